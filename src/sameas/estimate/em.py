"""EM iterations over one list of candidates, until the estimates converge (METHOD 6).

The E-step computes the probability of every pair from the previous estimates. The M-step uses these probabilities as
weights to estimate the shares of common objects, the distribution of the residuals and the relations of the magnitudes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.assignment import Hypothesis
from sameas.errors import InputError
from sameas.estimate.clustering import clustering
from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.companions import Companions
from sameas.estimate.coverage import local_share
from sameas.estimate.error_average import Average, Averaged, HypothesisSums, without_positions
from sameas.estimate.error_scales import SIGNIFICANT_TAIL_GAIN, fit_errors
from sameas.estimate.grades import Grades, first_magnitudes
from sameas.estimate.photometry import LearningPairs, Photometry
from sameas.estimate.quantity import MAX_MISSING
from sameas.estimate.sample import Setting
from sameas.estimate.unresolved import (
    MAX_UNRESOLVED_RECORDS,
    MIN_RESOLVED_PAIRS,
    BlendResolution,
    Unresolved,
    best_resolution,
)
from sameas.evidence import Brightness, Errors, PoissonField, Rule
from sameas.evidence.detection import logit
from sameas.evidence.rule import AS_QUOTED
from sameas.groups import Groups
from sameas.kernels import threads
from sameas.posterior import APPROXIMATE, Posterior, by_messages, posterior

#: Where errors are fitted, a pair of a lower probability gets its odds from its likelihood ratio and its records'
#: probabilities of having no other partner; higher probabilities are clipped.
MIN_P_PAIR, MAX_P_PAIR = 1e-3, 1.0 - 1e-12
MIN_SHARE = 1e-6  # lower limit of the share of records without a partner
#: Pairs of smaller ln odds, before one-to-one, are less probable than 1e-5; sums ignore them.
MIN_LOG_ODDS = math.log(1e-5)
MIN_INITIAL_SHARE, MAX_INITIAL_SHARE = 0.1, 0.95  # limits of the initial share of common objects in the poorer source
MIN_LARGEST_SCALE = 3.4  # the mixture of error scales reaches at least to this scale
#: Twice the number of chance candidates within √2 of its scale that an error component may have.
MAX_CHANCE_CANDIDATES = 0.15
MIN_PAIRS_TO_LEARN = 50.0  # errors, magnitudes and columns are fitted from this expected number of pairs on
#: The sizes of quoted errors are not used where magnitudes are informative and at most this share of the records has
#: none.
MAX_SHARE_MISSING = 0.05
MORE_TAIL_GAIN = 2.0  # times the gain in ln likelihood that a tail must have, after each time that it was dropped again
MIN_EVIDENCE_FITS = 1  # fits of magnitudes and columns before the iterations may end
#: Converged when the expected remaining change of the number of common objects is at most this share of its standard
#: error, or when its last change was at most this number.
TOLERANCE, TOLERANCE_NUMBER = 0.2, 0.01
TOLERANCE_WEIGHT = 0.01  # greatest change of the weights of averaged errors at convergence
MIN_BY_MESSAGE = 0.02  # messages are corrected by exact sums if they give at least this share of the common objects
MIN_RATE = 0.25  # lower limit of the ratio of one change to the previous one, for the expected remaining change
#: Companions are ignored when they bring the share of common objects below this fraction of the share from close pairs
#: and companions.
MIN_COMPANION_SHARE = 0.5


@dataclass(frozen=True)
class EMTuning:
    """What EM iterations fit. companions : whether companions. significant_tail_gain : gain in ln likelihood from which
    a tail of the errors is accepted."""

    companions: bool = True
    significant_tail_gain: float = SIGNIFICANT_TAIL_GAIN


DEFAULT_EM = EMTuning()

Both = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class EMState:
    """The estimates after an EM iteration.

    setting : candidates and records, the same in all iterations.
    p_partner : (n₁,), (n₂,) probability of having a partner, estimated where ``counted``.
    local_shares : (n₁,), (n₂,) local share of the source's other records that have a partner.
    errors : distribution of the residuals, fitted if ``fits_errors``.
    photometry : relations of the magnitudes; None without magnitudes. n_evidence_fits : fits of photometry and columns.
    n_common : expected number of common objects among the counted records. change : its change in the last iteration;
        NaN before the first; 0 after the first and with new candidates.
    tail_gain : gain in ln likelihood from a tail of the errors, whether it is accepted or not.
    uses_precision : whether the sizes of the quoted errors may be evidence. grades : that evidence, once estimated.
    density : (ρ₁, ρ₂) of all records of each source if given by the user, else None.
    average : errors over which probabilities are averaged because pairs are too few; None if ``errors`` are used.
    columns : evidence of other columns, or None.
    companions : excess of close neighbours within a source; None without an excess.
    unresolved : neighbours that one source does not resolve; None without any.
    """

    setting: Setting
    p_partner: Both
    counted: tuple[BoolArray, BoolArray]
    local_shares: Both
    errors: Errors
    fits_errors: bool
    photometry: Photometry | None
    density: tuple[float, float] | None = None
    n_evidence_fits: int = 0
    n_common: float = math.nan
    change: float = math.nan
    tail_gain: float = 0.0
    uses_precision: bool = True
    grades: Grades | None = None
    average: Average | None = None
    columns: ColumnEvidence | None = None
    companions: Companions | None = None
    unresolved: Unresolved | None = None
    tuning: EMTuning = DEFAULT_EM

    @classmethod
    def initial(
        cls,
        setting: Setting,
        errors: Errors,
        fits_errors: bool,
        photometry: Photometry | None,
        density: tuple[float, float] | None,
        share: float,
        uses_precision: bool,
        tuning: EMTuning = DEFAULT_EM,
        columns: ColumnEvidence | None = None,
    ) -> EMState:
        """The estimates before the first iteration, with this ``share`` of the poorer source in common."""
        n1, n2 = (len(rows) for rows in setting.rows)
        guess = min(max(share, MIN_INITIAL_SHARE), MAX_INITIAL_SHARE) * min(n1, n2)
        partner = np.full(n1, guess / n1), np.full(n2, guess / n2)
        estimates = cls(
            setting, partner, setting.counted, partner, errors, fits_errors, photometry, density,
            uses_precision=uses_precision, tuning=tuning, columns=columns and columns.in_folds(setting),
        )  # fmt: skip
        return replace(estimates, n_common=float(partner[0][setting.counted[0]].sum())).with_companions()

    def for_setting(
        self, setting: Setting, photometry: Photometry | None, columns: ColumnEvidence | None = None
    ) -> EMState:
        """The same estimates for other candidates and records, whose magnitudes and other columns are given."""
        partner, counted = [], []
        for old, new, p, estimated in zip(self.setting.rows, setting.rows, self.p_partner, self.counted, strict=True):
            p_row = np.full(max(old[-1], new[-1]) + 1, np.nan)
            p_row[old[estimated]] = p[estimated]
            partner.append(np.nan_to_num(p_row[new]))
            counted.append(np.isfinite(p_row[new]))
        if photometry is not None and self.photometry is not None:
            photometry = replace(photometry, chains=self.photometry.chains, curves=self.photometry.curves)
        grades = self.grades and self.grades.for_setting(setting, photometry)
        if columns is not None and self.columns is not None:
            columns = self.columns.for_setting(setting, columns)
        estimates = replace(
            self, setting=setting, photometry=photometry, change=0.0, grades=grades, columns=columns, unresolved=None
        )
        return estimates._with_partners((partner[0], partner[1]), (counted[0], counted[1])).with_companions(self)

    def with_companions(self, previous: EMState | None = None) -> EMState:
        """The same estimates with the companions of these candidates.

        previous : estimates for other candidates; their clustering is reused if the records are the same.
        """
        if not self.tuning.companions or self.density is not None:
            return self
        if previous is not None and previous.setting.pairs.same_records(self.setting.pairs):
            excess = None if previous.companions is None else previous.companions.clustering
        else:
            excess = clustering(self.setting)
        return replace(self, companions=None if excess is None else Companions.of(excess, self.setting))

    def with_unresolved(self, resolution: BlendResolution | None) -> EMState:
        """The same estimates with the neighbours that are not resolved among these candidates."""
        if resolution is None:
            return self
        magnitude = first_magnitudes(self.photometry)[1 - resolution.coarse]
        unresolved = Unresolved.of(resolution, self.setting, self.errors, magnitude)
        estimates = replace(self, unresolved=unresolved)
        return estimates._with_unresolved_by(estimates.expectation()[1])

    def _with_unresolved_by(self, p_pair: FloatArray) -> EMState:
        if self.unresolved is None:
            return self
        evidence = self.unresolved.with_probabilities(
            self.setting, self.errors, p_pair, self.shares(), self.brightness()
        )
        return replace(self, unresolved=evidence)

    def best_resolution(self, p_counted: FloatArray) -> BlendResolution | None:
        """The resolution that the positions show, given the probabilities (m,) of the pairs.

        None if there is none, the pairs are too few to know, or companions explain the neighbours: between two records
        of one object, too, lies that of the other source.
        """
        pairs, probable = self.setting.pairs, np.flatnonzero(p_counted > 0.5)
        paired = self.companions is not None and self.companions.clustering.level is None
        if paired or float(p_counted.sum()) < MIN_RESOLVED_PAIRS or not len(probable):
            return None
        # Probabilities without this evidence, as far as they are known.
        p_single = self.p_single(p_counted)
        unit = float(np.median(np.linalg.det(self.errors.typical_covariance(pairs, probable)))) ** (0.5 / pairs.d)
        # The pairs by the model S once, for all resolutions.
        setting, errors = replace(self.setting, pairs=self.errors.pairs(pairs)), AS_QUOTED.with_mixture(self.errors)

        def gain(resolution: BlendResolution) -> float:
            magnitude = first_magnitudes(self.photometry)[1 - resolution.coarse]
            every = -(-len(self.p_partner[resolution.coarse]) // MAX_UNRESOLVED_RECORDS)
            unresolved = Unresolved.of(resolution, setting, errors, magnitude, every)
            return -math.inf if unresolved is None else unresolved.gain(setting, errors, p_single, self.shares())

        return best_resolution(gain, unit)

    def p_single(self, p_pair: FloatArray) -> FloatArray:
        """(m,) probabilities that the pairs are one object, and no blend with a neighbour."""
        return p_pair if self.unresolved is None else p_pair * self.unresolved.single

    def _change(self, partner: Both) -> float:
        """Sum of the changes of the counted records' probabilities of a partner, in the source with the smaller sum.

        Not the change of their sum: it passes through 0 while errors and shares still move in opposite directions.
        """
        changes = zip(self.p_partner, partner, self.counted, strict=True)
        return min(float(np.abs(new - old)[counted].sum()) for old, new, counted in changes)

    def _with_partners(self, partner: Both, counted: tuple[BoolArray, BoolArray]) -> EMState:
        local_shares = _local_shares(self.setting, partner, counted)
        return replace(self, p_partner=partner, counted=counted, local_shares=local_shares)

    @property
    def mean_shares(self) -> tuple[float, float]:
        """Mean share of either source's counted records that have a partner."""
        one, two = (float(p[counted].mean()) for p, counted in zip(self.p_partner, self.counted, strict=True))
        return one, two

    @property
    def covered(self) -> tuple[BoolArray, BoolArray]:
        """(n₁,), (n₂,) records that are counted and lie where the other source observes."""
        (covered_1, covered_2), (counted_1, counted_2) = self.setting.covered, self.counted
        return covered_1 & counted_1, covered_2 & counted_2

    def shares(self) -> Both:
        """(n₁,), (n₂,) share of the source's records that have a partner, at each record's position."""
        if self.density is not None:
            one, two = self.mean_shares
            return np.full(len(self.p_partner[0]), one), np.full(len(self.p_partner[1]), two)
        return self.local_shares

    def brightness(self) -> Brightness | None:
        """Evidence of the magnitudes; None before the first fit and without magnitudes."""
        return None if self.photometry is None else self.photometry.rule(self.shares(), self.setting.pairs)

    def rule(self) -> Rule:
        """The rule made of all estimates."""
        rule: Rule = self._positions()
        graded = None if self.grades is None else self.grades.rule
        companions = None if self.companions is None else self.companions.rule
        columns = None if self.columns is None else self.columns.rule()
        unresolved = None if self.unresolved is None else self.unresolved.rule
        for term in (self.brightness(), graded, columns, companions, unresolved):
            rule = rule if term is None else rule + term
        return rule

    def _positions(self) -> PoissonField:
        if self.density is not None:
            (mean_1, mean_2), (all_1, all_2) = self.mean_shares, self.density
            alone_1, alone_2 = max(1.0 - mean_1, MIN_SHARE), max(1.0 - mean_2, MIN_SHARE)
            both = math.sqrt(all_1 * mean_1 * all_2 * mean_2)
            return PoissonField(both, all_1 * alone_1, all_2 * alone_2, self.errors)
        of_1, of_2 = self.setting.densities
        share_1, share_2 = self.local_shares
        # Both sources show the same common objects, so the rule takes the geometric mean of both densities. Each is
        # taken at its own record and excludes it; a density at the candidate would include it, and the pair would
        # support itself.
        common = of_1 * share_1, of_2 * share_2
        only_1 = of_1 * np.maximum(1.0 - share_1, MIN_SHARE)
        only_2 = of_2 * np.maximum(1.0 - share_2, MIN_SHARE)
        return PoissonField(common, only_1, only_2, self.errors)

    def expected_common(self) -> float:
        """Number of common objects expected from the shares."""
        return min(
            float((share * covered).sum()) for share, covered in zip(self.shares(), self.setting.covered, strict=True)
        )

    def message_errors(self) -> FloatArray | None:
        """(m,) probabilities of the pairs by exact sums around their records, minus those of the E-step by messages;
        None if hardly any are by messages, or they are averaged over errors."""
        if self.average is not None:
            return None
        by_message = 0.0

        def difference(groups: Groups, best: Hypothesis) -> Posterior:
            nonlocal by_message
            rough = by_messages(groups, best)
            approximate = rough.method[groups.group] == APPROXIMATE
            by_message = float(rough.p_pair[groups.order][approximate].sum())
            if by_message < MIN_BY_MESSAGE * self.n_common:
                return rough
            exact = posterior(groups, best)
            return replace(exact, p_pair=exact.p_pair - rough.p_pair)

        pairs, log_ratio = self.setting.pairs, self.rule()(self.setting.pairs).log_ratio
        sums = HypothesisSums.of(pairs, log_ratio, difference, self.companion_log_odds(), MIN_LOG_ODDS)
        return None if by_message < MIN_BY_MESSAGE * self.n_common else sums.p_pair

    def expectation(self) -> tuple[EMState, FloatArray, FloatArray]:
        """The E-step.

        Returns the estimates (with the weights of averaged errors updated), the (m,) probabilities of the pairs and
        the (m,) ln of their odds before one-to-one.
        """
        pairs, companion_log_odds = self.setting.pairs, self.companion_log_odds()
        evidence = self.rule()(pairs)
        if self.average is None:
            log_ratio = evidence.log_ratio
            p_pair = HypothesisSums.of(pairs, log_ratio, by_messages, companion_log_odds, MIN_LOG_ODDS).p_pair
            if companion_log_odds is not None:
                log_ratio = Averaged.one(pairs, p_pair, log_ratio).log_ratio
            return self, p_pair, log_ratio
        average, averaged = self.average.posterior(
            pairs, without_positions(evidence), *self.expected_counts(), companion_log_odds=companion_log_odds
        )
        return replace(self, average=average), averaged.p_pair, averaged.log_ratio

    def companion_log_odds(self) -> FloatArray | None:
        """(m,) ln of the odds, before one-to-one, that a pair is two companions; None without companions."""
        if self.companions is None or self.companions.clustering.level is not None:
            return None
        return self.companions.companion_log_odds(len(self.setting.pairs), *self.mean_shares)

    def expected_counts(self) -> tuple[float, tuple[int, int]]:
        """Expected number of common objects, and the numbers of covered records of both sources."""
        one, two = (max(int(np.count_nonzero(covered)), 1) for covered in self.setting.covered)
        return self.expected_common(), (one, two)

    def converged(self, previous: EMState) -> bool:
        """Whether the expected change of the number of common objects after the next iteration is small.

        Successive changes shrink by a ratio r: the greater of the share of information that is missing because pairs
        are uncertain, and the ratio of the last two changes. The variance of the number is Σ p(1 − p), times
        1/(1 − r) because the shares are estimated too.
        """
        if math.isnan(previous.change):
            return False
        if self.average is not None and previous.average is not None:
            weight_change = np.abs(self.average.weight - previous.average.weight).max()
            if weight_change > TOLERANCE_WEIGHT or np.isnan(weight_change):
                return False
        ratio = abs(self.change / previous.change) if previous.change else 0.0
        small = []
        for p_partner, counted in zip(self.p_partner, self.counted, strict=True):
            p = p_partner[counted]
            variance, mean = float((p * (1.0 - p)).sum()), float(p.mean())
            missing = min(variance / max(len(p) * mean * (1.0 - mean), 1e-300), MAX_MISSING)
            r = min(max(missing, ratio, MIN_RATE), MAX_MISSING)
            error = math.sqrt(variance / (1.0 - missing))
            small.append(abs(self.change) * r**2 / (1.0 - r) <= TOLERANCE * error)
        return all(small) or abs(self.change) <= TOLERANCE_NUMBER

    def evidence_converged(self, previous: EMState) -> bool:
        """Whether magnitudes, columns and grades were fitted often enough, and used in the last iteration."""
        fitted = (
            (self.photometry is None and self.columns is None)
            or self.n_common < MIN_PAIRS_TO_LEARN
            or self.n_evidence_fits >= MIN_EVIDENCE_FITS
        )
        graded = None if previous.grades is None else previous.grades.rule
        ungraded = self.grades is None or self.grades.rule is None
        return fitted and (ungraded or (graded is not None and graded.trained_on(self.setting.pairs)))

    def maximization(self, p_pair: FloatArray, log_ratio: FloatArray) -> EMState:
        """The M-step of shares, errors and grades; that of magnitudes and columns is :meth:`with_evidence`.

        p_pair, log_ratio : (m,) probabilities of the pairs, and ln of their odds before one-to-one.
        """
        pairs = self.setting.pairs
        partner = (
            np.minimum(np.bincount(pairs.i, p_pair, len(self.p_partner[0])), 1.0),
            np.minimum(np.bincount(pairs.j, p_pair, len(self.p_partner[1])), 1.0),
        )
        p_counted = self.setting.p_counted(p_pair)
        n_common = float(p_counted.sum())
        change = 0.0 if math.isnan(self.change) else self._change(partner)
        estimates = replace(self, n_common=n_common, change=change)
        estimates = estimates._with_partners(partner, self.setting.counted)
        companions, least = self.companions, MIN_COMPANION_SHARE
        if companions is not None and estimates.mean_shares[0] < least * companions.share:
            estimates = replace(estimates, companions=None)
        if n_common < MIN_PAIRS_TO_LEARN:
            return estimates._with_unresolved_by(p_pair)
        grades = self.grades
        if grades is None and self._uses_error_sizes():
            # Records are graded within ranges of magnitude only if the magnitudes of a pair are related. Otherwise the
            # part of an error that predicts magnitude, and with it completeness, would be lost.
            unrelated = self.photometry is None or (self.n_evidence_fits > 0 and not self.photometry.is_informative)
            grades = Grades.of(self.setting, None if unrelated else self.photometry)
        if grades is not None:
            ratios = replace(estimates, grades=grades)._partner_ratios()
            one, two = (None, None) if self.photometry is None else self.photometry.curves
            has_curve = one is not None, two is not None
            fitted = grades.fitted(pairs, p_counted, partner, estimates.covered, ratios, has_curve)
            estimates = replace(estimates, grades=fitted)
        if self.fits_errors:
            # An error component so wide that it is full of chance candidates cannot be distinguished from chance.
            square = self.errors.pairs(pairs).mahalanobis_sq
            radius = math.sqrt(float(square.max(initial=1.0)))
            by_chance = max(self.setting.by_chance(p_counted), 1e-12)
            widest = radius * (MAX_CHANCE_CANDIDATES / by_chance) ** (1.0 / pairs.d)
            log_odds = estimates.log_odds_without_errors(square, p_pair, log_ratio)
            fit = fit_errors(
                square, log_odds, pairs.d, self.errors, widest=max(widest, MIN_LARGEST_SCALE),
                significant_tail_gain=self.tuning.significant_tail_gain,
            )  # fmt: skip
            estimates = replace(estimates, errors=self.errors.with_mixture(fit.errors), tail_gain=fit.tail_gain)
            if fit.tail_gain < self.tuning.significant_tail_gain <= self.tail_gain:
                # With the pairs that a tail makes probable it gains less than without: it came and went for ever.
                more = MORE_TAIL_GAIN * self.tuning.significant_tail_gain
                estimates = replace(estimates, tuning=replace(self.tuning, significant_tail_gain=more))
        return estimates._with_unresolved_by(p_pair)

    def _partner_ratios(self) -> Both | None:
        """(n₁,), (n₂,) likelihood of each record's columns and magnitude if it has a partner, over that if it has none;
        None without such evidence."""
        rule = None if self.columns is None else self.columns.rule()
        terms = [] if rule is None or rule.learned is None else [rule.learned]
        if self.photometry is not None and self.grades is not None and not self.grades.by_magnitude:
            terms.append(self.photometry.logits())
        if not terms:
            return None
        one, two = (np.exp(np.sum(log_ratios, axis=0)) for log_ratios in zip(*terms, strict=True))
        return one, two

    def _uses_error_sizes(self) -> bool:
        """Whether the sizes of quoted errors may hold information that magnitudes do not: faint objects have larger."""
        magnitudes = self.photometry
        if not self.uses_precision or magnitudes is None or magnitudes.share_missing > MAX_SHARE_MISSING:
            return self.uses_precision
        return self.n_evidence_fits > 0 and not magnitudes.is_informative

    def log_odds_without_errors(self, square: FloatArray, p_pair: FloatArray, log_ratio: FloatArray) -> FloatArray:
        """(m,) ln of the odds of the pairs without the term of the errors; −∞ if record 1 is not counted.

        square : (m,) squared normalised distances by the error model.
        """
        from sameas.kernels.mixture import log_odds

        pairs = self.setting.pairs
        if self.unresolved is not None:
            p_pair = self.p_single(p_pair)
            log_ratio = log_ratio + np.log(np.maximum(self.unresolved.single, 1e-300))
        out = self.errors.log_profile(square, pairs.d)
        counted = self.setting.counted[0]
        log_odds(pairs.i, pairs.j, p_pair, log_ratio, *self.p_partner, counted, MIN_P_PAIR, MAX_P_PAIR, out)
        return out

    def with_evidence(self, p_counted: FloatArray, *, last: bool = False) -> EMState:
        """The M-step of magnitudes and columns, with these (m,) probabilities of the pairs."""
        photometry, columns = self.photometry, self.columns
        if (photometry is None and columns is None) or self.n_common < MIN_PAIRS_TO_LEARN:
            return self
        if photometry is not None:
            # The magnitude of a blend is not that of its brighter object.
            p_single = self.p_single(p_counted)
            evidence: LearningPairs = (self.setting.pairs, p_single, self.p_partner, self.shares(), self.covered)
            photometry = photometry.fitted(*evidence, last=last)
        if columns is not None:
            columns = columns.fitted(
                self.setting.pairs, p_counted, self.p_partner, self._expected_logits(), self.covered, last=last
            )
        return replace(self, photometry=photometry, columns=columns, n_evidence_fits=self.n_evidence_fits + 1)

    def _expected_logits(self) -> Both:
        """(n₁,), (n₂,) logit of the share with a partner, from position, magnitude and given priors."""
        one, two = map(logit, self.shares())
        if self.photometry is not None:
            one, two = (at + more for at, more in zip((one, two), self.photometry.logits(), strict=True))
        rule = None if self.columns is None else self.columns.rule()
        if rule is not None and rule.given is not None:
            one, two = one + rule.given[0], two + rule.given[1]
        return one, two


