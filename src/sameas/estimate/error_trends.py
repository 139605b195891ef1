"""Growth of errors beyond the quoted ones with magnitude (of either source) or distance from the field's centre.

The covariance of a pair becomes

    S = a₁² Σ₁ + a₂² Σ₂ + t(x)² 1,

with t² piecewise linear in x. Its values at the knots are fitted by maximum likelihood like the floor in
:mod:`~sameas.estimate.error_model`, which it generalizes. First a score test decides whether normalised residuals
change with x at all; a trend is accepted if its gain in likelihood exceeds what its parameters gain by chance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.estimate.coverage import Coverage
from sameas.estimate.error_model import MIN_PAIRS, fit_variances, log_likelihood, with_fitted_mixture
from sameas.estimate.photometry import Photometry
from sameas.evidence import Errors
from sameas.gate import Pairs
from sameas.kernels import threads
from sameas.records import Records, unpack
from sameas.space import Plane, unit_vectors

# Limits for trends of errors; all chosen.
#: Pairs less probable than this are not used; below the second, not by other errors either.
MIN_P, MIN_P_OTHER = 0.05, 1e-4
MAX_KNOTS, PAIRS_PER_KNOT = 7, 60.0  # number of knots of a trend, limited by the number of pairs
MIN_GAIN = 6.0  # gain in ln likelihood, beyond chance, for the score test and for a trend
MAX_REFITS, MIN_REFIT_GAIN = 12, 0.5  # number of fits with updated probabilities; they end when one gains less
MIN_FACTOR = 1e-3  # lower limit of the factors on quoted errors
MAX_RADIUS_DEG = 20.0  # a field of a larger radius has no centre


@dataclass(frozen=True)
class Trend:
    """Growth of errors beyond the quoted ones with a quantity x.

    source : 0 or 1, the source that has the quantity. quantity : "magnitude" or "distance from the centre"; unit of it.
    at : (k,) knots. added : (k,) added variance there per axis, in squared units of the residuals; linear between knots
    and constant beyond. sigma : (k,) total error of pairs near the knot, per axis.
    """

    source: int
    quantity: str
    unit: str
    at: FloatArray
    added: FloatArray
    sigma: FloatArray

    def variance(self, x: FloatArray) -> FloatArray:
        """(n,) added variances per axis; that of the middle knot where x (n,) is unknown."""
        x = np.where(np.isfinite(x), x, self.at[len(self.at) // 2])
        return np.asarray(np.interp(x, self.at, self.added))

    def words(self, name: str, scale: float = 1.0) -> str:
        """The error at the first, middle and last knot as text, times ``scale``; ``name`` is the source's.

        >>> at, sigma = np.array([15.0, 19.0, 21.5]), np.array([0.02, 0.1, 0.4])
        >>> Trend(0, "magnitude", "", at, sigma**2, sigma).words("plate")
        'by magnitude (plate): 0.02 at 15, 0.1 at 19, 0.4 at 21.5'
        """
        of = f" ({name})" if self.quantity == "magnitude" else ""
        some = [0, len(self.at) // 2, len(self.at) - 1]
        at = ", ".join(f"{scale * self.sigma[k]:.2g} at {self.at[k]:.3g}{self.unit}" for k in some)
        return f"by {self.quantity}{of}: {at}"


@dataclass(frozen=True)
class Covariate:
    """A quantity that errors may depend on: ``values`` (n_table,) by the rows of a source's table, NaN if unknown."""

    source: int
    quantity: str
    unit: str
    values: FloatArray

    def of(self, pairs: Pairs) -> FloatArray:
        """(m,) values of pairs."""
        records, at = (pairs.first, pairs.i) if self.source == 0 else (pairs.second, pairs.j)
        return self.values[records.rows[at]]


