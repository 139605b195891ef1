"""Tables of a picture at one instant: its records, and its objects.

- :class:`Scan`: all records of an instant, source by source, for the later stages of the picture.
- :class:`ObjectTable`: a number, a state and its covariance for every object; the base of both kinds of pictures.
- :class:`PictureObjects`: the objects of a picture at an instant, with their stages.

:func:`object_states` gives the position and velocity of objects from their records at an instant. Records with
independent errors are weighted by their inverse covariances. Tracks that smooth over the same motion have correlated
errors, whatever their sensors: those of one object (kinds :data:`SMOOTHED`) are first fused by covariance intersection,
which is consistent for any correlation, and then with the others. Directions contribute where they cross.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import (
    ABSENT,
    BoolArray,
    ColumnTable,
    FloatArray,
    IntArray,
    are_among,
    finite_rows,
    over_columns,
    taken,
)
from sameas.evidence.identity import UNSET
from sameas.kernels.kalman import sum_of_records
from sameas.kernels.track_pairs import pair_distances
from sameas.many.fusion import BISECTIONS, OPTIMAL, STEPS
from sameas.many.objects import Objects
from sameas.many.observations import Source, records_of
from sameas.picture.crossings import is_placed
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.ragged import Ragged
from sameas.records import Records
from sameas.tracks.alignment import States, moved
from sameas.tracks.feed import Feed
from sameas.tracks.placement import unnamed
from sameas.tracks.scene import POSITION, Instant

#: Octaves of distance by which the errors of one sensor may differ.
RANGE_BANDS = 4

#: A velocity is unknown if its variance is at least this share of the prior variance of velocities. It is below 1,
#: since correcting a range bias changes an unmeasured velocity by some percent.
UNKNOWN_VELOCITY_SHARE = 0.9


@dataclass(frozen=True)
class Scan:
    """The records of an instant, (n,) each.

    now : the instant.
    start : (S+1,) records of source s are start[s] … start[s+1] − 1.
    source : number of the record's source. row : of the source's reports. table : row among the source's records.
    track : the source's id of the object, "" for none.
    time_s : time of the report. late_s : its 1σ. walk_m2_per_s3, speed_m_per_s : motion noise, and 1σ per axis of the
        velocities of its objects. p_stationary : probability that its object is stationary.
    reported_state, reported_covariance : (n, 4), (n, 4, 4) at that time; NaN for directions.
    state, covariance : the same, moved to the instant.
    placed : whether the record has a position. moving : whether it has a velocity.
    manoeuvre_covariance : (n, 4, 4) part of the covariance that allows for a manoeuvre
        (:mod:`sameas.picture.track_pairs`).
    hull_covariance : (n, 2, 2) that which allows for a plot of any place of a hull (:mod:`sameas.picture.hull_echoes`).
    heights : (n, 4) height and its 1σ, metres, vertical speed and its 1σ, m/s; NaN where a record has none.
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
    p_stationary: FloatArray
    speed_m_per_s: FloatArray
    reported_state: FloatArray
    reported_covariance: FloatArray
    state: FloatArray
    covariance: FloatArray
    placed: BoolArray
    moving: BoolArray
    manoeuvre_covariance: FloatArray
    hull_covariance: FloatArray
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
        placed = finite_rows(columns["state"])
        with np.errstate(invalid="ignore"):
            unknown_variance = UNKNOWN_VELOCITY_SHARE * columns["speed_m_per_s"] ** 2
            moving = placed & (columns["reported_covariance"][:, 2, 2] < unknown_variance)
        manoeuvre_covariance = np.zeros((len(rows.row), 4, 4))
        return cls(
            now=now,
            start=rows.start,
            source=rows.row,
            placed=placed,
            moving=moving,
            manoeuvre_covariance=manoeuvre_covariance,
            hull_covariance=np.zeros((len(rows.row), 2, 2)),
            error_factor=np.ones(len(rows.row)),
            tuning=tuning,
            **columns,
        )

    def reports(self, attribute: str) -> bool:
        """Whether any source reports an attribute of identity."""
        return any(feed.attributes.get(attribute) is not None for feed in self.now.feeds)

    def texts(self, attribute: str) -> NDArray[Any]:
        """(n,) an attribute of identity of the records, "" for none and for values without meaning, such as MMSI 0.

        Transponders that are not set up, and the buoys of fishing nets, send MMSI 0: it names no ship.
        """
        out = np.full(len(self), "", dtype=object)
        unset = {"", *(value.upper() for value in UNSET.get(attribute, ()))}
        for s, feed in enumerate(self.now.feeds):
            column = feed.attributes.get(attribute)
            if column is not None:
                records = slice(self.start[s], self.start[s + 1])
                texts = ["" if value is None else str(value) for value in column[self.row[records]]]
                out[records] = ["" if text.upper() in unset else text for text in texts]
        return out

    def new_since(self, before: Scan | None) -> BoolArray:
        """(n,) whether a record is not in an earlier scan."""
        new = np.ones(len(self), bool)
        names = [] if before is None else [description.name for description in before.now.descriptions]
        for s, description in enumerate(self.now.descriptions):
            if before is not None and description.name in names:
                t = names.index(description.name)
                records = slice(self.start[s], self.start[s + 1])
                new[records] = ~are_among(self.row[records], before.row[before.start[t] : before.start[t + 1]])
        return new

    def with_covariance(self, extra: FloatArray) -> Scan:
        """The scan, and the sources' records in it, with covariances increased by ``extra`` (n, 4, 4)."""
        sources = list(self.now.sources)
        for s, source in enumerate(sources):
            records = slice(self.start[s], self.start[s + 1])
            sources[s] = _with_covariance(source, self.table[records], extra[records])
        now = replace(self.now, sources=tuple(sources))
        return replace(self, now=now, covariance=self.covariance + extra)

    def by_table(self, values: IntArray) -> dict[str, IntArray]:
        """By source name, values (n,) of its records by row of the source's table; ABSENT for rows without a record."""
        out = {}
        for s, description in enumerate(self.now.descriptions):
            records = slice(self.start[s], self.start[s + 1])
            column = out[description.name] = np.full(int(self.table[records].max(initial=-1)) + 1, ABSENT)
            column[self.table[records]] = values[records]
        return out

    def places(self, members: np.ma.MaskedArray) -> IntArray:
        """(n, S) the records of the scan of members that are given as rows of the sources' records, ABSENT for none."""
        rows, absent = np.ma.getdata(members), np.ma.getmaskarray(members)
        out = np.full(rows.shape, ABSENT)
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
    "row": np.empty(0, np.int64), "table": np.empty(0, np.int64), "track": np.empty(0, object), "time_s": np.empty(0),
    "late_s": np.empty(0), "walk_m2_per_s3": np.empty(0), "p_stationary": np.empty(0), "speed_m_per_s": np.empty(0),
    "reported_state": np.empty((0, 4)), "reported_covariance": np.empty((0, 4, 4)), "state": np.empty((0, 4)),
    "covariance": np.empty((0, 4, 4)), "heights": np.empty((0, 4)), "range_band": np.empty(0, np.int64),
}  # fmt: skip


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
        reported_state, reported_covariance = taken(reports.state, row), taken(reports.covariance, row)
        walk = feed.walk_m2_per_s3[row]
        state, covariance = moved(reported_state, reported_covariance, instant_s - time_s, walk, late)
    return {
        "row": row, "table": table, "track": _names(reports.track, row), "time_s": time_s, "late_s": np.full(n, late),
        "walk_m2_per_s3": walk,
        "p_stationary": np.zeros(n) if feed.p_stationary is None else feed.p_stationary[row],
        "speed_m_per_s": np.full(n, description.motion.speed_m_per_s or math.inf),
        "reported_state": reported_state, "reported_covariance": reported_covariance,
        "state": state, "covariance": covariance,
        "heights": np.full((n, 4), np.nan) if heights is None else taken(heights, table),
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
    out = track[row].astype(object)
    out[unnamed(out.tolist())] = ""
    return out


def distances(
    state: FloatArray, covariance: FloatArray, one: IntArray, other: IntArray, column: int = 0
) -> tuple[FloatArray, FloatArray]:
    """(k,), (k,) χ² of the differences of two rows, ``one`` and ``other`` (k,), of states (n, d), and the determinants
    of the sums of their covariances (n, d, d); column : the first of the two columns that are compared."""
    chi_sq, determinant = np.empty((2, len(one)))
    pair_distances(state, covariance, one, other, column, chi_sq, determinant)
    return chi_sq, determinant


def objects_per_m2(now: Instant) -> float:
    """Objects per m² of the plane at the centre of the region."""
    if now.features == POSITION:
        return now.density
    # The density of velocities falls to 1/(2π σ²) at rest.
    variance = math.sqrt(np.linalg.det(now.region.covariance[2:, 2:]))
    return float(now.density * 2.0 * math.pi * variance)


@dataclass(frozen=True)
class ObjectTable(ColumnTable):
    """Objects, (k,) each.

    number : of the object, from 1. state, covariance : (k, 4), (k, 4, 4) of position and velocity in the plane.
    """

    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    state: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 4, 4)))

    def __len__(self) -> int:
        return len(self.number)

    def predicted(self, dt_s: float, walk_m2_per_s3: FloatArray | float) -> Self:
        """The objects with their states predicted by ``dt_s``; walk_m2_per_s3 : of the random walk of velocities."""
        if not len(self):
            return self
        state, covariance = moved(self.state, self.covariance, dt_s, walk_m2_per_s3)
        return self.changed(state=state, covariance=covariance)


