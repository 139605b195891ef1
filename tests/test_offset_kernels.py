"""The compiled loops of the registration give the results of the reference implementations in `naive`."""

import numpy as np
import pytest

import naive
from problems import random_covariances
from sameas.kernels import offsets
from sameas.registration.weights import in_cells

SEEDS = range(6)
#: Features, and the period of the first and of the last axis.
SPACES = [(1, None, None), (1, 25.0, 25.0), (2, None, None), (2, 25.0, None), (2, None, 25.0), (3, None, None)]


def periods_of(d, first, last):
    periods = np.full(d, np.inf)
    periods[0] = first or periods[0]
    periods[-1] = last or periods[-1]
    return periods


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("space", SPACES)
def test_near_pairs_under_each_offset(seed, space):
    rng, d, periods = np.random.default_rng(seed), space[0], periods_of(*space)
    n, many, sets = 40, 30, 3
    one, two = rng.uniform(0.0, 25.0, (n, d)), rng.uniform(-10.0, 40.0, (sets, many, d))
    error_1, error_2 = random_covariances(rng, n, d), random_covariances(rng, sets, many, d)
    cells = in_cells(one, error_1, 6.0 * rng.uniform(0.2, 1.0), periods)
    start, i, j, residual, precision, log_normal = offsets.near_pairs(cells, two, error_2, periods, 3.0, 1.5)
    for s in range(sets):
        here = slice(start[s], start[s + 1])
        expected = naive.near_pairs((one, error_1), (two[s], error_2[s]), periods, 3.0, 1.5)
        assert set(zip(i[here], j[here], strict=True)) == set(expected) and len(i[here]) == len(expected)
        for e in range(start[s], start[s + 1]):
            delta, covariance = expected[i[e], j[e]]
            assert residual[e] == pytest.approx(delta)
            assert precision[e] == pytest.approx(np.linalg.inv(covariance))
            assert log_normal[e] == pytest.approx(naive.log_normal(delta, covariance))


def test_the_arrays_of_near_pairs_grow_when_full():
    crowd, error = np.zeros((60, 2)), np.broadcast_to(np.eye(2), (60, 2, 2)).copy()
    cells = in_cells(crowd, error, 6.0, np.full(2, np.inf))
    start, i, j, *_ = offsets.near_pairs(cells, crowd[None], error[None], np.full(2, np.inf), 3.0, 1.0)
    assert start[-1] == 3600 and len(set(zip(i, j, strict=True))) == 3600


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("space", SPACES)
def test_common_field_of_two_sources(seed, space):
    rng, d, periods = np.random.default_rng(seed), space[0], periods_of(*space)
    one, two = rng.uniform(0.0, 25.0, (20, d)), rng.uniform(-10.0, 20.0, (4, 15, d))
    two[3] += 100.0  # no common field
    box = np.stack([one.min(axis=0) - 1.0, one.max(axis=0) + 1.0])
    volume, whole, inside = offsets.overlap(box, one, two, 0.5, periods)
    for s in range(4):
        expected = naive.overlap(box, one, two[s], 0.5, periods)
        assert (volume[s], *whole[s], *inside[s]) == pytest.approx((expected[0], *expected[1], *expected[2]))


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("seed", SEEDS)
def test_belief_propagation_of_sparse_pairs_converges_to_that_of_the_full_matrix(seed):
    rng = np.random.default_rng(seed)
    sets, n1, n2 = 3, 9, 7
    weight = np.exp(rng.normal(0.0, 2.5, (sets, n1, n2))) * (rng.uniform(size=(sets, n1, n2)) < 0.25)
    s, j, i = np.nonzero(np.swapaxes(weight, 1, 2))
    start = np.searchsorted(s, np.arange(sets + 1))
    share, log_sum, common = offsets.messages(start, i, j, np.log(weight[s, i, j]), (n1, n2), 2000, 1e-13)
    for k in range(sets):
        expected, total = naive.belief_propagation(weight[k], 2000)
        here = slice(start[k], start[k + 1])
        assert share[here] == pytest.approx(expected[i[here], j[here]], rel=1e-6)
        assert (log_sum[k], common[k]) == pytest.approx((total, expected.sum()), rel=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_belief_propagation_on_trees_is_exact(seed):
    rng = np.random.default_rng(seed)
    # A star, a chain and records without candidates.
    edges = [(0, 0), (0, 1), (0, 2), (1, 3), (2, 3), (2, 4), (3, 5)]
    i, j = np.array(sorted(edges, key=lambda edge: edge[1])).T
    log_weight = rng.normal(0.0, 2.0, len(i))
    share, log_sum, _ = offsets.messages(np.array([0, len(i)]), i, j, log_weight, (5, 7), 100, 1e-12)
    ratio = dict(zip(zip(i.tolist(), j.tolist(), strict=True), log_weight, strict=True))
    weights = {pairs: np.exp(sum(ratio[pair] for pair in pairs)) for pairs in naive.hypotheses(5, 7, ratio)}
    assert log_sum[0] == pytest.approx(np.log(sum(weights.values())))
    expected = [sum(w for pairs, w in weights.items() if pair in pairs) for pair in ratio]
    assert share == pytest.approx(np.array(expected) / sum(weights.values()))


@pytest.mark.parametrize("seed", SEEDS)
def test_score_and_information_of_an_offset(seed):
    rng = np.random.default_rng(seed)
    sets, many, d, p, m = 3, 6, 2, 4, 50
    s, j = np.sort(rng.integers(0, sets, m)), rng.integers(0, many, m)
    weight, residual, precision = (
        rng.choice([0.0, 1e-7, 0.3, 1.0], m),
        rng.normal(size=(m, d)),
        random_covariances(rng, m, d),
    )
    jacobian = rng.normal(size=(sets, many, d, p))
    score, information = offsets.score_and_information(s, j, residual, precision, weight, jacobian, 1e-6)
    for k in range(sets):
        rows = [e for e in range(m) if s[e] == k and weight[e] > 1e-6]
        of = {e: weight[e] * jacobian[k, j[e]].T @ precision[e] for e in rows}
        assert score[k] == pytest.approx(sum(of[e] @ residual[e] for e in rows))
        assert information[k] == pytest.approx(sum(of[e] @ jacobian[k, j[e]] for e in rows))


def test_covariances_are_propagated():
    rng = np.random.default_rng(1)
    carried, covariance = rng.normal(size=(3, 5, 2, 2)), random_covariances(rng, 5, 2)
    expected = carried @ covariance @ np.swapaxes(carried, -1, -2)
    assert offsets.carried_errors(carried, covariance) == pytest.approx(expected)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("space", SPACES)
def test_differences_are_counted_in_cells_and_blocks(seed, space):
    rng, d, periods = np.random.default_rng(seed), space[0], periods_of(*space)
    one, two = rng.uniform(0.0, 25.0, (12, d)), rng.uniform(-10.0, 20.0, (9, d))
    low, size, cells = rng.uniform(-20.0, -5.0, d), rng.uniform(1.0, 4.0, d), rng.integers(4, 9, d)
    votes = offsets.tally(one, two, periods, low, size, cells)
    expected = naive.count_differences(one, two, periods, low, size, cells)
    assert votes.reshape(tuple(cells)) == pytest.approx(expected)
    middle = rng.integers(1, cells - 1, (20, d))
    stride = np.append(np.cumprod(cells[:0:-1])[::-1], 1)
    around = np.indices((3,) * d).reshape(d, -1).T - 1
    sums = offsets.blocks(votes, middle @ stride, around @ stride)
    assert sums == pytest.approx([sum(expected[tuple(at + step)] for step in around) for at in middle])