def covariates(coverage: Coverage, photometry: Photometry | None) -> list[Covariate]:
    """The quantities that the errors of these records may depend on."""
    quantities, sides = [], (coverage.first, coverage.second)
    if photometry is not None:
        for source, (records, side) in enumerate(zip(sides, photometry.sides, strict=True)):
            measured = np.isfinite(side.measured.values)
            band = int(np.argmax(measured.sum(axis=0)))
            values = _by_row(records, side.measured.values[:, band])
            quantities.append(Covariate(source, "magnitude", "", values))
    distance = _distance_from_centre(coverage.first, MAX_RADIUS_DEG)
    if distance is not None:
        quantities.append(Covariate(0, "distance from the centre", "°", _by_row(coverage.first, distance)))
    return quantities


def _by_row(records: Records, values: FloatArray) -> FloatArray:
    """(n_table,) values of records (n,) by the rows of their table, NaN for other rows."""
    by_row = np.full(records.n_table, np.nan)
    by_row[records.rows] = values
    return by_row


def _distance_from_centre(records: Records, max_radius_deg: float) -> FloatArray | None:
    """(n,) distance from the centre of a field on the sky in degrees; None if it is too wide to be one field."""
    if isinstance(records.space, Plane) or np.ptp(records.features[:, 1]) > 2.0 * max_radius_deg:
        return None
    bounds = threads.even(len(records))
    parts = threads.over(lambda a, b: np.ascontiguousarray(unit_vectors(*records.features[a:b].T).T), bounds)
    least, greatest = (np.array([end(part, axis=1) for part in parts]) for end in (np.min, np.max))
    middle = 0.5 * (least.min(axis=0) + greatest.max(axis=0))
    centre = middle / max(float(np.linalg.norm(middle)), 1e-9)

    def distance_of(vectors: FloatArray) -> FloatArray:
        chord_sq = sum((x - m) ** 2 for x, m in zip(vectors, centre, strict=True))
        return np.asarray(np.degrees(2.0 * np.arcsin(np.minimum(0.5 * np.sqrt(chord_sq), 1.0))))

    distance = np.concatenate(threads.each([partial(distance_of, part) for part in parts], len(records)))
    return distance if float(distance.max()) < max_radius_deg else None


