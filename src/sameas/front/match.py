"""``sameas.match(a, b)``: crossmatch two sources with everything estimated from the data.

:func:`match` reads both sources, chooses their columns and identifies them; the :class:`Match` that it returns gives
tables, reports, explanations and plots. The command ``sameas match`` does the same with files.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from sameas.errors import InputError
from sameas.evidence import Column, Errors, Related
from sameas.front.options import refuse_unknown, side_parameters, with_side_options
from sameas.front.partitioned import PartitionedMatch, both_hats
from sameas.front.tables import kind_of
from sameas.records import Records
from sameas.report.prose import DOUBT, Lines, Result, expected, in_one

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

    from sameas.estimate.result import Estimate
    from sameas.evidence import Magnitudes
    from sameas.front.request import Request
    from sameas.result import Explanation, Identification
    from sameas.sky.catalogue import Catalogue
    from sameas.sky.crossmatch import MatchOptions
    from sameas.sky.joins import JoinedTable
    from sameas.sky.sky_match import SkyMatch

#: The plots of a match of catalogues; the first is the default.
PLOTS = ("residuals", "normalised", "scatter", "certainty", "brightness", "ambiguous")


@dataclass(frozen=True, repr=False)
class Match(Result):
    """The result of :func:`match`. ``len(match)`` is the number of identified pairs.

    Attributes
    ----------
    identification : the result of the core: all candidates with their probabilities, groups, evidence term by term.
    estimate : the estimated parameters: number of common objects, errors, densities, magnitude relations.
    sky : both catalogues with their motions; None for a match of ``Records``, which have no columns.
    join, nway_columns : options of :attr:`table`.
    request : the sources and options, which :meth:`write` records in the output.
    notes : warnings about the input. call : the Python call, for the output's provenance.
    """

    _offers = ".table .joined('1or2') .pairs .report() .explain(id) .plot() .write(path)"

    identification: Identification
    estimate: Estimate
    sky: SkyMatch | None = None
    join: str = "all1"
    nway_columns: bool = False
    request: Request[MatchOptions] | None = None
    notes: tuple[str, ...] = ()
    call: str = ""

    def __len__(self) -> int:
        return len(self.identification.matches)

    @property
    def names(self) -> tuple[str, str]:
        """The sources' names."""
        return self.identification.first.source, self.identification.second.source

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings about the input and the result, one sentence each."""
        if self.sky is None:
            return (*self.notes, *self.estimate.notes)
        words = (lambda doubt, side: doubt) if self.request is None else self.request.words
        sides = enumerate((self.sky.first, self.sky.second), 1)
        of_input = (words(doubt, side) for side, catalogue in sides for doubt in catalogue.named_doubts)
        return (*self.notes, *of_input, *self.sky.doubts)

    @property
    def expected_wrong(self) -> float:
        """Expected number of wrong pairs among the identified ones."""
        return self.identification.expected_wrong

    @property
    def expected_missed(self) -> float:
        """Expected number of true pairs among the candidates that were not identified."""
        return self.identification.expected_missed

    @cached_property
    def pairs(self) -> Table:
        """The identified pairs, sorted by row of the first source: ``row_1``, ``row_2``, ``id_1``, ``id_2``,
        ``p_match``, separation, ``mahalanobis`` and ``log_odds``."""
        from sameas.sky.joins import pair_table

        return pair_table(self.identification)

    def blends(self, resolution: float, *, flux: Any = None) -> Table:
        """Records of the first source that are blends of two objects of the second.

        The table has one row for each record of the first source: ``row_1``, ``id_1``; the most probable partner,
        ``row_2`` and ``id_2``, and the second one of a blend, ``row_2b`` and ``id_2b`` (masked if there is none);
        ``p_match``, the probability of this answer; ``p_blend``, the probability that the record is any blend. Uses
        the errors of :attr:`estimate`, no magnitudes and no other columns.

        Parameters
        ----------
        resolution : separation at which half of the couples are blended in the first source; arcsec on the sky.
        flux : (n,) flux of every row of the second source in the band of the first. A blend then lies at the centre of
            light of its two objects, otherwise anywhere between them.

        Raises
        ------
        InputError : a resolution that is not positive, or far above the spacing of the objects; a flux array of the
            wrong length.
        """
        import numpy as np

        from sameas.estimate.blends import find_blends
        from sameas.sky.joins import blend_table

        first, second = self.identification.first, self.identification.second
        if flux is not None:
            flux = np.asarray(flux, np.float64)
            if flux.shape != (second.n_table,):
                raise InputError(f"blends: fluxes of shape {flux.shape}; give one for each of {second.n_table} rows")
            flux = flux[second.rows]
        errors, coverage = self.estimate.errors, self.estimate.coverage
        blends = find_blends(first, second, resolution, errors=errors, flux=flux, coverage=coverage)
        return blend_table(first, second, blends)

    @cached_property
    def table(self) -> Table:
        """The joined table of :attr:`join`: all columns of both sources and the result columns; see :meth:`joined`."""
        return self.joined(self.join, nway_columns=self.nway_columns)

    def joined(self, join: str = "all1", *, nway_columns: bool = False) -> Table:
        """The joined table of any join.

        Parameters
        ----------
        join : named as in STILTS: all1, 1and2, all2, 1or2, 1not2, 2not1, 1xor2; or pairs, which lists all candidates.
        nway_columns : add ``p_any``, ``p_i`` and ``dist_bayesfactor``, as in NWAY.

        Raises
        ------
        InputError : an unknown join.
        """
        return self.joined_table(join, nway_columns=nway_columns).whole()

    def joined_table(self, join: str | None = None, *, nway_columns: bool | None = None) -> JoinedTable:
        """The table of :meth:`joined`, not computed yet; by default that of :attr:`table`."""
        from sameas.sky.joins import JoinedTable, RecordsMatch

        matched = RecordsMatch(self.identification, self.estimate.coverage) if self.sky is None else self.sky
        return JoinedTable(matched, join or self.join, self.nway_columns if nway_columns is None else nway_columns)

    def report(self) -> str:
        """The report that the command prints."""
        return in_one(self.report_lines())

    def report_lines(self, words: Callable[[str], str] = str) -> Iterator[str]:
        """The lines of :meth:`report`. words : rewords messages that name arguments (the command names options)."""
        from sameas.report.match import catalogue_lines

        yield from (f"{DOUBT}{note}" for note in self.notes)
        if self.sky is not None:
            for side, catalogue in enumerate((self.sky.first, self.sky.second), 1):
                stated = words if self.request is None else partial(self.request.in_own_terms, words, side)
                yield from (*catalogue_lines(catalogue, side, self._path(side), stated), "")
        yield from self.result_lines(words)

    def result_lines(self, words: Callable[[str], str]) -> list[str]:
        """The report without the part about the input."""
        from sameas.report.match import estimate_lines, records_lines, summary_lines

        if self.sky is None:
            return records_lines(self.identification, self.estimate)
        return [*estimate_lines(self.sky, words), "", *summary_lines(self.sky)]

    def _path(self, side: int) -> str:
        source = "" if self.request is None else self.request.sources[side - 1]
        return source if isinstance(source, str) else ""

    def explain(self, id: Any = None, *, row: int | None = None, source: int = 1) -> RecordStory:
        """Why a record was identified as it was: its candidates, their probabilities and costs. ``print`` the result.

        Parameters
        ----------
        id : the record's id. row : its row in the table, counted from 0, instead of the id.
        source : 1 or 2, the record's source.

        Raises
        ------
        InputError : no such record; neither id nor row is given, or both.
        """
        from sameas.report.explain import explanation_lines

        if source not in (1, 2):
            raise InputError(f"source is {source}; give 1 or 2")
        records = self.identification.first if source == 1 else self.identification.second
        explanation = self.identification.explain(id_of(records, id, row), source=source)
        lines = str(explanation).splitlines() if self.sky is None else explanation_lines(self.sky, explanation, source)
        return RecordStory(tuple(lines), explanation)

    def plot(self, name: str = PLOTS[0], *, record: Any = None) -> Figure:
        """A matplotlib figure of the match, which notebooks display.

        name : "residuals" before and after motion; "normalised" residuals in quoted σ; "scatter" by error and
            magnitude; "certainty"; "brightness"; "ambiguous", the records with the strongest competitors.
        record : id of a record of the first source, whose group "ambiguous" draws instead.

        Raises
        ------
        InputError : an unknown name; a match of ``Records``; matplotlib is not installed; nothing to plot.
        """
        if self.sky is None:
            raise InputError("plots need catalogues; these are records without columns")
        return draw(self.sky, name, record)

    def write(
        self,
        path: str | os.PathLike[str],
        join: str | None = None,
        *,
        format: str | None = None,
        overwrite: bool = True,
    ) -> None:
        """Write the joined table with its provenance. The file is replaced as a whole: no run leaves half a file.

        Parameters
        ----------
        path : the extension gives the format: FITS, VOTable, ECSV, CSV or Parquet. format : the format's name, for
            other extensions. join : see :meth:`joined`; by default that of :attr:`table`.
        overwrite : False refuses an existing path.

        Raises
        ------
        InputError : the path cannot be written, exists, or is one of the inputs.
        """
        from sameas.io import write_table
        from sameas.io.atomic import refuse_inputs

        if self.request is not None:
            refuse_inputs(path, self.request.paths)
        computed = self.__dict__.get("table") if join is None else None
        table = self.joined_table(join) if computed is None else computed
        write_table(table, path, provenance=self.facts(self.call, join=join), format=format, overwrite=overwrite)

    def facts(self, command: str, words: Callable[[str], str] = str, join: str | None = None) -> dict[str, Any]:
        """The provenance of the table. command : as typed. words : see :meth:`report_lines`. join : of the table, by
        default that of :attr:`table`."""
        from sameas.front.provenance import of_match, of_records

        if self.sky is None or self.request is None:
            return of_records(self.identification, self.estimate, command)
        return of_match(self.request, self.sky, command, words) | {"join": join or self.join}

    @property
    def headline(self) -> str:
        """Summary in one line."""
        from sameas.representation import counted

        sizes = [f"{records.source} ({counted(records.n_table, 'row')})"
                 for records in (self.identification.first, self.identification.second)]  # fmt: skip
        pairs, wrong = counted(len(self), "pair"), expected(self.expected_wrong)
        return f"Match of {' and '.join(sizes)}: {pairs}, {wrong} expected wrong"


def draw(match: SkyMatch, name: str, record: Any = None) -> Figure:
    """The plot ``name`` of a match of two catalogues; see :meth:`Match.plot`."""
    from sameas import plots

    if name not in PLOTS:
        raise InputError(f"there is no plot {name!r}; give one of {', '.join(PLOTS)}")
    if name == "ambiguous":
        return plots.group(match, record=record)
    figure: Figure = getattr(plots, name)(match)
    return figure


@dataclass(frozen=True, repr=False)
class RecordStory(Lines):
    """The explanation of one record; ``print`` it.

    lines : the text. explanation : the same as values.
    """

    explanation: Explanation


def id_of(records: Records, id: Any, row: int | None) -> Any:
    """The id of a record that is given by either its id or its row."""
    if (id is None) == (row is None):
        raise InputError("explain: give the id of a record, or row=NUMBER")
    if row is None:
        return id
    if not 0 <= row < records.n_table:
        raise InputError(f"{records.source} has no row {row}; it has rows 0 to {records.n_table - 1}")
    return records.ids[row]


def call_text(function: Callable[..., Any], sources: Sequence[Any], stated: Mapping[str, Any]) -> str:
    """The call as text: paths, the types of other sources, and options that differ from their defaults."""
    paths = map(as_source, sources)
    given = [repr(source) if isinstance(source, str) else kind_of(source) for source in paths]
    defaults = {name: parameter.default for name, parameter in inspect.signature(function).parameters.items()}
    options = [f"{name}={value!r}" for name, value in stated.items() if value is not defaults.get(name)]
    return f"sameas.{function.__name__}({', '.join([*given, *options])})"


@with_side_options(2)
def match(
    first: Any,
    second: Any,
    *,
    join: str = "all1",
    nway_columns: bool = False,
    to_epoch: float | None = None,
    gate_sigmas: float | None = None,
    error_scale: float | str | Errors = "auto",
    density: tuple[float, float] | None = None,
    magnitudes: str | tuple[Magnitudes, Magnitudes] = "auto",
    precision: bool = True,
    evidence: Column | Related | Sequence[Column | Related] = (),
    offset: str = "none",
    names: tuple[str, str] | None = None,
    progress: Callable[[str], None] = lambda stage: None,
    **columns: Any,
) -> Match | PartitionedMatch:
    """Crossmatch two sources, one to one, with probabilities. What is not given is estimated from the data.

    Parameters
    ----------
    first, second : anything that holds positions: a path; an astropy ``Table``, ``QTable`` or ``SkyCoord``; a pandas,
        polars or Arrow table; a structured array; a dict of columns; a ``Catalogue``; or both ``Records``. Two folders
        of HATS catalogues give a :class:`PartitionedMatch`, which works partition by partition.
    join : the join of ``.table``, named as in STILTS; "all1" keeps every row of the first source.
    nway_columns : add NWAY's columns to ``.table``.
    to_epoch : Julian year to which both sources are propagated; chosen from their epochs by default.
    gate_sigmas : radius of the gate in quoted σ; by default as wide as the errors require.
    error_scale : "auto" estimates the distribution of the residuals relative to the quoted errors; a factor or
        ``Errors`` is used as given; 1 takes the errors as quoted.
    density : densities of all records of the first and the second source per square degree; for ``Records`` per unit
        of the residuals. Estimated locally by default.
    magnitudes : "auto", of both sources or of the only one that has them; "off"; or columns of both as "G,BP:J,H"; for
        ``Records`` two ``Magnitudes``.
    precision : whether the sizes of the quoted errors are evidence.
    evidence : further columns as evidence: ``Column(2, "MAG")`` of the second source, learned from the pairs or with
        your own ``odds``; ``Related("flux", "MAG")`` of both.
    offset : "find" estimates a shift and rotation between the sources and removes it.
    names : names of the two sources in messages. progress : called with the name of each step.
    columns : column options as in the command: ``ra1``, ``sigma2=0.1``, ``epoch2=2015.5``; without a number they apply
        to both sources. See :class:`~sameas.sky.CatalogueOptions`.

    Raises
    ------
    InputError : no positions; columns that are not understood; unknown options.

    Example
    -------
    >>> import numpy as np
    >>> import sameas
    >>> rng = np.random.default_rng(1)
    >>> ra, dec = 10.0 + rng.uniform(size=50), 20.0 + rng.uniform(size=50)
    >>> near = {"ra": ra[:40], "dec": dec[:40] + 5e-5 * rng.standard_normal(40)}
    >>> found = sameas.match({"ra": ra, "dec": dec}, near, sigma=0.2)
    >>> len(found), found.table.colnames[:4]
    (40, ['ra_1', 'dec_1', 'ra_2', 'dec_2'])
    """
    own = {
        "join": join, "nway_columns": nway_columns, "to_epoch": to_epoch, "gate_sigmas": gate_sigmas,
        "error_scale": error_scale, "density": density, "magnitudes": magnitudes, "precision": precision,
        "evidence": evidence, "offset": offset, "names": names,
    }  # fmt: skip
    refuse_unknown(columns, (*own, "progress", *side_parameters(2)), "match")
    stated = {name: value for name, value in columns.items() if value is not None}
    call = call_text(match, (first, second), own | stated)
    from sameas.front.request import Request
    from sameas.sky.crossmatch import MatchOptions
    from sameas.sky.output_columns import check_join

    named = magnitudes if isinstance(magnitudes, str) else "auto"
    options = MatchOptions(
        to_epoch, gate_sigmas, error_scale, density, named, offset, precision, tuple(_listed(evidence))
    )
    if isinstance(first, Records) or isinstance(second, Records):
        matched = _match_records(first, second, options, magnitudes, stated, progress)
        return replace(matched, join=join, nway_columns=nway_columns, call=call)
    check_join(join)
    if not isinstance(magnitudes, str):
        raise InputError("match: Magnitudes are those of Records", 'name columns of both catalogues, "G,BP:J,H"')
    options.check()
    request = Request(tuple(map(as_source, (first, second))), options, stated, tuple(names or ()))
    if both_hats(first, second):
        return PartitionedMatch(request, join, nway_columns, call, progress)
    first, second = request.catalogues()
    matched = identified(request, (first, second), progress=progress)
    return replace(matched, join=join, nway_columns=nway_columns, call=call)


def identified(
    request: Request[MatchOptions], catalogues: tuple[Catalogue, Catalogue], *, progress: Callable[[str], None]
) -> Match:
    """The match of the catalogues of a request, which are read already."""
    from sameas.sky import crossmatch

    matched = request.naming_sides(lambda: crossmatch.match(*catalogues, request.options, progress=progress))
    matched.estimate.coverage.release()
    notes = (request.twice,) if request.twice else ()
    return Match(matched.result, matched.estimate, matched, request=request, notes=notes)


def _listed(evidence: Column | Related | Iterable[Column | Related]) -> list[Column | Related]:
    """The columns of ``evidence`` as a list."""
    listed = [evidence] if isinstance(evidence, Column | Related) else list(evidence)
    for one in listed:
        if not isinstance(one, Column | Related):
            raise InputError(
                f"match: evidence holds {one!r}", 'give Column(2, "NAME") of sameas.evidence, or Related("A", "B")'
            )
    return listed


def as_source(source: Any) -> Any:
    """The source; a path as text."""
    return os.fspath(source) if isinstance(source, os.PathLike) else source


def _match_records(
    first: Any,
    second: Any,
    options: MatchOptions,
    magnitudes: str | tuple[Magnitudes, Magnitudes],
    columns: Mapping[str, Any],
    progress: Callable[[str], None],
) -> Match:
    """The match of two ``Records``. options : their density is per unit of the residuals. columns : options that only
    catalogues have."""
    from sameas.estimate.match import match as estimated

    for one in (first, second):
        if not isinstance(one, Records):
            raise InputError(
                f"match: Records are matched with Records, not with a {kind_of(one)}", "make both of one kind"
            )
    if columns:
        raise InputError(f"match: Records have no columns, so {next(iter(columns))} has no meaning for them")
    if options.offset != "none" or options.epoch_jyr is not None:
        raise InputError("match: Records have no epochs or frames", "see register for offsets between them")
    errors, gate = options.errors(), options.gate()
    if options.magnitudes not in ("auto", "off"):
        raise InputError("match: Records have no columns", "give magnitudes=(Magnitudes, Magnitudes)")
    identification, estimate = estimated(
        first, second, errors=errors, gate=gate, density=options.density_per_deg2,
        brightness=None if isinstance(magnitudes, str) else magnitudes, precision=options.precision,
        evidence=options.evidence, progress=progress,
    )  # fmt: skip
    return Match(identification, estimate)
