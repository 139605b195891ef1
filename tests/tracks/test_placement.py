"""Reports in the plane: equal positions from all notations, with stated or assumed errors."""

from typing import Any

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.tracks.alignment import States
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.placement import Directions, PlacedReports, SlowBearing
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, Motion, SensorErrors, Site, Targets, Timing

pymap3d = pytest.importorskip("pymap3d")
PLANE = LocalPlane(54.0, 10.0)
SITE = Site(54.1, 10.2, 40.0)
LAT, LON = np.array([54.05, 54.2]), np.array([10.25, 9.9])


def placed(description, reports, plane=None):
    return PlacedReports(description, reports, plane).in_plane


def test_geodetic_polar_and_local_positions_of_one_object_agree():
    bearing, _, distance = pymap3d.geodetic2aer(LAT, LON, 0.0, SITE.lat_deg, SITE.lon_deg, SITE.height_m)
    own = LocalPlane(SITE.lat_deg, SITE.lon_deg).of_geodetic(LAT, LON)
    ways = [
        ("ais", {"lat_deg": LAT, "lon_deg": LON}),
        ("marine radar", {"range_m": distance, "bearing_deg": bearing}),
        ("tracks", {"x_m": own[:, 0], "y_m": own[:, 1]}),
    ]
    for kind, fields in ways:
        description = Description(kind, kind, site=SITE, errors=SensorErrors(position_m=10.0))
        there = placed(description, Reports.of(kind, "table", {"time_s": [0.0, 1.0], **fields}), PLANE)
        assert isinstance(there, States)
        np.testing.assert_allclose(there.state[:, :2], PLANE.of_geodetic(LAT, LON), atol=0.05)


def test_an_aircraft_is_below_its_slant_range():
    lat, lon, height = 54.3, 10.9, 11e3
    bearing, _, distance = pymap3d.geodetic2aer(lat, lon, height, SITE.lat_deg, SITE.lon_deg, SITE.height_m)
    radar = Description("radar", "air radar", site=SITE)
    plot = {"time_s": [0.0], "range_m": [float(distance)], "bearing_deg": [float(bearing)]}
    known = placed(radar, Reports.of("radar", "table", plot | {"alt_m": [height]}), PLANE)
    truth = PLANE.of_geodetic(lat, lon)[0]
    assert np.linalg.norm(known.state[0, :2] - truth) < 0.1
    blind = placed(radar, Reports.of("radar", "table", plot), PLANE)
    away = np.linalg.norm(blind.state[0, :2] - truth)
    stated = np.sqrt(np.trace(blind.covariance[0, :2, :2]))
    assert 500.0 < away < 3.0 * stated
    _, lean, _ = pymap3d.geodetic2aer(lat, lon, height, SITE.lat_deg, SITE.lon_deg, SITE.height_m)
    high = placed(radar, Reports.of("radar", "table", plot | {"elevation_deg": [float(lean)]}), PLANE)
    assert np.linalg.norm(high.state[0, :2] - truth) < 20.0


def test_stated_errors_are_used_and_others_come_from_the_description():
    ais = Description("ais", "ais", errors=SensorErrors(position_m=15.0, extent_m=20.0))
    fields: dict[str, Any] = {"time_s": [0.0, 0.0], "lat_deg": LAT, "lon_deg": LON}
    fields["covariance_m2"] = [[9.0, 1.0, 4.0], [np.nan] * 3]
    there = placed(ais, Reports.of("ais", "ais", fields), PLANE)
    np.testing.assert_allclose(there.covariance[0, :2, :2], [[9, 1], [1, 4]], atol=0.1)
    np.testing.assert_allclose(there.covariance[1, :2, :2], 625.0 * np.eye(2), atol=2.0)


def test_cross_range_errors_grow_with_range_and_rotate_with_the_bearing():
    radar = Description(
        "radar", "marine radar", site=Site(54.0, 10.0), errors=SensorErrors(10.0, 0.0, 0.5, extent_m=0.0)
    )
    columns = {"time_s": [0.0, 0.0], "range_m": [10e3, 10e3], "bearing_deg": [0.0, 90.0]}
    covariance = placed(radar, Reports.of("radar", "table", columns), PLANE).covariance[:, :2, :2]
    across = (10e3 * np.radians(0.5)) ** 2
    np.testing.assert_allclose(np.einsum("nvv->nv", covariance), [[across, 100], [100, across]], rtol=0.02)


