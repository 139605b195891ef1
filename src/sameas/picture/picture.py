"""A picture over time: its states at a series of instants, as tables and a summary.

    scene = Scene.of([(radar_description, radar), (ais_description, ais)])
    picture = Picture.of(scene, instants(scene.span_s, every_s=10.0))
    picture.objects["object"], picture.records["object"], picture.summary

Use ``scene.registered()`` first to correct the sensors' offsets. For live use see :mod:`sameas.picture.live`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, entries
from sameas.errors import InputError
from sameas.many.observations import Observations, records_of
from sameas.picture.deception import faults_and_deceptions
from sameas.picture.picture_state import Carried, PictureState
from sameas.picture.plot_picture import PlotPicture, nameless
from sameas.picture.rows import Columns, GatheredRows
from sameas.picture.summary import Summary, Tally
from sameas.picture.tables import STAGES
from sameas.picture.texts import TEXTS
from sameas.picture.watch import Watch
from sameas.representation import in_short
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.distress import device_of, distress_calls
from sameas.tracks.placement import Directions
from sameas.tracks.scene import Scene

#: More instants are refused: the unit of the step is most likely wrong.
MAX_INSTANTS = 1_000_000

#: A new rival is explained only if its probability is above the first, a change of probability if it is larger than the
#: second.
EXPLAINED_RIVAL, EXPLAINED_CHANGE = 1e-3, 0.02


def instants(span_s: tuple[float, float], every_s: float) -> FloatArray:
    """(k,) the multiples of ``every_s`` seconds within a span; the end of the span if there are none.

    Example
    -------
    >>> instants((3.0, 31.0), 10.0).tolist()
    [10.0, 20.0, 30.0]
    >>> instants((3.0, 5.0), 10.0).tolist()
    [5.0]
    """
    first, last = span_s
    if not (math.isfinite(first) and math.isfinite(last) and first <= last):
        raise InputError(f"instants: span is {first} to {last}; give the first and the last time in seconds")
    if not 0.0 < every_s < math.inf:
        raise InputError(f"instants: every_s is {every_s}; give seconds above 0")
    low, high = math.ceil(first / every_s), math.floor(last / every_s)
    if high - low >= MAX_INSTANTS:
        raise InputError(f"instants: {high - low + 1} instants from {first:g} to {last:g} s; give a longer every_s")
    return every_s * np.arange(low, high + 1, dtype=np.float64) if high >= low else np.array([last])


def watch_of(scene: Scene) -> Watch | PlotPicture:
    """The initial state for a scene: a :class:`PlotPicture` if no source has ids, else a :class:`Watch`."""
    return PlotPicture() if nameless(scene) else Watch()


def picture_states(
    scene: Scene, instants_s: Iterable[float], watch: Watch | PlotPicture | None = None
) -> Iterator[PictureState[Watch] | PictureState[PlotPicture]]:
    """The states of the picture of a scene at successive instants; watch : the initial state."""
    carried = watch_of(scene) if watch is None else watch
    for instant_s in map(float, instants_s):
        state: PictureState[Watch] | PictureState[PlotPicture] = carried.at(scene, instant_s)
        carried = state.watch
        yield state


@in_short
@dataclass(frozen=True)
class Picture:
    """A picture over time. Make it with :meth:`Picture.of`.

    Attributes
    ----------
    instants_s : (k,) its instants.
    objects : columns of :func:`object_columns`, one row per object and instant. records : columns of
        :func:`record_columns`, one row per record and instant.
    summary : of all instants.
    texts : explanations, by index in ``instants_s`` and number of the object, where records, rivals or p changed.
    plane : of x_m and y_m; None for the user's own.
    watch : the state for later instants.
    """

    instants_s: FloatArray
    objects: Columns = field(repr=False)
    records: Columns = field(repr=False)
    summary: Summary
    texts: Mapping[tuple[int, int], str] = field(repr=False)
    plane: LocalPlane | None
    watch: Watch | PlotPicture = field(repr=False)

    @classmethod
    def of(
        cls,
        scene: Scene,
        instants_s: Sequence[float] | FloatArray,
        *,
        watch: Watch | PlotPicture | None = None,
        biases: Sequence[str] = (),
        progress: Callable[[str], object] | None = None,
    ) -> Picture:
        """The picture of a scene at some instants.

        Parameters
        ----------
        instants_s : ascending; see :func:`instants`.
        watch : evidence, memory and stages, or the final state of an earlier picture; by default that of
            :func:`watch_of`.
        biases : printable lines on the sensors' offsets, for the summary.
        progress : called with a text at each instant.

        Raises
        ------
        InputError : no instants, or not ascending; a source lacks what its evidence needs.

        Example
        -------
        >>> from sameas.tracks.reports import Reports
        >>> from sameas.tracks.source import Description, SensorErrors
        >>> columns = {"time_s": [0.0, 10.0], "x_m": [0.0, 50.0], "y_m": [0.0, 0.0], "track_id": ["7", "7"]}
        >>> radar = Reports.of("radar", "table", columns)
        >>> columns = {"time_s": [0.0, 10.0], "x_m": [3.0, 54.0], "y_m": [1.0, 2.0], "mmsi": ["235000001"] * 2}
        >>> ais = Reports.of("ais", "ais", columns)
        >>> tracker = Description("radar", "tracks", errors=SensorErrors(position_m=5.0))
        >>> picture = Picture.of(Scene.of([(tracker, radar), (Description("ais", "ais"), ais)]), [0.0, 10.0])
        >>> print(picture.objects["object"], picture.objects["members"], picture.objects["label"])
        [1 1] ['radar:0 ais:0' 'radar:1 ais:1'] ['235000001' '235000001']
        """
        times = np.asarray(instants_s, dtype=np.float64)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or np.any(np.diff(times) <= 0):
            raise InputError("picture: give one instant or more, in seconds, each later than the one before")
        objects, records, tallies = GatheredRows(), GatheredRows(), []
        texts: dict[tuple[int, int], str] = {}
        explained: dict[int, tuple[str, str, float]] = {}
        state = None
        for k, state in enumerate(picture_states(scene, times, watch)):
            if progress is not None:
                progress(f"instant {k + 1} of {len(times)}")
            objects.add(object_columns(state))
            records.add(record_columns(state))
            tallies.append(Tally.of(state))
            texts |= {(k, number): str(state.explain(number)) for number in _to_explain(state, explained)}
        assert state is not None
        table, records_table = (with_degrees(rows.taken(), scene.plane) for rows in (objects, records))
        faults = faults_and_deceptions(scene.feeds, records_table, state.scan.tuning)
        calls = distress_calls([feed.raw_reports for feed in scene.feeds if feed.raw_reports is not None])
        calls = tuple(one for one in calls if one.last_s >= times[0] and one.first_s <= times[-1])
        return cls(
            times, table, records_table,
            Summary.of(scene, table, tallies, biases, faults, error_lines(state.watch), calls),
            texts, scene.plane, state.watch,
        )  # fmt: skip

    def reasons(self) -> dict[int, list[tuple[float, str]]]:
        """By number of the object, the explanations in the order of the times from which they are valid."""
        out: dict[int, list[tuple[float, str]]] = {}
        for (k, number), text in sorted(self.texts.items()):
            out.setdefault(number, []).append((float(self.instants_s[k]), text))
        return out


def error_lines(watch: Watch | PlotPicture) -> list[str]:
    """Printable lines on the sources whose errors, misses or clutter, as estimated by a picture, are not as stated."""
    if not isinstance(watch, Watch):
        return []
    descriptions = () if watch.shown is None else watch.shown.now.descriptions
    return watch.memory.tracks.error_factors.lines() + watch.plot_rates.lines(descriptions)


def _to_explain(state: PictureState[Carried], explained: dict[int, tuple[str, str, float]]) -> list[int]:
    """Numbers of the objects with two or more records, or a likely rival, whose tracks, rival or probability changed.

    A plot without a track counts as a change at each scan.
    """
    scan = state.scan
    names = [description.name for description in scan.now.descriptions]
    records = zip(scan.source.tolist(), scan.track.tolist(), scan.row.tolist(), strict=True)
    words = [f"{names[s]}:{track or row}" for s, track, row in records]
    several, out = (state.members >= 0).sum(axis=1) > 1, []
    rivals = np.where(state.p_runner_up[:, None] > EXPLAINED_RIVAL, state.runner_up, ABSENT)
    texts = joined(state.members, words).tolist(), joined(rivals, words).tolist()
    columns = state.number.tolist(), *texts, several.tolist(), state.probability.tolist()
    for number, members, rival, is_joint, p in zip(*columns, strict=True):
        *last, p_last = explained.get(number, ("", "", -1.0))
        changed = last != [members, rival] or abs(p - p_last) > EXPLAINED_CHANGE
        if (is_joint or rival) and changed:
            explained[number] = members, rival, p
            out.append(number)
    return out


def object_columns(state: PictureState[Carried]) -> Columns:
    """The columns of a picture state's objects, one row each.

    time_s, object, stage; x_m, y_m, var_x_m2, cov_xy_m2, var_y_m2, masked if directions do not cross; vx_m_per_s,
    vy_m_per_s of the plane, speed_m_per_s, course_deg, masked if unknown; height_m, sigma_height_m, climb_m_per_s if
    sources report heights, of the kind of ``Scene.heights``; n_sources, sources, members ("radar:12 ais:3": rows of the
    sources' reports), probability, runner_up, p_runner_up, masked while coasting; label, mmsi, icao, callsign, name,
    mode_a, type; ambiguous: whether the probability is below ``AMBIGUOUS_BELOW``.
    """
    objects, detected = state.objects, state.objects.detected
    # ABSENT, the last row, for undetected objects; it is masked.
    at = np.where(detected, objects.detection, ABSENT)
    velocity = objects.state[:, 2:]
    velocity_unknown = ~objects.moving
    p_rival = np.append(state.p_runner_up, 0.0)[at]
    columns: Columns = {
        "time_s": np.full(len(objects), state.now.instant_s),
        "object": objects.number,
        "stage": np.array(STAGES, dtype=np.str_)[objects.stage] if len(objects) else np.empty(0, "U9"),
        **_ellipse(objects.state, objects.covariance, ~objects.placed),
        "vx_m_per_s": _masked(velocity[:, 0], velocity_unknown),
        "vy_m_per_s": _masked(velocity[:, 1], velocity_unknown),
        **_speed_and_course(velocity, velocity_unknown),
        **_fused_heights(state, at),
        "n_sources": np.append((state.members >= 0).sum(axis=1), 0)[at],
        **_memberships(state, at),
        "probability": _masked(np.append(state.probability, 0.0)[at], ~detected),
        "p_runner_up": _masked(p_rival, p_rival <= 0.0),
        **_texts(state),
        "ambiguous": np.append(state.ambiguous, False)[at],
    }
    return columns


def record_columns(state: PictureState[Carried]) -> Columns:
    """The columns of a picture state's records, one row each.

    time_s, source, row (of the source's reports), line (of its file), track_id, object; p_object, p_alone, age_s; x_m,
    y_m, var_x_m2, cov_xy_m2, var_y_m2, moved to the instant, masked for directions; height_m, sigma_height_m if sources
    report heights; bearing_deg, sigma_bearing_deg, sensor_x_m, sensor_y_m, masked for positions.
    """
    scan = state.scan
    sources = np.array([description.name for description in scan.now.descriptions] or [""], dtype=np.str_)
    return {
        "time_s": np.full(len(scan), state.now.instant_s),
        "source": sources[scan.source] if len(scan) else sources[:0],
        "row": scan.row,
        "line": _lines(state),
        "track_id": scan.track.astype(np.str_),
        "object": state.number[state.object_of_record],
        "p_object": state.probability[state.object_of_record],
        "p_alone": state.p_alone,
        "age_s": state.now.instant_s - scan.time_s,
        **_ellipse(scan.state, scan.covariance, ~scan.placed),
        **(_height_columns(scan.heights[:, 0], scan.heights[:, 1]) if _has_heights(state) else {}),
        **_direction_columns(state),
    }


def with_degrees(columns: Columns, plane: LocalPlane | None) -> Columns:
    """The columns with lat_deg and lon_deg before x_m and y_m, if there is a plane on the earth. Speeds and courses are
    then those at the place: away from its origin north is not the plane's, and lengths are shorter in it."""
    if plane is None or not columns:
        return columns
    hidden = np.ma.getmaskarray(columns["x_m"])
    position_m = np.column_stack([np.ma.filled(columns[name], 0.0) for name in ("x_m", "y_m")])
    lat, lon = plane.to_geodetic(position_m)
    out: Columns = {}
    for name, column in columns.items():
        if name == "x_m":
            out |= {"lat_deg": _masked(lat, hidden), "lon_deg": _masked(lon, hidden)}
        out[name] = column
    if "course_deg" in out:
        unknown = np.ma.getmaskarray(out["course_deg"])
        velocity = np.column_stack([np.ma.filled(out[name], 0.0) for name in ("vx_m_per_s", "vy_m_per_s")])
        # A velocity is known where bearings cross nowhere, too: it stays that in the plane.
        there = np.where(hidden[:, None, None], np.eye(2), plane.jacobian(lat, lon))
        out |= _speed_and_course(np.linalg.solve(there, velocity[:, :, None])[:, :, 0], unknown)
    return out


def _speed_and_course(velocity: FloatArray, unknown: BoolArray) -> Columns:
    return {
        "speed_m_per_s": _masked(np.hypot(*velocity.T), unknown),
        "course_deg": _masked(np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1])) % 360.0, unknown),
    }


