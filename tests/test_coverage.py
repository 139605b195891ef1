"""Estimated local densities agree with the true ones; holes of one source are found where the other is dense enough."""

import math

import numpy as np
import pytest

import sameas
from sameas import Plane, Records, Sphere
from sameas.estimate.coverage import SHARED_PSEUDO_COUNT, SHELL_SMOOTHS, SMOOTHS, Coverage, local_share
from sameas.simulate.scenes import Cap, LonLatBox, WholeSky
from sameas.space import ARCSEC_PER_RADIAN, displaced, unit_vectors


def uniform(rng, n, d=2, low=0.0, high=10.0):
    return Records.of(rng.uniform(low, high, (n, d)), sigma=0.01)


def sky(rng, n, area):
    return Records.of(area.draw(rng, n), sigma=1.0, space=Sphere())


@pytest.mark.parametrize("d", [1, 2, 3])
def test_a_uniform_field_has_its_density_everywhere(d):
    rng = np.random.default_rng(d)
    first, second = uniform(rng, 4000, d), uniform(rng, 1000, d)
    cover = Coverage.of(first, second)
    assert cover.volume == pytest.approx(10.0**d, rel=0.05)
    for source, n in ((1, 4000), (2, 1000)):
        for density in cover.density(source, np.ones(n)):
            assert np.median(density) == pytest.approx(n / 10.0**d, rel=0.15)
            assert np.percentile(density, 99) < 4 * n / 10.0**d
    assert cover.covered[0].mean() > 0.99 and cover.covered[1].mean() > 0.99
    assert cover.common_volume == pytest.approx(10.0**d, rel=0.15)


def test_weights_scale_the_density():
    rng = np.random.default_rng(0)
    cover = Coverage.of(uniform(rng, 3000), uniform(rng, 3000))
    whole, half = cover.density(1, np.ones(3000)), cover.density(1, np.full(3000, 0.5))
    for one, other in zip(whole, half, strict=True):
        assert np.median(other / one) == pytest.approx(0.5, rel=0.15)


def test_a_dense_clump_has_a_high_density():
    rng = np.random.default_rng(1)
    clump = rng.normal(5.0, 0.1, (2000, 2))
    first = Records.of(np.concatenate([rng.uniform(0, 10, (2000, 2)), clump]), sigma=0.01)
    second = uniform(rng, 4000)
    density = Coverage.of(first, second).density(1, np.ones(4000))[1]
    middle = np.hypot(*(second.features - 5.0).T) < 0.1
    far = np.hypot(*(second.features - 5.0).T) > 2.0
    # 2000 records of a normal of σ 0.1: about 2000 / (2π 0.01) e^(−¼) = 25 000 in its centre, and 20 far out.
    assert np.median(density[middle]) == pytest.approx(25_000, rel=0.4)
    assert np.median(density[far]) == pytest.approx(20, rel=0.3)


def test_a_record_does_not_count_towards_its_own_density():
    first = Records.of(np.array([[0.0, 0.0], [10.0, 10.0]]), sigma=0.1)
    second = Records.of(np.array([[0.1, 0.1], [9.9, 9.9]]), sigma=0.1)
    own, other = Coverage.of(first, second).density(1, np.ones(2))
    assert np.all(own < other)


