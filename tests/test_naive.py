"""The reference implementations against published values, quadrature, explicit sums, SciPy and 3-D vectors."""

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import gammaln, logsumexp, xlog1py, xlogy
from scipy.stats import gennorm, multivariate_normal, norm

import naive
from sameas.records import Records
from sameas.score.pairs import reliability
from sameas.simulate.scenes import line, poisson_field
from sameas.space import ARCSEC_PER_RADIAN, Plane, Sphere

quickly = settings(max_examples=60, deadline=None, derandomize=True)


def unit(lon_deg, lat_deg):
    """Unit vector of a direction, and its local east and north."""
    lon, lat = np.radians([lon_deg, lat_deg])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    return up, east, np.cross(up, east)


def random_covariance(rng, d, scale=1.0):
    root = rng.standard_normal((d, d)) * scale
    return root @ root.T + 0.1 * scale**2 * np.eye(d)


def random_ratios(rng, n1, n2, share):
    return {(i, j): rng.normal(1, 3) for i in range(n1) for j in range(n2) if rng.uniform() < share}


# ---- residuals ----


@pytest.mark.slow
@quickly
@given(
    lon_1=st.floats(0, 360),
    lat_1=st.floats(-89.99, 89.99),
    lon_2=st.floats(0, 360),
    lat_2=st.floats(-89.99, 89.99),
    seed=st.integers(0, 1000),
)
def test_sphere_residual_is_the_great_circle_with_parallel_transported_covariances(lon_1, lat_1, lon_2, lat_2, seed):
    (up_1, east_1, north_1), (up_2, east_2, north_2) = unit(lon_1, lat_1), unit(lon_2, lat_2)
    axis = np.cross(up_2, up_1)
    if np.linalg.norm(axis) < 1e-4 or up_1 @ up_2 < -0.99:
        return
    axis /= np.linalg.norm(axis)
    separation = math.atan2(np.linalg.norm(np.cross(up_2, up_1)), up_1 @ up_2)
    # Position angle at each end of the great circle from 2 to 1; at the midpoint it is their mean.
    along = [np.cross(axis, up) for up in (up_1, up_2)]
    angle_1 = math.atan2(along[0] @ east_1, along[0] @ north_1)
    angle_2 = math.atan2(along[1] @ east_2, along[1] @ north_2)
    middle = angle_2 + math.remainder(angle_1 - angle_2, 2 * math.pi) / 2
    rng = np.random.default_rng(seed)
    cov_1, cov_2 = random_covariance(rng, 2), random_covariance(rng, 2)
    a = Records.of([[lon_1, lat_1]], covariance=cov_1, space=Sphere())
    b = Records.of([[lon_2, lat_2]], covariance=cov_2, space=Sphere())
    delta, cov = naive.residual(a, 0, b, 0)
    expected = separation * ARCSEC_PER_RADIAN * np.array([math.sin(middle), math.cos(middle)])
    np.testing.assert_allclose(delta, expected, rtol=0, atol=1e-6 * ARCSEC_PER_RADIAN)

    # Parallel transport keeps the components along and across the great circle.
    halfway = math.sin(middle), math.cos(middle)
    transported = np.zeros((2, 2))
    for own, t, east, north in ((cov_1, along[0], east_1, north_1), (cov_2, along[1], east_2, north_2)):
        to_circle = np.array([[t @ east, t @ north], [axis @ east, axis @ north]])
        to_halfway = np.array([[halfway[0], -halfway[1]], [halfway[1], halfway[0]]])
        transported += to_halfway @ to_circle @ own @ to_circle.T @ to_halfway.T
    np.testing.assert_allclose(cov, transported, rtol=0, atol=1e-6 * np.trace(transported))


