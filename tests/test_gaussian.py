"""Vectorised Gaussians agree with the textbook formulas row by row."""

import math

import numpy as np
import pytest

import naive
from sameas.gaussian import Gaussian, InformationSum, inverse, log_density, mahalanobis_sq, propagated, symmetric


def gaussians(rng, *shape, d):
    root = rng.normal(size=(*shape, d, d)) + 2.0 * np.eye(d)
    return Gaussian(rng.normal(size=(*shape, d)), root @ np.swapaxes(root, -1, -2))


@pytest.fixture
def rng():
    return np.random.default_rng(4)


@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_inverse_and_propagated_are_symmetric_to_the_last_digit(rng, d):
    some, jacobian = gaussians(rng, 20, d=d), rng.normal(size=(20, 3, d))
    skew = rng.normal(size=(20, d, d))
    for matrix in (inverse(some.covariance), propagated(jacobian, some.covariance), symmetric(skew)):
        assert np.array_equal(matrix, matrix.transpose(0, 2, 1))
    assert np.allclose(inverse(some.covariance) @ some.covariance, np.eye(d), atol=1e-9)
    assert np.allclose(
        propagated(jacobian, some.covariance), [j @ s @ j.T for j, s in zip(jacobian, some.covariance, strict=True)]
    )


@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_density_and_distance_agree_with_the_definition(rng, d):
    some = gaussians(rng, 20, d=d)
    log_naive = [naive.log_normal(x, s) for x, s in zip(some.mean, some.covariance, strict=True)]
    square = [x @ np.linalg.solve(s, x) for x, s in zip(some.mean, some.covariance, strict=True)]
    np.testing.assert_allclose(log_density(some.mean, some.covariance), log_naive, rtol=1e-10)
    np.testing.assert_allclose(mahalanobis_sq(some.mean, some.covariance), square, rtol=1e-10)


def test_rows_and_covariances_broadcast(rng):
    points, one = rng.normal(size=(7, 1, 2)), gaussians(rng, 3, d=2)
    assert log_density(points - one.mean, one.covariance).shape == (7, 3)


@pytest.mark.parametrize("measured", [1, 2, 4])
def test_an_update_is_the_kalman_update(rng, measured):
    before, seen = gaussians(rng, 12, d=4), gaussians(rng, 12, d=measured)
    after, h = before.updated(seen), np.eye(measured, 4)
    for x, p, z, r, mean, covariance in zip(
        before.mean, before.covariance, seen.mean, seen.covariance, after.mean, after.covariance, strict=True
    ):
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        kept = np.eye(4) - gain @ h
        assert np.allclose(mean, x + gain @ (z - h @ x))
        assert np.allclose(covariance, kept @ p @ kept.T + gain @ r @ gain.T)


def test_a_conditional_is_the_quotient_of_densities(rng):
    """ln p(x, y) = ln p(x | y) + ln p(y)."""
    joint, at = gaussians(rng, 9, d=5), rng.normal(size=(9, 5))
    off, s = at - joint.mean, joint.covariance
    rest = Gaussian(joint.mean[:, :3], s[:, :3, :3]).conditional(s[:, :3, 3:], off[:, 3:], s[:, 3:, 3:])
    whole = log_density(at[:, :3] - rest.mean, rest.covariance) + log_density(off[:, 3:], s[:, 3:, 3:])
    assert np.allclose(whole, log_density(off, s))


def test_a_product_is_the_product_of_the_densities(rng):
    some, weights = gaussians(rng, 6, 3, d=2), rng.uniform(0.2, 1.0, (6, 3))
    for w in (None, weights):
        one, at = some.product(w), rng.normal(size=(40, 6, 2))
        parts = log_density(at[:, :, None] - some.mean, some.covariance) * (1.0 if w is None else w)
        apart = parts.sum(axis=2) - log_density(at - one.mean, one.covariance)
        assert np.allclose(apart, apart[0])


def test_a_product_keeps_its_precision_at_large_coordinates(rng):
    some, far = gaussians(rng, 5, 2, d=2), 1e9
    moved = Gaussian(some.mean + far, some.covariance).product()
    assert np.allclose(moved.mean - far, some.product().mean, atol=1e-6)


def test_summed_information_gives_the_joint_density_of_the_measurements(rng):
    """ln ∫ ∏ N(z; H x, R) dx by the marginal of the measurements under a wide prior of x."""
    n, d, m = 4, 3, 2
    prior, seen, slope = gaussians(rng, n, d=d), gaussians(rng, n, d=m), rng.normal(size=(n, m, d))
    total, rows = InformationSum.of(n, d), np.arange(n)
    for one, h in ((prior, None), (seen, slope)):
        log_norm = log_density(np.zeros_like(one.mean), one.covariance)
        total.add(rows, one.mean, inverse(one.covariance), log_norm, h)
    found = total.gaussian()
    log_integral = total.log_peak() - 0.5 * total.chi_sq(found)
    for k in range(n):
        p, h, r = prior.covariance[k], slope[k], seen.covariance[k]
        spread = h @ p @ h.T + r
        innovation = seen.mean[k] - h @ prior.mean[k]
        assert math.isclose(log_integral[k], naive.log_normal(innovation, spread), rel_tol=1e-9)
        assert np.allclose(found.mean[k], prior.mean[k] + p @ h.T @ np.linalg.solve(spread, innovation))
        assert np.allclose(found.covariance[k], p - p @ h.T @ np.linalg.solve(spread, h @ p))
    assert np.array_equal(total.at(rows[1:2]).vector, total.vector[1:2])
