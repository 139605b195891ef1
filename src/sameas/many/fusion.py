"""Fusion: one state from several estimates, according to the correlation of their errors.

- :func:`fuse_independent`: independent errors; weights are inverse covariances.
- :func:`bar_shalom_campo`: two estimates of known cross-covariance (common process noise, a shared sensor).
- :func:`covariance_intersection`: unknown correlation; the result is consistent for any.

The records of an identified object, which may observe different parts of the state, are fused by ``Objects.fused``.
Estimates here are points of one flat space: reduce periodic features to one period first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.gaussian import Gaussian, inverse, symmetric
from sameas.kernels.kalman import weights_of_least_determinant
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Plane

#: Most steps of the weights.
STEPS = 5000
#: Relative error of the optimality condition at which the weights have converged.
OPTIMAL = 1e-7
#: Bisections of a step of vertex exchange: to 2⁻⁴⁵ of it.
BISECTIONS = 45


@in_short
@dataclass(frozen=True)
class Fused:
    """``state`` (n, L) and ``covariance`` (n, L, L); ``weights`` (n, k) of covariance intersection, None elsewhere."""

    state: FloatArray
    covariance: FloatArray
    weights: FloatArray | None = None


def fuse_independent(states: ArrayLike, covariances: ArrayLike) -> Fused:
    """The estimate of least variance from k estimates with independent errors.

    states : (k, L), or (n, k, L) for n objects at once. covariances : (k, L, L) or (n, k, L, L).
    """
    x, p = _estimates(states, covariances)
    fused = Gaussian(x, p).product()
    return Fused(fused.mean, fused.covariance)


def bar_shalom_campo(
    state_1: ArrayLike, covariance_1: ArrayLike, state_2: ArrayLike, covariance_2: ArrayLike, cross: ArrayLike
) -> Fused:
    """The estimate of least variance from two whose errors have the cross-covariance P₁₂ = E[e₁ e₂ᵀ].

    x = x₁ + (P₁ − P₁₂) S⁻¹ (x₂ − x₁), P = P₁ − (P₁ − P₁₂) S⁻¹ (P₁ − P₂₁), S = P₁ + P₂ − P₁₂ − P₂₁
    (Bar-Shalom and Campo 1986). states : (n, L) or (L,); covariances and cross : (n, L, L) or (L, L).
    """
    x, p = _estimates(
        np.stack([np.asarray(state_1, float), np.asarray(state_2, float)], axis=-2),
        np.stack([np.asarray(covariance_1, float), np.asarray(covariance_2, float)], axis=-3),
    )
    p12 = np.broadcast_to(np.asarray(cross, dtype=np.float64), p[:, 0].shape)
    p21 = p12.transpose(0, 2, 1)
    joint = np.block([[p[:, 0], p12], [p21, p[:, 1]]])
    if np.any(np.linalg.eigvalsh(joint)[:, 0] < -1e-9 * np.abs(joint).max(axis=(1, 2))):
        raise InputError(
            "fusion: the cross-covariance is larger than the covariances allow; give P₁₂ = E[e₁ e₂ᵀ] in their unit"
        )
    spread = p[:, 0] + p[:, 1] - p12 - p21
    # Not Gaussian.conditional: S is 0 along errors that both estimates share, and the pseudo-inverse keeps x₁ there.
    gain = (p[:, 0] - p12) @ np.linalg.pinv(spread, hermitian=True)
    state = x[:, 0] + np.einsum("nvw,nw->nv", gain, x[:, 1] - x[:, 0])
    covariance = p[:, 0] - gain @ (p[:, 0] - p21)
    return Fused(state, symmetric(covariance))


def covariance_intersection(states: ArrayLike, covariances: ArrayLike) -> Fused:
    """A consistent estimate from k estimates whose errors may be correlated in any way.

    P⁻¹ = Σ wᵢ Pᵢ⁻¹, x = P Σ wᵢ Pᵢ⁻¹ xᵢ, wᵢ ≥ 0, Σ wᵢ = 1 (Julier and Uhlmann 1997). The weights jointly minimise the
    determinant of P, a convex problem of optimal design: weight is moved from the estimate of smallest gradient to that
    of largest, by the best amount (vertex exchange, Böhning 1986: one step for two estimates), until the equivalence
    theorem of Kiefer and Wolfowitz holds.

    states : (k, L), or (n, k, L) for n objects at once. covariances : (k, L, L) or (n, k, L, L).
    """
    x, p = _estimates(states, covariances)
    weights = intersection_weights(inverse(p))
    fused = Gaussian(x, p).product(weights)
    return Fused(fused.mean, fused.covariance, weights)


def intersection_weights(information: FloatArray) -> FloatArray:
    """(n, k) the weights of :func:`covariance_intersection` for n objects of k estimates, from their information
    matrices Pᵢ⁻¹ (n, k, L, L)."""
    weights = np.empty(information.shape[:2])
    weights_of_least_determinant(np.ascontiguousarray(information), STEPS, OPTIMAL, BISECTIONS, weights)
    return weights


def _estimates(states: ArrayLike, covariances: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """States (n, k, L) and covariances (n, k, L, L), validated."""
    x, p = np.asarray(states, dtype=np.float64), np.asarray(covariances, dtype=np.float64)
    if x.ndim == 2:
        x, p = x[None], p[None]
    if x.ndim != 3 or p.shape != (*x.shape, x.shape[-1]):
        raise InputError(f"fusion: states {x.shape}, covariances {p.shape}; give (n, k, L) and (n, k, L, L)")
    if not (np.isfinite(x).all() and np.isfinite(p).all()):
        raise InputError("fusion: a state or covariance is not finite; leave out estimates that are not known")
    try:
        # A Cholesky factorisation takes a fifth of the time of eigenvalues.
        np.linalg.cholesky(p)
    except np.linalg.LinAlgError:
        wrong = np.argwhere(np.linalg.eigvalsh(p)[..., 0] <= 0)
        if len(wrong):
            raise InputError(
                f"fusion: the covariance of object {wrong[0][0]}, estimate {wrong[0][1]} is not positive definite"
            ) from None
    return x, p


# Correlated sources: two filters of the same target.
#
# Two tracks of one target share its process noise, so their errors are correlated even if the sensors are independent:
# the residual's covariance is Σ₁ + Σ₂ − Σ₁₂ − Σ₁₂ᵀ (METHOD 1; Bar-Shalom 1981). Without the last two terms, the gate of
# equal sensors is 1.2 to 1.7 times too wide on average over position and velocity (most in velocity, and for targets
# that turn slowly), and every probability is biased. :func:`steady_tracks` gives Σ₁₂ of filters in steady state;
# :func:`without_common` subtracts it from two sources, which are then identified like any others.


@in_short
@dataclass(frozen=True)
class KalmanFilter:
    """A source's Kalman filter: measurement ``matrix`` H (m, L), and ``covariance`` R (m, m) of its measurements."""

    matrix: ArrayLike
    covariance: ArrayLike


