"""The compiled loops of the estimation give the results of the reference implementations in `naive`."""

from typing import Any

import numpy as np
import pytest

import naive
from sameas.kernels import mixture, relation
from sameas.kernels.compiled import kernel
from sameas.kernels.linear import solve

SEEDS = range(6)
exactly: dict[str, Any] = {"rel": 1e-9, "abs": 1e-9}


@kernel
def compiled_solve(matrix, right):
    """`solve` is compiled only as part of a kernel that calls it."""
    solve(matrix, right)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_few_linear_equations_are_solved(seed):
    rng = np.random.default_rng(seed)
    n, sides = int(rng.integers(1, 9)), int(rng.integers(1, 4))
    matrix, right = rng.normal(size=(n, n)), rng.normal(size=(n, sides))
    matrix[0, 0] = 0.0 if n > 1 else 1.0  # needs pivoting
    found = right.copy()
    compiled_solve(matrix.copy(), found)
    assert found == pytest.approx(np.linalg.solve(matrix, right), **exactly)


# ---- the distribution of the errors ----


def pairs_to_judge(seed, m=400):
    """Squared distances and log odds of m pairs."""
    rng = np.random.default_rng([1, seed])
    return rng.chisquare(2, m) * rng.choice([1.0, 9.0], m), rng.normal(0.0, 12.0, m)


@pytest.mark.parametrize("seed", SEEDS)
def test_log_odds_without_the_error_density(seed):
    rng = np.random.default_rng(seed)
    n, m, p_min, most_p = 30, 200, 1e-3, 1.0 - 1e-12
    i, j = rng.integers(0, n, m).astype(np.int32), rng.integers(0, n, m).astype(np.int32)
    p = rng.choice([0.0, 1e-4, 0.2, 0.999, 1.0], m)
    log_ratio, profile, counted = rng.normal(0.0, 5.0, m), rng.normal(0.0, 2.0, m), rng.uniform(size=n) < 0.8
    partners = rng.choice([0.0, 0.5, 1.0], n), rng.uniform(size=n)
    found = profile.copy()
    mixture.log_odds(i, j, p, log_ratio, *partners, counted, p_min, most_p, found)
    expected = [
        naive.log_odds_without_positions(
            p[e], log_ratio[e], (partners[0][i[e]], partners[1][j[e]]), profile[e], p_min, most_p
        )
        for e in range(m)
    ]
    assert np.all(np.isneginf(found[~counted[i]]))
    assert found[counted[i]] == pytest.approx(np.array(expected)[counted[i]], **exactly)


@pytest.mark.parametrize("seed", SEEDS)
def test_pairs_are_binned_by_distance_and_log_odds(seed):
    square, log_odds = pairs_to_judge(seed)
    limits = -12.0, 30.0, 1e-2, 1.01 * float(np.sqrt(square.max())), (40, 15)
    start, count, odds, squares = mixture.cells(square, log_odds, *limits)
    expected = naive.cells(square, log_odds, *limits)
    assert squares == pytest.approx([mean for mean, _ in expected], **exactly)
    assert np.diff(start).tolist() == [len(row) for _, row in expected]
    assert count.tolist() == [number for _, row in expected for number, _ in row]
    assert odds == pytest.approx([o for _, row in expected for _, o in row], **exactly)
    assert count.sum() == np.count_nonzero(log_odds > -12.0)


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("seed", SEEDS)
def test_the_shares_of_error_scales_maximise_the_likelihood(seed):
    square, log_odds = pairs_to_judge(seed)
    start, count, odds, squares = mixture.cells(square, log_odds, -12.0, 30.0, 1e-2, 20.0, (40, 15))
    scales, pseudo = np.array([0.5, 1.0, 3.0]), np.array([0.0, 2.0, 0.0])
    density = scales**-2.0 * np.exp(-0.5 * squares[:, None] / scales**2)
    state = start, count, odds, density, pseudo
    by_cell = count, odds, np.repeat(density, np.diff(start), axis=0), pseudo
    start_shares = np.random.default_rng(seed).dirichlet(np.ones(3))
    expected = naive.log_likelihood(*by_cell, start_shares)
    assert mixture.log_likelihood(*state, start_shares) == pytest.approx(expected, **exactly)
    found = mixture.max_likelihood_shares(*state, start_shares, 1e-3, 100, 1e-12, 1e-3, 1e-10)
    best = naive.log_likelihood(*by_cell, naive.em_shares(*by_cell, 5000))
    assert found.sum() == pytest.approx(1.0) and np.all(found >= 0.0)
    assert naive.log_likelihood(*by_cell, found) == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize("outlying", [0.0, 0.003, 0.1])
