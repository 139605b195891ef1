"""Brightness and colour as evidence: whether two magnitudes are of one object, and whether both sources would show it.

Objects are a Poisson field with magnitudes (METHOD 3.4, 4.3). In addition to its position, the evidence of a pair is

    ln p(m₁, m₂ | one object) − ln p(m₁) − ln p(m₂)   and   the log-odds that both sources show such magnitudes.

The first term is the mean of its two factorizations, p(m₁ | m₂) / p(m₁) and p(m₂ | m₁) / p(m₂), band after band
(:class:`Chain`). The second comes from the share of common objects by magnitude (``sameas.evidence.detection``).
``sameas.estimate.photometry`` fits both; the user gives :class:`Magnitudes`. The densities are those of all magnitudes
of a source (:class:`MagnitudeDensity`), and of one given others of the same object (:class:`Relation`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import ABSENT, FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence.detection import ShareCurve
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.records import Records
from sameas.representation import in_short


@in_short
@dataclass(frozen=True)
class MagnitudeDensity:
    """Density of the magnitudes of all records of a source in one band, 1/mag: a smoothed histogram.

    grid : (g,) mag, evenly spaced. log_density : (g,).
    """

    grid: FloatArray
    log_density: FloatArray

    def __call__(self, magnitude: FloatArray) -> FloatArray:
        """(n,) ln p at magnitudes (n,)."""
        return np.interp(magnitude, self.grid, self.log_density)


@in_short
@dataclass(frozen=True)
class Relation:
    """Density of one magnitude, given one or more others of the same object.

    The mean is the first of the others, plus a curve of it, plus linear terms in the colours. Residuals are a mixture
    of normals, whose variance is that of the quoted errors plus a scatter that depends on the first of the others. The
    share ``unrelated`` follows ``background`` instead, which is the lower limit of the density at any difference.

    knots, offset, scatter : (k,) magnitudes, and there the mean difference and the scatter beyond quoted errors, mag.
    slopes, centres : (c,) mag per mag of colour, about these colours: the other magnitudes minus the first of them.
        The mean is conditional on measured magnitudes, as needed to predict measured pairs: errors of the colours make
        its slopes smaller than those on true colours (regression dilution).
    scales, shares : of the mixture's normals, in units of error and scatter together.
    unrelated : the share that follows ``background``.
    covariance : (k + c, k + c) of offset and slopes, from the fitted pairs.
    mean_basis : (k + c,) basis averaged over these pairs.
    scatter_error : standard error of the typical scatter, mag. weight : expected number of these pairs.
    """

    knots: FloatArray
    offset: FloatArray
    scatter: FloatArray
    slopes: FloatArray
    centres: FloatArray
    scales: FloatArray
    shares: FloatArray
    unrelated: float
    background: MagnitudeDensity
    covariance: FloatArray
    mean_basis: FloatArray
    scatter_error: float
    weight: float

    @property
    def zero_point(self) -> float:
        """Mean difference of the pairs, mag: the magnitude minus the first of the others."""
        return float(self.mean_basis @ np.concatenate([self.offset, self.slopes]))

    @property
    def zero_point_error(self) -> float:
        """Its standard error, mag."""
        return math.sqrt(max(float(self.mean_basis @ self.covariance @ self.mean_basis), 0.0))

    @property
    def slope_errors(self) -> FloatArray:
        """(c,) standard errors of the slopes."""
        k = len(self.knots)
        return np.sqrt(np.diag(self.covariance)[k:])

    @property
    def typical_scatter(self) -> float:
        """Scatter beyond the quoted errors, mag: root mean square over the pairs."""
        share = self.mean_basis[: len(self.knots)]
        return math.sqrt(float(share @ self.scatter**2) / max(float(share.sum()), 1e-300))

    def log_density(
        self,
        y: FloatArray,
        others: FloatArray,
        variance: FloatArray,
        other_variance: FloatArray,
        background: FloatArray,
    ) -> FloatArray:
        """(m,) ln p of magnitudes y (m,) given others (m, 1 + c), with variances of both and the background p at y."""
        from sameas.kernels.relation import log_mixture

        relation = (
            self.offset,
            self.scatter,
            self.slopes,
            self.centres,
            self.scales,
            np.append(self.shares, self.unrelated),
        )
        out = np.empty(len(y))
        log_mixture(y, variance, others, other_variance, self.knots, relation, background, out)
        return out


@in_short
@dataclass(frozen=True)
class PartnerTilt:
    """The difference of the magnitudes of records with a partner from those of all records of a source.

    ln p(m | partner) − ln p(m) = ln s(m) − ln of the mean of s, with s(m) of ``curve`` about the logit ``middle``. The
    magnitudes of a pair are those of records with a partner even if they are unrelated.
    """

    curve: ShareCurve
    middle: float
    log_mean: float

    @classmethod
    def of(cls, curve: ShareCurve | None, magnitude: FloatArray, share: float) -> PartnerTilt | None:
        """From a source's magnitudes (n,), NaN where missing, and its mean share; None without a curve."""
        known = magnitude[np.isfinite(magnitude)]
        if curve is None or not len(known) or not 0.0 < share < 1.0:
            return None
        middle = math.log(share / (1.0 - share))
        logs = _log_share(middle + curve.logit(known[:: max(1, len(known) // 10_000)]))
        return cls(curve, middle, float(np.log(np.exp(logs).mean())))

    def __call__(self, magnitude: FloatArray) -> FloatArray:
        """(n,) at measured magnitudes (n,)."""
        return _log_share(self.middle + self.curve.logit(magnitude)) - self.log_mean


def _log_share(logit: FloatArray) -> FloatArray:
    return -np.logaddexp(0.0, -logit)


#: Which of the possible regressors of a magnitude are measured.
Pattern = tuple[bool, ...]


@in_short
@dataclass(frozen=True)
class Magnitudes:
    """Magnitudes of every row of one source's table, in one or more bands.

    values : (n_table,) or (n_table, bands), mag; NaN or masked where not measured. The completeness is estimated for
        the first band.
    sigma : one number, or of the shape of ``values``: 1σ errors, mag. Where NaN or not given, the fitted scatter
        includes them.
    names : of the bands, for reports.

    >>> from sameas.evidence import Magnitudes
    >>> Magnitudes([[15.2, 14.8], [16.0, float("nan")]], sigma=0.02, names=("G", "J")).bands
    2
    """

    values: ArrayLike
    sigma: ArrayLike | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        values = _numbers(self.values)
        values = values[:, None] if values.ndim == 1 else values
        if values.ndim != 2 or not values.shape[1]:
            raise InputError(f"magnitudes have shape {values.shape}; give (rows,) or (rows, bands)")
        names = self.names or tuple(f"band {k + 1}" for k in range(values.shape[1]))
        if len(names) != values.shape[1]:
            raise InputError(f"{len(names)} names for {values.shape[1]} bands of magnitudes; give one for each")
        infinite = np.isinf(values)
        object.__setattr__(self, "values", np.where(infinite, np.nan, values) if infinite.any() else values)
        object.__setattr__(self, "sigma", _sigmas(self.sigma, values))
        object.__setattr__(self, "names", tuple(names))

    @property
    def bands(self) -> int:
        """Number of bands."""
        return int(np.shape(self.values)[1])

    def of(self, records: Records) -> MeasuredMagnitudes:
        """The magnitudes at a source's usable records.

        Raises InputError: the number of magnitudes differs from that of the table's rows.
        """
        values = np.asarray(self.values)
        if len(values) != records.n_table:
            raise InputError(
                f"{records.source}: {len(values)} magnitudes for {records.n_table} rows; "
                "give one for every row of its table"
            )
        sigma, rows = np.asarray(self.sigma), records.rows
        if not sigma.any():
            sigma = np.broadcast_to(0.0, values.shape)  # takes no memory
        if len(rows) < len(values) or not (rows[1:] > rows[:-1]).all():
            values, sigma = values[rows], sigma[rows] if sigma.strides[0] else sigma[: len(rows)]
        return MeasuredMagnitudes(values, sigma**2 if sigma.strides[0] else sigma)


def _numbers(values: ArrayLike) -> FloatArray:
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"magnitudes are not numbers ({error})") from None


def _sigmas(sigma: ArrayLike | None, values: FloatArray) -> FloatArray:
    """The errors in the shape of the values; 0 where unknown."""
    if sigma is None:
        return np.broadcast_to(0.0, values.shape)
    given = _numbers(sigma)
    given = given[:, None] if given.ndim == 1 and len(given) == len(values) else given
    try:
        given = np.broadcast_to(given, values.shape)
    except ValueError:
        raise InputError(
            f"errors of magnitudes have shape {given.shape} for magnitudes {values.shape}; give one number, or one each"
        ) from None
    with np.errstate(invalid="ignore"):
        negative = np.flatnonzero((given < 0.0).any(axis=1))
    if len(negative):
        raise InputError(
            f"errors of magnitudes: {len(negative)} are negative (first: row {negative[0]}); "
            "give 1σ errors in mag, NaN where not known"
        )
    return np.where(np.isfinite(given), given, 0.0)


@in_short
@dataclass(frozen=True)
class MeasuredMagnitudes:
    """Magnitudes (n, bands), NaN where not measured, and the variances of their quoted errors."""

    values: FloatArray
    variance: FloatArray

    def take(self, rows: NDArray[np.integer]) -> MeasuredMagnitudes:
        """The magnitudes of some rows."""
        return MeasuredMagnitudes(self.values[rows], self.variance[rows])


@in_short
@dataclass(frozen=True)
class Regressors:
    """Rows with the same ``pattern`` of measured regressors: earlier bands of their source, then the other source's.

    rows : (r,) indices. y, variance : (r,) the magnitude and its variance. others, other_variance : (r, ·) of the
    measured regressors.
    """

    pattern: Pattern
    rows: IntArray
    y: FloatArray
    variance: FloatArray
    others: FloatArray
    other_variance: FloatArray

    @classmethod
    def split(cls, band: int, own: MeasuredMagnitudes, other: MeasuredMagnitudes | None) -> Iterator[Regressors]:
        """All rows with the band and a regressor of the other source (or of its own, without another) measured."""
        values, variance = own.values[:, :band], own.variance[:, :band]
        if other is not None:
            values, variance = np.hstack([values, other.values]), np.hstack([variance, other.variance])
        measured = np.isfinite(values)
        needed = measured[:, band:] if other is not None else measured
        usable = np.isfinite(own.values[:, band]) & needed.any(axis=1)
        code = np.where(usable, measured @ (1 << np.arange(measured.shape[1])), ABSENT)
        for number in np.unique(code[usable]):
            rows = np.flatnonzero(code == number)
            pattern = tuple(bool(number >> bit & 1) for bit in range(measured.shape[1]))
            at = np.ix_(rows, np.flatnonzero(pattern))
            yield cls(pattern, rows, own.values[rows, band], own.variance[rows, band], values[at], variance[at])

    def log_density(self, relation: Relation, background: FloatArray) -> FloatArray:
        """(r,) ln p of the band given these regressors; ``background`` (r,) is the background's density."""
        return relation.log_density(self.y, self.others, self.variance, self.other_variance, background)

    def of_own(self, band: int) -> Regressors:
        """The rows with the regressors of the band's own source only."""
        count = sum(self.pattern[:band])
        others, variance = self.others[:, :count], self.other_variance[:, :count]
        return Regressors(self.pattern[:band], self.rows, self.y, self.variance, others, variance)


@in_short
@dataclass(frozen=True)
class SourceMagnitudes:
    """The magnitudes of one source and their densities, before a comparison with the other source.

    densities : of all its records, per band; None where too few are measured. alone : per band, its relation to the
    earlier bands, by the pattern of the measured ones.
    """

    measured: MeasuredMagnitudes
    densities: tuple[MagnitudeDensity | None, ...]
    alone: tuple[Mapping[Pattern, Relation], ...]

    def compared(self, rows: NDArray[np.integer], other: MeasuredMagnitudes) -> Comparisons:
        """The comparison of the records ``rows`` (m,) with the magnitudes ``other`` of their partners."""
        own = self.measured.take(rows)
        bands: list[tuple[Comparison, ...]] = []
        for band, (density, alone) in enumerate(zip(self.densities, self.alone, strict=True)):
            comparisons = []
            if density is None:
                bands.append(())
                continue
            for regressors in Regressors.split(band, own, other):
                log_background, earlier = density(regressors.y), regressors.pattern[:band]
                background = np.exp(log_background)
                if not any(earlier):
                    comparisons.append(Comparison(regressors, background, log_background))
                elif earlier in alone:
                    without = regressors.of_own(band).log_density(alone[earlier], background)
                    comparisons.append(Comparison(regressors, background, without))
            bands.append(tuple(comparisons))
        return Comparisons(len(rows), tuple(bands), own.values[:, 0])


@in_short
@dataclass(frozen=True)
class Comparison:
    """A band with its regressors; (r,) p of it by its background, and ln p given earlier bands of its own source."""

    regressors: Regressors
    background: FloatArray
    log_without: FloatArray


@in_short
@dataclass(frozen=True)
class Comparisons:
    """The comparisons of m pairs, per band of one source. first_band : (m,) magnitudes in the first, NaN if missing."""

    m: int
    bands: tuple[tuple[Comparison, ...], ...]
    first_band: FloatArray

    def tilted(self, tilt: PartnerTilt | None) -> Comparisons:
        """The same with the magnitudes of records with a partner as background of the first band."""
        if tilt is None or not self.bands:
            return self
        first = tuple(replace(one, background=one.background * np.exp(tilt(one.regressors.y))) for one in self.bands[0])
        return replace(self, bands=(first, *self.bands[1:]))


@in_short
@dataclass(frozen=True)
class Chain:
    """ln p(m of one source | m of the other) − ln p(m of one source), band after band.

    ``related[k]`` holds the density of band k given its source's earlier bands and the other source's, by pattern of
    the measured ones. A pattern without a relation, because hardly any pair has it, adds nothing. tilt : of the first
    band of pairs with unrelated magnitudes, or without a magnitude of the other source; None if these are distributed
    like those of all records.
    """

    related: tuple[Mapping[Pattern, Relation], ...]
    tilt: PartnerTilt | None = None

    @property
    def scatter(self) -> float:
        """Scatter of the first band beyond quoted errors, mag: the median along the relation of most pairs."""
        relation = max(self.related[0].values(), key=lambda relation: relation.weight, default=None)
        return 0.0 if relation is None else float(np.median(relation.scatter))

    def log_ratio(self, compared: Comparisons) -> FloatArray:
        """(m,) for the compared magnitudes of the pairs."""
        total = np.zeros(compared.m)
        for band, (related, comparisons) in enumerate(zip(self.related, compared.tilted(self.tilt).bands, strict=True)):
            if band == 0 and self.tilt is not None:
                known = np.isfinite(compared.first_band)
                total[known] = self.tilt(compared.first_band[known])
            for comparison in comparisons:
                regressors, relation = comparison.regressors, related.get(comparison.regressors.pattern)
                if relation is not None:
                    gain = regressors.log_density(relation, comparison.background) - comparison.log_without
                    total[regressors.rows] = gain if band == 0 else total[regressors.rows] + gain
        return total


@in_short
@dataclass(frozen=True)
class Brightness(Rule):
    """Evidence of a pair's magnitudes, fitted by ``sameas.estimate.photometry``; add it to a rule of positions.

    sides : the magnitudes of each source and their densities.
    chains : of source 1 given source 2, and the reverse; None without a fit.
    completeness_1, completeness_2 : (n₁,), (n₂,) change of a record's log-odds of being in both sources by its
        magnitude: from the share at its position to that at its position and magnitude.
    comparisons : pairs whose magnitudes are compared already, and the comparisons of both sources.
    """

    sides: tuple[SourceMagnitudes, SourceMagnitudes] = field(repr=False)
    chains: tuple[Chain, Chain] | None = field(repr=False)
    completeness_1: FloatArray = field(repr=False)
    completeness_2: FloatArray = field(repr=False)
    comparisons: tuple[Pairs, tuple[Comparisons, Comparisons]] | None = field(repr=False, default=None)

    def __call__(self, pairs: Pairs) -> Evidence:
        terms = {"completeness": self.completeness_1[pairs.i] + self.completeness_2[pairs.j]}
        if self.chains is not None:
            if self.comparisons is not None and self.comparisons[0] is pairs:
                terms["brightness"] = self._log_ratio(*self.comparisons[1])
            else:
                terms["brightness"] = brightness = np.empty(len(pairs))
                for first in range(0, len(pairs), COMPARED_AT_ONCE):
                    some = slice(first, first + COMPARED_AT_ONCE)
                    brightness[some] = self._log_ratio(*_compared(self.sides, pairs.i[some], pairs.j[some]))
        return Evidence(terms)

    def log_ratio_of_blend(
        self, i: NDArray[np.integer], j: NDArray[np.integer], source: int, flux: FloatArray
    ) -> FloatArray:
        """(q,) ln of the density of the magnitudes of pairs (i, j), if others add their light to the object of
        ``source`` (0 or 1), over that if it is alone.

        flux : (q,) of the others over that of the object. Their colours scatter like those of pairs.
        """
        if self.chains is None:
            return np.zeros(len(i))
        rows, taken = np.arange(len(i)), zip(self.sides, (i, j), strict=True)
        both = [replace(side, measured=side.measured.take(at)) for side, at in taken]
        alone = self._log_ratio(*_compared((both[0], both[1]), rows, rows))
        own, density = both[source].measured, both[source].densities[0]
        change, variance = (
            -2.5 * np.log10(1.0 + flux),
            2.0 * (self.chains[1 - source].scatter * flux / (1.0 + flux)) ** 2,
        )
        together = MeasuredMagnitudes(own.values + change[:, None], own.variance + variance[:, None])
        both[source] = replace(both[source], measured=together)
        log_ratio = self._log_ratio(*_compared((both[0], both[1]), rows, rows)) - alone
        if density is not None:  # the object's own magnitude is measured, and its density is the same in both
            log_ratio += 0.5 * np.nan_to_num(density(together.values[:, 0]) - density(own.values[:, 0]))
        return log_ratio

    def _log_ratio(self, forth: Comparisons, back: Comparisons) -> FloatArray:
        assert self.chains is not None
        return 0.5 * (self.chains[0].log_ratio(forth) + self.chains[1].log_ratio(back))


#: Pairs whose comparisons, some 200 bytes each, are in memory at the same time where nothing else needs them.
COMPARED_AT_ONCE = 1 << 17


def comparisons_of(sides: tuple[SourceMagnitudes, SourceMagnitudes], pairs: Pairs) -> tuple[Comparisons, Comparisons]:
    """The comparisons of all pairs: source 1 with source 2, and the reverse."""
    return _compared(sides, pairs.i, pairs.j)


def _compared(
    sides: tuple[SourceMagnitudes, SourceMagnitudes], i: NDArray[np.integer], j: NDArray[np.integer]
) -> tuple[Comparisons, Comparisons]:
    one, two = sides
    return one.compared(i, two.measured.take(j)), two.compared(j, one.measured.take(i))
