"""Movers in tables of detections (:func:`night_movers`) or on a series of frames (:func:`series_movers`).

Both return a result that writes its tables and reports; the command uses both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import sameas
from sameas.arrays import BoolArray
from sameas.errors import InputError, Message
from sameas.front.provenance import program
from sameas.front.request import read_catalogue, stem_of
from sameas.io import checksum, write_table
from sameas.io.ades import REPORTS, Observer, observations
from sameas.io.atomic import filling
from sameas.report.movers import (
    below_lines,
    excluded_lines,
    known_lines,
    model_lines,
    mover_lines,
    plan_lines,
    searched_lines,
    series_lines,
    streak_lines,
)
from sameas.report.prose import DOUBT
from sameas.representation import counted
from sameas.sky.movers.detections import DetectionColumns, Detections, detections_of
from sameas.sky.movers.known import KnownObjects, name_movers, near_earth_scores
from sameas.sky.movers.orbits import Elements
from sameas.sky.movers.search import Movers, find_movers, search

if TYPE_CHECKING:
    from astropy.table import Table

    from sameas.front.series import FieldSeries, IdentifiedFrame
    from sameas.sky.movers.below_limit import BelowLimit
    from sameas.sky.movers.stack import Stack
    from sameas.sky.series import Series

Progress = Callable[[str], object]
Say = Callable[[Iterable[str]], object]
Site = tuple[float, float, float]

#: A report holds tracklets of at least this probability: of ten that are as probable as this, nine are real.
REPORTED = 0.9
#: Tracklets of at least this probability are measured in the pixels, which may raise their probability.
FAINT = 0.02


@dataclass(frozen=True)
class MoverOptions:
    """What is searched, and how tracklets are identified with known objects and reported.

    least, probability : minimum number of detections and minimum probability of a tracklet.
    elements : known objects, or None. observer : of the report, or None. reported : minimum probability of a tracklet
        in the report.
    site : latitude and longitude in degrees, height in metres of the observer; None takes the frame's header.
    """

    least: int = 2
    probability: float = 0.5
    elements: Elements | None = None
    observer: Observer | None = None
    reported: float = REPORTED
    site: Site | None = None

    @classmethod
    def read(cls, least: int, probability: float, *, elements: str | None, header: str | None, reported: float,
             site: Site | None) -> MoverOptions:  # fmt: skip
        """elements : file of known objects, or None. header : TOML of the report, or None.

        Raises InputError: a file cannot be read.
        """
        observer = None if header is None else Observer.read(header)
        return cls(least, probability, None if elements is None else Elements.read(elements), observer, reported, site)

    def in_report(self, movers: Movers) -> BoolArray:
        """(n,) which tracklets are in the report."""
        return movers.p_tracklet >= self.reported

    def table(self, movers: Movers, known: KnownObjects | None) -> Table:
        """The tracklets, with the names of known objects and whether each is in the report, where there is one."""
        table = movers.table()
        if known is not None:
            known.into(table, movers)
        if self.observer is not None:
            table["in_report"] = self.in_report(movers)
        return table


@dataclass(frozen=True)
class Night:
    """Detections of one night, and those of other nights. paths : of all tables."""

    paths: tuple[str, ...]
    detections: Detections
    others: tuple[Detections, ...]


def read_night(
    paths: Sequence[str],
    others: Sequence[str] = (),
    wanted: DetectionColumns | None = None,
    *,
    columns: Mapping[str, Any],
    progress: Progress,
    say: Say,
) -> Night:
    """The detections in the tables of one night.

    others : tables of other nights, from which the rates of motion are learned. wanted : columns of detections.
    columns : options of the tables and their columns, as of :func:`sameas.match`: ``{"sigma": 0.2}``.
    progress : called with the name of each step. say : called with the lines of the report, section by section.

    Raises InputError: a table that cannot be read or interpreted.
    """
    every = (*paths, *others)
    read = []
    for path in every:
        progress(f"reading {path}")
        read.append(read_catalogue(path, stem_of(path), {**columns, "epoch": "none", "pm": "none"}, 0))
    seen, lines = detections_of(read[: len(paths)], wanted)
    # A star at the same place in several exposures is no duplicate.
    doubts = [Message(DOUBT, f"{one.name}: ", doubt) for one in read for doubt in one.doubts if doubt != one.duplicates]
    say([*lines, *doubts, *searched_lines(seen), ""])
    return Night(every, seen, tuple(detections_of([one], wanted)[0] for one in read[len(paths) :]))


@dataclass(frozen=True)
class NightMovers:
    """The movers of a night of detections. known : their names, or None without elements."""

    found: Movers
    known: KnownObjects | None
    options: MoverOptions
    paths: tuple[str, ...]

    def tables(self) -> dict[str, Table]:
        """``detections``, one row per detection of a tracklet, and ``tracklets``."""
        return {"detections": self.found.detection_table(), "tracklets": self.options.table(self.found, self.known)}

    def facts(self) -> dict[str, Any]:
        """Provenance: inputs with checksums, and the parameters of the model of movers."""
        facts = program()
        for k, path in enumerate(self.paths, 1):
            facts[f"input_{k}"], facts[f"sha256_{k}"] = str(Path(path).resolve()), checksum(path)
        model = self.found.model
        facts |= {"p_detect": model.p_detect, "log_odds_next": model.log_odds, "gap": self.found.gap}
        return facts

    def write_reports(self, paths: Sequence[Path]) -> None:
        """Write the reports of an observer, in the order of :data:`sameas.io.ades.REPORTS`."""
        _write_reports(self.found, self.known, self.options, paths)


def _write_reports(
    movers: Movers, known: KnownObjects | None, options: MoverOptions, paths: Iterable[Path],
    series: Series | None = None,
) -> None:  # fmt: skip
    """Write the reports of the options' observer, one path for each of :data:`sameas.io.ades.REPORTS`."""
    assert options.observer is not None
    rows = observations(movers, known, np.flatnonzero(options.in_report(movers)), series)
    for path, write in zip(paths, REPORTS.values(), strict=True):
        write(rows, options.observer, path, software=f"sameas {sameas.__version__}")


