"""The explanation of one record, as ``sameas explain`` prints it: from a match, or from an output file alone.

An output of a match of two or several catalogues or of a frame has the answer, its probability, the most probable
alternative, and the competing records. The terms of the odds are not in the tables; :func:`explanation_lines` takes
them from a match, which may be a repeated one. :mod:`sameas.report.explain_picture` has those of a picture.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, IntArray
from sameas.errors import InputError
from sameas.report.prose import WIDTH, entry
from sameas.representation import count, counted
from sameas.result import probability_text

if TYPE_CHECKING:
    from astropy.table import Table

    from sameas.result import Competitor, Explanation
    from sameas.sky.catalogue import Catalogue
    from sameas.sky.sky_match import SkyMatch

#: Number of competing records that are listed (chosen).
LISTED = 8


@dataclass(frozen=True)
class Asked:
    """A record that is asked about.

    text : its id, or its row. source : number of its catalogue, from 1; of a frame 1 for measurements and 2 for stars.
    """

    text: str
    source: int
    by_row: bool = False

    @property
    def of_other(self) -> Asked:
        """The record of this id or row in the other one of two catalogues."""
        return replace(self, source=3 - self.source)


@dataclass(frozen=True)
class Output:
    """A table that a command wrote. facts : its provenance."""

    table: Table
    facts: Mapping[str, Any]

    def name(self, source: int) -> str:
        """The name of a catalogue."""
        return str(self.facts[f"name_{source}"])

    def value(self, column: str, row: int) -> Any:
        """The value of a cell; None where it is masked or the column does not exist."""
        return cell_value(self.table, column, row)

    def has(self, source: int, row: int) -> bool:
        """Whether a row has a record of a catalogue."""
        return self.value(self.facts.get(f"ra_column_{source}") or "", row) is not None

    def called(self, row: int, source: int) -> str:
        """The id of a row's record of a catalogue; its coordinates where the catalogue has no ids."""
        column = self.facts.get(f"id_column_{source}")
        if column is not None:
            return str(self.value(column, row))
        at = self._coordinates(row, source)
        return f"at {' '.join(at)}" if at else "without a position"

    def _coordinates(self, row: int, source: int) -> list[str]:
        """Both coordinates of a record as text; none if one is missing."""
        at = [self.value(self.facts[f"{role}_column_{source}"], row) for role in ("ra", "dec")]
        if None in at:
            return []
        return [one if isinstance(one, str) else f"{one:{sign}.6f}" for one, sign in zip(at, ("", "+"), strict=True)]

    def properties(self, row: int, source: int) -> list[str]:
        """The lines on position and brightness of a row's record of a catalogue."""
        lines = entry("position", ", ".join(self._coordinates(row, source)) or "not known")
        magnitude = self.facts.get(f"magnitude_column_{source}")
        if magnitude is not None and (value := self.value(magnitude, row)) is not None:
            lines += entry("brightness", f"{magnitude} {float(value):.2f}")
        return lines

    def group(self, row: int) -> IntArray:
        """The rows of the same group, including this one; none where the row has no group."""
        if self.value("group_id", row) is None:
            return np.empty(0, np.int64)
        groups = self.table["group_id"]
        same = np.asarray(np.ma.filled(groups, ABSENT)) == self.value("group_id", row)
        return np.flatnonzero(same & ~_absent(groups))

    def rows_of(self, asked: Asked) -> IntArray:
        """The rows with a record of a catalogue.

        Raises InputError: there is no such record, or rows cannot be counted.
        """
        table, facts, name = self.table, self.facts, self.name(asked.source)
        column = facts.get(f"id_column_{asked.source}")
        # Records without a position are in the output, too.
        present = ~_absent(table[column or facts[f"ra_column_{asked.source}"]])
        if column is not None and not asked.by_row:
            rows = np.flatnonzero(present & (texts_of(table[column]) == asked.text.strip()))
            if not len(rows):
                listed = ", ".join(texts_of(table[column])[np.flatnonzero(present)[:3]])
                raise InputError(
                    f"{name} has no record with the id {asked.text} in the output; its first ids are {listed}"
                )
            return rows
        number, position = _whole_number(asked.text, name), self._row_numbers(asked.source, present)
        rows = np.flatnonzero(position == number)
        if not len(rows):
            raise InputError(f"{name} has no row {number} in the output; rows are counted from 0")
        return rows

    def _row_numbers(self, source: int, present: BoolArray) -> IntArray:
        """(n,) the catalogue row of each row of the table, ABSENT for none; refused unless the table has them all."""
        table, facts = self.table, self.facts
        rows, join = facts[f"rows_{source}"], facts.get("join", "")
        leading = {"all1": 1, "1or2": 1, "pairs": 1, "all2": 2}.get(join)
        if source == leading and (len(table) == rows or (join == "1or2" and not present[rows:].any())):
            return np.where(np.arange(len(table)) < rows, np.arange(len(table)), ABSENT)
        positions = [texts_of(table[facts[f"{role}_column_{source}"]]) for role in ("ra", "dec")]
        held = np.flatnonzero(present)
        same = np.ones(len(held), bool)
        same[1:] = np.any([part[held][1:] != part[held][:-1] for part in positions], axis=0)
        number = np.full(len(table), ABSENT)
        number[held] = np.cumsum(same) - 1
        if ("join" in facts and source != leading) or number.max(initial=-1) + 1 != rows:
            raise InputError(
                f"{self.name(source)}: rows cannot be counted, because the output does not hold all its rows in "
                "their order",
                ("give the id instead, or " if facts.get(f"id_column_{source}") else "write it with an id, or ")
                + f"with the join {'all2' if source == 2 else 'all1'}",
            )
        return number


