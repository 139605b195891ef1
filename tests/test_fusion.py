"""Fused states: minimum variance if the correlation is known, consistent if it is not; common process noise."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from sameas import Field, InputError, Records, Sphere, identify
from sameas.many.fusion import (
    KalmanFilter,
    bar_shalom_campo,
    covariance_intersection,
    fuse_independent,
    steady_tracks,
    without_common,
)

DT = 2.0
MOTION = np.array([[1.0, DT], [0.0, 1.0]])
NOISE = 4.0 * np.array([[DT**4 / 4, DT**3 / 2], [DT**3 / 2, DT**2]])
RADAR, LIDAR = KalmanFilter([[1.0, 0.0]], [[400.0]]), KalmanFilter([[1.0, 0.0], [0.0, 1.0]], [[100.0, 0.0], [0.0, 9.0]])


def covariances(rng, *shape, d=3):
    root = rng.standard_normal((*shape, d, d))
    return root @ root.swapaxes(-1, -2) + 0.1 * np.eye(d)


def test_independent_fusion_is_the_generalized_least_squares_estimate():
    rng = np.random.default_rng(1)
    x, p = rng.normal(size=(4, 3)), covariances(rng, 4)
    fused = fuse_independent(x, p)
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
    np.testing.assert_allclose(fuse_independent(x + 1e7, p).state - 1e7, fuse_independent(x, p).state, atol=1e-8)


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
    two = fuse_independent(x, p)
    np.testing.assert_allclose(one.state, two.state, rtol=1e-9)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-9)


def test_covariance_intersection_of_two_has_the_weight_found_by_search():
    rng = np.random.default_rng(5)
    for _ in range(10):
        x, p = rng.normal(size=(2, 2)), covariances(rng, 2, d=2)
        information = np.linalg.inv(p)

        def size(w, information=information):
            return -np.linalg.slogdet(w * information[0] + (1 - w) * information[1])[1]

        best = minimize_scalar(size, bounds=(0, 1), method="bounded", options={"xatol": 1e-10}).fun
        found = np.linalg.slogdet(covariance_intersection(x, p).covariance[0])[1]
        assert found <= best + 1e-6 * max(1.0, abs(best))


def test_covariance_intersection_is_consistent_for_any_correlation():
    rng = np.random.default_rng(6)
    for _ in range(20):
        # Arbitrarily correlated errors: the true covariance of the fused state is bounded by the stated one.
        joint = covariances(rng, d=6)
        p = np.stack([joint[:2, :2], joint[2:4, 2:4], joint[4:, 4:]])
        fused = covariance_intersection(np.zeros((3, 2)), p)
        gains = [w * fused.covariance[0] @ np.linalg.inv(c) for w, c in zip(fused.weights[0], p, strict=True)]
        gain = np.hstack(gains)
        assert np.linalg.eigvalsh(fused.covariance[0] - gain @ joint @ gain.T)[0] > -1e-9


@pytest.mark.parametrize("k", [2, 3, 5])
@pytest.mark.long_after(1)
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
    np.testing.assert_allclose(fuse_independent(np.ones((2, 2)), np.stack([p, p])).covariance[0], p / 2, rtol=1e-9)


def test_the_order_of_estimates_changes_nothing():
    rng = np.random.default_rng(7)
    x, p = rng.normal(size=(4, 3)), covariances(rng, 4)
    turn = rng.permutation(4)
    for fuse in (fuse_independent, covariance_intersection):
        np.testing.assert_allclose(fuse(x, p).state, fuse(x[turn], p[turn]).state, atol=1e-6)


def test_invalid_estimates_are_refused_with_a_clear_message():
    with pytest.raises(InputError, match=r"give \(n, k, L\)"):
        fuse_independent(np.zeros((2, 3)), np.zeros((2, 2, 2)))
    with pytest.raises(InputError, match="estimate 1 is not positive definite"):
        fuse_independent(np.zeros((2, 1)), np.array([[[1.0]], [[-1.0]]]))
    with pytest.raises(InputError, match="not finite"):
        fuse_independent(np.array([[np.nan], [0.0]]), np.ones((2, 1, 1)))
    with pytest.raises(InputError, match="larger than the covariances allow"):
        bar_shalom_campo([0.0], [[1.0]], [0.0], [[1.0]], [[1.5]])


# Common process noise: the stated covariance of two tracks' difference is the observed one, and pairs use it.


def filtered(rng, targets, steps, sensors):
    """Errors (n, 2) of each sensor's filter of the same targets after ``steps`` steps."""
    truth = np.zeros((targets, 2))
    states = [np.zeros((targets, 2)) for _ in sensors]
    covariances = [np.eye(2) for _ in sensors]
    for _ in range(steps):
        truth = truth @ MOTION.T + rng.multivariate_normal(np.zeros(2), NOISE, targets)
        for k, sensor in enumerate(sensors):
            h, r = np.array(sensor.matrix), np.array(sensor.covariance)
            seen = truth @ h.T + rng.multivariate_normal(np.zeros(len(h)), r, targets)
            ahead = MOTION @ covariances[k] @ MOTION.T + NOISE
            gain = ahead @ h.T @ np.linalg.inv(h @ ahead @ h.T + r)
            forward = states[k] @ MOTION.T
            states[k] = forward + (seen - forward @ h.T) @ gain.T
            covariances[k] = (np.eye(2) - gain @ h) @ ahead
    return [state - truth for state in states]


