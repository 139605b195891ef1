"""The study of the papers' claims: every rule, many sources, with tables, figures and the page of the documentation."""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.tables import OUTPUT
from sameas.study.command import QUICK, SCENES, study

DOCS = Path(__file__).parent.parent / "docs"


def main() -> None:
    """The command line: what ``sameas study`` does, with the documentation's page in its place."""
    parser = argparse.ArgumentParser(prog="scripts/bench study", description=__doc__)
    parser.add_argument("--scenes", type=int, default=SCENES, help=f"scenes a point (default {SCENES})")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} scenes a point, and no page")
    options = parser.parse_args()
    scenes = QUICK if options.quick else options.scenes
    study(scenes, OUTPUT / "study", page=None if options.quick else DOCS / "study.md")


if __name__ == "__main__":
    main()
