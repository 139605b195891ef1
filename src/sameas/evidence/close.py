"""The close-objects rule: a different object is near, but not nearer than two objects can be (METHOD 3.2).

:class:`CloseObjects` uses the exact convolution of the normal and the boxes. The paper's approximation,
:func:`log_generalized_density`, serves to reproduce the paper and to show its error; the exact form costs no more.

The outer box b follows from the formation of the targets if that is known. Otherwise :func:`estimate_reach` estimates
both boxes from the distances of nearest neighbours in each source, corrected for the source's errors. A b much too
small is harmful, because residuals between the boxes and the true neighbours look impossible for two objects; one that
is too large costs little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence.rule import AS_QUOTED, Evidence, Rule
from sameas.gate import Pairs
from sameas.gaussian import LOG_2PI
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Sphere, folded, sphere_offset, unit_vectors, wrapped

# Boxes convolved with a normal: the density of a neighbour's residual, in logarithms (METHOD 3.2).
#
# - Independent features: :func:`log_neighbour_density` and its limit :func:`log_surface_density`. Everything is a sum
#   of positive terms, and every difference of Φ is taken in the negative tail, so that nothing cancels for σ ≪ a and
#   nothing underflows for |Δ| ≫ b.
# - Two correlated features: :func:`log_correlated_density` and :func:`log_correlated_surface`. Where the shell between
#   the boxes holds a large enough share of the normal, it is the difference of two rectangles by the angle integral of
#   Drezner and Wesolowsky (J. Statist. Comput. Simul. 35, 1990; nodes as Genz, Statistics and Computing 14, 2004). In
#   the tails, and for correlations near ±1, the shell is four disjoint rectangles, each an integral ∫ φ(t) [Φ(u₁(t)) −
#   Φ(u₀(t))] dt of positive, log-concave values: Gauss–Legendre over the interval around the peak that holds all but
#   e⁻³⁶ of it.


def log_neighbour_density(delta: FloatArray, sigma: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) ln of the braces of METHOD 3.2: density of Δ (m, d) for a neighbour between the boxes a and b (d,)."""
    x = np.abs(delta)
    log_pa = log_interval((x - a) / sigma, (x + a) / sigma, 2.0 * a / sigma)
    log_pb = log_interval((x - b) / sigma, (x + b) / sigma, 2.0 * b / sigma)
    far = log_interval((x + a) / sigma, (x + b) / sigma, (b - a) / sigma)
    near = log_interval((x - b) / sigma, (x - a) / sigma, (b - a) / sigma)
    log_e = np.logaddexp(far, near)
    before = np.cumsum(np.pad(log_pa, ((0, 0), (1, 0)))[:, :-1], axis=1)
    after = np.cumsum(np.pad(log_pb, ((0, 0), (0, 1)))[:, :0:-1], axis=1)[:, ::-1]
    return np.asarray(np.logaddexp.reduce(before + log_e + after, axis=1) - math.log(shell_volume(a, b)))


def log_surface_density(delta: FloatArray, sigma: FloatArray, a: FloatArray) -> FloatArray:
    """(m,) the limit b = (1 + ε) a → a of :func:`log_neighbour_density`."""
    x = np.abs(delta)
    log_pa = log_interval((x - a) / sigma, (x + a) / sigma, 2.0 * a / sigma)
    near = -0.5 * ((x - a) / sigma) ** 2
    far = -0.5 * ((x + a) / sigma) ** 2
    log_e = np.logaddexp(near, far) - 0.5 * LOG_2PI - np.log(sigma) + np.log(a)
    total = np.sum(log_pa, axis=1, keepdims=True) - log_pa + log_e
    return np.asarray(np.logaddexp.reduce(total, axis=1) - math.log(len(a) * np.prod(2.0 * a)))


def shell_volume(a: FloatArray, b: FloatArray) -> float:
    """V_b − V_a of the boxes |m_v| < a_v and |m_v| ≤ b_v, (d,) each, as a sum of positive terms."""
    terms = (np.prod(2.0 * a[:v]) * 2.0 * (b[v] - a[v]) * np.prod(2.0 * b[v + 1 :]) for v in range(len(a)))
    return float(sum(terms))


