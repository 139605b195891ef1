"""Inputs: one reader task per wire, which queues bytes with their receive time and reconnects when the wire breaks.

Wires: ``udp://`` (a multicast group is joined), ``tcp://`` (client), ``tcp-listen://`` (server), ``http(s)://`` and
``file://`` (polled every second), ``ws(s)://`` (of a Signal K server), ``serial:``, ``stdin:``. The
queue of a wire is bounded: when the picture cannot keep up, the oldest data are dropped and counted, so that a flood on
one wire loses reports of that wire only.
"""

from __future__ import annotations

import asyncio
import errno
import importlib.util
import ipaddress
import math
import os
import re
import socket
import ssl
import struct
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Awaitable, Callable
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass, field
from http.client import HTTPException
from urllib.parse import parse_qs, urlsplit

import sameas
from sameas.errors import InputError
from sameas.io.sensors import ogn
from sameas.io.sensors.gpsd import WATCH
from sameas.io.sensors.recording import Piece, Recorder
from sameas.io.sensors.stream import ReportStream, format_of
from sameas.live import websocket
from sameas.live.websocket import Login, connected
from sameas.tracks.reports import Reports

#: Shortest and longest wait in seconds before a wire is reconnected.
FIRST_WAIT_S, LONGEST_WAIT_S = 0.25, 15.0
#: A TCP connection without data for this many seconds is closed and reconnected.
SILENT_S = 120.0
#: Seconds without data after which the other side of a TCP connection is asked whether it is there: thrice, at half
#: this interval, so that one that was switched off is known after 25 s.
KEEP_ALIVE_S = 10
#: Seconds to wait for a TCP connection.
ANSWER_S = 10.0
#: Largest number of pieces of stdin that wait for the loop.
MOST_PIECES = 16
#: Largest number of senders of datagrams whose unfinished sentences are kept apart.
MOST_SENDERS = 1000
_SCHEMES = ("udp", "tcp", "tcp-listen", "http", "https", "ws", "wss", "file", "serial", "stdin")
#: A Signal K server sends deltas over TCP only to a client that subscribes (Signal K 1.7, "Subscription protocol").
_SUBSCRIPTION = '{"context":"*","subscribe":[{"path":"*","policy":"instant"}]}'
#: What servers on TCP want to be asked, by the format of their greeting; those of APRS, see :func:`_request`.
_REQUESTS = {"signalk": _SUBSCRIPTION, "gpsd": WATCH}
#: Seconds after which a server of APRS is told that its client is there: it ends silent connections.
TOLD_S = 240.0


@dataclass
class BoundedQueue:
    """Pieces in the order of receipt. Above ``max_bytes`` in total the oldest are dropped; dropped : their number."""

    max_bytes: int = 8 << 20
    dropped: int = 0
    _pieces: deque[Piece] = field(default_factory=deque)
    _bytes: int = 0

    def put(self, data: bytes, received_s: float, connection: int = 0, *, last: bool = False) -> None:
        self._pieces.append((received_s, data, connection, last))
        self._bytes += len(data)
        while self._bytes > self.max_bytes:
            self._bytes -= len(self._pieces.popleft()[1])
            self.dropped += 1

    def take(self, max_bytes: int) -> list[Piece]:
        """Removes and returns the oldest pieces, until they have ``max_bytes`` or more."""
        out, size = [], 0
        while self._pieces and size < max_bytes:
            piece = self._pieces.popleft()
            out.append(piece)
            size += len(piece[1])
        self._bytes -= size
        return out

    def __len__(self) -> int:
        return len(self._pieces)


@dataclass
class WireState:
    """State of a wire.

    connections : their number. received : bytes in total. last_s : receive time of the last. open_word : what an open
    wire is; a port that is bound is only listening.
    """

    connected: bool = False
    connections: int = 0
    error: str = ""
    received: int = 0
    last_s: float = -math.inf
    open_word: str = "connected"

    def __str__(self) -> str:
        """The connection in a word or two; empty before the first attempt."""
        return self.open_word if self.connected else self.error


