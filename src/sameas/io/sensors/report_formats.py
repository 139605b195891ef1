"""The formats of sensor files, and the reports in a file, whose format is detected from its content."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from sameas.errors import InputError, reading
from sameas.io.sensors import (
    aircraft,
    arpa,
    asterix,
    cot,
    gpsd,
    gpx,
    matlab,
    mode_s,
    n2k,
    ogn,
    recording,
    sbs,
    signalk,
    tables,
)
from sameas.io.sensors.format import ReadOptions, SensorFile, SensorFormat
from sameas.tracks.reports import Reports

#: Formats whose times may be of any zone.
ZONED = ("table", "sbs")
#: The formats, in the order in which they are tried.
SENSOR_FORMATS: tuple[SensorFormat, ...] = (
    recording.FORMAT, asterix.FORMAT, gpx.FORMAT, cot.FORMAT, gpsd.FORMAT, n2k.FORMAT, arpa.FORMAT, aircraft.FORMAT,
    signalk.FORMAT, sbs.FORMAT, ogn.FORMAT, mode_s.FORMAT, matlab.FORMAT, tables.FORMAT,
)  # fmt: skip
#: Their descriptions, by name.
REPORT_FORMATS: Mapping[str, str] = {
    known.name: known.label
    for known in (SENSOR_FORMATS[-1], *SENSOR_FORMATS[2:-1], SENSOR_FORMATS[1], SENSOR_FORMATS[0])
}


def read_reports(path: str | os.PathLike[str], options: ReadOptions | None = None) -> list[Reports]:
    """Reads a sensor file: one :class:`~sameas.tracks.reports.Reports` for each sensor in it.

    path : a file of one of :data:`REPORT_FORMATS`, gzipped or not. A ship's log may hold its AIS and its radar, an
        ASTERIX capture several radars: they are separate sources.
    options : for what the file does not contain.

    Returns
    -------
    Reports with times in UTC, metres and degrees. Unusable lines are in ``damaged``, with their numbers.

    Raises InputError: no such file; no usable report; no time or position; an unknown format.

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
    chosen = next((known for known in SENSOR_FORMATS if known.name == options.format), None) or format_of(file)
    with reading(str(path), f"cannot be read as {chosen.label}"):
        if options.time_zone is not None and chosen.name not in ZONED:
            raise InputError(
                f"{file.source}: the times of {chosen.name} have no time_zone: they are UTC", "leave it out"
            )
        return [_with_last_line(reports, file) for reports in chosen.read(file)]


def _with_last_line(reports: Reports, file: SensorFile) -> Reports:
    """The reports; a damaged last line without line end is called incomplete."""
    damaged = reports.damaged
    if damaged.unit != "line" or not file.unended:
        return reports
    last = len(file.lines)
    if last not in damaged.lines:
        return reports
    reasons = np.where(damaged.lines == last, "the last line is incomplete", damaged.reasons)
    return replace(reports, damaged=replace(damaged, reasons=reasons))


def format_of(file: SensorFile) -> SensorFormat:
    """The format of a file, detected from its content.

    Raises InputError: it is none of :data:`SENSOR_FORMATS`.
    """
    for known in SENSOR_FORMATS:
        if file.content.startswith(known.magic):
            return known
    for known in SENSOR_FORMATS:
        if known.recognises(file):
            return known
    raise InputError(f"{file.source}: is binary, but neither ASTERIX, pcap nor Parquet; give another file")
