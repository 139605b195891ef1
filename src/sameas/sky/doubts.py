"""Doubts of a match: fields that do not meet, and an epoch that the residuals contradict.

Where fields do not meet, :func:`apart_doubts` looks for what would make them: hours taken for degrees, columns
exchanged.

With a wrong epoch (:func:`epoch_doubt`) residuals grow along the proper motions. The catalogue with motions μ was
carried to an epoch T. Where the other one was observed at T + δ, each pair misses what its object moves in δ years, −μ
δ, beside a common offset. Both are fitted by least squares.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import Argument, Message, naming
from sameas.gaussian import inverse
from sameas.records import Records
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import ColumnChoice, in_years
from sameas.sky.column_values import to_icrs
from sameas.sky.frame.tangent import directions_deg
from sameas.space import mean_direction, unit_vectors

#: Records that a field is judged by, at most: its outline moves by little with more.
_ENOUGH = 10_000
#: Radii below this, in degrees, count as this: of a catalogue of one row (chosen).
_LEAST_RADIUS_DEG = 0.05


@dataclass(frozen=True)
class _Field:
    """A circle on the sky that holds all records. centre (3,) : unit vector. radius_deg : to the farthest record."""

    centre: FloatArray
    radius_deg: float

    @classmethod
    def of(cls, position_deg: FloatArray) -> _Field:
        vectors = unit_vectors(*position_deg.T)
        centre = mean_direction(vectors)
        return cls(centre, max(float(_degrees(vectors @ centre).max()), _LEAST_RADIUS_DEG))

    def to(self, other: _Field) -> float:
        """Degrees from centre to centre."""
        return float(_degrees(self.centre @ other.centre))

    def __str__(self) -> str:
        lon, lat = directions_deg(self.centre)
        return f"within {self.radius_deg:.2g}° of RA {lon:.2f}°, Dec {lat:+.2f}°"


def _degrees(cosine: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def apart_doubts(first: Catalogue, second: Catalogue, one: Records, two: Records) -> tuple[str, ...]:
    """One line where no record of one catalogue lies in the field of the other, with a misreading that explains it.

    one, two : their records.
    """
    positions = [records.features[:: max(1, len(records) // _ENOUGH)] for records in (one, two)]
    fields = [_Field.of(position) for position in positions]
    if fields[0].to(fields[1]) <= fields[0].radius_deg + fields[1].radius_deg:
        return ()
    said = f"the fields lie apart: {first.name} {fields[0]}, {second.name} {fields[1]}"
    sides = (2, second, positions[1], fields[0], first), (1, first, positions[0], fields[1], second)
    for side, catalogue, position, field, other in sides:
        for misread in _MISREADINGS:
            if misread.fits(catalogue.choice, position):
                meant = _Field.of(misread.correct(position))
                if meant.to(field) <= max(meant.radius_deg, field.radius_deg):
                    of = f"of {catalogue.name} would lie in the field of {other.name}: "
                    ra, dec = catalogue.choice.ra.name, catalogue.choice.dec.name
                    return (
                        Message(f"{said}; {misread.meant.format(ra=ra, dec=dec)} {of}", misread.remedy(ra, dec, side)),
                    )
    return (f"{said}: do they show the same part of the sky?",)


@dataclass(frozen=True)
class _Misreading:
    """What a table may mean instead.

    fits : whether it may, by its columns and positions. correct : the positions if so. meant : in words.
    remedy : what to do, for the columns of right ascension and declination of a side.
    """

    fits: Callable[[ColumnChoice, FloatArray], bool]
    correct: Callable[[FloatArray], FloatArray]
    meant: str
    remedy: Callable[[str, str, int], str]


def _no_unit(choice: ColumnChoice) -> bool:
    return choice.frame == "icrs" and choice.ra.unit == "deg" and choice.ra.reason == "by convention"


def _of_galactic(position_deg: FloatArray) -> FloatArray:
    ra, dec, _ = to_icrs("galactic", *position_deg.T)
    return np.column_stack([ra, dec])


def _exchanged(position_deg: FloatArray) -> FloatArray:
    return np.column_stack([position_deg[:, 1], (position_deg[:, 0] + 180.0) % 360.0 - 180.0])


_MISREADINGS = (
    _Misreading(
        lambda choice, at: _no_unit(choice) and bool(at[:, 0].max() <= 24.0),
        lambda at: at * [15.0, 1.0],
        "in hours, {ra}",
        lambda ra, dec, side: f"give the column its unit, h, or call it '{ra} [h]'",
    ),
    _Misreading(
        lambda choice, at: _no_unit(choice) and bool(at[:, 0].max() <= 2.0 * np.pi),
        lambda at: np.degrees(at),
        "in radians, {ra} and {dec}",
        lambda ra, dec, side: f"give the columns their unit, rad, or call them '{ra} [rad]', '{dec} [rad]'",
    ),
    _Misreading(
        lambda choice, at: choice.ra.unit == "sexagesimal hours",
        lambda at: at / [15.0, 1.0],
        "in degrees instead of hours, {ra}",
        lambda ra, dec, side: "give the column its unit, deg",
    ),
    _Misreading(
        lambda choice, at: bool((np.abs(_exchanged(at)[:, 1]) <= 90.0).all()),
        _exchanged,
        "exchanged, {ra} and {dec}",
        lambda ra, dec, side: Message("give ", Argument(f"ra{side}", dec), " ", Argument(f"dec{side}", ra)),
    ),
    _Misreading(
        lambda choice, at: True,
        lambda at: at * [1.0, -1.0],
        "with the other sign, {dec}",
        lambda ra, dec, side: "were its signs lost?",
    ),
    _Misreading(
        lambda choice, at: choice.frame == "icrs",
        _of_galactic,
        "as galactic longitude and latitude, {ra} and {dec}",
        lambda ra, dec, side: "call them l and b",
    ),
)


@dataclass(frozen=True)
class EpochTuning:
    """From where an epoch is doubted; all chosen.

    least_p_pair : pairs less probable are not used; nor are those with residuals of more than ``largest_sigmas``.
    fewest, most_pairs : with fewer pairs nothing is said, of more a regular sample is used.
    significant_sigmas : what motion, and what an offset beside it, must explain. significant_years : of δ, at least.
    significant_share : the fastest twentieth of the objects moves by this part of its error in δ years, at least.
    """

    least_p_pair: float = 0.9
    largest_sigmas: float = 6.0
    fewest: int = 20
    most_pairs: int = 30_000
    significant_sigmas: float = 5.0
    significant_years: float = 0.3
    significant_share: float = 0.3


TUNING = EpochTuning()


def epoch_doubt(
    first: Catalogue,
    second: Catalogue,
    epoch_jyr: float | None,
    answer: Identification,
    scale: float,
    tuning: EpochTuning = TUNING,
) -> tuple[str, bool]:
    """A doubt of the epoch that one catalogue was taken to have, empty where there is none, and whether it explains an
    offset of the pairs too.

    epoch_jyr : that both were brought to. scale : residuals over quoted errors.
    """
    side = _questioned(first, second)
    if side is None or epoch_jyr is None:
        return "", False
    questioned, other = (first, second) if side == 1 else (second, first)
    carried = questioned if questioned.has_motion else other
    records, at = (answer.first, answer.pairs.i) if carried is first else (answer.second, answer.pairs.j)
    use = np.flatnonzero(answer.p_pair > tuning.least_p_pair)
    use = use[:: -(-len(use) // tuning.most_pairs) or 1]
    of = carried.astrometry[records.rows[at[use]]]
    motion = 1e-3 * np.column_stack([of.pm_ra_mas_per_yr, of.pm_dec_mas_per_yr])
    # Residuals are first minus second; what was carried from a later epoch than was assumed was carried too far, what
    # was carried to an earlier one than it should, not far enough.
    sign = (1.0 if carried is first else -1.0) * (1.0 if carried is questioned else -1.0)
    residual, precision = answer.pairs.residual[use], inverse(answer.pairs.covariance_of(use)) / scale**2
    near = np.einsum("mv,mvw,mw->m", residual, precision, residual) < tuning.largest_sigmas**2
    known = near & np.isfinite(motion).all(axis=1)
    if np.count_nonzero(known) < tuning.fewest:
        return "", False
    motion, residual, precision = sign * motion[known], residual[known], precision[known]
    slope = np.concatenate([motion[:, :, None], np.broadcast_to(np.eye(2), (len(motion), 2, 2))], axis=2)
    years, error, gain = _fitted(slope, residual, precision)
    alone, error_alone, gain_alone = _fitted(slope[:, :, :1], residual, precision)
    least = tuning.significant_sigmas**2
    fast = np.sqrt(np.einsum("mv,mvw,mw->m", motion, precision, motion))
    if abs(years) < max(tuning.significant_years, tuning.significant_sigmas * error):
        return "", False
    if np.quantile(fast, 0.95) * abs(years) < tuning.significant_share:
        return "", False
    explains = gain - gain_alone < least
    years, error = (alone, error_alone) if explains else (years, error)
    was = questioned.epoch_jyr
    assert was is not None
    decimals = max(0, math.ceil(-math.log10(error)))
    text = (
        f"residuals follow the proper motions of {carried.name}, as if the epoch of {questioned.name} were "
        f"{was + years:.{decimals}f} ± {error:.{decimals}f}, not {in_years(was)}: "
    )
    return Message(text, naming(f"give {{epoch{side}:YEAR}}")), explains


def _questioned(first: Catalogue, second: Catalogue) -> int | None:
    """Whose epoch residuals can tell: of the catalogue whose epoch was assumed, or of the one without motions."""
    assumed = [catalogue.choice.epoch.reason == "assumed" for catalogue in (first, second)]
    moving = [catalogue.has_motion for catalogue in (first, second)]
    if first.epoch_jyr is None or second.epoch_jyr is None or not any(moving):
        return None
    if assumed[0] != assumed[1]:
        return 1 if assumed[0] else 2
    if moving[0] != moving[1]:
        return 2 if moving[0] else 1
    return None


def _fitted(slope: FloatArray, residual: FloatArray, precision: FloatArray) -> tuple[float, float, float]:
    """The first of the parameters with its standard error, and by how much all of them lower χ².

    slope (m, 2, k), residual (m, 2), precision (m, 2, 2).
    """
    pull = np.einsum("mvw,mwk->mvk", precision, slope)
    information = np.einsum("mvk,mvl->kl", pull, slope) + 1e-12 * np.eye(slope.shape[2])
    force = np.einsum("mvk,mv->k", pull, residual)
    found = np.linalg.solve(information, force)
    return float(found[0]), math.sqrt(float(np.linalg.inv(information)[0, 0])), float(found @ force)


__all__ = ["EpochTuning", "epoch_doubt"]
