"""What is not known in advance, estimated from the data: densities, shares in common, the spread of the errors.

Identification and maximum likelihood take turns, with every pair weighted by its posterior (METHOD 6), until the
expected number of common objects settles:

- the local densities of common objects and of records that only one source shows (``coverage.py``);
- how residuals spread about the quoted errors: a mixture of normals over a ladder of error scales, whose shares have
  one maximum of the likelihood, so that errors quoted too small and heavy tails come out of the same estimate;
- what errors grow with: magnitude, or the distance from the field's centre (``error_trends.py``);
- where magnitudes are given, how those of one source follow the other's, and how the shares in common depend on them
  (``photometry.py``);
- how wide the gate must be: it opens while its outermost part still holds true pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sameas._identify import identify
from sameas.arrays import FloatArray
from sameas.assignment import refuse_crowds
from sameas.errors import InputError
from sameas.estimate import em as going
from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.coverage import Coverage
from sameas.estimate.em import DEFAULT_EM, EMTuning, Estimates
from sameas.estimate.error_grid import DEFAULT_GRID, Average, ErrorScan, GridTuning, LeftOpen, scanned
from sameas.estimate.error_grid import identified as averaged
from sameas.estimate.error_model import ErrorModel, Tail, bettered, error_model, over_quoted, spread, tail
from sameas.estimate.error_trends import DEFAULT_TRENDS, Trend, TrendTuning, covariates, with_trends
from sameas.estimate.photometry import Photometry
from sameas.estimate.quantity import Quantity, changed_without, decisive, quantities
from sameas.estimate.sample import Sampling, Setting
from sameas.evidence import Column, Errors, Magnitudes, Precision, Related
from sameas.evidence.detection import DetectionCurve
from sameas.evidence.residuals import AS_QUOTED
from sameas.gate import ChiSquare, Pairs, Radius
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification

BRIGHTNESS_TERMS, PRECISION_TERMS = ("completeness", "brightness"), ("precision",)
COLUMN_TERMS = ("columns", "prior odds", "relations")


@in_short
@dataclass(frozen=True)
class MatchTuning:
    """When the gate opens, and when what was estimated is believed.

    Attributes
    ----------
    opening : the gate opens when this share of the expected true pairs lies beyond 0.7 of its radius (honest errors:
        4e-5).
    widest_sigmas : so far.
    exceeded : so far the typical errors may exceed the modelled ones before the gate opens for it; it then still loses
        only 2e-6.
    crowded : the gate does not open for a tail when a record would have more candidates by chance than this, on
        average,
    most_crowded : nor for errors that are too small when it would have more than this.
    suspected, suspected_crowded : a tail of the errors that betters ln of the likelihood by so much, but does not stand
        out, is looked for farther out. Then, and where one stands out, a record may have this many candidates by
        chance.
    widening : the gate opens by this factor to see whether what looks like the beginning of a tail is one: where it is
        ``suspected``, or this share of the pairs, ``suspected_share``, has errors 1.4 times the typical ones. Then
        ``seed`` is tried as its scale, in typical ones, and its share, and it is one if it then betters ln of the
        likelihood by ``borne_out`` (fields without a tail, but with clusters, ghosts or blends: 0.4 at most).
    modelled : pairs from which the error model of the evidence is learned. bettering : ln of the likelihood by which
        another model must be better, or be better than the quoted errors, or common objects stand out from chance.
    significant : standard deviations by which close candidates must exceed what chance gives, for their errors to be
        judged.
    misled : a sample has misled where it lets expect another number of common objects, by more than this share beyond
        chance.
    growing : whether it is asked what errors grow with. growing_fits : so often, at most, and
        growing_settled : while another fit of it betters ln of the likelihood by so much.
    unrelated : from this share of pairs on whose magnitudes follow no relation, that is said.
    em : of the EM iterations. trends : of errors that grow. grid : of the errors that are thought of before any are
        believed.
    """

    opening: float = 6e-5
    widest_sigmas: float = 400.0
    exceeded: float = 1.25
    crowded: float = 0.5
    most_crowded: float = 8.0
    suspected: float = 1.0
    suspected_crowded: float = 2.0
    widening: float = 1.5
    suspected_share: float = 0.1
    seed: tuple[float, float] = (3.375, 0.1)
    borne_out: float = 4.0
    modelled: int = 3_000
    bettering: float = 8.0
    significant: float = 4.0
    misled: float = 0.02
    growing: bool = True
    growing_fits: int = 3
    growing_settled: float = 2.0
    unrelated: float = 0.5
    em: EMTuning = DEFAULT_EM
    trends: TrendTuning = DEFAULT_TRENDS
    grid: GridTuning = DEFAULT_GRID


DEFAULT_MATCH = MatchTuning()


@in_short
@dataclass(frozen=True)
class Estimate:
    """What was found, and how.

    Attributes
    ----------
    common, share_1, share_2 : expected number of common objects, and what share of the covered records they are.
    errors : the errors of the evidence: the model S of the covariances, and the spread of the residuals about it.
    gate_sigmas : radius of the gate, in quoted standard deviations of the typical pair.
    coverage : where both look.
    rounds, settled : rounds of identification, and whether they settled.
    learned_from : records of either source that the rounds went over: all of them, or a sample that stands for them.
    notes : what a user should know.
    photometry : how the magnitudes of both sources are related, None where they were not given or told nothing.
    precision : what the sizes of the quoted errors say, None where they were not asked or told nothing.
    columns : what other columns say, None where none were given.
    trends : what errors grow with beside what is quoted; they are in ``errors``.
    answer : the identification. judged : whether the spread of the errors was learned from its pairs.
    left_open : what few pairs leave open of the errors; probabilities are averages over it. None where they are many.

    What follows from these is computed when it is asked for.
    """

    common: float
    share_1: float
    share_2: float
    errors: Errors
    gate_sigmas: float
    coverage: Coverage
    rounds: int
    settled: bool
    learned_from: tuple[int, int]
    notes: tuple[str, ...]
    photometry: Photometry | None
    precision: Precision | None
    answer: Identification = field(repr=False)
    judged: bool
    left_open: LeftOpen | None = None
    columns: ColumnEvidence | None = None
    trends: tuple[Trend, ...] = ()

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """All that is a number, by name, with its standard error; see ``sameas.estimate.quantity.quantities``."""
        return quantities(
            self.answer, self.coverage, self.photometry, errors=self.judged, learned_from=self.learned_from
        )

    @property
    def detection_1(self) -> DetectionCurve | None:
        """Share of source 1's records that source 2 shows, by magnitude; None without magnitudes."""
        return self._detection[0]

    @property
    def detection_2(self) -> DetectionCurve | None:
        """Share of source 2's records that source 1 shows, by magnitude; None without magnitudes."""
        return self._detection[1]

    @cached_property
    def _detection(self) -> tuple[DetectionCurve | None, DetectionCurve | None]:
        return (None, None) if self.photometry is None else self.photometry.detection(self.answer, self.coverage)

    @cached_property
    def decisive(self) -> Mapping[str, float]:
        """Median absolute value of each term of the evidence over the identified pairs."""
        return decisive(self.answer)

    @cached_property
    def changed_by_brightness(self) -> int:
        """How many records of source 1 positions alone would identify otherwise."""
        return changed_without(self.answer, BRIGHTNESS_TERMS)

    @cached_property
    def changed_by_precision(self) -> int:
        """How many records of source 1 would be identified otherwise without the sizes of the quoted errors."""
        return changed_without(self.answer, PRECISION_TERMS)

    @cached_property
    def changed_by_columns(self) -> int:
        """How many records of source 1 would be identified otherwise without the columns that were evidence."""
        return changed_without(self.answer, COLUMN_TERMS)

    @cached_property
    def tail(self) -> Tail | None:
        """The share of the pairs whose errors are far larger than the typical ones; None where there is none."""
        return tail(self.answer, self.errors)

    @cached_property
    def error_model(self) -> ErrorModel | None:
        """Which source's errors are too small, where that can be told; None where errors were not judged."""
        return error_model(self.answer) if self.judged else None

    @cached_property
    def spread(self) -> Errors:
        """How residuals spread about the quoted covariances alone, whatever the model of the errors."""
        return spread(self.answer.pairs, self.answer.p_pair) if self.errors.as_modelled else self.errors

    @property
    def typical_scale(self) -> float:
        """The factor by which the quoted errors must be multiplied for the typical pair."""
        return self.errors.typical_scale * self._modelled

    @cached_property
    def _modelled(self) -> float:
        """The same of the error model without its mixture: the median over the probable pairs."""
        return over_quoted(self.errors, self.answer.pairs, self.answer.p_pair)


