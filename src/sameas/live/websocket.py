"""A Signal K server over WebSocket: the connection, and the login for a token."""

from __future__ import annotations

import asyncio
import json
import urllib.error
import urllib.request
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING
from urllib.parse import SplitResult, urlsplit, urlunsplit

from sameas.errors import InputError, MissingPackage

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection
    from websockets.exceptions import ConnectionClosedError

#: Largest message, and largest answer to a login, in bytes.
MOST_BYTES, MOST_ANSWER = 16 << 20, 1 << 16
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
                token = json.loads(answer.read(MOST_ANSWER))["token"]
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
    """Refuses an address that cannot be that of a WebSocket, and any where the package is not installed."""
    parts = urlsplit(url)
    if not parts.hostname:
        raise InputError(f"input {url!r}: has no host", f"give {parts.scheme}://HOST:PORT{_STREAM_PATH}")
    if parts.username or parts.password:
        raise InputError(
            f"input {parts.scheme}://{_host(parts)}: has a password, which would be shown",
            'give username = "…" and password = "…" next to url',
        )
    if find_spec("websockets") is None:
        raise MissingPackage(f"input {url!r}: ws:// and wss:// need websockets: pip install 'sameas[live]'")


def _host(parts: SplitResult) -> str:
    """Host and port as in the address, without a user."""
    return parts.netloc.rpartition("@")[2]


@asynccontextmanager
async def connected(
    url: str, token: str | None, request: str | None, timeout_s: float
) -> AsyncIterator[ClientConnection]:
    """A connection to a ``ws://`` or ``wss://`` address; one without a path is that of a Signal K stream.

    request : a message that is sent first.

    Raises
    ------
    OSError : there is no connection, the server refuses it, or what arrives is no WebSocket.
    """
    from websockets import exceptions
    from websockets.asyncio.client import connect

    parts = urlsplit(url)
    path = parts.path if parts.path not in ("", "/") else _STREAM_PATH
    address = urlunsplit((parts.scheme, parts.netloc, path, parts.query or "subscribe=none", ""))
    try:
        async with connect(
            address, additional_headers={"Authorization": f"Bearer {token}"} if token else None, max_size=MOST_BYTES,
            open_timeout=timeout_s, close_timeout=1.0, proxy=None,
        ) as connection:  # fmt: skip
            if request is not None:
                # What the other side has sent before it closed can be read.
                with suppress(exceptions.ConnectionClosed):
                    await connection.send(request)
            yield connection
    except exceptions.InvalidStatus as error:
        raise ConnectionError(_refusal(error.response.status_code, token)) from None
    except exceptions.InvalidMessage:
        raise ConnectionError("the other side does not speak HTTP") from None
    except exceptions.InvalidHandshake:
        raise ConnectionError("the other side is no WebSocket") from None
    except exceptions.ConnectionClosedError as error:
        raise ConnectionError(_break(error)) from None
    except TimeoutError:
        raise TimeoutError(f"no answer for {timeout_s:.0f} s") from None


def _break(error: ConnectionClosedError) -> str:
    """What broke a connection; codes: RFC 6455, section 7.4.1."""
    code = None if error.sent is None else error.sent.code
    if code == 1009:
        return f"a message of more than {MOST_BYTES >> 20} MB"
    return "what arrives is no WebSocket" if code == 1002 else "the connection broke"


def _refusal(status: int, token: str | None) -> str:
    if status in (401, 403):
        return "the server refused the token" if token else "the server wants a token, or a user name and a password"
    if status == 404:
        return f"the server has no such address; that of a Signal K stream ends in {_STREAM_PATH}"
    return f"the server answered {status}, and no WebSocket"
