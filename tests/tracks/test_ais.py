"""AIS: real sentences are decoded as specified, and broken ones are counted."""

from pathlib import Path

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.sensors import ReadOptions, ais, read_reports
from sameas.io.sensors.ais import ASSUMED_LENGTH_M, LENGTH_PER_WIDTH
from sameas.io.sensors.nmea import checksum, log_of
from sameas.io.sensors.stream import ReportStream
from sameas.tracks.coordinates import LocalPlane, along_and_across

pyais = pytest.importorskip("pyais")
SAMPLE = Path(__file__).parent / "data" / "ais_sample.nmea"
# Start, width and sign of each field, from the tables of ITU-R M.1371.
CLASS_A = {"speed": (50, 10, 0), "accuracy": (60, 1, 0), "lon": (61, 28, 1), "lat": (89, 27, 1), "course": (116, 12, 0),
           "heading": (128, 9, 0), "second": (137, 6, 0), "raim": (148, 1, 0)}  # fmt: skip
CLASS_B = {"speed": (46, 10, 0), "accuracy": (56, 1, 0), "lon": (57, 28, 1), "lat": (85, 27, 1), "course": (112, 12, 0),
           "heading": (124, 9, 0), "second": (133, 6, 0), "raim": (147, 1, 0)}  # fmt: skip


def bits_of(payload):
    """The six bits of every letter, from the definition."""
    codes = [ord(letter) - 48 - (8 if ord(letter) > 88 else 0) for letter in payload]
    return "".join(f"{code:06b}" for code in codes)


def field(bits, start, width, signed):
    value = int(bits[start : start + width], 2)
    return value - (1 << width) if signed and bits[start] == "1" else value


def sentence(body):
    return f"!{body}*{checksum(body):02X}"


def encoded(**fields):
    return pyais.encode_dict({"mmsi": 235070762, **fields}, talker_id="AI", sentence_type="VDM")


def message(**fields):
    return encoded(type=1, **({"lat": 50.0, "lon": -1.0} | fields))


def reports(lines, stamp="\\c:1452603731*00\\", **options):
    log = log_of([stamp + line if stamp and line[0] in "!$" else line for line in lines])
    return ais.read(log, "coast", **options)


@pytest.fixture(scope="module")
def sample():
    [found] = read_reports(SAMPLE)
    return found


def test_every_real_report_agrees_with_its_bits(sample):
    lines = SAMPLE.read_text().splitlines()
    assert len(sample) == 11
    for k, line in enumerate(sample.line):
        bits = bits_of(lines[line - 1].split(",")[5])
        layout = CLASS_B if sample.extra["message_type"][k] == 18 else CLASS_A
        decoded = {name: field(bits, *place) for name, place in layout.items()}
        assert sample.mmsi[k] == f"{int(bits[8:38], 2):09d}"
        assert sample.lat_deg[k] == pytest.approx(decoded["lat"] / 600000, abs=1e-6)
        assert sample.lon_deg[k] == pytest.approx(decoded["lon"] / 600000, abs=1e-6)
        assert sample.speed_m_per_s[k] == pytest.approx(decoded["speed"] / 10 * 1852 / 3600)
        assert (
            np.isnan(sample.course_deg[k])
            if decoded["course"] == 3600
            else sample.course_deg[k] == decoded["course"] / 10
        )
        assert (
            np.isnan(sample.heading_deg[k])
            if decoded["heading"] == 511
            else sample.heading_deg[k] == decoded["heading"]
        )
        # No message of these ships states a hull: one of class A or B is assumed, along a heading or any.
        length_m = ASSUMED_LENGTH_M[sample.extra["message_type"][k]]
        hull = 2.0 * (length_m**2 + (length_m / LENGTH_PER_WIDTH) ** 2) / 12.0
        fix = 25.0 if decoded["accuracy"] else 225.0
        assert sample.covariance_m2[k, [0, 2]].sum() == pytest.approx(2.0 * fix + hull)
        assert sample.extra["raim_flag"][k] == decoded["raim"]
        assert sample.time_s[k] % 60 == decoded["second"]


def test_the_published_message_is_decoded_as_published(sample):
    [k] = np.flatnonzero(sample.mmsi == "366053209")
    assert (sample.lat_deg[k], sample.lon_deg[k]) == pytest.approx((37.802118, -122.341618))
    assert (sample.course_deg[k], sample.heading_deg[k], sample.speed_m_per_s[k]) == (219.3, 1.0, 0.0)


def test_damaged_lines_are_counted_by_number(sample):
    assert sample.damaged.lines.tolist() == [5, 11, 19]
    assert sample.damaged.reasons.tolist() == [
        "AIS sentence without a message",
        "part of a message without the others",
        "wrong checksum",
    ]
    assert sample.passed_over == {"AIS message of type 4": 1}


