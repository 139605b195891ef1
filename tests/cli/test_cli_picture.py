"""``sameas picture``: objects, written files, printed text and refusals."""

import csv
import json
import os
import sys

import numpy as np
import pytest

from sameas.front.picture_options import Instants
from sameas.io import read_table
from sameas.io.sensors.sources import read_sources
from sameas.kernels import threads

START = 1714605000.0  # 2024-05-01 23:10 UTC
LAT, LON = 50.6, -1.0
NORTH, EAST = 111_229.0, 70_768.0  # metres per degree there
QUICK = "--no-map", "--no-image"
TOML = f"""
[sources.radar]
kind = "marine radar"
site = {{ lat_deg = {LAT}, lon_deg = {LON} }}
errors = {{ range_m = 20, range_share = 0, bearing_deg = 0.3, extent_m = 0 }}
"""


def write(path, head, rows):
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([head, *rows])
    return path


@pytest.fixture(scope="module")
def coast(tmp_path_factory):
    """AIS and a radar with biases of 60 m and 1°, of eight ships over two minutes; one ship has no AIS."""
    folder, rng = tmp_path_factory.mktemp("coast"), np.random.default_rng(3)
    place, speed = rng.uniform(-6e3, 6e3, (8, 2)), rng.normal(0.0, 5.0, (8, 2))
    ais, radar = [], []
    for t in np.arange(0.0, 120.0, 3.0):
        east, north = (place + speed * t).T
        distance, bearing = np.hypot(east, north), np.degrees(np.arctan2(east, north))
        for k in np.flatnonzero(rng.random(8) < 0.9):
            seen = distance[k] + 60 + 15 * rng.normal(), (bearing[k] + 1.0 + 0.2 * rng.normal()) % 360
            radar.append([START + t, k + 101, *seen])
        for k in range(7):
            if t % 12 == 3 * (k % 4):
                knots, course = np.hypot(*speed[k]) / 0.514444, np.degrees(np.arctan2(*speed[k])) % 360
                spot = LAT + north[k] / NORTH, LON + east[k] / EAST
                ais.append([START + t, 235000001 + k, *spot, knots, course, f"SHIP {k}" if k % 2 else ""])
    write(folder / "ais.csv", ["time", "mmsi", "lat", "lon", "sog_kn", "cog_deg", "name"], ais)
    write(folder / "radar.csv", ["time", "track_id", "range_m", "bearing_deg"], radar)
    (folder / "sensors.toml").write_text(TOML)
    return folder


@pytest.fixture
def picture(sameas, coast, tmp_path):
    """A function that makes a picture of the coast and returns the printed text and the folder."""

    def run(*more, files=("ais.csv", "radar.csv"), exit_code=0):
        out = tmp_path / "out"
        paths = [coast / name for name in files]
        shown = sameas("picture", *paths, "-s", coast / "sensors.toml", "-o", out, *more, exit_code=exit_code)
        return shown, out

    return run


@pytest.fixture
def refused(refusal, coast, tmp_path):
    """A function that returns the refusal of the command and checks that nothing is written."""

    def run(*arguments):
        message = refusal("picture", *arguments, "-o", tmp_path / "out", "--quiet", *QUICK)
        assert not (tmp_path / "out").exists()
        return message

    return run


