"""The filter: against a textbook track, consistency (NEES, NIS), order of rows, reused ids."""

import numpy as np
import pytest
from scipy.stats import chi2

from sameas.errors import InputError
from sameas.io.sensors.format import kind_of
from sameas.kernels.tracks import filter_tracks
from sameas.tracks import Description, Reports, Scene
from sameas.tracks.alignment import States, aged, follow, moved

Q = 0.2


def scene(rng, tracks=150, reports=12, sigma=20.0):
    """Targets that follow the motion model, reported at irregular times; the states and the truth."""
    time_s = np.cumsum(rng.uniform(0.5, 12.0, (tracks, reports)), axis=1)
    truth = np.empty((tracks, reports, 4))
    truth[:, 0] = np.column_stack([rng.uniform(-1e4, 1e4, (tracks, 2)), 8.0 * rng.standard_normal((tracks, 2))])
    for k in range(1, reports):
        ahead, noise = moved(truth[:, k - 1], np.zeros((tracks, 4, 4)), time_s[:, k] - time_s[:, k - 1], Q)
        root = np.linalg.cholesky(noise + 1e-12 * np.eye(4))
        truth[:, k] = ahead + np.einsum("nvw,nw->nv", root, rng.standard_normal((tracks, 4)))
    seen = truth[..., :2] + sigma * rng.standard_normal((tracks, reports, 2))
    names = np.repeat([f"t{k}" for k in range(tracks)], reports)
    made = States.of(time_s.ravel(), seen.reshape(-1, 2), sigma**2 * np.eye(2), speed_m_per_s=8.0, track=names)
    return made, truth.reshape(-1, 4)


def by_hand(time_s, position, covariance, first):
    """Textbook Kalman filter of one track."""
    x, p = first
    out = [x]
    h = np.eye(2, 4)
    for k in range(1, len(time_s)):
        (x,), (p,) = moved(x[None], p[None], time_s[k] - time_s[k - 1], Q)
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + covariance)
        x = x + gain @ (position[k] - h @ x)
        p = (np.eye(4) - gain @ h) @ p
        out.append(x)
    return np.array(out), p


def test_a_track_agrees_with_the_textbook_filter():
    reports, _ = scene(np.random.default_rng(1), tracks=3, reports=8)
    followed = follow(reports, acceleration_m2_per_s3=Q)
    for name in ("t0", "t1", "t2"):
        own = np.flatnonzero(reports.track == name)
        states, last = by_hand(
            reports.time_s[own],
            reports.state[own, :2],
            400.0 * np.eye(2),
            (reports.state[own[0]], reports.covariance[own[0]]),
        )
        np.testing.assert_allclose(followed.states.state[own], states, rtol=1e-8, atol=1e-6)
        np.testing.assert_allclose(followed.states.covariance[own[-1]], last, rtol=1e-6, atol=1e-8)
    assert list(np.flatnonzero(followed.began)) == [0, 8, 16]


def test_errors_are_consistent():
    reports, truth = scene(np.random.default_rng(2))
    followed = follow(reports, acceleration_m2_per_s3=Q)
    error = followed.states.state - truth
    nees = np.einsum("nv,nvw,nw->n", error, np.linalg.inv(followed.states.covariance), error)
    # The last states of the tracks are independent.
    last = nees.reshape(150, -1)[:, -1]
    low, high = chi2.ppf([0.0005, 0.9995], 4 * 150) / 150
    assert low < last.mean() < high
    nis = followed.nis[np.isfinite(followed.nis)]
    low, high = chi2.ppf([0.0005, 0.9995], 2 * len(nis)) / len(nis)
    assert low < nis.mean() < high


def test_nis_detects_a_filter_with_too_small_measurement_errors():
    reports, _ = scene(np.random.default_rng(3))
    proud = States(reports.time_s, reports.state, 0.25 * reports.covariance, reports.track, reports.rows)
    nis = follow(proud, acceleration_m2_per_s3=Q).nis
    assert np.nanmean(nis) > 3.0


def test_the_order_of_rows_changes_nothing():
    rng = np.random.default_rng(4)
    reports, _ = scene(rng, tracks=9, reports=7)
    turn = rng.permutation(len(reports))
    one, other = (follow(r, acceleration_m2_per_s3=Q) for r in (reports, reports.take(turn)))
    np.testing.assert_allclose(other.states.state, one.states.state[turn], rtol=1e-9)
    np.testing.assert_allclose(other.nis, one.nis[turn], rtol=1e-9)


