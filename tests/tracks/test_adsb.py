"""ADS-B: positions and their accuracy from snapshots, BaseStation lines and raw messages."""

import json
from pathlib import Path

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.sensors import ReadOptions, aircraft, beast, mode_s, read_reports, sbs
from sameas.io.sensors.format import RADIUS_95
from sameas.io.sensors.stream import ReportStream

SAMPLE = Path(__file__).parent / "data" / "mode_s_sample.csv"
BARCELONA = {
    "hex": "3c6444", "type": "adsb_icao", "flight": "DLH123  ", "alt_baro": 36000, "alt_geom": 36550, "gs": 450.0,
    "track": 90.5, "baro_rate": -64, "squawk": "1000", "category": "A3", "lat": 41.3, "lon": 2.1, "nic": 8, "rc": 186,
    "seen_pos": 0.5, "nac_p": 9, "nac_v": 1, "sil": 3,
}  # fmt: skip


def snapshots(*pictures):
    return [json.dumps({"now": now, "messages": 1, "aircraft": list(seen)}) for now, seen in pictures]


def test_a_snapshot_gives_position_time_and_accuracy():
    made = aircraft.read(snapshots((1700000000.1, [BARCELONA])), "roof")
    assert made.time_s[0] == pytest.approx(1699999999.6) and made.icao.tolist() == ["3c6444"]
    assert (made.callsign[0], made.mode_a[0], made.extra["category"][0]) == ("DLH123", "1000", "A3")
    assert (made.alt_m[0], made.pressure_alt_m[0]) == pytest.approx((36550 * 0.3048, 36000 * 0.3048))
    np.testing.assert_allclose(made.covariance_m2[0], [(30 / RADIUS_95) ** 2, 0.0, (30 / RADIUS_95) ** 2])
    np.testing.assert_allclose(made.velocity_covariance_m2_per_s2[0, 0], (10 / RADIUS_95) ** 2)
    assert made.climb_m_per_s[0] == pytest.approx(-64 * 0.3048 / 60)


def test_a_repeated_position_is_no_new_report():
    again, moved = BARCELONA | {"seen_pos": 1.6}, BARCELONA | {"lat": 41.31, "seen_pos": 0.2}
    still = BARCELONA | {"seen_pos": 0.1}
    lines = snapshots(
        (100.1e7, [BARCELONA]), (100.1e7 + 1.0, [again]), (100.1e7 + 2.0, [moved]), (100.1e7 + 3.0, [still])
    )
    made = aircraft.read(lines, "roof")
    # The last position equals the first, but is a new fix.
    assert made.lat_deg.tolist() == [41.3, 41.31, 41.3] and made.passed_over == {"position repeated": 1}


def test_without_accuracy_the_containment_radius_is_used():
    mlat = {"hex": "~2a1b2c", "type": "mlat", "lat": 41.0, "lon": 2.0, "nic": 0, "rc": 0}
    by_rc = {key: value for key, value in BARCELONA.items() if key != "nac_p"} | {"hex": "a00001"}
    by_nic = {key: value for key, value in by_rc.items() if key != "rc"} | {"hex": "a00002"}
    made = aircraft.read(snapshots((1e9, [mlat, by_rc, by_nic])), "roof")
    assert np.isnan(made.covariance_m2[0]).all() and made.icao.tolist() == [None, "a00001", "a00002"]
    assert made.track_id[0] == "~2a1b2c" and made.extra["origin"][0] == "mlat"
    np.testing.assert_allclose(made.covariance_m2[1:, 0], [(93 / RADIUS_95) ** 2, (92.6 / RADIUS_95) ** 2])


