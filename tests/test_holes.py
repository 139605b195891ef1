"""Holes and borders of a source are found to a fraction of the spacing of its records, without false holes."""

import math

import numpy as np
import pytest

import naive
from sameas import Plane, Records, Sphere
from sameas.estimate import coverage
from sameas.estimate.coverage import Coverage, Points, opened
from sameas.simulate.scenes import LonLatBox
from sameas.space import sphere_offset

SEEDS = range(5)
SIDE = 1000.0


def disc(points):
    return np.hypot(*(points - [400.0, 500.0]).T) < 150.0


def beyond_a_slanted_line(points):
    return (points - 500.0) @ [math.cos(0.5), math.sin(0.5)] > 200.0


def nowhere(points):
    return np.zeros(len(points), bool)


def shown(rng, points, dark, share, space=None):
    """(records of a ``share`` of the points outside ``dark``, records of all points, masks: in ``dark``, detected)."""
    dark = dark(points)
    there = (rng.uniform(size=len(points)) < share) & ~dark
    records = [Records.of(some, sigma=1e-3, space=space or Plane()) for some in (points[there], points)]
    return *records, dark, there


@pytest.mark.parametrize("dark", [disc, beyond_a_slanted_line, lambda x: disc(x) | (x[:, 0] > 700.0)])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_mask_and_an_edge_are_found_to_a_fraction_of_the_spacing(seed, dark):
    rng = np.random.default_rng(seed)
    first, second, dark, there = shown(rng, rng.uniform(0.0, SIDE, (6000, 2)), dark, 0.8)
    cover = Coverage.of(first, second)
    seen_1, seen_2 = cover.covered
    assert seen_1.all()
    assert (seen_2 & dark).mean() < 0.005 and (~seen_2 & ~dark).mean() < 0.005
    assert there[seen_2].mean() == pytest.approx(there[~dark].mean(), abs=0.006)
    assert cover.common_volume == pytest.approx((1.0 - dark.mean()) * SIDE**2, rel=0.02)


def false_share(first, second):
    """Share of records false_share marked as in holes, the larger of the two sources."""
    return max((~seen).mean() for seen in Coverage.of(first, second).covered)


@pytest.mark.parametrize("share", [0.1, 0.8])
def test_a_uniform_field_has_hardly_any_false_holes(share):
    said = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        first, second, _, _ = shown(rng, rng.uniform(0.0, SIDE, (6000, 2)), nowhere, share)
        strangers = Records.of(np.concatenate([first.features, rng.uniform(0.0, SIDE, (2000, 2))]), sigma=1e-3)
        said += [false_share(first, second), false_share(strangers, second)]
    assert np.mean(said) <= 0.001


def test_a_common_share_that_varies_over_the_field_is_no_hole():
    said = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        points = rng.uniform(0.0, SIDE, (6000, 2))
        there = rng.uniform(size=6000) < 0.4 + 0.5 * points[:, 0] / SIDE
        said.append(false_share(*(Records.of(some, sigma=1e-3) for some in (points[there], points))))
    assert np.mean(said) <= 0.001


def test_a_crowd_in_one_place_makes_no_holes_elsewhere():
    said_of_both, said_of_one = [], []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        crowd, even = rng.normal(500.0, 3.0, (1000, 2)), rng.uniform(0.0, SIDE, (3000, 2))
        points = np.concatenate([crowd, even])
        both = [Records.of(points[rng.uniform(size=4000) < 0.7], sigma=1e-3) for _ in range(2)]
        said_of_both.append(false_share(*both))
        strangers = Records.of(rng.uniform(0.0, SIDE, (3000, 2)), sigma=1e-3)
        said_of_one.append(false_share(Records.of(points, sigma=1e-3), strangers))
    assert np.mean(said_of_both) <= 0.001 and np.mean(said_of_one) <= 0.02


@pytest.mark.parametrize("share", [0.08, 0.8])
def test_a_region_with_few_objects_is_no_hole(share):
    said = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        clusters = [rng.normal(centre, 5.0, (2000, 2)) for centre in rng.uniform(100.0, 900.0, (9, 2))]
        points = np.concatenate([rng.uniform(0.0, SIDE, (2000, 2)), *clusters])
        sources = (Records.of(points[rng.uniform(size=len(points)) < f], sigma=1e-3) for f in (share, 0.8))
        said.append(np.mean(np.concatenate([~seen for seen in Coverage.of(*sources).covered])))
    assert np.mean(said) <= 0.002


@pytest.mark.parametrize(("d", "n"), [(1, 3000), (3, 20000)])
def test_holes_in_one_and_three_dimensions(d, n):
    rng = np.random.default_rng(d)
    points = rng.uniform(0.0, 100.0, (n, d))
    first, second, dark, there = shown(rng, points, lambda x: np.linalg.norm(x - 45.0, axis=1) < 30.0, 0.8)
    seen = Coverage.of(first, second).covered[1]
    assert (seen & dark).mean() < 0.006 and (~seen & ~dark).mean() < 0.003
    assert there[seen].mean() == pytest.approx(there[~dark].mean(), abs=0.006)