def test_a_tail_of_the_errors_is_kept_where_it_is_significant(outlying):
    rng = np.random.default_rng(8)
    scales, core, pseudo = np.array([0.7, 1.0, 1.5, 4.0, 9.0]), 3, np.array([0.0, 2.0, 0.0, 0.0, 0.0])
    square = rng.chisquare(2, 1000) * np.where(rng.uniform(size=1000) < outlying, 16.0, 1.0)
    found = mixture.cells(square, np.full(1000, 14.0), -12.0, 30.0, 1e-2, 20.0, (60, 15))
    start, count, odds, squares = found
    search = (1e-3, 100, 1e-10, 1e-3, 1e-10)
    shares, tail, reached = mixture.fit(*found, 2, scales, core, pseudo, np.eye(5)[1], 8.0, search)
    density = np.repeat(scales**-2.0 * np.exp(-0.5 * squares[:, None] / scales**2), np.diff(start), axis=0)
    best = naive.em_shares(count, odds, density, pseudo, 5000)
    alone = naive.em_shares(count, odds, density[:, :core], pseudo[:core], 5000)
    gained = naive.log_likelihood(count, odds, density, pseudo, best)
    gained -= naive.log_likelihood(count, odds, density[:, :core], pseudo[:core], alone)
    assert tail == pytest.approx(gained, abs=0.01)
    expected = best if gained > 8.0 else np.append(alone, [0.0, 0.0])
    assert (shares[core:].sum() > 0.0) == (gained > 8.0) == (outlying > 0.01)
    assert shares == pytest.approx(expected, abs=0.02)
    assert reached == pytest.approx(naive.log_likelihood(count, odds, density, pseudo, shares))


# ---- relations of magnitudes ----


def magnitudes(seed, c):
    """A sample of pairs with c colours as ``learn`` takes it, and an initial relation."""
    rng = np.random.default_rng([2, seed, c])
    n, knots = 300, np.sort(rng.uniform(14.0, 20.0, 1 + seed))
    x = rng.uniform(13.0, 21.0, n)
    colours = np.hstack([rng.normal(0.0, 0.5, (n, c)), rng.uniform(1e-4, 1e-2, (n, c))])
    slopes = rng.normal(0.0, 0.1, c)
    difference = 0.3 + 0.02 * (x - 17.0) + colours[:, :c] @ slopes + rng.normal(0.0, 0.1, n)
    difference[rng.uniform(size=n) < 0.1] += 2.0
    quoted = rng.uniform(1e-4, 2e-2, (2, n))
    unrelated = rng.uniform(0.02, 0.3, n)
    chance = unrelated * rng.choice([0.0, 0.2, 3.0], n)
    sample = np.column_stack([difference, *quoted, unrelated, x, chance])
    k = len(knots)
    start = (
        np.full(k, 0.2), rng.uniform(0.05, 0.2, k), np.zeros(c), np.array([1.0, 3.0, 9.0]),
        np.array([0.8, 0.12, 0.03, 0.05]), np.zeros((k + c, k + c)), np.zeros(k + c), np.array([np.inf]),
    )  # fmt: skip
    return sample, colours, knots, start


@pytest.mark.parametrize("c", [0, 1, 2])
@pytest.mark.parametrize("seed", SEEDS)
def test_em_iterations_of_a_relation(seed, c):
    sample, colours, knots, start = magnitudes(seed, c)
    size = len(knots) + c
    penalty = np.diag(np.linspace(0.1, 1.0, size)) + 0.01
    allowances, unrelated, pairs, scatter = np.array([0.0, 0.3, 0.1]), 0.5, 20.0, 0.003
    found, expected = tuple(x.copy() for x in start), start
    relation.learn(sample, colours, knots, found, penalty, np.array([*allowances, unrelated, pairs, scatter, 0.0]), 4)
    priors = {"allowances": allowances, "unrelated": unrelated, "pairs": pairs, "scatter": scatter}
    for _ in range(4):
        expected = naive.em_iteration(sample, colours, knots, expected, penalty, priors)
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.ravel() == pytest.approx(np.ravel(theirs), **exactly)


