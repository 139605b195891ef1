"""Sensor files: formats are recognised from content; descriptions are paired with files, or inferred from them."""

import gzip
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.sensors import REPORT_FORMATS, ReadOptions, read_reports
from sameas.io.sensors.format import SensorFile, at_second, forward_filled, instant, unwrapped
from sameas.io.sensors.report_formats import format_of
from sameas.io.sensors.sources import read_source_options, read_sources

PLOTS = "time,range_km,bearing\n2024-05-01T12:00:00Z,5.2,40\n2024-05-01T12:00:03Z,5.1,41\n"
FIXES = "time,lat,lon,sog,mmsi\n2024-05-01T12:00:00Z,50.1,-1.2,10,235070762\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "plots.csv").write_text(PLOTS)
    (tmp_path / "coast.csv").write_text(FIXES)
    return tmp_path


def test_kinds_are_recognised_by_name_and_columns(folder):
    (folder / "harbour radar.csv").write_text(PLOTS)
    (folder / "unknown.csv").write_text("time,lat,lon\n2024-05-01T12:00:00Z,50.1,-1.2\n")
    radar, coast, plots = read_sources([folder / name for name in ("harbour radar.csv", "coast.csv", "plots.csv")])
    assert [s.description.kind for s in (radar, coast, plots)] == ["marine radar", "ais", "marine radar"]
    assert "read as ais: it has a column of mmsi" in coast.lines()[0]
    (folder / "flarm.csv").write_text("time,id,lat,lon,alt_m\n2024-05-01T12:00:00Z,DD1234,50.1,-1.2,600\n")
    assert read_sources([folder / "flarm.csv"])[0].description.kind == "ads-b"
    with pytest.raises(InputError, match=r"unknown: what kind of sensor is it\?.*\[sources.unknown\]"):
        read_sources([folder / "unknown.csv"])


def test_a_description_names_its_file_and_how_to_read_it(folder):
    (folder / "odd.csv").write_text("t,d,theta\n00:00:00,5.2,40\n00:00:03,5.1,41\n")
    (folder / "sensors.toml").write_text(
        '[sources.west]\nkind = "marine radar"\nsite = { lat_deg = 50, lon_deg = -1 }\n'
        'file = { path = "odd.csv", start = "2024-05-01", columns = { time_s = "t", range_m = "d", '
        'bearing_deg = "theta" }, units = { d = "km" } }\n'
    )
    [west] = read_sources([], read_source_options(folder / "sensors.toml"))
    assert west.description.name == west.reports.source == "west" and west.why_kind is None
    assert west.reports.range_m.tolist() == [5200.0, 5100.0] and west.reports.time_s[0] == 1714521600.0


def test_a_description_may_leave_the_kind_to_the_file(folder):
    (folder / "s.toml").write_text(
        '[sources.plots]\nsite = { lat_deg = 50, lon_deg = -1 }\nfile = { path = "plots.csv", start = 2024-05-01 }\n'
        '[sources.coast]\nkind = "other"\nfile = "coast.csv"\n'
    )
    plots, coast = read_sources([], read_source_options(folder / "s.toml"))
    assert (plots.description.kind, plots.why_kind) == ("marine radar", "it has a column of range_m")
    assert plots.description.site.lat_deg == 50 and plots.description.errors.bearing_deg == 0.5
    assert (coast.description.kind, coast.why_kind) == ("other", None)


def test_names_may_be_given_with_the_file(folder):
    toml = folder / "s.toml"
    toml.write_text('[sources.west]\nkind = "marine radar"\n')
    [west] = read_sources([f"west={folder / 'plots.csv'}"], read_source_options(toml))
    assert west.description.name == "west" and not any(a.source != "west" for a in west.description.assumed)
    with pytest.raises(InputError, match="west is described, but no file belongs to it; there are plots: give"):
        read_sources([folder / "plots.csv"], read_source_options(toml))
    with pytest.raises(InputError, match="two sources are called plots; name them, as in plots2=FILE, or plots=FILE"):
        read_sources([folder / "plots.csv", folder / "plots.csv"])
    with pytest.raises(InputError, match="west: its files are of several kinds: table, polar positions; "):
        read_sources([f"west={folder / 'plots.csv'}", f"west={folder / 'coast.csv'}"])
    with pytest.raises(InputError, match="no files"):
        read_sources([])


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ("[sources]\nwest = 3\n", r"sources.west is no table"),
        ('[sources.west]\nkind = "ais"\nfile = { colums = {} }\n', "'colums' is not known; give path, format"),
        ("[sources.west\n", "cannot be read as TOML"),
        ("x = 1\n", "describes no sources"),
    ],
)
def test_errors_of_a_description_are_reported(tmp_path, toml, message):
    (tmp_path / "s.toml").write_text(toml)
    with pytest.raises(InputError, match=message):
        read_source_options(tmp_path / "s.toml")


