"""Blocks: where ASTERIX begins and ends in a file of bare blocks or in a network capture.

It reads files of blocks one after the other, and pcap captures of UDP (Ethernet, Linux cooked, bare IP); a capture
also has the time of each packet, and with it the date that the records lack.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

_PCAP = {b"\xd4\xc3\xb2\xa1": ("<", 1e6), b"\xa1\xb2\xc3\xd4": (">", 1e6),
         b"\x4d\x3c\xb2\xa1": ("<", 1e9), b"\xa1\xb2\x3c\x4d": (">", 1e9)}  # fmt: skip
#: Bytes before the IP header by the kind of link; −2 of them are the protocol where there are any.
_LINKS = {1: 14, 101: 0, 113: 16, 228: 0, 276: 20}
PCAPNG = b"\x0a\x0d\x0d\x0a"


@dataclass(frozen=True)
class Block:
    """One block: the number of its packet (1 in a bare file), its place there, its category, the data after the head.

    ``received_s`` is the time of its packet, NaN where the file has none. ``problem`` is why there is no data.
    """

    packet: int
    offset: int
    category: int
    data: bytes
    received_s: float = float("nan")
    problem: str = ""


def blocks_of(content: bytes, received_s: float = float("nan")) -> Iterator[Block]:
    """The blocks in a file, or in a datagram received then. Other bytes become a block with a problem."""
    if content[:4] in _PCAP:
        for number, (received_s, payload) in enumerate(_packets(content), start=1):
            yield from _cut(payload, number, received_s)
    else:
        yield from _cut(content, 1, received_s)


def looks_like(content: bytes) -> bool:
    """Whether these bytes are a capture, or begin with a block of a likely category and length."""
    if content[:4] in _PCAP:
        return True
    length = int.from_bytes(content[1:3], "big")
    if len(content) < 6 or content[0] not in (1, 2, 4, 8, 9, 10, 11, 19, 20, 21, 23, 34, 48, 62, 63, 65, 247):
        return False
    return 4 <= length <= len(content) and (length == len(content) or content[length] < 248)


def _cut(data: bytes, packet: int, received_s: float) -> Iterator[Block]:
    at = 0
    while at < len(data):
        length = int.from_bytes(data[at + 1 : at + 3], "big")
        if length < 4 or at + length > len(data):
            problem = f"length {length} of the block at byte {at} does not fit; nothing after it can be read"
            yield Block(packet, at, data[at], b"", received_s, problem)
            return
        yield Block(packet, at, data[at], data[at + 3 : at + length], received_s)
        at += length


def _packets(content: bytes) -> Iterator[tuple[float, bytes]]:
    """Times and UDP payloads of a pcap file; other packets are left out, and fragments too."""
    order, unit = _PCAP[content[:4]]
    link = struct.unpack(order + "I", content[20:24])[0] & 0xFFFF if len(content) >= 24 else -1
    skipped = _LINKS.get(link)
    at = 24
    while skipped is not None and at + 16 <= len(content):
        second, fraction, length, _ = struct.unpack(order + "IIII", content[at : at + 16])
        payload = _udp(content[at + 16 : at + 16 + length], skipped)
        if payload:
            yield second + fraction / unit, payload
        at += 16 + length


def _udp(frame: bytes, skipped: int) -> bytes:
    """The UDP payload of a frame over IPv4 or IPv6; empty where there is none."""
    if skipped == 14:
        while frame[skipped - 2 : skipped] in (b"\x81\x00", b"\x88\xa8"):
            skipped += 4
    ip = frame[skipped:]
    if len(ip) < 28:
        return b""
    if ip[0] >> 4 == 4 and ip[9] == 17 and not int.from_bytes(ip[6:8], "big") & 0x3FFF:
        udp = ip[4 * (ip[0] & 15) : int.from_bytes(ip[2:4], "big")]
    elif ip[0] >> 4 == 6 and ip[6] == 17:
        udp = ip[40:]
    else:
        return b""
    return udp[8 : int.from_bytes(udp[4:6], "big")]
