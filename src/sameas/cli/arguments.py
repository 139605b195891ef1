"""Arguments: what the commands take, apart from the columns of the catalogues."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from sameas.cli.options import one_of

JOINS = ("all1", "1and2", "all2", "1or2", "1not2", "2not1", "1xor2", "pairs")
FORMATS = ("fits", "votable", "ecsv", "csv", "parquet")


def _file(name: str, help: str) -> Any:
    return typer.Argument(metavar=name, help=help, show_default=False)


def _option(*names: str, panel: str | None = None, **settings: Any) -> Any:
    return typer.Option(*names, rich_help_panel=panel, **settings)


_MATCH, _FILES = "The match", "Files"
_known_format = one_of(FORMATS)
First = Annotated[Path, _file("A", "First catalogue: FITS, VOTable, ECSV, CSV or Parquet.")]
Second = Annotated[Path, _file("B", "Second catalogue.")]
Output = Annotated[
    Path | None,
    _option("-o", "--output", metavar="OUT", help="The joined table; its format is that of the extension."),
]
Join = Annotated[
    str,
    _option("--join", metavar="TYPE", callback=one_of(JOINS), help=f"Rows of the output: {', '.join(JOINS)}."),
]
Nway = Annotated[bool, _option("--nway-columns", help="Add p_any, p_i and dist_bayesfactor of NWAY.")]
Pictures = Annotated[
    Path | None,
    _option("--pictures", metavar="FOLDER", help="Draw residuals, errors, certainty and brightness into a folder."),
]
ToEpoch = Annotated[
    float | None,
    _option("--to-epoch", panel=_MATCH, metavar="YEAR", help="Common epoch that both catalogues are moved to."),
]
GateSigmas = Annotated[
    float | None,
    _option(
        "--gate-sigmas",
        panel=_MATCH,
        metavar="K",
        help="Radius of the gate in quoted σ, instead of one as wide as the errors need.",
    ),
]
ErrorScale = Annotated[
    str,
    _option(
        "--error-scale",
        panel=_MATCH,
        metavar="auto|FACTOR",
        help="Factor on the quoted errors: estimated with its spread, or given; 1 believes them.",
    ),
]
Density = Annotated[
    str | None,
    _option(
        "--density",
        panel=_MATCH,
        metavar="N1,N2",
        help="Records per square degree of A and B, instead of local densities from the data.",
    ),
]
MagnitudeEvidence = Annotated[
    str,
    _option(
        "--magnitudes",
        panel=_MATCH,
        metavar="auto|off|A,…:B,…",
        help="Magnitudes as evidence: those of both catalogues, none, or columns of A and of B.",
    ),
]
PrecisionEvidence = Annotated[
    bool,
    _option(
        "--precision/--no-precision",
        panel=_MATCH,
        help="Whether the sizes of the quoted errors are evidence too, where magnitudes tell too little.",
    ),
]
Offset = Annotated[
    str,
    _option(
        "--offset",
        panel=_MATCH,
        metavar="none|find",
        callback=one_of(("none", "find")),
        help="Find the shift and turn of B against A, and take it away.",
    ),
]
Hdu1 = Annotated[
    str | None,
    _option("--hdu1", panel=_FILES, metavar="HDU", help="Number or name of the FITS extension of A."),
]
Hdu2 = Annotated[str | None, _option("--hdu2", panel=_FILES, metavar="HDU", help="The same of B.")]
Format1 = Annotated[
    str | None,
    _option(
        "--format1",
        panel=_FILES,
        metavar="NAME",
        callback=_known_format,
        help="Format of A where its extension does not tell it.",
    ),
]
Format2 = Annotated[
    str | None,
    _option("--format2", panel=_FILES, metavar="NAME", callback=_known_format, help="The same of B."),
]
OutFormat = Annotated[
    str | None,
    _option("--out-format", panel=_FILES, metavar="NAME", callback=_known_format, help="The same of OUT."),
]
Overwrite = Annotated[bool, _option("--overwrite/--no-overwrite", panel=_FILES, help="Whether OUT may exist already.")]
CompareNearest = Annotated[
    bool, _option("--compare-nearest", help="Print what the nearest neighbour would say beside it.")
]
Certify = Annotated[
    bool, _option("--certify", help="Prove that no other one-to-one answer is more probable, and print the proof.")
]
DryRun = Annotated[
    bool, _option("--dry-run", help="Print what is understood of the catalogues; identify and write nothing.")
]
Quiet = Annotated[bool, _option("--quiet", "-q", help="Print doubts and errors only.")]
Debug = Annotated[bool, _option("--debug", help="Show the traceback of an error.")]


Made = Annotated[Path, _file("OUT", "A table that `sameas match` wrote.")]
Record = Annotated[str, _file("ID", "Identifier of the record, or its row where the catalogue has none.")]
Source = Annotated[int, _option("--source", metavar="1|2", min=1, max=2, help="Whose record it is.")]
Format = Annotated[
    str | None,
    _option(
        "--format",
        metavar="NAME",
        callback=_known_format,
        help="Format of OUT where its extension does not tell it.",
    ),
]
