"""Texts of a picture name records by track and line, and mention more probable rivals."""

from dataclasses import replace

import numpy as np
import pytest

from sameas.many.objects import ObjectExplanation, Rival
from sameas.picture.picture import Picture
from sameas.picture.summary import share_error
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Description, MissRate, SensorErrors, Site


def test_the_standard_error_of_the_miss_share_agrees_with_trials():
    """Correlated scans: an object missed once is missed in the next three scans too."""
    rng, pulls = np.random.default_rng(4), []
    for _ in range(300):
        due = np.repeat(rng.integers(3, 9, 60), 4).astype(np.float64)
        missed = np.repeat(rng.binomial(due[::4].astype(np.int64), 0.2), 4).astype(np.float64)
        pulls.append((missed.sum() / due.sum() - 0.2) / share_error(due, missed))
    assert abs(np.mean(pulls)) < 0.25 and 0.9 < np.std(pulls) < 1.3
    assert share_error(due[:1], missed[:1]) is None
    assert share_error(np.full(24, 6.0), np.full(24, 1.0)) > 0.02


def crossing(seed=4):
    """Three vessels seen by a radar that numbers them and by a camera that does not; two cross in the camera's view."""
    rng = np.random.default_rng(seed)
    place = np.array([[-60.0, 400.0], [60.0, 420.0], [300.0, 300.0]])
    speed = np.array([[3.0, 0.0], [-3.0, 0.0], [0.0, 2.0]])
    plots, bearings = [], []
    for t in np.arange(0.0, 40.0, 2.0):
        for k, (east, north) in enumerate(place + speed * t + 3.0 * rng.normal(size=(3, 2))):
            plots.append((t, k + 5, east, north))
        for east, north in (place + speed * t)[rng.permutation(3)[:2]]:
            bearings.append((t + 0.5, np.degrees(np.arctan2(east, north)) + rng.normal()))
    time_s, number, x_m, y_m = np.transpose(plots)
    columns = {"time_s": time_s, "track_id": number.astype(int), "x_m": x_m, "y_m": y_m}
    radar = Reports.of("radar", "table", columns | {"line": np.arange(2, len(plots) + 2)})
    time_s, bearing = np.transpose(bearings)
    columns = {"time_s": time_s, "bearing_deg": bearing % 360.0, "line": np.arange(2, len(bearings) + 2)}
    camera = Reports.of("camera", "table", columns)
    at = Site(east_m=0.0, north_m=0.0)
    return [
        (
            Description("radar", "marine radar", site=at, errors=SensorErrors(position_m=4.0), misses=MissRate(0.05)),
            radar,
        ),
        (Description("camera", "camera", site=at), camera),
    ]


@pytest.mark.slow
def test_explanations_and_identities_name_the_same_tracks_and_lines():
    picture = Picture.of(Scene.of(crossing()), np.arange(1.0, 39.0, 2.0))
    r, o = picture.records, picture.objects
    assert picture.texts
    for (k, number), text in picture.texts.items():
        now = r["time_s"] == picture.instants_s[k]
        for row in np.flatnonzero(now & (r["object"] == number)):
            name = r["track_id"][row] or f"line {r['line'][row]}"
            assert f"{r['source'][row]} {name}" in text.splitlines()[0]
        shown = (o["time_s"] == picture.instants_s[k]) & (o["object"] == number)
        better = float(np.ma.filled(o["p_runner_up"], 0.0)[shown][0]) > float(o["probability"][shown][0])
        assert ("By itself" in text) == better


def test_a_more_probable_rival_is_reported():
    camera, radar = ("camera", "line 3"), ("radar", "5")
    rival = Rival((radar,), 0.51, 0.0, {}, (), chosen=False)
    chosen = Rival((camera, radar), 0.49, 3.0, {"position": 3.0}, (), chosen=True)
    sentence = "By itself radar 5 is more probable; the answer is the most probable for all records together."
    assert sentence in str(ObjectExplanation(2, 0, 3, True, (rival, chosen))).splitlines()
    assert "By itself" not in str(ObjectExplanation(2, 0, 3, True, (chosen, replace(rival, probability=0.48))))


