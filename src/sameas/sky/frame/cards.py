"""Cards: what a header says under the many names that observatories use for one thing.

A fact is looked up by a list of names, the more certain ones first, and comes with the line that says where it was
found and how it was read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from astropy.io.fits import Header

_SEXAGESIMAL = re.compile(
    r"^\s*([+-]?)\s*(\d+)[\s:hHdD°]+(\d+)(?:[\s:mM']+(\d+(?:\.\d*)?))?\s*[sS\"]?\s*([NSEWnsew]?)\s*$"
)
_NUMBER = re.compile(r"^\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+)?)\s*[A-Za-z/\-_]*\s*$")


@dataclass(frozen=True)
class Card:
    """One keyword with its value and comment."""

    name: str
    value: Any
    comment: str = ""

    def number(self) -> float:
        """The value as a number, NaN where it is none; a unit behind it is passed over."""
        if isinstance(self.value, bool):
            return math.nan
        if isinstance(self.value, int | float):
            return float(self.value)
        match = _NUMBER.match(str(self.value))
        return float(match[1].replace("D", "E").replace("d", "e")) if match else math.nan

    def angle(self) -> tuple[float, bool]:
        """The value in its first unit (hours or degrees), and whether it was sexagesimal; NaN where it is neither."""
        match = _SEXAGESIMAL.match(str(self.value)) if isinstance(self.value, str) else None
        if match is None:
            return self.number(), False
        first, minutes, seconds = float(match[2]), float(match[3]), float(match[4] or 0.0)
        if minutes >= 60 or seconds >= 60:
            return math.nan, True
        sign = -1.0 if match[1] == "-" or match[5].upper() == "S" else 1.0
        return sign * (first + minutes / 60 + seconds / 3600), True

    def text(self) -> str:
        """The value as text, without blanks around it."""
        return str(self.value).strip()

    def says(self, pattern: str) -> bool:
        """Whether the comment holds the pattern, in letters of any case."""
        return re.search(pattern, self.comment, re.IGNORECASE) is not None


@dataclass(frozen=True)
class Cards:
    """The cards of one header."""

    header: Header

    def all(self, names: Iterable[str]) -> list[Card]:
        """Those of the names that are there and have a value, in the order of the names."""
        found = []
        for name in names:
            for key in (name, f"HIERARCH {name}"):
                if key in self.header:
                    value = self.header[key]
                    text = "" if value is None or type(value).__name__ == "Undefined" else str(value).strip()
                    if text and text.lower() not in ("nan", "n/a", "none", "unknown", "null"):
                        found.append(Card(name, value, str(self.header.comments[key])))
                    break
        return found

    def first(self, names: Iterable[str]) -> Card | None:
        """The first of the names that is there and has a value."""
        return next(iter(self.all(names)), None)

    def number(self, names: Iterable[str]) -> Card | None:
        """The first of the names whose value is a finite number."""
        return next((card for card in self.all(names) if math.isfinite(card.number())), None)
