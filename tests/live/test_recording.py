"""Recordings of what a watch receives: byte for byte, hour by hour, after a kill, and replayed by its sensor file."""

import errno
import io
import json
import os
import signal
import socket
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import Any

import numpy as np
import pyais
import pytest
from tests.live.conftest import SITE, START_S
from tests.live.test_inputs import free_port

from sameas.cli.watch import recorded_inputs, settings_of
from sameas.errors import InputError
from sameas.front.picture import match_picture
from sameas.io.sensors.recording import FILE_S, RecordedInput, RecordedSource, Recorder, files_in, read
from sameas.io.sensors.report_formats import read_reports
from sameas.io.sensors.sources import read_sources
from sameas.io.sensors.stream import ReportStream
from sameas.live.keeper import Keeper
from sameas.live.outputs import asterix, sentence
from sameas.live.settings import read_settings

TOML = """
[watch]
every_s = 0.2
register_every_s = 0
own_ship = {{ source = "radar" }}
record = "raw"

[sources.ais]
kind = "ais"
input = "udp://127.0.0.1:{port}"

[sources.radar]
kind = "marine radar"
input = "udp://127.0.0.1:{port}"

[sources.south]
kind = "marine radar"
input = {{ url = "udp://127.0.0.1:{other}", format = "table" }}
"""
SHIP: dict[str, Any] = {
    "type": 1,
    "mmsi": 235070762,
    "lat": SITE[0] + 0.03,
    "lon": SITE[1] + 0.02,
    "speed": 5.0,
    "course": 90.0,
    "second": 1,
}


def cable(k, at=None):
    """One second of a ship's log, k seconds after noon, or of the time ``at``: own ship, a radar target, AIS."""
    at = at or datetime(2024, 5, 1, 12, 0, 0, tzinfo=UTC) + timedelta(seconds=k)
    minutes = f"{60 * SITE[0] % 60:07.4f}"
    own = sentence(f"GPRMC,{at:%H%M%S}.00,A,50{minutes},N,00057.0000,W,0.0,0.0,{at:%d%m%y},,,A")
    target = sentence(f"RATTM,01,{2.0 + k / 100:.2f},45.0,T,5.0,90.0,T,,,N,,T,,{at:%H%M%S}.00,A")
    return own + target + pyais.encode_dict(SHIP, talker_id="AI", sentence_type="VDM")[0].encode() + b"\r\n"


@pytest.fixture
def sensors(tmp_path):
    path = tmp_path / "sensors.toml"
    ports = {"port": free_port(socket.SOCK_DGRAM), "other": free_port(socket.SOCK_DGRAM)}
    path.write_text(TOML.format(**ports))
    return path, ports["port"]


def recorded(tmp_path, pieces, sources, format_name=None, **options):
    recorder = Recorder(tmp_path / "raw", RecordedInput(tuple(sources), format_name, options))
    for piece in pieces:
        recorder.write([piece])
    recorder.close()
    return tmp_path / "raw"


def same(one, other):
    """Whether two reports have the same columns."""
    first, second = one.columns(), other.columns()
    for name in first:
        if first[name].dtype == object:
            assert first[name].tolist() == second[name].tolist()
        else:
            np.testing.assert_array_equal(first[name], second[name])
    return set(first) == set(second)


def test_a_recording_gives_the_reports_that_the_stream_gave(tmp_path):
    log = b"".join(cable(k) for k in range(5))
    # Pieces end anywhere, as those of TCP do.
    cuts = [0, 7, 100, 101, 300, len(log)]
    pieces = [(START_S + k, log[a:b], 1, False) for k, (a, b) in enumerate(pairwise(cuts))]
    pieces.append((START_S + 9, b"", 1, True))
    stream = ReportStream("cable")
    for received_s, data, connection, last in pieces:
        stream.feed(data, received_s, connection=connection, last=last)
    expected = stream.reports()
    folder = recorded(tmp_path, pieces, [RecordedSource("ais", "ais"), RecordedSource("radar", "marine radar")])
    [file] = files_in(folder)
    found = read(file)
    assert [reports.source for reports in found] == ["ais", "radar"]
    assert all(same(one, other) for one, other in zip(found, expected, strict=True))
    [path] = folder.iterdir()
    assert path.name == "ais+radar-20240501T104000Z.jsonl" and path.stat().st_mode & 0o777 == 0o600
    # A single file is read like any other of a sensor.
    assert [reports.source for reports in read_reports(path)] == ["ais", "radar"]


