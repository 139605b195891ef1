"""Feeds: plots are filtered into tracks where needed, repeated positions set aside, stationary vessels recognised."""

import gc
import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sameas import identify_many
from sameas.errors import InputError
from sameas.many.observations import records_of
from sameas.tracks.alignment import States, moved
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.feed import Feed, need_filtering, position_updates, repeated
from sameas.tracks.placement import PlacedReports
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Description, MissRate, Motion, Resolution, SensorErrors, Site
from sameas.tracks.stationary import ADRIFT, DRIFT_WALK_M2_PER_S3, MIN_VARIANCE, stationary

PLOTS = {"time_s": [0.0, 3.0], "range_m": [900.0, 910.0], "bearing_deg": [10.0, 11.0]}
PLACES = {"time_s": [0.0, 3.0], "lat_deg": [50.0, 50.1], "lon_deg": [1.0, 1.0]}
SPEEDS = {"speed_m_per_s": [4.0, np.nan], "course_deg": [10.0, np.nan]}


@pytest.mark.parametrize(
    ("kind", "wrote", "columns", "needed"),
    [
        ("marine radar", "table", PLOTS | {"track_id": ["1", "1"]}, True),
        ("marine radar", "table", PLOTS, False),  # bare plots
        ("marine radar", "table", PLOTS | SPEEDS | {"track_id": ["1", "1"]}, False),  # a tracker's
        ("marine radar", "arpa", PLOTS | {"track_id": ["1", "1"]}, False),
        (
            "air radar",
            "asterix 048",
            PLOTS | SPEEDS | {"track_id": ["1", "1"]},
            True,
        ),  # plots with a tracker's velocity
        ("ais", "ais", PLACES | {"mmsi": ["2", "2"]}, True),
        ("ais", "ais", PLACES | SPEEDS | {"mmsi": ["2", "2"]}, False),
        ("mlat", "table", PLACES | {"icao": ["3c0000", "3c0000"]}, True),
        ("tracks", "table", PLACES | {"track_id": ["1", "1"]}, False),
        ("camera", "table", {"time_s": [0.0, 3.0], "bearing_deg": [1.0, 2.0], "track_id": ["1", "1"]}, False),
    ],
)
def test_plots_with_ids_and_without_velocities_are_filtered(kind, wrote, columns, needed):
    about = Description("one", kind, site=Site(east_m=0.0, north_m=0.0))
    assert need_filtering(PlacedReports(about, Reports.of("one", wrote, columns))) is needed


def vessels(rng, n=60, width_m=6e3):
    """Radar plots every 6 s and AIS every 3 min of the same vessels, all without velocities."""
    place, speed = rng.uniform(-width_m, width_m, (n, 2)), rng.normal(0.0, 6.0, (n, 2))
    plots, fixes = [], []
    for t in np.arange(0.0, 600.0, 6.0):
        seen = np.flatnonzero(rng.random(n) < 0.9)
        plots += [(t, i, *(place[i] + t * speed[i] + 40.0 * rng.normal(size=2))) for i in seen]
    for i, antenna in enumerate(8.0 * rng.normal(size=(n, 2))):
        for t in np.arange(rng.uniform(0.0, 180.0), 600.0, 180.0):
            fixes.append((t, i, *(place[i] + antenna + t * speed[i] + 2.0 * rng.normal(size=2))))
    reports = []
    for name, number, rows in (("radar", "track_id", plots), ("ais", "mmsi", sorted(fixes))):
        time_s, who, x_m, y_m = np.transpose(rows)
        columns = {"time_s": time_s, "x_m": x_m, "y_m": y_m, number: who.astype(int)}
        reports.append(Reports.of(name, "table", columns))
    return reports


RADAR = Description("radar", "marine radar", errors=SensorErrors(position_m=40.0, extent_m=0.0), misses=MissRate(0.1))
AIS = Description("ais", "ais", errors=SensorErrors(position_m=8.0, extent_m=0.0))


