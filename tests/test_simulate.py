"""Simulated scenes have the stated counts and errors, and do not leak the truth."""

import math
from typing import Any

import numpy as np
import pytest
from benchmarks.misstated import with_outliers
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.stats import chi2, kstest, spearmanr

import naive
from sameas.errors import InputError
from sameas.simulate import blended_field, counterparts
from sameas.simulate.scenes import (
    Cap,
    LonLatBox,
    SimulatedScene,
    WholeSky,
    chance_area_steradians,
    crowded_sky,
    grid,
    line,
    poisson_field,
    sky_field,
)
from sameas.space import ARCSEC_PER_RADIAN, Plane, displaced


def vectors(features):
    lon, lat = np.radians(features.T)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)


def common_mahalanobis(scene):
    pairs = zip(*scene.true_pairs(), strict=True)
    return [naive.mahalanobis(*naive.residual(scene.first, i, scene.second, j)) for i, j in pairs]


def field_scene(seed=0, **changes):
    usual: dict[str, Any] = {"density": 2.0, "extent": (20.0, 20.0), "q1": 0.2, "q2": 0.4, "sigma_1": 0.1}
    usual["sigma_2"] = (0.05, 0.5)
    return poisson_field(np.random.default_rng(seed), **(usual | changes))


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 1000),
    d=st.integers(1, 4),
    density=st.floats(0, 3),
    q1=st.floats(0, 1),
    q2=st.floats(0, 1),
    correlated=st.booleans(),
)
def test_true_pairs_are_the_records_of_one_object(seed, d, density, q1, q2, correlated):
    scene = field_scene(seed, density=density, extent=(2.0,) * d, q1=q1, q2=q2, false_1=0.5, correlated=correlated)
    rows_1, rows_2 = scene.true_pairs()
    np.testing.assert_array_equal(scene.truth_1[rows_1], scene.truth_2[rows_2])
    assert {*scene.truth_1[rows_1]} == {*scene.truth_1} & {*scene.truth_2}
    assert len({*scene.truth_1}) == len(scene.first) and len({*scene.truth_2}) == len(scene.second)
    assert not scene.false_1[rows_1].any() and not scene.false_2.any()
    assert (np.diff(rows_1) > 0).all()


def test_the_same_generator_gives_the_same_scene():
    one, two, other = field_scene(1), field_scene(1), field_scene(2)
    np.testing.assert_array_equal(one.first.features, two.first.features)
    np.testing.assert_array_equal(one.truth_2, two.truth_2)
    assert len(one.first) != len(other.first)


def test_a_poisson_field_has_the_stated_counts():
    volume, counts = 400.0, []
    for seed in range(60):
        scene = field_scene(seed, false_1=0.5, false_2=0.25)
        counts.append(
            [len(scene.true_pairs()[0]), len(scene.first), len(scene.second), scene.false_1.sum(), scene.false_2.sum()]
        )
    expected = volume * np.array([2 * 0.8 * 0.6, 2 * 0.8 + 0.5, 2 * 0.6 + 0.25, 0.5, 0.25])
    deviation = (np.mean(counts, axis=0) - expected) / np.sqrt(expected / 60)
    assert (np.abs(deviation) < 4).all()
    # the variance of a Poisson count is its mean
    assert (np.abs(np.var(counts, axis=0, ddof=1) / expected - 1) < 4 * math.sqrt(2 / 59)).all()


