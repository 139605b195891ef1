"""The clock of a source by the motion of what it shows: by how long stamps disagree with the ways between them.

Between two reports of one track lies a way, which its speed makes a time. A clock that jumps is wrong for all tracks at
once, by as much; a ship that manoeuvres or leaps says it of itself only.

- :class:`Steps`: reports of moving tracks and the next of the same. :func:`jump_of`: the jump that explains them best.
- :func:`with_minutes`: a clock that was counted on from the seconds in messages, with the minutes it missed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.tracks.alignment import States
from sameas.tracks.tuning import Tuning


@dataclass(frozen=True)
class Steps:
    """Reports of moving tracks and the next of the same in the file (m,): rows, and by how long stamps disagree.

    late_s, sigma_s : seconds that the second stamp is beyond what the way between them says, and their 1σ.
    track : number of the track.
    """

    first: IntArray
    second: IntArray
    late_s: FloatArray
    sigma_s: FloatArray
    track: IntArray

    @classmethod
    def of(cls, reports: States, walk: FloatArray, tuning: Tuning) -> Steps:
        """Of reports with velocities, in the order of the file."""
        assert reports.track is not None
        rows = np.flatnonzero(reports.usable)
        rows = rows[np.argsort(reports.rows[rows], kind="stable")]
        _, number = np.unique(reports.track[rows].astype(str), return_inverse=True)
        order = np.argsort(number, kind="stable")
        rows, number = rows[order], number[order]
        same = number[1:] == number[:-1]
        a, b, track = rows[:-1][same], rows[1:][same], number[1:][same]
        velocity = 0.5 * (reports.state[a, 2:] + reports.state[b, 2:])
        speed = np.maximum(np.hypot(*velocity.T), 1e-9)
        way, dt = reports.state[b, :2] - reports.state[a, :2], reports.time_s[b] - reports.time_s[a]
        beyond = way - velocity * dt[:, None]
        along = np.einsum("nv,nv->n", beyond, velocity) / speed
        across = np.abs(beyond[:, 0] * velocity[:, 1] - beyond[:, 1] * velocity[:, 0]) / speed
        spread = reports.covariance[a] + reports.covariance[b]
        # True seconds between the reports are those of the way, where stamps are wrong.
        passed = np.hypot(*way.T) / speed + np.abs(dt)
        variance = 0.5 * np.einsum("nvv->n", spread[:, :2, :2]) + walk[a] * passed**3 / 6.0
        variance = variance + passed**2 * np.einsum("nvv->n", spread[:, 2:, 2:]) / 8.0
        known = spread[:, 2, 2] < 0.1 * speed**2 + 1.0
        turned = np.hypot(*(reports.state[a, 2:] - reports.state[b, 2:]).T) > 0.3 * speed
        kept = known & ~turned & (speed > tuning.clock_speed_m_per_s) & (across < 4.0 * np.sqrt(variance))
        kept &= passed < tuning.clock_gap_s
        sigma = np.sqrt(variance) / speed
        return cls(a[kept], b[kept], -(along / speed)[kept], np.hypot(sigma, tuning.stamp_s)[kept], track[kept])


def jump_of(
    steps: Steps, at: IntArray, seconds: FloatArray, prior: float, tuning: Tuning
) -> tuple[float, int, float, int] | None:
    """The most probable jump: log-odds, row of the file from which on, seconds, number of tracks that vote for it.

    at : (n,) row of the file of every report. seconds : jumps that are tried. prior : probability that there is one.
    """
    if len(steps.first) < 2:
        return None
    size = int(at.max()) + 2
    outlier = math.log(tuning.clock_outlier / (2.0 * tuning.clock_search_s[1]))
    sound = np.logaddexp(_normal(steps.late_s, steps.sigma_s), outlier)
    best: tuple[float, int, float, int] | None = None
    # Lines between the same two reports of a track are one place to jump.
    places = len(steps.first) / len(np.unique(steps.track))
    for jump_s in seconds:
        vote = np.logaddexp(_normal(steps.late_s - jump_s, steps.sigma_s), outlier) - sound
        vote = np.clip(vote, -tuning.clock_vote, tuning.clock_vote)
        total = np.zeros(size)
        np.add.at(total, at[steps.first] + 1, vote)
        np.add.at(total, at[steps.second] + 1, -vote)
        total = np.cumsum(total)
        row = int(np.argmax(total))
        log_odds = float(total[row]) + math.log(prior / (len(seconds) * places))
        if best is None or log_odds > best[0]:
            over = (at[steps.first] < row) & (row <= at[steps.second]) & (vote > 0.0)
            best = log_odds, row, float(jump_s), len(np.unique(steps.track[over]))
    return best


def _normal(value: FloatArray, sigma: FloatArray) -> FloatArray:
    return np.asarray(-0.5 * (value / sigma) ** 2 - np.log(sigma * math.sqrt(2.0 * math.pi)))


def with_minutes(reports: States, walk: FloatArray, tuning: Tuning) -> tuple[States, int]:
    """Reports whose stamps were counted on from the seconds in messages, with the minutes that were missed.

    A pause of more than half a minute loses whole minutes. They are put in where the motion of the tracks shows them.
    Also how many there were.
    """
    if reports.track is None:
        return reports, 0
    at, count = np.asarray(reports.rows), 0
    seconds = -60.0 * np.arange(1.0, tuning.most_minutes + 1.0)
    for _ in range(tuning.most_pauses):
        steps = Steps.of(reports, walk, tuning)
        found = jump_of(steps, at, seconds, tuning.pause_prior, tuning)
        if found is None or found[0] <= 0.0:
            break
        _, row, jump_s, _ = found
        reports = replace(reports, time_s=np.where(at >= row, reports.time_s - jump_s, reports.time_s))
        count -= round(jump_s / 60.0)
    return reports, count
