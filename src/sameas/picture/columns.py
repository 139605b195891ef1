"""Columns: a moment of the picture as tables, one row per object and one row per record.

Numbers are plain arrays, masked arrays where some cells are absent; texts are arrays of str, "" where nothing is said.
Latitudes and longitudes are there where the picture has a plane on the earth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.observations import Observations, records_of
from sameas.picture.moment import TEXTS, Moment
from sameas.picture.numbering import STAGES
from sameas.picture.roll import BoolArray
from sameas.records import IntArray
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.placement import Directions

Columns = dict[str, NDArray[Any]]


def object_columns(moment: Moment) -> Columns:
    """One row per object of the picture.

    time_s, object, stage; x_m, y_m, var_x_m2, cov_xy_m2, var_y_m2, masked where directions do not cross; vx_m_per_s,
    vy_m_per_s, speed_m_per_s, course_deg, masked where nobody knows; n_sources, sources, members ("radar:12 ais:3": the
    rows of the sources' reports), probability, runner_up, p_runner_up, masked while it coasts; label, mmsi, icao,
    callsign, name, mode_a, type; ambiguous: less than 95 % probable.
    """
    known, seen = moment.known, moment.known.seen
    here = seen >= 0
    # The last row of what was found stands for what is not seen, and is masked.
    at = np.where(here, seen, -1)
    velocity = known.state[:, 2:]
    still = ~known.moving
    p_rival = np.append(moment.p_runner_up, 0.0)[at]
    columns: Columns = {
        "time_s": np.full(len(known), moment.now.instant_s),
        "object": known.number,
        "stage": np.array(STAGES, dtype=np.str_)[known.stage] if len(known) else np.empty(0, "U9"),
        **_ellipse(known.state, known.covariance, ~known.placed),
        "vx_m_per_s": _masked(velocity[:, 0], still),
        "vy_m_per_s": _masked(velocity[:, 1], still),
        "speed_m_per_s": _masked(np.hypot(*velocity.T), still),
        "course_deg": _masked(np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1])) % 360.0, still),
        "n_sources": np.append((moment.members >= 0).sum(axis=1), 0)[at],
        **_memberships(moment, at),
        "probability": _masked(np.append(moment.probability, 0.0)[at], ~here),
        "p_runner_up": _masked(p_rival, p_rival <= 0.0),
        **_texts(moment),
        "ambiguous": np.append(moment.ambiguous, False)[at],
    }
    return columns


def record_columns(moment: Moment) -> Columns:
    """One row per record that took part.

    time_s, source, row (of the source's reports), line (of its file), track_id, object; p_object, p_alone, age_s; x_m,
    y_m, var_x_m2, cov_xy_m2, var_y_m2, moved to the instant, masked for directions; bearing_deg, sigma_bearing_deg,
    sensor_x_m, sensor_y_m, masked for positions.
    """
    roll = moment.roll
    sources = np.array([description.name for description in roll.now.descriptions] or [""], dtype=np.str_)
    return {
        "time_s": np.full(len(roll), moment.now.instant_s),
        "source": sources[roll.source] if len(roll) else sources[:0],
        "row": roll.row,
        "line": _lines(moment),
        "track_id": roll.track.astype(np.str_),
        "object": moment.number[moment.object_of_record],
        "p_object": moment.probability[moment.object_of_record],
        "p_alone": moment.p_alone,
        "age_s": moment.now.instant_s - roll.time_s,
        **_ellipse(roll.state, roll.covariance, ~roll.placed),
        **_sights(moment),
    }


def gathered(parts: Sequence[Mapping[str, NDArray[Any]]]) -> Columns:
    """The rows of several moments one after another."""
    if not parts:
        return {}
    return {name: np.ma.concatenate(columns) if any(isinstance(c, np.ma.MaskedArray) for c in columns)
            else np.concatenate(columns)
            for name in parts[0] for columns in [[part[name] for part in parts]]}  # fmt: skip


def with_degrees(columns: Columns, plane: LocalPlane | None) -> Columns:
    """The same with lat_deg and lon_deg before x_m and y_m, where there is a plane on the earth."""
    if plane is None or not columns:
        return columns
    hidden = np.ma.getmaskarray(columns["x_m"])
    place = np.column_stack([np.ma.filled(columns[name], 0.0) for name in ("x_m", "y_m")])
    lat, lon = plane.to_geodetic(place)
    out: Columns = {}
    for name, column in columns.items():
        if name == "x_m":
            out |= {"lat_deg": _masked(lat, hidden), "lon_deg": _masked(lon, hidden)}
        out[name] = column
    return out


def _masked(values: ArrayLike, hidden: BoolArray) -> np.ma.MaskedArray:
    return np.ma.MaskedArray(values, hidden)


def _ellipse(state: NDArray[Any], covariance: NDArray[Any], hidden: BoolArray) -> Columns:
    return {
        "x_m": _masked(state[:, 0], hidden),
        "y_m": _masked(state[:, 1], hidden),
        "var_x_m2": _masked(covariance[:, 0, 0], hidden),
        "cov_xy_m2": _masked(covariance[:, 0, 1], hidden),
        "var_y_m2": _masked(covariance[:, 1, 1], hidden),
    }


def _memberships(moment: Moment, at: IntArray) -> Columns:
    """Whose records an object has, and which; and those of its runner-up."""
    roll = moment.roll
    names = [description.name for description in roll.now.descriptions]
    record = [f"{names[s]}:{row}" for s, row in zip(roll.source.tolist(), roll.row.tolist(), strict=True)]
    source = [names[s] for s in roll.source.tolist()]
    columns = {
        "sources": joined(moment.members, source),
        "members": joined(moment.members, record),
        "runner_up": joined(moment.runner_up, record),
    }
    return {name: np.append(texts, "")[at] for name, texts in columns.items()}


def joined(members: IntArray, words: Sequence[str]) -> NDArray[np.str_]:
    """(n,) the words of the members of each set, with spaces between them."""
    out: list[list[str]] = [[] for _ in range(len(members))]
    at, source = np.nonzero(members >= 0)
    for k, record in zip(at.tolist(), members[at, source].tolist(), strict=True):
        out[k].append(words[record])
    return np.array([" ".join(each) for each in out], dtype=np.str_)


def _texts(moment: Moment) -> Columns:
    rows = [moment.watch.called[number] for number in moment.known.number.tolist()]
    table = np.array(rows, dtype=object).reshape(len(rows), len(TEXTS))
    columns = {name: table[:, k].astype(np.str_) for k, name in enumerate(TEXTS)}
    label = np.full(len(rows), "", dtype=object)
    for name in ("icao", "mmsi", "callsign", "name"):
        label = np.where(columns[name] != "", columns[name], label)
    return {"label": label.astype(np.str_), **columns}


def _lines(moment: Moment) -> np.ma.MaskedArray:
    """(records,) line of each record in its file."""
    roll = moment.roll
    line, hidden = np.zeros(len(roll), np.int64), np.ones(len(roll), bool)
    for s, feed in enumerate(roll.now.feeds):
        here = slice(roll.start[s], roll.start[s + 1])
        if feed.given is not None:
            line[here], hidden[here] = feed.given.line[roll.row[here]], False
    return _masked(line, hidden)


def _sights(moment: Moment) -> Columns:
    """Directions of the records that are none but that, and where they are seen from."""
    roll, n = moment.roll, len(moment.roll)
    bearing, sigma, sensor, hidden = np.zeros(n), np.zeros(n), np.zeros((n, 2)), np.ones(n, bool)
    for s, (feed, source) in enumerate(zip(roll.now.feeds, roll.now.sources, strict=True)):
        if isinstance(source, Observations) and isinstance(feed.reports, Directions):
            here, records = slice(roll.start[s], roll.start[s + 1]), records_of(source)
            bearing[here], sigma[here] = records.features[:, 0], np.sqrt(records.covariance[:, 0])
            sensor[here], hidden[here] = feed.reports.sensor_m[roll.row[here]], False
    return {
        "bearing_deg": _masked(bearing, hidden),
        "sigma_bearing_deg": _masked(sigma, hidden),
        "sensor_x_m": _masked(sensor[:, 0], hidden),
        "sensor_y_m": _masked(sensor[:, 1], hidden),
    }
