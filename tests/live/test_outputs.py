"""Outputs are read back by our own readers and by independent parsers."""

import json
import re
import socket
import xml.etree.ElementTree as ET
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.live.conftest import EVIL, SITE, START_S, replay, settings

from sameas.errors import InputError
from sameas.io.sensors.asterix_tracks import SentTracks
from sameas.io.sensors.stream import ReportStream
from sameas.live.keeper import Keeper
from sameas.live.outputs import ENCODERS, Sink, TargetNumbers, asterix, cot, geojson, metrics, nmea, sinks_of
from sameas.live.own_ship import OwnShipState
from sameas.live.situation import OBJECT
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.heights import GEOMETRIC, PRESSURE, HeightModel, _Line


@pytest.fixture(scope="module")
def situation(tmp_path_factory):
    """One situation, shared read-only by all tests."""
    keeper = Keeper(settings(), tmp_path_factory.mktemp("outputs") / "state", replay=replay(until_s=2400.0))
    for k in range(1, 30):
        made = keeper.tick(START_S + 2.0 * k)
    keeper.close()
    return made


def read_back(situation, format, stream_format, renamed=(b"", b"")):
    stream = ReportStream("out", stream_format)
    for part in ENCODERS[format](situation):
        stream.feed(part.replace(*renamed), situation.time_s, last=True)
    return stream.reports()


