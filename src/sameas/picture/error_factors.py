"""Error factors and error correlation: how wrong a source's stated position errors are, and for how long they persist.

Error factors (:class:`ErrorFactors`) multiply the σ that a source states or that is assumed for its kind. The positions
of two tracks that are surely one object differ by δ ~ N(0, f_a² R_a + f_b² R_b + D), with R as stated, f the factors of
their sources, and D the covariance of the motion since the reports. The posterior of all factors is

    p(f_1 … f_S) ∝ Π_a p(f_a) exp Σ_{a<b} L_ab(f_a, f_b),

L_ab the log-likelihood of all differences of the two sources. The prior p(f) is log-normal, plus a point mass at f = 1,
with a mean square of 1: the stated variance is the expected one. So is that with the root mean square of the posterior,
which is used. More than ``BLOCK`` sources are split into blocks, each in the mean field of the others. A difference
that is correlated with previous ones of its pair counts by what it adds to them (:func:`information`), and the
differences of m tracks of one object count as m − 1 (:func:`pairs_within`). A share ``factor_outliers`` (1 %) of the
differences are outliers with ``factor_outlier`` times the errors: a wrong time stamp, an antenna far from the centre, a
false pair.

Sure pairs are selected for being near, so where pairs are sure only by chance, factors come out too small. The
residuals of single tracks from report to report, ν ~ N(0, f² (R + R′ − ρ (L L′ᵀ + L′ Lᵀ)) + κ D) as below, do not
depend on pairs and bound the errors from below, whatever ρ. Each source has one unknown ρ. They measure f² (1 − ρ).
With probability ``errors_new`` ρ is 0; otherwise the prior is uniform in ln (1 − ρ), so that residuals prefer none of
the factors above the bound. A prior uniform in ρ prefers small ones, by 1 / f²: AIS whose errors persist for minutes
would have factors of 0.85. The motion's share κ is unknown as well; whether it applies to the errors of measured
velocities too is a second unknown. Residuals count against small factors and not in favour of them: with a log-normal
prior alone the mean of the factors that they allow would be 1.2 to 1.4 where 1 is true, and a source more precise than
others has no other evidence.

The errors of a sensor rarely grow with distance as described. One factor, mostly of near objects, would make far ones
impossible partners. So each octave of distance from the sensor (:attr:`sameas.picture.tables.Scan.range_band`) has its
own factor f_b, with prior p(f_b | f) = ½ δ(f_b − f) + ½ log-normal about f, where f has the posterior above; its
evidence are the differences and residuals of that octave alone, given the factors of the other sources' octaves.

A new estimate changes what is known of the errors, not the errors: the previous instant is then judged by it as well
(:meth:`sameas.picture.named_tracks.NamedTracks.with_present_factors`).

A source's offset, which its reports have in common, is not included; see :mod:`sameas.tracks.registration`.

Source: mean-field approximation as in Bishop, Pattern Recognition and Machine Learning, section 10.1.

Error correlation (:class:`ErrorCorrelation`) is estimated from a source's own tracks. The errors of a tracker are
correlated over its smoothing time, those of a receiver over minutes; those of plots are independent. A second report
with the same error adds no information. If the errors of two reports of a track are correlated by ρ = exp(−Δt/τ), the
second differs from the prediction of the first by

    ν ~ N(0, R + R′ − C − Cᵀ + κ D),   C = ρ L L′ᵀ,

with R = L Lᵀ and R′ = L′ L′ᵀ the covariances of the two reports, and D the largest covariance of the motion between
them. Most objects move far less, so κ is one of ``motion_shares``, equally probable. Each report updates the
probability of every τ (``correlation_s``). The prior of ln(τ + 1 s) is normal about that of the source's kind
(:data:`sameas.tracks.kinds.KINDS`) with σ ``correlation_sigma``; after some dozens of reports the data dominate.

A share s of the error variance is *lasting*, that is constant for a track: the antenna's place on the hull, a residual
bias. It is one vector z ~ N(0, 1) for all reports of a track, e = √s L z + f; only f decorrelates with τ, and ρ above
is s + (1 − s) exp(−Δt/τ). A single track cannot separate a constant error from its position, so s is estimated from
pairs of tracks that are surely one object, by their differences δ and δ′ some time apart:

    δ′ ~ N(M δ, S − M S Mᵀ),   M = C S⁻¹,   S = P_a + P_b,   C = Σ_{a,b} [s + (1 − s) g exp(−Δt/τ)] R.

g is the share of f that the reports between keep of the motion alone (:mod:`sameas.picture.named_tracks`, G at ρ = 1):
a filter of plots forgets its error in some reports. Without g, constant errors of filtered tracks would count as a long
τ, and the pairs, whose f decays by g as well, would see the same error as new evidence at each report.

Source: autocorrelated errors of tracks as in Bar-Shalom, Li and Kirubarajan 2001, section 8.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import log_softmax, logsumexp

from sameas.arrays import BoolArray, FloatArray, IntArray, ordered_by
from sameas.gaussian import inverse, log_density, mahalanobis_sq
from sameas.kernels.kalman import add_evidence, correlated_shifts, update_in_plane
from sameas.picture.tables import RANGE_BANDS, Scan
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.tracks.alignment import moved
from sameas.tracks.kinds import KINDS

#: Smallest variance of a step, m²: keeps the covariance of a step without errors invertible.
MIN_M2 = 1e-6


def error_update(
    mean: FloatArray, covariance: FloatArray, slope: FloatArray, noise: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The Kalman update by ν = H x + n: mean and covariance of x, ln p(ν), and χ² of ν.

    mean, covariance : (k, d), (k, d, d) of x, the errors of tracks and their constant part, before a report.
    slope, noise : (k, 2, d), (k, 2, 2) H and the covariance of n. shift : (k, 2) ν.
    """
    out = np.empty(mean.shape), np.empty(covariance.shape), np.empty(len(mean)), np.empty(len(mean))
    update_in_plane(mean, covariance, slope, noise + MIN_M2 * np.eye(2), shift, *out)
    return out


