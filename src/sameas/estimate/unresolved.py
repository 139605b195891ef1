"""Unresolved neighbours: a coarse source shows two near objects of the fine one as one record between them.

One to one, such a record is the brighter of the two objects, but lies off it towards the other. Without this, every
record between two objects looks surely like the nearer one. Two objects at a separation s are one record of the coarse
source with the probability B(s) = 2^−(s/ℓ)⁴, ℓ its resolution, as in :mod:`~sameas.estimate.blends`. With w the
share of the brighter one in the flux, the density of the residual of a pair (i, j) is multiplied by

    γ₀ + Σ γ_k b_k μ_k ∫ p(w) N(x_j − w x_i − (1 − w) x_k; S) dw / N(x_j − x_i; S)

over the neighbours k of i in the fine source, the integral over w > ½. i and k are one record, if they are j's partner,
with the probability β_k = B u / (B + (1 − B)(1 − c)), where u is the probability that k has no partner but j, and c
the share of the records there that have a partner. γ₀ = Π (1 − β_k) is the probability of no blend; γ_k that of one
with k alone, β_k γ₀ / (1 − β_k), and of one with others too, whose position is that of the two. Without magnitudes
b = μ = 1 and w is uniform. With them b is the probability that i is the brightest, and μ the density of the magnitudes
of i and the others together, over that of i alone.

ℓ is that of a grid with the greatest likelihood, given the probabilities of the pairs.
:func:`sameas.estimate.blends.find_blends` gives the two objects of each record instead, for a resolution that is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.estimate.sample import Setting
from sameas.evidence import Brightness, Errors, Evidence, Rule
from sameas.gate import Pairs
from sameas.gaussian import inverse

# Parameters of the search for a resolution; all chosen.
REACH = 1.5  # maximum separation of two objects that are one record, in resolutions
TRIED = (1.5, 1.9, 2.3, 2.9, 3.6, 4.5, 5.6, 7.0)  # resolutions, in typical errors of a pair
SHARES = (0.55, 0.65, 0.75, 0.85, 0.95)  # w of the brighter object, equally probable
MIN_COLOUR_MAG, MAX_COLOUR_MAG = 0.03, 0.3  # limits of the scatter of the objects' colours; the upper one if unknown
MAX_BLENDED = 0.98  # greatest probability that a neighbour is not resolved
MIN_BLENDED = 1e-4  # probability of a blend from which its magnitude is compared
MAX_COUPLES = 20.0  # maximum mean number of neighbours per candidate; denser fields are left as they are
MIN_RESOLVED_PAIRS = 200.0  # expected number of pairs from which a resolution is sought
MAX_UNRESOLVED_RECORDS = 6_000  # of the coarse source, from which the resolution is found
MIN_GAIN = 12.0  # gain in ln likelihood over full resolution


#: Limit of ln of the ratio of two densities, so that sums do not overflow.
MAX_LOG_RATIO = 50.0

Both = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class BlendResolution:
    """The separation at which half of the couples of objects are one record of source ``coarse`` (0 or 1), in the unit
    of the residuals."""

    coarse: int
    separation: float

    def is_near(self, other: BlendResolution | None) -> bool:
        """Whether the other is of the same source and within a tenth."""
        return other is not None and other.coarse == self.coarse and abs(self.separation / other.separation - 1.0) < 0.1


@dataclass(frozen=True)
class UnresolvedRule(Rule):
    """The rule whose evidence for all pairs is ``term`` (m,)."""

    term: FloatArray

    def __call__(self, pairs: Pairs) -> Evidence:
        return Evidence({"unresolved neighbours": self.term})


@dataclass(frozen=True)
class BlendWeights:
    """Probabilities of blends, if a pair is one object or a blend whose brighter object is the fine record.

    single : (m,) of none. alone, with_more : (q,) of a blend with the neighbour alone, and with others too.
    more_flux : (q,) expected flux of the others, over that of the fine record.
    """

    single: FloatArray
    alone: FloatArray
    with_more: FloatArray
    more_flux: FloatArray


@dataclass(frozen=True)
class Unresolved:
    """The neighbours of the candidates of one setting.

    pair, neighbour : (q,) two candidates of one coarse record. separation : (q,) of their fine records.
    square, mirrored : (q, w) squared normalised distance of the coarse record from the point between them, by the share
        w; and from the point as far on the other side.
    weight : (q, w) probability of the share, if the fine record of ``pair`` is the brighter one. brighter : (q,)
        probability of that by magnitudes; 1 where they are unknown. fainter : (q,) magnitude of the neighbour
        minus that of the fine record of ``pair``, NaN where unknown.
    term : (m,) evidence of the pairs. single : (m,) probability that the pair is no blend, if it is one object.
    colour_mag : scatter of the objects' colours, by which the shares by the magnitudes are uncertain.
    """

    resolution: BlendResolution
    pair: IntArray
    neighbour: IntArray
    separation: FloatArray
    square: FloatArray = field(repr=False)
    mirrored: FloatArray = field(repr=False)
    weight: FloatArray = field(repr=False)
    brighter: FloatArray = field(repr=False)
    fainter: FloatArray = field(repr=False)
    term: FloatArray = field(repr=False)
    single: FloatArray = field(repr=False)
    colour_mag: float = math.inf

    @classmethod
    def of(
        cls, resolution: BlendResolution, setting: Setting, errors: Errors, magnitude: FloatArray | None, every: int = 1
    ) -> Unresolved | None:
        """The neighbours before any probabilities are known; None if there are too many.

        errors : whose model S measures distances. magnitude : (n,) of the fine source's records, NaN where unknown.
        every : 1 for all records of the coarse source, or every second, third, …
        """
        pairs = errors.pairs(setting.pairs)
        fine, coarse = _sides(resolution, pairs)
        some = np.arange(len(pairs)) if every == 1 else np.flatnonzero(coarse % every == 0)
        reach = REACH * resolution.separation
        parts = [(some[a], some[b]) for a, b in _couples(pairs.residual[some], coarse[some], reach)]
        if sum(len(one) for one, _ in parts) > MAX_COUPLES * len(some):
            return None
        pair, neighbour = (np.concatenate([part[k] for part in parts] or [np.empty(0, np.int64)]) for k in (0, 1))
        apart = pairs.residual[neighbour] - pairs.residual[pair]
        precision, shares = inverse(pairs.covariance_of(pair)), np.array(SHARES)
        along = np.einsum("qv,qvw,qw->q", pairs.residual[pair], precision, apart)[:, None]
        between = np.einsum("qv,qvw,qw->q", apart, precision, apart)[:, None]
        even, odd = pairs.mahalanobis_sq[pair, None] + (1.0 - shares) ** 2 * between, 2.0 * (1.0 - shares) * along
        separation = np.sqrt((apart**2).sum(axis=1))
        weight, brighter = np.full(even.shape, 1.0 / len(shares)), np.ones(len(pair))
        fainter = (
            np.full(len(pair), np.nan) if magnitude is None else magnitude[fine[neighbour]] - magnitude[fine[pair]]
        )
        none, all_single = np.zeros(len(pairs)), np.ones(len(pairs))
        unresolved = cls(
            resolution, pair, neighbour, separation, even + odd, even - odd, weight, brighter, fainter, none, all_single
        )
        return unresolved._with_colours(MAX_COLOUR_MAG)

    def _with_colours(self, colour_mag: float) -> Unresolved:
        """The same with the shares by magnitudes, if the objects' colours scatter by this much."""
        colour_mag = min(max(colour_mag, MIN_COLOUR_MAG), MAX_COLOUR_MAG)
        known = np.isfinite(self.fainter)
        if not known.any() or abs(colour_mag / self.colour_mag - 1.0) < 0.1:
            return self
        weight, brighter = self.weight.copy(), self.brighter.copy()
        by_share = _share_weights(self.fainter[known], np.array(SHARES), colour_mag)
        brighter[known] = by_share.sum(axis=1)
        weight[known] = by_share / np.maximum(brighter[known], 1e-9)[:, None]
        return replace(self, weight=weight, brighter=brighter, colour_mag=colour_mag)

    @property
    def _flux(self) -> FloatArray:
        """(q,) flux of the neighbour over that of the fine record of the pair; 0 where unknown."""
        return np.nan_to_num(10.0 ** (-0.4 * self.fainter))

    @property
    def rule(self) -> UnresolvedRule:
        """The evidence."""
        return UnresolvedRule(self.term)

    def with_probabilities(
        self, setting: Setting, errors: Errors, p_pair: FloatArray, share: Both, brightness: Brightness | None = None
    ) -> Unresolved:
        """The evidence by the probabilities (m,) of the pairs, and the local shares (n₁,), (n₂,) with a partner.

        brightness : evidence of the magnitudes, which for a blend are those of both objects together.
        """
        by_colours = self
        if brightness is not None and brightness.chains is not None:
            by_colours = self._with_colours(math.sqrt(2.0) * brightness.chains[self.resolution.coarse].scatter)
        weights, flux = by_colours._blended(setting, p_pair, share), self._flux
        ratio, toward = by_colours._ratio(self.square, setting, errors), weights.single.copy()
        for p_blend, added in ((weights.alone, flux), (weights.with_more, flux + weights.more_flux)):
            by_magnitude = self._magnitude_ratio(p_blend, added, setting.pairs, brightness)
            toward += self._by_pair(p_blend * ratio * by_magnitude, setting)
        toward = np.maximum(toward, 1e-9)
        return replace(by_colours, term=np.log(toward), single=weights.single / toward)

    def gain(self, setting: Setting, errors: Errors, p_pair: FloatArray, share: Both) -> float:
        """Gain in ln likelihood of the positions, given the probabilities (m,) of the pairs without this evidence.

        It is that beyond the mirrored points, which tails of the errors reach as well as the points between.
        """
        _, coarse = _sides(self.resolution, setting.pairs)
        weights = self._blended(setting, p_pair, share)
        blended = np.where(self.brighter > 0.5, weights.alone + weights.with_more, 0.0)
        gains = []
        for square in (self.square, self.mirrored):
            change = p_pair * self._by_pair(blended * (self._ratio(square, setting, errors) - 1.0), setting)
            of_record = np.bincount(coarse, change, len(share[self.resolution.coarse]))
            gains.append(float(np.log1p(np.maximum(of_record, -1.0 + 1e-9)).sum()))
        return gains[0] - max(gains[1], 0.0)

    def _blended(self, setting: Setting, p_pair: FloatArray, share: Both) -> BlendWeights:
        """The probabilities that the fine records of the pairs are the brighter ones of such blends."""
        fine, _ = _sides(self.resolution, setting.pairs)
        missing = 1.0 - share[1 - self.resolution.coarse]
        k, own = fine[self.neighbour], p_pair[self.neighbour]
        others = np.bincount(fine, p_pair, len(missing))[k] - own
        free = np.clip(1.0 - others / np.maximum(1.0 - own, 1e-9), 0.0, 1.0)
        merged = np.exp2(-((self.separation / self.resolution.separation) ** 4))
        p = np.minimum(free * merged / (merged + (1.0 - merged) * np.maximum(missing[k], 1e-3)), MAX_BLENDED)

        single = np.exp(self._by_pair(np.log1p(-p), setting))
        alone = p / (1.0 - p) * single[self.pair]
        several = np.maximum(1.0 - single - self._by_pair(alone, setting), 0.0)
        with_more = p * (several / np.maximum(self._by_pair(p, setting), 1e-300))[self.pair]
        brightest = np.log1p(-p * (1.0 - self.brighter))
        more_flux = p * self._flux * self.brighter
        return BlendWeights(
            single,
            alone * self.brighter,
            with_more * self.brighter * np.exp(self._of_others(brightest, setting)),
            self._of_others(more_flux, setting),
        )

    def _of_others(self, values: FloatArray, setting: Setting) -> FloatArray:
        """(q,) sums of values (q,) over the other neighbours of each pair."""
        return self._by_pair(values, setting)[self.pair] - values

    def _ratio(self, square: FloatArray, setting: Setting, errors: Errors) -> FloatArray:
        """(q,) density at these squared distances (q, w), averaged over the shares, over that of the pair."""
        d = setting.pairs.d
        at_pair = errors.log_profile(errors.pairs(setting.pairs).mahalanobis_sq, d)[self.pair, None]
        log_ratio = errors.log_profile(square.ravel(), d).reshape(square.shape) - at_pair
        return np.asarray((self.weight * np.exp(np.minimum(log_ratio, MAX_LOG_RATIO))).sum(axis=1))

    def _magnitude_ratio(
        self, p_blend: FloatArray, flux: FloatArray, pairs: Pairs, brightness: Brightness | None
    ) -> FloatArray:
        """(q,) density of the magnitudes if the neighbours add this ``flux`` (q,) to that of the fine records, over
        that if they do not; 1 where a blend is improbable."""
        ratio, compared = np.ones(len(flux)), np.flatnonzero(p_blend > MIN_BLENDED)
        if brightness is not None and len(compared):
            i, j = pairs.i[self.pair[compared]], pairs.j[self.pair[compared]]
            log_ratio = brightness.log_ratio_of_blend(i, j, 1 - self.resolution.coarse, flux[compared])
            ratio[compared] = np.exp(np.clip(log_ratio, -MAX_LOG_RATIO, MAX_LOG_RATIO))
        return ratio

    def _by_pair(self, values: FloatArray, setting: Setting) -> FloatArray:
        """(m,) sums of values (q,) over the neighbours of each pair."""
        return np.bincount(self.pair, values, len(setting.pairs)).astype(np.float64)