def test_velocities_and_their_errors_are_rotated_to_the_plane():
    ais = Description("ais", "ais", errors=SensorErrors(speed_m_per_s=0.5, course_deg=10.0))
    columns = {"time_s": [0.0, 0.0], "lat_deg": [54.0, 54.0], "lon_deg": [10.0, 14.0], "speed_m_per_s": [10.0, 10.0],
            "course_deg": [90.0, 90.0]}  # fmt: skip
    there = placed(ais, Reports.of("ais", "ais", columns), PLANE)
    np.testing.assert_allclose(there.state[0, 2:], [10.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.diag(there.covariance[0])[2:], [0.25, np.radians(10.0) ** 2 * 100], rtol=1e-6)
    turned = np.degrees(np.arctan2(there.state[1, 3], there.state[1, 2]))
    assert turned == pytest.approx(4.0 * np.sin(np.radians(54.0)), rel=0.01)


def test_zero_speed_is_a_velocity_and_no_speed_is_none():
    ais = Description("ais", "ais", motion=Motion(0.01, 6.0))
    fields: dict[str, Any] = {"time_s": [0.0, 0.0], "lat_deg": LAT, "lon_deg": LON, "speed_m_per_s": [0.0, np.nan]}
    there = placed(ais, Reports.of("ais", "ais", fields), PLANE)
    np.testing.assert_allclose(there.covariance[:, 2, 2], [0.09, 36.0], rtol=1e-4)


def test_latency_is_subtracted_from_time_stamps():
    radar = Description("radar", "tracks", errors=SensorErrors(position_m=1.0), timing=Timing(latency_s=2.5))
    there = placed(radar, Reports.of("radar", "table", {"time_s": [10.0], "x_m": [0.0], "y_m": [0.0]}))
    assert there.time_s[0] == 7.5


def test_a_camera_on_a_moving_ship_gives_bearings_from_its_position_at_that_time():
    camera = Description("camera", "camera")
    columns = {"time_s": [0.0, 1.0], "bearing_deg": [10.0, 350.0], "station_x_m": [0.0, 5.0], "station_y_m": [0.0, 1.0]}
    there = placed(camera, Reports.of("camera", "table", columns))
    assert isinstance(there, Directions)
    np.testing.assert_allclose(there.sensor_m, [[0, 0], [5, 1]])
    np.testing.assert_allclose(there.sigma_deg, 1.0)


def test_bearing_derivatives_are_finite_at_the_sensor_too():
    states = np.array([[1e-9, 0.0], [30.0, 40.0]])
    sight = SlowBearing((0.0, 0.0), nearest_m=10.0)
    assert np.isfinite(sight.jacobian(states)).all() and np.abs(sight.jacobian(states)[0]).max() < 1e-3
    np.testing.assert_allclose(sight.jacobian(states)[1, 0], np.degrees([40.0, -30.0]) / 2500.0)


def test_positions_without_errors_get_those_of_the_radar():
    radar = Description("radar", "marine radar", site=SITE)
    plots: dict[str, Any] = {"time_s": np.zeros(6), "range_m": [2e3] * 3 + [15e3] * 3}
    plots["bearing_deg"] = [0.0, 60.0, 200.0] * 2
    measured = placed(radar, Reports.of("radar", "table", plots), PLANE)
    lat, lon = PLANE.to_geodetic(measured.state[:, :2])
    reports = Reports.of("radar", "table", {"time_s": np.zeros(6), "lat_deg": lat, "lon_deg": lon})
    in_plane = placed(radar, reports, PLANE)
    np.testing.assert_allclose(in_plane.covariance[:, :2, :2], measured.covariance[:, :2, :2], rtol=0.02, atol=10.0)
    assert PlacedReports(radar, reports).errors_note == (
        "radar: 6 positions state no errors; assumed as good as a range ± 15 m ± 0.5 % and a bearing "
        "± 0.5°; errors.position_m overrides it",
    )
    # Without a sensor position: circular errors, as at a quarter of the range.
    bare = Description("radar", "marine radar")
    sigma = np.hypot(0.25 * 44_448.0 * np.radians(0.5), 15.0)
    np.testing.assert_allclose(placed(bare, reports, PLANE).covariance[:, 0, 0], sigma**2, rtol=0.02)
    assert "a bearing ± 0.5° at 11.1 km, since its position is not known" in PlacedReports(bare, reports).errors_note[0]
    # In metres of the user's own, and where errors are described or stated.
    flat = Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0))
    here = {"time_s": [0.0], "x_m": [0.0], "y_m": [10e3]}
    spread = placed(flat, Reports.of("radar", "table", here)).covariance[0, :2, :2]
    np.testing.assert_allclose(np.sqrt(np.diag(spread)), [np.hypot(87.3, 15.0), np.hypot(52.2, 15.0)], rtol=0.01)
    known = Description("radar", "marine radar", site=SITE, errors=SensorErrors(position_m=7.0, extent_m=0.0))
    assert PlacedReports(known, reports).errors_note == ()
    np.testing.assert_allclose(placed(known, reports, PLANE).covariance[:, 0, 0], 49.0, rtol=1e-3)


def test_heights_are_assumed_only_if_missing():
    radar = Description("radar", "air radar", site=SITE, targets=Targets(height_m=3000.0, height_sigma_m=1.0))
    plot = {"time_s": [0.0, 0.0], "range_m": [2e4, 2e4], "bearing_deg": [0.0, 0.0], "pressure_alt_m": [8000.0, np.nan]}
    north = placed(radar, Reports.of("radar", "table", plot), PLANE).state[:, 1]
    site = PLANE.of_geodetic(SITE.lat_deg, SITE.lon_deg)[0, 1]
    np.testing.assert_allclose(north - site, np.sqrt(2e4**2 - np.array([7960.0, 2960.0]) ** 2), atol=60.0)


@pytest.mark.parametrize(
    ("kind", "fields", "plane", "words"),
    [
        ("other", {"x_m": [0.0], "y_m": [0.0]}, None, r"one: errors.position_m is not known and 'other' assumes none"),
        ("ais", {"lat_deg": [1.0], "lon_deg": [1.0]}, None, "give the plane of the picture"),
        ("ais", {"x_m": [0.0], "y_m": [0.0]}, PLANE, "give the origin of that plane, site = "),
        ("marine radar", {"range_m": [1.0], "bearing_deg": [1.0]}, PLANE, "the sensor's position is not known"),
        (
            "marine radar",
            {"range_m": [1.0], "bearing_deg": [1.0]},
            None,
            r"give site = \{ lat_deg = …, lon_deg = … \} in its d.*, or east_m and north_m",
        ),
        ("marine radar", {"range_m": [1.0]}, None, "ranges without bearings"),
        ("camera", {"bearing_deg": [1.0]}, PLANE, "the sensor's position is not known"),
    ],
)
def test_missing_fields_are_named_with_where_to_give_them(kind, fields, plane, words):
    with pytest.raises(InputError, match=words):
        placed(Description("one", kind), Reports.of("one", "table", {"time_s": [0.0], **fields}), plane)
