"""A Signal K server over WebSocket: login, subscription, frames of every size, refusals, and what breaks."""

import asyncio
import base64
import hashlib
import json
import struct

import pytest
from tests.live.test_inputs import free_port, until

from sameas.errors import InputError, MissingPackage
from sameas.io.sensors.stream import ReportStream
from sameas.live.inputs import Wire
from sameas.live.settings import read_settings
from sameas.live.websocket import Login

HELLO = {"name": "signalk-server", "version": "2.1", "self": "vessels.urn:mrn:imo:mmsi:235000001", "roles": ["main"]}
MMSI = "235070762"


def delta(lat=50.1, seconds=0, **values):
    """A delta of a vessel; ``a_b`` is the path a.b."""
    known = {"navigation_position": {"latitude": lat, "longitude": -1.2}, **values}
    update = {
        "timestamp": f"2024-05-01T12:00:{seconds:02d}Z",
        "values": [{"path": name.replace("_", "."), "value": value} for name, value in known.items()],
    }
    return json.dumps({"context": f"vessels.urn:mrn:imo:mmsi:{MMSI}", "updates": [update]}).encode()


def frame(data, kind=1, whole=True):
    """An unmasked frame, as servers send."""
    n = len(data)
    size = bytes([n]) if n < 126 else struct.pack(">BH", 126, n) if n < 1 << 16 else struct.pack(">BQ", 127, n)
    return bytes([0x80 * whole | kind]) + size + data


async def unmasked(reader):
    """Kind and content of a frame of a client, which is masked."""
    first, second = await reader.readexactly(2)
    assert second & 0x80
    n = second & 0x7F
    n = struct.unpack(">H", await reader.readexactly(2))[0] if n == 126 else n
    mask, data = await reader.readexactly(4), await reader.readexactly(n)
    return first & 0x0F, bytes(b ^ mask[k % 4] for k, b in enumerate(data))


class Server:
    """Answers logins and WebSockets; ``serve`` continues after the handshake. asked : heads of the requests."""

    def __init__(self, serve, users=None, token=None):
        self.serve, self.users, self.token, self.asked = serve, users or {}, token, []
        self.errors = []

    async def __call__(self, reader, writer):
        try:
            head = (await reader.readuntil(b"\r\n\r\n")).decode()
            headers = {line.split(": ")[0].lower(): line.split(": ")[1] for line in head.split("\r\n")[1:-2]}
            self.asked.append(head.split("\r\n")[0])
            if head.startswith("POST /signalk/v1/auth/login "):
                given = json.loads(await reader.readexactly(int(headers["content-length"])))
                right = self.users.get(given["username"]) == given["password"]
                body = json.dumps({"token": self.token} if right else {"message": "no"}).encode()
                status = "200 OK" if right else "401 Unauthorized"
                writer.write(
                    f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body
                )
            elif self.token is not None and headers.get("authorization") != f"Bearer {self.token}":
                writer.write(b"HTTP/1.1 401 Unauthorized\r\nContent-Length: 0\r\n\r\n")
            else:
                key = headers["sec-websocket-key"].encode() + b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
                accept = base64.b64encode(hashlib.sha1(key).digest()).decode()
                writer.write(b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                             b"Sec-WebSocket-Accept: " + accept.encode() + b"\r\n\r\n")  # fmt: skip
                await self.serve(reader, writer)
            await writer.drain()
        except (ConnectionError, asyncio.IncompleteReadError):
            pass
        except Exception as error:
            self.errors.append(error)
        finally:
            writer.close()


def watched(server, done, path="", tls=None, **made):
    """The wire after ``done(wire)`` is true, connected to the server."""

    async def run():
        port = free_port()
        wire = Wire(f"{'wss' if tls else 'ws'}://127.0.0.1:{port}{path}", ReportStream("boat"), **made)
        async with await asyncio.start_server(server, "127.0.0.1", port, ssl=tls):
            task = asyncio.create_task(wire.run())
            try:
                await until(lambda: done(wire) or server.errors, 20.0)
            finally:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
        assert not server.errors, server.errors
        return wire

    return asyncio.run(run())


