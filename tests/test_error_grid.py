"""Averaging over uncertain error models: against enumeration, and on fields with formal errors."""

import numpy as np
import pytest
from benchmarks.misstated import formal_field, misquoted
from scipy.special import logsumexp

import naive
from problems import shuffled
from sameas import InputError, Records, Sphere
from sameas.estimate.coverage import Coverage
from sameas.estimate.error_average import Average, ErrorAverage
from sameas.estimate.error_grid import MAX_POINTS, MIN_POINTS, scan_errors
from sameas.estimate.match import match
from sameas.evidence import Errors
from sameas.gate import Radius
from sameas.score.pairs import is_true_pair


def counts(scene, **options):
    """(true pairs, found, false, true partners excluded with near certainty)."""
    answer, estimate = match(scene.first, scene.second, **options)
    true = scene.true_pairs()
    right = is_true_pair((answer.matches.rows_1, answer.matches.rows_2), true)
    certain = (answer.answers_1.p_none[true[0]].filled(0.0) > 0.99).sum()
    return len(true[0]), int(right.sum()), int((~right).sum()), int(certain), answer, estimate


# ---- the average over all hypotheses and error models ----


@pytest.mark.parametrize("seed", range(6))
def test_the_average_is_the_sum_over_hypotheses_and_errors(seed):
    rng = np.random.default_rng(seed)
    first, second = (Records.of(rng.uniform(0.0, 3.0, (n, 2)), sigma=rng.uniform(0.1, 0.5, n)) for n in (4, 5))
    several = (Errors(), Errors(factor_1=2.0, factor_2=0.7), Errors((1.0, 3.0), (0.9, 0.1), floor=0.4))
    log_prior, numbers, seen, expected = np.log([0.5, 0.3, 0.2]), np.array([1.5, 2.0, 3.0]), (4, 5), 2.2
    pairs = Radius(200.0)(first, second)
    average = ErrorAverage(several, log_prior, np.full(3, 1e6))
    others = rng.normal(1.0, 1.0, len(pairs))
    begun = Average(average, average.log_densities(pairs), np.full(3, 1 / 3), numbers)
    after, found = begun.posterior(pairs, others, expected, seen, exact=True)

    odds = [np.log(n) - np.log1p(-n / 4) - np.log1p(-n / 5) for n in (*numbers, expected)]
    log_weight, shares = [], []
    for k, errors in enumerate(several):
        log_ratio = others + errors.log_density(pairs) + odds[k] - odds[3]
        ratios = dict(zip(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True), log_ratio, strict=True))
        log_z = logsumexp([score for score, _ in naive.scored_hypotheses(4, 5, ratios, lambda k: 0.0)])
        n = numbers[k]
        log_weight.append(log_prior[k] + log_z + n + 4 * np.log1p(-n / 4) + 5 * np.log1p(-n / 5))
        p, _, _ = naive.posterior(4, 5, ratios, lambda k: 0.0)
        shares.append([p[pair] for pair in ratios])
    weight = np.exp(log_weight - logsumexp(log_weight))
    np.testing.assert_allclose(after.weight, weight, rtol=1e-9)
    np.testing.assert_allclose(found.p_pair, weight @ np.array(shares), rtol=0, atol=1e-9)


def test_an_isolated_pair_has_its_averaged_odds():
    first, second = Records.of([[0.0, 0.0]], sigma=0.1), Records.of([[0.5, 0.0]], sigma=0.1)
    pairs = Radius(50.0)(first, second)
    average = ErrorAverage((Errors(), Errors(floor=0.5)), np.log([0.5, 0.5]), np.full(2, 1e4))
    begun = Average.of(average, pairs, np.array([0.5, 0.5]), 0.5)
    _, found = begun.posterior(pairs, np.array([2.0]), 0.5, (1, 1), exact=True)
    assert 0.0 < found.p_pair[0] < 1.0
    assert found.log_ratio[0] == pytest.approx(np.log(found.p_pair[0]) - np.log1p(-found.p_pair[0]), rel=1e-9)


# ---- fields ----


def test_one_floor_for_all_axes_equals_equal_floors_per_axis():
    first = Records.of([[0.0, 0.0]], sigma=0.1, source="first")
    second = Records.of([[0.6, 0.2]], sigma=0.1, source="second")
    prior = np.log([0.5, 0.5])
    mixed = ErrorAverage((Errors(floor=0.3), Errors(floor=(0.5, 0.1))), prior, np.full(2, 50.0))
    alike = ErrorAverage((Errors(floor=(0.3, 0.3)), Errors(floor=(0.5, 0.1))), prior, np.full(2, 50.0))
    one, other = (average.candidates(first, second) for average in (mixed, alike))
    assert len(one) == len(other) == 1
    typical = mixed.typical(np.array([0.25, 0.75])).floor
    np.testing.assert_allclose(typical, np.sqrt([0.25 * 0.09 + 0.75 * 0.25, 0.25 * 0.09 + 0.75 * 0.01]))


