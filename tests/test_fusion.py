"""Fused states: minimum variance if the correlation is known, consistent if it is not."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from sameas.errors import InputError
from sameas.many.fusion import bar_shalom_campo, covariance_intersection, independent


def covariances(rng, *shape, d=3):
    root = rng.standard_normal((*shape, d, d))
    return root @ root.swapaxes(-1, -2) + 0.1 * np.eye(d)


def test_independent_fusion_is_the_generalized_least_squares_estimate():
    rng = np.random.default_rng(1)
    x, p = rng.normal(size=(4, 3)), covariances(rng, 4)
    fused = independent(x, p)
    joint = np.zeros((12, 12))
    for k in range(4):
        joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = p[k]
    design = np.vstack([np.eye(3)] * 4)
    best = np.linalg.inv(design.T @ np.linalg.solve(joint, design))
    np.testing.assert_allclose(fused.covariance[0], best, rtol=1e-10)
    np.testing.assert_allclose(fused.state[0], best @ design.T @ np.linalg.solve(joint, x.ravel()), rtol=1e-9)


def test_large_coordinates_lose_no_precision():
    rng = np.random.default_rng(2)
    x, p = rng.normal(size=(5, 3, 2)), covariances(rng, 5, 3, d=2)
    np.testing.assert_allclose(independent(x + 1e7, p).state - 1e7, independent(x, p).state, atol=1e-8)


def test_a_known_cross_covariance_gives_the_minimum_variance_estimate():
    rng = np.random.default_rng(3)
    joint = covariances(rng, 20, d=6)
    p1, p2, p12 = joint[:, :3, :3], joint[:, 3:, 3:], joint[:, :3, 3:]
    x1, x2 = rng.normal(size=(2, 20, 3))
    fused = bar_shalom_campo(x1, p1, x2, p2, p12)
    design = np.vstack([np.eye(3)] * 2)
    for n in range(20):
        best = np.linalg.inv(design.T @ np.linalg.solve(joint[n], design))
        state = best @ design.T @ np.linalg.solve(joint[n], np.concatenate([x1[n], x2[n]]))
        np.testing.assert_allclose(fused.covariance[n], best, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(fused.state[n], state, rtol=1e-6, atol=1e-8)


def test_zero_cross_covariance_equals_independent_fusion():
    rng = np.random.default_rng(4)
    x, p = rng.normal(size=(2, 3)), covariances(rng, 2)
    one = bar_shalom_campo(x[0], p[0], x[1], p[1], np.zeros((3, 3)))
    two = independent(x, p)
    np.testing.assert_allclose(one.state, two.state, rtol=1e-9)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-9)


@pytest.mark.parametrize("criterion", ["determinant", "trace"])
def test_covariance_intersection_of_two_has_the_weight_found_by_search(criterion):
    rng = np.random.default_rng(5)
    measures: dict[str, Callable[[np.ndarray], float]]
    measures = {"determinant": lambda c: np.linalg.slogdet(c)[1], "trace": np.trace}
    measure = measures[criterion]
    for _ in range(10):
        x, p = rng.normal(size=(2, 2)), covariances(rng, 2, d=2)
        information = np.linalg.inv(p)

        def size(w, information=information):
            return measure(np.linalg.inv(w * information[0] + (1 - w) * information[1]))

        best = minimize_scalar(size, bounds=(0, 1), method="bounded", options={"xatol": 1e-10}).fun
        assert measure(covariance_intersection(x, p, criterion=criterion).covariance[0]) <= best + 1e-6 * max(
            1.0, abs(best)
        )


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("criterion", ["determinant", "trace"])
def test_covariance_intersection_is_consistent_for_any_correlation(criterion):
    rng = np.random.default_rng(6)
    for _ in range(20):
        # Arbitrarily correlated errors: the true covariance of the fused state is bounded by the stated one.
        joint = covariances(rng, d=6)
        p = np.stack([joint[:2, :2], joint[2:4, 2:4], joint[4:, 4:]])
        fused = covariance_intersection(np.zeros((3, 2)), p, criterion=criterion)
        gains = [w * fused.covariance[0] @ np.linalg.inv(c) for w, c in zip(fused.weights[0], p, strict=True)]
        gain = np.hstack(gains)
        assert np.linalg.eigvalsh(fused.covariance[0] - gain @ joint @ gain.T)[0] > -1e-9


@pytest.mark.parametrize("k", [2, 3, 5])
def test_weights_of_a_covariance_intersection_are_optimal(k):
    rng = np.random.default_rng(8)
    p = covariances(rng, 200, k, d=4)
    fused = covariance_intersection(np.zeros((200, k, 4)), p)
    # Equivalence theorem of Kiefer and Wolfowitz: all gradients are ≤ 1, and = 1 for estimates of weight > 0.
    slope = np.einsum("nkvw,nwv->nk", np.linalg.inv(p), fused.covariance) / 4
    assert slope.max() < 1.0 + 1e-6
    np.testing.assert_allclose(np.sum(fused.weights * slope, axis=1), 1.0, atol=1e-9)
    assert (fused.weights >= 0).all() and (fused.weights == 0).any()


def test_a_repeated_estimate_adds_no_information():
    p = np.array([[2.0, 0.3], [0.3, 1.0]])
    fused = covariance_intersection(np.ones((2, 2)), np.stack([p, p]))
    np.testing.assert_allclose(fused.covariance[0], p, rtol=1e-9)
    np.testing.assert_allclose(independent(np.ones((2, 2)), np.stack([p, p])).covariance[0], p / 2, rtol=1e-9)


def test_the_order_of_estimates_changes_nothing():
    rng = np.random.default_rng(7)
    x, p = rng.normal(size=(4, 3)), covariances(rng, 4)
    turn = rng.permutation(4)
    for fuse in (independent, covariance_intersection):
        np.testing.assert_allclose(fuse(x, p).state, fuse(x[turn], p[turn]).state, atol=1e-6)


def test_invalid_estimates_are_refused_with_a_clear_message():
    with pytest.raises(InputError, match=r"give \(n, k, L\)"):
        independent(np.zeros((2, 3)), np.zeros((2, 2, 2)))
    with pytest.raises(InputError, match="estimate 1 is not positive definite"):
        independent(np.zeros((2, 1)), np.array([[[1.0]], [[-1.0]]]))
    with pytest.raises(InputError, match="not finite"):
        independent(np.array([[np.nan], [0.0]]), np.ones((2, 1, 1)))
    with pytest.raises(InputError, match="larger than the covariances allow"):
        bar_shalom_campo([0.0], [[1.0]], [0.0], [[1.0]], [[1.5]])
    with pytest.raises(InputError, match='"determinant" or "trace"'):
        covariance_intersection(np.zeros((2, 1)), np.ones((2, 1, 1)), criterion="volume")
