"""Formal errors, few pairs, floors nobody quotes, columns as evidence: beside mutual nearest, STILTS, NWAY."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks import judged, peers, workload
from benchmarks.frames import Tally
from benchmarks.recovered import true_rule
from benchmarks.tables import Table, report
from sameas import Identification, Sphere, identify
from sameas.estimate.blends import Blends, find_blends
from sameas.estimate.match import DEFAULT_MATCH, match
from sameas.evidence import Column, Magnitudes, Related
from sameas.records import Records
from sameas.score.pairs import is_true_pair, reliability
from sameas.simulate.exposures import Exposure, Sky, exposure
from sameas.simulate.scenes import SimulatedScene
from sameas.simulate.surveys import (
    BlendedField,
    Counterparts,
    blended_field,
    counterparts,
    couples_field,
    formal_field,
    growing_field,
)
from sameas.sky.crossmatch import nearest
from sameas.space import displaced

Pairs = tuple[np.ndarray, np.ndarray]
#: A true partner of a record that is told to have none with more than this is told so for certain.
CERTAIN = 0.99
#: Events in a bin of probability that is judged, and what it may be off.
IN_BIN, OFF = 200, 0.03


@dataclass(frozen=True)
class Kind:
    """Fields of one kind: number of objects, floor in arcsec, errors over those quoted."""

    objects: int
    floor: float = 0.0
    scale: float = 1.0

    def fields(self, options: argparse.Namespace) -> Iterator[SimulatedScene]:
        """As many as hold about the number of objects that is asked for; at least two."""
        for number in range(max(2, options.objects // self.objects)):
            rng = np.random.default_rng([162, self.objects, round(1000 * self.floor), round(1000 * self.scale), number])
            yield formal_field(rng, self.objects, floor_arcsec=self.floor, scale=self.scale)


#: What nobody quotes: floors under the errors, and errors that are all too small, or too large.
FLOORS = [Kind(objects, floor) for objects in (20, 40, 100, 200, 1000) for floor in (0.0, 0.05, 0.15, 0.5)]
SCALES = [Kind(objects, 0.0, scale) for objects in (20, 60, 200, 1000) for scale in (0.3, 2.0, 4.0, 16.0)]


@dataclass
class Judged:
    """What was said of all fields of one kind, and what is true of them."""

    true: int = 0
    found: int = 0
    wrong: int = 0
    certain: int = 0
    expected: float = 0.0
    variance: float = 0.0
    stated: list[np.ndarray] = field(default_factory=list)
    happened: list[np.ndarray] = field(default_factory=list)

    def add(self, answer: Identification, scene: SimulatedScene) -> None:
        """One field."""
        true, claimed = scene.true_pairs(), (answer.matches.rows_1, answer.matches.rows_2)
        right = is_true_pair(claimed, true)
        p = answer.matches.p_match
        self.true += len(true[0])
        self.found += int(right.sum())
        self.wrong += int((~right).sum())
        self.expected += answer.expected_wrong
        self.variance += float((p * (1.0 - p)).sum())
        for answers, rows in ((answer.answers_1, true[0]), (answer.answers_2, true[1])):
            self.certain += int((answers.p_none[rows].filled(0.0) > CERTAIN).sum())
        self.stated.append(answer.p_pair)
        self.happened.append(is_true_pair((answer.rows_1, answer.rows_2), true))

    @property
    def missed(self) -> int:
        """True pairs that were not found."""
        return self.true - self.found

    @property
    def deviation(self) -> float:
        """Wrong beyond those expected, in standard deviations of their number (of at least one pair)."""
        return (self.wrong - self.expected) / np.sqrt(max(self.variance, 1.0))


@dataclass
class Nearest:
    """Pairs that are each other's nearest, of all fields of one kind, within the radius that is best in truth."""

    separation: list[np.ndarray] = field(default_factory=list)
    right: list[np.ndarray] = field(default_factory=list)
    true: int = 0

    def add(self, scene: SimulatedScene) -> None:
        """One field."""
        there, back = nearest(scene.first, scene.second), nearest(scene.second, scene.first)
        mutual = np.flatnonzero(back.rows[there.rows] == np.arange(len(there.rows)))
        true = scene.true_pairs()
        self.tell(there.separation_arcsec[mutual], is_true_pair((mutual, there.rows[mutual]), true))
        self.true += len(true[0])

    def tell(self, separation: np.ndarray, right: np.ndarray) -> None:
        """The mutual pairs of one field, (k,): how far apart in arcsec, and whether they are true."""
        self.separation.append(separation)
        self.right.append(right)

    def best(self) -> tuple[float, int, int]:
        """The radius of fewest wrong and missed, and what is found and wrong within it."""
        order = np.argsort(np.concatenate(self.separation))
        separation, right = np.concatenate(self.separation)[order], np.concatenate(self.right)[order]
        found = np.concatenate([[0], np.cumsum(right)])
        wrong = np.arange(len(found)) - found
        best = int(np.argmin(wrong - found))
        return float(separation[best - 1]) if best else 0.0, int(found[best]), int(wrong[best])


