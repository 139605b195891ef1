"""Zones: the layout of two sources for the search, in which records near in space are near in memory.

Records are sorted into zones of one coordinate, and by the other coordinate within each; the few records with far
larger errors are separate classes. The order depends on the records' content, not on their rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Plane, Sphere, folded

if TYPE_CHECKING:
    from sameas.kernels import zones as kernels

Rows = NDArray[np.int32]

# Numbers of the layout affect the time of the search only, not its result (tuned by timing).

ONE_ZONE = 512  # up to this many records get one zone: more zones cost as much as testing all
SQUARE = 8.0  # a zone is as high as a square with this many records: one look-up costs as much as some tests
#: Squares along each axis of the grid that measures the area with records; refined, up to the latter, if most are empty
#: and the others crowded.
SQUARES, MAX_SQUARES = 32, 2048
FEW_TESTS = 4.0  # a class of errors is separate if that saves at least this many tests per record
FEW_ROWS = 10_000  # fewer rows than this are scanned without a compiled loop


@dataclass(frozen=True)
class Tuning:
    """Parameters of the layout, which affect the time of the search only, not its result (tuned by timing).

    Attributes
    ----------
    brute_force_records : up to this many records of both sources together on a plane, all pairs are tested.
    max_pairs_by_arrays : up to this many pairs in the same strip of latitude are tested by array operations if the
        kernel is interpreted.
    bytes_of_pair : memory for a pair in all stages together, measured. Pairs that need more than the available memory
        are refused; if that is unknown, more than ``memory`` bytes.
    """

    brute_force_records: int = 512
    max_pairs_by_arrays: int = 1_000_000
    bytes_of_pair: int = 300
    memory: int = 1 << 33


DEFAULT_TUNING = Tuning()


@dataclass(frozen=True)
class Geometry:
    """The feature space for the kernels: the coordinate of the zones (y), and that of the sweep (x).

    opening : squared half width of the gate per unit of variance, in the unit of the features.
    bare : whether a record consists of x, y and one variance only.
    """

    sphere: bool
    box: bool
    bare: bool
    limit: float
    opening: float
    periods: FloatArray
    x: int
    y: int
    tuning: Tuning

    @classmethod
    def of(cls, first: Records, second: Records, limit: float, box: bool, tuning: Tuning) -> Geometry:
        if isinstance(first.space, Sphere):
            # Box corners lie √2 farther out than the ellipse inside.
            opening = limit * (2.0 if box else 1.0) / 3600.0**2
            bare = first.covariance.shape[1] == second.covariance.shape[1] == 1
            return cls(True, box, bare, limit, opening, np.array([360.0, np.inf]), 0, 1, tuning)
        assert isinstance(first.space, Plane)
        periods = np.array(first.space.period_list(first.d))
        if first.d == 1 or len(first) + len(second) <= ONE_ZONE:
            return cls(False, box, False, limit, limit, periods, 0, 0, tuning)
        # Sweep along the feature with the widest range in units of its errors; zones of the second widest.
        sharpness = np.minimum(_sharpness(first), _sharpness(second))
        best = np.argsort(-sharpness, kind="stable")
        return cls(False, box, False, limit, limit, periods, int(best[0]), int(best[1]), tuning)

    @property
    def folds(self) -> tuple[float, float] | None:
        """The periods of x and y on a plane; None on the sphere."""
        return None if self.sphere else (float(self.periods[self.x]), float(self.periods[self.y]))


def _extent(values: FloatArray) -> FloatArray:
    """(2, d) least and greatest value of every column; few rows are not worth a compilation."""
    if 0 < len(values) < FEW_ROWS:
        return np.stack([values.min(axis=0), values.max(axis=0)])
    from sameas.kernels.zones import extent

    return np.asarray(extent(values))


@in_short
@dataclass(frozen=True)
class Source:
    """Records of one source for the search.

    features : folded into one period. variance : (n, 1) or (n, d), of the gate along the axes. ends : (2, d) least and
    greatest features.
    """

    features: FloatArray
    covariance: FloatArray
    variance: FloatArray
    records: Records
    ends: FloatArray

    @classmethod
    def of(cls, records: Records, geometry: Geometry) -> Source:
        features = records.features
        ends = _extent(features)
        for axis in np.flatnonzero(np.isfinite(geometry.periods)):
            period = geometry.periods[axis]
            if ends[0, axis] < 0 or ends[1, axis] >= period:
                reduced = folded(features[:, axis], period)
                features = features.copy()
                features[:, axis] = reduced
                ends[:, axis] = reduced.min(), reduced.max()
        variance = _widest(records) if geometry.sphere else records.variances
        return cls(features, records.covariance, variance, records, ends)

    def classes(self, others: float) -> list[Rows]:
        """The rows by classes of their errors, smallest first; the few largest are separate if that saves tests.

        others : number of records of the other source in the gate's area per unit of variance.
        """
        remaining = np.arange(len(self.features), dtype=np.int32)
        if len(remaining) < 64:
            return [remaining]
        size = self.variance[:, 0] if self.variance.shape[1] == 1 else self.variance.max(axis=1)
        parts: list[Rows] = []
        widest = 0.0
        while len(parts) < 8:
            top = size.max()
            wide = size > top / 16.0
            # A record is tested against zones and a window of about twice its own reach and √top each.
            if len(size) < 64 or np.count_nonzero(wide) > 0.2 * len(size) or 6.0 * top * others < FEW_TESTS:
                break
            part = remaining[wide]
            if parts and 6.0 * widest * others * len(part) < FEW_TESTS * len(self.features):
                # So few that another class would cost more than testing them with the gate of the previous one.
                parts[-1] = np.concatenate([parts[-1], part])
            else:
                parts.append(part)
                widest = top
            remaining, size = remaining[~wide], size[~wide]
        return [remaining, *parts[::-1]]

    def widest(self, rows: Rows, geometry: Geometry) -> tuple[float, float]:
        """The largest variances in x and in y of these rows."""
        variance = self.variance if len(rows) == len(self.variance) else self.variance[rows]
        largest = _extent(variance)[1].tolist()
        return (largest[0], largest[0]) if len(largest) == 1 else (largest[geometry.x], largest[geometry.y])

    def rank(self) -> IntArray:
        """The rank of each record's id, which orders records that are otherwise equal."""
        ids = self.records.ids[self.records.rows]
        rank = np.empty(len(ids), np.int64)
        # Ids of different types have no order, but their texts have.
        rank[np.argsort(ids.astype(str) if ids.dtype.kind == "O" else ids, kind="stable")] = np.arange(len(ids))
        return rank


