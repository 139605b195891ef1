"""Track history: shares of tracks change over minutes; reports before a manoeuvre stay with their tracks."""

from dataclasses import replace

import numpy as np
import pytest
from modelled_scenes import describe, feed, straight, two_meet

from sameas.picture import Picture
from sameas.picture.picture import picture_states
from sameas.picture.track_history import TrackHistory
from sameas.picture.tuning import Tuning
from sameas.picture.watch import Watch
from sameas.tracks.scene import Scene
from sameas.tracks.source import Motion


def shown(history, instant_s, number):
    """One track, of an object."""
    one = np.ones(1, np.int64)
    return history.advance(instant_s, 7 * one, number * one, np.zeros(1, bool), np.array([1, 2]), Tuning())


def test_shares_sum_to_one_and_change_over_minutes():
    history = TrackHistory()
    for t in range(0, 600, 10):
        history = shown(history, float(t), 1)
    wrong = shown(history, 600.0, 2)
    assert abs(wrong.share.sum() - 1.0) < 1e-9 and wrong.share[wrong.number == 1] > 0.95
    assert wrong.last_of(np.array([7, 8])).tolist() == [2, 0]
    for t in range(610, 1600, 10):
        wrong = shown(wrong, float(t), 2)
    assert abs(wrong.share[wrong.number == 2] - (1.0 - np.exp(-1000.0 / Tuning().history_s))) < 0.01


def test_a_number_returns_with_its_long_standing_tracks():
    history = TrackHistory()
    for t in range(0, 300, 10):
        history = shown(history, float(t), 1)
    at, row = shown(history, 300.0, 2).of(np.array([7]))
    assert at.tolist() == [0, 0] and history.number.tolist() == [1]
    assert shown(history, 300.0, 2).number[row].tolist() == [1, 2]


@pytest.mark.slow
def test_shares_change_within_the_time_of_the_tuning():
    scene, times = two_meet(0, 60.0, swap_s=150.0)
    # After 1000 times its time constant, a history has the last instant only: each track is of one object.
    watch = Watch(tuning=Tuning(history_s=0.01))
    for time_s in times[10:25].tolist():
        watch = watch.advance(scene.at(time_s)).watch
    assert watch.objects.history.share.tolist() == [1.0] * 4


def ferry(seed, stops_s=200.0):
    """A ferry that stops at a pier between two AIS reports, tracked by a radar; other ships are stationary."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 301.0, 10.0)
    x, v = (np.array(part) for part in straight([[0.0, 0.0]], [[9.0, 0.0]], times))
    still = times > stops_s
    x[:, still], v[:, still] = [9.0 * stops_s, 0.0], 0.0
    ais, radar = describe("ais", "ais", period_s=90.0), describe("radar", "tracks")
    reported = np.isin(times, [0.0, 90.0, 180.0, 290.0])
    return Scene.of([
        feed(rng, ais, times[reported], x[:, reported], v[:, reported], 600.0, ["a"], {"mmsi": ["235000001"]}),
        feed(rng, radar, times, x, v, 0.0, ["1"]),
    ]), times  # fmt: skip


@pytest.mark.slow
def test_a_report_before_a_manoeuvre_stays_with_its_track():
    together = 0
    for seed in range(5):
        scene, times = ferry(seed)
        o = Picture.of(scene, times).objects
        together += set(o["object"].tolist()) == {1} and bool((o["n_sources"][o["time_s"] > 0.0] == 2).all())
    # By the motion model the ferry is 13 σ from its report.
    assert together >= 4


def anchorage(seed):
    """A moored vessel that only AIS reports, 1 to 3 hm from silent ones that two radars see, and others under way."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 361.0, 10.0)
    angle = np.arange(6) * np.pi / 3.0
    silent = rng.uniform(100.0, 300.0, (6, 1)) * np.column_stack([np.cos(angle), np.sin(angle)])
    under_way = rng.uniform(-5e3, 5e3, (8, 2)) + np.array([8e3, 0.0])
    x, v = straight([[0.0, 0.0], *silent, *under_way], [*np.zeros((7, 2)), *rng.uniform(-5.0, 5.0, (8, 2))], times)
    ais = replace(describe("ais", "ais", 5.0), motion=Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=0.2))
    mmsi = [f"23500000{k}" for k in range(9)]
    reports = feed(rng, ais, times, x[[0, *range(7, 15)]], v[[0, *range(7, 15)]], 300.0, mmsi, {"mmsi": mmsi})[1]
    due = (reports.track_id != mmsi[0]) | (reports.time_s % 180.0 == 0.0)
    radars = [
        feed(rng, describe(name, "tracks"), times, x[1:], v[1:], 0.0, [f"{name} {k}" for k in range(14)])
        for name in ("r", "s")
    ]
    return Scene.of([(ais, reports.where(due)), *radars]), times, mmsi[0]


@pytest.mark.slow
def test_tracks_that_never_were_of_a_moored_vessel_are_no_sign_that_she_departed():
    for seed in range(3):
        scene, times, moored = anchorage(seed)
        for state in picture_states(scene, times, Watch()):
            scan = state.scan
            own = int(np.flatnonzero(scan.track == moored)[0])
            assert not scan.manoeuvre_covariance[own].any()
            members = state.members[(state.members == own).any(axis=1)]
            assert np.count_nonzero(members >= 0) == 1
