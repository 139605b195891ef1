"""The universal rule: any density of objects, and any density of the neighbour of an object (METHOD 3.3 [T13]).

:class:`Universal` sums over mixtures and samples, and integrates functions over normals. :func:`expectation` states the
error of the integrals: adaptive cubature in one and two dimensions, scrambled Sobol points above. Cubature may not
notice jumps of a density; it is used where it converges and agrees with Sobol points, which replace it elsewhere.

Densities of positions:

- :class:`Flat`: the same density everywhere.
- :class:`GaussianMixture`: everything has a closed form.
- :class:`Samples`: draws from a density of unknown form; sums over them come with their standard error.
- :class:`Displacement`: a function of the displacement of the other object from the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence.rule import AS_QUOTED, Evidence, Rule
from sameas.gate import Pairs
from sameas.gaussian import Gaussian, log_density
from sameas.representation import in_short
from sameas.space import Plane

#: Takes positions (n, d), gives densities (n,).
DensityFunction = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Flat:
    """The same density everywhere, 1 / (unit of the features)^d: 1 / volume of the region."""

    density: float

    def __post_init__(self) -> None:
        if not 0.0 < self.density < math.inf:
            raise InputError(f"Flat: density is {self.density}; give a positive number, 1 / volume of the region")

    def __call__(self, points: FloatArray) -> FloatArray:
        """(n,) the density at positions (n, d)."""
        return np.full(len(points), self.density)

    def log_common(self, x1: FloatArray, s1: FloatArray, x2: FloatArray, s2: FloatArray) -> FloatArray:
        """(…, 1) ln ∫ p(M) N(x1; M, s1) N(x2; M, s2) dM."""
        return (log_density(x1 - x2, s1 + s2) + math.log(self.density))[..., None]


@in_short
@dataclass(frozen=True)
class GaussianMixture:
    """Σ w_k N(M; mean_k, covariance_k).

    Parameters
    ----------
    weights : (k,) shares with the sum 1. means : (k, d). covariances : (k, d, d), positive definite.
    """

    weights: ArrayLike
    means: ArrayLike
    covariances: ArrayLike

    def __post_init__(self) -> None:
        weights, means, covariances = (np.asarray(x, np.float64) for x in (self.weights, self.means, self.covariances))
        if means.ndim != 2 or weights.shape != means.shape[:1] or covariances.shape != (*means.shape, means.shape[1]):
            raise InputError(
                f"GaussianMixture: weights {weights.shape}, means {means.shape}, covariances {covariances.shape}; "
                "give (k,), (k, d) and (k, d, d)"
            )
        if not (len(weights) and np.all(weights > 0.0) and abs(weights.sum() - 1.0) < 1e-6):
            raise InputError("GaussianMixture: weights must be positive and have the sum 1")
        if not np.all(np.linalg.eigvalsh(covariances) > 0.0):
            raise InputError("GaussianMixture: a covariance is not positive definite")
        for name, values in (("weights", weights), ("means", means), ("covariances", covariances)):
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(np.asarray(self.means))

    @property
    def d(self) -> int:
        """Number of features."""
        return int(np.shape(self.means)[1])

    def __call__(self, points: FloatArray) -> FloatArray:
        """(n,) the density at positions (n, d)."""
        parts = log_density(points[:, None] - np.asarray(self.means), np.asarray(self.covariances))
        return np.asarray(np.exp(parts) @ np.asarray(self.weights))

    def log_common(self, x1: FloatArray, s1: FloatArray, x2: FloatArray, s2: FloatArray) -> FloatArray:
        """(…, k) ln of the components of ∫ p(M) N(x1; M, s1) N(x2; M, s2) dM."""
        return np.log(self.weights) + log_parts(np.asarray(self.means), np.asarray(self.covariances), x1, s1, x2, s2)


@in_short
@dataclass(frozen=True)
class Samples:
    """Draws (n, d) from a density: of positions, or of displacements between neighbours.

    They must be dense on the scale of the records' errors, or the stated error is large; see :meth:`smoothed`.
    """

    points: ArrayLike

    def __post_init__(self) -> None:
        points = np.asarray(self.points, np.float64)
        if points.ndim != 2 or len(points) < 2 or not np.isfinite(points).all():
            raise InputError(f"Samples: points have shape {points.shape}; give (n, d) finite numbers, n of 2 or more")
        object.__setattr__(self, "points", points)

    def __len__(self) -> int:
        return len(np.asarray(self.points))

    @property
    def d(self) -> int:
        """Number of features."""
        return int(np.shape(self.points)[1])

    def smoothed(self) -> GaussianMixture:
        """The samples as a mixture of normals, with the width of Scott's rule for a single cluster."""
        points = np.asarray(self.points)
        n, d = points.shape
        spread = np.atleast_2d(np.cov(points.T)) * n ** (-2.0 / (d + 4))
        return GaussianMixture(np.full(n, 1.0 / n), points, np.broadcast_to(spread, (n, d, d)))

    def log_common(self, x1: FloatArray, s1: FloatArray, x2: FloatArray, s2: FloatArray) -> FloatArray:
        """(…, n) ln of the components of ∫ p(M) N(x1; M, s1) N(x2; M, s2) dM."""
        points = np.asarray(self.points)
        no_width = np.zeros((points.shape[1],) * 2)
        return log_parts(points, no_width, x1, s1, x2, s2) - math.log(len(points))


