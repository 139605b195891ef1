"""The search: from detections to tracklets, one line a stage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError, naming
from sameas.representation import in_short
from sameas.sky.movers.detections import Detections, TrailRates
from sameas.sky.movers.links import PRIOR_SHARE, candidate_links, learn, rates_between, with_far_links
from sameas.sky.movers.model import DEFAULT_TUNING, MotionModel, Surroundings, Tuning, fewest_shown
from sameas.sky.movers.rates import EclipticAxes, RateDensity
from sameas.sky.movers.stationary import Stationary, fixed_on_chip, stationary_sources
from sameas.sky.movers.tracks import Competition, Tracks, compete, groups_of, grow
from sameas.sky.series import Series

if TYPE_CHECKING:
    from astropy.table import Table

#: Prefixes of names: of movers by their detections, and of those that only the frames added together show.
DETECTED, ADDED = "sa", "sb"


@in_short
@dataclass(frozen=True)
class Movers:
    """Tracklets, the most probable first; (k,) each.

    Attributes
    ----------
    detections : what was searched. model : what was believed of movers, learned or given.
    members : (k, S) detections of each in the order of time, −1 behind the last one.
    p_tracklet : probability that there is a mover to which at least two of these detections belong.
    p_exact : probability that these detections are one mover's, and no other is.
    p_member : (k, S) probability of each detection to be of this mover.
    log_weight : ln of the odds of the tracklet against its detections being of no common mover.
    expected_chance : how many tracklets of as much evidence chance makes of all detections, at most (n e^−ln w: what
        is e^x times more probable as a mover than by chance happens by chance e^−x times as often as movers do).
    gap : ln of how much more probable another choice of tracklets could be at most.
    saw : (k,) exposures that saw its place, as far as they were asked. log_missed : what those that did not show it
        weigh of ``log_weight``.
    near_earth : (k,) scores of digest2 for near-Earth objects, 0 … 100, where they were asked for.
    prefix : of their names, :data:`DETECTED` or :data:`ADDED`.
    stationary : the stationary sources, which were left out; None where something else has found them.
    fixed : detections that were left out as fixed on the chip. alike : tracklets of one rate that were left out, as
        defects of the chip make them under a steady drift.
    """

    detections: Detections
    model: MotionModel
    members: IntArray
    p_tracklet: FloatArray
    p_exact: FloatArray
    p_member: FloatArray
    log_weight: FloatArray
    expected_chance: FloatArray
    gap: float
    state: FloatArray = field(repr=False)
    saw: IntArray
    log_missed: FloatArray
    near_earth: FloatArray | None = None
    prefix: str = DETECTED
    stationary: Stationary | None = field(default=None, repr=False)
    fixed: int = field(default=0, repr=False)
    alike: int = field(default=0, repr=False)

    def __len__(self) -> int:
        return len(self.members)

    @property
    def added(self) -> bool:
        """Whether only the frames added together show them."""
        return self.prefix == ADDED

    @property
    def size(self) -> IntArray:
        """(k,) detections of each tracklet."""
        return np.asarray((self.members >= 0).sum(axis=1))

    @property
    def names(self) -> tuple[str, ...]:
        """(k,) a name of eight letters and digits at most, as reports want it."""
        return tuple(f"{self.prefix}{k + 1:05d}" for k in range(len(self)))

    @property
    def tracklet(self) -> IntArray:
        """(n,) number of the tracklet that each detection belongs to, −1 for none."""
        out = np.full(len(self.detections), -1)
        k, column = np.nonzero(self.members >= 0)
        out[self.members[k, column]] = k
        return out

    @cached_property
    def _fits(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return _linear_fits(self.detections, self.members)

    @property
    def rate_arcsec_per_min(self) -> FloatArray:
        """(k, 2) of straight motion fitted to each, east and north of the equator."""
        return self._fits[0]

    @property
    def residual_arcsec(self) -> FloatArray:
        """(n, 2) of each detection from straight motion of its tracklet, east and north; NaN without one."""
        return self._fits[1]

    @property
    def scatter_arcsec(self) -> FloatArray:
        """(k,) root mean square of the residuals per axis, NaN for two detections."""
        return self._fits[2]

    def only(self, keep: BoolArray | IntArray) -> Movers:
        """Some of the tracklets."""
        names = ("members", "p_tracklet", "p_exact", "p_member", "log_weight", "expected_chance", "state", "saw",
                 "log_missed")  # fmt: skip
        near_earth = None if self.near_earth is None else self.near_earth[keep]
        return replace(self, **{name: getattr(self, name)[keep] for name in names}, near_earth=near_earth)

    def table(self) -> Table:
        """One row a tracklet."""
        from astropy.table import Table

        seen, first = self.detections, self.members[:, 0]
        last = self.members[np.arange(len(self)), self.size - 1]
        east, north = self.rate_arcsec_per_min.T
        table = Table(
            {
                "tracklet": np.array(self.names, dtype="U8"),
                "n_detections": self.size,
                "p_tracklet": self.p_tracklet,
                "p_exact": self.p_exact,
                "expected_chance": self.expected_chance,
                "log_odds": self.log_weight,
                "mjd_utc_first": seen.mjd_utc[first],
                "ra_deg_first": seen.ra_deg[first],
                "dec_deg_first": seen.dec_deg[first],
                "mjd_utc_last": seen.mjd_utc[last],
                "ra_deg_last": seen.ra_deg[last],
                "dec_deg_last": seen.dec_deg[last],
                "rate_arcsec_per_min": np.hypot(east, north),
                "rate_east_arcsec_per_min": east,
                "rate_north_arcsec_per_min": north,
                "position_angle_deg": np.degrees(np.arctan2(east, north)) % 360.0,
                "scatter_arcsec": np.ma.masked_invalid(self.scatter_arcsec),
            }
        )
        if self.near_earth is not None:
            table["digest2_neo"] = np.ma.masked_invalid(self.near_earth)
        units = {"_deg": "deg", "_arcsec": "arcsec", "per_min": "arcsec / min", "mjd": "d"}
        for name in table.colnames:
            unit = next((u for key, u in units.items() if name.endswith(key) or name.startswith(key)), None)
            table[name].unit = "deg" if "_deg_" in name else unit
        return table

    def detection_table(self) -> Table:
        """One row a detection of a tracklet, tracklet by tracklet in the order of time."""
        from astropy.table import Table

        seen = self.detections
        k, column = np.nonzero(self.members >= 0)
        rows = self.members[k, column]
        table = Table(
            {
                "tracklet": np.array(self.names, dtype="U8")[k] if len(k) else np.empty(0, "U8"),
                "id": seen.ids[rows],
                "row": seen.rows[rows],
                "exposure": np.array(seen.frame_names, dtype=str)[seen.frame[rows]],
                "mjd_utc": seen.mjd_utc[rows],
                "ra_deg": seen.ra_deg[rows],
                "dec_deg": seen.dec_deg[rows],
                "magnitude": np.ma.masked_invalid(seen.magnitude[rows]),
                "p_member": self.p_member[k, column],
                "residual_east_arcsec": self.residual_arcsec[rows, 0],
                "residual_north_arcsec": self.residual_arcsec[rows, 1],
            }
        )
        for name, unit in (("mjd_utc", "d"), ("ra_deg", "deg"), ("dec_deg", "deg"), ("magnitude", "mag"),
                           ("residual_east_arcsec", "arcsec"), ("residual_north_arcsec", "arcsec")):  # fmt: skip
            table[name].unit = unit
        return table


#: What is believed of movers beforehand weighs as many links (chosen: with 30, pairs of two exposures teach too much of
#: themselves; 347 of p > 0.5 were right 319 times stated, 300 times in fact).
COUNTS = 100.0


def find_movers(
    detections: Detections,
    *,
    model: MotionModel | None = None,
    others: Sequence[Detections] = (),
    least: int = 2,
    least_probability: float = 0.5,
    tuning: Tuning = DEFAULT_TUNING,
) -> Movers:
    """What moves among detections of several exposures: tracklets, how sure each is and each of its detections.

    Parameters
    ----------
    detections : of one night, or of a series of frames. What stands still, to the errors of the places and of the
        times between, is found first and left out (``Movers.stationary``).
    model : of rates, brightness and misses, as :func:`learn_motion` makes it; None learns it from these detections.
    others : detections of other nights to learn from, instead of these; for no ``model``.
    least : a tracklet has so many detections or more. least_probability : and is so probable.
    tuning : how the search goes.

    Returns
    -------
    The tracklets, the most probable first; a detection belongs to one at most.

    Example
    -------
    >>> t = [60000.0, 60000.01, 60000.02, 60000.03, 60000.04]
    >>> ra, dec = [156.0, 155.998, 155.996, 155.994, 155.992], [10.0, 10.0008, 10.0016, 10.0024, 10.0032]
    >>> found = find_movers(Detections.of(ra, dec, t, sigma_arcsec=0.2), least=3)
    >>> found.members, found.rate_arcsec_per_min.round(2)
    (array([[0, 1, 2, 3, 4]]), array([[-0.49,  0.2 ]]))
    """
    if least < 2:
        raise InputError(f"least={least}: a tracklet has two detections or more", naming("give {least:N}"))
    if not 0.0 <= least_probability <= 1.0:
        raise InputError(f"least_probability={least_probability}: give a probability, 0 to 1")
    stationary, fixed, at, rest = _left_out(detections, tuning)
    if len(np.unique(rest.frame)) < 2:
        return replace(_nothing(detections), stationary=stationary, fixed=fixed)
    around, taught = Surroundings.of(rest, tuning), None
    if model is None:
        if others:
            model = learn_motion(*others, tuning=tuning)
        else:
            model, taught = _learned(around, MotionModel(), COUNTS, tuning)
    found = _found(around, model, taught, tuning, least, least_probability, stationary)
    alike = _moving_alike(found)
    found = replace(found.only(~alike), alike=int(alike.sum()))
    members = np.where(found.members >= 0, at[found.members], -1)
    return replace(found, detections=detections, members=members, stationary=stationary, fixed=fixed)


def _left_out(detections: Detections, tuning: Tuning) -> tuple[Stationary, int, IntArray, Detections]:
    """The stationary sources, how many others are fixed on the chip, and the rows of the rest, with these, mended."""
    stationary = stationary_sources(detections, tuning)
    rest = stationary.rest(detections)
    moves = ~fixed_on_chip(rest)
    return stationary, int(np.count_nonzero(~moves)), np.flatnonzero(~stationary.rows)[moves], rest.some(moves)


#: Rates with smaller errors than this, arcsec/min, tell a common motion from that of the main belt, which spreads by
#: 0.05 and more. So many tracklets within three errors of a rate, and so many times as many as chance by what is
#: within twelve, move alike.
_SHARP, _ALIKE, _EXCESS = 0.012, 8, 8.0


def _moving_alike(found: Movers) -> BoolArray:
    """(k,) tracklets of one rate: no objects, but defects of a chip that a telescope moves over the sky."""
    out = np.zeros(len(found), bool)
    first, last = found.members[:, 0], _last(found)
    seen = found.detections
    variance = 0.5 * (seen.covariance[:, 0] + seen.covariance[:, 2])
    error = np.sqrt(variance[first] + variance[last]) / ((seen.mjd_utc[last] - seen.mjd_utc[first]) * 1440.0)
    sharp = np.flatnonzero((found.size > 2) & (error < _SHARP))
    rate, error = found.rate_arcsec_per_min[sharp], error[sharp]
    if len(sharp):
        tree = cKDTree(rate)
        near, far = (tree.query_ball_point(rate, sigmas * error, return_length=True) for sigmas in (3.0, 12.0))
        common = (near >= _ALIKE) & (near > _EXCESS * (far - near) / 15.0)
        for alike in tree.query_ball_point(rate[common], 3.0 * error[common]):
            out[sharp[alike]] = True
    return out


def _found(
    around: Surroundings,
    model: MotionModel,
    taught: Taught | None,
    tuning: Tuning,
    least: int,
    least_probability: float,
    stationary: Stationary | None = None,
) -> Movers:
    """The tracklets of detections without stationary ones.

    taught : what these detections have taught of the model, if they have. stationary : sources by which slow tracklets
    are judged.
    """
    detections = around.detections
    model = model.for_bands(detections.bands, tuning)
    competition = _competition(around, model, taught, tuning)
    p_stationary = np.zeros(len(competition.tracks))
    if stationary is not None:
        p_stationary = stationary.probability(around, competition.members, tuning)
    return _movers(detections, model, competition, least, least_probability, p_stationary)


def learn_motion(*nights: Detections, counts: float = COUNTS, tuning: Tuning = DEFAULT_TUNING) -> MotionModel:
    """What detections of one night or more teach of rates, brightness and misses; no identities are needed.

    counts : what is believed beforehand weighs as many links.

    A night of few movers leaves nearly all as it was believed before: the Solar System as ZTF sees it.

    Example: ``find_movers(tonight, model=learn_motion(yesterday))``.
    """
    model = MotionModel()
    for night in nights:
        _, _, _, rest = _left_out(night, tuning)
        if len(np.unique(rest.frame)) > 1:
            model, _ = _learned(Surroundings.of(rest, tuning), model, counts, tuning)
    return model


@dataclass(frozen=True)
class Taught:
    """What each group of tracks with detections in common has taught of a model.

    A single chance track among few makes movers of its rate ten times as frequent: without this, it would be believed
    for what it has taught itself.

    group : (n,) of each detection, g groups; −1 of none. rates : (c, g) mixtures, log_begin : (g,) that the others
    teach.
    """

    group: IntArray
    rates: RateDensity
    log_begin: FloatArray

    def corrected(self, around: Surroundings, tracks: Tracks, model: MotionModel) -> Tracks:
        """The tracks with the weights that the model has without what their groups have taught."""
        at = np.flatnonzero(self.group[tracks.first] >= 0)
        group = self.group[tracks.first[at]]
        rate, error = rates_between(around, tracks.first[at], tracks.last[at])
        change = self.rates.group(group).log_density(rate, error) - model.rates.log_density(rate, error)
        weight = tracks.log_weight.copy()
        # A track that is against the model is no more probable for that.
        weight[at] += np.minimum(change + self.log_begin[group] - model.log_begin, 0.0)
        return replace(tracks, log_weight=weight)


def _learned(
    around: Surroundings, model: MotionModel, counts: float, tuning: Tuning
) -> tuple[MotionModel, Taught | None]:
    """The model with what one night's detections teach, without stationary ones; and what they have taught of it."""
    rates = model.rates
    # Links that no main-belt object makes are too many, and say too little one by one.
    likely = replace(tuning, least_log_ratio=max(tuning.least_log_ratio, DEFAULT_TUNING.least_log_ratio))
    model = learn(around, model.for_bands(around.detections.bands, tuning), likely, counts=counts)
    return _taught_by_tracks(around, model, rates, tuning, counts * TRACK_COUNTS)


