"""Options of the columns: one small table, from which every catalogue gets the same options.

``--ra`` speaks of both catalogues, ``--ra1`` of the first and ``--ra2`` of the second; the last two win.
"""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from sameas.errors import Argument, Message

_THREE = tuple[str, str, str]
_QUOTES = "'"


@dataclass(frozen=True)
class ColumnOption:
    """An option of a catalogue: its name without dashes, the field of ``CatalogueOptions``, what it takes."""

    name: str
    field: str
    metavar: str
    help: str
    kind: Any = str

    @property
    def parameter(self) -> str:
        """The name as a parameter of a function."""
        return self.name.replace("-", "_")


COLUMN_OPTIONS = (
    ColumnOption("ra", "ra", "NAME", "Column of right ascension."),
    ColumnOption("dec", "dec", "NAME", "Column of declination."),
    ColumnOption("id", "id", "NAME", "Column of identifiers; they must be unique."),
    ColumnOption("sigma", "sigma", "NUMBER|NAME|E,N", "Position error, 1σ per axis: a number or columns."),
    ColumnOption("sigma-unit", "sigma_unit", "UNIT", "Unit of the error: arcsec, mas, deg."),
    ColumnOption("ellipse", "ellipse", "A B PA", "Columns: 1σ semi-axes, angle of A east of north.", _THREE),
    ColumnOption("correlation", "correlation", "NAME", "Column: correlation of east and north errors."),
    ColumnOption("epoch", "epoch", "YEAR|DATE|NAME", "Epoch of the positions, or the column of it."),
    ColumnOption("pm", "pm", "E,N|none", "Columns of proper motion, east with cos(dec)."),
    ColumnOption("pm-sigma", "pm_sigma_mas_per_yr", "MAS/YR", "Error of proper motions without one.", float),
    ColumnOption("parallax", "parallax", "NAME|none", "Column of parallax."),
    ColumnOption("radial-velocity", "radial_velocity", "NAME|none", "Column of radial velocity."),
    ColumnOption("magnitude", "magnitude", "NAME|none", "Column of a magnitude."),
    ColumnOption("sigma-floor", "sigma_floor_arcsec", "ARCSEC", "Quadratically added to the errors.", float),
    ColumnOption("missing-pm", "missing_pm_mas_per_yr", "MAS/YR", "Spread of unknown proper motions, 1σ.", float),
)

FILE_OPTIONS = (
    ColumnOption("format", "format", "NAME", "Format of a file whose extension does not tell it."),
    ColumnOption("hdu", "hdu", "HDU", "Number or name of the FITS extension."),
)

PANELS = {"": "Columns of both catalogues", "1": "First catalogue alone", "2": "Second catalogue alone"}


def with_columns(command: Callable[..., None]) -> Callable[..., None]:
    """The command, its ``**columns`` spelled out as the options of the table, for typer to read."""
    written = inspect.signature(command, eval_str=True)
    kept = [p for p in written.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    spelled = [_parameter(option, side) for side in PANELS for option in COLUMN_OPTIONS]
    command.__signature__ = written.replace(parameters=[*kept, *spelled])  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in (*kept, *spelled)}
    return command


def _parameter(option: ColumnOption, side: str) -> inspect.Parameter:
    said = typer.Option(
        f"--{option.name}{side}",
        metavar=option.metavar,
        help=option.help if not side else "",
        rich_help_panel=PANELS[side],
        show_default=False,
    )
    return inspect.Parameter(
        option.parameter + side,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[option.kind | None, said],
    )


def fields_of(columns: Mapping[str, Any], side: int) -> dict[str, Any]:
    """The fields of ``CatalogueOptions`` that the user said of catalogue 1 or 2."""
    fields = {}
    for option in COLUMN_OPTIONS:
        said = columns.get(f"{option.parameter}{side}")
        if said is None:
            said = columns.get(option.parameter)
        if said is not None:
            fields[option.field] = ",".join(said) if isinstance(said, tuple) else said
    return fields


def option_of(argument: Argument, side: int = 0, columns: Mapping[str, Any] | None = None) -> str:
    """The option of an argument, with what to give it: that of catalogue ``side``, unless it was said of all."""
    known = next((option for option in (*COLUMN_OPTIONS, *FILE_OPTIONS) if option.field == argument.name), None)
    name = argument.name.replace("_", "-") if known is None else known.name
    of_one = side and known is not None and (columns or {}).get(known.parameter) is None
    return f"--{name}{side if of_one else ''} {argument.value.strip(_QUOTES)}".rstrip()


#: What ``sameas frame`` has for arguments whose name is not that of its option.
_OF_FRAME = {"epoch_jyr": "--time DATE", "cone": "--aim", "catalogue": "--catalog bright", "format": "its format"}


def frame_option(argument: Argument) -> str:
    """The option of ``sameas frame`` for an argument."""
    return _OF_FRAME.get(argument.name) or option_of(argument)


def sensor_option(argument: Argument) -> str:
    """The option of ``sameas picture`` for an argument; most are names in the file of ``--sensors``."""
    return "--sensors" if argument.name == "read_told" else str(argument)


def in_options(text: str, option: Callable[[Argument], str] = option_of) -> str:
    """A text of the library as the command line has it: arguments are options."""
    return text.with_options(option) if isinstance(text, Message) else text


def one_of(names: Sequence[str]) -> Callable[[str | None], str | None]:
    """A check that an option has one of these values, which tells what was probably meant."""

    def check(value: str | None) -> str | None:
        if value is None or value in names:
            return value
        close = difflib.get_close_matches(value.lower(), names, n=2, cutoff=0.5)
        hint = f"did you mean {' or '.join(close)}? " if close else ""
        raise typer.BadParameter(f"{value!r} is not known; {hint}It is one of {', '.join(names)}.")

    return check


def ellipses_split(arguments: Sequence[str]) -> list[str]:
    """The arguments with ``--ellipse A,B,PA`` written as ``--ellipse A B PA``."""
    result: list[str] = []
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if re.fullmatch(r"--ellipse[12]?", name) and equals:
            result += [name, *value.split(",")]
        elif result and re.fullmatch(r"--ellipse[12]?", result[-1]) and argument.count(",") == 2:
            result += argument.split(",")
        else:
            result.append(argument)
    return result