def explanation_lines(match: SkyMatch, explanation: Explanation, source: int) -> list[str]:
    """The explanation of one record: its answer, its competitors, and the cost of other answers."""
    mine, other = (match.first, match.second) if source == 1 else (match.second, match.first)
    head = f"{explanation.source} {explanation.id} (row {explanation.row})"
    if explanation.set_aside:
        return [f"{head} could not be used: {explanation.set_aside}"]
    covered = (match.covered_1 if source == 1 else match.covered_2)[explanation.row]
    properties = [
        *entry("position", _position(mine, explanation.row)),
        *entry("brightness", _brightness(mine, explanation.row)),
    ]
    if explanation.group is None:
        why = "passes the gate" if covered else "passes the gate: it does not cover that place"
        return [f"{head} has no partner: no record of {other.name} {why}", *properties]
    chosen = next(c for c in explanation.competitors if c.chosen)
    who = "has no partner" if chosen.id is None else f"is {other.name} {chosen.id}"
    when = "" if match.epoch_jyr is None else f" at {match.epoch_jyr:.2f}"
    sizes = f"{explanation.records[0]} of {match.first.name} and {explanation.records[1]} of {match.second.name}"
    lines = [
        f"{head} {who}, probability {probability_text(chosen.probability)}",
        *properties,
        *entry("group", f"{explanation.group}: {sizes}; probabilities by {explanation.method}"),
        "",
        f"Answers ({other.name}{when}), and the factor each costs in the group's probability",
    ]
    lines += _repeated_answers(explanation.competitors, other)
    return lines + _next_best(explanation)


def _next_best(explanation: Explanation) -> list[str]:
    if explanation.next_best_cost is None:
        return []
    added, removed = (", ".join(f"{a} = {b}" for a, b in pairs) for pairs in explanation.next_best)
    change = f"without {removed}"
    if added:
        change = f"with {added}" + (f" instead of {removed}" if removed else "")
    words = f"The group's next best answer is {_times(explanation.next_best_cost)} times less probable: {change}."
    return ["", *textwrap.wrap(words, WIDTH, break_long_words=False, break_on_hyphens=False)]


def _repeated_answers(competitors: Sequence[Competitor], other: Catalogue) -> list[str]:
    ids = ["no partner" if c.id is None else str(c.id) for c in competitors]
    wide = max(map(len, ids))
    lines = [
        f"    {'answer':{wide}}{'probability':>13}{'cost factor':>12}{'arcsec':>9}{'east':>9}{'north':>9}"
        f"{'σ':>8}{'mag':>8}{'ln odds':>9}  of which"
    ]
    row_of = {str(name): row for row, name in enumerate(other.ids)}
    for name, c in zip(ids, competitors, strict=True):
        mark = "→" if c.chosen else " "
        line = f"  {mark} {name:{wide}}{probability_text(c.probability):>13}{_times(c.cost):>12}"
        if c.id is not None:
            line += _candidate(c, other, row_of[name])
        lines.append(line.rstrip())
    return lines