@pytest.mark.slow
def test_a_server_is_subscribed_to_and_messages_of_every_size_are_read():
    subscribed = []

    async def serve(reader, writer):
        writer.write(frame(json.dumps(HELLO).encode()))
        subscribed.append(await unmasked(reader))
        writer.write(frame(b"are you there?", 9))
        subscribed.append(await unmasked(reader))
        long, longer = "x" * 200, "y" * 70_000
        first = delta(50.1, 1, name=long)
        # One message in three frames, with a ping between them, and bytes that come one by one.
        writer.write(frame(first[:10], 1, False) + frame(b"", 9) + frame(first[10:60], 0, False) + frame(first[60:], 0))
        for byte in frame(delta(50.2, 2, name=longer)):
            writer.write(bytes([byte]))
        # A message in several lines is one message.
        writer.write(frame(json.dumps(json.loads(delta(50.3, 3)), indent=2).encode()))
        await writer.drain()
        await asyncio.sleep(30.0)

    wire = watched(Server(serve), lambda wire: len(wire.queue) >= 4)
    [reports] = wire.take()
    assert reports.lat_deg.tolist() == [50.1, 50.2, 50.3] and reports.mmsi.tolist() == [MMSI] * 3
    kind, text = subscribed[0]
    assert kind == 1 and json.loads(text) == {"context": "*", "subscribe": [{"path": "*", "policy": "instant"}]}
    assert subscribed[1] == (10, b"are you there?")


@pytest.mark.slow
@pytest.mark.parametrize(("path", "line", "sends"), [
    ("", "GET /signalk/v1/stream?subscribe=none HTTP/1.1", True),
    ("/signalk/v1/stream?subscribe=all", "GET /signalk/v1/stream?subscribe=all HTTP/1.1", False),
])  # fmt: skip
def test_an_address_that_subscribes_is_left_as_it_is(path, line, sends):
    sent = []

    async def serve(reader, writer):
        writer.write(frame(delta()))
        try:
            async with asyncio.timeout(0.5):
                kind, text = await unmasked(reader)
                sent.extend([text] if kind == 1 else [])
        except TimeoutError:
            pass
        await asyncio.sleep(30.0)

    server = Server(serve)
    watched(server, lambda wire: len(wire.queue) and (sent or not sends), path)
    assert server.asked == [line] and bool(sent) == sends


async def one_delta(reader, writer):
    writer.write(frame(delta()))
    await writer.drain()
    await asyncio.sleep(30.0)


@pytest.mark.slow
def test_a_token_or_a_login_opens_the_stream_again_after_it_broke():
    for login, posts in ((Login(token="abc"), 0), (Login(username="mate", password="pw"), 2)):

        async def breaks(reader, writer):
            writer.write(frame(delta()) + frame(b"\x03\xe8", 8))

        server = Server(breaks, {"mate": "pw"}, "abc")
        wire = watched(server, lambda wire: wire.state.connections >= 2, login=login)
        assert [line.split()[0] for line in server.asked[: 2 + posts]] == (
            ["POST", "GET"] * 2 if posts else ["GET"] * 2
        )
        assert len(wire.take()[0]) >= 1


@pytest.mark.parametrize(("login", "words"), [
    (None, "the server wants a token: give token, username and password, or access_file in its input"),
    (Login(token="old"), "the server refused the token"),
    (Login(username="mate", password="wrong"), "the server refused the user name or the password"),
])  # fmt: skip
def test_a_refusal_is_named_without_the_secret(login, words):
    wire = watched(Server(one_delta, {"mate": "pw"}, "abc"), lambda wire: wire.state.error, login=login)
    assert wire.state.error == words
    assert "wrong" not in repr(login) and "old" not in repr(login)


@pytest.mark.slow
@pytest.mark.parametrize(("sent", "words"), [
    (b"\xf1\x00", "what arrives is no WebSocket"),
    (b"\x85\x00", "what arrives is no WebSocket"),
    (b"\x82\x7f" + b"\x7f" * 8, "a message of more than 16 MB"),
])  # fmt: skip
def test_what_is_no_websocket_ends_the_connection(sent, words):
    async def serve(reader, writer):
        writer.write(sent)
        await writer.drain()
        await asyncio.sleep(5.0)

    assert watched(Server(serve), lambda wire: wire.state.error).state.error == words


