"""Star patterns: complete, without repetition, invariant under rotation, scale and reflection."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from sameas.sky.frame.pointing import similarities
from sameas.sky.frame.pointing_hints import PatternIndex, brightest_per_cell, codes, mirrored, patterns
from sameas.space import from_plane, to_plane, unit_vectors


def points(n: int = 11, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1000, (n, 2))


@pytest.mark.parametrize("k", [3, 4])
@pytest.mark.parametrize(("shortest", "longest"), [(0.0, np.inf), (300.0, 700.0)])
def test_every_set_of_points_occurs_once(k: int, shortest: float, longest: float) -> None:
    here = points()
    expected = {}
    for chosen in combinations(range(len(here)), k):
        side = max(np.linalg.norm(here[a] - here[b]) for a, b in combinations(chosen, 2))
        if shortest <= side <= longest:
            expected[chosen] = side
    found = patterns(here, k, shortest, longest)
    assert sorted(tuple(sorted(row)) for row in found.members.tolist()) == sorted(expected)
    for row, size in zip(found.members.tolist(), found.size, strict=True):
        assert size == pytest.approx(expected[tuple(sorted(row))])


@pytest.mark.parametrize("k", [3, 4])
def test_codes_are_invariant(k: int) -> None:
    here, turn = points(), 1.7 * np.exp(2.0j)
    there = turn * (here @ [1.0, 1.0j]) + (30 - 700j)
    flipped = np.conj(there)
    first = patterns(here, k)
    for image, expected in ((there, first.code), (flipped, mirrored(first.code))):
        again = patterns(np.column_stack([image.real, image.imag]), k)
        order = np.lexsort(np.sort(first.members, axis=1).T), np.lexsort(np.sort(again.members, axis=1).T)
        assert np.array_equal(first.members[order[0]], again.members[order[1]])
        assert np.allclose(expected[order[0]], again.code[order[1]], atol=1e-9)
        assert np.allclose(first.size * abs(turn), again.size[order[1]][np.argsort(order[0])])


def test_codes_do_not_depend_on_the_order_of_the_points() -> None:
    corner = points(4, 3)[None]
    # The farthest two points come first; their order and that of the others is fixed by the code.
    far = max(combinations(range(4), 2), key=lambda pair: np.linalg.norm(corner[0, pair[0]] - corner[0, pair[1]]))
    rest = [i for i in range(4) if i not in far]
    all_codes = [codes(corner[:, [*a, *b]])[1] for a in (far, far[::-1]) for b in (rest, rest[::-1])]
    assert np.allclose(all_codes, all_codes[0])


def test_too_few_points_have_no_patterns() -> None:
    for n in (0, 1, 2, 3):
        assert len(patterns(points(n), 4)) == 0
    assert len(patterns(points(3), 3)) == 1


@pytest.mark.parametrize("flip", [False, True])
def test_the_index_finds_the_pattern_and_the_pointing_at_the_pole_too(flip: bool) -> None:
    rng = np.random.default_rng(4)
    centre, scale = unit_vectors(123.0, 89.9), 1e-5
    px = rng.uniform(0, 1000, (6, 2))
    hand = 1.0 if flip else -1.0
    plane = scale * np.column_stack([hand * (px[:, 0] - 500), px[:, 1] - 500])
    vectors = from_plane(plane, centre)
    index = PatternIndex.of(vectors, np.arange(6), k=4, shortest_rad=0.0, longest_rad=1.0)
    seen = patterns(px, 4)
    i, j, flipped = index.similar(seen, 0.002, (0.8 * scale, 1.2 * scale))
    right = np.all(seen.members[i] == index.patterns.members[j], axis=1) & (flipped == flip)
    assert right.sum() == len(seen) == 15
    at, cd = similarities(
        px[seen.members[i]][right], vectors[index.patterns.members[j]][right], flipped[right], np.array([500.0, 500.0])
    )
    assert np.abs(to_plane(at, centre)).max() < 1e-7
    assert np.allclose(np.linalg.det(cd), hand * scale**2, rtol=1e-3)
    assert not len(index.similar(seen, 0.002, (2 * scale, 3 * scale))[0])


def test_the_brightest_stars_of_every_cell_cover_the_sky() -> None:
    rng = np.random.default_rng(5)
    vectors = rng.normal(size=(40_000, 3))
    vectors[:20_000] = np.abs(vectors[:20_000])  # one octant holds half of the stars
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    rank = rng.permutation(40_000)
    rows = brightest_per_cell(vectors, rank, np.radians(10.0), 3)
    octant = np.all(vectors[rows] > 0, axis=1).mean()
    assert np.all(np.diff(rank[rows]) > 0) and 0.1 < octant < 0.15
    assert len(rows) == pytest.approx(3 * 4 * np.pi / np.radians(10.0) ** 2, rel=0.03)
    # The brightest star of all is always selected.
    assert rank[rows[0]] == 0
