"""What is not known in advance, estimated from the data: densities, shares in common, the spread of the errors.

Identification and maximum likelihood take turns, with every pair weighted by its posterior (METHOD 6), until the
expected number of common objects settles:

- the local densities of common objects and of records that only one source shows (``coverage.py``);
- how residuals spread about the quoted errors: a mixture of normals over a ladder of error scales, whose shares have
  one maximum of the likelihood, so that errors quoted too small and heavy tails come out of the same estimate;
- where magnitudes are given, how those of one source follow the other's, and how the shares in common depend on them
  (``photometry.py``);
- how wide the gate must be: it opens while its outermost part still holds true pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sameas.assignment import assign
from sameas.coverage import Coverage
from sameas.detection import DetectionCurve
from sameas.error_model import ErrorModel, error_model
from sameas.errors import InputError
from sameas.evidence import Brightness, Errors, Magnitudes, PoissonField, Rule
from sameas.gate import ChiSquare, Pairs, Radius
from sameas.groups import groups
from sameas.identify import identify
from sameas.photometry import Lesson, Photometry
from sameas.posterior import by_messages
from sameas.prior import PerPair
from sameas.quantity import Quantity, changed_without, decisive, quantities
from sameas.records import FloatArray, Records
from sameas.result import Identification

#: Steps of the ladder of error scales, as a factor; enough for any smooth spread to be mixed from them.
RUNG = 1.5
#: The gate opens when this share of the expected true pairs lies beyond 0.7 of its radius (honest errors: 4e-5).
OPENING = 6e-5
WIDEST_SIGMAS = 400.0
#: The gate does not open for a tail when a record would have more candidates by chance than this, on average,
CROWDED = 0.5
#: nor for errors that are quoted too small when it would have more than this.
MOST_CROWDED = 8.0
#: Errors this many times too small are always thought of.
THINKABLE = 3.4
#: Least share of records that only one source shows.
LEAST_SHARE = 1e-6
#: EM of the shares of the scales stops at steps smaller than this.
SETTLED_SHARES = 1e-6
#: Standard deviations by which close candidates must exceed what chance gives, for their errors to be judged.
SIGNIFICANT = 4.0
#: Chance candidates within √2 of its scale that a component of the errors may hold, times two.
FILLED = 0.15
#: Fewer expected pairs than this say too little of the errors; the quoted ones are then believed.
FEWEST = 50.0
#: Rounds by positions alone before magnitudes are learned from, and rounds with them at least.
POSITIONS_FIRST, WITH_BRIGHTNESS = 2, 3
BRIGHTNESS_TERMS = ("completeness", "brightness")


@dataclass(frozen=True)
class Estimate:
    """What was found, and how.

    Attributes
    ----------
    common, share_1, share_2 : expected number of common objects, and what share of the covered records they are.
    errors : the spread of the residuals about their quoted covariances.
    gate_sigmas : radius of the gate, in quoted standard deviations.
    coverage : where both look.
    rounds, settled : rounds of identification, and whether they settled.
    notes : what a user should know.
    quantities : everything that is a number, by name, with its standard error; see ``sameas.quantity.quantities``.
    detection_1, detection_2 : share of each source's records that the other shows, by magnitude; None without.
    photometry : how the magnitudes of both sources are related, None where they were not given or told nothing.
    decisive : median absolute value of each term of the evidence over the identified pairs.
    changed_by_brightness : records of source 1 that positions alone would identify otherwise.
    error_model : which source's errors are too small, where that can be told; None where errors were not judged.
    """

    common: float
    share_1: float
    share_2: float
    errors: Errors
    gate_sigmas: float
    coverage: Coverage
    rounds: int
    settled: bool
    notes: tuple[str, ...] = field(default=())
    quantities: Mapping[str, Quantity] = field(default_factory=dict)
    detection_1: DetectionCurve | None = None
    detection_2: DetectionCurve | None = None
    photometry: Photometry | None = None
    decisive: Mapping[str, float] = field(default_factory=dict)
    changed_by_brightness: int = 0
    error_model: ErrorModel | None = None

    @property
    def typical_scale(self) -> float:
        """The factor by which the quoted errors must be multiplied for the typical pair."""
        return self.errors.typical_scale


def match(
    first: Records,
    second: Records,
    *,
    errors: Errors | None = None,
    gate: ChiSquare | Radius | None = None,
    density: tuple[float, float] | None = None,
    brightness: tuple[Magnitudes, Magnitudes] | None = None,
    rounds: int = 30,
    progress: Callable[[str], None] = lambda stage: None,
) -> tuple[Identification, Estimate]:
    """Identify two sources of which nothing is known but their records, and say what was estimated.

    Parameters
    ----------
    errors : the spread of the residuals; estimated if not given. ``Errors()`` believes the quoted errors.
    gate : the gate; if not given, as wide as the errors turn out to need.
    density : (ρ₁, ρ₂) of all records of each source per (residual unit)^d, instead of local ones from the data.
    brightness : magnitudes of every row of both tables, which are then evidence too; None leaves it to the positions.
    rounds : at most so many rounds of identification.
    progress : called with the name of what is being done.
    """
    for records in (first, second):
        if not len(records):
            raise InputError(f"{records.source} has no usable records; nothing can be identified")
    progress("densities")
    coverage = Coverage.of(first, second)
    loop = _Loop(first, second, coverage, errors, density, _photometry(first, second, brightness))
    answer, limit, total, settled = loop.open(gate, rounds, progress)
    if loop.learned and not _stands_out(answer.pairs, limit):
        loop = _Loop(first, second, coverage, errors or Errors(), density, None)
        answer, limit, more, settled = loop.open(gate, max(rounds - total, 5), progress)
        total += more
        believed = "the quoted errors" if brightness is None else "positions and quoted errors alone"
        loop.remarks.append(f"close candidates do not exceed what chance gives; {believed} are believed")
    return answer, _told(answer, loop, limit, total, settled)


def _photometry(first: Records, second: Records, brightness: tuple[Magnitudes, Magnitudes] | None) -> Photometry | None:
    if brightness is None:
        return None
    one, two = brightness
    return Photometry.of((one.of(first), two.of(second)), (one.names, two.names))


def _told(answer: Identification, loop: _Loop, limit: float, rounds: int, settled: bool) -> Estimate:
    """What the loop found, as it stands in its last identification."""
    common, coverage = float(answer.p_pair.sum()), loop.coverage
    seen_1, seen_2 = (max(int(np.count_nonzero(seen)), 1) for seen in coverage.covered)
    judged = loop.learns_errors and common >= FEWEST
    photometry = loop.photometry if loop.brightness() is not None else None
    curves = (None, None) if photometry is None else photometry.detection(answer, coverage)
    return Estimate(
        common, min(1.0, common / seen_1), min(1.0, common / seen_2), loop.errors, limit, coverage, rounds, settled,
        loop.notes(answer, settled), quantities(answer, coverage, photometry, errors=judged), *curves, photometry,
        decisive(answer), 0 if photometry is None else changed_without(answer, BRIGHTNESS_TERMS),
        error_model(answer) if judged else None,
    )  # fmt: skip


def _default_radius(d: int) -> float:
    """Radius of the default gate in d features, in standard deviations."""
    return math.sqrt(ChiSquare().limit(d))


def _stands_out(pairs: Pairs, limit: float) -> bool:
    """Whether the inner half of the gate holds more candidates than its outer part, at chance, lets expect."""
    inner = int(np.count_nonzero(pairs.mahalanobis_sq < (0.5 * limit) ** 2))
    share = 1.0 / (2.0**pairs.d - 1.0)
    outer = (len(pairs) - inner) * share
    return inner - outer > SIGNIFICANT * math.sqrt(inner + outer * share)


class _Loop:
    """Identification and estimation in turn, for one gate after another."""

    def __init__(
        self,
        first: Records,
        second: Records,
        coverage: Coverage,
        errors: Errors | None,
        density: tuple[float, float] | None,
        photometry: Photometry | None,
    ) -> None:
        self.first, self.second, self.coverage = first, second, coverage
        self.given = density
        self.learns_errors = errors is None
        self.errors = self.first_errors = errors or Errors()
        self.photometry = photometry
        self.lessons = 0
        self.remarks: list[str] = []
        # Half of the poorer source is taken to be common, to begin with.
        guess = 0.5 * min(len(first), len(second))
        self.p_1 = np.full(len(first), guess / len(first))
        self.p_2 = np.full(len(second), guess / len(second))

    def open(
        self, gate: ChiSquare | Radius | None, rounds: int, progress: Callable[[str], None]
    ) -> tuple[Identification, float, int, bool]:
        """Rounds with one gate after another, each twice as wide as the one before, until it is wide enough.

        Returns the answer, the radius of the last gate, the number of rounds, and whether they settled.
        """
        limit, total = _default_radius(self.first.d), 0
        while True:
            progress("gate")
            pairs = (gate or Radius(limit))(self.first, self.second)
            answer, done, settled = self.run(pairs, rounds - total, progress)
            total += done
            if gate is not None or total >= rounds or not self.must_open(answer, limit):
                return answer, limit, total, settled
            limit = min(2.0 * limit, WIDEST_SIGMAS)

    def run(self, pairs: Pairs, rounds: int, progress: Callable[[str], None]) -> tuple[Identification, int, bool]:
        """Rounds over one list of candidates: the exact answer at the end, how many rounds, whether they settled.

        Within the rounds only sums over many pairs are needed; messages are near enough for those.
        """
        grouped = groups(pairs)
        if self.photometry is not None:
            self.photometry = self.photometry.facing(pairs)
        before, settled, number = -1.0, False, 0
        p_pair = np.empty(0)
        while not settled and number < max(rounds, 1):
            number += 1
            progress(f"estimation, round {number}")
            linear = PerPair()(grouped.sizes_1, grouped.sizes_2)
            best = assign(grouped, self.rule()(pairs).log_ratio, linear)
            p_pair = by_messages(grouped, best).p_pair
            common = float(p_pair.sum())
            if not math.isfinite(common):
                raise InputError(
                    f"{self.first.source} and {self.second.source}: probabilities are beyond computing, the errors are "
                    "far larger than the spacing of the records; are the errors in the unit that was understood?"
                )
            settled = abs(common - before) <= 3e-4 * common + 0.01
            # The magnitudes must have had their say.
            settled &= self.photometry is None or common < FEWEST or self.lessons >= WITH_BRIGHTNESS
            before = common
            self.learn(pairs, p_pair, brightness=number >= POSITIONS_FIRST)
        if self.photometry is not None and self.lessons:
            self.photometry = self.photometry.learned(*self.lesson(pairs, p_pair), last=True)
        progress("identification")
        answer = identify(self.first, self.second, rule=self.rule(), gate=lambda a, b: pairs)
        return answer, number, settled

    def learn(self, pairs: Pairs, p_pair: FloatArray, *, brightness: bool) -> None:
        """What the probabilities of a round say of shares and errors, and from some round on of magnitudes."""
        self.p_1 = np.minimum(np.bincount(pairs.i, p_pair, len(self.first)), 1.0)
        self.p_2 = np.minimum(np.bincount(pairs.j, p_pair, len(self.second)), 1.0)
        common = float(p_pair.sum())
        if common < FEWEST:
            return
        if self.learns_errors:
            # A component so wide that chance fills it cannot be told from chance.
            radius = math.sqrt(float(pairs.mahalanobis_sq.max(initial=1.0)))
            widest = radius * (FILLED / max(self.by_chance(pairs, common), 1e-12)) ** (1.0 / pairs.d)
            widest = max(widest, THINKABLE)
            self.errors = fit_errors(pairs.mahalanobis_sq, p_pair, pairs.d, self.errors, widest=widest)
        if self.photometry is not None and brightness:
            self.photometry = self.photometry.learned(*self.lesson(pairs, p_pair))
            self.lessons += 1

    def lesson(self, pairs: Pairs, p_pair: FloatArray) -> Lesson:
        """What magnitudes are learned from."""
        return pairs, p_pair, (self.p_1, self.p_2), self.shares(), self.coverage.covered

    @cached_property
    def densities(self) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Local densities of the covered records of either source, at the records of both."""
        seen_1, seen_2 = (seen.astype(np.float64) for seen in self.coverage.covered)
        return self.coverage.density(1, seen_1), self.coverage.density(2, seen_2)

    @property
    def learned(self) -> bool:
        """Whether errors or magnitudes have been learned from the pairs."""
        return self.errors != self.first_errors or self.lessons > 0

    def shares(self) -> tuple[FloatArray, FloatArray]:
        """Share of the records of either source that have a partner, at the positions of its own."""
        if self.given is not None:
            return tuple(np.full(len(p), float(p.mean())) for p in (self.p_1, self.p_2))  # type: ignore[return-value]
        (at_1, _), (_, at_2) = self._local_shares()
        return at_1, at_2

    def _local_shares(self) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """The same of either source, at the records of both."""
        seen_1, seen_2 = (seen.astype(np.float64) for seen in self.coverage.covered)
        return self.coverage.share(1, self.p_1 * seen_1, seen_1), self.coverage.share(2, self.p_2 * seen_2, seen_2)

    def brightness(self) -> Brightness | None:
        """What magnitudes say, with the shares of this round."""
        return None if self.photometry is None else self.photometry.rule(self.shares())

    def rule(self) -> Rule:
        """The rule with the densities of this round."""
        positions, brightness = self._positions(), self.brightness()
        return positions if brightness is None else positions + brightness

    def _positions(self) -> PoissonField:
        if self.given is not None:
            mean_1, mean_2 = float(self.p_1.mean()), float(self.p_2.mean())
            alone_1, alone_2 = max(1.0 - mean_1, LEAST_SHARE), max(1.0 - mean_2, LEAST_SHARE)
            both = math.sqrt(self.given[0] * mean_1 * self.given[1] * mean_2)
            return PoissonField(both, self.given[0] * alone_1, self.given[1] * alone_2, self.errors)
        all_1, all_2 = self.densities
        share_1, share_2 = self._local_shares()
        # Both sources count the same common objects: the mean of the logarithms favours neither.
        common = tuple(np.sqrt(all_1[k] * share_1[k] * all_2[k] * share_2[k]) for k in range(2))
        only_1 = all_1[0] * np.maximum(1.0 - share_1[0], LEAST_SHARE)
        only_2 = all_2[1] * np.maximum(1.0 - share_2[1], LEAST_SHARE)
        return PoissonField(common, only_1, only_2, self.errors)  # type: ignore[arg-type]

    def must_open(self, answer: Identification, limit: float) -> bool:
        """Whether the outermost part of the gate still holds true pairs, and opening it is affordable."""
        if limit >= WIDEST_SIGMAS or not self.learns_errors:
            return False
        chance = self.by_chance(answer.pairs, float(answer.p_pair.sum())) * 2.0**self.first.d
        if chance < MOST_CROWDED and limit < _default_radius(self.first.d) * self.errors.typical_scale:
            return True
        if chance > CROWDED:
            return False
        outer = answer.pairs.mahalanobis_sq > (0.7 * limit) ** 2
        beyond = float(answer.p_pair[outer].sum())
        return beyond > 1.0 + OPENING * float(answer.p_pair.sum())

    def by_chance(self, pairs: Pairs, common: float) -> float:
        """Mean number of candidates of a record that are there by chance."""
        return max(len(pairs) - common, 0.0) / min(len(self.first), len(self.second))

    def notes(self, answer: Identification, settled: bool) -> tuple[str, ...]:
        notes = list(self.remarks)
        common = float(answer.p_pair.sum())
        if not settled:
            notes.append("the estimates had not settled when the rounds ran out")
        if common < 0.5:
            notes.append("no common object is expected: the sources seem to have nothing in common")
        if self.learns_errors and common < FEWEST:
            notes.append(f"too few pairs ({common:.1f}) to judge the errors; the quoted ones are believed")
        if self.photometry is not None and self.photometry.chains is None:
            early = common >= FEWEST and not self.lessons
            why = "too few rounds" if early else f"too few pairs with magnitudes of both (of {common:.1f})"
            notes.append(f"{why} to learn from the magnitudes; they are not used")
        return tuple(notes)