@pytest.mark.slow
def test_files_give_objects_tables_a_map_and_a_summary(picture):
    shown, out = picture("--every", "10s")
    assert sorted(os.listdir(out)) == [
        "explanations.json", "identities.parquet", "map.html", "objects.geojson", "objects.parquet", "picture.png",
        "summary.json",
    ]  # fmt: skip
    text = " ".join(shown.stdout.split())
    for words in (
        "Sources ais (ais.csv): 70 reports (table, geodetic positions), read as ais: by its name",
        "radar: plots with ids, filtered to tracks with velocities",
        "Picture: 12 instants, 2024-05-01 23:10:00 to 23:11:50 UTC",
        "objects 8 confirmed; seen: 7 by 2 sources at once, 1 by 1 alone",
        "are expected to be wrong",
        "offset ais: not corrected, the reference for the others offset radar: range +",
        "% of the others' objects within its coverage; used: 10 % per scan",
        "assumed radar (marine radar): coverage.range_m 44448",
    ):
        assert words in text, words
    objects, records = read_table(out / "objects.parquet"), read_table(out / "identities.parquet")
    last = objects[objects["time_s"] == objects["time_s"].max()]
    assert len(last) == 8 and set(last["stage"]) == {"confirmed"} and np.sum(last["sources"] == "ais radar") == 7
    assert sorted(set(last["mmsi"]) - {""}) == [str(235000001 + k) for k in range(7)]
    # A row of the identities leads to the line of its file.
    number_of = dict(zip(last["mmsi"], last["object"], strict=True))
    lines = (picture_of := records[records["time_s"] == last["time_s"][0]])["line"]
    for source, line, track, number in zip(picture_of["source"], lines, picture_of["track_id"], picture_of["object"],
                                           strict=True):  # fmt: skip
        if source == "radar" and track != "108":
            assert number == number_of[str(235000001 + int(track) - 101)] and line > 1


@pytest.mark.slow
def test_the_summary_is_written_as_numbers_too(picture, coast):
    _, out = picture("--every", "30s", *QUICK)
    summary = json.loads((out / "summary.json").read_text())
    ais, radar = summary["sources"]
    assert (ais["kind_guessed"], radar["kind_guessed"]) == ("by its name", None) and ais["reports"] == 70
    found = summary["offsets"][1]
    shift, turn = found["parameters"]["range_m"], found["parameters"]["azimuth_deg"]
    assert found["source"] == "radar" and found["against"] == ["ais"] and found["established"]
    assert abs(shift["value"] - 60.0) < 4.0 * shift["standard_error"] and abs(turn["value"] - 1.0) < 0.2
    assert summary["confirmed_objects_by_number_of_sources"] == [0, 1, 7] and summary["unconfirmed_objects"] == 0
    assert 7.5 < summary["objects_per_instant"] <= 8.0 and summary["expected_wrong_per_instant"] < 0.1
    assert {"source": "ais", "kind": "ais", "name": "misses.q", "value": 0.2,
            "why": "small craft carry no transponder, and time slots collide"} in summary["assumed"]  # fmt: skip
    assert summary["files"] == [str(coast / "ais.csv"), str(coast / "radar.csv")] and len(summary["sha256"]) == 2