def match(
    first: Records,
    second: Records,
    *,
    errors: Errors | None = None,
    gate: ChiSquare | Radius | None = None,
    density: tuple[float, float] | None = None,
    brightness: tuple[Magnitudes, Magnitudes] | None = None,
    precision: bool = True,
    evidence: Sequence[Column | Related] = (),
    rounds: int = 30,
    sampling: Sampling = Sampling(),  # noqa: B008
    tuning: MatchTuning = DEFAULT_MATCH,
    progress: Callable[[str], None] = lambda stage: None,
) -> tuple[Identification, Estimate]:
    """Identify two sources of which nothing is known but their records, and say what was estimated.

    Parameters
    ----------
    errors : the spread of the residuals; estimated if not given. ``Errors()`` believes the quoted errors.
    gate : the gate; if not given, as wide as the errors turn out to need.
    density : (ρ₁, ρ₂) of all records of each source per (residual unit)^d, instead of local ones from the data.
    brightness : magnitudes of every row of both tables, which are then evidence too; None leaves it to the positions.
    precision : whether the sizes of the quoted errors are evidence too: of faint objects they are larger.
    evidence : columns of either source that are evidence too, alone or as related to one of the other.
    rounds : at most so many rounds of identification.
    sampling : how a part of large sources is drawn, from which is estimated.
    tuning : when what is believed, such as with how few pairs probabilities are averaged.
    progress : called with the name of what is being done.
    """
    for records in (first, second):
        if not len(records):
            raise InputError(f"{records.source} has no usable records; nothing can be identified")
    progress("densities")
    seen, coverage = _photometry(first, second, brightness), Coverage.of(first, second)
    columns = ColumnEvidence.of(first, second, evidence)
    search = _GateSearch(coverage, seen, precision, density, gate, sampling, progress, tuning=tuning, columns=columns)
    scan = scanned(coverage, density, tuning.grid) if errors is None and gate is None else None
    if scan is not None and scan.contrast > tuning.bettering and scan.common < tuning.grid.many:
        return search.averaged(scan, rounds)
    search, found, remarks = _converged(search, scan, errors, rounds)
    answer, found = search.identified(found, rounds)
    return answer, replace(_estimate_of(answer, search.coverage, found, remarks), trends=search.trends)


