"""``sameas explain``: the match repeated as the output tells it, and one record's story."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sameas.cli.options import Debug, known_format, option
from sameas.cli.outcome import answering
from sameas.errors import InputError

if TYPE_CHECKING:
    from sameas.result.explanation import Explanation
    from sameas.sky.crossmatch import SkyMatch


def explain(
    output: Annotated[
        Path, typer.Argument(metavar="OUT", help="A table that `sameas match` wrote.", show_default=False)
    ],
    record: Annotated[
        str,
        typer.Argument(
            metavar="ID", help="Identifier of the record, or its row where the catalogue has none.", show_default=False
        ),
    ],
    source: Annotated[
        int, option("--source", metavar="1|2", min=1, max=2, show_default=True, help="Whose record it is.")
    ] = 1,
    format: Annotated[
        str | None,
        option(
            "--format", metavar="NAME", callback=known_format,
            help="Format of OUT where its extension does not tell it.",
        ),
    ] = None,
    debug: Debug = False,
) -> None:  # fmt: skip
    """Why a record was identified as it was: its competitors, and what other answers would cost.

    The match is repeated with what OUT says of it; the catalogues must still be where they were.
    """
    with answering(debug):
        run(output, record, source, format)


def run(output: Path, record: str, source: int, format: str | None) -> None:
    """Print why the record of catalogue ``source`` (1 or 2) was identified as it was."""
    from sameas.cli.request import Request
    from sameas.cli.terminal import Pace, Printer, tell_compilation
    from sameas.io import read_provenance
    from sameas.report.explain import explanation_lines
    from sameas.sky import crossmatch

    with Pace(quiet=False) as pace:
        pace(f"reading {output}")
        request = Request.of_facts(read_provenance(output, format=format), str(output))
        first, second = request.catalogue(1), request.catalogue(2)
        tell_compilation()
        match = request.naming_sides(lambda: crossmatch.match(first, second, request.options, progress=pace))
        lines = explanation_lines(match, _explained(match, record, source), source)
    Printer(quiet=False)(lines)


def _explained(match: SkyMatch, record: str, source: int) -> Explanation:
    try:
        return match.result.explain(record, source=source)
    except InputError as error:
        other = 3 - source
        try:
            match.result.explain(record, source=other)
        except InputError:
            raise error from None
        name = (match.first if other == 1 else match.second).name
        raise InputError(f"{record} is a record of {name}; say --source {other}") from None
