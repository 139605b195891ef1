"""Inputs: real sockets on the loopback; broken connections are restored, a flood drops the oldest data."""

import asyncio
import contextlib
import errno
import importlib.util
import json
import os
import socket
import sys

import pytest

import sameas
from sameas.errors import InputError
from sameas.io.sensors.recording import RecordedInput, Recording
from sameas.io.sensors.stream import ReportStream
from sameas.live import inputs
from sameas.live.inputs import BoundedQueue, Wire
from sameas.live.reception import is_time_zone
from sameas.live.replay import Playback, Replay, WatchClock
from sameas.tracks.reports import Reports

LINE = json.dumps({"time": 1714560000, "lat": 50.1, "lon": -1.2, "mmsi": "235070762"}).encode() + b"\n"


def free_port(kind=socket.SOCK_STREAM):
    with socket.socket(socket.AF_INET, kind) as made:
        made.bind(("127.0.0.1", 0))
        return made.getsockname()[1]


async def until(true, seconds=60.0):
    for _ in range(int(seconds / 0.01)):
        if true():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it did not come to that")


@pytest.mark.parametrize("group", ["127.0.0.1", "239.192.77.1"])
def test_unicast_and_multicast_datagrams_are_received(group):
    async def run():
        port = free_port(socket.SOCK_DGRAM)
        wire = Wire(f"udp://{group}:{port}?interface=127.0.0.1", ReportStream("coast", "table"))
        task = asyncio.create_task(wire.run())
        await until(lambda: wire.state.connected or wire.state.error)
        assert not wire.state.error
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            # Without a line end: the end of the datagram ends the line.
            out.sendto(LINE.strip(), (group, port))
        await until(lambda: len(wire.queue))
        [reports] = wire.take()
        task.cancel()
        return reports

    assert asyncio.run(run()).mmsi.tolist() == ["235070762"]


@pytest.mark.slow
def test_a_broken_connection_is_restored():
    async def run():
        port, served = free_port(), []

        async def serve(reader, writer):
            served.append(1)
            writer.write(LINE if len(served) == 1 else LINE.replace(b"235070762", b"235070763"))
            await writer.drain()
            writer.close()

        wire = Wire(f"tcp://127.0.0.1:{port}", ReportStream("coast", "table"))
        task = asyncio.create_task(wire.run())
        await until(lambda: wire.state.error)  # nobody listens yet
        async with await asyncio.start_server(serve, "127.0.0.1", port):
            await until(lambda: len(served) > 1 and len(wire.queue) > 1)
        task.cancel()
        return wire

    wire = asyncio.run(run())
    [reports] = wire.take()
    assert reports.mmsi.tolist()[:2] == ["235070762", "235070763"] and wire.state.connections >= 2


def test_incoming_connections_are_read():
    async def run():
        port = free_port()
        wire = Wire(f"tcp-listen://127.0.0.1:{port}", ReportStream("coast", "table"))
        task = asyncio.create_task(wire.run())
        await until(lambda: wire.state.connected)
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(LINE)
        await writer.drain()
        await until(lambda: len(wire.queue))
        writer.close()
        await writer.wait_closed()
        await asyncio.sleep(0.05)
        task.cancel()
        return wire

    assert len(asyncio.run(run()).take()[0]) == 1


def test_a_flood_drops_and_counts_the_oldest_data():
    queue = BoundedQueue(100)
    for k in range(50):
        queue.put(bytes([k]) * 10, float(k))
    assert queue.dropped == 40 and [piece[0] for piece in queue.take(1000)] == list(range(40, 50)) and not len(queue)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("carrier-pigeon://loft", "not a known kind of input; give one of udp"), ("udp://10.0.0.1", "has no port"),
        ("127.0.0.1:10110", "give udp://127.0.0.1:10110, or tcp://127.0.0.1:10110"),
        ("ws:///signalk", "has no host; give ws://HOST:PORT/signalk/v1/stream"),
        ("ws://me:secret@boat:3000", r"input ws://boat:3000: has a password, .* give username = .* next to url"),
        ("udp://239.1.1.1:8600?interface=eth0", "interface is 'eth0'; give its address"),
        ("serial:/dev/ttyUSB0?baud=4800bd", "baud is '4800bd'; give a number such as 4800 or 38400"),
        ("serial:/dev/ttyUSB0?baud=0", "baud is '0'"),
    ],
)  # fmt: skip
def test_an_invalid_input_address_is_refused(url, words):
    with pytest.raises(InputError, match=words):
        Wire(url, ReportStream("x"))


