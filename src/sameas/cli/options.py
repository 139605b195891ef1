"""Options shared by several commands, and the translation of the library's arguments into options.

Options of catalogues are declared in :mod:`sameas.front.options`; options of a single command are in its signature.
"""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from sameas.errors import Argument, Message
from sameas.front.options import COLUMN_OPTIONS, SIDE_OPTIONS, ColumnOption, replace_keywords

_QUOTES = "'"


def _parameter(one: ColumnOption, side: str, panel: str, hidden: bool) -> inspect.Parameter:
    """The typer parameter of an option of catalogue ``side`` (a number), or of all catalogues (empty)."""
    declared = option(
        f"--{one.name}{side}", panel=panel, metavar=one.metavar or None, help="" if side else one.help, hidden=hidden
    )
    return inspect.Parameter(
        one.parameter + side,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[one.kind | None, declared],
    )


def option(*names: str, panel: str | None = None, show_default: bool = False, **settings: Any) -> Any:
    """A typer option."""
    return typer.Option(*names, rich_help_panel=panel, show_default=show_default, **settings)


def with_columns(
    panels: Mapping[str, str], options: Sequence[ColumnOption] = COLUMN_OPTIONS, *, numbered_hidden: bool = False
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator that replaces a command's ``**columns`` by the options of catalogues.

    panels : title of the options' panel by the number of the catalogue; "" for all catalogues.
    """

    def with_signature(command: Callable[..., None]) -> Callable[..., None]:
        of_catalogues = [
            _parameter(one, side, panel, numbered_hidden and side != "")
            for side, panel in panels.items()
            for one in options
        ]
        replace_keywords(command, of_catalogues, eval_str=True)
        command.__annotations__ = {p.name: p.annotation for p in inspect.signature(command).parameters.values()}
        return command

    return with_signature


def option_of(argument: Argument) -> str:
    """The option of an argument, with its value."""
    known = next((one for one in SIDE_OPTIONS if one.field == argument.name), None)
    name = argument.name.replace("_", "-") if known is None else known.name
    return f"--{name} {argument.value.strip(_QUOTES)}".rstrip()


#: Options of ``sameas frame`` that are named differently from the arguments.
_OF_FRAME = {
    "epoch_jyr": "--time DATE", "cone": "--aim", "catalogue": "--catalog bright", "format": "its format",
    "gain_e_per_adu": "--gain", "read_noise_e": "--read-noise", "saturation_adu": "--saturation",
    "threshold_sigmas": "--threshold",
}  # fmt: skip


def frame_option(argument: Argument) -> str:
    """The option of ``sameas frame`` for an argument."""
    return _OF_FRAME.get(argument.name) or option_of(argument)


def mover_option(argument: Argument) -> str:
    """The option of ``sameas movers`` for an argument about tables."""
    return "--exposure NAME" if argument.name == "frame" else option_of(argument)


_OF_PICTURE = {
    "read_source_options": "--sensors", "at": "--at", "begin": "--from", "end": "--to", "every": "--every",
    "within": "--within", "without": "--without",
}  # fmt: skip


def sensor_option(argument: Argument) -> str:
    """The option of ``sameas picture`` for an argument; most arguments are keys of the ``--sensors`` file."""
    option = _OF_PICTURE.get(argument.name)
    if argument.name in ("columns", "units"):
        return f"file = {{ {argument.table} }} in its table [sources.NAME] of the --sensors file"
    return str(argument) if option is None else f"{option} {argument.value}".rstrip()


def in_options(text: str, option: Callable[[Argument], str] = option_of) -> str:
    """A message of the library with options in place of arguments."""
    return text.with_options(option) if isinstance(text, Message) else text


def one_of(names: Sequence[str] | Callable[[], Sequence[str]]) -> Callable[[str | None], str | None]:
    """A check that an option has one of these values; the error suggests similar ones."""

    def check(value: str | None) -> str | None:
        if value is None:
            return None
        known = names() if callable(names) else names
        if value in known:
            return value
        close = difflib.get_close_matches(value.lower(), known, n=2, cutoff=0.5)
        hint = f"did you mean {' or '.join(close)}? It" if close else "it"
        raise typer.BadParameter(f"{value!r} is not known; {hint} is one of {', '.join(known)}.")

    return check


def _format_names() -> Sequence[str]:
    from sameas.io import known_formats

    return tuple(known_formats())


known_format = one_of(_format_names)


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


# Options of several commands.

THE_MATCH, FILES = "The match", "Files"
Output = Annotated[
    Path | None, option("-o", "--output", metavar="OUT", help="The joined table; its format is that of the extension.")
]
ToEpoch = Annotated[float | None, option(
    "--to-epoch", panel=THE_MATCH, metavar="YEAR", help="Common epoch that both catalogues are moved to.",
)]  # fmt: skip
GateSigmas = Annotated[float | None, option(
    "--gate-sigmas", panel=THE_MATCH, metavar="K",
    help="Radius of the gate in quoted σ; by default from the estimated errors.",
)]  # fmt: skip
ErrorScale = Annotated[str, option(
    "--error-scale", panel=THE_MATCH, metavar="auto|FACTOR", show_default=True,
    help="Factor on the quoted errors: estimated, or given; 1 takes them as quoted.",
)]  # fmt: skip
Overwrite = Annotated[
    bool, option("--overwrite/--no-overwrite", panel=FILES, show_default=True, help="Whether OUT may exist already.")
]
OutFormat = Annotated[
    str | None, option("--out-format", metavar="NAME", callback=known_format, help="Format of OUT, as --format.")
]
DryRun = Annotated[
    bool, option("--dry-run", show_default=True, help="Print how the catalogues are read; match and write nothing.")
]
Quiet = Annotated[bool, option("--quiet", "-q", show_default=True, help="Print only doubts and errors.")]
Debug = Annotated[bool, option("--debug", show_default=True, help="Show the traceback of an error.")]
Folder = Annotated[Path, option("-o", "--output", metavar="FOLDER", show_default=True, help="Output folder.")]
