"""EM iterations: identification and maximum likelihood in turn, over one list of candidates, until estimates settle.

In every iteration each pair has its probability by the estimates of the one before, and what is estimated is learned
from the pairs with these weights (METHOD 6): the shares in common, the spread of the errors, how magnitudes are
related.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.errors import InputError
from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.companions import DEFAULT_COMPANIONS, Companions, CompanionsTuning, clustering
from sameas.estimate.coverage import local_share
from sameas.estimate.error_grid import Average, Averaged, Solved, but_positions
from sameas.estimate.error_model import DEFAULT_SCALES, ScalesTuning, fit_errors
from sameas.estimate.grades import Grades
from sameas.estimate.photometry import LearningPairs, Photometry
from sameas.estimate.quantity import MOST_MISSING
from sameas.estimate.sample import Setting
from sameas.evidence import Brightness, Errors, PoissonField, Rule
from sameas.evidence.detection import logit
from sameas.kernels import threads
from sameas.posterior import by_messages
from sameas.representation import in_short


@dataclass(frozen=True)
class EMTuning:
    """When an EM iteration learns what, and when the iterations end.

    Attributes
    ----------
    faint, largest_p : pairs less probable than this, and more, are not taken at their word when errors are judged.
    least_log_ratio : pairs of smaller ln of the odds, before one-to-one, are less probable than 1e-5, and count for
        nothing in sums.
    least_guess, most_guess : the first guess of the share of the poorer source that is common lies between these.
    widest_scale : errors this many times too small are always thought of.
    least_share : of records that only one source shows.
    filled : chance candidates within √2 of its scale that a component of the errors may hold, times two.
    fewest : fewer expected pairs than this say too little of errors and magnitudes.
    share_missing : quoted errors are not asked where magnitudes tell and hardly more than this share of the records
        lacks them.
    with_brightness : EM iterations with magnitudes at least.
    settled, settled_number : the number of common objects has settled when all changes to come are no more than this
        share of its standard error, or, of very few, when it changes by no more than this number.
    settled_weight : the weights of errors that are averaged over have settled when none changes by more than this.
    least_following : at least so much of each change is taken to follow in the next iteration.
    scales : how the mixture of error scales is found. companions : how those of objects are; None asks for none.
    disowned : what companions say is left out where, with it, fewer objects are common than this part of those that
        close pairs beyond chance and companions show.
    """

    faint: float = 1e-3
    largest_p: float = 1.0 - 1e-12
    least_log_ratio: float = math.log(1e-5)
    least_guess: float = 0.1
    most_guess: float = 0.95
    widest_scale: float = 3.4
    least_share: float = 1e-6
    filled: float = 0.15
    fewest: float = 50.0
    share_missing: float = 0.05
    with_brightness: int = 1
    settled: float = 0.2
    settled_number: float = 0.01
    settled_weight: float = 0.01
    least_following: float = 0.25
    scales: ScalesTuning = DEFAULT_SCALES
    companions: CompanionsTuning | None = DEFAULT_COMPANIONS
    disowned: float = 0.5


DEFAULT_EM = EMTuning()

Both = tuple[FloatArray, FloatArray]


@in_short
@dataclass(frozen=True)
class Estimates:
    """What is known between two rounds.

    Attributes
    ----------
    setting : candidates and records, which stay the same.
    partner : (n₁,), (n₂,) probability of having a partner; ``counted`` for which records it is known.
    local : (n₁,), (n₂,) local share of the records of either source that have a partner, at these without themselves.
    errors : the spread of the residuals; learned from the pairs where ``learns_errors``.
    photometry : how the magnitudes are related, None where they are not asked for. times_learned : how often.
    common : expected number of common objects among the counted, a guess before the first round. change : by how much
        the last round changed it, NaN before the first; 0 after it, which changed a guess, and where other candidates
        take part since.
    tail : by how much a tail of the errors, believed or not, betters ln of the likelihood.
    precision : whether the sizes of the quoted errors are asked. grades : what they say, None as long as they were not.
    density : (ρ₁, ρ₂) of all records of each source where the user gave them, else None.
    average : errors that too few pairs leave open, over which probabilities are averaged; None where ``errors`` hold.
    columns : other columns that are evidence, None where none are.
    companions : what is known of objects near each other, None where there are no more than by chance.
    """

    setting: Setting
    partner: Both
    counted: tuple[BoolArray, BoolArray]
    local: Both
    errors: Errors
    learns_errors: bool
    photometry: Photometry | None
    density: tuple[float, float] | None = None
    times_learned: int = 0
    common: float = math.nan
    change: float = math.nan
    tail: float = 0.0
    precision: bool = True
    grades: Grades | None = None
    average: Average | None = None
    columns: ColumnEvidence | None = None
    companions: Companions | None = None
    tuning: EMTuning = DEFAULT_EM

    @classmethod
    def nothing(
        cls,
        setting: Setting,
        errors: Errors | None,
        photometry: Photometry | None,
        density: tuple[float, float] | None,
        share: float,
        precision: bool,
        tuning: EMTuning = DEFAULT_EM,
        columns: ColumnEvidence | None = None,
    ) -> Estimates:
        """Before the first round, when this ``share`` of the poorer source is taken to be common."""
        n1, n2 = (len(rows) for rows in setting.rows)
        guess = min(max(share, tuning.least_guess), tuning.most_guess) * min(n1, n2)
        partner = np.full(n1, guess / n1), np.full(n2, guess / n2)
        known = cls(
            setting, partner, setting.counted, partner, errors or Errors(), errors is None, photometry, density,
            precision=precision, tuning=tuning, columns=columns and columns.in_folds(setting),
        )  # fmt: skip
        return replace(known, common=float(partner[0][setting.counted[0]].sum())).with_companions()

    def at(self, setting: Setting, photometry: Photometry | None, columns: ColumnEvidence | None = None) -> Estimates:
        """The same where other candidates and records take part, with the magnitudes and other columns of these."""
        partner, counted = [], []
        for old, new, p, known in zip(self.setting.rows, setting.rows, self.partner, self.counted, strict=True):
            whole = np.full(max(old[-1], new[-1]) + 1, np.nan)
            whole[old[known]] = p[known]
            partner.append(np.nan_to_num(whole[new]))
            counted.append(np.isfinite(whole[new]))
        if photometry is not None and self.photometry is not None:
            photometry = replace(photometry, chains=self.photometry.chains, curves=self.photometry.curves)
        grades = self.grades and self.grades.at(setting, photometry)
        if columns is not None and self.columns is not None:
            columns = self.columns.at(setting, columns)
        known_there = replace(self, setting=setting, photometry=photometry, change=0.0, grades=grades, columns=columns)
        return known_there._with_partners((partner[0], partner[1]), (counted[0], counted[1])).with_companions(self)

    def with_companions(self, before: Estimates | None = None) -> Estimates:
        """The same with what the couples of either source say of these candidates.

        before : what was known of other candidates, perhaps of the same records, which are not asked again.
        """
        tuning = self.tuning.companions
        if tuning is None or self.density is not None:
            return self
        if before is not None and before.setting.pairs.same_records(self.setting.pairs):
            known = None if before.companions is None else before.companions.clustering
        else:
            known = clustering(self.setting, tuning)
        return replace(self, companions=None if known is None else Companions.of(known, self.setting, tuning))

    def _with_partners(self, partner: Both, counted: tuple[BoolArray, BoolArray]) -> Estimates:
        return replace(self, partner=partner, counted=counted, local=_local(self.setting, partner, counted))

    @property
    def means(self) -> tuple[float, float]:
        """Mean share of either source's records that have a partner."""
        one, two = (float(p[known].mean()) for p, known in zip(self.partner, self.counted, strict=True))
        return one, two

    @property
    def covered(self) -> tuple[BoolArray, BoolArray]:
        """Which records tell of shares: the other source looks there, and they count."""
        (seen_1, seen_2), (counted_1, counted_2) = self.setting.seen, self.counted
        return seen_1 & counted_1, seen_2 & counted_2

    def shares(self) -> Both:
        """Share of the records of either source that have a partner, at the positions of its own."""
        if self.density is not None:
            one, two = self.means
            return np.full(len(self.partner[0]), one), np.full(len(self.partner[1]), two)
        return self.local

    def brightness(self) -> Brightness | None:
        """What magnitudes say; None as long as nothing is known of that."""
        return None if self.photometry is None else self.photometry.rule(self.shares(), self.setting.pairs)

    def rule(self) -> Rule:
        """The rule with all that is known."""
        rule: Rule = self._positions()
        graded = None if self.grades is None else self.grades.rule
        companions = None if self.companions is None else self.companions.rule
        for more in (self.brightness(), graded, None if self.columns is None else self.columns.rule(), companions):
            rule = rule if more is None else rule + more
        return rule

    def _positions(self) -> PoissonField:
        if self.density is not None:
            (mean_1, mean_2), (all_1, all_2) = self.means, self.density
            alone_1, alone_2 = max(1.0 - mean_1, self.tuning.least_share), max(1.0 - mean_2, self.tuning.least_share)
            both = math.sqrt(all_1 * mean_1 * all_2 * mean_2)
            return PoissonField(both, all_1 * alone_1, all_2 * alone_2, self.errors)
        of_1, of_2 = self.setting.densities
        share_1, share_2 = self.local
        # Both sources count the same common objects: the mean of the logarithms favours neither. Each where its own
        # record stands, which is not counted there; at the candidate it would be, and every pair vouch for itself.
        common = of_1 * share_1, of_2 * share_2
        only_1 = of_1 * np.maximum(1.0 - share_1, self.tuning.least_share)
        only_2 = of_2 * np.maximum(1.0 - share_2, self.tuning.least_share)
        return PoissonField(common, only_1, only_2, self.errors)

    def expected(self) -> float:
        """Number of common objects that the shares let expect."""
        return min(float((share * seen).sum()) for share, seen in zip(self.shares(), self.setting.seen, strict=True))

    def expectation(self) -> tuple[Estimates, FloatArray, FloatArray]:
        """The E-step: (m,) probabilities of the pairs and ln of their odds before one-to-one, and what was learned on
        the way of the errors that are left open."""
        pairs, evidence, beside = self.setting.pairs, self.rule()(self.setting.pairs), self.log_beside()
        if self.average is None:
            log_ratio = evidence.log_ratio
            p_pair = Solved.of(pairs, log_ratio, by_messages, beside, self.tuning.least_log_ratio).p_pair
            return self, p_pair, log_ratio if beside is None else Averaged.one(pairs, p_pair, log_ratio).log_ratio
        average, averaged = self.average.posterior(pairs, but_positions(evidence), *self.numbers(), beside=beside)
        return replace(self, average=average), averaged.p_pair, averaged.log_ratio

    def log_beside(self) -> FloatArray | None:
        """(m,) ln of the odds of pairs to be companions, before one-to-one; None where objects have none."""
        return None if self.companions is None else self.companions.log_beside(len(self.setting.pairs), *self.means)

    def numbers(self) -> tuple[float, tuple[int, int]]:
        """Common objects that the shares let expect, and records of either source that may be."""
        one, two = (max(int(np.count_nonzero(seen)), 1) for seen in self.setting.seen)
        return self.expected(), (one, two)

    def settled(self, before: Estimates) -> bool:
        """Whether all that later rounds may change the number of common objects by, but for the next, is small.

        A part r of each change follows in the next round: at least the share of the information that is missing
        because the pairs are not sure, and as much as followed in this. The standard error is that of Σ p(1 − p) of
        what is not sure, 1/(1 − r) times as large because the shares are estimated.
        """
        if math.isnan(before.change):
            return False
        if self.average is not None and before.average is not None:
            moved = np.abs(self.average.weight - before.average.weight).max()
            if moved > self.tuning.settled_weight or np.isnan(moved):
                return False
        followed = abs(self.change / before.change) if before.change else 0.0
        to_come = []
        for partner, known in zip(self.partner, self.counted, strict=True):
            p = partner[known]
            unsure, mean = float((p * (1.0 - p)).sum()), float(p.mean())
            missing = min(unsure / max(len(p) * mean * (1.0 - mean), 1e-300), MOST_MISSING)
            r = min(max(missing, followed, self.tuning.least_following), MOST_MISSING)
            error = math.sqrt(unsure / (1.0 - missing))
            to_come.append(abs(self.change) * r**2 / (1.0 - r) <= self.tuning.settled * error)
        return all(to_come) or abs(self.change) <= self.tuning.settled_number

    def evidence_settled(self, before: Estimates) -> bool:
        """Whether what is learned from pairs, magnitudes and grades, has had its say in the last round."""
        silent = self.photometry is None and self.columns is None
        magnitudes = silent or self.common < self.tuning.fewest or self.times_learned >= self.tuning.with_brightness
        graded = None if before.grades is None else before.grades.rule
        ungraded = self.grades is None or self.grades.rule is None
        return magnitudes and (ungraded or (graded is not None and graded.trained_on(self.setting.pairs)))

    def learned(self, p_pair: FloatArray, log_ratio: FloatArray) -> Estimates:
        """What a round says of shares and errors; what it says of magnitudes is ``with_evidence``.

        p_pair, log_ratio : (m,) probabilities of the pairs, and ln of their odds before one-to-one.
        """
        pairs = self.setting.pairs
        partner = (
            np.minimum(np.bincount(pairs.i, p_pair, len(self.partner[0])), 1.0),
            np.minimum(np.bincount(pairs.j, p_pair, len(self.partner[1])), 1.0),
        )
        p_counted = self.setting.p_counted(p_pair)
        common = float(p_counted.sum())
        known = replace(self, common=common, change=0.0 if math.isnan(self.change) else common - self.common)
        known = known._with_partners(partner, self.setting.counted)
        if self.companions is not None and known.means[0] < self.tuning.disowned * self.companions.share:
            known = replace(known, companions=None)
        if common < self.tuning.fewest:
            return known
        grades = self.grades
        if grades is None and self._asks_errors():
            # Among records of like magnitude only where magnitudes of a pair go together: else what an error says of
            # the other record's magnitude would be left out, though its completeness counts.
            unrelated = self.photometry is None or (self.times_learned > 0 and not self.photometry.telling)
            grades = Grades.of(self.setting, None if unrelated else self.photometry)
        if grades is not None:
            known = replace(
                known,
                grades=grades.learned(
                    pairs, p_counted, partner, known.covered, replace(known, grades=grades)._like_partners()
                ),
            )
        if self.learns_errors:
            # A component so wide that chance fills it cannot be told from chance.
            square = self.errors.pairs(pairs).mahalanobis_sq
            radius = math.sqrt(float(square.max(initial=1.0)))
            widest = radius * (self.tuning.filled / max(self.setting.by_chance(p_counted), 1e-12)) ** (1.0 / pairs.d)
            log_odds = known.log_odds_but_errors(square, p_pair, log_ratio)
            fit = fit_errors(
                square, log_odds, pairs.d, self.errors, widest=max(widest, self.tuning.widest_scale),
                tuning=self.tuning.scales,
            )  # fmt: skip
            known = replace(known, errors=self.errors.with_mixture(fit.errors), tail=fit.tail)
        return known

    def _like_partners(self) -> Both | None:
        """How much likelier partners are than others to have what else is known of a record; None where nothing is."""
        rule = None if self.columns is None else self.columns.rule()
        known = [] if rule is None or rule.learned is None else [rule.learned]
        if self.photometry is not None and self.grades is not None and not self.grades.by_magnitude:
            known.append(self.photometry.logits())
        if not known:
            return None
        one, two = (np.exp(np.sum(log_ratios, axis=0)) for log_ratios in zip(*known, strict=True))
        return one, two

    def _asks_errors(self) -> bool:
        """Whether the sizes of the quoted errors may say what nothing else does: of faint objects they are larger."""
        magnitudes = self.photometry
        if not self.precision or magnitudes is None or magnitudes.share_missing > self.tuning.share_missing:
            return self.precision
        return self.times_learned > 0 and not magnitudes.telling

    def log_odds_but_errors(self, square: FloatArray, p_pair: FloatArray, log_ratio: FloatArray) -> FloatArray:
        """(m,) ln of the odds of the pairs but for what the errors say, given how sure their records are of others.

        −∞ for those whose record 1 is not counted. square : (m,) normalised distances squared, by the error model.
        """
        from sameas.kernels.mixture import log_odds

        pairs = self.setting.pairs
        out = self.errors.log_profile(square, pairs.d)
        log_odds(
            pairs.i,
            pairs.j,
            p_pair,
            log_ratio,
            *self.partner,
            self.setting.counted[0],
            self.tuning.faint,
            self.tuning.largest_p,
            out,
        )
        return out

    def with_evidence(self, p_counted: FloatArray, *, last: bool = False) -> Estimates:
        """The magnitudes and columns learned from, where there are any, with pairs of these probabilities (m,)."""
        photometry, columns = self.photometry, self.columns
        if (photometry is None and columns is None) or self.common < self.tuning.fewest:
            return self
        if photometry is not None:
            evidence: LearningPairs = (
                self.setting.pairs,
                p_counted,
                self.partner,
                self.shares(),
                self.covered,
            )
            photometry = photometry.learned(*evidence, last=last)
        if columns is not None:
            columns = columns.learned(
                self.setting.pairs, p_counted, self.partner, self._expected_logits(), self.covered, last=last
            )
        return replace(self, photometry=photometry, columns=columns, times_learned=self.times_learned + 1)

    def _expected_logits(self) -> Both:
        """(n₁,), (n₂,) the logit of the share with a partner that places, magnitudes and given priors let expect."""
        one, two = map(logit, self.shares())
        if self.photometry is not None:
            one, two = (at + more for at, more in zip((one, two), self.photometry.logits(), strict=True))
        rule = None if self.columns is None else self.columns.rule()
        if rule is not None and rule.given is not None:
            one, two = one + rule.given[0], two + rule.given[1]
        return one, two