def test_a_base_station_is_the_clock_if_there_is_no_other(sample):
    # Message 4 in line 13 gives 2015-06-21 09:30:10.
    assert sample.notes[0].startswith("ais_sample.nmea: times from base stations' reports")
    assert np.ptp(sample.time_s) < 60.0 and abs(sample.time_s[0] - 1434879010.0) < 60.0


def test_reports_are_moved_to_the_hull_centre_even_if_dimensions_come_later():
    static = encoded(type=5, shipname="EVER DIADEM", callsign="3FOF8", imo=9134270, ship_type=70,
                     to_bow=225, to_stern=70, to_port=1, to_starboard=31)  # fmt: skip
    lines = [*message(heading=90, course=100.0, speed=12.0, second=5, accuracy=1), *static]
    made = reports(lines)
    assert (made.name[0], made.callsign[0], made.imo[0], made.type[0]) == ("EVER DIADEM", "3FOF8", "9134270", "cargo")
    assert (made.length_m[0], made.width_m[0]) == (295.0, 32.0)
    moved = LocalPlane(50.0, -1.0).of_geodetic(made.lat_deg, made.lon_deg)[0]
    np.testing.assert_allclose(moved, [77.5, -15.0], atol=0.02)
    np.testing.assert_allclose(made.covariance_m2[0], [25 + 295**2 / 12, 0.0, 25 + 32**2 / 12], atol=1e-6)
    assert made.extra["antenna_lon_deg"][0] == -1.0


@pytest.mark.parametrize("imo", [0, 9123456, 9000001, 912345, 12_345_678])
def test_a_number_without_the_check_digit_of_an_imo_number_is_no_identity(imo):
    """Two ships whose crews have entered the same one were an alarm: forged, duplicate or wrong."""
    ships = [211000001, 211000002]
    lines = [line for mmsi in ships for line in encoded(type=5, mmsi=mmsi, shipname="A", imo=imo, ship_type=70)]
    made = reports([*lines, *(line for mmsi in ships for line in message(mmsi=mmsi))])
    assert len(made) == 2 and made.name.tolist() == ["A", "A"] and made.imo is None


def test_the_antenna_of_a_ship_that_states_no_hull_is_anywhere_on_one():
    """A ship of 200 m was two objects for good, 1.00, where her reports had the errors of the GNSS alone."""
    [ship, boat, device, aircraft] = (
        made.covariance_m2[0]
        for made in (
            reports(message(heading=90, accuracy=1)),
            reports(encoded(type=18, lat=50.0, lon=-1.0, heading=90, accuracy=1)),
            reports(message(heading=90, accuracy=1, mmsi=970012345)),
            reports(encoded(type=9, mmsi=111232501, lat=50.0, lon=-1.0, course=90.0, accuracy=1)),
        )
    )
    np.testing.assert_allclose(ship, [25 + 60**2 / 6, 0.0, 25 + 10**2 / 6], atol=1e-9)
    np.testing.assert_allclose(boat, [25 + 15**2 / 6, 0.0, 25 + 2.5**2 / 6], atol=1e-9)
    assert device.tolist() == aircraft.tolist() == [25.0, 0.0, 25.0]
    craft = reports(message(heading=90, accuracy=1, mmsi=982110001)).covariance_m2[0]
    assert craft.tolist() == pytest.approx(boat.tolist())


def test_without_heading_the_course_of_a_moving_ship_is_used():
    static = encoded(type=24, partno=1, to_bow=40, to_stern=20, to_port=5, to_starboard=5)
    moving = reports([*message(heading=511, course=0.0, speed=10.0), *static])
    assert LocalPlane(50.0, -1.0).of_geodetic(moving.lat_deg, moving.lon_deg)[0] == pytest.approx([0.0, 10.0], abs=0.02)
    still = reports([*message(heading=511, course=0.0, speed=0.0), *static])
    assert (still.lat_deg[0], still.lon_deg[0]) == pytest.approx((50.0, -1.0))
    assert still.covariance_m2[0, 0] == still.covariance_m2[0, 2] > 225.0


def test_values_that_are_not_available_are_absent():
    made = reports(
        [*message(speed=102.3, course=360.0, heading=511), *message(mmsi=235000001, speed=3.0, course=10.0, heading=7)]
    )
    assert np.isnan([made.speed_m_per_s[0], made.course_deg[0], made.heading_deg[0]]).all()
    assert made.speed_m_per_s[1] == pytest.approx(3.0 * 1852 / 3600)


