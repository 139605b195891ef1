"""Requests: the sources and options of a match, which an output keeps so that it can be repeated."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from sameas.errors import InputError
from sameas.evidence import Column, Errors, OddsTable, Related
from sameas.front.options import COLUMN_OPTIONS, FILE_OPTIONS, SIDE_OPTIONS, fields_of, of_side, renamed
from sameas.front.tables import kind_of, table_of
from sameas.io import checksum
from sameas.kernels import threads
from sameas.representation import ORDINALS, in_short

if TYPE_CHECKING:
    from sameas.sky.catalogue import Catalogue
    from sameas.sky.crossmatch import MatchOptions
    from sameas.sky.internal import InternalOptions
    from sameas.sky.many import ManyOptions

Options = TypeVar("Options", bound="MatchOptions | ManyOptions | InternalOptions")


@in_short
@dataclass(frozen=True)
class Request(Generic[Options]):
    """The catalogues to be identified, with all options.

    sources : one or more paths, tables (see :func:`sameas.front.tables.table_of`) or catalogues.
    options : of the match.
    columns : options of the catalogues by parameter: ``sigma`` applies to all, ``sigma2`` to the second.
    given_names : the catalogues' names in messages, if given by the user.
    """

    sources: tuple[Any, ...]
    options: Options
    columns: Mapping[str, Any] = field(default_factory=dict)
    given_names: tuple[str, ...] = ()

    @property
    def paths(self) -> tuple[str, ...]:
        """The paths among the sources."""
        return tuple(source for source in self.sources if isinstance(source, str))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the catalogues in messages: as given; else file names, as short as they are distinct; "first",
        "second" for tables in memory."""
        if self.given_names:
            return self.given_names
        stems = self._named(stem_of)
        for names in (stems, self._named(lambda path: Path(path).name), self._named(str)):
            if len(set(names)) == len(names):
                return names
        return tuple(f"{stem} ({ordinal})" for stem, ordinal in zip(stems, ORDINALS, strict=False))

    def _named(self, of_path: Callable[[str], str]) -> tuple[str, ...]:
        def of(source: Any, ordinal: str) -> str:
            if isinstance(source, str):
                return of_path(source)
            return str(source.name) if _is_catalogue(source) else ordinal

        return tuple(map(of, self.sources, ORDINALS))

    def catalogue(self, side: int) -> Catalogue:
        """Catalogue 1, 2, …, read from its source.

        Raises InputError: not a table; refused by :meth:`~sameas.sky.catalogue.Catalogue.of`; column options for a
        source that is a ``Catalogue`` already.
        """
        from sameas.sky.catalogue import Catalogue

        source, name = self.sources[side - 1], self.names[side - 1]
        if isinstance(source, Catalogue):
            self._refuse_options(side, name)
            return source
        try:
            return read_catalogue(source, name, self.columns, side)
        except InputError as error:
            raise self.named(error, side) from error

    def catalogues(
        self, read: Callable[[int, Catalogue], None] = lambda side, catalogue: None, *, two_at_once: bool = False
    ) -> list[Catalogue]:
        """All catalogues.

        read : called with the number of each catalogue and the catalogue once it has been read, in order.
        two_at_once : read in two threads. Readers change the warnings filters of the process, so this is for processes
            that show no warnings.

        Raises InputError: as :meth:`catalogue`, with the errors of all catalogues in one message.
        """
        catalogues, refused = [], []
        for side, catalogue in enumerate(self._readers(two_at_once), 1):
            try:
                catalogues.append(catalogue())
            except InputError as error:
                refused.append(error)
                continue
            if not refused:
                read(side, catalogues[-1])
        if refused:
            raise InputError.together(refused)
        return catalogues

    def _readers(self, two_at_once: bool) -> Iterator[Callable[[], Catalogue]]:
        """For each catalogue a function that returns it; with ``two_at_once`` every second one is begun before."""
        sides = range(1, len(self.sources) + 1)
        for side in sides[::2] if two_at_once else ():
            ahead = [threads.started(partial(self.catalogue, following)) for following in sides[side : side + 1]]
            yield partial(self.catalogue, side)
            yield from ahead
        for side in () if two_at_once else sides:
            yield partial(self.catalogue, side)

    def _refuse_options(self, side: int, name: str) -> None:
        stated = [one.parameter for one in SIDE_OPTIONS if self.columns.get(f"{one.parameter}{side}") is not None]
        if stated:
            raise InputError(
                f"{name}: a Catalogue's columns are chosen already, so {stated[0]}{side} changes nothing",
                "give it in CatalogueOptions, or give the table",
            )

    def naming_sides(self, work: Callable[[], Any]) -> Any:
        """The result of ``work``. Its errors name the options of the catalogue that they concern (``sigma2``)."""
        try:
            return work()
        except InputError as error:
            side = self.names.index(error.source) + 1 if error.source in self.names else 0
            raise self.named(error, side) from error

    def named(self, error: InputError, side: int) -> InputError:
        """The error of one catalogue, with that catalogue's option names."""
        return InputError(self.words(error.words, side), source=error.source)

    def words(self, text: str, side: int = 0) -> str:
        """A message about one catalogue, or about all (side 0), with option names of this request."""
        return renamed(text, side, self.columns)

    def in_own_terms(self, words: Callable[[str], str], side: int, text: str) -> str:
        """:meth:`words`, then reworded by ``words``."""
        return words(self.words(text, side))

    @property
    def n_bytes(self) -> int:
        """Size of the files together."""
        return sum(os.path.getsize(path) for path in self.paths if os.path.isfile(path))

    @property
    def twice(self) -> str:
        """A warning if the first two sources are the same; else empty."""
        first, second = self.sources[:2]
        if isinstance(first, str) and isinstance(second, str):
            if os.path.exists(first) and os.path.exists(second) and os.path.samefile(first, second):
                return f"{first} is given twice: every record would match itself"
        elif first is second:
            return f"one {kind_of(first)} is given twice: every record would match itself"
        return ""

    def begin_checksums(self) -> None:
        """Compute the checksums of the files in threads, for :meth:`facts`."""
        for k, source in enumerate(self.sources):
            if isinstance(source, str) and os.path.isfile(source):  # a pipe can be read only once
                self._checksums[k] = threads.started(self._checksums[k])

    @cached_property
    def _checksums(self) -> list[Callable[[], str]]:
        """For each source a function that returns the checksum of its file."""
        return [partial(checksum, source) for source in self.sources]

    def facts(self) -> dict[str, Any]:
        """The request as flat provenance: absolute paths with checksums, options as JSON."""
        facts: dict[str, Any] = {}
        for k, source in enumerate(self.sources, 1):
            is_path = isinstance(source, str)
            facts[f"input_{k}"] = str(Path(source).resolve()) if is_path else f"{kind_of(source)} in memory"
            facts[f"sha256_{k}"] = self._checksums[k - 1]() if is_path else None
            for one in FILE_OPTIONS:
                facts[f"{one.name}_{k}"] = of_side(self.columns, one.parameter, k)
            facts[f"options_{k}"] = json.dumps(fields_of(self.columns, k), sort_keys=True)
        facts["options_match"] = json.dumps(asdict(self.options), sort_keys=True, default=_in_memory)
        return facts

    @staticmethod
    def of_facts(facts: Mapping[str, Any], output: str) -> Request[MatchOptions]:
        """The request of two catalogues from the provenance of an output file.

        Raises InputError: no provenance; an input no longer exists or has changed.
        """
        from sameas.sky.crossmatch import MatchOptions

        columns: dict[str, Any] = {}
        try:
            options = json.loads(facts["options_match"])
            if options["density_per_deg2"] is not None:
                options["density_per_deg2"] = tuple(options["density_per_deg2"])
            if isinstance(options["error_scale"], dict):
                held: dict[str, Any] = options["error_scale"]
                quoted: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in held.items()}
                options["error_scale"] = Errors(**quoted)
            options["evidence"] = tuple(map(_column_of, options.get("evidence", ())))
            for k in (1, 2):
                columns |= {f"{name}{k}": facts[f"{name}_{k}"] for name in ("format", "hdu")}
                fields = json.loads(facts[f"options_{k}"])
                columns |= {f"{one.parameter}{k}": fields[one.field] for one in COLUMN_OPTIONS if one.field in fields}
            request = Request((facts["input_1"], facts["input_2"]), MatchOptions(**options), columns)
        except (KeyError, TypeError, ValueError, AttributeError, RecursionError):
            raise InputError(f"{output}: has no provenance; give a table that `sameas match` wrote") from None
        for k, path in enumerate(request.paths, 1):
            if not os.path.isfile(path):  # a name may be too long for one
                raise InputError(f"{output}: was made from {path}, which no longer exists; restore it")
            if checksum(path) != facts.get(f"sha256_{k}"):
                raise InputError(
                    f"{output}: was made from {path}, which has changed since (another SHA-256); match again"
                )
        return request


