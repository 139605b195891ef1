"""The result has an answer for every table row: partner, no partner, or unusable."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from problems import plane_records
from sameas import Box, ChiSquare, CommonObjects, Field, InputError, PerPair, Records, Sphere, identify
from sameas.posterior import METHODS


def answered(seed=0, n=(12, 9), **keywords):
    rng = np.random.default_rng(seed)
    first, second = (plane_records(rng, k, 2, scale=0.06, source=name) for k, name in zip(n, "ab", strict=True))
    return identify(first, second, **({"rule": Field(0.5)} | keywords))


def with_unusable_rows():
    """Table rows 1 and 3 of the first source and row 0 of the second cannot be used."""
    first = Records.of(
        [[0.0, 0.0], [np.nan, 0.0], [5.0, 5.0], [0.1, 0.1], [20.0, 20.0]], sigma=[1.0, 1.0, 1.0, np.nan, 1.0],
        ids=list("abcde"), source="radar",
    )  # fmt: skip
    second = Records.of([[np.inf, 0.0], [5.1, 5.0], [0.1, 0.0], [40.0, 0.0]], sigma=1.0, ids=[9, 8, 7, 6], source="ais")
    return identify(first, second, rule=Field(1e-3), gate=Box(3.0))


def test_rows_are_numbered_as_in_the_tables():
    answer = with_unusable_rows()
    np.testing.assert_array_equal(answer.matches.rows_1, [0, 2])
    np.testing.assert_array_equal(answer.matches.rows_2, [2, 1])
    assert answer.answers_1.partner.tolist() == [2, None, 1, None, None]
    assert answer.answers_2.partner.tolist() == [None, 2, 0, None]


def test_rows_set_aside_are_unusable_and_not_unmatched():
    answer = with_unusable_rows()
    np.testing.assert_array_equal(answer.answers_1.usable, [True, False, True, False, True])
    np.testing.assert_array_equal(answer.answers_2.usable, [False, True, True, True])
    np.testing.assert_array_equal(answer.leftovers_1, [4])
    np.testing.assert_array_equal(answer.leftovers_2, [3])
    for name in ("partner", "pair", "p_match", "p_none", "second", "p_second", "candidates", "group", "group_size"):
        for answers in (answer.answers_1, answer.answers_2):
            assert np.ma.getmaskarray(getattr(answers, name))[~answers.usable].all(), name
    # A usable record without candidates has no partner with probability 1, which is an answer.
    assert answer.answers_1.p_none[4] == 1.0 and answer.answers_1.candidates[4] == 0
    assert answer.answers_1.group.mask[4] and answer.answers_1.second.mask[4]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), counted=st.booleans())
def test_answers_of_both_sources_agree_with_the_candidates(seed, counted):
    answer = answered(
        seed, n=np.random.default_rng(seed).integers(0, 15, 2), prior=CommonObjects(0.2, 0.1) if counted else PerPair()
    )
    p, chosen = answer.p_pair, answer.chosen
    for answers, own, other in (
        (answer.answers_1, answer.rows_1, answer.rows_2),
        (answer.answers_2, answer.rows_2, answer.rows_1),
    ):
        for row in range(len(answers.usable)):
            mine = np.flatnonzero(own == row)
            picked = mine[chosen[mine]]
            rest = mine[~chosen[mine]]
            assert len(picked) <= 1 and answers.candidates[row] == len(mine)
            assert answers.p_none[row] == pytest.approx(1 - p[mine].sum(), abs=1e-12)
            assert bool(np.ma.getmaskarray(answers.partner)[row]) == (len(picked) == 0)
            if len(picked):
                assert answers.partner[row] == other[picked[0]] and answers.pair[row] == picked[0]
                assert answers.p_match[row] == p[picked[0]]
            if len(rest):
                assert answers.p_second[row] == p[rest].max()
                assert other[rest[p[rest] == p[rest].max()]].tolist().count(answers.second[row]) == 1
            if len(mine):
                group = answers.group[row]
                assert set(answer.groups.of_pairs()[mine].tolist()) == {group}
                assert answers.group_size[row] == answer.groups.sizes_1[group] + answer.groups.sizes_2[group]
    assert sorted(answer.leftovers_1.tolist() + answer.matches.rows_1.tolist()) == list(range(len(answer.first)))
    assert sorted(answer.leftovers_2.tolist() + answer.matches.rows_2.tolist()) == list(range(len(answer.second)))


def test_matches_are_one_to_one_sorted_and_carry_their_numbers():
    answer = answered(3, n=(60, 50))
    found = answer.matches
    assert len(found) > 10 and np.all(np.diff(found.rows_1) > 0)
    assert len(set(found.rows_2.tolist())) == len(found)
    np.testing.assert_array_equal(found.p_match, answer.p_pair[found.pair])
    np.testing.assert_array_equal(found.residual, answer.pairs.residual[found.pair])
    np.testing.assert_allclose(found.mahalanobis**2, answer.pairs.mahalanobis_sq[found.pair])
    np.testing.assert_allclose(found.log_odds, answer.evidence.log_ratio[found.pair], rtol=1e-12)
    difference = answer.first.features[found.rows_1] - answer.second.features[found.rows_2]
    np.testing.assert_allclose(found.residual, difference, atol=1e-12)


def test_log_odds_include_the_prior_only_if_it_is_linear():
    linear = answered(prior=PerPair(1.25))
    np.testing.assert_allclose(linear.log_odds, linear.evidence.log_ratio + 1.25, rtol=0, atol=1e-12)
    counted = answered(prior=CommonObjects(0.1, 0.1))
    np.testing.assert_allclose(counted.log_odds, counted.evidence.log_ratio, rtol=0, atol=1e-12)


def test_expected_errors_are_sums_of_probabilities():
    answer = answered(5, n=(80, 70))
    inside = answer.p_pair[answer.chosen]
    assert answer.expected_wrong == pytest.approx(len(inside) - inside.sum())
    assert answer.expected_wrong > 0
    assert answer.expected_wrong == pytest.approx(np.sum(1 - answer.matches.p_match))
    assert answer.expected_missed == pytest.approx(answer.p_pair.sum() - inside.sum())


def test_residual_statistics_detect_errors_that_are_too_small():
    rng = np.random.default_rng(0)
    place = rng.uniform(0, 1000, (2000, 2))
    first = Records.of(place, sigma=0.1)
    for scale in (1.0, 2.0):
        noise = rng.normal(0, 0.1 * math.sqrt(2 * scale**2 - 1), place.shape)
        second = Records.of(place + noise, sigma=0.1)
        seen = identify(first, second, rule=Field(1e-6), gate=Box(20.0)).residual_statistics()
        spread = math.sqrt(2 * scale**2 - 1) / math.sqrt(2)
        assert seen["median_due"] == pytest.approx(math.sqrt(2 * math.log(2)))
        assert seen["median"] / seen["median_due"] == pytest.approx(spread, rel=0.05)
        np.testing.assert_allclose(seen["rms"], 0.1 * spread * math.sqrt(2), rtol=0.06)
        np.testing.assert_allclose(seen["mean"], 0.0, atol=0.02)


def test_no_matches_have_no_statistics():
    seen = identify(Records.of([0.0], sigma=1.0), Records.of([99.0], sigma=1.0), rule=Field(1.0)).residual_statistics()
    assert np.isnan(seen["median"]) and np.isnan(seen["mean"]).all() and seen["rms"].shape == (1,)


@pytest.mark.parametrize("n", [(0, 0), (0, 4), (4, 0)])
@pytest.mark.parametrize("prior", [PerPair(), CommonObjects(0.1, 0.1)])
def test_empty_sources_give_an_empty_result(n, prior):
    answer = answered(n=n, prior=prior)
    assert len(answer.matches) == 0 and answer.expected_wrong == 0 == answer.expected_missed
    assert len(answer.leftovers_1) == n[0] and len(answer.leftovers_2) == n[1]
    np.testing.assert_array_equal(answer.answers_1.p_none, np.ones(n[0]))
    assert answer.approximate_pairs == 0


def test_the_method_of_every_group_is_named():
    answer = answered(2, n=(40, 40), gate=Box(0.7))
    names = {answer.method(g) for g in range(len(answer.groups))}
    assert names <= set(METHODS) and len(names) == 2
    assert sum(answer.posterior.counts().values()) == len(answer.groups)


def test_results_on_the_sky_are_in_arcsec():
    first = Records.of([[10.0, 60.0]], sigma=0.5, space=Sphere())
    second = Records.of([[10.0, 60.0 - 1.0 / 3600]], sigma=0.5, space=Sphere())
    found = identify(first, second, rule=Field(1e-6), gate=ChiSquare()).matches
    np.testing.assert_allclose(found.residual, [[0.0, 1.0]], atol=1e-7)
    assert found.mahalanobis[0] == pytest.approx(math.sqrt(2.0), rel=1e-6)


def test_an_invalid_source_number_is_refused():
    with pytest.raises(InputError, match="source is 3; give 1 or 2"):
        answered().explain(100, source=3)