def test_the_names_of_dump1090_mutability_are_read():
    """A snapshot as the program of Debian writes it: height, speed and vertical rate were lost."""
    old = {"hex": "4ca104", "flight": "EIN400  ", "lat": 50.899979, "lon": -0.918398, "nucp": 7, "seen_pos": 0.1,
           "altitude": 34000, "vert_rate": 640, "track": 90, "speed": 400, "category": "A3", "mlat": [], "tisb": [],
           "messages": 120, "seen": 0.1, "rssi": -49.5}  # fmt: skip
    ground = old | {"hex": "4ca105", "altitude": "ground", "nucp": 0}
    by_mlat = old | {"hex": "4ca106", "mlat": ["lat", "lon", "track", "speed"]}
    made = aircraft.read(snapshots((1e9, [old, ground, by_mlat])), "roof")
    assert made.pressure_alt_m[0] == pytest.approx(34000 * 0.3048)
    assert made.climb_m_per_s[0] == pytest.approx(640 * 0.3048 / 60)
    np.testing.assert_allclose(made.speed_m_per_s, 400 * 1852 / 3600)
    np.testing.assert_allclose(made.covariance_m2[0, 0], (92.6 / RADIUS_95) ** 2)
    assert made.extra["on_ground"].tolist() == [0.0, 1.0, 0.0] and made.extra["origin"][2] == "mlat"
    assert np.isnan(made.covariance_m2[1:]).all()
    mixed = aircraft.read(snapshots((1e9, [BARCELONA | {"altitude": 1, "speed": 1, "nucp": 1}])), "roof")
    assert mixed.pressure_alt_m[0] == pytest.approx(36000 * 0.3048) and mixed.covariance_m2[0, 0] < 200.0


def test_a_single_snapshot_over_many_lines_and_an_aircraft_on_the_ground():
    text = json.dumps({"now": 1e9, "aircraft": [BARCELONA | {"alt_baro": "ground"}, {"hex": "a1"}]}, indent=2)
    made = aircraft.read(text.split("\n"), "roof")
    assert made.pressure_alt_m is None and made.extra["on_ground"].tolist() == [1.0]
    assert made.passed_over == {"aircraft without a position": 1}


def test_broken_snapshots_are_counted_by_line():
    lines = ["{", json.dumps({"aircraft": []}), json.dumps({"now": 1.0}), *snapshots((1e9, [BARCELONA, 7, {"lat": 1}])),
             *snapshots((1e9, [BARCELONA | {"lat": 95.0}, BARCELONA | {"gs": "fast"}]))]  # fmt: skip
    made = aircraft.read(lines, "roof")
    assert len(made) == 1 and made.damaged.lines.tolist() == [1, 2, 3, 4, 4, 5, 5]
    with pytest.raises(InputError, match="roof: no position of an aircraft: 1 line damaged: no JSON"):
        aircraft.read(["{"], "roof")


def base_station(kind, time="12:00:00.000", **cells):
    row = ["MSG", str(kind), "1", "1", "4CA7A8", "1", "2024/05/01", time, "2024/05/01", time, *[""] * 12]
    for place, value in cells.items():
        row[int(place[1:])] = value
    return ",".join(row)


def test_base_station_positions_include_the_latest_other_fields():
    lines = [
        base_station(1, c10="RYR174C "),
        base_station(4, c12="450", c13="101.5", c16="-640"),
        base_station(3, "12:00:01.500", c11="37000", c14="41.167", c15="-15.708", c21="0"),
        base_station(3, "12:01:00.000", c11="36000", c14="41.100", c15="-15.600"),
        "STA,,5,179,400AE7,10103,2008/11/28,14:58:51.153,2008/11/28,14:58:51.153,RM",
        "MSG,3,1,1,4CA7A8,1,2024/05/01",
        base_station(3, c11="37000", c14="91.0", c15="0.0"),
        base_station(3, c11="x", c14="9.0", c15="0.0"),
    ]
    made = sbs.read(lines, "roof")
    assert made.time_s.tolist() == [1714564801.5, 1714564860.0] and made.icao.tolist() == ["4ca7a8"] * 2
    assert made.callsign.tolist() == ["RYR174C", None]
    assert made.speed_m_per_s[0] == pytest.approx(450 * 1852 / 3600) and np.isnan(made.speed_m_per_s[1])
    assert made.pressure_alt_m.tolist() == pytest.approx([37000 * 0.3048, 36000 * 0.3048])
    assert made.passed_over == {"message without a position": 2, "STA line": 1}
    assert made.damaged.lines.tolist() == [6, 7, 8] and made.covariance_m2 is None


# ------------------------------------------------------------------------------------------------ raw messages


def read_lines(lines, start_s=None):
    return mode_s.read(mode_s.Messages.of_lines(lines), "roof", start_s)


def zones(lat):
    """Longitude zones (NL) of a latitude, from the definition in ICAO Doc 9871."""
    if abs(lat) >= 87.0:
        return 1 if abs(lat) > 87.0 else 2
    ratio = 1.0 - (1.0 - np.cos(np.pi / 30.0)) / np.cos(np.radians(lat)) ** 2
    return int(2.0 * np.pi / np.arccos(ratio))