@in_short
@dataclass(frozen=True)
class SampleMatch:
    """What a sample of two sources says of all of them: made by :func:`match_sample`.

    estimate : as of :func:`match`, of the sample. known : where its rounds ended. start : the errors by which the gate
    measures, gate_sigmas : its radius in these.
    """

    estimate: Estimate
    known: Estimates = field(repr=False)
    start: Errors
    gate_sigmas: float


def match_sample(
    coverage: Coverage,
    *,
    errors: Errors | None = None,
    gate: ChiSquare | Radius | None = None,
    density: tuple[float, float] | None = None,
    brightness: tuple[Magnitudes, Magnitudes] | None = None,
    precision: bool = True,
    columns: ColumnEvidence | None = None,
    rounds: int = 30,
    tuning: MatchTuning = DEFAULT_MATCH,
    progress: Callable[[str], None] = lambda stage: None,
) -> SampleMatch:
    """What is not known of two sources, estimated from a sample that somebody else has drawn.

    coverage : of the sample, with which of its records count. The others are those of :func:`match`; the likeliest
    errors are taken, however few the pairs are. columns : of its records, that are evidence too.
    """
    seen = _photometry(coverage.first, coverage.second, brightness)
    every = Sampling(enough=2**62)
    # What errors grow with would hold for the records of the sample alone; companions are asked of all records.
    tuning = replace(tuning, growing=False, em=replace(tuning.em, companions=None))
    search = _GateSearch(coverage, seen, precision, density, gate, every, progress, tuning=tuning, columns=columns)
    scan = scanned(coverage, density, tuning.grid) if errors is None and gate is None else None
    search, found, remarks = _converged(search, scan, errors, rounds)
    answer, found = search.identified(found, rounds)
    estimate = _estimate_of(answer, coverage, found, remarks)
    (one, two), common = found.known.setting.numbers, found.known.common
    share_1, share_2 = (min(1.0, common / max(n, 1)) for n in (one, two))
    estimate = replace(estimate, common=common, share_1=share_1, share_2=share_2)
    return SampleMatch(estimate, found.known, search.start, found.gate_sigmas)


