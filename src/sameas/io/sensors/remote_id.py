"""Messages of Remote ID (ASTM F3411) in JSON, as receivers pass them on: base64, hexadecimal, or numbers of bytes.

A message has 25 bytes: its type and the version, then the content. Bluetooth 4 sends one at a time: the address of the
sender says whose a position is, and another message who that is. Wi-Fi and Bluetooth 5 send packs of messages.
"""

from __future__ import annotations

import base64
import binascii
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sameas.io.sensors.format import RADIUS_95
from sameas.tracks.coordinates import MILE_M

_SIZE = 25
_BASIC_ID, _LOCATION, _SYSTEM_LAST, _PACK = 0, 1, 5, 15
#: Names of columns, without signs and in lower case, with the address of the sender.
_ADDRESSES = ("macaddress", "mac", "macaddr", "bssid", "address", "sendermac", "transmitter")
#: Radius of 95 % of a horizontal accuracy, metres, by its number; the first is unknown.
_RADII_M = (0.0, 10 * MILE_M, 4 * MILE_M, 2 * MILE_M, MILE_M, 0.5 * MILE_M, 0.3 * MILE_M, 0.1 * MILE_M, 0.05 * MILE_M,
            30.0, 10.0, 3.0, 1.0)  # fmt: skip
_HEXADECIMAL = re.compile(r"(?:[0-9a-fA-F]{2}[\s:]?)+")


def with_messages(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any] | None]:
    """The rows of JSON with what the messages in them say; the same rows where there are none.

    None in place of a row whose message has no position; it may say who the sender is. The column ``uas_id`` is the
    identity that the sender has anywhere in these rows, else the address of the sender.
    """
    found = [_message_of(row) for row in rows]
    if not any(name for name, _ in found):
        return list(rows)
    identity: dict[str, str] = {}
    out: list[dict[str, Any] | None] = []
    for row, (name, data) in zip(rows, found, strict=True):
        values, address = _values(data), _address(row)
        if address and "uas_id" in values:
            identity[address] = values["uas_id"]
        # The type that a receiver states is that of the radio.
        others = {key: cell for key, cell in row.items() if key not in (name, "type")}
        out.append(None if name and "latitude" not in values else others | {"uas_id": None} | values)
    for row, made in zip(rows, out, strict=True):
        if made is not None:
            address = _address(row)
            made["uas_id"] = made.get("uas_id") or identity.get(address or "") or address
    return out


def _message_of(row: Mapping[str, Any]) -> tuple[str, bytes]:
    """The name of the cell with messages, and these; "" for none."""
    for name, cell in row.items():
        for data in _bytes_of(cell):
            if _is_message(data):
                return name, data
    return "", b""


def _bytes_of(cell: Any) -> Iterator[bytes]:
    """The bytes that a cell may stand for."""
    if isinstance(cell, list) and len(cell) >= _SIZE and all(isinstance(one, int) and 0 <= one < 256 for one in cell):
        yield bytes(cell)
    if not isinstance(cell, str) or len(cell) < _SIZE:
        return
    if _HEXADECIMAL.fullmatch(cell.strip()):
        yield bytes.fromhex(re.sub(r"[\s:]", "", cell))
    try:
        yield base64.b64decode(cell.strip(), validate=True)
    except (binascii.Error, ValueError):
        return


def _is_message(data: bytes) -> bool:
    """Whether bytes are a message or a pack of them, in full; a receiver may pass on more bytes of zero."""
    if len(data) < _SIZE:
        return False
    kind = data[0] >> 4
    if kind == _PACK:
        return data[1] == _SIZE and 1 <= data[2] <= 9 and len(data) >= 3 + data[2] * _SIZE
    return kind <= _SYSTEM_LAST and data[0] & 15 <= 3 and not any(data[_SIZE:])


def _values(data: bytes) -> dict[str, Any]:
    """The identity and the position in a message or a pack, by names of columns of a table."""
    if not data:
        return {}
    values: dict[str, Any] = {}
    in_pack = data[0] >> 4 == _PACK
    starts = range(3, 3 + data[2] * _SIZE, _SIZE) if in_pack else (0,)
    for start in starts:
        message = data[start : start + _SIZE]
        if message[0] >> 4 == _BASIC_ID and message[1] >> 4:
            if name := message[2:22].split(b"\0")[0].decode("ascii", "ignore").strip():
                values["uas_id"] = name
        elif message[0] >> 4 == _LOCATION:
            values |= _location(message)
    return values


def _location(message: bytes) -> dict[str, float]:
    """The position, the height and the motion in a message of type 1, without what it marks as unknown."""
    flags, direction, speed, climb, lat, lon, pressure_alt, alt = struct.unpack("<BBBbiiHH", message[1:17])
    values: dict[str, float] = {}
    if lat or lon:
        values |= {"latitude": lat * 1e-7, "longitude": lon * 1e-7}
    if alt:
        values["altitude_m"] = 0.5 * alt - 1000.0
    if pressure_alt:
        values["pressure_altitude_m"] = 0.5 * pressure_alt - 1000.0
    course = direction + 180.0 * bool(flags & 2)
    if course <= 360.0:
        values["course"] = course % 360.0
    if not (speed == 255 and flags & 1):
        values["speed_mps"] = 0.75 * speed + 63.75 if flags & 1 else 0.25 * speed
    if climb != 126:
        values["climb_mps"] = 0.5 * climb
    radius_m = _RADII_M[min(message[19] & 15, len(_RADII_M) - 1)]
    if radius_m:
        values["sigma_m"] = radius_m / RADIUS_95
    return values


def _address(row: Mapping[str, Any]) -> str | None:
    """The address of the sender of a row, in capitals."""
    for name, cell in row.items():
        if re.sub(r"[^a-z]", "", name.lower()) in _ADDRESSES and isinstance(cell, str):
            return cell.upper()
    return None