def night_movers(night: Night, options: MoverOptions, *, progress: Progress, say: Say) -> NightMovers:
    """The movers of a night of detections, named where elements are given. progress, say : as :func:`read_night`."""
    progress("searching")
    movers = find_movers(
        night.detections, others=night.others, least=options.least, min_probability=options.probability
    )
    say([*excluded_lines(movers), *model_lines(movers), "", *mover_lines(movers), ""])
    known = None
    if options.elements is not None:
        progress("predicting known objects")
        known = name_movers(movers, options.elements, site=options.site)
        say([*known_lines(movers, known, options.site is not None), ""])
    return NightMovers(movers, known, options, night.paths)


@dataclass(frozen=True)
class FaintMovers:
    """Candidates below the detection limit of single frames, their stacked pixels, and names, None without elements."""

    candidates: BelowLimit
    pixels: Stack
    known: KnownObjects | None

    def table(self) -> Table:
        """One row per candidate."""
        below = self.candidates
        table = below.movers.table()
        table.remove_columns(["n_detections", "p_exact", "log_odds"])
        table["snr"], table["frames"] = below.snr, below.frames
        table["magnitude"] = np.ma.masked_invalid(below.movers.detections.magnitude[below.movers.members[:, 0]])
        table["magnitude"].unit = "mag"
        if self.known is not None:
            self.known.into(table, below.movers)
        return table


@dataclass(frozen=True)
class SeriesMovers:
    """The movers on a series of frames.

    found : the tracklets. field : the series and its frames. pixels : the frames stacked along each tracklet.
    known : names of the tracklets, or None without elements. below : candidates below the detection limit, or None.
    failed : names of frames that could not be identified, and why. reasons : why others are not in the series.
    streaks : the trails of single frames that no tracklet has, as of satellites, one row each.
    """

    found: Movers
    field: FieldSeries
    pixels: Stack
    known: KnownObjects | None
    below: FaintMovers | None
    streaks: Table
    options: MoverOptions
    failed: tuple[tuple[str, str], ...]
    reasons: tuple[str, ...]

    def write(self, folder: Path, title: str, catalogue: str) -> list[str]:
        """Writes tables, reports, picture and pages into a folder; returns the file names.

        All files are replaced together, so that the page never contradicts the tables next to it.

        title : of the pages. catalogue : of the stars, for the provenance.
        """
        from sameas.front.series import write_folder
        from sameas.pages.frame import write_movers_page

        movers, series, known, below = self.found, self.field.series, self.known, self.below
        facts = {**program(), "catalogue": catalogue}
        tables = {"movers": self._detections(), "tracklets": self.options.table(movers, known)}
        if below is not None:
            tables["below-limit"] = below.table()
        if len(self.streaks):
            tables["streaks"] = self.streaks
        in_report = None if self.options.observer is None else self.options.in_report(movers)
        written = []
        with filling(folder) as draft:
            for name in ("movers", "tracklets"):
                written.append(f"{name}.fits")
                write_table(tables[name], draft / written[-1], provenance=facts)
            if in_report is not None:
                reports = [f"report.{end}" for end in REPORTS]
                _write_reports(movers, known, self.options, [draft / name for name in reports], series)
                written += reports
            for name in ("below-limit", "streaks"):
                if name in tables:
                    written.append(f"{name}.fits")
                    write_table(tables[name], draft / written[-1], provenance=facts)
            shown = None if below is None else (below.candidates.movers, below.pixels, below.known)
            page, crossed = draft / "movers.html", len(self.streaks)
            write_movers_page(page, title, movers, series, self.pixels, known, shown, in_report, crossed)
            written += ["movers.html", *self._drawn(draft)]
            link = "movers.html", self._link_words()
            written += write_folder(
                [self.field], draft, title, {"catalogue": catalogue}, self.failed, self.reasons, link
            )
        return written

    def _detections(self) -> Table:
        """One row per detection of a tracklet; ``measurement`` is its number in the table of its frame, none of a trail
        beside a star or too faint for one."""
        table = self.found.detection_table()
        table.rename_column("id", "measurement")
        trails = self.field.series.trails
        added = 0 if trails is None else trails.added
        table["measurement"] = np.ma.array(
            table["measurement"], mask=table["row"] >= len(self.field.series.row) - added
        )
        table.remove_column("row")
        return table

    def _drawn(self, folder: Path) -> list[str]:
        """Draw the first candidate, if there is one and matplotlib is installed."""
        if not len(self.pixels) or find_spec("matplotlib") is None:
            return []
        from sameas.plots.frame import mover_picture
        from sameas.plots.sheet import save

        save(mover_picture(self.found, self.field.series, self.pixels, self.known), folder / "movers.png")
        return ["movers.png"]

    def _link_words(self) -> str:
        known, movers = self.known, self.found
        names = [] if known is None else [known.name(k) for k in range(len(movers)) if known.object[k] >= 0]
        shown = ", ".join(names[:3]) + (" …" if len(names) > 3 else "")
        return f"Movers: {counted(len(movers), 'candidate')}{f', {shown} among them' if names else ''}"