def fit_errors(
    mahalanobis_sq: FloatArray, weights: FloatArray, d: int, start: Errors, *, widest: float = np.inf, steps: int = 300
) -> Errors:
    """The mixture of error scales of greatest likelihood for residuals of the given posterior weights (EM).

    The scales are a ladder from 0.13 upwards as far as the residuals reach, and not beyond ``widest``; a pseudo-count
    on the scale 1 keeps a few pairs from saying much.
    """
    used = weights > 1e-3
    z2, weight = mahalanobis_sq[used], weights[used]
    reach = math.sqrt(float(z2.max(initial=1.0)))
    rungs = max(4, math.ceil(math.log(max(reach, 2.0) / 2.0) / math.log(RUNG)) + 1)
    scales = RUNG ** np.arange(-5.0, rungs)
    scales = scales[scales <= max(widest, 1.0)]
    # Pairs of like distance are counted together: the likelihood depends on nothing else.
    edges = np.geomspace(1e-3, max(reach, 2.0), 400)
    bins = np.searchsorted(edges, np.sqrt(z2))
    count = np.bincount(bins, weight, 401)
    centre = np.bincount(bins, weight * z2, 401) / np.maximum(count, 1e-300)
    log_part = -0.5 * centre[:, None] / scales**2 - d * np.log(scales)
    part = np.exp(log_part - log_part.max(axis=1, keepdims=True))
    known = dict(zip(np.round(start.scales, 9), start.shares, strict=True))
    shares = np.array([known.get(round(s, 9), 0.0) for s in scales]) + 1e-3
    shares /= shares.sum()
    pseudo = 2.0 * (np.abs(np.log(scales)) < 0.01)
    full = count > 0.0
    count, part = count[full], part[full]
    for _ in range(steps):
        owned = count / np.maximum(part @ shares, 1e-300)
        before, shares = shares, shares * (owned @ part) + pseudo
        shares /= shares.sum()
        if np.abs(shares - before).max() < SETTLED_SHARES:
            break
    kept = shares > 1e-6
    return Errors(tuple(scales[kept].tolist()), tuple((shares[kept] / shares[kept].sum()).tolist()))
