"""Deception alarms with probabilities: AIS that drifts away or falls silent; none in a correct picture."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from modelled_scenes import describe, feed, straight, watched_live

from sameas.picture.deception import deceptions
from sameas.picture.picture import Picture, instants
from sameas.picture.tuning import Tuning
from sameas.picture.watch import Watch
from sameas.report.picture import found_lines
from sameas.report.prose import ALARM
from sameas.tracks import Description, SensorErrors, Site
from sameas.tracks.faults import source_faults
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene

MMSI = [f"23500000{k}" for k in range(6)]
TIMES = np.arange(0.0, 401.0, 10.0)


def scene(seed=1, **changes):
    return Scene.of(sources(seed, **changes))


def sources(seed=1, drag_m_per_s=0.0, leap_m=0.0, silent_from_s=np.inf, radars=("radar",)):
    """Six ships 1.5 km apart: radars that track them, and AIS; the first ship's drags, leaps, or falls silent."""
    rng = np.random.default_rng(seed)
    start = np.column_stack([1500.0 * np.arange(6), 2000.0 + 300.0 * rng.standard_normal(6)])
    x, v = straight(start, 4.0 * rng.standard_normal((6, 2)), TIMES)
    made = [feed(rng, describe(name, "tracks"), TIMES, x, v, 30.0, [f"{name}{k}" for k in range(6)]) for name in radars]
    false, late = x.copy(), np.maximum(TIMES - 150.0, 0.0)
    false[0, :, 1] += drag_m_per_s * late + leap_m * (late > 0.0)
    ais, reports = feed(rng, describe("ais", "ais"), TIMES, false, v, 300.0, MMSI, {"mmsi": MMSI})
    kept = (reports.track_id != MMSI[0]) | (reports.time_s < silent_from_s)
    return [*made, (ais, reports.where(kept))]


def faults(made):
    return Picture.of(made, instants(made.span_s, 10.0)).summary.faults


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(("drag", "leap"), [(4.0, 0.0), (0.0, 800.0)])
@pytest.mark.parametrize("radars", [("radar",), ("radar", "other")])
def test_ais_that_drifts_away_from_the_radar_position_is_an_alarm(drag, leap, radars):
    (fault,) = faults(scene(drag_m_per_s=drag, leap_m=leap, radars=radars))
    assert (fault.kind, fault.source, fault.track) == ("dragged", "ais", MMSI[0])
    assert fault.probability > 0.95 and 150.0 < fault.first_s < 230.0
    assert f"ais reports {MMSI[0]} at one place" in str(fault) and "probability" in str(fault)


@pytest.mark.parametrize("moves", [False, True])
def test_tracks_that_were_one_object_by_mistake_and_stay_where_they_are_are_no_deception(moves):
    """A moored ship behind a pier, and 80 m from her a track of the radar, whose errors were assumed too large."""
    n, early = len(TIMES), TIMES < 150.0
    place = np.zeros((2, n, 2))
    place[1, :, 1] = 80.0
    place[0, early, 1] = 80.0 if moves else 0.0
    records = {
        "time_s": np.tile(TIMES, 2), "source": np.repeat(["ais", "radar"], n),
        "track_id": np.repeat([MMSI[0], "radar0"], n), "object": np.concatenate([np.full(n, 1), np.where(early, 1, 2)]),
        "x_m": np.ma.MaskedArray(place[:, :, 0].ravel()), "y_m": np.ma.MaskedArray(place[:, :, 1].ravel()),
        **{name: np.ma.MaskedArray(np.tile(np.where(early, 400.0, 40.0), 2)) for name in ("var_x_m2", "var_y_m2")},
    }  # fmt: skip
    found = deceptions(scene().feeds, records)
    assert [(fault.kind, fault.track) for fault in found] == ([("dragged", MMSI[0])] if moves else [])


def test_the_tuning_of_the_watch_decides_which_deceptions_are_alarms():
    made = scene(drag_m_per_s=4.0)
    never = Watch(tuning=Tuning(min_instants=1000))
    assert Picture.of(made, instants(made.span_s, 10.0), watch=never).summary.faults == ()