@pytest.mark.parametrize("said_m", [25.0, 40.0, 60.0])
def test_the_scatter_of_positions_shows_whether_a_tracker_reports_plots_or_smoothed_tracks(said_m):
    radar, _ = vessels(np.random.default_rng(4))
    about = Description("radar", "marine radar", errors=SensorErrors(position_m=said_m, extent_m=0.0))
    tracks = Feed.of(RADAR, radar, to_tracks=True).reports
    assert isinstance(tracks, States)
    velocity = {"vx_m_per_s": tracks.state[:, 2], "vy_m_per_s": tracks.state[:, 3]}
    names = {"time_s": radar.time_s, "track_id": radar.track_id}
    plots = Reports.of("radar", "table", names | velocity | {"x_m": radar.x_m, "y_m": radar.y_m})
    smoothed = {"x_m": tracks.state[:, 0], "y_m": tracks.state[:, 1]}
    # A tracker reports its tracks after convergence.
    settled = Reports.of("radar", "table", names | velocity | smoothed).where(radar.time_s > 120.0)
    assert need_filtering(PlacedReports(about, plots))
    assert not need_filtering(PlacedReports(about, settled))
    # Too few reports to decide.
    assert not need_filtering(PlacedReports(about, plots.where(np.arange(40))))
    assert not need_filtering(PlacedReports(Description("radar", "tracks", errors=about.errors), plots))


def f1_of_pairs(scene, instants_s):
    right = wrong = missed = 0
    for instant_s in instants_s:
        now = scene.at(instant_s)
        members = identify_many(now.sources, rule=now.rule(), region=now.region).members
        both = members[~np.ma.getmaskarray(members).any(axis=1)].data
        who = [np.asarray(getattr(feed.raw_reports, name))[records_of(source).ids].astype(int)
               for feed, source, name in zip(now.feeds, now.sources, ("track_id", "mmsi"), strict=True)]  # fmt: skip
        alike = int(np.sum(who[0][both[:, 0]] == who[1][both[:, 1]]))
        right, wrong = right + alike, wrong + len(both) - alike
        missed += len(np.intersect1d(*who)) - alike
    return 2.0 * right / (2.0 * right + wrong + missed)


@pytest.mark.slow
def test_filtering_corrects_pairs_that_bare_positions_get_wrong():
    scores = {True: [], False: []}
    for seed in range(3):
        radar, ais = vessels(np.random.default_rng(seed))
        for to_tracks, found in scores.items():
            feeds = [
                Feed.of(described, given, to_tracks=to_tracks) for described, given in ((RADAR, radar), (AIS, ais))
            ]
            found.append(f1_of_pairs(Scene(tuple(feeds)), (400.0, 590.0)))
    assert np.mean(scores[True]) > 0.985 > 0.95 > np.mean(scores[False])
    scene = Scene.of([(RADAR, radar), (AIS, ais)])
    assert [feed.filtered for feed in scene.feeds] == [True, True]
    assert f1_of_pairs(scene, (400.0, 590.0)) == scores[True][-1]


def test_satellite_positions_get_velocities_and_are_unchanged():
    _, ais = vessels(np.random.default_rng(5))
    plain, filtered = (Feed.of(AIS, ais, to_tracks=to_tracks).reports for to_tracks in (False, True))
    assert isinstance(plain, States) and isinstance(filtered, States)
    np.testing.assert_array_equal(filtered.state[:, :2], plain.state[:, :2])
    np.testing.assert_array_equal(filtered.covariance[:, :2, :2], plain.covariance[:, :2, :2])
    last = filtered.time_s > 450.0
    assert not plain.state[:, 2:].any() and np.median(np.sqrt(filtered.covariance[last, 2, 2])) < 1.0
    assert not filtered.covariance[last, :2, 2:].any()


def test_velocity_covariances_of_the_filter_are_consistent():
    """Mean normalised squared error over many tracks = dimension."""
    rng = np.random.default_rng(8)
    radar, _ = vessels(rng, n=200, width_m=50e3)
    tracks = Feed.of(RADAR, radar, to_tracks=True).reports
    assert isinstance(tracks, States)
    place = np.random.default_rng(8)
    place.uniform(-50e3, 50e3, (200, 2))
    speed = place.normal(0.0, 6.0, (200, 2))
    last = tracks.time_s >= 588.0
    error = tracks.state[last, 2:] - speed[tracks.track[last].astype(int)]
    chi_sq = np.einsum("nv,nvw,nw->n", error, np.linalg.inv(tracks.covariance[last, 2:, 2:]), error)
    # The vessels manoeuvre less than the process noise allows, so errors are at most the stated ones.
    assert 0.1 < chi_sq.mean() < 2.5


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


