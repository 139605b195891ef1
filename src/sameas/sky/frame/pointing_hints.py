"""Hints on the pointing of a frame, and the candidate pointings under each hint.

A hint defines the searched volume (:class:`~sameas.sky.frame.odds.SearchVolume`, which lowers the odds), the allowed
placements, and the candidate pointings, in lists, the cheapest and most probable first.

Candidates come from patterns of three or four points, described independently of shift, rotation and scale: the two
points A, B farthest apart are mapped to 0 and 1 of the complex plane; the positions of the others are the pattern's
*code* (Lang et al. 2010, AJ 139, 1782, section 2.1; there the others lie within the circle on A, B, here anywhere
closer to A and B than these to each other, so that every set of points has exactly one code). A mirrored pattern has
the conjugate code. :class:`PatternIndex` contains the patterns of a catalogue, :meth:`PatternIndex.similar` finds those
similar to the frame's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.ragged import Ragged, ranges
from sameas.representation import in_short
from sameas.sky.frame.odds import PlateProblem, SearchVolume
from sameas.sky.frame.pointing import Pointing, similarities
from sameas.space import ARCSEC_PER_RADIAN, chord_angle_deg, from_plane, to_plane, unit_vectors

if TYPE_CHECKING:
    from astropy.wcs import WCS
    from scipy.spatial import cKDTree

    from sameas.sky.frame.field import Stars


@dataclass(frozen=True)
class Patterns:
    """Sets of k points. members : (p, k) rows, A and B first. code : (p, 2(k−2)). size : (p,) |AB|."""

    members: IntArray
    code: FloatArray
    size: FloatArray

    def __len__(self) -> int:
        return len(self.members)


def patterns(points: FloatArray, k: int, shortest: float = 0.0, longest: float = np.inf) -> Patterns:
    """All patterns of k = 3 or 4 points with a longest side between two lengths.

    points : (n, 2) in a plane or (n, 3) unit vectors; lengths on the sphere are chords.
    """
    members = sets_of_points(points, k, shortest, longest)
    corner = points[members]
    size = np.linalg.norm(corner[:, 0] - corner[:, 1], axis=1)
    if points.shape[1] == 3:
        middle = corner.sum(axis=1, keepdims=True)
        corner = to_plane(corner, middle / np.linalg.norm(middle, axis=-1, keepdims=True))
    order, code = codes(corner)
    return Patterns(np.take_along_axis(members, order, axis=1), code, size)


def codes(corner: FloatArray) -> tuple[IntArray, FloatArray]:
    """The order of the k points of each pattern (p, k, 2), and its code (p, 2(k−2)); the first two points are A and B.

    A is the one of the two with the smaller sum of the real parts of the others, which are in ascending order of their
    real parts.
    """
    points = corner[..., 0] + 1j * corner[..., 1]
    others = (points[:, 2:] - points[:, :1]) / (points[:, 1:2] - points[:, :1])
    k = points.shape[1]
    swapped = others.real.sum(axis=1) > 0.5 * (k - 2)
    others[swapped] = 1.0 - others[swapped]
    ends = np.where(swapped[:, None], [1, 0], [0, 1])
    sequence = np.argsort(others.real, axis=1, kind="stable")
    others = np.take_along_axis(others, sequence, axis=1)
    return np.hstack([ends, sequence + 2]), others.view(np.float64).reshape(len(others), 2 * (k - 2))


def mirrored(code: FloatArray) -> FloatArray:
    """The codes of the mirror images of patterns."""
    return np.asarray(code * np.tile([1.0, -1.0], code.shape[1] // 2))


def sets_of_points(points: FloatArray, k: int, shortest: float, longest: float) -> IntArray:
    """(p, k) rows of all sets of k = 3 or 4 points with a longest side between two lengths, its two ends first."""
    from scipy.spatial import cKDTree

    span = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
    pairs = cKDTree(points).query_pairs(min(longest, span * 1.001 + 1e-300), output_type="ndarray").astype(np.int64)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    if not len(pairs):
        return np.empty((0, k), np.int64)
    start, neighbour = _neighbours(pairs, len(points))
    length = _distance(points, pairs[:, 0], pairs[:, 1])
    keep = length >= shortest
    pairs, length = pairs[keep], length[keep]
    a, b = pairs.T
    pair, at = ranges(start[a], start[a + 1] - start[a])
    third = neighbour[at]
    # Sets with two equal longest sides are excluded: those of a perfect grid cannot be distinguished.
    inside = (_distance(points, a[pair], third) < length[pair]) & (_distance(points, b[pair], third) < length[pair])
    pair, third = pair[inside], third[inside]
    if k == 3:
        return np.column_stack([a[pair], b[pair], third])
    stop = np.searchsorted(pair, pair, side="right")
    row = np.arange(len(pair))
    one, other = ranges(row + 1, stop - row - 1)
    near = _distance(points, third[one], third[other]) < length[pair[one]]
    one, other = one[near], other[near]
    return np.column_stack([a[pair[one]], b[pair[one]], third[one], third[other]])


def _neighbours(pairs: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Both directions of the pairs as CSR: the neighbours of point i are ``neighbour[start[i]:start[i + 1]]``."""
    point, neighbour = np.concatenate([pairs, pairs[:, ::-1]]).T
    order = np.lexsort((neighbour, point))
    return Ragged.of_sorted(point[order], n).start, neighbour[order]


