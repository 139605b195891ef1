"""Operations on long arrays give what NumPy's give."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sameas.arrays import inner, median, robust_scale, taken, weighted_median, within_turn

NUMBERS = st.lists(st.floats(-1e9, 1e9) | st.sampled_from([0.0, 1.0, math.inf]), min_size=1, max_size=50)


@given(NUMBERS)
def test_the_median_is_that_of_numpy(values):
    assert median(np.array(values)) == np.median(values)


def test_the_median_of_nothing_is_not_a_number():
    assert math.isnan(median(np.empty(0)))


@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.integers(1, 5)), min_size=1, max_size=20))
def test_a_weighted_median_is_the_lower_median_of_values_repeated_by_weight(pairs):
    values, weights = (np.array(column, float) for column in zip(*pairs, strict=True))
    repeated = np.sort(np.repeat(values, weights.astype(int)))
    assert weighted_median(values, weights) == repeated[(len(repeated) - 1) // 2]


def test_the_weighted_median_of_many_values_is_that_of_all_of_them_sorted():
    rng = np.random.default_rng(2)
    values, weights = rng.normal(size=20_001), rng.integers(1, 4, 20_001)
    repeated = np.sort(np.repeat(values, weights))
    assert weighted_median(values, weights.astype(float)) == repeated[(len(repeated) - 1) // 2]


@pytest.mark.parametrize("weights", [None, np.ones(100_000)])
def test_the_robust_scale_of_normal_numbers_is_their_standard_deviation_whatever_a_few_outliers_are(weights):
    residual = np.random.default_rng(3).normal(0.0, 2.5, 100_000)
    residual[::1000] = 1e9
    assert math.isclose(robust_scale(residual, weights), 2.5, rel_tol=0.01)


def test_the_robust_scale_leaves_out_what_is_not_a_number():
    residual = np.array([[1.0, -2.0], [np.nan, 3.0]])
    assert robust_scale(residual) == robust_scale(np.array([1.0, 2.0, 3.0])) == 1.4826 * 2.0
    assert math.isnan(robust_scale(np.array([np.nan])))


def test_the_inner_product_of_long_arrays_is_the_sum_of_products():
    one, other = np.random.default_rng(1).normal(size=(2, 20_000))
    assert math.isclose(inner(one, other), math.fsum(one * other), rel_tol=1e-9)


@given(
    st.lists(st.one_of(st.floats(-360.0, 719.0), st.floats(), st.sampled_from([-0.0, 360.0, -360.0, -1e-20, 719.9]))),
    st.booleans(),
)
def test_angles_are_reduced_as_by_the_remainder(angles, within):
    degrees = np.array([a for a in angles if -360.0 <= a < 720.0] if within else angles, np.float64)
    with np.errstate(invalid="ignore"):
        expected = np.mod(degrees, 360.0)
        reduced = within_turn(degrees)
    assert reduced.tobytes() == expected.tobytes()


@given(st.integers(1, 50), st.sampled_from([np.int32, np.int64, np.uint8]), st.data())
def test_rows_are_taken_as_by_indexing(n, kind, data):
    values = np.arange(3 * n, dtype=np.float64).reshape(n, 3)
    rows = np.array(data.draw(st.lists(st.integers(0, n - 1))), kind)
    assert np.array_equal(taken(values, rows), values[rows])
    assert np.array_equal(taken(values[:, 0], rows), values[:, 0][rows])