def position_of(even, odd, newest_is_odd):
    """Latitude and longitude of an even and an odd CPR pair (17-bit numbers), from the definition."""
    (lat0, lon0), (lat1, lon1) = ((a / 2**17, b / 2**17) for a, b in (even, odd))
    j = np.floor(59 * lat0 - 60 * lat1 + 0.5)
    lats = [6.0 * (j % 60 + lat0), 360.0 / 59.0 * (j % 59 + lat1)]
    lats = [lat - 360.0 if lat >= 270.0 else lat for lat in lats]
    if zones(lats[0]) != zones(lats[1]):
        return None
    lat, nl = lats[newest_is_odd], zones(lats[newest_is_odd])
    count = max(nl - newest_is_odd, 1)
    m = np.floor(lon0 * (nl - 1) - lon1 * nl + 0.5)
    lon = 360.0 / count * (m % count + (lon1 if newest_is_odd else lon0))
    return lat, lon - 360.0 if lon >= 180.0 else lon


def halves_of(path):
    """For each line: address, parity and the two numbers of every airborne position."""
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        message = line.split(",")[1]
        bits = f"{int(message, 16):0112b}"
        if 9 <= int(bits[32:37], 2) <= 18:
            yield number, message[2:8].lower(), int(bits[53]), (int(bits[54:71], 2), int(bits[71:88], 2))


def test_real_positions_agree_with_the_definition():
    pytest.importorskip("rs1090")
    made = read_lines(SAMPLE.read_text().splitlines())
    newest = {}
    expected = {}
    for number, address, odd, half in halves_of(SAMPLE):
        newest[address, odd] = half
        if (address, 1 - odd) in newest:
            pair = (newest[address, 0], newest[address, 1])
            expected[number] = (address, position_of(*pair, odd))
    assert len(made) >= 12 and set(made.line) <= set(expected)
    for k, number in enumerate(made.line):
        address, place = expected[number]
        assert made.icao[k] == address
        assert (made.lat_deg[k], made.lon_deg[k]) == pytest.approx(place, abs=1e-6)
    # Results of pyModeS 3.6.1 for the same lines.
    other = {42: (33.831298828125, -84.35140181560905, 9850), 53: (33.83125305175781, -84.35302734375, 9875),
             56: (34.01124572753906, -84.29652622767856, 11650)}  # fmt: skip
    for number, (lat, lon, feet) in other.items():
        [k] = np.flatnonzero(made.line == number)
        assert (made.lat_deg[k], made.lon_deg[k]) == pytest.approx((lat, lon), abs=1e-6)
        assert made.pressure_alt_m[k] == pytest.approx(feet * 0.3048)


def test_accuracy_and_velocity_are_the_latest_received():
    pytest.importorskip("rs1090")
    made = read_lines(SAMPLE.read_text().splitlines())
    # a6f2b7 sends NACp 10 in its target state message, in line 15.
    of_one = (made.icao == "a6f2b7") & (made.line > 15)
    np.testing.assert_allclose(made.covariance_m2[of_one][:, 0], (10.0 / RADIUS_95) ** 2)
    np.testing.assert_allclose(made.speed_m_per_s[of_one], 204.0, atol=1.0)
    # Positions before any NACp use the accuracy of their own type: NUCp 7.
    silent = np.isnan(made.extra["nac_p"])
    assert silent.any()
    np.testing.assert_allclose(made.covariance_m2[silent][:, 0], (92.6 / RADIUS_95) ** 2)
    # Geometric height = barometric height + difference in the velocity message.
    known = np.isfinite(made.alt_m)
    np.testing.assert_allclose((made.alt_m - made.pressure_alt_m)[known], made.extra["above_pressure_m"][known])


def test_the_published_pair_gives_the_published_position():
    pytest.importorskip("rs1090")
    odd, even = "8D40621D58C386435CC412692AD6", "8D40621D58C382D690C8AC2863A7"
    made = read_lines([f"1457996400.0 {odd}", f"1457996402.0 {even}"])
    assert (made.lat_deg[0], made.lon_deg[0]) == pytest.approx((52.2572, 3.91937), abs=1e-5)
    assert made.pressure_alt_m[0] == pytest.approx(38000 * 0.3048) and made.icao[0] == "40621d"


