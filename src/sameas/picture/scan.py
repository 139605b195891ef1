"""The scan: all records of an instant, source by source, in one table, for the later stages of the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.many.observations import Source, records_of
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.ragged import Ragged
from sameas.records import Records
from sameas.tracks.alignment import States, moved
from sameas.tracks.feed import Feed
from sameas.tracks.scene import POSITION, Instant

#: Octaves of distance by which the errors of one sensor may differ.
RANGE_BANDS = 4


@dataclass(frozen=True)
class Scan:
    """The records of an instant, (n,) each.

    Attributes
    ----------
    now : the instant.
    start : (S+1,) records of source s are start[s] … start[s+1] − 1.
    source : number of the record's source. row : of the source's reports. table : row among the source's records.
    track : the source's id of the object, "" for none.
    time_s : time of the report. late_s : its 1σ. walk_m2_per_s3, speed_m_per_s : motion noise, and 1σ per axis of the
        velocities of its objects.
    reported_state, reported_covariance : (n, 4), (n, 4, 4) at that time; NaN for directions.
    state, covariance : the same, moved to the instant.
    placed : whether the record has a position. moving : whether it has a velocity.
    manoeuvre_covariance : (n, 4, 4) part of the covariance that allows for a manoeuvre
        (:mod:`sameas.picture.track_pairs`).
    heights : (n, 3) height and its 1σ, metres, and vertical speed, m/s; NaN where a record has none.
    range_band : (n,) octave of the distance from the sensor: 0 beyond half the range of its coverage, 1 beyond a
        quarter, … ``RANGE_BANDS`` − 1; 0 without a sensor or a range.
    error_factor : (n,) by which the stated 1σ of positions is multiplied (:mod:`sameas.picture.error_factors`).
    tuning : of the picture.
    """

    now: Instant
    start: IntArray
    source: IntArray
    row: IntArray
    table: IntArray
    track: NDArray[Any]
    time_s: FloatArray
    late_s: FloatArray
    walk_m2_per_s3: FloatArray
    speed_m_per_s: FloatArray
    reported_state: FloatArray
    reported_covariance: FloatArray
    state: FloatArray
    covariance: FloatArray
    placed: BoolArray
    moving: BoolArray
    manoeuvre_covariance: FloatArray
    heights: FloatArray
    range_band: IntArray
    error_factor: FloatArray
    tuning: Tuning = DEFAULT_TUNING

    def __len__(self) -> int:
        return len(self.row)

    @classmethod
    def of(cls, now: Instant, tuning: Tuning = DEFAULT_TUNING) -> Scan:
        """The scan of an instant."""
        parts = [_part(feed, records_of(source).ids, records_of(source).rows, now.instant_s, heights)
                 for feed, source, heights in zip(now.feeds, now.sources, now.heights, strict=True)]  # fmt: skip
        columns = {name: np.concatenate([_EMPTY[name], *(part[name] for part in parts)]) for name in _EMPTY}
        rows = Ragged.of_sizes([len(part["row"]) for part in parts])
        placed = np.isfinite(columns["state"]).all(axis=1)
        with np.errstate(invalid="ignore"):
            unknown_variance = tuning.unknown_velocity_share * columns["speed_m_per_s"] ** 2
            moving = placed & (columns["reported_covariance"][:, 2, 2] < unknown_variance)
        manoeuvre_covariance = np.zeros((len(rows.row), 4, 4))
        return cls(
            now=now,
            start=rows.start,
            source=rows.row,
            placed=placed,
            moving=moving,
            manoeuvre_covariance=manoeuvre_covariance,
            error_factor=np.ones(len(rows.row)),
            tuning=tuning,
            **columns,
        )

    def texts(self, attribute: str) -> NDArray[Any]:
        """(n,) an attribute of identity of the records, "" for none."""
        out = np.full(len(self), "", dtype=object)
        for s, feed in enumerate(self.now.feeds):
            column = feed.attributes.get(attribute)
            if column is not None:
                records = slice(self.start[s], self.start[s + 1])
                out[records] = ["" if value is None else str(value) for value in column[self.row[records]]]
        return out

    def new_since(self, before: Scan | None) -> BoolArray:
        """(n,) whether a record is not in an earlier scan."""
        new = np.ones(len(self), bool)
        names = [] if before is None else [description.name for description in before.now.descriptions]
        for s, description in enumerate(self.now.descriptions):
            if before is not None and description.name in names:
                t = names.index(description.name)
                records = slice(self.start[s], self.start[s + 1])
                new[records] = ~np.isin(self.row[records], before.row[before.start[t] : before.start[t + 1]])
        return new

    def with_covariance(self, extra: FloatArray) -> Scan:
        """The scan, and the sources' records in it, with covariances increased by ``extra`` (n, 4, 4)."""
        sources = list(self.now.sources)
        for s, source in enumerate(sources):
            records = slice(self.start[s], self.start[s + 1])
            sources[s] = _with_covariance(source, self.table[records], extra[records])
        now = replace(self.now, sources=tuple(sources))
        return replace(self, now=now, covariance=self.covariance + extra)

    def places(self, members: np.ma.MaskedArray) -> IntArray:
        """(n, S) the records of the scan of members that are given as rows of the sources' records, −1 for none."""
        rows, absent = np.ma.getdata(members), np.ma.getmaskarray(members)
        out = np.full(rows.shape, -1)
        for s in range(len(self.start) - 1):
            present = np.flatnonzero(~absent[:, s])
            out[present, s] = self.find(s, rows[present, s])
        return out

    def find(self, source: int, table: IntArray) -> IntArray:
        """(k,) the records of the scan of rows of a source's records."""
        start, stop = self.start[source], self.start[source + 1]
        if stop > start and self.table[stop - 1] == stop - start - 1:
            # All rows of the source are in the scan, as at nearly all instants.
            return np.asarray(start + table)
        return np.asarray(start + np.searchsorted(self.table[start:stop], table))


