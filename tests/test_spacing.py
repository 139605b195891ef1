"""The box b of neighbours estimated from the data: right in size, harmless in use; a small b raises a doubt."""

import math

import numpy as np
import pytest

from sameas import Box, CloseObjects, CommonObjects, InputError, Plane, Records, identify
from sameas.evidence.close import estimate_reach
from sameas.score.pairs import score_records
from sameas.simulate.scenes import Cap, grid, line, poisson_field, sky_field

SIGMA = math.sqrt(2.0)
SCENES = {
    "line of five": (lambda rng: line(rng, n=5, spacing_sigmas=1.9, q1=0.1, q2=0.1), 1.9, 0.1),
    "line, half missed": (lambda rng: line(rng, n=5, spacing_sigmas=4.0, q1=0.5, q2=0.5), 4.0, 0.5),
    "grid": (lambda rng: grid(rng, shape=(3, 3), spacing_sigmas=3.0, q1=0.2, q2=0.2), 3.0, 0.2),
    "poisson": (
        lambda rng: poisson_field(
            rng, density=1 / (4 * (3.0 * SIGMA) ** 2), extent=(22.0, 22.0), q1=0.2, q2=0.2, sigma_1=1.0, sigma_2=1.0
        ),
        3.0,
        0.2,
    ),
}


def share_right(scenes, reaches, q):
    """Share of correctly decided records with the given b of each scene."""
    right = total = 0
    for scene, b in zip(scenes, reaches, strict=True):
        rule = CloseObjects(1.1 * SIGMA, tuple(np.broadcast_to(b, 2)))
        found = identify(scene.first, scene.second, rule=rule, prior=CommonObjects(q, q), gate=Box(8.0)).matches
        score = score_records((found.rows_1, found.rows_2), scene.true_pairs(), len(scene.first), len(scene.second))
        right, total = right + score.n_right_1 + score.n_right_2, total + score.n_1 + score.n_2
    return right / total


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_decisions_with_the_estimated_reach_are_as_accurate_as_with_the_true_one(name):
    make, spacing_sigmas, q = SCENES[name]
    scenes = [make(np.random.default_rng([1, k])) for k in range(150)]
    scenes = [scene for scene in scenes if max(len(scene.first), len(scene.second)) >= 2]
    true = 2 * spacing_sigmas * SIGMA
    estimated = share_right(scenes, [estimate_reach(scene.first, scene.second).b for scene in scenes], q)
    known = share_right(scenes, [true] * len(scenes), q)
    assert estimated > known - 0.02
    if name == "line, half missed":
        # For comparison: b equal to the inner box, and b three times too large.
        assert share_right(scenes, [1.12 * SIGMA] * len(scenes), q) < known - 0.2
        assert share_right(scenes, [3 * true] * len(scenes), q) > known - 0.05


@pytest.mark.parametrize("d", [4.0, 8.0])
def test_the_spacing_of_a_line_and_a_grid_is_recovered(d):
    rng = np.random.default_rng(2)
    distance = d * SIGMA
    grids = grid(rng, shape=(20, 20), spacing_sigmas=d, q1=0.0, q2=0.0)
    spacing = estimate_reach(grids.first, grids.second)
    # The nearest of four neighbours is biased to small distances.
    assert np.all((spacing.neighbour > (1 - 1.3 / d) * distance) & (spacing.neighbour < 1.05 * distance))
    np.testing.assert_allclose(spacing.b, 2 * spacing.neighbour)
    np.testing.assert_allclose(spacing.a, 1.1 * SIGMA)
    lines = line(rng, n=400, spacing_sigmas=d, q1=0.0, q2=0.0)
    along, across = estimate_reach(lines.first, lines.second).neighbour
    # All neighbours lie along one of two features: √2 of the distance.
    assert (1 - 1 / d) * math.sqrt(2) < along / distance < 1.05 * math.sqrt(2) and across < 0.2 * distance


def test_a_poisson_field_gives_its_root_mean_square_neighbour():
    rng = np.random.default_rng(3)
    field = poisson_field(
        rng, density=1.0, extent=(60.0, 60.0), q1=0.0, q2=0.0, sigma_1=0.05, sigma_2=0.05, space=Plane((60.0, 60.0))
    )
    spacing = estimate_reach(field.first, field.second)
    # The nearest of a Poisson field is normal in each feature, of variance 1/(2πρ).
    assert np.all(np.abs(spacing.neighbour - math.sqrt(2 / (2 * math.pi))) < 4 * spacing.error)
    assert np.all((spacing.error > 0.002) & (spacing.error < 0.05))


def test_the_standard_error_agrees_with_the_scatter_over_scenes():
    rng = np.random.default_rng(4)
    found = [
        estimate_reach(scene.first, scene.second)
        for scene in (
            poisson_field(rng, density=1.0, extent=(9.0, 9.0), q1=0.3, q2=0.3, sigma_1=0.05, sigma_2=0.05)
            for _ in range(150)
        )
    ]
    scatter = np.std([spacing.neighbour for spacing in found], axis=0)
    stated = np.mean([spacing.error for spacing in found], axis=0)
    assert np.all((stated > 0.5 * scatter) & (stated < 1.3 * scatter))


