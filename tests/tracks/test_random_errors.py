"""What is random of the errors that a source states: from third differences of its positions, before any filter."""

import numpy as np
import pytest

from sameas.tracks.alignment import States
from sameas.tracks.feed import Feed
from sameas.tracks.random_errors import random_errors
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, SensorErrors, Site

WALK = 0.01


def turning(rng, n=200, every_s=3.0, uneven=False):
    """(n,), (n, 2) times and places of a vessel that turns by 2° a second for a minute, every four minutes."""
    gaps = rng.uniform(0.3, 2.0, n) * every_s if uneven else np.full(n, every_s)
    t = np.cumsum(gaps)
    course = rng.uniform(0.0, 6.3) + np.cumsum(np.radians(2.0) * gaps * (t % 240.0 < 60.0))
    return t, np.cumsum(5.0 * gaps[:, None] * np.column_stack([np.sin(course), np.cos(course)]), axis=0)


def states(tracks, noise_m, stated_m):
    """Reports of tracks (times, places) with errors, stated as these 1σ east and north."""
    t, x = (np.concatenate([track[k] for track in tracks]) for k in (0, 1))
    names = np.repeat(np.arange(len(tracks)), [len(track[0]) for track in tracks])
    return States.of(t, x + noise_m, np.diag(np.square(stated_m)), speed_m_per_s=8.0, track=names)


def correlated(rng, n, rho):
    """(n, 2) errors of variance 1, each correlated by ρ with the one before."""
    out = rng.normal(size=(n, 2))
    for k in range(1, n):
        out[k] = rho * out[k - 1] + np.sqrt(1.0 - rho**2) * out[k]
    return out


@pytest.mark.parametrize("uneven", [False, True])
def test_errors_stated_far_too_large_are_found_in_each_direction(uneven):
    rng = np.random.default_rng(1)
    tracks = [turning(rng, uneven=uneven) for _ in range(6)]
    noise = rng.normal(size=(1200, 2)) * [30.0, 20.0]
    found = random_errors(states(tracks, noise, [500.0, 20.0]), None, WALK)
    assert 30.0 / 500.0 * 0.9 < found.along < 30.0 / 500.0 * 1.5 and found.across == 1.0


@pytest.mark.parametrize("rho", [0.0, 0.8])
@pytest.mark.parametrize("uneven", [False, True])
def test_honest_errors_are_as_stated_also_where_neighbouring_ones_are_correlated(rho, uneven):
    rng = np.random.default_rng(2)
    tracks = [turning(rng, uneven=uneven) for _ in range(6)]
    noise = 20.0 * np.concatenate([correlated(rng, 200, rho) for _ in tracks])
    assert not random_errors(states(tracks, noise, [20.0, 20.0]), None, WALK).overstated


def test_objects_at_rest_whose_positions_repeat_say_nothing_of_those_that_move():
    rng = np.random.default_rng(3)
    still = [(np.arange(0.0, 600.0, 3.0), np.full((200, 2), 50.0 * k)) for k in range(8)]
    moving = [turning(rng) for _ in range(2)]
    noise = np.concatenate([np.zeros((1600, 2)), rng.normal(0.0, 20.0, (400, 2))])
    assert not random_errors(states([*still, *moving], noise, [20.0, 20.0]), None, WALK).overstated


def test_few_reports_say_nothing():
    t = np.arange(20.0)
    assert not random_errors(states([(t, np.zeros((20, 2)))], 0.0, [99.0, 99.0]), None, WALK).overstated


def test_the_track_of_a_turning_vessel_does_not_lag_where_500_m_are_stated_for_30_m():
    rng = np.random.default_rng(4)
    t, x = turning(rng)
    x = x - x.mean(axis=0) + [4000.0, 3000.0]
    range_m, bearing_deg = np.hypot(*x.T) + rng.normal(0.0, 30.0, len(t)), np.degrees(np.arctan2(*x.T))
    columns = {"time_s": t, "range_m": range_m, "bearing_deg": bearing_deg + rng.normal(0.0, 0.15, len(t))}
    radar = Description(
        "radar", "marine radar", Site(east_m=0.0, north_m=0.0),
        errors=SensorErrors(range_m=500.0, range_share=0.0, bearing_deg=3.0, extent_m=10.0),
    )  # fmt: skip
    feed = Feed.of(radar, Reports.of("radar", "table", columns | {"track_id": ["7"] * len(t)}), to_tracks=True)
    reports, later = feed.reports, slice(30, None)
    assert isinstance(reports, States)
    # The positions stay as reported, with errors between the random ones and those stated.
    assert np.hypot(*(reports.state[later, :2] - x[later]).T).max() < 150.0
    assert 30.0 < np.sqrt(np.median(reports.covariance[:, 0, 0])) < 200.0
    velocity = np.gradient(x, t, axis=0)
    off = np.hypot(*(reports.state[later, 2:] - velocity[later]).T)
    assert np.median(off) < 1.0 and off.max() < 6.0
