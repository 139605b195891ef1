"""Named tracks: the tracks of sources with track ids, and the error of each track's position from report to report.

A source with ids of its objects (a radar's track numbers, an MMSI, an ICAO address) links its reports of one
object. The errors of two reports of a track are correlated: a filter smooths over a minute, an antenna stays at its
place on the hull. With e the error of a track's position, R its covariance at a report, and P that of the report moved
to the instant,

    between reports         e′ = e + n,    n ~ N(0, P′ − P), the growth by the track's motion;
    e = B z + f,  B = √s L,  z ~ N(0, 1) of the track, which lasts;
    at a new report         f′ = G f + n,  G = Cᵀ (P − s R)⁻¹,  n ~ N(0, P′ − s R′ − G C),  C = ρ (1 − s) L L′ᵀ,

L and L′ being the roots of R at the two reports, s the source's lasting share, ρ = exp(−Δt/τ), τ its correlation time
(:mod:`sameas.picture.error_factors`). A report measures e by its distance from the prediction of the last one,
ν = e′ − e = (G − 1) e + (B′ − G B) z + n. A Kalman filter keeps the mean and covariance of (e, z) by all reports of the
track; :func:`sameas.picture.error_factors.error_update` is one step.

A report that is farther from its prediction than one correct report in 10⁹ starts the track anew, without a past: its
id went to another object, or the object moved as its motion model does not allow.

Source: METHOD 1; autocorrelated errors of tracks as in Bar-Shalom, Li and Kirubarajan 2001, section 8.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import repeat

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.gate import ChiSquare
from sameas.kernels.track_steps import errors_forgotten, tracks_moved, ways_of_tracks
from sameas.picture.error_factors import ErrorCorrelation, ErrorFactors, error_update, evenly, growth
from sameas.picture.object_table import ColumnTable
from sameas.picture.scan import Scan
from sameas.ragged import places_in

#: Reports of an instant by which correlation times are estimated, at most; more show nothing new.
MOST_REPORTS = 256


@dataclass(frozen=True)
class Step(ColumnTable):
    """The step from the last instant to this one of tracks that are in both, (m,) each, by ascending number.

    last : (m, 2) position at the last instant. moved : (m, 2) the same report, moved to this instant.
    here : (m, 2) position by its present report, with its ``covariance`` P′.
    drift : (m, 2, 2) by which P grew. lasting, reported : (m, 2, 2) B and R of the present report.
    slope, noise : (m, 2, 4) H and (m, 2, 2) the covariance of n in ν = H (e, z) + n. shift : (m, 2) ν; all are 0
        without a new report.
    new_report : whether the track has one. source : number of its source.
    elapsed_s : seconds between the track's last two reports.
    log_own : ln p of that report by the track's own reports before it, 0 without one.
    error_mean, error_covariance : of (e, z) after it, by the track's own reports.
    instant_s : this instant.
    """

    WHOLE = frozenset({"instant_s"})
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
    elapsed_s: FloatArray
    log_own: FloatArray
    error_mean: FloatArray
    error_covariance: FloatArray
    instant_s: float

    def find(self, number: IntArray) -> IntArray:
        """(k,) where tracks stand in the step, −1 for those that are not in it."""
        return places_in(self.number, number)

    def log_elsewhere(self, tracks: tuple[IntArray, IntArray], log_density_anywhere: float) -> FloatArray:
        """(k,) ln of how probable the new report of either track is of an object anywhere, by its own 1; 0 at most, and
        without a new report."""
        own = [np.where(self.new_report[track], self.log_own[track], np.inf) for track in tracks]
        lower = np.minimum(*own)
        return np.where(np.isfinite(lower), np.minimum(log_density_anywhere - lower, 0.0), 0.0)


@dataclass(frozen=True)
class NamedTracks:
    """The named tracks at an instant.

    Attributes
    ----------
    instant_s : the instant. n_numbers : how many numbers are in use; the next track gets this one.
    by_name : number of a track, by source and then id. absent : source, id, and when it was in a scan last, by number,
        of those that are not in the scan of the instant.
    number : (m,) ascending. place : (m,) place of the track's record in the scan of the instant.
    track_of_record : (n,) number of the track of every record of that scan, −1 for records without an id.
    error_mean, error_covariance : (m, 4), (m, 4, 4) of (e, z), by the track's own reports.
    lasting : (n, 2, 2) B of every record of the scan.
    error_correlation, error_factors : of all sources. source : (m,) place of the track's source among its names.
    """

    instant_s: float = -np.inf
    n_numbers: int = 0
    by_name: Mapping[str, Mapping[str, int]] = field(default_factory=dict, repr=False)
    absent: Mapping[int, tuple[str, str, float]] = field(default_factory=dict, repr=False)
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    place: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    track_of_record: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    error_mean: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    error_covariance: FloatArray = field(default_factory=lambda: np.empty((0, 4, 4)))
    lasting: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    scan: Scan | None = None
    error_correlation: ErrorCorrelation = field(default_factory=ErrorCorrelation)
    source: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    error_factors: ErrorFactors = field(default_factory=ErrorFactors)

    def numbers_on(self, scan: Scan) -> IntArray:
        """(n,) the number of each record's track; −1 for records without an id, and for new ids."""
        out = np.full(len(scan), -1)
        for s, description in enumerate(scan.now.descriptions):
            here, known = slice(scan.start[s], scan.start[s + 1]), self.by_name.get(description.name)
            if known:
                out[here] = list(map(known.get, scan.track[here].tolist(), repeat(-1)))
        return out

    def on(self, scan: Scan, track_of_record: IntArray | None = None) -> tuple[NamedTracks, Step]:
        """The tracks of the next instant's scan, and the step to it; track_of_record : (n,) :meth:`numbers_on` of it.

        A track that is not in a scan keeps its number for ``id_timeout_s``, but has no past when it comes back.
        """
        correlation = self.error_correlation.of_sources(scan)
        track_of_record = self.numbers_on(scan) if track_of_record is None else track_of_record.copy()
        place = np.flatnonzero(scan.track != "")
        number, source = track_of_record[place], correlation.numbers(scan)[scan.source[place]]
        continuing = np.flatnonzero((places_in(self.number, number) >= 0) & scan.placed[place])
        continuing = continuing[np.argsort(number[continuing])]
        step, correlation, factors = self._step(
            scan, number[continuing], place[continuing], source[continuing], correlation
        )
        is_new = number < 0
        number[is_new] = self.n_numbers + np.arange(np.count_nonzero(is_new))
        track_of_record[place] = number
        lasting = _lasting_root(scan, correlation)
        order = np.argsort(number)
        number, place, source = number[order], place[order], source[order]
        at = step.find(number)
        anew = place[at < 0]
        error_mean = np.append(step.error_mean, np.zeros((1, 4)), axis=0)[at]
        error_covariance = np.append(step.error_covariance, np.zeros((1, 4, 4)), axis=0)[at]
        error_covariance[at < 0] = with_lasting(scan.covariance[anew, :2, :2], lasting[anew])
        now_s = scan.now.instant_s
        is_new = number >= self.n_numbers
        by_name, absent = self._names_on(scan, place[is_new], number[is_new], number)
        tracks = NamedTracks(
            now_s, self.n_numbers + int(np.count_nonzero(is_new)), by_name, absent, number, place, track_of_record,
            error_mean, error_covariance, lasting, scan, correlation, source, factors,
        )  # fmt: skip
        return tracks, step

    def _names_on(
        self, scan: Scan, new_place: IntArray, new_number: IntArray, present: IntArray
    ) -> tuple[Mapping[str, Mapping[str, int]], Mapping[int, tuple[str, str, float]]]:
        """The numbers by name with those of new tracks, without those that are absent for too long; the absent ones."""
        now_s, absent = scan.now.instant_s, dict(self.absent)
        for k in np.intersect1d(present, np.fromiter(absent, np.int64, len(absent))).tolist():
            del absent[k]
        if self.scan is not None:
            names = [description.name for description in self.scan.now.descriptions]
            for at in np.flatnonzero(~np.isin(self.number, present)).tolist():
                record = self.place[at]
                absent[int(self.number[at])] = names[self.scan.source[record]], self.scan.track[record], self.instant_s
        over = [k for k, (_, _, last_s) in absent.items() if now_s - last_s > scan.tuning.id_timeout_s]
        if not over and not len(new_place):
            return self.by_name, absent
        by_name = {source: dict(known) for source, known in self.by_name.items()}
        for k in over:
            source, name, _ = absent.pop(k)
            del by_name[source][name]
        sources = [description.name for description in scan.now.descriptions]
        for record, k in zip(new_place.tolist(), new_number.tolist(), strict=True):
            by_name.setdefault(sources[scan.source[record]], {})[scan.track[record]] = k
        return by_name, absent

    def _step(
        self, scan: Scan, number: IntArray, place: IntArray, source: IntArray, correlation: ErrorCorrelation
    ) -> tuple[Step, ErrorCorrelation, ErrorFactors]:
        """The step of tracks that continue, without those that begin anew, and what their reports show of errors."""
        before = self.scan if self.scan is not None else scan
        at = places_in(self.number, number)
        was = self.place[at]
        dt, elapsed = scan.now.instant_s - before.time_s[was], scan.time_s[place] - before.time_s[was]
        # A report of an earlier time than the track's last one is not new.
        new_report = elapsed > 0.0
        manoeuvres = before.manoeuvre_covariance[was, :2, :2], scan.manoeuvre_covariance[place, :2, :2]
        moved, (old, drift, root_before, root, motion) = np.empty((len(at), 2)), np.empty((5, len(at), 2, 2))
        tracks_moved(
            was, before.reported_state, before.reported_covariance, before.walk_m2_per_s3, before.late_s, dt,
            np.where(new_report[:, None, None], *manoeuvres), before.covariance, moved, old, drift,
        )  # fmt: skip
        new, shift = scan.covariance[place, :2, :2], scan.state[place, :2] - moved
        ways_of_tracks(
            was, place, before.reported_covariance, scan.reported_covariance, old, new, root_before, root, motion
        )
        correlation, factors = self._errors_shown(
            scan, (was, place), source, (dt, elapsed), shift, (root_before, root), motion, correlation
        )
        slope, noise = np.empty((len(at), 2, 4)), np.empty((len(at), 2, 2))
        share, forgotten = correlation.lasting(source, scan.tuning), correlation.forgotten(source, elapsed, scan.tuning)
        errors_forgotten(root_before, root, old, new, share, forgotten, slope, noise)
        error_mean, error_covariance = self.error_mean[at], self.error_covariance[at]
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
            number, source, before.state[was, :2], moved, moved + shift, new, drift,
            np.sqrt(share)[:, None, None] * root, scan.reported_covariance[place, :2, :2], slope, noise, shift,
            new_report, elapsed, log_own, updated_mean, updated_covariance, scan.now.instant_s,
        )  # fmt: skip
        consistent = ~new_report | (chi_sq <= ChiSquare(1.0 - scan.tuning.new_track_probability).limit(2))
        return step if consistent.all() else step.take(np.flatnonzero(consistent)), correlation, factors

    def _errors_shown(
        self, scan: Scan, reports: tuple[IntArray, IntArray], source: IntArray, times_s: tuple[FloatArray, FloatArray],
        shift: FloatArray, roots: tuple[FloatArray, FloatArray], motion: FloatArray, correlation: ErrorCorrelation,
    ) -> tuple[ErrorCorrelation, ErrorFactors]:  # fmt: skip
        """The correlation times and the factors of errors after new reports of tracks.

        reports : (m,) rows of the last report in the last scan, and of the new one in this. times_s : (m,) seconds from
        the last report to the instant, and to the new one. roots : (m, 2, 2) L and L′.
        """
        before = self.scan if self.scan is not None else scan
        k = np.flatnonzero(times_s[1] > 0.0)
        was, place = reports[0][k], reports[1][k]
        one, other = before.reported_covariance[was, :2, :2], scan.reported_covariance[place, :2, :2]
        source, elapsed, shift, motion = source[k], times_s[1][k], shift[k], motion[k]

        def shared(which: IntArray) -> FloatArray:
            """L L′ᵀ of some: the covariance of the errors of the two reports if they are the same."""
            return np.asarray(roots[0][k[which]] @ roots[1][k[which]].transpose(0, 2, 1))

        here = scan.state[place, :2]
        some = evenly(here, MOST_REPORTS)
        correlation = correlation.updated(
            source[some], elapsed[some], shift[some], (one[some] + other[some], shared(some)), motion[some], scan.tuning
        )
        factors = self.error_factors.of_sources(correlation.names, scan.tuning)
        stated = 1.0 / before.error_factor[was, None, None], 1.0 / scan.error_factor[place, None, None]
        as_stated = stated[0] ** 2 * one + stated[1] ** 2 * other
        few = factors.telling(source, here, as_stated, motion)
        was = was[few]
        # Of the motion what comes of the errors of velocities that were measured.
        later, moving = times_s[0][k[few], None, None], before.moving[was, None, None]
        cross, velocity = (before.reported_covariance[was, v, 2:] for v in (slice(2), slice(2, 4)))
        carried = np.where(moving, later * (cross + cross.transpose(0, 2, 1) + later * velocity), 0.0)
        factors = factors.with_shifts(
            source[few], shift[few], (as_stated[few], (stated[0] * stated[1])[few] * shared(few)),
            (motion[few], growth(carried)), scan.tuning,
        )  # fmt: skip
        return correlation, factors


def with_lasting(covariance: FloatArray, lasting: FloatArray) -> FloatArray:
    """(k, 4, 4) covariance of (e, z) before any other report: of e P (k, 2, 2), of both B (k, 2, 2), of z 1."""
    return np.asarray(
        np.block([[covariance, lasting], [lasting.transpose(0, 2, 1), np.broadcast_to(np.eye(2), lasting.shape)]])
    )


def _lasting_root(scan: Scan, correlation: ErrorCorrelation) -> FloatArray:
    """(n, 2, 2) B = √s L of every record, 0 for directions."""
    out = np.zeros((len(scan), 2, 2))
    at = np.flatnonzero(scan.placed)
    share = correlation.lasting(correlation.numbers(scan)[scan.source[at]], scan.tuning)
    covariance, root = scan.reported_covariance[at], np.sqrt(share)
    first = np.sqrt(covariance[:, 0, 0])
    cross = covariance[:, 1, 0] / first
    out[at, 0, 0], out[at, 1, 0] = root * first, root * cross
    out[at, 1, 1] = root * np.sqrt(covariance[:, 1, 1] - cross**2)
    return out