def test_a_hole_is_where_many_records_are_expected_and_none_found():
    rng = np.random.default_rng(2)
    first = uniform(rng, 5000)
    beyond = uniform(rng, 5000)
    second = Records.of(beyond.features[beyond.features[:, 0] < 5.0], sigma=0.01)
    seen_1, seen_2 = Coverage.of(first, second).covered
    left = first.features[:, 0] < 4.7
    right = first.features[:, 0] > 5.8
    assert seen_2.mean() > 0.99 and seen_1[left].mean() > 0.99
    assert seen_1[right].mean() < 0.05
    assert Coverage.of(first, second).common_volume == pytest.approx(50.0, rel=0.2)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_features_of_other_units_have_the_same_holes_and_the_same_region(unit):
    rng = np.random.default_rng(12)
    scale = np.array([1.0, unit])
    for n in (8, 3000):
        first, second = rng.uniform(0.0, 1000.0, (2, n, 2))
        second = second[np.hypot(*(second - 500.0).T) > 200.0]
        plain, scaled = (
            Coverage.of(*(Records.of(x * by, sigma=np.broadcast_to(by, x.shape)) for x in (first, second)))
            for by in (np.ones(2), scale)
        )
        assert all(np.array_equal(*each) for each in zip(plain.covered, scaled.covered, strict=True))
        assert scaled.common_volume == pytest.approx(unit * plain.common_volume, rel=1e-9)


@pytest.mark.parametrize(
    "area", [WholeSky(), LonLatBox((350.0, 370.0), (-10.0, 10.0)), LonLatBox((0.0, 360.0), (85.0, 90.0))]
)
def test_the_covered_area_of_a_sky_field_is_right(area):
    rng = np.random.default_rng(3)
    cover = Coverage.of(sky(rng, 5000, area), sky(rng, 5000, area))
    arcsec_sq = area.steradians() * ARCSEC_PER_RADIAN**2
    assert cover.common_volume == pytest.approx(arcsec_sq, rel=0.25)
    assert np.median(cover.density(1, np.ones(5000))[1]) == pytest.approx(5000 / arcsec_sq, rel=0.15)
    assert cover.covered[0].mean() > 0.98


@pytest.mark.parametrize("space", [Plane(), Sphere()])
def test_records_at_one_position_give_finite_densities(space):
    for n1, n2 in ((1, 1), (1, 5), (5, 5), (60, 40)):
        one, two = (Records.of(np.full((n, 2), 1.0), sigma=1.0, space=space) for n in (n1, n2))
        cover = Coverage.of(one, two)
        for density in (*cover.density(1, np.ones(n1)), *cover.density(2, np.ones(n2))):
            assert np.isfinite(density).all() and (density > 0).all()
        assert cover.covered[0].all() and cover.covered[1].all()


@pytest.mark.parametrize("space", [Plane(), Sphere()])
def test_a_crowd_at_one_position_does_not_refine_the_cells_without_limit(space):
    rng = np.random.default_rng(4)
    crowded = np.concatenate([rng.uniform(0.0, 50.0, (20, 2)), np.full((500, 2), 30.0)])
    records = Records.of(crowded, sigma=1e-9, space=space)
    cover = Coverage.of(records, records)
    assert all(np.isfinite(density).all() for density in cover.density(1, np.ones(520)))
    assert cover.covered[0].all()


def defined(cover, weights, side):
    """Density of source 1 at the records of ``side``: from level to level shrunk towards the cell counts, with
    the strength that maximises the leave-one-out likelihood of its own records."""
    start = (weights.sum() + 0.5) / cover.volume
    own, at = np.full(len(weights), start), np.full(len(getattr(cover.levels[0], side)), start)
    for level in cover.levels:
        volume, cell = level.volume[level.of_first], getattr(level, side)
        others = np.array([weights[level.of_first == here].sum() for here in level.of_first]) - weights
        fits = {k: np.sum(weights * np.log((others + k) / (volume + k / own))) for k in SMOOTHS}
        fits = {k: fit - 0.7 * n for n, (k, fit) in enumerate(fits.items())}
        smooth = max(fits, key=fits.get)
        # In the finest cells (four records on average or fewer) each record counts for three quarters.
        finest = level is cover.levels[-1] or weights @ (others + weights) <= 4.0 * weights.sum()
        without = (others + smooth) / (volume + smooth / own)
        own = (others + finest * 0.75 * weights + smooth) / (volume + smooth / own)
        count = np.array([weights[level.of_first == here].sum() for here in cell])
        at = own if side == "of_first" else (count + smooth) / (level.volume[cell] + smooth / at)
        if finest:
            break
    if smooth < SMOOTHS[0] and np.isin(weights, (0.0, 1.0)).all():
        return refined_by_balls(cover, weights, side, at, without, float(np.median(level.volume)))
    return at


