"""The HTTP server: event streams, tokens, and endpoints for other programs."""

import contextlib
import json
import pickle
import re
import signal
import socket
import ssl
import subprocess
import sys
import time
import urllib.error
import urllib.request
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.live.conftest import EVIL, START_S, descriptions, replay, served

from sameas.cli.watch import map_addresses, source_lines
from sameas.errors import InputError
from sameas.live.keeper import Keeper
from sameas.live.outputs import metrics
from sameas.live.server import Access, TlsCertificate, sse_event
from sameas.live.settings import LiveSource, Settings, WatchSettings
from sameas.live.situation import Delta
from sameas.picture.live import Registered
from sameas.registration import Parameter
from sameas.tracks import Reports, Timing
from sameas.tracks.registration import SourceBiases
from sameas.tracks.source import KnownBiases


def ask(url, method="GET", **headers):
    """Status, headers and body."""
    request = urllib.request.Request(url, method=method, headers={k.replace("_", "-"): v for k, v in headers.items()})
    opener = urllib.request.build_opener(NoRedirect)
    try:
        with opener.open(request, timeout=10.0) as answer:
            return answer.status, dict(answer.headers), answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read().decode()


class NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *anything):
        return None


def events(url, count, **headers):
    """The first ``count`` events of a stream: kind, id and content."""
    request, out = (
        urllib.request.Request(f"{url}/events", headers={k.replace("_", "-"): v for k, v in headers.items()}),
        [],
    )
    with urllib.request.urlopen(request, timeout=10.0) as stream:
        block = {}
        while len(out) < count:
            line = stream.readline().decode().rstrip("\n")
            if not line and block.get("data"):
                out.append((block["event"], block["id"], json.loads(block["data"])))
                block = {}
            name, _, value = line.partition(": ")
            block[name] = value
    return out


@pytest.mark.slow
def test_event_streams_begin_with_a_full_frame_and_resume_from_the_last_id(keeper):
    with served(keeper) as url:
        first, second, third = events(url, 3)
        (run, tick), (same_run, next_tick) = first[1].split("-"), second[1].split("-")
        assert (first[0], second[0]) == ("whole", "delta") and (run, int(tick) + 1) == (same_run, int(next_tick))
        assert len(first[2]["objects"]) >= 4 and first[2]["own"]["x"] == 0.0 and "cpa" in first[2]
        [again] = events(url, 1, Last_Event_ID=second[1])
        assert again[:2] == ("delta", third[1]) and again[2]["objects"] == third[2]["objects"]
        # Ids that are too old or of another run, whose ticks since its last state come again, cannot be resumed.
        for other in ("123456789", f"{run}-123456789", f"0123abcd-{next_tick}", next_tick):
            assert events(url, 1, Last_Event_ID=other)[0][0] == "whole"


def opened(url):
    """The answer of a server that may just be starting."""
    for _ in range(100):
        try:
            return urllib.request.urlopen(url, timeout=30.0)
        except urllib.error.URLError:
            time.sleep(0.05)
    raise TimeoutError(url)


@pytest.mark.slow
def test_an_open_event_stream_ends_with_the_watch(tmp_path):
    # An open page kept the process for a second more, and a traceback of sixty lines came last.
    rows = "".join(f"{10 * k},235000001,{50.0 + 1e-4 * k},-1.0\n" for k in range(20))
    (tmp_path / "ais.csv").write_text(f"time_s,mmsi,lat_deg,lon_deg\n{rows}")
    command = [sys.executable, "-m", "sameas", "watch", str(tmp_path / "ais.csv"), "--pace", "50", "--port", "0",
               "-o", str(tmp_path / "live")]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        url = next(line for line in process.stdout if line.startswith("Map: ")).split()[1]
        with opened(f"{url}events") as stream:
            assert stream.readline() and stream.read()
        _, errors = process.communicate(timeout=30.0)
    assert process.returncode == 0 and "Traceback" not in errors and "ERROR" not in errors


