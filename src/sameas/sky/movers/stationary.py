"""Stationary sources: stars, galaxies and variable objects among the detections, found before movers are searched.

The tracks of the search serve, with one change: rates are 0. Whether the detections of such a track are rather those
of a slow mover, its rate by least squares decides, one detection of which may be an outlier: its density is that of a
rate of 0 measured with the error it has, against that of movers. How many of the tracks that stay within some errors of
0 are stationary is estimated from them all; what a track itself adds to that does not count for it.

What stands still also shows how far the exposures are off each other, and how large the errors of places really are.

What is fixed on the chip while the telescope is dithered, warm pixels and other defects, is found by
:func:`fixed_on_chip`. Between two exposures all of it moves by one vector on the sky, another one between the next two;
what moves for itself does not. From exposure to exposure the vector that most pairs of detections have is looked for. A
steady drift is not told from a common motion here (``Movers.alike``); frames have pixels that tell
(:mod:`sameas.sky.series`).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit, logsumexp

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.sky.movers.detections import Detections
from sameas.sky.movers.links import candidate_links, learn
from sameas.sky.movers.model import DEFAULT_TUNING, MotionModel, Surroundings, Tuning
from sameas.sky.movers.rates import SOLAR_SYSTEM, EclipticAxes, RateDensity
from sameas.sky.movers.tracks import compete, grow
from sameas.space import ARCSEC_PER_RADIAN

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
    counts : of the tracks that stay within some errors, how many stand still and how many move.
    offset_arcsec : (f, 2) east and north, how far each exposure is off the others; 0 where too little shows it.
    error_scale : so many times larger than quoted are the errors of places, 1 or more.
    """

    rows: BoolArray
    places: int
    counts: tuple[float, float]
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

    def probability(self, around: Surroundings, members: IntArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(k,) that tracks of mended detections, the members (k, S), are stationary."""
        return _probabilities(_Rates.of(around, members, tuning), self.counts)


def stationary_sources(detections: Detections, tuning: Tuning = DEFAULT_TUNING) -> Stationary:
    """The sources that are rather stationary than moving or of no object."""
    none = np.zeros((len(detections.frame_names), 2))
    found = Stationary(np.zeros(len(detections), bool), 0, _BEFORE, none, 1.0)
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
    members = found.members[likely]
    if first:
        offset, scale = _offsets_of_all(around, members)
    else:
        rates = _Rates.of(around, members, tuning)
        p = _probabilities(rates, _counts(rates))
        offset, scale = _judged(around, members[p > 0.5], np.zeros_like(before.offset_arcsec), straight=False)
    rates = _Rates.of(around, members, tuning, scale)
    counts = _counts(rates)
    at_rest = members[_probabilities(rates, counts) > 0.5]
    rows = np.zeros(n, bool)
    rows[at_rest[at_rest >= 0]] = True
    return Stationary(rows, len(at_rest), counts, before.offset_arcsec + offset, before.error_scale * scale)


@dataclass(frozen=True)
class _Rates:
    """What the rates of tracks (k,) say of whether they are stationary.

    log_ratio : ln of how much more probable the detections are if the rate is 0 than if it is a mover's. near : whether
    the rate is within some errors of 0.
    """

    log_ratio: FloatArray
    near: BoolArray

    @classmethod
    def of(cls, around: Surroundings, members: IntArray, tuning: Tuning, scale: float = 1.0) -> _Rates:
        """Those of members (k, S), errors being ``scale`` times as large; any one of them may be an outlier."""
        there = members >= 0
        rows = np.where(there, members, members[:, :1])
        origin = np.repeat(members[:, 0], members.shape[1])
        place = around.axes.offsets(origin, rows.ravel()).reshape(*members.shape, 2)
        minutes = around.minutes[rows]
        variance = scale**2 * 0.5 * np.trace(around.covariance[rows], axis1=2, axis2=3)
        reference = np.column_stack([around.reference[members[:, 0]], np.zeros(len(members))])
        fits = [_RateFit.of(place, minutes, np.where(there, variance, np.inf))]
        log_prior = [np.zeros(len(members))]
        # Of two detections none can be told to be the outlier.
        for column in range(members.shape[1]):
            wide = variance.copy()
            wide[:, column] *= tuning.outlier_scale**2
            fits.append(_RateFit.of(place, minutes, np.where(there, wide, np.inf)))
            possible = there[:, column] & (there.sum(axis=1) > 2)
            log_prior.append(np.where(possible, math.log(tuning.outlier / (1.0 - tuning.outlier)), -np.inf))
        at_rest = np.array([q + f.log_rest + f.log_stationary() for q, f in zip(log_prior, fits, strict=True)])
        moving = np.array([q + f.log_rest + f.log_moving(reference) for q, f in zip(log_prior, fits, strict=True)])
        best = np.maximum(at_rest, moving).argmax(axis=0)
        near = np.array([f.chi2 for f in fits])[best, np.arange(len(members))] < _WITHIN_SIGMAS**2
        return cls(logsumexp(at_rest, axis=0) - logsumexp(moving, axis=0), near)


@dataclass(frozen=True)
class _RateFit:
    """Straight motion fitted to tracks (k,) by weighted least squares.

    rate : (k, 2) arcsec/min on the ecliptic axes. variance : of each of its components. log_rest : ln of the density of
    what is left when place and rate are taken out.
    """

    rate: FloatArray
    variance: FloatArray
    log_rest: FloatArray

    @classmethod
    def of(cls, place: FloatArray, minutes: FloatArray, variance: FloatArray) -> _RateFit:
        """That of places (k, S, 2) at times (k, S); variance : (k, S) arcsec² per axis, infinite where none is."""
        weight = 1.0 / variance
        total = weight.sum(axis=1)
        off = minutes - ((weight * minutes).sum(axis=1) / total)[:, None]
        mean = np.einsum("ks,ksd->kd", weight, place) / total[:, None]
        lever = np.maximum((weight * off**2).sum(axis=1), 1e-300)
        rate = np.einsum("ks,ksd->kd", weight * off, place) / lever[:, None]
        left = place - mean[:, None] - off[..., None] * rate[:, None]
        chi2 = (weight * (left**2).sum(axis=2)).sum(axis=1)
        # In two dimensions the root of the determinant of each covariance is its variance per axis.
        roots = np.where(np.isfinite(variance), np.log(np.minimum(variance, 1e300)), 0.0).sum(axis=1)
        return cls(rate, 1.0 / lever, -0.5 * chi2 - roots - np.log(total) - np.log(lever))

    @property
    def chi2(self) -> FloatArray:
        """(k,) of the rate, in two dimensions, against 0."""
        return np.asarray((self.rate**2).sum(axis=1) / self.variance)

    def log_stationary(self) -> FloatArray:
        """(k,) ln of the density of the rate if it is 0."""
        return -0.5 * self.chi2 - np.log(2.0 * math.pi * self.variance)

    def log_moving(self, reference: FloatArray) -> FloatArray:
        """(k,) the same if it moves: evenly within some errors of 0, or closer where all are slow there.

        reference : (k, 2) rate of a circular orbit.
        """
        evenly = -np.log(math.pi * _WITHIN_SIGMAS**2 * self.variance)
        error = self.variance[:, None, None] * np.eye(2)
        return np.maximum(SOLAR_SYSTEM.log_density(self.rate - reference, error), evenly)


def _counts(rates: _Rates) -> tuple[float, float]:
    """How many of the tracks near no motion are stationary, and how many move, by expectation and maximisation."""
    log_ratio = rates.log_ratio[rates.near]
    stationary, moving = 0.5 * len(log_ratio) + _BEFORE[0], 0.5 * len(log_ratio) + _BEFORE[1]
    for _ in range(50):
        p = float(expit(log_ratio + math.log(stationary / moving)).sum())
        stationary, moving = p + _BEFORE[0], len(log_ratio) - p + _BEFORE[1]
    return stationary, moving


def _probabilities(rates: _Rates, counts: tuple[float, float]) -> FloatArray:
    """(k,) that tracks are stationary, by the counts of the others."""
    stationary, moving = counts
    own = rates.near * expit(rates.log_ratio + math.log(stationary / moving))
    others = np.maximum(stationary - own, _BEFORE[0]), np.maximum(moving - (rates.near - own), _BEFORE[1])
    return np.asarray(expit(rates.log_ratio + np.log(others[0] / others[1])))


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


#: Larger dithers are not looked for, arcsec; nor so large ones that more pairs than these would have to be looked at.
_FARTHEST_ARCSEC, _MOST_PAIRS = 60.0, 500_000
#: So many pairs of one vector, and so many times as many as chance makes by what is farther around, are a pattern.
_LEAST, _EXCESS = 8, 8.0


def fixed_on_chip(detections: Detections) -> BoolArray:
    """(n,) detections that are fixed on the chip; none where no three exposures show a pattern that is not a motion.

    detections : without stationary sources.
    """
    out = np.zeros(len(detections), bool)
    rows = [np.flatnonzero(detections.frame == k) for k in range(len(detections.frame_names))]
    shown = [k for k, mine in enumerate(rows) if len(mine) >= _LEAST]
    if len(shown) < 3:
        return out
    axes, width = detections.axes(), 3.0 * math.sqrt(2.0) * detections.typical_sigma_arcsec
    steps = {b: _common_step(axes, rows[a], rows[b], width) for a, b in itertools.pairwise(shown)}
    found = {b: step for b, step in steps.items() if step is not None}
    if len(found) < 2 or _one_motion(found, dict(zip(shown[1:], shown, strict=False)), detections.frame_mjd, width):
        return out
    place = np.zeros((len(rows), 2))
    for k in range(1, len(rows)):
        place[k] = place[k - 1] + found.get(k, np.zeros(2))
    chip = axes.directions(np.arange(len(detections)), -place[detections.frame])
    i, j = cKDTree(chip).query_pairs(width / ARCSEC_PER_RADIAN, output_type="ndarray").T
    moved = np.hypot(*(place[detections.frame[i]] - place[detections.frame[j]]).T) > width
    out[i[moved]] = out[j[moved]] = True
    return out


def _common_step(axes: EclipticAxes, first: IntArray, second: IntArray, width: float) -> FloatArray | None:
    """(2,) arcsec on the ecliptic axes from detections of one exposure to those of another that most pairs have.

    None where no more have it than chance makes.
    """
    trees = cKDTree(axes.unit[first]), cKDTree(axes.unit[second])
    farthest = _FARTHEST_ARCSEC
    while farthest > 4.0 * width:
        if trees[0].count_neighbors(trees[1], farthest / ARCSEC_PER_RADIAN) <= _MOST_PAIRS:
            break
        farthest *= 0.7
    pairs = trees[0].sparse_distance_matrix(trees[1], farthest / ARCSEC_PER_RADIAN, output_type="ndarray")
    if len(pairs) < _LEAST:
        return None
    step = axes.offsets(first[pairs["i"]], second[pairs["j"]])
    tree = cKDTree(step)
    near = tree.query_ball_point(step, width, return_length=True)
    best = int(near.argmax())
    around = len(tree.query_ball_point(step[best], 4.0 * width)) - near[best]
    if near[best] < _LEAST or near[best] < _EXCESS * around / 15.0:
        return None
    return np.median(step[tree.query_ball_point(step[best], width)], axis=0)


def _one_motion(found: dict[int, FloatArray], before: dict[int, int], mjd: FloatArray, width: float) -> bool:
    """Whether steps to some exposures, each from the one before, are those of one rate."""
    days = np.array([mjd[b] - mjd[before[b]] for b in found])
    step = np.array(list(found.values()))
    rate = (days[:, None] * step).sum(axis=0) / max(float((days**2).sum()), 1e-300)
    return bool((np.hypot(*(step - days[:, None] * rate).T) < 2.0 * width).all())
