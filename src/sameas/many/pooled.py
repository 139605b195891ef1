"""Pooled records: the records of all sources in one numbering, their pairs, and their groups.

Sources and records are ordered by content, equal ones by id. All later stages use that order, so the result does not
depend on the order of sources or rows. Two records are a pair if they pass the gate. The gate compares features, so it
applies where both sources observe the whole state. Where one of them observes a part, two records pass if they can be
one object of the region: their χ² (:mod:`sameas.many.observations`) is at most the quantile of the gate's
completeness, for as many degrees of freedom as they have features. A group is a connected component of all pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, ordered_by, over_columns, places_in, taken
from sameas.assignment import refuse_crowds
from sameas.errors import InputError
from sameas.gate import DEFAULT_COMPLETENESS, ChiSquare, Pairs, Radius
from sameas.gaussian import inverse, propagated
from sameas.kernels.components import label_components
from sameas.kernels.kalman import joint_in_plane
from sameas.many.observations import LinearPart, Observations, Observers, Region, Source, records_of
from sameas.ragged import Ragged
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Plane

Gate = Callable[[Records, Records], Pairs]
#: Pairs of a partial source that are tested at once, to limit the memory.
CHUNK = 200_000


@in_short
@dataclass(frozen=True)
class PooledRecords:
    """The records of all sources, source after source.

    Attributes
    ----------
    observers : the sources, and the records of each, ordered by content.
    given : (S,) position of each source in the caller's list.
    start : (S+1,) the records of source s are numbered start[s] … start[s+1] − 1.
    i, j : (m,) the two records of each pair, i < j, sorted.
    parts : for every two sources, their Pairs and the positions of these among the m. If a source observes a part of
        the state, Pairs have no residual (shape (m, 0)) and no determinant, and χ² is that of one object of the region.
    group : (n,) the group of each record, numbered by first appearance.
    gate : the gate's description.
    """

    observers: Observers
    given: tuple[int, ...]
    start: IntArray
    i: IntArray
    j: IntArray
    parts: tuple[tuple[Pairs, IntArray], ...]
    group: IntArray
    gate: str

    def __len__(self) -> int:
        return int(self.start[-1])

    @property
    def sources(self) -> tuple[Source, ...]:
        """The sources in the order of their content."""
        return self.observers.sources

    @cached_property
    def source(self) -> IntArray:
        """(n,) the source of each record."""
        return Ragged(self.start).row

    @cached_property
    def sizes(self) -> IntArray:
        """(g,) number of records of each group."""
        return np.bincount(self.group, minlength=0)

    @cached_property
    def log_peak(self) -> FloatArray:
        """(n,) −½ ln|2π R| of every record."""
        return np.concatenate([self.observers.log_peak(s) for s in range(len(self.sources))])

    def log_joint(self, sets: IntArray) -> FloatArray:
        """(k,) ln J of sets (k, size) of record numbers, ascending."""
        if self.in_plane is None:
            members = np.full((len(sets), len(self.sources)), ABSENT)
            np.put_along_axis(members, self.source[sets], sets, axis=1)
            return self.log_joint_of_members(members)
        out = np.empty(len(sets))
        joint_in_plane(sets, *self.in_plane, out)
        return out

    def log_joint_of_members(self, members: IntArray) -> FloatArray:
        """(k,) ln J of sets (k, S) of record numbers by source, of any sizes."""
        return self.observers.joint(self.positions(members)).log_density

    @cached_property
    def in_plane(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray] | None:
        """Positions, precisions and log peaks of all records, centre and information of the region, for the compiled
        joint density; None unless all sources are positions in a plane without periods."""
        whole = [source for source in self.sources if isinstance(source, Records)]
        flat = all(isinstance(one.space, Plane) and one.d == 2 and not any(one.space.periods or ()) for one in whole)
        if len(whole) < len(self.sources) or not flat:
            return None
        region = self.observers.region
        centre = np.zeros(2) if region is None else np.asarray(region.centre, np.float64)
        prior = np.zeros((2, 2)) if region is None else inverse(np.asarray(region.covariance, np.float64))
        precision = np.concatenate([self.observers.precision(s) for s in range(len(self.sources))])
        return np.concatenate([one.features for one in whole]), precision, self.log_peak, centre, prior

    def neighbours(self, groups: BoolArray) -> tuple[IntArray, IntArray]:
        """CSR of the records that are pairs with each record, both ways and ascending, in some groups (g,)."""
        kept = groups[self.group[self.i]]
        one, two = np.concatenate([self.i[kept], self.j[kept]]), np.concatenate([self.j[kept], self.i[kept]])
        order = np.lexsort([two, one])
        return Ragged.of_sorted(one[order], len(self)).start, two[order]

    def positions(self, sets: NDArray[np.integer]) -> IntArray:
        """Sets (k, S) of record numbers as positions within each source; ABSENT stays."""
        return np.where(sets != ABSENT, sets - self.start[:-1], ABSENT)

    def pair(self, i: IntArray, j: IntArray) -> tuple[BoolArray, IntArray]:
        """Whether records i < j are a pair, and the number of the pair (0 if not)."""
        index = places_in(self._keys, i * len(self) + j)
        return index >= 0, np.maximum(index, 0)

    @cached_property
    def _keys(self) -> IntArray:
        return self.i * len(self) + self.j


def record_codes(n: int) -> NDArray[np.uint64]:
    """(n + 1,) a random number for each record, and 0 for ABSENT: a set is known by the sum of those of its records."""
    codes = np.random.default_rng(0).integers(0, 1 << 62, n + 1, dtype=np.uint64)
    codes[ABSENT] = 0
    return codes


def pooled(sources: Sequence[Source], gate: Gate, region: Region | None = None) -> PooledRecords:
    """The records of two or more sources, their pairs and groups."""
    if len(sources) < 2:
        raise InputError(f"{len(sources)} source given; give two or more, as a list")
    for number, source in enumerate(sources):
        if not isinstance(source, Records | Observations):
            kind = type(source).__name__
            raise InputError(f"source {number} is a {kind}; make it with Records.of(features, sigma=…)")
    # Checked here, so that error messages list the sources in the caller's order.
    assert Observers(tuple(sources), region).dimension
    ordered = [_in_order(source) for source in sources]
    contents = [_content(source) for source in ordered]
    if len(set(contents)) < len(contents):
        contents = [(*content, *_names(source)) for content, source in zip(contents, ordered, strict=True)]
    given = sorted(range(len(sources)), key=contents.__getitem__)
    observers = Observers(tuple(ordered[s] for s in given), region)
    start = Ragged.of_sizes([len(records_of(s)) for s in observers.sources]).start
    i, j, parts, description = _pairs(observers, start, gate)
    return PooledRecords(
        observers, tuple(given), start, i, j, parts, numbered_groups(i, j, int(start[-1])), description
    )


def _in_order(source: Source) -> Source:
    """The source with its records ordered by content, equal ones by id."""
    records = records_of(source)
    order = ordered_by(records.features.T)
    ordered = taken(records.features, order)
    if over_columns(np.logical_and, ordered[1:] == ordered[:-1]).any():
        ids = records.ids[records.rows]
        ids = ids if ids.dtype.kind in "iuf" else ids.astype(str)
        order = np.lexsort([ids, *records.covariance.T[::-1], *records.features.T[::-1]])
    records = replace(
        records,
        features=taken(records.features, order),
        covariance=taken(records.covariance, order),
        rows=records.rows[order],
    )
    return replace(source, records=records) if isinstance(source, Observations) else records


def _content(source: Source) -> tuple[object, ...]:
    """Sort key of a source."""
    records = records_of(source)
    part = repr(source.part) if isinstance(source, Observations) else ""
    content = records.features.tobytes(), records.covariance.tobytes()
    return len(records), part, *content, records.source


def _names(source: Source) -> list[str]:
    """The ids of a source's records: the sort key of sources of equal content."""
    records = records_of(source)
    return [str(x) for x in records.ids[records.rows]]


