"""`match_picture`: the command's result from Python, from files and from tables in memory."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import numpy as np
import pytest

import sameas
from sameas.errors import InputError
from sameas.front import picture as front
from sameas.io import read_table
from sameas.io.sensors import ReadOptions, read_reports
from sameas.pages.map import map_page

START = 1_714_560_000.0


def harbour(seed: int = 4) -> tuple[dict, dict]:
    """Five vessels with AIS, a radar that reads 60 m too far; the sixth has no transponder."""
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(-6e3, 6e3, (6, 2)), rng.normal(0.0, 5.0, (6, 2))
    ais = {name: [] for name in ("time", "mmsi", "lat", "lon", "sog_kn", "cog_deg")}
    radar = {name: [] for name in ("time", "track_id", "range_m", "bearing_deg")}
    for t in np.arange(0.0, 90.0, 3.0):
        where = place + speed * t
        for k in range(6):
            radar["time"].append(START + t)
            radar["track_id"].append(str(k + 101))
            radar["range_m"].append(np.hypot(*where[k]) + 60.0 + 15.0 * rng.normal())
            radar["bearing_deg"].append(np.degrees(np.arctan2(*where[k])) % 360.0 + 0.2 * rng.normal())
            if k < 5 and t % 9 == 3 * (k % 3):
                ais["time"].append(START + t)
                ais["mmsi"].append(f"23500{k}111")
                ais["lat"].append(50.55 + where[k, 1] / 111_240.0)
                ais["lon"].append(-0.95 + where[k, 0] / 70_870.0)
                ais["sog_kn"].append(np.hypot(*speed[k]) / 0.5144)
                ais["cog_deg"].append(np.degrees(np.arctan2(*speed[k])) % 360.0)
    return ais, radar


@pytest.fixture(scope="module")
def toml(tmp_path_factory):
    path = tmp_path_factory.mktemp("picture") / "sensors.toml"
    path.write_text('[sources.radar]\nkind = "marine radar"\nsite = { lat_deg = 50.55, lon_deg = -0.95 }\n')
    return path


@pytest.fixture(scope="module")
def found(toml):
    ais, radar = harbour()
    return sameas.match_picture({"ais": ais, "radar": radar}, sensors=toml, every=15.0)


def test_a_radar_aboard_is_on_the_map_where_its_vessel_is_at_each_instant() -> None:
    """It had no place on the map of a yacht's files, and no range rings about it."""
    rng = np.random.default_rng(2)
    place, speed, ahead = rng.uniform(-3e3, 3e3, (5, 2)), rng.normal(0.0, 4.0, (5, 2)), np.array([4.0, 2.0])
    ais, radar = [], []
    for t in np.arange(0.0, 120.0, 3.0):
        own, there = ahead * t, place + speed * t
        arm = there - own + 10.0 * rng.normal(size=(5, 2))
        for k in range(5):
            radar.append((START + t, k + 1, np.hypot(*arm[k]), np.degrees(np.arctan2(*arm[k])) % 360.0, *own))
            ais.append((START + t, 235_000_111 + k, *there[k]))
    scale = np.array([1.0 / 70_870.0, 1.0 / 111_240.0])
    names = "time", "track_id", "range_m", "bearing_deg", "own_lon", "own_lat"
    radar = dict(zip(names, map(np.array, zip(*radar, strict=True)), strict=True))
    ais = dict(zip(("time", "mmsi", "lon", "lat"), map(np.array, zip(*ais, strict=True)), strict=True))
    for table, prefix in ((radar, "own_"), (ais, "")):
        table[f"{prefix}lon"] = -0.95 + table[f"{prefix}lon"] * scale[0]
        table[f"{prefix}lat"] = 50.55 + table[f"{prefix}lat"] * scale[1]
    found = sameas.match_picture({"ais": ais, "radar": radar}, every=30.0)
    sheet = found.sheet()
    sites = {one.name: one.sites_m for one in sheet.sensors}
    assert sites["ais"] is None and len(sites["radar"]) == len(sheet.instants_s)
    lat, lon = sheet.plane.to_geodetic(sites["radar"])
    age = sheet.instants_s - START
    assert np.abs(lat - 50.55 - 2.0 * age * scale[1]).max() < 20.0 * scale[1]
    assert np.abs(lon + 0.95 - 4.0 * age * scale[0]).max() < 20.0 * scale[0]
    assert '"sites": [[' in map_page(sheet) or '"sites":[[' in map_page(sheet)


