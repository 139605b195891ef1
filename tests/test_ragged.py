"""Ragged ranges agree with nested loops."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import naive
from sameas.arrays import ordered_by, places_in, spans_in
from sameas.ragged import Ragged, ranges

quickly = settings(max_examples=100, deadline=None, derandomize=True)
rows = st.lists(st.tuples(st.integers(-9, 9), st.integers(0, 4)), max_size=9)


@quickly
@given(rows)
def test_rows_indices_and_values_are_those_of_nested_loops(rows):
    first, size = ([row[k] for row in rows] for k in (0, 1))
    expected = np.array(naive.ragged_ranges(first, size), np.int64).reshape(-1, 3).T
    ragged = Ragged.of_sizes(size)
    one, value = ranges(np.array(first, np.int64), np.array(size, np.int64))
    for column, due in zip((ragged.row, ragged.index, one, value), expected[[0, 1, 0, 2]], strict=True):
        np.testing.assert_array_equal(column, due)
        assert column.dtype == np.int64
    assert len(ragged) == len(size) and ragged.start[0] == 0 and ragged.start.dtype == np.int64
    np.testing.assert_array_equal(ragged.sizes, np.array(size, np.int64))


@quickly
@given(rows)
def test_sorted_rows_have_the_layout_of_their_sizes(rows):
    ragged = Ragged.of_sizes([size for _, size in rows])
    np.testing.assert_array_equal(Ragged.of_sorted(ragged.row, len(rows)).start, ragged.start)


numbers = st.lists(st.one_of(st.integers(0, 12), st.integers(0, 10**12)), max_size=12)


@quickly
@given(numbers, numbers)
def test_numbers_are_found_among_ascending_ones_with_gaps_and_without(here, wanted):
    here = np.sort(np.array(here, np.int64))
    wanted = np.array([*wanted, -1], np.int64)
    first, count = spans_in(here, wanted)
    np.testing.assert_array_equal(first, np.searchsorted(here, wanted))
    np.testing.assert_array_equal(count, [(here == number).sum() for number in wanted])
    once = np.unique(here)
    expected = [once.tolist().index(number) if number in once else -1 for number in wanted]
    np.testing.assert_array_equal(places_in(once, wanted), expected)


@quickly
@given(st.lists(st.tuples(st.sampled_from([-1.0, -0.0, 0.0, 2.5, np.nan]), st.floats(-2.0, 2.0)), max_size=9))
def test_rows_are_ordered_by_their_columns_as_by_lexsort(rows):
    equal = np.array(rows, np.float64).reshape(-1, 2).T
    for columns in (equal, equal[::-1]):
        np.testing.assert_array_equal(ordered_by(columns), np.lexsort(columns[::-1]))