@pytest.mark.slow
def test_with_a_certificate_the_map_is_served_over_https(tmp_path, certificate):
    file, _ = certificate
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        sensor = f"udp://127.0.0.1:{free.getsockname()[1]}"
    (tmp_path / "sensors.toml").write_text(f'[sources.coast]\nkind = "ais"\ninput = "{sensor}"\n')
    command = [sys.executable, "-m", "sameas", "watch", "-s", "sensors.toml", "--host", "127.0.0.1", "--port", "0",
               "--token", "helm", "--certificate", str(file), "--key", str(file.with_name("key.pem"))]  # fmt: skip
    trusted = ssl.create_default_context(cafile=file)
    trusted.check_hostname = False
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = next(line for line in process.stdout if line.startswith("Map: ")).split()[1]
            page = urllib.request.Request(url, headers={"Cookie": "sameas_token=helm"})
            assert url.startswith("https://")
            answer, end = None, time.monotonic() + 60.0
            while answer is None and time.monotonic() < end:
                with contextlib.suppress(urllib.error.URLError):
                    answer = urllib.request.urlopen(page, timeout=10.0, context=trusted)
            assert answer is not None and answer.status == 200
            with pytest.raises(urllib.error.URLError, match="CERTIFICATE_VERIFY_FAILED"):
                urllib.request.urlopen(page, timeout=10.0)
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=30.0)


def test_certificates_that_cannot_be_used_are_refused(tmp_path, certificate):
    file, _ = certificate
    key = file.with_name("key.pem")
    assert TlsCertificate.of(file, key) == TlsCertificate(file, key)
    both, locked, other = tmp_path / "both.pem", tmp_path / "locked.pem", tmp_path / "other.pem"
    both.write_text(file.read_text() + key.read_text())
    assert TlsCertificate.of(both).key == both
    subprocess.run(["openssl", "pkey", "-in", key, "-aes128", "-passout", "pass:helm", "-out", locked], check=True)
    subprocess.run(
        ["openssl", "genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-out", other],
        check=True, capture_output=True,
    )  # fmt: skip
    with pytest.raises(InputError, match=r"locked\.pem: the private key has a password; give a key without one"):
        TlsCertificate.of(file, locked)
    for given in ((file, None), (file, other)):
        with pytest.raises(InputError, match=r"boat\.pem.*: no certificate with its private key, in PEM"):
            TlsCertificate.of(*given)
    for given in ((tmp_path / "none.pem", key), (file, tmp_path / "none.pem")):
        with pytest.raises(InputError, match=r"none\.pem: No such file or directory"):
            TlsCertificate.of(*given)


