"""Scans: exposures and rotating antennas are distinguished, and every object occurs once per instant."""

import numpy as np
import pytest

from sameas.simulate.sensors import Sensor, TrueMotion
from sameas.tracks.reports import Reports
from sameas.tracks.scans import AntennaRotation, last_exposure, last_rotation, rotation_period_s, scans_of
from sameas.tracks.scene import Scene
from sameas.tracks.snapshot import Snapshot
from sameas.tracks.source import Clutter, Description, MissRate, Resolution, SensorCoverage, SensorErrors, Site, Timing

TURN_S = 2.9


def fleet(n=40, seconds=240.0):
    """Vessels around a radar at 50.8 N 1.3 W, on straight courses."""
    rng = np.random.default_rng(1)
    lat, lon = 50.8 + rng.uniform(-0.08, 0.08, n), -1.3 + rng.uniform(-0.12, 0.12, n)
    step = rng.normal(0.0, 3e-3, (n, 2))
    columns = {
        "time_s": np.tile([0.0, seconds], n),
        "lat_deg": np.column_stack([lat, lat + step[:, 0]]).ravel(),
        "lon_deg": np.column_stack([lon, lon + step[:, 1]]).ravel(),
        "mmsi": np.repeat([f"2350000{k:02d}" for k in range(n)], 2),
    }
    return TrueMotion.of(Reports.of("ais", "table", columns), gap_s=1e9)


def radar(period_s, q=1e-9, **other):
    """A radar that misses a share q of the objects and rotates once per period."""
    return Description(
        "radar", "marine radar", site=Site(50.8, -1.3), misses=MissRate(q), clutter=Clutter(0.0),
        coverage=SensorCoverage(range_m=5e4), resolution=Resolution(0.0, 0.0), timing=Timing(period_s, 0.0, 0.0),
        errors=SensorErrors(position_m=20.0), **other,
    )  # fmt: skip


def plots_at_instants(told_period_s, stamp=lambda t: t):
    """For each instant the numbers of current plots and of objects, for a described rotation period."""
    motion = fleet()
    output = Sensor(radar(TURN_S))(motion, (0.0, 230.0), np.random.default_rng(2))
    columns = {name: getattr(output.reports, name) for name in ("range_m", "bearing_deg")}
    reports = Reports.of("radar", "table", columns | {"time_s": stamp(output.reports.time_s)})
    scene = Scene.of([(radar(told_period_s), reports)], motion.plane)
    rows = [Snapshot.of(scene.feeds[0], t).rows for t in np.arange(20.0, 220.0, 1.7)]
    return np.array([len(row) for row in rows]), np.array([len(np.unique(output.truth[row])) for row in rows])


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("told_period_s", [TURN_S, 1.01 * TURN_S, 0.99 * TURN_S, 3.5, 2.4, 1.2, 8.0])
def test_every_object_occurs_once_however_wrong_the_described_period(told_period_s):
    plots, objects = plots_at_instants(told_period_s)
    # The antenna may pass a moving object slightly before or after one period.
    assert objects.mean() > 39.8
    assert plots.mean() < 40.2
    assert plots.min() >= 38
    assert plots.max() <= 42


def test_time_stamps_in_whole_seconds_are_no_exposures():
    plots, objects = plots_at_instants(TURN_S, np.round)
    # The period is 2.9 s: at worst a third of the objects occurs twice or not at all.
    assert objects.mean() > 34.0
    assert plots.mean() < 44.0


def test_the_period_is_measured_from_the_bearings():
    rng = np.random.default_rng(3)
    bearing = rng.uniform(0.0, 360.0, 25)
    turns = np.arange(60)[:, None]
    time_s = ((turns + bearing / 360.0) * TURN_S).ravel()
    seen = np.broadcast_to(bearing, (60, 25)).ravel() + rng.normal(0.0, 1.0, 1500)
    assert rotation_period_s(time_s, seen, 3.3) == pytest.approx(TURN_S, rel=1e-4)
    keep = rng.random(1500) < 0.3
    assert rotation_period_s(time_s[keep], seen[keep], 2.5) == pytest.approx(TURN_S, rel=3e-4)
    # Bearings unrelated to the time stamps, and too few bearings.
    assert rotation_period_s(time_s, rng.uniform(0.0, 360.0, 1500), 3.0) is None
    assert rotation_period_s(time_s[:6], seen[:6], 3.0) is None


