"""A situation: one tick of the picture as plain rows of objects and records, with the alarms.

Journal, outputs and web page are made from situations only; none of them accesses the picture itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.live.own_ship import OwnShipState
from sameas.maps.sheet import ellipse_axes
from sameas.picture.live import LiveState
from sameas.picture.picture import object_columns, record_columns, with_degrees
from sameas.picture.rows import Columns
from sameas.picture.tables import STAGES
from sameas.picture.texts import LABELS
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.heights import HeightModel
from sameas.tracks.kinds import KINDS
from sameas.tracks.source import Description

#: Columns of the rows that are sent to the web page: of an object, and of a record.
OBJECT = (
    "n", "stage", "x", "y", "vx", "vy", "speed", "course", "major", "minor", "angle", "sources", "p", "ambiguous",
    "rival", "height", "sh", "climb", *LABELS,
)  # fmt: skip
RECORD = ("n", "source", "row", "x", "y", "major", "minor", "angle", "p", "alone", "age", "bearing", "sb", "sx", "sy",
          "track_id")  # fmt: skip
#: An object at a greater height in metres is no ship.
FLYING_M = 150.0
#: Beginning of the MMSI of an aircraft of search and rescue (ITU-R M.585).
RESCUE = "111"


@dataclass(frozen=True)
class Alarm:
    """An alarm. key : its condition, the same as long as this lasts. objects : their numbers."""

    key: str
    kind: str
    text: str
    objects: tuple[int, ...] = ()

    @property
    def condition(self) -> str:
        """What is wrong, without where: the first word of the key, such as ``identity``, ``jumped``, ``cpa``."""
        return self.key.partition(" ")[0]


@dataclass(frozen=True)
class Situation:
    """The picture at one tick.

    tick : number of the tick since the state was created. time_s : time of the picture.
    objects, records : columns as of :mod:`sameas.picture.picture`. members : source and track of each record of an
        object, by the number of the object.
    cpa : distance (m) and time (s) of the closest approach to own ship, by the number of the object; closing objects
        only.
    heights : conversion of the objects' heights to heights above the ellipsoid. of_aircraft : the sources that show
        aircraft only.
    """

    tick: int
    time_s: float
    plane: LocalPlane | None
    objects: Columns = field(repr=False)
    records: Columns = field(repr=False)
    members: Mapping[int, tuple[tuple[str, str], ...]] = field(repr=False)
    alarms: tuple[Alarm, ...] = ()
    own_ship: OwnShipState | None = None
    heights: HeightModel | None = None
    of_aircraft: frozenset[str] = frozenset()

    @classmethod
    def of(
        cls,
        tick: int,
        state: LiveState,
        plane: LocalPlane | None,
        alarms: Sequence[Alarm] = (),
        own_ship: OwnShipState | None = None,
        heights: HeightModel | None = None,
    ) -> Situation:
        """The situation of a state."""
        objects, records = object_columns(state), record_columns(state)
        members: dict[int, list[tuple[str, str]]] = {}
        for number, source, track, row in zip(
            records["object"].tolist(), records["source"].tolist(), records["track_id"].tolist(),
            records["row"].tolist(), strict=True,
        ):  # fmt: skip
            members.setdefault(number, []).append((source, track or f"plot {row}"))
        return cls(
            tick, state.now.instant_s, plane, with_degrees(objects, plane), with_degrees(records, plane),
            {number: tuple(tracks) for number, tracks in members.items()}, tuple(alarms), own_ship,
            heights, _of_aircraft(state.now.descriptions),
        )  # fmt: skip

    @cached_property
    def flying(self) -> frozenset[int]:
        """The numbers of the aircraft: objects with an ICAO address or the MMSI of an aircraft of search and rescue,
        higher than :data:`FLYING_M`, or shown only by sources of aircraft."""
        objects, shown, source = self.objects, self.records["object"], self.records["source"]
        number = objects["object"]
        if not len(number):
            return frozenset()
        others = np.ones(len(shown), bool)
        for name in self.of_aircraft:
            others &= source != name
        flies = (objects["icao"] != "") | np.char.startswith(objects["mmsi"].astype(str), RESCUE)
        flies |= np.nan_to_num(self._heights[0]) > FLYING_M
        flies |= np.isin(number, shown) & ~np.isin(number, shown[others])
        return frozenset(number[flies].tolist())

    @cached_property
    def cpa(self) -> dict[int, tuple[float, float]]:
        """Distance (m) and time (s) of the closest approach to own ship, by number, where it is still ahead.

        Aircraft pass over ships and have none.
        """
        own, objects = self.own_ship, self.objects
        if own is None or not len(objects["object"]):
            return {}
        place = np.column_stack([np.ma.filled(objects[name], np.nan) for name in ("x_m", "y_m")]) - (own.x_m, own.y_m)
        speed = np.column_stack([np.ma.filled(objects[name], np.nan) for name in ("vx_m_per_s", "vy_m_per_s")])
        metres, seconds = closest_approach(place, speed - (own.vx_m_per_s, own.vy_m_per_s))
        numbers = objects["object"].tolist()
        closing = np.flatnonzero(np.isfinite(metres) & (objects["stage"] != "ended")).tolist()
        return {numbers[k]: (float(metres[k]), float(seconds[k])) for k in closing if numbers[k] not in self.flying}

    @cached_property
    def object_rows(self) -> dict[int, tuple[Any, ...]]:
        """The rows of :data:`OBJECT` by the number of the object; None for unknown values."""
        o = self.objects
        major, minor, angle = ellipse_axes(o)
        stage, unknown = [STAGES.index(name) for name in o["stage"].tolist()], np.full(len(o["object"]), np.nan)
        columns = [
            o["object"].tolist(), stage, _numbers(o["x_m"], 2), _numbers(o["y_m"], 2), _numbers(o["vx_m_per_s"], 2),
            _numbers(o["vy_m_per_s"], 2), _numbers(o["speed_m_per_s"], 2), _numbers(o["course_deg"], 1),
            _numbers(major, 1), _numbers(minor, 1), _numbers(angle, 0), o["n_sources"].tolist(),
            _numbers(o["probability"], 5), o["ambiguous"].astype(int).tolist(), _numbers(o["p_runner_up"], 5),
            *(_numbers(values, 1) for values in (*self._shown_heights(), o.get("climb_m_per_s", unknown))),
            *(o[name].tolist() for name in OBJECT[OBJECT.index("label") :]),
        ]  # fmt: skip
        rows: list[tuple[Any, ...]] = list(zip(*columns, strict=True))
        return {int(row[0]): row for row in rows}

    @cached_property
    def _heights(self) -> tuple[FloatArray, FloatArray]:
        """(n,) heights of the objects and their 1σ, NaN where unknown."""
        unknown = np.full(len(self.objects["object"]), np.nan)
        height, sigma = (
            np.ma.filled(self.objects.get(name, unknown), np.nan) for name in ("height_m", "sigma_height_m")
        )
        return height, sigma

    @cached_property
    def _above_ellipsoid(self) -> tuple[FloatArray, FloatArray] | None:
        """(n,) the same above the ellipsoid; None where no source reports heights."""
        return None if self.heights is None else self.heights.above_ellipsoid(*self._heights)

    def _shown_heights(self) -> list[FloatArray]:
        """(n,) the heights that a page shows and their 1σ: of what has a transponder those of the picture, as flight
        levels are; of others those above the ellipsoid."""
        if self._above_ellipsoid is None:
            return list(self._heights)
        has_level = (self.objects["icao"] != "") | (self.objects["mode_a"] != "")
        both = zip(self._heights, self._above_ellipsoid, strict=True)
        return [np.where(has_level, own, above) for own, above in both]

    @cached_property
    def record_rows(self) -> dict[str, tuple[Any, ...]]:
        """The rows of :data:`RECORD` by ``source:row``."""
        r = self.records
        major, minor, angle = ellipse_axes(r)
        columns = [
            r["object"].tolist(), r["source"].tolist(), r["row"].tolist(), _numbers(r["x_m"], 2), _numbers(r["y_m"], 2),
            _numbers(major, 1), _numbers(minor, 1), _numbers(angle, 0), _numbers(r["p_object"], 5),
            _numbers(r["p_alone"], 5), _numbers(r["age_s"], 1), _numbers(r["bearing_deg"], 2),
            _numbers(r["sigma_bearing_deg"], 2), _numbers(r["sensor_x_m"], 1), _numbers(r["sensor_y_m"], 1),
            r["track_id"].tolist(),
        ]  # fmt: skip
        return {f"{row[1]}:{row[2]}": row for row in zip(*columns, strict=True)}

    def listed(self) -> list[dict[str, Any]]:
        """Every object as a mapping for the outputs, in degrees, metres and seconds; None for unknown values."""
        o, cpa = self.objects, self.cpa
        names = [name for name in ("lat_deg", "lon_deg", "x_m", "y_m", "speed_m_per_s", "course_deg", "height_m",
                                   "climb_m_per_s", "var_x_m2", "cov_xy_m2", "var_y_m2", "probability")
                 if name in o]  # fmt: skip
        digits = {"lat_deg": 7, "lon_deg": 7, "probability": 6}
        columns: dict[str, list[float | None]] = {name: _numbers(o[name], digits.get(name, 2)) for name in names}
        if self._above_ellipsoid is not None and "height_m" in o:
            above = zip(("hae_m", "sigma_hae_m"), self._above_ellipsoid, strict=True)
            columns |= {name: _numbers(values, 1) for name, values in above}
        out = []
        for k, number in enumerate(o["object"].tolist()):
            one: dict[str, Any] = {
                "object": number,
                "stage": str(o["stage"][k]),
                **{name: column[k] for name, column in columns.items()},
            }
            one |= {name: str(o[name][k]) for name in LABELS if o[name][k]}
            one["sources"] = [f"{source}:{track}" for source, track in self.members.get(number, ())]
            if number in cpa:
                one["cpa_m"], one["tcpa_s"] = round(cpa[number][0], 1), round(cpa[number][1], 1)
            out.append(one)
        return out


def _of_aircraft(descriptions: Sequence[Description]) -> frozenset[str]:
    """The names of the sources that show aircraft only."""
    return frozenset(d.name for d in descriptions if d.kind == "air radar" or KINDS[d.kind].target == "aircraft")


@dataclass
class Delta:
    """The changes from one tick to the next, as sent to web pages."""

    tick: int
    time_s: float
    objects: list[tuple[Any, ...]] = field(default_factory=list)
    removed_objects: list[int] = field(default_factory=list)
    records: list[tuple[Any, ...]] = field(default_factory=list)
    removed_records: list[str] = field(default_factory=list)

    @classmethod
    def between(cls, previous: Situation | None, situation: Situation) -> Delta:
        """The changes from one situation to the next; all rows where there was none before."""
        old_objects = {} if previous is None else previous.object_rows
        old_records = {} if previous is None else previous.record_rows
        return cls(
            situation.tick, situation.time_s,
            [row for n, row in situation.object_rows.items() if old_objects.get(n) != row],
            [n for n in old_objects if n not in situation.object_rows],
            [row for key, row in situation.record_rows.items() if old_records.get(key) != row],
            [key for key in old_records if key not in situation.record_rows],
        )  # fmt: skip


def closest_approach(place: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance (n,) at closest approach and seconds until then, from relative positions and velocities (n, 2).

    NaN where the velocity is unknown or the distance already increases.

    >>> closest_approach(np.array([[0.0, 1000.0], [0.0, 1000.0]]), np.array([[1.0, -10.0], [0.0, 5.0]]))[1].round(1)
    array([99., nan])
    """
    speed_sq = (velocity**2).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        seconds = -(place * velocity).sum(axis=1) / speed_sq
        seconds = np.where((seconds > 0.0) & (speed_sq > 1e-4), seconds, np.nan)
    closest = place + velocity * seconds[:, None]
    return np.hypot(closest[:, 0], closest[:, 1]), seconds


def _numbers(column: NDArray[Any], digits: int) -> list[float | None]:
    # The data and the mask by themselves: a masked array of numbers takes four times as long.
    known = np.asarray(np.ma.getdata(column), np.float64).round(digits)
    values = np.where(np.ma.getmaskarray(column), np.nan, known)
    return [None if value != value else value for value in values.tolist()]
