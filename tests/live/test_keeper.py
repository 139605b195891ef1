"""The keeper: journal and state survive a kill, alarms begin and end, bad input never stops it."""

import ast
import asyncio
import contextlib
import hashlib
import io
import os
import pickle
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.live.conftest import SITE, START_S, descriptions, harbour, replay, settings

from sameas.errors import InputError
from sameas.io import read_table
from sameas.io.processes import Aside
from sameas.live.journal import LAYOUT, Journal, load_state
from sameas.live.keeper import BackgroundWork, Keeper, _Periodic
from sameas.live.outputs import sentence
from sameas.live.replay import Replay, SteadyClock
from sameas.live.settings import LiveSource, OwnShip, Settings, WatchSettings, read_settings
from sameas.live.situation import Alarm, Delta
from sameas.tracks import Description, Site
from sameas.tracks.reports import Reports


def numbers(situation):
    """{MMSI: object number}."""
    return {
        m: n for m, n in zip(situation.objects["mmsi"].tolist(), situation.objects["object"].tolist(), strict=True) if m
    }


def ticked(keeper, until_s, since_s=0.0, every_s=2.0):
    for t in np.arange(since_s + every_s, until_s + 1e-9, every_s):
        situation = keeper.tick(START_S + t)
    return situation


@pytest.mark.slow
def test_ships_are_matched_with_their_radar_targets_in_the_journal(keeper, tmp_path):
    situation = ticked(keeper, 60.0)
    assert len(numbers(situation)) == 5
    assert all(len(its) == 2 for its in situation.members.values())
    keeper.close()
    base = sqlite3.connect(tmp_path / "state" / "journal.sqlite")
    rows = base.execute("SELECT object, source, track FROM identities WHERE event = 'joined'").fetchall()
    assert base.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    base.close()
    number_of = {(source, track): number for number, source, track in rows}
    for number, its in situation.members.items():
        assert all(number_of[member] == number for member in its)
    [path] = (tmp_path / "state" / "archive").iterdir()
    archive = read_table(path)
    assert set(archive["object"]) == set(situation.objects["object"].tolist()) and len(set(archive["time_s"])) >= 5


def test_clutter_that_is_never_confirmed_is_not_in_the_journal(tmp_path):
    """A harbour of 60 ships with 12 radars had 1 800 objects in its journal after 20 minutes."""
    keeper = Keeper(settings(), tmp_path, replay=replay())
    echo = {"time_s": [START_S + 20.5, START_S + 40.5], "range_m": [2500.0, 2600.0], "bearing_deg": [200.0, 80.0]}
    situation = ticked(keeper, 18.0)
    keeper.picture.add("radar", Reports.of("radar", "table", echo | {"track_id": ["98", "99"]}))
    ticked(keeper, 38.0, 18.0)
    alarm = Alarm("zone harbour", "zone", "in the harbour")
    for t in (42.0, 44.0):
        situation = keeper.tick(START_S + t)
        tentative = situation.objects["object"][situation.objects["stage"] == "tentative"]
        keeper.store.journal.write(replace(situation, alarms=(replace(alarm, objects=tuple(tentative.tolist())),)))
    assert len(tentative) == 1 and len(situation.objects["object"]) == 6
    keeper.close()
    joined, _, objects = events(tmp_path)
    # What was in an alarm is known, since it was first shown.
    assert [row[1] for row in objects].count(0) == 1 and len(objects) == 6
    assert {track for _, source, track, _ in joined if source == "radar"} == {"0", "1", "2", "3", "4", "99"}
    with contextlib.closing(sqlite3.connect(tmp_path / "journal.sqlite")) as base:
        [[first_s]] = base.execute("SELECT first_s FROM objects WHERE confirmed = 0").fetchall()
    assert first_s == START_S + 42.0


@pytest.mark.slow
def test_a_restarted_watch_keeps_its_object_numbers(tmp_path):
    first = Keeper(settings(), tmp_path, replay=replay())
    before = numbers(ticked(first, 60.0))
    first.close()
    again = Keeper(settings(), tmp_path, replay=replay())
    again.clock.replay.take(START_S + 60.0)
    after = again.tick(START_S + 62.0)
    assert again.restored and numbers(after) == before and after.tick == 31
    again.close()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["marine radar", "camera"])
def test_a_restarted_watch_of_plots_keeps_its_object_numbers(kind, tmp_path):
    """Its state named two functions and a sparse array, and was refused as damaged; with a camera alone no tick was
    possible, for its feed has rows without a report."""
    at = {"lat_deg": SITE[0], "lon_deg": SITE[1]}
    plots: dict[str, Any] = {
        "time_s": START_S + 3.0 * np.repeat(np.arange(12), 3),
        "bearing_deg": [10.0, 100.0, 250.0] * 12,
    }
    if kind == "marine radar":
        plots["range_m"] = [900.0, 2000.0, 3000.0] * 12
    source = Description("plots", kind, site=Site(**at))
    watched = Settings({"plots": LiveSource(source)}, WatchSettings(register_every_s=0.0, faults_every_s=0.0))

    def ticked(first, last):
        keeper = Keeper(watched, tmp_path, replay=Replay([("plots", Reports.of("plots", "table", plots))], 1.0))
        for k in range(first, last):
            situation = keeper.tick(START_S + 3.0 * k)
        keeper.close()
        return keeper.restored, situation.objects["object"].tolist()

    (_, before), (restored, after) = ticked(0, 9), ticked(9, 11)
    assert restored and len(before) == len(after) == 3
    # A direction alone is of no object of before.
    assert after == before or kind == "camera"