def _pairs(
    observers: Observers, start: IntArray, gate: Gate
) -> tuple[IntArray, IntArray, tuple[tuple[Pairs, IntArray], ...], str]:
    compared: list[Pairs] = []
    numbers: list[tuple[IntArray, IntArray]] = []
    description = ""
    for s, first in enumerate(observers.sources):
        for t in range(s + 1, len(observers.sources)):
            second = observers.sources[t]
            if isinstance(first, Records) and isinstance(second, Records):
                pairs = gate(first, second)
                description = pairs.gate
            else:
                pairs = _possible(observers, s, t, gate)
            refuse_crowds(pairs)
            compared.append(pairs)
            numbers.append((pairs.i.astype(np.int64) + start[s], pairs.j.astype(np.int64) + start[t]))
    i, j = (np.concatenate(column) for column in zip(*numbers, strict=True))
    order = np.argsort(i * start[-1] + j)  # no two are equal
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    cuts = np.cumsum([0, *map(len, compared)])
    parts = tuple((pairs, rank[cuts[k] : cuts[k + 1]]) for k, pairs in enumerate(compared))
    return i[order], j[order], parts, description


def _possible(observers: Observers, s: int, t: int, gate: Gate) -> Pairs:
    """Pairs of two sources, at least one of them partial, whose records can be one object of the region."""
    from scipy.special import gammainccinv

    first, second = records_of(observers.sources[s]), records_of(observers.sources[t])
    completeness = gate.completeness if isinstance(gate, ChiSquare) else DEFAULT_COMPLETENESS
    limit = 2.0 * float(gammainccinv((first.d + second.d) / 2.0, 1.0 - completeness))
    possible = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))]
    near = _near(observers, s, t, limit)
    total = len(first) * len(second) if near is None else len(near)
    for low in range(0, total, CHUNK):
        numbers = np.arange(low, min(low + CHUNK, total))
        a, b = np.divmod(numbers if near is None else near[numbers], len(second))
        sets = np.full((len(a), len(observers.sources)), ABSENT)
        sets[:, s], sets[:, t] = a, b
        chi_sq = observers.joint(sets).chi_sq
        inside = chi_sq <= limit
        possible.append((a[inside], b[inside], chi_sq[inside]))
    i, j, chi_sq = (np.concatenate(column) for column in zip(*possible, strict=True))
    i, j = i.astype(np.int32), j.astype(np.int32)
    described = f"χ² ≤ {limit:.2f} of one object of the region"
    return Pairs(
        first=first, second=second, place_1=i, place_2=j, i=i, j=j, residual=np.empty((len(i), 0)),
        mahalanobis_sq=chi_sq, determinant=np.full(len(i), np.nan), gate=described,
    )  # fmt: skip


