"""Columns: which columns of a table are position, errors, motion, epoch and brightness, with the reason for each.

:func:`choose` uses the column names of known catalogues (:mod:`sameas.sky.surveys`), units and UCDs; an option
takes precedence. All position columns come from one convention: never the right ascension of one and the declination
of another. If two choices are equally good, the table is refused and the choices are listed.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import Table

from sameas.arrays import FloatArray, median
from sameas.errors import Argument, InputError, Message, naming
from sameas.sky import column_values, conventions, surveys
from sameas.sky.column_choice import (
    GUESSED,
    OF_RA,
    SECONDS_OF_RA,
    CatalogueOptions,
    ChosenColumn,
    ColumnChoice,
    Epoch,
    PositionError,
    survey_of,
)
from sameas.sky.conventions import Convention, ErrorNames

_SUFFIXES = {
    "_arcsec": "arcsec", "_mas": "mas", "_deg": "deg", "_hours": "hourangle", "_hrs": "hourangle", "_hr": "hourangle",
    "_h": "hourangle",
}  # fmt: skip
#: Error columns without a unit: a median below the first is taken as degrees, above the second as mas (chosen).
_LEAST_IN_ARCSEC, _LARGEST_IN_ARCSEC = 0.002, 5.0
#: A unit in brackets at the end of a column name.
_BRACKETED = re.compile(r"[\s_]*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
#: A number with a unit: ``100mas``, ``0.1 arcsec``, ``0.1"``.
_WITH_UNIT = re.compile(r"^([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*([a-z°″'\"]+)$", re.IGNORECASE)
_UNIT_WORDS = {
    "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "arcsec": "arcsec", "arcseconds": "arcsec",
    "arcsecond": "arcsec", "as": "arcsec", "″": "arcsec", '"': "arcsec", "''": "arcsec", "mas": "mas",
    "arcs": "arcsec", "milliarcsec": "mas", "milliarcsecs": "mas", "milliarcseconds": "mas", "microarcsec": "uas",
    "microarcseconds": "uas", "hrs": "hourangle",
    "h": "hourangle", "hr": "hourangle", "hour": "hourangle", "hours": "hourangle", "hourangle": "hourangle",
    "rad": "rad", "radian": "rad", "radians": "rad", "mag": "mag", "mas/yr": "mas / yr", "arcsec/yr": "arcsec / yr",
    "yr": "yr", "d": "d", "mjd": "d",
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

    def angles(self, names: tuple[str, ...], unit: str, *, of_ra: bool = False) -> tuple[ChosenColumn, ...]:
        """Columns of small angles, such as the errors of both axes, with their units; one unit is guessed for all
        columns without.

        of_ra : whether the first is of right ascension, and may be in seconds of time.
        """
        columns = [self.column(name, unit, self.options.sigma_unit or "") for name in names]
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

    def motion_column(self, name: str, unit: str, *, of_ra: bool = False) -> ChosenColumn:
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
    return next((_UNIT_WORDS[word] for word in words if word in _UNIT_WORDS), "")


def _bracketed_unit(name: str) -> str:
    match = _BRACKETED.search(name)
    return _UNIT_WORDS.get(match[1].lower(), "") if match else ""


def _squeezed(name: str) -> str:
    """The letters and digits of a name in lower case; a leading underscore (VizieR's computed columns) is kept."""
    return ("_" if name.startswith("_") else "") + re.sub(r"[\W_]+", "", name.lower())


_POSITION_ERROR = re.compile(
    r"_(?:pos_?err(?:or)?|e_pos|pos_sigma|sigma_pos|radec_err)(?:_(?:arcsec|mas|deg))?$", re.IGNORECASE
)
#: A probability in the description of a radius or an ellipse.
_CONFIDENCE = re.compile(r"\b(6[38]|9[059]|6[38]\.\d+)\s?(?:%|per ?cent)", re.IGNORECASE)
_DESCRIBED_EPOCH = re.compile(r"\bEp(?:och)?\s*[=:]?\s*J?\s*((?:18|19|20)\d\d(?:\.\d+)?)", re.IGNORECASE)


#: Parts of the names of columns of errors.
_ERROR_WORDS = re.compile(r"err|sigma|unc(?![a-z])|ellipse|(?:^|_)(?:rms|std)(?:_|$)", re.IGNORECASE)


def choose(table: Table, options: CatalogueOptions, source: str) -> ColumnChoice:
    """The columns chosen for position, errors, motion, epoch, id and magnitude.

    table : read are names, units, UCDs, descriptions, header and the notation of the cells.
    options : columns given by the user. source : name used in messages.

    Raises
    ------
    InputError : no position, two equally good ones, ambiguous errors, unknown columns, unfit units; all at once.
    """
    search = ColumnSearch(table, options, source)
    convention, not_used = _convention(search)
    if convention.frame == "icrs" and _states_b1950(search, convention):
        convention = conventions.of_b1950(replace(convention, title=f"{convention.title}; equinox B1950, FK4"))
    ra, dec = (search.find(name) for name in convention.position)
    if ra is None or dec is None:
        raise InputError(f"{source}: no columns {' and '.join(map(repr, convention.position))}")
    choosers: tuple[Callable[[], Any], ...] = (
        lambda: (_direction(search, ra, convention, 0), _direction(search, dec, convention, 1)),
        lambda: _motion(search, convention),
        lambda: _epoch(search, convention, ra),
        lambda: _id(search, convention),
        lambda: _magnitude(search, convention),
        lambda: _position_error(search, convention),
    )
    position, motions, epoch, id, magnitudes, error = _all_of(choosers)
    motion, motion_errors, notes = motions
    correlations = tuple((i, j, name) for i, j, wanted in convention.correlations if (name := search.find(wanted)))
    if not_used:
        notes = (*notes, f"not used: {', '.join(not_used)}")
    magnitude, magnitude_error = magnitudes
    if magnitude is None and options.magnitude is None:
        notes = (*notes, *_unused_bands(search))
    if error.kind == "unknown":
        used = {getattr(column, "name", column) for column in (*motion_errors, magnitude_error)}
        notes = (*notes, *_unused_errors(search, used))
        survey_errors = survey_of(convention.title, _year(search, epoch), _texts(search))
        error = error if survey_errors is None else PositionError("survey", survey=survey_errors)
    choice = ColumnChoice(
        convention=convention.title,
        ra=position[0],
        dec=position[1],
        error=error,
        epoch=epoch,
        id=id,
        motion=motion,
        motion_errors=motion_errors,
        correlations=correlations if error.kind == "axes" else tuple(c for c in correlations if min(c[:2]) >= 2),
        weights=_weights(search, convention) if error.kind == "axes" else (),
        magnitude=magnitude,
        magnitude_error=magnitude_error,
        notes=notes,
        frame=convention.frame,
        measured=search.find(convention.measured) or "",
    )
    return choice


def _all_of(choosers: tuple[Callable[[], Any], ...]) -> list[Any]:
    """The results of all choosers; their refusals are raised together."""
    choices: list[Any] = []
    refusals: list[InputError] = []
    for choose_one in choosers:
        try:
            choices.append(choose_one())
        except InputError as error:
            refusals.append(error)
    if refusals:
        raise InputError.together(refusals)
    return choices


def _convention(search: ColumnSearch) -> tuple[Convention, tuple[str, ...]]:
    """The convention of the position, and the right ascension columns that are not used."""
    if search.options.ra or search.options.dec:
        return _position_of_options(search), ()
    candidates = [c for c in surveys.CONVENTIONS if _applies(search, c)]
    if not candidates:
        other_frames = (c for c in surveys.OTHER_FRAMES if _applies(search, c))
        return _position_by_ucd(search) or next(other_frames, None) or _no_position(search), ()
    superseded = {name.lower() for c in candidates for name in c.over if name != c.position[0]}
    computed = {name.lower() for name in conventions.VIZIER_COMPUTED}
    rules: tuple[Callable[[Convention], bool], ...] = (
        lambda c: c.position[0].lower() not in computed,
        lambda c: c.position[0].lower() not in superseded,
        lambda c: _own_error(search, c) is not None,
        lambda c: "main" in search.ucd(search.find(c.position[0]) or ""),
    )
    for rule in rules:
        by_rule = [c for c in candidates if rule(c)]
        chosen = by_rule or candidates
        if len({c.position[0].lower() for c in chosen}) == 1:
            break
        candidates = chosen
    _refuse_ambiguous(search, chosen)
    taken = search.find(chosen[0].position[0])
    all_ra = {search.find(c.position[0]) for c in surveys.CONVENTIONS if _applies(search, c)}
    return chosen[0], tuple(sorted(name for name in all_ra if name and name != taken))


def _states_b1950(search: ColumnSearch, convention: Convention) -> bool:
    """Whether the table's header or VOTable says FK4 or equinox 1950, and the column's name no other."""
    header = {str(key).upper(): str(value).strip().upper() for key, value in search.table.meta.items()}
    frame = next((header[key] for key in ("COOSYS_SYSTEM", "RADESYS", "RADECSYS") if key in header), "")
    equinox = next((header[key] for key in ("COOSYS_EQUINOX", "EQUINOX") if key in header), "")
    other = any(text in convention.position[0].lower() for text in ("2000", "icrs"))
    return not other and ("FK4" in frame or (not frame and equinox in ("1950", "1950.0", "B1950", "B1950.0")))


def _applies(search: ColumnSearch, convention: Convention) -> bool:
    marked = not convention.marks or search.first(convention.marks) is not None
    marked = marked and search.first(convention.without) is None
    return marked and search.find_all(convention.position) is not None


def _refuse_ambiguous(search: ColumnSearch, chosen: list[Convention]) -> None:
    """Refuses several equally good positions or errors; puts conventions with errors first."""
    positions = sorted({search.find(c.position[0]) or "" for c in chosen})
    if len(positions) == 1 and all(_own_error(search, c) is None for c in chosen):
        positions = sorted(n for n in search.table.colnames if n.lower() == positions[0].lower())
    if len(positions) > 1:
        raise InputError(
            f"{search.source}: {len(positions)} candidates for right ascension: {', '.join(map(repr, positions))}",
            naming("give {ra:NAME}"),
        )
    errors = {names for c in chosen if (e := _own_error(search, c)) and (names := search.find_all(e.names))}
    if len(errors) > 1 and search.options.sigma is None and search.options.ellipse is None:
        raise InputError(
            f"{search.source}: {len(errors)} candidates for the position errors: "
            f"{' or '.join(','.join(names) for names in sorted(errors))}",
            naming("give {sigma:'EAST,NORTH'} or {ellipse:'A,B,ANGLE'}"),
        )
    chosen.sort(key=lambda c: _own_error(search, c) is None)


def _position_of_options(search: ColumnSearch) -> Convention:
    """The convention of the columns named by the options."""
    options = search.options
    stated = search.required(options.ra or options.dec or "", "ra" if options.ra else "dec")
    axis = 0 if options.ra else 1
    other = search.required(options.dec, "dec") if options.ra and options.dec else None
    known = [
        c
        for c in (*surveys.CONVENTIONS, *surveys.OTHER_FRAMES)
        if _applies(search, c)
        and search.find(c.position[axis]) == stated
        and other in (None, search.find(c.position[1 - axis]))
    ]
    if known:
        return min(known, key=lambda c: _own_error(search, c) is None)
    if other is None:
        raise InputError(f"{search.source}: {stated!r} has no known partner", naming("give {ra:NAME} and {dec:NAME}"))
    return conventions.plain((stated, other), title="options")


def _position_by_ucd(search: ColumnSearch) -> Convention | None:
    """The position columns with the UCDs of right ascension and declination, or galactic longitude and latitude."""

    def columns_with(*patterns: str) -> list[str]:
        ucds = {name: search.ucd(name) for name in search.table.colnames}
        names = [n for n, ucd in ucds.items() if ucd.startswith(patterns)]
        return [n for n in names if "main" in ucds[n]] or names

    ra, dec = columns_with("pos.eq.ra", "pos_eq_ra"), columns_with("pos.eq.dec", "pos_eq_dec")
    if len(ra) == 1 and len(dec) == 1:
        return conventions.plain((ra[0], dec[0]), title="UCD pos.eq.ra, pos.eq.dec")
    lon, lat = columns_with("pos.galactic.lon", "pos_gal_lon"), columns_with("pos.galactic.lat", "pos_gal_lat")
    if len(lon) == 1 and len(lat) == 1 and not ra:
        return conventions.plain((lon[0], lat[0]), "UCD pos.galactic.lon, pos.galactic.lat", "galactic")
    return None


def _no_position(search: ColumnSearch) -> Convention:
    tables = next((note for note in search.table.meta.get("sameas_notes", ()) if "extensions" in note), "")
    other = f" ({tables})" if tables else ""
    raise InputError(
        f"{search.source}: no columns of right ascension and declination found among: {search.listing()}{other}",
        naming("choose another table: give {hdu:NAME}" if tables else "give {ra:NAME} {dec:NAME}"),
    )


def _own_error(search: ColumnSearch, convention: Convention) -> ErrorNames | None:
    return next((e for e in convention.errors if search.find_all(e.names)), None)


def _direction(search: ColumnSearch, name: str, convention: Convention, axis: int) -> ChosenColumn:
    """The column of right ascension or longitude (axis 0), declination or latitude (axis 1)."""
    right_ascension, unit = axis == 0 and convention.frame in ("icrs", "B1950"), convention.unit
    if convention.parts:
        parts = tuple(part_name for part in convention.parts[axis] if (part_name := search.find(part)))
        unit_text = f"{'hours' if right_ascension else 'degrees'} in {', '.join(parts)}"
        return ChosenColumn(name, unit_text, "by convention", parts)
    if column_values.is_sexagesimal(search.table, name):
        own = column_values.unit_of(search.table, name)
        if not right_ascension or own == u.deg:
            return ChosenColumn(name, "sexagesimal degrees", "by its notation")
        first = column_values.sexagesimal(search.table[[name]][:1000], name, search.source)
        if own is None and np.nanmax(np.abs(first), initial=0.0) > 24.0:
            return ChosenColumn(name, "sexagesimal degrees", "by its notation, and numbers above 24")
        return ChosenColumn(name, "sexagesimal hours", "by its notation")
    column = search.column(name, unit)
    if column.unit in ("h", "hourangle"):
        return replace(column, unit="hourangle")
    return search.checked(column, "deg", "an angle")


def _position_error(search: ColumnSearch, convention: Convention) -> PositionError:
    options = search.options
    if options.sigma is not None and options.ellipse:
        raise InputError(Message(f"{search.source}: ", naming("give {sigma} or {ellipse}, not both")))
    if options.ellipse:
        stated = search.several(options.ellipse, 3, "ellipse")
        own = next((e for e in convention.errors if search.find_all(e.names) == stated), None)
        return _error_columns(search, own or ErrorNames("ellipse", stated))
    if options.sigma is not None:
        return _error_of_option(search, options.sigma, convention)
    own = _own_error(search, convention)
    if own:
        return _error_columns(search, own, convention)
    deviations = (
        *conventions.plain(convention.position).errors,
        *conventions.PLAIN_CIRCLES,
        *_circles_by_ending(search),
    )
    bare = () if search.first(conventions.LIGHT_RADII) else conventions.BARE_RADII
    for candidates in (deviations, conventions.CONFIDENCE_RADII, bare):
        found = {names: e for e in candidates if (names := search.find_all(e.names)) and _may_be_angle(search, names)}
        if found:
            break
    if len(found) > 1:
        raise InputError(
            f"{search.source}: {len(found)} candidates for the position error: "
            f"{' or '.join(','.join(names) for names in found)}",
            naming("give {sigma:NAME}"),
        )
    by_ucd = _errors_by_ucd(search)
    for error_names in (*found.values(), *([by_ucd] if by_ucd else [])):
        return _error_columns(search, error_names, convention)
    return PositionError("unknown")


def _may_be_angle(search: ColumnSearch, names: tuple[str, ...]) -> bool:
    units = [column_values.unit_of(search.table, name) for name in names]
    return all(unit is None or unit.is_equivalent(u.deg) for unit in units)


def _error_of_option(search: ColumnSearch, sigma: float | str, convention: Convention) -> PositionError:
    number_and_unit = _WITH_UNIT.match(str(sigma).strip())
    in_unit = _UNIT_WORDS.get(number_and_unit[2].lower(), "") if number_and_unit else ""
    if in_unit and search.find(str(sigma)) is None:
        assert number_and_unit is not None
        return _number_of_option(search, float(number_and_unit[1]), in_unit)
    try:
        number = float(sigma)
    except ValueError:
        text = str(sigma)
        count = 1 + text.count(",")
        names = search.several(text, 2 if count > 1 else 1, "sigma")
        own = _own_error(search, convention)
        if own and search.find_all(own.names) == names:
            return _error_columns(search, own, convention)
        known = (*conventions.CONFIDENCE_RADII, *conventions.BARE_RADII)
        radii = (e for e in known if search.find_all(e.names) == names)
        return _error_columns(search, next(radii, ErrorNames("axes" if count > 1 else "circle", names)))
    return _number_of_option(search, number, search.options.sigma_unit or "arcsec")


def _number_of_option(search: ColumnSearch, number: float, unit: str) -> PositionError:
    unit_column = ChosenColumn("sigma", unit, "option")
    search.checked(unit_column, "arcsec", "an angle; give arcsec, mas, deg", naming("'{sigma}'"))
    if not number > 0:
        message = Message(f"{search.source}: ", Argument("sigma", f"{number:g}"), " is not positive")
        raise InputError(message, "give a standard deviation per axis")
    return PositionError("number", sigma_arcsec=number * column_values.factor(unit, "arcsec"))


def _circles_by_ending(search: ColumnSearch) -> tuple[ErrorNames, ...]:
    """Position errors with a survey prefix: ``xmm_poserr_arcsec``."""
    names = [name for name in search.table.colnames if _POSITION_ERROR.search(name)]
    radial = conventions.CONFIDENCE_RADII[-1].containment
    return tuple(
        ErrorNames("circle", (name,), containment=radial if "radec_err" in name.lower() else 0.0) for name in names
    )


def _error_columns(
    search: ColumnSearch, error_names: ErrorNames, convention: Convention | None = None
) -> PositionError:
    """The columns of an error with their units; all ``error_names`` are columns of the table."""
    kind, names = error_names.kind, search.find_all(error_names.names) or ()
    if kind in ("variances", "inverse variances"):
        target = ("arcsec2", "the square of an angle") if kind == "variances" else ("1/arcsec2", "an angle to the -2")
        squares = tuple(search.checked(search.column(n, error_names.unit), *target) for n in names)
        return PositionError(kind, squares, covariance=search.first(error_names.covariance) or "")
    columns = search.angles(names[:2], error_names.unit, of_ra=kind == "axes")
    if kind == "ellipse":
        columns = (*columns, search.checked(search.column(names[2], "deg"), "deg", "an angle"))
    stated = search.options.correlation
    correlation = search.required(stated, "correlation") if stated else ""
    if not stated and kind == "axes" and convention:
        correlation = next((n for i, j, w in convention.correlations if (i, j) == (0, 1) and (n := search.find(w))), "")
    covariance = "" if correlation or kind != "axes" else search.first(error_names.covariance) or ""
    guessed = any(column.reason == GUESSED for column in columns)
    containment = error_names.containment or (_stated_containment(search, names[0]) if kind != "axes" else 0.0)
    sizes = np.concatenate([column_values.numbers(search.table, column.name, search.source) for column in columns[:2]])
    return PositionError(
        kind,
        columns,
        correlation=correlation,
        covariance=covariance,
        co_sigma="" if correlation or covariance else search.find(error_names.co_sigma) or "",
        angle_from=error_names.angle_from,
        guessed_unit=guessed,
        containment=containment,
        placeholders=_placeholders(sizes),
    )


#: Numbers that may stand for a missing error: of nines only from the first, any from the second, if they exceed the
#: median error so many times (chosen).
_LEAST_NINES, _NO_ERROR, _TIMES_THE_MEDIAN = 90.0, 1e10, 20.0


def _placeholders(sizes: FloatArray) -> tuple[float, ...]:
    """The numbers among errors (n,) that stand for missing ones, such as 99, 9999 or 1e20."""
    positive = sizes[(sizes > 0.0) & np.isfinite(sizes)]
    large = np.unique(positive[positive > max(_LEAST_NINES, _TIMES_THE_MEDIAN * median(positive))])
    return tuple(large[(large > _NO_ERROR) | column_values.is_placeholder(large)].tolist()) if len(large) else ()


def _stated_containment(search: ColumnSearch, name: str) -> float:
    """The probability of a circle or an ellipse by the description of its column, "90% confidence"; 0 if not stated."""
    percent = _CONFIDENCE.search(str(search.table[name].info.description or ""))
    return float(percent[1]) / 100.0 if percent else 0.0


def _errors_by_ucd(search: ColumnSearch) -> ErrorNames | None:
    """The position error by its UCDs: an ellipse, the errors of both axes, or a radius; None unless there is one.

    Of several ellipses it is the first, such as those of 68 and of 95 % confidence.
    """
    ucds = {name: search.ucd(name) for name in search.table.colnames}
    of_error = {name: ucd for name, ucd in ucds.items() if "stat.error" in ucd or "pos.errorellipse" in ucd}
    parts = [
        [name for name, ucd in of_error.items() if any(word in ucd for word in words)]
        for words in (("smajaxis",), ("sminaxis",), ("pos.posang",))
    ]
    if parts[0] and len(parts[0]) == len(parts[1]) == len(parts[2]):
        return ErrorNames("ellipse", tuple(part[0] for part in parts))
    of_axes = [[n for n, ucd in ucds.items() if ucd.startswith(f"stat.error;pos.eq.{axis}")] for axis in ("ra", "dec")]
    if all(len(names) == 1 for names in of_axes):
        return ErrorNames("axes", (of_axes[0][0], of_axes[1][0]))
    radii = [n for n, ucd in of_error.items() if ucd in ("stat.error;pos", "stat.error;pos.eq", "pos.errorellipse")]
    return ErrorNames("circle", (radii[0],)) if len(radii) == 1 else None


def _motion(search: ColumnSearch, convention: Convention) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[str, ...]]:
    """Columns of parallax, proper motion and radial velocity, the columns of their errors, and notes."""
    options = search.options
    names: list[str | None] = [None] * 4
    errors: list[str | None] = [None] * 4
    for motion_names in convention.motions:
        for k, (name, error) in enumerate(zip(motion_names.names, motion_names.errors, strict=True)):
            found = search.find(name)
            if names[k] is None and found:
                names[k], errors[k] = found, search.find(error)
            elif found and found == names[k] and errors[k] is None:
                # pmRA is found by two spellings, pmra and pmRA, and its error e_pmRA by the second only.
                errors[k] = search.find(error)
    if (names[1] is None) != (names[2] is None):
        names[1:3] = errors[1:3] = [None, None]
    if options.pm and options.pm.lower() == "none":
        names[1:3] = errors[1:3] = [None, None]
    elif options.pm:
        stated = search.several(options.pm, 2, "pm")
        errors[1:3] = [
            e if stated == tuple(names[1:3]) else _error_of(search, s) for s, e in zip(stated, errors[1:3], strict=True)
        ]
        names[1:3] = stated
    for k, text, option in ((0, options.parallax, "parallax"), (3, options.radial_velocity, "radial_velocity")):
        if text:
            names[k] = None if text.lower() == "none" else search.required(text, option)
            errors[k] = _error_of(search, names[k])
    notes = []
    if names[1] is None and not options.pm and (plain_names := search.find_all(("pm_ra", "pm_dec"))):
        not_used = f"{', '.join(plain_names)} not used: with or without cos(dec) is not stated; if with, give "
        notes.append(Message(not_used, Argument("pm", repr(",".join(plain_names)))))
    return (
        _motion_columns(search, names),
        _motion_columns(search, errors),
        tuple(notes),
    )


