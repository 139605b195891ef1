"""Reading: the reports in a file of any known format, found out from its content."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from sameas.errors import InputError, reading
from sameas.io.sensors import aircraft, asterix, mode_s, sbs, ship_log, signalk, tables
from sameas.io.sensors.format import ReadOptions, SensorFile, SensorFormat
from sameas.tracks.reports import Reports

#: The formats, in the order in which they are tried.
FORMATS: tuple[SensorFormat, ...] = (
    asterix.FORMAT, ship_log.FORMAT, aircraft.FORMAT, signalk.FORMAT, sbs.FORMAT, mode_s.FORMAT, tables.FORMAT,
)  # fmt: skip
#: What each of them is, by its name.
REPORT_FORMATS: Mapping[str, str] = {known.name: known.label for known in (FORMATS[-1], *FORMATS[1:-1], FORMATS[0])}


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
    options = options or ReadOptions()
    source = options.source or Path(path).name
    if options.format is not None and options.format not in REPORT_FORMATS:
        raise InputError(f"{source}: unknown format {options.format!r}; give one of {', '.join(REPORT_FORMATS)}")
    file = SensorFile.of(path, options)
    chosen = next((known for known in FORMATS if known.name == options.format), None) or format_of(file)
    with reading(str(path), f"cannot be read as {chosen.label}"):
        return [_with_last_line(reports, file) for reports in chosen.read(file)]


def _with_last_line(reports: Reports, file: SensorFile) -> Reports:
    """The same reports; a damaged last line that has no end was cut off with the file."""
    damaged, last = reports.damaged, len(file.lines) if file.unended else 0
    if last not in damaged.lines or damaged.unit != "line":
        return reports
    reasons = np.where(damaged.lines == last, "the last line is incomplete", damaged.reasons)
    return replace(reports, damaged=replace(damaged, reasons=reasons))


def format_of(file: SensorFile) -> SensorFormat:
    """The format that the content of a file has.

    Raises
    ------
    InputError : it is none of :data:`FORMATS`.
    """
    for known in FORMATS:
        if file.content.startswith(known.magic):
            return known
    for known in FORMATS:
        if known.recognises(file):
            return known
    raise InputError(f"{file.source}: is binary, but neither ASTERIX, pcap nor Parquet; give another file")