def test_tiny_separations_near_the_pole_and_across_zero_keep_their_precision():
    tiny = 1e-3 / 3600
    a = Records.of([[0.0, 89.9999], [360.0 - tiny, 0.0]], sigma=1.0, space=Sphere())
    b = Records.of([[0.0, 89.9999 - tiny], [tiny, 0.0]], sigma=1.0, space=Sphere())
    np.testing.assert_allclose(naive.residual(a, 0, b, 0)[0], [0, 1e-3], rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(naive.residual(a, 1, b, 1)[0], [-2e-3, 0], rtol=1e-6, atol=1e-15)


@quickly
@given(x=st.floats(-1000, 1000), y=st.floats(-1000, 1000))
def test_periodic_difference_lies_in_the_half_open_period(x, y):
    space = Plane(periods=(360.0, None))
    a, b = (Records.of([[v, v]], sigma=[[1.0, 2.0]], space=space) for v in (x, y))
    delta, cov = naive.residual(a, 0, b, 0)
    assert -180 < delta[0] <= 180
    assert math.isclose(math.remainder(delta[0] - (x - y), 360), 0, abs_tol=1e-9)
    assert delta[1] == x - y
    np.testing.assert_array_equal(cov, np.diag([2.0, 8.0]))


def test_a_difference_of_half_a_period_is_positive():
    space = Plane(periods=(360.0,))
    a, b = (Records.of([[v]], sigma=1.0, space=space) for v in (270.0, 90.0))
    assert naive.residual(a, 0, b, 0)[0] == naive.residual(b, 0, a, 0)[0] == 180.0


# ---- gate and groups ----


def test_wider_gates_hold_more_pairs_and_swapping_the_sources_transposes_them():
    rng = np.random.default_rng(5)
    a, b = (
        Records.of(rng.uniform(0, 8, (15, 2)), covariance=np.stack([random_covariance(rng, 2) for _ in range(15)]))
        for _ in range(2)
    )
    narrow, wide = naive.candidates(a, b, completeness=0.5), naive.candidates(a, b, completeness=0.999)
    assert narrow < wide
    assert naive.candidates(a, b, sigmas=1.0) < naive.candidates(a, b, sigmas=3.0)
    assert {(i, j) for j, i in naive.candidates(b, a, completeness=0.999)} == wide
    with pytest.raises(ValueError, match="either"):
        naive.candidates(a, b)


@pytest.mark.slow
def test_the_chi_square_gate_keeps_the_stated_share_of_true_pairs():
    rng = np.random.default_rng(6)
    cov, n, inside = random_covariance(rng, 3), 2000, 0
    for x in rng.multivariate_normal(np.zeros(3), 2 * cov, n):
        a, b = Records.of([x], covariance=cov), Records.of(np.zeros((1, 3)), covariance=cov)
        inside += len(naive.candidates(a, b, completeness=0.9))
    assert abs(inside / n - 0.9) < 4 * math.sqrt(0.09 / n)


@quickly
@given(seed=st.integers(0, 10_000), n1=st.integers(0, 8), n2=st.integers(0, 8), share=st.floats(0, 0.5))
def test_components_agree_with_scipy(seed, n1, n2, share):
    pairs = list(random_ratios(np.random.default_rng(seed), n1, n2, share))
    groups = naive.components(n1, n2, pairs)
    assert sorted(i for one, _ in groups for i in one) == list(range(n1))
    assert sorted(j for _, two in groups for j in two) == list(range(n2))
    if n1 + n2:
        i, j = np.array(pairs, int).reshape(-1, 2).T
        graph = coo_array((np.ones(len(i)), (i, n1 + j)), shape=(n1 + n2, n1 + n2))
        count, label = connected_components(graph, directed=False)
        assert count == len(groups)
        assert all(len({*label[list(one)], *label[[n1 + k for k in two]]}) == 1 for one, two in groups)


# ---- evidence ----


def test_log_normal_agrees_with_scipy():
    rng = np.random.default_rng(1)
    for d in (1, 2, 4):
        cov, delta = random_covariance(rng, d), rng.standard_normal(d)
        assert math.isclose(naive.log_normal(delta, cov), multivariate_normal(np.zeros(d), cov).logpdf(delta))


def test_rules_with_a_constant_differ_by_that_constant():
    delta, cov = np.array([1.0, 2.0]), np.array([[2.0, 0.3], [0.3, 1.0]])
    c = math.sqrt(0.07 * (1 - 0.8) / 0.8)
    assert math.isclose(naive.calibrated(delta, cov, 0.8, 0.07), naive.constant_cost(delta, cov, c))
    assert math.isclose(naive.field(delta, cov, c**2), naive.constant_cost(delta, cov, c))


def test_log_interval_agrees_with_quadrature_in_tails_and_narrow_intervals():
    cases = [(-1, 1), (0.5, 0.5 + 1e-9), (-1e-9, 1e-9), (30, 31), (30, 30.001), (-50, -40), (-3, 40), (2, 2.4)]
    for low, high in cases:
        edge = min(abs(low), abs(high)) if low * high > 0 else 0.0
        integral = quad(lambda x, e=edge: math.exp((e * e - x * x) / 2), low, high, epsabs=0, epsrel=1e-12)[0]
        expected = math.log(integral) - edge**2 / 2 - math.log(2 * math.pi) / 2
        assert math.isclose(float(naive.log_interval(low, high)), expected, rel_tol=1e-10), (low, high)
    assert naive.log_interval(1.0, 1.0) == -math.inf


@pytest.mark.parametrize(("delta", "expected"), [((30, 2), -346.0532), ((2, 1), -3.894715)])
def test_close_objects_density_has_the_published_values(delta, expected):
    delta, sigma = np.array(delta, float), np.array([1, 0.7])
    a, b, cov = np.array([1.1, 0.8]), np.array([4.0, 3.0]), np.diag(sigma**2)
    assert naive.close_objects_log_density(delta, sigma, a, b) == pytest.approx(expected, rel=2e-7)
    exact = naive.log_normal(delta, cov) - naive.close_objects_correlated(delta, cov, a, b)
    assert exact == pytest.approx(expected, rel=2e-7)


@quickly
@given(seed=st.integers(0, 10_000), d=st.integers(1, 4))
def test_close_objects_density_is_the_difference_of_the_boxes(seed, d):
    rng = np.random.default_rng(seed)
    sigma, a = rng.uniform(0.3, 2, (2, d))
    b = a + rng.uniform(0.5, 3, d)
    delta = rng.uniform(-1, 1, d) * (b + sigma)

    def box(c):
        return np.prod(norm.cdf((delta + c) / sigma) - norm.cdf((delta - c) / sigma))

    expected = (box(b) - box(a)) / (np.prod(2 * b) - np.prod(2 * a))
    assert math.exp(naive.close_objects_log_density(delta, sigma, a, b)) == pytest.approx(expected, rel=1e-7)


@pytest.mark.slow
def test_close_objects_density_integrates_to_one():
    sigma, a, b = np.array([0.6]), np.array([1.1]), np.array([3.0])
    total = quad(lambda x: math.exp(naive.close_objects_log_density(np.array([x]), sigma, a, b)), -9, 9, limit=200)
    assert total[0] == pytest.approx(1, abs=1e-7)


@quickly
@given(seed=st.integers(0, 10_000))
def test_close_objects_limit_is_that_of_equal_boxes(seed):
    rng = np.random.default_rng(seed)
    d = int(rng.integers(1, 4))
    cov, a, delta = random_covariance(rng, d), rng.uniform(0.3, 2, d), rng.uniform(-4, 4, d)
    near = naive.close_objects(delta, cov, a, a * (1 + 1e-7))
    assert naive.close_objects_limit(delta, cov, a) == pytest.approx(near, abs=1e-5)


@pytest.mark.slow
@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000))
def test_correlated_close_objects_uses_the_boxes_of_the_correlated_normal(seed):
    rng = np.random.default_rng(seed)
    cov, a = random_covariance(rng, 2), rng.uniform(0.3, 2, 2)
    b, delta = a + rng.uniform(0.5, 3, 2), rng.uniform(-4, 4, 2)
    normal = multivariate_normal(delta, cov)
    outer, inner = (normal.cdf(c, lower_limit=-c) for c in (b, a))
    expected = (outer - inner) / (np.prod(2 * b) - np.prod(2 * a))
    braces = naive.log_normal(delta, cov) - naive.close_objects_correlated(delta, cov, a, b)
    assert math.exp(braces) == pytest.approx(expected, abs=1e-8)


