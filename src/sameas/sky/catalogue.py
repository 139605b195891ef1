"""Catalogue: one table of the sky with positions, errors, proper motions, epoch and magnitude in known units.

:meth:`Catalogue.of` finds the columns of a table; :class:`CatalogueOptions` overrides them. Read ``interpretation``
(the chosen columns) and ``doubts`` (what looks wrong) before trusting a result.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from sameas.arrays import FloatArray, median
from sameas.errors import InputError, Message, naming
from sameas.records import Records
from sameas.representation import in_short
from sameas.sky import column_values
from sameas.sky.catalogue_doubts import (
    doubts_of,
    duplicate_doubt,
    filled_note,
    missing_motion_note,
    unmeasured_magnitude_note,
)
from sameas.sky.column_choice import CatalogueOptions, ColumnChoice, Epoch, PositionError, in_years
from sameas.sky.column_search import ColumnSearch
from sameas.sky.columns import choose
from sameas.sky.motion import Astrometry, Variances, position_at
from sameas.sky.table_astrometry import epochs_jyr, table_astrometry
from sameas.space import Sphere

__all__ = ["Catalogue", "CatalogueOptions"]


@in_short
@dataclass(frozen=True)
class Catalogue:
    """One source on the sky. Make it with :meth:`Catalogue.of`.

    Attributes
    ----------
    name : used in messages.
    table : the user's table, (n,) rows.
    ids : (n,) identifiers, unique.
    astrometry : (n,) positions, motions and errors; NaN where the position or its error is missing, and in
        ``epoch_jyr`` where the epoch is not known.
    options : given by the user. choice : the chosen columns. interpretation : the same as lines to print.
    doubts : what looks wrong. duplicates : the one about rows that repeat others, or "".
    has_motion : whether any row has a proper motion.
    magnitude, magnitude_error : (n,), NaN where not measured, or None. magnitude_name : the column.
    """

    name: str
    table: Table
    ids: NDArray[Any]
    astrometry: Astrometry
    choice: ColumnChoice
    interpretation: tuple[str, ...]
    doubts: tuple[str, ...]
    has_motion: bool
    options: CatalogueOptions = field(default_factory=CatalogueOptions)
    magnitude: FloatArray | None = None
    magnitude_error: FloatArray | None = None
    duplicates: str = ""

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def named_doubts(self) -> tuple[Message, ...]:
        """The doubts, each with the catalogue's name before it."""
        return tuple(Message(f"{self.name}: ", doubt) for doubt in self.doubts)

    @property
    def magnitude_name(self) -> str | None:
        """The column of the magnitude."""
        return self.choice.magnitude

    @cached_property
    def epoch_jyr(self) -> float | None:
        """The median epoch of the rows, None if no epoch is known."""
        known = self.astrometry.epoch_jyr[np.isfinite(self.astrometry.epoch_jyr)]
        return median(known) if len(known) else None

    @classmethod
    def of(cls, table: Any, name: str, *, options: CatalogueOptions | None = None) -> Catalogue:
        """The catalogue of a table.

        table : astropy Table or QTable, dict of arrays, pyarrow Table or pandas DataFrame.
        name : of the source, for messages. options : columns and values given by the user.

        Raises
        ------
        InputError : an empty table, missing or ambiguous columns (reported together), numbers impossible in
            their unit.

        Example
        -------
        >>> stars = Catalogue.of({"ra": [10.0], "dec": [20.0]}, "stars", options=CatalogueOptions(sigma=0.1))
        >>> stars.records().covariance.round(4)
        array([[0.01]])
        """
        options = CatalogueOptions() if options is None else options
        rows = column_values.as_table(table, name)
        if len(rows) == 0:
            raise InputError(f"{name}: the table has no rows")
        return cls._of_choice(rows, choose(rows, options, name), options, name)

    @classmethod
    def _of_choice(cls, rows: Table, choice: ColumnChoice, options: CatalogueOptions, name: str) -> Catalogue:
        """The catalogue of a table with chosen columns."""
        magnitude = _brightness(rows, choice.magnitude, name)
        astrometry, filled_arcsec, unmoved = table_astrometry(rows, choice, options, magnitude, name)
        has_motion = bool(unmoved) and not bool(unmoved[0].all())
        if has_motion:
            choice = replace(choice, notes=(*choice.notes, *missing_motion_note(np.logical_or(*unmoved), options)))
        epoch_doubt = ""
        if has_motion and not np.isfinite(astrometry.epoch_jyr).any():
            choice, epoch_doubt = _with_assumed_epoch(choice)
            astrometry = replace(astrometry, epoch_jyr=epochs_jyr(rows, choice, name))
        ids, id_note = _ids(rows, choice, options, name)
        interpretation = choice.describe(_epoch_range(astrometry.epoch_jyr))
        if not has_motion and not np.isfinite(astrometry.epoch_jyr).any():
            interpretation = (*interpretation, "without epoch and motion: used as it is; it cannot be moved")
        duplicates = duplicate_doubt(rows, astrometry)
        doubts = (
            epoch_doubt, filled_note(filled_arcsec, choice),
            *doubts_of(rows, astrometry, choice, options, duplicates, name),
        )  # fmt: skip
        return cls(
            name=name,
            table=rows,
            ids=ids,
            astrometry=astrometry,
            choice=choice,
            interpretation=interpretation + id_note + unmeasured_magnitude_note(rows, choice, name),
            doubts=tuple(doubt for doubt in doubts if doubt),
            duplicates=duplicates,
            has_motion=has_motion,
            options=options,
            magnitude=magnitude,
            magnitude_error=_brightness(rows, choice.magnitude_error, name),
        )

    def with_rows(self, table: Any) -> Catalogue:
        """Other rows of the same source with the same columns and options, without doubts; may be empty."""
        rows = column_values.as_table(table, self.name)
        magnitude = _brightness(rows, self.choice.magnitude, self.name)
        astrometry, *_ = table_astrometry(rows, self.choice, self.options, magnitude, self.name)
        ids, _ = _ids(rows, self.choice, self.options, self.name)
        return replace(
            self, table=rows, ids=ids, astrometry=astrometry, doubts=(), magnitude=magnitude,
            magnitude_error=_brightness(rows, self.choice.magnitude_error, self.name),
        )  # fmt: skip

    def column_named(self, name: str) -> str | None:
        """The column of this name: exact, else ignoring case; None without one."""
        return ColumnSearch(self.table, self.options, self.name).find(name.strip())

    @property
    def error_is_unknown(self) -> bool:
        """Whether no position errors are known."""
        return self.choice.error.kind == "unknown"

    def with_error(self, error: PositionError) -> Catalogue:
        """The same catalogue with other position errors."""
        return Catalogue._of_choice(self.table, replace(self.choice, error=error), self.options, self.name)

    def with_epoch(self, epoch_jyr: float) -> Catalogue:
        """The same catalogue with one epoch assumed for all rows."""
        epoch = Epoch(jyr=epoch_jyr, reason="assumed")
        return Catalogue._of_choice(self.table, replace(self.choice, epoch=epoch), self.options, self.name)

    def records(self, epoch_jyr: float | None = None) -> Records:
        """The catalogue's records at an epoch, with covariances of east and north in arcsec².

        epoch_jyr : Julian year to which every row is moved; None keeps the observed positions.
        Rows without a position or a positive error are set aside.

        Raises
        ------
        InputError : an epoch is given but the catalogue's epoch is not known; no position errors are known.
        """
        if self.error_is_unknown:
            others = [note for note in self.choice.notes if isinstance(note, Message) and _is_of_errors(note)]
            raise InputError(
                Message(
                    f"{self.name}: no column of position errors ({self.choice.convention})",
                    *(part for note in others for part in ("; ", note)),
                ),
                naming("give {sigma:ARCSEC}, {sigma:COLUMN} or {ellipse:'A,B,ANGLE'}"),
                source=self.name,
            )
        a = self.astrometry
        if epoch_jyr is None:
            return self._records(a.ra_deg, a.dec_deg, _position_errors(a))
        # A part of a catalogue may have no row with an epoch, or none at all.
        if self.epoch_jyr is None and self.choice.epoch.column is None:
            raise InputError(
                f"{self.name}: its epoch is not known, so it cannot be moved to {epoch_jyr:g}",
                naming("give {epoch:YEAR}"),
                source=self.name,
            )
        known = np.isfinite(a.epoch_jyr)
        with_epoch_known = a if known.all() else replace(a, epoch_jyr=np.where(known, a.epoch_jyr, epoch_jyr))
        ra, dec, covariance = position_at(with_epoch_known, epoch_jyr)
        return self._records(np.where(known, ra, np.nan), dec, covariance)

    def _records(self, ra_deg: FloatArray, dec_deg: FloatArray, position_errors: FloatArray) -> Records:
        """Records at these positions. position_errors : (n, 2) variances or (n, 2, 2) covariances, arcsec²."""
        if position_errors.ndim == 3 and not position_errors[:, 0, 1].any():
            position_errors = np.einsum("nvv->nv", position_errors)
        if position_errors.ndim == 2 and np.array_equal(position_errors[:, 0], position_errors[:, 1]):
            position_errors = position_errors[:, :1]
        return Records.of(
            np.column_stack([ra_deg, dec_deg]),
            variance=position_errors if position_errors.ndim == 2 else None,
            covariance=position_errors if position_errors.ndim == 3 else None,
            ids=self.ids,
            space=Sphere(),
            source=self.name,
            table=self.table,
            invalid="set aside",
        )


