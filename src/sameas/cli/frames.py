"""Many frames in several processes. A frame that fails does not stop the others."""

from __future__ import annotations

import math
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.cli.options import frame_option, in_options
from sameas.cli.outcome import end_cleanly_on_sigterm, fault, interruption
from sameas.cli.outputs import keep_freed_memory
from sameas.cli.terminal import Pace, Printer, notice
from sameas.errors import InputError
from sameas.front.framing import FrameRequest, fulfil
from sameas.front.pointing import CLOSE
from sameas.io.atomic import end_with_parent

if TYPE_CHECKING:
    from sameas.front.series import IdentifiedFrame

#: Bytes of freed memory that are kept for later arrays of frames.
FRAME_BYTES = 1 << 29


def two_numbers(text: str, option: str, what: str) -> tuple[float, float]:
    """``A,B`` as two numbers."""
    try:
        one, two = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{option} {text}: give {what}") from None
    return one, two


def aim_of(text: str | None) -> tuple[float, float] | None:
    """``RA,DEC`` in degrees, or sexagesimal with right ascension in hours."""
    if text is None:
        return None
    what = "RA,DEC in degrees, or 04:10:09,+22:50:22"
    if ":" not in text and "h" not in text:
        ra, dec = two_numbers(text, "--aim", what)
    else:
        from astropy.coordinates import SkyCoord

        try:
            at = SkyCoord(*text.split(","), unit=("hourangle", "deg"))
        except (ValueError, TypeError) as error:
            raise InputError(f"--aim {text}: give {what}") from error
        ra, dec = float(at.ra.deg), float(at.dec.deg)
    if not (math.isfinite(ra) and -90 <= dec <= 90):
        raise InputError(f"--aim {text}: give {what}")
    return ra % 360.0, dec


def scale_of(text: str | None) -> tuple[float, float] | None:
    """``LO,HI``, or one number ± 5 %."""
    if text is None:
        return None
    if "," not in text:
        one, _ = two_numbers(f"{text},0", "--scale", "LO,HI in arcsec per pixel")
        low, high = one * (1 - CLOSE), one * (1 + CLOSE)
    else:
        low, high = two_numbers(text, "--scale", "LO,HI in arcsec per pixel")
    if not 0 < low <= high < math.inf:
        raise InputError(f"--scale {text}: give LO,HI in arcsec per pixel, both above zero, the smaller one first")
    return low, high


@dataclass(frozen=True)
class Outcome:
    """The result of one frame: its summary, or an error. skipped : the outputs of an earlier run were kept."""

    request: FrameRequest
    summary: dict[str, Any] | None
    error: str = ""
    skipped: bool = False
    seconds: float = 0.0


def identified(outcomes: Sequence[Outcome]) -> tuple[list[IdentifiedFrame], list[tuple[str, str]]]:
    """The identified frames; and the names of the others, with their errors."""
    from sameas.front.series import IdentifiedFrame

    done = [IdentifiedFrame(one.request, one.summary) for one in outcomes if one.summary is not None]
    return done, [(one.request.name, one.error) for one in outcomes if one.summary is None]


def print_outcome(outcome: Outcome, printer: Printer) -> None:
    """Print one line about one of several frames."""
    from sameas.report.frame import one_line

    if outcome.summary is None:
        notice(f"{outcome.request.name}: {outcome.error}")
    else:
        state = "done before" if outcome.skipped else f"{outcome.seconds:.1f} s"
        printer([one_line(outcome.request.name, outcome.summary, state)])


