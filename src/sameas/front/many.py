"""Match of several catalogues at once: :func:`match_many` and its result, :class:`MatchMany`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from sameas.errors import InputError
from sameas.front.match import as_source, call_text, draw, id_of
from sameas.front.options import MOST, refuse_numbers, refuse_unknown, side_parameters, with_side_options
from sameas.report.prose import Result, in_one

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

    from sameas.evidence import Errors
    from sameas.front.request import Request
    from sameas.many.objects import ObjectExplanation, Objects
    from sameas.sky.catalogue import Catalogue
    from sameas.sky.many import ManyMatch, ManyOptions


@dataclass(frozen=True, repr=False)
class MatchMany(Result):
    """A match of several catalogues, returned by :func:`match_many`. ``len()`` is the number of objects.

    Attributes
    ----------
    sky : the catalogues, the objects, and the pairwise matches.
    request : all options, which :meth:`write` stores in the file. least : number of catalogues in which an object of
        :attr:`table` must be. call : the call that made it.
    """

    _offers = ".table .joined(2) .objects .report() .explain(id, source=1) .plot() .write(path)"

    sky: ManyMatch
    request: Request[ManyOptions]
    least: int = 1
    call: str = ""

    def __len__(self) -> int:
        return len(self.objects)

    @property
    def objects(self) -> Objects:
        """The result of the core: members, probabilities and states of all objects."""
        return self.sky.objects

    @property
    def doubts(self) -> tuple[str, ...]:
        """One sentence for each doubt about the input or the result."""
        sides = enumerate(self.sky.catalogues, 1)
        of_input = (self.request.words(doubt, side) for side, catalogue in sides for doubt in catalogue.named_doubts)
        return (*of_input, *self.sky.doubts)

    @cached_property
    def table(self) -> Table:
        """One row per object in at least ``least`` catalogues; see :meth:`joined`."""
        return self.joined(self.least)

    def joined(self, least: int = 1) -> Table:
        """One row per object in at least ``least`` catalogues, with the columns of all of them.

        Raises
        ------
        InputError : ``least`` is not between 1 and the number of catalogues.
        """
        from sameas.sky.many_joins import joined_many

        return joined_many(self.sky, least=least)

    def report(self) -> str:
        """The report that the command prints."""
        return in_one(self.report_lines())

    def report_lines(self, words: Callable[[str], str] = str) -> Iterator[str]:
        """The lines of :meth:`report`. words : formats a message that names arguments."""
        from sameas.report.match import catalogue_lines

        for side, catalogue in enumerate(self.sky.catalogues, 1):
            path = self.request.sources[side - 1]
            stated = partial(self.request.in_own_terms, words, side)
            yield from (*catalogue_lines(catalogue, side, path if isinstance(path, str) else "", stated), "")
        yield from self.result_lines(words)

    def result_lines(self, words: Callable[[str], str]) -> list[str]:
        """Estimates and results, without the interpretation of the input."""
        from sameas.report.many import many_estimate_lines, many_summary_lines

        return [*many_estimate_lines(self.sky, words), "", *many_summary_lines(self.sky)]

    def explain(self, id: Any = None, *, row: int | None = None, source: int | str = 1) -> ObjectExplanation:
        """Why a record is in its object: the possible sets of records and their probabilities; ``print`` the result.

        Parameters
        ----------
        id : of the record. row : in its table, counted from 0, instead. source : number or name of its catalogue.

        Raises
        ------
        InputError : no such record or catalogue; a row that could not be used; neither id nor row is given, or both.
        """
        import numpy as np

        from sameas.records import Records
        from sameas.result import row_of

        names = [catalogue.name for catalogue in self.sky.catalogues]
        if isinstance(source, str):
            if source not in names:
                raise InputError(f"no catalogue is named {source!r}; give one of {', '.join(names)}, or its number")
            number = names.index(source)
        elif 1 <= source <= len(names):
            number = source - 1
        else:
            raise InputError(f"source is {source}; give 1 to {len(names)}, or a name")
        records = self.objects.given[number]
        assert isinstance(records, Records)
        at = row_of(records.ids, id_of(records, id, row), records.source)
        which = self.objects.of(number).object
        if np.ma.getmaskarray(which)[at]:
            reason = records.set_aside.reasons[records.set_aside.rows == at][0]
            raise InputError(f"{records.source} {records.ids[at]} (row {at}) could not be used: {reason}")
        return self.objects.explain(int(which[at]))

    def plot(self, first: str | None = None, second: str | None = None, name: str = "residuals") -> Figure:
        """A plot of the match of two of the catalogues; notebooks show it.

        Parameters
        ----------
        first, second : names of the catalogues; the first two if not given.
        name : one of :data:`sameas.front.match.PLOTS`.

        Raises
        ------
        InputError : no such catalogues; see :meth:`sameas.Match.plot`.
        """
        names = [catalogue.name for catalogue in self.sky.catalogues]
        wanted = (first or names[0], second or next(n for n in names if n != (first or names[0])))
        for pair, match in self.sky.two_by_two.items():
            if set(pair) == set(wanted):
                return draw(match, name)
        raise InputError(f"no catalogues {wanted[0]} and {wanted[1]}; give two of {', '.join(names)}")

    def write(
        self,
        path: str | os.PathLike[str],
        least: int | None = None,
        *,
        format: str | None = None,
        overwrite: bool = True,
    ) -> None:
        """Writes the joined table with its provenance, atomically.

        Parameters
        ----------
        path : the format is that of the extension. format : its name, where the extension does not tell it.
        least : as of :meth:`joined`; that of :attr:`table` if not given. overwrite : False refuses a path that exists.

        Raises
        ------
        InputError : the path cannot be written, or is one of the inputs.
        """
        from sameas.io import write_table
        from sameas.io.atomic import refuse_inputs

        refuse_inputs(path, self.request.paths)
        table = self.table if least is None else self.joined(least)
        write_table(table, path, provenance=self.facts(self.call), format=format, overwrite=overwrite)

    def facts(self, command: str, words: Callable[[str], str] = str) -> dict[str, Any]:
        """The provenance of the table. command : as typed. words : formats a message that names arguments."""
        from sameas.front.provenance import of_many

        return of_many(self.request, self.sky, command, words)

    @property
    def headline(self) -> str:
        """A summary in one line."""
        from sameas.representation import count, counted

        names = ", ".join(f"{catalogue.name} ({counted(len(catalogue), 'row')})" for catalogue in self.sky.catalogues)
        several = int((self.objects.n_members > 1).sum())
        return f"Match of {names}: {counted(len(self), 'object')}, {count(several)} of them in several"


@with_side_options(MOST)
def match_many(
    *sources: Any,
    least: int = 1,
    to_epoch: float | None = None,
    gate_sigmas: float | None = None,
    error_scale: float | str | Errors = "auto",
    offset: str = "none",
    magnitudes: str = "auto",
    names: Sequence[str] | None = None,
    progress: Callable[[str], None] = lambda stage: None,
    **columns: Any,
) -> MatchMany:
    """Matches several catalogues at once; the result does not depend on their order.

    Parameters
    ----------
    sources : two to twelve, each anything that :func:`sameas.match` takes but ``Records``, or one list of them.
    least : number of catalogues in which an object of ``.table`` must be.
    to_epoch : Julian year of the objects' positions; the mean of the catalogues' epochs if not given.
    gate_sigmas, error_scale : as for :func:`sameas.match`, for each pair of catalogues.
    offset : "find" estimates a shift and rotation of each catalogue, and corrects it.
    magnitudes : "auto" uses the magnitude of each catalogue as evidence; "off" positions only.
    names : of the catalogues in messages. progress : called with the name of each step.
    columns : options of the columns: ``sigma=0.1`` for all, ``epoch3=2000`` for the third.

    Raises
    ------
    InputError : fewer than two or too many catalogues; columns that cannot be interpreted; unknown options.

    Example
    -------
    >>> import numpy as np
    >>> import sameas
    >>> ra = np.linspace(10.0, 11.0, 30)
    >>> all_of_them, most = {"ra": ra, "dec": ra}, {"ra": ra[5:], "dec": ra[5:]}
    >>> found = sameas.match_many(all_of_them, most, all_of_them, sigma=0.1)
    >>> len(found), len(found.joined(3))
    (30, 25)
    """
    from sameas.front.request import Request
    from sameas.sky.many import ManyOptions

    if len(sources) == 1 and isinstance(sources[0], list | tuple):
        sources = tuple(sources[0])
    refuse_numbers(len(sources), "match_many: ")
    own = {
        "least": least, "to_epoch": to_epoch, "gate_sigmas": gate_sigmas, "error_scale": error_scale,
        "offset": offset, "magnitudes": magnitudes, "names": names,
    }  # fmt: skip
    refuse_unknown(columns, (*own, "progress", *side_parameters(len(sources))), "match_many")
    if magnitudes not in ("auto", "off"):
        raise InputError(f"magnitudes is {magnitudes!r}", 'give "auto" or "off"')
    if not 1 <= least <= len(sources):
        raise InputError(f"least is {least}; give 1 to {len(sources)}, in how many catalogues an object must be")
    stated = {name: value for name, value in columns.items() if value is not None}
    options = ManyOptions(to_epoch, gate_sigmas, error_scale, offset=offset, magnitudes=magnitudes)
    options.of_two().check()
    request = Request(tuple(map(as_source, sources)), options, stated, tuple(names or ()))
    catalogues = request.catalogues()
    match = identified(request, catalogues, progress=progress)
    return MatchMany(match, request, least, call_text(match_many, sources, own | stated))


def identified(
    request: Request[ManyOptions], catalogues: Sequence[Catalogue], *, progress: Callable[[str], None]
) -> ManyMatch:
    """The match of the catalogues of a request, which are read already."""
    from sameas.sky.many import match_many as identify

    match: ManyMatch = request.naming_sides(lambda: identify(catalogues, request.options, progress=progress))
    return match
