"""Polynomials of two variables that carry pixels to the tangent plane, and their form in FITS headers (SIP)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sameas.records import FloatArray
from sameas.sky.frame.tangent import Pointing, directions_deg
from sameas.space import ARCSEC_PER_RADIAN

if TYPE_CHECKING:
    from astropy.wcs import WCS

#: The reverse of a SIP polynomial is itself no polynomial: its order grows until it is so near over the frame, px.
REVERSE_PX, REVERSE_HIGHEST = 0.002, 9


def terms(order: int) -> list[tuple[int, int]]:
    """The exponents (a, b) of uᵃ vᵇ up to an order: (0, 0), (1, 0), (0, 1), (2, 0), …"""
    return [(total - b, b) for total in range(order + 1) for b in range(total + 1)]


@dataclass(frozen=True)
class Polynomial:
    """(ξ, η) = Σ c_ab uᵃ vᵇ, (u, v) = (x − middle_px)/unit_px; ``coefficients`` (2, q) as in :func:`terms`."""

    coefficients: FloatArray
    middle_px: FloatArray
    unit_px: float
    order: int

    @classmethod
    def linear(cls, pointing: Pointing, middle_px: FloatArray, unit_px: float, order: int) -> Polynomial:
        """A pointing as a polynomial, arcsec; the higher terms are zero."""
        coefficients = np.zeros((2, len(terms(order))))
        cd = pointing.cd * ARCSEC_PER_RADIAN
        coefficients[:, 0] = cd @ (middle_px - pointing.origin_px)
        coefficients[:, 1:3] = cd * unit_px
        return cls(coefficients, middle_px, unit_px, order)

    def with_coefficients(self, coefficients: FloatArray) -> Polynomial:
        """The same with other coefficients (2, q)."""
        return replace(self, coefficients=coefficients)

    def basis(self, px: FloatArray) -> FloatArray:
        """(n, q) the terms at pixels (n, 2)."""
        u, v = ((px - self.middle_px) / self.unit_px).T
        return np.stack([u**a * v**b for a, b in terms(self.order)], axis=1)

    def __call__(self, px: FloatArray) -> FloatArray:
        """(n, 2) ξ, η at pixels (n, 2)."""
        return np.asarray(self.basis(px) @ self.coefficients.T)

    def slope(self, px: FloatArray) -> FloatArray:
        """(n, 2, 2) ∂(ξ, η)/∂(x, y)."""
        u, v = ((px - self.middle_px) / self.unit_px).T
        along_u = np.stack([a * u ** max(a - 1, 0) * v**b for a, b in terms(self.order)], axis=1)
        along_v = np.stack([b * u**a * v ** max(b - 1, 0) for a, b in terms(self.order)], axis=1)
        return np.stack([along_u @ self.coefficients.T, along_v @ self.coefficients.T], axis=2) / self.unit_px

    def inverse(self, plane: FloatArray) -> FloatArray:
        """(n, 2) the pixels of points ξ, η by Newton's method; NaN where there is none within reach."""
        linear = self.coefficients[:, 1:3] / self.unit_px
        px = self.middle_px + (plane - self.coefficients[:, 0]) @ np.linalg.inv(linear).T
        if self.order == 1:
            return np.asarray(px)
        # Far outside the frame a polynomial folds back: what lies two frames away has no place.
        reached = np.flatnonzero(np.abs(px - self.middle_px).max(axis=1) < 4 * self.unit_px)
        at = px[reached]
        for _ in range(20):
            slope = self.slope(at)
            good = np.abs(slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]) > 1e-12
            reached, at = reached[good], at[good]
            step = np.linalg.solve(slope[good], (self(at) - plane[reached])[:, :, None])[:, :, 0]
            # A step as long as the frame is lost on its way: it may not run off to infinity.
            at = at - np.clip(step, -self.unit_px, self.unit_px)
            if np.abs(step).max(initial=0.0) < 1e-9:
                break
        found = np.abs(self(at) - plane[reached]).max(axis=1) < 1e-4
        px = np.full_like(px, np.nan)
        px[reached[found]] = at[found]
        return np.asarray(px)

    def about(self, origin_px: FloatArray) -> FloatArray:
        """(2, q) coefficients of powers of pixels from another origin: Σ d_ab (x − x₀)ᵃ (y − y₀)ᵇ."""
        shift = (origin_px - self.middle_px) / self.unit_px
        place = {term: i for i, term in enumerate(terms(self.order))}
        moved = np.zeros_like(self.coefficients)
        for i, (a, b) in enumerate(terms(self.order)):
            for k in range(a + 1):
                for l in range(b + 1):
                    share = math.comb(a, k) * math.comb(b, l) * shift[0] ** (a - k) * shift[1] ** (b - l)
                    moved[:, place[k, l]] += share * self.coefficients[:, i] / self.unit_px ** (k + l)
        return moved


def sip(polynomial: Polynomial, centre: FloatArray, shape: tuple[int, int]) -> WCS:
    """An astropy WCS of a polynomial (arcsec) on the plane at ``centre``: TAN, or TAN-SIP with both directions."""
    from astropy.wcs import WCS, Sip

    origin = polynomial.inverse(np.zeros((1, 2)))[0]
    coefficients = polynomial.about(origin)
    cd = coefficients[:, 1:3]
    wcs = WCS(naxis=2)
    kind = "" if polynomial.order == 1 else "-SIP"
    wcs.wcs.ctype, wcs.wcs.cunit, wcs.wcs.radesys = [f"RA---TAN{kind}", f"DEC--TAN{kind}"], ["deg", "deg"], "ICRS"
    wcs.wcs.crval, wcs.wcs.crpix = [float(angle) for angle in directions_deg(centre)], list(origin + 1.0)
    wcs.wcs.cd = cd / 3600.0
    if polynomial.order > 1:
        bent = np.linalg.solve(cd, coefficients)
        forward = [_table(bent[axis], polynomial.order) for axis in range(2)]
        wcs.sip = Sip(*forward, *_reverse(polynomial, origin, cd, shape), origin + 1.0)
    wcs.wcs.set()
    wcs.array_shape = shape
    return wcs


def _table(row: FloatArray, order: int, least: int = 2) -> FloatArray:
    """SIP's square table A[a, b] of a row of coefficients, from the order ``least`` on."""
    table = np.zeros((order + 1, order + 1))
    for value, (a, b) in zip(row, terms(order), strict=True):
        if a + b >= least:
            table[a, b] = value
    return table


def _reverse(
    polynomial: Polynomial, origin: FloatArray, cd: FloatArray, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """The tables AP and BP: from linear pixels back to those of the frame."""
    n = 4 * REVERSE_HIGHEST
    x, y = np.meshgrid(np.linspace(-0.5, shape[1] - 0.5, n), np.linspace(-0.5, shape[0] - 0.5, n))
    px = np.column_stack([x.ravel(), y.ravel()])
    straight = polynomial(px) @ np.linalg.inv(cd).T
    unit = np.abs(straight).max()
    for order in range(polynomial.order, REVERSE_HIGHEST + 1):
        powers = np.stack(
            [(straight[:, 0] / unit) ** a * (straight[:, 1] / unit) ** b for a, b in terms(order)], axis=1
        )
        fit = np.linalg.lstsq(powers, px - origin - straight, rcond=None)[0]
        if np.abs(powers @ fit - (px - origin - straight)).max() < REVERSE_PX:
            break
    fit = fit / unit ** np.array([a + b for a, b in terms(order)])[:, None]
    return _table(fit[:, 0], order, least=0), _table(fit[:, 1], order, least=0)
