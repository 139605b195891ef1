"""Object numbers are kept; objects appear, are confirmed, coast and end; noise does not switch records."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from modelled_scenes import describe, feed, straight, two_meet

from sameas.errors import InputError
from sameas.picture import Picture, Stages, Watch, instants, picture_states
from sameas.picture.object_ids import NamedObjects
from sameas.picture.tuning import Tuning
from sameas.tracks.reports import Reports, joined
from sameas.tracks.scene import Feed, Scene
from sameas.tracks.source import Description, Motion, SensorErrors, Site, Timing

ALONE = Watch(evidence=lambda now, memory: now.rule() + now.identity(), bound=1.0)


def memberships(picture):
    """For each instant {source and last letter of the track} of every object with records."""
    r = picture.records
    names = [f"{s} {t[-1]}" for s, t in zip(r["source"].tolist(), r["track_id"].tolist(), strict=True)]
    out = [{} for _ in picture.instants_s]
    for name, at, number in zip(names, np.searchsorted(picture.instants_s, r["time_s"]), r["object"], strict=True):
        out[at][int(number)] = out[at].get(int(number), frozenset()) | {name}
    return out


def changes(picture):
    """How often the records grouped together differ from those of the previous instant."""
    return sum(a != b for a, b in pairwise(frozenset(each.values()) for each in memberships(picture)))


#: 2 σ apart, σ of the difference of two positions of 20 m each.
TWO_SIGMA_M = 2.0 * 20.0 * np.sqrt(2.0)


@pytest.mark.slow
def test_crossing_objects_keep_their_records():
    right = {frozenset({"radar 0", "ais 0"}), frozenset({"radar 1", "ais 1"})}
    for seed in range(20):
        scene, times = two_meet(seed, TWO_SIGMA_M)
        assert all(set(each.values()) == right for each in memberships(Picture.of(scene, times[10:21])))


@pytest.mark.slow
def test_objects_side_by_side_switch_only_with_evidence():
    with_memory = without = 0
    for seed in range(8):
        scene, times = two_meet(seed, TWO_SIGMA_M, side_by_side=True, tau_s=0.0)
        with_memory += changes(Picture.of(scene, times[:16]))
        without += changes(Picture.of(scene, times[:16], watch=ALONE))
    assert with_memory <= 0.5 * without and without >= 5


@pytest.mark.slow
def test_crossing_objects_keep_their_numbers():
    for seed in range(6):
        scene, times = two_meet(seed, 40.0)
        o = Picture.of(scene, times[8:23]).objects
        assert set(o["object"].tolist()) == {1, 2}
        for number in (1, 2):
            assert len(set(o["mmsi"][o["object"] == number].tolist())) == 1


@pytest.mark.slow
def test_a_picture_corrects_track_swaps_of_a_radar():
    mended = 0
    for seed in range(6):
        scene, times = two_meet(seed, 60.0, swap_s=150.0)
        picture = Picture.of(scene, times[10:25])
        mended += set(memberships(picture)[-1].values()) == {
            frozenset({"radar 0", "ais 1"}), frozenset({"radar 1", "ais 0"}),
        }  # fmt: skip
        o = picture.objects
        # The numbers stay with the unique ids.
        assert all(len(set(o["object"][o["mmsi"] == mmsi].tolist())) == 1 for mmsi in ("235000000", "235000001"))
    assert mended == 6


def plots(looks):
    """A scene of a radar with false echoes: scans as {time: positions}, empty scans included."""
    radar = describe("radar", "marine radar", period_s=10.0, clutter_per_km2=0.05)
    rows = [(t, *p) for t, places in looks.items() for p in places]
    columns = dict(zip(("time_s", "x_m", "y_m"), np.array(rows, float).reshape(-1, 3).T, strict=True))
    columns["range_m"] = None
    columns = {name: column for name, column in columns.items() if column is not None}
    reports = Reports.of("radar", "table", columns)
    return Scene((Feed.of(radar, reports, scan_times_s=sorted(looks)),))


@pytest.mark.slow
def test_an_object_appears_is_confirmed_coasts_and_ends():
    there = [(1000.0 + 5.0 * t, 0.0) for t in range(0, 1400, 10)]
    looks = {10.0 * k: [there[k]] + [(float(5000 + 40 * j), 3e3) for j in range(3)] for k in range(6)}
    looks |= {10.0 * k: [(float(5000 + 40 * j), 3e3) for j in range(3)] for k in range(6, 140)}
    # A false echo in one scan.
    looks[20.0] = [*looks[20.0], (-8e3, -8e3)]
    picture = Picture.of(plots(looks), sorted(looks), watch=Watch())
    o = picture.objects
    first = o["object"] == o["object"][np.argmin(np.hypot(o["x_m"] - 1000.0, o["y_m"]))]
    assert o["stage"][first][:4].tolist() == ["tentative", "tentative", "tentative", "confirmed"]
    after = o["stage"][first][6:]
    assert set(after[:-1].tolist()) == {"coasting"} and after[-1] == "ended"
    spread = np.asarray(o["var_x_m2"][first][6:])
    assert (np.diff(spread) > 0).all() and o["n_sources"][first][6:].max() == 0
    # Extrapolated at the estimated 5 m/s to the east.
    coasting = np.flatnonzero(first)[8]
    assert abs(o["x_m"][coasting] - (1000.0 + 5.0 * o["time_s"][coasting])) < 4.0 * np.sqrt(o["var_x_m2"][coasting])
    false = np.asarray(o["x_m"] < -7e3)
    # Until it is improbable, it is kept; it is shown while a scan shows it.
    assert o["stage"][false].tolist() == ["tentative"]


def test_transponders_and_two_agreeing_sources_are_confirmed_at_once():
    scene, times = two_meet(0, 500.0)
    assert set(Picture.of(scene, times[:1]).objects["stage"].tolist()) == {"confirmed"}
    watch = Watch(stages=Stages(scans=1, of=1, real=0.1))
    looks = {0.0: [(0.0, 0.0)], 10.0: [(0.0, 0.0)]}
    assert Picture.of(plots(looks), [0.0], watch=watch).objects["stage"].tolist() == ["confirmed"]
    assert Picture.of(plots(looks), [0.0]).objects["stage"].tolist() == ["tentative"]


@pytest.mark.slow
@pytest.mark.parametrize(("hours", "kept_h", "same"), [(0.5, 24.0, True), (2.0, 24.0, True), (2.0, 1.5, False)])
@pytest.mark.long_after(1)
def test_an_identified_object_that_returns_gets_its_old_number(hours, kept_h, same):
    rng, away_s = np.random.default_rng(5), 3600.0 * hours
    early, late = np.arange(0.0, 100.0, 10.0), np.arange(away_s, away_s + 100.0, 20.0)
    x, v = straight([[0.0, 0.0]], [[5.0 / hours, 0.0]], np.concatenate([early, late]))
    others, still = straight(rng.uniform(-400, 400, (12, 2)), np.zeros((12, 2)), np.arange(0.0, away_s + 100.0, 30.0))
    ais, radar = describe("ais", "ais"), describe("radar", "tracks", period_s=30.0)
    scene = Scene.of([
        feed(rng, ais, np.concatenate([early, late]), x, v, 600.0, ["a"], {"mmsi": ["235000001"]}),
        feed(rng, radar, np.arange(0.0, away_s + 100.0, 30.0), others, still, 60.0, [str(k) for k in range(12)]),
    ])  # fmt: skip
    watch = Watch(tuning=Tuning(return_s=3600.0 * kept_h))
    o = Picture.of(scene, instants((0.0, away_s + 90.0), 30.0 if hours < 1.0 else 90.0), watch=watch).objects
    mine = o["mmsi"] == "235000001"
    assert "ended" in o["stage"][mine] and (len(set(o["object"][mine].tolist())) == 1) == same
    assert o["stage"][mine][-1] == "confirmed"


@pytest.mark.long
def test_ids_that_stay_away_are_forgotten_and_with_them_their_history():
    """Every MMSI ever seen was kept: the memory of a watch of weeks grew, and its ticks became slower."""
    rng, times = np.random.default_rng(1), np.arange(0.0, 2001.0, 20.0)
    parts = [
        feed(rng, describe("ais", "ais"), t, *straight([[900.0 * (k % 9), 0.0]], [[0.0, 0.0]], t), 60.0, [f"a{k}"],
             {"mmsi": [f"{235000000 + k}"]})
        for k, t in enumerate(times[:100].reshape(50, 2))
    ]  # fmt: skip
    scene = Scene.of([(parts[0][0], joined([reports for _, reports in parts]))])
    for tuning, least, most in ((Tuning(return_s=200.0), 5, 16), (Tuning(most_absent=8), 8, 18), (Tuning(), 50, 50)):
        tracks = Picture.of(scene, times, watch=Watch(tuning=tuning)).watch
        assert isinstance(tracks, Watch) and isinstance(tracks.objects, NamedObjects)
        known = sum(map(len, tracks.memory.tracks.by_name.values()))
        assert least <= known <= most and len(np.unique(tracks.objects.history.track)) == known


@pytest.mark.slow
def test_an_aircraft_over_a_ship_takes_its_address_and_its_number_along():
    """For some instants an aircraft was one object with a ship below: she kept its address, it stayed tentative."""
    rng, times = np.random.default_rng(2), np.arange(0.0, 401.0, 5.0)
    ship, v_ship = straight([[0.0, 0.0]], [[3.0, 0.0]], times)
    plane, v_plane = straight([[-3_400.0, 0.0]], [[20.0, 0.0]], times)
    radar = feed(rng, describe("radar", "tracks"), times, ship, v_ship, 900.0, ["r"])
    adsb = feed(rng, describe("adsb", "ads-b"), times, plane, v_plane, 400.0, ["4008aa"], {"icao": ["4008aa"]})
    ais = feed(rng, describe("ais", "ais"), times, ship, v_ship, 400.0, ["235000001"], {"mmsi": ["235000001"]})
    o = Picture.of(Scene.of([radar, ais, adsb]), times, watch=ALONE).objects
    together = o["n_sources"] == 3
    assert together.any(), "they were never one object: the scene tests nothing"
    first, last = (set(o["object"][(o["icao"] != "") & (o["time_s"] == t)].tolist()) for t in (times[1], times[-1]))
    assert first == last and len(last) == 1
    [number] = last
    assert o["stage"][(o["object"] == number) & (o["time_s"] == times[-1])].tolist() == ["confirmed"]
    for t in times:
        assert np.count_nonzero(o["icao"][o["time_s"] == t] != "") == 1


def test_a_ship_that_brakes_unusually_hard_keeps_its_number():
    times = np.arange(0.0, 601.0, 60.0)
    rng = np.random.default_rng(6)
    x, v = (np.array(part) for part in straight([[0.0, 0.0]], [[18.0, 0.0]], times))
    x[:, 5:], v[:, 5:] = x[:, 4:5] + [[[300.0, 0.0]]], 0.0
    scene = Scene.of([feed(rng, describe("ais", "ais", 10.0), times, x, v, 600.0, ["a"], {"mmsi": ["235000001"]})])
    o = Picture.of(scene, times).objects
    assert set(o["object"].tolist()) == {1} and set(o["stage"].tolist()) == {"confirmed"}


AIRCRAFT = Motion(4.0, 150.0, manoeuvring_share=0.1)


def airborne(sources, seed, x, v, times, names):
    """A scene of air radars with numbered tracks of aircraft (n, k, 2)."""
    rng = np.random.default_rng(seed)
    described = [replace(describe(source, "air radar", 60.0, 5.0), motion=AIRCRAFT) for source in sources]
    return Scene.of([feed(rng, one, times, x, v, 0.0, names) for one in described])


@pytest.mark.parametrize("sources", [["one"], ["one", "two"]])
def test_an_aircraft_that_turns_in_a_holding_keeps_its_number(sources):
    """At standard rate it is 250 m from where it would be after ten seconds straight on. Others fly beside it."""
    times = np.arange(0.0, 301.0, 5.0)
    angle = times * 115.0 / 2800.0 + np.array([0.0, 2.1, 4.2])[:, None]
    x = 2800.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    v = 115.0 * np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    scene = airborne(sources, 4, x, v, times, ["a", "b", "c"])
    picture = Picture.of(scene, times[4::2])
    r = picture.records
    assert all(len(set(r["object"][r["track_id"] == name].tolist())) == 1 for name in "abc")
    assert len(set(r["object"].tolist())) == 3


def test_a_number_that_a_radar_uses_again_elsewhere_is_of_another_aircraft():
    """After a minute, at 20 km; a manoeuvre does not reach there."""
    times = np.arange(0.0, 301.0, 5.0)
    x, v = (np.array(part) for part in straight([[0.0, 0.0]], [[150.0, 0.0]], times))
    again = times >= 180.0
    x[0, again] = [0.0, 20e3] + (times[again, None] - 180.0) * [0.0, 150.0]
    v[0, again] = [0.0, 150.0]
    seen = (times < 120.0) | again
    scene = airborne(["one", "two"], 5, x[:, seen], v[:, seen], times[seen], ["a"])
    r = Picture.of(scene, np.arange(20.0, 300.0, 10.0)).records
    before, after = (set(r["object"][rows].tolist()) for rows in (r["time_s"] < 125.0, r["time_s"] > 195.0))
    assert len(before) == 1 and len(after) == 1 and before.isdisjoint(after)


def test_an_aircraft_that_no_source_shows_is_lost_within_three_minutes():
    """It coasts at first. A ship on the open sea coasts for much longer."""
    times = np.arange(0.0, 601.0, 5.0)
    others = np.random.default_rng(6).uniform(-9e4, 9e4, (9, 2))
    x, v = straight([[0.0, 0.0], *others], [[200.0, 0.0], *9 * [[150.0, 50.0]]], times)
    scene = airborne(["one"], 6, x, v, times, list("abcdefghij"))
    [radar] = scene.feeds
    gone = (radar.raw_reports.track_id == "a") & (radar.raw_reports.time_s > 200.0)
    scene = Scene.of([(radar.description, radar.raw_reports.where(~gone))])
    o = Picture.of(scene, np.arange(50.0, 600.0, 10.0)).objects
    number = int(o["object"][(o["time_s"] == 100.0) & (np.hypot(o["x_m"] - 20e3, o["y_m"]) < 1e3)][0])
    of_a = o["object"] == number
    coasts = o["time_s"][of_a & (o["stage"] == "coasting")]
    assert 30.0 <= np.ptp(coasts) <= 180.0 and o["stage"][of_a][-1] == "ended"
    assert o["stage"][o["object"] != number].tolist()[-1] == "confirmed"


@pytest.mark.slow
def test_live_and_batch_object_ids_agree():
    scene, times = two_meet(3, 80.0)
    watch, numbers = Watch(), []
    for time_s in times:
        state = watch.advance(scene.at(time_s))
        watch = state.watch
        numbers += state.objects.number.tolist()
    half = Picture.of(scene, times[:15])
    again = Picture.of(scene, times[15:], watch=half.watch)
    assert half.objects["object"].tolist() + again.objects["object"].tolist() == numbers
    assert [m.now.instant_s for m in picture_states(scene, times[:2])] == times[:2].tolist()


def test_invalid_stage_settings_are_refused():
    with pytest.raises(InputError, match="1 ≤ scans ≤ of"):
        Stages(scans=4, of=3)


@pytest.mark.slow_after(1)
def test_fast_objects_that_only_plots_show_are_not_shown_behind():
    """Beside ADS-B of another aircraft. Plots some seconds old, taken for positions now with the error of any velocity,
    drew the objects back by half a kilometre."""
    rng = np.random.default_rng(6)
    start, velocity = np.array([[-2e4, 5e3], [1e4, -2e4], [3e4, 8e3]]), np.array([[210.0, 20], [-60, 190], [-200, 40]])
    plots = {"time_s": [], "range_m": [], "bearing_deg": []}
    for turn in range(60):
        for k in range(3):
            t = 4.8 * (turn + (np.degrees(np.arctan2(*(start[k] + velocity[k] * 4.8 * turn))) % 360.0) / 360.0)
            east, north = start[k] + velocity[k] * t
            plots["time_s"].append(t)
            plots["range_m"].append(np.hypot(east, north) + 50.0 * rng.normal())
            plots["bearing_deg"].append((np.degrees(np.arctan2(east, north)) + 0.06 * rng.normal()) % 360.0)
    t = np.arange(0.0, 288.0)
    place = start[0] + velocity[0] * t[:, None] + 20.0 * rng.normal(size=(len(t), 2))
    adsb = {"time_s": t, "icao": ["39d300"] * len(t), "track_id": ["39d300"] * len(t), "x_m": place[:, 0],
            "y_m": place[:, 1], "vx_m_per_s": 0 * t + 210.0, "vy_m_per_s": 0 * t + 20.0}  # fmt: skip
    radar = Description("radar", "air radar", site=Site(east_m=0.0, north_m=0.0))
    reported = Description("adsb", "ads-b", errors=SensorErrors(position_m=20.0), timing=Timing(latency_s=0.0))
    scene = Scene.of([(radar, Reports.of("radar", "table", plots)), (reported, Reports.of("adsb", "table", adsb))])
    objects = Picture.of(scene, np.arange(60.0, 288.0, 7.0)).objects
    for k in (1, 2):
        true = start[k] + velocity[k] * np.asarray(objects["time_s"])[:, None]
        off = np.column_stack([objects["x_m"], objects["y_m"]]) - true
        near = np.flatnonzero((np.hypot(*off.T) < 2000.0) & (objects["time_s"] > 100.0))
        number = np.asarray(objects["object"])[near]
        near = near[number == np.bincount(number).argmax()]
        assert len(near) > 0.85 * len(number) and len(near) >= 24
        along = off[near] @ velocity[k] / np.hypot(*velocity[k])
        assert abs(np.mean(along)) < 50.0 and np.abs(along).max() < 400.0
        variance = objects["var_x_m2"][near] + objects["var_y_m2"][near]
        assert 0.15 < np.mean(np.sum(off[near] ** 2, axis=1) / variance) < 1.6
