"""Track history: the objects of the picture that each named track was assigned to."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sameas.arrays import BoolArray, ColumnTable, FloatArray, IntArray, is_dense, ordered_by, spans_in
from sameas.kernels.compiled import runs_compiled
from sameas.kernels.tracks import find_rows, list_rows, places_of
from sameas.picture.tuning import Tuning
from sameas.ragged import ranges

MIN_SHARE = 1e-3  # smaller shares of a track's history are dropped


@dataclass(frozen=True)
class TrackHistory(ColumnTable):
    """The objects that each track was assigned to, (k,) each, ordered by track, then by object.

    If the records of one object split for an instant and join again, its number stays with the tracks that were
    assigned to it for long: one wrong instant does not change numbers. A track that changes to another object
    permanently counts as that object's after some minutes. Shares change at the instants whose scan has the track:
    s ← s e^(−Δt/τ), plus 1 − e^(−Δt/τ) for its present object; τ is ``history_s``.

    track, number : of the track and the object. share : s. last : whether the track was assigned to the object in its
    last scan. unique : whether the track's id is unique. instant_s : the last instant.
    """

    WHOLE = frozenset({"instant_s"})
    instant_s: float = -math.inf
    track: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    share: FloatArray = field(default_factory=lambda: np.empty(0))
    last: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    unique: BoolArray = field(default_factory=lambda: np.empty(0, bool))

    def __len__(self) -> int:
        return len(self.track)

    def advance(
        self,
        instant_s: float,
        track: IntArray,
        number: IntArray,
        unique: BoolArray,
        alive: IntArray,
        tuning: Tuning,
        forgotten: IntArray | None = None,
    ) -> TrackHistory:
        """The history after a later instant.

        track, number, unique : (m,) the tracks of its scan, their objects, and whether their ids are unique.
        alive : ascending numbers of the objects that have not ended. Of ended objects only unique ids are kept: a track
            that was part of another object for a while returns with its own number. forgotten : tracks whose ids have
            timed out; None for none.
        """
        fade = math.exp(-(instant_s - self.instant_s) / tuning.history_s) if len(self) else 0.0
        at, row = self.of(track)
        in_scan = np.zeros(len(self), bool)
        in_scan[row] = True
        keep = (places_of(alive, self.number) >= 0) | self.unique
        if forgotten is not None and len(forgotten):
            keep &= ~np.isin(self.track, forgotten)
        keep &= ~in_scan | (fade * self.share >= MIN_SHARE)
        earlier = TrackHistory(
            instant_s, self.track, self.number, np.where(in_scan, fade * self.share, self.share), self.last & ~in_scan,
            self.unique,
        ).take(keep)  # fmt: skip
        # A new track has the share 1 in its first object.
        has_history = np.zeros(len(track), bool)
        has_history[at[keep[row]]] = True
        latest = TrackHistory(
            instant_s, track, number, np.where(has_history, 1.0 - fade, 1.0), np.ones(len(track), bool), unique
        )
        return earlier._with(latest)

    def of(self, tracks: IntArray) -> tuple[IntArray, IntArray]:
        """(m,) indices in ``tracks`` (k,) and (m,) rows of the history, of all rows of these tracks."""
        if not (runs_compiled(find_rows) and is_dense(self.track, tracks)):
            return ranges(*spans_in(self.track, tracks))
        first, size = np.empty((2, len(tracks)), np.int64)
        at, row = np.empty((2, find_rows(self.track, np.ascontiguousarray(tracks), first, size)), np.int64)
        list_rows(first, size, at, row)
        return at, row

    def last_of(self, tracks: IntArray) -> IntArray:
        """(k,) the object of each track in its last scan, 0 for none."""
        out = np.zeros(len(tracks), np.int64)
        at, row = self.of(tracks)
        out[at[self.last[row]]] = self.number[row[self.last[row]]]
        return out

    def together(self, tracks: IntArray, others: IntArray) -> BoolArray:
        """(k,) whether each track (k,) and the other (k,) were assigned to one object, in their history."""
        radix = int(self.number.max(initial=0)) + 1
        (at, row), (other_at, other_row) = self.of(tracks), self.of(others)
        # Both ascend, as the rows of a track do.
        common = places_of(at * radix + self.number[row], other_at * radix + self.number[other_row]) >= 0
        out = np.zeros(len(tracks), bool)
        out[other_at[common]] = True
        return out

    def main_ended(self, tracks: IntArray, alive: IntArray) -> IntArray:
        """(k,) the object that each track was in most of the time, of those that are not ``alive``; 0 for none."""
        out, best = np.zeros(len(tracks), np.int64), np.zeros(len(tracks))
        at, row = self.of(tracks)
        ended = ~np.isin(self.number[row], alive)
        at, row = at[ended], row[ended]
        np.maximum.at(best, at, self.share[row])
        is_best = self.share[row] == best[at]
        out[at[is_best]] = self.number[row[is_best]]
        return out

    def _with(self, more: TrackHistory) -> TrackHistory:
        """The rows of both, merged per track and object; ``more`` has one row per track."""
        at, row = self.of(more.track)
        same = self.number[row] == more.number[at]
        at, row = at[same], row[same]
        share, last, unique = self.share.copy(), self.last.copy(), self.unique.copy()
        share[row] += more.share[at]
        last[row] |= more.last[at]
        unique[row] |= more.unique[at]
        merged, is_new = self.changed(share=share, last=last, unique=unique), np.ones(len(more), bool)
        is_new[at] = False
        if not is_new.any():
            return merged
        both = merged.stacked(more.take(is_new))
        return both.take(ordered_by([both.track, both.number]))
