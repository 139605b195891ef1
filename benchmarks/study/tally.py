"""The tally: counts of a contender's decisions, summed over scenes, with standard errors.

Everything is counted per scene. Figures are ratios of sums over scenes, and their standard errors are those of ratio
estimates (Cochran, Sampling Techniques, 1977, 6.4): scenes are independent, records of one scene are not.

A record is *right* if its only partner is its true one, or if it has no partner and truly has none. A scene is *wholly
right* if all of its records are. A scene is *open* if both sources have records; in other scenes every rule is right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.study.contenders import Verdict
from benchmarks.study.scenes import Scenes
from sameas.arrays import FloatArray
from sameas.score.picture import nearest_match

COLUMNS = ("scenes", "open", "whole", "records", "right", "open records", "open right", "claimed", "true", "hits",
           "wrong", "missed", "candidates", "brier", "gospa", "lead", "whole lead")  # fmt: skip
AT = {name: k for k, name in enumerate(COLUMNS)}
#: Cutoff of GOSPA in σ, and bins of the calibration error.
CUTOFF, BINS = 3.0, 10


@dataclass(frozen=True)
class Ratio:
    """A figure and its standard error."""

    value: float
    error: float


@dataclass(frozen=True)
class Tally:
    """Sums over scenes: ``total`` (c,) of the columns, ``cross`` (c, c) of their products; seconds of work.

    bins : (blocks, 3, BINS) number of candidates, Σ p and Σ of those that are true, by their stated p.
    """

    total: FloatArray
    cross: FloatArray
    bins: FloatArray
    seconds: float

    def __add__(self, other: Tally) -> Tally:
        bins = np.concatenate([self.bins, other.bins])
        return Tally(self.total + other.total, self.cross + other.cross, bins, self.seconds + other.seconds)

    @property
    def scenes(self) -> int:
        return int(self.total[AT["scenes"]])

    def ratio(self, above: str, below: str) -> Ratio:
        """Σ above / Σ below over all scenes; NaN if the denominator is 0."""
        a, b = AT[above], AT[below]
        if not self.total[b] > 0.0:
            return Ratio(math.nan, math.nan)
        value = self.total[a] / self.total[b]
        square = self.cross[a, a] - 2.0 * value * self.cross[a, b] + value**2 * self.cross[b, b]
        n = max(self.scenes, 2)
        return Ratio(float(value), float(math.sqrt(max(square, 0.0) * n / (n - 1)) / self.total[b]))

    @property
    def calibration_error(self) -> Ratio:
        """Mean |stated − observed| of the candidates over bins of p; its error by the jackknife over blocks."""
        blocks = len(self.bins)
        whole = self.bins.sum(axis=0)
        value = _calibration_error(whole)
        without = np.array([_calibration_error(whole - block) for block in self.bins])
        error = math.sqrt((blocks - 1) / blocks * np.sum((without - without.mean()) ** 2)) if blocks > 1 else math.nan
        return Ratio(value, error if math.isfinite(value) else math.nan)

    def figures(self) -> dict[str, Ratio]:
        """The figures of the tables by name; leads are differences to the first contender of the point."""
        return {
            "right": self.ratio("right", "records"),
            "right of open": self.ratio("open right", "open records"),
            "whole": self.ratio("whole", "scenes"),
            "wrong pairs": self.ratio("wrong", "claimed"),
            "missed pairs": self.ratio("missed", "true"),
            "brier": self.ratio("brier", "candidates"),
            "ece": self.calibration_error,
            "gospa": self.ratio("gospa", "scenes"),
            "lead": self.ratio("lead", "records"),
            "whole lead": self.ratio("whole lead", "scenes"),
        }


def _calibration_error(bins: FloatArray) -> float:
    count, stated, observed = bins
    return float(np.abs(stated - observed).sum() / count.sum()) if count.sum() > 0 else math.nan


def count(scenes: Scenes, verdict: Verdict, seconds: float = 0.0, reference: FloatArray | None = None) -> Tally:
    """The tally of a verdict on scenes of two sources.

    reference : (count,) records that another contender has right; the difference to it is the lead, whose error is
    smaller than that of either, because both decided the same scenes.
    """
    per_scene = np.zeros((len(scenes), len(COLUMNS)))
    per_scene[:, AT["scenes"]] = 1.0
    open_ = scenes.open
    records = scenes.sizes[:2].sum(axis=0)
    right = rightly(scenes, verdict)
    other = right if reference is None else reference
    hit = scenes.truth[0][verdict.i] == scenes.truth[1][verdict.j]
    of_pair = scenes.scene[0][verdict.i]
    claimed, hits = (np.bincount(of_pair, weights, len(scenes)) for weights in (None, hit))
    common = np.intersect1d(scenes.truth[0], scenes.truth[1])
    true = np.bincount(scenes.target_scene[common], minlength=len(scenes))
    values = {
        "open": open_, "whole": right == records, "records": records, "right": right, "open records": records * open_,
        "open right": right * open_, "claimed": claimed, "true": true, "hits": hits, "wrong": claimed - hits,
        "missed": true - hits, "gospa": distances(scenes, _picture(scenes, verdict)), "lead": right - other,
        "whole lead": (right == records).astype(float) - (other == records),
    }  # fmt: skip
    bins = np.zeros((1, 3, BINS))
    if verdict.candidates is not None:
        i, j, p = verdict.candidates
        is_true = scenes.truth[0][i] == scenes.truth[1][j]
        of_pair = scenes.scene[0][i]
        values["candidates"] = np.bincount(of_pair, minlength=len(scenes))
        values["brier"] = np.bincount(of_pair, (p - is_true) ** 2, len(scenes))
        number = np.minimum((p * BINS).astype(np.int64), BINS - 1)
        bins[0] = [np.bincount(number, weights, BINS) for weights in (None, p, is_true)]
    for name, column in values.items():
        per_scene[:, AT[name]] = column
    return Tally(per_scene.sum(axis=0), per_scene.T @ per_scene, bins, seconds)


def rightly(scenes: Scenes, verdict: Verdict) -> FloatArray:
    """(count,) number of records that are right."""
    total = np.zeros(len(scenes))
    hit = scenes.truth[0][verdict.i] == scenes.truth[1][verdict.j]
    for side, rows in ((0, verdict.i), (1, verdict.j)):
        n = len(scenes.truth[side])
        partners, true_partners = np.bincount(rows, minlength=n), np.bincount(rows, hit, n)
        has_partner = np.isin(scenes.truth[side], scenes.truth[1 - side])
        right = np.where(has_partner, (partners == 1) & (true_partners == 1), partners == 0)
        total += np.bincount(scenes.scene[side], right, len(scenes))
    return total


def _picture(scenes: Scenes, verdict: Verdict) -> tuple[FloatArray, np.ndarray]:
    """Places (n, d) and scenes (n,) of the objects: pairs fused by inverse variance, the others as they are."""
    first, second = scenes.sources[:2]
    w1, w2 = 1.0 / first.covariance[verdict.i], 1.0 / second.covariance[verdict.j]
    fused = (w1 * first.features[verdict.i] + w2 * second.features[verdict.j]) / (w1 + w2)
    alone = [np.setdiff1d(np.arange(len(s)), rows) for s, rows in ((first, verdict.i), (second, verdict.j))]
    places = np.concatenate([fused, first.features[alone[0]], second.features[alone[1]]])
    at = (scenes.scene[0][verdict.i], scenes.scene[0][alone[0]], scenes.scene[1][alone[1]])
    return places, np.concatenate(at)


def distances(scenes: Scenes, picture: tuple[FloatArray, np.ndarray]) -> FloatArray:
    """(count,) GOSPA of order 2 between every scene's picture and all its targets, including missed ones."""
    places, scene = picture
    at, _, distance = nearest_match(places, scenes.targets, cutoff=CUTOFF)
    n = len(scenes)
    matched = np.bincount(scene[at], minlength=n)
    unmatched = np.bincount(scene, minlength=n) + np.bincount(scenes.target_scene, minlength=n) - 2.0 * matched
    return np.sqrt(np.bincount(scene[at], distance**2, n) + 0.5 * CUTOFF**2 * unmatched)
