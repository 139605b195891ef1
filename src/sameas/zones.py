"""Zones: how the search lays two sources out, so that what is near in space is near in memory.

Records are sorted into zones of one coordinate and along the other within each; records of very different errors are
laid out apart, class by class. The order depends on what the records say, not on the rows they stand in.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.records import FloatArray, Records
from sameas.space import Plane, Sphere

if TYPE_CHECKING:
    from sameas.kernels import spans

#: Fewer tests than this for each record are not worth another sweep.
FEW_TESTS = 4.0
#: So few records are swept in one zone: to lay out more costs as much as to test them all.
FEW_RECORDS = 512
#: So few keys are not sorted by their bits.
FEW_KEYS = 4096


@dataclass(frozen=True)
class Geometry:
    """The feature space as the kernels want it: which coordinate makes the zones (y), which is swept (x).

    opening : by how much a variance of one opens the gate, squared, in the unit of the features.
    """

    sphere: bool
    box: bool
    limit: float
    opening: float
    periods: FloatArray
    x: int
    y: int

    @classmethod
    def of(cls, first: Records, second: Records, limit: float, box: bool) -> Geometry:
        if isinstance(first.space, Sphere):
            # Box edges reach √2 further than the ellipse that they enclose.
            opening = limit * (2.0 if box else 1.0) / 3600.0**2
            return cls(True, box, limit, opening, np.array([360.0, np.inf]), 0, 1)
        assert isinstance(first.space, Plane)
        periods = np.array(first.space.period_list(first.d))
        if first.d == 1 or len(first) + len(second) <= FEW_RECORDS:
            return cls(False, box, limit, limit, periods, 0, 0)
        # Sweep along the feature that separates best for its errors; zones of the second best.
        sharpness = np.minimum(_sharpness(first), _sharpness(second))
        best = np.argsort(-sharpness, kind="stable")
        return cls(False, box, limit, limit, periods, int(best[0]), int(best[1]))


@dataclass(frozen=True)
class Side:
    """Records of one source as the sweep sees them, or one class of them.

    features are folded into one period; variance (n, 1) or (n, d) opens the gate along the axes; rows are positions in
    ``records``, whose ids break ties between equal ones; ends (2, d) are the least and greatest features.
    """

    features: FloatArray
    covariance: FloatArray
    variance: FloatArray
    rows: NDArray[np.int32]
    records: Records
    ends: FloatArray

    @classmethod
    def of(cls, records: Records, geometry: Geometry) -> Side:
        from sameas.kernels.order import extent

        features = records.features
        ends = extent(features)
        for axis in np.flatnonzero(np.isfinite(geometry.periods)):
            period = geometry.periods[axis]
            if ends[0, axis] < 0 or ends[1, axis] >= period:
                folded = np.mod(features[:, axis], period)
                folded[folded >= period] = 0.0
                features = features.copy()
                features[:, axis] = folded
                ends[:, axis] = folded.min(), folded.max()
        variance = _widest(records) if geometry.sphere else _variances(records)
        return cls(features, records.covariance, variance, np.arange(len(records), dtype=np.int32), records, ends)

    def take(self, rows: NDArray[np.int64]) -> Side:
        from sameas.kernels.order import extent

        features = np.ascontiguousarray(self.features[rows])
        covariance = np.ascontiguousarray(self.covariance[rows])
        return Side(features, covariance, self.variance[rows], self.rows[rows], self.records, extent(features))

    def classes(self, others: Callable[[], float]) -> list[Side]:
        """This side split by the size of its errors: the few widest apart, as long as that saves work.

        others : gives how many records of the other source lie in the area that a variance of one opens.
        """
        if len(self.rows) < 64:
            return [self]
        size = self.variance[:, 0] if self.variance.shape[1] == 1 else self.variance.max(axis=1)
        remaining: NDArray[np.int64] | None = None
        parts: list[NDArray[np.int64]] = []
        widest = 0.0
        while len(parts) < 8:
            top = size.max()
            wide = size > top / 16.0
            # A record is tested against three zones of height √top in a window of twice that.
            if len(size) < 64 or np.count_nonzero(wide) > 0.2 * len(size) or 6.0 * top * others() < FEW_TESTS:
                break
            remaining = np.arange(len(self.rows)) if remaining is None else remaining
            part = remaining[wide]
            if parts and 6.0 * widest * others() * len(part) < FEW_TESTS * len(self.rows):
                # So few that another sweep would cost more than to test them as widely as those before.
                parts[-1] = np.concatenate([parts[-1], part])
            else:
                parts.append(part)
                widest = top
            remaining, size = remaining[~wide], size[~wide]
        if remaining is None:
            return [self]
        return [self.take(rows) for rows in [*parts, remaining]]

    def sorted(self, zones: Zones, geometry: Geometry) -> spans.Side:
        """Sorted by zone, then x, then the rest of the content, then id."""
        from sameas.kernels import spans
        from sameas.kernels.order import sort_by_bits, sort_within_bins, take_rows, write_rows

        n, d = self.features.shape
        row_bits = max(1, int(n - 1).bit_length())
        zone_bits = max(1, int(zones.count - 1).bit_length())
        # Enough bins that few hold two records; those are put in order one by one.
        bin_bits = min(row_bits + 3, 32, 64 - row_bits - zone_bits)
        keys = np.empty(n, np.uint64)
        starts = np.zeros(zones.count + 1, np.int64)
        written = np.empty((n, d + self.covariance.shape[1]))
        shape = (zones.x, zones.y, zones.cuts(), row_bits, bin_bits)
        write_rows(self.features, self.covariance, *shape, keys, written, starts)
        if n < FEW_KEYS:
            keys.sort()
        else:
            keys = sort_by_bits(keys, row_bits, row_bits + bin_bits + zone_bits)
        order = np.empty(n, np.int32)
        doubt = sort_within_bins(order, row_bits, keys, written, zones.x, np.empty(0, np.int64))
        if doubt == 1:
            doubt = sort_within_bins(order, row_bits, keys, written, zones.x, self.rank())
        if doubt:
            order = self.content_order(zones.of_y(self.features[:, zones.y]), self.features[:, zones.x])
        content, guard = np.empty_like(written), np.empty((n, 4))
        opening = geometry.opening * (1.0 + 1e-6)
        take_rows(order, written, d, geometry.sphere, zones.x, zones.y, opening, content, guard)
        return spans.Side(content, guard, order if n == len(self.records) else self.rows[order], starts)

    def rank(self) -> NDArray[np.int64]:
        """The place of each record's id among the ids: what orders records that are equal in all else."""
        ids = self.records.ids[self.records.rows[self.rows]]
        rank = np.empty(len(ids), np.int64)
        # Ids of several kinds have no order among themselves, but their texts have.
        rank[np.argsort(ids.astype(str) if ids.dtype.kind == "O" else ids, kind="stable")] = np.arange(len(ids))
        return rank

    def content_order(self, *before: NDArray[Any]) -> NDArray[np.int32]:
        """The rows sorted by the keys ``before``, then features, covariance and id."""
        keys = [self.rank(), *self.covariance.T[::-1], *self.features.T[::-1], *before[::-1]]
        return np.lexsort(keys).astype(np.int32)


