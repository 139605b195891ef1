"""Settings of a live picture: a TOML file of the sensors with their wires, and a table ``[watch]`` for the whole.

    [watch]
    every_s = 1
    own_ship = { lat_deg = 50.55, lon_deg = -0.95 }       # or { mmsi = "235000001" }, or { source = "bridge" }

    [sources.coast]
    kind = "ais"
    input = "udp://239.192.0.4:60004"

    [sources.quay]
    kind = "air radar"
    input = { url = "udp://239.1.1.1:8600", sensor = "048 25/201" }

Sources may share a wire. ``sensor`` selects one of several sensors on it, by the end of its name in a file (``ais``,
``arpa``, ``048 SAC/SIC``); without it, AIS reports go to the source of kind AIS and radar targets to the radar.
"""

from __future__ import annotations

import difflib
import math
import os
import ssl
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from sameas.errors import InputError, reading
from sameas.io.sensors.format import ReadOptions
from sameas.io.sensors.recording import RecordedInput, RecordedSource
from sameas.io.sensors.report_formats import ZONED
from sameas.io.sensors.sources import setting_aside
from sameas.io.sensors.stream import STREAM_FORMATS
from sameas.live.inputs import require_readable
from sameas.live.websocket import Login
from sameas.live.zones import Zone, read_zones, require_names, zone_of
from sameas.maps.geojson import Coast, read_coast
from sameas.maps.tiles import Chart, is_tiles, open_chart
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.kinds import CARRIER_KIND, KINDS
from sameas.tracks.source import Description, source_tables

#: Other names of stream formats.
_FORMATS = {
    "ais": "nmea", "arpa": "nmea", "ttm": "nmea", "nmea0183": "nmea", "nmea 0183": "nmea", "basestation": "sbs",
    "nmea2000": "n2k", "nmea 2000": "n2k", "candump": "n2k", "canboat": "n2k", "actisense": "n2k",
    "ais-catcher": "gpsd", "aprs": "ogn", "flarm": "ogn",
    "aircraft.json": "aircraft", "readsb": "aircraft", "json": "table", "jsonl": "table", "csv": "table",
}  # fmt: skip


@dataclass(frozen=True)
class OwnShip:
    """Own ship: a fixed position, the object with an MMSI, or the own-ship sentences on the wire of a source."""

    lat_deg: float | None = None
    lon_deg: float | None = None
    mmsi: str | None = None
    source: str | None = None


@dataclass(frozen=True)
class WatchSettings:
    """The table ``[watch]``.

    every_s : time between ticks. lag_s : largest delay of a report. behind_s : delay of the picture behind the clock.
    register_every_s : time between two estimates of the sources' biases; 0: never.
    plane : origin of the plane; the first site or position if not given.
    own_ship : for CPA and TCPA. cpa_m, tcpa_s : an object with a smaller CPA and TCPA raises an alarm. If cpa_m is not
        given, it is 0.5 nm while own ship makes way, and there is no alarm while she does not: a radar on shore, or a
        ship in port, has many vessels close by.
    harbour_kn : while own ship is slower, an object that is alongside is an alarm only if it is about to be hit; 0: as
        any other is (:mod:`sameas.live.approaches`).
    silent_s : a source without reports for this long, or since the start, raises an alarm. clock_s : so does a source
        whose time stamps differ from the receive times by more.
    faults_every_s : time between two searches of the last minutes for deception and source faults; 0: never. Two
        successive searches must find a fault before it raises an alarm.
    return_h : a ship or an aircraft that names itself and returns within these hours has its object number again.
    archive_every_s : time between archived ticks; 0: none. history_s : span of the history on the page.
    save_every_s : time between two writes of the state.
    outputs : ``udp://HOST:PORT`` with a format: ``{ url = …, format = "nmea" }``.
    record : folder into which the received bytes are written, hour by hour. record_hours : files that are older are
        deleted; 0: none are.
    chart : GeoJSON, MBTiles or PMTiles files, drawn below the objects, the first one lowest. The first GeoJSON is the
        land, others are lines.
    zones : guard zones, GeoJSON files or tables (:mod:`sameas.live.zones`); an object inside raises an alarm.
    """

    every_s: float = 1.0
    lag_s: float = 10.0
    behind_s: float = 0.0
    register_every_s: float = 60.0
    plane: Mapping[str, float] | None = None
    own_ship: OwnShip | None = None
    cpa_m: float | None = None
    tcpa_s: float = 1200.0
    harbour_kn: float = 10.0
    silent_s: float = 60.0
    clock_s: float = 30.0
    faults_every_s: float = 30.0
    return_h: float = 24.0
    archive_every_s: float = 10.0
    history_s: float = 1800.0
    save_every_s: float = 5.0
    outputs: tuple[Mapping[str, str], ...] = ()
    record: str | None = None
    record_hours: float = 0.0
    chart: tuple[str, ...] = ()
    zones: tuple[Zone, ...] = ()

    @property
    def origin(self) -> LocalPlane | None:
        """The plane about the given origin; None if it is not given."""
        return None if self.plane is None else LocalPlane(self.plane["lat_deg"], self.plane["lon_deg"])


