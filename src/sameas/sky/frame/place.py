"""The pointing of a frame (plate solving): from its header, an approximate direction, or a range of scales only.

:func:`place` tries the hints in the given order and returns the first placement whose odds against chance, and against
the next best placement, are high enough; else it refuses with the best odds of each hint.

- :class:`ApproximateWcs`: an approximate plate solution, with any distortion that astropy reads (SIP, TPV, DSS). Shift
  and rotation are found by correlation.
- :class:`Aim`: a direction, its uncertainty and a range of scales; any orientation and parity.
- :class:`AllSky`: a range of scales only. For fields with a dozen of the catalogue's brighter stars; the index
  (:func:`~sameas.sky.frame.pointing_hints.sky_index`) takes seconds and can be reused for all frames of a camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.records import unpack
from sameas.representation import in_short
from sameas.sky.frame.field import Stars
from sameas.sky.frame.odds import PlateProblem, VerifiedPointing, refitted_on, verify
from sameas.sky.frame.pointing import Pointing, sky_of
from sameas.sky.frame.pointing_hints import (
    AIM_LISTS,
    VERIFIED,
    Aim,
    AimLists,
    AllSky,
    ApproximateWcs,
    Hint,
    SkyIndex,
    candidates,
)
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

if TYPE_CHECKING:
    from astropy.wcs import WCS

#: Minimum odds of an accepted placement (chosen).
DEFAULT_ODDS = 1e6


class NoSolution(InputError):
    """No hint leads to a placement with high enough odds."""


class MeasuredStars(Protocol):
    """Measurements for :func:`place`: 0-based pixels, covariances (xx, xy, yy in px²), fluxes, shape of the frame."""

    @property
    def x_px(self) -> FloatArray: ...
    @property
    def y_px(self) -> FloatArray: ...
    @property
    def covariance(self) -> FloatArray: ...
    @property
    def flux(self) -> FloatArray: ...
    @property
    def shape(self) -> tuple[int, int]: ...
    @property
    def name(self) -> str: ...


@in_short
@dataclass(frozen=True)
class Placement:
    """The pointing of a frame with its odds.

    Attributes
    ----------
    wcs : the linear plate solution (TAN, ICRS) as an astropy WCS.
    pointing : the same as numbers. log_odds : natural logarithm of its odds against chance.
    runner_up_log_odds : of the next best, different placement, −inf if there is none.
    rows_measured, rows_stars : (k,) the fitted pairs, as rows of the caller's tables.
    residual_px : (k, 2) measured minus predicted. rms_arcsec : their root mean square per axis.
    hint : text of the successful hint.
    """

    wcs: WCS
    pointing: Pointing
    log_odds: float
    runner_up_log_odds: float
    rows_measured: IntArray
    rows_stars: IntArray
    residual_px: FloatArray = field(repr=False)
    rms_arcsec: float
    hint: str

    @property
    def n_matched(self) -> int:
        """Number of fitted pairs."""
        return len(self.rows_stars)

    @property
    def scale_arcsec(self) -> float:
        """Arcseconds per pixel."""
        return self.pointing.scale_arcsec

    @property
    def rotation_deg(self) -> float:
        """The direction of the frame's y axis, degrees from north through east."""
        return self.pointing.rotation_deg

    @property
    def parity(self) -> int:
        """−1 for the sky as seen from inside, +1 mirrored."""
        return self.pointing.parity

    def describe(self) -> str:
        """One line to print."""
        ra, dec = self.wcs.wcs.crval
        parity = "mirrored" if self.parity > 0 else "not mirrored"
        return (
            f"placed by {self.hint}: RA {ra:.5f}° Dec {dec:+.5f}°, {self.scale_arcsec:.4f}″/px, y axis at "
            f"{self.rotation_deg:.2f}° (N through E), {parity}; {self.n_matched} stars, rms {self.rms_arcsec:.2f}″, "
            f"odds {odds_in_words(self.log_odds)}, next best {odds_in_words(self.runner_up_log_odds)}"
        )


