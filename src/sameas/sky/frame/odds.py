"""The odds of a frame's pointing against chance.

Predicted stars are matched one to one with the measurements, and this hypothesis is compared with uniformly distributed
measurements. With n measurements and m predicted stars, k of them paired, A the area of the frame and N the density of
a pair's residual,

    ln odds = Σ ln(A N) − ln[C(m,k) C(n,k) k!] − ln(min(n,m)+1) + ½ ln|2π C_θ| − ln V_θ.

The second term counts the ways to pair k of both [T1], the third is the flat prior of k (as in METHOD 4.1 for targets),
the last two are the Occam factor of the pointing: the posterior volume of shift, rotation, scale and shear over the
searched volume. So odds of 1000:1 mean the same for seven stars of a small field and for a search of the whole sky. The
number of brightest entries compared in each list is chosen by the odds; the number of choices lowers the odds too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.assignment import assign
from sameas.evidence import PoissonField
from sameas.gate import Radius
from sameas.gaussian import LOG_2PI, inverse, log_density, log_determinant
from sameas.groups import groups
from sameas.prior import EVIDENCE_ALONE
from sameas.records import Records
from sameas.sky.frame.pointing import Pointing, design

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


# Parameters of the odds of a pointing, all chosen.
#: 1σ of the difference in scale of a frame's axes, and of their angle from 90°, by refraction, tilt or non-square
#: pixels.
SHEAR = 0.01
DEEPEST = 2000  # maximum number of brightest measurements and stars that are compared
ITERATIONS = 7  # maximum number of iterations of matching and fit
DEPTHS = 7  # number of depths of each list at which the odds are computed
HOPELESS = -15.0  # a pointing is dropped if its log-odds are below this and did not rise in the last iteration


@dataclass(frozen=True)
class SearchVolume:
    """The searched volume of pointings.

    area_sr : area of the sky for the middle of the frame. rotation_rad : range of orientations. log_scale : ln of the
    largest over the smallest scale. parities : 1 or 2.
    """

    area_sr: float
    rotation_rad: float
    log_scale: float
    parities: int

    def log_volume(self, scale_rad: float, shear: float) -> float:
        """ln of the volume in pixels² · radians · ln scale · parities · shears. shear : 1σ of the shears."""
        sides = self.area_sr / scale_rad**2 * self.rotation_rad * self.log_scale * self.parities
        return math.log(sides) + math.log(2 * math.pi * shear**2)


@dataclass(frozen=True)
class PlateProblem:
    """The measurements of a frame and the stars of a catalogue, both brightest first.

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
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.vectors)

    def stars_near(self, direction: FloatArray, radius_rad: float) -> IntArray:
        """Rows of the stars within an angle, brightest first."""
        chord = 2.0 * math.sin(min(radius_rad, math.pi) / 2.0)
        return np.array(self._tree.query_ball_point(direction, chord, return_sorted=True), dtype=np.int64)

    def inside(self, px: FloatArray, margin_px: float = 0.0) -> Any:
        """(n,) mask of the pixels on the frame or at most ``margin_px`` outside."""
        low, high = -0.5 - margin_px, np.array(self.shape[::-1]) - 0.5 + margin_px
        return np.all((px >= low) & (px <= high), axis=1)


@dataclass(frozen=True)
class VerifiedPointing:
    """A verified pointing.

    pointing : refined. log_odds : natural, against chance; −inf if fewer than three stars fit.
    measured, stars : (k,) the paired rows of the problem, ordered by the brightness of the stars.
    residual_px : (k, 2) measurement minus prediction. depth : number of measurements and predicted stars compared.
    tolerance_px : the error per axis in addition to the quoted ones (distortion, old positions).
    """

    pointing: Pointing
    log_odds: float
    measured: IntArray
    stars: IntArray
    residual_px: FloatArray
    depth: tuple[int, int]
    tolerance_px: float


