"""Recordings: the bytes that ``sameas watch`` received, with their receive times, to be replayed.

A recording is a text file of JSON lines for each input. The first line names the sources of the input; every other line
is a piece of data: ``t`` its receive time, ``c`` the number of its connection, ``last`` where nothing follows on this
connection (a datagram, or its end), and ``text``, or ``base64`` for bytes that are no text. A line with ``dropped`` in
place of these says how many pieces were lost there, because more arrived than could be read. A recording is read by the
same :class:`~sameas.io.sensors.stream.ReportStream` that reads the input itself.
"""

from __future__ import annotations

import base64
import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from sameas.errors import InputError
from sameas.io.sensors.format import ReadOptions, SensorFile, SensorFormat, content, kind_of
from sameas.io.sensors.stream import ReportStream
from sameas.tracks.kinds import KINDS
from sameas.tracks.reports import Damaged, NoReports, Reports, joined

#: The first bytes of a recording.
MAGIC = b'{"recording of sameas watch"'
#: A file is closed and a new one begun after this many seconds or bytes.
FILE_S, FILE_BYTES = 3600.0, 64 << 20
#: A piece of data: receive time, bytes, number of its connection, whether it is the last of this connection.
Piece = tuple[float, bytes, int, bool]
_NAME = re.compile(r"(?P<wire>.+)-(?P<began>\d{8}T\d{6})Z(-\d+)?\.jsonl")


@dataclass(frozen=True)
class RecordedSource:
    """A source of an input. sensor : the sensor of a shared input that it takes, None: those that fit its kind."""

    name: str
    kind: str
    sensor: str | None = None

    def takes(self, reports: Reports) -> bool:
        """Whether reports of the input may be of this source.

        The format of a radar tells neither where it stands nor what it watches: coasts and towers have theirs in
        ASTERIX, too, so the kind that the source was given counts.
        """
        if self.sensor is not None:
            return reports.source.endswith(f":{self.sensor}") or self.sensor in (reports.source, reports.sac_sic)
        kind = kind_of(reports.kind)
        if kind is None or kind == self.kind or self.kind in ("tracks", "other", "mlat", "wam"):
            return True
        return not (KINDS[kind].self_named or KINDS[self.kind].self_named)

    def takes_first(self, reports: Reports) -> bool:
        """Whether reports of the input are its own where other sources may have them, too."""
        return self.sensor is not None or kind_of(reports.kind) in (None, self.kind)


def taker(sources: Iterable[RecordedSource], reports: Reports) -> str | None:
    """The name of the source that reports of an input belong to: of those that may, the first of their very kind."""
    takers = sorted((one for one in sources if one.takes(reports)), key=lambda one: not one.takes_first(reports))
    return takers[0].name if takers else None