def test_a_resumed_watch_takes_a_new_lag_and_refuses_another_plane(tmp_path):
    first = Keeper(settings(plane={"lat_deg": 50.5, "lon_deg": -1.0}), tmp_path / "state", replay=replay())
    for t in (10.0, 20.0):
        first.tick(START_S + t)
    first.close()
    again = Keeper(settings(lag_s=2.0), tmp_path / "state", replay=replay())
    assert again.picture.lag_s == 2.0 and again.picture.plane == first.picture.plane
    # With 2 s, a report of a second before is in time, and one of 5 s before is late.
    again.tick(START_S + 30.0)
    late = replay().sources[1][1]
    again.picture.add("radar", late.where((late.time_s > START_S + 24.0) & (late.time_s < START_S + 27.0)))
    again.tick(START_S + 31.0)
    assert again.picture.counts["radar"].late > 0
    again.close()
    with pytest.raises(InputError, match=r"is in the plane about 50.500000, -1.000000, and \[watch\] gives the plane"):
        Keeper(settings(plane={"lat_deg": 50.6, "lon_deg": -1.0}), tmp_path / "state", replay=replay())


@pytest.mark.slow
def test_a_watch_with_another_sensor_file_keeps_its_object_numbers_and_uses_the_file(tmp_path):
    """A corrected site was ignored, and with a further source the numbers of the journal were given again."""
    first = Keeper(settings(), tmp_path, replay=replay())
    before = numbers(ticked(first, 60.0))
    first.close()
    ais, radar = descriptions()
    radar = replace(radar, site=Site(lat_deg=SITE[0], lon_deg=SITE[1], height_m=12.0))
    sources = {d.name: LiveSource(d) for d in (Description("new", "ais"), ais, radar)}
    again = Keeper(Settings(sources, settings().watch), tmp_path, replay=replay())
    again.clock.replay.take(START_S + 60.0)
    after = again.tick(START_S + 62.0)
    assert again.changed == ("new", "radar") and numbers(after) == before
    assert after.tick == 31 and again.picture.descriptions[1].site.height_m == 12.0
    again.close()
    last = Keeper(settings(), tmp_path, replay=replay())
    last.clock.replay.take(START_S + 62.0)
    assert last.changed == ("radar",) and numbers(last.tick(START_S + 64.0)) == before
    last.close()


@pytest.mark.slow
def test_identities_survive_a_kill(tmp_path):
    program = (
        "import sys; sys.path.insert(0, '.')\n"
        "from pathlib import Path\nfrom tests.live.conftest import *\nfrom tests.live.test_keeper import numbers\n"
        f"keeper = Keeper(settings(save_every_s=0.0), Path({str(tmp_path)!r}), replay=replay())\n"
        "for k in range(1, 95):\n"
        "    frame = keeper.tick(START_S + 2.0 * k)\n"
        "    print(frame.tick, numbers(frame), flush=True)\n"
    )
    home = Path(__file__).parents[2]
    with subprocess.Popen([sys.executable, "-c", program], cwd=home, stdout=subprocess.PIPE, text=True) as run:
        lines = [run.stdout.readline() for _ in range(30)]
        os.kill(run.pid, signal.SIGKILL)
        lines += run.stdout.read().splitlines()
    before = ast.literal_eval(lines[25].split(" ", 1)[1])
    again = Keeper(settings(), tmp_path, replay=replay())
    assert again.restored and again.picture.instant_s >= START_S + 2.0 * 29
    again.clock.replay.take(again.picture.instant_s)
    assert numbers(again.tick(again.picture.instant_s + 2.0)) == before
    base = sqlite3.connect(tmp_path / "journal.sqlite")
    assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    base.close()
    again.close()


@pytest.mark.slow
def test_offsets_that_an_operator_sets_survive_a_kill_and_end_with_their_sensor(tmp_path):
    first = Keeper(settings(save_every_s=1e9), tmp_path, replay=replay())
    ticked(first, 10.0)
    first.offsets.set("radar", "azimuth_deg", -2.0, "operator at bridge")
    first.offsets.set("ais", "time_s", 3.0)
    first.offsets.hold("ais", False)
    # Killed before the next state: the journal has it.
    first.store.journal.close()
    base = sqlite3.connect(tmp_path / "journal.sqlite")
    rows = base.execute("SELECT source, event, bias, value, unit, by FROM offsets").fetchall()
    base.close()
    assert rows[0] == ("radar", "set", "azimuth_deg", -2.0, "deg", "operator at bridge")
    assert [row[:2] for row in rows[1:]] == [("ais", "set"), ("ais", "released")]
    again = Keeper(settings(), tmp_path, replay=replay())
    assert again.picture.held == {"radar"} and set(again.picture.biases) == {"radar"}
    assert again.offsets.in_words()["radar"]["offsets"] == ["azimuth -2.000° set by hand"]
    ticked(again, 20.0)
    again.close()
    ais, radar = descriptions()
    radar = replace(radar, site=Site(lat_deg=SITE[0], lon_deg=SITE[1], height_m=12.0))
    other = Settings({d.name: LiveSource(d) for d in (ais, radar)}, settings().watch)
    for made in (other, settings()):
        last = Keeper(made, tmp_path, replay=replay())
        assert last.picture.held == set() and not last.picture.biases
        last.close()


@pytest.mark.slow
def test_deltas_add_up_to_the_frame(keeper):
    objects, records = {}, {}
    for k in range(1, 20):
        situation = keeper.tick(START_S + 2.0 * k)
        delta = keeper.deltas[-1]
        objects = {n: r for n, r in objects.items() if n not in delta.removed_objects} | {
            row[0]: row for row in delta.objects
        }
        records = {n: r for n, r in records.items() if n not in delta.removed_records}
        records |= {f"{row[1]}:{row[2]}": row for row in delta.records}
        assert objects == situation.object_rows and records == situation.record_rows
    assert Delta.between(situation, situation).objects == [] and Delta.between(None, situation).objects
    keeper.close()


def approach(own_ship, also=None, **watch):
    """The kinds of alarms while a ship passes a place at 100 m. also : adds the reports of others at each time."""
    keeper = Keeper(
        Settings(
            {"ais": LiveSource(Description("ais", "ais"))},
            WatchSettings(own_ship=own_ship, register_every_s=0.0, plane={"lat_deg": 50.0, "lon_deg": -1.0}, **watch),
        ),
        replay=replay(),
    )
    keeper.clock.replay.sources, keeper.clock.replay._next, kinds = [], [], set()
    for t in np.arange(0.0, 60.0, 2.0):
        north = 2000.0 - 10.0 * t
        row: dict[str, Any] = {"time_s": [START_S + t], "lat_deg": [50.0 + north / 111_240.0], "lon_deg": [-0.9986]}
        row |= {"mmsi": ["235000001"], "vx_m_per_s": [0.0], "vy_m_per_s": [-10.0]}
        keeper.picture.add("ais", Reports.of("ais", "ais", row))
        if also is not None:
            also(keeper, t)
        kinds |= {alarm.kind for alarm in keeper.tick(START_S + t).alarms}
    keeper.close()
    return kinds


