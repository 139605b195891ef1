"""Error grades: the sizes of quoted errors as evidence, calibrated, and neutral where they are uninformative."""

import numpy as np
import pytest
from benchmarks.exposures import Sky, exposure

from sameas import Records
from sameas.estimate.grades import PSEUDO_COUNT, Grades, Scale
from sameas.estimate.match import match
from sameas.evidence import Errors, Magnitudes
from sameas.score.pairs import is_true_pair, score_probabilities
from sameas.simulate import counterparts

FLAT = Sky(
    catalogue_sigma_arcsec=(0.15, 0.15), motion_sigma_mas_per_yr=(5.0, 5.0), unknown_motion=0.0,
    frame_sigma_arcsec=(0.2, 0.2),
)  # fmt: skip


def claimed(answer):
    return answer.matches.rows_1, answer.matches.rows_2


def wrong(answer, scene):
    return int((~is_true_pair(claimed(answer), scene.true_pairs())).sum())


@pytest.fixture(scope="module")
def frames():
    return [exposure(np.random.default_rng([11, k]), side_deg=0.12) for k in range(6)]


@pytest.fixture(scope="module")
def found(frames):
    return [match(made.scene.first, made.scene.second) for made in frames]


# ---- benefit ----


@pytest.mark.slow
def test_quoted_errors_remove_a_third_of_the_false_matches(frames, found):
    without = [match(made.scene.first, made.scene.second, precision=False)[0] for made in frames]
    with_grades = sum(wrong(answer, made.scene) for (answer, _), made in zip(found, frames, strict=True))
    assert with_grades < 0.67 * sum(wrong(answer, made.scene) for answer, made in zip(without, frames, strict=True))


def test_probabilities_with_grades_are_calibrated(frames, found):
    stated, happened = [], []
    for made, (answer, _) in zip(frames, found, strict=True):
        stated.append(answer.p_pair)
        happened.append(is_true_pair((answer.rows_1, answer.rows_2), made.scene.true_pairs()))
    assert score_probabilities(np.concatenate(stated), np.concatenate(happened)).expected_calibration_error < 0.003


@pytest.mark.slow
@pytest.mark.long
def test_the_number_of_common_objects_is_not_biased(frames, found):
    more = [exposure(np.random.default_rng([12, k]), side_deg=0.12) for k in range(24)]
    estimates = [estimate for _, estimate in found] + [match(m.scene.first, m.scene.second)[1] for m in more]
    deviations = [
        (estimate.common - len(made.scene.true_pairs()[0])) / estimate.quantities["common"].standard_error
        for made, estimate in zip(frames + more, estimates, strict=True)
    ]
    assert abs(np.mean(deviations)) < 0.3 + 3.0 / np.sqrt(len(deviations))
    assert np.mean(np.abs(deviations) < 1.96) >= 0.8


def test_large_errors_lower_the_odds_of_a_match_in_a_shallower_source(found):
    answer, estimate = found[0]
    assert estimate.decisive["precision"] > 0.1 and "precision" in answer.evidence.terms
    volume = answer.second.covariance[:, 0] * answer.second.covariance[:, -1]
    faint = volume[answer.pairs.j] > np.quantile(volume, 0.9)
    precision = answer.evidence.terms["precision"]
    assert np.median(precision[faint]) < -0.5 < np.median(precision[answer.chosen])


@pytest.mark.slow
def test_without_magnitudes_the_errors_are_used():
    crowded, lost = Sky(stars_per_deg2=400_000.0), 0
    kept = 0
    for k in range(3):
        made = exposure(np.random.default_rng([4, k]), crowded, side_deg=0.12, missing=0.5)
        first, second = made.scene.first, made.scene.second
        lost += wrong(match(first, second, brightness=made.brightness, precision=False)[0], made.scene)
        kept += wrong(match(first, second, brightness=made.brightness)[0], made.scene)
    assert kept < 0.9 * lost


# ---- uninformative errors ----


def test_uninformative_errors_change_nothing():
    scene = exposure(np.random.default_rng(3), FLAT, side_deg=0.12).scene
    answer, _ = match(scene.first, scene.second)
    assert "precision" not in answer.evidence.terms
    assert np.array_equal(answer.p_pair, match(scene.first, scene.second, precision=False)[0].p_pair)


def test_grades_learn_nothing_if_magnitudes_contain_the_information(frames):
    made = frames[0]
    answer, _ = match(made.scene.first, made.scene.second, brightness=made.brightness)
    assert "precision" not in answer.evidence.terms


def test_few_records_or_equal_errors_have_no_grades():
    scene = exposure(np.random.default_rng(3), side_deg=0.01).scene
    assert "precision" not in match(scene.first, scene.second)[0].evidence.terms


def test_unrelated_sources_get_no_matches_from_grades(frames):
    answer, estimate = match(frames[0].scene.first, frames[1].scene.second)
    assert estimate.common < 0.02 * len(answer.first) and "precision" not in answer.evidence.terms