def formal(kinds: list[Kind], title: str, options: argparse.Namespace) -> Iterator[Table]:
    """Every kind of field, then how often what was said happened."""
    lines, all_of, worse = [], Judged(), []
    for kind in kinds:
        ours, theirs = Judged(), Nearest()
        for scene in kind.fields(options):
            ours.add(match(scene.first, scene.second)[0], scene)
            theirs.add(scene)
        radius, found, wrong = theirs.best()
        loss, due = ours.wrong + ours.missed, wrong + ours.true - found
        if loss > due:
            worse.append(f"{kind.objects} objects, floor {kind.floor:g}″, scale {kind.scale:g}: {loss} for {due}")
        lines.append([
            kind.objects, kind.floor, kind.scale, ours.true, ours.found, ours.wrong, ours.missed, ours.certain,
            ours.expected, ours.deviation, radius, found, wrong, ours.true - found,
        ])  # fmt: skip
        all_of.stated += ours.stated
        all_of.happened += ours.happened
    columns = (
        "objects", "floor ″", "scale", "true pairs", "found", "wrong", "missed", "told none, p > .99", "expected wrong",
        "off, σ", "mutual: best ″", "found", "wrong", "missed",
    )  # fmt: skip
    off = max(abs(float(line[9])) for line in lines)
    yield Table(title, columns, lines, (
        f"wrong and missed more than mutual nearest at its best radius: {'; '.join(worse) or 'nowhere'}",
        f"wrong beyond expected: at most {off:.1f} σ",
        "told none: records with a true partner that are said to have none; σ of at least one pair",
    ))  # fmt: skip
    yield calibrated(all_of, title)


def calibrated(judged: Judged, title: str) -> Table:
    """Stated probability beside observed frequency."""
    told = reliability(np.concatenate(judged.stated), np.concatenate(judged.happened))
    rows = [
        [float(p), float(f), int(n), float(f - p)]
        for p, f, n in zip(told.stated, told.observed, told.count, strict=True)
    ]
    worst = max((abs(row[3]) for row in rows if row[2] >= IN_BIN), default=0.0)
    note = f"largest difference in a bin of {IN_BIN} or more: {worst:.3f} (asked: ≤ {OFF:g})"
    return Table(f"{title}: what is said of candidates", ("stated", "observed", "candidates", "off"), rows, (note,))


# ---- crowded frames whose floor nobody quotes ----

FLOOR_ARCSEC = 0.1
#: Errors of photon noise: those of bright stars next to nothing, in the frame and in a catalogue of a few years ago.
PHOTON = Sky(
    stars_per_deg2=1_200_000.0,
    catalogue_sigma_arcsec=(0.002, 0.05), motion_sigma_mas_per_yr=(0.05, 1.0), unknown_motion=0.0, gap_yr=5.0,
    frame_sigma_arcsec=(0.005, 0.2),
)  # fmt: skip


def with_floor(rng: np.random.Generator, made: Exposure) -> tuple[Exposure, Exposure]:
    """The frame with a floor that is not quoted; the same where it is."""
    first = made.scene.first
    moved = replace(first, features=displaced(first.features, FLOOR_ARCSEC * rng.standard_normal((len(first), 2))))
    full = moved.full_covariance() + FLOOR_ARCSEC**2 * np.eye(2)
    honest = Records.of(moved.features, covariance=full, space=Sphere(), source=moved.source)
    return (
        replace(made, scene=replace(made.scene, first=moved)),
        replace(made, scene=replace(made.scene, first=honest)),
    )