@dataclass(frozen=True)
class RecordedInput:
    """What the first line of a recording says: the sources of the input, and how they are read."""

    sources: tuple[RecordedSource, ...]
    format: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The names of its sources, as in the name of the file."""
        return re.sub(r"[^\w.+-]", "_", "+".join(source.name for source in self.sources))

    def head(self) -> bytes:
        sources = [{"name": one.name, "kind": one.kind, "sensor": one.sensor} for one in self.sources]
        options = {name: dict(value) if isinstance(value, Mapping) else value for name, value in self.options.items()}
        content = {"recording of sameas watch": 1, "sources": sources, "format": self.format, "options": options}
        return json.dumps(content, ensure_ascii=False).encode() + b"\n"

    @classmethod
    def of_head(cls, line: bytes, source: str) -> RecordedInput:
        try:
            head = json.loads(line)
            if head["recording of sameas watch"] != 1:
                raise InputError(f"{source}: is a recording of a later version of sameas", "read it with that version")
            sources = tuple(RecordedSource(**one) for one in head["sources"])
            return cls(sources, head["format"], head["options"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{source}: the first line of the recording is damaged ({error})") from None


class Recorder:
    """Writes what one input receives into files of a folder.

    A line is handed to the system as soon as it is written: a process that is killed loses none of them. A disk that
    refuses is named in ``error``; the next piece is tried again.

    folder : is made if needed. recorded : of the input. keep_s : older files of this input are deleted; 0: none are.
    """

    def __init__(self, folder: Path, recorded: RecordedInput, keep_s: float = 0.0) -> None:
        self.folder, self.recorded, self.keep_s = folder, recorded, keep_s
        #: Why the last piece could not be written; bytes and pieces that were, and pieces that were not.
        self.error, self.written, self.lost = "", 0, 0
        self._file: IO[bytes] | None = None
        self._began_s, self._size = 0.0, 0

    def write(self, pieces: Sequence[Piece], dropped: int = 0) -> None:
        """Writes pieces. dropped : number of those before them that were lost."""
        if not pieces:
            return
        note = json.dumps({"t": round(pieces[0][0], 6), "dropped": dropped}).encode() + b"\n" if dropped else b""
        lines = note + b"".join(map(_line, pieces))
        try:
            file = self._open(pieces[0][0])
            # Unbuffered: the lines are the system's once this returns.
            if file.write(lines) != len(lines):
                raise OSError("the disk is full")
        except OSError as error:
            self.error, self.lost = error.strerror or str(error), self.lost + len(pieces)
            if self._file is not None and self._size == 0:
                # It holds nothing, and with every further piece there would be another one.
                Path(self._file.name).unlink(missing_ok=True)
            self.close()
            return
        self.error, self.written, self._size = "", self.written + len(lines), self._size + len(lines)

    def _open(self, now_s: float) -> IO[bytes]:
        # A clock that is set back begins a new file, too.
        if self._file is not None and 0.0 <= now_s - self._began_s < FILE_S and self._size < FILE_BYTES:
            return self._file
        self.close()
        self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        stamp, number = datetime.fromtimestamp(now_s, UTC).strftime("%Y%m%dT%H%M%SZ"), 1
        while True:
            path = self.folder / f"{self.recorded.name}-{stamp}{'' if number == 1 else f'-{number}'}.jsonl"
            try:
                file = open(path, "xb", buffering=0)  # noqa: SIM115 (closed when it is full)
                break
            except FileExistsError:
                number += 1
        os.chmod(path, 0o600)
        self._file, self._began_s, self._size = file, now_s, 0
        if file.write(head := self.recorded.head()) != len(head):
            raise OSError("the disk is full")
        self._delete_old(now_s)
        return file

    def _delete_old(self, now_s: float) -> None:
        for path in self.folder.iterdir() if self.keep_s > 0.0 else ():
            found = _NAME.fullmatch(path.name)
            if found is not None and found["wire"] == self.recorded.name:
                began_s = datetime.strptime(found["began"], "%Y%m%dT%H%M%S").replace(tzinfo=UTC).timestamp()
                if began_s + FILE_S < now_s - self.keep_s:
                    path.unlink(missing_ok=True)

    def close(self) -> None:
        """Closes the file; the next piece begins a new one."""
        if self._file is not None:
            self._file.close()
        self._file = None


def _line(piece: Piece) -> bytes:
    received_s, data, connection, last = piece
    line: dict[str, Any] = {"t": round(received_s, 6), "c": connection}
    if last:
        line["last"] = True
    try:
        line["text"] = data.decode("utf-8")
    except UnicodeDecodeError:
        line["base64"] = base64.b64encode(data).decode("ascii")
    return json.dumps(line, ensure_ascii=False).encode() + b"\n"


@dataclass(frozen=True)
class Recording:
    """What one input received, in the order of receipt. dropped : number of pieces lost before each piece, and after
    the last one. damaged : number of lines that cannot be read."""

    recorded: RecordedInput
    pieces: list[Piece]
    dropped: list[int]
    damaged: int = 0

    @classmethod
    def of(cls, file: SensorFile) -> Recording:
        """The recording in a file.

        Raises InputError: the first line is damaged.
        """
        pieces: list[Piece] = []
        dropped, damaged = [0], 0
        for line in file.content.split(b"\n"):
            if line.startswith(MAGIC) or not line:
                continue
            try:
                piece = json.loads(line)
                received_s = float(piece["t"])
                if not math.isfinite(received_s):
                    raise ValueError("no time")
                if "dropped" in piece:
                    dropped[-1] += max(int(piece["dropped"]), 0)
                    continue
                data = base64.b64decode(piece["base64"]) if "base64" in piece else piece["text"].encode("utf-8")
                pieces.append((received_s, data, int(piece["c"]), bool(piece.get("last"))))
                dropped.append(0)
            except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
                # A watch that was killed may have left a part of a line.
                damaged += 1
        return cls(RecordedInput.of_head(file.content.partition(b"\n")[0], file.source), pieces, dropped, damaged)


def read(file: SensorFile) -> list[Reports]:
    """The reports of a recording, one :class:`Reports` for each source of its input that has any.

    Raises InputError: no report; the first line is damaged.
    """
    recording = Recording.of(file)
    recorded = recording.recorded
    zone = file.options.time_zone or recorded.options.get("time_zone")
    options = ReadOptions(
        recorded.name, columns=file.options.columns or recorded.options.get("columns"), time_zone=zone,
        units=file.options.units or recorded.options.get("units"), kind=recorded.sources[0].kind,
    )  # fmt: skip
    stream = ReportStream(recorded.name, recorded.format, options)
    for received_s, data, connection, last in recording.pieces:
        stream.feed(data, received_s, connection=connection, last=last)
    parts: dict[str, list[Reports]] = {}
    for reports in stream.reports():
        taken = taker(recorded.sources, reports)
        if taken is None:
            stream.passed_over[f"reports of no source: {reports.source}"] += len(reports)
        else:
            parts.setdefault(taken, []).append(reports)
    lost = {"damaged lines of the recording": recording.damaged, "pieces that a flood dropped": sum(recording.dropped)}
    unused = dict(stream.damaged + stream.passed_over) | {reason: n for reason, n in lost.items() if n}
    if not parts:
        reasons = ", ".join(f"{n} × {reason}" for reason, n in unused.items())
        raise NoReports(f"{file.source}: no report in the recording{f': {reasons}' if reasons else ''}")
    first = next(iter(parts))
    return [
        replace(joined(each), source=name, damaged=Damaged(), passed_over=unused if name == first else {})
        for name, each in parts.items()
    ]


def paths_in(folder: Path) -> list[Path]:
    """The paths of the recordings in a folder, in the order of their names."""
    return [path for path in sorted(folder.iterdir()) if _NAME.fullmatch(path.name)]


def recordings(path: Path) -> list[SensorFile]:
    """The recordings in a folder, the files of each input as one; or a single file.

    Raises InputError: there is none; the file is no recording.
    """
    if path.is_dir():
        return list(files_in(path))
    file = SensorFile.of(path, ReadOptions())
    if not file.head.startswith(MAGIC):
        raise InputError(f"{path}: is no recording of sameas watch", "give the folder of --record")
    return [file]


def files_in(folder: Path) -> Iterator[SensorFile]:
    """The recordings in a folder, the files of each input as one, in the order of their times.

    Raises InputError: there is none.
    """
    wires: dict[str, list[Path]] = {}
    for path in paths_in(folder):
        if found := _NAME.fullmatch(path.name):
            wires.setdefault(found["wire"], []).append(path)
    if not wires:
        raise InputError(f"{folder}: is a directory without recordings of sameas watch", "give a file")
    for wire, paths in wires.items():
        yield SensorFile(folder, b"\n".join(content(path) for path in paths), wire, ReadOptions(wire))


FORMAT = SensorFormat(
    "recording", "recording of sameas watch", read, lambda file: file.head.startswith(MAGIC), (MAGIC,)
)
