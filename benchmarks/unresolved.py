"""Blends one to one with magnitudes: a coarse source shows several objects as one record, a fine one shows them apart.

Objects lie at random in a square, in magnitudes to 22.5 with counts as 10^(0.3 m). In the coarse source a record is
the light of the brightest of some objects and of others about it, each within the resolution with a probability that
falls from 1 to a half there, at the flux-weighted mean position; it shows nine of ten to 21 mag, ± 0.3″. The fine
source shows 95 of 100, ± 0.05″. The true partner of a blend is its brightest object. *As resolved* is the same match
told that the coarse source resolves everything; nearest is the mutual nearest record within 1″.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.tables import Table, report
from sameas import Records
from sameas.estimate.gate_search import MatchTuning
from sameas.estimate.match import match
from sameas.evidence import Magnitudes

SIGMA_ARCSEC, FINE_ARCSEC = 0.3, 0.05
FAINTEST, SHOWN_TO = 22.5, 21.0


@dataclass(frozen=True)
class Kind:
    """A line. colour : scatter between the bands of the two sources, mag. largest : most objects of a blend. quoted :
    errors of the coarse source, arcsec."""

    words: str
    objects: int = 8000
    side_arcsec: float = 180.0
    resolution_arcsec: float = 0.8
    colour: float = 0.1
    largest: int = 1000
    quoted: float = SIGMA_ARCSEC


PLAIN = Kind("8 000 objects, any number in a blend")
KINDS = (
    PLAIN,
    replace(PLAIN, words="two at most in a blend", largest=2),
    replace(PLAIN, words="colours of 0.3 mag", colour=0.3),
    replace(PLAIN, words="errors quoted 1.5 times too small", quoted=0.2),
    replace(PLAIN, words="16 000 objects", objects=16_000),
    replace(PLAIN, words="4 000 objects", objects=4000, side_arcsec=220.0, resolution_arcsec=1.0),
    replace(PLAIN, words="all resolved", resolution_arcsec=1e-3),
)


@dataclass(frozen=True)
class Field:
    """The records of both sources, their magnitudes, and the fine record (n,) of each coarse one, −1 without one."""

    coarse: Records
    fine: Records
    magnitudes: tuple[np.ndarray, np.ndarray]
    partner: np.ndarray

    @classmethod
    def of(cls, kind: Kind, seed: int) -> Field:
        rng, n = np.random.default_rng([91, seed]), kind.objects
        place = rng.uniform(0.0, kind.side_arcsec, (n, 2))
        bright, faint = 10.0 ** (0.3 * 15.0), 10.0 ** (0.3 * FAINTEST)
        fine_mag = np.log10(bright + rng.random(n) * (faint - bright)) / 0.3
        flux = 10.0 ** (-0.4 * (fine_mag + rng.normal(0.0, kind.colour, n)))
        blends = list(_blends(kind, place, fine_mag, rng))
        light = np.array([flux[one].sum() for one in blends])
        centre = np.array([(place[one] * flux[one, None]).sum(axis=0) / flux[one].sum() for one in blends])
        mag = -2.5 * np.log10(light)
        shown = np.flatnonzero((mag < SHOWN_TO) & (rng.random(len(mag)) < 0.92))
        centre = centre[shown] + SIGMA_ARCSEC * rng.standard_normal((len(shown), 2))
        seen = np.flatnonzero(rng.random(n) < 0.95)
        row = np.full(n, -1)
        row[seen] = np.arange(len(seen))
        measured = place[seen] + FINE_ARCSEC * rng.standard_normal((len(seen), 2))
        return cls(
            Records.of(centre, sigma=kind.quoted, source="coarse"),
            Records.of(measured, sigma=FINE_ARCSEC, source="fine"),
            (mag[shown] + rng.normal(0.0, 0.05, len(shown)), fine_mag[seen] + rng.normal(0.0, 0.02, len(seen))),
            row[np.array([one[0] for one in blends])[shown]],
        )


def _blends(kind: Kind, place: np.ndarray, mag: np.ndarray, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """The objects of each record of the coarse source, the brightest first, the others by distance."""
    tree, taken = cKDTree(place), np.zeros(len(place), bool)
    for k in np.argsort(mag).tolist():
        if taken[k]:
            continue
        near = np.array(tree.query_ball_point(place[k], 1.5 * kind.resolution_arcsec))
        off = np.linalg.norm(place[near] - place[k], axis=1)
        within = rng.random(len(near)) < 2.0 ** -((off / kind.resolution_arcsec) ** 4)
        free = np.flatnonzero(within & ~taken[near])
        one = near[free[np.argsort(off[free])]][: kind.largest]
        taken[one] = True
        yield one


def _nearest(one: Field) -> tuple[int, int]:
    """Found and wrong pairs of mutual nearest records within 1″."""
    coarse, fine = one.coarse.features, one.fine.features
    off, to_fine = cKDTree(fine).query(coarse)
    back = cKDTree(coarse).query(fine)[1]
    pairs = np.flatnonzero((off < 1.0) & (back[to_fine] == np.arange(len(coarse))))
    right = to_fine[pairs] == one.partner[pairs]
    return int(right.sum()), int((~right).sum())


def tables(fields: int) -> Iterator[Table]:
    """Found and wrong pairs, expected wrong ones and log loss of each kind."""
    ways = {"as resolved": MatchTuning(fits_resolution=False), "sameas": MatchTuning()}
    rows: list[list[object]] = []
    for kind in KINDS:
        drawn = [Field.of(kind, seed) for seed in range(fields)]
        row: list[object] = [kind.words, sum(int((one.partner >= 0).sum()) for one in drawn)]
        row += np.sum([_nearest(one) for one in drawn], axis=0).tolist()
        for tuning in ways.values():
            scores = [_score(one, tuning) for one in drawn]
            row += [
                *np.sum([score[:-1] for score in scores], axis=0).tolist(),
                np.mean([score[-1] for score in scores]),
            ]
        rows.append(row)
    notes = ("expected: wrong pairs by the probabilities; log loss: of a coarse record's true partner, or of none",)
    columns = [f"{way}: {what}" for way in ways for what in ("found", "wrong", "expected", "p > .99: wrong", "expected",
                                                             "log loss")]  # fmt: skip
    yield Table(
        "Blends with magnitudes, one to one", ("field", "true pairs", "nearest: found", "wrong", *columns), rows,
        (f"{fields} fields of each kind", *notes),
    )  # fmt: skip


def _score(one: Field, tuning: MatchTuning) -> tuple[float, ...]:
    """Found, wrong and expected wrong pairs; those of p > 0.99 wrong and expected; log loss of a coarse record."""
    coarse, fine = one.magnitudes
    answer, _ = match(one.coarse, one.fine, brightness=(Magnitudes(coarse), Magnitudes(fine)), tuning=tuning)
    p, right = answer.p_pair, one.partner[answer.rows_1] == answer.rows_2
    of_partner = np.bincount(answer.rows_1, p * right, len(one.partner))
    none = 1.0 - np.bincount(answer.rows_1, p, len(one.partner))
    stated = np.where(one.partner >= 0, of_partner, none)
    sure = p > 0.99
    found, wrong = (answer.chosen & right).sum(), (answer.chosen & ~right).sum()
    return (
        int(found), int(wrong), float(answer.expected_wrong), int((~right[sure]).sum()), float((1.0 - p[sure]).sum()),
        float(-np.log(np.maximum(stated, 1e-6)).mean()),
    )  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench unresolved", description=__doc__)
    parser.add_argument("--fields", type=int, default=3, help="fields of each kind (default 3)")
    report("unresolved", tables(parser.parse_args().fields))


if __name__ == "__main__":
    main()