def _masked(values: ArrayLike, hidden: BoolArray) -> np.ma.MaskedArray:
    # A column of a matrix would keep all of it in memory.
    return np.ma.MaskedArray(np.ascontiguousarray(values), hidden)


def _ellipse(state: NDArray[Any], covariance: NDArray[Any], hidden: BoolArray) -> Columns:
    return {
        "x_m": _masked(state[:, 0], hidden),
        "y_m": _masked(state[:, 1], hidden),
        "var_x_m2": _masked(covariance[:, 0, 0], hidden),
        "cov_xy_m2": _masked(covariance[:, 0, 1], hidden),
        "var_y_m2": _masked(covariance[:, 1, 1], hidden),
    }


def _has_heights(state: PictureState[Carried]) -> bool:
    """Whether any source of the scene reports heights."""
    return any(heights is not None for heights in state.now.heights)


def _height_columns(height: FloatArray, sigma: FloatArray) -> Columns:
    unknown = ~np.isfinite(height)
    return {"height_m": _masked(height, unknown), "sigma_height_m": _masked(sigma, unknown)}


def _fused_heights(state: PictureState[Carried], at: IntArray) -> Columns:
    """The heights of the objects, their 1σ, and vertical speeds: precision-weighted means over their records."""
    if not _has_heights(state):
        return {}
    # The last row is for "no record".
    height, sigma, climb, sigma_climb = np.vstack([state.scan.heights, np.full((1, 4), np.nan)]).T
    members = np.vstack([state.members, np.full((1, state.members.shape[1]), ABSENT)])
    (height, sigma), (climb, _) = (_weighted(*one, members[at]) for one in ((height, sigma), (climb, sigma_climb)))
    return {**_height_columns(height, sigma), "climb_m_per_s": _masked(climb, ~np.isfinite(climb))}


