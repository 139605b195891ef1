"""Stationary sources: stars, galaxies and variables among the detections, found before the search for movers.

The tracks of the search are used, with all rates 0. Whether such a track is a slow mover instead is decided by its
least-squares rate, with at most one outlier among its detections: the likelihood of the measured rate if the true one
is 0, against that of movers. The numbers of stationary and moving tracks within a few errors of 0 are estimated from
all of them; a track's own contribution is excluded from its probability.

Stationary sources also give the offsets between the exposures and the scale of the position errors.

Defects fixed on the chip of a dithered telescope, such as warm pixels, are found by :func:`fixed_on_chip`: between two
exposures they all move by one vector on the sky, a different one for each step; movers do not. For each step the vector
common to most pairs of detections is searched. A steady drift cannot be distinguished from a common motion here (see
``Movers.same_rate``); with frames, pixels can (:mod:`sameas.sky.series`).
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
from sameas.sky.movers.model import DEFAULT_TUNING, OUTLIER, OUTLIER_SCALE, MotionModel, Surroundings, Tuning
from sameas.sky.movers.rates import SOLAR_SYSTEM, EclipticAxes, RateDensity
from sameas.sky.movers.tracks import compete, grow
from sameas.space import ARCSEC_PER_RADIAN

#: Rate density of stationary sources: 1σ of 1e-4 arcsec/min, 1″ in a week.
_AT_REST = RateDensity.of([1.0], [(0.0, 0.0)], [(1e-4, 1e-4)])

WITHIN_SIGMAS = 5.0  # tracks with rates within this many errors of 0 are counted as stationary or slow
PRIOR_COUNTS = (0.1, 0.3)  # prior counts of stationary and of moving tracks among these
LEAST_TRACKS = 10  # minimum number of tracks for the offset of an exposure and the error scale
SEARCHES = 4  # maximum number of searches, each with the offsets and error scale of the previous one
#: Maximum dither, and maximum number of pairs that are searched for one.
FARTHEST_ARCSEC, MOST_PAIRS = 60.0, 500_000
#: Minimum number of pairs with a common vector, absolute and as a multiple of the chance number.
LEAST_PAIRS, EXCESS = 8, 8.0
#: Maximum number of vectors that are tried in one cell: a thousand detections at one place have a million pairs, and
#: counting the neighbours of each took half of the search's time.
MOST_TRIED = 100


@dataclass(frozen=True)
class Stationary:
    """The stationary sources among n detections of f exposures.

    rows : (n,) mask of their detections. places : number of objects, with two detections or more each.
    counts : numbers of stationary and moving tracks with rates within a few errors of 0.
    offset_arcsec : (f, 2) offset of each exposure, east and north; 0 where too few tracks show it.
    error_scale : ratio of true to quoted position errors, at least 1.
    """

    rows: BoolArray
    places: int
    counts: tuple[float, float]
    offset_arcsec: FloatArray
    error_scale: float

    def corrected(self, detections: Detections) -> Detections:
        """All detections, with the offsets of their exposures removed and their errors scaled."""
        east, north = self.offset_arcsec[detections.frame].T / 3600.0
        # At the pole east is undefined.
        cos = np.maximum(np.cos(np.radians(detections.dec_deg)), 1e-6)
        return replace(
            detections, ra_deg=(detections.ra_deg - east / cos) % 360.0,
            dec_deg=np.clip(detections.dec_deg - north, -90.0, 90.0),
            covariance=detections.covariance * self.error_scale**2,
        )  # fmt: skip

    def rest(self, detections: Detections) -> Detections:
        """The other detections, corrected."""
        return self.corrected(detections).some(np.flatnonzero(~self.rows))

    def probability(self, around: Surroundings, members: IntArray) -> FloatArray:
        """(k,) probability that tracks are stationary. members : (k, S), rows of corrected detections."""
        return _probabilities(_Rates.of(around, members), self.counts)


def stationary_sources(detections: Detections, tuning: Tuning) -> Stationary:
    """The sources that are more probably stationary than moving or unrelated."""
    no_offset = np.zeros((len(detections.frame_names), 2))
    sources = Stationary(np.zeros(len(detections), bool), 0, PRIOR_COUNTS, no_offset, 1.0)
    typical = detections.typical_sigma_arcsec

    for iteration in range(SEARCHES):
        previous = sources
        sources = _searched(previous.corrected(detections), previous, iteration == 0, tuning)
        changed = np.abs(sources.offset_arcsec - previous.offset_arcsec).max(initial=0.0)
        if changed < 0.2 * typical and sources.error_scale < 1.1 * previous.error_scale:
            break
    return sources


def _searched(detections: Detections, previous: Stationary, first: bool, tuning: Tuning) -> Stationary:
    """The stationary sources among corrected detections, with the accumulated offsets and error scale."""
    n, around = len(detections), Surroundings.of(detections, tuning)
    # Stationary tracks have few alternatives: the second best ones through a star skip an exposure.
    straight = replace(tuning, bend_arcsec_per_min2=0.0, min_log_ratio=DEFAULT_TUNING.min_log_ratio, tracks=6)
    at_rest = replace(around, reference=np.zeros(n), tuning=straight)
    model = MotionModel(rates=_AT_REST).for_bands(detections.bands)
    model = learn(at_rest, model)
    model = replace(model, rates=_AT_REST, log_begin=model.log_odds)
    competition = compete(grow(at_rest, candidate_links(at_rest, model), model), n, tuning)
    likely = np.flatnonzero(competition.chosen & (competition.shares(n)[0] > 0.5))
    members = competition.members[likely]
    if first:
        offset, scale = _robust_offsets(around, members)
    else:
        rates = _Rates.of(around, members)
        p = _probabilities(rates, _counts(rates))
        no_offset = np.zeros_like(previous.offset_arcsec)
        offset, scale = _fitted_offsets(around, members[p > 0.5], no_offset, straight=False)
    rates = _Rates.of(around, members, scale)
    counts = _counts(rates)
    stationary = members[_probabilities(rates, counts) > 0.5]
    rows = np.zeros(n, bool)
    rows[stationary[stationary >= 0]] = True
    return Stationary(rows, len(stationary), counts, previous.offset_arcsec + offset, previous.error_scale * scale)


@dataclass(frozen=True)
class _Rates:
    """Evidence of the rates of tracks (k,) on whether they are stationary.

    log_ratio : ln likelihood ratio of rate 0 against the rate of a mover. near : mask of the rates within a few errors
    of 0.
    """

    log_ratio: FloatArray
    near: BoolArray

    @classmethod
    def of(cls, around: Surroundings, members: IntArray, scale: float = 1.0) -> _Rates:
        """The evidence of tracks with members (k, S), errors multiplied by ``scale``; one member may be an outlier."""
        present = members >= 0
        rows = np.where(present, members, members[:, :1])
        origin = np.repeat(members[:, 0], members.shape[1])
        position = around.axes.offsets(origin, rows.ravel()).reshape(*members.shape, 2)
        minutes = around.minutes[rows]
        variance = scale**2 * 0.5 * np.trace(around.covariance[rows], axis1=2, axis2=3)
        reference = np.column_stack([around.reference[members[:, 0]], np.zeros(len(members))])
        fits = [_RateFit.of(position, minutes, np.where(present, variance, np.inf))]
        log_prior = [np.zeros(len(members))]
        # With two detections an outlier cannot be identified.
        for column in range(members.shape[1]):
            outlier_variance = variance.copy()
            outlier_variance[:, column] *= OUTLIER_SCALE**2
            fits.append(_RateFit.of(position, minutes, np.where(present, outlier_variance, np.inf)))
            possible = present[:, column] & (present.sum(axis=1) > 2)
            log_prior.append(np.where(possible, math.log(OUTLIER / (1.0 - OUTLIER)), -np.inf))
        at_rest = np.array([q + f.log_residual + f.log_stationary() for q, f in zip(log_prior, fits, strict=True)])
        moving = np.array(
            [q + f.log_residual + f.log_moving(reference, WITHIN_SIGMAS) for q, f in zip(log_prior, fits, strict=True)]
        )
        best = np.maximum(at_rest, moving).argmax(axis=0)
        near = np.array([f.chi2 for f in fits])[best, np.arange(len(members))] < WITHIN_SIGMAS**2
        return cls(logsumexp(at_rest, axis=0) - logsumexp(moving, axis=0), near)


@dataclass(frozen=True)
class _RateFit:
    """Linear motion fitted to tracks (k,) by weighted least squares.

    rate : (k, 2) arcsec/min on the ecliptic axes. variance : (k,) of each component. log_residual : ln of the density
    of the residuals, with position and rate marginalised.
    """

    rate: FloatArray
    variance: FloatArray
    log_residual: FloatArray

    @classmethod
    def of(cls, position: FloatArray, minutes: FloatArray, variance: FloatArray) -> _RateFit:
        """The fit to positions (k, S, 2) at times (k, S). variance : (k, S) arcsec² per axis, infinite for padding."""
        weight = 1.0 / variance
        total = weight.sum(axis=1)
        minutes_off = minutes - ((weight * minutes).sum(axis=1) / total)[:, None]
        mean = np.einsum("ks,ksd->kd", weight, position) / total[:, None]
        spread = np.maximum((weight * minutes_off**2).sum(axis=1), 1e-300)
        rate = np.einsum("ks,ksd->kd", weight * minutes_off, position) / spread[:, None]
        residual = position - mean[:, None] - minutes_off[..., None] * rate[:, None]
        chi2 = (weight * (residual**2).sum(axis=2)).sum(axis=1)
        # In two dimensions the root of the determinant of a covariance is its variance per axis.
        log_variances = np.where(np.isfinite(variance), np.log(np.minimum(variance, 1e300)), 0.0).sum(axis=1)
        return cls(rate, 1.0 / spread, -0.5 * chi2 - log_variances - np.log(total) - np.log(spread))

    @property
    def chi2(self) -> FloatArray:
        """(k,) χ² of the rate against 0, two degrees of freedom."""
        return np.asarray((self.rate**2).sum(axis=1) / self.variance)

    def log_stationary(self) -> FloatArray:
        """(k,) ln of the density of the measured rate if the true one is 0."""
        return -0.5 * self.chi2 - np.log(2.0 * math.pi * self.variance)

    def log_moving(self, reference: FloatArray, within_sigmas: float) -> FloatArray:
        """(k,) the same for movers: uniform within a few errors of 0, or that of the Solar System if larger.

        reference : (k, 2) rate of a circular orbit. within_sigmas : number of these errors.
        """
        uniform = -np.log(math.pi * within_sigmas**2 * self.variance)
        error = self.variance[:, None, None] * np.eye(2)
        return np.maximum(SOLAR_SYSTEM.log_density(self.rate - reference, error), uniform)


def _counts(rates: _Rates) -> tuple[float, float]:
    """Numbers of stationary and of moving tracks with rates near 0, by EM."""
    log_ratio = rates.log_ratio[rates.near]
    stationary, moving = (0.5 * len(log_ratio) + PRIOR_COUNTS[0], 0.5 * len(log_ratio) + PRIOR_COUNTS[1])
    for _ in range(50):
        p = float(expit(log_ratio + math.log(stationary / moving)).sum())
        stationary, moving = (p + PRIOR_COUNTS[0], len(log_ratio) - p + PRIOR_COUNTS[1])
    return stationary, moving


def _probabilities(rates: _Rates, counts: tuple[float, float]) -> FloatArray:
    """(k,) probability that tracks are stationary, with counts that exclude the track itself."""
    stationary, moving = counts
    own = rates.near * expit(rates.log_ratio + math.log(stationary / moving))
    others = (np.maximum(stationary - own, PRIOR_COUNTS[0]), np.maximum(moving - (rates.near - own), PRIOR_COUNTS[1]))
    return np.asarray(expit(rates.log_ratio + np.log(others[0] / others[1])))


def _robust_offsets(around: Surroundings, members: IntArray) -> tuple[FloatArray, float]:
    """Offsets and error scale as :func:`_fitted_offsets`, from tracks of which some move.

    Residuals from linear motion show all offsets except a linear drift, for movers too. If these exceed half an error,
    a drift of similar size is expected: the median residuals from the mean positions are used, if they change the
    offsets by less than three times this size.
    """
    no_offset = np.zeros((len(around.detections.frame_names), 2))
    offset, scale = _fitted_offsets(around, members, no_offset, straight=True)
    size = float(np.sqrt((offset**2).mean()))
    if size > 0.5 * around.detections.typical_sigma_arcsec:
        from_means, _ = _fitted_offsets(around, members, offset, straight=False)
        if np.abs(from_means - offset).max() < 3.0 * size:
            return from_means, scale
    return offset, scale


def _fitted_offsets(
    around: Surroundings, members: IntArray, offset: FloatArray, *, straight: bool
) -> tuple[FloatArray, float]:
    """(f, 2) offset of each exposure, arcsec east and north, and the ratio of true to quoted errors.

    members : (k, S) detections of tracks; medians of their residuals are used. offset : (f, 2) initial values.
    straight : residuals from linear motion, else from the mean position.
    """
    detections, offset, least_tracks = around.detections, offset.copy(), LEAST_TRACKS
    parameters = 2 if straight else 1
    members = members[(members >= 0).sum(axis=1) > parameters]
    if len(members) < least_tracks:
        return offset, 1.0
    present = members >= 0
    rows = np.where(present, members, members[:, :1])
    origin = np.repeat(members[:, 0], members.shape[1])
    position = around.axes.to_equator(origin, around.axes.offsets(origin, rows.ravel())).reshape(*members.shape, 2)
    minutes, frame = around.minutes[rows], detections.frame[rows]
    for _ in range(10):
        residual = _residuals(position - offset[frame], minutes, present, straight)
        for k in np.unique(frame[present]).tolist():
            of_exposure = residual[present & (frame == k)]
            if len(of_exposure) >= least_tracks:
                offset[k] += np.median(of_exposure, axis=0)
        offset -= offset.mean(axis=0)
    residual = _residuals(position - offset[frame], minutes, present, straight)
    freedom = 2 * (present.sum(axis=1) - parameters)
    variance = (present * 0.5 * np.trace(around.covariance[rows], axis1=2, axis2=3)).sum(axis=1) / present.sum(axis=1)
    chi2 = (residual**2).sum(axis=(1, 2)) / (freedom * variance)
    # The median of χ² per degree of freedom f is about (1 − 2/9f)³ (Wilson & Hilferty 1931).
    return offset, max(1.0, math.sqrt(float(np.median(chi2 / (1.0 - 2.0 / (9.0 * freedom)) ** 3))))


def _residuals(position: FloatArray, minutes: FloatArray, present: BoolArray, straight: bool) -> FloatArray:
    """(k, S, 2) residuals of positions from the mean of their track, or from linear motion; 0 for padding."""
    count = present.sum(axis=1)[:, None]
    residual = np.where(
        present[..., None],
        position - (position * present[..., None]).sum(axis=1, keepdims=True) / count[..., None],
        0.0,
    )
    if straight:
        t = np.where(present, minutes - (minutes * present).sum(axis=1, keepdims=True) / count, 0.0)
        slope = np.einsum("ks,ksd->kd", t, residual) / np.maximum((t**2).sum(axis=1), 1e-12)[:, None]
        residual = residual - t[..., None] * slope[:, None]
    return np.asarray(residual)


def fixed_on_chip(detections: Detections) -> BoolArray:
    """(n,) mask of the detections fixed on the chip; empty without a pattern in three exposures that is not a motion.

    detections : without stationary sources.
    """
    fixed = np.zeros(len(detections), bool)
    rows = [np.flatnonzero(detections.frame == k) for k in range(len(detections.frame_names))]
    usable = [k for k, of_exposure in enumerate(rows) if len(of_exposure) >= LEAST_PAIRS]
    if len(usable) < 3:
        return fixed
    axes, width = detections.axes(), 3.0 * math.sqrt(2.0) * detections.typical_sigma_arcsec
    steps = {b: _common_step(axes, rows[a], rows[b], width) for a, b in itertools.pairwise(usable)}
    common_steps = {b: step for b, step in steps.items() if step is not None}
    previous = dict(zip(usable[1:], usable, strict=False))
    if len(common_steps) < 2 or _one_motion(common_steps, previous, detections.frame_mjd, width):
        return fixed
    dither = np.zeros((len(rows), 2))
    for k in range(1, len(rows)):
        dither[k] = dither[k - 1] + common_steps.get(k, np.zeros(2))
    on_chip = axes.directions(np.arange(len(detections)), -dither[detections.frame])
    i, j = cKDTree(on_chip).query_pairs(width / ARCSEC_PER_RADIAN, output_type="ndarray").T
    dithered = np.hypot(*(dither[detections.frame[i]] - dither[detections.frame[j]]).T) > width
    fixed[i[dithered]] = fixed[j[dithered]] = True
    return fixed


def _common_step(axes: EclipticAxes, first: IntArray, second: IntArray, width: float) -> FloatArray | None:
    """(2,) most common vector from detections of one exposure to those of another, arcsec on the ecliptic axes.

    None if it is not more common than by chance.
    """
    trees = cKDTree(axes.unit[first]), cKDTree(axes.unit[second])
    farthest = FARTHEST_ARCSEC
    while farthest > 4.0 * width:
        if trees[0].count_neighbors(trees[1], farthest / ARCSEC_PER_RADIAN) <= MOST_PAIRS:
            break
        farthest *= 0.7
    pairs = trees[0].sparse_distance_matrix(trees[1], farthest / ARCSEC_PER_RADIAN, output_type="ndarray")
    if len(pairs) < LEAST_PAIRS:
        return None
    step = axes.offsets(first[pairs["i"]], second[pairs["j"]])
    tree, tried = cKDTree(step), thinned(step, 0.5 * width, MOST_TRIED)
    near = tree.query_ball_point(step[tried], width, return_length=True)
    best, most = step[tried[near.argmax()]], int(near.max())
    around = tree.query_ball_point(best, 4.0 * width, return_length=True) - most
    if most < LEAST_PAIRS or most < EXCESS * around / 15.0:
        return None
    return np.median(step[tree.query_ball_point(best, width)], axis=0)


def thinned(step: FloatArray, side: float, most_tried: int) -> IntArray:
    """Rows of the vectors (n, 2), ascending: all, or ``most_tried`` evenly chosen in a cell of more."""
    column, row = np.floor((step - step.min(axis=0)) / side).astype(np.int64).T
    cell = column * (int(row.max()) + 1) + row
    order = np.argsort(cell, kind="stable")
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    count = np.diff(first, append=len(cell))
    rank = np.arange(len(cell)) - np.repeat(first, count)
    return np.sort(order[rank % np.repeat(-(-count // most_tried), count) == 0])


def _one_motion(steps: dict[int, FloatArray], previous: dict[int, int], mjd: FloatArray, width: float) -> bool:
    """Whether the steps to exposures from their previous ones agree with one constant rate."""
    days = np.array([mjd[b] - mjd[previous[b]] for b in steps])
    step = np.array(list(steps.values()))
    rate = (days[:, None] * step).sum(axis=0) / max(float((days**2).sum()), 1e-300)
    return bool((np.hypot(*(step - days[:, None] * rate).T) < 2.0 * width).all())
