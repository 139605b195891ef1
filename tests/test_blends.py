"""Blend probabilities: explicit sums over all hypotheses, and calibration."""

import itertools
import math

import numpy as np
import pytest

from sameas import Records, match
from sameas.errors import InputError
from sameas.estimate.blends import BlendTuning as Tuning
from sameas.estimate.blends import (
    DetectionOdds,
    Merging,
    candidates_of,
    find_blends,
    hypotheses,
    log_odds_of,
    suspected_blends,
)
from sameas.estimate.match import match as estimated
from sameas.evidence import Errors
from sameas.simulate.blends import blended_field

SIGMA, RESOLUTION, SHARE, ALONE = 0.3, 2.0, 0.7, 0.02


def small(rng):
    fine = rng.uniform(0.0, 4.0, (4, 2))
    coarse = rng.uniform(0.0, 4.0, (3, 2))
    flux = rng.uniform(0.2, 3.0, 4)
    return Records.of(coarse, sigma=SIGMA), Records.of(fine, sigma=1e-6), flux


def merged(fine):
    """All ways in which objects merge in pairs, the nearest first, with their probabilities."""
    couples = sorted(itertools.combinations(range(len(fine)), 2), key=lambda c: math.dist(fine[c[0]], fine[c[1]]))
    for outcome in itertools.product((False, True), repeat=len(couples)):
        p, pairs, taken = 1.0, [], set()
        for (j, k), together in zip(couples, outcome, strict=True):
            s = math.dist(fine[j], fine[k])
            b = 2.0 ** -((s / RESOLUTION) ** 4) if s <= 1.75 * RESOLUTION and not taken & {j, k} else 0.0
            p *= b if together else 1.0 - b
            if together:
                pairs.append((j, k))
                taken |= {j, k}
        if p > 0.0:
            yield p, pairs, taken


def all_hypotheses(coarse, fine, flux):
    """All hypotheses of four objects in the coarse source, with their relative probabilities."""

    def density(x, at):
        return math.exp(-((x - at) ** 2).sum() / (2 * SIGMA**2)) / (2 * math.pi * SIGMA**2)

    weights = {}
    couples = list(itertools.combinations(range(len(fine)), 2))
    ways = list(merged(fine))
    for answer in itertools.product(range(-1, 10), repeat=len(coarse)):
        objects_of = [() if a < 0 else (a,) if a < 4 else couples[a - 4] for a in answer]
        used = [n for objects in objects_of for n in objects]
        if len(set(used)) < len(used):
            continue
        weight = 1.0
        for x, objects in zip(coarse, objects_of, strict=True):
            if objects:
                w = flux[objects[0]] / flux[list(objects)].sum()
                weight *= density(x, w * fine[objects[0]] + (1 - w) * fine[objects[-1]]) / ALONE
        shown, prior = sum(map(bool, objects_of)), 0.0
        for p, pairs, taken in ways:
            fits = all(o in pairs if len(o) == 2 else not taken & set(o) for o in objects_of)
            prior += fits * p * SHARE**shown * (1 - SHARE) ** (len(fine) - len(pairs) - shown)
        weights[answer] = weight * prior
    total = sum(weights.values())
    return {answer: weight / total for answer, weight in weights.items()}


@pytest.mark.parametrize("seed", range(6))
def test_probabilities_are_the_sums_over_all_hypotheses(seed):
    rng = np.random.default_rng([11, seed])
    first, second, flux = small(rng)
    tuning = Tuning(min_log_odds=-np.inf, max_hypotheses=1e9)
    found = candidates_of(first, second, RESOLUTION, Errors(), flux)
    shown = DetectionOdds(Merging.of(found.couples, found.blended, 4, tuning.max_mergers), SHARE)
    log_density, log_odds = log_odds_of(found, shown, np.ones(1), np.full(3, ALONE))
    summed = hypotheses(found, log_density, log_odds, shown, 3, tuning)
    due = all_hypotheses(first.features, second.features, flux)
    couples = list(itertools.combinations(range(4), 2))
    for i, j, k, p in zip(found.i, found.j, found.k, summed.p, strict=True):
        number = j if k < 0 else 4 + couples.index((min(j, k), max(j, k)))
        assert p == pytest.approx(sum(x for answer, x in due.items() if answer[i] == number), abs=1e-9)
    best = max(due, key=due.get)
    numbers = [sum(1 for n in best if n >= 0), summed.chosen.sum()]
    assert numbers[0] == numbers[1]