def _converged(
    search: _GateSearch, scan: ErrorScan | None, errors: Errors | None, rounds: int
) -> tuple[_GateSearch, _Converged, list[str]]:
    """Where the rounds end, with the errors that the records show, and what is to be said of it."""
    tuning = search.tuning
    if scan is not None and scan.contrast > tuning.bettering and scan.gain > tuning.bettering:
        search = replace(search, start=scan.likeliest)
    found, remarks = search.settled(errors, rounds), []
    while errors is None and found.rounds < rounds:
        model, gain = found.bettered()
        if gain < tuning.bettering:
            break
        search = replace(search, start=model)
        again = search.settled(None, max(rounds - found.rounds, 5))
        found = replace(again, rounds=found.rounds + again.rounds)
    if errors is None:
        search, found = _with_tail(search, found, rounds)
    if tuning.growing and errors is None and found.settled:
        search, found = _with_trends(search, found, rounds)
    if found.has_learned and not _stands_out(search.start.pairs(found.whole.pairs), found.gate_sigmas, tuning):
        more = search.photometry is not None or search.columns is not None
        believed = "positions and quoted errors alone" if more else "the quoted errors"
        given = search.columns and search.columns.given_only
        search = replace(
            search, photometry=None, precision=False, columns=given, trends=(), tailed=None, least_sigmas=0.0
        )
        again = search.settled(errors or Errors(), max(rounds - found.rounds, 5))
        found = replace(again, rounds=found.rounds + again.rounds)
        remarks.append(f"close candidates do not exceed what chance gives; {believed} are used")
    return search, found, remarks


def _with_tail(search: _GateSearch, found: _Converged, rounds: int) -> tuple[_GateSearch, _Converged]:
    """Where the rounds end with a gate that shows the tail of the errors, if there is one.

    Within the gate of honest errors, displaced pairs are hard to tell from the many that chance makes, and what they
    would add to the number of common objects is missing; farther out, only a tail has more pairs than chance.
    """
    tuning, scales = search.tuning, search.tuning.em.scales
    # It is judged when the rounds have ended, not in each of them: what it adds grows with the common objects.
    patient = replace(tuning, em=replace(tuning.em, scales=replace(scales, standing_out=tuning.suspected)))
    while search.gate is None and found.suspects_tail() and found.rounds < rounds:
        least_sigmas, tailed = tuning.widening * found.gate_sigmas, _tailed(found.known.errors, tuning)
        wider = replace(search, least_sigmas=least_sigmas, tailed=tailed, tuning=patient)
        again = wider.settled(None, max(rounds - found.rounds, 5))
        if again.known.tail < tuning.borne_out:
            break
        search, found = wider, replace(again, rounds=found.rounds + again.rounds)
    return search, found


def _tailed(errors: Errors, tuning: MatchTuning) -> Errors:
    """The same errors with the beginning of a tail, unless they have one."""
    scale, share = tuning.seed
    wide = scale * errors.typical_scale
    if max(errors.scales) >= wide:
        return errors
    return replace(errors, scales=(*errors.scales, wide), shares=(*((1.0 - share) * x for x in errors.shares), share))


def _with_trends(search: _GateSearch, found: _Converged, rounds: int) -> tuple[_GateSearch, _Converged]:
    """Where the rounds end with errors that grow with magnitude or place, if the pairs show that they do."""
    known = covariates(search.coverage, search.photometry, search.tuning.trends)
    for _ in range(search.tuning.growing_fits):
        if found.rounds >= rounds or not found.known.learns_errors or found.known.common < search.tuning.em.fewest:
            break
        model, trends, gain = with_trends(
            found.known.errors, found.known.setting.pairs, found.p_counted, known, search.tuning.modelled,
            search.trends, search.tuning.trends,
        )  # fmt: skip
        if gain < (search.tuning.growing_settled if search.trends else search.tuning.bettering):
            break
        search = replace(search, start=model, trends=trends)
        again = search.settled(None, max(rounds - found.rounds, 5))
        found = replace(again, rounds=found.rounds + again.rounds)
    return search, found


def _photometry(first: Records, second: Records, brightness: tuple[Magnitudes, Magnitudes] | None) -> Photometry | None:
    if brightness is None:
        return None
    one, two = brightness
    return Photometry.of((one.of(first), two.of(second)), (one.names, two.names))