def test_wrapping_counters_are_unwrapped_from_the_start():
    pytest.importorskip("rs1090")
    odd, even = "8D40621D58C386435CC412692AD6", "8D40621D58C382D690C8AC2863A7"
    lines = [f"@{0x100000000000:012X}{odd};", f"@{0x100000000000 + 24_000_000:012X}{even};"]
    assert read_lines(lines, start_s=1457996400.0).time_s.tolist() == [1457996402.0]
    with pytest.raises(InputError, match="roof: no time in 2 of 2 messages; give start"):
        read_lines(lines)
    with pytest.raises(InputError, match="write one before every message"):
        read_lines([f"*{odd};", f"*{even};"])


def test_broken_messages_are_counted_by_line():
    pytest.importorskip("rs1090")
    lines = SAMPLE.read_text().splitlines()
    lines[3] = lines[3][:-1] + "0"
    lines.insert(7, "rubbish")
    lines.insert(9, "1753827787.0,8DAB")
    made = read_lines(lines)
    assert made.damaged.lines.tolist() == [4, 8, 10]
    assert made.damaged.reasons[0] == "not Mode S, or wrong parity"
    with pytest.raises(InputError, match="roof: no position in 1 messages"):
        read_lines(["1457996400.0 8D40621D58C386435CC412692AD6"])


