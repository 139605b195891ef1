"""Columns: which columns of a table are position, errors, motion, epoch and brightness, and why we think so.

:func:`choose` looks for the names of known catalogues (:mod:`sameas.sky.conventions`), for units and
UCDs; an option always wins. What belongs together is taken together: never the right ascension of one
convention and the declination of another. Where two answers are equally good the table is refused with the
choices.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from astropy import units as u
from astropy.table import Table

from sameas.errors import Argument, InputError, Message, naming
from sameas.sky import column_values, conventions
from sameas.sky.column_choice import CatalogueOptions, Column, ColumnChoice, Epoch, PositionError
from sameas.sky.conventions import Convention, ErrorNames

# Names: the columns of one table, found by name, with their units, and what is wrong in the user's words.

_SUFFIXES = {"_arcsec": "arcsec", "_mas": "mas", "_deg": "deg"}


@dataclass(frozen=True)
class ColumnSearch:
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
        raise InputError(Message(f"{self.source}: no column {wanted.strip()!r} for ", Argument(option), f"; {hint}"))

    def listing(self) -> str:
        names = self.table.colnames
        return ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")

    def several(self, text: str, count: int, option: str) -> tuple[str, ...]:
        """The columns that an option names, separated by commas."""
        parts = [part for part in text.split(",") if part.strip()]
        if len(parts) != count:
            message = Message(f"{self.source}: ", Argument(option, repr(text)), f" names {len(parts)} columns")
            raise InputError(message, f"give {count} with commas")
        return tuple(self.required(part, option) for part in parts)

    def column(self, name: str, unit: str, option: str = "") -> Column:
        """A column with its unit: its own, else that of its name's ending, else ``unit`` by convention."""
        own = column_values.unit_of(self.table, name)
        if option:
            return Column(name, option, "option")
        if own is not None:
            return Column(name, own.to_string(), "unit of the column")
        return Column(name, _suffix_unit(name) or unit, "by its name" if _suffix_unit(name) else "by convention")

    def angle(self, name: str, unit: str) -> Column:
        """A column of small angles, such as errors."""
        column = self.column(name, unit, self.options.sigma_unit or "")
        if not column.unit:
            values = column_values.numbers(self.table, name, self.source)
            known = values[np.isfinite(values)]
            middle = f" (median {np.median(known):g})" if len(known) else ""
            raise InputError(
                f"{self.source}: the unit of {name!r}{middle} is not said",
                naming("say {sigma_unit:arcsec}, mas or deg"),
            )
        return self.checked(column, "arcsec", "an angle")

    def checked(self, column: Column, target: str, words: str, name: str = "") -> Column:
        """The column, whose unit is one of ``target``'s kind. name : of the column in messages."""
        try:
            column_values.factor(column.unit, target)
        except (ValueError, TypeError):  # UnitConversionError, unknown unit
            unfit = f" is in {column.unit}, which is not {words}"
            raise InputError(Message(f"{self.source}: ", name or repr(column.name), unfit)) from None
        return column

    def motion_column(self, name: str, unit: str) -> Column:
        """A column of parallax, proper motion or radial velocity."""
        return self.checked(self.column(name, unit), unit, f"convertible to {unit}")

    def ucd(self, name: str) -> str:
        """The column's UCD, lower case."""
        return str(self.table[name].info.meta.get("ucd", "") if self.table[name].info.meta else "").lower()


def _suffix_unit(name: str) -> str:
    return next((unit for suffix, unit in _SUFFIXES.items() if name.lower().endswith(suffix)), "")


_DESCRIBED_EPOCH = re.compile(r"\bEp(?:och)?\s*[=:]?\s*J?\s*((?:18|19|20)\d\d(?:\.\d+)?)", re.IGNORECASE)


def choose(table: Table, options: CatalogueOptions, source: str) -> ColumnChoice:
    """What the columns of a table mean.

    table : its names, units, UCDs, descriptions and header are read, of its cells only the notation.
    options : what the user says. source : name used in messages.

    Raises
    ------
    InputError : no position, two equally good ones, no or ambiguous errors, unknown columns, unfit units.
    """
    search = ColumnSearch(table, options, source)
    convention, not_used = _convention(search)
    ra, dec = (search.find(name) for name in convention.position)
    if ra is None or dec is None:
        raise InputError(f"{source}: no columns {' and '.join(map(repr, convention.position))}")
    error = _position_error(search, convention)
    motion, motion_errors, notes = _motion(search, convention)
    found = tuple((i, j, name) for i, j, wanted in convention.correlations if (name := search.find(wanted)))
    if not_used:
        notes = (*notes, f"not used: {', '.join(not_used)}")
    magnitude, magnitude_error = _magnitude(search, convention)
    choice = ColumnChoice(
        convention=convention.title,
        ra=_direction(search, ra, convention.unit, right_ascension=True),
        dec=_direction(search, dec, convention.unit, right_ascension=False),
        error=error,
        epoch=_epoch(search, convention, ra),
        id=_id(search, convention),
        motion=motion,
        motion_errors=motion_errors,
        correlations=found if error.kind == "axes" else tuple(c for c in found if min(c[:2]) >= 2),
        weights=_weights(search, convention) if error.kind == "axes" else (),
        magnitude=magnitude,
        magnitude_error=magnitude_error,
        notes=notes,
    )
    return choice