@pytest.mark.slow
def test_a_radar_on_shore_is_no_own_ship_in_danger_unless_a_distance_is_given():
    shore = OwnShip(lat_deg=50.0, lon_deg=-1.0)
    assert approach(shore) == set()
    assert approach(shore, cpa_m=500.0) == {"cpa"}


@pytest.mark.slow
@pytest.mark.parametrize("beside_m", [None, 100.0, 900.0])
def test_an_approaching_ship_that_no_source_shows_any_more_is_an_alarm(beside_m):
    """Unless another object is where she should be, which another source may have found: she has a new number then."""
    sources = {"ais": LiveSource(Description("ais", "ais"))}
    watch = WatchSettings(own_ship=OwnShip(lat_deg=50.0, lon_deg=-1.0), cpa_m=500.0, register_every_s=0.0,
                          plane={"lat_deg": 50.0, "lon_deg": -1.0})  # fmt: skip
    keeper = Keeper(Settings(sources, watch), replay=replay())
    keeper.clock.replay.sources, keeper.clock.replay._next = [], []

    def report(t, mmsi, east):
        row: dict[str, Any] = {"time_s": [START_S + t], "lat_deg": [50.0 + (8000.0 - 10.0 * t) / 111_240.0]}
        row |= {"lon_deg": [-1.0 + east / 71_695.7], "mmsi": [mmsi], "vx_m_per_s": [0.0], "vy_m_per_s": [-10.0]}
        keeper.reception.add("ais", Reports.of("ais", "ais", row), START_S + t)

    first_s = np.inf
    for t in np.arange(0.0, 300.0, 10.0):
        if t < 100.0:
            report(t, "235000001", 100.0)
        if beside_m is not None:
            report(t, "235000002", 100.0 + beside_m)
        for alarm in keeper.tick(START_S + t).alarms:
            if alarm.condition == "lost":
                assert alarm.text.startswith(
                    "235000001 is lost: no source shows it any more, and it will pass at 100 m"
                )
                first_s = min(first_s, t)
    keeper.close()
    assert first_s == np.inf if beside_m == 100.0 else 150.0 < first_s < 200.0


@pytest.mark.slow
@pytest.mark.parametrize(("knots", "kinds"), [(5.0, {"cpa"}), (0.5, set())])
def test_a_ship_under_way_is_warned_of_approaches_and_one_in_port_is_not(knots, kinds):
    def moved(keeper, t):
        north = 0.5144 * knots * t
        row: dict[str, Any] = {"time_s": [START_S + t], "lat_deg": [50.0 + north / 111_240.0], "lon_deg": [-1.0]}
        row |= {"mmsi": ["235000009"], "vx_m_per_s": [0.0], "vy_m_per_s": [0.5144 * knots]}
        keeper.picture.add("ais", Reports.of("ais", "ais", row))

    assert approach(OwnShip(mmsi="235000009"), also=moved) == kinds


def listening(tmp_path, clock, folder=None):
    """A keeper with one source of tracks in degrees, and its wire."""
    path = tmp_path / "sensors.toml"
    path.write_text(
        '[watch]\nplane = { lat_deg = 50.0, lon_deg = -1.0 }\n[sources.far]\nkind = "tracks"\n'
        'errors = { position_m = 20 }\ninput = { url = "tcp://127.0.0.1:10110", format = "table" }\n'
    )
    keeper = Keeper(read_settings(path), folder, clock=clock)
    return keeper, keeper.wires["tcp://127.0.0.1:10110"]


def line(time_s):
    return f'{{"time": {time_s}, "lat": 50.0, "lon": -1.0, "track_id": "7"}}\n'.encode()


@pytest.mark.parametrize(("off_s", "words"), [
    (86400.0, "far: its time stamps are 1.0 days ahead of the times of receipt"),
    (-START_S, "far: its time stamps are 19844.4 days behind the times of receipt"),
    (3600.0, "far: its time stamps are 1.0 h ahead of the times of receipt (a time zone? give time_zone in its input)"),
])  # fmt: skip
def test_stamps_of_tomorrow_and_of_1970_are_one_alarm_and_fill_no_memory(tmp_path, off_s, words):
    now = [START_S]
    keeper, wire = listening(tmp_path, lambda: now[0])
    for k in range(40):
        now[0] = START_S + k
        wire.receive(line(now[0] + off_s))
        situation = keeper.tick()
    assert [alarm.text for alarm in situation.alarms] == [words] and len(situation.objects["object"]) == 0
    assert keeper.health()["sources"]["far"]["refused"] == (40 if off_s > 0.0 else 0)
    assert keeper.picture.counts["far"].taken == (0 if off_s > 0.0 else 40)
    keeper.close()


def test_a_clock_that_is_set_back_does_not_stop_the_picture(tmp_path):
    steady, wall = [0.0], [START_S]
    keeper, _ = listening(tmp_path, SteadyClock(lambda: wall[0], lambda: steady[0]), tmp_path / "state")

    def after(seconds, step_s=0.0):
        steady[0] += seconds
        wall[0] += seconds + step_s
        return keeper.tick()

    assert after(1.0).time_s == START_S + 1.0
    back = after(1.0, -3600.0)
    assert back.time_s == START_S + 2.0
    assert [alarm.text for alarm in back.alarms] == [
        "the clock of this computer was set back by 1.0 h; the watch keeps the time before: set it right"
    ]
    assert after(1.0).time_s == START_S + 3.0
    # Set right again.
    assert after(1.0, 3600.0).alarms == () and keeper.clock.set_back_s == 0.0
    assert after(1.0, 7200.0).time_s == START_S + 7205.0
    keeper.close()
    # A watch that begins with a clock before its state says that it stands still.
    again, _ = listening(tmp_path, lambda: START_S, tmp_path / "state")
    [alarm] = again.tick().alarms
    assert alarm.text.startswith("the picture is 2.0 h later than the clock of this computer, and stands still until")
    assert not again.health()["ok"]
    again.close()