def test_missing_rs1090_is_reported_with_the_remedy(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rs1090", None)
    with pytest.raises(InputError, match=r"raw Mode S messages need rs1090: pip install 'sameas\[targets\]'"):
        read_lines(["1457996400.0 8D40621D58C386435CC412692AD6"])


# ------------------------------------------------------------------------------------------- other ways to write them

ODD, EVEN = "8d40621d58c386435cc412692ad6", "8d40621d58c382d690c8ac2863a7"


def beast_frame(message, counter):
    """A frame with a counter of 6 bytes, as receivers send it on port 30005."""
    body = counter.to_bytes(6) + b"\x40" + bytes.fromhex(message)
    return b"\x1a" + (b"3" if len(message) == 28 else b"2") + body.replace(b"\x1a", b"\x1a\x1a")


def test_beast_frames_are_read_from_a_file(tmp_path):
    """The counter holds an escape byte; the frames between are of Mode A/C and of the receiver's state."""
    pytest.importorskip("rs1090")
    odd, even = beast_frame(ODD, 0x1A1A_0000), beast_frame(EVEN, 0x1A1A_0000 + 24_000_000)
    between = b"\x1a1" + bytes(7) + b"\x12\x34" + b"\x1a4" + bytes(21)
    file = tmp_path / "roof.bin"
    file.write_bytes(odd + between + even + even[:-4])
    [made] = read_reports(file, ReadOptions(start="2016-03-14T23:00:00Z"))
    assert made.time_s.tolist() == [1457996402.0] and made.icao.tolist() == ["40621d"] and made.line.tolist() == [4]
    assert made.damaged.sentences() == ["1 frame damaged: a Beast frame of another length (frame 5)"]
    assert made.passed_over["Mode A/C message"] == made.passed_over["state of the receiver"] == 1
    with pytest.raises(InputError, match="no time in 2 of 2 messages; give start, the UTC of the first frame"):
        read_reports(file)


def test_a_counter_of_gps_is_the_time_of_the_day(tmp_path):
    pytest.importorskip("rs1090")
    times = [(86_390 + k, 250_000_000 * (k % 4)) for k in range(10)] + [(2, 500_000_000)]
    counters = [(seconds << 30) + nanoseconds for seconds, nanoseconds in times]
    frames = [beast_frame((ODD, EVEN)[k % 2], counter) for k, counter in enumerate(counters)]
    file = tmp_path / "roof.bin"
    file.write_bytes(b"".join(frames))
    [made] = read_reports(file, ReadOptions(start="2024-05-01"))
    midnight = 1714521600.0
    assert made.time_s[0] == pytest.approx(midnight + 86_391.25)
    assert made.time_s[-1] == pytest.approx(midnight + 86_402.5)


@pytest.mark.parametrize("size", [1, 2, 7, 23, 1000])
def test_frames_may_be_cut_anywhere(size):
    rng = np.random.default_rng(size)
    # Counters, levels and messages of escapes and types only are the hardest to cut.
    bodies = [bytes(rng.choice([0x1A, 0x31, 0x33, 0x05], 21).tolist()) for _ in range(200)]
    data = b"".join(b"\x1a3" + body.replace(b"\x1a", b"\x1a\x1a") for body in bodies)
    rest, messages = b"", []
    for start in range(0, len(data), size):
        rest += data[start : start + size]
        frames = beast.split_frames(rest)
        assert not frames.damaged
        messages += frames.messages
        rest = rest[frames.end :]
    messages += beast.split_frames(rest, final=True).messages
    assert messages == [body[7:].hex() for body in bodies]


def test_json_lines_of_jet1090_are_decoded_from_their_frames(tmp_path):
    """A second receiver's message is no second report; a position on the ground is the one that jet1090 found."""
    pytest.importorskip("rs1090")
    ground = {"timestamp": 1457996390.0, "frame": "903a23ff426a4e65f7487a775d17", "latitude": 52.32, "longitude": 4.73}
    lines = [ground, {"timestamp": 1457996400.0, "frame": ODD}, {"timestamp": 1457996402.0, "frame": EVEN},
             {"timestamp": 1457996402.05, "frame": EVEN}, {"timestamp": 1457996403.0, "frame": "20"}]  # fmt: skip
    file = tmp_path / "roof.jsonl"
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    [made] = read_reports(file)
    assert made.lat_deg.tolist() == pytest.approx([52.32, 52.2572], abs=1e-4)
    assert made.extra["on_ground"].tolist() == [1.0, 0.0]
    assert made.passed_over["message of a second receiver"] == 1 and made.damaged.lines.tolist() == [5]


@pytest.mark.parametrize("form", ["beast", "avr", "json"])
def test_messages_of_transponders_arrive_live_in_pieces(form):
    """A position needs two halves, which are in different pieces; times are those of receipt, or stated."""
    pytest.importorskip("rs1090")
    stream = ReportStream("roof")
    made = []
    for message, when in ((ODD, 1457996400.0), (EVEN, 1457996402.0)):
        piece = {
            "beast": beast_frame(message, 5),
            "avr": f"*{message.upper()};\r\n".encode(),
            "json": json.dumps({"timestamp": when, "frame": message}).encode() + b"\n",
        }[form]
        for part in (piece[:9], piece[9:]):
            stream.feed(part, when)
            made += stream.reports()
    [reports] = made
    assert stream.format == "mode-s" and reports.time_s.tolist() == [1457996402.0]
    assert (reports.lat_deg[0], reports.lon_deg[0]) == pytest.approx((52.2572, 3.91937), abs=1e-4)
    assert stream.passed_over == {"half a position": 1} and not stream.damaged


def test_a_trace_of_readsb_has_the_positions_of_one_aircraft(tmp_path):
    further = {"type": "adsb_icao", "flight": "DAL1812 ", "nac_p": 9, "squawk": "3451"}
    trace = [[0.0, 16.77, -88.03, 32000, 478.6, 327.8, 0, -64, further, "adsb_icao", 33825, 32, 280, 0.0],
             [9.5, 16.79, -88.04, "ground", 12.0, 336.8, 4, 128, None, "adsb_icao"],
             [12.0, 16.80, -88.05, 1500, 12.0, 336.8, 8, None, None], "rubbish"]  # fmt: skip
    file = tmp_path / "trace_full_ac671b.json"
    document = {"icao": "ac671b", "r": "N899DN", "t": "B739", "timestamp": 1738703622.5, "trace": trace}
    file.write_text(json.dumps(document))
    [made] = read_reports(file)
    assert made.time_s.tolist() == [1738703622.5, 1738703632.0, 1738703634.5] and made.icao[2] == "ac671b"
    assert made.callsign.tolist() == ["DAL1812"] * 3 and made.covariance_m2[2, 0] == made.covariance_m2[0, 0]
    feet = 0.3048
    np.testing.assert_allclose(made.pressure_alt_m, [32000 * feet, np.nan, np.nan])
    np.testing.assert_allclose(made.alt_m, [33825 * feet, np.nan, 1500 * feet])
    np.testing.assert_allclose(made.climb_m_per_s, [-64 * feet / 60, 128 * feet / 60, np.nan])
    assert made.damaged.sentences() == ["1 record damaged: no list of aircraft (record 4)"]
