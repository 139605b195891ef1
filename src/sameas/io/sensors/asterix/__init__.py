"""ASTERIX: the binary records of radars, trackers and ADS-B ground stations (EUROCONTROL-SPEC-0149).

``records`` splits files and network captures into blocks of one category, and blocks into records; ``cat021``,
``cat048`` and ``cat062`` decode their items; this module groups them into the reports of each sensor.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError, naming
from sameas.io.sensors.asterix import cat021, cat048, cat062
from sameas.io.sensors.asterix.records import (
    CATEGORIES,
    PCAPNG,
    Block,
    DamagedRecord,
    blocks_of,
    looks_like,
    records_of,
    unsigned,
)
from sameas.io.sensors.format import DAY_S, SensorFormat, unwrapped
from sameas.tracks.reports import Damaged, NoReports, Reports, of_rows

__all__ = ["FORMAT", "read"]


_DECODERS: dict[int, ModuleType] = {21: cat021, 48: cat048, 62: cat062}
#: Category, SAC and SIC: one sensor.
Sensor = tuple[int, int, int]


def read(
    content: bytes,
    source: str,
    start_s: float | None = None,
    *,
    received_s: float = float("nan"),
    blocks_read: set[tuple[int, bytes]] | None = None,
) -> list[Reports]:
    """The reports in ASTERIX bytes, one :class:`Reports` for each category and sensor (SAC, SIC).

    Parameters
    ----------
    content : consecutive blocks, or a pcap capture. Line numbers are those of the records in the file.
    source : its name in messages; several sensors are named ``source:048 SAC/SIC``.
    start_s : UTC date of the first record, for files that are no capture: records have the time of day only.
    received_s, blocks_read : for a stream, the receive time and the earlier blocks (updated); every sensor is then
        named as one of several.

    Raises
    ------
    InputError : nothing of categories 021, 048 or 062; no date.
    """
    if content[:4] == PCAPNG:
        raise InputError(f"{source}: is a pcapng capture; convert it: editcap -F pcap FILE FILE.pcap")
    rows: dict[Sensor, list[dict[str, Any]]] = {}
    damaged: list[tuple[int, str]] = []
    passed_over: Counter[str] = Counter()
    number = 0
    live = blocks_read is not None
    blocks_read = set() if blocks_read is None else blocks_read
    for block in blocks_of(content, received_s):
        repeated = (block.category, block.data) in blocks_read
        blocks_read.add((block.category, block.data))
        if repeated and not block.problem:
            # Sensors may send over two networks; otherwise blocks differ by their time of day.
            passed_over["block that came before, from a second network"] += 1
        elif block.problem:
            damaged.append((number + 1, block.problem))
        elif block.category not in _DECODERS:
            passed_over[f"block of category {block.category:03d}"] += 1
        else:
            number = _add_block(block, number, rows, damaged, passed_over)
    if not rows:
        problems = [
            *Damaged.of(damaged, "record").sentences(),
            *(f"{n} skipped: {what}" for what, n in passed_over.items()),
        ]
        raise NoReports(
            f"{source}: no target of category 021, 048 or 062; {'; '.join(problems) or 'is it ASTERIX?'}",
            damaged=Damaged.of(damaged, "record"), passed_over=passed_over,
        )  # fmt: skip
    # Damaged and skipped records are counted for the whole file, with its first sensor.
    unused: list[tuple[Damaged, Mapping[str, int]]] = [(Damaged.of(damaged, "record"), passed_over)]
    unused += [(Damaged(unit="record"), {})] * (len(rows) - 1)
    return [
        _reports(sensor, of_rows(own_rows), _name(source, sensor, 2 if live else len(rows)), start_s, *own_unused)
        for (sensor, own_rows), own_unused in zip(sorted(rows.items()), unused, strict=True)
    ]


def _add_block(
    block: Block,
    number: int,
    rows: dict[Sensor, list[dict[str, Any]]],
    damaged: list[tuple[int, str]],
    passed_over: Counter[str],
) -> int:
    """Adds the reports of a block to ``rows``; returns the number of its last record in the file."""
    decoder = _DECODERS[block.category]
    try:
        for items in records_of(CATEGORIES[block.category], block.data):
            number += 1
            row = decoder.row(items)
            if isinstance(row, str):
                # A reason that begins with the category is that of an intact record without a target.
                if row.startswith("0"):
                    passed_over[row] += 1
                else:
                    damaged.append((number, row))
                continue
            if abs(row.get("lat_deg", 0.0)) > 90.0:
                damaged.append((number, "latitude beyond ±90°"))
                continue
            identity = items.get("010", b"\0\0")
            sensor = (block.category, unsigned(identity[:1]), unsigned(identity[1:]))  # type: ignore[index]
            rows.setdefault(sensor, []).append({"line": number, "received_s": block.received_s, **row})
    except DamagedRecord as error:
        number += 1
        damaged.append((number, f"{error}; the rest of its block is lost"))
    return number


def _name(source: str, sensor: Sensor, count: int) -> str:
    category, sac, sic = sensor
    return source if count == 1 else f"{source}:{category:03d} {sac}/{sic}"


def _reports(
    sensor: Sensor,
    columns: dict[str, Any],
    name: str,
    start_s: float | None,
    damaged: Damaged,
    passed_over: Mapping[str, int],
) -> Reports:
    decoder = _DECODERS[sensor[0]]
    received_s = columns.pop("received_s")
    columns["time_s"] = _times(columns.pop("day_s"), received_s, name, start_s)
    columns |= decoder.errors(columns)
    date_source = "of the capture" if np.isfinite(received_s).any() else "that was given"
    notes = (f"{name}: times of day on the date {date_source}", *decoder.notes(name))
    return Reports.of(name, f"asterix {sensor[0]:03d}", columns, damaged=damaged, passed_over=passed_over, notes=notes)


def _times(day_s: FloatArray, received_s: FloatArray, name: str, start_s: float | None) -> FloatArray:
    """UTC of the times of day: on the day nearest to the packet's, else counted from the given date."""
    if np.isfinite(received_s).all():
        day_s = np.where(np.isnan(day_s), np.mod(received_s, DAY_S), day_s)
        return np.asarray(day_s + DAY_S * np.round((received_s - day_s) / DAY_S))
    if start_s is None:
        raise InputError(
            f"{name}: no date: the records have the time of day only", naming("give {start}, the UTC date of the first")
        )
    return unwrapped(day_s, DAY_S, start_s)


FORMAT = SensorFormat(
    "asterix",
    "ASTERIX categories 021, 048 and 062, bare or in a pcap capture",
    lambda file: read(file.content, file.source, file.start_s),
    lambda file: looks_like(file.content),
    magic=(PCAPNG,),
)