@dataclass(frozen=True)
class Zones:
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
    def of(cls, one: Side, two: Side, geometry: Geometry) -> Zones:
        x, y = geometry.x, geometry.y
        widest = one.variance.max(axis=0) + two.variance.max(axis=0)
        reach = np.sqrt(geometry.opening * widest) * (1.0 + 1e-9) + 1e-300
        reach_x, reach_y = (float(reach[0]),) * 2 if len(reach) == 1 else (float(reach[x]), float(reach[y]))
        ends = np.minimum(one.ends[0], two.ends[0]), np.maximum(one.ends[1], two.ends[1])
        period = float(geometry.periods[y])
        most = 4 * max(len(one.rows), len(two.rows))
        if x == y:
            low, height, count, wraps = 0.0, math.inf, 1, False
        elif math.isfinite(period):
            count = int(min(period / reach_y, most))
            count = count if count >= 3 else 1
            low, height, wraps = 0.0, period / count, True
        else:
            low, high = float(ends[0][y]), float(ends[1][y])
            if (high - low) / reach_y > most and not geometry.sphere:
                low, high = _bulk(one.features[:, y], two.features[:, y])
            count = int(max(1, min((high - low) / reach_y, most)))
            height, wraps = max((high - low) / count, reach_y), False
        windows = _sphere_windows(low, height, count, reach_x) if geometry.sphere else np.full(count, reach_x)
        return cls(x, y, low, height, count, wraps, windows, float(ends[0][x]), float(ends[1][x]))

    def cuts(self) -> FloatArray:
        """(low, height, count) of the zones and (low, extent) of x."""
        return np.array([self.low, self.height, self.count, self.x_low, max(self.x_high - self.x_low, 1e-290)])

    def cells(self, side: spans.Side) -> spans.Cells:
        """The zones cut into cells of x, as many as the side has records, and one more each."""
        from sameas.kernels.spans import Cells, cells_of

        zones = np.empty(self.count + 1, np.int64)
        starts = np.empty(len(side.rows) + self.count + 1, np.int32)
        scale = np.empty(self.count)
        cells_of(side, self.x_low, max(self.x_high - self.x_low, 1e-290), zones, starts, scale)
        return Cells(zones, starts, self.x_low, scale)

    def of_y(self, y: FloatArray) -> NDArray[np.int64]:
        """The zone of each y; beyond the first and the last zone, those."""
        zone = np.floor((y - self.low) / self.height)
        return np.clip(zone, 0, self.count - 1).astype(np.int64)


