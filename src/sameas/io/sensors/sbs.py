"""SBS: the lines of BaseStation (``MSG,3,…``), which dump1090 and similar programs serve on port 30003.

Positions are in messages of type 2 and 3, velocities in 4 (2 on the ground), call signs in 1, squawks in 6: every
position gets the latest fields of its aircraft. No message states accuracies. Times are local time of the receiver in
some programs and UTC in others; the lines do not say which.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from sameas.io.sensors.aircraft import identity_of
from sameas.io.sensors.format import FEET_PER_MINUTE_M_PER_S, KNOT_M_PER_S, SensorFormat, instant, utc_of
from sameas.tracks.coordinates import FOOT_M
from sameas.tracks.reports import Reports, Unused, of_rows

#: Fields older than this, in seconds, are not joined to a position (chosen).
_STALE_S = 30.0
#: Cells of a message.
CELLS = 22
#: Number of the field (from 0), its column and its unit.
_FIELDS = {
    11: ("pressure_alt_m", FOOT_M),
    12: ("speed_m_per_s", KNOT_M_PER_S),
    13: ("course_deg", 1.0),
    16: ("climb_m_per_s", FEET_PER_MINUTE_M_PER_S),
}


#: Time and value of the latest fields, by aircraft and field.
Latest = dict[str, dict[str, tuple[float, Any]]]


def read(
    lines: Sequence[str],
    source: str,
    unended: bool = False,
    latest_fields: Latest | None = None,
    time_zone: str | None = None,
) -> Reports:
    """The positions of aircraft in SBS lines.

    lines : other than MSG (SEL, ID, AIR, STA, CLK) are skipped.
    source : its name in messages.
    unended : whether the last line has no line end; then it must have all its cells.
    latest_fields : for a stream, the fields before these lines; updated.
    time_zone : of the times; UTC if not given.

    Raises InputError: no position.
    """
    unused = Unused()
    by_aircraft: Latest = {} if latest_fields is None else latest_fields
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        cells = line.split(",")
        if cells[0].strip() in ("SEL", "ID", "AIR", "STA", "CLK"):
            unused.passed_over[f"{cells[0].strip()} line"] += 1
            continue
        try:
            time_s, address, fields = _message(cells, least=CELLS if unended and number == len(lines) else 16)
        except ValueError as error:
            unused.damaged.append((number, str(error)))
            continue
        latest = by_aircraft.setdefault(address, {})
        latest |= {name: (time_s, value) for name, value in fields.items() if value is not None}
        if fields.get("lat_deg") is None or fields.get("lon_deg") is None:
            unused.passed_over["message without a position"] += 1
        else:
            current = {name: value for name, (when, value) in latest.items() if abs(time_s - when) <= _STALE_S}
            rows.append({"line": number, "time_s": time_s, **identity_of(address), **current})
    if not rows:
        raise unused.refusal(f"{source}: no position: {unused.reasons() or 'no MSG,2 or MSG,3'}")
    zone = time_zone or "UTC"
    notes = (f"{source}: times are read as {zone}; SBS lines state no time zone", f"{source}: SBS states no errors")
    columns = of_rows(rows)
    columns["time_s"] = utc_of(columns["time_s"], time_zone)
    return unused.reports(source, "adsb", columns, notes)


def _message(cells: Sequence[str], least: int) -> tuple[float, str, dict[str, Any]]:
    """Time, address and fields. Raises ValueError with the reason. least : number of cells."""
    if cells[0].strip() != "MSG":
        raise ValueError("no SBS message")
    if len(cells) < least:
        raise ValueError(f"{len(cells)} cells of a message that has {CELLS}")
    address = cells[4].strip()
    if not address or any(c not in "0123456789abcdefABCDEF~" for c in address):
        raise ValueError("no address of an aircraft")
    time_s = instant(f"{cells[6].strip().replace('/', '-')} {cells[7].strip()}")
    if time_s is None:
        raise ValueError("no time")
    fields: dict[str, Any] = {"callsign": cells[10].strip() or None}
    for number, (column, scale) in _FIELDS.items():
        value = _number(cells, number)
        fields[column] = None if value is None else scale * value
    fields["lat_deg"], fields["lon_deg"] = _number(cells, 14), _number(cells, 15)
    if (fields["lat_deg"] is None) != (fields["lon_deg"] is None):
        raise ValueError("half of a position")
    if fields["lat_deg"] is not None and not (abs(fields["lat_deg"]) <= 90.0 and abs(fields["lon_deg"]) <= 180.0):
        raise ValueError("position outside the earth")
    squawk = cells[17].strip() if len(cells) > 17 else ""
    fields["mode_a"] = squawk or None
    if len(cells) > 21 and cells[21].strip():
        fields["on_ground"] = float(cells[21].strip() not in ("0", "false"))
    return time_s, address, fields


def _number(cells: Sequence[str], number: int) -> float | None:
    text = cells[number].strip() if number < len(cells) else ""
    if not text:
        return None
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"cell {number + 1} is no number") from None


FORMAT = SensorFormat(
    "sbs",
    "BaseStation lines (MSG,…)",
    lambda file: [read(file.lines, file.source, file.unended, time_zone=file.options.time_zone)],
    lambda file: any(re.match(r"MSG,\s*\d,", line) for line in file.head_lines),
)