def with_trends(
    errors: Errors,
    pairs: Pairs,
    p_pair: FloatArray,
    quantities: Sequence[Covariate],
    most: int,
    previous: Sequence[Trend],
) -> tuple[Errors, tuple[Trend, ...], float]:
    """The errors with trends that these pairs support, the trends, and the gain in ln likelihood.

    errors : the present model. p_pair : (m,) probabilities. most : greatest number of pairs used. previous : trends
    included in ``errors``, which are fitted again.

    Source: METHOD 6, "Errors that grow".
    """
    likely = np.flatnonzero(p_pair > MIN_P)
    likely = likely[:: max(1, -(-len(likely) // most))]
    some, weight = pairs.part(likely), p_pair[likely]
    if float(weight.sum()) < MIN_PAIRS:
        return errors, (), 0.0
    n_knots = int(min(MAX_KNOTS, float(weight.sum()) / PAIRS_PER_KNOT))
    score = _score(errors, errors.pairs(some).mahalanobis_sq, pairs.d)
    fitted_before = {(trend.source, trend.quantity) for trend in previous}
    bases = [_LinearBasis.of(one, some, weight, n_knots, MIN_PAIRS) for one in quantities]
    candidates = [
        basis
        for basis in bases
        if basis is not None and (basis.key in fitted_before or basis.expected_gain(score, weight) > MIN_GAIN)
    ]
    if not candidates:
        return errors, (), 0.0
    present = log_likelihood(errors, some, weight)
    best: tuple[float, Errors, tuple[Trend, ...]] = (present if not previous else -math.inf, errors, ())
    chosen: list[_LinearBasis] = []
    while len(chosen) < len(candidates):
        fits = [(basis, *_fit_trends(some, weight, [*chosen, basis])) for basis in candidates if basis not in chosen]
        basis, value, model, trends = max(fits, key=lambda fit: fit[1])
        if value - best[0] < MIN_GAIN + 0.5 * n_knots * math.log(float(weight.sum())):
            break
        best = value, model, trends
        chosen.append(basis)
    if not chosen:
        return errors, (), 0.0
    competing = _Competing.of(errors, pairs, p_pair, most)
    without = competing.reweighted(with_fitted_mixture(errors, some, weight))[1]
    model, trends, fitted = _refit(competing, best, chosen)
    return model, trends, fitted - without


def _refit(
    competing: _Competing, initial: tuple[float, Errors, tuple[Trend, ...]], chosen: Sequence[_LinearBasis]
) -> tuple[Errors, tuple[Trend, ...], float]:
    """The trends fitted repeatedly with updated probabilities of the candidates, and the gain in ln likelihood."""
    (_, errors, trends), bases = initial, [each.at(competing.pairs) for each in chosen]
    weight, gain = competing.p, -math.inf
    for _ in range(MAX_REFITS):
        likely = weight > MIN_P
        some = competing.pairs.part(np.flatnonzero(likely))
        weight, new_gain = competing.reweighted(with_fitted_mixture(errors, some, weight[likely]))
        if new_gain - gain < MIN_REFIT_GAIN:
            break
        gain, likely = new_gain, weight > MIN_P
        some, of_some = competing.pairs.part(np.flatnonzero(likely)), [each.part(likely) for each in bases]
        _, errors, trends = _fit_trends(some, weight[likely], of_some)
    return errors, trends, gain


@dataclass(frozen=True)
class _Competing:
    """All candidates of some records of source 1; each record has at most one partner among them.

    p, log_density : (m,) probabilities of the pairs, and the ln density of residuals that they were computed with.
    """

    pairs: Pairs
    p: FloatArray
    log_density: FloatArray

    @classmethod
    def of(cls, errors: Errors, pairs: Pairs, p_pair: FloatArray, most: int) -> _Competing:
        """The candidates of at most ``most`` records with a possible partner."""
        some = np.zeros(len(pairs.first), np.bool_)
        has = np.flatnonzero(np.bincount(pairs.i, p_pair, len(some)) > MIN_P)
        some[has[:: max(1, -(-len(has) // most))]] = True
        kept = np.flatnonzero(some[pairs.i] & (p_pair > MIN_P_OTHER))
        part = pairs.part(kept)
        return cls(part, p_pair[kept], errors.log_density(part))

    def reweighted(self, errors: Errors) -> tuple[FloatArray, float]:
        """(m,) probabilities by other errors, and the change of ln likelihood of the records' candidates."""
        n = len(self.pairs.first)
        odds = self.p * np.exp(np.clip(errors.log_density(self.pairs) - self.log_density, -50.0, 50.0))
        none = np.maximum(1.0 - np.bincount(self.pairs.i, self.p, n), 1e-9)
        total = none + np.bincount(self.pairs.i, odds, n)
        return odds / total[self.pairs.i], float(np.log(total).sum())


@dataclass(frozen=True, eq=False)
class _LinearBasis:
    """Piecewise linear basis of a covariate x: ``values`` (k, m) of pairs, one for each of the ``knots`` (k,)."""

    covariate: Covariate
    knots: FloatArray
    values: FloatArray

    def at(self, pairs: Pairs) -> _LinearBasis:
        """The basis evaluated for other pairs."""
        x = self.covariate.of(pairs)
        x = np.where(np.isfinite(x), x, self.knots[len(self.knots) // 2])
        return replace(self, values=np.array([np.interp(x, self.knots, one) for one in np.eye(len(self.knots))]))

    def part(self, some: BoolArray) -> _LinearBasis:
        """The basis for some of the pairs."""
        return replace(self, values=self.values[:, some])

    @property
    def key(self) -> tuple[int, str]:
        return self.covariate.source, self.covariate.quantity

    @classmethod
    def of(
        cls, covariate: Covariate, pairs: Pairs, weight: FloatArray, n_knots: int, min_pairs: float
    ) -> _LinearBasis | None:
        """The basis with equal weights of pairs between knots; None if x is mostly unknown or hardly varies."""
        x = covariate.of(pairs)
        finite = np.isfinite(x)
        if float(weight[finite].sum()) < max(min_pairs, 0.5 * float(weight.sum())):
            return None
        order = np.flatnonzero(finite)[np.argsort(x[finite], kind="stable")]
        cumulated = np.cumsum(weight[order])
        at = np.searchsorted(cumulated, np.linspace(0.02, 0.98, n_knots) * cumulated[-1])
        knots = np.unique(x[order][np.minimum(at, len(order) - 1)])
        if len(knots) < 3:
            return None
        return cls(covariate, knots, np.empty(0)).at(pairs)

    def expected_gain(self, score: FloatArray, weight: FloatArray) -> float:
        """Expected gain in ln likelihood from errors that change with x, less that of chance, to second order."""
        slope = self.values @ (weight * score)
        information = (self.values * (weight * score**2)) @ self.values.T
        gain = 0.5 * float(slope @ np.linalg.lstsq(information, slope, rcond=1e-9)[0])
        return gain - 0.5 * len(slope)

    def trend(self, added: FloatArray, total_variance: FloatArray, weight: FloatArray) -> Trend:
        """The trend with these (k,) variances at the knots; ``total_variance`` (m,) of pairs."""
        one, shares = self.covariate, self.values * weight
        sigma = np.sqrt(shares @ total_variance / shares.sum(axis=1))
        return Trend(one.source, one.quantity, one.unit, self.knots, added, sigma)


def _score(errors: Errors, square: FloatArray, d: int) -> FloatArray:
    """(m,) derivative of the ln density of residuals with ln of all errors; square : (m,) squared normalised."""
    scales, shares = np.asarray(errors.scales), np.asarray(errors.shares)
    p_component = np.log(np.maximum(shares, 1e-300)) - d * np.log(scales) - 0.5 * square[:, None] / scales**2
    p_component = np.exp(p_component - p_component.max(axis=1, keepdims=True))
    p_component /= p_component.sum(axis=1, keepdims=True)
    return np.asarray(square * (p_component / scales**2).sum(axis=1) - d)


def _fit_trends(
    pairs: Pairs, weight: FloatArray, bases: Sequence[_LinearBasis]
) -> tuple[float, Errors, tuple[Trend, ...]]:
    """ln likelihood of pairs with errors that grow with all these quantities, the errors, and their trends."""
    one, two = (unpack(of.covariance[at], pairs.d) for of, at in ((pairs.first, pairs.i), (pairs.second, pairs.j)))
    unit = float(np.median(np.einsum("mvv->m", one + two))) / pairs.d
    floor_covariance = unit * np.eye(pairs.d)
    parts = np.stack([one, two, *(value[:, None, None] * floor_covariance for each in bases for value in each.values)])
    theta = fit_variances(pairs.residual, weight, parts)
    total_variance = np.einsum("k,kmvv->m", theta, parts) / pairs.d
    ends = np.cumsum([2, *(len(each.values) for each in bases)])
    trends = tuple(
        each.trend(unit * theta[begin:end], total_variance, weight)
        for each, begin, end in zip(bases, ends, ends[1:], strict=False)
    )
    added: list[FloatArray | None] = [None, None]
    for trend, each in zip(trends, bases, strict=True):
        variance, other = trend.variance(each.covariate.values), added[trend.source]
        added[trend.source] = variance if other is None else other + variance
    factors = np.maximum(np.sqrt(theta[:2]), MIN_FACTOR).tolist()
    errors = Errors(factor_1=factors[0], factor_2=factors[1], added=(added[0], added[1]))
    return log_likelihood(errors, pairs, weight), errors, trends
