"""Antenna offset and accuracy: the centre of a hull, and the accuracy classes of transponders."""

import numpy as np
import pytest

from sameas.io.sensors.ais import Hull
from sameas.io.sensors.format import (
    RADIUS_95,
    round_covariance,
    sigma_of_containment,
    sigma_of_nacp,
    sigma_of_nacv,
    sigma_of_nic,
    sigma_of_nucp,
)
from sameas.tracks.coordinates import LocalPlane


def hull(*sides):
    return Hull(*(np.array([float(side)]) for side in sides))


def centre(made, heading_deg, lat=50.0, lon=-1.0):
    """East and north from the antenna to the centre (m), and the covariance (m²)."""
    lat2, lon2, extent = made.centre(np.array([lat]), np.array([lon]), np.array([heading_deg]))
    return LocalPlane(lat, lon).of_geodetic(lat2, lon2)[0], extent[0]


def test_the_centre_of_a_ship_is_ahead_of_an_antenna_at_the_bridge():
    # EVER DIADEM: 225 m to the bow, 70 m to the stern, 1 m to port, 31 m to starboard.
    made = hull(225, 70, 1, 31)
    assert made.length_m == 295.0 and made.width_m == 32.0
    north, extent = centre(made, 0.0)
    np.testing.assert_allclose(north, [15.0, 77.5], atol=0.01)
    np.testing.assert_allclose(extent, [32.0**2 / 12, 0.0, 295.0**2 / 12], atol=1e-9)
    east, extent = centre(made, 90.0)
    np.testing.assert_allclose(east, [77.5, -15.0], atol=0.01)
    np.testing.assert_allclose(extent, [295.0**2 / 12, 0.0, 32.0**2 / 12], atol=1e-9)


def test_the_extent_of_the_hull_is_along_the_heading():
    _, extent = centre(hull(100, 100, 10, 10), 30.0)
    matrix = np.array([[extent[0], extent[1]], [extent[1], extent[2]]])
    values, vectors = np.linalg.eigh(matrix)
    np.testing.assert_allclose(values, [20.0**2 / 12, 200.0**2 / 12])
    np.testing.assert_allclose(np.abs(vectors[:, 1]), [np.sin(np.pi / 6), np.cos(np.pi / 6)])


@pytest.mark.slow
def test_without_a_heading_the_offset_is_averaged_over_directions():
    made = hull(200, 100, 10, 20)
    where, extent = centre(made, np.nan)
    np.testing.assert_allclose(where, 0.0, atol=1e-6)
    angles = np.linspace(0.0, 360.0, 721)[:-1]
    known = [centre(made, angle) for angle in angles]
    # The mean over all headings of the covariance and of the squared offset.
    mean = np.mean([np.array([e[0] + w[0] ** 2, e[2] + w[1] ** 2]) for w, e in known], axis=0)
    np.testing.assert_allclose(extent[[0, 2]], mean, rtol=1e-3)
    assert extent[1] == 0.0


def test_an_antenna_of_unknown_position_is_uniform_on_the_hull():
    made = hull(0, 120, 0, 18)
    assert not made.antenna_known and made.length_m == 120.0
    where, extent = centre(made, 0.0)
    np.testing.assert_allclose(where, 0.0, atol=1e-6)
    np.testing.assert_allclose(extent, [2 * 18.0**2 / 12, 0.0, 2 * 120.0**2 / 12])


def test_an_unknown_hull_changes_nothing():
    for made in (hull(0, 0, 0, 0), hull(np.nan, np.nan, np.nan, np.nan)):
        where, extent = centre(made, 45.0)
        np.testing.assert_allclose(where, 0.0, atol=1e-6)
        assert extent.tolist() == [0.0, 0.0, 0.0] and np.isnan(made.length_m)


def test_the_centre_is_found_across_the_antimeridian():
    lat, lon, _ = hull(300, 0, 10, 10).centre(np.array([60.0]), np.array([179.9999]), np.array([90.0]))
    assert -180.0 <= lon[0] < -179.99 and lat[0] == pytest.approx(60.0, abs=1e-4)


def test_a_radius_of_95_percent_holds_95_percent():
    rng = np.random.default_rng(1)
    errors = rng.normal(0.0, sigma_of_nacp(9), (100_000, 2))
    assert np.mean(np.hypot(*errors.T) < 30.0) == pytest.approx(0.95, abs=0.005)


def test_better_classes_are_smaller_and_unknown_ones_are_absent():
    for sigma, highest in ((sigma_of_nacp, 11), (sigma_of_nic, 11), (sigma_of_nucp, 9), (sigma_of_nacv, 4)):
        known = sigma(np.arange(1, highest + 1))
        assert (np.diff(known) < 0).all() and known[0] > 0
        assert np.isnan(sigma([0, -1, highest + 1, np.nan])).all()
    # Where a standard states both, accuracy is half of the containment radius.
    np.testing.assert_allclose(sigma_of_containment([185.2, 0.0]), [92.6 / RADIUS_95, np.nan])
    np.testing.assert_allclose(sigma_of_nic(8), sigma_of_nacp(8))


def test_circular_errors_have_no_correlation():
    np.testing.assert_array_equal(round_covariance([2.0, np.nan]), [[4.0, 0.0, 4.0], [np.nan] * 3])
