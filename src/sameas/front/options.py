"""Options of catalogues, declared once for Python's keyword arguments and for the command line.

``sigma`` applies to all catalogues, ``sigma1`` to the first and ``sigma2`` to the second; a numbered option overrides
the general one. The command line writes ``--sigma1``, with dashes for underscores.
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sameas.errors import Argument, InputError, Message

_THREE = tuple[str, str, str]


@dataclass(frozen=True)
class ColumnOption:
    """An option of a catalogue.

    name : without leading dashes. field : of ``CatalogueOptions``. unit : to which quantities are converted; empty for
    options that take no quantity.
    """

    name: str
    field: str
    metavar: str
    help: str
    kind: Any = str
    unit: str = ""

    @property
    def parameter(self) -> str:
        """The name as a parameter of a function."""
        return self.name.replace("-", "_")


COLUMN_OPTIONS = (
    ColumnOption("ra", "ra", "NAME", "Column of right ascension."),
    ColumnOption("dec", "dec", "NAME", "Column of declination."),
    ColumnOption("id", "id", "NAME", "Column of identifiers; they must be unique."),
    ColumnOption(
        "sigma", "sigma", "NUMBER|NAME|E,N", "Position error, 1σ per axis: a number or columns.", str, "arcsec"
    ),
    ColumnOption("sigma-unit", "sigma_unit", "UNIT", "Unit of the error: arcsec, mas, deg."),
    ColumnOption("ellipse", "ellipse", "A B PA", "Columns: 1σ semi-axes, angle of A east of north.", _THREE),
    ColumnOption("correlation", "correlation", "NAME", "Column: correlation of east and north errors."),
    ColumnOption("epoch", "epoch", "YEAR|DATE|NAME", "Epoch of the positions, or the column of it.", str, "yr"),
    ColumnOption("pm", "pm", "E,N|none", "Columns of proper motion, east with cos(dec)."),
    ColumnOption(
        "pm-sigma", "pm_sigma_mas_per_yr", "MAS/YR", "Error of proper motions that state none.", float, "mas / yr"
    ),
    ColumnOption("parallax", "parallax", "NAME|none", "Column of parallax."),
    ColumnOption("radial-velocity", "radial_velocity", "NAME|none", "Column of radial velocity."),
    ColumnOption("magnitude", "magnitude", "NAME|none", "Column of a magnitude."),
    ColumnOption("sigma-floor", "sigma_floor_arcsec", "ARCSEC", "Quadratically added to the errors.", float, "arcsec"),
    ColumnOption(
        "fill-errors", "fill_errors", "", "Give rows without an error the typical error of their magnitude.", bool
    ),
    ColumnOption(
        "missing-pm", "missing_pm_mas_per_yr", "MAS/YR", "Spread of unknown proper motions, 1σ.", float, "mas / yr"
    ),
)
FILE_OPTIONS = (
    ColumnOption("format", "format", "NAME", "Format of the file; by default by its extension."),
    ColumnOption("hdu", "hdu", "HDU", "Number or name of the FITS extension."),
)
SIDE_OPTIONS = (*COLUMN_OPTIONS, *FILE_OPTIONS)
#: Largest number of catalogues, that of ``sameas.sky.many``; each has options of its own.
MOST = 12


def refuse_numbers(n: int, prefix: str = "") -> None:
    """Refuse one catalogue, and more than can be matched at once."""
    if not 2 <= n <= MOST:
        from sameas.representation import counted

        why = ": with more, combinations are too many; match their objects with the others afterwards" if n > 1 else ""
        raise InputError(f"{prefix}{counted(n, 'catalogue')} given", f"give two to {MOST}{why}")


def of_side(columns: Mapping[str, Any], parameter: str, side: int) -> Any:
    """The value for catalogue 1, 2, …: its own, else the general one."""
    own = columns.get(f"{parameter}{side}")
    return columns.get(parameter) if own is None else own


def fields_of(columns: Mapping[str, Any], side: int) -> dict[str, Any]:
    """The fields of ``CatalogueOptions`` that the user gave for catalogue 1, 2, …."""
    values = {one: of_side(columns, one.parameter, side) for one in COLUMN_OPTIONS}
    return {one.field: _plain(value, one) for one, value in values.items() if value is not None}


def _plain(value: Any, option: ColumnOption) -> Any:
    """A value for provenance: lists joined by commas, quantities and times as numbers in the option's unit."""
    if getattr(value, "shape", ()):
        message = Message(Argument(option.parameter), f" has {len(value)} values, one for a row")
        raise InputError(message, "make them a column of the table, and give its name")
    if isinstance(value, tuple | list):
        return ",".join(map(str, value))
    if option.unit and hasattr(value, "to_value"):
        return float(value.to_value("jyear" if hasattr(value, "jyear") else option.unit))
    return value


