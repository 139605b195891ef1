"""Biases: apply and undo, derivatives, and errors of corrected reports."""

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.records import Records
from sameas.tracks import Description, Feed, KnownBiases, Motion, Reports, Scene, SensorErrors, Site, Timing
from sameas.tracks.alignment import States
from sameas.tracks.biases import AZIMUTH, BIASES, AzimuthDrift, BiasModel, RelativeBias, corrected
from sameas.tracks.coordinates import plane_polar
from sameas.tracks.placement import Directions
from sameas.tracks.registration import SourceBiases

RNG = np.random.default_rng(1)
POSITION, VELOCITY = RNG.uniform(-9e3, 9e3, (7, 2)), 6.0 * RNG.standard_normal((7, 2))
THETA = np.array([60.0, -1.5, 0.004, 2.5, 30.0, -20.0])
MODELS = {
    "site": BiasModel((500.0, -2000.0)),
    "nowhere": BiasModel(),
    "moving": BiasModel(RNG.uniform(-1e4, 0, (7, 2))),
}


def without_site(name):
    return np.where(np.arange(6) < 3, 0.0, THETA) if name == "nowhere" else THETA


@pytest.mark.parametrize("name", MODELS)
def test_undoing_a_bias_is_the_inverse(name):
    model, theta = MODELS[name], without_site(name)
    shown = model.forward(POSITION, VELOCITY, theta)
    assert np.hypot(*(shown.position - POSITION).T).min() > 20.0
    np.testing.assert_allclose(model.inverse(shown.position, VELOCITY, theta).position, POSITION, atol=1e-8)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("way", ["forward", "inverse"])
def test_derivatives_agree_with_finite_differences(name, way):
    move, theta = getattr(MODELS[name], way), without_site(name)
    found = move(POSITION, VELOCITY, theta)
    step = 1e-3 * np.eye(2)
    numeric = [
        (move(POSITION + e, VELOCITY, theta).position - move(POSITION - e, VELOCITY, theta).position) / 2e-3
        for e in step
    ]
    np.testing.assert_allclose(found.by_position, np.stack(numeric, axis=-1), atol=1e-6)
    for k, e in enumerate(1e-4 * np.eye(6)):
        if name == "nowhere" and k < 3:
            continue
        slope = (move(POSITION, VELOCITY, theta + e).position - move(POSITION, VELOCITY, theta - e).position) / 2e-4
        np.testing.assert_allclose(found.by_theta[..., k], slope, atol=2e-3, err_msg=BIASES[k])


@pytest.mark.slow
def test_the_offset_of_two_biased_sources_aligns_their_records():
    other = np.array([-40.0, 0.8, 0.0, -1.0, 0.0, 0.0])
    first, second = MODELS["site"], BiasModel((4000.0, 3000.0))
    seen_1, seen_2 = (m.forward(POSITION, VELOCITY, t).position for m, t in ((first, THETA), (second, other)))
    model = RelativeBias(first, second, VELOCITY, (1.0,) * 12)
    theta = np.concatenate([THETA, other])
    np.testing.assert_allclose(model.moved(seen_2, theta), seen_1, atol=1e-6)
    many = model.moved(seen_2, np.stack([theta, 0.0 * theta])[:, None, :])
    np.testing.assert_allclose(many[1], seen_2, atol=1e-9)
    assert model.jacobian(seen_2, theta).shape == (7, 2, 12) and len(model.names) == 12
    # Only parameters that may differ are fitted, in the plane of the sensor of larger azimuth uncertainty.
    radar = RelativeBias(first, second, VELOCITY, (0.0,) * 6 + (50.0, 1.0, 0.0, 2.0, 0.0, 0.0))
    assert radar.names == ("second_range_m", "second_azimuth_deg", "second_time_s")
    assert radar.voted(2) == [(0, -1.0), (1, -1.0)] and len(radar.turns()) == 1
    records = Records.of(seen_2, sigma=1.0)
    assert radar.placed(records, records) is radar


def test_correcting_the_azimuth_keeps_the_range_error():
    site, bearing = np.zeros((1, 2)), 40.0
    position, covariance = plane_polar(
        range_m=10e3, bearing_deg=bearing + 2.0, sensor_m=site, sigma_range_m=5.0, sigma_bearing_deg=1.0
    )
    reports = States.of([0.0], position, covariance, speed_m_per_s=8.0, velocity=[[3.0, 4.0]],
                        velocity_covariance=np.eye(2), track=["1"])  # fmt: skip
    theta = np.array([0.0, 2.0, 0.0, 3.0, 0.0, 0.0])
    right = corrected(reports, site, theta)
    assert isinstance(right, States)
    wanted, spread = plane_polar(
        range_m=10e3, bearing_deg=bearing, sensor_m=site, sigma_range_m=5.0, sigma_bearing_deg=1.0
    )
    np.testing.assert_allclose(right.state[:, :2], wanted, atol=1e-6)
    np.testing.assert_allclose(right.covariance[:, :2, :2], spread, rtol=1e-9)
    assert right.time_s[0] == -3.0 and np.hypot(*right.state[0, 2:]) == pytest.approx(5.0)
    # The correction is uncertain: 0.1° across, 0 along; 2 m along, 0 across.
    for variance, along, across in [((0.0, 0.01), 0.0, (10e3 * np.radians(0.1)) ** 2), ((4.0, 0.0), 4.0, 0.0)]:
        less_sure = corrected(reports, site, theta, np.diag([*variance, 0.0, 0.0, 0.0, 0.0]))
        assert isinstance(less_sure, States)
        grown = less_sure.covariance[0, :2, :2] - spread[0]
        out = np.array([np.sin(np.radians(bearing)), np.cos(np.radians(bearing))])
        assert out @ grown @ out == pytest.approx(along, abs=1e-6)
        assert np.trace(grown) == pytest.approx(along + across, rel=1e-6)