def log_interval(low: FloatArray, high: FloatArray, width: FloatArray) -> FloatArray:
    """ln[Φ(high) − Φ(low)], with both flipped to the negative tail if low is positive.

    ``width`` is high − low before rounding; if it is small, the difference is the density in the middle times the
    width, to second order.
    """
    from scipy.special import log_ndtr

    flip = low > 0
    low, high = np.where(flip, -high, low), np.where(flip, -low, high)
    middle = 0.5 * (low + high)
    top = log_ndtr(high)
    with np.errstate(divide="ignore"):
        wide = top + np.log(-np.expm1(np.minimum(log_ndtr(low) - top, 0.0)))
        narrow = np.log(width) - 0.5 * (middle**2 + LOG_2PI) + (middle**2 - 1.0) * width**2 / 24.0
    return np.where(width * (1.0 + np.abs(middle)) < 1e-3, narrow, wide)


# ---- two correlated features ----

#: Up to this correlation the angle integral is smooth enough for its 20 nodes (Genz 2004).
SMOOTH_CORRELATION = 0.925
#: Smaller shares of the shell are not computed as a difference of two boxes, each exact to about 1e-15.
MIN_DIFFERENCE = 1e-5
#: The interval of integration ends where the value has fallen to e⁻³⁶ of its peak, below the rounding of a double.
DROP = 36.0
#: Borders of panels around an edge of Φ, in widths of the edge.
EDGE = np.array([-9.0, -4.5, 0.0, 4.5, 9.0])
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
ANGLES, ANGLE_WEIGHTS = np.polynomial.legendre.leggauss(20)
#: Pairs in one batch, which limits the memory for the tails.
BATCH = 2048


def log_correlated_density(delta: FloatArray, covariance: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) ln of the braces of METHOD 3.2 with all of Σ: Δ (m, 2), Σ (m, 2, 2), boxes a and b (2,)."""
    sigma, rho = _standardised(covariance)
    share = np.zeros(len(delta))
    smooth = np.flatnonzero(np.abs(rho) <= SMOOTH_CORRELATION)
    if len(smooth):
        outer, inner = (_box(delta[smooth], sigma[smooth], rho[smooth], c) for c in (b, a))
        share[smooth] = outer - inner
    far = np.flatnonzero(share < MIN_DIFFERENCE)
    log_share = np.log(np.maximum(share, MIN_DIFFERENCE))
    for begin in range(0, len(far), BATCH):
        some = far[begin : begin + BATCH]
        log_share[some] = _log_shell(delta[some], sigma[some], rho[some], a, b)
    return log_share - math.log(shell_volume(a, b))


def log_correlated_surface(delta: FloatArray, covariance: FloatArray, a: FloatArray) -> FloatArray:
    """(m,) the limit b = (1 + ε) a → a of :func:`log_correlated_density`: the four edges of the inner box."""
    sigma, rho = _standardised(covariance)
    narrow = np.sqrt(1.0 - rho**2)
    edges = []
    for across, along in ((0, 1), (1, 0)):
        spread = sigma[:, along] * narrow
        for side in (-a[across], a[across]):
            z = (side - delta[:, across]) / sigma[:, across]
            centre = delta[:, along] + rho * sigma[:, along] * z
            low, high = (-a[along] - centre) / spread, (a[along] - centre) / spread
            length = log_interval(low, high, 2.0 * a[along] / spread)
            edges.append(length - 0.5 * (LOG_2PI + z**2) - np.log(sigma[:, across]) + math.log(a[across]))
    return np.asarray(np.logaddexp.reduce(edges) - math.log(2.0 * np.prod(2.0 * a)))


def _standardised(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(m, 2) standard deviations and (m,) correlations."""
    sigma = np.sqrt(np.einsum("mvv->mv", covariance))
    return sigma, covariance[:, 0, 1] / (sigma[:, 0] * sigma[:, 1])


def _box(delta: FloatArray, sigma: FloatArray, rho: FloatArray, c: FloatArray) -> FloatArray:
    """(m,) probability of |m_v| ≤ c_v for m ~ N(Δ, Σ), to about 1e-15 of 1."""
    from scipy.special import ndtr

    low, high = (-c - delta) / sigma, (c - delta) / sigma
    share: FloatArray = np.prod(ndtr(high) - ndtr(low), axis=1)
    half = 0.5 * np.arcsin(rho)
    for angle, weight in zip(ANGLES, ANGLE_WEIGHTS, strict=True):
        sine = np.sin(half * (1.0 + angle))
        twice = 2.0 * (1.0 - sine**2)
        corners = np.zeros(len(rho))
        for x, y, sign in ((high, high, 1), (low, low, 1), (low, high, -1), (high, low, -1)):
            h, k = x[:, 0], y[:, 1]
            corners += sign * np.exp(-(h * h + k * k - 2.0 * h * k * sine) / twice)
        share += half * weight / (2.0 * math.pi) * corners
    return share


