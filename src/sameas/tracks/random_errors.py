"""Random errors: which part of the stated errors of a source changes from report to report.

A user who does not know the errors of a sensor states large ones, or gives a containment radius for 1σ. A filter that
takes them for noise then follows a turning vessel late by hundreds of metres. What the noise is at most, the positions
show by themselves, before any filter. Four positions of a track at the times tᵢ have the divided third difference

    d = Σ wᵢ xᵢ,   wᵢ = Π_{j≠i} 1 / (tᵢ − tⱼ),

which is 0 for motion with any constant acceleration, whatever the steps, and has the variance Σ wᵢ² Rᵢ for random
errors as stated. Its median square over that variance is s², the random share of the stated variance, increased by
what remains of the motion. Errors that persist for some reports pass for smaller ones in neighbouring reports, and
would mislead the filter as much as noise does. So the steps are also made longer, up to the memory of the filter,
(s² R / q)^¼, and the largest s² counts; of tracks, whose motion differs, nearly the largest one.

A filter by s² R follows without lag. Of the errors that persist nothing is known but that they are between the random
ones and those stated. Their prior 1σ is the geometric mean of both, √s σ, and that of the place on the hull as
described; they are no noise that a filter reduces, so the positions stay as reported, with these errors. Other sources
show what they are (:mod:`sameas.picture.error_factors`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import propagated
from sameas.tracks.alignment import States

#: Errors are taken for overstated if their random part is at most this share of the stated 1σ: a filter lags by
#: the square root of it too long (chosen).
OVERSTATED = 1.0 / 3.0
#: The least share: positions of objects at rest may be repeated to the last digit.
LEAST_SHARE = 1.0 / 32.0
#: A track shows its share by that many third differences, the source by that many in total; of its tracks, those with
#: larger shares than this quantile are left out, of at most MAX_TRACKS (chosen).
MIN_DIFFERENCES, MIN_IN_TOTAL, QUANTILE, MAX_TRACKS = 10, 30, 0.9, 256
#: Median of the square of a standard normal number.
MEDIAN_SQUARE = float(ndtri(0.75)) ** 2


@dataclass(frozen=True)
class RandomErrors:
    """The shares of the stated 1σ of a source's positions that change from report to report, 1 if not overstated.

    along, across : the line of sight from the sensor; without one, east and north.
    """

    along: float = 1.0
    across: float = 1.0

    @property
    def overstated(self) -> bool:
        """Whether the stated errors are much larger than the random ones in any direction."""
        return min(self.along, self.across) < 1.0

    def noise(self, reports: States, sensor_m: FloatArray | None) -> States:
        """The reports with the random part of their position errors, s² R, by which they are to be filtered."""
        return self._scaled(reports, sensor_m, 1.0) if self.overstated else reports

    def persistent(self, reports: States, sensor_m: FloatArray | None, extent_m: float) -> States:
        """The reports with the prior errors of their positions, s R, and those of the place on the hull."""
        if not self.overstated:
            return reports
        scaled = self._scaled(reports, sensor_m, 0.5)
        scaled.covariance[:, :2, :2] += extent_m**2 * np.eye(2)
        return scaled

    def _scaled(self, reports: States, sensor_m: FloatArray | None, power: float) -> States:
        axes, covariance = _axes(reports, sensor_m), reports.covariance.copy()
        scale = np.einsum("nvk,k,nwk->nvw", axes, np.array([self.along, self.across]) ** power, axes)
        covariance[:, :2, :2] = propagated(scale, covariance[:, :2, :2])
        return replace(reports, covariance=covariance)

    def line(self, source: str) -> str:
        """Printable: what was found of a source."""
        share = min(self.along, self.across)
        return f"{source}: positions scatter by {share:.2g} of the errors given or assumed; tracks are filtered by that"


#: Errors that are random as stated.
AS_STATED = RandomErrors()


def random_errors(reports: States, sensor_m: FloatArray | None, acceleration_m2_per_s3: float) -> RandomErrors:
    """The random errors of a source with track ids, whose positions are measured, not filtered.

    sensor_m : (n, 2) position of the sensor at each report; None if it is unknown. acceleration_m2_per_s3 : power
    density of the velocity's random walk, by which the reports are to be filtered.

    >>> t, rng = np.arange(60.0), np.random.default_rng(1)
    >>> place = np.column_stack([5.0 * t, 0.0 * t]) + rng.normal(0.0, 10.0, (60, 2))
    >>> for stated in (10.0, 500.0):
    ...     reports = States.of(t, place, stated**2 * np.eye(2), speed_m_per_s=8.0, track=["a"] * 60)
    ...     print(random_errors(reports, None, 0.01).overstated)
    False
    True
    """
    rows, number = reports.by_track()
    kept = number < MAX_TRACKS
    rows, number = rows[kept], number[kept]
    gaps = np.diff(reports.time_s[rows])[np.diff(number) == 0]
    if not (gaps > 0.0).any():
        return AS_STATED
    axes = _axes(reports, sensor_m)[rows]
    variance = np.einsum("nvk,nvw,nwk->nk", axes, reports.covariance[rows, :2, :2], axes)
    typical = np.median(variance, axis=0)
    memory_s = (typical.max() / acceleration_m2_per_s3) ** 0.25
    step_s = float(np.median(gaps[gaps > 0.0]))
    steps_s = [0.0, *(step_s * 2.0 ** np.arange(1, 1 + max(math.ceil(math.log2(memory_s / step_s)), 0)))]
    by_step = []
    for step_s in steps_s:
        four = _fours(reports.time_s[rows], number, step_s)
        by_step.append(_square_shares(reports.time_s[rows], reports.state[rows, :2], axes, variance, number, four))
    share = [_share(np.array(steps_s), np.array(by_step)[:, k], typical[k] / acceleration_m2_per_s3) for k in (0, 1)]
    return RandomErrors(*share)


def _share(steps_s: FloatArray, square_shares: FloatArray, ratio_s4: float) -> float:
    """s where the memory of a filter by s² R has no step with a larger one; 1 if not overstated. ratio_s4 : R / q."""
    square, known = 1.0, np.isfinite(square_shares)
    for _ in range(len(steps_s)):
        in_memory = steps_s <= (square * ratio_s4) ** 0.25
        square = min(square, max(square_shares[in_memory & known].max(initial=0.0), LEAST_SHARE**2))
    return math.sqrt(square) if known[in_memory].all() and square <= OVERSTATED**2 else 1.0


def _axes(reports: States, sensor_m: FloatArray | None) -> FloatArray:
    """(n, 2, 2) the unit vectors along and across the line of sight, in columns; east and north without a sensor."""
    axes = np.broadcast_to(np.eye(2), (len(reports), 2, 2)).copy()
    if sensor_m is None:
        return axes
    arm = reports.state[:, :2] - sensor_m
    range_m = np.hypot(*arm.T)
    known = range_m > 0.0
    unit = arm[known] / range_m[known, None]
    axes[known, :, 0], axes[known, :, 1] = unit, np.column_stack([unit[:, 1], -unit[:, 0]])
    return axes


def _fours(time_s: FloatArray, number: IntArray, step_s: float) -> IntArray:
    """(m, 4) places of reports of one track, each later than the one before by ``step_s`` or more; the reports are in
    order of their tracks (n,) and times."""
    first = np.arange(len(time_s))
    since_s = time_s - time_s.min()
    # Half a millisecond for the rounding of stamps; never the same time twice.
    spacing_s = max(step_s - 5e-4, 1e-6)
    key = since_s + number * (2.0 * since_s.max() + 4.0 * spacing_s)
    out = [first]
    for _ in range(3):
        # Of places beyond the last report, the last one stands: it is of no longer time, and dropped below.
        out.append(np.minimum(np.searchsorted(key, key[out[-1]] + spacing_s), len(key) - 1))
    four = np.column_stack(out)
    is_one = (number[four[:, 3]] == number[first]) & (np.diff(time_s[four], axis=1) > 0.0).all(axis=1)
    return four[is_one]


def _square_shares(
    time_s: FloatArray, place: FloatArray, axes: FloatArray, variance: FloatArray, number: IntArray, four: IntArray
) -> FloatArray:
    """(2,) s² along both axes by the third differences of four reports each (m, 4); NaN if these are too few."""
    if len(four) < MIN_IN_TOTAL:
        return np.full(2, np.nan)
    apart_s = time_s[four][:, :, None] - time_s[four][:, None, :]
    weight = 1.0 / (apart_s + np.eye(4)).prod(axis=2)
    weight /= np.abs(weight).max(axis=1, keepdims=True)
    # Differences of positions from the first keep the digits of a plane of hundreds of kilometres.
    third = np.einsum("mi,miv,mvk->mk", weight, place[four] - place[four[:, :1]], axes[four[:, 0]])
    square = third**2 / np.einsum("mi,mik->mk", weight**2, variance[four])
    begins = np.flatnonzero(np.diff(number[four[:, 0]], prepend=-1))
    of_tracks = [np.median(part, axis=0) for part in np.split(square, begins[1:]) if len(part) >= MIN_DIFFERENCES]
    if not of_tracks:
        return np.full(2, np.nan)
    return np.quantile(of_tracks, QUANTILE, axis=0, method="higher") / MEDIAN_SQUARE
