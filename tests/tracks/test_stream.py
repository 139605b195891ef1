"""Streams: readers fed in pieces give the result of the whole file."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from tests.tracks.test_asterix import block, plot

from sameas.errors import InputError
from sameas.io.sensors import ReadOptions, asterix, nmea, read_reports
from sameas.io.sensors.stream import ReportStream, format_of
from sameas.tracks.reports import joined

DATA = Path(__file__).parent / "data"


def nmea_line(body):
    return f"${body}*{nmea.checksum(body):02X}".encode()


def by_pieces(data, cuts, **options):
    """Reports by sensor name of a stream fed with ``data`` in pieces."""
    stream, out = ReportStream("wire", **options), {}
    for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True):
        stream.feed(data[a:b], 1_714_560_000.0)
        for reports in stream.reports():
            out.setdefault(reports.source, []).append(reports)
    return stream, {name: joined(parts) for name, parts in out.items()}


@pytest.mark.parametrize("seed", [0, 1])
def test_ais_in_any_pieces_equals_the_file(seed):
    data = (DATA / "ais_sample.nmea").read_bytes()
    cuts = np.sort(np.random.default_rng(seed).choice(len(data), 40, replace=False)).tolist()
    stream, found = by_pieces(data, cuts)
    [whole] = read_reports(DATA / "ais_sample.nmea", ReadOptions(start=1_714_560_000.0))
    live = found["wire:ais"]
    assert stream.format == "nmea" and len(live) == len(whole) > 5
    assert live.mmsi.tolist() == whole.mmsi.tolist()
    np.testing.assert_allclose(live.extra["antenna_lat_deg"], whole.extra["antenna_lat_deg"])
    assert np.all(np.abs(live.time_s - 1_714_560_000.0) <= 60.0)


def sentence(body):
    checksum = 0
    for letter in body:
        checksum ^= ord(letter)
    return f"${body}*{checksum:02X}\r\n"


def test_own_ship_is_remembered_from_piece_to_piece():
    stream = ReportStream("bridge")
    stream.feed(sentence("GPGGA,120000,5033.0,N,00057.0,W,1,8,1,0,M,0,M,,").encode(), 100.0)
    stream.feed(sentence("HEHDT,90.0,T").encode(), 100.5)
    assert stream.reports() == []
    stream.feed(sentence("RATTM,01,2.0,10.0,R,5.0,45.0,T,,,N,,T,,,").encode(), 101.0)
    [reports] = stream.reports()
    assert reports.source == "bridge:arpa" and reports.bearing_deg.tolist() == [100.0]
    assert reports.station_lat_deg[0] == pytest.approx(50.55) and reports.time_s.tolist() == [101.0]
    assert stream.own_ship == pytest.approx((50.55, -0.95, 90.0))


def test_lines_of_two_connections_are_not_mixed():
    stream, row = ReportStream("receivers", "table"), {"time": 1714560000, "lat": 50.1, "lon": -1.2}
    for at in range(0, 90, 20):
        for connection in (1, 2):
            line = json.dumps(row | {"mmsi": f"23507076{connection}"}).encode() + b"\n"
            stream.feed(line[at : at + 20], 0.0, connection=connection)
    [reports] = stream.reports()
    assert sorted(reports.mmsi.tolist()) == ["235070761", "235070762"] and not +stream.damaged


def test_a_datagram_cut_off_does_not_spoil_the_next():
    data = block(48, plot(40_000.0, 1) + plot(40_000.5, 2))
    stream = ReportStream("feed", "asterix")
    stream.feed(data[:-5], 1_714_560_000.0, last=True)
    stream.feed(data, 1_714_560_000.0, last=True)
    [reports] = stream.reports()
    assert len(reports) == 2 and stream.damaged["an ASTERIX block that is cut off"] == 1


def blocks_at(times):
    return [block(48, plot(40_000.0 + t, 2 * t + 1) + plot(40_000.5 + t, 2 * t + 2)) for t in times]


def numbers_of(stream):
    return sorted(int(name) for reports in stream.reports() for name in reports.track_id)


@pytest.mark.parametrize("piece", [7, 60, 1000])
@pytest.mark.parametrize(
    ("spoil", "lost"),
    [
        (lambda b: [*b[:4], b[4][:-3], *b[5:]], {9, 10}),  # the last bytes of a block
        (lambda b: [*b[:4], b[4][:2] + b[4][9:], *b[5:]], {9, 10}),  # bytes of its header and its first record
        (lambda b: [*b[:4], b[4][20:], *b[5:]], {9, 10}),  # the beginning of a block
        (lambda b: [*b[:4], b[4][:12], b[6][15:], *b[7:]], {9, 10, 11, 12, 13, 14}),  # across three blocks
        (lambda b: [*b[:4], b"\x07ETX garbage \x30\x00 \x15\x01\xff", *b[4:]], set()),  # foreign bytes in between
        (lambda b: [b[0][9:], *b[1:]], {1, 2}),  # a connection that begins within a block
        (lambda b: [*b[:4], b[4][:1] + b"\xff" + b[4][2:], *b[5:]], {9, 10}),  # a wrong length
        (lambda b: [*b[:4], bytes(300), *b[4:]], set()),
    ],
)
def test_an_asterix_stream_is_read_on_after_lost_or_foreign_bytes(piece, spoil, lost):
    data = b"".join(spoil(blocks_at(range(12))))
    stream = ReportStream("feed", "asterix")
    found = []
    for at in range(0, len(data), piece):
        stream.feed(data[at : at + piece], 1_714_560_000.0)
        found += numbers_of(stream)
    assert set(found) == set(range(1, 25)) - lost and len(found) == len(set(found))
    assert stream.damaged["bytes that are no ASTERIX block"] == 1


def test_a_false_length_does_not_stop_an_asterix_stream_for_long():
    stream = ReportStream("feed", "asterix")
    stream.feed(b"\x30\xff\xf0" + bytes(range(200)), 0.0)
    stream.feed(b"".join(blocks_at(range(2))), 0.0)
    assert numbers_of(stream) == [1, 2, 3, 4] and sum(stream.damaged.values()) == 1


def test_blocks_of_categories_that_are_not_read_are_no_damage():
    other = [block(34, b"\xf6\x01\x02\x01\x00\x00\x00\x40\x10\x20"), block(253, b"\x01\x02\x03\x04\x05")]
    stream = ReportStream("feed", "asterix")
    data = b"".join(b for pair in zip(blocks_at(range(6)), other * 3, strict=True) for b in pair)
    for at in range(0, len(data), 5):
        stream.feed(data[at : at + 5], 0.0)
    assert numbers_of(stream) == list(range(1, 13)) and not +stream.damaged
    assert stream.passed_over["block of category 253"] >= 1


def test_an_asterix_file_is_read_on_after_damage():
    blocks = blocks_at(range(8))
    content = b"".join([*blocks[:3], blocks[3][:-4], *blocks[4:]])
    [reports] = asterix.read(content, "radar", 1_714_521_600.0)
    assert sorted(map(int, reports.track_id)) == [1, 2, 3, 4, 5, 6, 9, 10, 11, 12, 13, 14, 15, 16]
    assert "bytes at byte" in " ".join(reports.damaged.sentences())


def test_damaged_lines_are_counted_and_reading_continues():
    stream = ReportStream("bridge", "nmea")
    stream.feed(b"!AIVDM,1,1,,A,33P;Tw0tjBQO22:E7dm66DrB20UP,0*00\n\xff\xfe nonsense\n", 0.0)
    assert stream.reports() == [] and sum(stream.damaged.values()) == 2
    stream.feed(b"!AIVDM,1,1,,A,33P;Tw0tjBQO22:E7dm66DrB20UP,0*2E\n", 1.0)
    assert len(stream.reports()[0]) == 1


def test_repeated_aircraft_positions_are_no_new_reports_in_later_pieces():
    snapshot = {"now": 1e9, "aircraft": [{"hex": "a0b1c2", "lat": 50.0, "lon": 1.0, "seen_pos": 0.2}]}
    stream = ReportStream("feeder")
    for k in range(3):
        stream.feed(json.dumps(snapshot | {"now": 1e9 + 0.1 * k}).encode() + b"\n", 0.0)
        reports = stream.reports()
        assert len(reports) == (k == 0)
    assert stream.passed_over["position repeated"] == 2


def test_sbs_positions_include_other_fields_of_earlier_pieces():
    stream = ReportStream("feeder")
    head = "1,1,A0B1C2,1,2024/05/01,12:00:00.000,2024/05/01,12:00:00.000"
    stream.feed(f"MSG,1,{head},BAW12,,,,,,,,,,,\n".encode(), 0.0)
    assert stream.reports() == []
    stream.feed(f"MSG,3,{head},,35000,,,50.1,-1.2,,,,,,0\n".encode(), 0.0)
    [reports] = stream.reports()
    assert reports.callsign.tolist() == ["BAW12"] and reports.lat_deg.tolist() == [50.1]


def test_asterix_takes_the_date_of_receipt_and_a_source_per_sensor():
    received = 1_714_560_000.0
    day_s = received % 86400.0
    stream, data = ReportStream("lan"), block(48, plot(day_s))
    stream.feed(data, received, last=True)
    stream.feed(data, received, last=True)
    [reports] = stream.reports()
    assert reports.source.startswith("lan:048 ") and reports.time_s[0] == pytest.approx(received, abs=0.01)
    assert stream.passed_over["block that came before, from a second network"] == 1


def test_signal_k_gives_vessels_own_ship_and_radar_targets(tmp_path):
    def delta(context, *values, time="2024-05-01T12:00:00Z"):
        return {
            "context": context,
            "updates": [{"timestamp": time, "values": [{"path": p, "value": v} for p, v in values]}],
        }

    lines = [
        {"name": "server", "self": "urn:mrn:imo:mmsi:230099999", "roles": ["master"]},
        delta("vessels.urn:mrn:imo:mmsi:230099999", ("navigation.position", {"latitude": 50.0, "longitude": -1.0})),
        delta("vessels.urn:mrn:imo:mmsi:235070762", ("navigation.speedOverGround", 5.0), ("", {"name": "ALBA"})),
        delta("vessels.urn:mrn:imo:mmsi:235070762", ("", {"communication": {"callsignVhf": "GABC"}})),
        delta("vessels.urn:mrn:imo:mmsi:235070762", ("registrations.imo", "IMO 9074729")),
        delta("vessels.urn:mrn:imo:mmsi:235070762", ("navigation.position", {"latitude": 50.1, "longitude": -1.1})),
        delta("vessels.self", ("radars.quay.targets.3", {"distance": 900.0, "bearing": math.pi / 2})),
        delta("vessels.self", ("navigation.position", {"latitude": "north"})),
    ]
    data = "".join(json.dumps(line) + "\n" for line in lines).encode()
    stream, found = by_pieces(data, [100, 333])
    ships, targets = found["wire:ais"], found["wire:arpa"]
    assert (ships.mmsi.tolist(), ships.name.tolist(), ships.speed_m_per_s.tolist()) == (["235070762"], ["ALBA"], [5.0])
    assert (ships.callsign.tolist(), ships.imo.tolist()) == (["GABC"], ["9074729"])
    assert targets.range_m.tolist() == [900.0] and targets.bearing_deg[0] == pytest.approx(90.0)
    assert targets.station_lat_deg.tolist() == [50.0] and sum(stream.damaged.values()) == 1
    path = tmp_path / "deltas.jsonl"
    path.write_bytes(data)
    assert [reports.kind for reports in read_reports(path)] == ["ais", "arpa"]
    # The log of a server has milliseconds and the provider before each delta.
    path.write_text("".join(f"1714564800000;n2k;{json.dumps(line)}\n" for line in lines))
    assert [reports.kind for reports in read_reports(path)] == ["ais", "arpa"]


def test_reports_of_a_stream_say_where_own_ship_was_then():
    """A recording is replayed by them; her position may have come long before."""
    stream = ReportStream("bridge", "nmea")
    stream.feed(nmea_line("GPRMC,130212.00,A,5000.0,N,00100.0,W,10.0,90.0,120116,,,A") + b"\r\n", 1e9)
    assert stream.reports() == []
    for lat in ("5000.0", "5001.0"):
        stream.feed(TTM + b"\r\n" + nmea_line(f"GPGLL,{lat},N,00100.0,W,,A") + b"\r\n", 1e9 + 3.0)
    [reports] = stream.reports()
    assert reports.extra["own_lat_deg"].tolist() == [50.0, 50.0]
    assert reports.extra["own_course_deg"].tolist() == [90.0, 90.0]
    assert stream.own_ship[0] == pytest.approx(50.0 + 1 / 60)


def test_buoys_and_base_stations_on_signal_k_are_no_ships():
    place = {"path": "navigation.position", "value": {"latitude": 50.0, "longitude": -1.0}}
    contexts = "atons.urn:mrn:imo:mmsi:992351000", "shore.basestations.urn:mrn:imo:mmsi:002320001", "vessels.x"
    update = {"timestamp": "2024-05-01T12:00:00Z", "values": [place]}
    lines = [json.dumps({"context": context, "updates": [update]}) + "\n" for context in contexts]
    stream, found = by_pieces("".join(lines).encode(), [])
    assert found["wire:ais"].track_id.tolist() == ["vessels.x"]
    assert stream.passed_over["aid to navigation or base station"] == 2


def test_the_compass_of_a_yacht_on_signal_k_is_her_heading_with_its_variation(tmp_path):
    at = {"timestamp": "2024-05-01T12:00:00Z"}
    place = {"path": "navigation.position", "value": {"latitude": 50.0, "longitude": -1.0}}
    compass = {"path": "navigation.headingMagnetic", "value": math.radians(1.0)}
    variation = {"path": "navigation.magneticVariation", "value": math.radians(-3.0)}
    other = "vessels.urn:mrn:imo:mmsi:235070762"
    lines = [{"context": "vessels.self", "updates": [at | {"values": [one]}]} for one in (place, compass, variation)]
    lines.append({"context": other, "updates": [at | {"values": [place, compass]}]})
    data = "".join(json.dumps(line) + "\n" for line in lines).encode()
    stream, found = by_pieces(data, [])
    assert stream.own_ship == pytest.approx((50.0, -1.0, 358.0))
    assert found["wire:ais"].extra["own_heading_deg"][0] == pytest.approx(358.0)
    assert "magnetic_heading_deg" not in found["wire:ais"].extra


def test_an_invalid_line_does_not_affect_the_others():
    stream = ReportStream("coast", "table")
    stream.feed(b'time,lat\n{"time": 1714560000, "lat": 50.1, "lon": -1.2, "mmsi": "235070762"}\n[1]\n', 0.0)
    [reports] = stream.reports()
    assert len(reports) == 1 and stream.damaged["no JSON object"] == 2
    stream.feed(b"\nnothing\n", 1.0)
    assert stream.reports() == []


def test_the_format_is_recognised_from_the_first_bytes():
    assert format_of(b"!AIVDM,1,1") == format_of(b"\\s:x*00\\!AIVDM") == "nmea"
    assert format_of(b"MSG,3,") == "sbs" and format_of(b'{"now": 1, "aircraft": [') == "aircraft"
    assert format_of(b'{"name": "boat", "version": "2.0", "self": "vessels.urn:mrn:imo:mmsi:235000001"}\n') == "signalk"
    assert format_of(b"") is None and format_of(b'{"lat": 1') is None
    with pytest.raises(InputError, match="not a stream format"):
        ReportStream("x", "csv")
    assert nmea.log_of(["$GPHDT,1,T"], received_s=[7.0]).clock_s.tolist() == [7.0]


TTM = nmea_line("RATTM,05,12.345,45.6,T,12.0,180.0,T,,,N,,T,,,A")


def nmea_stream(*datagrams, end=False):
    """A stream fed with datagrams of senders, (number, bytes), or with pieces of connection 0 that then ends."""
    stream = ReportStream("bridge")
    for sender, data in datagrams:
        stream.feed(data, 1_714_560_000.0, connection=sender, last=not end)
    if end:
        stream.feed(b"", 1_714_560_000.0, last=True)
    return stream, [reports for reports in stream.reports() if reports.source.endswith("arpa")]


@pytest.mark.parametrize("cut", [1, 12, 23, 40, len(TTM) - 2])
def test_a_sentence_that_datagrams_cut_is_whole_again(cut):
    other = nmea_line("RATTM,06,2.000,90.0,T,12.0,180.0,T,,,N,,T,,,A")
    stream, [reports] = nmea_stream((1, TTM[:cut]), (2, other), (1, TTM[cut:] + b"\r\n" + other[:9]))
    assert sorted(reports.range_m.round().tolist()) == [3704.0, round(12.345 * 1852)]
    assert reports.bearing_deg.max() == 90.0 and reports.bearing_deg.min() == 45.6 and not +stream.damaged


def test_a_datagram_without_a_line_end_is_read_at_once():
    stream, [reports] = nmea_stream((1, TTM))
    assert len(reports) == 1 and not +stream.damaged


@pytest.mark.parametrize("end", [True, False])
def test_a_sentence_cut_off_is_damaged_and_no_report(end):
    stream, [reports] = nmea_stream((0, TTM + b"\r\n"), (0, TTM[:22]), *[(0, TTM)] * (not end), end=end)
    assert set(reports.bearing_deg.tolist()) == {45.6} and stream.damaged["a line that is cut off"] == 1


def test_a_line_that_ends_within_a_sentence_is_damaged_and_no_report():
    stream, [reports] = nmea_stream((0, TTM + b"\r\n" + TTM[:20] + b"\r\n" + TTM + b"\r\n"), (0, TTM[:20] + b"\r\n"))
    assert reports.bearing_deg.tolist() == [45.6, 45.6] and stream.damaged == {nmea.CUT_OFF: 2}
    # One sentence of another device has none: that says nothing about the others.
    [arpa] = read_sentences([TTM, b"$RATLL,05,5030.0,N,00100.0,W,,,T,"])
    assert arpa == "RATTM RATLL"


def read_sentences(lines):
    log = nmea.log_of([line.decode() for line in lines], received_s=[0.0] * len(lines))
    return [" ".join(sentence.address for sentence in log.sentences)]


def test_sentences_without_checksums_need_none():
    stream, [reports] = nmea_stream((0, TTM[:-3]), (0, TTM[:-3]), (0, TTM[:-3] + b"\r\n"))
    assert len(reports) == 3 and not +stream.damaged


def test_a_position_cut_off_with_its_connection_is_no_report():
    line = b"MSG,3,1,1,3C0001,1,2024/05/01,12:00:00.000,2024/05/01,12:00:00.000,,35000,,,51.50123,-1.23456,,,0,0,0,0"
    stream = ReportStream("sbs")
    stream.feed(line + b"\r\n" + line[:-18], 0.0, connection=1)
    stream.feed(b"", 0.0, connection=1, last=True)
    [reports] = stream.reports()
    assert reports.lon_deg.tolist() == [-1.23456] and stream.damaged["a line that is cut off"] == 1


def test_sbs_lines_in_local_time_are_read_in_their_zone():
    line = b"MSG,3,1,1,3C0001,1,2024/07/01,14:00:00.000,2024/07/01,14:00:00.000,,35000,,,51.5,-1.2,,,0,0,0,0\n"
    stream = ReportStream("sbs", options=ReadOptions(time_zone="Europe/Berlin"))
    stream.feed(line, 0.0)
    assert (stream.reports()[0].time_s / 3600.0 % 24.0).tolist() == [12.0]


def signalk_delta(second, **values):
    update = {"timestamp": f"2024-05-01T12:00:{second:02d}Z", "values": [
        {"path": name.replace("_", "."), "value": value} for name, value in values.items()
    ]}  # fmt: skip
    return json.dumps({"context": "vessels.urn:mrn:imo:mmsi:235070762", "updates": [update]}).encode() + b"\n"


def signalk_reports(*deltas):
    stream = ReportStream("boat", "signalk")
    for one in deltas:
        stream.feed(one, 0.0)
    [reports] = stream.reports()
    return reports


def test_a_ship_of_signal_k_is_at_the_middle_of_its_hull():
    place = {"navigation_position": {"latitude": 50.1, "longitude": -1.2}}
    size = {"design_length": {"overall": 300.0, "hull": 290.0}, "design_beam": 40.0}
    east = {"navigation_headingTrue": math.pi / 2}
    bow = {"sensors_ais_fromBow": 250.0}
    # Sizes come seldom, long before the positions; the antenna is 100 m behind the middle.
    moved = signalk_reports(signalk_delta(0, **size, **bow), signalk_delta(50, **east), signalk_delta(55, **place))
    assert (moved.length_m[0], moved.width_m[0]) == (300.0, 40.0)
    metres_per_degree = 111_412.84 * math.cos(math.radians(50.1)) - 93.5 * math.cos(3 * math.radians(50.1))
    assert (moved.lon_deg[0] + 1.2) * metres_per_degree == pytest.approx(100.0, abs=0.3)
    assert moved.lat_deg[0] == pytest.approx(50.1, abs=1e-7)
    assert moved.covariance_m2[0] == pytest.approx([15.0**2 + 300.0**2 / 12, 0.0, 15.0**2 + 40.0**2 / 12], abs=0.1)
    # A GNSS antenna of the vessel does as well.
    gps = {"sensors_gps_fromBow": 250.0}
    same = signalk_reports(signalk_delta(0, **size, **gps), signalk_delta(50, **east), signalk_delta(55, **place))
    assert same.lon_deg[0] == moved.lon_deg[0]
    # Without the antenna's place the position stays, and could be anywhere on the hull.
    stays = signalk_reports(signalk_delta(0, **size), signalk_delta(50, **east), signalk_delta(55, **place))
    assert stays.lon_deg[0] == -1.2
    assert stays.covariance_m2[0, 0] == pytest.approx(15.0**2 + 2 * 300.0**2 / 12, abs=0.1)


@pytest.mark.parametrize("size", [{}, {"design_length": 0.0}, {"design_length": {"overall": None}},
                                  {"design_length": 4000.0, "design_beam": -1.0}])  # fmt: skip
def test_a_ship_of_signal_k_without_a_size_is_where_it_is_reported(size):
    reports = signalk_reports(signalk_delta(0, navigation_position={"latitude": 50.1, "longitude": -1.2}, **size))
    assert (reports.lat_deg[0], reports.lon_deg[0]) == (50.1, -1.2) and reports.covariance_m2 is None


def test_the_speed_of_own_ship_is_that_of_her_receiver():
    stream = ReportStream("bridge", "nmea")
    assert np.isnan(stream.own_velocity).all()

    def velocity(*bodies):
        stream.feed(b"\r\n".join([*map(nmea_line, bodies), b""]), 1_462_104_131.0)
        stream.reports()
        return stream.own_velocity

    moving = "GPRMC,130212.00,A,5046.380,N,00105.576,W,10.0,157.8,010516,,,A"
    assert velocity(moving) == pytest.approx((10 * 1852 / 3600, 157.8))
    assert velocity("GPVTG,90.0,T,,M,2.0,N,3.7,K,A") == pytest.approx((2 * 1852 / 3600, 90.0))
    # A receiver that rests sends no course; one without a fix says nothing.
    assert velocity(moving.replace("10.0,157.8", "0.0,")) == pytest.approx((0.0, 90.0))
    assert velocity(moving.replace(",A,5046", ",V,5046")) == pytest.approx((0.0, 90.0))
    boat = ReportStream("boat", "signalk")
    own = {"navigation.speedOverGround": 3.0, "navigation.courseOverGroundTrue": math.pi / 2,
           "navigation.position": {"latitude": 50.1, "longitude": -1.2}}  # fmt: skip
    values = [{"path": path, "value": value} for path, value in own.items()]
    update = {"timestamp": "2024-05-01T12:00:00Z", "values": values}
    boat.feed(json.dumps({"context": "vessels.self", "updates": [update]}).encode() + b"\n", 0.0)
    boat.reports()
    assert boat.own_velocity == pytest.approx((3.0, 90.0))


def test_the_state_of_a_ship_of_signal_k_is_the_status_of_her_ais():
    stream, found = ReportStream("sk", "signalk"), []
    for state in ("moored", "motoring"):
        values = [{"path": "navigation.state", "value": state},
                  {"path": "navigation.position", "value": {"latitude": 50.1, "longitude": -1.1}}]  # fmt: skip
        update = {"timestamp": "2026-01-01T00:00:00Z", "values": values}
        line = json.dumps({"context": "vessels.urn:mrn:imo:mmsi:235070762", "updates": [update]})
        stream.feed(line.encode() + b"\n", 0.0)
        found += [reports.extra["nav_status"][0] for reports in stream.reports()]
    assert found[0] == 5.0 and np.isnan(found[1])
