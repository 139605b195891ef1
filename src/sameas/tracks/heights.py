"""Heights of reports, converted to one kind: pressure heights and heights above the ellipsoid differ by the weather.

A pressure height is the height at which the standard atmosphere has the measured pressure. It differs from the height
above the ellipsoid by some 8 m per hPa at the ground, 4 % per 10 K of temperature, and the geoid. If aircraft report
both (ADS-B version 2), or sources of both kinds observe the same aircraft, the difference is estimated as a linear
function of height. So is the offset between two sources of one kind, such as a pressure correction in one of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import FloatArray, IntArray, robust_scale
from sameas.gate import ChiSquare
from sameas.gaussian import mahalanobis_sq
from sameas.ragged import flattened
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions, heights_by_elevation
from sameas.tracks.reports import Reports
from sameas.tracks.snapshot import Snapshot
from sameas.tracks.source import Description

PRESSURE, GEOMETRIC = "pressure height", "height above the ellipsoid"

SIGMA_M = 60.0  # 1σ of a height without a stated error
#: 1σ of an unknown vertical speed and of a reported one; growth of its variance with age, so that an aircraft that
#: climbs at 10 m/s may be level after a minute and a half.
CLIMB_M_PER_S, REPORTED_CLIMB_M_PER_S, CLIMB_NOISE_M2_PER_S3 = 8.0, 1.5, 1.0
#: 1σ of the difference between pressure height and height above the ellipsoid if it is not estimated: at the ground,
#: and as a share of the height.
PRESSURE_M, PRESSURE_SHARE = 250.0, 0.04
MAX_GAIN = 3.0 * PRESSURE_SHARE  # heights of different aircraft, taken for pairs, have larger ones
OFFSET_M = 300.0  # 1σ of the offset between two sources of one kind
#: Minimum number of reports with both heights for a line, and minimum span of their heights for its gain.
MIN_REPORTS, MIN_SPAN_M = 20, 2000.0
#: Instants at which sources are compared, pairs at most, completeness of the gate of positions.
INSTANTS, MAX_PAIRS, NEAR = 32, 3000, 0.999
MIN_PAIRS, SHARE = 5, 0.5  # minimum number of pairs for an offset, and share of the records that agree with it
CLEAR = 0.25  # a pair is clear if any other of either record is four times as far apart: one wrong one in 16 is
MIN_M = 5.0  # minimum 1σ of an estimate


@dataclass(frozen=True)
class HeightReports:
    """The heights of a source's reports, all of one kind, (n,) each, NaN where a report has none.

    height_m, sigma_m : height and its 1σ. climb_m_per_s, sigma_climb_m_per_s : vertical speed and its 1σ.
    climb_noise_m2_per_s3 : growth of the variance of vertical speeds with the age of a report.
    kind : PRESSURE or GEOMETRIC. notes : how they were converted to that kind, printable.
    """

    height_m: FloatArray
    sigma_m: FloatArray
    climb_m_per_s: FloatArray
    sigma_climb_m_per_s: FloatArray
    climb_noise_m2_per_s3: float
    kind: str
    notes: tuple[str, ...] = ()

    def at(self, rows: IntArray, age_s: FloatArray) -> FloatArray:
        """(k, 4) heights, their 1σ, vertical speeds and their 1σ of ``rows``, moved forward by ``age_s``; NaN if not
        reported."""
        climb, sigma_climb = self.climb_m_per_s[rows], self.sigma_climb_m_per_s[rows]
        height = self.height_m[rows] + np.nan_to_num(climb) * age_s
        # A plot may be later than the instant, within the exposure of its scan.
        changed = np.hypot(sigma_climb, np.sqrt(self.climb_noise_m2_per_s3 * np.abs(age_s)))
        sigma_now = np.where(np.isfinite(climb), changed, np.nan)
        return np.column_stack([height, np.hypot(self.sigma_m[rows], sigma_climb * age_s), climb, sigma_now])


@dataclass(frozen=True)
class HeightColumns:
    """The heights of one source as reported, (n,) each, NaN where a report has none.

    pressure_m, geometric_m : pressure height, and height above the ellipsoid. sigma_m : 1σ of either.
    climb_m_per_s : vertical speed.
    """

    pressure_m: FloatArray
    geometric_m: FloatArray
    sigma_m: FloatArray
    climb_m_per_s: FloatArray

    @classmethod
    def of(cls, description: Description, reports: Reports) -> HeightColumns | None:
        """The heights of reports with positions; None if no report has a height or a vertical speed."""
        n, absent = len(reports), np.full(len(reports), np.nan)
        pressure = absent if reports.pressure_alt_m is None else reports.pressure_alt_m
        geometric = absent if reports.alt_m is None else reports.alt_m
        if reports.z_m is not None and description.site is None:
            geometric = np.where(np.isfinite(geometric), geometric, reports.z_m)
        stated = absent if reports.sigma_alt_m is None else reports.sigma_alt_m
        sigma = np.where(stated > 0.0, stated, np.full(n, description.errors.height_m or SIGMA_M))
        site_m = 0.0 if description.site is None else description.site.height_m
        measured = heights_by_elevation(reports, description.errors, site_m)
        if measured is not None:
            only = ~np.isfinite(geometric) & ~np.isfinite(pressure) & np.isfinite(measured[0]) & (measured[1] > 0.0)
            geometric, sigma = np.where(only, measured[0], geometric), np.where(only, measured[1], sigma)
        climb = absent if reports.climb_m_per_s is None else reports.climb_m_per_s
        out = cls(pressure, geometric, sigma, climb)
        return out if out.any else None

    @property
    def any(self) -> bool:
        """Whether any report has a height or a vertical speed."""
        return any(np.isfinite(c).any() for c in (self.pressure_m, self.geometric_m, self.climb_m_per_s))

    @property
    def table(self) -> FloatArray:
        """(n, 4) the columns, in their order."""
        return np.column_stack([self.pressure_m, self.geometric_m, self.sigma_m, self.climb_m_per_s])


def _columns_of(feed: Feed) -> HeightColumns | None:
    """The heights of a feed's reports: of its raw reports, or as kept by a live feed; None if it has none."""
    if isinstance(feed.reports, Directions):
        return None
    if feed.heights is not None:
        kept = HeightColumns(*feed.heights.T)
        return kept if kept.any else None
    if feed.raw_reports is None:
        return None
    return HeightColumns.of(feed.description, feed.raw_reports)


