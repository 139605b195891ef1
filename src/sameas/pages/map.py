"""The page of a picture over time: a chart with a time slider, objects, records and the reasons.

One file without network access; it opens from disk in Chromium, Firefox and Safari of 2023 and later.
"""

from __future__ import annotations

import base64
import gzip
import json
import os
from collections.abc import Iterable, Mapping
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.io.atomic import replacing
from sameas.maps.outline import Outline, outline
from sameas.maps.sheet import Columns, MapSheet, ellipse_axes, members_of
from sameas.pages import POLICY, SERVED_POLICY, asset, page_of, script_safe
from sameas.picture.tables import STAGES
from sameas.picture.texts import LABELS

# Packed columns of numbers, small in the file and unpacked by a few lines of script (map-table.js).
#
# A column is rounded to a step. Each number is stored as its difference from the previous one, with the sign in the
# lowest bit (zigzag), in as many bytes as the largest difference needs. All lowest bytes come first, then the next
# ones: most bytes of slowly changing columns are then 0, which DEFLATE compresses well. Browsers can read gzip.


def packed(columns: Mapping[str, tuple[NDArray[Any], float]]) -> tuple[list[dict[str, Any]], str]:
    """The description of each column, in order, and all their numbers as text.

    columns : name to (values (n,), step); NaN where there is no number.

    Returns
    -------
    (heads, text) : per column its name, step, length, bytes per number, and whether a presence byte per number follows
        (``holes``); base64 of gzip of the bytes.

    >>> heads, text = packed({"x_m": (np.array([1.0, 2.5]), 0.5)})
    >>> heads
    [{'name': 'x_m', 'step': 0.5, 'n': 2, 'bytes': 1, 'holes': False}]
    """
    heads, parts = [], []
    for name, (values, step) in columns.items():
        head, body = _column(name, np.asarray(values, np.float64), step)
        heads.append(head)
        parts.append(body)
    return heads, squeezed(b"".join(parts))


def squeezed(data: bytes) -> str:
    """base64 of gzip, without a time stamp: equal data give equal text."""
    return base64.b64encode(gzip.compress(data, 6, mtime=0)).decode("ascii")


def _column(name: str, values: FloatArray, step: float) -> tuple[dict[str, Any], bytes]:
    present = np.isfinite(values)
    if np.any(np.abs(values[present]) / step >= 2**31):
        raise InputError(f"map: column {name} holds {np.abs(values[present]).max():g}, too large to show")
    counts = np.rint(np.where(present, values, 0.0) / step).astype(np.int64)
    # An absent number repeats the previous one: its difference is 0.
    last = np.maximum.accumulate(np.where(present, np.arange(len(values)), 0)) if len(values) else np.empty(0, np.int64)
    difference = np.diff(counts[last], prepend=0)
    zigzag = (difference << 1) ^ (difference >> 63)
    width = next(w for w in (1, 2, 4, 8) if not len(zigzag) or int(zigzag.max()) < 1 << (8 * w))
    planes = [((zigzag >> (8 * k)) & 255).astype(np.uint8).tobytes() for k in range(width)]
    holes = not bool(present.all())
    head = {"name": name, "step": step, "n": len(values), "bytes": width, "holes": holes}
    return head, b"".join([*planes, present.astype(np.uint8).tobytes() if holes else b""])


#: The scripts of the page, each after those it uses; further ones of a live page.
SCRIPTS = ("table", "words", "earth", "marks", "labels", "chart", "ground", "panel", "listing", "hands")
LIVE_SCRIPTS = ("tiles", "history", "live")
#: Size of the chart relative to the extent of the data, and its least half width in metres.
ROOM, MIN_M = 4.0, 20e3
#: Step of stored probabilities.
PROBABILITY_STEP = 1e-5


def write_map_page(sheet: MapSheet, path: str | os.PathLike[str]) -> None:
    """Writes the page of a sheet: one file, complete in itself.

    Raises InputError: the path cannot be written; a number is too large to show.
    """
    page = map_page(sheet)
    with replacing(path) as draft:
        draft.write_text(page, encoding="utf-8")