def test_maps_of_many_positions_have_fewer_instants_and_say_so(found, tmp_path) -> None:
    picture, n = found.picture, len(found.picture.objects["object"])
    assert front.thinned(picture, n) is picture
    third = front.thinned(picture, n // 3 + 1)
    assert third.instants_s.tolist() == picture.instants_s[::-3][::-1].tolist()
    for columns, whole in ((third.objects, picture.objects), (third.records, picture.records)):
        rows = np.isin(whole["time_s"], third.instants_s)
        assert columns["object"].tolist() == whole["object"][rows].tolist() and rows.sum() < len(rows)
    last = {number: text for (_, number), text in sorted(picture.texts.items())}
    assert {number: text for (_, number), text in sorted(third.texts.items())} == last
    # An explanation is not shown before it is valid.
    assert all(
        third.instants_s[at] >= picture.instants_s[min(k for k, one in picture.texts if one == number)]
        for at, number in third.texts
    )
    outputs = front.PictureOutputs(tmp_path, image=False, most_positions=n // 3 + 1)
    with pytest.warns(UserWarning, match=r"objects.geojson and map.html: \d of the \d instants.*objects.parquet and"):
        front.write(found, tmp_path, outputs)
    features = json.loads((tmp_path / "objects.geojson").read_text("utf-8"))["features"]
    points = [one["properties"]["time_s"] for one in features if "time_s" in one["properties"]]
    assert points == third.objects["time_s"].tolist()
    assert len(read_table(tmp_path / "objects.parquet")) == n


@pytest.mark.slow
def test_tables_in_memory_and_files_give_the_same_picture(found, toml, tmp_path) -> None:
    pd = pytest.importorskip("pandas")
    ais, radar = harbour()
    pd.DataFrame(ais).to_csv(tmp_path / "ais.csv", index=False)
    pd.DataFrame(radar).to_csv(tmp_path / "radar.csv", index=False)
    files = sameas.match_picture([tmp_path / "ais.csv", tmp_path / "radar.csv"], sensors=toml, every=15.0)
    stamped = pd.DataFrame(ais)
    stamped["time"] = pd.to_datetime(stamped["time"], unit="s")
    mixed = sameas.match_picture({"ais": stamped, "radar": tmp_path / "radar.csv"}, sensors=toml, every=15.0)
    for other in (files, mixed):
        for name in ("object", "members", "stage"):
            assert other.objects[name].tolist() == found.objects[name].tolist()
        np.testing.assert_allclose(other.objects["x_m"].filled(0), found.objects["x_m"].filled(0), atol=1e-3)


def test_the_result_has_the_methods_of_other_results(found, tmp_path) -> None:
    assert len(found) == len(found.picture.instants_s) == 6
    assert {"object", "members", "probability"} <= set(found.table.colnames)
    assert {"source", "row", "object", "p_object"} <= set(found.pairs.colnames)
    both = found.objects[found.objects["n_sources"] == 2]
    number = int(both["object"][-1])
    assert "radar" in str(found.explain(number)) and str(both["mmsi"][-1]) in str(found.explain(number))
    assert str(found.explain("101", source="radar")) != str(found.explain(number, at=START + 30.0))
    for words in ("Sources", "Picture: 6 instants", "offset", "assumed"):
        assert words in found.report()
    assert len(repr(found).splitlines()) <= 10 and "confirmed object" in repr(found)
    found.write(tmp_path / "out", format="csv", image=False)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names - {f"{name}.csv.provenance.json" for name in ("objects", "identities")} == {
        "objects.csv", "identities.csv", "objects.geojson", "summary.json", "explanations.json", "map.html"
    }  # fmt: skip
    clock = f"{datetime.fromtimestamp(START + 30.0, UTC):%H:%M:%S}"
    assert str(sameas.explain(tmp_path / "out", number, at=clock)) == str(
        sameas.explain(tmp_path / "out", number, at=START + 30.0)
    )
    again = tmp_path / "again" / "out"
    again.parent.mkdir()
    found.write(again, format="csv", image=False)
    assert str(sameas.compare(tmp_path / "out", again)).splitlines()[0] == f"{tmp_path / 'out'} against {again}"
    found.write(again, image=False, map=False, asterix=True)
    [tracks] = read_reports(again / "objects.ast", ReadOptions(start=START, source="picture"))
    confirmed = found.objects[np.isin(found.objects["stage"], ["confirmed", "coasting"])]
    assert (tracks.kind, len(tracks)) == ("asterix 062", len(confirmed))
    assert tracks.track_id.tolist() == [str(number) for number in confirmed["object"]]
    np.testing.assert_allclose(tracks.time_s, confirmed["time_s"], atol=0.01)
    np.testing.assert_allclose(tracks.lat_deg, confirmed["lat_deg"], atol=6e-6)
    np.testing.assert_allclose(tracks.covariance_m2[:, 0], confirmed["var_x_m2"], rtol=0.2)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["command"].startswith("sameas.match_picture(dict, dict, sensors=") and summary["files"] == []


def test_an_excluded_sensor_and_a_single_instant(toml) -> None:
    ais, radar = harbour()
    sources = {"ais": ais, "radar": radar}
    alone = sameas.match_picture(sources, sensors=toml, at=START + 60.0, without="ais")
    assert len(alone) == 1 and set(alone.pairs["source"].tolist()) == {"radar"}
    with pytest.raises(InputError, match=r"without=sonar: there is no such source; give one of ais, radar"):
        sameas.match_picture(sources, sensors=toml, without=["sonar"])
    with pytest.raises(InputError, match=r"at=noon: give a time such as"):
        sameas.match_picture(sources, sensors=toml, at="noon")
    with pytest.raises(InputError, match="give at, or every with begin and end, not both"):
        sameas.match_picture(sources, sensors=toml, at=START, every=3.0)
    # It was a TypeError, though the command takes it.
    words = sameas.match_picture(sources, sensors=toml, every="0.5min")
    assert (
        words.pairs["time_s"].tolist()
        == sameas.match_picture(sources, sensors=toml, every=30.0).pairs["time_s"].tolist()
    )
    with pytest.raises(InputError, match=r"every=soon is not a duration; give seconds, or 10s, 2min or 1h"):
        sameas.match_picture(sources, sensors=toml, every="soon")
    for series in ({"begin": 0}, {"end": 0.0}, {"every": 0.0}):
        with pytest.raises(InputError, match="give at, or every with begin and end, not both"):
            sameas.match_picture(sources, sensors=toml, at=START, **series)
    with pytest.raises(InputError, match=r"\(begin=0\) to .* \(end=-5\): it ends before it begins"):
        sameas.match_picture(sources, sensors=toml, begin=0, end=-5)
    with pytest.raises(InputError, match=r"give at, or begin and end, within that span"):
        sameas.match_picture(sources, sensors=toml, at=START + 1e6)
    with pytest.raises(InputError, match="radar is described, but no file belongs to it"):
        sameas.match_picture({"ais": ais}, sensors=toml)


def test_tables_in_memory_of_a_vessel_that_carries_a_sensor_need_no_kind(tmp_path):
    """Files needed none; the same in memory was refused."""
    ais, radar = harbour()
    times = np.arange(START, START + 90.0)
    gps = {"time": times, "lat": np.full(90, 50.55), "lon": np.full(90, -0.95)}
    toml = tmp_path / "sensors.toml"
    toml.write_text('[sources.radar]\nkind = "marine radar"\nplatform = { source = "gps" }\n')
    picture = sameas.match_picture({"ais": ais, "radar": radar, "gps": gps}, sensors=toml, every=30.0)
    assert len(picture.objects) > 0
