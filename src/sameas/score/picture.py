"""Scores of a picture over time against the truth: identification, continuity of object numbers, accuracy of states.

For trials of known truth: simulated ones, or real motion with modelled sensors. Identity metrics take a table with one
row for each record and instant, from any program: time, source, the object number that the program assigned, and the
number of the true object (−1, :data:`FALSE`, for a false record). Other programs can so be scored by the same code.

- :func:`pair_score` : precision, recall and F1 of pairs of records, and the share of instants without an error.
- :func:`siap` : completeness, ambiguity, spuriousness, continuity, identity switches. :func:`majority_votes` : the true
  object of each object of the picture.
- :func:`nees` : consistency of fused states with their covariances. :func:`mean_gospa` : distance of the picture as a
  whole from the truth.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.assignment import assign, refuse_crowds
from sameas.errors import InputError
from sameas.gate import Radius
from sameas.gaussian import mahalanobis_sq
from sameas.groups import groups
from sameas.prior import PerPair
from sameas.records import Records
from sameas.representation import in_short
from sameas.score.pairs import PairScore

# GOSPA: position errors, missed objects and false objects as one distance.
#
# Generalized optimal sub-pattern assignment with α = 2 (Rahmathullah, García-Fernández, Svensson, "Generalized optimal
# sub-pattern assignment metric", FUSION 2017, definition 1 and proposition 1):
#
#     GOSPA^p = min over one-to-one sets of pairs of  Σ_pairs min(d, c)^p + c^p/2 · (missed + false),
#
# d the distance, c the cutoff. It is a matching of largest Σ (c^p − d^p) over pairs nearer than c, which this package's
# gate, groups and assignment solve for pictures of any size.


@dataclass(frozen=True)
class Gospa:
    """The metric and its parts; ``distance`` is in the unit of the positions, ``localisation`` in its p-th power.

    localisation : Σ d^p of the matched pairs. missed, false : numbers of true and of found objects without match.
    cutoff, order : c and p.
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
    """The GOSPA metric of the objects ``found`` (n, d) and the ``true`` ones (m, d).

    Parameters
    ----------
    cutoff : c, the distance from which on a found object does not match a true one.
    order : p ≥ 1; 2 for squared distances.

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
    """The one-to-one match of the metric: rows of ``found`` and ``true``, (k,) each, and their distances (k,).

    Several pictures that are farther apart than ``cutoff`` can be matched in one call, with the same result for each.
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
    """The assigned and the true object of every record, in the order of instants. Make it with :meth:`of`.

    Attributes
    ----------
    time_s : (n,) the instant. source : (n,) number of the source. assigned : (n,) number of the object in the picture.
    true : (n,) number of the true object, FALSE for a false record.
    """

    time_s: FloatArray
    source: IntArray
    assigned: IntArray
    true: IntArray

    @classmethod
    def of(cls, records: Mapping[str, ArrayLike], true: ArrayLike) -> Identities:
        """From the columns time_s, source and object of a picture's records, and the true object of each row.

        A record without an object (masked, or a negative number) counts as a separate object.

        Raises
        ------
        InputError : a column is missing or of another length.
        """
        missing = [name for name in ("time_s", "source", "object") if name not in records]
        if missing:
            raise InputError(f"identities: no column {missing[0]}; give time_s, source and object")
        time_s, truth = np.asarray(records["time_s"], np.float64), np.asarray(true, np.int64)
        assigned = np.ma.filled(np.ma.asarray(records["object"]), ABSENT).astype(np.int64)
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
        """The distinct times (k,), and the number of each row's time among them (n,)."""
        times, which = np.unique(self.time_s, return_inverse=True)
        return times, which.astype(np.int64)


@in_short
@dataclass(frozen=True)
class PictureScore:
    """Pairs of records of two sources over all instants. right : (k,) whether each instant is without an error."""

    pairs: PairScore
    right: BoolArray

    @property
    def share_right(self) -> float:
        """Share of the instants at which all objects have exactly the right records; NaN without instants."""
        return float(self.right.mean()) if len(self.right) else math.nan