def growth(change: FloatArray) -> FloatArray:
    """(n, 2, 2) the positive semidefinite part of changes of covariances.

    >>> growth(np.array([[[0.0, 1.0], [1.0, 0.0]], [[-2.0, 0.0], [0.0, 3.0]]])).tolist()
    [[[0.5, 0.5], [0.5, 0.5]], [[0.0, 0.0], [0.0, 3.0]]]
    """
    mean = 0.5 * (change[:, 0, 0] + change[:, 1, 1])
    half, cross = 0.5 * (change[:, 0, 0] - change[:, 1, 1]), 0.5 * (change[:, 0, 1] + change[:, 1, 0])
    radius = np.hypot(half, cross)
    # The eigenvalues are m ± r; the projector of m + r is ½ [1 + D / r], D the traceless part of the change.
    high, low = np.maximum(mean + radius, 0.0), np.maximum(mean - radius, 0.0)
    level, slope = 0.5 * (high + low), 0.5 * (high - low) / np.where(radius > 0.0, radius, 1.0)
    out = np.empty(change.shape)
    out[:, 0, 0], out[:, 1, 1] = level + slope * half, level - slope * half
    out[:, 0, 1] = out[:, 1, 0] = slope * cross
    return out


#: Correlations of two reports at which likelihoods are computed; interpolated between.
CORRELATIONS = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0])
#: The same for error factors, of which neighbouring ones differ by 2^¼: 1 − ρ is 1, 2^(−½), ½ … so that f² (1 − ρ) has
#: the same values for all f; and 0, for receivers that repeat positions.
FACTOR_CORRELATIONS = np.append(1.0 - 2.0 ** (-0.5 * np.arange(16)), 1.0)


