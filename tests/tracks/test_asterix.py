"""ASTERIX: items and their values agree with libasterix."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.sensors import read_reports
from sameas.io.sensors.asterix import read
from sameas.io.sensors.asterix_records import CATEGORIES, DamagedRecord, letters, looks_like, octal, records_of
from sameas.io.sensors.captures import is_capture
from sameas.io.sensors.format import RADIUS_95

DATA = Path(__file__).parent / "data"
ORACLE = json.loads((DATA / "asterix_oracle.json").read_text())
DATE = 1714521600.0  # 2024-05-01
# Subfield names that differ between editions, at equal position and length.
RENAMED = {"ISA": "SAL", "GS": "GSP", "BDSDATA": "MB"}
NM, FL = 1852.0, 30.48


def recorded(k):
    return ORACLE["records"][k]["values"], bytes.fromhex(ORACLE["records"][k]["block"])


def block(category, data):
    return bytes([category]) + (len(data) + 3).to_bytes(2, "big") + data


def plot(seconds, number=1, distance=256):
    """Bytes of a category 048 record with items 010, 140, 040, 161."""
    tod = int(seconds * 128).to_bytes(3, "big")
    return bytes([0xD1, 0x10, 1, 2]) + tod + distance.to_bytes(2, "big") + b"\x40\0" + number.to_bytes(2, "big")


@pytest.mark.parametrize("case", ORACLE["layouts"], ids=lambda case: case["edition"])
def test_item_boundaries_follow_the_specification(case):
    found = list(records_of(CATEGORIES[case["category"]], bytes.fromhex(case["data"])))
    assert len(found) == len(case["records"]) == 4
    for items, expected in zip(found, case["records"], strict=True):
        assert set(items) == set(expected)
        for name, value in items.items():
            if isinstance(value, bytes):
                assert value.hex() == expected[name]
            else:
                subfields = {RENAMED.get(part, part): content for part, content in expected[name].items()}
                assert {part: content.hex() for part, content in value.items()} == subfields
    assert len(set().union(*case["records"])) >= 25


def test_a_radar_plot_agrees_with_libasterix():
    values, data = recorded(0)
    [made] = read(data, "radar", DATE)
    assert (made.kind, made.position) == ("asterix 048", "polar")
    assert made.time_s[0] == DATE + values["140"]
    assert made.range_m[0] == pytest.approx(values["040.RHO"] * NM)
    assert made.bearing_deg[0] == pytest.approx(values["040.THETA"])
    assert (made.mode_a[0], made.callsign[0], made.icao[0]) == (values["070.MODE3A"], values["240"].strip(), "3c660c")
    assert int(made.icao[0], 16) == values["220"] and made.track_id[0] == str(values["161.TRN"])
    assert made.pressure_alt_m[0] == pytest.approx(values["090.FL"] * FL)
    assert made.speed_m_per_s[0] == pytest.approx(values["200.GSP"] * NM)
    assert made.course_deg[0] == pytest.approx(values["200.HDG"])
    np.testing.assert_allclose(
        made.covariance_m2[0], [(values["210.SIGX"] * NM) ** 2, 0, (values["210.SIGY"] * NM) ** 2]
    )


def test_a_system_track_agrees_with_libasterix_and_its_covariance_is_a_signed_square():
    values, data = recorded(1)
    [made] = read(data, "system", DATE)
    assert (made.kind, made.position) == ("asterix 062", "geodetic") and made.time_s[0] == DATE + values["070"]
    assert (made.lat_deg[0], made.lon_deg[0]) == pytest.approx((values["105.LAT"], values["105.LON"]), abs=1e-9)
    assert (made.x_m[0], made.y_m[0]) == (values["100.X"], values["100.Y"])
    assert (made.vx_m_per_s[0], made.vy_m_per_s[0]) == (values["185.VX"], values["185.VY"])
    assert (made.mode_a[0], made.callsign[0], made.track_id[0]) == (values["060.MODE3A"], "QFA12", str(values["040"]))
    assert int(made.icao[0], 16) == values["380.ADR"]
    assert made.pressure_alt_m[0] == pytest.approx(values["136"] * FL)
    assert made.alt_m[0] == pytest.approx(values["130"] * 0.3048)
    assert made.climb_m_per_s[0] == pytest.approx(values["220"] * 0.3048 / 60)
    x, root, y = values["500.APC.X"], values["500.COV"], values["500.APC.Y"]
    assert root < 0
    np.testing.assert_allclose(made.covariance_m2[0], [x**2, -(root**2), y**2])
    np.testing.assert_allclose(
        made.velocity_covariance_m2_per_s2[0], [values["500.ATV.X"] ** 2, 0, values["500.ATV.Y"] ** 2]
    )
    assert made.sigma_alt_m[0] == pytest.approx(values["500.AGA"] * 0.3048)


def test_an_ads_b_report_agrees_with_libasterix():
    values, data = recorded(2)
    [made] = read(data, "ground", DATE)
    assert made.kind == "asterix 021" and made.time_s[0] == DATE + values["071"]
    assert (made.lat_deg[0], made.lon_deg[0]) == pytest.approx((values["131.LAT"], values["131.LON"]), abs=1e-9)
    assert made.alt_m[0] == pytest.approx(values["140"] * 0.3048)
    assert made.pressure_alt_m[0] == pytest.approx(values["145"] * FL)
    assert made.speed_m_per_s[0] == pytest.approx(values["160.GS"] * NM) and made.course_deg[0] == values["160.TA"]
    assert made.climb_m_per_s[0] == pytest.approx(values["157.GVR"] * 0.3048 / 60)
    assert (made.mode_a[0], made.callsign[0]) == (values["070.MODE3A"], values["170"].strip())
    assert int(made.icao[0], 16) == values["080"] and made.track_id[0] == str(values["161.TRNUM"])
    # Version 2 with NACp 9 and NACv 2: 30 m and 3 m/s in 95 %.
    np.testing.assert_allclose(made.covariance_m2[0, 0], (30 / RADIUS_95) ** 2)
    np.testing.assert_allclose(made.velocity_covariance_m2_per_s2[0, 0], (3 / RADIUS_95) ** 2)


def test_a_version_0_transponder_states_nucp_in_the_bits_of_nic():
    # FSPEC of items 010, 071, 130, 090, 210; quality with NUCp 7 and undefined bits in its second part.
    items = [bytes([1, 2]), (128).to_bytes(3, "big"), bytes(6), bytes([7 << 1]), bytes([0 << 3 | 2])]
    spec = bytes([0b10001101, 0b00000001, 0b00110000])
    [made] = read(block(21, spec + b"".join(items)), "ground", DATE)
    assert made.extra["version"][0] == 0.0
    np.testing.assert_allclose(made.covariance_m2[0, 0], (92.6 / RADIUS_95) ** 2)


def test_times_of_day_cross_midnight_and_may_be_late():
    seconds = [86399.0, 1.0, 86398.5, 3.0]
    data = b"".join(block(48, plot(s, k)) for k, s in enumerate(seconds))
    [made] = read(data, "radar", DATE)
    assert (made.time_s - DATE).tolist() == [86399.0, 86401.0, 86398.5, 86403.0]
    # A start with a time of day selects the nearest day.
    [made] = read(data, "radar", DATE - 2.0)
    assert (made.time_s - DATE).tolist() == [-1.0, 1.0, -1.5, 3.0]
    with pytest.raises(InputError, match="radar: no date: the records have the time of day only; give start"):
        read(data, "radar")


def test_every_sensor_in_a_file_is_a_source():
    other = bytearray(plot(10.0))
    other[3] = 9
    found = read(block(48, plot(9.0) + bytes(other)) + block(34, b"\x80\x01\x02"), "site", DATE)
    assert [made.source for made in found] == ["site:048 1/2", "site:048 1/9"]
    assert [made.line.tolist() for made in found] == [[1], [2]]
    assert found[0].passed_over == {"block of category 034": 1}


def test_a_block_received_over_two_networks_counts_once():
    [made] = read(block(48, plot(1.0)) * 2 + block(48, plot(1.0, 2)), "radar", DATE)
    assert made.track_id.tolist() == ["1", "2"]
    assert made.passed_over == {"block that came before, from a second network": 1}


def test_damaged_records_are_counted_and_the_next_block_is_read():
    cut = plot(1.0)[:-3]
    spare = bytes([0x01, 0x01, 0x01, 0x01, 0x80])
    data = block(48, plot(1.0)) + block(48, cut) + block(48, spare) + block(48, plot(2.0, 7))
    [made] = read(data + b"\x30\xff\xff", "radar", DATE)
    assert made.track_id.tolist() == ["1", "7"] and made.damaged.unit == "record"
    assert made.damaged.lines.tolist() == [2, 3, 5]
    assert made.damaged.reasons[0] == "ends within an item; the rest of its block is lost"
    assert made.damaged.reasons[1].startswith("names item 29 of its field specification, which does not exist")
    assert made.damaged.reasons[2] == "3 bytes at byte 53 are a block that is cut off"


def test_any_bytes_are_either_records_or_damage():
    rng = np.random.default_rng(3)
    for category in CATEGORIES.values():
        for _ in range(100):
            data = rng.integers(0, 256, 60, dtype=np.uint8).tobytes()
            try:
                for items in records_of(category, data):
                    assert items
            except DamagedRecord:
                pass


def test_simulated_and_empty_records_are_ignored():
    # FSPEC 010, 140, 020, 040; item 020 with SIM set.
    simulated = bytes([0xF0, 1, 2, 0, 0, 128, 0xB0, 1, 0, 0x40, 0])
    nowhere = bytes([0xC0, 1, 2, 0, 0, 128])
    timeless = bytes([0x90, 1, 2, 1, 0, 0x40, 0])
    [made] = read(block(48, simulated + nowhere + timeless + plot(1.0)), "radar", DATE)
    assert made.passed_over == {"048 of a simulated target or a field monitor": 1, "048 without a measured position": 1}
    assert made.damaged.sentences() == ["1 record damaged: a plot without a time (record 3)"]
    with pytest.raises(
        InputError, match="site: no target of category 001, 010, 020, 021, 048 or 062; 1 skipped: block of category 034"
    ):
        read(block(34, b"\x80\x01\x02"), "site", DATE)


def capture(packets, order="<", link=1):
    """A pcap file of UDP over IPv4 on Ethernet."""
    head = struct.pack(order + "IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)
    out = [head]
    for when, payload in packets:
        frame = packet(payload)[0 if link == 1 else 14 :]
        out.append(struct.pack(order + "IIII", int(when), int(when % 1 * 1e6), len(frame), len(frame)) + frame)
    return b"".join(out)


@pytest.mark.parametrize(("order", "link"), [("<", 1), (">", 1), ("<", 101)])
def test_a_capture_gives_its_date(order, link):
    packets = [(DATE + 86400.5, block(48, plot(86399.75))), (DATE + 86401.0, block(48, plot(0.5, 2)))]
    [made] = read(capture(packets, order, link), "site")
    assert (made.time_s - DATE).tolist() == [86399.75, 86400.5]


def packet(payload):
    """A UDP packet over IPv4 on Ethernet."""
    udp = struct.pack(">HHHH", 8600, 8600, 8 + len(payload), 0) + payload
    return bytes(12) + b"\x08\0" + struct.pack(">BBHHHBBH8x", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + udp


def pcapng(packets, order="<", tick=b""):
    """A pcapng file: a section, an interface, and a packet each. tick : the option if_tsresol; microseconds if none."""

    def part(kind, body):
        body += bytes(-len(body) % 4)
        return struct.pack(order + "II", kind, len(body) + 12) + body + struct.pack(order + "I", len(body) + 12)

    ticks_per_s = 1e6 if not tick else 2.0 ** (tick[0] & 127) if tick[0] & 128 else 10.0 ** tick[0]
    option = struct.pack(order + "HH", 9, 1) + tick + bytes(3) + bytes(4) if tick else b""
    out = [part(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1))]
    out += [part(1, struct.pack(order + "HHI", 1, 0, 0) + option), part(5, bytes(12))]
    for when, payload in packets:
        high, low = divmod(round(when * ticks_per_s), 1 << 32)
        frame = packet(payload)
        out.append(part(6, struct.pack(order + "IIIII", 0, high, low, len(frame), len(frame)) + frame))
    return b"".join(out)


@pytest.mark.parametrize(("order", "tick"), [("<", b""), (">", b""), ("<", b"\x09"), ("<", b"\x8a")])
def test_a_pcapng_capture_of_wireshark_is_read(order, tick):
    packets = [(DATE + 86400.5, block(48, plot(86399.75))), (DATE + 86401.0, block(48, plot(0.5, 2)))]
    [made] = read(pcapng(packets, order, tick), "site")
    assert (made.time_s - DATE).tolist() == [86399.75, 86400.5]
    assert looks_like(pcapng(packets))
    # Cut off, its complete packets are read.
    [made] = read(pcapng(packets, order, tick)[:-5], "site")
    assert len(made) == 1


@pytest.mark.parametrize("made", [capture, pcapng])
def test_sentences_in_a_capture_have_the_times_of_their_datagrams(made, tmp_path):
    sentences = [line for line in (DATA / "ais_sample.nmea").read_text().splitlines() if line.startswith("!")][:6]
    packets = [(DATE + 2.0 * k, f"{sentence}\r\n".encode()) for k, sentence in enumerate(sentences)]
    (tmp_path / "ais.pcap").write_bytes(made([*packets, (DATE, b"\0\1\2")]))
    (tmp_path / "ais.nmea").write_text("".join(f"{DATE + 2.0 * k:.3f} {one}\n" for k, one in enumerate(sentences)))
    [captured], [logged] = (read_reports(tmp_path / name) for name in ("ais.pcap", "ais.nmea"))
    np.testing.assert_array_equal(captured.time_s, logged.time_s)
    assert captured.mmsi.tolist() == logged.mmsi.tolist() and len(captured) and captured.time_s.min() > DATE - 70


def ioss(blocks, numbered=False):
    """IOSS Final Format: length, [number,] error, board, day, time of 0.01 s; the blocks; four bytes A5."""
    frames = []
    for k, content in enumerate(blocks):
        head = (k.to_bytes(4, "big") if numbered else b"") + bytes([0, 1, 12]) + (3_600_000).to_bytes(3, "big")
        frames.append((2 + len(head) + len(content) + 4).to_bytes(2, "big") + head + content + b"\xa5" * 4)
    return b"".join(frames)


@pytest.mark.parametrize("numbered", [False, True])
def test_a_recording_in_ioss_final_format_is_read(numbered):
    blocks = [block(48, plot(1.0)), block(34, b"\x80\x01\x02") + block(48, plot(2.0, 2)), block(48, plot(3.0, 3))]
    assert looks_like(ioss(blocks, numbered))
    [made] = read(ioss(blocks, numbered), "site", DATE)
    assert made.track_id.tolist() == ["1", "2", "3"] and made.passed_over == {"block of category 034": 1}
    # Bytes that are no frame are damage; the frames after them are read.
    whole = ioss(blocks[:1], numbered)
    [made] = read(whole + b"\0\x30lost\xa5\xa5\xa5\xa5" + ioss(blocks[1:], numbered), "site", DATE)
    assert made.track_id.tolist() == ["1", "2", "3"] and len(made.damaged.lines) == 1
    [made] = read((whole + ioss(blocks[1:], numbered))[:-6], "site", DATE)
    assert made.track_id.tolist() == ["1", "2"] and len(made.damaged.lines) == 1


@pytest.mark.parametrize("begin", [b"2024-05-01 23:00:00", b"01.05.2024 23:00:00"])
def test_a_recording_in_rff_gives_its_date(begin):
    header = begin.ljust(20, b"\0") + begin.ljust(20, b"\0") + bytes(88)
    content = header
    for after_ms, one in [(0, block(48, plot(82800.0))), (3_610_000, block(48, plot(9.5, 2)))]:
        content += struct.pack("<IH", after_ms, len(one)) + one
    assert looks_like(content)
    [made] = read(content, "site")
    assert (made.time_s - DATE).tolist() == [82800.0, 86409.5]


def test_a_text_that_begins_with_two_times_is_no_recording():
    line = b"2024-05-01 12:00:00,2024-05-01 12:00:10,0101,50.123456,-1.234567,12.5\n"
    assert not is_capture(line * 50)
    assert not any(is_capture(line[k:] * 50) for k in range(len(line)))


# Made with libasterix, edition 1.29: at 48.2345 N, 16.3717 W, 187 m; the second one with items 050, 060, 070 as well.
SERVICES = ("220015e910500c01465000020000bb224cd3f45b9f",
            "220020ef90500c014650000200040102900000020801100200bb224cd3f45b9f")  # fmt: skip


@pytest.mark.parametrize("service", SERVICES)
def test_the_place_of_a_radar_is_in_its_service_messages(service):
    mine = bytearray(plot(1.0))
    mine[2:4] = 80, 12
    radar, other = read(block(48, bytes(mine) + plot(2.0)) + bytes.fromhex(service), "site", DATE)[::-1]
    assert (radar.source, radar.sac_sic, other.sac_sic, other.site) == ("site:048 80/12", "80/12", "1/2", None)
    assert radar.site == pytest.approx((48.2345, -16.3717, 187.0), abs=2e-5)
    assert not radar.passed_over and not other.passed_over


def test_a_radar_at_the_origin_states_no_place():
    [made] = read(block(48, plot(1.0)) + block(34, bytes([0x81, 0x10, 1, 2, 0, 100]) + bytes(6)), "site", DATE)
    assert made.site is None and made.passed_over == {"block of category 034": 1}


# Made with libasterix: category 001, edition 1.4, a plot, a track and a plot without item 010; 002, edition 1.2.
OLDER = bytes.fromhex(
    "010033fa500c2014405800095105283240ffc4500cb0004d0a2040000510ffa0080020000200057932a00062100500c0003300"
)
CLOCK = bytes.fromhex("02000cd8500c014732000200")


def test_plots_and_tracks_of_older_radars_agree_with_libasterix():
    [made] = read(CLOCK + OLDER, "radar", DATE)
    assert (made.kind, made.sac_sic, made.position) == ("asterix 001", "80/12", "polar")
    # 10:07:32 and 0.5 s after it, modulo 512 s.
    assert (made.time_s - DATE).tolist() == [36452.5, 36453.25, 36454.0]
    np.testing.assert_allclose(made.range_m, np.array([40.5, 20.25, 10.0]) * NM)
    assert made.bearing_deg.tolist() == [123.75, 90.0, 270.0]
    assert made.mode_a.tolist() == ["4521", "1000", None] and made.track_id.tolist() == [None, "77", None]
    np.testing.assert_allclose(made.pressure_alt_m, np.array([330.0, 350.25, np.nan]) * FL)
    assert (made.speed_m_per_s[1], made.course_deg[1]) == (0.125 * NM, 45.0)
    assert made.extra["detection"].tolist() == ["secondary", "primary and secondary", "primary"]
    assert not len(made.damaged.lines) and not made.passed_over


def test_the_clock_of_older_radars_is_that_of_their_messages_or_of_receipt():
    with pytest.raises(InputError, match="no message of category 002 before it that gives the time of day"):
        read(OLDER, "radar", DATE)
    # The time of receipt in a capture, 1 s after the first plot and before midnight.
    [made] = read(capture([(DATE + 512.0 * 60 + 101.5, OLDER)]), "radar")
    assert (made.time_s - DATE).tolist() == [512.0 * 60 + late for late in (100.5, 101.25, 102.0)]
    # The message comes some seconds after the truncated time began anew.
    later = bytearray(CLOCK)
    later[7:10] = int((512.0 * 70 + 3.0) * 128).to_bytes(3, "big")
    before = bytearray(OLDER)
    at = OLDER.index(int(100.5 * 128).to_bytes(2, "big"))
    before[at : at + 2] = int(511.0 * 128).to_bytes(2, "big")
    [made] = read(bytes(later) + bytes(before), "radar", DATE)
    assert made.time_s[0] - DATE == 512.0 * 69 + 511.0


def test_letters_and_codes_follow_the_standard():
    # ICAO Annex 10: letters are their place in the alphabet, digits those of ASCII, a blank is 32.
    codes = [ord(c) - 64 if c.isalpha() else ord(c) for c in "KLM1023 "]
    packed = int("".join(f"{code:06b}" for code in codes), 2).to_bytes(6, "big")
    assert letters(packed) == "KLM1023"
    assert letters(bytes(6)) is None
    assert octal(bytes([0x0F, 0x11])) == "7421"


def six_bit(text):
    letters = " ABCDEFGHIJKLMNOPQRSTUVWXYZ" + " " * 21 + "0123456789"
    number = 0
    for letter in text.ljust(8):
        number = number << 6 | letters.index(letter)
    return number.to_bytes(6, "big")


def degrees(lat, lon, bits):
    return b"".join(round(angle / 180.0 * 2**bits).to_bytes(4, "big", signed=True) for angle in (lat, lon))


def multilateration(seconds, lat=50.1, lon=8.6, descriptor=b"\x40"):
    """A category 020 record: 010, 020, 140, 041, 161, 170; 070, 202, 090, 220, 245; 105, 500."""
    head = bytes([0xF7, 0xED, 0x88]) + b"\x10\x02" + descriptor + int(seconds * 128).to_bytes(3, "big")
    track = degrees(lat, lon, 25) + (77).to_bytes(2, "big") + b"\0"
    velocity = (-320).to_bytes(2, "big", signed=True) + (200).to_bytes(2, "big")
    identity = (0o4521).to_bytes(2, "big") + velocity + (1400).to_bytes(2, "big") + bytes.fromhex("3c6444")
    accuracy = b"\x40" + (40).to_bytes(2, "big") + (60).to_bytes(2, "big") + (1).to_bytes(2, "big")
    return head + track + identity + b"\0" + six_bit("DLH123") + (1600).to_bytes(2, "big") + accuracy


def test_multilateration_is_read():
    [made] = read(block(20, multilateration(38400.5) + multilateration(38401.5, 50.101, -8.6)), "wam", DATE)
    assert (made.kind, made.position) == ("asterix 020", "geodetic")
    assert made.time_s.tolist() == [DATE + 38400.5, DATE + 38401.5]
    assert made.lat_deg == pytest.approx([50.1, 50.101], abs=3e-6) and made.lon_deg == pytest.approx(
        [8.6, -8.6], abs=3e-6
    )
    assert (made.icao[0], made.callsign[0], made.mode_a[0], made.track_id[0]) == ("3c6444", "DLH123", "4521", "77")
    assert (made.vx_m_per_s[0], made.vy_m_per_s[0]) == (-80.0, 50.0)
    assert made.pressure_alt_m[0] == pytest.approx(350 * FL) and made.alt_m[0] == pytest.approx(10_000 * 0.3048)
    assert made.covariance_m2[0].tolist() == [100.0, 0.0, 225.0]


@pytest.mark.parametrize("extent", [0x80, 0x04, 0x02])
def test_field_monitors_and_tests_of_multilateration_are_passed_over(extent):
    data = multilateration(1.0, descriptor=bytes([0x41, extent])) + multilateration(2.0)
    [made] = read(block(20, data), "wam", DATE)
    assert len(made) == 1 and list(made.passed_over) == ["020 of a simulated or test target or a field monitor"]


def surface(seconds, items, position, message=1):
    """A category 010 record: 010, 000, 020, 140, a position, 161, 500."""
    head = bytes([0xF0 | items, 0x21, 0x01, 0x80]) + b"\0\x05" + bytes([message]) + b"\x60"
    return head + int(seconds * 128).to_bytes(3, "big") + position + (9).to_bytes(2, "big") + b"\x08\x0c" + b"\xff\xf8"


def test_surface_radars_are_read_by_their_degrees_else_by_range_and_bearing():
    [made] = read(block(10, surface(5.0, 0x09, degrees(50.03, 8.55, 31))), "smr", DATE)
    assert (made.kind, made.track_id[0]) == ("asterix 010", "9")
    assert (made.lat_deg[0], made.lon_deg[0]) == pytest.approx((50.03, 8.55), abs=1e-7)
    assert made.covariance_m2[0].tolist() == [4.0, -2.0, 9.0]
    # Without item 500.
    record = surface(5.0, 0x09, degrees(50.03, 8.55, 31))
    without = record[:1] + bytes([0x21, 0x00]) + record[4:-4]
    [made] = read(block(10, without), "smr", DATE)
    assert made.covariance_m2[0].tolist() == [100.0, 0.0, 100.0]
    both = (1200).to_bytes(2, "big") + (16384).to_bytes(2, "big") + (1200).to_bytes(2, "big") + b"\0\0"
    [made] = read(block(10, surface(5.0, 0x07, both) + surface(6.0, 0x07, both, message=2)), "smr", DATE)
    assert (made.position, made.range_m[0], made.bearing_deg[0]) == ("polar", 1200.0, 90.0)
    assert list(made.passed_over) == ["010 of a status or an update cycle"]
