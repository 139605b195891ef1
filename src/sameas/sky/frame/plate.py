"""The plate model: a polynomial from pixels to the tangent plane of the sky, fitted to stars, with its covariance.

Directions, pixels and the plane are those of :mod:`sameas.sky.frame.pointing`. :class:`PlateModel` is

    (ξ, η) = Σ_{a+b ≤ p} c_ab uᵃ vᵇ,   (u, v) = (x − middle) / half diagonal,

ξ east and η north on the tangent plane, arcsec. Each pair is weighted by its probability; its covariance is the sum of
the measurement's, transformed to the plane, and the star's, and of a floor common to all pairs if the residuals show
one: blends, turbulence and the detector move bright stars by more than their photon noise, and without it a few of them
would decide the plate. The order p is given, or chosen by leave-one-out likelihood, at most the order of least BIC, and
such that its WCS can be inverted. :meth:`PlateModel.predict` gives the pixel of a star with its covariance,
:meth:`PlateModel.to_sky` the inverse, :meth:`PlateModel.to_wcs` an astropy WCS (TAN, or TAN-SIP: Shupe et al. 2005, ASP
347, 491).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray, tall_product
from sameas.errors import InputError
from sameas.gaussian import inverse, log_determinant, propagated, symmetric
from sameas.records import unpack
from sameas.representation import in_short
from sameas.sky.frame.pointing import Pointing
from sameas.space import ARCSEC_PER_RADIAN, axes_at, directions_deg, from_plane, to_plane, unit_vectors

if TYPE_CHECKING:
    from astropy.wcs import WCS


#: Highest order of a plate model (chosen).
HIGHEST_ORDER = 5


ITERATIONS = 8  # number of iterations of the fit, its weights and the transformed errors
#: The weight of larger residuals falls with their inverse square, so that wrong pairs and blends have little influence;
#: blends move one star in ten of a crowded frame. With 3.5 instead of 2 the plates of crowded frames are 1.2 to 1.6
#: times as far off; without blends 2 costs 4 % (tuned on simulated frames).
TAIL_SIGMAS = 2.0
QUOTED_WEIGHT = 4.0  # prior weight, in residuals, of an error scale of 1
#: The order of the inverse SIP polynomial is raised until its largest error over the frame is below REVERSE_PX, at most
#: to REVERSE_ORDER.
REVERSE_PX, REVERSE_ORDER = 0.002, 9
MAX_REVERSE_PX = 0.01  # orders whose inverse has a larger error are not chosen, unless given
FLOOR_GAIN = 6.0  # a floor must lower −2 ln L by more than this
FLOOR_PAIRS = 20.0  # minimum number of pairs for it
FLOOR_STEPS = 16  # number of floors tried, from LEAST_FLOOR times the smallest error to twice the median residual
LEAST_FLOOR = 0.3
FLOOR_FREEDOM = 4.0  # degrees of freedom of the t distribution of the residuals there, low against blends
FLOOR_ITERATIONS = 4  # iterations of its scale


MIN_GAIN = 8.0  # a higher order must lower the leave-one-out −2 ln L by more than this


def terms(order: int) -> list[tuple[int, int]]:
    """The exponents (a, b) of uᵃ vᵇ with a + b ≤ order: (0, 0), (1, 0), (0, 1), (2, 0), …"""
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
        """The linear polynomial of a pointing, arcsec; higher terms are zero."""
        coefficients = np.zeros((2, len(terms(order))))
        cd = pointing.cd * ARCSEC_PER_RADIAN
        coefficients[:, 0] = cd @ (middle_px - pointing.origin_px)
        coefficients[:, 1:3] = cd * unit_px
        return cls(coefficients, middle_px, unit_px, order)

    def with_coefficients(self, coefficients: FloatArray) -> Polynomial:
        """The same with other coefficients (2, q)."""
        return replace(self, coefficients=coefficients)

    def basis(self, px: FloatArray) -> FloatArray:
        """(n, q) the terms uᵃ vᵇ at pixels (n, 2)."""
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
        """(n, 2) the pixels of points ξ, η by Newton's method; NaN if it does not converge near the frame."""
        linear = self.coefficients[:, 1:3] / self.unit_px
        px = self.middle_px + (plane - self.coefficients[:, 0]) @ np.linalg.inv(linear).T
        if self.order == 1:
            return np.asarray(px)
        # Far outside the frame the polynomial folds back: points about two frames away have no pixel.
        rows = np.flatnonzero(np.abs(px - self.middle_px).max(axis=1) < 4 * self.unit_px)
        pixels = px[rows]
        for _ in range(20):
            slope = self.slope(pixels)
            regular = np.abs(slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]) > 1e-12
            rows, pixels = rows[regular], pixels[regular]
            step = np.linalg.solve(slope[regular], (self(pixels) - plane[rows])[:, :, None])[:, :, 0]
            # Steps are limited to half the diagonal against divergence.
            pixels = pixels - np.clip(step, -self.unit_px, self.unit_px)
            if np.abs(step).max(initial=0.0) < 1e-9:
                break
        converged = np.abs(self(pixels) - plane[rows]).max(axis=1) < 1e-4
        px = np.full_like(px, np.nan)
        px[rows[converged]] = pixels[converged]
        return np.asarray(px)

    def about(self, origin_px: FloatArray) -> FloatArray:
        """(2, q) coefficients d_ab about another origin, in pixels: Σ d_ab (x − x₀)ᵃ (y − y₀)ᵇ."""
        shift = (origin_px - self.middle_px) / self.unit_px
        column = {term: i for i, term in enumerate(terms(self.order))}
        about_origin = np.zeros_like(self.coefficients)
        for i, (a, b) in enumerate(terms(self.order)):
            for k in range(a + 1):
                for l in range(b + 1):
                    factor = math.comb(a, k) * math.comb(b, l) * shift[0] ** (a - k) * shift[1] ** (b - l)
                    about_origin[:, column[k, l]] += factor * self.coefficients[:, i] / self.unit_px ** (k + l)
        return about_origin


