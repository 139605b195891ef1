"""The sheet: the content of a map of a picture, as columns and texts.

>>> import numpy as np
>>> objects = {"time_s": [0.0, 10.0], "object": [1, 1], "stage": ["tentative", "confirmed"],
...            "x_m": [0.0, 50.0], "y_m": [0.0, 0.0]}
>>> sheet = MapSheet.of("Harbour", objects, {})
>>> sheet.instants_s.tolist(), sheet.utc
([0.0, 10.0], False)
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.maps.outline import Outline
from sameas.picture.tables import STAGES
from sameas.report.prose import UTC_FROM_S
from sameas.representation import in_short
from sameas.tracks.coordinates import LocalPlane, bearing_in_plane
from sameas.tracks.feed import Feed
from sameas.tracks.source import Description

Columns = Mapping[str, NDArray[Any]]


#: Columns of the objects, and the value where a column is absent; None: it is required.
OBJECTS: Mapping[str, Any] = {
    "time_s": None, "object": None, "stage": None, "x_m": None, "y_m": None,
    "lat_deg": np.nan, "lon_deg": np.nan, "vx_m_per_s": np.nan, "vy_m_per_s": np.nan, "speed_m_per_s": np.nan,
    "course_deg": np.nan, "height_m": np.nan, "sigma_height_m": np.nan, "climb_m_per_s": np.nan,
    "var_x_m2": np.nan, "cov_xy_m2": np.nan, "var_y_m2": np.nan, "n_sources": 0,
    "probability": np.nan, "runner_up": "", "p_runner_up": np.nan, "label": "", "mmsi": "", "icao": "", "callsign": "",
    "name": "", "mode_a": "", "type": "", "ambiguous": False,
}  # fmt: skip
RECORDS: Mapping[str, Any] = {
    "time_s": None, "source": None, "row": None, "object": None,
    "line": -1, "track_id": "", "p_object": np.nan, "p_alone": np.nan, "age_s": np.nan, "x_m": np.nan, "y_m": np.nan,
    "var_x_m2": np.nan, "cov_xy_m2": np.nan, "var_y_m2": np.nan, "bearing_deg": np.nan, "sigma_bearing_deg": np.nan,
    "sensor_x_m": np.nan, "sensor_y_m": np.nan,
}  # fmt: skip


@dataclass(frozen=True)
class MapSensor:
    """A source on the map, and its coverage.

    x_m, y_m : its site in the plane; None where it has none. visible_deg : visible bearings in the plane (from, to),
    clockwise; a whole turn is (0, 360). file : of its reports. sites_m : (t, 2) its site at every instant, of a sensor
    that moves; NaN where it is unknown.
    """

    name: str
    kind: str = ""
    file: str = ""
    x_m: float | None = None
    y_m: float | None = None
    range_m: float | None = None
    nearest_m: float = 0.0
    visible_deg: tuple[tuple[float, float], ...] = ((0.0, 360.0),)
    sites_m: FloatArray | None = field(default=None, repr=False, compare=False)

    @classmethod
    def of(cls, description: Description, plane: LocalPlane | None, file: str = "") -> MapSensor:
        """The sensor of a source's description; ``plane`` None: the user's own plane."""
        coverage = description.coverage
        visible = _visible(coverage.sector_deg, coverage.shadows_deg)
        if description.site is None:
            return cls(
                description.name, description.kind, file, None, None, coverage.range_m, coverage.nearest_m, visible
            )
        site = description.site
        if plane is not None and site.lat_deg is not None and site.lon_deg is not None:
            turn = float(bearing_in_plane(plane, [0.0], [site.lat_deg], [site.lon_deg])[0])
            visible = tuple((start + turn, stop + turn) for start, stop in visible)
        x, y = site.in_plane(plane)
        return cls(description.name, description.kind, file, x, y, coverage.range_m, coverage.nearest_m, visible)

    def aboard(self, feed: Feed, instants_s: FloatArray) -> MapSensor:
        """The sensor with its sites at instants (t,), if its feed's description has no site but its reports have."""
        if feed.description.site is not None:
            return self
        sites = [feed.sensor_at(float(instant_s)) for instant_s in instants_s]
        return self if not sites or sites[0] is None else replace(self, sites_m=np.array(sites, np.float64))


def _visible(
    sector: tuple[float, float] | None, shadows: Sequence[tuple[float, float]]
) -> tuple[tuple[float, float], ...]:
    """Visible bearings (from, to) of a sector minus its shadows; from is at least 0, to at most 360° more."""
    start = 0.0 if sector is None else sector[0] % 360.0
    width = 360.0 if sector is None else (sector[1] - sector[0]) % 360.0 or 360.0
    visible = [(start, start + width)]
    for shadow in shadows:
        low = shadow[0] % 360.0
        long = (shadow[1] - shadow[0]) % 360.0 or 360.0
        for turn in (-360.0, 0.0, 360.0):
            dark = (low + turn, low + turn + long)
            visible = [
                part
                for a, b in visible
                for part in ((a, min(b, dark[0])), (max(a, dark[1]), b))
                if part[1] - part[0] > 0
            ]
    return tuple(visible)


