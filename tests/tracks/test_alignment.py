"""Alignment in time: prediction, growth of uncertainty, order of arrival, and records too old to be informative."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sameas.errors import InputError
from sameas.kernels.tracks import search_jumps
from sameas.many.observations import Bearing, LinearPart
from sameas.tracks.alignment import Earlier, States, Succession, aged, moved, process_noise, transition

SECONDS = st.floats(-200.0, 200.0)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.0, 100.0), st.floats(0.0, 100.0))
def test_two_predictions_equal_one(first, second):
    rng = np.random.default_rng(1)
    root = rng.standard_normal((1, 4, 4))
    state, covariance = rng.standard_normal((1, 4)), root @ root.transpose(0, 2, 1)
    step = moved(*moved(state, covariance, first, 0.3), second, 0.3)
    whole = moved(state, covariance, first + second, 0.3)
    np.testing.assert_allclose(step[0], whole[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(step[1], whole[1], rtol=1e-9, atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(SECONDS)
def test_process_noise_is_a_covariance_and_grows_into_past_and_future(dt):
    noise = process_noise(dt, 0.5)[0]
    assert np.linalg.eigvalsh(noise)[0] >= -1e-9 * max(np.trace(noise), 1.0)
    covariance = np.diag([4.0, 4.0, 1.0, 1.0])[None]
    later = moved(np.zeros((1, 4)), covariance, dt, 0.5)[1]
    assert np.linalg.det(later[0, :2, :2]) >= 16.0 - 1e-9


def test_the_process_noise_agrees_with_simulated_walks():
    rng = np.random.default_rng(2)
    q, dt, n = 0.7, 0.02, 500
    shocks = np.sqrt(q * dt) * rng.standard_normal((4000, n))
    velocity = np.cumsum(shocks, axis=1)
    position = np.cumsum(velocity, axis=1)[:, -1] * dt
    sample = np.cov(position, velocity[:, -1])
    np.testing.assert_allclose(process_noise(n * dt, q)[0][np.ix_([0, 2], [0, 2])], sample, rtol=0.06)


def test_unknown_velocity_is_in_the_covariance():
    reports = States.of(
        [0.0, 1.0], [[0, 0], [1, 1]], np.eye(2), speed_m_per_s=8.0, velocity=[[3.0, 4.0], [np.nan, 0.0]],
        velocity_covariance=0.25 * np.eye(2),
    )  # fmt: skip
    np.testing.assert_allclose(reports.state[:, 2:], [[3.0, 4.0], [0.0, 0.0]])
    np.testing.assert_allclose(reports.covariance[:, 2, 2], [0.25, 64.0])
    bare = moved(reports.state[1:], reports.covariance[1:], 10.0, 0.0)[1]
    assert bare[0, 0, 0] == pytest.approx(1.0 + 80.0**2)


def test_uncertain_time_stamps_add_error_along_the_velocity_only():
    state, covariance = np.array([[0, 0, 10.0, 0.0]]), np.zeros((1, 4, 4))
    np.testing.assert_allclose(moved(state, covariance, 0.0, 0.0, 2.0)[1][0, :2, :2], [[400.0, 0.0], [0.0, 0.0]])


def test_the_latest_report_by_time_represents_a_track_for_any_order_of_arrival():
    time_s = np.array([10.0, 4.0, 30.0, 12.0, 11.0, 7.0])
    track = np.array(["a", "b", "a", "b", "a", "c"], dtype=object)
    rng = np.random.default_rng(3)
    for _ in range(5):
        order = rng.permutation(6)
        chosen = order[Succession.of(time_s[order], track[order]).at(12.0)]
        assert sorted(chosen) == [3, 4, 5]
    follows = Succession.of(time_s, track)
    assert len(follows.at(1.0)) == 0
    assert [list(follows.at(t)) for t in (4.0, 7.0, 10.0, 99.0)] == [[1], [1, 5], [0, 1, 5], [2, 3, 5]]
    assert len(Succession.of(np.empty(0), np.empty(0, object)).at(0.0)) == 0
    # At equal times the last one received.
    assert list(Succession.of(np.zeros(3), np.array(["a", "b", "a"])).at(0.0)) == [1, 2]


def test_records_expire_by_their_uncertainty_not_by_age():
    state = np.zeros((3, 4))
    ship, aircraft = np.diag([100.0, 100.0, 0.01, 0.01]), np.diag([100.0, 100.0, 4e4, 4e4])
    covariance = moved(state, np.stack([ship, aircraft, ship]), [60.0, 60.0, 3000.0], 0.01)[1]
    assert list(aged(covariance, 1e-6)) == [False, True, True]
    # In sparse traffic the same records are still informative.
    assert list(aged(covariance, 1e-12)) == [False, False, False]


def test_earlier_observations_measure_part_of_the_present_state():
    states = np.array([[100.0, 200.0, 5.0, -3.0], [-80.0, 40.0, 0.0, 2.0]])
    part = Earlier(Bearing((10.0, -5.0), dimension=4), 4.0)
    before = states @ transition(-4.0)[0].T
    np.testing.assert_allclose(part(states), Bearing((10.0, -5.0), dimension=4)(before))
    for v in range(4):
        step = np.zeros(4)
        step[v] = 1e-5
        slope = (part(states + step) - part(states - step)) / 2e-5
        np.testing.assert_allclose(part.jacobian(states)[:, :, v], slope, atol=1e-6)
    linear = Earlier(LinearPart(np.eye(2, 4)), 2.0)
    np.testing.assert_allclose(linear(states), states[:, :2] - 2.0 * states[:, 2:])


def test_reports_without_a_time_are_refused():
    with pytest.raises(InputError, match=r"ais: 1 report has no time \(first: row 1\)"):
        States.of([0.0, np.nan], np.zeros((2, 2)), np.eye(2), speed_m_per_s=8.0, source="ais")
    with pytest.raises(InputError, match="without their covariances"):
        States.of([0.0], np.zeros((1, 2)), np.eye(2), speed_m_per_s=8.0, velocity=[[0.0, 0.0]])
    with pytest.raises(InputError, match="give how fast objects may be"):
        States.of([0.0], np.zeros((1, 2)), np.eye(2), speed_m_per_s=0.0)


@pytest.mark.parametrize("way", ["interpreted", "compiled"])
def test_the_jump_of_a_clock_is_searched_as_by_the_sums_over_all_rows(way):
    rng = np.random.default_rng(4)
    m, rows, most, log_outlier = 40, 90, 8.0, -6.0
    before = np.sort(rng.choice(rows - 8, m, replace=False))
    after = before + rng.integers(1, 8, m)
    late, sigma, seconds = rng.normal(0.0, 8.0, m), rng.uniform(0.5, 6.0, m), np.array([-40.0, -6.0, 6.0, 12.0, 400.0])
    late[before > 50] += 12.0
    log_width = np.log(sigma * np.sqrt(2.0 * np.pi))
    log_no_jump = np.logaddexp(-0.5 * (late / sigma) ** 2 - log_width, log_outlier)
    total, row = np.empty(5), np.empty(5, np.int64)
    getattr(search_jumps, way)(
        seconds, late, sigma, log_width, log_no_jump, before + 1, after + 1, log_outlier, most, total, row
    )
    for s, jump_s in enumerate(seconds):
        log_ratio = np.logaddexp(-0.5 * ((late - jump_s) / sigma) ** 2 - log_width, log_outlier) - log_no_jump
        log_ratio = np.clip(log_ratio, -most, most)
        sums = np.array([log_ratio[(before < n) & (n <= after)].sum() for n in range(rows)])
        assert total[s] == pytest.approx(sums.max(), abs=1e-9) and sums[row[s]] == pytest.approx(sums.max(), abs=1e-9)
