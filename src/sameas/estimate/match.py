"""Crossmatch of two sources with everything unknown estimated from the data: densities, shares in common, errors.

EM iterations alternate between identification and maximum likelihood, with every pair weighted by its posterior
probability (METHOD 6), until the expected number of common objects converges. Estimated are

- the local densities of common objects and of records that only one source shows (``coverage.py``);
- the distribution of residuals relative to the quoted errors: a mixture of normals over a ladder of error scales. Its
  likelihood in the shares has one maximum, and covers both underestimated errors and heavy tails;
- growth of errors with magnitude or with the distance from the field's centre (``error_trends.py``);
- relations between the magnitudes of both sources, and the shares in common by magnitude (``photometry.py``);
- the width of the gate: it is widened while its outer part still contains true pairs.
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
from sameas.estimate.columns import DEFAULT_COLUMNS, ColumnEvidence, ColumnsTuning
from sameas.estimate.coverage import DEFAULT_COVERAGE, Coverage, CoverageTuning
from sameas.estimate.em import DEFAULT_EM, EMTuning, Estimates, iterate
from sameas.estimate.error_average import Average, ErrorRanges, identify_averaged
from sameas.estimate.error_grid import DEFAULT_GRID, ErrorScan, GridTuning, mean_densities, scan_errors
from sameas.estimate.error_model import (
    DEFAULT_ERROR_FIT,
    ErrorFitTuning,
    ErrorModel,
    Tail,
    better_model,
    error_model,
    factor_on_quoted,
    fit_spread,
    tail,
)
from sameas.estimate.error_trends import DEFAULT_TRENDS, Trend, TrendTuning, covariates, with_trends
from sameas.estimate.photometry import DEFAULT_RELATIONS, Photometry, RelationTuning
from sameas.estimate.quantity import Quantity, changed_without, decisive, quantities
from sameas.estimate.sample import Sampling, Setting
from sameas.evidence import Column, Errors, Magnitudes, Precision, Related
from sameas.evidence.detection import DetectionCurve
from sameas.evidence.rule import AS_QUOTED
from sameas.gate import ChiSquare, Pairs, Radius
from sameas.kernels.compiled import prefer_compiled
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification
from sameas.space import ball_volume

BRIGHTNESS_TERMS, PRECISION_TERMS = ("completeness", "brightness"), ("precision",)
COLUMN_TERMS = ("columns", "prior odds", "relations")


@in_short
@dataclass(frozen=True)
class MatchTuning:
    """Limits for widening the gate and for accepting estimates.

    Attributes
    ----------
    max_iterations : EM iterations after which no further error model is tried; its iterations are at most two thirds of
        these more.
    min_outer_share : the gate is widened when this share of the expected true pairs lies beyond 0.7 of its radius
        (4e-5 where errors are as quoted), and one pair more. max_negligible_chance : where a record would have fewer
        chance candidates, half a pair of a tail suffices: its last pairs are otherwise certain to have no partner.
    max_gate_sigmas : greatest radius of the gate.
    max_scale_excess : the gate is widened when the typical errors exceed those it was made for by this factor; up to
        there it loses only 2e-6 of the pairs.
    max_chance_tail, max_chance_scale : the gate is not widened for a tail, or for underestimated errors, when a record
        would have on average more chance candidates than this.
    suspect_tail_gain, max_chance_suspected : a tail with this gain in ln likelihood that is not yet significant is
        looked for in a wider gate. Then, and with a significant tail, a record may have this many chance candidates.
    gate_step : the gate is widened by this factor to test for a tail that begins at its edge: after
        ``suspect_tail_gain``, or where ``suspect_wide_share`` of the pairs has errors above 1.4 typical ones.
    tail_seed : scale (in typical errors) and share of the tail that this test starts from.
    min_tail_gain : gain in ln likelihood for the test to accept the tail (fields without a tail, but with clusters,
        ghosts or blends: at most 0.4).
    n_model_pairs : pairs from which the error model of the evidence is fitted.
    min_gain : gain in ln likelihood for another error model, over the quoted errors, or of common objects over chance.
    min_significance : excess of close candidates over chance, in standard deviations, from which errors are fitted.
    max_sample_error : a sample is rejected when the number of common objects differs from its prediction by more than
        this share and the statistical error.
    fits_trends : whether growth of the errors is fitted, at most ``max_trend_fits`` times, while a further fit gains
        ``min_trend_gain`` in ln likelihood.
    max_unrelated : from this share of pairs with unrelated magnitudes on, a note is given.
    max_interpreted : records plus twice the expected chance candidates above which interpreting the kernels takes
        longer than reading the compiled ones from the cache (measured with 200 to 2 000 records).
    em : tuning of EM iterations. relations : of magnitudes. columns : of other columns. trends : of growing errors.
    grid : of the scan of error models before any iteration. coverage : of cells, densities and holes. error_fit : of
        factors, floors and tails.
    """

    max_iterations: int = 30
    min_outer_share: float = 6e-5
    max_negligible_chance: float = 0.1
    max_gate_sigmas: float = 400.0
    max_scale_excess: float = 1.25
    max_chance_tail: float = 0.5
    max_chance_scale: float = 8.0
    suspect_tail_gain: float = 1.0
    max_chance_suspected: float = 2.0
    gate_step: float = 1.5
    suspect_wide_share: float = 0.1
    tail_seed: tuple[float, float] = (3.375, 0.1)
    min_tail_gain: float = 4.0
    n_model_pairs: int = 3_000
    min_gain: float = 8.0
    min_significance: float = 4.0
    max_sample_error: float = 0.02
    fits_trends: bool = True
    max_trend_fits: int = 3
    min_trend_gain: float = 2.0
    max_unrelated: float = 0.5
    max_interpreted: float = 2_300.0
    em: EMTuning = DEFAULT_EM
    relations: RelationTuning = DEFAULT_RELATIONS
    columns: ColumnsTuning = DEFAULT_COLUMNS
    trends: TrendTuning = DEFAULT_TRENDS
    grid: GridTuning = DEFAULT_GRID
    coverage: CoverageTuning = DEFAULT_COVERAGE
    error_fit: ErrorFitTuning = DEFAULT_ERROR_FIT


DEFAULT_MATCH = MatchTuning()


@in_short
@dataclass(frozen=True)
class Estimate:
    """The estimates of a crossmatch and the options they were made with.

    Attributes
    ----------
    common, share_1, share_2 : expected number of common objects, and their shares of the covered records.
    errors : the errors of the evidence: model S of the covariances, and distribution of the residuals relative to S.
    gate_sigmas : radius of the gate, in quoted standard deviations of the typical pair.
    coverage : where both sources observe.
    iterations, converged : number of EM iterations, and whether they converged.
    learned_from : records of each source that were used: all, or those of a sample.
    notes : remarks for the user.
    photometry : relations of the magnitudes of both sources; None if not given or not informative.
    precision : evidence of the sizes of the quoted errors; None if not used or not informative.
    columns : evidence of other columns; None if not given.
    trends : growth of the errors in addition to the quoted ones; included in ``errors``. tuning : as of :func:`match`.
    answer : the identification. errors_estimated : whether the distribution of the errors was estimated from its pairs.
    error_ranges : ranges of the errors over which probabilities are averaged with few pairs; None with many.

    The properties are computed when first used.
    """

    common: float
    share_1: float
    share_2: float
    errors: Errors
    gate_sigmas: float
    coverage: Coverage
    iterations: int
    converged: bool
    learned_from: tuple[int, int]
    notes: tuple[str, ...]
    photometry: Photometry | None
    precision: Precision | None
    answer: Identification = field(repr=False)
    errors_estimated: bool
    error_ranges: ErrorRanges | None = None
    columns: ColumnEvidence | None = None
    trends: tuple[Trend, ...] = ()
    tuning: MatchTuning = field(default=DEFAULT_MATCH, repr=False)

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """All numbers by name, with standard errors; see ``sameas.estimate.quantity.quantities``."""
        errors = self.errors if self.errors_estimated else None
        return quantities(
            self.answer, self.coverage, self.photometry, self.columns, errors=errors, learned_from=self.learned_from
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
        """Number of records of source 1 that positions alone would identify differently."""
        return changed_without(self.answer, BRIGHTNESS_TERMS)

    @cached_property
    def changed_by_precision(self) -> int:
        """Number of records of source 1 identified differently without the sizes of the quoted errors."""
        return changed_without(self.answer, PRECISION_TERMS)

    @cached_property
    def changed_by_columns(self) -> int:
        """Number of records of source 1 identified differently without the other columns."""
        return changed_without(self.answer, COLUMN_TERMS)

    @cached_property
    def tail(self) -> Tail | None:
        """Share of pairs with errors far larger than the typical ones; None without a tail."""
        return tail(self.answer, self.errors, self.tuning.error_fit)

    @cached_property
    def error_model(self) -> ErrorModel | None:
        """Factors and floor of each source's errors, as far as distinguishable; None if errors were not estimated."""
        return error_model(self.answer, self.tuning.error_fit) if self.errors_estimated else None

    @cached_property
    def spread(self) -> Errors:
        """Distribution of the residuals relative to the quoted covariances, whatever the error model."""
        if not self.errors.as_modelled:
            return self.errors
        return fit_spread(self.answer.pairs, self.answer.p_pair, self.tuning.error_fit)

    @property
    def typical_scale(self) -> float:
        """Factor on the quoted errors for the typical pair."""
        return self.errors.typical_scale * self._model_factor

    @cached_property
    def _model_factor(self) -> float:
        """Median over the probable pairs of modelled over quoted errors, without the mixture."""
        return factor_on_quoted(self.errors, self.answer.pairs, self.answer.p_pair, self.tuning.error_fit)


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
    sampling: Sampling = Sampling(),  # noqa: B008
    tuning: MatchTuning = DEFAULT_MATCH,
    progress: Callable[[str], None] = lambda stage: None,
) -> tuple[Identification, Estimate]:
    """The identification of two sources, with everything unknown estimated, and the estimates.

    Parameters
    ----------
    errors : distribution of the residuals; estimated if not given. ``Errors()`` assumes the quoted errors.
    gate : the gate; widened as the estimated errors need if not given.
    density : (ρ₁, ρ₂) of all records of each source per (residual unit)^d, instead of local ones from the data.
    brightness : magnitudes of every row of both tables, as evidence; None uses positions only.
    precision : whether the sizes of the quoted errors are evidence: faint objects have larger ones.
    evidence : columns used as evidence, of one source or related columns of both.
    sampling : size of the sample of large sources from which estimates are made.
    tuning : limits, such as the number of pairs below which probabilities are averaged over errors.
    progress : called with the name of each step.

    Raises
    ------
    InputError : a source has no records.
    """
    for records in (first, second):
        if not len(records):
            raise InputError(f"{records.source} has no usable records; nothing can be identified")
    progress("densities")
    photometry = _photometry(first, second, brightness, tuning)
    coverage = Coverage.of(first, second, tuning=tuning.coverage)
    columns = ColumnEvidence.of(first, second, evidence, tuning.columns)
    if _expected_work(coverage, density) > tuning.max_interpreted:
        prefer_compiled()
    search = _GateSearch(
        coverage, photometry, precision, density, gate, sampling, progress, tuning=tuning, columns=columns
    )
    scan = scan_errors(coverage, density, tuning.grid) if errors is None and gate is None else None
    # With few records, errors by which they have nothing in common are averaged over too.
    few = min(len(first), len(second)) <= 2 * tuning.grid.enough
    if scan is not None and scan.common < tuning.grid.max_averaged and (few or scan.contrast > tuning.min_gain):
        return search.match_averaged(scan)
    search, result, remarks = _fit(search, scan, errors)
    result = search.without_message_errors(result)
    answer, result = search.identify_all(result)
    return answer, replace(_to_estimate(answer, search.coverage, result, remarks), trends=search.trends)


