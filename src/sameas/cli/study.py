"""``sameas study``: every rule that the papers name on the same scenes; tables, figures and the page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Scenes = Annotated[int | None, typer.Option("--scenes", metavar="N", help="Scenes at every point; 4000 if not given.")]
Quick = Annotated[bool, typer.Option("--quick", help="200 scenes at every point: a look, in a minute.")]
Folder = Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Gets tables, figures and study.md.")]
Only = Annotated[
    list[str] | None,
    typer.Option(
        "--only",
        metavar="NAME",
        help="One experiment, and no page; may be given again. "
        "claims, spacing, formations, wrong, several, mori, priors.",
    ),
]
Page = Annotated[Path | None, typer.Option("--page", metavar="FILE", help="Another place for the page.")]


def run(scenes: int | None, quick: bool, folder: Path, only: list[str] | None, page: Path | None) -> None:
    """Run the study and print what it found."""
    from sameas.study.command import QUICK, SCENES, study

    if scenes is not None and quick:
        raise typer.BadParameter("say --quick or --scenes, not both", param_hint="--quick")
    study(scenes or (QUICK if quick else SCENES), folder, only or (), page)
