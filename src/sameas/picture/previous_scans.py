"""The rules of previous scans: the history of two tracks, and their velocities where they have none in common."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, taken
from sameas.errors import InputError
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.kernels.tracks import places_of
from sameas.picture.named_tracks import NamedTracks
from sameas.picture.tables import Scan, distances, objects_per_m2
from sameas.picture.track_pairs import keys
from sameas.representation import in_short
from sameas.tracks.kinds import KINDS


@in_short
@dataclass(frozen=True)
class PreviousScans(Rule):
    """The evidence of previous scans on pairs of named tracks; made by :meth:`sameas.picture.memory.TrackMemory.rule`.

    ln r of a pair has two parts, which count differently in a set of tracks of three sources or more:

    - The level, the same for all ways to match the tracks of rivals, shows whether sources have objects in common. The
      best reference counts, so that one source with a wrong time or wrong errors does not separate the others.
    - The difference from the level, 0 or less, shows which of the rivals is the object. All sources count by their
      precision. With the best reference of each set, a wrong set would count only the more favourable part of the
      evidence: of two tracks of the same wrong ship, one.

    Parameters
    ----------
    numbers : by source name, the track number of each row of the source's table, ABSENT for rows without an id.
    first, second : (k,) numbers of tracks, first < second, in ascending order. log_ratio : (k,) their ln r.
    level : (k,) of ln r; None if every set counts its best reference. precision : (k,) sum of the precisions of both
        tracks, above 0; required with a level.

    Example
    -------
    >>> from sameas import Radius, Records
    >>> radar = Records.of([[0.0, 0.0], [9.0, 0.0]], sigma=5.0, source="radar")
    >>> ais = Records.of([[5.0, 0.0]], sigma=5.0, source="ais")
    >>> previous = PreviousScans({"radar": [3, 4], "ais": [7]}, first=[3], second=[7], log_ratio=[5.5])
    >>> previous(Radius(5.0)(radar, ais)).log_ratio.tolist()
    [5.5, 0.0]
    """

    numbers: Mapping[str, ArrayLike] = field(repr=False)
    first: ArrayLike
    second: ArrayLike
    log_ratio: ArrayLike
    level: ArrayLike | None = None
    precision: ArrayLike | None = None

    def __post_init__(self) -> None:
        first, second, log_ratio = np.asarray(self.first), np.asarray(self.second), np.asarray(self.log_ratio)
        if not len(first) == len(second) == len(log_ratio) or np.any(first >= second):
            raise InputError("PreviousScans: give first, second and log_ratio of every pair of tracks, first < second")
        if np.any(np.diff(self._keys) <= 0):
            raise InputError("PreviousScans: give every pair of tracks once, in ascending order")
        if (self.level is None) != (self.precision is None):
            raise InputError("PreviousScans: give level and precision of every pair of tracks, or neither")

    def __call__(self, pairs: Pairs) -> Evidence:
        return Evidence({"memory": self.of_pairs(pairs, self.log_ratio)})

    def parts(self) -> tuple[Rule, ...]:
        """The level, and the differences from it; the rule itself without a level."""
        return (self,) if self.level is None else (_Level(self), _RivalHistories(self))

    def of_pairs(self, pairs: Pairs, values: ArrayLike) -> FloatArray:
        """(m,) the values (k,) of the pairs' tracks; 0 for pairs that are not among them."""
        return np.append(np.asarray(values, dtype=np.float64), 0.0)[self.rows(pairs)]

    def rows(self, pairs: Pairs) -> IntArray:
        """(m,) the pair of tracks of each pair of records, ABSENT for those not among them. Several rules ask for the
        same pairs, which are looked up once."""
        known = self._looked_up.get(id(pairs))
        if known is None:
            one, two = (
                np.asarray(self.numbers.get(side.source, np.full(side.n_table, ABSENT)))[side.rows[at]]
                for side, at in ((pairs.first, pairs.i), (pairs.second, pairs.j))
            )
            pair_key = np.where((one >= 0) & (two >= 0), keys(np.minimum(one, two), np.maximum(one, two)), ABSENT)
            known = pairs, places_of(self._keys, pair_key)
            self._looked_up[id(pairs)] = known
        return known[1]

    @cached_property
    def _keys(self) -> IntArray:
        return keys(np.asarray(self.first), np.asarray(self.second))

    @cached_property
    def _looked_up(self) -> dict[int, tuple[Pairs, IntArray]]:
        """By the identity of pairs, these, so that the identity stays theirs, and their rows."""
        return {}


@dataclass(frozen=True)
class _Level(Rule):
    """The level of a history: see :class:`PreviousScans`."""

    history: PreviousScans

    def __call__(self, pairs: Pairs) -> Evidence:
        assert self.history.level is not None
        return Evidence({"memory": self.history.of_pairs(pairs, self.history.level)})


