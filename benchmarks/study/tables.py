"""Tables of the study, as Markdown for readers and Parquet for programs; every figure with its standard error."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.study.claims import claims
from benchmarks.study.scenes import Lattice
from benchmarks.study.several import COLUMNS
from benchmarks.study.study import Study
from benchmarks.study.tally import Ratio
from sameas.io import replacing

Row = dict[str, Any]


def all_tables(study: Study) -> dict[str, list[Row]]:
    """The tables of the study by name, without empty ones."""
    tables = {
        "claims": _claims(study), "rules": _rules(study), "several": _several(study), "mori": _mori(study),
        "priors": _priors(study),
    }  # fmt: skip
    return {name: rows for name, rows in tables.items() if rows}


def write(rows: Sequence[Row], folder: Path, name: str) -> None:
    """NAME.parquet and NAME.md."""
    import pyarrow as pa
    from pyarrow import parquet

    flat = [_flat(row) for row in rows]
    with replacing(folder / f"{name}.parquet") as draft:
        parquet.write_table(pa.Table.from_pylist(flat), draft)
    with replacing(folder / f"{name}.md") as draft:
        draft.write_text(markdown(rows) + "\n", encoding="utf-8")


def markdown(rows: Sequence[Row], columns: Iterable[str] = ()) -> str:
    """Rows as a table of these columns, default all; numbers are right-aligned."""
    names = list(columns) or list(rows[0])
    right = {n for n in names if any(isinstance(r.get(n), Ratio | float | int) for r in rows)}
    lines = ["| " + " | ".join(names) + " |", "|" + "|".join("---:" if n in right else "---" for n in names) + "|"]
    return "\n".join(lines + ["| " + " | ".join(shown(row.get(n)) for n in names) + " |" for row in rows])


def shown(cell: Any) -> str:
    """A cell as text: a figure with its standard error, a dash for NaN, empty for None."""
    if cell is None:
        return ""
    if isinstance(cell, Ratio):
        if math.isnan(cell.value):
            return "–"
        return f"{cell.value:.3f}" if math.isnan(cell.error) else f"{cell.value:.3f} ± {cell.error:.3f}"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    return f"{cell:.3g}" if isinstance(cell, float) else str(cell)


def _flat(row: Row) -> Row:
    """A figure as two columns; NaN as null."""
    flat: Row = {}
    for name, cell in row.items():
        parts = {name: cell.value, f"{name} s.e.": cell.error} if isinstance(cell, Ratio) else {name: cell}
        flat |= {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in parts.items()}
    return flat


def _claims(study: Study) -> list[Row]:
    return [
        {
            "source": c.source,
            "claim": c.what,
            "claimed": c.claimed,
            "measured": c.measured,
            "counted as": c.counted,
            "agrees": c.verdict,
        }
        for c in claims(study)
    ]


def _rules(study: Study) -> list[Row]:
    rows = []
    for outcome in study.outcomes:
        point, formation = outcome.point, outcome.point.formation
        about = {
            "experiment": point.experiment, "scene": point.name, "targets": formation.targets,
            "lattice": " × ".join(map(str, formation.shape)) if isinstance(formation, Lattice) else None,
            "features": formation.d, "spacing": float(formation.spacing), "q1": formation.q[0], "q2": formation.q[1],
            "sigma1": formation.sigma[0], "sigma2": formation.sigma[1],
        }  # fmt: skip
        for rank, (name, tally) in enumerate(zip(outcome.names, outcome.tallies, strict=True)):
            if point.share < 1.0 and rank == 0:
                continue  # Only the reference; its row on all scenes is already there.
            time_ms = 1e3 * tally.seconds / tally.scenes
            rows.append(about | {"rule": name, "scenes": tally.scenes, **tally.figures(), "ms per scene": time_ms})
    return rows


def _several(study: Study) -> list[Row]:
    rows = []
    for several, counts in study.several:
        row: Row = {"scene": several.name, "sources": len(several.formation.q), "scenes": len(counts.per_scene)}
        row |= {name: counts.mean(name) for name in COLUMNS}
        n = len(counts.per_scene)
        row |= {
            "joint ms per scene": 1e3 * counts.joint_s / n,
            "sequential ms per scene": 1e3 * counts.sequential_s / n,
        }
        rows.append(row)
    return rows


def _mori(study: Study) -> list[Row]:
    return [
        {"features": p.features, "β√|S|": p.density, "formula": p.formula, "simulated": p.simulated,
         "difference": p.simulated.value - p.formula}
        for p in study.mori
    ]  # fmt: skip


def _priors(study: Study) -> list[Row]:
    p = study.priors
    if p is None:
        return []
    mean_loss = float(p.loss[p.differ].mean()) if p.differ.any() else 0.0
    return [
        {
            "groups": len(p),
            "decided differently": int(p.differ.sum()),
            "exact less probable": int((p.loss < -1e-9).sum()),
            "largest loss of the linear prior, ln": float(p.loss.max()),
            "mean loss where they differ, ln": mean_loss,
            "records right, exact": p.right_exact,
            "records right, linear": p.right_linear,
        }
    ]