def sip(polynomial: Polynomial, centre: FloatArray, shape: tuple[int, int]) -> WCS:
    """The astropy WCS of a polynomial (arcsec) on the plane at ``centre``: TAN, or TAN-SIP with its inverse."""
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
        distortion = np.linalg.solve(cd, coefficients)
        forward = [_table(distortion[axis], polynomial.order) for axis in range(2)]
        wcs.sip = Sip(*forward, *_reverse(polynomial, origin, cd, shape)[:2], origin + 1.0)
    wcs.wcs.set()
    wcs.array_shape = shape
    return wcs


def _table(row: FloatArray, order: int, least: int = 2) -> FloatArray:
    """The square table A[a, b] of SIP from a row of coefficients, terms of order ``least`` and higher."""
    table = np.zeros((order + 1, order + 1))
    for value, (a, b) in zip(row, terms(order), strict=True):
        if a + b >= least:
            table[a, b] = value
    return table


def _reverse(
    polynomial: Polynomial, origin: FloatArray, cd: FloatArray, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray, float]:
    """The inverse tables AP and BP, from linear to frame pixels, and their largest error over the frame, px."""
    n = 4 * REVERSE_ORDER
    x, y = np.meshgrid(np.linspace(-0.5, shape[1] - 0.5, n), np.linspace(-0.5, shape[0] - 0.5, n))
    px = np.column_stack([x.ravel(), y.ravel()])
    linear = polynomial(px) @ np.linalg.inv(cd).T
    unit = np.abs(linear).max()
    for order in range(polynomial.order, REVERSE_ORDER + 1):
        powers = np.stack([(linear[:, 0] / unit) ** a * (linear[:, 1] / unit) ** b for a, b in terms(order)], axis=1)
        fit = np.linalg.lstsq(powers, px - origin - linear, rcond=None)[0]
        worst = float(np.abs(powers @ fit - (px - origin - linear)).max())
        if worst < REVERSE_PX:
            break
    fit = fit / unit ** np.array([a + b for a, b in terms(order)])[:, None]
    return _table(fit[:, 0], order, least=0), _table(fit[:, 1], order, least=0), worst