def test_a_converged_relation_does_not_change():
    sample, colours, knots, start = magnitudes(3, 1)
    found, again = tuple(x.copy() for x in start), None
    priors = np.array([0.0, 0.3, 0.1, 0.5, 20.0, 0.003, 1e-9])
    for steps in (2000, 1):
        again = tuple(x.copy() for x in found)
        relation.learn(sample, colours, knots, found, 0.1 * np.eye(len(knots) + 1), priors, steps)
    for before, after in zip(again, found, strict=True):
        assert after.ravel() == pytest.approx(before.ravel(), rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("c", [0, 1, 2])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_density_of_a_magnitude_given_others(seed, c):
    rng = np.random.default_rng([3, seed, c])
    n, k = 60, 1 + seed
    knots = np.sort(rng.uniform(14.0, 20.0, k))
    state = (
        rng.normal(0.0, 0.2, k), rng.uniform(0.01, 0.3, k), rng.normal(0.0, 0.2, c), rng.normal(0.5, 0.2, c),
        np.array([1.0, 3.0, 9.0]), rng.dirichlet(np.ones(4)),
    )  # fmt: skip
    others = rng.uniform(13.0, 21.0, (n, 1 + c))
    y, variance, background = (
        others[:, 0] + rng.normal(0.0, 1.0, n),
        rng.uniform(0.0, 0.1, n),
        rng.uniform(0.01, 0.3, n),
    )
    other_variance, found = rng.uniform(0.0, 0.1, (n, 1 + c)), np.empty(n)
    relation.log_mixture(y, variance, others, other_variance, knots, state, background, found)
    expected = [
        naive.log_magnitude_density(y[e], variance[e], others[e], other_variance[e], knots, state, background[e])
        for e in range(n)
    ]
    assert found == pytest.approx(np.array(expected), **exactly)


@pytest.mark.parametrize("seed", SEEDS)
def test_weighted_quartiles_of_the_values_nearest_to_each_knot(seed):
    rng = np.random.default_rng([4, seed])
    n, k = 50, 5
    values, weight, nearest = rng.normal(size=n), rng.uniform(size=n), rng.integers(0, k - 1, n)
    found = np.empty((3, k + 1))
    relation.quartiles(np.argsort(values, kind="stable"), values, weight, nearest, found)
    for quarter, row in zip((0.25, 0.5, 0.75), found, strict=True):
        expected = naive.weighted_quantiles(quarter, values, weight, nearest, k)
        assert np.isnan(expected[k - 1]) and row == pytest.approx(np.array(expected), nan_ok=True, **exactly)


@pytest.mark.parametrize("c", [0, 2])
def test_a_sample_of_pairs_is_gathered(c):
    rng = np.random.default_rng([7, c])
    y, variance, unrelated, assumed = rng.uniform(size=(4, 20))
    others, other_variance = rng.uniform(size=(2, 20, 1 + c))
    at, weight = rng.permutation(20)[:8], rng.uniform(0.1, 1.0, 8)
    sample, colours = np.empty((8, 6)), np.empty((8, 2 * c))
    relation.gather(at, weight, y, variance, others, other_variance, unrelated, assumed, sample, colours)
    for e, row in enumerate(at):
        odds = (1.0 - weight[e]) / weight[e]
        first = y[row] - others[row, 0], variance[row], other_variance[row, 0]
        assert sample[e] == pytest.approx([*first, unrelated[row], others[row, 0], odds * assumed[row]])
        assert colours[e] == pytest.approx([*(others[row, 1:] - others[row, 0]), *other_variance[row, 1:]])


# ---- curves of a share ----


@pytest.mark.parametrize("k", [1, 2, 3, 12])
@pytest.mark.parametrize("seed", SEEDS)
def test_newton_steps_of_a_detection_curve(seed, k):
    rng = np.random.default_rng([5, seed, k])
    n, knots = 200, np.sort(rng.uniform(14.0, 20.0, k) ** 2)  # some of them close together
    magnitude, log_odds, p_detected = rng.uniform(150.0, 450.0, n), rng.normal(0.0, 1.0, n), rng.uniform(size=n)
    penalty, expected = 0.3 * np.eye(k) + 0.01, rng.normal(0.0, 0.5, k)
    found = expected.copy()
    relation.climb(magnitude, log_odds, p_detected, knots, penalty, found, 3, 0.4, 0.0)
    for _ in range(3):
        expected = naive.newton_step(magnitude, log_odds, p_detected, knots, penalty, expected, 0.4)
    assert found == pytest.approx(expected, **exactly)


@pytest.mark.parametrize("k", [1, 2, 3, 12])
@pytest.mark.parametrize("seed", SEEDS)
def test_weight_of_a_magnitude_by_the_detection_curve(seed, k):
    rng = np.random.default_rng([6, seed, k])
    n, knots, values = 100, np.sort(rng.uniform(14.0, 20.0, k)), rng.normal(0.0, 4.0, k)
    magnitude, share = rng.uniform(13.0, 21.0, n), rng.uniform(size=n)
    magnitude[:5], share[5:7], magnitude[7 : 7 + k] = np.nan, [0.0, 1.0], knots
    wanted, found = np.delete(np.arange(n), 50), np.zeros(n)
    relation.weigh(magnitude, share, wanted, 1e-6, knots, values, found)
    expected = [naive.log_weight_change(magnitude[e], share[e], 1e-6, knots, values) for e in range(n)]
    expected[50] = 0.0
    assert found == pytest.approx(np.array(expected), **exactly)