def series_movers(
    frames: Sequence[IdentifiedFrame],
    options: MoverOptions,
    *,
    failed: Sequence[tuple[str, str]],
    below_limit: float | None = None,
    say: Say = lambda lines: None,
) -> SeriesMovers:
    """The movers on the frames of one field, whatever their filters.

    failed : names of frames that could not be identified, and why.
    below_limit : highest rate, arcsec/min, of the search below the detection limit; None for no such search.
    say : called with the lines of the report, section by section.

    Raises InputError: fewer than two frames, no two of one field, or several fields.
    """
    from sameas.front.series import series_of
    from sameas.sky.movers.stack import confirmed, stack
    from sameas.sky.movers.trails import streak_table, streaks, with_trails

    if len(frames) < 2:
        raise InputError(
            f"{len(frames)} of {len(frames) + len(failed)} frames could be identified; movers need two or more"
        )
    fields, reasons = series_of(frames, by_filter=False)
    say([f"{DOUBT}{reason}" for reason in reasons])
    if not fields:
        raise InputError("no two frames make a series: " + "; ".join(reasons))
    if len(fields) != 1:
        each = "; ".join(f"{len(one.members)} about {_centre(one)}" for one in fields)
        raise InputError(
            f"the frames show {len(fields)} fields ({each}); search the frames of each field by themselves"
        )
    members = fields[0].members
    tied = with_trails(fields[0].series, (one.frame() for one in members))
    movers, series = search(tied, least=options.least, min_probability=min(options.probability, FAINT))
    field = replace(fields[0], series=series)
    pixels = stack(movers, series, (one.frame() for one in members))
    movers, pixels = confirmed(movers, pixels, options.probability)
    options = replace(options, site=options.site or _site(members))
    movers = replace(movers, near_earth=near_earth_scores(movers, options.site))
    crossed = streak_table(series, streaks(series, movers.detections.rows[movers.members[movers.members >= 0]]))
    say(["", *series_lines(series), "", *model_lines(movers), "", *mover_lines(movers), *streak_lines(crossed)])
    known = None
    if options.elements is not None:
        known = name_movers(movers, options.elements, site=options.site)
        say(["", *known_lines(movers, known, options.site is not None)])
    below = None if below_limit is None else _below(movers, field, known, options, below_limit, say)
    return SeriesMovers(movers, field, pixels, known, below, crossed, options, tuple(failed), tuple(reasons))


def _below(
    movers: Movers, field: FieldSeries, known: KnownObjects | None, options: MoverOptions, fastest: float, say: Say
) -> FaintMovers:
    """The search below the detection limit, to a rate in arcsec/min."""
    from sameas.sky.movers.below_limit import Plan, search_below_limit
    from sameas.sky.movers.stack import stack

    say(["", *plan_lines(Plan.of(field.series, fastest))])
    frames = [one.frame for one in field.members]
    below = search_below_limit(movers, field.series, frames, fastest, min_probability=options.probability)
    say(below_lines(below))
    names, elements = None, options.elements
    if elements is not None and known is not None:
        named = {known.name(k) for k in range(len(movers)) if known.object[k] >= 0}
        rest = elements.some(np.array([k for k, name in enumerate(elements.name) if name not in named], np.int64))
        names = name_movers(below.movers, rest, site=options.site)
        if len(below):
            say(known_lines(below.movers, names, options.site is not None))
    pixels = stack(below.movers, field.series, (give() for give in frames), place=below.place)
    return FaintMovers(below, pixels, names)


def _centre(one: FieldSeries) -> str:
    ra, dec = one.series.middle_deg
    return f"{ra:.2f} {dec:+.2f}°"


def _site(members: Sequence[IdentifiedFrame]) -> Site | None:
    """Latitude, longitude and height of the observatory in the first frame's header."""
    from sameas.sky.frame.image import read

    place = read(members[0].request.path).facts.station
    return None if place is None else (place.lat_deg, place.lon_deg, place.height_m)