def test_a_serial_line_without_its_library_is_refused_at_once(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "serial" else find(name))
    with pytest.raises(InputError, match="pip install pyserial"):
        Wire("serial:/dev/ttyUSB0", ReportStream("x"))


def test_a_pipe_that_ends_says_what_to_do(monkeypatch):
    end, begin = os.pipe()
    os.write(begin, b"$HEHDT,1.0,T\r\n")
    os.close(begin)
    wire = Wire("stdin:", ReportStream("boat"))
    with os.fdopen(end) as pipe:
        monkeypatch.setattr(sys, "stdin", pipe)
        asyncio.run(wire.run())
    assert wire.state.error == "the program that wrote to it has ended; start both again" and len(wire.queue)


def test_a_serial_line_that_may_not_be_opened_names_the_group(monkeypatch):
    serial = pytest.importorskip("serial")

    def refused(*_):
        raise serial.SerialException(errno.EACCES, "could not open port")

    async def run():
        wire = Wire("serial:/dev/ttyUSB0", ReportStream("boat"))
        monkeypatch.setattr(serial, "Serial", lambda *_, **__: refused())
        task = asyncio.create_task(wire.run())
        await until(lambda: wire.state.error)
        task.cancel()
        return wire.state.error

    assert asyncio.run(run()) == "Permission denied; become a member of the group that owns it, often dialout"


def test_a_datagram_address_of_another_machine_is_named():
    async def run():
        wire = Wire("udp://192.0.2.7:5000", ReportStream("x"))
        task = asyncio.create_task(wire.run())
        await until(lambda: wire.state.error)
        task.cancel()
        return wire.state.error

    assert asyncio.run(run()) == ("192.0.2.7 is no address of this machine; give udp://0.0.0.0:5000 for any sender")


@pytest.mark.slow
def test_a_signal_k_server_is_asked_for_its_deltas_and_a_refusal_is_named():
    """The server of Signal K greets, and sends nothing until a client subscribes."""

    async def run():
        port, asked = free_port(), []

        async def serve(reader, writer):
            writer.write(b'{"name":"signalk-server","version":"2.1","self":"vessels.urn:x","roles":["main"]}\r\n')
            asked.append(json.loads(await reader.readline()))
            writer.close()

        wire = Wire(f"tcp://127.0.0.1:{port}", ReportStream("boat"))
        task = asyncio.create_task(wire.run())
        await until(lambda: str(wire.state))
        refused = str(wire.state)
        async with await asyncio.start_server(serve, "127.0.0.1", port):
            await until(lambda: asked)
        task.cancel()
        return refused, asked[0]

    refused, asked = asyncio.run(run())
    assert refused == "Connection refused"
    assert asked["context"] == "*" and asked["subscribe"][0]["path"] == "*"


@pytest.mark.slow
def test_a_server_of_aprs_is_asked_for_its_filter_kept_awake_and_connected_again():
    """A server of the Open Glider Network: it greets, wants a login, sends comments, and ends silent connections."""
    now = 1_716_364_000.0  # 07:46:40 UTC
    glider = (
        "FLRDDE626>OGFLR,qAS,EGHL:/0746{:02d}h5111.32N/00102.04W'086/007/A=000607 !W83! id06DDE626 -019fpm gps2x3\r\n"
    )

    async def run():
        port, told, connections = free_port(), [], []

        async def serve(reader, writer):
            connections.append(writer)
            writer.write(b"# aprsc 2.1.19-g730c5c0\r\n")
            told.append((await reader.readline()).decode())
            writer.write(b"# logresp N0CALL unverified, server GLIDERN4\r\n" + glider.format(37 + len(told)).encode())
            for _ in range(3):
                await asyncio.sleep(0.1)
                writer.write(b"# aprsc 2.1.19-g730c5c0 22 May 2024 07:46:40 GMT GLIDERN4 10.0.0.1:14580\r\n")
            told.append((await reader.readline()).decode())
            writer.close()

        async with await asyncio.start_server(serve, "127.0.0.1", port):
            url = f"tcp://127.0.0.1:{port}?filter=r/51.18/-1.03/100+t/o"
            wire = Wire(url, ReportStream("gliders"), clock=lambda: now, told_s=0.05)
            task = asyncio.create_task(wire.run())
            await until(lambda: len(told) == 4)
            task.cancel()
        return told, wire

    told, wire = asyncio.run(run())
    asked = f"user N0CALL pass -1 vers sameas {sameas.__version__} filter r/51.18/-1.03/100 t/o\r\n"
    assert told == [asked, "#keepalive\r\n"] * 2 and wire.stream.format in (None, "ogn")
    [reports] = wire.take()
    assert reports.track_id.tolist() == ["dde626"] * 2 and reports.time_s.tolist() == [now - 2.0, now]
    assert not +wire.stream.damaged and not +wire.stream.passed_over


