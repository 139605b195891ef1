"""The log of alarms: they begin and end, are acknowledged, and a flood of them hides no other."""

import math
import os
import sqlite3
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.live.conftest import START_S

from sameas.cli.watch import EditedFile, News
from sameas.live.alarms import AlarmLog, ConfirmedFaults, fault_alarms
from sameas.live.inputs import WireState
from sameas.live.journal import Journal, Store
from sameas.live.situation import Alarm
from sameas.tracks.faults import Fault
from sameas.tracks.reports import Reports


def test_the_terminal_shows_an_alarm_once_however_long_the_ticks_are():
    log = AlarmLog(Store(None), START_S)
    news = News({}, log)
    for t in (0.0, 30.0, 60.0):
        log.update([Alarm("cpa 1", "cpa", "A will pass at 100 m in 2.0 min", (1,))], START_S + t)
        log.update([Alarm("cpa 1", "cpa", "A will pass at 100 m in 1.5 min", (1,))], START_S + t)
    assert sum("will pass" in line for line in news()) == 1 and not news()


def test_a_flood_of_alarms_is_a_few_lines_with_a_count_and_hides_no_other_alarm():
    log, clock = AlarmLog(Store(None), START_S), [0.0]
    news = News({}, log, clock=lambda: clock[0])
    forged = [Alarm(f"identity mmsi {k}", "identity", f"MMSI {k} is forged", (k,)) for k in range(400)]
    log.update([*forged[:350], Alarm("silent radar", "source", "radar is silent")], START_S)
    lines = news()
    assert [line.endswith(f" MMSI {k} is forged") for k, line in enumerate(lines)] == [True] * 5 + [False, False]
    assert "radar is silent" in lines[5] and "and 345 more of identity" in lines[6]
    # Further ones within the minute are one line at its end.
    clock[0] = 30.0
    log.update(forged[350:], START_S + 30.0)
    assert news() == []
    clock[0] = 61.0
    [line] = news()
    assert "and 50 more of identity" in line
    clock[0] = 130.0
    log.update([Alarm("identity mmsi 500", "identity", "MMSI 500 is forged", (1,))], START_S + 130.0)
    assert len(news()) == 1


def test_every_second_names_the_most_urgent_approaches():
    """An approach is a danger of its own, whatever began a while ago."""
    log, clock = AlarmLog(Store(None), START_S), [0.0]
    news = News({}, log, clock=lambda: clock[0])
    fleet = [Alarm(f"cpa {k}", "cpa", f"{k} will pass", (k,)) for k in range(100)]
    log.update(fleet[:90], START_S)
    assert len(news()) == 6
    clock[0] = 1.0
    log.update(fleet[90:91], START_S + 1.0)
    assert len(news()) == 1


def test_the_terminal_says_once_that_an_input_has_own_ship():
    """With several, the user sees which one has been taken."""
    wire: Any = SimpleNamespace(state=WireState(), stream=SimpleNamespace(own_ship=(math.nan, math.nan, math.nan)))
    news = News({"udp://:1": wire}, AlarmLog(Store(None), START_S), names_own_ship=False)
    assert news() == []
    wire.stream.own_ship = (50.0, -1.0, math.nan)
    assert "udp://:1 has own ship's position" in news()[0] and news() == []
    news = News({"udp://:1": wire}, AlarmLog(Store(None), START_S))
    assert news() == []


def test_a_short_break_of_a_connection_is_no_line():
    wire: Any = SimpleNamespace(state=WireState(connected=True, connections=1), stream=None)
    news = News({"tcp://a:1": wire}, AlarmLog(Store(None), START_S))
    assert news() == ["  tcp://a:1: connected"]
    wire.state.connections = 2
    assert news() == []
    wire.state.connected, wire.state.error = False, "Connection refused"
    assert news() == ["  tcp://a:1: Connection refused"] and news() == []
    wire.state.connected = True
    assert news() == ["  tcp://a:1: connected"]


