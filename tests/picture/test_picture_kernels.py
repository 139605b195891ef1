"""Kernels of an instant agree with NumPy formulas, interpreted and compiled."""

from itertools import combinations

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from problems import random_covariances
from sameas.arrays import places_in, spans_in
from sameas.gate.zones import percentiles
from sameas.gaussian import inverse
from sameas.kernels.components import grown_sets, label_components
from sameas.kernels.kalman import (
    innovation_model,
    report_factors,
    states_moved,
    sum_of_records,
    tracks_moved,
    update_in_plane,
    weights_of_least_determinant,
)
from sameas.kernels.nearest import nearest_at_once
from sameas.kernels.tracks import DURATION_SUMS, add_durations, find_places, find_rows, list_rows, neighbours, outdated
from sameas.kernels.zones import merge_rows
from sameas.many.fusion import BISECTIONS, OPTIMAL, STEPS
from sameas.picture.error_correlation import growth
from sameas.ragged import ranges
from sameas.tracks.alignment import moved, process_noise, transition

WAYS = ("interpreted", "compiled")


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def test_states_are_predicted_by_their_transition(rng):
    state, covariance, dt, walk = (
        rng.standard_normal((9, 4)),
        random_covariances(rng, 9, 4),
        rng.normal(0.0, 5.0, 9),
        rng.random(9),
    )
    there, spread = moved(state, covariance, dt, walk)
    f = transition(dt)
    np.testing.assert_allclose(there, np.einsum("nvw,nw->nv", f, state), rtol=1e-12)
    np.testing.assert_allclose(spread, f @ covariance @ f.transpose(0, 2, 1) + process_noise(dt, walk), rtol=1e-10)
    assert np.array_equal(spread, spread.transpose(0, 2, 1))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("late_s", [0.0, 0.7])
def test_prediction_by_kernel_and_by_arrays_agree_bit_for_bit(rng, way, late_s, monkeypatch):
    state, covariance, dt, walk = (
        rng.standard_normal((9, 4)),
        random_covariances(rng, 9, 4),
        rng.normal(0.0, 5.0, 9),
        rng.random(9),
    )
    covariance[:, 0, 3] += 0.1  # slightly asymmetric covariances are symmetrised
    covariance[4] = np.nan
    monkeypatch.setattr("sameas.tracks.alignment.runs_compiled", lambda kernel: False)
    expected = moved(state, covariance, dt, walk, late_s)
    there, spread = np.empty((9, 4)), np.empty((9, 4, 4))
    getattr(states_moved, way)(state, covariance, dt, walk, late_s, there, spread)
    assert np.array_equal(there, expected[0]) and np.array_equal(spread, expected[1], equal_nan=True)