@dataclass(frozen=True)
class LiveSource:
    """One source: description, wire (None: replayed from files), format. sensor : its name on a shared wire.

    login : to the server of its wire.
    """

    description: Description
    url: str | None = None
    format: str | None = None
    sensor: str | None = None
    options: ReadOptions = field(default_factory=ReadOptions)
    login: Login | None = None

    @property
    def recorded(self) -> RecordedSource:
        """What a recording of its wire says of it."""
        return RecordedSource(self.description.name, self.description.kind, self.sensor)


@dataclass(frozen=True)
class Settings:
    """All sources by name, and the options of the watch. set_aside : by name, why other sources cannot be used."""

    sources: Mapping[str, LiveSource]
    watch: WatchSettings = field(default_factory=WatchSettings)
    set_aside: Mapping[str, str] = field(default_factory=dict)

    def with_zones(self, paths: Iterable[str | Path]) -> Settings:
        """With the guard zones of GeoJSON files besides those it has; refused as of :func:`read_zones`."""
        zones = (*self.watch.zones, *(zone for path in paths for zone in read_zones(path)))
        require_names(zones, "--zones")
        return replace(self, watch=replace(self.watch, zones=zones))

    def recorded_input(self, url: str) -> RecordedInput:
        """What a recording of a wire says of it."""
        on_wire = [source for source in self.sources.values() if source.url == url]
        options = on_wire[0].options
        given = {"columns": options.columns, "units": options.units, "time_zone": options.time_zone}
        given = {name: value for name, value in given.items() if value}
        return RecordedInput(tuple(source.recorded for source in on_wire), on_wire[0].format, given)


def read_settings(path: str | Path, *, set_aside: dict[str, InputError] | None = None) -> Settings:
    """The settings of a TOML file.

    set_aside : receives the errors of sources that cannot be used, by name. Without it, the first one is raised.

    Raises InputError: not TOML, no sources, an unknown name, an invalid value.
    """
    tables = source_tables(path)
    content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    with reading(str(path), "is not a description of a watch"):
        sources: dict[str, LiveSource] = {}
        platforms = [table.get("platform") for table in tables.values()]
        carriers = {one.get("source") for one in platforms if isinstance(one, Mapping)}
        for name, table in tables.items():
            kind = {"kind": CARRIER_KIND} if name in carriers else {}
            with setting_aside(name, set_aside):
                sources[name] = _source(name, kind | dict(table), f"{path}: sources.{name}")
        return Settings(sources, _watch(content.get("watch", {}), f"{path}: watch", tables))


def _instead_of(key: str, known: Iterable[str]) -> str:
    """The remedy for an unknown name: the one that it resembles, else all."""
    names = sorted(known)
    near = difflib.get_close_matches(key, names, 1, 0.6)
    return f"did you mean {near[0]}?" if near else f"give {', '.join(names)}"