@pytest.mark.slow
def test_a_watch_records_draws_a_chart_and_lets_viewers_only_look(tmp_path):
    """The options of the command, which no other test gives to it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (tmp_path / "sensors.toml").write_text(
        f'[sources.coast]\nkind = "ais"\ninput = {{ url = "udp://127.0.0.1:{port}", format = "table" }}\n'
    )
    shore = [[-1.1, 50.0], [-1.0, 50.1], [-0.9, 50.0]]
    (tmp_path / "shore.geojson").write_text(json.dumps({"type": "LineString", "coordinates": shore}))
    command = [sys.executable, "-m", "sameas", "watch", "-s", "sensors.toml", "--record", "raw", "--chart",
               "shore.geojson", "--host", "127.0.0.1", "--port", "0", "--token", "helm", "--viewer-token", "guest",
               "--every", "0.2s"]  # fmt: skip
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = next(line for line in process.stdout if line.startswith("Map: ")).split()[1]
            url, _, token = url.partition("?token=")
            assert token == "helm" and opened(f"{url}alarms?token=guest")
            guest, helm = {"Authorization": "Bearer guest"}, {"Authorization": "Bearer helm", "X-Sameas": "1"}
            assert ask(f"{url}alarms")[0] == 401 and ask(f"{url}alarms", **guest)[0] == 200
            assert ask(f"{url}alarms/7/acknowledge", "POST", **guest)[0] == 403
            assert ask(f"{url}alarms/7/acknowledge", "POST", **helm)[0] == 404
            end = time.monotonic() + 60.0
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                while not list((tmp_path / "raw").glob("coast-*")) and time.monotonic() < end:
                    row = {"time": time.time(), "lat": 50.02, "lon": -1.0, "mmsi": "235000001"}
                    sender.sendto(json.dumps(row).encode() + b"\n", ("127.0.0.1", port))
                    time.sleep(0.2)
            page = ask(url, **guest)[2]
            assert re.search(r'"charts": ?\[\{"name": ?"shore"', page)
        finally:
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=60.0)
    assert process.returncode == 0 and "Traceback" not in errors
    [recorded] = (tmp_path / "raw").glob("coast-*")
    assert "235000001" in recorded.read_text()


@pytest.mark.slow
def test_the_page_begins_with_the_objects_and_their_records(keeper):
    """Before its first event it would else show no source and no probability of any object."""
    with served(keeper) as url:
        [whole] = events(url, 1)
        _, _, page = ask(url)
    rows = {name: int(n) for name, n in re.findall(r'"name": ?"([or])\.n"[^}]*"n": ?(\d+)', page)}
    assert len(whole[2]["objects"]) >= 4 and rows["o"] >= 4 and rows["r"] >= rows["o"]


@pytest.mark.slow
def test_objects_metrics_and_health_are_served(keeper):
    with served(keeper) as url:
        events(url, 8)
        status, headers, body = ask(f"{url}/objects.geojson")
        collection = json.loads(body)
        assert status == 200 and headers["content-type"] == "application/geo+json" and len(collection["features"]) == 5
        lon, lat = collection["features"][0]["geometry"]["coordinates"]
        assert abs(lon + 0.95) < 0.2 and abs(lat - 50.55) < 0.2
        assert {one["mmsi"] for one in json.loads(ask(f"{url}/objects")[2])["objects"]} == {
            f"23500{k}111" for k in range(5)
        }
        assert json.loads(ask(f"{url}/health")[2])["ok"] is True
        words = ask(f"{url}/metrics")[2]
        assert "sameas_up 1" in words and 'sameas_source_reports_total{source="radar"}' in words
        assert ask(f"{url}/alarms")[0] == 200 and ask(f"{url}/history")[0] == 200
        status, headers, body = ask(url)
        assert status == 200 and "connect-src 'self'" in body and "script-src 'sha256-" in body
        assert EVIL not in body and headers["x-frame-options"] == "DENY"


def test_an_operator_holds_the_biases_of_a_source(keeper):
    def found(value, established=True):
        biases = {"azimuth_deg": Parameter(value, 0.1, "deg")}
        theta = np.array([0.0, np.radians(value), 0.0, 0.0, 0.0, 0.0])
        return Registered((SourceBiases("radar", ("ais",), biases, established=established, theta=theta,
                                        covariance=1e-9 * np.eye(6)),))  # fmt: skip

    def alignment():
        return keeper.offsets.in_words()["radar"]

    with served(keeper, Access("0.0.0.0", "op", "view")) as url:
        keeper.picture.take_off(found(1.5))
        assert alignment()["offsets"] == ["azimuth +1.500 ± 0.100°"] and alignment()["state"] == "subtracted"
        path = f"{url}/sources/radar/hold"
        assert ask(path, "POST", Authorization="Bearer view", X_Sameas="1")[0] == 403
        assert ask(path, "POST", Authorization="Bearer op")[0] == 403 and not alignment()["held"]
        assert ask(path, "POST", Authorization="Bearer op", X_Sameas="1")[0] == 200 and alignment()["held"]
        assert ask(f"{url}/sources/none/hold", "POST", Authorization="Bearer op", X_Sameas="1")[0] == 404
        keeper.picture.take_off(found(4.0))
        assert alignment()["offsets"] == ["azimuth +1.500 ± 0.100°"]
        assert pickle.loads(pickle.dumps(keeper.picture)).held == {"radar"}
        assert ask(path, "DELETE", Authorization="Bearer op", X_Sameas="1")[0] == 200 and not alignment()["held"]
        keeper.picture.take_off(found(4.0))
        assert alignment()["offsets"] == ["azimuth +4.000 ± 0.100°"]


def told(url, content, **headers):
    """The status and the answer to an offset that is sent."""
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, body, named, method="POST"), timeout=10) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as error:
        return error.code, json.loads(error.read())


def test_an_operator_sets_an_offset_which_is_subtracted_until_it_is_released(keeper):
    def alignment():
        return keeper.offsets.in_words()["radar"]

    with served(keeper, Access("0.0.0.0", "op", "view")) as url:
        path, op = f"{url}/sources/radar/offset", {"Authorization": "Bearer op", "X_Sameas": "1"}
        nautical = {"bias": "range_m", "value": 0.1, "unit": "nm"}
        assert told(path, nautical, Authorization="Bearer view", X_Sameas="1")[0] == 403
        assert told(path, nautical, Authorization="Bearer op")[0] == 403 and not alignment()["held"]
        assert told(path, nautical, **op) == (200, {"set": {"range_m": pytest.approx(185.2)}})
        assert told(path, {"bias": "azimuth_deg", "value": -2}, **op)[0] == 200
        assert alignment()["held"] and alignment()["state"] == "subtracted"
        assert alignment()["offsets"] == ["range +185.2 m set by hand", "azimuth -2.000° set by hand"]
        np.testing.assert_allclose(keeper.picture.biases["radar"].theta, [185.2, -2.0, 0.0, 0.0, 0.0, 0.0])
        assert told(f"{url}/sources/none/offset", nautical, **op)[0] == 404
        # The estimate goes on, and counts again after the release.
        azimuth = {"azimuth_deg": Parameter(1.5, 0.1, "deg")}
        keeper.picture.take_off(Registered((SourceBiases(
            "radar", ("ais",), azimuth, theta=np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.0]), covariance=1e-9 * np.eye(6)
        ),)))  # fmt: skip
        assert alignment()["offsets"][1] == "azimuth -2.000° set by hand"
        assert alignment()["notes"] == ["estimated now, not used: azimuth +1.500 ± 0.100°"]
        assert ask(f"{url}/sources/radar/hold", "DELETE", Authorization="Bearer op", X_Sameas="1")[0] == 200
        assert alignment()["offsets"] == ["azimuth +1.500 ± 0.100°"] and not alignment()["held"]


@pytest.mark.parametrize(("content", "words"), [
    (b"azimuth 2", "the request is no JSON"),
    (b"[" * 900, "the request is no JSON"),
    (b" " * 2000, "the request is too long"),
    ([2.0], "there is no offset None"),
    ({"bias": "tilt", "value": 1}, "there is no offset 'tilt'"),
    ({"bias": "azimuth_deg", "value": "2"}, "azimuth_deg: the value is '2'"),
    ({"bias": "azimuth_deg", "value": True}, "azimuth_deg: the value is True"),
    (b'{"bias": "azimuth_deg", "value": NaN}', "azimuth_deg: the value is nan"),
    ({"bias": "azimuth_deg", "value": 200}, "radar: azimuth_deg is 200"),
    ({"bias": "azimuth_deg", "value": 2, "unit": "m"}, "azimuth_deg: the unit is 'm'"),
    ({"bias": "azimuth_deg", "value": 2, "unit": []}, "azimuth_deg: the unit is []"),
])  # fmt: skip
def test_an_offset_that_no_sensor_has_is_refused(keeper, content, words):
    with served(keeper) as url:
        status, answer = told(f"{url}/sources/radar/offset", content, X_Sameas="1")
    assert status == 400 and words in answer["error"] and not keeper.picture.held


def test_ais_has_no_azimuth_to_set(keeper):
    with served(keeper) as url:
        status, answer = told(f"{url}/sources/ais/offset", {"bias": "azimuth_deg", "value": 2}, X_Sameas="1")
        assert status == 400 and "give one of time_s, east_m, north_m" in answer["error"]
        assert told(f"{url}/sources/ais/offset", {"bias": "time_s", "value": 2}, X_Sameas="1")[0] == 200


def test_what_the_sensor_file_subtracts_is_shown():
    known = KnownBiases(azimuth_deg=2.0, range_m=-35.0)
    radar = replace(descriptions()[1], calibration=known, timing=Timing(latency_s=0.5))
    keeper = Keeper(Settings({"radar": LiveSource(radar)}, WatchSettings()), replay=replay())
    assert keeper.offsets.in_words()["radar"]["described"] == "range -35 m, azimuth +2°, stamps +0.5 s late"
    assert keeper.offsets.in_words()["radar"]["state"] == "none estimated"
    keeper.close()


def test_biases_are_served_and_printed(keeper):
    azimuth = {"azimuth_deg": Parameter(1.5, 0.1, "deg")}
    for established, words in ((False, "NOT ESTABLISHED"), (True, "subtracted")):
        found = SourceBiases("radar", ("ais",), azimuth, established=established, theta=np.zeros(6),
                             covariance=1e-9 * np.eye(6))  # fmt: skip
        keeper.picture.take_off(Registered((found,)))
        health = keeper.health()
        biases = health["sources"]["radar"]["biases"]
        assert biases["text"] == "azimuth +1.500 ± 0.100°" and biases["established"] == established
        assert health["sources"]["ais"]["biases"] is None
        assert source_lines("radar", health["sources"]["radar"])[1] == f"    azimuth +1.500 ± 0.100°, {words}"
        served_words = metrics(health, [])
        assert 'sameas_source_bias{source="radar",bias="azimuth_deg"} 1.5' in served_words
        assert f'sameas_source_biases_established{{source="radar"}} {int(established)}' in served_words


@pytest.mark.slow
def test_requests_with_another_host_name_are_refused(keeper):
    with served(keeper) as url:
        assert ask(f"{url}/objects", Host="evil.example:80")[0] == 421
        assert ask(f"{url}/alarms/1/acknowledge", "POST")[0] == 403
        assert ask(f"{url}/alarms/999/acknowledge", "POST", X_Sameas="1")[0] == 404


@pytest.mark.slow
def test_beyond_the_loopback_tokens_give_roles(keeper):
    with served(keeper, Access("0.0.0.0", "op-secret", "view-secret")) as url:
        assert ask(f"{url}/objects")[0] == 401 and ask(f"{url}/objects?token=wrong")[0] == 401
        assert ask(f"{url}/objects", Authorization="Bearer view-secret")[0] == 200
        status, headers, _ = ask(f"{url}/?token=view-secret")
        assert status == 303 and headers["location"] == "/" and "HttpOnly" in headers["set-cookie"]
        cookie = headers["set-cookie"].partition(";")[0]
        assert ask(url, Cookie=cookie)[0] == 200 and '"operator":false' in ask(url, Cookie=cookie)[2]
        assert ask(f"{url}/alarms/1/acknowledge", "POST", X_Sameas="1", Cookie=cookie)[0] == 403
        operator = {"Authorization": "Bearer op-secret", "X_Sameas": "1"}
        assert ask(f"{url}/alarms/1/acknowledge", "POST", **operator)[0] == 404
        assert json.loads(ask(f"{url}/health")[2]) == {"ok": True}
    assert Access.of("0.0.0.0").operator and Access.of("127.0.0.1").operator is None


@pytest.mark.parametrize(("token", "role"), [("a", "operator"), ("b", "viewer"), ("c", None), (None, None)])
def test_a_token_has_its_role(token, role):
    assert Access("0.0.0.0", "a", "b").role(token) == role


def test_no_name_breaks_an_event_stream(keeper):
    situation = keeper.tick(START_S + 2.0)
    delta = Delta(
        situation.tick, situation.time_s, objects=[(1, 'a\n\nevent: whole\r\ndata: {}\u2028</script>\x1b[31m"')]
    )
    event = sse_event("delta", keeper, situation, delta)
    head, data, end, rest = event.split("\n", 1)[1].split("\n")
    assert head == "event: delta" and end == rest == "" and event.isascii()
    assert json.loads(data.removeprefix("data: "))["objects"] == [list(row) for row in delta.objects]
    keeper.close()


def test_the_explanation_of_an_object_begins_with_the_navigational_status_in_its_ais(keeper):
    objects = keeper.tick(START_S + 2.0).objects
    at = int(np.flatnonzero(objects["mmsi"] != "")[0])
    number, mmsi = int(objects["object"][at]), str(objects["mmsi"][at])
    assert keeper.why(number).startswith(f"Object {number} is ")
    columns: dict[str, Any] = {
        "time_s": [START_S],
        "lat_deg": [50.0],
        "lon_deg": [0.0],
        "mmsi": [mmsi],
        "nav_status": [1.0],
    }
    keeper.approaches.take(Reports.of("ais", "ais", columns))
    assert keeper.why(number).startswith(f"Navigational status in its AIS: at anchor\nObject {number} is ")
    keeper.close()


@pytest.mark.slow
def test_the_evidence_of_an_object_is_served_as_text(keeper):
    with served(keeper) as url:
        [_, (_, _, content)] = events(url, 2)
        number = int(keeper.situation.objects["object"][0])
        status, headers, text = ask(f"{url}/objects/{number}/why")
        assert content and status == 200 and headers["content-type"].startswith("text/plain")
        assert text.startswith(f"Object {number} is ") and "probability" in text
        assert ask(f"{url}/objects/99999/why")[2] == "no source shows object 99999 now"
        assert "Replay, 20 × real time" in ask(f"{url}/")[2]


def test_the_addresses_that_are_printed_can_be_given_to_others():
    assert map_addresses(Access.of("127.0.0.1"), 8642) == ["Map: http://127.0.0.1:8642/"]
    assert map_addresses(Access.of("::1"), 1) == ["Map: http://[::1]:1/"]
    *lines, secret = map_addresses(Access("0.0.0.0", "op", "view"), 8642)
    name = socket.gethostname()
    assert lines == [f"Map: http://{name}:8642/?token=op", f"  to look only: http://{name}:8642/?token=view"]
    assert secret.startswith("  not encrypted: the token can be read on the network")
    assert map_addresses(Access("10.0.0.1", "op"), 1, "https") == ["Map: https://10.0.0.1:1/?token=op"]
