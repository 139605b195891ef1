"""Photometry of a frame: the zero point of its magnitudes, and its completeness.

    m = z + c (colour − mean) + Σ_k r_k sᵏ,   s = (instrumental − mean) / spread,

instrumental = −2.5 log₁₀ flux. A linear detector needs z and c only; photographic plates are non-linear (r₂, r₃). The
terms are chosen by BIC on the identified pairs, weighted by their probabilities; outliers are downweighted.

The probability that the frame detects a star of magnitude m is

    P_d(m) = top / (1 + exp((m − limit)/width)),

fitted to the identification probabilities of the stars. It defines which stars are missing on the frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, robust_scale, weighted_median
from sameas.gaussian import inverse

PAIRS_PER_TERM = 12  # minimum of additional pairs per term
ITERATIONS = 12  # of the fit and its weights
TAIL_SIGMAS = 3.0  # the weight of residuals beyond this many robust standard deviations falls with their inverse square
PRIOR_STARS = 2.0  # weight of the prior of the completeness, in stars
STARS_PER_BIN = 20  # minimum number of stars for bins of half a magnitude; else wider bins are used
CELLS = 150  # number of magnitude cells for the fit of the completeness


MIN_PAIRS = 3  # for a zero point


@dataclass(frozen=True)
class ZeroPoint:
    """The calibration from fluxes to magnitudes. Make it with :meth:`ZeroPoint.of`.

    zero_point : magnitude minus instrumental magnitude of a star of mean brightness and colour; on a linear detector
        also the magnitude of a star of flux 1. sigma : its standard error.
    colour_term, colour_sigma : magnitudes per magnitude of colour, 0 if not needed or not known.
    bend : coefficients of s, s², s³; empty for a linear detector. centre, spread : of instrumental magnitudes.
    reach : range of s of the pairs; outside, the non-linear correction is constant.
    mean_colour : of the pairs. scatter : robust standard deviation of a pair. pairs : their effective number.
    """

    zero_point: float
    sigma: float
    colour_term: float
    colour_sigma: float
    bend: tuple[float, ...]
    centre: float
    spread: float
    reach: tuple[float, float]
    mean_colour: float
    scatter: float
    pairs: float

    @classmethod
    def of(cls, flux: FloatArray, magnitude: FloatArray, colour: FloatArray, weight: FloatArray) -> ZeroPoint | None:
        """The zero point of pairs with weights, (n,) each; None with fewer than three."""
        known = (flux > 0) & np.isfinite(magnitude) & (weight > 0)
        if weight[known].sum() < MIN_PAIRS:
            return None
        m, w = magnitude[known], weight[known]
        measured = instrumental(flux[known])
        centre, spread = float(np.average(measured, weights=w)), max(float(np.std(measured)), 1e-6)
        s = (measured - centre) / spread
        pair_colour = colour[known]
        has_colour = np.isfinite(pair_colour)
        mean = (
            float(np.average(pair_colour[has_colour], weights=w[has_colour]))
            if w[has_colour].sum() >= MIN_PAIRS
            else math.nan
        )
        excess = np.where(has_colour, pair_colour - mean, 0.0) if math.isfinite(mean) else np.zeros_like(s)
        columns = {"colour": excess, "1": s, "2": s**2, "3": s**3}
        candidates: list[tuple[str, ...]] = [(), ("1", "2"), ("1", "2", "3")]
        if math.isfinite(mean) and np.ptp(excess) > 0:
            candidates += [("colour", *terms) for terms in candidates]
        candidates = [terms for terms in candidates if w.sum() >= MIN_PAIRS + PAIRS_PER_TERM * len(terms)] or [()]
        fits = {terms: _robust([columns[name] for name in terms], m - measured, w) for terms in candidates}
        best = min(fits, key=lambda terms: fits[terms].bic)
        fit = fits[best]
        value, error = dict(zip(best, fit.terms[1:], strict=True)), dict(zip(best, fit.sigma[1:], strict=True))
        return cls(
            zero_point=float(fit.terms[0]),
            sigma=float(fit.sigma[0]),
            colour_term=value.get("colour", 0.0),
            colour_sigma=error.get("colour", 0.0),
            bend=tuple(value[name] for name in ("1", "2", "3") if name in value),
            centre=centre,
            spread=spread,
            reach=(float(np.quantile(s, 0.01)), float(np.quantile(s, 0.99))),
            mean_colour=mean if "colour" in value else 0.0,
            scatter=fit.scatter,
            pairs=float(w.sum()),
        )

    def __call__(self, flux: FloatArray, colour: FloatArray | None = None) -> FloatArray:
        """(n,) magnitudes of fluxes, at the mean colour where the colour is not known; NaN where flux ≤ 0."""
        measured = instrumental(flux)
        # A cubic diverges outside the range of the fitted pairs.
        s = np.clip((measured - self.centre) / self.spread, *self.reach)
        result = measured + self.zero_point
        for power, factor in enumerate(self.bend, 1):
            result = result + factor * s**power
        if colour is not None:
            excess = np.where(np.isfinite(colour), colour - self.mean_colour, 0.0)
            result = result + self.colour_term * excess
        return result

    @property
    def words(self) -> str:
        """The zero point with its standard error, as ``20.329 ± 0.002``."""
        return _with_error(self.zero_point, self.sigma)

    def describe(self) -> str:
        """One line to print."""
        words = f"zero point {self.words} mag"
        if self.colour_term:
            words += f", colour term {_with_error(self.colour_term, self.colour_sigma, '+')}"
        if self.bend:
            words += ", not linear (a curve of third order)" if len(self.bend) > 2 else ", not linear (a parabola)"
        return f"{words}; scatter {self.scatter:.3f} mag of {self.pairs:.0f} pairs"


def _with_error(value: float, sigma: float, sign: str = "") -> str:
    """A value and its standard error with three decimals, or more (at most six) until the error is not zero."""
    digits = next((digits for digits in (3, 4, 5) if round(sigma, digits) > 0.0), 6)
    return f"{value:{sign}.{digits}f} ± {sigma:.{digits}f}"


def instrumental(flux: FloatArray) -> FloatArray:
    """−2.5 log₁₀ flux, NaN where flux ≤ 0."""
    return np.asarray(-2.5 * np.log10(np.where(flux > 0, flux, np.nan)))


@dataclass(frozen=True)
class _MagnitudeFit:
    terms: NDArray[Any]
    sigma: NDArray[Any]
    scatter: float
    bic: float


def _robust(columns: list[FloatArray], y: FloatArray, weight: FloatArray) -> _MagnitudeFit:
    """Weighted least squares; residuals beyond ``tail_sigmas`` robust standard deviations are downweighted."""
    a = np.column_stack([np.ones_like(y), *columns])
    tail_weight = np.ones_like(y)
    # Starting from the weighted median, one wrong pair of seven does not decide which pairs are outliers.
    residual = y - weighted_median(y, weight)
    scatter = 1.0
    for iteration in range(ITERATIONS):
        if iteration:
            w = weight * tail_weight
            normal = a.T @ (w[:, None] * a) + 1e-9 * np.eye(a.shape[1])
            terms = np.linalg.solve(normal, a.T @ (w * y))
            residual = y - a @ terms
        scatter = max(robust_scale(residual, weight), 1e-3)
        tail_weight = np.minimum(1.0, (TAIL_SIGMAS * scatter / np.maximum(np.abs(residual), 1e-12)) ** 2)
    n = float(weight.sum())
    loss = np.where(tail_weight < 1.0, TAIL_SIGMAS**2 * (1.0 - np.log(tail_weight)), (residual / scatter) ** 2)
    bic = 2 * n * math.log(scatter) + float(weight @ loss) + a.shape[1] * math.log(max(n, 2.0))
    return _MagnitudeFit(np.asarray(terms), scatter * np.sqrt(np.diag(inverse(normal))), scatter, bic)


@dataclass(frozen=True)
class Completeness:
    """The detection probability of a star on the frame, by magnitude. Make it with :meth:`Completeness.of`.

    top : for bright stars. limit : magnitude at half of this. width : of the decline, mag.
    edges : (k + 1,) of magnitude bins. stars : (k,) stars on the frame. identified : (k,) expected number of identified
    ones.
    """

    top: float
    limit: float
    width: float
    edges: FloatArray
    stars: FloatArray
    identified: FloatArray

    @classmethod
    def of(cls, magnitude: FloatArray, p_identified: FloatArray) -> Completeness | None:
        """The fit to stars with identification probabilities, (n,) each; None if no magnitude is known."""
        known = np.isfinite(magnitude)
        if not known.any():
            return None
        m, p = magnitude[known], np.clip(p_identified[known], 0.0, 1.0)
        top, limit, width = _fitted_curve(m, p)
        edges = _bins(m, STARS_PER_BIN)
        bin = np.clip(np.searchsorted(edges, m, side="right") - 1, 0, len(edges) - 2)
        count = np.bincount(bin, minlength=len(edges) - 1).astype(np.float64)
        identified = np.bincount(bin, p, len(edges) - 1).astype(np.float64)
        return cls(top, limit, width, edges, count, identified)

    def __call__(self, magnitude: FloatArray) -> FloatArray:
        """(n,) detection probability of stars; that of a bright star where the magnitude is not known."""
        steps = np.clip((np.nan_to_num(magnitude, nan=-99.0) - self.limit) / self.width, -60.0, 60.0)
        return np.asarray(self.top / (1.0 + np.exp(steps)))

    def faintest(self, p: float) -> float:
        """The magnitude at which the probability falls to ``p`` (below ``top``)."""
        return self.limit + self.width * math.log(max(self.top / p - 1.0, 1e-9))

    @property
    def sigma(self) -> FloatArray:
        """(k,) standard errors of ``identified / stars``: binomial, with half a star added to either outcome."""
        share = (self.identified + 0.5) / (self.stars + 1.0)
        return np.asarray(np.sqrt(share * (1.0 - share) / (self.stars + 1.0)))

    def describe(self) -> str:
        """One line to print."""
        faintest = float(self.edges[-1])
        if self.faintest(0.5 * self.top) >= faintest:
            bright, faint = (f"{100 * share:.0f} %" for share in (self.top, float(self(np.array([faintest]))[0])))
            if faint == bright:
                return f"{bright} of the stars detected, to the faintest of the catalogue"
            return f"{bright} of the bright stars detected, {faint} of the faintest in the catalogue ({faintest:.2f})"
        return f"{100 * self.top:.0f} % of the bright stars detected, half as many at magnitude {self.limit:.2f}"


def _fitted_curve(m: FloatArray, p: FloatArray) -> tuple[float, float, float]:
    """Maximum-likelihood (top, limit, width), with a weak prior that bright stars are detected."""
    from scipy.optimize import minimize

    low, high, cells, weight = float(m.min()), float(m.max()), CELLS, PRIOR_STARS
    cell = np.minimum(((m - low) / max(high - low, 1e-9) * cells).astype(np.int64), cells - 1)
    number = np.bincount(cell, minlength=cells)
    used = number > 0
    identified = np.bincount(cell, p, cells)[used]
    missed, middle = number[used] - identified, (np.bincount(cell, m, cells) / np.maximum(number, 1))[used]

    def cost(x: FloatArray) -> float:
        top = 1.0 / (1.0 + math.exp(-x[0]))
        width = math.exp(min(x[2], 3.0))
        curve = top / (1.0 + np.exp(np.clip((middle - x[1]) / width, -60.0, 60.0)))
        curve = np.clip(curve, 1e-9, 1.0 - 1e-9)
        likelihood = float(identified @ np.log(curve) + missed @ np.log1p(-curve))
        # ln of the prior: as if bright stars were identified, and a width of e^−1.2 mag within a factor of e².
        log_prior = weight * math.log(top) - weight * ((x[2] + 1.2) / 2.0) ** 2
        beyond = max(low - x[1], x[1] - high - 3.0, 0.0)
        return float(-likelihood - log_prior + beyond**2)

    starts = [float(np.quantile(m, q)) for q in (0.2, 0.5, 0.8)] + [high + 1.0]
    fits = [minimize(cost, [3.0, start, -1.2], method="Nelder-Mead", options={"maxiter": 300}) for start in starts]
    x = min(fits, key=lambda fit: float(fit.fun)).x
    return 1.0 / (1.0 + math.exp(-x[0])), float(x[1]), math.exp(min(x[2], 3.0))


def _bins(m: FloatArray, stars_per_bin: int) -> FloatArray:
    """Edges of bins of half a magnitude, or of one magnitude with few stars."""
    low, high = float(np.quantile(m, 0.002)), float(m.max())
    step = 0.5 if len(m) >= stars_per_bin * 4 * max(high - low, 1.0) else 1.0
    first = math.floor(low / step) * step
    return np.asarray(np.arange(first, max(high, first + 1e-6) + step, step))
