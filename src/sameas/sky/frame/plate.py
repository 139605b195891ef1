"""The plate model: from pixels to the sky by a polynomial, fitted to identified stars, with its covariance.

    (ξ, η) = Σ_{a+b ≤ p} c_ab uᵃ vᵇ,   (u, v) = (x − middle) / half diagonal,

ξ east and η north on the tangent plane, arcsec. Every pair counts with its probability; its error is that of the
measurement, brought to the plane, and that of the star. The order p is given, or the one that foretells each star best
from the others (leave-one-out), no higher than the one of least BIC, and such that its WCS can be inverted.
:meth:`PlateModel.predict` gives the pixel of a star with its covariance, :meth:`PlateModel.to_sky` the
reverse, :meth:`PlateModel.to_wcs` gives an astropy WCS (TAN, or TAN-SIP: Shupe et al. 2005, ASP 347, 491).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.gaussian import inverse, propagated, symmetric
from sameas.records import unpack
from sameas.representation import in_short
from sameas.sky.frame.tangent import Pointing, axes, directions_deg, from_plane, to_plane
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

if TYPE_CHECKING:
    from astropy.wcs import WCS

#: Highest order of a plate model (chosen).
HIGHEST_ORDER = 5


@dataclass(frozen=True)
class PlateTuning:
    """Numbers of the fit of a plate, all chosen.

    Attributes
    ----------
    iterations : of fitting, weighing down and bringing the errors to the plane.
    tail_sigmas : the weight of a residual beyond this falls as its inverse square: a wrong pair does not pull.
    quoted_weight : prior weight, in residuals, of a scale of 1 of the quoted errors.
    reverse_px : the reverse of a SIP polynomial is approximated until its largest error over the frame is below this,
        or by the order ``reverse_order`` at most. An order whose reverse errs by more than ``most_reverse_px`` there is
        not taken, unless it was asked for.
    foretelling : a higher order must better −2 ln L of stars foretold by the others by more than this.
    """

    iterations: int = 8
    tail_sigmas: float = 3.5
    quoted_weight: float = 4.0
    reverse_px: float = 0.002
    reverse_order: int = 9
    most_reverse_px: float = 0.01
    foretelling: float = 8.0


TUNING = PlateTuning()


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
        # Far outside the frame a polynomial folds back: points two frames away have no pixel.
        reached = np.flatnonzero(np.abs(px - self.middle_px).max(axis=1) < 4 * self.unit_px)
        at = px[reached]
        for _ in range(20):
            slope = self.slope(at)
            good = np.abs(slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]) > 1e-12
            reached, at = reached[good], at[good]
            step = np.linalg.solve(slope[good], (self(at) - plane[reached])[:, :, None])[:, :, 0]
            # Steps are not longer than half the frame, so that none diverges.
            at = at - np.clip(step, -self.unit_px, self.unit_px)
            if np.abs(step).max(initial=0.0) < 1e-9:
                break
        converged = np.abs(self(at) - plane[reached]).max(axis=1) < 1e-4
        px = np.full_like(px, np.nan)
        px[reached[converged]] = at[converged]
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


def sip(polynomial: Polynomial, centre: FloatArray, shape: tuple[int, int], tuning: PlateTuning = TUNING) -> WCS:
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
        wcs.sip = Sip(*forward, *_reverse(polynomial, origin, cd, shape, tuning)[:2], origin + 1.0)
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
    polynomial: Polynomial, origin: FloatArray, cd: FloatArray, shape: tuple[int, int], tuning: PlateTuning
) -> tuple[FloatArray, FloatArray, float]:
    """The tables AP and BP, from linear pixels back to those of the frame, and their largest error over it, px."""
    n = 4 * tuning.reverse_order
    x, y = np.meshgrid(np.linspace(-0.5, shape[1] - 0.5, n), np.linspace(-0.5, shape[0] - 0.5, n))
    px = np.column_stack([x.ravel(), y.ravel()])
    straight = polynomial(px) @ np.linalg.inv(cd).T
    unit = np.abs(straight).max()
    for order in range(polynomial.order, tuning.reverse_order + 1):
        powers = np.stack(
            [(straight[:, 0] / unit) ** a * (straight[:, 1] / unit) ** b for a, b in terms(order)], axis=1
        )
        fit = np.linalg.lstsq(powers, px - origin - straight, rcond=None)[0]
        worst = float(np.abs(powers @ fit - (px - origin - straight)).max())
        if worst < tuning.reverse_px:
            break
    fit = fit / unit ** np.array([a + b for a, b in terms(order)])[:, None]
    return _table(fit[:, 0], order, least=0), _table(fit[:, 1], order, least=0), worst


@dataclass(frozen=True)
class MatchedStars:
    """Measurements and the catalogue stars that they are.

    Attributes
    ----------
    px : (n, 2) 0-based pixels. covariance_px : (n, 3) of them: xx, xy, yy in px².
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

    Attributes
    ----------
    centre : (3,) where the tangent plane touches the sphere. polynomial : pixels → ξ, η in arcsec.
    covariance : (2q, 2q) of the coefficients (those of ξ, then those of η), arcsec², grown by ``error_scale``².
    error_scale : residuals over quoted errors; never below 1.
    shape : (rows, columns) of the frame.
    effective_pairs : the sum of the probabilities. bic, left_out : of every order that was tried, the criterion of
        Bayes, and −2 ln L of the stars, each by a fit to the others.
    residual_arcsec : (n, 2) star minus model. weight : (n,) of each pair in the fit.
    """

    centre: FloatArray
    polynomial: Polynomial
    covariance: FloatArray
    error_scale: float
    shape: tuple[int, int]
    effective_pairs: float
    bic: Mapping[int, float]
    left_out: Mapping[int, float]
    residual_arcsec: FloatArray = field(repr=False)
    weight: FloatArray = field(repr=False)

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

        The covariance is the model's alone, or with ``covariance_px`` (n, 3) that of a measurement's position.
        """
        px = np.column_stack([np.ravel(x_px), np.ravel(y_px)]).astype(np.float64)
        plane = self.polynomial(px)
        spread = self._spread(px)
        if covariance_px is not None:
            slope = self.polynomial.slope(px)
            spread += propagated(slope, unpack(np.asarray(covariance_px, dtype=np.float64), 2))
        vectors = from_plane(plane / ARCSEC_PER_RADIAN, self.centre)
        to_sky = sky_axes(vectors, self.centre)
        return (*directions_deg(vectors), _packed(propagated(to_sky, spread)))

    def predict(
        self, ra_deg: ArrayLike, dec_deg: ArrayLike, covariance_arcsec: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pixels of stars, x and y, and their covariance (n, 3: xx, xy, yy in px²).

        The covariance is the model's alone, or with ``covariance_arcsec`` (n, 3) the star's position error too.
        NaN for stars that the model cannot see (the other half of the sky, or far outside a strongly curved frame).
        """
        vectors = unit_vectors(np.ravel(ra_deg), np.ravel(dec_deg))
        px = self.polynomial.inverse(to_plane(vectors, self.centre) * ARCSEC_PER_RADIAN)
        spread = self._spread(px)
        if covariance_arcsec is not None:
            to_local = np.linalg.inv(sky_axes(vectors, self.centre))
            star = unpack(np.asarray(covariance_arcsec, dtype=np.float64), 2)
            spread += propagated(to_local, star)
        visible = np.isfinite(px).all(axis=1)
        to_px = np.linalg.inv(self.polynomial.slope(px[visible]))
        packed = np.full((len(px), 3), np.nan)
        packed[visible] = _packed(propagated(to_px, spread[visible]))
        return px[:, 0], px[:, 1], packed

    def to_wcs(self) -> WCS:
        """The same as an astropy WCS: TAN for order 1, else TAN-SIP with both directions."""
        return sip(self.polynomial, self.centre, self.shape)

    def describe(self) -> str:
        """One line to print."""
        rms = self.rms_arcsec
        tried = ", ".join(f"{order}: {value:.1f}" for order, value in self.bic.items())
        return (
            f"plate model of order {self.order} on {self.effective_pairs:.1f} pairs, "
            f"rms {rms[0]:.3f}″ × {rms[1]:.3f}″, errors {self.error_scale:.2f} times those quoted "
            f"(BIC of each order: {tried})"
        )

    def _spread(self, px: FloatArray) -> FloatArray:
        """(n, 2, 2) covariance of ξ, η by the model's own uncertainty, arcsec²."""
        basis = self.polynomial.basis(px)
        q = basis.shape[1]
        blocks = self.covariance.reshape(2, q, 2, q)
        return np.asarray(np.einsum("nq,aqbr,nr->nab", basis, blocks, basis))


def fit_plate(
    stars: MatchedStars,
    start: Pointing,
    shape: tuple[int, int],
    *,
    order: int | None = None,
    tuning: PlateTuning = TUNING,
) -> PlateModel:
    """The plate model of identified stars.

    Parameters
    ----------
    stars : the pairs with their errors and probabilities.
    start : a linear solution near enough to bring the stars' errors to pixels; its plane is kept.
    shape : (rows, columns) of the frame. order : 1 … 5, or None for the one of least BIC.
    tuning : numbers of the fit.

    Raises
    ------
    InputError : too few pairs for the order (an order of q terms needs (q + 1) pairs, three at least).

    Example
    -------
    >>> plate = fit_plate(stars, placement.pointing, (1024, 1024))  # doctest: +SKIP
    >>> x, y, covariance_px = plate.predict(ra_deg, dec_deg)  # doctest: +SKIP
    """
    effective = float(np.sum(stars.p_match))
    if order is not None and not (isinstance(order, int) and 1 <= order <= HIGHEST_ORDER):
        raise InputError(f"plate: order is {order}; give 1 … {HIGHEST_ORDER}, or None")
    orders = [order] if order else list(range(1, HIGHEST_ORDER + 1))
    # One pair more than terms: without a residual orders cannot be compared.
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
    fits = {p: _fitted(stars, start, shape, p, tuning) for p in possible}
    bic = {p: model.bic[p] for p, model in fits.items()}
    left_out = {p: model.left_out[p] for p, model in fits.items()}
    best = min(bic, key=lambda p: (bic[p], p))
    supported = [p for p in possible if p <= best]
    if order is None:
        supported = [p for p in supported if p == possible[0] or _invertible(fits[p], tuning)]
    least = min(left_out[p] for p in supported)
    best = min(p for p in supported if left_out[p] <= least + tuning.foretelling)
    return replace(fits[best], bic=bic, left_out=left_out)


def _invertible(model: PlateModel, tuning: PlateTuning) -> bool:
    """Whether the WCS of a model leads from the sky back to the pixels it came from, all over the frame."""
    if model.order == 1:
        return True
    origin = model.polynomial.inverse(np.zeros((1, 2)))[0]
    cd = model.polynomial.about(origin)[:, 1:3]
    return _reverse(model.polynomial, origin, cd, model.shape, tuning)[2] < tuning.most_reverse_px


def _fitted(
    stars: MatchedStars, start: Pointing, shape: tuple[int, int], order: int, tuning: PlateTuning
) -> PlateModel:
    """The model of one order."""
    middle = np.array([(shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0])
    polynomial = Polynomial.linear(start, middle, 0.5 * math.hypot(*shape), order)
    vectors = unit_vectors(stars.ra_deg, stars.dec_deg)
    plane = to_plane(vectors, start.centre) * ARCSEC_PER_RADIAN
    to_local = np.linalg.inv(sky_axes(vectors, start.centre))
    star = propagated(to_local, unpack(stars.covariance_arcsec, 2))
    basis, down = polynomial.basis(stars.px), np.ones(len(plane))
    q = basis.shape[1]
    for _ in range(tuning.iterations):
        slope = polynomial.slope(stars.px)
        total = star + propagated(slope, unpack(stars.covariance_px, 2))
        precision = inverse(total + 1e-12 * np.eye(2))
        information, right = _normal_equations(basis, precision, plane, stars.p_match * down)
        solution = _solved(information, right)
        polynomial = polynomial.with_coefficients(solution.reshape(2, q))
        left = plane - basis @ polynomial.coefficients.T
        square = np.einsum("ni,nij,nj->n", left, precision, left)
        scale_sq = _scale_squared(square, stars.p_match, down, 2 * q, tuning.quoted_weight)
        down = np.minimum(1.0, tuning.tail_sigmas**2 * scale_sq / np.maximum(square, 1e-300))
    grown = max(1.0, scale_sq)
    covariance = grown * _solved(_normal_equations(basis, precision, plane, stars.p_match * down)[0], np.eye(2 * q))
    return PlateModel(
        centre=start.centre,
        polynomial=polynomial,
        covariance=symmetric(covariance),
        error_scale=math.sqrt(grown),
        shape=shape,
        effective_pairs=float(stars.p_match.sum()),
        bic={order: _bic(square / scale_sq, scale_sq, down, stars.p_match, 2 * q, tuning)},
        left_out={order: _left_out(basis, precision, left, stars.p_match, down, tuning)},
        residual_arcsec=left,
        weight=stars.p_match * down,
    )


def _bic(
    square: FloatArray,
    scale_sq: float,
    down: FloatArray,
    p_match: FloatArray,
    parameters: int,
    tuning: PlateTuning,
) -> float:
    """−2 ln L + parameters · ln(effective pairs), the scale of the errors being unknown.

    ``square`` (n,) residuals squared in units of their scaled errors; beyond the tail a residual costs its logarithm.
    """
    n, prior = 2.0 * float(p_match.sum()), tuning.quoted_weight
    loss = np.where(down < 1.0, tuning.tail_sigmas**2 * (1.0 - np.log(down)), square)
    # From the scale with as many degrees of freedom as are left to that of greatest likelihood.
    share = max(n - parameters + prior, 1.0) / (n + prior)
    return n * math.log(scale_sq * share) + float(p_match @ loss) / share + parameters * math.log(n / 2.0)


def _left_out(
    basis: FloatArray,
    precision: FloatArray,
    left: FloatArray,
    p_match: FloatArray,
    down: FloatArray,
    tuning: PlateTuning,
) -> float:
    """−2 ln L of the residuals ``left`` (n, 2) of every star from a fit to the others, the scale being unknown.

    Of a linear fit these follow without fitting again: (1 − H)⁻¹ of the residual, H = w X (Σ w Xᵀ P X)⁻¹ Xᵀ P.
    """
    q, weight = basis.shape[1], p_match * down
    information = _normal_equations(basis, precision, left, weight)[0]
    blocks = _solved(information, np.eye(2 * q)).reshape(2, q, 2, q)
    spread = np.einsum("nq,aqbr,nr->nab", basis, blocks, basis)
    leverage = weight[:, None, None] * spread @ precision
    # A star that the model follows wherever it goes is foretold by nothing.
    foretold = np.linalg.solve(np.eye(2) * (1.0 + 1e-9) - leverage, left[:, :, None])[:, :, 0]
    square = np.einsum("ni,nij,nj->n", foretold, precision, foretold)
    scale_sq = max(float(weight @ square), 1e-300) / max(2.0 * float(weight.sum()), 1e-300)
    far = square / scale_sq > tuning.tail_sigmas**2
    ratio = np.maximum(square / scale_sq, 1e-300)
    loss = np.where(far, tuning.tail_sigmas**2 * (1.0 + np.log(ratio / tuning.tail_sigmas**2)), ratio)
    return float(2.0 * p_match.sum() * math.log(scale_sq) + p_match @ loss)


def _normal_equations(
    basis: FloatArray, precision: FloatArray, plane: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Σ w Xᵀ Σ⁻¹ X (2q, 2q) and Σ w Xᵀ Σ⁻¹ y (2q,), X = diag(basis, basis)."""
    q = basis.shape[1]
    scaled = precision * weight[:, None, None]
    # Matrix products are many times faster here than einsum over five indices (timed).
    across, cross, along = (basis.T @ (scaled[:, a, b, None] * basis) for a, b in ((0, 0), (0, 1), (1, 1)))
    information = np.block([[across, cross], [cross.T, along]])
    right = basis.T @ np.einsum("nab,nb->na", scaled, plane)
    return information, right.T.reshape(2 * q)


def _solved(information: FloatArray, right: FloatArray) -> FloatArray:
    """The solution of the normal equations; refused where stars on a line or in a corner leave them singular."""
    unit = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information * unit[:, None] * unit
    if np.linalg.cond(scaled) > 1e12:
        raise InputError(
            "plate: the identified stars do not determine the model (they lie on a line or in one place); "
            "give a lower order or a deeper catalogue"
        )
    solution = np.linalg.solve(scaled, right * (unit if right.ndim == 1 else unit[:, None]))
    return np.asarray(solution * (unit if right.ndim == 1 else unit[:, None]))


def _scale_squared(square: FloatArray, p_match: FloatArray, down: FloatArray, parameters: int, prior: float) -> float:
    """Mean square of the residuals over their errors; that of the first iteration is robust against tails."""
    weight = p_match * down
    if np.all(down == 1.0):
        order = np.argsort(square)
        share = np.cumsum(p_match[order]) / p_match.sum()
        n = 2.0 * p_match.sum()
        median = float(square[order][np.searchsorted(share, 0.5)]) / (2 * math.log(2.0))
        mean = (float(weight @ square) + prior) / (max(n - parameters, 0.0) + prior)
        # Of right pairs the mean is the better estimate; a few wrong pairs make it many times the median.
        return mean if mean < 3.0 * max(median, 1e-300) else median
    freedom = max(2.0 * weight.sum() - parameters, 0.0)
    return float((float(weight @ square) + prior) / (freedom + prior))


def sky_axes(vectors: FloatArray, centre: FloatArray) -> FloatArray:
    """(n, 2, 2) by how much a step in ξ, η moves a direction (n, 3) to its own east and north."""
    east, north = axes(np.broadcast_to(centre, vectors.shape))
    depth = np.sum(vectors * centre, axis=1)
    own = np.stack(axes(vectors), axis=1)
    # v = (c + ξe + ηn)/|…|, |…| = 1/depth; the part of the step along v drops out, as own axes are orthogonal to v.
    step = np.stack([east, north], axis=2) * depth[:, None, None]
    return np.asarray(own @ step)


def _packed(full: FloatArray) -> FloatArray:
    return np.stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]], axis=1)
