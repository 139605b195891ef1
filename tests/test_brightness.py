"""Magnitudes as evidence: learned from the data, calibrated, and harmless where they are uninformative."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from benchmarks.exposures import Sky, exposure
from benchmarks.misstated import misquoted, with_outliers

from problems import calibration, counterparts_of_ellipses
from sameas import InputError, PoissonField, Records, identify
from sameas.estimate.gate_search import MatchTuning
from sameas.estimate.match import match
from sameas.estimate.photometry import Photometry, Sample, density_of, fit_relation
from sameas.evidence import Brightness, Chain, Magnitudes, SourceMagnitudes
from sameas.evidence.detection import DetectionCurve, LinearSpline, ShareCurve, knots_of, logit, share_error
from sameas.score.pairs import is_true_pair


def wrong(answer, scene):
    claimed = answer.matches.rows_1, answer.matches.rows_2
    return int((~is_true_pair(claimed, scene.true_pairs())).sum())


@pytest.fixture(scope="module")
def frame():
    return exposure(np.random.default_rng(1), Sky(stars_per_deg2=400_000.0), side_deg=0.12)


@pytest.fixture(scope="module")
def alone(frame):
    return match(frame.scene.first, frame.scene.second, precision=False)


@pytest.fixture(scope="module")
def found(frame):
    return match(frame.scene.first, frame.scene.second, brightness=frame.brightness)


# ---- benefit ----


@pytest.mark.slow
def test_magnitudes_remove_most_false_matches(frame, alone, found):
    assert wrong(alone[0], frame.scene) > 20
    assert wrong(found[0], frame.scene) < 0.4 * wrong(alone[0], frame.scene)
    score = calibration(found[0], frame.scene)
    assert score.expected_calibration_error < 0.005
    assert score.brier < 0.4 * calibration(alone[0], frame.scene).brier


def test_the_result_is_one_to_one_and_converged(found):
    answer, estimate = found
    assert len(np.unique(answer.matches.rows_1)) == len(np.unique(answer.matches.rows_2)) == len(answer.matches)
    assert estimate.converged and estimate.notes == ()


def test_the_contribution_of_every_term_is_reported(alone, found):
    assert set(found[1].decisive) == {"position", "densities", "completeness", "brightness"}
    assert set(alone[1].decisive) == {"position", "densities"}
    assert all(value > 0.5 for value in found[1].decisive.values())
    assert found[1].changed_by_brightness > 20 and alone[1].changed_by_brightness == 0
    assert set(found[0].evidence.terms) == set(found[1].decisive)


def test_zero_point_scatter_and_colour_term_are_found_within_their_errors(frame, found):
    quantities = found[1].quantities
    true = {"scatter": frame.sky.scatter, "error_scale": 1.0, "common": len(frame.scene.true_pairs()[0])}
    rows = frame.scene.true_pairs()
    difference = [np.asarray(m.values)[r, 0] for m, r in zip(frame.brightness, rows, strict=True)]
    true["zero_point"] = float(np.mean(difference[0] - difference[1]))
    for name, value in true.items():
        quantity = quantities[name]
        assert abs(quantity.value - value) < 3.5 * quantity.standard_error, (name, quantity, value)
        assert 0.0 < quantity.standard_error < 0.1 * abs(value)
    # The colour is measured with errors, which make its slope a little smaller.
    assert quantities["colour_I"].value == pytest.approx(-frame.sky.colour_term, abs=0.02)


def test_completeness_is_found_at_every_magnitude(frame, found):
    curve = found[1].detection_2
    seen, true = np.asarray(frame.brightness[1].values)[:, 0], frame.magnitude[frame.scene.truth_2]
    at = np.searchsorted(curve.edges, seen, side="right") - 1
    expected = np.array([frame.sky.completeness(true[at == k]).mean() for k in range(len(curve.number))])
    deviation = (curve.probability - expected) / curve.standard_error
    assert np.abs(deviation).max() < 4.0 and np.mean(np.abs(deviation) < 2.0) > 0.8
    assert curve.probability[0] > 0.9 and curve.probability[-1] < 0.05 and len(curve.number) > 8
    assert curve.number.sum() == len(frame.scene.second)
    # Detections in the frame only: uncatalogued stars and false detections.
    beta = found[1].detection_1
    density = float((beta.density * np.diff(beta.edges)).sum()) * frame.area_arcsec2
    assert density == pytest.approx(len(frame.scene.first) - len(frame.scene.true_pairs()[0]), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", [lambda rng, s: misquoted(s, 1.7), lambda rng, s: with_outliers(rng, s, 0.02)], ids=["1.7", "outliers"]
)
def test_probabilities_stay_calibrated_with_wrongly_quoted_errors(frame, change):
    scene = change(np.random.default_rng(2), frame.scene)
    answer, _ = match(scene.first, scene.second, brightness=frame.brightness)
    assert calibration(answer, scene).expected_calibration_error < 0.01


# ---- uninformative magnitudes ----


@pytest.mark.slow
def test_uninformative_magnitudes_change_almost_nothing(frame, alone):
    rng = np.random.default_rng(3)
    first, second = frame.scene.first, frame.scene.second
    noise = Magnitudes(rng.normal(15.0, 1.0, len(first))), Magnitudes(rng.normal(15.0, 1.0, len(second)))
    answer, estimate = match(first, second, brightness=noise)
    assert wrong(answer, frame.scene) < 1.15 * wrong(alone[0], frame.scene)
    # Compare sums over the candidates: the gate by positions alone holds more of them.
    score, before = calibration(answer, frame.scene), calibration(alone[0], frame.scene)
    assert score.brier * score.n < 1.05 * before.brier * before.n
    assert score.expected_calibration_error < 0.01
    assert estimate.decisive["brightness"] < 0.2 and estimate.decisive["completeness"] < 0.3


def test_a_nonlinear_relation_does_no_harm(frame, alone):
    bent = np.asarray(frame.brightness[0].values)[:, 0]
    bent = Magnitudes(bent + 0.15 * (bent - 16.0) ** 2, 0.05)
    answer, _ = match(frame.scene.first, frame.scene.second, brightness=(bent, frame.brightness[1]))
    assert wrong(answer, frame.scene) < 0.4 * wrong(alone[0], frame.scene)
    assert calibration(answer, frame.scene).expected_calibration_error < 0.006


@pytest.mark.slow
def test_missing_magnitudes_are_neutral_and_the_others_still_help():
    made = exposure(np.random.default_rng(4), Sky(stars_per_deg2=400_000.0), side_deg=0.12, missing=0.3)
    scene = made.scene
    answer, _ = match(scene.first, scene.second, brightness=made.brightness)
    assert wrong(answer, scene) < 0.75 * wrong(match(scene.first, scene.second, precision=False)[0], scene)
    assert calibration(answer, scene).expected_calibration_error < 0.006
    one = np.isnan(np.asarray(made.brightness[0].values)[:, 0])[answer.pairs.i]
    two = np.isnan(np.asarray(made.brightness[1].values)).all(axis=1)[answer.pairs.j]
    assert np.all(answer.evidence.terms["brightness"][one & two] == 0.0)
    nowhere = np.isnan(np.asarray(made.brightness[1].values)[:, 0])[answer.pairs.j]
    assert np.all(answer.evidence.terms["completeness"][one & nowhere] == 0.0)


@pytest.mark.slow
def test_magnitudes_of_one_source_have_their_full_weight_where_the_other_has_none():
    """They tell whether a record has a partner. Half of that was left out: 36 more than the 510 true pairs were
    expected, and 17 % of the records at p = 0.5 had a partner."""
    deviations = []
    for seed in range(6):
        rng = np.random.default_rng([31, seed])
        first, second, partner, magnitude = counterparts_of_ellipses(rng)
        unknown = Magnitudes(np.full(len(first), np.nan))
        found = match(first, second, brightness=(unknown, Magnitudes(magnitude)))[1].quantities["common"]
        deviations.append((found.value - np.count_nonzero(partner >= 0)) / found.standard_error)
    assert abs(np.mean(deviations)) < 2.0 and np.max(np.abs(deviations)) < 5.0


def test_swapping_the_sources_swaps_the_answer(frame, found):
    back, estimate = match(frame.scene.second, frame.scene.first, brightness=frame.brightness[::-1])
    assert estimate.common == pytest.approx(found[1].common, rel=2e-3)
    forth = dict(zip(found[0].matches.rows_1.tolist(), found[0].matches.rows_2.tolist(), strict=True))
    turned = dict(zip(back.matches.rows_2.tolist(), back.matches.rows_1.tolist(), strict=True))
    assert sum(forth[i] == j for i, j in turned.items() if i in forth) > 0.998 * len(forth)


@pytest.mark.slow
def test_too_few_pairs_to_learn_magnitudes_are_reported():
    rng = np.random.default_rng(5)
    place = rng.uniform(0.0, 100.0, (30, 2))
    first, second = (Records.of(place + rng.normal(0.0, 0.1, (30, 2)), sigma=0.1) for _ in range(2))
    magnitudes = Magnitudes(rng.normal(15.0, 1.0, 30))
    answer, estimate = match(first, second, brightness=(magnitudes, magnitudes))
    assert len(answer.matches) == 30 and estimate.photometry is None and estimate.detection_1 is None
    assert any("too few pairs with magnitudes" in note and "not used" in note for note in estimate.notes)


@pytest.mark.parametrize("limit", [1, 2, 4, 5, 6, 7, 8])
def test_em_iterations_may_reach_their_limit_before_and_after_the_gate_widens(limit):
    made = exposure(np.random.default_rng(18), Sky(stars_per_deg2=60_000.0), side_deg=0.12)
    scene = misquoted(made.scene, 2.0)
    tuning = MatchTuning(max_iterations=limit)
    answer, estimate = match(scene.first, scene.second, brightness=made.brightness, tuning=tuning)
    assert estimate.converged != any("had not converged" in note for note in estimate.notes)
    assert estimate.converged or estimate.iterations == limit
    assert len(answer.matches) > 0 and np.isfinite(answer.p_pair).all()


@pytest.mark.slow
@pytest.mark.long
def test_unrelated_sources_learn_nothing_from_magnitudes():
    rng = np.random.default_rng(6)
    first, second = (Records.of(rng.uniform(0.0, 40.0, (1000, 2)), sigma=0.3) for _ in range(2))
    magnitudes = Magnitudes(rng.normal(15.0, 1.0, 1000)), Magnitudes(rng.normal(15.0, 1.0, 1000))
    answer, estimate = match(first, second, brightness=magnitudes)
    assert estimate.photometry is None
    assert len(answer.matches) < 200 and "brightness" not in answer.evidence.terms


@pytest.mark.parametrize("values", [np.full(400, np.nan), np.full(400, 15.0)], ids=["none", "all alike"])
def test_random_magnitudes_are_harmless(values):
    rng = np.random.default_rng(7)
    place = rng.uniform(0.0, 60.0, (400, 2))
    first, second = (Records.of(place + rng.normal(0.0, 0.1, (400, 2)), sigma=0.1) for _ in range(2))
    answer, _ = match(first, second, brightness=(Magnitudes(values), Magnitudes(values)))
    assert np.mean(answer.matches.rows_1 == answer.matches.rows_2) > 0.99 and len(answer.matches) > 390
    assert np.isfinite(answer.evidence.log_ratio).all()


# ---- the rule ----


@pytest.mark.slow
def test_the_rule_adds_to_the_position_rule(frame, found):
    answer, estimate = found
    shares = tuple(np.full(len(r), 0.5) for r in (frame.scene.first, frame.scene.second))
    brightness = estimate.photometry.rule(shares)
    assert isinstance(brightness, Brightness)
    again = identify(frame.scene.first, frame.scene.second, rule=PoissonField(0.005, 0.001, 0.01) + brightness)
    assert set(again.evidence.terms) == {"position", "densities", "completeness", "brightness"}
    # Other pairs than those it was learned from are evaluated again, with the same result.
    fresh = dataclasses.replace(brightness, comparisons=None)(answer.pairs).terms["brightness"]
    assert fresh == pytest.approx(brightness(answer.pairs).terms["brightness"], abs=1e-12)


def test_the_ratio_is_that_of_the_true_densities_for_one_normal_band():
    rng = np.random.default_rng(8)
    n, spread, scatter = 6000, 1.5, 0.2
    true = rng.normal(16.0, spread, n)
    one, two = true + 0.3 + rng.normal(0.0, scatter, n), true
    measured = [Magnitudes(x).of(Records.of(np.arange(n)[:, None], sigma=1.0)) for x in (one, two)]
    photometry = Photometry.of((measured[0], measured[1]), (("a",), ("b",)))

    class EveryPair:
        i = j = np.arange(n)

    training: Any = EveryPair, np.ones(n), (np.ones(n),) * 2, (np.full(n, 0.5),) * 2, (np.ones(n, bool),) * 2
    learned = photometry.fitted(*training).fitted(*training, last=True)
    at = rng.permutation(n)[:500]
    forth = learned.chains[0].log_ratio(learned.sides[0].compared(at, measured[1].take(at)))
    back = learned.chains[1].log_ratio(learned.sides[1].compared(at, measured[0].take(at)))
    total = spread**2 + scatter**2

    def normal(x, variance):
        return -0.5 * x**2 / variance - 0.5 * math.log(2.0 * math.pi * variance)

    exact = normal(one[at] - two[at] - 0.3, scatter**2) - normal(one[at] - 16.3, total)
    central = np.abs(true[at] - 16.0) < 2.0 * spread
    assert np.abs(forth - exact)[central].max() < 0.6 and abs(np.mean((forth - exact)[central])) < 0.05
    assert abs(np.mean((back - exact)[central])) < 0.05


def test_the_ratio_is_bounded_below_by_the_unrelated_share(found):
    relation = found[1].photometry.first_relation
    far = np.array([5.0, 15.0, 40.0])
    others, none = np.column_stack([far + 100.0] * (1 + len(relation.slopes))), np.zeros((3, 1 + len(relation.slopes)))
    density = relation.background(far)
    ratio = relation.log_density(far, others, np.full(3, 0.01), none, np.exp(density)) - density
    assert ratio == pytest.approx(math.log(relation.unrelated))


def test_bands_of_one_source_are_not_counted_twice():
    rng = np.random.default_rng(9)
    n = 4000
    true = rng.normal(16.0, 1.5, n)
    second = Magnitudes(true + rng.normal(0.0, 0.2, n))
    once = true + rng.normal(0.0, 0.2, n)
    # The second band repeats the first and must not raise any probability.
    twice = np.column_stack([once, once + rng.normal(0.0, 0.01, n)])
    records = Records.of(np.arange(n)[:, None], sigma=1.0)

    class EveryPair:
        i = j = np.arange(n)

    training: Any = EveryPair, np.ones(n), (np.ones(n),) * 2, (np.full(n, 0.5),) * 2, (np.ones(n, bool),) * 2
    ratios = []
    for values in (once, twice):
        measured = Magnitudes(values).of(records), second.of(records)
        learned = Photometry.of(measured, (("a", "b")[: np.ndim(values)], ("c",))).fitted(*training)
        learned = learned.fitted(*training, last=True)
        ratios.append(learned.chains[0].log_ratio(learned.sides[0].compared(EveryPair.i, measured[1])))
    assert np.mean(ratios[0]) > 1.0
    assert np.mean(ratios[1]) == pytest.approx(np.mean(ratios[0]), abs=0.03)
    assert np.std(ratios[1] - ratios[0]) < 0.2


@pytest.mark.parametrize(
    "make, words",
    [
        (
            lambda: Magnitudes(np.zeros((2, 2, 2))),
            r"magnitudes have shape \(2, 2, 2\); give \(rows,\) or \(rows, bands\)",
        ),
        (lambda: Magnitudes(["a", "b"]), "magnitudes are not numbers"),
        (lambda: Magnitudes([1.0, 2.0], sigma=[0.1, -0.1]), r"1 are negative \(first: row 1\)"),
        (lambda: Magnitudes([1.0, 2.0], sigma=np.ones((3, 1))), "give one number, or one each"),
        (lambda: Magnitudes([1.0, 2.0], names=("G", "J")), "2 names for 1 bands"),
    ],
)
def test_invalid_magnitudes_are_refused_with_a_clear_message(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_magnitudes_of_another_table_are_refused():
    with pytest.raises(InputError, match="plate: 2 magnitudes for 3 rows; give one for every row of its table"):
        Magnitudes([1.0, 2.0]).of(Records.of(np.zeros(3), sigma=1.0, source="plate"))


def test_masked_cells_are_missing_and_unknown_errors_count_as_scatter():
    values = np.ma.MaskedArray([15.0, 16.0], [False, True])
    magnitudes = Magnitudes(values, sigma=[np.nan, 0.1])
    measured = magnitudes.of(Records.of(np.zeros(2), sigma=1.0))
    assert np.isnan(measured.values[1, 0]) and measured.variance[:, 0].tolist() == pytest.approx([0.0, 0.01])


@pytest.mark.slow
def test_rows_set_aside_do_not_shift_the_magnitudes_of_others():
    records = Records.of([[0.0], [np.nan], [2.0]], sigma=1.0)
    assert Magnitudes([10.0, 11.0, 12.0]).of(records).values[:, 0].tolist() == [10.0, 12.0]


def test_a_chain_without_relations_has_no_evidence():
    records = Records.of(np.zeros(3), sigma=1.0)
    measured = Magnitudes([10.0, 11.0, 12.0]).of(records)
    side = SourceMagnitudes(measured, (density_of(np.linspace(10.0, 12.0, 60)),), ({},))
    assert np.all(Chain(({},)).log_ratio(side.compared(np.arange(3), measured)) == 0.0)


# ---- components ----


def test_a_relation_and_its_errors_are_recovered():
    deviations = []
    for seed in range(60):
        rng = np.random.default_rng([10, seed])
        x = rng.uniform(14.0, 20.0, 800)
        colour, error = rng.normal(0.8, 0.4, 800), rng.uniform(0.02, 0.15, 800)
        y = x + 0.5 + 0.1 * (colour - 0.8) + rng.normal(0.0, 1.0, 800) * np.hypot(0.08, error)
        lost = rng.uniform(size=800) < 0.03
        y[lost] = rng.uniform(12.0, 22.0, int(lost.sum()))
        background = np.exp(density_of(y)(y))
        sample = Sample.of(
            y, np.column_stack([x, x - colour]), error**2, np.zeros((800, 2)), background, np.ones(800), background
        )
        relation = fit_relation(sample, density_of(y))
        relation = fit_relation(sample, density_of(y), relation, last=True)
        truth = 0.5 + 0.1 * float(np.average(colour[~lost] - 0.8))
        deviations.append([
            (relation.zero_point - truth) / relation.zero_point_error,
            (relation.slopes[0] + 0.1) / relation.slope_errors[0],
            (relation.typical_scatter - 0.08) / relation.scatter_error,
            (relation.unrelated - 0.03) / math.sqrt(0.03 / 800),
        ])  # fmt: skip
    deviation = np.array(deviations)
    assert np.all(np.mean(np.abs(deviation) < 1.96, axis=0) > 0.85)
    assert np.all(np.abs(deviation.mean(axis=0)) < 0.5) and np.all(deviation.std(axis=0) < 1.4)


def test_a_magnitude_density_integrates_to_one_and_is_never_zero():
    density = density_of(np.random.default_rng(11).normal(18.0, 1.0, 5000))
    step = density.grid[1] - density.grid[0]
    assert np.exp(density.log_density).sum() * step == pytest.approx(1.0, abs=1e-3)
    normal = -0.5 * np.log(2 * np.pi)
    assert density(np.array([18.0]))[0] == pytest.approx(normal, abs=0.1)
    assert np.isfinite(density(np.array([-50.0, 90.0]))).all()


def test_detection_shares_are_recovered_on_top_of_local_shares():
    rng = np.random.default_rng(12)
    magnitude, position = rng.uniform(14.0, 20.0, 20_000), rng.choice([0.3, 0.8], 20_000)
    true = 1.0 / (1.0 + np.exp(-(logit(position) + 2.0 - 1.0 * (magnitude - 16.0))))
    shown = (rng.uniform(size=20_000) < true).astype(float)
    curve = ShareCurve.fit(magnitude, position, shown)
    at = np.linspace(14.5, 19.5, 6)
    fitted = LinearSpline.at(curve.knots, at).curve(curve.values)
    assert fitted == pytest.approx(2.0 - (at - 16.0), abs=0.3)
    terms = curve.terms(np.array([16.0, np.nan]), np.array([0.5, 0.5]))
    s = 1.0 / (1.0 + math.exp(-2.0))
    assert terms[0] == pytest.approx(0.5 * math.log(s / 0.5) - math.log((1 - s) / 0.5), abs=0.3) and terms[1] == 0.0


def test_a_detection_curve_of_shares_all_one_stays_finite():
    magnitude = np.linspace(10.0, 20.0, 1000)
    curve = ShareCurve.fit(magnitude, np.full(1000, 0.9999), np.ones(1000))
    assert np.isfinite(curve.values).all() and np.isfinite(curve.terms(magnitude, np.full(1000, 0.9999))).all()


def test_bins_of_the_detection_curve_hold_all_records_and_enough_each():
    rng = np.random.default_rng(13)
    magnitude = rng.normal(18.0, 1.5, 3000)
    curve = DetectionCurve.of("G", magnitude, np.full(3000, 0.4), 100.0)
    assert curve.number.sum() == 3000 and curve.number.min() >= 30 and len(curve.middle) == len(curve.number)
    assert np.all(curve.probability == pytest.approx(0.4)) and np.all(np.diff(curve.edges) > 0.0)
    # Uncertain pairs carry less information than the same number of certain pairs.
    sure = share_error(np.array([100.0]), np.array([40.0]), np.array([0.0]))
    assert share_error(np.array([100.0]), np.array([40.0]), np.array([12.0]))[0] > 1.2 * sure[0]


def test_the_linear_basis_interpolates_and_its_sums_agree_with_the_matrix():
    rng = np.random.default_rng(14)
    knots, x, weights = np.array([0.0, 1.0, 3.0]), rng.uniform(-1.0, 4.0, 50), rng.uniform(size=50)
    spline = LinearSpline.at(knots, x)
    assert spline.curve(np.array([1.0, 2.0, -1.0])) == pytest.approx(np.interp(x, knots, [1.0, 2.0, -1.0]))
    matrix = np.column_stack([spline.curve(row) for row in np.eye(3)])
    assert spline.sum(weights) == pytest.approx(matrix.T @ weights)
    single = LinearSpline.at(np.array([2.0]), x)
    assert single.curve(np.array([5.0])) == pytest.approx(5.0) and single.sum(weights) == pytest.approx(weights.sum())


def test_knots_follow_the_weight():
    x = np.concatenate([np.zeros(100), np.linspace(1.0, 2.0, 900)])
    knots = knots_of(x, np.ones(1000), 100.0, 6)
    assert len(knots) <= 6 and np.all(np.diff(knots) > 0) and knots[0] == 0.0
    assert len(knots_of(np.full(50, 3.0), np.ones(50), 10.0, 6)) == 1


@pytest.mark.slow
def test_a_simulated_exposure_has_the_stated_false_and_uncatalogued_shares():
    sky = Sky(stars_per_deg2=400_000.0)
    made = exposure(np.random.default_rng(15), sky, side_deg=0.2)
    scene = made.scene
    assert scene.false_1.mean() == pytest.approx(0.08, abs=0.01)
    rows = scene.true_pairs()
    uncatalogued = 1.0 - len(rows[0]) / int((~scene.false_1).sum())
    assert uncatalogued == pytest.approx(0.08, abs=0.01)
    scale = match(scene.first, scene.second)[1].quantities["error_scale"]
    assert scale.value == pytest.approx(1.0, abs=0.03)
    assert misquoted(scene, 2.0).first.covariance == pytest.approx(scene.first.covariance / 4.0)
    moved = with_outliers(np.random.default_rng(16), scene, 0.05)
    assert np.mean(np.any(moved.first.features != scene.first.features, axis=1)) == pytest.approx(0.05, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3])
def test_hardly_any_pair_is_taken_for_one_with_unrelated_magnitudes_where_there_is_none(seed):
    """The share was estimated from a thousand pairs, with probabilities that already rested on a larger share: 0.1 to
    0.2 %, and false pairs with good positions became pairs with unrelated magnitudes."""
    made = exposure(np.random.default_rng([seed, 9]), Sky(stars_per_deg2=3_000_000.0, uncatalogued=0.3), side_deg=0.15)
    _, estimate = match(made.scene.first, made.scene.second, brightness=made.brightness)
    assert estimate.photometry.first_relation.unrelated < 2e-4


@pytest.mark.slow
def test_unrelated_magnitudes_do_not_hide_pairs():
    """In a crowded field with permuted frame magnitudes, completeness and error grades once counted the same
    information twice, and one in six common objects was lost."""
    made = exposure(np.random.default_rng([77, 2]), Sky(stars_per_deg2=8_000_000.0), side_deg=0.02)
    scene, (frame, catalogue) = made.scene, made.brightness
    shuffled = np.random.default_rng(5).permutation(np.asarray(frame.values)[:, 0])
    one_band = Magnitudes(np.asarray(catalogue.values)[:, 0], np.asarray(catalogue.sigma)[:, 0], ("V",))
    answer, estimate = match(scene.first, scene.second, brightness=(Magnitudes(shuffled), one_band))
    true = len(scene.true_pairs()[0])
    assert abs(estimate.common / true - 1.0) < 0.08
    assert any("are unrelated" in note for note in estimate.notes)
    claimed = answer.matches.rows_1, answer.matches.rows_2
    assert is_true_pair(claimed, scene.true_pairs()).sum() > 0.87 * true


def test_magnitude_errors_larger_than_the_scatter_of_magnitudes_are_reported():
    """Saturated stars of a plate; they were once reported as unrelated magnitudes."""
    made = exposure(np.random.default_rng([78, 1]), Sky(stars_per_deg2=20_000.0), side_deg=0.2)
    scene, rng = made.scene, np.random.default_rng(6)
    first, second = rng.normal(12.0, 0.2, len(scene.first)), rng.normal(13.0, 0.2, len(scene.second))
    i, j = scene.true_pairs()
    first[i] = second[j] - 1.0 + rng.normal(0.0, 0.15, len(i))
    vague = Magnitudes(first, np.full(len(first), 0.5)), Magnitudes(second, np.full(len(second), 0.01))
    _, estimate = match(scene.first, scene.second, brightness=vague)
    (note,) = (note for note in estimate.notes if "magnitudes" in note)
    assert note.startswith("the quoted errors of the magnitudes, 0.5 mag, are larger than the spread")