@dataclass(frozen=True)
class MatchedStars:
    """Pairs of measurements and catalogue stars.

    px : (n, 2) 0-based pixels. covariance_px : (n, 3) their covariances: xx, xy, yy in px².
    ra_deg, dec_deg : (n,) of the stars at the frame's epoch. covariance_arcsec : (n, 3) east-east, east-north,
        north-north in arcsec². p_match : (n,) the probability of each pair.
    """

    px: FloatArray
    covariance_px: FloatArray
    ra_deg: FloatArray
    dec_deg: FloatArray
    covariance_arcsec: FloatArray
    p_match: FloatArray

    def __post_init__(self) -> None:
        n = len(self.px)
        shapes = {"px": (n, 2), "covariance_px": (n, 3), "covariance_arcsec": (n, 3)}
        for name in ("px", "covariance_px", "ra_deg", "dec_deg", "covariance_arcsec", "p_match"):
            values, shape = np.asarray(getattr(self, name), dtype=np.float64), shapes.get(name, (n,))
            if values.shape != shape:
                raise InputError(f"plate: {name} has shape {values.shape}; give {shape}")
            if not np.isfinite(values).all():
                row = int(np.argwhere(~np.isfinite(values))[0, 0])
                raise InputError(f"plate: {name} of pair {row} is not a number; leave such pairs out")
        if np.any((self.p_match < 0) | (self.p_match > 1)):
            raise InputError("plate: p_match must be within 0 … 1")


