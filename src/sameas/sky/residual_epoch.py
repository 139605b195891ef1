"""An epoch that the residuals of a match contradict, and motions that were misread.

With a wrong epoch (:func:`epoch_doubt`, :class:`MovedPairs`) residuals grow along the proper motions. The catalogue
with proper motions μ was moved to an epoch T. If the other one was observed at T + δ, each pair has a residual −μ δ,
plus a common offset. Both are fitted by least squares. Motions in another convention (without cos δ, exchanged, with
the other sign, in arcsec/yr) are tested in the same way, and preferred where they lower χ² further.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import Message, naming
from sameas.evidence import Errors
from sameas.gaussian import inverse
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import in_years

# Thresholds for doubting an epoch; all chosen.
MIN_P_PAIR, LARGEST_SIGMAS = 0.9, 6.0  # pairs with a lower probability or a larger residual are not used
FEWEST, MAX_PAIRS = 20, 30_000  # with fewer pairs no doubt is reported; more are sampled regularly
SIGNIFICANT_SIGMAS = 5.0  # minimum significance of δ, and of an offset in addition
SIGNIFICANT_YEARS = 0.3  # minimum of |δ|
SIGNIFICANT_SHARE = 0.3  # the fastest 5 % of the objects must move by at least this fraction of their errors in δ years
#: An epoch does not explain δ that differ by more than this share between east and north, nor one outside this range.
LARGEST_AXIS_RATIO = 0.3
EPOCHS_JYR = (1800.0, 2100.0)


def epoch_doubt(
    first: Catalogue, second: Catalogue, epoch_jyr: float | None, answer: Identification, errors: Errors
) -> tuple[str, bool]:
    """A doubt about the epoch of one catalogue, or about the convention of the motions (empty if none), and whether the
    epoch also explains a common offset.

    epoch_jyr : common epoch of the match. errors : estimated ones. With the quoted ones bright stars, whose errors are
    mostly a floor, would have most of the weight, and those of them that moved most would count as outliers.
    """
    side = _questioned(first, second)
    if side is None or epoch_jyr is None:
        return "", False
    questioned, other = (first, second) if side == 1 else (second, first)
    moved, moved_side = (questioned, side) if questioned.has_motion else (other, 3 - side)
    assert questioned.epoch_jyr is not None
    return _moved_pairs(moved, moved_side, epoch_jyr, answer, errors).doubt(
        moved,
        moved_side,
        Questioned(questioned.name, questioned.epoch_jyr, naming(f"give {{epoch{side}:YEAR}}"), moved is questioned),
    )


@dataclass(frozen=True)
class Questioned:
    """Whose epoch the residuals test: its name, the assumed or stated epoch, how to give another.

    moved : whether it is the source with the motions itself.
    """

    name: str
    epoch_jyr: float
    remedy: Message
    moved: bool = False


def _moved_pairs(moved: Catalogue, side: int, epoch_jyr: float, answer: Identification, errors: Errors) -> MovedPairs:
    """Some sure pairs with a known proper motion. side : of the moved catalogue, 1 or 2."""
    records, index = (answer.first, answer.pairs.i) if side == 1 else (answer.second, answer.pairs.j)
    use = np.flatnonzero(answer.p_pair > MIN_P_PAIR)
    use = use[:: -(-len(use) // MAX_PAIRS) or 1]
    astrometry = moved.astrometry[records.rows[index[use]]]
    motion = astrometry.motion_arcsec_per_yr
    return MovedPairs(
        motion,
        (epoch_jyr - astrometry.epoch_jyr)[:, None] * motion,
        answer.pairs.residual[use] if side == 1 else -answer.pairs.residual[use],
        inverse(errors.typical_covariance(answer.pairs, use)),
        np.cos(np.radians(astrometry.dec_deg)),
    )._sure()


def _as_they_are(values: FloatArray) -> FloatArray:
    return values


@dataclass(frozen=True)
class MovedPairs:
    """Pairs with objects that were moved by their proper motions, as a test of epoch and motions.

    motion : (m, 2) arcsec/yr, east with cos δ, and north. displaced : (m, 2) arcsec by which the objects were moved.
    residual : (m, 2) arcsec, their position minus that in the other source. precision : (m, 2, 2) of the residuals.
    cos_dec : (m,) cosine of declination. remaining : what a fit to the residuals leaves of (m, 2) values, for residuals
        from a fitted model.
    """

    motion: FloatArray
    displaced: FloatArray
    residual: FloatArray
    precision: FloatArray
    cos_dec: FloatArray
    remaining: Callable[[FloatArray], FloatArray] = _as_they_are

    def _sure(self) -> MovedPairs:
        """Those with known motions and without large residuals."""
        near = np.einsum("mv,mvw,mw->m", self.residual, self.precision, self.residual) < LARGEST_SIGMAS**2
        some = near & np.isfinite(self.motion).all(axis=1)
        parts = (self.motion, self.displaced, self.residual, self.precision, self.cos_dec)
        return MovedPairs(*(part[some] for part in parts))

    def doubt(self, moved: Catalogue, side: int | str, questioned: Questioned) -> tuple[str, bool]:
        """A doubt about an epoch or the convention of the motions (empty if none), and whether the epoch also explains
        a common offset. side : of the moved catalogue, for the names of options.
        """
        if len(self.motion) < FEWEST:
            return "", False
        # A catalogue moved from a later epoch than assumed was moved too far; one moved to an earlier epoch than it
        # should, not far enough.
        motion = self.remaining(self.motion if questioned.moved else -self.motion)
        design = np.concatenate([motion[:, :, None], np.broadcast_to(np.eye(2), (len(motion), 2, 2))], axis=2)
        solution, covariance, gain = _least_squares(design, self.residual, self.precision)
        years, error = float(solution[0]), math.sqrt(float(covariance[0, 0]))
        significant_gain = SIGNIFICANT_SIGMAS**2
        motion_sigmas = np.sqrt(np.einsum("mv,mvw,mw->m", motion, self.precision, motion))
        if abs(years) < max(SIGNIFICANT_YEARS, SIGNIFICANT_SIGMAS * error):
            return "", False
        if np.quantile(motion_sigmas, 0.95) * abs(years) < SIGNIFICANT_SHARE:
            return "", False
        text = f"residuals follow the proper motions of {moved.name}, "
        possible = EPOCHS_JYR[0] <= questioned.epoch_jyr + years <= EPOCHS_JYR[1]
        misread = self.misreading(gain + (significant_gain if possible else -significant_gain))
        if misread is not None:
            return Message(text, *misread.words(moved, side)), False
        factors = self.different_factors()
        if factors or not possible:
            fits = factors or f"as if the epoch of {questioned.name} were {questioned.epoch_jyr + years:.0f}"
            return (
                f"{text}{fits}, which no epoch explains: are they in the right columns, and their units right?",
                False,
            )
        alone, covariance_alone, gain_only = _least_squares(design[:, :, :1], self.residual, self.precision)
        explains = gain - gain_only < significant_gain
        if explains:
            years, error = float(alone[0]), math.sqrt(float(covariance_alone[0, 0]))
        decimals = max(0, math.ceil(-math.log10(error)))
        text += (
            f"as if the epoch of {questioned.name} were {questioned.epoch_jyr + years:.{decimals}f} ± "
            f"{error:.{decimals}f}, not {in_years(round(questioned.epoch_jyr, max(decimals, 1)))}: "
        )
        return Message(text, questioned.remedy), explains

    def misreading(self, min_gain: float) -> _MotionMisreading | None:
        """The misreading of the motions that lowers χ² most, with an offset, and by more than ``min_gain``; or None."""
        offset = np.broadcast_to(np.eye(2), (len(self.residual), 2, 2))
        before, best = _chi_square(self.residual, self.precision), None
        for misread in _MOTION_MISREADINGS:
            corrected = misread.corrected(self.displaced, self.cos_dec)
            residual = self.residual + self.remaining(corrected - self.displaced)
            after = _chi_square(residual, self.precision) - _least_squares(offset, residual, self.precision)[2]
            if before - after > min_gain:
                min_gain, best = before - after, misread
        return best

    def different_factors(self) -> str:
        """The factors on the motions east and north that fit best, as text, if they differ; else empty."""
        if not self.displaced.any():
            return ""
        displaced = self.remaining(self.displaced)
        design = np.concatenate([displaced[:, :, None] * np.eye(2), np.zeros_like(self.precision) + np.eye(2)], 2)
        solution, covariance, _ = _least_squares(design, self.residual, self.precision)
        east, north = 1.0 - solution[:2]
        error = math.sqrt(float(covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1]))
        least = LARGEST_AXIS_RATIO * max(abs(solution[0]), abs(solution[1]))
        if abs(east - north) < max(SIGNIFICANT_SIGMAS * error, least):
            return ""
        return f"which fit best multiplied by {east:.2f} east and {north:.2f} north"


@dataclass(frozen=True)
class _MotionMisreading:
    """One possible misreading of the columns of proper motion.

    meaning : text with the names of the columns. remedy : template of :func:`naming`, with the side (1 or 2).
    corrected : displacements (m, 2) east and north after correction, given those before and cos δ (m,).
    """

    meaning: str
    remedy: str
    corrected: Callable[[FloatArray, FloatArray], FloatArray]

    def words(self, catalogue: Catalogue, side: int | str) -> tuple[str, Message]:
        """The meaning and the remedy, for a catalogue and its side (1, 2, or empty if it is the only one)."""
        ra, dec = ("" if column is None else column.name for column in catalogue.choice.motion[1:3])
        return f"{self.meaning.format(ra=ra, dec=dec)}: ", naming(self.remedy.format(ra=ra, dec=dec, side=side))


_MOTION_MISREADINGS = (
    _MotionMisreading(
        "as if {ra} did not contain cos(dec)",
        "multiply it by cos(dec)",
        lambda moved, cos_dec: moved * np.column_stack([cos_dec, np.ones_like(cos_dec)]),
    ),
    _MotionMisreading(
        "as if {ra} and {dec} were exchanged", "give {{pm{side}:'{dec},{ra}'}}", lambda moved, cos_dec: moved[:, ::-1]
    ),
    _MotionMisreading("as if {ra} had the other sign", "was it lost?", lambda moved, cos_dec: moved * [-1.0, 1.0]),
    _MotionMisreading("as if {dec} had the other sign", "was it lost?", lambda moved, cos_dec: moved * [1.0, -1.0]),
    _MotionMisreading(
        "as if {ra} and {dec} were in arcsec/yr, not mas/yr",
        "give the columns their unit, arcsec / yr",
        lambda moved, cos_dec: 1e3 * moved,
    ),
)


def _chi_square(residual: FloatArray, precision: FloatArray) -> float:
    return float(np.einsum("mv,mvw,mw->", residual, precision, residual))


def _questioned(first: Catalogue, second: Catalogue) -> int | None:
    """The side whose epoch the residuals test: the one with an assumed epoch, or the one without motions; or None."""
    assumed = [catalogue.choice.epoch.reason == "assumed" for catalogue in (first, second)]
    moving = [catalogue.has_motion for catalogue in (first, second)]
    if first.epoch_jyr is None or second.epoch_jyr is None or not any(moving):
        return None
    if assumed[0] != assumed[1]:
        return 1 if assumed[0] else 2
    if moving[0] != moving[1]:
        return 2 if moving[0] else 1
    return None


def _least_squares(
    design: FloatArray, residual: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Least squares: the (k,) parameters, their (k, k) covariance, and the decrease of χ² by all of them.

    design (m, 2, k), residual (m, 2), precision (m, 2, 2).
    """
    weighted = np.einsum("mvw,mwk->mvk", precision, design)
    information = np.einsum("mvk,mvl->kl", weighted, design) + 1e-12 * np.eye(design.shape[2])
    projection = np.einsum("mvk,mv->k", weighted, residual)
    solution = np.linalg.solve(information, projection)
    return solution, inverse(information), float(solution @ projection)


__all__ = ["MovedPairs", "Questioned", "epoch_doubt"]