def _distance(points: FloatArray, i: NDArray[Any], j: NDArray[Any]) -> FloatArray:
    return np.asarray(np.linalg.norm(points[i] - points[j], axis=1))


@dataclass(frozen=True)
class PatternIndex:
    """A searchable index of patterns on the sky. vectors : (n, 3) directions. rows : (n,) rows of the table."""

    vectors: FloatArray
    rows: IntArray
    patterns: Patterns

    @classmethod
    def of(
        cls, vectors: FloatArray, rows: IntArray, *, k: int, shortest_rad: float, longest_rad: float
    ) -> PatternIndex:
        """The index of all patterns of ``rows`` of ``vectors`` with a longest side between the two angles."""
        chosen = vectors[rows]
        chords = 2.0 * np.sin(np.minimum([shortest_rad, longest_rad], np.pi) / 2.0)
        return cls(chosen, rows, patterns(chosen, k, *map(float, chords)))

    @cached_property
    def tree(self) -> cKDTree:
        """The k-d tree of all codes."""
        from scipy.spatial import cKDTree

        # Codes are uniform enough for sliding midpoints, which build the tree three times as fast (timed).
        return cKDTree(self.patterns.code, compact_nodes=False, balanced_tree=False)

    @cached_property
    def star_tree(self) -> cKDTree:
        """The k-d tree of all directions."""
        from scipy.spatial import cKDTree

        return cKDTree(self.vectors)

    def similar(
        self, measured: Patterns, tolerance: float, scale_rad: tuple[float, float]
    ) -> tuple[IntArray, IntArray, BoolArray]:
        """Pairs of similar patterns: rows of ``measured`` (pixels), rows of the index, mirrored or not.

        tolerance : maximum distance of the codes. scale_rad : (least, largest) angle of a pixel.
        """
        from scipy.spatial import cKDTree

        parts = []
        # Seen from inside the sphere x points west: a frame that is not mirrored has the conjugate code.
        for flipped in (False, True):
            code = measured.code if flipped else mirrored(measured.code)
            if not len(code) or not len(self.patterns):
                continue
            near = cKDTree(code).sparse_distance_matrix(self.tree, tolerance, output_type="ndarray")
            i, j = near["i"].astype(np.int64), near["j"].astype(np.int64)
            scale = self.patterns.size[j] / measured.size[i]
            fits = (scale >= 0.98 * scale_rad[0]) & (scale <= 1.02 * scale_rad[1])
            parts.append((i[fits], j[fits], np.full(int(fits.sum()), flipped)))
        if not parts:
            return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, bool)
        i, j, flip = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.lexsort((flip, j, i))
        return i[order], j[order], flip[order]


