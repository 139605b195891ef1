"""Memory: the evidence of previous scans that two named tracks are one object.

Two tracks that agreed for ten minutes are not separated because noise brings another track nearer for one antenna
rotation. :class:`TrackMemory` is updated from instant to instant; :meth:`TrackMemory.rule` is a rule for
:func:`sameas.identify_many`, to be added to those of the instant:

    memory = memory.advance(scan)
    found = identify_many(now.sources, rule=now.rule() + now.identity() + memory.rule(), region=now.region)
    memory = memory.with_pairs(found.pooled)

Its log-likelihood ratio is that of all reports (:mod:`sameas.picture.track_pairs`) minus that of the two positions of
the instant, so the sum counts each report once. It is bounded by −2b and b = ln((1−ε)/ε), with ε the probability that a
report is of another object than that of its id (ids are reused, and swapped where two targets cross), so that a wrong
picture corrects itself (``report_reassigned``). The stated lasting errors are checked against the mean offsets of pairs
that are surely one object (:meth:`sameas.picture.track_pairs.TrackPairs.with_offsets`). Records without an id have no
memory; that of a track ends with its reports.

A pair that passes the gate for the first time has no history; :meth:`TrackMemory.first_contact` is the rule for pairs
that were never sure, by the velocities of both records and the kinds of their targets. Both rules are in
:mod:`sameas.picture.previous_scans`.

The probability that a track is of a real object is in the memory, too (:mod:`sameas.picture.track_existence`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, taken, taken_plane
from sameas.errors import InputError
from sameas.gaussian import log_determinant
from sameas.kernels.tracks import places_of
from sameas.many.pooled import PooledRecords
from sameas.picture.error_correlation import MANOEUVRE_CHI_SQ
from sameas.picture.error_factors import MAX_PAIRS, evenly, information, pairs_within
from sameas.picture.id_swaps import MIN_SWAP, SWAP_MODELS, SWAP_RANGES, Rivals, SwapRates, by_source_order
from sameas.picture.manoeuvres import with_manoeuvres
from sameas.picture.named_tracks import NamedTracks, Step
from sameas.picture.previous_scans import FirstContact, PreviousScans
from sameas.picture.tables import RANGE_BANDS, Scan, distances, objects_per_m2
from sameas.picture.track_existence import PERIOD_S, TrackExistence
from sameas.picture.track_pairs import LASTING_S, MIN_OFFSETS, TrackPairs, keys
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.representation import in_short

SURE_PAIR = 0.999  # a pair is sure at or above this probability
#: Share of the variance of a pair's difference below which the evidence of its reports hardly depends on how the errors
#: of one source are correlated (chosen).
OUTGROWN_SHARE = 1.0 / 3.0


@in_short
@dataclass(frozen=True)
class TrackMemory:
    """The memory of named tracks and of the pairs of them that passed the gate.

    Parameters
    ----------
    tracks, existence, track_pairs, swaps : the state, updated from instant to instant.
    """

    tracks: NamedTracks = field(default_factory=NamedTracks)
    existence: TrackExistence = field(default_factory=TrackExistence)
    track_pairs: TrackPairs = field(default_factory=TrackPairs)
    swaps: SwapRates = field(default_factory=SwapRates)

    def advance(self, scan: Scan, track_of_record: IntArray | None = None) -> TrackMemory:
        """The memory after the scan of a later instant.

        track_of_record : (n,) ``tracks.numbers_on(scan)``, where already known.

        Raises
        ------
        InputError : the scan is of an instant before the previous one.
        """
        before = self._judged_anew(scan)
        tracks, step = before.tracks.advance(scan, track_of_record)
        swaps, per_m2 = self._swaps_of(tracks, scan), objects_per_m2(scan.now)
        track_pairs, swaps = before.track_pairs.stepped(step, swaps, per_m2, scan.tuning)
        track_pairs = track_pairs.with_offsets(step, tracks.error_correlation, scan.tuning)
        existence = self.existence.advance(tracks)
        # The new reports count from the next instant on.
        tracks = replace(tracks, error_factors=step.reports.factors_after(tracks.error_factors))
        after = replace(self, tracks=tracks, track_pairs=track_pairs, swaps=swaps, existence=existence)
        return after._with_returned(step)

    def looked_ahead(self, scan: Scan, track_of_record: IntArray | None = None) -> TrackMemory:
        """The memory at the scan of a later instant, for the rules of that instant alone: it cannot be advanced."""
        before = self._judged_anew(scan)
        tracks, step = before.tracks.looked_ahead(scan, track_of_record)
        swaps, per_m2, tuning = self._swaps_of(tracks, scan), objects_per_m2(scan.now), scan.tuning
        track_pairs, swaps = before.track_pairs.looked_ahead(step, swaps, per_m2, tuning)
        # Offsets of fewer values than contribute would be thrown away.
        track_pairs = track_pairs.with_offsets(step, tracks.error_correlation, tuning, least=MIN_OFFSETS)
        existence = self.existence.advance(tracks)
        after = replace(self, tracks=tracks, track_pairs=track_pairs, swaps=swaps, existence=existence)
        return after._with_returned(step)

    def _judged_anew(self, scan: Scan) -> TrackMemory:
        """The memory of the previous instant by the present estimates of errors; refused as by :meth:`advance`."""
        require_order(self.tracks.instant_s, scan.now.instant_s)
        return self._with_present_factors()._with_present_correlation(scan.tuning)

    def _swaps_of(self, tracks: NamedTracks, scan: Scan) -> SwapRates:
        """The swap rates with the new sources of a scan."""
        kind, known = {d.name: d.kind for d in scan.now.descriptions}, len(self.swaps.log_probable)
        kinds = ["" if k < known else kind[name] for k, name in enumerate(tracks.error_correlation.names)]
        return self.swaps.of_sources(kinds)

    def with_numbers_of(self, later: TrackMemory, tuning: Tuning) -> TrackMemory:
        """The memory with the numbers that were given to the ids of tracks until a later instant, and their existence
        then: false tracks may begin and end between two steps of the memory."""
        out = replace(self, tracks=self.tracks.with_numbers_of(later.tracks, tuning), existence=later.existence)
        if "_log_ratio" in self.__dict__:
            # It depends on neither, and stays until the next step.
            out.__dict__["_log_ratio"] = self._log_ratio
        return out

    def _with_present_factors(self) -> TrackMemory:
        """The memory of the previous instant by the present factors: :meth:`NamedTracks.with_present_factors`."""
        tracks, changed = self.tracks.with_present_factors()
        if tracks is self.tracks or tracks.scan is None or self.tracks.scan is None:
            return self
        rows, a, b = self._pairs_with(changed)
        scan = tracks.scan
        before, covariance = self.tracks.scan.covariance[:, :2, :2], scan.covariance[:, :2, :2]
        change = scan.error_factor / self.tracks.scan.error_factor
        delta, after = scan.state[a, :2] - scan.state[b, :2], (covariance[a], covariance[b])
        track_pairs = self.track_pairs.with_errors(rows, delta, (before[a], before[b]), after, (change[a], change[b]))
        correlation = tracks.error_correlation
        anew = correlation.begun_anew(self.tracks.error_correlation)[correlation.numbers(scan)[scan.source]]
        restart = anew[a] | anew[b]
        lasting = tracks.lasting[a[restart]], tracks.lasting[b[restart]]
        track_pairs = track_pairs.without_history(
            rows[restart], delta[restart], (after[0][restart], after[1][restart]), lasting
        )
        return replace(self, tracks=tracks, track_pairs=track_pairs)

    def _with_present_correlation(self, tuning: Tuning) -> TrackMemory:
        """The memory of the previous instant without evidence that the present correlation of errors refutes:
        :meth:`sameas.picture.error_correlation.ErrorCorrelation.weighing`. Pairs whose other errors are the larger ones
        by far keep theirs."""
        if not self.tracks.error_correlation.names:
            return self
        correlation, outgrown = self.tracks.error_correlation.weighing(tuning)
        out, scan = replace(self, tracks=replace(self.tracks, error_correlation=correlation)), self.tracks.scan
        if not outgrown.any() or scan is None:
            return out
        is_outgrown = outgrown[correlation.numbers(scan)[scan.source]]
        rows, a, b = out._pairs_with(is_outgrown)
        covariance, reported = scan.covariance[:, :2, :2], scan.reported_covariance[:, :2, :2]
        whole, of_outgrown = _trace(covariance), np.where(is_outgrown, _trace(reported), 0.0)
        counts = of_outgrown[a] + of_outgrown[b] > OUTGROWN_SHARE * (whole[a] + whole[b])
        rows, a, b = rows[counts], a[counts], b[counts]
        delta = scan.state[a, :2] - scan.state[b, :2]
        track_pairs = self.track_pairs.without_evidence(
            rows, delta, (covariance[a], covariance[b]), (self.tracks.lasting[a], self.tracks.lasting[b])
        )
        return replace(out, track_pairs=track_pairs)

    def _pairs_with(self, changed: BoolArray) -> tuple[IntArray, IntArray, IntArray]:
        """(m,) the pairs with a record of the last scan that ``changed`` (n,), and the records of their two tracks."""
        record = np.append(self.tracks.place, ABSENT)
        a, b = (record[rows] for rows in self._rows)
        rows = np.flatnonzero((a >= 0) & (b >= 0) & (changed[a] | changed[b]))
        return rows, a[rows], b[rows]

    def rule(self) -> PreviousScans:
        """The rule of previous scans for the records of the instant."""
        log_ratio, level = self._log_ratio
        first, second = self.track_pairs.first, self.track_pairs.second
        scan = self.tracks.scan
        numbers = {} if scan is None else scan.by_table(self.tracks.track_of_record)
        return PreviousScans(numbers, first, second, log_ratio, level, self._precision())

    def first_contact(self, history: PreviousScans) -> FirstContact | None:
        """The rule for pairs of records of the instant that were never sure; None before the first instant.

        history : :meth:`rule`.
        """
        scan = self.tracks.scan
        if scan is None:
            return None
        records = scan.by_table(np.arange(len(scan)))
        sure = ~np.isnan(self.track_pairs.anchor_s)
        return FirstContact(scan, records, history, sure, self.tracks)

    def _precision(self) -> FloatArray:
        """(k,) sum of the precisions of both tracks of each pair, |P|^(−½) in m⁻²."""
        if self.tracks.scan is None:
            return np.zeros(len(self.track_pairs))
        # Directions have no positions, and count nothing.
        precision, placed = np.zeros(len(self.tracks.place)), self.tracks.scan.placed[self.tracks.place]
        covariance = taken_plane(self.tracks.scan.covariance, self.tracks.place[placed])
        precision[placed] = np.exp(-0.5 * log_determinant(covariance))
        one, other = self._rows
        return np.asarray(precision[one] + precision[other])

    @cached_property
    def _rows(self) -> tuple[IntArray, IntArray]:
        """(k,), (k,) the rows of both tracks of each pair among the tracks, ABSENT for none."""
        one, other = (places_of(self.tracks.number, k) for k in (self.track_pairs.first, self.track_pairs.second))
        return one, other

    @cached_property
    def _log_ratio(self) -> tuple[FloatArray, FloatArray]:
        """(k,) ln r of the pairs, without the positions of the instant, and its level (:class:`PreviousScans`)."""
        track_pairs, tracks = self.track_pairs, self.tracks
        first, second = self._rows
        rivals = Rivals.of(first, second, tracks.source[first], tracks.source[second])
        log_ratio = track_pairs.log_ratio + track_pairs.log_reported - track_pairs.log_now
        tuning = DEFAULT_TUNING if tracks.scan is None else tracks.scan.tuning
        agrees = track_pairs.chi_sq <= MANOEUVRE_CHI_SQ
        # With an agreeing rival, ids may have been swapped: the mean offset may mix several objects.
        alone = rivals.max_other(np.where(agrees, 0.0, -np.inf)) < 0.0
        log_ratio += np.where(alone, track_pairs.log_offset, 0.0)
        if tracks.scan is not None:
            log_odds = log_ratio + track_pairs.log_now - math.log(objects_per_m2(tracks.scan.now))
            numbers = by_source_order((first, second), (tracks.source[first], tracks.source[second]))
            models = self.swaps.probable
            log_ratio = rivals.with_joint_swaps(
                log_ratio, track_pairs.by_model[:, models], np.where(agrees, log_odds, -np.inf),
                partial(self._swaps_since, tracks.scan, numbers, models),
            )  # fmt: skip
        log_ratio = rivals.bounded(log_ratio, agrees, tuning)
        return log_ratio, rivals.level(log_ratio, agrees)

    def _swaps_since(
        self, scan: Scan, numbers: tuple[IntArray, IntArray], models: IntArray, side: int, pair: IntArray,
        rival: IntArray,
    ) -> tuple[IntArray, FloatArray, FloatArray]:  # fmt: skip
        """Pairs whose track that differs from the rival's may have exchanged ids with it since a scan.

        (m,) indices of pairs and rivals (n,); (m, r), (m, r) probability of a swap under each of ``models``, and that
        of the model. Both tracks have a report of their source's last scan. numbers : (k,), (k,) indices of the tracks.
        """
        tracks = self.tracks
        one, other = tracks.place[numbers[1 - side][pair]], tracks.place[numbers[1 - side][rival]]
        source = tracks.source[numbers[1 - side][pair]]
        period_s = np.array([d.timing.period_s or PERIOD_S for d in scan.now.descriptions])[scan.source]
        is_recent = scan.now.instant_s - scan.time_s <= 1.5 * period_s
        which = np.flatnonzero(is_recent[one] & is_recent[other] & self.swaps.may_swap[source])
        chi_sq, _ = distances(scan.state, scan.reported_covariance, one[which], other[which])
        near = chi_sq < -math.log(MIN_SWAP) * max(SWAP_RANGES)
        which, (rates, ranges) = which[near], SWAP_MODELS
        p = rates[models] * np.exp(chi_sq[near, None] * (-1.0 / ranges[models]))
        return which, p, self.swaps.probability[:, models][source[which]]

    def with_real(self, track: IntArray) -> TrackMemory:
        """The memory after other sources confirm tracks (any shape, ABSENT for none) as real."""
        return replace(self, existence=self.existence.with_real(track[track >= 0]))

    def with_manoeuvres(
        self, scan: Scan, track_of_record: IntArray, per_m2: float, together: Callable[[IntArray, IntArray], BoolArray]
    ) -> Scan:
        """The scan of a later instant with larger covariances for reports that a manoeuvre has made obsolete.

        track_of_record : (n,) ``tracks.numbers_on(scan)``. together : gives of numbers of tracks, (n,) and (n,),
        whether each two were one object before.
        """
        names, n = self.tracks.error_correlation.names, len(self.swaps.log_probable)
        known = np.array([names.index(d.name) if d.name in names else n for d in scan.now.descriptions], np.int64)
        swap_rate = np.append(self.swaps.rate(np.arange(n)), 0.0)[known]
        return with_manoeuvres(
            scan, track_of_record, self.tracks.scan, self.track_pairs, self._log_ratio[0], per_m2, swap_rate, together
        )

    def with_pairs(self, pooled: PooledRecords) -> TrackMemory:
        """The memory with the pairs that passed the gate for the first time; they have no history yet."""
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
        return self._with_paired(a[new], b[new])

    def _with_returned(self, step: Step) -> TrackMemory:
        """The memory after a step with the pairs of which a track is seen again: their history counts at once."""
        distant, place = self.track_pairs.distant, self.tracks.place
        a, b = (place[track] for track in distant.returned(self.tracks.number, step))
        return self._with_paired(a, b)

    def _with_paired(self, a: IntArray, b: IntArray) -> TrackMemory:
        """The memory with new pairs of the tracks of records (k,), the number of the first track the lower one."""
        tracks, scan = self.tracks, self.tracks.scan
        if not len(a) or scan is None:
            return self
        number = tracks.track_of_record
        delta = np.ascontiguousarray((taken(scan.state, a) - taken(scan.state, b))[:, :2])
        covariances = taken_plane(scan.covariance, a), taken_plane(scan.covariance, b)
        # Tracks that were looked ahead have no errors.
        known = tracks.lasting if len(tracks.lasting) else np.zeros((len(scan), 2, 2))
        lasting = taken(known, a), taken(known, b)
        log_met = tracks.log_met(a, b, objects_per_m2(scan.now))
        new_pairs = TrackPairs.of(number[a], number[b], delta, covariances, lasting, scan.now.instant_s, log_met)
        return replace(self, track_pairs=self.track_pairs.with_(new_pairs))

    def with_sure(self, members: IntArray, probability: FloatArray) -> TrackMemory:
        """The memory with error factors and correlations updated by the pairs that are surely one object.

        members, probability : (n, S) records of the scan, ABSENT for none, and (n,) of the objects of the instant.
        """
        tracks, scan, pairs = self.tracks, self.tracks.scan, self.track_pairs
        if scan is None or not len(members):
            return self
        at, places, share = self._sure_pairs(scan, members[probability >= SURE_PAIR])
        elapsed = scan.now.instant_s - pairs.anchor_s[at]
        delta = scan.state[places[:, 0], :2] - scan.state[places[:, 1], :2]
        due = np.flatnonzero((elapsed >= LASTING_S) & pairs.anchor_new[at].all(axis=1))
        # Pairs added at one instant are due at one instant; beyond MAX_PAIRS they wait for the next.
        due = due[evenly(scan.state[places[due, 0], :2], MAX_PAIRS)]
        restart = np.isnan(elapsed)
        restart[due] = True
        log_kept = np.zeros(len(scan))
        log_kept[tracks.place] = tracks.log_kept
        track_pairs = pairs.anchored(at, restart, scan.now.instant_s, delta, log_kept[places])
        at, places, elapsed, delta = at[due], places[due], elapsed[due], delta[due]
        kept = np.exp(np.minimum(log_kept[places] - pairs.anchor_kept[at], 0.0))
        errors, a, b = tracks.error_correlation, *places.T
        source = errors.numbers(scan)[scan.source]
        own, whole = scan.reported_covariance[:, :2, :2], scan.covariance[:, :2, :2]
        reported, total = (own[a], own[b]), whole[a] + whole[b]
        # Correlation of a pair's difference with its previous one, and with all previous ones by lasting errors.
        correlated = (
            errors.correlation(source[k], elapsed, scan.tuning, g) for k, g in zip((a, b), kept.T, strict=True)
        )
        lasting = (errors.lasting(source[k], scan.tuning) for k in (a, b))
        rho, lasting_rho = (
            sum((_trace(r) * share_of for r, share_of in zip(reported, shares, strict=True)), np.zeros(len(a)))
            / _trace(total)
            for shares in (correlated, lasting)
        )
        part = source * RANGE_BANDS + scan.range_band
        factors = tracks.error_factors.with_sure_pairs(
            (part[a], part[b]), delta, tuple(own[k] / scan.error_factor[k, None, None] ** 2 for k in (a, b)),
            total - reported[0] - reported[1],
            share[due] * information(pairs.n_compared[at], rho, lasting_rho),
        )  # fmt: skip
        correlation = errors.with_sure_pairs(
            (source[a], source[b]), elapsed, (pairs.anchor[at], delta), reported, total, kept, scan.tuning
        )
        tracks = replace(tracks, error_correlation=correlation, error_factors=factors)
        return replace(self, tracks=tracks, track_pairs=track_pairs)

    def _sure_pairs(self, scan: Scan, sure: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
        """(k,) known pairs of tracks among the records of objects (n, S), (k, 2) their records, (k,) their shares."""
        usable = (sure >= 0) & scan.placed[sure] & (self.tracks.track_of_record[sure] >= 0)
        places, share = pairs_within(np.where(usable, sure, ABSENT))
        places = np.take_along_axis(places, np.argsort(self.tracks.track_of_record[places], axis=1), axis=1)
        number = self.tracks.track_of_record[places]
        at = places_of(keys(self.track_pairs.first, self.track_pairs.second), keys(number[:, 0], number[:, 1]))
        return at[at >= 0], places[at >= 0], share[at >= 0]


def _trace(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.trace(covariance, axis1=1, axis2=2))


def require_order(last_s: float, instant_s: float) -> None:
    """Refuse an instant before the last one."""
    if instant_s < last_s:
        raise InputError(
            f"the picture is at {last_s:g} s and was given {instant_s:g} s; give instants in the order of time"
        )
