"""Stated probabilities against the truth for two catalogues with one unstated trouble, 32 kinds.

Simulated catalogues of one field: errors that differ from record to record, missed objects, false records. Each kind
has one trouble that no column states (wrong errors, offsets, unknown motions, duplicates, artefacts, blends, unequal
depth). ``sameas.match`` gets two tables without options. Scored are its pairs and its records without a partner,
compared with mutual nearest within the radius that is best with the truth known. ``scripts/bench troubles``, 1 minute.
"""

from __future__ import annotations

import argparse
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from astropy.table import Table as Rows
from scipy.spatial import cKDTree

import sameas
from benchmarks.field import MutualNearest
from benchmarks.tables import Table, report

#: A pair, or a record's having no partner, is certain above this probability.
CERTAIN = 0.99
#: Mean of the quoted errors per axis, arcsec, and its scatter from record to record, as a factor.
SIGMA, SCATTER = 0.15, 1.6
COLUMNS = ("trouble", "true pairs", "right", "wrong", "expected wrong", "difference, σ",
           "certain", "wrong of these", "expected", "certainly none", "wrong of these",
           "mutual nearest: best ″", "right", "wrong", "doubts reported")  # fmt: skip


@dataclass(frozen=True)
class Source:
    """The records of one source.

    position : (n, 2) arcsec east and north. sigma : (n,) quoted error per axis, arcsec. magnitude : (n,).
    object : (n,) number of the object, −1 for a false record.
    """

    position: np.ndarray
    sigma: np.ndarray
    magnitude: np.ndarray
    object: np.ndarray

    def __len__(self) -> int:
        return len(self.object)

    def where(self, rows: np.ndarray) -> Source:
        """The records at a mask or at row numbers."""
        return Source(self.position[rows], self.sigma[rows], self.magnitude[rows], self.object[rows])

    def and_(self, *more: Source) -> Source:
        """The records of this and other sources."""
        columns = ("position", "sigma", "magnitude", "object")
        return Source(*(np.concatenate([getattr(s, name) for s in (self, *more)]) for name in columns))

    def moved(self, by: np.ndarray) -> Source:
        """The records displaced by (n, 2) or (2,) arcsec."""
        return replace(self, position=self.position + by)

    def table(self, rng: np.random.Generator, *, errors: bool, magnitudes: bool) -> tuple[Rows, np.ndarray]:
        """The records as a table in random order, and the object of each row."""
        order = rng.permutation(len(self))
        dec = 20.0 + self.position[order, 1] / 3600.0
        ra = 150.0 + self.position[order, 0] / 3600.0 / np.cos(np.radians(20.0))
        rows = Rows({"id": np.arange(len(order)), "ra": ra, "dec": dec})
        rows["ra"].unit = rows["dec"].unit = "deg"
        if errors:
            rows["pos_err"] = self.sigma[order]
            rows["pos_err"].unit = "arcsec"
        if magnitudes:
            rows["mag"] = self.magnitude[order]
        return rows, self.object[order]


@dataclass(frozen=True)
class Field:
    """The objects of a field. position : (n, 2) arcsec. magnitude : (n,). side : arcsec."""

    rng: np.random.Generator
    position: np.ndarray
    magnitude: np.ndarray
    side: float

    @classmethod
    def of(cls, rng: np.random.Generator, objects: int, chance: float) -> Field:
        """A uniform field with on average ``chance`` other objects within 3σ of a pair."""
        side = np.sqrt(objects * np.pi * (3.0 * np.sqrt(2.0) * SIGMA) ** 2 / chance)
        magnitude = 20.0 + np.log10(rng.random(objects)) / 0.4
        return cls(rng, rng.uniform(0.0, side, (objects, 2)), magnitude, float(side))

    def source(
        self,
        *,
        missing: float = 0.15,
        false: float = 0.1,
        position: np.ndarray | None = None,
        scale: float | np.ndarray = 1.0,
        where: np.ndarray | None = None,
        sigma: float = SIGMA,
    ) -> Source:
        """A source that misses a share of the objects and adds false records.

        false : false records per object, uniform over the field. position : (n, 2) of the objects as the source has
        them, without noise. scale : (n,) true over quoted errors. where : (n,) which objects it can detect at all.
        """
        rng, n = self.rng, len(self.position)
        detected = np.flatnonzero((rng.random(n) >= missing) & (True if where is None else where))
        quoted = sigma * np.exp(rng.normal(0.0, np.log(SCATTER), n))
        noise = rng.normal(size=(n, 2)) * (quoted * scale)[:, None]
        measured = (self.position if position is None else position) + noise
        magnitude = self.magnitude + rng.normal(0.0, 0.1, n)
        real = Source(measured, quoted, magnitude, np.arange(n)).where(detected)
        return real.and_(self.false(int(rng.poisson(false * n)), sigma=sigma))

    def false(self, count: int, position: np.ndarray | None = None, sigma: float = SIGMA) -> Source:
        """False records, uniform over the field or at (count, 2) positions."""
        rng = self.rng
        if position is None:
            position = rng.uniform(0.0, self.side, (count, 2))
        quoted = sigma * np.exp(rng.normal(0.0, np.log(SCATTER), count))
        return Source(position, quoted, 20.0 + np.log10(rng.random(count)) / 0.4, np.full(count, -1))

    def smooth(self, amplitude: float, waves: float) -> np.ndarray:
        """(n, 2) a smooth random field with this RMS per axis and about ``waves`` waves over the side."""
        out = np.zeros_like(self.position)
        for axis in (0, 1):
            for _ in range(24):
                k = self.rng.normal(0.0, 2.0 * np.pi * waves / self.side, 2)
                out[:, axis] += np.cos(self.position @ k + self.rng.uniform(0.0, 2.0 * np.pi))
        return np.asarray(out * (amplitude / np.sqrt(12.0)))


