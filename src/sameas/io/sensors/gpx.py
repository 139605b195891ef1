"""GPX: the track of own ship by her receiver or plotter, as positions of a vessel that carries sensors.

The points of tracks and routes that have a time are read, of whatever version of GPX; their names are not. Source: GPX
1.1, topografix.com.
"""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np

from sameas.errors import InputError
from sameas.io.sensors.format import OWN_SHIP, SensorFile, SensorFormat, instant
from sameas.tracks.platforms import OWN_POSITIONS
from sameas.tracks.reports import Damaged, Reports

_POINTS = ("trkpt", "rtept")


def read(file: SensorFile) -> list[Reports]:
    """The points with a time, in the order of their times.

    Raises InputError: no XML; no point with a time.
    """
    if b"<!DOCTYPE" in file.content or b"<!ENTITY" in file.content:
        raise InputError(f"{file.source}: has a document type, which GPX has not", "export the track anew")
    try:
        root = ElementTree.fromstring(file.content)
    except ElementTree.ParseError as error:
        raise InputError(f"{file.source}: is no GPX: {error}", "export the track anew") from error
    rows: list[tuple[float, float, float, int]] = []
    damaged: list[tuple[int, str]] = []
    points = [one for one in root.iter() if _name(one) in _POINTS]
    for number, point in enumerate(points, start=1):
        time_s = next((instant(one.text or "") for one in point if _name(one) == "time"), None)
        if time_s is None:
            damaged.append((number, "no time"))
            continue
        try:
            lat, lon = float(point.attrib["lat"]), float(point.attrib["lon"])
        except (KeyError, ValueError):
            damaged.append((number, "no position"))
            continue
        if abs(lat) <= 90.0 and abs(lon) <= 180.0:
            rows.append((time_s, lat, lon, number))
        else:
            damaged.append((number, "position outside the earth"))
    if not rows:
        raise InputError(
            f"{file.source}: no point of a track with a time among {len(points)}", "export a track, not waypoints"
        )
    time_s, lat, lon, line = np.array(sorted(rows)).T
    columns = {"time_s": time_s, "line": line.astype(np.int64), "lat_deg": lat, "lon_deg": lon}
    known = {"lat": lat, "lon": lon}
    own = {column: known.get(name, np.full(len(lat), np.nan)) for name, column in OWN_SHIP.items()}
    return [Reports.of(file.source, OWN_POSITIONS, columns | own, damaged=Damaged.of(damaged, "record"))]


def _name(element: ElementTree.Element) -> str:
    """The name of an element without its namespace."""
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


FORMAT = SensorFormat("gpx", "GPX: the track of own ship", read, lambda file: b"<gpx" in file.head[:4096])