def pair_score(identities: Identities) -> PictureScore:
    """Precision, recall and F1 of pairs, and the instants without an error.

    A pair is two records of different sources at one instant. It is claimed if both are assigned one object, and true
    if both are of one true object. If a source has several records of an object (a broken track and its successor), the
    number of true pairs with another source is the largest one-to-one number.

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
    n_claimed = _RecordCounts.of(instant, identities.assigned, identities.source).pairs(len(times))
    n_true = _RecordCounts.of(instant, true, identities.source).pairs_one_to_one(len(times))
    both = np.unique(np.column_stack([identities.assigned, true]), axis=0, return_inverse=True)[1].reshape(-1)
    n_right = _RecordCounts.of(instant, both, identities.source).pairs_one_to_one(len(times))
    score = PairScore(int(n_claimed.sum()), int(n_true.sum()), int(n_right.sum()))
    return PictureScore(score, (n_claimed == n_right) & (n_true == n_right))


@dataclass(frozen=True)
class _RecordCounts:
    """Numbers of records of each source of each object at each instant (c,), the smallest first for each object.

    instant : (c,) of the count. begins : (c,) whether it is the first of its object. records : (c,) the count.
    """

    instant: IntArray
    begins: BoolArray
    records: IntArray

    @classmethod
    def of(cls, instant: IntArray, object: IntArray, source: IntArray) -> _RecordCounts:
        cells, records = np.unique(np.column_stack([instant, object, source]), axis=0, return_counts=True)
        order = np.lexsort([records, cells[:, 1], cells[:, 0]])
        cells, begins = cells[order], np.ones(len(cells), bool)
        begins[1:] = np.any(cells[1:, :2] != cells[:-1, :2], axis=1)
        return cls(cells[:, 0], begins, records[order])

    def pairs(self, count: int) -> IntArray:
        """(count,) pairs of records of different sources of one object, by instant."""
        first = np.flatnonzero(self.begins)
        total, squares = (np.add.reduceat(x, first) if len(first) else x for x in (self.records, self.records**2))
        return np.bincount(self.instant[first], (total**2 - squares) // 2, count).astype(np.int64)

    def pairs_one_to_one(self, count: int) -> IntArray:
        """(count,) the most pairs, one to one between any two sources, by instant: Σ_{a<b} min(c_a, c_b)."""
        n = len(self.instant)
        ends = np.append(np.flatnonzero(self.begins)[1:], n)
        after = (ends[np.cumsum(self.begins) - 1] if n else ends[:0]) - 1 - np.arange(n)
        return np.bincount(self.instant, self.records * after, count).astype(np.int64)


@dataclass(frozen=True)
class Siap:
    """Metrics of the Single Integrated Air Picture, and identity switches.

    Attributes
    ----------
    completeness : share of the true objects, over instants, that have an object of the picture; 1 is best.
    ambiguity : objects of the picture per true object, of those that have one; 1 is best.
    spuriousness : share of the picture's objects without a true object; 0 is best.
    continuity : share of the true objects' time that is covered by the longest of their objects; 1 is best.
    number_changes_per_hour : smallest possible number of changes of object number, per hour of covered true objects.
    switches : how often a true object's number differs from its previous one (identity switches of CLEAR MOT).
    """

    completeness: float
    ambiguity: float
    spuriousness: float
    continuity: float
    number_changes_per_hour: float
    switches: int


def siap(identities: Identities) -> Siap:
    """Completeness, ambiguity, spuriousness, continuity and identity switches of a picture.

    The true object of an object of the picture is that of most of its records at the instant; with a tie, or if most
    are false, it has none. Only true objects with a record at the instant are counted. Times are counted in instants.

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
    votes = majority_votes(identities)
    valid = votes.where(votes.true != FALSE)
    times, instant = identities.instants
    n_true = len(np.unique(np.column_stack([instant, identities.true])[identities.true != FALSE], axis=0))
    n_covered = len(np.unique(np.column_stack([valid.instant, valid.true]), axis=0))
    by_object = [valid.where(valid.true == one) for one in np.unique(valid.true)]
    hours = n_covered * _step(times) / 3600.0
    return Siap(
        completeness=_ratio(n_covered, n_true),
        ambiguity=_ratio(len(valid), n_covered),
        spuriousness=_ratio(len(votes) - len(valid), len(votes)),
        continuity=_ratio(sum(_longest(one) for one in by_object), n_true),
        number_changes_per_hour=_ratio(sum(_fewest_changes(one) for one in by_object), hours),
        switches=sum(_switches(one) for one in by_object),
    )