def test_simultaneous_plots_are_exposures():
    rng = np.random.default_rng(4)
    frames = np.repeat(0.5 * np.arange(100), 6)
    sector = rng.uniform(20.0, 60.0, 600)
    assert scans_of(frames, 0.5, sector).rotation is None
    assert scans_of(frames, 3.0, sector).rotation is None
    np.testing.assert_array_equal(scans_of(frames, 3.0, sector).scan_s, frames)
    # Time stamps that differ slightly within an exposure.
    jittered = frames + rng.uniform(0.0, 0.05, 600)
    looks = scans_of(jittered, 0.5, sector)
    assert looks.rotation is None
    assert len(np.unique(looks.scan_s)) == 100
    assert np.abs(looks.scan_s - frames).max() < 0.05


def test_exposures_of_a_circling_object_are_no_rotation():
    # Bearings that drift by 360° in total fold at a period slightly different from that of the exposures.
    frames = 0.5 * np.arange(400) + 0.02 * np.sin(np.arange(400.0) ** 2)
    drift = 360.0 * frames / 200.0 + np.random.default_rng(6).normal(0.0, 5.0, 400)
    assert rotation_period_s(frames, drift, 0.5) is not None
    assert scans_of(frames, 0.5, drift).rotation is None
    # Irregular exposures, with all scan times known.
    frames = np.sort(np.random.default_rng(7).uniform(0.0, 200.0, 400))
    assert scans_of(frames, 0.5, drift, np.append(frames, 7.77)).rotation is None


def test_one_object_under_a_rotating_antenna_is_one():
    time_s = TURN_S * np.arange(40) + 0.001 * np.sin(np.arange(40))
    looks = scans_of(time_s, 1.01 * TURN_S, np.full(40, 77.0))
    assert looks.rotation is None
    assert len(np.unique(looks.scan_s)) == 40
    assert list(last_exposure(looks.scan_s, np.unique(looks.scan_s), 2.5 * TURN_S)) == [2]


def test_shared_time_stamps_are_scans_without_a_period():
    np.testing.assert_allclose(scans_of(np.array([5.0, 0.0, 0.0, 5.0]), 99.0).scan_s, [5.0, 0.0, 0.0, 5.0])
    turning = np.array([0.0, 0.5, 2.5, 3.0, 3.6, 5.9, 6.0])
    np.testing.assert_allclose(scans_of(turning, None).scan_s, turning)
    # A few equal time stamps do not make exposures of individually timed plots.
    many = np.random.default_rng(5).uniform(0.0, 60.0, 300)
    looks = scans_of(np.append(many, many[:5]), 3.0)
    assert looks.rotation is not None
    assert looks.rotation.period_s == 3.0
    assert np.ptp(np.append(many, many[:5])[looks.scan_s == looks.scan_s[0]]) < 3.0


def test_an_empty_scan_replaces_the_previous_one():
    scan_s = np.array([1.0, 1.0, 2.0])
    assert list(last_exposure(scan_s, np.array([1.0, 2.0]), 1.9)) == [0, 1]
    assert list(last_exposure(scan_s, np.array([1.0, 2.0, 3.0]), 3.5)) == []
    assert list(last_exposure(scan_s, np.array([1.0, 2.0]), 0.5)) == []


def test_the_last_rotation_is_kept_until_more_is_received():
    time_s, rotation, looked = np.arange(0.0, 9.0, 0.5), AntennaRotation(3.0, 0.5), np.array([0.0, 3.0, 6.0])
    assert list(time_s[last_rotation(time_s, rotation, looked, 7.2)]) == [4.5, 5.0, 5.5, 6.0, 6.5, 7.0]
    # Plots are late, or have ended.
    assert list(time_s[last_rotation(time_s, rotation, looked, 60.0)]) == [6.5, 7.0, 7.5, 8.0, 8.5]
    assert list(last_rotation(time_s, rotation, looked, -1.0)) == []
    # The radar is known to have continued without detections.
    assert list(last_rotation(time_s, rotation, np.append(looked, 60.0), 60.0)) == []
