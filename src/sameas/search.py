"""The search behind the gate: every pair whose residual is small enough for its own covariance, and no other.

Records are laid out in zones (``zones.py``, ``kernels/order.py``); what may lie within the gate of each is looked up
(``kernels/spans.py``) and measured (``kernels/sphere.py``, ``plane.py``), class of errors by class of errors, so that a
few wide ones do not slow down the many. The order of the pairs depends on what the records say, not on their rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sameas import threads
from sameas.records import FloatArray, Records
from sameas.zones import Geometry, Side, Zones, area

if TYPE_CHECKING:
    from sameas.kernels import spans

#: Records in a row whose candidates are counted to know how much room all need.
SAMPLE = 128

#: Places, i, j, residual, squared Mahalanobis distance, determinant: the columns of :class:`sameas.gate.Pairs`.
Columns = tuple[
    NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], FloatArray, FloatArray, FloatArray
]


def search(first: Records, second: Records, limit: float, box: bool) -> Columns:
    """All pairs with Δᵀ Σ⁻¹ Δ ≤ limit (or, with ``box``, Δ_v² ≤ limit·Σ_vv in every feature v)."""
    if not len(first) or not len(second):
        return _room(0, first.d)
    geometry = Geometry.of(first, second, limit, box)
    sides = Side.of(first, geometry), Side.of(second, geometry)
    # Worked out only where it is asked for, and once.
    density = [cache(partial(_within_opening, other, sides, geometry)) for other in sides[::-1]]
    classes = [side.classes(others) for side, others in zip(sides, density, strict=True)]
    several = len(classes[0]) * len(classes[1]) > 1
    places = _Places(len(first)), _Places(len(second))
    found: list[Columns] = []
    for one in classes[0]:
        for two in classes[1]:
            zones = Zones.of(one, two, geometry)
            ordered = threads.each(
                [partial(one.sorted, zones, geometry), partial(two.sorted, zones, geometry)],
                len(one.rows) + len(two.rows),
            )
            columns = _swept(ordered[0], ordered[1], zones, geometry)
            if several:
                at = [place.of(side.rows) for place, side in zip(places, ordered, strict=True)]
                columns = (at[0][columns[0]], at[1][columns[1]], *columns[2:])
            found.append(columns)
    if not several:
        return found[0]
    columns = tuple(np.concatenate(parts) for parts in zip(*found, strict=True))  # type: ignore[assignment]
    # What each sweep found is in order already, which a stable sort makes use of.
    order = np.argsort((columns[0].astype(np.int64) << 32) | columns[1], kind="stable")
    return tuple(np.ascontiguousarray(column[order]) for column in columns)  # type: ignore[return-value]


def _room(capacity: int, d: int) -> Columns:
    """Columns for so many pairs."""
    whole = [np.empty(capacity, np.int32) for _ in range(4)]
    return (*whole, np.empty((capacity, d)), np.empty(capacity), np.empty(capacity))  # type: ignore[return-value]


def _within_opening(side: Side, sides: tuple[Side, Side], geometry: Geometry) -> float:
    """How many records of a side lie in the area that a variance of one opens."""
    return geometry.opening * len(side.rows) / max(area(*sides, geometry), 1e-290)


class _Places:
    """The place of every record in an order of content: class by class, each as it was first sorted."""

    def __init__(self, n: int) -> None:
        self.place = np.full(n, -1, np.int32)
        self.used = 0

    def of(self, rows: NDArray[np.int32]) -> NDArray[np.int32]:
        """The places of the sorted records of a class, given to them when it is first asked for."""
        if self.place[rows[0]] < 0:
            self.place[rows] = np.arange(self.used, self.used + len(rows))
            self.used += len(rows)
        return self.place[rows]


def _swept(one: spans.Side, two: spans.Side, zones: Zones, geometry: Geometry) -> Columns:
    """The candidates of two sorted sides; places are positions in them."""
    d = len(geometry.periods)
    if geometry.sphere:
        from sameas.kernels.sphere import sweep_sphere

        sweep = partial(sweep_sphere, one, two, zones.cells(two), zones.windows, geometry.limit, geometry.box)
    else:
        from sameas.kernels.plane import sweep_plane

        shape = (zones.wraps, geometry.limit, geometry.box, (zones.x, zones.y), geometry.periods)
        sweep = partial(sweep_plane, one, two, zones.cells(two), zones.windows, *shape)
    bounds = threads.even(len(one.rows))
    each = _expected(sweep, len(one.rows), d)
    starts = [math.ceil(each * k) for k in bounds]
    room = _room(starts[-1], d)

    def work(first: int, last: int) -> list[Columns]:
        # Every range has its part of the room; what does not fit there gets more of its own.
        out = tuple(column[math.ceil(each * first) : math.ceil(each * last)] for column in room)
        chunks: list[Columns] = []
        while first < last:
            found, first = sweep(first, last, out)
            chunks.append(tuple(column[:found] for column in out))  # type: ignore[arg-type]
            out = _room(max(int(2 * each * (last - first)), len(two.rows), 1024), d) if first < last else ()  # type: ignore[assignment]
        return chunks

    ranges = threads.over(work, bounds)
    if any(len(chunks) > 1 for chunks in ranges):
        everything = [chunk for chunks in ranges for chunk in chunks]
        return tuple(np.concatenate(parts) for parts in zip(*everything, strict=True))  # type: ignore[return-value]
    used = 0
    for (chunk,), start in zip(ranges, starts, strict=False):
        count = len(chunk[0])
        if start != used:
            for column in room:
                column[used : used + count] = column[start : start + count]
        used += count
    return tuple(column[:used] for column in room)  # type: ignore[return-value]


def _expected(sweep: Callable[[int, int, Columns], tuple[int, int]], n: int, d: int) -> float:
    """Room to keep for the candidates of a record: what a sample of the records has, and some more."""
    if n <= 32 * SAMPLE:
        return 4.0
    out = _room(16 * SAMPLE, d)
    found = done = 0
    for first in range(0, n - SAMPLE, n // 16):
        count, reached = sweep(first, first + SAMPLE, out)
        found, done = found + count, done + max(reached - first, 1)
    return 1.25 * found / done + 0.5
