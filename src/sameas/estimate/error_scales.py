"""Error scales: the distribution of residuals relative to their errors, a mixture of normals over a ladder of scales.

Its likelihood in the shares has one maximum, and it covers both underestimated errors and heavy tails.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.evidence import Errors

#: Step of the ladder of scales, as a factor, fine enough for any smooth distribution; and its lowest rung, in steps
#: from 1.
RUNG, LOWEST = 1.5, -5.0
#: If the typical scale differs from 1 by more than this, in ln, ladders shifted by these fractions of a rung are tried
#: too.
MAX_LOG_SCALE = 0.1
SHIFTS = (1.0 / 3.0, 2.0 / 3.0)
BINS, MIN_DISTANCE = 160, 1e-2  # pairs are binned by distance, from this distance on, in standard deviations
#: Pairs below these log odds are ignored; larger odds are clipped; number of bins.
MIN_LOG_ODDS, MAX_LOG_ODDS, LOG_ODDS_BINS = -12.0, 30.0, 43
TOLERANCE, MAX_STEPS = 1e-2, 40  # the fit ends when ln likelihood grows by less than this, or after this many steps
INITIAL_SHARE = 1e-3  # added to every share at the beginning, since EM never changes a share of zero
#: Smallest fraction of a step; and the addition to the curvature, relative to its trace, because neighbouring normals
#: are nearly degenerate.
MIN_STEP, RIDGE = 1e-3, 1e-10


#: Errors larger than this scale are a tail, and it must gain this in ln likelihood (four standard errors). A tail with
#: chance pairs in it would grow from step to step, as it makes more of them probable.
TAIL_SCALE, SIGNIFICANT_TAIL_GAIN = 2.0, 8.0

#: Starts of the bins of distance, counts and odds of the cells in them, mean squared distances of the bins.
BinnedPairs = tuple[IntArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class ErrorFit:
    """The fitted errors, and the gain in ln likelihood from a tail, whether significant or not.

    log_likelihood : of the errors, up to a constant of the pairs.
    """

    errors: Errors
    tail_gain: float
    log_likelihood: float


def fit_errors(
    mahalanobis_sq: FloatArray,
    log_odds: FloatArray,
    d: int,
    start: Errors,
    *,
    widest: float = math.inf,
    significant_tail_gain: float = SIGNIFICANT_TAIL_GAIN,
) -> ErrorFit:
    """The mixture of error scales of greatest likelihood for pairs that are true with odds exp(log_odds) · f.

    f = Σ share scale^(−d) exp(−m²/(2 scale²)) is the mixture's factor for a pair (``Errors.log_profile``); ``log_odds``
    contains all other evidence. The ladder of scales reaches from 0.13 to the largest residual, or to ``widest``; a
    pseudo-count on the scale nearest to 1 limits the effect of few pairs. If the typical scale is not near 1, shifted
    ladders are tried too: one normal mixed from two neighbouring rungs has too long a tail, which chance pairs fill.

    mahalanobis_sq, log_odds : (m,) squared normalised distances m² in d features, and ln of the odds.
    start : initial mixture. significant_tail_gain : gain in ln likelihood from which a tail is accepted.
    """
    reach, cells = _binned(mahalanobis_sq, log_odds)
    fit = _on_ladder(reach, cells, d, start, widest, 0.0, significant_tail_gain)
    if abs(math.log(fit.errors.typical_scale)) < MAX_LOG_SCALE:
        return fit
    others = [_on_ladder(reach, cells, d, fit.errors, widest, shift, significant_tail_gain) for shift in SHIFTS]
    return max(fit, *others, key=lambda fit: fit.log_likelihood)


def _on_ladder(
    reach: float, cells: BinnedPairs, d: int, start: Errors, widest: float, shift: float, significant_tail_gain: float
) -> ErrorFit:
    """The maximum-likelihood mixture of the grid of scales ``shift`` of a step above 1, 1.5, …"""
    from sameas.kernels.mixture import fit

    rungs = max(4, math.ceil(math.log(reach / 2.0) / math.log(RUNG)) + 1)
    steps = np.arange(LOWEST, rungs) + shift
    scales = RUNG**steps
    scales = scales[scales <= max(widest, RUNG**shift)]
    nearest = np.round(np.log(np.asarray(start.scales)) / math.log(RUNG) - steps[0])
    at = nearest.clip(0, len(scales) - 1).astype(np.int64)
    shares = np.asarray(np.bincount(at, start.shares, len(scales)), np.float64)
    core, pseudo = int(np.searchsorted(scales, TAIL_SCALE, side="right")), np.zeros(len(scales))
    pseudo[np.argmin(np.abs(np.log(scales)))] = 2.0
    search = INITIAL_SHARE, MAX_STEPS, TOLERANCE, MIN_STEP, RIDGE
    shares, tail, likelihood = fit(*cells, d, scales, core, pseudo, shares, significant_tail_gain, search)
    kept = shares > 1e-6
    errors = Errors(tuple(scales[kept].tolist()), tuple((shares[kept] / shares[kept].sum()).tolist()))
    return ErrorFit(errors, tail, likelihood)


def _binned(z2: FloatArray, log_odds: FloatArray) -> tuple[float, BinnedPairs]:
    """The largest normalised distance of pairs (m,) with sufficient odds, and pairs binned by distance and odds."""
    from sameas.kernels.mixture import cells

    farthest = float(z2.max(initial=1.0, where=log_odds > MIN_LOG_ODDS))
    reach = max(math.sqrt(farthest), 2.0)
    return reach, cells(z2, log_odds, MIN_LOG_ODDS, MAX_LOG_ODDS, MIN_DISTANCE, reach, (BINS, LOG_ODDS_BINS))
