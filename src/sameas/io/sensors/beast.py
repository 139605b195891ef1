"""Beast: the binary messages of Mode S receivers (dump1090, readsb, Radarcape; port 30005).

A frame is 0x1a, a type ("1" Mode A/C, "2" and "3" Mode S of 7 and 14 bytes, "4" and "5" states of the receiver), a
counter of 6 bytes, the signal level and the message. Of what follows the type, 0x1a is written twice. The counter has
12 MHz, or, of a receiver with GPS, seconds of the day in its upper 18 bits and nanoseconds in its lower 30.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from sameas.arrays import FloatArray

COUNTER_HZ = 12e6
#: A counter starts again after this many seconds.
COUNTER_S = 2.0**48 / COUNTER_HZ
_ESCAPE = b"\x1a"
#: Bytes after the type, by type: counter, level, message.
_LENGTHS = {b"1": 9, b"2": 14, b"3": 21, b"4": 21, b"5": 21}
_MODE_S = (b"2", b"3")
_OTHERS = {b"1": "Mode A/C message", b"4": "state of the receiver", b"5": "state of the receiver"}
#: The start of a frame: an escape that is not written twice, and a type.
_START = re.compile(rb"(?<!\x1a)(?:\x1a\x1a)*\x1a([1-5])")
#: A counter with this many different upper parts or more is one of GPS if no lower part has 10⁹ or more: of a counter
#: of 12 MHz one in 14 has.
_FEWEST_UPPER = 10


@dataclass
class Frames:
    """The frames of a stream.

    messages : Mode S messages, in hexadecimal. numbers : of their frames, from 1. counters : of their frames.
    passed_over : number of other frames, by what they are. damaged : numbers of frames of a wrong length, and of what
    is no frame. n_frames : their number. end : bytes of whole frames; what is left may become one.
    """

    messages: list[str] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    counters: list[int] = field(default_factory=list)
    passed_over: Counter[str] = field(default_factory=Counter)
    damaged: list[tuple[int, str]] = field(default_factory=list)
    n_frames: int = 0
    end: int = 0


def looks_like(head: bytes) -> bool:
    """Whether bytes begin with a frame, and with another one after it, if they are longer.

    >>> looks_like(bytes.fromhex("1a320000000000000d5d39810c8ffa34")), looks_like(b"*5D39810C8FFA34;")
    (True, False)
    """
    if head[:1] != _ESCAPE or head[1:2] not in _LENGTHS:
        return False
    frames = split_frames(head[: 1 << 12])
    return not frames.damaged and (frames.n_frames > 0 or len(head) < 2 * _LENGTHS[head[1:2]] + 2)


def split_frames(data: bytes, *, final: bool = False) -> Frames:
    """The frames in bytes.

    final : whether nothing follows; then a frame that is cut off is damaged.
    """
    frames = Frames()
    starts = [(match.end() - 2, match[1]) for match in _START.finditer(data)]
    if not starts or starts[0][0] > 0:
        end = starts[0][0] if starts else len(data) - _ends_with_half(data)
        if (starts or final or len(data) > max(_LENGTHS.values())) and data:
            frames.damaged.append((1, "bytes that are no Beast frame"))
            frames.end = end
    for (start, kind), (end, _) in pairwise([*starts, (len(data), b"")]):
        if end == len(data) and not final and _ends_with_half(data):
            end -= 1
        body = data[start + 2 : end].replace(_ESCAPE * 2, _ESCAPE)
        if end >= len(data) - 1 and not final and len(body) < _LENGTHS[kind]:
            break
        frames.end = end
        frames.n_frames += 1
        if len(body) != _LENGTHS[kind]:
            frames.damaged.append((frames.n_frames, "a Beast frame of another length"))
        elif kind in _MODE_S:
            frames.numbers.append(frames.n_frames)
            frames.counters.append(int.from_bytes(body[:6]))
            frames.messages.append(body[7:].hex())
        else:
            frames.passed_over[_OTHERS[kind]] += 1
    return frames


def _ends_with_half(data: bytes) -> bool:
    """Whether the last byte is an escape that is the first half of two, or begins a frame."""
    return (len(data) - len(data.rstrip(_ESCAPE))) % 2 == 1


def seconds_of(counters: list[int]) -> tuple[FloatArray, float]:
    """Seconds (n,) of the counters of a receiver, and the seconds after which they start again.

    Of a counter of 12 MHz they count from any time, of one of GPS from midnight UTC.
    """
    values = np.array(counters, np.uint64)
    upper, lower = values >> np.uint64(30), values & np.uint64((1 << 30) - 1)
    if len(np.unique(upper)) >= _FEWEST_UPPER and (lower < 10**9).all() and (upper <= 86400).all():
        return upper + 1e-9 * lower, 86400.0
    return values / COUNTER_HZ, COUNTER_S
