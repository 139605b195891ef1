"""Explanations of the records of an output file.

An explanation uses the output alone, since its inputs may have moved. Where the inputs of a match of two catalogues
still exist and are small, or on request, the match is repeated, which adds the terms of the odds and the cost of other
answers.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.errors import InputError, naming, reading
from sameas.report.explain import Asked, Output, explanation_lines, frame_lines, internal_lines, many_lines, match_lines
from sameas.report.prose import Lines

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
    """Why a record was identified as it was, from a file of ``match``, ``many``, ``internal``, ``frame``, ``picture``.

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
    if kind == "match":
        return (*_either(match_lines, output, asked), "", ALONE)
    return {"many": many_lines, "internal": internal_lines, "frame": frame_lines}[kind](output, asked)


def _kind(facts: Mapping[str, Any], path: Path) -> str:
    """The command that made an output: "match", "many", "internal" or "frame"."""
    if "reach_arcsec" in facts:
        return "internal"
    if "ra_column_1" in facts:
        return "match" if "candidates" in facts else "many"
    if "options_match" in facts and "candidates" in facts:
        return "match"
    if "digest" in facts and "frame" in facts:
        return "frame"
    raise InputError(
        f"{path}: has no provenance; give a table that `sameas match`, `many`, `internal` or `frame` wrote"
    )


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
    """The explanations in a folder, by number of the object; empty where it has none."""
    path = folder / REASONS
    if not path.exists():
        return {}
    content = json.loads(path.read_text("utf-8"))
    return {int(n): [(float(time_s), str(text)) for time_s, text in one] for n, one in content["objects"].items()}


def picture_tables(folder: Path) -> tuple[Table, Table]:
    """The objects and the records of a picture in a folder.

    Raises InputError: they are not there.
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
