"""The close-objects rule where features are correlated, and the paper's approximation of it."""

import math

import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.stats import multivariate_normal

import naive
from problems import plane_records
from sameas import Box, CloseObjects, InputError, Radius, Records
from sameas.evidence import log_neighbour_density, log_surface_density
from sameas.evidence.close import (
    log_correlated_density,
    log_correlated_surface,
    log_generalized_density,
    log_generalized_gaussian,
    log_rectangle,
)

A, B = np.array([0.7, 1.3]), np.array([2.0, 1.9])


def covariances(rng, n, rho):
    """(n, 2, 2) of sigmas between 0.03 and 30."""
    sigma = 10 ** rng.uniform(-1.5, 1.5, (n, 2))
    corner = np.broadcast_to(rho, n) * sigma[:, 0] * sigma[:, 1]
    return np.stack([sigma[:, 0] ** 2, corner, corner, sigma[:, 1] ** 2], axis=1).reshape(-1, 2, 2)


def residuals(rng, n):
    """(n, 2), from the centre to far outside the boxes."""
    return rng.normal(0, 1, (n, 2)) * rng.choice([1.0, 5.0, 40.0], (n, 1))


def braces_by_reference(delta, cov, a, b):
    return [
        naive.log_normal(x, s) - naive.close_objects_correlated(x, s, a, b) for x, s in zip(delta, cov, strict=True)
    ]


# ---- the exact form ----


@pytest.mark.slow
def test_correlated_braces_agree_with_the_reference_from_the_centre_to_the_far_tails():
    rng = np.random.default_rng(0)
    n = 60
    delta, cov = residuals(rng, n), covariances(rng, n, rng.uniform(-0.95, 0.95, n))
    expected = np.array(braces_by_reference(delta, cov, A, B))
    assert expected.min() < -1e4 and expected.max() > -4
    np.testing.assert_allclose(log_correlated_density(delta, cov, A, B), expected, rtol=1e-9, atol=1e-8)


@pytest.mark.slow
def test_correlated_braces_agree_with_a_double_integral_in_ordinary_cases():
    rng = np.random.default_rng(1)
    for rho in (0.6, -0.9):
        delta, cov = rng.normal(0, 1.5, 2), np.array([[1.0, 0.7 * rho], [0.7 * rho, 0.49]])
        normal = multivariate_normal(delta, cov)

        def box(c, normal=normal):
            return dblquad(lambda y, x: normal.pdf((x, y)), -c[0], c[0], -c[1], c[1], epsabs=1e-13, epsrel=1e-11)[0]

        expected = math.log((box(B) - box(A)) / (4 * (B.prod() - A.prod())))
        assert log_correlated_density(delta[None], cov[None], A, B)[0] == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("rho", [0.0, 1e-12, -1e-9])
def test_without_correlation_the_exact_form_equals_the_diagonal_one(rho):
    rng = np.random.default_rng(2)
    delta, cov = residuals(rng, 300), covariances(rng, 300, rho)
    sigma = np.sqrt(np.einsum("mvv->mv", cov))
    expected = log_neighbour_density(delta, sigma, A, B)
    assert expected.min() < -1e5
    # A correlation of 1e-9 changes the logarithm of the far tails by that fraction.
    close = {"rtol": 1e-10 + 3 * abs(rho), "atol": 1e-10}
    np.testing.assert_allclose(log_correlated_density(delta, cov, A, B), expected, **close)
    np.testing.assert_allclose(log_correlated_surface(delta, cov, A), log_surface_density(delta, sigma, A), **close)


