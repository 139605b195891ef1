"""Reading: the catalogues of a request, each printed as soon as it is understood."""

from __future__ import annotations

from functools import partial
from typing import Any

from sameas.cli.options import in_options
from sameas.cli.terminal import Pace, Printer
from sameas.front.request import Request
from sameas.report.match import catalogue_lines
from sameas.sky.catalogue import Catalogue


def catalogues(request: Request[Any], printer: Printer, pace: Pace) -> list[Catalogue]:
    """All catalogues of a request."""

    def told(side: int, catalogue: Catalogue) -> None:
        pace.pause()
        printer([*catalogue_lines(catalogue, side, request.paths[side - 1], partial(_in_own_terms, request, side)), ""])
        if side < len(request.paths):
            pace(f"reading {request.paths[side]}")

    pace(f"reading {request.paths[0]}")
    return request.catalogues(told)


def _in_own_terms(request: Request[Any], side: int, text: str) -> str:
    """A text on one catalogue, with that catalogue's own options."""
    return in_options(request.words(text, side))
