"""Directions without any source of positions: true crossings become objects, ghosts do not."""

from __future__ import annotations

from typing import Any

import numpy as np

from sameas.picture import Picture
from sameas.picture.plot_picture import PlotPicture
from sameas.report.picture import scene_lines
from sameas.tracks import Description, Reports, Scene, Site

PLACES_M = np.array([[-9000.0, -6000.0], [8000.0, -7000.0], [0.0, 9000.0]])
START_M = np.array([[-2000.0, 1500.0], [3000.0, -1000.0], [500.0, 3500.0]])
VELOCITY_M_PER_S = np.array([[6.0, 2.0], [-4.0, 3.0], [2.0, -6.0]])


def direction_finders(n_places: int, n_emitters: int, delay_s: float = 0.2) -> Scene:
    """Directions ± 0.5° every 5 s, of which three in ten are missing and one in some twenty is false."""
    rng, sources = np.random.default_rng(7), []
    for k, place in enumerate(PLACES_M[:n_places]):
        times, bearings = [], []
        for t in np.arange(delay_s * k, 300.0, 5.0):
            arm = START_M[:n_emitters] + t * VELOCITY_M_PER_S[:n_emitters] - place
            shown = np.degrees(np.arctan2(*arm.T)) + 0.5 * rng.standard_normal(n_emitters)
            shown = [*shown[rng.random(n_emitters) < 0.7], *rng.uniform(0.0, 360.0, rng.poisson(0.1))]
            bearings += [bearing % 360.0 for bearing in shown]
            times += [t] * len(shown)
        columns: dict[str, Any] = {
            "time_s": times,
            "bearing_deg": bearings,
            "sigma_bearing_deg": np.full(len(times), 0.5),
        }
        site = Site(east_m=float(place[0]), north_m=float(place[1]))
        sources.append((Description(f"df{k}", "esm", site=site), Reports.of(f"df{k}", "table", columns)))
    return Scene.of(sources)


def places_shown(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The distances of the confirmed objects from the nearest emitter after 250 s, and which emitter that is."""
    picture = Picture.of(scene, np.arange(0.0, 251.0, 10.0))
    assert isinstance(picture.watch, PlotPicture)
    objects = picture.objects
    last = (objects["time_s"] == 250.0) & (objects["stage"] != "tentative")
    shown = np.column_stack([objects["x_m"], objects["y_m"]]).astype(float)[last]
    emitters = START_M + 250.0 * VELOCITY_M_PER_S
    distance_m = np.hypot(*np.moveaxis(shown[:, None] - emitters, -1, 0))
    return distance_m.min(axis=1), distance_m.argmin(axis=1)


def test_three_direction_finders_show_each_emitter_once_and_no_ghost():
    distance_m, emitter = places_shown(direction_finders(3, 3))
    assert sorted(emitter.tolist()) == [0, 1, 2] and distance_m.max() < 400.0


def test_two_direction_finders_find_one_emitter_also_if_they_take_turns():
    for delay_s in (0.2, 2.5):
        distance_m, emitter = places_shown(direction_finders(2, 1, delay_s))
        assert emitter.tolist() == [0] and distance_m.max() < 400.0


def test_the_report_says_from_how_many_places_the_directions_are():
    for n_places, words in ((1, "no object gets a position"), (2, "false crossings"), (3, "3 places")):
        scene = direction_finders(n_places, 1)
        assert words in list(scene_lines(scene, PlotPicture()))[-1]
