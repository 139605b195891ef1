"""The search for all pairs of records within a gate, with their residuals.

Records are sorted into zones (``zones.py``); possible candidates of each are looked up (both in ``kernels/zones.py``)
and measured (``kernels/search.py``). If a few records have far wider errors than the others, the search runs over them,
whichever source they belong to, so that they do not slow down the others. The order of the pairs depends on the
records' content, not on their rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.bounds import memory_left
from sameas.errors import InputError
from sameas.gate.zones import FEW_ROWS, Extent, Geometry, Layout, Source, Tuning
from sameas.kernels import threads
from sameas.kernels.compiled import runs_interpreted
from sameas.ragged import ranges
from sameas.records import Records
from sameas.space import Plane

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

SAMPLE = 128  # length of the samples of successive records whose candidates are counted to estimate the memory


def search(first: Records, second: Records, limit: float, box: bool, tuning: Tuning) -> Columns:
    """All pairs with Δᵀ Σ⁻¹ Δ ≤ limit (or, with ``box``, Δ_v² ≤ limit·Σ_vv in every feature v).

    Raises InputError: there are more than the memory holds.
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
    classes = [source.classes(others) for source, others in zip(sources, within, strict=True)]
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
    few = len(one.side.rows) + len(two.side.rows) <= FEW_ROWS
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
    each = _expected(partial(candidates, wide[:0]), one.starts[1], d, SAMPLE)
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
    parts = [np.empty(0, np.int64)]
    for a, b in product(range(len(one.grids)), range(len(two.grids))):
        if a == b == 0:
            continue
        if max(one.widest[a]) >= max(two.widest[b]):
            parts.append(_visits(one, a, two, b, geometry, allowed))
        else:
            back = _visits(two, b, one, a, geometry, allowed)
            parts.append(np.sort(back << 32 | back >> 32))
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
