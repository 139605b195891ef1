"""Streams: the file formats of this package, decoded from bytes as they arrive over a wire.

A :class:`ReportStream` splits its input into lines or datagrams and passes them to the readers. The state that these
need between lines (incomplete messages, names of ships, heading of own ship) is kept from piece to piece.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from sameas.errors import InputError
from sameas.io.sensors import (
    aircraft,
    ais,
    arpa,
    asterix,
    beast,
    gpsd,
    mode_s,
    n2k,
    nmea,
    ogn,
    sbs,
    sentences,
    signalk,
    tables,
)
from sameas.io.sensors.asterix_records import looks_cut_off, looks_like, split_blocks
from sameas.io.sensors.asterix_services import Services
from sameas.io.sensors.format import ReadOptions, SensorFile
from sameas.tracks.reports import Damaged, NoReports, Reports

#: A line of more bytes is damaged: the format is a different one, or bytes were lost.
LONGEST_LINE = 4 << 20
#: Largest number of aircraft, or blocks, in the state; above it, the state is cleared.
MOST_REMEMBERED = 20_000
_CHECKSUM = re.compile(rb"\*[0-9A-Fa-f]{2}")
_MODE_S = re.compile(rb"[*@](?:[0-9A-Fa-f]{14}){1,2}(?:[0-9A-Fa-f]{12})?;|" + mode_s.IN_JSON.encode())
STREAM_FORMATS = ("nmea", "n2k", "gpsd", "sbs", "aircraft", "mode-s", "ogn", "asterix", "table", "signalk")


def format_of(data: bytes) -> str | None:
    """The format of a stream from its first bytes; None while it cannot be determined."""
    if looks_like(data):
        return "asterix"
    text = data.lstrip()
    if beast.looks_like(data) or _MODE_S.match(text):
        return "mode-s"
    if text[:1] in b"!$\\" and text:
        return "n2k" if text.startswith((b"$PCDIN,", b"!PDGY,")) else "nmea"
    if re.match(rb"(MSG|SEL|ID|AIR|STA|CLK),", text):
        return "sbs"
    if gpsd.looks_like(text):
        return "gpsd"
    # The first bytes may be the end of a line.
    lines = text.decode("ascii", errors="replace").splitlines()[:8]
    if n2k.looks_like(lines):
        return "n2k"
    if ogn.looks_like(lines):
        return "ogn"
    if text[:1] == b"{":
        # The hello message of a server has roles, or its version and own ship.
        greets = b'"roles"' in text or (b'"version"' in text and b'"self"' in text)
        if b'"updates"' in text or greets:
            return "signalk"
        return "aircraft" if re.search(rb'"(?:aircraft|ac)"\s*:\s*\[', text) else "table" if b"\n" in text else None
    # A line may begin with its receive time.
    return "nmea" if re.search(rb"[!$][A-Z]{4,9}[A-Z0-9]?,", text) else None


@dataclass
class ReportStream:
    """Decodes bytes to reports as they arrive.

    source : its name in messages; several sensors of a stream are named as in a file, NAME:ais, NAME:048 1/2.
    format : one of :data:`STREAM_FORMATS`; None: detected from the first bytes.
    options : columns and units of tables.
    carries : whether positions of own ship are reports, where the stream has nothing else: she carries another sensor.

    damaged, passed_over : number of unused lines or records by reason. sentence_kinds : those of NMEA 0183 so far.

    >>> stream = ReportStream("coast")
    >>> stream.feed(b'{"time": 1714560000, "lat": 50.1, "lon": -1.2, "mmsi"', 0.0)
    >>> stream.reports()
    []
    >>> stream.feed(b': "235070762"}\\n', 0.5)
    >>> [reports] = stream.reports()
    >>> reports.mmsi.tolist()
    ['235070762']
    """

    source: str
    format: str | None = None
    options: ReadOptions = field(default_factory=ReadOptions)
    carries: bool = False
    damaged: Counter[str] = field(default_factory=Counter)
    passed_over: Counter[str] = field(default_factory=Counter)
    sentence_kinds: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        if self.format is not None and self.format not in STREAM_FORMATS:
            raise InputError(
                f"{self.source}: {self.format!r} is not a stream format", f"give one of {', '.join(STREAM_FORMATS)}"
            )
        self._rest: dict[int, bytes] = {}
        #: Whether any line has a checksum; whether messages of transponders are Beast frames.
        self._checked, self._is_beast = False, False
        self._addresses: Counter[str] = Counter()
        self._lines: list[tuple[float, str]] = []
        self._datagrams: list[tuple[float, bytes]] = []
        self._messages: list[mode_s.Messages] = []
        self._ais_state, self._ship, self._vessels = ais.ReceiverState(), arpa.ArpaState(), signalk.Vessels()
        self._translators: dict[str, sentences.Translator] = {"n2k": n2k.Bus(), "gpsd": gpsd.JsonMessages()}
        self._latest: sbs.Latest = {}
        self._aircraft: dict[str, object] = {}
        self._transponders = mode_s.Aircraft()
        self._blocks: set[tuple[int, bytes]] = set()
        self._services = Services()
        #: Receive time of the last position of own ship.
        self.own_ship_s = -math.inf

    def feed(self, data: bytes, received_s: float, *, connection: int = 0, last: bool = False) -> None:
        """Adds bytes received at this time.

        connection : its number; an incomplete line or block waits for the next bytes of its own connection.
        last : whether nothing follows, because the bytes are a datagram or the connection ends.
        """
        rest, datagram = self._rest.pop(connection, b""), last and bool(data)
        if rest and datagram and data[:1] in (b"!", b"$", b"\\"):
            # The datagram before ended within a sentence that this one does not continue.
            rest = self._cut_off(rest) + b"\n"
        data = rest + data
        if self.format is None:
            self.format = format_of(data)
        if self.format == "asterix":
            rest = self._feed_blocks(data, received_s, last)
        elif self.format == "mode-s" and (data[:1] == b"\x1a" or self._is_beast):
            rest = self._feed_frames(data, received_s, last)
        else:
            rest = self._feed_lines(data, received_s, last, datagram)
        if rest:
            if len(self._rest) > MOST_REMEMBERED:
                self._rest.clear()
            self._rest[connection] = rest

    def _feed_lines(self, data: bytes, received_s: float, last: bool, datagram: bool) -> bytes:
        """Adds complete lines; the rest is an incomplete one.

        The last sentence of a datagram may go on in the next one of its sender: serial lines are forwarded so.
        """
        pieces = re.split(rb"[\r\n]+", data)
        rest = pieces.pop()
        if last and (not rest.strip() or self._is_whole(rest)):
            pieces.append(rest)
            rest = b""
        elif last and not (datagram and self.format == "nmea"):
            pieces.append(self._cut_off(rest))
            rest = b""
        self._checked = self._checked or any(_CHECKSUM.search(piece) for piece in pieces)
        if len(rest) > LONGEST_LINE:
            self.damaged["a line without an end"] += 1
            rest = b""
        self._lines += [(received_s, piece.decode("utf-8", errors="replace")) for piece in pieces if piece.strip()]
        if self.format is None and self._lines:
            self.format = format_of("\n".join(line for _, line in self._lines).encode() + b"\n")
        return rest

    def _is_whole(self, line: bytes) -> bool:
        """Whether a line without a line end is not cut off, as far as its format shows it."""
        if (self.format or format_of(line)) == "nmea":
            start = max(line.rfind(b"!"), line.rfind(b"$"), 0)
            return _CHECKSUM.search(line, start) is not None
        return not line.startswith(b"MSG,") or line.count(b",") >= sbs.CELLS - 1

    def _cut_off(self, line: bytes) -> bytes:
        """Nothing is left of a line that is cut off, which is damaged; where no sentence of the stream has a checksum,
        nothing shows that it is."""
        if (self.format or format_of(line)) == "nmea" and not self._checked:
            return line
        self.damaged["a line that is cut off"] += 1
        return b""

    def _feed_blocks(self, data: bytes, received_s: float, last: bool) -> bytes:
        """Adds complete blocks; the rest is an incomplete one."""
        split = split_blocks(data, final=last)
        for start, end in split.gaps:
            cut_off = last and end == len(data) and looks_cut_off(data[start:])
            self.damaged["an ASTERIX block that is cut off" if cut_off else "bytes that are no ASTERIX block"] += 1
        content = b"".join(data[start:end] for start, end in split.blocks)
        if content:
            self._datagrams.append((received_s, content))
        return data[split.end :]

    def _feed_frames(self, data: bytes, received_s: float, last: bool) -> bytes:
        """Adds complete Beast frames; the rest is an incomplete one."""
        self._is_beast = True
        frames = beast.split_frames(data, final=last)
        if frames.end:
            self._messages.append(mode_s.Messages.of_frames(frames).received(received_s))
        return data[frames.end :]

    @property
    def own_ship(self) -> tuple[float, float, float]:
        """The latest latitude, longitude and heading of own ship in the stream, NaN where unknown."""
        if self.format == "signalk":
            return (*self._vessels.station, self._vessels.own_heading_deg)
        return self._ship.lat, self._ship.lon, self._ship.heading

    @property
    def own_mmsi(self) -> str:
        """The MMSI of own ship where the stream gives it; else empty."""
        return self._vessels.own_mmsi if self.format == "signalk" else self._ship.mmsi

    @property
    def own_velocity(self) -> tuple[float, float]:
        """The latest speed (m/s) and course (degrees) of own ship over ground in the stream, NaN where unknown."""
        if self.format == "signalk":
            return self._vessels.own_velocity
        return self._ship.speed, self._ship.course

    def reports(self) -> list[Reports]:
        """The reports in the data since the last call, one :class:`Reports` per sensor.

        Raises InputError: the data have no report of this format: a column, a library or a time is missing.
        """
        if not self._lines and not self._datagrams and not self._messages:
            return []
        received_s = max((when for when, _ in (*self._lines[-1:], *self._datagrams[-1:])), default=-math.inf)
        positions = self._ship.positions + self._vessels.positions
        try:
            return self._decoded()
        finally:
            if self._ship.positions + self._vessels.positions > positions:
                self.own_ship_s = received_s

    def _decoded(self) -> list[Reports]:
        """The reports in the lines and datagrams that wait."""
        lines, datagrams, messages = self._lines, self._datagrams, self._messages
        self._lines, self._datagrams, self._messages = [], [], []
        texts, received = [text for _, text in lines], [when for when, _ in lines]
        if translate := self._translators.get(self.format or ""):
            texts, numbers, damaged = sentences.translated(texts, translate)
            self._count(Damaged.of(damaged), {})
            received = [received[number - 1] for number in numbers]
        if self.format in ("nmea", *self._translators):
            return self._nmea(texts, received)
        if self.format == "asterix":
            parts = [self._read(partial(self._asterix, data, when)) for when, data in datagrams]
            return [reports for part in parts for reports in part]
        if self.format == "mode-s":
            return self._mode_s(texts, received, messages)
        if self.format == "sbs":
            if len(self._latest) > MOST_REMEMBERED:
                self._latest.clear()
            zone = self.options.time_zone
            return self._read(lambda: [sbs.read(texts, self.source, latest_fields=self._latest, time_zone=zone)])
        if self.format == "ogn":
            return self._read(lambda: [ogn.read(texts, self.source, received[0])])
        if self.format == "aircraft":
            if len(self._aircraft) > MOST_REMEMBERED:
                self._aircraft.clear()
            return self._read(lambda: [aircraft.read(texts, self.source, self._aircraft)])  # type: ignore[arg-type]
        if self.format == "signalk":
            return self._read(lambda: signalk.read(texts, self.source, self._vessels))
        if self.format == "table":
            # A line of another kind must not change the format of the others.
            rows = [text for text in texts if text.lstrip()[:1] == "{"]
            self.damaged["no JSON object"] += len(texts) - len(rows)
            if not rows:
                return []
            content = "\n".join(rows).encode()
            file = SensorFile(Path(self.source), content + b"\n", self.source, self.options)
            return self._read(lambda: tables.FORMAT.read(file))
        self.damaged["lines of no known format"] += len(texts)
        return []

    def _asterix(self, data: bytes, received_s: float) -> list[Reports]:
        if len(self._blocks) > MOST_REMEMBERED:
            self._blocks.clear()
        return asterix.read(data, self.source, received_s=received_s, blocks_read=self._blocks, services=self._services)

    def _mode_s(self, texts: list[str], received: list[float], found: list[mode_s.Messages]) -> list[Reports]:
        """Messages of transponders; those without a time have that of receipt."""
        if len(self._transponders.fields) > MOST_REMEMBERED:
            self._transponders = mode_s.Aircraft()
        if texts:
            read = mode_s.Messages.of_json if texts[0].lstrip()[:1] == "{" else mode_s.Messages.of_lines
            found = [*found, read(texts).received(np.array(received))]
        messages = mode_s.Messages.joined(found)
        return self._read(lambda: [mode_s.read(messages, self.source, aircraft=self._transponders)])

    def _nmea(self, texts: list[str], received: list[float]) -> list[Reports]:
        if len(self._addresses) > MOST_REMEMBERED:
            self._addresses.clear()
        log = nmea.log_of(texts, received_s=received, checked=self._addresses)
        self._count(Damaged.of(log.damaged), {})
        log = nmea.Log(log.sentences, log.clock_s, log.clock, ())
        kinds = {sentence.kind for sentence in log.sentences}
        if len(self.sentence_kinds) < MOST_REMEMBERED:
            self.sentence_kinds |= kinds
        has_others = not self.sentence_kinds.isdisjoint((*ais.SENTENCES, *arpa.SENTENCES))
        out: list[Reports] = []
        own = arpa.own_ship_of(log, self._ship)
        if kinds & set(ais.SENTENCES):
            out += self._read(lambda: [ais.read(log, f"{self.source}:ais", state=self._ais_state)])
        if kinds - {"VDM"}:
            out += self._read(lambda: [arpa.read(log, f"{self.source}:arpa", ship=self._ship, own=own)])
        if self.carries and not has_others:
            positions = arpa.own_positions(log, self.source, None, own)
            out = [] if positions is None else [positions]
        return arpa.with_own_ship(out, log, own, arpa.own_track(log, own, None, self._ship.mmsi) if out else None)

    def _read(self, read: Callable[[], list[Reports]]) -> list[Reports]:
        """The reports of a reader; its counts of damaged and skipped lines are added to those of the stream."""
        try:
            out = read()
        except NoReports as empty:
            self._count(empty.damaged, empty.passed_over)
            return []
        for reports in out:
            self._count(reports.damaged, reports.passed_over)
        return out

    def _count(self, damaged: Damaged, passed_over: object) -> None:
        self.damaged.update(damaged.counts())
        self.passed_over.update(passed_over)  # type: ignore[call-overload]
