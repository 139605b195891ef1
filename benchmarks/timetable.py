"""Rows of the speed tables: the work of `sameas`, that of its peers, and the targets."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from benchmarks.measure import Measurement, Work, measure
from benchmarks.tables import Table, duration

COLUMNS = ("what", "by", "median", "min to max", "runs", "peak MB", "above baseline", "× sameas", "target", "met")


#: A peer's name, and its work or how to install it.
PeerWork = tuple[str, Work | str]


@dataclass(frozen=True)
class Row:
    """A task of `sameas`, compared with its peers.

    what : label. work : that of `sameas`. peers : those of other programs. limit_s : target in seconds. min_speedup :
    targeted ratio of the first peer's median to its time. quantile : of the run times, compared with the targets.
    """

    what: str
    work: Work
    peers: tuple[PeerWork, ...] = ()
    limit_s: float | None = None
    min_speedup: float | None = None
    quantile: float = 0.5


def timetable(title: str, rows: Iterable[Row], notes: tuple[str, ...] = ()) -> Table:
    """Measure every row: `sameas` first, its peers below. A note gives the reason of each failure."""
    lines: list[list[object]] = []
    failures: list[str] = []
    for row in rows:
        measured = [("sameas", measure(row.work)), *((name, _measured(work)) for name, work in row.peers)]
        reference = measured[0][1]
        for k, (name, measurement) in enumerate(measured):
            targets = _targets(row, measured) if k == 0 else ["", ""]
            what = row.what if k == 0 else ""
            lines.append([what, name, *_cells(measurement, row.quantile, reference.quantile(row.quantile)), *targets])
            if measurement.error and not measurement.not_installed:
                failures.append(f"{row.what}: {name} failed: {measurement.error}")
    return Table(title, COLUMNS, lines, (*notes, *failures))


def _measured(work: Work | str) -> Measurement:
    return Measurement(error=work, not_installed=True) if isinstance(work, str) else measure(work)


def _targets(row: Row, measured: list[tuple[str, Measurement]]) -> list[object]:
    """The targets in words, and whether all are met."""
    time = measured[0][1].quantile(row.quantile)
    targets, met_targets = [], []
    if row.limit_s is not None:
        targets.append(f"≤ {duration(row.limit_s)}")
        met_targets.append(time <= row.limit_s)
    if row.min_speedup is not None and len(measured) > 1 and measured[1][1].seconds:
        name, peer = measured[1]
        targets.append(f"≥ {row.min_speedup:.3g}× {name.split()[0]}")
        met_targets.append(peer.median >= row.min_speedup * time)
    return [", ".join(targets), "" if not met_targets else "yes" if all(met_targets) else "NO"]


def _cells(measurement: Measurement, quantile: float, reference_s: float) -> list[object]:
    if not measurement.seconds:
        cells = ["missing", measurement.error] if measurement.not_installed else ["failed", ""]
        return [*cells, 0, None, None, None]
    prefix = "" if quantile == 0.5 else f"p50 {duration(measurement.median)}, p{100 * quantile:.0f} "
    time = measurement.quantile(quantile)
    spread = f"{duration(min(measurement.seconds))} to {duration(max(measurement.seconds))}"
    return [
        prefix + duration(time), spread, len(measurement.seconds), round(measurement.peak_mb),
        round(measurement.peak_mb - measurement.baseline_mb), round(time / reference_s, 2) if reference_s > 0 else None,
    ]  # fmt: skip
