"""A picture against the truth: are the right records one object, do objects keep their numbers, are states honest?

For trials whose truth is known: simulated ones, or real motion with modelled sensors. Identity metrics take a table of
identities, one row per record and instant, from whatever program: when, of which source, which number the program gave
its object, and which object it truly is (−1: false). So other programs are judged by the same code.

- :func:`pair_score` : precision, recall and F1 of the pairs of records, and the share of instants wholly right.
- :func:`siap` : completeness, ambiguity, spuriousness, continuity, switches of identity. :func:`majority_votes` :
  which true object an object of the picture stands for.
- :func:`nees` : whether fused states are as near to the truth as their covariances say. :func:`mean_gospa` : how far
  the picture as a whole is from the truth.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.assignment import assign, refuse_crowds
from sameas.errors import InputError
from sameas.gate import Radius
from sameas.gaussian import mahalanobis_sq
from sameas.groups import groups
from sameas.prior import PerPair
from sameas.records import Records
from sameas.representation import in_short
from sameas.score.pairs import PairScore

# GOSPA: how far a fused picture is from the truth, wrong places, missed objects and false ones in one number.
#
# Generalized optimal sub-pattern assignment with α = 2 (Rahmathullah, García-Fernández, Svensson, "Generalized optimal
# sub-pattern assignment metric", FUSION 2017, definition 1 and proposition 1):
#
#     GOSPA^p = min over one-to-one sets of pairs of  Σ_pairs min(d, c)^p + c^p/2 · (missed + false),
#
# d the distance, c the cutoff. It is a matching of greatest Σ (c^p − d^p) over pairs nearer than c, which the gate, the
# groups and the assignment of this package solve, whatever the size of the picture.


@dataclass(frozen=True)
class Gospa:
    """The metric and its parts; ``distance`` is in the unit of the positions, the parts in that unit to the ``order``.

    localisation : Σ d^p of the matched. missed, false : numbers of objects that nothing was matched to, and of found
    ones that are matched to nothing.
    """

    localisation: float
    missed: int
    false: int
    cutoff: float
    order: float

    @property
    def distance(self) -> float:
        """The metric: (localisation + c^p/2 · (missed + false))^(1/p)."""
        total = self.localisation + 0.5 * self.cutoff**self.order * (self.missed + self.false)
        return float(total ** (1.0 / self.order))


def gospa(found: ArrayLike, true: ArrayLike, *, cutoff: float, order: float = 2.0) -> Gospa:
    """How far the objects ``found`` (n, d) are from the ``true`` ones (m, d).

    Parameters
    ----------
    cutoff : c, the distance from which on a found object is no estimate of a true one.
    order : p ≥ 1; 2 weighs distances as variances do.

    Example
    -------
    >>> picture = gospa([[0.0, 0.0], [9.0, 9.0]], [[0.0, 1.0], [5.0, 0.0]], cutoff=2.0)
    >>> picture.missed, picture.false, round(picture.distance**2, 6)
    (1, 1, 5.0)
    """
    rows_found, rows_true, distance = nearest_match(found, true, cutoff=cutoff, order=order)
    missed, false = len(np.asarray(true)) - len(rows_true), len(np.asarray(found)) - len(rows_found)
    return Gospa(float(np.sum(distance**order)), missed, false, cutoff, order)


def nearest_match(
    found: ArrayLike, true: ArrayLike, *, cutoff: float, order: float = 2.0
) -> tuple[IntArray, IntArray, FloatArray]:
    """The one-to-one match that the metric takes: rows of ``found`` and ``true``, (k,) each, and their distances (k,).

    Pictures that lie farther apart than ``cutoff`` can be matched all at once: the match of each is that of it alone.
    """
    if not (0.0 < cutoff < math.inf and 1.0 <= order < math.inf):
        raise InputError(
            f"gospa: cutoff is {cutoff}, order {order}; give a positive distance and an order of 1 or more"
        )
    # Errors of c/√2 each: Mahalanobis distances are distances over the cutoff.
    sides = [Records.of(_places(x), sigma=cutoff / math.sqrt(2.0)) for x in (found, true)]
    if sides[0].d != sides[1].d:
        raise InputError(f"gospa: found objects have {sides[0].d} features, true ones {sides[1].d}; give the same")
    for side, name in zip(sides, ("found", "true"), strict=True):
        if len(side) < side.n_table:
            raise InputError(f"gospa: a {name} object has no position (first: row {side.set_aside.rows[0]})")
    pairs = Radius(1.0)(*sides)
    refuse_crowds(pairs)
    grouped = groups(pairs)
    gain = 1.0 - pairs.mahalanobis_sq ** (order / 2.0)
    best = assign(grouped, gain, PerPair(0.0)(grouped.sizes_1, grouped.sizes_2))
    chosen = grouped.order[best.chosen]
    distance = cutoff * np.sqrt(pairs.mahalanobis_sq[chosen])
    return pairs.i[chosen].astype(np.int64), pairs.j[chosen].astype(np.int64), distance


def _places(positions: ArrayLike) -> FloatArray:
    places = np.asarray(positions, np.float64)
    if places.ndim != 2 or not places.shape[1]:
        raise InputError(f"gospa: positions have shape {places.shape}; give (objects, features), (0, d) for none")
    return places


FALSE = -1


@in_short
@dataclass(frozen=True)
class Identities:
    """Which object every record was identified with, and which it is. Make it with :meth:`of`.

    Attributes
    ----------
    time_s : (n,) the instant. source : (n,) number of the source. assigned : (n,) number of the object in the picture.
    true : (n,) number of the true object, −1 for a false record. Rows are in the order of instants.
    """

    time_s: FloatArray
    source: IntArray
    assigned: IntArray
    true: IntArray

    @classmethod
    def of(cls, records: Mapping[str, ArrayLike], true: ArrayLike) -> Identities:
        """From the columns time_s, source and object of a picture's records, and the truth of each row.

        A record without an object (masked, or a negative number) is an object of its own.

        Raises
        ------
        InputError : a column is missing or of another length.
        """
        missing = [name for name in ("time_s", "source", "object") if name not in records]
        if missing:
            raise InputError(f"identities: no column {missing[0]}; give time_s, source and object")
        time_s, truth = np.asarray(records["time_s"], np.float64), np.asarray(true, np.int64)
        assigned = np.ma.filled(np.ma.asarray(records["object"]), -1).astype(np.int64)
        _, source = np.unique(np.asarray(records["source"]).astype(str), return_inverse=True)
        if not len(time_s) == len(truth) == len(assigned) == len(source):
            raise InputError(f"identities: {len(time_s)} times for {len(assigned)} objects and {len(truth)} truths")
        assigned = np.where(assigned < 0, assigned.max(initial=0) + 1 + np.arange(len(assigned)), assigned)
        order = np.lexsort([source, assigned, time_s])
        return cls(time_s[order], source[order].astype(np.int64), assigned[order], truth[order])

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def instants(self) -> tuple[FloatArray, IntArray]:
        """The distinct times (k,), and which of them every row is of (n,)."""
        times, which = np.unique(self.time_s, return_inverse=True)
        return times, which.astype(np.int64)


@in_short
@dataclass(frozen=True)
class PictureScore:
    """Pairs of records of two sources, over all instants. right : (k,) whether each instant is wholly right."""

    pairs: PairScore
    right: BoolArray

    @property
    def share_right(self) -> float:
        """Share of the instants at which every record is with exactly those that are the same object; NaN without."""
        return float(self.right.mean()) if len(self.right) else math.nan


def pair_score(identities: Identities) -> PictureScore:
    """Precision, recall and F1 of pairs, and instants wholly right.

    A pair is two records of different sources at one instant; it is claimed where both are in one object, true
    where both are of one true object. Where a source shows an object twice (a track that broke, and its successor),
    it has as many true pairs with another source as can be made one to one.

    Example
    -------
    >>> records = {"time_s": [0, 0, 0, 0], "source": ["a", "b", "a", "b"], "object": [1, 1, 2, 3]}
    >>> score = pair_score(Identities.of(records, [5, 5, 6, 6]))
    >>> score.pairs.precision, score.pairs.recall, score.share_right
    (1.0, 0.5, 0.0)
    """
    times, instant = identities.instants
    single = len(identities) + np.arange(len(identities))
    true = np.where(identities.true == FALSE, single, identities.true)
    of_assigned = _Sightings.of(instant, identities.assigned, identities.source).pairs(len(times))
    true_of = _Sightings.of(instant, true, identities.source).pairs_one_to_one(len(times))
    both = np.unique(np.column_stack([identities.assigned, true]), axis=0, return_inverse=True)[1].reshape(-1)
    right_of = _Sightings.of(instant, both, identities.source).pairs_one_to_one(len(times))
    score = PairScore(int(of_assigned.sum()), int(true_of.sum()), int(right_of.sum()))
    return PictureScore(score, (of_assigned == right_of) & (true_of == right_of))


@dataclass(frozen=True)
class _Sightings:
    """How often each source shows each object at each instant (c,), sources that show it least first."""

    instant: IntArray
    begins: BoolArray
    times: IntArray

    @classmethod
    def of(cls, instant: IntArray, object: IntArray, source: IntArray) -> _Sightings:
        cells, times = np.unique(np.column_stack([instant, object, source]), axis=0, return_counts=True)
        order = np.lexsort([times, cells[:, 1], cells[:, 0]])
        cells, begins = cells[order], np.ones(len(cells), bool)
        begins[1:] = np.any(cells[1:, :2] != cells[:-1, :2], axis=1)
        return cls(cells[:, 0], begins, times[order])

    def pairs(self, count: int) -> IntArray:
        """(count,) pairs of records of different sources in one object, per instant."""
        first = np.flatnonzero(self.begins)
        whole, own = (np.add.reduceat(x, first) if len(first) else x for x in (self.times, self.times**2))
        return np.bincount(self.instant[first], (whole**2 - own) // 2, count).astype(np.int64)

    def pairs_one_to_one(self, count: int) -> IntArray:
        """(count,) the most pairs with no record twice between two sources: Σ_{a<b} min(c_a, c_b), per instant."""
        n = len(self.instant)
        ends = np.append(np.flatnonzero(self.begins)[1:], n)
        after = (ends[np.cumsum(self.begins) - 1] if n else ends[:0]) - 1 - np.arange(n)
        return np.bincount(self.instant, self.times * after, count).astype(np.int64)


@dataclass(frozen=True)
class Siap:
    """Metrics of the Single Integrated Air Picture, and switches.

    Attributes
    ----------
    completeness : share of the true objects, over instants, that an object of the picture stands for; 1 is best.
    ambiguity : objects of the picture that stand for a true object, per true object that has one; 1 is best.
    spuriousness : share of the picture's objects that stand for no true object; 0 is best.
    continuity : share of the true objects' time for which the one that stands for them longest does; 1 is best.
    number_changes_per_hour : the least number of changes of number with which the picture can be followed, per hour of
        objects followed.
    switches : how often a true object's number changes from the one it had last (identity switches of CLEAR MOT).
    """

    completeness: float
    ambiguity: float
    spuriousness: float
    continuity: float
    number_changes_per_hour: float
    switches: int


def siap(identities: Identities) -> Siap:
    """How completely, unambiguously and lastingly the objects of a picture stand for the true ones.

    An object of the picture stands for the true object that most of its records are of at the instant; where the vote
    is even, or the most are false, for none. An object that a source shows exists; one that no source shows is not
    asked for. Times are counted in instants.

    Source: Votruba, Nisley, Rothrock and Zombro, "Single Integrated Air Picture (SIAP) Metrics Implementation", SIAP SE
    TF Technical Report 2001-001 (2001): completeness, ambiguity, spurious tracks, longest track segment, rate of track
    number change. Switches: Bernardin and Stiefelhagen, EURASIP J. Image Video Process. 2008, 246309.

    Example
    -------
    >>> records = {"time_s": [0, 1, 2, 3], "source": ["a"] * 4, "object": [1, 1, 2, 2]}
    >>> found = siap(Identities.of(records, [0, 0, 0, 0]))
    >>> found.completeness, found.continuity, found.switches
    (1.0, 0.5, 1)
    """
    majority = majority_votes(identities)
    held_by = majority.where(majority.true != FALSE)
    times, instant = identities.instants
    n_true = len(np.unique(np.column_stack([instant, identities.true])[identities.true != FALSE], axis=0))
    held = len(np.unique(np.column_stack([held_by.instant, held_by.true]), axis=0))
    single = [held_by.where(held_by.true == one) for one in np.unique(held_by.true)]
    hours = held * _step(times) / 3600.0
    return Siap(
        completeness=_ratio(held, n_true),
        ambiguity=_ratio(len(held_by), held),
        spuriousness=_ratio(len(majority) - len(held_by), len(majority)),
        continuity=_ratio(sum(_longest(one) for one in single), n_true),
        number_changes_per_hour=_ratio(sum(_fewest_changes(one) for one in single), hours),
        switches=sum(_switches(one) for one in single),
    )


@in_short
@dataclass(frozen=True)
class MajorityVotes:
    """Per object of the picture and instant (k,), in the order of time: which true object it stands for.

    instant : which of the distinct times. assigned : the object's number in the picture. true : of the true object that
    most of its records are of; −1 where the vote is even or the most are false. votes : the number of those records.
    """

    time_s: FloatArray
    instant: IntArray
    assigned: IntArray
    true: IntArray
    votes: IntArray

    def __len__(self) -> int:
        return len(self.assigned)

    def where(self, which: BoolArray) -> MajorityVotes:
        """Some of the rows."""
        return MajorityVotes(*(column[which] for column in vars(self).values()))


def majority_votes(identities: Identities) -> MajorityVotes:
    """Which true object every object of the picture stands for at every instant."""
    times, instant = identities.instants
    cells, votes = np.unique(
        np.column_stack([instant, identities.assigned, identities.true]), axis=0, return_counts=True
    )
    # The most votes stand last of each object.
    order = np.lexsort([votes, cells[:, 1], cells[:, 0]])
    cells, votes = cells[order], votes[order]
    last = np.ones(len(cells), bool)
    last[:-1] = np.any(cells[1:, :2] != cells[:-1, :2], axis=1)
    even = np.zeros(len(cells), bool)
    even[1:] = ~last[:-1] & (votes[1:] == votes[:-1])
    true = np.where(even, FALSE, cells[:, 2])
    return MajorityVotes(times[cells[last, 0]], cells[last, 0], cells[last, 1], true[last], votes[last])


def _longest(one: MajorityVotes) -> int:
    """Instants for which the object that stands longest for a true one does."""
    return int(np.unique(one.assigned, return_counts=True)[1].max())


def _fewest_changes(one: MajorityVotes) -> int:
    """Changes of number when every instant keeps the number that lasts longest without a gap."""
    held = [set(one.assigned[one.instant == step].tolist()) for step in np.unique(one.instant)]
    changes, going = 0, held[0]
    for now in held[1:]:
        going = going & now
        if not going:
            changes, going = changes + 1, now
    return changes


def _switches(one: MajorityVotes) -> int:
    """Changes of the number that was last, which is kept for as long as it stands for the object."""
    last, switches = -1, 0
    for step in np.unique(one.instant):
        here = np.flatnonzero(one.instant == step)
        if last in one.assigned[here]:
            continue
        best = int(one.assigned[here[np.lexsort([one.assigned[here], -one.votes[here]])[0]]])
        switches += last >= 0
        last = best
    return switches


def _step(times: FloatArray) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else math.nan


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


@dataclass(frozen=True)
class Nees:
    """Normalised estimation error squared of n states of d components: on average d where covariances are honest.

    low, high : between which the mean lies with 95 % if they are and the states are independent.
    median, median_due : what a few wild states do not change, and what it is of honest covariances.
    """

    mean: float
    median: float
    median_due: float
    low: float
    high: float
    n: int
    d: int


def nees(found: ArrayLike, covariance: ArrayLike, true: ArrayLike) -> Nees:
    """Whether errors of fused states are what their covariances say: (x̂ − x)ᵀ P⁻¹ (x̂ − x).

    Parameters
    ----------
    found, true : (n, d) states of the picture's objects and of the objects they stand for; rows with NaN are left out.
    covariance : (n, d, d).

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 5.4.2.

    Example
    -------
    >>> nees([[3.0, 4.0]], [[[25.0, 0.0], [0.0, 25.0]]], [[0.0, 0.0]]).mean
    1.0
    """
    from scipy.stats import chi2

    off = np.asarray(found, np.float64) - np.asarray(true, np.float64)
    spread = np.asarray(covariance, np.float64)
    if off.ndim != 2 or spread.shape != (*off.shape, off.shape[-1]):
        raise InputError(f"nees: states {off.shape}, covariances {spread.shape}; give (n, d) and (n, d, d)")
    known = np.isfinite(off).all(axis=1)
    off, spread = off[known], spread[known]
    n, d = off.shape
    due = float(chi2.median(d))
    if not n:
        return Nees(math.nan, math.nan, due, math.nan, math.nan, 0, d)
    square = mahalanobis_sq(off, spread)
    low, high = (float(chi2.ppf(p, n * d)) / n for p in (0.025, 0.975))
    return Nees(float(square.mean()), float(np.median(square)), due, low, high, n, d)


def mean_gospa(
    pictures: Iterable[tuple[ArrayLike, ArrayLike]], *, cutoff: float, order: float = 2.0
) -> tuple[float, list[Gospa]]:
    """The mean over instants of :func:`sameas.score.picture`, and its parts at every instant.

    pictures : per instant the positions found (n, d) and the true ones (m, d).

    >>> mean, _ = mean_gospa([([[0.0, 0.0]], [[0.0, 3.0]]), ([[0.0, 0.0]], [[0.0, 5.0]])], cutoff=50.0)
    >>> round(mean, 6)
    4.0
    """
    parts = [gospa(found, true, cutoff=cutoff, order=order) for found, true in pictures]
    return (float(np.mean([part.distance for part in parts])) if parts else math.nan), parts
