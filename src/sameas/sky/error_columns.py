"""Error columns: which columns are the position error, in which form, unit and confidence.

Options come first, then the convention of the position, the usual names of errors and radii, and UCDs. If several are
equally good, the table is refused and they are listed.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from astropy import units as u

from sameas.arrays import FloatArray, median
from sameas.errors import Argument, InputError, Message, naming
from sameas.sky import column_values, conventions
from sameas.sky.column_choice import GUESSED, ChosenColumn, PositionError
from sameas.sky.column_search import UNIT_WORDS, ColumnSearch
from sameas.sky.conventions import Convention, ErrorNames

#: A number with a unit: ``100mas``, ``0.1 arcsec``, ``0.1"``.
_WITH_UNIT = re.compile(r"^([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*([a-z°″'\"]+)$", re.IGNORECASE)
#: The end of the name of a position error with a survey's prefix.
_POSITION_ERROR = re.compile(
    r"_(?:pos_?err(?:or)?|e_pos|pos_sigma|sigma_pos|radec_err)(?:_(?:arcsec|mas|deg))?$", re.IGNORECASE
)
#: A probability in the description of a radius or an ellipse.
_CONFIDENCE = re.compile(r"\b(6[38]|9[059]|6[38]\.\d+)\s?(?:%|per ?cent)", re.IGNORECASE)


def own_error(search: ColumnSearch, convention: Convention) -> ErrorNames | None:
    """The first error of the convention whose columns the table has, with positive numbers."""
    return next(
        (e for e in convention.errors if (names := search.find_all(e.names)) and search.hold_errors(names)), None
    )


def position_error(search: ColumnSearch, convention: Convention) -> PositionError:
    """The position error of a table with a position of this convention; of the kind "unknown" without one."""
    options = search.options
    if options.sigma is not None and options.ellipse:
        raise InputError(Message(f"{search.source}: ", naming("give {sigma} or {ellipse}, not both")))
    if options.ellipse:
        stated = search.several(options.ellipse, 3, "ellipse")
        return _error_columns(search, _named_by_option(search, stated, convention) or ErrorNames("ellipse", stated))
    if options.sigma is not None:
        return _error_of_option(search, options.sigma, convention)
    own = own_error(search, convention)
    if own:
        return _error_columns(search, own, convention)
    deviations = (
        *conventions.plain(convention.position).errors,
        *conventions.PLAIN_CIRCLES,
        *_circles_by_ending(search),
        *(e for e in conventions.PLAIN_ELLIPSES if not _are_of_a_shape(search, e.names)),
    )
    # Those of a survey have been passed over: its archive fills columns that it does not compute with a default.
    of_survey = {search.find_all(e.names) for e in convention.errors} if convention.marks else set()
    bare = () if search.first(conventions.LIGHT_RADII) else conventions.BARE_RADII
    for candidates in (deviations, _confidence_radii(search), bare):
        found = {names: e for e in candidates if (names := search.find_all(e.names)) and _may_be_angle(search, names)}
        found = {names: e for names, e in found.items() if names not in of_survey}
        found = {names: e for names, e in found.items() if search.hold_errors(names)}
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


def _are_of_a_shape(search: ColumnSearch, names: tuple[str, ...]) -> bool:
    """Whether columns named as errors of axes are those of the axes of the source: ``err_a`` beside ``a`` (Aegean)."""
    measured = re.sub(r"^(?:pos_?)?(?:err|error|sigma)_?(?:ellipse_?)?", "", names[0])
    return search.find(measured) is not None


def _may_be_angle(search: ColumnSearch, names: tuple[str, ...]) -> bool:
    """Whether columns named as errors may be angles: by their units, and not as whole numbers called ``err``, which
    are codes (forced photometry of ATLAS)."""
    units = [column_values.unit_of(search.table, name) for name in names]
    code = names[0].lower() in ("err", "error") and units[0] is None and search.table[names[0]].dtype.kind in "iub"
    return not code and all(unit is None or unit.is_equivalent(u.deg) for unit in units)


def _error_of_option(search: ColumnSearch, sigma: float | str, convention: Convention) -> PositionError:
    number_and_unit = _WITH_UNIT.match(str(sigma).strip())
    in_unit = UNIT_WORDS.get(number_and_unit[2].lower(), "") if number_and_unit else ""
    if in_unit and search.find(str(sigma)) is None:
        assert number_and_unit is not None
        return _number_of_option(search, float(number_and_unit[1]), in_unit)
    try:
        number = float(sigma)
    except ValueError:
        text = str(sigma)
        count = 1 + text.count(",")
        names = search.several(text, 2 if count > 1 else 1, "sigma")
        own = _named_by_option(search, names, convention)
        if own:
            return _error_columns(search, own, convention)
        return _error_columns(search, ErrorNames("axes" if count > 1 else "circle", names))
    return _number_of_option(search, number, search.options.sigma_unit or "arcsec")


def _named_by_option(search: ColumnSearch, names: tuple[str, ...], convention: Convention) -> ErrorNames | None:
    """The error of these columns by the convention or by the usual names of radii; None if they are not known.

    One axis of a known ellipse is a circle of the same probability.
    """
    known = (*convention.errors, *_confidence_radii(search, every=True), *conventions.BARE_RADII)
    named = next((e for e in known if search.find_all(e.names) == names), None)
    if named is None and len(names) == 1:
        axis = next(
            (e for e in known if e.kind == "ellipse" and names[0] in (search.find_all(e.names) or ())[:2]), None
        )
        named = axis and replace(axis, kind="circle", names=names)
    return named


def _confidence_radii(search: ColumnSearch, *, every: bool = False) -> tuple[ErrorNames, ...]:
    """The columns that are radii of a stated probability by their names; unless ``every``, those of one probability."""
    radii = [
        ErrorNames("circle", (name,), "arcsec", containment=int(match["percent"] or match["of_pos"]) / 100.0)
        for name in search.table.colnames
        if (match := conventions.CONFIDENCE_RADIUS.fullmatch(name.lower()))
    ]
    if not every:
        usual = next((p for p in (0.9, 0.95, 0.68, 0.99, 0.5) if any(e.containment == p for e in radii)), 0.0)
        radii = [e for e in radii if e.containment == usual]
    return (*radii, conventions.RADEC_ERR)


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
    radial = conventions.RADIAL_CONTAINMENT
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
    columns = search.angles(names[:2], error_names.unit, of_ra=kind == "axes", unit_of_ra=error_names.unit_of_ra)
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
    """The probability of a circle or an ellipse by the description of its column, "90% confidence", or its name; 0 if
    neither states one."""
    percent = _CONFIDENCE.search(str(search.table[name].info.description or ""))
    if percent:
        return float(percent[1]) / 100.0
    named = conventions.NAMED_PERCENTAGE.search(name)
    return float(named["percent"] or named["behind"] or named["before"]) / 100.0 if named else 0.0


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
