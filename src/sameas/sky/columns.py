"""Columns: which columns of a table are position, errors, motion, epoch and brightness, with the reason for each.

:func:`choose` uses the column names of known catalogues (:mod:`sameas.sky.surveys`), units and UCDs; an option
takes precedence. All position columns come from one convention: never the right ascension of one and the declination
of another. If two choices are equally good, the table is refused and the choices are listed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import Table

from sameas.arrays import median
from sameas.errors import Argument, InputError, Message, naming
from sameas.sky import column_values, conventions, surveys
from sameas.sky.column_choice import CatalogueOptions, ChosenColumn, ColumnChoice, Epoch, PositionError, survey_of
from sameas.sky.column_search import ColumnSearch
from sameas.sky.conventions import Convention
from sameas.sky.error_columns import own_error, position_error
from sameas.sky.frame.cards import date_of, start_mjd

_DESCRIBED_EPOCH = re.compile(r"\bEp(?:och)?\s*[=:]?\s*J?\s*((?:18|19|20)\d\d(?:\.\d+)?)", re.IGNORECASE)
#: Parts of the names of columns of errors.
_ERROR_WORDS = re.compile(r"err|sigma|unc(?![a-z])|ellipse|(?:^|_)(?:rms|std)(?:_|$)", re.IGNORECASE)
#: Names of errors of a position, whatever their unit: ``error_radius``, ``RA_ERR_PLUS``, ``sigmara``.
_POSITION_ERROR_WORDS = re.compile(
    r"err(?:or)?_?(?:rad(?:ius)?|circle|ellipse|ra|dec|pos)(?![a-z])|(?:^|_)(?:ra|dec|de|pos(?:ition)?)_?(?:err|unc|sig|std)"
    r"|sig(?:ma)?_?(?:ra|dec|pos)(?![a-z])|(?:^|_)e_(?:ra|dec?|pos)|ellipse",
    re.IGNORECASE,
)


def choose(table: Table, options: CatalogueOptions, source: str) -> ColumnChoice:
    """The columns chosen for position, errors, motion, epoch, id and magnitude.

    table : read are names, units, UCDs, descriptions, header and the notation of the cells.
    options : columns given by the user. source : name used in messages.

    Raises InputError: no position, two equally good ones, ambiguous errors, unknown columns, unfit units; all at once.
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
        lambda: position_error(search, convention),
    )
    position, motions, epoch, id, magnitudes, error = _all_of(choosers)
    motion, motion_errors, notes = motions
    correlations = tuple((i, j, name) for i, j, wanted in convention.correlations if (name := search.find(wanted)))
    if not_used:
        notes = (*notes, f"not used: {', '.join(not_used)}")
    magnitude, magnitude_error = magnitudes
    followed = _followed(search, error, magnitude)
    if followed and not (followed == magnitude and magnitude_error):
        name, error = error.columns[0].name, PositionError("unknown")
        magnitude_error = name if followed == magnitude else magnitude_error
        stated = f"{name} is taken for the error of {followed}, which it follows; if it is the position's, give "
        notes = (*notes, Message(stated, Argument("sigma", repr(name))))
    if magnitude is None and options.magnitude is None:
        notes = (*notes, *_unused_bands(search))
    incomplete = error.kind == "unknown" or (motion[1] is not None and motion_errors[1] is None)
    survey = survey_of(convention.title, _year(search, epoch), _texts(search)) if incomplete else None
    if error.kind == "unknown":
        used = {getattr(column, "name", column) for column in (*motion_errors, magnitude_error, *position)}
        notes = (*notes, *_unused_errors(search, used))
        error = error if survey is None else PositionError("survey", survey=survey)
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
        survey=survey,
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
        return _position_by_ucd(search) or next(other_frames, None) or _pair_named_alike(search), ()
    superseded = {name.lower() for c in candidates for name in c.over if name != c.position[0]}
    computed = {name.lower() for name in conventions.VIZIER_COMPUTED}
    rules: tuple[Callable[[Convention], bool], ...] = (
        lambda c: c.position[0].lower() not in computed,
        lambda c: c.position[0].lower() not in superseded,
        lambda c: own_error(search, c) is not None,
        lambda c: "main" in search.ucd(search.find(c.position[0]) or ""),
    )
    for rule in rules:
        by_rule = [c for c in candidates if rule(c)]
        chosen = by_rule or candidates
        if len({c.position[0].lower() for c in chosen}) == 1:
            break
        candidates = chosen
    # A recognised survey knows which of its columns are the errors.
    chosen = [c for c in chosen if c.marks and own_error(search, c)] or chosen
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
    if len(positions) == 1 and all(own_error(search, c) is None for c in chosen):
        positions = sorted(n for n in search.table.colnames if n.lower() == positions[0].lower())
    if len(positions) > 1:
        raise InputError(
            f"{search.source}: {len(positions)} candidates for right ascension: {', '.join(map(repr, positions))}",
            naming("give {ra:NAME}"),
        )
    errors = {names for c in chosen if (e := own_error(search, c)) and (names := search.find_all(e.names))}
    if len(errors) > 1 and search.options.sigma is None and search.options.ellipse is None:
        raise InputError(
            f"{search.source}: {len(errors)} candidates for the position errors: "
            f"{' or '.join(','.join(names) for names in sorted(errors))}",
            naming("give {sigma:'EAST,NORTH'} or {ellipse:'A,B,ANGLE'}"),
        )
    chosen.sort(key=lambda c: own_error(search, c) is None)


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
        return min(known, key=lambda c: own_error(search, c) is None)
    if other is None and axis == 0:
        other = search.partner_of(stated)
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