def test_messages_without_position_are_ignored_and_dead_reckoning_is_coarse():
    made = reports(
        [*message(lat=91.0, lon=181.0), *message(second=63), *message(second=62, accuracy=1), *message(second=10)]
    )
    assert made.passed_over == {"AIS report without a position": 1, "AIS report, positioning inoperative": 1}
    np.testing.assert_allclose(np.diff(made.covariance_m2[:, 0]), 225.0 - 1e4)
    assert made.time_s.tolist() == [1452603731.0, 1452603730.0]


def test_the_second_in_the_message_gives_its_time_before_receipt():
    def at(receipt, second):
        return reports(message(second=second), stamp=f"\\c:{receipt}*00\\").time_s[0]

    minute = 1452603720
    assert at(minute + 11, 9) == minute + 9
    assert at(minute + 2, 58) == minute - 2
    # The receiver's clock may be slightly slow.
    assert at(minute + 58, 1) == minute + 61


def test_sentences_that_follow_each_other_without_a_line_end_are_all_read():
    """As dispatchers put them into a datagram."""
    first, second = "!AIVDM,1,1,,A,13`dt7@P16PE:8tMUuV0wOwhR8R?,0*3C", "!AIVDM,1,1,,A,13aGsd0P0wPDfptMU9wk6gwl2@RF,0*55"
    log = log_of([f"\\s:x,c:1780315200*00\\{first}{second}", first])
    assert [(one.line, one.text) for one in log.sentences] == [(1, first), (1, second), (2, first)]
    assert not log.damaged and np.all(log.clock_s == 1780315200.0)
    stream = ReportStream("dispatcher")
    stream.feed((first + second).encode(), 1780315200.0, last=True)
    assert sum(len(reports) for reports in stream.reports()) == 2


@pytest.mark.parametrize(
    "stamped",
    [
        "\\s:r3669961,c:1452603731*00\\{}",
        "\\g:1-2-1234,c:1452603731000*00\\{}",
        "2016-01-12T13:02:11Z {}",
        "1452603731.0,{}",
        "[12.01.2016 13:02:11] {}",
        "12.1.2016 13:02:11.0;{}",
        "{},r003669945,1452603731",
    ],
)
def test_many_receiver_time_formats_are_read(stamped):
    assert reports([stamped.format(message(second=11)[0])], stamp="").time_s[0] == 1452603731.0


def test_other_sentences_give_the_time_too():
    clock = sentence("PGHP,1,2016,1,12,13,2,11,0,338,2,,1,09").replace("!", "$")
    assert reports([clock, *message(second=10)], stamp="").time_s[0] == 1452603730.0
    clock = sentence("GPZDA,130211.00,12,01,2016,00,00").replace("!", "$")
    assert reports([clock, *message(second=60)], stamp="").time_s[0] == 1452603731.0


@pytest.mark.parametrize("stamp", ["{} ", "[{}.250] ", "{};"])
def test_a_time_of_day_before_a_sentence_needs_the_date_only(tmp_path, stamp):
    clocks = ["23:59:40", "23:59:50", "00:00:00"]
    lines = [
        stamp.format(clock) + encoded(type=1, lat=54.5, lon=10.2, speed=8.0, course=0.0, second=60)[0]
        for clock in clocks
    ]
    path = tmp_path / "coast.nmea"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(
        InputError, match=r"no time: the lines have the time of day, but no date; give start, the UTC date"
    ):
        read_reports(path)
    [reports] = read_reports(path, ReadOptions(start="2024-05-01"))
    of_day = reports.time_s - 1714521600.0
    np.testing.assert_allclose(of_day, np.array([86380.0, 86390.0, 86400.0]) + 0.25 * ("250" in stamp))


def test_without_a_clock_seconds_are_counted_from_the_start():
    lines = [line for second in (50, 59, 3, 2, 20) for line in message(second=second)]
    with pytest.raises(InputError, match=r"coast: no time: the lines carry no time of receipt.* give start"):
        reports(lines, stamp="")
    times = reports(lines, stamp="", start_s=1452603720.0 + 45.0).time_s
    assert (times - 1452603720.0).tolist() == [50.0, 59.0, 63.0, 62.0, 80.0]


def test_a_long_range_report_is_as_coarse_as_its_steps():
    made = reports(encoded(type=27, lat=60.0, lon=4.76, speed=9, course=167, accuracy=1))
    [hull] = along_and_across(np.array([60.0**2 / 6]), np.array([10.0**2 / 6]), np.array([167.0]))
    assert made.covariance_m2[0, 2] == pytest.approx(25.0 + 185.2**2 / 12 + hull[1, 1])
    assert made.covariance_m2[0, 0] == pytest.approx(25.0 + (185.2 / 2) ** 2 / 12 + hull[0, 0], rel=0.01)
    assert made.speed_m_per_s[0] == pytest.approx(9 * 1852 / 3600) and made.time_s[0] == 1452603731.0