@pytest.mark.slow
def test_without_correlation_the_correlated_rule_equals_the_plain_rule_in_the_tails_too():
    for delta in ((0.0, 0.0), (3.0, -1.0), (30.0, 2.0), (4.0, 60.0)):
        for scale in (1.0, 0.01):
            cov = np.diag([1, 0.49]) * scale**2
            args = np.array(delta), cov, np.array([1.1, 0.8]), np.array([4.0, 3.0])
            assert naive.close_objects_correlated(*args) == pytest.approx(naive.close_objects(*args), rel=1e-9)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("c", [0.01, 0.3, 1.0, 3.0, 20.0, 1e4])
def test_generalized_gaussian_keeps_variance_and_peak(c):
    sigma = 0.7
    peak = math.exp(naive.generalized_gaussian(0.0, sigma, c))
    assert peak == pytest.approx(math.erf(c / sigma / math.sqrt(2)) / (2 * c), rel=1e-12)
    ends = 40 * math.hypot(sigma, c)
    points = [-2 * c, -c, 0, c, 2 * c]
    mass, second = (
        quad(
            lambda x, m=m: x**m * math.exp(naive.generalized_gaussian(x, sigma, c)),
            -ends,
            ends,
            points=points,
            limit=500,
        )[0]
        for m in (0, 2)
    )
    assert mass == pytest.approx(1, rel=1e-5)
    assert second == pytest.approx(sigma**2 + c**2 / 3, rel=1e-4)


