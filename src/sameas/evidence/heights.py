"""Heights as evidence: two aircraft at one position are different if their heights or vertical speeds differ.

The likelihood ratio of heights h₁, h₂ with 1σ errors σ₁, σ₂ is

    r = (1 − w) N(h₁ − h₂; 0, σ₁² + σ₂²) / √(p(h₁) p(h₂)) + w,

with p the density of the heights of the other objects, and w the probability that one of the two is an outlier: a
garbled code, another object's reply. Heights of different kinds (pressure, geometric) must be converted to one before.

That of vertical speeds is the same with their density, 1σ errors and w. Most aircraft are level, so equal speeds of 0
are weak evidence; an aircraft that climbs is distinguished from one that descends through its height.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.errors import InputError
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.records import Records
from sameas.representation import in_short

#: Prior span of heights and of vertical speeds, and number of objects that the prior counts as (chosen).
USUAL_M, USUAL_M_PER_S, USUAL_WEIGHT = 13_000.0, 30.0, 10.0
BANDWIDTH_M, BANDWIDTH_M_PER_S = 150.0, 2.0  # 1σ of the smoothing of known values to their density
#: A normal at −4 … 4 standard deviations, of sum 1.
SMOOTHING = np.exp(-0.5 * np.arange(-4.0, 5.0) ** 2)
SMOOTHING /= SMOOTHING.sum()


@dataclass(frozen=True)
class _Quantity:
    """One quantity of all sources: by source name (n_table, 2) value and its 1σ, NaN if unknown.

    wrong : probability that one of two values is an outlier. usual : prior span. bandwidth : 1σ of the smoothing.
    """

    word: str
    unit: str
    values: Mapping[str, FloatArray]
    wrong: float
    usual: float
    bandwidth: float

    def checked(self) -> None:
        """Raise InputError for values of the wrong shape or without an error."""
        for source, values in self.values.items():
            table = np.asarray(values, dtype=np.float64)
            if table.ndim != 2 or table.shape[1] != 2:
                raise InputError(
                    f"{source}: {self.word}s have the shape {table.shape}; give (n, 2): {self.word} and its error"
                )
            known = np.isfinite(table[:, 0])
            if np.any(~(table[known, 1] > 0.0)):
                row = np.flatnonzero(known)[np.argmin(table[known, 1] > 0.0)]
                raise InputError(
                    f"{source}: row {row}: the {self.word}'s error is {table[row, 1]}; give {self.unit} above 0"
                )

    def log_ratio(self, pairs: Pairs) -> FloatArray:
        """(pairs,) ln r; 0 if one of the two is unknown."""
        one, two = self._of(pairs.first), self._of(pairs.second)
        out = np.zeros(len(pairs))
        if one is None or two is None:
            return out
        (h, s), (k, t) = one[pairs.first.rows[pairs.i]].T, two[pairs.second.rows[pairs.j]].T
        both: BoolArray = np.isfinite(h) & np.isfinite(k)
        if not both.any():
            return out
        h, s, k, t = h[both], s[both], k[both], t[both]
        variance = s**2 + t**2
        same = -0.5 * ((h - k) ** 2 / variance + np.log(2.0 * np.pi * variance))
        other = 0.5 * (self._log_density(h) + self._log_density(k))
        out[both] = np.logaddexp(math.log1p(-self.wrong) + same - other, math.log(self.wrong))
        return out

    def _of(self, records: Records) -> FloatArray | None:
        values = self.values.get(records.source)
        if values is None:
            return None
        table = np.asarray(values, dtype=np.float64)
        if len(table) != records.n_table:
            raise InputError(
                f"{records.source}: {len(table)} {self.word}s for {records.n_table} rows; give one for every row"
            )
        return table

    @cached_property
    def _known(self) -> FloatArray:
        """(n,) all known values, ascending."""
        every = [np.asarray(values, dtype=np.float64)[:, 0] for values in self.values.values()]
        known = np.concatenate([np.empty(0), *every])
        return np.sort(known[np.isfinite(known)])

    @cached_property
    def _number_density(self) -> tuple[FloatArray, FloatArray]:
        """(g,), (g,) places near the known values, ascending, and the smoothed number of these per unit there."""
        known, width = self._known, self.bandwidth
        bins, counts = np.unique(np.rint((known - known[0]) / width), return_counts=True)
        # Without the places between, where there is nothing: one fill value would make a grid without end.
        near = np.unique(bins[:, None] + np.arange(-5, 6))
        number = np.zeros(len(near))
        number[np.searchsorted(near, bins)] = counts
        return near * width + known[0], np.convolve(number, SMOOTHING, mode="same") / width

    def _log_density(self, value: FloatArray) -> FloatArray:
        """(m,) ln p of values, one of each source being those of the pair itself."""
        own = 2.0 * SMOOTHING.max() / self.bandwidth
        others = np.maximum(np.interp(value, *self._number_density) - own, 0.0)
        total = max(len(self._known) - 2.0, 0.0) + USUAL_WEIGHT
        return np.asarray(np.log((others + USUAL_WEIGHT / self.usual) / total))


@in_short
@dataclass(frozen=True)
class Heights(Rule):
    """The heights and vertical speeds of the records, in addition to their positions.

    heights : by the source's name, (n_table, 2) height and its 1σ error of every row of its table, metres; NaN where a
        record has none. All are of one kind.
    climbs : the same of vertical speeds, m/s upwards; sources without any may be left out.
    wrong, wrong_climb : probability that one of two heights is an outlier, and one of two vertical speeds: trackers
        follow a change late (chosen).

    >>> from sameas import Radius, Records
    >>> radar = Records.of([[0.0, 0.0]], sigma=50.0, source="radar")
    >>> adsb = Records.of([[10.0, 0.0], [0.0, 10.0], [5.0, 5.0]], sigma=50.0, source="adsb")
    >>> heights = Heights({"radar": [[10_000.0, 20.0]], "adsb": [[10_010.0, 20.0], [3_000.0, 20.0], [np.nan, np.nan]]})
    >>> pairs = Radius(99.0)(radar, adsb)
    >>> dict(sorted(zip(pairs.j.tolist(), heights(pairs).log_ratio.round(1).tolist())))
    {0: 5.2, 1: -4.6, 2: 0.0}
    """

    heights: Mapping[str, FloatArray] = field(repr=False)
    climbs: Mapping[str, FloatArray] = field(default_factory=dict, repr=False)
    wrong: float = 0.01
    wrong_climb: float = 0.05

    def __post_init__(self) -> None:
        self._height.checked()
        self._climb.checked()

    def __call__(self, pairs: Pairs) -> Evidence:
        parts = {"height": self._height.log_ratio(pairs)}
        if self.climbs:
            parts["vertical speed"] = self._climb.log_ratio(pairs)
        return Evidence(parts)

    @cached_property
    def _height(self) -> _Quantity:
        return _Quantity("height", "metres", self.heights, self.wrong, USUAL_M, BANDWIDTH_M)

    @cached_property
    def _climb(self) -> _Quantity:
        return _Quantity("vertical speed", "m/s", self.climbs, self.wrong_climb, USUAL_M_PER_S, BANDWIDTH_M_PER_S)
