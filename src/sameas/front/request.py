"""Requests (the sources and options of a match) and provenance: how an output was made, so that it can be repeated.

Provenance is for people and for ``sameas explain``: flat mappings of plain values. Except for date and paths, they are
the same for the same inputs and options.
"""

from __future__ import annotations

import json
import math
import os
import platform
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import sameas
from sameas.errors import InputError
from sameas.evidence import Column, Errors, OddsTable, Related
from sameas.front.options import COLUMN_OPTIONS, FILE_OPTIONS, SIDE_OPTIONS, fields_of, of_side, renamed
from sameas.front.tables import kind_of, table_of
from sameas.io import checksum
from sameas.kernels import threads
from sameas.representation import ORDINALS, in_short

if TYPE_CHECKING:
    from sameas.estimate.result import Estimate
    from sameas.result import Identification
    from sameas.sky.catalogue import Catalogue
    from sameas.sky.crossmatch import MatchOptions, SkyMatch
    from sameas.sky.many import ManyMatch, ManyOptions
    from sameas.sky.systematics import Rotation

Options = TypeVar("Options", bound="MatchOptions | ManyOptions")


@in_short
@dataclass(frozen=True)
class Request(Generic[Options]):
    """The catalogues to be identified, with all options.

    Attributes
    ----------
    sources : two or more paths, tables (see :func:`sameas.front.tables.table_of`) or catalogues.
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

        Raises
        ------
        InputError : not a table; refused by :meth:`~sameas.sky.catalogue.Catalogue.of`; column options for a source
            that is a ``Catalogue`` already.
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

        Parameters
        ----------
        read : called with the number of each catalogue and the catalogue once it has been read, in order.
        two_at_once : read in two threads. Readers change the warnings filters of the process, so this is for processes
            that show no warnings.

        Raises
        ------
        InputError : as :meth:`catalogue`, with the errors of all catalogues in one message.
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

        Raises
        ------
        InputError : no provenance; an input no longer exists or has changed.
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

    Raises
    ------
    InputError : as :func:`~sameas.front.tables.table_of` and :meth:`~sameas.sky.catalogue.Catalogue.of`.
    """
    from sameas.sky.catalogue import Catalogue, CatalogueOptions

    hdu, format = of_side(columns, "hdu", side), of_side(columns, "format", side)
    table = table_of(source, name, format=format, hdu=int(hdu) if str(hdu).isdigit() else hdu)
    return Catalogue.of(table, name, options=CatalogueOptions(**fields_of(columns, side)))


def _is_catalogue(source: object) -> bool:
    from sameas.sky.catalogue import Catalogue

    return isinstance(source, Catalogue)


#: Names of the terms of the error model in an output.
ERROR_TERM_NAMES = {
    "factor_1": "error_factor_1",
    "factor_2": "error_factor_2",
    "both": "error_factor_both",
    "floor": "error_floor",
    "floor_instead": "error_floor_instead",
}


def program() -> dict[str, Any]:
    """Name and version of this program."""
    return {"program": "sameas", "version": sameas.__version__}


def made_by(command: str) -> dict[str, Any]:
    """Program, version and command."""
    return {**program(), "command": command}


def _made_now(command: str) -> dict[str, Any]:
    # SOURCE_DATE_EPOCH, if set, makes outputs reproducible byte for byte (reproducible-builds.org).
    given = os.environ.get("SOURCE_DATE_EPOCH", "")
    moment = datetime.fromtimestamp(int(given), UTC) if re.fullmatch(r"\d{1,10}", given) else datetime.now(UTC)
    now = moment.strftime("%Y-%m-%dT%H:%M:%SZ")
    return made_by(command) | {"date_utc": now, "python": platform.python_version()}


def of_match(
    request: Request[MatchOptions], match: SkyMatch, command: str, words: Callable[[str], str]
) -> dict[str, Any]:
    """Provenance of a match of two catalogues. words : rewords messages that name arguments."""
    from importlib.metadata import version

    import astropy
    import numpy

    from sameas.sky.joins import joined_names

    result, estimate = match.result, match.estimate
    area, density_1, density_2 = match.area_and_densities
    return {
        **_made_now(command),
        "numpy": numpy.__version__,
        "numba": version("numba"),  # without importing it
        "astropy": astropy.__version__,
        **request.facts(),
        "name_1": match.first.name,
        "name_2": match.second.name,
        **_roles((match.first, match.second), joined_names([match.first.table, match.second.table])),
        "rows_1": len(match.first),
        "rows_2": len(match.second),
        "used_1": len(result.first),
        "used_2": len(result.second),
        "epoch_1": match.first.epoch_jyr,
        "epoch_2": match.second.epoch_jyr,
        "common_epoch": match.epoch_jyr,
        "motion": match.moved,
        **_offset(match),
        "area_deg2": area,
        "density_1_per_deg2": density_1,
        "density_2_per_deg2": density_2,
        **_estimates(estimate),
        "evidence_error_floor_arcsec": estimate.errors.floor,
        "gate_sigmas": estimate.gate_sigmas,
        "rounds": estimate.iterations,
        "settled": estimate.converged,
        **_quantities(match),
        "error_note": (estimate.error_model.note or None) if estimate.error_model is not None else None,
        **_completeness(match),
        "candidates": len(result.pairs),
        "pairs": len(result.matches),
        "expected_wrong": result.expected_wrong,
        "doubts": [words(doubt) for doubt in match.doubts],
    }


def _estimates(estimate: Estimate) -> dict[str, Any]:
    """Estimates of two sources that have no unit."""
    return {
        "common_objects": estimate.common,
        "share_1": estimate.share_1,
        "share_2": estimate.share_2,
        "error_scales": list(estimate.spread.scales),
        "error_shares": list(estimate.spread.shares),
        "evidence_error_factor_1": estimate.errors.factor_1,
        "evidence_error_factor_2": estimate.errors.factor_2,
        **({"evidence_error_trends": trends} if (trends := _trends(estimate)) else {}),
    }


