"""Simulated sensors follow their descriptions and biases; true motion interpolates reports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.simulate.sensors import LEVEL_M, Bias, Sensor, SensorOutput, Tracker, TrueMotion
from sameas.tracks.alignment import States
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import (
    Clutter,
    Description,
    MissRate,
    Motion,
    Resolution,
    SensorCoverage,
    SensorErrors,
    Site,
    Targets,
    Timing,
)

LAT, LON = 50.75, -1.20
RADAR = Description(
    "radar", "marine radar", site=Site(LAT, LON, 20.0), coverage=SensorCoverage(range_m=15e3), misses=MissRate(0.2),
    clutter=Clutter(0.0), resolution=Resolution(0.0, 0.0), errors=SensorErrors(position_m=25.0, extent_m=0.0),
    timing=Timing(period_s=3.0, latency_s=2.0, latency_sigma_s=0.0),
)  # fmt: skip


def vessels(count: int = 20, seed: int = 1, height_m: float | None = None) -> TrueMotion:
    """Straight courses at constant speed around the site, 600 s long."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 601.0, 20.0)
    lat, lon = LAT + rng.uniform(-0.05, 0.05, count), LON + rng.uniform(-0.08, 0.08, count)
    drift = rng.uniform(-1e-4, 1e-4, (2, count))
    columns = {
        "time_s": np.tile(times, count), "track_id": np.repeat([f"{k:02d}" for k in range(count)], len(times)),
        "lat_deg": np.repeat(lat, len(times)) + np.outer(drift[0], times).ravel(),
        "lon_deg": np.repeat(lon, len(times)) + np.outer(drift[1], times).ravel(),
    }  # fmt: skip
    if height_m is not None:
        columns["pressure_alt_m"] = np.full(count * len(times), height_m)
    return TrueMotion.of(Reports.of("log", "table", columns))


def simulated(sensor: Sensor, motion: TrueMotion | None = None, seed: int = 7) -> SensorOutput:
    return sensor(motion or vessels(), (0.0, 600.0), np.random.default_rng(seed))


def errors_of(sensor: Sensor, got: SensorOutput, motion: TrueMotion) -> np.ndarray:
    """(n, 2) errors of the placed reports, along and across the line of sight."""
    [feed] = Scene.of([(sensor.description, replace(got.reports, track_id=None))], motion.plane).feeds
    true = got.truth >= 0
    k, time_s = got.truth[true], feed.reports.time_s[true]
    place = np.array([motion.paths[j].at(np.array([t]))[0, :2] for j, t in zip(k, time_s, strict=True)])
    out = place - feed.sensor_m[0]
    out /= np.linalg.norm(out, axis=1)[:, None]
    assert isinstance(feed.reports, States)
    off = feed.reports.state[true, :2] - place
    return np.column_stack([np.sum(off * out, axis=1), off[:, 0] * out[:, 1] - off[:, 1] * out[:, 0]])


def test_true_motion_interpolates_its_reports_and_does_not_extrapolate() -> None:
    columns = {"time_s": [0.0, 60.0, 120.0, 900.0], "lat_deg": [50.0, 50.01, 50.0, 50.0], "lon_deg": [0.0] * 4}
    motion = TrueMotion.of(Reports.of("ais", "table", columns | {"mmsi": ["7"] * 4}), gap_s=300.0)
    north = motion.plane.of_geodetic([50.0, 50.01], [0.0, 0.0])[:, 1]
    assert motion.at(60.0)[0, 1] == pytest.approx(north[1]) and motion.at(0.0)[0, 1] == pytest.approx(north[0])
    assert north[0] < motion.at(30.0)[0, 1] < north[1]
    assert np.isnan([motion.at(t)[0, 0] for t in (-1.0, 500.0, 901.0)]).all()
    assert motion.span_s == (0.0, 900.0)


def test_a_smoothed_path_is_closer_to_the_motion_than_its_reports() -> None:
    rng = np.random.default_rng(2)
    times = np.arange(0.0, 900.0, 10.0)
    lat = 50.0 + 4e-5 * times
    noisy = {"time_s": times, "lat_deg": lat + rng.normal(size=90) * 15 / 111e3, "lon_deg": np.zeros(90)}
    reports = Reports.of("ais", "table", noisy | {"mmsi": ["7"] * 90})
    ais = Description("ais", "ais", errors=SensorErrors(position_m=15.0), motion=Motion(0.001, 8.0))
    smooth, rough = TrueMotion.of(reports, ais), TrueMotion.of(reports)
    true = smooth.plane.of_geodetic(lat, np.zeros(90))[:, 1]
    scatter = [np.std([motion.at(t)[0, 1] - y for t, y in zip(times, true, strict=True)]) for motion in (smooth, rough)]
    assert scatter[0] < 0.5 * scatter[1]


def test_objects_of_reports_are_numbered_by_their_ids() -> None:
    columns = {"time_s": [0.0, 0.0, 9.0, 9.0], "lat_deg": [50.0] * 4, "lon_deg": [0.0] * 4}
    reports = Reports.of("ais", "table", columns | {"mmsi": ["9", "8", None, "8"]})
    motion = TrueMotion.of(reports)
    assert motion.names == ("8", "9") and motion.objects_of(reports).tolist() == [1, 0, -1, 0]
    assert motion.only([1]).names == ("9",)


