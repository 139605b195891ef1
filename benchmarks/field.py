"""Right, wrong and missed pairs of simulated catalogues whose errors are not as quoted, next to other programs.

`sameas.match` with everything estimated, in sections (--only): unquoted floors and scales of the errors with few and
many pairs; crowded frames; errors that grow with magnitude or position; couples of objects; columns as evidence;
blends; and real catalogues (``withheld.py``). Compared with mutual nearest at the radius that is best with the truth
known, partly with STILTS and NWAY. ``scripts/bench field``, 2 minutes.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks import peers, withheld, workload
from benchmarks.exposures import FrameAndCatalogue, Sky, exposure
from benchmarks.frames import Tally
from benchmarks.misstated import couples_field, formal_field, growing_field
from benchmarks.recovered import true_rule
from benchmarks.tables import Table, report
from sameas import Identification, Sphere, identify
from sameas.estimate.blends import Blends, find_blends
from sameas.estimate.gate_search import DEFAULT_MATCH
from sameas.estimate.match import match
from sameas.evidence import Column, Magnitudes, Related
from sameas.records import Records
from sameas.score.pairs import is_true_pair, reliability
from sameas.simulate.blends import BlendedField, blended_field
from sameas.simulate.catalogues import Counterparts, counterparts
from sameas.simulate.scenes import SimulatedScene
from sameas.sky.sky_match import nearest
from sameas.space import displaced

Pairs = tuple[np.ndarray, np.ndarray]
#: A pair, or a record's having no partner, is certain above this probability.
CERTAIN = 0.99
#: Fewest candidates in a bin of probability that is tested, and the targeted difference of its observed frequency.
MIN_BIN_COUNT, MAX_DIFFERENCE = 200, 0.03


@dataclass(frozen=True)
class Kind:
    """Fields of one kind. objects : number. floor : of the errors, arcsec. scale : true over quoted errors."""

    objects: int
    floor: float = 0.0
    scale: float = 1.0

    def fields(self, options: argparse.Namespace) -> Iterator[SimulatedScene]:
        """At least two, together about ``options.objects`` objects."""
        for number in range(max(2, options.objects // self.objects)):
            rng = np.random.default_rng([162, self.objects, round(1000 * self.floor), round(1000 * self.scale), number])
            yield formal_field(rng, self.objects, floor_arcsec=self.floor, scale=self.scale)


#: Unquoted floors of the errors, and errors quoted too large or too small by a factor.
FLOORS = [Kind(objects, floor) for objects in (20, 40, 100, 200, 1000) for floor in (0.0, 0.05, 0.15, 0.5)]
SCALES = [Kind(objects, 0.0, scale) for objects in (20, 60, 200, 1000) for scale in (0.3, 2.0, 4.0, 16.0)]


@dataclass
class Score:
    """Counts over all fields of one kind.

    certain : records with a true partner and p_none > ``CERTAIN``. expected, variance : of the number of wrong pairs.
    """

    true: int = 0
    found: int = 0
    wrong: int = 0
    certain: int = 0
    expected: float = 0.0
    variance: float = 0.0
    stated: list[np.ndarray] = field(default_factory=list)
    is_true: list[np.ndarray] = field(default_factory=list)

    def add(self, answer: Identification, scene: SimulatedScene) -> None:
        """Add one field."""
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
        self.is_true.append(is_true_pair((answer.rows_1, answer.rows_2), true))

    @property
    def missed(self) -> int:
        """Number of true pairs that were not found."""
        return self.true - self.found

    @property
    def deviation(self) -> float:
        """Wrong pairs minus expected ones, in standard deviations (of at least one pair)."""
        return (self.wrong - self.expected) / np.sqrt(max(self.variance, 1.0))


@dataclass
class MutualNearest:
    """Mutual nearest neighbours of all fields of one kind, within the radius that is best with the truth known."""

    separation: list[np.ndarray] = field(default_factory=list)
    right: list[np.ndarray] = field(default_factory=list)
    true: int = 0

    def add(self, scene: SimulatedScene) -> None:
        """Add one field."""
        forward, backward = nearest(scene.first, scene.second), nearest(scene.second, scene.first)
        mutual = np.flatnonzero(backward.rows[forward.rows] == np.arange(len(forward.rows)))
        true = scene.true_pairs()
        self.add_pairs(forward.separation_arcsec[mutual], is_true_pair((mutual, forward.rows[mutual]), true))
        self.true += len(true[0])

    def add_pairs(self, separation: np.ndarray, right: np.ndarray) -> None:
        """Add the mutual pairs of one field: (k,) separation in arcsec, and whether they are true."""
        self.separation.append(separation)
        self.right.append(right)

    def best(self) -> tuple[float, int, int]:
        """The radius with fewest wrong and missed pairs, and the numbers of right and wrong pairs within it."""
        order = np.argsort(np.concatenate(self.separation))
        separation, right = np.concatenate(self.separation)[order], np.concatenate(self.right)[order]
        found = np.concatenate([[0], np.cumsum(right)])
        wrong = np.arange(len(found)) - found
        best = int(np.argmin(wrong - found))
        return float(separation[best - 1]) if best else 0.0, int(found[best]), int(wrong[best])


def formal(kinds: list[Kind], title: str, options: argparse.Namespace) -> Iterator[Table]:
    """One row per kind of field; then the calibration over all of them."""
    lines, total, worse = [], Score(), []
    for kind in kinds:
        score, mutual = Score(), MutualNearest()
        for scene in kind.fields(options):
            score.add(match(scene.first, scene.second)[0], scene)
            mutual.add(scene)
        radius, found, wrong = mutual.best()
        loss, loss_of_mutual = score.wrong + score.missed, wrong + score.true - found
        if loss > loss_of_mutual:
            label = f"{kind.objects} objects, floor {kind.floor:g}″, scale {kind.scale:g}"
            worse.append(f"{label}: {loss}, {loss_of_mutual}")
        lines.append([
            kind.objects, kind.floor, kind.scale, score.true, score.found, score.wrong, score.missed, score.certain,
            score.expected, score.deviation, radius, found, wrong, score.true - found,
        ])  # fmt: skip
        total.stated += score.stated
        total.is_true += score.is_true
    columns = (
        "objects", "floor ″", "scale", "true pairs", "found", "wrong", "missed", "none, p > .99", "expected wrong",
        "difference, σ", "mutual: best ″", "found", "wrong", "missed",
    )  # fmt: skip
    deviation = max(abs(float(line[9])) for line in lines)
    yield Table(title, columns, lines, (
        f"more wrong and missed pairs than mutual nearest at its best radius: {'; '.join(worse) or 'nowhere'}",
        f"wrong beyond expected: at most {deviation:.1f} σ",
        "none: records with a true partner and p_none > 0.99; σ of at least one pair",
    ))  # fmt: skip
    yield calibration(total, title)


def calibration(score: Score, title: str) -> Table:
    """Stated probabilities of candidates and observed frequencies."""
    bins = reliability(np.concatenate(score.stated), np.concatenate(score.is_true))
    rows = [
        [float(p), float(f), int(n), float(f - p)]
        for p, f, n in zip(bins.stated, bins.observed, bins.count, strict=True)
    ]
    worst = max((abs(row[3]) for row in rows if row[2] >= MIN_BIN_COUNT), default=0.0)
    note = f"largest difference in a bin of {MIN_BIN_COUNT} or more: {worst:.3f} (target: ≤ {MAX_DIFFERENCE:g})"
    return Table(f"{title}: calibration", ("stated", "observed", "candidates", "difference"), rows, (note,))


# ---- crowded frames with an unquoted floor ----

FLOOR_ARCSEC = 0.1
#: Photon noise: errors of bright stars close to zero, in the frame and in a catalogue five years older.
PHOTON = Sky(
    stars_per_deg2=1_200_000.0,
    catalogue_sigma_arcsec=(0.002, 0.05), motion_sigma_mas_per_yr=(0.05, 1.0), unknown_motion=0.0, gap_yr=5.0,
    frame_sigma_arcsec=(0.005, 0.2),
)  # fmt: skip


def with_floor(rng: np.random.Generator, simulated: FrameAndCatalogue) -> tuple[FrameAndCatalogue, FrameAndCatalogue]:
    """The frame with an error floor that its errors do not include; the same with errors that do."""
    first = simulated.scene.first
    displaced_first = replace(
        first, features=displaced(first.features, FLOOR_ARCSEC * rng.standard_normal((len(first), 2)))
    )
    full = displaced_first.full_covariance() + FLOOR_ARCSEC**2 * np.eye(2)
    with_quoted_floor = Records.of(
        displaced_first.features, covariance=full, space=Sphere(), source=displaced_first.source
    )
    return (
        replace(simulated, scene=replace(simulated.scene, first=displaced_first)),
        replace(simulated, scene=replace(simulated.scene, first=with_quoted_floor)),
    )


def crowded(options: argparse.Namespace) -> Iterator[Table]:
    """Crowded frames: positions alone and magnitudes, with the floor quoted or not."""
    tallies: dict[tuple[str, str], Tally] = {}
    floors: list[float] = []
    for number in range(options.frames):
        rng = np.random.default_rng([163, number])
        simulated = exposure(rng, PHOTON, side_deg=options.side)
        unquoted, quoted = with_floor(rng, simulated)
        for title, case in (("as quoted", simulated), (f"floor of {FLOOR_ARCSEC:g}″, quoted", quoted),
                            (f"floor of {FLOOR_ARCSEC:g}″, not quoted", unquoted)):  # fmt: skip
            first, second = case.scene.first, case.scene.second
            if case is not unquoted:
                with_truth = identify(first, second, rule=true_rule(case))
                tallies.setdefault((title, "true parameters"), Tally()).add_answer(with_truth, case.scene)
            answer, estimate = match(first, second)
            tallies.setdefault((title, "all estimated, positions"), Tally()).add_answer(answer, case.scene)
            if case is unquoted:
                floors.append(getattr(estimate.errors, "floor", float("nan")))
            answer, _ = match(first, second, brightness=case.brightness)
            tallies.setdefault((title, "all estimated, two bands"), Tally()).add_answer(answer, case.scene)
    lines = [[*names, *tally.line()[:3], tally.line()[6], tally.line()[7]] for names, tally in tallies.items()]
    columns = ("errors", "by", "claimed", "wrong", "±", "expected wrong", "ECE")
    floor = f"estimated floor: {np.mean(floors):.4f} ± {np.std(floors):.4f}″"
    yield Table(f"Crowded frames: {options.frames} of {options.side:g}°", columns, lines, (floor,))


# ---- errors that grow, couples, other programs ----


#: True errors in arcsec, all quoted as 0.1″, by magnitude and distance from the centre over that of a corner.
GROWING: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "as quoted": lambda magnitude, distance: np.full(len(magnitude), 0.1),
    "faint 0.4″, bright 0.02″": lambda magnitude, distance: np.hypot(0.02, 0.4 * 10.0 ** (0.3 * (magnitude - 22.0))),
    "bright 0.5″, others 0.1″": lambda magnitude, distance: np.where(magnitude < 19.0, 0.5, 0.1),
    "centre 0.05″, corners 0.65″": lambda magnitude, distance: 0.05 + 0.6 * distance**2,
}


def growing(options: argparse.Namespace) -> Iterator[Table]:
    """Errors that grow with magnitude or position, all quoted as 0.1″: one error for all, a fitted trend, the truth."""
    lines: list[list[object]] = []
    for name, law in GROWING.items():
        tallies: dict[str, Tally] = {}
        mutual = MutualNearest()
        for number in range(options.fields):
            scene, (one, two), errors = growing_field(np.random.default_rng([7, number]), 3000, law)
            true_errors = replace(scene.second, covariance=errors[:, None] ** 2)
            mutual.add(scene)
            for by, brightness in (("positions", None), ("magnitudes", (Magnitudes(one), Magnitudes(two)))):
                for how, second, trends in (("one error for all", scene.second, False), ("sameas", scene.second, True),
                                            ("true errors given", true_errors, False)):  # fmt: skip
                    tuning = replace(DEFAULT_MATCH, fits_trends=trends)
                    answer, _ = match(scene.first, second, brightness=brightness, tuning=tuning)
                    tallies.setdefault(f"{by}, {how}", Tally()).add_answer(answer, scene)
        for title, tally in tallies.items():
            claimed, wrong, error = tally.line()[:3]
            lines.append([name, title, claimed, wrong, error, tally.line()[6], tally.line()[7]])
        radius, found, wrong = mutual.best()
        lines.append([name, f"mutual nearest within {radius:.2g}″", found + wrong, wrong, None, None, None])
    columns = ("errors, all quoted 0.1″", "by", "claimed", "wrong", "±", "expected wrong", "ECE")
    yield Table(f"Errors that grow: {options.fields} fields of 3 000 objects each", columns, lines)


#: Fields with couples: objects, share in couples, separation over a record's σ, share that either source misses.
COUPLES = [
    *((400, share, separation, missing) for share in (0.3, 1.0) for separation in (0.1, 0.5, 1.0, 2.0, 5.0, 20.0)
      for missing in (0.0, 0.2, 0.4)),
    (100, 0.3, 2.0, 0.3), (5000, 0.1, 2.0, 0.3), (400, 0.0, 0.0, 0.3),
]  # fmt: skip


def couples(options: argparse.Namespace) -> Iterator[Table]:
    """Objects closer to each other than in a Poisson field, with and without the estimate of companions."""
    lines: list[list[object]] = []
    for objects, share, separation, missing in COUPLES:
        tunings = {
            "sameas": DEFAULT_MATCH,
            "no companions": replace(DEFAULT_MATCH, em=replace(DEFAULT_MATCH.em, companions=False)),
        }
        scores, certain_counts = {method: Score() for method in tunings}, dict.fromkeys(tunings, (0, 0))
        mutual = MutualNearest()
        for number in range(max(1, 3 * options.objects // objects)):
            seed = [163, objects, round(100 * share), round(10 * separation), round(100 * missing), number]
            scene = couples_field(
                np.random.default_rng(seed), objects, share=share, separation=separation, missing=missing
            )
            mutual.add(scene)
            for method, tuning in tunings.items():
                answer, _ = match(scene.first, scene.second, tuning=tuning)
                scores[method].add(answer, scene)
                matches = answer.matches
                right = is_true_pair((matches.rows_1, matches.rows_2), scene.true_pairs())
                certain = matches.p_match > CERTAIN
                n, n_wrong = certain_counts[method]
                certain_counts[method] = n + int(certain.sum()), n_wrong + int((certain & ~right).sum())
        _, found, wrong = mutual.best()
        line: list[object] = [objects, share, separation, missing, scores["sameas"].true]
        for method, score in scores.items():
            line += [score.found, score.wrong, score.expected, *certain_counts[method]]
        lines.append([*line, found, wrong])
    heads = ("right", "wrong", "expected wrong", "certain", "wrong of these")
    columns = ("objects", "in couples", "separation, σ", "missed", "true pairs", *heads,
               *(f"no companions: {name}" for name in heads), "mutual: right", "wrong")  # fmt: skip
    yield Table("Couples of objects", columns, lines)


def others(options: argparse.Namespace) -> Iterator[Table]:
    """STILTS and NWAY on some of the same fields, with the errors as quoted."""
    lines: list[list[object]] = []
    missing: set[str] = set()
    for kind in (Kind(200, 0.0), Kind(200, 0.15), Kind(200, 0.5), Kind(200, 0.0, 4.0)):
        scene = next(kind.fields(options))
        true = scene.true_pairs()
        matches = match(scene.first, scene.second)[0].matches
        claims: dict[str, Pairs] = {"sameas": (matches.rows_1, matches.rows_2)}
        with tempfile.TemporaryDirectory(prefix="sameas-bench-") as name:
            claims |= _other_claims(scene, Path(name) / "scene", options, missing)
        for by, claimed in claims.items():
            right = int(is_true_pair(claimed, true).sum())
            lines.append([kind.objects, kind.floor, kind.scale, by, len(true[0]), right, len(claimed[0]) - right])
    columns = ("objects", "floor ″", "scale", "by", "true pairs", "found", "wrong")
    notes = tuple(f"{name}: missing" for name in sorted(missing))
    yield Table("Other programs, with the errors as quoted", columns, lines, notes)


def _other_claims(
    scene: SimulatedScene, folder: Path, options: argparse.Namespace, missing: set[str]
) -> dict[str, Pairs]:
    """The pairs of STILTS and NWAY; NWAY is given the true densities. Missing programs are added to ``missing``."""
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
class ClaimScore:
    """The claimed pairs of all sets with their probabilities."""

    p: list[np.ndarray] = field(default_factory=list)
    right: list[np.ndarray] = field(default_factory=list)
    true: int = 0

    def add(self, claimed: Pairs, p: np.ndarray, simulated: Counterparts) -> None:
        """Add one set."""
        true = simulated.scene.true_pairs()
        self.p.append(p)
        self.right.append(is_true_pair(claimed, true))
        self.true += len(true[0])

    def line(self, min_p: float = 0.0) -> list[object]:
        """Found, wrong, expected wrong, and their difference in σ, of the claims with p > ``min_p``."""
        p, right = np.concatenate(self.p), np.concatenate(self.right)
        kept = p > min_p
        wrong, expected = int((~right[kept]).sum()), float((1.0 - p[kept]).sum())
        spread = np.sqrt(max(float((p[kept] * (1.0 - p[kept])).sum()), 1.0))
        return [int(right[kept].sum()), wrong, expected, (wrong - expected) / spread]

    def threshold_for(self, found: int) -> float:
        """The highest threshold on p that keeps this many right claims."""
        p, right = np.concatenate(self.p), np.concatenate(self.right)
        order = np.argsort(-p)
        rank = int(np.searchsorted(np.cumsum(right[order]), found))
        return float(p[order][min(rank, len(p) - 1)]) - 1e-12


def columns(options: argparse.Namespace) -> Iterator[Table]:
    """Counterparts of sources with large errors, columns of the deep catalogue as evidence; and NWAY."""
    by_columns: dict[str, ClaimScore] = {}
    of_nway: ClaimScore | None = None
    uninformative: dict[str, list[str]] = {}
    for number in range(options.sets):
        simulated = counterparts(np.random.default_rng([16, number + 1]))
        scene = simulated.scene
        magnitude = Column(2, simulated.magnitude, name="MAG")
        noise = Column(2, simulated.noise, name="noise")
        other_columns = [Column(2, simulated.colour, name="colour"), Column(2, simulated.kind, name="kind"), noise]
        ways: dict[str, list[Column | Related]] = {
            "positions": [], "MAG": [magnitude], "noise": [noise],
            "MAG, colour, kind, noise": [magnitude, *other_columns],
            "MAG and its relation to flux": [Related(simulated.flux, simulated.magnitude, ("flux", "MAG"))],
        }  # fmt: skip
        for name, evidence in ways.items():
            answer, estimate = match(scene.first, scene.second, evidence=evidence)
            found = answer.matches
            by_columns.setdefault(name, ClaimScore()).add((found.rows_1, found.rows_2), found.p_match, simulated)
            if estimate.columns is not None:
                without = [one.name for one in estimate.columns.findings if not one.used]
                uninformative.setdefault(name, []).append(",".join(without) or "none")
        pairs = _counterparts_of_nway(simulated, options)
        if pairs is not None:
            of_nway = of_nway or ClaimScore()
            of_nway.add(*pairs, simulated)
    true = by_columns["MAG"].true
    lines: list[list[object]] = [[f"sameas, {name}", "all", true, *score.line()] for name, score in by_columns.items()]
    if of_nway is not None:
        for min_p in (0.0, 0.25, 0.5):
            line = of_nway.line(min_p)
            lines.append(["NWAY, MAG auto", f"p > {min_p:g}" if min_p else "all", true, *line])
            threshold = by_columns["MAG"].threshold_for(int(line[0]))  # type: ignore[call-overload]
            lines.append(
                ["sameas, MAG, as many found", f"p > {threshold:.2f}", true, *by_columns["MAG"].line(threshold)]
            )
    notes = [f"uninformative, set by set: {name}: {'; '.join(sets)}" for name, sets in uninformative.items()]
    names = ("by", "kept", "true pairs", "found", "wrong", "expected wrong", "difference, σ")
    yield Table(
        f"Counterparts: {options.sets} sets of 1 500 sources with errors of 1–2″ among 241 000 records, λ 0.3",
        names, lines, (*notes, *(() if of_nway else ("NWAY: missing",))),
    )  # fmt: skip


def _counterparts_of_nway(simulated: Counterparts, options: argparse.Namespace) -> tuple[Pairs, np.ndarray] | None:
    """NWAY's counterparts and their probabilities, given the true area and completeness; None if it is missing."""
    area = simulated.area_arcsec2
    n, n1, n2 = len(simulated.scene.true_pairs()[0]), len(simulated.scene.first), len(simulated.scene.second)
    with tempfile.TemporaryDirectory(prefix="sameas-bench-") as name:
        densities = workload.Densities(n / area, (n1 - n) / area, (n2 - n) / area)
        folder = workload.save(Path(name) / "scene", simulated.scene, densities)
        np.save(folder / "magnitude.npy", simulated.magnitude)
        found = options.interpreters.nway("nway_counterparts", folder, area / 3600.0**2, n / n1)
    if found is None:
        return None
    row_1, row_2, p_any, p_i = found
    return (row_1.astype(np.int64), row_2.astype(np.int64)), p_any * p_i