def test_without_neighbours_there_are_no_blends():
    rng = np.random.default_rng(2)
    fine = np.column_stack([np.arange(80.0) * 20.0, np.zeros(80)])
    coarse = fine[:60] + 0.1 * rng.standard_normal((60, 2))
    found = find_blends(Records.of(coarse, sigma=0.1), Records.of(fine, sigma=1e-3), 2.0, errors=Errors())
    assert np.array_equal(found.partner, np.arange(60)) and found.other.mask.all() and not found.p_blend.any()
    assert found.share == pytest.approx(0.75, abs=0.01) and found.exact.all()


@pytest.mark.parametrize("resolution", [0.0, -1.0, np.inf, np.nan])
def test_the_resolution_must_be_positive(resolution):
    first, second, _ = small(np.random.default_rng(1))
    with pytest.raises(InputError, match="resolution"):
        find_blends(first, second, resolution, errors=Errors())


def test_a_resolution_far_above_the_spacing_is_refused():
    """Every two objects of a field were couples of each record: memory and hours without an end."""
    rng = np.random.default_rng(4)
    coarse, fine = (Records.of(rng.uniform(0.0, 9.0, (n, 2)), sigma=0.3, source=f"a{n}") for n in (50, 400))
    with pytest.raises(InputError, match=r"about \d+ records of a400 lie within .* of each one of a50, too many"):
        find_blends(coarse, fine, 6.0, errors=Errors())


def test_fluxes_are_those_of_the_records():
    first, second, flux = small(np.random.default_rng(1))
    for wrong in (flux[:2], -flux):
        with pytest.raises(InputError, match="one above 0 for each of 4 records"):
            find_blends(first, second, 2.0, errors=Errors(), flux=wrong)


def test_an_unknown_flux_is_like_none_given():
    """A blend with an object of unknown flux could not be found at all."""
    rng = np.random.default_rng(3)
    fine = rng.uniform(0.0, 100.0, (60, 2))
    fine[1] = fine[0] + (1.0, 0.0)
    coarse = np.concatenate([[fine[:2].mean(axis=0)], fine[2:50]]) + 0.1 * rng.standard_normal((49, 2))
    records, unknown = (Records.of(coarse, sigma=0.1), Records.of(fine, sigma=1e-3)), np.full(60, np.nan)
    without = find_blends(*records, 2.0, errors=Errors())
    assert (without.partner[0], without.other[0]) == (0, 1)
    assert find_blends(*records, 2.0, errors=Errors(), flux=unknown).p_blend == pytest.approx(
        without.p_blend, abs=1e-12
    )
    one = find_blends(*records, 2.0, errors=Errors(), flux=np.where(np.arange(60) == 1, np.nan, 1.0))
    assert one.p_blend[0] == pytest.approx(without.p_blend[0], abs=1e-4)
    with pytest.raises(InputError, match="one above 0"):
        find_blends(*records, 2.0, errors=Errors(), flux=np.where(np.arange(60) == 1, np.inf, 1.0))