Pair = tuple[Source, Source]
Trouble = Callable[[Field], Pair]


def _duplicates(f: Field) -> Pair:
    second = f.source()
    copies = second.where(f.rng.random(len(second)) < 0.06)
    return f.source(), second.and_(copies.moved(f.rng.normal(0.0, 1.0, (len(copies), 2)) * copies.sigma[:, None]))


def _epochs(f: Field) -> Pair:
    return f.source(), f.source(missing=0.4, false=0.05).and_(f.source(missing=0.4, false=0.05))


def _spikes(f: Field) -> Pair:
    bright = f.position[np.argsort(f.magnitude)[:8]]
    along = f.rng.uniform(-0.15, 0.15, (8, 60)) * f.side
    across = f.rng.normal(0.0, 0.2, (8, 60))
    vertical = f.rng.random((8, 60)) < 0.5
    x, y = np.where(vertical, along, across), np.where(vertical, across, along)
    position = (bright[:, None, :] + np.stack([x, y], axis=2)).reshape(-1, 2)
    position = position[((position > 0) & (position < f.side)).all(axis=1)]
    return f.source(), f.source().and_(f.false(len(position), position))


def _holes(f: Field) -> Pair:
    centre = f.rng.uniform(0.0, f.side, (6, 2))
    outside = cKDTree(centre).query(f.position)[0] > 0.11 * f.side
    return f.source(), f.source(where=outside)


def _half(f: Field) -> Pair:
    second = f.source(where=f.position[:, 0] > 0.55 * f.side)
    return f.source(), second.where(second.position[:, 0] > 0.54 * f.side)


def _chips(f: Field) -> Pair:
    chip = (f.position > 0.5 * f.side) @ np.array([1, 2])
    return f.source(), f.source(position=f.position + f.rng.normal(0.0, 0.25, (4, 2))[chip])


def _rotated(f: Field) -> Pair:
    x, y = (f.position / f.side - 0.5).T
    return f.source(), f.source(position=f.position + 0.6 * np.column_stack([x - 1.5 * y, 1.5 * x + y]))


def _shifted(f: Field) -> Pair:
    return f.source(), f.source(position=f.position + np.array([0.9, -0.5]))


def _motions(f: Field) -> Pair:
    fast = f.rng.random((len(f.position), 1)) < 0.03
    return f.source(), f.source(
        position=f.position + 16.0 * f.rng.normal(0.0, np.where(fast, 0.1, 0.008), f.position.shape)
    )


def _bright_floor(f: Field) -> Pair:
    scale = np.hypot(0.4, 0.25 * 10 ** (-0.2 * (f.magnitude - 17.5)) / SIGMA)
    return f.source(), f.source(scale=np.maximum(scale, 1.0))


def _tails(f: Field) -> Pair:
    scale = np.where(f.rng.random((2, len(f.position))) < 0.06, 6.0, 1.0)
    return f.source(scale=scale[0]), f.source(scale=scale[1])


def _cluster(f: Field) -> Pair:
    n = len(f.position) // 2
    radius = 0.06 * f.side * np.sqrt(f.rng.random(n) / (1.02 - f.rng.random(n)))
    angle = f.rng.uniform(0.0, 2.0 * np.pi, n)
    position = f.position.copy()
    position[:n] = 0.5 * f.side + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    inside = ((position > 0) & (position < f.side)).all(axis=1)
    g = replace(f, position=position[inside], magnitude=f.magnitude[inside])
    return g.source(), g.source()


