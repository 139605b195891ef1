"""Approaches: which closest approaches to own ship are alarms.

At sea every object that will pass close enough and soon enough is one, at rest or not: a ship at anchor ahead is in the
way. In a harbour, berthed ships are many, and a course that leads past quays always points at some of them. While own
ship is slow, an object that is alongside therefore raises an alarm only where it is about to be hit. An object is
alongside if

- its AIS says that it is moored, and its motion agrees; or its motion alone says so: the probability of the mode
  "alongside" (:mod:`sameas.tracks.stationary`);
- its AIS does not say that it is at anchor, aground or not under command;
- others that are alongside are near, as at a quay or in a marina, or the land of the user's chart is beside it. What
  does not move at sea is alone: a platform, a wreck, a ship at anchor in a calm.

A slow radar target without AIS beside one that is alongside is that ship, or the quay.

An alarm of a ship in company, which closes and opens slowly, stays while she is as near: it would begin and end with
every change of a knot.

An approaching object that no source shows any more is an alarm of its own, while its approach is extrapolated.

A ship that leaves her berth loses the probability with her first reports, or those of a radar, and is watched as any
other; also as a new, tentative object, while AIS still reports her at the quay every three minutes. The page counts the
berthed ships without an alarm.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import BoolArray, FloatArray
from sameas.io.sensors.ais import STATUSES
from sameas.io.sensors.format import KNOT_M_PER_S
from sameas.live.own_ship import OwnShipState
from sameas.live.settings import WatchSettings, read_chart
from sameas.live.situation import Alarm, Situation
from sameas.maps.geojson import Coast
from sameas.picture.live import LiveState
from sameas.picture.rows import Columns
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.distress import device_of
from sameas.tracks.reports import Reports
from sameas.tracks.stationary import RESTS

#: An active alarm of closest approach ends beyond this multiple of its limits, and this speed, m/s, by the time to it:
#: 2σ of a relative velocity by AIS, whose courses err by 2°. A CPA in 20 minutes wanders by 300 m.
CPA_HOLDS, CPA_HOLDS_M_PER_S = 1.2, 0.3
#: An object with an active alarm is still near while it opens by less than this, m/s, and is not farther than this
#: multiple of its least range since, or so many metres more.
PARTS_M_PER_S, PARTS, PARTS_M = 1.0, 1.5, 100.0
#: CPA in metres that raises an alarm unless it is given, 0.5 nm, while own ship is at least this fast, m/s (1 kn).
CPA_M, UNDER_WAY_M_PER_S = 926.0, KNOT_M_PER_S
#: Own ship with the limit above is under way down to this multiple of that speed.
UNDER_WAY_HOLDS = 0.7
#: Own ship leaves the harbour at this multiple of its speed.
HARBOUR_HOLDS = 1.25
#: An object is alongside from the first probability on, and no longer below the second. Reports every three minutes
#: take 12 minutes to the first.
ALONGSIDE_FROM, ALONGSIDE_BELOW = 0.8, 0.5
#: Least number of others alongside, and the distance in metres within which they are.
COMPANIONS, COMPANY_M = 2, 926.0
#: An object at rest this near to a line of the user's chart is at a quay, metres: half a beam, and the errors of both.
QUAY_M = 75.0
#: A target without AIS is alongside within this distance of an object alongside, metres, below this speed, m/s (2 kn).
BESIDE_M, SLOW_M_PER_S = 100.0, 2.0 * KNOT_M_PER_S
#: A tentative object raises an alarm once it has been in the picture for this time, seconds.
TENTATIVE_S = 30.0
#: An approaching object is lost if no source has shown it for this time, seconds (IEC 62388: AIS of a ship under way),
#: and none shows another object within the distance, metres: that would be the same one under another number.
LOST_S, LOST_M = 60.0, 300.0
#: An object alongside is about to be hit if it will be passed at less than own ship's way in the first number of
#: seconds, within the second: at 6 kn 46 m and 185 m.
HIT_CPA_S, HIT_TCPA_S = 15.0, 60.0
#: Navigational status of AIS (ITU-R M.1371): moored; not under command, at anchor, aground.
MOORED, HAZARDS = 5.0, (1.0, 2.0, 6.0)
#: Most MMSIs whose statuses are kept: a flood of forged ones fills no memory.
MOST_STATUSES = 100_000


@dataclass
class Approaches:
    """The alarms of approaches, tick after tick.

    in_harbour : whether own ship is slow enough. berthed : objects without an alarm because they are alongside.
    """

    watch: WatchSettings
    in_harbour: bool = False
    berthed: frozenset[int] = frozenset()
    _alongside: frozenset[int] = frozenset()
    _under_way: bool = False
    #: Least range of each object since its alarm began, metres.
    _nearest_m: dict[int, float] = field(default_factory=dict)
    #: The land of the user's chart in the plane, and whether the place of an object at rest is beside it.
    _quays: _Quays | None = None
    _at_quay: dict[tuple[float, float], bool] = field(default_factory=dict)
    #: Since when an object is in the picture, while it is tentative.
    _since_s: dict[int, float] = field(default_factory=dict)
    #: Since when no source shows an object.
    _coasting_s: dict[int, float] = field(default_factory=dict)
    #: The last navigational status by MMSI.
    _status: dict[str, float] = field(default_factory=dict)

    def take(self, reports: Reports) -> None:
        """Takes the navigational status of reports that have one."""
        status = reports.extra.get("nav_status")
        if status is not None and reports.mmsi is not None:
            if len(self._status) > MOST_STATUSES:
                self._status.clear()
            self._status |= {
                str(mmsi): value
                for mmsi, value in zip(reports.mmsi.tolist(), status.tolist(), strict=True)
                if mmsi and value == value
            }

    def status(self, mmsi: str) -> str:
        """The last navigational status in the AIS of an MMSI, in words; "" for none."""
        return STATUSES.get(int(self._status.get(mmsi, -1.0)), "")

    def alarms(self, situation: Situation, state: LiveState, active: Container[str], own_mmsi: str = "") -> list[Alarm]:
        """The alarms of a situation; none without an own ship.

        state : the picture of the situation. active : keys of the alarms of the last one. own_mmsi : of own ship, if
        her transponder gives it: stations on shore receive her as well.
        """
        watch, ship, out, berthed = self.watch, situation.own_ship, [], set()
        if watch.own_ship is None and ship is None:
            return []
        speed = 0.0 if ship is None else math.hypot(ship.vx_m_per_s, ship.vy_m_per_s)
        cpa_m = watch.cpa_m
        if cpa_m is None:
            self._under_way = speed > UNDER_WAY_M_PER_S * (UNDER_WAY_HOLDS if self._under_way else 1.0)
            cpa_m = CPA_M if self._under_way else 0.0
        limit = watch.harbour_kn * KNOT_M_PER_S
        self.in_harbour = ship is not None and speed < limit * (HARBOUR_HOLDS if self.in_harbour else 1.0)
        self._alongside = self._objects_alongside(situation, state)
        own = {own_mmsi, "" if watch.own_ship is None else watch.own_ship.mmsi or ""} - {""}
        objects = situation.objects
        numbers, stages, labels, mmsis = (objects[name].tolist() for name in ("object", "stage", "label", "mmsi"))
        texts = dict(zip(numbers, zip(labels, mmsis, strict=True), strict=True))
        tentative = [number for number, stage in zip(numbers, stages, strict=True) if stage == "tentative"]
        self._since_s = {number: self._since_s.get(number, situation.time_s) for number in tentative}
        lost, company = self._lost(situation), self._in_company(situation, active, CPA_HOLDS * cpa_m)
        passing = company | situation.cpa
        # The most urgent first: of many at once only the first are named.
        for number, (metres, seconds) in sorted(passing.items(), key=lambda one: one[1][1]):
            label, mmsi = texts[number]
            # An alarm that is active holds a little longer, so that one approach is not many alarms.
            holds, spare_m = (CPA_HOLDS, CPA_HOLDS_M_PER_S * seconds) if f"cpa {number}" in active else (1.0, 0.0)
            near = number in company or (metres < holds * cpa_m + spare_m and seconds < holds * watch.tcpa_s)
            settled = situation.time_s - self._since_s.get(number, -math.inf) >= TENTATIVE_S
            # A locating device that calls for help has an alarm already, and is to be approached.
            if not near or not settled or mmsi in own or device_of(mmsi):
                continue
            hit = metres < holds * HIT_CPA_S * speed and seconds < holds * HIT_TCPA_S
            if self.in_harbour and number in self._alongside and not hit:
                berthed.add(number)
                continue
            name, passes = label or f"object {number}", f"will pass at {metres:.0f} m in {seconds / 60.0:.1f} min"
            if number not in situation.cpa:
                passes = f"stays near, at {metres:.0f} m"
            out.append(Alarm(f"cpa {number}", "cpa", f"{name} {passes}", (number,)))
            if number in lost:
                text = f"{name} is lost: no source shows it any more, and it {passes}"
                out.append(Alarm(f"lost {number}", "cpa", text, (number,)))
        self.berthed = frozenset(berthed)
        return out

    def _in_company(
        self, situation: Situation, active: Container[str], limit_m: float
    ) -> dict[int, tuple[float, float]]:
        """Range (m) and 0 s of the objects with an active alarm that are still as near as they were, by number."""
        ship, objects, out = situation.own_ship, situation.objects, {}
        nearest_m, self._nearest_m = self._nearest_m, {}
        for k, number in enumerate(objects["object"].tolist()):
            if (
                ship is None
                or f"cpa {number}" not in active
                or objects["stage"][k] == "ended"
                or np.ma.is_masked(objects["x_m"][k])
            ):
                continue
            range_m, opens = _opening(objects, k, ship)
            self._nearest_m[number] = least_m = min(nearest_m.get(number, math.inf), range_m)
            if range_m < min(limit_m, max(PARTS * least_m, least_m + PARTS_M)) and not opens > PARTS_M_PER_S:
                out[number] = (range_m, 0.0)
        return out

    def _lost(self, situation: Situation) -> set[int]:
        """The objects that no source has shown for a while, unless another one is where they should be."""
        objects, now_s = situation.objects, situation.time_s
        number, coasts = objects["object"], objects["stage"] == "coasting"
        self._coasting_s = {n: self._coasting_s.get(n, now_s) for n in number[coasts].tolist()}
        late = np.array([now_s - self._coasting_s.get(n, now_s) >= LOST_S for n in number.tolist()], bool)
        place = np.column_stack([np.ma.filled(objects[name], np.nan) for name in ("x_m", "y_m")])
        late &= np.isfinite(place).all(axis=1)
        shown = place[~coasts & np.isfinite(place).all(axis=1)]
        if late.any() and len(shown):
            late[late] = cKDTree(shown).query(place[late])[0] > LOST_M
        return set(number[late].tolist())

    def _objects_alongside(self, situation: Situation, state: LiveState) -> frozenset[int]:
        objects, p_modes = situation.objects, dict(zip(state.number.tolist(), state.p_modes, strict=True))
        number, mmsi = objects["object"].tolist(), objects["mmsi"].tolist()
        x, y, speed = (np.ma.filled(objects[name], np.nan) for name in ("x_m", "y_m", "speed_m_per_s"))
        place, placed = np.column_stack([x, y]), np.isfinite(x + y)
        at_rest = np.zeros(len(number), bool)
        for k in np.flatnonzero(placed).tolist():
            p, status = p_modes.get(number[k]), self._status.get(mmsi[k])
            if p is not None and not np.isnan(p[0]) and status not in HAZARDS:
                moored = status == MOORED and p[:RESTS].sum() >= ALONGSIDE_BELOW
                enough = ALONGSIDE_BELOW if number[k] in self._alongside else ALONGSIDE_FROM
                at_rest[k] = moored or p[0] >= enough
        found = np.flatnonzero(at_rest)
        if not len(found):
            return frozenset()
        berthed = cKDTree(place[found]).query_ball_point(place[found], COMPANY_M, return_length=True) > COMPANIONS
        berthed[~berthed] = self._beside_land(place[found[~berthed]], situation.plane)
        found = found[berthed]
        with np.errstate(invalid="ignore"):
            unnamed = np.flatnonzero(placed & ~at_rest & (objects["mmsi"] == "") & ~(speed > SLOW_M_PER_S))
        if len(found) and len(unnamed):
            beside = cKDTree(place[found]).query(place[unnamed])[0] <= BESIDE_M
            found = np.concatenate([found, unnamed[beside]])
        return frozenset(number[k] for k in found.tolist())

    def _beside_land(self, place: FloatArray, plane: LocalPlane | None) -> BoolArray:
        """(n,) whether the land of the user's chart, the first one with lines, is beside each place (n, 2)."""
        charts = [] if plane is None else [read_chart(path) for path in self.watch.chart]
        land = next((chart for chart in charts if isinstance(chart, Coast)), None)
        if land is None or plane is None:
            return np.zeros(len(place), bool)
        if self._quays is None:
            self._quays = _Quays.of(land.in_plane(plane).coast)
        # An object at rest stays in its square of 10 m.
        squares = [(x, y) for x, y in (place / 10.0).round().tolist()]
        fresh = [one for one in squares if one not in self._at_quay]
        self._at_quay = {one: self._at_quay[one] for one in squares if one in self._at_quay}
        self._at_quay |= {one: self._quays.distance_m(np.multiply(one, 10.0)) <= QUAY_M for one in fresh}
        return np.array([self._at_quay[one] for one in squares], bool)


