"""Holes and borders of a source are found to a fraction of the spacing of its records, without false holes."""

import math

import numpy as np
import pytest

import naive
from sameas import Plane, Records, Sphere
from sameas.estimate import coverage
from sameas.estimate.coverage import Coverage
from sameas.estimate.holes import DISC, Points, in_empty_discs
from sameas.simulate.scenes import LonLatBox
from sameas.space import sphere_offset

SEEDS = range(5)
SIDE = 1000.0


def disc(points):
    return np.hypot(*(points - [400.0, 500.0]).T) < 150.0


def beyond_a_slanted_line(points):
    return (points - 500.0) @ [math.cos(0.5), math.sin(0.5)] > 200.0


def no_hole(points):
    return np.zeros(len(points), bool)


def two_sources(rng, points, hole, share, space=None):
    """A source of a ``share`` of the points outside ``hole``, one of all; masks: in the hole, detected."""
    hole = hole(points)
    detected = (rng.uniform(size=len(points)) < share) & ~hole
    records = [Records.of(some, sigma=1e-3, space=space or Plane()) for some in (points[detected], points)]
    return *records, hole, detected


@pytest.mark.parametrize("hole", [disc, beyond_a_slanted_line, lambda x: disc(x) | (x[:, 0] > 700.0)])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_mask_and_an_edge_are_found_to_a_fraction_of_the_spacing(seed, hole):
    rng = np.random.default_rng(seed)
    first, second, hole, detected = two_sources(rng, rng.uniform(0.0, SIDE, (6000, 2)), hole, 0.8)
    coverage_of_both = Coverage.of(first, second)
    covered_1, covered_2 = coverage_of_both.covered
    assert covered_1.all()
    assert (covered_2 & hole).mean() < 0.005 and (~covered_2 & ~hole).mean() < 0.005
    assert detected[covered_2].mean() == pytest.approx(detected[~hole].mean(), abs=0.006)
    assert coverage_of_both.common_volume == pytest.approx((1.0 - hole.mean()) * SIDE**2, rel=0.02)


def false_share(first, second):
    """Share of the records marked as in holes; the larger one of both sources."""
    return max((~covered).mean() for covered in Coverage.of(first, second).covered)


@pytest.mark.parametrize("share", [0.1, 0.8])
def test_a_uniform_field_has_hardly_any_false_holes(share):
    false_shares = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        first, second, _, _ = two_sources(rng, rng.uniform(0.0, SIDE, (6000, 2)), no_hole, share)
        unrelated = Records.of(np.concatenate([first.features, rng.uniform(0.0, SIDE, (2000, 2))]), sigma=1e-3)
        false_shares += [false_share(first, second), false_share(unrelated, second)]
    assert np.mean(false_shares) <= 0.001


def test_a_common_share_that_varies_over_the_field_is_no_hole():
    false_shares = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        points = rng.uniform(0.0, SIDE, (6000, 2))
        detected = rng.uniform(size=6000) < 0.4 + 0.5 * points[:, 0] / SIDE
        false_shares.append(false_share(*(Records.of(some, sigma=1e-3) for some in (points[detected], points))))
    assert np.mean(false_shares) <= 0.001


def test_a_crowd_in_one_place_makes_no_holes_elsewhere():
    shares_of_both, shares_of_one = [], []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        crowd, even = rng.normal(500.0, 3.0, (1000, 2)), rng.uniform(0.0, SIDE, (3000, 2))
        points = np.concatenate([crowd, even])
        both = [Records.of(points[rng.uniform(size=4000) < 0.7], sigma=1e-3) for _ in range(2)]
        shares_of_both.append(false_share(*both))
        unrelated = Records.of(rng.uniform(0.0, SIDE, (3000, 2)), sigma=1e-3)
        shares_of_one.append(false_share(Records.of(points, sigma=1e-3), unrelated))
    assert np.mean(shares_of_both) <= 0.001 and np.mean(shares_of_one) <= 0.02


@pytest.mark.parametrize("share", [0.08, 0.8])
def test_a_region_with_few_objects_is_no_hole(share):
    false_shares = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        clusters = [rng.normal(centre, 5.0, (2000, 2)) for centre in rng.uniform(100.0, 900.0, (9, 2))]
        points = np.concatenate([rng.uniform(0.0, SIDE, (2000, 2)), *clusters])
        sources = (Records.of(points[rng.uniform(size=len(points)) < f], sigma=1e-3) for f in (share, 0.8))
        false_shares.append(np.mean(np.concatenate([~covered for covered in Coverage.of(*sources).covered])))
    assert np.mean(false_shares) <= 0.002


@pytest.mark.parametrize(("d", "n"), [(1, 3000), (3, 20000)])
def test_holes_in_one_and_three_dimensions(d, n):
    rng = np.random.default_rng(d)
    points = rng.uniform(0.0, 100.0, (n, d))
    first, second, hole, detected = two_sources(rng, points, lambda x: np.linalg.norm(x - 45.0, axis=1) < 30.0, 0.8)
    covered = Coverage.of(first, second).covered[1]
    assert (covered & hole).mean() < 0.006 and (~covered & ~hole).mean() < 0.003
    assert detected[covered].mean() == pytest.approx(detected[~hole].mean(), abs=0.006)


def test_a_hole_across_the_period_boundary_is_found():
    rng = np.random.default_rng(1)
    points = np.stack([rng.uniform(0.0, 360.0, 5000), rng.uniform(0.0, 100.0, 5000)], axis=1)
    first, second, hole, _ = two_sources(
        rng, points, lambda x: (x[:, 0] > 340.0) | (x[:, 0] < 30.0), 0.8, Plane(periods=(360.0, None))
    )
    covered = Coverage.of(first, second).covered[1]
    assert (covered & hole).mean() < 0.003 and (~covered & ~hole).mean() < 0.003