def received(situation, format, count):
    """The first datagrams that a sink sends."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        made.settimeout(5.0)
        sink = Sink(f"udp://127.0.0.1:{made.getsockname()[1]}", format)
        sink.send(situation)
        sink.close()
        return [made.recv(65536) for _ in range(count)]


def placed(situation):
    return {one["object"]: one for one in situation.listed()}


@pytest.mark.slow
def test_asterix_062_round_trips(situation):
    [reports] = read_back(situation, "asterix", "asterix")
    truth = placed(situation)
    assert reports.kind == "asterix 062" and len(reports) == 5
    for k, number in enumerate(reports.track_id.tolist()):
        one = truth[int(number)]
        assert reports.lat_deg[k] == pytest.approx(one["lat_deg"], abs=1e-5)
        assert reports.lon_deg[k] == pytest.approx(one["lon_deg"], abs=1e-5)
        assert np.hypot(reports.vx_m_per_s[k], reports.vy_m_per_s[k]) == pytest.approx(one["speed_m_per_s"], abs=0.4)
        assert reports.time_s[k] == pytest.approx(situation.time_s, abs=0.01)
        assert np.sqrt(reports.covariance_m2[k, 0]) == pytest.approx(np.sqrt(one["var_x_m2"]), abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "column"), [(GEOMETRIC, "alt_m"), (PRESSURE, "pressure_alt_m")])
def test_asterix_062_has_identities_and_heights(situation, model, column):
    count = len(situation.objects["object"])
    first = np.arange(count) == 0
    height = np.ma.array(np.full(count, 3000.0), mask=~first)
    more = {
        "height_m": height, "sigma_height_m": np.ma.array(np.full(count, 20.0), mask=~first),
        "climb_m_per_s": np.ma.array(np.full(count, -5.0), mask=~first),
    } | {name: np.where(first, value, situation.objects[name])
         for name, value in (("icao", "400801"), ("callsign", "BAW 12"), ("mode_a", "2476"))}  # fmt: skip
    flying = replace(situation, heights=HeightModel(model), objects=situation.objects | more)
    [reports] = read_back(flying, "asterix", "asterix")
    [k] = [k for k, address in enumerate(reports.icao) if address]
    assert (reports.icao[k], reports.callsign[k], reports.mode_a[k]) == ("400801", "BAW 12", "2476")
    assert getattr(reports, column)[k] == pytest.approx(3000.0, abs=4.0)
    assert reports.climb_m_per_s[k] == pytest.approx(-5.0, abs=0.02)
    # Ships have the beginning of their name in capitals, without what six bits cannot write.
    assert {text for text in reports.callsign if text} == {"BAW 12", *(f"SHIP {n}" for n in range(1, 5))}


@pytest.mark.slow
def test_a_track_of_asterix_062_begins_and_ends_once(situation):
    sent, tracks, gone = [], SentTracks(), int(situation.objects["object"][0])
    stages = situation.objects["stage"].copy()
    stages[situation.objects["object"] == gone] = "ended"
    ended = replace(situation, time_s=situation.time_s + 1.0, objects={**situation.objects, "stage": stages})
    held = np.where(stages == "ended", stages, "coasting")
    coasting = replace(ended, objects={**ended.objects, "stage": held})
    for one in (situation, situation, ended, coasting):
        stream = ReportStream("out", "asterix")
        for part in asterix(one, tracks):
            stream.feed(part, one.time_s, last=True)
        [reports] = stream.reports()
        sent.append(reports)
    flags = [dict(zip(reports.track_id.tolist(), reports.extra["ends"].tolist(), strict=True)) for reports in sent]
    everyone = {str(number): 0.0 for number in placed(situation)}
    rest = {number: 0.0 for number in everyone if number != str(gone)}
    assert flags == [everyone, everyone, {**everyone, str(gone): 1.0}, rest]
    # The end is the last report once more, at its own time.
    row = sent[2].track_id.tolist().index(str(gone))
    assert sent[2].time_s[row] == pytest.approx(situation.time_s, abs=0.01)
    # The begin takes an octet more; of a coasting track four octets follow each other.
    fresh = SentTracks()
    first, second = (sum(map(len, asterix(situation, fresh))) for _ in range(2))
    assert first == second + len(everyone)
    coasted = dict(zip(sent[3].track_id.tolist(), sent[3].extra["coasted"].tolist(), strict=True))
    assert coasted == dict.fromkeys(rest, 1.0)


def test_ttm_and_tll_round_trip(situation):
    lines = b"".join(ENCODERS["nmea"](situation)).decode()
    assert lines.count("$RATTM") == 5 == lines.count("$RATLL")
    [reports] = read_back(situation, "nmea", "nmea")
    truth = placed(situation)
    for k, number in enumerate(reports.track_id.tolist()):
        one = truth[int(number)]
        assert reports.range_m[k] == pytest.approx(np.hypot(one["x_m"], one["y_m"]), abs=2.0)
        assert reports.speed_m_per_s[k] == pytest.approx(one["speed_m_per_s"], abs=0.1)


def ships(numbers, x_m=None):
    """A situation with these confirmed objects, at these distances east of own ship."""
    places = x_m or {n: 1000.0 + n for n in numbers}
    listed = [
        {"object": n, "stage": "confirmed", "x_m": places[n], "y_m": 0.0, "speed_m_per_s": 1.0, "course_deg": 0.0}
        for n in numbers
    ]
    return SimpleNamespace(own_ship=OwnShipState(0.0, 0.0), cpa={}, time_s=START_S, plane=None, listed=lambda: listed)


def test_bearings_of_targets_are_from_true_north():
    """Own ship is 100 km east of the plane's origin, where north is 1.1 degrees from the plane's."""
    plane = LocalPlane(50.8, -1.3)
    (x, y), (x_of, y_of) = plane.of_geodetic([50.8, 50.9], [0.1, 0.1])
    one = {"object": 1, "stage": "confirmed", "x_m": x_of, "y_m": y_of, "speed_m_per_s": 0.0, "course_deg": 0.0}
    made: Any = SimpleNamespace(
        own_ship=OwnShipState(x, y), cpa={}, time_s=START_S, plane=plane, listed=lambda: [{"probability": 1.0, **one}]
    )
    (target,) = [part.decode().split(",") for part in nmea(made) if b"TTM" in part]
    assert abs((float(target[3]) + 180.0) % 360.0 - 180.0) < 0.05 and float(target[2]) == pytest.approx(6.0, abs=0.05)


def test_angles_are_below_360():
    """A bearing of 359.97° was sent as 360.0, which is none."""
    one = {"object": 1, "stage": "confirmed", "x_m": -0.5, "y_m": 1000.0, "speed_m_per_s": 1.0, "course_deg": 359.98}
    one |= {"lat_deg": 50.0, "lon_deg": -1.0, "var_x_m2": 1.0, "var_y_m2": 1.0}
    made: Any = SimpleNamespace(
        own_ship=OwnShipState(0.0, 0.0), cpa={}, time_s=START_S, plane=None, listed=lambda: [one], flying=frozenset()
    )
    (target,) = [part.decode().split(",") for part in nmea(made) if b"TTM" in part]
    assert (target[3], target[6]) == ("0.0", "0.0") and b'course="0.0"' in b"".join(cot(made))


def test_no_two_targets_have_the_same_number_and_a_target_keeps_its_own():
    numbers = TargetNumbers()
    numbers.update(ships([5, 105, 205]))
    first = dict(numbers.by_object)
    assert len(set(first.values())) == 3 and first[5] == 5
    assert not numbers.update(ships([7, 105, 205, 305, 5])) and len(set(numbers.by_object.values())) == 5
    assert all(numbers.by_object[n] == first[n] for n in first)


def test_a_target_that_ended_is_sent_as_lost_once_and_its_number_rests():
    numbers = TargetNumbers()
    list(nmea(ships([5, 6]), numbers))
    ended = b"".join(nmea(ships([6, 105]), numbers)).decode()
    assert re.findall(r"RATTM,(\d\d),[^\r]*,L,", ended) == ["05"] and numbers.by_object[105] != 5
    assert b",L," not in b"".join(nmea(ships([6, 105]), numbers))
    [reports] = nmea_reports(ended)
    assert sorted(reports.track_id) == sorted(f"{n:02d}" for n in numbers.by_object.values())


def nmea_reports(lines):
    stream = ReportStream("out", "nmea")
    stream.feed(lines.encode(), START_S)
    return stream.reports()


def test_of_more_than_a_hundred_targets_the_nearest_have_numbers():
    far = {n: 100.0 * n for n in range(1, 131)}
    numbers = TargetNumbers()
    numbers.update(ships(list(far), far))
    assert set(numbers.by_object) == set(range(1, 101)) and numbers.unnumbered == 30
    # Two that change order by a little keep theirs; one that comes near gets one.
    numbers.update(ships(list(far), far | {101: 9_950.0}))
    assert 101 not in numbers.by_object
    lost = numbers.update(ships(list(far), far | {120: 50.0}))
    assert 120 in numbers.by_object and 100 not in numbers.by_object and len(set(numbers.by_object.values())) == 100
    assert lost == []  # its number is in use again at once


def test_signal_k_deltas_round_trip(situation):
    [reports] = read_back(situation, "signalk", "signalk", (b'"sameas"', b'"another"'))
    truth = {one["mmsi"]: one for one in situation.listed()}
    assert set(reports.mmsi) == set(truth)
    for k, mmsi in enumerate(reports.mmsi):
        assert reports.lat_deg[k] == pytest.approx(truth[mmsi]["lat_deg"])


def test_objects_that_a_signal_k_server_sends_back_are_no_reports(situation):
    """A server forwards what it is sent under the same ``$source``: the picture would take its own objects for AIS."""
    stream = ReportStream("boat", "signalk")
    for part in ENCODERS["signalk"](situation):
        stream.feed(part, situation.time_s, last=True)
    assert stream.reports() == []
    assert stream.passed_over == {"update that sameas has sent": 5}


def test_every_signal_k_delta_is_a_datagram_of_its_own(situation):
    """A Signal K server parses a datagram as one delta: of several it took none."""
    contexts = {json.loads(datagram)["context"] for datagram in received(situation, "signalk", 5)}
    assert len(contexts) == 5


def test_cursor_on_target_is_valid_xml_for_any_ship_name(situation):
    found = [ET.fromstring(part) for part in ENCODERS["cot"](situation)]
    assert len(found) == 5 and EVIL in {one.find("detail/contact").get("callsign") for one in found}
    assert all(one.get("type") == "a-u-S" and 0.0 < float(one.find("point").get("ce")) < 200.0 for one in found)
    assert all(abs(float(one.find("point").get("lat")) - SITE[0]) < 0.2 for one in found)


def test_aircraft_without_an_address_are_in_the_air_and_raise_no_approach(situation):
    """A glider with FLARM, a target of a tower's radar and a helicopter of search and rescue were sent as ships."""
    numbers = situation.objects["object"].tolist()
    shown = [(numbers[0], "flarm"), (numbers[1], "tower"), (numbers[2], "tower"), (numbers[2], "ais")]
    records = {"object": np.array([n for n, _ in shown]), "source": np.array([name for _, name in shown], object)}
    mmsi = np.array(["", "", "", "111211501", *situation.objects["mmsi"][4:]], object)
    made = replace(
        situation, records=records, objects={**situation.objects, "mmsi": mmsi},
        of_aircraft=frozenset({"flarm", "tower"}), own_ship=OwnShipState(0.0, 0.0),
    )  # fmt: skip
    kinds = [ET.fromstring(part).get("type") for part in cot(made)]
    assert kinds == ["a-u-A", "a-u-A", "a-u-S", "a-u-A", "a-u-S"]
    assert not made.cpa.keys() & {numbers[0], numbers[1], numbers[3]}