def _competition(around: Surroundings, model: MotionModel, taught: Taught | None, tuning: Tuning) -> Competition:
    """The tracks of all links, near and far, as they compete for the detections."""
    links = with_far_links(around, candidate_links(around, model, tuning), model, tuning)
    tracks = grow(around, links, model, tuning)
    if taught is not None:
        tracks = taught.corrected(around, tracks, model)
    return compete(tracks, len(around.detections), tuning)


#: What is believed beforehand weighs so many tracks, for each link that it weighs: a link is one of several of a track,
#: and chance makes far fewer tracks.
TRACK_COUNTS = 0.1


def _taught_by_tracks(
    around: Surroundings, model: MotionModel, rates: RateDensity, tuning: Tuning, counts: float
) -> tuple[MotionModel, Taught]:
    """The model with the rates, and how often a mover begins and is shown again, that whole tracks teach.

    rates : as believed beforehand. Among many false detections links alone do not show what is fast: that there are
    such movers, tracks tell that are straight over three exposures and more.
    """
    n = len(around.detections)
    found = _competition(around, model, None, tuning)
    # Defects of a chip make pairs of any rate: where three exposures saw its place, a pair teaches nothing.
    telling = (found.p_track > 0.01) & (found.tracks.size >= fewest_shown(found.tracks.saw))
    p, tracks, members = found.p_track[telling], found.tracks.only(telling), found.members[telling]
    groups, of_track, of_detection = groups_of(members, n)
    # Movers that too few exposures show make no such track; detections are those of an exposure.
    movers = np.bincount(of_track, p / model.tracked(tracks.saw, tuning), groups)
    exposures = float(around.coverage.before[around.cell, -1].mean())
    share = (movers.sum() + counts * PRIOR_SHARE) / (n / exposures + counts)
    of_others = (movers.sum() - movers + counts * PRIOR_SHARE) / (n / exposures + counts)
    rate, error = rates_between(around, tracks.first, tracks.last)
    sharp = np.sqrt(np.trace(error, axis1=1, axis2=2)) < 1.0
    moments = model.rates.moments(rate[sharp], error[sharp], p[sharp], of_track[sharp], groups)
    every = rates.counted(counts) + moments.all()
    learned = replace(
        model,
        rates=every.densities().group(0),
        log_begin=math.log(share),
        p_detect=min(max(_shown(p, tracks.size, tracks.saw, model.p_detect), 0.3), 0.97),
    )
    return learned, Taught(of_detection, (every - moments).densities(), np.log(of_others))