def _local_shares(setting: Setting, partner: Both, counted: tuple[BoolArray, BoolArray]) -> Both:
    """(n₁,), (n₂,) local shares of records with a partner, from the counted records that are covered."""
    # The coarsest level gives the mean of all; the finest has too few records a cell.
    levels = setting.levels[1:-1] or setting.levels
    weights = [(covered & used).astype(np.float64) for covered, used in zip(setting.covered, counted, strict=True)]
    of_own = partial(local_share, levels, pseudo_count=setting.shared_pseudo_count, elsewhere=False)
    works = [partial(of_own, k + 1, partner[k] * weights[k], weights[k]) for k in (0, 1)]
    (at_1, _), (_, at_2) = threads.each(works, len(weights[0]))
    return at_1, at_2


def iterate(
    estimates: EMState,
    max_iterations: int,
    progress: Callable[[str], None],
    stop_early: Callable[[EMState, FloatArray], bool] = lambda estimates, p_counted: False,
    message_errors: FloatArray | None = None,
) -> tuple[EMState, FloatArray, int, bool]:
    """EM iterations over one list of candidates, until they converge.

    stop_early : decides from the first iteration's estimates and probabilities whether to stop there.
    message_errors : (m,) :meth:`EMState.message_errors`, added to the probabilities by messages; None without.

    Returns the estimates, the (m,) probabilities of the counted pairs, the number of iterations, and whether they
    converged. Probabilities come from message passing: the M-step needs only sums over many pairs.
    """
    setting = estimates.setting
    if estimates.photometry is not None:
        estimates = replace(estimates, photometry=estimates.photometry.with_comparisons(setting.pairs))
    converged, iteration = False, 0
    p_counted = np.empty(0)
    while not converged and iteration < max(max_iterations, 1):
        if iteration:
            estimates = estimates.with_evidence(p_counted)
        iteration += 1
        progress(f"estimation, round {iteration}")
        previous = estimates
        estimates, p_pair, log_ratio = estimates.expectation()
        if message_errors is not None:
            p_pair = np.clip(p_pair + message_errors, 0.0, 1.0)
        p_counted = setting.p_counted(p_pair)
        if not math.isfinite(float(p_counted.sum())):
            raise InputError(
                f"{setting.pairs.first.source} and {setting.pairs.second.source}: probabilities cannot be computed: "
                "the errors are far larger than the spacing of the records; are the errors in the assumed unit?"
            )
        estimates = estimates.maximization(p_pair, log_ratio)
        converged = estimates.converged(previous) and estimates.evidence_converged(previous)
        if iteration == 1 and not converged and stop_early(estimates, p_counted):
            break
    return estimates, p_counted, iteration, converged