def test_a_source_that_never_sends_is_an_alarm_with_the_reason(tmp_path):
    path, now = tmp_path / "sensors.toml", [1000.0]
    path.write_text(
        '[watch]\nsilent_s = 30\n[sources.coast]\nkind = "ais"\ninput = "udp://127.0.0.1:60004"\n'
        '[sources.bridge]\nkind = "marine radar"\ninput = "tcp://127.0.0.1:10110"\n'
        '[sources.port]\nkind = "ais"\ninput = "tcp://127.0.0.1:10111"\n'
    )
    keeper = Keeper(read_settings(path), clock=lambda: now[0])
    coast, bridge, port = keeper.wires.values()
    coast.state.connected = port.state.connected = True
    bridge.state.error = "Connection refused"
    assert keeper.tick().alarms == ()
    now[0] = 1031.0
    port.receive(b"!AIVDM,1,1,,A,13aGra0P00PHid>NK9<2sdAN0L1P,0*FF\r\n")
    began = "has sent no report since the watch began"
    assert {alarm.text for alarm in keeper.tick().alarms} == {
        f"coast {began}: nothing arrives on udp://127.0.0.1:60004",
        f"bridge {began}: tcp://127.0.0.1:10110 is not connected (Connection refused)",
        f"port {began}: data arrive on tcp://127.0.0.1:10111, but none are its reports (1 × wrong checksum)",
    }
    keeper.close()


def test_a_cable_with_several_sources_that_falls_silent_is_one_alarm(tmp_path):
    path, now = tmp_path / "sensors.toml", [1_714_564_800.0]
    path.write_text(
        '[watch]\nsilent_s = 30\n[sources.coast]\nkind = "ais"\ninput = "tcp://127.0.0.1:10110"\n'
        '[sources.bridge]\nkind = "marine radar"\ninput = "tcp://127.0.0.1:10110"\n'
    )
    keeper = Keeper(read_settings(path), clock=lambda: now[0])
    [wire] = keeper.wires.values()
    wire.state.connected = True

    def alarms(seconds):
        now[0] += seconds
        return [alarm.text for alarm in keeper.tick().alarms]

    assert alarms(31.0) == [
        "tcp://127.0.0.1:10110, of coast and bridge, is silent since the watch began: nothing has arrived"
    ]
    position = sentence("GPRMC,120031.00,A,5033.00,N,00057.00,W,0.0,0.0,010524,,,A")
    wire.receive(position + sentence("RATTM,05,2.0,45.6,T,9.0,180.0,T,,,N,,T,,120031.00,A"), last=True)
    # Data arrive: only what is missing is named.
    assert alarms(0.0) == [
        "coast has sent no report since the watch began: data arrive on tcp://127.0.0.1:10110, but none are its "
        "reports (sentences RMC, TTM)"
    ]
    wire.state.connected, wire.state.error = False, "Connection refused"
    assert alarms(31.0) == [
        "tcp://127.0.0.1:10110, of coast and bridge, is silent for 30 s: it is not connected (Connection refused)",
        "own ship: bridge has given no position for 30 s; no approach is watched",
    ]
    keeper.close()


TTM = sentence("RATTM,05,2.0,45.6,T,9.0,180.0,T,,,N,,T,,,A")


@pytest.mark.parametrize(
    ("kind", "more", "data", "words"),
    [
        ("marine radar", "", TTM, "the sensor's position is not known; give site = { lat_deg"),
        ("ais", "", b'{"bearing": 1}\n', 'no column of time among: bearing; give columns = { time_s = "NAME" }'),
        ("ads-b", ', format = "nmea"', 20 * b"MSG,3,1,1,3C0001\n", "no NMEA sentence; leave out its format"),
        ("air radar", ', sensor = "048 1/2"', TTM, 'has arpa, but no 048 1/2: give sensor = "arpa"'),
    ],
)
def test_reports_that_cannot_be_used_are_an_alarm_at_once(kind, more, data, words, tmp_path):
    """A missing site or column, another format or sensor is said with the first data, not a minute later."""
    path, now = tmp_path / "sensors.toml", [1000.0]
    path.write_text(f'[sources.rays]\nkind = "{kind}"\ninput = {{ url = "udp://127.0.0.1:60004"{more} }}\n')
    keeper = Keeper(read_settings(path), clock=lambda: now[0])
    [wire] = keeper.wires.values()
    for _ in range(2):
        wire.receive(data, last=True)
        now[0] += 5.0
        alarms = keeper.tick().alarms
    [alarm] = alarms
    assert words in alarm.text and alarm.kind == "source"
    keeper.close()


def test_a_picture_that_falls_behind_is_an_alarm(tmp_path):
    path = tmp_path / "sensors.toml"
    path.write_text('[sources.coast]\nkind = "ais"\ninput = "udp://127.0.0.1:60004"\n')
    keeper = Keeper(read_settings(path), clock=lambda: START_S)
    keeper.durations_s.extend([2.04] * 6 + [0.1] * 5)
    assert keeper.tick(START_S).alarms == ()
    keeper.durations_s.extend([2.04] * 8)
    [alarm] = keeper.tick(START_S + 1.0).alarms
    assert alarm.text.startswith("an instant takes 2.0 s, and every_s is 1: the picture is that old")
    keeper.close()


@pytest.mark.slow
def test_a_long_tick_makes_no_source_silent(tmp_path, monkeypatch):
    path, now = tmp_path / "sensors.toml", [START_S]
    path.write_text('[watch]\nsilent_s = 30\n[sources.coast]\nkind = "ais"\ninput = "udp://127.0.0.1:60004"\n')
    keeper = Keeper(read_settings(path), clock=lambda: now[0])
    advance = keeper.picture.advance

    def compiled(instant_s):
        now[0] += 90.0
        return advance(instant_s)

    monkeypatch.setattr(keeper.picture, "advance", compiled)
    [wire] = keeper.wires.values()
    wire.receive(b'{"time": 1714560000, "lat": 50.1, "lon": -1.2, "mmsi": "235070762"}\n')
    assert keeper.tick().alarms == ()
    keeper.close()