def rounded_arpa(minutes):
    """An ARPA's reports of a ship of 4 m/s that closes, every 3 s, in steps of 0.01 nm and 0.1°."""
    time_s = np.arange(0.0, 60.0 * minutes, 3.0)
    columns: dict[str, Any] = {
        "time_s": time_s, "track_id": ["07"] * len(time_s),
        "range_m": np.round((6000.0 - 4.0 * time_s) / 18.52) * 18.52, "bearing_deg": np.full(len(time_s), 30.0),
        "speed_m_per_s": np.full(len(time_s), 4.0), "course_deg": np.full(len(time_s), 210.0),
    }  # fmt: skip
    radar = Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0))
    return radar, Reports.of("radar", "arpa", columns)


def test_positions_rounded_by_an_arpa_are_no_repetitions():
    radar, reports = rounded_arpa(minutes=5.0)
    feed = Feed.of(radar, reports)
    assert isinstance(feed.reports, States)
    repeats, _ = repeated(np.zeros(len(reports), int), reports.time_s, feed.reports.state[:, :2])
    assert len(repeats) > 5
    assert feed.reports.usable.all()
    assert not any("repeat" in note for note in feed.notes)


def test_a_position_that_stays_behind_its_object_is_set_aside_after_some_reports():
    n = 10
    reports = states_of(np.zeros((n, 2)), np.tile([4.0, 0.0], (n, 1)), ["a"] * n, sigma=0.1)
    now, _ = position_updates(reports)
    # 2σ of 10 m are reached after 5 s, since the first report of the position, not since the one before.
    assert np.flatnonzero(~now.usable).tolist() == [6, 7, 8, 9]


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
        "time_s": [0.0, 1.0, 2.0], "lat_deg": [48.0, 48.0, 48.0036], "lon_deg": [2.0, 2.0, 2.0],
        "speed_m_per_s": [200.0] * 3, "course_deg": [0.0] * 3, "icao": ["4bc844"] * 3,
    }  # fmt: skip
    from sameas.tracks.coordinates import LocalPlane

    feed = Feed.of(Description("adsb", "ads-b"), Reports.of("adsb", "table", columns), LocalPlane(48.0, 2.0))
    assert list(feed.reports.usable) == [True, False, True]
    assert feed.notes[0].startswith("adsb: 1 report repeats the position of an earlier report")


VESSELS = Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=0.3)


def reported_states(velocity, sigma_m_per_s=0.3, sigma_m=5.0):
    n = len(velocity)
    return States.of(
        np.zeros(n), np.zeros((n, 2)), sigma_m**2 * np.eye(2), speed_m_per_s=8.0, velocity=velocity,
        velocity_covariance=sigma_m_per_s**2 * np.eye(2),
    )  # fmt: skip


def test_the_probability_of_being_stationary_follows_bayes():
    rng = np.random.default_rng(1)
    velocity = rng.normal(0.0, 0.8, (30, 2))
    _, modes = stationary(reported_states(velocity), VESSELS)
    density = [
        multivariate_normal.pdf(velocity, cov=(0.09 + MIN_VARIANCE + s**2) * np.eye(2)) for s in (0.01, 0.1, 0.5, 8.0)
    ]
    weight = np.array([0.15, 0.15, 0.07, 0.63]) * np.transpose(density)
    assert modes is not None
    np.testing.assert_allclose(modes.p_slow, weight[:, :3] / weight.sum(axis=1, keepdims=True), rtol=1e-9)


