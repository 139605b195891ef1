"""Tracks: candidate sets of detections of one mover, grown along the links, with their log weights.

The state of a track is position, rate and a small acceleration on the tangent plane at its first detection, with its
covariance (a Kalman filter without process noise, i.e. sequential least squares). The prior of the acceleration is
small for slow movers, so that motion is linear over short times and quadratic over long ones. The third and each later
detection adds

    ln N(x; predicted) − ln β + ln g/n + ln P(detected again, after the misses)

to the log weight, the last by the beta-binomial pattern of detections among the exposures that covered the position
(``MotionModel.log_pattern``). Exposures before the first and after the last detection that covered the position count
likewise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sameas.arrays import ABSENT, BoolArray, ColumnTable, FloatArray, IntArray
from sameas.gaussian import Gaussian, log_density
from sameas.many.marginals import additive_answer
from sameas.many.sets import Sets
from sameas.ragged import Ragged, ranges
from sameas.sky.movers.links import Links, rates_of
from sameas.sky.movers.model import BEND_RATE, OUTLIER, OUTLIER_SCALE, MotionModel, Surroundings, Tuning

#: Number of exposures before and after a track that are checked for non-detections, and minimum ln w of the tracks for
#: which this is done.
OUTER_EXPOSURES, MIN_ENDED = 8, -4.0


@dataclass(frozen=True)
class Tracks(ColumnTable):
    """Tracks, (k,) each, grown exposure by exposure.

    first, last : detections. parent : the track without its last detection, ABSENT for tracks of two detections. size :
    number of detections. log_weight : ln w against the detections being unrelated. gain : the part of the last
    detection. n_covered : number of exposures that covered its position, from its first detection on. log_missed : the
    part of ln w of those without a detection. state : (k, 6) position, rate and acceleration at the time of the first
    detection, in arcsec and minutes on its ecliptic axes.
    """

    first: IntArray
    last: IntArray
    parent: IntArray
    size: IntArray
    log_weight: FloatArray
    gain: FloatArray
    n_covered: IntArray
    log_missed: FloatArray
    state: FloatArray

    def __len__(self) -> int:
        return len(self.last)

    def members(self, tracks: IntArray) -> IntArray:
        """(k, longest) detections of some tracks in order of time, padded with ABSENT."""
        out = np.full((len(tracks), int(self.size[tracks].max(initial=1))), -1)
        current, rows = tracks, np.arange(len(tracks))
        while len(rows):
            out[rows, self.size[current] - 1] = self.last[current]
            has_parent = self.parent[current] >= 0
            out[rows[~has_parent], 0] = self.first[current[~has_parent]]
            rows, current = rows[has_parent], self.parent[current[has_parent]]
        return out


@dataclass(frozen=True)
class _Extendable:
    """Tracks that can be extended, with the covariances (k, 6, 6) of their states."""

    tracks: Tracks
    covariance: FloatArray

    def take(self, which: BoolArray | IntArray) -> _Extendable:
        """Some of the tracks."""
        return _Extendable(self.tracks.take(which), self.covariance[which])

    @staticmethod
    def concatenated(parts: list[_Extendable]) -> _Extendable:
        """Several sets of tracks as one."""
        return _Extendable(
            parts[0].tracks.stacked(*(p.tracks for p in parts[1:])), np.concatenate([p.covariance for p in parts])
        )


def grow(around: Surroundings, links: Links, model: MotionModel) -> Tracks:
    """The tracks along the links: for each detection, the best ones that end there."""
    detections = around.detections
    order = np.argsort(detections.frame[links.j], kind="stable")
    links = links.take(order)
    bounds = np.searchsorted(detections.frame[links.j], np.arange(len(detections.frame_names) + 1))
    # Last exposure with a link from each: after it the covariances, nine tenths of the memory, are dropped.
    last_use = np.full(len(detections.frame_names), ABSENT)
    np.maximum.at(last_use, detections.frame[links.i], detections.frame[links.j])
    rows = np.empty(0, np.int64)
    values = np.empty(0)
    tracks = Tracks(rows, rows, rows, rows, values, values, rows, values, np.empty((0, 6)))
    kept: list[_Extendable] = [_Extendable(tracks, np.empty((0, 6, 6)))]
    offsets = [0]
    # Range of the tracks that end at each detection; those of one exposure are sorted by detection.
    start, count = np.zeros(len(detections), np.int64), np.zeros(len(detections), np.int64)
    for frame in range(len(detections.frame_names)):
        to_frame = links.take(np.arange(bounds[frame], bounds[frame + 1]))
        if not len(to_frame):
            continue
        grown = [_new_tracks(around, to_frame, model)]
        row, parent = ranges(start[to_frame.i], count[to_frame.i])
        if len(row):
            grown.append(_extended(around, to_frame.take(row), _gathered(kept, offsets, parent), parent, model))
        kinds = np.concatenate([to_frame.far.astype(np.int64), np.full(len(row) and len(grown[-1].tracks), 2)])
        level = _best_per_detection(_Extendable.concatenated(grown), kinds, around.tuning.tracks)
        size = np.bincount(level.tracks.last, minlength=len(detections))
        ended = np.flatnonzero(size)
        count[ended] = size[ended]
        offsets.append(offsets[-1] + len(kept[-1].tracks))
        start[ended] = offsets[-1] + np.searchsorted(level.tracks.last, ended)
        kept.append(level)
        for n, old in enumerate(kept[:-1]):
            if len(old.covariance) and last_use[detections.frame[old.tracks.last[0]]] <= frame:
                kept[n] = replace(old, covariance=old.covariance[:0])
    return _with_outer_exposures(around, kept[0].tracks.stacked(*(level.tracks for level in kept[1:])), model)


def _gathered(levels: list[_Extendable], offsets: list[int], number: IntArray) -> _Extendable:
    """The tracks with given numbers, from levels whose first tracks have the numbers ``offsets``.

    Concatenating all levels would copy them at every exposure: quadratic cost in the length of a series.
    """
    level = np.searchsorted(offsets, number, side="right") - 1
    order = np.argsort(level, kind="stable")
    parts = [levels[n].take(number[level == n] - offsets[n]) for n in np.unique(level).tolist()]
    inverse_order = np.empty_like(order)
    inverse_order[order] = np.arange(len(order))
    return _Extendable.concatenated(parts).take(inverse_order)


def _with_outer_exposures(around: Surroundings, tracks: Tracks, model: MotionModel) -> Tracks:
    """The tracks with the misses in the exposures before and after them that covered their extrapolated positions."""
    detections, tuning, when = around.detections, around.tuning, around.detections.frame_mjd * 1440.0
    frames, first_minutes = len(when), detections.mjd_utc * 1440.0
    # Misses only lower the weight, and dominated tracks do not compete.
    selected = np.flatnonzero((tracks.log_weight > MIN_ENDED) & ~_dominated(tracks, tuning))
    steps = np.arange(1, OUTER_EXPOSURES + 1)
    n_covered = tracks.n_covered.copy()
    for part in np.split(selected, range(tuning.pairs_at_once, len(selected), tuning.pairs_at_once)):
        frame = np.concatenate(
            [
                detections.frame[tracks.first[part]][:, None] - steps,
                detections.frame[tracks.last[part]][:, None] + steps,
            ],
            axis=1,
        )
        k, column = np.nonzero((frame >= 0) & (frame < frames))
        row, number = part[k], frame[k, column]
        t = (when[number] - first_minutes[tracks.first[row]])[:, None]
        state = tracks.state[row]
        position = state[:, :2] + t * state[:, 2:4] + 0.5 * t * t * state[:, 4:]
        np.add.at(n_covered, row, around.coverage.covers(around.axes.directions(tracks.first[row], position), number))
    old_pattern = model.log_pattern(tracks.size, tracks.n_covered)
    pattern = model.log_pattern(tracks.size, n_covered)
    missed = pattern - model.log_pattern(tracks.size, tracks.size)
    return replace(tracks, log_weight=tracks.log_weight + pattern - old_pattern, n_covered=n_covered, log_missed=missed)


def _dominated(tracks: Tracks, tuning: Tuning) -> BoolArray:
    """(k,) mask of the tracks with an extension by a certain detection; these do not compete."""
    dominated = np.zeros(len(tracks), bool)
    certain = (tracks.parent >= 0) & (tracks.gain > tuning.certain_gain)
    dominated[tracks.parent[certain]] = True
    return dominated


def _best_per_detection(grown: _Extendable, kind: IntArray, most: int) -> _Extendable:
    """The best tracks of each kind (k,) for each last detection, sorted by detection."""
    tracks = grown.tracks
    order = np.lexsort([-tracks.log_weight, kind, tracks.last])
    code = 3 * tracks.last[order] + kind[order]
    return grown.take(order[np.arange(len(order)) - np.searchsorted(code, code) < most])


def _new_tracks(around: Surroundings, links: Links, model: MotionModel) -> _Extendable:
    """Tracks of two detections, one per link."""
    m, tuning = len(links), around.tuning
    rate, error = rates_of(around, links.i, links.j, links.minutes, links.offset)
    mean, rate_covariance = model.rates.prior_at(rate, error)
    state = np.zeros((m, 6))
    state[:, 2:4] = mean
    state[:, 2] += around.reference[links.i]
    covariance = np.zeros((m, 6, 6))
    covariance[:, :2, :2] = around.covariance[links.i]
    covariance[:, 2:4, 2:4] = rate_covariance
    speed = np.hypot(*(links.offset / links.minutes[:, None]).T)
    bend = tuning.bend_arcsec_per_min2 * np.maximum(1.0, speed / BEND_RATE)
    covariance[:, [4, 5], [4, 5]] = (bend**2)[:, None]
    state, covariance = _updated(state, covariance, links.minutes, links.offset, around.covariance[links.j])
    # The prior of a link (a detection has a next one) is replaced by that of a track (a detection begins a mover).
    two, n_covered = np.full(m, 2), 2 + links.misses
    pattern = model.log_pattern(two, n_covered)
    weight = (
        links.log_ratio - model.log_odds - links.misses * math.log(1.0 - model.p_detect)
        + model.log_begin - around.log_crowding[links.i] + pattern
    )  # fmt: skip
    missed = pattern - model.log_pattern(two, two)
    return _Extendable(
        Tracks(links.i, links.j, np.full(m, ABSENT), two, weight, weight, n_covered, missed, state), covariance
    )


def _extended(
    around: Surroundings, links: Links, tracks: _Extendable, parent: IntArray, model: MotionModel
) -> _Extendable:
    """Tracks extended by one detection along a link from their end; ``links`` and ``tracks`` are (m,) each."""
    parents, tuning = tracks.tracks, around.tuning
    minutes = around.minutes[links.j] - around.minutes[parents.first]
    offset = around.axes.offsets(parents.first, links.j)
    noise = around.covariance[links.j]
    residual, covariance = _predicted(parents.state, tracks.covariance, minutes, offset, noise)
    outlier_covariance = covariance + (OUTLIER_SCALE**2 - 1.0) * noise
    log_fit = np.logaddexp(
        math.log1p(-OUTLIER) + log_density(residual, covariance),
        math.log(OUTLIER) + log_density(residual, outlier_covariance),
    )
    size, n_covered = parents.size + 1, parents.n_covered + links.misses + 1
    pattern = model.log_pattern(size, n_covered)
    log_again = pattern - model.log_pattern(parents.size, parents.n_covered)
    gain = log_again + log_fit - around.log_density[links.j] + links.log_brightness
    missed = pattern - model.log_pattern(size, size)
    # Few of the tracks are in line with the link.
    kept = np.flatnonzero(gain > tuning.min_log_ratio)
    parents, state_covariance = parents.take(kept), tracks.covariance[kept]
    state, state_covariance = _updated(parents.state, state_covariance, minutes[kept], offset[kept], noise[kept])
    extended = Tracks(
        parents.first, links.j[kept], parent[kept], size[kept], parents.log_weight + gain[kept], gain[kept],
        n_covered[kept], missed[kept], state,
    )  # fmt: skip
    return _Extendable(extended, state_covariance)


def _predicted(
    state: FloatArray, covariance: FloatArray, minutes: FloatArray, position: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(m, 2) residual of a detection from the prediction, and its covariance (m, 2, 2)."""
    t = minutes[:, None]
    residual = position - (state[:, :2] + t * state[:, 2:4] + 0.5 * t * t * state[:, 4:])
    factor = np.stack([np.ones(len(minutes)), minutes, 0.5 * minutes**2], axis=1)
    blocks = covariance.reshape(-1, 3, 2, 3, 2)
    return residual, np.einsum("ma,maibj,mb->mij", factor, blocks, factor, optimize=True) + noise


