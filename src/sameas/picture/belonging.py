"""Belonging: which objects of the picture a track has been of, and for what share of the last minutes.

Where the records of one object part for an instant and come together again, its number comes back with the tracks that
were its own for long: what was wrong for an instant does not decide who is who. And a track that goes over to another
object for good takes it for its own after some minutes.

Shares go by the instants that show the track: s ← s e^(−Δt/τ), and 1 − e^(−Δt/τ) more for the object that it is of.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sameas.picture.named import found_in
from sameas.picture.roll import BoolArray
from sameas.picture.rows import Rows
from sameas.records import FloatArray, IntArray

#: τ, seconds. Taken.
LASTS_S = 300.0
#: A smaller share is forgotten.
LEAST = 1e-3


@dataclass(frozen=True)
class Belonging(Rows):
    """Tracks and objects that they have been of, (k,) each, by ascending track, then object.

    track, number : of the track and the object. share : of the last minutes. last : whether it is the object that the
    track was of when it was last shown. unique : whether nobody else bears the track's name. instant_s : the last one.
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

    def on(self, instant_s: float, track: IntArray, number: IntArray, unique: BoolArray, alive: IntArray) -> Belonging:
        """After a later instant.

        Parameters
        ----------
        track, number, unique : (m,) the tracks that it shows, the objects that they are of, whether nobody else bears
            their names.
        alive : ascending numbers of the objects that have not ended. Of those that have only names that nobody else
            bears are kept.
        """
        fade = math.exp(-(instant_s - self.instant_s) / LASTS_S) if len(self) else 0.0
        shown = np.isin(self.track, track)
        keep = (found_in(alive, self.number) >= 0) | (self.unique & self.last & ~shown)
        old = Belonging(
            instant_s, self.track, self.number, np.where(shown, fade * self.share, self.share), self.last & ~shown,
            self.unique,
        ).take(np.flatnonzero(keep & (~shown | (fade * self.share >= LEAST))))  # fmt: skip
        # Who was of nobody before is wholly of its first object.
        known = np.isin(track, old.track)
        more = Belonging(instant_s, track, number, np.where(known, 1.0 - fade, 1.0), np.ones(len(track), bool), unique)
        return old._with(more)

    def of(self, tracks: IntArray) -> tuple[IntArray, IntArray]:
        """(m,) places in ``tracks`` (k,) and (m,) rows here of everything that these tracks have been of."""
        low, high = (np.searchsorted(self.track, tracks, side) for side in ("left", "right"))
        width = high - low
        at = np.repeat(np.arange(len(tracks)), width)
        return at, np.arange(len(at)) - np.repeat(np.cumsum(width) - width, width) + np.repeat(low, width)

    def last_of(self, tracks: IntArray) -> IntArray:
        """(k,) the object that each track was of when it was last shown, 0 for none."""
        out = np.zeros(len(tracks), np.int64)
        at, row = self.of(tracks)
        out[at[self.last[row]]] = self.number[row[self.last[row]]]
        return out

    def _with(self, more: Belonging) -> Belonging:
        """Rows of both, those of one track and object as one."""
        whole = self.stacked(more)
        key = np.column_stack([whole.track, whole.number])
        rows, back = np.unique(key, axis=0, return_inverse=True)
        back, n = back.reshape(-1), len(rows)
        share = np.asarray(np.bincount(back, whole.share, n), np.float64)
        last, unique = (np.bincount(back, column, n) > 0 for column in (whole.last, whole.unique))
        return Belonging(self.instant_s, rows[:, 0], rows[:, 1], share, last, unique)
