"""The search behind the gate: every pair whose residual is small enough for its own covariance, and no other.

Records are sorted into zones of one coordinate (``kernels/order.py``) and swept along the other
(``kernels/sweep.py``). Zones fit the largest errors of a sweep; records of very different errors are swept apart, class
by class, so that a few wide ones do not slow down the many. The order of the pairs depends on what the records say, not
on the rows they stand in.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas import threads
from sameas.records import FloatArray, Records, unpack
from sameas.space import Plane, Sphere

#: Fewer tests than this for each record are not worth another sweep.
FEW_TESTS = 4.0

#: Places, i, j, residual, squared Mahalanobis distance, determinant: the columns of :class:`sameas.gate.Pairs`.
Columns = tuple[
    NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], FloatArray, FloatArray, FloatArray
]


def search(first: Records, second: Records, limit: float, box: bool) -> Columns:
    """All pairs with Δᵀ Σ⁻¹ Δ ≤ limit (or, with ``box``, Δ_v² ≤ limit·Σ_vv in every feature v)."""
    if not len(first) or not len(second):
        return _room(0, first.d)
    geometry = _Geometry.of(first, second, limit, box)
    sides = _Side.of(first, geometry), _Side.of(second, geometry)
    classes = [side.classes(_Density(other, sides, geometry)) for side, other in zip(sides, sides[::-1], strict=True)]
    several = len(classes[0]) * len(classes[1]) > 1
    places = _Places(len(first)), _Places(len(second))
    found: list[Columns] = []
    for one in classes[0]:
        for two in classes[1]:
            zones = _Zones.of(one, two, geometry)
            ordered = threads.each(
                [partial(one.sorted, zones), partial(two.sorted, zones)], len(one.rows) + len(two.rows)
            )
            columns = _swept(ordered[0], ordered[1], zones, geometry)
            if several:
                at = [place.of(side) for place, side in zip(places, ordered, strict=True)]
                columns = (at[0][columns[0]], at[1][columns[1]], *columns[2:])
            found.append(columns)
    if not several:
        return found[0]
    columns = tuple(np.concatenate(parts) for parts in zip(*found, strict=True))  # type: ignore[assignment]
    order = np.argsort((columns[0].astype(np.int64) << 32) | columns[1])
    return tuple(np.ascontiguousarray(column[order]) for column in columns)  # type: ignore[return-value]


def _room(capacity: int, d: int) -> Columns:
    """Columns for so many pairs."""
    whole = [np.empty(capacity, np.int32) for _ in range(4)]
    return (*whole, np.empty((capacity, d)), np.empty(capacity), np.empty(capacity))  # type: ignore[return-value]


@dataclass(frozen=True)
class _Density:
    """How densely the records of a side lie in the plane of x and y; worked out only where it is asked for."""

    side: _Side
    sides: tuple[_Side, _Side]
    geometry: _Geometry

    def __call__(self) -> float:
        return len(self.side.rows) / max(_area(*self.sides, self.geometry), 1e-290)


class _Places:
    """The place of every record in an order of content: class by class, each as it was first sorted."""

    def __init__(self, n: int) -> None:
        self.place = np.full(n, -1, np.int32)
        self.used = 0

    def of(self, side: _Side) -> NDArray[np.int32]:
        """The places of the sorted records of a class, given to them when it is first asked for."""
        if self.place[side.rows[0]] < 0:
            self.place[side.rows] = np.arange(self.used, self.used + len(side.rows))
            self.used += len(side.rows)
        return self.place[side.rows]


@dataclass(frozen=True)
class _Geometry:
    """The feature space as the kernel wants it: which coordinate makes the zones (y), which is swept (x)."""

    sphere: bool
    box: bool
    limit: float
    periods: FloatArray
    x: int
    y: int

    @classmethod
    def of(cls, first: Records, second: Records, limit: float, box: bool) -> _Geometry:
        if isinstance(first.space, Sphere):
            return cls(True, box, limit, np.array([360.0, np.inf]), 0, 1)
        assert isinstance(first.space, Plane)
        periods = np.array(first.space.period_list(first.d))
        if first.d == 1:
            return cls(False, box, limit, periods, 0, 0)
        # Sweep along the feature that separates best for its errors; zones of the second best.
        sharpness = np.minimum(_sharpness(first), _sharpness(second))
        best = np.argsort(-sharpness, kind="stable")
        return cls(False, box, limit, periods, int(best[0]), int(best[1]))

    def array(self, wraps: bool) -> FloatArray:
        return np.array([self.sphere, self.box, self.limit, self.x, self.y, wraps], dtype=np.float64)


def _area(one: _Side, two: _Side, geometry: _Geometry) -> float:
    """Area in x and y where records lie, by the cells of a grid that they occupy; 0 where there is no y."""
    if geometry.x == geometry.y:
        return 0.0
    axes = [geometry.x, geometry.y]
    low = np.minimum(one.features.min(axis=0), two.features.min(axis=0))[axes]
    high = np.maximum(one.features.max(axis=0), two.features.max(axis=0))[axes]
    extent = np.maximum(high - low, 1e-300)
    occupied = np.zeros((32, 32), np.bool_)
    for side in (one, two):
        cell = [np.minimum((side.features[:, v] - low[k]) * (32.0 / extent[k]), 31.0) for k, v in enumerate(axes)]
        occupied[cell[0].astype(np.int8), cell[1].astype(np.int8)] = True
    shrink = np.ones(32)
    if geometry.sphere:
        shrink = np.maximum(np.cos(np.radians(low[1] + extent[1] * (np.arange(32) + 0.5) / 32.0)), 1e-6)
    return float((occupied * shrink).sum() * extent[0] * extent[1] / 1024.0)


def _sharpness(records: Records) -> FloatArray:
    """Per feature, how many standard deviations wide the bulk of the records lies."""
    middle = np.percentile(records.features, (5, 95), axis=0)
    return (middle[1] - middle[0]) / np.sqrt(_variances(records).mean(axis=0))


def _variances(records: Records) -> FloatArray:
    """(n, 1) or (n, d) variances along the axes."""
    p, d = records.covariance.shape[1], records.d
    if p <= d:
        return records.covariance
    diagonal = np.cumsum([0, *range(d, 1, -1)])
    return records.covariance[:, diagonal]


@dataclass(frozen=True)
class _Side:
    """Records of one source as the sweep sees them.

    features are folded into one period; reach (n, 1) or (n, d) is how far a record's own error opens the gate, in the
    unit of the features; starts are the zones once the side is sorted; the records' ids break ties between equal ones.
    """

    features: FloatArray
    covariance: FloatArray
    rows: NDArray[np.int32]
    reach: FloatArray
    records: Records
    starts: NDArray[np.int64]

    @classmethod
    def of(cls, records: Records, geometry: _Geometry) -> _Side:
        features = records.features
        for axis in np.flatnonzero(np.isfinite(geometry.periods)):
            period = geometry.periods[axis]
            folded = features[:, axis]
            if folded.size and (folded.min() < 0 or folded.max() >= period):
                folded = np.mod(folded, period)
                folded[folded >= period] = 0.0
                features = features.copy()
                features[:, axis] = folded
        if geometry.sphere and records.covariance.shape[1] > 1:
            # The axes turn between two directions: only the largest eigenvalue bounds the reach on every axis.
            widest = np.linalg.eigvalsh(unpack(records.covariance, 2))[:, -1:]
        else:
            widest = _variances(records)
        reach = np.sqrt(geometry.limit * widest)
        if geometry.sphere:
            # Box edges reach √2 further than the ellipse that they enclose.
            reach = reach * (math.sqrt(2.0) if geometry.box else 1.0) / 3600.0
        rows = np.arange(len(records), dtype=np.int32)
        return cls(features, records.covariance, rows, reach, records, np.empty(0, np.int64))

    def take(self, rows: NDArray[np.int64]) -> _Side:
        return replace(
            self,
            features=np.ascontiguousarray(self.features[rows]),
            covariance=np.ascontiguousarray(self.covariance[rows]),
            rows=self.rows[rows],
            reach=self.reach[rows],
        )

    def classes(self, others: Callable[[], float]) -> list[_Side]:
        """This side split by the size of its errors: the few widest apart, as long as that saves work.

        others : gives the density of the other source in the plane of x and y.
        """
        size = self.reach.max(axis=1)
        remaining = np.arange(len(size))
        parts: list[NDArray[np.int64]] = []
        while len(parts) < 8:
            top = size[remaining].max()
            wide = size[remaining] > top / 4.0
            # A record is tested against three zones of height top in a window of 2 top.
            if len(remaining) < 64 or wide.mean() > 0.2 or 6.0 * top**2 * others() < FEW_TESTS:
                break
            parts.append(remaining[wide])
            remaining = remaining[~wide]
        if not parts:
            return [self]
        return [self.take(rows) for rows in [*parts, remaining]]

    def sorted(self, zones: _Zones) -> _Side:
        """Sorted by zone, then x, then the rest of the content, then id."""
        from sameas.kernels.order import gather, sort_by_bits, sort_keys, sort_within_bins

        n = len(self.rows)
        row_bits = max(1, int(n - 1).bit_length())
        zone_bits = max(1, int(zones.count - 1).bit_length())
        # Enough bins that few hold two records; those are put in order one by one.
        bin_bits = min(row_bits + 3, 32, 64 - row_bits - zone_bits)
        keys = np.empty(n, np.uint64)
        starts = np.zeros(zones.count + 1, np.int64)
        sort_keys(self.features, zones.x, zones.y, zones.cuts(), row_bits, bin_bits, keys, starts)
        keys = sort_by_bits(keys, row_bits, row_bits + bin_bits + zone_bits)
        order = np.empty(n, np.int64)
        inner = (order, row_bits, keys, self.features, self.covariance, zones.x)
        doubt = sort_within_bins(*inner, np.empty(0, np.int64))
        if doubt == 1:
            doubt = sort_within_bins(*inner, self.rank())
        if doubt:
            order = self.content_order(zones.of_y(self.features[:, zones.y]), self.features[:, zones.x])
        features, covariance = np.empty_like(self.features), np.empty_like(self.covariance)
        reach, rows = np.empty_like(self.reach), np.empty_like(self.rows)
        gather(order, self.features, self.covariance, self.reach, self.rows, features, covariance, reach, rows)
        return replace(self, features=features, covariance=covariance, reach=reach, rows=rows, starts=starts)

    def guard(self, geometry: _Geometry) -> FloatArray:
        """(n, 2) what tells most pairs apart before anything exact: on the sphere squared reach and cosine of the
        latitude; on a plane squared reach in x and in y."""
        guard = np.empty((len(self.rows), 2))
        if geometry.sphere:
            np.multiply(self.reach[:, 0], self.reach[:, 0] * (1.0 + 1e-6), out=guard[:, 0])
            np.cos(self.features[:, 1] * (math.pi / 180.0), out=guard[:, 1])
            return guard
        last = self.reach.shape[1] - 1
        for k, axis in enumerate((geometry.x, geometry.y)):
            np.multiply(self.reach[:, min(axis, last)], self.reach[:, min(axis, last)] * (1.0 + 1e-6), out=guard[:, k])
        return guard

    def rank(self) -> NDArray[np.int64]:
        """The place of each record's id among the ids: what orders records that are equal in all else."""
        ids = self.records.ids[self.records.rows[self.rows]]
        rank = np.empty(len(ids), np.int64)
        # Ids of several kinds have no order among themselves, but their texts have.
        rank[np.argsort(ids.astype(str) if ids.dtype.kind == "O" else ids, kind="stable")] = np.arange(len(ids))
        return rank

    def content_order(self, *before: NDArray[Any]) -> NDArray[np.int64]:
        """The rows sorted by the keys ``before``, then features, covariance and id."""
        return np.lexsort([self.rank(), *self.covariance.T[::-1], *self.features.T[::-1], *before[::-1]])