@in_short
@dataclass(frozen=True)
class SteadyTracks:
    """(L, L) covariances of two filtered tracks of one target, and their cross-covariance E[error₁ error₂ᵀ]."""

    first: FloatArray
    second: FloatArray
    cross: FloatArray

    @property
    def residual(self) -> FloatArray:
        """(L, L) covariance of the tracks' difference: Σ₁ + Σ₂ − Σ₁₂ − Σ₁₂ᵀ."""
        return self.first + self.second - self.cross - self.cross.T

    @property
    def widening(self) -> FloatArray:
        """(L,) factor by which neglecting the cross-covariance overestimates σ of the difference, by component."""
        return np.sqrt(np.diag(self.first + self.second) / np.diag(self.residual))


def steady_tracks(transition: ArrayLike, process: ArrayLike, first: KalmanFilter, second: KalmanFilter) -> SteadyTracks:
    """Steady-state covariances of two filters that track one target with measurements at the same times.

    Parameters
    ----------
    transition : F (L, L) of the target's motion from one measurement to the next.
    process : Q (L, L) of its process noise, the same in both filters.
    first, second : the filters of the two sources.

    The steady state solves the algebraic Riccati equation; with gains K the cross-covariance solves the linear
    equation Σ₁₂ = (I − K₁H₁)(F Σ₁₂ Fᵀ + Q)(I − K₂H₂)ᵀ (Bar-Shalom 1981).

    Example
    -------
    A target that accelerates at random, measured every second by two sensors of 30 m:

    >>> dt, q = 1.0, 25.0
    >>> motion = [[1.0, dt], [0.0, 1.0]]
    >>> noise = q * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
    >>> sensor = KalmanFilter([[1.0, 0.0]], [[30.0**2]])
    >>> steady_tracks(motion, noise, sensor, sensor).widening.round(2)
    array([1.11, 1.87])
    """
    f, q = (np.asarray(x, dtype=np.float64) for x in (transition, process))
    if f.ndim != 2 or f.shape != q.shape or f.shape[0] != f.shape[1]:
        raise InputError(f"steady_tracks: transition {f.shape}, process {q.shape}; give (L, L) both")
    steady = [_steady_state(f, q, one) for one in (first, second)]
    keep = [
        np.eye(len(f)) - gain @ np.asarray(one.matrix) for (_, gain), one in zip(steady, (first, second), strict=True)
    ]
    # vec(A X Bᵀ) = (A ⊗ B) vec X, row by row.
    step = np.kron(keep[0] @ f, keep[1] @ f)
    start = (keep[0] @ q @ keep[1].T).ravel()
    cross = np.linalg.solve(np.eye(len(start)) - step, start).reshape(f.shape)
    return SteadyTracks(steady[0][0], steady[1][0], cross)