def _near(observers: Observers, s: int, t: int, limit: float) -> IntArray | None:
    """Of two sources that observe linear parts the pairs (p,) whose difference alone has a χ² up to a limit, numbered
    i · n₂ + j, ascending; None for others.

    The difference z₁ − z₂ of two records of one object of the region is normal with the mean (H₁ − H₂) μ₀ + c₁ − c₂ and
    the covariance R₁ + R₂ + (H₁ − H₂) P₀ (H₁ − H₂)ᵀ; of a record of the whole state, H₂ z₁ is compared. Its χ² is never
    above that of both records.
    """
    sources, region = [observers.sources[k] for k in (s, t)], observers.region
    parts = [source.part for source in sources if isinstance(source, Observations)]
    linear = [part for part in parts if isinstance(part, LinearPart)]
    flat = all(isinstance(own := records_of(source).space, Plane) and own.periods is None for source in sources)
    if (
        region is None
        or len(linear) < len(parts)
        or not flat
        or len({len(np.asarray(one.matrix)) for one in linear}) > 1
    ):
        return None
    compared = []
    for source, part in zip(sources, (linear[0], linear[-1]), strict=True):
        records, covariance = records_of(source), records_of(source).full_covariance()
        if isinstance(source, Records):
            observed, covariance = part(records.features), propagated(part.jacobian(records.features), covariance)
        else:
            observed = records.features
        compared.append((observed, covariance))
    change = np.asarray(linear[0].matrix) - np.asarray(linear[-1].matrix)
    shift = change @ np.asarray(region.centre) + linear[0].offset - linear[-1].offset
    (one, of_one), (other, of_other) = compared
    # Errors of rounding are no reason to lose a pair.
    gate = Radius(math.sqrt(limit) * (1.0 + 1e-9))
    near = gate(
        Records.of(one - shift, covariance=of_one + propagated(change, region.covariance), source="first"),
        Records.of(other, covariance=of_other, source="second"),
    )
    return np.sort(near.i.astype(np.int64) * len(other) + near.j)


def numbered_groups(i: IntArray, j: IntArray, n: int) -> IntArray:
    """(n,) the connected component of each record, numbered by first appearance."""
    parent, label = np.empty((2, n), np.int64)
    label_components(i, j, parent, label)
    return label