def _log_shell(delta: FloatArray, sigma: FloatArray, rho: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) ln of the probability of the box b without the box a: the rectangles left, right, below and above."""
    upright, lying = np.array([b[0] - a[0], 2.0 * b[1]]), np.array([2.0 * a[0], b[1] - a[1]])
    left, right, below, above = (-b[0], -b[1]), (a[0], -b[1]), (-a[0], -b[1]), (-a[0], a[1])
    parts = []
    for corner, extent in ((left, upright), (right, upright), (below, lying), (above, lying)):
        if np.all(extent > 0.0):
            low, width = (corner - delta) / sigma, extent / sigma
            parts.append(log_rectangle(low[:, 0], width[:, 0], low[:, 1], width[:, 1], rho))
    return np.asarray(np.logaddexp.reduce(parts))


def log_rectangle(
    x_low: FloatArray, x_width: FloatArray, y_low: FloatArray, y_width: FloatArray, rho: FloatArray
) -> FloatArray:
    """(m,) ln of the probability of rectangles of positive widths under standard normals of correlation ρ.

    Corners and widths are separate arguments, so that a box much smaller than σ keeps its width. All (m,).
    """
    cut = _Cut(x_low, y_low, y_width, rho)
    peak = cut.peak(x_width)
    top = cut.log_value(peak)
    left, right = cut.stretch(peak, top, -1.0, peak), cut.stretch(peak, top, 1.0, x_width - peak)
    # Panels: two on each side of the peak, and around the edges of Φ where they are sharp.
    edge_width = np.sqrt(1.0 - rho**2) / np.maximum(np.abs(rho), 1e-3)
    slope = np.where(rho < 0.0, -1.0, 1.0) * np.maximum(np.abs(rho), 1e-3)
    edges = [(y / slope - x_low)[:, None] + EDGE * edge_width[:, None] for y in (y_low, y_low + y_width)]
    own = np.stack([peak - left, peak - left / 2.0, peak, peak + right / 2.0, peak + right], axis=1)
    borders = np.clip(np.concatenate([own, *edges], axis=1), own[:, :1], own[:, -1:])
    borders.sort(axis=1)
    row, panel = np.nonzero(np.diff(borders, axis=1) > 0.0)
    low, half = borders[row, panel], 0.5 * (borders[row, panel + 1] - borders[row, panel])
    points = (low + half)[:, None] + half[:, None] * NODES
    value = np.exp(cut.of(row[:, None]).log_value(points) - top[row, None]) @ WEIGHTS * half
    return top + np.log(np.bincount(row, value, len(rho)))


@dataclass(frozen=True)
class _Cut:
    """ln of φ(t) [Φ(u₁(t)) − Φ(u₀(t))], t = x_low + τ, u = (y − ρt) / √(1 − ρ²), at least as concave as −τ²/2."""

    x_low: FloatArray
    y_low: FloatArray
    y_width: FloatArray
    rho: FloatArray

    def of(self, row: IntArray) -> _Cut:
        return _Cut(self.x_low[row], self.y_low[row], self.y_width[row], self.rho[row])

    def _sides(self, tau: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        t, narrow = self.x_low + tau, np.sqrt(1.0 - self.rho**2)
        low, width = (self.y_low - self.rho * t) / narrow, self.y_width / narrow
        return t, low, low + width, width

    def log_value(self, tau: FloatArray) -> FloatArray:
        t, low, high, width = self._sides(tau)
        return log_interval(low, high, width) - 0.5 * (LOG_2PI + t**2)

    def slope(self, tau: FloatArray) -> FloatArray:
        t, low, high, width = self._sides(tau)
        middle, inside = 0.5 * (low + high), log_interval(low, high, width) + 0.5 * LOG_2PI
        with np.errstate(over="ignore", invalid="ignore"):
            across = np.exp(-0.5 * high**2 - inside) - np.exp(-0.5 * low**2 - inside)
        across = np.where(width * (1.0 + np.abs(middle)) < 1e-3, -middle, across)
        return np.asarray(-t - self.rho / np.sqrt(1.0 - self.rho**2) * across)

    def peak(self, room: FloatArray) -> FloatArray:
        """(m,) τ in 0 … room where the slope is below ½: from there the value rises by at most e^(1/8)."""
        low, high = np.zeros(len(room)), room.copy()
        at_low, at_high = self.slope(low), self.slope(high)
        peak = np.where(at_low <= 0.0, low, high)
        open_ = np.flatnonzero((at_low > 0.0) & (at_high < 0.0))
        low, high, at_low, at_high = low[open_], high[open_], at_low[open_], at_high[open_]
        # Regula falsi with the value at the retained end halved (Illinois); the slope is monotone.
        for _ in range(60):
            if not len(open_):
                break
            middle = np.clip(low + (high - low) * at_low / (at_low - at_high), low, high)
            value = self.of(open_).slope(middle)
            peak[open_] = middle
            rises = value > 0.0
            at_high, at_low = np.where(rises, at_high / 2.0, value), np.where(rises, value, at_low / 2.0)
            low, high = np.where(rises, middle, low), np.where(rises, high, middle)
            going = (np.abs(value) > 0.5) & (high > low)
            open_ = open_[going]
            low, high, at_low, at_high = (x[going] for x in (low, high, at_low, at_high))
        return peak

    def stretch(self, peak: FloatArray, top: FloatArray, side: float, room: FloatArray) -> FloatArray:
        """(m,) distance from the peak on one side at which the value has fallen by e^DROP, or the available room.

        At least as concave as −τ²/2, the value lies below its tangent parabola. Newton steps start beyond the solution
        and never pass it.
        """
        slope = np.minimum(side * self.slope(peak), 0.5)
        reach = np.minimum(2.0 * DROP / (np.sqrt(slope**2 + 2.0 * DROP) - slope), room)
        for _ in range(5):
            beyond = self.log_value(peak + side * reach) - top + DROP
            step = np.where(beyond < 0.0, beyond / np.minimum(side * self.slope(peak + side * reach), -1e-300), 0.0)
            reach = np.maximum(reach - step, 0.0)
        return reach


EXACT, DIAGONAL = "exact", "diagonal"
GENERALIZED_GAUSSIAN = "generalized Gaussian"

#: ln of the limits of the generalized Gaussian's shape: normal, and practically uniform.
NORMAL, UNIFORM = math.log(2.0), math.log(1e7)
#: Bisection steps from the whole range of shapes to the rounding of a double.
HALVINGS = 60


def log_generalized_density(delta: FloatArray, sigma: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) ln of the paper's braces of METHOD 3.2, −∞ where they are not positive.

    A generalized Gaussian replaces the convolution of a normal and a box, with the same variance σ² + c²/3 and the same
    value at 0 [T21–T25]. It is good to a few per cent near the centre; beyond the outer box it falls too fast, and the
    difference of two may be negative there. Δ and σ (m, d), boxes a and b (d,); the exact form is
    :func:`sameas.evidence.log_neighbour_density`.
    """
    outer = _log_box(delta, sigma, b)
    inner = np.full(len(delta), -np.inf) if np.any(a == 0.0) else _log_box(delta, sigma, a)
    positive = outer > inner
    braces = np.full(len(delta), -np.inf)
    braces[positive] = outer[positive] + np.log(-np.expm1(inner[positive] - outer[positive]))
    return np.asarray(braces - math.log(shell_volume(a, b)))


