"""The odds that a frame points where a placement has it, against all chance.

Stars predicted on the frame are identified with its measurements, one to one, and the whole identification is weighed
against "every measurement lies anywhere". With n measurements and m predicted stars, of which k are paired, A the
area of the frame and N the density of a pair's residual,

    ln odds = Σ ln(A N) − ln[C(m,k) C(n,k) k!] − ln(min(n,m)+1) + ½ ln|2π C_θ| − ln V_θ.

The second term counts the ways of pairing k of both [T1], the third is the flat prior of k (what METHOD 4.1 is for
targets), and the last two are the price of the pointing: the volume that the data leave to shift, turn, scale and shear
over the volume that was searched. So odds of 1000:1 mean the same for seven stars of a small field and for
a search of the whole sky. How deep the two lists are compared is chosen, and the number of choices lowers the odds too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.assignment import assign
from sameas.evidence import PoissonField
from sameas.gate import Radius
from sameas.gaussian import LOG_2PI, inverse, log_density, log_determinant
from sameas.groups import groups
from sameas.prior import PerPair
from sameas.records import Records
from sameas.sky.frame.tangent import Pointing, design


@dataclass(frozen=True)
class OddsTuning:
    """Numbers of the odds of a pointing, all chosen.

    Attributes
    ----------
    shear : 1σ by which the axes of a frame differ in scale, or from a right angle: refraction, tilt, pixels that are
        not square.
    deepest : at most this many of the brightest measurements and stars are compared.
    iterations : most iterations of identification and fit.
    depths : depths of each list at which the odds are taken.
    hopeless : a pointing is given up when its log-odds are below this and did not rise in the last iteration.
    """

    shear: float = 0.01
    deepest: int = 2000
    iterations: int = 7
    depths: int = 7
    hopeless: float = -15.0


TUNING = OddsTuning()


@dataclass(frozen=True)
class SearchVolume:
    """The volume that was searched: ``area_sr`` of the sky for the frame's middle, ``rotation_rad`` of orientation,
    ``log_scale`` the logarithm of the largest over the least scale, ``parities`` 1 or 2."""

    area_sr: float
    rotation_rad: float
    log_scale: float
    parities: int

    def log_volume(self, scale_rad: float, tuning: OddsTuning = TUNING) -> float:
        """ln of the volume in pixels² · radians · ln scale · parities · shears."""
        sides = self.area_sr / scale_rad**2 * self.rotation_rad * self.log_scale * self.parities
        return math.log(sides) + math.log(2 * math.pi * tuning.shear**2)


@dataclass(frozen=True)
class PlateProblem:
    """A frame and a sky, both brightest first.

    Attributes
    ----------
    px : (n, 2) measurements. covariance : (n, 2, 2) px². shape : (rows, columns) of the frame.
    vectors : (m, 3) directions of stars. sigma_rad : (m,) their errors per axis.
    """

    px: FloatArray
    covariance: FloatArray
    shape: tuple[int, int]
    vectors: FloatArray
    sigma_rad: FloatArray

    @property
    def area_px(self) -> float:
        """Area of the frame, px²."""
        return float(self.shape[0] * self.shape[1])

    @property
    def middle_px(self) -> FloatArray:
        """(2,) the middle of the frame."""
        return np.array([(self.shape[1] - 1) / 2.0, (self.shape[0] - 1) / 2.0])

    @property
    def half_diagonal_px(self) -> float:
        """From the middle to a corner."""
        return 0.5 * math.hypot(*self.shape)

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.vectors)

    def stars_near(self, direction: FloatArray, radius_rad: float) -> IntArray:
        """Rows of the stars within an angle, brightest first."""
        chord = 2.0 * math.sin(min(radius_rad, math.pi) / 2.0)
        return np.array(self._tree.query_ball_point(direction, chord, return_sorted=True), dtype=np.int64)

    def inside(self, px: FloatArray, margin_px: float = 0.0) -> Any:
        """(n,) mask of the pixels that lie on the frame, or not farther than ``margin_px`` outside."""
        low, high = -0.5 - margin_px, np.array(self.shape[::-1]) - 0.5 + margin_px
        return np.all((px >= low) & (px <= high), axis=1)


@dataclass(frozen=True)
class Verdict:
    """A pointing that was verified.

    Attributes
    ----------
    pointing : refined. log_odds : natural, against all chance; −inf where fewer than three stars fit.
    measured, stars : (k,) the paired rows of the problem, in the order of the stars' brightness.
    residual_px : (k, 2) measurement minus prediction. depth : how many measurements and predicted stars were weighed.
    tolerance_px : the error per axis beyond those quoted (distortion, old positions).
    """

    pointing: Pointing
    log_odds: float
    measured: IntArray
    stars: IntArray
    residual_px: FloatArray
    depth: tuple[int, int]
    tolerance_px: float


def verify(
    problem: PlateProblem,
    pointing: Pointing,
    volume: SearchVolume,
    tolerance_px: float,
    tuning: OddsTuning = TUNING,
) -> Verdict:
    """The pointing refined to the measurements, with its odds.

    Identification and fit alternate; in each iteration the error that the residuals have beyond the quoted ones
    replaces ``tolerance_px``. The iteration with the best odds is returned.
    """
    nothing = np.empty(0, np.int64)
    best = Verdict(pointing, -math.inf, nothing, nothing, np.empty((0, 2)), (0, 0), tolerance_px)
    radius = problem.half_diagonal_px * float(np.sqrt(abs(np.linalg.det(pointing.cd))))
    rows = problem.stars_near(pointing.to_sky(problem.middle_px[None])[0], 1.2 * radius)
    for _ in range(tuning.iterations):
        verdict = weigh(problem, rows, pointing, volume, tolerance_px, tuning)
        if len(verdict.measured) < 3:
            break
        if verdict.log_odds > best.log_odds:
            best = verdict
        elif verdict.log_odds < tuning.hopeless:
            break
        step = _step(problem, verdict, tuning)
        pointing = verdict.pointing.moved(step)
        if not 0.5 < np.linalg.det(pointing.cd) / np.linalg.det(verdict.pointing.cd) < 2.0:
            break
        residual = _predicted_residual(problem, verdict, pointing)
        tighter = max(_excess(problem, verdict, residual), 0.25 * tolerance_px)
        if tighter > 0.95 * tolerance_px and np.abs(step[:2]).max() < 0.01:
            break
        tolerance_px = min(tolerance_px, tighter)
    return best


def weigh(
    problem: PlateProblem,
    rows: IntArray,
    pointing: Pointing,
    volume: SearchVolume,
    tolerance_px: float,
    tuning: OddsTuning = TUNING,
) -> Verdict:
    """The odds of a pointing without refinement; ``rows`` are the stars about the frame, brightest first."""
    predicted = pointing.to_px(problem.vectors[rows])
    inside = np.flatnonzero(problem.inside(predicted))[: tuning.deepest]
    rows, predicted = rows[inside], predicted[inside]
    n = min(len(problem.px), tuning.deepest)
    i, j = _paired(problem, n, rows, predicted, pointing, tolerance_px)
    residual = problem.px[i] - predicted[j]
    total = _total_covariance(problem, i, rows[j], pointing, tolerance_px)
    gain = math.log(problem.area_px) + log_density(residual, total)
    score, depth = _best_depth(gain, i, j, n, len(rows), tuning)
    used = (i < depth[0]) & (j < depth[1])
    columns = design(predicted[j[used]] - pointing.origin_px)
    information = np.einsum("nai,nab,nbj->ij", columns, inverse(total[used]), columns)
    information[4:, 4:] += np.eye(2) / tuning.shear**2
    price = -0.5 * float(log_determinant(information)) + 3.0 * LOG_2PI
    price -= volume.log_volume(math.sqrt(abs(np.linalg.det(pointing.cd))), tuning)
    singular = np.linalg.svd(pointing.cd, compute_uv=False)
    price -= 0.5 * (0.5 * math.log(singular[0] / singular[1]) / tuning.shear) ** 2
    enough = used.sum() >= 3
    log_odds = score + min(price, 0.0) if enough else -math.inf
    return Verdict(pointing, log_odds, i[used], rows[j[used]], residual[used], depth, tolerance_px)


def _paired(
    problem: PlateProblem, n: int, rows: IntArray, predicted: FloatArray, pointing: Pointing, tolerance_px: float
) -> tuple[IntArray, IntArray]:
    """Pairs of the n brightest measurements and predicted stars, both as positions in the order of brightness."""
    m = len(rows)
    if not m:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    wide = problem.covariance[:n] + tolerance_px**2 * np.eye(2)
    sigma = np.maximum(problem.sigma_rad[rows] / math.sqrt(abs(np.linalg.det(pointing.cd))), 1e-6)
    frame = Records.of(problem.px[:n], covariance=wide, source="frame")
    sky = Records.of(predicted, sigma=sigma, source="catalogue")
    # Half of the fainter list is taken to be common; the odds that follow do not depend on it.
    common, area = 0.5 * min(n, m), problem.area_px
    rule = PoissonField(common / area, (n - 0.9 * common) / area, (m - 0.9 * common) / area)
    # As in `identify`, without the probabilities: only the best hypothesis is weighed.
    pairs = Radius(4.0)(frame, sky)
    grouped = groups(pairs)
    best = assign(grouped, rule(pairs).log_ratio, PerPair(0.0)(grouped.sizes_1, grouped.sizes_2))
    chosen = grouped.order[best.chosen]
    i, j = pairs.i[chosen].astype(np.int64), pairs.j[chosen].astype(np.int64)
    order = np.argsort(j, kind="stable")
    return i[order], j[order]


def _best_depth(
    gain: FloatArray, i: IntArray, j: IntArray, n: int, m: int, tuning: OddsTuning
) -> tuple[float, tuple[int, int]]:
    """The best score over how deep the two lists are compared, and that depth."""
    from scipy.special import gammaln

    if not len(gain):
        return -math.inf, (n, m)
    ns, ms = _depths(n, tuning.depths), _depths(m, tuning.depths)
    inside = (i[None, None, :] < ns[:, None, None]) & (j[None, None, :] < ms[None, :, None])
    k, total = inside.sum(axis=2), inside @ gain
    n_, m_ = ns[:, None], ms[None, :]
    # ln C(n,k) C(m,k) k!
    ways = gammaln(n_ + 1) - gammaln(n_ - k + 1) + gammaln(m_ + 1) - gammaln(m_ - k + 1) - gammaln(k + 1)
    score = total - ways - np.log(np.minimum(n_, m_) + 1.0) - math.log(k.size)
    a, b = np.unravel_index(int(np.argmax(score)), score.shape)
    return float(score[a, b]), (int(ns[a]), int(ms[b]))


def _depths(n: int, number: int) -> IntArray:
    """Lengths of about ``number`` prefixes of a list of n, in geometric progression from 4 to n."""
    return np.unique(np.round(np.geomspace(min(4, n), n, number)).astype(np.int64))


def _total_covariance(
    problem: PlateProblem, i: IntArray, rows: IntArray, pointing: Pointing, tolerance_px: float
) -> FloatArray:
    """(k, 2, 2) of the residuals of pairs: measurement, star and tolerance."""
    star = (problem.sigma_rad[rows] ** 2 / abs(np.linalg.det(pointing.cd)) + tolerance_px**2)[:, None, None]
    return np.asarray(problem.covariance[i] + star * np.eye(2))


def _step(problem: PlateProblem, verdict: Verdict, tuning: OddsTuning = TUNING) -> FloatArray:
    """(6,) shift, growth, rotation and shears that bring the predictions to the measurements; see ``design``."""
    columns = design(verdict.pointing.to_px(problem.vectors[verdict.stars]) - verdict.pointing.origin_px)
    total = _total_covariance(problem, verdict.measured, verdict.stars, verdict.pointing, verdict.tolerance_px)
    precision = inverse(total)
    step = np.zeros(6)
    weight = np.ones(len(total))
    for _ in range(2):
        weighted = np.einsum("nai,nab,n->nib", columns, precision, weight)
        information = np.einsum("nib,nbj->ij", weighted, columns) + np.diag([0, 0, 0, 0, *2 * [tuning.shear**-2]])
        step = np.linalg.solve(information, np.einsum("nib,nb->i", weighted, verdict.residual_px))
        left = verdict.residual_px - columns @ step
        # Weights of Student's t with four degrees of freedom: a few wrong pairs do not pull.
        weight = 6.0 / (4.0 + np.einsum("ni,nij,nj->n", left, precision, left))
    return np.asarray(step)


def _predicted_residual(problem: PlateProblem, verdict: Verdict, pointing: Pointing) -> FloatArray:
    return np.asarray(problem.px[verdict.measured] - pointing.to_px(problem.vectors[verdict.stars]))


def _excess(problem: PlateProblem, verdict: Verdict, residual: FloatArray) -> float:
    """The error per axis that the typical residual has beyond the quoted ones, px."""
    quoted = _total_covariance(problem, verdict.measured, verdict.stars, verdict.pointing, 0.0)
    # The fit takes about 5 of the 2k degrees of freedom; the median of r² is 2 ln 2 σ² in two dimensions.
    share = max(2 * len(residual) - 5.0, 1.0) / (2 * len(residual))
    square = np.median(np.sum(residual**2, axis=1)) / (2 * math.log(2)) / share
    typical = 0.5 * np.median(np.trace(quoted, axis1=1, axis2=2))
    return math.sqrt(max(square - typical, 0.05**2))


def on_pixels(verdict: Verdict, problem: PlateProblem, px: FloatArray) -> Verdict:
    """The verdict's pairs fitted once more, on other pixels (n, 2) of the same measurements."""
    own = replace(problem, px=px)
    pointing = verdict.pointing
    for _ in range(3):
        fit = replace(verdict, pointing=pointing)
        fit = replace(fit, residual_px=_predicted_residual(own, fit, pointing))
        pointing = pointing.moved(_step(own, fit))
    return replace(fit, pointing=pointing, residual_px=_predicted_residual(own, fit, pointing))
