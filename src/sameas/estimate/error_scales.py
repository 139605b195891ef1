"""Error scales: by how much residuals spread more or less than their quoted errors, found from pairs.

The spread is a mixture of normals over a ladder of error scales. Its shares have one maximum of the likelihood, so that
errors quoted too small and heavy tails come out of the same estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.evidence import Errors

#: Steps of the ladder of error scales, as a factor; enough for any smooth spread to be mixed from them.
RUNG = 1.5
LOWEST_RUNG = -5.0
#: Where typical errors are not within this of those quoted, in ln, ladders shifted by these parts of a rung are tried.
AS_QUOTED, SHIFTS = 0.1, (1.0 / 3.0, 2.0 / 3.0)
#: Pairs of like distance are counted together, in so many bins from the first distance on, in standard deviations.
BINS, NEAREST = 160, 1e-2
#: Pairs whose log odds are less say nothing of the errors, whatever these are; more is as sure as can be; in so many
#: steps.
LEAST_LOG_ODDS, MOST_LOG_ODDS, ACROSS = -12.0, 30.0, 43
#: The search for the shares stops when ln of the likelihood grows by less than this, or after so many steps.
SETTLED, STEPS = 1e-2, 40
#: Errors larger than so many times the quoted ones are a tail. It must better ln of the likelihood by so much, four
#: standard errors: what chance pairs look like feeds on itself, as more of them are then believed.
TAIL, STANDING_OUT = 2.0, 8.0
#: What every share begins with besides its own: EM never revives one that is zero.
SPREAD = 1e-3
#: Least part of a step, and what is added to the curvature, of its trace: neighbouring normals are much alike.
SHORTEST, RIDGE = 1e-3, 1e-10


@dataclass(frozen=True)
class ErrorFit:
    """The errors, and by how much a tail of them would better ln of the likelihood, whether it stands out or not.

    log_likelihood : of the errors, up to a constant of the pairs.
    """

    errors: Errors
    tail: float
    log_likelihood: float


def fit_errors(
    mahalanobis_sq: FloatArray, log_odds: FloatArray, d: int, start: Errors, *, widest: float = math.inf
) -> ErrorFit:
    """The mixture of error scales of greatest likelihood for pairs that are true with odds of exp(log_odds) · f.

    f = Σ share scale^(−d) exp(−m²/(2 scale²)) is what the mixture says of a pair (``Errors.log_profile``), ``log_odds``
    what everything else does. The scales are a ladder from 0.13 upwards as far as the residuals reach, and not beyond
    ``widest``; a pseudo-count on the scale nearest to 1 keeps a few pairs from saying much. Where errors are typically
    not as quoted, ladders that begin between its rungs are tried too: mixed from two neighbours, one normal would have
    too long a tail, which chance pairs fill.

    Parameters
    ----------
    mahalanobis_sq, log_odds : (m,) squared normalised distances m² in d features, and ln of the odds.
    start : where the search begins.
    """
    reach, cells = _cells(mahalanobis_sq, log_odds)
    fit = _on_ladder(reach, cells, d, start, widest, 0.0)
    if abs(math.log(fit.errors.typical_scale)) < AS_QUOTED:
        return fit
    others = [_on_ladder(reach, cells, d, fit.errors, widest, shift) for shift in SHIFTS]
    return max(fit, *others, key=lambda fit: fit.log_likelihood)


def _on_ladder(
    reach: float, cells: tuple[NDArray, ...], d: int, start: Errors, widest: float, shift: float
) -> ErrorFit:
    """The likeliest mixture of one ladder, whose rungs stand ``shift`` of one higher than 1, 1.5, …"""
    from sameas.kernels.mixture import fit

    rungs = max(4, math.ceil(math.log(reach / 2.0) / math.log(RUNG)) + 1)
    steps = np.arange(LOWEST_RUNG, rungs) + shift
    scales = RUNG**steps
    scales = scales[scales <= max(widest, RUNG**shift)]
    nearest = np.round(np.log(np.asarray(start.scales)) / math.log(RUNG) - steps[0])
    at = nearest.clip(0, len(scales) - 1).astype(np.int64)
    shares = np.asarray(np.bincount(at, start.shares, len(scales)), np.float64)
    core, pseudo = int(np.searchsorted(scales, TAIL, side="right")), np.zeros(len(scales))
    pseudo[np.argmin(np.abs(np.log(scales)))] = 2.0
    search = SPREAD, STEPS, SETTLED, SHORTEST, RIDGE
    shares, tail, likelihood = fit(*cells, d, scales, core, pseudo, shares, STANDING_OUT, search)
    kept = shares > 1e-6
    errors = Errors(tuple(scales[kept].tolist()), tuple((shares[kept] / shares[kept].sum()).tolist()))
    return ErrorFit(errors, tail, likelihood)


def _cells(z2: FloatArray, log_odds: FloatArray) -> tuple[float, tuple[NDArray, ...]]:
    """How far the pairs (m,) reach, but for those of too little odds, and these in cells of like distance and odds."""
    from sameas.kernels.mixture import cells

    furthest = float(z2.max(initial=1.0, where=log_odds > LEAST_LOG_ODDS))
    reach = max(math.sqrt(furthest), 2.0)
    return reach, cells(z2, log_odds, LEAST_LOG_ODDS, MOST_LOG_ODDS, NEAREST, reach, (BINS, ACROSS))
