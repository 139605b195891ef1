"""Records: the items of one block, by name, as bytes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from sameas.io.sensors.asterix.layout import Category, Field, Length

Item = bytes | Mapping[str, bytes]


class DamagedRecord(ValueError):
    """A record that ends in the middle of an item, or names an item that its category does not have."""


def records_of(category: Category, data: bytes) -> Iterator[dict[str, Item]]:
    """The records in the data of a block, the items of each by name; compounds by the names of their subfields.

    Raises
    ------
    DamagedRecord : after the last whole record; what follows it in the block cannot be found.

    Example
    -------
    >>> from sameas.io.sensors.asterix.layout import CATEGORIES
    >>> [record] = records_of(CATEGORIES[48], bytes.fromhex("D0 0102 054600 0A002000"))
    >>> {name: value.hex() for name, value in record.items()}
    {'010': '0102', '140': '054600', '040': '0a002000'}
    """
    at = 0
    while at < len(data):
        items: dict[str, Item] = {}
        chosen, at = _chosen(category.items, data, at)
        for name, length in chosen:
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
    chosen, at = _chosen(fields, data, at)
    for name, length in chosen:
        end = _end(length, data, at)
        parts[name] = data[at:end]
        at = end
    return parts, at


def _chosen(fields: tuple[Field | None, ...], data: bytes, at: int) -> tuple[list[Field], int]:
    """The items that a field specification names, and where it ends; seven bits a byte, the eighth tells of more."""
    chosen: list[Field] = []
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
                chosen.append(field)
        bit += 7
        if not byte & 1:
            return chosen, at


def _end(length: Length, data: bytes, at: int) -> int:
    """Where the item at ``at`` ends."""
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
    """The item as a whole number."""
    return int.from_bytes(item, "big")


def signed(item: bytes) -> int:
    """The item as a whole number in two's complement."""
    return int.from_bytes(item, "big", signed=True)


#: The alphabet of call signs: six bits a letter (ICAO Annex 10); what is no letter is a blank.
_LETTERS = " ABCDEFGHIJKLMNOPQRSTUVWXYZ     " + " " * 16 + "0123456789      "


def letters(item: bytes) -> str | None:
    """The text of an item of six-bit letters; None where it is blank."""
    number, count = unsigned(item), len(item) * 8 // 6
    text = "".join(_LETTERS[number >> 6 * (count - 1 - k) & 63] for k in range(count)).strip()
    return text or None


def octal(item: bytes, bits: int = 12) -> str:
    """Mode A code: the lowest bits in octal digits."""
    return f"{unsigned(item) & (1 << bits) - 1:0{bits // 3}o}"
