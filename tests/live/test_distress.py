"""Devices and aircraft in distress are alarms, in a file and live; devices in a test are none."""

from typing import Any

import numpy as np
import pytest
from tests.live.conftest import START_S, replay

from sameas.io.sensors import ReadOptions, read_reports
from sameas.io.sensors.sentences import AisWriter, clock
from sameas.live.keeper import Keeper
from sameas.live.settings import LiveSource, OwnShip, Settings, WatchSettings
from sameas.picture import Picture
from sameas.tracks import Description, Reports, Scene
from sameas.tracks.distress import CALL_S, CODE_S, distress_calls

SART, TESTED, SHIP = "970012345", "970054321", "211700001"


def log(tmp_path, calls=((SART, 14), ("972098765", 14), ("974011223", 14), (TESTED, 15))):
    """The log of a receiver with a ship and devices by MMSI and status."""
    write, lines = AisWriter(), []
    for t in np.arange(0.0, 120.0, 10.0):
        lines.append(clock(START_S + t))
        for k, (mmsi, status) in enumerate(((SHIP, 0), *calls)):
            place = {"lat": 54.6 + 0.01 * k, "lon": 12.3, "speed": 0.4, "course": 90.0}
            lines += write({"type": 1, "mmsi": mmsi, "status": status, **place, "second": int(START_S + t) % 60})
    (tmp_path / "log.nmea").write_text("\n".join(lines) + "\n")
    [reports] = read_reports(tmp_path / "log.nmea", ReadOptions(source="log"))
    return reports


def test_devices_that_are_not_tested_call_for_help(tmp_path):
    reports = log(tmp_path)
    picture = Picture.of(Scene.of([(Description("log", "ais"), reports)]), [START_S + 60.0, START_S + 110.0])
    words = [str(call) for call in picture.summary.calls]
    assert [text.partition(" calls")[0] for text in words] == [
        f"AIS-SART {SART}",
        "MOB device 972098765",
        "EPIRB 974011223",
    ]
    assert "at 54°36.60' N 012°18.00' E, received by log" in words[0]
    assert picture.summary.lines()[0].startswith(f"alarm: AIS-SART {SART} calls for help")
    at = np.flatnonzero(picture.objects["mmsi"] == SART)
    assert set(picture.objects["type"][at]) == {"AIS-SART"}
    assert set(picture.objects["label"][at]) == {f"AIS-SART {SART}"}


@pytest.mark.parametrize(
    ("status", "calls"), [(None, 1), (["14"] * 3, 1), (["ais-sart is active"] * 3, 1), (["15"] * 3, 0)]
)
def test_a_table_may_have_no_status_or_words(tmp_path, status, calls):
    rows = [f"{START_S + 10 * k:.0f},{SART},54.6,12.3" + ("" if status is None else f",{status[k]}") for k in range(3)]
    head = "time,mmsi,lat,lon" + ("" if status is None else ",navstatus")
    (tmp_path / "ais.csv").write_text("\n".join([head, *rows]) + "\n")
    assert len(distress_calls(read_reports(tmp_path / "ais.csv"))) == calls


def received(t, *, mmsi=SART, lat=54.6, speed=0.2, source="ais"):
    columns = {"time_s": [t], "lat_deg": [lat], "lon_deg": [12.3], "speed_m_per_s": [speed], "course_deg": [0.0]}
    return Reports.of(source, "ais", columns | {"mmsi": [mmsi], "track_id": [mmsi], "nav_status": [14.0]})


def watch(folder=None, **given):
    keeper = Keeper(Settings({"ais": LiveSource(Description("ais", "ais"))}, WatchSettings(**given)), folder,
                    replay=replay())  # fmt: skip
    keeper.clock.replay.sources, keeper.clock.replay._next = [], []
    return keeper


def test_a_live_call_is_an_alarm_at_once_and_for_as_long_as_it_is_repeated():
    keeper, active = watch(), {}
    for t in (0.0, 1.0, 60.0, 200.0, 60.0 + CALL_S, 62.0 + CALL_S):
        if t in (0.0, 60.0):
            keeper._use("ais", received(START_S + t))
        active[t] = [one for one in keeper.tick(START_S + t).alarms if one.kind == "distress"]
    keeper.close()
    assert [len(one) for one in active.values()] == [1, 1, 1, 1, 1, 0]
    assert active[0.0][0].key == f"distress {SART}" and len(active[0.0][0].objects) == 1


