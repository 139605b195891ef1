"""The study of the papers' claims: every rule, many sources, with tables, figures and the page of the documentation."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.study.command import QUICK, SCENES, study
from benchmarks.study.experiments import NAMES
from benchmarks.tables import OUTPUT
from sameas import InputError

DOCS = Path(__file__).parents[2] / "docs"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; a full run writes ``docs/study.md``."""
    parser = argparse.ArgumentParser(prog="scripts/bench study", description=__doc__)
    parser.add_argument("--scenes", type=int, default=None, help=f"scenes per point (default {SCENES})")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} scenes per point, and no page")
    parser.add_argument("--only", action="append", default=[], help=f"one experiment, and no page: {', '.join(NAMES)}")
    parser.add_argument("-o", "--output", type=Path, default=OUTPUT / "study", help="folder for tables and figures")
    parser.add_argument("--page", type=Path, default=None, help="another path for the page")
    options = parser.parse_args(arguments)
    if options.scenes is not None and options.quick:
        parser.error("give --quick or --scenes, not both")
    whole = not (options.quick or options.only)
    page = options.page or (DOCS / "study.md" if whole and options.output == OUTPUT / "study" else None)
    try:
        study(options.scenes or (QUICK if options.quick else SCENES), options.output, options.only, page)
    except InputError as error:
        sys.exit(f"scripts/bench study: {error}")


if __name__ == "__main__":
    main()