@pytest.mark.slow
def test_tables_may_be_csv_with_empty_cells_for_missing_values(picture):
    _, out = picture("--every", "60s", "--format", "csv", *QUICK)
    with open(out / "identities.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["bearing_deg"] for row in rows} == {""} and {row["source"] for row in rows} == {"ais", "radar"}
    with open(out / "objects.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    silent = [row for row in rows if row["sources"] == "radar"]
    assert silent and {row["mmsi"] for row in silent} == {""} and all(float(row["probability"]) > 0.9 for row in rows)


@pytest.mark.slow
def test_an_older_picture_in_the_folder_is_reported(picture):
    picture("--every", "60s", *QUICK)
    shown, out = picture("--every", "60s", "--format", "csv", *QUICK)
    assert f"not of this one: {out / 'objects.parquet'}, {out / 'identities.parquet'}" in shown.stderr


@pytest.mark.slow
def test_a_coast_of_ones_own_is_drawn_on_the_map(picture, tmp_path):
    """An island of 0.01° by 0.01° beside the radar, in place of the coasts of the world."""
    ring = [[LON + x, LAT + y] for x, y in ((0.0, 0.0), (0.01, 0.0), (0.01, 0.01), (0.0, 0.01), (0.0, 0.0))]
    (tmp_path / "island.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))

    def ground(*options):
        _, out = picture("--at", "23:11", "--no-image", *options)
        return json.loads((out / "map.html").read_text().split('id="data">')[1].split("</script>")[0])

    own, world = ground("--coast", tmp_path / "island.geojson"), ground()
    (island,) = own["land"]
    sides = np.ptp(np.array(island).reshape(-1, 2), axis=0)
    np.testing.assert_allclose(sides, [0.01 * EAST, 0.01 * NORTH], rtol=0.01)
    assert own["credit"] == "" and world["credit"].startswith("coast: Natural Earth") and island not in world["land"]


def test_quiet_prints_only_doubts_and_alarms(sameas, tmp_path):
    rows = [[START + t, 235000001, LAT + 0.03 * k, LON, 0.0, 0.0] for t in range(0, 60, 6) for k in (0, 1)]
    write(tmp_path / "ais.csv", ["time", "mmsi", "lat", "lon", "sog_kn", "cog_deg"], rows)
    shown = sameas("picture", tmp_path / "ais.csv", "-o", tmp_path / "out", "--every", "20s", "--quiet", *QUICK)
    assert shown.stdout == ""
    lines = [line for line in shown.stderr.splitlines() if "compiling" not in line]
    assert lines[0].startswith("sameas: ALARM: MMSI 235000001 is reported at two places 3337 m apart (")
    assert lines[0].endswith("from 2024-05-01 23:10:00 UTC") and " by ais line 2 and ais line 3: forged," in lines[0]
    assert all(line.startswith(("sameas: ALARM: ", "sameas: doubt: ")) for line in lines)


@pytest.mark.slow
def test_the_tables_are_the_same_for_any_number_of_threads(picture, monkeypatch):
    # Small pictures use one thread by default; here all allowed threads are used.
    monkeypatch.setattr(threads.even, "__defaults__", (1,))
    contents = []
    for count in ("1", "2", "3"):
        monkeypatch.setenv("SAMEAS_THREADS", count)
        _, out = picture("--every", "30s", *QUICK)
        contents.append({name: (out / name).read_bytes() for name in sorted(os.listdir(out))})
    assert len(contents[0]) == 5 and contents[0] == contents[1] == contents[2]


@pytest.mark.slow
def test_the_order_of_the_files_changes_no_object(picture):
    tables = []
    for files in (("ais.csv", "radar.csv"), ("radar.csv", "ais.csv")):
        _, out = picture("--every", "30s", *QUICK, files=files)
        tables.append(read_table(out / "objects.parquet"))
    one, two = tables
    assert one.colnames == two.colnames and len(one) == len(two)
    for name in one.colnames:
        if one[name].dtype.kind == "f":
            np.testing.assert_allclose(np.ma.filled(one[name], -1.0), np.ma.filled(two[name], -1.0), atol=1e-6)
        else:
            words = [[" ".join(sorted(str(cell).split())) for cell in table[name]] for table in tables]
            assert words[0] == words[1], name


def test_one_source_makes_a_picture(sameas, coast, tmp_path):
    shown = sameas("picture", coast / "ais.csv", "-o", tmp_path / "out", "--at", "23:11", *QUICK)
    assert "Picture: 2024-05-01 23:11:00 UTC\n  objects               7 confirmed\n  assumed" in shown.stdout


@pytest.mark.slow
def test_excluding_a_source_gives_the_picture_of_the_others(sameas, coast, tmp_path):
    both = (coast / "ais.csv", coast / "radar.csv", "--at", "23:11", "--format", "csv", *QUICK)
    sameas("picture", *both, "--without", "radar", "-o", tmp_path / "what-if")
    sameas("picture", coast / "ais.csv", "--at", "23:11", "--format", "csv", *QUICK, "-o", tmp_path / "alone")
    for name in ("objects.csv", "identities.csv"):
        assert (tmp_path / "what-if" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("radra",), "--without radra: there is no such source; give one of ais, radar"),
        (("ais", "radar"), "--without ais, radar: no source is left"),
    ],
)
def test_an_unknown_source_cannot_be_excluded(names, words, refused, coast):
    options = [part for name in names for part in ("--without", name)]
    assert words in refused(coast / "ais.csv", coast / "radar.csv", "-s", coast / "sensors.toml", *options)


@pytest.mark.slow
def test_sources_in_local_metres_give_no_geojson(sameas, tmp_path):
    rows = [[t, 1 + k, 100.0 * k + 2.0 * t, 50.0] for t in range(0, 20, 2) for k in range(3)]
    write(tmp_path / "radar.csv", ["t", "track_id", "x_m", "y_m"], rows)
    bearings = [[t, float(np.degrees(np.arctan2(r[2] - 50.0, r[3] + 400.0)))] for r in rows for t in [r[0]]]
    write(tmp_path / "camera.csv", ["t", "bearing_deg"], bearings)
    (tmp_path / "s.toml").write_text(
        "[sources.radar]\nsite = { east_m = 0, north_m = 0 }\nerrors = { position_m = 5 }\n"
        '[sources.camera]\nkind = "camera"\nsite = { east_m = 50, north_m = -400 }\n'
    )
    shown = sameas("picture", tmp_path / "radar.csv", tmp_path / "camera.csv", "-s", tmp_path / "s.toml",
                   "-o", tmp_path / "out", "--every", "6s", *QUICK)  # fmt: skip
    # Without a kind, the kind follows from the name of the description.
    assert "read as marine radar: by its name" in shown.stdout and "0 to 18 s" in shown.stdout
    assert sorted(os.listdir(tmp_path / "out")) == [
        "explanations.json",
        "identities.parquet",
        "objects.parquet",
        "summary.json",
    ]
    assert "3 confirmed; seen: 3 by 2 sources at once" in shown.stdout


UNUSABLE = [
    ("", "is empty"),
    ("time,lat,lon,mmsi\n", "names columns, but has no row that can be used"),
    ("hello\n", "no format of sensors fits; as a table, its line 1 does not name columns"),
    ("Dear sir,\nnothing\n", "no columns of time and a position among"),
    (b"\x93\x00\x01" * 999, "is binary, but neither ASTERIX, pcap nor Parquet"),
    (b"PAR1" + bytes(9), "cannot be read as CSV, Parquet or JSON lines"),
    ("lat,lon,mmsi\n1,2,3\n", "no column of time among: lat, lon, mmsi; give file = { columns = { time_s = "
                              "\"NAME\" } } in its table [sources.NAME] of the --sensors file"),
    ("time,lat,lon\n2024-05-01T12:00:00Z,50,1\n", "what kind of sensor is it? Neither its name nor its columns"),
    ("time,lat,lon,mmsi\n23:10:00,50,1,235000001\n", "give start, the UTC date of the first row: --start, or"),
    ("time,track_id,range_m,bearing_deg\n1714605000,1,2,3\n",
     "the sensor's position is not known; give site = { lat_deg = …, lon_deg = … } in its description"),
    (None, "no such file"),
]  # fmt: skip


def put(path, content):
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(("content", "words"), UNUSABLE)
def test_unusable_files_are_refused_with_a_remedy(content, words, refused, tmp_path):
    assert words in refused(put(tmp_path / "other.csv", content))


@pytest.mark.slow
@pytest.mark.parametrize(("content", "words"), UNUSABLE[::3])
def test_an_unusable_file_is_set_aside_and_reported_where_others_can_be_used(content, words, sameas, coast, tmp_path):
    other, out = put(tmp_path / "other.csv", content), tmp_path / "picture"
    result = sameas("picture", coast / "ais.csv", other, "-o", out, "--quiet", *QUICK, exit_code=1)
    assert result.stderr.startswith("sameas: doubt: set aside: ") and words in result.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert [source["name"] for source in summary["sources"]] == ["ais"] and words in summary["doubts"][0]
    assert words not in sameas("picture", coast / "ais.csv", other, "--without", "other", "-o", out, *QUICK).stdout


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        (None, "s.toml: cannot be read as TOML (No such file or directory)"),
        ("[sources.radar", "s.toml: cannot be read as TOML (Expected ']'"),
    ],
)
def test_a_file_that_describes_nothing_is_refused_with_a_remedy(toml, words, refused, coast, tmp_path):
    put(tmp_path / "s.toml", toml)
    assert words in refused(coast / "ais.csv", coast / "radar.csv", "-s", tmp_path / "s.toml")