@in_short
@dataclass(frozen=True)
class _Converged:
    """Where the rounds ended, for one gate.

    whole : all candidates. known : what is known, of all or of a sample. p_counted : (m,) probabilities of its pairs.
    """

    whole: Setting
    known: Estimates
    p_counted: FloatArray
    gate_sigmas: float
    rounds: int
    settled: bool
    learned_from: tuple[int, int]
    tuning: MatchTuning

    @property
    def sampled(self) -> bool:
        """Whether a sample stood for all."""
        return self.known.setting is not self.whole

    @property
    def has_learned(self) -> bool:
        """Whether errors, their sizes or magnitudes have been learned from the pairs."""
        graded = self.known.grades is not None and self.known.grades.rule is not None
        learned = self.known.errors.scales != (1.0,) or self.known.errors.as_modelled
        return (self.known.learns_errors and learned) or self.known.times_learned > 0 or graded

    def bettered(self) -> tuple[Errors, float]:
        """The error model that the pairs show, and by how much it betters ln of their likelihood."""
        known = self.known
        if not known.learns_errors or known.common < self.tuning.em.fewest:
            return known.errors, 0.0
        return bettered(known.errors, known.setting.pairs, self.p_counted, self.tuning.modelled)

    def must_open(self) -> bool:
        """Whether the outermost part of the gate still holds true pairs, and opening it is affordable."""
        limit, tuning, standing_out = self.gate_sigmas, self.tuning, self.tuning.em.scales.standing_out
        if limit >= tuning.widest_sigmas or not self.known.learns_errors:
            return False
        if _is_narrow(self.known, self.p_counted, limit, tuning):
            return True
        chance = _chance(self.known, self.p_counted, 2.0)
        if tuning.suspected < self.known.tail < standing_out and chance < tuning.suspected_crowded:
            return True  # what lies farther out decides whether it is one
        if chance > (tuning.suspected_crowded if self.known.tail >= standing_out else tuning.crowded):
            return False
        return self._reaches_farther()

    def suspects_tail(self) -> bool:
        """Whether errors look as if they had a tail beyond the gate, and opening this a little is affordable."""
        known, tuning = self.known, self.tuning
        wider = tuning.widening * self.gate_sigmas
        if not known.learns_errors or known.common < tuning.em.fewest or wider > tuning.widest_sigmas:
            return False
        if _chance(known, self.p_counted, tuning.widening) > tuning.most_crowded:
            return False
        if known.tail >= tuning.em.scales.standing_out:
            return self._reaches_farther()
        typical = 1.4 * known.errors.typical_scale
        wide = sum(x for scale, x in zip(known.errors.scales, known.errors.shares, strict=True) if scale > typical)
        return known.tail > tuning.suspected or wide > tuning.suspected_share

    def _reaches_farther(self) -> bool:
        """Whether true pairs lie in the outer part of the gate."""
        square = self.known.errors.pairs(self.known.setting.pairs).mahalanobis_sq
        beyond = float(self.p_counted[square > (0.7 * self.gate_sigmas) ** 2].sum())
        return beyond > 1.0 + self.tuning.opening * float(self.p_counted.sum())


def _chance(known: Estimates, p_counted: FloatArray, wider: float) -> float:
    """Candidates of a record that are there by chance, if the gate were so many times as wide."""
    return known.setting.by_chance(p_counted) * wider**known.setting.pairs.d


def _is_narrow(known: Estimates, p_counted: FloatArray, limit: float, tuning: MatchTuning) -> bool:
    """Whether a gate of so many sigmas is too narrow for the typical errors, and opening it is affordable."""
    if limit >= tuning.widest_sigmas or not known.learns_errors:
        return False
    needed = _radius(None, known.setting.pairs.d) * known.errors.typical_scale
    return tuning.exceeded * limit < needed and _chance(known, p_counted, 2.0) < tuning.most_crowded


