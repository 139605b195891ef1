"""Stationary sources: stars, galaxies and variable objects among the detections, found before movers are searched.

The tracks of the search serve, with one change: rates are 0. Whether the detections of such a track are rather those
of a slow mover, the rate between its first and last one decides: its density is that of a rate of 0 measured with the
error it has, against that of movers. How many of the tracks stand still is estimated from them all.

What stands still also shows how far the exposures are off each other, and how large the errors of places really are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.sky.movers.detections import Detections
from sameas.sky.movers.links import candidate_links, learn, rates_of
from sameas.sky.movers.model import DEFAULT_TUNING, MotionModel, Surroundings, Tuning
from sameas.sky.movers.rates import SOLAR_SYSTEM, RateDensity, log_normal
from sameas.sky.movers.tracks import Tracks, compete, grow

#: Rates of what stands still, arcsec/min: what is less is no rate at all (1″ in a week).
_AT_REST = RateDensity.of([1.0], [(0.0, 0.0)], [(1e-4, 1e-4)])
#: Movers with rates within so many errors of none come with what stands still.
_WITHIN_SIGMAS = 5.0
#: Of tracks that stay within some errors so many stand still, and so many do not, before any is seen (chosen).
_BEFORE = (0.1, 0.3)
#: An exposure's offset, and the scale of the errors, are estimated from so many tracks or more.
_LEAST_JUDGED = 10
#: Searches at most, each with the offsets and errors that those before have shown.
_ROUNDS = 4


@dataclass(frozen=True)
class Stationary:
    """The stationary sources among n detections of f exposures.

    rows : (n,) which of them. places : of how many objects, each seen twice or more.
    share : of the tracks that stay within some errors, the part that stands still.
    offset_arcsec : (f, 2) east and north, how far each exposure is off the others; 0 where too little shows it.
    error_scale : so many times larger than quoted are the errors of places, 1 or more.
    """

    rows: BoolArray
    places: int
    share: float
    offset_arcsec: FloatArray
    error_scale: float

    def mended(self, detections: Detections) -> Detections:
        """All detections, their exposures' offsets removed and their errors scaled."""
        east, north = self.offset_arcsec[detections.frame].T / 3600.0
        # At the pole itself east is no direction.
        cos = np.maximum(np.cos(np.radians(detections.dec_deg)), 1e-6)
        return replace(
            detections, ra_deg=(detections.ra_deg - east / cos) % 360.0,
            dec_deg=np.clip(detections.dec_deg - north, -90.0, 90.0),
            covariance=detections.covariance * self.error_scale**2,
        )  # fmt: skip

    def rest(self, detections: Detections) -> Detections:
        """The detections that do not stand still, mended."""
        return self.mended(detections).some(np.flatnonzero(~self.rows))

    def probability(self, around: Surroundings, tracks: Tracks) -> FloatArray:
        """(k,) that tracks of mended detections stand still."""
        return np.asarray(expit(_log_ratio(around, tracks, 1.0) + math.log(self.share / (1.0 - self.share))))


def stationary_sources(detections: Detections, tuning: Tuning = DEFAULT_TUNING) -> Stationary:
    """The sources that are rather stationary than moving or of no object."""
    none = np.zeros((len(detections.frame_names), 2))
    found = Stationary(np.zeros(len(detections), bool), 0, 0.0, none, 1.0)
    typical = detections.typical_sigma_arcsec
    for turn in range(_ROUNDS):
        before = found
        found = _searched(before.mended(detections), before, turn == 0, tuning)
        changed = np.abs(found.offset_arcsec - before.offset_arcsec).max(initial=0.0)
        if changed < 0.2 * typical and found.error_scale < 1.1 * before.error_scale:
            break
    return found


def _searched(detections: Detections, before: Stationary, first: bool, tuning: Tuning) -> Stationary:
    """The stationary sources among detections that were mended already, and what they show in all."""
    n, around = len(detections), Surroundings.of(detections, tuning)
    here = replace(around, reference=np.zeros(n))
    # What stands still has few rivals: the second best ways through a star are those that pass over an exposure.
    tuning = replace(tuning, bend_arcsec_per_min2=0.0, least_log_ratio=DEFAULT_TUNING.least_log_ratio, tracks=6)
    model = MotionModel(rates=_AT_REST).for_bands(detections.bands, tuning)
    model = learn(here, model, tuning)
    model = replace(model, rates=_AT_REST, log_begin=model.log_odds)
    found = compete(grow(here, candidate_links(here, model, tuning), model, tuning), n, tuning)
    likely = np.flatnonzero(found.chosen & (found.shares(n)[0] > 0.5))
    tracks, members = found.tracks.only(likely), found.members[likely]
    if first:
        offset, scale = _offsets_of_all(around, members)
    else:
        p, _ = _probabilities(_log_ratio(around, tracks, 1.0))
        offset, scale = _judged(around, members[p > 0.5], np.zeros_like(before.offset_arcsec), straight=False)
    p, share = _probabilities(_log_ratio(around, tracks, scale))
    at_rest = members[p > 0.5]
    rows = np.zeros(n, bool)
    rows[at_rest[at_rest >= 0]] = True
    return Stationary(rows, len(at_rest), share, before.offset_arcsec + offset, before.error_scale * scale)