def test_a_log_of_two_sensors_gives_two_sources():
    from pathlib import Path

    log = Path(__file__).parent / "data" / "ais_sample.nmea"
    ais = read_sources([log], start="2024-05-01")
    assert [s.description.kind for s in ais] == ["ais"]


def test_times_of_day_have_the_date_of_the_other_sources(tmp_path):
    """A radar's export with times of day only, across midnight, beside AIS of one evening; not beside AIS of a week."""
    (tmp_path / "radar.csv").write_text("time,range_m,brg\n23:59:58.0,1000,70\n00:00:02.0,1010,71\n")
    ais = "time,lat,lon,mmsi\n2024-05-01T23:58:00Z,50.1,-1.2,235070762\n{}T00:05:00Z,50.1,-1.2,235070762\n"
    (tmp_path / "ais.csv").write_text(ais.format("2024-05-02"))
    radar, _ = read_sources([tmp_path / "radar.csv", tmp_path / "ais.csv"])
    assert radar.reports.time_s.tolist() == [instant("2024-05-01T23:59:58Z"), instant("2024-05-02T00:00:02Z")]
    assert "its times of day are read as those of 2024-05-01, the date of the others" in " ".join(radar.lines())
    (tmp_path / "ais.csv").write_text(ais.format("2024-05-08"))
    with pytest.raises(InputError, match="has the time of day only; give start"):
        read_sources([tmp_path / "radar.csv", tmp_path / "ais.csv"])


def test_times_of_day_of_all_sources_are_of_one_day(tmp_path):
    """Two exports without any date are compared, also where one begins after midnight; one alone has no date."""
    radar, ais = tmp_path / "radar.csv", tmp_path / "ais.csv"
    radar.write_text("time,range_m,brg\n23:59:58.0,1000,70\n00:00:02.0,1010,71\n")
    ais.write_text("time,lat,lon,mmsi\n00:00:01,50.1,-1.2,235070762\n00:05:00,50.1,-1.2,235070762\n")
    for file in (radar, ais):
        os.utime(file, (instant("2024-05-02T08:00:00Z"),) * 2)
    found = read_sources([radar, ais])
    first_s = instant("2024-05-02T23:59:58Z")
    assert [(one.reports.time_s - first_s).tolist() for one in found] == [[0.0, 4.0], [3.0, 302.0]]
    for one, day in zip(found, ("02", "03"), strict=True):
        said = f"those of 2024-05-{day}, as no source states a date and radar.csv was written then"
        assert said in " ".join(one.lines())
    with pytest.raises(InputError, match="has the time of day only; give start"):
        read_sources([radar])


def test_a_format_named_like_a_kind_of_source_has_that_kind(folder, monkeypatch):
    """So a new sensor needs no table of formats and kinds."""
    from sameas.io.sensors import report_formats
    from sameas.io.sensors.format import SensorFormat
    from sameas.tracks.kinds import KINDS, Kind
    from sameas.tracks.reports import Reports

    def read(file):
        time_s, x_m, y_m = zip(*(map(float, line.split()) for line in file.lines[1:]), strict=True)
        return [Reports.of(file.source, "sonar", {"time_s": time_s, "x_m": x_m, "y_m": y_m})]

    sonar = SensorFormat("sonar", "sonar pings", read, lambda file: file.head_lines[0] == "SONAR")
    monkeypatch.setattr(report_formats, "SENSOR_FORMATS", (sonar, *report_formats.SENSOR_FORMATS))
    monkeypatch.setitem(KINDS, "sonar", Kind("a sonar", {"errors.position_m": (20.0, "a test")}))
    (folder / "pings.txt").write_text("SONAR\n0 10 20\n5 12 22\n")
    [pings] = read_sources([folder / "pings.txt"])
    assert (pings.description.kind, pings.why_kind) == ("sonar", "its format is sonar")
    assert pings.description.errors.position_m == 20.0


@pytest.mark.parametrize(
    "given",
    [
        'columns = { range_m = "Range" }',
        'columns = { range = "d" }',
        'columns = { range_m = "d" }, units = { d = "furlong" }',
    ],
)
def test_a_description_that_does_not_fit_its_file_sets_its_source_aside(given, tmp_path):
    (tmp_path / "ais.csv").write_text("time,lat,lon,mmsi\n0,50.0,-1.0,235000001\n")
    (tmp_path / "radar.csv").write_text("time,d,bearing\n0,900,45\n")
    (tmp_path / "sensors.toml").write_text(
        f'[sources.radar]\nkind = "marine radar"\nfile = {{ path = "radar.csv", {given} }}\n'
    )
    words, options = (
        r"radar: .*(among: time, d, bearing|did you mean range_m|unit 'furlong')",
        tmp_path / "sensors.toml",
    )
    with pytest.raises(InputError, match=words):
        read_sources([tmp_path / "ais.csv"], read_source_options(options))
    set_aside: dict[str, InputError] = {}
    [ais] = read_sources([tmp_path / "ais.csv"], read_source_options(options), set_aside=set_aside)
    assert ais.description.name == "ais" and re.search(words, str(set_aside["radar"]))


