"""Blocks and records of ASTERIX: the items of each record, by name, as bytes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from sameas.io.sensors.captures import datagrams_of, is_capture

# Blocks, in a file of consecutive blocks or in a recording of datagrams.


@dataclass(frozen=True)
class Block:
    """One block. data : after the block header.

    received_s : time of the packet, NaN in a bare file. problem : why there is no data.
    """

    category: int
    data: bytes
    received_s: float = float("nan")
    problem: str = ""


def blocks_of(content: bytes, received_s: float) -> Iterator[Block]:
    """The blocks in a file, or in a datagram received at this time. Bytes of no block become one with a problem."""
    if is_capture(content):
        for received_s, payload in datagrams_of(content):
            yield from _split(payload, received_s)
    else:
        yield from _split(content, received_s)


def looks_like(content: bytes) -> bool:
    """Whether these bytes are a capture, or begin with a block of a likely category and length.

    The quotation mark and the letter A with which tables begin are categories, and the next two letters of a table are
    a length in a file of 30 kB; but no block is text.
    """
    if is_capture(content):
        return True
    length = int.from_bytes(content[1:3], "big")
    if len(content) < 6 or content[0] not in _LIKELY or _NOT_IN_TEXT.search(content[:length]) is None:
        return False
    return 4 <= length <= len(content) and (length == len(content) or content[length] < 248)


def _split(data: bytes, received_s: float) -> Iterator[Block]:
    split = split_blocks(data, final=True)
    for start, end in sorted([*split.blocks, *split.gaps]):
        if (start, end) in split.gaps:
            cut_off = end == len(data) and looks_cut_off(data[start:])
            what = "are a block that is cut off" if cut_off else "are no block; reading continues after them"
            yield Block(data[start], b"", received_s, f"{end - start} bytes at byte {start} {what}")
        else:
            yield Block(data[start], data[start + 3 : end], received_s)


# Framing. A block has its category and its length, and no mark at which it begins. Where bytes of a stream are missing
# or foreign, a block has the wrong length, and the header after it is none. The next place is searched at which a block
# of a known category begins, whose records end where it ends, and which another block follows.

#: Categories that are sent along with the ones that are read; I010, the sensor, is the first item of all of them.
_LIKELY = (1, 2, 4, 8, 9, 10, 11, 19, 20, 21, 23, 34, 48, 62, 63, 65, 247)
_HEADER = re.compile(b"[" + b"".join(b"\\x%02x" % category for category in _LIKELY) + b"][\\x00-\\x1f]", re.DOTALL)
_NOT_IN_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
#: Bytes in which a block may begin that are kept while none is found; longer blocks are rare, and lost here.
_KEPT = 8192


@dataclass(frozen=True)
class BlockSplit:
    """Places (start, end) in bytes. blocks : the blocks. gaps : bytes that belong to none. end : where an incomplete
    block may begin."""

    blocks: list[tuple[int, int]]
    gaps: list[tuple[int, int]]
    end: int


def split_blocks(data: bytes, *, final: bool) -> BlockSplit:
    """The blocks in consecutive bytes, found again after bytes that are missing or foreign.

    final : whether nothing follows: a datagram, a file, the end of a connection. Otherwise the last block is taken at
        once if its records end with it; whether another follows is not yet known.

    >>> one = bytes.fromhex("30 000D D0 0102 054600 0A002000")
    >>> split_blocks(one + b"#" + one[4:] + one + one, final=True)
    BlockSplit(blocks=[(0, 13), (23, 36), (36, 49)], gaps=[(13, 23)], end=49)
    """
    blocks: list[tuple[int, int]] = []
    gaps: list[tuple[int, int]] = []
    at, n = 0, len(data)
    while at < n:
        end = _end_of_block(data, at)
        # Where nothing follows yet, the records of the block must end with it.
        if 0 <= end <= n and (_begins(data, end) if end < n else final or _is_sound(data, at, end)):
            blocks.append((at, end))
            at = end
            continue
        found = _next_block(data, at + 1)
        if found is not None:
            if 0 <= end <= found and _is_sound(data, at, end):
                # Foreign bytes between two blocks; without them, the block has lost some of its own.
                blocks.append((at, end))
                at = end
            gaps.append((at, found))
            at = found
        elif final:
            gaps.append((at, n))
            at = n
        elif n - at > _KEPT and not (end > n and data[at] in _LIKELY and _head_is_sound(data, at)):
            gaps.append((at, n - _KEPT))
            at = n - _KEPT
            break
        else:
            break
    return BlockSplit(blocks, gaps, at)


def looks_cut_off(data: bytes) -> bool:
    """Whether bytes that are no block begin with the header of a longer one."""
    return data[0] in _LIKELY and (len(data) < 3 or int.from_bytes(data[1:3], "big") > len(data))


def _end_of_block(data: bytes, at: int) -> int:
    """The end of the block that begins at ``at``, -1 where its header is incomplete or no header."""
    length = int.from_bytes(data[at + 1 : at + 3], "big") if at + 3 <= len(data) else 0
    return at + length if length >= 4 else -1


def _begins(data: bytes, at: int) -> bool:
    """Whether a block of a likely category seems to begin here, or of any category that one of these follows."""
    end = _end_of_block(data, at)
    likely = data[at] in _LIKELY
    if likely and (len(data) - at < 4 or (end > 0 and data[at + 3] >= 0x80)):
        return True
    return 0 < end <= len(data) and (end == len(data) or (data[end] in _LIKELY and (likely or _begins(data, end))))


def _next_block(data: bytes, at: int) -> int | None:
    """Where the next block begins, from ``at`` on; None where none is found."""
    for header in _HEADER.finditer(data, at):
        start = header.start()
        end = _end_of_block(data, start)
        if end < 0 or end > len(data) or not _is_sound(data, start, end):
            continue
        # Categories that are not read have no records to check: another block must follow.
        if data[start] in CATEGORIES and (end == len(data) or _begins(data, end)):
            return start
        if end < len(data) and data[end] in CATEGORIES and _begins(data, end):
            return start
    return None


def _is_sound(data: bytes, start: int, end: int) -> bool:
    """Whether the records of a block end where it ends, and name their sensor; for a category that is not read, whether
    its first record does."""
    if data[start] not in CATEGORIES:
        return data[start] in _LIKELY and end - start >= 6 and data[start + 3] >= 0x80
    try:
        named = ["010" in items for items in records_of(CATEGORIES[data[start]], data[start + 3 : end])]
        return named[0] if data[start] == 1 and named else all(named)
    except DamagedRecord:
        return False


def _head_is_sound(data: bytes, start: int) -> bool:
    """Whether an incomplete block begins with a record of its category."""
    if data[start] not in CATEGORIES:
        return data[start + 3] >= 0x80
    try:
        return "010" in next(records_of(CATEGORIES[data[start]], data[start + 3 :]), {})
    except DamagedRecord:
        return False


# Layout: the items of a record of each category, in the order of the field specification (FSPEC), and their lengths.
#
# A length is
#
# - ``3`` — number of bytes;
# - ``"1+"`` — parts of this many bytes; the lowest bit of a part is set if another follows;
# - ``"n8"`` — repetition count in one byte, then that many parts of 8 bytes;
# - ``"len"`` — the first byte is the length of the item, including itself;
# - a tuple of (name, length) — compound item: a field specification of its own, then its subfields.
#
# Sources: EUROCONTROL-SPEC-0149-12 (category 021, editions 2.1 to 2.7), -4 (048, 1.27 to 1.32), -2b (034, 1.27 to
# 1.29), -2a (001, 1.1 to 1.4; 002), -9 (062, 1.16 to 1.21), -14 (020, 1.5 to 1.11), -7 (010, 1.1).

Length = int | str | tuple["Field | None", ...]
#: Name and length of an item; None where the field specification has a spare bit.
Field = tuple[str, Length]


def _field(part: str) -> Field:
    name, length = part.split(":")
    return name, int(length) if length.isdigit() else length


@dataclass(frozen=True)
class AsterixCategory:
    """One category: ``items`` in the order of the bits of the field specification.

    of_tracks : those of records of tracks, where they are others; such a record has the first bit of item 020.
    """

    number: int
    items: tuple[Field | None, ...]
    of_tracks: tuple[Field | None, ...] = ()

    def items_at(self, data: bytes, at: int) -> tuple[Field | None, ...]:
        """The items of the record that begins here."""
        if not self.of_tracks:
            return self.items
        first, end = data[at], at
        while end < len(data) and data[end] & 1:
            end += 1
        # Item 010, if present, has two bytes.
        descriptor = end + 1 + 2 * bool(first & 0x80)
        is_track = bool(first & 0x40) and descriptor < len(data) and bool(data[descriptor] & 0x80)
        return self.of_tracks if is_track else self.items


def _category(number: int, items: str, compounds: Mapping[str, str]) -> AsterixCategory:
    fields: list[Field | None] = []
    for part in items.split():
        name = part.split(":")[0]
        if name in compounds:
            fields.append((name, tuple(None if part == "-" else _field(part) for part in compounds[name].split())))
        else:
            fields.append(None if part == "-" else _field(part))
    return AsterixCategory(number, tuple(fields))


_INTENT = "TIS:1+ TID:n15"

_OF_PLOTS = (
    "010:2 020:1+ 040:4 070:2 090:2 130:1+ 141:2 050:2 120:1 131:1 080:2 100:4 060:2 030:1+ 150:1 - - - - SP:len -"
)
_OF_TRACKS = (
    "010:2 020:1+ 161:2 040:4 042:4 200:4 070:2 090:2 141:2 130:1+ 131:1 120:1 170:1+ 210:1+ 050:2 080:2 100:4 060:2 "
    "030:1+ SP:len - 150:1"
)

CATEGORIES = {
    1: replace(_category(1, _OF_PLOTS, {}), of_tracks=_category(1, _OF_TRACKS, {}).items),
    2: _category(2, "010:2 000:1 020:1 030:3 041:2 050:1+ 060:1+ 070:n2 100:8 090:2 080:1+ - SP:len -", {}),
    10: _category(
        10,
        "010:2 000:1 020:1+ 140:3 041:8 040:4 042:4 200:4 202:4 161:2 170:1+ 060:2 220:3 245:7 250:n8 300:1 090:2 "
        "091:2 270:1+ 550:1 310:1 500:4 280:n2 131:1 210:2 - SP:len RE:len",
        {},
    ),
    20: _category(
        20,
        "010:2 020:1+ 140:3 041:8 042:6 161:2 170:1+ 070:2 202:4 090:2 100:4 220:3 245:7 110:2 105:2 210:2 300:1 310:1 "
        "500 400:n1 250:n8 230:2 260:7 030:1+ 055:1 050:2 RE:len SP:len",
        {"500": "DOP:6 SDP:6 SDH:2"},
    ),
    21: _category(
        21,
        "010:2 040:1+ 161:2 015:1 071:3 130:6 131:8 072:3 150:2 151:2 080:3 073:3 074:4 075:3 076:4 140:2 090:1+ 210:1 "
        "070:2 230:2 145:2 152:2 200:1 155:2 157:2 160:4 165:2 077:3 170:6 020:1 220 146:2 148:2 110 016:1 008:1 "
        "271:1+ 132:1 250:n8 260:7 400:1 295 - - - - - RE:len SP:len",
        {
            "220": "WS:2 WD:2 TMP:2 TRB:1",
            "110": _INTENT,
            "295": "AOS:1 TRD:1 M3A:1 QI:1 TI1:1 MAM:1 GH:1 FL:1 SAL:1 FSA:1 AS:1 TAS:1 MH:1 BVR:1 GVR:1 GV:1 TAR:1 "
            "TI2:1 TS:1 MET:1 ROA:1 ARA:1 SCC:1",
        },
    ),
    48: _category(
        48,
        "010:2 140:3 020:1+ 040:4 070:2 090:2 130 220:3 240:6 250:n8 161:2 042:4 200:4 170:1+ 210:4 030:1+ 080:2 100:4 "
        "110:2 120 230:2 260:7 055:1 050:2 065:1 060:2 SP:len RE:len",
        {"130": "SRL:1 SRR:1 SAM:1 PRL:1 PAM:1 RPD:1 APD:1", "120": "CAL:2 RDS:n6"},
    ),
    34: _category(
        34,
        "010:2 000:1 030:3 020:1 041:2 050 060 070:n2 100:8 110:1 120:8 090:2 RE:len SP:len",
        {"050": "COM:1 - - PSR:1 SSR:1 MDS:2", "060": "COM:1 - - PSR:1 SSR:1 MDS:1"},
    ),
    62: _category(
        62,
        "010:2 - 015:1 070:3 105:8 100:6 185:4 210:2 060:2 245:7 380 040:2 080:1+ 290 200:1 295 136:2 130:2 135:2 "
        "220:2 390 270:1+ 300:1 110 120:2 510:3+ 500 340 - - - - - RE:len SP:len",
        {
            "380": "ADR:3 ID:6 MHG:2 IAS:2 TAS:2 SAL:2 FSS:2 TIS:1+ TID:n15 COM:2 SAB:2 ACS:7 BVR:2 GVR:2 RAN:2 TAR:2 "
            "TAN:2 GSP:2 VUN:1 MET:8 EMC:1 POS:6 GAL:2 PUN:1 MB:n8 IAR:2 MAC:2 BPS:2",
            "290": "TRK:1 PSR:1 SSR:1 MDS:1 ADS:2 ES:1 VDL:1 UAT:1 LOP:1 MLT:1",
            "295": "MFL:1 MD1:1 MD2:1 MDA:1 MD4:1 MD5:1 MHG:1 IAS:1 TAS:1 SAL:1 FSS:1 TID:1 COM:1 SAB:1 ACS:1 BVR:1 "
            "GVR:1 RAN:1 TAR:1 TAN:1 GSP:1 VUN:1 MET:1 EMC:1 POS:1 GAL:1 PUN:1 MB:1 IAR:1 MAC:1 BPS:1",
            "390": "TAG:2 CS:7 IFI:4 FCT:1 TAC:4 WTC:1 DEP:4 DST:4 RDS:3 CFL:2 CTL:2 TOD:n4 AST:6 STS:1 STD:7 STA:7 "
            "PEM:2 PEC:7",
            "110": "SUM:1 PMN:4 POS:6 GA:2 EM1:2 TOS:1 XP:1",
            "500": "APC:4 COV:2 APW:4 AGA:1 ABA:1 ATV:2 AA:2 ARC:1",
            "340": "SID:2 POS:4 HEIGHT:2 MDC:2 MDA:2 TYP:1",
        },
    ),
}


Item = bytes | Mapping[str, bytes]


class DamagedRecord(ValueError):
    """A record that ends within an item, or has an item that its category does not define."""


def records_of(category: AsterixCategory, data: bytes) -> Iterator[dict[str, Item]]:
    """The records in the data of a block: items by name, compound items as mappings of their subfields.

    Raises DamagedRecord: after the last valid record; the start of the next one cannot be determined.

    >>> from sameas.io.sensors.asterix_records import CATEGORIES
    >>> [record] = records_of(CATEGORIES[48], bytes.fromhex("D0 0102 054600 0A002000"))
    >>> {name: value.hex() for name, value in record.items()}
    {'010': '0102', '140': '054600', '040': '0a002000'}
    """
    at = 0
    while at < len(data):
        items: dict[str, Item] = {}
        present, at = _fields_of(category.items_at(data, at), data, at)
        for name, length in present:
            if isinstance(length, tuple):
                items[name], at = _compound(length, data, at)
            else:
                end = _end(length, data, at)
                items[name] = data[at:end]
                at = end
        if not items:
            raise DamagedRecord("names no item")
        yield items


def _compound(fields: tuple[Field | None, ...], data: bytes, at: int) -> tuple[Mapping[str, bytes], int]:
    parts: dict[str, bytes] = {}
    present, at = _fields_of(fields, data, at)
    for name, length in present:
        end = _end(length, data, at)
        parts[name] = data[at:end]
        at = end
    return parts, at


def _fields_of(fields: tuple[Field | None, ...], data: bytes, at: int) -> tuple[list[Field], int]:
    """The items of a field specification, and its end: 7 per byte, whose lowest bit says whether another follows."""
    present: list[Field] = []
    bit = 0
    while True:
        if at >= len(data):
            raise DamagedRecord("ends within its field specification")
        byte = data[at]
        at += 1
        for k in range(7):
            if byte >> (7 - k) & 1:
                field = fields[bit + k] if bit + k < len(fields) else None
                if field is None:
                    raise DamagedRecord(f"names item {bit + k + 1} of its field specification, which does not exist")
                present.append(field)
        bit += 7
        if not byte & 1:
            return present, at


def _end(length: Length, data: bytes, at: int) -> int:
    """The end of the item that starts at ``at``."""
    if isinstance(length, int):
        end = at + length
    elif isinstance(length, tuple):
        raise TypeError("a subfield cannot be a compound")
    elif length.endswith("+"):
        step = int(length[:-1])
        end = at + step
        while end <= len(data) and data[end - 1] & 1:
            end += step
    elif at >= len(data):
        raise DamagedRecord("ends within an item")
    elif length == "len":
        end = at + max(data[at], 1)
    else:
        end = at + 1 + data[at] * int(length[1:])
    if end > len(data):
        raise DamagedRecord("ends within an item")
    return end


def unsigned(item: bytes) -> int:
    """The item as an unsigned integer."""
    return int.from_bytes(item, "big")


def signed(item: bytes) -> int:
    """The item as a signed integer (two's complement)."""
    return int.from_bytes(item, "big", signed=True)


#: Six-bit characters of call signs (ICAO Annex 10); undefined codes are blanks.
_LETTERS = " ABCDEFGHIJKLMNOPQRSTUVWXYZ     " + " " * 16 + "0123456789      "


def letters(item: bytes) -> str | None:
    """The text of an item of six-bit characters; None where it is blank."""
    number, count = unsigned(item), len(item) * 8 // 6
    text = "".join(_LETTERS[number >> 6 * (count - 1 - k) & 63] for k in range(count)).strip()
    return text or None


def octal(item: bytes) -> str:
    """Mode A code: the lowest 12 bits in octal digits."""
    return f"{unsigned(item) & 0xFFF:04o}"