def test_mean_and_covariance_agree_with_the_mixture():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(4, 4)) * np.array([5.0, 5.0, 0.4, 0.4])[:, None]
    state, covariance = np.array([[3.0, -7.0, 1.3, 0.5]]), (root @ root.T)[None]
    made = States(np.zeros(1), state, covariance, None, np.arange(1))
    now, modes = stationary(made, VESSELS)
    assert modes is not None and 0.05 < modes.p_slow.sum() < 0.95
    parts = [(1.0 - modes.p_slow.sum(), (state[0], covariance[0]))]
    for share, slow in zip(modes.p_slow[0], (0.01, 0.1, 0.5), strict=True):
        gain = covariance[0][:, 2:] @ np.linalg.inv(covariance[0][2:, 2:] + slow**2 * np.eye(2))
        mean, spread = state[0] - gain @ state[0, 2:], covariance[0] - gain @ covariance[0][2:]
        if slow == 0.5:
            # Adrift, the position stays as reported.
            mean[:2], spread[:2, :2], spread[:2, 2:], spread[2:, :2] = state[0, :2], covariance[0, :2, :2], 0.0, 0.0
        parts.append((share, (mean, spread)))
    many = np.vstack([rng.multivariate_normal(*gaussian, int(400_000 * share)) for share, gaussian in parts])
    np.testing.assert_allclose(now.state[0], many.mean(axis=0), atol=0.03)
    np.testing.assert_allclose(now.covariance[0], np.cov(many.T), rtol=0.02, atol=0.02)


@pytest.mark.slow
def test_states_of_simulated_vessels_are_consistent():
    rng = np.random.default_rng(6)
    n, age_s = 100_000, 180.0
    mode = rng.choice(4, n, p=[0.15, 0.15, 0.07, 0.63])
    velocity = np.array([0.01, 0.1, 0.5, 8.0])[mode, None] * rng.standard_normal((n, 2))
    there, _ = moved(np.column_stack([np.zeros((n, 2)), velocity]), np.zeros((n, 4, 4)), age_s, 0.0)
    walk = np.array([0.0, 0.0, DRIFT_WALK_M2_PER_S3, 0.01])[mode]
    there[:, :2] += np.sqrt(walk * age_s**3 / 3.0)[:, None] * rng.standard_normal((n, 2))
    made = reported_states(velocity + 0.3 * rng.standard_normal((n, 2)))
    now, modes = stationary(made, VESSELS)
    assert modes is not None
    stands = modes.p_slow.sum(axis=1)
    mean_walk = 0.01 * (1.0 - stands) + DRIFT_WALK_M2_PER_S3 * modes.p_slow[:, ADRIFT]
    error, spread = _off(now, there, age_s, mean_walk)
    before, wide = _off(made, there, age_s, 0.01)
    slow = stands > 0.5
    for some in (slow, ~slow):
        square = np.einsum("nv,nvw,nw->n", error[some], np.linalg.inv(spread[some]), error[some])
        assert square.mean() == pytest.approx(2.0, rel=0.1)
    assert np.sqrt(np.mean(error[slow] ** 2)) < 0.7 * np.sqrt(np.mean(before[slow] ** 2))
    assert np.sqrt(np.linalg.det(spread[slow])).mean() < 0.1 * np.sqrt(np.linalg.det(wide[slow])).mean()


def _off(states, there, age_s, walk):
    ahead, spread = moved(states.state, states.covariance, age_s, walk)
    # The reported position does not matter here.
    return ahead[:, :2] - there[:, :2], spread[:, :2, :2] - states.covariance[:, :2, :2] + 1e-6 * np.eye(2)


def test_missing_velocities_and_always_moving_kinds_are_unchanged():
    bare = States.of(np.zeros(2), np.zeros((2, 2)), np.eye(2), speed_m_per_s=8.0)
    now, modes = stationary(bare, VESSELS)
    assert modes is not None
    np.testing.assert_array_equal(now.covariance, bare.covariance)
    np.testing.assert_array_equal(modes.p_slow, np.zeros((2, 3)))
    made = reported_states(np.zeros((2, 2)))
    assert stationary(made, Description("adsb", "ads-b").motion) == (made, None)
    assert stationary(made, Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=0.0)) == (made, None)
    with pytest.raises(InputError, match="give the share of stationary objects, below 1"):
        stationary(made, Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=1.0))