@in_short
@dataclass(frozen=True)
class Displacement:
    """The density of the displacement M₂ − M₁ of the other object from the first, a function (n, d) → (n,)."""

    density: DensityFunction

    def __call__(self, points: FloatArray) -> FloatArray:
        """(n,) the density at displacements (n, d)."""
        return self.density(points)


def log_parts(
    means: FloatArray, covariances: FloatArray, x1: FloatArray, s1: FloatArray, x2: FloatArray, s2: FloatArray
) -> FloatArray:
    """(…, k) ln ∫ N(M; mean_k, covariance_k) N(x1; M, s1) N(x2; M, s2) dM.

    Two measurements of one object equal one of their weighted mean, times the density of their difference.
    """
    fused = Gaussian(x1, s1).updated(Gaussian(x2, s2))
    offset = fused.mean[..., None, :] - means
    return log_density(x1 - x2, s1 + s2)[..., None] + log_density(
        offset, fused.covariance[..., None, :, :] + covariances
    )


#: Takes pairs (r,) and standard normal points (n, k), gives the values (r, n) there.
Integrand = Callable[[IntArray, FloatArray], FloatArray]
#: Takes positions of the two objects (n, d) each, gives p(M₂ | M₁) (n,).
ConditionalFunction = Callable[[FloatArray, FloatArray], FloatArray]

#: Adaptive cubature covers ±8.5 standard deviations; a share of 2e-17 of a normal lies beyond.
REACH = 8.5
#: Greatest number of subdivisions of cubature (chosen).
SUBDIVISIONS = 40
#: Independent scrambles of the Sobol points, whose scatter is the stated error (chosen).
SCRAMBLES = 16
#: Points of each scramble: in the first step, to check cubature, and at most (chosen).
FIRST, CHECK, MOST = 2**8, 2**10, 2**13
#: Values of a density in one batch, and components times features of closed forms in one batch.
VALUES_IN_BATCH, COMPONENTS_IN_BATCH = 2**18, 2**20


@dataclass(frozen=True)
class Expected:
    """(m,) ln of the expectations, and (m,) their relative standard errors; infinite where ``log_value`` is a bound."""

    log_value: FloatArray
    error: FloatArray


def expectation(integrand: Integrand, pairs: int, k: int, relative_error: float, seed: int, density: str) -> Expected:
    """E f(z), z ~ N(0, 1)^k, for every pair, to ``relative_error`` if the number of steps suffices.

    Raises InputError: the values are negative or not finite, or zero around every pair.
    """
    f, rows = _Checked(integrand, density), np.arange(pairs)
    if k > 2:
        value, error, bound = _scrambled(f, rows, k, relative_error, seed, MOST)
    else:
        value, error, converged = _adaptive(f, pairs, k, relative_error)
        bound = k * math.erfc(REACH / math.sqrt(2.0))
        check, check_error, gap = _scrambled(f, rows, k, relative_error, seed, CHECK)
        positive = check > 0.0
        sigma = np.multiply(check, check_error, out=np.zeros(pairs), where=positive)
        tolerance = 5.0 * sigma + error * value + 10.0 * f.largest * gap
        rows = rows[positive & (~converged | (np.abs(value - check) > tolerance))]
        if len(rows):
            value[rows], error[rows], _ = _scrambled(f, rows, k, relative_error, seed, MOST)
    zero = value <= 0.0
    if np.any(zero):
        if f.largest <= 0.0:
            raise InputError(f"Universal: {density} is zero around every pair; give a density that covers the records")
        # An upper bound: the largest value at any point, times the share of the normal without points.
        value, error = np.where(zero, f.largest * bound, value), np.where(zero, np.inf, error)
    return Expected(np.log(value), error)