TENTATIVE, CONFIRMED, COASTING, ENDED = range(4)
STAGES = ("tentative", "confirmed", "coasting", "ended")


@dataclass(frozen=True)
class PictureObjects(ObjectTable):
    """The objects of the picture at an instant, (k,) each, by ascending number, including those that end there.

    stage : index in :data:`STAGES`.
    placed : whether the position is known.
    moving : whether the velocity is known, reported or from the object's positions.
    detection : (k,) index of the detected object of the instant, ABSENT if not detected.
    """

    stage: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    placed: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    moving: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    detection: IntArray = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def in_picture(self) -> Self:
        """The objects that are shown."""
        return self

    @property
    def detected(self) -> BoolArray:
        """(k,) whether any source detects the object."""
        return np.asarray(self.detection >= 0)

    def numbers(self, n_detections: int) -> IntArray:
        """(n,) the number of each detected object."""
        out = np.zeros(n_detections, np.int64)
        out[self.detection[self.detected]] = self.number[self.detected]
        return out

    def undetected(self, stage: IntArray) -> Self:
        """The objects with these stages (k,), none of them detected; after a long pause their place is not known."""
        placed = self.placed & (np.trace(self.covariance[:, :2, :2], axis1=1, axis2=2) < LOST_M**2)
        return self.changed(stage=stage, placed=placed, detection=np.full(len(self), ABSENT))

    def in_order(self, *others: Self) -> Self:
        """The objects of this table and others, by ascending number."""
        objects = self.stacked(*others)
        if (objects.number[1:] > objects.number[:-1]).all():
            return objects
        return objects.take(np.argsort(objects.number))

    def with_ends(self, ended: Self, dt_s: float, walk_m2_per_s3: FloatArray | float) -> Self:
        """The objects with those of ``dt_s`` before that have ended since, where these are expected."""
        if not len(ended):
            return self
        expected = ended.predicted(dt_s, walk_m2_per_s3)
        return self.in_order(expected.undetected(np.full(len(ended), ENDED)))


