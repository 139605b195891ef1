"""Brightness and colour as evidence: do two magnitudes belong to one object, and would the other source show it?

Objects are a Poisson field with magnitudes (METHOD 3.4, 4.3). Beside its position a pair weighs

    ln p(m₁, m₂ | one object) − ln p(m₁) − ln p(m₂)   and   what the magnitudes say of being shown by both sources.

The first is the mean of both ways to take it apart, p(m₁ | m₂) / p(m₁) and p(m₂ | m₁) / p(m₂), each band after band
(:class:`Chain`). The second comes from the share of common objects at each magnitude (``sameas.detection``).
``sameas.photometry`` learns both; the user gives :class:`Magnitudes`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.errors import InputError
from sameas.evidence.relation import MagnitudeDensity, Relation
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.records import FloatArray, Records

#: Which of a magnitude's possible regressors are measured.
Pattern = tuple[bool, ...]


@dataclass(frozen=True)
class Magnitudes:
    """Magnitudes of every row of one source's table, in one or more bands.

    Parameters
    ----------
    values : (n_table,) or (n_table, bands), mag; NaN or masked where not measured. The completeness is learned of the
        first band.
    sigma : one number, or of the shape of ``values``: 1σ errors, mag. Where they are NaN or not given, the scatter
        that is learned stands for them.
    names : of the bands, for reports.

    Example
    -------
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
        object.__setattr__(self, "values", np.where(np.isfinite(values), values, np.nan))
        object.__setattr__(self, "sigma", _sigmas(self.sigma, values))
        object.__setattr__(self, "names", tuple(names))

    @property
    def bands(self) -> int:
        """Number of bands."""
        return int(np.shape(self.values)[1])

    def of(self, records: Records) -> Measured:
        """The magnitudes at a source's usable records.

        Raises
        ------
        InputError : they are not those of its table.
        """
        values = np.asarray(self.values)
        if len(values) != records.n_table:
            raise InputError(
                f"{records.source}: {len(values)} magnitudes for {records.n_table} rows; "
                "give one for every row of its table"
            )
        return Measured(values[records.rows], np.asarray(self.sigma)[records.rows] ** 2)


def _numbers(values: ArrayLike) -> FloatArray:
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"magnitudes are not numbers ({error})") from None


def _sigmas(sigma: ArrayLike | None, values: FloatArray) -> FloatArray:
    """The errors in the shape of the values; 0 where not known."""
    given = np.zeros(()) if sigma is None else _numbers(sigma)
    given = given[:, None] if given.ndim == 1 and len(given) == len(values) else given
    try:
        given = np.broadcast_to(given, values.shape)
    except ValueError:
        raise InputError(
            f"errors of magnitudes have shape {given.shape} for magnitudes {values.shape}; give one number, or one each"
        ) from None
    with np.errstate(invalid="ignore"):
        wrong = np.flatnonzero((given < 0.0).any(axis=1))
    if len(wrong):
        raise InputError(
            f"errors of magnitudes: {len(wrong)} are negative (first: row {wrong[0]}); "
            "give 1σ errors in mag, NaN where not known"
        )
    return np.where(np.isfinite(given), given, 0.0)


@dataclass(frozen=True)
class Measured:
    """Magnitudes (n, bands), NaN where not measured, and the variances of their quoted errors."""

    values: FloatArray
    variance: FloatArray

    def take(self, rows: NDArray[np.integer]) -> Measured:
        """Some rows."""
        return Measured(self.values[rows], self.variance[rows])


@dataclass(frozen=True)
class Regressors:
    """Rows whose band has the same ``pattern`` of regressors: earlier bands of its source, then the other source's.

    rows : (r,) which rows. y, variance : (r,) the magnitude and its variance. others, other_variance : (r, ·) of the
    regressors that are measured.
    """

    pattern: Pattern
    rows: NDArray[np.int64]
    y: FloatArray
    variance: FloatArray
    others: FloatArray
    other_variance: FloatArray

    @classmethod
    def split(cls, band: int, own: Measured, other: Measured | None) -> Iterator[Regressors]:
        """All rows where the band and a regressor of the other source are measured, or of its own without another."""
        values, variance = own.values[:, :band], own.variance[:, :band]
        if other is not None:
            values, variance = np.hstack([values, other.values]), np.hstack([variance, other.variance])
        measured = np.isfinite(values)
        needed = measured[:, band:] if other is not None else measured
        usable = np.isfinite(own.values[:, band]) & needed.any(axis=1)
        code = np.where(usable, measured @ (1 << np.arange(measured.shape[1])), -1)
        for number in np.unique(code[usable]):
            rows = np.flatnonzero(code == number)
            pattern = tuple(bool(number >> bit & 1) for bit in range(measured.shape[1]))
            at = np.ix_(rows, np.flatnonzero(pattern))
            yield cls(pattern, rows, own.values[rows, band], own.variance[rows, band], values[at], variance[at])

    def log_density(self, relation: Relation, background: FloatArray) -> FloatArray:
        """(r,) ln p of the band by a relation to these regressors; (r,) the background's density."""
        return relation.log_density(self.y, self.others, self.variance, self.other_variance, background)

    def of_own(self, band: int) -> Regressors:
        """With the regressors of the band's own source only."""
        kept = sum(self.pattern[:band])
        others, variance = self.others[:, :kept], self.other_variance[:, :kept]
        return Regressors(self.pattern[:band], self.rows, self.y, self.variance, others, variance)