def _steady_state(f: FloatArray, q: FloatArray, one: KalmanFilter) -> tuple[FloatArray, FloatArray]:
    """Covariance after the update, and gain, of a filter in steady state."""
    from scipy.linalg import solve_discrete_are

    h, r = (np.asarray(x, dtype=np.float64) for x in (one.matrix, one.covariance))
    if h.ndim != 2 or h.shape[1] != len(f) or r.shape != (len(h), len(h)):
        raise InputError(f"KalmanFilter: matrix {h.shape}, covariance {r.shape}; give (m, {len(f)}) and (m, m)")
    try:
        predicted = solve_discrete_are(f.T, h.T, q, r)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InputError(
            f"KalmanFilter: it never settles ({error}); does it measure what the target's state needs?"
        ) from None
    gain = predicted @ h.T @ inverse(h @ predicted @ h.T + r)
    keep = np.eye(len(f)) - gain @ h
    return keep @ predicted @ keep.T + gain @ r @ gain.T, gain


def without_common(first: Records, second: Records, cross: ArrayLike) -> tuple[Records, Records]:
    """Both sources with their common covariance subtracted, so that a pair's Σ is the covariance of its residual.

    Only the sum over a pair is meaningful afterwards: fuse with the original covariances (:func:`bar_shalom_campo`).

    Parameters
    ----------
    first, second : records in one :class:`Plane`.
    cross : Σ₁₂ (d, d) = E[error₁ error₂ᵀ] of the two records of one object, the same for every pair.

    Raises
    ------
    InputError : Σ₁ + Σ₂ − Σ₁₂ − Σ₁₂ᵀ is not positive definite for every pair.
    """
    d = first.d
    common = np.asarray(cross, dtype=np.float64)
    for records in (first, second):
        if not isinstance(records.space, Plane):
            raise InputError(f"{records.source}: common errors are taken off in a plane; give local coordinates")
    if common.shape != (d, d) or not np.isfinite(common).all():
        raise InputError(f"cross has shape {common.shape}; give ({d}, {d}) finite numbers")
    whole = common + common.T
    limits = [_max_share(records, whole) for records in (first, second)]
    if sum(limits) <= 1.0 + 1e-12:
        raise InputError(
            f"cross is as large as the errors of {first.source} and {second.source} themselves; "
            "the covariance of a residual would not be positive definite"
        )
    # Any split that leaves both covariances positive definite is valid; this one is proportional to the largest shares.
    shares = [one / sum(limits) if np.isfinite(sum(limits)) else 0.5 for one in limits]
    return tuple(_subtracted(r, share * whole) for r, share in zip((first, second), shares, strict=True))  # type: ignore[return-value]


def _max_share(records: Records, whole: FloatArray) -> float:
    """The largest multiple of ``whole`` that leaves every record's covariance positive definite; ∞ if any does."""
    values = np.linalg.eigvals(np.linalg.solve(records.full_covariance(), whole))
    largest = float(values.real.max(initial=0.0))
    return 1.0 / largest if largest > 0.0 else np.inf


def _subtracted(records: Records, common: FloatArray) -> Records:
    """The records with a matrix (d, d) subtracted from every covariance."""
    upper = np.triu_indices(records.d)
    packed = (records.full_covariance() - common)[:, upper[0], upper[1]]
    return replace(records, covariance=np.ascontiguousarray(packed))
