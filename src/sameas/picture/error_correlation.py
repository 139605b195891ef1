"""Error correlation: for how long the position errors of a source persist.

Error correlation (:class:`ErrorCorrelation`) is estimated from a source's own tracks. The errors of a tracker are
correlated over its smoothing time, those of a receiver over minutes; those of plots are independent. A second report
with the same error adds no information. If the errors of two reports of a track are correlated by ρ = exp(−Δt/τ), the
second differs from the prediction of the first by

    ν ~ N(0, R + R′ − C − Cᵀ + κ D),   C = ρ L L′ᵀ,

with R = L Lᵀ and R′ = L′ L′ᵀ the covariances of the two reports, and D the largest covariance of the motion between
them. Most objects move far less, so κ is one of ``MOTION_SHARES``, equally probable. Each report updates the
probability of every τ (``correlation_s``). The prior of ln(τ + 1 s) is normal about that of the source's kind
(:data:`sameas.tracks.kinds.KINDS`) with σ ``CORRELATION_SIGMA``; after some dozens of reports the data dominate.

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

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray, finite_rows
from sameas.gaussian import inverse, log_density, mahalanobis_sq
from sameas.kernels.kalman import add_evidence, correlated_shifts
from sameas.picture.tables import Scan
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.tracks.kinds import KINDS

#: Smallest variance of a step, m²: keeps the covariance of a step without errors invertible.
MIN_M2 = 1e-6
#: Correlations of two reports at which likelihoods are computed; interpolated between.
CORRELATIONS = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0])

#: A report with a larger χ² from its prediction is of a manoeuvre and not used to estimate errors; the limit of 1 in
#: 1000 for two degrees of freedom.
MANOEUVRE_CHI_SQ = 13.8
#: Prior 1σ of ln(τ + 1 s) about that of the source's kind.
CORRELATION_SIGMA = 3.0
#: Change of ln of a source's error factor beyond which its error correlation is estimated anew.
CORRELATION_RESTART = 0.2
LASTING_RESTART = 0.25  # evidence on pairs that was weighed by a share lower by this than the present one is dropped
MOTION_SHARES = (1.0, 0.1, 0.01)  # grid of shares of the largest motion noise; the prior is uniform


@dataclass(frozen=True)
class ErrorCorrelation:
    """The estimated correlation times and lasting shares of the errors of sources.

    names : of the sources. log_probable : (S, s, τ) ln of the probability of each lasting share and each τ, up to a
    constant; log_prior : (S, s, τ) before any evidence. factor : (S,) the error factors by which the evidence was
    judged, NaN before any. used : (S,) the lowest lasting share by which the evidence of pairs was weighed since it was
    last dropped, NaN before any (:meth:`weighing`).
    """

    names: tuple[str, ...] = ()
    log_probable: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0)))
    log_prior: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0)))
    factor: FloatArray = field(default_factory=lambda: np.empty(0))
    used: FloatArray = field(default_factory=lambda: np.empty(0))

    def of_sources(self, scan: Scan) -> ErrorCorrelation:
        """The estimate with the new sources of a scan at their prior."""
        new = [d for d in scan.now.descriptions if d.name not in self.names]
        if self.names and not new:
            return self
        kind_s = np.array([KINDS[description.kind].correlation_s for description in new], np.float64)
        log_change = np.log(np.array(scan.tuning.correlation_s) + 1.0) - np.log(kind_s[:, None] + 1.0)
        prior = -0.5 * (log_change / CORRELATION_SIGMA) ** 2
        prior = np.repeat(prior[:, None], len(scan.tuning.lasting_shares), axis=1)
        log_probable, log_prior = (
            np.concatenate([before, prior]) if self.names else prior for before in (self.log_probable, self.log_prior)
        )
        names = (*self.names, *(description.name for description in new))
        factor, used = (np.append(before, np.full(len(new), np.nan)) for before in (self.factor, self.used))
        return replace(self, names=names, log_probable=log_probable, log_prior=log_prior, factor=factor, used=used)

    def with_factors(self, factor: FloatArray) -> ErrorCorrelation:
        """The estimate by other error factors of the sources, (S,).

        Residuals of tracks measure f² (1 − ρ), and differences of pairs the same. Where f has changed by more than
        ``CORRELATION_RESTART``, what they showed of ρ no longer holds, and the estimate begins anew: errors that were
        stated three times too large, and are new in every report, would stay persistent.
        """
        change = np.abs(np.log(factor / self.factor))
        changed = np.flatnonzero(change > CORRELATION_RESTART)
        if not len(changed) and np.isfinite(change).all():
            return self
        log_probable = self.log_probable.copy()
        log_probable[changed] = self.log_prior[changed]
        factor = np.where(change <= CORRELATION_RESTART, self.factor, factor)
        return replace(self, log_probable=log_probable, factor=factor)

    def begun_anew(self, before: ErrorCorrelation) -> BoolArray:
        """(S,) of which sources the estimate began anew since ``before``, of the same sources."""
        return np.asarray(np.isfinite(before.factor) & (self.factor != before.factor))

    def weighing(self, tuning: Tuning) -> tuple[ErrorCorrelation, BoolArray]:
        """The estimate before it weighs the evidence of the next reports, and (S,) of which sources the previous
        evidence was weighed by a lasting share too low by ``LASTING_RESTART``.

        That evidence counted constant errors as new ones, again with every report, and would outweigh all that follows.
        Evidence weighed by too high a share is only too weak.
        """
        lasting = self.lasting(np.arange(len(self.names)), tuning)
        outgrown = lasting > self.used + LASTING_RESTART
        return replace(self, used=np.where(outgrown, lasting, np.fmin(self.used, lasting))), outgrown

    def numbers(self, scan: Scan) -> IntArray:
        """(S,) the index in ``names`` of each source of a scan."""
        return np.array([self.names.index(d.name) for d in scan.now.descriptions], dtype=np.int64)

    def lasting(self, source: IntArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(n,) mean s of the sources."""
        return np.asarray(np.einsum("nst,s->n", self._weights, np.array(tuning.lasting_shares))[source])

    def correlation(
        self, source: IntArray, elapsed_s: FloatArray, tuning: Tuning = DEFAULT_TUNING, kept: float | FloatArray = 1.0
    ) -> FloatArray:
        """(n,) mean correlation s + (1 − s) g exp(−Δt/τ) of two reports of tracks of the sources, ``elapsed_s`` apart;
        kept : (n,) g."""
        return self.lasting(source, tuning) + kept * self.decaying(source, elapsed_s, tuning)

    def decaying(self, source: IntArray, elapsed_s: FloatArray, tuning: Tuning) -> FloatArray:
        """(n,) the part of the correlation that decays, mean (1 − s) exp(−Δt/τ)."""
        of_tau = np.einsum("nst,s->nt", self._weights, 1.0 - np.array(tuning.lasting_shares))
        # Sources have few distinct Δt.
        elapsed_s, at = np.unique(elapsed_s, return_inverse=True)
        return np.asarray(np.einsum("st,nt->ns", of_tau, _rho(elapsed_s, np.array(tuning.correlation_s)))[at, source])

    def of_mean(self, source: IntArray, every_s: float, count: IntArray, tuning: Tuning) -> FloatArray:
        """(…) variance of the mean of ``count`` reports of sources, ``every_s`` apart, relative to that of a report."""
        steps = np.arange(1, int(count.max(initial=1)))
        correlation = self.correlation(
            np.repeat(np.arange(len(self.names)), len(steps)), np.tile(every_s * steps, len(self.names)), tuning
        ).reshape(len(self.names), len(steps))
        # The mean correlation over all ordered pairs of n reports; 2 (n − k) of the pairs are k steps apart.
        sums = np.zeros((2, len(self.names), len(steps) + 1))
        np.cumsum([correlation, steps * correlation], axis=2, out=sums[:, :, 1:])
        n = np.maximum(count, 1)
        total, weighted = (part[source, n - 1] for part in sums)
        return np.asarray((n + 2.0 * (n * total - weighted)) / n**2)

    @cached_property
    def _weights(self) -> FloatArray:
        """(S, s, τ) probabilities."""
        weight = np.exp(self.log_probable - self.log_probable.max(axis=(1, 2), initial=-np.inf, keepdims=True))
        return np.asarray(weight / weight.sum(axis=(1, 2), keepdims=True))

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

        source, elapsed_s, shift : (n,), (n,), (n, 2) the source, Δt and ν of each report.
        errors : R + R′ and L L′ᵀ, (n, 2, 2) each. motion : D, and what is in it from the errors of measured velocities.
        """
        steady = mahalanobis_sq(shift, errors[0] + motion[0]) <= MANOEUVRE_CHI_SQ
        source, elapsed_s, shift = source[steady], elapsed_s[steady], shift[steady]
        motion = motion[0][steady], motion[1][steady]
        total, common = errors[0][steady], (errors[1] + errors[1].transpose(0, 2, 1))[steady]
        log_p = np.logaddexp(*log_residuals(shift, (total, common), motion, CORRELATIONS))
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
            with np.errstate(invalid="ignore"):  # a singular covariance: see _with_evidence
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
        log_p = np.where(finite_rows(log_p)[:, None], log_p, 0.0)
        # Sources have few distinct Δt: log-likelihoods are summed per Δt first.
        elapsed_ms = np.rint(1e3 * elapsed_s)
        order = np.lexsort([kept, elapsed_ms, source])
        key = np.column_stack([source, elapsed_ms, kept])[order]
        first = np.ones(len(key), bool)
        first[1:] = (key[1:] != key[:-1]).any(axis=1)
        key, group = key[first], np.empty(len(order), np.int64)
        group[order] = np.cumsum(first) - 1
        sums = np.zeros((len(key), len(CORRELATIONS)))
        np.add.at(sums, group, log_p)
        rho = key[:, 2:] * _rho(1e-3 * key[:, 1], np.array(tuning.correlation_s))
        add_evidence(key[:, 0].astype(np.int64), rho, sums, CORRELATIONS, np.array(tuning.lasting_shares), log_probable)
        return replace(self, log_probable=log_probable)


def log_residuals(
    shift: FloatArray, errors: Sequence[FloatArray], motion: Sequence[FloatArray], correlations: FloatArray
) -> FloatArray:
    """(2, n, c) ln p of ν (n, 2) for correlations ρ (c,): with κ on all of the motion, and with κ on all but the errors
    of measured velocities, which are as stated.

    errors : (n, 2, 2) R + R′, and L L′ᵀ + L′ Lᵀ. motion : (n, 2, 2) D, and what is in it from these errors.
    """
    (total, common), (whole, by_velocity), shares = errors, motion, np.array(MOTION_SHARES)
    log_p = np.empty((2, len(shift), len(correlations)))
    for fixed, scaled, out in ((total, whole, log_p[0]), (total + by_velocity, growth(whole - by_velocity), log_p[1])):
        correlated_shifts(shift, fixed, common, scaled, correlations, shares, MIN_M2, out)
    return log_p


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


def _rho(elapsed_s: FloatArray, tau_s: FloatArray) -> FloatArray:
    """(n, τ) ρ = exp(−Δt/τ), for τ (τ,) or (n, τ) in seconds; 0 where τ is 0."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        rho = np.exp(-np.maximum(elapsed_s, 0.0)[:, None] / tau_s)
    return np.where(tau_s > 0.0, rho, 0.0)