def _weighted(value: FloatArray, sigma: FloatArray, members: IntArray) -> tuple[FloatArray, FloatArray]:
    """(k,), (k,) precision-weighted means over the members (k, S) and their 1σ; NaN where none has a value."""
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = np.where(np.isfinite(value), 1.0 / sigma**2, 0.0)[members]
        total = weight.sum(axis=1)
        return (weight * np.nan_to_num(value)[members]).sum(axis=1) / total, 1.0 / np.sqrt(total)


def _memberships(state: PictureState[Carried], at: IntArray) -> Columns:
    """The columns of the sources and records of objects, and of the records of their runners-up."""
    scan = state.scan
    names = [description.name for description in scan.now.descriptions]
    record = [f"{names[s]}:{row}" for s, row in zip(scan.source.tolist(), scan.row.tolist(), strict=True)]
    source = [names[s] for s in scan.source.tolist()]
    columns = {
        "sources": joined(state.members, source),
        "members": joined(state.members, record),
        "runner_up": joined(state.runner_up, record),
    }
    return {name: np.append(texts, "")[at] for name, texts in columns.items()}


def joined(members: IntArray, words: Sequence[str]) -> NDArray[np.str_]:
    """(n,) the words of the members of each set, joined by spaces."""
    out: list[list[str]] = [[] for _ in range(len(members))]
    for k, record in zip(*(column.tolist() for column in entries(members)), strict=True):
        out[k].append(words[record])
    return np.array([" ".join(each) for each in out], dtype=np.str_)


