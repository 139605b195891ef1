"""Named tracks: the tracks of sources with track ids, and the filtered position error of each.

A source with ids (a radar's track numbers, MMSI, ICAO addresses) links its reports of one object. The errors of two
reports of a track are correlated: a tracker smooths over a minute, an antenna has a fixed place on the hull. With e the
error of a track's position, R its covariance at a report, and P that of the report moved to the instant,

    between reports         e′ = e + n,    n ~ N(0, P′ − P), the growth by the track's motion;
    at a report             e = B z + f,   B = √s L,  z ~ N(0, 1) constant for the track;
    at a new report         f′ = G f + n,  G = Cᵀ (P − s R)⁻¹,  n ~ N(0, P′ − s R′ − G C),  C = ρ (1 − s) L L′ᵀ,

with L and L′ the Cholesky roots of R at the two reports, s the lasting (constant) share of the source's error variance,
ρ = exp(−Δt/τ), and τ its correlation time (:mod:`sameas.picture.error_correlation`). The residual of a report from the
prediction of the previous one measures e: ν = e′ − e = (G − 1) e + (B′ − G B) z + n. A Kalman filter has the mean and
covariance of (e, z) by all reports of the track; :func:`sameas.picture.error_factors.error_update` is one step.

A report farther from its prediction than one correct report in 10⁹ restarts the track without history: its id went to
another object, or the object moved in a way that its motion model excludes. Where all tracks are of aircraft that
transmit their own ids, it is the latter: the growth is then as large as the residual
(:meth:`NewReports.unmodelled_motion`).

Source: METHOD 1; autocorrelated errors of tracks as in Bar-Shalom, Li and Kirubarajan 2001, section 8.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sameas.arrays import ABSENT, BoolArray, ColumnTable, FloatArray, IntArray, numbers_of, taken, taken_plane
from sameas.gate import ChiSquare
from sameas.gaussian import log_determinant, mahalanobis_sq
from sameas.kernels.kalman import innovation_model, report_factors, tracks_moved
from sameas.kernels.tracks import places_of
from sameas.picture.error_correlation import MANOEUVRE_CHI_SQ, ErrorCorrelation, growth
from sameas.picture.error_factors import ErrorFactors, error_update, evenly
from sameas.picture.tables import RANGE_BANDS, Scan
from sameas.picture.tuning import Tuning
from sameas.tracks.kinds import KINDS

#: At most this many reports of an instant are used to estimate correlation times; more add no information.
MAX_REPORTS = 256
#: Smallest change of ln of an error factor for which the errors of tracks are estimated anew (chosen).
MIN_CHANGE = 0.1
#: Positions of a track are kept for so many marks, this many seconds apart: five minutes of approach (chosen).
MARKS, MARK_EVERY_S = 5, 60.0
#: Largest age of a report that is marked, seconds: that of AIS of class B under way (chosen).
MARK_AGE_S = 30.0
#: A track jumps if it moves farther than this number of times the usual speed of its kind, and so many metres.
JUMP_SPEEDS, JUMP_M = 3.0, 300.0
#: Share of their ways by which those of two tracks of one object may differ, by a radar's gain, turn or late stamps.
WAY_SHARE = 0.1

NEW_TRACK_PROBABILITY = 1e-9  # a track restarts beyond the χ² limit that this share of correct reports exceeds


@dataclass(frozen=True)
class Step(ColumnTable):
    """The tracks that are in the previous and the present instant, (m,) each, by ascending number.

    last : (m, 2) position at the previous instant. moved : (m, 2) the same report moved to this instant.
    here : (m, 2) position by the latest report, ``covariance`` : (m, 2, 2) its P′.
    drift : (m, 2, 2) growth of P between the instants. lasting, reported : (m, 2, 2) B and R of the latest report.
    slope, noise : (m, 2, 4) H and (m, 2, 2) covariance of n in ν = H (e, z) + n. shift : (m, 2) ν. All are 0 without a
        new report.
    new_report : whether the track has a new report. source : number of its source.
    log_kept : Σ ln g over all reports of the track, g the mean share of f that a report keeps by its motion alone, G at
        ρ = 1 and s = 0.
    log_own : ln p of the new report given the track's previous reports, 0 without one.
    error_mean, error_covariance : (m, 4), (m, 4, 4) of (e, z), given the track's own reports.
    instant_s : the present instant. reports : its new reports, also of tracks that restart. restarted : (r,) numbers of
    these.
    """

    WHOLE = frozenset({"instant_s", "reports", "restarted"})
    number: IntArray
    source: IntArray
    last: FloatArray
    moved: FloatArray
    here: FloatArray
    covariance: FloatArray
    drift: FloatArray
    lasting: FloatArray
    reported: FloatArray
    slope: FloatArray
    noise: FloatArray
    shift: FloatArray
    new_report: BoolArray
    log_kept: FloatArray
    log_own: FloatArray
    error_mean: FloatArray
    error_covariance: FloatArray
    instant_s: float
    reports: NewReports
    restarted: IntArray = field(default_factory=lambda: np.empty(0, np.int64))

    def find(self, number: IntArray) -> IntArray:
        """(k,) row of each track in the step, ABSENT for tracks that are not in it."""
        return places_of(self.number, number)

    def log_elsewhere(self, tracks: tuple[IntArray, IntArray], log_density_anywhere: float) -> FloatArray:
        """(k,) ln of the probability of a pair's new report, of an object anywhere, relative to that by its own track:
        the higher value of both tracks, at most 0; 0 without a new report."""
        log_own = [np.where(self.new_report[track], self.log_own[track], np.inf) for track in tracks]
        lower = np.minimum(*log_own)
        return np.where(np.isfinite(lower), np.minimum(log_density_anywhere - lower, 0.0), 0.0)


@dataclass(frozen=True)
class NamedTracks:
    """The named tracks at an instant.

    instant_s : the instant. n_numbers : count of numbers in use, and the number of the next new track.
    by_name : number of a track, by source and id. absent : by number, the source and id of the tracks that are not in
        the scan of the instant, and the time until which they keep it. forgotten : numbers that ended at this instant.
    number : (m,) ascending. place : (m,) the track's record in the scan of the instant.
    track_of_record : (n,) number of the track of each record of that scan, ABSENT for records without an id.
    error_mean, error_covariance : (m, 4), (m, 4, 4) of (e, z), given the track's own reports.
    log_kept : (m,) as of :class:`Step`. lasting : (n, 2, 2) B of each record of the scan.
    past : (m, MARKS, 3) position of each track at the last marks and its variance, the newest first, NaN where it had
        none. marked_s : time of the newest mark.
    scan : of the instant; None before the first.
    error_correlation, error_factors : of all sources. source : (m,) index of the track's source in
        ``error_correlation.names``.
    """

    instant_s: float = -np.inf
    n_numbers: int = 0
    by_name: Mapping[str, Mapping[str, int]] = field(default_factory=dict, repr=False)
    absent: Mapping[int, tuple[str, str, float]] = field(default_factory=dict, repr=False)
    forgotten: IntArray = field(default_factory=lambda: np.empty(0, np.int64), repr=False)
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    place: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    track_of_record: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    error_mean: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    error_covariance: FloatArray = field(default_factory=lambda: np.empty((0, 4, 4)))
    log_kept: FloatArray = field(default_factory=lambda: np.empty(0))
    lasting: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    past: FloatArray = field(default_factory=lambda: np.empty((0, MARKS, 3)))
    marked_s: float = -np.inf
    scan: Scan | None = None
    error_correlation: ErrorCorrelation = field(default_factory=ErrorCorrelation)
    source: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    error_factors: ErrorFactors = field(default_factory=ErrorFactors)

    def with_present_factors(self) -> tuple[NamedTracks, BoolArray]:
        """The tracks with the previous scan by the present error factors, and (n,) its records whose factor changed.

        A factor that was estimated anew changed no error. Without this, errors would count as having changed by it, and
        a report that stays where it was as evidence against that. Changes below :data:`MIN_CHANGE` are ignored.
        """
        if self.scan is None:
            return self, np.zeros(0, bool)
        changed = np.abs(np.log(self.error_factors.of_records(self.scan) / self.scan.error_factor)) > MIN_CHANGE
        if not changed.any():
            return self, changed
        scan = self.error_factors.applied(self.scan)
        correlation = self.error_correlation.with_factors(self.error_factors.factor)
        lasting = _lasting_root(scan, correlation)
        return replace(self, scan=scan, error_correlation=correlation, lasting=lasting), changed

    def numbers_on(self, scan: Scan) -> IntArray:
        """(n,) the number of each record's track; ABSENT for records without an id and for new ids."""
        out = np.full(len(scan), ABSENT)
        for s, description in enumerate(scan.now.descriptions):
            records, number_of = slice(scan.start[s], scan.start[s + 1]), self.by_name.get(description.name)
            if number_of:
                out[records] = numbers_of(scan.track[records].tolist(), number_of)
        return out

    def advance(self, scan: Scan, track_of_record: IntArray | None = None) -> tuple[NamedTracks, Step]:
        """The tracks after the next scan, with the error factors of before, and the step to it; argument as of
        :meth:`looked_ahead`."""
        tracks, step = self.looked_ahead(scan, track_of_record)
        return tracks._with_errors_of(step), step

    def looked_ahead(self, scan: Scan, track_of_record: IntArray | None = None) -> tuple[NamedTracks, Step]:
        """The tracks at the next scan without their errors, so that they cannot be advanced, and the step to it.

        track_of_record : (n,) :meth:`numbers_on` of the scan, where already known.

        A track that is not in a scan keeps its number for ``id_timeout_s``, that of a source whose objects name
        themselves for ``return_s``, but has no history when it returns.
        """
        correlation = self.error_correlation.of_sources(scan)
        factors = self.error_factors.of_sources(correlation.names)
        correlation = correlation.with_factors(factors.factor)
        track_of_record = self.numbers_on(scan) if track_of_record is None else track_of_record.copy()
        place = np.flatnonzero(scan.track != "")
        number = track_of_record[place]
        is_new = number < 0
        number[is_new] = self.n_numbers + np.arange(np.count_nonzero(is_new))
        track_of_record[place] = number
        order = np.argsort(number)
        number, place = number[order], place[order]
        source = correlation.numbers(scan)[scan.source[place]]
        continuing = (places_of(self.number, number) >= 0) & scan.placed[place]
        known = replace(self, error_correlation=correlation, error_factors=factors)
        step, correlation = known._step(scan, number[continuing], place[continuing], source[continuing])
        now_s = scan.now.instant_s
        is_new = number >= self.n_numbers
        by_name, absent, forgotten = self._names_after(scan, place[is_new], number[is_new], number)
        tracks = NamedTracks(
            instant_s=now_s, n_numbers=self.n_numbers + int(np.count_nonzero(is_new)), by_name=by_name, absent=absent,
            forgotten=forgotten, number=number, place=place, track_of_record=track_of_record, scan=scan,
            error_correlation=correlation, source=source, error_factors=factors,
        )  # fmt: skip
        return tracks._with_past(self), step

    def _with_errors_of(self, step: Step) -> NamedTracks:
        """These tracks of a scan with their errors after the step to it; those that are not in the step have begun."""
        assert self.scan is not None
        scan, at, lasting = self.scan, step.find(self.number), _lasting_root(self.scan, self.error_correlation)
        started = np.flatnonzero(at < 0)
        error_mean = taken(np.append(step.error_mean, np.zeros((1, 4)), axis=0), at)
        error_covariance = taken(np.append(step.error_covariance, np.zeros((1, 4, 4)), axis=0), at)
        if len(started):
            records = self.place[started]
            error_covariance[started] = prior_covariance(scan.covariance[records, :2, :2], lasting[records])
        return replace(
            self, error_mean=error_mean, error_covariance=error_covariance, log_kept=np.append(step.log_kept, 0.0)[at],
            lasting=lasting,
        )  # fmt: skip

    def _with_past(self, before: NamedTracks) -> NamedTracks:
        """These tracks of a scan with where they were at the marks of the previous one, and a new mark where due.

        The place that an old report has been moved to is none where a track was. A track that jumps farther than its
        kind moves is of another object from then on, and was nowhere.
        """
        assert self.scan is not None
        at, now_s = places_of(before.number, self.number), self.scan.now.instant_s
        past = np.append(before.past, np.full((1, MARKS, 3), np.nan), axis=0)[at]
        known = np.flatnonzero(at >= 0)
        if before.scan is not None and len(known):
            here, last = self.place[known], before.place[at[known]]
            jump = np.hypot(*(self.scan.state[here, :2] - before.scan.state[last, :2]).T)
            elapsed = now_s - before.scan.time_s[last]
            past[known[jump > JUMP_SPEEDS * self.scan.speed_m_per_s[here] * elapsed + JUMP_M]] = np.nan
        if now_s - before.marked_s < MARK_EVERY_S:
            return replace(self, past=past, marked_s=before.marked_s)
        past[:, 1:], past[:, 0, :2] = past[:, :-1].copy(), self.scan.state[self.place, :2]
        is_old = now_s - self.scan.time_s[self.place] > MARK_AGE_S
        past[:, 0, 2] = np.where(is_old, np.nan, self.position_m2[self.place])
        return replace(self, past=past, marked_s=now_s)

    def log_met(self, one: IntArray, other: IntArray, per_m2: float) -> FloatArray:
        """(k,) ln r, 0 or less, that the tracks of records (k,) which meet for the first time were one object before: a
        boat that moors at a turbine came from elsewhere.

        Their separation is compared with that at the marks, so that a constant offset of their sources, known or not,
        is no evidence; neither is a difference within :data:`WAY_SHARE` of their ways. They may be one all the same if
        the id of one went to the object of the other, with probability ``report_reassigned``, of all objects to that.
        """
        scan, p = self.scan, self.position_m2
        assert scan is not None
        a, b = (places_of(self.number, self.track_of_record[records]) for records in (one, other))
        past = np.append(self.past, np.full((1, MARKS, 3), np.nan), axis=0)
        ways = [scan.state[r, None, :2] - past[k, :, :2] for r, k in ((one, a), (other, b))]
        variance = (p[one] + p[other])[:, None] + past[a, :, 2] + past[b, :, 2]
        longest = np.maximum(*(np.hypot(way[..., 0], way[..., 1]) for way in ways))
        chi_sq = ((ways[0] - ways[1]) ** 2).sum(axis=-1) / ((WAY_SHARE * longest) ** 2 + variance)
        excess = np.maximum(np.nanmax(chi_sq, axis=1, initial=0.0) - MANOEUVRE_CHI_SQ, 0.0)
        log_taken = np.log(2.0 * math.pi * per_m2 * np.minimum(p[one], p[other]))
        floor = math.log(scan.tuning.report_reassigned) + np.minimum(log_taken, 0.0)
        return np.asarray(np.nan_to_num(np.maximum(-0.5 * excess, floor)))

    @cached_property
    def position_m2(self) -> FloatArray:
        """(n,) m², mean of both axes, of the positions of the records of the scan."""
        assert self.scan is not None
        return np.asarray(0.5 * np.trace(self.scan.covariance[:, :2, :2], axis1=1, axis2=2))

    def _names_after(
        self, scan: Scan, new_place: IntArray, new_number: IntArray, present: IntArray
    ) -> tuple[Mapping[str, Mapping[str, int]], Mapping[int, tuple[str, str, float]], IntArray]:
        """``by_name``, ``absent`` and ``forgotten`` after a scan: with its new tracks, without ids that timed out."""
        now_s, tuning = scan.now.instant_s, scan.tuning
        gone = places_of(present, np.array(list(self.absent), np.int64)) < 0
        absent = {k: kept for (k, kept), is_gone in zip(self.absent.items(), gone.tolist(), strict=True) if is_gone}
        absent |= self._without(present, tuning)
        timed_out = [k for k, (_, _, until_s) in absent.items() if now_s > until_s]
        # The first ones have been absent for longest.
        surplus = len(absent) - len(timed_out) - tuning.most_absent
        if surplus > 0:
            timed_out = [*timed_out, *[k for k in absent if k not in set(timed_out)][:surplus]]
        if not timed_out and not len(new_place):
            return self.by_name, absent, np.empty(0, np.int64)
        by_name = {source: dict(numbers) for source, numbers in self.by_name.items()}
        for k in timed_out:
            source, name, _ = absent.pop(k)
            by_name[source].pop(name, None)
        sources = [description.name for description in scan.now.descriptions]
        for record, k in zip(new_place.tolist(), new_number.tolist(), strict=True):
            by_name.setdefault(sources[scan.source[record]], {})[scan.track[record]] = k
        return by_name, absent, np.array(timed_out, np.int64)

    def _without(self, present: IntArray, tuning: Tuning) -> dict[int, tuple[str, str, float]]:
        """As of ``absent``: the tracks of this instant whose numbers are not ``present``, ascending."""
        out: dict[int, tuple[str, str, float]] = {}
        if self.scan is None:
            return out
        descriptions = self.scan.now.descriptions
        for at in np.flatnonzero(places_of(present, self.number) < 0).tolist():
            record = self.place[at]
            source = descriptions[self.scan.source[record]]
            keep_s = tuning.return_s if KINDS[source.kind].self_named else tuning.id_timeout_s
            out[int(self.number[at])] = source.name, self.scan.track[record], self.instant_s + keep_s
        return out

    def with_numbers_of(self, later: NamedTracks, tuning: Tuning) -> NamedTracks:
        """The tracks with the numbers that were given to ids until a later instant, and no more of it. Tracks that
        began since are absent until they are reported again, so that their ids time out if they are not."""
        absent = {**later.absent, **later._without(self.number, tuning)}
        return replace(self, by_name=later.by_name, n_numbers=later.n_numbers, absent=absent)

    def _step(self, scan: Scan, number: IntArray, place: IntArray, source: IntArray) -> tuple[Step, ErrorCorrelation]:
        """The step of continuing tracks, without those that restart, and the updated error correlation.

        number, place, source : (m,) of the tracks: their numbers, ascending, records of the scan, and sources.
        """
        previous = self.scan if self.scan is not None else scan
        at = places_of(self.number, number)
        last = self.place[at]
        dt, elapsed = scan.now.instant_s - previous.time_s[last], scan.time_s[place] - previous.time_s[last]
        # A report with an earlier time than the track's previous one is not new.
        new_report = elapsed > 0.0
        manoeuvres = taken_plane(previous.manoeuvre_covariance, last), taken_plane(scan.manoeuvre_covariance, place)
        moved, (old, drift, root_last, root, motion) = np.empty((len(at), 2)), np.empty((5, len(at), 2, 2))
        tracks_moved(
            last, previous.reported_state, previous.reported_covariance, previous.walk_m2_per_s3, previous.late_s, dt,
            np.where(new_report[:, None, None], *manoeuvres), previous.covariance, moved, old, drift,
        )  # fmt: skip
        new, shift = taken_plane(scan.covariance, place), taken(scan.state, place)[:, :2] - moved
        report_factors(
            last, place, previous.reported_covariance, scan.reported_covariance, old, new, root_last, root, motion
        )
        k = np.flatnonzero(new_report)
        reports = NewReports(
            previous=previous, scan=scan, last=last[k], place=place[k], source=source[k], dt=dt[k], elapsed=elapsed[k],
            shift=taken(shift, k), motion=taken(motion, k), root_last=taken(root_last, k), root=taken(root, k),
        )  # fmt: skip
        correlation = reports.correlation_after(self.error_correlation)
        if reports.are_of_named_aircraft:
            unmodelled = reports.unmodelled_motion(old[k] + new[k])
            old[k] += unmodelled
            drift[k] += unmodelled
        slope, noise = np.empty((len(at), 2, 4)), np.empty((len(at), 2, 2))
        share, decaying = correlation.lasting(source, scan.tuning), correlation.decaying(source, elapsed, scan.tuning)
        innovation_model(root_last, root, old, new, share, decaying, slope, noise)
        # |R| / |P| is the square of the mean g of both axes.
        log_kept = np.log(root_last[:, 0, 0] * root_last[:, 1, 1]) - 0.5 * log_determinant(old)
        log_kept = self.log_kept[at] + np.where(new_report, log_kept, 0.0)
        error_mean, error_covariance = taken(self.error_mean, at), taken(self.error_covariance, at)
        error_covariance[:, :2, :2] += drift
        updated_mean, updated_covariance, log_own, chi_sq = error_update(
            error_mean, error_covariance, slope, noise, shift
        )
        updated_mean[:, :2] += shift
        repeated = np.flatnonzero(~new_report)
        shift[repeated], slope[repeated], noise[repeated], log_own[repeated] = 0.0, 0.0, 0.0, 0.0
        updated_mean[repeated], updated_covariance[repeated] = error_mean[repeated], error_covariance[repeated]
        new[repeated] = old[repeated]
        step = Step(
            number=number, source=source, last=np.ascontiguousarray(taken(previous.state, last)[:, :2]), moved=moved,
            here=moved + shift, covariance=new, drift=drift, lasting=np.sqrt(share)[:, None, None] * root,
            reported=taken_plane(scan.reported_covariance, place), slope=slope, noise=noise, shift=shift,
            new_report=new_report, log_kept=log_kept, log_own=log_own, error_mean=updated_mean,
            error_covariance=updated_covariance, instant_s=scan.now.instant_s, reports=reports,
        )  # fmt: skip
        consistent = ~new_report | (chi_sq <= _new_track_chi_sq())
        if consistent.all():
            return step, correlation
        return replace(step.take(np.flatnonzero(consistent)), restarted=number[~consistent]), correlation