def map_page(sheet: MapSheet, live: Mapping[str, Any] | None = None) -> str:
    """The page of a sheet as text.

    live : settings for ``map-live.js`` of a served page that is updated, and of its ``charts``; None for a file.
    """
    objects, strings = _objects(sheet)
    records, tracks = _records(sheet)
    heads, columns = packed({f"o.{k}": v for k, v in objects.items()} | {f"r.{k}": v for k, v in records.items()})
    settings = _settings(sheet) | {"columns": heads, "strings": strings | tracks, "live": live}
    marks = {
        "css": asset("map.css"),
        "js": "\n".join(asset(f"map-{name}.js") for name in (SCRIPTS if live is None else SCRIPTS + LIVE_SCRIPTS)),
        "data": script_safe(settings),
        "columns": columns,
        "texts": script_safe(_texts(sheet)),
    }
    return page_of("map.html", sheet.title, "map", marks, POLICY if live is None else SERVED_POLICY)


def _settings(sheet: MapSheet) -> dict[str, Any]:
    """The data of the page other than columns and explanations."""
    plane = sheet.plane
    return {
        "title": sheet.title,
        "utc": sheet.utc,
        "instants": np.round(sheet.instants_s, 3).tolist(),
        "origin": None if plane is None else [plane.lat_deg, plane.lon_deg],
        "extent": [round(v, 2) for v in sheet.home()],
        "stages": list(STAGES),
        "sensors": [
            {
                "name": s.name, "kind": s.kind, "file": s.file,
                "site": _place(s.x_m, s.y_m),
                "range": s.range_m, "nearest": s.nearest_m, "visible": [list(part) for part in s.visible_deg],
                "sites": None if s.sites_m is None else [_place(*site) for site in s.sites_m],
            }
            for s in sheet.sensors
        ],
        "summary": list(sheet.summary),
        "credit": "" if sheet.plane is None or sheet.ground else "coast: Natural Earth, ± 1 km, not for navigation",
        "alarms": [{"text": a.text, "time": a.time_s, "objects": list(a.objects)} for a in sheet.alarms],
        **_ground(sheet),
    }  # fmt: skip


def _place(x_m: float | None, y_m: float | None) -> list[float] | None:
    """[x, y] to a centimetre; None for unknown ones."""
    if x_m is None or y_m is None or not np.isfinite(x_m):
        return None
    return [round(float(x_m), 2), round(float(y_m), 2)]


def _ground(sheet: MapSheet) -> dict[str, Any]:
    """The box of the plane that can be viewed, and the coasts and borders in it."""
    west, south, east, north = sheet.extent()
    half = max(ROOM * max(east - west, north - south) / 2.0, MIN_M if sheet.plane is not None else 0.0)
    x, y = (west + east) / 2.0, (south + north) / 2.0
    box = (x - half, y - half, x + half, y + half)
    if sheet.ground is not None:
        lines = sheet.ground.within(*box)
    else:
        lines = Outline() if sheet.plane is None else outline(sheet.plane, *box)
    return {
        "box": [round(v) for v in box],
        "land": _points(lines.land),
        "coast": _points(lines.coast),
        "borders": _points(lines.borders),
        "overlays": [
            {"land": _points(own.land), "coast": _points(own.coast)}
            for own in (overlay.within(*box) for overlay in sheet.overlays)
        ],
    }


def _points(lines: Iterable[FloatArray]) -> list[list[int]]:
    """Each line as [x, y, x, y, …] in whole metres."""
    return [np.rint(line).astype(np.int64).ravel().tolist() for line in lines]


def _texts(sheet: MapSheet) -> dict[str, str]:
    """Per object all its explanations by index of the instant, compressed together: they differ little."""
    texts_of: dict[int, dict[int, str]] = {}
    for (instant, number), text in sorted(sheet.texts.items()):
        texts_of.setdefault(number, {})[instant] = text
    return {str(n): squeezed(json.dumps(texts, ensure_ascii=False).encode()) for n, texts in texts_of.items()}


