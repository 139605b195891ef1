"""Column search: finds the columns of one table by name, however it is spelt, each with its unit."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from astropy import units as u
from astropy.table import Table

from sameas.arrays import median
from sameas.errors import Argument, InputError, Message, naming
from sameas.sky import column_values
from sameas.sky.column_choice import GUESSED, OF_RA, SECONDS_OF_RA, CatalogueOptions, ChosenColumn

_SUFFIXES = {
    "_arcsec": "arcsec", "_mas": "mas", "_deg": "deg", "_hours": "hourangle", "_hrs": "hourangle", "_hr": "hourangle",
    "_h": "hourangle", "_arcmin": "arcmin",
}  # fmt: skip
#: Error columns without a unit: a median below the first is taken as degrees, above the second as mas (chosen).
_LEAST_IN_ARCSEC, _LARGEST_IN_ARCSEC = 0.002, 5.0
#: A unit in brackets at the end of a column name.
_BRACKETED = re.compile(r"[\s_]*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
#: Words of right ascension and declination in names.
_COORDINATES = (("right_?ascension", "declination"), ("ra", "dec"), ("ra", "de"), ("ra", "decl"), ("alpha", "delta"))
#: Parts of names of errors, motions and offsets.
_NO_POSITION = re.compile(
    r"err|sig|unc|std|rms|var|cov|cor|prec|pm|off|(?:^|_)(?:e|d|delta|mu|n)_?(?:ra|alpha)|mu_?(?:ra|alpha)|19[05]0|1875",
    re.IGNORECASE,
)
#: Units by the words that people write for them.
UNIT_WORDS = {
    "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "arcsec": "arcsec", "arcseconds": "arcsec",
    "arcsecond": "arcsec", "as": "arcsec", "″": "arcsec", '"': "arcsec", "''": "arcsec", "mas": "mas",
    "arcs": "arcsec", "arcsecs": "arcsec", "milliarcsec": "mas", "milliarcsecs": "mas", "milliarcseconds": "mas",
    "microarcsec": "uas", "microarcseconds": "uas", "hrs": "hourangle", "arcmin": "arcmin", "arcminute": "arcmin",
    "arcminutes": "arcmin",
    "h": "hourangle", "hr": "hourangle", "hour": "hourangle", "hours": "hourangle", "hourangle": "hourangle",
    "rad": "rad", "radian": "rad", "radians": "rad", "mag": "mag", "mas/yr": "mas / yr", "arcsec/yr": "arcsec / yr",
    "yr": "yr", "d": "d", "mjd": "d", "gon": "0.9 deg", "gons": "0.9 deg", "grad": "0.9 deg", "grads": "0.9 deg",
    "gradian": "0.9 deg", "gradians": "0.9 deg", "turn": "cycle", "turns": "cycle", "rev": "cycle",
}  # fmt: skip


@dataclass(frozen=True)
class ColumnSearch:
    """Search for the columns of one table by name; errors name the option to give."""

    table: Table
    options: CatalogueOptions
    source: str

    def find(self, wanted: str) -> str | None:
        """The column of this name: exact, else the only match ignoring case, else ignoring blanks, brackets, dots."""
        if wanted in self.table.colnames:
            return wanted
        alike = self._by_lower_case.get(wanted.lower(), [])
        if not alike and wanted:
            alike = self._by_squeezed_name.get(_squeezed(wanted), [])
        return alike[0] if len(alike) == 1 else None

    @cached_property
    def _by_lower_case(self) -> dict[str, list[str]]:
        """The columns by their lower-case names."""
        names: dict[str, list[str]] = {}
        for name in self.table.colnames:
            names.setdefault(name.lower(), []).append(name)
        return names

    @cached_property
    def _by_squeezed_name(self) -> dict[str, list[str]]:
        """The columns with punctuation in their names, by letters and digits only.

        ``RA (J2000)`` is found as raj2000, ``Dec. [deg]`` as dec.
        """
        names: dict[str, list[str]] = {}
        for name in self.table.colnames:
            if re.fullmatch(r"\w*", name, re.ASCII):
                continue
            for squeezed in {_squeezed(name), _squeezed(_BRACKETED.sub("", name) if _bracketed_unit(name) else name)}:
                names.setdefault(squeezed, []).append(name)
        return names

    def find_all(self, wanted: tuple[str, ...]) -> tuple[str, ...] | None:
        """The columns of these names, or None if one is missing."""
        columns = [self.find(name) for name in wanted]
        return None if None in columns else tuple(name for name in columns if name)

    def hold_errors(self, names: tuple[str, ...]) -> bool:
        """Whether the first of these columns has a positive number; archives write negative ones for none."""
        return column_values.holds_positive(self.table, names[0])

    def first(self, wanted: tuple[str, ...]) -> str | None:
        """The first of these names that is a column."""
        return next((column for name in wanted if (column := self.find(name))), None)

    def required(self, wanted: str, option: str) -> str:
        """The column named by an option."""
        column = self.find(wanted.strip())
        if column:
            return column
        lower = {name.lower(): name for name in self.table.colnames}
        close = [lower[name] for name in difflib.get_close_matches(wanted.strip().lower(), lower, n=3)]
        hint = f"did you mean {' or '.join(map(repr, close))}?" if close else f"it has: {self.listing()}"
        raise InputError(Message(f"{self.source}: no column {wanted.strip()!r} for ", Argument(option), f"; {hint}"))

    def partner_of(self, name: str) -> str | None:
        """The column of declination whose name is that of a column of right ascension but for the coordinate."""
        for of_ra, of_dec in _COORDINATES:
            for match in re.finditer(of_ra, name, re.IGNORECASE):
                partner = self.find(f"{name[: match.start()]}{of_dec}{name[match.end() :]}")
                if partner and partner != name and name.lower() != "alpha":
                    return partner
        return None

    def positions(self) -> list[tuple[str, str]]:
        """Pairs of columns that are named alike but for the coordinate: ``meanra, meandec``; no errors or motions."""
        pairs = [(name, self.partner_of(name)) for name in self.table.colnames if not _NO_POSITION.search(name)]
        return [(ra, dec) for ra, dec in pairs if dec and all(self._may_be_position(name) for name in (ra, dec))]

    def _may_be_position(self, name: str) -> bool:
        unit = column_values.unit_of(self.table, name)
        angle = unit is None or unit.is_equivalent("deg") or unit == u.hour
        return angle and (
            column_values.is_sexagesimal(self.table, name) or column_values.holds_numbers(self.table, name)
        )

    def listing(self) -> str:
        names = self.table.colnames
        return ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")

    def several(self, text: str, count: int, option: str) -> tuple[str, ...]:
        """The columns named by an option, separated by commas."""
        parts = [part for part in text.split(",") if part.strip()]
        if len(parts) != count:
            message = Message(f"{self.source}: ", Argument(option, repr(text)), f" names {len(parts)} columns")
            raise InputError(message, f"give {count} with commas")
        return tuple(self.required(part, option) for part in parts)

    def column(self, name: str, unit: str, option: str = "") -> ChosenColumn:
        """A column with its unit: the option's, the column's own, that of the name's suffix, or ``unit``."""
        own = column_values.unit_of(self.table, name)
        if option:
            return ChosenColumn(name, option, "option")
        if own is not None:
            return ChosenColumn(name, own.to_string(), "unit of the column")
        if written := _written_unit(self.table, name):
            return ChosenColumn(name, written, "unit of the column")
        return ChosenColumn(name, _suffix_unit(name) or unit, "by its name" if _suffix_unit(name) else "by convention")

    def angles(
        self, names: tuple[str, ...], unit: str, *, of_ra: bool = False, unit_of_ra: str = ""
    ) -> tuple[ChosenColumn, ...]:
        """Columns of small angles, such as the errors of both axes, with their units; one unit is guessed for all
        columns without.

        of_ra : whether the first is of right ascension, and may be in seconds of time. unit_of_ra : its unit, if it is
            not that of the others.
        """
        units = (unit_of_ra or unit, *(unit,) * (len(names) - 1))
        columns = [self.column(n, u, self.options.sigma_unit or "") for n, u in zip(names, units, strict=True)]
        if of_ra and columns[0].unit == "s":
            return replace(columns[0], unit=SECONDS_OF_RA), *self.angles(names[1:], unit)
        without = [column.name for column in columns if not column.unit]
        if without:
            guessed = self._guessed_unit(without)
            columns = [c if c.unit else replace(c, unit=guessed, reason=GUESSED) for c in columns]
        remedy = naming("give {sigma_unit:UNIT}, such as mas")
        return tuple(self.checked(column, "arcsec", "an angle", remedy=remedy) for column in columns)

    def _guessed_unit(self, names: list[str]) -> str:
        """The unit of error columns without one, guessed from their median."""
        values = np.concatenate([column_values.numbers(self.table, name, self.source) for name in names])
        known = values[values > 0]
        middle = median(known) if len(known) else 0.1
        if 0.0 < middle < _LEAST_IN_ARCSEC:
            return "deg"
        moving = self.find_all(("pmra", "pmdec")) or self.find_all(("pmRA", "pmDE"))
        return "mas" if moving or middle > _LARGEST_IN_ARCSEC else "arcsec"

    def checked(self, column: ChosenColumn, target: str, words: str, name: str = "", remedy: str = "") -> ChosenColumn:
        """The column, refused if its unit cannot be converted to ``target``. name : the column's name in messages.
        remedy : what to do."""
        try:
            column_values.factor(column.unit, target)
        except (ValueError, TypeError):  # UnitConversionError, unknown unit
            unfit = f" is in {column.unit}, which is not {words}"
            raise InputError(Message(f"{self.source}: ", name or repr(column.name), unfit), remedy) from None
        return column

    def motion_column(self, name: str, unit: str, *, of_ra: bool) -> ChosenColumn:
        """A column of parallax, proper motion or radial velocity.

        of_ra : whether it is a motion in right ascension, which may be in seconds of time.
        """
        column, remedy = self.column(name, unit), ""
        stated = getattr(self.table[name], "unit", None)
        if unit == "mas / yr" and stated is not None and re.search("[a-zA-Z]", str(stated)):
            own = column_values.motion_unit(str(stated))
            column, remedy = (
                replace(column, unit=own, reason="unit of the column"),
                "convert the column, and name its unit",
            )
            if of_ra and column_values.is_in_seconds_of_time(own):
                return replace(column, unit=f"{own}{OF_RA}")
        return self.checked(column, unit, f"convertible to {unit}", remedy=remedy)

    def ucd(self, name: str) -> str:
        """The column's UCD, lower case."""
        return str(self.table[name].info.meta.get("ucd", "") if self.table[name].info.meta else "").lower()


def _suffix_unit(name: str) -> str:
    """The unit at the end of a name: ``err_mas``, ``RA [deg]``."""
    suffix = next((unit for suffix, unit in _SUFFIXES.items() if name.lower().endswith(suffix)), "")
    return suffix or _bracketed_unit(name)


def _written_unit(table: Table, name: str) -> str:
    """The column's unit in words that astropy does not know: hours, arcseconds, ``Angle[deg]``; "" if none is found."""
    unit = getattr(table[name], "unit", None)
    if not isinstance(unit, u.UnrecognizedUnit):
        return ""
    text = str(unit).strip().lower()
    words = (text, text.replace(" ", ""), *re.split(r"[^a-z]+", text))
    return next((UNIT_WORDS[word] for word in words if word in UNIT_WORDS), "")


def _bracketed_unit(name: str) -> str:
    match = _BRACKETED.search(name)
    return UNIT_WORDS.get(match[1].lower(), "") if match else ""


def _squeezed(name: str) -> str:
    """The letters and digits of a name in lower case; a leading underscore (VizieR's computed columns) is kept."""
    return ("_" if name.startswith("_") else "") + re.sub(r"[\W_]+", "", name.lower())
