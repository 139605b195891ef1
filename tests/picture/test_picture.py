"""The whole picture: agreement with identify_many, columns, summary, explanations, unusual sources."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from modelled_scenes import WALK, describe, feed, straight, two_meet

from sameas.errors import InputError
from sameas.io.sensors import read_reports
from sameas.many.identify import identify_many
from sameas.many.observations import records_of
from sameas.picture import Picture, Watch, instants
from sameas.picture.picture import object_columns, record_columns
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Description, MissRate, SensorCoverage, SensorErrors, Site, Timing

OBJECTS = """time_s object stage x_m y_m var_x_m2 cov_xy_m2 var_y_m2 vx_m_per_s vy_m_per_s speed_m_per_s course_deg
    n_sources sources members runner_up probability p_runner_up label mmsi icao callsign name mode_a type ambiguous"""
RECORDS = """time_s source row line track_id object p_object p_alone age_s x_m y_m var_x_m2 cov_xy_m2 var_y_m2
    bearing_deg sigma_bearing_deg sensor_x_m sensor_y_m"""
SOLENT = Path(__file__).parents[2] / ".." / "shared" / "data" / "stonesoup_demos" / "SolentAIS_20160112_130211.csv"


def ships(seed=1, n=30, looks=8, names=True):
    """Ships observed by three sources, σ 20 m and 15 m; one in ten is missed in every scan of the plots."""
    rng = np.random.default_rng(seed)
    times = np.arange(looks) * 10.0
    x, v = straight(rng.uniform(-4e3, 4e3, (n, 2)), 4.0 * rng.standard_normal((n, 2)), times)
    track = [str(k) for k in range(n)]
    mmsi = [f"{235000000 + k}" for k in range(n)]
    return [
        feed(rng, describe("radar", "tracks"), times, x, v, 60.0, track if names else None),
        feed(rng, describe("ais", "ais", 15.0), times[::2], x[:, ::2], v[:, ::2], 600.0, mmsi, {"mmsi": mmsi}),
        feed(rng, describe("coast", "marine radar"), times, x[3:], v[3:], 60.0, track[3:] if names else None),
    ], times


def test_one_instant_agrees_with_identify_many():
    sources, times = ships()
    scene = Scene.of(sources)
    now = scene.at(times[3])
    found = identify_many(now.sources, rule=now.rule() + now.identity(), region=now.region)
    state = Watch(evidence=lambda now, memory: now.rule() + now.identity()).advance(now)
    o, r = object_columns(state), record_columns(state)
    assert " ".join(OBJECTS.split()) == " ".join(o) and " ".join(RECORDS.split()) == " ".join(r)
    names = [records_of(source).source for source in now.sources]
    by_set = {
        " ".join(f"{name}:{records_of(s).ids[row]}" for name, s, row in zip(names, now.sources, members, strict=True)
                 if row is not np.ma.masked): p
        for members, p in zip(found.members, found.probability, strict=True)
    }  # fmt: skip
    assert by_set == pytest.approx(dict(zip(o["members"].tolist(), o["probability"].tolist(), strict=True)))
    for s, name in enumerate(names):
        mine, of = r["source"] == name, found.of(s)
        np.testing.assert_allclose(r["p_alone"][mine], of.p_alone, atol=1e-12)
        np.testing.assert_allclose(r["p_object"][mine], of.p_object)
        np.testing.assert_allclose(
            np.column_stack([r["x_m"][mine], r["y_m"][mine]]), records_of(now.sources[s]).features
        )


def test_tracks_of_directions_and_named_tracks_are_a_picture_without_warnings():
    """Warnings are errors here: the precision of a track without a position was computed."""
    sources, times = ships(n=6, looks=3)
    camera = Description("camera", "camera", site=Site(east_m=0.0, north_m=0.0), misses=MissRate(0.2), motion=WALK)
    bearings: dict[str, Any] = {
        "time_s": np.repeat(times, 2),
        "bearing_deg": [20.0, 200.0] * 3,
        "track_id": ["a", "b"] * 3,
    }
    picture = Picture.of(Scene.of([*sources, (camera, Reports.of("camera", "table", bearings))]), times)
    assert {"radar", "ais", "coast", "camera"} == set(picture.records["source"].tolist())


def test_objects_are_more_accurate_than_their_records_and_consistent():
    sources, times = ships(seed=2, n=60)
    rng = np.random.default_rng(2)
    start, velocity = rng.uniform(-4e3, 4e3, (60, 2)), 4.0 * rng.standard_normal((60, 2))
    o = Picture.of(Scene.of(sources), times[[0, 5]]).objects
    several = o["n_sources"] == 3
    who = [int(mmsi) - 235000000 for mmsi in o["mmsi"][several]]
    truth = start[who] + o["time_s"][several][:, None] * velocity[who]
    error = np.column_stack([o["x_m"], o["y_m"]])[several] - truth
    spread = np.array([[o["var_x_m2"], o["cov_xy_m2"]], [o["cov_xy_m2"], o["var_y_m2"]]])[:, :, several]
    square = np.einsum("nv,nvw,nw->n", error, np.linalg.inv(np.moveaxis(spread, 2, 0)), error)
    # Two of the three are smoothed; their common errors are not counted twice, so covariances may be conservative.
    assert 0.4 < square.mean() / 2.0 < 1.2 and np.sqrt(np.mean(error**2)) < 16.0
    assert np.sqrt(np.mean((o["vx_m_per_s"][several] - velocity[who, 0]) ** 2)) < 0.3


def test_the_order_of_sources_changes_nothing():
    sources, times = ships(seed=3)
    one, other = (Picture.of(Scene.of(given), times[:5]) for given in (sources, sources[::-1]))
    sets = []
    for picture in (one, other):
        o = picture.objects
        sets.append([(t, n, *sorted(m.split()), s, c) for t, n, m, s, c in zip(
            o["time_s"].tolist(), o["object"].tolist(), o["members"].tolist(), o["stage"].tolist(),
            o["label"].tolist(), strict=True)])  # fmt: skip
    assert sets[0] == sets[1]
    np.testing.assert_allclose(one.objects["x_m"], other.objects["x_m"], atol=1e-6)
    np.testing.assert_allclose(one.objects["probability"], other.objects["probability"], atol=1e-9)


def test_plots_without_ids_are_followed_too():
    sources, times = ships(seed=4, names=False)
    o = Picture.of(Scene.of(sources), times).objects
    assert len(set(o["object"].tolist())) == 30
    # Objects on radar only have no identity, and their speed is estimated from positions.
    assert all(len(set(o["object"][o["mmsi"] == mmsi].tolist())) == 1 for mmsi in set(o["mmsi"].tolist()) - {""})


def test_one_source_or_none_makes_a_picture():
    sources, times = ships(seed=5)
    picture = Picture.of(Scene.of(sources[1:2]), times)
    assert set(picture.objects["n_sources"].tolist()) == {1} and set(picture.records["p_alone"].tolist()) == {1.0}
    assert set(picture.objects["object"].tolist()) == set(range(1, 31)) and not picture.texts
    assert picture.summary.lines()[0] == "objects: 30 confirmed"
    early = Picture.of(Scene.of(sources), [-20.0, -10.0, 0.0])
    assert (early.objects["time_s"] == 0.0).all() and len(early.objects["object"]) == 30
    nothing = Picture.of(Scene.of(sources), [-20.0])
    assert {len(column) for column in [*nothing.objects.values(), *nothing.records.values()]} == {0}
    assert nothing.summary.lines()[:2] == [
        "objects: 0 confirmed",
        "confidence: of 0 objects per instant none are expected to be wrong; no groups of neighbours are ambiguous",
    ]


def test_the_summary_states_position_errors():
    sources, times = ships(seed=8)
    picture = Picture.of(Scene.of(sources), [*times, times[-1] + 20.0, times[-1] + 60.0])
    o, places = picture.objects, picture.summary.places
    confirmed = o["stage"] == "confirmed"
    both = np.ma.sqrt(0.5 * (o["var_x_m2"] + o["var_y_m2"]))[confirmed].compressed()
    assert places.shown_m == np.median(both)
    assert places.coasting == np.mean([np.sum(o["stage"][o["time_s"] == t] == "coasting") for t in picture.instants_s])
    line = next(line for line in picture.summary.lines() if line.startswith("places"))
    assert line.startswith(f"places: known to {places.shown_m:.2g} m (1σ, the median object)")
    assert ("coast without" in line) == (places.coasting > 0.0)
    # Coasting objects have larger errors.
    assert places.coasting_m is None or places.coasting_m > places.shown_m


def test_a_source_may_begin_late_and_fall_silent():
    sources, times = ships(seed=6, looks=12)
    late = sources[2][1].where((sources[2][1].time_s >= 40.0) & (sources[2][1].time_s < 70.0))
    picture = Picture.of(Scene.of([*sources[:2], (sources[2][0], late)]), times)
    o = picture.objects
    three = {t: int(np.sum(o["n_sources"][o["time_s"] == t] == 3)) for t in times.tolist()}
    assert three[30.0] == 0 and three[40.0] >= 25
    assert len(set(o["object"].tolist())) == 30


def test_bearings_are_used_and_are_no_position_alone():
    camera = Description(
        "camera", "camera", site=Site(east_m=0.0, north_m=0.0), misses=MissRate(0.2), motion=WALK,
        coverage=SensorCoverage(range_m=3000.0), errors=SensorErrors(bearing_deg=0.5, extent_m=3.0),
    )  # fmt: skip
    bearings = {"time_s": [0.0] * 3 + [10.0] * 3, "bearing_deg": [45.2, 120.0, 359.5] * 2}
    rng = np.random.default_rng(7)
    x, v = straight([[700.0, 700.0], [0.0, 1000.0]], [[0.0, 0.0]] * 2, np.array([0.0, 10.0]))
    radar = feed(rng, describe("radar", "tracks"), np.array([0.0, 10.0]), x, v, 60.0, ["1", "2"])
    picture = Picture.of(Scene.of([radar, (camera, Reports.of("camera", "table", bearings))]), [0.0, 10.0])
    o, r = picture.objects, picture.records
    both, alone = o["n_sources"] == 2, o["sources"] == "camera"
    assert both.sum() == 4 and alone.sum() == 2
    assert np.ma.getmaskarray(o["x_m"])[alone].all() and not np.ma.getmaskarray(o["x_m"])[both].any()
    # The camera reduces the radar's error across the line of sight.
    assert np.all(o["var_x_m2"][both] + o["var_y_m2"][both] < 2 * 20.0**2)
    seen = r["source"] == "camera"
    assert (np.ma.getmaskarray(r["bearing_deg"]) == ~seen).all() and np.ma.getmaskarray(r["x_m"])[seen].all()
    assert len(set(o["object"].tolist())) == 3


def eye(name: str, times: np.ndarray, bearing_deg: np.ndarray, track: str) -> tuple[Description, Reports]:
    """A camera at the origin with the directions of one track."""
    camera = Description(
        name, "camera", site=Site(east_m=0.0, north_m=0.0), misses=MissRate(0.2), motion=WALK,
        coverage=SensorCoverage(range_m=3000.0), errors=SensorErrors(bearing_deg=0.3, extent_m=1.0),
        timing=Timing(period_s=1.0),
    )  # fmt: skip
    columns: dict[str, Any] = {"time_s": times, "bearing_deg": bearing_deg % 360.0, "track_id": [track] * len(times)}
    return camera, Reports.of(name, "table", columns)


def test_an_object_that_only_a_direction_shows_keeps_its_place():
    times = np.arange(0.0, 40.0, 1.0)
    x, v = straight([[-300.0, 400.0]], [[8.0, 0.0]], times)
    rng = np.random.default_rng(2)
    bearing = np.degrees(np.arctan2(*x[0].T)) + 0.3 * rng.standard_normal(len(times))
    description, reports = feed(rng, describe("radar", "tracks"), times, x, v, 5.0, ["7"])
    radar = description, reports.where(reports.time_s < 20.0)
    picture = Picture.of(Scene.of([radar, eye("camera", times, bearing, "c1")]), times)
    o = picture.objects
    last = o["time_s"] == 39.0
    assert o["stage"][last].tolist() == ["confirmed"] and o["sources"][last].tolist() == ["camera"]
    apart = np.array([float(o["x_m"][last][0]), float(o["y_m"][last][0])]) - x[0, -1]
    terms = [float(o[name][last][0]) for name in ("var_x_m2", "cov_xy_m2", "cov_xy_m2", "var_y_m2")]
    covariance = np.reshape(terms, (2, 2))
    assert np.hypot(*apart) < 40.0 and apart @ np.linalg.solve(covariance, apart) < 9.0
    assert set(o["object"].tolist()) == {1}


def test_an_object_without_a_place_does_not_coast():
    times = np.arange(0.0, 40.0, 1.0)
    x, v = straight([[-300.0, 400.0]], [[8.0, 0.0]], times)
    radar = feed(np.random.default_rng(2), describe("radar", "tracks"), times, x, v, 5.0, ["7"])
    beside = eye("camera", times[times < 10.0], np.full(10, 170.0), "c1")
    o = Picture.of(Scene.of([radar, beside]), times).objects
    of_camera = o["object"] == o["object"][o["sources"] == "camera"][0]
    assert np.isin(o["stage"][of_camera], ["tentative", "confirmed", "coasting", "ended"]).all()
    assert o["time_s"][of_camera].max() < 25.0


def test_rows_and_lines_lead_back_to_the_file():
    sources, times = ships(seed=8)
    description, reports = sources[1]
    moved_lines = replace(reports, line=reports.line + 100)
    picture = Picture.of(Scene.of([sources[0], (description, moved_lines)]), times[:2])
    r = picture.records
    mine = r["source"] == "ais"
    assert (r["line"][mine] == moved_lines.line[r["row"][mine]]).all()
    assert (r["track_id"][mine] == reports.track_id[r["row"][mine]].astype(str)).all()
    assert (r["age_s"][mine] == r["time_s"][mine] - reports.time_s[r["row"][mine]]).all()


def test_degrees_are_given_if_the_plane_is_on_the_earth():
    rng = np.random.default_rng(9)
    columns = {"time_s": np.zeros(5), "lat_deg": 50.8 + 0.01 * rng.random(5), "lon_deg": 179.995 + 0.01 * np.arange(5)}
    reports = Reports.of("ais", "ais", columns | {"mmsi": [str(k) for k in range(1, 6)]})
    picture = Picture.of(Scene.of([(Description("ais", "ais"), reports)]), [0.0])
    order = np.argsort(picture.objects["mmsi"].astype(int))
    np.testing.assert_allclose(picture.objects["lat_deg"][order], reports.lat_deg, atol=1e-9)
    np.testing.assert_allclose(picture.objects["lon_deg"][order], reports.lon_deg, atol=1e-9)
    assert "lat_deg" in picture.records and picture.plane is not None


def test_speeds_and_courses_are_those_at_the_place_of_an_object():
    """Courses of aircraft 500 km from the middle were off by five degrees: north there is not the plane's."""
    lon = np.array([-8.0, 0.0, 8.0])
    columns: dict[str, Any] = {
        "time_s": np.zeros(3), "lat_deg": np.full(3, 52.0), "lon_deg": lon, "icao": ["4b00", "4b01", "4b02"],
        "speed_m_per_s": np.full(3, 200.0), "course_deg": np.full(3, 90.0),
    }  # fmt: skip
    objects = Picture.of(Scene.of([(Description("adsb", "ads-b"), Reports.of("adsb", "adsb", columns))]), [0.0]).objects
    np.testing.assert_allclose(objects["course_deg"], 90.0, atol=1e-3)
    np.testing.assert_allclose(objects["speed_m_per_s"], 200.0, rtol=1e-3)
    assert np.ptp(objects["vy_m_per_s"]) > 40.0