def _candidate(c: Competitor, other: Catalogue, row: int) -> str:
    assert c.residual is not None and c.log_odds is not None
    magnitude = np.nan if other.magnitude is None else other.magnitude[row]
    terms = ", ".join(f"{key} {value:+.2f}" for key, value in c.terms.items())
    return (
        f"{np.hypot(*c.residual):9.3f}{c.residual[0]:+9.3f}{c.residual[1]:+9.3f}{c.mahalanobis:8.2f}"
        f"{f'{magnitude:.2f}' if np.isfinite(magnitude) else '':>8}{c.log_odds:+9.2f}  {terms}"
    )


def _times(cost: float) -> str:
    """The factor exp(cost) as text; "best" for a cost of 0."""
    if cost <= 0:
        return "best"
    return f"{np.exp(cost):.3g}" if cost < 14 else f"10^{cost / np.log(10):.0f}"


def _position(catalogue: Catalogue, row: int) -> str:
    at = catalogue.astrometry
    pm = at.pm_ra_mas_per_yr[row], at.pm_dec_mas_per_yr[row]
    epoch = at.epoch_jyr[row]
    words = f"{at.ra_deg[row]:.6f}, {at.dec_deg[row]:+.6f} deg"
    if np.isfinite(epoch):
        words += f" at {epoch:.2f}"
    if catalogue.has_motion and np.isfinite(pm).all():
        words += f", moving {pm[0]:+.1f}, {pm[1]:+.1f} mas/yr"
    return words


def _brightness(catalogue: Catalogue, row: int) -> str:
    if catalogue.magnitude is None or not np.isfinite(catalogue.magnitude[row]):
        return "not known"
    return f"{catalogue.magnitude_name} {catalogue.magnitude[row]:.2f}"


def match_lines(output: Output, asked: Asked) -> list[str]:
    """One record of a match of two catalogues.

    Raises InputError: no such record in the table.
    """
    rows, source = output.rows_of(asked), asked.source
    mine, other = output.name(source), output.name(3 - source)
    best = rows[_first_chosen(output.table, rows)]
    words, is_pair = output.called(best, source), output.value("p_match", best) is not None
    if not is_pair and output.value("p_none", best) is None:
        return [f"{mine} {words} could not be used", *output.properties(best, source)]
    who = f"is {other} {output.called(best, 3 - source)}" if is_pair else "has no partner"
    p = probability_text(float(output.value("p_match" if is_pair else "p_none", best)))
    lines = [f"{mine} {words} {who}, probability {p}", *output.properties(best, source)]
    if not is_pair and not output.value("n_within", best):
        covered = bool(output.value("covered", best))
        return [*lines, *entry("candidates", "none" if covered else f"none: {other} does not cover that place")]
    lines += entry("candidates", f"{count(output.value('n_within', best))} within the gate")
    lines += ["", f"Answers ({other})", *_answers(output, rows, best, source)]
    return [*lines, *_competing([_pair(output, int(row)) for row in output.group(best) if row not in rows])]


def _answers(output: Output, rows: IntArray, best: int, source: int) -> list[str]:
    """The candidates that the table names, and "no partner"."""
    answers: dict[str, tuple[float, str]] = {}
    for row in rows.tolist():
        if (p_match := output.value("p_match", row)) is not None:
            east, north = (output.value(name, row) for name in ("dx_arcsec", "dy_arcsec"))
            details = f"{output.value('sep_arcsec', row):.3f} arcsec ({east:+.3f} east, {north:+.3f} north), "
            details += f"{output.value('mahalanobis', row):.2f} σ, ln odds {output.value('log_odds', row):+.2f}"
            answers[output.called(row, 3 - source)] = float(p_match), details
    # p_none and id_second of a row refer to the first catalogue, unless the row has no record of it.
    if source == (1 if output.has(1, best) else 2):
        second, alone = output.value("id_second", best), output.value("p_none", best)
        if second is not None and output.facts.get("join") != "pairs":  # which has all candidates
            name = str(second) if output.facts.get(f"id_column_{3 - source}") else f"row {second}"
            answers.setdefault(name, (float(output.value("p_second", best)), "the most probable other candidate"))
        if alone is not None:
            answers["no partner"] = float(alone), ""
    wide = max(map(len, answers))
    order = sorted(answers.items(), key=lambda answer: -answer[1][0])
    return [f"    {name:{wide}}  {probability_text(p):>10}  {details}".rstrip() for name, (p, details) in order]