@dataclass(frozen=True)
class _GateSearch:
    """Rounds with one gate after another, each twice as wide as the one before, until it is wide enough.

    tailed, least_sigmas : the errors, and the radius of the gate, that the rounds begin with where a tail was seen.
    """

    coverage: Coverage
    photometry: Photometry | None
    precision: bool
    density: tuple[float, float] | None
    gate: ChiSquare | Radius | None
    sampling: Sampling
    progress: Callable[[str], None]
    start: Errors = AS_QUOTED
    tuning: MatchTuning = DEFAULT_MATCH
    columns: ColumnEvidence | None = None
    trends: tuple[Trend, ...] = ()
    tailed: Errors | None = None
    least_sigmas: float = 0.0

    def settled(self, errors: Errors | None, most: int) -> _Converged:
        """The end of at most so many rounds; ``errors`` are estimated if not given."""
        first, second = self.coverage.first, self.coverage.second
        limit, total, known, whole = max(_radius(self.gate, first.d), self.least_sigmas), 0, None, None
        while True:
            self.progress("gate")
            pairs = (self.gate or Radius(limit))(*self.start.records(first, second))
            refuse_crowds(pairs)
            near = pairs
            if self.start.as_modelled:
                pairs = pairs.of(first, second)
            whole = Setting.whole(pairs, self.coverage) if whole is None else replace(whole, pairs=pairs)
            part = whole.sample(self.sampling)
            seen = self.photometry if part is whole or self.photometry is None else self.photometry.part(*part.rows)
            columns = self.columns if part is whole or self.columns is None else self.columns.part(*part.rows)
            if known is None:
                # More close candidates than chance gives are common objects.
                inner, by_chance = _halves(near, limit)
                excess = (inner - by_chance) / min(len(first), len(second))
                known = Estimates.nothing(
                    part, errors, seen, self.density, excess, self.precision, self.tuning.em, columns
                )
                known = replace(known, errors=errors or self.start.with_mixture(self.tailed or self.start))
            else:
                known = known.at(part, seen, columns)
            found = self._in_gate(known, whole, limit, most - total)
            found = replace(found, rounds=total + found.rounds)
            known, p_counted, total = found.known, found.p_counted, found.rounds
            if self.gate is not None or total >= most or not found.must_open():
                return replace(found, known=known.with_evidence(p_counted, last=True))
            known = known.with_evidence(p_counted)
            limit = min(2.0 * limit, self.tuning.widest_sigmas)

    def _in_gate(self, known: Estimates, whole: Setting, limit: float, most: int) -> _Converged:
        """The end of at most so many rounds with one gate; of the first where it shows that the gate is too narrow."""

        def narrow(known: Estimates, p_counted: FloatArray) -> bool:
            return self.gate is None and _is_narrow(known, p_counted, limit, self.tuning)

        known, p_counted, number, settled = going.settled(known, most, self.progress, narrow)
        return _Converged(whole, known, p_counted, limit, number, settled, known.setting.numbers, self.tuning)

    def averaged(self, scan: ErrorScan, most: int) -> tuple[Identification, Estimate]:
        """All records identified, averaged over the errors that few pairs leave open."""
        first, second = self.coverage.first, self.coverage.second
        self.progress("gate")
        left = scan.average(first.d)
        pairs = left.candidates(first, second)
        refuse_crowds(pairs)
        whole = Setting.whole(pairs, self.coverage)
        share = scan.common / min(len(first), len(second))
        known = Estimates.nothing(
            whole, AS_QUOTED, self.photometry, self.density, share, self.precision, self.tuning.em, self.columns
        )
        known = replace(known, average=Average.of(left, pairs, scan.weight, scan.common))
        known, p_counted, number, settled = going.settled(known, most, self.progress)
        known = known.with_evidence(p_counted, last=True)
        self.progress("identification")
        assert known.average is not None
        answer = averaged(known.average, pairs, known.rule(), *known.numbers(), known.log_beside())
        typical = known.average.typical
        limit = math.sqrt(left.limit)
        known = replace(known, errors=typical, learns_errors=True)
        found = _Converged(whole, known, p_counted, limit, number, settled, whole.numbers, self.tuning)
        estimate = _estimate_of(answer, self.coverage, found, [])
        assert known.average is not None
        return answer, replace(estimate, left_open=left.left_open(known.average.weight))

    def identified(self, found: _Converged, most: int) -> tuple[Identification, _Converged]:
        """All records identified with what is known; with rounds over all of them, where a sample misled."""
        known = found.known.at(found.whole, self.photometry, self.columns) if found.sampled else found.known
        answer = self._identified(known)
        if not found.sampled or _as_expected(
            float(answer.p_pair.sum()), known.expected(), float(found.p_counted.sum()), self.tuning
        ):
            return answer, replace(found, known=known)
        known = known.learned(answer.p_pair, answer.evidence.log_ratio)
        known, p_counted, done, settled = going.settled(known, max(most - found.rounds, 5), self.progress)
        total, known = found.rounds + done, known.with_evidence(p_counted, last=True)
        found = _Converged(
            found.whole, known, p_counted, found.gate_sigmas, total, settled, found.whole.numbers, self.tuning
        )
        return self._identified(known), found

    def _identified(self, known: Estimates) -> Identification:
        self.progress("identification")
        pairs, beside = known.setting.pairs, known.log_beside()
        if beside is not None:
            return averaged(None, pairs, known.rule(), *known.numbers(), beside)
        return identify(pairs.first, pairs.second, rule=known.rule(), gate=lambda first, second: pairs)