def test_the_covariance_of_two_tracks_agrees_with_simulation():
    steady = steady_tracks(MOTION, NOISE, RADAR, LIDAR)
    one, two = filtered(np.random.default_rng(1), 40_000, 30, (RADAR, LIDAR))
    for stated, seen in ((steady.first, one.T @ one), (steady.second, two.T @ two), (steady.cross, one.T @ two),
                         (steady.residual, (one - two).T @ (one - two))):  # fmt: skip
        size = np.sqrt(np.outer(np.diag(steady.first + steady.second), np.diag(steady.first + steady.second)))
        np.testing.assert_allclose(seen / len(one), stated, atol=0.02 * size.max() / np.sqrt(1.0))


@pytest.mark.parametrize("index", [0.01, 0.1, 0.5, 1.0, 2.0, 5.0, 20.0])
def test_without_the_common_part_the_gate_is_too_wide_at_every_manoeuvring_index(index):
    noise = 400.0 * index**2 * NOISE / (4.0 * DT**4)
    alike = steady_tracks(MOTION, noise, RADAR, RADAR)
    assert 1.2 < np.sqrt(alike.widening.prod()) < 1.7 and alike.widening[0] < alike.widening[1]


def test_pairs_have_the_covariance_of_the_residual_whatever_the_split():
    steady = steady_tracks(MOTION, NOISE, RADAR, LIDAR)
    rng = np.random.default_rng(2)
    first = Records.of(rng.normal(0, 5, (30, 2)), covariance=steady.first, source="radar")
    second = Records.of(rng.normal(0, 5, (30, 2)), covariance=steady.second, source="lidar")
    answer = identify(*without_common(first, second, steady.cross), rule=Field(1e-3))
    np.testing.assert_allclose(answer.pairs.covariance, np.broadcast_to(steady.residual, (len(answer.pairs), 2, 2)))


def test_normalised_residuals_follow_their_distribution_only_without_the_common_part():
    steady = steady_tracks(MOTION, NOISE, RADAR, LIDAR)
    one, two = filtered(np.random.default_rng(3), 4000, 30, (RADAR, LIDAR))
    delta = one - two
    honest, naive = (
        np.mean(np.einsum("ni,ij,nj->n", delta, np.linalg.inv(c), delta))
        for c in (steady.residual, steady.first + steady.second)
    )
    assert honest == pytest.approx(2.0, abs=0.1) and naive < 1.8


@pytest.mark.parametrize("cross, words", [
    (np.eye(2) * 30.0, "as large as the errors of radar and lidar"),
    (np.eye(3), r"give \(2, 2\)"),
    ([[np.nan, 0.0], [0.0, 1.0]], "finite"),
])  # fmt: skip
def test_invalid_cross_covariances_are_refused(cross, words):
    first, second = (Records.of([[0.0, 0.0]], sigma=s, source=n) for s, n in ((5.0, "radar"), (5.0, "lidar")))
    with pytest.raises(InputError, match=words):
        without_common(first, second, cross)
    with pytest.raises(InputError, match="local coordinates"):
        sky = Records.of([[0.0, 0.0]], sigma=5.0, space=Sphere())
        without_common(sky, sky, np.eye(2))


def test_a_filter_without_steady_state_is_refused():
    with pytest.raises(InputError, match="never settles"):
        steady_tracks(MOTION, NOISE, KalmanFilter([[0.0, 1.0]], [[1.0]]), RADAR)
    with pytest.raises(InputError, match=r"give \(m, 2\)"):
        steady_tracks(MOTION, NOISE, KalmanFilter([[1.0]], [[1.0]]), RADAR)