def test_an_anchored_vessel_is_not_extrapolated_and_a_moving_one_is():
    columns = {"time_s": [0.0, 0.0], "lat_deg": [50.8, 50.9], "lon_deg": [-1.3, -1.3],
               "speed_m_per_s": [0.05, 6.0], "course_deg": [200.0, 90.0]}  # fmt: skip
    reports = Reports.of("ais", "table", columns | {"mmsi": ["235000001", "235000002"]})
    feed = Feed.of(Description("ais", "ais"), reports, LocalPlane(50.85, -1.3))
    assert isinstance(feed.reports, States)
    ahead, spread = moved(feed.reports.state, feed.reports.covariance, 180.0, feed.walk_m2_per_s3)
    sigma = np.sqrt(spread[:, 0, 0])
    assert sigma[0] < 35.0
    assert sigma[1] > 130.0
    assert np.hypot(*(ahead[0, :2] - feed.reports.state[0, :2])) < 2.0
    assert ahead[1, 0] - feed.reports.state[1, 0] == pytest.approx(1080.0, rel=0.01)


def test_the_probability_that_two_objects_have_one_echo_is_that_of_drawn_positions():
    rng = np.random.default_rng(7)
    cell = Resolution(range_m=40.0, bearing_deg=2.5)
    radar = Description("radar", "marine radar", site=Site(east_m=300.0, north_m=-200.0), resolution=cell)
    feed = Feed.of(radar, Reports.of("radar", "table", PLOTS))
    sensor = feed.sensor_at(3.0)
    one = np.array([[1500.0, 700.0], [1520.0, 760.0], [-900.0, 100.0]]) + sensor
    other = np.array([[1490.0, 730.0], [1600.0, 900.0]]) + sensor
    spread = [np.array([[400.0, 150.0], [150.0, 300.0]]), 20.0 * np.eye(2)]
    every = list(np.ndindex(3, 2))
    i, j = np.array(every).T
    places = [(place, np.tile(p, (len(place), 1, 1))) for place, p in zip((one, other), spread, strict=True)]
    p = feed.p_unresolved(
        3.0, *((place[k], covariance[k]) for (place, covariance), k in zip(places, (i, j), strict=True))
    )
    found = p.reshape(3, 2)
    for i, j in every:
        a, b = (rng.multivariate_normal(x, p, 40_000) - sensor for x, p in zip((one[i], other[j]), spread, strict=True))
        turn = np.degrees(np.arctan2(*a.T) - np.arctan2(*b.T)) % 360.0
        apart = abs(np.hypot(*a.T) - np.hypot(*b.T)), np.minimum(turn, 360.0 - turn)
        assert found[i, j] == pytest.approx(np.mean((apart[0] < 40.0) & (apart[1] < 2.5)), abs=0.02)
    assert 0.2 < found[0, 0] < 0.98 and found[2].max() == 0.0
    # Objects beyond each other's reach are resolved.
    reach = [feed.resolution_reach_m(3.0, each) for each in places]
    beyond = np.hypot(*(one[:, None] - other).transpose(2, 0, 1)) > np.add.outer(*reach)
    assert beyond[2].all() and not beyond[:2].any()
    # Where one of them may be, however far apart.
    anywhere = np.array([[4e4, 0.0], [0.0, 4e4]]) + sensor, np.tile(1e10 * np.eye(2), (2, 1, 1))
    assert feed.p_unresolved(3.0, anywhere, places[1]).min() > 0.0
    assert feed.resolution_reach_m(3.0, anywhere).min() > 8e4
    camera = Feed.of(
        Description("camera", "camera", site=Site(east_m=0.0, north_m=0.0), resolution=cell),
        Reports.of("camera", "table", {"time_s": [0.0, 3.0], "bearing_deg": [1.0, 2.0]}),
    )
    without = replace(feed, description=replace(radar, resolution=Resolution(0.0, 0.0)))
    for each in (without, camera):
        assert not each.p_unresolved(3.0, places[0], places[0]).any()
        assert not each.resolution_reach_m(3.0, places[0]).any()


def test_a_feed_does_not_keep_itself_in_memory():
    """A watch makes one every minute of each source, and its garbage collector runs every few hours only."""
    reports = Reports.of("one", "ais", PLACES | SPEEDS | {"mmsi": ["2", "2"]})
    made = Scene.of([(Description("one", "ais"), reports)]).feeds[0]
    assert made.as_measured is made
    gone = weakref.ref(made)
    gc.disable()
    try:
        del made
        assert gone() is None
    finally:
        gc.enable()