def test_a_call_survives_a_kill_and_stays_one_alarm(tmp_path):
    killed = watch(tmp_path, save_every_s=1e9)
    killed.tick(START_S)
    killed._use("ais", received(START_S + 1.0))
    killed.tick(START_S + 1.0)
    [alarm] = killed.alarm_list()
    assert killed.acknowledge(alarm["id"], "mate")
    killed.store.journal.close()
    again = watch(tmp_path)
    # The device is silent for a minute, and then sends on.
    for t in (20.0, 40.0, 60.0, 80.0):
        if t == 60.0:
            again._use("ais", received(START_S + t))
        again.tick(START_S + t)
    [row] = again.alarm_list()
    again.close()
    assert (row["kind"], row["active"], row["acknowledged_by"]) == ("distress", 1, "mate")
    assert row["id"] == alarm["id"]


@pytest.mark.parametrize(("mmsi", "alarms"), [(SART, {"distress"}), (SHIP, {"cpa"})])
def test_a_device_that_calls_for_help_is_to_be_approached(mmsi, alarms):
    keeper, kinds = watch(own_ship=OwnShip(mmsi="235000009"), cpa_m=500.0), set()
    for t in np.arange(0.0, 120.0, 10.0):
        for one, lat in ((mmsi, 54.6), ("235000009", 54.58 + 8.0 * t / 111_240.0)):
            keeper._use("ais", received(START_S + t, mmsi=one, lat=lat, speed=0.0 if one == mmsi else 8.0))
        kinds |= {alarm.kind for alarm in keeper.tick(START_S + t).alarms}
    keeper.close()
    assert kinds == alarms


def flown(t, code, *, source="mlat", **identity):
    """Reports of one aircraft at the times t (n,), with the codes (n,)."""
    t = np.asarray(t, np.float64)
    columns: dict[str, Any] = {"time_s": START_S + t, "lat_deg": 54.6 + 1e-3 * t, "lon_deg": np.full(len(t), 12.3)}
    columns |= {"track_id": ["7"] * len(t), "mode_a": code}
    return Reports.of(source, "table", columns | {name: [text] * len(t) for name, text in identity.items()})


@pytest.mark.parametrize(
    ("t", "code", "calls"),
    [
        ([0.0, 4.0, 8.0], ["1234", "7700", "7700"], 1),
        ([0.0, 4.0, 8.0], ["1234", "7700", "1234"], 0),  # garbled once
        ([0.0, 4.0, 8.0 + CODE_S], ["7600", "1234", "7600"], 0),  # and once more
        ([0.0, 4.0, 8.0], ["7000", None, "7000"], 0),
    ],
)
def test_a_code_of_distress_is_a_call_if_two_reports_have_it(t, code, calls):
    assert len(distress_calls([flown(t, code, icao="4ca123")])) == calls


@pytest.mark.parametrize(
    ("identity", "who", "label"),
    [
        ({"icao": "4ca123", "callsign": "RYR12"}, "aircraft 4ca123", "RYR12"),
        ({"callsign": "RYR12"}, "aircraft RYR12", "RYR12"),
        ({}, "an aircraft", "A7700"),
    ],
)
def test_an_aircraft_in_distress_is_an_alarm_of_its_object(identity, who, label):
    t = np.arange(0.0, 60.0, 5.0)
    scene = Scene.of([(Description("mlat", "mlat"), flown(t, ["7700"] * len(t), **identity))])
    picture = Picture.of(scene, START_S + np.array([30.0, 55.0]))
    [call] = picture.summary.calls
    assert str(call).startswith(f"{who} squawks 7700, emergency, at 54°39.30' N 012°18.00' E")
    own = picture.objects[call.column] == call.identity
    assert own.all() and set(picture.objects["label"]) == {label}


def test_a_live_code_is_an_alarm_from_its_second_report_until_it_is_changed():
    keeper, active = watch(), {}
    for t, code in ((0.0, "7700"), (5.0, "7700"), (10.0, "2000"), (66.0, "2000")):
        keeper._use("ais", flown([t], [code], source="ais", icao="4ca123"))
        active[t] = [one for one in keeper.tick(START_S + t).alarms if one.kind == "distress"]
    keeper.close()
    assert [len(one) for one in active.values()] == [0, 1, 1, 0]
    assert active[5.0][0].key == "distress 4ca123"
