"""Reading: the reports in a file of any known format, found out from its content."""

from __future__ import annotations

import gzip
import os
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sameas.errors import InputError
from sameas.io.sensors import aircraft, ais, arpa, asterix, mode_s, nmea, sbs, tables
from sameas.io.sensors.asterix.blocks import PCAPNG, looks_like
from sameas.io.sensors.clock import started
from sameas.tracks.reports import Reports

# Content: the bytes and lines of a file, whatever is wrong with single ones.


def content(path: str | os.PathLike[str]) -> bytes:
    """All bytes of a file, unpacked where it is gzipped.

    Raises
    ------
    InputError : no such file, a directory, empty, a packed file cut off.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a directory; give a file")
    if not path.exists():
        raise InputError(f"{path}: no such file")
    found = path.read_bytes()
    if found[:2] == b"\x1f\x8b":
        try:
            found = gzip.decompress(found)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise InputError(f"{path}: is cut off in the middle; copy it again") from error
    if not found:
        raise InputError(f"{path}: is empty")
    return found


def lines_of(found: bytes) -> list[str]:
    """Its lines; line 1 is the first. Bytes that are no UTF-8 become replacement characters."""
    return (
        found.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n").rstrip("\n").split("\n")
    )


#: The formats, and what they are.
REPORT_FORMATS: Mapping[str, str] = {
    "table": "CSV, Parquet or JSON lines with columns that are understood by their names",
    "nmea": "NMEA 0183: AIS (VDM) and tracked radar targets (TTM, TLL)",
    "aircraft": "aircraft.json of dump1090, readsb or tar1090, one snapshot a line or a file",
    "sbs": "BaseStation lines (MSG,…)",
    "mode-s": "raw Mode S messages in hexadecimal, with times",
    "asterix": "ASTERIX categories 021, 048 and 062, bare or in a pcap capture",
}
#: How many lines are looked at to find the format out.
_LOOKED_AT = 200


@dataclass(frozen=True)
class ReadOptions:
    """What a file does not say of itself.

    source : the name of the source in messages; the name of the file if not given.
    format : one of :data:`REPORT_FORMATS`, where the content does not tell it.
    start : UTC of the first line as ISO text or seconds, for files that tell the time of day only, or count.
    columns : tables only: by quantity (``lat_deg``, ``time_s`` …) the name of the column that it is.
    units : tables only: by name of a column its unit.
    """

    source: str | None = None
    format: str | None = None
    start: str | float | None = None
    columns: Mapping[str, str] | None = None
    units: Mapping[str, str] | None = None


def read_reports(path: str | os.PathLike[str], options: ReadOptions | None = None) -> list[Reports]:
    """What sensors wrote: one :class:`~sameas.tracks.reports.Reports` for each sensor in the file.

    Parameters
    ----------
    path : a file of one of :data:`REPORT_FORMATS`, gzipped or not. A ship's log may hold its AIS and its radar, an
        ASTERIX capture many radars: they come as one source each.
    options : what the file does not say.

    Returns
    -------
    Reports with times in UTC, metres and degrees. Lines that cannot be used are in ``damaged``, with their numbers.

    Raises
    ------
    InputError : no such file; nothing in it can be used; no time or no position in it; a format that is not known.

    Example
    -------
    >>> import pathlib, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "coast.csv"
    >>> _ = file.write_text("time,lat,lon,sog,mmsi\\n2024-05-01T12:00:00Z,50.1,-1.2,10,235070762\\n")
    >>> [reports] = read_reports(file)
    >>> reports.position, reports.mmsi.tolist(), reports.speed_m_per_s.round(2).tolist()
    ('geodetic', ['235070762'], [5.14])
    """
    path, options = Path(path), options or ReadOptions()
    source = options.source or path.name
    if options.format is not None and options.format not in REPORT_FORMATS:
        raise InputError(f"{source}: unknown format {options.format!r}; give one of {', '.join(REPORT_FORMATS)}")
    start_s = started(options.start, source)
    found = content(path)
    name = options.format or format_of(found, source)
    if name == "asterix":
        return asterix.read(found, source, start_s)
    if name == "table":
        cells = _cells(path, found, source)
        return [tables.read(cells, source, start_s, options.columns, options.units)]
    lines = lines_of(found)
    if name == "nmea":
        return _of_log(nmea.log_of(lines), source, start_s)
    if name == "mode-s":
        return [mode_s.read(lines, source, start_s)]
    return [aircraft.read(lines, source) if name == "aircraft" else sbs.read(lines, source)]


def format_of(found: bytes, source: str = "file") -> str:
    """The name of the format that the content has.

    Raises
    ------
    InputError : it is none of :data:`REPORT_FORMATS`.
    """
    if found[:4] == b"PAR1":
        return "table"
    if found[:4] == PCAPNG or looks_like(found):
        return "asterix"
    head = found[:65536]
    lines = [line.strip() for line in lines_of(head)[:_LOOKED_AT] if line.strip()]
    if any(re.search(r"[!$][A-Z]{4,9}[A-Z0-9]?,", line) for line in lines):
        return "nmea"
    if re.search(rb'"aircraft"\s*:\s*\[', head):
        return "aircraft"
    if any(re.match(r"MSG,\s*\d,", line) for line in lines):
        return "sbs"
    if _share(lines, r"(?:[^,;*@]+[,;\s]+)?[*@]?[0-9A-Fa-f]{14,42};?") > 0.5:
        return "mode-s"
    # A zero among sentences is a line that was damaged; no table has one.
    if b"\0" in head:
        raise InputError(f"{source}: is binary, but neither ASTERIX, pcap nor Parquet; give another file")
    return "table"


def _share(lines: Sequence[str], pattern: str) -> float:
    return sum(re.fullmatch(pattern, line) is not None for line in lines) / max(len(lines), 1)


def _cells(path: Path, found: bytes, source: str) -> tables.TableText:
    if found[:4] == b"PAR1":
        return tables.cells_of_parquet(path)
    lines = lines_of(found)
    first = next((line.strip() for line in lines if line.strip()), "")
    return tables.cells_of_json(lines, source) if first[:1] in "{[" else tables.cells_of_csv(lines, source)


def _of_log(log: nmea.Log, source: str, start_s: float | None) -> list[Reports]:
    """AIS and radar targets of a log; two sources where it has both."""
    kinds = {sentence.kind for sentence in log.sentences}
    has = {"ais": "VDM" in kinds, "arpa": bool(kinds & set(arpa.SENTENCES))}
    if not any(has.values()):
        said = ", ".join(sorted(kinds)) or "none"
        raise InputError(f"{source}: no AIS (VDM) and no radar targets (TTM, TLL) among its sentences: {said}")
    both = all(has.values())
    read = [ais.read(log, f"{source}:ais" if both else source, start_s)] if has["ais"] else []
    if has["arpa"]:
        # Lines that are no sentences are counted once, with the first source.
        rest = replace(log, damaged=()) if both else log
        read.append(arpa.read(rest, f"{source}:arpa" if both else source, start_s))
    return read