def _motion_columns(search: ColumnSearch, names: list[str | None]) -> tuple[ChosenColumn | None, ...]:
    """The columns of parallax, motion in right ascension and declination, radial velocity, or of their errors."""
    units = ("mas", "mas / yr", "mas / yr", "km / s")
    return tuple(
        search.motion_column(name, unit, of_ra=k == 1) if name else None
        for k, (name, unit) in enumerate(zip(names, units, strict=True))
    )


def _error_of(search: ColumnSearch, name: str | None) -> str | None:
    patterns = ("{}_error", "e_{}", "{}_err", "{}err", "{}Err", "sigma_{}")
    return search.first(tuple(pattern.format(name) for pattern in patterns)) if name else None


def _epoch(search: ColumnSearch, convention: Convention, ra: str) -> Epoch:
    stated, table = search.options.epoch, search.table
    if stated is not None:
        if str(stated).lower() == "none":
            return Epoch(reason="not used, option")
        try:
            return Epoch(jyr=column_values.year_of(str(stated)), reason="option")
        except ValueError:
            column = search.required(str(stated), "epoch")
            return Epoch(column=column, reason=f"column {column}, option")
    name = search.first(convention.epochs)
    if name:
        return Epoch(column=name, reason=f"column {name}")
    if convention.only_epoch:
        return Epoch(jyr=convention.epoch_jyr, reason=f"epoch of {convention.title}")
    for wanted in conventions.PLAIN_EPOCHS:  # valid with any names of the position
        name = search.find(wanted)
        if name and column_values.are_years(table, name):
            return Epoch(column=name, reason=f"column {name}")
    year_in_description = _DESCRIBED_EPOCH.search(str(table[ra].info.description or ""))
    if year_in_description:
        return Epoch(jyr=float(year_in_description[1]), reason=f"description of {ra}")
    if convention.epoch_jyr is not None:
        return Epoch(jyr=convention.epoch_jyr, reason=f"epoch of {convention.title}")
    release_epoch = _released_epoch(search, convention)
    return release_epoch if release_epoch else _header_epoch(table)