def _opening(objects: Columns, k: int, ship: OwnShipState) -> tuple[float, float]:
    """Range (m) of an object from own ship, and the speed (m/s) at which it grows; NaN where that is unknown."""
    x, y, vx, vy = (
        float(np.ma.filled(objects[name][k], np.nan)) for name in ("x_m", "y_m", "vx_m_per_s", "vy_m_per_s")
    )
    range_m = math.hypot(x - ship.x_m, y - ship.y_m)
    opening = (x - ship.x_m) * (vx - ship.vx_m_per_s) + (y - ship.y_m) * (vy - ship.vy_m_per_s)
    return range_m, opening / max(range_m, 1.0)


@dataclass(frozen=True)
class _Quays:
    """The lines of a chart as segments, from ``start`` to ``start + along``, (n, 2) metres in the plane."""

    start: FloatArray
    along: FloatArray

    @classmethod
    def of(cls, lines: Sequence[FloatArray]) -> _Quays:
        """The segments of lines, each (n, 2)."""
        none = [np.zeros((0, 2))]
        return cls(
            np.concatenate(none + [line[:-1] for line in lines]),
            np.concatenate(none + [np.diff(line, axis=0) for line in lines]),
        )

    def distance_m(self, place: FloatArray) -> float:
        """From a place (2,) to the nearest point of the lines; infinite without lines.

        >>> _Quays.of([np.array([[0.0, 0.0], [100.0, 0.0]])]).distance_m(np.array([130.0, 40.0]))
        50.0
        """
        length_sq = np.maximum((self.along**2).sum(axis=1), 1e-12)
        fraction = np.clip(((place - self.start) * self.along).sum(axis=1) / length_sq, 0.0, 1.0)
        apart = self.start + fraction[:, None] * self.along - place
        return float(np.sqrt((apart**2).sum(axis=1).min(initial=np.inf)))