def _updated(
    state: FloatArray, covariance: FloatArray, minutes: FloatArray, position: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """State and covariance updated with a detection."""
    residual, residual_covariance = _predicted(state, covariance, minutes, position, noise)
    factor = np.stack([np.ones(len(minutes)), minutes, 0.5 * minutes**2], axis=1)
    cross_covariance = np.einsum("maibj,mb->maij", covariance.reshape(-1, 3, 2, 3, 2), factor).reshape(-1, 6, 2)
    updated = Gaussian(state, covariance).conditional(cross_covariance, residual, residual_covariance)
    return updated.mean, updated.covariance


@dataclass(frozen=True)
class Competition:
    """Competing tracks and the best selection of tracks without common detections.

    tracks : the competing ones. members : (k, S) their detections. chosen : (k,) mask of the best selection. p_track :
    (k,) probability of exactly this set. gap : upper bound on ln of the probability ratio of another selection to this
    one; 0 if proved optimal.
    """

    tracks: Tracks
    members: IntArray
    chosen: BoolArray
    p_track: FloatArray
    gap: float

    def shares(self, n: int) -> tuple[FloatArray, FloatArray]:
        """For each chosen track: probability that a mover has at least two of its detections (k,), and each (k, S).

        n : number of detections.
        """
        members, p = self.members, self.p_track
        owner = np.full(n + 1, ABSENT)
        k, column = np.nonzero((members >= 0) & self.chosen[:, None])
        owner[members[k, column]] = k
        p_tracklet, p_member = np.zeros(len(members)), np.zeros(members.shape)
        position = np.full(n + 1, ABSENT)
        position[members[k, column]] = column
        owners = owner[members]  # chosen track of each member, ABSENT for none (padding reads the extra last element)
        for track in np.flatnonzero(p > 1e-9):
            chosen_tracks = owners[track][members[track] >= 0]
            for chosen in np.unique(chosen_tracks[chosen_tracks >= 0]):
                common = members[track][(owners[track] == chosen) & (members[track] >= 0)]
                if len(common) >= 2:
                    p_tracklet[chosen] += p[track]
                    p_member[chosen, position[common]] += p[track]
        return np.minimum(p_tracklet, 1.0), np.minimum(p_member, 1.0)


def compete(tracks: Tracks, n: int, tuning: Tuning) -> Competition:
    """The best selection of tracks without common detections, and the probability of each, by set packing.

    tracks : of n detections. Tracks with a certain extension and tracks with a low weight do not compete.
    """
    competing = np.flatnonzero(~_dominated(tracks, tuning) & (tracks.log_weight > tuning.min_competing))
    members = tracks.members(competing)
    weight = tracks.log_weight[competing]
    use_count = np.bincount(members[members >= 0], minlength=n)
    alone = np.where(members >= 0, use_count[members], 1).max(axis=1, initial=1) == 1
    chosen, probability = alone & (weight > 0), np.where(alone, 1.0 / (1.0 + np.exp(-np.clip(weight, -700, 700))), 0.0)
    conflicting = np.flatnonzero(~alone)
    gap = 0.0
    if len(conflicting):
        sets, sizes, of_track = _sets(_contracted(members[conflicting], n), weight[conflicting])
        answer = additive_answer(sets, sizes)
        chosen[conflicting], probability[conflicting] = answer.chosen[of_track], answer.probability[of_track]
        gap = float(answer.gap.max(initial=0.0))
    return Competition(tracks.take(competing), members, chosen, probability, gap)


def groups_of(members: IntArray, n: int) -> tuple[int, IntArray, IntArray]:
    """Groups of tracks connected by common detections: their number, that of each track (k,), of each detection (n,).

    members : (k, S) of the tracks, among n detections; detections without a track have group ABSENT.
    """
    k, column = np.nonzero(members >= 0)
    edges = coo_array((np.ones(len(k), np.int8), (k, len(members) + members[k, column])), shape=(len(members) + n,) * 2)
    _, component = connected_components(edges, directed=False)
    components, of_track = np.unique(component[: len(members)], return_inverse=True)
    number = np.full(int(component.max(initial=0)) + 1, ABSENT)
    number[components] = np.arange(len(components))
    return len(components), of_track, number[component[len(members) :]]


def _contracted(members: IntArray, n: int) -> IntArray:
    """The members (k, S) reduced to at most two of the detections that occur in exactly the same tracks.

    Further ones do not change the packing problem; two are kept so that a track keeps at least two records.
    """
    k, column = np.nonzero(members >= 0)
    record = members[k, column]
    track_code = np.random.default_rng(0).integers(0, 1 << 62, len(members), dtype=np.uint64)
    signature = np.zeros(n, np.uint64)
    np.add.at(signature, record, track_code[k])
    present = np.unique(record)
    order = np.argsort(signature[present], kind="stable")
    ordered = signature[present][order]
    rank = np.arange(len(order)) - np.searchsorted(ordered, ordered)
    kept = np.zeros(n, bool)
    kept[present[order[rank < 2]]] = True
    return np.where((members >= 0) & kept[members], members, ABSENT)


def _sets(members: IntArray, weight: FloatArray) -> tuple[Sets, IntArray, IntArray]:
    """Candidate sets of the tracks and of single records, the sizes of the groups, and the set of each track."""
    k, column = np.nonzero(members >= 0)
    records, number = np.unique(members[k, column], return_inverse=True)
    n, m = len(records), len(members)
    packed = np.full((n + m, int((members >= 0).sum(axis=1).max())), -1)
    packed[:n, 0] = np.arange(n)
    size = np.concatenate([np.ones(n, np.int64), np.bincount(k, minlength=m)])
    packed[n + k, np.arange(len(k)) - Ragged.of_sizes(size[n:]).start[k]] = number
    edges = coo_array((np.ones(len(k), np.int8), (number, n + k)), shape=(n + m, n + m))
    count, component = connected_components(edges, directed=False)
    order = np.lexsort([size, component])
    position = np.empty(n + m, np.int64)
    position[order] = np.arange(n + m)
    log_weight = np.concatenate([np.zeros(n), weight])[order]
    start = Ragged.of_sorted(component[order], count).start
    sets = Sets(packed[order], size[order], log_weight, component[order], start, np.full(count, -np.inf))
    return sets, np.bincount(component[:n], minlength=count), position[n:]
