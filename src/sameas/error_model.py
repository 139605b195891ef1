"""Error model: which source's quoted errors are too small, and by how much; a diagnostic, from identified pairs.

With the covariance of a pair modelled as

    S = a₁² Σ₁ + a₂² Σ₂ + f² 1

the factors a₁, a₂ and the floor f are found by maximum likelihood (Fisher scoring) over the pairs, weighted by their
posterior. What lies beyond the 99 % radius of the model is a tail and left out, its absence accounted for. Only the
variation of Σ₁, Σ₂ from pair to pair tells the terms apart: where it does not, that is said. Two floors, one of each
source, look the same as one of both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.chisquare import quantile, share_within
from sameas.quantity import Quantity
from sameas.records import FloatArray, unpack
from sameas.result import Identification

#: Pairs learned from: at least, in expectation, and at most.
FEWEST, ENOUGH = 200.0, 5_000
CORE = 0.99
STEPS, SETTLED = 60, 1e-6
#: A factor whose standard error is larger than this share of it is not told from the others.
TELLING = 0.25


@dataclass(frozen=True)
class ErrorModel:
    """Factors on the quoted errors of either source and a floor of both together, in the unit of the residuals.

    factor_1, factor_2, floor : None where the data cannot tell them apart; ``note`` then says why.
    """

    factor_1: Quantity | None
    factor_2: Quantity | None
    floor: Quantity | None
    note: str = ""


def error_model(answer: Identification) -> ErrorModel:
    """The error model of the pairs of an answer.

    Example
    -------
    >>> error_model(match(plate, gaia)[0]).factor_1  # doctest: +SKIP
    Quantity(value=1.68, standard_error=0.04, unit='')
    """
    pairs = answer.pairs
    told = np.flatnonzero(answer.p_pair > 0.5)
    told = told[:: max(1, -(-len(told) // ENOUGH))]
    weight = answer.p_pair[told]
    if weight.sum() < FEWEST:
        return ErrorModel(
            None, None, None, f"fewer than {FEWEST:.0f} pairs: too few to judge the sources' errors apart"
        )
    one = unpack(pairs.first.covariance[pairs.i[told]], pairs.d)
    two = unpack(pairs.second.covariance[pairs.j[told]], pairs.d)
    # The floor is counted in a typical variance of the pairs.
    unit = float(np.median(np.einsum("mvv->m", one + two)) / pairs.d)
    parts = np.stack([one, two, np.broadcast_to(unit * np.eye(pairs.d), one.shape)])
    return _told(*_fit(pairs.residual[told], parts, weight), unit)


def _fit(residual: FloatArray, parts: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """(3,) variances' factors, and their covariance; None where the information has no inverse.

    residual (m, d), parts (3, m, d, d).
    """
    d = residual.shape[1]
    limit = quantile(CORE, d)
    # What the mean square of a normal loses where its tail is cut off.
    kept = share_within(limit, d + 2) / CORE
    theta, damping = np.array([1.0, 1.0, 0.05]), 0.5
    for _ in range(STEPS):
        inverse = np.linalg.inv(np.einsum("k,kmvw->mvw", theta, parts))
        scaled = np.einsum("mvw,mw->mv", inverse, residual)
        core = weight * ((scaled * residual).sum(axis=1) <= limit)
        square = np.einsum("mv,kmvw,mw->km", scaled, parts, scaled) / kept
        along = np.einsum("mvw,kmwx->kmvx", inverse, parts)
        score = 0.5 * ((square - np.einsum("kmvv->km", along)) * core).sum(axis=1)
        information = 0.5 * np.einsum("m,kmvw,lmwv->kl", core, along, along)
        free = (theta > 1e-9) | (score > 0.0)
        step = np.zeros(3)
        step[free] = np.linalg.lstsq(information[np.ix_(free, free)], score[free], rcond=1e-9)[0]
        before, theta = theta, np.maximum(theta + damping * step, 1e-9 * (theta + damping * step > -1.0))
        damping = 1.0
        if np.abs(theta - before).max() < SETTLED * max(1.0, float(theta.max())):
            break
    scale = np.sqrt(np.diag(information))
    normal = information / np.outer(scale, scale)
    if np.linalg.eigvalsh(normal)[0] < 1e-6:
        return theta, None
    covariance = np.linalg.inv(normal) / np.outer(scale, scale)
    # A term that is held at zero takes nothing from what is known of the others.
    free = theta > 1e-6
    held = np.diag(np.diag(covariance))
    held[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
    return theta, held * _widened(d, limit, kept)


def _widened(d: int, limit: float, kept: float) -> float:
    """How much larger the variance of a common factor of all variances is because of the core, against 1/information.

    With the squares x ~ χ²_d and the core x ≤ θL the factor θ solves Σ_core (x/(θ kept) − d) = 0; its variance is
    V / J², V that of a pair's part in the sum and J the slope of its mean, in which the border of the core takes part.
    """
    variance = d * (d + 2) * share_within(limit, d + 4) / kept**2 - CORE * d**2
    log_density = (0.5 * d - 1.0) * math.log(limit) - 0.5 * limit - 0.5 * d * math.log(2.0) - math.lgamma(0.5 * d)
    slope = CORE * d - limit * math.exp(log_density) * (limit / kept - d)
    return variance / slope**2 * 0.5 * d * CORE


def _told(theta: FloatArray, covariance: FloatArray | None, unit: float) -> ErrorModel:
    """Factors and floor, where they can be told apart."""
    apart = "the quoted errors vary too little, or too much alike, from pair to pair to judge the sources apart"
    if covariance is None:
        return ErrorModel(None, None, None, apart)
    roots, spread = np.sqrt(theta), _root_errors(theta, np.sqrt(np.diag(covariance)))
    factors = [Quantity(float(roots[k]), float(spread[k])) for k in range(2)]
    known = [q if q.standard_error < TELLING * max(q.value, 1.0) else None for q in factors]
    floor = Quantity(float(roots[2]) * math.sqrt(unit), float(spread[2]) * math.sqrt(unit))
    if known == [None, None]:
        return ErrorModel(None, None, None, apart)
    return ErrorModel(known[0], known[1], floor, "" if all(known) else apart)


def _root_errors(theta: FloatArray, errors: FloatArray) -> FloatArray:
    """Standard errors of √θ, from those of θ ≥ 0: how far the root moves at most when θ does by its own.

    Where θ is zero within its error its root is not normal, and to first order its error would be nearly none.
    """
    ends = (np.sqrt(np.maximum(theta + side * errors, 0.0)) for side in (-1.0, 1.0))
    return np.asarray(np.max([np.abs(end - np.sqrt(theta)) for end in ends], axis=0))