def refined_by_balls(cover, weights, side, at, without, volume):
    """Densities ``at`` the records of ``side``, from ball to smaller ball shrunk towards the number of neighbours
    beyond 7 typical errors, while the leave-one-out likelihood of source 1's own records grows by 16 or more.

    without : density at these without the record itself. volume : of the finest cells.
    """
    points = [ARCSEC_PER_RADIAN * unit_vectors(*records.features.T) for records in (cover.first, cover.second)]
    there = points[0 if side == "of_first" else 1]
    to_own, to_there = (np.linalg.norm(some[:, None] - points[0][weights > 0], axis=2) for some in (points[0], there))
    near, radius, fitted = 7.0 * cover.typical_error[0], math.sqrt(2.0 * volume / math.pi), False
    while radius**2 > 2.0 * near**2:
        shell = math.pi * (radius**2 - near**2)
        own, others = (np.sum((distance <= radius) & (distance > near), axis=1) for distance in (to_own, to_there))
        fits = {k: np.sum(weights * np.log((own + k) / (shell + k / without))) for k in SHELL_SMOOTHS}
        fits = {k: fit - 0.7 * n for n, (k, fit) in enumerate(fits.items())}
        smooth = max(fits, key=fits.get)
        if fits[smooth] - np.sum(weights * np.log(without)) > 16.0:
            fitted, without = True, (own + smooth) / (shell + smooth / without)
            at = (others + smooth) / (shell + smooth / at)
        elif fitted:
            break
        radius /= math.sqrt(2.0)
    assert fitted
    return at


@pytest.mark.parametrize("space", [Plane(), Sphere()])
def test_cells_and_densities_agree_with_the_definition(space):
    rng = np.random.default_rng(5)
    clump = rng.normal(20.0, 0.5, (150, 2))
    one, two = (
        Records.of(np.concatenate([rng.uniform(0.0, 60.0, (n, 2)), clump]), sigma=1.0, space=space) for n in (80, 300)
    )
    cover = Coverage.of(one, two)
    for coarse, fine in zip(cover.levels, cover.levels[1:], strict=False):
        assert fine.volume.mean() == pytest.approx(coarse.volume.mean() / 8.0, rel=0.5)
    for level in cover.levels:
        cells = np.concatenate([level.of_first, level.of_second])
        assert sorted(set(cells.tolist())) == list(range(len(level.volume)))
    weights = rng.uniform(size=len(one))
    at_first, at_second = cover.density(1, weights)
    np.testing.assert_allclose(at_first, defined(cover, weights, "of_first"), rtol=1e-9)
    np.testing.assert_allclose(at_second, defined(cover, weights, "of_second"), rtol=1e-9)


def clumped(rng, n, of_each, extent):
    """(n · of_each, 2) positions in n elongated clumps; extent : standard deviation along the longer axis, arcsec."""
    centre = LonLatBox((149.0, 151.0), (1.0, 3.0)).draw(rng, n)
    off = rng.normal(size=(n * of_each, 2)) * np.array([extent, 0.3 * extent])
    return displaced(np.repeat(centre, of_each, axis=0), off)


def test_densities_in_clumps_agree_with_the_definition():
    rng = np.random.default_rng(6)
    one, two = (Records.of(clumped(rng, 60, 6, 20.0), sigma=0.4, space=Sphere()) for _ in range(2))
    cover, weights = Coverage.of(one, two), (rng.random(360) < 0.9).astype(np.float64)
    for density, side in zip(cover.density(1, weights), ("of_first", "of_second"), strict=True):
        np.testing.assert_allclose(density, defined(cover, weights, side), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "of_each", "extent"), [(1000, 5, 30.0), (150, 20, 20.0), (300, 8, 4.0)])