SITE = f"site = {{ lat_deg = {LAT}, lon_deg = {LON} }}"


MISDESCRIBED = [
    (TOML + '[sources.lidar]\nkind = "lidar"\n',
     "lidar is described, but no file belongs to it; there are ais, radar", ["ais", "radar"]),
    (TOML.replace("lon_deg", "long_deg"), "radar: 'long_deg' in site is not known; did you mean lon_deg?", ["ais"]),
    (TOML.replace("= 20", '= "20 m"'), "radar: errors.range_m is '20 m'; give a number", ["ais"]),
    (TOML.replace("marine", "quantum"), "radar: kind is 'quantum radar'; give one of marine radar", ["ais"]),
    (TOML + "file = 3\n", "sources.radar.file is 3; give a path, or { path = ", ["ais"]),
    (TOML + 'file = { columns = "d" }\n', "sources.radar.file.columns is 'd'; give { range_m = \"d\" }", ["ais"]),
    (TOML + "file = { path = 3 }\n", "sources.radar.file.path is 3; give a text", ["ais"]),
    (TOML + 'file = { columns = { range_m = "Range" } }\n', "radar: no column 'Range' among: time, tr", ["ais"]),
    (TOML.replace(SITE, ""), "radar: the sensor's position is not known; give site = {", ["ais"]),
    (TOML.replace(SITE, "site = { lat_deg = 50.6 }"), "radar: site: give lat_deg and lon_deg, or east_m", ["ais"]),
    (TOML.replace(SITE, f"site = {{ lat_deg = {LON}, lon_deg = {LAT} }}"), "radar: lies 7", ["ais"]),
    (TOML.replace("marine radar", "other"), "radar: motion.speed_m_per_s is not known and 'other'", ["ais"]),
    ("[sources.ais]\nkind = 7\n" + TOML, "ais: kind is '7'; give one of", ["radar"]),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("toml", "words", "used"), MISDESCRIBED)