@dataclass(frozen=True)
class MapAlarm:
    """An alarm. time_s : its time, None: active at all times. objects : numbers of its objects."""

    text: str
    time_s: float | None = None
    objects: tuple[int, ...] = ()


@in_short
@dataclass(frozen=True)
class MapSheet:
    """The content of a map. Make it with :meth:`MapSheet.of`, which checks it.

    title : of the map.
    objects : columns of :data:`OBJECTS`, one row per object and instant, in the order of objects and times.
    records : columns of :data:`RECORDS`, one row per record and instant, in the order of sources, rows and times.
    instants_s : (k,) ascending times of the picture, empty ones included.
    sensors : all sources of the records, in the order of their colours.
    plane : of x and y; None for the user's own plane, which has no coast.
    summary : lines printed next to the map.
    texts : explanations by (index in ``instants_s``, number of the object); each is valid until the object's next one.
    ground : coasts given by the user, in the plane; None: those of :func:`sameas.maps.outline`. overlays : further
        lines given by the user.
    """

    title: str
    objects: Columns
    records: Columns
    instants_s: FloatArray
    sensors: tuple[MapSensor, ...] = ()
    plane: LocalPlane | None = None
    summary: tuple[str, ...] = ()
    alarms: tuple[MapAlarm, ...] = ()
    texts: Mapping[tuple[int, int], str] = field(default_factory=dict)
    ground: Outline | None = None
    overlays: tuple[Outline, ...] = ()

    @classmethod
    def of(
        cls,
        title: str,
        objects: Mapping[str, Any],
        records: Mapping[str, Any],
        *,
        instants_s: ArrayLike | None = None,
        sensors: Sequence[MapSensor] = (),
        plane: LocalPlane | None = None,
        summary: Sequence[str] = (),
        alarms: Sequence[MapAlarm] = (),
        texts: Mapping[tuple[int, int], str] | None = None,
        ground: Outline | None = None,
        overlays: Sequence[Outline] = (),
    ) -> MapSheet:
        """A checked and sorted sheet; unknown columns are ignored.

        instants_s : None: the times of the objects and records. sensors : sources of records that are not among them
        are added.

        Raises InputError: a column is missing or has another length; an unknown stage; a time that is no instant.
        """
        rows, marks = _complete("objects", objects, OBJECTS), _complete("records", records, RECORDS)
        wrong = sorted(set(rows["stage"].tolist()) - set(STAGES))
        if wrong:
            raise InputError(f"objects: stage is {wrong[0]!r}; give one of {', '.join(STAGES)}")
        times = np.unique(np.concatenate([rows["time_s"], marks["time_s"]]).astype(np.float64))
        if instants_s is not None:
            given_times = np.unique(np.asarray(instants_s, dtype=np.float64))
            unknown_times = np.setdiff1d(times, given_times)
            if len(unknown_times):
                raise InputError(
                    f"map: {len(unknown_times)} times are not among the instants (first: {unknown_times[0]:g} s)"
                )
            times = given_times
        if not len(times):
            raise InputError("map: there is no instant to show; give objects, records or instants_s")
        names = {sensor.name for sensor in sensors}
        added = [MapSensor(str(name)) for name in dict.fromkeys(marks["source"].tolist()) if name not in names]
        by_object = np.lexsort((rows["time_s"], rows["object"]))
        by_source = np.lexsort((marks["time_s"], marks["row"], marks["source"].astype(str)))
        return cls(
            title=title, objects={name: rows.pop(name)[by_object] for name in list(rows)},
            records={name: marks.pop(name)[by_source] for name in list(marks)}, instants_s=times,
            sensors=(*sensors, *added), plane=plane, summary=tuple(summary), alarms=tuple(alarms),
            texts=dict(texts or {}), ground=ground, overlays=tuple(overlays),
        )  # fmt: skip

    @property
    def utc(self) -> bool:
        """Whether times are seconds since 1970 UTC; otherwise they are seconds from an unknown origin."""
        return bool(self.instants_s[0] >= UTC_FROM_S)

    def nearest(self, time_s: float) -> int:
        """Index of the instant nearest to a time."""
        return int(np.argmin(np.abs(self.instants_s - time_s)))

    def instant_of(self, columns: Columns) -> IntArray:
        """(n,) index in ``instants_s`` of each row of objects or records."""
        return np.searchsorted(self.instants_s, columns["time_s"].astype(np.float64))

    def extent(self) -> tuple[float, float, float, float]:
        """West, south, east and north of all objects and records, in metres."""
        places = [np.column_stack([c["x_m"], c["y_m"]]) for c in (self.objects, self.records)]
        return _bounds(np.concatenate([*places, self._sites()]))

    def home(self) -> tuple[float, float, float, float]:
        """West, south, east and north of the first view: sites and confirmed objects; the extent if there are none."""
        confirmed = self.objects["stage"] == "confirmed"
        if not confirmed.any():
            return self.extent()
        places = np.column_stack([self.objects["x_m"][confirmed], self.objects["y_m"][confirmed]])
        return _bounds(np.concatenate([places, self._sites()]))

    def _sites(self) -> FloatArray:
        fixed = [(s.x_m, s.y_m) for s in self.sensors if s.x_m is not None and s.y_m is not None]
        moving = [s.sites_m[np.isfinite(s.sites_m[:, 0])] for s in self.sensors if s.sites_m is not None]
        return np.concatenate([np.array(fixed, np.float64).reshape(-1, 2), *moving])