@dataclass(frozen=True)
class Extent:
    """The region of two sources: (low, high) of x and of y without outliers, and the area with records.

    The area is that of the occupied squares of a grid; it is 0 without y.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    area: float

    @classmethod
    def of(cls, sources: tuple[Source, Source], geometry: Geometry) -> Extent:
        from sameas.kernels.zones import tally

        axes = [geometry.x, geometry.y]
        low = np.minimum(sources[0].ends[0], sources[1].ends[0])[axes]
        high = np.maximum(sources[0].ends[1], sources[1].ends[1])[axes]
        x, y = ((float(a), float(b)) for a, b in zip(low, high, strict=True))
        if len(sources[0].features) + len(sources[1].features) <= ONE_ZONE:
            return cls(x, y, 0.0)
        squares, total = SQUARES, sum(len(source.features) for source in sources)
        while True:
            counts = np.zeros((squares, squares), np.int64)
            size = np.maximum((high - low) / squares, 1e-300)
            for source in sources:
                tally(source.features, geometry.x, geometry.y, low[0], low[1], 1.0 / size[0], 1.0 / size[1], counts)
            held = int(np.count_nonzero(counts))
            if 4 * held > squares**2 or total < 64 * held or squares >= MAX_SQUARES:
                break
            squares *= 8  # fields far apart are much smaller than the squares
        shrink = np.ones(squares)
        if geometry.sphere:
            shrink = np.maximum(np.cos(np.radians(low[1] + size[1] * (np.arange(squares) + 0.5))), 1e-6)
        area = float(((counts > 0) * shrink).sum() * size[0] * size[1]) if geometry.x != geometry.y else 0.0
        x = _bulk(x, counts.sum(axis=1), [source.features[:, geometry.x] for source in sources])
        if not geometry.sphere:
            y = _bulk(y, counts.sum(axis=0), [source.features[:, geometry.y] for source in sources])
        return cls(x, y, area)


@dataclass(frozen=True)
class Zones:
    """Zones of equal height in y; ``wraps`` if they form a ring."""

    low: float
    height: float
    count: int
    wraps: bool

    @classmethod
    def of(cls, n: int, reach: float, extent: Extent, geometry: Geometry) -> Zones:
        """Zones for n records whose gate by their own errors extends to ``reach`` in y."""
        if geometry.x == geometry.y:
            return cls(0.0, math.inf, 1, False)
        height = max(math.sqrt(SQUARE * extent.area / n), 0.25 * reach)
        period = float(geometry.periods[geometry.y])
        low, high = (0.0, period) if math.isfinite(period) else extent.y
        count = max(1, int(min((high - low) / height, float(n))))
        return cls(low, max((high - low) / count, 1e-290), count, math.isfinite(period) and count > 1)

    def stretch(self, reach: float, geometry: Geometry) -> FloatArray:
        """(zones,) half width in x of the region within a distance in y, per unit of that distance, up to ``reach``."""
        if not geometry.sphere:
            return np.ones(self.count)
        return _longitudes(self.low, self.height, self.count, reach)


@dataclass(frozen=True)
class Layout:
    """The layout of a source, by classes of errors, smallest first.

    side : all records, by class. starts : first place of each class, and the end.
    zones, grids : of every class. widest : largest variances in x and in y of every class.
    """

    side: kernels.Side
    starts: list[int]
    zones: list[Zones]
    grids: list[kernels.Grid]
    widest: list[tuple[float, float]]

    @classmethod
    def of(cls, source: Source, classes: list[Rows], extent: Extent, geometry: Geometry) -> Layout:
        """Each class in its own zones, its records sorted by zone, x, other content, and id."""
        from sameas.kernels.zones import Side

        n, width = len(source.features), source.covariance.shape[1]
        width += 0 if geometry.sphere else source.features.shape[1]
        side = Side(np.empty((0 if geometry.bare else n, width)), np.empty((n, 4)), np.empty(n, np.int32))
        starts = list(accumulate(map(len, classes), initial=0))
        widest = [source.widest(rows, geometry) for rows in classes]
        zones = [
            Zones.of(len(rows), math.sqrt(geometry.opening * 2.0 * y), extent, geometry)
            for rows, (_, y) in zip(classes, widest, strict=True)
        ]
        grids = [
            _laid_out(source, rows, cut, extent, geometry, side, base)
            for rows, cut, base in zip(classes, zones, starts[:-1], strict=True)
        ]
        return cls(side, starts, zones, grids, widest)

    def reach(self, which: int, visitors: tuple[float, float], end: int, geometry: Geometry) -> kernels.Reach:
        """The reach into a class of records with variances up to those of ``visitors``, at places before ``end``."""
        from sameas.kernels.zones import Reach

        opening = geometry.opening * (1.0 + 1e-6)
        x, y = self.widest[which]
        stretch = self.zones[which].stretch(math.sqrt(opening * (y + visitors[1])), geometry)
        return Reach(opening, x, y, stretch, end)


def _laid_out(
    source: Source, rows: Rows, zones: Zones, extent: Extent, geometry: Geometry, side: kernels.Side, base: int
) -> kernels.Grid:
    """Write one class to ``side`` from place ``base`` on, and return its grid."""
    from sameas.kernels.zones import CELLS, Grid, Side, into_cells, into_zones, take_rows, zones_of

    n, content = len(rows), (source.features, source.covariance)
    zone, ends = np.empty(n, np.int32), np.empty(zones.count + 1, np.int64)
    zones_of(source.features, rows, geometry.y, zones.low, 1.0 / zones.height, zone, ends)
    part = Side(*(column[base : base + n] for column in side))
    into_zones(source.features, source.variance, rows, geometry.x, geometry.y, zone, ends[:-1].copy(), part)
    first, scale = np.empty(zones.count + 1, np.int64), np.empty(zones.count)
    starts = np.empty(CELLS * n + zones.count + 1, np.int32)
    frame = extent.x[0], max(extent.x[1] - extent.x[0], 1e-290)
    for rank in (lambda: np.empty(0, np.int64), source.rank):
        if into_cells(*content, geometry.sphere, ends, frame, rank(), base, (first, starts, scale), part):
            break
    take_rows(*content, part.rows, part.content)
    return Grid(first, starts, scale, extent.x[0], zones.low, 1.0 / zones.height, zones.wraps)


def _bulk(ends: tuple[float, float], counts: IntArray, values: list[FloatArray]) -> tuple[float, float]:
    """The range of the bulk of some values, if a few outliers leave most of the whole range empty."""
    share = np.cumsum(counts)
    middle = np.searchsorted(share, share[-1] * np.array([0.005, 0.995]))
    if middle[1] - middle[0] >= len(counts) // 8:
        return ends
    inner = np.percentile(np.concatenate(values), (0.5, 99.5))
    margin = 0.05 * (inner[1] - inner[0])
    return float(max(ends[0], inner[0] - margin)), float(min(ends[1], inner[1] + margin))


def _longitudes(low: float, height: float, count: int, reach_deg: float) -> FloatArray:
    """(zones,) half width in longitude of the region within reach of any point of each zone, per unit of reach.

    From sin²(s/2) ≥ cos δ₁ cos δ₂ sin²(Δα/2), with the least cosines in the zone and its reach. The width grows faster
    than sin(s/2), so the quotient for the greatest reach is sufficient for all.
    """
    bottom = low + height * np.arange(count)
    farthest = np.minimum(np.maximum(np.abs(bottom), np.abs(bottom + height)), 90.0)
    beyond = np.minimum(farthest + reach_deg, 90.0)
    cosines = np.cos(np.radians(farthest)) * np.cos(np.radians(beyond))
    half = math.radians(min(reach_deg, 180.0)) / 2.0
    sine = math.sin(half)
    stretch = np.full(count, np.inf)
    narrow = cosines > sine**2
    width = 2.0 * np.degrees(np.arcsin(sine / np.sqrt(cosines[narrow]))) * (1.0 + 1e-9)
    stretch[narrow] = width / reach_deg * (half / sine)
    return stretch


def _sharpness(records: Records) -> FloatArray:
    """Per feature, the width of the bulk of the records in standard deviations."""
    middle = percentiles(records.features, (0.05, 0.95))
    return np.asarray((middle[1] - middle[0]) / np.sqrt(records.variances.mean(axis=0)))


def percentiles(values: FloatArray, shares: tuple[float, ...]) -> FloatArray:
    """(k, d) quantiles of every column, equal to ``np.quantile``, which takes four times as long for a few hundred
    rows."""
    ranks = [share * (len(values) - 1) for share in shares]
    ends = [(int(rank), min(int(rank) + 1, len(values) - 1)) for rank in ranks]
    ordered = np.partition(values, sorted({end for both in ends for end in both}), axis=0)
    return np.stack(
        [_between(ordered[low], ordered[high], rank - low) for (low, high), rank in zip(ends, ranks, strict=True)]
    )


def _between(low: FloatArray, high: FloatArray, share: float) -> FloatArray:
    return high - (high - low) * (1.0 - share) if share >= 0.5 else low + (high - low) * share


def _widest(records: Records) -> FloatArray:
    """(n, 1) the largest variance along any direction, for positions on the sphere: their axes rotate with the pair."""
    if records.covariance.shape[1] == 1:
        return records.covariance
    if records.covariance.shape[1] == 2:
        return np.asarray(records.covariance.max(axis=1, keepdims=True))
    from sameas.kernels.zones import widest

    variance = np.empty((len(records), 1))
    widest(records.covariance, variance)
    return variance