def test_a_source_that_is_not_described_rightly_is_set_aside(toml, words, used, sameas, coast, tmp_path):
    toml, out = put(tmp_path / "s.toml", toml), tmp_path / "picture"
    files = coast / "ais.csv", coast / "radar.csv"
    result = sameas("picture", *files, "-s", toml, "-o", out, "--quiet", *QUICK, exit_code=1)
    assert "sameas: doubt: set aside: " in result.stderr and words in result.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert [source["name"] for source in summary["sources"]] == used and words in summary["doubts"][0]


@pytest.mark.slow
@pytest.mark.parametrize(("toml", "words", "used"), MISDESCRIBED[::5])
def test_a_watch_goes_on_without_a_source_that_is_not_described_rightly(toml, words, used, sameas, coast, tmp_path):
    files, toml = (coast / "ais.csv", coast / "radar.csv"), put(tmp_path / "s.toml", toml)
    result = sameas("watch", *files, "-s", toml, "--pace", "1000", "--no-map", exit_code=1)
    assert words in " ".join(result.stdout.split()) and f"  {used[-1]}: " in result.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("when", "words"),
    [
        (("--at", "12:00"), "no source has a report at 2024-05-01 12:00:00 UTC; reports are of 2024-05-01 23:"),
        (("--at", "noon"), "--at noon: give a time such as 2024-05-01T13:00:00Z, 13:00, or seconds"),
        (("--from", "23:11", "--to", "23:10:30"), "from 2024-05-01 23:11:00 (--from 23:11) to 23:10:30 UTC (--to 23:"),
        (("--to", "2024-05-01T20:00:00Z"), "to 20:00:00 UTC (--to 2024-05-01T20:00:00Z): it ends before it begins"),
        (("--every", "0.0001s"), "--every 0.0001s makes 1 170 000 instants from 2024-05-01 23:10:00 to 23:11:57 UTC"),
    ],
)
def test_invalid_times_are_refused(when, words, refused, coast):
    assert words in refused(coast / "ais.csv", coast / "radar.csv", "-s", coast / "sensors.toml", *when)


