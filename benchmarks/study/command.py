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

#: Scenes a point of a run that is published, and of a quick one.
SCENES, QUICK = 4000, 200


def study(scenes: int, folder: Path, only: Sequence[str] = (), page: Path | None = None) -> Study:
    """Run the study and write what it found; a summary on the terminal.

    Parameters
    ----------
    scenes : at every point.
    folder : gets ``tables/`` (Parquet and Markdown), ``figures/`` (SVG), and ``study.md`` where all experiments ran.
    only : experiments to run; all if none are named.
    page : another place for ``study.md``, with its figures in ``figures/`` beside it.
    """
    if page is not None and only:
        raise InputError("the page needs every experiment; leave out --only, or --page")
    figures = _figures_or_words()
    with _Bar() as told:
        found = studied(scenes, only, told)
    place = page or folder / "study.md"
    rows = tables.all_tables(found)
    for name, table in rows.items():
        (folder / "tables").mkdir(parents=True, exist_ok=True)
        tables.write(table, folder / "tables", name)
    if not only:
        place.parent.mkdir(parents=True, exist_ok=True)
        with replacing(place) as draft:
            draft.write_text(page_of(found), encoding="utf-8")
    drawn = _draw(found, place.parent / "figures") if figures is None else []
    for line in [*summary(found), "", *_written(folder, rows, place if not only else None, drawn)]:
        print(line)
    if figures is not None:
        print(figures)
    return found


def summary(study: Study) -> list[str]:
    """What the study found, for a terminal."""
    lines = []
    for claim in claims(study):
        lines.append(f"  {claim.what}: {claim.said} ({claim.source})")
        lines.append(f"      measured {tables.shown(claim.ours)}, within: {claim.verdict} ({claim.counted})")
    if lines:
        lines.insert(0, "What was claimed")
    if study.priors is not None:
        p = study.priors
        share = 100.0 * p.differ.mean()
        lines += ["", f"Linear prior: {share:.2f} % of {len(p)} groups are decided otherwise than with the exact one; "
                  f"the exact is less probable in {int((p.loss < -1e-9).sum())}"]  # fmt: skip
    for several, counts in study.several:
        matters = counts.mean("order matters").value
        joint, sequential = (tables.shown(counts.mean(f"{way} whole")) for way in ("joint", "sequential"))
        lines.append(
            f"{several.name}: all at once {joint} wholly right, one after another {sequential}, "
            f"order matters in {100 * matters:.0f} %"
        )
    if study.crowd is not None:
        c = study.crowd
        lines.append(f"identify_many, 6 sources × 200 targets, {c.records} records: {c.seconds:.2f} s")
    if not study.stone_soup:
        lines.append(f"{INSTALL}; its column is left out")
    return [*lines, f"{study.scenes} scenes a point, {study.seconds:.0f} s"]


def _figures_or_words() -> str | None:
    """None where figures can be drawn, else why there are none; asked before minutes are spent."""
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
    """A progress bar on the terminal's stderr; nothing where there is no terminal. Call it with what is done."""

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

    def __call__(self, what: str, done: int, of: int) -> None:
        if what not in self.tasks:
            self.tasks[what] = self.bar.add_task(what, total=of)
        self.bar.update(self.tasks[what], completed=done)  # type: ignore[arg-type]