@dataclass(frozen=True)
class Side:
    """What is known of one source's magnitudes before the sources are compared.

    densities : of all its records, per band; None where too few are measured. alone : per band how it follows the
    earlier bands, by the pattern of those that are measured.
    """

    measured: Measured
    densities: tuple[MagnitudeDensity | None, ...]
    alone: tuple[Mapping[Pattern, Relation], ...]

    def compared(self, rows: NDArray[np.integer], other: Measured) -> Compared:
        """Some of its records, (m,) ``rows``, beside the magnitudes ``other`` of those they are compared with."""
        own = self.measured.take(rows)
        bands: list[tuple[Comparison, ...]] = []
        for band, (density, alone) in enumerate(zip(self.densities, self.alone, strict=True)):
            comparisons = []
            if density is None:
                bands.append(())
                continue
            for these in Regressors.split(band, own, other):
                log_background, earlier = density(these.y), these.pattern[:band]
                background = np.exp(log_background)
                if not any(earlier):
                    comparisons.append(Comparison(these, background, log_background))
                elif earlier in alone:
                    without = these.of_own(band).log_density(alone[earlier], background)
                    comparisons.append(Comparison(these, background, without))
            bands.append(tuple(comparisons))
        return Compared(len(rows), tuple(bands))


@dataclass(frozen=True)
class Comparison:
    """A band with its regressors; (r,) p of it by its background, and ln p by the earlier bands of its own source."""

    regressors: Regressors
    background: FloatArray
    log_without: FloatArray


@dataclass(frozen=True)
class Compared:
    """All comparisons of m pairs, per band of one source."""

    m: int
    bands: tuple[tuple[Comparison, ...], ...]


@dataclass(frozen=True)
class Chain:
    """ln p(m of one source | m of the other) − ln p(m of one source), band after band.

    ``related[k]`` holds the density of band k given its source's earlier bands and the other source's, by pattern of
    what is measured. What has no relation, because hardly any pair has such magnitudes, says nothing.
    """

    related: tuple[Mapping[Pattern, Relation], ...]

    def log_ratio(self, compared: Compared) -> FloatArray:
        """(m,) for the magnitudes of both sides of the pairs."""
        total = np.zeros(compared.m)
        for related, comparisons in zip(self.related, compared.bands, strict=True):
            for comparison in comparisons:
                these, relation = comparison.regressors, related.get(comparison.regressors.pattern)
                if relation is not None:
                    total[these.rows] += these.log_density(relation, comparison.background) - comparison.log_without
        return total


@dataclass(frozen=True)
class Brightness(Rule):
    """What the magnitudes of a pair say, as learned by ``sameas.photometry``; add it to a rule of positions.

    Parameters
    ----------
    sides : what is known of either source's magnitudes.
    chains : of source 1 given source 2, and the reverse; None where nothing could be learned.
    shown_1, shown_2 : (n₁,), (n₂,) what a record's magnitude says of its being shown by both sources: terms that
        turn the shares at its position into those at its position and magnitude.
    known : pairs for which the comparisons are already there, and these.
    """

    sides: tuple[Side, Side] = field(repr=False)
    chains: tuple[Chain, Chain] | None = field(repr=False)
    shown_1: FloatArray = field(repr=False)
    shown_2: FloatArray = field(repr=False)
    known: tuple[Pairs, tuple[Compared, Compared]] | None = field(repr=False, default=None)

    def __call__(self, pairs: Pairs) -> Evidence:
        terms = {"completeness": self.shown_1[pairs.i] + self.shown_2[pairs.j]}
        if self.chains is not None:
            there = self.known is not None and self.known[0] is pairs
            forth, back = self.known[1] if there and self.known else compared(self.sides, pairs)
            terms["brightness"] = 0.5 * (self.chains[0].log_ratio(forth) + self.chains[1].log_ratio(back))
        return Evidence(terms)


def compared(sides: tuple[Side, Side], pairs: Pairs) -> tuple[Compared, Compared]:
    """The magnitudes of all pairs: of source 1 beside those of source 2, and the reverse."""
    one, two = sides
    return (
        one.compared(pairs.i, two.measured.take(pairs.j)),
        two.compared(pairs.j, one.measured.take(pairs.i)),
    )
