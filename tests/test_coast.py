"""A user's coastline: GeoJSON in, land and shores in metres out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.maps.geojson import read_coast
from sameas.tracks.coordinates import LocalPlane

PLANE = LocalPlane(50.8, -1.3)


def written(tmp_path: Path, value: Any) -> Path:
    path = tmp_path / "coast.geojson"
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    return path


def square(west: float, south: float, size: float, clockwise: bool = False) -> list[list[float]]:
    ring = [[west, south], [west + size, south], [west + size, south + size], [west, south + size], [west, south]]
    return ring[::-1] if clockwise else ring


def area(ring: np.ndarray) -> float:
    x, y = ring.T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


@pytest.mark.parametrize("clockwise", [False, True])
def test_land_runs_anticlockwise_and_its_lakes_clockwise_however_they_are_written(tmp_path, clockwise):
    polygon = {
        "type": "Polygon",
        "coordinates": [square(-1.4, 50.7, 0.1, clockwise), square(-1.37, 50.73, 0.02, clockwise)],
    }
    island, lake = (
        read_coast(written(tmp_path, {"type": "Feature", "properties": {}, "geometry": polygon})).in_plane(PLANE).land
    )
    metre_north, metre_east = 111_250.0, 111_300.0 * np.cos(np.radians(50.75))
    assert area(island) == pytest.approx(0.1 * metre_north * 0.1 * metre_east, rel=0.01)
    assert area(lake) == pytest.approx(-0.02 * metre_north * 0.02 * metre_east, rel=0.01)


def test_lines_are_shores_and_other_features_are_ignored(tmp_path):
    collection = {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "geometry": {"type": "LineString", "coordinates": [[-1.3, 50.8, 4.0], [-1.2, 50.8, 4.0]]},
            },
            {"type": "Feature", "geometry": None},
            {"type": "Feature", "geometry": {"type": "Point", "coordinates": [0, 0]}},
            {"type": "Feature", "geometry": {"type": "LineString", "coordinates": [[120, -50], [121, -50]]}},
        ],
    }
    ground = read_coast(written(tmp_path, collection)).in_plane(PLANE)
    assert ground.land == () and len(ground.coast) == 1
    assert ground.coast[0][0] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert ground.coast[0][1, 0] == pytest.approx(7045.0, abs=10.0)


def test_parts_outside_the_map_are_clipped(tmp_path):
    ground = read_coast(written(tmp_path, {"type": "Polygon", "coordinates": [square(-2.0, 50.0, 2.0)]}))
    ground = ground.in_plane(PLANE)
    [land] = ground.within(-1000.0, -1000.0, 1000.0, 1000.0).land
    assert area(land) == pytest.approx(4e6)
    assert ground.within(-1000.0, -1000.0, 1000.0, 1000.0).coast == ()


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("{", "is not GeoJSON"),
        ("[1, 2]", "is not GeoJSON"),
        ({"type": "FeatureCollection", "features": []}, "no polygon and no line"),
        ({"type": "LineString", "coordinates": [[1, "x"], [2, 3]]}, "feature 0: coordinates that are not pairs"),
        ({"type": "LineString", "coordinates": [[1, 200], [2, 300]]}, "feature 0: .* longitudes and latitudes"),
        ({"type": "Polygon", "coordinates": None}, "feature 0: coordinates that are not lists of places"),
        ({"type": "MultiPolygon", "coordinates": [None]}, "feature 0: coordinates that are not lists of places"),
        ({"type": "MultiLineString", "coordinates": 5}, "feature 0: coordinates that are not lists of places"),
        ({"type": "LineString", "coordinates": None}, "feature 0: coordinates that are not pairs"),
        ({"type": "GeometryCollection", "geometries": None}, "no polygon and no line"),
    ],
)
def test_invalid_coast_files_are_refused_by_name(tmp_path, value, words):
    with pytest.raises(InputError, match=words) as error:
        read_coast(written(tmp_path, value))
    assert "coast.geojson" in str(error.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"none\.geojson: cannot be read"):
        read_coast(tmp_path / "none.geojson")


def test_tiles_are_refused_with_what_to_give_instead(tmp_path):
    path = tmp_path / "harbour.pmtiles"
    path.write_bytes(b"PMTiles\x03")
    with pytest.raises(InputError, match="only sameas watch draws tiles; give land or shores as GeoJSON"):
        read_coast(path)
