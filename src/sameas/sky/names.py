"""Names: the columns of one table, found by name, with their units, and what is wrong in the user's words."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

import numpy as np
from astropy.table import Table

from sameas.errors import InputError
from sameas.sky import cells
from sameas.sky.understood import CatalogueOptions, Column

_SUFFIXES = {"_arcsec": "arcsec", "_mas": "mas", "_deg": "deg"}


@dataclass(frozen=True)
class Search:
    """One table being read: finds columns by name and says what is wrong in the user's words."""

    table: Table
    options: CatalogueOptions
    source: str

    def find(self, wanted: str) -> str | None:
        """The column of that name: exactly, or the only one in any case."""
        names = self.table.colnames
        if wanted in names:
            return wanted
        alike = [name for name in names if name.lower() == wanted.lower()] if wanted else []
        return alike[0] if len(alike) == 1 else None

    def find_all(self, wanted: tuple[str, ...]) -> tuple[str, ...] | None:
        """All of the columns, or None."""
        found = [self.find(name) for name in wanted]
        return None if None in found else tuple(name for name in found if name)

    def first(self, wanted: tuple[str, ...]) -> str | None:
        """The first of the columns that is there."""
        return next((found for name in wanted if (found := self.find(name))), None)

    def required(self, wanted: str, option: str) -> str:
        """The column that an option names."""
        found = self.find(wanted.strip())
        if found:
            return found
        lower = {name.lower(): name for name in self.table.colnames}
        close = [lower[name] for name in difflib.get_close_matches(wanted.strip().lower(), lower, n=3)]
        hint = f"did you mean {' or '.join(map(repr, close))}?" if close else f"it has: {self.listing()}"
        raise InputError(f"{self.source}: no column {wanted.strip()!r} for --{option}; {hint}")

    def listing(self) -> str:
        names = self.table.colnames
        return ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")

    def several(self, text: str, count: int, option: str) -> tuple[str, ...]:
        """The columns that an option names, separated by commas."""
        parts = [part for part in text.split(",") if part.strip()]
        if len(parts) != count:
            raise InputError(f"{self.source}: --{option} {text} names {len(parts)} columns; give {count} with commas")
        return tuple(self.required(part, option) for part in parts)

    def column(self, name: str, unit: str, option: str = "") -> Column:
        """A column with its unit: its own, else that of its name's ending, else ``unit`` by convention."""
        own = cells.unit_of(self.table, name)
        if option:
            return Column(name, option, "option")
        if own is not None:
            return Column(name, own.to_string(), "unit of the column")
        return Column(name, _suffix_unit(name) or unit, "by its name" if _suffix_unit(name) else "by convention")

    def angle(self, name: str, unit: str) -> Column:
        """A column of small angles, such as errors."""
        column = self.column(name, unit, self.options.sigma_unit or "")
        if not column.unit:
            values = cells.numbers(self.table, name, self.source)
            known = values[np.isfinite(values)]
            middle = f" (median {np.median(known):g})" if len(known) else ""
            raise InputError(
                f"{self.source}: the unit of {name!r}{middle} is not said; say --sigma-unit arcsec, mas or deg"
            )
        return self.checked(column, "arcsec", "an angle")

    def checked(self, column: Column, target: str, words: str) -> Column:
        try:
            cells.factor(column.unit, target)
        except (ValueError, TypeError):  # UnitConversionError, unknown unit
            raise InputError(f"{self.source}: {column.name!r} is in {column.unit}, which is not {words}") from None
        return column

    def motion_column(self, name: str, unit: str) -> Column:
        """A column of parallax, proper motion or radial velocity."""
        return self.checked(self.column(name, unit), unit, f"convertible to {unit}")

    def ucd(self, name: str) -> str:
        """The column's UCD, lower case."""
        return str(self.table[name].info.meta.get("ucd", "") if self.table[name].info.meta else "").lower()


def _suffix_unit(name: str) -> str:
    return next((unit for suffix, unit in _SUFFIXES.items() if name.lower().endswith(suffix)), "")