def _log_box(delta: FloatArray, sigma: FloatArray, c: FloatArray) -> FloatArray:
    """(m,) ln of V_c ∏ ψ(Δ_v; σ_v, c_v)."""
    return np.asarray(
        np.sum(log_generalized_gaussian(delta, sigma, np.broadcast_to(c, delta.shape)) + np.log(2.0 * c), axis=1)
    )


def log_generalized_gaussian(x: FloatArray, sigma: FloatArray, c: FloatArray) -> FloatArray:
    """ln of the generalized Gaussian of variance σ² + c²/3 and the value of ψ(·; σ, c) at 0; elementwise."""
    from scipy.special import gammaln

    ratio, back = np.unique(np.ravel(c / sigma), return_inverse=True)
    at_zero = log_interval(-ratio, ratio, 2.0 * ratio) - np.log(2.0 * ratio)
    log_deviation = 0.5 * np.log1p(ratio**2 / 3.0)
    log_shape = _log_shape(at_zero + log_deviation)
    width = np.exp(log_deviation + 0.5 * (gammaln(np.exp(-log_shape)) - gammaln(3.0 * np.exp(-log_shape))))
    at_zero, shape, width = (np.reshape(values[back], np.shape(x)) for values in (at_zero, np.exp(log_shape), width))
    with np.errstate(over="ignore", divide="ignore"):
        return np.asarray(at_zero - np.log(sigma) - np.exp(shape * np.log(np.abs(x) / (sigma * width))))