@pytest.mark.slow
@pytest.mark.parametrize("objects, floor, scale", [(20, 0.15, 1.0), (40, 0.5, 1.0), (100, 0.05, 1.0), (60, 0.0, 16.0)])
def test_clear_partners_are_found_whatever_the_quoted_errors(objects, floor, scale):
    for seed in range(3):
        scene = formal_field(np.random.default_rng([7, objects, seed]), objects, floor_arcsec=floor, scale=scale)
        true, found, wrong, certain, answer, estimate = counts(scene)
        assert found >= true - 1 and wrong <= 1 and certain == 0
        assert abs(answer.expected_wrong - wrong) < 1.5 and estimate.error_ranges is not None


def test_many_pairs_determine_floor_and_factor():
    scene = formal_field(np.random.default_rng(8), 1500, floor_arcsec=0.3)
    true, found, wrong, certain, _, estimate = counts(scene)
    assert found >= true - 1 and wrong <= 2 and certain == 0 and estimate.error_ranges is None
    assert estimate.errors.floor * estimate.errors.typical_scale == pytest.approx(0.3, rel=0.05)
    assert estimate.typical_scale == pytest.approx(0.3 / 0.07, rel=0.6) and estimate.gate_sigmas > 12.0


def test_true_errors_of_many_pairs_stay_as_quoted():
    scene = formal_field(np.random.default_rng(9), 1500)
    true, found, wrong, _, _, estimate = counts(scene)
    assert found == true and wrong == 0 and not estimate.errors.as_modelled


@pytest.mark.slow
def test_scaling_all_errors_leaves_the_results_unchanged():
    scene = formal_field(np.random.default_rng(10), 60, floor_arcsec=0.0)
    base, (true, *_) = counts(scene)[4], counts(scene)
    for factor in (0.5, 2.0, 5.0):
        other = counts(misquoted(scene, factor))[4]
        assert other.matches.rows_1.tolist() == base.matches.rows_1.tolist()
        assert other.matches.rows_2.tolist() == base.matches.rows_2.tolist()
        assert other.matches.p_match == pytest.approx(base.matches.p_match, abs=0.01)
    assert len(base.matches) == true


def test_the_order_of_the_sources_and_of_their_rows_does_not_matter():
    scene = formal_field(np.random.default_rng(11), 60, floor_arcsec=0.2)
    answer, estimate = match(scene.first, scene.second)
    back, swapped = match(scene.second, scene.first)
    assert swapped.common == pytest.approx(estimate.common, rel=1e-6)
    ours = sorted(zip(answer.rows_1.tolist(), answer.rows_2.tolist(), answer.p_pair, strict=True))
    theirs = sorted(zip(back.rows_2.tolist(), back.rows_1.tolist(), back.p_pair, strict=True))
    assert [x[:2] for x in ours] == [x[:2] for x in theirs]
    assert [x[2] for x in ours] == pytest.approx([x[2] for x in theirs], abs=1e-6)
    again, _ = match(shuffled(np.random.default_rng(1), scene.first), scene.second)
    assert again.p_pair.sum() == pytest.approx(answer.p_pair.sum(), rel=1e-9)


# ---- the grid ----


@pytest.mark.slow
def test_without_common_objects_no_partner_is_found():
    rng = np.random.default_rng(12)
    first, second = (
        Records.of(np.column_stack([rng.uniform(20, 20.3, 400), rng.uniform(0, 0.3, 400)]), sigma=0.2, space=Sphere())
        for _ in range(2)
    )
    assert scan_errors(Coverage.of(first, second)).contrast < 6.0
    answer, _ = match(first, second)
    assert len(answer.matches) < 4


def test_records_too_close_to_widen_their_errors_are_not_scanned():
    rng = np.random.default_rng(13)
    first, second = (Records.of(rng.uniform(0, 1, (300, 2)), sigma=0.05) for _ in range(2))
    assert scan_errors(Coverage.of(first, second)) is None


@pytest.mark.parametrize("apart_deg", [1.0, 60.0])
def test_disjoint_fields_are_not_scanned(apart_deg):
    # The density of the empty sky between the fields once made every record a candidate of every other: gigabytes.
    rng = np.random.default_rng(16)
    first, second = (
        Records.of(
            np.column_stack([rng.uniform(20, 20.3, 500), rng.uniform(at, at + 0.3, 500)]), sigma=0.2, space=Sphere()
        )
        for at in (0.0, apart_deg)
    )
    assert scan_errors(Coverage.of(first, second)) is None
    answer, estimate = match(first, second)
    assert len(answer.matches) == 0 and estimate.common < 1.0