@pytest.mark.slow
def test_errors_are_those_of_the_description() -> None:
    motion, sensor = vessels(), Sensor(RADAR)
    got = simulated(sensor, motion)
    off = errors_of(sensor, got, motion)
    assert np.all(np.abs(off.mean(axis=0)) < 4 * 25.0 / np.sqrt(len(off)))
    assert np.all(np.abs(off.std(axis=0) / 25.0 - 1.0) < 0.1)
    assert got.reports.sigma_range_m is not None and np.all(got.reports.sigma_range_m == 25.0)


def test_range_and_bearing_errors_grow_as_those_of_a_polar_sensor() -> None:
    motion = vessels()
    sensor = Sensor(replace(RADAR, errors=SensorErrors(range_m=10.0, range_share=0.0, bearing_deg=0.5, extent_m=0.0)))
    got = simulated(sensor, motion)
    off = errors_of(sensor, got, motion)
    assert got.reports.sigma_range_m is None and abs(off[:, 0].std() / 10.0 - 1.0) < 0.15
    across = np.degrees(off[:, 1] / np.asarray(got.reports.range_m))
    assert abs(across.std() / 0.5 - 1.0) < 0.1


def test_biases_are_added_to_measurements() -> None:
    motion, sensor = vessels(), Sensor(RADAR, Bias(range_m=80.0, azimuth_deg=1.5, time_s=0.0))
    got = simulated(sensor, motion)
    off = errors_of(sensor, got, motion)
    assert abs(off[:, 0].mean() - 80.0) < 6.0
    turned = np.degrees(off[:, 1] / (np.asarray(got.reports.range_m)))
    assert abs(turned.mean() - 1.5) < 0.1


def test_stamps_are_late_by_the_latency_and_the_bias() -> None:
    early, late = (simulated(Sensor(RADAR, Bias(time_s=t))) for t in (0.0, 1.5))
    np.testing.assert_allclose(late.reports.time_s - early.reports.time_s, 1.5)
    np.testing.assert_allclose(early.scan_times_s, np.arange(0.0, 600.0, 3.0) + 2.0)


def test_misses_and_clutter_are_as_frequent_as_described() -> None:
    motion = vessels()
    got = simulated(Sensor(replace(RADAR, clutter=Clutter(0.05))), motion)
    looks, due = 200, 200 * len(motion)
    seen, false = np.sum(got.truth >= 0), np.sum(got.truth < 0)
    assert abs(seen - 0.8 * due) < 5 * np.sqrt(0.16 * due)
    expected = 0.05 * np.pi * 15.0**2 * looks
    assert abs(false - expected) < 5 * np.sqrt(expected)


def test_nothing_is_seen_beyond_the_coverage() -> None:
    near = replace(RADAR, coverage=SensorCoverage(range_m=5e3, sector_deg=(0.0, 120.0)), clutter=Clutter(0.2))
    exact = replace(near, errors=SensorErrors(position_m=0.01, extent_m=0.0))
    got = simulated(Sensor(exact))
    assert len(got.reports) and np.all(np.asarray(got.reports.range_m) < 5000.1)
    assert np.all((np.asarray(got.reports.bearing_deg) + 1.0) % 360.0 < 122.0)
    assert {-1} < set(got.truth.tolist()) < set(range(-1, 20))


def test_an_antenna_rotates_from_north_once_per_period() -> None:
    exact = replace(RADAR, errors=SensorErrors(position_m=0.01, extent_m=0.0))
    got = simulated(Sensor(exact))
    phase = (got.reports.time_s - 2.0) % 3.0 / 3.0 * 360.0
    off = (phase - np.asarray(got.reports.bearing_deg) + 180.0) % 360.0 - 180.0
    # Near objects move noticeably during one rotation.
    assert np.abs(off).max() < 2.0


def test_two_unresolved_objects_give_one_plot() -> None:
    columns = {"time_s": [0.0, 600.0] * 2, "lat_deg": [LAT + 0.05] * 4, "lon_deg": [LON, LON, LON + 1e-4, LON + 1e-4]}
    pair = TrueMotion.of(Reports.of("ais", "table", columns | {"mmsi": ["1", "1", "2", "2"]}), gap_s=1e4)
    wide = replace(RADAR, misses=MissRate(1e-9), resolution=Resolution(range_m=30.0, bearing_deg=1.0))
    assert set(simulated(Sensor(wide), pair).truth.tolist()) == {0}
    fine = replace(wide, resolution=Resolution(range_m=30.0, bearing_deg=0.01))
    assert np.bincount(simulated(Sensor(fine), pair).truth).tolist() == [200, 200]