class Wire:
    """One wire, its queue and its stream of reports.

    url : see the module. stream : decodes the bytes. max_bytes : size of the queue. clock : UTC in seconds.
    recorder : writes the bytes to disk before they are decoded. login : for a server that wants one. told_s : seconds
    after which a server of APRS is told that its client is there. longest_wait_s : before it connects again.
    """

    def __init__(
        self,
        url: str,
        stream: ReportStream,
        *,
        max_bytes: int = 8 << 20,
        clock: Callable[[], float] = time.time,
        recorder: Recorder | None = None,
        login: Login | None = None,
        told_s: float = TOLD_S,
        longest_wait_s: float = LONGEST_WAIT_S,
    ) -> None:
        self.url, self.stream, self.clock, self.recorder = url, stream, clock, recorder
        self.told_s, self.longest_wait_s = told_s, longest_wait_s
        self.login = login or Login()
        self.queue, self.state = BoundedQueue(max_bytes), WireState()
        # Number of dropped pieces that the recording says.
        self._dropped = 0
        parts = urlsplit(url)
        require_readable(url)
        if parts.scheme in ("udp", "tcp-listen"):
            self.state.open_word = "listening"

    async def run(self) -> None:
        """Reads until cancelled; a broken wire is reconnected, after waits that double up to the longest."""
        wait_s = FIRST_WAIT_S
        scheme = urlsplit(self.url).scheme
        reader: Callable[[], Awaitable[None]] = {
            "udp": self._udp, "tcp": self._tcp, "tcp-listen": self._listen, "http": self._polled, "https": self._polled,
            "ws": self._web_socket, "wss": self._web_socket, "file": self._polled, "serial": self._serial,
            "stdin": self._stdin,
        }[scheme]  # fmt: skip
        while True:
            before = self.state.received
            try:
                await reader()
                ended = "the program that wrote to it has ended; start both again"
                self.state.error = ended if scheme == "stdin" else "closed by the other side"
            except asyncio.CancelledError:
                raise
            except (OSError, HTTPException, InputError) as error:
                self.state.error = _cause(error)
                if isinstance(error, PermissionError):
                    self.login.forget_token()
            self.state.connected = False
            if scheme == "stdin":
                return
            wait_s = FIRST_WAIT_S if self.state.received > before else min(2.0 * wait_s, self.longest_wait_s)
            await asyncio.sleep(wait_s)

    def take(self, max_bytes: int = 2 << 20) -> list[Reports]:
        """The reports in the oldest queued pieces, about ``max_bytes`` of them.

        Raises InputError: the data cannot be decoded to reports; they are dropped.
        """
        pieces = self.queue.take(max_bytes)
        self._record(pieces)
        for received_s, data, connection, last in pieces:
            self.stream.feed(data, received_s, connection=connection, last=last)
        return self.stream.reports()

    def close(self) -> None:
        """Records what is still in the queue, and closes the recording."""
        if self.recorder is not None:
            self._record(self.queue.take(self.queue.max_bytes + 1))
            self.recorder.close()

    def receive(self, data: bytes, connection: int = 0, *, last: bool = False) -> None:
        """Queues data that have just arrived. last : no more of them comes: an incomplete line is read as it is."""
        now_s = self.clock()
        self.state.received += len(data)
        self.state.last_s, self.state.error = now_s, ""
        self.queue.put(data, now_s, connection, last=last)

    def play(self, piece: Piece, dropped: int = 0) -> None:
        """Takes a piece of a recording as if it were received now. dropped : number of those lost before it."""
        received_s, data, connection, last = piece
        self.state.connected, self.state.last_s = True, received_s
        self.state.received += len(data)
        self.queue.dropped += dropped
        self.queue.put(data, received_s, connection, last=last)

    def _record(self, pieces: list[Piece]) -> None:
        if self.recorder is not None and pieces:
            dropped = self.queue.dropped
            self.recorder.write(pieces, dropped - self._dropped)
            self._dropped = dropped

    def _ended(self, connection: int) -> None:
        """Ends a connection: an incomplete line of it is not continued by the next one."""
        self.queue.put(b"", self.clock(), connection, last=True)

    def _set_connected(self) -> int:
        """Counts a connection; its number."""
        self.state.connected = True
        self.state.connections += 1
        self.state.error = ""
        return self.state.connections

    async def _udp(self) -> None:
        parts = urlsplit(self.url)
        host, port = parts.hostname or "0.0.0.0", parts.port or 0
        udp_socket = _udp_socket(host, port, parse_qs(parts.query).get("interface", ["0.0.0.0"])[0])
        loop, received = asyncio.get_running_loop(), self.receive
        senders: dict[object, int] = {}

        class Receiver(asyncio.DatagramProtocol):
            def datagram_received(self, data: bytes, addr: object) -> None:
                if len(senders) >= MOST_SENDERS:
                    senders.clear()
                received(data, senders.setdefault(addr, len(senders)), last=True)

        transport, _ = await loop.create_datagram_endpoint(Receiver, sock=udp_socket)
        try:
            self._set_connected()
            await asyncio.Event().wait()
        finally:
            transport.close()

    async def _tcp(self) -> None:
        parts = urlsplit(self.url)
        # Not asyncio.wait_for: that of Python 3.11 swallows a cancellation that comes together with data.
        try:
            async with asyncio.timeout(ANSWER_S):
                reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
        except TimeoutError:
            raise TimeoutError(f"no answer for {ANSWER_S:.0f} s") from None
        keep_alive(writer)
        connection = self._set_connected()
        told_s = math.inf
        try:
            while True:
                async with asyncio.timeout(SILENT_S):
                    data = await reader.read(65536)
                if not data:
                    return
                self.receive(data, connection)
                spoken = self.stream.format or format_of(data) or ""
                if math.isinf(told_s) and (request := _request(spoken, parts.query)):
                    # The first message is a greeting.
                    writer.write(request.encode() + b"\r\n")
                    told_s = time.monotonic()
                elif spoken == "ogn" and time.monotonic() - told_s > self.told_s:
                    writer.write(ogn.KEEP_ALIVE.encode())
                    told_s = time.monotonic()
        except TimeoutError:
            raise TimeoutError(f"no data for {SILENT_S:.0f} s") from None
        finally:
            self._ended(connection)
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()

    async def _web_socket(self) -> None:
        # The token may have expired since the last connection.
        token = await self.login.ask_token(self.url, ANSWER_S)
        subscribes = "subscribe=" in self.url and "subscribe=none" not in self.url
        request, tls = None if subscribes else _SUBSCRIPTION, self.login.tls()
        async with connected(self.url, token, request, ANSWER_S, tls) as opened:
            connection = self._set_connected()
            try:
                messages = aiter(opened)
                while True:
                    async with asyncio.timeout(SILENT_S):
                        message = await anext(messages, None)
                    if message is None:
                        return
                    data = message.encode() if isinstance(message, str) else message
                    # A message is a line, however it is printed.
                    self.receive(data.replace(b"\n", b" ") + b"\n", connection)
            except TimeoutError:
                raise ConnectionError(f"no data for {SILENT_S:.0f} s") from None
            finally:
                self._ended(connection)

    async def _listen(self) -> None:
        parts = urlsplit(self.url)

        writers: set[asyncio.StreamWriter] = set()

        async def served(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writers.add(writer)
            keep_alive(writer)
            connection = self._set_connected()
            try:
                with suppress(OSError):
                    while data := await reader.read(65536):
                        self.receive(data, connection)
            finally:
                self._ended(connection)
                writers.discard(writer)
                writer.close()

        async with await asyncio.start_server(served, parts.hostname, parts.port) as server:
            self.state.connected = True
            try:
                await server.serve_forever()
            finally:
                for writer in list(writers):
                    writer.close()

    async def _polled(self) -> None:
        tls = self.login.tls()

        def fetched() -> bytes:
            with urllib.request.urlopen(self.url, timeout=5.0, context=tls) as answer:
                return bytes(answer.read(32 << 20))

        while True:
            data = await asyncio.to_thread(fetched)
            if not self.state.connected:
                self._set_connected()
            self.receive(data.replace(b"\n", b" "), last=True)
            await asyncio.sleep(1.0)

    async def _serial(self) -> None:
        import serial

        try:
            line = serial.Serial(urlsplit(self.url).path, int(serial_speed(self.url)), timeout=1.0)
        except serial.SerialException as error:
            if error.errno == errno.EACCES:
                group = "become a member of the group that owns it, often dialout"
                raise OSError(f"{os.strerror(error.errno)}; {group}") from error
            raise OSError(str(error) if error.errno is None else os.strerror(error.errno)) from error
        with line:
            connection = self._set_connected()
            try:
                while True:
                    if data := await asyncio.to_thread(line.read, max(line.in_waiting, 1)):
                        self.receive(data, connection)
            except serial.SerialException as error:
                raise OSError(f"the line was lost: {error}") from error
            finally:
                self._ended(connection)

    async def _stdin(self) -> None:
        self._set_connected()
        loop, pieces = asyncio.get_running_loop(), asyncio.Queue[bytes](MOST_PIECES)

        def read() -> None:
            # The loop may have ended meanwhile.
            with suppress(RuntimeError, OSError, CancelledError):
                data = b" "
                while data:
                    data = os.read(sys.stdin.fileno(), 65536)
                    asyncio.run_coroutine_threadsafe(pieces.put(data), loop).result()

        # Not asyncio.to_thread: the end of the program waits for its threads, and this one waits for data.
        threading.Thread(target=read, daemon=True).start()
        while data := await pieces.get():
            self.receive(data)
        self._ended(0)


def _request(spoken: str, query: str) -> str | None:
    """What a server that speaks this format wants to be asked; query : of its address."""
    if spoken != "ogn":
        return _REQUESTS.get(spoken)
    given = {name: " ".join(values).split() for name, values in parse_qs(query).items()}
    return ogn.login("".join(given.get("user", ["N0CALL"])), sameas.__version__, " ".join(given.get("filter", [])))


def keep_alive(writer: asyncio.StreamWriter) -> None:
    """Has the system ask a silent other side whether it is there: one that was switched off ends no connection."""
    connection = writer.get_extra_info("socket")
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    # Not every system has a name for these.
    for name, value in (("TCP_KEEPIDLE", KEEP_ALIVE_S), ("TCP_KEEPINTVL", KEEP_ALIVE_S // 2), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def require_readable(url: str) -> None:
    """Refuses an address that can never be read, whatever is connected later."""
    parts = urlsplit(url)
    if parts.scheme in ("ws", "wss"):
        websocket.require_readable(url)
    if parts.scheme not in _SCHEMES:
        remedy = f"give one of {', '.join(_SCHEMES)}"
        if re.fullmatch(r"[\w.-]+:\d+", url):
            remedy = f"give udp://{url}, or tcp://{url}"
        raise InputError(f"input {url!r}: is not a known kind of input", remedy)
    if parts.scheme in ("udp", "tcp", "tcp-listen") and not parts.port:
        raise InputError(f"input {url!r}: has no port", f"give {parts.scheme}://HOST:PORT")
    interface = parse_qs(parts.query).get("interface", ["0.0.0.0"])[0]
    try:
        ipaddress.IPv4Address(interface)
    except ValueError:
        raise InputError(f"input {url!r}: interface is {interface!r}", "give its address, such as 10.0.0.2") from None
    speed = serial_speed(url)
    if parts.scheme == "serial" and not (speed.isdecimal() and int(speed)):
        raise InputError(f"input {url!r}: baud is {speed!r}", "give a number such as 4800 or 38400")
    if parts.scheme == "serial" and importlib.util.find_spec("serial") is None:
        raise InputError("a serial line needs pyserial: pip install pyserial")


def serial_speed(url: str) -> str:
    """The speed of a serial line, as its address has it."""
    return parse_qs(urlsplit(url).query).get("baud", ["38400"])[0]


def _cause(error: Exception) -> str:
    """What broke a wire, in the words of the operating system."""
    if isinstance(error, urllib.error.HTTPError):
        return str(error)
    reason = error.reason if isinstance(error, urllib.error.URLError) else error
    if isinstance(reason, ssl.SSLCertVerificationError):
        key = "server_name" if "mismatch" in reason.verify_message else "ca_file"
        return f"its certificate is not trusted ({reason.verify_message.rstrip('.')}); give {key} in its input"
    # The numbers of TLS errors are OpenSSL's.
    if not isinstance(reason, OSError) or reason.errno is None or isinstance(reason, ssl.SSLError):
        return str(reason) or type(error).__name__
    words = reason.strerror if isinstance(reason, socket.gaierror) else os.strerror(reason.errno)
    return words or str(reason)


def _udp_socket(host: str, port: int, interface: str) -> socket.socket:
    """A non-blocking socket bound to this address; a multicast group is joined."""
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    try:
        address = ipaddress.ip_address(socket.gethostbyname(host))
        if address.is_multicast:
            # Any number of programs may receive a group. Of two that share a unicast port, one would get nothing.
            udp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            udp.bind((str(address), port))
            group = struct.pack("4s4s", socket.inet_aton(str(address)), socket.inet_aton(interface))
            udp.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        else:
            udp.bind((str(address), port))
    except OSError as error:
        udp.close()
        if error.errno == errno.EADDRNOTAVAIL:
            raise InputError(
                f"{host} is no address of this machine; give udp://0.0.0.0:{port} for any sender"
            ) from error
        raise
    udp.setblocking(False)
    return udp