@pytest.mark.parametrize("rho", [0.9, -0.99, 0.999999])
def test_the_order_of_integration_does_not_matter(rho):
    rng = np.random.default_rng(3)
    delta, cov = residuals(rng, 300), covariances(rng, 300, rho)
    one = log_correlated_density(delta, cov, A, B)
    other = log_correlated_density(delta[:, ::-1], cov[:, ::-1, ::-1], A[::-1], B[::-1])
    mirrored = log_correlated_density(-delta, cov, A, B)
    # Precision is lost only through 1 − ρ², in the tails.
    lost = 1e-12 / (1 - rho**2)
    np.testing.assert_allclose(one, other, rtol=lost, atol=1e-9)
    np.testing.assert_allclose(one, mirrored, rtol=1e-12, atol=1e-9)
    assert np.isfinite(one).all()


def test_thin_ellipses_have_the_probability_of_a_line():
    # ρ → 1: y = x, and the rectangle reduces to the intersection of its two intervals.
    low = np.array([-1.0, 0.5, 3.0])
    ours = log_rectangle(low, np.full(3, 2.0), low + 0.5, np.full(3, 2.0), np.full(3, 1 - 1e-13))
    np.testing.assert_allclose(ours, naive.log_interval(low + 0.5, low + 2.0), rtol=2e-6)


def test_the_difference_and_the_four_rectangles_agree_where_the_method_changes():
    # The method changes at a share of 1e-5: the density must not jump there.
    x = np.linspace(5.0, 7.0, 4001)
    delta = np.stack([x, 0.3 * x], axis=1)
    cov = np.broadcast_to([[1.0, 0.5], [0.5, 0.8]], (len(x), 2, 2))
    log_density = log_correlated_density(delta, cov, A, B)
    share = log_density + math.log(4 * (B.prod() - A.prod()))
    assert share.max() > math.log(1e-5) > share.min()
    assert np.abs(np.diff(log_density, 3)).max() < 1e-8


def test_the_correlated_surface_is_the_limit_of_thin_shells():
    rng = np.random.default_rng(4)
    delta, cov = rng.normal(0, 3, (60, 2)), covariances(rng, 60, rng.uniform(-0.99, 0.99, 60))
    surface = log_correlated_surface(delta, cov, A)
    np.testing.assert_allclose(surface, log_correlated_density(delta, cov, A, A * (1 + 1e-7)), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("a, b", [((0.0, 0.0), (1.0, 2.0)), ((0.0, 0.5), (1.0, 2.0)), ((0.5, 1.0), (0.5, 2.0))])
def test_boxes_may_be_empty_in_one_feature_or_lack_the_inner_box(a, b):
    rng = np.random.default_rng(5)
    a, b = np.array(a), np.array(b)
    delta, cov = residuals(rng, 20), covariances(rng, 20, 0.7)
    expected = braces_by_reference(delta, cov, a, b)
    np.testing.assert_allclose(log_correlated_density(delta, cov, a, b), expected, rtol=1e-9, atol=1e-8)


@pytest.mark.slow
def test_the_rule_uses_the_full_covariance_of_two_correlated_features():
    rng = np.random.default_rng(6)
    full, plain = (plane_records(rng, 7, 2, scale=0.2, kind=kind) for kind in ("full", "axis sigmas"))
    pairs = Box(4.0)(full, plain)
    for a, b in ((0.2, 0.9), (0.0, 0.9)):
        expected = [
            naive.close_objects_correlated(*naive.residual(full, i, plain, j), np.full(2, a), np.full(2, b))
            for i, j in zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)
        ]
        exact, diagonal = CloseObjects(a, b)(pairs), CloseObjects(a, b, correlation="diagonal")(pairs)
        np.testing.assert_allclose(exact.log_ratio, expected, rtol=1e-9, atol=1e-8)
        assert np.abs(exact.log_ratio - diagonal.log_ratio).max() > 0.01
    uncorrelated = Box(4.0)(plain, plain)
    exact, diagonal = (CloseObjects(0.2, 0.9, how)(uncorrelated).log_ratio for how in ("exact", "diagonal"))
    np.testing.assert_array_equal(exact, diagonal)


