"""Running fixes: where emitters are that one moving direction finder hears, if they do not move.

The directions of one place do not cross, but those of one that moves do, as from several places. The emitter and the
offset of the directions are the least-squares solution of all directions of it so far, weighted by their errors; the
offset has its prior width. Directions of one emitter have one frequency, or one name; without these all are taken to
be of one. Errors of directions nearer in time than ``FIX_CORRELATION_S`` count as one. Where the directions scatter
far more than they should about the solution, the emitter moves, or there are several: then it has no place.

Source: bearings-only localization of a stationary target, by nonlinear least squares.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.placement import Directions
from sameas.tracks.reports import Reports
from sameas.tracks.source import BiasPrior, Description, Motion

#: The kind of reports of running fixes, and 1σ of the velocity of what does not move, m/s.
FIXES, STILL_M_PER_S = "running fix", 0.01

#: Least number of directions that place an emitter, and most instants at which it is.
FIX_DIRECTIONS, FIX_INSTANTS = 10, 40
#: 1σ of its place by the range, and scatter of the directions by their errors, at most.
FIX_SHARE, FIX_SPREAD = 0.1, 2.0
FIX_CORRELATION_S = 10.0  # errors of directions nearer in time count as one


def running_fixes(
    description: Description, directions: Directions, raw: Reports, plane: LocalPlane | None
) -> tuple[tuple[Description, Reports] | None, tuple[str, ...]]:
    """A moving direction finder as a source of the places of its emitters, None if it has none, and notes.

    raw : the reports of the directions. Each fix is one in place of its last direction; the others have no place.
    plane : of the sensor's positions; None for metres of the user's own.
    """
    usable = np.flatnonzero(directions.usable)
    usable = usable[np.argsort(directions.time_s[usable], kind="stable")]
    place, covariance = np.full((len(raw), 2), np.nan), np.full((len(raw), 3), np.nan)
    ids, notes = np.full(len(raw), None, object), []
    for name, of_emitter in _emitters(usable, directions, raw):
        last: _Fix | None = None
        for count in _checkpoints(len(of_emitter)):
            fix = _Fix.of(directions, of_emitter[:count], description.bias.azimuth_deg or 0.0)
            if fix is None or not fix.is_placed():
                continue
            row = directions.rows[of_emitter[count - 1]]
            place[row], covariance[row], last = fix.place, fix.covariance[[0, 0, 1], [0, 1, 1]], fix
            ids[row] = name
        way_m = float(np.hypot(*np.ptp(directions.sensor_m[of_emitter], axis=0)))
        words = f"{name or 'what it hears'}, by {len(of_emitter)} directions from {way_m / 1e3:.1f} km of its way"
        if last is None:
            why = "it moves, there are several emitters, or the directions hardly cross"
            notes.append(f"{description.name}: no place of {words}: {why}")
        else:
            small, large = np.sqrt(np.linalg.eigvalsh(last.covariance))
            notes.append(
                f"{description.name}: the place of {words}, if it does not move: ± {large:.0f} × {small:.0f} m"
            )
    if np.isnan(place).all():
        return None, tuple(notes)
    columns = dict(zip(("x_m", "y_m"), place.T, strict=True))
    if plane is not None:
        known = np.isfinite(place[:, 0])
        geodetic = np.full((2, len(raw)), np.nan)
        geodetic[:, known] = plane.to_geodetic(place[known])
        columns = dict(zip(("lat_deg", "lon_deg"), geodetic, strict=True))
    of_direction = dict.fromkeys(("bearing_deg", "station_lat_deg", "station_lon_deg", "station_x_m", "station_y_m",
                                  "station_heading_deg", "sigma_bearing_deg", "speed_m_per_s", "course_deg",
                                  "heading_deg"))  # fmt: skip
    named = raw.track_id if raw.object_ids is not None else ids
    fixes = replace(raw, kind=FIXES, covariance_m2=covariance, track_id=named, **of_direction, **columns)  # type: ignore[arg-type]
    fixes = fixes.where(np.isfinite(place[:, 0]))
    # What does not move keeps its place.
    still = np.zeros(len(fixes))
    variance = np.tile([STILL_M_PER_S**2, 0.0, STILL_M_PER_S**2], (len(fixes), 1))
    fixes = replace(fixes, vx_m_per_s=still, vy_m_per_s=still, velocity_covariance_m2_per_s2=variance)
    motion = Motion(acceleration_m2_per_s3=1e-9, speed_m_per_s=1.0)
    about = Description(
        description.name, "tracks", motion=motion, misses=description.misses, bias=BiasPrior(shift_m=0.0)
    )
    return (about, fixes), tuple(notes)


def _emitters(usable: IntArray, directions: Directions, raw: Reports) -> Iterator[tuple[str, IntArray]]:
    """Name and directions of each emitter: by the names of the reports, or the frequency; else of one."""
    rows = directions.rows[usable]
    if raw.object_ids is not None:
        labels: NDArray[np.object_] = raw.object_ids[rows]
    elif raw.frequency_hz is not None:
        frequency = raw.frequency_hz[rows]
        order = np.argsort(frequency)
        steps = np.diff(frequency[order]) > _SAME_FREQUENCY * frequency[order][1:]
        group = np.empty(len(rows), np.int64)
        group[order] = np.concatenate([[0], np.cumsum(steps)]) if len(rows) else []
        mean = np.bincount(group, np.nan_to_num(frequency)) / np.maximum(np.bincount(group), 1)
        labels = np.array([*(f"{mean[k] / 1e6:.6g} MHz" for k in group), None], object)[:-1]
        labels[~np.isfinite(frequency)] = None
    else:
        labels = np.full(len(rows), "", object)
    for label in dict.fromkeys(label for label in labels if label is not None):
        yield str(label), usable[labels == label]


#: Frequencies of one emitter differ by less than this part (chosen).
_SAME_FREQUENCY = 1e-4


def _checkpoints(count: int) -> list[int]:
    """The numbers of directions after which an emitter is placed."""
    if count < FIX_DIRECTIONS:
        return []
    return np.unique(np.linspace(FIX_DIRECTIONS, count, FIX_INSTANTS).astype(np.int64)).tolist()


@dataclass(frozen=True)
class _Fix:
    """The place (2,) of an emitter with its covariance (2, 2), m². spread : of directions, in units of their errors.
    range_m : to the sensor now."""

    place: FloatArray
    covariance: FloatArray
    spread: float
    range_m: float

    def is_placed(self) -> bool:
        """Whether the directions cross, and at one place."""
        large_m = float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))
        return large_m < FIX_SHARE * self.range_m and self.spread < FIX_SPREAD

    @classmethod
    def of(cls, directions: Directions, which: IntArray, offset_deg: float) -> _Fix | None:
        """The fix by some directions, with an offset of 0 ± ``offset_deg``; None where they are parallel."""
        from scipy.optimize import least_squares

        sensor, bearing = directions.sensor_m[which], directions.bearing_deg[which]
        lasting = np.broadcast_to(directions.lasting_deg, directions.sigma_deg.shape)[which]
        of_each = directions.sigma_deg[which] ** 2
        sigma = np.sqrt(np.maximum(of_each - lasting**2, 0.05 * of_each))
        interval_s = float(np.ptp(directions.time_s[which])) / max(len(which) - 1, 1)
        share = min(1.0, interval_s / FIX_CORRELATION_S)
        offset_sigma = max(offset_deg, 0.01)
        ranges = np.geomspace(50.0, 0.5 * _FARTHEST_M, 40)
        middle = np.radians(bearing[: max(len(which) // 4, 1)])
        ahead = np.array([np.sin(middle).mean(), np.cos(middle).mean()])

        def misfit(state: FloatArray) -> FloatArray:
            off, _ = _off(bearing - state[2], sensor, state[:2])
            return np.append(off / sigma, state[2] / offset_sigma)

        def slopes(state: FloatArray) -> FloatArray:
            _, slope = _off(bearing - state[2], sensor, state[:2])
            of_each = -np.column_stack([slope, np.ones(len(which))]) / sigma[:, None]
            return np.vstack([of_each, [0.0, 0.0, 1.0 / offset_sigma]])

        starts = sensor[0] + ranges[:, None] * ahead / max(float(np.hypot(*ahead)), 1e-9)
        start = min((np.append(one, 0.0) for one in starts), key=lambda state: float(np.sum(misfit(state) ** 2)))
        fit = least_squares(misfit, start, slopes, method="lm", x_scale="jac")
        state = fit.x
        if not np.hypot(*(state[:2] - sensor[0])) < _FARTHEST_M:
            return None
        information, prior = fit.jac[:-1].T @ fit.jac[:-1], np.diag([0.0, 0.0, offset_sigma**-2.0])
        spread_sq = (2.0 * fit.cost + _PRIOR_COUNT) / (len(which) + _PRIOR_COUNT)
        # The scatter is that of the directions; the offset's prior is its own.
        covariance = np.linalg.inv(share * information / spread_sq + prior)[:2, :2]
        covariance = 0.5 * (covariance + covariance.T)
        if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0.0):
            return None
        range_m = float(np.hypot(*(state[:2] - sensor[-1])))
        return cls(state[:2], covariance, float(np.sqrt(spread_sq)), range_m)


#: No emitter is heard from farther away, m.
_FARTHEST_M = 500e3
#: Directions by which the scatter is as stated before any is seen (chosen).
_PRIOR_COUNT = 5.0


def _off(bearing_deg: FloatArray, sensor: FloatArray, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) bearings less those of a place, degrees, and (n, 2) the derivatives of the latter by it."""
    arm = place - sensor
    square = np.maximum(np.einsum("nv,nv->n", arm, arm), 1.0)
    off = np.mod(bearing_deg - np.degrees(np.arctan2(arm[:, 0], arm[:, 1])) + 180.0, 360.0) - 180.0
    return off, np.degrees(np.column_stack([arm[:, 1], -arm[:, 0]]) / square[:, None])