@dataclass
class _Checked:
    """The integrand, which must give densities; ``largest`` is its largest value so far."""

    integrand: Integrand
    density: str
    largest: float = 0.0

    def __call__(self, rows: IntArray, points: FloatArray) -> FloatArray:
        values = np.asarray(self.integrand(rows, points), np.float64)
        if not np.all((values >= 0.0) & (values < np.inf)):
            raise InputError(f"Universal: {self.density} is negative or not finite; give densities of zero or more")
        self.largest = max(self.largest, float(values.max(initial=0.0)))
        return values


def _adaptive(f: _Checked, pairs: int, k: int, relative_error: float) -> tuple[FloatArray, FloatArray, BoolArray]:
    """(m,) values, relative errors, and whether they converged: Gauss–Kronrod cubature pair by pair."""
    from scipy.integrate import cubature

    value, error, converged = np.zeros(pairs), np.zeros(pairs), np.zeros(pairs, np.bool_)
    for row in range(pairs):
        one = np.array([row])

        def weighted(z: FloatArray, one: IntArray = one) -> FloatArray:
            log_weight = -0.5 * (np.sum(z**2, axis=1) + k * math.log(2.0 * math.pi))
            return np.asarray(f(one, z)[0] * np.exp(log_weight))

        integral = cubature(
            weighted, np.full(k, -REACH), np.full(k, REACH), rule="gk15", rtol=relative_error, points=[np.zeros(k)],
            max_subdivisions=SUBDIVISIONS,
        )  # fmt: skip
        value[row], converged[row] = integral.estimate, integral.status == "converged"
        error[row] = integral.error / integral.estimate if integral.estimate > 0.0 else 0.0
    return value, error, converged


