"""Heights of reports: conversion to one kind, offsets between sources, and use in a picture."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sameas.picture import LivePicture, Picture
from sameas.tracks import Description, Reports, Scene, SensorErrors, Site
from sameas.tracks.heights import PRESSURE


def source(name: str, columns: dict, sigma: float = 100.0, height_m: float = 20.0):
    errors = SensorErrors(position_m=sigma, height_m=height_m)
    return Description(name, "tracks", errors=errors), Reports.of(name, "table", columns)


def crossing(rng, name: str, height: str, shift_m: float = 0.0, share: float = 1.0, with_heights: bool = True):
    """Two aircraft on one course, 7 000 m apart in height and within 100 m horizontally."""
    columns = {key: [] for key in ("time_s", "x_m", "y_m", "track_id", height)}
    for k, side in enumerate((-1.0, 1.0)):
        for t in np.arange(0.0, 200.0, 5.0):
            columns["time_s"].append(t)
            columns["x_m"].append(200.0 * (t - 100.0) + rng.normal(0.0, 100.0))
            columns["y_m"].append(0.5 * side * (t - 100.0) + rng.normal(0.0, 100.0))
            columns["track_id"].append(f"{name}{k}")
            known = rng.random() < share
            columns[height].append(3000.0 + 7000.0 * k + shift_m + rng.normal(0.0, 20.0) if known else np.nan)
    if not with_heights:
        del columns[height]
    return source(name, columns)


def counts(picture: Picture) -> tuple[int, int]:
    """Numbers of true and false pairs; tracks of one object end in the same letter."""
    records, right, wrong = picture.records, 0, 0
    for key in set(zip(records["time_s"].tolist(), records["object"].tolist(), strict=True)):
        here = (records["time_s"] == key[0]) & (records["object"] == key[1])
        ends = [name[-1] for name in records["track_id"][here]]
        if len(ends) == 2:
            right, wrong = right + (ends[0] == ends[1]), wrong + (ends[0] != ends[1])
    return right, wrong


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(("other", "shift_m"), [("pressure_alt_m", 0.0), ("alt_m", 250.0), ("pressure_alt_m", 150.0)])
def test_heights_distinguish_two_aircraft_over_one_place(other: str, shift_m: float) -> None:
    rng = np.random.default_rng(1)
    scene = Scene.of([crossing(rng, "a", "pressure_alt_m"), crossing(rng, "b", other, shift_m, share=0.8)])
    times = np.arange(20.0, 200.0, 10.0)
    picture = Picture.of(scene, times)
    right, wrong = counts(picture)
    assert wrong == 0 and right >= 20
    heights = np.ma.compressed(picture.objects["height_m"])
    assert np.all(np.minimum(abs(heights - 3000.0), abs(heights - 10_000.0)) < 100.0)
    assert np.ma.compressed(picture.objects["sigma_height_m"]).max() < 100.0
    if shift_m:
        assert any("subtracted" in note for heights in scene.heights for note in heights.notes)


@pytest.mark.slow_after(1)
def test_vertical_speeds_distinguish_two_aircraft_whose_heights_no_source_reports() -> None:
    """One climbs, the other descends, on one course and 200 m apart at most; both sources report vertical speeds."""

    def found(with_climbs: bool) -> tuple[int, int]:
        right, wrong = 0, 0
        for seed in range(3):
            rng, sources = np.random.default_rng(seed), []
            for name in "ab":
                description, reports = crossing(rng, name, "pressure_alt_m", with_heights=False)
                climb = np.where(reports.track_id == f"{name}0", 9.0, -9.0) + rng.normal(0.0, 1.0, len(reports))
                sources.append((description, replace(reports, climb_m_per_s=climb if with_climbs else None)))
            picture = Picture.of(Scene.of(sources), np.arange(20.0, 200.0, 30.0))
            assert ("climb_m_per_s" in picture.objects) == with_climbs
            one = counts(picture)
            right, wrong = right + one[0], wrong + one[1]
        return right, wrong

    without, (right, wrong) = found(False), found(True)
    assert without[1] >= 3 and wrong == 0 and right >= 30, (without, right, wrong)


@pytest.mark.slow
def test_without_heights_the_same_aircraft_are_confused() -> None:
    wrong, heights = 0, []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        blind = Scene.of([crossing(rng, name, "pressure_alt_m", with_heights=False) for name in "ab"])
        picture = Picture.of(blind, np.arange(20.0, 200.0, 30.0))
        wrong += counts(picture)[1]
        heights.append("height_m" in picture.objects)
    assert wrong >= 6 and not any(heights)


def test_the_difference_of_height_kinds_is_fitted_by_a_line() -> None:
    rng = np.random.default_rng(5)
    level = rng.uniform(500.0, 12e3, 400)
    both: dict[str, Any] = {
        "time_s": np.arange(400.0), "x_m": rng.uniform(-9e4, 9e4, 400), "y_m": rng.uniform(-9e4, 9e4, 400),
        "track_id": [str(k) for k in range(400)], "pressure_alt_m": level,
        "alt_m": 80.0 + 1.03 * level + rng.normal(0.0, 8.0, 400),
    }  # fmt: skip
    # One report in fifty has another aircraft's geometric height.
    both["alt_m"][::50] = rng.uniform(500.0, 12e3, 8)
    only = {**{name: both[name][:40] for name in ("time_s", "track_id", "alt_m")},
            "x_m": rng.uniform(-9e5, -8e5, 40), "y_m": rng.uniform(-9e5, -8e5, 40)}  # fmt: skip
    heights = Scene.of([source("both", both), source("only", only)]).heights
    assert all(one is not None and one.kind == PRESSURE for one in heights)
    np.testing.assert_array_equal(heights[0].height_m, level)
    right = np.arange(40) % 50 != 0
    assert np.sqrt(np.mean((heights[1].height_m - level[:40])[right] ** 2)) < 12.0
    assert np.all(heights[1].sigma_m < 30.0) and "by 392 reports with both" in heights[1].notes[0]


def test_the_line_between_two_sources_is_fitted_to_common_aircraft() -> None:
    rng = np.random.default_rng(8)
    times = np.arange(0.0, 100.0, 5.0)
    place, speed = rng.uniform(-6e4, 6e4, (30, 2)), rng.normal(0.0, 150.0, (30, 2))
    level = rng.uniform(1e3, 12e3, 30)

    def seen(name: str, column: str, heights: np.ndarray):
        where = place[:, None] + speed[:, None] * times[:, None] + rng.normal(0.0, 30.0, (30, len(times), 2))
        return source(name, {
            "time_s": np.tile(times, 30), "x_m": where[..., 0].ravel(), "y_m": where[..., 1].ravel(),
            "track_id": np.repeat([f"{name}{k}" for k in range(30)], len(times)),
            column: np.repeat(heights, len(times)) + rng.normal(0.0, 10.0, 30 * len(times)),
        }, sigma=30.0)  # fmt: skip

    scene = Scene.of([seen("a", "pressure_alt_m", level), seen("b", "alt_m", 120.0 + 1.03 * level)])
    heights = scene.heights[1]
    assert np.median(np.abs(heights.height_m - np.repeat(level, len(times)))) < 12.0
    assert np.median(heights.sigma_m) < 40.0 and "+3.0 % against a" in heights.notes[0]


def test_height_kinds_without_comparison_get_wide_errors() -> None:
    """Only pressure heights against only ellipsoidal heights, far apart: no fitted line, wide errors."""
    here = {"time_s": [0.0], "x_m": [0.0], "y_m": [0.0], "track_id": ["1"], "pressure_alt_m": [10e3]}
    there = {"time_s": [0.0], "x_m": [9e4], "y_m": [0.0], "track_id": ["2"], "alt_m": [10e3]}
    heights = Scene.of([source("here", here), source("there", there)]).heights
    assert heights[0].sigma_m[0] == 20.0 and heights[1].sigma_m[0] > 400.0


def test_heights_follow_from_elevation_and_vertical_speed() -> None:
    radar = {
        "time_s": [0.0, 0.0],
        "range_m": [50e3, 50e3],
        "bearing_deg": [10.0, 20.0],
        "elevation_deg": [10.0, np.nan],
    }
    errors = SensorErrors(range_m=50.0, bearing_deg=0.1)
    description = Description("radar", "tracks", site=Site(lat_deg=50.0, lon_deg=8.0, height_m=100.0), errors=errors)
    seen = {"time_s": [0.0], "lat_deg": [50.4], "lon_deg": [8.1], "alt_m": [8000.0], "climb_m_per_s": [10.0]}
    scene = Scene.of([(description, Reports.of("radar", "table", radar)), source("ads-b", seen)])
    measured, reported = scene.heights
    # 50 km at 10°: 8 682 m above the sensor, and 190 m of Earth curvature.
    assert measured.height_m[0] == pytest.approx(100.0 + 8682.0 + 190.0, abs=2.0)
    assert measured.sigma_m[0] == pytest.approx(86.0, rel=0.02) and np.isnan(measured.height_m[1])
    later = reported.at(np.array([0]), np.array([6.0]))
    # A plot may be later than the instant, within the exposure of its scan: a warning, and no vertical speed.
    sooner = reported.at(np.array([0]), np.array([-6.0]))
    assert sooner[0, 1:] == pytest.approx(later[0, 1:])
    assert later[0].tolist() == [8060.0, pytest.approx(np.hypot(20.0, 9.0)), 10.0, pytest.approx(np.sqrt(1.5**2 + 6.0))]


@pytest.mark.slow
@pytest.mark.parametrize(("other", "shift_m"), [("pressure_alt_m", 0.0), ("alt_m", 250.0), ("pressure_alt_m", 400.0)])
def test_heights_distinguish_two_aircraft_over_one_place_in_a_live_picture(other: str, shift_m: float) -> None:
    rng = np.random.default_rng(2)
    made = [crossing(rng, "a", "pressure_alt_m"), crossing(rng, "b", other, shift_m, share=0.8)]
    live = LivePicture([description for description, _ in made])
    right, wrong, off = 0, 0, []
    for t in np.arange(10.0, 200.0, 10.0):
        for description, reports in made:
            live.add(
                description.name, reports.where(np.flatnonzero((reports.time_s <= t) & (reports.time_s > t - 10.0)))
            )
        if t in (50.0, 80.0):
            live.register()
        state = live.advance(float(t))
        track, heights = state.scan.track, state.scan.heights
        for members in state.members if t > 80.0 else ():
            ends = [str(track[m])[-1] for m in members if m >= 0]
            if len(ends) == 2:
                right, wrong = right + (ends[0] == ends[1]), wrong + (ends[0] != ends[1])
                off += [heights[m, 0] - (3000.0 + 7000.0 * int(ends[0])) for m in members]
    assert wrong == 0 and right >= 20
    # The offset estimated from the last minutes is removed; the rest is error.
    assert np.nanmax(np.abs(off)) < (120.0 if shift_m else 80.0)


def test_gliders_in_one_thermal_do_not_make_an_offset_of_their_distances_in_height() -> None:
    """Nine with FLARM above each other, of which three have ADS-B: most pairs within the errors are of two of them."""
    rng = np.random.default_rng(3)
    times, gliders = np.arange(0.0, 1500.0, 5.0), np.arange(9)
    turn = rng.uniform(0.0, 6.3, 9)[:, None] + rng.uniform(0.1, 0.3, 9)[:, None] * times
    radius_m = rng.uniform(90.0, 180.0, (9, 1, 1))
    place = radius_m * np.stack([np.sin(turn), np.cos(turn)], axis=2) + times[:, None]
    level = 600.0 + 70.0 * gliders[:, None] + rng.uniform(0.8, 1.4, 9)[:, None] * times

    def seen(name: str, who: np.ndarray, shift_m: float):
        where = place[who] + rng.normal(0.0, 4.0, (len(who), len(times), 2))
        return source(name, {
            "time_s": np.tile(times, len(who)), "x_m": where[..., 0].ravel(), "y_m": where[..., 1].ravel(),
            "track_id": np.repeat([f"{name}{k}" for k in who], len(times)), "alt_m": level[who].ravel() + shift_m,
        }, sigma=76.0, height_m=60.0)  # fmt: skip

    heights = Scene.of([seen("flarm", gliders, 0.0), seen("adsb", gliders[::3], 30.0)]).heights[1]
    assert np.abs(heights.height_m - level[::3].ravel()).max() < 10.0
    assert heights.sigma_m.max() < 40.0
