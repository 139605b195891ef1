"""Hough search: offsets at which more records of the two sources coincide than by chance.

In the chart of an offset model, its main parameters shift all records by the same amount. Every pair of records votes
for the shift that would make it one object: true pairs vote for the same shift, chance pairs for any. Votes are counted
in cells, from coarse ones down to the size of the errors. Parameters that do not shift the chart (rotation, stretch, …)
are searched on a grid, for many records on a few small patches, which need a coarse grid only. If the pairs are too
many to list, the counts are the correlation of both densities of records, by Fourier transform.

"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.records import Records
from sameas.registration.offsets import Offset
from sameas.space import Sphere, wrapped

#: Score, and a shift in the chart.
Peak = tuple[float, FloatArray]

#: Maximum number of pairs whose votes are counted one by one (above, counts are a correlation by FFT), and of cells.
MAX_PAIRS, MAX_CELLS = 2_000_000, 1 << 19
#: Cells up to FINE_SIGMAS σ, the standard deviation of a residual, need no finer count; peaks of a coarse count that
#: are refined.
FINE_SIGMAS, COARSE_PEAKS = 2.0, 8
FIRST_RECORDS, MORE_RECORDS = 64, 8  # records that vote first, and the factor to the next number of them
#: The votes of a sample decide at this score, with at most this many peaks near it.
DECIDED_SCORE, FEW_PEAKS = 25.0, 4
#: Records of a patch in a grid search, peaks kept at each node, and size of its cells in σ, wider than 1 because the
#: true votes at a node of the grid do not coincide exactly.
PATCH_RECORDS, NODE_PEAKS, PATCH_CELL_SIGMAS = 40, 5, 1.6
#: A step of the grid moves the patch's edge by this many σ; the grid extends to this many prior widths in at most this
#: many steps.
STEP_SIGMAS, REACH_WIDTHS, MAX_STEPS = 3.0, 2.5, 41
PEAK_SHARE, PEAK_CELLS = 0.3, 2  # minimum share of the best score, and minimum distance in cells, of fine peaks
VOTE_SAMPLE = 20_000  # records that locate the votes within a coarse cell


@dataclass(frozen=True)
class Votes:
    """Initial offsets, best first: ``theta`` (s, p), scores (s,), and the patch of each (s,), a number in ``patches``;
    a patch is rows of the second source."""

    theta: FloatArray
    score: FloatArray
    patch: IntArray
    patches: tuple[IntArray, ...]

    def with_zero(self) -> Votes:
        """These, and the offset 0."""
        theta = np.concatenate([self.theta, np.zeros((1, self.theta.shape[1]))])
        return Votes(theta, np.append(self.score, 0.0), np.append(self.patch, 0), self.patches)


#: Score, number of the patch, and θ of each initial offset.
Entries = list[tuple[float, int, FloatArray]]


@dataclass(frozen=True)
class HoughSearch:
    """Two sources and an offset model placed on them."""

    first: Records
    second: Records
    model: Offset

    def vote(self, count: int) -> Votes:
        """The ``count`` offsets with the most votes."""
        entries, patches = self._on_patches(count) if self.model.turns() else self._by_sample(count)
        entries.sort(key=lambda entry: -entry[0])
        entries = [entry for entry in entries if entry[0] >= PEAK_SHARE * entries[0][0]][:count]
        p = len(self.model.names)
        return Votes(
            np.array([theta for _, _, theta in entries]).reshape(-1, p), np.array([score for score, _, _ in entries]),
            np.array([number for _, number, _ in entries], np.int64), patches,
        )  # fmt: skip

    def _by_sample(self, count: int) -> tuple[Entries, tuple[IntArray, ...]]:
        """The votes of a few records of the second source, then of more, until one peak is clear."""
        n, size = len(self.second), FIRST_RECORDS
        while True:
            rows = np.linspace(0, n - 1, min(size, n)).astype(np.int64)
            peaks = self._shifts(rows, np.zeros(len(self.model.names)), 1.0, count)
            best = max((score for score, _ in peaks), default=0.0)
            near = sum(score >= PEAK_SHARE * best for score, _ in peaks)
            if len(rows) == n or (best >= DECIDED_SCORE and near <= FEW_PEAKS):
                return [(score, 0, theta) for score, theta in peaks], (rows,)
            size *= MORE_RECORDS

    def _on_patches(self, count: int) -> tuple[Entries, tuple[IntArray, ...]]:
        """The votes at every node of the grid, of all records or of small patches."""
        entries: Entries = []
        patches = _patches(self.model.chart(self.second.features), PATCH_RECORDS)
        # On small patches true votes are clear; otherwise chance votes may outnumber them, and more peaks are kept.
        each, cell = (count, 1.0) if len(patches) == 1 else (NODE_PEAKS, PATCH_CELL_SIGMAS)
        for number, rows in enumerate(patches):
            for node in self._grid(rows):
                entries += [(score, number, theta) for score, theta in self._shifts(rows, node, cell, each)]
        return entries, patches

    def _grid(self, rows: IntArray) -> Iterator[FloatArray]:
        """θ of every grid node: the parameters that do not shift the chart, in steps that hardly distort the patch."""
        p, sigma = len(self.model.names), typical_sigma(self.first, self.second)
        axes = []
        jacobian = self.model.jacobian(self.second.features, np.zeros(p))[rows]
        for direction, width in self.model.turns():
            move = jacobian @ direction
            distortion = float(np.sqrt(np.sum((move - move.mean(axis=0)) ** 2, axis=1)).max(initial=0.0))
            reach = REACH_WIDTHS * width
            steps = min(math.ceil(reach * distortion / (STEP_SIGMAS * sigma)), MAX_STEPS // 2)
            axes.append(
                [direction * at for at in np.linspace(-reach, reach, 2 * steps + 1)] if steps else [0.0 * direction]
            )
        for parts in product(*axes):
            yield np.sum(parts, axis=0) if parts else np.zeros(p)

    def _shifts(self, rows: IntArray, node: FloatArray, cell: float, count: int) -> list[Peak]:
        """The shifts with the most votes at one node of the grid, as (score, θ); ``cell`` : size of the cells in σ."""
        first, second, model = self.first, self.second, self.model
        d, periods = first.d, np.array(model.periods(first.d))
        moved = model.moved(second.features, node)
        sigma = np.hypot(_chart_sigma(model, first, first.features), _chart_sigma(model, second, moved))
        one, two = np.ascontiguousarray(model.chart(first.features)), model.chart(moved)[rows]
        limit = np.empty(d)
        for axis, (which, per) in enumerate(model.voted(d)):
            width = 0.0 if which is None else model.widths[which]
            limit[axis] = (3.5 * width / abs(per) if width < math.inf else math.inf) + 3.0 * sigma[axis]
        if len(one) * len(two) <= MAX_PAIRS:
            low = np.where(np.isfinite(periods), -0.5 * periods, one.min(axis=0) - two.max(axis=0)) - 3.0 * sigma
            high = np.where(np.isfinite(periods), 0.5 * periods, one.max(axis=0) - two.min(axis=0)) + 3.0 * sigma
            box = np.maximum(low, -limit), np.maximum(np.minimum(high, limit), np.maximum(low, -limit))
            peaks = Charts(one, two, periods, sigma * cell).peaks(box, count)
        else:
            peaks = Charts(one, two, periods, sigma).correlated_peaks(limit, count)
        result = []
        for score, shift in peaks:
            theta = node.copy()
            for axis, (which, per) in enumerate(model.voted(d)):
                if which is not None:
                    theta[which] += per * shift[axis]
            result.append((score, theta))
        return result


def _patches(chart: FloatArray, size: int) -> tuple[IntArray, ...]:
    """Rows of all records, or of the patches nearest to the centre of the field and to those of its quarters."""
    n, d = chart.shape
    if n <= 2 * size:
        return (np.arange(n),)
    spread = np.maximum(chart.std(axis=0), 1e-300)
    signs = [np.zeros(d), *(np.array(s) for s in product((-0.8, 0.8), repeat=min(d, 2)))]
    patches = []
    for sign in signs:
        middle = chart.mean(axis=0) + spread * np.pad(sign, (0, d - len(sign)))
        distance = np.sum(((chart - middle) / spread) ** 2, axis=1)
        patches.append(np.argpartition(distance, size)[:size])
    return tuple(patches)


def typical_sigma(first: Records, second: Records) -> float:
    """Median standard deviation of one axis of a residual."""
    parts = [np.median(np.einsum("nvv->n", r.full_covariance()) / r.d) for r in (first, second)]
    return math.sqrt(float(sum(parts)))


def _chart_sigma(model: Offset, records: Records, features: FloatArray) -> FloatArray:
    """(d,) median standard deviations along the chart's axes, by finite steps along the features' axes."""
    d, periods = records.d, np.array(model.periods(records.d))
    sigma = np.sqrt(np.einsum("nvv->nv", records.full_covariance()))
    # On the sphere the chart is in the residual's unit already.
    if isinstance(records.space, Sphere):
        return np.asarray(np.median(sigma, axis=0))
    variance = np.zeros_like(features)
    for axis in range(d):
        step = model.chart(features + sigma[:, axis, None] * np.eye(d)[axis]) - model.chart(features)
        variance += wrapped(step, periods) ** 2
    return np.asarray(np.sqrt(np.median(variance, axis=0)))


@dataclass(frozen=True)
class Charts:
    """Records of both sources in the chart, (n₁, d) and (n₂, d), its periods (d,), and σ of a difference (d,)."""

    one: FloatArray
    two: FloatArray
    periods: FloatArray
    sigma: FloatArray

    def peaks(self, box: tuple[FloatArray, FloatArray], count: int, density: float | None = None) -> list[Peak]:
        """Peaks of the differences of records within a box, in coarse cells first if needed, then in fine ones.

        box : its low and high corner. density : of chance votes; estimated from the surroundings if not given.
        """
        from sameas.kernels.offsets import tally

        (low, high), sigma = box, self.sigma
        most = min(max(64 * len(self.one) * len(self.two), 4096), MAX_CELLS)
        size = sigma * _coarser((high - low) / sigma, most)
        # One more cell at either end, which stays empty.
        cells, start = np.maximum(np.ceil((high - low) / size).astype(np.int64), 1) + 2, low - size
        votes = tally(self.one, self.two, self.periods, start, size, cells).reshape(tuple(cells))
        chance = None if density is None else density * float(size.prod())
        if np.all(size <= FINE_SIGMAS * sigma):
            return [
                (score, start + (cell + 0.5) * size)
                for score, cell, _ in _crowded(votes, count, chance, PEAK_SHARE, PEAK_CELLS)
            ]
        result: list[Peak] = []
        for _, cell, chance_votes in _crowded(votes, min(count, COARSE_PEAKS), chance, 0.0, 1):
            block = start + (cell - 1.0) * size, start + (cell + 2.0) * size
            result += self.peaks(block, max(1, count // COARSE_PEAKS), chance_votes / float(size.prod()))
        result.sort(key=lambda entry: -entry[0])
        return result[:count]

    def correlated_peaks(self, limit: FloatArray, count: int) -> list[Peak]:
        """Peaks when the pairs are too many to list: by correlation of both sources' densities (FFT)."""
        from scipy.signal import fftconvolve
        from scipy.spatial import cKDTree

        one, two, sigma = self.one, self.two, self.sigma
        origin_1, origin_2, d = one.min(axis=0), two.min(axis=0), one.shape[1]
        span = np.maximum(np.maximum(one.max(axis=0) - origin_1, two.max(axis=0) - origin_2), sigma)
        size = sigma * _coarser(span / sigma, MAX_CELLS / 2.0)
        cells = np.ceil(span / size).astype(int) + 1
        densities = [_density((one - origin_1) / size, cells), _density((two - origin_2) / size, cells)]
        votes = np.pad(fftconvolve(densities[0], densities[1][(slice(None, None, -1),) * d]).clip(0.0), 1)
        start = origin_1 - origin_2 - cells * size
        for v in range(d):
            shift = wrapped(start[v] + np.arange(votes.shape[v]) * size[v], self.periods[v])
            votes *= np.expand_dims(np.abs(shift) <= limit[v] + size[v], tuple(u for u in range(d) if u != v))
        if np.all(size <= FINE_SIGMAS * sigma):
            return [
                (score, start + cell * size) for score, cell, _ in _crowded(votes, count, None, PEAK_SHARE, PEAK_CELLS)
            ]
        tree = cKDTree(one / size)
        sample = two[np.linspace(0, len(two) - 1, min(VOTE_SAMPLE, len(two))).astype(np.int64)]
        result: list[Peak] = []
        for _, cell, chance_votes in _crowded(votes, COARSE_PEAKS, None, 0.0, 1):
            centre = start + cell * size
            near = tree.query_ball_point((sample + centre) / size, 1.5, p=np.inf, return_sorted=False)
            at = np.repeat(np.arange(len(sample)), [len(rows) for rows in near])
            rows = np.array([row for rows in near for row in rows], np.int64)
            difference, box = one[rows] - sample[at], (centre - 1.5 * size, centre + 1.5 * size)
            density = chance_votes / float(size.prod()) * len(sample) / len(two)
            origin = np.zeros((1, d))
            result += Charts(difference, origin, np.full(d, np.inf), sigma).peaks(
                box, max(1, count // COARSE_PEAKS), density
            )
        result.sort(key=lambda entry: -entry[0])
        return result[:count]


def _coarser(extent_sigmas: FloatArray, most: float) -> float:
    """Size of a cell in standard deviations, at least 1, with which there are at most about ``most`` cells."""
    cells_needed = float(np.prod(np.maximum(extent_sigmas, 1.0)))
    return max(1.0, float((cells_needed / most) ** (1.0 / len(extent_sigmas))))


def _crowded(
    votes: FloatArray, count: int, chance: float | None, share: float, apart_cells: int
) -> list[tuple[float, FloatArray, float]]:
    """The blocks of 3 cells a side with the largest excess over chance: score, middle cell, chance votes of a cell.

    chance : chance votes of a cell; estimated from the surroundings if not given. share : least score of a block,
    relative to the best. apart_cells : blocks within this many cells of a better one belong to its peak. The score is
    the log likelihood ratio of a Poisson count. The outermost cells have no votes.
    """
    from sameas.kernels.offsets import blocks

    flat = votes.ravel()
    block, filled = 3.0**votes.ndim, np.flatnonzero(flat > 0.5)
    stride = [math.prod(votes.shape[axis + 1 :]) for axis in range(votes.ndim)]
    near = np.array([np.dot(step, stride) for step in product((-1, 0, 1), repeat=votes.ndim)], np.int64)
    counts = blocks(flat, filled, near)
    most = min(12 * count, len(counts))
    top = np.argpartition(counts, len(counts) - most)[len(counts) - most :] if most else filled
    cell = np.stack(np.unravel_index(filled[top], votes.shape), axis=1)
    chance_votes = _surroundings(votes, cell) if chance is None else np.full(len(top), chance)
    expected, counted = chance_votes * block, counts[top]
    score = np.where(counted > expected, counted * np.log(counted / expected) - (counted - expected), 0.0)
    peaks: list[tuple[float, FloatArray, float]] = []
    taken = np.empty((0, votes.ndim))
    for k in np.lexsort((filled[top], -score)):
        if len(peaks) == count or score[k] <= 0.0 or (peaks and score[k] < share * peaks[0][0]):
            break
        if not (np.abs(taken - cell[k]) <= apart_cells).all(axis=1).any():
            peaks.append((float(score[k]), cell[k].astype(np.float64), float(chance_votes[k])))
            taken = np.vstack([taken, cell[k]])
    return peaks


def _surroundings(votes: FloatArray, cell: IntArray) -> FloatArray:
    """Mean count of a cell around each cell (k, d): over blocks of a tenth of the field and their neighbours."""
    from scipy import ndimage

    side = [max(1, -(-length // 10)) for length in votes.shape]
    # Empty surroundings do not mean that chance votes are impossible.
    least = max(0.05 * votes.mean(), 1e-6)
    if np.prod([min(3 * s, length) for s, length in zip(side, votes.shape, strict=True)]) < 20.0 * 3.0**votes.ndim:
        return np.full(len(cell), max(float(votes.mean()), least))
    blocks, filled = votes, np.ones(())
    for axis, step in enumerate(side):
        edges = np.arange(0, votes.shape[axis], step)
        blocks = np.add.reduceat(blocks, edges, axis=axis)
        filled = filled[..., None] * np.diff(np.append(edges, votes.shape[axis])).astype(np.float64)
    smooth = ndimage.uniform_filter(blocks, 3, mode="constant") / ndimage.uniform_filter(filled, 3, mode="constant")
    at = tuple(cell[:, axis] // side[axis] for axis in range(votes.ndim))
    return np.asarray(np.maximum(smooth[at], least))


def _density(at: FloatArray, cells: IntArray) -> FloatArray:
    """Number of records in each cell."""
    flat = np.ravel_multi_index(tuple(at.astype(np.int64).T), tuple(cells))
    return np.bincount(flat, minlength=int(cells.prod())).reshape(tuple(cells)).astype(np.float64)