def test_a_hole_across_the_period_boundary_is_found():
    rng = np.random.default_rng(1)
    points = np.stack([rng.uniform(0.0, 360.0, 5000), rng.uniform(0.0, 100.0, 5000)], axis=1)
    first, second, dark, _ = shown(
        rng, points, lambda x: (x[:, 0] > 340.0) | (x[:, 0] < 30.0), 0.8, Plane(periods=(360.0, None))
    )
    seen = Coverage.of(first, second).covered[1]
    assert (seen & dark).mean() < 0.003 and (~seen & ~dark).mean() < 0.003


def test_a_hole_near_the_pole_is_found():
    rng = np.random.default_rng(2)
    points = LonLatBox((0.0, 360.0), (80.0, 90.0)).draw(rng, 8000)

    def masked(sky):
        lon, lat = sky.T
        return np.hypot(*sphere_offset(lon, lat, np.full(len(sky), 30.0), np.full(len(sky), 88.0)).T) < 3.0 * 3600.0

    first, second, dark, there = shown(rng, points, masked, 0.8, Sphere())
    seen = Coverage.of(first, second).covered[1]
    assert dark[points[:, 1] > 89.5].all() and dark.mean() > 0.08
    assert (seen & dark).mean() < 0.003 and (~seen & ~dark).mean() < 0.002
    assert there[seen].mean() == pytest.approx(there[~dark].mean(), abs=0.003)


def test_a_frame_in_an_all_sky_catalogue_is_found():
    rng = np.random.default_rng(3)
    sky = LonLatBox((0.0, 360.0), (-90.0, 90.0)).draw(rng, 100_000)
    first, second, dark, there = shown(
        rng, sky, lambda x: (np.abs(x[:, 0] - 200.0) > 12.0) | (np.abs(x[:, 1] - 40.0) > 9.0), 0.8, Sphere()
    )
    seen_1, seen_2 = Coverage.of(first, second).covered
    assert 500 < len(first) < 1200 and seen_1.all()
    assert (seen_2 & dark).sum() < 30 and (~seen_2 & ~dark).sum() < 30
    assert there[seen_2].mean() == pytest.approx(there[~dark].mean(), abs=0.02)


def test_the_order_of_the_rows_does_not_matter():
    rng = np.random.default_rng(4)
    first, second, _, _ = shown(rng, rng.uniform(0.0, SIDE, (20_000, 2)), disc, 0.05)
    order_1, order_2 = rng.permutation(len(first)), rng.permutation(len(second))
    mixed = [Records.of(x.features[order], sigma=1e-3) for x, order in ((first, order_1), (second, order_2))]
    for seen, again, order in zip(
        Coverage.of(first, second).covered, Coverage.of(*mixed).covered, (order_1, order_2), strict=True
    ):
        assert (seen[order] == again).all() and not (seen.all() and order is order_2)


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("periods", [(None,), (30.0,), (None, None), (None, 25.0), (30.0, 25.0), (None, None, None)])
def test_empty_discs_agree_with_the_definition(seed, periods):
    rng, d = np.random.default_rng(seed), len(periods)
    one, two = rng.uniform(0.0, 24.0, (150, d)), rng.uniform(0.0, 24.0, (20, d))
    here, there = (Points.of(Records.of(x, sigma=1.0, space=Plane(periods))) for x in (one, two))
    density, wanted = rng.uniform(0.5, 20.0, 150) / 24.0**d, rng.uniform(size=150) < 0.8
    expected, beyond, least = 1.2, 0.1, 2.0
    unit = math.pi ** (d / 2) / math.gamma(d / 2 + 1)
    radius = (expected / unit / density) ** (1 / d)
    inner = radius - beyond * density ** (-1 / d)
    wraps = np.array([period or math.inf for period in periods])
    slow = naive.inside_empty_discs(one, two, wanted, radius, inner, least, wraps)
    assert (opened(here, there, wanted, density, expected, beyond, least) == slow).all()
    assert slow.any() and not slow.all()


# ---- cost without holes ----


def test_a_uniform_field_is_not_searched_and_one_with_a_mask_is(monkeypatch):
    searched = []

    def within_holes(here, seen, *about):
        searched.append(1)
        return ~seen

    monkeypatch.setattr(coverage, "within_holes", within_holes)
    rng = np.random.default_rng(12)
    place = rng.uniform(0.0, 1000.0, (4000, 2))
    shown = rng.uniform(size=4000) < 0.8
    masked = shown & (np.hypot(*(place - [410.0, 530.0]).T) > 100.0)
    for kept, expected in ((shown, False), (masked, True)):
        searched.clear()
        first, second = Records.of(place[kept], sigma=0.5), Records.of(place, sigma=0.5)
        assert len(Coverage.of(first, second).covered[1]) == 4000
        assert bool(searched) == expected
