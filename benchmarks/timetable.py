"""A row of the speed table: our work, a peer's beside it, what was asked for, and how it is printed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from benchmarks.measure import Measurement, Work, measure
from benchmarks.tables import Table, duration

COLUMNS = (
    "what",
    "by",
    "median",
    "min to max",
    "runs",
    "peak MB",
    "above rest",
    "× sameas",
    "asked",
    "holds",
)


#: A peer: its name, and its work or how to install it.
Beside = tuple[str, Work | str]


@dataclass(frozen=True)
class Row:
    """what : what is done. ours : our work. beside : the peers. at_most_s : what the plan asks, or None.

    at_least : how many times faster than the first peer it must be, or None. share : the quantile that is judged
    (0.5 the median, 0.99 for p99).
    """

    what: str
    ours: Work
    beside: tuple[Beside, ...] = ()
    at_most_s: float | None = None
    at_least: float | None = None
    share: float = 0.5


def timetable(title: str, rows: Iterable[Row], notes: tuple[str, ...] = ()) -> Table:
    """Every row measured, ours first, peers below it; what failed says why in a note."""
    lines: list[list[object]] = []
    failures: list[str] = []
    for row in rows:
        measured = [("sameas", measure(row.ours)), *((name, _measured(work)) for name, work in row.beside)]
        ours = measured[0][1]
        for k, (name, one) in enumerate(measured):
            judged = _verdict(row, measured) if k == 0 else ["", ""]
            what = row.what if k == 0 else ""
            lines.append([what, name, *_cells(one, row.share, _judged(ours, row.share)), *judged])
            if one.missing and not one.absent:
                failures.append(f"{row.what}: {name} failed: {one.missing}")
    return Table(title, COLUMNS, lines, (*notes, *failures))


def _measured(work: Work | str) -> Measurement:
    return Measurement(missing=work, absent=True) if isinstance(work, str) else measure(work)


def _verdict(row: Row, measured: list[tuple[str, Measurement]]) -> list[object]:
    """What is asked for, and whether it holds."""
    time = _judged(measured[0][1], row.share)
    asked, holds = [], []
    if row.at_most_s is not None:
        asked.append(f"≤ {duration(row.at_most_s)}")
        holds.append(time <= row.at_most_s)
    if row.at_least is not None and len(measured) > 1 and measured[1][1].seconds:
        name, peer = measured[1]
        asked.append(f"≥ {row.at_least:.3g}× {name.split()[0]}")
        holds.append(peer.median >= row.at_least * time)
    return [", ".join(asked), "" if not holds else "yes" if all(holds) else "NO"]


def _judged(one: Measurement, share: float) -> float:
    return one.median if share == 0.5 else one.quantile(share)


def _cells(one: Measurement, share: float, ours: float) -> list[object]:
    if not one.seconds:
        words = ["missing", one.missing] if one.absent else ["failed", ""]
        return [*words, 0, None, None, None]
    word = "" if share == 0.5 else f"p50 {duration(one.median)}, p{100 * share:.0f} "
    time = _judged(one, share)
    spread = f"{duration(min(one.seconds))} to {duration(max(one.seconds))}"
    return [
        word + duration(time), spread, len(one.seconds), round(one.peak_mb),
        round(one.peak_mb - one.resting_mb), round(time / ours, 2) if ours > 0 else None,
    ]  # fmt: skip
