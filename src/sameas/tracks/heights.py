"""Heights of reports, brought to one kind: pressure heights and heights above the ellipsoid differ by the weather.

A pressure height is the height at which the standard atmosphere has the pressure; the true one differs by some 8 m a
hPa at the ground, by 4 % a 10 K of temperature, and by the geoid. Where aircraft send both (ADS-B version 2), or where
sources of both kinds show the same aircraft, the difference is estimated as a line in height. What stays between two
sources of one kind, such as the pressure that one of them corrects for, is estimated too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import FloatArray, IntArray
from sameas.gate import ChiSquare
from sameas.gaussian import mahalanobis_sq
from sameas.ragged import flattened
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions, heights_by_elevation
from sameas.tracks.reports import Reports
from sameas.tracks.snapshot import Snapshot
from sameas.tracks.source import Description


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
class HeightColumns:
    """The heights of one source as it gives them, (n,) each, NaN where a report has none.

    pressure_m, geometric_m : height in the standard atmosphere, and above the ellipsoid. sigma_m : 1σ of either.
    climb_m_per_s : vertical speed.
    """

    pressure_m: FloatArray
    geometric_m: FloatArray
    sigma_m: FloatArray
    climb_m_per_s: FloatArray

    @classmethod
    def of(
        cls, description: Description, reports: Reports, tuning: HeightTuning = DEFAULT_TUNING
    ) -> HeightColumns | None:
        """Those of reports with positions; None where none has a height."""
        n, nothing = len(reports), np.full(len(reports), np.nan)
        pressure = nothing if reports.pressure_alt_m is None else reports.pressure_alt_m
        geometric = nothing if reports.alt_m is None else reports.alt_m
        if reports.z_m is not None and description.site is None:
            geometric = np.where(np.isfinite(geometric), geometric, reports.z_m)
        stated = nothing if reports.sigma_alt_m is None else reports.sigma_alt_m
        sigma = np.where(stated > 0.0, stated, np.full(n, description.errors.height_m or tuning.sigma_m))
        site_m = 0.0 if description.site is None else description.site.height_m
        measured = heights_by_elevation(reports, description.errors, site_m)
        if measured is not None:
            only = ~np.isfinite(geometric) & ~np.isfinite(pressure) & np.isfinite(measured[0]) & (measured[1] > 0.0)
            geometric, sigma = np.where(only, measured[0], geometric), np.where(only, measured[1], sigma)
        climb = nothing if reports.climb_m_per_s is None else reports.climb_m_per_s
        out = cls(pressure, geometric, sigma, climb)
        return out if out.any else None

    @property
    def any(self) -> bool:
        """Whether any report has a height."""
        return bool(np.isfinite(self.pressure_m).any() or np.isfinite(self.geometric_m).any())

    @property
    def table(self) -> FloatArray:
        """(n, 4) the columns, in their order."""
        return np.column_stack([self.pressure_m, self.geometric_m, self.sigma_m, self.climb_m_per_s])


def _columns_of(feed: Feed, tuning: HeightTuning) -> HeightColumns | None:
    """The heights of a feed's reports: of those that the reader gave, or those that a growing feed has kept."""
    if isinstance(feed.reports, Directions):
        return None
    if feed.heights is not None:
        kept = HeightColumns(*feed.heights.T)
        return kept if kept.any else None
    return None if feed.raw_reports is None else HeightColumns.of(feed.description, feed.raw_reports, tuning)


@dataclass(frozen=True)
class HeightOffset:
    """By how much a source's heights are above the reference's: ``offset_m`` + ``gain`` × height; scatter and words."""

    offset_m: float
    gain: float
    scatter_m: float
    note: str


@dataclass(frozen=True)
class HeightModel:
    """How the heights of all sources become heights of one kind, without offsets between the sources.

    kind : PRESSURE or GEOMETRIC. line : between the kinds, None where nothing shows it. offsets : by name of source.
    """

    kind: str = PRESSURE
    line: _Line | None = None
    offsets: Mapping[str, HeightOffset] = field(default_factory=dict)

    @classmethod
    def of(cls, feeds: Sequence[Feed], tuning: HeightTuning = DEFAULT_TUNING) -> HeightModel | None:
        """What the reports of these feeds show; None where none has a height."""
        columns = [_columns_of(feed, tuning) for feed in feeds]
        known = [one for one in columns if one is not None]
        if not known:
            return None
        model = cls(kind_of(known), _line(known, tuning))
        raw = [None if one is None else _of_kind(one, model.kind, model.line, tuning) for one in columns]
        counts = [0 if one is None else int(np.isfinite(one.height_m).sum()) for one in raw]
        reference = int(np.argmax(counts))
        against, offsets = raw[reference], {}
        assert against is not None
        for k, (one, feed) in enumerate(zip(raw, feeds, strict=True)):
            if k != reference and one is not None and counts[k]:
                found = _offset(one, feed, against, feeds[reference], tuning)
                if found is not None:
                    offsets[feed.description.name] = found
        return replace(model, offsets=offsets)

    @classmethod
    def as_given(cls, feeds: Sequence[Feed], tuning: HeightTuning = DEFAULT_TUNING) -> HeightModel | None:
        """Of the kind that these feeds have, line and offsets unknown; None where none has a height."""
        known = [one for feed in feeds if (one := _columns_of(feed, tuning)) is not None]
        return cls(kind_of(known)) if known else None

    def heights(self, source: str, columns: HeightColumns, tuning: HeightTuning = DEFAULT_TUNING) -> HeightReports:
        """The heights of a source, all of the one kind, without its offset."""
        heights = _of_kind(columns, self.kind, self.line, tuning)
        offset = self.offsets.get(source)
        if offset is None:
            return heights
        # Errors that were those of an unknown difference of the kinds are the scatter that the pairs show.
        found = np.minimum(heights.sigma_m, offset.scatter_m)
        corrected = (heights.height_m - offset.offset_m) / (1.0 + offset.gain)
        return replace(heights, height_m=corrected, sigma_m=found, notes=(*heights.notes, offset.note))


