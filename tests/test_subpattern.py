"""GOSPA: hand examples, exhaustive search over assignments, and refusals."""

import itertools

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.score.picture import gospa, nearest_match


def by_definition(found, true, cutoff, order):
    """The metric to the power ``order``, minimised over all one-to-one sets of pairs (definition)."""
    if len(found) > len(true):
        found, true = true, found
    best = np.inf
    for taken in itertools.permutations(range(len(true)), len(found)):
        d = np.linalg.norm(found - true[list(taken)], axis=1)
        best = min(best, float(np.sum(np.minimum(d, cutoff) ** order)))
    return best + cutoff**order / 2 * (len(true) - len(found))


def test_gospa_of_an_example_computed_by_hand():
    # One found 0.6 away, one 3 away from anything with cutoff 2, one true object missed twice over.
    score = gospa([[0.6, 0.0], [10.0, 3.0]], [[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]], cutoff=2.0)
    assert (score.missed, score.false) == (2, 1)
    assert score.localisation == pytest.approx(0.36)
    assert score.distance == pytest.approx(np.sqrt(0.36 + 2.0**2 / 2 * 3))


@pytest.mark.parametrize("order", [1.0, 2.0, 3.5])
def test_gospa_is_the_minimum_over_all_assignments(order):
    rng = np.random.default_rng(1)
    for _ in range(40):
        n, m, d = rng.integers(0, 6), rng.integers(0, 6), rng.integers(1, 4)
        found, true = rng.normal(0, 1.5, (n, d)), rng.normal(0, 1.5, (m, d))
        due = by_definition(found, true, 1.7, order)
        assert gospa(found, true, cutoff=1.7, order=order).distance ** order == pytest.approx(due, abs=1e-9)


def test_empty_sets():
    nothing = np.empty((0, 2))
    assert gospa(nothing, nothing, cutoff=1.0).distance == 0.0
    assert gospa(nothing, [[0.0, 0.0]], cutoff=2.0).distance == pytest.approx(np.sqrt(2.0))
    assert gospa([[0.0, 0.0]], nothing, cutoff=2.0).false == 1


def test_gospa_is_a_metric():
    rng = np.random.default_rng(2)
    for _ in range(30):
        a, b, c = (rng.normal(0, 2, (rng.integers(0, 5), 2)) for _ in range(3))
        one, two, three = (gospa(x, y, cutoff=2.0).distance for x, y in ((a, b), (b, c), (a, c)))
        assert three <= one + two + 1e-9
        assert gospa(b, a, cutoff=2.0).distance == pytest.approx(one, abs=1e-12)
    assert gospa(a, a, cutoff=2.0).distance == 0.0


def test_distant_clusters_are_matched_independently():
    rng = np.random.default_rng(3)
    pictures = [(rng.normal(0, 2, (5, 2)), rng.normal(0, 2, (4, 2))) for _ in range(6)]
    far = np.arange(6)[:, None, None] * np.array([1000.0, 0.0])
    rows, _, distance = nearest_match(
        np.concatenate([p[0] for p in pictures] + far.repeat(5, 1).reshape(6, 5, 2)),
        np.concatenate([p[1] for p in pictures] + far.repeat(4, 1).reshape(6, 4, 2)),
        cutoff=2.0,
    )
    alone = [gospa(found, true, cutoff=2.0).localisation for found, true in pictures]
    np.testing.assert_allclose(np.bincount(rows // 5, distance**2, 6), alone, rtol=1e-9)


@pytest.mark.parametrize(
    "found, true, keywords, words",
    [
        ([[0.0]], [[0.0]], {"cutoff": 0.0}, "cutoff is 0.0, order 2.0; give a positive distance"),
        ([[0.0]], [[0.0]], {"cutoff": 1.0, "order": 0.5}, "an order of 1 or more"),
        ([0.0, 1.0], [[0.0]], {"cutoff": 1.0}, r"shape \(2,\); give \(objects, features\)"),
        ([[0.0, 1.0]], [[0.0]], {"cutoff": 1.0}, "2 features, true ones 1"),
        ([[0.0], [np.nan]], [[0.0]], {"cutoff": 1.0}, r"a found object has no position \(first: row 1\)"),
    ],
)
def test_refusals_say_what_and_where(found, true, keywords, words):
    with pytest.raises(InputError, match=words):
        gospa(found, true, **keywords)