def _log_shape(log_peak: FloatArray) -> FloatArray:
    """(n,) ln of the shape of the generalized Gaussian of variance 1 with these ln values at 0, by bisection.

    The value at 0 decreases with the shape, from that of the normal to that of the uniform distribution.
    """
    low, high = np.full(len(log_peak), NORMAL), np.full(len(log_peak), UNIFORM)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        above = _log_peak(middle) > log_peak
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.asarray(0.5 * (low + high))


def _log_peak(log_shape: FloatArray) -> FloatArray:
    from scipy.special import gammaln

    inverse = np.exp(-log_shape)
    return np.asarray(log_shape - math.log(2.0) - 1.5 * gammaln(inverse) + 0.5 * gammaln(3.0 * inverse))


@in_short
@dataclass(frozen=True)
class CloseObjects(Rule):
    """A different object is uniform in the box |m_v| ≤ b_v around the first without its inner box |m_v| < a_v.

    λ = N(Δ; 0, Σ) / [density of Δ for two such objects] (METHOD 3.2 [T14–T19, T26]), with the exact convolution of
    the normal and the box, evaluated in logarithms: a sum of positive terms that neither cancels for σ ≪ a nor
    underflows for |Δ| ≫ b. A b much smaller than the distance of neighbours is harmful, one too large hardly:
    see :func:`sameas.evidence.close.estimate_reach`.

    Parameters
    ----------
    a : least distance of two objects, per feature or one number for all; 0 if they may coincide.
    b : greatest distance of the neighbour per feature, b ≥ a. None is the limit b → a, taken with b = (1 + ε) a: the
        neighbour lies on the surface of the inner box.
    correlation : "exact" (default) uses all of Σ for the boxes in two features; "diagonal" drops the correlation there,
        as the paper does. In one, three or more features the boxes always use the diagonal of Σ. N always uses all
        of Σ.
    approximation : None, or "generalized Gaussian" for the paper's approximation [T21–T25], which drops the
        correlation. Far outside the outer box its braces are negative; those pairs get the exact value.

    Example
    -------
    >>> from sameas import CloseObjects, Radius, Records
    >>> pairs = Radius(9.0)(Records.of([[0.0, 0.0]], sigma=1.0), Records.of([[0.3, 1.0], [5.0, 5.0]], sigma=0.5))
    >>> CloseObjects(a=1.2, b=6.0)(pairs).log_ratio.round(2)
    array([  2.91, -16.72])
    """

    a: float | tuple[float, ...]
    b: float | tuple[float, ...] | None = None
    correlation: str = EXACT
    approximation: str | None = None

    def __post_init__(self) -> None:
        if self.correlation not in (EXACT, DIAGONAL):
            raise InputError(f'CloseObjects: correlation is {self.correlation!r}; give "{EXACT}" or "{DIAGONAL}"')
        if self.approximation not in (None, GENERALIZED_GAUSSIAN):
            raise InputError(
                f'CloseObjects: approximation is {self.approximation!r}; give "{GENERALIZED_GAUSSIAN}" or None'
            )
        a = np.atleast_1d(np.asarray(self.a, dtype=np.float64))
        if not np.all((a >= 0) & (a < np.inf)):
            raise InputError(f"CloseObjects: a is {self.a}; give distances of zero or more in the unit of the features")
        if self.b is None:
            if not np.all(a > 0):
                raise InputError("CloseObjects: a is 0 and b is not given; give b, the reach of a neighbour")
            if self.approximation is not None:
                raise InputError(
                    f"CloseObjects: the {self.approximation} has no limit b → a; give b, or no approximation"
                )
            return
        b = np.atleast_1d(np.asarray(self.b, dtype=np.float64))
        if a.size > 1 and b.size > 1 and a.size != b.size:
            raise InputError(f"CloseObjects: a has {a.size} features, b {b.size}; give one number or one per feature")
        if not (np.all(b >= a) and np.any(b > a) and np.all((b > 0) & (b < np.inf))):
            raise InputError(
                f"CloseObjects: b is {self.b} with a {self.a}; "
                "give b ≥ a and above zero in every feature, larger in one, or no b"
            )

    def __call__(self, pairs: Pairs) -> Evidence:
        a = _per_feature(self.a, pairs.d, "a")
        b = None if self.b is None else _per_feature(self.b, pairs.d, "b")
        density = _diagonal_density(pairs, a, b)
        if self.approximation is not None and b is not None:
            density = _approximate_density(pairs, a, b, density)
        elif self.correlation == EXACT and pairs.d == 2:
            _correlate(density, pairs, a, b)
        return Evidence({"position": AS_QUOTED.log_density(pairs), "neighbour": -density})


