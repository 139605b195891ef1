"""JSON of gpsd and AIS-catcher: the same reports as from the sentences, in files and in streams."""

import json

import numpy as np
import pytest

from sameas.io.sensors import read_reports
from sameas.io.sensors.gpsd import JsonMessages
from sameas.io.sensors.stream import ReportStream, format_of

START_S = 1780315200.0  # 2026-06-01 12:00
VERSION = {"class": "VERSION", "release": "3.25", "proto_major": 3, "proto_minor": 15}
TPV = {
    "class": "TPV", "mode": 3, "time": "2026-06-01T12:00:00.000Z", "lat": 54.4, "lon": -10.3,
    "track": 30.0, "speed": 5.0,
}  # fmt: skip
ATT = {"class": "ATT", "heading": 33.0}
POSITION = {
    "class": "AIS", "type": 1, "mmsi": 211000001, "scaled": True, "status": 0, "turn": 0, "speed": 10.0,
    "accuracy": True, "lat": 54.5, "lon": -10.25, "course": 120.0, "heading": 511, "second": 57,
}  # fmt: skip
RAW = POSITION | {"scaled": False, "lat": 32_700_000, "lon": -6_150_000, "speed": 100, "course": 1200}
STATIC = {
    "class": "AIS", "type": 5, "mmsi": 211000001, "scaled": True, "imo": 9074729, "callsign": "DABC",
    "shipname": "EXAMPLE", "shiptype": 70, "to_bow": 100, "to_stern": 20, "to_port": 10, "to_starboard": 10,
}  # fmt: skip
SENTENCES = {
    "class": "AIS", "device": "AIS-catcher", "rxuxtime": START_S + 5.25, "type": 1, "mmsi": 227006760,
    "nmea": ["!AIVDM,1,1,,A,13HOI:0P0000VOHLCnHQKwvL05Ip,0*23"],
}  # fmt: skip


def written(tmp_path, *objects):
    path = tmp_path / "receiver.json"
    path.write_text("".join(json.dumps(one) + "\n" for one in objects))
    return path


@pytest.mark.parametrize("message", [POSITION, RAW])
def test_messages_of_gpsd_have_the_time_of_its_receiver(message, tmp_path):
    [ships] = read_reports(written(tmp_path, VERSION, TPV, STATIC, message))
    assert (ships.mmsi[0], ships.name[0], ships.callsign[0]) == ("211000001", "EXAMPLE", "DABC")
    assert (ships.length_m[0], ships.width_m[0], ships.type[0], ships.heading_deg) == (120.0, 20.0, "cargo", None)
    np.testing.assert_allclose([ships.extra["antenna_lat_deg"][0], ships.extra["antenna_lon_deg"][0]], [54.5, -10.25])
    np.testing.assert_allclose(ships.speed_m_per_s, 10.0 * 1852 / 3600)
    assert ships.course_deg[0] == 120.0 and ships.time_s[0] == START_S - 3.0


def test_sentences_that_ais_catcher_carries_are_read_at_their_time(tmp_path):
    [ships] = read_reports(written(tmp_path, SENTENCES))
    assert ships.mmsi.tolist() == ["227006760"] and ships.time_s[0] == pytest.approx(START_S + 5.25, abs=60.0)


@pytest.mark.parametrize("time", [{"toa": START_S + 5.25}, {"rxtime": "20260601120005"}])
def test_the_time_of_receipt_has_several_names_in_ais_catcher(time, tmp_path):
    """Its decoded messages have no ``rxuxtime``, at times."""
    [ships] = read_reports(written(tmp_path, POSITION | {"second": 60} | time))
    assert ships.time_s[0] == pytest.approx(START_S + 5.0, abs=0.3)


def test_a_damaged_object_is_counted(tmp_path):
    path = written(tmp_path, TPV, POSITION, POSITION | {"lat": "north"})
    path.write_text(path.read_text() + '{"class": "AIS"')
    [ships] = read_reports(path)
    assert len(ships) == 1 and ships.damaged.lines.tolist() == [3, 4]


@pytest.mark.parametrize("first", [VERSION, TPV, POSITION, SENTENCES])
def test_a_stream_has_own_ship_and_ships_at_their_times_of_receipt(first):
    data = "".join(json.dumps(one) + "\n" for one in (first, TPV, ATT, STATIC, POSITION, SENTENCES)).encode()
    assert format_of(data[:120]) == "gpsd"
    stream, found = ReportStream("boat"), []
    for k in range(0, len(data), 41):
        stream.feed(data[k : k + 41], START_S + 5.25)
        found += stream.reports()
    assert {mmsi for reports in found for mmsi in reports.mmsi} == {"211000001", "227006760"}
    assert stream.own_ship == pytest.approx((54.4, -10.3, 33.0))
    assert stream.own_velocity == pytest.approx((5.0, 30.0), abs=1e-4)


def test_a_receiver_without_a_fix_is_nowhere():
    assert JsonMessages()(json.dumps({"class": "TPV", "mode": 1, "time": "2026-06-01T12:00:00Z"})) == []
    assert JsonMessages()(json.dumps({"class": "SKY", "satellites": []})) == ()
