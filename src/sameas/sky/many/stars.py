"""Stars: position and motion of one star from several catalogues, each at its own epoch.

A star is at x at a reference epoch T and moves by v. A record of epoch t without a motion measures z = x + (t − T) v;
one with a motion measures both, x and v, carried to T. With Λ, η and χ² summed over the records of a set as in
:mod:`sameas.many.joint`, on the tangent plane at the set's first record, the density of their positions is

    ln J = Σ ln norm + 2 ln 2π − ½ ln|Λ| − ½ χ²,

less the same of the motions alone where two records or more have one: the density is that of the positions, given one
motion, as in :func:`sameas.sky.crossmatch.match`. Where no record of a set has a motion, v is normal about 0 with the
standard deviation that the catalogues were given for unknown motions. So a star of large motion is identified in
catalogues without motions wherever one catalogue has it, in both directions of time; a common epoch cannot do that.
For two catalogues J is the density of the residual at the common epoch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.gaussian import LOG_2PI, InformationSum, inverse, log_density, propagated
from sameas.many.joint import NO_RECORD
from sameas.records import Records
from sameas.representation import in_short
from sameas.sky import column_values
from sameas.sky.catalogue import Catalogue
from sameas.sky.motion import propagate
from sameas.space import displaced, on_axes_of

#: Sets worked on at a time, which bounds the memory.
CHUNK = 100_000
#: Stands for the unknown motion of records at the reference epoch, whose position it does not change.
_STILL_ARCSEC_PER_YR = 1.0
#: Position and proper motion among the six parameters of an :class:`~sameas.sky.motion.Astrometry`.
_PLACE_AND_MOTION = np.array([0, 1, 3, 4])


@in_short
@dataclass(frozen=True)
class AstrometricRecords:
    """Position and motion of one catalogue's usable records; lengths in arcsec, times in years, axes east, north.

    Attributes
    ----------
    direction : (n, 2) right ascension and declination, degrees: at the reference epoch where the motion is known, at
        the record's own epoch where not.
    motion : (n, 2) proper motion, 0 where it is not known.
    precision : (n, 4, 4) of (position, motion) at the reference epoch. log_norm : (n,) ln of their normal's factor.
    moving : (n,) whether the motion is known.
    motion_precision : (n, 2, 2), 0 where it is not known. motion_log_norm : (n,) the same of the motion alone.
    unknown_motion : (n,) standard deviation of a motion that is not known.
    """

    direction: FloatArray
    motion: FloatArray
    precision: FloatArray
    log_norm: FloatArray
    moving: BoolArray
    motion_precision: FloatArray
    motion_log_norm: FloatArray
    unknown_motion: FloatArray

    def __len__(self) -> int:
        return len(self.direction)

    def at(self, rows: IntArray) -> AstrometricRecords:
        """Some of the records."""
        return AstrometricRecords(**{name: values[rows] for name, values in vars(self).items()})

    @classmethod
    def of(cls, catalogue: Catalogue, records: Records, epoch_jyr: float | None) -> AstrometricRecords:
        """The ``records`` of a catalogue; ``epoch_jyr`` is None where nothing moves."""
        part = catalogue.astrometry[records.rows]
        covariance = 1e-6 * part.covariance[:, :2, :2]
        direction, motion = np.column_stack([part.ra_deg, part.dec_deg]), np.zeros((len(records), 2))
        span = np.zeros(len(records)) if epoch_jyr is None else part.epoch_jyr - epoch_jyr
        precision_2 = inverse(covariance)
        # z = (1, span) (x, v)
        precision = np.empty((len(records), 4, 4))
        precision[:, :2, :2] = precision_2
        precision[:, :2, 2:] = precision[:, 2:, :2] = span[:, None, None] * precision_2
        precision[:, 2:, 2:] = span[:, None, None] ** 2 * precision_2
        log_norm = _log_norm(covariance)
        moving = np.zeros(len(records), bool) if epoch_jyr is None else moving_rows(catalogue)[records.rows]
        motion_precision, motion_log_norm = np.zeros((len(records), 2, 2)), np.zeros(len(records))
        k = np.flatnonzero(moving)
        if len(k):
            carried = propagate(part[k], float(epoch_jyr or 0.0))
            both = 1e-6 * carried.covariance[:, _PLACE_AND_MOTION[:, None], _PLACE_AND_MOTION]
            direction[k] = np.column_stack([carried.ra_deg, carried.dec_deg])
            motion[k] = 1e-3 * np.column_stack([carried.pm_ra_mas_per_yr, carried.pm_dec_mas_per_yr])
            precision[k], log_norm[k] = inverse(both), _log_norm(both)
            alone = both[:, 2:, 2:]
            motion_precision[k], motion_log_norm[k] = inverse(alone), _log_norm(alone)
        unknown = 1e-3 * np.sqrt(part.covariance[:, 3, 3])
        unknown = np.where(moving | (unknown <= 0.0) | (epoch_jyr is None), _STILL_ARCSEC_PER_YR, unknown)
        return cls(direction, motion, precision, log_norm, moving, motion_precision, motion_log_norm, unknown)


class AstrometricFit(NamedTuple):
    """Per set (k,): ``log_peak`` ln J without its −½ χ², ``chi_sq`` χ² of 2 (size − 1) degrees of freedom.

    direction, motion : (k, 2) of the star at the reference epoch. covariance : (k, 4, 4) of both.
    has_residual : whether χ² is one of errors; where no record has a motion and their epochs differ, it is one of
        motions.
    """

    log_peak: FloatArray
    chi_sq: FloatArray
    direction: FloatArray
    motion: FloatArray
    covariance: FloatArray
    has_residual: BoolArray


def fitted(astrometric: tuple[AstrometricRecords, ...], sets: NDArray[np.integer]) -> AstrometricFit:
    """The star of each of the ``sets`` (k, catalogues) of positions of records, NO_RECORD for none; none is empty."""
    parts = [_fitted(astrometric, sets[low : low + CHUNK]) for low in range(0, max(len(sets), 1), CHUNK)]
    return (
        parts[0]
        if len(parts) == 1
        else AstrometricFit(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    )


def _fitted(astrometric: tuple[AstrometricRecords, ...], sets: NDArray[np.integer]) -> AstrometricFit:
    anchor = _anchors(astrometric, sets)
    whole, motions = InformationSum.of(len(sets), 4), InformationSum.of(len(sets), 2)
    moving, spread = np.zeros(len(sets), np.int64), np.zeros(len(sets))
    for s, catalogue in enumerate(astrometric):
        k = np.flatnonzero(sets[:, s] != NO_RECORD)
        members = catalogue.at(sets[k, s])
        offset, rotation = on_axes_of(anchor[k], members.direction)
        velocity = np.einsum("kvw,kw->kv", rotation, members.motion)
        axes = np.zeros((len(k), 4, 4))
        axes[:, :2, :2] = axes[:, 2:, 2:] = rotation
        whole.add(k, np.column_stack([offset, velocity]), propagated(axes, members.precision), members.log_norm)
        motions.add(k, velocity, propagated(rotation, members.motion_precision), members.motion_log_norm)
        moving[k] += members.moving
        spread[k] = np.maximum(spread[k], np.where(members.moving, 0.0, members.unknown_motion))
    still = np.flatnonzero(moving == 0)
    open_motion = np.zeros((len(still), 4, 4))
    open_motion[:, [2, 3], [2, 3]] = 1.0 / spread[still, None] ** 2
    whole.add(still, np.zeros((len(still), 4)), open_motion, -LOG_2PI - 2.0 * np.log(spread[still]))
    log_peak, star = whole.log_peak(), whole.gaussian()
    chi_sq = whole.chi_sq(star)
    has_residual = (moving > 0) | ~whole.information[:, :2, 2:].any(axis=(1, 2))
    several = np.flatnonzero(moving > 1)
    if len(several):
        known = motions.at(several)
        log_peak[several] -= known.log_peak()
        chi_sq[several] -= known.chi_sq(known.gaussian())
    return AstrometricFit(
        log_peak,
        np.maximum(chi_sq, 0.0),
        displaced(anchor, star.mean[:, :2]),
        star.mean[:, 2:],
        star.covariance,
        has_residual,
    )


def _anchors(astrometric: tuple[AstrometricRecords, ...], sets: NDArray[np.integer]) -> FloatArray:
    """(k, 2) the direction of each set's first record."""
    at = np.full((len(sets), 2), np.nan)
    for s in reversed(range(len(astrometric))):
        here = sets[:, s] != NO_RECORD
        at[here] = astrometric[s].direction[sets[here, s]]
    return at


def _log_norm(covariance: FloatArray) -> FloatArray:
    return log_density(np.zeros(covariance.shape[1]), covariance)


def moving_rows(catalogue: Catalogue) -> BoolArray:
    """(n,) the rows of the table that have a proper motion."""
    known = np.ones(len(catalogue), bool)
    for column in catalogue.choice.motion[1:3]:
        if column is None:
            return np.zeros(len(catalogue), bool)
        known &= np.isfinite(column_values.numbers(catalogue.table, column.name, catalogue.name))
    return known