@pytest.mark.slow_after(2)
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--quiet",), "give the sensors' files, or --sensors"),
        (("a.csv", "--every", "-3s"), "'-3s' is not a duration; give 10s, 2min or 1h"),
        (("a.csv", "--every", "0s"), "'0s' is not a duration"),
        (("a.csv", "--at", "12:00", "--every", "3s"), "give --at, or --every with --from and --to, not both"),
        (("a.csv", "--format", "fits"), "'fits' is not known"),
    ],
)
def test_wrong_usage_is_reported(arguments, words, sameas):
    shown = sameas("picture", *arguments, exit_code=2)
    assert words in " ".join(shown.stderr.replace("│", " ").split())


def test_a_time_of_day_refers_to_the_reports_also_across_midnight():
    midnight = 1714608000.0
    late = midnight - 600.0, midnight + 900.0
    assert Instants(None, "23:55", None, None).of([late]).tolist() == [midnight - 300.0]
    assert Instants(None, "00:05:30", None, None).of([late]).tolist() == [midnight + 330.0]
    assert Instants(300.0, None, "23:56", "00:10").of([late]).tolist() == [midnight, midnight + 300, midnight + 600]


def test_the_default_number_of_instants_is_reasonable():
    assert len(Instants(None, None, None, None).of([(START, START + 100.0)])) == 101
    for span_s in (7000.0, 86400.0, 1e7):
        assert 100 <= len(Instants(None, None, None, None).of([(START, START + span_s)])) <= 202


@pytest.mark.slow
def test_only_reports_of_an_area_are_used(sameas, refused, coast, tmp_path):
    """AIS of a harbour and of another one 3 000 km away, and a file of ships of that one only."""
    rows = (coast / "ais.csv").read_text().splitlines()
    cells = [row.split(",") for row in rows[1:]]
    away = [",".join([one[0], str(int(one[1]) + 50), str(float(one[2]) - 27.0), *one[3:]]) for one in cells]
    (tmp_path / "ais.csv").write_text("\n".join([*rows, *away]) + "\n")
    (tmp_path / "south.csv").write_text("\n".join([rows[0], *away]) + "\n")
    files = tmp_path / "ais.csv", coast / "radar.csv"
    near = "-s", coast / "sensors.toml", "--within", f"{LAT},{LON},20nm"
    shown = sameas("picture", *files, tmp_path / "south.csv", *near, "-o", tmp_path / "part", *QUICK, exit_code=1)
    assert f"{len(cells)} of {2 * len(cells)} reports are within 37 km of {LAT}, {LON:g}; only these" in shown.stdout
    assert f"south: none of its {len(cells)} positions is within 37 km" in shown.stdout
    one = tmp_path / "one"
    sameas("picture", coast / "ais.csv", files[1], "-s", coast / "sensors.toml", "-o", one, *QUICK)
    objects, alone = (read_table(folder / "objects.parquet") for folder in (tmp_path / "part", one))
    assert objects["lat_deg"].tolist() == alone["lat_deg"].tolist()
    assert f"south: none of its {len(cells)} positions" in refused(tmp_path / "south.csv", *near[2:])


@pytest.mark.parametrize("text", ["54;10", "54,10", "54,10,50 miles", "95,10,50", "54,10,0", "nan,1,1"])
def test_an_area_that_is_none_is_refused(text, refused, coast):
    assert f"--within {text.removesuffix(' miles')}"[:11] in refused(coast / "ais.csv", "--within", text)


