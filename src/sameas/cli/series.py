"""A series of frames on the command line: identify every frame, find what moves, name and report it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import sameas
from sameas.errors import InputError
from sameas.front.framing import FrameRequest, PointingOptions
from sameas.front.provenance import program
from sameas.representation import counted

#: Tracklets of at least this probability are measured in the pixels, which may raise their probability.
FAINT = 0.02


@dataclass(frozen=True)
class SeriesRequest:
    """The inputs and options of a search for movers on a series of frames.

    Attributes
    ----------
    paths : frames, or folders of them. catalogue, columns : star catalogue and its columns. folder : of the outputs.
    pointing : pointing hints. darks, flats, biases : calibration frames.
    least, probability : minimum number of detections and minimum probability of a tracklet.
    elements : file of known objects, or None. header : TOML of the report, or None. reported : minimum probability of
        a tracklet in the report.
    processes : number of worker processes. below_limit : highest rate, arcsec/min, of the search below the detection
        limit; None for no such search.
    site : latitude, longitude, height of the observer; None takes the frame's header.
    """

    paths: tuple[str, ...]
    catalogue: str
    columns: dict[str, Any]
    folder: Path
    pointing: PointingOptions
    darks: tuple[str, ...]
    flats: tuple[str, ...]
    biases: tuple[str, ...]
    least: int
    probability: float
    elements: str | None
    header: str | None
    reported: float
    processes: int
    below_limit: float | None = None
    site: tuple[float, float, float] | None = None


def run(request: SeriesRequest, quiet: bool) -> None:
    """Identify the frames, combine them to a series, search, name, report, print."""
    import numpy as np

    from sameas.cli.frames import expanded, names_of, run_all
    from sameas.cli.terminal import Printer, notice, share_compilation
    from sameas.front.series import Identified, series_of
    from sameas.io import write_table
    from sameas.io.ades import REPORTS, Observer, observations
    from sameas.io.atomic import filling
    from sameas.pages.movers import write_movers_page
    from sameas.report.frame import one_line
    from sameas.report.movers import known_lines, model_lines, mover_lines, report_lines, series_lines
    from sameas.report.prose import DOUBT
    from sameas.sky.movers.known import name_movers, near_earth_scores
    from sameas.sky.movers.orbits import Elements
    from sameas.sky.movers.search import search
    from sameas.sky.movers.stack import confirmed, stack, with_trails

    began, printer = time.perf_counter(), Printer(quiet)
    observer = None if request.header is None else Observer.read(request.header)
    elements = None if request.elements is None else Elements.read(request.elements)
    share_compilation(quiet)
    paths = expanded(request.paths, (*request.darks, *request.flats, *request.biases))
    requests = [_frame_request(request, path, name) for path, name in zip(
        paths, names_of(paths), strict=True)]  # fmt: skip

    def tell(outcome: Any) -> None:
        if outcome.summary is None:
            notice(f"{outcome.request.name}: {outcome.error}")
        else:
            state = "done before" if outcome.skipped else f"{outcome.seconds:.1f} s"
            printer([one_line(outcome.request.name, outcome.summary, state)])

    outcomes = run_all(requests, processes=request.processes, again=False, shown=not quiet, tell=tell)
    done = [Identified(one.request, one.summary) for one in outcomes if one.summary is not None]
    if len(done) < 2:
        raise InputError(f"{len(done)} of {len(outcomes)} frames could be identified; movers need two or more")
    each, reasons = series_of(done, by_filter=False)
    printer([f"{DOUBT}{reason}" for reason in reasons])
    if len(each) != 1:
        fields = "; ".join(f"{len(one.members)} about {_about(one)}" for one in each) or "no two of one field"
        raise InputError(
            f"the frames show {len(each)} fields ({fields}); search the frames of each field by themselves"
        )
    tied = with_trails(each[0].series, (one.frame() for one in each[0].members))
    found, series = search(tied, least=request.least, least_probability=min(request.probability, FAINT))
    each = [replace(each[0], series=series)]
    pixels = stack(found, series, (one.frame() for one in each[0].members))
    found, pixels = confirmed(found, pixels, request.probability)
    site = request.site or _site(each[0].members)
    found = replace(found, near_earth=near_earth_scores(found, site))
    printer(["", *series_lines(series), "", *model_lines(found), "", *mover_lines(found)])
    known = None
    if elements is not None:
        known = name_movers(found, elements, site=site)
        printer(["", *known_lines(found, known, site is not None)])
    below = None if request.below_limit is None else _below(request, found, each[0], known, elements, site, printer)
    facts = {**program(), "catalogue": request.catalogue}
    written = ["movers.fits", "tracklets.fits"]
    failed = [(one.request.name, one.error) for one in outcomes if one.summary is None]
    title = _title(request.paths)
    tracklets = found.table()
    if known is not None:
        known.into(tracklets, found)
    in_report = None if observer is None else found.p_tracklet >= request.reported
    if in_report is not None:
        tracklets["in_report"] = in_report
    # All files are replaced together, so that the page never contradicts the tables next to it.
    with filling(request.folder) as draft:
        write_table(found.detection_table(), draft / written[0], provenance=facts)
        write_table(tracklets, draft / written[1], provenance=facts)
        if observer is not None and in_report is not None:
            rows = observations(found, known, np.flatnonzero(in_report), series)
            software = f"sameas {sameas.__version__}"
            for end, write in REPORTS.items():
                written.append(f"report.{end}")
                write(rows, observer, draft / written[-1], software=software)
        if below is not None:
            written.append("below-limit.fits")
            write_table(_below_table(below[0], below[2]), draft / written[-1], provenance=facts)
        shown = None if below is None else (below[0].movers, *below[1:])
        write_movers_page(draft / "movers.html", title, found, series, pixels, known, shown, in_report)
        link = "movers.html", _link_words(found, known)
        written += [
            "movers.html",
            *_drawn(draft, found, series, pixels, known),
            *_product(each, draft, title, {"catalogue": request.catalogue}, failed, reasons, link),
        ]
    if observer is not None:
        printer(["", *report_lines(found, request.reported)])
    printer(["", f"Output: {request.folder}/: {', '.join(written)}", f"Time: {time.perf_counter() - began:.1f} s"])


def _below(
    request: SeriesRequest, found: Any, field: Any, known: Any, elements: Any, site: Any, printer: Any
) -> tuple[Any, Any, Any]:
    """The search below the detection limit: candidates, their stacked pixels, and their names among known objects."""
    import numpy as np

    from sameas.report.movers import below_lines, known_lines, plan_lines
    from sameas.sky.movers.below_limit import Plan, search_below_limit
    from sameas.sky.movers.known import name_movers
    from sameas.sky.movers.stack import stack

    fastest = request.below_limit or 0.0
    printer(["", *plan_lines(Plan.of(field.series, fastest))])
    frames = [one.frame for one in field.members]
    below = search_below_limit(found, field.series, frames, fastest, least_probability=request.probability)
    printer(below_lines(below))
    names = None
    if elements is not None:
        named = {known.name(k) for k in range(len(found)) if known.object[k] >= 0}
        rest = elements.some(np.array([k for k, name in enumerate(elements.name) if name not in named], np.int64))
        names = name_movers(below.movers, rest, site=site)
        if len(below):
            printer(known_lines(below.movers, names, site is not None))
    pixels = stack(below.movers, field.series, (give() for give in frames), place=below.place)
    return below, pixels, names


def _below_table(below: Any, known: Any) -> Any:
    """The table of candidates below the detection limit of single frames, one row each."""
    import numpy as np

    table = below.movers.table()
    table.remove_columns(["n_detections", "p_exact", "log_odds"])
    table["snr"], table["frames"] = below.snr, below.frames
    table["magnitude"] = np.ma.masked_invalid(below.movers.detections.magnitude[below.movers.members[:, 0]])
    table["magnitude"].unit = "mag"
    if known is not None:
        known.into(table, below.movers)
    return table


def product(outcomes: Sequence[Any], folder: Path, title: str, facts: dict[str, Any], quiet: bool) -> None:
    """Write the tables and the index page of a folder of frames: its series, and the frames outside of any."""
    from sameas.cli.terminal import Printer
    from sameas.front.series import Identified, series_of
    from sameas.io.atomic import filling
    from sameas.report.movers import star_lines
    from sameas.report.prose import DOUBT

    printer = Printer(quiet)
    each, reasons = series_of([Identified(one.request, one.summary) for one in outcomes if one.summary is not None])
    for one in each:
        printer(["", *star_lines(one.series, one.filter)])
    printer([f"{DOUBT}{reason}" for reason in reasons])
    failed = [(one.request.name, one.error) for one in outcomes if one.summary is None]
    with filling(folder) as draft:
        written = _product(each, draft, title, facts, failed, reasons)
    printer([f"Output: {folder}/: {', '.join(written)}"])


def _product(
    each: Sequence[Any], folder: Path, title: str, facts: dict[str, Any], failed: list[tuple[str, str]],
    reasons: list[str], movers: tuple[str, str] | None = None,
) -> list[str]:  # fmt: skip
    from sameas.front.series import doubts_of, write_series
    from sameas.pages.movers import series_field, write_series_page

    written = write_series(each, folder, facts)
    fields = [
        series_field(
            one.name,
            one.series,
            [m.summary for m in one.members],
            [doubts_of(m.summary) for m in one.members],
            one.filter,
        )
        for one in each
    ]
    write_series_page(folder / "index.html", title, fields, failed=failed, reasons=reasons, movers=movers)
    return [*written, "index.html"]


def _title(paths: Sequence[str]) -> str:
    """Name of a series: the folder of its first frame."""
    first = Path(paths[0]).resolve()
    return (first if first.is_dir() else first.parent).name


def _about(one: Any) -> str:
    ra, dec = one.series.middle_deg
    return f"{ra:.2f} {dec:+.2f}°"


def _frame_request(request: SeriesRequest, path: str, name: str) -> FrameRequest:
    return FrameRequest(
        path=path, folder=str(request.folder), name=name, catalogue=request.catalogue, pointing=request.pointing,
        columns=request.columns, darks=request.darks, flats=request.flats, biases=request.biases, page=False,
        picture=False,
    )  # fmt: skip


def _link_words(found: Any, known: Any) -> str:
    names = [] if known is None else [known.name(k) for k in range(len(found)) if known.object[k] >= 0]
    shown = ", ".join(names[:3]) + (" …" if len(names) > 3 else "")
    return f"Movers: {counted(len(found), 'candidate')}{f', {shown} among them' if names else ''}"


def _drawn(folder: Path, found: Any, series: Any, pixels: Any, known: Any) -> list[str]:
    """Draw the first candidate, if there is one and matplotlib is installed."""
    if not len(pixels) or find_spec("matplotlib") is None:
        return []
    from sameas.plots.movers import mover_picture
    from sameas.plots.sheet import save

    save(mover_picture(found, series, pixels, known), folder / "movers.png")
    return ["movers.png"]


def _site(done: tuple[Any, ...]) -> tuple[float, float, float] | None:
    """Latitude, longitude and height of the observatory in the first frame's header."""
    from sameas.sky.frame.image import read

    place = read(done[0].request.path).facts.station
    return None if place is None else (place.lat_deg, place.lon_deg, place.height_m)