def test_a_unicast_port_that_another_program_receives_is_an_error():
    async def run():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            other.bind(("127.0.0.1", 0))
            wire = Wire(f"udp://127.0.0.1:{other.getsockname()[1]}", ReportStream("coast"))
            task = asyncio.create_task(wire.run())
            await until(lambda: str(wire.state))
            task.cancel()
            return str(wire.state)

    assert asyncio.run(run()) == "Address already in use"


def test_a_file_is_polled(tmp_path):
    path = tmp_path / "aircraft.json"
    content = {"now": 1714560000.0, "aircraft": [{"hex": "400a00", "lat": 50.0, "lon": -1.0}]}
    path.write_text(json.dumps(content, indent=1))

    async def run():
        wire = Wire(path.as_uri(), ReportStream("pi"))
        task = asyncio.create_task(wire.run())
        await until(lambda: len(wire.queue))
        task.cancel()
        return wire.take()

    [reports] = asyncio.run(run())
    assert reports.icao.tolist() == ["400a00"]


def test_a_cancellation_that_comes_together_with_data_ends_the_wire(monkeypatch):
    """``asyncio.wait_for`` of Python 3.11 swallowed it: a watch went on until the busy connection ended."""

    async def run():
        port, over, closed = free_port(), asyncio.Event(), asyncio.Event()

        async def serve(reader, writer):
            with contextlib.suppress(OSError):
                while not over.is_set():
                    writer.write(LINE)
                    await writer.drain()
                    await asyncio.sleep(0.01)
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
            closed.set()

        wire = Wire(f"tcp://127.0.0.1:{port}", ReportStream("coast", "table"))
        async with await asyncio.start_server(serve, "127.0.0.1", port):
            task = asyncio.create_task(wire.run())
            await until(lambda: len(wire.queue))
            feed = asyncio.StreamReader.feed_data

            def fed(reader, data):
                feed(reader, data)
                asyncio.get_running_loop().call_soon(task.cancel)

            monkeypatch.setattr(asyncio.StreamReader, "feed_data", fed)
            await asyncio.wait({task}, timeout=5.0)
            done = task.done()
            over.set()
            await closed.wait()
            task.cancel()
            return done

    assert asyncio.run(run())


def test_a_port_that_is_bound_is_listening_and_not_connected():
    async def run():
        wire = Wire(f"tcp-listen://127.0.0.1:{free_port()}", ReportStream("coast", "table"))
        task = asyncio.create_task(wire.run())
        await until(lambda: wire.state.connected)
        words = str(wire.state)
        task.cancel()
        await asyncio.wait({task})
        return words

    assert asyncio.run(run()) == "listening"


def test_a_line_cut_off_by_a_broken_connection_is_not_continued_by_the_next():
    async def run():
        port, served = free_port(), []

        async def serve(reader, writer):
            served.append(1)
            writer.write(LINE[:30] if len(served) == 1 else LINE)
            await writer.drain()
            writer.close()

        async with await asyncio.start_server(serve, "127.0.0.1", port):
            wire = Wire(f"tcp://127.0.0.1:{port}", ReportStream("coast", "table"))
            task = asyncio.create_task(wire.run())
            await until(lambda: len(served) > 1 and len(wire.queue) > 2)
            task.cancel()
        return wire

    assert asyncio.run(run()).take()[0].mmsi.tolist()[:1] == ["235070762"]


def moments(name, times):
    return name, Reports.of(name, "table", {"time_s": times, "x_m": [0.0] * len(times), "y_m": [0.0] * len(times)})


def test_a_source_in_another_time_zone_is_named_before_a_replay():
    replay = Replay([moments("radar", [0.0, 600.0]), moments("ais", [10.0, 500.0]), moments("net", [7205.0, 7700.0])])
    [doubt] = replay.apart()
    assert doubt.startswith("net: its reports are 1.8 h after all others; its first is 2.0 h after theirs")
    assert not Replay([moments("radar", [0.0, 600.0]), moments("ais", [10.0, 500.0])]).apart()


