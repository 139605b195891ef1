"""The χ² distribution: closed forms in two dimensions, where most of our work is, SciPy's functions elsewhere.

SciPy is imported where it is needed only: it takes longer than many a match.
"""

from __future__ import annotations

import math


def quantile(share: float, d: int) -> float:
    """The squared length that a share of normal vectors in d dimensions does not exceed.

    >>> round(quantile(0.99, 2), 4)
    9.2103
    """
    if d == 2:
        return -2.0 * math.log1p(-share)
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(0.5 * d, share))


def upper_quantile(share: float, d: int) -> float:
    """The squared length that a share of normal vectors in d dimensions exceeds; exact for the smallest shares."""
    if d == 2:
        return -2.0 * math.log(share)
    from scipy.special import gammainccinv

    return 2.0 * float(gammainccinv(0.5 * d, share))