@dataclass(frozen=True)
class _Zones:
    """Zones of equal height in y, and for each the half width of the window in x."""

    x: int
    y: int
    low: float
    height: float
    count: int
    wraps: bool
    windows: FloatArray
    x_low: float
    x_high: float

    @classmethod
    def of(cls, one: _Side, two: _Side, geometry: _Geometry) -> _Zones:
        x, y = geometry.x, geometry.y
        widest = np.hypot(one.reach.max(axis=0), two.reach.max(axis=0)) * (1.0 + 1e-9) + 1e-300
        reach_x, reach_y = (float(widest[0]),) * 2 if len(widest) == 1 else (float(widest[x]), float(widest[y]))
        x_low = min(one.features[:, x].min(), two.features[:, x].min())
        x_high = max(one.features[:, x].max(), two.features[:, x].max())
        period = float(geometry.periods[y])
        most = 4 * max(len(one.rows), len(two.rows))
        if x == y:
            low, height, count, wraps = 0.0, math.inf, 1, False
        elif math.isfinite(period):
            count = int(min(period / reach_y, most))
            count = count if count >= 3 else 1
            low, height, wraps = 0.0, period / count, True
        else:
            low, high = _stretch(one.features[:, y], two.features[:, y], reach_y, most, geometry.sphere)
            count = int(max(1, min((high - low) / reach_y, most)))
            height, wraps = max((high - low) / count, reach_y), False
        windows = _sphere_windows(low, height, count, reach_x) if geometry.sphere else np.full(count, reach_x)
        return cls(x, y, low, height, count, wraps, windows, float(x_low), float(x_high))

    def cuts(self) -> FloatArray:
        """(low, height, count) of the zones and (low, extent) of x."""
        return np.array([self.low, self.height, self.count, self.x_low, max(self.x_high - self.x_low, 1e-290)])

    def of_y(self, y: FloatArray) -> NDArray[np.int64]:
        """The zone of each y; beyond the first and the last zone, those."""
        zone = np.floor((y - self.low) / self.height)
        return np.clip(zone, 0, self.count - 1).astype(np.int64)