# ---- invariances ----


def test_swapping_the_sources_transposes_the_evidence(frames, found):
    scene, (answer, _) = frames[0].scene, found[0]
    other, _ = match(scene.second, scene.first)
    mine = dict(zip(zip(answer.pairs.i, answer.pairs.j, strict=True), answer.p_pair, strict=True))
    theirs = dict(zip(zip(other.pairs.j, other.pairs.i, strict=True), other.p_pair, strict=True))
    assert max(abs(p - theirs.get(key, 0.0)) for key, p in mine.items()) < 0.05


# ---- grades ----


def test_grades_are_about_equal_in_number_and_rise_with_the_error():
    volume = np.random.default_rng(1).normal(size=5000)
    grades = Scale.of(volume, None, 8).grades(volume, None)
    assert np.bincount(grades, minlength=8).min() > 500 and grades.max() == 7
    assert np.all(np.diff(grades[np.argsort(volume)]) >= 0)


def test_equal_errors_have_equal_grades():
    volume = np.repeat([0.0, 1.0], [3000, 1000])
    grades = Scale.of(volume, None, 6).grades(volume, None)
    assert len(np.unique(grades[:3000])) == 1 and len(np.unique(grades[3000:])) == 1 and grades[0] <= grades[-1]


def test_grades_are_independent_of_the_magnitude():
    rng = np.random.default_rng(2)
    magnitude = rng.uniform(12.0, 20.0, 4000)
    volume = magnitude + rng.normal(size=4000)
    grades = Scale.of(volume, magnitude, 4).grades(volume, magnitude)
    assert abs(np.corrcoef(grades, magnitude)[0, 1]) < 0.1 < np.corrcoef(grades, volume)[0, 1]


def test_records_without_magnitude_are_graded_separately():
    rng = np.random.default_rng(2)
    magnitude = np.where(rng.uniform(size=4000) < 0.3, np.nan, rng.uniform(12.0, 20.0, 4000))
    volume = rng.normal(size=4000)
    scale = Scale.of(volume, magnitude, 4)
    grades = scale.grades(volume, magnitude)
    missing = np.isnan(magnitude)
    assert scale.size == 8 and grades[missing].min() == 4 and grades[~missing].max() == 3
    assert np.bincount(grades[missing] - 4).min() > 200


def test_the_unit_of_a_feature_does_not_matter():
    rng = np.random.default_rng(5)
    volume = rng.normal(size=1000)
    scales = Scale.of(volume, None, 5), Scale.of(volume + 3.0, None, 5)
    assert np.array_equal(scales[0].grades(volume, None), scales[1].grades(volume + 3.0, None))


def test_grades_that_vary_equally_over_the_sky_are_neutral(found):
    """Two fields, one measured well and one badly by both sources: within each, errors are uninformative."""
    answer, _ = found[0]
    pairs, n1, n2 = answer.pairs, len(answer.first), len(answer.second)
    rng = np.random.default_rng(7)
    west = [features[:, 0] > np.median(features[:, 0]) for features in (answer.first.features, answer.second.features)]
    cells = west[0].astype(np.int32), west[1].astype(np.int32)
    sizes = [side + rng.uniform(size=len(side)) for side in west]
    scales = Scale.of(sizes[0], None, 4), Scale.of(sizes[1], None, 4)
    graded = Grades(scales, (scales[0].grades(sizes[0], None), scales[1].grades(sizes[1], None)), cells)
    partner = np.full(n1, 0.5), np.full(n2, 0.5)
    every = np.ones(n1, bool), np.ones(n2, bool)
    assert graded.fitted(pairs, answer.p_pair, partner, every).rule is None
    nowhere = np.zeros(n1, np.int32), np.zeros(n2, np.int32)
    one_cell = Grades(scales, graded.grades, nowhere)
    assert one_cell.fitted(pairs, answer.p_pair, partner, every).rule is not None


