"""The gate: which pairs of records could be one object.

A pair is a *candidate* if its residual Δ is small relative to its own covariance Σ = Σ₁ + Σ₂ (METHOD 2). Each pair has
its own σ, so that a record with a large error neither widens the gate of others nor is lost.

- :class:`ChiSquare` (default): Δᵀ Σ⁻¹ Δ within the χ² quantile of a given completeness, the probability that the gate
  keeps a true pair.
- :class:`Radius`: Δᵀ Σ⁻¹ Δ ≤ k², a limit in standard deviations of the distance.
- :class:`Box`: |Δ_v| ≤ k σ_v in every feature, the papers' "three sigma" gate.

The gate is part of the model: pairs outside have probability zero. A wider gate than the default has no visible effect:
with a per-pair prior no probability changes by more than 1e-5 where groups are summed exactly (measured by
``benchmarks/gate.py``; 3σ changes them by up to 0.99). With a prior of the number of pairs, the gate determines which
records are counted, and no gate is wide enough. 3σ serves to reproduce the papers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.bounds import memory_left
from sameas.errors import InputError
from sameas.gate.zones import DEFAULT_TUNING, Extent, Geometry, Layout, Source, Tuning
from sameas.gaussian import distance_and_log_determinant
from sameas.kernels import threads
from sameas.kernels.compiled import runs_interpreted
from sameas.ragged import ranges
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Plane, Sphere

# The search for all pairs within the gate.
#
# Records are sorted into zones (``zones.py``); possible candidates of each are looked up (both in
# ``kernels/zones.py``) and measured (``kernels/search.py``). If a few records have far wider errors than the others,
# the search runs over them, whichever source they belong to, so that they do not slow down the others. The order of the
# pairs depends on the records' content, not on their rows.

#: Places, i, j, residual, squared Mahalanobis distance, determinant: the columns of :class:`sameas.gate.Pairs`.
Columns = tuple[
    NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], FloatArray, FloatArray, FloatArray
]

#: Records for which an interpreted search takes some milliseconds.
FEW_RECORDS = 64
#: Less memory than this is allocated without checking how much is available, bytes.
_SMALL = 1 << 28

#: Writes the pairs of the records first ≤ k < last into columns; gives (pairs, next k), less than last when full.
Sweep = Callable[[int, int, Any], tuple[int, int]]


def search(first: Records, second: Records, limit: float, box: bool, tuning: Tuning) -> Columns:
    """All pairs with Δᵀ Σ⁻¹ Δ ≤ limit (or, with ``box``, Δ_v² ≤ limit·Σ_vv in every feature v).

    Raises
    ------
    InputError : there are more than the memory holds.
    """
    return _search(first, second, limit, box, tuning, _Allowed(first, second, tuning))


@dataclass
class _Allowed:
    """How many pairs of two sources the memory holds."""

    first: Records
    second: Records
    tuning: Tuning
    count: int = 0

    @cached_property
    def most(self) -> float:
        """Greatest number of pairs; the available memory (0.2 ms to find out) is checked only by large searches."""
        if len(self.first) * len(self.second) * self.tuning.bytes_of_pair < _SMALL:
            return math.inf
        left = memory_left()
        return (self.tuning.memory if left is None else left) / self.tuning.bytes_of_pair

    def take(self, count: int) -> None:
        """Count ``count`` more pairs; raises InputError if the total is too large."""
        self.count += count
        if self.count > self.most:
            size = self.most / 1e6
            raise InputError(
                f"{self.first.source}, {self.second.source}: more than {size:,.1f} million pairs lie within the gate, "
                "and the memory holds no more",
                "are the errors in another unit? Give smaller ones, a smaller gate, or fewer records at a time",
            )


def _search(first: Records, second: Records, limit: float, box: bool, tuning: Tuning, allowed: _Allowed) -> Columns:
    if not len(first) or not len(second):
        return _room(first.d, 0)
    if len(first) + len(second) <= tuning.brute_force_records and isinstance(first.space, Plane):
        columns = _each_with_each(first, second, limit, box, first.space)
        if columns is not None:
            return columns
    geometry = Geometry.of(first, second, limit, box, tuning)
    sources = Source.of(first, geometry), Source.of(second, geometry)
    extent = Extent.of(sources, geometry)
    within = [geometry.opening * len(other) / max(extent.area, 1e-290) for other in (second, first)]
    classes = [source.classes(others, tuning.few_tests) for source, others in zip(sources, within, strict=True)]
    one, two = threads.each(
        [partial(Layout.of, source, rows, extent, geometry) for source, rows in zip(sources, classes, strict=True)],
        len(first) + len(second),
    )
    return _listed(one, two, _wide_pairs(one, two, geometry, allowed), geometry, allowed)


def _each_with_each(first: Records, second: Records, limit: float, box: bool, space: Plane) -> Columns | None:
    """All pairs of few records on a plane; None if they exceed the allocated columns, or records are equal."""
    from sameas.kernels.search import sweep_few

    out = _room(first.d, 4 * (len(first) + len(second)))
    periods = np.array(space.period_list(first.d))
    count = sweep_few(first.features, first.covariance, second.features, second.covariance, limit, box, periods, out)
    return None if count < 0 else tuple(column[:count] for column in out)  # type: ignore[return-value]


def _listed(one: Layout, two: Layout, wide: IntArray, geometry: Geometry, allowed: _Allowed) -> Columns:
    """The candidates among the narrowest classes, and those of the pairs ``wide`` of other classes."""
    from sameas.kernels.search import sweep_plane, sweep_sphere

    about = one.side, two.side, two.grids[0], two.reach(0, one.widest[0], one.starts[1], geometry)
    kernel, gate = sweep_sphere if geometry.sphere else sweep_plane, (geometry.limit, geometry.box)
    few = len(one.side.rows) + len(two.side.rows) <= geometry.tuning.few_rows
    if geometry.sphere and few and runs_interpreted(kernel) and not len(wide):
        columns = _few_on_sphere(one, two, geometry)
        if columns is not None:
            allowed.take(len(columns[0]))
            return columns

    def candidates(listed: IntArray, first: int, last: int, out: Columns) -> tuple[int, int]:
        if geometry.folds is None:
            return sweep_sphere(*about, listed, *gate, first, last, out)
        return sweep_plane(*about, geometry.folds, listed, *gate, geometry.periods, first, last, out)

    def sweep(first: int, last: int, out: Columns) -> tuple[int, int]:
        count = 0
        while first < last:
            # An interpreted kernel gets a few records at a time, so that it is compiled if they have many candidates.
            upto = min(first + FEW_RECORDS, last) if runs_interpreted(kernel) else last
            further = wide[np.searchsorted(wide, first << 32) :] if len(wide) else wide
            more, first = candidates(further, first, upto, _from(out, count) if count else out)
            count += more
            if first < upto:
                break
        return count, first

    n, d = len(one.side.rows), len(geometry.periods)
    each = _expected(partial(candidates, wide[:0]), one.starts[1], d, geometry.tuning.sample)
    each = min(each, allowed.most / n)
    bounds = threads.even(n)
    starts = [math.ceil(each * k) + (int(np.searchsorted(wide, k << 32)) if len(wide) else 0) for k in bounds]
    return _gathered(sweep, bounds, starts, partial(_room, d), len(two.side.rows), replace(allowed, count=0))


def _from(out: Columns, count: int) -> Columns:
    """The columns from ``count`` on."""
    return tuple(column[count:] for column in out)  # type: ignore[return-value]


def _few_on_sphere(one: Layout, two: Layout, geometry: Geometry) -> Columns | None:
    """The output of ``sweep_sphere``, bit by bit, by array operations: faster than the interpreted kernel.

    None with too many pairs, or pairs so wide or so near a pole that the kernel uses other series for them.
    """
    from sameas.kernels.search import CLOSE_DEG, close_residual, shorter_ways, spreads

    guard_1, guard_2 = one.side.guard, two.side.guard
    order = np.argsort(guard_2[:, 1], kind="stable")
    latitude = guard_2[order, 1]
    reach = np.sqrt(geometry.opening * (1.0 + 1e-6) * (guard_1[:, 3] + guard_2[:, 3].max()))
    highest = max(float(np.abs(guard[:, 1]).max()) for guard in (guard_1, guard_2))
    if reach.max() > 0.1 * CLOSE_DEG * math.cos(math.radians(min(highest, 90.0))):
        return None
    low = np.searchsorted(latitude, guard_1[:, 1] - reach)
    size = np.searchsorted(latitude, guard_1[:, 1] + reach, side="right") - low
    if size.sum() > geometry.tuning.max_pairs_by_arrays:
        return None
    k, at = ranges(low, size)
    q = order[at]
    dlon = shorter_ways(guard_1[k, 0] - guard_2[q, 0])
    near = np.flatnonzero(np.abs(dlon) * math.cos(math.radians(highest)) <= reach[k])
    near = near[np.lexsort((q[near], k[near]))]
    k, q, dlon = k[near], q[near], dlon[near]
    east, north = close_residual(dlon, guard_1[k, 1] - guard_2[q, 1], guard_1[k, 2] + guard_2[q, 2])
    xx, xy, yy = spreads(one.side, two.side, k, q, dlon)
    determinant = xx * yy - xy * xy
    squared = (east * east * yy - 2.0 * east * north * xy + north * north * xx) / determinant
    limit = geometry.limit
    inside = (east * east <= limit * xx) & (north * north <= limit * yy) if geometry.box else squared <= limit
    kept = np.flatnonzero(inside)
    places = k[kept].astype(np.int32), q[kept].astype(np.int32)
    rows = one.side.rows[places[0]], two.side.rows[places[1]]
    return (*places, *rows, np.stack([east[kept], north[kept]], axis=1), squared[kept], determinant[kept])


def _wide_pairs(one: Layout, two: Layout, geometry: Geometry, allowed: _Allowed) -> IntArray:
    """Pairs of places k << 32 | q near enough to be measured, without those of the two narrowest classes; sorted.

    The search runs over the wider of two classes.
    """
    from sameas.kernels.zones import transposed

    parts = [np.empty(0, np.int64)]
    for a, b in product(range(len(one.grids)), range(len(two.grids))):
        if a == b == 0:
            continue
        if max(one.widest[a]) >= max(two.widest[b]):
            parts.append(_visits(one, a, two, b, geometry, allowed))
        else:
            back = _visits(two, b, one, a, geometry, allowed)
            parts.append(np.empty_like(back))
            transposed(back, np.zeros(len(one.side.rows) + 1, np.int32), parts[-1])
    # Each part is sorted already, which a stable sort exploits.
    return np.sort(np.concatenate(parts), kind="stable") if len(parts) > 1 else parts[0]


def _visits(visitors: Layout, a: int, hosts: Layout, b: int, geometry: Geometry, allowed: _Allowed) -> IntArray:
    """Pairs visitor << 32 | host between classes of the two sources that are near enough to be measured."""
    from sameas.kernels.zones import ROOM, visit

    bounds = [visitors.starts[a] + k for k in threads.even(visitors.starts[a + 1] - visitors.starts[a], 256)]
    reach = hosts.reach(b, visitors.widest[a], bounds[-1], geometry)
    sweep = partial(visit, visitors.side, hosts.side, hosts.grids[b], reach, geometry.folds)
    each = len(hosts.side.rows) + ROOM
    starts = [each * t for t in range(len(bounds))]

    def room(n: int) -> tuple[IntArray]:
        return (np.empty(n, np.int64),)

    return _gathered(sweep, bounds, starts, room, each, allowed)[0]  # type: ignore[no-any-return]


def _gathered(
    sweep: Sweep,
    bounds: list[int],
    starts: list[int],
    room: Callable[[int], tuple[Any, ...]],
    least: int,
    allowed: _Allowed,
) -> tuple[Any, ...]:
    """The pairs of a sweep over ranges of records in parallel; range t starts at starts[t] of common columns.

    A range that exceeds its part continues in columns of its own of at least ``least`` pairs, enough for any record.
    """
    whole = room(starts[-1])
    part = {first: slice(starts[t], starts[t + 1]) for t, first in enumerate(bounds[:-1])}

    def work(first: int, last: int) -> list[tuple[Any, ...]]:
        out = tuple(column[part[first]] for column in whole)
        chunks: list[tuple[Any, ...]] = []
        while first < last:
            count, first = sweep(first, last, out)
            allowed.take(count)
            chunks.append(tuple(column[:count] for column in out))
            out = room(max(len(out[0]), least)) if first < last else ()
        return chunks

    ranges = threads.over(work, bounds)
    if any(len(chunks) > 1 for chunks in ranges):
        all_chunks = [chunk for chunks in ranges for chunk in chunks]
        return tuple(np.concatenate(parts) for parts in zip(*all_chunks, strict=True))
    used = 0
    for (chunk,), start in zip(ranges, starts, strict=False):
        count = len(chunk[0])
        if start != used:
            threads.each([partial(_move, column, start, used, count) for column in whole], count)
        used += count
    del ranges, chunk
    for column in whole:
        # Nothing refers to the columns any more: unused memory is released.
        column.resize((used, *column.shape[1:]), refcheck=False)
    return whole


def _move(column: NDArray[Any], start: int, to: int, count: int) -> None:
    """Move ``count`` elements of a column from ``start`` to ``to``."""
    column[to : to + count] = column[start : start + count]


def _room(d: int, capacity: int) -> Columns:
    """Columns for ``capacity`` pairs."""
    whole = [np.empty(capacity, np.int32) for _ in range(4)]
    return (*whole, np.empty((capacity, d)), np.empty(capacity), np.empty(capacity))  # type: ignore[return-value]


def _expected(sweep: Sweep, n: int, d: int, sample: int) -> float:
    """Candidates per record to allocate for: the mean of 16 samples of ``sample`` records, plus a margin."""
    if n <= 32 * sample:
        return 4.0
    out = _room(d, 16 * sample)
    pairs = records = 0
    for first in range(0, n - sample, n // 16):
        count, reached = sweep(first, first + sample, out)
        pairs, records = pairs + count, records + max(reached - first, 1)
    return 1.25 * pairs / records + 0.5


# The χ² distribution: closed forms in two dimensions, SciPy's functions in others.
#
# SciPy is imported only where needed, because the import takes longer than many matches.


def quantile(share: float, d: int) -> float:
    """The squared length that a ``share`` of standard normal vectors in d dimensions does not exceed.

    >>> round(quantile(0.99, 2), 4)
    9.2103
    """
    if d == 2:
        return -2.0 * math.log1p(-share)
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(0.5 * d, share))


def upper_quantile(share: float, d: int) -> float:
    """The squared length that a ``share`` of standard normal vectors in d dimensions exceeds; exact for tiny shares."""
    if d == 2:
        return -2.0 * math.log(share)
    from scipy.special import gammainccinv

    return 2.0 * float(gammainccinv(0.5 * d, share))


#: Share of true pairs that the default gate keeps: 6.4σ in two dimensions.
DEFAULT_COMPLETENESS = 1.0 - 1e-9


@in_short
@dataclass(frozen=True)
class Pairs:
    """The candidates, in an order that depends on the records' content only, not on their rows.

    Attributes
    ----------
    place_1, place_2 : (m,) places of the two records in an order by content, in which near places are near in space.
    i, j : (m,) indices of the two records in ``first`` and ``second``.
    residual : (m, d) Δ = X₁ − X₂ in the space's residual unit.
    mahalanobis_sq : (m,) Δᵀ Σ⁻¹ Δ.
    determinant : (m,) |Σ|.
    gate : description of the gate, for the result.
    """

    first: Records
    second: Records
    place_1: NDArray[np.int32]
    place_2: NDArray[np.int32]
    i: NDArray[np.int32]
    j: NDArray[np.int32]
    residual: FloatArray
    mahalanobis_sq: FloatArray
    determinant: FloatArray
    gate: str

    def __post_init__(self) -> None:
        columns = (self.place_1, self.place_2, self.i, self.j, self.residual, self.mahalanobis_sq, self.determinant)
        if len({len(column) for column in columns}) != 1:
            raise InputError(f"pairs: columns of {', '.join(str(len(c)) for c in columns)} rows; cut all of them alike")

    def __len__(self) -> int:
        return len(self.i)

    @property
    def d(self) -> int:
        """Number of features of a residual."""
        return int(self.residual.shape[1])

    @cached_property
    def log_peak(self) -> FloatArray:
        """(m,) ln of the density at zero residual, −½ ln |2πΣ|."""
        return self.log_peaks(slice(None))

    def log_peaks(self, some: slice) -> FloatArray:
        """(k,) :attr:`log_peak` of some pairs, not cached."""
        return np.asarray(-0.5 * (np.log(self.determinant[some]) + self.d * math.log(2.0 * math.pi)))

    @cached_property
    def covariance(self) -> FloatArray:
        """(m, d, d) Σ of each residual, on the residual's axes."""
        return self._covariance(self.i, self.j)

    def covariance_of(self, some: IntArray) -> FloatArray:
        """(k, d, d) Σ of the residuals of some pairs (k,) only."""
        return self._covariance(self.i[some], self.j[some])

    def same_records(self, other: Pairs) -> bool:
        """Whether ``other`` has the same record objects."""
        return self.first is other.first and self.second is other.second

    def part(self, kept: BoolArray | IntArray) -> Pairs:
        """Some of the candidates, with the same records."""
        columns = ("place_1", "place_2", "i", "j", "residual", "mahalanobis_sq", "determinant")
        return replace(self, **{name: getattr(self, name)[kept] for name in columns})

    def of(self, first: Records, second: Records) -> Pairs:
        """The same candidates with the errors of these records, which must otherwise be the same."""
        pairs = replace(self, first=first, second=second)
        distance_sq, log_determinant = distance_and_log_determinant(self.residual, pairs.covariance)
        return replace(pairs, mahalanobis_sq=distance_sq, determinant=np.exp(log_determinant))

    def _covariance(self, i: NDArray[np.int32], j: NDArray[np.int32]) -> FloatArray:
        out = np.empty((len(i), self.d, self.d))
        a, b = self.first, self.second
        if isinstance(a.space, Sphere) and a.covariance.shape[1] == b.covariance.shape[1] == 1:
            out[:] = 0.0
            out[:, 0, 0] = out[:, 1, 1] = a.covariance[i, 0] + b.covariance[j, 0]  # circles need no rotation
        elif isinstance(a.space, Sphere):
            from sameas.kernels.search import sphere_covariances

            sphere_covariances(a.features, a.covariance, b.features, b.covariance, i, j, out)
        else:
            from sameas.kernels.search import plane_covariances

            plane_covariances(a.covariance, b.covariance, i, j, out)
        return out