def _trends(estimate: Estimate) -> list[str]:
    """The quantities that errors grow with, in words."""
    scale = estimate.errors.typical_scale
    return [trend.words(f"source {trend.source + 1}", scale) for trend in estimate.trends]


def _roles(catalogues: Sequence[Catalogue], names: Sequence[Sequence[str]]) -> dict[str, Any]:
    """The columns of the joined table that hold id, position and magnitude of each catalogue; None if it has none.

    names : of each catalogue's columns in the joined table.
    """
    facts: dict[str, Any] = {}
    for k, (catalogue, joined) in enumerate(zip(catalogues, names, strict=True), 1):
        name_in_output = dict(zip(catalogue.table.colnames, joined, strict=True))
        choice = catalogue.choice
        numbered = any("rows are numbered" in line for line in catalogue.interpretation)
        roles = {"id": None if numbered else choice.id, "ra": choice.ra.name, "dec": choice.dec.name,
                 "magnitude": choice.magnitude}  # fmt: skip
        facts |= {f"{role}_column_{k}": None if name is None else name_in_output[name] for role, name in roles.items()}
    return facts


def of_records(result: Identification, estimate: Estimate, command: str) -> dict[str, Any]:
    """Provenance of a match of two ``Records``."""
    return {
        **_made_now(command),
        "name_1": result.first.source,
        "name_2": result.second.source,
        "rows_1": result.first.n_table,
        "rows_2": result.second.n_table,
        "used_1": len(result.first),
        "used_2": len(result.second),
        **_estimates(estimate),
        "evidence_error_floor": estimate.errors.floor,
        "gate_sigmas": estimate.gate_sigmas,
        "candidates": len(result.pairs),
        "pairs": len(result.matches),
        "expected_wrong": result.expected_wrong,
        "doubts": list(estimate.notes),
    }


def _offset(match: SkyMatch) -> dict[str, Any]:
    """The offset removed from the second catalogue: in words; east, north and rotation with errors, arcsec."""
    warp = {} if match.warp is None else {"offset_warp": str(match.warp), "offset_warp_order": match.warp.order}
    if match.rotation is None:
        return {"offset": None, **warp}
    return {f"offset{name}": value for name, value in _rotation_values(match.rotation).items()} | warp


def _rotation_values(rotation: Rotation) -> dict[str, Any]:
    """A rotation as plain values, by the suffix of their names."""
    return {
        "": str(rotation),
        "_centre_deg": list(rotation.centre_deg),
        "_arcsec": rotation.vector.tolist(),
        "_arcsec_error": rotation.standard_errors.tolist(),
    }


def _quantities(match: SkyMatch) -> dict[str, float]:
    """All estimates that have a standard error, with it."""
    estimate = match.estimate
    quantities = dict(estimate.quantities)
    if estimate.tail is not None:
        quantities["error_tail_share"] = estimate.tail.share
    if estimate.error_model is not None:
        quantities |= {ERROR_TERM_NAMES[name]: quantity for name, quantity in estimate.error_model.terms.items()}
    facts = {}
    for name, quantity in quantities.items():
        if math.isfinite(quantity.standard_error):
            facts[f"estimated_{name}"] = quantity.value
            facts[f"estimated_{name}_error"] = quantity.standard_error
    return facts


def of_many(
    request: Request[ManyOptions], match: ManyMatch, command: str, words: Callable[[str], str]
) -> dict[str, Any]:
    """Provenance of a match of several catalogues. words : rewords messages that name arguments."""
    from sameas.sky.joins import joined_names

    facts, given = _made_now(command), request.facts()
    for k, catalogue in enumerate(match.catalogues, 1):
        facts |= {name: given[name] for name in (f"input_{k}", f"sha256_{k}")}
        facts |= {f"name_{k}": catalogue.name, f"rows_{k}": len(catalogue), f"epoch_{k}": catalogue.epoch_jyr}
        facts[f"options_{k}"] = given[f"options_{k}"]
    facts |= _roles(match.catalogues, joined_names([catalogue.table for catalogue in match.catalogues]))
    facts |= {"options_match": given["options_match"], "epoch_object": match.epoch_jyr}
    for k, catalogue in enumerate(match.catalogues, 1):
        if catalogue.name in match.rotations:
            removed = _rotation_values(match.rotations[catalogue.name])
            facts |= {f"offset{name}_{k}": value for name, value in removed.items()}
    facts |= {f"expected_{'_'.join(names)}": expected for names, expected in match.expected.items()}
    doubts = [words(doubt) for doubt in match.doubts]
    return facts | {"objects": len(match.objects), "rounds": match.iterations, "doubts": doubts}


def _completeness(match: SkyMatch) -> dict[str, Any]:
    """By magnitude: the share of each catalogue that the other one detects, and the density of undetected objects."""
    from sameas.sky.crossmatch import ARCSEC2_PER_DEG2

    facts: dict[str, Any] = {}
    for side, curve in ((1, match.estimate.detection_1), (2, match.estimate.detection_2)):
        if curve is not None:
            facts |= {
                f"completeness_{side}_band": curve.band,
                f"completeness_{side}_edges_mag": curve.edges.tolist(),
                f"completeness_{side}": curve.probability.tolist(),
                f"completeness_{side}_error": curve.standard_error.tolist(),
                f"density_only_{side}_per_deg2_mag": (ARCSEC2_PER_DEG2 * curve.density).tolist(),
                f"density_only_{side}_per_deg2_mag_error": (ARCSEC2_PER_DEG2 * curve.density_error).tolist(),
            }
    return facts
