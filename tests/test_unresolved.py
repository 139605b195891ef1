"""Unresolved neighbours: blends of a coarse source are found, and probabilities of one-to-one pairs allow for them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sameas import Records
from sameas.estimate.coverage import Coverage
from sameas.estimate.gate_search import DEFAULT_MATCH
from sameas.estimate.match import match
from sameas.estimate.sample import Setting
from sameas.estimate.unresolved import BlendResolution, Unresolved
from sameas.evidence import Errors, Magnitudes
from sameas.gate import Radius

RESOLUTION = 1.0
UNAWARE = replace(DEFAULT_MATCH, fits_resolution=False)


def blended(seed, n=3_000, resolution=RESOLUTION, side=180.0):
    """A fine source of n objects, a coarse one that blends those nearer than its resolution, the brighter object of
    each of its records, and the magnitudes of both sources."""
    rng = np.random.default_rng([41, seed])
    place, flux = rng.uniform(0.0, side, (n, 2)), rng.uniform(0.2, 1.0, n)
    seen, light, alive = place.copy(), flux.copy(), np.ones(n, bool)
    couples = (
        cKDTree(place).query_pairs(1.5 * resolution, output_type="ndarray") if resolution else np.empty((0, 2), int)
    )
    apart = np.hypot(*(place[couples[:, 0]] - place[couples[:, 1]]).T)
    taken = np.zeros(n, bool)
    for at in np.argsort(apart):
        one, two = couples[at][np.argsort(-flux[couples[at]])]
        if not taken[[one, two]].any() and rng.random() < 2.0 ** -((apart[at] / resolution) ** 4):
            taken[[one, two]] = True
            alive[two] = False
            light[one] += flux[two]
            seen[one] += flux[two] / (flux[one] + flux[two]) * (place[two] - place[one])
    detected = rng.permutation(np.flatnonzero(alive & (rng.random(n) < 0.9)))
    fine = Records.of(place + 0.05 * rng.standard_normal((n, 2)), sigma=0.05, source="fine")
    noise = 0.3 * rng.standard_normal((len(detected), 2))
    light_mag = -2.5 * np.log10(light[detected]) + 0.05 * rng.standard_normal(len(detected))
    magnitudes = Magnitudes(-2.5 * np.log10(flux), sigma=0.01), Magnitudes(light_mag, sigma=0.05)
    return fine, Records.of(seen[detected] + noise, sigma=0.3, source="coarse"), detected, magnitudes


def wrong_and_expected(seeds, tuning, with_magnitudes=False):
    wrong = expected = log_loss = 0.0
    for seed in seeds:
        fine, coarse, truth, magnitudes = blended(seed)
        answer, _ = match(fine, coarse, tuning=tuning, brightness=magnitudes if with_magnitudes else None)
        right = answer.rows_1 == truth[answer.rows_2]
        wrong += float((~right[answer.chosen]).sum())
        expected += answer.expected_wrong
        log_loss -= float(np.log(np.maximum(np.bincount(answer.rows_2, answer.p_pair * right), 1e-6)).sum())
    return wrong, expected, log_loss


@pytest.mark.slow_after(1)
def test_probabilities_allow_for_blends():
    wrong, expected, log_loss = wrong_and_expected(range(2), DEFAULT_MATCH)
    wrong_unaware, expected_unaware, log_loss_unaware = wrong_and_expected(range(2), UNAWARE)
    assert wrong_unaware > 1.4 * expected_unaware
    assert wrong - expected < 0.6 * (wrong_unaware - expected_unaware)
    assert log_loss < 0.93 * log_loss_unaware


def test_the_magnitude_of_a_blend_is_that_of_its_objects_together():
    wrong, expected, log_loss = wrong_and_expected([0], DEFAULT_MATCH, with_magnitudes=True)
    wrong_unaware, _, log_loss_unaware = wrong_and_expected([0], UNAWARE, with_magnitudes=True)
    assert wrong < 0.85 * wrong_unaware
    assert abs(wrong - expected) < 3.0 * expected**0.5
    assert log_loss < 0.9 * log_loss_unaware


@pytest.mark.parametrize("swapped", [False, True])
def test_the_resolution_and_the_coarse_source_are_found(swapped):
    fine, coarse, *_ = blended(4)
    _, estimate = match(coarse, fine) if swapped else match(fine, coarse)
    assert estimate.resolution.coarse == (0 if swapped else 1)
    assert 0.75 < estimate.resolution.separation / RESOLUTION < 1.3


@pytest.mark.parametrize("seed", range(2))
def test_sources_that_resolve_all_neighbours_have_no_resolution(seed):
    fine, coarse, *_ = blended(seed, resolution=1e-3)
    assert match(fine, coarse)[1].resolution is None


def test_the_evidence_has_the_mean_one_over_all_positions_unless_the_object_may_be_the_fainter_one_of_a_blend():
    """∫ N(x_j − x_i) (evidence) dx_j is the probability that i is not the fainter one of two that are one record."""
    step = 0.04
    axis = np.arange(-4.0, 4.0, step)
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    fine = Records.of([[0.0, 0.0], [0.9, 0.3]], sigma=0.1, source="fine")
    errors, total = Errors((1.0, 2.0), (0.9, 0.1)), np.zeros(2)
    for chunk in np.array_split(places, 40):
        coarse = Records.of(chunk, sigma=0.5, source="coarse")
        pairs = Radius(100.0)(fine, coarse)
        setting = Setting.whole(pairs, Coverage.of(fine, coarse))
        magnitude = np.array([20.0, 21.0])
        unresolved = Unresolved.of(BlendResolution(1, 1.2), setting, errors, magnitude)
        share = np.full(2, 0.8), np.full(len(chunk), 0.8)
        term = unresolved.with_probabilities(setting, errors, np.zeros(len(pairs)), share).term
        assert np.ptp(term[pairs.i == 0]) > 0.5
        total += np.bincount(pairs.i, np.exp(errors.log_density(pairs) + term), 2) * step**2
    one_record = 2.0 ** -((np.hypot(0.9, 0.3) / 1.2) ** 4)
    hidden = one_record / (one_record + (1.0 - one_record) * 0.2)
    assert total == pytest.approx([1.0, 1.0 - hidden], abs=3e-3)
