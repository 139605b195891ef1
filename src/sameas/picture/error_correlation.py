"""Error correlation: for how long a source's errors of position last, learned from how its own tracks go on.

A tracker's errors last for as long as it smooths, a receiver's for minutes, and a plot's are new at every turn. It
decides what a look is worth: a second look with the same error says nothing new. Where the errors of two looks of a
track go together by ρ = exp(−Δt/τ), the second lies from where the first foretold it by

    ν ~ N(0, R + R′ − C − Cᵀ + κ D),   C = ρ L L′ᵀ,

with R = L Lᵀ and R′ = L′ L′ᵀ the covariances of the two reports, and D what the motion between them leaves open, at
most: most objects are far quieter than the most restless of their kind, so κ is one of :data:`RESTLESS`, each as
probable. So every look tells how probable each of some τ is (:data:`TRIED_S`). Beforehand ln(τ + 1 s) is that of the
source's kind (:data:`CORRELATION_S`) to within :data:`KNOWN_TO`, 1σ; after some dozens of looks only they count.

Source: autocorrelated errors of tracks as in Bar-Shalom, Li and Kirubarajan 2001, section 8.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import Gaussian, log_density, mahalanobis_sq, propagated
from sameas.picture.scan import Scan

#: Least variance of a step, m²: keeps what is certain invertible.
LEAST_M2 = 1e-6


def error_update(
    mean: FloatArray, spread: FloatArray, turn: FloatArray, fresh: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean and covariance of e′ after a look that shifted a track by ν, ln p(ν), and χ² of ν.

    mean, shift : (k, 2). spread, turn, fresh : (k, 2, 2) covariance of e before, G, and the covariance of n.
    """
    slope = turn - np.eye(2)
    total = propagated(slope, spread) + fresh + LEAST_M2 * np.eye(2)
    cross = turn @ spread @ slope.transpose(0, 2, 1) + fresh
    surprise = shift - np.einsum("kvw,kw->kv", slope, mean)
    before = Gaussian(np.einsum("kvw,kw->kv", turn, mean), propagated(turn, spread) + fresh)
    after = before.conditional(cross, surprise, total)
    return after.mean, after.covariance, log_density(surprise, total), mahalanobis_sq(surprise, total)


def growth(change: FloatArray) -> FloatArray:
    """(n, 2, 2) changes of covariances without what shrank."""
    values, axes = np.linalg.eigh(change)
    return np.asarray((axes * np.maximum(values, 0.0)[:, None, :]) @ axes.transpose(0, 2, 1))


#: τ by kind of source: how long an error of position lasts, in seconds. Chosen, not measured.
CORRELATION_S: Mapping[str, float] = {
    "marine radar": 60.0,  # what such a radar names it has smoothed, for a minute or so
    "air radar": 5.0,  # every turn measures anew
    "ais": 600.0,  # the antenna stays where it is on the hull, and a receiver's error drifts over minutes
    "ads-b": 600.0,  # a receiver's error drifts over minutes
    "mlat": 30.0,  # the same receivers for a while
    "lidar": 10.0,  # the same side of the hull for a while
    "camera": 10.0,  # the same side of the hull for a while
    "esm": 10.0,
    "tracks": 60.0,  # smoothed
    "other": 60.0,
}
#: τ that are tried, seconds.
TRIED_S = np.array([0.0, 2.0, 5.0, 12.0, 30.0, 75.0, 180.0, 450.0, 1100.0])
#: 1σ of ln(τ + 1 s) about that of the kind.
KNOWN_TO = 3.0
#: κ that are tried.
RESTLESS = (1.0, 0.1, 0.01)
#: A look farther than this χ² from where it was foretold, whatever τ, is a manoeuvre's and tells nothing of errors.
MOVED_CHI_SQ = 13.8


@dataclass(frozen=True)
class ErrorCorrelation:
    """What is known of how long the errors of sources last.

    names : of the sources heard so far. log_probable : (s, τ) ln of how probable each τ is, up to a constant.
    given_s : τ that the user gives, by name; these are not learned.
    """

    names: tuple[str, ...] = ()
    log_probable: FloatArray = field(default_factory=lambda: np.empty((0, len(TRIED_S))))
    given_s: Mapping[str, float] = field(default_factory=dict)

    def of_sources(self, scan: Scan) -> ErrorCorrelation:
        """The same with the sources of a scan that were not heard before."""
        new = [d for d in scan.now.descriptions if d.name not in self.names]
        if not new:
            return self
        kind_s = np.array([CORRELATION_S[description.kind] for description in new])
        away = np.log(TRIED_S + 1.0) - np.log(kind_s[:, None] + 1.0)
        before = np.vstack([self.log_probable, -0.5 * (away / KNOWN_TO) ** 2])
        return ErrorCorrelation((*self.names, *(description.name for description in new)), before, self.given_s)

    def numbers(self, scan: Scan) -> IntArray:
        """(S,) the place in ``names`` of each source of a scan."""
        return np.array([self.names.index(d.name) for d in scan.now.descriptions], dtype=np.int64)

    def rho(self, source: IntArray, elapsed_s: FloatArray) -> FloatArray:
        """(n,) mean ρ of two looks of tracks of the sources, so long apart."""
        weight = np.exp(self.log_probable - self.log_probable.max(axis=1, initial=-np.inf, keepdims=True))
        mean = np.einsum("nt,nt->n", (weight / weight.sum(axis=1, keepdims=True))[source], _rho(elapsed_s, TRIED_S))
        told = np.array([self.given_s.get(name, np.nan) for name in self.names])[source]
        given = _rho(elapsed_s, np.nan_to_num(told)[:, None])[:, 0]
        return np.where(np.isfinite(told), given, mean)

    def looked(
        self,
        source: IntArray,
        elapsed_s: FloatArray,
        shift: FloatArray,
        errors: tuple[FloatArray, FloatArray],
        motion: FloatArray,
    ) -> ErrorCorrelation:
        """After new looks at tracks.

        Parameters
        ----------
        source, elapsed_s, shift : (n,), (n,), (n, 2) the source, Δt and ν of each look.
        errors : R + R′ and L L′ᵀ, (n, 2, 2) each. motion : (n, 2, 2) D.
        """
        usual = mahalanobis_sq(shift, errors[0] + motion) <= MOVED_CHI_SQ
        source, elapsed_s, shift, motion = source[usual], elapsed_s[usual], shift[usual], motion[usual]
        both, alike = errors[0][usual], (errors[1] + errors[1].transpose(0, 2, 1))[usual]
        more = self.log_probable.copy()
        for k, rho in enumerate(_rho(elapsed_s, TRIED_S).T):
            still = both - rho[:, None, None] * alike + LEAST_M2 * np.eye(2)
            log_p = np.logaddexp.reduce([log_density(shift, still + share * motion) for share in RESTLESS])
            more[:, k] += np.bincount(source, log_p, len(self.names))
        return ErrorCorrelation(self.names, more, self.given_s)


def _rho(elapsed_s: FloatArray, tau_s: FloatArray) -> FloatArray:
    """(n, τ) ρ, for τ (τ,) or (n, τ)."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        rho = np.exp(-np.maximum(elapsed_s, 0.0)[:, None] / tau_s)
    return np.where(tau_s > 0.0, rho, 0.0)
