"""True motion: where objects were at any time, between the reports that are taken as the truth.

For trials of the picture: a log of AIS or ADS-B, in which every object names itself, is taken as the truth, and
sensors are modelled on top of it (:mod:`sameas.tracks.modelled`). Smoothed, the path is what can have moved so, and the
log keeps errors of its own; through every report, the log's errors are part of the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator, make_smoothing_spline

from sameas.errors import InputError
from sameas.records import FloatArray, IntArray
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description

#: A curve needs so many points to be smoothed.
FEWEST = 5


@dataclass(frozen=True)
class Path:
    """One object's reports: (k,) ascending times, (k, 3) east, north and height in metres.

    gap_s : where two reports are farther apart in time nothing is known of what lies between.
    stiffness_s3 : σ²/q of the smoothing, 0 for a path through every report; see :meth:`TrueMotion.of`.
    """

    time_s: FloatArray
    place: FloatArray
    gap_s: float
    stiffness_s3: float = 0.0

    def at(self, time_s: FloatArray) -> FloatArray:
        """(..., 3) places at any times; NaN where the object is not known."""
        times = np.asarray(time_s, np.float64)
        out = np.full((*times.shape, 3), np.nan)
        if len(self.time_s) < 2:
            return out
        after = np.searchsorted(self.time_s, times, side="right").clip(1, len(self.time_s) - 1)
        known = (times >= self.time_s[0]) & (times <= self.time_s[-1])
        known &= self.time_s[after] - self.time_s[after - 1] <= self.gap_s
        out[known] = self._curve(times[known] - self.time_s[0])
        return out

    @cached_property
    def _curve(self) -> Callable[[FloatArray], FloatArray]:
        since = self.time_s - self.time_s[0]
        if self.stiffness_s3 == 0.0 or len(since) < FEWEST:
            return PchipInterpolator(since, self.place)
        curves = [make_smoothing_spline(since, axis, lam=self.stiffness_s3) for axis in self.place.T]
        return lambda times: np.stack([curve(times) for curve in curves], axis=-1)


@dataclass(frozen=True)
class TrueMotion:
    """The paths of all objects in one plane. Make it with :meth:`of`; an object's number is its place in ``names``.

    >>> said = {"time_s": [0.0, 60.0], "lat_deg": [50.8, 50.8], "lon_deg": [-1.30, -1.29], "mmsi": ["235070762"] * 2}
    >>> motion = TrueMotion.of(Reports.of("ais", "table", said))
    >>> motion.names, np.hypot(*motion.at(30.0)[0, :2]).round(1).item()
    (('235070762',), 0.0)
    """

    plane: LocalPlane
    names: tuple[str, ...]
    paths: tuple[Path, ...]

    @classmethod
    def of(
        cls,
        reports: Reports,
        description: Description | None = None,
        *,
        plane: LocalPlane | None = None,
        gap_s: float = 300.0,
    ) -> TrueMotion:
        """Paths of the objects that reports name: by track_id, MMSI or ICAO address, the first of these that is there.

        Parameters
        ----------
        reports : latitudes and longitudes, with heights where they have them. Reports without a name or a position
            are left out, and of two of one time the first is taken.
        description : of the source of the reports. With it the paths are the smoothing splines of its errors σ
            (errors.position_m) and its objects' motion q (acceleration_m2_per_s3), Σ (x − f)² + σ²/q ∫ f̈²: what a
            Kalman smoother of nearly constant velocity gives. Without it they go through every report.
        plane : to lay the paths in; about the reports if not given.
        gap_s : the longest time between two reports that the path bridges.

        Raises
        ------
        InputError : no latitudes, no names, or gap_s not above 0.
        """
        if reports.lat_deg is None or reports.lon_deg is None:
            raise InputError(f"{reports.source}: true motion needs latitudes and longitudes; its positions are others")
        if not gap_s > 0.0:
            raise InputError(f"TrueMotion: gap_s is {gap_s}; give seconds above 0")
        plane = plane or LocalPlane.about(reports.lat_deg, reports.lon_deg)
        named, height = _names(reports), _heights(reports)
        usable = np.flatnonzero(np.isfinite(reports.lat_deg) & np.isfinite(reports.lon_deg) & (named != ""))
        lat, lon = reports.lat_deg[usable], reports.lon_deg[usable]
        place = np.column_stack([plane.of_geodetic(lat, lon, reports.source), height[usable]])
        names, number = np.unique(named[usable], return_inverse=True)
        stiffness = 0.0 if description is None else _stiffness_s3(description)
        paths = []
        for k in range(len(names)):
            rows = np.flatnonzero(number == k)
            time_s, first = np.unique(reports.time_s[usable[rows]], return_index=True)
            paths.append(Path(time_s, place[rows[first]], gap_s, stiffness))
        return cls(plane, tuple(str(name) for name in names), tuple(paths))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def span_s(self) -> tuple[float, float]:
        """The first and the last time of any path."""
        if not self.paths:
            raise InputError("TrueMotion: there are no paths; give reports that name their objects")
        return float(min(p.time_s[0] for p in self.paths)), float(max(p.time_s[-1] for p in self.paths))

    def at(self, instant_s: float) -> FloatArray:
        """(m, 3) east, north and height of every object at an instant; NaN where it is not known."""
        return self.along(np.full(len(self), instant_s))

    def along(self, time_s: FloatArray) -> FloatArray:
        """(..., m, 3) places of the objects, each at times of its own (..., m)."""
        times = np.asarray(time_s, np.float64)
        if not self.paths:
            return np.empty((*times.shape, 3))
        return np.stack([path.at(times[..., k]) for k, path in enumerate(self.paths)], axis=-2)

    def objects_of(self, reports: Reports) -> IntArray:
        """(n,) number of the object that each report names; −1 for one that is not known."""
        number = {name: k for k, name in enumerate(self.names)}
        return np.array([number.get(name, -1) for name in _names(reports)], np.int64)

    def only(self, which: Sequence[int] | NDArray[np.int64]) -> TrueMotion:
        """The paths of some of the objects, numbered anew."""
        return TrueMotion(self.plane, tuple(self.names[k] for k in which), tuple(self.paths[k] for k in which))


def _heights(reports: Reports) -> FloatArray:
    """(n,) as told, from the satellites where that is told too; 0 where nothing is."""
    height = np.zeros(len(reports))
    for column in (reports.pressure_alt_m, reports.alt_m):
        height = height if column is None else np.where(np.isfinite(column), column, height)
    return height


def _stiffness_s3(description: Description) -> float:
    sigma, walk = description.errors.position_m, description.motion.acceleration_m2_per_s3
    if sigma is None or not walk:
        raise InputError(
            f"{description.name}: smoothing its paths needs errors.position_m and motion.acceleration_m2_per_s3; "
            "give both in its description, or no description"
        )
    return sigma**2 / walk


def _names(reports: Reports) -> NDArray[np.str_]:
    column = next((c for c in (reports.track_id, reports.mmsi, reports.icao) if c is not None), None)
    if column is None:
        raise InputError(
            f"{reports.source}: reports do not name their objects; true motion needs track_id, mmsi or icao"
        )
    return np.array(["" if name is None else str(name) for name in column], dtype=str)