@pytest.mark.slow
def test_explanations_use_object_numbers_and_come_when_records_change():
    scene, times = two_meet(1, 60.0)
    picture = Picture.of(scene, times)
    for (k, number), text in picture.texts.items():
        assert text.startswith(f"Object {number} is ")
        assert number in picture.objects["object"][picture.objects["time_s"] == times[k]]
    assert {number for _, number in picture.texts} == {1, 2} and len(picture.texts) < 2 * len(times)
    state = Watch().advance(scene.at(0.0))
    assert "probability" in str(state.explain(1))
    with pytest.raises(InputError, match="object 9 is not shown"):
        state.explain(9)


def test_the_summary_lists_the_important_facts():
    sources, times = ships(seed=10)
    rng = np.random.default_rng(10)
    # Of the third, half is taken away, and it lies elsewhere.
    description, reports = sources[2]
    kept = reports.where(np.isin(reports.track_id, [str(k) for k in range(3, 16)]))
    forged: dict[str, Any] = {"time_s": [0.0], "x_m": [9e3], "y_m": [9e3], "mmsi": ["235000001"], "track_id": ["x"]}
    elsewhere = describe("elsewhere", "tracks"), Reports.of("elsewhere", "table", forged)
    never = feed(rng, describe("never", "tracks"), np.array([900.0, 910.0]), *straight([[0.0, 0.0]], [[0.0, 0.0]],
                 np.array([0.0, 10.0])), 0.0, ["1"])  # fmt: skip
    picture = Picture.of(Scene.of([*sources[:2], (description, kept), elsewhere, never]), times, biases=("radar: 2°",))
    summary, told_lines = picture.summary, "\n".join(picture.summary.lines())
    assert summary.by_sources[2] > 10 and summary.by_sources[3] > 5 and summary.instants == len(times)
    misses = {one.source: one.share for one in summary.misses}
    assert abs(misses["coast"] - 17 / 30) < 0.05 and misses["radar"] < 0.1
    assert summary.alarms[0].alarm.value == "235000001" and summary.alarms[0].instants == len(times)
    assert summary.alarms[0].alarm.second == ("elsewhere", 0) or summary.alarms[0].alarm.first == ("elsewhere", 0)
    for words in ("radar: 2°", "elsewhere shares no object", "never has no report", "coast misses ",
                  "assumed for tracks"):  # fmt: skip
        assert words in told_lines, words


