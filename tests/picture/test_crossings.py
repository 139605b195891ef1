"""Directions without any source of positions: true crossings become objects, ghosts do not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sameas.picture import LivePicture, Picture
from sameas.picture.plot_picture import PlotPicture
from sameas.report.picture import scene_lines
from sameas.tracks import Description, Reports, Scene, Site

PLACES_M = np.array([[-9000.0, -6000.0], [8000.0, -7000.0], [0.0, 9000.0]])
START_M = np.array([[-2000.0, 1500.0], [3000.0, -1000.0], [500.0, 3500.0]])
VELOCITY_M_PER_S = np.array([[6.0, 2.0], [-4.0, 3.0], [2.0, -6.0]])


UNHEARD_M = np.array([[6000.0, 6000.0], [6200.0, 6100.0], [6100.0, 6300.0]])
CHANNELS_HZ = np.array([156.800e6, 156.650e6, 156.375e6])


def direction_finders(
    n_places: int,
    n_emitters: int,
    delay_s: float = 0.2,
    frequencies: bool = False,
    offset_deg: tuple[float, ...] = (0.0,) * len(PLACES_M),
) -> Scene:
    """Directions ± 0.5° every 5 s, of which three in ten are missing and one in some twenty is false."""
    rng, sources = np.random.default_rng(7), []
    for k, place in enumerate(PLACES_M[:n_places]):
        times, bearings, emitters = [], [], []
        for t in np.arange(delay_s * k, 300.0, 5.0):
            arm = START_M[:n_emitters] + t * VELOCITY_M_PER_S[:n_emitters] - place
            shown = np.degrees(np.arctan2(*arm.T)) + 0.5 * rng.standard_normal(n_emitters)
            seen = np.flatnonzero(rng.random(n_emitters) < 0.7)
            shown = [*shown[seen], *rng.uniform(0.0, 360.0, rng.poisson(0.1))]
            bearings += [(bearing + offset_deg[k]) % 360.0 for bearing in shown]
            emitters += [*seen, *[0] * (len(shown) - len(seen))]
            times += [t] * len(shown)
        columns: dict[str, Any] = {
            "time_s": times,
            "bearing_deg": bearings,
            "sigma_bearing_deg": np.full(len(times), 0.5),
        }
        if frequencies:
            columns["frequency_hz"] = CHANNELS_HZ[emitters] + 500.0 * rng.standard_normal(len(times))
        site = Site(east_m=float(place[0]), north_m=float(place[1]))
        sources.append((Description(f"df{k}", "esm", site=site), Reports.of(f"df{k}", "table", columns)))
    return Scene.of(sources)


def shown_after_250_s(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The vectors of the confirmed objects from the nearest emitter after 250 s, which emitter that is, and their
    covariances."""
    picture = Picture.of(scene, np.arange(0.0, 251.0, 10.0))
    assert isinstance(picture.watch, PlotPicture)
    objects = picture.objects
    last = (objects["time_s"] == 250.0) & (objects["stage"] != "tentative")
    shown = np.column_stack([objects["x_m"], objects["y_m"]]).astype(float)[last]
    apart_m = shown[:, None] - (START_M + 250.0 * VELOCITY_M_PER_S)
    emitter = np.hypot(*np.moveaxis(apart_m, -1, 0)).argmin(axis=1)
    columns = ("var_x_m2", "cov_xy_m2", "cov_xy_m2", "var_y_m2")
    covariance = np.column_stack([objects[name][last] for name in columns]).astype(float).reshape(-1, 2, 2)
    return apart_m[np.arange(len(emitter)), emitter], emitter, covariance