@in_short
@dataclass(frozen=True)
class PlateModel:
    """A fitted plate model. Make it with :func:`fit_plate`.

    centre : (3,) tangent point. polynomial : pixels → ξ, η in arcsec.
    covariance : (2q, 2q) of the coefficients (those of ξ, then those of η), arcsec², multiplied by ``error_scale``².
    error_scale : ratio of residuals to quoted errors, at least 1. floor_arcsec : error per axis that was added in
        quadrature to all pairs; 0 if the residuals show none.
    shape : (rows, columns) of the frame.
    effective_pairs : the sum of the probabilities. bic : by order. leave_one_out : −2 ln L by order, each star
        predicted by a fit to the others.
    residual_arcsec : (n, 2) star minus model. weight : (n,) of each pair in the fit.
    """

    centre: FloatArray
    polynomial: Polynomial
    covariance: FloatArray
    error_scale: float
    shape: tuple[int, int]
    effective_pairs: float
    bic: Mapping[int, float]
    leave_one_out: Mapping[int, float]
    residual_arcsec: FloatArray = field(repr=False)
    weight: FloatArray = field(repr=False)
    floor_arcsec: float = 0.0

    @property
    def order(self) -> int:
        """The order of the polynomial."""
        return self.polynomial.order

    @property
    def rms_arcsec(self) -> FloatArray:
        """(2,) weighted root mean square of the residuals, ξ and η."""
        return np.asarray(np.sqrt(self.weight @ self.residual_arcsec**2 / self.weight.sum()))

    def to_sky(
        self, x_px: ArrayLike, y_px: ArrayLike, covariance_px: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Right ascension, declination (degrees) and covariance (n, 3: east-east, east-north, north-north, arcsec²).

        The covariance is the model's; with ``covariance_px`` (n, 3) the measurement's covariance is added.
        """
        px = np.column_stack([np.ravel(x_px), np.ravel(y_px)]).astype(np.float64)
        plane = self.polynomial(px)
        covariance = self._plane_covariance(px)
        if covariance_px is not None:
            slope = self.polynomial.slope(px)
            covariance += propagated(slope, unpack(np.asarray(covariance_px, dtype=np.float64), 2))
        vectors = from_plane(plane / ARCSEC_PER_RADIAN, self.centre)
        to_sky = sky_axes(vectors, self.centre)
        return (*directions_deg(vectors), _packed(propagated(to_sky, covariance)))

    def predict(
        self, ra_deg: ArrayLike, dec_deg: ArrayLike, covariance_arcsec: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pixels of stars, x and y, and their covariance (n, 3: xx, xy, yy in px²).

        The covariance is the model's; with ``covariance_arcsec`` (n, 3) the star's covariance is added. NaN for stars
        without a pixel (on the opposite half of the sky, or far outside a strongly distorted frame).
        """
        vectors = unit_vectors(np.ravel(ra_deg), np.ravel(dec_deg))
        px = self.polynomial.inverse(to_plane(vectors, self.centre) * ARCSEC_PER_RADIAN)
        covariance = self._plane_covariance(px)
        if covariance_arcsec is not None:
            to_local = np.linalg.inv(sky_axes(vectors, self.centre))
            star_covariance = unpack(np.asarray(covariance_arcsec, dtype=np.float64), 2)
            covariance += propagated(to_local, star_covariance)
        visible = np.isfinite(px).all(axis=1)
        to_px = np.linalg.inv(self.polynomial.slope(px[visible]))
        packed = np.full((len(px), 3), np.nan)
        packed[visible] = _packed(propagated(to_px, covariance[visible]))
        return px[:, 0], px[:, 1], packed

    def to_wcs(self) -> WCS:
        """The model as an astropy WCS: TAN for order 1, else TAN-SIP with its inverse."""
        return sip(self.polynomial, self.centre, self.shape)

    def describe(self) -> str:
        """One line to print."""
        rms = self.rms_arcsec
        bic_of_orders = ", ".join(f"{order}: {value:.1f}" for order, value in self.bic.items())
        floor = f" and a floor of {self.floor_arcsec:.2g}″" if self.floor_arcsec else ""
        return (
            f"plate model of order {self.order} on {self.effective_pairs:.1f} pairs, "
            f"rms {rms[0]:.3f}″ × {rms[1]:.3f}″, errors {self.error_scale:.2f} times those quoted{floor} "
            f"(BIC of each order: {bic_of_orders})"
        )

    def _plane_covariance(self, px: FloatArray) -> FloatArray:
        """(n, 2, 2) covariance of ξ, η from the coefficients, arcsec²."""
        basis = self.polynomial.basis(px)
        q = basis.shape[1]
        blocks = self.covariance.reshape(2, q, 2, q)
        return np.asarray(np.einsum("nq,aqbr,nr->nab", basis, blocks, basis))


def fit_plate(stars: MatchedStars, start: Pointing, shape: tuple[int, int], *, order: int | None = None) -> PlateModel:
    """The plate model of identified stars.

    stars : the pairs with their errors and probabilities.
    start : a linear solution, accurate enough to transform the errors; its tangent point is kept.
    shape : (rows, columns) of the frame. order : 1 … 5, or None to choose it.

    Raises InputError: too few pairs for the order (order 1 needs three, an order of q terms q + 1).

    >>> plate = fit_plate(stars, placement.pointing, (1024, 1024))  # doctest: +SKIP
    >>> x, y, covariance_px = plate.predict(ra_deg, dec_deg)  # doctest: +SKIP
    """
    effective = float(np.sum(stars.p_match))
    if order is not None and not (isinstance(order, int) and 1 <= order <= HIGHEST_ORDER):
        raise InputError(f"plate: order is {order}; give 1 … {HIGHEST_ORDER}, or None")
    orders = [order] if order else list(range(1, HIGHEST_ORDER + 1))
    # Orders above 1 need one pair more than terms: without residuals orders cannot be compared.
    possible = [p for p in orders if effective >= len(terms(p)) + (1 if p > 1 else 0) - 1e-9]
    if not possible:
        need = len(terms(orders[0])) + (1 if orders[0] > 1 else 0)
        raise InputError(
            f"plate: {effective:.1f} identified stars are too few for order {orders[0]}, which needs {need}; "
            "give a lower order or a deeper catalogue"
        )
    behind = np.flatnonzero(unit_vectors(stars.ra_deg, stars.dec_deg) @ start.centre <= 0.0)
    if len(behind):
        raise InputError(f"plate: the star of pair {behind[0]} is 90° or more from the frame; check the pairs")
    fits = {p: _fitted(stars, start, shape, p) for p in possible}
    bic = {p: model.bic[p] for p, model in fits.items()}
    leave_one_out = {p: model.leave_one_out[p] for p, model in fits.items()}
    best = min(bic, key=lambda p: (bic[p], p))
    supported = [p for p in possible if p <= best]
    if order is None:
        supported = [p for p in supported if p == possible[0] or _invertible(fits[p])]
    least = min(leave_one_out[p] for p in supported)
    best = min(p for p in supported if leave_one_out[p] <= least + MIN_GAIN)
    return replace(fits[best], bic=bic, leave_one_out=leave_one_out)


def _invertible(model: PlateModel) -> bool:
    """Whether the inverse of the model's WCS is accurate over the whole frame."""
    if model.order == 1:
        return True
    origin = model.polynomial.inverse(np.zeros((1, 2)))[0]
    cd = model.polynomial.about(origin)[:, 1:3]
    return _reverse(model.polynomial, origin, cd, model.shape)[2] < MAX_REVERSE_PX


def _fitted(stars: MatchedStars, start: Pointing, shape: tuple[int, int], order: int) -> PlateModel:
    """The plate model of one order, by iteratively reweighted least squares."""
    middle = np.array([(shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0])
    polynomial = Polynomial.linear(start, middle, 0.5 * math.hypot(*shape), order)
    vectors = unit_vectors(stars.ra_deg, stars.dec_deg)
    plane = to_plane(vectors, start.centre) * ARCSEC_PER_RADIAN
    to_local = np.linalg.inv(sky_axes(vectors, start.centre))
    star_covariance = propagated(to_local, unpack(stars.covariance_arcsec, 2))
    basis, tail_weight = polynomial.basis(stars.px), np.ones(len(plane))
    q = basis.shape[1]
    floor_sq, residual = 0.0, np.zeros_like(plane)
    for iteration in range(ITERATIONS):
        slope = polynomial.slope(stars.px)
        total = star_covariance + propagated(slope, unpack(stars.covariance_px, 2))
        if iteration:
            floor_sq = _floor_squared(residual, total, q, stars.p_match)
        total = total + floor_sq * np.eye(2)
        precision = inverse(total + 1e-12 * np.eye(2))
        information, right_side = _normal_equations(basis, precision, plane, stars.p_match * tail_weight)
        solution = _solve_normal(information, right_side)
        polynomial = polynomial.with_coefficients(solution.reshape(2, q))
        residual = plane - basis @ polynomial.coefficients.T
        normalised_sq = np.einsum("ni,nij,nj->n", residual, precision, residual)
        scale_sq = _scale_squared(normalised_sq, stars.p_match, tail_weight, 2 * q)
        tail_weight = np.minimum(1.0, TAIL_SIGMAS**2 * scale_sq / np.maximum(normalised_sq, 1e-300))
    covariance_scale, log_volume = max(1.0, scale_sq), float(stars.p_match @ log_determinant(total))
    covariance = covariance_scale * _solve_normal(
        _normal_equations(basis, precision, plane, stars.p_match * tail_weight)[0], np.eye(2 * q)
    )
    return PlateModel(
        centre=start.centre,
        polynomial=polynomial,
        covariance=symmetric(covariance),
        error_scale=math.sqrt(covariance_scale),
        shape=shape,
        effective_pairs=float(stars.p_match.sum()),
        bic={order: log_volume + _bic(normalised_sq / scale_sq, scale_sq, stars.p_match, 2 * q)},
        leave_one_out={
            order: log_volume + _leave_one_out(basis, precision, residual, stars.p_match, tail_weight, TAIL_SIGMAS)
        },
        residual_arcsec=residual,
        weight=stars.p_match * tail_weight,
        floor_arcsec=math.sqrt(covariance_scale * floor_sq),
    )


def _floor_squared(residual: FloatArray, covariance: FloatArray, terms_per_axis: int, p_match: FloatArray) -> float:
    """The variance per axis to be added to all pairs, arcsec², before the error scale; 0 if the residuals show none.

    It maximises the restricted likelihood (Patterson & Thompson 1971, Biometrika 58, 545) together with the error
    scale: residuals that grow less than the quoted errors from bright to faint stars have a floor. The residuals have a
    t distribution there, and both axes of a pair count by themselves.

    residual : (n, 2) of a fit with ``terms_per_axis`` terms. covariance : (n, 2, 2) as quoted.
    """
    if float(p_match.sum()) < max(FLOOR_PAIRS, 2 * terms_per_axis):
        return 0.0
    quoted, squares = np.diagonal(covariance, axis1=1, axis2=2), residual**2
    least = LEAST_FLOOR**2 * float(quoted.min())
    most = max(float(np.median(squares[p_match > 0.5])) if (p_match > 0.5).any() else 0.0, 1e-300) * 4.0
    if least >= most:
        return 0.0
    floors = np.concatenate([[0.0], np.geomspace(max(least, 1e-6 * most), most, FLOOR_STEPS)])
    misfit = np.array([_restricted_misfit(squares, quoted + floor, terms_per_axis, p_match) for floor in floors])
    best = int(np.argmin(misfit))
    return float(floors[best]) if misfit[best] < misfit[0] - FLOOR_GAIN else 0.0


def _restricted_misfit(squares: FloatArray, variance: FloatArray, terms_per_axis: int, p_match: FloatArray) -> float:
    """Restricted −2 ln L of squared residuals (n, 2) with these variances (n, 2) and an unknown error scale.

    The determinant of the terms' information is that of stars whose errors do not depend on their place.
    """
    freedom, nu = max(2.0 * float(p_match.sum()) - 2 * terms_per_axis, 1.0), FLOOR_FREEDOM
    ratio = (squares / variance).sum(axis=1)
    scale_sq = float(np.median(ratio)) / (2.0 * math.log(2.0))
    for _ in range(FLOOR_ITERATIONS):
        weight = p_match * (nu + 2.0) / (nu + ratio / scale_sq)
        scale_sq = (float(weight @ ratio) + QUOTED_WEIGHT) / (freedom + QUOTED_WEIGHT)
    loss = (nu + 2.0) * np.log1p(ratio / (nu * scale_sq))
    information = terms_per_axis * float(np.log(weight @ (1.0 / variance)).sum())
    prior = QUOTED_WEIGHT * (math.log(scale_sq) + 1.0 / scale_sq)
    return float(p_match @ (np.log(variance).sum(axis=1) + loss)) + freedom * math.log(scale_sq) + prior + information


def _bic(normalised_sq: FloatArray, scale_sq: float, p_match: FloatArray, parameters: int) -> float:
    """−2 ln L + parameters · ln(effective pairs), with an unknown error scale.

    normalised_sq : (n,) squared residuals over scaled variances; beyond the tail the loss grows logarithmically.
    """
    n, prior = 2.0 * float(p_match.sum()), QUOTED_WEIGHT
    limit = TAIL_SIGMAS**2
    loss = np.where(
        normalised_sq > limit, limit * (1.0 + np.log(np.maximum(normalised_sq / limit, 1.0))), normalised_sq
    )
    # Ratio of the maximum-likelihood scale to the one by degrees of freedom.
    ratio = max(n - parameters + prior, 1.0) / (n + prior)
    return n * math.log(scale_sq * ratio) + float(p_match @ loss) / ratio + parameters * math.log(n / 2.0)


def _leave_one_out(
    basis: FloatArray,
    precision: FloatArray,
    residual: FloatArray,
    p_match: FloatArray,
    tail_weight: FloatArray,
    tail_sigmas: float,
) -> float:
    """Leave-one-out −2 ln L: each star predicted by a fit to the others, with an unknown error scale.

    For a linear fit these residuals follow without refitting: (1 − H)⁻¹ r, H = w X (Σ w Xᵀ P X)⁻¹ Xᵀ P.
    residual : (n, 2) of the fit to all stars.
    """
    q, weight = basis.shape[1], p_match * tail_weight
    information = _normal_equations(basis, precision, residual, weight)[0]
    blocks = _solve_normal(information, np.eye(2 * q)).reshape(2, q, 2, q)
    covariance = np.einsum("nq,aqbr,nr->nab", basis, blocks, basis)
    leverage = weight[:, None, None] * covariance @ precision
    # 1e-9 keeps the matrix regular for a star that determines the model alone (leverage 1).
    predicted_residual = np.linalg.solve(np.eye(2) * (1.0 + 1e-9) - leverage, residual[:, :, None])[:, :, 0]
    normalised_sq = np.einsum("ni,nij,nj->n", predicted_residual, precision, predicted_residual)
    scale_sq = max(float(weight @ normalised_sq), 1e-300) / max(2.0 * float(weight.sum()), 1e-300)
    in_tail = normalised_sq / scale_sq > tail_sigmas**2
    ratio = np.maximum(normalised_sq / scale_sq, 1e-300)
    loss = np.where(in_tail, tail_sigmas**2 * (1.0 + np.log(ratio / tail_sigmas**2)), ratio)
    return float(2.0 * p_match.sum() * math.log(scale_sq) + p_match @ loss)


def _normal_equations(
    basis: FloatArray, precision: FloatArray, plane: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Σ w Xᵀ P X (2q, 2q) and Σ w Xᵀ P y (2q,), X = diag(basis, basis), P the precision, y the plane coordinates."""
    q = basis.shape[1]
    scaled = precision * weight[:, None, None]
    # Matrix products are many times faster than einsum over five indices (timed).
    xi_xi, xi_eta, eta_eta = (tall_product(basis, scaled[:, a, b, None] * basis) for a, b in ((0, 0), (0, 1), (1, 1)))
    information = np.block([[xi_xi, xi_eta], [xi_eta.T, eta_eta]])
    right_side = tall_product(basis, np.einsum("nab,nb->na", scaled, plane))
    return information, right_side.T.reshape(2 * q)


def _solve_normal(information: FloatArray, right_side: FloatArray) -> FloatArray:
    """The solution of the normal equations; refused if they are singular (stars on a line or in one place)."""
    unit = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information * unit[:, None] * unit
    if np.linalg.cond(scaled) > 1e12:
        raise InputError(
            "plate: the identified stars do not determine the model (they lie on a line or in one place); "
            "give a lower order or a deeper catalogue"
        )
    solution = np.linalg.solve(scaled, right_side * (unit if right_side.ndim == 1 else unit[:, None]))
    return np.asarray(solution * (unit if right_side.ndim == 1 else unit[:, None]))


def _scale_squared(normalised_sq: FloatArray, p_match: FloatArray, tail_weight: FloatArray, parameters: int) -> float:
    """Mean square of residuals over errors; robust against outliers in the first iteration, before any weighting."""
    weight, prior = p_match * tail_weight, QUOTED_WEIGHT
    if np.all(tail_weight == 1.0):
        order = np.argsort(normalised_sq)
        share = np.cumsum(p_match[order]) / p_match.sum()
        n = 2.0 * p_match.sum()
        median = float(normalised_sq[order][np.searchsorted(share, 0.5)]) / (2 * math.log(2.0))
        mean = (float(weight @ normalised_sq) + prior) / (max(n - parameters, 0.0) + prior)
        # The mean is the better estimate without wrong pairs; a few wrong pairs make it many times the median.
        return mean if mean < 3.0 * max(median, 1e-300) else median
    freedom = max(2.0 * weight.sum() - parameters, 0.0)
    expected = _weighted_mean_square(TAIL_SIGMAS)
    return float((float(weight @ normalised_sq) / expected + prior) / (freedom + prior))


@lru_cache
def _weighted_mean_square(sigmas: float) -> float:
    """Σ w z / 2Σ w of normal residuals, z = r²/σ² of two axes, w = min(1, sigmas² s²/z), s² this mean itself."""
    from scipy.special import exp1

    mean = 1.0
    for _ in range(50):
        half = 0.5 * sigmas**2 * mean
        mean = (1.0 - math.exp(-half)) / (1.0 - math.exp(-half) + half * float(exp1(half)))
    return mean


def sky_axes(vectors: FloatArray, centre: FloatArray) -> FloatArray:
    """(n, 2, 2) ∂(local east, north)/∂(ξ, η) at directions (n, 3)."""
    east, north = axes_at(np.broadcast_to(centre, vectors.shape))
    depth = np.sum(vectors * centre, axis=1)
    local = np.stack(axes_at(vectors), axis=1)
    # v = (c + ξe + ηn)/|…|, |…| = 1/depth; the component of the step along v is orthogonal to the local axes.
    step = np.stack([east, north], axis=2) * depth[:, None, None]
    return np.asarray(local @ step)


def _packed(full: FloatArray) -> FloatArray:
    return np.stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]], axis=1)