def test_in_clumps_smaller_than_cells_as_many_pairs_are_wrong_as_expected(n, of_each, extent):
    """Densities of cells alone gave 146 wrong pairs where 38 were expected, 571 where 221 were, and 760 where 457 were:
    the last clumps are six errors long, and resolved by the separations of their members only."""
    wrong, expected, variance = 0, 0.0, 0.0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        objects, sides, labels = clumped(rng, n, of_each, extent), [], []
        for share, sigma in ((0.6, 0.4), (0.5, 0.5)):
            of = np.flatnonzero(rng.random(len(objects)) < share)
            position = displaced(objects[of], sigma * rng.normal(size=(len(of), 2)))
            sides.append(Records.of(position, sigma=sigma, space=Sphere(), source=f"sigma {sigma}"))
            labels.append(of)
        found = sameas.match(*sides)
        rows, p = [np.asarray(found.pairs[name]) for name in ("row_1", "row_2")], np.asarray(found.pairs["p_match"])
        wrong += int(np.count_nonzero(labels[0][rows[0]] != labels[1][rows[1]]))
        expected, variance = expected + found.expected_wrong, variance + float((p * (1.0 - p)).sum())
    assert abs(wrong - expected) < 3.0 * math.sqrt(2.0 * variance)


def test_densities_resolve_a_cluster_and_stay_smooth_in_a_uniform_field():
    rng = np.random.default_rng(8)
    even, other = uniform(rng, 600), uniform(rng, 600)
    spread = {}
    for name, middle in (("even", 0), ("cluster", 300)):
        drawn = [np.concatenate([r.features[middle:], rng.normal(5.0, 0.15, (middle, 2))]) for r in (even, other)]
        one, two = (Records.of(each, sigma=0.01) for each in drawn)
        at, _ = Coverage.of(one, two).covered_densities[0]
        truth = (600 - middle) / 100.0 + middle * np.exp(-0.5 * np.square((drawn[0] - 5.0) / 0.15).sum(axis=1)) / (
            2.0 * np.pi * 0.15**2
        )
        spread[name] = np.abs(np.log(at / truth))
    assert np.median(spread["even"]) < 0.05  # Poisson counts of a finest cell: 12 ± 3
    assert np.median(spread["cluster"][300:]) < 0.5


def test_the_mean_inverse_root_of_the_density_is_unbiased_in_sparse_clusters():
    """Chance pairs have weight 1/√(ρ₁ρ₂); with strict leave-one-out densities it was 8 % too large on average."""
    rng, ratio = np.random.default_rng(11), []
    for _ in range(40):
        # Half uniform over 1 × 1, half a Plummer profile of radius 0.06.
        radius, angle = 0.06 * np.sqrt(1.0 / rng.random(75) - 1.0), rng.uniform(0.0, 2.0 * np.pi, 75)
        cluster = 0.5 + (radius * [np.cos(angle), np.sin(angle)]).T
        objects = np.concatenate([rng.random((75, 2)), cluster[(np.abs(cluster - 0.5) < 0.5).all(axis=1)]])
        each = [Records.of(objects[rng.random(len(objects)) < 0.7], sigma=1e-4) for _ in range(2)]
        density, _ = Coverage.of(*each).covered_densities[0]
        square = np.square(each[0].features - 0.5).sum(axis=1) / 0.06**2
        ratio.append(np.sqrt(0.7 * 75.0 * (1.0 + 1.0 / (np.pi * 0.06**2 * (1.0 + square) ** 2)) / density))
    assert np.concatenate(ratio).mean() == pytest.approx(1.0, abs=0.05)


