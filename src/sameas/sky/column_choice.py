"""The columns of a catalogue: the user's options, the resulting choice, and typical errors of surveys.

``SURVEYS`` gives errors of positions and proper motions by magnitude for tables without error columns. They are
medians from the literature, 1σ per axis: right on average at a magnitude, not for each star. Data only.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sameas.arrays import FloatArray
from sameas.sky.conventions import Correlations, SkyFrame

#: Ending of a unit in seconds of time, 15 cos δ arcsec each.
OF_RA = " of right ascension"
#: Unit of errors of right ascension in seconds of time, as in radio surveys at the CDS.
SECONDS_OF_RA = f"s{OF_RA}"


@dataclass(frozen=True)
class Survey:
    """The typical errors of one survey.

    title : common name. source : reference of the numbers. band : band of the magnitudes.
    mag_mas : (magnitude, error in mas per axis), ascending; interpolated linearly in the logarithm of the error,
        constant outside. typical_mas : error where no magnitude is known. mag_mas_per_yr, typical_mas_per_yr : the
        same for proper motions; empty and None if the survey has none.
    conventions : titles of the column conventions of this survey. epochs_jyr : (least, largest) epoch, where several
        surveys share a convention. words : pattern found in the texts of its tables.
    """

    title: str
    source: str
    band: str
    mag_mas: tuple[tuple[float, float], ...]
    typical_mas: float
    conventions: tuple[str, ...] = ()
    epochs_jyr: tuple[float, float] = (-np.inf, np.inf)
    words: str = ""
    mag_mas_per_yr: tuple[tuple[float, float], ...] = ()
    typical_mas_per_yr: float | None = None

    def sigma_mas(self, magnitude: FloatArray | None, n: int) -> FloatArray:
        """(n,) standard deviation per axis, mas, by magnitude where it is known.

        >>> SURVEYS[0].title, SURVEYS[0].sigma_mas(np.array([12.0, 20.0, np.nan]), 3).round(3).tolist()
        ('Gaia DR3', [0.015, 0.4, 0.1])
        """
        return _by_magnitude(self.mag_mas, self.typical_mas, magnitude, n)

    def pm_sigma_mas_per_yr(self, magnitude: FloatArray | None, n: int) -> FloatArray | None:
        """(n,) standard deviation of proper motion per axis, mas/yr; None if the survey has no proper motions.

        >>> SURVEYS[0].pm_sigma_mas_per_yr(np.array([12.0, 20.0, np.nan]), 3).round(3).tolist()
        [0.02, 0.5, 0.12]
        """
        if self.typical_mas_per_yr is None:
            return None
        return _by_magnitude(self.mag_mas_per_yr, self.typical_mas_per_yr, magnitude, n)


def _by_magnitude(
    mag_and_error: tuple[tuple[float, float], ...], typical: float, magnitude: FloatArray | None, n: int
) -> FloatArray:
    if magnitude is None or not mag_and_error:
        return np.full(n, typical)
    mags, errors = np.array(mag_and_error).T
    return np.where(np.isfinite(magnitude), np.exp(np.interp(magnitude, mags, np.log(errors))), typical)


_GAIA = ("Gaia archive", "Gaia at VizieR")
_MOTIONS_DR3 = ((15.0, 0.02), (17.0, 0.07), (20.0, 0.5), (21.0, 1.4))
_MOTIONS_DR2 = ((15.0, 0.06), (17.0, 0.2), (20.0, 1.2), (21.0, 3.0))
_DR3 = Survey(
    "Gaia DR3", "Gaia Collaboration 2021, A&A 649, A1", "G",
    ((15.0, 0.015), (17.0, 0.05), (20.0, 0.4), (21.0, 1.0)), 0.1,
    _GAIA, (2015.9, 2016.1), r"gaia[ _-]?e?dr3|\bI[/_]35[05]\b", _MOTIONS_DR3, 0.12,
)  # fmt: skip
#: The first survey that fits is used.
SURVEYS = (
    _DR3,
    Survey(
        "Gaia DR2", "Gaia Collaboration 2018, A&A 616, A1", "G",
        ((15.0, 0.03), (17.0, 0.1), (20.0, 0.7), (21.0, 2.0)), 0.2,
        _GAIA, (2015.4, 2015.6), r"gaia[ _-]?dr2|\bI[/_]345\b", _MOTIONS_DR2, 0.3,
    ),
    Survey(
        "Gaia DR1", "Gaia Collaboration 2016, A&A 595, A2", "G", ((21.0, 10.0),), 10.0,
        _GAIA, (2014.9, 2015.1), r"gaia[ _-]?dr1|\bI[/_]337\b",
    ),
    # DR3 if the release is not known.
    replace(_DR3, epochs_jyr=(-np.inf, np.inf), words=""),
    Survey(
        "Hipparcos", "ESA 1997, SP-1200", "Hp", ((9.0, 0.7), (12.0, 1.6)), 0.8,
        ("Hipparcos (I/239)", "Hipparcos, the new reduction (I/311)"), words=r"\bI[/_](239|311)\b|hipparcos",
        mag_mas_per_yr=((9.0, 0.8), (12.0, 1.8)), typical_mas_per_yr=0.9,
    ),
    Survey(
        "Tycho-2", "Høg et al. 2000, A&A 355, L27", "VT", ((9.0, 7.0), (11.5, 60.0)), 60.0,
        ("Tycho-2 (I/259)",), words=r"tycho[ _-]?2|\bI[/_]259\b", typical_mas_per_yr=2.5,
    ),
    Survey(
        "2MASS", "Skrutskie et al. 2006, AJ 131, 1163: of order 100 mas; by J against Gaia DR2 in NGC 188", "J",
        ((8.5, 110.0), (9.5, 75.0), (15.0, 78.0), (15.75, 100.0), (16.25, 200.0), (16.75, 255.0)), 80.0,
        ("2MASS", "2MASS at VizieR (II/246)"), words=r"2MASS|\bII[/_]246\b",
    ),
    Survey(
        # 45 mas against UCAC and 20 to 30 mas common to a region, in quadrature; at r = 22 photon noise only.
        "SDSS", "Pier et al. 2003, AJ 125, 1559, abstract", "r", ((20.0, 51.0), (22.0, 103.0)), 60.0,
        ("SDSS",), words=r"\bSDSS\b|\bV[/_]147\b",
    ),
    Survey(
        # A median distance of 13.5 mas to Gaia is 11.5 mas per axis; 5 mas from the frame; the faint end is assumed.
        "Pan-STARRS1", "Lubow et al. 2021, AJ 161, 6, and Magnier et al. 2020, ApJS 251, 6, abstracts", "r",
        ((19.0, 12.5), (21.5, 60.0)), 30.0,
        ("Pan-STARRS1",), words=r"pan-?starrs|\bII[/_]349\b",
    ),
    Survey(
        # Assumed: the supplement's table was not available.
        "AllWISE", "assumed after Cutri et al. 2013, AllWISE Explanatory Supplement, II.5", "W1",
        ((13.0, 50.0), (17.0, 300.0)), 150.0,
        ("AllWISE", "AllWISE at VizieR (II/328)"), words=r"allwise|\bII[/_]328\b",
    ),
    Survey(
        # 15 to 20 mas from 10 to 14 mag, 15 to 100 mas and 1 to 10 mas/yr in total; UCAC2 has 70 mas at 16 mag, proper
        # motions of 1 to 3 mas/yr up to 12 mag and of 4 to 7 mas/yr up to 16 mag.
        "UCAC4", "Zacharias et al. 2013, AJ 145, 44, and of UCAC2 2004, AJ 127, 3043, abstracts", "f",
        ((10.0, 15.0), (14.0, 20.0), (16.0, 70.0)), 40.0,
        words=r"\bUCAC4\b|\bI[/_]322", mag_mas_per_yr=((12.0, 2.0), (14.0, 4.0), (16.0, 7.0)), typical_mas_per_yr=4.0,
    ),
    Survey("USNO-B1.0", "Monet et al. 2003, AJ 125, 984", "R", ((21.0, 200.0),), 200.0, words=r"USNO-?B1|\bI[/_]284\b"),
)  # fmt: skip


def survey_of(convention: str, epoch_jyr: float | None, texts: list[str]) -> Survey | None:
    """The survey of a table, by the title of its convention and its epoch, or by its texts; None if not known."""
    for survey in SURVEYS:
        least, largest = survey.epochs_jyr
        dated = survey.epochs_jyr[0] == -np.inf or (epoch_jyr is not None and least < epoch_jyr < largest)
        if convention in survey.conventions and dated:
            return survey
    named = [s for s in SURVEYS if s.words and any(re.search(s.words, text, re.IGNORECASE) for text in texts)]
    return named[0] if len({survey.title for survey in named}) == 1 else None


#: Reason of a unit that is not stated in the table.
GUESSED = "guessed by its size"


@dataclass(frozen=True)
class CatalogueOptions:
    """Options for the columns of a catalogue; what is not given is searched for. Names ignore case.

    ra, dec, id, magnitude, parallax, radial_velocity : column names; "none" for the last three ignores them.
    sigma : one standard deviation per axis: a number (in ``sigma_unit``, arcsec if not given), a column, or
        "column east,column north". sigma_unit : arcsec, mas, deg, ...
    ellipse : "a,b,angle": columns of one-sigma semi-axes and of the angle of a, degrees east of north.
    correlation : column of the correlation of east and north.
    epoch : Julian year, ISO date, or column of Julian years, MJD, JD or dates; "none" does without.
    pm : "column,column" of proper motion in right ascension (times cos δ) and declination, or "none".
    pm_sigma_mas_per_yr : error of proper motions where the table has none.
    sigma_floor_arcsec : added in quadrature to the position errors.
    missing_pm_mas_per_yr : standard deviation per axis of the proper motion of objects without a measured one.
    fill_errors : rows whose position error is empty or not positive get the typical error at their magnitude.
    """

    ra: str | None = None
    dec: str | None = None
    id: str | None = None
    sigma: float | str | None = None
    sigma_unit: str | None = None
    ellipse: str | None = None
    correlation: str | None = None
    epoch: float | str | None = None
    pm: str | None = None
    parallax: str | None = None
    radial_velocity: str | None = None
    magnitude: str | None = None
    pm_sigma_mas_per_yr: float | None = None
    sigma_floor_arcsec: float = 0.0
    missing_pm_mas_per_yr: float | None = None
    fill_errors: bool = False


@dataclass(frozen=True)
class ChosenColumn:
    """A column: its name, the unit of its numbers, and the origin of the unit.

    parts : the columns of hours (or sign and degrees), minutes and seconds, if an angle is split over several.
    """

    name: str
    unit: str
    reason: str
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class PositionError:
    """The position error: "circle", "axes", "ellipse", "variances" or their inverses from columns, one
    ``sigma_arcsec`` for all ("number"), that of a survey by magnitude ("survey"), or "unknown", to be estimated.

    reason : origin of a number. survey : source of typical errors. guessed_unit : the unit of the columns is not stated
    and was guessed from the size of the numbers. co_sigma : column of the root of the covariance with its sign.
    angle_from : zero point of the ellipse angle, which increases towards the other axis. containment : probability that
    the position lies within the circle or ellipse; 0 if the sizes are standard deviations. placeholders : numbers
    that stand for missing errors.
    """

    kind: Literal["circle", "axes", "ellipse", "variances", "inverse variances", "number", "survey", "unknown"]
    columns: tuple[ChosenColumn, ...] = ()
    sigma_arcsec: float = np.nan
    correlation: str = ""
    covariance: str = ""
    co_sigma: str = ""
    angle_from: Literal["north", "east"] = "north"
    reason: str = "option"
    survey: Survey | None = None
    guessed_unit: bool = False
    containment: float = 0.0
    placeholders: tuple[float, ...] = ()

    @property
    def divisor(self) -> float:
        """The size of the circle or ellipse in standard deviations: √(−2 ln (1 − containment))."""
        return math.sqrt(-2.0 * math.log1p(-self.containment)) if self.containment else 1.0


@dataclass(frozen=True)
class Epoch:
    """The epoch: a column, one Julian year for all rows, or neither if it is not known.

    otherwise_jyr : that of rows in which the column has none.
    """

    column: str | None = None
    jyr: float | None = None
    otherwise_jyr: float = np.nan
    reason: str = "not known"


@dataclass(frozen=True)
class ColumnChoice:
    """The columns chosen from a table; :meth:`describe` returns them as lines of text.

    motion, motion_errors : parallax, pm ra*, pm dec, radial velocity; None where the table has none.
    correlations : (i, j, column), parameters numbered as in :mod:`sameas.sky.conventions`.
    weights : the 15 columns UW of hip2 followed by F2 and Ntr. notes : further lines for the user.
    frame : of the position and its errors. measured : a column that is empty in rows without a measurement. survey :
    of the table, for errors of motions that it does not state.
    """

    convention: str
    ra: ChosenColumn
    dec: ChosenColumn
    error: PositionError
    epoch: Epoch
    id: str | None = None
    motion: tuple[ChosenColumn | None, ...] = (None,) * 4
    motion_errors: tuple[ChosenColumn | None, ...] = (None,) * 4
    correlations: Correlations = ()
    weights: tuple[str, ...] = ()
    magnitude: str | None = None
    magnitude_error: str | None = None
    notes: tuple[str, ...] = ()
    frame: SkyFrame = "icrs"
    measured: str = ""
    survey: Survey | None = None

    def describe(self, epochs: str = "") -> tuple[str, ...]:
        """Lines to print: the chosen columns with reasons. epochs : text of the epochs read from a column."""
        lines = [f"position: {_listed(self.ra, self.dec)}; names of: {self.convention}", self._error_line()]
        moving = [column for column in self.motion if column]
        if moving:
            known = [column for column in self.motion_errors if column]
            words = f"motion: {_listed(*moving)}; " + (f"errors: {_listed(*known)}" if known else "without errors")
            count = sum(1 for i, j, _ in self.correlations if (i, j) != (0, 1))
            if self.weights:
                words += "; correlations from the weight matrix UW"
            elif count:
                words += f"; {count} correlations"
            lines.append(words)
        else:
            lines.append("motion: none")
        years = epochs if self.epoch.jyr is None else in_years(self.epoch.jyr)
        lines.append(f"epoch: {years} ({self.epoch.reason})" if years else f"epoch: {self.epoch.reason}")
        brightness = self.magnitude or "none"
        lines.append(f"magnitude: {brightness}" + (f" ± {self.magnitude_error}" if self.magnitude_error else ""))
        lines.append(f"id: {self.id or 'row number'}")
        return (*lines, *self.notes)

    def _error_line(self) -> str:
        if self.error.kind == "number":
            return f"errors: {self.error.sigma_arcsec:.3g} arcsec on each axis ({self.error.reason})"
        if self.error.kind == "unknown":
            return "errors: not known, to be estimated from the distances of records"
        if self.error.survey is not None:
            by = f" by {self.magnitude}" if self.magnitude else ""
            return f"errors: those of {self.error.survey.title}{by} ({self.error.survey.source})"
        words = {
            "circle": "on each axis",
            "axes": "east and north",
            "ellipse": f"ellipse, angle {'east of north' if self.error.angle_from == 'north' else 'north of east'}",
            "variances": "variances east and north",
            "inverse variances": "inverse variances east and north",
        }
        shape = words[self.error.kind]
        if self.error.containment:
            shape = "radius" if self.error.kind == "circle" else shape
            shape += f"; contains {100 * self.error.containment:.0f} %: divided by {self.error.divisor:.3f} to get σ"
        line = f"errors: {_listed(*self.error.columns)}, {shape}"
        if self.error.placeholders:
            line += f"; {' and '.join(f'{one:g}' for one in self.error.placeholders)} counts as missing"
        if self.error.correlation:
            line += f", correlation {self.error.correlation}"
        if self.error.co_sigma:
            line += f", co-sigma {self.error.co_sigma}"
        return line + (f", covariance {self.error.covariance}" if self.error.covariance else "")


def in_years(epoch: float) -> str:
    """A Julian year, with as many decimals as it needs and at least one."""
    text = f"{epoch:.4f}".rstrip("0")
    return text + "0" if text.endswith(".") else text


def _listed(*columns: ChosenColumn) -> str:
    """Column names with unit and reason, grouped by both."""
    groups: dict[tuple[str, str], list[str]] = {}
    for column in columns:
        groups.setdefault((column.unit, column.reason), []).append(column.name)
    return ", ".join(f"{', '.join(names)} [{unit}, {reason}]" for (unit, reason), names in groups.items())