def test_a_replay_that_waits_loses_no_time_of_the_reports():
    replay = Replay([moments("radar", [0.0, 600.0])], 10.0)
    replay.begin(100.0)
    replay.wait(30.0)
    assert replay.now_s(131.0) == 10.0


def test_the_ticks_of_a_recording_are_as_far_apart_as_they_were_however_long_they_take():
    now = [50.0]
    pieces = [(100.0 + k, b"a", 1, False) for k in range(60)]
    played = Playback([("tcp://ais:1", Recording(RecordedInput(()), pieces, [0] * 61))], 100.0)
    clock, due_s, during = WatchClock(lambda: now[0], playback=played), 100.0, []
    clock.begin(None)
    for late_s, lasts_s in ((0.0, 0.4), (0.06, 0.002), (0.2, 0.0)):
        due_s = clock.begin_tick(due_s)
        # The thread of the tick begins later than it should.
        now[0] += late_s
        during.append(clock())
        now[0] += lasts_s
        during.append(clock())
        due_s += 1.0
        now[0] += clock.end_tick(due_s)
    assert during == [100.0, 100.0, 101.0, 101.0, 102.0, 102.0]


def test_a_delay_of_whole_hours_is_a_time_zone():
    assert all(is_time_zone(s) for s in (7205.0, -3598.0, 19800.0))
    assert not any(is_time_zone(s) for s in (700.0, 0.0, 4000.0, 86400.0))


def test_a_replay_ends_with_its_last_report():
    replay = Replay([("a", Reports.of("a", "table", {"time_s": [5.0, 7.0], "x_m": [0, 1], "y_m": [0, 0]}))], 100.0)
    replay.begin(0.0)
    assert (replay.now_s(0.01), replay.now_s(1.0)) == (6.0, 7.0)


def test_a_serial_cable_is_pulled_and_put_back(tmp_path):
    """A pair of pseudo-terminals stands for the line; its end is removed, and another takes its name."""
    pytest.importorskip("serial")
    pty, tty = pytest.importorskip("pty"), pytest.importorskip("tty")
    link = tmp_path / "ttyUSB0"

    def plugged():
        line, end = pty.openpty()
        tty.setraw(end)
        link.symlink_to(os.ttyname(end))
        return line, end

    async def run():
        wire = Wire(f"serial:{link}?baud=4800", ReportStream("boat"))
        task = asyncio.create_task(wire.run())
        await until(lambda: wire.state.error)
        words, heard = [wire.state.error], []
        for n in range(2):
            line, end = plugged()
            await until(lambda: wire.state.connected)
            os.write(line, f"$HEHDT,{n}.0,T\r\n".encode())
            await until(lambda: len(wire.queue))
            heard.append(b"".join(data for _, data, _, _ in wire.queue.take(1 << 20)))
            link.unlink()
            os.close(end)
            os.close(line)
            await until(lambda: not wire.state.connected)
            words.append(wire.state.error)
            wire.queue.take(1 << 20)
        task.cancel()
        return words, heard

    words, heard = asyncio.run(run())
    assert words[0] == "No such file or directory" and words[1].startswith("the line was lost: ")
    assert heard == [b"$HEHDT,0.0,T\r\n", b"$HEHDT,1.0,T\r\n"]


@pytest.mark.parametrize("listens", [False, True])
def test_the_other_side_of_a_silent_connection_is_asked_whether_it_is_there(listens, monkeypatch):
    """A receiver that loses its power ends no connection; it was known after two minutes."""
    asked, keep_alive = [], inputs.keep_alive

    def asking(writer):
        keep_alive(writer)
        asked.append(writer.get_extra_info("socket").getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE))

    monkeypatch.setattr(inputs, "keep_alive", asking)

    async def run():
        port = free_port()
        wire = Wire(f"{'tcp-listen' if listens else 'tcp'}://127.0.0.1:{port}", ReportStream("coast"))

        async def serve(reader, writer):
            await reader.read()
            writer.close()

        server = None if listens else await asyncio.start_server(serve, "127.0.0.1", port)
        task = asyncio.create_task(wire.run())
        await until(lambda: wire.state.connected)
        if listens:
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            await until(lambda: asked)
            writer.close()
            await writer.wait_closed()
            await asyncio.sleep(0.05)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        if server is not None:
            server.close()

    asyncio.run(run())
    assert len(asked) == 1 and asked[0] != 0
