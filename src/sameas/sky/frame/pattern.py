"""Patterns of three or four points, described so that shift, rotation and scale do not matter.

The two points A, B farthest apart are put at 0 and 1 of the complex plane; where the others then lie is the pattern's
*code* (Lang et al. 2010, AJ 139, 1782, section 2.1; there the others lie within the circle on A, B, here anywhere
nearer to both than they are to each other, so that every set of points has exactly one code). A mirrored pattern has
the conjugate code. :class:`PatternIndex` holds the patterns of a catalogue, :meth:`PatternIndex.alike` finds those
that look like the frame's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.ragged import Ragged, ranges
from sameas.sky.frame.tangent import to_plane


@dataclass(frozen=True)
class Patterns:
    """Sets of k points each: ``members`` (p, k) their rows, A and B first; ``code`` (p, 2(k−2)); ``size`` (p,) |AB|."""

    members: IntArray
    code: FloatArray
    size: FloatArray

    def __len__(self) -> int:
        return len(self.members)


def patterns(points: FloatArray, k: int, shortest: float = 0.0, longest: float = np.inf) -> Patterns:
    """All patterns of k = 3 or 4 of the points whose longest side is between two lengths.

    ``points`` (n, 2) in a plane or (n, 3) unit vectors of directions; a length on the sphere is a chord.
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
    """The order of the k points of each pattern (p, k, 2) and its code (p, 2(k−2)), the first two being A and B.

    The code itself decides which of the two is A, and the order of the others: the sum of their real parts is smaller
    with this A, and they are in ascending order of their real parts.
    """
    points = corner[..., 0] + 1j * corner[..., 1]
    rest = (points[:, 2:] - points[:, :1]) / (points[:, 1:2] - points[:, :1])
    k = points.shape[1]
    swapped = rest.real.sum(axis=1) > 0.5 * (k - 2)
    rest[swapped] = 1.0 - rest[swapped]
    ends = np.where(swapped[:, None], [1, 0], [0, 1])
    sequence = np.argsort(rest.real, axis=1, kind="stable")
    rest = np.take_along_axis(rest, sequence, axis=1)
    return np.hstack([ends, sequence + 2]), rest.view(np.float64).reshape(len(rest), 2 * (k - 2))


def mirrored(code: FloatArray) -> FloatArray:
    """The codes of the mirror images of patterns."""
    return np.asarray(code * np.tile([1.0, -1.0], code.shape[1] // 2))


def sets_of_points(points: FloatArray, k: int, shortest: float, longest: float) -> IntArray:
    """(p, k) rows of all sets of k = 3 or 4 points, the two farthest apart first, within two lengths of each other."""
    from scipy.spatial import cKDTree

    span = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
    pairs = cKDTree(points).query_pairs(min(longest, span * 1.001 + 1e-300), output_type="ndarray").astype(np.int64)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    if not len(pairs):
        return np.empty((0, k), np.int64)
    start, neighbour = _neighbours(pairs, len(points))
    apart = _distance(points, pairs[:, 0], pairs[:, 1])
    keep = apart >= shortest
    pairs, apart = pairs[keep], apart[keep]
    a, b = pairs.T
    pair, at = ranges(start[a], start[a + 1] - start[a])
    third = neighbour[at]
    # Points with equal longest sides make no pattern: those of a perfect grid could not be distinguished.
    inside = (_distance(points, a[pair], third) < apart[pair]) & (_distance(points, b[pair], third) < apart[pair])
    pair, third = pair[inside], third[inside]
    if k == 3:
        return np.column_stack([a[pair], b[pair], third])
    stop = np.searchsorted(pair, pair, side="right")
    own = np.arange(len(pair))
    one, other = ranges(own + 1, stop - own - 1)
    near = _distance(points, third[one], third[other]) < apart[pair[one]]
    one, other = one[near], other[near]
    return np.column_stack([a[pair[one]], b[pair[one]], third[one], third[other]])


def _neighbours(pairs: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Both directions of the pairs as CSR: the neighbours of point i are ``neighbour[start[i]:start[i + 1]]``."""
    here, there = np.concatenate([pairs, pairs[:, ::-1]]).T
    order = np.lexsort((there, here))
    return Ragged.of_sorted(here[order], n).start, there[order]


def _distance(points: FloatArray, i: NDArray[Any], j: NDArray[Any]) -> FloatArray:
    return np.asarray(np.linalg.norm(points[i] - points[j], axis=1))


@dataclass(frozen=True)
class PatternIndex:
    """The patterns of directions on the sky, ready to be searched: ``vectors`` (n, 3), ``rows`` (n,) of the table."""

    vectors: FloatArray
    rows: IntArray
    patterns: Patterns

    @classmethod
    def of(
        cls, vectors: FloatArray, rows: IntArray, *, k: int, shortest_rad: float, longest_rad: float
    ) -> PatternIndex:
        """All patterns of ``rows`` of ``vectors`` with a longest side within the two angles."""
        chosen = vectors[rows]
        chords = 2.0 * np.sin(np.minimum([shortest_rad, longest_rad], np.pi) / 2.0)
        return cls(chosen, rows, patterns(chosen, k, *map(float, chords)))

    @cached_property
    def tree(self) -> Any:
        """Every code, in a k-d tree."""
        from scipy.spatial import cKDTree

        # Codes are distributed evenly enough for sliding midpoints, which build the tree three times as fast (timed).
        return cKDTree(self.patterns.code, compact_nodes=False, balanced_tree=False)

    @cached_property
    def star_tree(self) -> Any:
        """Every direction, in a k-d tree."""
        from scipy.spatial import cKDTree

        return cKDTree(self.vectors)

    def alike(
        self, measured: Patterns, tolerance: float, scale_rad: tuple[float, float]
    ) -> tuple[IntArray, IntArray, BoolArray]:
        """Pairs of patterns that are alike: rows of ``measured`` (pixels), rows of the index, mirrored or not.

        ``tolerance`` is the distance of two codes; ``scale_rad`` the least and largest angle of a pixel.
        """
        from scipy.spatial import cKDTree

        parts = []
        # Seen from inside the sphere x runs west: a frame that is not mirrored has the conjugate code.
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
    """Rows of the n brightest stars of every cell of about ``side_rad`` squared, in the order of brightness.

    ``rank`` (m,): 0 is the brightest. Cells are equal in area: bands of latitude, cut into equal lengths.
    """
    bands = max(1, round(np.pi / side_rad))
    lat = np.arcsin(np.clip(vectors[:, 2], -1.0, 1.0))
    band = np.clip(((lat / np.pi + 0.5) * bands).astype(np.int64), 0, bands - 1)
    edges = np.sin((np.arange(bands + 1) / bands - 0.5) * np.pi)
    per_band = np.maximum(1, np.round(2 * np.pi * np.diff(edges) / side_rad**2)).astype(np.int64)
    around = (np.arctan2(vectors[:, 1], vectors[:, 0]) / (2 * np.pi)) % 1.0
    cell = Ragged.of_sizes(per_band).start[band] + np.minimum(
        (around * per_band[band]).astype(np.int64), per_band[band] - 1
    )
    order = np.lexsort((rank, cell))
    ordered = cell[order]
    within = np.arange(len(order)) - np.searchsorted(ordered, ordered)
    chosen = order[within < n]
    return chosen[np.argsort(rank[chosen], kind="stable")]
