"""Gate search: EM iterations with a gate that is widened while its outer part still contains true pairs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sameas._identify import identify
from sameas.arrays import FloatArray
from sameas.assignment import refuse_crowds
from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.coverage import Coverage
from sameas.estimate.em import DEFAULT_EM, MIN_PAIRS_TO_LEARN, EMState, EMTuning, iterate
from sameas.estimate.error_average import Average, identify_averaged
from sameas.estimate.error_grid import ErrorScan
from sameas.estimate.error_model import better_model
from sameas.estimate.error_trends import Trend
from sameas.estimate.photometry import Photometry
from sameas.estimate.result import Estimate
from sameas.estimate.sample import Sampling, Setting
from sameas.estimate.unresolved import BlendResolution
from sameas.evidence import Errors
from sameas.evidence.rule import AS_QUOTED
from sameas.gate import ChiSquare, Pairs, Radius
from sameas.result import Identification

#: The gate is widened when this share of the expected true pairs lies beyond 0.7 of its radius (4e-5 where errors are
#: as quoted), and one pair more.
MIN_OUTER_SHARE = 6e-5
#: Where a record would have fewer chance candidates, half a pair of a tail suffices: its last pairs are otherwise
#: certain to have no partner.
MAX_NEGLIGIBLE_CHANCE = 0.1
MAX_GATE_SIGMAS = 400.0  # greatest radius of the gate
#: The gate is widened when the typical errors exceed those it was made for by this factor; up to there it loses only
#: 2e-6 of the pairs.
MAX_SCALE_EXCESS = 1.25
#: The gate is not widened for a tail, or for underestimated errors, when a record would have on average more chance
#: candidates than this.
MAX_CHANCE_TAIL, MAX_CHANCE_SCALE = 0.5, 8.0
#: A tail with this gain in ln likelihood that is not yet significant is looked for in a wider gate. Then, and with a
#: significant tail, a record may have this many chance candidates.
SUSPECT_TAIL_GAIN, MAX_CHANCE_SUSPECTED = 1.0, 2.0
#: The gate is widened by this factor to test for a tail that begins at its edge: after SUSPECT_TAIL_GAIN, or where
#: SUSPECT_WIDE_SHARE of the pairs has errors above 1.4 typical ones.
GATE_STEP = 1.5
SUSPECT_WIDE_SHARE = 0.1
N_MODEL_PAIRS = 3_000  # pairs from which the error model of the evidence is fitted
MIN_SIGNIFICANCE = 4.0  # excess of close candidates over chance, in standard deviations, from which errors are fitted
MAX_UNRELATED = 0.5  # from this share of pairs with unrelated magnitudes on, a note is given


@dataclass(frozen=True)
class MatchTuning:
    """Limits for widening the gate and for accepting estimates.

    max_iterations : EM iterations after which no further error model is tried; its iterations are at most two thirds of
        these more.
    max_sample_error : a sample is rejected when the number of common objects differs from its prediction by more than
        this share and the statistical error.
    fits_trends, fits_resolution : whether growth of the errors, and the resolution of a source that blends neighbours,
        are fitted.
    em : tuning of EM iterations.
    """

    max_iterations: int = 30
    max_sample_error: float = 0.02
    fits_trends: bool = True
    fits_resolution: bool = True
    em: EMTuning = DEFAULT_EM


DEFAULT_MATCH = MatchTuning()


@dataclass(frozen=True)
class GateResult:
    """The state after the EM iterations with one gate.

    whole : all candidates. estimates : of all or of a sample. p_counted : (m,) probabilities of their pairs.
    too_narrow : whether the iterations ended before the gate was wide enough.
    """

    whole: Setting
    estimates: EMState
    p_counted: FloatArray
    gate_sigmas: float
    iterations: int
    converged: bool
    learned_from: tuple[int, int]
    tuning: MatchTuning
    too_narrow: bool = False

    def is_worse_than(self, other: GateResult) -> bool:
        """Whether pairs are lost beyond this gate only, or only these estimates have not converged."""
        return (self.too_narrow and not other.too_narrow) or (other.converged and not self.converged)

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
        if not estimates.fits_errors or estimates.n_common < MIN_PAIRS_TO_LEARN:
            return estimates.errors, 0.0
        pairs = estimates.setting.pairs
        p_single = estimates.p_single(self.p_counted)
        return better_model(estimates.errors, pairs, p_single, N_MODEL_PAIRS)

    def must_widen(self) -> bool:
        """Whether the outer part of the gate still contains true pairs, and a wider gate is affordable."""
        limit, significant_tail_gain = self.gate_sigmas, self.tuning.em.significant_tail_gain
        if limit >= MAX_GATE_SIGMAS or not self.estimates.fits_errors:
            return False
        if _is_narrow(self.estimates, self.p_counted, limit):
            return True
        chance = _chance_candidates(self.estimates, self.p_counted, 2.0)
        if SUSPECT_TAIL_GAIN < self.estimates.tail_gain < significant_tail_gain and chance < MAX_CHANCE_SUSPECTED:
            return True  # pairs farther out decide whether the tail is real
        significant = self.estimates.tail_gain >= significant_tail_gain
        if chance > (MAX_CHANCE_SUSPECTED if significant else MAX_CHANCE_TAIL):
            return False
        return self._extends_to_edge()

    def suspects_tail(self) -> bool:
        """Whether errors may have a tail beyond the gate, and a slightly wider gate is affordable."""
        estimates = self.estimates
        wider = GATE_STEP * self.gate_sigmas
        if not estimates.fits_errors or estimates.n_common < MIN_PAIRS_TO_LEARN or wider > MAX_GATE_SIGMAS:
            return False
        if _chance_candidates(estimates, self.p_counted, GATE_STEP) > MAX_CHANCE_SCALE:
            return False
        if estimates.tail_gain >= self.tuning.em.significant_tail_gain:
            return self._extends_to_edge()
        errors = estimates.errors
        typical = 1.4 * errors.typical_scale
        wide = sum(x for scale, x in zip(errors.scales, errors.shares, strict=True) if scale > typical)
        return estimates.tail_gain > SUSPECT_TAIL_GAIN or wide > SUSPECT_WIDE_SHARE

    def _extends_to_edge(self) -> bool:
        """Whether true pairs lie in the outer part of the gate."""
        square = self.estimates.errors.pairs(self.estimates.setting.pairs).mahalanobis_sq
        beyond = float(self.p_counted[square > (0.7 * self.gate_sigmas) ** 2].sum())
        estimates = self.estimates
        of_tail = self.gate_sigmas > 1.5 * estimates.errors.typical_scale * _radius(None, estimates.setting.pairs.d)
        if of_tail and _chance_candidates(estimates, self.p_counted, 2.0) < MAX_NEGLIGIBLE_CHANCE:
            return beyond > 0.5
        return beyond > 1.0 + MIN_OUTER_SHARE * float(self.p_counted.sum())


def _chance_candidates(estimates: EMState, p_counted: FloatArray, wider: float) -> float:
    """Mean number of chance candidates of a record in a gate ``wider`` times as wide."""
    return estimates.setting.by_chance(p_counted) * wider**estimates.setting.pairs.d


def _is_narrow(estimates: EMState, p_counted: FloatArray, limit: float) -> bool:
    """Whether a gate of ``limit`` sigmas is too narrow for the typical errors, and a wider gate is affordable."""
    if limit >= MAX_GATE_SIGMAS or not estimates.fits_errors:
        return False
    needed = _radius(None, estimates.setting.pairs.d) * estimates.errors.typical_scale
    chance = _chance_candidates(estimates, p_counted, 2.0)
    return MAX_SCALE_EXCESS * limit < needed and chance < MAX_CHANCE_SCALE


@dataclass(frozen=True)
class GateSearch:
    """EM iterations with a gate that is doubled until it is wide enough.

    gate_errors : errors of the gate's distances and of the residuals' model. seed_errors, min_sigmas : errors and gate
    radius of the first iteration, where a tail is tested. resolution : of a source that blends neighbours; None if both
    resolve all.
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
    resolution: BlendResolution | None = None

    def run(self, errors: Errors | None, max_iterations: int) -> GateResult:
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
            photometry, columns = self.photometry, self.columns
            if part is not whole:
                photometry, columns = photometry and photometry.part(*part.rows), columns and columns.part(*part.rows)
            if estimates is None:
                # Close candidates in excess of chance are common objects.
                inner, by_chance = _inner_counts(near, limit)
                excess = (inner - by_chance) / min(len(first), len(second))
                seed = errors or self.gate_errors.with_mixture(self.seed_errors or self.gate_errors)
                estimates = EMState.initial(
                    part, seed, errors is None, photometry, self.density, excess, self.precision, self.tuning.em,
                    columns,
                )  # fmt: skip
            else:
                estimates = estimates.for_setting(part, photometry, columns)
            estimates = estimates.with_unresolved(self.resolution)
            result = self._run_gate(estimates, whole, limit, max_iterations - iterations)
            result = replace(result, iterations=iterations + result.iterations)
            estimates, p_counted, iterations = result.estimates, result.p_counted, result.iterations
            too_narrow = self.gate is None and result.must_widen()
            if not too_narrow or iterations >= max_iterations:
                estimates = estimates.with_evidence(p_counted, last=True)
                converged = result.converged and not too_narrow
                return replace(result, estimates=estimates, converged=converged, too_narrow=too_narrow)
            estimates = estimates.with_evidence(p_counted)
            limit = min(2.0 * limit, MAX_GATE_SIGMAS)

    def _run_gate(self, estimates: EMState, whole: Setting, limit: float, max_iterations: int) -> GateResult:
        """The result with one gate; after one iteration if that shows the gate to be too narrow."""

        def narrow(estimates: EMState, p_counted: FloatArray) -> bool:
            return self.gate is None and _is_narrow(estimates, p_counted, limit)

        estimates, p_counted, n, converged = iterate(estimates, max_iterations, self.progress, narrow)
        return GateResult(whole, estimates, p_counted, limit, n, converged, estimates.setting.n_counted, self.tuning)

    def remaining(self, result: GateResult) -> int:
        """Iterations that may follow on a result: those left, at least two thirds of all."""
        most = self.tuning.max_iterations
        return max(most - result.iterations, 2 * most // 3, 5)

    def without_message_errors(self, result: GateResult) -> GateResult:
        """The result after further iterations with the errors of messages removed.

        In crowds messages give one true pair in a hundred less than exact sums, and the shares estimated from them
        multiply that: fewer common objects are expected, so that pairs become less probable.
        """
        errors = result.estimates.message_errors()
        if errors is None:
            return result
        estimates, p_counted, n, converged = iterate(
            result.estimates, self.remaining(result), self.progress, message_errors=errors
        )
        estimates = estimates.with_evidence(p_counted, last=True)
        return replace(
            result, estimates=estimates, p_counted=p_counted, iterations=result.iterations + n,
            converged=result.converged and converged,
        )  # fmt: skip

    def match_averaged(self, scan: ErrorScan) -> tuple[Identification, Estimate]:
        """All records identified, averaged over the errors that few pairs do not rule out."""
        first, second = self.coverage.first, self.coverage.second
        self.progress("gate")
        error_average = scan.average(first.d)
        pairs = error_average.candidates(first, second)
        refuse_crowds(pairs)
        whole = Setting.whole(pairs, self.coverage)
        share = scan.common / min(len(first), len(second))
        estimates = EMState.initial(
            whole, AS_QUOTED, False, self.photometry, self.density, share, self.precision, self.tuning.em, self.columns
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
        result = GateResult(whole, estimates, p_counted, limit, n, converged, whole.n_counted, self.tuning)
        estimate = to_estimate(answer, self.coverage, result, [])
        return answer, replace(estimate, error_ranges=error_average.ranges(average.weight))

    def identify_all(self, result: GateResult) -> tuple[Identification, GateResult]:
        """All records identified; after further iterations over all of them if a sample was not representative."""
        estimates = result.estimates
        if result.sampled:
            estimates = estimates.for_setting(result.whole, self.photometry, self.columns)
            estimates = estimates.with_unresolved(self.resolution)
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
        result = GateResult(
            whole, estimates, p_counted, result.gate_sigmas, iterations, converged, whole.n_counted, self.tuning
        )
        return self._identify(estimates), result

    def _identify(self, estimates: EMState) -> Identification:
        self.progress("identification")
        pairs, companion_log_odds = estimates.setting.pairs, estimates.companion_log_odds()
        if companion_log_odds is not None:
            return identify_averaged(None, pairs, estimates.rule(), *estimates.expected_counts(), companion_log_odds)
        return identify(pairs.first, pairs.second, rule=estimates.rule(), gate=lambda first, second: pairs)


def _agrees_with_sample(common: float, expected: float, sampled: float, tuning: MatchTuning) -> bool:
    """Whether the number of common objects is the one expected from a sample with ``sampled`` common objects."""
    error = tuning.max_sample_error + MIN_SIGNIFICANCE / math.sqrt(max(sampled, 1.0))
    return abs(common - expected) <= error * expected


def to_estimate(answer: Identification, coverage: Coverage, result: GateResult, remarks: list[str]) -> Estimate:
    """The estimates as of the last identification."""
    estimates, common = result.estimates, float(answer.p_pair.sum())
    n_1, n_2 = (max(int(np.count_nonzero(covered)), 1) for covered in coverage.covered)
    photometry = estimates.photometry if estimates.photometry is not None and estimates.photometry.is_fitted else None
    precision = None if estimates.grades is None else estimates.grades.rule
    estimate = Estimate(
        common=common, share_1=min(1.0, common / n_1), share_2=min(1.0, common / n_2), errors=estimates.errors,
        gate_sigmas=result.gate_sigmas, coverage=coverage, iterations=result.iterations, converged=result.converged,
        learned_from=result.learned_from, notes=tuple(remarks) + _notes(result, answer), photometry=photometry,
        precision=precision, answer=answer,
        errors_estimated=estimates.fits_errors and common >= MIN_PAIRS_TO_LEARN, columns=estimates.columns,
    )  # fmt: skip
    if not estimates.errors.as_modelled:
        return estimate
    return replace(estimate, gate_sigmas=result.gate_sigmas * estimate.typical_scale / estimates.errors.typical_scale)


def _notes(result: GateResult, answer: Identification) -> tuple[str, ...]:
    """Remarks for the user."""
    notes, estimates, common = [], result.estimates, float(answer.p_pair.sum())
    if not result.converged:
        moved = f"the last one moved {estimates.change:.2g} of {common:.0f} common objects"
        notes.append(f"the estimates had not converged after {result.iterations} iterations: {moved}")
    if common < 0.5:
        notes.append("no common object is expected: the sources seem to have no object in common")
    if estimates.fits_errors and common < MIN_PAIRS_TO_LEARN:
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
    if estimates.photometry is not None and relation is not None and relation.unrelated > MAX_UNRELATED:
        error, spread_mag = estimates.photometry.quoted_and_spread(answer.pairs, answer.p_pair)
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


def has_excess(pairs: Pairs, limit: float) -> bool:
    """Whether the inner half of the gate has significantly more candidates than the outer part's density predicts."""
    inner, by_chance = _inner_counts(pairs, limit)
    return inner - by_chance > MIN_SIGNIFICANCE * math.sqrt(inner + by_chance / (2.0**pairs.d - 1.0))
