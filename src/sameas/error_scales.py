"""Error scales: by how much residuals spread more or less than their quoted errors, found from pairs.

The spread is a mixture of normals over a ladder of error scales. Its shares have one maximum of the likelihood, so that
errors quoted too small and heavy tails come out of the same estimate.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.evidence import Errors
from sameas.records import FloatArray

#: Steps of the ladder of error scales, as a factor; enough for any smooth spread to be mixed from them.
RUNG = 1.5
LOWEST_RUNG = -5.0
#: Pairs of like distance are counted together, in so many bins from the first distance on, in standard deviations.
BINS, NEAREST = 400, 1e-3
#: Pairs less probable than this say nothing of the errors.
PROBABLE = 1e-3
#: The search for the shares stops at steps smaller than this, far below their standard errors, or after so many.
SETTLED, STEPS = 1e-5, 100
#: What a share that was zero starts from: EM would leave it at zero.
REVIVED = 1e-4


def fit_errors(
    mahalanobis_sq: FloatArray, weights: FloatArray, d: int, start: Errors, *, widest: float = math.inf
) -> Errors:
    """The mixture of error scales of greatest likelihood for residuals of the given posterior weights.

    The scales are a ladder from 0.13 upwards as far as the residuals reach, and not beyond ``widest``; a pseudo-count
    on the scale 1 keeps a few pairs from saying much.

    Parameters
    ----------
    mahalanobis_sq, weights : (m,) squared normalised distances in d features, and the probabilities of the pairs.
    start : where the search begins.
    """
    used = weights > PROBABLE
    z2, weight = mahalanobis_sq[used], weights[used]
    reach = max(math.sqrt(float(z2.max(initial=1.0))), 2.0)
    rungs = max(4, math.ceil(math.log(reach / 2.0) / math.log(RUNG)) + 1)
    scales = RUNG ** np.arange(LOWEST_RUNG, rungs)
    scales = scales[scales <= max(widest, 1.0)]
    count, centre = _counted(z2, weight, reach)
    log_part = -0.5 * centre[:, None] / scales**2 - d * np.log(scales)
    part = np.exp(log_part - log_part.max(axis=1, keepdims=True))
    known = dict(zip(np.round(start.scales, 9), start.shares, strict=True))
    shares = np.array([known.get(round(s, 9), 0.0) for s in scales]) + REVIVED
    pseudo = 2.0 * (np.abs(np.log(scales)) < 0.01)
    shares = _accelerated(_Mixture(count, part, pseudo), shares / shares.sum())
    kept = shares > 1e-6
    return Errors(tuple(scales[kept].tolist()), tuple((shares[kept] / shares[kept].sum()).tolist()))


def _counted(z2: FloatArray, weight: FloatArray, reach: float) -> tuple[FloatArray, FloatArray]:
    """Weight and mean squared distance of the bins that hold any: the likelihood depends on nothing else."""
    begin = math.log(NEAREST)
    along = 0.5 * np.log(np.maximum(z2, NEAREST**2))
    bins = ((along - begin) * ((BINS - 1) / (math.log(reach) - begin))).astype(np.int64)
    count = np.bincount(bins, weight, BINS)
    full = count > 0.0
    return count[full], np.bincount(bins, weight * z2, BINS)[full] / count[full]


class _Mixture:
    """Counts (b,) of bins whose densities by the components are ``part`` (b, k), and pseudo-counts (k,)."""

    def __init__(self, count: FloatArray, part: FloatArray, pseudo: FloatArray) -> None:
        self.count, self.part, self.pseudo = count, part, pseudo

    def improved(self, shares: FloatArray) -> FloatArray:
        """One step of EM."""
        owned = self.count / np.maximum(self.part @ shares, 1e-300)
        shares = shares * (owned @ self.part) + self.pseudo
        return shares / shares.sum()

    def log_likelihood(self, shares: FloatArray) -> float:
        """With the prior that the pseudo-counts stand for."""
        log_prior = self.pseudo @ np.log(np.maximum(shares, 1e-300))
        return float(self.count @ np.log(np.maximum(self.part @ shares, 1e-300)) + log_prior)


def _accelerated(mixture: _Mixture, shares: FloatArray) -> FloatArray:
    """Where EM leads, reached by squared extrapolation (Varadhan & Roland 2008, Scand. J. Statist. 35, 335, S3)."""
    for _ in range(STEPS):
        once = mixture.improved(shares)
        twice = mixture.improved(once)
        if np.abs(twice - shares).max() < SETTLED:
            return twice
        step, bend = once - shares, (twice - once) - (once - shares)
        length = max(1.0, float(np.linalg.norm(step) / max(np.linalg.norm(bend), 1e-300)))
        # A share that the leap would take below zero stays a little above it, or it could not come back.
        leap = np.maximum(shares + 2.0 * length * step + length**2 * bend, 1e-3 * twice)
        leap = mixture.improved(leap / leap.sum())
        shares = leap if mixture.log_likelihood(leap) >= mixture.log_likelihood(twice) else twice
    return shares