def test_the_density_of_a_sparse_source_is_right_at_the_field_borders():
    """Its cells extend beyond the field; the field is determined from the richer source."""
    rng = np.random.default_rng(5)
    disc = Cap(150.0, 2.0, 1.0)
    for few, many in ((300, 60_000), (1_500, 60_000)):
        cover = Coverage.of(sky(rng, few, disc), sky(rng, many, disc))
        due = few / (2.0 * np.pi * (1.0 - np.cos(np.radians(1.0))) * ARCSEC_PER_RADIAN**2)
        for density in cover.covered_densities[0]:
            assert np.mean(np.log(density / due)) == pytest.approx(0.0, abs=0.06)


@pytest.mark.parametrize("share", [0.005, 0.5, 0.95])
def test_shares_of_a_uniform_field_do_not_follow_count_noise(share):
    """Shares near 0 and 1 depend on few records of the rarer kind in every cell."""
    rng = np.random.default_rng(6)
    first, second = uniform(rng, 500), uniform(rng, 60_000)
    partner = (rng.uniform(size=60_000) < share).astype(float)
    cover = Coverage.of(first, second)
    drawn = SHARED_PSEUDO_COUNT
    for at in local_share(cover.levels[1:-1], 2, partner, np.ones(60_000), pseudo_count=drawn):
        logit = np.log(at / (1.0 - at))
        assert np.mean(logit) == pytest.approx(np.log(share / (1.0 - share)), abs=0.1)
        assert np.std(logit) < 0.2


@pytest.mark.parametrize("overlap", [0.5, 0.1, 0.03])
def test_densities_in_a_narrow_overlap_are_right(overlap):
    """Only the part of a cell inside the strip counts; densities were once up to 100 times too low."""
    rng = np.random.default_rng(int(1000 * overlap))
    low = 10.0 * (1.0 - overlap)
    first = Records.of(rng.uniform(0.0, 10.0, (5000, 2)), sigma=0.01)
    second = Records.of(rng.uniform(0.0, 10.0, (5000, 2)) + np.array([low, 0.0]), sigma=0.01)
    cover = Coverage.of(first, second)
    for densities in cover.covered_densities:
        for density, covered in zip(densities, cover.covered, strict=True):
            assert np.median(density[covered]) == pytest.approx(50.0, rel=0.4)


def test_released_cells_are_computed_again_and_give_the_same():
    rng = np.random.default_rng(7)
    cap = Cap(40.0, 20.0, 0.5)
    cover = Coverage.of(sky(rng, 3000, cap), sky(rng, 2000, cap))
    densities, covered, volume = cover.covered_densities, cover.covered, cover.common_volume
    cover.release()
    assert not {"levels", "covered_densities", "_points"} & set(vars(cover))
    assert cover.common_volume == volume
    for before, after in zip((*covered, *densities[0], *densities[1]), _all_of(cover), strict=True):
        np.testing.assert_array_equal(before, after)


def test_the_part_of_a_released_coverage_has_the_cells_of_the_whole():
    rng = np.random.default_rng(8)
    cover = Coverage.of(uniform(rng, 3000), uniform(rng, 3000))
    rows = np.arange(0, 3000, 3)
    before = cover.part(rows, rows)
    cover.release()
    after = cover.part(rows, rows)
    after.release()
    for one, other in zip(before.levels, after.levels, strict=True):
        np.testing.assert_array_equal(one.of_first, other.of_first)
        np.testing.assert_array_equal(one.volume, other.volume)


def _all_of(cover):
    return (*cover.covered, *cover.covered_densities[0], *cover.covered_densities[1])


def test_a_match_does_not_keep_the_cells():
    from sameas.front.match import match

    rng = np.random.default_rng(9)
    ra, dec = rng.uniform(10, 11, 500), rng.uniform(20, 21, 500)
    found = match({"ra": ra, "dec": dec}, {"ra": ra, "dec": dec + 1e-5})
    assert "levels" not in vars(found.estimate.coverage)
