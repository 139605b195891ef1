"""Two outputs compared: which records the one says are one object, and the other does not; :func:`compare`.

What-ifs end here: other errors, another gate, a sensor left out. Records that one of the two does not have are counted
and left out of the comparison, so that a sensor left out is no difference by itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.errors import InputError, reading
from sameas.front.explain import CHANGED, Lines
from sameas.report.prose import count, entry, moment
from sameas.report.written import source_numbers, texts_of
from sameas.result.explanation import probability_text

if TYPE_CHECKING:
    from astropy.table import Table

#: Differences that are listed (chosen).
LISTED = 20
#: A record: the instant of a picture in seconds (0 for catalogues), its source, and its name there.
Record = tuple[float, str, str]


@dataclass(frozen=True)
class _Objects:
    """What an output says: the number of the object of each record, and the probability of each object."""

    title: str
    of: Mapping[Record, int]
    probability: Mapping[int, float]

    def sets(self, shared: set[Record]) -> dict[Record, frozenset[Record]]:
        """Of every shared record the shared ones that are one object with it, itself among them."""
        members: dict[int, list[Record]] = {}
        for record in shared:
            members.setdefault(self.of[record], []).append(record)
        whole = {number: frozenset(records) for number, records in members.items()}
        return {record: whole[self.of[record]] for record in shared}


def compare(one: str | os.PathLike[str], other: str | os.PathLike[str]) -> Lines:
    """Which identities two outputs give differently; ``print`` it.

    Parameters
    ----------
    one, other : tables that ``match`` or ``many`` wrote, or folders of pictures; of the same catalogues or sensors.

    Raises
    ------
    InputError : outputs of different kinds, or without a record in common; a file that does not say how it was made.

    Example: ``print(sameas.compare("before.fits", "after.fits"))``.
    """
    first, second = (_read(Path(path)) for path in (one, other))
    shared = set(first.of) & set(second.of)
    if not shared:
        raise InputError(
            f"{one} and {other} have no record in common", "give outputs of the same catalogues, or of the same sensors"
        )
    return Lines(tuple(_lines(first, second, shared)))


def _lines(first: _Objects, second: _Objects, shared: set[Record]) -> Iterator[str]:
    sides = [(objects, objects.sets(shared)) for objects in (first, second)]
    pictures = any(time_s for time_s, _, _ in shared)
    yield f"{first.title} against {second.title}"
    yield from entry("records", f"{count(len(shared))} in both" + "".join(
        f"; {count(len(one.of) - len(shared))} only in {one.title}" for one, _ in sides if len(one.of) > len(shared)
    ))  # fmt: skip
    joined = [{records for records in sets.values() if len(records) > 1} for _, sets in sides]
    same = joined[0] & joined[1]
    what = "objects at an instant" if pictures else "objects"
    yield from entry("joined alike", f"{count(len(same))} {what} of two records or more")
    for (one, _), own in zip(sides, joined, strict=True):
        yield from entry("joined otherwise", f"{count(len(own - same))} in {one.title}")
    changed = sorted(record for record in shared if sides[0][1][record] != sides[1][1][record])
    yield from entry("records moved", f"{count(len(changed))} of {count(len(shared))} are of another object")
    listed: set[frozenset[Record]] = set()
    shown = 0
    for record in changed:
        answers = [members[record] for _, members in sides]
        if answers[0] | answers[1] in listed:
            continue
        listed.add(answers[0] | answers[1])
        shown += 1
        if shown <= LISTED:
            yield ""
            yield _called(record) + (f" at {moment(record[0])}" if pictures else "")
            for (one, _), members in zip(sides, answers, strict=True):
                others = sorted(members - {record})
                words = " = ".join(map(_called, others)) if others else "no partner"
                p = one.probability.get(one.of[record])
                yield from entry(one.title[:20], words + ("" if p is None else f", probability {probability_text(p)}"))
    if shown > LISTED:
        yield ""
        yield f"and {count(shown - LISTED)} more"


def _called(record: Record) -> str:
    return f"{record[1]} {record[2]}"


def _read(path: Path) -> _Objects:
    with reading(str(path), CHANGED):
        return _of_picture(path) if path.is_dir() else _of_table(path)


def _of_picture(folder: Path) -> _Objects:
    from sameas.front.explain import picture_tables

    objects, records = picture_tables(folder)
    times = np.asarray(records["time_s"], dtype=np.float64)
    tracks = texts_of(records["track_id"])
    names = np.where(tracks == "", np.char.add("row ", texts_of(records["row"])), tracks)
    keys = zip(times.tolist(), texts_of(records["source"]).tolist(), names.tolist(), strict=True)
    instants = np.unique(times)
    at, n = np.searchsorted(instants, times), int(np.max(records["object"], initial=0)) + 1
    numbers = at * n + np.asarray(records["object"], dtype=np.int64)
    where = np.searchsorted(instants, np.asarray(objects["time_s"], dtype=np.float64))
    p = _numbers(objects["probability"])
    own = (where * n + np.asarray(objects["object"], dtype=np.int64)).tolist()
    known = {number: value for number, value in zip(own, p.tolist(), strict=True) if value == value}
    return _Objects(folder.name or str(folder), dict(zip(keys, numbers.tolist(), strict=True)), known)


def _of_table(path: Path) -> _Objects:
    from sameas.io import read_provenance, read_table

    facts, table = read_provenance(path), read_table(path)
    sources = source_numbers(facts)
    if len(sources) < 2:
        raise InputError(f"{path}: does not say how it was made; give a table that `sameas match` or `many` wrote")
    chosen = np.ones(len(table), bool)
    if "match_flag" in table.colnames:
        chosen = np.ma.filled(np.ma.asarray(table["match_flag"]), 1) == 1
    of: dict[Record, int] = {}
    for k in sources:
        names, there = _names(table, facts, k)
        name = str(facts[f"name_{k}"])
        for row in np.flatnonzero(there & chosen).tolist():
            of[0.0, name, str(names[row])] = row
        # Of a record that is only among candidates that were not chosen nothing is said.
        for row in np.flatnonzero(there & ~chosen).tolist():
            of.setdefault((0.0, name, str(names[row])), len(table) + len(of))
    p = next((table[name] for name in ("p_object", "p_match") if name in table.colnames), None)
    values = np.full(len(table), np.nan) if p is None else _numbers(p)
    if "p_none" in table.colnames:
        values = np.where(np.isnan(values), _numbers(table["p_none"]), values)
    return _Objects(path.name, of, {row: value for row, value in enumerate(values.tolist()) if value == value})


def _names(table: Table, facts: Mapping[str, Any], k: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """What the records of a catalogue are called, and where a row has one."""
    place = [facts.get(f"{role}_column_{k}") for role in ("ra", "dec")]
    if None in place or not set(place) <= set(table.colnames):
        raise InputError(
            f"{facts[f'name_{k}']}: its columns of positions are not in the table; write it with join all1"
        )
    columns = [np.ma.asarray(table[name]) for name in place]
    there = ~np.ma.getmaskarray(columns[0])
    if columns[0].dtype.kind == "f":
        there &= np.isfinite(np.ma.getdata(columns[0]))
    identifier = facts.get(f"id_column_{k}")
    if identifier is not None and identifier in table.colnames:
        return texts_of(table[identifier]), there
    texts = [texts_of(column) for column in columns]
    return np.char.add(np.char.add(texts[0], " "), texts[1]), there


def _numbers(column: Any) -> FloatArray:
    return np.asarray(np.ma.filled(np.ma.asarray(column).astype(np.float64), np.nan))