def test_generalized_gaussian_agrees_with_scipys_gennorm():
    sigma, c = 1.0, 2.5
    value = [math.exp(naive.generalized_gaussian(x, sigma, c)) for x in (0.0, 1.0, 2.0, 4.0)]
    # The shape from the ratio of two values, then everything else from scipy.
    shape = math.log(math.log(value[0] / value[2]) / math.log(value[0] / value[1])) / math.log(2)
    scale = math.log(value[0] / value[1]) ** (-1 / shape)
    np.testing.assert_allclose(value, gennorm(shape, scale=scale).pdf([0, 1, 2, 4]), rtol=1e-9)


def test_the_paper_form_is_near_the_exact_rule_in_the_centre_and_nan_in_the_tails():
    cov, a, b = np.diag([1, 0.49]), np.array([1.1, 0.8]), np.array([4.0, 3.0])
    for x in (0.0, 1.0, 2.0, 4.0):
        args = np.array([x, 0.5]), cov, a, b
        assert naive.close_objects_paper(*args) == pytest.approx(naive.close_objects(*args), abs=0.1)
    assert math.isnan(naive.close_objects_paper(np.array([30.0, 0.0]), cov, a, b))


@pytest.mark.slow
def test_universal_rule_contains_the_uniform_and_the_close_objects_rule():
    grid = np.linspace(-40, 40, 4001)
    inside = np.full_like(grid, -math.log(80))
    args = 0.3, 0.5, 1.4, 0.8
    delta, cov = np.array([0.3 - 1.4]), np.array([[1.3]])
    anywhere = naive.universal_1d(*args, lambda m: inside, lambda m1, m2: -math.log(80) + 0 * m1 * m2, grid)
    assert anywhere == pytest.approx(naive.field(delta, cov, 1 / 80), abs=1e-9)

    def shell(m1, m2):  # the middle of a grid cell decides, so the box edges lie between grid points
        distance = np.abs(m1 - m2)
        return np.where((distance > 1.11) & (distance < 4.01), -math.log(2 * 2.9), -np.inf)

    near = naive.universal_1d(*args, lambda m: inside, shell, grid)
    assert near == pytest.approx(naive.close_objects(delta, cov, np.array([1.11]), np.array([4.01])), abs=1e-4)


# ---- hypotheses and priors ----


@pytest.mark.parametrize(("n1", "n2"), [(0, 0), (0, 3), (1, 1), (2, 3), (4, 4), (3, 6)])
def test_the_number_of_enumerated_hypotheses_is_the_formula(n1, n2):
    found = list(naive.hypotheses(n1, n2, [(i, j) for i in range(n1) for j in range(n2)]))
    assert len(found) == len(set(found)) == naive.number_of_hypotheses(n1, n2)
    assert all(len({i for i, _ in h}) == len({j for _, j in h}) == len(h) for h in found)


def test_only_allowed_pairs_are_used():
    allowed = [(0, 1), (1, 1), (2, 0)]
    assert set(naive.hypotheses(3, 2, allowed)) == {
        (), ((0, 1),), ((1, 1),), ((2, 0),), ((0, 1), (2, 0)), ((1, 1), (2, 0))
    }  # fmt: skip