#: 1σ of the position of an object that may be anywhere in the plane, metres (chosen).
LOST_M = 1e5
#: Kinds of sources whose named records are tracks smoothed by a filter.
SMOOTHED = ("tracks", "marine radar")
#: 1σ per axis of velocities of objects without a described speed, m/s.
UNKNOWN_SPEED = 1e3


@dataclass(frozen=True)
class ObjectStates:
    """Objects at one instant, (n,) each.

    state, covariance : (n, 4), (n, 4, 4) in the plane; an unreported velocity is 0 ± the described speed.
    placed : whether the position is known, from a position or from crossing directions.
    moving : whether a record has a velocity.
    """

    state: FloatArray
    covariance: FloatArray
    placed: BoolArray
    moving: BoolArray


def object_states(scan: Scan, members: IntArray, identification: Objects | None) -> ObjectStates:
    """The states of the objects ``identification`` of a scan; members : (n, S) their records, ABSENT for none."""
    n = len(members)
    state, covariance, placed, moving = np.empty((n, 4)), np.empty((n, 4, 4)), np.empty(n, bool), np.empty(n, bool)
    kinds = np.array([description.kind in SMOOTHED for description in scan.now.descriptions], dtype=bool)
    smoothed = scan.moving & (scan.track != "") & (kinds[scan.source] if len(scan) else False)
    speed = np.where(np.isfinite(scan.speed_m_per_s), scan.speed_m_per_s, UNKNOWN_SPEED)
    sum_of_records(
        members, scan.state, scan.covariance, scan.placed, scan.moving, smoothed, speed, STEPS, OPTIMAL, BISECTIONS,
        state, covariance, placed, moving,
    )  # fmt: skip
    directed = np.flatnonzero(over_columns(np.logical_or, np.append(~scan.placed, False)[members]))
    if len(directed) and identification is not None:
        # Directions are not linear in the state; the identification's joint density has done their update.
        fused = identification.fused
        state[directed, :2] = fused.state[directed, :2]
        covariance[directed, :2], covariance[directed, 2:, :2] = 0.0, 0.0
        covariance[directed, :2, :2] = fused.covariance[directed, :2, :2]
        placed[directed] |= is_placed(covariance[directed], scan.now.region.covariance)
    return ObjectStates(state, covariance, placed, moving)
