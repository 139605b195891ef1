"""Error scales: by how much residuals spread more or less than their quoted errors, found from pairs.

The spread is a mixture of normals over a ladder of error scales. Its shares have one maximum of the likelihood, so that
errors quoted too small and heavy tails come out of the same estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.evidence import Errors


@dataclass(frozen=True)
class ScalesTuning:
    """How the mixture of error scales is found.

    Attributes
    ----------
    rung, lowest : the step of the ladder, as a factor, fine enough for any smooth spread to be mixed from it; and how
        many steps below 1 it begins.
    as_quoted, shifts : where typical errors are not within this of those quoted, in ln, ladders shifted by these parts
        of a rung are tried.
    bins, nearest : pairs of like distance are counted together, in so many bins from this distance on, in standard
        deviations.
    least_log_odds, most_log_odds, across : pairs of smaller log odds say nothing of the errors, whatever these are;
        greater are as sure as can be; in so many steps.
    settled, steps : the search for the shares stops when ln of the likelihood grows by less than this, or after so many
        steps.
    tail, standing_out : errors larger than so many times the quoted ones are a tail. It must better ln of the
        likelihood by so much, four standard errors: what chance pairs look like feeds on itself, as more of them are
        then believed.
    spread : what every share begins with besides its own: EM never revives one that is zero.
    shortest, ridge : least part of a step, and what is added to the curvature, of its trace: neighbouring normals are
        much alike.
    """

    rung: float = 1.5
    lowest: float = -5.0
    as_quoted: float = 0.1
    shifts: tuple[float, ...] = (1.0 / 3.0, 2.0 / 3.0)
    bins: int = 160
    nearest: float = 1e-2
    least_log_odds: float = -12.0
    most_log_odds: float = 30.0
    across: int = 43
    settled: float = 1e-2
    steps: int = 40
    tail: float = 2.0
    standing_out: float = 8.0
    spread: float = 1e-3
    shortest: float = 1e-3
    ridge: float = 1e-10


DEFAULT_SCALES = ScalesTuning()


@dataclass(frozen=True)
class ErrorFit:
    """The errors, and by how much a tail of them would better ln of the likelihood, whether it stands out or not.

    log_likelihood : of the errors, up to a constant of the pairs.
    """

    errors: Errors
    tail: float
    log_likelihood: float


def fit_errors(
    mahalanobis_sq: FloatArray,
    log_odds: FloatArray,
    d: int,
    start: Errors,
    *,
    widest: float = math.inf,
    tuning: ScalesTuning = DEFAULT_SCALES,
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
    reach, cells = _cells(mahalanobis_sq, log_odds, tuning)
    fit = _on_ladder(reach, cells, d, start, widest, 0.0, tuning)
    if abs(math.log(fit.errors.typical_scale)) < tuning.as_quoted:
        return fit
    others = [_on_ladder(reach, cells, d, fit.errors, widest, shift, tuning) for shift in tuning.shifts]
    return max(fit, *others, key=lambda fit: fit.log_likelihood)


def _on_ladder(
    reach: float,
    cells: tuple[NDArray[Any], ...],
    d: int,
    start: Errors,
    widest: float,
    shift: float,
    tuning: ScalesTuning,
) -> ErrorFit:
    """The likeliest mixture of one ladder, whose rungs stand ``shift`` of one higher than 1, 1.5, …"""
    from sameas.kernels.mixture import fit

    rungs = max(4, math.ceil(math.log(reach / 2.0) / math.log(tuning.rung)) + 1)
    steps = np.arange(tuning.lowest, rungs) + shift
    scales = tuning.rung**steps
    scales = scales[scales <= max(widest, tuning.rung**shift)]
    nearest = np.round(np.log(np.asarray(start.scales)) / math.log(tuning.rung) - steps[0])
    at = nearest.clip(0, len(scales) - 1).astype(np.int64)
    shares = np.asarray(np.bincount(at, start.shares, len(scales)), np.float64)
    core, pseudo = int(np.searchsorted(scales, tuning.tail, side="right")), np.zeros(len(scales))
    pseudo[np.argmin(np.abs(np.log(scales)))] = 2.0
    search = tuning.spread, tuning.steps, tuning.settled, tuning.shortest, tuning.ridge
    shares, tail, likelihood = fit(*cells, d, scales, core, pseudo, shares, tuning.standing_out, search)
    kept = shares > 1e-6
    errors = Errors(tuple(scales[kept].tolist()), tuple((shares[kept] / shares[kept].sum()).tolist()))
    return ErrorFit(errors, tail, likelihood)


def _cells(z2: FloatArray, log_odds: FloatArray, tuning: ScalesTuning) -> tuple[float, tuple[NDArray[Any], ...]]:
    """How far the pairs (m,) reach, but for those of too little odds, and these in cells of like distance and odds."""
    from sameas.kernels.mixture import cells

    furthest = float(z2.max(initial=1.0, where=log_odds > tuning.least_log_odds))
    reach = max(math.sqrt(furthest), 2.0)
    return reach, cells(
        z2, log_odds, tuning.least_log_odds, tuning.most_log_odds, tuning.nearest, reach, (tuning.bins, tuning.across)
    )
