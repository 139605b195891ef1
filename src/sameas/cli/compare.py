"""``sameas compare``: which identities two outputs give differently."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sameas.cli.options import Debug
from sameas.cli.outcome import answering

_WHAT = "A table that `sameas match` or `many` wrote, or the folder of a picture."


def compare(
    one: Annotated[Path, typer.Argument(metavar="A", help=_WHAT, show_default=False)],
    other: Annotated[Path, typer.Argument(metavar="B", help="Another, of the same records.", show_default=False)],
    debug: Debug = False,
) -> None:
    """Compare two outputs: which records were identified differently.

    Records that one of the two does not have are counted; a sensor left out is no difference by itself.
    """
    with answering(debug):
        from sameas.cli.terminal import Pace, Printer
        from sameas.front.comparison import compare as comparison

        with Pace(quiet=False) as pace:
            pace(f"reading {one} and {other}")
            lines = comparison(one, other).lines
        Printer(quiet=False)(lines)