def verify(problem: PlateProblem, pointing: Pointing, volume: SearchVolume, tolerance_px: float) -> VerifiedPointing:
    """The pointing refined by the measurements, with its odds.

    Matching and fit alternate; each iteration re-estimates ``tolerance_px`` from the excess of the residuals over the
    quoted errors. The iteration with the best odds is returned.
    """
    no_rows = np.empty(0, np.int64)
    best = VerifiedPointing(pointing, -math.inf, no_rows, no_rows, np.empty((0, 2)), (0, 0), tolerance_px)
    radius = problem.half_diagonal_px * float(np.sqrt(abs(np.linalg.det(pointing.cd))))
    rows = problem.stars_near(pointing.to_sky(problem.middle_px[None])[0], 1.2 * radius)
    for _ in range(ITERATIONS):
        verified = weigh(problem, rows, pointing, volume, tolerance_px)
        if len(verified.measured) < 3:
            break
        if verified.log_odds > best.log_odds:
            best = verified
        elif verified.log_odds < HOPELESS:
            break
        step = _step(problem, verified, SHEAR)
        pointing = verified.pointing.moved(step)
        if not 0.5 < np.linalg.det(pointing.cd) / np.linalg.det(verified.pointing.cd) < 2.0:
            break
        residual = _predicted_residual(problem, verified, pointing)
        tighter = max(_excess(problem, verified, residual), 0.25 * tolerance_px)
        if tighter > 0.95 * tolerance_px and np.abs(step[:2]).max() < 0.01:
            break
        tolerance_px = min(tolerance_px, tighter)
    return best


def weigh(
    problem: PlateProblem, rows: IntArray, pointing: Pointing, volume: SearchVolume, tolerance_px: float
) -> VerifiedPointing:
    """The odds of a pointing without refinement. rows : the stars on and around the frame, brightest first."""
    predicted = pointing.to_px(problem.vectors[rows])
    inside = np.flatnonzero(problem.inside(predicted))[:DEEPEST]
    rows, predicted = rows[inside], predicted[inside]
    n = min(len(problem.px), DEEPEST)
    i, j = _paired(problem, n, rows, predicted, pointing, tolerance_px)
    residual = problem.px[i] - predicted[j]
    total = _total_covariance(problem, i, rows[j], pointing, tolerance_px)
    gain = math.log(problem.area_px) + log_density(residual, total)
    score, depth = _best_depth(gain, i, j, (n, len(rows)), DEPTHS)
    used = (i < depth[0]) & (j < depth[1])
    columns = design(predicted[j[used]] - pointing.origin_px)
    information = np.einsum("nai,nab,nbj->ij", columns, inverse(total[used]), columns)
    information[4:, 4:] += np.eye(2) / SHEAR**2
    log_volume_ratio = -0.5 * float(log_determinant(information)) + 3.0 * LOG_2PI
    log_volume_ratio -= volume.log_volume(math.sqrt(abs(np.linalg.det(pointing.cd))), SHEAR)
    singular = np.linalg.svd(pointing.cd, compute_uv=False)
    log_volume_ratio -= 0.5 * (0.5 * math.log(singular[0] / singular[1]) / SHEAR) ** 2
    enough = used.sum() >= 3
    log_odds = score + min(log_volume_ratio, 0.0) if enough else -math.inf
    return VerifiedPointing(pointing, log_odds, i[used], rows[j[used]], residual[used], depth, tolerance_px)


def _paired(
    problem: PlateProblem, n: int, rows: IntArray, predicted: FloatArray, pointing: Pointing, tolerance_px: float
) -> tuple[IntArray, IntArray]:
    """Pairs of the n brightest measurements and the predicted stars, as indices in order of brightness."""
    m = len(rows)
    if not m:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    covariance = problem.covariance[:n] + tolerance_px**2 * np.eye(2)
    sigma = np.maximum(problem.sigma_rad[rows] / math.sqrt(abs(np.linalg.det(pointing.cd))), 1e-6)
    frame = Records.of(problem.px[:n], covariance=covariance, source="frame")
    sky = Records.of(predicted, sigma=sigma, source="catalogue")
    # Half of the shorter list is assumed common; the resulting odds do not depend on it.
    common, area = 0.5 * min(n, m), problem.area_px
    rule = PoissonField(common / area, (n - 0.9 * common) / area, (m - 0.9 * common) / area)
    # As in `identify`, without probabilities: only the best hypothesis is used.
    pairs = Radius(4.0)(frame, sky)
    grouped = groups(pairs)
    best = assign(grouped, rule(pairs).log_ratio, EVIDENCE_ALONE(grouped.sizes_1, grouped.sizes_2))
    chosen = grouped.order[best.chosen]
    i, j = pairs.i[chosen].astype(np.int64), pairs.j[chosen].astype(np.int64)
    order = np.argsort(j, kind="stable")
    return i[order], j[order]


