"""Accuracy: the standard deviations behind the classes in which transponders state how good their positions are.

ADS-B states radii of 95 % (NACp), bounds that are exceeded almost never (NIC), or the older NUCp; AIS one bit. A radius
r that holds 95 % of a round Gaussian is 2.45 σ: P(ρ < r) = 1 − exp(−r²/2σ²). All of it is the accuracy of the
transponder's navigation, not of its clock or its transmission.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray

#: Radius of 95 % over the standard deviation of one axis: sqrt(−2 ln 0.05).
RADIUS_95 = float(np.sqrt(-2.0 * np.log(0.05)))
#: Radii of 95 % in metres by NACp 0 to 11 (RTCA DO-260B): 10 NM is class 1, 3 m class 11.
_NACP_M = (np.nan, 18520.0, 7408.0, 3704.0, 1852.0, 926.0, 555.6, 185.2, 92.6, 30.0, 10.0, 3.0)
#: Containment radii in metres by NIC 0 to 11 (DO-260B).
_NIC_M = (np.nan, 37040.0, 14816.0, 7408.0, 3704.0, 1852.0, 1111.2, 370.4, 185.2, 75.0, 25.0, 7.5)
#: Radii of 95 % in metres by NUCp 0 to 9 (DO-260).
_NUCP_M = (np.nan, 18520.0, 9260.0, 1852.0, 926.0, 463.0, 185.2, 92.6, 10.0, 3.0)
#: Errors of 95 % of the horizontal velocity in m/s by NACv 0 to 4 (DO-260B).
_NACV_M_PER_S = (np.nan, 10.0, 3.0, 1.0, 0.3)
#: 1σ in metres per axis by the accuracy bit of AIS (ITU-R M.1371: within 10 m or not; without it that of ships' GNSS).
AIS_SIGMA_M = {True: 5.0, False: 15.0}
#: 1σ in metres per axis of AIS positions that are dead reckoned or entered by hand (chosen).
AIS_RECKONED_SIGMA_M = 100.0


def sigma_of_nacp(nacp: ArrayLike) -> FloatArray:
    """(n,) metres per axis, of navigation accuracy categories; NaN where the class is 0, not known or reserved.

    Example
    -------
    >>> sigma_of_nacp([9, 8, 0]).round(1).tolist()
    [12.3, 37.8, nan]
    """
    return _looked_up(_NACP_M, nacp) / RADIUS_95


def sigma_of_nucp(nucp: ArrayLike) -> FloatArray:
    """(n,) metres per axis, of the uncertainty categories of version 0; NaN as for :func:`sigma_of_nacp`."""
    return _looked_up(_NUCP_M, nucp) / RADIUS_95


def sigma_of_containment(radius_m: ArrayLike) -> FloatArray:
    """(n,) metres per axis, of containment radii Rc, for transponders that state nothing else.

    Rc is exceeded almost never, and not a multiple of the error; the classes of DO-260 that state both have half of it
    as their radius of 95 %, and so do we. Zero or less means not known.
    """
    radius = np.asarray(radius_m, dtype=np.float64)
    return np.where(radius > 0.0, 0.5 * radius / RADIUS_95, np.nan)


def sigma_of_nic(nic: ArrayLike) -> FloatArray:
    """(n,) metres per axis, of navigation integrity categories; see :func:`sigma_of_containment`."""
    return sigma_of_containment(_looked_up(_NIC_M, nic))


def sigma_of_nacv(nacv: ArrayLike) -> FloatArray:
    """(n,) metres per second per axis, of velocity accuracy categories; NaN as for :func:`sigma_of_nacp`."""
    return _looked_up(_NACV_M_PER_S, nacv) / RADIUS_95


def round_covariance(sigma: ArrayLike) -> FloatArray:
    """(n, 3) xx, xy, yy of errors that are alike in all directions; NaN where sigma is."""
    variance = np.square(np.asarray(sigma, dtype=np.float64))
    return np.stack([variance, np.where(np.isnan(variance), np.nan, 0.0), variance], axis=-1)


def _looked_up(table: tuple[float, ...], classes: ArrayLike) -> FloatArray:
    values = np.append(np.asarray(table), np.nan)
    classes = np.asarray(classes, dtype=np.float64)
    known = np.isfinite(classes) & (classes >= 0) & (classes < len(table))
    return np.asarray(values[np.where(known, classes, len(table)).astype(np.int64)])
