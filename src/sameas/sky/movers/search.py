"""The search for movers: from detections, or a series of frames, to tracklets with probabilities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.errors import InputError, naming
from sameas.representation import in_short
from sameas.sky.frame.measurements import POGSON
from sameas.sky.movers.detections import Detections, TrailRates
from sameas.sky.movers.links import PRIOR_SHARE, candidate_links, learn, rates_between, with_far_links
from sameas.sky.movers.model import DEFAULT_TUNING, MotionModel, Surroundings, Tuning, min_detected
from sameas.sky.movers.rates import EclipticAxes, RateDensity
from sameas.sky.movers.stationary import Stationary, fixed_on_chip, stationary_sources
from sameas.sky.movers.tracks import Competition, Tracks, compete, groups_of, grow
from sameas.sky.series import Series

if TYPE_CHECKING:
    from astropy.table import Table

#: Prefixes of names: movers found in the detections, and movers found only in the stacked frames.
DETECTED, ADDED = "sa", "sb"

#: Weight of the prior model of movers, in links. With 30, pairs of two exposures influence their own probabilities too
#: much: of 347 with p > 0.5, 319 were expected to be right and 300 were.
MODEL_COUNTS = 100.0
#: The same in tracks, per link of that weight: a track has several links, and chance tracks are far fewer.
TRACK_COUNTS = 0.1
#: Maximum error of rates, to separate a common motion from the main belt, whose scatter is 0.05 and more.
SHARP_ARCSEC_PER_MIN = 0.012
#: Minimum number of tracklets within three errors of a rate, absolute and as a multiple of the number expected from
#: those within twelve errors.
LEAST_ALIKE, ALIKE_EXCESS = 8, 8.0


@in_short
@dataclass(frozen=True)
class Movers:
    """Tracklets, the most probable first; (k,) each.

    Attributes
    ----------
    detections : searched detections. model : the model of movers, learned or given.
    members : (k, S) detections of each in order of time, padded with ABSENT.
    p_tracklet : probability that a mover has at least two of these detections.
    p_exact : probability that a mover has exactly these detections.
    p_member : (k, S) probability of each detection to belong to this mover.
    log_weight : ln of the odds of the tracklet against its detections being unrelated.
    expected_chance : upper bound on the expected number of chance tracklets of at least this weight (n e^−ln w: chance
        gives odds of e^x for e^−x as many tracklets as movers).
    gap : upper bound on ln of the probability ratio of another selection of tracklets to this one.
    n_covered : (k,) number of checked exposures that covered its position. log_missed : the part of ``log_weight`` of
        those without a detection.
    near_earth : (k,) digest2 scores for near-Earth objects, 0 … 100, if requested.
    prefix : of their names, :data:`DETECTED` or :data:`ADDED`.
    stationary : excluded stationary sources; None if they were found by other means.
    fixed : number of detections excluded as fixed on the chip. same_rate : number of tracklets excluded because many
        have the same rate, as chip defects have under a steady drift.
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
    n_covered: IntArray
    log_missed: FloatArray
    near_earth: FloatArray | None = None
    prefix: str = DETECTED
    stationary: Stationary | None = field(default=None, repr=False)
    fixed: int = field(default=0, repr=False)
    same_rate: int = field(default=0, repr=False)

    def __len__(self) -> int:
        return len(self.members)

    @property
    def added(self) -> bool:
        """Whether they were found only in the stacked frames."""
        return self.prefix == ADDED

    @property
    def size(self) -> IntArray:
        """(k,) detections of each tracklet."""
        return np.asarray((self.members >= 0).sum(axis=1))

    @property
    def names(self) -> tuple[str, ...]:
        """(k,) names of at most eight letters and digits, as reports require."""
        return tuple(f"{self.prefix}{k + 1:05d}" for k in range(len(self)))

    @property
    def tracklet(self) -> IntArray:
        """(n,) tracklet of each detection, ABSENT for none."""
        out = np.full(len(self.detections), ABSENT)
        k, column = np.nonzero(self.members >= 0)
        out[self.members[k, column]] = k
        return out

    @cached_property
    def _fits(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return _linear_fits(self.detections, self.members)

    @property
    def rate_arcsec_per_min(self) -> FloatArray:
        """(k, 2) rate of linear motion fitted to each, east and north (equatorial)."""
        return self._fits[0]

    @property
    def residual_arcsec(self) -> FloatArray:
        """(n, 2) residual of each detection from linear motion of its tracklet, east and north; NaN without one."""
        return self._fits[1]

    @property
    def scatter_arcsec(self) -> FloatArray:
        """(k,) root mean square of the residuals per axis, NaN for two detections."""
        return self._fits[2]

    def only(self, keep: BoolArray | IntArray) -> Movers:
        """Some of the tracklets."""
        names = ("members", "p_tracklet", "p_exact", "p_member", "log_weight", "expected_chance", "state", "n_covered",
                 "log_missed")  # fmt: skip
        near_earth = None if self.near_earth is None else self.near_earth[keep]
        return replace(self, **{name: getattr(self, name)[keep] for name in names}, near_earth=near_earth)

    def table(self) -> Table:
        """A table with one row per tracklet."""
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
        """A table with one row per detection of a tracklet, by tracklet and time."""
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


def find_movers(
    detections: Detections,
    *,
    model: MotionModel | None = None,
    others: Sequence[Detections] = (),
    least: int = 2,
    min_probability: float = 0.5,
    tuning: Tuning = DEFAULT_TUNING,
) -> Movers:
    """Tracklets of movers among detections of several exposures, with probabilities of each and of its detections.

    Parameters
    ----------
    detections : of one night, or of a series of frames. Stationary sources, within the errors, are found first and
        excluded (``Movers.stationary``).
    model : of rates, brightness and misses, from :func:`learn_motion`; None estimates it from these detections.
    others : detections of other nights from which to estimate the model instead; ignored if a ``model`` is given.
    least : minimum number of detections of a tracklet. min_probability : minimum ``p_tracklet``.
    tuning : parameters of the search.

    Returns
    -------
    The tracklets, the most probable first; a detection belongs to at most one.

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
    if not 0.0 <= min_probability <= 1.0:
        raise InputError(f"min_probability={min_probability}: give a probability, 0 to 1")
    stationary, fixed, at, rest = _excluded(detections, tuning)
    if len(np.unique(rest.frame)) < 2:
        return replace(_no_movers(detections), stationary=stationary, fixed=fixed)
    around, influence = Surroundings.of(rest, tuning), None
    if model is None:
        if others:
            model = learn_motion(*others, tuning=tuning)
        else:
            model, influence = _learned(around, MotionModel(), MODEL_COUNTS)
    movers = _found(around, model, influence, least, min_probability, stationary)
    same_rate = _same_rate(movers)
    movers = replace(movers.only(~same_rate), same_rate=int(same_rate.sum()))
    members = np.where(movers.members >= 0, at[movers.members], ABSENT)
    return replace(movers, detections=detections, members=members, stationary=stationary, fixed=fixed)


def _excluded(detections: Detections, tuning: Tuning) -> tuple[Stationary, int, IntArray, Detections]:
    """The stationary sources, the number of others fixed on the chip, and the rest: rows and corrected detections."""
    stationary = stationary_sources(detections, tuning)
    rest = stationary.rest(detections)
    moves = ~fixed_on_chip(rest)
    return stationary, int(np.count_nonzero(~moves)), np.flatnonzero(~stationary.rows)[moves], rest.some(moves)


def _same_rate(movers: Movers) -> BoolArray:
    """(k,) mask of the tracklets with a common rate: chip defects moved over the sky by a steady drift."""
    same_rate = np.zeros(len(movers), bool)
    first, last = movers.members[:, 0], _last(movers)
    detections = movers.detections
    variance = 0.5 * (detections.covariance[:, 0] + detections.covariance[:, 2])
    error = np.sqrt(variance[first] + variance[last]) / (
        (detections.mjd_utc[last] - detections.mjd_utc[first]) * 1440.0
    )
    sharp = np.flatnonzero((movers.size > 2) & (error < SHARP_ARCSEC_PER_MIN))
    rate, error = movers.rate_arcsec_per_min[sharp], error[sharp]
    if len(sharp):
        tree = cKDTree(rate)
        near, far = (tree.query_ball_point(rate, sigmas * error, return_length=True) for sigmas in (3.0, 12.0))
        common = (near >= LEAST_ALIKE) & (near > ALIKE_EXCESS * (far - near) / 15.0)
        for near in tree.query_ball_point(rate[common], 3.0 * error[common]):
            same_rate[sharp[near]] = True
    return same_rate


def _found(
    around: Surroundings,
    model: MotionModel,
    influence: Influence | None,
    least: int,
    min_probability: float,
    stationary: Stationary | None,
) -> Movers:
    """The tracklets of detections without stationary ones.

    influence : of these detections on the model, if it was estimated from them. stationary : sources for the
    probability that slow tracklets are stationary.
    """
    detections = around.detections
    model = model.for_bands(detections.bands)
    competition = _competition(around, model, influence)
    p_stationary = np.zeros(len(competition.tracks))
    if stationary is not None:
        p_stationary = stationary.probability(around, competition.members)
    return _movers(detections, model, competition, least, min_probability, p_stationary)


def learn_motion(*nights: Detections, counts: float = MODEL_COUNTS, tuning: Tuning = DEFAULT_TUNING) -> MotionModel:
    """The model of rates, brightness and misses estimated from one or more nights; no identities are needed.

    counts : weight of the prior model, in links.

    A night with few movers hardly changes the prior model: the Solar System as seen by ZTF.

    Example: ``find_movers(tonight, model=learn_motion(yesterday))``.
    """
    model = MotionModel()
    for night in nights:
        _, _, _, rest = _excluded(night, tuning)
        if len(np.unique(rest.frame)) > 1:
            model, _ = _learned(Surroundings.of(rest, tuning), model, counts)
    return model


@dataclass(frozen=True)
class Influence:
    """The influence of each group of connected tracks on an estimated model.

    A single chance track among few makes movers of its rate ten times as frequent in the model: without this correction
    it would support itself.

    group : (n,) of each detection, ABSENT for none, g groups. rates : (c, g) mixtures and log_begin : (g,), both
    estimated without the group.
    """

    group: IntArray
    rates: RateDensity
    log_begin: FloatArray

    def corrected(self, around: Surroundings, tracks: Tracks, model: MotionModel) -> Tracks:
        """The tracks with the weights under the model estimated without their groups."""
        at = np.flatnonzero(self.group[tracks.first] >= 0)
        group = self.group[tracks.first[at]]
        rate, error = rates_between(around, tracks.first[at], tracks.last[at])
        change = self.rates.group(group).log_density(rate, error) - model.rates.log_density(rate, error)
        weight = tracks.log_weight.copy()
        # The weight is only lowered.
        weight[at] += np.minimum(change + self.log_begin[group] - model.log_begin, 0.0)
        return replace(tracks, log_weight=weight)


def _learned(around: Surroundings, model: MotionModel, counts: float) -> tuple[MotionModel, Influence | None]:
    """The model updated with the detections of one night, without stationary ones, and their influence on it."""
    rates, tuning = model.rates, around.tuning
    # Links too fast for the main belt are too many and carry too little information each.
    likely = replace(tuning, min_log_ratio=max(tuning.min_log_ratio, DEFAULT_TUNING.min_log_ratio))
    model = learn(replace(around, tuning=likely), model.for_bands(around.detections.bands), counts=counts)
    return _learned_from_tracks(around, model, rates, counts * TRACK_COUNTS)


def _competition(around: Surroundings, model: MotionModel, influence: Influence | None) -> Competition:
    """The competition of the tracks along all links, near and far, for the detections."""
    links = with_far_links(around, candidate_links(around, model), model)
    tracks = grow(around, links, model)
    if influence is not None:
        tracks = influence.corrected(around, tracks, model)
    return compete(tracks, len(around.detections), around.tuning)


def _learned_from_tracks(
    around: Surroundings, model: MotionModel, rates: RateDensity, counts: float
) -> tuple[MotionModel, Influence]:
    """The model with rates, track starts and detection probability estimated from whole tracks.

    rates : of the prior model. Among many false detections links alone do not show fast movers; straight tracks over
    three or more exposures do.
    """
    n = len(around.detections)
    competition = _competition(around, model, None)
    # Chip defects make pairs of any rate: where three exposures covered the position, pairs are not used.
    used = (competition.p_track > 0.01) & (competition.tracks.size >= min_detected(competition.tracks.n_covered))
    p, tracks, members = competition.p_track[used], competition.tracks.take(used), competition.members[used]
    groups, of_track, of_detection = groups_of(members, n)
    # Corrected for movers with too few detections for such a track; the share refers to one exposure's detections.
    movers = np.bincount(of_track, p / model.tracked(tracks.n_covered), groups)
    exposures = float(around.coverage.before[around.cell, -1].mean())
    share = (movers.sum() + counts * PRIOR_SHARE) / (n / exposures + counts)
    share_of_others = (movers.sum() - movers + counts * PRIOR_SHARE) / (n / exposures + counts)
    rate, error = rates_between(around, tracks.first, tracks.last)
    sharp = np.sqrt(np.trace(error, axis1=1, axis2=2)) < 1.0
    moments = model.rates.moments(rate[sharp], error[sharp], p[sharp], of_track[sharp], groups)
    all_moments = rates.counted(counts) + moments.all()
    learned = replace(
        model,
        rates=all_moments.densities().group(0),
        log_begin=math.log(share),
        p_detect=min(max(detection_probability(p, tracks.size, tracks.n_covered, model.p_detect), 0.3), 0.97),
    )
    return learned, Influence(of_detection, (all_moments - moments).densities(), np.log(share_of_others))


def detection_probability(weight: FloatArray, n_detected: IntArray, n_covered: IntArray, p: float) -> float:
    """The detection probability from tracks (k,) with ``n_detected`` detections in ``n_covered`` exposures, by EM.

    Movers with too few detections make no usable track: the binomials are truncated.
    """
    few = min_detected(n_covered) > 2
    for _ in range(30):
        none, one = (1.0 - p) ** n_covered, n_covered * p * (1.0 - p) ** (n_covered - 1)
        two = np.where(few, 0.5 * n_covered * (n_covered - 1) * p**2 * (1.0 - p) ** np.maximum(n_covered - 2, 0), 0.0)
        p_usable = np.maximum(1.0 - none - one - two, 1e-6)
        p = (float(weight @ (n_detected + (one + 2.0 * two) / p_usable)) + 2.0) / (
            float(weight @ (n_covered / p_usable)) + 3.0
        )
    return p


def _movers(
    detections: Detections,
    model: MotionModel,
    competition: Competition,
    least: int,
    p_least: float,
    p_stationary: FloatArray,
) -> Movers:
    """The chosen tracks as tracklets, the most probable first, with probabilities reduced by ``p_stationary``."""
    p_tracklet, p_member = competition.shares(len(detections))
    p_moving = 1.0 - p_stationary
    p_tracklet, p_member = p_moving * p_tracklet, p_moving[:, None] * p_member
    keep = np.flatnonzero(competition.chosen)
    keep = keep[(competition.tracks.size[keep] >= least) & (p_tracklet[keep] >= p_least)]
    keep = keep[np.lexsort([competition.members[keep, 0], -competition.tracks.log_weight[keep]])]
    weight = competition.tracks.log_weight[keep]
    width = int(competition.tracks.size[keep].max(initial=2))
    chance = len(detections) * np.exp(-np.clip(weight, -50.0, 700.0))
    return Movers(
        detections=detections, model=model, members=competition.members[keep][:, :width], p_tracklet=p_tracklet[keep],
        p_exact=(p_moving * competition.p_track)[keep], p_member=p_member[keep][:, :width], log_weight=weight,
        expected_chance=chance, gap=competition.gap, state=competition.tracks.state[keep],
        n_covered=competition.tracks.n_covered[keep], log_missed=competition.tracks.log_missed[keep],
    )  # fmt: skip


def _linear_fits(detections: Detections, members: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(k, 2) rates, (n, 2) residuals and (k,) scatter of linear motion fitted by weighted least squares."""
    rate, residual = np.full((len(members), 2), np.nan), np.full((len(detections), 2), np.nan)
    scatter = np.full(len(members), np.nan)
    axes: EclipticAxes = detections.axes()
    for size in np.unique((members >= 0).sum(axis=1)):
        of_size = np.flatnonzero((members >= 0).sum(axis=1) == size)
        rows = members[of_size, :size]
        first = np.repeat(rows[:, 0], size)
        position = axes.to_equator(first, axes.offsets(first, rows.ravel())).reshape(len(of_size), size, 2)
        t = (detections.mjd_utc[rows] - detections.mjd_utc[rows[:, :1]]) * 1440.0
        weight = 1.0 / (0.5 * (detections.covariance[rows][..., 0] + detections.covariance[rows][..., 2]))
        total = weight.sum(axis=1, keepdims=True)
        middle = (weight * t).sum(axis=1, keepdims=True) / total
        mean = np.einsum("ks,ksd->kd", weight, position) / total
        time_off = t - middle
        slope = np.einsum("ks,ksd->kd", weight * time_off, position) / (weight * time_off**2).sum(axis=1)[:, None]
        residual_of_size = position - mean[:, None] - time_off[..., None] * slope[:, None]
        rate[of_size], residual[rows] = slope, residual_of_size
        if size > 2:
            scatter[of_size] = np.sqrt((residual_of_size**2).sum(axis=(1, 2)) / (2 * (size - 2)))
    return rate, residual, scatter


# Parameters of the search in a series of frames.
#: Minimum motion between first and last frame: less on the sky is a faint or blended star, less on the chip a defect.
MIN_MOVE_PX = 2.0
#: With five or more detections a smaller motion counts as real if it exceeds this many pixels and this many times its
#: error, by its scatter about linear motion.
CREEP_PX, CREEP_SIGMAS = 0.8, 12.0
DRIFT = 0.5  # a tracklet may be a defect if its motion on the chip is less than this fraction of that on the sky
ITERATIONS = 3  # maximum number of searches, each without the stationary sources found by the previous one
#: Weight of the prior model, in links: detections left over in frames are mostly noise, and give no rates.
COUNTS = 300.0


#: Few detections are left over in a series, and three frames must agree: links too fast for the main belt are tried
#: too. With −6, the limit for alerts, no injected mover faster than 2″/min was found, bright or faint; with −14 most
#: are.
MOTION_TUNING = Tuning(min_log_ratio=-14.0)


def unexplained_detections(series: Series) -> Detections:
    """The detections of a series that are not explained otherwise; ``rows`` are rows of the series, ``ids`` the numbers
    of the measurements in the tables of their frames."""
    at = np.flatnonzero(series.unexplained)
    ra, dec = series.sky(series.place[at])
    mjd = np.array([e.mjd_utc for e in series.exposures])[series.frame[at]]
    error = POGSON * series.measured("flux_err", at) / np.maximum(series.measured("flux", at), 1e-9)
    seen = Detections.of(
        ra, dec, mjd, sigma_arcsec=series.sigma_arcsec[at], frame=np.array([f"{k:05d}" for k in series.frame[at]]),
        magnitude=series.magnitude[at], magnitude_error=np.where(np.isfinite(series.magnitude[at]), error, np.nan),
        name="series",
    )  # fmt: skip
    names = tuple(series.exposures[int(k)].name for k in seen.frame_names)
    rows = at[seen.rows]
    return replace(seen, rows=rows, ids=series.row[rows], frame_names=names, trail=_trail_rates(series, rows))


def _trail_rates(series: Series, rows: IntArray) -> TrailRates | None:
    """The rates by the trails of some measurements; None without measured trails."""
    if series.trails is None:
        return None
    minutes = np.array([e.exposure_s for e in series.exposures])[series.frame[rows]] / 60.0
    width = np.array([max(e.psf_fwhm_px, 1.5) * e.scale_arcsec_per_px for e in series.exposures])[series.frame[rows]]
    # A trail of twice the minimum length is recognised even if faint.
    least = 2.0 * series.trails.min_widths * width / minutes
    return TrailRates(
        series.trails.arcsec[rows] / minutes[:, None], series.trails.sigma_arcsec[rows] / minutes,
        np.where(minutes > 0, least, np.inf),
    )  # fmt: skip


def search(
    series: Series, *, least: int = 3, min_probability: float = 0.5, motion: Tuning = MOTION_TUNING
) -> tuple[Movers, Series]:
    """The movers of a series of frames, and the series with newly found stationary and fixed detections marked.

    least : minimum number of frames. min_probability : minimum ``p_tracklet``.

    Tracklets that move less than two pixels in total are faint or blended stars; those that move less than two pixels
    plus twice their error on the chip, while the sky moves over it, are warm pixels. They are marked and the rest is
    searched again, so that they do not influence the rates.
    """
    for _ in range(ITERATIONS):
        if len(np.unique(series.frame[series.unexplained])) < 2:
            return _no_movers(_no_detections(series)), series
        around = Surroundings.of(unexplained_detections(series), motion)
        movers = _found(around, *_learned(around, MotionModel(), COUNTS), 2, 0.0, None)
        slow, stuck = _stationary_and_fixed(movers, series)
        if not (slow | stuck).any():
            break
        stationary, fixed = series.stationary.copy(), series.fixed.copy()
        for mask, selected in ((stationary, slow), (fixed, stuck & ~slow)):
            members = movers.members[selected]
            mask[movers.detections.rows[members[members >= 0]]] = True
        series = replace(series, stationary=stationary, fixed=fixed)
    slow, stuck = _stationary_and_fixed(movers, series)
    wanted = (movers.size >= least) & (movers.p_tracklet >= min_probability) & ~slow & ~stuck
    return movers.only(wanted), series


def _stationary_and_fixed(movers: Movers, series: Series) -> tuple[BoolArray, BoolArray]:
    """(k,) masks of the tracklets that are stationary on the sky, and of those that may be fixed on the chip."""
    over_sky = _moved_arcsec(movers) / series.scale_arcsec_per_px
    rows = movers.detections.rows[movers.members[:, 0]], movers.detections.rows[_last(movers)]
    first, last = (_chip(series, selected) for selected in rows)
    over_chip = np.hypot(*(last - first).T)
    error = np.hypot(*(series.sigma_arcsec[selected] for selected in rows)) / series.scale_arcsec_per_px
    stuck = (over_chip < MIN_MOVE_PX + 2.0 * error) & (over_chip < DRIFT * over_sky)
    # Blends and faint stars move with the seeing; a linear motion of many times its scatter is real.
    creeps = (movers.size >= 5) & (over_sky > CREEP_PX) & (_moved_sigmas(movers) > CREEP_SIGMAS)
    return (over_sky < MIN_MOVE_PX) & ~creeps, stuck


def _chip(series: Series, rows: IntArray) -> FloatArray:
    """(n, 2) pixels of some measurements in their frames."""
    out = np.empty((len(rows), 2))
    for n in np.unique(series.frame[rows]):
        in_frame, exposure = series.frame[rows] == n, series.exposures[n]
        out[in_frame] = np.column_stack([exposure.x_px, exposure.y_px])[series.row[rows[in_frame]]]
    return out


def _last(movers: Movers) -> IntArray:
    """(k,) the last detection of each tracklet."""
    return np.asarray(movers.members[np.arange(len(movers)), movers.size - 1])


def _no_detections(series: Series) -> Detections:
    """An empty set of detections with the exposures of the series."""
    values, rows = np.empty(0), np.empty(0, np.int64)
    names = tuple(exposure.name for exposure in series.exposures)
    return Detections(
        ra_deg=values, dec_deg=values, covariance=np.empty((0, 3)), mjd_utc=values, frame=rows, magnitude=values,
        magnitude_error=values, band=rows, bands=("",), ids=rows, rows=rows, frame_names=names, name="series",
    )  # fmt: skip


def _no_movers(detections: Detections) -> Movers:
    """An empty set of tracklets."""
    values, rows, pairs = np.empty(0), np.empty(0, np.int64), np.empty((0, 2))
    return Movers(
        detections=detections, model=MotionModel(), members=pairs.astype(np.int64), p_tracklet=values, p_exact=values,
        p_member=pairs, log_weight=values, expected_chance=values, gap=0.0, state=np.empty((0, 6)), n_covered=rows,
        log_missed=values,
    )  # fmt: skip


def _moved_arcsec(movers: Movers) -> FloatArray:
    """(k,) motion of each tracklet between its first and last detection, arcsec."""
    minutes = (movers.detections.mjd_utc[_last(movers)] - movers.detections.mjd_utc[movers.members[:, 0]]) * 1440.0
    return np.asarray(np.hypot(*movers.rate_arcsec_per_min.T) * minutes)


def _moved_sigmas(movers: Movers) -> FloatArray:
    """(k,) motion of each tracklet over its error, by the larger of its scatter and the quoted errors."""
    present = movers.members >= 0
    count = movers.size
    detections, rows = movers.detections, np.maximum(movers.members, 0)
    quoted = np.where(present, 0.5 * (detections.covariance[rows][..., 0] + detections.covariance[rows][..., 2]), 0.0)
    sigma = np.maximum(np.nan_to_num(movers.scatter_arcsec), np.sqrt(quoted.sum(axis=1) / count))
    t = np.where(present, 1440.0 * (detections.mjd_utc[rows] - detections.mjd_utc[rows[:, :1]]), 0.0)
    time_off = np.where(present, t - (t.sum(axis=1) / count)[:, None], 0.0)
    return np.asarray(np.hypot(*movers.rate_arcsec_per_min.T) * np.sqrt((time_off**2).sum(axis=1)) / sigma)
