"""Every rule agrees with its formula, in a plane and on the sphere, also for extreme numbers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

import naive
from problems import KINDS, plane_records, sky_records
from sameas import Box, CloseObjects, ConstantCost, Field, InputError, PoissonField, Radius, Records
from sameas.evidence import DetectionField, Errors, Evidence, Rule, log_neighbour_density, log_surface_density
from sameas.evidence.close import DIAGONAL

# METHOD 3.2 gives −346.0532 and −3.894715; more digits by quadrature, see the test that recomputes them.
CHECKS = [((30.0, 2.0), -346.0532), ((2.0, 1.0), -3.894715)]
SIGMA, A, B = np.array([1.0, 0.7]), np.array([1.1, 0.8]), np.array([4.0, 3.0])


def plane_pairs(d, seed=0, kinds=("full", "axis sigmas"), gate=4.0):
    rng = np.random.default_rng([seed, d])
    return Box(gate)(*(plane_records(rng, 20, d, scale=0.1 * d, kind=kind) for kind in kinds))


def sky_pairs(seed=0):
    rng = np.random.default_rng(seed)
    lon, lat = rng.uniform(0, 360, 30), 90 - rng.uniform(0, 0.01, 30)
    first = sky_records(rng, lon, lat, scale_arcsec=3.0, kind="full")
    second = sky_records(rng, lon + rng.normal(0, 5, 30), lat, scale_arcsec=5.0, kind="axis sigmas")
    return Radius(4.0)(first, second)


SCENES = {"1-D": lambda: plane_pairs(1, kinds=("one sigma",) * 2), "2-D": lambda: plane_pairs(2),
          "3-D": lambda: plane_pairs(3, kinds=KINDS[1:]), "sphere": sky_pairs}  # fmt: skip


def per_pair(pairs, formula):
    """The formula of (Δ, Σ, i, j) for every pair, computed from the records."""
    return np.array([
        formula(*naive.residual(pairs.first, i, pairs.second, j), i, j)
        for i, j in zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)
    ])  # fmt: skip


N = 30
VARYING_1, VARYING_2 = np.geomspace(0.1, 9.0, N), np.geomspace(5.0, 0.2, N)
MIXED = Errors(scales=(0.8, 1.5, 6.0), shares=(0.3, 0.6, 0.1))


def mixture(delta, cov):
    return math.log(
        sum(w * math.exp(naive.log_normal(delta, s**2 * cov)) for s, w in zip(MIXED.scales, MIXED.shares, strict=True))
    )


RULES = {
    "field": (lambda n1, n2: Field(0.3), lambda x, s, i, j: naive.field(x, s, 0.3)),
    "field, local": (lambda n1, n2: Field(VARYING_2[:n2]), lambda x, s, i, j: naive.field(x, s, VARYING_2[j])),
    "constant cost": (lambda n1, n2: ConstantCost(0.4), lambda x, s, i, j: naive.constant_cost(x, s, 0.4)),
    "detection": (
        lambda n1, n2: ConstantCost.calibrated(0.9, 0.2),
        lambda x, s, i, j: naive.calibrated(x, s, 0.9, 0.2),
    ),
    "detection, local": (
        lambda n1, n2: DetectionField(VARYING_2[:n2] / 6, VARYING_1[:n1]),
        lambda x, s, i, j: naive.calibrated(x, s, VARYING_2[j] / 6, VARYING_1[i]),
    ),
    "poisson": (
        lambda n1, n2: PoissonField(2.0, 0.3, 0.7),
        lambda x, s, i, j: naive.log_normal(x, s) + math.log(2.0 / (0.3 * 0.7)),
    ),
    "poisson, local": (
        lambda n1, n2: PoissonField((VARYING_1[:n1], VARYING_2[:n2]), VARYING_1[:n1], VARYING_2[:n2]),
        lambda x, s, i, j: naive.log_normal(x, s) - 0.5 * math.log(VARYING_1[i] * VARYING_2[j]),
    ),
    "poisson, mixed errors": (
        lambda n1, n2: PoissonField(2.0, 0.3, 0.7, MIXED),
        lambda x, s, i, j: mixture(x, s) + math.log(2.0 / (0.3 * 0.7)),
    ),
    "close objects": (
        lambda n1, n2: CloseObjects(0.2, 0.9, correlation=DIAGONAL),
        lambda x, s, i, j: naive.close_objects(x, s, np.full(len(x), 0.2), np.full(len(x), 0.9)),
    ),
    "close objects, a = 0": (
        lambda n1, n2: CloseObjects(0.0, 0.9, correlation=DIAGONAL),
        lambda x, s, i, j: naive.close_objects(x, s, np.zeros(len(x)), np.full(len(x), 0.9)),
    ),
    "close objects, surface": (
        lambda n1, n2: CloseObjects(0.3, correlation=DIAGONAL),
        lambda x, s, i, j: naive.close_objects_limit(x, s, np.full(len(x), 0.3)),
    ),
}


@pytest.mark.slow_after(6)
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("name", RULES)
def test_rules_agree_with_their_formulas(name, scene):
    pairs = SCENES[scene]()
    make, formula = RULES[name]
    evidence = make(len(pairs.first), len(pairs.second))(pairs)
    assert len(pairs) > 20 and all(np.shape(values) == (len(pairs),) for values in evidence.terms.values())
    np.testing.assert_allclose(evidence.log_ratio, per_pair(pairs, formula), rtol=1e-9, atol=1e-8)


@pytest.mark.slow
def test_boxes_may_differ_by_feature_and_one_may_be_empty():
    pairs = plane_pairs(2)
    for a, b in (((0.1, 0.3), (0.7, 0.5)), ((0.1, 0.3), (0.1, 0.5)), ((0.0, 0.3), (0.4, 0.3))):
        expected = per_pair(pairs, lambda x, s, i, j, a=a, b=b: naive.close_objects(x, s, np.array(a), np.array(b)))
        np.testing.assert_allclose(CloseObjects(a, b, DIAGONAL)(pairs).log_ratio, expected, rtol=1e-9, atol=1e-8)


# ---- the braces of METHOD 3.2 at extreme arguments ----


def by_quadrature(delta, sigma, a, b):
    """The braces as an integral of the normal over the four rectangles of the shell, relative to its peak."""

    def side(v, low, high):
        peak = min(max(delta[v], low), high)
        top = norm.logpdf(peak, delta[v], sigma[v])
        area, _ = quad(lambda m: math.exp(norm.logpdf(m, delta[v], sigma[v]) - top), low, high, epsabs=0, epsrel=1e-12)
        return top + math.log(area)

    pieces = [
        side(0, a[0], b[0]) + side(1, -b[1], b[1]), side(0, -b[0], -a[0]) + side(1, -b[1], b[1]),
        side(0, -a[0], a[0]) + side(1, a[1], b[1]), side(0, -a[0], a[0]) + side(1, -b[1], -a[1]),
    ]  # fmt: skip
    return np.logaddexp.reduce(pieces) - math.log(4 * (b[0] * b[1] - a[0] * a[1]))


@pytest.mark.parametrize("delta, published", CHECKS)
def test_braces_have_the_published_values(delta, published):
    ours = log_neighbour_density(np.array([delta]), SIGMA[None], A, B)[0]
    assert ours == pytest.approx(published, abs=6e-5 if published < -100 else 6e-7)
    assert ours == pytest.approx(naive.close_objects_log_density(np.array(delta), SIGMA, A, B), abs=1e-9)
    assert ours == pytest.approx(by_quadrature(delta, SIGMA, A, B), abs=1e-6)


def test_braces_of_a_large_residual_do_not_underflow():
    # One feature: the far tail is that of the nearest edge, Q(t) ≈ φ(t)/t · (1 − 1/t²) with t = (x − b)/σ.
    for x in (1e2, 1e4, 1e6):
        ours = log_neighbour_density(np.array([[x]]), np.ones((1, 1)), np.array([1.0]), np.array([2.0]))[0]
        t = x - 2.0
        expected = norm.logpdf(t) - math.log(t) + math.log1p(-1 / t**2) - math.log(2.0)
        assert ours == pytest.approx(expected, rel=1e-9)


def test_braces_of_tiny_errors_do_not_cancel():
    # Deep inside the inner box only the nearer wall contributes, z = (a − x)/σ away.
    sigma, a, b = 1e-3, 1.0, 3.0
    for x in (0.0, 0.2, 0.9):
        ours = log_neighbour_density(np.array([[x]]), np.full((1, 1), sigma), np.array([a]), np.array([b]))[0]
        walls = np.logaddexp(norm.logsf((a - x) / sigma), norm.logsf((a + x) / sigma))
        assert ours == pytest.approx(walls - math.log(2 * (b - a)), rel=1e-12)
    # Well within the shell the density is 1/(V_b − V_a).
    ours = log_neighbour_density(np.array([[2.0]]), np.full((1, 1), sigma), np.array([a]), np.array([b]))[0]
    assert ours == pytest.approx(-math.log(2 * (b - a)), abs=1e-12)


@pytest.mark.parametrize("sigma", [1e2, 1e5, 1e8, 1e12, 1e17])
def test_braces_of_errors_far_wider_than_the_boxes_are_the_normal_density(sigma):
    # The mean of a normal over a region much smaller than σ is its density: λ → 1.
    for z in (0.0, 0.7, 3.0):
        delta = np.full((1, 2), z * sigma)
        ours = log_neighbour_density(delta, np.full((1, 2), sigma), np.array([0.5, 0.4]), np.array([2.0, 0.8]))[0]
        assert ours == pytest.approx(2 * norm.logpdf(z) - 2 * math.log(sigma), abs=30 * (1 + z) / sigma**2 + 1e-9)


@pytest.mark.slow
@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    x=st.lists(st.floats(-50, 50), min_size=2, max_size=2),
    sigma=st.lists(st.floats(1e-3, 30), min_size=2, max_size=2),
    a=st.lists(st.just(0.0) | st.floats(1e-3, 3), min_size=2, max_size=2),
    more=st.lists(st.just(0.0) | st.floats(1e-3, 5), min_size=2, max_size=2),
)
def test_braces_agree_with_the_reference_everywhere(x, sigma, a, more):
    delta, sigma, a = np.array(x), np.array(sigma), np.array(a)
    b = a + np.array(more)
    if not (np.all(b > 0) and np.any(b > a)):
        return
    expected = naive.close_objects_log_density(delta, sigma, a, b)
    ours = log_neighbour_density(delta[None], sigma[None], a, b)[0]
    assert ours == pytest.approx(expected, rel=1e-8, abs=1e-7)


def test_the_surface_rule_is_the_limit_of_thin_shells():
    rng = np.random.default_rng(0)
    delta, sigma, a = rng.normal(0, 3, (50, 2)), rng.uniform(0.1, 3, (50, 2)), np.array([0.7, 1.3])
    surface = log_surface_density(delta, sigma, a)
    thin = log_neighbour_density(delta, sigma, a, a * (1 + 1e-6))
    np.testing.assert_allclose(surface, thin, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("rule", [CloseObjects(0.5, 2.0), CloseObjects(0.5), CloseObjects(0.0, 2.0)])
def test_the_ratio_of_close_objects_is_largest_at_zero_residual(rule):
    first = Records.of(np.linspace(0, 6, 30)[:, None] * [1.0, 1.0], sigma=0.2)
    second = Records.of([[0.0, 0.0]], sigma=0.2)
    pairs = Radius(40.0)(first, second)
    ratio = rule(pairs).log_ratio[np.argsort(pairs.i)]
    assert np.isfinite(ratio).all() and ratio[0] == ratio.max() and ratio[0] > 0


# ---- rules together ----


def test_rules_add_term_by_term():
    pairs = plane_pairs(2)
    one, two, three = Field(0.3), ConstantCost(0.2), PoissonField(1.0, 2.0, 3.0)
    together = (one + two + three)(pairs)
    np.testing.assert_allclose(
        together.log_ratio, sum(rule(pairs).log_ratio for rule in (one, two, three)), rtol=1e-13, atol=1e-12
    )
    assert set(together.terms) == {"position", "elsewhere", "cost", "densities"}
    right = (one + (two + three))(pairs)
    np.testing.assert_allclose(right.log_ratio, together.log_ratio, rtol=1e-13, atol=1e-12)
    assert len((one + (two + three)).parts()) == 3


def test_evidence_is_the_sum_of_its_terms():
    evidence = Evidence({"a": np.array([1.0, 2.0]), "b": np.array([0.5, -3.0])})
    np.testing.assert_array_equal(evidence.log_ratio, [1.5, -1.0])


def test_rules_of_zero_pairs_are_empty():
    nothing = Box()(Records.of([0.0], sigma=1.0), Records.of([100.0], sigma=1.0))
    for make, _ in RULES.values():
        assert make(1, 1)(nothing).log_ratio.shape == (0,)


def test_errors_mixture_is_a_density():
    sigma = 0.3
    first = Records.of(np.arange(-20, 20, 0.01), sigma=sigma)
    pairs = Radius(200.0)(first, Records.of([0.0], sigma=sigma))
    assert np.exp(MIXED.log_density(pairs)).sum() * 0.01 == pytest.approx(1.0, abs=1e-9)
    # A component of share 0 changes nothing.
    same = Errors(scales=(2.0, 9.0), shares=(1.0, 0.0)).log_density(pairs)
    np.testing.assert_allclose(same, Errors(scales=(2.0,), shares=(1.0,)).log_density(pairs), rtol=1e-14)


# ---- messages ----


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda p: ConstantCost(0.0), "C is 0.0; give a positive density"),
        (lambda p: ConstantCost(math.nan), "C is nan; give a positive density"),
        (lambda p: Field(0.0)(p), "Field: density is zero, negative or not finite"),
        (lambda p: Field(np.ones(3))(p), r"Field: density has shape \(3,\); give a number or \(20,\)"),
        (lambda p: PoissonField(1.0, -1.0, 1.0)(p), "PoissonField: only_1 is zero, negative or not finite"),
        (lambda p: PoissonField(math.nan, 1.0, 1.0)(p), "PoissonField: common is zero, negative or not finite"),
        (lambda p: PoissonField((np.ones(20), np.ones(7)), 1.0, 1.0)(p), r"common\[1\] has shape \(7,\)"),
        (lambda p: DetectionField(1.0, 1.0)(p), "detection_probability is 1 or more"),
        (lambda p: DetectionField(0.5, 0.0)(p), "density is zero, negative or not finite"),
        (lambda p: CloseObjects(-1.0, 2.0), "a is -1.0; give distances of zero or more"),
        (lambda p: CloseObjects(math.nan, 2.0), "a is nan; give distances"),
        (lambda p: CloseObjects(0.0), "a is 0 and b is not given; give b"),
        (lambda p: CloseObjects(2.0, 1.0), "b is 1.0 with a 2.0; give b ≥ a"),
        (lambda p: CloseObjects(1.0, 1.0), "larger in one, or no b"),
        (lambda p: CloseObjects(0.0, (0.0, 1.0)), "above zero in every feature"),
        (lambda p: CloseObjects((1.0, 1.0), (2.0, 2.0, 2.0)), "a has 2 features, b 3"),
        (lambda p: CloseObjects((0.1, 0.1, 0.1), 1.0)(p), "a has 3 numbers for 2 features"),
        (lambda p: Errors(scales=(1.0, 2.0)), "2 scales but 1 shares; give one share per scale"),
        (lambda p: Errors(scales=(), shares=()), "0 scales"),
        (lambda p: Errors(scales=(0.0,)), "scales must be positive"),
        (lambda p: Errors(scales=(math.nan,)), "scales must be positive"),
        (lambda p: Errors(scales=(math.inf,)), "scales must be positive"),
        (lambda p: Errors(shares=(math.nan,)), "shares non-negative with the sum 1"),
        (lambda p: Errors(shares=(0.9,)), "shares non-negative with the sum 1"),
    ],
)
def test_invalid_rules_are_refused_with_a_clear_message(make, words):
    pairs = plane_pairs(2)
    with pytest.raises(InputError, match=words):
        make(pairs)


def test_the_interface_of_rules_is_not_a_rule():
    with pytest.raises(TypeError, match="Rule is the interface of decision rules; use one of them"):
        Rule()(plane_pairs(2))
