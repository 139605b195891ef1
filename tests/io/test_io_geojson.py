"""GeoJSON of a picture, as map programs expect it."""

import json

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.geojson import write_geojson

NOON_S = 1_700_000_000.25


def objects():
    hidden = np.array([False, False, True])
    return {
        "time_s": np.array([NOON_S, NOON_S, NOON_S]),
        "object": np.array([1, 2, 3]),
        "lat_deg": np.ma.MaskedArray([50.123456789, -10.0, 0.0], hidden),
        "lon_deg": np.ma.MaskedArray([-1.5, 179.9995, 0.0], hidden),
        "x_m": np.ma.MaskedArray([1234.56789012, 2.0, 0.0], hidden),
        "probability": np.array([0.999999, 0.5, np.nan]),
        "label": np.array(['Ålesund "7"', "", ""]),
        "ambiguous": np.array([False, True, False]),
    }


def test_objects_are_points_longitude_first(tmp_path):
    write_geojson(objects(), tmp_path / "o.geojson")
    whole = json.loads((tmp_path / "o.geojson").read_text(encoding="utf-8"))
    assert set(whole) == {"type", "features"} and whole["type"] == "FeatureCollection"
    first, second, third = whole["features"]
    assert first["geometry"] == {"type": "Point", "coordinates": [-1.5, 50.1234568]}
    assert first["properties"] == {
        "time": "2023-11-14T22:13:20.250000Z", "time_s": NOON_S, "object": 1, "x_m": 1234.56789,
        "probability": 0.999999, "label": 'Ålesund "7"', "ambiguous": False,
    }  # fmt: skip
    assert second["properties"]["label"] is None and second["properties"]["ambiguous"] is True
    assert (
        third["geometry"] is None and third["properties"]["probability"] is None and third["properties"]["x_m"] is None
    )


def test_seconds_from_an_arbitrary_start_have_no_date(tmp_path):
    mine = objects() | {"time_s": np.array([0.0, 10.0, 20.0])}
    write_geojson(mine, tmp_path / "o.geojson")
    assert "time" not in json.loads((tmp_path / "o.geojson").read_text())["features"][1]["properties"]


def test_a_picture_in_local_metres_is_refused_and_nothing_is_written(tmp_path):
    flat = {name: column for name, column in objects().items() if not name.endswith("_deg")}
    with pytest.raises(InputError, match="no lat_deg; GeoJSON needs latitudes and longitudes"):
        write_geojson(flat, tmp_path / "o.geojson")
    with pytest.raises(InputError, match="does not exist"):
        write_geojson(objects(), tmp_path / "no" / "o.geojson")
    assert not any(tmp_path.iterdir())


def test_an_object_has_a_track_in_the_order_of_time_cut_at_the_antimeridian(tmp_path):
    moving = {
        "time_s": np.array([NOON_S + 20, NOON_S, NOON_S + 10, NOON_S]),
        "object": np.array([4, 4, 4, 5]),
        "lat_deg": np.array([-10.0, -10.0, -10.0, 1.0]),
        "lon_deg": np.array([-179.5, 179.0, 179.5, 1.0]),
        "label": np.array(["PIKA", "", "PIKA", "ALONE"]),
    }
    write_geojson(moving, tmp_path / "o.geojson")
    *points, track = json.loads((tmp_path / "o.geojson").read_text())["features"]
    assert len(points) == 4
    assert track["properties"]["object"] == 4 and track["properties"]["label"] == "PIKA"
    assert track["properties"]["times_s"] == [NOON_S, NOON_S + 10, NOON_S + 20]
    west = [[179.0, -10.0], [179.5, -10.0], [180.0, -10.0]]
    assert track["geometry"] == {"type": "MultiLineString", "coordinates": [west, [[-180.0, -10.0], [-179.5, -10.0]]]}