def test_a_camera_gives_bearings_and_a_source_without_a_site_positions() -> None:
    motion = vessels()
    camera = Description(
        "eye", "camera", site=RADAR.site, coverage=SensorCoverage(range_m=20e3), timing=Timing(period_s=5.0)
    )
    assert simulated(Sensor(camera), motion).reports.position == "bearing"
    other = Description("mlat", "other", misses=MissRate(0.1), errors=SensorErrors(position_m=10.0), timing=Timing(5.0))
    got = simulated(Sensor(other, Bias(east_m=300.0)), motion)
    place = motion.plane.of_geodetic(got.reports.lat_deg, got.reports.lon_deg)
    true = np.array(
        [motion.paths[k].at(np.array([t]))[0, :2] for k, t in zip(got.truth, got.reports.time_s, strict=True)]
    )
    np.testing.assert_allclose((place - true).mean(axis=0), [300.0, 0.0], atol=2.0)


@pytest.mark.slow
def test_aircraft_report_their_level_and_are_placed_by_slant_range() -> None:
    motion = vessels(height_m=9000.0)
    radar = replace(
        RADAR, errors=SensorErrors(position_m=5.0, extent_m=0.0, height_m=0.0), targets=Targets(5000.0, 3500.0)
    )
    sensor = Sensor(radar)
    got = simulated(sensor, motion)
    np.testing.assert_allclose(np.asarray(got.reports.pressure_alt_m) % LEVEL_M / LEVEL_M % 1.0, 0.0, atol=1e-6)
    # A flight level is rounded to 15 m; at 9 km height and 6 km distance that is 23 m on the ground.
    assert np.median(np.abs(errors_of(sensor, got, motion)[:, 0])) < 40.0


def test_tracks_are_of_one_object_each_and_break_when_it_is_missed() -> None:
    got = simulated(Sensor(replace(RADAR, misses=MissRate(0.5)), tracker=Tracker(begins_after=0, breaks_after=2)))
    names = np.asarray(got.reports.track_id).astype(str)
    owners = {name: set(got.truth[names == name].tolist()) for name in set(names)}
    assert all(len(owner) == 1 for owner in owners.values()) and len(owners) > 40
    gaps = [np.diff(np.sort(got.reports.time_s[names == name])).max(initial=0.0) for name in owners]
    assert max(gaps) < 2 * 3.0 + 3.0 + 0.1


def test_a_track_begins_late_and_has_a_velocity() -> None:
    motion = vessels()
    got = simulated(Sensor(replace(RADAR, misses=MissRate(1e-9)), tracker=Tracker(begins_after=3)), motion)
    assert got.reports.time_s.min() >= 3 * 3.0 and len(set(np.asarray(got.reports.track_id))) == len(motion)
    late = np.flatnonzero((got.reports.time_s > 300.0) & (got.reports.time_s < 590.0))
    velocity = got.reports.velocity_m_per_s()
    assert velocity is not None
    way = [np.diff(motion.paths[got.truth[k]].at(got.reports.time_s[k] + [0.0, 1.0]), axis=0)[0, :2] for k in late]
    assert np.median(np.linalg.norm(velocity[late] - way, axis=1)) < 1.0


def test_false_tracks_have_the_described_duration_and_density() -> None:
    described = replace(RADAR, clutter=Clutter(0.05))
    got = simulated(Sensor(described, tracker=Tracker(begins_after=0, false_looks=5.0)))
    false = got.truth < 0
    _, looks = np.unique(np.asarray(got.reports.track_id)[false].astype(str), return_counts=True)
    assert 4.0 < looks.mean() < 6.0
    expected = 0.05 * np.pi * 15.0**2 * 200
    assert abs(false.sum() - expected) < 5 * np.sqrt(5.0 * expected)


def test_the_same_generator_gives_the_same() -> None:
    one, two = (
        simulated(Sensor(replace(RADAR, clutter=Clutter(0.05)), tracker=Tracker(breaks=0.01))) for _ in range(2)
    )
    # The last digit depends on memory alignment in older NumPy.
    np.testing.assert_allclose(one.reports.range_m, two.reports.range_m, rtol=1e-13)
    np.testing.assert_array_equal(one.truth, two.truth)


def test_without_objects_a_source_is_empty() -> None:
    got = simulated(Sensor(replace(RADAR, coverage=SensorCoverage(range_m=1.0))))
    assert len(got.reports) == 0 and len(got.truth) == 0


def test_refusals_say_what_is_missing() -> None:
    with pytest.raises(InputError, match=r"other: timing.period_s is not known"):
        simulated(Sensor(Description("other", "other", site=RADAR.site)))
    with pytest.raises(InputError, match="reports do not name their objects"):
        TrueMotion.of(Reports.of("ais", "table", {"time_s": [0.0], "lat_deg": [50.0], "lon_deg": [0.0]}))
    with pytest.raises(InputError, match="true motion needs latitudes"):
        TrueMotion.of(Reports.of("ais", "table", {"time_s": [0.0], "x_m": [50.0], "y_m": [0.0]}))
    with pytest.raises(InputError, match="breaks_after ≥ 1"):
        Tracker(breaks_after=0)
    with pytest.raises(InputError, match=r"smoothing its paths needs errors\.position_m"):
        TrueMotion.of(
            Reports.of("ais", "table", {"time_s": [0.0], "lat_deg": [50.0], "lon_deg": [0.0], "mmsi": ["1"]}),
            Description("other", "other"),
        )