def _expected_work(coverage: Coverage, density: tuple[float, float] | None) -> float:
    """Records of the poorer source, and twice the expected chance candidates in the default gate by quoted errors."""
    if not all(covered.any() for covered in coverage.covered):
        return 0.0
    d = coverage.first.d
    volume = ball_volume(d) * ChiSquare().limit(d) ** (0.5 * d) * float(np.prod(coverage.typical_error))
    n = min(len(coverage.first), len(coverage.second))
    return float(n * (1.0 + 2.0 * max(mean_densities(coverage, density)) * volume))


@dataclass(frozen=True)
class Assumed:
    """What is given to a match instead of being estimated; the fields are the arguments of :func:`match`."""

    errors: Errors | None = None
    gate: ChiSquare | Radius | None = None
    density: tuple[float, float] | None = None
    precision: bool = True


@in_short
@dataclass(frozen=True)
class SampleMatch:
    """Estimates from a sample of two sources, for use on all records. Made by :func:`match_sample`.

    estimate : as of :func:`match`, of the sample. estimates : after the last EM iteration. gate_errors, gate_sigmas :
    errors of the gate's distances, and its radius in these.
    """

    estimate: Estimate
    estimates: Estimates = field(repr=False)
    gate_errors: Errors
    gate_sigmas: float


