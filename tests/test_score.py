"""Scores against explicit counts of sets, and against truths drawn from the stated probabilities."""

import doctest
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sameas.errors import InputError
from sameas.score import pairs
from sameas.score.pairs import is_true_pair, reliability, score_pairs, score_probabilities, score_records
from sameas.simulate import scenes


def some_pairs(rng, n1, n2):
    k = int(rng.integers(0, min(n1, n2) + 1))
    return rng.permutation(n1)[:k], rng.permutation(n2)[:k]


def as_set(pairs):
    return set(zip(*(np.asarray(side).tolist() for side in pairs), strict=True))


@settings(max_examples=100, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), n1=st.integers(0, 6), n2=st.integers(0, 6))
def test_counts_of_decisions_agree_with_set_operations(seed, n1, n2):
    rng = np.random.default_rng(seed)
    claimed, true = some_pairs(rng, n1, n2), some_pairs(rng, n1, n2)
    pairs, records = score_pairs(claimed, true), score_records(claimed, true, n1, n2)
    one, two = as_set(claimed), as_set(true)
    assert (pairs.n_claimed, pairs.n_true, pairs.n_right) == (len(one), len(two), len(one & two))
    partner, true_partner = dict(one), dict(two)
    assert records.n_right_1 == sum(partner.get(i) == true_partner.get(i) for i in range(n1))
    partner, true_partner = ({j: i for i, j in s} for s in (one, two))
    assert records.n_right_2 == sum(partner.get(j) == true_partner.get(j) for j in range(n2))
    assert (records.n_right_1 + records.n_right_2 == n1 + n2) == (one == two)
    if one and two and one & two:
        assert pairs.f1 == pytest.approx(2 / (1 / pairs.precision + 1 / pairs.recall))


def test_the_true_matches_have_perfect_scores():
    true = [3, 1], [0, 2]
    assert score_pairs(true, true).precision == score_pairs(true, true).recall == score_pairs(true, true).f1 == 1
    assert score_records(true, true, 5, 4).share_right == 1
    assert score_records(true, true, 5, 4).share_right == 1.0


def test_ratios_of_zero_counts_are_nan():
    nothing = [], []
    pairs = score_pairs(nothing, nothing)
    assert all(math.isnan(x) for x in (pairs.precision, pairs.recall, pairs.f1))
    assert math.isnan(score_records(nothing, nothing, 0, 0).share_right)
    assert score_records(nothing, nothing, 3, 2).share_right == 1
    assert math.isnan(score_probabilities([], []).brier)
    assert math.isnan(reliability([], []).expected_calibration_error)


def test_candidates_that_share_records_are_marked_true_or_false():
    is_true = is_true_pair(([0, 0, 1, 7], [0, 1, 1, 3]), ([0, 2], [1, 3]))
    assert is_true.tolist() == [False, True, False, False]


@pytest.mark.parametrize("width", ["equal", "adaptive"])
def test_reliability_accepts_calibrated_and_detects_miscalibrated_probabilities(width):
    rng = np.random.default_rng(1)
    p = rng.beta(0.3, 0.3, 20_000)
    happened = rng.uniform(size=len(p)) < p
    table = reliability(p, happened, bins=12, width=width)
    assert table.count.sum() == len(p)
    assert (np.abs(table.deviation) < 4).all()
    assert table.expected_calibration_error < 0.01
    boastful = p**3 / (p**3 + (1 - p) ** 3)
    table = reliability(boastful, happened, bins=12, width=width)
    assert np.abs(table.deviation).max() > 10
    assert table.expected_calibration_error > 0.05
    assert score_probabilities(boastful, happened).brier > score_probabilities(p, happened).brier
    assert score_probabilities(boastful, happened).log_score < score_probabilities(p, happened).log_score


def test_the_standard_error_is_the_scatter_of_the_observed_frequency():
    rng = np.random.default_rng(2)
    p = rng.uniform(size=200)
    tables = [reliability(p, rng.uniform(size=200) < p, bins=4) for _ in range(800)]
    scatter = np.std([t.observed for t in tables], axis=0)
    np.testing.assert_allclose(scatter, tables[0].standard_error, rtol=0.12)


def test_adaptive_bins_ascend_and_hold_equal_counts():
    p = np.random.default_rng(3).uniform(size=103) ** 4
    table = reliability(p, p > 0.5, bins=10, width="adaptive")
    assert table.count.max() - table.count.min() <= 1
    assert (np.diff(table.stated) > 0).all()


def test_empty_bins_are_omitted_and_probability_one_is_in_the_last():
    table = reliability([0.0, 1.0, 1.0 + 1e-12], [False, True, True])
    assert table.count.tolist() == [1, 2]
    assert table.deviation.tolist() == [0, 0]
    assert reliability([1.0, 1.0], [True, False]).deviation.tolist() == [-math.inf]


@settings(max_examples=50, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 50))
def test_proper_scores_do_not_change_when_events_are_negated(seed, n):
    rng = np.random.default_rng(seed)
    p, happened = rng.uniform(size=n), rng.uniform(size=n) < 0.5
    one, two = score_probabilities(p, happened), score_probabilities(1 - p, ~happened)
    assert one.brier == pytest.approx(two.brier)
    assert one.log_score == pytest.approx(two.log_score)
    assert one.brier == pytest.approx(np.mean([(a - b) ** 2 for a, b in zip(p, happened, strict=True)]))


def test_an_event_of_probability_zero_that_occurs_scores_minus_infinity():
    assert score_probabilities([0.0, 0.5], [True, True]).log_score == -math.inf
    assert score_probabilities([0.0, 1.0], [False, True]).log_score == 0


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda: score_pairs(([0, 0], [1, 2]), ([], [])), "claimed pairs: row 0 of source 1 has several partners"),
        (lambda: score_pairs(([0], [1, 2]), ([], [])), "two lists of equal length"),
        (lambda: score_pairs(([-1], [1]), ([], [])), "give integers from 0"),
        (lambda: score_pairs(([0.5], [1]), ([], [])), "give integers from 0"),
        (lambda: score_records(([5], [1]), ([], []), 3, 3), "row 5 of source 1, which has 3 records"),
        (lambda: reliability([1.2], [True]), r"1 probabilities lie outside 0 … 1 \(first: row 0: 1.2\)"),
        (lambda: reliability([math.nan], [True]), "lie outside"),
        (lambda: reliability([0.5], [True, False]), "give one per event"),
        (lambda: reliability([0.5], [True], bins=0), "at least one"),
        (lambda: reliability([0.5], [True], width="narrow"), 'give "equal" or "adaptive"'),
    ],
)
def test_invalid_scores_are_refused_with_a_clear_message(ask, words):
    with pytest.raises(InputError, match=words):
        ask()


@pytest.mark.parametrize("module", [pairs, scenes])
def test_examples_in_the_docstrings_run(module):
    result = doctest.testmod(module)
    assert result.attempted and not result.failed
