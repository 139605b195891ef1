"""How well offsets explain two sources: the weight of every pair, and the log likelihood of the whole identification.

Objects are a Poisson field (METHOD 4.3): under an offset θ a pair weighs w = ρ₁₂ N(Δ(θ); 0, Σ) / (ρ₁ ρ₂), and the
likelihood is the sum over all one-to-one hypotheses of the product of their weights. Sums over hypotheses are taken by
messages; the logarithm of the sum is Bethe's, and its derivative with respect to θ is that of the messages' weights, so
that weights, likelihood and standard errors agree. Many offsets are looked at in one go: ``s`` is the number of the
offset, and every array of pairs runs over the pairs of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sameas.evidence import LOG_2PI
from sameas.gate import Radius
from sameas.records import FloatArray, Records
from sameas.registration.offsets import Offset
from sameas.registration.votes import typical_sigma, wrapped
from sameas.space import Plane

#: Pairs beyond so many (widened) standard deviations are not weighed.
GATE_SIGMAS = 5.5
#: All distances are computed up to so many pairs; beyond, the gate looks for them.
DENSE = 400_000
#: Sweeps of the messages, and the relative change that counts as settled: in the search, and at the end.
SWEEPS, ROUGHLY, CLOSELY = 100, 1e-2, 1e-7
LEAST_COMMON, MOST_SHARE = 0.05, 0.98


@dataclass(frozen=True)
class Scene:
    """Two sources and a placed offset between them. ``box`` (2, d) low and high corner of the first in the chart."""

    first: Records
    second: Records
    model: Offset
    covariance_1: FloatArray
    covariance_2: FloatArray
    sigma: float
    box: FloatArray

    @classmethod
    def of(cls, first: Records, second: Records, model: Offset) -> Scene:
        sigma = typical_sigma(first, second)
        box = boxed(flattened(first.features, model, first), sigma)
        return cls(first, second, model, first.full_covariance(), second.full_covariance(), sigma, box)

    def of_patch(self, rows: NDArray[np.int64]) -> Scene:
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

    s: NDArray[np.int64]
    i: NDArray[np.int64]
    j: NDArray[np.int64]
    residual: FloatArray
    precision: FloatArray
    weight: FloatArray
    common: FloatArray
    gain: FloatArray
    in_common: FloatArray


def weigh(scene: Scene, theta: FloatArray, common: FloatArray, widening: float) -> Weighed:
    """Weights of all pairs under the offsets theta (s, p), for so many expected common objects (s,).

    widening : the factor by which errors are taken larger than quoted, for the search.
    """
    moved = scene.model.moved(scene.second.features, theta[:, None, :])
    carried = scene.model.carried(scene.second.features, theta[:, None, :])
    spread = carried @ scene.covariance_2 @ np.swapaxes(carried, -1, -2)
    s, i, j, residual, covariance = _candidates(scene, moved, spread, widening)
    precision = np.linalg.inv(covariance)
    distance = np.einsum("mv,mvw,mw->m", residual, precision, residual)
    log_normal = -0.5 * (distance + np.log(np.linalg.det(covariance)) + residual.shape[1] * LOG_2PI)
    volume, whole, inside = _overlap(scene, moved)
    density = np.stack([len(scene.first) / whole[:, 0], len(scene.second) / whole[:, 1]], axis=1)
    expected = density * volume[:, None]
    shared = np.clip(common, LEAST_COMMON, MOST_SHARE * np.maximum(expected.min(axis=1), 2 * LEAST_COMMON))
    rest = np.maximum(expected - shared[:, None], 0.5)
    log_odds = np.log(shared) + np.log(np.maximum(volume, 1e-300)) - np.log(rest).sum(axis=1)
    share, log_sum = _messages(
        s,
        i,
        j,
        log_odds[s] + log_normal,
        (len(theta), len(scene.first), len(scene.second)),
        ROUGHLY if widening > 1.0 else CLOSELY,
    )
    alone = inside * (np.log(rest) - np.log(np.maximum(expected, 0.5)))
    gain = np.where(volume > 0.0, shared + alone.sum(axis=1) + log_sum, 0.0)
    total = np.bincount(s, share, len(theta)).astype(np.float64)
    return Weighed(s, i, j, residual, np.asarray(precision, np.float64), share, total, gain, inside)


def _candidates(
    scene: Scene, moved: FloatArray, spread: FloatArray, widening: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], FloatArray, FloatArray]:
    first, second = scene.first, scene.second
    if not isinstance(first.space, Plane) or len(moved) * len(first) * len(second) > DENSE:
        return _gated(scene, moved, spread, widening)
    periods = np.array(first.space.period_list(first.d))
    difference = wrapped(first.features[None, :, None, :] - moved[:, None, :, :], periods)
    reach_1 = np.einsum("nvv->n", scene.covariance_1)
    reach_2 = np.einsum("snvv->sn", spread)
    reach = (GATE_SIGMAS * widening) ** 2 * (reach_1[None, :, None] + reach_2[:, None, :])
    s, i, j = np.nonzero(np.einsum("sijv,sijv->sij", difference, difference) <= reach)
    return s, i, j, difference[s, i, j], (scene.covariance_1[i] + spread[s, j]) * widening**2


def _gated(
    scene: Scene, moved: FloatArray, spread: FloatArray, widening: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], FloatArray, FloatArray]:
    """The same for many records, or on the sphere, by the gate."""
    gate = Radius(GATE_SIGMAS * widening)
    found = [gate(scene.first, arrived(scene.second, moved[s], spread[s])) for s in range(len(moved))]
    number = np.repeat(np.arange(len(found)), [len(pairs) for pairs in found])
    return (
        number, np.concatenate([pairs.i for pairs in found]).astype(np.int64),
        np.concatenate([pairs.j for pairs in found]).astype(np.int64),
        np.concatenate([pairs.residual for pairs in found]),
        np.concatenate([pairs.covariance for pairs in found]) * widening**2,
    )  # fmt: skip


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


def _overlap(scene: Scene, moved: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(s,) volume where both look, (s, 2) volume where each looks, (s, 2) records of each in the overlap."""
    flat = flattened(moved, scene.model, scene.second)
    box_1, box_2 = scene.box[:, None, :], boxed(flat, scene.sigma)
    one = flattened(scene.first.features, scene.model, scene.first)
    if isinstance(scene.first.space, Plane):
        # An axis that wraps is looked at all around.
        period = np.array(scene.first.space.period_list(scene.first.d))
        around = np.where(np.isfinite(period), 1.0, 0.0)
        ring = np.where(np.isfinite(period), period, 0.0)
        box_1, box_2 = (np.where(around > 0, np.stack([0 * b[0], 0 * b[1] + ring]), b) for b in (box_1, box_2))
        one, flat = (np.where(around > 0, np.mod(x, np.where(around > 0, period, 1.0)), x) for x in (one, flat))
    low, high = np.maximum(box_1[0], box_2[0]), np.minimum(box_1[1], box_2[1])
    volume = np.prod(np.maximum(high - low, 0.0), axis=-1)
    whole = np.stack([np.broadcast_to(np.prod(b[1] - b[0], axis=-1), volume.shape) for b in (box_1, box_2)], axis=1)
    inside = [
        np.count_nonzero(((x >= low[:, None, :]) & (x <= high[:, None, :])).all(axis=-1), axis=-1)
        for x in (np.broadcast_to(one, (len(low), *one.shape)), flat)
    ]
    return volume, whole, np.stack(inside, axis=1).astype(np.float64)


