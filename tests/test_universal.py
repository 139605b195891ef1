"""The universal rule: closed forms, integrals within their stated errors, and the rules it contains."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

import naive
from problems import plane_records, sky_records
from sameas import CloseObjects, Field, InputError, Plane, Radius, Records
from sameas.evidence import Displacement, Flat, GaussianMixture, Samples, Universal

SHELL_A, SHELL_B = 0.6, 2.0


def shell(m):
    """Density of a displacement between the boxes."""
    inside = (np.abs(m) < SHELL_B).all(axis=1) & ~(np.abs(m) < SHELL_A).all(axis=1)
    d = m.shape[1]
    return inside / ((2 * SHELL_B) ** d - (2 * SHELL_A) ** d)


def some_pairs(d, n=3, seed=0, kind="full"):
    rng = np.random.default_rng([seed, d])
    return Radius(6.0)(*(plane_records(rng, n, d, extent=2.5, scale=0.5, kind=kind) for _ in range(2)))


def mixture(rng, k, d):
    root = rng.normal(0, 1, (k, d, d))
    return GaussianMixture(
        rng.dirichlet(np.ones(k) * 5), rng.normal(0, 2, (k, d)), root @ root.transpose(0, 2, 1) + np.eye(d)
    )


def within(evidence, expected, sigmas=5.0):
    """Assert that every ratio is within ``sigmas`` stated errors of the expected one."""
    assert evidence.log_error is not None and np.isfinite(evidence.log_error).all()
    assert np.all(np.abs(evidence.log_ratio - expected) <= sigmas * evidence.log_error + 1e-9)


# ---- closed forms ----


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_closed_form_of_mixtures_is_the_joint_normal_of_both_records(d):
    """Numerator and denominator as densities of the stacked vector (X₁, X₂), from the definition."""
    rng = np.random.default_rng(d)
    pairs, p, q = some_pairs(d), mixture(rng, 3, d), mixture(rng, 2, d)
    evidence = Universal(p, q)(pairs)
    s1, s2 = pairs.first.full_covariance(), pairs.second.full_covariance()
    for e, (i, j) in enumerate(zip(pairs.i, pairs.j, strict=True)):
        both = np.concatenate([pairs.first.features[i], pairs.second.features[j]])
        errors = np.block([[s1[i], np.zeros((d, d))], [np.zeros((d, d)), s2[j]]])
        same = sum(
            w * multivariate_normal(np.tile(m, 2), np.tile(s, (2, 2)) + errors).pdf(both)
            for w, m, s in zip(p.weights, p.means, p.covariances, strict=True)
        )
        different = sum(
            w * v * multivariate_normal(np.concatenate([m, m + n]), np.block([[s, s], [s, s + r]]) + errors).pdf(both)
            for w, m, s in zip(p.weights, p.means, p.covariances, strict=True)
            for v, n, r in zip(q.weights, q.means, q.covariances, strict=True)
        )
        assert evidence.log_ratio[e] == pytest.approx(math.log(same / different), abs=1e-9)
    assert len(pairs) > 3 and np.all(evidence.log_error == 0.0)


@pytest.mark.slow
def test_the_rule_agrees_with_the_reference_integral():
    pairs = some_pairs(1)
    p, q = GaussianMixture([1.0], [[1.0]], [[[2.0]]]), GaussianMixture([0.4, 0.6], [[-2.0], [2.0]], np.ones((2, 1, 1)))
    grid = np.linspace(-9, 11, 1501)
    var_1, var_2 = pairs.first.full_covariance()[:, 0, 0], pairs.second.full_covariance()[:, 0, 0]
    expected = [
        naive.universal_1d(
            pairs.first.features[i, 0], var_1[i], pairs.second.features[j, 0], var_2[j],
            lambda m: norm.logpdf(m, 1.0, math.sqrt(2.0)),
            lambda m1, m2: np.log(0.4 * norm.pdf(m2 - m1, -2) + 0.6 * norm.pdf(m2 - m1, 2)),
            grid,
        )
        for i, j in zip(pairs.i[:4], pairs.j[:4], strict=True)
    ]  # fmt: skip
    np.testing.assert_allclose(Universal(p, q)(pairs).log_ratio[:4], expected, atol=1e-8)


# ---- special cases ----


@pytest.mark.parametrize("d", [1, 2, 3])
def test_a_neighbour_anywhere_is_the_uniform_rule(d):
    pairs = some_pairs(d)
    everywhere = Displacement(lambda m: np.full(len(m), 0.02))
    for position in (Flat(0.02), lambda m: np.full(len(m), 0.02)):
        evidence = Universal(position, everywhere)(pairs)
        np.testing.assert_allclose(evidence.log_ratio, Field(0.02)(pairs).log_ratio, atol=1e-10)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("d", [1, 2])
def test_a_neighbour_in_the_shell_is_the_close_objects_rule(d):
    pairs = some_pairs(d)
    expected = CloseObjects(SHELL_A, SHELL_B)(pairs).log_ratio
    evidence = Universal(Flat(0.1), Displacement(shell), relative_error=1e-3)(pairs)
    within(evidence, expected)
    assert evidence.log_error.max() < 5e-3


@pytest.mark.slow
def test_functions_of_both_positions_in_two_features_are_summed_over_four_dimensions():
    pairs = some_pairs(2)
    rule = Universal(lambda m: np.full(len(m), 0.1), lambda m1, m2: shell(m2 - m1), relative_error=3e-3)
    evidence = rule(pairs)
    within(evidence, CloseObjects(SHELL_A, SHELL_B)(pairs).log_ratio)
    assert 0.0 < evidence.log_error.max() < 0.02
    np.testing.assert_array_equal(rule(pairs).log_ratio, evidence.log_ratio)
    other = Universal(rule.position, rule.neighbour, relative_error=3e-3, seed=1)(pairs)
    assert np.any(other.log_ratio != evidence.log_ratio)


def test_samples_of_the_shell_give_the_close_objects_rule_within_their_stated_error():
    rng = np.random.default_rng(3)
    draws = rng.uniform(-SHELL_B, SHELL_B, (6000, 2))
    pairs = some_pairs(2)
    evidence = Universal(Flat(0.1), Samples(draws[shell(draws) > 0]))(pairs)
    within(evidence, CloseObjects(SHELL_A, SHELL_B)(pairs).log_ratio)
    assert 1e-3 < np.median(evidence.log_error) < 0.1


# ---- the same density in other forms ----


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("d", [1, 2])
def test_mixtures_given_as_functions_agree_with_the_closed_form(d):
    rng = np.random.default_rng(10 + d)
    pairs, p, q = some_pairs(d, n=2), mixture(rng, 2, d), mixture(rng, 2, d)
    exact = Universal(p, q)(pairs).log_ratio
    for rule in (
        Universal(p, Displacement(lambda m: q(m)), 1e-3),
        Universal(lambda m: p(m), q, 1e-3),
        Universal(lambda m: p(m), lambda m1, m2: q(m2 - m1), 1e-3),
    ):
        evidence = rule(pairs)
        within(evidence, exact)
        assert evidence.log_error.max() < 0.02


@pytest.mark.slow
def test_samples_of_both_densities_agree_with_the_closed_form_within_their_stated_error():
    rng = np.random.default_rng(20)
    p, q = GaussianMixture([1.0], [[1.0]], [[[1.0]]]), GaussianMixture([1.0], [[0.0]], [[[4.0]]])
    pairs = some_pairs(1)
    exact = Universal(p, q)(pairs).log_ratio
    off = []
    for _ in range(30):
        drawn = Universal(Samples(rng.normal(1, 1, (200, 1))), Samples(rng.normal(0, 2, (200, 1))))(pairs)
        off.append((drawn.log_ratio - exact) / drawn.log_error)
    # Numerator and denominator share the samples, so the stated error is slightly too large.
    assert 0.4 < np.std(off) < 1.2


def test_smoothed_samples_have_the_mean_and_variance_of_the_samples():
    rng = np.random.default_rng(21)
    points = rng.normal(0, [1.0, 3.0], (500, 2))
    smooth = Samples(points).smoothed()
    assert len(smooth) == 500 and smooth.d == 2
    factor = 500 ** (-2 / 6)
    np.testing.assert_allclose(np.asarray(smooth.covariances)[0], np.cov(points.T) * factor)
    x = np.stack(np.meshgrid(np.arange(-6, 6, 0.2), np.arange(-14, 14, 0.4)), axis=-1).reshape(-1, 2)
    assert smooth(x).sum() * 0.08 == pytest.approx(1.0, abs=1e-3)


def test_records_across_a_period_are_near():
    first = Records.of([[359.9, 0.0]], sigma=0.2, space=Plane((360.0, None)))
    second = Records.of([[0.1, 0.0]], sigma=0.2, space=Plane((360.0, None)))
    near = GaussianMixture([1.0], [[0.0, 0.0]], [np.eye(2)])
    ratio = Universal(Flat(0.01), near)(Radius(5.0)(first, second)).log_ratio
    plain = Radius(5.0)(Records.of([[0.0, 0.0]], sigma=0.2), Records.of([[0.2, 0.0]], sigma=0.2))
    np.testing.assert_allclose(ratio, Universal(Flat(0.01), near)(plain).log_ratio, atol=1e-9)


# ---- errors ----


def test_a_density_hit_by_no_sample_gives_a_bound_with_a_warning():
    first = Records.of([[0.0], [5.0]], sigma=0.04)
    pairs = Radius(60.0)(first, Records.of([[0.0], [3.8]], sigma=0.04))
    evidence = Universal(Flat(1.0), Displacement(shell))(pairs)
    # The shell is ten standard deviations away, so no sampled neighbour reaches a record.
    near = np.abs(pairs.residual[:, 0]) < 0.1
    assert np.isinf(evidence.log_error[near]).all() and np.all(evidence.log_ratio[near] > 30)
    assert np.all(evidence.log_ratio[near] <= CloseObjects(SHELL_A, SHELL_B)(pairs).log_ratio[near] + 1e-6)
    assert np.isfinite(evidence.log_ratio).all()
    assert (Field(0.1) + Universal(Flat(1.0), Displacement(shell)))(pairs).log_error.max() == np.inf


def test_errors_of_rules_add_in_squares_and_exact_rules_have_none():
    pairs = some_pairs(2)
    rng = np.random.default_rng(1)
    rough = Universal(Flat(0.1), Samples(rng.normal(0, 2, (200, 2))))
    alone = rough(pairs).log_error
    assert Field(0.1)(pairs).log_error is None and (Field(0.1) + Field(0.2))(pairs).log_error is None
    np.testing.assert_allclose((Field(0.1) + rough)(pairs).log_error, alone)
    np.testing.assert_allclose((rough + Field(0.1) + rough)(pairs).log_error, alone * math.sqrt(2))


def test_zero_pairs_have_no_evidence():
    nothing = Radius(3.0)(Records.of([0.0], sigma=1.0), Records.of([100.0], sigma=1.0))
    evidence = Universal(lambda m: np.ones(len(m)), lambda a, b: np.ones(len(a)))(nothing)
    assert evidence.log_ratio.shape == evidence.log_error.shape == (0,)


NO_DENSITY: Any = 0.3
NO_DISPLACEMENT: Any = Flat(1.0)
ONE = GaussianMixture([1.0], [[0.0, 0.0]], [np.eye(2)])


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda p: Universal(NO_DENSITY, ONE), "position is a float; give a GaussianMixture, Samples or a function"),
        (lambda p: Universal(Flat(1.0), NO_DISPLACEMENT), "neighbour is Flat; give Displacement"),
        (lambda p: Universal(Flat(1.0), ONE, relative_error=0.0), "relative_error is 0.0; give a number between"),
        (lambda p: Universal(lambda m: m[:, 0], Samples(np.eye(2))), r"give neighbour.smoothed\(\)"),
        (lambda p: Universal(Samples(np.eye(2)), lambda a, b: a[:, 0]), r"give position.smoothed\(\)"),
        (lambda p: Universal(Flat(1.0), Samples(np.ones((3, 1))))(p), "neighbour has 1 features, the records 2"),
        (lambda p: Universal(lambda m: -np.ones(len(m)), ONE)(p), "density of position is negative or not finite"),
        (lambda p: Universal(lambda m: 0.0 * m[:, 0], ONE)(p), "zero around every pair; give a density that covers"),
        (lambda p: Universal(lambda m: m, ONE)(p), r"a density gave shape \(.*, 2\) for .* positions; give one number"),
        (lambda p: Flat(0.0), "Flat: density is 0.0; give a positive number"),
        (lambda p: GaussianMixture([1.0], [0.0], [[1.0]]), r"give \(k,\), \(k, d\) and \(k, d, d\)"),
        (lambda p: GaussianMixture([0.5], [[0.0]], [[[1.0]]]), "have the sum 1"),
        (lambda p: GaussianMixture([1.0], [[0.0]], [[[-1.0]]]), "not positive definite"),
        (lambda p: Samples(np.ones(3)), r"points have shape \(3,\); give \(n, d\)"),
    ],
)
def test_invalid_densities_are_refused_with_a_clear_message(make, words):
    pairs = some_pairs(2)
    with pytest.raises(InputError, match=words):
        make(pairs)


def test_directions_are_refused():
    rng = np.random.default_rng(0)
    sky = sky_records(rng, np.zeros(2), np.array([0.0, 1.0]), scale_arcsec=1.0)
    with pytest.raises(InputError, match="records are directions; project both sources to one tangent plane"):
        Universal(Flat(1.0), ONE)(Radius(5.0)(sky, sky))