def place(
    measured: MeasuredStars,
    stars: Stars,
    hints: Hint | Sequence[Hint],
    *,
    index: SkyIndex | None = None,
    odds: float = DEFAULT_ODDS,
    aim_lists: AimLists = AIM_LISTS,
) -> Placement:
    """The placement of a frame by the first hint whose best placement has high enough odds.

    Parameters
    ----------
    measured : the frame's measurements; up to half of the brighter ones may be spurious.
    stars : the catalogue at the frame's epoch, of the field or (for :class:`AllSky`) of the whole sky.
    hints : one or several of :class:`ApproximateWcs`, :class:`Aim`, :class:`AllSky`, tried in this order.
    index : of :func:`~sameas.sky.frame.pointing_hints.sky_index` for :class:`AllSky` hints, reusable between frames;
        built if not given.
    odds : minimum odds of a placement against chance, and against the next best placement.
    aim_lists : patterns that are tried around an aim.

    Raises
    ------
    InputError : too few measurements or stars. NoSolution : no placement reaches ``odds``.

    Example
    -------
    >>> place(measurements, stars, Aim(62.5, 22.8, radius_deg=0.1, scale_arcsec=(0.9, 1.4)))  # doctest: +SKIP
    """
    hints = [hints] if isinstance(hints, ApproximateWcs | Aim | AllSky) else list(hints)
    if not hints or not odds > 1:
        raise InputError("place: give at least one hint, and odds above 1")
    problem, order_1, order_2 = problem_of(measured, stars)
    refusals = []
    for hint in hints:
        best, second = _best_pointing(problem, hint, index, math.log(odds), aim_lists)
        if best is not None and _is_established(best, second, math.log(odds)):
            return _placement(problem, best, second, hint, (order_1, order_2))
        refusals.append(_refusal(hint, best, second))
    raise NoSolution(f"{measured.name}: no solution: {'; '.join(refusals)}; {_advice(hints)}")


def problem_of(measured: MeasuredStars, stars: Stars) -> tuple[PlateProblem, IntArray, IntArray]:
    """The plate problem, both lists brightest first, and their rows in the caller's tables."""
    px = np.column_stack([measured.x_px, measured.y_px]).astype(np.float64)
    usable = np.isfinite(px).all(axis=1) & np.isfinite(measured.covariance).all(axis=1) & np.isfinite(measured.flux)
    order_1 = np.argsort(np.where(usable, -measured.flux, np.inf), kind="stable")[: int(usable.sum())]
    order_2 = stars.order()
    for n, name, what in (
        (len(order_1), measured.name, "usable measurements; is the threshold too high"),
        (len(order_2), stars.name, "stars; does the catalogue cover the field"),
    ):
        if n < 4:
            raise InputError(f"{name}: {n} {what}? A plate solution needs at least four")
    sigma = np.broadcast_to(np.asarray(stars.sigma_arcsec, dtype=np.float64), len(order_2))[order_2]
    vectors = unit_vectors(np.asarray(stars.ra_deg)[order_2], np.asarray(stars.dec_deg)[order_2])
    covariance = unpack(np.asarray(measured.covariance, dtype=np.float64)[order_1], 2)
    shape = (int(measured.shape[0]), int(measured.shape[1]))
    return PlateProblem(px[order_1], covariance, shape, vectors, sigma / ARCSEC_PER_RADIAN), order_1, order_2


def _best_pointing(
    problem: PlateProblem, hint: Hint, index: SkyIndex | None, least_log_odds: float, aim_lists: AimLists
) -> tuple[VerifiedPointing | None, float]:
    """The best pointing under one hint, and the log-odds of the next best, different one."""
    undistorted = _undistorted(problem, hint)
    volume, tolerance = hint.search_volume(undistorted), 0.01 * undistorted.half_diagonal_px
    best, second = None, -math.inf
    for pointings in candidates(undistorted, hint, index, aim_lists):
        for pointing in _distinct(pointings, undistorted, VERIFIED):
            verified = verify(undistorted, pointing, volume, tolerance)
            if not math.isfinite(verified.log_odds) or not hint.allows(verified.pointing, undistorted):
                continue
            if best is None or verified.log_odds > best.log_odds:
                if best is not None and not _is_same(best.pointing, verified.pointing, undistorted):
                    second = max(second, best.log_odds)
                best = verified
            elif not _is_same(best.pointing, verified.pointing, undistorted):
                second = max(second, verified.log_odds)
        if _is_established(best, second, least_log_odds):
            break
    return best, second