def test_the_velocity_of_a_track_is_more_precise_than_any_report():
    reports, truth = scene(np.random.default_rng(5))
    last = np.arange(11, len(reports), 12)
    error = follow(reports, acceleration_m2_per_s3=Q).states.state[last] - truth[last]
    assert np.sqrt(np.mean(error[:, 2:] ** 2)) < 0.5 * 8.0
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 20.0


def test_a_straight_course_is_followed_without_lag():
    rng = np.random.default_rng(9)
    tracks, looks, course = 400, 40, 2.0 * np.pi * np.random.default_rng(10).random(400)
    ahead = np.column_stack([np.sin(course), np.cos(course)])
    time_s = np.broadcast_to(3.0 * np.arange(looks), (tracks, looks))
    truth = 6.0 * ahead[:, None] * time_s[..., None]
    seen = truth + 25.0 * rng.standard_normal(truth.shape)
    names = np.repeat([f"t{k}" for k in range(tracks)], looks)
    made = States.of(time_s.ravel(), seen.reshape(-1, 2), 625.0 * np.eye(2), speed_m_per_s=8.0, track=names)
    states = follow(made, acceleration_m2_per_s3=0.01).states
    last = states.state.reshape(tracks, looks, 4)[:, -1]
    late_s = -np.einsum("nv,nv->n", last[:, :2] - truth[:, -1], ahead) / 6.0
    slow = 1.0 - np.einsum("nv,nv->n", last[:, 2:], ahead) / 6.0
    for bias in (late_s, slow):
        assert abs(bias.mean()) < 4.0 * bias.std() / np.sqrt(tracks)
    assert late_s.std() / np.sqrt(tracks) < 0.1


def changing(rng, tracks=200, looks=200):
    """Ships at 8 m/s that turn by 90° or speed up by 0.12 m/s² between 200 and 300 s; the reports and the truth."""
    time_s = 3.0 * np.arange(looks)
    share = np.clip((time_s - 200.0) / 100.0, 0.0, 1.0)
    turn, faster = np.deg2rad(90.0) * share, 12.0 * share
    turns = np.arange(tracks) % 2 == 0
    speed = np.where(turns[:, None], 8.0, 8.0 + faster)
    course = np.where(turns[:, None], turn, 0.0)
    truth = np.cumsum(3.0 * speed[..., None] * np.stack([np.sin(course), np.cos(course)], axis=-1), axis=1)
    seen = truth + 25.0 * rng.standard_normal(truth.shape)
    names = np.repeat([f"t{k}" for k in range(tracks)], looks)
    made = States.of(np.tile(time_s, tracks), seen.reshape(-1, 2), 625.0 * np.eye(2), speed_m_per_s=8.0, track=names)
    return made, truth


def test_a_ship_that_turns_or_speeds_up_for_a_minute_is_followed_with_little_lag_and_honest_errors():
    made, truth = changing(np.random.default_rng(11))
    states = follow(made, acceleration_m2_per_s3=0.01).states
    late = slice(84, 100)  # 252 to 297 s
    error = (states.state[:, :2].reshape(truth.shape) - truth)[:, late]
    covariance = states.covariance[:, :2, :2].reshape(*truth.shape, 2)[:, late]
    nees = np.einsum("nkv,nkvw,nkw->nk", error, np.linalg.inv(covariance), error)
    assert np.hypot(*error.mean(axis=1).T).mean() < 15.0
    assert nees.mean() < 4.0


def test_the_filter_is_as_before_while_the_motion_is_as_modelled():
    reports, _ = scene(np.random.default_rng(12), tracks=300, reports=30)
    manoeuvres = follow(reports, acceleration_m2_per_s3=Q).trend[:, 3] == 0.0
    assert manoeuvres.mean() < 1e-3


def test_a_single_outlier_is_no_manoeuvre():
    time_s = 3.0 * np.arange(30)
    position = np.column_stack([6.0 * time_s, np.zeros(30)])
    position[20, 1] = 150.0
    reports = States.of(time_s, position, 625.0 * np.eye(2), speed_m_per_s=8.0, track=["7"] * 30)
    assert np.isinf(follow(reports, acceleration_m2_per_s3=0.01).trend[:, 3]).all()