@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize("d", [1, 3])
def test_errors_in_a_plane_are_as_stated(d, correlated):
    extent = (20.0,) * d
    scene = field_scene(3, density=3000 / 20.0**d, extent=extent, correlated=correlated, space=Plane(periods=extent))
    assert scene.first.covariance.shape[1] == (d * (d + 1) // 2 if correlated else d)
    assert kstest(common_mahalanobis(scene), chi2(d).cdf).pvalue > 1e-3
    assert (scene.first.features >= 0).all() and (scene.first.features <= 20).all()


def test_sigmas_are_log_uniform_between_the_bounds():
    sigma = np.sqrt(field_scene(4, density=10.0).second.covariance[:, 0])
    assert kstest(np.log(sigma / 0.05) / math.log(10), "uniform").pvalue > 1e-3


def test_the_row_order_is_independent_of_the_truth():
    sky = sky_field(np.random.default_rng(5), n_common=2000, n_only_1=500, n_only_2=500)
    for scene in (sky, field_scene(5, density=5.0, false_1=1.0, false_2=1.0)):
        rows_1, rows_2 = scene.true_pairs()
        lone = np.ones(len(scene.first))
        lone[rows_1] = 0
        for x, y in ((rows_1, rows_2), (np.arange(len(lone)), lone), (np.arange(len(lone)), scene.truth_1)):
            assert spearmanr(x, y).pvalue > 1e-3
        np.testing.assert_array_equal(scene.first.ids, np.arange(len(scene.first)))


def test_scenes_may_have_empty_sources():
    for scene in (
        field_scene(density=0.0),
        field_scene(q1=1.0, correlated=True),
        sky_field(np.random.default_rng(0), n_common=0, n_only_1=3, n_only_2=0),
        sky_field(np.random.default_rng(0), n_common=0, n_only_1=0, n_only_2=3, elliptical=True),
    ):
        assert isinstance(scene, SimulatedScene)
        assert all(len(rows) == 0 for rows in scene.true_pairs())


# ---- the papers' targets ----


def test_neighbours_on_a_grid_differ_by_the_spacing_in_one_feature_only():
    scene = grid(np.random.default_rng(0), shape=(3, 4), spacing_sigmas=2e6, q1=0, q2=0, sigma_1=3e-6, sigma_2=4e-6)
    steps = scene.first.features / 10
    assert np.abs(steps - steps.round()).max() < 1e-4
    assert {tuple(x) for x in steps.round().astype(int).tolist()} == {(i, j) for i in range(3) for j in range(4)}


def test_a_line_is_a_grid_of_one_row_with_the_stated_errors_and_misses():
    rng, squares, seen = np.random.default_rng(1), [], 0
    for _ in range(300):
        scene = line(rng, n=5, spacing_sigmas=1.5, q1=0.3, q2=0.0, sigma_1=1.0, sigma_2=2.0, d=3)
        assert scene.first.d == 3 and len(scene.second) == 5
        squares += common_mahalanobis(scene)
        seen += len(scene.first)
    assert kstest(squares, chi2(3).cdf).pvalue > 1e-3
    assert abs(seen / 1500 - 0.7) < 4 * math.sqrt(0.21 / 1500)


# ---- the sphere ----


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    lon=st.floats(0, 360), lat=st.floats(-90, 90), distance=st.floats(1e-6, 600_000), angle=st.floats(0, 2 * math.pi)
)
def test_displaced_moves_by_the_distance_and_starts_in_the_direction(lon, lat, distance, angle):
    offset = distance * np.array([[math.sin(angle), math.cos(angle)]])
    start = np.array([[lon, lat]])
    end = displaced(start, offset)
    moved = naive.sphere_difference(*end[0], lon, lat)
    assert np.hypot(*moved) == pytest.approx(distance, rel=1e-9, abs=1e-8)
    if abs(lat) < 89.999:
        # The direction at the midpoint rotated back by half of θ is the direction at the start.
        back = naive.rotation_matrix(-naive.half_rotation(*end[0], lon, lat)) @ moved
        np.testing.assert_allclose(back, offset[0], rtol=0, atol=1e-7 * distance + 1e-8)


@pytest.mark.parametrize("area", [WholeSky(), Cap(10, 80, 30), Cap(0, -90, 120), LonLatBox((350, 400), (-20, 70))])
def test_areas_are_filled_uniformly(area):
    drawn = area.draw(np.random.default_rng(2), 4000)
    everywhere = WholeSky().draw(np.random.default_rng(3), 40_000)
    if isinstance(area, Cap):
        centre = vectors(np.array([[area.lon_deg, area.lat_deg]]))[0]
        limit = math.cos(math.radians(area.radius_deg))
        assert (vectors(drawn) @ centre >= limit - 1e-12).all()
        inside = vectors(everywhere) @ centre >= limit
    elif isinstance(area, LonLatBox):
        inside = ((everywhere[:, 0] - 350) % 360 < 50) & (np.abs(everywhere[:, 1] - 25) < 45)
    else:
        inside = np.ones(len(everywhere), bool)
    share = area.steradians() / (4 * math.pi)
    assert abs(inside.mean() - share) < 4 * math.sqrt(share * (1 - share) / 40_000) + 1e-12
    for axis in range(3):
        assert kstest(vectors(drawn)[:, axis], vectors(everywhere[inside])[:, axis]).pvalue > 1e-3


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("elliptical", [False, True])
@pytest.mark.parametrize("area", [WholeSky(), Cap(0.0, 90.0, 0.0003)])
def test_errors_on_the_sphere_are_as_stated_near_the_pole_too(area, elliptical):
    scene = sky_field(
        np.random.default_rng(7), n_common=3000, n_only_1=10, n_only_2=20, area=area, elliptical=elliptical
    )
    assert (len(scene.first), len(scene.second)) == (3010, 3020)
    assert kstest(common_mahalanobis(scene), chi2(2).cdf).pvalue > 1e-3