def _undistorted(problem: PlateProblem, hint: Hint) -> PlateProblem:
    """The problem with the distortion of the header's WCS removed from the measurements."""
    if not isinstance(hint, ApproximateWcs):
        return problem
    linear = Pointing.of_wcs(hint.wcs, problem.shape)
    px = linear.to_px(sky_of(hint.wcs, problem.px))
    return PlateProblem(px, problem.covariance, problem.shape, problem.vectors, problem.sigma_rad)


def _distinct(pointings: Iterator[Pointing], problem: PlateProblem, most: int) -> Iterator[Pointing]:
    """The first of each cluster of nearly equal pointings, at most ``most`` of them."""
    proposed = list(pointings)
    if not proposed:
        return
    corners = np.stack([pointing.to_sky(_corners(problem)) for pointing in proposed])
    remaining = np.ones(len(proposed), bool)
    for _ in range(most):
        if not remaining.any():
            return
        first = int(np.argmax(remaining))
        distance = np.linalg.norm(corners - corners[first], axis=2).max(axis=1)
        remaining &= distance > 0.03 * np.linalg.norm(corners[first, 2] - corners[first, 1])
        remaining[first] = False
        yield proposed[first]


def _corners(problem: PlateProblem) -> FloatArray:
    """(3, 2) three corners of the frame, the last two on a diagonal."""
    rows, columns = problem.shape
    return np.array([[0.0, 0.0], [columns - 1.0, 0.0], [0.0, rows - 1.0]])


def _is_same(one: Pointing, other: Pointing, problem: PlateProblem) -> bool:
    """Whether the corners of the frame agree for two pointings, to 1 % of its diagonal."""
    difference = one.to_sky(_corners(problem)) - other.to_sky(_corners(problem))
    size = 2 * problem.half_diagonal_px * one.scale_arcsec / ARCSEC_PER_RADIAN
    return bool(np.linalg.norm(difference, axis=1).max() < 0.01 * size)


def _is_established(best: VerifiedPointing | None, second: float, least_log_odds: float) -> bool:
    return best is not None and best.log_odds - max(second, 0.0) >= least_log_odds


def _placement(
    problem: PlateProblem, best: VerifiedPointing, second: float, hint: Hint, orders: tuple[IntArray, IntArray]
) -> Placement:
    rms_px = math.sqrt(np.mean(best.residual_px**2))
    if isinstance(hint, ApproximateWcs):
        best = refitted_on(best, problem, problem.px)
    return Placement(
        wcs=best.pointing.to_wcs(problem.shape),
        pointing=best.pointing,
        log_odds=best.log_odds,
        runner_up_log_odds=second,
        rows_measured=orders[0][best.measured],
        rows_stars=orders[1][best.stars],
        residual_px=best.residual_px,
        rms_arcsec=rms_px * best.pointing.scale_arcsec,
        hint=hint.words,
    )


def odds_in_words(log_odds: float) -> str:
    """Odds as text: 250:1, 1:30, 10^45:1."""
    if log_odds == -math.inf:
        return "none"
    size = abs(log_odds)
    number = f"{math.exp(size):.3g}" if size < math.log(1e5) else f"10^{size / math.log(10):.0f}"
    return f"{number}:1" if log_odds >= 0 else f"1:{number}"


def _refusal(hint: Hint, best: VerifiedPointing | None, second: float) -> str:
    by = f"{hint.words} {hint.ra_deg:.4f}°, {hint.dec_deg:+.4f}°" if isinstance(hint, Aim) else hint.words
    if best is None:
        return f"no fit by {by}"
    words = f"by {by} the best has odds {odds_in_words(best.log_odds)} ({len(best.stars)} stars)"
    return words + (f", another {odds_in_words(second)}" if second > 0 else "")


def _advice(hints: Sequence[Hint]) -> str:
    aims = [hint for hint in hints if isinstance(hint, Aim)]
    skies = [hint for hint in hints if isinstance(hint, AllSky)]
    radius = f" than {aims[0].radius_deg:.2g}°" if aims else ""
    area = f"another aim, a larger radius{radius}" if aims else "an aim" if skies else "a larger radius"
    tried = [aim.scale_arcsec for aim in aims] + [sky.scale_arcsec for sky in skies]
    scales = f" than {tried[0][0]:.3g} to {tried[0][1]:.3g}″ per pixel" if tried else ""
    binned = " (are pixels binned?)" if aims else ""
    return f"give {area}, a wider range of scales{scales}{binned} or a deeper catalogue"
