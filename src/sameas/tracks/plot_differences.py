"""Differences between plots of two sources at one time, along and across the line of sight."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions
from sameas.tracks.scans import usual_period_s

#: Plots of two sources are compared if they differ by less than the first, or by this many assumed σ.
FIT_BOX_M, FIT_BOX_SIGMAS = 40.0, 2.5
#: Maximum number of compared scans of two sources; those within this time count as one, since errors are correlated.
FIT_SCANS, FIT_CORRELATION_S = 2000, 10.0


@dataclass(frozen=True)
class PlotDifferences:
    """Pairs of plots of two sources at one time, (m,) each.

    s, t : the sources. i, j : rows of their reports. range_m : r. along_m, across_m : the difference along and across
    the line of sight. placed : whether both have ranges; along_m is 0 otherwise. box_m : half the width of the box.
    weight : of the pair, in independent scans.
    """

    s: IntArray
    t: IntArray
    i: IntArray
    j: IntArray
    range_m: FloatArray
    along_m: FloatArray
    across_m: FloatArray
    placed: NDArray[np.bool_]
    box_m: FloatArray
    weight: FloatArray

    def __len__(self) -> int:
        return len(self.s)


@dataclass(frozen=True)
class MatchedScans:
    """Scans of two sources nearest in time: the sources, the numbers and the rows of the scans, the time, and the
    weight in independent scans."""

    sources: tuple[int, int]
    numbers: tuple[int, int]
    rows: tuple[IntArray, IntArray]
    time_s: float
    weight: float


def matched_scans(feeds: Sequence[Feed]) -> Iterator[MatchedScans]:
    """For any two sources, not both of directions, each scan of that with fewer and the nearest one of the other."""
    scans = [scans_with_rows(feed) for feed in feeds]
    for s, t in combinations(range(len(feeds)), 2):
        if all(isinstance(feeds[k].reports, Directions) for k in (s, t)):
            continue
        fewer, other = (s, t) if len(scans[s][0]) <= len(scans[t][0]) else (t, s)
        times, rows = scans[fewer]
        if len(times) < 2 or not len(scans[other][0]):
            continue
        period, period_other = usual_period_s(times), usual_period_s(scans[other][0])
        step = max(len(times) // FIT_SCANS, 1)
        nearest = nearest_scans(scans[other][0], times)
        gap = np.abs(scans[other][0][nearest] - times)
        weight = min(step * period / FIT_CORRELATION_S, 1.0)
        for k in range(0, len(times), step):
            if gap[k] <= 0.6 * period_other:
                numbers, both = (k, int(nearest[k])), (rows[k], scans[other][1][nearest[k]])
                yield MatchedScans((fewer, other), numbers, both, float(times[k]), weight)


def plot_differences(feeds: Sequence[Feed], logs: FloatArray) -> PlotDifferences:
    """The pairs of plots of any two sources, between scans that are nearest in time.

    logs : (3, S) ln of the errors a, b and e of each source, by which a box is wide enough.
    """
    parts: list[list[Any]] = []
    for match in matched_scans(feeds):
        i, j = (side.ravel() for side in np.meshgrid(*match.rows, indexing="ij"))
        s, t = match.sources
        parts.append([np.full(len(i), s), np.full(len(i), t), i, j, np.full(len(i), match.weight)])
    if not parts:
        none, no_rows = np.empty(0), np.empty(0, np.int64)
        return PlotDifferences(
            s=no_rows, t=no_rows, i=no_rows, j=no_rows, range_m=none, along_m=none, across_m=none,
            placed=np.empty(0, bool), box_m=none, weight=none,
        )  # fmt: skip
    return _compared(feeds, logs, [np.concatenate(column) for column in zip(*parts, strict=True)])


def _compared(feeds: Sequence[Feed], logs: FloatArray, columns: Sequence[NDArray[Any]]) -> PlotDifferences:
    """The pairs with their differences, of those within the box; columns : s, t, i, j and weight."""
    s, t, i, j, weight = columns
    n = len(s)
    position, sensor, bearing = np.full((2, n, 2), np.nan), np.empty((2, n, 2)), np.full((2, n), np.nan)
    for k, feed in enumerate(feeds):
        for side, (which, rows) in enumerate(((s, i), (t, j))):
            of_feed = which == k
            sensor[side, of_feed] = feed.sensor_m[rows[of_feed]]  # type: ignore[index]
            if isinstance(feed.reports, Directions):
                bearing[side, of_feed] = feed.reports.bearing_deg[rows[of_feed]]
            else:
                position[side, of_feed] = feed.reports.state[rows[of_feed], :2]
    has_position = np.isfinite(position[:, :, 0])
    both_positions = has_position.all(axis=0)
    middle = np.where(
        both_positions[:, None],
        0.5 * (position[0] + position[1]),
        np.where(has_position[0][:, None], position[0], position[1]),
    )
    # A direction is compared with a position as seen from the sensor of the direction.
    origin = np.where(has_position[0][:, None], sensor[1], sensor[0])
    from_sensor = middle - origin
    range_m = np.maximum(np.hypot(*from_sensor.T), 1e-9)
    direction = from_sensor / range_m[:, None]
    delta = np.where(both_positions[:, None], position[0] - position[1], 0.0)
    bearing_of_position = np.degrees(np.arctan2(from_sensor[:, 0], from_sensor[:, 1]))
    angles = [np.where(has_position[side], bearing_of_position, bearing[side]) for side in (0, 1)]
    angle = np.radians((angles[0] - angles[1] + 180.0) % 360.0 - 180.0)
    along = np.einsum("nv,nv->n", delta, direction)
    across = np.where(both_positions, delta[:, 0] * direction[:, 1] - delta[:, 1] * direction[:, 0], angle * range_m)
    a, b, e = np.exp(2.0 * logs)
    hull = e[s] + e[t]
    sigma = np.sqrt(np.maximum(a[s] + a[t], range_m**2 * (b[s] + b[t])) + hull)
    box = np.maximum(FIT_BOX_M, FIT_BOX_SIGMAS * sigma)
    kept = np.flatnonzero((np.abs(along) < box) & (np.abs(across) < box) & (range_m > 1.0))
    return PlotDifferences(*(x[kept] for x in (s, t, i, j, range_m, along, across, both_positions, box, weight)))


def scans_with_rows(feed: Feed) -> tuple[FloatArray, list[IntArray]]:
    """The times of the scans, including empty ones, and the rows of the usable reports of each."""
    times, rows = feed.scan_times_s, np.flatnonzero(feed.reports.usable)
    number = np.searchsorted(times, feed.scan_s[rows])
    order = np.argsort(number, kind="stable")
    return times, np.split(rows[order], np.cumsum(np.bincount(number, minlength=len(times)))[:-1])


def nearest_scans(times: FloatArray, at: FloatArray) -> IntArray:
    after = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
    before = after - 1
    if len(times) < 2:
        return np.zeros(len(at), np.int64)
    return np.where(np.abs(times[after] - at) < np.abs(times[before] - at), after, before)
