"""The commands by name. A command's module is imported, and its options are built, when it runs."""

from __future__ import annotations

import importlib
import inspect
import os
import shlex
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

import sameas
from sameas.cli.options import ellipses_split
from sameas.cli.peers import NO_RADIUS_NEEDED, NWAY, refuse_arguments_of_stilts
from sameas.front.options import RADIUS


class _AsTyped:
    """The value of an option without typer's validation if it is a text or a path; typer validates other types.

    typer 0.29 builds a pydantic validator for every option, given or not; importing pydantic takes a tenth of a short
    run. Texts and readable paths need no validation.
    """

    def __init__(self, kind: Any) -> None:
        self.kind = kind

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """The value that the command's function receives."""
        many = param.multiple or param.nargs == -1
        if value is None:
            return () if many else None
        if not many and isinstance(value, str):
            if self.kind is str:
                return value
            if self.kind is Path and (os.access(value, os.R_OK) or not os.path.lexists(value)):
                return Path(value)
        param._runtime_param = None
        return param.get_runtime_param().coerce(value, param=param, ctx=ctx)


def _as_typed(command: Any, ctx: Any) -> None:
    """Skip the validation of texts and paths in versions of typer that validate."""
    for parameter in command.get_params(ctx):
        if getattr(parameter, "_runtime_param", command) is None and hasattr(parameter, "type_descriptor"):
            parameter._runtime_param = _AsTyped(parameter.type_descriptor.annotation)


def _in_plain_words(parameter: Any) -> Any:
    """A parameter whose help has no Python types, and arguments as they are written.

    typer 0.29 prints ``<bool>`` beside every flag, ``<list[str]>`` beside the files, and ``{A} {B}`` for ``A B``.
    """
    is_argument = parameter.param_type_name == "argument"
    if is_argument:
        parameter.get_usage_pieces = lambda ctx: [parameter.metavar]
    if is_argument or parameter.is_flag:
        parameter.display_type_rich = lambda ctx: None
    return parameter


class _InPlainWords:
    """Part of a command or a group: the parameters in plain words."""

    def get_params(self, ctx: Any) -> list[Any]:
        return [_in_plain_words(one) for one in super().get_params(ctx)]  # type: ignore[misc]


class _Group(_InPlainWords, TyperGroup):
    """All commands."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        _as_typed(self, ctx)
        return super().parse_args(ctx, args)


app = typer.Typer(
    name="sameas",
    cls=_Group,
    help="Which records of two or more sources are the same object, and how sure that is.",
    epilog="Start with: sameas match A.fits B.fits -o OUT.fits, or sameas picture RADAR.csv AIS.nmea",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

#: The commands, each the function of its name in the module of its name, and the first sentence of its docstring.
COMMANDS = {
    "match": "Identify the records of two catalogues and join their tables.",
    "explain": "Explain a record's identification: its candidates, and what other answers would cost.",
    "compare": "Compare two outputs: which records were identified differently.",
    "many": "Identify the records of several catalogues at once and join their tables, one row per object.",
    "internal": "Find which rows of one table are the same object: detections on many exposures, duplicates.",
    "frame": "Identify the stars on frames with a catalogue: table, plate solution, regions, pictures and a page each.",
    "movers": "Find what moves: tracklets of detections, how sure each is, and each of its detections.",
    "picture": "One picture from many sensors: which record of each source is which ship or aircraft, "
    "and how sure that is.",
    "watch": "The picture live: which of the sensors' records are the same ship or aircraft, while it happens.",
}


#: Commands that use position errors instead of a radius.
_WITH_ERRORS = {"match", "many", "internal"}


class _Recorded(_InPlainWords, TyperCommand):
    """A command that records its arguments as typed, for provenance."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        _as_typed(self, ctx)
        ctx.meta["typed"] = shlex.join(["sameas", str(self.name), *args])
        if self.name in _WITH_ERRORS:
            refuse_arguments_of_stilts(args)
        try:
            return super().parse_args(ctx, ellipses_split(args))
        except Exception as error:
            unknown: Any = error
            name = getattr(unknown, "option_name", None) or ""
            instead = NO_RADIUS_NEEDED if name.strip("-").replace("-", "_") in RADIUS else NWAY.get(name)
            if self.name in _WITH_ERRORS and instead is not None:
                unknown.possibilities = None  # similar in letters only
                unknown.message = f"No such option: {name}. {instead}"
            raise


class _Lazy(TyperCommand):
    """A command with only a name and a help sentence; its options are built when it runs."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        return command_of(str(self.name)).make_context(info_name, args, parent, **extra)


@cache
def command_of(name: str) -> Any:
    """A command with its options."""
    alone = typer.Typer(add_completion=False)
    function = getattr(importlib.import_module(f"sameas.cli.{name}"), name)
    alone.command(name, cls=_Recorded, help=_unwrapped(function), no_args_is_help=name != "picture")(function)
    return typer.main.get_command(alone)


def _unwrapped(function: Any) -> str:
    """A docstring with each paragraph on one line: typer keeps the line breaks of all but the first."""
    return "\n\n".join(" ".join(part.split()) for part in (inspect.getdoc(function) or "").split("\n\n"))


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sameas {sameas.__version__}")
        raise typer.Exit


Version = Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")]


@app.callback()
def _sameas(version: Version = False) -> None:
    pass


def _placeholder() -> None:
    pass


for _name, _sentence in COMMANDS.items():
    app.command(_name, cls=_Lazy, help=_sentence)(_placeholder)


@app.command("formats")
def formats() -> None:
    """The file formats that are read and written, with their extensions."""
    from sameas.io import known_formats, written_formats

    written = written_formats()
    for name, extensions in known_formats().items():
        typer.echo(f"{name:10}  {' '.join(extensions)}{'' if name in written else '  (read only)'}")