#: Columns of positions on an image: SExtractor, photutils, DAOPHOT, IRAF, plain.
_PIXELS = (
    ("XWIN_IMAGE", "YWIN_IMAGE"), ("X_IMAGE", "Y_IMAGE"), ("xcentroid", "ycentroid"), ("x_fit", "y_fit"),
    ("XCENTER", "YCENTER"), ("x_pix", "y_pix"), ("x_centroid", "y_centroid"), ("x", "y"),
)  # fmt: skip


def _pair_named_alike(search: ColumnSearch) -> Convention:
    """The only pair of columns whose names differ in the coordinate alone; refused without one, and with several."""
    pairs = search.positions()
    if len(pairs) == 1:
        return conventions.plain(pairs[0], title="a pair named alike")
    if pairs:
        listed = "; ".join(", ".join(pair) for pair in pairs[:6])
        (ra, dec), *_ = pairs
        raise InputError(
            f"{search.source}: {len(pairs)} candidates for right ascension and declination: {listed}",
            Message("give ", Argument("ra", repr(ra)), " ", Argument("dec", repr(dec)), " or another pair"),
        )
    tables = next((note for note in search.table.meta.get("sameas_notes", ()) if "extensions" in note), "")
    other = f" ({tables})" if tables else ""
    pixels = next((names for pair in _PIXELS if (names := search.find_all(pair))), None)
    if pixels and not tables:
        wanted = next((note for note in search.table.meta.get("sameas_notes", ()) if "pixels" in note), "")
        convert = "convert them with the solution of their image (astropy.wcs), or give {ra:NAME} {dec:NAME}"
        raise InputError(
            f"{search.source}: no columns of right ascension and declination, but pixels {', '.join(pixels)}",
            wanted or naming(convert),
        )
    both = next(filter(lambda name: _holds_both(search.table, name), search.table.colnames), None)
    if both:
        raise InputError(
            f"{search.source}: {both} holds right ascension and declination together",
            "divide it into two columns, such as RA and DEC",
        )
    raise InputError(
        f"{search.source}: no columns of right ascension and declination found among: {search.listing()}{other}",
        naming("choose another table: give {hdu:NAME}" if tables else "give {ra:NAME} {dec:NAME}"),
    )


#: Two numbers in degrees; or hours, minutes and seconds, then degrees, minutes and seconds.
_BOTH = re.compile(
    r"\s*(\d{1,3}\.\d+[\s,]+[+-]?\d{1,2}\.\d+"
    r"|\d{1,2}[h: ]\d{1,2}[m: ]\d{1,2}(\.\d*)?s?[\s,]*[+-]?\d{1,2}[d: ]\d{1,2}[m: ]\d{1,2}(\.\d*)?s?)\s*"
)


def _holds_both(table: Table, name: str) -> bool:
    """Whether the first cell of a column of text is a right ascension and a declination."""
    first = table[name][:1]
    return first.dtype.kind in "OSU" and len(first) > 0 and bool(_BOTH.fullmatch(str(first[0])))


