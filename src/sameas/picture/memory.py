"""Memory: the evidence of past scans that two named tracks are one object, beside that of the instant.

Two tracks that were together for ten minutes do not part because noise brings another nearer for one turn of the
antenna. :class:`Past` goes from instant to instant; :meth:`Past.rule` is a rule for
:func:`sameas.many.identify_many`, to be added to those of the instant:

    past = past.on(scan)
    found = identify_many(now.sources, rule=now.rule() + now.identity() + past.rule(), region=now.region)
    past = past.with_pairs(found.pooled)

Its logarithm is that of all reports (:mod:`sameas.picture.track_pairs`) less that of the two positions of the instant,
so the sum of both counts every report once. It stays between −2b and b = ln((1−ε)/ε), with ε the probability that a
report is of another object than its id says: ids are reused, and swapped where two targets cross. So a wrong picture
corrects itself. What sensors state of errors that last is judged by the mean offsets of pairs that are surely one
object (:meth:`sameas.picture.track_pairs.TrackPairs.with_offsets`). Records without an id have no past, and tracks that
are not reported any more are forgotten.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.many.pooled import PooledRecords
from sameas.picture.error_factors import MOST_PAIRS, ErrorFactors, evenly
from sameas.picture.named import NamedTracks
from sameas.picture.scan import Scan, objects_per_m2
from sameas.picture.track_existence import TrackExistence
from sameas.picture.track_pairs import Rivals, SwapRates, TrackPairs, keys, with_manoeuvres
from sameas.picture.tuning import DEFAULT_TUNING
from sameas.ragged import places_in
from sameas.representation import in_short

#: Default ε: one scan in ten thousand, which a radar of 20 rotations a minute has every eight hours (chosen).
REASSIGNED = 1e-4


@in_short
@dataclass(frozen=True)
class Memory(Rule):
    """The evidence of the past on pairs of named tracks; made by :meth:`Past.rule`.

    Parameters
    ----------
    numbers : per source, by its name, the number of the track of every row of its table, −1 for rows without an id.
    first, second : (k,) numbers of tracks, first < second, in ascending order. log_ratio : (k,) ln r of the past.

    Example
    -------
    >>> from sameas import Radius, Records
    >>> radar = Records.of([[0.0, 0.0], [9.0, 0.0]], sigma=5.0, source="radar")
    >>> ais = Records.of([[5.0, 0.0]], sigma=5.0, source="ais")
    >>> past = Memory({"radar": [3, 4], "ais": [7]}, first=[3], second=[7], log_ratio=[5.5])
    >>> past(Radius(5.0)(radar, ais)).log_ratio.tolist()
    [5.5, 0.0]
    """

    numbers: Mapping[str, ArrayLike] = field(repr=False)
    first: ArrayLike
    second: ArrayLike
    log_ratio: ArrayLike

    def __post_init__(self) -> None:
        first, second, log_ratio = np.asarray(self.first), np.asarray(self.second), np.asarray(self.log_ratio)
        if not len(first) == len(second) == len(log_ratio) or np.any(first >= second):
            raise InputError("Memory: give first, second and log_ratio of every couple of tracks, first < second")
        if np.any(np.diff(keys(first, second)) <= 0):
            raise InputError("Memory: give every couple of tracks once, in ascending order")

    def __call__(self, pairs: Pairs) -> Evidence:
        one, two = (
            np.asarray(self.numbers.get(side.source, np.full(side.n_table, -1)))[side.rows[at]]
            for side, at in ((pairs.first, pairs.i), (pairs.second, pairs.j))
        )
        pair_key = np.where((one >= 0) & (two >= 0), keys(np.minimum(one, two), np.maximum(one, two)), -1)
        at = places_in(keys(np.asarray(self.first), np.asarray(self.second)), pair_key)
        return Evidence({"memory": np.append(np.asarray(self.log_ratio, dtype=np.float64), 0.0)[at]})


@in_short
@dataclass(frozen=True)
class Past:
    """The memory of named tracks, and of pairs of them that the gate has let through.

    Parameters
    ----------
    reassigned : ε of the module. correlation_s : by name of source the correlation time of its errors, where it is not
        to be estimated (:mod:`sameas.picture.error_correlation`); 0 where the errors of all reports are independent.
    tracks, existence, track_pairs, swaps : filled in from instant to instant.
    """

    reassigned: float = REASSIGNED
    correlation_s: Mapping[str, float] = field(default_factory=dict)
    tracks: NamedTracks = field(default_factory=NamedTracks)
    existence: TrackExistence = field(default_factory=TrackExistence)
    track_pairs: TrackPairs = field(default_factory=TrackPairs)
    swaps: SwapRates = field(default_factory=SwapRates)

    def __post_init__(self) -> None:
        if not 0.0 < self.reassigned < 0.5:
            raise InputError(f"memory: reassigned is {self.reassigned}; give a probability between 0 and 0.5")

    @property
    def error_factors(self) -> ErrorFactors:
        """By how much the errors that sources state are too small."""
        return self.tracks.error_factors

    def on(self, scan: Scan, track_of_record: IntArray | None = None) -> Past:
        """The past after the scan of a later instant.

        track_of_record : (n,) ``tracks.numbers_on(scan)``, where it is known already.

        Raises
        ------
        InputError : the scan is of an earlier instant than the last.
        """
        if scan.now.instant_s < self.tracks.instant_s:
            raise InputError(
                f"the picture is at {self.tracks.instant_s:g} s and was given {scan.now.instant_s:g} s; "
                "give instants in the order of time"
            )
        correlation = replace(self.tracks.error_correlation, fixed_s=self.correlation_s)
        tracks, step = replace(self.tracks, error_correlation=correlation).on(scan, track_of_record)
        kind = {description.name: description.kind for description in scan.now.descriptions}
        known = len(self.swaps.log_probable)
        swaps = self.swaps.of_sources(
            ["" if k < known else kind[name] for k, name in enumerate(tracks.error_correlation.names)], scan.tuning
        )
        track_pairs, swaps = self.track_pairs.stepped(
            step, self.reassigned, swaps, objects_per_m2(scan.now), scan.tuning
        )
        track_pairs = track_pairs.with_offsets(step, tracks.error_correlation, scan.tuning)
        existence = self.existence.on(tracks)
        return replace(self, tracks=tracks, track_pairs=track_pairs, swaps=swaps, existence=existence)

    def rule(self) -> Memory:
        """The rule of the past at the instant."""
        scan, track_pairs, numbers = self.tracks.scan, self.track_pairs, {}
        for s, description in enumerate(() if scan is None else scan.now.descriptions):
            assert scan is not None
            here = slice(scan.start[s], scan.start[s + 1])
            numbers[description.name] = np.full(int(scan.table[here].max(initial=-1)) + 1, -1)
            numbers[description.name][scan.table[here]] = self.tracks.track_of_record[here]
        return Memory(numbers, track_pairs.first, track_pairs.second, self._log_ratio())

    def _log_ratio(self) -> FloatArray:
        """(k,) ln r of the pairs by the past."""
        track_pairs, tracks = self.track_pairs, self.tracks
        first, second = (places_in(tracks.number, number) for number in (track_pairs.first, track_pairs.second))
        rivals = Rivals.of(first, second, tracks.source[first], tracks.source[second])
        past = track_pairs.log_ratio + track_pairs.at_scan - track_pairs.now
        chi_sq = DEFAULT_TUNING.manoeuvre_chi_sq if tracks.scan is None else tracks.scan.tuning.manoeuvre_chi_sq
        agrees = track_pairs.chi_sq <= chi_sq
        # Among rivals tracks may have been swapped since, and offsets are those of several objects.
        alone = rivals.most_other(np.where(agrees, 0.0, -np.inf)) < 0.0
        past += np.where(alone, track_pairs.log_offset, 0.0)
        return rivals.bounded(past, agrees, self.reassigned)

    def with_real(self, track: IntArray) -> Past:
        """The same, with tracks (any shape, −1 for none) that other sources show to be real."""
        return replace(self, existence=self.existence.with_real(track[track >= 0]))

    def with_manoeuvres(self, scan: Scan, track_of_record: IntArray, per_m2: float) -> Scan:
        """A later instant's scan with larger covariances of the reports that a manoeuvre has made obsolete.

        track_of_record : (n,) ``tracks.numbers_on(scan)``.
        """
        return with_manoeuvres(scan, track_of_record, self.track_pairs, self._log_ratio(), per_m2)

    def with_pairs(self, pooled: PooledRecords) -> Past:
        """The same with the pairs that the gate let through for the first time, which have no past yet."""
        scan = self.tracks.scan
        if scan is None:
            return self
        names = [description.name for description in scan.now.descriptions]
        parts = [np.empty((0, 2), np.int64)]
        for pairs in (part for part, _ in pooled.parts if len(part)):
            one, two = names.index(pairs.first.source), names.index(pairs.second.source)
            i, j = pairs.first.rows[pairs.i], pairs.second.rows[pairs.j]
            parts.append(np.column_stack([scan.find(one, i), scan.find(two, j)]))
        (one, two), number = np.concatenate(parts).T, self.tracks.track_of_record
        named = (number[one] >= 0) & (number[two] >= 0) & scan.placed[one] & scan.placed[two]
        a, b = (np.where(number[one] < number[two], *both)[named] for both in ((one, two), (two, one)))
        new = ~self.track_pairs.has(number[a], number[b])
        a, b = a[new], b[new]
        if not len(a):
            return self
        delta, covariance = scan.state[a, :2] - scan.state[b, :2], scan.covariance[:, :2, :2]
        lasting = self.tracks.lasting
        fresh = TrackPairs.of(
            number[a], number[b], delta, (covariance[a], covariance[b]), (lasting[a], lasting[b]), scan.now.instant_s
        )
        return replace(self, track_pairs=self.track_pairs.with_(fresh))

    def with_sure(self, members: IntArray, probability: FloatArray) -> Past:
        """The same after objects of the instant, (n, S) places in the scan and their probabilities: what surely is one
        object shows how long errors last."""
        tracks, scan = self.tracks, self.tracks.scan
        if scan is None or not len(members):
            return self
        sure = members[probability >= scan.tuning.sure_pair]
        one, two = np.triu_indices(sure.shape[1], 1)
        places = np.stack([sure[:, one].ravel(), sure[:, two].ravel()], axis=1)
        places = places[(places >= 0).all(axis=1)]
        places = places[scan.placed[places].all(axis=1) & (tracks.track_of_record[places] >= 0).all(axis=1)]
        places = np.take_along_axis(places, np.argsort(tracks.track_of_record[places], axis=1), axis=1)
        number = tracks.track_of_record[places]
        at = places_in(keys(self.track_pairs.first, self.track_pairs.second), keys(number[:, 0], number[:, 1]))
        at, places = at[at >= 0], places[at >= 0]
        elapsed = scan.now.instant_s - self.track_pairs.anchor_s[at]
        delta = scan.state[places[:, 0], :2] - scan.state[places[:, 1], :2]
        due = np.flatnonzero((elapsed >= scan.tuning.lasting_s) & self.track_pairs.anchor_new[at].all(axis=1))
        # Pairs that met at one instant are due at one; those beyond some dozens wait for the next.
        due = due[evenly(scan.state[places[due, 0], :2], MOST_PAIRS)]
        correlation = tracks.error_correlation
        number_of = correlation.numbers(scan)[scan.source]
        begin = np.isnan(elapsed)
        begin[due] = True
        track_pairs = self.track_pairs.anchored(at, begin, scan.now.instant_s, delta)
        a, b = places[due].T
        reported, total = scan.reported_covariance[:, :2, :2], scan.covariance[:, :2, :2]
        # Shares of a difference's variance that the last one of its pair has shown.
        shown = sum(
            (correlation.correlation(number_of[record], elapsed[due], scan.tuning) * _trace(reported[record])
             for record in (a, b)), np.zeros(len(a)),
        ) / _trace(total[a] + total[b])  # fmt: skip
        factors = self.error_factors.with_sure_pairs(
            (number_of[a], number_of[b]), delta[due],
            tuple(reported[record] / scan.error_factor[record, None, None] ** 2 for record in (a, b)),
            total[a] + total[b] - reported[a] - reported[b], 1.0 - shown**2, scan.tuning,
        )  # fmt: skip
        correlation = correlation.with_sure_pairs(
            (number_of[a], number_of[b]), elapsed[due], (self.track_pairs.anchor[at[due]], delta[due]),
            (reported[a], reported[b]), total[a] + total[b], scan.tuning,
        )  # fmt: skip
        tracks = replace(tracks, error_correlation=correlation, error_factors=factors)
        return replace(self, tracks=tracks, track_pairs=track_pairs)


def _trace(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.trace(covariance, axis1=1, axis2=2))