def test_elliptical_errors_keep_the_mean_variance_and_lie_in_all_directions():
    scene = sky_field(
        np.random.default_rng(8), n_common=5000, n_only_1=0, n_only_2=0, sigma_arcsec=0.2, elliptical=True
    )
    xx, xy, yy = scene.first.covariance.T
    np.testing.assert_allclose((xx + yy) / 2, 0.04)
    assert kstest(np.arctan2(2 * xy, yy - xx) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3


def chance_candidates(scene):
    """Mean number per record of other objects' records within 3 √(σ₁² + σ₂²)."""
    sigma_1, sigma_2 = (np.sqrt(s.covariance[:, 0]) for s in (scene.first, scene.second))
    one, two = (cKDTree(vectors(s.features)) for s in (scene.first, scene.second))
    reach = 3 * math.hypot(sigma_1.max(), sigma_2.max()) / ARCSEC_PER_RADIAN
    found = one.sparse_distance_matrix(two, reach, output_type="ndarray")
    near = found["v"] * ARCSEC_PER_RADIAN < 3 * np.hypot(sigma_1[found["i"]], sigma_2[found["j"]])
    return (near & (scene.truth_1[found["i"]] != scene.truth_2[found["j"]])).sum() / len(scene.first)


@pytest.mark.parametrize(("lam", "n"), [(0.05, 40_000), (0.5, 20_000), (2.0, 20_000), (8.0, 20_000)])
def test_a_crowded_sky_has_the_stated_number_of_chance_candidates(lam, n):
    scene = crowded_sky(np.random.default_rng(9), n, lam, centre_deg=(0.0, 90.0))
    assert len(scene.first) == len(scene.second) == n
    assert len(scene.true_pairs()[0]) == pytest.approx(n * 8 / 9, abs=1)
    # up to 2 % are lost at the edge of the cap
    tolerance = 5 * math.sqrt(lam * (1 + lam) / n)
    assert chance_candidates(scene) == pytest.approx(lam * 0.99, abs=tolerance + 0.015 * lam)


def test_chance_area_without_spread_of_sigma_is_the_circle_of_three_sigma():
    assert chance_area_steradians(100, 100.0, 1.0) * ARCSEC_PER_RADIAN**2 == pytest.approx(math.pi * 18)
    narrow = chance_area_steradians(7, 0.3, (0.2, 0.2 * (1 + 1e-9)))
    assert narrow == pytest.approx(chance_area_steradians(7, 0.3, 0.2), rel=1e-6)


@pytest.mark.slow
def test_a_million_rows_are_simulated():
    scene = crowded_sky(np.random.default_rng(0), 1_000_000, 0.5)
    assert len(scene.first) == 1_000_000


# ---- refusals ----


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: field_scene(q1=1.5), "q1 is 1.5; give a probability"),
        (lambda: field_scene(density=-1.0), "density is -1.0; give a number that is not negative"),
        (lambda: field_scene(extent=(1.0, 0.0)), "one positive size per feature"),
        (lambda: field_scene(sigma_1=(0.2, 0.1)), "first: sigma is .*low ≤ high"),
        (lambda: field_scene(sigma_2=0.0), "second: sigma is 0.0; give a positive number"),
        (lambda: line(np.random.default_rng(0), n=0, spacing_sigmas=1, q1=0, q2=0), "one positive count"),
        (lambda: line(np.random.default_rng(0), n=2, spacing_sigmas=-1, q1=0, q2=0), "spacing_sigmas is -1"),
        (lambda: sky_field(np.random.default_rng(0), n_common=-1, n_only_1=0, n_only_2=0), "none below 0"),
        (lambda: crowded_sky(np.random.default_rng(0), 10**6, 1e-7), "skies; give fewer rows"),
        (lambda: crowded_sky(np.random.default_rng(0), 0, 1.0), "give positive numbers"),
        (lambda: Cap(0, 0, 0), "radius_deg is 0"),
        (lambda: LonLatBox((0, 370), (0, 1)), "span up to 360"),
        (lambda: LonLatBox((0, 10), (5, 5)), "within ±90"),
    ],
)
def test_invalid_scenes_are_refused_with_a_clear_message(make, words):
    with pytest.raises(InputError, match=words):
        make()


def span_deg(records):
    """The larger side of the box around the records, degrees."""
    lon, lat = np.ptp(records.features, axis=0)
    return max(float(lon * math.cos(math.radians(records.features[0, 1]))), float(lat))


def sigma_arcsec(records):
    return np.sqrt(records.covariance[:, 0])


def test_the_options_of_a_blended_field():
    usual = blended_field(np.random.default_rng(1), objects=2_000)
    wide = blended_field(np.random.default_rng(1), objects=2_000, per_deg2=5_000.0)
    assert (usual.parts < 0).all(axis=1).sum() == 200
    assert span_deg(wide.second) == pytest.approx(2.0 * span_deg(usual.second), rel=0.05)
    assert sigma_arcsec(usual.first).min() >= 0.1 and sigma_arcsec(usual.first).max() <= 0.4


def test_the_options_of_counterparts_and_outliers():
    made = counterparts(np.random.default_rng(1), sources=60, records=2_000)
    assert len(made.scene.true_pairs()[0]) == 54
    assert sigma_arcsec(made.scene.first).min() >= 1.0 and sigma_arcsec(made.scene.first).max() <= 2.0
    scene = crowded_sky(np.random.default_rng(1), 200, 0.1)
    far = with_outliers(np.random.default_rng(2), scene, 1.0, sigmas=50.0)
    moved = np.linalg.norm(vectors(far.first.features) - vectors(scene.first.features), axis=1) * ARCSEC_PER_RADIAN
    np.testing.assert_allclose(moved, 50.0 * sigma_arcsec(scene.first), rtol=1e-6)