def many_lines(output: Output, asked: Asked) -> list[str]:
    """One record of several catalogues, and its object."""
    row, source = int(output.rows_of(asked)[0]), asked.source
    sources = source_numbers(output.facts)

    def members(at: int) -> list[str]:
        return [f"{output.name(k)} {output.called(at, k)}" for k in sources if output.has(k, at)]

    mine, probability = f"{output.name(source)} {output.called(row, source)}", output.value("p_object", row)
    if probability is None:
        return [f"{mine} could not be used", *output.properties(row, source)]
    others = [name for name in members(row) if name != mine]
    who = f"is {' = '.join(others)}" if others else "has no partner in any catalogue"
    p = probability_text(float(probability))
    lines = [f"{mine} {who}, probability {p}", *output.properties(row, source)]
    if (chi_sq := output.value("chi_sq", row)) is not None:
        free = 2 * (len(members(row)) - 1)
        lines += entry("residuals", f"χ² {chi_sq:.2f} of {free} degrees of freedom, by the quoted errors")
    if (second := output.value("runner_up", row)) is not None:
        p = probability_text(float(output.value("p_runner_up", row)))
        lines += entry("next best", f"{second}, probability {p}")
    rivals = [int(other) for other in output.group(row) if other != row]
    texts = [probability_text(float(output.value("p_object", other))) for other in rivals]
    details = [f"{' = '.join(members(k))}, probability {p}" for k, p in zip(rivals, texts, strict=True)]
    return lines + _competing(details)


def internal_lines(output: Output, asked: Asked) -> list[str]:
    """One row of an internal match, with the other rows of its object; of a table of objects one object.

    Raises InputError: no such row or object in the table.
    """
    table = output.table
    if "object_rank" not in table.colnames:
        rows = np.flatnonzero(texts_of(table["object_id"]) == asked.text.strip())
        if asked.by_row or not len(rows):
            raise InputError(
                f"{output.name(1)} has no object {asked.text} in the output; its objects are numbered from 1"
            )
        return _object_lines(output, int(rows[0]), "")
    row = int(output.rows_of(asked)[0])
    mine, number = f"{output.name(1)} {output.called(row, 1)}", output.value("object_id", row)
    if number is None:
        return [f"{mine} could not be used", *output.properties(row, 1)]
    lines = [*_object_lines(output, row, f"{mine} is of "), *output.properties(row, 1), "", f"Rows of object {number}"]
    ids = np.ma.filled(table["object_id"], ABSENT)
    rows = np.flatnonzero((np.asarray(ids) == number) & ~_absent(table["object_id"]))
    names = [output.called(int(one), 1) for one in rows]
    for one, name in zip(rows.tolist(), names, strict=True):
        mark, apart = "→" if one == row else " ", output.value("object_sep_arcsec", one)
        p = probability_text(float(output.value("p_row", one)))
        lines.append(f"  {mark} {name:{max(map(len, names))}}  {p:>10}  {apart:.3f} arcsec from the mean place")
    return lines


def _object_lines(output: Output, row: int, before: str) -> list[str]:
    """The object of a row of a table of an internal match."""
    number, n_rows, p = (output.value(name, row) for name in ("object_id", "object_rows", "p_object"))
    exactly = f"probability that exactly these rows are one object {probability_text(float(p))}"
    lines = [f"{before}object {number} of {counted(int(n_rows), 'row')}, {exactly}"]
    if n_rows > 1 and (chi_sq := output.value("chi_sq", row)) is not None:
        lines += entry("residuals", f"χ² {chi_sq:.2f} of {2 * (int(n_rows) - 1)} degrees of freedom")
    return lines