def renamed(text: str, side: int, columns: Mapping[str, Any]) -> str:
    """A message about one catalogue, or about all (side 0), with parameters in place of fields."""
    if not isinstance(text, Message):
        return text

    def parameter(argument: Argument) -> Argument:
        known = next((one for one in SIDE_OPTIONS if one.field == argument.name), None)
        if known is None:
            return argument
        of_one = side and columns.get(known.parameter) is None
        return Argument(f"{known.parameter}{side if of_one else ''}", argument.value)

    return Message(*(parameter(part) if isinstance(part, Argument) else part for part in text.parts))


#: Names of the search radius in other programs.
RADIUS = {
    "radius", "within", "max_sep", "max_error", "separation", "seplimit", "tolerance", "match_radius", "radius_arcsec",
}  # fmt: skip
#: Why there is none here.
NO_RADIUS = (
    "how far to look follows from the errors of the positions; where the tables do not state these, they are estimated"
)


#: Options of the command for evidence, and the argument of the call.
EVIDENCE = {
    "column1": 'evidence=Column(1, "NAME")', "column2": 'evidence=Column(2, "NAME")',
    "relation": 'evidence=Related("NAME1", "NAME2")',
}  # fmt: skip


def refuse_unknown(given: Iterable[str], known: Sequence[str], call: str) -> None:
    """Refuse unknown keyword arguments, with suggestions of similar names."""
    for name in given:
        if name not in known:
            if name in RADIUS and "sigma" in known:
                raise InputError(
                    f"{call} has no option {name!r}, for it needs none: {NO_RADIUS}",
                    "give sigma=ARCSEC, or choose from the pairs by their sep_arcsec",
                )
            if name in EVIDENCE and "evidence" in known:
                raise InputError(f"{call} has no option {name!r}", f"give {EVIDENCE[name]}, of sameas.evidence")
            close = difflib.get_close_matches(name.lower(), known, n=3, cutoff=0.6)
            hint = f"did you mean {' or '.join(close)}?" if close else "see its documentation for those that it has"
            raise InputError(f"{call} has no option {name!r}", hint)


def side_parameters(sides: int) -> list[str]:
    """Option names of this many catalogues: ``ra``, ``ra1``, ``ra2``, …."""
    return [f"{one.parameter}{side or ''}" for side in range(sides + 1) for one in SIDE_OPTIONS]


def replace_keywords(
    function: Callable[..., Any], parameters: Sequence[inspect.Parameter], *, eval_str: bool = False
) -> None:
    """Puts keyword parameters into the signature of a function in place of its ``**keywords``.

    eval_str : whether annotations are evaluated, as by ``inspect.signature``.
    """
    written = inspect.signature(function, eval_str=eval_str)
    kept = [p for p in written.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    function.__signature__ = written.replace(parameters=[*kept, *parameters])  # type: ignore[attr-defined]


def with_side_options(sides: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator that adds the options of this many catalogues to the signature of a function with ``**columns``."""

    def with_signature(function: Callable[..., Any]) -> Callable[..., Any]:
        names = side_parameters(sides)
        replace_keywords(function, [inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY, default=None) for n in names])
        return function

    return with_signature