def _local(setting: Setting, partner: Both, counted: tuple[BoolArray, BoolArray]) -> Both:
    """Local shares, of the records that tell of them."""
    # One cell says no more than the mean of all, and the finest say next to nothing.
    levels = setting.levels[1:-1] or setting.levels
    weights = [(seen & known).astype(np.float64) for seen, known in zip(setting.seen, counted, strict=True)]
    works = [partial(local_share, levels, k + 1, partner[k] * weights[k], weights[k], elsewhere=False) for k in (0, 1)]
    (at_1, _), (_, at_2) = threads.each(works, len(weights[0]))
    return at_1, at_2


def settled(
    known: Estimates,
    rounds: int,
    progress: Callable[[str], None],
    useless: Callable[[Estimates, FloatArray], bool] = lambda known, p_counted: False,
) -> tuple[Estimates, FloatArray, int, bool]:
    """Rounds over one list of candidates: what is known then, the probabilities (m,) of the pairs that count, how many
    rounds it took, and whether the estimates settled.

    Within the rounds only sums over many pairs are needed; messages are near enough for those.

    useless : whether more rounds would be, by what is known after the first and the probabilities in it.
    """
    setting = known.setting
    if known.photometry is not None:
        known = replace(known, photometry=known.photometry.facing(setting.pairs))
    done, number = False, 0
    p_counted = np.empty(0)
    while not done and number < max(rounds, 1):
        if number:
            known = known.with_evidence(p_counted)
        number += 1
        progress(f"estimation, round {number}")
        before = known
        known, p_pair, log_ratio = known.expectation()
        p_counted = setting.p_counted(p_pair)
        common = float(p_counted.sum())
        if not math.isfinite(common):
            raise InputError(
                f"{setting.pairs.first.source} and {setting.pairs.second.source}: probabilities cannot be computed: "
                "the errors are far larger than the spacing of the records; are the errors in the assumed unit?"
            )
        known = known.learned(p_pair, log_ratio)
        done = known.settled(before) and known.evidence_settled(before)
        if number == 1 and not done and useless(known, p_counted):
            break
    return known, p_counted, number, done