def _as_expected(common: float, expected: float, sampled: float, tuning: MatchTuning) -> bool:
    """Whether as many are common as a sample with so many common objects lets expect."""
    return abs(common - expected) <= (tuning.misled + tuning.significant / math.sqrt(max(sampled, 1.0))) * expected


def _estimate_of(answer: Identification, coverage: Coverage, found: _Converged, remarks: list[str]) -> Estimate:
    """What was found, as it stands in the last identification."""
    known, common = found.known, float(answer.p_pair.sum())
    seen_1, seen_2 = (max(int(np.count_nonzero(seen)), 1) for seen in coverage.covered)
    photometry = known.photometry if known.photometry is not None and known.photometry.tells else None
    precision = None if known.grades is None else known.grades.rule
    estimate = Estimate(
        common, min(1.0, common / seen_1), min(1.0, common / seen_2), known.errors, found.gate_sigmas, coverage,
        found.rounds, found.settled, found.learned_from, tuple(remarks) + _notes(found, common), photometry, precision,
        answer,
        known.learns_errors and common >= found.tuning.em.fewest, columns=known.columns,
    )  # fmt: skip
    if not known.errors.as_modelled:
        return estimate
    return replace(estimate, gate_sigmas=found.gate_sigmas * estimate.typical_scale / known.errors.typical_scale)


def _notes(found: _Converged, common: float) -> tuple[str, ...]:
    """What a user should know."""
    notes, known = [], found.known
    if not found.settled:
        notes.append("the estimates had not converged at the last iteration")
    if common < 0.5:
        notes.append("no common object is expected: the sources seem to have no object in common")
    if known.learns_errors and common < found.tuning.em.fewest:
        believed = (
            "probabilities are averaged over what they leave open" if known.average else "the quoted errors are used"
        )
        notes.append(f"too few pairs ({common:.1f}) to judge the errors; {believed}")
    if known.photometry is not None and known.photometry.chains is None:
        few = f"too few pairs with magnitudes of both (of {common:.1f})"
        notes.append(f"{few} to fit the magnitudes; they are not used")
    relation = None if known.photometry is None else known.photometry.first_relation
    if known.photometry is not None and relation is not None and relation.unrelated > found.tuning.unrelated:
        error, spread_mag = known.photometry.quoted_and_spread(known.setting.pairs, found.p_counted)
        notes.append(
            f"the quoted errors of the magnitudes, {error:.2g} mag, are larger than the spread of those of the pairs, "
            f"{spread_mag:.2g} mag: they have hardly any weight"
            if error > spread_mag
            else f"the magnitudes of {relation.unrelated:.0%} of the pairs are unrelated, and "
            "have hardly any weight: are they of these objects, and in the right columns?"
        )
    return tuple(notes)


def _radius(gate: ChiSquare | Radius | None, d: int) -> float:
    """Radius of a gate, or of the default one, in d features, in standard deviations."""
    return gate.sigmas if isinstance(gate, Radius) else math.sqrt((gate or ChiSquare()).limit(d))


def _halves(pairs: Pairs, limit: float) -> tuple[float, float]:
    """Candidates in the inner half of the gate, and as many as the density of its outer part lets expect there."""
    inner = int(np.count_nonzero(pairs.mahalanobis_sq < (0.5 * limit) ** 2))
    return float(inner), (len(pairs) - inner) / (2.0**pairs.d - 1.0)


def _stands_out(pairs: Pairs, limit: float, tuning: MatchTuning) -> bool:
    """Whether the inner half of the gate holds more candidates than its outer part, at chance, lets expect."""
    inner, by_chance = _halves(pairs, limit)
    return inner - by_chance > tuning.significant * math.sqrt(inner + by_chance / (2.0**pairs.d - 1.0))