def _messages(
    s: NDArray[np.int64],
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    log_weight: FloatArray,
    shape: tuple[int, int, int],
    settled: float,
) -> tuple[FloatArray, FloatArray]:
    """(m,) probabilities of the pairs and (s,) log of the sum over all hypotheses (Bethe), by sum-product messages."""
    sets, n1, n2 = shape
    row, column = s * n1 + i, s * n2 + j
    weight = np.exp(np.minimum(log_weight, 600.0))
    to_row = np.ones(len(weight))
    to_column = weight
    for _ in range(SWEEPS):
        before = to_column
        heard = weight * to_row
        to_column = weight / (1.0 + np.maximum(np.bincount(row, heard, sets * n1)[row] - heard, 0.0))
        total = np.bincount(column, to_column, sets * n2)[column]
        to_row = 1.0 / (1.0 + np.maximum(total - to_column, 0.0))
        if not len(weight) or np.all(np.abs(to_column - before) <= 1e-9 + settled * to_column):
            break
    heard = weight * to_row
    by_row = 1.0 + np.bincount(row, heard, sets * n1)
    by_column = 1.0 + np.bincount(column, to_column, sets * n2)
    log_sum = np.log(by_row).reshape(sets, n1).sum(axis=1) + np.log(by_column).reshape(sets, n2).sum(axis=1)
    log_sum -= np.bincount(s, np.log1p(to_column * to_row), sets)
    return heard / by_row[row], log_sum
