"""The web server: live map, event stream, and a JSON interface for other programs.

On the loopback interface no token is needed, but the Host header must name the loopback (protection against DNS
rebinding). Elsewhere a token is required: the operator's may acknowledge alarms, the viewer's may read. A token in the
URL is moved into a cookie. Names of ships are inserted as text, never as markup, and the page's content policy allows
its own script only.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import math
import secrets
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.errors import InputError, first_line, optional
from sameas.live.keeper import Keeper
from sameas.live.offsets import OFFSETS, read_offset
from sameas.live.outputs import geojson, metrics
from sameas.live.settings import read_chart
from sameas.live.situation import OBJECT, RECORD, Delta, Situation
from sameas.maps.geojson import Coast
from sameas.maps.sheet import MapSensor, MapSheet
from sameas.maps.tiles import Chart
from sameas.pages.map import map_page
from sameas.tracks.platforms import OWN_POSITIONS

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

#: Seconds between keep-alive comments on an idle event stream.
SIGN_OF_LIFE_S = 10.0
LOOPBACK = ("127.0.0.1", "localhost", "::1")
_COOKIE = "sameas_token"
_HEADERS = {
    "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "X-Frame-Options": "DENY",
    "Cache-Control": "no-store",
}  # fmt: skip


@dataclass(frozen=True)
class Access:
    """Access rules. host : to which the server is bound. operator, viewer : tokens; None on the loopback."""

    host: str = "127.0.0.1"
    operator: str | None = None
    viewer: str | None = None

    @classmethod
    def of(cls, host: str, operator: str | None = None, viewer: str | None = None) -> Access:
        """The rules for a host; an operator token is generated where none is given and the host is not the loopback."""
        if host not in LOOPBACK and operator is None:
            operator = secrets.token_urlsafe(18)
        return cls(host, operator, viewer)

    def role(self, given: str | None) -> str | None:
        """The role of a token: "operator", "viewer" or None."""
        if self.operator is None:
            return "operator"
        given = given or ""
        if hmac.compare_digest(given.encode(), self.operator.encode()):
            return "operator"
        if self.viewer is not None and hmac.compare_digest(given.encode(), self.viewer.encode()):
            return "viewer"
        return None

    def accepts_host(self, host_header: str) -> bool:
        """Whether the Host header may be served: on the loopback only a name of the loopback."""
        return (
            self.host not in LOOPBACK
            or host_header.rpartition(":")[0].strip("[]") in LOOPBACK
            or (host_header.strip("[]") in LOOPBACK)
        )


@dataclass(frozen=True)
class TlsCertificate:
    """What the server proves its name with, for https. file : certificate and its chain, PEM. key : its private key."""

    file: Path
    key: Path

    @classmethod
    def of(cls, file: Path, key: Path | None = None) -> TlsCertificate:
        """The certificate of a file; key : the file of its private key, if that is another one.

        Raises InputError: a file is missing, is no PEM, has a password, or the key is not that of the certificate.
        """
        key, has_password = key or file, False

        def password() -> str:
            nonlocal has_password
            has_password = True
            return ""

        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            # Without a function OpenSSL asks for the password on the terminal.
            context.load_cert_chain(file, key, password)
        except FileNotFoundError as error:
            missing = key if file.exists() else file
            raise InputError(
                f"{missing}: No such file or directory", "give a certificate, and --key for its key"
            ) from error
        except (OSError, ssl.SSLError) as error:
            if has_password:
                raise InputError(f"{key}: the private key has a password", "give a key without one") from error
            files = f"{file}" if key == file else f"{file} and {key}"
            raise InputError(
                f"{files}: no certificate with its private key, in PEM ({first_line(error)})",
                "give --certificate, and --key if the key is in a file of its own",
            ) from error
        return cls(file, key)


@dataclass
class Clients:
    """Number of event streams: now, and their limit."""

    limit: int = 100
    now: int = 0


def application(keeper: Keeper, access: Access | None) -> Starlette:
    """The ASGI application of a keeper, for uvicorn or another server.

    Raises InputError: Starlette is not installed.
    """
    with optional("the live map needs Starlette and uvicorn", "live"):
        from starlette.applications import Starlette
        from starlette.routing import Route
    handlers = _Handlers(keeper, access or Access(), Clients())
    guarded = handlers.guarded
    changing = (handlers.acknowledge, handlers.hold, handlers.offset)
    acknowledge, hold, offset = (guarded(one, operator=True, changes=True) for one in changing)
    return Starlette(routes=[
        Route("/", guarded(handlers.page)),
        Route("/events", guarded(handlers.events)),
        Route("/history", guarded(handlers.history)),
        Route("/chart/{number:int}/{zoom:int}/{column:int}/{row:int}", guarded(handlers.tile)),
        Route("/objects", guarded(handlers.objects)),
        Route("/objects.geojson", guarded(handlers.objects_geojson)),
        Route("/objects/{number:int}/why", guarded(handlers.why)),
        Route("/alarms", guarded(handlers.alarms)),
        Route("/alarms/{alarm:int}/acknowledge", acknowledge, methods=["POST"]),
        Route("/sources/{source:path}/offset", offset, methods=["POST"]),
        Route("/sources/{source:path}/hold", hold, methods=["POST", "DELETE"]),
        Route("/metrics", guarded(handlers.prometheus)),
        Route("/health", handlers.health),
    ])  # fmt: skip


#: Answers a request of a role.
_Handler = Callable[["Request", str], Awaitable["Response"]]


def _json(content: object, status: int = 200, **headers: str) -> Response:
    from starlette.responses import JSONResponse

    return JSONResponse(content, status, headers=_HEADERS | headers)


#: Largest body of a request in bytes.
MOST_BODY = 1000


def _who(request: Request) -> str:
    return f"operator at {request.client.host}" if request.client else "operator"


async def _short_body(request: Request) -> bytes:
    """The body of a request; refused where it is long, before it is read."""
    body = b""
    async for piece in request.stream():
        body += piece
        if len(body) > MOST_BODY:
            raise InputError("the request is too long", 'give JSON such as {"bias": "azimuth_deg", "value": 2.0}')
    return body


@dataclass(frozen=True)
class _Handlers:
    """The answers of the server, one method a path."""

    keeper: Keeper
    access: Access
    clients: Clients

    def _role_of(self, request: Request) -> str | None:
        bearer = request.headers.get("authorization", "").removeprefix("Bearer ")
        return self.access.role(bearer or request.cookies.get(_COOKIE) or request.query_params.get("token"))

    def guarded(
        self, handler: _Handler, *, operator: bool = False, changes: bool = False
    ) -> Callable[[Request], Awaitable[Response]]:
        """The handler behind the access rules. operator : viewers are refused. changes : a header is required that
        other sites cannot send."""

        async def guard(request: Request) -> Response:
            if not self.access.accepts_host(request.headers.get("host", "")):
                return _json({"error": "the request names another host"}, 421)
            role = self._role_of(request)
            if role is None:
                return _json({"error": "give a token: ?token=…, or Authorization: Bearer …"}, 401)
            if operator and role != "operator":
                return _json({"error": "viewers may only look"}, 403)
            if changes and request.headers.get("x-sameas") != "1":
                return _json({"error": "give the header X-Sameas: 1"}, 403)
            return await handler(request, role)

        return guard

    async def page(self, request: Request, role: str) -> Response:
        from starlette.responses import RedirectResponse, Response

        token = request.query_params.get("token")
        if token is not None:
            moved = RedirectResponse(request.url.path, 303, headers=_HEADERS)
            moved.set_cookie(_COOKIE, token, httponly=True, samesite="strict", secure=request.url.scheme == "https")
            return moved
        text = await asyncio.to_thread(live_page, self.keeper, role == "operator")
        return Response(text, media_type="text/html", headers=_HEADERS)

    async def events(self, request: Request, role: str) -> Response:
        from starlette.responses import StreamingResponse

        if self.clients.now >= self.clients.limit:
            return _json({"error": "too many connections"}, 503, **{"Retry-After": "10"})
        run, _, since = request.headers.get("last-event-id", "").partition("-")
        known = run == self.keeper.run_id and since.isdecimal()
        stream = _events(self.keeper, self.clients, int(since) if known else None)
        return StreamingResponse(stream, media_type="text/event-stream", headers=_HEADERS | {"X-Accel-Buffering": "no"})

    async def tile(self, request: Request, role: str) -> Response:
        """A tile of a chart of the user; 204 where the chart has none there."""
        from starlette.responses import Response

        charts, number = self.keeper.settings.watch.chart, int(request.path_params["number"])
        chart = read_chart(charts[number]) if number < len(charts) else None
        if not isinstance(chart, Chart):
            return _json({"error": "the watch has no such chart of tiles"}, 404)
        zoom, column, row = (int(request.path_params[name]) for name in ("zoom", "column", "row"))
        try:
            found = await asyncio.to_thread(chart.tile, zoom, column, row)
        except InputError as error:
            return _json({"error": str(error)}, 500)
        if found is None:
            return Response(status_code=204, headers=_HEADERS)
        # The chart stays the same while the watch runs; the pictures are for this reader only.
        headers = _HEADERS | {"Cache-Control": "private, max-age=600"}
        return Response(found[0], media_type=found[1], headers=headers)

    async def history(self, request: Request, role: str) -> Response:
        with self.keeper.lock:
            situations = list(self.keeper.history)
        return _json({"frames": [
            {"t": situation.time_s, "objects": list(situation.object_rows.values())} for situation in situations
        ]})  # fmt: skip

    async def objects(self, request: Request, role: str) -> Response:
        situation = self.keeper.situation
        listed = [] if situation is None else situation.listed()
        return _json({"time_s": None if situation is None else situation.time_s, "objects": listed})

    async def objects_geojson(self, request: Request, role: str) -> Response:
        from starlette.responses import Response

        situation = self.keeper.situation
        content = {"type": "FeatureCollection", "features": []} if situation is None else geojson(situation)
        return Response(json.dumps(content, allow_nan=False), media_type="application/geo+json", headers=_HEADERS)

    async def why(self, request: Request, role: str) -> Response:
        from starlette.responses import PlainTextResponse

        # In a thread: an explanation of a large group takes some milliseconds.
        text = await asyncio.to_thread(self.keeper.why, int(request.path_params["number"]))
        return PlainTextResponse(text, headers=_HEADERS)

    async def alarms(self, request: Request, role: str) -> Response:
        return _json({"alarms": self.keeper.alarm_list()})

    async def acknowledge(self, request: Request, role: str) -> Response:
        done = self.keeper.acknowledge(int(request.path_params["alarm"]), _who(request))
        return _json({"acknowledged": done}, 200 if done else 404)

    async def hold(self, request: Request, role: str) -> Response:
        """Keeps the biases of a source as they are (POST), or releases them (DELETE)."""
        held = request.method == "POST"
        done = self.keeper.offsets.hold(str(request.path_params["source"]), held, _who(request))
        return _json({"held": held} if done else {"error": "there is no such source"}, 200 if done else 404)

    async def offset(self, request: Request, role: str) -> Response:
        """Sets one bias of a source by hand: JSON with bias, value and, if not that of its name, unit."""
        source = str(request.path_params["source"])
        try:
            bias, value = read_offset(await _short_body(request))
            done = self.keeper.offsets.set(source, bias, value, _who(request))
        except InputError as error:
            return _json({"error": str(error)}, 400)
        return _json({"set": {bias: value}} if done else {"error": "there is no such source"}, 200 if done else 404)

    async def prometheus(self, request: Request, role: str) -> Response:
        from starlette.responses import PlainTextResponse

        return PlainTextResponse(metrics(self.keeper.health(), list(self.keeper.durations_s)), headers=_HEADERS)

    async def health(self, request: Request) -> Response:
        """The state, for everyone; without a token only whether all is well."""
        state = self.keeper.health()
        full = self.access.accepts_host(request.headers.get("host", "")) and self._role_of(request) is not None
        return _json(state if full else {"ok": state["ok"]}, 200 if state["ok"] else 503)


async def _events(keeper: Keeper, clients: Clients, since: int | None) -> AsyncIterator[str]:
    """Server-sent events: the whole situation, or the deltas missed since tick ``since``; then one delta per tick,
    until the watch ends."""
    listener, sent = keeper.listen(), since
    clients.now += 1
    try:
        while True:
            with keeper.lock:
                situation, deltas = keeper.situation, list(keeper.deltas)
            if situation is not None:
                missed = [] if sent is None else [delta for delta in deltas if delta.tick > sent]
                known = sent is not None and (missed[0].tick == sent + 1 if missed else sent == situation.tick)
                if not known:
                    yield sse_event("whole", keeper, situation, Delta.between(None, situation))
                else:
                    for delta in missed:
                        yield sse_event("delta", keeper, situation, delta)
                sent = situation.tick
            if keeper.ended:
                return
            listener.clear()
            try:
                await asyncio.wait_for(listener.wait(), SIGN_OF_LIFE_S)
            except TimeoutError:
                yield ": still here\n\n"
    finally:
        clients.now -= 1
        keeper.leave(listener)


def sse_event(kind: str, keeper: Keeper, situation: Situation, delta: Delta) -> str:
    """A server-sent event, "whole" or "delta": what a page shows of a situation, as JSON."""
    own = situation.own_ship
    content = {
        "tick": delta.tick, "t": delta.time_s, "whole": kind == "whole", "objects": delta.objects,
        "gone": delta.removed_objects, "records": delta.records, "lost": delta.removed_records,
    }  # fmt: skip
    if delta.tick == situation.tick:
        content |= {
            "own": None if own is None else {
                "x": round(own.x_m, 1), "y": round(own.y_m, 1), "vx": round(own.vx_m_per_s, 2),
                "vy": round(own.vy_m_per_s, 2),
                "heading": None if math.isnan(own.heading_deg) else round(own.heading_deg, 1),
            },
            "geographic": keeper.picture.plane is not None,
            "berthed": sorted(keeper.approaches.berthed),
            "cpa": {n: [round(metres), round(seconds)] for n, (metres, seconds) in situation.cpa.items()},
            "alarms": keeper.alarm_list(most_ended=100), "zones": keeper.zones.outlines,
            "alignment": keeper.offsets.in_words(), "errors": [*keeper.picture.doubts, *keeper.picture.errors],
        }  # fmt: skip
    data = json.dumps(content, allow_nan=False, separators=(",", ":"))
    return f"id: {keeper.run_id}-{delta.tick}\nevent: {kind}\ndata: {data}\n\n"


def live_page(keeper: Keeper, operator: bool) -> str:
    """The map page with the current picture; the event stream continues from it."""
    watch, plane = keeper.settings.watch, keeper.picture.plane
    with keeper.lock:
        situation = keeper.situation
    empty: Mapping[str, Any] = {}
    objects, records = (empty, empty) if situation is None else (situation.objects, situation.records)
    # A site in degrees has no place in metres of one's own, nor the reverse.
    sensors = [MapSensor.of(source.description, plane) for source in keeper.settings.sources.values()
               if (site := source.description.site) is None or (site.lat_deg is None) == (plane is None)]  # fmt: skip
    sensors += [MapSensor(name, source.description.kind) for name, source in keeper.settings.sources.items()
                if name not in {sensor.name for sensor in sensors}]  # fmt: skip
    carrier = keeper.own_ship.carrier
    sensors = [replace(sensor, kind=OWN_POSITIONS) if sensor.name == carrier else sensor for sensor in sensors]
    instant_s = keeper.now_s() if situation is None else situation.time_s
    charts = [read_chart(path) for path in watch.chart]
    # The first one is the land.
    lines = [] if plane is None else [chart.in_plane(plane) for chart in charts if isinstance(chart, Coast)]
    title = "Live picture" if keeper.clock.pace is None else f"Replay, {keeper.clock.pace:g} × real time"
    sheet = MapSheet.of(
        title, _filled(objects), records, instants_s=np.array([instant_s]), sensors=sensors, plane=plane,
        ground=lines[0] if lines else None, overlays=lines[1:],
    )  # fmt: skip
    live = {
        "object": list(OBJECT), "record": list(RECORD), "operator": operator, "tick": watch.every_s,
        "every": max(10.0, watch.every_s), "history": watch.history_s,
        "word": "live" if keeper.clock.pace is None else "replay",
        "charts": _charts(watch.chart, charts),
        "offsets": {bias: [words, list(units)] for bias, (words, units) in OFFSETS.items()},
    }  # fmt: skip
    return map_page(sheet, live)


def _charts(paths: Sequence[str], charts: Sequence[Coast | Chart]) -> list[dict[str, Any]]:
    """What the page is told of each chart. overlay : number of the overlay; None for the land."""
    out: list[dict[str, Any]] = []
    n_lines = 0
    for path, chart in zip(paths, charts, strict=True):
        name = {"name": Path(path).stem}
        if isinstance(chart, Chart):
            out.append(name | {"zooms": chart.zooms, "bounds": chart.bounds_deg, "credit": chart.credit})
        else:
            out.append(name | {"overlay": n_lines - 1 if n_lines else None})
            n_lines += 1
    return out


def _filled(objects: Mapping[str, Any]) -> dict[str, Any]:
    return {name: column for name, column in objects.items() if name not in ("sources", "members")} | (
        {"runner_up": np.full(len(objects["object"]), "", object)} if objects else {}
    )
