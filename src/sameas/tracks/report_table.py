"""The table of a live source: its reports, each in a row of its own as long as it may be current."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, taken
from sameas.tracks.alignment import NO_TREND, States
from sameas.tracks.placement import Directions
from sameas.tracks.stationary import FILTERED, SLOW

#: Columns that a feed needs.
_VISIBLE = ("time_s", "state", "covariance", "p_slow", "sensor_m", "heights", "name")


class ReportTable:
    """A table of reports; taken : (n,) whether a row is in use.

    The modes of motion, more than half of a row, are in it from :meth:`with_modes` on; before, they have length 0.
    """

    ARRAYS: tuple[tuple[str, tuple[int, ...], ArrayLike], ...] = (
        ("time_s", (), -math.inf), ("measured", (4,), math.nan), ("measured_covariance", (4, 4), math.nan),
        ("filtered", (4,), math.nan), ("filtered_covariance", (4, 4), math.nan), ("state", (4,), math.nan),
        ("covariance", (4, 4), math.nan), ("p_slow", (SLOW,), 0.0), ("sensor_m", (2,), math.nan),
        ("heights", (4,), math.nan), ("late_s", (), -math.inf), ("trend", (4,), NO_TREND),
    )  # fmt: skip
    MODES: tuple[tuple[str, tuple[int, ...]], ...] = (
        ("modes", (FILTERED,)), ("modes_mean", (FILTERED, 4)), ("modes_covariance", (FILTERED, 4, 4)),
    )  # fmt: skip
    time_s: FloatArray
    measured: FloatArray
    measured_covariance: FloatArray
    filtered: FloatArray
    filtered_covariance: FloatArray
    state: FloatArray
    covariance: FloatArray
    p_slow: FloatArray
    modes: FloatArray
    modes_mean: FloatArray
    modes_covariance: FloatArray
    sensor_m: FloatArray
    heights: FloatArray
    late_s: FloatArray
    trend: FloatArray

    def __init__(self, n: int) -> None:
        for name, shape, empty in self.ARRAYS:
            setattr(self, name, np.full((n, *shape), empty, np.float64))
        for name, shape in self.MODES:
            setattr(self, name, np.empty((0, *shape)))
        self.taken = np.zeros(n, bool)
        self.number = np.full(n, ABSENT)
        self.serial = np.full(n, ABSENT)
        self.name: NDArray[Any] = np.full(n, "", object)
        self.attributes: dict[str, NDArray[Any]] = {}

    def __len__(self) -> int:
        return len(self.taken)

    @classmethod
    def of_states(
        cls, in_plane: States, usable: IntArray, sensor_m: FloatArray | None, attributes: dict[str, NDArray[Any]]
    ) -> ReportTable:
        rows = cls(len(usable))
        for column in ("measured", "filtered", "state"):
            setattr(rows, column, taken(in_plane.state, usable))
        for column in ("measured_covariance", "filtered_covariance", "covariance"):
            setattr(rows, column, taken(in_plane.covariance, usable))
        return rows._with(in_plane.time_s[usable], usable, sensor_m, attributes)

    @classmethod
    def of_directions(
        cls, in_plane: Directions, usable: IntArray, sensor_m: FloatArray | None, attributes: dict[str, NDArray[Any]]
    ) -> ReportTable:
        rows = cls(len(usable))
        rows.measured[:, 0], rows.measured[:, 1] = in_plane.bearing_deg[usable], in_plane.sigma_deg[usable]
        return rows._with(in_plane.time_s[usable], usable, sensor_m, attributes)

    def _with(
        self, time_s: FloatArray, usable: IntArray, sensor_m: FloatArray | None, attributes: dict[str, NDArray[Any]]
    ) -> ReportTable:
        self.time_s, self.taken = time_s.copy(), np.ones(len(usable), bool)
        if sensor_m is not None:
            self.sensor_m = np.asarray(sensor_m)[usable]
        self.attributes = {name: column[usable] for name, column in attributes.items()}
        return self

    def with_modes(self) -> None:
        """Adds the modes of motion if it has none, not-a-number as they are not known."""
        if len(self.modes) < len(self):
            for name, shape in self.MODES:
                setattr(self, name, np.full((len(self), *shape), math.nan))

    @property
    def _has_modes(self) -> bool:
        return len(self.modes) > 0

    @property
    def _columns(self) -> tuple[str, ...]:
        modes = [name for name, _ in self.MODES] if self._has_modes else []
        return (*(name for name, _, _ in self.ARRAYS), *modes, "taken", "number", "serial", "name")

    def only(self, which: BoolArray) -> ReportTable:
        """The rows of a mask; self where that is all of them."""
        if which.all():
            return self
        out = ReportTable(0)
        for name in self._columns:
            setattr(out, name, getattr(self, name)[which])
        out.attributes = {name: column[which] for name, column in self.attributes.items()}
        return out

    def visible(self, also: tuple[str, ...]) -> ReportTable:
        """Copies of the columns that a feed needs, and of the columns ``also``: later reports must not change them."""
        out = ReportTable(0)
        for name in (*_VISIBLE, *also):
            setattr(out, name, getattr(self, name).copy())
        # No copies: feeds do not keep these.
        out.taken, out.number, out.serial = self.taken, self.number, self.serial
        out.attributes = {name: column.copy() for name, column in self.attributes.items()}
        return out

    def grown(self, n: int) -> ReportTable:
        """The table with ``n`` more empty rows."""
        more, out = ReportTable(n), ReportTable(0)
        if self._has_modes:
            more.with_modes()
        for name in self._columns:
            setattr(out, name, np.concatenate([getattr(self, name), getattr(more, name)]))
        none = np.full(n, None, object)
        for name, column in self.attributes.items():
            empty = none if column.dtype == object else np.full(n, np.nan)
            out.attributes[name] = np.concatenate([column, empty])
        return out

    def put(self, places: IntArray, new: ReportTable) -> None:
        """Writes the rows ``new`` to these rows of the table."""
        if self._has_modes:
            new.with_modes()
        for name in self._columns:
            getattr(self, name)[places] = getattr(new, name)
        for name in new.attributes.keys() - self.attributes.keys():
            kind = new.attributes[name].dtype
            self.attributes[name] = np.full(len(self), np.nan if kind.kind == "f" else None, kind)
        for name, column in self.attributes.items():
            column[places] = new.attributes.get(name, None if column.dtype == object else np.nan)

    def clear(self, places: IntArray) -> None:
        """Empties these rows."""
        for name, _, empty in self.ARRAYS:
            if name in (*_VISIBLE, "measured"):
                getattr(self, name)[places] = empty
        self.taken[places], self.number[places], self.serial[places], self.name[places] = False, ABSENT, ABSENT, ""
        for column in self.attributes.values():
            column[places] = None if column.dtype == object else np.nan