def test_a_continent_is_one_area_and_the_earth_is_none(sameas, refused, tmp_path):
    """Aircraft over a continent were 'too far for one plane' from their own second source."""
    rng = np.random.default_rng(5)
    places = {"wide": ((30.0, 50.0), (-120.0, -70.0)), "earth": ((-80.0, 80.0), (-180.0, 180.0))}
    for name, (lat, lon) in places.items():
        start = np.column_stack([rng.uniform(*lat, 30), rng.uniform(*lon, 30)])
        for part, noise in (("a", 1e-4), ("b", 2e-4)):
            rows = [
                [START + t, f"{0x4B0000 + k:06x}", *(start[k] + [1e-3 * t, 0.0] + noise * rng.normal(size=2)), 216, 0]
                for t in range(0, 60, 5) for k in range(30)
            ]  # fmt: skip
            write(tmp_path / f"{name}-{part}.csv", ["time", "icao24", "lat", "lon", "groundspeed", "track"], rows)
    files = [tmp_path / f"wide-{part}.csv" for part in "ab"]
    shown = sameas("picture", *files, "--no-identity", "-o", tmp_path / "wide", *QUICK)
    assert "30 confirmed; seen: 30 by 2 sources at once" in shown.stdout
    words = refused(*(tmp_path / f"earth-{part}.csv" for part in "ab"))
    assert "--within LAT,LON,KM" in words


def test_two_flights_months_apart_are_a_picture_of_both(sameas, tmp_path):
    """Instants were spread over the months between, in which there is nothing; predicted over them, an aircraft left
    the earth, which ended the run."""
    rows = ["time,icao24,lat,lon,groundspeed,track"]
    for address, begin in (("4b17fd", START), ("4b17fe", START + 60 * 86400.0)):
        rows += [f"{begin + t},{address},{47.45 + 1e-3 * t:.5f},8.55,220,0" for t in range(0, 300, 5)]
    (tmp_path / "adsb.csv").write_text("\n".join(rows) + "\n")
    sameas("picture", tmp_path / "adsb.csv", "-o", tmp_path / "picture")
    objects = read_table(tmp_path / "picture" / "objects.parquet")
    shown = objects[objects["stage"] == "confirmed"]
    assert set(shown["icao"]) == {"4b17fd", "4b17fe"} and 100 < len(shown) < 400
    lost = objects[objects["stage"] == "ended"]
    assert len(lost) == 1 and lost["x_m"].mask.all() and lost["lat_deg"].mask.all()


def test_an_unwritable_folder_is_refused_at_the_start(refusal, coast, tmp_path):
    (tmp_path / "file").write_text("mine")
    message = refusal("picture", coast / "nothing.csv", "-o", tmp_path / "file")
    assert message == f"cannot write into {tmp_path / 'file'}: file exists; give another folder"


@pytest.mark.slow
def test_an_interruption_while_writing_leaves_nothing(sameas, coast, tmp_path, monkeypatch):
    from sameas.io import geojson

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(geojson, "write_geojson", stopped)
    shown = sameas("picture", coast / "ais.csv", "-o", tmp_path / "out", "--at", "23:11", *QUICK, exit_code=130)
    assert "stopped; nothing was written" in shown.stderr and not (tmp_path / "out").exists()


