"""Priors agree with their formulas for every group; the slope of the linear prior is the paper's."""

import math

import numpy as np
import pytest

import naive
from sameas import CommonObjects, InputError, PerPair

N1, N2 = np.array([1, 3, 7, 2, 40, 5]), np.array([1, 5, 2, 2, 35, 5])
MISSES = [(0.1, 0.2), (0.5, 0.5), (0.01, 0.9), (1e-9, 1e-9)]


@pytest.mark.parametrize("q1, q2", MISSES)
def test_common_objects_agrees_with_its_formula_up_to_a_constant_per_group(q1, q2):
    prior = CommonObjects(q1, q2)(N1, N2)
    assert prior.slope is None and len(prior.table) == prior.start[-1]
    for g, (n1, n2) in enumerate(zip(N1.tolist(), N2.tolist(), strict=True)):
        table = prior.table[prior.start[g] : prior.start[g + 1]]
        expected = np.array([naive.common_objects_log_prior(k, n1, n2, q1, q2) for k in range(min(n1, n2) + 1)])
        np.testing.assert_allclose(table - table[0], expected - expected[0], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("q1, q2", MISSES)
def test_the_linear_form_has_the_least_squares_slope(q1, q2):
    prior = CommonObjects(q1, q2, linear=True)(N1, N2)
    expected = [naive.common_objects_slope(n1, n2, q1, q2) for n1, n2 in zip(N1.tolist(), N2.tolist(), strict=True)]
    np.testing.assert_allclose(prior.slope, expected, rtol=1e-9)
    fitted = []
    for n1, n2 in zip(N1.tolist(), N2.tolist(), strict=True):
        k = np.arange(min(n1, n2) + 1)
        fitted.append(np.polyfit(k, CommonObjects(q1, q2).log_probability(k, n1, n2), 1)[0])
    np.testing.assert_allclose(prior.slope, fitted, rtol=1e-8)


def test_swapping_the_sources_and_their_miss_probabilities_changes_nothing():
    one, two = CommonObjects(0.1, 0.3)(N1, N2), CommonObjects(0.3, 0.1)(N2, N1)
    np.testing.assert_allclose(one.table, two.table, rtol=1e-13)


def test_lower_miss_probabilities_favour_more_pairs():
    slopes = [CommonObjects(q, q, linear=True)(N1, N2).slope for q in (0.01, 0.1, 0.5, 0.9)]
    assert np.all(np.diff(slopes, axis=0) < 0)


def test_per_pair_is_the_same_for_every_group():
    prior = PerPair(-1.5)(N1, N2)
    np.testing.assert_array_equal(prior.slope, np.full(len(N1), -1.5))


@pytest.mark.parametrize("prior", [PerPair(1.0), CommonObjects(0.1, 0.1), CommonObjects(0.1, 0.1, linear=True)])
def test_priors_of_zero_groups_are_empty(prior):
    log_prior = prior(np.empty(0, np.int64), np.empty(0, np.int64))
    assert log_prior.slope is None or len(log_prior.slope) == 0
    assert len(log_prior.start) == 1


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: PerPair(math.inf), "log_odds is inf; give a finite natural logarithm"),
        (lambda: PerPair(math.nan), "log_odds is nan"),
        (lambda: CommonObjects(0.0, 0.1), "q1 is 0.0; give the probability that source 1 misses an object"),
        (lambda: CommonObjects(0.1, 1.0), "q2 is 1.0; give the probability that source 2 misses an object"),
        (lambda: CommonObjects(math.nan, 0.1), "q1 is nan"),
    ],
)
def test_invalid_priors_are_refused_with_a_clear_message(make, words):
    with pytest.raises(InputError, match=words):
        make()