@pytest.mark.slow
def test_a_close_approach_is_an_alarm_until_it_has_passed(tmp_path):
    t = np.arange(0.0, 400.0, 2.0)
    ship: dict[str, Any] = {
        "time_s": START_S + t, "x_m": 100.0 + 0.0 * t, "y_m": 2000.0 - 10.0 * t, "mmsi": ["235000001"] * len(t),
        "vx_m_per_s": 0.0 * t, "vy_m_per_s": -10.0 + 0.0 * t,
    }  # fmt: skip
    own: dict[str, Any] = {
        "time_s": START_S + t, "x_m": 0.0 * t, "y_m": 0.0 * t, "mmsi": ["235000002"] * len(t),
        "vx_m_per_s": 0.0 * t, "vy_m_per_s": 0.0 * t,
    }  # fmt: skip
    watch = WatchSettings(own_ship=OwnShip(mmsi="235000002"), register_every_s=0.0, cpa_m=926.0)
    keeper = Keeper(Settings({"ais": LiveSource(Description("ais", "ais"))}, watch), tmp_path, replay=replay())
    keeper.clock.replay.sources, keeper.clock.replay._next = [], []
    raised = []
    for k, time_s in enumerate(t):
        for one in (ship, own):
            row = {name: column[k : k + 1] for name, column in one.items()}
            keeper.picture.add("ais", Reports.of("ais", "ais", row))
        situation = keeper.tick(START_S + time_s)
        raised.append([alarm.kind for alarm in situation.alarms])
    assert raised[20] == ["cpa"] and situation.alarms == ()
    [one] = keeper.alarm_list()
    assert (
        "will pass at 100 m" in one["text"]
        and not one["active"]
        and one["last_s"] == pytest.approx(START_S + 198, abs=4)
    )
    assert keeper.acknowledge(one["id"], "mate") and not keeper.acknowledge(one["id"], "mate")
    assert keeper.alarm_list()[0]["acknowledged_by"] == "mate"
    keeper.close()


@pytest.mark.slow
def test_a_replay_skips_nothing_while_kernels_are_compiled(tmp_path, monkeypatch):
    """A registration that compiled for a minute between two ticks cost a replay at pace 8 eight minutes."""
    keeper = Keeper(settings(every_s=0.05), tmp_path, replay=replay(pace=20.0))
    ticks, sleep = [], asyncio.sleep

    async def stalled(seconds):
        await sleep(seconds + 1.5 * (len(ticks) == 3))

    tick = keeper.tick

    def kept():
        ticks.append(tick())
        return ticks[-1]

    monkeypatch.setattr(keeper, "tick", kept)
    monkeypatch.setattr("sameas.live.keeper.asyncio.sleep", stalled)
    asyncio.run(keeper.run(until=lambda: len(ticks) >= 8))
    steps_s = np.diff([situation.time_s for situation in ticks])
    assert keeper.clock.waited_s > 1.4 and steps_s.max() < 20.0 * 1.0


def test_unusable_reports_do_not_stop_the_keeper(keeper):
    ticked(keeper, 20.0)
    from_nowhere = Reports.of("ais", "table", {"time_s": [START_S + 20.0], "range_m": [10.0], "bearing_deg": [0.0]})
    keeper.reception.add("ais", from_nowhere, START_S + 20.0)
    ais = keeper.health()["sources"]["ais"]
    assert ais["refused"] == 1 and ais["error"].startswith("errors.range_m is not known")
    keeper.picture.advance = lambda instant_s: 1 / 0
    assert keeper.tick(START_S + 22.0) is None and keeper.failed_ticks == 1
    del keeper.picture.advance
    assert keeper.tick(START_S + 24.0) is not None
    keeper.close()


@pytest.mark.slow
def test_a_failed_registration_or_search_does_not_stop_the_keeper(tmp_path, monkeypatch):
    def failing(*arguments):
        raise ZeroDivisionError("a fault of ours")

    for name in ("estimated", "faults_of"):
        monkeypatch.setattr(f"sameas.live.keeper.{name}", failing)
    keeper = Keeper(settings(register_every_s=0.1, faults_every_s=0.1, every_s=0.05), tmp_path, replay=replay())
    asyncio.run(keeper.run(until=lambda: keeper._tick >= 3))
    assert keeper.store.journal is None and load_state(tmp_path)["tick"] == 3
    # Nor does an exception that the keeper does not catch.
    monkeypatch.setattr(BackgroundWork, "register", failing)
    again = Keeper(settings(register_every_s=0.1, every_s=0.05), tmp_path, replay=replay())
    asyncio.run(again.run(until=lambda: again._tick >= 6))
    assert again.restored and again.store.journal is None and load_state(tmp_path)["tick"] == 6


def test_a_damaged_state_is_refused(tmp_path):
    (tmp_path / "state.pickle").write_bytes(b"\x80\x05nonsense")
    with pytest.raises(InputError, match="is damaged"):
        load_state(tmp_path)
    (tmp_path / "state.pickle").unlink()
    assert load_state(tmp_path) is None


