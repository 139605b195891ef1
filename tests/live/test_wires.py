"""From sockets to the picture: sensors over real sockets, one that stops and floods, and the command."""

import asyncio
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request

import numpy as np
import pytest
from tests.live.conftest import SITE, harbour
from tests.live.test_inputs import free_port, until

from sameas.live.keeper import Keeper
from sameas.live.settings import read_settings

TOML = """
[watch]
every_s = 0.2
register_every_s = 0
silent_s = 1.5
own_ship = {{ lat_deg = 50.55, lon_deg = -0.95 }}

[sources.ais]
kind = "ais"
input = {{ url = "udp://127.0.0.1:{udp}", format = "table" }}

[sources.radar]
kind = "marine radar"
site = {{ lat_deg = 50.55, lon_deg = -0.95 }}
errors = {{ range_m = 20, range_share = 0, bearing_deg = 0.5, extent_m = 5 }}
input = {{ url = "tcp://127.0.0.1:{tcp}", format = "table" }}
"""


def lines(reports, when):
    """JSON lines of harbour reports, stamped with ``when``."""
    columns = {name: column.tolist() for name, column in reports.columns().items() if name not in ("line", "time_s")}
    for k in range(len(reports)):
        row = {
            name.removesuffix("_m").removesuffix("_deg").replace("_m_per_s", ""): cells[k]
            for name, cells in columns.items()
        }
        yield json.dumps(row | {"time": when}).encode() + b"\n"


def at(reports, k):
    """The reports of the k-th time step."""
    times = np.unique(reports.time_s)
    return reports.where(reports.time_s == times[k])


