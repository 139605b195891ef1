"""The distribution of residuals about their quoted covariances."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.gate import Pairs

#: Pairs in one batch, which fits into the cache.
BATCH = 16_384


@dataclass(frozen=True)
class Errors:
    """How residuals spread about their quoted covariances: a mixture of normals N(0, scale²·Σ).

    ``Errors()`` takes the quoted errors as they are. ``Errors(scales=(1.4, 6.0), shares=(0.95, 0.05))`` says that they
    are 1.4 times too small, and that one pair in twenty has errors 6 times larger than quoted (a heavy tail).
    """

    scales: tuple[float, ...] = (1.0,)
    shares: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        if len(self.scales) != len(self.shares) or not self.scales:
            raise InputError(
                f"Errors: {len(self.scales)} scales but {len(self.shares)} shares; give one share per scale"
            )
        positive = all(0.0 < scale < math.inf for scale in self.scales) and all(share >= 0.0 for share in self.shares)
        if not positive or abs(sum(self.shares) - 1.0) > 1e-6:
            raise InputError("Errors: scales must be positive, and shares non-negative with the sum 1")

    @property
    def typical_scale(self) -> float:
        """The factor by which the quoted errors must be multiplied for the typical pair: the median of the scales."""
        order = np.argsort(self.scales)
        shares, logs = np.asarray(self.shares)[order], np.log(np.asarray(self.scales)[order])
        return float(np.exp(np.interp(0.5, np.cumsum(shares) - 0.5 * shares, logs)))

    def log_density(self, pairs: Pairs) -> FloatArray:
        """(m,) ln of the density of the residuals [F14, T17, for one component of scale 1]."""
        if self.scales == (1.0,):
            return pairs.log_peak - 0.5 * pairs.mahalanobis_sq
        return pairs.log_peak + self.log_profile(pairs.mahalanobis_sq, pairs.d)

    def log_profile(self, mahalanobis_sq: FloatArray, d: int) -> FloatArray:
        """(m,) ln Σ_k share_k scale_k^(−d) exp(−m²/(2 scale_k²)): what replaces exp(−m²/2) of one normal."""
        parts = [(scale, share) for scale, share in zip(self.scales, self.shares, strict=True) if share > 0.0]
        widest = max(scale for scale, _ in parts)
        profile = np.empty(len(mahalanobis_sq))
        # Relative to the widest normal no density overflows or underflows a double.
        for begin in range(0, len(profile), BATCH):
            half = -0.5 * mahalanobis_sq[begin : begin + BATCH]
            total = np.zeros(len(half))
            for scale, share in parts:
                total += share * scale**-d * np.exp(half * (scale**-2 - widest**-2))
            profile[begin : begin + BATCH] = np.log(total) + half * widest**-2
        return profile


#: The quoted errors as they are.
AS_QUOTED = Errors()