def frame_lines(output: Output, asked: Asked) -> list[str]:
    """One measurement or star of a frame."""
    table, facts, text = output.table, output.facts, asked.text
    column = "measurement" if asked.source == 1 else "star"
    rows = np.array([int(text)]) if asked.by_row else np.flatnonzero(texts_of(table[column]) == text.strip())
    if not len(rows) or not 0 <= rows[0] < len(table):
        listed = ", ".join(texts_of(table[column])[:3])
        raise InputError(f"{facts['frame']} has no {column} {text}; its first are {listed}")
    row = int(rows[0])
    fate, star, number = (output.value(name, row) for name in ("fate", "star", "measurement"))
    mine = f"{facts['catalogue']} {star}" if number is None else f"measurement {number}"
    lines = [f"{mine} is {'a star that is ' * (fate == 'missing')}{fate}"]
    if fate == "identified":
        lines = [f"measurement {number} is {facts['catalogue']} {star}, "
                 f"probability {probability_text(float(output.value('p_match', row)))}"]  # fmt: skip
        off = f"{output.value('residual_x_px', row):+.2f}, {output.value('residual_y_px', row):+.2f} px"
        east, north = (output.value(f"residual_{axis}_arcsec", row) for axis in ("east", "north"))
        far = f"{output.value('distance_sigma', row):.2f} σ"
        lines += entry("measured − predicted", f"{off}; {east:+.3f}″ east, {north:+.3f}″ north; {far}")
    lines += entry("position", f"x {output.value('x_px', row):.2f}, y {output.value('y_px', row):.2f} px")
    magnitudes = [f"{words} {output.value(name, row):.2f}" for name, words in
                  (("magnitude", "measured"), ("star_magnitude", "in the catalogue"))
                  if output.value(name, row) is not None]  # fmt: skip
    lines += entry("magnitude", ", ".join(magnitudes)) if magnitudes else []
    if (alone := output.value("p_none", row)) is not None:
        lines += entry("no partner", f"probability {probability_text(float(alone))}")
    second = output.value("second_star" if number is not None else "second_measurement", row)
    if second is not None:
        lines += entry("next best", f"{second}, probability {probability_text(float(output.value('p_second', row)))}")
    if (seen := output.value("p_detect", row)) is not None:
        lines += entry("completeness", f"{100 * float(seen):.0f} % at its magnitude")
    return lines + (entry("remark", str(output.value("remark", row))) if output.value("remark", row) else [])


def _whole_number(text: str, name: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise InputError(f"{name} has no ids, so {text!r} is none of its records", "give a row, from 0") from None


def _first_chosen(table: Table, rows: IntArray) -> int:
    """The index, among these rows, of the answer."""
    if "match_flag" not in table.colnames:
        return 0
    return int(np.argmax(np.asarray(np.ma.filled(table["match_flag"][rows], 0)) == 1))


def _pair(output: Output, row: int) -> str:
    """The records of a row of a match, and their probability."""
    present = [k for k in (1, 2) if output.has(k, row)]
    called = " = ".join(f"{output.name(k)} {output.called(row, k)}" for k in present)
    p = output.value("p_match" if len(present) == 2 else "p_none", row)
    words = f"{called}{' alone' * (len(present) == 1)}"
    return words if p is None else f"{words}, probability {probability_text(float(p))}"


def _competing(details: Sequence[str]) -> list[str]:
    if not details:
        return []
    lines = ["", "Competing records", *(f"    {words}" for words in details[:LISTED])]
    return lines + ([f"    and {count(len(details) - LISTED)} more"] if len(details) > LISTED else [])


def source_numbers(facts: Mapping[str, Any]) -> list[int]:
    """The numbers of the matched catalogues, from 1."""
    return sorted(int(name.removeprefix("name_")) for name in facts if re.fullmatch(r"name_\d+", name))


def texts_of(column: Any) -> NDArray[np.str_]:
    """(n,) the cells of a column as stripped text; the values of masked cells are arbitrary."""
    return np.char.strip(np.asarray(np.ma.filled(column, "" if column.dtype.kind in "USO" else 0)).astype(str))


def _absent(column: Any) -> BoolArray:
    absent = np.array(np.ma.getmaskarray(column), bool)
    if column.dtype.kind == "f":  # a masked float is NaN in FITS
        absent |= np.isnan(np.ma.getdata(column))
    return absent


def cell_value(table: Table, name: str, row: int) -> Any:
    """The value of a cell; None where it is masked or the column does not exist."""
    if name not in table.colnames:
        return None
    cell = table[name][row]
    if cell is np.ma.masked or (isinstance(cell, float | np.floating) and np.isnan(cell)):
        return None
    return cell.item() if hasattr(cell, "item") else cell
