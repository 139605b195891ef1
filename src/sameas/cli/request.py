"""Requests: files and all that is said of them, enough to identify them again; kept in the output."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from sameas.cli.options import COLUMN_OPTIONS, fields_of, in_options, of_side, option_of
from sameas.cli.terminal import Pace, Printer
from sameas.errors import InputError
from sameas.io import checksum, read_table
from sameas.report.match import ORDINALS, catalogue_lines
from sameas.sky.catalogue import Catalogue, CatalogueOptions

if TYPE_CHECKING:
    from sameas.sky.crossmatch import MatchOptions
    from sameas.sky.many import ManyOptions


Options = TypeVar("Options", bound="MatchOptions | ManyOptions")


@dataclass(frozen=True)
class Request(Generic[Options]):
    """Which catalogues are identified, and how.

    paths : of two files or more. options : of the match. columns : options of the catalogues as they were typed,
    by parameter: ``sigma`` is that of all, ``sigma2`` that of the second.
    """

    paths: tuple[str, ...]
    options: Options
    columns: Mapping[str, Any] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The catalogues' names in messages: their files' stems, or more where these are not different."""
        stems = tuple(Path(path).name.removesuffix(".gz").rsplit(".", 1)[0] for path in self.paths)
        files = tuple(Path(path).name for path in self.paths)
        for names in (stems, files, self.paths):
            if len(set(names)) == len(names):
                return names
        return tuple(f"{stem} ({ordinal.lower()})" for stem, ordinal in zip(stems, ORDINALS, strict=False))

    def catalogue(self, side: int) -> Catalogue:
        """Catalogue 1, 2, …, read and understood."""
        hdu = of_side(self.columns, "hdu", side)
        try:
            table = read_table(
                self.paths[side - 1],
                format=of_side(self.columns, "format", side),
                hdu=int(hdu) if hdu is not None and hdu.isdigit() else hdu,
            )
            options = CatalogueOptions(**fields_of(self.columns, side))
            return Catalogue.of(table, self.names[side - 1], options=options)
        except InputError as error:
            raise InputError(self.in_options(error.words, side)) from error

    def catalogues(self, printer: Printer, pace: Pace) -> list[Catalogue]:
        """All catalogues, printed as soon as each is understood."""
        read = []
        for side, path in enumerate(self.paths, 1):
            pace(f"reading {path}")
            read.append(self.catalogue(side))
            pace.pause()
            printer([*catalogue_lines(read[-1], side, path, partial(self.in_options, side=side)), ""])
        return read

    def naming_sides(self, work: Callable[[], Any]) -> Any:
        """The result of ``work``; its refusals name the options of the catalogue that they are about."""
        try:
            return work()
        except InputError as error:
            side = self.names.index(error.source) + 1 if error.source in self.names else 0
            raise InputError(self.in_options(error.words, side)) from error

    def in_options(self, text: str, side: int) -> str:
        """A text on one catalogue, with that catalogue's own options."""
        return in_options(text, lambda argument: option_of(argument, side, self.columns))

    def facts(self) -> dict[str, Any]:
        """The request as flat provenance: absolute paths with their checksums, options as JSON."""
        facts: dict[str, Any] = {}
        for k, path in enumerate(self.paths, 1):
            facts[f"input_{k}"] = str(Path(path).resolve())
            facts[f"sha256_{k}"] = checksum(path)
            facts[f"format_{k}"], facts[f"hdu_{k}"] = (of_side(self.columns, name, k) for name in ("format", "hdu"))
            facts[f"options_{k}"] = json.dumps(fields_of(self.columns, k), sort_keys=True)
        facts["options_match"] = json.dumps(asdict(self.options), sort_keys=True)
        return facts

    @staticmethod
    def of_facts(facts: Mapping[str, Any], output: str) -> Request[MatchOptions]:
        """The request of two catalogues that provenance tells.

        Raises
        ------
        InputError : the file does not say how it was made; an input is gone or was changed.
        """
        from sameas.sky.crossmatch import MatchOptions

        columns: dict[str, Any] = {}
        try:
            options = json.loads(facts["options_match"])
            if options["density_per_deg2"] is not None:
                options["density_per_deg2"] = tuple(options["density_per_deg2"])
            for k in (1, 2):
                columns |= {f"{name}{k}": facts[f"{name}_{k}"] for name in ("format", "hdu")}
                fields = json.loads(facts[f"options_{k}"])
                columns |= {f"{one.parameter}{k}": fields[one.field] for one in COLUMN_OPTIONS if one.field in fields}
            request = Request((facts["input_1"], facts["input_2"]), MatchOptions(**options), columns)
        except (KeyError, TypeError, ValueError):
            raise InputError(
                f"{output}: does not say how it was made; give a table that `sameas match` wrote"
            ) from None
        for k, path in enumerate(request.paths, 1):
            if not Path(path).is_file():
                raise InputError(f"{output}: was made from {path}, which is not there any more; put it back")
            if checksum(path) != facts[f"sha256_{k}"]:
                raise InputError(
                    f"{output}: was made from {path}, which has changed since (another SHA-256); match again"
                )
        return request
