"""NMEA 2000: messages packed by hand, in every form of a log, give the reports of AIS and ARPA."""

import json
import math
import struct
from base64 import b64encode

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.sensors import ReadOptions, n2k, read_reports
from sameas.io.sensors.nmea import checksum
from sameas.io.sensors.stream import ReportStream, format_of

START_S = 1780315200.0  # 2026-06-01 12:00


def rad(degrees):
    return round(math.radians(degrees) * 1e4)


def position(mmsi=211000001, lat=54.5, lon=-10.25, course=120.0, speed=8.0, heading=118.0, status=0, channel=0):
    motion = 0xFFFF if course is None else rad(course), round(speed * 100)
    compass = 0xFFFF if heading is None else rad(heading)
    return 129038, struct.pack(
        "<BIiiBHH3BHhBBB", 1, mmsi, round(lon * 1e7), round(lat * 1e7), 1 | 17 << 2, *motion, 0, 0, channel << 3,
        compass, 0, status, 0, 255,
    )  # fmt: skip


def static(mmsi=211000001, name="EXAMPLE"):
    sizes = [round(10 * size) for size in (120.0, 20.0, 8.0, 100.0)]
    return 129794, struct.pack(
        "<BII7s20sB4HHIH20sBB", 5, mmsi, 9074729, b"DABC@@@", name.encode().ljust(20, b"@"), 70, *sizes, 0, 0, 750,
        b"KIEL".ljust(20), 0, 0,
    )  # fmt: skip


def target(number=7, bearing=45.0, range_m=3704.0, status=2, reference=0):
    motion = rad(90.0), 500
    of_target = struct.pack("<BHBHi", 0, number, status | reference << 4, rad(bearing), round(100 * range_m))
    return 128520, of_target + struct.pack("<HHiiI", *motion, 0, 0, 0xFFFFFFFF)


