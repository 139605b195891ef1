"""Tables of results: aligned text for the terminal, Markdown and JSON in ``benchmarks/output``."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import machine

OUTPUT = Path(__file__).parent / "output"


@dataclass(frozen=True)
class Table:
    """Rows of cells under column names; a cell is text or an unrounded number. notes : printed below the table."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    notes: Sequence[str] = ()

    def text(self) -> str:
        """Aligned columns; those with a number are aligned to the right."""
        cells = self._cells()
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        right = [any(isinstance(row[k], int | float) for row in self.rows) for k in range(len(self.columns))]
        lines = [
            "  ".join(c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, right, strict=True))
            for row in cells
        ]
        lines.insert(1, "  ".join("-" * width for width in widths))
        return "\n".join([self.title, *(f"  {line.rstrip()}" for line in lines), *self._notes("  ")])

    def markdown(self) -> str:
        """The same as Markdown."""
        head, *body = ["| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in self._cells()]
        ruler = "|" + "---|" * len(self.columns)
        return "\n".join([f"### {self.title}", "", head, ruler, *body, "", *self._notes("")])

    def _cells(self) -> list[list[str]]:
        return [list(self.columns), *([formatted(cell) for cell in row] for row in self.rows)]

    def _notes(self, indent: str) -> list[str]:
        return [f"{indent}{note}" for note in self.notes]


def formatted(cell: Any) -> str:
    """Two to four digits of a number; empty for None."""
    if cell is None:
        return ""
    if isinstance(cell, bool) or not isinstance(cell, int | float):
        return str(cell)
    if isinstance(cell, int):
        return f"{cell:d}"
    if math.isnan(cell):
        return "–"
    size = abs(cell)
    if size != 0 and size < 1e-3:
        return f"{cell:.1e}"
    return f"{cell:.0f}" if size >= 1000 else f"{cell:.4g}"


def duration(seconds: float) -> str:
    """A time in s, ms or µs with three digits."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e6:.3g} µs"


def report(name: str, tables: Iterable[Table]) -> None:
    """Print every table when it is finished, and write all to NAME.md and NAME.json."""
    OUTPUT.mkdir(exist_ok=True)
    about = machine.described()
    print("\n".join(about), end="\n\n", flush=True)
    done: list[Table] = []
    for table in tables:
        done.append(table)
        print(table.text(), end="\n\n", flush=True)
        pages = [f"# {name}", *(f"- {line}" for line in about), *(t.markdown() for t in done)]
        (OUTPUT / f"{name}.md").write_text("\n\n".join(pages) + "\n")
        content = {"machine": about, "tables": [vars(t) for t in done]}
        (OUTPUT / f"{name}.json").write_text(json.dumps(content, indent=1, ensure_ascii=False, default=float))
    print(f"written to {OUTPUT / name}.md and .json")
