"""Tracks: sets of detections that one mover could be, grown along the links, and what each weighs.

A track's motion is a place, a rate and a small acceleration on the tangent plane at its first detection, and its error
(a Kalman filter without process noise: one least-squares fit, one detection after another). The acceleration has a
prior that is small for slow movers, so that over a short time motion is linear, over a long one quadratic. The third
detection and each later one weighs

    ln N(x; predicted) − ln β + ln g/n + ln P(shown again, after the exposures passed over),

that probability being the one of a mover that so many exposures have shown of so many that saw its place
(``MotionModel.log_pattern``). Exposures before the first and after the last detection that saw where it then was count
in the same way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.many.marginals import additive_answer
from sameas.many.sets import Sets
from sameas.ragged import Ragged, ranges
from sameas.sky.movers.links import AT_ONCE, Links, rates_of
from sameas.sky.movers.model import DEFAULT_TUNING, MotionModel, Surroundings, Tuning
from sameas.sky.movers.rates import log_normal


@dataclass(frozen=True)
class Tracks:
    """Tracks, (k,) each; made exposure by exposure.

    last : the last detection. parent : the track without it, −1 where that is one detection alone. first : the first
    detection. size : of how many detections. log_weight : ln w against all of them being of no mover, or each of
    another. gain : what the last detection adds to it. saw : exposures that saw its place, from its first detection on.
    log_missed : what those of them that do not show it weigh of ln w. state : (k, 6) place, rate and acceleration at
    the time of the first detection, in arcsec and minutes on its ecliptic axes.
    """

    first: IntArray
    last: IntArray
    parent: IntArray
    size: IntArray
    log_weight: FloatArray
    gain: FloatArray
    saw: IntArray
    log_missed: FloatArray
    state: FloatArray

    def __len__(self) -> int:
        return len(self.last)

    def only(self, keep: BoolArray | IntArray) -> Tracks:
        """Some of the tracks."""
        return Tracks(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    @staticmethod
    def together(parts: list[Tracks]) -> Tracks:
        """All of several lists of tracks."""
        return Tracks(*(np.concatenate([getattr(p, name) for p in parts]) for name in Tracks.__dataclass_fields__))

    def members(self, of: IntArray) -> IntArray:
        """(k, longest) detections of some tracks in the order of time, −1 behind the last one of each."""
        out = np.full((len(of), int(self.size[of].max(initial=1))), -1)
        at, rows = of, np.arange(len(of))
        while len(rows):
            out[rows, self.size[at] - 1] = self.last[at]
            above = self.parent[at] >= 0
            out[rows[~above], 0] = self.first[at[~above]]
            rows, at = rows[above], self.parent[at[above]]
        return out


@dataclass(frozen=True)
class _Open:
    """Tracks that may go on, with the covariances (k, 6, 6) of their states."""

    tracks: Tracks
    covariance: FloatArray

    def only(self, keep: BoolArray | IntArray) -> _Open:
        """Some of the tracks."""
        return _Open(self.tracks.only(keep), self.covariance[keep])

    @staticmethod
    def together(parts: list[_Open]) -> _Open:
        """All of several lists of tracks."""
        return _Open(Tracks.together([p.tracks for p in parts]), np.concatenate([p.covariance for p in parts]))


def grow(around: Surroundings, links: Links, model: MotionModel, tuning: Tuning = DEFAULT_TUNING) -> Tracks:
    """The tracks that the links make: at every detection the best of those that end there."""
    seen = around.detections
    order = np.argsort(seen.frame[links.j], kind="stable")
    links = links.only(order)
    bounds = np.searchsorted(seen.frame[links.j], np.arange(len(seen.frame_names) + 1))
    # No link goes on from an exposure after this one: its covariances, nine tenths of the memory, are given up.
    until = np.full(len(seen.frame_names), -1)
    np.maximum.at(until, seen.frame[links.i], seen.frame[links.j])
    kept: list[_Open] = [_none()]
    offsets = [0]
    # Where in ``kept`` the tracks that end at a detection are: those of one exposure follow each other by detection.
    start, count = np.zeros(len(seen), np.int64), np.zeros(len(seen), np.int64)
    for frame in range(len(seen.frame_names)):
        here = links.only(slice(bounds[frame], bounds[frame + 1]))  # type: ignore[arg-type]
        if not len(here):
            continue
        grown = [_begun(around, here, model, tuning)]
        row, parent = ranges(start[here.i], count[here.i])
        if len(row):
            grown.append(_extended(around, here.only(row), _among(kept, offsets, parent), parent, model, tuning))
        kind = np.concatenate([here.far.astype(np.int64), np.full(len(row) and len(grown[-1].tracks), 2)])
        level = _best(_Open.together(grown), kind, tuning.tracks)
        size = np.bincount(level.tracks.last, minlength=len(seen))
        ended = np.flatnonzero(size)
        count[ended] = size[ended]
        offsets.append(offsets[-1] + len(kept[-1].tracks))
        start[ended] = offsets[-1] + np.searchsorted(level.tracks.last, ended)
        kept.append(level)
        for n, old in enumerate(kept[:-1]):
            if len(old.covariance) and until[seen.frame[old.tracks.last[0]]] <= frame:
                kept[n] = replace(old, covariance=old.covariance[:0])
    return _ended(around, Tracks.together([level.tracks for level in kept]), model, tuning)


def _among(levels: list[_Open], offsets: list[int], number: IntArray) -> _Open:
    """The tracks with some numbers, of levels whose first tracks have the numbers ``offsets``.

    All levels in one list would be copied at every exposure: long series would cost as the square of their length.
    """
    level = np.searchsorted(offsets, number, side="right") - 1
    order = np.argsort(level, kind="stable")
    parts = [levels[n].only(number[level == n] - offsets[n]) for n in np.unique(level).tolist()]
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    return _Open.together(parts).only(back)


def _none() -> _Open:
    no = np.empty(0, np.int64)
    none = np.empty(0)
    return _Open(Tracks(no, no, no, no, none, none, no, none, np.empty((0, 6))), np.empty((0, 6, 6)))


def _ended(around: Surroundings, tracks: Tracks, model: MotionModel, tuning: Tuning) -> Tracks:
    """The tracks, with what the exposures before and after them say that saw where they then were."""
    seen, when = around.detections, around.detections.frame_mjd * 1440.0
    frames, first_minutes = len(when), seen.mjd_utc * 1440.0
    # What is improbable without them they make no more probable; what does not compete need not be known.
    asked = np.flatnonzero((tracks.log_weight > tuning.least_ended) & ~_surpassed(tracks, tuning))
    steps = np.arange(1, tuning.around + 1)
    saw = tracks.saw.copy()
    for part in np.split(asked, range(AT_ONCE, len(asked), AT_ONCE)):
        frame = np.concatenate(
            [seen.frame[tracks.first[part]][:, None] - steps, seen.frame[tracks.last[part]][:, None] + steps], axis=1
        )
        k, column = np.nonzero((frame >= 0) & (frame < frames))
        at, number = part[k], frame[k, column]
        t = (when[number] - first_minutes[tracks.first[at]])[:, None]
        state = tracks.state[at]
        there = state[:, :2] + t * state[:, 2:4] + 0.5 * t * t * state[:, 4:]
        np.add.at(saw, at, around.coverage.saw(around.axes.directions(tracks.first[at], there), number))
    before = model.log_pattern(tracks.size, tracks.saw, tuning)
    pattern = model.log_pattern(tracks.size, saw, tuning)
    missed = pattern - model.log_pattern(tracks.size, tracks.size, tuning)
    return replace(tracks, log_weight=tracks.log_weight + pattern - before, saw=saw, log_missed=missed)


def _surpassed(tracks: Tracks, tuning: Tuning) -> BoolArray:
    """(k,) tracks that do not compete: those of another without its last detections, where these are sure."""
    out = np.zeros(len(tracks), bool)
    sure = (tracks.parent >= 0) & (tracks.gain > tuning.sure)
    out[tracks.parent[sure]] = True
    return out


def _best(grown: _Open, kind: IntArray, most: int) -> _Open:
    """The best tracks of every kind (k,) at every last detection, by detection."""
    tracks = grown.tracks
    order = np.lexsort([-tracks.log_weight, kind, tracks.last])
    code = 3 * tracks.last[order] + kind[order]
    return grown.only(order[np.arange(len(order)) - np.searchsorted(code, code) < most])


def _begun(around: Surroundings, links: Links, model: MotionModel, tuning: Tuning) -> _Open:
    """Tracks of two detections."""
    m = len(links)
    rate, error = rates_of(around, links.i, links.j, links.minutes, links.offset)
    mean, spread = model.rates.prior_at(rate, error)
    state = np.zeros((m, 6))
    state[:, 2:4] = mean
    state[:, 2] += around.reference[links.i]
    covariance = np.zeros((m, 6, 6))
    covariance[:, :2, :2] = around.covariance[links.i]
    covariance[:, 2:4, 2:4] = spread
    speed = np.hypot(*(links.offset / links.minutes[:, None]).T)
    bend = tuning.bend_arcsec_per_min2 * np.maximum(1.0, speed / tuning.bend_rate)
    covariance[:, [4, 5], [4, 5]] = (bend**2)[:, None]
    state, covariance = _updated(state, covariance, links.minutes, links.offset, around.covariance[links.j])
    # A link counts how seldom a detection has a next one; a track, how seldom it begins a mover's.
    two, saw = np.full(m, 2), 2 + links.misses
    pattern = model.log_pattern(two, saw, tuning)
    weight = (
        links.log_ratio - model.log_odds - links.misses * math.log(1.0 - model.p_detect)
        + model.log_begin - around.log_crowding[links.i] + pattern
    )  # fmt: skip
    missed = pattern - model.log_pattern(two, two, tuning)
    return _Open(Tracks(links.i, links.j, np.full(m, -1), two, weight, weight, saw, missed, state), covariance)


def _extended(
    around: Surroundings, links: Links, above: _Open, parent: IntArray, model: MotionModel, tuning: Tuning
) -> _Open:
    """Tracks with one detection more, that of the link beginning where each ends; (m,) of links and tracks."""
    before = above.tracks
    minutes = around.minutes[links.j] - around.minutes[before.first]
    place = around.axes.offsets(before.first, links.j)
    noise = around.covariance[links.j]
    off, spread = _predicted(before.state, above.covariance, minutes, place, noise)
    wide = spread + (tuning.outlier_scale**2 - 1.0) * noise
    fit = np.logaddexp(
        math.log1p(-tuning.outlier) + log_normal(off, spread), math.log(tuning.outlier) + log_normal(off, wide)
    )
    size, saw = before.size + 1, before.saw + links.misses + 1
    pattern = model.log_pattern(size, saw, tuning)
    again = pattern - model.log_pattern(before.size, before.saw, tuning)
    gain = again + fit - around.log_density[links.j] + links.log_brightness
    missed = pattern - model.log_pattern(size, size, tuning)
    # Few of those that a link may continue lie in line with it.
    kept = np.flatnonzero(gain > tuning.least_log_ratio)
    before, covariance = before.only(kept), above.covariance[kept]
    state, covariance = _updated(before.state, covariance, minutes[kept], place[kept], noise[kept])
    longer = Tracks(
        before.first, links.j[kept], parent[kept], size[kept], before.log_weight + gain[kept], gain[kept], saw[kept],
        missed[kept], state,
    )  # fmt: skip
    return _Open(longer, covariance)


def _predicted(
    state: FloatArray, covariance: FloatArray, minutes: FloatArray, place: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(m, 2) residual of a detection from what was predicted, and (m, 2, 2) the covariance of that."""
    t = minutes[:, None]
    off = place - (state[:, :2] + t * state[:, 2:4] + 0.5 * t * t * state[:, 4:])
    factor = np.stack([np.ones(len(minutes)), minutes, 0.5 * minutes**2], axis=1)
    blocks = covariance.reshape(-1, 3, 2, 3, 2)
    return off, np.einsum("ma,maibj,mb->mij", factor, blocks, factor, optimize=True) + noise