def _convention(search: ColumnSearch) -> tuple[Convention, tuple[str, ...]]:
    """The convention of the position, and the right ascensions that were passed over."""
    if search.options.ra or search.options.dec:
        return _said_position(search), ()
    there = [c for c in conventions.CONVENTIONS if _applies(search, c)]
    if not there:
        return _position_by_ucd(search), ()
    superseded = {name.lower() for c in there for name in c.over if name != c.position[0]}
    computed = {name.lower() for name in conventions.VIZIER_COMPUTED}
    rules: tuple[Callable[[Convention], bool], ...] = (
        lambda c: c.position[0].lower() not in computed,
        lambda c: c.position[0].lower() not in superseded,
        lambda c: _own_error(search, c) is not None,
        lambda c: "main" in search.ucd(search.find(c.position[0]) or ""),
    )
    for rule in rules:
        there_by_rule = [c for c in there if rule(c)]
        chosen = there_by_rule or there
        if len({c.position[0].lower() for c in chosen}) == 1:
            break
        there = chosen
    _refuse_equals(search, chosen)
    taken = search.find(chosen[0].position[0])
    every = {search.find(c.position[0]) for c in conventions.CONVENTIONS if _applies(search, c)}
    return chosen[0], tuple(sorted(name for name in every if name and name != taken))


def _applies(search: ColumnSearch, convention: Convention) -> bool:
    marked = not convention.marks or search.first(convention.marks) is not None
    return marked and search.find_all(convention.position) is not None


def _refuse_equals(search: ColumnSearch, chosen: list[Convention]) -> None:
    positions = sorted({search.find(c.position[0]) or "" for c in chosen})
    if len(positions) == 1 and all(_own_error(search, c) is None for c in chosen):
        positions = sorted(n for n in search.table.colnames if n.lower() == positions[0].lower())
    if len(positions) > 1:
        raise InputError(
            f"{search.source}: {len(positions)} candidates for right ascension: {', '.join(map(repr, positions))}",
            naming("say {ra:NAME}"),
        )
    errors = {names for c in chosen if (e := _own_error(search, c)) and (names := search.find_all(e.names))}
    if len(errors) > 1 and search.options.sigma is None and search.options.ellipse is None:
        raise InputError(
            f"{search.source}: {len(errors)} candidates for the position errors: "
            f"{' or '.join(','.join(names) for names in sorted(errors))}",
            naming("say {sigma:'EAST,NORTH'} or {ellipse:'A,B,ANGLE'}"),
        )
    # Of one position the convention that brings errors knows it best.
    chosen.sort(key=lambda c: _own_error(search, c) is None)


def _said_position(search: ColumnSearch) -> Convention:
    """The convention of the columns that the options name."""
    options = search.options
    said = search.required(options.ra or options.dec or "", "ra" if options.ra else "dec")
    axis = 0 if options.ra else 1
    other = search.required(options.dec, "dec") if options.ra and options.dec else None
    known = [
        c
        for c in conventions.CONVENTIONS
        if _applies(search, c)
        and search.find(c.position[axis]) == said
        and other in (None, search.find(c.position[1 - axis]))
    ]
    if known:
        return min(known, key=lambda c: _own_error(search, c) is None)
    if other is None:
        raise InputError(f"{search.source}: {said!r} has no known partner", naming("say {ra:NAME} and {dec:NAME}"))
    return conventions.plain((said, other), title="options")


def _position_by_ucd(search: ColumnSearch) -> Convention:
    def marked(*patterns: str) -> list[str]:
        ucds = {name: search.ucd(name) for name in search.table.colnames}
        found = [n for n, ucd in ucds.items() if ucd.startswith(patterns)]
        return [n for n in found if "main" in ucds[n]] or found

    ra, dec = marked("pos.eq.ra", "pos_eq_ra"), marked("pos.eq.dec", "pos_eq_dec")
    if len(ra) == 1 and len(dec) == 1:
        return conventions.plain((ra[0], dec[0]), title="UCD pos.eq.ra, pos.eq.dec")
    raise InputError(
        f"{search.source}: no columns of right ascension and declination found among: {search.listing()}",
        naming("say {ra:NAME} {dec:NAME}"),
    )