@pytest.mark.slow
def test_bytes_that_are_no_text_are_recorded(tmp_path, keeper):
    for _ in range(40):
        situation = keeper.tick(START_S + 60.0)
    blocks = b"".join(asterix(situation))
    folder = recorded(tmp_path, [(START_S + 60.1, blocks, 0, True)], [RecordedSource("tower", "tracks")])
    [line] = next(folder.iterdir()).read_bytes().splitlines()[1:]
    assert "base64" in json.loads(line)
    [source] = read_sources([folder])
    stream = ReportStream("tower")
    stream.feed(blocks, START_S + 60.1, last=True)
    assert same(source.reports, stream.reports()[0]) and source.description.kind == "tracks"


def test_how_an_input_is_read_is_part_of_the_recording(tmp_path):
    rows = b"".join(
        json.dumps({"when": f"2024-05-01T12:00:0{k}", "d": 1 + k, "b": 10}).encode() + b"\n" for k in range(4)
    )
    options = {
        "columns": {"time_s": "when", "range_m": "d", "bearing_deg": "b"},
        "units": {"d": "km"},
        "time_zone": "+02:00",
    }
    folder = recorded(
        tmp_path, [(START_S, rows, 0, True)], [RecordedSource("south", "marine radar")], "table", **options
    )
    [source] = read_sources([folder])
    assert source.reports.range_m.tolist() == [1000.0, 2000.0, 3000.0, 4000.0]
    assert source.reports.time_s[0] == START_S - 40 * 60.0


def test_a_file_ends_after_an_hour_and_old_ones_are_deleted(tmp_path):
    named = RecordedInput((RecordedSource("a b/c", "ais"),))
    recorder = Recorder(tmp_path, named, keep_s=2.0 * FILE_S)
    (tmp_path / "other-20200101T000000Z.jsonl").write_text("of another input")
    for hour in range(7):
        recorder.write([(START_S + hour * FILE_S, b"x\n", 0, True), (START_S + hour * FILE_S + 1.0, b"y\n", 0, True)])
    # A clock that is set back begins a file of its own.
    recorder.write([(START_S + 5 * FILE_S, b"z\n", 0, True)])
    recorder.close()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [
        "a_b_c-20240501T134000Z.jsonl", "a_b_c-20240501T144000Z.jsonl", "a_b_c-20240501T154000Z-2.jsonl",
        "a_b_c-20240501T154000Z.jsonl", "a_b_c-20240501T164000Z.jsonl", "other-20200101T000000Z.jsonl",
    ]  # fmt: skip
    assert [len((tmp_path / name).read_text().splitlines()) for name in names[:-1]] == [3, 3, 2, 3, 3]


def test_a_disk_that_refuses_is_an_alarm_and_the_next_piece_is_tried_again(tmp_path, sensors):
    path, _ = sensors
    keeper = Keeper(read_settings(path))
    (tmp_path / "raw").write_text("a file where the folder should be")
    wire = keeper.wires[next(iter(keeper.wires))]
    wire.receive(cable(0), 1, last=True)
    keeper.tick()
    [alarm] = [one for one in keeper.situation.alarms if one.key == "record"]
    assert alarm.text.startswith(f"{tmp_path / 'raw'} cannot be written; what is received is not recorded:")
    assert keeper.health()["wires"][wire.url]["not_recorded"] == 1
    (tmp_path / "raw").unlink()
    wire.receive(cable(1), 1, last=True)
    keeper.tick()
    assert not [one for one in keeper.situation.alarms if one.key == "record"]
    # What came after the last tick is recorded at the end.
    wire.receive(cable(2), 1, last=True)
    keeper.close()
    assert len(read_reports(next((tmp_path / "raw").iterdir()))[1]) == 2