# ---- blends ----


def blended(options: argparse.Namespace) -> Iterator[Table]:
    """Coarse records that may be two objects, as of WISE against Gaia; next to one-to-one matching."""
    scores: dict[str, BlendScore] = {}
    for number in range(options.fields):
        simulated = blended_field(np.random.default_rng([164, number]), objects=options.blend_objects)
        first, second = simulated.first, simulated.second
        answer, estimate = match(first, second)
        forward, backward = nearest(first, second), nearest(second, first)
        mutual = (backward.rows[forward.rows] == np.arange(len(first))) & (forward.separation_arcsec < 3.0)
        one_to_one = np.full(len(first), -1)
        one_to_one[answer.matches.rows_1] = answer.matches.rows_2
        no_second = np.full(len(first), -1)
        scores.setdefault("mutual nearest, 3″", BlendScore()).add(
            np.where(mutual, forward.rows, -1), no_second, simulated
        )
        scores.setdefault("sameas, one to one", BlendScore()).add(one_to_one, no_second, simulated)
        for title, flux in (("sameas, blends", None), ("sameas, blends, fluxes given", simulated.flux)):
            found = find_blends(first, second, simulated.resolution_arcsec, errors=estimate.errors, flux=flux,
                                coverage=estimate.coverage)  # fmt: skip
            scores.setdefault(title, BlendScore()).add(
                found.partner.filled(-1), found.other.filled(-1), simulated, found
            )
    columns = ("by", "records", "right", "blends", "found", "wrong", "missed", "expected", "difference, σ", "not exact")
    yield Table(
        f"Blends: {options.fields} fields of {options.blend_objects} objects, 20 000 per deg², resolution 6″",
        columns, [[name, *score.line()] for name, score in scores.items()],
        ("right: records with the true objects (none, one or two); found to expected: blends; expected: Σ p_blend",),
    )  # fmt: skip
    for title in ("sameas, blends", "sameas, blends, fluxes given"):
        yield calibration(Score(stated=scores[title].p, is_true=scores[title].is_blend), f"{title}: p_blend")