@pytest.mark.slow
def test_a_second_radar_raises_the_probability_of_deception():
    one, two = (faults(scene(drag_m_per_s=4.0, radars=radars))[0] for radars in (("radar",), ("radar", "other")))
    assert two.log_odds > one.log_odds + 2.0


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("switched_off", [False, True])
@pytest.mark.parametrize(("has_ais", "renumbered_s"), [(True, np.inf), (True, 250.0), (False, np.inf), (False, 250.0)])
def test_a_helicopter_that_leaves_its_ship_or_switches_off_on_board_is_no_alarm(switched_off, has_ais, renumbered_s):
    # The radar still sees the ship, which reports herself or, as a ship of a navy, nothing.
    radar, ais = sources()
    rng, ship = np.random.default_rng(2), ais[1].track_id == MMSI[0]
    x = np.column_stack([ais[1].x_m[ship], ais[1].y_m[ship]])
    v = np.column_stack([ais[1].vx_m_per_s[ship], ais[1].vy_m_per_s[ship]])
    flown = np.maximum(TIMES - 150.0, 0.0)[:, None] * ([0.0, 0.0] if switched_off else [4.0, 12.0])
    positions = np.stack([x + flown, np.full_like(x, -9e3)])
    velocities = np.stack([v + np.gradient(flown, TIMES, axis=0), np.zeros_like(x)])
    adsb = describe("adsb", "ads-b", sigma_m=10.0)
    described, flights = feed(rng, adsb, TIMES, positions, velocities, 300.0, ["48e0a1", "400100"])
    aboard = flights.where((flights.track_id != "48e0a1") | (flights.time_s < 180.0) | (not switched_off))
    ids = radar[1].track_id.copy()
    ids[(ids == "radar0") & (radar[1].time_s > renumbered_s)] = "radar9"
    ais = (ais[0], ais[1] if has_ais else ais[1].where(~ship))
    assert not faults(Scene.of([(radar[0], replace(radar[1], track_id=ids)), ais, (described, aboard)]))


@pytest.mark.slow
def test_an_aircraft_whose_reports_leave_what_radars_see_is_an_alarm():
    rng, n = np.random.default_rng(2), 4
    start, speed = rng.uniform(-9e3, 9e3, (n, 2)), 80.0 * rng.standard_normal((n, 2))
    x, v = straight(start, speed, TIMES)
    false = x.copy()
    false[0, :, 1] += 15.0 * np.maximum(TIMES - 150.0, 0.0)
    radar = feed(rng, describe("radar", "tracks"), TIMES, x, v, 30.0, [f"radar{k}" for k in range(n)])
    names = [f"48e0a{k}" for k in range(n)]
    adsb = feed(rng, describe("adsb", "ads-b"), TIMES, false, v, 300.0, names, {"icao": names})
    assert [(fault.kind, fault.track) for fault in faults(Scene.of([radar, adsb]))] == [("dragged", "48e0a0")]


@pytest.mark.slow_after(1)
def test_a_tracker_that_follows_a_ship_late_on_her_path_is_no_alarm():
    rng = np.random.default_rng(3)
    start = np.column_stack([1500.0 * np.arange(6), 2000.0 + 300.0 * rng.standard_normal(6)])
    true, v = straight(start, 4.0 * rng.standard_normal((6, 2)), TIMES)
    late = true.copy()
    for place, lag_s in ((true, 0.0), (late, 9.0)):
        # Her speed grows by 18 m/s between 200 and 300 s.
        moving = np.maximum(TIMES - lag_s - 200.0, 0.0)
        place[0, :, 1] += np.where(moving < 100.0, 0.09 * moving**2, 18.0 * moving - 900.0)
    v = v.copy()
    v[0, :, 1] += 0.18 * np.clip(TIMES - 200.0, 0.0, 100.0)
    radar = feed(rng, describe("radar", "tracks"), TIMES, late, v, 30.0, [f"radar{k}" for k in range(6)])
    ais = feed(rng, describe("ais", "ais"), TIMES, true, v, 300.0, MMSI, {"mmsi": MMSI})
    assert not faults(Scene.of([radar, ais]))


@pytest.mark.slow
def test_ais_silence_of_a_ship_still_on_radar_is_an_alarm():
    (fault,) = faults(scene(silent_from_s=200.0))
    assert (fault.kind, fault.track) == ("silent", MMSI[0]) and 190.0 <= fault.first_s < 200.1
    assert "has gone silent: radar saw it for" in str(fault)


