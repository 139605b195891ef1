"""Scenes: many moving objects, observed by different sensors, are identified."""

from typing import Any

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.many.identify import identify_many
from sameas.many.observations import LinearPart, Observations, records_of
from sameas.records import Records
from sameas.tracks.reports import Reports
from sameas.tracks.scene import POSITION_AND_VELOCITY, Feed, Scene
from sameas.tracks.source import Clutter, Description, MissRate, Motion, SensorCoverage, SensorErrors, Site, Timing

WALK = Motion(0.01, 8.0)
RADAR = Description(
    "radar", "marine radar", site=Site(east_m=0.0, north_m=0.0), misses=MissRate(0.1), clutter=Clutter(0.0),
    motion=WALK, errors=SensorErrors(20.0, 0.0, 0.3, extent_m=0.0), timing=Timing(3.0, 0.0, 0.0),
)  # fmt: skip
AIS = Description(
    "ais", "ais", misses=MissRate(0.2), motion=WALK, errors=SensorErrors(position_m=15.0, extent_m=0.0),
    timing=Timing(30.0, 0.0, 0.0),
)  # fmt: skip


def traffic(seed=1, ships=40, until_s=240.0):
    """Ships on straight courses: radar plots every 3 s without ids, AIS at irregular times, up to 90 s old."""
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(-6e3, 6e3, (ships, 2)), 5.0 * rng.standard_normal((ships, 2))
    radar, ais = {"time_s": [], "range_m": [], "bearing_deg": []}, {"time_s": [], "x_m": [], "y_m": [], "mmsi": []}
    ais |= {"vx_m_per_s": [], "vy_m_per_s": []}
    for t in np.arange(0.0, until_s, 3.0):
        x = (start + t * velocity)[rng.random(ships) > 0.1]
        radar["time_s"] += [t] * len(x)
        radar["range_m"] += list(np.hypot(*x.T) + 20.0 * rng.standard_normal(len(x)))
        radar["bearing_deg"] += list(np.degrees(np.arctan2(x[:, 0], x[:, 1])) + 0.3 * rng.standard_normal(len(x)))
    for k in np.flatnonzero(rng.random(ships) > 0.2):
        for t in np.cumsum(rng.uniform(10.0, 90.0, 8)):
            x = start[k] + t * velocity[k] + 15.0 * rng.standard_normal(2)
            v = velocity[k] + 0.3 * rng.standard_normal(2)
            for name, value in zip(ais, (t, *x, f"{k:09d}", *v), strict=True):
                ais[name].append(value)
    shuffled = rng.permutation(len(ais["time_s"]))
    ais = {name: np.asarray(column, object if name == "mmsi" else float)[shuffled] for name, column in ais.items()}
    reports = Reports.of("radar", "table", radar), Reports.of("ais", "ais", ais)
    return Scene.of([(RADAR, reports[0]), (AIS, reports[1])]), start, velocity


@pytest.mark.parametrize("features", [2, POSITION_AND_VELOCITY])
def test_ships_are_matched_in_both_sources_at_any_instant(features):
    scene, start, velocity = traffic()
    good = claimed = possible = 0
    for instant_s in (130.0, 161.5):
        now = scene.at(instant_s, features=features)
        found = identify_many(now.sources, rule=now.rule(), region=now.region)
        truth = start + instant_s * velocity
        owners = []
        for feed, source in zip(now.feeds, now.sources, strict=True):
            own = feed.reports
            then = own.state[records_of(source).ids]
            at = then[:, None, :2] + (instant_s - own.time_s[records_of(source).ids])[:, None, None] * velocity - truth
            owners.append(np.linalg.norm(at, axis=2).argmin(axis=1))
        both = ~np.ma.getmaskarray(found.members).any(axis=1)
        members = found.members[both]
        good += (owners[0][members[:, 0]] == owners[1][members[:, 1]]).sum()
        claimed, possible = claimed + both.sum(), possible + len(np.intersect1d(*owners))
    assert good / claimed > 0.95 and good / possible > 0.95


