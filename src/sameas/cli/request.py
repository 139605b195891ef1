"""Requests: two files and all that is said of them, enough to do a match again; kept in the output."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.cli.options import in_options, option_of
from sameas.errors import InputError
from sameas.io import checksum, read_table
from sameas.sky.bands import AUTO, OFF
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import MatchOptions, SkyMatch, match

if TYPE_CHECKING:
    from astropy.table import Table


@dataclass(frozen=True)
class Request:
    """What is to be matched, and how. Pairs speak of the first and the second catalogue.

    columns : fields of ``CatalogueOptions``. said : the options as they were typed, for messages.
    """

    paths: tuple[str, str]
    formats: tuple[str | None, str | None] = (None, None)
    hdus: tuple[str | None, str | None] = (None, None)
    columns: tuple[dict[str, Any], dict[str, Any]] = field(default_factory=lambda: ({}, {}))
    options: MatchOptions = field(default_factory=MatchOptions)
    said: Mapping[str, Any] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, str]:
        """The catalogues' names in messages: their files' stems, or more where these are the same."""
        stems = tuple(Path(path).name.removesuffix(".gz").rsplit(".", 1)[0] for path in self.paths)
        files = tuple(Path(path).name for path in self.paths)
        for one, two in (stems, files, self.paths):
            if one != two:
                return one, two
        return f"{stems[0]} (first)", f"{stems[1]} (second)"

    def catalogue(self, side: int) -> Catalogue:
        """Catalogue 1 or 2, read and understood."""
        with_options = CatalogueOptions(**self.columns[side - 1])
        table = self._table(side)
        try:
            return Catalogue.of(table, self.names[side - 1], options=with_options)
        except InputError as error:
            raise InputError(self.in_options(error.words, side)) from error

    def match(self, first: Catalogue, second: Catalogue, progress: Callable[[str], None]) -> SkyMatch:
        """Both catalogues identified."""
        return self.saying_sides(lambda: match(first, second, self.options, progress=progress))

    def saying_sides(self, work: Callable[[], Any]) -> Any:
        """The result of ``work``; its refusals name the options of the catalogue that they speak of."""
        try:
            return work()
        except InputError as error:
            side = self.names.index(error.source) + 1 if error.source in self.names else 0
            raise InputError(self.in_options(error.words, side)) from error

    def in_options(self, text: str, side: int) -> str:
        """A text on one catalogue, with that catalogue's own options."""
        return in_options(text, lambda argument: option_of(argument, side, self.said))

    def _table(self, side: int) -> Table:
        hdu: str | int | None = self.hdus[side - 1]
        if isinstance(hdu, str) and hdu.isdigit():
            hdu = int(hdu)
        try:
            return read_table(self.paths[side - 1], format=self.formats[side - 1], hdu=hdu)
        except InputError as error:
            raise InputError(self.in_options(error.words, side)) from error

    def facts(self) -> dict[str, Any]:
        """The request as flat provenance: absolute paths with their checksums, options as JSON."""
        facts: dict[str, Any] = {}
        for k in (1, 2):
            path = Path(self.paths[k - 1])
            facts[f"input_{k}"] = str(path.resolve())
            facts[f"sha256_{k}"] = checksum(path)
            facts[f"format_{k}"], facts[f"hdu_{k}"] = self.formats[k - 1], self.hdus[k - 1]
            facts[f"options_{k}"] = json.dumps(self.columns[k - 1], sort_keys=True)
        facts["options_match"] = json.dumps(asdict(self.options), sort_keys=True)
        return facts

    @classmethod
    def of_facts(cls, facts: Mapping[str, Any], output: str) -> Request:
        """The request that provenance tells.

        Raises
        ------
        InputError : the file does not say how it was made; an input is gone or was changed.
        """
        try:
            said = json.loads(facts["options_match"])
            if said["density_per_deg2"] is not None:
                said["density_per_deg2"] = tuple(said["density_per_deg2"])
            request = cls(
                (facts["input_1"], facts["input_2"]),
                (facts["format_1"], facts["format_2"]),
                (facts["hdu_1"], facts["hdu_2"]),
                (json.loads(facts["options_1"]), json.loads(facts["options_2"])),
                MatchOptions(**said),
            )
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


def match_options(
    to_epoch: float | None,
    gate_sigmas: float | None,
    error_scale: str,
    density: str | None,
    magnitudes: str,
    offset: str,
    precision: bool,
) -> MatchOptions:
    """The options of the match, refused at once where they make no sense."""
    options = MatchOptions(
        to_epoch, gate_sigmas, error_scale, magnitudes=magnitudes, offset=offset, precision=precision
    )
    if density is not None:
        try:
            one, two = (float(part) for part in density.split(","))
        except ValueError:
            raise InputError(
                f"--density {density}: give two numbers N1,N2, records per square degree of either catalogue"
            ) from None
        options = replace(options, density_per_deg2=(one, two))
    if magnitudes not in (AUTO, OFF) and magnitudes.count(":") != 1:
        raise InputError(f"--magnitudes {magnitudes}: give auto, off, or columns of both catalogues, A,…:B,…")
    for check in (options.errors, options.gate, options.density):
        check()
    return options
