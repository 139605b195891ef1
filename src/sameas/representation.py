"""How values print: a dataclass of arrays in a few lines, whatever its size; counts with their nouns."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

#: Characters of a line, lines of a value, characters of a field, items of a collection that are printed (all chosen).
WIDTH, LINES, LETTERS, ITEMS = 100, 9, 60, 4

ORDINALS = (
    "first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth", "eleventh",
    "twelfth",
)  # fmt: skip

T = TypeVar("T")


def in_short(cls: type[T]) -> type[T]:
    """Make a dataclass that users get print in at most ten lines: arrays by type and shape, long values by size.

    >>> from dataclasses import dataclass
    >>> @in_short
    ... @dataclass(frozen=True)
    ... class Points:
    ...     name: str
    ...     at: np.ndarray
    >>> Points("all", np.zeros((1000, 2)))
    Points(name='all', at=<float64 (1000, 2)>)
    """
    cls.__repr__ = _in_lines  # type: ignore[method-assign]
    return cls


def _in_lines(self: Any) -> str:
    parts = [f"{field.name}={shown(getattr(self, field.name))}" for field in fields(self) if field.repr]
    lines = textwrap.wrap(
        f"{type(self).__qualname__}({', '.join(parts)})", WIDTH, subsequent_indent="    ", break_on_hyphens=False
    )
    return "\n".join(lines if len(lines) <= LINES else [*lines[:LINES], "    …)"])


def shown(value: Any) -> str:
    """A value in a few words."""
    if isinstance(value, np.ndarray):
        if value.size <= ITEMS and value.dtype.kind != "O":
            return " ".join(repr(value.tolist()).split())
        masked = "masked " if isinstance(value, np.ma.MaskedArray) else ""
        return f"<{masked}{value.dtype} {value.shape}>"
    if hasattr(value, "colnames"):
        return f"<{type(value).__name__} of {len(value)} rows, {len(value.colnames)} columns>"
    if is_dataclass(value) and not isinstance(value, type):
        text = _in_lines(value)
        return text if len(text) <= LETTERS and "\n" not in text else f"{type(value).__qualname__}(…)"
    if isinstance(value, str):
        return repr(value if len(value) <= LETTERS else value[: LETTERS - 1] + "…")
    if isinstance(value, Mapping | Sequence | set | frozenset):
        return _collection(value)
    text = " ".join(repr(value).split())
    return text if len(text) <= LETTERS else f"<{type(value).__qualname__}>"


def _collection(values: Any) -> str:
    """A short collection in full, a longer one by its type and number of items."""
    if len(values) <= ITEMS:
        if isinstance(values, Mapping):
            text = "{" + ", ".join(f"{shown(key)}: {shown(value)}" for key, value in values.items()) + "}"
        else:
            items = ", ".join(map(shown, values))
            text = f"[{items}]" if isinstance(values, list) else f"({items}{',' * (len(values) == 1)})"
        if len(text) <= 2 * LETTERS:
            return text
    return f"<{type(values).__name__} of {len(values)}>"


def count(number: int | np.integer) -> str:
    """An integer with its thousands separated by spaces.

    >>> count(12345)
    '12 345'
    """
    return f"{int(number):,}".replace(",", " ")


def listed(names: Sequence[str]) -> str:
    """Names in a sentence.

    >>> listed(["ais"]), listed(["ais", "radar", "mlat"])
    ('ais', 'ais, radar and mlat')
    """
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def counted(number: int | np.integer, noun: str, plural: str = "") -> str:
    """A number with its noun, or its noun and verb; without ``plural`` the noun gets an s.

    >>> counted(1, "report"), counted(12345, "report"), counted(2, "report has", "reports have")
    ('1 report', '12 345 reports', '2 reports have')
    """
    return f"{count(number)} {noun if number == 1 else plural or noun + 's'}"