@pytest.mark.parametrize("room", [0, 20])
def test_a_full_disk_is_left_without_files_that_hold_nothing(tmp_path, monkeypatch, room):
    """Each further piece is tried again: a file for each of them would use up the names of the disk."""
    left = [1 << 20]

    class Disk(io.FileIO):
        def write(self, data):
            n = min(len(data), left[0])
            left[0] -= n
            if data and not n:
                raise OSError(errno.ENOSPC, "No space left on device")
            return super().write(data[:n])

    monkeypatch.setattr(
        "sameas.io.sensors.recording.open", lambda path, mode, buffering: Disk(path, "x"), raising=False
    )
    recorder = Recorder(tmp_path, RecordedInput((RecordedSource("a", "ais"),)))
    recorder.write([(START_S, b"x", 0, True)])
    [first] = tmp_path.iterdir()
    for k in range(5):
        # As much as is left at any time.
        left[0] = room
        recorder.write([(START_S + 1.0 + k, b"y", 0, True)])
        assert recorder.error in ("No space left on device", "the disk is full")
        assert list(tmp_path.iterdir()) == [first]
    left[0] = 1 << 20
    recorder.write([(START_S + 10.0, b"z", 0, True)])
    recorder.close()
    assert recorder.error == "" and recorder.lost == 5
    assert ['"z"' in path.read_text() for path in sorted(tmp_path.iterdir())] == [False, True]


def test_a_recording_is_replayed_with_the_sensor_file_of_the_watch(tmp_path, sensors):
    path, _ = sensors
    now = [START_S + 4800.0]
    keeper = Keeper(read_settings(path), clock=lambda: now[0])
    wire = keeper.wires[next(iter(keeper.wires))]
    for k in range(30):
        now[0] += 1.0
        wire.receive(cable(k), 1, last=True)
    keeper.tick()
    keeper.close()
    # A source that sent nothing is no error.
    settings, replay = settings_of([str(tmp_path / "raw")], path, None, 10.0)
    assert sorted(settings.sources) == ["ais", "radar"]
    again = Keeper(settings, replay=replay)
    replay.begin(0.0)
    again.tick(START_S + 4820.0)
    # Own ship is where her radar is.
    lat, lon = again.picture.plane.to_geodetic([[again.situation.own_ship.x_m, again.situation.own_ship.y_m]])
    assert (float(lat[0]), float(lon[0])) == pytest.approx(SITE, abs=1e-6)
    assert again.picture.counts["radar"].taken == 21
    # The picture of files reads the folder, too, and states the digest of each of its files.
    picture = match_picture([tmp_path / "raw"], sensors=path, every=10.0)
    assert picture.facts("x")["files"] == [str(one) for one in sorted((tmp_path / "raw").iterdir())]
    assert len(picture.objects) > 0


@pytest.mark.parametrize("content, words", [
    (b'{"recording of sameas watch": 1, "sources": [', "first line of the recording is damaged"),
    (b'{"recording of sameas watch": 7, "sources": []}\n', "a later version of sameas; read it with that version"),
    (b'{"recording of sameas watch": 1, "sources": [{"name": "a", "kind": "ais"}], "format": null, "options": {}}\n{"',
     "no report in the recording: 1 × damaged lines of the recording"),
])  # fmt: skip
def test_a_damaged_recording_is_refused(tmp_path, content, words):
    (tmp_path / "a-20240501T000000Z.jsonl").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_sources([tmp_path])


def test_a_folder_without_recordings_is_refused(tmp_path):
    with pytest.raises(InputError, match="is a directory without recordings of sameas watch; give a file"):
        read_sources([tmp_path])


