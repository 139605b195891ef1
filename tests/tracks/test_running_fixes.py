"""One moving direction finder places emitters that do not move, with honest errors, and says where it cannot."""

import numpy as np
import pytest

from sameas.picture import Picture
from sameas.tracks import Description, LocalPlane, Reports, Scene
from sameas.tracks.placement import Directions

START_S, PLANE = 1_714_560_000.0, LocalPlane(50.7, -1.3)
#: Metres east and north, and frequencies, of two emitters.
EMITTERS_M, FREQUENCIES_HZ = np.array([[6000.0, 4000.0], [-5000.0, 1500.0]]), np.array([156.8e6, 121.5e6])


def heard(seed=1, *, frequencies=True, emitters=(0, 1), velocity=(0.0, 0.0), turns=True, offset_deg=1.5, minutes=25.0):
    """A boat goes north and then east, unless she rests, and hears each emitter in two of three intervals of 5 s."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 60.0 * minutes, 5.0)
    boat = np.column_stack([np.where(t < 700.0, 0.0, 5.0 * (t - 700.0)), np.where(t < 700.0, 5.0 * t, 3500.0)])
    boat = boat if turns else np.zeros_like(boat)
    lat, lon = PLANE.to_geodetic(boat)
    parts = []
    for k in emitters:
        rows = np.flatnonzero(rng.random(len(t)) < 0.67)
        arm = EMITTERS_M[k] + t[rows, None] * np.array(velocity) - boat[rows]
        bearing = np.degrees(np.arctan2(*arm.T)) + offset_deg + 2.0 * rng.normal(size=len(rows))
        parts.append(np.column_stack([t[rows], lat[rows], lon[rows], bearing, np.full(len(rows), FREQUENCIES_HZ[k])]))
    time_s, lat, lon, bearing, frequency = np.concatenate(parts)[np.argsort(np.concatenate(parts)[:, 0])].T
    columns = {"time_s": START_S + time_s, "station_lat_deg": lat, "station_lon_deg": lon, "bearing_deg": bearing}
    columns |= {"frequency_hz": frequency} if frequencies else {}
    return Scene.of([(Description("df", "esm"), Reports.of("df", "table", columns))], PLANE)


def test_emitters_are_placed_by_the_way_of_the_finder_with_honest_errors():
    """They had no place: one finder is one place."""
    nees = []
    for seed in range(8):
        feed = heard(seed, offset_deg=2.0 * np.random.default_rng(seed).normal()).feeds[0]
        fixes = feed.raw_reports
        for k, name in enumerate(("156.8 MHz", "121.5 MHz")):
            last = np.flatnonzero(fixes.track_id == name)[-1]
            apart = feed.reports.state[last, :2] - EMITTERS_M[k]
            nees.append(apart @ np.linalg.solve(feed.reports.covariance[last, :2, :2], apart) / 2.0)
            assert np.hypot(*apart) < 900.0
    assert 0.5 < np.mean(nees) < 1.6, nees


def test_the_picture_shows_the_emitters_as_objects():
    scene = heard()
    objects = Picture.of(scene, scene.span_s[1] - np.arange(300.0, -1.0, -60.0)).objects
    last = objects["time_s"] == objects["time_s"].max()
    place = np.column_stack([objects["x_m"][last], objects["y_m"][last]])
    apart = np.hypot(*(place[:, None] - EMITTERS_M).transpose(2, 0, 1)).min(axis=0)
    assert len(place) == 2 and apart.max() < 700.0 and set(objects["stage"][last]) == {"confirmed"}
    assert (
        "the place of 156.8 MHz, by 202 directions from 5.3 km" in scene.notes[0]
        and "if it does not move: ± " in scene.notes[0]
    )


@pytest.mark.parametrize("how", [{"turns": False}, {"frequencies": False}, {"minutes": 0.5}])
def test_what_does_not_cross_at_one_place_has_none(how):
    """From one place; two emitters without frequencies; too few."""
    scene = heard(**how)
    assert isinstance(scene.feeds[0].reports, Directions)
    assert any("there are several emitters" in note for note in scene.notes) == ("turns" not in how)


def test_one_emitter_without_a_frequency_is_placed_and_one_that_moves_across_is_not():
    feed = heard(frequencies=False, emitters=(0,)).feeds[0]
    assert np.hypot(*(feed.reports.state[-1, :2] - EMITTERS_M[0])) < 700.0
    assert isinstance(heard(emitters=(1,), velocity=(0.0, 15.0)).feeds[0].reports, Directions)