@pytest.mark.parametrize(("answer", "words"), [
    (b"HTTP/1.1 200 OK\r\n\r\n", "the server answered 200, and no WebSocket"),
    (b"HTTP/1.1 404 Not Found\r\n\r\n", "that of a Signal K stream ends in /signalk/v1/stream"),
    (b"HTTP/1.1 101 Fine\r\nSec-WebSocket-Accept: x\r\n\r\n", "the other side is no WebSocket"),
    (b"SSH-2.0-OpenSSH\r\n", "the other side does not speak HTTP"),
    (b"\r\n\r\n", "the other side does not speak HTTP"),
])  # fmt: skip
def test_another_server_is_named(answer, words):
    class Other(Server):
        async def __call__(self, reader, writer):
            await reader.readuntil(b"\r\n\r\n")
            writer.write(answer)
            await writer.drain()
            writer.close()

    assert words in watched(Other(None), lambda wire: wire.state.error).state.error


class Guarded(Server):
    """A server that gives its token to devices that its administrator approves. answers : one for each question.

    Where they are used up, the request is forgotten.
    """

    def __init__(self, answers):
        super().__init__(one_delta, token="granted")
        self.answers, self.devices = list(answers), []

    async def __call__(self, reader, writer):
        head = await reader.readuntil(b"\r\n\r\n")
        if b" /signalk/v1/stream" in head.partition(b"\r\n")[0]:
            replayed = asyncio.StreamReader()
            replayed.feed_data(head)
            return await super().__call__(replayed, writer)
        self.asked.append(head.partition(b"\r\n")[0].decode())
        if head.startswith(b"POST /signalk/v1/access/requests "):
            length = int(head.lower().partition(b"content-length: ")[2].partition(b"\r\n")[0])
            self.devices.append(json.loads(await reader.readexactly(length)))
            status, answer = "202 Accepted", {"state": "PENDING", "href": "/signalk/v1/requests/7"}
        else:
            status, answer = self.answers.pop(0) if self.answers else ("404 Not Found", {})
        body = json.dumps(answer).encode()
        writer.write(f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body)
        await writer.drain()
        writer.close()


PENDING = ("200 OK", {"state": "PENDING", "statusCode": 202})
GRANTED = {"permission": "APPROVED", "token": "granted"}
POST, GET = "POST /signalk/v1/access/requests HTTP/1.1", "GET /signalk/v1/requests/7 HTTP/1.1"


@pytest.mark.slow
@pytest.mark.parametrize(
    "granted", [{"state": "COMPLETED", "accessRequest": GRANTED}, {"state": "COMPLETED"} | GRANTED]
)
@pytest.mark.long_after(1)
def test_access_is_requested_once_and_the_token_kept_for_its_owner(tmp_path, granted):
    file = tmp_path / "access.json"
    server, login = Guarded([PENDING, PENDING, ("200 OK", granted)]), Login(access_file=file)
    errors = []

    def done(wire):
        errors.append(wire.state.error)
        return len(wire.queue)

    watched(server, done, login=login, longest_wait_s=0.25)
    [device] = server.devices
    assert device["permissions"] == "readonly" and device["description"].startswith("sameas on ")
    assert any(device["clientId"] in error and error.startswith("waits for access") for error in errors)
    assert (
        server.asked[:4] == ["POST /signalk/v1/access/requests HTTP/1.1"] + ["GET /signalk/v1/requests/7 HTTP/1.1"] * 3
    )
    assert json.loads(file.read_text())["token"] == "granted" and file.stat().st_mode & 0o777 == 0o600
    # The next watch uses the token, and asks nothing.
    again = Guarded([])
    watched(again, lambda wire: len(wire.queue), login=login)
    assert again.asked == ["GET /signalk/v1/stream?subscribe=none HTTP/1.1"]
    # One that the server refuses has expired: the same device asks for another.
    kept = json.loads(file.read_text())
    file.write_text(json.dumps(kept | {"token": "old"}))
    third = Guarded([("200 OK", granted)])
    watched(third, lambda wire: len(wire.queue), login=login, longest_wait_s=0.25)
    assert third.devices[0]["clientId"] == device["clientId"] and json.loads(file.read_text()) == kept