def test_an_id_given_to_another_object_begins_a_new_track():
    time_s = np.arange(8.0)
    position = np.column_stack([5.0 * time_s, np.zeros(8)])
    position[4:, 1] += 20e3
    reports = States.of(time_s, position, np.eye(2), speed_m_per_s=8.0, track=["7"] * 8)
    followed = follow(reports, acceleration_m2_per_s3=Q)
    assert list(np.flatnonzero(followed.began)) == [0, 4]
    assert np.abs(followed.states.state[-1, 3]) < 3.0


def test_reports_without_position_are_unchanged():
    reports, _ = scene(np.random.default_rng(6), tracks=2, reports=5)
    holed = States(reports.time_s, reports.state.copy(), reports.covariance, reports.track, reports.rows)
    holed.state[2] = np.nan
    followed = follow(holed, acceleration_m2_per_s3=Q)
    rest = np.delete(np.arange(10), 2)
    np.testing.assert_allclose(
        followed.states.state[rest], follow(reports.take(rest), acceleration_m2_per_s3=Q).states.state
    )
    assert np.isnan(followed.states.state[2]).all() and np.isnan(followed.nis[2])


def test_invalid_input_is_refused():
    bare = States.of([0.0], np.zeros((1, 2)), np.eye(2), speed_m_per_s=8.0)
    with pytest.raises(InputError, match="name no tracks"):
        follow(bare, acceleration_m2_per_s3=Q)


def test_a_gap_of_a_day_is_no_manoeuvre():
    """Such as after a damaged time of day: a noise a hundred times larger for a day left covariances of 10²⁰ m²."""
    made, _ = changing(np.random.default_rng(13), tracks=20, looks=90)
    late = made.time_s + np.where(made.time_s >= 267.0, 86_400.0, 0.0)
    reports = States(late, made.state, made.covariance, made.track, made.rows)
    tracks = follow(reports, acceleration_m2_per_s3=0.01)
    assert (np.linalg.eigvalsh(tracks.states.covariance) > 0.0).all()
    after = tracks.states.covariance[np.flatnonzero(made.time_s == 267.0)]
    assert after[:, 0, 0].max() < 1.01 * 625.0
    # The random walk of a day, of which the position after it excludes three quarters.
    assert after[:, 2, 2].max() < 0.01 * 86_400.0


def test_a_covariance_that_is_singular_by_rounding_is_aged():
    axis = np.array([1.0, -0.16])
    covariance = np.zeros((2, 4, 4))
    covariance[:, 2:, 2:] = np.eye(2)
    covariance[0, :2, :2] = 8e20 * np.outer(axis, axis)
    covariance[1, :2, :2] = 25.0**2 * np.eye(2)
    assert aged(covariance, 1e-9).tolist() == [True, False]


def test_the_filter_gives_the_same_result_interpreted_as_compiled(monkeypatch):
    made, _ = changing(np.random.default_rng(13), tracks=10)
    made.state[500, :2] += 20e3  # an id given to another object
    ways = []
    for way in ("interpreted", "compiled"):
        monkeypatch.setattr("sameas.tracks.alignment.filter_tracks", getattr(filter_tracks, way))
        ways.append(follow(made, acceleration_m2_per_s3=0.01))
    one, other = ways
    assert (one.trend[:, 3] == 0.0).any() and one.began[500]
    for name in ("nis", "began", "trend"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.states.state, other.states.state)
    np.testing.assert_array_equal(one.states.covariance, other.states.covariance)


def test_multilateration_of_a_surveillance_system_follows_an_airliner_in_a_turn():
    """With the errors of amateur receivers its track lagged by 250 m, and was taken for a forged address."""
    rng, speed, rate = np.random.default_rng(3), 217.0, np.radians(1.2)  # m/s, a bank of 25°
    t = np.cumsum(rng.uniform(1.0, 2.0, 90))
    heading = rate * np.clip(t - 60.0, 0.0, 60.0)
    place = speed * np.cumsum(np.column_stack([np.sin(heading), np.cos(heading)]) * np.diff(t, prepend=0.0)[:, None], 0)
    x_m, y_m = (place + 25.0 * rng.normal(size=place.shape)).T
    columns = {"time_s": t, "x_m": x_m, "y_m": y_m, "icao": ["3c6528"] * len(t)}
    kind = kind_of("asterix 020")
    assert kind is not None
    [feed] = Scene.of([(Description("towers", kind), Reports.of("towers", "asterix 020", columns))]).feeds
    assert feed.filtered and isinstance(feed.reports, States)
    assert np.hypot(*(feed.reports.state[:, :2] - place).T).max() < 130.0