def _bulk(y1: FloatArray, y2: FloatArray) -> tuple[float, float]:
    """The stretch of y that holds the bulk of the records: outliers would make the zones too coarse."""
    y = np.concatenate([y1, y2])
    inner = np.percentile(y, (0.5, 99.5))
    margin = 0.05 * (inner[1] - inner[0])
    return float(max(y.min(), inner[0] - margin)), float(min(y.max(), inner[1] + margin))


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


def _widest(records: Records) -> FloatArray:
    """(n, 1) the largest variance in any direction of directions on the sphere: their axes turn from pair to pair."""
    if records.covariance.shape[1] == 1:
        return records.covariance
    if records.covariance.shape[1] == 2:
        return records.covariance.max(axis=1, keepdims=True)
    xx, xy, yy = records.covariance.T
    return (0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy))[:, None]


def area(one: Side, two: Side, geometry: Geometry) -> float:
    """Area in x and y where records lie, by the cells of a grid that they occupy; 0 where there is no y."""
    if geometry.x == geometry.y:
        return 0.0
    axes = [geometry.x, geometry.y]
    low = np.minimum(one.ends[0], two.ends[0])[axes]
    high = np.maximum(one.ends[1], two.ends[1])[axes]
    extent = np.maximum(high - low, 1e-300)
    occupied = np.zeros((32, 32), np.bool_)
    for side in (one, two):
        cell = [np.minimum((side.features[:, v] - low[k]) * (32.0 / extent[k]), 31.0) for k, v in enumerate(axes)]
        occupied[cell[0].astype(np.int8), cell[1].astype(np.int8)] = True
    shrink = np.ones(32)
    if geometry.sphere:
        shrink = np.maximum(np.cos(np.radians(low[1] + extent[1] * (np.arange(32) + 0.5) / 32.0)), 1e-6)
    return float((occupied * shrink).sum() * extent[0] * extent[1] / 1024.0)