def test_a_sensor_file_that_is_edited_meanwhile_is_said_once_with_its_errors(tmp_path):
    path = tmp_path / "sensors.toml"

    def written(text):
        path.write_text(text)
        os.utime(path, ns=(next(times), next(times)))

    times = iter(range(10**18, 10**18 + 10**12, 10**10))
    written('[sources.coast]\nkind = "ais"\ninput = "udp://127.0.0.1:60004"\n')
    edited = EditedFile(path, "begin again to use it")
    assert edited() == []
    written('[sources.coast]\nkind = "ais"\ninput = "udp://127.0.0.1:60005"\n')
    assert edited() == [f"  {path} has changed: begin again to use it"] and edited() == []
    written('[sources.coast]\nkind = "ais"\ninput = "udp://127.0.0.1:60005"\n[sources.mast]\nkind = "rader"\n')
    lines = edited()
    assert "has changed: begin" in lines[0] and "mast" in lines[1] and "rader" in lines[1] and edited() == []
    written("[sources.coast\n")
    [line] = edited()
    assert "has changed, but cannot be used" in line and edited() == []
    path.unlink()
    assert edited() == []


def opened(folder):
    """The log of a new watch in a folder, and its store."""
    store = Store(folder)
    return AlarmLog(store, START_S), store


@pytest.mark.parametrize("saved", [True, False])
def test_alarms_are_acknowledged_and_kept_when_they_end(saved, tmp_path):
    log, store = opened(tmp_path / "state" if saved else None)
    alarm = Alarm("cpa 1", "cpa", "A will pass at 100 m in 2.0 min", (1,))
    log.update([alarm], START_S + 2.0)
    [one] = log.rows()
    assert (one["text"], one["objects"], one["active"], one["acknowledged_by"]) == (alarm.text, [1], 1, None)
    assert (one["id"] > 0) == saved and "cpa 1" in log and "cpa 2" not in log
    assert log.acknowledge(one["id"], "mate", START_S + 3.0)
    assert not log.acknowledge(one["id"], "cook", START_S + 4.0)
    assert (log.rows()[0]["acknowledged_by"], log.rows()[0]["acknowledged_s"]) == ("mate", START_S + 3.0)
    # A condition that is absent for less than 10 s is the same alarm.
    log.update([], START_S + 11.0)
    log.update([alarm], START_S + 12.0)
    log.update([], START_S + 60.0)
    [one] = log.rows()
    assert (one["active"], one["acknowledged_by"], one["last_s"]) == (0, "mate", START_S + 12.0)
    # One that begins again is another.
    log.update([alarm], START_S + 90.0)
    assert [one["active"] for one in log.rows()] == [1, 0] and len(log.rows(most_ended=0)) == 1
    store.close()


def test_an_alarm_that_is_none_is_not_acknowledged(tmp_path):
    for folder in (tmp_path / "state", None):
        log, store = opened(folder)
        assert not any(log.acknowledge(number, "mate", START_S) for number in (7, 2**63, -(10**30)))
        assert not store.refusal
        store.close()


def test_alarms_that_the_disk_refused_are_in_the_journal_later_with_who_acknowledged_them(tmp_path, monkeypatch):
    log, store = opened(tmp_path / "state")
    alarm = Alarm("silent radar", "source", "radar is silent")

    def full(*_, **__):
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(Journal, "alarm", full)
        log.update([alarm], START_S)
        [one] = log.rows()
        assert one["id"] < 0 and store.refusal == "database or disk is full"
        assert log.acknowledge(one["id"], "mate", START_S + 1.0)
    log.update([alarm], START_S + 2.0)
    [one] = log.rows()
    assert one["id"] > 0 and (one["acknowledged_by"], one["acknowledged_s"]) == ("mate", START_S + 1.0)
    assert store.refusal == ""
    store.close()


def test_an_alarm_of_a_full_disk_is_in_the_journal_with_its_times_though_it_has_ended(tmp_path, monkeypatch):
    log, store = opened(tmp_path / "state")
    alarms = [Alarm("cpa 1", "cpa", "A will pass", (1,)), Alarm("silent radar", "source", "radar is silent")]

    def full(*_, **__):
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(Journal, "alarm", full)
        log.update(alarms, START_S)
        log.update(alarms[1:], START_S + 60.0)
        assert {(one["id"] > 0, one["active"]) for one in log.rows()} == {(False, 0), (False, 1)}
    log.update(alarms[1:], START_S + 61.0)
    ended, active = sorted(log.rows(), key=lambda one: one["key"])
    assert ended["id"] > 0 and (ended["first_s"], ended["last_s"], ended["active"]) == (START_S, START_S, 0)
    assert active["id"] > 0 and (active["first_s"], active["active"]) == (START_S, 1) and not log._unsaved
    store.close()