def _year(search: ColumnSearch, epoch: Epoch) -> float | None:
    """The Julian year of all rows, or the median over the rows; None if it is not known."""
    if not epoch.column:
        return epoch.jyr
    years = column_values.years(search.table, epoch.column, search.source)
    known = years[np.isfinite(years)]
    return median(known) if len(known) else None


def _released_epoch(search: ColumnSearch, convention: Convention) -> Epoch | None:
    """The epoch of the data release named in the texts or implied by the columns; None unless there is exactly one."""
    texts = _texts(search)
    reasons = {
        epoch: f"the table states {match[0]}"
        for pattern, epoch in convention.releases
        for text in texts
        if (match := re.search(pattern, text, re.IGNORECASE))
    }
    reasons |= {
        epoch: f"of the release that has {column}"
        for wanted, epoch in convention.release_columns
        if (column := search.find(wanted))
    }
    if len(reasons) != 1:
        return None
    (epoch, reason), *_ = reasons.items()
    return Epoch(jyr=epoch, reason=reason)


def _texts(search: ColumnSearch) -> list[str]:
    """The metadata of the table and its first designations, searched for the data release."""
    texts = [f"{key} {value}" for key, value in search.table.meta.items()]
    name = search.find("designation")
    if name and column_values.is_text(search.table, name):
        texts += [str(text) for text in search.table[name][:100]]
    return texts