def test_a_hole_near_the_pole_is_found():
    rng = np.random.default_rng(2)
    points = LonLatBox((0.0, 360.0), (80.0, 90.0)).draw(rng, 8000)

    def masked(sky):
        lon, lat = sky.T
        return np.hypot(*sphere_offset(lon, lat, np.full(len(sky), 30.0), np.full(len(sky), 88.0)).T) < 3.0 * 3600.0

    first, second, hole, detected = two_sources(rng, points, masked, 0.8, Sphere())
    covered = Coverage.of(first, second).covered[1]
    assert hole[points[:, 1] > 89.5].all() and hole.mean() > 0.08
    assert (covered & hole).mean() < 0.003 and (~covered & ~hole).mean() < 0.002
    assert detected[covered].mean() == pytest.approx(detected[~hole].mean(), abs=0.003)


def test_a_frame_in_an_all_sky_catalogue_is_found():
    rng = np.random.default_rng(3)
    sky = LonLatBox((0.0, 360.0), (-90.0, 90.0)).draw(rng, 100_000)
    first, second, hole, detected = two_sources(
        rng, sky, lambda x: (np.abs(x[:, 0] - 200.0) > 12.0) | (np.abs(x[:, 1] - 40.0) > 9.0), 0.8, Sphere()
    )
    covered_1, covered_2 = Coverage.of(first, second).covered
    assert 500 < len(first) < 1200 and covered_1.all()
    assert (covered_2 & hole).sum() < 30 and (~covered_2 & ~hole).sum() < 30
    assert detected[covered_2].mean() == pytest.approx(detected[~hole].mean(), abs=0.02)


def test_the_order_of_the_rows_does_not_matter():
    rng = np.random.default_rng(4)
    first, second, _, _ = two_sources(rng, rng.uniform(0.0, SIDE, (20_000, 2)), disc, 0.05)
    order_1, order_2 = rng.permutation(len(first)), rng.permutation(len(second))
    mixed = [Records.of(x.features[order], sigma=1e-3) for x, order in ((first, order_1), (second, order_2))]
    for covered, covered_again, order in zip(
        Coverage.of(first, second).covered, Coverage.of(*mixed).covered, (order_1, order_2), strict=True
    ):
        assert (covered[order] == covered_again).all() and not (covered.all() and order is order_2)


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("periods", [(None,), (30.0,), (None, None), (None, 25.0), (30.0, 25.0), (None, None, None)])
def test_empty_discs_agree_with_the_definition(seed, periods):
    rng, d = np.random.default_rng(seed), len(periods)
    one, two = rng.uniform(0.0, 24.0, (150, d)), rng.uniform(0.0, 24.0, (20, d))
    own, other = (Points.of(Records.of(x, sigma=1.0, space=Plane(periods)), np.ones(x.shape[1])) for x in (one, two))
    density, wanted = rng.uniform(0.5, 20.0, 150) / 24.0**d, rng.uniform(size=150) < 0.8
    expected, beyond, least = 1.2, 0.1, 2.0
    unit = math.pi ** (d / 2) / math.gamma(d / 2 + 1)
    radius = (expected / unit / density) ** (1 / d)
    inner = radius - beyond * density ** (-1 / d)
    wraps = np.array([period or math.inf for period in periods])
    slow = naive.inside_empty_discs(one, two, wanted, radius, inner, least, wraps)
    assert (in_empty_discs(own, other, wanted, density, expected, beyond, least) == slow).all()
    assert slow.any() and not slow.all()


# ---- cost ----


@pytest.mark.parametrize("at_once", [1_000, 1_000_000])
def test_a_crowd_in_a_hole_is_in_it_however_few_of_its_points_are_listed_at_once(at_once):
    """Each of a crowd has all others in its disc: the lists of all would fill the memory."""
    rng = np.random.default_rng(5)
    even, crowd = rng.uniform(0.0, SIDE, (4000, 2)), rng.normal([400.0, 500.0], 0.5, (4000, 2))
    even = even[~disc(even)]
    first, second = Records.of(even, sigma=1e-3), Records.of(np.concatenate([even, crowd]), sigma=1e-3)
    own, other = (Points.of(records, np.full(2, 1e-3)) for records in (second, first))
    every, density = np.ones(len(second), bool), np.full(len(second), len(even) / SIDE**2)
    inside = in_empty_discs(own, other, every, density, DISC, 0.0, 2.0, at_once)
    assert inside[: len(even)].mean() < 0.01 and inside[len(even) :].all()


def test_a_uniform_field_is_not_searched_and_one_with_a_mask_is(monkeypatch):
    searched = []

    def within_holes(own, covered, *others):
        searched.append(1)
        return ~covered

    monkeypatch.setattr(coverage, "within_holes", within_holes)
    rng = np.random.default_rng(12)
    points = rng.uniform(0.0, 1000.0, (4000, 2))
    detected = rng.uniform(size=4000) < 0.8
    masked = detected & (np.hypot(*(points - [410.0, 530.0]).T) > 100.0)
    for kept, expected in ((detected, False), (masked, True)):
        searched.clear()
        first, second = Records.of(points[kept], sigma=0.5), Records.of(points, sigma=0.5)
        assert len(Coverage.of(first, second).covered[1]) == 4000
        assert bool(searched) == expected
