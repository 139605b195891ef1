"""Error scales: by how much residuals spread more or less than their quoted errors, found from pairs.

The spread is a mixture of normals over a ladder of error scales. Its shares have one maximum of the likelihood, so that
errors quoted too small and heavy tails come out of the same estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sameas.evidence import Errors
from sameas.records import FloatArray

#: Steps of the ladder of error scales, as a factor; enough for any smooth spread to be mixed from them.
RUNG = 1.5
LOWEST_RUNG = -5.0
#: Pairs of like distance are counted together, in so many bins from the first distance on, in standard deviations.
BINS, NEAREST = 400, 1e-3
#: Pairs whose log odds are less say nothing of the errors, whatever these are; more is as sure as can be; in so many
#: steps.
LEAST_LOG_ODDS, MOST_LOG_ODDS, ACROSS = -12.0, 30.0, 84
#: The search for the shares stops when ln of the likelihood grows by less than this, or after so many steps.
SETTLED, STEPS = 1e-4, 40
#: Errors larger than so many times the quoted ones are a tail. It must better ln of the likelihood by so much, four
#: standard errors: what chance pairs look like feeds on itself, as more of them are then believed.
TAIL, STANDING_OUT = 2.0, 8.0
#: What every share begins with besides its own: EM never revives one that is zero.
SPREAD = 1e-3
#: Least part of a step, and what is added to the curvature, of its trace: neighbouring normals are much alike.
SHORTEST, RIDGE = 1e-3, 1e-10

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class ErrorFit:
    """The errors, and by how much a tail of them would better ln of the likelihood, whether it stands out or not."""

    errors: Errors
    tail: float


def fit_errors(
    mahalanobis_sq: FloatArray, log_odds: FloatArray, d: int, start: Errors, *, widest: float = math.inf
) -> ErrorFit:
    """The mixture of error scales of greatest likelihood for pairs that are true with odds of exp(log_odds) · f.

    f = Σ share scale^(−d) exp(−m²/(2 scale²)) is what the mixture says of a pair (``Errors.log_profile``), ``log_odds``
    what everything else does. The scales are a ladder from 0.13 upwards as far as the residuals reach, and not beyond
    ``widest``; a pseudo-count on the scale 1 keeps a few pairs from saying much.

    Parameters
    ----------
    mahalanobis_sq, log_odds : (m,) squared normalised distances m² in d features, and ln of the odds.
    start : where the search begins.
    """
    cells = _Cells.of(mahalanobis_sq, log_odds)
    rungs = max(4, math.ceil(math.log(cells.reach / 2.0) / math.log(RUNG)) + 1)
    scales = RUNG ** np.arange(LOWEST_RUNG, rungs)
    scales = scales[scales <= max(widest, 1.0)]
    log_part = -0.5 * cells.square[:, None] / scales**2 - d * np.log(scales)
    known = dict(zip(np.round(start.scales, 9), start.shares, strict=True))
    shares = np.array([known.get(round(s, 9), 0.0) for s in scales])
    pseudo = np.where(np.abs(np.log(scales)) < 0.01, 2.0, 0.0)
    mixture = _Mixture(cells.count, np.exp(cells.log_odds[:, None] + log_part), pseudo)
    shares, tail = _standing_out(mixture, mixture.best_shares(shares), scales)
    kept = shares > 1e-6
    return ErrorFit(Errors(tuple(scales[kept].tolist()), tuple((shares[kept] / shares[kept].sum()).tolist())), tail)


def _standing_out(mixture: _Mixture, shares: FloatArray, scales: FloatArray) -> tuple[FloatArray, float]:
    """The shares, without a tail where the data would be nearly as likely without one; and how much less likely."""
    core = scales <= TAIL
    if not shares[~core].any():
        return shares, 0.0
    if not shares[core].any():
        return shares, math.inf
    without = replace(mixture, part=mixture.part[:, core], pseudo=mixture.pseudo[core])
    alone = without.best_shares(shares[core] / shares[core].sum())
    gained = mixture.log_likelihood(shares) - without.log_likelihood(alone)
    if gained > STANDING_OUT:
        return shares, gained
    bare = np.zeros(len(scales))
    bare[core] = alone
    return bare, gained


@dataclass(frozen=True)
class _Cells:
    """Pairs of like distance and odds, taken together: the likelihood depends on nothing else.

    count, square, log_odds : (b,) pairs in each cell, means of their squared distances and log odds.
    reach : the greatest distance.
    """

    count: FloatArray
    square: FloatArray
    log_odds: FloatArray
    reach: float

    @classmethod
    def of(cls, z2: FloatArray, log_odds: FloatArray) -> _Cells:
        """Cells of pairs (m,); those of too little odds are left out."""
        used = log_odds > LEAST_LOG_ODDS
        z2, log_odds = z2[used], np.minimum(log_odds[used], MOST_LOG_ODDS)
        reach, begin = max(math.sqrt(float(z2.max(initial=1.0))), 2.0), math.log(NEAREST)
        along = 0.5 * np.log(np.maximum(z2, NEAREST**2)) - begin
        cell = (along * ((BINS - 1) / (math.log(reach) - begin))).astype(np.int64) * ACROSS
        across = (log_odds - LEAST_LOG_ODDS) * ((ACROSS - 1) / (MOST_LOG_ODDS - LEAST_LOG_ODDS))
        cell += across.astype(np.int64)
        count = np.bincount(cell, minlength=BINS * ACROSS)
        full = np.flatnonzero(count)
        held = count[full].astype(np.float64)
        square, mean = (np.bincount(cell, values, BINS * ACROSS)[full] / held for values in (z2, log_odds))
        return cls(held, square, mean, reach)


@dataclass(frozen=True)
class _Mixture:
    """Cells (b,) of ``count`` pairs, which are true with odds that each component would give, ``part`` (b, k), times
    its share; pseudo-counts (k,) of the components.

    Of n pairs of odds o the likelihood is (1 + o)^n, whose logarithm is concave in the shares: one maximum.
    """

    count: FloatArray
    part: FloatArray
    pseudo: FloatArray

    def log_likelihood(self, shares: FloatArray) -> float:
        """With the prior that the pseudo-counts stand for."""
        log_prior = float(self.pseudo @ np.log(np.maximum(shares, 1e-300)))
        return float(self.count @ np.log1p(self.part @ shares)) + log_prior

    def best_shares(self, shares: FloatArray) -> FloatArray:
        """The shares of greatest likelihood, from any on: a step of EM, which always leads upwards, and one of
        Newton's among shares that are not negative, which leads there at once from near by, in turn."""
        free = (shares > 0.0) | (self.pseudo > 0.0)
        shares, reached = shares + SPREAD, -math.inf
        for _ in range(STEPS):
            slope, bend = self._derivatives(shares)
            shares = np.maximum(shares * slope, 0.0)
            shares /= shares.sum()
            slope, bend = self._derivatives(shares)
            wanted, free = _on_simplex(slope + bend @ shares, bend, free)
            now, best, length = self.log_likelihood(shares), shares, 1.0
            while length > SHORTEST:
                # A share with pseudo-counts is never zero; a parabola does not know that.
                tried = np.maximum(shares + length * (wanted - shares), np.where(self.pseudo > 0.0, 0.1 * shares, 0.0))
                tried /= tried.sum()
                if (there := self.log_likelihood(tried)) > now:
                    now, best = there, tried
                    break
                length *= 0.25
            shares, gained, reached = best, now - reached, now
            if gained < SETTLED:
                break
        return shares

    def _derivatives(self, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(k,) slope and (k, k) negative curvature of the logarithm of the likelihood."""
        held = np.maximum(shares, 1e-100)
        weight = 1.0 / (1.0 + self.part @ shares)
        slope = (self.count * weight) @ self.part + np.where(self.pseudo > 0.0, self.pseudo / held, 0.0)
        bend = (self.part * (self.count * weight**2)[:, None]).T @ self.part
        diagonal = np.where(self.pseudo > 0.0, self.pseudo / held**2, 0.0) + RIDGE * np.trace(bend)
        return slope, bend + np.diag(diagonal)


def _on_simplex(slope: FloatArray, bend: FloatArray, free: BoolArray) -> tuple[FloatArray, BoolArray]:
    """The shares y ≥ 0, Σ y = 1, of greatest slope·y − ½ y·bend·y, and which are not zero; ``free``: a guess."""
    k = len(slope)
    free, size = free.copy(), float(np.abs(slope).max())
    for _ in range(6 * k):
        at = np.flatnonzero(free)
        system = np.ones((len(at) + 1, len(at) + 1))
        system[:-1, :-1], system[-1, -1] = bend[np.ix_(at, at)], 0.0
        solved = np.linalg.solve(system, np.append(slope[at], 1.0))
        if len(at) > 1 and solved[:-1].min() < 0.0:
            free[at[np.argmin(solved[:-1])]] = False
            continue
        shares = np.zeros(k)
        shares[at] = solved[:-1]
        gain = np.where(free, -np.inf, slope - bend @ shares - solved[-1])
        best = int(np.argmax(gain))
        if gain[best] <= 1e-9 * size:
            break
        free[best] = True
    return shares, free
