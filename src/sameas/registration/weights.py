"""Weights of all pairs of two sources under given offsets, and the log likelihood of the identification.

Objects are a Poisson field (METHOD 4.3). Under an offset θ a pair weighs w = ρ₁₂ N(Δ(θ); 0, Σ) / (ρ₁ ρ₂), and the
likelihood is the sum over all one-to-one hypotheses of the product of their weights. It is approximated by messages:
the logarithm of the sum is Bethe's, whose derivative with respect to θ is given by the messages' weights, so that
weights, likelihood and standard errors are consistent. Many offsets are evaluated together: ``s`` is the number of the
offset, and arrays of pairs concatenate those of all offsets.
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
from sameas.registration.offsets import Displaced, Offset
from sameas.space import Plane

if TYPE_CHECKING:
    from sameas.kernels.offsets import Cells

GATE_SIGMAS = 5.5  # pairs farther apart than this are ignored
CELL_SIGMAS, CELLS_PER_RECORD = 6.0, 4.0  # size of the cells in which pairs are searched, and their number per record
#: Maximum number of sweeps of messages, and the relative change at convergence, in the search and afterwards.
SWEEPS, SEARCH_MESSAGE_TOLERANCE, MESSAGE_TOLERANCE = 100, 1e-2, 1e-5
#: Limits of the number of common objects: objects, and share of the smaller source.
MIN_COMMON, MAX_COMMON_SHARE = 0.05, 0.98


@dataclass(frozen=True)
class PlacedSources:
    """Two sources and an offset model placed on them.

    covariance_1, covariance_2 : (n, d, d) of their records. sigma : typical σ of a residual. flat : (n₁, d) the first
    source's positions in the residual's unit. box : (2, d) corners of its field. cells : its records in cells, for the
    search of pairs. periods : (d,) of the residual's axes.
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
        cells = in_cells(first.features, errors[0], CELL_SIGMAS * sigma, periods, CELLS_PER_RECORD)
        return cls(first, second, model, *errors, sigma, flat, boxed(flat, sigma), cells, periods)

    def of_patch(self, rows: IntArray) -> PlacedSources:
        """The same with only these records of the second source."""
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
    """Weights of pairs under s offsets.

    displaced : the second source's records (s, n₂).
    s, i, j : (m,) offset and records of each pair. residual (m, d), precision (m, d, d) Σ⁻¹, weight (m,) posterior.
    common : (s,) expected number of common objects. gain : (s,) log likelihood minus that of nothing in common.
    in_common : (s, 2) number of records of either source in the overlap.
    """

    displaced: Displaced
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
class CandidatePairs:
    """Candidate pairs under s offsets, and the overlap of the sources.

    displaced : the second source's records (s, n₂).
    start (s + 1,), i, j (m,), residual (m, d), precision (m, d, d), log_normal (m,) ln density of a true pair.
    volume (s,) of the overlap, expected (s, 2) mean number of records of each in it, in_common (s, 2) their number.
    """

    displaced: Displaced
    start: IntArray
    i: IntArray
    j: IntArray
    residual: FloatArray
    precision: FloatArray
    log_normal: FloatArray
    volume: FloatArray
    expected: FloatArray
    in_common: FloatArray

    def with_overlap_of_first(self) -> CandidatePairs:
        """The same pairs, with the overlap of the first offset for all offsets."""
        same = np.zeros(len(self.volume), np.int64)
        return replace(self, volume=self.volume[same], expected=self.expected[same], in_common=self.in_common[same])


def candidates_at(scene: PlacedSources, theta: FloatArray, widening: float) -> CandidatePairs:
    """The candidate pairs under the offsets theta (s, p), with errors ``widening`` times as large as quoted."""
    from sameas.kernels.offsets import carried_errors, overlap

    features = scene.second.features
    shape = (len(theta), *features.shape)
    displaced = scene.model.displaced(features, theta[:, None, :])
    moved = np.ascontiguousarray(np.broadcast_to(displaced.position, shape))
    carried = np.broadcast_to(displaced.by_position, (*shape, scene.first.d))
    spread = carried_errors(np.ascontiguousarray(carried), scene.covariance_2)
    flat = np.ascontiguousarray(flattened(moved, scene.model, scene.second))
    volume, volumes, inside = overlap(scene.box, scene.flat, flat, scene.sigma, scene.periods)
    expected = np.array([len(scene.first), len(scene.second)]) / volumes * volume[:, None]
    return CandidatePairs(displaced, *_candidates(scene, moved, spread, widening), volume, expected, inside)


def weigh(scene: PlacedSources, theta: FloatArray, common: FloatArray, widening: float) -> Weighed:
    """Weights of all pairs under the offsets theta (s, p), for expected numbers of common objects (s,).

    widening : factor on the quoted errors, above 1 in the search.
    """
    return weighed(
        scene,
        candidates_at(scene, theta, widening),
        common,
        SEARCH_MESSAGE_TOLERANCE if widening > 1.0 else MESSAGE_TOLERANCE,
    )


