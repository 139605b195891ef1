"""Tables of drones: messages of MAVLink in their own units, and Remote ID, whose speeds are metres a second."""

import base64
import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sameas.io.sensors import read_reports
from sameas.io.sensors.sources import read_sources

OF_VEHICLE = ["time_boot_ms", "lat", "lon", "alt", "relative_alt", "vx", "vy", "vz", "hdg"]
OF_AIRCRAFT = [
    "ICAO_address",
    "lat",
    "lon",
    "altitude_type",
    "altitude",
    "heading",
    "hor_velocity",
    "ver_velocity",
    "callsign",
    "emitter_type",
    "tslc",
    "flags",
    "squawk",
]


def written(path, message, fields, *rows):
    """A table as ``mavlogdump --format csv --types …`` writes it."""
    names = ["timestamp", *(f"{message}.{field}" for field in fields)]
    path.write_text("\n".join(",".join(map(str, row)) for row in (names, *rows)) + "\n")
    return path


def test_a_vehicle_of_mavlink_is_read_in_its_units_with_x_towards_north(tmp_path):
    row = (1714564800.25, 100250, 520012345, 44000001, 52000, 40000, 300, -400, -150, 9000)
    unknown = (1714564800.75, 100750, 520012350, 44000001, 52000, 40000, 300, -400, -150, 65535)
    path = written(tmp_path / "log.csv", "GLOBAL_POSITION_INT", OF_VEHICLE, row, unknown)
    [source] = read_sources([path])
    reports = source.reports
    assert source.description.kind == "drone" and reports.object_ids.tolist() == ["vehicle 1"] * 2
    assert reports.lat_deg[0] == pytest.approx(52.0012345) and reports.alt_m[0] == pytest.approx(52.0)
    np.testing.assert_allclose(reports.velocity_m_per_s()[0], [-4.0, 3.0])
    np.testing.assert_allclose(reports.climb_m_per_s, 1.5)
    np.testing.assert_allclose(reports.heading_deg, [90.0, np.nan])
    assert "read as GLOBAL_POSITION_INT of MAVLink" in "\n".join(reports.summary())


def test_messages_of_mavlink_in_lines_of_json_are_read_like_those_in_a_table(tmp_path):
    data = dict(zip(OF_VEHICLE, (1, 520000000, 44000000, 52000, 40000, 300, -400, -150, 9000), strict=True))
    lines = [
        {"meta": {"type": "ATTITUDE", "timestamp": 1714564800.0, "srcSystem": 7}, "data": {"roll": 0.1}},
        {"meta": {"type": "GLOBAL_POSITION_INT", "timestamp": 1714564800.5, "srcSystem": 7}, "data": data},
    ]
    path = tmp_path / "log.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    [reports] = read_reports(path)
    assert reports.lat_deg.tolist() == [52.0] and reports.object_ids.tolist() == ["vehicle 7"]
    np.testing.assert_allclose(reports.velocity_m_per_s(), [[-4.0, 3.0]])


def test_aircraft_of_mavlink_have_hexadecimal_addresses_and_only_what_their_flags_call_valid(tmp_path):
    pressure = (
        1714564800.0,
        4735555,
        520000000,
        44000000,
        0,
        350000,
        9000,
        6000,
        250,
        "PHABC",
        1,
        0,
        1 + 2 + 4 + 8,
        7000,
    )
    geometric = (1714564801.0, 4735555, 520000000, 44010000, 1, 350000, 9000, 6000, 250, "PHABC", 1, 0, 255, 7000)
    nowhere = (1714564802.0, 4735555, 0, 0, 1, 350000, 9000, 6000, 250, "PHABC", 1, 0, 2, 7000)
    path = written(tmp_path / "log.csv", "ADSB_VEHICLE", OF_AIRCRAFT, pressure, geometric, nowhere)
    [source] = read_sources([path])
    reports = source.reports
    assert source.description.kind == "ads-b" and reports.icao.tolist() == ["484243"] * 2
    np.testing.assert_allclose(reports.alt_m, [np.nan, 350.0])
    np.testing.assert_allclose(reports.pressure_alt_m, [350.0, np.nan])
    np.testing.assert_allclose(reports.velocity_m_per_s()[:, 0], 60.0)
    assert reports.callsign.tolist() == [None, "PHABC"] and reports.mode_a.tolist() == [None, "7000"]


