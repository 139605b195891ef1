"""Outcomes: how a command ends, in one line and an exit code.

0 done; 1 the input cannot be used, or nothing useful was done; 2 wrong usage (typer's); 130 interrupted; 143 asked to
end (SIGTERM).
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import typer

from sameas.cli.options import in_options, option_of
from sameas.errors import Argument, InputError, printable

INPUT_ERROR, INTERRUPTED, TERMINATED = 1, 130, 143
#: Seconds in which the main thread may end by itself: an answer within a second is promised. Those of a worker, so that
#: it has ended before the one who started it; those in which it may end when it is asked to.
PATIENCE_S, PATIENCE_OF_WORKERS_S, ENDING_S = 0.7, 0.2, 0.4
#: What the system refuses, which is no fault of ours.
_OF_THE_SYSTEM = {
    errno.ENAMETOOLONG: "the name is too long for a file; give a shorter one",
    errno.ELOOP: "a link that leads to itself",
    errno.ENOTDIR: "a part of this path is a file, not a folder",
    errno.EMFILE: "too many open files; raise the limit (ulimit -n)",
    errno.ENFILE: "too many open files in this system",
    errno.EAGAIN: "no more threads or processes are allowed; raise the limit (ulimit -u)",
}


class Terminated(KeyboardInterrupt):
    """The process was asked to end (SIGTERM): drafts are removed on the way out, as after Ctrl-C."""


def end_cleanly_when_asked(worker: bool = False) -> None:
    """From now on SIGTERM raises ``Terminated`` in the main thread, the first time; a second one ends at once.

    Compiled loops do not look whether they are to stop: where the main thread has not ended the process within
    ``PATIENCE_S`` of SIGINT or SIGTERM, another removes the drafts and ends it. worker : says nothing and is
    faster, and a second SIGTERM is nothing to it.
    """
    signal.signal(signal.SIGTERM, _terminate_worker if worker else _terminate)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    before = sys.unraisablehook
    # What is raised within a __del__ Python prints, and goes on; the other thread ends the process then.
    sys.unraisablehook = lambda told: None if isinstance(told.exc_value, KeyboardInterrupt) else before(told)
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(read_end, worker), daemon=True).start()


def _watch(read_end: int, worker: bool) -> None:
    """Waits for a signal, and for the main thread to heed it; where it does not, ends the process."""
    while True:
        number = os.read(read_end, 1)
        if number and number[0] in (signal.SIGINT, signal.SIGTERM):
            time.sleep(PATIENCE_OF_WORKERS_S if worker else PATIENCE_S)
            end_now(TERMINATED if number[0] == signal.SIGTERM else INTERRUPTED, "" if worker else stopped())


def end_now(code: int, words: str = "") -> None:
    """Ends the process at once, and those it has started: drafts are removed, threads of libraries not waited for."""
    atomic = sys.modules.get("sameas.io.atomic")  # where it was not imported nothing is drafted, nor anything written
    if atomic is not None:
        atomic.placing.acquire(timeout=ENDING_S)
        atomic.discard_drafts()
    if "multiprocessing.process" in sys.modules:
        children = sys.modules["multiprocessing.process"].active_children()
        for child in children:
            child.terminate()
        end = time.monotonic() + ENDING_S
        for child in children:
            child.join(max(end - time.monotonic(), 0.0))
            child.kill()
    with suppress(OSError, ValueError):
        sys.stdout.flush()
        sys.stderr.write(f"sameas: {words}\n" if words else "")
        sys.stderr.flush()
    os._exit(code)


def stopped() -> str:
    """The message of a process that was stopped."""
    atomic = sys.modules.get("sameas.io.atomic")
    written = [str(path) for path in atomic.written] if atomic else []
    return f"stopped; {', '.join(written) or 'nothing'} was written"


#: What was raised in the main thread when it was asked to end. A library may catch it, and fail for what it then lacks.
_raised: list[type[KeyboardInterrupt]] = []


def _interrupt(number: int, frame: Any) -> None:
    _raised[:] = [KeyboardInterrupt]
    raise KeyboardInterrupt


def _terminate(number: int, frame: Any) -> None:
    signal.signal(number, signal.SIG_DFL)
    _raised[:] = [Terminated]
    raise Terminated


def _terminate_worker(number: int, frame: Any) -> None:
    # It is asked twice where who started it is interrupted, and then ends; it ends within its patience anyway.
    signal.signal(number, signal.SIG_IGN)
    raise Terminated


def exit_code(error: KeyboardInterrupt) -> int:
    """That of a process that was interrupted, or asked to end."""
    return TERMINATED if isinstance(error, Terminated) else INTERRUPTED


@contextmanager
def answering(debug: bool, option: Callable[[Argument], str] = option_of) -> Iterator[None]:
    """Errors in the block become one line on stderr and an exit code.

    debug : print the traceback too. option : what the command has instead of an argument of the library.
    """
    if "sameas.io.atomic" in sys.modules:
        sys.modules["sameas.io.atomic"].written.clear()
    try:
        yield
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except KeyboardInterrupt as error:
        _end(stopped(), exit_code(error), debug)
    except InputError as error:
        _end(in_options(error.words, option), INPUT_ERROR, debug)
    except PermissionError as error:
        _end(f"{error.filename or 'a file'}: permission denied: this user may not use it, or a folder above it",
             INPUT_ERROR, debug)  # fmt: skip
    except OSError as error:
        from sameas.io.atomic import refused_by_disk

        reason = refused_by_disk(error)
        if error.errno == errno.ENOENT and error.filename is None:
            _end("the folder that this was started in no longer exists; change to another", INPUT_ERROR, debug)
        if error.errno in _OF_THE_SYSTEM:
            _end(f"{error.filename or 'this process'}: {_OF_THE_SYSTEM[error.errno]}", INPUT_ERROR, debug)
        if reason is None:
            _end(f"{fault(error)} with what --debug shows", INPUT_ERROR, debug)
        place = error.filename or "a temporary file, or where stdout goes"
        _end(f"{place}: {reason}; make room, there too where TMPDIR says", INPUT_ERROR, debug)
    except MemoryError:
        _end("not enough memory for these catalogues; nothing was written", INPUT_ERROR, debug)
    except Exception as error:
        asked = interruption(error)
        if asked is not None:
            _end(stopped(), exit_code(asked), debug)
        _end(f"{fault(error)} with what --debug shows", INPUT_ERROR, debug)


def interruption(error: BaseException | None) -> KeyboardInterrupt | None:
    """The interruption that made the error, if one did: of one on its way out, compiled code makes a SystemError, and
    an import that catches it (NumPy's does) fails in the next line."""
    if _raised:
        return _raised[0]()
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return error
        error = error.__cause__ or (error.__context__ if isinstance(error, SystemError) else None)
    return None


def unanswered(error: SystemExit) -> KeyboardInterrupt | None:
    """The interruption that came outside of ``answering``: typer says nothing of it, and knows one signal only."""
    cause = None if error.__context__ is None else error.__context__.__cause__
    return cause if isinstance(cause, KeyboardInterrupt) else None


def fault(error: Exception) -> str:
    """The message of an error that was not foreseen."""
    words = InputError(" ".join(str(error).split()))
    return f"unexpected {type(error).__name__}: {words}; this is a fault of sameas, please report it"


def _end(message: str, code: int, debug: bool) -> None:
    if _raised:
        message, code = stopped(), exit_code(_raised[0]())
    if debug:
        import traceback

        traceback.print_exc()
    sys.stderr.write(f"sameas: {printable(message)}\n")
    raise typer.Exit(code)
