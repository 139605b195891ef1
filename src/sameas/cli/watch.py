"""``sameas watch``: the picture live, from what sensors send or from files that are replayed."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import math
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sameas.cli.options import Debug, Quiet, in_options, option, sensor_option
from sameas.cli.outcome import INPUT_ERROR, answering
from sameas.cli.picture import duration_s
from sameas.cli.terminal import Printer, share_compilation
from sameas.errors import InputError, optional
from sameas.io.atomic import FolderHeld
from sameas.report.prose import ALARM, DOUBT
from sameas.representation import count, counted

if TYPE_CHECKING:
    from socket import socket

    import uvicorn

    from sameas.live.alarms import AlarmLog
    from sameas.live.inputs import Wire
    from sameas.live.keeper import Keeper
    from sameas.live.replay import Playback, Replay
    from sameas.live.server import Access, TlsCertificate
    from sameas.live.settings import Settings

LOG = logging.getLogger("sameas.live")
#: Alarms of one condition that have a line of their own, and the seconds for which those after them are counted.
FEW, CROWD_S = 5, 60.0
#: Seconds after which a watch in standby asks again whether it is its turn.
STANDBY_S = 0.5
_INPUTS, _MAP = "What is read", "The map"


def watch(
    files: Annotated[list[str] | None, typer.Argument(
        metavar="[FILE]...", show_default=False,
        help="Files, or a folder of --record, to replay instead of live inputs, as for sameas picture. NAME=FILE "
        "names the source.",
    )] = None,
    sensors: Annotated[Path | None, option(
        "--sensors", "-s", metavar="TOML",
        help="Descriptions of the sensors and their inputs: udp://, tcp://, tcp-listen://, http://, serial:, stdin:.",
    )] = None,
    output: Annotated[Path | None, option(
        "-o", "--output", metavar="FOLDER",
        help="Folder of state, journal and archive; a watch that was stopped resumes from it.",
    )] = None,
    pace: Annotated[float, option(
        "--pace", panel=_INPUTS, metavar="N", show_default=True, help="Replay N times as fast as recorded.",
    )] = 1.0,
    as_received: Annotated[bool, option(
        "--as-received", panel=_INPUTS,
        help="Replay recordings by the times of receipt, not by those of the reports: late reports and clocks that "
        "jump come again as they came.",
    )] = False,
    record: Annotated[Path | None, option(
        "--record", panel=_INPUTS, metavar="FOLDER", help="Record what is received; the folder can be replayed.",
    )] = None,
    every: Annotated[str | None, option("--every", panel=_INPUTS, metavar="1s", help="Time between instants.")] = None,
    start: Annotated[str | None, option(
        "--start", panel=_INPUTS, metavar="TIME", help="UTC of the first line, for files without a date.",
    )] = None,
    duration: Annotated[
        str | None, option("--for", panel=_INPUTS, metavar="10s", help="End after this long; otherwise with Ctrl-C.")
    ] = None,
    host: Annotated[
        str, option(
            "--host", panel=_MAP, metavar="ADDRESS", show_default=True,
            help="Address of the map; other machines need a token.",
        )
    ] = "127.0.0.1",
    port: Annotated[
        int, option("--port", panel=_MAP, metavar="N", show_default=True, help="Port of the map; 0: any free one.")
    ] = 8642,
    token: Annotated[
        str | None, option("--token", panel=_MAP, metavar="TEXT", help="Token that may acknowledge alarms.")
    ] = None,
    viewer_token: Annotated[
        str | None, option("--viewer-token", panel=_MAP, metavar="TEXT", help="Token that may only view.")
    ] = None,
    certificate: Annotated[Path | None, option(
        "--certificate", panel=_MAP, metavar="PEM",
        help="Serve https, with this certificate and its private key; without it the map is not encrypted.",
    )] = None,
    key: Annotated[Path | None, option(
        "--key", panel=_MAP, metavar="PEM", help="The private key, if it is in a file of its own.",
    )] = None,
    chart: Annotated[list[Path] | None, option(
        "--chart", panel=_MAP, metavar="FILE",
        help="Chart below the objects: MBTiles, PMTiles or GeoJSON of land; again for charts above it.",
    )] = None,
    zones: Annotated[list[Path] | None, option(
        "--zones", metavar="GEOJSON",
        help="Guard zones: polygons, or points with radius_m; an object inside raises an alarm. Again for more.",
    )] = None,
    no_map: Annotated[bool, option("--no-map", panel=_MAP, help="Serve no map.")] = False,
    standby: Annotated[bool, option(
        "--standby", help="While another watch uses the folder of -o: wait, and take over when it has ended.",
    )] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:  # fmt: skip
    """The picture live: which of the sensors' records are the same ship or aircraft, while it happens.

    Reads what sensors send, or replays files; serves a map; keeps a journal of identities; sends to other programs.
    """
    if not files and sensors is None:
        raise typer.BadParameter("give --sensors with a TOML file that has inputs, or files to replay")
    with answering(debug, sensor_option):
        from sameas.live.keeper import Keeper
        from sameas.live.server import Access, TlsCertificate

        access = Access.of(host, token, viewer_token)
        if key is not None and certificate is None:
            raise InputError(f"{key}: the key of which certificate?", "give --certificate, too")
        secured = None if certificate is None else TlsCertificate.of(certificate, key)
        every_s, replay, playback = duration_s(every), None, None
        if as_received:
            settings, playback = recorded_inputs(files or [], sensors, pace)
        else:
            settings, replay = settings_of(files or [], sensors, start, pace)
        if every_s is not None:
            settings = replace(settings, watch=replace(settings.watch, every_s=every_s))
        settings = _with_charts(settings, chart) if chart else settings
        settings = settings.with_zones(zones) if zones else settings
        if record is not None and (replay or playback) is not None:
            raise InputError("--record: files are replayed, and nothing is received", "leave it out")
        settings = settings if record is None else replace(settings, watch=replace(settings.watch, record=str(record)))
        if standby and (output is None or (replay or playback) is not None):
            raise InputError("--standby: takes over from a watch of inputs", "give its folder with -o, and no files")
        share_compilation(quiet, "picture")
        to_stdout = any(str(sink.get("url", "")).startswith("stdout:") for sink in settings.watch.outputs)
        say = Printer(quiet, sys.stderr if to_stdout else None)
        keeper = _in_turn(partial(Keeper, settings, output, replay=replay, playback=playback), standby, say)
        until_s = None if duration is None else time.monotonic() + (duration_s(duration) or 0.0)
        say(f"{DOUBT}set aside: {words}" for words in settings.set_aside.values())
        say(f"{DOUBT}{line}" for line in (replay.apart() if replay else ()))
        if keeper.restored:
            say([_resumption(keeper)])
        server = None if no_map else _server(keeper, access, port, secured, say)
        # What is imported stays. Each collection of the rest stops the picture, so there are many short ones.
        gc.freeze()
        gc.set_threshold(100_000, 50, 100)
        kept = "" if output is None else "; objects keep their numbers"
        edited = EditedFile(
            None if playback or replay else sensors, f"end this watch and begin it again to use it{kept}"
        )
        asyncio.run(_run(keeper, server, until_s, say, edited))
        state = keeper.health()
        say([f"Watched: {counted(state['tick'], 'instant')}, {counted(state['objects'], 'object')} in the last"])
        if (waited_s := keeper.clock.waited_s) > 5.0:
            say([f"  The replay waited {waited_s:.0f} s for the picture: it was slower than --pace {pace:g}"])
        for name, one in state["sources"].items():
            say(source_lines(name, one))
    if settings.set_aside:
        raise typer.Exit(INPUT_ERROR)


def _in_turn(begin: Callable[[], Keeper], waits: bool, say: Printer) -> Keeper:
    """The keeper, if it waits as soon as no other process uses its folder."""
    waiting = False
    while True:
        try:
            keeper = begin()
        except FolderHeld as error:
            if not waits:
                raise
            if not waiting:
                say([f"Standby: {error.message}; this watch takes over when that one has ended"])
            waiting = True
            time.sleep(STANDBY_S)
        else:
            if waiting:
                say([f"Taken over at {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"])
            return keeper


def _resumption(keeper: Keeper) -> str:
    """Printable: from when the state is that is continued, and which sources have changed since."""
    when = datetime.fromtimestamp(keeper.picture.instant_s, UTC) if keeper.picture.instant_s > 0.0 else None
    changed = f"; new or described differently since: {', '.join(keeper.changed)}" if keeper.changed else ""
    at = "its start" if when is None else f"{when:%Y-%m-%d %H:%M:%S} UTC"
    return f"Resumed: {keeper.folder} of {at}; objects keep their numbers{changed}"


def source_lines(name: str, health: dict[str, Any]) -> list[str]:
    """Printable: the counters of a source, and its biases; health : of the source, from ``Keeper.health``."""
    aside = [f"{count(health[word])} {word}" for word in ("late", "repeated", "refused") if health[word]]
    aside += [f"{count(health['jumps'])} where its object cannot be"] if health["jumps"] else []
    aside += [f"{count(health['unplaced'])} without a position"] if health["unplaced"] else []
    words = "".join(f", {each}" for each in aside)
    error = f"; {health['error']}" if health["error"] else ""
    lines = [f"  {name}: {counted(health['reports'], 'report')}{words}{error}"]
    if (biases := health["biases"]) is not None:
        lines.append(f"    {biases['text']}, {'subtracted' if biases['established'] else 'NOT ESTABLISHED'}")
    return lines


def settings_of(
    files: list[str], sensors: Path | None, start: str | None, pace: float
) -> tuple[Settings, Replay | None]:
    """The settings, and the replay if files are given. Sources that cannot be used are set aside, if others can."""
    from sameas.io.sensors.sources import read_source_options, read_sources
    from sameas.live.replay import Replay
    from sameas.live.settings import LiveSource, Settings, WatchSettings, read_settings
    from sameas.tracks.scene import Scene

    aside: dict[str, InputError] = {}
    settings = Settings({}, WatchSettings()) if sensors is None else read_settings(sensors, set_aside=aside)
    live, replay = dict(settings.sources), None
    if files or not any(source.url for source in live.values()):
        options = {} if sensors is None else read_source_options(sensors, set_aside=aside)
        if not files and not aside and not any(one.path for one in options.values()):
            raise InputError(
                f"{sensors}: no source has an input",
                'give input = "udp://HOST:PORT", "tcp://HOST:PORT", "serial:…" in its table, or files to replay',
            )
        sources = read_sources(list(files), options, start=start, set_aside=aside)
        # The plane is centred on all positions, not on the first.
        scene = Scene.of([(source.description, source.reports) for source in sources], set_aside=aside)
        sources = [source for source in sources if source.description.name not in aside]
        replay = Replay([(source.description.name, source.reports) for source in sources], pace, scene.plane)
        live = {source.description.name: LiveSource(source.description) for source in sources}
        settings = _with_own_ship(settings, replay)
    else:
        for name in [name for name, source in live.items() if source.url is None]:
            aside[name] = InputError(f"{name}: has no input", 'give input = "udp://HOST:PORT", serial: … in its table')
            del live[name]
    words = {name: in_options(error.words, sensor_option) for name, error in aside.items()}
    return Settings(live, settings.watch, words), replay


def _with_own_ship(settings: Settings, replay: Replay) -> Settings:
    """The settings with the ship that wrote the replayed log as own ship, unless they name one."""
    from sameas.io.sensors.format import OWN_SHIP
    from sameas.live.settings import OwnShip

    logs = [name for name, reports in replay.sources if OWN_SHIP["lat"] in reports.extra]
    if settings.watch.own_ship is not None or not logs:
        return settings
    return replace(settings, watch=replace(settings.watch, own_ship=OwnShip(source=logs[-1])))


def recorded_inputs(files: list[str], sensors: Path | None, pace: float) -> tuple[Settings, Playback]:
    """The settings, and recordings to replay as they were received on the inputs of these."""
    from sameas.io.sensors.recording import Recording, recordings
    from sameas.live.replay import Playback
    from sameas.live.settings import read_settings

    if sensors is None or not files:
        raise InputError("--as-received: which inputs are recorded?", "give --sensors, and the folder of --record")
    settings = read_settings(sensors)
    played = []
    for file in files:
        for recorded in recordings(Path(file)):
            recording = Recording.of(recorded)
            names = [source.name for source in recording.recorded.sources]
            urls = {settings.sources[name].url for name in names if name in settings.sources} - {None}
            if len(urls) != 1:
                known = f"{sensors} has no input for" if not urls else f"{sensors} has several inputs for"
                raise InputError(f"{file}: {known} {', '.join(names)}", "give the sensor file of that watch")
            played.append((str(urls.pop()), recording))
    return settings, Playback(played, pace)


def _with_charts(settings: Settings, charts: Sequence[Path]) -> Settings:
    from sameas.live.settings import read_chart

    for chart in charts:
        read_chart(str(chart))
    return replace(settings, watch=replace(settings.watch, chart=tuple(map(str, charts))))


def _server(
    keeper: Keeper, access: Access, port: int, certificate: TlsCertificate | None, say: Printer
) -> tuple[uvicorn.Server, socket]:
    """The server and its socket; prints the address of the map."""
    from socket import AF_INET, AF_INET6, SO_REUSEADDR, SOL_SOCKET, socket

    with optional("the live map needs Starlette and uvicorn", "live", "or give --no-map"):
        import uvicorn
    from sameas.live.server import application

    listener = socket(AF_INET6 if ":" in access.host else AF_INET)
    listener.setsockopt(SOL_SOCKET, SO_REUSEADDR, 1)
    try:
        listener.bind((access.host, port))
    except OSError as error:
        listener.close()
        raise InputError(
            f"{access.host}:{port} cannot be served on ({error.strerror})", "give another --port"
        ) from error
    # The map has server-sent events; looking for WebSockets would import a package that other versions warn about.
    config = uvicorn.Config(
        application(keeper, access),
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=1,
        ws="none",
        ssl_certfile=None if certificate is None else certificate.file,
        ssl_keyfile=None if certificate is None else certificate.key,
    )
    say(map_addresses(access, listener.getsockname()[1], "http" if certificate is None else "https"))
    return uvicorn.Server(config), listener


def map_addresses(access: Access, port: int, scheme: str = "http") -> list[str]:
    """Printable: the addresses of the map for those who may acknowledge, and for those who may look only."""
    from socket import gethostname

    # An address that stands for all of this machine cannot be given to others.
    host = access.host
    name = gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    map_at = f"{scheme}://{name}:{port}/"
    if access.operator is None:
        return [f"Map: {map_at}"]
    lines = [f"Map: {map_at}?token={access.operator}"]
    if access.viewer is not None:
        lines.append(f"  to look only: {map_at}?token={access.viewer}")
    if scheme == "http":
        lines.append("  not encrypted: the token can be read on the network; --certificate serves https")
    return lines


class News:
    """Lines on what has changed since the last call: connections, and alarms that begin.

    A forger can raise hundreds of alarms. Of each condition the first :data:`FEW` within a minute have a line of their
    own, and those after them a count. An approach is a danger of its own: of these every call names the first.

    names_own_ship : whether the settings do; if not, the input that has her position is named once.
    """

    def __init__(
        self,
        wires: Mapping[str, Wire],
        alarms: AlarmLog,
        clock: Callable[[], float] = time.monotonic,
        *,
        names_own_ship: bool = True,
    ) -> None:
        self.wires, self.alarms, self.clock, self.names_own_ship = wires, alarms, clock, names_own_ship
        self.connections: dict[str, str] = {}
        self.crowds: dict[str, _Crowd] = defaultdict(_Crowd)

    def __call__(self) -> list[str]:
        lines, now_s = [], self.clock()
        for url, wire in self.wires.items():
            words = str(wire.state)
            if words and words != self.connections.get(url):
                self.connections[url] = words
                lines.append(f"  {url.rstrip(':')}: {words}")
            if not self.names_own_ship and math.isfinite(wire.stream.own_ship[0]):
                self.names_own_ship = True
                lines.append(f"  {url} has own ship's position: the map shows her, and approaches are watched")
        for condition, crowd in self.crowds.items():
            if condition == "cpa" or now_s - crowd.since_s >= CROWD_S:
                crowd.named, crowd.since_s = 0, now_s
        while self.alarms.begun:
            time_s, alarm = self.alarms.begun.popleft()
            crowd = self.crowds[alarm.condition]
            if crowd.named == 0:
                crowd.since_s = now_s
            crowd.last_s = time_s
            if crowd.named < FEW:
                crowd.named += 1
                lines.append(f"{ALARM}{datetime.fromtimestamp(time_s, UTC):%H:%M:%S} {alarm.text}")
            else:
                crowd.more += 1
        for condition, crowd in self.crowds.items():
            if crowd.more and (condition == "cpa" or now_s - crowd.counted_s >= CROWD_S):
                words = f"and {count(crowd.more)} more of {condition}; the page and the journal list them"
                lines.append(f"{ALARM}{datetime.fromtimestamp(crowd.last_s, UTC):%H:%M:%S} {words}")
                crowd.more, crowd.counted_s = 0, now_s
        return lines


@dataclass
class EditedFile:
    """Lines on a sensor file that was changed since the watch or the last call has read it, with the errors it has now.

    path : None: there is none. remedy : how the changes are used.
    """

    path: Path | None
    remedy: str

    def __post_init__(self) -> None:
        self._read_ns = self._changed_ns()

    def __call__(self) -> list[str]:
        changed_ns, aside = self._changed_ns(), dict[str, InputError]()
        if self.path is None or changed_ns in (0, self._read_ns):
            return []
        from sameas.live.settings import read_settings

        self._read_ns = changed_ns
        try:
            read_settings(self.path, set_aside=aside)
        except InputError as error:
            return [f"{DOUBT}{self.path} has changed, but cannot be used: {in_options(error.words, sensor_option)}"]
        lines = [f"  {self.path} has changed: {self.remedy}"]
        return lines + [f"{DOUBT}{in_options(error.words, sensor_option)}" for error in aside.values()]

    def _changed_ns(self) -> int:
        """When it was last changed; 0 where there is none, as for a moment while editors write it."""
        try:
            return 0 if self.path is None else self.path.stat().st_mtime_ns
        except OSError:
            return 0


@dataclass
class _Crowd:
    """Alarms of one condition: how many were named since when, how many were not yet, and when these were counted."""

    named: int = 0
    since_s: float = -math.inf
    more: int = 0
    counted_s: float = -math.inf
    last_s: float = 0.0


async def _run(
    keeper: Keeper,
    server: tuple[uvicorn.Server, socket] | None,
    until_s: float | None,
    say: Printer,
    edited: EditedFile,
) -> None:
    """Run the loop and the server until the time is up or a signal stops them."""
    over = asyncio.Event()
    loop = asyncio.get_running_loop()
    # Its terminal is closed, a connection over SSH lost: unless nohup has it go on, it ends as on the others.
    hangs_up = hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
    for number in (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hangs_up else [])):
        with contextlib.suppress(NotImplementedError):
            loop.add_signal_handler(number, over.set)

    def ends() -> bool:
        return over.is_set() or (keeper.clock.done if until_s is None else time.monotonic() >= until_s)

    served = None
    if server is not None:
        # Signals are handled here: they end the loop, which then ends the server.
        server[0].install_signal_handlers = lambda: None  # type: ignore[attr-defined]  # of older versions
        server[0].capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment]
        served = asyncio.create_task(server[0].serve(sockets=[server[1]]))
    news = News(keeper.wires, keeper.alarms, names_own_ship=keeper.settings.watch.own_ship is not None)

    async def tell() -> None:
        while True:
            # In a thread, because a terminal that is stopped blocks.
            try:
                await asyncio.to_thread(lambda: say([*news(), *edited()]))
            except OSError:
                LOG.exception("nothing more is printed")
                return
            await asyncio.sleep(1.0)

    printing = asyncio.create_task(tell())
    watched = asyncio.create_task(keeper.run(until=ends, stop=over))
    ending = asyncio.create_task(over.wait())
    try:
        await asyncio.wait({watched, ending}, return_when=asyncio.FIRST_COMPLETED)
        await watched
    finally:
        ending.cancel()
        printing.cancel()
        if server is not None and served is not None:
            server[0].should_exit = True
            with contextlib.suppress(asyncio.CancelledError):
                await served
            server[1].close()
        say(news())
