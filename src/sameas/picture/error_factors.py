"""Error factors: by how much the errors that a source states, or that are assumed for its kind, are too small.

The positions of two tracks that are surely one object differ by δ ~ N(0, f_a² R_a + f_b² R_b + D), with R as stated,
f the factors of their sources, and D the motion since the reports. So pairs of every two sources weigh every pair of
factors, and all sources have

    p(f_1 … f_S) ∝ Π_a p(f_a) exp Σ_{a<b} L_ab(f_a, f_b),

L_ab the log-likelihood of all differences of the two sources; p(f) is log-normal about 1, but for a share of sources
whose f is 1. More sources than ``BLOCK`` are taken in blocks, each in the mean field of the others. A difference that
is correlated with the last one of its pair by ρ counts as 1 − ρ² of one. One in a hundred may be of anything within
``factor_outlier`` times the errors: a stamp, a mast, a pair that was none.

Sure pairs are those that are near each other, so where none is sure but by chance factors come out small. The ways of
tracks from one report to the next, ν ~ N(0, f² (R + R′ − ρ (L L′ᵀ + L′ Lᵀ)) + κ D) as
below, know nothing of pairs: whatever the correlation ρ, errors are no smaller than ν
shows. ρ is any, as probable, one for all of a source; so is whether of D the errors of velocities are as stated, or a
share κ of them as of the rest. So ways speak against small factors and not for them: by a log-normal prior alone the
mean of what they leave over is 1.2 to 1.4 where 1 is true, and a source that is precise beside others has no other
evidence.

What several reports of one source have in common, its offset, is not in it; see :mod:`sameas.tracks.registration`.

Source: mean-field approximation as in Bishop, Pattern Recognition and Machine Learning, section 10.1.

The correlation time of a source's position errors is estimated from its own tracks (:class:`ErrorCorrelation`). A
tracker's errors last as long as it smooths, a receiver's for minutes, and a plot's are independent at every scan. A
second report with the same error adds no information. Where the errors of two reports of a track are correlated by
ρ = exp(−Δt/τ), the second differs from the prediction of the first by

    ν ~ N(0, R + R′ − C − Cᵀ + κ D),   C = ρ L L′ᵀ,

with R = L Lᵀ and R′ = L′ L′ᵀ the covariances of the two reports, and D the largest covariance of the motion between
them. Most objects move far less, so κ is one of ``motion_shares``, each as probable. Every report so changes the
probability of each τ (``correlation_s``). The prior of ln(τ + 1 s) is normal about that of the source's kind
(:data:`sameas.tracks.kinds.KINDS`) with ``correlation_sigma``; after some dozens of reports the data dominate.

A share s of the variance of a source's errors is *lasting*: the antenna's place on the hull, the rest of a bias. Such
an error is one vector z ~ N(0, 1) for all reports of a track, e = √s L z + f, and only f is forgotten after τ: ρ above
is s + (1 − s) exp(−Δt/τ). A track alone cannot tell an error that lasts from a place, so s is estimated from pairs of
tracks that are surely one object: of their positions' differences δ and δ′ some time apart,

    δ′ ~ N(M δ, S − M S Mᵀ),   M = C S⁻¹,   S = P_a + P_b,   C = Σ_{a,b} [s + (1 − s) exp(−Δt/τ)] R.

Source: autocorrelated errors of tracks as in Bar-Shalom, Li and Kirubarajan 2001, section 8; METHOD 11.4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import log_softmax, logsumexp

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import inverse, log_density, mahalanobis_sq
from sameas.kernels.kalman import add_evidence, correlated_shifts, update_in_plane
from sameas.picture.scan import Scan
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.ragged import ordered_by
from sameas.tracks.alignment import moved
from sameas.tracks.kinds import KINDS

#: Least variance of a step, m²: it keeps the covariance of a certain step invertible.
LEAST_M2 = 1e-6


def error_update(
    mean: FloatArray, covariance: FloatArray, slope: FloatArray, noise: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean and covariance of x by ν = H x + n, ln p(ν), and χ² of ν.

    mean, covariance : (k, d), (k, d, d) of x, errors and what lasts of them, before a report that moved a track by ν.
    slope, noise : (k, 2, d), (k, 2, 2) H and the covariance of n. shift : (k, 2) ν.
    """
    out = np.empty(mean.shape), np.empty(covariance.shape), np.empty(len(mean)), np.empty(len(mean))
    update_in_plane(mean, covariance, slope, noise + LEAST_M2 * np.eye(2), shift, *out)
    return out