@in_short
@dataclass(frozen=True)
class MajorityVotes:
    """The true object of each object of the picture at each instant (k,), in the order of time.

    instant : number among the distinct times. assigned : the object's number in the picture. true : number of the true
    object of most of its records; FALSE for a tie or if most are false. votes : number of those records.
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
    """The true object of every object of the picture at every instant, by majority of its records."""
    times, instant = identities.instants
    cells, votes = np.unique(
        np.column_stack([instant, identities.assigned, identities.true]), axis=0, return_counts=True
    )
    # The most votes are the last of each object.
    order = np.lexsort([votes, cells[:, 1], cells[:, 0]])
    cells, votes = cells[order], votes[order]
    last = np.ones(len(cells), bool)
    last[:-1] = np.any(cells[1:, :2] != cells[:-1, :2], axis=1)
    tie = np.zeros(len(cells), bool)
    tie[1:] = ~last[:-1] & (votes[1:] == votes[:-1])
    true = np.where(tie, FALSE, cells[:, 2])
    return MajorityVotes(times[cells[last, 0]], cells[last, 0], cells[last, 1], true[last], votes[last])


def _longest(one: MajorityVotes) -> int:
    """Number of instants of the object of the picture that covers a true object longest."""
    return int(np.unique(one.assigned, return_counts=True)[1].max())


def _fewest_changes(one: MajorityVotes) -> int:
    """Changes of number if each number is kept as long as it is available."""
    available = [set(one.assigned[one.instant == step].tolist()) for step in np.unique(one.instant)]
    changes, kept = 0, available[0]
    for now in available[1:]:
        kept = kept & now
        if not kept:
            changes, kept = changes + 1, now
    return changes


def _switches(one: MajorityVotes) -> int:
    """Changes of a true object's number: it is kept while it covers the object, else replaced by that of most votes."""
    previous, switches = -1, 0
    for step in np.unique(one.instant):
        rows = np.flatnonzero(one.instant == step)
        if previous in one.assigned[rows]:
            continue
        best = int(one.assigned[rows[np.lexsort([one.assigned[rows], -one.votes[rows]])[0]]])
        switches += previous >= 0
        previous = best
    return switches


def _step(times: FloatArray) -> float:
    """Median interval between instants."""
    return float(np.median(np.diff(times))) if len(times) > 1 else math.nan


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


@dataclass(frozen=True)
class Nees:
    """Normalised estimation error squared of n states of d components: d on average if covariances are right.

    low, high : 95 % interval of the mean if covariances are right and states independent.
    median, median_due : the median, which is robust against outliers, and its expected value.
    """

    mean: float
    median: float
    median_due: float
    low: float
    high: float
    n: int
    d: int


def nees(found: ArrayLike, covariance: ArrayLike, true: ArrayLike) -> Nees:
    """Consistency of the errors of fused states with their covariances: (x̂ − x)ᵀ P⁻¹ (x̂ − x).

    Parameters
    ----------
    found, true : (n, d) states of the picture's objects and of their true objects; rows with NaN are ignored.
    covariance : (n, d, d).

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 5.4.2.

    Example
    -------
    >>> nees([[3.0, 4.0]], [[[25.0, 0.0], [0.0, 25.0]]], [[0.0, 0.0]]).mean
    1.0
    """
    from scipy.stats import chi2

    error = np.asarray(found, np.float64) - np.asarray(true, np.float64)
    p = np.asarray(covariance, np.float64)
    if error.ndim != 2 or p.shape != (*error.shape, error.shape[-1]):
        raise InputError(f"nees: states {error.shape}, covariances {p.shape}; give (n, d) and (n, d, d)")
    known = np.isfinite(error).all(axis=1)
    error, p = error[known], p[known]
    n, d = error.shape
    expected_median = float(chi2.median(d))
    if not n:
        return Nees(math.nan, math.nan, expected_median, math.nan, math.nan, 0, d)
    square = mahalanobis_sq(error, p)
    low, high = (float(chi2.ppf(quantile, n * d)) / n for quantile in (0.025, 0.975))
    return Nees(float(square.mean()), float(np.median(square)), expected_median, low, high, n, d)


def mean_gospa(pictures: Iterable[tuple[ArrayLike, ArrayLike]], *, cutoff: float) -> tuple[float, list[Gospa]]:
    """The mean over instants of :func:`gospa`'s distance, and the metric at every instant.

    pictures : for each instant the positions found (n, d) and the true ones (m, d).

    >>> mean, _ = mean_gospa([([[0.0, 0.0]], [[0.0, 3.0]]), ([[0.0, 0.0]], [[0.0, 5.0]])], cutoff=50.0)
    >>> round(mean, 6)
    4.0
    """
    parts = [gospa(found, true, cutoff=cutoff) for found, true in pictures]
    return (float(np.mean([part.distance for part in parts])) if parts else math.nan), parts
