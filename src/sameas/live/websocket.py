"""A Signal K server over WebSocket: the connection, the certificates, and the login or access request for a token.

Access requests: a device asks once, an administrator of the server approves or denies it there, and the device asks
for the answer until then (Signal K 1.7, "Access Requests").
"""

from __future__ import annotations

import asyncio
import json
import os
import ssl
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from socket import gethostname
from typing import TYPE_CHECKING, Any
from urllib.parse import SplitResult, urlsplit, urlunsplit
from uuid import uuid4

from sameas.errors import InputError, MissingPackage, reading
from sameas.io.atomic import replacing

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection
    from websockets.exceptions import ConnectionClosedError

#: Largest message, and largest answer to a login, in bytes.
MOST_BYTES, MOST_ANSWER = 16 << 20, 1 << 16
#: Where a Signal K server takes a user name and a password (Signal K 1.7, "Security").
_LOGIN_PATH = "/signalk/v1/auth/login"
#: Where it takes the request of a device for access.
_ACCESS_PATH = "/signalk/v1/access/requests"
_STREAM_PATH = "/signalk/v1/stream"


@dataclass(frozen=True)
class Login:
    """How to be let in: a token; or a user name and a password, with which a token is asked for; or an access request.

    access_file : keeps the request for access, and the token that an administrator of the server has granted.
    ca_file : certificates (PEM) that are trusted instead of those of the system. server_name : for which the server's
        certificate is made, if it is another than in the address.
    """

    token: str | None = None
    username: str | None = None
    password: str | None = None
    access_file: Path | None = None
    ca_file: Path | None = None
    server_name: str | None = None

    def __repr__(self) -> str:
        """Without secrets: it may be printed."""
        return f"Login({'a token' if self.token else self.username!r})"

    def tls(self) -> ssl.SSLContext:
        """The certificates to trust. No connection is made without verification.

        Raises OSError: the file cannot be read, or holds no certificate.
        """
        context = _NamedServer(ssl.PROTOCOL_TLS_CLIENT)
        context.server_name = self.server_name
        if self.ca_file is None:
            context.load_default_certs()
        else:
            context.load_verify_locations(self.ca_file)
        return context

    async def ask_token(self, url: str, timeout_s: float) -> str | None:
        """The token, asked of the server of a WebSocket where there is none yet; None where nothing is given.

        Raises
        ------
        OSError : the server cannot be reached, refuses, or its administrator has not granted access yet.
        """
        if self.token is None and self.username is not None:
            return await asyncio.to_thread(self._logged_in, _Server.of(url, self.tls(), timeout_s))
        if self.token is None and self.access_file is not None:
            return await asyncio.to_thread(self._granted, _Server.of(url, self.tls(), timeout_s), self.access_file)
        return self.token

    def forget_token(self) -> None:
        """Drops a granted token that the server refused: it has expired, or was revoked. The next one is requested."""
        if self.access_file is not None and "token" in (kept := _read_access(self.access_file)):
            _write_access(self.access_file, {"clientId": kept["clientId"]})

    def _logged_in(self, server: _Server) -> str:
        status, answer = server.ask(_LOGIN_PATH, {"username": self.username, "password": self.password or ""})
        if status in (400, 401, 403):
            raise ConnectionError("the server refused the user name or the password")
        if status != 200:
            raise ConnectionError(f"login: the server answered {status}")
        return _token_in(answer, _LOGIN_PATH)

    def _granted(self, server: _Server, file: Path) -> str:
        """The granted token. A request is made once, and its state is asked for with every further attempt."""
        kept = _read_access(file)
        if "token" in kept:
            return str(kept["token"])
        if kept.get("denied"):
            raise ConnectionError(f"an administrator of the server has denied access; remove {file} to ask again")
        if "href" not in kept:
            body = {
                "clientId": kept["clientId"],
                "description": f"sameas on {gethostname()}",
                "permissions": "readonly",
            }
            status, answer = server.ask(_ACCESS_PATH, body)
            if not isinstance(href := answer.get("href"), str) or not href.startswith("/"):
                words = answer.get("message") or f"it answered {status}"
                raise ConnectionError(
                    f"the server takes no access request ({words}); give token, or username and password"
                )
            kept = {"clientId": kept["clientId"], "href": href}
            _write_access(file, kept)
        status, answer = server.ask(str(kept["href"]))
        # In the answers of version 1 of the server, and in those of the specification.
        found = answer.get("accessRequest", answer)
        permission = found.get("permission") if isinstance(found, dict) else None
        if permission == "APPROVED":
            token = _token_in(found, _ACCESS_PATH)
            _write_access(file, {"clientId": kept["clientId"], "token": token})
            return token
        if permission == "DENIED":
            _write_access(file, {"clientId": kept["clientId"], "denied": True})
            raise ConnectionError("an administrator of the server has denied access")
        if answer.get("state") != "PENDING":
            # The server has forgotten the request, as after a restart.
            _write_access(file, {"clientId": kept["clientId"]})
        raise ConnectionError(
            f"waits for access: an administrator of the server has to approve device {kept['clientId']}"
        )