@pytest.mark.slow
def test_a_plot_without_id_is_explained_at_every_scan():
    times = np.arange(1.0, 39.0, 2.0)
    picture = Picture.of(Scene.of(crossing()), times)
    r = picture.records
    for k, instant_s in enumerate(times):
        seen = r["object"][(r["time_s"] == instant_s) & (r["source"] == "camera")]
        shared = [n for n in seen.tolist() if np.sum((r["time_s"] == instant_s) & (r["object"] == n)) > 1]
        assert all((k, number) in picture.texts for number in shared)


def test_ships_are_not_missed_by_a_receiver_of_aircraft():
    """With nineteen ships and one aircraft, ADS-B missed 95 % of the others' objects."""
    times = np.arange(0.0, 60.0, 5.0)

    def source(name, kind, tracks):
        rows = [(t, 4000.0 * k + v * t, 9000.0 * k, v, 0.0, f"{k}") for t in times for k, v in tracks]
        columns = dict(
            zip(("time_s", "x_m", "y_m", "vx_m_per_s", "vy_m_per_s", "track_id"), zip(*rows, strict=True), strict=True)
        )
        return Description(name, kind, errors=SensorErrors(position_m=10.0)), Reports.of(name, "table", columns)

    ships, flight = [(k, 5.0) for k in range(1, 6)], [(0, 200.0)]
    scene = Scene.of([source("ais", "ais", ships), source("tracker", "tracks", ships), source("adsb", "ads-b", flight)])
    misses = {one.source: one for one in Picture.of(scene, times[1:]).summary.misses}
    assert "adsb" not in misses or misses["adsb"].due == 0
    assert misses["tracker"].due > 0
    # Ships without AIS are only seen by radars; an aircraft that they see is missed by ADS-B, and not by AIS.
    scene = Scene.of([
        source("ais", "ais", ships[:2]), source("adsb", "ads-b", [(9, 150.0)]),
        *(source(f"coast {k}", "tracks", ships) for k in range(2)),
        *(source(f"airport {k}", "tracks", [(k, 200.0) for k in (0, 10, 11)]) for k in range(2)),
    ])  # fmt: skip
    misses = {one.source: one for one in Picture.of(scene, times[1:]).summary.misses}
    assert (misses["adsb"].due, misses["adsb"].share) == (3 * (len(times) - 1), 1.0)
    assert misses["ais"].due == 5 * (len(times) - 1) and misses["ais"].share == pytest.approx(0.6)


@pytest.mark.parametrize("kind", ["ads-b", "drone"])
def test_a_glider_without_a_name_is_called_by_her_tracker(kind):
    """A page of the Open Glider Network listed #7 and #8: nobody found the glider that was asked for."""
    rows = [(t, 3000.0 * k, 5.0 * t, *ids) for t in range(0, 60, 10) for k, ids in enumerate(
        [("dde626", None, None), ("3c0001", "3c0001", "CHRIS1")])]  # fmt: skip
    names = ("time_s", "x_m", "y_m", "track_id", "icao", "callsign")
    columns = dict(zip(names, zip(*rows, strict=True), strict=True))
    picture = Picture.of(Scene.of([(Description("ogn", kind), Reports.of("ogn", "ogn", columns))]), [50.0])
    assert sorted(picture.objects["label"].tolist()) == ["CHRIS1", "DDE626"]


def test_mmsi_0_names_no_ship():
    """The buoys of fishing nets send it: their objects had one label, and were one vessel in Signal K."""
    times = np.arange(0.0, 60.0, 10.0)
    rows = [(t, 3000.0 * k, 5.0 * t, mmsi) for t in times for k, mmsi in enumerate(["000000000"] * 2 + ["235000001"])]
    columns = dict(zip(("time_s", "x_m", "y_m", "mmsi"), zip(*rows, strict=True), strict=True))
    picture = Picture.of(Scene.of([(Description("ais", "ais"), Reports.of("ais", "ais", columns))]), [50.0])
    assert (
        sorted(picture.objects["label"].tolist()) == sorted(picture.objects["mmsi"].tolist()) == ["", "", "235000001"]
    )