def _direction(search: ColumnSearch, name: str, convention: Convention, axis: int) -> ChosenColumn:
    """The column of right ascension or longitude (axis 0), declination or latitude (axis 1)."""
    right_ascension = axis == 0 and convention.frame in ("icrs", "B1950")
    unit = (right_ascension and convention.unit_of_ra) or convention.unit
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
    stated = getattr(search.table[name], "unit", None)
    if isinstance(stated, u.UnrecognizedUnit) and column.reason == "by convention":
        column = replace(column, reason=f"assumed: its unit {str(stated)!r} cannot be read")
    return search.checked(column, "deg", "an angle")


def _motion(search: ColumnSearch, convention: Convention) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[str, ...]]:
    """Columns of parallax, proper motion and radial velocity, the columns of their errors, and notes."""
    options = search.options
    names: list[str | None] = [None] * 4
    errors: list[str | None] = [None] * 4
    unit = next((m.unit for m in convention.motions if search.find(m.names[1])), "mas")
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
    return (_motion_columns(search, names, unit), _motion_columns(search, errors, unit), tuple(notes))


def _motion_columns(search: ColumnSearch, names: list[str | None], unit: str) -> tuple[ChosenColumn | None, ...]:
    """The columns of parallax, motion in right ascension and declination, radial velocity, or of their errors.

    unit : of the parallax, and of the motions in a year, where the table states none.
    """
    units = (unit, f"{unit} / yr", f"{unit} / yr", "km / s")
    return tuple(
        search.motion_column(name, unit, of_ra=k == 1) if name else None
        for k, (name, unit) in enumerate(zip(names, units, strict=True))
    )


def _error_of(search: ColumnSearch, name: str | None) -> str | None:
    if not name:
        return None
    patterns = ("{}_error", "e_{}", "{}_err", "{}err", "{}Err", "sigma_{}")
    names = [pattern.format(name) for pattern in patterns]
    quantity, _, band = name.rpartition("_")
    if quantity.lower() in ("mag", "magnitude"):  # mag_g: magerr_g, mag_err_g
        names += [f"{quantity}{error}_{band}" for error in ("err", "_err", "error", "_error")]
    return search.first(tuple(names))


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
    own_columns = (found for wanted in convention.epochs if (found := search.find(wanted)))
    dated = next((one for one in own_columns if column_values.holds_positive(table, one)), None)
    if dated:
        return _with_median(search, Epoch(column=dated, reason=f"column {dated}"), convention)
    if convention.only_epoch:
        named = f"epoch of {convention.title}" if convention.epoch_jyr is not None else "not known"
        return Epoch(jyr=convention.epoch_jyr, reason=named)
    for wanted in conventions.PLAIN_EPOCHS + conventions.SOLAR_EPOCHS:  # valid with any names of the position
        name = search.find(wanted)
        if name and column_values.are_years(table, name):
            return Epoch(column=name, reason=f"column {name}")
    for name in column_values.counted_days(table):
        if column_values.are_years(table, name):
            return Epoch(column=name, reason=f"column {name}")
    year_in_description = _DESCRIBED_EPOCH.search(str(table[ra].info.description or ""))
    if year_in_description:
        return Epoch(jyr=float(year_in_description[1]), reason=f"description of {ra}")
    if convention.epoch_jyr is not None:
        return Epoch(jyr=convention.epoch_jyr, reason=f"epoch of {convention.title}")
    release_epoch = _released_epoch(search, convention)
    return release_epoch if release_epoch else _header_epoch(table)


def _with_median(search: ColumnSearch, epoch: Epoch, convention: Convention) -> Epoch:
    """The epoch with the median of its column for the rows without one, if the survey's rows are of one campaign."""
    if not convention.one_campaign or not column_values.are_years(search.table, str(epoch.column)):
        return epoch
    years = column_values.years(search.table, str(epoch.column), search.source)
    if np.isfinite(years).all():
        return epoch
    middle = median(years[np.isfinite(years)])
    return replace(epoch, otherwise_jyr=middle, reason=f"{epoch.reason}; in rows without one its median {middle:.2f}")


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
            year = _header_year(text)
            if year is not None:
                return Epoch(jyr=year, reason=f"header {key}{unread}")
            unread = unread or f"; {key} = {text!r} is no time"
    counted = start_mjd(header)
    if counted is not None:
        return Epoch(jyr=float(column_values.mjd_to_jyr(counted[0])), reason=f"header {counted[1]}{unread}")
    return Epoch(reason=f"{Epoch.reason}{unread}")


