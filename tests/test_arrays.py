"""Operations on long arrays give what NumPy's give."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sameas.arrays import inner, median, taken, within_turn

NUMBERS = st.lists(st.floats(-1e9, 1e9) | st.sampled_from([0.0, 1.0, math.inf]), min_size=1, max_size=50)


@given(NUMBERS)
def test_the_median_is_that_of_numpy(values):
    assert median(np.array(values)) == np.median(values)


def test_the_median_of_nothing_is_not_a_number():
    assert math.isnan(median(np.empty(0)))


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
