"""A WebSocket client (RFC 6455) and the login of a Signal K server.

Only what an input needs is here: messages come in, one subscription goes out. A library (websockets, wsproto) would be
a dependency for two hundred lines; extensions are not asked for, so that no server compresses.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import os
import struct
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from urllib.parse import SplitResult, urlsplit

from sameas.errors import InputError, printable

#: Largest message, in bytes, and largest answer to a handshake or a login.
MOST_BYTES, MOST_HEAD = 16 << 20, 1 << 16
#: Appended to a key by the server (RFC 6455, section 1.3).
_KEY_OF_SERVERS = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
_CONTINUED, _TEXT, _BYTES, _CLOSE, _PING, _PONG = 0, 1, 2, 8, 9, 10
#: Where a Signal K server takes a user name and a password (Signal K 1.7, "Security").
_LOGIN_PATH = "/signalk/v1/auth/login"
_STREAM_PATH = "/signalk/v1/stream"


@dataclass(frozen=True)
class Login:
    """How to be let in: a token, or a user name and a password, with which a token is asked for."""

    token: str | None = None
    username: str | None = None
    password: str | None = None

    def __repr__(self) -> str:
        """Without secrets: it may be printed."""
        return f"Login({'a token' if self.token else self.username!r})"

    async def ask_token(self, url: str, timeout_s: float) -> str | None:
        """The token, asked of the server of a WebSocket where there is none yet; None where nothing is given.

        Raises
        ------
        OSError : the server cannot be reached, or refuses.
        """
        if self.token is not None or self.username is None:
            return self.token
        return await asyncio.to_thread(self._logged_in, url, timeout_s)

    def _logged_in(self, url: str, timeout_s: float) -> str:
        parts = urlsplit(url)
        address = f"{'https' if parts.scheme == 'wss' else 'http'}://{_host(parts)}{_LOGIN_PATH}"
        body = json.dumps({"username": self.username, "password": self.password or ""}).encode()
        request = urllib.request.Request(address, body, {"Content-Type": "application/json"}, method="POST")
        try:
            with urllib.request.urlopen(request, timeout=timeout_s) as answer:
                token = json.loads(answer.read(MOST_HEAD))["token"]
        except urllib.error.HTTPError as error:
            refused = error.code in (400, 401, 403)
            error.close()
            raise ConnectionError(
                "the server refused the user name or the password" if refused else f"login: {error}"
            ) from None
        except (ValueError, KeyError, TypeError):
            raise ConnectionError(f"{_LOGIN_PATH} gave no token: is this a Signal K server?") from None
        if not isinstance(token, str) or not token.isprintable():
            raise ConnectionError(f"{_LOGIN_PATH} gave no token: is this a Signal K server?")
        return token


def require_readable(url: str) -> None:
    """Refuses an address that cannot be that of a WebSocket."""
    parts = urlsplit(url)
    if not parts.hostname:
        raise InputError(f"input {url!r}: has no host", f"give {parts.scheme}://HOST:PORT{_STREAM_PATH}")
    if parts.username or parts.password:
        raise InputError(
            f"input {parts.scheme}://{_host(parts)}: has a password, which would be shown",
            'give username = "…" and password = "…" next to url',
        )


def _host(parts: SplitResult) -> str:
    """Host and port as in the address, without a user."""
    return parts.netloc.rpartition("@")[2]


class WebSocket:
    """An open connection."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    @classmethod
    async def open(cls, url: str, token: str | None = None) -> WebSocket:
        """Connects to a ``ws://`` or ``wss://`` address; one without a path is that of a Signal K stream.

        Raises
        ------
        OSError : there is no connection, or the server refuses it.
        """
        parts = urlsplit(url)
        secure = parts.scheme == "wss"
        port = parts.port or (443 if secure else 80)
        reader, writer = await asyncio.open_connection(parts.hostname, port, ssl=True if secure else None)
        try:
            key = base64.b64encode(os.urandom(16))
            query = parts.query or "subscribe=none"
            lines = [
                f"GET {parts.path if parts.path not in ('', '/') else _STREAM_PATH}?{query} HTTP/1.1",
                f"Host: {_host(parts)}", "Upgrade: websocket", "Connection: Upgrade",
                f"Sec-WebSocket-Key: {key.decode()}", "Sec-WebSocket-Version: 13",
                *([f"Authorization: Bearer {token}"] if token else []),
            ]  # fmt: skip
            writer.write("\r\n".join([*lines, "", ""]).encode("latin-1", errors="replace"))
            status, headers = await _answer(reader)
            if status == 101:
                expected = base64.b64encode(hashlib.sha1(key + _KEY_OF_SERVERS).digest()).decode()
                if headers.get("sec-websocket-accept") == expected:
                    return cls(reader, writer)
                raise ConnectionError("the other side is no WebSocket")
            raise ConnectionError(_refusal(status, token))
        except BaseException:
            writer.close()
            raise

    async def send(self, text: str) -> None:
        """Sends a message of text."""
        self._write(_TEXT, text.encode())
        await self.writer.drain()

    def _write(self, kind: int, data: bytes) -> None:
        # A client masks what it sends (section 5.3).
        mask = os.urandom(4)
        n = len(data)
        size = (
            bytes([0x80 | n])
            if n < 126
            else struct.pack(">BH", 0xFE, n)
            if n < 1 << 16
            else struct.pack(">BQ", 0xFF, n)
        )
        self.writer.write(bytes([0x80 | kind]) + size + mask + _masked(data, mask))

    async def messages(self) -> AsyncIterator[bytes]:
        """The messages, until the other side closes; its pings are answered.

        Raises
        ------
        OSError : the connection breaks, or what arrives is no WebSocket.
        """
        message, size = [], 0
        while True:
            try:
                whole, kind, data = await self._frame()
            except asyncio.IncompleteReadError:
                return
            if kind == _PING:
                self._write(_PONG, data)
            elif kind == _CLOSE:
                self._write(_CLOSE, data[:2])
                return
            elif kind in (_TEXT, _BYTES, _CONTINUED):
                message.append(data)
                size += len(data)
                if size > MOST_BYTES:
                    raise ConnectionError(f"a message of more than {MOST_BYTES >> 20} MB")
                if whole:
                    yield b"".join(message)
                    message, size = [], 0
            elif kind != _PONG:
                raise ConnectionError("what arrives is no WebSocket")

    async def _frame(self) -> tuple[bool, int, bytes]:
        """Whether a message ends with it, its kind, its content."""
        first, second = await self.reader.readexactly(2)
        n, mask = second & 0x7F, b""
        if n == 126:
            n = int.from_bytes(await self.reader.readexactly(2), "big")
        elif n == 127:
            n = int.from_bytes(await self.reader.readexactly(8), "big")
        if first & 0x70 or n > MOST_BYTES:
            raise ConnectionError("what arrives is no WebSocket" if first & 0x70 else "a frame that is too long")
        if second & 0x80:
            mask = await self.reader.readexactly(4)
        data = await self.reader.readexactly(n)
        return bool(first & 0x80), first & 0x0F, _masked(data, mask) if mask else data


def _masked(data: bytes, mask: bytes) -> bytes:
    """The bytes, each with its byte of the mask, which repeats (its own inverse)."""
    n = len(data)
    repeated = (mask * (n // 4 + 1))[:n]
    return (int.from_bytes(data, "big") ^ int.from_bytes(repeated, "big")).to_bytes(n, "big")


async def _answer(reader: asyncio.StreamReader) -> tuple[int, Mapping[str, str]]:
    """The status and the headers of an HTTP answer."""
    try:
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        status = int(head[0].split()[1])
    except (asyncio.IncompleteReadError, asyncio.LimitOverrunError, ValueError, IndexError):
        raise ConnectionError("the other side does not speak HTTP") from None
    pairs = (line.partition(":") for line in head[1:] if line)
    return status, {name.strip().lower(): value.strip() for name, _, value in pairs}


def _refusal(status: int, token: str | None) -> str:
    if status in (401, 403):
        return "the server refused the token" if token else "the server wants a token, or a user name and a password"
    if status == 404:
        return printable("the server has no such address; that of a Signal K stream ends in /signalk/v1/stream")
    return f"the server answered {status}, and no WebSocket"
