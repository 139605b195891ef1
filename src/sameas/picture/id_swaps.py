"""Id swaps: pairs of tracks that exclude each other, and how often trackers swap the ids of near objects.

After a report, two tracks of one source at distance χ² have exchanged their ids with probability h e^(−χ²/c), and with
probability ε at any distance. The rate h and the range c of a source are estimated by how probable its reports are
under each of several models (:class:`SwapRates`), and the likelihood ratio r of a pair is the mean over the models, by
their probability. With the mean rate instead, a history would be lost before enough reports have shown that a tracker
does not swap.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, over_columns, taken
from sameas.kernels.id_swaps import add_set_gains, swap_factors
from sameas.kernels.track_pairs import best_others
from sameas.picture.named_tracks import Step
from sameas.picture.tables import distances
from sameas.picture.tuning import Tuning
from sameas.tracks.kinds import KINDS

#: Minimum probability, for h = 1, of a swap that is counted.
MIN_SWAP = 1e-3
#: Less probable models of swaps do not change the mean over models.
MIN_PROBABILITY = 1e-4
#: Maximum difference of ln r under one model of swaps from ln of the mean.
MAX_DIFFERENCE = 20.0

SWAP_RATES = (1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.3)  # grid of probabilities h, per report, that a tracker swaps two objects
SWAP_RANGES = (1.5, 4.0)  # grid of c, where h decreases with the distance as e^(−χ²/c); the prior is uniform
SWAP_RATE, SWAP_SIGMA = 3e-4, 2.0  # prior median of h and 1σ of ln h
#: (r,), (r,) h and c of every model of swaps: each rate with each range.
SWAP_MODELS = np.tile(SWAP_RATES, len(SWAP_RANGES)), np.repeat(SWAP_RANGES, len(SWAP_RATES))


def by_source_order(pair: tuple[IntArray, IntArray], source: tuple[IntArray, IntArray]) -> tuple[IntArray, IntArray]:
    """(k,), (k,) both values of each pair, that of the source with the lower number first."""
    in_order = source[0] <= source[1]
    return np.where(in_order, *pair), np.where(in_order, *pair[::-1])


@dataclass(frozen=True)
class Rivals:
    """Sets of mutually exclusive pairs: one track with each of the tracks of one other source.

    sides : (k,), (k,) numbers of the two sets of each pair: with the same track of the one source, and with the same of
    the other, in the order of :func:`by_source_order`.
    """

    sides: tuple[IntArray, IntArray]

    @classmethod
    def of(cls, first: IntArray, second: IntArray, one: IntArray, other: IntArray) -> Rivals:
        """first, second : (k,) numbers of the tracks, from 0 without large gaps. one, other : (k,) their sources."""
        sources = 1 + max(int(one.max(initial=0)), int(other.max(initial=0)))
        # A track that began later may be the second of one pair and the first of another.
        (first, second), (one, other) = (
            by_source_order(pair, (one, other)) for pair in ((first, second), (one, other))
        )
        return cls((first * sources + other, second * sources + one))

    def best_other(self, values: FloatArray, side: int) -> IntArray:
        """(k,) the other pair with the highest value in each pair's set; ABSENT without one."""
        best = np.empty(len(values), np.int64)
        best_others(self.sides[side], values, best)
        return best

    def max_other(self, values: FloatArray) -> FloatArray:
        """(k,) the highest value of any rival of each pair; −∞ without one."""
        padded = np.append(values, -np.inf)
        best = [padded[self.best_other(values, side)] for side in range(2)]
        return np.asarray(np.maximum(*best))

    def most(self, values: FloatArray) -> FloatArray:
        """(k,) the highest value of each pair and its rivals."""
        out = values
        for side in self.sides:
            out = np.maximum(out, group_maximum(side, values))
        return out

    def level(self, values: FloatArray, agrees: BoolArray) -> FloatArray:
        """(k,) the mean of the highest values with the one and with the other track, each pair's own included.

        agrees : (k,) whether the positions of the instant agree; other rivals are ignored.
        """
        agreeing = np.where(agrees, values, -np.inf)
        first, second = (np.maximum(values, group_maximum(side, agreeing)) for side in self.sides)
        return np.asarray(0.5 * (first + second))

    def most_free(self, values: FloatArray, agrees: BoolArray) -> FloatArray:
        """(k,) the highest value of each pair and its rivals, without rivals whose other track has a better pair.

        agrees : (k,) whether a pair may be such a better one.
        """
        out, padded = values, np.append(np.where(agrees, values, -np.inf), -np.inf)
        for side in range(2):
            better = padded[self.best_other(padded[:-1], 1 - side)]
            out = np.maximum(out, group_maximum(self.sides[side], np.where(better > values, -np.inf, values)))
        return out

    def with_joint_swaps(
        self, log_ratio: FloatArray, by_model: FloatArray, log_odds: FloatArray,
        swaps: Callable[[int, IntArray, IntArray], tuple[IntArray, FloatArray, FloatArray]],
    ) -> FloatArray:  # fmt: skip
        """(k,) ln r, bounded as far as a swap of ids may have exchanged two pairs at once.

        A swap of b and b′ exchanges (a, b), (a′, b′) for (a, b′), (a′, b). As ln r of each pair allows for it alone,
        the sum of both is bounded by 2 ln[(1 − p) / p], twice what one swap permits. So the difference Δ of ln r of a
        pair and of its best rival becomes ½ ln{[(1 − p) e^(2Δ) + p] / [(1 − p) + p e^(2Δ)]}, under each swap model.

        by_model : (k, r) how much larger ln r is under each model. log_odds : (k,) of each pair against chance, −∞
        where the positions of the instant disagree. swaps : gives, of pairs (n,) and their rivals (n,) with the same
        first track (0) or the same second one (1), those that may have been exchanged, (m,), p under each model, (m,
        r), and the probability of each model, (m, r).
        """
        out = log_ratio.copy()
        padded = np.append(log_odds, -np.inf)
        best_of_side = [self.best_other(log_odds, side) for side in range(2)]
        for side, best in enumerate(best_of_side):
            partner = padded[best_of_side[1 - side]]
            at = np.flatnonzero(padded[best] > -np.inf)  # ABSENT, no rival, reads the last
            # Without a pair (a′, b′) or (a′, b), the swap exchanges one pair only, and ln r allows for it.
            at = at[np.maximum(partner[at], partner[best[at]]) > 0.0]
            which, p, probability = swaps(side, at, best[at])
            at, rival = at[which], best[at[which]]
            change = (log_ratio[at] - log_ratio[rival])[:, None] + taken(by_model, at) - taken(by_model, rival)
            odds_against = np.exp(np.clip(-change, -300.0, 300.0))
            exchanged = 1.0 / (1.0 + odds_against**2)
            exchanged += p * (1.0 - 2.0 * exchanged)
            # ½ logit is the logit of the square roots' ratio.
            root, rest = np.sqrt(exchanged), np.sqrt(1.0 - exchanged)
            joint, alone = root / (root + rest), 1.0 / (1.0 + odds_against)
            out[at] += np.log(np.einsum("nr,nr->n", probability, joint) / np.einsum("nr,nr->n", probability, alone))
        return out

    def bounded(self, log_ratio: FloatArray, agrees: BoolArray, tuning: Tuning) -> FloatArray:
        """(k,) ln r within −2b … b, b = ln((1−ε)/ε); the excess of the best rival over b is subtracted, which keeps
        differences between rivals.

        agrees : (k,) whether the positions of the instant agree. Where they do not, ln r of the history is large only
            because it leaves them out; such pairs do not lower their rivals.
        """
        bound = math.log((1.0 - tuning.report_reassigned) / tuning.report_reassigned)
        excess = np.maximum(self.most(np.where(agrees, log_ratio, -np.inf)) - bound, 0.0)
        return np.clip(log_ratio - excess, -2.0 * bound, bound)