def _source(name: str, table: Mapping[str, Any], where: str) -> LiveSource:
    for key in table:
        if key not in ("input", "file") and difflib.get_close_matches(key, ("input",), 1, 0.8):
            raise InputError(f"{where}: {key!r} is not known; did you mean input?")
    described = {key: value for key, value in table.items() if key not in ("input", "file", "sac_sic")}
    given = table.get("input")
    given = {"url": given} if isinstance(given, str) else {} if given is None else given
    if not isinstance(given, Mapping):
        raise InputError(f'{where}.input is {given!r}; give "udp://HOST:PORT", or {{ url = "…", format = "…" }}')
    known = ("url", "format", "sensor", "columns", "units", "time_zone", *(f.name for f in fields(Login)))
    for key in given:
        if key not in known:
            raise InputError(f"{where}.input: {key!r} is not known", _instead_of(key, known))
    if given.get("format") not in (None, *STREAM_FORMATS):
        format_name = _FORMATS.get(str(given["format"]).lower())
        hint = f"give {format_name}" if format_name else f"give one of {', '.join(STREAM_FORMATS)}"
        raise InputError(f"{where}.input: format is {given['format']!r}; {hint}")
    zone = given.get("time_zone")
    if not isinstance(zone, str | None):
        raise InputError(f"{where}.input: time_zone is {zone!r}", 'give a text such as "Europe/Berlin"')
    if given and "kind" not in described:
        raise InputError(f"{where}: has no kind", f'give kind = "…", one of {", ".join(KINDS)}')
    if zone is not None and given.get("format") not in (None, *ZONED):
        raise InputError(
            f"{where}.input: the times of {given['format']} have no time_zone: they are UTC", "leave it out"
        )
    if isinstance(url := given.get("url"), str):
        require_readable(url)
    description = Description.from_mapping(name, described)
    if given and (description.motion.acceleration_m2_per_s3 is None or description.misses.q is None):
        raise InputError(
            f"{where}: its kind {description.kind!r} assumes neither the motion of objects nor how many it misses",
            "give motion = { acceleration_m2_per_s3 = …, speed_m_per_s = … } and misses = { q = … }",
        )
    options = ReadOptions(
        name, columns=given.get("columns"), units=given.get("units"), kind=description.kind, time_zone=zone
    )
    login = _login(given, f"{where}.input")
    sensor = given.get("sensor", table.get("sac_sic"))
    return LiveSource(description, given.get("url"), given.get("format"), sensor, options, login)


def _login(given: Mapping[str, Any], where: str) -> Login | None:
    """The login in an input; a secret may be in the environment: { env = "NAME" }."""
    texts = {f.name: _secret(given[f.name], f"{where}.{f.name}") for f in fields(Login) if f.name in given}
    if not texts:
        return None
    scheme = str(given.get("url", "")).partition(":")[0]
    for name in texts:
        schemes = ("wss", "https") if name in ("ca_file", "server_name") else ("ws", "wss")
        if scheme not in schemes:
            raise InputError(f"{where}: {name} is for {schemes[0]}:// and {schemes[1]}:// only", "leave it out")
    if "password" in texts and "username" not in texts:
        raise InputError(f"{where}: password, but no username; give both")
    folder = Path(where.split(": ")[0]).parent
    access_file, ca_file = (folder / texts[name] if name in texts else None for name in ("access_file", "ca_file"))
    login = Login(texts.get("token"), texts.get("username"), texts.get("password"), access_file, ca_file,
                  texts.get("server_name"))  # fmt: skip
    try:
        login.tls()
    except OSError as error:
        reason = "holds no certificate in PEM form" if isinstance(error, ssl.SSLError) else error.strerror
        raise InputError(f"{where}.ca_file: {ca_file}: {reason}", "give that of the server or its authority") from None
    return login


def _secret(value: Any, where: str) -> str:
    if isinstance(value, Mapping) and set(value) == {"env"} and isinstance(value["env"], str):
        if value["env"] not in os.environ:
            raise InputError(f"{where}: the environment has no {value['env']}", "set it, or give the text here")
        value = os.environ[value["env"]]
    # The value itself is in no message.
    if not isinstance(value, str) or not value.isprintable():
        raise InputError(f"{where} is no text of one line", 'give it in quotes, or { env = "NAME" }')
    return value