def test_extended_class_b_gives_name_and_hull():
    payload = "C5N3SRgPEnJGEBT>NhWAwwo862PaLELTBJ:V00000000S0D:R220"
    made = reports([f"!AIVDM,1,1,,B,{payload},0*0B"])
    bow, stern, port, starboard = (field(bits_of(payload), *at, 0) for at in ((271, 9), (280, 9), (289, 6), (295, 6)))
    assert (made.mmsi[0], made.name[0]) == ("367059850", "CAPT.J.RIMES")
    assert (made.length_m[0], made.width_m[0]) == (bow + stern, port + starboard) == (26.0, 8.0)


def test_parts_of_a_message_must_be_in_order():
    first, second = encoded(type=5, shipname="A" * 20)
    made = reports([second, first, *message(), second])
    assert made.damaged.lines.tolist() == [1] and made.name.tolist() == ["A" * 20]
    made = reports([first, first, second, *message()])
    assert made.damaged.lines.tolist() == [1]


def parts_of(mmsi, name, tag=("", ""), talker="AI"):
    parts = pyais.encode_dict(
        {"type": 5, "mmsi": mmsi, "shipname": name, "callsign": "D"}, talker_id=talker, sentence_type="VDM", seq_id=3
    )
    return [f"\\{block},c:1452603731*00\\{part}" for block, part in zip(tag, parts, strict=True)]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"tag": ("g:1-2-71,s:r1", "g:2-2-71")}, {"tag": ("g:1-2-72,s:r2", "g:2-2-72")}),
        ({"tag": ("s:r1", "s:r1")}, {"tag": ("s:r2", "s:r2")}),
        ({"tag": ("x:1", "x:1"), "talker": "AI"}, {"tag": ("x:1", "x:1"), "talker": "BS"}),
    ],
)
def test_messages_of_several_stations_in_one_stream_are_kept_apart(first, second):
    a, b = parts_of(235070762, "ARCTURUS", **first), parts_of(235070763, "BETELGEUSE", **second)
    positions = [*message(), *message(mmsi=235070763)]
    made = reports([a[0], b[0], a[1], b[1], *positions])
    assert made.name.tolist() == ["ARCTURUS", "BETELGEUSE"] and not made.damaged.counts()


def test_parts_that_may_be_of_two_messages_make_none():
    a, b = (parts_of(235070762 + k, name, ("x:1", "x:1")) for k, name in enumerate(("ARCTURUS", "BETELGEUSE")))
    made = reports([a[0], b[0], a[1], b[1], *message()])
    assert made.name is None
    assert sorted(set(made.damaged.reasons)) == [
        "part of a message without the others",
        "parts of messages of several receivers that cannot be told apart",
    ]


def test_a_part_that_comes_much_later_is_of_another_message():
    first, second = parts_of(235070762, "ARCTURUS", ("x:1", "x:1"))
    made = reports([first, second.replace("1452603731", "1452603761"), *message()])
    assert made.name is None and len(made.damaged.reasons) == 2


def test_own_ship_and_other_messages_are_ignored():
    own = message()[0].replace("VDM", "VDO").split("*")[0][1:]
    made = reports([sentence(own), *message()])
    assert made.passed_over == {"own ship's own report (VDO)": 1} and len(made) == 1


def test_random_bytes_never_stop_the_reader():
    rng = np.random.default_rng(7)
    letters = [chr(code) for code in range(33, 120)]
    junk = [sentence("AIVDM,1,1,,A," + "".join(rng.choice(letters, 28)).replace(",", "0").replace("*", "1") + ",0")
            for _ in range(200)]  # fmt: skip
    made = reports([*junk, *message(), "\x00\xff", "$"])
    assert "235070762" in made.mmsi.tolist()
    assert (np.abs(made.lat_deg) <= 90.0).all() and (np.abs(made.lon_deg) <= 180.0).all()


def test_missing_pyais_is_reported_with_the_remedy(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyais", None)
    with pytest.raises(InputError, match=r"AIS messages need pyais: pip install 'sameas\[targets\]'"):
        reports(["!AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C"])


def test_the_navigational_status_is_kept_and_unknown_where_it_is_not_set():
    found = reports([line for status in (5, 1, 15) for line in message(mmsi=235070762 + status, status=status)])
    assert found.extra["nav_status"].tolist()[:2] == [5.0, 1.0] and np.isnan(found.extra["nav_status"][2])
