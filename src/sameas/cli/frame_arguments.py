"""Arguments of ``sameas frame``; the columns of its one catalogue are those of ``sameas match``."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from sameas.cli.arguments import FORMATS
from sameas.cli.options import COLUMN_OPTIONS, one_of

_PLACE, _IMAGE, _FILES, _STARS = "Where it points", "The image", "Outputs", "The catalogue's columns"


def _option(*names: str, panel: str | None = None, **settings: Any) -> Any:
    return typer.Option(*names, rich_help_panel=panel, show_default=settings.pop("show_default", False), **settings)


Images = Annotated[
    list[Path], typer.Argument(metavar="IMAGE...", help="Frames: FITS, plain or packed (.fz, .gz).", show_default=False)
]
StarCatalogue = Annotated[
    str,
    _option(
        "--catalog",
        "-c",
        metavar="NAME",
        help="A table, a folder of Parquet (HATS), 'bright' (whole sky, G < 10, no network) or 'gaia' (online).",
    ),
]
Folder = Annotated[Path, _option("-o", "--output", metavar="FOLDER", show_default=True, help="Where the outputs go.")]
AimAt = Annotated[
    str | None,
    _option("--aim", panel=_PLACE, metavar="RA,DEC", help="Middle of the frame, degrees or 04:10:09,+22:50:22."),
]
OffBy = Annotated[float | None, _option("--radius", panel=_PLACE, metavar="DEG", help="How far off the aim may be.")]
Scale = Annotated[
    str | None, _option("--scale", panel=_PLACE, metavar="LO,HI", help="Arcsec per pixel, least and largest.")
]
NoHeader = Annotated[bool, _option("--ignore-header", panel=_PLACE, help="Do not believe the header's plate solution.")]
When = Annotated[
    str | None, _option("--time", panel=_IMAGE, metavar="DATE|YEAR", help="Middle of the exposure (UTC), or a year.")
]
Darks = Annotated[list[Path] | None, _option("--dark", panel=_IMAGE, metavar="FILE", help="Dark frames; repeat it.")]
Flats = Annotated[list[Path] | None, _option("--flat", panel=_IMAGE, metavar="FILE", help="Flat fields; repeat it.")]
Biases = Annotated[list[Path] | None, _option("--bias", panel=_IMAGE, metavar="FILE", help="Biases; repeat it.")]
Mask = Annotated[Path | None, _option("--mask", panel=_IMAGE, metavar="FILE", help="Image, not 0 where not usable.")]
Hdu = Annotated[str | None, _option("--hdu", panel=_IMAGE, metavar="HDU", help="Number or name of the extension.")]
Threshold = Annotated[
    float, _option("--threshold", panel=_IMAGE, metavar="SIGMAS", show_default=True, help="Faintest detection.")
]
Gain = Annotated[float | None, _option("--gain", panel=_IMAGE, metavar="E/ADU", help="Electrons per unit.")]
ReadNoise = Annotated[float | None, _option("--read-noise", panel=_IMAGE, metavar="E", help="Electrons.")]
Saturation = Annotated[
    float | None, _option("--saturation", panel=_IMAGE, metavar="ADU", help="Level of a full pixel.")
]
Brightness = Annotated[
    str,
    _option(
        "--magnitudes", metavar="auto|off", callback=one_of(("auto", "off")), help="Brightness as evidence, or not."
    ),
]
Order = Annotated[
    int | None,
    _option("--order", metavar="1…5", min=1, max=5, help="Of the plate model; else that of the least BIC."),
]
Faintest = Annotated[
    float | None, _option("--faintest", metavar="MAG", help="Use no fainter stars; else as faint as the frame shows.")
]
NoMotion = Annotated[bool, _option("--no-motion", help="Leave the stars at their own epoch, to see what motion does.")]
Brightest = Annotated[
    int,
    _option("--brightest", panel=_FILES, metavar="N", min=0, show_default=True, help="Stars marked in the pictures."),
]
TableFormat = Annotated[
    str, _option("--format", panel=_FILES, metavar="NAME", callback=one_of(FORMATS), help="Of the table of stars.")
]
WcsCopy = Annotated[bool, _option("--wcs-copy", panel=_FILES, help="Write a copy of the frame with the solution.")]
NoPage = Annotated[bool, _option("--no-page", panel=_FILES, help="Write no page (.html).")]
NoPicture = Annotated[bool, _option("--no-picture", panel=_FILES, help="Write no pictures (.png).")]
Processes = Annotated[
    int, _option("--processes", "-j", metavar="N", min=1, show_default=True, help="Frames at a time.")
]
Again = Annotated[bool, _option("--again", help="Do also what has been done with the same files and options.")]


def with_own_columns(command: Callable[..., None]) -> Callable[..., None]:
    """The command, its ``**columns`` spelled out as options of one catalogue, for typer to read."""
    written = inspect.signature(command, eval_str=True)
    kept = [p for p in written.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    spelled = [
        inspect.Parameter(
            option.parameter,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[
                option.kind | None,
                _option(f"--{option.name}", panel=_STARS, metavar=option.metavar, help=option.help),
            ],
        )
        for option in COLUMN_OPTIONS
    ]
    command.__signature__ = written.replace(parameters=[*kept, *spelled])  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in (*kept, *spelled)}
    return command
