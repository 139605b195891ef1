"""The choice of a catalogue's columns: what a user gives, and what was chosen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sameas.sky.conventions import Correlations, SkyFrame
from sameas.sky.surveys import Survey

#: Why a unit is taken that nothing says.
GUESSED = "guessed by its size"


@dataclass(frozen=True)
class CatalogueOptions:
    """What the user gives of a catalogue; everything else is looked for. Columns are named in any case.

    ra, dec, id, magnitude, parallax, radial_velocity : column names; "none" for the last three ignores them.
    sigma : one standard deviation per axis: a number (in ``sigma_unit``, arcsec if not given), a column, or
        "column east,column north". sigma_unit : arcsec, mas, deg, ...
    ellipse : "a,b,angle": columns of one-sigma semi-axes and of the angle of a, degrees east of north.
    correlation : column of the correlation of east and north.
    epoch : Julian year, ISO date, or column of Julian years, MJD, JD or dates.
    pm : "column,column" of proper motion in right ascension (times cos δ) and declination, or "none".
    pm_sigma_mas_per_yr : error of proper motions where the table has none.
    sigma_floor_arcsec : added in quadrature to the position errors.
    missing_pm_mas_per_yr : how fast an object of unknown proper motion may move, one sigma per axis.
    fill_errors : rows whose position error is empty or not positive get the typical one of their magnitude.
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
class Column:
    """A column in its role: its name, the unit of its numbers, and where we have the unit from.

    parts : the columns of hours (or sign and degrees), minutes and seconds, where one angle is spread over several.
    """

    name: str
    unit: str
    reason: str
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class PositionError:
    """The position error: "circle", "axes", "ellipse" or "variances" from columns, one ``sigma_arcsec`` for all
    ("number"), that of a survey by magnitude ("survey"), or "unknown", to be estimated.

    reason : where a number is from. survey : whose errors are taken. guessed_unit : the unit of the columns is said
    nowhere, and taken from the size of the numbers.

    angle_from : where the angle of an ellipse is counted from, towards the other one.
    """

    kind: Literal["circle", "axes", "ellipse", "variances", "number", "survey", "unknown"]
    columns: tuple[Column, ...] = ()
    sigma_arcsec: float = np.nan
    correlation: str = ""
    covariance: str = ""
    angle_from: Literal["north", "east"] = "north"
    reason: str = "option"
    survey: Survey | None = None
    guessed_unit: bool = False


@dataclass(frozen=True)
class Epoch:
    """The epoch: a column, or one Julian year for all, or neither where it is not known."""

    column: str | None = None
    jyr: float | None = None
    reason: str = "not known"


@dataclass(frozen=True)
class ColumnChoice:
    """What was understood of a table's columns; :meth:`describe` says it in words.

    motion, motion_errors : parallax, pm ra*, pm dec, radial velocity; None where the table has none.
    correlations : (i, j, column), parameters numbered as in :mod:`sameas.sky.conventions`.
    weights : the 15 columns UW of hip2 followed by F2 and Ntr. notes : what else should be known.
    frame : of the position and of its errors. measured : a column that is empty in rows that are no measurements.
    """

    convention: str
    ra: Column
    dec: Column
    error: PositionError
    epoch: Epoch
    id: str | None = None
    motion: tuple[Column | None, ...] = (None,) * 4
    motion_errors: tuple[Column | None, ...] = (None,) * 4
    correlations: Correlations = ()
    weights: tuple[str, ...] = ()
    magnitude: str | None = None
    magnitude_error: str | None = None
    notes: tuple[str, ...] = ()
    frame: SkyFrame = "icrs"
    measured: str = ""

    def describe(self, epochs: str = "") -> tuple[str, ...]:
        """Lines to be printed: what was taken for what, and why; ``epochs`` as read from the column."""
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
            return "errors: not known, to be estimated from the distances to another catalogue"
        if self.error.survey is not None:
            by = f" by {self.magnitude}" if self.magnitude else ""
            return f"errors: those of {self.error.survey.title}{by} ({self.error.survey.source})"
        words = {
            "circle": "on each axis",
            "axes": "east and north",
            "ellipse": f"ellipse, angle {'east of north' if self.error.angle_from == 'north' else 'north of east'}",
            "variances": "variances east and north",
        }
        line = f"errors: {_listed(*self.error.columns)}, {words[self.error.kind]}"
        if self.error.correlation:
            line += f", correlation {self.error.correlation}"
        return line + (f", covariance {self.error.covariance}" if self.error.covariance else "")


def in_years(epoch: float) -> str:
    """A Julian year, with as many decimals as it needs and at least one."""
    text = f"{epoch:.4f}".rstrip("0")
    return text + "0" if text.endswith(".") else text


def _listed(*columns: Column) -> str:
    """Names with their units, those of one unit and one reason together."""
    groups: dict[tuple[str, str], list[str]] = {}
    for column in columns:
        groups.setdefault((column.unit, column.reason), []).append(column.name)
    return ", ".join(f"{', '.join(names)} [{unit}, {reason}]" for (unit, reason), names in groups.items())
