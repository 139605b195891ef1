"""What the user asks of a picture: instants, area, and steps of the method."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import Argument, InputError, Message
from sameas.io.sensors.format import picture_time
from sameas.io.sensors.sources import SensorSource
from sameas.picture.picture import MAX_INSTANTS, instants
from sameas.picture.plot_picture import PlotPicture, nameless
from sameas.picture.watch import EvidenceOf, Watch, all_evidence
from sameas.report.prose import span
from sameas.representation import count
from sameas.tracks.coordinates import MILE_M, LocalPlane
from sameas.tracks.reports import NoReports
from sameas.tracks.scene import Scene

_UNITS_M = {"km": 1000.0, "nm": MILE_M, "m": 1.0}
_NUMBER = r"\s*([+-]?(?:\d+\.?\d*|\.\d+))\s*"
_AREA = re.compile(rf"{_NUMBER},{_NUMBER},{_NUMBER}({'|'.join(_UNITS_M)})?\s*")

#: Default steps between instants in seconds, the shortest that gives at most ``ENOUGH`` instants is used.
STEPS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1200.0, 1800.0, 3600.0)
ENOUGH = 200


@dataclass(frozen=True)
class Instants:
    """The instants that the user asks for: one (``at``), or a series."""

    every_s: float | None = None
    at: str | float | None = None
    begin: str | float | None = None
    end: str | float | None = None

    def of(self, sessions_s: Sequence[tuple[float, float]]) -> FloatArray:
        """(k,) the instants in seconds, ascending, for reports within these spans, of which the pauses between them get
        none if the user gives no times."""
        span_s = sessions_s[0][0], sessions_s[-1][1]
        if self.at is not None:
            return np.array([picture_time(self.at, "at", span_s)])
        first = span_s[0] if self.begin is None else picture_time(self.begin, "begin", span_s)
        last = span_s[1] if self.end is None else picture_time(self.end, "end", span_s)
        if first > last:
            words = Message("the picture would be from ", self._range_text(first, last), ": it ends before it begins")
            raise InputError(words)
        if self.every_s is not None and not 0.0 < self.every_s < np.inf:
            raise InputError(Message(Argument("every", f"{self.every_s:g}s"), " is no time between instants"),
                             "give a time above 0")  # fmt: skip
        if self.every_s is not None and (last - first) / self.every_s >= MAX_INSTANTS:
            times = f" makes {count(round((last - first) / self.every_s))} instants from {span(first, last)}"
            every = Argument("every", f"{self.every_s:g}s")
            raise InputError(Message(every, times), "give a longer time between instants")
        if self.every_s is not None or self.begin is not None or self.end is not None:
            sessions_s = [(first, last)]
        if len(sessions_s) > ENOUGH:
            sessions_s = [sessions_s[k] for k in np.linspace(0, len(sessions_s) - 1, ENOUGH).astype(int)]
        length_s = sum(end - begin for begin, end in sessions_s)
        step = next((step for step in STEPS_S if length_s / step <= ENOUGH), length_s / ENOUGH)
        return np.concatenate([instants(session, self.every_s or step) for session in sessions_s])

    def _range_text(self, first_s: float, last_s: float) -> Message:
        begin, end = span(first_s, last_s).split(" to ", 1)
        given = [Message(" (", Argument(name, str(value)), ")") if value is not None else ""
                 for name, value in (("begin", self.begin), ("end", self.end))]  # fmt: skip
        return Message(begin, given[0], " to ", end, given[1])


@dataclass(frozen=True)
class Area:
    """The places within ``radius_m`` of a latitude and longitude, by great circles.

    >>> area = Area.of_text("55.5,10.5,20nm")
    >>> str(area), area.holds(np.array([55.6, 56.5]), np.array([10.5, 10.5])).tolist()
    ('37 km of 55.5, 10.5', [True, False])
    """

    lat_deg: float
    lon_deg: float
    radius_m: float

    def __str__(self) -> str:
        radius_km = self.radius_m / 1000.0
        return f"{radius_km:{'.0f' if radius_km > 10.0 else '.3g'}} km of {self.lat_deg:g}, {self.lon_deg:g}"

    @classmethod
    def of_text(cls, text: str) -> Area:
        """Of "LAT,LON,DISTANCE", with km, nm or m; kilometres without a unit.

        Raises InputError: it is none.
        """
        match = _AREA.fullmatch(text)
        if match is not None:
            lat_deg, lon_deg, distance = (float(number) for number in match.group(1, 2, 3))
            if abs(lat_deg) <= 90.0 and distance > 0.0:
                return cls(lat_deg, lon_deg, distance * _UNITS_M[match[4] or "km"])
        raise InputError(
            Message(Argument("within", text), " is no area"),
            "give latitude and longitude in degrees and a distance, as 55.5,10.5,50km",
        )

    def holds(self, lat_deg: FloatArray, lon_deg: FloatArray) -> np.ndarray:
        """(n,) whether places (n,) are in the area; not where they are NaN."""
        plane = LocalPlane(self.lat_deg, self.lon_deg)
        return np.asarray(plane.great_circle_m(lat_deg, lon_deg) <= self.radius_m)

    def part(
        self, sources: Sequence[SensorSource], set_aside: dict[str, InputError] | None = None
    ) -> list[SensorSource]:
        """The sources with those of their reports that are in the area; plots measured from a sensor are all kept.

        set_aside : receives the errors of sources without such reports, if others have some; without it, and if none
        has, the first is raised.
        """
        out, errors = [], {}
        for source in sources:
            reports = source.reports
            if reports.lat_deg is None or reports.lon_deg is None:
                out.append(source)
                continue
            inside = self.holds(reports.lat_deg, reports.lon_deg)
            if not inside.any():
                name = source.description.name
                errors[name] = NoReports(f"{name}: none of its {count(len(reports))} positions is within {self}")
                continue
            note = f"{count(int(inside.sum()))} of {count(len(reports))} reports are within {self}; only these are used"
            part = replace(reports.where(inside), notes=(*reports.notes, note))
            out.append(replace(source, reports=part))
        if errors and (set_aside is None or not out):
            raise next(iter(errors.values()))
        if set_aside is not None:
            set_aside |= errors
        return out


@dataclass(frozen=True)
class Method:
    """Steps of the method that can be switched off, and what is left out. without : names of excluded sources. area :
    outside of which positions are not used."""

    registration: bool = True
    identity: bool = True
    memory: bool = True
    without: tuple[str, ...] = ()
    area: Area | None = None

    def included(
        self, sources: Sequence[SensorSource], set_aside: dict[str, InputError] | None = None
    ) -> list[SensorSource]:
        """The sources that are not excluded, with their reports in the area. set_aside : the errors of others; those
        of excluded ones are removed, and those without a position in the area get one.

        Raises InputError: a name that no source has; no source remains.
        """
        names = [source.description.name for source in sources]
        for name in self.without:
            if (set_aside is None or set_aside.pop(name, None) is None) and name not in names:
                words = Message(Argument("without", name), ": there is no such source")
                raise InputError(words, f"give one of {', '.join(names)}")
        included = [source for source in sources if source.description.name not in self.without]
        if not included:
            raise InputError(Message(Argument("without", ", ".join(self.without)), ": no source is left"))
        return included if self.area is None else self.area.part(included, set_aside)

    def evidence(self) -> EvidenceOf:
        """The evidence that is used at an instant."""
        return partial(all_evidence, identity=self.identity, previous_scans=self.memory)

    def watch(self, scene: Scene, misread: frozenset[str] = frozenset()) -> Watch | PlotPicture:
        """The state that is carried from instant to instant; without memory, instants are independent. misread : as of
        the watch."""
        if not self.memory:
            return Watch(evidence=self.evidence(), bound=1.0, misread=misread)
        return PlotPicture() if nameless(scene) else Watch(evidence=self.evidence(), misread=misread)
