"""Two objects with one id become two tracks, and tracks end after their timeout."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sameas.tracks.alignment import States
from sameas.tracks.duplicate_ids import split_duplicate_ids
from sameas.tracks.feed import track_timeout_s
from sameas.tracks.live_feed import LiveFeed
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Description, Motion, SensorErrors

SPEED = 8.0


def states(places: list[list[tuple[float, float, float]]], names: list[str]) -> States:
    """States from one list of (time, east, north) per object."""
    rows = [(t, x, y, name) for way, name in zip(places, names, strict=True) for t, x, y in way]
    rows.sort()
    time_s, x, y, track = (list(column) for column in zip(*rows, strict=True))
    return States.of(
        time_s, np.column_stack([x, y]), 100.0 * np.eye(2), speed_m_per_s=SPEED, track=np.array(track, object)
    )


def way(start_s: float, east_m: float, count: int = 10, speed: float = 5.0) -> list[tuple[float, float, float]]:
    return [(start_s + 10.0 * k, east_m + speed * 10.0 * k, 0.0) for k in range(count)]


def test_one_id_at_two_positions_becomes_two_tracks() -> None:
    reports = states([way(0.0, 0.0), way(5.0, 9000.0), way(2.0, -3000.0)], ["7", "7", "8"])
    found, notes = split_duplicate_ids(reports, SPEED)
    owner = np.select([reports.state[:, 0] > 5000.0, reports.state[:, 0] < -1000.0], ["far", "other"], "near")
    assert {name: set(found.track[owner == name]) for name in ("near", "far", "other")} == {
        "near": {"7"}, "far": {"7 (2)"}, "other": {"8"},
    }  # fmt: skip
    assert notes == ("7 is reported at 2 places too far apart for one object: split into one track each",)
    assert found.usable.all()


def test_a_lone_report_far_away_is_not_used() -> None:
    reports = states([way(0.0, 0.0), [(43.0, 50e3, 0.0)]], ["7", "7"])
    found, notes = split_duplicate_ids(reports, SPEED)
    assert (
        set(found.track) == {"7"} and (~found.usable).sum() == 1 and not found.usable[reports.state[:, 0] > 4e4].any()
    )
    assert notes == ("1 report of 7 set aside: no object moves that fast",)


def moving(east_m: np.ndarray, time_s: np.ndarray) -> States:
    """Reports of one ship that states 5 m/s to the east."""
    velocity, covariance = np.tile([5.0, 0.0], (len(time_s), 1)), np.tile(0.1 * np.eye(2), (len(time_s), 1, 1))
    return States.of(
        time_s, np.column_stack([east_m, np.zeros(len(time_s))]), 100.0 * np.eye(2), speed_m_per_s=SPEED,
        velocity=velocity, velocity_covariance=covariance, track=np.full(len(time_s), "7", object),
    )  # fmt: skip


@pytest.mark.parametrize("wrong", [{20: 3000.0, 30: 4000.0, 50: 2500.0}, {20: 3000.0, 120: 3600.0, 170: 3800.0}])
def test_wrong_positions_within_reach_of_each_other_are_no_second_object(wrong: dict[int, float]) -> None:
    """One by one, seconds or minutes apart: no speed of the ship leads from one to the next."""
    time_s = 6.0 * np.arange(200.0)
    east_m = 5.0 * time_s
    for row, off in wrong.items():
        east_m[row] += off
    found, notes = split_duplicate_ids(moving(east_m, time_s), SPEED)
    assert set(found.track) == {"7"} and np.flatnonzero(~found.usable).tolist() == list(wrong)
    assert notes == ("3 reports of 7 set aside: no object moves that fast",)


def test_a_reused_id_is_not_two_simultaneous_objects() -> None:
    found, notes = split_duplicate_ids(states([way(0.0, 0.0), way(150.0, 20e3)], ["7", "7"]), SPEED)
    assert set(found.track) == {"7"} and notes == () and found.usable.all()


@pytest.mark.parametrize("speed", [0.0, 8.0, 20.0])
def test_a_single_object_is_unchanged(speed: float) -> None:
    reports = states([way(0.0, 0.0, 40, speed)], ["7"])
    found, notes = split_duplicate_ids(reports, SPEED)
    assert notes == () and set(found.track) == {"7"}
    np.testing.assert_array_equal(found.state, reports.state)


def test_an_identity_at_two_positions_of_one_source_raises_an_alarm() -> None:
    rows = sorted([(t, x, y, "235070762") for one in (way(0.0, 0.0), way(5.0, 9000.0)) for t, x, y in one])
    columns = dict(zip(("time_s", "x_m", "y_m", "mmsi"), zip(*rows, strict=True), strict=True))
    scene = Scene.of([(Description("ais", "ais"), Reports.of("ais", "ais", columns))])
    [alarm] = scene.at(95.0).alarms()
    assert alarm.value == "235070762" and alarm.distance == pytest.approx(9000.0, abs=50.0)
    assert any("one track each" in note for note in scene.notes)


def test_a_track_ends_after_a_silence_longer_than_the_gaps_of_its_source() -> None:
    steady = [(t, 0.0, 0.0) for t in np.arange(0.0, 300.0, 3.0)]
    lost = [(t, 900.0, 0.0) for t in np.arange(0.0, 60.0, 3.0)]
    rows = sorted([(*r, "1") for r in steady] + [(*r, "2") for r in lost])
    columns = dict(zip(("time_s", "x_m", "y_m", "track_id"), zip(*rows, strict=True), strict=True))
    scene = Scene.of(
        [(Description("radar", "tracks", errors=SensorErrors(position_m=10.0)), Reports.of("radar", "table", columns))]
    )
    assert [len(scene.at(t).sources[0]) for t in (50.0, 59.9, 61.0)] == [2, 2, 1]  # type: ignore[arg-type]


def test_a_ship_at_anchor_stays_where_most_others_report_every_two_seconds() -> None:
    ferries = [
        (t, 400.0 * k + 9.0 * t, 0.0, 9.0, f"23500{k:04d}") for k in range(40) for t in np.arange(0.0, 600.0, 2.0)
    ]
    anchored = [(t, -2000.0, 0.0, 0.0, "235009999") for t in np.arange(0.0, 600.0, 180.0)]
    columns = dict(
        zip(("time_s", "x_m", "y_m", "vx_m_per_s", "mmsi"), zip(*ferries, *anchored, strict=True), strict=True)
    )
    columns["vy_m_per_s"] = [0.0] * len(columns["time_s"])
    scene = Scene.of([(Description("ais", "ais"), Reports.of("ais", "ais", columns))])
    assert [len(scene.at(t).sources[0]) for t in (100.0, 350.0, 599.0)] == [41, 41, 41]  # type: ignore[arg-type]


def test_the_timeout_is_the_99_9th_percentile_of_gaps() -> None:
    rng = np.random.default_rng(1)
    times = np.cumsum(np.where(rng.random(20_000) < 0.05, 180.0, 10.0))
    times[10_000:] += 5000.0
    assert track_timeout_s(times, np.full(20_000, "7")) == pytest.approx(180.0)
    assert track_timeout_s(times, None) == math.inf
    assert track_timeout_s(times[:3], np.array(["1", "2", "3"])) == math.inf


def flights(count: int = 3, step_s: float = 5.0, speed: float = 220.0, **columns: Any) -> Reports:
    """Tracks of another system that fly east side by side, with their velocities."""
    rows = [(step_s * k, speed * step_s * k, 5000.0 * n, f"{n}") for k in range(12) for n in range(count)]
    time_s, x, y, track = (list(column) for column in zip(*rows, strict=True))
    covariance = np.tile([1600.0, 0.0, 1600.0], (len(rows), 1))
    velocity = {"vx_m_per_s": np.full(len(rows), speed), "vy_m_per_s": np.zeros(len(rows))}
    given: dict[str, Any] = (
        {"time_s": time_s, "x_m": x, "y_m": y, "track_id": track, "covariance_m2": covariance} | velocity | columns
    )
    return Reports.of("tracker", "asterix 062", given)


def test_tracks_of_aircraft_move_as_aircraft() -> None:
    scene = Scene.of([(Description("tracker", "tracks"), flights())])
    description = scene.feeds[0].description
    assert scene.notes == () and description.motion.speed_m_per_s == 150.0
    assert {line.kind for line in description.assumed if line.name.startswith("motion.")} == {"tracks of aircraft"}


def test_tracks_of_ships_and_a_given_motion_stay_as_they_are() -> None:
    given = Description("tracker", "tracks", motion=Motion(acceleration_m2_per_s3=1.0, speed_m_per_s=60.0))
    described = Scene.of([(given, flights())]).feeds[0].description
    ships = Scene.of([(Description("tracker", "tracks"), flights(speed=6.0))]).feeds[0].description
    assert (described.motion, ships.motion.speed_m_per_s) == (given.motion, 8.0)


def test_live_tracks_of_aircraft_move_as_aircraft() -> None:
    feed, reports = LiveFeed(Description("tracker", "tracks")), flights(speed=220.0)
    for k in range(len(reports)):
        feed.add(reports.where([k]))
    assert (feed.counts.jumps, feed.description.motion.speed_m_per_s) == (0, 150.0)


def test_one_helicopter_does_not_turn_ships_into_aircraft() -> None:
    feed, ships = LiveFeed(Description("tracker", "tracks")), flights(step_s=30.0, speed=6.0)
    helicopter = flights(1, step_s=30.0, speed=70.0)
    helicopter = replace(helicopter, track_id=np.array(["H"] * len(helicopter), object))
    for k in range(len(helicopter)):
        feed.add(helicopter.where([k]))
        feed.add(ships.where([3 * k, 3 * k + 1, 3 * k + 2]))
    assert (feed.counts.jumps, feed.description.motion.speed_m_per_s) == (0, 8.0)


def test_a_fast_craft_that_states_its_speed_is_one_object() -> None:
    times = np.arange(0.0, 100.0, 10.0)
    speed = np.where(times < 50.0, 2.0, 75.0)
    columns = {"x_m": np.cumsum(10.0 * speed), "y_m": 0.0 * times, "vx_m_per_s": speed, "vy_m_per_s": 0.0 * times}
    reports = Reports.of("ais", "ais", {"time_s": times, "mmsi": ["111232506"] * 10, **columns})
    scene = Scene.of([(Description("ais", "ais"), reports)])
    assert scene.notes == () and scene.feeds[0].reports.usable.all()