def match_sample(
    coverage: Coverage,
    assumed: Assumed = Assumed(),
    *,
    brightness: tuple[Magnitudes, Magnitudes] | None = None,
    columns: ColumnEvidence | None = None,
    tuning: MatchTuning,
    progress: Callable[[str], None] = lambda stage: None,
) -> SampleMatch:
    """The estimates from a sample drawn by the caller.

    coverage : of the sample, with its counted records. columns : of its records, as evidence. Other arguments as of
    :func:`match`. The errors of maximum likelihood are used, however few the pairs are.
    """
    photometry = _photometry(coverage.first, coverage.second, brightness, tuning)
    all_records, density = Sampling(enough=2**62), assumed.density
    # Trends would apply to the records of the sample only; companions need all records.
    tuning = replace(tuning, fits_trends=False, em=replace(tuning.em, companions=None))
    search = _GateSearch(
        coverage, photometry, assumed.precision, density, assumed.gate, all_records, progress, tuning=tuning,
        columns=columns,
    )  # fmt: skip
    estimated = assumed.errors is None and assumed.gate is None
    scan = scan_errors(coverage, density, tuning.grid) if estimated else None
    search, result, remarks = _fit(search, scan, assumed.errors)
    result = search.without_message_errors(result)
    answer, result = search.identify_all(result)
    estimate = _to_estimate(answer, coverage, result, remarks)
    (one, two), common = result.estimates.setting.n_counted, result.estimates.n_common
    share_1, share_2 = (min(1.0, common / max(n, 1)) for n in (one, two))
    estimate = replace(estimate, common=common, share_1=share_1, share_2=share_2)
    return SampleMatch(estimate, result.estimates, search.gate_errors, result.gate_sigmas)