def _texts(state: PictureState[Carried]) -> Columns:
    rows = [state.watch.texts[number] for number in state.objects.number.tolist()]
    table = np.array(rows, dtype=object).reshape(len(rows), len(TEXTS))
    columns = {name: table[:, k].astype(np.str_) for k, name in enumerate(TEXTS)}
    label = np.array([f"A{code}" if code else "" for code in columns["mode_a"].tolist()], dtype=object)
    for name in ("icao", "mmsi", "callsign", "name"):
        label = np.where(columns[name] != "", columns[name], label)
    devices = [device_of(mmsi) for mmsi in columns["mmsi"].tolist()]
    label = np.array([f"{one} {text}" if one else text for one, text in zip(devices, label, strict=True)], object)
    return {"label": label.astype(np.str_), **columns}


def _lines(state: PictureState[Carried]) -> np.ma.MaskedArray:
    """(records,) the line of each record in its file."""
    scan = state.scan
    line, hidden = np.zeros(len(scan), np.int64), np.ones(len(scan), bool)
    for s, feed in enumerate(scan.now.feeds):
        records = slice(scan.start[s], scan.start[s + 1])
        if feed.raw_reports is not None:
            line[records], hidden[records] = feed.raw_reports.line[scan.row[records]], False
    return _masked(line, hidden)


def _direction_columns(state: PictureState[Carried]) -> Columns:
    """The columns of directions and of the places of their sensors."""
    scan, n = state.scan, len(state.scan)
    bearing, sigma, sensor, hidden = np.zeros(n), np.zeros(n), np.zeros((n, 2)), np.ones(n, bool)
    for s, (feed, source) in enumerate(zip(scan.now.feeds, scan.now.sources, strict=True)):
        if isinstance(source, Observations) and isinstance(feed.reports, Directions):
            own, records = slice(scan.start[s], scan.start[s + 1]), records_of(source)
            bearing[own], sigma[own] = records.features[:, 0], np.sqrt(records.covariance[:, 0])
            sensor[own], hidden[own] = feed.reports.sensor_m[scan.row[own]], False
    return {
        "bearing_deg": _masked(bearing, hidden),
        "sigma_bearing_deg": _masked(sigma, hidden),
        "sensor_x_m": _masked(sensor[:, 0], hidden),
        "sensor_y_m": _masked(sensor[:, 1], hidden),
    }