GNSS_PLACE = 129025, struct.pack("<ii", round(54.4e7), round(-10.3e7))
MOTION = 129026, struct.pack("<BBHHH", 0, 0xFC, rad(30.0), 500, 0xFFFF)
GYRO = 127250, struct.pack("<BHhhB", 0, rad(33.0), 0x7FFF, 0x7FFF, 0xFC)
COMPASS = 127250, struct.pack("<BHhhB", 0, rad(30.0), 0x7FFF, rad(-2.5), 0xFD)
CLOCK = 126992, struct.pack("<BBHI", 0, 0xF0, int(START_S // 86400), round(START_S % 86400 * 1e4))
#: Engine speed, which is of no interest.
ENGINE = 127488, bytes(8)


def frames(pgn, data, number=3, source=43):
    """The CAN identifier of a message, and the bytes of its frames."""
    can_id = 6 << 26 | pgn << 8 | source
    if len(data) <= 8:
        return can_id, [data]
    parts = [data[:6], *(data[k : k + 7] for k in range(6, len(data), 7))]
    heads = [bytes([number << 5, len(data)]), *(bytes([number << 5 | k]) for k in range(1, len(parts)))]
    return can_id, [(head + part).ljust(8, b"\xff") for head, part in zip(heads, parts, strict=True)]


def candump_log(time_s, message):
    can_id, parts = frames(*message)
    return [f"({time_s:.6f}) can0 {can_id:08X}#{part.hex().upper()}" for part in parts]


def candump(time_s, message):
    can_id, parts = frames(*message)
    return [f" ({time_s:.6f})  can0  {can_id:08X}   [{len(part)}]  {part.hex(' ').upper()}" for part in parts]


def yacht_devices(time_s, message):
    can_id, parts = frames(*message)
    seconds = time_s % 60.0
    return [f"12:{int(time_s // 60 % 60):02d}:{seconds:06.3f} R {can_id:08X} {part.hex(' ').upper()}" for part in parts]


def canboat(time_s, message):
    pgn, data = message
    moment = np.datetime64(round(time_s * 1000), "ms")
    return [f"{moment}Z,4,{pgn},43,255,{len(data)},{data.hex(',')}"]


def canboat_frames(time_s, message):
    moment = str(np.datetime64(round(time_s * 1000), "ms")).replace("T", "-")
    return [f"{moment},4,{message[0]},43,255,{len(part)},{part.hex(',')}" for part in frames(*message)[1]]


def signal_k(time_s, message):
    """As the log of a Signal K server has them."""
    return [f"{round(time_s * 1000)};A;{line}" for line in canboat(time_s, message)]


def candump_dated(time_s, message):
    """With -tA and -a."""
    moment = str(np.datetime64(round(time_s * 1e6), "us")).replace("T", " ")
    return [line.replace(f"{time_s:.6f}", moment) + "   '..q.Z..'" for line in candump(time_s, message)]


def pcdin(_, message, source=43):
    pgn, data = message
    body = f"PCDIN,{pgn:06X},00000000,{source:02X},{data.hex().upper()}"
    return [f"${body}*{checksum(body):02X}"]


def pdgy(time_s, message, source=43):
    pgn, data = message
    return [f"!PDGY,{pgn},6,{source},255,{time_s % 60.0:.2f},{b64encode(data).decode().rstrip('=')}"]


FORMS = (candump_log, candump, candump_dated, yacht_devices, canboat, canboat_frames, signal_k, pcdin, pdgy)


def log(form, *messages, every_s=1.0):
    return [line for k, message in enumerate(messages) for line in form(START_S + k * every_s, message)]


def written(tmp_path, lines):
    path = tmp_path / "bus.log"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_a_log_gives_ships_targets_and_own_ship(form, tmp_path):
    messages = CLOCK, GNSS_PLACE, GYRO, ENGINE, static(), position(), target()
    ships, targets = read_reports(written(tmp_path, log(form, *messages)), ReadOptions(source="bus"))
    assert (ships.source, targets.source) == ("bus:ais", "bus:arpa")
    assert (ships.mmsi[0], ships.name[0], ships.callsign[0], ships.type[0]) == ("211000001", "EXAMPLE", "DABC", "cargo")
    assert (ships.length_m[0], ships.width_m[0], ships.imo[0]) == (120.0, 20.0, "9074729")
    np.testing.assert_allclose([ships.course_deg[0], ships.heading_deg[0]], [120.0, 118.0], atol=0.1)
    np.testing.assert_allclose(ships.speed_m_per_s[0], 8.0, atol=0.03)
    # The antenna is 100 m abaft the bow of 120 m: the middle of the hull is 40 m ahead of it.
    north_m = (ships.lat_deg[0] - 54.5) * 111_300
    assert north_m == pytest.approx(40.0 * math.cos(math.radians(118.0)), abs=3.0)
    assert targets.track_id[0] == "7" and targets.range_m[0] == pytest.approx(3704.0, abs=0.1)
    np.testing.assert_allclose([targets.bearing_deg[0], targets.course_deg[0]], [45.0, 90.0], atol=0.01)
    assert targets.speed_m_per_s[0] == pytest.approx(5.0, abs=0.001)
    np.testing.assert_allclose([targets.station_lat_deg[0], targets.station_lon_deg[0]], [54.4, -10.3], atol=1e-7)
    assert targets.station_heading_deg[0] == pytest.approx(33.0, abs=0.01)
    assert targets.time_s[0] == START_S + (0.0 if form in (yacht_devices, pcdin, pdgy) else 6.0)
    assert not len(ships.damaged.lines) and not len(targets.damaged.lines)


def analyzed(pgn, radians=False, **fields):
    """A message as JSON of canboat, or of canboatjs."""
    moment = "2026-06-01-12:00:03.000"
    names = {name: math.radians(value) if radians and name in ("COG", "Heading", "Bearing") else value
             for name, value in fields.items()}  # fmt: skip
    more = {"input": []} if radians else {}
    return json.dumps({"timestamp": moment, "prio": 4, "src": 43, "dst": 255, "pgn": pgn, **more, "fields": names})


@pytest.mark.parametrize("radians", [False, True])
def test_the_json_of_canboat_says_the_same(radians, tmp_path):
    place = {"Longitude": -10.25, "Latitude": 54.5, "Position Accuracy": "High", "Time Stamp": "1"}
    ship = {"Message ID": "Scheduled Class A position report", "User ID": 211000001}
    heard = {"AIS Transceiver information": "Channel B VDL reception"}
    motion = {"COG": 120.0, "SOG": 8.0, "Heading": 118.0, "Nav Status": "At anchor"}
    sizes = {
        "Length": 120.0,
        "Beam": 20.0,
        "Position reference from Starboard": 8.0,
        "Position reference from Bow": 100.0,
    }
    about = {
        "Name": "Example",
        "Callsign": "DABC",
        "IMO number": 9074729,
        "Type of ship": "Cargo, No additional information",
    }
    own = {"AIS Transceiver information": {"value": 4, "name": "Own information not broadcast"}}
    lines = [
        analyzed(129038, radians, **ship, **own, **place, **motion),
        analyzed(126992, Date="2026.06.01", Time="12:00:00.00000"),
        analyzed(129025, Latitude=54.4, Longitude=-10.3),
        analyzed(127250, radians, Heading=33.0, Reference="True"),
        analyzed(129794, **ship, **heard, **sizes, **about),
        analyzed(129038, radians, **ship, **heard, **place, **motion),
        analyzed(128520, radians, **{
            "Target ID #": 7, "Track Status": "Tracking", "Bearing Reference": "True", "Bearing": 45.0,
            "Distance": 3704.0, "Course": None, "Speed": 5.0,
        }),
        analyzed(127488, Speed=800.0), '{"pgn": 129038, "fields": 7}',
    ]  # fmt: skip
    assert format_of("\n".join(lines).encode()) == "n2k"
    ships, targets = read_reports(written(tmp_path, lines))
    assert (ships.mmsi[0], ships.name[0], ships.callsign[0], ships.type[0]) == ("211000001", "EXAMPLE", "DABC", "cargo")
    assert (ships.length_m[0], ships.extra["nav_status"][0], ships.covariance_m2[0, 0] > 25.0) == (120.0, 1.0, True)
    np.testing.assert_allclose([ships.course_deg[0], ships.heading_deg[0]], [120.0, 118.0], atol=0.1)
    np.testing.assert_allclose(ships.speed_m_per_s[0], 8.0, atol=0.03)
    assert targets.track_id[0] == "7" and targets.bearing_deg[0] == pytest.approx(45.0)
    assert targets.station_heading_deg[0] == pytest.approx(33.0) and targets.course_deg is None
    assert ships.passed_over == {"own ship's own report (VDO)": 1} and ships.damaged.lines.tolist() == [9]


def test_the_angles_of_canboat_with_si_are_radians(tmp_path):
    """``-si`` says nothing of it: courses of 0° to 6.28° were read."""
    lines = [
        analyzed(126992, Date="2026.06.01", Time="12:00:00.00000"), analyzed(129025, Latitude=54.4, Longitude=-10.3),
        analyzed(127250, Heading=round(math.radians(33.0), 4), Reference="True"),
        analyzed(128520, **{
            "Target ID #": 7, "Track Status": "Tracking", "Bearing Reference": "True", "Distance": 3704.0, "Speed": 5.0,
            "Bearing": round(math.radians(45.0), 4), "Course": round(math.radians(90.0), 4),
        }),
    ]  # fmt: skip
    [targets] = read_reports(written(tmp_path, lines))
    angles = targets.bearing_deg[0], targets.course_deg[0], targets.station_heading_deg[0]
    np.testing.assert_allclose(angles, [45.0, 90.0, 33.0], atol=0.01)


def test_what_own_transponder_sends_is_own_ship(tmp_path):
    own = position(mmsi=211999999, lat=54.45, lon=-10.2, channel=4)
    ships, targets = read_reports(written(tmp_path, log(canboat, own, position(), target())))
    assert ships.mmsi.tolist() == ["211000001"]
    assert ships.passed_over == {"own ship's own report (VDO)": 1}
    assert targets.station_lat_deg[0] == pytest.approx(54.45, abs=1e-6)


def test_what_is_not_available_is_missing(tmp_path):
    [ships] = read_reports(
        written(tmp_path, log(canboat, position(course=None, speed=655.35, heading=None, status=15)))
    )
    assert ships.course_deg is None and ships.speed_m_per_s is None and ships.heading_deg is None


def test_a_message_whose_frames_are_lost_is_none_and_what_is_cut_off_is_counted(tmp_path):
    lines = log(candump_log, static(), position())
    del lines[2]
    [ships] = read_reports(written(tmp_path, [*lines, "(1780315203.000000) can0 09F80", "nonsense"]))
    assert len(ships) == 1 and ships.name is None
    assert ships.damaged.sentences() == ["2 lines damaged: no frame of NMEA 2000 (lines 16, 17)"]


def test_a_log_without_ships_and_targets_says_what_it_has(tmp_path):
    with pytest.raises(InputError, match=r"no AIS .VDM. and no radar targets .* HDT, VTG"):
        read_reports(written(tmp_path, log(canboat, MOTION, GYRO)))


@pytest.mark.parametrize("form", FORMS)
def test_a_stream_in_any_pieces_has_own_ship_and_the_same_reports(form):
    messages = CLOCK, GNSS_PLACE, MOTION, COMPASS, static(), position(), target(), target(status=3), target(number=8)
    data = "\n".join(log(form, *messages)).encode() + b"\n"
    assert format_of(data) == "n2k"
    stream, found = ReportStream("bus"), {}
    for k in range(0, len(data), 37):
        stream.feed(data[k : k + 37], START_S + 3.0)
        for reports in stream.reports():
            found.setdefault(reports.source, []).extend(reports.track_id.tolist())
    assert found == {"bus:ais": ["211000001"], "bus:arpa": ["7", "8"]}
    assert stream.own_ship == pytest.approx((54.4, -10.3, 27.5), abs=0.01)
    assert stream.own_velocity == pytest.approx((5.0, 30.0), abs=0.01)
    assert not stream.damaged


def test_lost_targets_and_bearings_of_no_known_reference_are_no_reports():
    translate = n2k.Bus()
    lines = [log(canboat, one)[0] for one in (target(), target(reference=2))]
    assert [["RATTM" in text for text in translate(line)] for line in lines] == [[True], []]
