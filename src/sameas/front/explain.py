"""Explain a record of an output file, and compare two outputs.

An explanation uses the output alone, since its inputs may have moved. Where the inputs of a match of two catalogues
still exist and are small, or on request, the match is repeated, which adds the terms of the odds and the cost of other
answers.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.errors import InputError, reading
from sameas.report.explain import Asked, Output, source_numbers, texts_of
from sameas.report.prose import Lines, entry, moment
from sameas.representation import count
from sameas.result import probability_text

if TYPE_CHECKING:
    from astropy.table import Table

    from sameas.sky.sky_match import SkyMatch

#: The match is repeated without request up to this number of rows in both catalogues: under a second (chosen).
REPEATED = 100_000
#: Last line of an explanation from the table alone.
ALONE = "From the table alone; match again for the terms of the odds and the cost of other answers."
#: Message on an output that was edited or truncated, followed by the error of its reader.
CHANGED = "is not as sameas wrote it"
#: Tables of a picture's folder.
_TABLES = ("objects", "identities")
#: File of the explanations in a picture's folder.
REASONS = "explanations.json"


def explain(
    output: str | os.PathLike[str],
    id: Any = None,
    *,
    row: int | None = None,
    source: int | str = 1,
    at: float | str | None = None,
    other: Any = None,
    again: bool = False,
    format: str | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> Lines:
    """Why a record was identified as it was, from a file that ``match``, ``many``, ``frame`` or ``picture`` wrote.

    Parameters
    ----------
    output : the table; of a picture its folder.
    id : of the record; for a frame the star, or the number of a measurement; for a picture the number or label of an
        object, or with ``source`` a track, line or row.
    row : instead of ``id``: row of the catalogue, counted from 0; for a frame row of the table.
    source : number or name of the catalogue; for a frame "star" or "measurement"; for a picture the record's source.
    at : for a picture, the time in seconds or as a date. other : for a picture, a second object or track, to ask
        whether and why both are one; a track that is not unique is "SOURCE:TRACK".
    again : whether to repeat the match of two catalogues, for the terms of the odds and the cost of other answers; the
        inputs must be unchanged in place.
    format : of the file, if its extension does not determine it. progress : called with the name of each step.

    Raises
    ------
    InputError : the file has no provenance, or no such record.

    Example: ``print(sameas.explain("identified.fits", 17))``.
    """
    path = Path(output)
    if (id is None) == (row is None):
        raise InputError("explain: give the id of a record, or row=NUMBER")
    record, by_row = str(row if id is None else id), id is None
    progress(f"reading {path}")
    if os.path.isdir(path):  # Path's own raises where a name is too long for a file
        return Lines(tuple(_of_picture(path, record, source, at, None if other is None else str(other))))
    if other is not None:
        raise InputError(f"{path}: is no picture; two records are compared in the folder of a picture only")
    from sameas.io import read_provenance, read_table

    facts = read_provenance(path, format=format)
    with reading(str(path), CHANGED):
        kind = _kind(facts, path)
        number = _side_of_frame(facts, source) if kind == "frame" else _number(facts, source, path)
        small = kind == "match" and int(facts["rows_1"]) + int(facts["rows_2"]) <= REPEATED
    if again and kind != "match":
        raise InputError(f"{path}: only a match of two catalogues is repeated; leave again out")
    if again or small:
        repeated = _repeated(facts, path, Asked(record, number, by_row), again, progress)
        if repeated is not None:
            return repeated
        progress(f"reading {path}")
    table = read_table(path, format=format)
    with reading(str(path), CHANGED):
        return Lines(tuple(_of_table(kind, Output(table, facts), Asked(record, number, by_row))))


def _of_table(kind: str, output: Output, asked: Asked) -> Iterable[str]:
    """The explanation of a record from the table alone."""
    from sameas.report.explain import frame_lines, many_lines, match_lines

    if kind == "match":
        return (*_either(match_lines, output, asked), "", ALONE)
    return many_lines(output, asked) if kind == "many" else frame_lines(output, asked)


def _kind(facts: Mapping[str, Any], path: Path) -> str:
    """The command that made an output: "match", "many" or "frame"."""
    if "ra_column_1" in facts:
        return "match" if "candidates" in facts else "many"
    if "options_match" in facts and "candidates" in facts:
        return "match"
    if "digest" in facts and "frame" in facts:
        return "frame"
    raise InputError(f"{path}: has no provenance; give a table that `sameas match` wrote")


def _number(facts: Mapping[str, Any], source: int | str, path: Path) -> int:
    """The number of a catalogue, from 1."""
    names = {facts[name]: int(name.removeprefix("name_")) for name in facts if name.startswith("name_")}
    number = names.get(str(source), int(source) if str(source).isdecimal() else 0)
    if number not in names.values():
        raise InputError(f"{path}: it has no source {source}; give one of {', '.join(names)}, or its number")
    return number


def _side_of_frame(facts: Mapping[str, Any], source: int | str) -> int:
    """1 for the measurements of a frame, 2 for its stars."""
    sides = {1: 1, "measurement": 1, "1": 1, 2: 2, "star": 2, "2": 2}
    if source not in sides:
        raise InputError(f"{facts['frame']}: source is {source!r}; give measurement or star")
    return sides[source]


def _repeated(
    facts: Mapping[str, Any], path: Path, asked: Asked, again: bool, progress: Callable[[str], None]
) -> Lines | None:
    """The explanation from a repeated match; None where it cannot be repeated and this was not requested."""
    from sameas.front.match import id_of
    from sameas.front.request import Request
    from sameas.report.explain import explanation_lines
    from sameas.sky import crossmatch

    try:
        request = Request.of_facts(facts, str(path))
    except InputError:
        if again or "ra_column_1" not in facts:
            raise
        return None
    first, second = request.catalogue(1), request.catalogue(2)
    match = request.naming_sides(lambda: crossmatch.match(first, second, request.options, progress=progress))
    record, source = asked.text, asked.source
    if asked.by_row:
        record = id_of(match.result.first if source == 1 else match.result.second, None, int(record))
    return Lines(tuple(explanation_lines(match, _explained(match, record, source), source)))


def _explained(match: SkyMatch, record: str, source: int) -> Any:
    try:
        return match.result.explain(record, source=source)
    except InputError as error:
        other = 3 - source
        try:
            match.result.explain(record, source=other)
        except InputError:
            raise error from None
        raise _of_other(record, (match.first if other == 1 else match.second).name, other) from None


def _either(lines: Callable[[Output, Asked], list[str]], output: Output, asked: Asked) -> list[str]:
    """The lines of a record; an error names the other catalogue where the record is in that one."""
    try:
        return lines(output, asked)
    except InputError as error:
        other = asked.of_other
        try:
            lines(output, other)
        except InputError:
            raise error from None
        if asked.by_row or output.facts.get(f"id_column_{other.source}") is None:
            raise
        raise _of_other(asked.text, output.name(other.source), other.source) from None


def _of_other(record: str, name: str, other: int) -> InputError:
    from sameas.errors import naming

    return InputError(f"{record} is a record of {name}", naming(f"give {{source:{other}}}"))


def _of_picture(folder: Path, record: str, source: int | str, at: float | str | None, other: str | None) -> list[str]:
    from sameas.io.sensors.format import picture_time
    from sameas.report.explain_picture import picture_lines

    objects, records = picture_tables(folder)
    with reading(str(folder), CHANGED):
        times = np.asarray(objects["time_s"], np.float64)
        span_s = (float(times.min()), float(times.max())) if len(times) else (0.0, 0.0)
        when = None if at is None else picture_time(at, "at", span_s)
        named, why = None if source in (1, "1") else str(source), _reasons(folder)
        return picture_lines(objects, records, record, named, when, why, other)


def _reasons(folder: Path) -> dict[int, list[tuple[float, str]]]:
    """The explanations in a folder, by number of the object; empty where it has none, as of an earlier version."""
    path = folder / REASONS
    if not path.exists():
        return {}
    content = json.loads(path.read_text("utf-8"))
    return {int(n): [(float(time_s), str(text)) for time_s, text in one] for n, one in content["objects"].items()}


def picture_tables(folder: Path) -> tuple[Table, Table]:
    """The objects and the records of a picture in a folder.

    Raises
    ------
    InputError : they are not there.
    """
    from sameas.io import read_table
    from sameas.partitions.hats import is_hats

    paths = []
    for name in _TABLES:
        there = [folder / f"{name}.{ending}" for ending in ("parquet", "csv") if (folder / f"{name}.{ending}").exists()]
        if not there:
            if is_hats(folder):
                raise InputError(
                    f"{folder}: records of a HATS catalogue are not looked up",
                    "match tables of that part of the sky, and give their output",
                )
            raise InputError(f"{folder}: has no {name}.parquet or {name}.csv; give the folder of a picture")
        paths.append(there[0])
    objects, records = map(read_table, paths)
    return objects, records


# Comparison of two outputs: which records are one object in one of them but not in the other; :func:`compare`.
#
# For what-if studies: other errors, another gate, a sensor excluded. Records that only one output has are counted; in
# pictures they are ignored in the comparison, so that excluding a sensor is not a difference by itself.

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
