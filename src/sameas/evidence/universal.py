"""The universal rule: any density of objects, and any density of the neighbour of an object (METHOD 3.3 [T13])."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sameas.errors import InputError
from sameas.evidence.densities import DensityFunction, Displacement, Flat, GaussianMixture, Samples, log_normal
from sameas.evidence.expectation import Expected, expectation
from sameas.evidence.rule import Evidence, Rule
from sameas.evidence.spread import AS_QUOTED
from sameas.gate import Pairs
from sameas.records import FloatArray
from sameas.space import Plane

#: Takes positions of the two objects (n, d) each, gives p(M₂ | M₁) (n,).
ConditionalFunction = Callable[[FloatArray, FloatArray], FloatArray]
#: Components times features that closed forms hold at a time.
AT_ONCE = 2**20


@dataclass(frozen=True)
class Universal(Rule):
    """λ = ∫ p(M) N(X₁;M,Σ₁) N(X₂;M,Σ₂) dM / ∬ p(M₁) p(M₂|M₁) N(X₁;M₁,Σ₁) N(X₂;M₂,Σ₂) dM₁ dM₂, for any densities.

    ``Field`` and ``CloseObjects`` are special cases of it and faster. Records lie in a plane, of any dimension.

    Parameters
    ----------
    position : p(M): :class:`Flat`, :class:`GaussianMixture`, :class:`Samples`, or a function of positions (n, d).
    neighbour : p(M₂|M₁): a :class:`GaussianMixture` or :class:`Samples` of the displacement M₂ − M₁, a
        :class:`Displacement`, or a function of M₁ and M₂, (n, d) each. Functions give densities (n,).
        Samples and functions of positions do not go together; ``Samples.smoothed()`` does.
    relative_error : asked of integrals of functions: adaptive cubature up to two dimensions of the integral (features
        once for a Displacement whose ``position`` is no function, twice otherwise), scrambled Sobol points
        above and where cubature does not settle.
    seed : of the Sobol points; the same seed gives the same answer.

    The evidence states its error, ``Evidence.log_error``: that of the integrals and of the samples. It is infinite
    where a density is zero wherever it was looked at: the ratio is then only bounded.

    Example
    -------
    >>> from sameas import Radius, Records
    >>> pairs = Radius(5.0)(Records.of([[0.0, 0.0]], sigma=1.0), Records.of([[0.5, 0.0]], sigma=1.0))
    >>> near = GaussianMixture([1.0], [[0.0, 0.0]], [[[9.0, 0.0], [0.0, 9.0]]])
    >>> Universal(Flat(0.01), near)(pairs).log_ratio.round(3)
    array([1.654])
    """

    position: Flat | GaussianMixture | Samples | DensityFunction
    neighbour: GaussianMixture | Samples | Displacement | ConditionalFunction
    relative_error: float = 1e-4
    seed: int = 0

    def __post_init__(self) -> None:
        for name, given in (("position", self.position), ("neighbour", self.neighbour)):
            if not isinstance(given, Samples) and not callable(given):
                raise InputError(
                    f"Universal: {name} is a {type(given).__name__}; give a GaussianMixture, Samples or a function"
                )
        if isinstance(self.neighbour, Flat):
            raise InputError("Universal: neighbour is Flat; give Displacement(Flat(density)), or use the rule Field")
        if not 0.0 < self.relative_error < 1.0:
            raise InputError(f"Universal: relative_error is {self.relative_error}; give a number between 0 and 1")
        if isinstance(self.neighbour, Samples) and not isinstance(self.position, Flat | GaussianMixture | Samples):
            raise InputError("Universal: position is a function and neighbour Samples; give neighbour.smoothed()")
        closed = GaussianMixture | Samples | Displacement
        if isinstance(self.position, Samples) and not isinstance(self.neighbour, closed):
            raise InputError("Universal: position is Samples and neighbour a function; give position.smoothed()")

    def __call__(self, pairs: Pairs) -> Evidence:
        scene = _Scene.of(pairs, self)
        position = AS_QUOTED.log_density(pairs)
        if not len(pairs):
            return Evidence({"position": position, "place": position, "neighbour": position}, position)
        same, different = scene.same(), scene.different()
        terms = {"position": position, "place": same.log_value, "neighbour": -different.log_value}
        return Evidence(terms, np.hypot(same.error, different.error))


@dataclass(frozen=True)
class _Scene:
    """The positions (m, d) and covariances (m, d, d) of the two records of every pair, and the rule."""

    rule: Universal
    x1: FloatArray
    s1: FloatArray
    x2: FloatArray
    s2: FloatArray

    @classmethod
    def of(cls, pairs: Pairs, rule: Universal) -> _Scene:
        if not isinstance(pairs.first.space, Plane):
            raise InputError("Universal: records are directions; project both sources to one tangent plane first")
        for name, given in (("position", rule.position), ("neighbour", rule.neighbour)):
            if isinstance(given, GaussianMixture | Samples) and given.d != pairs.d:
                raise InputError(f"Universal: {name} has {given.d} features, the records {pairs.d}")
        x1 = pairs.first.features[pairs.i]
        s1, s2 = pairs.first.full_covariance()[pairs.i], pairs.second.full_covariance()[pairs.j]
        # Across a period the second record is taken where it is near the first.
        return cls(rule, x1, s1, x1 - pairs.residual, s2)

    def same(self) -> Expected:
        """∫ p(M) N(X₁; M, Σ₁) N(X₂; M, Σ₂) dM over N(Δ; 0, Σ): the mean of p around the fused position."""
        p = self.rule.position
        if isinstance(p, Flat | GaussianMixture | Samples):
            log_value, error = self._closed(None)
            return Expected(log_value - log_normal(self.x1 - self.x2, self.s1 + self.s2), error)
        gain = np.swapaxes(np.linalg.solve(self.s1 + self.s2, self.s1), 1, 2)
        fused = self.x1 - np.einsum("mvw,mw->mv", gain, self.x1 - self.x2)
        root = np.linalg.cholesky(0.5 * (gain @ self.s2 + np.swapaxes(gain @ self.s2, 1, 2)))
        return self._expected(lambda rows, z: _values(p, _around(fused, root, rows, z)), fused.shape[1], "position")

    def different(self) -> Expected:
        """The density of both records if they are two objects."""
        p, q = self.rule.position, self.rule.neighbour
        if isinstance(p, Flat | GaussianMixture | Samples):
            if isinstance(q, GaussianMixture | Samples):
                return Expected(*self._closed(q))
            if isinstance(q, Displacement):
                return self._displaced(p, q)
        return self._both(p, q)

    def _closed(self, q: GaussianMixture | Samples | None) -> tuple[FloatArray, FloatArray]:
        """ln of the sum over components, and the relative error that comes of samples; no ``q``: one object."""
        p = self.rule.position
        assert isinstance(p, Flat | GaussianMixture | Samples)
        means, covariances, log_weights = _components(q, self.x1.shape[1])
        count = len(means) * (1 if isinstance(p, Flat) else len(p))
        log_value, error = np.empty(len(self.x1)), np.empty(len(self.x1))
        step = max(1, AT_ONCE // (count * self.x1.shape[1] ** 2))
        for begin in range(0, len(self.x1), step):
            some = slice(begin, begin + step)
            x1, s1, s2 = self.x1[some, None], self.s1[some, None], self.s2[some, None] + covariances
            parts = p.log_common(x1, s1, self.x2[some, None] - means, s2) + log_weights[:, None]
            log_value[some] = total = np.logaddexp.reduce(parts, axis=(1, 2))
            share = np.exp(parts - total[:, None, None])
            error[some] = np.hypot(
                _scatter(share.sum(axis=2)) if isinstance(q, Samples) else 0.0,
                _scatter(share.sum(axis=1)) if isinstance(p, Samples) else 0.0,
            )
        return log_value, error

    def _displaced(self, p: Flat | GaussianMixture | Samples, q: Displacement) -> Expected:
        """The mean over displacements m ~ N(−Δ, Σ) of q(m) and of what p says of X₁ and X₂ − m as one object."""
        delta, total = self.x1 - self.x2, self.s1 + self.s2
        root = np.linalg.cholesky(total)

        def integrand(rows: NDArray[np.int64], z: FloatArray) -> FloatArray:
            m = _around(-delta, root, rows, z)
            density = _values(q, m)
            if isinstance(p, Flat):
                return density * p.density
            one = self.x1[rows, None], self.s1[rows, None], self.x2[rows, None] - m, self.s2[rows, None]
            common = np.logaddexp.reduce(p.log_common(*one), axis=-1) - log_normal(one[0] - one[2], total[rows, None])
            return density * np.exp(common)

        return self._expected(integrand, delta.shape[1], "neighbour")

    def _both(self, p: DensityFunction | GaussianMixture | Flat | Samples, q: object) -> Expected:
        """The mean of p(M₁) p(M₂|M₁) over M₁ ~ N(X₁, Σ₁), M₂ ~ N(X₂, Σ₂)."""
        d = self.x1.shape[1]
        root_1, root_2 = np.linalg.cholesky(self.s1), np.linalg.cholesky(self.s2)
        assert callable(p) and callable(q)

        def integrand(rows: NDArray[np.int64], z: FloatArray) -> FloatArray:
            m1, m2 = _around(self.x1, root_1, rows, z[:, :d]), _around(self.x2, root_2, rows, z[:, d:])
            if isinstance(q, GaussianMixture | Displacement):
                return _values(p, m1) * _values(q, m2 - m1)
            flat = np.asarray(q(m1.reshape(-1, d), m2.reshape(-1, d)), np.float64)
            return _values(p, m1) * _shaped(flat, m1)

        return self._expected(integrand, 2 * d, "position or neighbour")

    def _expected(self, integrand: Callable[..., FloatArray], k: int, name: str) -> Expected:
        rule = self.rule
        return expectation(integrand, len(self.x1), k, rule.relative_error, rule.seed, f"the density of {name}")


def _components(q: GaussianMixture | Samples | None, d: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means (l, d), covariances (l, d, d) and ln weights (l,) of displacements; none at all for one object."""
    if isinstance(q, GaussianMixture):
        return np.asarray(q.means), np.asarray(q.covariances), np.log(q.weights)
    means = np.zeros((1, d)) if q is None else np.asarray(q.points)
    return means, np.zeros((len(means), d, d)), np.full(len(means), -math.log(len(means)))


def _scatter(share: FloatArray) -> FloatArray:
    """(m,) relative standard error of a mean over samples, of their shares (m, n) in it."""
    n = share.shape[1]
    return np.asarray(np.sqrt(np.sum((n * share - 1.0) ** 2, axis=1) / (n * (n - 1))))


def _around(mean: FloatArray, root: NDArray[np.floating], rows: NDArray[np.int64], z: FloatArray) -> FloatArray:
    """(r, n, d) the normal points z (n, d) brought to the means and covariances of some pairs."""
    return mean[rows, None] + np.einsum("rvw,nw->rnv", root[rows], z)


def _values(density: DensityFunction | Samples, points: FloatArray) -> FloatArray:
    """(r, n) a density at points (r, n, d)."""
    assert callable(density)
    return _shaped(np.asarray(density(points.reshape(-1, points.shape[-1])), np.float64), points)


def _shaped(flat: FloatArray, points: FloatArray) -> FloatArray:
    n = points.shape[0] * points.shape[1]
    if flat.shape != (n,):
        raise InputError(f"Universal: a density gave shape {flat.shape} for {n} positions; give one number for each")
    return flat.reshape(points.shape[:2])
