"""The explanation of an object or a record of a picture of sensors: why its records are one object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.errors import InputError
from sameas.gaussian import mahalanobis_sq
from sameas.report.explain import cell_value, texts_of
from sameas.report.prose import entry, moment
from sameas.result import probability_text

if TYPE_CHECKING:
    from astropy.table import Table

#: By number of an object, the times from which an explanation of it is valid, ascending, and its text.
Reasons = Mapping[int, Sequence[tuple[float, str]]]


def picture_lines(
    objects: Table, records: Table, record: str, source: str | None, at_s: float | None, why: Reasons, other: str | None
) -> list[str]:
    """One object of a picture by its number or label, or, where ``source`` is named, one of its records by track, line
    or row.

    at_s : time in seconds, of which the nearest instant is used; the last instant of the object if None. other : a
    second object or track, to say whether and why both are one.
    """
    if other is not None:
        return _pair_lines(objects, records, record if source is None else f"{source}:{record}", other, at_s, why)
    if source is not None:
        at, mine, details = _record_of(records, record, source, at_s)
        number = int(records["object"][at])
        head = [f"{mine} is of object {number}, probability {probability_text(float(records['p_object'][at]))}; "
                f"of no other record {probability_text(float(records['p_alone'][at]))}", *details, ""]  # fmt: skip
        return head + _object(objects, records, number, float(records["time_s"][at]), why)
    number, when = _numbered(objects, record, at_s)
    return _object(objects, records, number, when, why)


def _numbered(objects: Table, record: str, at_s: float | None) -> tuple[int, float]:
    """The object of a number or label, and the instant: the nearest to a time, or its last."""
    names = [name for name in ("label", "mmsi", "icao", "callsign", "name") if name in objects.colnames]
    known = texts_of(objects["object"]) == record.strip()
    for name in names:
        known = known if known.any() else np.char.lower(texts_of(objects[name])) == record.strip().lower()
    if not known.any():
        raise InputError(f"the picture has no object {record}; give its number, label, MMSI or name")
    when = _nearest(np.asarray(objects["time_s"])[known], at_s)
    rows = np.flatnonzero(known & (np.asarray(objects["time_s"]) == when))
    return int(objects["object"][rows[0]]), when


def _pair_lines(objects: Table, records: Table, one: str, other: str, at_s: float | None, why: Reasons) -> list[str]:
    """Whether two tracks of a picture are one object, and why: how far apart they are, and when they were one.

    one, other : each the number or label of an object, or a track, "SOURCE:TRACK" where that is not unique.
    at_s : time in seconds, of which the nearest instant with both is used; the last one if None.
    """
    tracks = [_tracks_of(objects, records, name) for name in (one, other)]
    out: list[str] = []
    reasons: dict[str, None] = {}
    for first in tracks[0]:
        for second in tracks[1]:
            if first[0] != second[0]:
                lines, texts = _compared(records, first, second, at_s, why)
                out += [*([""] if out else []), *lines]
                reasons |= dict.fromkeys(texts)
    if not out:
        raise InputError(f"{one} and {other} have no tracks of two sources: those of one source are never one object")
    return [*out, *(line for text in reasons for line in ["", *text.splitlines()])]


def _tracks_of(objects: Table, records: Table, name: str) -> list[tuple[str, str]]:
    """The tracks (source, id) that a name stands for: SOURCE:TRACK, an object with its last records, or a track."""
    sources, track_ids = texts_of(records["source"]), texts_of(records["track_id"])
    pairs = np.unique(np.column_stack([sources, track_ids]), axis=0).tolist()
    exact = [(s, t) for s, t in pairs if name in (f"{s}:{t}", f"{s} {t}")]
    if exact:
        return exact
    try:
        number, _ = _numbered(objects, name, None)
    except InputError:
        found = [(s, t) for s, t in pairs if t == name.strip()]
        if not found:
            raise InputError(f"the picture has no object and no track {name}", "give SOURCE:TRACK") from None
        if len(found) > 1:
            choices = " or ".join(f"{s}:{t}" for s, t in found)
            raise InputError(f"{len(found)} sources have a track {name}", f"give {choices}") from None
        return found
    mine = np.asarray(records["object"]) == number
    mine &= np.asarray(records["time_s"]) == np.max(np.asarray(records["time_s"])[mine], initial=-np.inf)
    return sorted(zip(sources[mine].tolist(), track_ids[mine].tolist(), strict=True))


def _compared(
    records: Table, one: tuple[str, str], other: tuple[str, str], at_s: float | None, why: Reasons
) -> tuple[list[str], list[str]]:
    """The lines on two tracks, and the explanations of their objects that speak of both."""
    sources, tracks = texts_of(records["source"]), texts_of(records["track_id"])
    times, number = np.asarray(records["time_s"], np.float64), np.asarray(records["object"])
    rows = [{times[k]: k for k in np.flatnonzero((sources == s) & (tracks == t)).tolist()} for s, t in (one, other)]
    both = sorted(set(rows[0]) & set(rows[1]))
    names = [f"{source} {track or 'without a track number'}" for source, track in (one, other)]
    if not both:
        return [f"{names[0]} and {names[1]}: at no instant of the picture do both have a report"], []
    when = _nearest(np.array(both), at_s)
    pairs = [(rows[0][t], rows[1][t]) for t in both]
    together = sum(number[a] == number[b] for a, b in pairs)
    at = pairs[both.index(when)]
    is_one = "are one object" if number[at[0]] == number[at[1]] else "are two objects"
    numbers = list(dict.fromkeys(int(number[k]) for k in at))
    lines = [f"{names[0]} and {names[1]} {is_one} ({' and '.join(map(str, numbers))}) at {moment(when)}"]
    lines += entry("together", f"at {together} of the {len(both)} instants with a report of both")
    lines += entry("apart", _separation(records, *at))
    distances = [d for a, b in pairs if (d := _distance(records, a, b)) is not None]
    if len(distances) > 1:
        metres, sigmas = np.median(np.array(distances), axis=0)
        lines += entry("", f"{metres:.0f} m, {sigmas:.1f} σ in the median of {len(distances)} instants")
    texts = ["\n".join(reason) for k in numbers if (reason := _reason(why, k, when))]
    texts = [text for text in texts if all(name in text for name in names)]
    if not texts and not together:
        lines += entry("why", "never a probable pair: no explanation of one names the other")
    return lines, texts


def _distance(records: Table, one: int, other: int) -> tuple[float, float] | None:
    """Metres between two records, and the same in σ of both; None where one is a direction."""
    columns = [[cell_value(records, name, k) for name in ("x_m", "y_m", "var_x_m2", "cov_xy_m2", "var_y_m2")]
               for k in (one, other)]  # fmt: skip
    if any(value is None for row in columns for value in row):
        return None
    a, b = np.array(columns, np.float64)
    step, (xx, xy, yy) = b[:2] - a[:2], a[2:] + b[2:]
    return float(np.hypot(*step)), float(np.sqrt(mahalanobis_sq(step, np.array([[xx, xy], [xy, yy]]))))


def _separation(records: Table, one: int, other: int) -> str:
    """How far apart two records are; in position, and in height where both have one."""
    distance = _distance(records, one, other)
    words = "not known: one is a direction" if distance is None else f"{distance[0]:.0f} m, {distance[1]:.1f} σ"
    if "height_m" in records.colnames:
        heights = [(cell_value(records, "height_m", k), cell_value(records, "sigma_height_m", k)) for k in (one, other)]
        if all(value is not None for row in heights for value in row):
            (a, sigma_a), (b, sigma_b) = ((float(h), float(sigma)) for h, sigma in heights)
            words += f"; in height {abs(a - b):.0f} m, {abs(a - b) / max(np.hypot(sigma_a, sigma_b), 1e-9):.1f} σ"
    return words


def _reason(why: Reasons, number: int, when: float) -> list[str]:
    """The explanation of an object that is valid at a time."""
    valid = [(since, text) for since, text in why.get(number, ()) if since <= when]
    if not valid:
        return []
    since, text = valid[-1]
    return [f"Why, as at {moment(since)}:", *text.splitlines()]


def _record_of(records: Table, record: str, source: str, at_s: float | None) -> tuple[int, str, list[str]]:
    """The row in the table of records, its name, and the lines about it."""
    of_source = texts_of(records["source"]) == source
    if not of_source.any():
        known = ", ".join(sorted(set(texts_of(records["source"]).tolist())))
        raise InputError(f"the picture has no source {source}; it has {known}")
    for column in ("track_id", "line", "row"):
        named = of_source & (texts_of(records[column]) == record.strip())
        if named.any():
            when = _nearest(np.asarray(records["time_s"])[named], at_s)
            at = int(np.flatnonzero(named & (np.asarray(records["time_s"]) == when))[0])
            words = {"track_id": "track", "line": "line", "row": "row"}[column]
            age = float(records["age_s"][at])
            return at, f"{source} {words} {record}", entry("time", f"{moment(when)}; reported {age:.0f} s before")
    raise InputError(f"{source} has no track, line or row {record} in the picture")


def _object(objects: Table, records: Table, number: int, when: float, why: Reasons) -> list[str]:
    rows = (np.asarray(objects["object"]) == number) & (np.asarray(objects["time_s"]) == when)
    row = int(np.flatnonzero(rows)[0])
    label = str(cell_value(objects, "label", row) or "")
    lines = [f"Object {number}{f' ({label})' * bool(label)} at {moment(when)}: {cell_value(objects, 'stage', row)}"]
    if cell_value(objects, "probability", row) is None:
        return [*lines, *entry("records", "none now: its position is predicted from earlier reports")]
    lines += entry("records", str(cell_value(objects, "members", row)))
    lines += entry("probability", probability_text(float(cell_value(objects, "probability", row))))
    if cell_value(objects, "p_runner_up", row) is not None and cell_value(objects, "runner_up", row):
        p = probability_text(float(cell_value(objects, "p_runner_up", row)))
        lines += entry("next best", f"{cell_value(objects, 'runner_up', row)}, probability {p}")
    mine = (np.asarray(records["object"]) == number) & (np.asarray(records["time_s"]) == when)
    for at in np.flatnonzero(mine).tolist():
        track = str(cell_value(records, "track_id", at) or "")
        age = f"{float(records['age_s'][at]):.0f} s old"
        details = f"row {cell_value(records, 'row', at)}{f', track {track}' * bool(track)}, {age}"
        alone = probability_text(float(records["p_alone"][at]))
        lines += entry(f"  {cell_value(records, 'source', at)}", f"{details}; in no other source {alone}")
    words = f"{cell_value(objects, 'members', row)} {cell_value(objects, 'runner_up', row) or ''}".split()
    compared = _rows_of(records, words, when)
    for k, one in enumerate(compared):
        for other in compared[k + 1 :]:
            called = [f"{cell_value(records, 'source', at)} {cell_value(records, 'track_id', at) or ''}".rstrip()
                      for at in (one, other)]  # fmt: skip
            if cell_value(records, "source", one) != cell_value(records, "source", other):
                lines += entry("apart", f"{' and '.join(called)}: {_separation(records, one, other)}")
    reason = _reason(why, number, when)
    return [*lines, *([""] if reason else []), *reason]


def _rows_of(records: Table, words: Sequence[str], when: float) -> list[int]:
    """The rows in the table of the records "source:row" at an instant."""
    now = np.flatnonzero(np.asarray(records["time_s"]) == when).tolist()
    row_of = {f"{cell_value(records, 'source', at)}:{cell_value(records, 'row', at)}": at for at in now}
    return [row_of[word] for word in dict.fromkeys(words) if word in row_of]


def _nearest(times: NDArray[Any], at_s: float | None) -> float:
    return float(times.max() if at_s is None else times[np.argmin(np.abs(times - at_s))])