def test_a_state_that_other_code_saved_is_refused_in_one_line(tmp_path, monkeypatch):
    first = Keeper(settings(), tmp_path, replay=replay())
    ticked(first, 4.0)
    first.close()
    for name, value, whose in (
        ("sameas.live.journal.LAYOUT", LAYOUT + 1, "an earlier build of this version of sameas"),
        ("sameas.__version__", "99.0", "version 0.1.0 of sameas"),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(name, value)
            with pytest.raises(InputError, match=rf"state.pickle: was saved by {whose}.*; move its folder away"):
                load_state(tmp_path)
    again = Keeper(settings(), tmp_path, replay=replay())
    assert again.restored
    again.close()


class AttributeNames(pickle.Pickler):
    """Collects the attribute names of sameas objects."""

    def __init__(self) -> None:
        super().__init__(io.BytesIO(), protocol=5)
        self.found: dict[str, set[str]] = {}

    def reducer_override(self, value: Any) -> Any:
        kind = type(value)
        if kind.__module__.startswith("sameas"):
            kept = {n for n in vars(value) if not isinstance(getattr(kind, n, None), cached_property)}
            self.found.setdefault(f"{kind.__module__}.{kind.__qualname__}", set()).update(kept)
        return NotImplemented


def test_the_contents_of_states_match_the_layout_version(keeper):
    ticked(keeper, 20.0)
    names = AttributeNames()
    names.dump(keeper.picture)
    held = sorted((kind, sorted(found)) for kind, found in names.found.items())
    # Where this fails, states that others have saved cannot be read any more: raise LAYOUT, and take the new digest.
    assert (LAYOUT, hashlib.sha256(repr(held).encode()).hexdigest()[:12]) == (73, "b3462c6554a8")


def test_settings_are_read_and_unknown_ones_refused(tmp_path):
    path = tmp_path / "sensors.toml"
    path.write_text(
        "[watch]\nevery_s = 2\nown_ship = { lat_deg = 50.0, lon_deg = -1.0 }\nplane = { lat_deg = 50, lon_deg = -1 }\n"
        'outputs = [{ url = "udp://127.0.0.1:10110", format = "nmea" }]\n'
        '[sources.coast]\nkind = "ais"\ninput = "udp://239.192.0.4:60004"\n'
        '[sources.quay]\nkind = "air radar"\ninput = { url = "udp://239.1.1.1:8600", sensor = "048 25/201" }\n'
    )
    found = read_settings(path)
    assert found.watch.every_s == 2.0 and found.watch.own_ship == OwnShip(50.0, -1.0)
    assert found.sources["quay"].sensor == "048 25/201" and found.sources["coast"].url == "udp://239.192.0.4:60004"
    ais = Reports.of("lan:ais", "ais", {"time_s": [0.0], "x_m": [0.0], "y_m": [0.0]})
    assert found.sources["coast"].recorded.takes(ais) and not found.sources["quay"].recorded.takes(ais)
    for text, words in (
        ("[watch]\nevery = 1\n", "'every' is not known; did you mean every_s?"),
        ("[watch]\nlag_s = -1\n", "give a number, 0 or more"),
        ("[watch]\nown_ship = { name = 1 }\n", "give lat_deg and lon_deg"),
        ('[watch]\nown_ship = { lat_deg = 50.0, lon_deg = "1" }\n', "own_ship.lon_deg is '1'; give degrees"),
        ("[watch]\nown_ship = { lat_deg = 95.0, lon_deg = 1.0 }\n", r"lat_deg is 95.0; give degrees within ±90"),
        ("[watch]\nown_ship = { lat_deg = 50.0 }\n", "own_ship: lat_deg, but not lon_deg; give both"),
        ("[watch]\nown_ship = { mmsi = [1] }\n", "own_ship.mmsi is .*; give it in quotes"),
        ('[watch]\nown_ship = { source = "quay" }\n', "own_ship.source is 'quay'; give one of coast"),
        ('[watch]\nplane = { lat_deg = 50.0, lon_deg = "1" }\n', "plane.lon_deg is '1'; give degrees"),
        ("[watch]\nplane = { lat_deg = nan, lon_deg = 1 }\n", "plane.lat_deg is nan; give degrees"),
        ("[watch]\nplane = { lat_deg = true, lon_deg = 1 }\n", "plane.lat_deg is True; give degrees"),
        ("[watch]\nevery_s = nan\n", "every_s is nan; give a number, 0 or more"),
        ("[watch]\nlag_s = inf\n", "lag_s is inf; give a number, 0 or more"),
        ("[watch]\noutputs = 3\n", "outputs is 3; give a list"),
        ("[watch]\nchart = 3\n", "chart is 3; give the name of a file in quotes"),
        ('[watch]\nchart = "shores.geojson"\n', "shores.geojson"),
        ('[watch]\nchart = ["shores.geojson", 3]\n', "give the name of a file in quotes, or a list of them"),
        ('[sources.b]\nkind = "ais"\ninputs = "udp://127.0.0.1:1"\n', "'inputs' is not known; did you mean input?"),
        ('[sources.b]\ninput = "udp://127.0.0.1:1"\n', 'has no kind; give kind = "…", one of marine radar'),
        ('[sources.b]\nkind = "other"\ninput = "udp://127.0.0.1:1"\n', "give motion = .* and misses = "),
        ('[sources.b]\ninput = { url = "udp://127.0.0.1:1", format = "ais" }\n', "format is 'ais'; give nmea"),
    ):
        path.write_text(text + '[sources.coast]\nkind = "ais"\n')
        with pytest.raises(InputError, match=words):
            read_settings(path)
    path.write_text('[watch]\nown_ship = { mmsi = 23507 }\n[sources.coast]\nkind = "ais"\n')
    assert read_settings(path).watch.own_ship == OwnShip(mmsi="000023507")
    path.write_text('[sources.coast]\nkind = "ais"\n')
    with pytest.raises(InputError, match="has no input"):
        Keeper(read_settings(path))


def test_a_watch_with_a_long_interval_stops_at_once(tmp_path):
    """The keeper once slept until its next tick, so Ctrl-C took up to --every."""

    async def stopped():
        keeper, over = Keeper(settings(every_s=3600.0), tmp_path, replay=replay()), asyncio.Event()
        running = asyncio.create_task(keeper.run(until=over.is_set, stop=over))
        while keeper.situation is None:
            await asyncio.sleep(0.01)
        over.set()
        await asyncio.wait_for(running, 60.0)
        return keeper

    assert asyncio.run(stopped()).situation is not None and load_state(tmp_path)["tick"] == 1


@pytest.mark.long
def test_memory_stays_constant_over_an_hour_at_hundredfold_pace(tmp_path):
    psutil = pytest.importorskip("psutil")

    made = harbour(until_s=3600.0)
    keeper = Keeper(settings(save_every_s=60.0), tmp_path, replay=replay(until_s=3600.0))
    process, sizes = psutil.Process(), []
    for k in range(1, 720):
        keeper.tick(START_S + 5.0 * k)
        if k == 300:  # a source stops, and returns as a flood
            flood = made["radar"].where(np.flatnonzero(made["radar"].time_s > START_S + 1400.0)[:5000])
            keeper.reception.add("radar", flood, time.time())
        sizes.append(process.memory_info().rss / 1e6)
    assert sizes[-1] - sizes[360] < 30.0
    assert len(numbers(keeper.situation)) == 5 and keeper.failed_ticks == 0
    keeper.close()


def test_a_state_that_cannot_be_saved_is_said_once_while_the_journal_can(tmp_path, monkeypatch, caplog):
    """Where the state did not fit and the journal did, the warning came back at every save, and the alarm ended."""
    keeper = Keeper(settings(save_every_s=1.0), tmp_path, replay=replay())

    def full() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(keeper, "save", full)
    situations = [keeper.tick(START_S + 2.0 * k) for k in range(1, 6)]
    assert sum("No space left" in record.message for record in caplog.records) == 1
    assert all(any(alarm.key == "folder" for alarm in situation.alarms) for situation in situations[1:])
    monkeypatch.undo()
    keeper.tick(START_S + 12.0)
    assert keeper.store.refusal == ""
    keeper.close()


def events(folder):
    """The entries of the journal on identities and alarms."""
    with contextlib.closing(sqlite3.connect(folder / "journal.sqlite")) as base:
        assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        joined = base.execute("SELECT object, source, track, event FROM identities ORDER BY rowid").fetchall()
        alarms = base.execute("SELECT key, active FROM alarms ORDER BY id").fetchall()
        return joined, alarms, base.execute("SELECT object, confirmed FROM objects ORDER BY object").fetchall()


@pytest.mark.slow
def test_a_full_disk_is_an_alarm_and_missing_entries_are_written_later(tmp_path):
    """The watch once ended with "a fault of sameas" and lost its alarms."""
    one, two = (Keeper(settings(), tmp_path / name, replay=replay()) for name in ("one", "two"))
    ticked(one, 60.0)
    ticked(two, 20.0)
    [pages] = two.store.journal._base.execute("PRAGMA page_count").fetchone()
    two.store.journal._base.execute(f"PRAGMA max_page_count = {pages}")
    big = Alarm("flood", "source", "x" * 100_000)
    assert two.store.attempt(lambda journal: journal.alarm(big, 0.0)) is None
    situation = two.tick(START_S + 22.0)
    assert [alarm.text for alarm in situation.alarms if alarm.key == "folder"] == [
        f"{tmp_path / 'two'} cannot be written (database or disk is full); what happens is written when it can"
    ]
    listed = {alarm["key"]: alarm["id"] for alarm in two.alarm_list()}
    assert "folder" in listed and not two.acknowledge(-1, "me")
    two.store.journal._base.execute("PRAGMA max_page_count = 1000000")
    ticked(two, 60.0, 22.0)
    assert not two.store.refusal
    one.close()
    two.close()
    (joined, _, objects), (joined_2, alarms, objects_2) = events(tmp_path / "one"), events(tmp_path / "two")
    assert joined == joined_2 and objects == objects_2 and ("folder", 0) in alarms


@pytest.mark.slow
def test_ticks_not_written_to_the_journal_are_written_later(tmp_path, monkeypatch):
    one, two = (Keeper(settings(), tmp_path / name, replay=replay()) for name in ("one", "two"))
    written = Journal._write_identities

    def full(journal, situation):
        written(journal, situation)
        raise sqlite3.OperationalError("database or disk is full")

    ticked(one, 60.0)
    monkeypatch.setattr(Journal, "_write_identities", full)
    ticked(two, 20.0)
    monkeypatch.undo()
    ticked(two, 60.0, 20.0)
    one.close()
    two.close()
    (joined, _, objects), (joined_2, _, objects_2) = events(tmp_path / "one"), events(tmp_path / "two")
    # Alarms that began and ended in between are unknown.
    assert {row for row in joined if row[3] == "joined"} >= set(joined_2) and objects == objects_2


def test_a_deleted_folder_does_not_stop_the_keeper_and_is_reported_at_the_end(tmp_path):
    keeper = Keeper(settings(save_every_s=2.0), tmp_path / "state", replay=replay())
    ticked(keeper, 10.0)
    shutil.rmtree(tmp_path / "state")
    situation = ticked(keeper, 20.0, 10.0)
    assert any(alarm.key == "folder" for alarm in situation.alarms)
    with pytest.raises(InputError, match=r"the last state of the watch is not saved: .*make room, or give a folder"):
        keeper.close()


def test_a_folder_is_locked_by_one_watch(tmp_path):
    keeper = Keeper(settings(), tmp_path, replay=replay())
    with pytest.raises(InputError, match="another run writes there; give another folder, or end that one"):
        Keeper(settings(), tmp_path, replay=replay())
    keeper.close()
    Keeper(settings(), tmp_path, replay=replay()).close()


def test_the_archive_is_written_at_least_every_ten_minutes(tmp_path):
    keeper = Keeper(settings(), tmp_path, replay=replay())
    ticked(keeper, 20.0)
    assert not (tmp_path / "archive").exists()
    keeper.tick(START_S + 620.0)
    assert len(list((tmp_path / "archive").iterdir())) == 1
    keeper.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "change", "kind", "words"),
    [
        ("ais", "dragged", "deception", "ais reports 235002111 at one place, radar sees it at another"),
        ("ais", None, "", ""),
        ("radar", "ended", "source", "radar: ends"),
        ("ais", "clock", "source", "ais: its clock jumps by"),
    ],
)
def test_deception_and_source_faults_are_alarms_that_can_be_acknowledged(source, change, kind, words, tmp_path):
    made = harbour(until_s=330.0)
    reports = made[source]
    late, arrivals_s = reports.time_s > START_S + 200.0, {name: one.time_s for name, one in made.items()}
    if change == "ended":
        made[source] = reports.where(~late)
    elif change == "dragged":
        away = 8.0 * np.maximum(reports.time_s - START_S - 200.0, 0.0) * (reports.track_id == "235002111")
        made[source] = replace(reports, lat_deg=np.asarray(reports.lat_deg) + away / 111_240.0)
    elif change == "clock":
        made[source] = replace(reports, time_s=reports.time_s + 30.0 * late)
    keeper = Keeper(settings(), tmp_path, replay=replay())
    keeper.clock.replay.sources, keeper.clock.replay._next = [], []

    def goes_on(since_s, until_s):
        for t in np.arange(since_s, until_s, 5.0) + START_S:
            for name, one in made.items():
                arrival_s = arrivals_s[name][: len(one)] if change != "ended" else one.time_s
                keeper.picture.add(name, one.where((arrival_s > t) & (arrival_s <= t + 5.0)))
            situation = keeper.tick(t + 5.0)
        return situation

    goes_on(0.0, 300.0)
    keeper.background.search()
    goes_on(300.0, 310.0)
    assert not [alarm for alarm in keeper.alarm_list() if alarm["kind"] in ("source", "deception")]
    keeper.background.search()
    situation = goes_on(310.0, 320.0)
    found = [alarm for alarm in keeper.alarm_list() if alarm["kind"] in ("source", "deception")]
    assert [alarm["kind"] for alarm in found] == ([kind] if kind else [])
    if kind:
        assert words in found[0]["text"] and "probability" in found[0]["text"]
        assert keeper.acknowledge(found[0]["id"], "mate") and keeper.alarm_list()[0]["acknowledged_by"] == "mate"
    if kind == "deception":
        assert any(numbers(situation)["235002111"] in alarm.objects for alarm in situation.alarms)
    keeper.close()