@pytest.mark.parametrize(
    ("model", "hae", "sigma"),
    [
        (HeightModel(GEOMETRIC), 3000.0, 20.0),
        (HeightModel(PRESSURE), 3000.0, np.sqrt(20.0**2 + 250.0**2 + 120.0**2)),
        (HeightModel(PRESSURE, _Line(50.0, 0.02, 15.0, 40)), 3110.0, np.hypot(1.02 * 20.0, 15.0)),
    ],
)
def test_cursor_on_target_has_the_height_above_the_ellipsoid(situation, model, hae, sigma):
    count = len(situation.objects["object"])
    height = np.ma.masked_all(count)
    height[0] = 3000.0
    flying = replace(
        situation, heights=model,
        objects=situation.objects | {"height_m": height, "sigma_height_m": np.ma.where(height.mask, np.nan, 20.0)},
    )  # fmt: skip
    points = [ET.fromstring(part).find("point") for part in ENCODERS["cot"](flying)]
    [known] = [point for point in points if point.get("hae") != "9999999.0"]
    assert float(known.get("hae")) == pytest.approx(hae, abs=0.1)
    assert float(known.get("le")) == pytest.approx(1.645 * sigma, rel=0.01)
    assert all(point.get("le") == "9999999.0" for point in points if point is not known)


