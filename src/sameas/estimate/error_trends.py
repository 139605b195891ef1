"""What errors grow with beside what is quoted: the magnitude of either source, the distance from the field's centre.

The covariance of a pair becomes

    S = a₁² Σ₁ + a₂² Σ₂ + t(x)² 1

with t² piecewise linear in x, its values at the knots found by maximum likelihood as the floor is in
:mod:`~sameas.estimate.error_model`, of which it is the floor that is not the same everywhere. A score test says first
whether residuals over their modelled errors change with x at all; a trend is believed where it betters the likelihood
by more than its parameters do by chance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.estimate.coverage import Coverage
from sameas.estimate.error_model import FEWEST, fit_variances, log_likelihood, with_spread
from sameas.estimate.photometry import Photometry
from sameas.evidence import Errors
from sameas.gate import Pairs
from sameas.records import Records, unpack
from sameas.representation import in_short
from sameas.space import Plane, unit_vectors


@dataclass(frozen=True)
class TrendTuning:
    """When errors are believed to grow; all chosen.

    Attributes
    ----------
    telling, rising : pairs less probable than this tell nothing; less than the second, not by other errors either.
    knots, per_knot : knots of a trend at most, and pairs to each at least.
    promising : ln of the likelihood that a score test must promise, and a trend better, beside what chance gives.
    refining, refined : fits of a trend with the probabilities by it, at most, and ln of the likelihood that the last is
        worth.
    least_factor : quoted errors count for this part of themselves at least.
    widest_deg : a field that reaches farther from its middle, in degrees, has no centre.
    """

    telling: float = 0.05
    rising: float = 1e-4
    knots: int = 7
    per_knot: float = 60.0
    promising: float = 6.0
    refining: int = 12
    refined: float = 0.5
    least_factor: float = 1e-3
    widest_deg: float = 20.0


DEFAULT_TRENDS = TrendTuning()


@dataclass(frozen=True)
class Trend:
    """How errors change with a quantity, beside what is quoted.

    source : 0 or 1, whose records it is told by. quantity : "magnitude" or "distance from the centre". unit : of it.
    at : (k,) knots. added : (k,) variance there per axis, in the unit of the residuals squared, beside what is quoted;
    linear between knots and constant beyond. sigma : (k,) all of the error of pairs about there, per axis.
    """

    source: int
    quantity: str
    unit: str
    at: FloatArray
    added: FloatArray
    sigma: FloatArray

    def variance(self, x: FloatArray) -> FloatArray:
        """(n,) variances per axis; where ``x`` (n,) is not known, that of the middle knot."""
        known = np.where(np.isfinite(x), x, self.at[len(self.at) // 2])
        return np.asarray(np.interp(known, self.at, self.added))

    def words(self, name: str, scale: float = 1.0) -> str:
        """The error at the first, the middle and the last knot, by a source of this name, ``scale`` times as large.

        >>> at, sigma = np.array([15.0, 19.0, 21.5]), np.array([0.02, 0.1, 0.4])
        >>> Trend(0, "magnitude", "", at, sigma**2, sigma).words("plate")
        'by magnitude (plate): 0.02 at 15, 0.1 at 19, 0.4 at 21.5'
        """
        of = f" ({name})" if self.quantity == "magnitude" else ""
        some = [0, len(self.at) // 2, len(self.at) - 1]
        at = ", ".join(f"{scale * self.sigma[k]:.2g} at {self.at[k]:.3g}{self.unit}" for k in some)
        return f"by {self.quantity}{of}: {at}"


@in_short
@dataclass(frozen=True)
class Covariate:
    """A quantity that errors may grow with: ``values`` (n_table,) by the rows of a source's table, NaN if unknown."""

    source: int
    quantity: str
    unit: str
    values: FloatArray

    def of(self, pairs: Pairs) -> FloatArray:
        """(m,) of pairs."""
        records, at = (pairs.first, pairs.i) if self.source == 0 else (pairs.second, pairs.j)
        return self.values[records.rows[at]]


def covariates(
    coverage: Coverage, photometry: Photometry | None, tuning: TrendTuning = DEFAULT_TRENDS
) -> list[Covariate]:
    """What the errors of these records may grow with."""
    found, sides = [], (coverage.first, coverage.second)
    if photometry is not None:
        for source, (records, side) in enumerate(zip(sides, photometry.sides, strict=True)):
            measured = np.isfinite(side.measured.values)
            band = int(np.argmax(measured.sum(axis=0)))
            values = _by_row(records, side.measured.values[:, band])
            found.append(Covariate(source, "magnitude", "", values))
    distance = _from_centre(coverage.first, tuning.widest_deg)
    if distance is not None:
        found.append(Covariate(0, "distance from the centre", "°", _by_row(coverage.first, distance)))
    return found


def _by_row(records: Records, values: FloatArray) -> FloatArray:
    by_row = np.full(records.n_table, np.nan)
    by_row[records.rows] = values
    return by_row