def test_what_is_learned_is_the_ratio_of_the_counts(found):
    answer, _ = found[0]
    pairs, n1, n2 = answer.pairs, len(answer.first), len(answer.second)
    rng = np.random.default_rng(6)
    size = rng.normal(size=n1), rng.normal(size=n2)
    size[1][pairs.j[answer.chosen]] = size[0][pairs.i[answer.chosen]]
    scales = Scale.of(size[0], None, 3), Scale.of(size[1], None, 3)
    nowhere = np.zeros(n1, np.int32), np.zeros(n2, np.int32)
    grades = scales[0].grades(size[0], None), scales[1].grades(size[1], None)
    partner = (
        np.minimum(np.bincount(pairs.i, answer.p_pair, n1), 1.0),
        np.minimum(np.bincount(pairs.j, answer.p_pair, n2), 1.0),
    )
    rule = (
        Grades(scales, grades, nowhere)
        .fitted(pairs, answer.p_pair, partner, (np.ones(n1, bool), np.ones(n2, bool)))
        .rule
    )
    common, squares, alone = np.zeros((3, 3)), np.zeros((3, 3)), [np.zeros(3), np.zeros(3)]
    for i, j, p in zip(pairs.i, pairs.j, answer.p_pair, strict=True):
        common[grades[0][i], grades[1][j]] += p
        squares[grades[0][i], grades[1][j]] += p * p
    for source in range(2):
        for grade, p in zip(grades[source], partner[source], strict=True):
            alone[source][grade] += 1.0 - p
    chance = np.outer(alone[0] / alone[0].sum(), alone[1] / alone[1].sum())
    assert np.exp(rule.log_ratio) == pytest.approx(common / common.sum() / chance, rel=0.05, abs=9 * PSEUDO_COUNT)
    apart = common.sum(axis=1)[:, None] * common.sum(axis=0) * chance
    apart /= chance.sum(axis=1)[:, None] * chance.sum(axis=0)
    pseudo = 9 * PSEUDO_COUNT * apart / apart.sum()
    at = grades[0][pairs.i], grades[1][pairs.j]
    remaining = np.maximum(1.0 - answer.p_pair / (squares + pseudo)[at], (pseudo / (common + pseudo))[at])
    assert rule(pairs).terms["precision"] == pytest.approx(rule.log_ratio[at] + np.log(remaining), rel=0.05, abs=0.05)


def test_uninformative_magnitudes_do_not_disable_grades(frames):
    scene, rng = frames[0].scene, np.random.default_rng(3)
    one, two = (Magnitudes(rng.normal(15.0, 1.0, len(records))) for records in (scene.first, scene.second))
    assert "precision" in match(scene.first, scene.second, brightness=(one, two))[0].evidence.terms


def faint_objects(rng, n):
    """(n,) errors in arcsec of objects in both sources: each grows with its magnitude, which differs by a colour."""
    first = 18.9 - rng.exponential(1.8, n)
    second = first + rng.normal(0.0, 0.1, n)
    return 3.5e-3 * 10.0 ** (0.3 * (first - 18.9)), np.clip(0.25 * 10.0 ** (0.4 * (second - 18.5)), 0.077, 0.25)


@pytest.mark.slow
@pytest.mark.long
def test_chance_pairs_of_rare_grades_do_not_support_each_other():
    """Of sources whose errors are strongly correlated too many pairs were wrong, by 3.8 standard deviations."""
    mistaken, expected, variance = 0, 0.0, 0.0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        n, alone = 10_000, (3_000, 5_000)
        sizes = faint_objects(rng, n)
        side = np.sqrt(n * np.pi / 0.15) * 3.0 * 0.09
        at, sides = rng.uniform(0.0, side, (n, 2)), []
        for source, more in enumerate(alone):
            kept = np.flatnonzero(rng.random(n) < 0.85)
            extra = np.clip(faint_objects(rng, 4 * more)[source], None, 0.25)
            extra = np.sort(extra)[-more:]
            error = rng.normal(size=(len(kept), 2)) * sizes[source][kept, None]
            place = np.concatenate([at[kept] + error, rng.uniform(0.0, side, (more, 2))])
            sides.append((place, np.concatenate([sizes[source][kept], extra]), np.append(kept, np.full(more, -1))))
        first, second = (Records.of(place, sigma=size) for place, size, _ in sides)
        found, _ = match(first, second, errors=Errors())
        pairs = found.matches
        i, j = pairs.rows_1, pairs.rows_2
        mistaken += int(np.count_nonzero((sides[0][2][i] != sides[1][2][j]) | (sides[0][2][i] < 0)))
        p = pairs.p_match
        expected, variance = expected + float((1.0 - p).sum()), variance + float((p * (1.0 - p)).sum())
    assert mistaken - expected < 3.0 * np.sqrt(variance)


@pytest.mark.slow
def test_records_with_a_magnitude_are_not_counted_as_such_twice():
    """Two thirds of the catalogue are too faint for a magnitude, and hardly any partner: the completeness by magnitude
    knows that of the others, and the grades knew it once more."""
    wrong, expected, variance = 0, 0.0, 0.0
    for seed in range(2):
        rng = np.random.default_rng([23, seed])
        made = counterparts(rng, sources=1_000, records=30_000, chance=3.0)
        true = made.scene.true_pairs()
        one = rng.normal(21.5, 1.7, len(made.scene.first))
        one[true[0]] = made.magnitude[true[1]] + rng.normal(0.0, 0.7, len(true[0]))
        two = np.where(made.magnitude < 24.3, made.magnitude, np.nan)
        answer, _ = match(made.scene.first, made.scene.second, brightness=(Magnitudes(one), Magnitudes(two)))
        p = answer.matches.p_match
        wrong += int((~is_true_pair((answer.matches.rows_1, answer.matches.rows_2), true)).sum())
        expected, variance = expected + float((1.0 - p).sum()), variance + float((p * (1.0 - p)).sum())
    assert abs(wrong - expected) < 2.0 * np.sqrt(variance)