def test_in_three_features_the_boxes_use_the_diagonal():
    rng = np.random.default_rng(7)
    pairs = Box(4.0)(*(plane_records(rng, 12, 3, scale=0.3, kind="full") for _ in range(2)))
    exact, diagonal = (CloseObjects(0.2, 0.9, how)(pairs).log_ratio for how in ("exact", "diagonal"))
    np.testing.assert_array_equal(exact, diagonal)


def test_the_density_of_a_neighbours_residual_integrates_to_one():
    x = np.arange(-6, 6, 0.12)
    delta = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    for a, b in ((A, B), (np.zeros(2), B)):
        cov = np.broadcast_to([[0.5, -0.4], [-0.4, 0.6]], (len(delta), 2, 2))
        assert np.exp(log_correlated_density(delta, cov, a, b)).sum() * 0.12**2 == pytest.approx(1.0, abs=1e-6)


# ---- the paper's approximation ----


@pytest.mark.parametrize("ratio", [1e-4, 0.05, 0.5, 2.0, 30.0, 1e4])
def test_the_generalized_gaussian_agrees_with_the_reference(ratio):
    sigma = 0.7
    x = np.array([0.0, 0.1, 0.5, 1.0, 2.0]) * math.hypot(sigma, ratio * sigma)
    expected = [naive.generalized_gaussian(value, sigma, ratio * sigma) for value in x]
    ours = log_generalized_gaussian(x, np.full(5, sigma), np.full(5, ratio * sigma))
    middle = np.array(expected) > -20
    np.testing.assert_allclose(ours[middle], np.array(expected)[middle], rtol=1e-8, atol=1e-7)
    # Beyond its edge a nearly uniform density is zero up to rounding.
    assert np.all(ours[~middle] < -19)


def test_the_papers_braces_agree_with_the_reference_and_negative_ones_are_marked():
    rng = np.random.default_rng(8)
    delta, sigma = rng.normal(0, 3, (80, 2)), rng.uniform(0.3, 2, (80, 2))
    ours = log_generalized_density(delta, sigma, A, B)
    covs = [np.diag(s**2) for s in sigma]
    expected = np.array(
        [naive.log_normal(x, s) - naive.close_objects_paper(x, s, A, B) for x, s in zip(delta, covs, strict=True)]
    )
    negative = np.isnan(expected)
    assert 0 < negative.sum() < 60
    assert np.all(ours[negative] == -np.inf)
    np.testing.assert_allclose(ours[~negative], expected[~negative], rtol=1e-7, atol=1e-5)


def test_the_approximation_is_near_the_exact_rule_and_replaced_by_it_where_invalid():
    x = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 30.0])
    pairs = Radius(60.0)(Records.of(np.stack([x, x / 10], axis=1), sigma=0.6), Records.of([[0.0, 0.0]], sigma=0.8))
    exact, paper = (CloseObjects(1.1, 4.0, approximation=how)(pairs) for how in (None, "generalized Gaussian"))
    far = pairs.residual[:, 0] > 10
    assert far.sum() == 1 and np.isfinite(paper.log_ratio).all()
    np.testing.assert_array_equal(paper.log_ratio[far], exact.log_ratio[far])
    difference = np.abs(paper.log_ratio - exact.log_ratio)[~far]
    assert 0.001 < difference.max() < 0.15


@pytest.mark.parametrize(
    "keywords, words",
    [
        ({"correlation": "none"}, """correlation is 'none'; give "exact" or "diagonal\""""),
        ({"approximation": "normal"}, """approximation is 'normal'; give "generalized Gaussian" or None"""),
        ({"b": None, "approximation": "generalized Gaussian"}, "generalized Gaussian has no limit b → a; give b"),
    ],
)
def test_invalid_input_is_refused_with_a_clear_message(keywords, words):
    with pytest.raises(InputError, match=words):
        CloseObjects(**({"a": 1.0, "b": 2.0} | keywords))
