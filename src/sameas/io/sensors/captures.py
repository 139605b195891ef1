"""Recordings of a network or of a surveillance centre: the datagrams in them, with the times of receipt.

- pcap and pcapng of Wireshark and tcpdump: UDP over IPv4 and IPv6, on Ethernet, Linux cooked, loopback and raw IP.
- IOSS Final Format: every frame has its length, the board, the day and the time of recording, and ends with four bytes
  A5; with sequence numbers these are in front of the board. The day has no month, so there is no date.
- RFF of Comsoft: a header of 128 bytes with the begin and the end, then frames with milliseconds since the begin.

Source for the frames of IOSS and RFF: the framing definitions of jASTERIX; for pcapng: draft-ietf-opsawg-pcapng.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from datetime import UTC, datetime

_PCAP = {b"\xd4\xc3\xb2\xa1": ("<", 1e6), b"\xa1\xb2\xc3\xd4": (">", 1e6),
         b"\x4d\x3c\xb2\xa1": ("<", 1e9), b"\xa1\xb2\x3c\x4d": (">", 1e9)}  # fmt: skip
PCAPNG = b"\x0a\x0d\x0d\x0a"
#: Bytes before the IP header, by link type; the last two are the protocol in Ethernet (14 bytes).
_LINKS = {0: 4, 1: 14, 12: 0, 101: 0, 108: 4, 113: 16, 228: 0, 229: 0, 276: 20}
#: Bytes that are in no text.
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f\x7f]")
#: The end of a frame of IOSS, and the lengths of its header, without and with sequence numbers.
_IOSS_END, _IOSS_HEADERS = b"\xa5\xa5\xa5\xa5", (8, 12)
#: Lengths of the header of an RFF file, of its two times, of the header of a frame, and of the longest frame.
_RFF_HEADER, _RFF_TIME, _RFF_FRAME, _RFF_LONGEST = 128, 20, 6, 0x2000


def is_capture(content: bytes) -> bool:
    """Whether these bytes are a recording of datagrams."""
    return content[:4] in (*_PCAP, PCAPNG) or _ioss_header(content, 0) > 0 or _rff_start(content) is not None


def datagrams_of(content: bytes) -> Iterator[tuple[float, bytes]]:
    """Times of receipt, UTC in seconds, and contents of the datagrams of a recording; of IOSS the times are NaN.

    Packets that are not UDP, and fragments, are skipped. Bytes between frames are given like those of a frame.
    """
    if content[:4] in _PCAP:
        return _of_pcap(content)
    if content[:4] == PCAPNG:
        return _of_pcapng(content)
    start_s = _rff_start(content)
    return _of_ioss(content) if start_s is None else _of_rff(content, start_s)


def with_text_as_lines(content: bytes) -> bytes:
    """A capture whose datagrams are text, as a file of their lines, NMEA sentences behind their times of receipt; any
    other content as it is."""
    if content[:4] not in (*_PCAP, PCAPNG):
        return content
    lines, others = [], 0
    for received_s, payload in datagrams_of(content):
        if not payload.isascii() or _CONTROL.search(payload):
            others += 1
            continue
        stamp = b"" if math.isnan(received_s) else b"%.3f " % received_s
        lines += [
            (stamp if line[:1] in b"!$\\" else b"") + line
            for line in payload.splitlines()
            if line and not line.isspace()
        ]
    return b"\n".join(lines) + b"\n" if len(lines) > others else content


def _of_pcap(content: bytes) -> Iterator[tuple[float, bytes]]:
    order, unit = _PCAP[content[:4]]
    link = struct.unpack(order + "I", content[20:24])[0] & 0xFFFF if len(content) >= 24 else -1
    header = _LINKS.get(link)
    at = 24
    while header is not None and at + 16 <= len(content):
        second, fraction, length, _ = struct.unpack(order + "IIII", content[at : at + 16])
        payload = _udp(content[at + 16 : at + 16 + length], header)
        if payload:
            yield second + fraction / unit, payload
        at += 16 + length


#: Types of the blocks of pcapng: section header, description of an interface, packets without and with a time.
_SECTION, _INTERFACE, _OLD_PACKET, _SIMPLE_PACKET, _PACKET = 0x0A0D0D0A, 1, 2, 3, 6


def _of_pcapng(content: bytes) -> Iterator[tuple[float, bytes]]:
    order, at = "<", 0
    interfaces: list[tuple[int | None, float, float]] = []
    while at + 12 <= len(content):
        kind, length = struct.unpack(order + "II", content[at : at + 8])
        if kind == _SECTION:
            order = "<" if content[at + 8 : at + 12] == b"\x4d\x3c\x2b\x1a" else ">"
            length = struct.unpack(order + "I", content[at + 4 : at + 8])[0]
            interfaces = []
        if length < 12 or at + length > len(content):
            return
        body = content[at + 8 : at + length - 4]
        if kind == _INTERFACE and len(body) >= 8:
            interfaces.append(_interface(body, order))
        elif kind in (_PACKET, _OLD_PACKET) and len(body) >= 20:
            number, high, low, captured = struct.unpack(order + ("IIII" if kind == _PACKET else "HxxIII"), body[:16])
            if number < len(interfaces):
                header, tick_s, offset_s = interfaces[number]
                payload = b"" if header is None else _udp(body[20 : 20 + captured], header)
                if payload:
                    yield ((high << 32) + low) * tick_s + offset_s, payload
        elif kind == _SIMPLE_PACKET and interfaces and interfaces[0][0] is not None:
            payload = _udp(body[4:], interfaces[0][0])
            if payload:
                yield math.nan, payload
        at += length


def _interface(body: bytes, order: str) -> tuple[int | None, float, float]:
    """Bytes before the IP header, seconds of a tick of the clock and its offset, of an interface of pcapng."""
    tick_s, offset_s, at = 1e-6, 0.0, 8
    while at + 4 <= len(body):
        option, length = struct.unpack(order + "HH", body[at : at + 4])
        value = body[at + 4 : at + 4 + length]
        if option == 0:
            break
        if option == 9 and value:
            tick_s = 2.0 ** -(value[0] & 0x7F) if value[0] & 0x80 else 10.0 ** -value[0]
        elif option == 14 and len(value) == 8:
            offset_s = float(struct.unpack(order + "q", value)[0])
        at += 4 + -(-length // 4) * 4
    return _LINKS.get(struct.unpack(order + "H", body[:2])[0]), tick_s, offset_s


def _udp(frame: bytes, header: int) -> bytes:
    """The UDP payload of a frame with IPv4 or IPv6; empty where there is none."""
    if header == 14:
        while frame[header - 2 : header] in (b"\x81\x00", b"\x88\xa8"):
            header += 4
    ip = frame[header:]
    if len(ip) < 28:
        return b""
    if ip[0] >> 4 == 4 and ip[9] == 17 and not int.from_bytes(ip[6:8], "big") & 0x3FFF:
        udp = ip[4 * (ip[0] & 15) : int.from_bytes(ip[2:4], "big")]
    elif ip[0] >> 4 == 6 and ip[6] == 17:
        udp = ip[40:]
    else:
        return b""
    return udp[8 : int.from_bytes(udp[4:6], "big")]


def _ioss_header(content: bytes, at: int) -> int:
    """Bytes before the content of the frame of IOSS that begins at ``at``; 0 where none does.

    With sequence numbers, the block in the frame begins four bytes later: its length fits there only.
    """
    end = at + int.from_bytes(content[at : at + 2], "big")
    if not at + _IOSS_HEADERS[0] + 7 <= end <= len(content) or content[end - 4 : end] != _IOSS_END:
        return 0
    for header in _IOSS_HEADERS:
        block = at + header
        if 4 <= int.from_bytes(content[block + 1 : block + 3], "big") <= end - 4 - block and content[block]:
            return header
    return 0


def _of_ioss(content: bytes) -> Iterator[tuple[float, bytes]]:
    at, lost = 0, 0
    while at < len(content):
        header = _ioss_header(content, at)
        if header:
            if lost < at:
                yield math.nan, content[lost:at]
            end = at + int.from_bytes(content[at : at + 2], "big")
            yield math.nan, content[at + header : end - 4]
            at = lost = end
        else:
            found = content.find(_IOSS_END, at)
            at = len(content) if found < 0 else found + len(_IOSS_END)
    if lost < len(content):
        yield math.nan, content[lost:]


def _rff_start(content: bytes) -> float | None:
    """The begin of a recording in RFF, UTC in seconds; None where this is none."""
    if len(content) < _RFF_HEADER + _RFF_FRAME or content[0] > 0x7F:
        return None
    start_s, end_s = (_rff_time(content[k * _RFF_TIME : (k + 1) * _RFF_TIME]) for k in range(2))
    length = int.from_bytes(content[_RFF_HEADER + 4 : _RFF_HEADER + _RFF_FRAME], "little")
    block = content[_RFF_HEADER + _RFF_FRAME :][:3]
    # In a text that begins with two times, the length would be of two letters: 8 kB or more.
    fits = len(block) == 3 and 4 <= int.from_bytes(block[1:], "big") <= length < _RFF_LONGEST
    return start_s if fits and end_s is not None else None


def _rff_time(text: bytes) -> float | None:
    """UTC of a date and a time of day, the year first or last; None for anything else."""
    numbers = [int(one) for one in re.findall(rb"\d+", text)[:6]]
    if len(numbers) < 6:
        return None
    if numbers[0] < 1000:
        numbers[:3] = numbers[2::-1]
    try:
        return datetime(*numbers, tzinfo=UTC).timestamp()  # type: ignore[misc, arg-type]
    except ValueError:
        return None


def _of_rff(content: bytes, start_s: float) -> Iterator[tuple[float, bytes]]:
    at = _RFF_HEADER
    while at + _RFF_FRAME <= len(content):
        since_ms, length = struct.unpack("<IH", content[at : at + _RFF_FRAME])
        at += _RFF_FRAME
        yield start_s + since_ms / 1000.0, content[at : at + length]
        at += length
