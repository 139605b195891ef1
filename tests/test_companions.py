"""Clustered objects (more close pairs than a Poisson field): detected, used, and not found where there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.misstated import couples_field
from scipy import special

from sameas import ChiSquare, Identification, Records
from sameas.estimate.clustering import close_neighbours, clustering, ring, scaled_i0, scaled_sources, share_within
from sameas.estimate.companions import Companions
from sameas.estimate.coverage import Coverage, typical_error
from sameas.estimate.gate_search import DEFAULT_MATCH
from sameas.estimate.match import match
from sameas.estimate.sample import Setting
from sameas.score.pairs import is_true_pair
from sameas.simulate.scenes import SimulatedScene

WITHOUT = replace(DEFAULT_MATCH, em=replace(DEFAULT_MATCH.em, companions=False))


def setting_of(scene: SimulatedScene) -> Setting:
    return Setting.whole(ChiSquare()(scene.first, scene.second), Coverage.of(scene.first, scene.second))


def fields(seed: int, number: int, **options: float) -> list[SimulatedScene]:
    return [couples_field(np.random.default_rng([seed, k]), 400, **options) for k in range(number)]  # type: ignore[arg-type]


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_share_within_reach_is_a_noncentral_chi_square(d):
    from scipy.special import chndtr

    variance = np.geomspace(1e-4, 2.0, 40)
    for radius in (0.0, 0.5, 2.75, 5.5):
        expected = chndtr(49.0 / variance, d, radius**2 / variance)
        assert np.allclose(share_within(7.0, radius, variance, d), expected, rtol=0, atol=2e-5)


def test_a_wide_ring_of_two_dimensions_is_scaled_before_it_overflows():
    from scipy.special import i0e

    x = np.geomspace(1e-3, 1e5, 200)
    density = ring(x, 1.0, np.ones(200), 2)
    expected = np.exp(-0.5 * (x - 1.0) ** 2) * i0e(x) / (2.0 * np.pi)
    assert np.allclose(density, expected, rtol=1e-9, atol=0)


def test_neighbours_found_in_strips_and_by_the_gate_agree():
    scene = couples_field(np.random.default_rng(3), 400)
    setting = setting_of(scene)
    source, _ = scaled_sources(setting, typical_error(scene.first, scene.second))
    in_strips, by_gate = (source.near(source, 5.0, most) for most in (1_000_000, 0))
    order, other_order = (np.lexsort(found[1::-1]) for found in (in_strips, by_gate))
    for ours, due in zip(in_strips, by_gate, strict=True):
        np.testing.assert_allclose(ours[order], due[other_order], rtol=0, atol=1e-7)


def certain_and_wrong(answer: Identification, scene: SimulatedScene) -> tuple[int, float]:
    """(number, expected number) of false pairs among those of p > 0.99."""
    matches = answer.matches
    wrong = ~is_true_pair((matches.rows_1, matches.rows_2), scene.true_pairs())
    sure = matches.p_match > 0.99
    return int(wrong[sure].sum()), float((1.0 - matches.p_match[sure]).sum())


@pytest.mark.parametrize("d", [1, 2, 3])
def test_a_ring_density_integrates_to_one(d: int) -> None:
    r = np.linspace(1e-6, 12.0, 20_001)
    shell = (np.full(len(r), 2.0), 2.0 * np.pi * r, 4.0 * np.pi * r**2)[d - 1]
    for radius in (0.0, 0.7, 3.0):
        assert np.trapezoid(shell * ring(r, radius, np.full(len(r), 0.8), d), r) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_a_ring_is_the_density_of_blurred_points_on_a_sphere(d: int) -> None:
    rng = np.random.default_rng(d)
    at = rng.standard_normal((400_000, d))
    at *= 2.0 / np.sqrt((at**2).sum(axis=1))[:, None]
    distance = np.sqrt(((at + 0.9 * rng.standard_normal(at.shape)) ** 2).sum(axis=1))
    r = np.linspace(0.0, 2.0, 2001)[1:]
    shell = (np.full(len(r), 2.0), 2.0 * np.pi * r, 4.0 * np.pi * r**2)[d - 1]
    inside = np.trapezoid(shell * ring(r, 2.0, np.full(len(r), 0.81), d), r)
    assert inside == pytest.approx((distance < 2.0).mean(), abs=0.004)


@pytest.mark.parametrize(("share", "separation"), [(0.3, 0.5), (0.3, 2.0), (1.0, 2.0), (1.0, 5.0)])
def test_the_number_of_companions_is_unbiased(share: float, separation: float) -> None:
    scenes = fields(1, 4, share=share, separation=separation, missing=0.2)
    seen = [clustering(setting_of(scene)) for scene in scenes]
    numbers = [known.volume.sum() * np.mean(known.mean_densities) for known in seen if known is not None]
    assert len(numbers) == len(scenes)
    # Each source detects 0.8 of the companions.
    assert np.mean(numbers) == pytest.approx(0.8 * share, rel=0.15)
    shares = [known.shares[0] for known in seen if known is not None]
    assert np.mean(shares) == pytest.approx(0.8, abs=0.06)


@pytest.mark.parametrize("chance", [0.01, 0.3, 3.0])
def test_a_poisson_field_has_no_companions(chance: float) -> None:
    scenes = fields(2, 10, share=0.0, chance=chance, missing=0.2)
    assert [clustering(setting_of(scene)) for scene in scenes] == [None] * 10


@pytest.mark.slow
def test_companions_change_nothing_in_a_poisson_field() -> None:
    (scene,) = fields(2, 1, share=0.0, chance=0.3, missing=0.2)
    with_them, _ = match(scene.first, scene.second)
    without, _ = match(scene.first, scene.second, tuning=WITHOUT)
    np.testing.assert_array_equal(with_them.p_pair, without.p_pair)


@pytest.mark.slow_after(2)
@pytest.mark.parametrize(
    ("share", "separation", "missing"),
    [(0.3, 0.5, 0.4), (1.0, 2.0, 0.4), (0.3, 0.1, 0.2), (0.3, 2.0, 0.4), (1.0, 0.5, 0.4), (1.0, 5.0, 0.4)],
)
def test_a_companion_is_not_matched_in_place_of_a_missed_partner(
    share: float, separation: float, missing: float
) -> None:
    scenes = fields(3, 4, share=share, separation=separation, missing=missing)
    wrong, expected, variance, certain, certain_expected = 0, 0.0, 0.0, 0, 0.0
    for scene in scenes:
        answer, _ = match(scene.first, scene.second)
        matches = answer.matches
        wrong += int((~is_true_pair((matches.rows_1, matches.rows_2), scene.true_pairs())).sum())
        expected += answer.expected_wrong
        variance += float((matches.p_match * (1.0 - matches.p_match)).sum())
        number = certain_and_wrong(answer, scene)
        certain, certain_expected = certain + number[0], certain_expected + number[1]
    assert abs(wrong - expected) < 4.0 * np.sqrt(variance)
    assert certain <= certain_expected + 3.0


def test_swapping_sources_and_shuffling_rows_change_nothing() -> None:
    (scene,) = fields(4, 1, share=0.5, separation=1.0)
    answer, _ = match(scene.first, scene.second)
    swapped, _ = match(scene.second, scene.first)
    shuffled, _ = match(scene.first.part(np.random.default_rng(1).permutation(len(scene.first))), scene.second)
    p = sorted(answer.p_pair)
    np.testing.assert_allclose(sorted(swapped.p_pair), p, atol=1e-6)
    np.testing.assert_allclose(sorted(shuffled.p_pair), p, atol=1e-6)


def test_couples_as_close_as_the_errors_are_ambiguous() -> None:
    (scene,) = fields(5, 1, share=1.0, separation=0.1, missing=0.0)
    known, setting = clustering(setting_of(scene)), setting_of(scene)
    assert known is not None
    # Two isolated couples: 1 and 2 in the first source, 3 and 4 in the second.
    unit = float(known.unit[0]) * np.array([1.0, 0.0])
    field = setting.pairs.first
    at = field.features[:2] * 0.0 + [[160.0, 0.0], [160.0, 0.0]]
    first = np.vstack([field.features, at + np.outer([-0.9, 0.9], unit / 3600.0)])
    second = np.vstack([setting.pairs.second.features, at + np.outer([-0.8, 0.8], unit / 3600.0)])
    one, two = (Records.of(x, sigma=0.1, space=field.space, source=name) for x, name in ((first, "a"), (second, "b")))
    pairs = ChiSquare()(one, two)
    whole = Setting.whole(pairs, Coverage.of(one, two))
    companions = Companions.of(known, whole)
    swap = np.zeros(len(pairs))
    swap[companions.index] = companions.log_swap
    n = len(one)
    by = {(int(i), int(j)): e for e, (i, j) in enumerate(zip(pairs.i, pairs.j, strict=True))}
    a, b, x, y = (by[i, j] for i, j in ((n - 2, n - 2), (n - 1, n - 1), (n - 2, n - 1), (n - 1, n - 2)))
    square = pairs.mahalanobis_sq
    straight = 0.5 * (square[x] + square[y] - square[a] - square[b])
    said_by_couples = swap[a] + swap[b] - swap[x] - swap[y]
    assert straight > 2.0
    assert -straight < said_by_couples < -0.3 * straight


def test_records_within_their_errors_of_each_other_are_counted() -> None:
    (scene,) = fields(6, 1, share=0.0, chance=0.3)
    again = scene.second.part(np.arange(0, len(scene.second), 5))
    place = np.vstack([scene.second.features, again.features])
    twice = Records.of(place, sigma=0.1, space=scene.second.space, source="second")
    counted = close_neighbours(Setting.whole(ChiSquare()(scene.first, twice), Coverage.of(scene.first, twice)))
    assert counted is not None
    one, two = counted
    assert (one.n_records, two.n_records) == (len(scene.first), len(twice))
    assert abs(one.n_pairs - one.by_chance) < 4.0 * one.by_chance**0.5
    # All couples of a record and its copy; chance couples exceed those expected from densities without copies.
    assert two.n_pairs - len(again) - one.n_pairs > -4.0 * one.n_pairs**0.5
    assert two.n_pairs - two.by_chance > 0.6 * len(again)


def test_the_scaled_bessel_function_agrees_with_scipy():
    x = np.concatenate([[0.0, 1e-300], np.geomspace(1e-3, 1e12, 4001), [29.999999, 30.0, np.inf]])
    with np.errstate(all="raise"):
        ours = scaled_i0(x)
    np.testing.assert_allclose(ours, special.i0e(x), rtol=3e-15)
    assert scaled_i0(x[:4000].reshape(40, 100)).shape == (40, 100)