def weighed(scene: PlacedSources, candidates: CandidatePairs, common: FloatArray, tolerance: float) -> Weighed:
    """Weights of candidate pairs by messages, iterated until their relative change is below ``tolerance``."""
    from sameas.kernels.offsets import messages

    volume, expected = candidates.volume, candidates.expected
    in_both = np.clip(common, MIN_COMMON, MAX_COMMON_SHARE * np.maximum(expected.min(axis=1), 2 * MIN_COMMON))
    rest = np.maximum(expected - in_both[:, None], 0.5)
    # Of a Poisson number n, the mean of 1 / (n + 1) is nearly 1 / its expectation.
    due = np.maximum(expected - in_both[:, None], 0.0) + 1.0
    log_odds = np.log(in_both) + np.log(np.maximum(volume, 1e-300)) - np.log(due).sum(axis=1)
    s = Ragged(candidates.start).row
    records = len(scene.first), len(scene.second)
    log_weight = log_odds[s] + candidates.log_normal
    share, log_sum, total = messages(
        candidates.start, candidates.i, candidates.j, log_weight, records, SWEEPS, tolerance
    )
    # The likelihood has the remaining number ``rest``, the pairs have ``due``: the last term corrects for that.
    alone = candidates.in_common * (np.log(rest) - np.log(np.maximum(expected, 0.5))) + in_both[:, None] * np.log(
        due / rest
    )
    gain = np.where(volume > 0.0, in_both + alone.sum(axis=1) + log_sum, 0.0)
    return Weighed(
        candidates.displaced,
        s,
        candidates.i,
        candidates.j,
        candidates.residual,
        candidates.precision,
        share,
        total,
        gain,
        candidates.in_common,
    )


#: start (s + 1,), i, j (m,), residual (m, d), precision (m, d, d), log density of a true pair (m,).
Candidates = tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray, FloatArray]


def _candidates(scene: PlacedSources, moved: FloatArray, spread: FloatArray, widening: float) -> Candidates:
    if not isinstance(scene.first.space, Plane):
        return _gated(scene, moved, spread, widening)
    from sameas.kernels.offsets import near_pairs

    return near_pairs(scene.cells, moved, spread, scene.periods, GATE_SIGMAS, widening)


def _gated(scene: PlacedSources, moved: FloatArray, spread: FloatArray, widening: float) -> Candidates:
    """Candidates on the sphere, by the gate."""
    gate = Radius(GATE_SIGMAS * widening)
    gated = [gate(scene.first, records_moved(scene.second, moved[s], spread[s])) for s in range(len(moved))]
    residual = np.concatenate([pairs.residual for pairs in gated])
    covariance = np.concatenate([pairs.covariance for pairs in gated]) * widening**2
    return (
        Ragged.of_sizes([len(pairs) for pairs in gated]).start,
        np.concatenate([pairs.i for pairs in gated]).astype(np.int64),
        np.concatenate([pairs.j for pairs in gated]).astype(np.int64), residual, inverse(covariance),
        log_density(residual, covariance),
    )  # fmt: skip


def in_cells(
    features: FloatArray, covariance: FloatArray, size: float, periods: FloatArray, per_record: float = CELLS_PER_RECORD
) -> Cells:
    """Records laid out in cells of their first and last feature, with a single cell along a periodic axis."""
    from sameas.kernels.offsets import Cells

    axes = [0, features.shape[1] - 1]
    at = features[:, axes]
    low, span = at.min(axis=0), np.ptp(at, axis=0)
    size = max(size, float(np.sqrt(np.prod(np.maximum(span, size)) / (per_record * len(at)))))
    # With one feature, both axes are the same.
    one_cell = np.isfinite(periods[axes]) | [False, features.shape[1] == 1]
    sizes = np.where(one_cell, np.inf, size)
    shape = (span / sizes).astype(np.int64) + 1
    column, line = np.minimum(((at - low) / sizes).astype(np.int64), shape - 1).T
    cell = line * shape[0] + column
    rows = np.argsort(cell, kind="stable")
    start = Ragged.of_sorted(cell[rows], shape.prod()).start
    return Cells(features[rows], covariance[rows], rows, start, low, sizes, shape)


def records_moved(second: Records, moved: FloatArray, covariance: FloatArray) -> Records:
    """The second source's records at new positions (n, d), with covariances (n, d, d)."""
    upper = np.triu_indices(second.d)
    packed = np.ascontiguousarray(covariance[:, upper[0], upper[1]])
    return replace(second, features=np.ascontiguousarray(moved), covariance=packed)


def flattened(features: FloatArray, model: Offset, records: Records) -> FloatArray:
    """Positions in the residual's unit."""
    return features if isinstance(records.space, Plane) else model.chart(features)


def boxed(flat: FloatArray, sigma: float) -> FloatArray:
    """(2, …, d) corners of the field of records (…, n, d): their extent plus their mean spacing and σ on each side."""
    n = flat.shape[-2]
    low, high = flat.min(axis=-2), flat.max(axis=-2)
    more = (high - low) / max(n - 1, 1) + sigma
    return np.stack([low - more, high + more])