def _fit(
    search: _GateSearch, scan: ErrorScan | None, errors: Errors | None
) -> tuple[_GateSearch, _GateResult, list[str]]:
    """The search with the fitted error model, its result, and remarks for the user."""
    tuning = search.tuning
    if scan is not None and scan.contrast > tuning.min_gain and scan.gain > tuning.min_gain:
        search = replace(search, gate_errors=scan.best)
    result, remarks = search.run(errors, tuning.max_iterations), []
    while errors is None and result.iterations < tuning.max_iterations:
        model, gain = result.better_model()
        if gain < tuning.min_gain:
            break
        changed = replace(search, gate_errors=model)
        again = _rerun(changed, result, None)
        if again.is_worse_than(result):
            break
        search, result = changed, again
    if errors is None:
        search, result = _fit_tail(search, result)
    if tuning.fits_trends and errors is None and result.converged:
        search, result = _fit_trends(search, result)
    if result.has_learned and not _has_excess(search.gate_errors.pairs(result.whole.pairs), result.gate_sigmas, tuning):
        more = search.photometry is not None or search.columns is not None
        assumed = "positions and quoted errors alone" if more else "the quoted errors"
        given = search.columns and search.columns.given_only
        search = replace(
            search, photometry=None, precision=False, columns=given, trends=(), seed_errors=None, min_sigmas=0.0
        )
        result = _rerun(search, result, errors or Errors())
        remarks.append(f"close candidates do not exceed what chance gives; {assumed} are used")
    return search, result, remarks