def ellipse_axes(columns: Columns) -> tuple[FloatArray, FloatArray, FloatArray]:
    """1σ along and across the major axis, metres, and the angle of that axis from east to north, degrees.

    columns : with var_x_m2, cov_xy_m2 and var_y_m2 (n,), masked or NaN where there is no position. Results are NaN
    there and for ellipses with σ ≥ 2000 km, which are not drawn.
    """
    names = ("var_x_m2", "cov_xy_m2", "var_y_m2")
    a, b, c = (np.ma.filled(np.ma.asarray(columns[name], np.float64), np.nan) for name in names)
    half, spread = (a + c) / 2.0, np.hypot((a - c) / 2.0, b)
    with np.errstate(invalid="ignore"):
        major, minor = np.sqrt(half + spread), np.sqrt(np.maximum(half - spread, 0.0))
    angle = np.degrees(np.arctan2(b, (a - c) / 2.0)) / 2.0
    huge = ~(major < 2e6)
    return np.where(huge, np.nan, major), np.where(huge, np.nan, minor), np.where(huge, np.nan, angle)


def seen_by_several(objects: Columns) -> BoolArray:
    """(n,) mask of objects reported by two or more sources with a probability of at least 0.5, or not known."""
    improbable = objects["probability"].astype(np.float64) < 0.5
    return np.asarray((objects["n_sources"] > 1) & ~improbable, np.bool_)


def _bounds(places: FloatArray) -> tuple[float, float, float, float]:
    """West, south, east and north of positions, at least 100 m wide and high."""
    finite = places[np.isfinite(places).all(axis=1)]
    if not len(finite):
        finite = np.zeros((1, 2))
    low, high = finite.min(axis=0), finite.max(axis=0)
    pad = np.maximum(50.0 - (high - low) / 2.0, 0.0)
    west, south = low - pad
    east, north = high + pad
    return float(west), float(south), float(east), float(north)


def _complete(what: str, columns_in: Mapping[str, Any], required: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """All required columns: absent numbers are NaN, absent texts ""; an empty mapping is an empty table."""
    lengths = {name: len(columns_in[name]) for name in columns_in if name in required}
    if len(set(lengths.values())) > 1:
        name = next(name for name in lengths if lengths[name] != next(iter(lengths.values())))
        first = next(iter(lengths))
        raise InputError(f"{what}: column {name} has {lengths[name]} rows, {first} has {lengths[first]}")
    n = next(iter(lengths.values()), 0)
    missing = [name for name, default in required.items() if default is None and name not in columns_in]
    if missing and lengths:
        raise InputError(f"{what}: there is no column {missing[0]}; give {', '.join(missing)}")
    columns = {}
    for name, default in required.items():
        if name not in columns_in or not lengths:
            columns[name] = np.full(n, "" if default is None else default, object if default == "" else None)
        elif isinstance(default, str) or name in ("stage", "source"):
            columns[name] = _texts(columns_in[name])
        else:
            columns[name] = _numbers(f"{what}: column {name}", columns_in[name], default)
    if n == 0:
        columns |= {name: np.empty(0) for name, default in required.items() if default is None}
    return columns


def _texts(column: Any) -> NDArray[Any]:
    """(n,) str; "" where masked or missing."""
    hidden = np.ma.getmaskarray(np.ma.asarray(column))
    values = np.ma.getdata(np.ma.asarray(column)).tolist()
    texts = ["" if off or v is None or v != v else str(v) for v, off in zip(values, hidden, strict=True)]
    # Equal texts of a column are one object: they are names of sources and ships.
    shared = {text: text for text in texts}
    return np.array([shared[text] for text in texts], dtype=object)


def _numbers(what: str, column: Any, default: Any) -> NDArray[Any]:
    """(n,) numbers; NaN or the default where masked."""
    values = np.ma.asarray(column)
    if values.dtype.kind not in "iufb":
        raise InputError(f"{what} is of type {values.dtype}; give numbers")
    if values.dtype.kind == "f" or isinstance(default, float):
        return np.asarray(np.ma.filled(values.astype(np.float64), np.nan))
    if default is None and np.ma.is_masked(values):
        raise InputError(f"{what} is masked in row {np.flatnonzero(np.ma.getmaskarray(values))[0]}; give a number")
    return np.asarray(np.ma.getdata(values) if default is None else np.ma.filled(values, default))


def members_of(text: str) -> list[tuple[str, int]]:
    """(source, row) of each member in a list as written in tables.

    >>> members_of("radar:12 north ais:3")
    [('radar', 12), ('north ais', 3)]
    """
    return [(source, int(row)) for source, row in re.findall(r"\s*(.+?):(\d+)(?=\s|$)", text)]