def _is_of_errors(note: Message) -> bool:
    """Whether a note names the argument for columns of position errors."""
    return any(argument.name in ("sigma", "ellipse") for argument in note.arguments)


def _position_errors(astrometry: Astrometry) -> FloatArray:
    """(n, 2) variances or (n, 2, 2) covariances of the positions, arcsec²."""
    packed = astrometry.packed
    return 1e-6 * (packed.stacked(2) if isinstance(packed, Variances) else packed[:, :2, :2])


def _with_assumed_epoch(choice: ColumnChoice) -> tuple[ColumnChoice, str]:
    """The choice with the usual epoch for proper motions without one, and the doubt that reports it."""
    gaia = choice.convention.startswith("Gaia")
    year = 2016.0 if gaia else 2000.0
    hint = " (Gaia DR1 2015.0, DR2 2015.5, DR3 2016.0)" if gaia else ""
    doubt = Message(
        f"its epoch is not stated: {in_years(year)} was assumed; ",
        naming(f"give {{epoch:YEAR}}{hint}, or {{pm:'none'}}"),
    )
    return replace(choice, epoch=Epoch(jyr=year, reason="assumed")), doubt


def _epoch_range(epochs: FloatArray) -> str:
    known = epochs[np.isfinite(epochs)]
    if not len(known):
        return ""
    first, last = known.min(), known.max()
    return in_years(float(first)) if first == last else f"{first:.2f} to {last:.2f}"