@pytest.mark.parametrize(
    ("n1", "n2", "q1", "q2"), [(2, 3, 0.1, 0.3), (4, 4, 0.5, 0.05), (1, 5, 0.6, 0.6), (3, 0, 0.2, 0.9)]
)
def test_prior_of_common_objects_is_the_sum_over_the_number_of_objects(n1, n2, q1, q2):
    def summed(k):
        n = n1 + n2 - k
        m = np.arange(n, n + 2000)
        counts = gammaln(m + 1) - gammaln(k + 1) - gammaln(n1 - k + 1) - gammaln(n2 - k + 1) - gammaln(m - n + 1)
        seen = xlog1py(n1, -q1) + xlogy(n1 - k, q2) + xlogy(n2 - k, q1) + xlog1py(n2, -q2) + xlogy(m - n, q1 * q2)
        number = math.log(math.comb(n1, k) * math.comb(n2, k) * math.factorial(k))
        return logsumexp(counts + seen) - number

    difference = [naive.common_objects_log_prior(k, n1, n2, q1, q2) - summed(k) for k in range(min(n1, n2) + 1)]
    np.testing.assert_allclose(difference, difference[0], atol=1e-9)


def test_without_missed_objects_only_the_full_hypothesis_is_possible():
    values = [naive.common_objects_log_prior(k, 3, 3, 0.0, 0.0) for k in range(4)]
    assert values[:3] == [-math.inf] * 3 and math.isfinite(values[3])


@pytest.mark.parametrize(("n1", "n2"), [(1, 1), (3, 2), (5, 8), (10, 10)])
def test_linear_prior_is_the_least_squares_line(n1, n2):
    k = np.arange(min(n1, n2) + 1)
    values = [naive.common_objects_log_prior(int(i), n1, n2, 0.2, 0.4) for i in k]
    assert naive.common_objects_slope(n1, n2, 0.2, 0.4) == pytest.approx(np.polyfit(k, values, 1)[0])
    assert naive.common_objects_linear(3, 0, 4, 0.2, 0.4) == 0.0


# ---- the best hypothesis and the posterior ----


@quickly
@given(seed=st.integers(0, 10_000), n1=st.integers(0, 5), n2=st.integers(0, 5), share=st.floats(0, 1))
def test_best_hypothesis_is_the_optimal_assignment_and_the_best_count(seed, n1, n2, share):
    rng = np.random.default_rng(seed)
    ratio = random_ratios(rng, n1, n2, share)
    log_odds = rng.normal(0, 2)
    weight = np.zeros((n1, n2))
    for (i, j), value in ratio.items():
        weight[i, j] = max(value + log_odds, 0.0)
    i, j = linear_sum_assignment(weight, maximize=True)
    score, pairs = naive.best(n1, n2, ratio, lambda k: naive.per_pair(k, log_odds))
    assert score == pytest.approx(weight[i, j].sum())
    assert pairs == {(int(a), int(b)) for a, b in zip(i, j, strict=True) if weight[a, b] > 0}
    totals = naive.best_per_k(n1, n2, ratio)
    assert score == pytest.approx(max(w + k * log_odds for k, w in enumerate(totals)))
    finite = [w for w in totals if w > -math.inf]
    assert totals[: len(finite)] == finite
    assert all(np.diff(finite, 2) <= 1e-9)


@quickly
@given(seed=st.integers(0, 10_000), n1=st.integers(0, 5), n2=st.integers(0, 4), share=st.floats(0, 1))
def test_posterior_of_every_record_sums_to_one_and_swapping_the_sources_transposes_it(seed, n1, n2, share):
    rng = np.random.default_rng(seed)
    ratio = random_ratios(rng, n1, n2, share)
    p, none_1, none_2 = naive.posterior(n1, n2, ratio, lambda k: naive.common_objects_log_prior(k, n1, n2, 0.1, 0.3))
    for i in range(n1):
        assert none_1[i] + sum(v for pair, v in p.items() if pair[0] == i) == pytest.approx(1)
    for j in range(n2):
        assert none_2[j] + sum(v for pair, v in p.items() if pair[1] == j) == pytest.approx(1)
    swapped = {(j, i): v for (i, j), v in ratio.items()}
    q, other_2, other_1 = naive.posterior(
        n2, n1, swapped, lambda k: naive.common_objects_log_prior(k, n2, n1, 0.3, 0.1)
    )
    np.testing.assert_allclose([*p.values(), *none_1, *none_2], [*(q[j, i] for i, j in p), *other_1, *other_2])


