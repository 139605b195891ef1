"""Heights as evidence: two aircraft at one position are different if their heights differ.

The likelihood ratio of heights h₁, h₂ with 1σ errors σ₁, σ₂ is

    r = (1 − w) N(h₁ − h₂; 0, σ₁² + σ₂²) / √(p(h₁) p(h₂)) + w,

with p the density of the heights of the other objects, and w the probability that one of the two is an outlier: a
garbled code, another object's reply. Heights of different kinds (pressure, geometric) must be converted to one before.
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


@dataclass(frozen=True)
class HeightEvidenceTuning:
    """The constants of the evidence of heights (chosen).

    wrong : probability that one of two heights is an outlier.
    usual_m : prior span of heights. usual_weight : number of objects that the prior counts as.
    bandwidth_m : 1σ of the smoothing of known heights to their density.
    """

    wrong: float = 0.01
    usual_m: float = 13_000.0
    usual_weight: float = 10.0
    bandwidth_m: float = 150.0


DEFAULT_TUNING = HeightEvidenceTuning()


@in_short
@dataclass(frozen=True)
class Heights(Rule):
    """The heights of the records, in addition to their positions.

    Parameters
    ----------
    heights : by the source's name, (n_table, 2) height and its 1σ error of every row of its table, metres; NaN where a
        record has none. All are of one kind.

    Example
    -------
    >>> from sameas import Radius, Records
    >>> radar = Records.of([[0.0, 0.0]], sigma=50.0, source="radar")
    >>> adsb = Records.of([[10.0, 0.0], [0.0, 10.0], [5.0, 5.0]], sigma=50.0, source="adsb")
    >>> heights = Heights({"radar": [[10_000.0, 20.0]], "adsb": [[10_010.0, 20.0], [3_000.0, 20.0], [np.nan, np.nan]]})
    >>> pairs = Radius(99.0)(radar, adsb)
    >>> dict(sorted(zip(pairs.j.tolist(), heights(pairs).log_ratio.round(1).tolist())))
    {0: 5.2, 1: -4.6, 2: 0.0}
    """

    heights: Mapping[str, FloatArray] = field(repr=False)
    tuning: HeightEvidenceTuning = DEFAULT_TUNING

    def __post_init__(self) -> None:
        for source, values in self.heights.items():
            sigma = np.asarray(values, dtype=np.float64)
            if sigma.ndim != 2 or sigma.shape[1] != 2:
                raise InputError(f"{source}: heights have the shape {sigma.shape}; give (n, 2): height and its error")
            known = np.isfinite(sigma[:, 0])
            if np.any(~(sigma[known, 1] > 0.0)):
                row = np.flatnonzero(known)[np.argmin(sigma[known, 1] > 0.0)]
                raise InputError(f"{source}: row {row}: the height's error is {sigma[row, 1]}; give metres above 0")

    def __call__(self, pairs: Pairs) -> Evidence:
        one, two = self._of(pairs.first), self._of(pairs.second)
        out = np.zeros(len(pairs))
        if one is None or two is None:
            return Evidence({"height": out})
        (h, s), (k, t) = one[pairs.first.rows[pairs.i]].T, two[pairs.second.rows[pairs.j]].T
        both: BoolArray = np.isfinite(h) & np.isfinite(k)
        h, s, k, t = h[both], s[both], k[both], t[both]
        variance = s**2 + t**2
        same = -0.5 * ((h - k) ** 2 / variance + np.log(2.0 * np.pi * variance))
        other = 0.5 * (self._log_density(h) + self._log_density(k))
        wrong = self.tuning.wrong
        out[both] = np.logaddexp(math.log1p(-wrong) + same - other, math.log(wrong))
        return Evidence({"height": out})

    def _of(self, records: Records) -> FloatArray | None:
        values = self.heights.get(records.source)
        if values is None:
            return None
        table = np.asarray(values, dtype=np.float64)
        if len(table) != records.n_table:
            raise InputError(
                f"{records.source}: {len(table)} heights for {records.n_table} rows; give one for every row"
            )
        return table

    @cached_property
    def _known(self) -> FloatArray:
        """(n,) all known heights, ascending."""
        every = [np.asarray(values, dtype=np.float64)[:, 0] for values in self.heights.values()]
        heights = np.concatenate([np.empty(0), *every])
        return np.sort(heights[np.isfinite(heights)])

    def _log_density(self, height: FloatArray) -> FloatArray:
        """(m,) ln p of heights, one of each source being those of the pair itself."""
        tuning, known = self.tuning, self._known
        width = tuning.bandwidth_m
        grid = np.arange(-5, int((known[-1] - known[0]) / width) + 7) * width + known[0]
        counts = np.bincount(np.rint((known - grid[0]) / width).astype(np.int64), minlength=len(grid))
        steps = np.arange(-4, 5)
        kernel = np.exp(-0.5 * steps**2)
        smooth = np.convolve(counts, kernel / kernel.sum(), mode="same") / width
        own = 2.0 * kernel[4] / kernel.sum() / width
        others = np.maximum(np.interp(height, grid, smooth) - own, 0.0)
        total = max(len(known) - 2.0, 0.0) + tuning.usual_weight
        return np.asarray(np.log((others + tuning.usual_weight / tuning.usual_m) / total))