def _own_error(search: ColumnSearch, convention: Convention) -> ErrorNames | None:
    return next((e for e in convention.errors if search.find_all(e.names)), None)


def _direction(search: ColumnSearch, name: str, unit: str, right_ascension: bool) -> Column:
    if column_values.is_sexagesimal(search.table, name):
        own = column_values.unit_of(search.table, name)
        hours = right_ascension and own != u.deg
        return Column(name, "sexagesimal hours" if hours else "sexagesimal degrees", "by its notation")
    column = search.column(name, unit)
    if column.unit in ("h", "hourangle"):
        return replace(column, unit="hourangle")
    return search.checked(column, "deg", "an angle")


def _position_error(search: ColumnSearch, convention: Convention) -> PositionError:
    options = search.options
    if options.sigma is not None and options.ellipse:
        raise InputError(Message(f"{search.source}: ", naming("give {sigma} or {ellipse}, not both")))
    if options.ellipse:
        return _error_columns(search, "ellipse", search.several(options.ellipse, 3, "ellipse"), "", "")
    if options.sigma is not None:
        return _said_error(search, options.sigma, convention)
    own = _own_error(search, convention)
    if own:
        return _error_columns(search, own.kind, search.find_all(own.names) or (), own.unit, own.covariance, convention)
    ways = (*conventions.plain(convention.position).errors, *conventions.PLAIN_CIRCLES)
    found = {names: e for e in ways if (names := search.find_all(e.names)) and _may_be_angle(search, names)}
    if len(found) > 1:
        raise InputError(
            f"{search.source}: {len(found)} candidates for the position error: "
            f"{' or '.join(','.join(names) for names in found)}",
            naming("say {sigma:NAME}"),
        )
    for names, way in found.items():
        return _error_columns(search, way.kind, names, way.unit, way.covariance, convention)
    raise InputError(
        f"{search.source}: no column of position errors ({convention.title})",
        naming("say {sigma:ARCSEC}, {sigma:COLUMN} or {ellipse:'A,B,ANGLE'}"),
    )


def _may_be_angle(search: ColumnSearch, names: tuple[str, ...]) -> bool:
    units = [column_values.unit_of(search.table, name) for name in names]
    return all(unit is None or unit.is_equivalent(u.deg) for unit in units)


def _said_error(search: ColumnSearch, sigma: float | str, convention: Convention) -> PositionError:
    try:
        number = float(sigma)
    except ValueError:
        text = str(sigma)
        count = 1 + text.count(",")
        names = search.several(text, 2 if count > 1 else 1, "sigma")
        own = _own_error(search, convention)
        if own and search.find_all(own.names) == names:
            return _error_columns(search, own.kind, names, own.unit, own.covariance, convention)
        return _error_columns(search, "axes" if count > 1 else "circle", names, "", "")
    unit = search.options.sigma_unit or "arcsec"
    unit_of = Column("sigma", unit, "option")
    search.checked(unit_of, "arcsec", "an angle; give arcsec, mas, deg", naming("'{sigma}'"))
    if not number > 0:
        message = Message(f"{search.source}: ", Argument("sigma", str(sigma)), " is not positive")
        raise InputError(message, "give a standard deviation per axis")
    return PositionError("number", sigma_arcsec=number * column_values.factor(unit, "arcsec"))


def _error_columns(
    search: ColumnSearch,
    kind: Literal["circle", "axes", "ellipse"],
    names: tuple[str, ...],
    unit: str,
    covariance: str,
    convention: Convention | None = None,
) -> PositionError:
    columns = tuple(search.angle(name, unit) for name in names[:2])
    if kind == "ellipse":
        columns = (*columns, search.checked(search.column(names[2], "deg"), "deg", "an angle"))
    said = search.options.correlation
    correlation = search.required(said, "correlation") if said else ""
    if not said and kind == "axes" and convention:
        correlation = next((n for i, j, w in convention.correlations if (i, j) == (0, 1) and (n := search.find(w))), "")
    found = "" if correlation or kind != "axes" else search.find(covariance) or ""
    return PositionError(kind, columns, correlation=correlation, covariance=found)