def own_ship_at(keeper, now, position, more=""):
    """The state of own ship one second later, with an RMC at this place (minutes north of 50° N)."""
    now[0] += 1.0
    clock = time.strftime("%H%M%S.00", time.gmtime(now[0]))
    date = time.strftime("%d%m%y", time.gmtime(now[0]))
    [wire] = keeper.wires.values()
    wire.receive(sentence(f"GPRMC,{clock},A,50{position:07.4f},N,00057.0000,W,{more or ','},{date},,,A"), last=True)
    return keeper.tick().own_ship


@pytest.mark.slow
def test_the_jitter_of_a_position_alongside_is_no_speed_and_a_measured_speed_is_taken_as_it_is(tmp_path):
    path, now = tmp_path / "sensors.toml", [1_714_564_800.0]
    path.write_text(
        '[watch]\nown_ship = { source = "bridge" }\nplane = { lat_deg = 50.55, lon_deg = -0.95 }\n'
        '[sources.bridge]\nkind = "marine radar"\ninput = "tcp://127.0.0.1:10110"\n'
    )
    keeper = Keeper(read_settings(path), clock=lambda: now[0])
    for _ in range(60):
        own_ship_at(keeper, now, 33.0)
    # Five metres at once, after a minute at rest: no ship makes half a knot from that.
    jump = [own_ship_at(keeper, now, 33.0027) for _ in range(30)]
    assert max(ship.vy_m_per_s for ship in jump) < 0.26 and abs(jump[-1].vy_m_per_s) < 0.05
    # Her receiver's speed is that of the ship at once.
    ship = own_ship_at(keeper, now, 33.0027, "9.72,90.0")
    assert (ship.vx_m_per_s, ship.vy_m_per_s) == pytest.approx((5.0, 0.0), abs=0.01)
    assert own_ship_at(keeper, now, 33.0027, "0.0,").vx_m_per_s == 0.0
    # A receiver that fails leaves no ship where she was, and says so; targets go on.
    [wire] = keeper.wires.values()
    for _ in range(2):
        now[0] += 40.0
        wire.receive(sentence("RATTM,05,2.0,45.6,T,9.0,180.0,T,,,N,,T,,,A"), last=True)
        situation = keeper.tick()
    assert situation.own_ship is None
    words = "own ship: bridge has given no position for 60 s; no approach is watched"
    assert words in [alarm.text for alarm in situation.alarms]
    assert own_ship_at(keeper, now, 33.1) is not None
    assert words not in [alarm.text for alarm in keeper.situation.alarms]
    keeper.close()