def _rerun(search: _GateSearch, result: _GateResult, errors: Errors | None) -> _GateResult:
    """The result of a changed search with the remaining iterations, at least two thirds of all; all are counted.

    With each error model the gate is doubled anew; five times take 12 to 18 iterations.
    """
    most = search.tuning.max_iterations
    again = search.run(errors, max(most - result.iterations, 2 * most // 3, 5))
    return replace(again, iterations=result.iterations + again.iterations)


def _fit_tail(search: _GateSearch, result: _GateResult) -> tuple[_GateSearch, _GateResult]:
    """The search and result with a gate wide enough for the tail of the errors, if there is one.

    Within a gate for quoted errors, pairs of the tail are hidden among chance candidates, and their number is missing
    from the number of common objects; farther out, only a tail gives more pairs than chance.
    """
    tuning, scales = search.tuning, search.tuning.em.scales
    # Accepted after the last iteration, not in each: the gain of a tail grows with the number of common objects.
    late = replace(
        tuning, em=replace(tuning.em, scales=replace(scales, significant_tail_gain=tuning.suspect_tail_gain))
    )
    while search.gate is None and result.suspects_tail() and result.iterations < tuning.max_iterations:
        min_sigmas = tuning.gate_step * result.gate_sigmas
        seed_errors = _with_tail_seed(result.estimates.errors, tuning)
        wider = replace(search, min_sigmas=min_sigmas, seed_errors=seed_errors, tuning=late)
        wider_result = _rerun(wider, result, None)
        if wider_result.estimates.tail_gain < tuning.min_tail_gain:
            break
        search, result = wider, wider_result
    return search, result


def _with_tail_seed(errors: Errors, tuning: MatchTuning) -> Errors:
    """The errors with a tail added, unless they have one."""
    scale, share = tuning.tail_seed
    wide = scale * errors.typical_scale
    if max(errors.scales) >= wide:
        return errors
    return replace(errors, scales=(*errors.scales, wide), shares=(*((1.0 - share) * x for x in errors.shares), share))


def _fit_trends(search: _GateSearch, result: _GateResult) -> tuple[_GateSearch, _GateResult]:
    """The search and result with errors that grow with magnitude or position, if the pairs show such growth."""
    tuning, quantities = search.tuning, covariates(search.coverage, search.photometry, search.tuning.trends)
    for _ in range(tuning.max_trend_fits):
        estimates = result.estimates
        few = estimates.n_common < tuning.em.min_pairs
        if result.iterations >= tuning.max_iterations or not estimates.fits_errors or few:
            break
        model, trends, gain = with_trends(
            estimates.errors, estimates.setting.pairs, result.p_counted, quantities, tuning.n_model_pairs,
            search.trends, tuning.trends, tuning.error_fit,
        )  # fmt: skip
        if gain < (tuning.min_trend_gain if search.trends else tuning.min_gain):
            break
        changed = replace(search, gate_errors=model, trends=trends)
        again = _rerun(changed, result, None)
        if again.is_worse_than(result):
            break
        search, result = changed, again
    return search, result


def _photometry(
    first: Records, second: Records, brightness: tuple[Magnitudes, Magnitudes] | None, tuning: MatchTuning
) -> Photometry | None:
    if brightness is None:
        return None
    one, two = brightness
    return Photometry.of((one.of(first), two.of(second)), (one.names, two.names), tuning.relations)


@in_short
@dataclass(frozen=True)
class _GateResult:
    """The state after the EM iterations with one gate.

    whole : all candidates. estimates : of all or of a sample. p_counted : (m,) probabilities of their pairs.
    too_narrow : whether the iterations ended before the gate was wide enough.
    """

    whole: Setting
    estimates: Estimates
    p_counted: FloatArray
    gate_sigmas: float
    iterations: int
    converged: bool
    learned_from: tuple[int, int]
    tuning: MatchTuning
    too_narrow: bool = False

    def is_worse_than(self, other: _GateResult) -> bool:
        """Whether pairs are lost beyond this gate only."""
        return self.too_narrow and not other.too_narrow

    @property
    def sampled(self) -> bool:
        """Whether the estimates are those of a sample."""
        return self.estimates.setting is not self.whole

    @property
    def has_learned(self) -> bool:
        """Whether errors, their sizes, magnitudes or columns were estimated from the pairs."""
        graded = self.estimates.grades is not None and self.estimates.grades.rule is not None
        learned = self.estimates.errors.scales != (1.0,) or self.estimates.errors.as_modelled
        return (self.estimates.fits_errors and learned) or self.estimates.n_evidence_fits > 0 or graded

    def better_model(self) -> tuple[Errors, float]:
        """The error model that the pairs support, and its gain in ln likelihood."""
        estimates = self.estimates
        if not estimates.fits_errors or estimates.n_common < self.tuning.em.min_pairs:
            return estimates.errors, 0.0
        pairs, tuning = estimates.setting.pairs, self.tuning
        return better_model(estimates.errors, pairs, self.p_counted, tuning.n_model_pairs, tuning.error_fit)

    def must_widen(self) -> bool:
        """Whether the outer part of the gate still contains true pairs, and a wider gate is affordable."""
        limit, tuning, significant_tail_gain = (
            self.gate_sigmas,
            self.tuning,
            self.tuning.em.scales.significant_tail_gain,
        )
        if limit >= tuning.max_gate_sigmas or not self.estimates.fits_errors:
            return False
        if _is_narrow(self.estimates, self.p_counted, limit, tuning):
            return True
        chance = _chance_candidates(self.estimates, self.p_counted, 2.0)
        if (
            tuning.suspect_tail_gain < self.estimates.tail_gain < significant_tail_gain
            and chance < tuning.max_chance_suspected
        ):
            return True  # pairs farther out decide whether the tail is real
        significant = self.estimates.tail_gain >= significant_tail_gain
        if chance > (tuning.max_chance_suspected if significant else tuning.max_chance_tail):
            return False
        return self._extends_to_edge()

    def suspects_tail(self) -> bool:
        """Whether errors may have a tail beyond the gate, and a slightly wider gate is affordable."""
        estimates, tuning = self.estimates, self.tuning
        wider = tuning.gate_step * self.gate_sigmas
        if not estimates.fits_errors or estimates.n_common < tuning.em.min_pairs or wider > tuning.max_gate_sigmas:
            return False
        if _chance_candidates(estimates, self.p_counted, tuning.gate_step) > tuning.max_chance_scale:
            return False
        if estimates.tail_gain >= tuning.em.scales.significant_tail_gain:
            return self._extends_to_edge()
        errors = estimates.errors
        typical = 1.4 * errors.typical_scale
        wide = sum(x for scale, x in zip(errors.scales, errors.shares, strict=True) if scale > typical)
        return estimates.tail_gain > tuning.suspect_tail_gain or wide > tuning.suspect_wide_share

    def _extends_to_edge(self) -> bool:
        """Whether true pairs lie in the outer part of the gate."""
        square = self.estimates.errors.pairs(self.estimates.setting.pairs).mahalanobis_sq
        beyond = float(self.p_counted[square > (0.7 * self.gate_sigmas) ** 2].sum())
        estimates, tuning = self.estimates, self.tuning
        of_tail = self.gate_sigmas > 1.5 * estimates.errors.typical_scale * _radius(None, estimates.setting.pairs.d)
        if of_tail and _chance_candidates(estimates, self.p_counted, 2.0) < tuning.max_negligible_chance:
            return beyond > 0.5
        return beyond > 1.0 + tuning.min_outer_share * float(self.p_counted.sum())


def _chance_candidates(estimates: Estimates, p_counted: FloatArray, wider: float) -> float:
    """Mean number of chance candidates of a record in a gate ``wider`` times as wide."""
    return estimates.setting.by_chance(p_counted) * wider**estimates.setting.pairs.d


def _is_narrow(estimates: Estimates, p_counted: FloatArray, limit: float, tuning: MatchTuning) -> bool:
    """Whether a gate of ``limit`` sigmas is too narrow for the typical errors, and a wider gate is affordable."""
    if limit >= tuning.max_gate_sigmas or not estimates.fits_errors:
        return False
    needed = _radius(None, estimates.setting.pairs.d) * estimates.errors.typical_scale
    chance = _chance_candidates(estimates, p_counted, 2.0)
    return tuning.max_scale_excess * limit < needed and chance < tuning.max_chance_scale


@dataclass(frozen=True)
class _GateSearch:
    """EM iterations with a gate that is doubled until it is wide enough.

    gate_errors : errors of the gate's distances and of the residuals' model. seed_errors, min_sigmas : errors and gate
    radius of the first iteration, where a tail is tested.
    """

    coverage: Coverage
    photometry: Photometry | None
    precision: bool
    density: tuple[float, float] | None
    gate: ChiSquare | Radius | None
    sampling: Sampling
    progress: Callable[[str], None]
    gate_errors: Errors = AS_QUOTED
    tuning: MatchTuning = DEFAULT_MATCH
    columns: ColumnEvidence | None = None
    trends: tuple[Trend, ...] = ()
    seed_errors: Errors | None = None
    min_sigmas: float = 0.0

    def run(self, errors: Errors | None, max_iterations: int) -> _GateResult:
        """The result after at most ``max_iterations``; ``errors`` are estimated if not given."""
        first, second = self.coverage.first, self.coverage.second
        limit, iterations = max(_radius(self.gate, first.d), self.min_sigmas), 0
        estimates, whole = None, None
        while True:
            self.progress("gate")
            pairs = (self.gate or Radius(limit))(*self.gate_errors.records(first, second))
            refuse_crowds(pairs)
            near = pairs
            if self.gate_errors.as_modelled:
                pairs = pairs.of(first, second)
            whole = Setting.whole(pairs, self.coverage) if whole is None else replace(whole, pairs=pairs)
            part = whole.sample(self.sampling)
            photometry = (
                self.photometry if part is whole or self.photometry is None else self.photometry.part(*part.rows)
            )
            columns = self.columns if part is whole or self.columns is None else self.columns.part(*part.rows)
            if estimates is None:
                # Close candidates in excess of chance are common objects.
                inner, by_chance = _inner_counts(near, limit)
                excess = (inner - by_chance) / min(len(first), len(second))
                estimates = Estimates.initial(
                    part, errors, photometry, self.density, excess, self.precision, self.tuning.em, columns
                )
                initial_errors = errors or self.gate_errors.with_mixture(self.seed_errors or self.gate_errors)
                estimates = replace(estimates, errors=initial_errors)
            else:
                estimates = estimates.for_setting(part, photometry, columns)
            result = self._run_gate(estimates, whole, limit, max_iterations - iterations)
            result = replace(result, iterations=iterations + result.iterations)
            estimates, p_counted, iterations = result.estimates, result.p_counted, result.iterations
            too_narrow = self.gate is None and result.must_widen()
            if not too_narrow or iterations >= max_iterations:
                estimates = estimates.with_evidence(p_counted, last=True)
                converged = result.converged and not too_narrow
                return replace(result, estimates=estimates, converged=converged, too_narrow=too_narrow)
            estimates = estimates.with_evidence(p_counted)
            limit = min(2.0 * limit, self.tuning.max_gate_sigmas)

    def _run_gate(self, estimates: Estimates, whole: Setting, limit: float, max_iterations: int) -> _GateResult:
        """The result with one gate; after one iteration if that shows the gate to be too narrow."""

        def narrow(estimates: Estimates, p_counted: FloatArray) -> bool:
            return self.gate is None and _is_narrow(estimates, p_counted, limit, self.tuning)

        estimates, p_counted, n, converged = iterate(estimates, max_iterations, self.progress, narrow)
        return _GateResult(whole, estimates, p_counted, limit, n, converged, estimates.setting.n_counted, self.tuning)

    def without_message_errors(self, result: _GateResult) -> _GateResult:
        """The result after further iterations with the errors of messages removed.

        In crowds messages give one true pair in a hundred less than exact sums, and the shares estimated from them
        multiply that: fewer common objects are expected, so that pairs become less probable.
        """
        errors = result.estimates.message_errors()
        if errors is None:
            return result
        most = self.tuning.max_iterations
        remaining = max(most - result.iterations, 2 * most // 3, 5)
        estimates, p_counted, n, converged = iterate(
            result.estimates, remaining, self.progress, message_errors=errors
        )  # fmt: skip
        estimates = estimates.with_evidence(p_counted, last=True)
        return replace(
            result, estimates=estimates, p_counted=p_counted, iterations=result.iterations + n,
            converged=result.converged and converged,
        )  # fmt: skip

    def match_averaged(self, scan: ErrorScan) -> tuple[Identification, Estimate]:
        """All records identified, averaged over the errors that few pairs do not rule out."""
        first, second = self.coverage.first, self.coverage.second
        self.progress("gate")
        error_average = scan.average(first.d, self.tuning.grid)
        pairs = error_average.candidates(first, second)
        refuse_crowds(pairs)
        whole = Setting.whole(pairs, self.coverage)
        share = scan.common / min(len(first), len(second))
        estimates = Estimates.initial(
            whole, AS_QUOTED, self.photometry, self.density, share, self.precision, self.tuning.em, self.columns
        )
        estimates = replace(estimates, average=Average.of(error_average, pairs, scan.weight, scan.common))
        estimates, p_counted, n, converged = iterate(estimates, self.tuning.max_iterations, self.progress)
        estimates = estimates.with_evidence(p_counted, last=True)
        self.progress("identification")
        average = estimates.average
        assert average is not None
        answer = identify_averaged(
            average, pairs, estimates.rule(), *estimates.expected_counts(), estimates.companion_log_odds()
        )
        estimates = replace(estimates, errors=average.typical, fits_errors=True)
        limit = math.sqrt(float(error_average.limits.max()))
        result = _GateResult(whole, estimates, p_counted, limit, n, converged, whole.n_counted, self.tuning)
        estimate = _to_estimate(answer, self.coverage, result, [])
        return answer, replace(estimate, error_ranges=error_average.ranges(average.weight))

    def identify_all(self, result: _GateResult) -> tuple[Identification, _GateResult]:
        """All records identified; after further iterations over all of them if a sample was not representative."""
        estimates = result.estimates
        if result.sampled:
            estimates = estimates.for_setting(result.whole, self.photometry, self.columns)
        answer = self._identify(estimates)
        if not result.sampled or _agrees_with_sample(
            float(answer.p_pair.sum()), estimates.expected_common(), float(result.p_counted.sum()), self.tuning
        ):
            return answer, replace(result, estimates=estimates)
        estimates = estimates.maximization(answer.p_pair, answer.evidence.log_ratio)
        remaining = max(self.tuning.max_iterations - result.iterations, 5)
        estimates, p_counted, n, converged = iterate(estimates, remaining, self.progress)
        iterations, estimates = result.iterations + n, estimates.with_evidence(p_counted, last=True)
        whole = result.whole
        result = _GateResult(
            whole, estimates, p_counted, result.gate_sigmas, iterations, converged, whole.n_counted, self.tuning
        )
        return self._identify(estimates), result

    def _identify(self, estimates: Estimates) -> Identification:
        self.progress("identification")
        pairs, companion_log_odds = estimates.setting.pairs, estimates.companion_log_odds()
        if companion_log_odds is not None:
            return identify_averaged(None, pairs, estimates.rule(), *estimates.expected_counts(), companion_log_odds)
        return identify(pairs.first, pairs.second, rule=estimates.rule(), gate=lambda first, second: pairs)


def _agrees_with_sample(common: float, expected: float, sampled: float, tuning: MatchTuning) -> bool:
    """Whether the number of common objects is the one expected from a sample with ``sampled`` common objects."""
    error = tuning.max_sample_error + tuning.min_significance / math.sqrt(max(sampled, 1.0))
    return abs(common - expected) <= error * expected


def _to_estimate(answer: Identification, coverage: Coverage, result: _GateResult, remarks: list[str]) -> Estimate:
    """The estimates as of the last identification."""
    estimates, common = result.estimates, float(answer.p_pair.sum())
    n_1, n_2 = (max(int(np.count_nonzero(covered)), 1) for covered in coverage.covered)
    photometry = estimates.photometry if estimates.photometry is not None and estimates.photometry.is_fitted else None
    precision = None if estimates.grades is None else estimates.grades.rule
    estimate = Estimate(
        common, min(1.0, common / n_1), min(1.0, common / n_2), estimates.errors, result.gate_sigmas, coverage,
        result.iterations, result.converged, result.learned_from, tuple(remarks) + _notes(result, common), photometry,
        precision, answer,
        estimates.fits_errors and common >= result.tuning.em.min_pairs, columns=estimates.columns, tuning=result.tuning,
    )  # fmt: skip
    if not estimates.errors.as_modelled:
        return estimate
    return replace(estimate, gate_sigmas=result.gate_sigmas * estimate.typical_scale / estimates.errors.typical_scale)


def _notes(result: _GateResult, common: float) -> tuple[str, ...]:
    """Remarks for the user."""
    notes, estimates = [], result.estimates
    if not result.converged:
        notes.append("the estimates had not converged at the last iteration")
    if common < 0.5:
        notes.append("no common object is expected: the sources seem to have no object in common")
    if estimates.fits_errors and common < result.tuning.em.min_pairs:
        consequence = (
            "probabilities are averaged over what they leave open"
            if estimates.average
            else "the quoted errors are used"
        )
        notes.append(f"too few pairs ({common:.1f}) to judge the errors; {consequence}")
    if estimates.photometry is not None and not estimates.photometry.has_relation:
        few = f"too few pairs with magnitudes of both (of {common:.1f})"
        notes.append(f"{few} to fit the magnitudes; they are not used")
    relation = None if estimates.photometry is None else estimates.photometry.first_relation
    if estimates.photometry is not None and relation is not None and relation.unrelated > result.tuning.max_unrelated:
        error, spread_mag = estimates.photometry.quoted_and_spread(estimates.setting.pairs, result.p_counted)
        notes.append(
            f"the quoted errors of the magnitudes, {error:.2g} mag, are larger than the spread of those of the pairs, "
            f"{spread_mag:.2g} mag: they have hardly any weight"
            if error > spread_mag
            else f"the magnitudes of {relation.unrelated:.0%} of the pairs are unrelated, and "
            "have hardly any weight: are they of these objects, and in the right columns?"
        )
    return tuple(notes)


def _radius(gate: ChiSquare | Radius | None, d: int) -> float:
    """Radius of a gate, or of the default gate, in d features, in standard deviations."""
    return gate.sigmas if isinstance(gate, Radius) else math.sqrt((gate or ChiSquare()).limit(d))


def _inner_counts(pairs: Pairs, limit: float) -> tuple[float, float]:
    """Candidates in the inner half of the gate, and the number expected there from the density in its outer part."""
    inner = int(np.count_nonzero(pairs.mahalanobis_sq < (0.5 * limit) ** 2))
    return float(inner), (len(pairs) - inner) / (2.0**pairs.d - 1.0)


def _has_excess(pairs: Pairs, limit: float, tuning: MatchTuning) -> bool:
    """Whether the inner half of the gate has significantly more candidates than the outer part's density predicts."""
    inner, by_chance = _inner_counts(pairs, limit)
    return inner - by_chance > tuning.min_significance * math.sqrt(inner + by_chance / (2.0**pairs.d - 1.0))