def test_an_aircraft_has_no_closest_approach_to_a_ship(situation):
    assert situation.cpa
    number = next(iter(situation.cpa))
    icao = np.where(situation.objects["object"] == number, "400801", situation.objects["icao"])
    flying = replace(situation, objects=situation.objects | {"icao": icao})
    assert set(situation.cpa) - set(flying.cpa) == {number}


def test_lines_and_geojson_contain_every_object_but_geojson_no_tentative_one(situation):
    lines = [json.loads(line) for line in b"".join(ENCODERS["jsonl"](situation)).splitlines()]
    assert {one["object"] for one in lines} == set(situation.objects["object"].tolist())
    assert all(set(one["sources"]) and one["time_s"] == situation.time_s for one in lines)
    assert len(geojson(situation)["features"]) == 5
    stage = situation.objects["stage"].copy()
    stage[1] = "tentative"
    unsure = replace(situation, objects=situation.objects | {"stage": stage})
    assert len(geojson(unsure)["features"]) == 4 and len(list(ENCODERS["jsonl"](unsure))) == 5


def test_a_sink_sends_what_fits_in_datagrams(situation):
    [came] = received(situation, "nmea", 1)
    assert came.startswith(b"$RATTM") and len(came) <= 1400 and came.endswith(b"\r\n")
    for wrong in ({"url": "ftp://x", "format": "nmea"}, {"url": "udp://x:1", "format": "morse"}, {"url": "udp://x:1"}):
        with pytest.raises(InputError, match="output"):
            sinks_of([wrong])


