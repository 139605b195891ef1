"""Repeated positions of a moving object are set aside."""

from typing import Any

import numpy as np

from sameas.tracks.alignment import States
from sameas.tracks.feed import Feed, position_updates
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description


def states_of(position, velocity, track, time_s=None, sigma=1.0):
    n = len(position)
    return States.of(
        np.arange(n) if time_s is None else time_s, position, 100.0 * np.eye(2), speed_m_per_s=150.0, track=track,
        velocity=velocity, velocity_covariance=sigma**2 * np.eye(2),
    )  # fmt: skip


def test_a_repeated_position_of_a_moving_object_is_set_aside():
    rng = np.random.default_rng(1)
    place, v = [[0.0, 0.0], [60.0, 0.0], [60.0, 0.0], [60.0, 0.0], [240.0, 0.0]], np.full((5, 2), [60.0, 0.0])
    order = rng.permutation(10)
    both = states_of(
        [*place, *np.add(place, 9e3)], np.vstack([v, v]), ["a"] * 5 + ["b"] * 5, np.tile(np.arange(5.0), 2)
    )
    now, notes = position_updates(both.take(order))
    assert sorted(order[~now.usable]) == [2, 3, 7, 8]
    assert notes == ("4 reports repeat the positions of an earlier report though the object moves; set aside: no "
                     "position was measured",)  # fmt: skip
    # Returning to a position is no repetition.
    assert position_updates(states_of([[0.0, 0.0], [9.0, 0.0], [0.0, 0.0]], v[:3], ["a"] * 3))[0].usable.all()


def test_an_object_that_may_be_stationary_may_repeat_its_position():
    place = np.zeros((4, 2))
    for velocity in (np.zeros((4, 2)), np.full((4, 2), 0.9), np.full((4, 2), np.nan)):
        states, notes = position_updates(states_of(place, velocity, ["a"] * 4, sigma=0.3))
        assert states.usable.all()
        assert notes == ()
    moving = np.full((4, 2), 50.0)
    assert position_updates(states_of(place, moving, list("abcd")))[0].usable.all()
    assert position_updates(states_of(place, moving, None))[0].usable.all()


def test_a_feed_reports_rows_set_aside():
    columns: dict[str, Any] = {
        "time_s": [0.0, 1.0, 2.0], "lat_deg": [48.0, 48.0, 48.001], "lon_deg": [2.0, 2.0, 2.0],
        "speed_m_per_s": [50.0] * 3, "course_deg": [0.0] * 3, "icao": ["4bc844"] * 3,
    }  # fmt: skip
    from sameas.tracks.coordinates import LocalPlane

    feed = Feed.of(Description("adsb", "ads-b"), Reports.of("adsb", "table", columns), LocalPlane(48.0, 2.0))
    assert list(feed.reports.usable) == [True, False, True]
    assert feed.notes[0].startswith("adsb: 1 report repeats the position of an earlier report")