@dataclass(frozen=True)
class HeightOffset:
    """A source's heights minus the reference's: ``offset_m`` + ``gain`` × reference height ± ``scatter_m``."""

    offset_m: float
    gain: float
    scatter_m: float
    note: str


@dataclass(frozen=True)
class HeightModel:
    """Conversion of the heights of all sources to one kind, without offsets between the sources.

    kind : PRESSURE or GEOMETRIC. line : relation of the kinds, None if it was not estimated. offsets : by source name.
    """

    kind: str = PRESSURE
    line: _Line | None = None
    offsets: Mapping[str, HeightOffset] = field(default_factory=dict)

    @classmethod
    def of(cls, feeds: Sequence[Feed]) -> HeightModel | None:
        """The model estimated from the reports of these feeds; None if none has a height."""
        columns = [_columns_of(feed) for feed in feeds]
        known = [one for one in columns if one is not None]
        if not known:
            return None
        model = cls(kind_of(known), _line(known))
        raw = [None if one is None else model.of_kind(one) for one in columns]
        counts = [0 if one is None else int(np.isfinite(one.height_m).sum()) for one in raw]
        reference = int(np.argmax(counts))
        against, offsets = raw[reference], {}
        assert against is not None
        for k, (one, feed) in enumerate(zip(raw, feeds, strict=True)):
            if k != reference and one is not None and counts[k]:
                offset = _offset(one, feed, against, feeds[reference])
                if offset is not None:
                    offsets[feed.description.name] = offset
        return replace(model, offsets=offsets)

    @classmethod
    def as_given(cls, feeds: Sequence[Feed]) -> HeightModel | None:
        """The model with the kind of these feeds' heights, without line and offsets; None if none has a height."""
        known = [one for feed in feeds if (one := _columns_of(feed)) is not None]
        return cls(kind_of(known)) if known else None

    def of_kind(self, one: HeightColumns) -> HeightReports:
        """The heights of a source, all of ``kind``, with its offset."""
        line = self.line
        notes: tuple[str, ...] = ()
        own, other = (one.pressure_m, one.geometric_m) if self.kind == PRESSURE else (one.geometric_m, one.pressure_m)
        only_other = ~np.isfinite(own) & np.isfinite(other)
        converted, extra = other, np.hypot(PRESSURE_M, PRESSURE_SHARE * other)
        if line is not None:
            converted = (other - line.offset_m) / (1.0 + line.gain)
            extra = np.full(len(other), line.sigma_m)
            if only_other.any():
                notes = (
                    f"heights above the ellipsoid were made pressure heights: they are {line.offset_m:+.0f} m "
                    f"{100.0 * line.gain:+.1f} % ± {line.sigma_m:.0f} m higher, by {line.count} reports with both",
                )
        height = np.where(only_other, converted, own)
        sigma = np.where(only_other, np.hypot(one.sigma_m, extra), one.sigma_m)
        climb = one.climb_m_per_s
        sigma_climb = np.where(np.isfinite(climb), REPORTED_CLIMB_M_PER_S, CLIMB_M_PER_S)
        sigma = np.where(np.isfinite(height), sigma, np.nan)
        return HeightReports(height, sigma, climb, sigma_climb, CLIMB_NOISE_M2_PER_S3, self.kind, notes)

    def heights(self, source: str, columns: HeightColumns) -> HeightReports:
        """The heights of a source, all of ``kind``, corrected for its offset."""
        heights = self.of_kind(columns)
        offset = self.offsets.get(source)
        if offset is None:
            return heights
        # The scatter of the pairs replaces the larger error of an unknown difference between the kinds.
        sigma = np.minimum(heights.sigma_m, offset.scatter_m)
        corrected = (heights.height_m - offset.offset_m) / (1.0 + offset.gain)
        return replace(heights, height_m=corrected, sigma_m=sigma, notes=(*heights.notes, offset.note))

    def above_ellipsoid(self, height_m: FloatArray, sigma_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) heights above the ellipsoid and their 1σ, from heights of ``kind``.

        Without an estimated relation a pressure height is taken as it is, with the error of an unknown atmosphere.
        """
        if self.kind == GEOMETRIC:
            return height_m, sigma_m
        if self.line is None:
            extra = np.hypot(PRESSURE_M, PRESSURE_SHARE * height_m)
            return height_m, np.hypot(sigma_m, extra)
        height = height_m + self.line.offset_m + self.line.gain * height_m
        return height, np.hypot((1.0 + self.line.gain) * sigma_m, self.line.sigma_m)


def kind_of(columns: Sequence[HeightColumns]) -> str:
    """The kind to which heights are converted: PRESSURE if any source has pressure heights."""
    return PRESSURE if any(np.isfinite(one.pressure_m).any() for one in columns) else GEOMETRIC


def heights_of(feeds: Sequence[Feed], model: HeightModel | None) -> tuple[HeightReports | None, ...]:
    """The heights of every source, all of one kind and without offsets between them; None for a source without any.

    model : the conversion; estimated from these feeds if None.
    """
    model = HeightModel.of(feeds) if model is None else model
    if model is None:
        return (None,) * len(feeds)
    given = ((feed.description.name, _columns_of(feed)) for feed in feeds)
    return tuple(None if columns is None else model.heights(name, columns) for name, columns in given)


@dataclass(frozen=True)
class _Line:
    """Geometric minus pressure height: ``offset_m`` + ``gain`` × pressure height ± ``sigma_m``; ``count`` reports."""

    offset_m: float
    gain: float
    sigma_m: float
    count: int


def _line(known: Sequence[HeightColumns]) -> _Line | None:
    """The line fitted to reports with both heights; None if they are fewer than ``MIN_REPORTS``."""
    pressure, geometric = (
        np.concatenate([getattr(one, name) for one in known]) for name in ("pressure_m", "geometric_m")
    )
    both = np.isfinite(pressure) & np.isfinite(geometric)
    if both.sum() < MIN_REPORTS:
        return None
    x, y = pressure[both], (geometric - pressure)[both]
    offset, gain, sigma = _robust_line(x, y)
    keep = np.abs(y - offset - gain * x) <= 4.0 * max(sigma, MIN_M)
    return _Line(offset, gain, max(sigma, MIN_M), int(keep.sum()))


def _robust_line(x: FloatArray, y: FloatArray) -> tuple[float, float, float]:
    """Offset, gain and scatter (1σ) of y over x without outliers; gain 0 if points are few or the span of x small, or
    if it is none of the atmosphere."""
    keep = np.ones(len(x), bool)
    offset = gain = sigma = 0.0
    for _ in range(5):
        gain = 0.0
        if keep.sum() >= MIN_REPORTS and np.ptp(x[keep]) >= MIN_SPAN_M:
            design = np.column_stack([np.ones(keep.sum()), x[keep]])
            offset, gain = map(float, np.linalg.lstsq(design, y[keep], rcond=None)[0])
        if gain == 0.0 or abs(gain) > MAX_GAIN:
            offset, gain = float(np.median(y[keep])), 0.0
        residual = y - offset - gain * x
        sigma = robust_scale(residual)
        keep = np.abs(residual) <= 4.0 * max(sigma, MIN_M)
    return offset, gain, sigma


def _offset(heights: HeightReports, feed: Feed, against: HeightReports, reference: Feed) -> HeightOffset | None:
    """The offset of a source against another; None if too few pairs agree on one, or if it is not significant."""
    difference, sigma, height, records = _differences(heights, feed, against, reference)
    if records < MIN_PAIRS:
        return None
    width = np.hypot(sigma, MIN_M)
    # The mode of the differences under the prior of the offset.
    density = np.exp(-0.5 * ((difference[:, None] - difference[None, :]) / width[None, :]) ** 2).sum(axis=1)
    best = difference[np.argmax(np.log(density) - 0.5 * (difference / np.hypot(OFFSET_M, sigma)) ** 2)]
    near = np.abs(difference - best) < 3.0 * width
    if near.sum() < max(MIN_PAIRS, SHARE * records):
        return None
    offset, gain, scatter = _robust_line(height[near], difference[near])
    error = max(1.2533 * scatter / np.sqrt(near.sum()), MIN_M)
    if abs(offset) < 2.0 * error and gain == 0.0:
        return None
    note = (
        f"{feed.description.name}: heights {offset:+.0f} ± {error:.0f} m{f' {100.0 * gain:+.1f} %' if gain else ''} "
        f"against {reference.description.name}, subtracted; by {near.sum()} pairs"
    )
    return HeightOffset(offset, gain, max(scatter, MIN_M) + error, note)


def _differences(
    heights: HeightReports, feed: Feed, against: HeightReports, reference: Feed
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """(k,) height differences of pairs near in position, their 1σ, the reference heights, and the number of records.

    Where enough pairs are clear, only these: of gliders in one thermal most pairs are of two of them.
    """
    start = max(feed.reports.time_s.min(), reference.reports.time_s.min())
    stop = min(feed.reports.time_s.max(), reference.reports.time_s.max())
    parts, records = [(np.empty(0),) * 3 + (np.empty(0, bool),)], 0
    for instant_s in np.linspace(start, stop, INSTANTS) if stop >= start else ():
        one, two = Snapshot.of(feed, float(instant_s)), Snapshot.of(reference, float(instant_s))
        if not (len(one.rows) and len(two.rows)):
            continue
        (h, s), (k, t) = (
            table.at(side.feed.reports.rows[side.rows], instant_s - side.time_s)[:, :2].T
            for side, table in ((one, heights), (two, against))
        )
        i, j = _near(one, two, NEAR)
        both = np.isfinite(h[i]) & np.isfinite(k[j])
        i, j = i[both], j[both]
        apart_m = np.hypot(*(one.state[i, :2] - two.state[j, :2]).T)
        is_clear = (apart_m < CLEAR * _next_m(i, apart_m)) & (apart_m < CLEAR * _next_m(j, apart_m))
        parts.append((h[i] - k[j], np.hypot(s[i], t[j]), k[j], is_clear))
        records += min(len(np.unique(i)), len(np.unique(j)))
    difference, sigma, height, clear = (np.concatenate(column)[:MAX_PAIRS] for column in zip(*parts, strict=True))
    if (n_clear := int(clear.sum())) >= MIN_REPORTS:
        return difference[clear], sigma[clear], height[clear], n_clear
    return difference, sigma, height, min(records, len(difference))


def _next_m(record: IntArray, apart_m: FloatArray) -> FloatArray:
    """(k,) of each pair, the distance of the nearest other pair of its record (k,); infinite if there is none."""
    order = np.lexsort([apart_m, record])
    ranked = apart_m[order]
    first = np.diff(record[order], prepend=-1) != 0
    begins = np.flatnonzero(first)[np.cumsum(first) - 1]
    after = np.append(np.where(first[1:], np.inf, ranked[1:]), np.inf)
    out = np.empty(len(record))
    out[order] = np.where(first, after, ranked[begins])
    return out


def _near(one: Snapshot, two: Snapshot, completeness: float) -> tuple[IntArray, IntArray]:
    """Pairs of rows of two snapshots that are near each other in position."""
    limit = ChiSquare(completeness).limit(2)
    radius = np.sqrt(limit * (_median_variance(one) + _median_variance(two)))
    i, j = flattened(cKDTree(two.state[:, :2]).query_ball_point(one.state[:, :2], float(radius)))
    delta = one.state[i, :2] - two.state[j, :2]
    keep = mahalanobis_sq(delta, one.covariance[i, :2, :2] + two.covariance[j, :2, :2]) < limit
    return i[keep], j[keep]


def _median_variance(snapshot: Snapshot) -> float:
    """Median of the sum of the variances of both axes, m²."""
    return float(np.median(np.trace(snapshot.covariance[:, :2, :2], axis1=1, axis2=2)))