def _crowding(f: Field) -> Pair:
    separation = cKDTree(f.position).query(f.position, 2)[0][:, 1]
    return f.source(missing=0.05), f.source(
        where=f.rng.random(len(separation)) < 1.0 - np.exp(-((separation / 0.8) ** 2))
    )


def _blended(f: Field) -> Pair:
    """The first source blends objects within 1.2″: one record at the flux-weighted mean position."""
    order = np.argsort(f.magnitude)
    tree, flux, position = cKDTree(f.position), 10 ** (-0.4 * f.magnitude), f.position.copy()
    kept = np.ones(len(position), np.bool_)
    for k in order.tolist():
        if kept[k]:
            others = [j for j in tree.query_ball_point(f.position[k], 1.2) if j != k and kept[j] and flux[j] <= flux[k]]
            kept[others] = False
            blend = [k, *others]
            position[k] = (flux[blend, None] * f.position[blend]).sum(axis=0) / flux[blend].sum()
    return f.source(position=position, where=kept), f.source()


def _extended(f: Field) -> Pair:
    return f.source(), f.source(scale=np.where(f.rng.random(len(f.position)) < 0.25, 5.0, 1.0))


def _deeper(f: Field) -> Pair:
    return f.source(where=f.magnitude < np.quantile(f.magnitude, 0.15), missing=0.05), f.source()


def _few(f: Field) -> Pair:
    first = f.source()
    return first.where(f.rng.choice(len(first), 15, replace=False)), f.source()


def _unrelated(f: Field) -> Pair:
    return f.source(), f.false(len(f.position))


def _rounded(f: Field) -> Pair:
    second = f.source(sigma=0.05)
    return f.source(), replace(second, position=np.round(second.position / 0.36) * 0.36)


def _ghosts(f: Field) -> Pair:
    second = f.source()
    ghosts = second.where(f.rng.random(len(second)) < 0.12).moved(np.array([2.1, -0.7]))
    return f.source(), second.and_(replace(ghosts, object=np.full(len(ghosts), -1), magnitude=ghosts.magnitude + 3.0))


def _variable(f: Field) -> Pair:
    first, second = f.source(), f.source()
    variable = f.rng.random(len(second)) < 0.2
    return first, replace(second, magnitude=second.magnitude + variable * f.rng.normal(0.0, 2.0, len(second)))


def _warm_columns(f: Field) -> Pair:
    """Both have warm pixels, each in columns of its own detector."""

    def column(x: float) -> np.ndarray:
        y = f.rng.uniform(0.0, f.side, 40)
        return np.column_stack([np.full(40, x), y])

    one, two = (f.false(160, np.concatenate([column(x) for x in f.rng.uniform(0, f.side, 4)])) for _ in range(2))
    return f.source().and_(one), f.source().and_(two)


@dataclass(frozen=True)
class Kind:
    """A trouble. chance : other objects within 3σ of a pair. errors, magnitudes : whether the tables have them."""

    trouble: str
    make: Trouble
    chance: float = 0.3
    errors: bool = True
    magnitudes: bool = False


KINDS = [
    Kind("none, sparse", lambda f: (f.source(), f.source()), chance=0.05),
    Kind("none", lambda f: (f.source(), f.source())),
    Kind("none, crowded", lambda f: (f.source(), f.source()), chance=1.5),
    Kind("none, magnitudes", lambda f: (f.source(), f.source()), chance=1.0, magnitudes=True),
    Kind("no error column", lambda f: (f.source(), f.source()), errors=False),
    Kind("no error column, crowded", lambda f: (f.source(), f.source()), chance=1.0, errors=False),
    Kind("errors twice too small", lambda f: (f.source(scale=2.0), f.source(scale=2.0)), chance=0.1),
    Kind("errors three times too large", lambda f: (f.source(scale=0.33), f.source(scale=0.33)), chance=1.0),
    Kind("a floor for bright records only", _bright_floor),
    Kind("6 % of either with errors six times as large", _tails),
    Kind("a quarter extended, errors five times as large", _extended),
    Kind("shift of 1″", _shifted),
    Kind("rotation and scale, 0.5″ at the edge", _rotated),
    Kind("four chips, each shifted by 0.25″", _chips),
    Kind(
        "smooth warp of 0.15″ (atmosphere)", lambda f: (f.source(), f.source(position=f.position + f.smooth(0.15, 5.0)))
    ),
    Kind("16 years of proper motions, no column", _motions),
    Kind("positions rounded to 0.36″", _rounded),
    Kind("6 % duplicates", _duplicates),
    Kind("two epochs in one catalogue", _epochs),
    Kind("spikes of bright stars", _spikes),
    Kind("columns of warm pixels in both", _warm_columns),
    Kind("a ghost 2″ from every eighth", _ghosts),
    Kind("holes", _holes),
    Kind("half of the field", _half),
    Kind("a cluster", _cluster, chance=0.1),
    Kind("neighbours within 0.8″ lost", _crowding, chance=0.6),
    Kind("blends within 1.2″", _blended, chance=0.5),
    Kind("seven times as deep", _deeper, chance=0.5),
    Kind("seven times as deep, magnitudes", _deeper, chance=0.5, magnitudes=True),
    Kind("15 records", _few, chance=0.2),
    Kind("one in five variable, magnitudes", _variable, chance=1.0, magnitudes=True),
    Kind("nothing in common", _unrelated),
]


