"""How well offsets explain two sources: the weight of every pair, and the log likelihood of the whole identification.

Objects are a Poisson field (METHOD 4.3): under an offset θ a pair weighs w = ρ₁₂ N(Δ(θ); 0, Σ) / (ρ₁ ρ₂), and the
likelihood is the sum over all one-to-one hypotheses of the product of their weights. Sums over hypotheses are taken by
messages; the logarithm of the sum is Bethe's, and its derivative with respect to θ is that of the messages' weights, so
that weights, likelihood and standard errors agree. Many offsets are looked at in one go: ``s`` is the number of the
offset, and every array of pairs runs over the pairs of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.gate import Radius
from sameas.gaussian import inverse, log_density
from sameas.ragged import Ragged
from sameas.records import Records
from sameas.registration.hough import typical_sigma
from sameas.registration.offsets import Offset
from sameas.space import Plane

if TYPE_CHECKING:
    from sameas.kernels.offsets import Cells

#: Pairs beyond so many (widened) standard deviations are not weighed.
GATE_SIGMAS = 5.5
#: Size in standard deviations of the cells in which the first source is searched, and most of them for a record.
CELL_SIGMAS, CELLS_OF_A_RECORD = 6.0, 4.0
#: Sweeps of the messages, and the relative change that counts as settled: in the search, and at the end.
SWEEPS, ROUGHLY, CLOSELY = 100, 1e-2, 1e-5
LEAST_COMMON, MOST_SHARE = 0.05, 0.98


@dataclass(frozen=True)
class PlacedSources:
    """Two sources and a placed offset between them.

    flat (n, d) : the first source's positions in the residual's unit, and ``box`` (2, d) the corners of where it looks.
    cells : the first source as it is laid out to be searched. periods (d,) of the residual's axes.
    """

    first: Records
    second: Records
    model: Offset
    covariance_1: FloatArray
    covariance_2: FloatArray
    sigma: float
    flat: FloatArray
    box: FloatArray
    cells: Cells
    periods: FloatArray

    @classmethod
    def of(cls, first: Records, second: Records, model: Offset) -> PlacedSources:
        sigma = typical_sigma(first, second)
        flat = np.ascontiguousarray(flattened(first.features, model, first))
        periods = np.array(first.space.period_list(first.d) if isinstance(first.space, Plane) else [np.inf] * first.d)
        errors = first.full_covariance(), second.full_covariance()
        cells = _in_cells(first.features, errors[0], CELL_SIGMAS * sigma, periods)
        return cls(first, second, model, *errors, sigma, flat, boxed(flat, sigma), cells, periods)

    def of_patch(self, rows: IntArray) -> PlacedSources:
        """The same with these records of the second source only."""
        if len(rows) == len(self.second):
            return self
        second = self.second
        part = replace(
            second, features=second.features[rows], covariance=second.covariance[rows], rows=second.rows[rows]
        )
        model = self.model
        velocity = getattr(model, "velocity", None)
        if velocity is not None:
            model = replace(model, velocity=np.asarray(velocity)[rows])  # type: ignore[type-var]
        return replace(self, second=part, covariance_2=self.covariance_2[rows], model=model)


@dataclass(frozen=True)
class Weighed:
    """What s offsets make of the records.

    s, i, j : (m,) offset and records of every pair. residual (m, d), precision (m, d, d) Σ⁻¹, weight (m,) posterior.
    common : (s,) expected number of common objects. gain : (s,) log likelihood less that of nothing in common.
    in_common : (s, 2) records of either source where both look.
    """

    s: IntArray
    i: IntArray
    j: IntArray
    residual: FloatArray
    precision: FloatArray
    weight: FloatArray
    common: FloatArray
    gain: FloatArray
    in_common: FloatArray


@dataclass(frozen=True)
class Meeting:
    """Which records can meet under s offsets: pairs, and where both sources look.

    start (s + 1,), i, j (m,), residual (m, d), precision (m, d, d), log_normal (m,) ln density of a true pair.
    volume (s,) where both look, expected (s, 2) records of each there on average, in_common (s, 2) those there are.
    """

    start: IntArray
    i: IntArray
    j: IntArray
    residual: FloatArray
    precision: FloatArray
    log_normal: FloatArray
    volume: FloatArray
    expected: FloatArray
    in_common: FloatArray

    def as_overlapping_at(self, s: int) -> Meeting:
        """The same pairs, with the overlap that offset s has: no record at the edge comes in or goes."""
        same = np.full(len(self.volume), s)
        return replace(self, volume=self.volume[same], expected=self.expected[same], in_common=self.in_common[same])


def meet(scene: PlacedSources, theta: FloatArray, widening: float) -> Meeting:
    """The pairs under the offsets theta (s, p), of errors that are so many times larger than quoted."""
    from sameas.kernels.offsets import both_look, carried_errors

    features = scene.second.features
    shape = (len(theta), *features.shape)
    moved = np.ascontiguousarray(np.broadcast_to(scene.model.moved(features, theta[:, None, :]), shape))
    carried = np.broadcast_to(scene.model.carried(features, theta[:, None, :]), (*shape, scene.first.d))
    spread = carried_errors(np.ascontiguousarray(carried), scene.covariance_2)
    flat = np.ascontiguousarray(flattened(moved, scene.model, scene.second))
    volume, whole, inside = both_look(scene.box, scene.flat, flat, scene.sigma, scene.periods)
    expected = np.array([len(scene.first), len(scene.second)]) / whole * volume[:, None]
    return Meeting(*_candidates(scene, moved, spread, widening), volume, expected, inside)


def weigh(scene: PlacedSources, theta: FloatArray, common: FloatArray, widening: float) -> Weighed:
    """Weights of all pairs under the offsets theta (s, p), for so many expected common objects (s,).

    widening : the factor by which errors are taken larger than quoted, for the search.
    """
    return weighed(scene, meet(scene, theta, widening), common, ROUGHLY if widening > 1.0 else CLOSELY)


def weighed(scene: PlacedSources, met: Meeting, common: FloatArray, settled: float) -> Weighed:
    """Weights of the pairs that meet, by messages that settle to so small a share of them."""
    from sameas.kernels.offsets import messages

    volume, expected = met.volume, met.expected
    shared = np.clip(common, LEAST_COMMON, MOST_SHARE * np.maximum(expected.min(axis=1), 2 * LEAST_COMMON))
    rest = np.maximum(expected - shared[:, None], 0.5)
    # One more than are left: the mean of its inverse is that of the number that is due (Poisson), few or many.
    due = np.maximum(expected - shared[:, None], 0.0) + 1.0
    log_odds = np.log(shared) + np.log(np.maximum(volume, 1e-300)) - np.log(due).sum(axis=1)
    s = Ragged(met.start).row
    records = len(scene.first), len(scene.second)
    log_weight = log_odds[s] + met.log_normal
    share, log_sum, total = messages(met.start, met.i, met.j, log_weight, records, SWEEPS, settled)
    # The likelihood is that of what is left, so it has to be said for the shared what they are weighed less.
    alone = met.in_common * (np.log(rest) - np.log(np.maximum(expected, 0.5))) + shared[:, None] * np.log(due / rest)
    gain = np.where(volume > 0.0, shared + alone.sum(axis=1) + log_sum, 0.0)
    return Weighed(s, met.i, met.j, met.residual, met.precision, share, total, gain, met.in_common)


#: start (s + 1,), i, j (m,), residual (m, d), precision (m, d, d), log density of a true pair (m,).
Candidates = tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray, FloatArray]


def _candidates(scene: PlacedSources, moved: FloatArray, spread: FloatArray, widening: float) -> Candidates:
    if not isinstance(scene.first.space, Plane):
        return _gated(scene, moved, spread, widening)
    from sameas.kernels.offsets import near_pairs

    found: Candidates = near_pairs(scene.cells, moved, spread, scene.periods, GATE_SIGMAS, widening)
    return found


def _gated(scene: PlacedSources, moved: FloatArray, spread: FloatArray, widening: float) -> Candidates:
    """The same on the sphere, by the gate."""
    gate = Radius(GATE_SIGMAS * widening)
    found = [gate(scene.first, arrived(scene.second, moved[s], spread[s])) for s in range(len(moved))]
    residual = np.concatenate([pairs.residual for pairs in found])
    covariance = np.concatenate([pairs.covariance for pairs in found]) * widening**2
    return (
        Ragged.of_sizes([len(pairs) for pairs in found]).start,
        np.concatenate([pairs.i for pairs in found]).astype(np.int64),
        np.concatenate([pairs.j for pairs in found]).astype(np.int64), residual, inverse(covariance),
        log_density(residual, covariance),
    )  # fmt: skip


def _in_cells(features: FloatArray, covariance: FloatArray, size: float, periods: FloatArray) -> Cells:
    """Records laid out in cells of their first and last feature; one cell all along an axis with a period."""
    from sameas.kernels.offsets import Cells

    axes = [0, features.shape[1] - 1]
    at = features[:, axes]
    low, span = at.min(axis=0), np.ptp(at, axis=0)
    size = max(size, float(np.sqrt(np.prod(np.maximum(span, size)) / (CELLS_OF_A_RECORD * len(at)))))
    # The only feature is the last as well.
    whole = np.isfinite(periods[axes]) | [False, features.shape[1] == 1]
    sizes = np.where(whole, np.inf, size)
    shape = (span / sizes).astype(np.int64) + 1
    column, line = np.minimum(((at - low) / sizes).astype(np.int64), shape - 1).T
    cell = line * shape[0] + column
    rows = np.argsort(cell, kind="stable")
    start = Ragged.of_sorted(cell[rows], shape.prod()).start
    return Cells(features[rows], covariance[rows], rows, start, low, sizes, shape)


def arrived(second: Records, moved: FloatArray, covariance: FloatArray) -> Records:
    """The second source's records at their new places (n, d), with covariances (n, d, d)."""
    upper = np.triu_indices(second.d)
    packed = np.ascontiguousarray(covariance[:, upper[0], upper[1]])
    return replace(second, features=np.ascontiguousarray(moved), covariance=packed)


def flattened(features: FloatArray, model: Offset, records: Records) -> FloatArray:
    """Positions in the residual's unit."""
    return features if isinstance(records.space, Plane) else model.chart(features)


def boxed(flat: FloatArray, sigma: float) -> FloatArray:
    """(2, …, d) corners of the region that the records (…, n, d) fill: a little more than they span."""
    n = flat.shape[-2]
    low, high = flat.min(axis=-2), flat.max(axis=-2)
    more = (high - low) / max(n - 1, 1) + sigma
    return np.stack([low - more, high + more])
