"""Boxes under a normal: the density of a neighbour's residual, in logarithms (METHOD 3.2).

- Independent features: :func:`log_neighbour_density` and its limit :func:`log_surface_density`. Everything is a sum of
  positive terms, and every difference of Φ is taken in the negative tail: nothing cancels for σ ≪ a, nothing underflows
  for |Δ| ≫ b.
- Two correlated features: :func:`log_correlated_density` and :func:`log_correlated_surface`. Where the shell between
  the boxes holds a large enough share of the normal, it is the difference of two rectangles by the angle integral of
  Drezner and Wesolowsky (J. Statist. Comput. Simul. 35, 1990; nodes as Genz, Statistics and Computing 14, 2004). In the
  tails, and for correlations near ±1, the shell is four disjoint rectangles, each an integral
  ∫ φ(t) [Φ(u₁(t)) − Φ(u₀(t))] dt of positive, log-concave values: Gauss–Legendre over the stretch around the peak that
  holds all but e⁻³⁶ of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import LOG_2PI
from sameas.representation import in_short


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
    """ln[Φ(high) − Φ(low)], both flipped to the negative tail where low is positive.

    ``width`` is high − low before rounding: where it is small, the difference is the density in the middle times the
    width, to the second order.
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
#: The least share of the shell that is computed as a difference of two boxes, each good to about 1e-15.
LEAST_DIFFERENCE = 1e-5
#: The stretch ends where the value has fallen to e⁻³⁶ of its peak, below the rounding of a double.
DROP = 36.0
#: Borders of panels about an edge of Φ, in widths of the edge.
EDGE = np.array([-9.0, -4.5, 0.0, 4.5, 9.0])
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
ANGLES, ANGLE_WEIGHTS = np.polynomial.legendre.leggauss(20)
#: Pairs in one batch, which bounds the memory of the tails.
BATCH = 2048


def log_correlated_density(delta: FloatArray, covariance: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) ln of the braces of METHOD 3.2 with the whole of Σ: Δ (m, 2), Σ (m, 2, 2), boxes a and b (2,)."""
    sigma, rho = _standardised(covariance)
    share = np.zeros(len(delta))
    smooth = np.flatnonzero(np.abs(rho) <= SMOOTH_CORRELATION)
    if len(smooth):
        outer, inner = (_box(delta[smooth], sigma[smooth], rho[smooth], c) for c in (b, a))
        share[smooth] = outer - inner
    far = np.flatnonzero(share < LEAST_DIFFERENCE)
    log_share = np.log(np.maximum(share, LEAST_DIFFERENCE))
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

    Corners and widths come apart, so that a box much smaller than σ keeps its width. All (m,).
    """
    cut = _Cut(x_low, y_low, y_width, rho)
    peak = cut.peak(x_width)
    top = cut.log_value(peak)
    left, right = cut.stretch(peak, top, -1.0, peak), cut.stretch(peak, top, 1.0, x_width - peak)
    # Panels: both sides of the peak in two, and the edges of Φ where they are sharp.
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


@in_short
@dataclass(frozen=True)
class _Cut:
    """ln of φ(t) [Φ(u₁(t)) − Φ(u₀(t))], t = x_low + τ, u = (y − ρt) / √(1 − ρ²): concave, at least as −τ²/2."""

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
        """(m,) τ in 0 … room from which the value rises by no more than e^(1/8): the slope is below ½ there."""
        low, high = np.zeros(len(room)), room.copy()
        at_low, at_high = self.slope(low), self.slope(high)
        peak = np.where(at_low <= 0.0, low, high)
        open_ = np.flatnonzero((at_low > 0.0) & (at_high < 0.0))
        low, high, at_low, at_high = low[open_], high[open_], at_low[open_], at_high[open_]
        # Regula falsi, the end that stays at half its value (Illinois); the slope is monotone.
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
        """(m,) how far from the peak on one side the value has fallen by e^DROP, or the room that there is.

        Concave as −τ²/2 at least, it falls below its tangent's parabola; Newton's steps come back from there and
        never pass the true place.
        """
        slope = np.minimum(side * self.slope(peak), 0.5)
        reach = np.minimum(2.0 * DROP / (np.sqrt(slope**2 + 2.0 * DROP) - slope), room)
        for _ in range(5):
            beyond = self.log_value(peak + side * reach) - top + DROP
            back = np.where(beyond < 0.0, beyond / np.minimum(side * self.slope(peak + side * reach), -1e-300), 0.0)
            reach = np.maximum(reach - back, 0.0)
        return reach