def test_errors_of_predicted_records_are_consistent():
    scene, start, velocity = traffic(seed=2, ships=150)
    now = scene.at(200.0)
    for feed, records in zip(now.feeds, now.sources, strict=True):
        near = np.linalg.norm(records.features[:, None] - (start + 200.0 * velocity), axis=2)
        error = records.features - (start + 200.0 * velocity)[near.argmin(axis=1)]
        square = np.einsum("nv,nvw,nw->n", error, np.linalg.inv(records.full_covariance()), error)
        # These ships keep straight courses, so the errors are slightly smaller than the motion model allows.
        assert 0.6 < np.median(square) / 1.386 < 1.3, feed.description.name


def test_the_order_of_reports_changes_nothing():
    one, _, _ = traffic(seed=3)
    now = one.at(120.0)
    ais = next(f for f in one.feeds if f.description.name == "ais")
    assert np.any(np.diff(ais.reports.time_s) < 0)
    assert len(now.sources[1]) == len(np.unique(ais.reports.track[ais.reports.time_s <= 120.0]))


def test_a_stale_report_expires_and_is_reported():
    columns: dict[str, Any] = {"time_s": [0.0, 5000.0], "x_m": [0.0, 900.0], "y_m": [0.0, 0.0], "mmsi": ["1", "2"]}
    scene = Scene.of([(AIS, Reports.of("ais", "ais", columns))])
    assert len(records_of(scene.at(10.0).sources[0])) == 1
    late = scene.at(5001.0)
    assert [int(k) for k in records_of(late.sources[0]).ids] == [1] and [int(k) for k in late.aged[0]] == [0]


def test_bare_plots_in_four_features_measure_the_earlier_position():
    scene, _, _ = traffic(seed=4)
    now = scene.at(100.0, features=POSITION_AND_VELOCITY)
    radar, ais = now.sources
    assert isinstance(radar, Observations) and isinstance(radar.part, LinearPart)
    np.testing.assert_allclose(np.asarray(radar.part.matrix)[:, 2:], -1.0 * np.eye(2))
    assert isinstance(ais, Records) and ais.d == 4


def test_velocities_distinguish_objects_at_one_position():
    names = {"mmsi": ["1", "2"]}
    one: dict[str, Any] = {
        "time_s": [0.0, 0.0],
        "x_m": [0.0, 10.0],
        "y_m": [0.0, 0.0],
        "vx_m_per_s": [6.0, -6.0],
        "vy_m_per_s": [0.0] * 2,
    }
    other = one | {"x_m": [8.0, 2.0]}
    feeds = [(AIS, Reports.of("ais", "ais", one | names))]
    twin = Description(
        "radar", "tracks", errors=SensorErrors(position_m=15.0, speed_m_per_s=0.5, course_deg=3.0), motion=WALK
    )
    scene = Scene.of([*feeds, (twin, Reports.of("radar", "table", other))])
    blind, seeing = (scene.at(0.0, features=f) for f in (2, POSITION_AND_VELOCITY))
    pairs = [identify_many(now.sources, rule=now.rule(), region=now.region) for now in (blind, seeing)]
    assert pairs[1].members.tolist() in ([[0, 0], [1, 1]], [[1, 1], [0, 0]])
    assert pairs[1].probability.min() > 0.95 > pairs[0].probability.max()


def test_a_camera_bearing_is_matched_to_its_boat():
    camera = Description(
        "camera", "camera", site=Site(east_m=0.0, north_m=0.0), clutter=Clutter(per_deg=0.005), misses=MissRate(0.2),
        coverage=SensorCoverage(range_m=2000.0), errors=SensorErrors(bearing_deg=0.5, extent_m=3.0), motion=WALK,
    )  # fmt: skip
    columns = {"time_s": [9.9, 9.9], "bearing_deg": [359.0, 45.3]}
    boats = {"time_s": [10.0, 10.0], "range_m": [900.0, 1000.0], "bearing_deg": [45.0, 358.7]}
    scene = Scene.of([(RADAR, Reports.of("radar", "table", boats)), (camera, Reports.of("camera", "table", columns))])
    for features in (2, POSITION_AND_VELOCITY):
        now = scene.at(10.0, features=features)
        found = identify_many(now.sources, rule=now.rule(), region=now.region)
        assert sorted(found.members.tolist()) == [[0, 1], [1, 0]]
        assert found.probability.min() > 0.9
    # 3 m of hull are 0.17° at 1000 m, not more.
    assert records_of(now.sources[1]).covariance.max() < 0.5**2 + 0.3**2