def brightest_per_cell(vectors: FloatArray, rank: IntArray, side_rad: float, n: int) -> IntArray:
    """Rows of the n brightest stars of each cell of about ``side_rad`` squared, in order of brightness.

    rank : (m,), 0 is the brightest. Cells have equal areas: bands of latitude, divided into equal lengths.
    """
    bands = max(1, round(np.pi / side_rad))
    lat = np.arcsin(np.clip(vectors[:, 2], -1.0, 1.0))
    band = np.clip(((lat / np.pi + 0.5) * bands).astype(np.int64), 0, bands - 1)
    edges = np.sin((np.arange(bands + 1) / bands - 0.5) * np.pi)
    per_band = np.maximum(1, np.round(2 * np.pi * np.diff(edges) / side_rad**2)).astype(np.int64)
    longitude = (np.arctan2(vectors[:, 1], vectors[:, 0]) / (2 * np.pi)) % 1.0
    cell = Ragged.of_sizes(per_band).start[band] + np.minimum(
        (longitude * per_band[band]).astype(np.int64), per_band[band] - 1
    )
    order = np.lexsort((rank, cell))
    ordered = cell[order]
    within = np.arange(len(order)) - np.searchsorted(ordered, ordered)
    chosen = order[within < n]
    return chosen[np.argsort(rank[chosen], kind="stable")]


# Numbers of the search for a pointing, tuned on simulated frames.

CODE_TOLERANCE = 0.02  # maximum distance of two codes of similar patterns: 1.5 % of the longest side per coordinate
#: (least, largest) longest side of a pattern over the side of the field: in the index of the whole sky, and around an
#: aim with few or many stars per field.
SIDES_ALL_SKY, SIDES_FEW, SIDES_MANY = (0.2, 0.6), (0.15, 1.3), (0.2, 0.7)
MANY_STARS = 20  # stars per field above which it has many: no longest patterns, no triangles of faint stars
STARS_PER_FIELD = 14  # bright stars per field in the index of the whole sky
MEASURED = (12, 20, 30)  # numbers of brightest measurements tried with the index, in this order
BATCH = 20_000  # pairs of patterns counted at a time, which bounds the memory
BEST, VERIFIED = 500, 20  # maximum number of pointings per list, and of different ones that are verified

AimLists = tuple[tuple[int, int, int], ...]
#: Tried around an aim, in this order: points per pattern, bright stars per field, brightest measurements.
AIM_LISTS: AimLists = ((4, 16, 16), (4, 16, 30), (3, 16, 25), (4, 32, 32), (3, 32, 36))
#: Only the first list around an aim: a second, where all may take half a minute; and those after it, of which the next
#: has all its patterns, so that a search in two steps misses none.
BRIGHTEST_PATTERNS = AIM_LISTS[:1]
FURTHER_PATTERNS = AIM_LISTS[1:]


@in_short
@dataclass(frozen=True)
class ApproximateWcs:
    """An approximate plate solution.

    Parameters
    ----------
    wcs : any celestial astropy WCS, distorted or not.
    radius_deg : maximum offset; a quarter of the frame's shorter side if not given.
    max_rotation_deg : maximum rotation, of either sign. scale_tolerance : maximum relative error of the scale.
    """

    wcs: WCS
    radius_deg: float | None = None
    max_rotation_deg: float = 2.0
    scale_tolerance: float = 0.02

    words = "the header's plate solution"

    def __post_init__(self) -> None:
        if not getattr(self.wcs, "has_celestial", False):
            raise InputError("ApproximateWcs: the WCS has no celestial axes; give an Aim instead")
        if not (self.radius_deg is None or self.radius_deg > 0) or not 0 < self.max_rotation_deg <= 180:
            raise InputError("ApproximateWcs: radius_deg must be positive, and max_rotation_deg within 0 … 180")
        if not 0 < self.scale_tolerance < 0.5:
            raise InputError(f"ApproximateWcs: scale_tolerance is {self.scale_tolerance}; give a share such as 0.02")

    def radius_px(self, pointing: Pointing, problem: PlateProblem) -> float:
        """The maximum offset, px."""
        if self.radius_deg is None:
            return 0.25 * min(problem.shape)
        return self.radius_deg * 3600.0 / pointing.scale_arcsec

    def search_volume(self, problem: PlateProblem) -> SearchVolume:
        """The volume that is searched."""
        pointing = Pointing.of_wcs(self.wcs, problem.shape)
        side = 2 * self.radius_px(pointing, problem) * pointing.scale_arcsec / ARCSEC_PER_RADIAN
        return SearchVolume(side**2, 2 * math.radians(self.max_rotation_deg), 2 * self.scale_tolerance, 1)

    def allows(self, pointing: Pointing, problem: PlateProblem) -> bool:
        """Whether a placement agrees with the hint."""
        header = Pointing.of_wcs(self.wcs, problem.shape)
        offset = header.to_px(pointing.to_sky(problem.middle_px[None]))[0] - problem.middle_px
        ratio = math.log(pointing.scale_arcsec / header.scale_arcsec)
        near = bool(np.hypot(*offset) <= 1.5 * self.radius_px(header, problem))
        return near and abs(ratio) <= 1.5 * self.scale_tolerance and pointing.parity == header.parity


