"""Catalogues with one trouble of the field each, that their columns do not state: stated probability beside truth.

Two catalogues of one field, made as observatories make them: errors that differ from record to record, objects that
one or the other misses, false records. Each kind has one trouble that nobody states, and all is asked of
``sameas.match`` as a stranger would: two tables, no options. Judged is every identified pair and every record that is
said to have no partner, beside mutual nearest within the radius that is best when the truth is known.
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
from benchmarks.field import Nearest
from benchmarks.tables import Table, report

#: A pair, or a record's having no partner, is called certain from here on.
SURE = 0.99
#: Mean of the quoted errors per axis, arcsec, and its scatter from record to record, as a factor.
SIGMA, SCATTER = 0.15, 1.6
COLUMNS = ("trouble", "true pairs", "right", "wrong", "expected wrong", "off, σ",
           "certain", "wrong of these", "expected", "certainly none", "wrong of these",
           "mutual nearest: best ″", "right", "wrong", "doubts said")  # fmt: skip


@dataclass(frozen=True)
class Source:
    """What one source measured.

    place : (n, 2) arcsec east and north. sigma : (n,) quoted error per axis, arcsec. magnitude : (n,).
    object : (n,) number of the object, −1 of a false record.
    """

    place: np.ndarray
    sigma: np.ndarray
    magnitude: np.ndarray
    object: np.ndarray

    def __len__(self) -> int:
        return len(self.object)

    def part(self, some: np.ndarray) -> Source:
        """Some of the records."""
        return Source(self.place[some], self.sigma[some], self.magnitude[some], self.object[some])

    def and_(self, *more: Source) -> Source:
        """Records of several."""
        columns = ("place", "sigma", "magnitude", "object")
        return Source(*(np.concatenate([getattr(s, name) for s in (self, *more)]) for name in columns))

    def moved(self, by: np.ndarray) -> Source:
        """The same, elsewhere by (n, 2) or (2,) arcsec."""
        return replace(self, place=self.place + by)

    def table(self, rng: np.random.Generator, *, errors: bool, magnitudes: bool) -> tuple[Rows, np.ndarray]:
        """The records as a table, in an order that says nothing; and the object of each row."""
        order = rng.permutation(len(self))
        dec = 20.0 + self.place[order, 1] / 3600.0
        ra = 150.0 + self.place[order, 0] / 3600.0 / np.cos(np.radians(20.0))
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
    """Objects, and two sources that look at them. place : (n, 2) arcsec; magnitude : (n,); side : of the field."""

    rng: np.random.Generator
    place: np.ndarray
    magnitude: np.ndarray
    side: float

    @classmethod
    def of(cls, rng: np.random.Generator, objects: int, chance: float) -> Field:
        """So many, evenly; ``chance`` others within 3σ of a pair on average."""
        side = np.sqrt(objects * np.pi * (3.0 * np.sqrt(2.0) * SIGMA) ** 2 / chance)
        magnitude = 20.0 + np.log10(rng.random(objects)) / 0.4
        return cls(rng, rng.uniform(0.0, side, (objects, 2)), magnitude, float(side))

    def seen(
        self,
        *,
        missing: float = 0.15,
        false: float = 0.1,
        place: np.ndarray | None = None,
        scale: float | np.ndarray = 1.0,
        where: np.ndarray | None = None,
        sigma: float = SIGMA,
    ) -> Source:
        """What a source shows: it misses a share of the objects, and has false records, evenly, per object.

        place : (n, 2) where it has the objects, without errors. scale : (n,) true errors over those quoted.
        where : (n,) which objects it can show at all.
        """
        rng, n = self.rng, len(self.place)
        shown = np.flatnonzero((rng.random(n) >= missing) & (True if where is None else where))
        quoted = sigma * np.exp(rng.normal(0.0, np.log(SCATTER), n))
        at = (self.place if place is None else place) + rng.normal(size=(n, 2)) * (quoted * scale)[:, None]
        magnitude = self.magnitude + rng.normal(0.0, 0.1, n)
        real = Source(at, quoted, magnitude, np.arange(n)).part(shown)
        return real.and_(self.false(int(rng.poisson(false * n)), sigma=sigma))

    def false(self, count: int, place: np.ndarray | None = None, sigma: float = SIGMA) -> Source:
        """False records, evenly or at places (count, 2)."""
        rng = self.rng
        at = rng.uniform(0.0, self.side, (count, 2)) if place is None else place
        quoted = sigma * np.exp(rng.normal(0.0, np.log(SCATTER), count))
        return Source(at, quoted, 20.0 + np.log10(rng.random(count)) / 0.4, np.full(count, -1))

    def smooth(self, amplitude: float, waves: float) -> np.ndarray:
        """(n, 2) a smooth random field of that r.m.s. per axis, with about so many waves over the side."""
        out = np.zeros_like(self.place)
        for axis in (0, 1):
            for _ in range(24):
                k = self.rng.normal(0.0, 2.0 * np.pi * waves / self.side, 2)
                out[:, axis] += np.cos(self.place @ k + self.rng.uniform(0.0, 2.0 * np.pi))
        return np.asarray(out * (amplitude / np.sqrt(12.0)))


Pair = tuple[Source, Source]
Trouble = Callable[[Field], Pair]


def _twice(f: Field) -> Pair:
    second = f.seen()
    again = second.part(f.rng.random(len(second)) < 0.06)
    return f.seen(), second.and_(again.moved(f.rng.normal(0.0, 1.0, (len(again), 2)) * again.sigma[:, None]))


def _epochs(f: Field) -> Pair:
    return f.seen(), f.seen(missing=0.4, false=0.05).and_(f.seen(missing=0.4, false=0.05))


def _spikes(f: Field) -> Pair:
    bright = f.place[np.argsort(f.magnitude)[:8]]
    along = f.rng.uniform(-0.15, 0.15, (8, 60)) * f.side
    across = f.rng.normal(0.0, 0.2, (8, 60))
    turned = f.rng.random((8, 60)) < 0.5
    x, y = np.where(turned, along, across), np.where(turned, across, along)
    place = (bright[:, None, :] + np.stack([x, y], axis=2)).reshape(-1, 2)
    place = place[((place > 0) & (place < f.side)).all(axis=1)]
    return f.seen(), f.seen().and_(f.false(len(place), place))


def _holes(f: Field) -> Pair:
    centre = f.rng.uniform(0.0, f.side, (6, 2))
    away = cKDTree(centre).query(f.place)[0] > 0.11 * f.side
    return f.seen(), f.seen(where=away)


def _half(f: Field) -> Pair:
    second = f.seen(where=f.place[:, 0] > 0.55 * f.side)
    return f.seen(), second.part(second.place[:, 0] > 0.54 * f.side)


def _chips(f: Field) -> Pair:
    chip = (f.place > 0.5 * f.side) @ np.array([1, 2])
    return f.seen(), f.seen(place=f.place + f.rng.normal(0.0, 0.25, (4, 2))[chip])


def _turned(f: Field) -> Pair:
    x, y = (f.place / f.side - 0.5).T
    return f.seen(), f.seen(place=f.place + 0.6 * np.column_stack([x - 1.5 * y, 1.5 * x + y]))


def _shifted(f: Field) -> Pair:
    return f.seen(), f.seen(place=f.place + np.array([0.9, -0.5]))


def _motions(f: Field) -> Pair:
    fast = f.rng.random((len(f.place), 1)) < 0.03
    return f.seen(), f.seen(place=f.place + 16.0 * f.rng.normal(0.0, np.where(fast, 0.1, 0.008), f.place.shape))


def _bright_floor(f: Field) -> Pair:
    law = np.hypot(0.4, 0.25 * 10 ** (-0.2 * (f.magnitude - 17.5)) / SIGMA)
    return f.seen(), f.seen(scale=np.maximum(law, 1.0))


def _tails(f: Field) -> Pair:
    wild = np.where(f.rng.random((2, len(f.place))) < 0.06, 6.0, 1.0)
    return f.seen(scale=wild[0]), f.seen(scale=wild[1])


def _cluster(f: Field) -> Pair:
    n = len(f.place) // 2
    radius = 0.06 * f.side * np.sqrt(f.rng.random(n) / (1.02 - f.rng.random(n)))
    angle = f.rng.uniform(0.0, 2.0 * np.pi, n)
    place = f.place.copy()
    place[:n] = 0.5 * f.side + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    inside = ((place > 0) & (place < f.side)).all(axis=1)
    g = replace(f, place=place[inside], magnitude=f.magnitude[inside])
    return g.seen(), g.seen()


def _crowding(f: Field) -> Pair:
    near = cKDTree(f.place).query(f.place, 2)[0][:, 1]
    return f.seen(missing=0.05), f.seen(where=f.rng.random(len(near)) < 1.0 - np.exp(-((near / 0.8) ** 2)))


def _blended(f: Field) -> Pair:
    """The first tells nothing apart that is nearer than 1.2″: the fainter of two is lost, the place is between."""
    order = np.argsort(f.magnitude)
    tree, flux, place = cKDTree(f.place), 10 ** (-0.4 * f.magnitude), f.place.copy()
    kept = np.ones(len(place), np.bool_)
    for k in order.tolist():
        if kept[k]:
            others = [j for j in tree.query_ball_point(f.place[k], 1.2) if j != k and kept[j] and flux[j] <= flux[k]]
            kept[others] = False
            some = [k, *others]
            place[k] = (flux[some, None] * f.place[some]).sum(axis=0) / flux[some].sum()
    return f.seen(place=place, where=kept), f.seen()


def _extended(f: Field) -> Pair:
    return f.seen(), f.seen(scale=np.where(f.rng.random(len(f.place)) < 0.25, 5.0, 1.0))


def _deeper(f: Field) -> Pair:
    return f.seen(where=f.magnitude < np.quantile(f.magnitude, 0.15), missing=0.05), f.seen()


def _few(f: Field) -> Pair:
    first = f.seen()
    return first.part(f.rng.choice(len(first), 15, replace=False)), f.seen()


def _strangers(f: Field) -> Pair:
    return f.seen(), f.false(len(f.place))


def _rounded(f: Field) -> Pair:
    second = f.seen(sigma=0.05)
    return f.seen(), replace(second, place=np.round(second.place / 0.36) * 0.36)


def _ghosts(f: Field) -> Pair:
    second = f.seen()
    ghosts = second.part(f.rng.random(len(second)) < 0.12).moved(np.array([2.1, -0.7]))
    return f.seen(), second.and_(replace(ghosts, object=np.full(len(ghosts), -1), magnitude=ghosts.magnitude + 3.0))


def _variable(f: Field) -> Pair:
    first, second = f.seen(), f.seen()
    wild = f.rng.random(len(second)) < 0.2
    return first, replace(second, magnitude=second.magnitude + wild * f.rng.normal(0.0, 2.0, len(second)))


def _chains(f: Field) -> Pair:
    """Both have warm pixels, each in columns of its own detector."""

    def column(x: float) -> np.ndarray:
        y = f.rng.uniform(0.0, f.side, 40)
        return np.column_stack([np.full(40, x), y])

    one, two = (f.false(160, np.concatenate([column(x) for x in f.rng.uniform(0, f.side, 4)])) for _ in range(2))
    return f.seen().and_(one), f.seen().and_(two)


@dataclass(frozen=True)
class Kind:
    """A trouble, how crowded its fields are, and what its tables have."""

    trouble: str
    make: Trouble
    chance: float = 0.3
    errors: bool = True
    magnitudes: bool = False


KINDS = [
    Kind("none, sparse", lambda f: (f.seen(), f.seen()), chance=0.05),
    Kind("none", lambda f: (f.seen(), f.seen())),
    Kind("none, crowded", lambda f: (f.seen(), f.seen()), chance=1.5),
    Kind("none, magnitudes", lambda f: (f.seen(), f.seen()), chance=1.0, magnitudes=True),
    Kind("no error column", lambda f: (f.seen(), f.seen()), errors=False),
    Kind("no error column, crowded", lambda f: (f.seen(), f.seen()), chance=1.0, errors=False),
    Kind("errors twice too small", lambda f: (f.seen(scale=2.0), f.seen(scale=2.0)), chance=0.1),
    Kind("errors three times too large", lambda f: (f.seen(scale=0.33), f.seen(scale=0.33)), chance=1.0),
    Kind("a floor for the bright only", _bright_floor),
    Kind("6 % of either with errors six times as large", _tails),
    Kind("a quarter extended, errors five times as large", _extended),
    Kind("shift of 1″", _shifted),
    Kind("turn and scale, 0.5″ at the rim", _turned),
    Kind("four chips, each shifted by 0.25″", _chips),
    Kind("air: smooth warp of 0.15″", lambda f: (f.seen(), f.seen(place=f.place + f.smooth(0.15, 5.0)))),
    Kind("16 years of motions, no column of them", _motions),
    Kind("places rounded to 0.36″", _rounded),
    Kind("6 % given twice", _twice),
    Kind("two epochs in one list", _epochs),
    Kind("spikes of bright stars", _spikes),
    Kind("columns of warm pixels in both", _chains),
    Kind("a ghost 2″ beside every eighth", _ghosts),
    Kind("holes", _holes),
    Kind("half of the field", _half),
    Kind("a cluster", _cluster, chance=0.1),
    Kind("neighbours within 0.8″ lost", _crowding, chance=0.6),
    Kind("blends within 1.2″", _blended, chance=0.5),
    Kind("seven times as deep", _deeper, chance=0.5),
    Kind("seven times as deep, magnitudes", _deeper, chance=0.5, magnitudes=True),
    Kind("15 records", _few, chance=0.2),
    Kind("one in five variable, magnitudes", _variable, chance=1.0, magnitudes=True),
    Kind("nothing in common", _strangers),
]


@dataclass
class Judged:
    """What was said of all fields of one kind, and what is true of them."""

    true: int = 0
    p: list[np.ndarray] = field(default_factory=list)
    right: list[np.ndarray] = field(default_factory=list)
    none: int = 0
    none_wrong: int = 0
    said: set[str] = field(default_factory=set)
    nearest: Nearest = field(default_factory=Nearest)

    def add(self, kind: Kind, rng: np.random.Generator, objects: int) -> None:
        """One field."""
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
        sure = (none > SURE) & ~matched
        self.none += int(sure.sum())
        self.none_wrong += int(np.isin(of_a[np.asarray(joined["id_1"])][sure], both).sum())
        self.said |= set(re.findall(r"^ +doubt +(.*?)(?:[:;(].*)?$", str(found.report()), re.MULTILINE))
        self._mutual(one.place, two.place, one.object, two.object)

    def _mutual(self, a: np.ndarray, b: np.ndarray, of_a: np.ndarray, of_b: np.ndarray) -> None:
        distance, there = cKDTree(b).query(a)
        back = cKDTree(a).query(b)[1]
        mutual = np.flatnonzero(back[there] == np.arange(len(a)))
        self.nearest.tell(distance[mutual], (of_a[mutual] == of_b[there[mutual]]) & (of_a[mutual] >= 0))

    def line(self, kind: Kind) -> list[Any]:
        """The row of the table."""
        p, right = np.concatenate(self.p), np.concatenate(self.right)
        sure, expected = p >= SURE, float((1.0 - p).sum())
        wrong = int((~right).sum())
        off = (wrong - expected) / np.sqrt(max(float((p * (1.0 - p)).sum()), 1.0))
        return [
            kind.trouble, self.true, int(right.sum()), wrong, expected, float(off), int(sure.sum()),
            int((sure & ~right).sum()), float((1.0 - p[sure]).sum()), self.none, self.none_wrong,
            *self.nearest.best(),
            "; ".join(sorted(text[:48] for text in self.said)),
        ]  # fmt: skip


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """One row a kind of trouble."""
    lines = []
    for k, kind in enumerate(KINDS):
        if options.only and not any(word in kind.trouble for word in options.only):
            continue
        judged = Judged()
        for number in range(options.fields):
            judged.add(kind, np.random.default_rng([2811, options.seed, k, number]), options.objects)
        lines.append(judged.line(kind))
    yield Table(f"Troubles: {options.fields} fields of {options.objects} objects each", COLUMNS, lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench troubles", description=__doc__)
    parser.add_argument("--objects", type=int, default=800, help="of a field (default 800)")
    parser.add_argument("--fields", type=int, default=4, help="of each kind (default 4)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[], help="kinds whose name holds one of these")
    warnings.simplefilter("ignore")
    report("troubles", tables(parser.parse_args()))


if __name__ == "__main__":
    main()