@pytest.mark.slow
def test_a_watch_that_is_killed_has_recorded_what_came_before_its_last_tick(tmp_path, sensors):
    path, port = sensors
    watching = subprocess.Popen(
        [sys.executable, "-m", "sameas", "watch", "--sensors", str(path), "--no-map", "-o", str(tmp_path / "state")],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path,
    )  # fmt: skip
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            k, end = 0, time.monotonic() + 120.0
            while not list((tmp_path / "raw").glob("*")) and time.monotonic() < end:
                # The radar's targets have stamps of their own, the AIS reports the time of receipt.
                sender.sendto(cable(k % 50, datetime.now(UTC)), ("127.0.0.1", port))
                k += 1
                time.sleep(0.1)
            sent = [b"".join((cable(0, datetime.now(UTC)), f"$GPTXT,{n}\r\n".encode())) for n in range(20)]
            for data in sent:
                sender.sendto(data, ("127.0.0.1", port))
            marks = [f"$GPTXT,{n}\\r\\n" for n in range(20)]

            def text():
                return "".join(one.read_text() for one in (tmp_path / "raw").glob("ais+radar-*"))

            while not all(mark in text() for mark in marks) and time.monotonic() < end:
                time.sleep(0.1)
            watching.send_signal(signal.SIGKILL)
            watching.wait(20.0)
    finally:
        watching.kill()
        watching.wait(20.0)
        watching.stdout.close()
    assert all(mark in text() for mark in marks)
    # A kill in the middle of a line: the lines before are read.
    [file] = (tmp_path / "raw").glob("ais+radar-*")
    whole = len(read_reports(file)[1])
    os.truncate(file, file.stat().st_size - 20)
    assert whole - 1 <= len(read_reports(file)[1]) < whole
    done = subprocess.run(
        [sys.executable, "-m", "sameas", "watch", "--sensors", str(path), "raw", "--pace", "50", "--no-map"],
        capture_output=True, text=True, cwd=tmp_path, timeout=120.0, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and "ais: " in done.stdout and "radar: " in done.stdout, done.stdout + done.stderr


def ticked(keeper, now, pieces, until_s):
    """The alarms that began and the late reports, tick by tick, while pieces are received."""
    found, pieces = [], list(pieces)
    while now[0] < until_s:
        now[0] += 1.0
        while pieces and pieces[0][0] <= now[0]:
            when, url, data = pieces.pop(0)
            keeper.wires[url].play((when, data, 1, True))
        situation = keeper.tick()
        counts = keeper.picture.counts
        found.append((now[0], sorted(alarm.text for alarm in situation.alarms), {n: c.late for n, c in counts.items()},
                      sorted(situation.members.items())))  # fmt: skip
    keeper.close()
    return found


@pytest.mark.slow
def test_a_recording_is_replayed_as_it_was_received(tmp_path):
    """A report 25 s late, a clock that jumps by 45 s, a source that falls silent, a flood: all of it once more."""
    path, begin_s = tmp_path / "sensors.toml", START_S + 4800.0
    path.write_text(
        '[watch]\nregister_every_s = 0\nfaults_every_s = 0\nsilent_s = 20\nrecord = "raw"\nlag_s = 5\n'
        f"plane = {{ lat_deg = {SITE[0]}, lon_deg = {SITE[1]} }}\n"
        '[sources.north]\nkind = "ais"\ninput = { url = "tcp://127.0.0.1:10110", format = "table" }\n'
        '[sources.south]\nkind = "ais"\ninput = { url = "tcp://127.0.0.1:10111", format = "table" }\n'
    )
    north, south = "tcp://127.0.0.1:10110", "tcp://127.0.0.1:10111"

    def line(t, mmsi, lat=0.0):
        columns = {
            "time": begin_s + t,
            "lat": SITE[0] + 0.01 + lat,
            "lon": SITE[1],
            "mmsi": mmsi,
            "sog_kn": 0,
            "cog_deg": 0,
        }
        return json.dumps(columns).encode() + b"\n"

    pieces = [(begin_s + t, north, line(t + 45.0 * (t > 30), "235000001")) for t in range(0, 60, 2)]
    pieces += [(begin_s + t + 0.3, south, line(t, "235000002", 0.01)) for t in range(0, 20, 2)]
    # Of a ship of its own, which only this report shows late; and then nothing.
    pieces.append((begin_s + 20.3, south, line(-4.7, "235000002", 0.01)))
    pieces.sort(key=lambda one: one[0])
    now = [begin_s - 1.0]
    keeper = Keeper(read_settings(path), clock=lambda: now[0])
    keeper.wires[south].queue.max_bytes = 4000
    flood = [(begin_s + 10.6, south, line(10.0, "235000003", 0.02))] * 100
    live = ticked(keeper, now, sorted(pieces + flood, key=lambda one: one[0]), begin_s + 58.0)
    words = " ".join(text for _, texts, *_ in live for text in texts)
    assert "time stamps are 45 s ahead" in words and "south has sent no report" in words and "the oldest data" in words
    assert live[-1][2]["south"] == 1

    settings, playback = recorded_inputs([str(tmp_path / "raw")], path, 8.0)
    real = [1000.0]
    again = Keeper(settings, playback=playback, clock=lambda: real[0])
    playback.begin(1000.0, begin_s - 1.0 + 1e-9)
    found = []
    while len(found) < len(live):
        # Eight times as fast.
        real[0] += 1.0 / 8.0
        situation = again.tick()
        counts = again.picture.counts
        found.append((round(again.clock(), 6), sorted(alarm.text for alarm in situation.alarms),
                      {n: c.late for n, c in counts.items()}, sorted(situation.members.items())))  # fmt: skip
    again.close()
    assert (
        found == live
        and playback.done
        and not [
            one for one in (tmp_path / "raw").iterdir() if b"235000003" not in one.read_bytes() and "south" in one.name
        ]
    )
    # By the times of reports nothing is late, and the flood is told.
    [_, source] = read_sources([tmp_path / "raw"])
    assert sum(source.reports.passed_over.values()) > 0
    assert "pieces that a flood dropped" in source.reports.passed_over


@pytest.mark.slow
@pytest.mark.long
def test_a_replay_as_received_waits_for_the_picture_and_ends_with_the_recording(tmp_path, sensors):
    path, _ = sensors
    names = [RecordedSource("ais", "ais"), RecordedSource("radar", "marine radar")]
    pieces = [(START_S + 4800.0 + k, cable(k), 1, True) for k in range(40)]
    folder = recorded(tmp_path, pieces, names)
    before = sorted(one.read_bytes() for one in folder.iterdir())
    out = subprocess.run(
        [sys.executable, "-m", "sameas", "watch", "--sensors", str(path), str(folder), "--as-received", "--pace", "40",
         "--no-map"], capture_output=True, text=True, timeout=300.0,
    )  # fmt: skip
    assert out.returncode == 0, out.stderr
    # Ticks of 0.2 s of the recording.
    assert any(f"Watched: {n} instants, 2 objects" in out.stdout for n in range(195, 203)), out.stdout
    assert "radar: 40 reports" in out.stdout and "ais: 40 reports" in out.stdout
    # Nothing listens, and it is not recorded again.
    assert "replayed" in out.stdout and "listening" not in out.stdout
    assert sorted(one.read_bytes() for one in folder.iterdir()) == before


@pytest.mark.parametrize(("files", "given", "words"), [
    (["raw"], False, "which inputs are recorded"), ([], True, "which inputs are recorded"),
    (["sensors.toml"], True, "is no recording of sameas watch"), (["raw"], True, "has no input for tower"),
])  # fmt: skip
def test_what_cannot_be_replayed_as_received_is_refused(files, given, words, tmp_path, sensors):
    recorded(tmp_path, [(START_S, cable(0), 1, True)], [RecordedSource("tower", "tracks")])
    with pytest.raises(InputError, match=words):
        recorded_inputs([str(tmp_path / file) for file in files], sensors[0] if given else None, 1.0)