@dataclass(frozen=True)
class Aim:
    """An approximate direction, its maximum distance from the frame's middle, and (least, largest) arcsec per pixel."""

    ra_deg: float
    dec_deg: float
    radius_deg: float
    scale_arcsec: tuple[float, float]

    words = "the aim"

    def __post_init__(self) -> None:
        _check_scales("Aim", self.scale_arcsec)
        if not (math.isfinite(self.ra_deg) and -90 <= self.dec_deg <= 90 and 0 < self.radius_deg <= 180):
            raise InputError(
                f"Aim: ({self.ra_deg}, {self.dec_deg}) within {self.radius_deg}; give degrees, and a radius above 0"
            )

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector."""
        return unit_vectors(self.ra_deg, self.dec_deg)

    def search_volume(self, problem: PlateProblem) -> SearchVolume:
        """The volume that is searched."""
        area = 4 * math.pi * math.sin(math.radians(self.radius_deg) / 2) ** 2
        return SearchVolume(area, 2 * math.pi, _log_range(self.scale_arcsec), 2)

    def allows(self, pointing: Pointing, problem: PlateProblem) -> bool:
        """Whether a placement agrees with the hint."""
        middle = pointing.to_sky(problem.middle_px[None])[0]
        off_deg = chord_angle_deg(float(np.linalg.norm(middle - self.direction)))
        return off_deg <= 1.05 * self.radius_deg and _within(self.scale_arcsec, pointing)


@dataclass(frozen=True)
class AllSky:
    """No direction: only the (least, largest) scale in arcsec per pixel."""

    scale_arcsec: tuple[float, float]

    words = "a search of the whole sky"

    def __post_init__(self) -> None:
        _check_scales("AllSky", self.scale_arcsec)

    def search_volume(self, problem: PlateProblem) -> SearchVolume:
        """The volume that is searched."""
        return SearchVolume(4 * math.pi, 2 * math.pi, _log_range(self.scale_arcsec), 2)

    def allows(self, pointing: Pointing, problem: PlateProblem) -> bool:
        """Whether a placement agrees with the hint."""
        return _within(self.scale_arcsec, pointing)


Hint = ApproximateWcs | Aim | AllSky


def _check_scales(name: str, scales: tuple[float, float]) -> None:
    if not (len(scales) == 2 and 0 < scales[0] <= scales[1] < 7200):
        raise InputError(f"{name}: scale_arcsec is {scales}; give (least, largest) in arcsec per pixel")


def _log_range(scales: tuple[float, float]) -> float:
    # An exact scale is searched within one percent.
    return max(math.log(scales[1] / scales[0]), 0.01)


def _within(scales: tuple[float, float], pointing: Pointing) -> bool:
    return 0.99 * scales[0] <= pointing.scale_arcsec <= 1.01 * scales[1]


@dataclass(frozen=True)
class SkyIndex:
    """Patterns of bright stars of the whole sky, one :class:`PatternIndex` per size of field; reusable."""

    levels: tuple[PatternIndex, ...]


def sky_index(stars: Stars, shape: tuple[int, int], hint: AllSky) -> SkyIndex:
    """The index of a catalogue of the whole sky, for frames of ``shape`` (rows, columns) and the scales of the hint.

    Raises InputError: the catalogue has too few stars for fields of this size.
    """
    order = stars.order()
    vectors = unit_vectors(np.asarray(stars.ra_deg)[order], np.asarray(stars.dec_deg)[order])
    return _index_of(vectors, shape, hint)


def _index_of(vectors: FloatArray, shape: tuple[int, int], hint: AllSky) -> SkyIndex:
    least, most = (side / ARCSEC_PER_RADIAN * math.sqrt(shape[0] * shape[1]) for side in hint.scale_arcsec)
    per_field = len(vectors) * least**2 / (4 * math.pi)
    if per_field < 4:
        raise InputError(
            f"a field of {math.degrees(least):.2g}° holds {per_field:.2g} stars of the catalogue; a search of the "
            "whole sky needs a deeper catalogue or a wider field; give an aim"
        )
    _refuse_round(least)
    steps = max(1, math.ceil(math.log(most / least) / math.log(math.sqrt(2.0)) - 0.3))
    fields = least * math.sqrt(2.0) ** np.arange(steps)
    return SkyIndex(tuple(_level(vectors, float(side), STARS_PER_FIELD, 4, SIDES_ALL_SKY) for side in fields))


def _refuse_round(side_rad: float) -> None:
    if side_rad > math.radians(60):
        raise InputError(
            f"a field of {math.degrees(side_rad):.0f}° is not flat; cut a part of less than 60° out of the frame"
        )


def _level(vectors: FloatArray, side_rad: float, per_field: int, k: int, sides: tuple[float, float]) -> PatternIndex:
    """The patterns of k among the ``per_field`` brightest stars of each field of a given side."""
    rank = np.arange(len(vectors))
    rows = brightest_per_cell(vectors, rank, side_rad / 2.0, max(1, round(per_field / 4)))
    return PatternIndex.of(vectors, rows, k=k, shortest_rad=sides[0] * side_rad, longest_rad=sides[1] * side_rad)


def candidates(
    problem: PlateProblem, hint: Hint, index: SkyIndex | None, aim_lists: AimLists = AIM_LISTS
) -> Iterator[Iterator[Pointing]]:
    """Lists of candidate pointings, the most promising of each first."""
    if isinstance(hint, ApproximateWcs):
        yield _correlated(problem, hint)
        return
    scale = (hint.scale_arcsec[0] / ARCSEC_PER_RADIAN, hint.scale_arcsec[1] / ARCSEC_PER_RADIAN)
    if isinstance(hint, AllSky):
        index = index or _index_of(problem.vectors, problem.shape, hint)
        for n in MEASURED:
            if n == MEASURED[0] or n // 2 < len(problem.px):
                yield _alike(problem, index.levels, n, 4, scale)
        return
    yield from _about_aim(problem, hint, scale, aim_lists)


def _about_aim(
    problem: PlateProblem, aim: Aim, scale: tuple[float, float], aim_lists: AimLists
) -> Iterator[Iterator[Pointing]]:
    _refuse_round(scale[0] * math.sqrt(problem.shape[0] * problem.shape[1]))
    reach = math.radians(aim.radius_deg) + problem.half_diagonal_px * scale[1]
    cone = problem.vectors[problem.stars_near(aim.direction, reach)]
    if len(cone) < 3:
        raise InputError(
            f"the catalogue has {len(cone)} stars within {math.degrees(reach):.2g}° of the aim; give one that covers it"
        )
    side = math.sqrt(problem.shape[0] * problem.shape[1] * scale[0] * scale[1])
    many = len(cone) * side**2 / (4 * math.pi * math.sin(reach / 2) ** 2) > MANY_STARS
    done: set[tuple[int, int, int]] = set()
    levels: dict[tuple[int, int], PatternIndex] = {}  # the costly part of a list
    for k, per_field, n in aim_lists:
        if many and k == 3 and per_field > aim_lists[0][1]:
            continue
        if (k, per_field) not in levels:
            levels[k, per_field] = _level(cone, side, per_field, k, SIDES_MANY if many else SIDES_FEW)
        level = levels[k, per_field]
        # With few stars or measurements later lists are the same as earlier ones.
        key = (k, len(level.vectors), min(n, len(problem.px)))
        if key not in done and len(level.patterns):
            done.add(key)
            yield _alike(problem, (level,), n, k, scale)


def _alike(
    problem: PlateProblem, levels: tuple[PatternIndex, ...], n: int, k: int, scale: tuple[float, float]
) -> Iterator[Pointing]:
    """Pointings that map a pattern of the n brightest measurements to one of stars, by descending number of matches."""
    # Small patterns determine neither the rotation nor the scale of the frame.
    measured = patterns(problem.px[:n], k, 0.1 * min(problem.shape))
    hits, centres, matrices = [], [], []
    for level in levels:
        i, j, flipped = level.similar(measured, CODE_TOLERANCE * math.sqrt(k - 2) / math.sqrt(2.0), scale)
        for start in range(0, len(i), BATCH):
            part = slice(start, start + BATCH)
            count, centre, cd = _match_counts(problem, level, measured, i[part], j[part], flipped[part], n)
            top = np.argsort(-count, kind="stable")[:BEST]
            top = top[count[top] >= k]
            hits.append(count[top])
            centres.append(centre[top])
            matrices.append(cd[top])
    if not hits:
        return
    count, centre, cd = np.concatenate(hits), np.concatenate(centres), np.concatenate(matrices)
    for row in np.argsort(-count, kind="stable")[:BEST]:
        yield Pointing(centre[row], cd[row], problem.middle_px)


def _match_counts(
    problem: PlateProblem, level: PatternIndex, measured: Patterns, i: IntArray, j: IntArray, flipped: BoolArray, n: int
) -> tuple[IntArray, FloatArray, FloatArray]:
    """For each pair of patterns, the number of the max(n, 20) brightest measurements on a star, and the pointing."""
    px = problem.px[measured.members[i]]
    centre, cd = similarities(px, level.vectors[level.patterns.members[j]], flipped, problem.middle_px)
    offset = problem.px[: max(n, 20)] - problem.middle_px
    plane = np.einsum("nb,cab->cna", offset, cd)
    directions = from_plane(plane, centre[:, None, :])
    near = 0.01 * problem.half_diagonal_px * np.sqrt(np.abs(np.linalg.det(cd)))
    distance, star = level.star_tree.query(directions, distance_upper_bound=float(near.max(initial=0.0)), workers=2)
    hit = distance <= near[:, None]
    # Each star counts once, even with several measurements near it.
    star = np.sort(np.where(hit, star, len(level.vectors)), axis=1)
    first = (star < len(level.vectors)) & np.diff(star, axis=1, prepend=-1).astype(bool)
    return first.sum(axis=1), centre, cd


def _correlated(problem: PlateProblem, header: ApproximateWcs) -> Iterator[Pointing]:
    """Pointings near the header's, rotated and shifted to maximise the number of measurements on stars."""
    header_pointing = Pointing.of_wcs(header.wcs, problem.shape)
    radius, middle = header.radius_px(header_pointing, problem), problem.middle_px
    bin_px = max(4.0, 0.004 * problem.half_diagonal_px)
    reach = (problem.half_diagonal_px + radius) * header_pointing.scale_arcsec / ARCSEC_PER_RADIAN
    stars = problem.vectors[problem.stars_near(header_pointing.to_sky(middle[None])[0], reach)]
    predicted = header_pointing.to_px(stars)
    predicted = predicted[problem.inside(predicted, radius)] - header_pointing.origin_px
    steps = math.ceil(math.radians(header.max_rotation_deg) * problem.half_diagonal_px / bin_px)
    proposals = []
    for depth in (50, 200):
        measured = problem.px[:depth] - header_pointing.origin_px
        for angle in np.linspace(-1, 1, 2 * steps + 1) * math.radians(header.max_rotation_deg):
            sine, cosine = math.sin(angle), math.cos(angle)
            rotated = predicted[:depth] @ np.array([[cosine, sine], [-sine, cosine]])
            for excess, shift in _peaks(measured, rotated, radius, bin_px):
                proposals.append((excess, header_pointing.moved(np.array([*shift, 0.0, angle, 0.0, 0.0]))))
    yield header_pointing
    for _, pointing in sorted(proposals, key=lambda proposal: -proposal[0]):
        yield pointing


def _peaks(measured: FloatArray, predicted: FloatArray, radius: float, bin_px: float) -> list[tuple[float, FloatArray]]:
    """The two shifts within ``radius`` with most coincidences, each with its excess over chance in σ."""
    from scipy.ndimage import uniform_filter

    if not len(predicted) or not len(measured):
        return []
    shifts = (measured[:, None, :] - predicted[None, :, :]).reshape(-1, 2)
    bins = max(3, math.ceil(2 * radius / bin_px))
    count = np.histogram2d(shifts[:, 0], shifts[:, 1], bins=bins, range=[[-radius, radius]] * 2)[0]
    # Sums over 3 × 3 bins, so that a peak at a bin border is not split.
    count = uniform_filter(count, 3, mode="constant") * 9.0
    expected = max(float(count.mean()), 1e-3)
    peaks = []
    for flat in np.argsort(-count, axis=None, kind="stable")[:2]:
        bin = np.array(np.unravel_index(flat, count.shape))
        peaks.append(
            (float((count.flat[flat] - expected) / math.sqrt(expected)), (bin + 0.5) * 2 * radius / bins - radius)
        )
    return peaks