def _diagonal_density(pairs: Pairs, a: FloatArray, b: FloatArray | None) -> FloatArray:
    """(m,) ln of the density of Δ for two neighbours, with the diagonal of Σ for the boxes."""
    sigma = np.sqrt(np.einsum("mvv->mv", pairs.covariance))
    if b is None:
        return log_surface_density(pairs.residual, sigma, a)
    return log_neighbour_density(pairs.residual, sigma, a, b)


def _correlate(density: FloatArray, pairs: Pairs, a: FloatArray, b: FloatArray | None) -> None:
    """Replace the diagonal ``density`` by the exact one where two features are correlated."""
    rows = np.flatnonzero(pairs.covariance[:, 0, 1])
    if not len(rows):
        return
    delta, covariance = pairs.residual[rows], pairs.covariance[rows]
    if b is None:
        density[rows] = log_correlated_surface(delta, covariance, a)
    else:
        density[rows] = log_correlated_density(delta, covariance, a, b)


def _approximate_density(pairs: Pairs, a: FloatArray, b: FloatArray, exact: FloatArray) -> FloatArray:
    """(m,) the paper's approximation, and ``exact`` where its braces are not positive."""
    sigma = np.sqrt(np.einsum("mvv->mv", pairs.covariance))
    approximate = log_generalized_density(pairs.residual, sigma, a, b)
    return np.where(np.isfinite(approximate), approximate, exact)


def _per_feature(value: float | tuple[float, ...], d: int, name: str) -> FloatArray:
    values = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if values.size not in (1, d):
        raise InputError(
            f"CloseObjects: {name} has {values.size} numbers for {d} features; give one, or one per feature"
        )
    return np.broadcast_to(values, d).copy()


#: The inner box in standard deviations of a residual's feature, as in the papers [T].
INNER_SIGMAS = 1.1
#: The least outer box, in the same unit: with few neighbours their distance may be underestimated; 4 σ is always safe.
MIN_SIGMAS = 4.0
#: A given box is doubted if neighbours lie outside by more than this number of standard errors (chosen).
DOUBT_SIGMAS = 2.0


@in_short
@dataclass(frozen=True)
class Spacing:
    """The distance of neighbours in the sources, per feature, in the unit of the residuals.

    a : (d,) inner box: 1.1 σ of a typical residual [T], below which two objects look like one.
    b : (d,) outer box: twice the distance of a typical neighbour, and at least 4 σ.
    neighbour : (d,) distance of a typical neighbour, which may lie along any feature: √(d · mean square), 0 where the
        errors explain all of it.
    error : (d,) standard error of ``neighbour``; infinite where that is 0.
    sigma : (d,) standard deviation of a typical residual.
    neighbours : number of pairs of nearest neighbours used, both sources together.
    """

    a: FloatArray
    b: FloatArray
    neighbour: FloatArray
    error: FloatArray
    sigma: FloatArray
    neighbours: int

    def doubt(self, b: ArrayLike) -> str:
        """A sentence if the data contradict a given ``b`` (a number or (d,)) with neighbours outside; else ''."""
        given = np.broadcast_to(np.asarray(b, np.float64), self.b.shape)
        finite = np.isfinite(self.error)
        least = np.where(finite, self.neighbour - DOUBT_SIGMAS * np.where(finite, self.error, 0.0), 0.0)
        # Neighbours nearer than the errors cannot be shown to lie outside a box.
        feature = int(np.argmax(least / np.maximum(given, self.sigma)))
        if least[feature] <= max(given[feature], self.sigma[feature]):
            return ""
        return (
            f"b is {given[feature]:.3g} in feature {feature}, but the sources' own neighbours lie "
            f"{self.neighbour[feature]:.3g} ± {self.error[feature]:.2g} apart there: true pairs and chance "
            f"pairs are confused; give b of {self.b[feature]:.3g} or more"
        )


