"""Cards: one keyword of a FITS header with its value and comment, as a number, an angle or text."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from astropy.io.fits import Header

_SEXAGESIMAL = re.compile(
    r"^\s*([+-]?)\s*(\d+)[\s:hHdD°]+(\d+(?:\.\d+)?)(?:[\s:mM']+(\d+(?:\.\d*)?))?\s*[mMsS'\"]?\s*([NSEWnsew]?)\s*$"
)
_NUMBER = re.compile(r"^\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+)?)\s*[A-Za-z/\-_]*\s*$")


@dataclass(frozen=True)
class Card:
    """One keyword with its value and comment."""

    name: str
    value: Any
    comment: str = ""

    def number(self) -> float:
        """The value as a number, else NaN; a unit after it is ignored."""
        if isinstance(self.value, bool):
            return math.nan
        if isinstance(self.value, int | float):
            return float(self.value)
        match = _NUMBER.match(str(self.value))
        return float(match[1].replace("D", "E").replace("d", "e")) if match else math.nan

    def angle(self) -> tuple[float, bool]:
        """The value in its first unit (hours or degrees), and whether it is sexagesimal; NaN if it is not an angle."""
        match = _SEXAGESIMAL.match(str(self.value)) if isinstance(self.value, str) else None
        if match is None:
            return self.number(), False
        first, minutes, seconds = float(match[2]), float(match[3]), float(match[4] or 0.0)
        if minutes >= 60 or seconds >= 60:
            return math.nan, True
        sign = -1.0 if match[1] == "-" or match[5].upper() == "S" else 1.0
        return sign * (first + minutes / 60 + seconds / 3600), True

    def text(self) -> str:
        """The value as text, stripped."""
        return str(self.value).strip()

    def says(self, pattern: str) -> bool:
        """Whether the comment matches the pattern, ignoring case."""
        return re.search(pattern, self.comment, re.IGNORECASE) is not None


@dataclass(frozen=True)
class Cards:
    """The cards of one header."""

    header: Header

    def all(self, names: Iterable[str]) -> list[Card]:
        """The cards of the names that have a value, in the order of the names."""
        cards = []
        for name in names:
            for key in (name, f"HIERARCH {name}"):
                if key in self.header:
                    value = self.header[key]
                    text = "" if value is None or type(value).__name__ == "Undefined" else str(value).strip()
                    if text and text.lower() not in ("nan", "n/a", "none", "unknown", "null"):
                        cards.append(Card(name, value, str(self.header.comments[key])))
                    break
        return cards

    def first(self, names: Iterable[str]) -> Card | None:
        """The card of the first name that has a value."""
        return next(iter(self.all(names)), None)

    def number(self, names: Iterable[str]) -> Card | None:
        """The card of the first name that has a finite number."""
        return next((card for card in self.all(names) if math.isfinite(card.number())), None)