class _NamedServer(ssl.SSLContext):
    """A context that expects a certificate for ``server_name`` where it is given, whatever the address."""

    server_name: str | None = None

    def wrap_socket(self, *args: Any, **options: Any) -> ssl.SSLSocket:
        return super().wrap_socket(*args, **self._named(options))

    def wrap_bio(self, *args: Any, **options: Any) -> ssl.SSLObject:
        return super().wrap_bio(*args, **self._named(options))

    def _named(self, options: dict[str, Any]) -> dict[str, Any]:
        return options if self.server_name is None else options | {"server_hostname": self.server_name}


@dataclass(frozen=True)
class _Server:
    """The HTTP interface of the server of a WebSocket."""

    address: str
    tls: ssl.SSLContext
    timeout_s: float

    @classmethod
    def of(cls, url: str, tls: ssl.SSLContext, timeout_s: float) -> _Server:
        parts = urlsplit(url)
        return cls(f"{'https' if parts.scheme == 'wss' else 'http'}://{_host(parts)}", tls, timeout_s)

    def ask(self, path: str, body: object = None) -> tuple[int, dict[str, Any]]:
        """Status and answer, empty where it is no JSON object; posts ``body`` where it is given."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.address + path, data, {"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=self.timeout_s, context=self.tls) as answer:
                status, content = answer.status, answer.read(MOST_ANSWER)
        except urllib.error.HTTPError as error:
            with error:
                status, content = error.code, error.read(MOST_ANSWER)
        with suppress(ValueError):
            if isinstance(found := json.loads(content), dict):
                return status, found
        return status, {}


def _token_in(answer: Mapping[str, Any], path: str) -> str:
    token = answer.get("token")
    if not isinstance(token, str) or not token.isprintable():
        raise ConnectionError(f"{path} gave no token: is this a Signal K server?")
    return token


def _read_access(file: Path) -> dict[str, Any]:
    """What is kept of an access request; the name of a new device where the file does not exist.

    Raises InputError: the file is another one.
    """
    if not file.exists():
        _write_access(file, {"clientId": str(uuid4())})
    with reading(str(file), "keeps no access request"):
        kept: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return {"clientId": str(kept["clientId"])} | kept


def _write_access(file: Path, kept: Mapping[str, Any]) -> None:
    with replacing(file) as draft:
        os.chmod(draft, 0o600)
        draft.write_text(json.dumps(kept) + "\n", encoding="utf-8")


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
    url: str, token: str | None, request: str | None, timeout_s: float, tls: ssl.SSLContext
) -> AsyncIterator[ClientConnection]:
    """A connection to a ``ws://`` or ``wss://`` address; one without a path is that of a Signal K stream.

    request : a message that is sent first. tls : certificates to trust.

    Raises
    ------
    PermissionError : the server refuses the token.
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
            open_timeout=timeout_s, close_timeout=1.0, proxy=None, ssl=tls if parts.scheme == "wss" else None,
        ) as connection:  # fmt: skip
            if request is not None:
                # What the other side has sent before it closed can be read.
                with suppress(exceptions.ConnectionClosed):
                    await connection.send(request)
            yield connection
    except exceptions.InvalidStatus as error:
        status = error.response.status_code
        kind = PermissionError if status in (401, 403) else ConnectionError
        raise kind(_refusal(status, token)) from None
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
        wants = "the server wants a token: give token, username and password, or access_file in its input"
        return "the server refused the token" if token else wants
    if status == 404:
        return f"the server has no such address; that of a Signal K stream ends in {_STREAM_PATH}"
    return f"the server answered {status}, and no WebSocket"