def _sides(resolution: BlendResolution, pairs: Pairs) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(m,) records of the fine and of the coarse source."""
    return (pairs.j, pairs.i) if resolution.coarse == 0 else (pairs.i, pairs.j)


def _share_weights(fainter: FloatArray, shares: FloatArray, scatter_mag: float) -> FloatArray:
    """(q, w) probabilities of the shares w of objects whose neighbours are fainter by (q,) magnitudes, with a scatter;
    they sum to less than 1 where the neighbour may be the brighter one."""
    from scipy.special import ndtr

    half = 0.25 / len(shares)  # of the interval of each share, ½ … 1 together
    edges = np.append(shares - half, 1.0 - 1e-9)
    magnitude = 2.5 * np.log10(edges / (1.0 - edges))
    below = ndtr((magnitude - fainter[:, None]) / scatter_mag)
    below[:, -1] = 1.0
    return np.asarray(np.diff(below, axis=1))


def _couples(residual: FloatArray, coarse: NDArray[np.int32], most: float) -> Iterator[tuple[IntArray, IntArray]]:
    """Couples of pairs of one coarse record whose fine records are at most so far apart, both ways."""
    order = np.lexsort((residual[:, 0], coarse))
    record, place = coarse[order], residual[order]
    first, step = np.arange(len(order)), 0
    while len(first):
        step += 1
        first = first[: np.searchsorted(first, len(order) - step)]
        second = first + step
        # Those that are too far along the first axis are also too far from all later ones.
        possible = (record[first] == record[second]) & (place[second, 0] - place[first, 0] <= most)
        first, second = first[possible], second[possible]
        near = ((place[second] - place[first]) ** 2).sum(axis=1) <= most**2
        one, two = order[first[near]], order[second[near]]
        yield one, two
        yield two, one


def best_resolution(gain: Callable[[BlendResolution], float], unit: float) -> BlendResolution | None:
    """The resolution of greatest gain in ln likelihood; None if both sources resolve all their neighbours.

    gain : of a resolution. unit : typical error of a pair.
    """
    best, most = None, MIN_GAIN
    for coarse in (0, 1):
        gains: list[float] = []
        for multiple in TRIED:
            gains.append(gain(BlendResolution(coarse, multiple * unit)))
            if gains[-1] < max(gains) - 2.0 * MIN_GAIN:
                break
        at = int(np.argmax(gains))
        # A gain that grows up to the largest resolution is one of a tail of the errors.
        if at < len(gains) - 1 and gains[at] > most:
            best, most = BlendResolution(coarse, TRIED[at] * unit), gains[at]
    return best