def test_speeds_beside_a_direction_are_knots_in_tables_of_flightradar24_only(tmp_path):
    names = "timestamp,uas_id,latitude,longitude,geodetic_altitude,speed,direction,operator_id"
    path = tmp_path / "rid.csv"
    path.write_text(
        f"{names}\n1714564800,1581F4X,52.0,4.4,95,10,90,NLD1\n1714564801,1581F4X,52.0,4.4,-1000,10,361,NLD1\n"
    )
    [source] = read_sources([path])
    assert source.description.kind == "drone" and source.reports.object_ids.tolist() == ["1581F4X"] * 2
    np.testing.assert_allclose(source.reports.velocity_m_per_s()[0], [10.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(source.reports.alt_m, [95.0, np.nan])


def test_positions_of_a_camera_are_those_of_a_lidar(tmp_path):
    path = tmp_path / "pole_camera.csv"
    path.write_text(
        "timestamp_ns,class,x,y,z\n1714564800000000000,car,1.0,2.0,0.8\n1714564800100000000,car,1.1,2.0,0.8\n"
    )
    [source] = read_sources([path])
    assert source.description.kind == "lidar" and "which a camera does not measure" in str(source.why_kind)
    np.testing.assert_allclose(np.diff(source.reports.time_s), 0.1, atol=1e-6)


def basic_id(name):
    return struct.pack("<BB20s3x", 0x02, 0x12, name.encode())


def location(lat=50.7, lon=-1.1, *, course=275.0, speed=70.0, climb=-2.5, alt=62.0, accuracy=11):
    """A location message: speeds above 63.75 m/s and courses above 180° have flags of their own."""
    flags = 0x20 | 2 * (course >= 180.0) | (speed > 63.75)
    speed_byte = round((speed - 63.75) / 0.75) if speed > 63.75 else round(speed / 0.25)
    heights = [round(2 * (height + 1000.0)) for height in (60.0, alt, 55.0)]
    place = round(lat * 1e7), round(lon * 1e7)
    return struct.pack(
        "<BBBBbiiHHHBBHBx", 0x12, flags, round(course % 180.0), speed_byte, round(2 * climb), *place, *heights,
        0x40 | accuracy, 0x33, 24_000, 1,
    )  # fmt: skip


AS_TEXT: dict[str, Callable[[bytes], Any]] = {
    "UASdata": lambda data: base64.b64encode(data).decode(),
    "raw": bytes.hex,
    "payload": list,
}


@pytest.mark.parametrize("name", AS_TEXT)
def test_messages_of_remote_id_in_json_are_read(tmp_path, name):
    pack = bytes([0xF2, 25, 2]) + basic_id("1581F45T7227Q000A123") + location()
    data = {"timestamp": 1714560000500, "MAC address": "60:60:1f:aa:bb:cc", "type": "BT5", name: AS_TEXT[name](pack)}
    (tmp_path / "receiver.jsonl").write_text(json.dumps({"protocol": 1.0, "data": data}) + "\n")
    [source] = read_sources([tmp_path / "receiver.jsonl"])
    reports = source.reports
    assert source.description.kind == "drone" and reports.track_id.tolist() == ["1581F45T7227Q000A123"]
    assert reports.time_s.tolist() == [1714560000.5] and reports.type is None
    assert (reports.lat_deg[0], reports.lon_deg[0]) == pytest.approx((50.7, -1.1), abs=1e-7)
    assert (reports.alt_m[0], reports.pressure_alt_m[0]) == (62.0, 60.0)
    assert (reports.course_deg[0], reports.climb_m_per_s[0]) == (275.0, -2.5)
    assert reports.speed_m_per_s[0] == pytest.approx(70.0, abs=0.4)
    assert reports.covariance_m2[0, 0] == pytest.approx(1.5, abs=0.01)  # 3 m with 95 %


def test_single_messages_of_remote_id_belong_to_the_drone_that_the_sender_names(tmp_path):
    messages = [
        ("aa", location()), ("aa", basic_id("1581F45T")), ("bb", location(lat=50.8)), ("aa", location(lon=-1.2)),
        ("bb", location(lat=0.0, lon=0.0)),
    ]  # fmt: skip
    lines = [
        json.dumps({"time": 1714560000 + k, "mac": mac, "raw": message.hex()})
        for k, (mac, message) in enumerate(messages)
    ]
    (tmp_path / "receiver.jsonl").write_text("\n".join(lines) + "\n")
    [reports] = read_reports(tmp_path / "receiver.jsonl")
    assert reports.track_id.tolist() == ["1581F45T", "BB", "1581F45T"] and reports.line.tolist() == [1, 3, 4]
    assert not len(reports.damaged.lines)


def test_the_time_of_a_decoded_message_is_that_of_its_receipt(tmp_path):
    place = {"Latitude": 50.7, "Longitude": -1.1, "Direction": 90.0, "TimeStamp": 24_012}
    row = {"timestamp": "2024-05-01T10:40:02Z", "BasicID": {"UASID": "1581F45T"}, "Location": place}
    (tmp_path / "receiver.jsonl").write_text(json.dumps(row) + "\n")
    [reports] = read_reports(tmp_path / "receiver.jsonl")
    assert reports.time_s.tolist() == [1714560002.0] and reports.track_id.tolist() == ["1581F45T"]