@in_short
@dataclass(frozen=True)
class ChiSquare:
    """Δᵀ Σ⁻¹ Δ within the χ² quantile of ``completeness``, the probability of keeping a true pair."""

    completeness: float = DEFAULT_COMPLETENESS
    tuning: Tuning = field(default=DEFAULT_TUNING, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.completeness < 1.0:
            raise InputError(f"gate: completeness is {self.completeness}; give a probability between 0 and 1")

    def limit(self, d: int) -> float:
        """The χ² quantile for d features."""
        return upper_quantile(1.0 - self.completeness, d)

    def __call__(self, first: Records, second: Records) -> Pairs:
        limit = self.limit(feature_count(first, second))
        description = f"χ² ≤ {limit:.2f} (loses {1 - self.completeness:.1e} of the true)"
        return _candidates(first, second, limit, False, description, self.tuning)


DEFAULT_GATE = ChiSquare()


@in_short
@dataclass(frozen=True)
class Radius:
    """Mahalanobis distance within ``sigmas``: Δᵀ Σ⁻¹ Δ ≤ sigmas²."""

    sigmas: float
    tuning: Tuning = field(default=DEFAULT_TUNING, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.sigmas < math.inf:
            raise InputError(f"gate: sigmas is {self.sigmas}; give a positive number")

    def __call__(self, first: Records, second: Records) -> Pairs:
        return _candidates(first, second, self.sigmas**2, False, f"distance ≤ {self.sigmas:g} σ", self.tuning)


@in_short
@dataclass(frozen=True)
class Box:
    """|Δ_v| ≤ ``sigmas``·σ_v in every feature v, the gate of both papers (3σ)."""

    sigmas: float = 3.0
    tuning: Tuning = field(default=DEFAULT_TUNING, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.sigmas < math.inf:
            raise InputError(f"gate: sigmas is {self.sigmas}; give a positive number")

    def __call__(self, first: Records, second: Records) -> Pairs:
        return _candidates(first, second, self.sigmas**2, True, f"each feature within {self.sigmas:g} σ", self.tuning)


def feature_count(first: Records, second: Records) -> int:
    """The number of features of two sources, which must be in one space."""
    for source in (first, second):
        if not isinstance(source, Records):
            raise InputError(f"a source is a {type(source).__name__}; make it with Records.of(features, sigma=…)")
    if first.d != second.d or first.space != second.space:
        raise InputError(
            f"{first.source} has {first.d} features in {first.space}, {second.source} {second.d} in {second.space}; "
            "bring both to one feature space"
        )
    return first.d


def _candidates(first: Records, second: Records, limit: float, box: bool, description: str, tuning: Tuning) -> Pairs:
    feature_count(first, second)
    return Pairs(first, second, *search(first, second, limit, box, tuning), gate=description)
