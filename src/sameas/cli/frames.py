"""Many frames in several processes, with a progress row each. A frame that fails does not stop the others."""

from __future__ import annotations

import math
import multiprocessing
import signal
import sys
import threading
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
from sameas.cli.terminal import Printer, notice
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


#: Rows of progress that a terminal shows at once.
ROWS = 14


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
    requests: Sequence[FrameRequest], *, processes: int, again: bool, shown: bool, tell: Callable[[Outcome], None]
) -> list[Outcome]:
    """The outcomes of all frames, in the order of the frames.

    processes : number of worker processes. again : repeat frames that have outputs. shown : show progress rows on a
    terminal. tell : called with each outcome, in that order, when it and all before it are complete.
    """
    if len(requests) == 1 or processes == 1:
        outcomes = []
        with _rows(requests, shown) as row:
            for number, request in enumerate(requests):
                outcome = _one(request, again, lambda stage, number=number: row(number, stage))  # type: ignore[misc]
                row(number, _state(outcome))
                tell(outcome)
                outcomes.append(outcome)
        return outcomes
    return _in_processes(requests, processes, again, shown, tell)


def _in_processes(
    requests: Sequence[FrameRequest], processes: int, again: bool, shown: bool, tell: Callable[[Outcome], None]
) -> list[Outcome]:
    # A forked process inherits locks held by threads that do not exist in it.
    context = multiprocessing.get_context("spawn")
    stages = context.SimpleQueue()
    outcomes: dict[int, Outcome] = {}
    with (
        _rows(requests, shown) as row,
        ProcessPoolExecutor(
            min(processes, len(requests)), mp_context=context, initializer=_begin, initargs=(stages,)
        ) as pool,
    ):
        listener = threading.Thread(target=_listen, args=(stages, row), daemon=True)
        listener.start()
        futures: dict[Future[Outcome], int] = {}
        told = 0
        try:
            with _without_interrupts():
                for number, request in enumerate(requests):
                    futures[pool.submit(_worked, number, request, again)] = number
            for future in as_completed(futures):
                number = futures[future]
                try:
                    outcome = future.result()
                except Exception as error:  # the process itself has died
                    outcome = Outcome(requests[number], None, f"{requests[number].path}: the process ended ({error})")
                row(number, _state(outcome))
                outcomes[number] = outcome
                while told in outcomes:
                    tell(outcomes[told])
                    told += 1
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
        finally:
            stages.put(None)
        listener.join(1.0)
    return [outcomes[number] for number in range(len(requests))]


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


_stages: Any = None


def _begin(stages: Any) -> None:
    """Initialise a worker process."""
    import warnings

    global _stages
    _stages = stages
    end_with_parent()
    end_cleanly_on_sigterm(worker=True)
    warnings.simplefilter("ignore")


def _worked(number: int, request: FrameRequest, again: bool) -> Outcome:
    return _one(request, again, lambda stage: _stages.put((number, stage)))


def _listen(stages: Any, row: Callable[[int, str], None]) -> None:
    while (message := stages.get()) is not None:
        row(*message)


def _one(request: FrameRequest, again: bool, progress: Callable[[str], None]) -> Outcome:
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


def _state(outcome: Outcome) -> str:
    if outcome.summary is None:
        return "failed"
    return "done before" if outcome.skipped else f"done in {outcome.seconds:.1f} s"


@contextmanager
def _rows(requests: Sequence[FrameRequest], shown: bool) -> Iterator[Callable[[int, str], None]]:
    """A function (number of the frame, stage) that updates the frame's progress row; finished rows are removed."""
    if not (shown and sys.stderr.isatty()):
        yield lambda number, stage: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn("{task.fields[frame]}"), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        tasks: dict[int, Any] = {}

        def row(number: int, stage: str) -> None:
            if number not in tasks:
                tasks[number] = progress.add_task(stage, total=1, frame=requests[number].name)
            ended = stage.startswith(("done", "failed"))
            progress.update(tasks[number], description=stage, completed=int(ended))
            over = [k for k, task in tasks.items() if progress.tasks[progress.task_ids.index(task)].finished]
            for k in over[: max(0, len(tasks) - ROWS)]:
                progress.remove_task(tasks.pop(k))

        yield row
