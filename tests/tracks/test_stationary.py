"""Whether an object is stationary: by all its reports, calibrated, and the same live as from a file."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sameas.kernels.modes import filter_modes
from sameas.tracks.alignment import States, moved
from sameas.tracks.feed import Feed
from sameas.tracks.live_feed import LiveFeed
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, Motion, SensorErrors
from sameas.tracks.stationary import (
    ADRIFT,
    DRIFT_M_PER_S,
    DRIFT_SHARE,
    DRIFT_WALK_M2_PER_S3,
    FILTERED,
    MIN_VARIANCE,
    REST_S,
    slow_objects,
    stationary,
)

VESSELS = Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=0.2)
SIGMA_M, SIGMA_M_PER_S = 5.0, 0.5


def shares():
    """Shares of objects alongside, at anchor, adrift, under way on a steady course and otherwise; 1σ of their
    velocities, and the walks of these."""
    w, drift = VESSELS.stationary_share, DRIFT_SHARE
    share = np.array([w / 2.0] * 2 + [(1.0 - w) * drift] + [(1.0 - w) * (1.0 - drift) / 2.0] * 2)
    slow_walk = DRIFT_WALK_M2_PER_S3
    return share, np.array([0.01, 0.1, DRIFT_M_PER_S, 8.0, 8.0]), [0.0, 0.0, slow_walk, slow_walk, 0.01]


def simulated(rng, n, reports, every_s):
    """Reports of n objects whose mode of motion changes as the model says; and whether each report is of one that is
    slow."""
    (share, speed, walk), step_s = shares(), 2.0
    mode = rng.choice(FILTERED, n, p=share)
    p_change = -np.expm1(-step_s / (REST_S * (1.0 - VESSELS.stationary_share)))
    velocity = speed[mode, None] * rng.standard_normal((n, 2))
    place, rows, is_slow = np.zeros((n, 2)), [], []
    for k in range(reports):
        position = place + SIGMA_M * rng.standard_normal((n, 2))
        measured = velocity + SIGMA_M_PER_S * rng.standard_normal((n, 2))
        rows.append(np.column_stack([np.full(n, k * every_s), position, measured, np.arange(n)]))
        is_slow.append(mode < 3)
        for _ in range(round(every_s / step_s)):
            place = place + step_s * velocity
            velocity = velocity + np.sqrt(np.array(walk)[mode] * step_s)[:, None] * rng.standard_normal((n, 2))
            new = rng.choice(FILTERED, n, p=share)
            changes = (rng.random(n) < p_change) & (new != mode) & ((mode > 1) | (new > 1))
            mode = np.where(changes, new, mode)
            velocity = np.where(changes[:, None], speed[mode, None] * rng.standard_normal((n, 2)), velocity)
    time_s, x, y, vx, vy, track = np.concatenate(rows).T
    return states(time_s, np.column_stack([x, y]), np.column_stack([vx, vy]), track), np.concatenate(is_slow)


def states(time_s, place, velocity, track):
    return States.of(
        time_s, place, SIGMA_M**2 * np.eye(2), speed_m_per_s=8.0, velocity=velocity,
        velocity_covariance=SIGMA_M_PER_S**2 * np.eye(2), track=track,
    )  # fmt: skip


def judged(made, motion):
    """The states, and (n,) the probability that each report is of a slow object."""
    now, modes = stationary(made, motion)
    return now, modes.p_slow.sum(axis=1)


@pytest.mark.parametrize("way", ["interpreted", "compiled"])
def test_the_modes_after_two_reports_are_the_exact_mixture(way, monkeypatch):
    rng = np.random.default_rng(2)
    n, dt = 40, 30.0
    true = np.repeat([0.05, 0.3, 0.8, 3.0], n // 4)[:, None] * rng.standard_normal((n, 2))
    place = np.concatenate([np.zeros((n, 2)), dt * true]) + SIGMA_M * rng.standard_normal((2 * n, 2))
    measured = np.tile(true, (2, 1)) + SIGMA_M_PER_S * rng.standard_normal((2 * n, 2))
    made = states(np.repeat([0.0, dt], n), place, measured, np.tile(np.arange(n), 2))
    monkeypatch.setattr("sameas.tracks.stationary.filter_modes", getattr(filter_modes, way))
    _, modes = stationary(made, VESSELS)
    (share, speed, walk), error = (
        shares(),
        np.diag([SIGMA_M**2] * 2 + [SIGMA_M_PER_S**2] * 2) + MIN_VARIANCE * np.eye(4),
    )
    p_change = -np.expm1(-dt / (REST_S * (1.0 - VESSELS.stationary_share)))
    for k in range(n):
        first, second = made.state[k], made.state[n + k]
        weight = np.zeros((FILTERED, FILTERED))
        for i in range(FILTERED):
            s, total = speed[i] ** 2, error[2, 2] + speed[i] ** 2
            p_first = share[i] * multivariate_normal.pdf(first[2:], cov=total * np.eye(2))
            x, p = (
                np.append(first[:2], first[2:] * s / total),
                np.diag([error[0, 0]] * 2 + [error[2, 2] * s / total] * 2),
            )
            stays = 1.0
            for j in range(FILTERED):
                if j == i or (i < 2 and j < 2):
                    continue
                stays -= p_change * share[j]
                # At a time u, uniform in 0 … dt, the velocity changed.
                path = dt**2 / 3.0 * (p[2:, 2:] + np.outer(x[2:], x[2:]) / 4.0 + walk[i] * dt / 4.0 * np.eye(2))
                path = dt**2 / 3.0 * s * np.eye(2) if i < 2 else path
                cov = np.kron(speed[j] ** 2 * np.array([[dt**2 / 3.0, dt / 2.0], [dt / 2.0, 1.0]]), np.eye(2)) + error
                cov[:2, :2] += p[:2, :2] + path
                mean = np.append(x[:2] + (0.5 * dt * x[2:] if i > 1 else 0.0), [0.0, 0.0])
                weight[i, j] = p_first * p_change * share[j] * multivariate_normal.pdf(second, mean, cov)
            if i < 2:
                mean, cov = np.append(x[:2], [0.0, 0.0]), s * np.kron([[dt**2, dt], [dt, 1.0]], np.eye(2))
                cov[:2, :2] += p[:2, :2]
            else:
                (mean,), (cov,) = moved(x[None], p[None], dt, walk[i])
            weight[i, i] = p_first * stays * multivariate_normal.pdf(second, mean, cov + error)
        expected = weight.sum(axis=0) / weight.sum()
        np.testing.assert_allclose(np.exp(modes.log_p[n + k]), expected, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("speed", [0.2, 0.4])
def test_a_vessel_adrift_is_not_at_rest_though_each_report_would_allow_it(speed):
    rng, time_s = np.random.default_rng(1), 10.0 * np.arange(40)
    velocity = np.column_stack([np.full(40, speed), np.zeros(40)])
    place = time_s[:, None] * velocity + SIGMA_M * rng.standard_normal((40, 2))
    now, modes = stationary(states(time_s, place, velocity, ["a"] * 40), VESSELS)
    assert np.all(modes.p_slow[20:, ADRIFT] > 0.9)
    np.testing.assert_allclose(now.state[20:, 2:], velocity[20:], atol=0.15)
    assert np.all(np.sqrt(now.covariance[20:, 2, 2]) < 0.2)


@pytest.mark.parametrize("speed", [2.0, 3.0, 6.0])
def test_a_vessel_on_a_steady_course_is_not_adrift(speed):
    rng, time_s = np.random.default_rng(2), 10.0 * np.arange(90)
    velocity = np.column_stack([np.full(90, speed), np.zeros(90)])
    place = time_s[:, None] * velocity + SIGMA_M * rng.standard_normal((90, 2))
    measured = velocity + SIGMA_M_PER_S * rng.standard_normal((90, 2))
    _, modes = stationary(states(time_s, place, measured, ["a"] * 90), VESSELS)
    assert np.all(modes.p_slow.sum(axis=1) < 0.1)


def test_a_vessel_at_anchor_keeps_its_place_by_its_earlier_reports():
    rng = np.random.default_rng(3)
    n, age_s = 400, 150.0
    time_s, track = np.tile([0.0, 180.0, 360.0], n), np.repeat(np.arange(n), 3)
    velocity = 0.1 * rng.standard_normal((n, 2))[track]
    place = velocity * time_s[:, None] + SIGMA_M * rng.standard_normal((3 * n, 2))
    measured = velocity + SIGMA_M_PER_S * rng.standard_normal((3 * n, 2))
    now, p = judged(states(time_s, place, measured, track), VESSELS)
    last = np.flatnonzero(time_s == 360.0)
    walk = 0.01 * (1.0 - p[last])
    ahead, covariance = moved(now.state[last], now.covariance[last], age_s, walk)
    error = ahead[:, :2] - velocity[last] * (360.0 + age_s)
    square = np.einsum("nv,nvw,nw->n", error, np.linalg.inv(covariance[:, :2, :2]), error)
    # By each report alone the mean is 0.4; it is below 2 as a vessel adrift would be possible.
    assert 1.2 < square.mean() < 2.3


@pytest.mark.parametrize(("slow", "kind"), [(0.01, 0), (0.1, 1)])
def test_the_history_tells_vessels_alongside_from_those_at_anchor(slow, kind):
    rng = np.random.default_rng(6)
    n, reports, age_s = 400, 12, 150.0
    time_s, track = np.tile(180.0 * np.arange(reports), n), np.repeat(np.arange(n), reports)
    step = slow * rng.standard_normal((n, reports, 2))
    place = 180.0 * np.cumsum(step, axis=1).reshape(-1, 2) + SIGMA_M * rng.standard_normal((reports * n, 2))
    measured = SIGMA_M_PER_S * rng.standard_normal((reports * n, 2))
    now, modes = stationary(states(time_s, place, measured, track), VESSELS)
    last = np.flatnonzero(time_s == time_s.max())
    assert modes.p_slow[last, kind].mean() > 0.9
    _, covariance = moved(now.state[last], now.covariance[last], age_s, np.zeros(n))
    swings_m2 = covariance[:, 0, 0] - SIGMA_M**2
    assert np.median(swings_m2) == pytest.approx((slow * age_s) ** 2, rel=0.5, abs=6.0)


@pytest.mark.slow
@pytest.mark.parametrize("every_s", [10.0, 180.0])
def test_the_probability_by_all_reports_is_the_frequency(every_s):
    made, lies = simulated(np.random.default_rng(4), 4000, 8, every_s)
    _, p = judged(made, VESSELS)
    for low, high in ((0.0, 0.01), (0.01, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 1.1)):
        some = (p >= low) & (p < high)
        deviation = 4.0 * np.sqrt(np.sum(p[some] * (1.0 - p[some])) + 1.0) / max(some.sum(), 1)
        assert abs(p[some].mean() - lies[some].mean()) < deviation + 0.02, (low, some.sum())
    _, alone = judged(States(made.time_s, made.state, made.covariance, None, made.rows), VESSELS)
    loss = [-np.log(np.maximum(np.where(lies, q, 1.0 - q), 1e-12)).mean() for q in (p, alone)]
    assert loss[0] < 0.65 * loss[1]


def test_a_departure_and_an_arrival_are_recognised():
    time_s = 10.0 * np.arange(40)
    speed = np.where((time_s >= 100.0) & (time_s < 250.0), 5.0, 0.0)
    place = np.column_stack([np.cumsum(speed) * 10.0, np.zeros(40)])
    _, p = judged(states(time_s, place, np.column_stack([speed, np.zeros(40)]), ["a"] * 40), VESSELS)
    assert np.all(p[2:10] > 0.95) and np.all(p[10:25] < 0.05) and np.all(p[26:] > 0.9)


def test_reports_without_a_velocity_start_again():
    time_s = np.array([0.0, 180.0, 360.0, 540.0])
    made = states(time_s, np.zeros((4, 2)), np.zeros((4, 2)), ["a"] * 4)
    unknown = States.of(time_s, np.zeros((4, 2)), 25.0 * np.eye(2), speed_m_per_s=8.0, track=["a"] * 4)
    covariance = np.where((time_s == 180.0)[:, None, None], unknown.covariance, made.covariance)
    _, p = judged(States(time_s, made.state, covariance, made.track, made.rows), VESSELS)
    assert p[1] == 0.0 and p[2] == pytest.approx(p[0]) and p[3] > p[2]


def test_a_second_report_of_one_time_is_no_evidence():
    made = States(np.zeros(2), np.zeros((2, 4)), np.zeros((2, 4, 4)), np.array(["a", "a"]), np.arange(2))
    _, p = judged(made, VESSELS)
    assert p[0] == p[1] > 0.9


@pytest.mark.parametrize("late", [False, True])
def test_a_live_feed_gives_the_probabilities_of_the_file(late):
    rng = np.random.default_rng(5)
    made, _ = simulated(rng, 20, 12, 10.0)
    columns = {
        "time_s": made.time_s, "x_m": made.state[:, 0], "y_m": made.state[:, 1], "vx_m_per_s": made.state[:, 2],
        "vy_m_per_s": made.state[:, 3], "mmsi": [f"23500{int(k):04d}" for k in made.track],
    }  # fmt: skip
    description = Description("ais", "ais", motion=VESSELS, errors=SensorErrors(position_m=5.0, speed_m_per_s=0.5))
    reports = Reports.of("ais", "ais", columns)
    whole, live = Feed.of(description, reports), LiveFeed(description, lag_s=30.0)
    arrival = made.time_s + (rng.uniform(0.0, 25.0, len(made)) if late else 0.0)
    for instant_s in np.arange(0.0, 140.0, 5.0):
        arrives = np.flatnonzero((arrival <= instant_s) & (arrival > instant_s - 5.0))
        live.add(reports.where(arrives))
        feed = live.feed(instant_s)
        live.release()
    rows, of_file = feed.succession.at(110.0), whole.succession.at(110.0)
    assert feed.reports.track is not None and whole.reports.track is not None
    order, of_file = rows[np.argsort(feed.reports.track[rows])], of_file[np.argsort(whole.reports.track[of_file])]
    assert isinstance(feed.reports, States) and isinstance(whole.reports, States)
    assert feed.reports.time_s[order].tolist() == whole.reports.time_s[of_file].tolist()
    np.testing.assert_allclose(feed.p_stationary[order], whole.p_stationary[of_file], rtol=1e-9)
    np.testing.assert_allclose(feed.reports.covariance[order], whole.reports.covariance[of_file], rtol=1e-9)


@pytest.mark.parametrize("bare", [False, True])
def test_reports_taken_in_batches_of_tracks_are_the_same(bare):
    """The modes of a day of a country's AIS take 20 GB at once."""
    made, _ = simulated(np.random.default_rng(6), 30, 12, 10.0)
    made = made.take(np.random.default_rng(7).permutation(len(made)))
    usable = made.state.copy()
    usable[::17] = np.nan
    made = replace(made, state=usable, track=None if bare else made.track)
    whole, p_whole = slow_objects(made, VESSELS)
    for batch in (1, 50, 200):
        now, p = slow_objects(made, VESSELS, batch=batch)
        assert np.array_equal(now.state, whole.state, equal_nan=True) and np.array_equal(p, p_whole)
        assert np.array_equal(now.covariance, whole.covariance, equal_nan=True)