def test_excluded_stale_reports_are_reported():
    columns: dict[str, Any] = {
        "time_s": [0.0, 0.0, 900.0],
        "x_m": [0.0, 900.0, 900.0],
        "y_m": [0.0] * 3,
        "mmsi": ["1", "2", "2"],
    }
    ais = describe("ais", "ais", clutter_per_km2=0.0)
    picture = Picture.of(Scene.of([(ais, Reports.of("ais", "ais", columns))]), [0.0, 300.0, 900.0, 2500.0])
    stages = picture.objects["stage"][picture.objects["mmsi"] == "1"].tolist()
    assert stages[0] == "confirmed" and stages[-1] == "ended"


@pytest.mark.slow
def test_no_ghost_of_real_traffic_appears():
    if not SOLENT.exists():
        pytest.skip("needs the Solent AIS log of Stone Soup's demos")
    (reports,) = read_reports(SOLENT)
    scene = Scene.of([(Description("ais", "ais"), reports)])
    first = scene.span_s[0]
    o = Picture.of(scene, instants((first + 60.0, first + 900.0), 60.0)).objects
    names = set(o["mmsi"].tolist())
    assert len(names) > 60
    assert all(len(set(o["object"][o["mmsi"] == mmsi].tolist())) == 1 for mmsi in names)
    assert "coasting" not in o["stage"].tolist()


def test_invalid_instants_and_pictures_are_refused():
    assert instants((0.0, 25.0), 10.0).tolist() == [0.0, 10.0, 20.0]
    with pytest.raises(InputError, match="every_s is 0"):
        instants((0.0, 1.0), 0.0)
    with pytest.raises(InputError, match="give a longer every_s"):
        instants((0.0, 1e9), 1e-3)
    with pytest.raises(InputError, match="first and the last time"):
        instants((5.0, 1.0), 1.0)
    scene, times = two_meet(0, 100.0)
    for wrong in ([], [10.0, 10.0], [np.nan]):
        with pytest.raises(InputError, match="one instant or more"):
            Picture.of(scene, wrong)
    with pytest.raises(InputError, match="instants in the order of time"):
        Picture.of(scene, [0.0], watch=Picture.of(scene, times[:3]).watch)
