"""A ship's log of NMEA 0183 sentences: its AIS and its tracked radar targets, as one source each."""

from __future__ import annotations

import re
from dataclasses import replace

from sameas.errors import InputError
from sameas.io.sensors import ais, arpa, nmea
from sameas.io.sensors.format import SensorFile, SensorFormat
from sameas.tracks.reports import Reports


def read(log: nmea.Log, source: str, start_s: float | None) -> list[Reports]:
    """AIS and radar targets of a log; two sources where it has both."""
    kinds = {sentence.kind for sentence in log.sentences}
    has = {"ais": "VDM" in kinds, "arpa": bool(kinds & set(arpa.SENTENCES))}
    if not any(has.values()):
        listed = ", ".join(sorted(kinds)) or "none"
        raise InputError(f"{source}: no AIS (VDM) and no radar targets (TTM, TLL) among its sentences: {listed}")
    both = all(has.values())
    sources = [ais.read(log, f"{source}:ais" if both else source, start_s)] if has["ais"] else []
    if has["arpa"]:
        # Damaged lines are counted once, with the first source.
        rest = replace(log, damaged=()) if both else log
        sources.append(arpa.read(rest, f"{source}:arpa" if both else source, start_s))
    return sources


def _recognises(file: SensorFile) -> bool:
    return any(re.search(r"[!$][A-Z]{4,9}[A-Z0-9]?,", line) for line in file.head_lines)


FORMAT = SensorFormat(
    "nmea",
    "NMEA 0183: AIS (VDM) and tracked radar targets (TTM, TLL)",
    lambda file: read(nmea.log_of(file.lines, file.unended), file.source, file.start_s),
    _recognises,
)