@pytest.mark.slow
@pytest.mark.parametrize(("stops", "kinds"), [(False, ["silent"]), (True, [])])
def test_a_ship_that_stops_may_pause_for_three_minutes(stops, kinds):
    """At anchor, and below 2 kn with class B, ships report every three minutes instead of every ten seconds."""
    rng = np.random.default_rng(3)
    start = np.column_stack([1500.0 * np.arange(6), 2000.0 + 300.0 * rng.standard_normal(6)])
    x, v = straight(start, np.tile([0.0, 5.0], (6, 1)), TIMES)
    if stops:
        halted = TIMES > 150.0
        x[0, halted], v = x[0, np.argmax(halted)], v.copy()
        v[0] = np.where(halted[:, None], 0.0, [0.0, 5.0])
    radar = feed(rng, describe("radar", "tracks"), TIMES, x, v, 30.0, [f"radar{k}" for k in range(6)])
    ais, reports = feed(rng, describe("ais", "ais"), TIMES, x, v, 300.0, MMSI, {"mmsi": MMSI})
    kept = (reports.track_id != MMSI[0]) | (reports.time_s < 160.0)
    made = Scene.of([radar, (ais, reports.where(kept))])
    assert [fault.kind for fault in faults(made)] == kinds


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("n", [1, 3])
def test_several_ships_that_end_where_nobody_was_received_have_left_the_reception(n):
    """Every aircraft that flew out of the reach of the receiver of ADS-B, within that of the radars, was an alarm."""
    rng, angle = np.random.default_rng(3), np.linspace(0.0, 2.0 * np.pi, 7)[:-1]
    out = np.column_stack([np.cos(angle), np.sin(angle)])
    x, v = straight(1500.0 * out, np.where(np.arange(6)[:, None] < n, 8.0, 0.5) * out, TIMES)
    radar = feed(rng, describe("radar", "tracks"), TIMES, x, v, 30.0, [f"radar{k}" for k in range(6)])
    ais, reports = feed(rng, describe("ais", "ais"), TIMES, x, v, 300.0, MMSI, {"mmsi": MMSI})
    received = reports.where(np.hypot(reports.x_m, reports.y_m) < 3000.0)
    found = [(fault.kind, fault.track) for fault in faults(Scene.of([radar, (ais, received)]))]
    assert found == ([("silent", MMSI[0])] if n == 1 else [])


@pytest.mark.slow
@pytest.mark.parametrize("heard_until_s", [np.inf, 200.0])
def test_a_ship_that_leaves_one_base_station_while_another_receives_her_is_not_silent(heard_until_s):
    """Of three base stations with overlapping coverage, each raised the alarm for every ship that went out of reach."""
    radar, (ais, reports) = sources(silent_from_s=200.0)
    _, received = sources()[1]
    kept = (received.track_id != MMSI[0]) | (received.time_s <= heard_until_s)
    other = replace(ais, name="other"), replace(received.where(kept), source="other")
    found = faults(Scene.of([radar, (ais, reports), other]))
    assert [(fault.kind, fault.source) for fault in found] == ([] if heard_until_s > 400.0 else [("silent", "other")])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"drag_m_per_s": 4.0}, "dragged"),
        ({"leap_m": 800.0}, "dragged"),
        ({"silent_from_s": 200.0}, "silent"),
        ({}, ""),
    ],
)
def test_a_live_picture_finds_deception_too(changes, kind):
    made = sources(radars=("radar", "other"), **changes)
    live = watched_live(made, TIMES)
    assert [(fault.kind, fault.track) for fault in live.faults()] == ([(kind, MMSI[0])] if kind else [])
    assert pickle.loads(pickle.dumps(live)).faults() == ()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_correct_picture_raises_no_alarm(seed):
    assert faults(scene(seed, radars=("radar", "other"))) == ()


@pytest.mark.slow_after(1)
def test_two_ships_that_exchange_their_mmsi_are_one_alarm_which_the_report_prints():
    radar, (ais, reports) = sources()
    track, later = reports.track_id.astype(object), reports.time_s > 200.0
    first, other = track == MMSI[0], track == MMSI[5]
    swapped = np.where(later & first, MMSI[5], np.where(later & other, MMSI[0], track))
    made = Reports.of(ais.name, reports.kind, reports.columns() | {"track_id": swapped, "mmsi": swapped})
    found = Scene.of([radar, (ais, made)])
    summary = Picture.of(found, instants(found.span_s, 10.0)).summary
    (fault,) = summary.faults
    assert (fault.kind, fault.track, fault.first_s) == ("exchanged", MMSI[0], 210.0) and fault.probability > 0.999
    [printed] = [line for line in found_lines(summary) if line.startswith(ALARM)]
    assert f"{MMSI[0]} and {MMSI[5]} change places, 7" in printed