@pytest.mark.slow
def test_the_offsets_and_faults_of_a_watch_are_the_same_from_another_process():
    offsets, faults = [], []
    for aside in (Aside(10**9), Aside(1)):
        keeper = Keeper(settings(), replay=replay())
        keeper.background.aside = aside
        keeper.clock.replay.sources, keeper.clock.replay._next = [], []
        for name, one in harbour(until_s=330.0).items():
            if name == "radar":
                one = one.where(one.time_s < START_S + 200.0)
            keeper.picture.add(name, one)
        for t in np.arange(5.0, 330.0, 5.0):
            keeper.tick(START_S + t)
        keeper.background.register()
        keeper.background.search()
        keeper.background.search()
        offsets.append([str(one) for one in keeper.picture.biases.values()])
        faults.append({key: str(fault) for key, fault in keeper.background.faults.confirmed.items()})
        keeper.close()
    assert offsets[0] == offsets[1] and len(offsets[0]) > 0
    assert faults[0] == faults[1] and any("radar: ends" in words for words in faults[0].values())


def test_biases_are_estimated_soon_after_the_beginning_and_then_at_growing_intervals():
    """The first doubt about a radar that is read wrongly came after a minute or two; until then it confirmed alone."""

    async def begun(*first_s):
        times, now_s = [], [0.0]
        work = _Periodic(lambda: times.append(now_s[0]), 60.0, *first_s)
        for now_s[0] in np.arange(200.0).tolist():
            work.begin_if_due(now_s[0])
            await work.task
        return times

    assert asyncio.run(begun(10.0)) == [0.0, 10.0, 30.0, 70.0, 130.0, 190.0]
    assert asyncio.run(begun()) == [0.0, 60.0, 120.0, 180.0]