def crowded(options: argparse.Namespace) -> Iterator[Table]:
    """Crowded frames: positions alone and magnitudes, the floor told or not."""
    tallies: dict[tuple[str, str], Tally] = {}
    floors: list[float] = []
    for number in range(options.frames):
        rng = np.random.default_rng([163, number])
        made = exposure(rng, PHOTON, side_deg=options.side)
        silent, honest = with_floor(rng, made)
        for title, shown in (("as quoted", made), (f"floor of {FLOOR_ARCSEC:g}″, quoted", honest),
                             (f"floor of {FLOOR_ARCSEC:g}″, not quoted", silent)):  # fmt: skip
            first, second = shown.scene.first, shown.scene.second
            if shown is not silent:
                known = identify(first, second, rule=true_rule(shown))
                tallies.setdefault((title, "true parameters"), Tally()).add_answer(known, shown.scene)
            answer, estimate = match(first, second)
            tallies.setdefault((title, "nothing told, positions"), Tally()).add_answer(answer, shown.scene)
            if shown is silent:
                floors.append(getattr(estimate.errors, "floor", float("nan")))
            answer, _ = match(first, second, brightness=shown.brightness)
            tallies.setdefault((title, "nothing told, two bands"), Tally()).add_answer(answer, shown.scene)
    lines = [[*names, *tally.line()[:3], tally.line()[6], tally.line()[7]] for names, tally in tallies.items()]
    columns = ("errors", "by", "claimed", "wrong", "±", "expected wrong", "ECE")
    floor = f"floor that was estimated: {np.mean(floors):.4f} ± {np.std(floors):.4f}″"
    yield Table(f"Crowded frames: {options.frames} of {options.side:g}°", columns, lines, (floor,))


# ---- others ----


#: How errors grow that are all quoted as 0.1″: by magnitude and distance from the centre over that of a corner.
GROWING: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "as quoted": lambda magnitude, distance: np.full(len(magnitude), 0.1),
    "faint 0.4″, bright 0.02″": lambda magnitude, distance: np.hypot(0.02, 0.4 * 10.0 ** (0.3 * (magnitude - 22.0))),
    "bright 0.5″, others 0.1″": lambda magnitude, distance: np.where(magnitude < 19.0, 0.5, 0.1),
    "centre 0.05″, corners 0.65″": lambda magnitude, distance: 0.05 + 0.6 * distance**2,
}


def growing(options: argparse.Namespace) -> Iterator[Table]:
    """Errors that grow with magnitude or place, all quoted alike: one error for all, found, and told."""
    lines: list[list[object]] = []
    for name, law in GROWING.items():
        tallies: dict[str, Tally] = {}
        beside = Nearest()
        for number in range(options.fields):
            scene, (one, two), errors = growing_field(np.random.default_rng([7, number]), 3000, law)
            told = replace(scene.second, covariance=errors[:, None] ** 2)
            beside.add(scene)
            for by, brightness in (("positions", None), ("magnitudes", (Magnitudes(one), Magnitudes(two)))):
                for how, second, grown in (("one error for all", scene.second, False), ("sameas", scene.second, True),
                                           ("errors told", told, False)):  # fmt: skip
                    tuning = replace(DEFAULT_MATCH, fits_trends=grown)
                    answer, _ = match(scene.first, second, brightness=brightness, tuning=tuning)
                    tallies.setdefault(f"{by}, {how}", Tally()).add_answer(answer, scene)
        for title, tally in tallies.items():
            claimed, wrong, error = tally.line()[:3]
            lines.append([name, title, claimed, wrong, error, tally.line()[6], tally.line()[7]])
        radius, found, wrong = beside.best()
        lines.append([name, f"mutual nearest within {radius:.2g}″", found + wrong, wrong, None, None, None])
    columns = ("errors, all quoted 0.1″", "by", "claimed", "wrong", "±", "expected wrong", "ECE")
    yield Table(f"Errors that grow: {options.fields} fields of 3 000 objects each", columns, lines)


#: Fields with couples: objects, share in couples, separation in errors of a record, share that either source misses.
COUPLES = [
    *((400, share, separation, missing) for share in (0.3, 1.0) for separation in (0.1, 0.5, 1.0, 2.0, 5.0, 20.0)
      for missing in (0.0, 0.2, 0.4)),
    (100, 0.3, 2.0, 0.3), (5000, 0.1, 2.0, 0.3), (400, 0.0, 0.0, 0.3),
]  # fmt: skip