def ais_alone(is_false):
    """Only the AIS, with the first ship 9 km off where ``is_false`` of the times."""
    _, (ais, reports) = sources()
    columns = dict(reports.columns())
    columns["y_m"] = columns["y_m"] + np.where((reports.track_id == MMSI[0]) & is_false(reports.time_s), 9000.0, 0.0)
    return faults(Scene.of([(ais, Reports.of(ais.name, reports.kind, columns))]))


@pytest.mark.slow
def test_a_jump_is_found_without_a_radar_and_one_false_position_is_none():
    assert not ais_alone(lambda time_s: time_s == 200.0)
    (fault,) = ais_alone(lambda time_s: time_s > 200.0)
    assert (fault.kind, fault.track) == ("jumped", MMSI[0])
    assert f"{MMSI[0]} jumps by 9" in str(fault) and "faster than it can move: another sender" in str(fault)


@pytest.mark.parametrize("states_speed", [True, False])
def test_a_helicopter_that_states_her_speed_does_not_jump(states_speed):
    # She hovers, is not heard for a minute in which she flies 3.6 km, and hovers again.
    time_s = np.concatenate([np.arange(0.0, 200.0, 10.0), [260.0], np.arange(270.0, 470.0, 10.0)])
    x_m = np.where(time_s < 260.0, 0.0, 3600.0)
    speed = np.where(np.isin(time_s, [190.0, 260.0]) & states_speed, 60.0, 0.0)
    columns = {"time_s": time_s, "x_m": x_m, "y_m": np.zeros(len(time_s)), "speed_m_per_s": speed}
    columns |= {"course_deg": np.full(len(time_s), 90.0), "mmsi": np.full(len(time_s), "111232001")}
    reports = Reports.of("ais", "ais", columns)
    found = faults(Scene.of([(Description("ais", "ais", errors=SensorErrors(position_m=10.0)), reports)]))
    assert [fault.kind for fault in found] == ([] if states_speed else ["jumped"])


def test_ships_that_exchange_their_mmsi_back_are_a_second_alarm():
    _, (ais, reports) = sources()
    track, swapped = reports.track_id.astype(object), (reports.time_s > 120.0) & (reports.time_s <= 280.0)
    names = np.where(swapped & (track == MMSI[0]), MMSI[5], np.where(swapped & (track == MMSI[5]), MMSI[0], track))
    columns = reports.columns() | {"track_id": names, "mmsi": names}
    found = faults(Scene.of([(ais, Reports.of(ais.name, reports.kind, columns))]))
    assert [(fault.kind, fault.first_s) for fault in found] == [("exchanged", 130.0), ("exchanged", 290.0)]


def of_a_tracker(seed, jump_s, ships=8):
    """The feeds of a radar's plots with track numbers, over ten minutes; from the middle on its clock is ahead."""
    rng = np.random.default_rng(seed)
    place, speed, plots = rng.uniform(-6e3, 6e3, (ships, 2)), rng.normal(0.0, 5.0, (ships, 2)), []
    for t in np.arange(0.0, 600.0, 3.0):
        weave = np.column_stack([60.0 * np.sin(t / 60.0 + np.arange(ships)), np.zeros(ships)])
        east, north = (place + speed * t + weave * (seed % 2)).T
        for k in np.flatnonzero(rng.random(ships) < 0.9):
            distance, bearing = np.hypot(east[k], north[k]), np.degrees(np.arctan2(east[k], north[k]))
            plot = distance + 20.0 * rng.normal(), bearing + 0.3 * rng.normal()
            plots.append((t + (jump_s if t > 300.0 else 0.0), *plot, f"{k}"))
    columns = dict(zip(("time_s", "range_m", "bearing_deg", "track_id"), zip(*plots, strict=True), strict=True))
    errors = SensorErrors(range_m=20.0, range_share=0.0, bearing_deg=0.3, extent_m=5.0)
    radar = Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0), errors=errors)
    return Scene.of([(radar, Reports.of("radar", "table", columns))]).feeds


@pytest.mark.slow
@pytest.mark.parametrize(("jump_s", "kinds"), [(0.0, []), (30.0, ["clock"]), (-30.0, ["clock"])])
def test_a_clock_that_jumps_is_found_in_plots_that_are_filtered_to_tracks(jump_s, kinds):
    for seed in range(6):
        assert [fault.kind for fault in source_faults(of_a_tracker(seed, jump_s))] == kinds
