"""Numbered plots are filtered into tracks if velocities are missing or positions scatter; smoothed tracks are kept."""

import numpy as np
import pytest

from sameas import identify_many
from sameas.many.observations import records_of
from sameas.tracks.alignment import States
from sameas.tracks.feed import Feed, need_filtering
from sameas.tracks.placement import PlacedReports
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Description, MissRate, SensorErrors, Site

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


RADAR = Description(
    "radar", "marine radar", errors=SensorErrors(position_m=40.0, extent_m=0.0), misses=MissRate(0.1)
)  # fmt: skip
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
            feeds = [Feed.of(said, given, to_tracks=to_tracks) for said, given in ((RADAR, radar), (AIS, ais))]
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