def test_sentences_have_82_characters_at_most(situation, monkeypatch):
    listed = [one | {"name": "ABCDEFGHIJKLMNOPQRST", "x_m": 100_000.0} for one in situation.listed()]
    monkeypatch.setattr(type(situation), "listed", lambda self: listed)
    monkeypatch.setattr(type(situation), "cpa", {one["object"]: (99_999.0, 9_999.0) for one in listed})
    sentences = list(ENCODERS["nmea"](situation))
    assert max(map(len, sentences)) == 82 and all(b",ABCDEFG" in sentence for sentence in sentences)


def test_no_transponder_text_stops_an_output(situation, monkeypatch):
    """A six-letter address that is no hexadecimal number once stopped the ASTERIX output."""
    hostile = {"icao": "zzzzzz", "mmsi": "=cmd()", "name": 'a*00\r\n$GPGLL,"/><x', "label": "]]>\x1b[31m\u2028"}
    listed = [one | hostile for one in situation.listed()]
    monkeypatch.setattr(type(situation), "listed", lambda self: listed)
    one = {"reports": 1, "unplaced": 0, "late": 0, "repeated": 0, "jumps": 0, "refused": 0}
    health = {"ok": True, "tick": 1, "faults": 0, "objects": 1, "alarms": 0, "sources": {hostile["name"]: one},
              "wires": {}, "timed": 1, "timed_s": 0.25}  # fmt: skip
    lines = metrics(health, [0.25]).split("\n")[:-1]
    names = [line.split()[2] for line in lines if line.startswith("# TYPE")]
    assert names == [line.split()[2] for line in lines if line.startswith("# HELP")] and len(names) == len(set(names))
    assert [line.split()[2] for line in lines if line.endswith(" counter") and "_total" not in line] == []
    assert all(re.fullmatch(r'#.*|[a-z_]+(\{[a-z]+="([^"\\\n]|\\.)*"\})? [0-9.]+', line) for line in lines), lines
    parts = {name: list(ENCODERS[name](situation)) for name in ENCODERS}
    assert all(parts.values())
    for part in parts["cot"]:
        assert ET.fromstring(part).find("detail/contact").get("callsign").isprintable()
    assert all(part.endswith(b"\r\n") and part[:-2].isascii() and part.count(b"*") == 1 for part in parts["nmea"])
    assert all(part.count(b"\n") == 1 and json.loads(part) for name in ("jsonl", "signalk") for part in parts[name])


def test_an_output_to_an_unknown_host_is_refused_before_the_watch():
    with pytest.raises(InputError, match=r"nohost.invalid is not found .*; give its address"):
        Sink("udp://nohost.invalid:1234", "cot")


@pytest.mark.parametrize(("icao", "height"), [("3c0001", 2320.0), ("", 2480.0)])
def test_a_glider_has_the_height_that_she_sends_and_an_airliner_a_flight_level(situation, icao, height):
    """A picture with pressure heights showed those of gliders, 160 m from what their pilots read, as metres."""
    count = len(situation.objects["object"])
    sent = np.ma.array(np.full(count, 2320.0))
    columns = {"height_m": sent, "sigma_height_m": np.ma.array(np.full(count, 15.0)), "icao": np.full(count, icao)}
    flying = replace(
        situation, heights=HeightModel(PRESSURE, _Line(160.0, 0.0, 10.0, 40)), objects=situation.objects | columns
    )
    rows = [dict(zip(OBJECT, row, strict=True)) for row in flying.object_rows.values()]
    assert {row["height"] for row in rows} == {height}
