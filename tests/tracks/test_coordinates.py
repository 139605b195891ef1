"""Coordinates: round trips, covariances against samples, poles and the antimeridian, refusals."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sameas.errors import InputError
from sameas.gaussian import propagated
from sameas.tracks.coordinates import LocalPlane, along_and_across, bearing_in_plane, plane_polar, polar_to_geodetic

pymap3d = pytest.importorskip("pymap3d")


@settings(max_examples=60, deadline=None)
@given(st.floats(-90, 90), st.floats(-180, 180), st.floats(-3e5, 3e5), st.floats(-3e5, 3e5))
def test_round_trips_anywhere_on_earth(lat, lon, east, north):
    plane = LocalPlane(lat, lon)
    np.testing.assert_allclose(plane.of_geodetic(*plane.to_geodetic([[east, north]])), [[east, north]], atol=1e-6)


def test_distances_near_the_origin_agree_with_the_ellipsoid():
    from pymap3d.vincenty import vdist

    rng = np.random.default_rng(1)
    for origin in [(0.0, 0.0), (63.4, 10.4), (-89.9, 40.0), (45.0, 180.0)]:
        plane = LocalPlane(*origin)
        lat, lon = plane.to_geodetic(rng.uniform(-5e3, 5e3, (20, 2)))
        geodesic = [vdist(*origin, float(a), float(b))[0] for a, b in zip(lat, lon, strict=True)]
        np.testing.assert_allclose(np.hypot(*plane.of_geodetic(lat, lon).T), geodesic, rtol=1e-6)


def test_round_trips_at_the_antimeridian_and_the_poles():
    east = LocalPlane(10.0, 179.999).of_geodetic([10.0, 10.0], [179.999, -179.999])[1, 0]
    assert east == pytest.approx(0.002 * np.cos(np.radians(10.0)) * 111_320, rel=1e-3)
    across = LocalPlane(90.0, 0.0).of_geodetic([89.99, 89.99], [30.0, -150.0])
    np.testing.assert_allclose(across[0], -across[1], atol=1e-6)
    assert LocalPlane.about([1.0, 1.0], [179.0, -179.0]).lon_deg == pytest.approx(180.0)


def test_the_rotation_is_the_derivative_of_the_plane():
    plane, step = LocalPlane(60.0, 20.0), 1e-4
    lat, lon = np.array([61.0, 58.5]), np.array([23.0, 16.0])
    jacobian = plane.jacobian(lat, lon)
    here = plane.of_geodetic(lat, lon)
    for axis, (dlat, dlon) in enumerate([(0.0, step), (step, 0.0)]):
        there = plane.of_geodetic(lat + dlat, lon + dlon)
        e, n, _ = pymap3d.geodetic2enu(lat + dlat, lon + dlon, 0, lat, lon, 0)
        metres = (e, n)[axis]
        np.testing.assert_allclose((there - here) / metres[:, None], jacobian[:, :, axis], atol=2e-5)


def test_range_and_bearing_give_the_position_of_an_aircraft():
    rng = np.random.default_rng(2)
    site = (52.0, 179.9, 120.0)
    lat, lon = 52.0 + rng.uniform(-1.5, 1.5, 50), 179.9 + rng.uniform(-2.0, 2.0, 50)
    height = rng.uniform(0.0, 12e3, 50)
    bearing, _, distance = pymap3d.geodetic2aer(lat, lon, height, *site)
    found = polar_to_geodetic(
        range_m=distance, bearing_deg=bearing, sensor_lat_deg=site[0], sensor_lon_deg=site[1], sensor_height_m=site[2],
        height_m=height, sigma_range_m=50.0, sigma_bearing_deg=0.05,
    )  # fmt: skip
    plane = LocalPlane(*site[:2])
    away = plane.of_geodetic(found.lat_deg, found.lon_deg) - plane.of_geodetic(lat, lon)
    assert np.abs(away).max() < 0.01
    np.testing.assert_allclose(found.height_m, height, atol=0.01)


@pytest.mark.parametrize(("distance", "height"), [(200e3, 10e3), (30e3, 9e3), (5e3, 0.0)])
def test_the_covariance_on_the_ground_agrees_with_a_sample(distance, height):
    rng = np.random.default_rng(3)
    site, sigma = (48.0, 11.0, 500.0), {"range": 80.0, "bearing": 0.15, "height": 120.0}
    about = {"sensor_lat_deg": site[0], "sensor_lon_deg": site[1], "sensor_height_m": site[2]}
    errors = {"sigma_range_m": sigma["range"], "sigma_bearing_deg": sigma["bearing"], "sigma_height_m": sigma["height"]}
    plane = LocalPlane(*site[:2])

    def ground(r, b, h):
        found = polar_to_geodetic(range_m=r, bearing_deg=b, height_m=h, **about, **errors)
        jacobian = plane.jacobian(found.lat_deg, found.lon_deg)
        return plane.of_geodetic(found.lat_deg, found.lon_deg), propagated(jacobian, found.covariance)

    n = 20_000
    draws = (rng.standard_normal(n) * s for s in sigma.values())
    r, b, h = (mean + draw for mean, draw in zip((distance, 70.0, height), draws, strict=True))
    sample = np.cov(ground(r, b, h)[0].T)
    _, stated = ground([distance], [70.0], [height])
    np.testing.assert_allclose(stated[0], sample, atol=0.04 * np.trace(sample))


def test_the_covariance_of_a_wide_beam_covers_its_arc():
    rng = np.random.default_rng(4)
    bearing = 30.0 + 8.0 * rng.standard_normal(40_000)
    about: dict[str, Any] = {"sensor_m": (100.0, -50.0), "sigma_range_m": 5.0, "sigma_bearing_deg": 8.0}
    sample, _ = plane_polar(
        range_m=np.full(40_000, 2e3) + 5.0 * rng.standard_normal(40_000), bearing_deg=bearing, **about
    )
    _, stated = plane_polar(range_m=[2e3], bearing_deg=[30.0], **about)
    along = np.array([np.sin(np.radians(30.0)), np.cos(np.radians(30.0))])
    assert along @ stated[0] @ along == pytest.approx(along @ np.cov(sample.T) @ along, rel=0.1)


def test_along_and_across_errors_rotate_with_the_bearing():
    cov = along_and_across(100.0, 1.0, [0.0, 90.0, 45.0])
    np.testing.assert_allclose(cov[0], [[1, 0], [0, 100]], atol=1e-9)
    np.testing.assert_allclose(cov[1], [[100, 0], [0, 1]], atol=1e-9)
    assert cov[2, 0, 1] == pytest.approx(49.5)


def test_bearings_are_corrected_for_meridian_convergence_and_wrap():
    plane = LocalPlane(60.0, 20.0)
    assert bearing_in_plane(plane, [359.9, 0.1], 60.0, 20.0) == pytest.approx([359.9, 0.1])
    # East of the origin, true north is west of the plane's north.
    turned_by = bearing_in_plane(plane, [0.0], 60.0, 24.0)[0] - 360.0
    assert turned_by == pytest.approx(-4.0 * np.sin(np.radians(60.0)), rel=0.01)
    far = plane.of_geodetic([60.0, 60.01], [24.0, 24.0])
    east, north = far[1] - far[0]
    assert turned_by == pytest.approx(np.degrees(np.arctan2(east, north)), abs=1e-3)


def test_invalid_coordinates_are_refused_with_a_clear_message():
    plane = LocalPlane(50.8, -1.3)
    with pytest.raises(
        InputError, match=r"ais: 1 positions lie farther than 4000 km.*row 1: 50.8, 81.*sign of the long"
    ):
        plane.of_geodetic([50.8, 50.8], [-1.3, 81.3], "ais")
    with pytest.raises(InputError, match=r"ais: 1 latitudes lie beyond ±90° \(first: row 0: 151"):
        plane.of_geodetic([151.0], [0.0], "ais")
    with pytest.raises(InputError, match="origin is nan"):
        LocalPlane(np.nan, 0.0)
    with pytest.raises(InputError, match="no position is known"):
        LocalPlane.about([np.nan], [np.nan])
    with pytest.raises(InputError, match="beyond the edge of the earth"):
        plane.to_geodetic([[8e6, 0.0]])
    assert np.isnan(plane.of_geodetic([np.nan], [0.0])).all()


def test_without_pymap3d_the_install_line_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pymap3d", None)
    with pytest.raises(InputError, match=r"need pymap3d: pip install 'sameas\[targets\]'"):
        LocalPlane(0.0, 0.0).of_geodetic([0.0], [0.0])


def test_a_plot_nearer_than_its_assumed_height_has_an_error_in_every_direction():
    """Ships 3 to 9 km from an air radar without heights: 1σ was 20 km along the bearing, and 0 across it."""
    ranges = np.array([3000.0, 5000.0, 9000.0])
    ground = polar_to_geodetic(
        range_m=ranges, bearing_deg=[20.0, 110.0, 290.0], sensor_lat_deg=50.7, sensor_lon_deg=-1.1,
        height_m=5000.0, sigma_range_m=70.0, sigma_bearing_deg=0.06, sigma_height_m=3500.0,
    )  # fmt: skip
    small, large = np.sqrt(np.linalg.eigvalsh(ground.covariance)).T
    assert (large <= ranges * 1.001).all() and (small > 1.0).all()
