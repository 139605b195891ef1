"""``sameas frame``: which stars are on frames, and where the frames point."""

from __future__ import annotations

from typing import Any

import typer

from sameas.cli.arguments import Debug, Quiet
from sameas.cli.frame_arguments import (
    Again,
    AimAt,
    Biases,
    Brightest,
    Brightness,
    Darks,
    Faintest,
    Flats,
    Folder,
    Gain,
    Hdu,
    Images,
    Mask,
    NoHeader,
    NoMotion,
    NoPage,
    NoPicture,
    OffBy,
    Order,
    Processes,
    ReadNoise,
    Saturation,
    Scale,
    StarCatalogue,
    TableFormat,
    Threshold,
    WcsCopy,
    When,
    with_own_columns,
)
from sameas.cli.options import fields_of, frame_option
from sameas.cli.outcome import INPUT_ERROR, answering


@with_own_columns
def frame(
    images: Images,
    catalog: StarCatalogue,
    output: Folder = "identified",  # type: ignore[assignment]
    aim: AimAt = None,
    radius: OffBy = None,
    scale: Scale = None,
    ignore_header: NoHeader = False,
    time: When = None,
    dark: Darks = None,
    flat: Flats = None,
    bias: Biases = None,
    mask: Mask = None,
    hdu: Hdu = None,
    threshold: Threshold = 4.0,
    gain: Gain = None,
    read_noise: ReadNoise = None,
    saturation: Saturation = None,
    order: Order = None,
    magnitudes: Brightness = "auto",
    faintest: Faintest = None,
    no_motion: NoMotion = False,
    brightest: Brightest = 1000,
    format: TableFormat = "fits",
    wcs_copy: WcsCopy = False,
    no_page: NoPage = False,
    no_picture: NoPicture = False,
    processes: Processes = 2,
    again: Again = False,
    quiet: Quiet = False,
    debug: Debug = False,
    **columns: Any,
) -> None:
    """Identify the stars on frames with a catalogue: table, plate solution, regions, pictures and a page each.

    A frame is placed by its header, or an aim and a scale, or a range of scales alone. What is done already is not
    done again.
    """
    with answering(debug, frame_option):
        from sameas.cli.framing import FrameRequest
        from sameas.cli.pointing_hints import PointingOptions, aim_of, scale_of

        said = PointingOptions(aim_of(aim), radius, scale_of(scale), header=not ignore_header)
        given = {"gain_e_per_adu": gain, "read_noise_e": read_noise, "saturation_adu": saturation}
        requests = [
            FrameRequest(
                path=str(path),
                folder=str(output),
                name=name,
                catalogue=catalog,
                said=said,
                columns=fields_of(columns, 1),
                given={key: value for key, value in given.items() if value is not None},
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
            for path, name in zip(images, _names([str(path) for path in images]), strict=True)
        ]
        failed = _run(requests, processes, again, quiet)
    if failed:
        raise typer.Exit(INPUT_ERROR)


def _names(paths: list[str]) -> list[str]:
    """Names of the outputs: the frames' names without their endings, with their folders' where two are the same."""
    from pathlib import Path

    from sameas.errors import InputError

    stems = [_stem(path) for path in paths]
    names = [
        stem if stems.count(stem) == 1 else f"{Path(path).resolve().parent.name}-{stem}"
        for stem, path in zip(stems, paths, strict=True)
    ]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"two frames would both be written as {twice}; give each once, or use a folder for each")
    return names


def _stem(path: str) -> str:
    from pathlib import Path

    name = Path(path).name
    for packed in (".gz", ".fz"):
        name = name.removesuffix(packed)
    return name.rpartition(".")[0] or name


def _run(requests: list[Any], processes: int, again: bool, quiet: bool) -> bool:
    """Does the frames, prints what is to be said; whether any failed."""
    from sameas.cli.frames import Outcome, run_all
    from sameas.cli.terminal import Printer, notice, tell_compilation
    from sameas.report.frame import frame_lines, one_line, totals

    printer = Printer(quiet)
    many = len(requests) > 1
    if not quiet:
        tell_compilation()

    def tell(outcome: Outcome) -> None:
        if outcome.told is None:
            notice(f"{outcome.request.name}: {outcome.error}" if many else outcome.error)
        elif many:
            state = "done before" if outcome.skipped else f"{outcome.seconds:.1f} s"
            printer([one_line(outcome.request.name, outcome.told, state)])
        else:
            printer(frame_lines(outcome.told))
            printer(["", *_written(outcome)])

    outcomes = run_all(requests, processes=processes, again=again, shown=not quiet, tell=tell)
    if many:
        failed, skipped = sum(o.told is None for o in outcomes), sum(o.skipped for o in outcomes)
        printer([totals(len(outcomes) - failed - skipped, skipped, failed)])
    return any(outcome.told is None for outcome in outcomes)


def _written(outcome: Any) -> list[str]:
    names = ", ".join(path.name for path in (*outcome.request.outputs().values(), outcome.request.summary_path))
    state = "done before, not repeated (--again does)" if outcome.skipped else f"{outcome.seconds:.1f} s"
    return [f"Output: {outcome.request.folder}/: {names}", f"Time: {state}"]
