"""Clocks of sources, checked by the motion of their tracks.

The distance between two reports of one track, divided by its speed, is a time. A clock jump shifts all tracks at once
by the same time; a manoeuvre or an outlier affects one track only.

- :class:`Steps`: successive reports of moving tracks. :func:`jump_of`: the most probable jump of a clock by seconds.
- :func:`with_minutes`: a clock that is counted from the seconds in messages, with missing minutes inserted.
- :func:`leaps_of`: jumps by more than a report's motion can bridge, which the stamps themselves show, line by line;
  :func:`without_leaps`: the reports without those of a clock that was wrong for a while.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from sameas.arrays import ColumnTable, FloatArray, IntArray
from sameas.kernels.tracks import search_jumps
from sameas.representation import counted
from sameas.tracks.alignment import States, track_numbers

#: Prior probability of a fault of one kind, and the probability at which it is an alarm.
FAULT_PRIOR, SURE_FAULT = 1e-3, 0.95
#: Minimum speed of the tracks used, maximum time between their reports, and 1σ of a correct time stamp.
CLOCK_SPEED_M_PER_S, CLOCK_GAP_S, STAMP_S = 1.5, 400.0, 1.5
CLOCK_SEARCH_S = (6.0, 181.0, 2.0)  # trial jumps: from, to, step
CLOCK_OUTLIER, CLOCK_VOTE = 0.05, 8.0  # share of outliers among the steps of tracks, and maximum evidence of one step
LEAP_GAP_S = 60.0  # most seconds that pass in truth from one line of a file to the next where its stamps leap
#: Of a clock counted from the seconds in messages: maximum number of whole minutes lost in one pause, maximum number of
#: corrected pauses, and probability that there is another one.
MAX_MINUTES, MAX_PAUSES, PAUSE_PRIOR = 10, 100, 0.3


@dataclass(frozen=True)
class Steps(ColumnTable):
    """Pairs of successive reports of moving tracks in the order of the file, (m,) each.

    first, second : rows. late_s, sigma_s : seconds by which the second stamp is later than the motion predicts, and 1σ.
    track : number of the track.
    """

    first: IntArray
    second: IntArray
    late_s: FloatArray
    sigma_s: FloatArray
    track: IntArray

    @classmethod
    def of(cls, reports: States, walk: FloatArray, later: States | None = None) -> Steps:
        """Of reports with velocities, in the order of the file.

        later : the states that the later report of each pair is taken from, for reports that are filtered: they are to
            be filtered backwards (:func:`sameas.tracks.alignment.followed_back`), since a filter follows a track where
            its clock jumps.
        """
        assert reports.track is not None
        ends = reports if later is None else later
        rows = np.flatnonzero(reports.usable)
        rows = rows[np.argsort(reports.rows[rows], kind="stable")]
        number = track_numbers(reports.track[rows])
        order = np.argsort(number, kind="stable")
        rows, number = rows[order], number[order]
        same = number[1:] == number[:-1]
        a, b, track = rows[:-1][same], rows[1:][same], number[1:][same]
        velocity = 0.5 * (reports.state[a, 2:] + ends.state[b, 2:])
        speed = np.maximum(np.hypot(*velocity.T), 1e-9)
        step, dt = ends.state[b, :2] - reports.state[a, :2], reports.time_s[b] - reports.time_s[a]
        residual = step - velocity * dt[:, None]
        along = np.einsum("nv,nv->n", residual, velocity) / speed
        across = np.abs(residual[:, 0] * velocity[:, 1] - residual[:, 1] * velocity[:, 0]) / speed
        total = reports.covariance[a] + ends.covariance[b]
        # An upper limit of the true time between the reports, whether or not the stamps are wrong.
        elapsed = np.hypot(*step.T) / speed + np.abs(dt)
        variance = 0.5 * np.einsum("nvv->n", total[:, :2, :2]) + walk[a] * elapsed**3 / 6.0
        variance = variance + elapsed**2 * np.einsum("nvv->n", total[:, 2:, 2:]) / 8.0
        known = total[:, 2, 2] < 0.1 * speed**2 + 1.0
        turned = np.hypot(*(reports.state[a, 2:] - ends.state[b, 2:]).T) > 0.3 * speed
        kept = known & ~turned & (speed > CLOCK_SPEED_M_PER_S) & (across < 4.0 * np.sqrt(variance))
        kept &= elapsed < CLOCK_GAP_S
        sigma = np.sqrt(variance) / speed
        return cls(a[kept], b[kept], -(along / speed)[kept], np.hypot(sigma, STAMP_S)[kept], track[kept])


def jump_of(steps: Steps, at: IntArray, seconds: FloatArray, prior: float) -> tuple[float, int, float, int] | None:
    """The most probable clock jump: log-odds, first row of the file after it, seconds, number of supporting tracks.

    at : (n,) row of the file of each report. seconds : the jumps to try. prior : probability of a jump.
    """
    if len(steps.first) < 2:
        return None
    log_outlier = math.log(CLOCK_OUTLIER / (2.0 * CLOCK_SEARCH_S[1]))
    log_width = np.log(steps.sigma_s * math.sqrt(2.0 * math.pi))

    def log_density(late_s: FloatArray) -> FloatArray:
        return np.asarray(np.logaddexp(-0.5 * (late_s / steps.sigma_s) ** 2 - log_width, log_outlier))

    log_no_jump = log_density(steps.late_s)
    before, after = at[steps.first], at[steps.second]
    total, row = np.empty(len(seconds)), np.empty(len(seconds), np.int64)
    search_jumps(
        seconds, steps.late_s, steps.sigma_s, log_width, log_no_jump, before + 1, after + 1, log_outlier,
        CLOCK_VOTE, total, row,
    )  # fmt: skip
    # All lines between the same two reports of a track are one place for a jump.
    places = len(steps.first) / len(np.unique(steps.track))
    log_odds = total + math.log(prior / (len(seconds) * places))
    best = int(np.argmax(log_odds))
    across = (before < row[best]) & (row[best] <= after)
    supports = across & (log_density(steps.late_s - seconds[best]) > log_no_jump)
    votes = len(np.unique(steps.track[supports]))
    return float(log_odds[best]), int(row[best]), float(seconds[best]), votes


def with_minutes(reports: States, walk: FloatArray) -> tuple[States, int]:
    """The reports with missing minutes inserted, and how many; for stamps counted from the seconds in messages.

    A pause of more than half a minute loses whole minutes. They are inserted where the motion of the tracks shows them.
    """
    if reports.track is None:
        return reports, 0
    at, count = np.asarray(reports.rows), 0
    seconds = -60.0 * np.arange(1.0, MAX_MINUTES + 1.0)
    for _ in range(MAX_PAUSES):
        steps = Steps.of(reports, walk)
        jump = jump_of(steps, at, seconds, PAUSE_PRIOR)
        if jump is None or jump[0] <= 0.0:
            break
        _, row, jump_s, _ = jump
        reports = replace(reports, time_s=np.where(at >= row, reports.time_s - jump_s, reports.time_s))
        count -= round(jump_s / 60.0)
    return reports, count


@dataclass(frozen=True)
class Leap:
    """A jump of a clock by ``seconds`` from one line of the file to the next, which the tracks do not make.

    row : of the source's table, from which on the stamps are wrong. until : row at which they are right again; None if
    they do not return. first_s, last_s : the stamps before these rows, of a clock that does not return its last one.
    log_odds : against a pause, or reports that were late. votes : number of tracks that show it.
    """

    row: int
    until: int | None
    first_s: float
    last_s: float
    seconds: float
    log_odds: float
    votes: int

    @property
    def probability(self) -> float:
        return float(expit(self.log_odds))

    def __str__(self) -> str:
        shows = f"as the motion of {self.votes} tracks shows"
        if self.until is None:
            return (
                f"its clock jumps by {self.seconds:+.0f} s, {shows}; correct its stamps from then on, or leave it out"
            )
        sense, off = "ahead" if self.seconds > 0.0 else "behind", f"{abs(self.seconds):.0f} s"
        n, span = self.until - self.row, f"{self.last_s - self.first_s:.0f} s"
        return f"its clock is {off} {sense} for {span}, {shows}; the {counted(n, 'report')} of it are set aside"


def leaps_of(reports: States, walk: FloatArray) -> tuple[Leap, ...]:
    """Jumps by more than ``CLOCK_SEARCH_S``: the stamps leap, and the tracks go on as if no time had passed.

    After a pause of the source the tracks are elsewhere; a report that was late is where its track had been.
    walk : (n,) as of :meth:`Steps.of`.
    """
    order = np.argsort(reports.rows, kind="stable")
    time_s = reports.time_s[order]
    step_s = np.diff(time_s, prepend=time_s[:1])
    at = np.flatnonzero(np.abs(step_s) > CLOCK_SEARCH_S[1])
    if reports.track is None or not len(at):
        return ()
    part = np.empty(len(order), np.int64)
    part[order] = np.cumsum(np.abs(step_s) > CLOCK_SEARCH_S[1])
    evidence = _evidence(reports, part, np.append(0.0, step_s[at]), walk)
    rows, out, n = np.asarray(reports.rows)[order], [], 0
    while n < len(at):
        begin, (log_odds, votes, passed_s) = int(at[n]), evidence[n + 1]
        n += 1
        if expit(log_odds) <= SURE_FAULT:
            continue
        seconds = float(step_s[begin]) - passed_s
        back = np.flatnonzero(np.abs(step_s[at[n:]] + seconds) < LEAP_GAP_S)
        until = int(at[n + back[0]]) if len(back) else None
        last_s = float(time_s[-1] if until is None else time_s[until - 1] - seconds)
        row, until_row = int(rows[begin]), None if until is None else int(rows[until])
        out.append(Leap(row, until_row, float(time_s[begin - 1]), last_s, seconds, log_odds, votes))
        n = len(at) if until is None else n + int(back[0]) + 1
    return tuple(out)


def _evidence(reports: States, part: IntArray, step_s: FloatArray, walk: FloatArray) -> list[tuple[float, int, float]]:
    """Of the leap to each part of the file (``step_s``): its log-odds, the number of tracks that show it, and the
    seconds that passed in truth."""
    closed = replace(reports, time_s=reports.time_s - np.cumsum(step_s)[part])
    steps = Steps.of(closed, walk)
    crossing = part[steps.second] == part[steps.first] + 1
    n_moving = _tracks_across(reports, part)
    log_outlier = math.log(CLOCK_OUTLIER / (2.0 * CLOCK_SEARCH_S[1]))
    # One value of the time that passed, common to all tracks, is fitted for each leap.
    log_prior = math.log(FAULT_PRIOR / (len(step_s) * LEAP_GAP_S / STAMP_S))
    out = [(-math.inf, 0, 0.0)] * len(step_s)
    for k in np.unique(part[steps.second[crossing]]).tolist():
        across = crossing & (part[steps.second] == k)
        late_s, sigma_s = steps.late_s[across], steps.sigma_s[across]
        passed_s = -float(np.median(late_s))
        log_normal = -0.5 * ((late_s + passed_s) / sigma_s) ** 2 - np.log(sigma_s * math.sqrt(2.0 * math.pi))
        votes = np.clip(log_normal - log_outlier, 0.0, CLOCK_VOTE)
        shown = int(np.sum(votes > 0.0))
        if 2 * shown > n_moving[k] and abs(passed_s) < LEAP_GAP_S:
            out[k] = (float(votes.sum()) + log_prior, shown, passed_s)
    return out


def _tracks_across(reports: States, part: IntArray) -> IntArray:
    """(parts,) number of moving tracks with a report in each part of the file and one in the part before."""
    assert reports.track is not None
    moving = np.flatnonzero(np.hypot(*reports.state[:, 2:].T) > CLOCK_SPEED_M_PER_S)
    n_parts = int(part.max()) + 1
    seen = np.unique(track_numbers(reports.track)[moving] * n_parts + part[moving])
    return np.bincount(seen[np.isin(seen - 1, seen) & (seen % n_parts > 0)] % n_parts, minlength=n_parts)


def without_leaps(reports: States, leaps: Sequence[Leap]) -> States:
    """The reports; those of a clock that returned have the times they would have, and no position."""
    time_s, state = reports.time_s.copy(), reports.state.copy()
    for leap in leaps:
        if leap.until is not None:
            wrong = (reports.rows >= leap.row) & (reports.rows < leap.until)
            time_s[wrong] -= leap.seconds
            state[wrong] = np.nan
    return replace(reports, time_s=time_s, state=state) if leaps else reports