def test_a_disk_that_is_full_now_and_then_is_said_once(tmp_path, caplog):
    _, store = opened(tmp_path / "state")

    def full(_):
        raise sqlite3.OperationalError("database or disk is full")

    for _ in range(3):
        store.attempt(full)
        assert store.refusal == "database or disk is full"
        store.attempt(lambda _: None)
        assert store.refusal == ""
    assert len(caplog.records) == 1
    store.close()


def test_alarms_that_were_active_when_a_watch_was_closed_go_on(tmp_path):
    log, store = opened(tmp_path / "state")
    alarm = Alarm("silent radar", "source", "radar is silent")
    log.update([alarm], START_S)
    store.close()
    log, store = opened(tmp_path / "state")
    log.update([alarm], START_S + 1.0)
    assert len(log.rows()) == 1 and not log.begun
    store.close()


def shown(members, **records):
    """A situation of objects at 0 m east, 100 m north times their number, with records of an AIS receiver at (x, y)."""
    numbers = np.array(list(members), np.int64)
    at = np.array(records.get("received", np.empty((0, 2)))).reshape(-1, 2)
    return SimpleNamespace(
        members=members,
        objects={"object": numbers, "x_m": np.zeros(len(numbers)), "y_m": 100.0 * numbers},
        records={"source": np.full(len(at), "ais"), "x_m": at[:, 0], "y_m": at[:, 1], "age_s": np.zeros(len(at))},
    )


def silence(mmsi, track):
    words = f"{mmsi} has gone silent"
    return Fault("silent", "ais", START_S, START_S + 200.0, 9.0, words, mmsi, (("radar", track),))


def report(mmsi, after_s):
    place = {"time_s": [START_S + after_s], "x_m": [0.0], "y_m": [0.0], "mmsi": [mmsi]}
    return Reports.of("ais", "ais", place)


def test_a_ship_is_silent_until_she_reports_again_or_nothing_shows_her():
    """The searches see ten minutes: her alarm ended while she was still dark, and had no object to look at."""
    faults, fault = ConfirmedFaults(), silence("235000111", "7")
    seen = shown({4: (("radar", "7"),), 5: (("radar", "8"),)})
    for _ in range(2):
        faults.update([fault], seen)
    assert [alarm.objects for alarm in fault_alarms(faults.confirmed, seen)] == [(4,)]
    # The radar gives her another track number meanwhile.
    for members in ((("radar", "7"), ("other", "1")), (("other", "1"),)):
        seen.members[4] = members
        faults.update([], seen)
    assert [alarm.objects for alarm in fault_alarms(faults.confirmed, seen)] == [(4,)]
    gone = ConfirmedFaults(faults.confirmed)
    gone.update([], shown({5: (("radar", "8"),)}))
    assert not gone.confirmed
    for mmsi, after_s, silent in (("235000222", 900.0, 1), ("235000111", -5.0, 1), ("235000111", 900.0, 0)):
        faults.take(report(mmsi, after_s))
        assert len(faults.confirmed) == silent


@pytest.mark.parametrize(("at", "received", "silent"), [(9, [], 0), (30, [], 1), (9, [[0.0, 500.0]], 1)])
def test_a_ship_is_not_silent_where_others_were_and_reported_again(at, received, silent):
    """Every ship that passed behind an island was an alarm, each time. Where somebody is received is no such place."""
    faults, first, second = ConfirmedFaults(), silence("235000111", "7"), silence("235000222", "8")
    for _ in range(2):
        faults.update([first], shown({4: (("radar", "7"),)}))
    assert len(faults.confirmed) == 1
    faults.take(report("235000111", 400.0))
    assert not faults.confirmed
    for _ in range(2):
        faults.update([second], shown({at: (("radar", "8"),)}, received=received))
    assert len(faults.confirmed) == silent
    # She leaves the place behind the island, and is silent still.
    faults.update([second], shown({40: (("radar", "8"),)}))
    assert len(faults.confirmed) == 1