def places_shown(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The distances of the confirmed objects from the nearest emitter after 250 s, and which emitter that is."""
    apart_m, emitter, _ = shown_after_250_s(scene)
    return np.hypot(*apart_m.T), emitter


def test_three_direction_finders_show_each_emitter_once_and_no_ghost():
    distance_m, emitter = places_shown(direction_finders(3, 3))
    assert sorted(emitter.tolist()) == [0, 1, 2] and distance_m.max() < 400.0


@pytest.mark.long
def test_two_direction_finders_find_one_emitter_also_if_they_take_turns():
    for delay_s in (0.2, 2.5):
        distance_m, emitter = places_shown(direction_finders(2, 1, delay_s))
        assert emitter.tolist() == [0] and distance_m.max() < 400.0


def test_frequencies_leave_no_ghost_to_two_direction_finders():
    distance_m, emitter = places_shown(direction_finders(2, 3, frequencies=True))
    assert sorted(emitter.tolist()) == [0, 1, 2] and distance_m.max() < 400.0


def nees(apart_m: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("kv,kvw,kw->k", apart_m, np.linalg.inv(covariance), apart_m) / 2.0


@pytest.mark.long
def test_offsets_of_direction_finders_show_where_three_of_them_cross():
    true = (1.5, -2.0, 1.0)
    scene, biases = direction_finders(3, 3, frequencies=True, offset_deg=true).registered()
    for k, one in enumerate(biases):
        azimuth = one.parameters["azimuth_deg"]
        assert azimuth.standard_error < 1.0 and abs(azimuth.value - true[k]) < 2.5 * azimuth.standard_error
    apart_m, emitter, covariance = shown_after_250_s(scene)
    assert sorted(emitter.tolist()) == [0, 1, 2] and nees(apart_m, covariance).max() < 3.0


def test_offsets_are_not_estimated_where_several_objects_make_false_crossings():
    _, biases = direction_finders(3, 3).registered()
    assert all("without frequencies" in one.notes[0] and not one.parameters for one in biases)
    _, of_one = direction_finders(3, 1).registered()
    assert all(abs(one.parameters["azimuth_deg"].value) < 2.0 for one in of_one)


def test_errors_at_two_places_allow_for_offsets_that_cannot_be_seen():
    scene, biases = direction_finders(2, 2, frequencies=True, offset_deg=(2.0, 2.0)).registered()
    assert all("two places alone" in one.notes[0] and not one.parameters for one in biases)
    apart_m, emitter, covariance = shown_after_250_s(scene)
    assert sorted(emitter.tolist()) == [0, 1] and nees(apart_m, covariance).max() < 2.0


@pytest.mark.parametrize("frequencies", [False, True])
def test_two_places_with_frequencies_are_said_to_have_no_false_crossings(frequencies):
    line = list(scene_lines(direction_finders(2, 2, frequencies=frequencies), PlotPicture()))[-1]
    assert ("false crossings" in line) is not frequencies


def test_the_report_says_from_how_many_places_the_directions_are():
    for n_places, words in ((1, "no object gets a position"), (2, "false crossings"), (3, "3 places")):
        scene = direction_finders(n_places, 1)
        assert words in list(scene_lines(scene, PlotPicture()))[-1]


def test_crossings_beside_ais_err_by_offsets_as_they_say():
    """Their errors averaged out over the scans: a kilometre was known to 0.2 km."""
    heard = direction_finders(2, 1, frequencies=True, offset_deg=(2.0, -2.0))
    objects = beside_ais(heard, UNHEARD_M, np.zeros((3, 2))).objects
    names = ("x_m", "y_m", "var_x_m2", "cov_xy_m2", "cov_xy_m2", "var_y_m2", "time_s")
    x_m, y_m, *terms, time_s = (np.ma.filled(objects[name], np.nan) for name in names)
    crossed = (objects["sources"] == "df0 df1") & np.isfinite(x_m) & (time_s > 100.0)
    apart_m = np.column_stack([x_m, y_m])[crossed] - START_M[0] - time_s[crossed][:, None] * VELOCITY_M_PER_S[0]
    assert crossed.sum() > 5 and np.median(np.hypot(*apart_m.T)) > 200.0
    assert np.median(nees(apart_m, np.column_stack(terms)[crossed].reshape(-1, 2, 2))) < 2.0


def test_live_direction_finders_are_registered_and_show_their_emitters():
    feeds = direction_finders(3, 3, frequencies=True, offset_deg=(1.5, -2.0, 1.0)).feeds
    picture = LivePicture([feed.description for feed in feeds])
    for t in np.arange(0.0, 121.0, 10.0):
        for feed in feeds:
            reports = feed.raw_reports
            assert reports is not None
            picture.add(feed.description.name, reports.where((reports.time_s > t - 10.0) & (reports.time_s <= t)))
        picture.advance(t)
        if t == 60.0:
            assert all(one.parameters["azimuth_deg"].standard_error < 1.5 for one in picture.register())
    places = np.column_stack([picture.objects["x_m"], picture.objects["y_m"]]).astype(float)
    apart_m = np.hypot(*np.moveaxis(places[:, None] - (START_M + 120.0 * VELOCITY_M_PER_S), -1, 0))
    assert sorted(apart_m.argmin(axis=1).tolist()) == [0, 1, 2] and apart_m.min(axis=1).max() < 400.0


def beside_ais(heard: Scene, start_m: np.ndarray, velocity_m_per_s: np.ndarray) -> Picture:
    """The picture of direction finders and of ships with AIS, ± 8 m every 6 s."""
    rng = np.random.default_rng(3)
    columns: dict[str, list[Any]] = {name: [] for name in ("time_s", "x_m", "y_m", "vx_m_per_s", "vy_m_per_s", "mmsi")}
    for t in np.arange(0.0, 300.0, 6.0):
        for ship, (start, velocity) in enumerate(zip(start_m, velocity_m_per_s, strict=True)):
            place = start + t * velocity + 8.0 * rng.standard_normal(2)
            for name, value in zip(columns, (t, *place, *velocity, f"23500{ship}111"), strict=True):
                columns[name].append(value)
    ais = Description("ais", "ais"), Reports.of("ais", "ais", columns)
    finders = [(feed.description, feed.raw_reports) for feed in heard.feeds if feed.raw_reports is not None]
    return Picture.of(Scene.of([*finders, ais]).registered()[0], np.arange(0.0, 251.0, 10.0))


def test_two_ships_of_ais_are_those_that_direction_finders_hear():
    """The region of two positions was a point between them: no direction was of a ship."""
    objects = beside_ais(direction_finders(2, 3), START_M[:2], VELOCITY_M_PER_S[:2]).objects
    shown = objects["stage"] == "confirmed"
    for mmsi in ("235000111", "235001111"):
        of_ship = shown & (objects["mmsi"] == mmsi)
        assert len(set(objects["object"][of_ship].tolist())) == 1
        assert np.mean(["df" in sources for sources in objects["sources"][of_ship].tolist()]) > 0.6
    last = objects["time_s"] == 250.0
    assert sum(last & (objects["stage"] != "tentative")) <= 4


def test_direction_finders_place_emitters_far_from_all_ships_of_ais():
    """They were outside the region of the positions, and their directions did not cross."""
    objects = beside_ais(direction_finders(2, 2, frequencies=True), UNHEARD_M, np.zeros((3, 2))).objects
    x_m, y_m, time_s = (np.ma.filled(objects[name], np.nan) for name in ("x_m", "y_m", "time_s"))
    crossed = (objects["sources"] == "df0 df1") & np.isfinite(x_m) & (time_s > 60.0)
    true = START_M[:2] + time_s[crossed][:, None, None] * VELOCITY_M_PER_S[:2]
    apart_m = np.column_stack([x_m, y_m])[crossed][:, None] - true
    nearest_m = np.hypot(*np.moveaxis(apart_m, -1, 0)).min(axis=1)
    assert crossed.sum() > 10 and np.median(nearest_m) < 300.0