def _ids(
    table: Table, choice: ColumnChoice, options: CatalogueOptions, source: str
) -> tuple[NDArray[Any], tuple[str, ...]]:
    """(n,) identifiers, and a note if the id column cannot be used."""
    if choice.id is None:
        return np.arange(len(table)), ()
    column = table[choice.id]
    if np.ma.getmaskarray(column).any() if hasattr(column, "mask") else False:
        return np.arange(len(table)), (f"id: {choice.id} has empty cells, so rows are numbered",)
    ids = np.asarray(column)
    if ids.ndim > 1 or any(isinstance(one, np.ndarray | list) for one in (ids if ids.dtype.kind == "O" else ())):
        if options.id:
            raise InputError(
                f"{source}: column {choice.id!r} has several values in a cell; give a column of single ids"
            )
        return np.arange(len(table)), (f"id: {choice.id} has several values in a cell, so rows are numbered",)
    if not options.id and _repeats(ids):
        return np.arange(len(table)), (f"id: {choice.id} is not unique, so rows are numbered",)
    return ids, ()


def _brightness(table: Table, name: str | None, source: str) -> FloatArray | None:
    """(n,) magnitudes, NaN where not measured."""
    if name is None:
        return None
    return column_values.magnitudes(table, name, source)


def _repeats(ids: NDArray[Any]) -> bool:
    """Whether an identifier occurs twice."""
    if ids.dtype.kind in "iu" and np.all(ids[1:] > ids[:-1]):
        return False
    ordered = np.sort(ids.astype(str) if ids.dtype.kind == "O" else ids)
    return bool(np.any(ordered[1:] == ordered[:-1]))
