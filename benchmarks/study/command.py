"""The study's run: runs the experiments with a progress bar, writes tables, figures and the page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from benchmarks.study import tables
from benchmarks.study.claims import claims
from benchmarks.study.page import page as page_of
from benchmarks.study.stonesoup import INSTALL
from benchmarks.study.study import Study, studied
from sameas.errors import InputError
from sameas.io import replacing

if TYPE_CHECKING:
    from rich.progress import Progress

#: Scenes per point of a run that is published, and of a quick one.
SCENES, QUICK = 4000, 200


def study(scenes: int, folder: Path, only: Sequence[str] = (), page: Path | None = None) -> Study:
    """Run the study, write its results and print a summary.

    Parameters
    ----------
    scenes : number of scenes per point.
    folder : for ``tables/`` (Parquet and Markdown), ``figures/`` (SVG), and ``study.md`` if all experiments are run.
    only : experiments to run; default all.
    page : another path for ``study.md``, with its figures in ``figures/`` next to it.
    """
    if page is not None and only:
        raise InputError("the page needs every experiment; leave out --only, or --page")
    no_figures = _why_no_figures()
    with _Bar() as progress:
        result = studied(scenes, only, progress)
    path = page or folder / "study.md"
    rows = tables.all_tables(result)
    for name, table in rows.items():
        (folder / "tables").mkdir(parents=True, exist_ok=True)
        tables.write(table, folder / "tables", name)
    if not only:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as draft:
            draft.write_text(page_of(result), encoding="utf-8")
    drawn = _draw(result, path.parent / "figures") if no_figures is None else []
    for line in [*summary(result), "", *_written(folder, rows, path if not only else None, drawn)]:
        print(line)
    if no_figures is not None:
        print(no_figures)
    return result


def summary(study: Study) -> list[str]:
    """The results of the study as lines to print."""
    lines = []
    for claim in claims(study):
        lines.append(f"  {claim.what}: {claim.claimed} ({claim.source})")
        lines.append(f"      measured {tables.shown(claim.measured)}, agrees: {claim.verdict} ({claim.counted})")
    if lines:
        lines.insert(0, "What was claimed")
    if study.priors is not None:
        p = study.priors
        share = 100.0 * p.differ.mean()
        lines += ["", f"Linear prior: {share:.2f} % of {len(p)} groups are decided differently from the exact one; "
                  f"the exact is less probable in {int((p.loss < -1e-9).sum())}"]  # fmt: skip
    for several, counts in study.several:
        matters = counts.mean("order matters").value
        joint, sequential = (tables.shown(counts.mean(f"{way} whole")) for way in ("joint", "sequential"))
        lines.append(
            f"{several.name}: joint {joint} wholly right, sequential {sequential}, "
            f"order matters in {100 * matters:.0f} %"
        )
    if study.crowd is not None:
        c = study.crowd
        lines.append(f"identify_many, 6 sources × 200 targets, {c.records} records: {c.seconds:.2f} s")
    if not study.stone_soup:
        lines.append(f"{INSTALL}; its results are missing")
    return [*lines, f"{study.scenes} scenes per point, {study.seconds:.0f} s"]


def _why_no_figures() -> str | None:
    """None if figures can be drawn, otherwise the reason; checked before the run, which takes minutes."""
    from importlib.util import find_spec

    return None if find_spec("matplotlib") else "no figures: matplotlib is missing; pip install 'sameas[plots]'"


def _draw(study: Study, folder: Path) -> list[Path]:
    from benchmarks.study.figures import all_figures, save

    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in all_figures(study).items():
        paths.append(folder / f"{name}.svg")
        save(figure, paths[-1])
    return paths


def _written(folder: Path, rows: dict, page: Path | None, drawn: list[Path]) -> list[str]:
    lines = [f"written: {', '.join(f'{name}.parquet and .md' for name in rows)} in {folder / 'tables'}"]
    if drawn:
        lines.append(f"         {len(drawn)} figures in {drawn[0].parent}")
    return lines + ([f"         {page}"] if page else [])


class _Bar:
    """A progress bar on stderr if that is a terminal; called with experiment, pieces done and pieces in all."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        self.bar: Progress = Progress(
            TextColumn("{task.description:16}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
            TimeRemainingColumn(), console=Console(stderr=True), transient=True,
        )  # fmt: skip
        self.tasks: dict[str, int] = {}

    def __enter__(self) -> _Bar:
        self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bar.stop()

    def __call__(self, experiment: str, done: int, total: int) -> None:
        if experiment not in self.tasks:
            self.tasks[experiment] = self.bar.add_task(experiment, total=total)
        self.bar.update(self.tasks[experiment], completed=done)  # type: ignore[arg-type]