def _motion(search: ColumnSearch, convention: Convention) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[str, ...]]:
    """Columns of parallax, proper motion and radial velocity, those of their errors, and notes."""
    options, units = search.options, ("mas", "mas / yr", "mas / yr", "km / s")
    names: list[str | None] = [None] * 4
    errors: list[str | None] = [None] * 4
    for way in convention.motions:
        for k, (name, error) in enumerate(zip(way.names, way.errors, strict=True)):
            if names[k] is None and search.find(name):
                names[k], errors[k] = search.find(name), search.find(error)
    if (names[1] is None) != (names[2] is None):
        names[1:3] = errors[1:3] = [None, None]
    if options.pm and options.pm.lower() == "none":
        names[1:3] = errors[1:3] = [None, None]
    elif options.pm:
        said = search.several(options.pm, 2, "pm")
        errors[1:3] = [
            e if said == tuple(names[1:3]) else _error_of(search, s) for s, e in zip(said, errors[1:3], strict=True)
        ]
        names[1:3] = said
    for k, text, option in (
        (0, options.parallax, "parallax"),
        (3, options.radial_velocity, "radial_velocity"),
    ):
        if text:
            names[k] = None if text.lower() == "none" else search.required(text, option)
            errors[k] = _error_of(search, names[k])
    notes = []
    if names[1] is None and not options.pm and (other := search.find_all(("pm_ra", "pm_dec"))):
        not_used = f"{', '.join(other)} not used: with or without cos(dec) is not said; if with, say "
        notes.append(Message(not_used, Argument("pm", repr(",".join(other)))))
    return (
        tuple(search.motion_column(n, unit) if n else None for n, unit in zip(names, units, strict=True)),
        tuple(search.motion_column(n, unit) if n else None for n, unit in zip(errors, units, strict=True)),
        tuple(notes),
    )


def _error_of(search: ColumnSearch, name: str | None) -> str | None:
    ways = ("{}_error", "e_{}", "{}_err", "{}err", "{}Err", "sigma_{}")
    return search.first(tuple(way.format(name) for way in ways)) if name else None


def _epoch(search: ColumnSearch, convention: Convention, ra: str) -> Epoch:
    said, table = search.options.epoch, search.table
    if said is not None:
        try:
            return Epoch(jyr=column_values.year_of(str(said)), reason="option")
        except ValueError:
            column = search.required(str(said), "epoch")
            return Epoch(column=column, reason=f"column {column}, option")
    name = search.first(convention.epochs)
    if name:
        return Epoch(column=name, reason=f"column {name}")
    described = _DESCRIBED_EPOCH.search(str(table[ra].info.description or ""))
    if described:
        return Epoch(jyr=float(described[1]), reason=f"description of {ra}")
    if convention.epoch_jyr is not None:
        return Epoch(jyr=convention.epoch_jyr, reason=f"epoch of {convention.title}")
    released = _released_epoch(search, convention)
    return released if released else _header_epoch(table)


def _released_epoch(search: ColumnSearch, convention: Convention) -> Epoch | None:
    """The epoch of the data release that the table's words or columns tell, if they tell one."""
    texts = [f"{key} {value}" for key, value in search.table.meta.items()]
    name = search.find("designation")
    if name and column_values.is_text(search.table, name):
        texts += [str(text) for text in search.table[name][:100]]
    found = {
        epoch: f"the table says {match[0]}"
        for pattern, epoch in convention.releases
        for text in texts
        if (match := re.search(pattern, text, re.IGNORECASE))
    }
    found |= {
        epoch: f"of the release that has {column}"
        for wanted, epoch in convention.release_columns
        if (column := search.find(wanted))
    }
    if len(found) != 1:
        return None
    (epoch, reason), *_ = found.items()
    return Epoch(jyr=epoch, reason=reason)


def _header_epoch(table: Table) -> Epoch:
    header = {str(key).upper(): value for key, value in table.meta.items()}
    for key in conventions.HEADER_EPOCHS:
        if key.upper() in header:
            try:
                return Epoch(jyr=column_values.year_of(str(header[key.upper()])), reason=f"header {key}")
            except ValueError:
                continue
    return Epoch()


def _id(search: ColumnSearch, convention: Convention) -> str | None:
    if search.options.id:
        return search.required(search.options.id, "id")
    return search.first(convention.ids + conventions.PLAIN_IDS)


def _weights(search: ColumnSearch, convention: Convention) -> tuple[str, ...]:
    if not convention.weights:
        return ()
    names = tuple(f"{convention.weights}{k}" for k in range(1, 16))
    return search.find_all((*names, "F2", "Ntr")) or ()


def _magnitude(search: ColumnSearch, convention: Convention) -> tuple[str | None, str | None]:
    said = search.options.magnitude
    if said:
        name = None if said.lower() == "none" else search.required(said, "magnitude")
        return name, _error_of(search, name)
    for wanted, error in convention.magnitudes + conventions.PLAIN_MAGNITUDES:
        name = search.find(wanted)
        if name and getattr(search.table[name], "ndim", 1) == 1 and not column_values.is_text(search.table, name):
            same = tuple(e for w, e in convention.magnitudes + conventions.PLAIN_MAGNITUDES if w == wanted)
            return name, search.find(error) or search.first(same)
    return next((n for n in search.table.colnames if search.ucd(n).startswith(("phot.mag;", "phot_mag"))), None), None
