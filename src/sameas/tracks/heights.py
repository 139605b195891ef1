"""Heights of reports, brought to one kind: pressure heights and heights above the ellipsoid differ by the weather.

A pressure height is the height at which the standard atmosphere has the pressure; the true one differs by some 8 m a
hPa at the ground, by 4 % a 10 K of temperature, and by the geoid. Where aircraft send both (ADS-B version 2), or where
sources of both kinds show the same aircraft, the difference is estimated as a line in height. What stays between two
sources of one kind, such as the pressure that one of them corrects for, is estimated too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import FloatArray, IntArray
from sameas.gate import ChiSquare
from sameas.gaussian import mahalanobis_sq
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions, heights_by_elevation
from sameas.tracks.reports import Reports
from sameas.tracks.snapshot import Snapshot


@dataclass(frozen=True)
class HeightTuning:
    """The chosen numbers of heights. Units are in the names.

    sigma_m : 1σ of a height whose error nobody says. climb_m_per_s : 1σ of an unknown vertical speed;
    reported_climb_m_per_s : of a reported one. pressure_m, pressure_share : 1σ by which pressure height and height
    above the ellipsoid differ, at the ground and as a share of the height, where nothing shows it. offset_m : 1σ of the
    offset between two sources of one kind. both_fewest, span_m : reports, and the span of their heights, that establish
    a line.
    instants : at which sources are compared, by so many pairs at most. pairs_fewest : pairs that establish an offset.
    share : the least share of the records that agree with it. near : the gate of positions. least_m : an established
    error is at least this.
    """

    sigma_m: float = 60.0
    climb_m_per_s: float = 8.0
    reported_climb_m_per_s: float = 1.5
    pressure_m: float = 250.0
    pressure_share: float = 0.04
    offset_m: float = 300.0
    both_fewest: int = 20
    span_m: float = 2000.0
    instants: int = 32
    pairs_fewest: int = 5
    share: float = 0.5
    near: float = 0.999
    most_pairs: int = 3000
    least_m: float = 5.0


DEFAULT_TUNING = HeightTuning()
PRESSURE, GEOMETRIC = "pressure height", "height above the ellipsoid"


@dataclass(frozen=True)
class HeightReports:
    """The heights of a source's reports, (n,) each, NaN where a report has none.

    height_m, sigma_m : the height and its 1σ. climb_m_per_s, sigma_climb_m_per_s : vertical speed and its 1σ.
    kind : PRESSURE or GEOMETRIC, of all. notes : how they were brought to that kind, printable.
    """

    height_m: FloatArray
    sigma_m: FloatArray
    climb_m_per_s: FloatArray
    sigma_climb_m_per_s: FloatArray
    kind: str
    notes: tuple[str, ...] = ()

    def at(self, rows: IntArray, age_s: FloatArray) -> FloatArray:
        """(k, 3) heights, their 1σ and reported vertical speeds, moved for ``age_s``; NaN where not reported."""
        climb = self.climb_m_per_s[rows]
        height = self.height_m[rows] + np.nan_to_num(climb) * age_s
        return np.column_stack([height, np.hypot(self.sigma_m[rows], self.sigma_climb_m_per_s[rows] * age_s), climb])


@dataclass(frozen=True)
class _Columns:
    """The heights of one source as it gives them."""

    pressure: FloatArray
    geometric: FloatArray
    sigma_m: FloatArray

    @classmethod
    def of(cls, feed: Feed, tuning: HeightTuning) -> _Columns | None:
        reports = feed.raw_reports
        if reports is None or isinstance(feed.reports, Directions):
            return None
        n, nothing = len(reports), np.full(len(reports), np.nan)
        pressure = nothing if reports.pressure_alt_m is None else reports.pressure_alt_m
        geometric = nothing if reports.alt_m is None else reports.alt_m
        if reports.z_m is not None and feed.description.site is None:
            geometric = np.where(np.isfinite(geometric), geometric, reports.z_m)
        description = feed.description
        stated = nothing if reports.sigma_alt_m is None else reports.sigma_alt_m
        sigma = np.where(stated > 0.0, stated, np.full(n, description.errors.height_m or tuning.sigma_m))
        site_m = 0.0 if description.site is None else description.site.height_m
        measured = heights_by_elevation(reports, description.errors, site_m)
        if measured is not None:
            only = ~np.isfinite(geometric) & ~np.isfinite(pressure) & np.isfinite(measured[0]) & (measured[1] > 0.0)
            geometric, sigma = np.where(only, measured[0], geometric), np.where(only, measured[1], sigma)
        if not (np.isfinite(pressure).any() or np.isfinite(geometric).any()):
            return None
        return cls(pressure, geometric, sigma)


def heights_of(feeds: Sequence[Feed], tuning: HeightTuning = DEFAULT_TUNING) -> tuple[HeightReports | None, ...]:
    """The heights of every source, all of one kind and without offsets between them; None where a source has none."""
    columns = [_Columns.of(feed, tuning) for feed in feeds]
    known = [one for one in columns if one is not None]
    if not known:
        return (None,) * len(feeds)
    kind = PRESSURE if any(np.isfinite(one.pressure).any() for one in known) else GEOMETRIC
    line = _line(known, tuning)
    out = [
        None if one is None else _of_kind(one, kind, line, feed.raw_reports, tuning)
        for one, feed in zip(columns, feeds, strict=True)
    ]
    counts = [0 if one is None else int(np.isfinite(one.height_m).sum()) for one in out]
    reference = int(np.argmax(counts))
    for k in range(len(out)):
        if k != reference and counts[k]:
            out[k] = _without_offset(out[k], feeds[k], out[reference], feeds[reference], tuning)
    return tuple(out)


@dataclass(frozen=True)
class _Line:
    """Geometric less pressure height: ``offset_m`` + ``gain`` × height ± ``sigma_m``, by ``count`` reports."""

    offset_m: float
    gain: float
    sigma_m: float
    count: int


def _line(known: Sequence[_Columns], tuning: HeightTuning) -> _Line | None:
    """The line of reports that have both heights; None where they are too few."""
    pressure, geometric = (np.concatenate([getattr(one, name) for one in known]) for name in ("pressure", "geometric"))
    both = np.isfinite(pressure) & np.isfinite(geometric)
    if both.sum() < tuning.both_fewest:
        return None
    x, y = pressure[both], (geometric - pressure)[both]
    offset, gain, sigma = _robust_line(x, y, tuning)
    keep = np.abs(y - offset - gain * x) <= 4.0 * max(sigma, tuning.least_m)
    return _Line(offset, gain, max(sigma, tuning.least_m), int(keep.sum()))


def _robust_line(x: FloatArray, y: FloatArray, tuning: HeightTuning) -> tuple[float, float, float]:
    """Offset, gain and scatter (1σ) of y over x; the gain is 0 where x hardly varies or the points are few."""
    keep = np.ones(len(x), bool)
    offset = gain = sigma = 0.0
    for _ in range(5):
        if keep.sum() < tuning.both_fewest or np.ptp(x[keep]) < tuning.span_m:
            offset, gain = float(np.median(y[keep])), 0.0
        else:
            design = np.column_stack([np.ones(keep.sum()), x[keep]])
            offset, gain = map(float, np.linalg.lstsq(design, y[keep], rcond=None)[0])
        left = np.abs(y - offset - gain * x)
        sigma = 1.4826 * float(np.median(left))
        keep = left <= 4.0 * max(sigma, tuning.least_m)
    return offset, gain, sigma


def _of_kind(
    one: _Columns, kind: str, line: _Line | None, reports: Reports | None, tuning: HeightTuning
) -> HeightReports:
    """The heights of one source, those of the other kind converted."""
    notes: tuple[str, ...] = ()
    own, other = (one.pressure, one.geometric) if kind == PRESSURE else (one.geometric, one.pressure)
    foreign = ~np.isfinite(own) & np.isfinite(other)
    converted, extra = other, np.hypot(tuning.pressure_m, tuning.pressure_share * other)
    if line is not None:
        converted = (other - line.offset_m) / (1.0 + line.gain)
        extra = np.full(len(other), line.sigma_m)
        if foreign.any():
            notes = (
                f"heights above the ellipsoid were made pressure heights: they are {line.offset_m:+.0f} m "
                f"{100.0 * line.gain:+.1f} % ± {line.sigma_m:.0f} m higher, by {line.count} reports with both",
            )
    height = np.where(foreign, converted, own)
    sigma = np.where(foreign, np.hypot(one.sigma_m, extra), one.sigma_m)
    climb = np.full(len(height), np.nan) if reports is None or reports.climb_m_per_s is None else reports.climb_m_per_s
    sigma_climb = np.where(np.isfinite(climb), tuning.reported_climb_m_per_s, tuning.climb_m_per_s)
    return HeightReports(height, np.where(np.isfinite(height), sigma, np.nan), climb, sigma_climb, kind, notes)


def _without_offset(
    heights: HeightReports | None, feed: Feed, against: HeightReports | None, reference: Feed, tuning: HeightTuning
) -> HeightReports | None:
    """The heights without their offset against those of another source, where aircraft that both show establish it."""
    assert heights is not None and against is not None
    difference, sigma, height, records = _differences(heights, feed, against, reference, tuning)
    if records < tuning.pairs_fewest:
        return heights
    width = np.hypot(sigma, tuning.least_m)
    # Of the offsets that pairs show the one by which most agree, near 0 rather than far.
    agree = np.exp(-0.5 * ((difference[:, None] - difference[None, :]) / width[None, :]) ** 2).sum(axis=1)
    best = difference[np.argmax(np.log(agree) - 0.5 * (difference / np.hypot(tuning.offset_m, sigma)) ** 2)]
    near = np.abs(difference - best) < 3.0 * width
    if near.sum() < max(tuning.pairs_fewest, tuning.share * records):
        return heights
    offset, gain, scatter = _robust_line(height[near], difference[near], tuning)
    error = max(1.2533 * scatter / np.sqrt(near.sum()), tuning.least_m)
    if abs(offset) < 2.0 * error and gain == 0.0:
        return heights
    note = (
        f"{feed.description.name}: heights {offset:+.0f} ± {error:.0f} m{f' {100.0 * gain:+.1f} %' if gain else ''} "
        f"against {reference.description.name}, taken away; by {near.sum()} pairs"
    )
    # Errors that were those of an unknown difference of the kinds are the scatter that the pairs show.
    found = np.minimum(heights.sigma_m, max(scatter, tuning.least_m) + error)
    corrected = (heights.height_m - offset) / (1.0 + gain)
    return replace(heights, height_m=corrected, sigma_m=found, notes=(*heights.notes, note))


def _differences(
    heights: HeightReports, feed: Feed, against: HeightReports, reference: Feed, tuning: HeightTuning
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """(k,) differences of height of records that are near in position, their 1σ, the heights that they are less, and
    of how many records they are."""
    start = max(feed.reports.time_s.min(), reference.reports.time_s.min())
    stop = min(feed.reports.time_s.max(), reference.reports.time_s.max())
    parts, records = [(np.empty(0),) * 3], 0
    for instant_s in np.linspace(start, stop, tuning.instants) if stop >= start else ():
        one, two = Snapshot.of(feed, float(instant_s)), Snapshot.of(reference, float(instant_s))
        if not (len(one.rows) and len(two.rows)):
            continue
        (h, s), (k, t) = (
            table.at(side.feed.reports.rows[side.rows], instant_s - side.time_s)[:, :2].T
            for side, table in ((one, heights), (two, against))
        )
        i, j = _near(one, two, tuning)
        both = np.isfinite(h[i]) & np.isfinite(k[j])
        i, j = i[both], j[both]
        parts.append((h[i] - k[j], np.hypot(s[i], t[j]), k[j]))
        records += min(len(np.unique(i)), len(np.unique(j)))
    difference, sigma, height = (np.concatenate(column)[: tuning.most_pairs] for column in zip(*parts, strict=True))
    return difference, sigma, height, min(records, len(difference))


def _near(one: Snapshot, two: Snapshot, tuning: HeightTuning) -> tuple[IntArray, IntArray]:
    """Rows of two snapshots that are near each other in position."""
    limit = ChiSquare(tuning.near).limit(2)
    widest = np.sqrt(limit * (_usual(one) + _usual(two)))
    near = cKDTree(two.state[:, :2]).query_ball_point(one.state[:, :2], float(widest))
    i = np.repeat(np.arange(len(near)), [len(each) for each in near])
    j = np.concatenate([np.empty(0, np.int64), *(np.asarray(each, np.int64) for each in near)])
    delta = one.state[i, :2] - two.state[j, :2]
    keep = mahalanobis_sq(delta, one.covariance[i, :2, :2] + two.covariance[j, :2, :2]) < limit
    return i[keep], j[keep]


def _usual(snapshot: Snapshot) -> float:
    """The usual sum of the variances of both axes, m²."""
    return float(np.median(np.trace(snapshot.covariance[:, :2, :2], axis1=1, axis2=2)))