def _shown(weight: FloatArray, shown: IntArray, saw: IntArray, p: float) -> float:
    """The probability with which an exposure shows a mover, of tracks (k,) that ``shown`` of ``saw`` exposures show.

    Those that too few show make no track that teaches: truncated binomials, by expectation and maximisation.
    """
    few = fewest_shown(saw) > 2
    for _ in range(30):
        none, one = (1.0 - p) ** saw, saw * p * (1.0 - p) ** (saw - 1)
        two = np.where(few, 0.5 * saw * (saw - 1) * p**2 * (1.0 - p) ** np.maximum(saw - 2, 0), 0.0)
        there = np.maximum(1.0 - none - one - two, 1e-6)
        p = (float(weight @ (shown + (one + 2.0 * two) / there)) + 2.0) / (float(weight @ (saw / there)) + 3.0)
    return p


def _movers(
    detections: Detections, model: MotionModel, found: Competition, least: int, p_least: float, p_stationary: FloatArray
) -> Movers:
    p_tracklet, p_member = found.shares(len(detections))
    moves = 1.0 - p_stationary
    p_tracklet, p_member = moves * p_tracklet, moves[:, None] * p_member
    keep = np.flatnonzero(found.chosen)
    keep = keep[(found.tracks.size[keep] >= least) & (p_tracklet[keep] >= p_least)]
    keep = keep[np.lexsort([found.members[keep, 0], -found.tracks.log_weight[keep]])]
    weight = found.tracks.log_weight[keep]
    width = int(found.tracks.size[keep].max(initial=2))
    chance = len(detections) * np.exp(-np.clip(weight, -50.0, 700.0))
    return Movers(
        detections, model, found.members[keep][:, :width], p_tracklet[keep], (moves * found.p_track)[keep],
        p_member[keep][:, :width], weight, chance, found.gap, found.tracks.state[keep],
        found.tracks.saw[keep], found.tracks.log_missed[keep],
    )  # fmt: skip


