"""Faults of sources over time: a clock that jumps, a source that ends early, freezes or floods.

Each is an alarm with its log-odds against a sound source, and so a probability. Sound sources differ from each other
more than any model allows, so each is compared with its own previous behaviour.

- :func:`source_faults`: of all sources of a scene. :func:`clock_jumps`: of the clock of one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from sameas.arrays import FloatArray
from sameas.tracks.alignment import States, follow, followed_back, track_numbers
from sameas.tracks.clocks import CLOCK_SEARCH_S, FAULT_PRIOR, SURE_FAULT, Steps, jump_of
from sameas.tracks.feed import CORRELATED_KINDS, Feed, walk_of
from sameas.tracks.reports import Reports

FAULT_REPORTS = 20  # minimum number of reports of a tested source
CLOCK_JUMPS = 3  # maximum number of jumps of a clock
ENDED_S, ENDED_SHARE = 60.0, 0.1  # a source has ended if it is silent for this time and this share of the whole time
#: Minimum number of repeated positions of a frozen track, probability that a moving track repeats a position, and
#: maximum evidence of one track.
FROZEN_REPORTS, P_REPEATED, TRACK_VOTE = 3, 0.02, 8.0
#: Width of the intervals in which reports are counted, a flood's minimum ratio to, and excess over, the usual count.
FLOOD_S, FLOOD_FACTOR, FLOOD_MIN = 10.0, 5.0, 50.0


@dataclass(frozen=True)
class Fault:
    """An alarm on one source, or on one of its tracks.

    kind : "clock", "ended", "frozen", "flood", "dragged", "silent", "jumped", "exchanged" or "phantom". source : name.
    track : its id, "" for the whole source. first_s, last_s : begin and end of the fault. log_odds : against a sound
    source. words : what is wrong and what to do. seen_as : source and track of each sensor that still shows the object.
    """

    kind: str
    source: str
    first_s: float
    last_s: float
    log_odds: float
    words: str
    track: str = ""
    seen_as: tuple[tuple[str, str], ...] = ()

    @property
    def probability(self) -> float:
        """Of the fault."""
        return float(expit(self.log_odds))

    def __str__(self) -> str:
        sure = "more than 0.999" if self.probability > 0.999 else f"{self.probability:.3f}"
        return f"{self.words} (probability {sure}, log evidence {self.log_odds:.1f})"


def source_faults(feeds: Sequence[Feed]) -> tuple[Fault, ...]:
    """The faults of the sources of a scene with a probability above ``SURE_FAULT``, in order of time."""
    faults = [fault for feed in feeds for fault in _faults(feed, feeds) if fault.probability > SURE_FAULT]
    return tuple(sorted(faults, key=lambda fault: fault.first_s))


def _faults(feed: Feed, feeds: Sequence[Feed]) -> Iterator[Fault]:
    if feed.raw_reports is None or len(feed.raw_reports) < FAULT_REPORTS:
        return
    name = feed.description.name
    for leap in feed.leaps:
        yield Fault("clock", name, leap.first_s, leap.last_s, leap.log_odds, f"{name}: {leap}")
    yield from clock_jumps(feed)
    yield from _ended(feed, feeds)
    yield from _frozen(feed)
    yield from _floods(feed)


def clock_jumps(feed: Feed) -> list[Fault]:
    """Jumps of a clock within its file: from one line on, the stamps of all moving tracks are early or late.

    A manoeuvre or an outlier affects one track only, so the evidence of each track is bounded.
    """
    reports = feed.reports
    if not isinstance(reports, States) or reports.track is None or not feed.has_velocities:
        return []
    before, after = reports, None
    if feed.measured is not None and feed.description.kind not in CORRELATED_KINDS:
        before, after = _filtered_both_ways(feed.measured, feed)
    steps = Steps.of(before, feed.walk_m2_per_s3, after)
    jumps: list[Fault] = []
    ahead = np.arange(*CLOCK_SEARCH_S)
    seconds = np.concatenate([-ahead[::-1], ahead])
    at = np.asarray(reports.rows)
    for _ in range(CLOCK_JUMPS):
        jump = jump_of(steps, at, seconds, FAULT_PRIOR)
        if jump is None or jump[0] <= 0.0:
            break
        log_odds, row, jump_s, votes = jump
        when = float(reports.time_s[int(np.flatnonzero(at == row)[0])])
        words = (
            f"{feed.description.name}: its clock jumps by {jump_s:+.0f} s, as the motion of {votes} tracks shows; "
            "correct the stamps from then on, or leave the source out"
        )
        jumps.append(Fault("clock", feed.description.name, when, float(reports.time_s.max()), log_odds, words))
        across_jump = (at[steps.first] < row) & (row <= at[steps.second])
        steps = steps.take(~across_jump)
    return jumps


def _filtered_both_ways(measured: States, feed: Feed) -> tuple[States, States]:
    """Measured positions filtered to tracks forwards and backwards; where the stamps of the file go back, anew."""
    at = np.argsort(measured.rows, kind="stable")
    part = np.empty(len(measured), np.int64)
    part[at] = np.cumsum(np.diff(measured.time_s[at], prepend=-np.inf) < -CLOCK_SEARCH_S[0])
    assert measured.track is not None
    number = track_numbers(measured.track)
    speed = feed.description.motion.speed_m_per_s or 0.0
    given = States.of(
        measured.time_s,
        measured.state[:, :2],
        measured.covariance[:, :2, :2],
        track=part * (number.max(initial=0) + 1) + number,
        speed_m_per_s=speed,
    )
    walk = walk_of(feed.description)
    forwards = follow(given, acceleration_m2_per_s3=walk).states
    back = followed_back(given, acceleration_m2_per_s3=walk, speed_m_per_s=speed)
    track, rows = measured.track, measured.rows
    return replace(forwards, track=track, rows=rows), replace(back, track=track, rows=rows)


def _ended(feed: Feed, feeds: Sequence[Feed]) -> Iterator[Fault]:
    """A source whose reports end while those of others continue, compared with its longest previous pause."""
    others = [other.reports.time_s for other in feeds if other is not feed and len(other.reports)]
    times = np.unique(feed.reports.time_s)
    if not others or len(times) < FAULT_REPORTS:
        return
    end, begin = max(float(t.max()) for t in others), min(float(t.min()) for t in others)
    silent_s, pauses = end - float(times[-1]), np.diff(times)
    longest = max(float(pauses.max()), feed.description.timing.period_s or 0.0)
    if silent_s < max(ENDED_S, ENDED_SHARE * (end - begin)):
        return
    log_odds = log_odds_of_silence(silent_s, longest, len(pauses), FAULT_PRIOR)
    name = feed.description.name
    words = (
        f"{name}: ends {silent_s:.0f} s before the others, its longest pause before was {longest:.3g} s; what it "
        "showed is unseen from then on, not gone"
    )
    yield Fault("ended", name, float(times[-1]), end, log_odds, words)


def log_odds_of_silence(silent_s: float, longest_s: float, pauses: int, prior: float) -> float:
    """Log-odds that a silence is the end of the reports.

    longest_s : the longest previous pause. pauses : their number. prior : prior odds. The model: pauses are exponential
    with the longest one occurring once.
    """
    return (silent_s / longest_s - 1.0) * math.log(pauses) + math.log(prior)


def _places(reports: Reports) -> FloatArray | None:
    """(n, 2) positions as the source gives them, unrounded."""
    for one, other in (("lat_deg", "lon_deg"), ("x_m", "y_m"), ("range_m", "bearing_deg")):
        first, second = getattr(reports, one), getattr(reports, other)
        if first is not None and second is not None:
            return np.column_stack([first, second])
    return None


def _frozen(feed: Feed) -> Iterator[Fault]:
    """A source whose moving tracks repeat their last positions exactly until it ends."""
    raw, reports = feed.raw_reports, feed.reports
    position = None if raw is None else _places(raw)
    if raw is None or position is None or not isinstance(reports, States) or raw.object_ids is None:
        return
    number = track_numbers(raw.object_ids)
    order = np.lexsort([raw.time_s, number])
    time_s, position, number = raw.time_s[order], position[order], number[order]
    last_two = np.flatnonzero(np.diff(number, append=-1))[:, None] - [1, 0]
    if (position[last_two[:, 0]] != position[last_two[:, 1]]).any(axis=1).all():
        return  # No track ends with a position that it repeats.
    velocity = raw.velocity_m_per_s()
    # Without velocities a track counts as moving by its changing positions only.
    speed = np.full(len(order), np.inf) if velocity is None else np.nan_to_num(np.hypot(*velocity.T), nan=0.0)[order]
    end, votes, n_frozen, begins = float(raw.time_s.max()), 0.0, 0, []
    n_moving = 0
    for rows in np.split(np.arange(len(order)), np.flatnonzero(np.diff(number)) + 1):
        changed = np.flatnonzero((position[rows[1:]] != position[rows[:-1]]).any(axis=1))
        if len(changed) < FROZEN_REPORTS or end - time_s[rows[-1]] > 0.25 * (end - float(raw.time_s.min())):
            continue
        last = int(changed[-1]) + 1
        update_s = np.diff(time_s[rows[np.append(0, changed + 1)]])
        # A moving track has a new position with nearly every report; one at anchor may repeat it.
        if len(changed) < 0.8 * last or (np.median(speed[rows]) < 1.0):
            continue
        n_moving += 1
        n_repeats = len(rows) - 1 - last
        frozen_s = time_s[rows[-1]] - time_s[rows[last]]
        if n_repeats >= FROZEN_REPORTS and frozen_s > 5.0 * float(np.median(update_s)):
            n_frozen += 1
            begins.append(float(time_s[rows[last]]))
            votes += min(n_repeats * math.log(1.0 / P_REPEATED), TRACK_VOTE)
    log_odds = votes + (n_moving - n_frozen) * math.log(P_REPEATED) + math.log(FAULT_PRIOR)
    if n_frozen:
        name = feed.description.name
        words = (
            f"{name}: is frozen: {n_frozen} of {n_moving} moving tracks repeat their last positions while their stamps "
            "go on; its positions are stale from then on"
        )
        yield Fault("frozen", name, float(np.median(begins)), end, log_odds, words)


def _floods(feed: Feed) -> Iterator[Fault]:
    """Intervals in which a source gives many times its usual number of reports."""
    time_s = feed.reports.time_s
    width = max(FLOOD_S, 5.0 * (feed.description.timing.period_s or 0.0))
    bins = ((time_s - time_s.min()) // width).astype(np.int64)
    if not 5 <= bins.max(initial=0) < 10**6:
        return
    count = np.bincount(bins)
    typical = max(float(np.median(count)), 1.0)
    normal = count[count <= np.quantile(count, 0.9)]
    dispersion = max(float(np.var(normal)) / max(float(normal.mean()), 1.0), 1.0)
    flooded = (count > FLOOD_FACTOR * typical) & (count > typical + FLOOD_MIN)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flooded.astype(np.int64), [0]])))
    for low, high in zip(edges[::2], edges[1::2], strict=True):
        reports, expected = float(count[low:high].sum()), typical * (high - low)
        log_odds = (reports * math.log(reports / expected) - reports + expected) / dispersion
        log_odds += math.log(FAULT_PRIOR / len(count))
        name, begin = feed.description.name, float(time_s.min()) + float(low) * width
        words = (
            f"{name}: flood of reports: {reports:.0f} reports in {width * (high - low):.0f} s, {expected:.0f} are "
            "usual; look for repeated or fabricated reports"
        )
        yield Fault("flood", name, begin, begin + float(high - low) * width, log_odds, words)