@dataclass
class BlendScore:
    """Counts and probabilities of the coarse records of all fields.

    counts : records, right, blends, found, wrong, not exact.
    """

    counts: np.ndarray = field(default_factory=lambda: np.zeros(6, np.int64))
    p: list[np.ndarray] = field(default_factory=list)
    is_blend: list[np.ndarray] = field(default_factory=list)

    def add(self, partner: np.ndarray, other: np.ndarray, simulated: BlendedField, found: Blends | None = None) -> None:
        """Add one field: (n,) rows of both objects of each record, −1 for none."""
        right = (np.sort(np.column_stack([partner, other]), axis=1) == np.sort(simulated.parts, axis=1)).all(axis=1)
        is_blend, claimed = np.all(simulated.parts >= 0, axis=1), other >= 0
        inexact = 0 if found is None else int((~found.exact).sum())
        self.counts += [
            len(is_blend), right.sum(), is_blend.sum(), (right & is_blend).sum(), (claimed & ~right).sum(), inexact
        ]  # fmt: skip
        if found is not None:
            self.p.append(found.p_blend)
            self.is_blend.append(is_blend)

    def line(self) -> list[object]:
        """The counts, the expected number of blends, and the difference from it in σ."""
        records, right, blends, found, wrong, inexact = map(int, self.counts)
        line: list[object] = [records, right, blends, found, wrong, blends - found]
        if not self.p:
            return [*line, "", "", ""]
        p = np.concatenate(self.p)
        return [*line, float(p.sum()), (blends - float(p.sum())) / np.sqrt(float((p * (1 - p)).sum())), inexact]


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """The tables of the selected sections."""
    sections: dict[str, Callable[[], Iterator[Table]]] = {
        "floors": lambda: formal(FLOORS, "Floors", options),
        "scales": lambda: formal(SCALES, "Scales", options),
        "crowded": lambda: crowded(options),
        "growing": lambda: growing(options),
        "couples": lambda: couples(options),
        "others": lambda: others(options),
        "columns": lambda: columns(options),
        "blends": lambda: blended(options),
        "real": lambda: withheld.tables(options),
    }
    for name in options.only:
        yield from sections[name]()


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench field", description=__doc__)
    parser.add_argument("--objects", type=int, default=400, help="objects of each kind of field (default 400)")
    parser.add_argument("--frames", type=int, default=8, help="crowded frames (default 8)")
    parser.add_argument("--side", type=float, default=0.05, help="side of a frame, degrees (default 0.05)")
    parser.add_argument("--peer-python", action="append", default=[], help="NAME=PYTHON: the interpreter of a peer")
    parser.add_argument("--sets", type=int, default=2, help="sets of counterparts (default 2)")
    parser.add_argument("--fields", type=int, default=4, help="fields with blends (default 4)")
    parser.add_argument("--blend-objects", type=int, default=4000, help="objects of each (default 4000)")
    sections = ["floors", "scales", "crowded", "growing", "couples", "others", "columns", "blends", "real"]
    parser.add_argument("--only", nargs="+", default=sections, choices=sections)
    options = parser.parse_args()
    options.interpreters = peers.Interpreters.of(options.peer_python)
    report("field", tables(options))


if __name__ == "__main__":
    main()
