"""Error correlation: the correlation time of a source's position errors, estimated from its own tracks.

A tracker's errors last as long as it smooths, a receiver's for minutes, and a plot's are independent at every scan. A
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

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import inverse, log_density, mahalanobis_sq
from sameas.kernels.kalman import add_evidence, correlated_shifts, update_in_plane
from sameas.picture.scan import Scan
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
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