def _new_track_chi_sq() -> float:
    """χ² of a residual beyond which a report is of another object."""
    return ChiSquare(1.0 - NEW_TRACK_PROBABILITY).limit(2)


@dataclass(frozen=True)
class NewReports:
    """The new reports of tracks at an instant, (k,) each, from which the errors of the sources are estimated.

    previous, scan : of the last step and of the instant. last, place : each track's records in both. source : of the
    track. dt, elapsed : seconds from the last report to the instant, and to the new report. shift, motion : (k, 2),
    (k, 2, 2) ν and D. root_last, root : (k, 2, 2) L and L′.
    """

    previous: Scan
    scan: Scan
    last: IntArray
    place: IntArray
    source: IntArray
    dt: FloatArray
    elapsed: FloatArray
    shift: FloatArray
    motion: FloatArray
    root_last: FloatArray
    root: FloatArray

    def correlation_after(self, before: ErrorCorrelation) -> ErrorCorrelation:
        """The error correlation after these reports."""
        sample = evenly(taken(self.scan.state, self.place)[:, :2], MAX_REPORTS)
        r_last, r_new = self._reported(sample)
        return before.updated(
            self.source[sample], self.elapsed[sample], self.shift[sample], (r_last + r_new, self._common(sample)),
            self._motions(sample), self.scan.tuning,
        )  # fmt: skip

    def factors_after(self, before: ErrorFactors) -> ErrorFactors:
        """The error factors after these reports."""
        r_last, r_new = self._reported(slice(None))
        to_stated = (
            1.0 / self.previous.error_factor[self.last, None, None],
            1.0 / self.scan.error_factor[self.place, None, None],
        )
        as_stated = to_stated[0] ** 2 * r_last + to_stated[1] ** 2 * r_new
        part = self.source * RANGE_BANDS + self.scan.range_band[self.place]
        sample = before.informative(part, taken(self.scan.state, self.place)[:, :2], as_stated, self.motion)
        common = (to_stated[0] * to_stated[1])[sample] * self._common(sample)
        return before.with_shifts(part[sample], self.shift[sample], (as_stated[sample], common), self._motions(sample))

    def _reported(self, which: IntArray | slice) -> tuple[FloatArray, FloatArray]:
        """R and R′."""
        return (
            taken_plane(self.previous.reported_covariance, self.last[which]),
            taken_plane(self.scan.reported_covariance, self.place[which]),
        )

    def _common(self, which: IntArray) -> FloatArray:
        """L L′ᵀ: the covariance of two reports with fully correlated errors."""
        return np.asarray(taken(self.root_last, which) @ taken(self.root, which).transpose(0, 2, 1))

    @property
    def are_of_named_aircraft(self) -> bool:
        """Whether all sources of the scan are of aircraft that transmit their own ids."""
        kinds = [KINDS[one.kind] for one in self.scan.now.descriptions]
        return all(kind.self_named and kind.target == "aircraft" for kind in kinds)

    def unmodelled_motion(self, covariance: FloatArray) -> FloatArray:
        """(k, 2, 2) the covariance, beside that of the motion model, of the predictions of aircraft that can have moved
        so far, and moved in a way that the model excludes; 0 of all others.

        covariance : (k, 2, 2) of ν, if the errors of two reports were independent.

        So a circling glider's prediction tells little of her place, and what is known of her and of other tracks stays:
        begun anew every ten seconds, gliders in one thermal were paired by each instant alone. For named aircraft only:
        the tracks of a radar begin anew by the same motion, and what one of two tracks of one object keeps would then
        be evidence for two.
        """
        excluded = mahalanobis_sq(self.shift, covariance) > _new_track_chi_sq()
        moved_sq = np.sum(self.shift**2, axis=1)
        excluded &= moved_sq <= (JUMP_SPEEDS * self.scan.speed_m_per_s[self.place] * self.elapsed + JUMP_M) ** 2
        return np.asarray(np.where(excluded, 0.5 * moved_sq, 0.0)[:, None, None] * np.eye(2))

    def _motions(self, which: IntArray) -> tuple[FloatArray, FloatArray]:
        """D, and the part of it that comes from errors of measured velocities."""
        last, dt = self.last[which], self.dt[which, None, None]
        moving = self.previous.moving[last, None, None]
        reported = taken(self.previous.reported_covariance, last)
        cross, velocity = reported[:, :2, 2:], reported[:, 2:, 2:]
        by_velocity = np.where(moving, dt * (cross + cross.transpose(0, 2, 1) + dt * velocity), 0.0)
        return taken(self.motion, which), growth(by_velocity)


def prior_covariance(covariance: FloatArray, lasting: FloatArray) -> FloatArray:
    """(k, 4, 4) covariance of (e, z) of a track without history: P for e and B between e and z, (k, 2, 2) each; 1 for
    z."""
    return np.asarray(
        np.block([[covariance, lasting], [lasting.transpose(0, 2, 1), np.broadcast_to(np.eye(2), lasting.shape)]])
    )


def _lasting_root(scan: Scan, correlation: ErrorCorrelation) -> FloatArray:
    """(n, 2, 2) B = √s L of each record, 0 for directions."""
    out = np.zeros((len(scan), 2, 2))
    at = np.flatnonzero(scan.placed)
    share = correlation.lasting(correlation.numbers(scan)[scan.source[at]], scan.tuning)
    covariance, root = taken(scan.reported_covariance, at), np.sqrt(share)
    first = np.sqrt(covariance[:, 0, 0])
    cross = covariance[:, 1, 0] / first
    out[at, 0, 0], out[at, 1, 0] = root * first, root * cross
    out[at, 1, 1] = root * np.sqrt(covariance[:, 1, 1] - cross**2)
    return out