DATA = Path(__file__).parent / "data"
ORACLE = json.loads((DATA / "asterix_oracle.json").read_text())


@pytest.mark.parametrize(
    ("found", "name"),
    [
        (b"# log\n!AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C\n", "nmea"),
        (b"1452603731 $RATTM,01,1,1,T,1,1,T,,,N,,T,,,A*00\n", "nmea"),
        (b'{ "now" : 1.0, "aircraft" : [] }', "aircraft"),
        (b"MSG,3,1,1,4CA7A8,1,2024/05/01,12:00:00,2024/05/01,12:00:00,,,,,,,,,,,,\n", "sbs"),
        (b"*8D40621D58C386435CC412692AD6;\n", "mode-s"),
        (b"1457996400.0,8D40621D58C386435CC412692AD6\n", "mode-s"),
        (b"time,lat,lon\n1,2,3\n", "table"),
        (b'{"time": 1, "lat": 2, "lon": 3}\n', "table"),
        (b"PAR1....", "table"),
        (bytes.fromhex(ORACLE["records"][0]["block"]), "asterix"),
        (b"\xd4\xc3\xb2\xa1" + bytes(20), "asterix"),
    ],
)
def test_the_format_is_recognised_from_the_content(found, name):
    file = SensorFile(Path("file"), found, "file", ReadOptions())
    assert name in REPORT_FORMATS and format_of(file).name == name


@pytest.mark.parametrize("head", ['"time","mmsi","lat","lon"', "Altitude,time,mmsi,lat,lon", ">time;mmsi;lat;lon"])
def test_a_long_table_is_no_asterix(tmp_path, head):
    """Its first three bytes are a category of radars and, in a file of 30 kB, the length of a block."""
    (tmp_path / "coast.csv").write_text(head + "\n" + '"2024-05-01 12:00:00",235070762,50.1,-1.2\n' * 1000)
    assert format_of(SensorFile.of(tmp_path / "coast.csv", ReadOptions())).name == "table"


def test_gzipped_files_are_read(tmp_path):
    (tmp_path / "log.gz").write_bytes(gzip.compress((DATA / "ais_sample.nmea").read_bytes()))
    [packed], [plain] = read_reports(tmp_path / "log.gz"), read_reports(DATA / "ais_sample.nmea")
    np.testing.assert_array_equal(packed.lat_deg, plain.lat_deg)
    (tmp_path / "cut.gz").write_bytes((tmp_path / "log.gz").read_bytes()[:-20])
    with pytest.raises(InputError, match=r"cut.gz: is cut off in the middle; copy it again"):
        read_reports(tmp_path / "cut.gz")


def test_the_start_is_a_date_or_an_instant(tmp_path):
    (tmp_path / "radar.ast").write_bytes(bytes.fromhex(ORACLE["records"][0]["block"]))
    for start in ("2024-05-01", "2024-05-01T23:59:58Z", 1714521600.0):
        [made] = read_reports(tmp_path / "radar.ast", ReadOptions(start=start, source="radar"))
        assert (made.source, made.time_s[0]) == ("radar", 1714521600.0 + 86399.5)
    with pytest.raises(InputError, match="start='yesterday' is not an instant; give a date"):
        read_reports(tmp_path / "radar.ast", ReadOptions(start="yesterday"))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"\x89PNG\r\n\x1a\n" + bytes(40), "is binary, but neither ASTERIX, pcap nor Parquet"),
        (
            b"$GPZDA,130211.00,12,01,2016,00,00*61\n",
            "no AIS .VDM. and no radar targets .TTM, TLL. among its sentences: ZDA",
        ),
        (b"hello\n", "no format of sensors fits; as a table, its line 1 does not name columns"),
    ],
)
def test_unreadable_files_are_reported(tmp_path, content, words):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(InputError, match=f"file: {words}"):
        read_reports(tmp_path / "file")


