"""Internal match of one table: :func:`match_internal` and its result, :class:`MatchInternal`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from sameas.front.match import as_source, call_text
from sameas.front.options import refuse_unknown, side_parameters, with_side_options
from sameas.report.prose import Result, in_one

if TYPE_CHECKING:
    from astropy.table import Table

    from sameas.front.request import Request
    from sameas.sky.catalogue import Catalogue
    from sameas.sky.internal import InternalMatch, InternalOptions


@dataclass(frozen=True, repr=False)
class MatchInternal(Result):
    """The objects of one table, returned by :func:`match_internal`. ``len()`` is the number of objects.

    Attributes
    ----------
    sky : the result: the object of each row, probabilities, places and errors of the objects.
    request : all options, which :meth:`write` stores in the file. call : the call that made it.
    """

    _offers = ".table .objects .report() .write(path)"

    sky: InternalMatch
    request: Request[InternalOptions]
    call: str = ""

    def __len__(self) -> int:
        return len(self.sky)

    @property
    def doubts(self) -> tuple[str, ...]:
        """One sentence for each doubt about the input or the result."""
        of_input = (self.request.words(doubt, 1) for doubt in self.sky.catalogue.named_doubts)
        return (*of_input, *self.sky.doubts)

    @cached_property
    def table(self) -> Table:
        """The rows of the table with ``object_id``, ``object_rows``, ``object_rank``, ``object_sep_arcsec``, ``p_row``
        and ``p_object``. ``table[table["object_rank"] == 1]`` has one row of each object."""
        from sameas.sky.internal import rows_table

        return rows_table(self.sky)

    @cached_property
    def objects(self) -> Table:
        """One row for each object, with the mean place of its rows and its error, for :func:`sameas.match`."""
        from sameas.sky.internal import objects_table

        return objects_table(self.sky)

    def report(self) -> str:
        """The report that the command prints."""
        return in_one(self.report_lines())

    def report_lines(self, words: Callable[[str], str] = str) -> Iterator[str]:
        """The lines of :meth:`report`. words : formats a message that names arguments."""
        from sameas.report.match import catalogue_lines

        path = self.request.sources[0]
        stated = partial(self.request.in_own_terms, words, 1)
        yield from (*catalogue_lines(self.sky.catalogue, 0, path if isinstance(path, str) else "", stated), "")
        yield from self.result_lines(words)

    def result_lines(self, words: Callable[[str], str]) -> list[str]:
        """Estimates and results, without the interpretation of the input."""
        from sameas.report.internal import internal_estimate_lines, internal_summary_lines

        return [*internal_estimate_lines(self.sky, words), "", *internal_summary_lines(self.sky)]

    def write(
        self, path: str | os.PathLike[str], *, objects: bool = False, format: str | None = None, overwrite: bool = True
    ) -> None:
        """Writes :attr:`table`, or :attr:`objects`, with its provenance, atomically.

        Parameters
        ----------
        path : the format is that of the extension. objects : write the table of objects instead of that of rows.
        format : its name, where the extension does not tell it. overwrite : False refuses a path that exists.

        Raises
        ------
        InputError : the path cannot be written, or is the input.
        """
        from sameas.io import write_table
        from sameas.io.atomic import refuse_inputs

        refuse_inputs(path, self.request.paths)
        table = self.objects if objects else self.table
        write_table(table, path, provenance=self.facts(self.call), format=format, overwrite=overwrite)

    def facts(self, command: str, words: Callable[[str], str] = str) -> dict[str, Any]:
        """The provenance of the table. command : as typed. words : formats a message that names arguments."""
        from sameas.front.provenance import of_internal

        return of_internal(self.request, self.sky, command, words)

    @property
    def headline(self) -> str:
        """A summary in one line."""
        from sameas.representation import count, counted

        several = int((self.sky.n_rows > 1).sum())
        name, rows = self.sky.catalogue.name, counted(len(self.sky.catalogue), "row")
        return f"Internal match of {name} ({rows}): {counted(len(self), 'object')}, {count(several)} of several rows"


@with_side_options(0)
def match_internal(
    source: Any,
    *,
    exposure: str | None = None,
    error_scale: float | str = "auto",
    name: str | None = None,
    progress: Callable[[str], None] = lambda stage: None,
    **columns: Any,
) -> MatchInternal:
    """Which rows of one table are the same object: detections on many exposures, merged lists, duplicates.

    The internal match of TOPCAT (STILTS ``tmatch1``), without a radius: errors, density of objects and numbers of rows
    are estimated from the table.

    Parameters
    ----------
    source : anything that :func:`sameas.match` takes but ``Records``.
    exposure : column that numbers the exposures, images or visits; an exposure shows an object once.
    error_scale : "auto" estimates the errors from the distances of close rows; 1 takes the quoted ones.
    name : of the table in messages. progress : called with the name of each step.
    columns : options of the columns, as of :func:`sameas.match`, without a number: ``sigma=0.1``.

    Raises
    ------
    InputError : no positions; columns that cannot be interpreted; unknown options; no such exposure column.

    Example
    -------
    >>> import numpy as np
    >>> import sameas
    >>> rng = np.random.default_rng(2)
    >>> ra, dec = np.repeat(10.0 + rng.uniform(size=60), 3), np.repeat(20.0 + rng.uniform(size=60), 3)
    >>> noise = rng.normal(0.0, 0.1 / 3600.0, (2, 180))
    >>> found = sameas.match_internal({"ra": ra + noise[0], "dec": dec + noise[1]}, sigma=0.1)
    >>> len(found), len(found.table), found.objects.colnames[:3]
    (60, 180, ['object_id', 'ra', 'dec'])
    """
    from sameas.front.request import Request
    from sameas.sky.internal import InternalOptions

    own = {"exposure": exposure, "error_scale": error_scale, "name": name}
    refuse_unknown(columns, (*own, "progress", *side_parameters(0)), "match_internal")
    stated = {parameter: value for parameter, value in columns.items() if value is not None}
    options = InternalOptions(error_scale, exposure)
    options.check()
    request = Request((as_source(source),), options, stated, (name,) if name else ())
    found = gathered(request, request.catalogue(1), progress=progress)
    return MatchInternal(found, request, call_text(match_internal, (source,), own | stated))


def gathered(
    request: Request[InternalOptions], catalogue: Catalogue, *, progress: Callable[[str], None]
) -> InternalMatch:
    """The internal match of the catalogue of a request, which is read already."""
    from sameas.sky.internal import match_internal as gather

    found: InternalMatch = request.naming_sides(lambda: gather(catalogue, request.options, progress=progress))
    return found
