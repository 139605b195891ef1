"""Objects of a picture as ASTERIX category 062, the tracks of a surveillance data processing system, edition 1.18.

Each record has items 010 (SAC and SIC, both 0), 070, 105, 185, 040, 080 and 500 (accuracies); where known 060 (Mode A
code), 245 (call sign, else the beginning of a ship's name), 380 (address), 130 or 135 (height above the ellipsoid, or
pressure height) and 220 (vertical rate). The first record of a track has bit TSB of item 080. One that left the picture
is given once more, as it was last, with bit TSE; a coasting one has bit CST.
Source: EUROCONTROL-SPEC-0149-9.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.io.sensors.format import DAY_S
from sameas.tracks.coordinates import FOOT_M
from sameas.tracks.heights import GEOMETRIC, HeightModel

#: Tracks of a block: 60 octets each at most.
_TRACKS = 20
#: Characters of an identification.
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 "
#: Stages of the objects that are tracks.
_SHOWN = ("confirmed", "coasting")
#: The columns of objects that items are made of.
_COLUMNS = ("object", "stage", "lat_deg", "lon_deg", "speed_m_per_s", "course_deg", "var_x_m2", "cov_xy_m2", "var_y_m2",
            "height_m", "climb_m_per_s", "callsign", "name", "icao", "mode_a")  # fmt: skip


@dataclass
class SentTracks:
    """The last record of every track that was sent and has not ended: its time, and the object."""

    last: dict[int, tuple[float, Mapping[str, Any]]] = field(default_factory=dict)

    def update(
        self, time_s: float, objects: Sequence[Mapping[str, Any]]
    ) -> tuple[set[int], list[tuple[float, Mapping[str, Any]]]]:
        """Takes the objects that are sent now: the numbers of those that begin, and the last records of those that are
        sent no longer."""
        now = {int(one["object"]): (time_s, one) for one in objects}
        begin = set(now) - set(self.last)
        ended = [last for number, last in self.last.items() if number not in now]
        self.last = now
        return begin, ended


def blocks_of_objects(objects: Mapping[str, NDArray[Any]], heights: HeightModel | None) -> Iterator[bytes]:
    """The blocks of all instants of a picture, in order of time.

    objects : columns of :attr:`sameas.picture.picture.Picture.objects`, sorted by time, with ``lat_deg``.
    heights : of which kind they are; None if there are none.
    """
    columns = {name: np.ma.asarray(objects[name]) for name in _COLUMNS if name in objects}
    sent, time_s = SentTracks(), np.asarray(objects["time_s"], np.float64)
    for start, end in pairwise(np.flatnonzero(np.diff(time_s, prepend=-np.inf, append=np.inf) != 0.0).tolist()):
        cells = [column[start:end].tolist() for column in columns.values()]
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*cells, strict=True)]
        yield from track_blocks(float(time_s[start]), rows, sent, heights)


def track_blocks(
    time_s: float, objects: Sequence[Mapping[str, Any]], sent: SentTracks, heights: HeightModel | None
) -> Iterator[bytes]:
    """The blocks of an instant, of up to twenty tracks each.

    time_s : UTC. objects : mappings of the names in an object table, None or absent where unknown.
    sent : the tracks that were given before; updated. heights : as of :func:`blocks_of_objects`.
    """
    placed = [one for one in objects if one["stage"] in _SHOWN and one.get("lat_deg") is not None]
    begin, ended = sent.update(time_s, placed)
    records = [_record(one, last_s, _TRACK_ENDS, heights) for last_s, one in ended]
    records += [_record(one, time_s, _TRACK_BEGINS if one["object"] in begin else 0, heights) for one in placed]
    for first in range(0, len(records), _TRACKS):
        data = b"".join(records[first : first + _TRACKS])
        yield bytes([62]) + (len(data) + 3).to_bytes(2, "big") + data


#: Bits TSE and TSB of octet 2 of item 080.
_TRACK_ENDS, _TRACK_BEGINS = 0x40, 0x20


def _record(one: Mapping[str, Any], time_s: float, status: int, heights: HeightModel | None) -> bytes:
    """The record of a track. status : bits of octet 2 of item 080."""
    unit = 180.0 / 2**25
    lat, lon = round(one["lat_deg"] / unit), round(one["lon_deg"] / unit)
    # Octet 1 of item 080: multisensor; a coasting track has bit CST of octet 4. The lowest bit: an octet follows.
    items: dict[int, bytes] = {
        1: bytes([0, 0]),
        4: (round(time_s % DAY_S * 128.0) % round(DAY_S * 128.0)).to_bytes(3, "big"),
        5: lat.to_bytes(4, "big", signed=True) + lon.to_bytes(4, "big", signed=True),
        12: (one["object"] % 65536).to_bytes(2, "big"),
        13: bytes([0x01, status | 0x01, 0x01, 0x80])
        if one["stage"] == "coasting"
        else bytes([0x01, status])
        if status
        else bytes([0x00]),
        27: _accuracy(one),
    }
    course, speed, icao = one.get("course_deg"), one.get("speed_m_per_s"), str(one.get("icao", ""))
    if speed is not None and course is not None:
        velocity = speed * math.sin(math.radians(course)), speed * math.cos(math.radians(course))
        items[7] = b"".join(_short(v / 0.25) for v in velocity)
    if re.fullmatch("[0-7]{4}", mode_a := str(one.get("mode_a", ""))):
        items[9] = int(mode_a, 8).to_bytes(2, "big")
    if letters := _identification(one.get("callsign") or one.get("name") or ""):
        # A call sign or registration from the target; the name of a ship is not one.
        items[10] = bytes([0x00 if one.get("callsign") else 0x40]) + letters
    if re.fullmatch(r"[0-9A-Fa-f]{6}", icao):
        items[11] = bytes([0x80]) + int(icao, 16).to_bytes(3, "big")
    height, climb = one.get("height_m"), one.get("climb_m_per_s")
    if height is not None and heights is not None:
        if heights.kind == GEOMETRIC:
            items[18] = _short(height / FOOT_M / 6.25)
        else:
            # Quarters of a flight level, in 15 bits below that of a QNH correction, which there is none.
            quarters = int(np.clip(round(height / FOOT_M / 25.0), -60, 6000))
            items[19] = (quarters & 0x7FFF).to_bytes(2, "big")
    if climb is not None:
        items[20] = _short(climb / FOOT_M * 60.0 / 6.25)
    # A presence bit for each item in the order of the standard; the lowest bit of an octet says that one follows.
    octets = [0] * (-(-max(items) // 7))
    for number in items:
        octets[(number - 1) // 7] |= 0x80 >> (number - 1) % 7
    presence = [octet | (k < len(octets) - 1) for k, octet in enumerate(octets)]
    return bytes(presence) + b"".join(items[number] for number in sorted(items))


def _accuracy(one: Mapping[str, Any]) -> bytes:
    """Item 500: accuracies in x and y, and the covariance as a signed square root, in steps of 0.5 m."""
    sigmas = [int(np.clip(round(math.sqrt(one[name] or 0.0) / 0.5), 0, 65535)) for name in ("var_x_m2", "var_y_m2")]
    cross = one["cov_xy_m2"] or 0.0
    return (
        bytes([0b11000000])
        + sigmas[0].to_bytes(2, "big")
        + sigmas[1].to_bytes(2, "big")
        + _short(math.copysign(math.sqrt(abs(cross)), cross) / 0.5)
    )


def _short(value: float) -> bytes:
    """A signed number of two octets."""
    return int(np.clip(round(value), -32768, 32767)).to_bytes(2, "big", signed=True)


def _identification(text: str) -> bytes:
    """Eight characters of six bits (ICAO Annex 10, volume IV, 3.1.2.9); empty where none can be encoded."""
    known = "".join(letter for letter in text.upper() if letter in _LETTERS).strip()[:8].ljust(8)
    if not known.strip():
        return b""
    bits = 0
    for letter in known:
        bits = bits << 6 | (32 if letter == " " else ord(letter) & 0x3F)
    return bits.to_bytes(6, "big")