def _linear_fits(detections: Detections, members: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(k, 2) rates, (n, 2) residuals and (k,) scatter of straight motion fitted by weighted least squares."""
    rate, left = np.full((len(members), 2), np.nan), np.full((len(detections), 2), np.nan)
    scatter = np.full(len(members), np.nan)
    axes: EclipticAxes = detections.axes()
    for size in np.unique((members >= 0).sum(axis=1)):
        these = np.flatnonzero((members >= 0).sum(axis=1) == size)
        rows = members[these, :size]
        first = np.repeat(rows[:, 0], size)
        place = axes.to_equator(first, axes.offsets(first, rows.ravel())).reshape(len(these), size, 2)
        t = (detections.mjd_utc[rows] - detections.mjd_utc[rows[:, :1]]) * 1440.0
        weight = 1.0 / (0.5 * (detections.covariance[rows][..., 0] + detections.covariance[rows][..., 2]))
        total = weight.sum(axis=1, keepdims=True)
        middle = (weight * t).sum(axis=1, keepdims=True) / total
        mean = np.einsum("ks,ksd->kd", weight, place) / total
        around = t - middle
        slope = np.einsum("ks,ksd->kd", weight * around, place) / (weight * around**2).sum(axis=1)[:, None]
        off = place - mean[:, None] - around[..., None] * slope[:, None]
        rate[these], left[rows] = slope, off
        if size > 2:
            scatter[these] = np.sqrt((off**2).sum(axis=(1, 2)) / (2 * (size - 2)))
    return rate, left, scatter


# The search on a series of frames: from what the tied frames leave over to what moves there.


@dataclass(frozen=True)
class SearchTuning:
    """How a series is searched.

    Attributes
    ----------
    least_move_px : what moves less between its first and last frame stands still: over the sky a faint or blended star,
        over the chip a defect.
    creep_px : what is seen five times and more moves, though it is less than that, if it is this far
    creep_sigmas : and so many times its error, by its own scatter about straight motion.
    drift : what moves over the chip by less than this part of its motion over the sky may be a defect.
    turns : the search is repeated without what it has shown to stand still, so many times at most.
    counts : what is believed of movers weighs as many links: what is left of frames is mostly noise, which teaches
        nothing of rates.
    """

    least_move_px: float = 2.0
    creep_px: float = 0.8
    creep_sigmas: float = 12.0
    drift: float = 0.5
    turns: int = 3
    counts: float = 300.0


SERIES_TUNING = SearchTuning()
#: Little is left of a series, and three frames have to agree: links that no main-belt object makes are tried too. With
#: −6, the bound of alerts, no injected mover faster than 2″/min was found, bright or faint; with −14 most are.
MOTION_TUNING = Tuning(least_log_ratio=-14.0)


def left_over(series: Series) -> Detections:
    """What is left to move; ``rows`` are those of the series."""
    at = np.flatnonzero(series.left)
    ra, dec = series.sky(series.place[at])
    mjd = np.array([e.mjd_utc for e in series.exposures])[series.frame[at]]
    error = np.concatenate([1.0857 * e.flux_err / np.maximum(e.flux, 1e-9) for e in series.exposures])[at]
    seen = Detections.of(
        ra, dec, mjd, sigma_arcsec=series.sigma_arcsec[at], frame=np.array([f"{k:05d}" for k in series.frame[at]]),
        magnitude=series.magnitude[at], magnitude_error=np.where(np.isfinite(series.magnitude[at]), error, np.nan),
        name="series",
    )  # fmt: skip
    names = tuple(series.exposures[int(k)].name for k in seen.frame_names)
    rows = at[seen.rows]
    return replace(seen, rows=rows, ids=rows, frame_names=names, trail=_trail_rates(series, rows))


def _trail_rates(series: Series, rows: IntArray) -> TrailRates | None:
    """What the trails of some measurements say of rates; None where none were measured."""
    if series.trails is None:
        return None
    minutes = np.array([e.exposure_s for e in series.exposures])[series.frame[rows]] / 60.0
    width = np.array([max(e.psf_fwhm_px, 1.5) * e.scale_arcsec_per_px for e in series.exposures])[series.frame[rows]]
    # A trail of twice the least length is seen as one also where it is faint.
    least = 2.0 * series.trails.least_widths * width / minutes
    return TrailRates(
        series.trails.arcsec[rows] / minutes[:, None], series.trails.sigma_arcsec[rows] / minutes,
        np.where(minutes > 0, least, np.inf),
    )  # fmt: skip


def search(
    series: Series,
    *,
    least: int = 3,
    least_probability: float = 0.5,
    tuning: SearchTuning = SERIES_TUNING,
    motion: Tuning = MOTION_TUNING,
) -> tuple[Movers, Series]:
    """What moves on a series of frames, and the series with what the search has shown to stand still.

    least : frames that show it. least_probability : of a tracklet.

    Tracklets that move less than two pixels in all are faint or blended stars; those that move less than two pixels
    over the chip, by twice their error, while the sky moves over it, are warm pixels. They are marked, and the rest is
    searched again, so that rates are not learned from them.
    """
    for _ in range(tuning.turns):
        if len(np.unique(series.frame[series.left])) < 2:
            return _nothing(_nothing_left(series)), series
        around = Surroundings.of(left_over(series), motion)
        found = _found(around, *_learned(around, MotionModel(), tuning.counts, motion), motion, 2, 0.0)
        slow, stuck = _standing(found, series, tuning)
        if not (slow | stuck).any():
            break
        still, fixed = series.still.copy(), series.fixed.copy()
        for standing, which in ((still, slow), (fixed, stuck & ~slow)):
            members = found.members[which]
            standing[found.detections.rows[members[members >= 0]]] = True
        series = replace(series, still=still, fixed=fixed)
    slow, stuck = _standing(found, series, tuning)
    wanted = (found.size >= least) & (found.p_tracklet >= least_probability) & ~slow & ~stuck
    return found.only(wanted), series


def _standing(found: Movers, series: Series, tuning: SearchTuning) -> tuple[BoolArray, BoolArray]:
    """(k,) whether each tracklet stands still on the sky, and whether it may on the chip, which the sky moves over."""
    over_sky = _moved_arcsec(found) / series.scale_arcsec_per_px
    rows = found.detections.rows[found.members[:, 0]], found.detections.rows[_last(found)]
    first, last = (_chip(series, these) for these in rows)
    over_chip = np.hypot(*(last - first).T)
    error = np.hypot(*(series.sigma_arcsec[these] for these in rows)) / series.scale_arcsec_per_px
    stuck = (over_chip < tuning.least_move_px + 2.0 * error) & (over_chip < tuning.drift * over_sky)
    # Blends and faint stars wander with the seeing; what creeps straight on, many times its scatter, does not.
    sure = (found.size >= 5) & (over_sky > tuning.creep_px) & (_moved_sigmas(found) > tuning.creep_sigmas)
    return (over_sky < tuning.least_move_px) & ~sure, stuck


def _chip(series: Series, rows: IntArray) -> FloatArray:
    """(n, 2) pixels of some measurements on their frames."""
    out = np.empty((len(rows), 2))
    for n in np.unique(series.frame[rows]):
        here, exposure = series.frame[rows] == n, series.exposures[n]
        out[here] = np.column_stack([exposure.x_px, exposure.y_px])[series.row[rows[here]]]
    return out


def _last(found: Movers) -> IntArray:
    """(k,) the last detection of each tracklet."""
    return np.asarray(found.members[np.arange(len(found)), found.size - 1])


def _nothing_left(series: Series) -> Detections:
    """No detections of its exposures."""
    no, none = np.empty(0), np.empty(0, np.int64)
    names = tuple(one.name for one in series.exposures)
    return Detections(no, no, np.empty((0, 3)), no, none, no, no, none, ("",), none, none, names, name="series")


def _nothing(detections: Detections) -> Movers:
    """No tracklets, where no two exposures have anything left."""
    no, none, wide = np.empty(0), np.empty(0, np.int64), np.empty((0, 2))
    return Movers(
        detections, MotionModel(), wide.astype(np.int64), no, no, wide, no, no, 0.0, np.empty((0, 6)), none, no
    )  # fmt: skip


def _moved_arcsec(found: Movers) -> FloatArray:
    """(k,) how far each tracklet moves between its first and last detection."""
    minutes = (found.detections.mjd_utc[_last(found)] - found.detections.mjd_utc[found.members[:, 0]]) * 1440.0
    return np.asarray(np.hypot(*found.rate_arcsec_per_min.T) * minutes)


def _moved_sigmas(found: Movers) -> FloatArray:
    """(k,) how far each tracklet moves in units of its error, by the larger of its scatter and the quoted errors."""
    there = found.members >= 0
    count = found.size
    seen, rows = found.detections, np.maximum(found.members, 0)
    quoted = np.where(there, 0.5 * (seen.covariance[rows][..., 0] + seen.covariance[rows][..., 2]), 0.0)
    sigma = np.maximum(np.nan_to_num(found.scatter_arcsec), np.sqrt(quoted.sum(axis=1) / count))
    t = np.where(there, 1440.0 * (seen.mjd_utc[rows] - seen.mjd_utc[rows[:, :1]]), 0.0)
    around = np.where(there, t - (t.sum(axis=1) / count)[:, None], 0.0)
    return np.asarray(np.hypot(*found.rate_arcsec_per_min.T) * np.sqrt((around**2).sum(axis=1)) / sigma)
