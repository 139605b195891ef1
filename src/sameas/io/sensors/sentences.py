"""Sentences of NMEA 0183, written from what other formats say: own ship, radar targets and AIS.

NMEA 2000 and the JSON of receivers say the same things in other forms. They are translated to sentences, which one
reader decodes, with one state in files and in streams: AIS with its "not available", the positions of hulls and parts
of messages, own ship, and the numbers of ARPA targets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

from sameas.errors import InputError, optional
from sameas.io.sensors import arpa
from sameas.io.sensors.format import KNOT_M_PER_S, SensorFile
from sameas.io.sensors.nmea import checksum, log_of
from sameas.tracks.coordinates import MILE_M
from sameas.tracks.reports import Reports

#: The sentences that a line stands for, none where it says nothing of interest. Raises ValueError for a damaged line.
Translator = Callable[[str], Sequence[str]]


def sentence(*fields: object) -> str:
    """A sentence of these fields, with its checksum; None is an empty field.

    >>> sentence("GPVTG", 90.0, "T", None, "M", 10.0, "N")
    '$GPVTG,90.0,T,,M,10.0,N*0D'
    """
    body = ",".join("" if field is None else str(field) for field in fields)
    return f"${body}*{checksum(body):02X}"


def at_time(text: str, time_s: float | None) -> str:
    """The sentence with its time of receipt in a tag block, where there is one."""
    return text if time_s is None else f"\\c:{time_s:.3f}\\{text}"


def clock(time_s: float) -> str:
    """The sentence of a UTC clock."""
    moment = datetime.fromtimestamp(time_s, UTC)
    return sentence("GPZDA", f"{moment:%H%M%S}.{moment.microsecond // 10_000:02d}", *f"{moment:%d,%m,%Y}".split(","))


def position(lat_deg: float | None, lon_deg: float | None) -> list[str]:
    """The sentence of own ship's position; none where it is not available."""
    if lat_deg is None or lon_deg is None or not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0):
        return []
    return [sentence("GPGLL", *_angle(lat_deg, 2, "NS"), *_angle(lon_deg, 3, "EW"), None, "A")]


def _angle(degrees: float, digits: int, sides: str) -> tuple[str, str]:
    """Degrees and minutes, to 2 mm, and the side."""
    minutes = round(abs(degrees) * 60.0, 6)
    whole = int(minutes // 60.0)
    return f"{whole:0{digits}d}{minutes - 60.0 * whole:09.6f}", sides[int(degrees < 0.0)]


def velocity(course_deg: float | None, speed_m_per_s: float | None) -> str:
    """The sentence of own ship's course and speed over ground."""
    return sentence(
        "GPVTG", _rounded(course_deg), "T", None, "M", _rounded(speed_m_per_s, KNOT_M_PER_S), "N", None, "K"
    )


def heading(true_deg: float | None) -> str:
    """The sentence of own ship's true heading."""
    return sentence("HEHDT", _rounded(true_deg), "T")


def compass(magnetic_deg: float | None, deviation_deg: float | None, variation_deg: float | None) -> str:
    """The sentence of a magnetic compass; deviation and variation are positive to the east."""
    deviation, variation = (
        (None, None) if angle is None else (_rounded(abs(angle)), "EW"[angle < 0.0])
        for angle in (deviation_deg, variation_deg)
    )
    return sentence("HCHDG", _rounded(magnetic_deg), *deviation, *variation)


def target(
    number: object, range_m: float, bearing_deg: float, speed_m_per_s: float | None, course_deg: float | None, *,
    status: str = "T",
) -> str:  # fmt: skip
    """The sentence of a radar target; bearing and course from true north. status : L, Q or T, as in TTM."""
    return sentence(
        "RATTM", number, _rounded(range_m, MILE_M), _rounded(bearing_deg), "T", _rounded(speed_m_per_s, KNOT_M_PER_S),
        _rounded(course_deg), "T", None, None, "N", "", status, None, None, "A",
    )  # fmt: skip


def _rounded(value: float | None, unit: float = 1.0) -> str | None:
    return None if value is None else f"{value / unit:.5f}"


@dataclass
class AisWriter:
    """Writes AIS messages. sequence : number of the last message of several parts, 0 to 9."""

    sequence: int = 0

    def __call__(self, fields: Mapping[str, Any], *, own: bool = False) -> list[str]:
        """The sentences of a message.

        fields : by the names of pyais (``type``, ``mmsi``, ``lat`` …) and in its units, knots and degrees; those that
            are None are not available. own : whether own ship's transponder reports itself.

        Raises ValueError: a value that the message cannot have. InputError : pyais is not installed.
        """
        with optional("AIS messages need pyais", "targets"):
            from pyais.encode import encode_dict
        self.sequence = (self.sequence + 1) % 10
        kind = int(fields["type"])
        absent = {} if kind in (5, 24) else _ABSENT | ({"status": 15} if kind in (1, 2, 3) else {})
        given = {name: value for name, value in fields.items() if value is not None}
        try:
            return list(encode_dict({**absent, **given}, sentence_type="VDO" if own else "VDM", seq_id=self.sequence))
        except Exception as error:
            # pyais raises many kinds of errors.
            raise ValueError(f"no AIS message of type {kind}: {error}") from error


#: What stands for a value that is not available in reports of positions (ITU-R M.1371).
_ABSENT = {"lat": 91.0, "lon": 181.0, "speed": 102.3, "course": 360.0, "heading": 511, "second": 60}


def read_translated(file: SensorFile, translate: Translator) -> list[Reports]:
    """The reports of a file whose lines stand for sentences.

    Raises InputError: no AIS and no radar target among them; no time.
    """
    texts, numbers, damaged = translated(file.lines, translate)
    log = log_of(texts, numbers=numbers, start_s=file.start_s)
    log = replace(log, damaged=tuple(sorted((*log.damaged, *damaged))))
    return arpa.of_log(log, file.source, file.start_s)


def translated(lines: Sequence[str], translate: Translator) -> tuple[list[str], list[int], list[tuple[int, str]]]:
    """The sentences of lines, the number of the line of each, and the damaged lines with the reason."""
    texts: list[str] = []
    numbers: list[int] = []
    damaged: list[tuple[int, str]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            found = translate(line)
        except InputError:
            raise
        except (ValueError, TypeError, KeyError, OverflowError, IndexError) as error:
            damaged.append((number, str(error)))
            continue
        texts += found
        numbers += [number] * len(found)
    return texts, numbers, damaged