@dataclass(frozen=True)
class ErrorCorrelation:
    """The estimated correlation times and lasting shares of the errors of sources.

    names : of the sources. log_probable : (S, s, τ) ln of the probability of each lasting share and each τ, up to a
    constant; log_prior : (S, s, τ) before any evidence. factor : (S,) the error factors by which the evidence was
    judged, NaN before any. used : (S,) the lowest lasting share by which the evidence of pairs was weighed since it was
    last dropped, NaN before any (:meth:`weighing`). fixed_s : τ by source where the user gives it; these are not
    estimated, and have no lasting share.
    """

    names: tuple[str, ...] = ()
    log_probable: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0)))
    log_prior: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0)))
    factor: FloatArray = field(default_factory=lambda: np.empty(0))
    used: FloatArray = field(default_factory=lambda: np.empty(0))
    fixed_s: Mapping[str, float] = field(default_factory=dict)

    def of_sources(self, scan: Scan) -> ErrorCorrelation:
        """The estimate with the new sources of a scan at their prior."""
        new = [d for d in scan.now.descriptions if d.name not in self.names]
        if self.names and not new:
            return self
        kind_s = np.array([KINDS[description.kind].correlation_s for description in new], np.float64)
        log_change = np.log(np.array(scan.tuning.correlation_s) + 1.0) - np.log(kind_s[:, None] + 1.0)
        prior = -0.5 * (log_change / scan.tuning.correlation_sigma) ** 2
        prior = np.repeat(prior[:, None], len(scan.tuning.lasting_shares), axis=1)
        log_probable, log_prior = (
            np.concatenate([before, prior]) if self.names else prior for before in (self.log_probable, self.log_prior)
        )
        names = (*self.names, *(description.name for description in new))
        factor, used = (np.append(before, np.full(len(new), np.nan)) for before in (self.factor, self.used))
        return replace(self, names=names, log_probable=log_probable, log_prior=log_prior, factor=factor, used=used)

    def with_factors(self, factor: FloatArray, tuning: Tuning) -> ErrorCorrelation:
        """The estimate by other error factors of the sources, (S,).

        Residuals of tracks measure f² (1 − ρ), and differences of pairs the same. Where f has changed by more than
        ``correlation_restart``, what they showed of ρ no longer holds, and the estimate begins anew: errors that were
        stated three times too large, and are new in every report, would stay persistent.
        """
        change = np.abs(np.log(factor / self.factor))
        changed = np.flatnonzero(change > tuning.correlation_restart)
        if not len(changed) and np.isfinite(change).all():
            return self
        log_probable = self.log_probable.copy()
        log_probable[changed] = self.log_prior[changed]
        factor = np.where(change <= tuning.correlation_restart, self.factor, factor)
        return replace(self, log_probable=log_probable, factor=factor)

    def begun_anew(self, before: ErrorCorrelation) -> BoolArray:
        """(S,) of which sources the estimate began anew since ``before``, of the same sources."""
        return np.asarray(np.isfinite(before.factor) & (self.factor != before.factor))

    def weighing(self, tuning: Tuning) -> tuple[ErrorCorrelation, BoolArray]:
        """The estimate before it weighs the evidence of the next reports, and (S,) of which sources the previous
        evidence was weighed by a lasting share too low by ``lasting_restart``.

        That evidence counted constant errors as new ones, again with every report, and would outweigh all that follows.
        Evidence weighed by too high a share is only too weak.
        """
        lasting = self.lasting(np.arange(len(self.names)), tuning)
        outgrown = lasting > self.used + tuning.lasting_restart
        return replace(self, used=np.where(outgrown, lasting, np.fmin(self.used, lasting))), outgrown

    def numbers(self, scan: Scan) -> IntArray:
        """(S,) the index in ``names`` of each source of a scan."""
        return np.array([self.names.index(d.name) for d in scan.now.descriptions], dtype=np.int64)

    def lasting(self, source: IntArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(n,) mean s of the sources."""
        mean = np.einsum("nst,s->n", self._weights, np.array(tuning.lasting_shares))
        return np.where(np.isfinite(self._fixed_s), 0.0, mean)[source]

    def correlation(
        self, source: IntArray, elapsed_s: FloatArray, tuning: Tuning = DEFAULT_TUNING, kept: float | FloatArray = 1.0
    ) -> FloatArray:
        """(n,) mean correlation s + (1 − s) g exp(−Δt/τ) of two reports of tracks of the sources, ``elapsed_s`` apart;
        kept : (n,) g."""
        return self.lasting(source, tuning) + kept * self.decaying(source, elapsed_s, tuning)

    def decaying(self, source: IntArray, elapsed_s: FloatArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(n,) the part of the correlation that decays, mean (1 − s) exp(−Δt/τ)."""
        of_tau = np.einsum("nst,s->nt", self._weights, 1.0 - np.array(tuning.lasting_shares))
        # Sources have few distinct Δt.
        elapsed_s, at = np.unique(elapsed_s, return_inverse=True)
        mean = np.einsum("st,nt->ns", of_tau, _rho(elapsed_s, np.array(tuning.correlation_s)))[at, source]
        fixed_s = self._fixed_s
        if not np.isfinite(fixed_s).any():
            return np.asarray(mean)
        given = _rho(elapsed_s, np.nan_to_num(fixed_s))[at, source]
        return np.where(np.isfinite(fixed_s)[source], given, mean)

    def of_mean(self, source: IntArray, every_s: float, count: IntArray, tuning: Tuning) -> FloatArray:
        """(n,) variance of the mean of ``count`` (n,) reports ``every_s`` apart, relative to that of one report."""
        steps = np.arange(1, int(count.max(initial=1)))
        correlation = self.correlation(
            np.repeat(np.arange(len(self.names)), len(steps)), np.tile(every_s * steps, len(self.names)), tuning
        ).reshape(len(self.names), len(steps))
        # The mean correlation over all ordered pairs of n reports; 2 (n − k) of the pairs are k steps apart.
        sums = [np.cumsum(np.pad(part, ((0, 0), (1, 0))), axis=1) for part in (correlation, steps * correlation)]
        n = np.maximum(count, 1)
        total, weighted = (part[source, n - 1] for part in sums)
        return np.asarray((n + 2.0 * (n * total - weighted)) / n**2)

    @cached_property
    def _weights(self) -> FloatArray:
        """(S, s, τ) probabilities."""
        weight = np.exp(self.log_probable - self.log_probable.max(axis=(1, 2), initial=-np.inf, keepdims=True))
        return np.asarray(weight / weight.sum(axis=(1, 2), keepdims=True))

    @cached_property
    def _fixed_s(self) -> FloatArray:
        """(S,) τ where the user gives it, else NaN."""
        return np.array([self.fixed_s.get(name, np.nan) for name in self.names], np.float64)

    def updated(
        self,
        source: IntArray,
        elapsed_s: FloatArray,
        shift: FloatArray,
        errors: tuple[FloatArray, FloatArray],
        motion: tuple[FloatArray, FloatArray],
        tuning: Tuning = DEFAULT_TUNING,
    ) -> ErrorCorrelation:
        """The estimate after new reports of tracks; reports after a manoeuvre are ignored.

        Parameters
        ----------
        source, elapsed_s, shift : (n,), (n,), (n, 2) the source, Δt and ν of each report.
        errors : R + R′ and L L′ᵀ, (n, 2, 2) each. motion : D, and what is in it from the errors of measured velocities.
        """
        steady = mahalanobis_sq(shift, errors[0] + motion[0]) <= tuning.manoeuvre_chi_sq
        source, elapsed_s, shift, motion = (
            source[steady],
            elapsed_s[steady],
            shift[steady],
            (motion[0][steady], motion[1][steady]),
        )
        total, common = errors[0][steady], (errors[1] + errors[1].transpose(0, 2, 1))[steady]
        log_p = np.logaddexp(*_log_shifts(shift, (total, common), motion, CORRELATIONS, tuning))
        return self._with_evidence(source, elapsed_s, log_p, np.ones(len(log_p)), tuning)

    def with_sure_pairs(
        self,
        sources: tuple[IntArray, IntArray],
        elapsed_s: FloatArray,
        differences: tuple[FloatArray, FloatArray],
        reported: tuple[FloatArray, FloatArray],
        total: FloatArray,
        kept: FloatArray,
        tuning: Tuning = DEFAULT_TUNING,
    ) -> ErrorCorrelation:
        """The estimate after comparing the differences of sure pairs with earlier ones of the same pairs.

        Parameters
        ----------
        sources : of both tracks, (n,) each. elapsed_s : (n,) Δt. differences : δ and δ′, (n, 2) each.
        reported : R of both, (n, 2, 2) each. total : (n, 2, 2) S. kept : (n, 2) g of both.
        """
        if not len(elapsed_s):
            return self
        out, precision = self, inverse(total)
        mean_rho = [
            self.correlation(source, elapsed_s, tuning, kept[:, side])[:, None, None]
            for side, source in enumerate(sources)
        ]
        for own, other in ((0, 1), (1, 0)):
            # (c, n, 2, 2): each possible correlation of one source, the present mean of the other.
            common = CORRELATIONS[:, None, None, None] * reported[own] + mean_rho[other] * reported[other]
            slope = common @ precision
            innovation = differences[1] - np.einsum("cnvw,nw->cnv", slope, differences[0])
            log_p = log_density(innovation, total - slope @ common.swapaxes(2, 3) + MIN_M2 * np.eye(2)).T
            out = out._with_evidence(sources[own], elapsed_s, log_p, kept[:, own], tuning)
        return out

    def _with_evidence(
        self, source: IntArray, elapsed_s: FloatArray, log_p: FloatArray, kept: FloatArray, tuning: Tuning
    ) -> ErrorCorrelation:
        """The estimate after n independent observations; log_p : (n, k) their ln p for each of :data:`CORRELATIONS`.
        kept : (n,) g."""
        log_probable = self.log_probable.copy()
        # An observation whose covariance is singular by rounding is none.
        log_p = np.where(np.isfinite(log_p).all(axis=1, keepdims=True), log_p, 0.0)
        # Sources have few distinct Δt: log-likelihoods are summed per Δt first.
        elapsed_ms = np.rint(1e3 * elapsed_s)
        key, group = np.unique(np.column_stack([source, elapsed_ms, kept]), axis=0, return_inverse=True)
        sums = np.zeros((len(key), len(CORRELATIONS)))
        np.add.at(sums, group.ravel(), log_p)
        rho = key[:, 2:] * _rho(1e-3 * key[:, 1], np.array(tuning.correlation_s))
        add_evidence(key[:, 0].astype(np.int64), rho, sums, CORRELATIONS, np.array(tuning.lasting_shares), log_probable)
        return replace(self, log_probable=log_probable)


def _log_shifts(
    shift: FloatArray, errors: Sequence[FloatArray], motion: Sequence[FloatArray], correlations: FloatArray,
    tuning: Tuning,
) -> FloatArray:  # fmt: skip
    """(2, n, c) ln p of ν (n, 2) for correlations ρ (c,): with κ on all of the motion, and with κ on all but the errors
    of measured velocities, which are as stated.

    errors : (n, 2, 2) R + R′, and L L′ᵀ + L′ Lᵀ. motion : (n, 2, 2) D, and what is in it from these errors.
    """
    (total, common), (whole, by_velocity), shares = errors, motion, np.array(tuning.motion_shares)
    log_p = np.empty((2, len(shift), len(correlations)))
    for fixed, scaled, out in ((total, whole, log_p[0]), (total + by_velocity, growth(whole - by_velocity), log_p[1])):
        correlated_shifts(shift, fixed, common, scaled, correlations, shares, MIN_M2, out)
    return log_p


def _rho(elapsed_s: FloatArray, tau_s: FloatArray) -> FloatArray:
    """(n, τ) ρ = exp(−Δt/τ), for τ (τ,) or (n, τ) in seconds; 0 where τ is 0."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        rho = np.exp(-np.maximum(elapsed_s, 0.0)[:, None] / tau_s)
    return np.where(tau_s > 0.0, rho, 0.0)


#: Sources whose joint posterior is computed exactly, and mean-field iterations over blocks of that size.
BLOCK, STEPS = 3, 5
#: At most this many pairs and reports of an instant are used, to limit the time; and at most this many reports of a
#: part of a source: more add no information.
MAX_PAIRS, MAX_REPORTS, MOST_OF_PART = 64, 32, 2000


@dataclass(frozen=True)
class ErrorFactors:
    """The estimated factors on the stated errors of sources.

    names : of the S sources; part s B + b of them is range band b of source s, B = ``RANGE_BANDS``.
    log_likely : (S B, S B, K, K) L_ab of parts a < b, by the factors of both.
    log_shifts : (S B, K, 2ρ) ln p of the residuals of their tracks, with κ on all of the motion, and with κ on all but
    the errors of measured velocities. reports : (S B,) how many reports these are from.
    factor : (S,) root mean square of each source's factor: the variance of its errors is the mean over the posterior.
    sigma : (S,) 1σ of its logarithm. by_range : (S, B) the factor of each range band.
    """

    names: tuple[str, ...] = ()
    log_likely: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0, 0)))
    log_shifts: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0)))
    reports: FloatArray = field(default_factory=lambda: np.empty(0))
    factor: FloatArray = field(default_factory=lambda: np.empty(0))
    sigma: FloatArray = field(default_factory=lambda: np.empty(0))
    by_range: FloatArray = field(default_factory=lambda: np.empty((0, RANGE_BANDS)))

    def of_sources(self, names: tuple[str, ...], tuning: Tuning = DEFAULT_TUNING) -> ErrorFactors:
        """The estimate with new sources at their prior; names : of all sources, those already known first."""
        if names == self.names:
            return self
        k, n, known = len(tuning.error_factors), RANGE_BANDS * len(names), len(self.reports)
        log_likely = np.zeros((n, n, k, k))
        log_likely[:known, :known] = self.log_likely.reshape(known, known, k, k)
        log_shifts, reports = np.zeros((n, k, 2 * len(FACTOR_CORRELATIONS))), np.zeros(n)
        log_shifts[:known], reports[:known] = (
            self.log_shifts.reshape(known, k, 2 * len(FACTOR_CORRELATIONS)),
            self.reports,
        )
        extended = replace(self, names=names, log_likely=log_likely, log_shifts=log_shifts, reports=reports)
        return extended._with_posterior(tuning)

    def informative(self, part: IntArray, position: FloatArray, stated: FloatArray, motion: FloatArray) -> IntArray:
        """(k,) the new reports, of (n,), that :meth:`with_shifts` should use.

        part, position : (n,), (n, 2). stated, motion : (n, 2, 2) R + R′ as stated, and D. Where the motion is larger
        than the errors, residuals would test the motion model instead.
        """
        steady = np.trace(motion, axis1=1, axis2=2) < np.trace(stated, axis1=1, axis2=2)
        which = np.flatnonzero(steady & (self.reports[part] < MOST_OF_PART))
        return which[evenly(position[which], MAX_REPORTS)]

    def with_shifts(
        self,
        part: IntArray,
        shift: FloatArray,
        errors: tuple[FloatArray, FloatArray],
        motion: tuple[FloatArray, FloatArray],
        tuning: Tuning = DEFAULT_TUNING,
    ) -> ErrorFactors:
        """The estimate after new reports of tracks, those chosen by :meth:`informative`.

        Parameters
        ----------
        part, shift : (n,), (n, 2) the part of the source, and ν. errors : R + R′ and L L′ᵀ as stated. motion : D, and
        what is in it from the errors of measured velocities. (n, 2, 2) each.
        """
        n = len(part)
        if not n:
            return self
        total, common = errors[0], errors[1] + errors[1].transpose(0, 2, 1)
        log_outlier = log_density(shift, tuning.factor_outlier**2 * total) - np.log(1.0 / tuning.factor_outliers - 1.0)
        # All factors at once, (factors times n, …).
        sq = np.array(tuning.error_factors) ** 2
        errors_of = [np.multiply.outer(sq, each).reshape(-1, 2, 2) for each in (total, common)]
        motion_of = [np.tile(each, (len(sq), 1, 1)) for each in motion]
        log_p = _log_shifts(np.tile(shift, (len(sq), 1)), errors_of, motion_of, FACTOR_CORRELATIONS, tuning)
        both_cases = np.moveaxis(log_p.reshape(2, len(sq), n, -1), 0, 2).reshape(len(sq), n, -1)
        # Half weight: each report enters two successive residuals.
        log_likely = 0.5 * np.logaddexp(both_cases, log_outlier[:, None])
        log_shifts = self.log_shifts.copy()
        for p in np.unique(part).tolist():
            log_shifts[p] += log_likely[:, part == p].sum(axis=1)
        reports = self.reports + np.bincount(part, minlength=len(self.reports))
        return replace(self, log_shifts=log_shifts, reports=reports)

    def with_sure_pairs(
        self,
        parts: tuple[IntArray, IntArray],
        delta: FloatArray,
        stated: tuple[FloatArray, FloatArray],
        motion: FloatArray,
        weight: FloatArray,
        tuning: Tuning = DEFAULT_TUNING,
    ) -> ErrorFactors:
        """The estimate after pairs of tracks that are surely one object, at most :data:`MAX_PAIRS` per instant.

        Parameters
        ----------
        parts : of both sources, (n,) each. delta : (n, 2) δ. stated : R of both, (n, 2, 2) each.
        motion : (n, 2, 2) D. weight : (n,) of :func:`information`.
        """
        if not len(delta):
            return self
        swap = parts[0] > parts[1]
        first, second = np.minimum(*parts), np.maximum(*parts)
        one, other = (np.where(swap[:, None, None], *both) for both in (stated[::-1], stated))
        log_p, log_likely = (
            weight[:, None, None] * _log_density(delta, one, other, motion, tuning),
            self.log_likely.copy(),
        )
        np.add.at(log_likely, (first, second), log_p)
        return replace(self, log_likely=log_likely)._with_posterior(tuning)

    def of_records(self, scan: Scan) -> FloatArray:
        """(n,) the factor of each record; 1 for directions and for sources that are not in ``names``."""
        if not len(scan):
            return np.empty(0)
        names = {name: k for k, name in enumerate(self.names)}
        as_stated = np.ones(RANGE_BANDS)
        factors = [self.by_range[names[d.name]] if d.name in names else as_stated for d in scan.now.descriptions]
        return np.where(scan.placed, np.array(factors)[scan.source, scan.range_band], 1.0)

    def applied(self, scan: Scan) -> Scan:
        """The scan with the position errors of its records multiplied by the factors instead of those applied before;
        errors of velocities only if these come from positions."""
        factor = self.of_records(scan)
        change = factor / scan.error_factor
        if np.all(np.abs(change - 1.0) < 1e-9):
            return scan
        scale = np.ones((len(scan), 4))
        scale[:, :2] = change[:, None]
        # Velocities from positions have correlated errors: those are wrong by the same factor.
        from_positions = np.nan_to_num(scan.reported_covariance[:, :2, 2:]).any(axis=(1, 2))
        scale[from_positions, 2:] = change[from_positions, None]
        reported = scale[:, :, None] * scan.reported_covariance * scale[:, None, :]
        added = np.nan_to_num(reported - scan.reported_covariance)
        _, extra = moved(np.zeros((len(scan), 4)), added, scan.now.instant_s - scan.time_s, np.zeros(len(scan)))
        return replace(scan.with_covariance(extra), reported_covariance=reported, error_factor=factor)

    def lines(self) -> list[str]:
        """Printable lines on the sources whose errors differ from the stated ones by 3σ and by 25 % or more."""
        return [
            f"{name}: positions err by {factor:.2g} times what is stated or assumed (ln ± {sigma:.2g}); counted so"
            for name, factor, sigma in zip(self.names, self.factor.tolist(), self.sigma.tolist(), strict=True)
            if abs(np.log(factor)) > max(3.0 * sigma, np.log(1.25))
        ]

    def _with_posterior(self, tuning: Tuning) -> ErrorFactors:
        """The estimate with ``factor``, ``sigma`` and ``by_range`` updated to all evidence."""
        logs, n, k = np.log(np.array(tuning.error_factors)), len(self.names), len(tuning.error_factors)
        own = _log_prior(logs, tuning) + _of_residuals(
            self.log_shifts.reshape(n, RANGE_BANDS, k, -1).sum(axis=1), tuning
        )
        # L symmetrised: by the factor of the first part, then of the second.
        of_parts = self.log_likely + self.log_likely.transpose(1, 0, 3, 2)
        pairwise = of_parts.reshape(n, RANGE_BANDS, n, RANGE_BANDS, k, k).sum(axis=(1, 3))
        weight = np.exp(log_softmax(own, axis=1))
        blocks = [np.arange(begin, min(begin + BLOCK, n)) for begin in range(0, n, BLOCK)]
        for _ in range(STEPS if len(blocks) > 1 else 1):
            for block in blocks:
                others = np.setdiff1d(np.arange(n), block)
                field_ = np.einsum("stfg,tg->sf", pairwise[np.ix_(block, others)], weight[others])
                weight[block] = _marginals(own[block] + field_, pairwise[np.ix_(block, block)])
        mean = weight @ logs
        sigma = np.sqrt(np.maximum(weight @ logs**2 - mean**2, 0.0))
        factor = np.sqrt(weight @ np.exp(2.0 * logs))
        return replace(
            self, factor=factor, sigma=sigma, by_range=self._by_range(factor, weight, of_parts, logs, tuning)
        )

    def _by_range(
        self, factor: FloatArray, weight: FloatArray, pairwise: FloatArray, logs: FloatArray, tuning: Tuning
    ) -> FloatArray:
        """(S, B) the factors of the range bands: that of the source where it has evidence of one band only.

        factor, weight : (S,), (S, K) root mean square and posterior of the sources' factors. pairwise : (S B, S B, K,
        K) L of parts, symmetrised.
        """
        n, k = weight.shape
        log_pairs = np.einsum("stfg,tg->sf", pairwise, np.repeat(weight, RANGE_BANDS, axis=0))
        has_evidence = (self.reports > 0) | log_pairs.any(axis=1)
        several = has_evidence.reshape(n, RANGE_BANDS).sum(axis=1) > 1
        ratio = np.exp(-0.5 * ((logs - logs[:, None]) / tuning.error_factor_sigma) ** 2)
        change = 0.5 * np.eye(k) + 0.5 * ratio / ratio.sum(axis=1, keepdims=True)
        prior = np.repeat(np.log(weight @ change + 1e-300), RANGE_BANDS, axis=0)
        of_bands = np.exp(log_softmax(prior + _of_residuals(self.log_shifts, tuning) + log_pairs, axis=1))
        return np.where(
            several[:, None], np.sqrt(of_bands @ np.exp(2.0 * logs)).reshape(n, RANGE_BANDS), factor[:, None]
        )


def information(n_previous: IntArray, rho: FloatArray, lasting_rho: FloatArray) -> FloatArray:
    """(n,) how much a difference of a sure pair adds to the estimate of its variance, in independent differences.

    n_previous : (n,) number of the pair's previous differences. rho, lasting_rho : (n,) correlation with the last of
    them, and that with all of them by errors that last.

    The mean square of n differences with the correlation c between any two has the variance of n / (1 + (n − 1) c²)
    independent ones. So a constant error, however often it is seen, is one: all differences are worth 1 / c² at most.
    """
    first = n_previous == 0
    square = lasting_rho**2
    spread = (1.0 + n_previous * square) * (1.0 + (n_previous - 1.0) * square)
    return np.where(first, 1.0, (1.0 - rho**2) / np.where(first, 1.0, spread))


def pairs_within(members: IntArray) -> tuple[IntArray, FloatArray]:
    """(k, 2) the pairs of records of each object, and (k,) what each counts, in independent differences.

    members : (n, S) records of the objects, ABSENT for none. The m (m − 1) / 2 differences of m records are sums of
    m − 1 of them: of three tracks of one ship, the third difference shows nothing new. With a weight of 2 / m each, the
    likelihood of a factor common to all is exact where their errors are equal.

    >>> pairs, share = pairs_within(np.array([[0, 3, 5], [1, 4, -1]]))
    >>> pairs.tolist(), share.round(2).tolist()
    ([[0, 3], [0, 5], [3, 5], [1, 4]], [0.67, 0.67, 0.67, 1.0])
    """
    one, two = np.triu_indices(members.shape[1], 1)
    pairs = np.stack([members[:, one], members[:, two]], axis=2).reshape(-1, 2)
    share = np.repeat(2.0 / np.maximum((members >= 0).sum(axis=1), 1), len(one))
    complete = (pairs >= 0).all(axis=1)
    return pairs[complete], share[complete]


def evenly(position: FloatArray, max_rows: int) -> IntArray:
    """(k,) rows, ascending, of at most ``max_rows`` of n positions (n, 2), spread evenly in the order of their
    coordinates, so that the choice does not depend on the order of the rows."""
    if len(position) <= max_rows:
        return np.arange(len(position))
    return np.sort(ordered_by(position.T)[np.linspace(0, len(position) - 1, max_rows).astype(np.int64)])


def _of_residuals(log_shifts: FloatArray, tuning: Tuning) -> FloatArray:
    """(n, K) ln p of residuals for each factor, from that for each ρ and both cases of the motion (n, K, 2ρ)."""
    share = tuning.errors_new
    prior = np.full(len(FACTOR_CORRELATIONS), (1.0 - share) / len(FACTOR_CORRELATIONS))
    prior[0] += share
    return np.asarray(logsumexp(log_shifts + np.log(np.tile(prior, 2)), axis=2))


def _log_prior(logs: FloatArray, tuning: Tuning) -> FloatArray:
    """(K,) ln of the prior probability of factors with these logarithms."""
    # With this median the mean square is 1: the variance before any evidence is the stated one.
    log_normal = np.exp(-0.5 * ((logs + tuning.error_factor_sigma**2) / tuning.error_factor_sigma) ** 2)
    as_stated = np.abs(logs) == np.abs(logs).min()
    share = tuning.errors_as_stated
    return np.asarray(np.log((1.0 - share) * log_normal / log_normal.sum() + share * as_stated / as_stated.sum()))


def _marginals(own: FloatArray, pairwise: FloatArray) -> FloatArray:
    """(m, K) marginal probabilities of the factors of m sources, from the log-potentials of each (m, K) and of each two
    (m, m, K, K)."""
    m, k = own.shape
    total = np.zeros((k,) * m)
    for s in range(m):
        total += own[s].reshape([k if axis == s else 1 for axis in range(m)])
        for t in range(s + 1, m):
            total += pairwise[s, t].reshape([k if axis in (s, t) else 1 for axis in range(m)])
    p = np.exp(total - total.max(initial=-np.inf))
    out = np.array([p.sum(axis=tuple(axis for axis in range(m) if axis != s)) for s in range(m)]).reshape(m, k)
    return np.asarray(out / out.sum(axis=1, keepdims=True))


def _log_density(
    delta: FloatArray, one: FloatArray, other: FloatArray, motion: FloatArray, tuning: Tuning
) -> FloatArray:
    """(n, K, K) ln p(δ), up to a constant, for each pair of factors; one, other : (n, 2, 2) R_a and R_b."""
    sq = np.array(tuning.error_factors) ** 2
    xx, xy, yy = (
        sq[:, None] * one[:, v, w, None, None] + sq * other[:, v, w, None, None] + motion[:, v, w, None, None]
        for v, w in ((0, 0), (0, 1), (1, 1))
    )
    xx, yy = xx + MIN_M2, yy + MIN_M2
    det = np.maximum(xx * yy - xy**2, MIN_M2**2)
    x, y = delta[:, 0, None, None], delta[:, 1, None, None]
    chi_sq = (yy * x**2 - 2.0 * xy * x * y + xx * y**2) / det
    inflated = tuning.factor_outlier**2
    inlier, outlier = -0.5 * chi_sq, -0.5 * chi_sq / inflated - np.log(inflated * (1.0 / tuning.factor_outliers - 1.0))
    return np.asarray(np.logaddexp(inlier, outlier) - 0.5 * np.log(det))