def _watch(table: Any, where: str, sources: Iterable[str]) -> WatchSettings:
    if not isinstance(table, Mapping):
        raise InputError(f"{where} is no table; give [watch]")
    known = {f.name for f in fields(WatchSettings)}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in known:
            raise InputError(f"{where}: {key!r} is not known", _instead_of(key, known))
        if key == "own_ship":
            values[key] = _own_ship(value, f"{where}.own_ship", sources)
        elif key == "plane":
            if not isinstance(value, Mapping) or set(value) != {"lat_deg", "lon_deg"}:
                raise InputError(f"{where}.plane is {value!r}; give {{ lat_deg = …, lon_deg = … }}")
            values[key] = _place(value, f"{where}.plane")
        elif key == "outputs":
            if not isinstance(value, list):
                raise InputError(f"{where}.outputs is {value!r}; give a list")
            values[key] = tuple(value)
        elif key == "record":
            if not isinstance(value, str):
                raise InputError(f"{where}.{key} is {value!r}; give the name of a folder in quotes")
            values[key] = str(Path(where.split(": ")[0]).parent / value)
        elif key == "chart":
            files = [value] if isinstance(value, str) else value
            if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
                raise InputError(f"{where}.chart is {value!r}; give the name of a file in quotes, or a list of them")
            values[key] = tuple(str(Path(where.split(": ")[0]).parent / file) for file in files)
            for file in values[key]:
                # A map without its shores is found out too late.
                read_chart(file)
        elif key == "zones":
            values[key] = _zones(value, f"{where}.zones")
        elif isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 <= value < math.inf:
            raise InputError(f"{where}.{key} is {value!r}; give a number, 0 or more")
        else:
            values[key] = float(value)
    if values.get("every_s", 1.0) <= 0.0:
        raise InputError(f"{where}.every_s is 0; give seconds above 0")
    return WatchSettings(**values)


def _zones(value: Any, where: str) -> tuple[Zone, ...]:
    """Guard zones: names of GeoJSON files beside the sensor file, and tables."""
    zones: list[Zone] = []
    for k, one in enumerate(value if isinstance(value, list) else [value]):
        if isinstance(one, str):
            zones += read_zones(Path(where.split(": ")[0]).parent / one)
        else:
            zones.append(zone_of(one, f"{where}[{k}]"))
    require_names(zones, where)
    return tuple(zones)


@lru_cache(maxsize=32)
def read_chart(path: str) -> Coast | Chart:
    """The user's chart: land and shores, or tiles; any other file is refused."""
    return open_chart(path) if is_tiles(path) else read_coast(path)


def _own_ship(given: Any, where: str, sources: Iterable[str]) -> OwnShip:
    known = [f.name for f in fields(OwnShip)]
    if not isinstance(given, Mapping) or not given or not set(given) <= set(known):
        raise InputError(f"{where} is {given!r}; give lat_deg and lon_deg, mmsi, or source")
    if ("lat_deg" in given) != ("lon_deg" in given):
        present, missing = ("lat_deg", "lon_deg") if "lat_deg" in given else ("lon_deg", "lat_deg")
        raise InputError(f"{where}: {present}, but not {missing}; give both")
    mmsi, source = given.get("mmsi"), given.get("source")
    if isinstance(mmsi, int) and not isinstance(mmsi, bool):
        mmsi = f"{mmsi:09d}"
    if not isinstance(mmsi, str | None):
        raise InputError(f"{where}.mmsi is {mmsi!r}; give it in quotes")
    if source is not None and source not in list(sources):
        raise InputError(f"{where}.source is {source!r}; give one of {', '.join(sources)}")
    return OwnShip(mmsi=mmsi, source=source, **_place(given, where))


def _place(given: Mapping[str, Any], where: str) -> dict[str, float]:
    """The latitude and longitude of a table; empty where it has none."""
    place: dict[str, float] = {}
    for name, most in (("lat_deg", 90.0), ("lon_deg", 360.0)):
        value = given.get(name)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= most:
            raise InputError(f"{where}.{name} is {value!r}; give degrees within ±{most:g}")
        place[name] = float(value)
    return place