def _from_centre(records: Records, widest_deg: float) -> FloatArray | None:
    """(n,) distance from the middle of a field on the sky, degrees; None where it is too wide to be one field."""
    if isinstance(records.space, Plane) or np.ptp(records.features[:, 1]) > 2.0 * widest_deg:
        return None
    place = unit_vectors(*records.features.T).T
    middle = np.array([0.5 * (x.min() + x.max()) for x in place])
    length = max(float(np.linalg.norm(middle)), 1e-9)
    chord_sq = sum((x - m) ** 2 for x, m in zip(place, middle / length, strict=True))
    distance = np.degrees(2.0 * np.arcsin(np.minimum(0.5 * np.sqrt(chord_sq), 1.0)))
    return distance if float(distance.max()) < widest_deg else None


def with_trends(
    errors: Errors,
    pairs: Pairs,
    p_pair: FloatArray,
    known: Sequence[Covariate],
    most: int,
    believed: Sequence[Trend] = (),
    tuning: TrendTuning = DEFAULT_TRENDS,
) -> tuple[Errors, tuple[Trend, ...], float]:
    """Errors that grow with what these pairs show them to grow with, and by how much ln of their likelihood betters.

    errors : the model to be bettered. p_pair : (m,) probabilities. most : pairs learned from, at most. believed :
    trends that these errors have already: they are fitted again.

    Source: METHOD 11.1.
    """
    telling = np.flatnonzero(p_pair > tuning.telling)
    telling = telling[:: max(1, -(-len(telling) // most))]
    some, weight = pairs.part(telling), p_pair[telling]
    if float(weight.sum()) < FEWEST:
        return errors, (), 0.0
    number = int(min(tuning.knots, float(weight.sum()) / tuning.per_knot))
    score = _score(errors, errors.pairs(some).mahalanobis_sq, pairs.d)
    had = {(trend.source, trend.quantity) for trend in believed}
    asked = [hats for one in known if (hats := _Hats.of(one, some, weight, number)) is not None]
    asked = [hats for hats in asked if hats.key in had or hats.promise(score, weight) > tuning.promising]
    if not asked:
        return errors, (), 0.0
    now = log_likelihood(errors, some, weight)
    best: tuple[float, Errors, tuple[Trend, ...]] = (now if not believed else -math.inf, errors, ())
    taken: list[_Hats] = []
    while len(taken) < len(asked):
        fits = [(hats, *_fitted(some, weight, [*taken, hats], tuning)) for hats in asked if hats not in taken]
        hats, there, model, trends = max(fits, key=lambda fit: fit[1])
        if there - best[0] < tuning.promising + 0.5 * number * math.log(float(weight.sum())):
            break
        best = there, model, trends
        taken.append(hats)
    if not taken:
        return errors, (), 0.0
    competing = _Competing.of(errors, pairs, p_pair, most, tuning)
    before = competing.under(with_spread(errors, some, weight))[1]
    model, trends, there = _refined(competing, best, taken, tuning)
    return model, trends, there - before


def _refined(
    competing: _Competing,
    begin: tuple[float, Errors, tuple[Trend, ...]],
    taken: Sequence[_Hats],
    tuning: TrendTuning,
) -> tuple[Errors, tuple[Trend, ...], float]:
    """The same fitted again and again, with the probabilities that candidates have by it, and ln of the likelihood."""
    (_, errors, trends), all_hats = begin, [each.at(competing.pairs) for each in taken]
    weight, gain = competing.p, -math.inf
    for _ in range(tuning.refining):
        telling = weight > tuning.telling
        some = competing.pairs.part(np.flatnonzero(telling))
        weight, better = competing.under(with_spread(errors, some, weight[telling]))
        if better - gain < tuning.refined:
            break
        gain, telling = better, weight > tuning.telling
        some, hats = competing.pairs.part(np.flatnonzero(telling)), [each.part(telling) for each in all_hats]
        _, errors, trends = _fitted(some, weight[telling], hats, tuning)
    return errors, trends, gain


@in_short
@dataclass(frozen=True)
class _Competing:
    """All candidates of some records of source 1, of which each has one or none.

    p, log_density : (m,) the probabilities of the pairs, and ln of the density of their residuals in these.
    """

    pairs: Pairs
    p: FloatArray
    log_density: FloatArray

    @classmethod
    def of(cls, errors: Errors, pairs: Pairs, p_pair: FloatArray, most: int, tuning: TrendTuning) -> _Competing:
        """Of so many records, at most, that probably have a partner."""
        some = np.zeros(len(pairs.first), np.bool_)
        has = np.flatnonzero(np.bincount(pairs.i, p_pair, len(some)) > tuning.telling)
        some[has[:: max(1, -(-len(has) // most))]] = True
        kept = np.flatnonzero(some[pairs.i] & (p_pair > tuning.rising))
        part = pairs.part(kept)
        return cls(part, p_pair[kept], errors.log_density(part))

    def under(self, errors: Errors) -> tuple[FloatArray, float]:
        """(m,) probabilities by other errors, and by how much ln of the likelihood of all that is seen betters."""
        n = len(self.pairs.first)
        odds = self.p * np.exp(np.clip(errors.log_density(self.pairs) - self.log_density, -50.0, 50.0))
        none = np.maximum(1.0 - np.bincount(self.pairs.i, self.p, n), 1e-9)
        total = none + np.bincount(self.pairs.i, odds, n)
        return odds / total[self.pairs.i], float(np.log(total).sum())


@in_short
@dataclass(frozen=True, eq=False)
class _Hats:
    """Piecewise linear functions of a covariate x: (k, m) ``hats`` of pairs, one at each of the ``knots`` (k,)."""

    covariate: Covariate
    knots: FloatArray
    hats: FloatArray

    def at(self, pairs: Pairs) -> _Hats:
        """The same functions of other pairs."""
        x = self.covariate.of(pairs)
        known = np.where(np.isfinite(x), x, self.knots[len(self.knots) // 2])
        return replace(self, hats=np.array([np.interp(known, self.knots, one) for one in np.eye(len(self.knots))]))

    def part(self, some: BoolArray) -> _Hats:
        """Of some pairs."""
        return replace(self, hats=self.hats[:, some])

    @property
    def key(self) -> tuple[int, str]:
        return self.covariate.source, self.covariate.quantity

    @classmethod
    def of(cls, covariate: Covariate, pairs: Pairs, weight: FloatArray, number: int) -> _Hats | None:
        """Knots with as many pairs between each two; None where x is hardly known, or hardly varies."""
        x = covariate.of(pairs)
        finite = np.isfinite(x)
        if float(weight[finite].sum()) < max(FEWEST, 0.5 * float(weight.sum())):
            return None
        order = np.flatnonzero(finite)[np.argsort(x[finite], kind="stable")]
        cumulated = np.cumsum(weight[order])
        at = np.searchsorted(cumulated, np.linspace(0.02, 0.98, number) * cumulated[-1])
        knots = np.unique(x[order][np.minimum(at, len(order) - 1)])
        if len(knots) < 3:
            return None
        return cls(covariate, knots, np.empty(0)).at(pairs)

    def promise(self, score: FloatArray, weight: FloatArray) -> float:
        """What changes with x promise ln of the likelihood to better by, but for what chance gives, to second order."""
        slope = self.hats @ (weight * score)
        information = (self.hats * (weight * score**2)) @ self.hats.T
        gain = 0.5 * float(slope @ np.linalg.lstsq(information, slope, rcond=1e-9)[0])
        return gain - 0.5 * len(slope)

    def trend(self, added: FloatArray, all_of_it: FloatArray, weight: FloatArray) -> Trend:
        """With these variances (k,) at the knots, where all that of the pairs is (m,)."""
        one, shares = self.covariate, self.hats * weight
        sigma = np.sqrt(shares @ all_of_it / shares.sum(axis=1))
        return Trend(one.source, one.quantity, one.unit, self.knots, added, sigma)


def _score(errors: Errors, square: FloatArray, d: int) -> FloatArray:
    """(m,) how ln of the density of residuals changes with ln of all errors. square : (m,) normalised, by the model."""
    scales, shares = np.asarray(errors.scales), np.asarray(errors.shares)
    member = np.log(np.maximum(shares, 1e-300)) - d * np.log(scales) - 0.5 * square[:, None] / scales**2
    member = np.exp(member - member.max(axis=1, keepdims=True))
    member /= member.sum(axis=1, keepdims=True)
    return np.asarray(square * (member / scales**2).sum(axis=1) - d)


def _fitted(
    pairs: Pairs, weight: FloatArray, hats: Sequence[_Hats], tuning: TrendTuning
) -> tuple[float, Errors, tuple[Trend, ...]]:
    """ln of the likelihood of pairs with errors that grow with all of these, the errors, and how they grow."""
    one, two = (unpack(of.covariance[at], pairs.d) for of, at in ((pairs.first, pairs.i), (pairs.second, pairs.j)))
    unit = float(np.median(np.einsum("mvv->m", one + two))) / pairs.d
    level = unit * np.eye(pairs.d)
    parts = np.stack([one, two, *(hat[:, None, None] * level for each in hats for hat in each.hats)])
    theta = fit_variances(pairs.residual, weight, parts)
    all_of_it = np.einsum("k,kmvv->m", theta, parts) / pairs.d
    ends = np.cumsum([2, *(len(each.hats) for each in hats)])
    trends = tuple(
        each.trend(unit * theta[begin:end], all_of_it, weight)
        for each, begin, end in zip(hats, ends, ends[1:], strict=False)
    )
    added: list[FloatArray | None] = [None, None]
    for trend, each in zip(trends, hats, strict=True):
        more, before = trend.variance(each.covariate.values), added[trend.source]
        added[trend.source] = more if before is None else before + more
    factors = np.maximum(np.sqrt(theta[:2]), tuning.least_factor).tolist()
    errors = Errors(factor_1=factors[0], factor_2=factors[1], added=(added[0], added[1]))
    return log_likelihood(errors, pairs, weight), errors, trends