def test_without_matplotlib_only_the_image_is_missing(sameas, coast, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    shown = sameas("picture", coast / "ais.csv", "-o", tmp_path / "out", "--at", "23:11", "--no-map")
    assert "no picture.png: " in shown.stderr and "pip install 'sameas[plots]'" in shown.stderr
    assert "picture.png" not in os.listdir(tmp_path / "out") and "objects.parquet" in os.listdir(tmp_path / "out")


@pytest.mark.parametrize("missing", ["pymap3d", "pyais"])
def test_a_missing_package_is_named_with_its_install_line(missing, refused, coast, tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == missing]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    log = tmp_path / "coast.nmea"
    log.write_text("!AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C\n")
    file = log if missing == "pyais" else coast / "ais.csv"
    assert "pip install 'sameas[targets]'" in refused(file, "--start", "2024-05-01")


def test_damaged_lines_are_listed_and_the_rest_used(sameas, coast, tmp_path):
    lines = (coast / "ais.csv").read_text().splitlines()
    lines[4], lines[9] = "ink", lines[9].replace("50.", "fifty ")
    (tmp_path / "ais.csv").write_text("\n".join(lines) + "\n")
    shown = sameas("picture", tmp_path / "ais.csv", "-o", tmp_path / "out", "--at", "23:11", *QUICK)
    assert "68 reports" in shown.stdout and "1 line damaged: has not 7 cells (line 5)" in shown.stdout
    assert "1 line damaged: lat is no number (line 10)" in shown.stdout
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert sum(summary["sources"][0]["damaged"].values()) == 2


@pytest.mark.slow
def test_a_zero_byte_in_a_log_is_one_damaged_line(tmp_path):
    (tmp_path / "log.nmea").write_bytes(
        b"\\c:1714605000*50\\!AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C\n\x00\x01\n"
    )
    [source] = read_sources([tmp_path / "log.nmea"])
    assert len(source.reports) == 1 and source.reports.damaged.lines.tolist() == [2]


@pytest.mark.slow
@pytest.mark.parametrize("days", [-365, 30])
def test_a_source_of_another_day_does_not_stretch_a_picture_or_a_replay(days, sameas, coast, tmp_path):
    rows = list(csv.reader((coast / "radar.csv").read_text().splitlines()))
    write(tmp_path / "radar.csv", rows[0], [[float(row[0]) + 86_400 * days, *row[1:]] for row in rows[1:]])
    files = coast / "ais.csv", tmp_path / "radar.csv"
    words = "set aside: ais: its reports are of 2024-05-01"  # the radar has more reports
    options = "-s", coast / "sensors.toml"
    result = sameas("picture", *files, *options, "--every", "20s", "-o", tmp_path / "out", *QUICK, exit_code=1)
    assert words in " ".join(result.stdout.split()) and "Picture: 6 instants" in result.stdout
    result = sameas("watch", *files, *options, "--pace", "1000", "--no-map", exit_code=1)
    assert words in " ".join(result.stdout.split())


@pytest.mark.slow
def test_a_watch_begins_without_the_inputs_that_cannot_be_used(sameas, tmp_path):
    toml = put(
        tmp_path / "s.toml",
        """
[watch]
every_s = 0.2
own_ship = { source = "bridge" }
[sources.ais]
kind = "ais"
input = "udp://127.0.0.1:0?"
[sources.north]
kind = "ais"
input = "tcp-listen://127.0.0.1:18642"
[sources.bridge]
kind = "marine radar"
input = { url = "10.0.0.5:10110", format = "nmea" }
[sources.approach]
kind = "air radar"
input = { url = "udp://239.1.1.1:8600", format = "astrix" }
[sources.recorded]
kind = "marine radar"
""",
    )
    result = sameas("watch", "-s", toml, "--no-map", "--for", "2s", exit_code=1)
    shown = " ".join(result.stdout.split())
    for words in (
        "set aside: input 'udp://127.0.0.1:0?': has no port; give udp://HOST:PORT",
        "set aside: input '10.0.0.5:10110': is not a known kind of input; give udp://10.0.0.5:10110, or tcp://",
        "sources.approach.input: format is 'astrix'; give one of",
        "set aside: recorded: has no input; give input = ",
    ):
        assert words in shown
    assert shown.count("is set aside: ") == 4 and " north: 0 reports" in shown  # an alarm for each
    toml.write_text(toml.read_text().replace("tcp-listen", "telnet"))
    assert "input 'udp://127.0.0.1:0?': has no port" in sameas("watch", "-s", toml, "--no-map", exit_code=1).stderr