def _in_memory(value: Any) -> Any:
    """JSON of a number given as a 0-dimensional array; null for other objects in memory."""
    return value.item() if hasattr(value, "item") and not getattr(value, "ndim", 0) else None


def _column_of(held: Mapping[str, Any]) -> Column | Related:
    if "first" in held:
        return Related(held["first"], held["second"], tuple(held["names"]))
    odds = None if held["odds"] is None else OddsTable(held["odds"]["rows"])
    return Column(held["source"], held["values"], odds, held["name"])


def stem_of(path: str) -> str:
    """The name of a file without its ending, also that of a compressed one."""
    return Path(path).name.removesuffix(".gz").rsplit(".", 1)[0]


def read_catalogue(source: Any, name: str, columns: Mapping[str, Any], side: int) -> Catalogue:
    """A catalogue from what holds its positions, with the options of a side; side 0 has those of all sides only.

    Raises InputError: as :func:`~sameas.front.tables.table_of` and :meth:`~sameas.sky.catalogue.Catalogue.of`.
    """
    from sameas.sky.catalogue import Catalogue, CatalogueOptions

    hdu, format = of_side(columns, "hdu", side), of_side(columns, "format", side)
    table = table_of(source, name, format=format, hdu=int(hdu) if str(hdu).isdigit() else hdu)
    return Catalogue.of(table, name, options=CatalogueOptions(**fields_of(columns, side)))


def _is_catalogue(source: object) -> bool:
    from sameas.sky.catalogue import Catalogue

    return isinstance(source, Catalogue)
