"""Match of two HATS catalogues: the result of :func:`sameas.match` for two partitioned catalogues."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.errors import InputError, Message
from sameas.front.options import FILE_OPTIONS, fields_of
from sameas.front.provenance import made_by
from sameas.front.request import Request
from sameas.partitions.hats import HatsCatalogue, is_hats, without_properties

if TYPE_CHECKING:
    from sameas.partitions.estimated import Estimated
    from sameas.partitions.run import Written
    from sameas.sky.crossmatch import MatchOptions


@dataclass(frozen=True, repr=False)
class PartitionedMatch:
    """A match of two partitioned catalogues, returned by :func:`sameas.match` for HATS input.

    It is lazy: :attr:`estimated`, and with it :meth:`report`, reads the positions of both catalogues once;
    :meth:`write` matches all partitions and writes a HATS catalogue.

    Attributes
    ----------
    request : all options. join, nway_columns : of the output. call : that made it. progress : called with the name of
        each step. workers : number of processes; that of the processors if None.
    """

    request: Request[MatchOptions]
    join: str = "all1"
    nway_columns: bool = False
    call: str = ""
    progress: Callable[[str], None] = field(default=lambda stage: None)
    workers: int | None = None

    def __post_init__(self) -> None:
        for name in (f"{one.parameter}{side}" for one in FILE_OPTIONS for side in ("", 1, 2)):
            if self.request.columns.get(name) is not None:
                raise InputError(f"{name}: HATS catalogues are Parquet files; their format is not an option",
                                 "leave it out")  # fmt: skip

    @cached_property
    def catalogues(self) -> tuple[HatsCatalogue, HatsCatalogue]:
        """Both catalogues on disk."""
        one, two = (HatsCatalogue.open(path, name) for path, name in
                    zip(self.request.paths, self.request.names, strict=True))  # fmt: skip
        return one, two

    @cached_property
    def estimated(self) -> Estimated:
        """All estimated parameters, fitted once to all partitions."""
        with tempfile.TemporaryDirectory(prefix="sameas-") as scratch:
            return self._estimated(Path(scratch), self.workers, None)

    def _estimated(self, scratch: Path, workers: int | None, executor: Executor | None) -> Estimated:
        from sameas.partitions.estimated import estimate
        from sameas.partitions.workers import Workers
        from sameas.sky.catalogue import CatalogueOptions

        stated = [CatalogueOptions(**fields_of(self.request.columns, side)) for side in (1, 2)]
        estimated: Estimated = self.request.naming_sides(
            lambda: estimate(
                self.catalogues,
                (stated[0], stated[1]),
                self.request.options,
                join=self.join,
                nway_columns=self.nway_columns,
                workers=Workers(workers, executor),
                scratch=scratch,
                progress=self.progress,
            )
        )
        return estimated

    def write(
        self,
        path: str | os.PathLike[str],
        *,
        workers: int | None = None,
        executor: Executor | None = None,
        margin_arcsec: float = 10.0,
        piece_rows: int = 300_000,
    ) -> Written:
        """Matches all partitions and writes the joined catalogue, with a margin, as a HATS collection.

        The same call resumes an interrupted one: finished partitions are kept.

        Parameters
        ----------
        path : the collection's folder. margin_arcsec : of the margin catalogue; 0 writes none.
        workers : processes. executor : used instead of processes of our own, such as ``client.get_executor()`` of
            dask.distributed; its workers must see the folders.
        piece_rows : approximate number of records of both catalogues that a worker matches at once, independent of the
            partitions; fewer in crowded fields, where they and their candidates would need more than about 0.6 GB.

        Raises
        ------
        InputError : the name is that of a table; the folder exists and is not an unfinished match of the same input; a
            partition cannot be read, by name; workers die repeatedly.
        """
        from sameas.partitions.run import write
        from sameas.partitions.workers import Workers

        refuse_file_name(path)
        target, workers = Path(path).absolute(), self.workers if workers is None else workers
        for source in self.request.paths:
            if target == Path(source).resolve() or target.is_relative_to(Path(source).resolve()):
                raise InputError(f"{path}: lies in an input", "give another name")
        facts = self.facts() | {"margin_arcsec": margin_arcsec, "piece_rows": piece_rows}
        if "estimated" not in self.__dict__:
            refuse_existing(target)
            with tempfile.TemporaryDirectory(prefix=".sameas-", dir=_made(target.parent)) as folder:
                self.__dict__["estimated"] = self._estimated(Path(folder), workers, executor)
        return write(self.estimated, target, facts, margin_arcsec=margin_arcsec, workers=Workers(workers, executor),
                     progress=self.progress, piece_rows=piece_rows)  # fmt: skip

    def facts(self) -> dict[str, Any]:
        """The provenance of the output; it depends on inputs and options only."""
        facts = made_by(self.call) | {"join": self.join, "nway_columns": self.nway_columns}
        for k, (path, stored) in enumerate(zip(self.request.paths, self.catalogues, strict=True), 1):
            facts |= {f"input_{k}": str(Path(path).resolve()), f"fingerprint_{k}": stored.fingerprint(),
                      f"options_{k}": json.dumps(fields_of(self.request.columns, k), sort_keys=True)}  # fmt: skip
        return facts | {"options_match": json.dumps(asdict(self.request.options), sort_keys=True)}

    @property
    def doubts(self) -> tuple[str, ...]:
        """One sentence for each doubt."""
        twice = (self.request.twice,) if self.request.twice else ()
        of_input = (
            self.request.words(_of_first_rows(catalogue.name, doubt), side)
            for side, catalogue in enumerate(self.estimated.catalogues, 1)
            for doubt in catalogue.doubts
        )
        return (*twice, *of_input, *self.estimated.doubts)

    def report(self) -> str:
        """The interpretation of the input, and the estimates."""
        return "\n".join(self.report_lines())

    def report_lines(self, words: Callable[[str], str] = str) -> Iterator[str]:
        """The lines of :meth:`report`. words : formats a message that names arguments."""
        from sameas.report.estimates import column_lines, modelled_errors
        from sameas.report.prose import DOUBT, entry, figures, labelled, percent
        from sameas.representation import ORDINALS, count, counted

        estimated = self.estimated
        learned, work = estimated.learned, estimated.work
        for side, (stored, rows, catalogue) in enumerate(
            zip(self.catalogues, estimated.rows, estimated.catalogues, strict=True), 1
        ):
            parts = counted(len(stored.cells), "partition")
            yield f"{ORDINALS[side - 1].capitalize()} catalogue: {stored.name}, {counted(rows, 'row')} in {parts}"
            yield from entry("columns by", "the first rows of some partitions, which are those that notes count")
            yield from labelled([words(self.request.words(line, side)) for line in catalogue.interpretation])
            yield ""
        yield "Estimated, once for all partitions"
        yield from entry("epoch", estimated.moved)
        one, two = estimated.sample
        yield from entry("sample", f"{count(one)} and {count(two)} records")
        shares = " and ".join(percent(share) for share in learned.means)
        yield from entry("have a partner", f"{shares} of their records")
        errors = learned.errors
        scaled = f"{errors.typical_scale:.2f} times those quoted, typically"
        yield from entry("errors", modelled_errors(errors) if errors.as_modelled else scaled)
        yield from entry("gate", f"{figures(learned.gate_sigmas)} σ")
        if learned.columns is not None:
            nothing = entry("columns", "too few pairs to fit them; they are not used")
            yield from column_lines(learned.columns, (self.catalogues[0].name, self.catalogues[1].name)) or nothing
        yield from entry("halo", f"{figures(work.halo_arcsec)} arcsec, wider where that is not enough")
        far = [0 if side.far is None else len(side.far) for side in work.sides]
        if any(far):
            yield from entry("far", f"{count(far[0])} and {count(far[1])} records need a wider one")
        yield from (DOUBT + words(doubt) for doubt in self.doubts)

    def __repr__(self) -> str:
        one, two = self.catalogues
        return (
            f"Match of {one.name} and {two.name}, {len(one.cells)} and {len(two.cells)} partitions: "
            ".write(path) identifies them; .report() tells what was estimated"
        )


def _of_first_rows(name: str, doubt: str) -> Message:
    """A doubt about the first rows of some partitions, without the remedy that is refused for partitions."""
    refused = isinstance(doubt, Message) and any(argument.name == "fill_errors" for argument in doubt.arguments)
    return Message(f"{name}, in its first rows: ", doubt.partition("; ")[0] if refused else doubt)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def both_hats(first: object, second: object) -> bool:
    """Whether both sources are HATS catalogues.

    Raises InputError: only one of them is, or has partitions without their properties.
    """
    in_parts = [is_hats(source) for source in (first, second)]
    if any(in_parts) and not all(in_parts):
        if without_properties(bare := second if in_parts[0] else first):
            raise InputError(f"{bare}: has partitions, but no hats.properties", "restore it, or import it again")
        raise InputError(
            f"{first if in_parts[0] else second}: a HATS catalogue is matched with another one",
            "import the other with hats-import, or give a table of both",
        )
    return all(in_parts)


def refuse_existing(path: str | os.PathLike[str]) -> None:
    """Refuse an output folder that is not empty and not of an unfinished match."""
    target = Path(path)
    if target.is_dir() and any(target.iterdir()) and not (target / ".sameas-run").exists():
        raise InputError(f"{path}: exists already, and is not an unfinished match", "give another name, or remove it")


def refuse_file_name(path: str | os.PathLike[str]) -> None:
    """Refuse an output with the name of a table."""
    from sameas.io.tables import FORMATS

    name = Path(path).name.lower()
    if ending := next((one for known in FORMATS for one in known.extensions if name.endswith(one)), ""):
        raise InputError(
            f"{path}: the match of HATS catalogues is a folder of partitions, not one file",
            f"give a name without {ending}",
        )


def written_lines(written: Written) -> list[str]:
    """The report of a finished run."""
    from sameas.report.prose import entry, figures
    from sameas.representation import count

    return [
        "Identified",
        *entry("pairs", f"{count(written.pairs)}, {figures(written.expected_wrong)} expected wrong"),
        *entry("rows", f"{count(written.rows)} in {count(written.partitions)} partitions"),
        *entry("halo", f"{figures(written.halo_arcsec)} arcsec at most"),
        *(
            entry("not certain", f"{count(written.doubtful)} rows whose groups reach beyond the halo")
            if written.doubtful
            else ()
        ),
        *entry("output", f"{written.path}, a HATS collection"),
    ]