_EMPTY: dict[str, NDArray[Any]] = {
    "row": np.empty(0, np.int64),
    "table": np.empty(0, np.int64),
    "track": np.empty(0, object),
    "time_s": np.empty(0),
    "late_s": np.empty(0),
    "walk_m2_per_s3": np.empty(0),
    "speed_m_per_s": np.empty(0),
    "reported_state": np.empty((0, 4)),
    "reported_covariance": np.empty((0, 4, 4)),
    "state": np.empty((0, 4)),
    "covariance": np.empty((0, 4, 4)),
    "heights": np.empty((0, 3)),
    "range_band": np.empty(0, np.int64),
}


def _part(
    feed: Feed, ids: NDArray[Any], table: IntArray, instant_s: float, heights: FloatArray | None
) -> dict[str, NDArray[Any]]:
    """The columns of one source."""
    reports, description = feed.reports, feed.description
    row = ids[table].astype(np.int64)
    n, time_s = len(row), reports.time_s[row]
    late = description.timing.latency_sigma_s or 0.0
    reported_state, reported_covariance = np.full((n, 4), np.nan), np.full((n, 4, 4), np.nan)
    state, covariance = reported_state, reported_covariance
    walk = np.full(n, description.motion.acceleration_m2_per_s3 or 0.0)
    if isinstance(reports, States):
        reported_state, reported_covariance = reports.state[row], reports.covariance[row]
        walk = feed.walk_m2_per_s3[row]
        state, covariance = moved(reported_state, reported_covariance, instant_s - time_s, walk, late)
    return {
        "row": row, "table": table, "track": _names(reports.track, row), "time_s": time_s, "late_s": np.full(n, late),
        "walk_m2_per_s3": walk,
        "speed_m_per_s": np.full(n, description.motion.speed_m_per_s or math.inf),
        "reported_state": reported_state, "reported_covariance": reported_covariance,
        "state": state, "covariance": covariance,
        "heights": np.full((n, 3), np.nan) if heights is None else heights[table],
        "range_band": _range_bands(feed, row, reported_state[:, :2]),
    }  # fmt: skip


def _range_bands(feed: Feed, row: IntArray, position: FloatArray) -> IntArray:
    """(n,) :attr:`Scan.range_band` of reports at these positions (n, 2)."""
    range_m = feed.description.coverage.range_m
    if feed.sensor_m is None or not range_m:
        return np.zeros(len(row), np.int64)
    share = np.hypot(*(position - feed.sensor_m[row]).T) / range_m
    octave = np.nan_to_num(np.floor(-np.log2(np.clip(share, 0.5**RANGE_BANDS, 1.0))))
    return np.asarray(np.clip(octave, 0, RANGE_BANDS - 1), np.int64)


def _with_covariance(source: Source, table: IntArray, extra: FloatArray) -> Source:
    """A source with the covariances of its records increased by ``extra``; table : their rows, ascending."""
    if not isinstance(source, Records) or not extra.any():
        return source
    d = source.d
    covariance = source.full_covariance() + extra[np.searchsorted(table, source.rows), :d, :d]
    upper = np.triu_indices(d)
    return replace(source, covariance=covariance[:, upper[0], upper[1]])


def _names(track: NDArray[Any] | None, row: IntArray) -> NDArray[Any]:
    """Track ids; "" for reports that the scene only named by their row."""
    if track is None:
        return np.full(len(row), "", dtype=object)
    out = np.empty(len(row), object)
    out[:] = ["" if name[:8] == "unnamed " else name for name in map(str, track[row].tolist())]
    return out


def objects_per_m2(now: Instant) -> float:
    """Objects per m² of the plane at the centre of the region."""
    if now.features == POSITION:
        return now.density
    # The density of velocities falls to 1/(2π σ²) at rest.
    variance = math.sqrt(np.linalg.det(now.region.covariance[2:, 2:]))
    return float(now.density * 2.0 * math.pi * variance)
