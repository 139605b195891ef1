"""``sameas explain``: why a record was identified as it was, from an output of any command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sameas.cli.options import Debug, known_format, option
from sameas.cli.outcome import answering


def explain(
    output: Annotated[Path, typer.Argument(
        metavar="OUT", help="A table that `sameas match`, `many`, `internal` or `frame` wrote, or a picture's folder.",
        show_default=False,
    )],
    record: Annotated[str, typer.Argument(
        metavar="ID",
        help="Id of the record, or its row if the catalogue has no ids; in a picture, the number or label of an "
        "object.",
        show_default=False,
    )],
    source: Annotated[str, option(
        "--source", metavar="1|2|NAME", show_default=True,
        help="Source of the record: its number or name; in a frame, measurement or star.",
    )] = "1",
    row: Annotated[bool, option("--row", show_default=True, help="ID is a row, counted from 0.")] = False,
    at: Annotated[str | None, option("--at", metavar="TIME", help="Of a picture: the time.")] = None,
    other: Annotated[str | None, option(
        "--with", metavar="ID", help="Of a picture: a second track or object: are both one, and why?",
    )] = None,
    again: Annotated[bool, option(
        "--again", show_default=True,
        help="Match the two catalogues again, for the terms of the odds and the cost of other answers.",
    )] = False,
    format: Annotated[str | None, option(
        "--format", metavar="NAME", callback=known_format, help="Format of OUT; by default by its extension.",
    )] = None,
    debug: Debug = False,
) -> None:  # fmt: skip
    """Explain a record's identification: its candidates, and what other answers would cost.

    What OUT holds is enough; where the catalogues of a small match are still there it is repeated, which tells more.
    """
    with answering(debug):
        from sameas.cli.terminal import Pace, Printer, share_compilation
        from sameas.front.explain import explain as explanation_of

        with Pace(quiet=False) as pace:
            share_compilation(quiet=False)
            record_or_row = {"row": _row(record)} if row else {"id": record}
            lines = explanation_of(
                output, source=source, at=at, other=other, again=again, format=format, progress=pace, **record_or_row
            ).lines
        Printer(quiet=False)(lines)


def _row(text: str) -> int:
    if not text.isdigit():
        raise typer.BadParameter(f"{text!r} is not a row; give a whole number from 0", param_hint="ID")
    return int(text)
