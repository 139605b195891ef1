"""Compiled loops over the reports of tracks: their Kalman filter, and the evidence of their motion on a clock
(:mod:`sameas.tracks.alignment`); those that a live feed drops, and those beside new ones
(:mod:`sameas.tracks.live_feed`); the durations of tracks (:mod:`sameas.picture.track_existence`) and their places in
tables."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray, is_dense, places_in
from sameas.kernels.compiled import part, runs_compiled, small, small_by
from sameas.kernels.kalman import state_moved
from sameas.kernels.linear import solve_2


def _work(rows: IntArray, begins: BoolArray, *_: object) -> float:
    # A report that continues a track takes 0.1 ms if interpreted.
    return 100.0 * (len(rows) - 0.9 * begins.sum())


@small_by(_work)
def filter_tracks(
    rows: IntArray, begins: BoolArray, time_s: FloatArray, walk: float, fast: float, new_chi_sq: float,
    lag_chi_sq: float, manoeuvre_s: float, memory: float, most: float, state: FloatArray, covariance: FloatArray,
    trend: FloatArray, nis: FloatArray, began: BoolArray,
) -> None:  # fmt: skip
    """Replace the states (n, 4) and covariances (n, 4, 4) of reports, of which the positions are measured, by those of
    their tracks after each, and write ``nis``, ``began`` (n,) and ``trend`` (n, 4), as of
    :class:`sameas.tracks.alignment.FilteredTracks`.

    rows : (k,) reports by track and time. begins : (k,) whether one is the first of its track; it keeps its state and
    its trend. walk, fast : m²/s³, random walk of the velocity, and during a manoeuvre of ``manoeuvre_s`` seconds.
    new_chi_sq : χ² of an innovation beyond which a track begins. lag_chi_sq : χ² of the sum of innovations beyond which
    a manoeuvre does. memory : weight of that sum at the next report. most : of an innovation, in σ.
    """
    x, p, wide = np.empty(4), np.empty((4, 4)), np.empty((4, 4))
    for at in range(len(rows)):
        row, last = rows[at], rows[at - 1]
        if begins[at]:
            began[row] = True
            continue
        dt = time_s[row] - time_s[last]
        since_s = _since(trend[last], abs(dt), lag_chi_sq, manoeuvre_s)
        for v in range(4):
            for w in range(4):
                wide[v, w] = covariance[last, v, w]
        if since_s == 0.0 and trend[last, 3] > manoeuvre_s:
            # It began about the memory of the sum ago.
            _add_noise(wide, min(abs(dt) * memory / (1.0 - memory), manoeuvre_s), fast)
        state_moved(state[last], wide, dt, walk if since_s > manoeuvre_s else fast, x, p)
        a, b, c = p[0, 0] + covariance[row, 0, 0], p[0, 1] + covariance[row, 0, 1], p[1, 1] + covariance[row, 1, 1]
        determinant = a * c - b * b
        east, north = state[row, 0] - x[0], state[row, 1] - x[1]
        one, other = solve_2(a, b, c, determinant, east, north)
        chi_sq = east * one + north * other
        if chi_sq > new_chi_sq:
            began[row] = True
            trend[row, 0] = trend[row, 1] = trend[row, 2] = 0.0
            trend[row, 3] = math.inf
            continue
        nis[row] = chi_sq
        _add_innovation(trend[last], a, b, c, east, north, memory, most, trend[row])
        trend[row, 3] = since_s
        for v in range(4):
            state[row, v] = x[v] + p[v, 0] * one + p[v, 1] * other
            gain, gain_other = solve_2(a, b, c, determinant, p[v, 0], p[v, 1])
            for w in range(v + 1):
                value = p[v, w] - gain * p[0, w] - gain_other * p[1, w]
                covariance[row, v, w] = covariance[row, w, v] = value


@part
def _since(trend: FloatArray, elapsed_s: float, lag_chi_sq: float, manoeuvre_s: float) -> float:
    """Seconds since a manoeuvre was detected, 0 for one detected now: the last innovations lie on one side."""
    if elapsed_s <= manoeuvre_s and trend[0] * trend[0] + trend[1] * trend[1] > lag_chi_sq * trend[2]:
        return 0.0
    return trend[3] + elapsed_s


@part
def _add_noise(p: FloatArray, elapsed_s: float, walk: float) -> None:
    """Add the noise of so many seconds to a covariance (4, 4), Q of :func:`sameas.tracks.alignment.process_noise`."""
    for v in range(2):
        p[v, v] += walk * elapsed_s * elapsed_s * elapsed_s / 3.0
        p[v, 2 + v] += walk * elapsed_s * elapsed_s / 2.0
        p[2 + v, v] = p[v, 2 + v]
        p[2 + v, 2 + v] += walk * elapsed_s


@part
def _add_innovation(
    before: FloatArray, a: float, b: float, c: float, east: float, north: float, memory: float, most: float,
    trend: FloatArray,
) -> None:  # fmt: skip
    """Write the fading sum of the innovations and its variance after one more, of covariance [[a, b], [b, c]]."""
    root = math.sqrt(a)
    slope = b / root
    x = east / root
    y = (north - slope * x) / math.sqrt(max(c - slope * slope, 1e-12))
    # A single outlier is no lag.
    shrunk = min(most / max(math.sqrt(x * x + y * y), 1e-12), 1.0)
    trend[0], trend[1] = memory * before[0] + shrunk * x, memory * before[1] + shrunk * y
    trend[2] = memory * memory * before[2] + 1.0


def _work_of_jumps(seconds: FloatArray, late_s: FloatArray, *_: object) -> float:
    return 2.0 * len(seconds) * len(late_s)


@small_by(_work_of_jumps)
def search_jumps(
    seconds: FloatArray, late_s: FloatArray, sigma_s: FloatArray, log_width: FloatArray, log_no_jump: FloatArray,
    begins: IntArray, ends: IntArray, log_outlier: float, most: float, total: FloatArray, row: IntArray,
) -> None:  # fmt: skip
    """Write for each jump (s,) of a clock by ``seconds`` the most probable ``row`` of the file from which on it stands,
    the first of several, and ``total``, the log-ratio there: the sum over the pairs of reports on both sides of it.

    late_s, sigma_s : (m,) as of :class:`sameas.tracks.clocks.Steps`. log_width : (m,) ln(σ √(2π)). log_no_jump :
    (m,) ln of the density of the stamps without a jump. begins, ends : (m,) the rows, from the first to before the
    second, from which on a jump lies between the reports of a pair. log_outlier : ln of the density of a stamp that no
    motion explains. most : limit of the log-ratio of a pair, and of its negative.
    """
    rows = ends.max() + 1
    added, taken = np.empty(rows), np.empty(rows)
    for s in range(len(seconds)):
        added[:] = 0.0
        taken[:] = 0.0
        for k in range(len(late_s)):
            sigmas = (late_s[k] - seconds[s]) / sigma_s[k]
            log_normal = -0.5 * (sigmas * sigmas) - log_width[k]
            ratio = min(max(_log_sum(log_normal, log_outlier) - log_no_jump[k], -most), most)
            added[begins[k]] += ratio
            taken[ends[k]] += ratio
        here = 0.0
        total[s], row[s] = -math.inf, 0
        for n in range(rows):
            here += added[n] - taken[n]
            if here > total[s]:
                total[s], row[s] = here, n


@part
def _log_sum(x: float, y: float) -> float:
    """ln(eˣ + eʸ), as of ``np.logaddexp``; of an x far below y it is y, for which no exponential is taken."""
    if x > y:
        return x + math.log1p(math.exp(y - x))
    return y if x < y - 50.0 else y + math.log1p(math.exp(x - y))


@small
def outdated(
    order: IntArray, number: IntArray, time_s: FloatArray, late_s: FloatArray, horizon_s: float, ended_s: float,
    dropped: BoolArray, ended: BoolArray, gaps: FloatArray,
) -> int:  # fmt: skip
    """Write which reports (k,) no instant at or after the horizon needs: those with a later one of their track at or
    before it, and those before ``ended_s``; and which of them are the last of their tracks. Writes the gaps (k, 2) to
    the later ones, and how late these were; returns their number.

    order : (k,) rows by track and time. number, time_s, late_s : (n,) of all rows.
    """
    n_gaps = 0
    for k in range(len(order)):
        row, later = order[k], order[min(k + 1, len(order) - 1)]
        goes_on = later != row and number[later] == number[row]
        dropped[k] = time_s[row] < ended_s
        ended[k] = dropped[k] and not goes_on
        if goes_on and time_s[later] <= horizon_s:
            dropped[k] = True
            gaps[n_gaps, 0], gaps[n_gaps, 1] = time_s[later] - time_s[row], late_s[later]
            n_gaps += 1
    return n_gaps


@small
def neighbours(
    order: IntArray, number: IntArray, time_s: FloatArray, new_number: IntArray, new_time_s: FloatArray, own: IntArray
) -> int:
    """Write the rows of the tracks of new reports, in order: of each track the last one before its first new report,
    and all after that; returns how many.

    order : (k,) rows by track and time. number, time_s : (n,) of all rows. new_number, new_time_s : (m,) of the new
    reports, numbers ascending. own : (k,).
    """
    count = k = at = 0
    while k < len(order) and at < len(new_number):
        track = new_number[at]
        if number[order[k]] < track:
            k += 1
            continue
        earliest_s, last = math.inf, -1
        while at < len(new_number) and new_number[at] == track:
            earliest_s = min(earliest_s, new_time_s[at])
            at += 1
        while k < len(order) and number[order[k]] == track:
            row = order[k]
            if time_s[row] < earliest_s:
                last = row
            else:
                if last >= 0:
                    own[count], last = last, -1
                    count += 1
                own[count] = row
                count += 1
            k += 1
        if last >= 0:
            own[count] = last
            count += 1
    return count


#: Columns of the sums of :func:`add_durations`: ends and total durations of false and of real tracks; how many real and
#: how many false ones began with the first scan and later, without those known to be real.
DURATION_SUMS = ("ended false", "ended real", "false", "real", "real first", "real later", "false first", "false later")


@small
def add_durations(
    source: IntArray, began_later: BoolArray, duration_s: FloatArray, ended: BoolArray, is_real: BoolArray,
    p_real: FloatArray, sums: FloatArray,
) -> None:  # fmt: skip
    """Add to ``sums`` (S, 8) of each source :data:`DURATION_SUMS`, of tracks (n,) that are real with ``p_real``.

    Tracks known to be real (``is_real``) would bias the share of the others.
    """
    for k in range(len(source)):
        p, of_source = p_real[k], sums[source[k]]
        if ended[k]:
            of_source[0] += 1.0 - p
            of_source[1] += p
        of_source[2] += (1.0 - p) * duration_s[k]
        of_source[3] += p * duration_s[k]
        if not is_real[k]:
            later = 1 if began_later[k] else 0
            of_source[4 + later] += p
            of_source[6 + later] += 1.0 - p


@small
def find_rows(ascending: IntArray, numbers: IntArray, first: IntArray, size: IntArray) -> int:
    """Write the first row of each number (k,) among ascending ones, and how many rows it has; returns their sum.

    As :func:`sameas.arrays.spans_in`, in a fifth of the time. The ascending ones are not empty, and dense.
    """
    total, low = 0, ascending[0]
    begin = np.zeros(ascending[-1] - low + 2, np.int64)
    for number in ascending:
        begin[number - low + 1] += 1
    for k in range(1, len(begin)):
        begin[k] += begin[k - 1]
    for k in range(len(numbers)):
        place = numbers[k] - low
        first[k] = size[k] = 0
        if 0 <= place < len(begin) - 1:
            first[k], size[k] = begin[place], begin[place + 1] - begin[place]
        total += size[k]
    return total


@small
def list_rows(first: IntArray, size: IntArray, at: IntArray, row: IntArray) -> None:
    """Write the rows first[k] … first[k] + size[k] − 1, and k of each (:func:`sameas.ragged.ranges`)."""
    n = 0
    for k in range(len(first)):
        for place in range(size[k]):
            at[n], row[n] = k, first[k] + place
            n += 1


def places_of(ascending: IntArray, numbers: IntArray) -> IntArray:
    """(k,) positions of numbers among ascending ones, ABSENT for others: :func:`sameas.arrays.places_in`, in a third of
    the time once kernels are compiled."""
    if not runs_compiled(find_places):
        return places_in(ascending, numbers)
    place = np.empty(np.shape(numbers), np.int64)
    find_places(ascending, np.ascontiguousarray(numbers).ravel(), is_dense(ascending, numbers), place.ravel())
    return place


@small
def find_places(ascending: IntArray, numbers: IntArray, dense: bool, place: IntArray) -> None:
    """Write the position of each number (k,) among ascending ones, −1 for others. dense : whether to look them up in a
    table; else they are searched for."""
    n = len(ascending)
    low = ascending[0] if n else 0
    table = np.full(ascending[-1] - low + 1 if dense else 0, -1)
    if dense:
        for k in range(n):
            table[ascending[k] - low] = k
    for k in range(len(numbers)):
        number = numbers[k]
        if dense:
            place[k] = table[number - low] if 0 <= number - low < len(table) else -1
            continue
        first, last = 0, n
        while first < last:
            middle = (first + last) // 2
            if ascending[middle] < number:
                first = middle + 1
            else:
                last = middle
        place[k] = first if first < n and ascending[first] == number else -1
