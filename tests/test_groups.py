"""Groups are the connected components; their layout is consistent in itself and with the gate."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive
from problems import laid_out, plane_records, shuffled
from sameas import Box
from sameas.groups import groups

graphs = st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(
    lambda n: st.tuples(st.just(n), st.sets(st.tuples(st.integers(0, n[0] - 1), st.integers(0, n[1] - 1)), max_size=25))
)


@pytest.mark.slow
@settings(max_examples=150, deadline=None, derandomize=True)
@given(graphs)
def test_groups_are_the_components_and_the_layout_is_consistent(graph):
    (n1, n2), edges = graph
    pairs, found = laid_out(n1, n2, edges)
    expected = [g for g in naive.components(n1, n2, edges) if g[0] and g[1]]
    rows = [
        (set(found.rows_1[a:b].tolist()), set(found.rows_2[c:d].tolist()))
        for a, b, c, d in zip(found.start_1[:-1], found.start_1[1:], found.start_2[:-1], found.start_2[1:], strict=True)
    ]
    rows, expected = ([(sorted(one), sorted(two)) for one, two in each] for each in (rows, expected))
    assert sorted(rows) == sorted(expected)
    assert len(found) == len(expected)

    m = len(edges)
    assert sorted(found.order.tolist()) == list(range(m))
    assert found.start[0] == 0 and found.start[-1] == m and found.edges_1[-1] == m
    assert len(set(found.rows_1.tolist())) == len(found.rows_1) and len(set(found.rows_2.tolist())) == len(found.rows_2)
    group = np.repeat(np.arange(len(found)), found.pair_counts)
    np.testing.assert_array_equal(found.rows_1[found.start_1[group] + found.local_1], pairs.i[found.order])
    np.testing.assert_array_equal(found.rows_2[found.start_2[group] + found.local_2], pairs.j[found.order])
    # The pairs of a record of source 1 are contiguous: edges_1 is their CSR.
    by_record = np.repeat(np.arange(len(found.rows_1)), np.diff(found.edges_1))
    np.testing.assert_array_equal(found.rows_1[by_record], pairs.i[found.order])
    np.testing.assert_array_equal(found.of_pairs()[found.order], group)
    assert found.sizes_1.sum() == len(found.rows_1) and found.sizes_2.sum() == len(found.rows_2)
    assert sum(v for k, v in found.statistics().items() if k != "records in the largest") == len(found)
    for parts in (1, 2, 5):
        bounds = found.bounds(parts)
        assert bounds[0] == 0 and bounds[-1] == len(found) and sorted(bounds) == bounds


@pytest.mark.parametrize("d", [1, 2])
def test_layout_does_not_depend_on_the_row_order(d):
    rng = np.random.default_rng(d)
    first, second = (plane_records(rng, 200, d, scale=2e-4 * 20.0 ** (d - 1)) for _ in range(2))

    def in_ids(one, two):
        found = groups(Box()(one, two))
        return one.ids[found.rows_1].tolist(), two.ids[found.rows_2].tolist(), found.start.tolist()

    expected = in_ids(first, second)
    assert len(expected[2]) > 20
    for _ in range(3):
        assert in_ids(shuffled(rng, first), shuffled(rng, second)) == expected


def test_statistics_state_the_group_sizes():
    edges = (
        {(0, 0)} | {(1, j) for j in (1, 2)} | {(2 + k, 3 + k) for k in range(40)} | {(2 + k, 4 + k) for k in range(39)}
    )
    _, found = laid_out(42, 43, edges)
    assert found.statistics() == {
        "of one pair": 1, "of 3 to 4 records": 1, "of 5 to 16": 0, "of 17 to 64": 0, "larger": 1,
        "records in the largest": 80,
    }  # fmt: skip


def test_without_candidates_there_are_no_groups():
    _, found = laid_out(3, 2, set())
    assert len(found) == 0 and found.bounds(2) == [0, 0, 0] and found.statistics()["records in the largest"] == 0