def _updated(
    state: FloatArray, covariance: FloatArray, minutes: FloatArray, place: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """State and covariance after a detection."""
    off, spread = _predicted(state, covariance, minutes, place, noise)
    factor = np.stack([np.ones(len(minutes)), minutes, 0.5 * minutes**2], axis=1)
    across = np.einsum("maibj,mb->maij", covariance.reshape(-1, 3, 2, 3, 2), factor).reshape(-1, 6, 2)
    gain = across @ np.linalg.inv(spread)
    updated = covariance - gain @ across.transpose(0, 2, 1)
    updated = 0.5 * (updated + updated.transpose(0, 2, 1))
    return state + np.einsum("mij,mj->mi", gain, off), updated


@dataclass(frozen=True)
class Competition:
    """Tracks that compete for detections: none has a detection that another chosen one has.

    tracks : those that compete. chosen : (k,) those of the best choice. p_track : (k,) probability of each exactly as
    it is. gap : ln of how much more probable another choice could be at most; 0 where it is proved best.
    """

    tracks: Tracks
    members: IntArray
    chosen: BoolArray
    p_track: FloatArray
    gap: float

    def shares(self, n: int) -> tuple[FloatArray, FloatArray]:
        """(k,) probability that one object has two detections of each chosen track, (k, S) each; n in all."""
        members, p = self.members, self.p_track
        owner = np.full(n + 1, -1)
        k, column = np.nonzero((members >= 0) & self.chosen[:, None])
        owner[members[k, column]] = k
        p_tracklet, p_member = np.zeros(len(members)), np.zeros(members.shape)
        position = np.full(n + 1, -1)
        position[members[k, column]] = column
        of = owner[members]  # which chosen track each detection of each track belongs to; −1 reads the last, none
        for track in np.flatnonzero(p > 1e-9):
            mine = of[track][members[track] >= 0]
            for chosen in np.unique(mine[mine >= 0]):
                common = members[track][(of[track] == chosen) & (members[track] >= 0)]
                if len(common) >= 2:
                    p_tracklet[chosen] += p[track]
                    p_member[chosen, position[common]] += p[track]
        return np.minimum(p_tracklet, 1.0), np.minimum(p_member, 1.0)


def compete(tracks: Tracks, n: int, tuning: Tuning = DEFAULT_TUNING, *, time_limit_s: float = 20.0) -> Competition:
    """The best choice of tracks that share no detection, and the probability of each, by set packing.

    tracks : of n detections. Tracks that are another one without its last detections, where these are sure, do not
    compete; nor do those that weigh nothing.
    """
    at = np.flatnonzero(~_surpassed(tracks, tuning) & (tracks.log_weight > tuning.least_competing))
    members = tracks.members(at)
    weight = tracks.log_weight[at]
    use = np.bincount(members[members >= 0], minlength=n)
    alone = np.where(members >= 0, use[members], 1).max(axis=1, initial=1) == 1
    chosen, share = alone & (weight > 0), np.where(alone, 1.0 / (1.0 + np.exp(-np.clip(weight, -700, 700))), 0.0)
    rest = np.flatnonzero(~alone)
    gap = 0.0
    if len(rest):
        sets, sizes, of_track = _sets(_contracted(members[rest], n), weight[rest])
        answer = additive_answer(sets, sizes, time_limit_s=time_limit_s)
        chosen[rest], share[rest] = answer.chosen[of_track], answer.probability[of_track]
        gap = float(answer.gap.max(initial=0.0))
    return Competition(tracks.only(at), members, chosen, share, gap)


def groups_of(members: IntArray, n: int) -> tuple[int, IntArray, IntArray]:
    """How many groups tracks with members (k, S) make that have some of n detections in common; (k,) that of each.

    And (n,) that of each detection, −1 of those of no track.
    """
    k, column = np.nonzero(members >= 0)
    edges = coo_array((np.ones(len(k), np.int8), (k, len(members) + members[k, column])), shape=(len(members) + n,) * 2)
    _, part = connected_components(edges, directed=False)
    there, of_track = np.unique(part[: len(members)], return_inverse=True)
    number = np.full(int(part.max(initial=0)) + 1, -1)
    number[there] = np.arange(len(there))
    return len(there), of_track, number[part[len(members) :]]


def _contracted(members: IntArray, n: int) -> IntArray:
    """The members (k, S) without detections that are in exactly the same tracks as two others.

    What cannot be told apart by the tracks that it is in need not be carried along twice; two of each kind stay, so
    that a track keeps two records or more.
    """
    k, column = np.nonzero(members >= 0)
    record = members[k, column]
    code = np.random.default_rng(0).integers(0, 1 << 62, len(members), dtype=np.uint64)
    kind = np.zeros(n, np.uint64)
    np.add.at(kind, record, code[k])
    there = np.unique(record)
    order = np.argsort(kind[there], kind="stable")
    ordered = kind[there][order]
    place = np.arange(len(order)) - np.searchsorted(ordered, ordered)
    kept = np.zeros(n, bool)
    kept[there[order[place < 2]]] = True
    return np.where((members >= 0) & kept[members], members, -1)


def _sets(members: IntArray, weight: FloatArray) -> tuple[Sets, IntArray, IntArray]:
    """The tracks as candidate sets beside their records alone, the sizes of the groups, and the set of each track."""
    k, column = np.nonzero(members >= 0)
    records, number = np.unique(members[k, column], return_inverse=True)
    n, m = len(records), len(members)
    packed = np.full((n + m, int((members >= 0).sum(axis=1).max())), -1)
    packed[:n, 0] = np.arange(n)
    size = np.concatenate([np.ones(n, np.int64), np.bincount(k, minlength=m)])
    packed[n + k, np.arange(len(k)) - Ragged.of_sizes(size[n:]).start[k]] = number
    edges = coo_array((np.ones(len(k), np.int8), (number, n + k)), shape=(n + m, n + m))
    count, part = connected_components(edges, directed=False)
    order = np.lexsort([size, part])
    place = np.empty(n + m, np.int64)
    place[order] = np.arange(n + m)
    log_weight = np.concatenate([np.zeros(n), weight])[order]
    start = Ragged.of_sorted(part[order], count).start
    sets = Sets(packed[order], size[order], log_weight, part[order], start, np.full(count, -np.inf))
    return sets, np.bincount(part[:n], minlength=count), place[n:]