def _objects(sheet: MapSheet) -> tuple[dict[str, tuple[NDArray[Any], float]], dict[str, list[str]]]:
    """Columns of the objects with their steps, and the lists of texts that coded columns refer to."""
    o, step = sheet.objects, _step(sheet)
    numbers, strings = _coded(o, LABELS, "o")
    stage = np.array([STAGES.index(name) for name in o["stage"].tolist()], np.float64)
    first, rows = _runners_up(sheet)
    return {
        "t": (sheet.instant_of(o), 1), "n": (o["object"], 1), "stage": (stage, 1),
        "x": (o["x_m"], step), "y": (o["y_m"], step), "vx": (o["vx_m_per_s"], 0.01), "vy": (o["vy_m_per_s"], 0.01),
        "speed": (o["speed_m_per_s"], 0.01), "course": (o["course_deg"], 0.1), **_ellipses(o, step),
        "height": (o["height_m"], 1.0), "sh": (o["sigma_height_m"], 1.0), "climb": (o["climb_m_per_s"], 0.1),
        "sources": (o["n_sources"], 1), "p": (o["probability"], PROBABILITY_STEP), "ambiguous": (o["ambiguous"], 1),
        "rival": (o["p_runner_up"], PROBABILITY_STEP), "rivals": (first, 1), "rivalRows": (rows, 1), **numbers,
    }, strings  # fmt: skip


def _records(sheet: MapSheet) -> tuple[dict[str, tuple[NDArray[Any], float]], dict[str, list[str]]]:
    r, step = sheet.records, _step(sheet)
    places = {sensor.name: k for k, sensor in enumerate(sheet.sensors)}
    source = np.array([places[name] for name in r["source"].tolist()], np.float64)
    numbers, strings = _coded(r, ("track_id",), "r")
    return {
        "t": (sheet.instant_of(r), 1), "n": (r["object"], 1), "source": (source, 1), "row": (r["row"], 1),
        "line": (r["line"], 1), "x": (r["x_m"], step), "y": (r["y_m"], step), **_ellipses(r, step),
        "p": (r["p_object"], PROBABILITY_STEP), "alone": (r["p_alone"], PROBABILITY_STEP), "age": (r["age_s"], 0.1),
        "bearing": (r["bearing_deg"], 0.01), "sb": (r["sigma_bearing_deg"], 0.01),
        "sx": (r["sensor_x_m"], step), "sy": (r["sensor_y_m"], step), **numbers,
    }, strings  # fmt: skip


def _step(sheet: MapSheet) -> float:
    """Step of stored positions, metres: 0.01 within 20 km of the origin, else 0.1."""
    west, south, east, north = sheet.extent()
    return 0.01 if max(abs(west), abs(south), abs(east), abs(north)) < 20e3 else 0.1


def _ellipses(columns: Columns, step: float) -> dict[str, tuple[NDArray[Any], float]]:
    major, minor, angle = ellipse_axes(columns)
    return {"major": (major, step), "minor": (minor, step), "angle": (angle, 1.0)}


def _coded(
    columns: Columns, names: Iterable[str], table: str
) -> tuple[dict[str, tuple[NDArray[Any], float]], dict[str, list[str]]]:
    """Text columns as indices into the lists of their distinct texts."""
    numbers, strings = {}, {}
    for name in names:
        texts, index = np.unique(columns[name].astype(str), return_inverse=True)
        numbers[name], strings[f"{table}.{name}"] = (index, 1.0), texts.tolist()
    return numbers, strings


def _runners_up(sheet: MapSheet) -> tuple[IntArray, IntArray]:
    """The members of each object row's runner-up: offsets (n + 1,) into an array of rows of the records."""
    r, o = sheet.records, sheet.objects
    texts = zip(sheet.instant_of(o).tolist(), o["runner_up"].tolist(), strict=True)
    members = [[(t, *member) for member in members_of(text)] if text else () for t, text in texts]
    named = set(chain.from_iterable(members))
    keys = zip(sheet.instant_of(r).tolist(), r["source"].tolist(), map(int, r["row"].tolist()), strict=True)
    row_of = {key: k for k, key in enumerate(keys) if key in named}
    first, rows = [0], []
    for each in members:
        rows += [row_of[member] for member in each if member in row_of]
        first.append(len(rows))
    return np.array(first, np.int64), np.array(rows, np.int64)