def test_a_known_calibration_is_subtracted_directly():
    reports = Reports.of("radar", "table", {"time_s": [0.0], "range_m": [1030.0], "bearing_deg": [91.0]})
    errors = SensorErrors(5.0, 0.0, 0.1)
    known = KnownBiases(range_m=30.0, azimuth_deg=1.0, north_m=7.0)
    there = Site(east_m=0.0, north_m=0.0)
    feed = Feed.of(Description("radar", "marine radar", site=there, errors=errors, calibration=known), reports)
    assert isinstance(feed.reports, States)
    np.testing.assert_allclose(feed.reports.state[0, :2], [1000.0, -7.0], atol=0.3)
    with pytest.raises(InputError, match=r"radar: calibration of range or azimuth needs .* give site"):
        reports = Reports.of("radar", "table", {"time_s": [0.0], "x_m": [1030.0], "y_m": [0.0]})
        Feed.of(Description("radar", "tracks", errors=SensorErrors(position_m=5.0), calibration=known), reports)


def test_directions_are_rotated_with_the_uncertainty_of_the_bias():
    camera = Description(
        "camera", "camera", site=Site(east_m=0.0, north_m=0.0), motion=Motion(0.01, 8.0), timing=Timing(1.0),
        errors=SensorErrors(bearing_deg=0.3), calibration=KnownBiases(azimuth_deg=2.0),
    )  # fmt: skip
    scene = Scene.of([(camera, Reports.of("camera", "table", {"time_s": [0.0], "bearing_deg": [1.0]}))])
    directions = scene.feeds[0].reports
    assert isinstance(directions, Directions)
    assert directions.bearing_deg[0] == pytest.approx(359.0) and camera.bias.azimuth_deg is None
    grown = corrected(directions, scene.feeds[0].sensor_m, np.zeros(6), np.diag([0.0, 0.16, 0, 0, 0, 0]))
    assert isinstance(grown, Directions)
    assert grown.sigma_deg[0] == pytest.approx(0.5)


def test_a_drift_is_followed_between_its_knots_and_returns_to_the_mean_after_them():
    """A live radar had the mean azimuth of the last ten minutes subtracted, not the present one."""
    drift = AzimuthDrift(np.array([0.0, 30.0, 60.0]), np.array([-2.0, 0.0, 2.0]), np.full(3, 0.04), 4.0, 120.0)
    azimuth, variance = drift.at(np.array([15.0, 60.0, 180.0, 1e5]))
    assert np.allclose(azimuth, [-1.0, 2.0, 2.0 * np.exp(-1.0), 0.0])
    kept = np.exp(-2.0)
    assert np.allclose(variance, [0.04, 0.04, 0.04 * kept + 4.0 * (1.0 - kept), 4.0])


def test_biases_are_removed_with_the_drift_of_the_azimuth_at_each_report():
    """An offset set by hand ends the drift."""
    times, place = np.array([30.0, 60.0]), np.array([[0.0, 1000.0], [0.0, 1000.0]])
    errors = SensorErrors(position_m=9.0)
    radar = Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0), errors=errors)
    columns = {"time_s": times, "x_m": place[:, 0], "y_m": place[:, 1]}
    feed = Feed.of(radar, Reports.of("radar", "table", columns))
    drift = AzimuthDrift(np.array([0.0, 30.0, 60.0]), np.array([-2.0, 0.0, 2.0]), np.full(3, 0.04), 4.0, 120.0)
    theta, covariance = np.zeros(6), np.zeros((6, 6))
    theta[AZIMUTH], covariance[AZIMUTH, AZIMUTH] = 3.0, 0.01 + drift.spread_deg**2
    biases = SourceBiases("radar", ("ais",), theta=theta, covariance=covariance, drift=drift)

    def bearings(taken_off):
        state = taken_off.removed(feed).reports.state
        return np.degrees(np.arctan2(state[:, 0], state[:, 1]))

    assert np.allclose(bearings(biases), [-3.0, -5.0])
    assert np.allclose(bearings(biases.with_set("azimuth_deg", 1.0)), -1.0)
    assert np.allclose(bearings(biases.with_set("range_m", 10.0)), [-3.0, -5.0])
    reports = biases.removed(feed).reports
    assert isinstance(reports, States) and isinstance(feed.reports, States)
    added = reports.covariance[:, 0, 0] - feed.reports.covariance[:, 0, 0]
    assert np.allclose(added, np.radians(0.2) ** 2 * 1e6, rtol=0.02)