def _log_ratio(around: Surroundings, tracks: Tracks, scale: float) -> FloatArray:
    """(k,) ln of how much more probable the rate between a track's ends is if it stands still. scale : of the errors.

    Within some errors of no motion the rates of movers are spread evenly, or closer where all are slow.
    """
    i, j = tracks.first, tracks.last
    minutes = around.minutes[j] - around.minutes[i]
    offset = around.axes.offsets(i, j)
    relative, error = rates_of(around, i, j, minutes, offset)
    error = error * scale**2
    evenly = -np.log(math.pi * _WITHIN_SIGMAS**2 * np.sqrt(np.linalg.det(error)))
    moving = np.maximum(SOLAR_SYSTEM.log_density(relative, error), evenly)
    return np.asarray(log_normal(offset / minutes[:, None], error) - moving)


def _probabilities(log_ratio: FloatArray) -> tuple[FloatArray, float]:
    """(k,) probabilities of tracks to stand still, and the share that does, by expectation and maximisation."""
    share = 0.5
    for _ in range(50):
        p = expit(log_ratio + math.log(share / (1.0 - share)))
        share = float((p.sum() + _BEFORE[0]) / (len(p) + sum(_BEFORE)))
    return np.asarray(p), share


def _offsets_of_all(around: Surroundings, members: IntArray) -> tuple[FloatArray, float]:
    """The same as :func:`_judged` of tracks of which some move.

    What moves shows offsets too, but for those that grow evenly with time. Where it shows some larger than half an
    error, those that grow are as large: what most tracks show is removed, if it is less than three times that.
    """
    none = np.zeros((len(around.detections.frame_names), 2))
    offset, scale = _judged(around, members, none, straight=True)
    size = float(np.sqrt((offset**2).mean()))
    if size > 0.5 * around.detections.typical_sigma_arcsec:
        every, _ = _judged(around, members, offset, straight=False)
        if np.abs(every - offset).max() < 3.0 * size:
            return every, scale
    return offset, scale


def _judged(around: Surroundings, members: IntArray, offset: FloatArray, *, straight: bool) -> tuple[FloatArray, float]:
    """(f, 2) arcsec east and north of each exposure off the others, and how many times larger errors are than quoted.

    members : (k, S) detections of tracks, the median of whose residuals counts. offset : (f, 2) to begin with.
    straight : residuals from straight motion, or else from the mean place.
    """
    seen, offset = around.detections, offset.copy()
    lost = 2 if straight else 1
    members = members[(members >= 0).sum(axis=1) > lost]
    if len(members) < _LEAST_JUDGED:
        return offset, 1.0
    there = members >= 0
    rows = np.where(there, members, members[:, :1])
    origin = np.repeat(members[:, 0], members.shape[1])
    place = around.axes.to_equator(origin, around.axes.offsets(origin, rows.ravel())).reshape(*members.shape, 2)
    minutes, frame = around.minutes[rows], seen.frame[rows]
    for _ in range(10):
        off = _residuals(place - offset[frame], minutes, there, straight)
        for k in np.unique(frame[there]).tolist():
            mine = off[there & (frame == k)]
            if len(mine) >= _LEAST_JUDGED:
                offset[k] += np.median(mine, axis=0)
        offset -= offset.mean(axis=0)
    off = _residuals(place - offset[frame], minutes, there, straight)
    freedom = 2 * (there.sum(axis=1) - lost)
    variance = (there * 0.5 * np.trace(around.covariance[rows], axis1=2, axis2=3)).sum(axis=1) / there.sum(axis=1)
    chi2 = (off**2).sum(axis=(1, 2)) / (freedom * variance)
    # The median of χ² per degree of freedom f is about (1 − 2/9f)³ (Wilson & Hilferty 1931).
    return offset, max(1.0, math.sqrt(float(np.median(chi2 / (1.0 - 2.0 / (9.0 * freedom)) ** 3))))


def _residuals(place: FloatArray, minutes: FloatArray, there: BoolArray, straight: bool) -> FloatArray:
    """(k, S, 2) of places from the mean of their track, or from straight motion; 0 where there is none."""
    count = there.sum(axis=1)[:, None]
    off = np.where(
        there[..., None], place - (place * there[..., None]).sum(axis=1, keepdims=True) / count[..., None], 0.0
    )
    if straight:
        t = np.where(there, minutes - (minutes * there).sum(axis=1, keepdims=True) / count, 0.0)
        slope = np.einsum("ks,ksd->kd", t, off) / np.maximum((t**2).sum(axis=1), 1e-12)[:, None]
        off = off - t[..., None] * slope[:, None]
    return np.asarray(off)