def kind_of(columns: Sequence[HeightColumns]) -> str:
    """The kind that heights are brought to: PRESSURE where any source has pressure heights."""
    return PRESSURE if any(np.isfinite(one.pressure_m).any() for one in columns) else GEOMETRIC


def heights_of(
    feeds: Sequence[Feed], model: HeightModel | None = None, tuning: HeightTuning = DEFAULT_TUNING
) -> tuple[HeightReports | None, ...]:
    """The heights of every source, all of one kind and without offsets between them; None where a source has none.

    model : how they become so; what these reports show where not given.
    """
    model = HeightModel.of(feeds, tuning) if model is None else model
    if model is None:
        return (None,) * len(feeds)
    given = ((feed.description.name, _columns_of(feed, tuning)) for feed in feeds)
    return tuple(None if columns is None else model.heights(name, columns, tuning) for name, columns in given)


@dataclass(frozen=True)
class _Line:
    """Geometric less pressure height: ``offset_m`` + ``gain`` × height ± ``sigma_m``, by ``count`` reports."""

    offset_m: float
    gain: float
    sigma_m: float
    count: int


def _line(known: Sequence[HeightColumns], tuning: HeightTuning) -> _Line | None:
    """The line of reports that have both heights; None where they are too few."""
    pressure, geometric = (
        np.concatenate([getattr(one, name) for one in known]) for name in ("pressure_m", "geometric_m")
    )
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


def _of_kind(one: HeightColumns, kind: str, line: _Line | None, tuning: HeightTuning) -> HeightReports:
    """The heights of one source, those of the other kind converted."""
    notes: tuple[str, ...] = ()
    own, other = (one.pressure_m, one.geometric_m) if kind == PRESSURE else (one.geometric_m, one.pressure_m)
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
    climb = one.climb_m_per_s
    sigma_climb = np.where(np.isfinite(climb), tuning.reported_climb_m_per_s, tuning.climb_m_per_s)
    return HeightReports(height, np.where(np.isfinite(height), sigma, np.nan), climb, sigma_climb, kind, notes)


def _offset(
    heights: HeightReports, feed: Feed, against: HeightReports, reference: Feed, tuning: HeightTuning
) -> HeightOffset | None:
    """The offset of a source against another, where aircraft that both show establish one."""
    difference, sigma, height, records = _differences(heights, feed, against, reference, tuning)
    if records < tuning.pairs_fewest:
        return None
    width = np.hypot(sigma, tuning.least_m)
    # Of the offsets that pairs show the one by which most agree, near 0 rather than far.
    agree = np.exp(-0.5 * ((difference[:, None] - difference[None, :]) / width[None, :]) ** 2).sum(axis=1)
    best = difference[np.argmax(np.log(agree) - 0.5 * (difference / np.hypot(tuning.offset_m, sigma)) ** 2)]
    near = np.abs(difference - best) < 3.0 * width
    if near.sum() < max(tuning.pairs_fewest, tuning.share * records):
        return None
    offset, gain, scatter = _robust_line(height[near], difference[near], tuning)
    error = max(1.2533 * scatter / np.sqrt(near.sum()), tuning.least_m)
    if abs(offset) < 2.0 * error and gain == 0.0:
        return None
    note = (
        f"{feed.description.name}: heights {offset:+.0f} ± {error:.0f} m{f' {100.0 * gain:+.1f} %' if gain else ''} "
        f"against {reference.description.name}, subtracted; by {near.sum()} pairs"
    )
    return HeightOffset(offset, gain, max(scatter, tuning.least_m) + error, note)


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
    i, j = flattened(cKDTree(two.state[:, :2]).query_ball_point(one.state[:, :2], float(widest)))
    delta = one.state[i, :2] - two.state[j, :2]
    keep = mahalanobis_sq(delta, one.covariance[i, :2, :2] + two.covariance[j, :2, :2]) < limit
    return i[keep], j[keep]


def _usual(snapshot: Snapshot) -> float:
    """The usual sum of the variances of both axes, m²."""
    return float(np.median(np.trace(snapshot.covariance[:, :2, :2], axis1=1, axis2=2)))