@pytest.mark.slow
def test_sensors_over_sockets_make_one_picture_and_a_dead_one_raises_an_alarm(tmp_path):
    made, ports = harbour(until_s=60.0), {"udp": free_port(socket.SOCK_DGRAM), "tcp": free_port()}
    path = tmp_path / "sensors.toml"
    path.write_text(TOML.format(**ports))

    async def run():
        keeper, over, writers = Keeper(read_settings(path), tmp_path / "state"), asyncio.Event(), []

        async def served(reader, writer):
            writers.append(writer)

        server = await asyncio.start_server(served, "127.0.0.1", ports["tcp"])
        task = asyncio.create_task(keeper.run(until=over.is_set))
        out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        await until(lambda: writers and all(wire.state.connected for wire in keeper.wires.values()))
        for k in range(3000):  # kernels may have to be compiled first, which takes minutes on a busy machine
            if k >= 20 and keeper.situation is not None and len(keeper.situation.members) >= 5:
                break
            now = time.time()
            for line in lines(at(made["ais"], min(k // 3, 9)), now):
                out.sendto(line, ("127.0.0.1", ports["udp"]))
            writers[-1].write(b"no line of any format\n" + b"".join(lines(at(made["radar"], min(k, 19)), now)))
            await asyncio.sleep(0.1)
        assert keeper.situation is not None and len(keeper.situation.members) >= 5
        situation, health = keeper.situation, keeper.health()
        writers[-1].close()
        server.close()
        await until(lambda: any(alarm.key == "silent radar" for alarm in keeper.situation.alarms), 10.0)
        out.sendto(b"x" * 60000, ("127.0.0.1", ports["udp"]))
        await asyncio.sleep(0.5)
        ticking = keeper.health()["ok"]
        over.set()
        await task
        out.close()
        return situation, health, ticking, keeper

    situation, health, ticking, keeper = asyncio.run(run())
    assert {source for its in situation.members.values() for source, _ in its} == {"ais", "radar"}
    assert health["sources"]["ais"]["reports"] >= 50 and abs(health["sources"]["ais"]["delay_s"]) < 5.0
    assert health["wires"][f"tcp://127.0.0.1:{keeper_port(keeper)}"]["damaged"] >= 10
    assert ticking and keeper.failed_ticks == 0


def keeper_port(keeper):
    return next(url for url in keeper.wires if url.startswith("tcp")).rpartition(":")[2]


@pytest.mark.slow
def test_the_command_serves_a_replay_and_ends_on_a_signal(tmp_path):
    for name, reports in harbour().items():
        times = np.unique(reports.time_s)[:30]
        rows = [json.loads(line) for k, t in enumerate(times) for line in lines(at(reports, k), float(t))]
        (tmp_path / f"{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (tmp_path / "sensors.toml").write_text(
        f'[sources.radar]\nkind = "marine radar"\nsite = {{ lat_deg = {SITE[0]}, lon_deg = {SITE[1]} }}\n'
        '[sources.ais]\nkind = "ais"\n'
    )
    command = [sys.executable, "-m", "sameas", "watch", "ais.jsonl", "radar.jsonl", "--sensors", "sensors.toml",
               "--port", "0", "--pace", "5", "--every", "0.5s", "--for", "60s", "-o", "state"]  # fmt: skip
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        address = re.search(r"http://\S+", run.stdout.readline())[0]
        end, health = time.monotonic() + 30.0, {}
        while not health.get("ok") or health["objects"] < 5:
            assert time.monotonic() < end and run.poll() is None, run.stderr.read()
            time.sleep(0.2)
            try:
                with urllib.request.urlopen(f"{address}health", timeout=5.0) as answer:
                    health = json.loads(answer.read())
            except OSError:
                continue
        run.send_signal(signal.SIGTERM)
        out, err = run.communicate(timeout=60.0)
    assert run.returncode == 0 and "Watched:" in out and "radar: " in out and "Traceback" not in err
    assert (tmp_path / "state" / "state.pickle").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_watch_whose_stdin_is_silent_ends_on_a_signal(name, tmp_path):
    if not hasattr(signal, name):
        pytest.skip("this system has no such signal")
    (tmp_path / "sensors.toml").write_text('[sources.a]\nkind = "ais"\ninput = "stdin:"\n')
    command = [sys.executable, "-m", "sameas", "watch", "--sensors", "sensors.toml", "--no-map"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as run:
        assert run.stdout.readline() == b"  stdin: connected\n"
        run.send_signal(getattr(signal, name))
        try:
            run.wait(20.0)
        finally:
            run.kill()
        assert b"a: 0 reports" in run.stdout.read() and run.returncode == 0


def health_of(address):
    try:
        with urllib.request.urlopen(f"{address}/health", timeout=5.0) as answer:
            return json.loads(answer.read())
    except OSError:
        return {}


def objects_of(address):
    """The number of each object with an MMSI."""
    with urllib.request.urlopen(f"{address}/objects", timeout=5.0) as answer:
        return {one["mmsi"]: one["object"] for one in json.loads(answer.read())["objects"] if one.get("mmsi")}


@pytest.mark.slow
def test_a_watch_in_standby_takes_over_with_the_same_numbers_when_the_first_is_killed(tmp_path):
    ports = {"udp": free_port(socket.SOCK_DGRAM), "tcp": free_port()}
    (tmp_path / "sensors.toml").write_text(
        TOML.format(**ports).replace("every_s = 0.2", "every_s = 0.5\nsave_every_s = 1")
    )
    address, made = f"http://127.0.0.1:{free_port()}", harbour(until_s=300.0)
    command = [sys.executable, "-m", "sameas", "watch", "--sensors", "sensors.toml", "-o", "state", "--port",
               address.rpartition(":")[2]]  # fmt: skip
    over, out = threading.Event(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send():
        k = 0
        while not over.wait(0.5):
            for line in lines(at(made["ais"], k % 100), time.time()):
                out.sendto(line, ("127.0.0.1", ports["udp"]))
            k += 1

    def until_true(true):
        end = time.monotonic() + 60.0
        while not (value := true()):
            assert time.monotonic() < end
            time.sleep(0.2)
        return value

    sender = threading.Thread(target=send)
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as first:
        sender.start()
        until_true(lambda: health_of(address).get("objects", 0) >= 5)
        with subprocess.Popen([*command, "--standby"], cwd=tmp_path, stdout=subprocess.PIPE, text=True) as second:
            try:
                assert second.stdout.readline().startswith("Standby: state: another run writes there; this watch takes")
                time.sleep(2.0)
                before = objects_of(address)
                first.kill()
                assert second.stdout.readline().startswith("Taken over at ")
                resumed = second.stdout.readline()
                until_true(lambda: health_of(address).get("objects", 0) >= 5)
                after = objects_of(address)
            finally:
                over.set()
                sender.join()
                first.kill()
                second.send_signal(signal.SIGTERM)
                second.communicate(timeout=60.0)
    out.close()
    assert len(before) >= 4 and before == after
    assert resumed.startswith("Resumed: state of ") and second.returncode == 0


@pytest.mark.parametrize("given", [["--sensors", "sensors.toml"], ["ais.csv", "-o", "state"]])
def test_a_standby_needs_a_folder_and_inputs(given, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sensors.toml").write_text(TOML.format(udp=60004, tcp=60005))
    (tmp_path / "ais.csv").write_text("time,x,y,mmsi\n1714560000,0,0,1\n1714560001,1,0,1\n")
    done = subprocess.run(
        [sys.executable, "-m", "sameas", "watch", *given, "--standby"], capture_output=True, text=True
    )
    assert done.returncode == 1 and "takes over from a watch of inputs; give its folder with -o" in done.stderr
