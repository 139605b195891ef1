"""Identity as evidence: MMSI, ICAO address, callsign, Mode A, name, type, length, each with a model of its errors.

Identities are evidence for or against one object, but never decide alone: addresses are shared, mistyped, off by a bit,
inherited from a neighbour, or forged. Each attribute that both records have gives a ratio
r_k = p(both values | one object) / p(both values | two objects); together they give

    λ = [(1 − g) R + g] / [(1 − s) + s R],   R = ∏ r_k,

with g the probability that a record carries another object's identity altogether, and s that a second object nearby has
the same identity. So ln λ stays between ln g and ln(1/s) for any number of attributes.

- :class:`Identity`: the rule; add it to a rule of positions: ``CloseObjects(a, b) + Identity({...})``.
- :class:`Code`, :class:`Category`, :class:`Size`, :class:`Frequency`: models of attributes; :data:`MODELS` for the
  usual ones.
- :func:`alarms`: records whose unique identities agree while their positions contradict.

Texts are compared in normalised spelling (:func:`plain`). Texts that differ by one bit or one typing error count as a
small error of one value (:func:`differ_by_one_bit`, :func:`differ_by_one_typing`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import DEFAULT_COMPLETENESS, ChiSquare, Pairs
from sameas.gaussian import mahalanobis_sq
from sameas.ragged import ranges
from sameas.records import Records, unpack
from sameas.representation import in_short
from sameas.space import Plane, wrapped


def plain(values: ArrayLike, unknown: Sequence[str] = ()) -> NDArray[Any]:
    """(n,) numbers unchanged; texts in capitals, without surrounding spaces, "" where missing or in ``unknown``.

    Integers count as texts: an MMSI is a name, not a size.
    """
    if isinstance(values, np.ma.MaskedArray):
        masked, values = np.ma.getmaskarray(values), values.data.astype(object)
        values[masked] = None
    array = np.asarray(values)
    if array.dtype.kind == "f":
        return array.astype(np.float64)
    cells = array.astype(object)
    if all(cell is None or isinstance(cell, float | np.floating) for cell in cells):
        return np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64)
    missing = {"", "NONE", "NAN", *(text.upper() for text in unknown)}
    texts = (("" if cell is None else str(cell)).strip().upper() for cell in cells)
    return np.array(["" if text in missing else text for text in texts], dtype=np.str_)


#: Most bits of an address.
BITS = 60


def differ_by_one_bit(first: NDArray[Any], second: NDArray[Any]) -> BoolArray:
    """(m,) whether two hexadecimal addresses differ in one bit; False where either is not hexadecimal."""
    a, b = _hexadecimal(first), _hexadecimal(second)
    difference = a ^ b
    return np.asarray((a >= 0) & (b >= 0) & (difference != 0) & ((difference & (difference - 1)) == 0))


def n_one_bit_apart(asked: NDArray[Any], values: NDArray[Any]) -> IntArray:
    """(k,) how many of some addresses differ from each of those asked for as of :func:`differ_by_one_bit`."""
    a, known = _hexadecimal(asked), np.sort(_hexadecimal(values))
    flipped = a[:, None] ^ (1 << np.arange(BITS))
    return np.where(a >= 0, _n_equal(flipped, known).sum(axis=1), 0)


def _n_equal(asked: NDArray[Any], ascending: NDArray[Any]) -> IntArray:
    """How many of some values, in ascending order, equal each of those asked for."""
    return np.searchsorted(ascending, asked, side="right") - np.searchsorted(ascending, asked)


def _hexadecimal(texts: NDArray[Any]) -> IntArray:
    """(n,) values of texts of up to :data:`BITS` / 4 hexadecimal digits; ABSENT for other texts."""
    values, index = np.unique(texts, return_inverse=True)
    numbers = np.full(len(values), ABSENT, np.int64)
    for k, text in enumerate(values):
        if 0 < 4 * len(text) <= BITS and not set(text) - set("0123456789ABCDEF"):
            numbers[k] = int(text, 16)
    return numbers[index]


def differ_by_one_typing(first: NDArray[Any], second: NDArray[Any]) -> BoolArray:
    """(m,) whether one letter was replaced, dropped or added, or two neighbours swapped (Damerau 1964)."""
    a, b = _letters(first, second)
    width = a.shape[1]
    long_a, long_b = np.count_nonzero(a, axis=1), np.count_nonzero(b, axis=1)
    unequal = a != b
    differing = unequal.sum(axis=1)
    at = unequal.argmax(axis=1)
    row, after = np.arange(len(a)), np.minimum(at + 1, width - 1)
    swapped = (differing == 2) & (a[row, at] == b[row, after]) & (a[row, after] == b[row, at]) & unequal[row, after]
    same_length = (long_a == long_b) & ((differing == 1) | swapped)
    longer = np.where((long_a > long_b)[:, None], a, b)
    shorter = np.where((long_a > long_b)[:, None], b, a)
    # The longer text without the letter at the first difference must equal the shorter one.
    column = np.arange(width - 1)
    without = np.where(column < at[:, None], longer[:, :-1], longer[:, 1:])
    dropped = (np.abs(long_a - long_b) == 1) & (without == shorter[:, :-1]).all(axis=1)
    return np.asarray(same_length | dropped)


def n_one_typing_apart(asked: NDArray[Any], values: NDArray[Any]) -> IntArray:
    """(k,) how many of some values, each there once, differ from each of those asked for as of
    :func:`differ_by_one_typing`."""
    a, b = _letters(asked, values)
    long_a, long_b = np.count_nonzero(a, axis=1), np.count_nonzero(b, axis=1)
    known, n = np.sort(_texts(b)), np.zeros(len(a), np.int64)
    for at in range(a.shape[1] - 1):
        without_a, without_b = (_texts(np.delete(letters, at, axis=1)) for letters in (a, b))
        # Of two equal neighbours either may be the one that was dropped.
        drops_a, drops_b = ((letters[:, at] != letters[:, at - 1]) | (at == 0) for letters in (a, b))
        inside_a, inside_b = long_a > at, long_b > at
        replaced = _n_equal(without_a, np.sort(without_b[inside_b])) - _n_equal(_texts(a), known)
        n += np.where(inside_a, replaced, 0)
        n += np.where(inside_a & drops_a, _n_equal(without_a, known), 0)
        n += _n_equal(_texts(a), np.sort(without_b[inside_b & drops_b]))
        swapped = a.copy()
        swapped[:, [at, at + 1]] = a[:, [at + 1, at]]
        swaps = (long_a > at + 1) & (a[:, at] != a[:, at + 1])
        n += np.where(swaps, _n_equal(_texts(swapped), known), 0)
    return n


def _letters(*texts: NDArray[Any]) -> tuple[NDArray[np.uint32], ...]:
    """The letters of texts, one row each, all of one width with a 0 or more at the end."""
    width = max(4, *(one.dtype.itemsize for one in texts)) // 4 + 1
    return tuple(np.ascontiguousarray(one.astype(f"U{width}")).view(np.uint32).reshape(-1, width) for one in texts)


def _texts(letters: NDArray[np.uint32]) -> NDArray[np.str_]:
    """The texts of rows of letters."""
    return np.ascontiguousarray(letters).view(f"U{letters.shape[1]}")[:, 0]


#: By source and name, the attributes of the rows of its table; None, NaN or "" where a record has none.
Attributes = Mapping[str, Mapping[str, ArrayLike]]


class Model(Protocol):
    """The model of an attribute: its evidence that two records are one object."""

    def __call__(self, first: NDArray[Any], second: NDArray[Any], pool: NDArray[Any]) -> FloatArray:
        """(m,) ln r of pairs of known values; ``pool``: known values of all sources, for their frequencies."""


@in_short
@dataclass(frozen=True)
class Code:
    """Values that should identify one object: addresses, numbers, names.

    r = (1 − e) / p(value) for equal values; e / p(near) for values that differ by one bit or one typing error; else the
    share ``other`` of values unrelated to the object. p(value), the probability that an unrelated object has it, is
    1/``values``, or the frequency with which several objects of one source have it. p(near), that it has one of the
    values a small error away, is ``neighbours`` p(value), or the share of the others that have: addresses and call
    signs of a fleet follow each other.

    Parameters
    ----------
    values : approximate number of values in use.
    slips : e, the probability of a small error. other : of a value unrelated to the object.
    bits : whether small errors are single bits of a hexadecimal address; else typing errors: one letter replaced,
        dropped or added, or two swapped.
    neighbours : number of values one small error away.
    shared : values of many objects, with the share of objects that have them.
    unknown : values without meaning.
    """

    values: float
    slips: float = 0.01
    other: float = 0.005
    bits: bool = False
    neighbours: float = 24.0
    shared: Mapping[str, float] = field(default_factory=dict)
    unknown: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not (self.values > 1 and 0 < self.slips < 1 and 0 < self.other < 1 and self.slips + self.other < 1):
            raise InputError("Code: give values above 1, and shares of errors between 0 and 1 whose sum is below 1")

    def __call__(self, first: NDArray[Any], second: NDArray[Any], pool: NDArray[Any]) -> FloatArray:
        values, log_chance = self._log_chances(pool)
        chance = 0.5 * (log_chance[np.searchsorted(values, first)] + log_chance[np.searchsorted(values, second)])
        log_other = math.log(self.other)
        out = np.full(len(first), log_other)
        same = first == second
        out[same] = np.logaddexp(math.log1p(-self.slips - self.other) - chance[same], log_other)
        differ = np.flatnonzero(~same)
        near = differ[self._are_near(first[differ], second[differ])]
        log_near = np.maximum(
            math.log(self.neighbours) + chance[near], self._log_near(first[near], second[near], values)
        )
        out[near] = np.logaddexp(math.log(self.slips) - log_near, log_other)
        return out

    def _are_near(self, first: NDArray[Any], second: NDArray[Any]) -> BoolArray:
        """(m,) whether two different values are one small error apart."""
        return (differ_by_one_bit if self.bits else differ_by_one_typing)(first, second)

    def _log_near(self, first: NDArray[Any], second: NDArray[Any], values: NDArray[Any]) -> FloatArray:
        """(m,) ln of the share of other values that are near one of a near pair, besides the pair itself."""
        asked, index = np.unique(np.concatenate([first, second]), return_inverse=True)
        # A fleet of hundreds is in a live picture: each value beside all others would take a tenth of a second.
        near = (n_one_bit_apart if self.bits else n_one_typing_apart)(asked, values) - 1.0
        share = near[index].reshape(2, -1).mean(axis=0) / max(len(values) - 2, 1)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(share))

    def _log_chances(self, pool: NDArray[Any]) -> tuple[NDArray[Any], FloatArray]:
        """The values of the pool, ascending, and ln p that an unrelated object has them."""
        values, counts = np.unique(pool, return_counts=True)
        # In the pool, each source has one value per object: n equal values are those of n objects.
        chance = np.maximum((counts - 1.0) / max(len(pool) - 1, 1), 1.0 / self.values)
        for value, share in self.shared.items():
            at = np.flatnonzero(values == value)
            chance[at] = np.maximum(chance[at], share)
        return values, np.log(chance)


@dataclass(frozen=True)
class Category:
    """Values of a few classes, such as the type of ship: r from their frequencies and the rate of misclassification.

    wrong : probability that the two sources classify one object differently.
    """

    wrong: float = 0.15
    unknown: tuple[str, ...] = ("0", "unknown", "not available", "other")

    def __call__(self, first: NDArray[Any], second: NDArray[Any], pool: NDArray[Any]) -> FloatArray:
        values, counts = np.unique(pool, return_counts=True)
        share = (counts + 1.0) / (counts.sum() + len(values) + 1.0)
        chance = np.sqrt(share[np.searchsorted(values, first)] * share[np.searchsorted(values, second)])
        return np.log(np.where(first == second, (1.0 - self.wrong) / chance, 0.0) + self.wrong)


@dataclass(frozen=True)
class Size:
    """Lengths or other sizes: their difference is normal with relative error ``share`` and error ``sigma``.

    wrong : probability that one of them is an outlier.
    """

    sigma: float = 2.0
    share: float = 0.1
    wrong: float = 0.05
    unknown: tuple[str, ...] = ()

    def __call__(self, first: NDArray[Any], second: NDArray[Any], pool: NDArray[Any]) -> FloatArray:
        a, b, known = first.astype(np.float64), second.astype(np.float64), pool.astype(np.float64)
        mean = 0.5 * (a + b)
        variance = 2.0 * (self.sigma**2 + (self.share * mean) ** 2)
        centre, spread = float(np.mean(known)), float(np.var(known)) + float(np.mean(variance))
        same = -0.5 * ((a - b) ** 2 / variance + np.log(variance))
        # Two unrelated objects: the geometric mean of a normal of the variance of all values, at both.
        other = -0.5 * (0.5 * ((a - centre) ** 2 + (b - centre) ** 2) / spread + math.log(spread))
        return np.logaddexp(math.log1p(-self.wrong) + same - other, math.log(self.wrong))


#: Differences of frequencies that are in memory at once.
KERNEL_CELLS = 1 << 20


@dataclass(frozen=True)
class Frequency:
    """Carrier frequencies in Hz: those of one emitter differ by the errors of two receivers.

    r = (1 − e) N(Δ; 0, 2σ²) / p + e, with p the density of the frequencies of other emitters at the mean of both: a
    kernel estimate from the pool without the two records themselves, and one emitter of ``values`` equally probable
    frequencies.

    Parameters
    ----------
    sigma_hz : of a receiver below ``radar_hz``, where channels are 6.25 kHz and more apart. radar_sigma_hz : above it;
        the magnetron of a radar drifts by some megahertz.
    other : e, the probability that one emitter is received on two frequencies. values : distinct frequencies in use.
    """

    sigma_hz: float = 2e3
    radar_sigma_hz: float = 2e6
    radar_hz: float = 1e9
    other: float = 0.005
    values: float = 100.0

    def __call__(self, first: NDArray[Any], second: NDArray[Any], pool: NDArray[Any]) -> FloatArray:
        a, b, known = first.astype(np.float64), second.astype(np.float64), pool.astype(np.float64)
        middle = 0.5 * (a + b)
        sigma = math.sqrt(2.0) * np.where(middle < self.radar_hz, self.sigma_hz, self.radar_sigma_hz)
        # In units of the density of two equal frequencies, which cancels. Some pairs at a time.
        kernel, rows = np.empty(len(middle)), max(KERNEL_CELLS // max(len(known), 1), 1)
        for at in (slice(start, start + rows) for start in range(0, len(middle), rows)):
            kernel[at] = np.exp(-0.5 * (np.subtract.outer(middle[at], known) / sigma[at, None]) ** 2).sum(axis=1)
        own = 2.0 * np.exp(-0.5 * (0.5 * (a - b) / sigma) ** 2)
        others = np.maximum(kernel - own, 0.0) + 1.0 / self.values
        log_chance = np.log(others / max(len(known) - 1.0, 1.0))
        same = -0.5 * ((a - b) / sigma) ** 2 - log_chance
        return np.asarray(np.logaddexp(math.log1p(-self.other) + same, math.log(self.other)))


#: That of the emission which a direction finder has received.
FREQUENCY = "frequency_hz"
#: Attributes that only one object should have.
UNIQUE = ("mmsi", "imo", "icao")
#: Values of identities that are sent where none is set.
UNSET: Mapping[str, tuple[str, ...]] = {
    "mmsi": ("0", "000000000", "111111111", "123456789", "999999999"),
    "imo": ("0", "1234567"),
    "icao": ("000000", "ffffff"),
    "callsign": ("00000000",),
    "name": ("UNKNOWN", "NONAME"),
}
MODELS: Mapping[str, Model] = {
    "mmsi": Code(1e5, neighbours=160.0, unknown=UNSET["mmsi"]),
    "imo": Code(6e4, neighbours=120.0, unknown=UNSET["imo"]),
    "icao": Code(1e5, bits=True, neighbours=24.0, unknown=UNSET["icao"]),
    "callsign": Code(3e4, slips=0.03, other=0.02, neighbours=400.0, unknown=UNSET["callsign"]),
    "name": Code(2e4, slips=0.05, other=0.02, neighbours=800.0, unknown=UNSET["name"]),
    "mode_a": Code(
        4096.0, slips=0.01, other=0.01, neighbours=12.0, unknown=("0000",),
        shared={"1000": 0.5, "1200": 0.3, "2000": 0.1, "7000": 0.3, "7001": 0.02, "7600": 1e-3, "7700": 1e-3},
    ),
    "type": Category(),
    "length_m": Size(),
    FREQUENCY: Frequency(),
}  # fmt: skip


#: Attributes that name one object; others, such as the code of a transponder, several share, or say what it is.
NAMING = ("mmsi", "imo", "icao", "callsign", "name")


@in_short
@dataclass(frozen=True)
class Identity(Rule):
    """The identities of the records, as evidence that is bounded on both sides (see the module).

    Parameters
    ----------
    attributes : by source name and attribute, the values of all rows of its table (n_table,), one row per object: equal
        values of several rows are those that objects share.
    models : per attribute; an attribute without a model is refused.
    borrowed : g, the probability that a record carries another object's identity. duplicate : s, that another object
        nearby shows the same: duplicates, forgeries, rebroadcasts.

    Example
    -------
    >>> from sameas import Radius, Records
    >>> radar = Records.of([[0.0, 0.0], [9.0, 0.0]], sigma=5.0, source="radar")
    >>> adsb = Records.of([[1.0, 1.0], [8.0, 0.0]], sigma=5.0, source="adsb")
    >>> attributes = {"radar": {"icao": ["4b1814", None]}, "adsb": {"icao": ["4b1814", "4b1815"]}}
    >>> pairs = Radius(5.0)(radar, adsb)
    >>> evidence = Identity(attributes)(pairs)
    >>> [(int(i), int(j), round(float(v), 1)) for i, j, v in zip(pairs.i, pairs.j, evidence.log_ratio)]
    [(0, 0, 6.9), (0, 1, 3.7), (1, 0, 0.0), (1, 1, 0.0)]
    """

    attributes: Attributes = field(repr=False)
    models: Mapping[str, Model] = field(default_factory=lambda: MODELS)
    borrowed: float = 0.01
    duplicate: float = 1e-3

    def __post_init__(self) -> None:
        if not (0.0 < self.borrowed < 1.0 and 0.0 < self.duplicate < 1.0):
            raise InputError("Identity: borrowed and duplicate are probabilities, strictly between 0 and 1")
        for source, columns in self.attributes.items():
            for name in columns:
                if name not in self.models:
                    raise InputError(f"{source}: no model for {name!r}; give one in models, or leave the column out")

    def __call__(self, pairs: Pairs) -> Evidence:
        terms = {}
        for name in self.common(pairs.first.source, pairs.second.source):
            first = self.column(pairs.first, name)[pairs.first.rows[pairs.i]]
            second = self.column(pairs.second, name)[pairs.second.rows[pairs.j]]
            terms[name] = self._term(name, first, second)
        if not terms:
            return Evidence({"identity": np.zeros(len(pairs))})
        total = np.sum(list(terms.values()), axis=0)
        bounded = np.logaddexp(math.log1p(-self.borrowed) + total, math.log(self.borrowed))
        bounded -= np.logaddexp(math.log1p(-self.duplicate), math.log(self.duplicate) + total)
        # Exactly 0 for pairs without a common attribute, without rounding.
        bounded[total == 0.0] = 0.0
        return Evidence({**terms, "borrowed or shared": bounded - total})

    def common(self, first: str, second: str) -> list[str]:
        """The attributes that both sources have."""
        return [name for name in self.attributes.get(first, {}) if name in self.attributes.get(second, {})]

    def column(self, records: Records, name: str) -> NDArray[Any]:
        """(n_table,) the values of a source in normalised spelling; "" or NaN where missing."""
        values = self._plain[records.source][name]
        if len(values) != records.n_table:
            raise InputError(
                f"{records.source}: {len(values)} values of {name} for {records.n_table} rows; give one for every row "
                "of its table"
            )
        return values

    def _term(self, name: str, first: NDArray[Any], second: NDArray[Any]) -> FloatArray:
        """(m,) ln r of one attribute, 0 where either record has none."""
        out = np.zeros(len(first))
        both = np.flatnonzero(_has_value(first) & _has_value(second))
        if len(both):
            out[both] = self.models[name](first[both], second[both], self._pools[name])
        return out

    @cached_property
    def _plain(self) -> dict[str, dict[str, NDArray[Any]]]:
        """The attributes in normalised spelling."""
        return {
            source: {name: _spelled(values, self.models[name]) for name, values in columns.items()}
            for source, columns in self.attributes.items()
        }

    @cached_property
    def _pools(self) -> dict[str, NDArray[Any]]:
        """Known values of all sources, by attribute."""
        names = {name for columns in self.attributes.values() for name in columns}
        return {name: self._pool(name) for name in names}

    def _pool(self, name: str) -> NDArray[Any]:
        """Known values of all sources; each value as often as in the source that has it most often."""
        columns = [column[name] for column in self._plain.values() if name in column]
        columns = [column[_has_value(column)] for column in columns]
        if any(column.dtype.kind == "f" for column in columns):
            return np.concatenate(columns)
        counted = [np.unique(column, return_counts=True) for column in columns]
        values, index = np.unique(np.concatenate([v for v, _ in counted]), return_inverse=True)
        most = np.zeros(len(values), np.int64)
        np.maximum.at(most, index, np.concatenate([n for _, n in counted]))
        return np.repeat(values, most)


def _spelled(values: ArrayLike, model: Model) -> NDArray[Any]:
    """(n_table,) values in normalised spelling; codes and classes as texts, whatever their type in the table."""
    unknown = getattr(model, "unknown", ())
    column = plain(values, unknown)
    if column.dtype.kind == "f" and isinstance(model, Code | Category):
        column = plain([f"{value:.15g}" if np.isfinite(value) else "" for value in column], unknown)
    return column


def _has_value(values: NDArray[Any]) -> BoolArray:
    return np.isfinite(values) if values.dtype.kind == "f" else np.asarray(values != "")


@dataclass(frozen=True)
class IdentityConflict:
    """Two records with the same identity at positions too far apart for one object.

    first, second : name of the source and row of its table. distance : in the unit of the features. chi_sq : Δᵀ Σ⁻¹ Δ.
    """

    attribute: str
    value: str
    first: tuple[str, int]
    second: tuple[str, int]
    distance: float
    chi_sq: float

    def __str__(self) -> str:
        (one, i), (two, j) = self.first, self.second
        kind = "shown twice" if one == two else "contradicts positions"
        return (
            f"{self.attribute} {self.value} {kind}: {one} row {i} and {two} row {j} are {self.distance:.4g} apart "
            f"({math.sqrt(self.chi_sq):.1f} σ); forged, duplicate or wrong"
        )


def alarms(sources: Sequence[Records], identity: Identity) -> list[IdentityConflict]:
    """Records of one instant with the same identity and contradicting positions, in one source or in two.

    The gate excludes such pairs, so that :class:`Identity` never compares them: positions beyond the default gate
    contradict, and the attributes are those that only one object should have (:data:`UNIQUE`).

    Parameters
    ----------
    sources : records of one plane at one instant. identity : their attributes.
    """
    limit_of = ChiSquare(DEFAULT_COMPLETENESS)
    all_alarms = []
    for name in UNIQUE:
        values = [_SourceValues.of(records, identity, name) for records in sources if isinstance(records.space, Plane)]
        for s, first in enumerate(values):
            for second in values[s:]:
                all_alarms += first.against(second, name, limit_of)
    return sorted(all_alarms, key=lambda alarm: (alarm.attribute, alarm.value, alarm.first, alarm.second))


@dataclass(frozen=True)
class _SourceValues:
    """The usable records of one source that have an attribute, at indices ``at``, sorted by value."""

    records: Records
    values: NDArray[Any]
    at: IntArray

    @classmethod
    def of(cls, records: Records, identity: Identity, name: str) -> _SourceValues:
        if name not in identity.attributes.get(records.source, {}):
            return cls(records, np.empty(0, dtype="U1"), np.empty(0, np.int64))
        values = identity.column(records, name)[records.rows]
        at = np.flatnonzero(_has_value(values))
        order = np.argsort(values[at], kind="stable")
        return cls(records, values[at][order], at[order])

    def against(self, other: _SourceValues, name: str, gate: ChiSquare) -> list[IdentityConflict]:
        """Alarms between records of this source and of ``other``, which may be the same."""
        low, high = (np.searchsorted(other.values, self.values, side) for side in ("left", "right"))
        i, j = ranges(low, high - low)
        a, b = self.at[i], other.at[j]
        if other is self:
            once = a < b
            a, b, i = a[once], b[once], i[once]
        one, two = self.records, other.records
        if not len(a) or one.d != two.d or not isinstance(one.space, Plane):
            return []
        delta = wrapped(one.features[a] - two.features[b], one.space.period_list(one.d))
        total = unpack(one.covariance[a], one.d) + unpack(two.covariance[b], two.d)
        chi_sq = mahalanobis_sq(delta, total)
        distance = np.linalg.norm(delta[:, :2], axis=1)
        return [
            IdentityConflict(name, str(self.values[i[k]]), (one.source, int(one.rows[a[k]])),
                             (two.source, int(two.rows[b[k]])), float(distance[k]), float(chi_sq[k]))
            for k in np.flatnonzero(chi_sq > gate.limit(one.d))
        ]  # fmt: skip
