"""ADS-B: positions and their accuracy from snapshots, BaseStation lines and raw messages."""

import json
from pathlib import Path

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.sensors import aircraft, mode_s, sbs
from sameas.io.sensors.format import RADIUS_95

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
    made = mode_s.read(SAMPLE.read_text().splitlines(), "roof")
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
    made = mode_s.read(SAMPLE.read_text().splitlines(), "roof")
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
    made = mode_s.read([f"1457996400.0 {odd}", f"1457996402.0 {even}"], "roof")
    assert (made.lat_deg[0], made.lon_deg[0]) == pytest.approx((52.2572, 3.91937), abs=1e-5)
    assert made.pressure_alt_m[0] == pytest.approx(38000 * 0.3048) and made.icao[0] == "40621d"


def test_wrapping_counters_are_unwrapped_from_the_start():
    pytest.importorskip("rs1090")
    odd, even = "8D40621D58C386435CC412692AD6", "8D40621D58C382D690C8AC2863A7"
    lines = [f"@{0x100000000000:012X}{odd};", f"@{0x100000000000 + 24_000_000:012X}{even};"]
    assert mode_s.read(lines, "roof", start_s=1457996400.0).time_s.tolist() == [1457996402.0]
    with pytest.raises(InputError, match="roof: no time in 2 of 2 messages; give start"):
        mode_s.read(lines, "roof")
    with pytest.raises(InputError, match="write one before every message"):
        mode_s.read([f"*{odd};", f"*{even};"], "roof")


def test_broken_messages_are_counted_by_line():
    pytest.importorskip("rs1090")
    lines = SAMPLE.read_text().splitlines()
    lines[3] = lines[3][:-1] + "0"
    lines.insert(7, "rubbish")
    lines.insert(9, "1753827787.0,8DAB")
    made = mode_s.read(lines, "roof")
    assert made.damaged.lines.tolist() == [4, 8, 10]
    assert made.damaged.reasons[0] == "not Mode S, or wrong parity"
    with pytest.raises(InputError, match="roof: no position in 1 messages"):
        mode_s.read(["1457996400.0 8D40621D58C386435CC412692AD6"], "roof")


def test_missing_rs1090_is_reported_with_the_remedy(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rs1090", None)
    with pytest.raises(InputError, match=r"raw Mode S messages need rs1090: pip install 'sameas\[targets\]'"):
        mode_s.read(["1457996400.0 8D40621D58C386435CC412692AD6"], "roof")