@dataclass(frozen=True)
class _RivalHistories(Rule):
    """How much less probable the history of each pair is than its level: see :class:`PreviousScans`."""

    history: PreviousScans

    def __call__(self, pairs: Pairs) -> Evidence:
        history = self.history
        assert history.level is not None and history.precision is not None
        difference = np.asarray(history.log_ratio, np.float64) - np.asarray(history.level, np.float64)
        precision = history.of_pairs(pairs, history.precision)
        return Evidence({"memory": history.of_pairs(pairs, difference)}, precision=precision)


#: Shares of velocities that are right, and that have ten times their stated errors; the rest is of any other object.
VELOCITY_SHARES = (0.99, 0.01)
#: Probability that an object which AIS names as a ship is one that ADS-B names as an aircraft, or the reverse (chosen).
WRONG_TARGET = 1e-3
#: First digits of the MMSI of search and rescue aircraft, which send both.
RESCUE_AIRCRAFT = "111"


@dataclass(frozen=True)
class FirstContact(Rule):
    """The evidence of velocities and kinds of targets on pairs that were never surely one object.

    Positions alone join an aircraft that passes over a ship to it, for an instant. The ratio of the probabilities of
    the difference Δ of two velocities with covariances V_a, V_b, if both are of one object and if not, is

        r = [0.99 N(Δ; 0, V) + 0.01 N(Δ; 0, 100 V)] / N(Δ; 0, S) + ε²,   V = V_a + V_b,   S = s_a² + s_b²,

    s the usual speeds of both sources' targets and ε ``report_reassigned``. It counts at most as 1: equal velocities do
    not join two records, since most ships in a harbour have the velocity 0. The history of a pair contains its
    velocities, as displacements: the lower of both counts. Where one source names ships and the other aircraft, the
    ratio is :data:`WRONG_TARGET` times that.

    scan : of the instant. records : by source name, the record of the scan of each row of the source's table, or
        ABSENT.
    history : of the pairs of tracks. sure : (k,) which of them were sure before.
    tracks : of the scan. Where both were before (:meth:`NamedTracks.log_met`) is in the history of a pair from the next
        instant on; at its first one it counts here.
    """

    scan: Scan = field(repr=False)
    records: Mapping[str, IntArray] = field(repr=False)
    history: PreviousScans
    sure: BoolArray = field(repr=False)
    tracks: NamedTracks = field(repr=False)

    def __call__(self, pairs: Pairs) -> Evidence:
        out = np.zeros(len(pairs))
        first, second = (self.records.get(side.source) for side in (pairs.first, pairs.second))
        if first is not None and second is not None:
            a, b = first[pairs.first.rows[pairs.i]], second[pairs.second.rows[pairs.j]]
            pair = self.history.rows(pairs)
            at = np.flatnonzero((a >= 0) & (b >= 0) & ~np.append(self.sure, False)[pair])
            met, new = np.zeros(len(at)), pair[at] < 0
            met[new] = self.tracks.log_met(a[at[new]], b[at[new]], objects_per_m2(self.scan.now))
            counted = met + np.minimum(np.append(np.asarray(self.history.log_ratio), 0.0)[pair[at]], 0.0)
            out[at] = np.minimum(self._by_velocity(a[at], b[at]) - counted, 0.0) + self._by_target(a[at], b[at]) + met
        return Evidence({"velocity": out})

    def _by_velocity(self, a: IntArray, b: IntArray) -> FloatArray:
        """(k,) ln r of the velocities of records; 0 where one has none."""
        scan, out = self.scan, np.zeros(len(a))
        at = np.flatnonzero(scan.moving[a] & scan.moving[b])
        a, b = a[at], b[at]
        chi_sq, determinant = distances(scan.state, scan.covariance, a, b, column=2)
        delta = (taken(scan.state, a) - taken(scan.state, b))[:, 2:]
        variance = scan.speed_m_per_s[a] ** 2 + scan.speed_m_per_s[b] ** 2
        log_other = -0.5 * (delta[:, 0] ** 2 + delta[:, 1] ** 2) / variance - np.log(variance)
        right, wide = np.log(VELOCITY_SHARES)
        log_same = np.logaddexp(right - 0.5 * chi_sq, wide - math.log(100.0) - 0.005 * chi_sq)
        log_same -= 0.5 * np.log(determinant)
        log_ratio = np.logaddexp(log_same - log_other, 2.0 * math.log(scan.tuning.report_reassigned))
        out[at] = np.where(np.isfinite(variance), np.minimum(log_ratio, 0.0), 0.0)
        return out

    def _by_target(self, a: IntArray, b: IntArray) -> FloatArray:
        """(k,) ln of :data:`WRONG_TARGET` for a ship and an aircraft, 0 for others."""
        out, target = np.zeros(len(a)), np.array([KINDS[d.kind].target for d in self.scan.now.descriptions])
        of_sources = (target != target[:, None]) & (target != "") & (target != "")[:, None]
        differ = np.flatnonzero(of_sources[self.scan.source[a], self.scan.source[b]])
        if len(differ):
            rescue = np.array([name.startswith(RESCUE_AIRCRAFT) for name in self.scan.texts("mmsi").tolist()])
            out[differ] = np.where(rescue[a[differ]] | rescue[b[differ]], 0.0, math.log(WRONG_TARGET))
        return out