def swap_hypotheses(
    log_weight: FloatArray, log_two: FloatArray, step: Step, tracks: tuple[IntArray, IntArray], rivals: Rivals
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Of each pair and its most probable rival with the same first track, and with the same second, (k, 2) each: the
    rival (ABSENT without one), ln p of the pair's new reports apart from the position if their ids were swapped, and,
    (k, 2, c), the probability of a swap for h = 1 and each range.

    tracks : (k,), (k,) of both sources, as of :func:`by_source_order`.
    log_weight : (k,) ln r with the positions of the last reports. log_two : (k,) ln p of the new reports given two
    objects.

    After a swap the pair has the rival's ``log_weight``, and its new report agrees with the other track rather than
    with the prediction of its own: the subtracted term is ``log_two`` less that of the other track's report. Leaving
    out either would favour a rival whose last report was an outlier, and inflate the estimated swap rates.
    """
    k, ranges = len(log_weight), np.array(SWAP_RANGES)
    rival, log_report, p_swap = np.full((k, 2), ABSENT), np.zeros((k, 2)), np.zeros((k, 2, len(ranges)))
    for side, track in ((0, tracks[1]), (1, tracks[0])):
        best = rivals.best_other(log_weight, side)
        at = np.flatnonzero((best >= 0) & step.new_report[track])
        one, other = track[at], track[best[at]]
        chi_sq, _ = distances(step.here, step.covariance, one, other)
        # The most probable pair of a set swaps with at most one of the others, and each of these only with it.
        leads, sets = log_weight[at] >= log_weight[best[at]], rivals.sides[side][at]
        for c, p in enumerate(np.exp(-chi_sq / ranges[:, None])):
            total = np.bincount(sets, np.where(leads, 0.0, p))[sets]
            p_swap[at, side, c] = np.where(leads, np.minimum(total, 1.0), p / np.maximum(total, 1.0))
        rival[at, side] = best[at]
        log_report[at, side] = -(log_two - step.log_own[tracks[side]])[at]
    return rival, log_report, p_swap


@dataclass(frozen=True)
class SwapRates:
    """How often trackers swap the ids of near objects: the probability of each of ``SWAP_MODELS``, per source.

    log_probable : (S, r) its ln, up to a constant.
    """

    log_probable: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    def of_sources(self, kinds: Sequence[str]) -> SwapRates:
        """The rates with new sources at their prior; kinds : of all sources, those already known first.

        Sources that name themselves (AIS, ADS-B) have the lowest rate for certain.
        """
        rates = np.log(SWAP_MODELS[0])
        prior = -0.5 * ((rates - math.log(SWAP_RATE)) / SWAP_SIGMA) ** 2
        never = np.where(rates == rates.min(), 0.0, -np.inf)
        new = [never if KINDS[kind].self_named else prior for kind in kinds[len(self.log_probable) :]]
        if not new:
            return self
        return SwapRates(np.concatenate([self.log_probable.reshape(-1, len(rates)), new]))

    @cached_property
    def probability(self) -> FloatArray:
        """(S, r) of each model."""
        weight = np.exp(self.log_probable - self.log_probable.max(axis=1, initial=-np.inf, keepdims=True))
        return np.asarray(weight / weight.sum(axis=1, keepdims=True))

    @cached_property
    def may_swap(self) -> BoolArray:
        """(S,) whether a source may swap ids; self-named ones never do."""
        return np.asarray(np.isfinite(self.log_probable).all(axis=1))

    @property
    def probable(self) -> IntArray:
        """The models that are not improbable for every source that may swap ids."""
        return np.flatnonzero((self.probability[self.may_swap] > MIN_PROBABILITY).any(axis=0))

    def rate(self, source: IntArray) -> FloatArray:
        """(n,) mean h of each source."""
        return np.asarray((self.probability @ SWAP_MODELS[0])[source]) if len(source) else np.empty(0)

    def of_pairs(self, sources: Sequence[IntArray]) -> FloatArray:
        """(k, r) probability of each model for pairs of tracks of two sources: the mean of those that may swap ids."""
        weight = np.where(self.may_swap, 1.0, 1e-9)
        one, other = (weight[source][:, None] for source in sources)
        first, second = (taken(self.probability, source) for source in sources)
        return np.asarray((one * first + other * second) / (one + other))

    def updated(
        self, before: tuple[FloatArray, FloatArray, FloatArray], log_ratio: FloatArray, log_now: FloatArray,
        swap: tuple[IntArray, FloatArray, FloatArray], rivals: Rivals, sources: tuple[IntArray, IntArray],
        log_density_anywhere: float,
    ) -> tuple[FloatArray, FloatArray, FloatArray, SwapRates]:  # fmt: skip
        """Of pairs after new reports: ln r and how much larger it is under each model, (k,) and (k, r), and the
        probability that ids were swapped, (k,); and the updated rates.

        A swap of near objects is not evident from one report, only from many later ones. So ln r of every pair is kept
        for each model, and the likelihood of a model is the probability of the reports given its ln r: for a set of
        pairs, the sum of their weights, including that of no pair, divided by the sum before the reports.

        After a swap, ln r counts the present positions only, not the rival's last ones: where errors are constant, both
        have the same error. The likelihood of a model counts both: see :func:`swap_hypotheses`.

        before : (k,), (k,), (k, r) ln r, ln N of the positions of the last reports, and how much larger ln r was under
        each model. log_ratio, log_now : (k,) ln r with the new reports without swaps, and ln N of the present
        positions. swap : of :func:`swap_hypotheses`. sources : (k,), (k,) sources of the tracks that differ within the
        sets of ``rivals.sides``. log_density_anywhere : ln of the density of objects anywhere.
        """
        log_old, log_reported, by_model = before
        p_swapped = np.zeros(len(log_ratio))
        at = np.flatnonzero(over_columns(np.logical_or, (swap[2] > MIN_SWAP).reshape(-1, 2 * len(SWAP_RANGES))))
        if not len(at):
            return log_ratio, by_model, p_swapped, self
        sources, weight = (sources[0][at], sources[1][at]), np.exp(by_model)
        factor, swapped, with_reports = np.empty((3, len(at), weight.shape[1]))
        log_top = np.empty(len(at))
        swap_factors(
            at, (log_old, log_reported), log_ratio, weight,
            (taken(swap[0], at), taken(swap[1], at), taken(swap[2], at)),
            np.column_stack([self.may_swap[source] for source in sources]), np.array(SWAP_RATES), factor,
            swapped, with_reports, log_top,
        )  # fmt: skip
        own = taken(weight, at)
        swaps = self._with_reports(
            ((log_old + log_reported)[at], own), (log_ratio[at] + log_now[at] + log_top, with_reports),
            tuple(side[at] for side in rivals.sides), sources, log_density_anywhere,
        )  # fmt: skip
        probability, after = swaps.of_pairs(sources), own * factor
        mean = np.einsum("nr,nr->n", probability, after)
        log_ratio, by_model = log_ratio.copy(), by_model.copy()
        log_ratio[at] += np.log(mean)
        by_model[at] = np.clip(np.log(after / mean[:, None]), -MAX_DIFFERENCE, MAX_DIFFERENCE)
        p_swapped[at] = np.einsum("nr,nr->n", probability, swapped / factor)
        return log_ratio, by_model, p_swapped, swaps

    def _with_reports(
        self, before: tuple[FloatArray, FloatArray], after: tuple[FloatArray, FloatArray], sides: Sequence[IntArray],
        sources: Sequence[IntArray], log_density_anywhere: float,
    ) -> SwapRates:  # fmt: skip
        """The rates after reports; before, after : (n,), (n, r) ln of a weight of each pair, and its weights under each
        model relative to that. sides, sources : (n,), (n,) sets of pairs, and sources of the tracks that differ within
        them."""
        log_probable = self.log_probable.copy()
        for side, source in zip(sides, sources, strict=True):
            # The sets of both tracks of the other source contain the same swap: each has half a share.
            add_set_gains(side, source, before, after, log_density_anywhere, 0.5, log_probable)
        return SwapRates(log_probable - log_probable.max(axis=1, keepdims=True))


def group_maximum(group: IntArray, values: FloatArray) -> FloatArray:
    """(k,) the highest value in each one's group."""
    best = np.full(int(group.max(initial=-1)) + 1, -np.inf)
    np.maximum.at(best, group, values)
    return best[group]
