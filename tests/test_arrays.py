"""Operations on long arrays give what NumPy's give."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sameas.arrays import inner, median

NUMBERS = st.lists(st.floats(-1e9, 1e9) | st.sampled_from([0.0, 1.0, math.inf]), min_size=1, max_size=50)


@given(NUMBERS)
def test_the_median_is_that_of_numpy(values):
    assert median(np.array(values)) == np.median(values)


def test_the_median_of_nothing_is_not_a_number():
    assert math.isnan(median(np.empty(0)))


def test_the_inner_product_of_long_arrays_is_the_sum_of_products():
    one, other = np.random.default_rng(1).normal(size=(2, 20_000))
    assert math.isclose(inner(one, other), math.fsum(one * other), rel_tol=1e-9)
