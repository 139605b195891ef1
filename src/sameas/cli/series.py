"""A series of frames on the command line: every frame identified, then what moves on them, named and reported."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sameas
from sameas.errors import InputError
from sameas.front.framing import FrameRequest, PointingOptions


@dataclass(frozen=True)
class SeriesRequest:
    """What is wanted of a series.

    paths : of the frames. catalogue, columns : of the stars. folder : of the outputs. pointing : where frames point.
    darks, flats, biases : calibration frames. least, probability : of a tracklet. elements : file of known objects, or
    None. header : TOML of the report, or None. processes : frames at a time.
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
    processes: int


def run(request: SeriesRequest, quiet: bool) -> None:
    """Identify the frames, tie them together, search, name, report, say."""
    from sameas.cli.frame import _names
    from sameas.cli.frames import run_all
    from sameas.cli.terminal import Printer, notice, share_compilation
    from sameas.io import write_table
    from sameas.io.ades import Observer, write_80_columns, write_psv, write_xml
    from sameas.report.frame import one_line
    from sameas.report.movers import known_lines, model_lines, mover_lines, series_lines
    from sameas.sky.movers.known import name_movers
    from sameas.sky.movers.orbits import Elements
    from sameas.sky.movers.series import search, tie

    began, printer = time.perf_counter(), Printer(quiet)
    observer = None if request.header is None else Observer.read(request.header)
    elements = None if request.elements is None else Elements.read(request.elements)
    share_compilation(quiet)
    requests = [_frame_request(request, path, name) for path, name in zip(
        request.paths, _names(list(request.paths)), strict=True)]  # fmt: skip

    def tell(outcome: Any) -> None:
        if outcome.told is None:
            notice(f"{outcome.request.name}: {outcome.error}")
        else:
            state = "done before" if outcome.skipped else f"{outcome.seconds:.1f} s"
            printer([one_line(outcome.request.name, outcome.told, state)])

    outcomes = run_all(requests, processes=request.processes, again=False, shown=not quiet, tell=tell)
    done = [one for one in outcomes if one.told is not None]
    if len(done) < 2:
        raise InputError(f"{len(done)} of {len(outcomes)} frames could be identified; what moves shows on two or more")
    series = tie([_exposure(one) for one in done])
    found, series = search(series, least=request.least, least_probability=request.probability)
    printer(["", *series_lines(series), "", *model_lines(found), "", *mover_lines(found)])
    site = _site(done)
    known = None
    if elements is not None:
        known = name_movers(found, elements, site=site)
        printer(["", *known_lines(found, known, site is not None)])
    facts = {"program": "sameas", "version": sameas.__version__, "catalogue": request.catalogue}
    written = ["movers.fits", "tracklets.fits"]
    write_table(found.detection_table(), request.folder / written[0], provenance=facts, overwrite=True)
    write_table(found.table(), request.folder / written[1], provenance=facts, overwrite=True)
    if observer is not None:
        rows, software = observations(found, series, known), f"sameas {sameas.__version__}"
        for name, write in (("report.psv", write_psv), ("report.xml", write_xml), ("report.txt", write_80_columns)):
            write(rows, observer, request.folder / name, software=software)
            written.append(name)
    printer(["", f"Output: {request.folder}/: {', '.join(written)}", f"Time: {time.perf_counter() - began:.1f} s"])


def _frame_request(request: SeriesRequest, path: str, name: str) -> FrameRequest:
    return FrameRequest(
        path=path, folder=str(request.folder), name=name, catalogue=request.catalogue, said=request.pointing,
        columns=request.columns, darks=request.darks, flats=request.flats, biases=request.biases, page=False,
        picture=False,
    )  # fmt: skip


def _exposure(outcome: Any) -> Any:
    """The measurements of a frame that was identified, from its outputs."""
    from astropy.time import Time

    from sameas.io import read_table
    from sameas.sky.movers.series import Exposure

    told = outcome.told
    if told["exposure"]["mid_time"] is None:
        raise InputError(f"{told['frame']}: the header has no time of the exposure; what moves cannot be told without")
    date, scale = told["exposure"]["mid_time"].split()
    place = told["place"]
    return Exposure.of_listing(
        read_table(outcome.request.outputs()["table"]), told["frame"], float(Time(date, scale=scale.lower()).utc.mjd),
        place["scale_arcsec_per_px"], (place["rows"], place["columns"]), float(told["exposure"]["exposure_s"] or "nan"),
    )  # fmt: skip


def _site(done: list[Any]) -> tuple[float, float, float] | None:
    """Latitude, longitude and height of the observatory as the first frame's header has them."""
    from sameas.sky.frame.image import read

    place = read(done[0].request.path).facts.station
    return None if place is None else (place.lat_deg, place.lon_deg, place.height_m)


def observations(found: Any, series: Any, known: Any) -> list[Any]:
    """The rows of a report, tracklet by tracklet."""
    import numpy as np
    from astropy.time import Time

    from sameas.io.ades import Observation

    seen, out = found.detections, []
    for k, members in enumerate(found.members):
        for row in members[members >= 0].tolist():
            at = int(seen.rows[row])
            exposure = series.exposures[series.frame[at]]
            east, both, north = exposure.covariance[series.row[at]]
            flux, error = exposure.flux[series.row[at]], exposure.flux_err[series.row[at]]
            out.append(
                Observation(
                    found.names[k],
                    str(Time(seen.mjd_utc[row], format="mjd", scale="utc").isot),
                    float(seen.ra_deg[row]),
                    float(seen.dec_deg[row]),
                    float(np.sqrt(east)),
                    float(np.sqrt(north)),
                    float(both / np.sqrt(east * north)),
                    float(exposure.magnitude[series.row[at]]),
                    float(1.0857 * error / flux) if flux > 0 else float("nan"),
                    float(exposure.snr[series.row[at]]),
                    permanent="" if known is None else known.number(k),
                )
            )
    return out