@pytest.mark.parametrize("max_mergers", [20, 1_000])
def test_in_crowds_partners_are_as_certain_as_stated(max_mergers):
    """Where each object is near the next, all records were one group: most of its candidates were dropped, their
    records certainly without a partner, and odds of hundreds of objects underflowed."""
    made = blended_field(np.random.default_rng(12), objects=250, per_deg2=200_000.0)
    blends = find_blends(
        made.first, made.second, 6.0, errors=Errors(), flux=made.flux, tuning=Tuning(max_mergers=max_mergers)
    )
    answer = np.column_stack([blends.partner.filled(-1), blends.other.filled(-1)])
    right = (np.sort(answer, axis=1) == np.sort(made.parts, axis=1)).all(axis=1)
    wrong = (1.0 - blends.p_match).sum()
    assert abs(np.count_nonzero(~right) - wrong) < 4.0 * np.sqrt(wrong) and wrong < 0.05 * len(right)
    two = (made.parts >= 0).all(axis=1)
    assert abs(blends.p_blend.sum() - two.sum()) < 6.0 and not blends.exact.all()


@pytest.mark.slow
@pytest.mark.parametrize("with_fluxes", [True, False])
def test_blend_probabilities_are_calibrated(with_fluxes):
    """Fields like WISE on Gaia, 6″: partners of coarse records, and whether they are blends."""
    p, right, p_two, two, found_two, real = [], [], [], [], 0, 0
    for seed in range(3):
        made = blended_field(np.random.default_rng([12, seed]), objects=1_500)
        flux = made.flux if with_fluxes else None
        blends = find_blends(made.first, made.second, made.resolution_arcsec, errors=Errors(), flux=flux)
        answer = np.column_stack([blends.partner.filled(-1), blends.other.filled(-1)])
        ok = (np.sort(answer, axis=1) == np.sort(made.parts, axis=1)).all(axis=1)
        p.append(blends.p_match)
        right.append(ok)
        p_two.append(blends.p_blend)
        two.append((made.parts >= 0).all(axis=1))
        found_two += int((ok & two[-1]).sum())
        real += int(two[-1].sum())
    for stated, happened in ((p, right), (p_two, two)):
        stated, happened = np.concatenate(stated), np.concatenate(happened)
        sure = np.sqrt(max((stated * (1 - stated)).sum(), 1.0))
        assert abs(stated.sum() - happened.sum()) < 4.0 * sure
    assert found_two > (0.8 if with_fluxes else 0.6) * real > 60


def test_a_match_says_which_of_its_records_are_blends():
    made = blended_field(np.random.default_rng(5), objects=300)
    found = match(made.first, made.second)
    table = found.blends(made.resolution_arcsec, flux=made.flux)
    assert table["row_1"].tolist() == list(range(len(made.first))) and not np.ma.is_masked(table["p_blend"])
    two = ~np.ma.getmaskarray(table["row_2b"])
    claimed = np.sort(np.column_stack([table["row_2"][two], table["row_2b"][two]]), axis=1)
    assert len(claimed) > 10 and (claimed == np.sort(made.parts[two], axis=1)).all(axis=1).mean() > 0.6
    with pytest.raises(InputError, match="one for each of 300 rows"):
        found.blends(6.0, flux=[1.0])


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("seed", range(3))
def test_residuals_that_point_to_a_neighbour_suggest_blends(seed):
    made = blended_field(np.random.default_rng([13, seed]), objects=1_500)
    answer, estimate = estimated(made.first, made.second)
    number, within, sigmas = suspected_blends(answer, estimate.errors, estimate.coverage, 0)
    assert number > 20 and 3.0 < within < 12.0 and sigmas > 10.0
    # With many pairs only a sample is tested.
    fewer, _, _ = suspected_blends(
        answer, estimate.errors, estimate.coverage, 0, Tuning(max_pairs=len(answer.pairs) // 5)
    )
    assert fewer < number
    assert suspected_blends(answer, estimate.errors, estimate.coverage, 1) is None


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_without_shifted_residuals_suggest_no_blends(seed):
    made = blended_field(np.random.default_rng([14, seed]), objects=1_500, resolution_arcsec=0.01)
    answer, estimate = estimated(made.first, made.second)
    for coarse in (0, 1):
        assert suspected_blends(answer, estimate.errors, estimate.coverage, coarse) is None
