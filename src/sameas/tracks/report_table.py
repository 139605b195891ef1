"""The table of a live source: its reports, each in a row of its own as long as it may be current.

Rows are used again: those of dropped reports (:meth:`ReportTable.clear`) are free for new ones after
:meth:`ReportTable.release`, and :meth:`ReportTable.shrink` gives back those that a flood of reports has left empty.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, taken
from sameas.tracks.alignment import NO_TREND, States
from sameas.tracks.placement import Directions
from sameas.tracks.stationary import FILTERED, SLOW

#: Columns by group: name, shape of an element, value of an empty row. All tables have REPORTS; few sources need
#: heights, filtered tracks and modes of motion, which are most of a row.
REPORTS, HEIGHTS, FILTER, MODES = "reports", "heights", "filter", "modes"
_COLUMNS: dict[str, tuple[tuple[str, tuple[int, ...], ArrayLike], ...]] = {
    REPORTS: (
        ("time_s", (), -math.inf), ("measured", (4,), math.nan), ("measured_covariance", (4, 4), math.nan),
        ("sensor_m", (2,), math.nan), ("late_s", (), -math.inf),
    ),
    HEIGHTS: (("heights", (4,), math.nan),),
    FILTER: (
        ("filtered", (4,), math.nan), ("filtered_covariance", (4, 4), math.nan), ("state", (4,), math.nan),
        ("covariance", (4, 4), math.nan), ("trend", (4,), NO_TREND),
    ),
    MODES: (
        ("p_slow", (SLOW,), 0.0), ("modes", (FILTERED,), math.nan), ("modes_mean", (FILTERED, 4), math.nan),
        ("modes_covariance", (FILTERED, 4, 4), math.nan),
    ),
}  # fmt: skip
#: Columns of which a feed shows all rows, also empty ones.
_VISIBLE = frozenset(
    {"time_s", "measured", "measured_covariance", "sensor_m", "heights", "state", "covariance", "p_slow"}
)


class ReportTable:
    """A table of reports; groups : of its columns. taken : (n,) whether a row is in use."""

    time_s: FloatArray
    measured: FloatArray
    measured_covariance: FloatArray
    sensor_m: FloatArray
    late_s: FloatArray
    heights: FloatArray
    filtered: FloatArray
    filtered_covariance: FloatArray
    state: FloatArray
    covariance: FloatArray
    trend: FloatArray
    p_slow: FloatArray
    modes: FloatArray
    modes_mean: FloatArray
    modes_covariance: FloatArray

    def __init__(self, n: int, groups: tuple[str, ...] = (REPORTS,)) -> None:
        self.groups = groups
        for name, shape, empty in self._filled:
            setattr(self, name, np.full((n, *shape), empty, np.float64))
        self.taken = np.zeros(n, bool)
        self.number = np.full(n, ABSENT)
        self.serial = np.full(n, ABSENT)
        self.name: NDArray[Any] = np.full(n, "", object)
        self.attributes: dict[str, NDArray[Any]] = {}
        self._free, self._cleared = np.empty(0, np.int64), np.empty(0, np.int64)

    def __len__(self) -> int:
        return len(self.taken)

    @classmethod
    def of(
        cls, in_plane: States | Directions, usable: IntArray, sensor_m: FloatArray | None,
        attributes: Mapping[str, NDArray[Any]],
    ) -> ReportTable:  # fmt: skip
        """The usable reports; of directions, bearing and 1σ are the first columns of the state."""
        rows = cls(len(usable))
        if isinstance(in_plane, Directions):
            rows.measured[:, 0], rows.measured[:, 1] = in_plane.bearing_deg[usable], in_plane.sigma_deg[usable]
        else:
            rows.measured, rows.measured_covariance = taken(in_plane.state, usable), taken(in_plane.covariance, usable)
        rows.time_s, rows.taken = in_plane.time_s[usable], np.ones(len(usable), bool)
        if sensor_m is not None:
            rows.sensor_m = np.asarray(sensor_m)[usable]
        rows.attributes = {name: column[usable] for name, column in attributes.items()}
        return rows

    def add_groups(self, *groups: str) -> None:
        """Adds the columns that it has not yet, empty; filtered tracks as measured."""
        for group in groups:
            if group in self.groups:
                continue
            self.groups = (*self.groups, group)
            for name, shape, empty in _COLUMNS[group]:
                setattr(self, name, np.full((len(self), *shape), empty, np.float64))
            if group == FILTER:
                self.filtered[:], self.filtered_covariance[:] = self.measured, self.measured_covariance
                self.state[:], self.covariance[:] = self.measured, self.measured_covariance

    @property
    def tracks(self) -> tuple[FloatArray, FloatArray]:
        """(n, 4), (n, 4, 4) the states of the reports and their covariances: filtered, or as measured."""
        if FILTER in self.groups:
            return self.state, self.covariance
        return self.measured, self.measured_covariance

    @property
    def _filled(self) -> tuple[tuple[str, tuple[int, ...], ArrayLike], ...]:
        return tuple(column for group in self.groups for column in _COLUMNS[group])

    @property
    def _columns(self) -> tuple[str, ...]:
        return (*(name for name, _, _ in self._filled), "taken", "number", "serial", "name")

    def only(self, which: BoolArray) -> ReportTable:
        """The rows of a mask; self where that is all of them."""
        if which.all():
            return self
        out = ReportTable(0, self.groups)
        for name in self._columns:
            setattr(out, name, getattr(self, name)[which])
        out.attributes = {name: column[which] for name, column in self.attributes.items()}
        return out

    def add(self, new: ReportTable) -> IntArray:
        """(len(new),) the free rows that the rows ``new`` are written to; the table grows if there are too few."""
        if len(self._free) < len(new):
            self._grow(max(64, len(new) - len(self._free), len(self)))
        places, self._free = self._free[: len(new)], self._free[len(new) :]
        self._put(places, new)
        return places

    def _grow(self, n: int) -> None:
        """Adds ``n`` empty rows."""
        more = ReportTable(n, self.groups)
        self._free = np.concatenate([self._free, len(self) + np.arange(n)])
        for name, column in self.attributes.items():
            empty = np.full(n, None, object) if column.dtype == object else np.full(n, np.nan)
            self.attributes[name] = np.concatenate([column, empty])
        for name in self._columns:
            setattr(self, name, np.concatenate([getattr(self, name), getattr(more, name)]))

    def _put(self, places: IntArray, new: ReportTable) -> None:
        """Writes the rows ``new`` to these rows of the table."""
        self.add_groups(*new.groups)
        new.add_groups(*self.groups)
        for name in self._columns:
            getattr(self, name)[places] = getattr(new, name)
        for name in new.attributes.keys() - self.attributes.keys():
            kind = new.attributes[name].dtype
            self.attributes[name] = np.full(len(self), np.nan if kind.kind == "f" else None, kind)
        for name, column in self.attributes.items():
            column[places] = new.attributes.get(name, None if column.dtype == object else np.nan)

    def clear(self, places: IntArray) -> None:
        """Empties these rows."""
        for name, _, empty in self._filled:
            if name in _VISIBLE:
                getattr(self, name)[places] = empty
        self.taken[places], self.number[places], self.serial[places], self.name[places] = False, ABSENT, ABSENT, ""
        for column in self.attributes.values():
            column[places] = None if column.dtype == object else np.nan
        self._cleared = np.concatenate([self._cleared, places])

    def release(self) -> None:
        """Frees the rows that were emptied."""
        self._free, self._cleared = np.concatenate([self._free, self._cleared]), np.empty(0, np.int64)

    @property
    def n_held(self) -> int:
        """Number of rows that are not free."""
        return len(self) - len(self._free)

    def use_lowest(self) -> None:
        """New reports take the lowest free rows, so that those at the end become empty."""
        self._free = np.sort(self._free)

    def shrink(self, n: int) -> IntArray:
        """Cuts the table to its first ``n`` rows, at least those held; the reports beyond move to the lowest free rows.

        Returns (n,) the new row of each of the present ones that is in use.
        """
        self.use_lowest()
        place = np.arange(len(self))
        stays, moves = place < n, self.taken & (place >= n)
        n_moved = np.count_nonzero(moves)
        place[moves], free = self._free[:n_moved], self._free[n_moved:]
        self._put(place[moves], self.only(moves))
        kept = self.only(stays)
        for name in (*self._columns, "attributes"):
            setattr(self, name, getattr(kept, name))
        self._free = free[free < n]
        return place
