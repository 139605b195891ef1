"""Sources with common errors: two filters that follow the same manoeuvre have correlated errors.

Two tracks of one target share its process noise, so their errors are correlated even where the sensors are independent:
the residual's covariance is Σ₁ + Σ₂ − Σ₁₂ − Σ₁₂ᵀ (METHOD 1; Bar-Shalom 1981). Without the last two terms the gate of
equal sensors is 1.2 to 1.7 times too wide in the mean over position and velocity (most in velocity, and for targets
that turn slowly), and every probability is off. :func:`steady_tracks` gives Σ₁₂ for filters in
their steady state, :func:`without_common` takes it off two sources, which are then identified like any others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.gaussian import inverse
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Plane


@in_short
@dataclass(frozen=True)
class Filter:
    """A source's Kalman filter: ``matrix`` H (m, L), what it measures, and ``covariance`` R (m, m) of its errors."""

    matrix: ArrayLike
    covariance: ArrayLike


@in_short
@dataclass(frozen=True)
class SteadyTracks:
    """(L, L) covariances of two filtered tracks of one target, and ``cross``, E[error₁ error₂ᵀ]."""

    first: FloatArray
    second: FloatArray
    cross: FloatArray

    @property
    def residual(self) -> FloatArray:
        """(L, L) covariance of the difference of both tracks: Σ₁ + Σ₂ − Σ₁₂ − Σ₁₂ᵀ."""
        return self.first + self.second - self.cross - self.cross.T

    @property
    def widening(self) -> FloatArray:
        """(L,) by how much σ of the difference is overestimated along each component without the common part."""
        return np.sqrt(np.diag(self.first + self.second) / np.diag(self.residual))


def steady_tracks(transition: ArrayLike, process: ArrayLike, first: Filter, second: Filter) -> SteadyTracks:
    """Covariances of two filters that follow one target at the same instants, once they have settled.

    Parameters
    ----------
    transition : F (L, L) of the target's motion from one measurement to the next.
    process : Q (L, L) of its process noise, which both filters know.
    first, second : the filters of the two sources.

    The filters settle by the algebraic Riccati equation; with gains K the cross-covariance solves the linear
    equation Σ₁₂ = (I − K₁H₁)(F Σ₁₂ Fᵀ + Q)(I − K₂H₂)ᵀ (Bar-Shalom 1981).

    Example
    -------
    A target that accelerates at random, measured every second by two sensors of 30 m:

    >>> dt, q = 1.0, 25.0
    >>> motion = [[1.0, dt], [0.0, 1.0]]
    >>> noise = q * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
    >>> sensor = Filter([[1.0, 0.0]], [[30.0**2]])
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


def _steady_state(f: FloatArray, q: FloatArray, one: Filter) -> tuple[FloatArray, FloatArray]:
    """(covariance after the update, gain) of a filter in its steady state."""
    from scipy.linalg import solve_discrete_are

    h, r = (np.asarray(x, dtype=np.float64) for x in (one.matrix, one.covariance))
    if h.ndim != 2 or h.shape[1] != len(f) or r.shape != (len(h), len(h)):
        raise InputError(f"Filter: matrix {h.shape}, covariance {r.shape}; give (m, {len(f)}) and (m, m)")
    try:
        predicted = solve_discrete_are(f.T, h.T, q, r)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InputError(
            f"Filter: it never settles ({error}); does it measure what the target's state needs?"
        ) from None
    gain = predicted @ h.T @ inverse(h @ predicted @ h.T + r)
    keep = np.eye(len(f)) - gain @ h
    return keep @ predicted @ keep.T + gain @ r @ gain.T, gain


def without_common(first: Records, second: Records, cross: ArrayLike) -> tuple[Records, Records]:
    """Both sources with the covariance of their common errors taken off, so that a pair's Σ is that of its residual.

    Only the sum over a pair has a meaning afterwards: fuse with the covariances as they were
    (:func:`sameas.many.fusion.correlated`).

    Parameters
    ----------
    first, second : records in one :class:`Plane`.
    cross : Σ₁₂ (d, d) = E[error₁ error₂ᵀ] of the two records of one object, the same for every pair.

    Raises
    ------
    InputError : where Σ₁ + Σ₂ − Σ₁₂ − Σ₁₂ᵀ cannot be a covariance for every pair.
    """
    d = first.d
    common = np.asarray(cross, dtype=np.float64)
    for records in (first, second):
        if not isinstance(records.space, Plane):
            raise InputError(f"{records.source}: common errors are taken off in a plane; give local coordinates")
    if common.shape != (d, d) or not np.isfinite(common).all():
        raise InputError(f"cross has shape {common.shape}; give ({d}, {d}) finite numbers")
    whole = common + common.T
    least = [_least(records, whole) for records in (first, second)]
    if sum(least) <= 1.0 + 1e-12:
        raise InputError(
            f"cross is as large as the errors of {first.source} and {second.source} themselves; "
            "the covariance of a residual would not be positive definite"
        )
    # Any split that leaves both covariances positive definite is valid: here in proportion to what each can spare.
    shares = [one / sum(least) if np.isfinite(sum(least)) else 0.5 for one in least]
    return tuple(_less(r, share * whole) for r, share in zip((first, second), shares, strict=True))  # type: ignore[return-value]


def _least(records: Records, whole: FloatArray) -> float:
    """The largest share of ``whole`` that every record's covariance can spare; infinite where it takes nothing."""
    values = np.linalg.eigvals(np.linalg.solve(records.full_covariance(), whole))
    largest = float(values.real.max(initial=0.0))
    return 1.0 / largest if largest > 0.0 else np.inf


def _less(records: Records, common: FloatArray) -> Records:
    upper = np.triu_indices(records.d)
    packed = (records.full_covariance() - common)[:, upper[0], upper[1]]
    return replace(records, covariance=np.ascontiguousarray(packed))
