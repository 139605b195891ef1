"""The covariance of the new reduction of Hipparcos (I/311, "hip2"), which it tells in a hidden way.

The catalogue gives five formal errors σᵢ and the 15 elements ``UW`` of an upper triangular matrix, column by
column. The diagonal elements are scaled by the errors, the others are not:

    Uᵢᵢ = UWᵢᵢ u / σᵢ,   Uᵢⱼ = UWᵢⱼ (i < j, in 1/mas),   covariance C = u² U⁻¹ U⁻ᵀ,

u² the unit weight variance, from the goodness of fit F2 with ν = Ntr − 5 degrees of freedom (Wilson and
Hilferty):

    u² = [ √(2 / 9ν) F2 + 1 − 2 / 9ν ]³

(Michalik, Lindegren, Hobbs and Lammers 2014, A&A 571, A85, appendix B, tell how it is read; this form was
found from the data: √Cᵢᵢ = σᵢ within the rounding of two decimals for solutions of five parameters.) Where
the diagonal does not return the quoted errors (solutions of seven and more parameters, whose further
elements are in other files) the correlations are not known and are left at zero.
"""

from __future__ import annotations

import numpy as np

from sameas.sky.cells import FloatArray

# Rounding of UW to 0.01 moves the diagonal by less than 1 % in 98 % of the five-parameter solutions.
_TOLERANCE = 0.03


def correlations(weights: FloatArray, errors: FloatArray, f2: FloatArray, n_transits: FloatArray) -> FloatArray:
    """(n, 5, 5) correlations of ra*, dec, parallax, pm ra*, pm dec; the identity where they cannot be told.

    weights : (n, 15) UW. errors : (n, 5) quoted formal errors in mas and mas/yr. f2 : (n,) goodness of fit.
    n_transits : (n,) Ntr, the number of field transits used.
    """
    n = len(weights)
    result = np.broadcast_to(np.eye(5), (n, 5, 5)).copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        free = n_transits - 5.0
        variance = (np.sqrt(2 / (9 * free)) * f2 + 1 - 2 / (9 * free)) ** 3
        scaled = _scaled_triangle(weights, errors / np.sqrt(variance)[:, None])
        determinant = scaled[:, range(5), range(5)].prod(axis=1)
    usable = np.flatnonzero(np.isfinite(scaled).all(axis=(1, 2)) & (np.abs(determinant) > 1e-12))
    inverse = np.linalg.inv(scaled[usable])
    covariance = inverse @ inverse.transpose(0, 2, 1)
    deviation = np.sqrt(np.einsum("nii->ni", covariance))
    told = (np.abs(deviation - 1) < _TOLERANCE).all(axis=1)
    spread = deviation[told]
    result[usable[told]] = covariance[told] / (spread[:, :, None] * spread[:, None, :])
    return result


def _scaled_triangle(weights: FloatArray, unscaled_errors: FloatArray) -> FloatArray:
    """(n, 5, 5) the triangle U in units of the errors, U'ᵢⱼ = Uᵢⱼ σⱼ / u: its inverse gives correlations."""
    triangle = np.zeros((len(weights), 5, 5))
    k = 0
    for j in range(5):
        for i in range(j + 1):
            triangle[:, i, j] = weights[:, k] * (unscaled_errors[:, j] if i < j else 1.0)
            k += 1
    return triangle
