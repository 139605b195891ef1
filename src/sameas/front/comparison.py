"""The comparison of two outputs: which records are one object in one of them but not in the other.

For what-if studies: other errors, another gate, a sensor excluded. Records that only one output has are counted; in
pictures they are ignored in the comparison, so that excluding a sensor is not a difference by itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.errors import InputError, reading
from sameas.front.explain import CHANGED, picture_tables
from sameas.report.explain import source_numbers, texts_of
from sameas.report.prose import Lines, entry, moment
from sameas.representation import count
from sameas.result import probability_text

if TYPE_CHECKING:
    from astropy.table import Table

#: Number of differences that are listed (chosen).
LISTED = 20
#: A record: instant in seconds (0 for catalogues), source, and id within the source.
Record = tuple[float, str, str]
#: A record, and its partners in each of two outputs, as text.
_Difference = tuple[str, tuple[str, ...], tuple[str, ...]]


@dataclass(frozen=True)
class ComparedObjects:
    """The content of an output: the object number of each record, and the probability of each object."""

    title: str
    of: Mapping[Record, int]
    probability: Mapping[int, float]

    def sets(self, shared: set[Record], counted: Iterable[Record]) -> dict[Record, frozenset[Record]]:
        """For every shared record, the set of counted records of its object, including itself."""
        members: dict[int, list[Record]] = {}
        for record in counted:
            members.setdefault(self.of[record], []).append(record)
        sets = {number: frozenset(records) for number, records in members.items()}
        return {record: sets[self.of[record]] for record in shared}


def compare(one: str | os.PathLike[str], other: str | os.PathLike[str]) -> Lines:
    """The differences in identity between two outputs; ``print`` the result.

    Parameters
    ----------
    one, other : tables that ``match`` or ``many`` wrote, or folders of pictures; of the same catalogues or sensors.

    Raises
    ------
    InputError : outputs of different kinds, or without a common record; a file without provenance.

    Example: ``print(sameas.compare("before.fits", "after.fits"))``.
    """
    first, second = (_read(Path(path)) for path in (one, other))
    if first.title == second.title:
        first, second = replace(first, title=str(one)), replace(second, title=str(other))
    shared = set(first.of) & set(second.of)
    if not shared:
        names = [sorted({name for _, name, _ in output.of}) for output in (first, second)]
        sources = (
            "" if names[0] == names[1] else f": one is of {', '.join(names[0])}, the other of {', '.join(names[1])}"
        )
        raise InputError(
            f"{one} and {other} have no record in common{sources}",
            "give outputs of the same catalogues, or of the same sensors at the same instants",
        )
    return Lines(tuple(comparison_lines(first, second, shared)))


def comparison_lines(first: ComparedObjects, second: ComparedObjects, shared: set[Record]) -> Iterator[str]:
    """The lines of a comparison: counts, then the differences, at most :data:`LISTED`. shared : records of both."""
    pictures = any(time_s for time_s, _, _ in shared)
    # A table of pairs omits records without partner, so a partner that only one table has is a different answer. In a
    # picture, a record that only one output has at an instant is ignored.
    sources = {name for _, name, _ in shared}
    counted = [shared if pictures else {record for record in one.of if record[1] in sources} for one in (first, second)]
    sides = [(one, one.sets(shared, its)) for one, its in zip((first, second), counted, strict=True)]
    yield f"{first.title} against {second.title}"
    yield from entry("records", f"{count(len(shared))} in both" + "".join(
        f"; {count(len(one.of) - len(shared))} only in {one.title}" for one, _ in sides if len(one.of) > len(shared)
    ))  # fmt: skip
    joined = [{records for records in sets.values() if len(records) > 1} for _, sets in sides]
    same = joined[0] & joined[1]
    what = "objects at an instant" if pictures else "objects"
    yield from entry("identified alike", f"{count(len(same))} {what} of two records or more")
    for (one, _), own in zip(sides, joined, strict=True):
        yield from entry("identified otherwise", f"{count(len(own - same))} in {one.title}")
    changed = sorted(record for record in shared if sides[0][1][record] != sides[1][1][record])
    yield from entry("records moved", f"{count(len(changed))} of {count(len(shared))} are of another object")
    listed: set[frozenset[Record]] = set()
    differences: dict[_Difference, list[Record]] = {}
    for record in changed:
        answers = [members[record] for _, members in sides]
        if answers[0] | answers[1] in listed:
            continue
        listed.add(answers[0] | answers[1])
        others = [tuple(_called(other) for other in sorted(members - {record})) for members in answers]
        # In a picture, a difference that lasts is one, however many instants show it.
        differences.setdefault((_called(record), others[0], others[1]), []).append(record)
    for (name, *others), records in list(differences.items())[:LISTED]:
        yield ""
        yield name + (f" at {_instants(records)}" if pictures else "")
        for (one, _), partners in zip(sides, others, strict=True):
            words = " = ".join(partners) if partners else "no partner"
            p = [p for record in records if (p := one.probability.get(one.of[record])) is not None]
            texts = list(dict.fromkeys(probability_text(value) for value in (min(p), max(p)))) if p else []
            yield from entry(one.title[:20], words + (f", probability {' to '.join(texts)}" if texts else ""))
    if len(differences) > LISTED:
        yield ""
        yield f"and {count(len(differences) - LISTED)} more"


def _instants(records: Sequence[Record]) -> str:
    """The time of a difference, or its first and last ones with their number."""
    if len(records) == 1:
        return moment(records[0][0])
    return f"{len(records)} instants from {moment(records[0][0])} to {moment(records[-1][0])}"


def _called(record: Record) -> str:
    return f"{record[1]} {record[2]}"


def _read(path: Path) -> ComparedObjects:
    with reading(str(path), CHANGED):
        return _objects_of_picture(path) if path.is_dir() else _objects_of_table(path)


def _objects_of_picture(folder: Path) -> ComparedObjects:
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
    return ComparedObjects(folder.name or str(folder), dict(zip(keys, numbers.tolist(), strict=True)), known)


def _objects_of_table(path: Path) -> ComparedObjects:
    from sameas.io import read_provenance, read_table

    facts, table = read_provenance(path), read_table(path)
    sources = source_numbers(facts)
    if len(sources) < 2:
        raise InputError(f"{path}: has no provenance; give a table that `sameas match` or `many` wrote")
    chosen = np.ones(len(table), bool)
    if "match_flag" in table.colnames:
        chosen = np.ma.filled(np.ma.asarray(table["match_flag"]), 1) == 1
    of: dict[Record, int] = {}
    for k in sources:
        names, there = _names(table, facts, k)
        name = str(facts[f"name_{k}"])
        for row in np.flatnonzero(there & chosen).tolist():
            of[0.0, name, str(names[row])] = row
        # A record that is only among the rejected candidates is an object of its own.
        for row in np.flatnonzero(there & ~chosen).tolist():
            of.setdefault((0.0, name, str(names[row])), len(table) + len(of))
    p = next((table[name] for name in ("p_object", "p_match") if name in table.colnames), None)
    values = np.full(len(table), np.nan) if p is None else _numbers(p)
    if "p_none" in table.colnames:
        values = np.where(np.isnan(values), _numbers(table["p_none"]), values)
    return ComparedObjects(path.name, of, {row: value for row, value in enumerate(values.tolist()) if value == value})


def _names(table: Table, facts: Mapping[str, Any], k: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Ids of the records of a catalogue, and which rows have such a record."""
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
    values = np.asarray(np.ma.filled(np.ma.asarray(column).astype(np.float64), np.nan))
    if values.ndim > 1:
        raise InputError(f"{column.name}: {values[0].size} values in every row, where one belongs")
    return values