def expanded(paths: Sequence[str], others: Sequence[str] = ()) -> list[str]:
    """The frames, with folders replaced by their frames. others : calibration frames, which are excluded.

    Further calibration frames in a folder are excluded with a notice.
    """
    from sameas.front.series import calibrations_in, frames_in
    from sameas.representation import counted

    excluded = {Path(other).resolve() for other in others}
    frames: list[str] = []
    for path in paths:
        if not Path(path).is_dir():
            frames.append(path)
            continue
        frames += [one for one in frames_in(path) if Path(one).resolve() not in excluded]
        unused = [Path(one).name for one in calibrations_in(path) if Path(one).resolve() not in excluded]
        if unused:
            left = counted(len(unused), "calibration frame")
            notice(
                f"{path}: {left} not used, the first {unused[0]}; --dark, --flat and --bias FILE calibrate with them"
            )
    return frames


def names_of(paths: list[str]) -> list[str]:
    """Names of the outputs: file names without extensions, preceded by the folder's name where two are equal."""
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
    name = Path(path).name
    for packed in (".gz", ".fz"):
        name = name.removesuffix(packed)
    return name.rpartition(".")[0] or name


def run_all(
    requests: Sequence[FrameRequest], *, processes: int, again: bool, quiet: bool, tell: Callable[[Outcome], None]
) -> list[Outcome]:
    """The outcomes of all frames, in the order of the frames.

    processes : number of worker processes. again : repeat frames that have outputs. quiet : show no progress. tell :
    called with each outcome, in that order, when it and all before it are complete.
    """
    outcomes: list[Outcome] = []
    with Pace(quiet) as pace:

        def add(outcome: Outcome) -> None:
            pace.pause()
            tell(outcome)
            outcomes.append(outcome)

        if len(requests) == 1 or processes == 1:
            for request in requests:
                add(_one(request, again, lambda stage, one=request: pace(f"{one.name}: {stage}")))  # type: ignore[misc]
        else:
            _in_processes(requests, processes, again, pace, add)
    return outcomes


def _in_processes(
    requests: Sequence[FrameRequest], processes: int, again: bool, pace: Pace, tell: Callable[[Outcome], None]
) -> None:
    # A forked process inherits locks held by threads that do not exist in it.
    context = multiprocessing.get_context("spawn")
    outcomes: dict[int, Outcome] = {}
    with ProcessPoolExecutor(min(processes, len(requests)), mp_context=context, initializer=_begin) as pool:
        futures: dict[Future[Outcome], int] = {}
        told = 0
        try:
            with _without_interrupts():
                for number, request in enumerate(requests):
                    futures[pool.submit(_one, request, again)] = number
            pace(f"{len(requests)} frames")
            for future in as_completed(futures):
                number = futures[future]
                try:
                    outcome = future.result()
                except Exception as error:  # the process itself has died
                    outcome = Outcome(requests[number], None, f"{requests[number].path}: the process ended ({error})")
                outcomes[number] = outcome
                while told in outcomes:
                    tell(outcomes[told])
                    told += 1
                pace(f"{len(outcomes)} of {len(requests)} frames done")
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Processes started in the block ignore Ctrl-C, which a terminal sends to all; their parent terminates them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


def _begin() -> None:
    """Initialise a worker process."""
    import warnings

    end_with_parent()
    end_cleanly_on_sigterm(worker=True)
    warnings.simplefilter("ignore")


def _one(request: FrameRequest, again: bool, progress: Callable[[str], None] = lambda stage: None) -> Outcome:
    began = time.perf_counter()
    keep_freed_memory(FRAME_BYTES)
    try:
        earlier = None if again else request.done()
        if earlier is not None:
            return Outcome(request, earlier, skipped=True)
        summary = fulfil(request, progress, partial(in_options, option=frame_option))
        return Outcome(request, summary, seconds=time.perf_counter() - began)
    except InputError as error:
        return Outcome(request, None, in_options(error.words, frame_option), seconds=time.perf_counter() - began)
    except MemoryError:
        return Outcome(request, None, f"{request.path}: not enough memory for this frame")
    except Exception as error:
        interrupt = interruption(error)
        if interrupt is not None:
            raise interrupt from error
        return Outcome(request, None, f"{request.path}: {fault(error)}", seconds=time.perf_counter() - began)