@dataclass
class Score:
    """Counts over all fields of one kind.

    p, right : of the pairs. none, none_wrong : records certain to have no partner, and how many of them have one.
    """

    true: int = 0
    p: list[np.ndarray] = field(default_factory=list)
    right: list[np.ndarray] = field(default_factory=list)
    none: int = 0
    none_wrong: int = 0
    doubts: set[str] = field(default_factory=set)
    nearest: MutualNearest = field(default_factory=MutualNearest)

    def add(self, kind: Kind, rng: np.random.Generator, objects: int) -> None:
        """Add one field."""
        one, two = kind.make(Field.of(rng, objects, kind.chance))
        (a, of_a), (b, of_b) = (s.table(rng, errors=kind.errors, magnitudes=kind.magnitudes) for s in (one, two))
        found = sameas.match(a, b)
        pairs, both = found.pairs, np.intersect1d(of_a[of_a >= 0], of_b[of_b >= 0])
        i, j = np.asarray(pairs["row_1"]), np.asarray(pairs["row_2"])
        self.true += len(both)
        self.p.append(np.asarray(pairs["p_match"]))
        self.right.append((of_a[i] == of_b[j]) & (of_a[i] >= 0))
        joined: Any = found.joined("all1")
        none, matched = np.asarray(joined["p_none"]), np.zeros(len(a), np.bool_)
        matched[i] = True
        certain = (none > CERTAIN) & ~matched
        self.none += int(certain.sum())
        self.none_wrong += int(np.isin(of_a[np.asarray(joined["id_1"])][certain], both).sum())
        self.doubts |= set(re.findall(r"^ +doubt +(.*?)(?:[:;(].*)?$", str(found.report()), re.MULTILINE))
        self._mutual(one.position, two.position, one.object, two.object)

    def _mutual(self, a: np.ndarray, b: np.ndarray, of_a: np.ndarray, of_b: np.ndarray) -> None:
        distance, forward = cKDTree(b).query(a)
        backward = cKDTree(a).query(b)[1]
        mutual = np.flatnonzero(backward[forward] == np.arange(len(a)))
        self.nearest.add_pairs(distance[mutual], (of_a[mutual] == of_b[forward[mutual]]) & (of_a[mutual] >= 0))

    def line(self, kind: Kind) -> list[Any]:
        """The row of the table."""
        p, right = np.concatenate(self.p), np.concatenate(self.right)
        certain, expected = p >= CERTAIN, float((1.0 - p).sum())
        wrong = int((~right).sum())
        deviation = (wrong - expected) / np.sqrt(max(float((p * (1.0 - p)).sum()), 1.0))
        return [
            kind.trouble, self.true, int(right.sum()), wrong, expected, float(deviation), int(certain.sum()),
            int((certain & ~right).sum()), float((1.0 - p[certain]).sum()), self.none, self.none_wrong,
            *self.nearest.best(),
            "; ".join(sorted(text[:48] for text in self.doubts)),
        ]  # fmt: skip


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """One row per kind of trouble."""
    lines = []
    for k, kind in enumerate(KINDS):
        if options.only and not any(word in kind.trouble for word in options.only):
            continue
        score = Score()
        for number in range(options.fields):
            score.add(kind, np.random.default_rng([2811, options.seed, k, number]), options.objects)
        lines.append(score.line(kind))
    yield Table(f"Troubles: {options.fields} fields of {options.objects} objects each", COLUMNS, lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench troubles", description=__doc__)
    parser.add_argument("--objects", type=int, default=800, help="objects per field (default 800)")
    parser.add_argument("--fields", type=int, default=4, help="fields of each kind (default 4)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[], help="kinds whose name contains one of these")
    warnings.simplefilter("ignore")
    report("troubles", tables(parser.parse_args()))


if __name__ == "__main__":
    main()