def growth(change: FloatArray) -> FloatArray:
    """(n, 2, 2) the positive part of changes of covariances.

    >>> growth(np.array([[[0.0, 1.0], [1.0, 0.0]], [[-2.0, 0.0], [0.0, 3.0]]])).tolist()
    [[[0.5, 0.5], [0.5, 0.5]], [[0.0, 0.0], [0.0, 3.0]]]
    """
    mean = 0.5 * (change[:, 0, 0] + change[:, 1, 1])
    half, cross = 0.5 * (change[:, 0, 0] - change[:, 1, 1]), 0.5 * (change[:, 0, 1] + change[:, 1, 0])
    radius = np.hypot(half, cross)
    # Eigenvalues are m ± r; the part of m + r is ½ [1 + D / r] of it, D the change without its mean.
    high, low = np.maximum(mean + radius, 0.0), np.maximum(mean - radius, 0.0)
    level, slope = 0.5 * (high + low), 0.5 * (high - low) / np.where(radius > 0.0, radius, 1.0)
    out = np.empty(change.shape)
    out[:, 0, 0], out[:, 1, 1] = level + slope * half, level - slope * half
    out[:, 0, 1] = out[:, 1, 0] = slope * cross
    return out


#: Correlations of two reports at which likelihoods are computed; between them they are interpolated.
CORRELATIONS = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0])