def _stretch(y1: FloatArray, y2: FloatArray, reach: float, most: int, sphere: bool) -> tuple[float, float]:
    """The stretch of y to cut into zones: all of it, or its bulk where outliers would make the zones too coarse."""
    low, high = min(y1.min(), y2.min()), max(y1.max(), y2.max())
    if (high - low) / reach > most and not sphere:
        inner = np.percentile(np.concatenate([y1, y2]), (0.5, 99.5))
        margin = 0.05 * (inner[1] - inner[0])
        low, high = max(low, inner[0] - margin), min(high, inner[1] + margin)
    return float(low), float(high)


def _sphere_windows(low: float, height: float, count: int, reach_deg: float) -> FloatArray:
    """Half width in longitude, degrees, of what lies within ``reach_deg`` of any point of each zone.

    From sin²(s/2) ≥ cos δ₁ cos δ₂ sin²(Δα/2), with the least cosines that the zone and its reach contain.
    """
    bottom = low + height * np.arange(count)
    farthest = np.minimum(np.maximum(np.abs(bottom), np.abs(bottom + height)), 90.0)
    beyond = np.minimum(farthest + reach_deg, 90.0)
    cosines = np.cos(np.radians(farthest)) * np.cos(np.radians(beyond))
    sine = math.sin(math.radians(min(reach_deg, 180.0)) / 2.0)
    windows = np.full(count, 360.0)
    narrow = cosines > sine**2
    windows[narrow] = 2.0 * np.degrees(np.arcsin(sine / np.sqrt(cosines[narrow]))) * (1.0 + 1e-9)
    return windows


def _swept(one: _Side, two: _Side, zones: _Zones, geometry: _Geometry) -> Columns:
    """The candidates of two sorted sides; places are positions in them."""
    from sameas.kernels.sweep import sweep

    d = one.features.shape[1]
    packed = geometry.array(zones.wraps)
    guards = one.guard(geometry), two.guard(geometry)

    bounds = threads.even(len(one.rows))
    starts = [4 * k for k in bounds]
    room = _room(starts[-1], d)

    def work(first: int, last: int) -> list[Columns]:
        # Every range has its part of the room; what does not fit there gets more of its own.
        out = tuple(column[4 * first : 4 * last] for column in room)
        chunks: list[Columns] = []
        while first < last:
            found, first = sweep(
                one.features, one.covariance, one.rows, one.starts, guards[0],
                two.features, two.covariance, two.rows, two.starts, guards[1],
                zones.windows, packed, geometry.periods, first, last, *out,
            )  # fmt: skip
            chunks.append(tuple(column[:found] for column in out))  # type: ignore[arg-type]
            out = _room(max(4 * (last - first), len(two.rows), 1024), d) if first < last else ()  # type: ignore[assignment]
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