def couples(options: argparse.Namespace) -> Iterator[Table]:
    """Objects nearer to each other than a Poisson field has them: companions asked for, or not."""
    lines: list[list[object]] = []
    for objects, share, separation, missing in COUPLES:
        ways = {
            "sameas": DEFAULT_MATCH,
            "no companions": replace(DEFAULT_MATCH, em=replace(DEFAULT_MATCH.em, companions=None)),
        }
        judgements, sure = {way: Judged() for way in ways}, dict.fromkeys(ways, (0, 0))
        beside = Nearest()
        for number in range(max(1, 3 * options.objects // objects)):
            seed = [163, objects, round(100 * share), round(10 * separation), round(100 * missing), number]
            scene = couples_field(
                np.random.default_rng(seed), objects, share=share, separation=separation, missing=missing
            )
            beside.add(scene)
            for way, tuning in ways.items():
                answer, _ = match(scene.first, scene.second, tuning=tuning)
                judgements[way].add(answer, scene)
                matches = answer.matches
                right = is_true_pair((matches.rows_1, matches.rows_2), scene.true_pairs())
                certain = matches.p_match > CERTAIN
                sure[way] = sure[way][0] + int(certain.sum()), sure[way][1] + int((certain & ~right).sum())
        _, found, wrong = beside.best()
        line: list[object] = [objects, share, separation, missing, judgements["sameas"].true]
        for way, it in judgements.items():
            line += [it.found, it.wrong, it.expected, *sure[way]]
        lines.append([*line, found, wrong])
    own = ("right", "wrong", "expected wrong", "certain", "wrong of these")
    columns = ("objects", "in couples", "separation, σ", "missed", "true pairs", *own,
               *(f"no companions: {name}" for name in own), "mutual: right", "wrong")  # fmt: skip
    yield Table("Couples of objects", columns, lines)


def others(options: argparse.Namespace) -> Iterator[Table]:
    """STILTS and NWAY on some of the same fields, with the errors as they are quoted."""
    lines: list[list[object]] = []
    missing: set[str] = set()
    for kind in (Kind(200, 0.0), Kind(200, 0.15), Kind(200, 0.5), Kind(200, 0.0, 4.0)):
        scene = next(kind.fields(options))
        true = scene.true_pairs()
        mine = match(scene.first, scene.second)[0]
        claims: dict[str, Pairs] = {"sameas": (mine.matches.rows_1, mine.matches.rows_2)}
        with tempfile.TemporaryDirectory(prefix="sameas-bench-") as name:
            claims |= _theirs(scene, Path(name) / "scene", options, missing)
        for by, claimed in claims.items():
            right = int(is_true_pair(claimed, true).sum())
            lines.append([kind.objects, kind.floor, kind.scale, by, len(true[0]), right, len(claimed[0]) - right])
    columns = ("objects", "floor ″", "scale", "by", "true pairs", "found", "wrong")
    notes = tuple(f"{name}: missing" for name in sorted(missing))
    yield Table("Others, with the errors as quoted", columns, lines, notes)


def _theirs(scene: SimulatedScene, folder: Path, options: argparse.Namespace, missing: set[str]) -> dict[str, Pairs]:
    """What each of them claims, told the true densities."""
    from benchmarks.frames import nway

    area = (3600.0**2) * len(scene.first) / 2000.0
    n, n1, n2 = len(scene.true_pairs()[0]), len(scene.first), len(scene.second)
    densities = workload.Densities(n / area, (n1 - n) / area, (n2 - n) / area)
    arrays = workload.Arrays.load(workload.save(folder, scene, densities))
    claims: dict[str, Pairs] = {}
    if peers.PEERS["stilts"].version("") is None:
        missing.add("STILTS")
    else:
        claims["STILTS find=best, 3σ"] = peers.stilts_pairs(arrays)
    pairs = nway(arrays, scene, area, options.interpreters)
    if pairs is None:
        missing.add("NWAY")
    else:
        claims["NWAY, p > ½"] = pairs
    return claims


# ---- columns of one catalogue ----


@dataclass
class Counted:
    """What was claimed of all sets, and with which probabilities."""

    p: list[np.ndarray] = field(default_factory=list)
    right: list[np.ndarray] = field(default_factory=list)
    true: int = 0

    def add(self, claimed: Pairs, p: np.ndarray, made: Counterparts) -> None:
        """One set."""
        true = made.scene.true_pairs()
        self.p.append(p)
        self.right.append(is_true_pair(claimed, true))
        self.true += len(true[0])

    def line(self, least: float = 0.0) -> list[object]:
        """Found, wrong, expected wrong, and wrong beyond those in σ, of what is at least so probable."""
        p, right = np.concatenate(self.p), np.concatenate(self.right)
        kept = p > least
        wrong, expected = int((~right[kept]).sum()), float((1.0 - p[kept]).sum())
        spread = np.sqrt(max(float((p[kept] * (1.0 - p[kept])).sum()), 1.0))
        return [int(right[kept].sum()), wrong, expected, (wrong - expected) / spread]

    def least_for(self, found: int) -> float:
        """The least probability that keeps so many right claims."""
        p, right = np.concatenate(self.p), np.concatenate(self.right)
        order = np.argsort(-p)
        place = int(np.searchsorted(np.cumsum(right[order]), found))
        return float(p[order][min(place, len(p) - 1)]) - 1e-12


def columns(options: argparse.Namespace) -> Iterator[Table]:
    """Counterparts of sources with wide errors: columns of the deep catalogue as evidence, beside NWAY."""
    ours: dict[str, Counted] = {}
    theirs: Counted | None = None
    told: dict[str, list[str]] = {}
    for number in range(options.sets):
        made = counterparts(np.random.default_rng([16, number + 1]))
        scene = made.scene
        magnitude = Column(2, made.magnitude, name="MAG")
        noise = Column(2, made.noise, name="noise")
        more = [Column(2, made.colour, name="colour"), Column(2, made.kind, name="kind"), noise]
        ways: dict[str, list[Column | Related]] = {
            "positions": [], "MAG": [magnitude], "noise": [noise], "MAG, colour, kind, noise": [magnitude, *more],
            "MAG and its relation to flux": [Related(made.flux, made.magnitude, ("flux", "MAG"))],
        }  # fmt: skip
        for name, evidence in ways.items():
            answer, estimate = match(scene.first, scene.second, evidence=evidence)
            found = answer.matches
            ours.setdefault(name, Counted()).add((found.rows_1, found.rows_2), found.p_match, made)
            if estimate.columns is not None:
                silent = [one.name for one in estimate.columns.findings if not one.tells]
                told.setdefault(name, []).append(",".join(silent) or "none")
        pairs = _counterparts_of_nway(made, options)
        if pairs is not None:
            theirs = theirs or Counted()
            theirs.add(*pairs, made)
    true = ours["MAG"].true
    lines: list[list[object]] = [[f"sameas, {name}", "all", true, *counted.line()] for name, counted in ours.items()]
    if theirs is not None:
        for least in (0.0, 0.25, 0.5):
            theirs_line = theirs.line(least)
            lines.append(["NWAY, MAG auto", f"p > {least:g}" if least else "all", true, *theirs_line])
            same = ours["MAG"].least_for(int(theirs_line[0]))  # type: ignore[call-overload]
            lines.append(["sameas, MAG, as many found", f"p > {same:.2f}", true, *ours["MAG"].line(same)])
    notes = [f"said to tell nothing, set by set: {name}: {'; '.join(silent)}" for name, silent in told.items()]
    names = ("by", "kept", "true pairs", "found", "wrong", "expected wrong", "off, σ")
    yield Table(
        f"Counterparts: {options.sets} sets of 1 500 sources with errors of 1–2″ among 241 000 records, λ 0.3",
        names, lines, (*notes, *(() if theirs else ("NWAY: missing",))),
    )  # fmt: skip


def _counterparts_of_nway(made: Counterparts, options: argparse.Namespace) -> tuple[Pairs, np.ndarray] | None:
    """NWAY's counterparts and their probabilities, told the true area and completeness; None where it is missing."""
    area = made.area_arcsec2
    n, n1, n2 = len(made.scene.true_pairs()[0]), len(made.scene.first), len(made.scene.second)
    with tempfile.TemporaryDirectory(prefix="sameas-bench-") as name:
        densities = workload.Densities(n / area, (n1 - n) / area, (n2 - n) / area)
        folder = workload.save(Path(name) / "scene", made.scene, densities)
        np.save(folder / "magnitude.npy", made.magnitude)
        found = options.interpreters.nway("nway_counterparts", folder, area / 3600.0**2, n / n1)
    if found is None:
        return None
    row_1, row_2, p_any, p_i = found
    return (row_1.astype(np.int64), row_2.astype(np.int64)), p_any * p_i


# ---- blends ----


def blended(options: argparse.Namespace) -> Iterator[Table]:
    """Fields like WISE's on Gaia's: coarse records that are two objects, beside rules that know one only."""
    tallies: dict[str, Blended] = {}
    for number in range(options.fields):
        made = blended_field(np.random.default_rng([164, number]), objects=options.blend_objects)
        first, second = made.first, made.second
        answer, estimate = match(first, second)
        nearby = nearest(first, second), nearest(second, first)
        mutual = (nearby[1].rows[nearby[0].rows] == np.arange(len(first))) & (nearby[0].separation_arcsec < 3.0)
        one = np.full(len(first), -1)
        one[answer.matches.rows_1] = answer.matches.rows_2
        alone = np.full(len(first), -1)
        tallies.setdefault("mutual nearest, 3″", Blended()).add(np.where(mutual, nearby[0].rows, -1), alone, made)
        tallies.setdefault("sameas, one to one", Blended()).add(one, alone, made)
        for title, flux in (("sameas, blends", None), ("sameas, blends, fluxes told", made.flux)):
            found = find_blends(first, second, made.resolution_arcsec, errors=estimate.errors, flux=flux,
                                coverage=estimate.coverage)  # fmt: skip
            tallies.setdefault(title, Blended()).add(found.partner.filled(-1), found.other.filled(-1), made, found)
    columns = ("by", "records", "right", "blends", "found", "wrong", "missed", "p_blend expects", "off, σ", "not exact")
    yield Table(
        f"Blends: {options.fields} fields of {options.blend_objects} objects, 20 000 per deg², resolution 6″",
        columns, [[name, *tally.line()] for name, tally in tallies.items()],
        ("right: records whose answer, none, one or two objects, is the truth; found, wrong, missed: of blends",),
    )  # fmt: skip
    for title in ("sameas, blends", "sameas, blends, fluxes told"):
        judged = Judged(stated=tallies[title].p, happened=tallies[title].two)
        yield calibrated(judged, f"{title}: p_blend")


@dataclass
class Blended:
    """What was said of all fields' coarse records, and which of them are blends."""

    counts: np.ndarray = field(default_factory=lambda: np.zeros(6, np.int64))
    p: list[np.ndarray] = field(default_factory=list)
    two: list[np.ndarray] = field(default_factory=list)

    def add(self, partner: np.ndarray, other: np.ndarray, made: BlendedField, found: Blends | None = None) -> None:
        """One field."""
        right = (np.sort(np.column_stack([partner, other]), axis=1) == np.sort(made.parts, axis=1)).all(axis=1)
        two, said = np.all(made.parts >= 0, axis=1), other >= 0
        inexact = 0 if found is None else int((~found.exact).sum())
        self.counts += [len(two), right.sum(), two.sum(), (right & two).sum(), (said & ~right).sum(), inexact]
        if found is not None:
            self.p.append(found.p_blend)
            self.two.append(two)

    def line(self) -> list[object]:
        """Numbers, and how far the expected number of blends is off."""
        records, right, blends, found, wrong, inexact = map(int, self.counts)
        line: list[object] = [records, right, blends, found, wrong, blends - found]
        if not self.p:
            return [*line, "", "", ""]
        p = np.concatenate(self.p)
        return [*line, float(p.sum()), (blends - float(p.sum())) / np.sqrt(float((p * (1 - p)).sum())), inexact]


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """The sections that are asked for."""
    sections: dict[str, Callable[[], Iterator[Table]]] = {
        "floors": lambda: formal(FLOORS, "Floors", options),
        "scales": lambda: formal(SCALES, "Scales", options),
        "crowded": lambda: crowded(options),
        "growing": lambda: growing(options),
        "couples": lambda: couples(options),
        "others": lambda: others(options),
        "columns": lambda: columns(options),
        "blends": lambda: blended(options),
        "real": lambda: judged.tables(options),
    }
    for name in options.only:
        yield from sections[name]()


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench field", description=__doc__)
    parser.add_argument("--objects", type=int, default=400, help="objects of each kind of field (default 400)")
    parser.add_argument("--frames", type=int, default=8, help="crowded frames (default 8)")
    parser.add_argument("--side", type=float, default=0.05, help="side of a frame, degrees (default 0.05)")
    parser.add_argument("--peer-python", action="append", default=[], help="NAME=PYTHON, where a peer is installed")
    parser.add_argument("--sets", type=int, default=2, help="sets of counterparts (default 2)")
    parser.add_argument("--fields", type=int, default=4, help="fields with blends (default 4)")
    parser.add_argument("--blend-objects", type=int, default=4000, help="objects of each (default 4000)")
    every = ["floors", "scales", "crowded", "growing", "couples", "others", "columns", "blends", "real"]
    parser.add_argument("--only", nargs="+", default=every, choices=every)
    options = parser.parse_args()
    options.interpreters = peers.Interpreters.of(options.peer_python)
    report("field", tables(options))


if __name__ == "__main__":
    main()