@pytest.mark.slow
def test_a_denied_request_is_not_made_again_and_a_forgotten_one_is(tmp_path):
    file = tmp_path / "access.json"
    denied = Guarded([("200 OK", {"state": "COMPLETED", "accessRequest": {"permission": "DENIED"}})])
    wire = watched(denied, lambda wire: "remove" in wire.state.error, login=Login(access_file=file))
    assert len(denied.devices) == 1
    assert wire.state.error == f"an administrator of the server has denied access; remove {file} to ask again"
    file.unlink()
    forgetful = Guarded([])
    watched(forgetful, lambda wire: len(forgetful.devices) == 2, login=Login(access_file=file))
    assert forgetful.devices[0] == forgetful.devices[1]


def test_a_server_without_access_requests_and_a_foreign_file_are_named(tmp_path):
    class Without(Server):
        async def __call__(self, reader, writer):
            await reader.readuntil(b"\r\n\r\n")
            writer.write(b"HTTP/1.1 501 Not Implemented\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            await writer.drain()
            writer.close()

    file = tmp_path / "access.json"
    wire = watched(Without(None), lambda wire: wire.state.error, login=Login(access_file=file))
    assert wire.state.error == (
        "the server takes no access request (it answered 501); give token, or username and password"
    )
    file.write_text("[1]")
    wire = watched(Without(None), lambda wire: wire.state.error, login=Login(access_file=file))
    assert wire.state.error.startswith(f"{file}: keeps no access request")


@pytest.mark.slow
def test_a_server_with_a_certificate_of_its_own_is_read_where_it_is_trusted_and_named(certificate):
    file, tls = certificate
    login = Login(username="mate", password="pw", ca_file=file, server_name="boat.local")
    server = Server(one_delta, {"mate": "pw"}, "abc")
    wire = watched(server, lambda wire: len(wire.queue), tls=tls, login=login)
    assert [line.split()[0] for line in server.asked] == ["POST", "GET"]
    for missing, key in ((Login(), "ca_file"), (Login(ca_file=file), "server_name")):
        server = Server(one_delta)
        wire = watched(server, lambda wire: wire.state.error, tls=tls, login=missing)
        assert wire.state.error.startswith("its certificate is not trusted (")
        assert wire.state.error.endswith(f"); give {key} in its input") and not server.asked


SOURCE = '[sources.boat]\nkind = "ais"\ninput = {{ url = "{url}", {given} }}\n'


def login_of(tmp_path, given, url="ws://boat:3000"):
    path = tmp_path / "sensors.toml"
    path.write_text(SOURCE.format(url=url, given=given))
    return read_settings(path).sources["boat"].login


def test_a_login_is_given_in_the_settings_or_in_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("BOAT", "secret")
    assert login_of(tmp_path, 'token = "abc"') == Login(token="abc")
    given = 'username = "mate", password = { env = "BOAT" }'
    assert login_of(tmp_path, given, "wss://boat") == Login(username="mate", password="secret")
    assert login_of(tmp_path, 'format = "signalk"') is None
    # Files are beside the settings.
    assert login_of(tmp_path, 'access_file = "boat.json"') == Login(access_file=tmp_path / "boat.json")


@pytest.mark.parametrize(("given", "url", "words"), [
    ('token = "abc"', "tcp://boat:8375", "token is for ws:// and wss:// only; leave it out"),
    ('password = "abc"', "ws://boat", "password, but no username; give both"),
    ("token = 3", "ws://boat", r'input.token is no text of one line; give it in quotes, or \{ env'),
    ('ca_file = "boat.pem"', "ws://boat", "ca_file is for wss:// and https:// only; leave it out"),
    ('ca_file = "none.pem"', "wss://boat", "none.pem: No such file or directory; give that of the server"),
    ('ca_file = "sensors.toml"', "wss://boat", "sensors.toml: holds no certificate in PEM form"),
    ('token = { env = "NO_SUCH_NAME" }', "ws://boat", "the environment has no NO_SUCH_NAME; set it"),
])  # fmt: skip
def test_a_wrong_login_is_refused(tmp_path, given, url, words):
    with pytest.raises(InputError, match=words):
        login_of(tmp_path, given, url)


def test_an_address_of_a_websocket_needs_its_package(monkeypatch):
    monkeypatch.setattr("sameas.live.websocket.find_spec", lambda name: None)
    with pytest.raises(MissingPackage, match=r"ws:// and wss:// need websockets: pip install 'sameas\[live\]'"):
        Wire("ws://127.0.0.1:3000", ReportStream("boat"))
