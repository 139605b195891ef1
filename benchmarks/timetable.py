"""A row of the speed table: our work, a peer's beside it, what was asked for, and how it is printed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from benchmarks.measure import Measurement, Work, measure
from benchmarks.tables import Table, duration

COLUMNS = ("what", "by", "median", "min to max", "runs", "peak MB", "above rest", "× sameas", "asked", "holds")


@dataclass(frozen=True)
class Row:
    """what : what is done. ours : our work. beside : (name, work) of peers. at_most_s : what issue 3 asks, or None.

    at_least : how many times faster than the first peer it must be, or None. share : the quantile that is judged
    (0.5 the median, 0.99 for p99).
    """

    what: str
    ours: Work
    beside: tuple[tuple[str, Work], ...] = ()
    at_most_s: float | None = None
    at_least: float | None = None
    share: float = 0.5


def timetable(title: str, rows: Iterable[Row], notes: tuple[str, ...] = ()) -> Table:
    """Every row measured, ours first, peers below it."""
    return Table(title, COLUMNS, [line for row in rows for line in _lines(row)], notes)


def _lines(row: Row) -> Iterator[list[object]]:
    ours = measure(row.ours)
    others = [(name, measure(work)) for name, work in row.beside]
    time = _judged(ours, row.share)
    asked, holds = [], []
    if row.at_most_s is not None:
        asked.append(f"≤ {duration(row.at_most_s)}")
        holds.append(time <= row.at_most_s)
    if row.at_least is not None and others and others[0][1].seconds:
        asked.append(f"≥ {row.at_least:g}× {others[0][0].split()[0]}")
        holds.append(others[0][1].median >= row.at_least * time)
    verdict = "" if not holds else "yes" if all(holds) else "NO"
    yield [row.what, "sameas", *_cells(ours, row.share, time), ", ".join(asked), verdict]
    for name, one in others:
        yield ["", name, *_cells(one, row.share, time), "", ""]


def _judged(one: Measurement, share: float) -> float:
    return one.median if share == 0.5 else one.quantile(share)


def _cells(one: Measurement, share: float, ours: float) -> list[object]:
    if not one.seconds:
        return [f"missing: {one.missing}", "", 0, None, None, None]
    word = "" if share == 0.5 else f"p{100 * share:.0f} "
    time = _judged(one, share)
    spread = f"{duration(min(one.seconds))} to {duration(max(one.seconds))}"
    return [
        word + duration(time), spread, len(one.seconds), round(one.peak_mb),
        round(one.peak_mb - one.resting_mb), round(time / ours, 2) if ours > 0 else None,
    ]  # fmt: skip
