"""``sameas frame``: identify the stars on frames and solve where the frames point."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sameas.cli.options import Debug, Folder, Quiet, frame_option, known_format, one_of, option, with_columns
from sameas.cli.outcome import INPUT_ERROR, answering
from sameas.front.options import fields_of

if TYPE_CHECKING:
    from sameas.cli.frames import Outcome
    from sameas.front.framing import FrameRequest

_PLACE, _IMAGE, _FILES = "Where it points", "The image", "Outputs"


@with_columns({"": "The catalogue's columns"})
def frame(
    images: Annotated[list[Path], typer.Argument(
        metavar="IMAGE...", show_default=False,
        help="Frames: FITS, plain or packed (.fz, .gz), or photographs (JPEG, PNG, TIFF); a folder is a series.",
    )],
    catalog: Annotated[str, option(
        "--catalog", "-c", metavar="NAME",
        help="A table, a folder of Parquet (HATS), 'bright' (whole sky, G < 10, no network) or 'gaia' (online).",
    )],
    output: Folder = Path("identified"),
    aim: Annotated[str | None, option(
        "--aim", panel=_PLACE, metavar="RA,DEC", help="Middle of the frame, degrees or 04:10:09,+22:50:22.",
    )] = None,
    radius: Annotated[
        float | None, option("--radius", panel=_PLACE, metavar="DEG", help="Largest error of the aim.")
    ] = None,
    scale: Annotated[
        str | None, option("--scale", panel=_PLACE, metavar="LO,HI", help="Arcsec per pixel, smallest and largest.")
    ] = None,
    ignore_header: Annotated[
        bool, option("--ignore-header", panel=_PLACE, help="Ignore the header's plate solution.")
    ] = False,
    time: Annotated[
        str | None, option("--time", panel=_IMAGE, metavar="DATE|YEAR", help="Middle of the exposure (UTC), or a year.")
    ] = None,
    dark: Annotated[
        list[Path] | None, option("--dark", panel=_IMAGE, metavar="FILE", help="Dark frames; repeat it.")
    ] = None,
    flat: Annotated[
        list[Path] | None, option("--flat", panel=_IMAGE, metavar="FILE", help="Flat fields; repeat it.")
    ] = None,
    bias: Annotated[
        list[Path] | None, option("--bias", panel=_IMAGE, metavar="FILE", help="Biases; repeat it.")
    ] = None,
    mask: Annotated[Path | None, option(
        "--mask", panel=_IMAGE, metavar="FILE", help="Mask image; pixels that are not 0 are not used.",
    )] = None,
    hdu: Annotated[
        str | None, option("--hdu", panel=_IMAGE, metavar="HDU", help="Number or name of the extension.")
    ] = None,
    threshold: Annotated[
        float, option("--threshold", panel=_IMAGE, metavar="SIGMAS", show_default=True, help="Detection limit.")
    ] = 4.0,
    gain: Annotated[float | None, option("--gain", panel=_IMAGE, metavar="E/ADU", help="Electrons per unit.")] = None,
    read_noise: Annotated[float | None, option("--read-noise", panel=_IMAGE, metavar="E", help="Electrons.")] = None,
    saturation: Annotated[
        float | None, option("--saturation", panel=_IMAGE, metavar="ADU", help="Saturation level.")
    ] = None,
    order: Annotated[
        int | None, option("--order", metavar="1…5", min=1, max=5, help="Order of the plate model; by default by BIC.")
    ] = None,
    magnitudes: Annotated[str, option(
        "--magnitudes", metavar="auto|off", callback=one_of(("auto", "off")), help="Brightness as evidence, or not.",
    )] = "auto",
    faintest: Annotated[
        float | None, option("--faintest", metavar="MAG", help="Faintest star used; by default the frame's limit.")
    ] = None,
    no_motion: Annotated[bool, option("--no-motion", help="Leave the stars at the catalogue's epoch.")] = False,
    brightest: Annotated[int | None, option(
        "--brightest", panel=_FILES, metavar="N", min=0, help="Mark only the N brightest identified stars.",
    )] = None,
    format: Annotated[
        str, option("--format", panel=_FILES, metavar="NAME", callback=known_format, help="Format of the star tables.")
    ] = "fits",
    wcs_copy: Annotated[
        bool, option("--wcs-copy", panel=_FILES, help="Write a copy of the frame with the solution.")
    ] = False,
    no_page: Annotated[bool, option("--no-page", panel=_FILES, help="Write no page (.html).")] = False,
    no_picture: Annotated[bool, option("--no-picture", panel=_FILES, help="Write no pictures (.png).")] = False,
    processes: Annotated[
        int, option("--processes", "-j", metavar="N", min=1, show_default=True, help="Frames at a time.")
    ] = 2,
    again: Annotated[
        bool, option("--again", help="Repeat frames that were done with the same files and options.")
    ] = False,
    quiet: Quiet = False,
    debug: Debug = False,
    **columns: Any,
) -> None:  # fmt: skip
    """Identify the stars on frames with a catalogue: table, plate solution, regions, pictures and a page each.

    A frame is placed by its header, or an aim and a scale, or a range of scales alone. What is done already is not
    done again. Of a folder the frames of one field and filter are a series: one table of stars, zero points, a page.
    """
    with answering(debug, frame_option):
        from sameas.cli.frames import aim_of, expanded, names_of, scale_of
        from sameas.front.framing import FrameRequest, given_values
        from sameas.front.pointing import PointingOptions

        paths = expanded(
            [str(path) for path in images], [str(path) for path in (*(dark or ()), *(flat or ()), *(bias or ()))]
        )
        pointing = PointingOptions(aim_of(aim), radius, scale_of(scale), header=not ignore_header)
        requests = [
            FrameRequest(
                path=path,
                folder=str(output),
                name=name,
                catalogue=catalog,
                pointing=pointing,
                columns=fields_of(columns, 1),
                given=given_values(gain, read_noise, saturation),
                time=time,
                hdu=hdu,
                mask=None if mask is None else str(mask),
                darks=tuple(map(str, dark or ())),
                flats=tuple(map(str, flat or ())),
                biases=tuple(map(str, bias or ())),
                threshold_sigmas=threshold,
                order=order,
                magnitudes=magnitudes,  # type: ignore[arg-type]
                faintest=faintest,
                motion=not no_motion,
                brightest=brightest,
                format=format,
                page=not no_page,
                picture=not no_picture,
                copy=wcs_copy,
            )
            for path, name in zip(paths, names_of(paths), strict=True)
        ]
        title = next((path.resolve().name for path in images if path.is_dir()), None)
        failed = _run(requests, processes, again, quiet, title)
    if failed:
        raise typer.Exit(INPUT_ERROR)


def _run(requests: list[FrameRequest], processes: int, again: bool, quiet: bool, series: str | None) -> bool:
    """Process the frames and print their lines; returns whether any failed.

    series : name of the series of a folder; None for frames that were given one by one.
    """
    from sameas.cli.frames import identified, print_outcome, run_all
    from sameas.cli.terminal import Printer, notice, share_compilation
    from sameas.report.frame import frame_lines, frames_lines, totals

    printer = Printer(quiet)
    many = len(requests) > 1
    share_compilation(quiet, "frame")

    def tell(outcome: Outcome) -> None:
        if many:
            print_outcome(outcome, printer)
        elif outcome.summary is None:
            notice(outcome.error)
        else:
            printer(frame_lines(outcome.summary))
            printer(["", *_written(outcome)])

    outcomes = run_all(requests, processes=processes, again=again, quiet=quiet, tell=tell)
    if many:
        failed, skipped = sum(o.summary is None for o in outcomes), sum(o.skipped for o in outcomes)
        printer([totals(len(outcomes) - failed - skipped, skipped, failed)])
        printer(frames_lines([one.summary for one in outcomes if one.summary is not None]))
        if series is None:
            printer(["Each by itself; give their folder instead for a series: stars over all frames, and one page"])
    if series is not None:
        from sameas.front.series import folder_of_series

        first = requests[0]
        facts = {"catalogue": first.catalogue}
        written = folder_of_series(*identified(outcomes), Path(first.folder), series, facts, say=printer)
        printer([f"Output: {first.folder}/: {', '.join(written)}"])
    return any(outcome.summary is None for outcome in outcomes)


def _written(outcome: Outcome) -> list[str]:
    names = ", ".join(path.name for path in (*outcome.request.outputs().values(), outcome.request.summary_path))
    state = "done before, not repeated (use --again)" if outcome.skipped else f"{outcome.seconds:.1f} s"
    return [f"Output: {outcome.request.folder}/: {names}", f"Time: {state}"]