def _header_year(text: str) -> float | None:
    """The Julian year of a header's text, also of a date as in FITS before 2000 (31/12/98).

    None for what is no time, and for zero or less, which stands for a time that was not set.
    """
    try:
        year = column_values.year_of(text)
    except ValueError:
        day = date_of(text.strip())
        return None if day is None else float(column_values.mjd_to_jyr(day[0] + (day[1] or 0.0)))
    return year if year > 0.0 else None


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
        return name, None if name and column_values.is_flux(search.table, name) else _error_of(search, name)
    for wanted, error in convention.magnitudes + conventions.PLAIN_MAGNITUDES:
        name = search.find(wanted)
        if name and _holds_magnitudes(search.table, name):
            errors_of_name = tuple(e for w, e in convention.magnitudes + conventions.PLAIN_MAGNITUDES if w == wanted)
            return name, search.find(error) or search.first(errors_of_name) or _error_of(search, name)
    by_ucd = next((n for n in search.table.colnames if search.ucd(n).startswith(("phot.mag;", "phot_mag"))), None)
    if by_ucd:
        return by_ucd, None
    units = _bands(search)
    band = next((name for name, unit in units.items() if unit is not None and unit.to_string() == "mag"), None)
    if band is None:
        named = filter(conventions.BAND_MAGNITUDE.fullmatch, search.table.colnames)
        band = next((name for name in named if _holds_magnitudes(search.table, name)), None)
    if band is None:
        fluxes = (name for flux in conventions.PLAIN_FLUXES if (name := search.find(flux)))
        return next((name for name in fluxes if _holds_magnitudes(search.table, name)), None), None
    return band, _error_of(search, band)


def _holds_magnitudes(table: Table, name: str) -> bool:
    """Whether a column has one number per row: apertures have several."""
    return getattr(table[name], "ndim", 1) == 1 and column_values.holds_numbers(table, name)


def _bands(search: ColumnSearch) -> dict[str, u.UnitBase | None]:
    """Columns with the name of a band, and their units."""
    return {
        name: column_values.unit_of(search.table, name) for name in conventions.BANDS if name in search.table.colnames
    }


def _followed(search: ColumnSearch, error: PositionError, magnitude: str | None) -> str:
    """The magnitude, or the column named as a band, directly before a position error ``err`` or ``sigma`` without a
    unit; "" if there is none."""
    if search.options.sigma is not None or error.kind != "circle" or not error.guessed_unit:
        return ""
    name, names = error.columns[0].name, search.table.colnames
    before = names[max(names.index(name) - 1, 0)]
    band = before == magnitude or before in conventions.BANDS or conventions.BAND_MAGNITUDE.fullmatch(before)
    return before if band and name.lower() in ("err", "error", "sigma") else ""


def _unused_errors(search: ColumnSearch, used: Collection[str | None]) -> tuple[Message, ...]:
    """A note on columns that are named as errors and are angles by their unit, or without one name an axis, a position
    or a radius; without those used for something else."""
    names = [name for name in search.table.colnames if name not in used and _may_be_position_error(search, name)]
    if not names:
        return ()
    one = f"{', '.join(names[:6])} not used; if {'it is' if len(names) == 1 else 'they are'} the position's, give "
    axes = next(([a, b] for a in names if (b := search.partner_of(a)) and b in names), None)
    if len(names) == 3 and axes is None:
        return (Message(one, Argument("ellipse", repr(",".join(names))), _ONE_SIGMA),)
    return (Message(one, Argument("sigma", repr(",".join(axes or names[:1]))), _ONE_SIGMA),)


#: What the columns of an error are to contain.
_ONE_SIGMA = " (one standard deviation on each axis: a radius of 90 % divided by 2.146, of 95 % by 2.448)"


def _may_be_position_error(search: ColumnSearch, name: str) -> bool:
    unit = column_values.unit_of(search.table, name)
    if unit is None:
        return bool(_POSITION_ERROR_WORDS.search(name)) and column_values.holds_numbers(search.table, name)
    return bool(_ERROR_WORDS.search(name)) and unit.is_equivalent(u.deg)


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