@dataclass(frozen=True)
class ErrorCorrelation:
    """The correlation times of the errors of sources.

    names : of the sources so far. log_probable : (S, s, τ) ln of the probability of each lasting share and each τ, up
    to a constant.
    fixed_s : τ that the user gives, by name; these are not estimated, and nothing of such errors lasts.
    """

    names: tuple[str, ...] = ()
    log_probable: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0)))
    fixed_s: Mapping[str, float] = field(default_factory=dict)

    def of_sources(self, scan: Scan) -> ErrorCorrelation:
        """The same with the new sources of a scan."""
        new = [d for d in scan.now.descriptions if d.name not in self.names]
        if self.names and not new:
            return self
        kind_s = np.array([KINDS[description.kind].correlation_s for description in new], np.float64)
        away = np.log(np.array(scan.tuning.correlation_s) + 1.0) - np.log(kind_s[:, None] + 1.0)
        prior = -0.5 * (away / scan.tuning.correlation_sigma) ** 2
        prior = np.repeat(prior[:, None], len(scan.tuning.lasting_shares), axis=1)
        log_probable = np.concatenate([self.log_probable, prior]) if self.names else prior
        return ErrorCorrelation((*self.names, *(description.name for description in new)), log_probable, self.fixed_s)

    def numbers(self, scan: Scan) -> IntArray:
        """(S,) the place in ``names`` of each source of a scan."""
        return np.array([self.names.index(d.name) for d in scan.now.descriptions], dtype=np.int64)

    def lasting(self, source: IntArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(n,) mean s of tracks of the sources."""
        mean = np.einsum("nst,s->n", self._weights, np.array(tuning.lasting_shares))
        return np.where(np.isfinite(self._fixed_s), 0.0, mean)[source]

    def correlation(self, source: IntArray, elapsed_s: FloatArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(n,) mean correlation s + (1 − s) exp(−Δt/τ) of two reports of tracks of the sources, ``elapsed_s`` apart."""
        return self.lasting(source, tuning) + self.forgotten(source, elapsed_s, tuning)

    def forgotten(self, source: IntArray, elapsed_s: FloatArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(n,) the part of it that is not lasting, mean (1 − s) exp(−Δt/τ)."""
        of_tau = np.einsum("nst,s->nt", self._weights, 1.0 - np.array(tuning.lasting_shares))
        # Most sources have few different Δt.
        elapsed_s, at = np.unique(elapsed_s, return_inverse=True)
        mean = np.einsum("st,nt->ns", of_tau, _rho(elapsed_s, np.array(tuning.correlation_s)))[at, source]
        fixed_s = self._fixed_s
        if not np.isfinite(fixed_s).any():
            return np.asarray(mean)
        given = _rho(elapsed_s, np.nan_to_num(fixed_s))[at, source]
        return np.where(np.isfinite(fixed_s)[source], given, mean)

    def of_mean(self, source: IntArray, every_s: float, count: IntArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(n,) the share of the variance of a report that is left in the mean of ``count`` (n,), ``every_s`` apart."""
        steps = np.arange(1, int(count.max(initial=1)))
        correlation = self.correlation(
            np.repeat(np.arange(len(self.names)), len(steps)), np.tile(every_s * steps, len(self.names)), tuning
        ).reshape(len(self.names), len(steps))
        # The mean over all couples of n reports, of which 2 (n − k) are k steps apart.
        sums = [np.cumsum(np.pad(part, ((0, 0), (1, 0))), axis=1) for part in (correlation, steps * correlation)]
        n = np.maximum(count, 1)
        each, stepped = (part[source, n - 1] for part in sums)
        return np.asarray((n + 2.0 * (n * each - stepped)) / n**2)

    @cached_property
    def _weights(self) -> FloatArray:
        """(S, s, τ) probabilities."""
        weight = np.exp(self.log_probable - self.log_probable.max(axis=(1, 2), initial=-np.inf, keepdims=True))
        return np.asarray(weight / weight.sum(axis=(1, 2), keepdims=True))

    @cached_property
    def _fixed_s(self) -> FloatArray:
        """(S,) τ that the user gives, NaN for others."""
        return np.array([self.fixed_s.get(name, np.nan) for name in self.names], np.float64)

    def updated(
        self,
        source: IntArray,
        elapsed_s: FloatArray,
        shift: FloatArray,
        errors: tuple[FloatArray, FloatArray],
        motion: FloatArray,
        tuning: Tuning = DEFAULT_TUNING,
    ) -> ErrorCorrelation:
        """After new reports of tracks.

        Parameters
        ----------
        source, elapsed_s, shift : (n,), (n,), (n, 2) the source, Δt and ν of each report.
        errors : R + R′ and L L′ᵀ, (n, 2, 2) each. motion : (n, 2, 2) D.
        """
        steady = mahalanobis_sq(shift, errors[0] + motion) <= tuning.manoeuvre_chi_sq
        source, elapsed_s, shift, motion = source[steady], elapsed_s[steady], shift[steady], motion[steady]
        both, shared = errors[0][steady], (errors[1] + errors[1].transpose(0, 2, 1))[steady]
        log_p = np.empty((len(source), len(CORRELATIONS)))
        correlated_shifts(shift, both, shared, motion, CORRELATIONS, np.array(tuning.motion_shares), LEAST_M2, log_p)
        return self._with_evidence(source, elapsed_s, log_p, tuning)

    def with_sure_pairs(
        self,
        sources: tuple[IntArray, IntArray],
        elapsed_s: FloatArray,
        differences: tuple[FloatArray, FloatArray],
        reported: tuple[FloatArray, FloatArray],
        total: FloatArray,
        tuning: Tuning = DEFAULT_TUNING,
    ) -> ErrorCorrelation:
        """After pairs of tracks that are surely one object have been compared with what they were some time ago.

        Parameters
        ----------
        sources : of both tracks, (n,) each. elapsed_s : (n,) Δt. differences : δ and δ′, (n, 2) each.
        reported : R of both, (n, 2, 2) each. total : (n, 2, 2) S.
        """
        if not len(elapsed_s):
            return self
        out, spread = self, inverse(total)
        usual = [self.correlation(source, elapsed_s, tuning)[:, None, None] for source in sources]
        for own, other in ((0, 1), (1, 0)):
            # All correlations at once, (c, n, 2, 2).
            common = CORRELATIONS[:, None, None, None] * reported[own] + usual[other] * reported[other]
            slope = common @ spread
            innovation = differences[1] - np.einsum("cnvw,nw->cnv", slope, differences[0])
            log_p = log_density(innovation, total - slope @ common.swapaxes(2, 3) + LEAST_M2 * np.eye(2)).T
            out = out._with_evidence(sources[own], elapsed_s, log_p, tuning)
        return out

    def _with_evidence(
        self, source: IntArray, elapsed_s: FloatArray, log_p: FloatArray, tuning: Tuning
    ) -> ErrorCorrelation:
        """After n independent values of which ln p is given for each of :data:`CORRELATIONS`, (n, k)."""
        log_probable = self.log_probable.copy()
        # Most sources have few different Δt: their values are added up first.
        elapsed_ms = np.rint(1e3 * elapsed_s).astype(np.int64)
        key, group = np.unique(source * (elapsed_ms.max(initial=0) + 1) + elapsed_ms, return_inverse=True)
        source_of, elapsed_ms = np.divmod(key, elapsed_ms.max(initial=0) + 1)
        sums = np.zeros((len(key), len(CORRELATIONS)))
        np.add.at(sums, group, log_p)
        rho = _rho(np.asarray(1e-3 * elapsed_ms, np.float64), np.array(tuning.correlation_s))
        add_evidence(source_of, rho, sums, CORRELATIONS, np.array(tuning.lasting_shares), log_probable)
        return replace(self, log_probable=log_probable)


def _rho(elapsed_s: FloatArray, tau_s: FloatArray) -> FloatArray:
    """(n, τ) ρ, for τ (τ,) or (n, τ) in seconds."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        rho = np.exp(-np.maximum(elapsed_s, 0.0)[:, None] / tau_s)
    return np.where(tau_s > 0.0, rho, 0.0)


#: Sources whose factors are weighed together, and steps of the mean field of blocks of them.
BLOCK, STEPS = 3, 5
#: Pairs, and reports, of an instant that are looked at, for the time it takes; and reports of a source: more show
#: nothing new.
MOST_PAIRS, MOST_REPORTS, MOST_OF_SOURCE = 64, 32, 2000


@dataclass(frozen=True)
class ErrorFactors:
    """The factors of the errors of sources.

    names : of the sources so far. log_likely : (S, S, K, K) L of two sources a < b, by the factors of both.
    log_shifts : (S, K, 2ρ) ln p of the ways of their tracks, with any share of the motion, and with all of what comes
    of the errors of velocities. reports : (S,) of how many reports.
    factor : (S,) mean of each source, geometric. sigma : (S,) 1σ of its logarithm.
    """

    names: tuple[str, ...] = ()
    log_likely: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0, 0)))
    log_shifts: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0)))
    reports: FloatArray = field(default_factory=lambda: np.empty(0))
    factor: FloatArray = field(default_factory=lambda: np.empty(0))
    sigma: FloatArray = field(default_factory=lambda: np.empty(0))

    def of_sources(self, names: tuple[str, ...], tuning: Tuning = DEFAULT_TUNING) -> ErrorFactors:
        """The same with all of these sources, in their order; the first ones are here already."""
        if names == self.names:
            return self
        k, known = len(tuning.error_factors), len(self.names)
        log_likely = np.zeros((len(names), len(names), k, k))
        log_likely[:known, :known] = self.log_likely.reshape(known, known, k, k)
        log_shifts, reports = np.zeros((len(names), k, 2 * len(CORRELATIONS))), np.zeros(len(names))
        log_shifts[:known], reports[:known] = self.log_shifts.reshape(known, k, 2 * len(CORRELATIONS)), self.reports
        whole = replace(self, names=names, log_likely=log_likely, log_shifts=log_shifts, reports=reports)
        return whole._averaged(tuning)

    def telling(self, source: IntArray, place: FloatArray, stated: FloatArray, motion: FloatArray) -> IntArray:
        """(k,) those of new reports (n,) at places (n, 2) that :meth:`with_shifts` is to look at, by R + R′ as stated
        and D, (n, 2, 2).

        Where motion is larger than errors its description would be judged.
        """
        calm = np.trace(motion, axis1=1, axis2=2) < np.trace(stated, axis1=1, axis2=2)
        which = np.flatnonzero(calm & (self.reports[source] < MOST_OF_SOURCE))
        return which[evenly(place[which], MOST_REPORTS)]

    def with_shifts(
        self,
        source: IntArray,
        shift: FloatArray,
        errors: tuple[FloatArray, FloatArray],
        motion: tuple[FloatArray, FloatArray],
        tuning: Tuning = DEFAULT_TUNING,
    ) -> ErrorFactors:
        """After new reports of tracks, a few of those of an instant (:meth:`telling`).

        Parameters
        ----------
        source, shift : (n,), (n, 2) place in ``names`` and ν. errors : R + R′ and L L′ᵀ as stated, motion : D and
        what of it comes of the errors of measured velocities, (n, 2, 2) each.
        """
        n = len(source)
        if not n:
            return self
        both, shared = errors[0], errors[1] + errors[1].transpose(0, 2, 1)
        log_out = log_density(shift, tuning.factor_outlier**2 * both) - np.log(1.0 / tuning.factor_outliers - 1.0)
        # Once with any share of the motion, once with the errors of velocities as they are stated.
        fixed, free = (
            np.concatenate([np.zeros_like(motion[1]), motion[1]]),
            np.concatenate([motion[0], growth(motion[0] - motion[1])]),
        )
        # All factors at once, (factors, twice n, …).
        sq = np.array(tuning.error_factors)[:, None, None, None] ** 2
        stated, common = (sq * np.concatenate([one, one]) for one in (both, shared))
        log_p = np.empty((len(sq) * 2 * n, len(CORRELATIONS)))
        correlated_shifts(
            np.tile(shift, (2 * len(sq), 1)), (stated + fixed).reshape(-1, 2, 2), common.reshape(-1, 2, 2),
            np.tile(free, (len(sq), 1, 1)), CORRELATIONS, np.array(tuning.motion_shares), LEAST_M2, log_p,
        )  # fmt: skip
        # Of two ways in succession the report between is in both.
        both_ways = log_p.reshape(len(sq), 2, n, len(CORRELATIONS)).transpose(0, 2, 1, 3).reshape(len(sq), n, -1)
        seen = 0.5 * np.logaddexp(both_ways, log_out[:, None])
        log_shifts = self.log_shifts.copy()
        for s in np.unique(source).tolist():
            log_shifts[s] += seen[:, source == s].sum(axis=1)
        reports = self.reports + np.bincount(source, minlength=len(self.names))
        return replace(self, log_shifts=log_shifts, reports=reports)

    def with_sure_pairs(
        self,
        sources: tuple[IntArray, IntArray],
        delta: FloatArray,
        stated: tuple[FloatArray, FloatArray],
        motion: FloatArray,
        weight: FloatArray,
        tuning: Tuning = DEFAULT_TUNING,
    ) -> ErrorFactors:
        """After pairs of tracks that are surely one object, of an instant :data:`MOST_PAIRS` at most.

        Parameters
        ----------
        sources : places in ``names`` of both, (n,) each. delta : (n, 2) δ. stated : R of both, (n, 2, 2) each.
        motion : (n, 2, 2) D. weight : (n,) 1 − ρ².
        """
        if not len(delta):
            return self
        swap = sources[0] > sources[1]
        first, second = np.minimum(*sources), np.maximum(*sources)
        one, other = (np.where(swap[:, None, None], *both) for both in (stated[::-1], stated))
        log_p, log_likely = (
            weight[:, None, None] * _log_density(delta, one, other, motion, tuning),
            self.log_likely.copy(),
        )
        np.add.at(log_likely, (first, second), log_p)
        return replace(self, log_likely=log_likely)._averaged(tuning)

    def on(self, scan: Scan) -> Scan:
        """The scan with the errors of its records multiplied; velocities have their own, and keep them."""
        names = {name: k for k, name in enumerate(self.names)}
        factor = np.array([self.factor[names[d.name]] if d.name in names else 1.0 for d in scan.now.descriptions])
        each = np.where(scan.placed, factor[scan.source], 1.0) if len(scan) else np.empty(0)
        if np.all(np.abs(each - 1.0) < 1e-9):
            return scan
        size = np.ones((len(scan), 4))
        size[:, :2] = each[:, None]
        reported = size[:, :, None] * scan.reported_covariance * size[:, None, :]
        change = np.nan_to_num(reported - scan.reported_covariance)
        _, extra = moved(np.zeros((len(scan), 4)), change, scan.now.instant_s - scan.time_s, np.zeros(len(scan)))
        return replace(scan.with_covariance(extra), reported_covariance=reported, error_factor=each)

    def lines(self) -> list[str]:
        """Printable lines on the sources whose errors surely are not as stated."""
        return [
            f"{name}: positions err by {factor:.2g} times what is stated or assumed (ln ± {sigma:.2g}); counted so"
            for name, factor, sigma in zip(self.names, self.factor.tolist(), self.sigma.tolist(), strict=True)
            if abs(np.log(factor)) > max(3.0 * sigma, np.log(1.25))
        ]

    def _averaged(self, tuning: Tuning) -> ErrorFactors:
        """With the mean factors by all that was seen."""
        logs, n = np.log(np.array(tuning.error_factors)), len(self.names)
        own = _log_prior(logs, tuning) + logsumexp(self.log_shifts, axis=2)
        # L of every source with every other, by its own factor first.
        both = self.log_likely + self.log_likely.transpose(1, 0, 3, 2)
        weight = np.exp(log_softmax(own, axis=1))
        blocks = [np.arange(begin, min(begin + BLOCK, n)) for begin in range(0, n, BLOCK)]
        for _ in range(STEPS if len(blocks) > 1 else 1):
            for block in blocks:
                beside = np.setdiff1d(np.arange(n), block)
                alone = own[block] + np.einsum("stfg,tg->sf", both[np.ix_(block, beside)], weight[beside])
                weight[block] = _marginals(alone, both[np.ix_(block, block)])
        mean = weight @ logs
        return replace(self, factor=np.exp(mean), sigma=np.sqrt(np.maximum(weight @ logs**2 - mean**2, 0.0)))


def evenly(place: FloatArray, most: int) -> IntArray:
    """(k,) ascending, ``most`` of n places (n, 2), spread evenly in the order of their first coordinates: a choice that
    does not depend on the order in which they are given."""
    if len(place) <= most:
        return np.arange(len(place))
    return np.sort(ordered_by(place.T)[np.linspace(0, len(place) - 1, most).astype(np.int64)])


def _log_prior(logs: FloatArray, tuning: Tuning) -> FloatArray:
    """(K,) ln of the prior probability of factors of these logarithms."""
    broad = np.exp(-0.5 * (logs / tuning.error_factor_sigma) ** 2)
    as_stated = np.abs(logs) == np.abs(logs).min()
    share = tuning.errors_as_stated
    return np.asarray(np.log((1.0 - share) * broad / broad.sum() + share * as_stated / as_stated.sum()))


def _marginals(alone: FloatArray, both: FloatArray) -> FloatArray:
    """(m, K) probabilities of the factors of m sources: ln of those of each alone (m, K), of each two (m, m, K, K)."""
    m, k = alone.shape
    total = np.zeros((k,) * m)
    for s in range(m):
        total += alone[s].reshape([k if axis == s else 1 for axis in range(m)])
        for t in range(s + 1, m):
            total += both[s, t].reshape([k if axis in (s, t) else 1 for axis in range(m)])
    p = np.exp(total - total.max(initial=-np.inf))
    out = np.array([p.sum(axis=tuple(axis for axis in range(m) if axis != s)) for s in range(m)]).reshape(m, k)
    return np.asarray(out / out.sum(axis=1, keepdims=True))


def _log_density(
    delta: FloatArray, one: FloatArray, other: FloatArray, motion: FloatArray, tuning: Tuning
) -> FloatArray:
    """(n, K, K) ln p(δ) for every pair of factors."""
    sq = np.array(tuning.error_factors) ** 2
    xx, xy, yy = (
        sq[:, None] * one[:, v, w, None, None] + sq * other[:, v, w, None, None] + motion[:, v, w, None, None]
        for v, w in ((0, 0), (0, 1), (1, 1))
    )
    xx, yy = xx + LEAST_M2, yy + LEAST_M2
    det = np.maximum(xx * yy - xy**2, LEAST_M2**2)
    x, y = delta[:, 0, None, None], delta[:, 1, None, None]
    chi_sq = (yy * x**2 - 2.0 * xy * x * y + xx * y**2) / det
    far = tuning.factor_outlier**2
    usual, outlier = -0.5 * chi_sq, -0.5 * chi_sq / far - np.log(far * (1.0 / tuning.factor_outliers - 1.0))
    return np.asarray(np.logaddexp(usual, outlier) - 0.5 * np.log(det))