def test_the_grid_is_finer_where_the_records_are_more_informative():
    scenes = [formal_field(np.random.default_rng(14), n, floor_arcsec=0.15) for n in (20, 200)]
    coarse, fine = (scan_errors(Coverage.of(s.first, s.second)) for s in scenes)
    for scan in (coarse, fine):
        assert MIN_POINTS <= len(scan.errors) <= MAX_POINTS
        assert scan.weight.sum() == pytest.approx(1.0) and scan.gain > 0.0
    spread = [np.std(np.log([e.factor_1 for e in scan.errors])) for scan in (coarse, fine)]
    assert spread[1] < spread[0]


# ---- the model of the errors ----


def test_the_error_model_is_the_covariance_of_every_pair():
    rng = np.random.default_rng(15)
    first, second = (Records.of(rng.uniform(0, 2, (6, 2)), covariance=np.array([[0.3, 0.1], [0.1, 0.2]])) for _ in "ab")
    errors = Errors((1.0, 3.0), (0.8, 0.2), factor_1=1.5, factor_2=0.5, floor=(0.2, 0.4))
    pairs = Radius(50.0)(first, second)
    covariance = (1.5**2 + 0.5**2) * np.array([[0.3, 0.1], [0.1, 0.2]]) + np.diag([0.04, 0.16])
    due = [
        logsumexp([np.log(w) + naive.log_normal(delta, s**2 * covariance) for s, w in ((1.0, 0.8), (3.0, 0.2))])
        for delta in pairs.residual
    ]
    np.testing.assert_allclose(errors.log_density(pairs), due, rtol=1e-10)
    # The gate of the records with modelled errors is that of the model.
    near = Radius(3.0)(*errors.records(first, second))
    assert len(near) == int((errors.pairs(pairs).mahalanobis_sq <= 9.0).sum())


@pytest.mark.parametrize("wrong", [{"factor_1": 0.0}, {"factor_2": -1.0}, {"floor": -0.1}, {"floor": (0.1, np.inf)}])
def test_impossible_error_models_are_refused(wrong):
    with pytest.raises(InputError, match="floor of 0 or more"):
        Errors(**wrong)


# ---- tails, few pairs, crowds ----


def doubtful(scenes):
    """(stated, observed) sums over the candidates with doubtful probabilities."""
    stated, observed = 0.0, 0
    for scene in scenes:
        answer, _ = match(scene.first, scene.second)
        happened = is_true_pair((answer.rows_1, answer.rows_2), scene.true_pairs())
        some = (answer.p_pair > 0.02) & (answer.p_pair < 0.5)
        stated, observed = stated + float(answer.p_pair[some].sum()), observed + int(happened[some].sum())
    return stated, observed


def test_a_tail_of_few_pairs_is_found_and_its_absence_too():
    # The share of the tail was 3 % with any data: 1.6 times too many doubtful pairs were true with a tail of a sixth.
    scans = []
    for tail in ((0.0, 1.0), (0.2, 4.0)):
        scene = formal_field(np.random.default_rng(21), 300, tail=tail, quoted_arcsec=(0.05, 0.5), per_deg2=47_000.0)
        _, estimate = match(scene.first, scene.second)
        assert estimate.error_ranges is not None
        scans.append(1.0 - estimate.errors.shares[0])
    assert scans[0] < 0.02 and 0.12 < scans[1] < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("tail", [(0.0, 1.0), (0.15, 4.0)])
@pytest.mark.long_after(1)
def test_doubtful_pairs_are_as_probable_as_stated_with_and_without_a_tail(tail):
    scenes = [
        formal_field(np.random.default_rng([22, k]), 60, tail=tail, quoted_arcsec=(0.05, 0.5), per_deg2=1_400_000.0)
        for k in range(6)
    ]
    stated, observed = doubtful(scenes)
    assert stated - 4.0 * np.sqrt(stated) < observed < 1.5 * stated + 3.0 * np.sqrt(stated)


def test_ten_pairs_with_larger_errors_than_quoted_are_not_certain_to_have_no_partner():
    # Nothing stands out from chance in such a field; the quoted errors were then used, and true pairs had p 0.
    stated = observed = 0.0
    for k in range(8):
        scene = formal_field(
            np.random.default_rng([23, k]), 14, quoted_arcsec=(0.05, 0.5), per_deg2=1_400_000.0, floor_arcsec=0.5
        )
        answer, estimate = match(scene.first, scene.second)
        true = scene.true_pairs()
        assert estimate.error_ranges is not None
        stated += float(answer.answers_1.p_none[true[0]].sum())
        observed += len(true[0])
    assert stated < 0.4 * observed


def test_errors_of_a_small_crowded_field_are_averaged_over():
    # With four chance candidates within 3σ no errors but the quoted ones were tried.
    scene = formal_field(np.random.default_rng(24), 100, quoted_arcsec=(0.05, 0.5), per_deg2=19_000_000.0, scale=2.0)
    answer, estimate = match(scene.first, scene.second)
    assert estimate.error_ranges is not None and estimate.typical_scale > 1.3
    assert len(answer.pairs) < 100 * len(scene.first)
