"""Common process noise: the stated covariance of two tracks' difference is the observed one, and pairs use it."""

import numpy as np
import pytest

from sameas import Field, InputError, Records, Sphere, identify
from sameas.many.fusion import Filter, steady_tracks, without_common

DT = 2.0
MOTION = np.array([[1.0, DT], [0.0, 1.0]])
NOISE = 4.0 * np.array([[DT**4 / 4, DT**3 / 2], [DT**3 / 2, DT**2]])
RADAR, LIDAR = Filter([[1.0, 0.0]], [[400.0]]), Filter([[1.0, 0.0], [0.0, 1.0]], [[100.0, 0.0], [0.0, 9.0]])


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
def test_invalid_input_is_refused(cross, words):
    first, second = (Records.of([[0.0, 0.0]], sigma=s, source=n) for s, n in ((5.0, "radar"), (5.0, "lidar")))
    with pytest.raises(InputError, match=words):
        without_common(first, second, cross)
    with pytest.raises(InputError, match="local coordinates"):
        sky = Records.of([[0.0, 0.0]], sigma=5.0, space=Sphere())
        without_common(sky, sky, np.eye(2))


def test_a_filter_without_steady_state_is_refused():
    with pytest.raises(InputError, match="never settles"):
        steady_tracks(MOTION, NOISE, Filter([[0.0, 1.0]], [[1.0]]), RADAR)
    with pytest.raises(InputError, match=r"give \(m, 2\)"):
        steady_tracks(MOTION, NOISE, Filter([[1.0]], [[1.0]]), RADAR)