def test_posterior_of_one_pair_is_the_logistic_of_its_odds():
    p, none_1, none_2 = naive.posterior(1, 1, {(0, 0): 1.3}, lambda k: naive.per_pair(k, -0.4))
    assert p[0, 0] == pytest.approx(1 / (1 + math.exp(-0.9)))
    assert none_1[0] == none_2[0] == pytest.approx(1 - p[0, 0])


def test_with_a_linear_prior_groups_are_independent():
    rng = np.random.default_rng(2)
    ratio = random_ratios(rng, 5, 5, 0.25)
    whole, *_ = naive.posterior(5, 5, ratio, lambda k: naive.per_pair(k, -1.0))
    for one, _ in naive.components(5, 5, ratio):
        own = {pair: value for pair, value in ratio.items() if pair[0] in one}
        part, *_ = naive.posterior(5, 5, own, lambda k: naive.per_pair(k, -1.0))
        assert part == pytest.approx({pair: whole[pair] for pair in own})


@pytest.mark.slow
def test_stated_probability_is_the_observed_frequency_in_a_poisson_field_with_false_detections():
    rng = np.random.default_rng(11)
    density, q1, q2, false_1, false_2 = 1.0, 0.2, 0.3, 0.2, 0.1
    # METHOD 4.3: what only one source shows, per unit area
    lone_1, lone_2 = density * (1 - q1) * q2 + false_1, density * q1 * (1 - q2) + false_2
    log_odds = math.log(density * (1 - q1) * (1 - q2) / (lone_1 * lone_2))
    stated, happened = [], []
    for _ in range(110):
        scene = poisson_field(
            rng, density=density, extent=(4.0, 4.0), q1=q1, q2=q2, sigma_1=(0.03, 0.18), sigma_2=0.07,
            false_1=false_1, false_2=false_2, correlated=True, space=Plane(periods=(4.0, 4.0)),
        )  # fmt: skip
        truth = set(zip(*map(np.ndarray.tolist, scene.true_pairs()), strict=True))
        pairs = naive.candidates(scene.first, scene.second, completeness=0.99)
        for one, two in naive.components(len(scene.first), len(scene.second), pairs):
            rows, columns = sorted(one), sorted(two)
            ratio = {
                (i, j): naive.log_normal(*naive.residual(scene.first, rows[i], scene.second, columns[j]))
                for i in range(len(rows))
                for j in range(len(columns))
                if (rows[i], columns[j]) in pairs
            }
            p, *_ = naive.posterior(len(rows), len(columns), ratio, lambda k: naive.per_pair(k, log_odds))
            stated += p.values()
            happened += [(rows[i], columns[j]) in truth for i, j in p]
    table = reliability(stated, happened, bins=8, width="adaptive")
    assert len(stated) > 1500
    assert ((table.stated > 0.1) & (table.stated < 0.9)).any()
    assert (np.abs(table.deviation) < 3.5).all()
    assert table.expected_calibration_error < 0.02


@pytest.mark.slow
def test_the_close_objects_rule_beats_the_uniform_rule_on_a_line_of_targets_as_in_the_paper():
    rng = np.random.default_rng(3)
    spacing, q, sigma = 3.0, 0.5, math.sqrt(2) * np.ones(2)
    right, total = {"close": 0, "uniform": 0}, 0
    for _ in range(400):
        scene = line(rng, n=2, spacing_sigmas=spacing, q1=q, q2=q)
        n1, n2 = len(scene.first), len(scene.second)
        total += n1 + n2
        truth = set(zip(*map(np.ndarray.tolist, scene.true_pairs()), strict=True))
        residuals = {(i, j): naive.residual(scene.first, i, scene.second, j) for i in range(n1) for j in range(n2)}
        rules = {
            "close": lambda r: naive.close_objects(*r, 1.1 * sigma, 2.0 * spacing * sigma),
            "uniform": lambda r: naive.field(*r, 1 / (1000 * sigma.prod())),
        }
        for name, rule in rules.items():
            ratio = {pair: rule(r) for pair, r in residuals.items()}
            prior = partial(naive.common_objects_log_prior, n1=n1, n2=n2, q1=q, q2=q)
            _, claimed = naive.best(n1, n2, ratio, prior)
            wrong = claimed ^ truth
            right[name] += n1 + n2 - len({i for i, _ in wrong}) - len({j for _, j in wrong})
    assert right["close"] / total == pytest.approx(0.91, abs=0.03)  # METHOD 8
    assert right["close"] > right["uniform"] + 0.01 * total