def _header_epoch(table: Table) -> Epoch:
    header = {str(key).upper(): value for key, value in table.meta.items()}
    unread = ""
    for key in conventions.HEADER_EPOCHS:
        if key.upper() in header:
            text = str(header[key.upper()])
            try:
                return Epoch(jyr=column_values.year_of(text), reason=f"header {key}{unread}")
            except ValueError:
                unread = unread or f"; {key} = {text!r} is no time"
    return Epoch(reason=f"{Epoch.reason}{unread}")


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
    stated = search.options.magnitude
    if stated:
        name = None if stated.lower() == "none" else search.required(stated, "magnitude")
        return name, _error_of(search, name)
    for wanted, error in convention.magnitudes + conventions.PLAIN_MAGNITUDES:
        name = search.find(wanted)
        if name and _holds_magnitudes(search.table, name):
            errors_of_name = tuple(e for w, e in convention.magnitudes + conventions.PLAIN_MAGNITUDES if w == wanted)
            return name, search.find(error) or search.first(errors_of_name)
    by_ucd = next((n for n in search.table.colnames if search.ucd(n).startswith(("phot.mag;", "phot_mag"))), None)
    if by_ucd:
        return by_ucd, None
    units = _bands(search)
    band = next((name for name, unit in units.items() if unit is not None and unit.to_string() == "mag"), None)
    if band is None:
        named = filter(conventions.BAND_MAGNITUDE.fullmatch, search.table.colnames)
        band = next((name for name in named if _holds_magnitudes(search.table, name)), None)
    return band, _error_of(search, band)