@pytest.mark.parametrize("way", WAYS)
def test_last_reports_are_predicted_as_by_the_formulas(rng, way):
    n, was = 8, np.array([3, 0, 7, 7])
    state, covariance, walk, late = (
        rng.standard_normal((n, 4)),
        random_covariances(rng, n, 4),
        rng.random(n),
        rng.random(n),
    )
    before, dt, left = 0.5 * random_covariances(rng, n, 4), rng.random(4), 0.1 * random_covariances(rng, 4, 2)
    place, old, drift = np.empty((4, 2)), np.empty((4, 2, 2)), np.empty((4, 2, 2))
    getattr(tracks_moved, way)(was, state, covariance, walk, late, dt, left, before, place, old, drift)
    there, spread = moved(state[was], covariance[was], dt, walk[was])
    blurred = there[:, 2:, None] * there[:, None, 2:] + spread[:, 2:, 2:]
    spread = spread[:, :2, :2] + late[was, None, None] ** 2 * blurred + left
    np.testing.assert_allclose(place, there[:, :2], rtol=1e-12)
    np.testing.assert_allclose(old, spread, rtol=1e-12)
    np.testing.assert_allclose(drift, growth(spread - before[was, :2, :2]), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("way", WAYS)
def test_correlations_of_two_reports_agree_with_the_formulas(rng, way):
    was, now, m = np.array([2, 0, 1]), np.array([1, 1, 0]), 3
    one, other = 0.2 * random_covariances(rng, 4, 4), 0.2 * random_covariances(rng, 4, 4)
    old, new = one[was, :2, :2] + random_covariances(rng, m, 2), other[now, :2, :2] + random_covariances(rng, m, 2)
    root_before, root, motion = np.empty((3, m, 2, 2))
    getattr(report_factors, way)(was, now, one, other, old, new, root_before, root, motion)
    np.testing.assert_allclose(root_before, np.linalg.cholesky(one[was, :2, :2]), rtol=1e-10)
    np.testing.assert_allclose(root, np.linalg.cholesky(other[now, :2, :2]), rtol=1e-10)
    np.testing.assert_allclose(motion, growth(old + new - one[was, :2, :2] - other[now, :2, :2]), rtol=1e-9, atol=1e-12)
    share, forgotten = rng.random(m), 0.3 * rng.random(m)
    slope, noise = np.empty((m, 2, 4)), np.empty((m, 2, 2))
    getattr(innovation_model, way)(root_before, root, old, new, share, forgotten, slope, noise)
    common, s = forgotten[:, None, None] * (root_before @ root.transpose(0, 2, 1)), share[:, None, None]
    gain = common.transpose(0, 2, 1) @ inverse(old - s * one[was, :2, :2])
    lasting = np.sqrt(s) * (root - gain @ root_before)
    np.testing.assert_allclose(slope, np.concatenate([gain - np.eye(2), lasting], axis=2), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(noise, new - s * other[now, :2, :2] - gain @ common, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("way", WAYS)
def test_a_covariance_of_rank_1_has_a_root_whatever_its_rounding(way):
    """Plots nearer than their assumed height had such covariances, and no instant could be decided any more."""
    thin = np.zeros((1, 4, 4))
    thin[0, :2, :2] = [[4.0, 2.0], [2.0, 1.0 - 1e-15]]
    root_before, root, motion = np.empty((3, 1, 2, 2))
    first, old = np.zeros(1, np.int64), thin[:, :2, :2].copy()
    getattr(report_factors, way)(first, first, thin, thin, old, old, root_before, root, motion)
    np.testing.assert_allclose(root[0], [[2.0, 0.0], [1.0, 0.0]])


@pytest.mark.parametrize("way", WAYS)
def test_an_innovation_covariance_that_is_negative_by_rounding_is_no_fault(way):
    noise = np.array([[[1e7, 1e7], [1e7, 1e7 - 1e-6]]])
    out = np.empty((1, 4)), np.empty((1, 4, 4)), np.empty(1), np.empty(1)
    mean, slope = np.zeros((1, 4)), np.zeros((1, 2, 4))
    getattr(update_in_plane, way)(mean, np.eye(4)[None], slope, noise, np.array([[10.0, 10.0]]), *out)
    assert all(np.isfinite(each).all() for each in out) and 0.0 <= out[3][0] < 1.0


@pytest.mark.parametrize("way", WAYS)
def test_weights_of_covariance_intersection_are_optimal(rng, way):
    information = random_covariances(rng, 6, 3, 4)
    weights = np.empty((6, 3))
    getattr(weights_of_least_determinant, way)(information, STEPS, OPTIMAL, BISECTIONS, weights)
    total = np.einsum("nk,nkvw->nvw", weights, information)
    slope = np.einsum("nkvw,nwv->nk", information, np.linalg.inv(total)) / 4.0
    assert weights.min() >= 0.0 and weights.sum(axis=1) == pytest.approx(np.ones(6))
    # Optimality: no estimate gains from more weight, and none with weight from less.
    assert slope.max() < 1.0 + 2.0 * OPTIMAL and slope[weights > 1e-3] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("way", WAYS)
def test_states_of_objects_are_information_sums(rng, way):
    n = 7
    state, covariance = 1e4 + rng.standard_normal((n, 4)), random_covariances(rng, n, 4)
    members = np.array([[0, 1, -1], [2, -1, 3], [-1, 4, -1], [5, 6, -1]])
    placed, moving = np.arange(n) != 4, np.array([True, True, True, False, True, False, False])
    smoothed = np.array([True, True, False, False, False, False, False])
    speed = np.full(n, 8.0)
    mean, spread, has_place, has_velocity = np.empty((4, 4)), np.empty((4, 4, 4)), np.empty(4, bool), np.empty(4, bool)
    getattr(sum_of_records, way)(
        members, state, covariance, placed, moving, smoothed, speed, STEPS, OPTIMAL, BISECTIONS, mean, spread,
        has_place, has_velocity,
    )  # fmt: skip
    assert has_place.tolist() == [True, True, False, True] and has_velocity.tolist() == [True, True, False, False]
    of = np.zeros((n, 4, 4))
    of[moving] = np.linalg.inv(covariance[moving])
    of[~moving, :2, :2] = np.linalg.inv(covariance[~moving, :2, :2])
    weights = np.empty((1, 2))
    weights_of_least_determinant(of[None, :2], STEPS, OPTIMAL, BISECTIONS, weights)
    of[:2] *= weights[0][:, None, None]
    rest = np.diag([0.0, 0.0, 1.0, 1.0]) / 8.0**2
    for k, (records, beside) in enumerate([([0, 1], 0.0), ([2, 3], 0.0), (None, None), ([5, 6], rest)]):
        if records is not None:
            information = of[records].sum(axis=0) + beside
            np.testing.assert_allclose(spread[k], np.linalg.inv(information), rtol=1e-7, atol=1e-10)
            pull = np.einsum("kvw,kw->v", of[records], state[records])
            np.testing.assert_allclose(mean[k], np.linalg.solve(information, pull), rtol=1e-7)


@pytest.mark.parametrize("way", WAYS)
def test_components_are_numbered_by_first_appearance(rng, way):
    i, j, n = rng.integers(0, 30, 18), rng.integers(0, 30, 18), 30
    parent, label = np.empty((2, n), np.int64)
    getattr(label_components, way)(i, j, parent, label)
    _, theirs = connected_components(coo_array((np.ones(18), (i, j)), shape=(n, n)), directed=False)
    assert np.array_equal(label[:, None] == label, theirs[:, None] == theirs)
    assert np.array_equal(np.unique(label, return_index=True)[1], np.sort(np.unique(label, return_index=True)[1]))


@pytest.mark.parametrize("way", WAYS)
def test_two_ordered_lists_of_rows_are_merged(rng, way):
    number, time_s, serial = rng.integers(0, 4, 40), rng.integers(0, 5, 40).astype(float), rng.permutation(40)

    def ordered(rows):
        return rows[np.lexsort([serial[rows], time_s[rows], number[rows]])]

    rows, merged = rng.permutation(40)[:31], np.empty(31, np.int64)
    getattr(merge_rows, way)(ordered(rows[:20]), ordered(rows[20:]), number, time_s, serial, merged)
    assert np.array_equal(merged, ordered(rows))


@pytest.mark.parametrize("way", WAYS)
def test_reports_are_dropped_that_no_later_instant_needs(rng, way):
    number, time_s, late_s = rng.integers(0, 9, 40), rng.integers(0, 12, 40).astype(float), rng.normal(size=40)
    number[0], time_s[0] = 9, 1.0
    order = np.lexsort([time_s, number])
    (dropped, ended), gaps = np.empty((2, 40), bool), np.empty((40, 2))
    n = getattr(outdated, way)(order, number, time_s, late_s, 6.0, 2.0, dropped, ended, gaps)
    expected = []
    for k, row in enumerate(order):
        later = [other for other in order[k + 1 :] if number[other] == number[row]]
        replaced = bool(later) and time_s[later[0]] <= 6.0
        assert dropped[k] == (replaced or time_s[row] < 2.0)
        assert ended[k] == (not later and time_s[row] < 2.0)
        expected += [(time_s[later[0]] - time_s[row], late_s[later[0]])] if replaced else []
    assert gaps[:n].tolist() == [list(gap) for gap in expected]
    assert ended.any() and 0 < n < dropped.sum()


@pytest.mark.parametrize("way", WAYS)
def test_neighbours_of_new_reports_are_those_of_their_tracks_from_the_one_before_on(rng, way):
    number, time_s = rng.integers(0, 9, 40), rng.integers(0, 12, 40).astype(float)
    order = np.lexsort([time_s, number])
    new_number, new_time_s, own = (
        np.array([-1, 1, 1, 3, 6, 20]),
        np.array([2.0, 9.0, 4.0, -1.0, 99.0, 5.0]),
        order.copy(),
    )
    n = getattr(neighbours, way)(order, number, time_s, new_number, new_time_s, own)
    expected = []
    for track in np.unique(new_number):
        rows, first_s = order[number[order] == track], new_time_s[new_number == track].min()
        expected += [*rows[time_s[rows] < first_s][-1:], *rows[time_s[rows] >= first_s]]
    assert own[:n].tolist() == expected and 0 < n < 40


@pytest.mark.parametrize("way", WAYS)
def test_numbers_are_found_in_tables_as_by_arrays(rng, way):
    ascending, numbers = np.sort(rng.integers(3, 30, 20)), rng.integers(-1, 40, 25)
    first, size = np.empty((2, 25), np.int64)
    at, row = np.empty((2, getattr(find_rows, way)(ascending, numbers, first, size)), np.int64)
    getattr(list_rows, way)(first, size, at, row)
    assert np.array_equal([at, row], ranges(*spans_in(ascending, numbers))) and len(at) > 0
    for table, dense in ((np.unique(ascending), True), (1000 * np.unique(ascending), False), (numbers[:0], False)):
        wanted, place = numbers if dense else 1000 * numbers, np.empty(25, np.int64)
        getattr(find_places, way)(table, wanted, dense, place)
        assert np.array_equal(place, places_in(table, wanted))


@pytest.mark.parametrize("way", WAYS)
def test_durations_are_summed_by_source(rng, way):
    n = 30
    source, (later, ended, is_real) = rng.integers(0, 3, n), rng.random((3, n)) < 0.4
    duration_s, p, sums = rng.random(n), rng.random(n), np.zeros((3, len(DURATION_SUMS)))
    getattr(add_durations, way)(source, later, duration_s, ended, is_real, p, sums)
    weights = [(1.0 - p) * ended, p * ended, (1.0 - p) * duration_s, p * duration_s]
    weights += [q * ~is_real * began for q in (p, 1.0 - p) for began in (~later, later)]
    assert np.array_equal(sums, np.stack([np.bincount(source, weight, 3) for weight in weights], axis=1))


@pytest.mark.parametrize("way", WAYS)
def test_sets_grow_by_records_that_are_pairs_with_all_of_theirs(rng, way):
    i, j = np.nonzero(np.triu(rng.random((9, 9)) < 0.6, 1))
    pair = {(a, b): k for k, (a, b) in enumerate(zip(i.tolist(), j.tolist(), strict=True))}
    start = np.searchsorted(i, np.arange(10))
    sets = np.array([(a, b, c) for a, b, c in combinations(range(9), 3) if {(a, b), (a, c), (b, c)} <= set(pair)])
    width = np.where(sets[:, 0] == 1, 0, np.diff(start)[sets[:, 2]])
    parent, added, pairs = (
        np.empty(width.sum(), np.int64),
        np.empty(width.sum(), np.int64),
        np.empty((width.sum(), 3), int),
    )
    n = getattr(grown_sets, way)(sets, width, start, j, parent, added, pairs)
    expected = [
        (k, d, [pair[one, d] for one in records])
        for k, records in enumerate(sets.tolist())
        for d in range(9)
        if records[0] != 1 and all((one, d) in pair for one in records)
    ]
    assert list(zip(parent[:n].tolist(), added[:n].tolist(), pairs[:n].tolist(), strict=True)) == expected
    assert 0 < n < width.sum()


@pytest.mark.parametrize("n", [1, 2, 20, 501])
def test_percentiles_agree_with_numpy_to_the_last_digit(rng, n):
    values = rng.standard_normal((n, 2))
    assert np.array_equal(percentiles(values, (0.05, 0.95)), np.percentile(values, (5, 95), axis=0))


@pytest.mark.parametrize("way", WAYS)
def test_the_nearest_place_of_an_instant_is_that_of_all_distances(rng, way):
    sizes, at = np.array([3, 1, 6]), np.array([2, 0, 0, 1, 2])
    points, places = rng.standard_normal((4, 5, 2)), rng.standard_normal((10, 2))
    start = np.append(0, np.cumsum(sizes))
    distance, nearest = np.empty((4, 5)), np.empty((4, 5), np.int64)
    getattr(nearest_at_once, way)(points, at, places, start, distance, nearest)
    apart = np.hypot(*np.moveaxis(points[:, :, None] - places, -1, 0))
    apart = np.where(np.repeat(np.arange(3), sizes) == at[:, None], apart, np.inf)
    assert np.array_equal(nearest, apart.argmin(axis=2))
    np.testing.assert_allclose(distance, apart.min(axis=2), rtol=1e-12)