def test_wrong_paths_and_formats_are_reported(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_reports(tmp_path / "none.csv")
    with pytest.raises(InputError, match="is a directory"):
        read_reports(tmp_path)
    (tmp_path / "a.csv").write_text("time,lat,lon\n1,2,3\n")
    with pytest.raises(InputError, match="unknown format 'cvs'; give one of table, "):
        read_reports(tmp_path / "a.csv", ReadOptions(format="cvs"))


def test_a_summary_lists_rows_read_damage_and_assumptions():
    [made] = read_reports(DATA / "ais_sample.nmea", ReadOptions(source="coast"))
    summary = made.summary()
    assert summary[0] == "coast: 11 reports (ais, geodetic positions)"
    assert "1 line damaged: wrong checksum (line 19)" in summary and "1 skipped: AIS message of type 4" in summary
    assert any("assumed 5 m per axis" in line for line in summary)


def test_wrapping_counters_are_unwrapped_and_gaps_kept():
    values = np.array([50.0, np.nan, 10.0, 55.0, 20.0])
    np.testing.assert_array_equal(unwrapped(values, 60.0), [50.0, np.nan, 70.0, 55.0, 80.0])
    np.testing.assert_array_equal(unwrapped([np.nan], 60.0), [np.nan])
    rng = np.random.default_rng(4)
    times = np.cumsum(rng.uniform(0.0, 29.0, 500))
    np.testing.assert_allclose(unwrapped(times % 60.0, 60.0), times - 60.0 * (times[0] // 60.0))


def test_missing_values_are_filled_forward():
    assert forward_filled(np.array([np.nan, 2.0, np.nan, 5.0])).tolist() == [2.0, 2.0, 2.0, 5.0]
    assert np.isnan(forward_filled(np.array([np.nan]))).all()
    assert at_second(np.array([100.0]), np.array([np.nan]))[0] == 100.0


def test_invalid_times_are_missing():
    assert instant("radar") is None and instant("") is None and instant("2024-13-45") is None


@pytest.mark.slow
def test_no_decoder_is_loaded_before_a_file_needs_it():
    program = "import sys, sameas.io.sensors; print(*sorted({name.split('.')[0] for name in sys.modules}))"
    loaded = set(
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    )
    assert "numpy" in loaded and not loaded & {"pyais", "rs1090", "pymap3d", "pyarrow", "astropy", "scipy", "numba"}


def test_the_track_of_a_vessel_that_carries_a_sensor_needs_no_kind(tmp_path):
    (tmp_path / "gps.csv").write_text("time,lat,lon\n0,50.0,-1.0\n60,50.0,-1.0\n")
    (tmp_path / "radar.csv").write_text("time,range_m,bearing\n10,1000,20\n")
    toml = tmp_path / "sensors.toml"
    toml.write_text('[sources.radar]\nkind = "marine radar"\nplatform = { source = "gps" }\n')
    files = tmp_path / "radar.csv", tmp_path / "gps.csv"
    _, gps = read_sources(files, read_source_options(toml))
    assert gps.description.kind == "tracks" and gps.why_kind == "it has the positions of a vessel with a sensor"
    with pytest.raises(InputError, match="gps: what kind of sensor is it"):
        read_sources(files)


def test_a_table_of_one_path_without_names_is_own_ships(tmp_path):
    """It was asked what kind of sensor she is."""
    rows = [f"{t},{50.0 + 5.0 * t / 111_200.0:.6f},-1.0,5" for t in range(40)]
    (tmp_path / "voyage.csv").write_text("time_s,lat,lon,heading\n" + "\n".join(rows) + "\n")
    [own] = read_sources([tmp_path / "voyage.csv"])
    assert own.reports.kind == "own ship" and own.lines()[0] == (
        "voyage (voyage.csv): 40 reports (own ship, geodetic positions): its positions have no names and are on one "
        "path: own ship; if not, give its kind"
    )
    # Plots without names jump.
    jumping = [row.replace("50.0", "50.1") if k % 3 else row for k, row in enumerate(rows)]
    (tmp_path / "voyage.csv").write_text("time_s,lat,lon,heading\n" + "\n".join(jumping) + "\n")
    with pytest.raises(InputError, match="voyage: what kind of sensor is it"):
        read_sources([tmp_path / "voyage.csv"])


def test_files_of_one_name_are_parts_of_one_source(tmp_path):
    """They were two radars, of which one ended and the other began."""
    (tmp_path / "b.csv").write_text("time,range_m,bearing\n2024-05-01T11:00:00Z,900,10\nlate,900,10\n")
    (tmp_path / "a.csv").write_text("time,range_m,bearing,track_id\n2024-05-01T10:00:00Z,800,12,7\n")
    [radar] = read_sources([f"radar={tmp_path / name}" for name in ("b.csv", "a.csv")])
    assert radar.reports.range_m.tolist() == [800.0, 900.0] and radar.reports.track_id.tolist() == ["7", None]
    first, damage, *_ = radar.lines()
    assert first.startswith("radar (a.csv, b.csv): 2 reports") and damage.startswith("1 line damaged: ")
    assert damage.endswith("(b.csv) (line 3)")
