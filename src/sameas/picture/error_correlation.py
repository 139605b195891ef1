"""Error correlation: the correlation time of a source's position errors, estimated from its own tracks.

A tracker's errors last as long as it smooths, a receiver's for minutes, and a plot's are independent at every scan. A
second report with the same error adds no information. Where the errors of two reports of a track are correlated by
ρ = exp(−Δt/τ), the second differs from the prediction of the first by

    ν ~ N(0, R + R′ − C − Cᵀ + κ D),   C = ρ L L′ᵀ,

with R = L Lᵀ and R′ = L′ L′ᵀ the covariances of the two reports, and D the largest covariance of the motion between
them. Most objects move far less, so κ is one of ``motion_shares``, each as probable. Every report so changes the
probability of each τ (``correlation_s``). The prior of ln(τ + 1 s) is normal about that of the source's kind
(:data:`CORRELATION_S`) with ``correlation_sigma``; after some dozens of reports the data dominate.

Source: autocorrelated errors of tracks as in Bar-Shalom, Li and Kirubarajan 2001, section 8.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import Gaussian, log_density, mahalanobis_sq, propagated
from sameas.picture.scan import Scan
from sameas.picture.tuning import DEFAULT_TUNING, Tuning

#: Least variance of a step, m²: it keeps the covariance of a certain step invertible.
LEAST_M2 = 1e-6


def error_update(
    mean: FloatArray, covariance: FloatArray, transition: FloatArray, noise: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean and covariance of e′ after a report that moved a track by ν, ln p(ν), and χ² of ν.

    mean, shift : (k, 2). covariance, transition, noise : (k, 2, 2) covariance of e before, G, and the covariance of n.
    """
    slope = transition - np.eye(2)
    total = propagated(slope, covariance) + noise + LEAST_M2 * np.eye(2)
    cross = transition @ covariance @ slope.transpose(0, 2, 1) + noise
    surprise = shift - np.einsum("kvw,kw->kv", slope, mean)
    before = Gaussian(np.einsum("kvw,kw->kv", transition, mean), propagated(transition, covariance) + noise)
    after = before.conditional(cross, surprise, total)
    return after.mean, after.covariance, log_density(surprise, total), mahalanobis_sq(surprise, total)


def growth(change: FloatArray) -> FloatArray:
    """(n, 2, 2) the positive part of changes of covariances."""
    values, axes = np.linalg.eigh(change)
    return np.asarray((axes * np.maximum(values, 0.0)[:, None, :]) @ axes.transpose(0, 2, 1))


#: τ by kind of source: how long an error of position lasts, in seconds. Chosen, not measured.
CORRELATION_S: Mapping[str, float] = {
    "marine radar": 60.0,  # what such a radar names it has smoothed, for a minute or so
    "air radar": 5.0,  # every turn is a new measurement
    "ais": 600.0,  # the antenna stays where it is on the hull, and a receiver's error drifts over minutes
    "ads-b": 600.0,  # a receiver's error drifts over minutes
    "mlat": 30.0,  # the same receivers for a while
    "lidar": 10.0,  # the same side of the hull for a while
    "camera": 10.0,  # the same side of the hull for a while
    "esm": 10.0,
    "tracks": 60.0,  # smoothed
    "other": 60.0,
}


@dataclass(frozen=True)
class ErrorCorrelation:
    """The correlation times of the errors of sources.

    names : of the sources so far. log_probable : (s, τ) ln of the probability of each τ, up to a constant.
    fixed_s : τ that the user gives, by name; these are not estimated.
    """

    names: tuple[str, ...] = ()
    log_probable: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    fixed_s: Mapping[str, float] = field(default_factory=dict)

    def of_sources(self, scan: Scan) -> ErrorCorrelation:
        """The same with the new sources of a scan."""
        new = [d for d in scan.now.descriptions if d.name not in self.names]
        if self.names and not new:
            return self
        kind_s = np.array([CORRELATION_S[description.kind] for description in new], np.float64)
        away = np.log(np.array(scan.tuning.correlation_s) + 1.0) - np.log(kind_s[:, None] + 1.0)
        prior = -0.5 * (away / scan.tuning.correlation_sigma) ** 2
        log_probable = np.vstack([self.log_probable, prior]) if self.names else prior
        return ErrorCorrelation((*self.names, *(description.name for description in new)), log_probable, self.fixed_s)

    def numbers(self, scan: Scan) -> IntArray:
        """(S,) the place in ``names`` of each source of a scan."""
        return np.array([self.names.index(d.name) for d in scan.now.descriptions], dtype=np.int64)

    def rho(self, source: IntArray, elapsed_s: FloatArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(n,) mean ρ of two reports of tracks of the sources, ``elapsed_s`` apart."""
        weight = np.exp(self.log_probable - self.log_probable.max(axis=1, initial=-np.inf, keepdims=True))
        rho_mean = np.einsum(
            "nt,nt->n",
            (weight / weight.sum(axis=1, keepdims=True))[source],
            _rho(elapsed_s, np.array(tuning.correlation_s)),
        )
        fixed_s = np.array([self.fixed_s.get(name, np.nan) for name in self.names])[source]
        rho_fixed = _rho(elapsed_s, np.nan_to_num(fixed_s)[:, None])[:, 0]
        return np.where(np.isfinite(fixed_s), rho_fixed, rho_mean)

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
        log_probable = self.log_probable.copy()
        for k, rho in enumerate(_rho(elapsed_s, np.array(tuning.correlation_s)).T):
            covariance = both - rho[:, None, None] * shared + LEAST_M2 * np.eye(2)
            log_p = np.logaddexp.reduce(
                [log_density(shift, covariance + share * motion) for share in tuning.motion_shares]
            )
            log_probable[:, k] += np.bincount(source, log_p, len(self.names))
        return ErrorCorrelation(self.names, log_probable, self.fixed_s)


def _rho(elapsed_s: FloatArray, tau_s: FloatArray) -> FloatArray:
    """(n, τ) ρ, for τ (τ,) or (n, τ) in seconds."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        rho = np.exp(-np.maximum(elapsed_s, 0.0)[:, None] / tau_s)
    return np.where(tau_s > 0.0, rho, 0.0)