def _scrambled(
    f: _Checked, rows: IntArray, k: int, relative_error: float, seed: int, most: int
) -> tuple[FloatArray, FloatArray, float]:
    """Values and relative errors of some pairs by scrambled Sobol points, and the share of the normal per point.

    Points are doubled, up to ``most`` of each scramble, for pairs that need it; the error is the scatter of scrambles.
    """
    from scipy.special import ndtri
    from scipy.stats import qmc

    engines = [qmc.Sobol(k, scramble=True, rng=stream) for stream in np.random.default_rng(seed).spawn(SCRAMBLES)]
    total, drawn, error = np.zeros((SCRAMBLES, len(rows))), np.zeros(len(rows), np.int64), np.full(len(rows), np.inf)
    open_, n = np.arange(len(rows)), FIRST
    while len(open_) and drawn.max() < most:
        for at, engine in enumerate(engines):
            # A scramble may round to 0, where the normal quantile is infinite.
            points = ndtri(np.clip(engine.random(n), 1e-16, 1.0 - 1e-16))
            for begin in range(0, len(open_), max(1, VALUES_IN_BATCH // n)):
                some = open_[begin : begin + max(1, VALUES_IN_BATCH // n)]
                total[at, some] += f(rows[some], points).sum(axis=1)
        drawn[open_] += n
        mean = total[:, open_] / drawn[open_]
        sigma, middle = mean.std(axis=0, ddof=1) / math.sqrt(SCRAMBLES), mean.mean(axis=0)
        error[open_] = np.divide(sigma, middle, out=np.full(len(open_), np.inf), where=middle > 0.0)
        open_, n = open_[error[open_] > relative_error], int(drawn.max())
    return total.mean(axis=0) / drawn, error, 1.0 / (SCRAMBLES * int(drawn.max(initial=1)))


@in_short
@dataclass(frozen=True)
class Universal(Rule):
    """λ = ∫ p(M) N(X₁;M,Σ₁) N(X₂;M,Σ₂) dM / ∬ p(M₁) p(M₂|M₁) N(X₁;M₁,Σ₁) N(X₂;M₂,Σ₂) dM₁ dM₂, for any densities.

    ``Field`` and ``CloseObjects`` are faster special cases. Records lie in a plane of any dimension.

    Parameters
    ----------
    position : p(M): :class:`Flat`, :class:`GaussianMixture`, :class:`Samples`, or a function of positions (n, d).
    neighbour : p(M₂|M₁): a :class:`GaussianMixture` or :class:`Samples` of the displacement M₂ − M₁, a
        :class:`Displacement`, or a function of M₁ and M₂, (n, d) each. Functions give densities (n,).
        Samples cannot be combined with functions of positions; ``Samples.smoothed()`` can.
    relative_error : of integrals of functions: adaptive cubature in up to two dimensions of the integral (the number of
        features for a Displacement whose ``position`` is no function, twice that otherwise), scrambled Sobol points
        above and where cubature does not converge.
    seed : of the Sobol points; the same seed gives the same answer.

    The evidence has an error, ``Evidence.log_error``: that of the integrals and of the samples. It is infinite where a
    density is zero at every point, and the ratio is only a bound.

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
        scene = _PairsOfRecords.of(pairs, self)
        position = AS_QUOTED.log_density(pairs)
        if not len(pairs):
            return Evidence({"position": position, "place": position, "neighbour": position}, position)
        same, different = scene.same(), scene.different()
        terms = {"position": position, "place": same.log_value, "neighbour": -different.log_value}
        return Evidence(terms, np.hypot(same.error, different.error))


@dataclass(frozen=True)
class _PairsOfRecords:
    """The positions (m, d) and covariances (m, d, d) of the two records of every pair, and the rule."""

    rule: Universal
    x1: FloatArray
    s1: FloatArray
    x2: FloatArray
    s2: FloatArray

    @classmethod
    def of(cls, pairs: Pairs, rule: Universal) -> _PairsOfRecords:
        if not isinstance(pairs.first.space, Plane):
            raise InputError("Universal: records are directions; project both sources to one tangent plane first")
        for name, given in (("position", rule.position), ("neighbour", rule.neighbour)):
            if isinstance(given, GaussianMixture | Samples) and given.d != pairs.d:
                raise InputError(f"Universal: {name} has {given.d} features, the records {pairs.d}")
        x1 = pairs.first.features[pairs.i]
        s1, s2 = pairs.first.full_covariance()[pairs.i], pairs.second.full_covariance()[pairs.j]
        # Across a period, the second record is moved to the image nearest to the first.
        return cls(rule, x1, s1, x1 - pairs.residual, s2)

    def same(self) -> Expected:
        """∫ p(M) N(X₁; M, Σ₁) N(X₂; M, Σ₂) dM over N(Δ; 0, Σ): the mean of p around the fused position."""
        p = self.rule.position
        if isinstance(p, Flat | GaussianMixture | Samples):
            log_value, error = self._closed(None)
            return Expected(log_value - log_density(self.x1 - self.x2, self.s1 + self.s2), error)
        fused = Gaussian(self.x1, self.s1).updated(Gaussian(self.x2, self.s2))
        root, d = np.linalg.cholesky(fused.covariance), self.x1.shape[1]
        return self._expected(lambda rows, z: _values(p, _transformed(fused.mean, root, rows, z)), d, "position")

    def different(self) -> Expected:
        """The density of both records if they are two different objects."""
        p, q = self.rule.position, self.rule.neighbour
        if isinstance(p, Flat | GaussianMixture | Samples):
            if isinstance(q, GaussianMixture | Samples):
                return Expected(*self._closed(q))
            if isinstance(q, Displacement):
                return self._displaced(p, q)
        return self._both(p, q)

    def _closed(self, q: GaussianMixture | Samples | None) -> tuple[FloatArray, FloatArray]:
        """ln of the sum over components, and the relative error due to samples; without ``q`` for one object."""
        p = self.rule.position
        assert isinstance(p, Flat | GaussianMixture | Samples)
        means, covariances, log_weights = _components(q, self.x1.shape[1])
        count = len(means) * (1 if isinstance(p, Flat) else len(p))
        log_value, error = np.empty(len(self.x1)), np.empty(len(self.x1))
        step = max(1, COMPONENTS_IN_BATCH // (count * self.x1.shape[1] ** 2))
        for begin in range(0, len(self.x1), step):
            some = slice(begin, begin + step)
            x1, s1, s2 = self.x1[some, None], self.s1[some, None], self.s2[some, None] + covariances
            components = p.log_common(x1, s1, self.x2[some, None] - means, s2) + log_weights[:, None]
            log_value[some] = total = np.logaddexp.reduce(components, axis=(1, 2))
            share = np.exp(components - total[:, None, None])
            error[some] = np.hypot(
                _scatter(share.sum(axis=2)) if isinstance(q, Samples) else 0.0,
                _scatter(share.sum(axis=1)) if isinstance(p, Samples) else 0.0,
            )
        return log_value, error

    def _displaced(self, p: Flat | GaussianMixture | Samples, q: Displacement) -> Expected:
        """The mean over displacements m ~ N(−Δ, Σ) of q(m) times the density by p of X₁ and X₂ − m as one object."""
        delta, total = self.x1 - self.x2, self.s1 + self.s2
        root = np.linalg.cholesky(total)

        def integrand(rows: IntArray, z: FloatArray) -> FloatArray:
            m = _transformed(-delta, root, rows, z)
            density = _values(q, m)
            if isinstance(p, Flat):
                return density * p.density
            one = self.x1[rows, None], self.s1[rows, None], self.x2[rows, None] - m, self.s2[rows, None]
            common = np.logaddexp.reduce(p.log_common(*one), axis=-1) - log_density(one[0] - one[2], total[rows, None])
            return np.asarray(density * np.exp(common))

        return self._expected(integrand, delta.shape[1], "neighbour")

    def _both(self, p: DensityFunction | GaussianMixture | Flat | Samples, q: object) -> Expected:
        """The mean of p(M₁) p(M₂|M₁) over M₁ ~ N(X₁, Σ₁), M₂ ~ N(X₂, Σ₂)."""
        d = self.x1.shape[1]
        root_1, root_2 = np.linalg.cholesky(self.s1), np.linalg.cholesky(self.s2)
        assert callable(p) and callable(q)

        def integrand(rows: IntArray, z: FloatArray) -> FloatArray:
            m1, m2 = _transformed(self.x1, root_1, rows, z[:, :d]), _transformed(self.x2, root_2, rows, z[:, d:])
            if isinstance(q, GaussianMixture | Displacement):
                return _values(p, m1) * _values(q, m2 - m1)
            flat = np.asarray(q(m1.reshape(-1, d), m2.reshape(-1, d)), np.float64)
            return _values(p, m1) * _shaped(flat, m1)

        return self._expected(integrand, 2 * d, "position or neighbour")

    def _expected(self, integrand: Callable[..., FloatArray], k: int, name: str) -> Expected:
        rule = self.rule
        return expectation(integrand, len(self.x1), k, rule.relative_error, rule.seed, f"the density of {name}")


def _components(q: GaussianMixture | Samples | None, d: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means (l, d), covariances (l, d, d) and ln weights (l,) of displacements; a single zero for one object."""
    if isinstance(q, GaussianMixture):
        return np.asarray(q.means), np.asarray(q.covariances), np.log(q.weights)
    means = np.zeros((1, d)) if q is None else np.asarray(q.points)
    return means, np.zeros((len(means), d, d)), np.full(len(means), -math.log(len(means)))


def _scatter(share: FloatArray) -> FloatArray:
    """(m,) relative standard error of a mean over samples, of their shares (m, n) in it."""
    n = share.shape[1]
    return np.asarray(np.sqrt(np.sum((n * share - 1.0) ** 2, axis=1) / (n * (n - 1))))


def _transformed(mean: FloatArray, root: NDArray[np.floating], rows: IntArray, z: FloatArray) -> FloatArray:
    """(r, n, d) the standard normal points z (n, d) transformed to the means and covariances of some pairs."""
    return np.asarray(mean[rows, None] + np.einsum("rvw,nw->rnv", root[rows], z))


def _values(density: DensityFunction | Samples, points: FloatArray) -> FloatArray:
    """(r, n) values of a density at points (r, n, d)."""
    assert callable(density)
    return _shaped(np.asarray(density(points.reshape(-1, points.shape[-1])), np.float64), points)


def _shaped(flat: FloatArray, points: FloatArray) -> FloatArray:
    n = points.shape[0] * points.shape[1]
    if flat.shape != (n,):
        raise InputError(f"Universal: a density gave shape {flat.shape} for {n} positions; give one number for each")
    return flat.reshape(points.shape[:2])