def _best_depth(
    gain: FloatArray, i: IntArray, j: IntArray, lengths: tuple[int, int], depths: int
) -> tuple[float, tuple[int, int]]:
    """The best score over this number of depths of two lists of these lengths, and the depths."""
    from scipy.special import gammaln

    if not len(gain):
        return -math.inf, lengths
    ns, ms = (np.unique(np.round(np.geomspace(min(4, length), length, depths)).astype(np.int64)) for length in lengths)
    inside = (i[None, None, :] < ns[:, None, None]) & (j[None, None, :] < ms[None, :, None])
    k, log_gain = inside.sum(axis=2), inside @ gain
    n_, m_ = ns[:, None], ms[None, :]
    # ln C(n,k) C(m,k) k!
    ways = gammaln(n_ + 1) - gammaln(n_ - k + 1) + gammaln(m_ + 1) - gammaln(m_ - k + 1) - gammaln(k + 1)
    score = log_gain - ways - np.log(np.minimum(n_, m_) + 1.0) - math.log(k.size)
    a, b = np.unravel_index(int(np.argmax(score)), score.shape)
    return float(score[a, b]), (int(ns[a]), int(ms[b]))


def _total_covariance(
    problem: PlateProblem, i: IntArray, rows: IntArray, pointing: Pointing, tolerance_px: float
) -> FloatArray:
    """(k, 2, 2) covariances of the residuals: measurement, star and tolerance."""
    star = (problem.sigma_rad[rows] ** 2 / abs(np.linalg.det(pointing.cd)) + tolerance_px**2)[:, None, None]
    return np.asarray(problem.covariance[i] + star * np.eye(2))


def _step(problem: PlateProblem, verified: VerifiedPointing, shear: float) -> FloatArray:
    """(6,) corrections of shift, scale, rotation and shears from a robust fit of the residuals; see ``design``."""
    columns = design(verified.pointing.to_px(problem.vectors[verified.stars]) - verified.pointing.origin_px)
    total = _total_covariance(problem, verified.measured, verified.stars, verified.pointing, verified.tolerance_px)
    precision = inverse(total)
    step = np.zeros(6)
    weight = np.ones(len(total))
    for _ in range(2):
        weighted = np.einsum("nai,nab,n->nib", columns, precision, weight)
        information = np.einsum("nib,nbj->ij", weighted, columns) + np.diag([0, 0, 0, 0, *2 * [shear**-2]])
        step = np.linalg.solve(information, np.einsum("nib,nb->i", weighted, verified.residual_px))
        residual = verified.residual_px - columns @ step
        # Weights of Student's t with four degrees of freedom, so that a few wrong pairs have little influence.
        weight = 6.0 / (4.0 + np.einsum("ni,nij,nj->n", residual, precision, residual))
    return np.asarray(step)


def _predicted_residual(problem: PlateProblem, verified: VerifiedPointing, pointing: Pointing) -> FloatArray:
    return np.asarray(problem.px[verified.measured] - pointing.to_px(problem.vectors[verified.stars]))


def _excess(problem: PlateProblem, verified: VerifiedPointing, residual: FloatArray) -> float:
    """The error per axis of the typical residual in excess of the quoted errors, px."""
    quoted = _total_covariance(problem, verified.measured, verified.stars, verified.pointing, 0.0)
    # The fit takes about 5 of the 2k degrees of freedom; the median of r² is 2 ln 2 σ² in two dimensions.
    share = max(2 * len(residual) - 5.0, 1.0) / (2 * len(residual))
    square = np.median(np.sum(residual**2, axis=1)) / (2 * math.log(2)) / share
    typical = 0.5 * np.median(np.trace(quoted, axis1=1, axis2=2))
    return math.sqrt(max(square - typical, 0.05**2))


def refitted_on(verified: VerifiedPointing, problem: PlateProblem, px: FloatArray) -> VerifiedPointing:
    """The pairs of a verified pointing refitted to other pixels (n, 2) of the same measurements."""
    on_px = replace(problem, px=px)
    pointing = verified.pointing
    for _ in range(3):
        fit = replace(verified, pointing=pointing)
        fit = replace(fit, residual_px=_predicted_residual(on_px, fit, pointing))
        pointing = pointing.moved(_step(on_px, fit, SHEAR))
    return replace(fit, pointing=pointing, residual_px=_predicted_residual(on_px, fit, pointing))