def test_measurement_errors_are_subtracted():
    # Isolated couples: no choice among neighbours, so the distance is recovered for any errors.
    rng = np.random.default_rng(5)
    angle, centre = rng.uniform(0, 2 * np.pi, 2000), np.arange(2000)[:, None] * [200.0, 0.0]
    half = 4.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    place = np.concatenate([centre + half, centre - half])
    for sigma in (0.01, 1.5, 3.0):
        source = Records.of(place + rng.normal(0, sigma, place.shape), sigma=sigma)
        spacing = estimate_reach(source, source)
        assert spacing.neighbours == 4000
        np.testing.assert_allclose(spacing.neighbour, 8.0, rtol=0.05)


def test_features_have_scales_of_their_own():
    rng = np.random.default_rng(6)
    scene = grid(rng, shape=(12, 12), spacing_sigmas=6.0, q1=0.1, q2=0.1)
    plain = estimate_reach(scene.first, scene.second)
    stretched = [
        Records.of(source.features * [1.0, 1000.0], sigma=[1.0, 1000.0]) for source in (scene.first, scene.second)
    ]
    scaled = estimate_reach(*stretched)
    for name in ("a", "b", "neighbour", "error", "sigma"):
        np.testing.assert_allclose(getattr(scaled, name), getattr(plain, name) * [1.0, 1000.0], rtol=1e-9)


def test_directions_and_periodic_features_wrap():
    rng = np.random.default_rng(7)
    sky = sky_field(rng, n_common=200, n_only_1=0, n_only_2=0, sigma_arcsec=0.1, area=Cap(0.0, 89.999, 0.005))
    spacing = estimate_reach(sky.first, sky.second)
    density = 200 / (math.pi * (0.005 * 3600) ** 2)
    np.testing.assert_allclose(spacing.neighbour, 1 / math.sqrt(math.pi * density), rtol=0.3)
    ring = Records.of(np.arange(0.0, 360.0, 30.0)[:, None] % 360, sigma=0.1, space=Plane((360.0,)))
    np.testing.assert_allclose(estimate_reach(ring, ring).neighbour, 30.0, rtol=1e-3)


def test_a_value_that_rounds_to_the_period_is_at_its_beginning():
    space = Plane((360.0, None))
    ring = Records.of([[-1e-17, 0.0], [5.0, 1.0], [350.0, 2.0]], sigma=1.0, space=space)
    same = Records.of([[0.0, 0.0], [5.0, 1.0], [350.0, 2.0]], sigma=1.0, space=space)
    np.testing.assert_allclose(estimate_reach(ring, ring).neighbour, estimate_reach(same, same).neighbour)


def test_a_small_reach_raises_a_doubt_and_a_large_one_does_not():
    rng = np.random.default_rng(8)
    scene = line(rng, n=60, spacing_sigmas=6.0, q1=0.1, q2=0.1)
    spacing = estimate_reach(scene.first, scene.second)
    true = 12 * SIGMA
    text = spacing.doubt(0.2 * true)
    assert "b is 3.39 in feature 0, but the sources' own neighbours lie" in text and "or more" in text
    for b in (true, 10 * true, spacing.b, (true, 0.01)):
        assert spacing.doubt(b) == ""


def test_distances_explained_by_errors_give_the_least_reach_without_doubt():
    rng = np.random.default_rng(9)
    heap = Records.of(rng.normal(0, 1.0, (30, 2)), sigma=1.0)
    spacing = estimate_reach(heap, heap)
    np.testing.assert_allclose(spacing.b, 4.0 * SIGMA)
    assert np.all(spacing.neighbour == 0.0) and np.isinf(spacing.error).all() and spacing.doubt(0.1) == ""


def test_one_source_alone_may_give_the_reach():
    one = Records.of([[0.0, 0.0]], sigma=1.0, source="ais")
    two = Records.of([[0.0, 0.0], [9.0, 0.0]], sigma=1.0, source="radar")
    spacing = estimate_reach(one, two)
    assert spacing.neighbours == 1
    assert spacing.neighbour[0] == pytest.approx(math.sqrt(2 * (81 - 2)))
    same_spot = Records.of([[1.0, 1.0], [1.0, 1.0], [5.0, 5.0]], sigma=0.1)
    assert np.isfinite(estimate_reach(same_spot, one).b).all()
    with pytest.raises(InputError, match="ais has 1 records, ais 1: no neighbours to measure; give b"):
        estimate_reach(one, one)


def test_the_order_of_the_sources_does_not_matter():
    rng = np.random.default_rng(10)
    scene = grid(rng, shape=(4, 4), spacing_sigmas=3.0, q1=0.3, q2=0.1, sigma_2=0.5)
    one, other = estimate_reach(scene.first, scene.second), estimate_reach(scene.second, scene.first)
    for name in ("a", "b", "neighbour", "error"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12)