def _holds_magnitudes(table: Table, name: str) -> bool:
    """Whether a column has one number per row: apertures have several."""
    return getattr(table[name], "ndim", 1) == 1 and column_values.holds_numbers(table, name)


def _bands(search: ColumnSearch) -> dict[str, u.UnitBase | None]:
    """Columns with the name of a band, and their units."""
    return {
        name: column_values.unit_of(search.table, name) for name in conventions.BANDS if name in search.table.colnames
    }


def _unused_errors(search: ColumnSearch, used: Collection[str | None]) -> tuple[Message, ...]:
    """A note if columns that are named as errors are angles, by their unit, without those used for something else."""
    names = [
        name
        for name in search.table.colnames
        if name not in used
        and _ERROR_WORDS.search(name)
        and (unit := column_values.unit_of(search.table, name)) is not None
        and unit.is_equivalent(u.deg)
    ]
    if not names:
        return ()
    one = f"{', '.join(names[:6])} not used; if {'it is' if len(names) == 1 else 'they are'} the position's, give "
    own = Argument("ellipse", repr(",".join(names))) if len(names) == 3 else Argument("sigma", repr(names[0]))
    return (Message(one, own),)


def _unused_bands(search: ColumnSearch) -> tuple[Message, ...]:
    """A note if columns with the names of bands state no unit."""
    unknown = [
        name for name, unit in _bands(search).items() if unit is None and not (len(name) == 1 and name.islower())
    ]
    names = [name for name in unknown if column_values.holds_numbers(search.table, name)]
    if not names:
        return ()
    not_used = f"not used: {', '.join(names)}, whose unit is not stated; if it is mag, give "
    return (Message(not_used, Argument("magnitude", repr(names[0]))),)