def test_objects_outside_the_coverage_do_not_count_as_missed():
    near = Description(
        "near",
        "lidar",
        site=Site(east_m=0.0, north_m=0.0),
        coverage=SensorCoverage(range_m=100.0),
        misses=MissRate(0.2),
    )
    boats = {"time_s": [0.0] * 4, "range_m": [50.0, 800.0, 900.0, 1500.0], "bearing_deg": [0.0, 90.0, 180.0, 270.0]}
    lidar = {"time_s": [0.0], "range_m": [50.0], "bearing_deg": [0.5]}
    now = Scene.of([(RADAR, Reports.of("radar", "table", boats)), (near, Reports.of("near", "table", lidar))]).at(0.0)
    assert now.rule().q == pytest.approx((0.1, 0.2 * 2 / 5 + 3 / 5))


def test_silent_sources_are_excluded_and_empty_scans_count():
    plots = {"time_s": [0.0, 0.0], "range_m": [50.0, 80.0], "bearing_deg": [0.0, 90.0]}
    reports = Reports.of("radar", "table", plots)
    feeds = (
        Feed.of(RADAR, reports, scan_times_s=[0.0, 3.0]),
        Feed.of(AIS, Reports.of("ais", "ais", {"time_s": [0.0], "x_m": [0.0], "y_m": [50.0]})),
    )
    scene = Scene(feeds)
    assert len(scene.at(2.9).with_records().sources) == 2
    assert [records_of(s).source for s in scene.at(3.1).with_records().sources] == ["ais"]


def test_identities_are_used_at_an_instant_and_alarms_raised():
    one: dict[str, Any] = {
        "time_s": [0.0, 0.0, 1.0],
        "x_m": [0.0, 5e3, 5e3],
        "y_m": [0.0] * 3,
        "mmsi": ["235000001", "235000002", None],
    }
    two: dict[str, Any] = {"time_s": [0.0], "x_m": [9e3], "y_m": [0.0], "mmsi": ["235000001"], "track_id": ["x"]}
    twin = Description("coast", "tracks", errors=SensorErrors(position_m=15.0), motion=WALK)
    now = Scene.of([(AIS, Reports.of("ais", "ais", one)), (twin, Reports.of("coast", "table", two))]).at(2.0)
    assert np.asarray(now.identity().attributes["ais"]["mmsi"]).tolist() == ["235000001", "235000002", None]
    assert [(alarm.value, alarm.first, alarm.second) for alarm in now.alarms()] == [
        ("235000001", ("ais", 0), ("coast", 0))
    ]


def test_every_assumed_number_is_listed_with_the_instant():
    scene, _, _ = traffic(seed=5)
    assumed = [str(line) for line in scene.at(100.0).assumed]
    assert any(line.startswith("radar: bias.azimuth_deg = 1, assumed") for line in assumed)
    assert not any("misses.q" in line for line in assumed)


def test_invalid_scenes_are_refused():
    reports = Reports.of("ais", "ais", {"time_s": [0.0], "x_m": [0.0], "y_m": [0.0]})
    with pytest.raises(InputError, match="two sources are called ais"):
        Scene.of([(AIS, reports), (AIS, reports)])
    with pytest.raises(InputError, match=r"give 2 .* or 4"):
        Scene.of([(AIS, reports)]).at(0.0, features=3)
    with pytest.raises(InputError, match="no source of the scene has a report"):
        Scene(()).span_s  # noqa: B018
    bare = Description("bare", errors=SensorErrors(position_m=1.0), motion=Motion(speed_m_per_s=1.0))
    with pytest.raises(InputError, match=r"bare: motion\.acceleration_m2_per_s3 is not known"):
        Scene.of([(bare, reports)]).at(0.0)