def estimate_reach(first: Records, second: Records) -> Spacing:
    """The boxes of ``CloseObjects`` from the records of the sources themselves.

    The displacement u of a record to the nearest other record of its own source contains the errors of both records;
    the mean square of u minus their variance is that of neighbours. If every neighbour differs in one feature only, as
    in the papers' scenes, each feature has a share of 1/d of it on a lattice: hence the factor d. Choosing the nearest
    of several makes displacements small, by up to a third on a lattice of spacing 4 σ; objects that a source missed
    make them large. Decisions with this b come within 0.02 of those with the true one.

    Raises
    ------
    InputError : neither source has two records.

    Example
    -------
    >>> from sameas import CloseObjects, Records
    >>> radar = Records.of([[0.0, 0.0], [5.0, 0.3], [10.1, -0.2]], sigma=0.5)
    >>> ais = Records.of([[0.2, 0.0], [9.8, 0.3]], sigma=0.3)
    >>> spacing = estimate_reach(radar, ais)
    >>> rule = CloseObjects(tuple(spacing.a), tuple(spacing.b))
    """
    sources = [source for source in (first, second) if len(source) >= 2]
    if not sources:
        raise InputError(
            f"{first.source} has {len(first)} records, {second.source} {len(second)}: no neighbours to measure; "
            "give b, the reach of a neighbour"
        )
    measured = [_excess(source) for source in sources]
    excess = np.concatenate([values for values, _ in measured])
    count = sum(pairs for _, pairs in measured)
    d = first.d
    mean_square = excess.mean(axis=0)
    # Two records that are mutually nearest are one pair.
    spread = excess.std(axis=0) / math.sqrt(max(count, 1))
    neighbour = np.sqrt(d * np.maximum(mean_square, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(neighbour > 0.0, 0.5 * d * spread / neighbour, np.inf)
    sigma = np.sqrt(sum(_typical_variance(source) for source in (first, second)))
    a = INNER_SIGMAS * sigma
    b = np.maximum(2.0 * neighbour, MIN_SIGMAS * sigma)
    return Spacing(a, b, neighbour, error, sigma, count)


def _excess(source: Records) -> tuple[FloatArray, int]:
    """(n, d) squared displacements to the nearest other record minus the variance of their errors; number of pairs."""
    other = _nearest(source)
    variance = source.variances
    excess = _displacement(source, other) ** 2 - variance - variance[other]
    own = np.arange(len(source))
    mutual = int(np.count_nonzero(other[other] == own))
    return excess, len(source) - mutual // 2


def _typical_variance(source: Records) -> FloatArray:
    """(d,) typical variance of every feature; 0 for a source without records."""
    return np.broadcast_to(np.median(source.variances, axis=0) if len(source) else 0.0, (source.d,))


def _nearest(source: Records) -> IntArray:
    """(n,) the nearest other record of the same source, with every feature in units of its typical error."""
    from scipy.spatial import cKDTree

    if isinstance(source.space, Sphere):
        points = unit_vectors(*source.features.T)
        tree = cKDTree(points)
    else:
        scale = np.sqrt(_typical_variance(source))
        periods = np.array(source.space.period_list(source.d)) / scale
        points = source.features / scale
        for v in np.flatnonzero(np.isfinite(periods)):
            points[:, v] = folded(points[:, v], periods[v])
        tree = cKDTree(points, boxsize=np.where(np.isfinite(periods), periods, 0.0))
    place = np.arange(len(source))
    nearest = tree.query(points, k=2)[1]
    # Records at one position may be listed in any order.
    return np.asarray(np.where(nearest[:, 0] == place, nearest[:, 1], nearest[:, 0]), np.int64)


def _displacement(source: Records, other: IntArray) -> FloatArray:
    """(n, d) from every record to ``other`` of the same source, in the unit of the residuals."""
    if isinstance(source.space, Sphere):
        return sphere_offset(*source.features[other].T, *source.features.T)
    return wrapped(source.features[other] - source.features, source.space.period_list(source.d))
