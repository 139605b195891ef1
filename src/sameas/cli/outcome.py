"""Outcomes: every command ends with one line and an exit code.

0 done; 1 the input cannot be used, or nothing useful was done; 2 wrong usage (typer's); 130 interrupted (SIGINT);
143 terminated (SIGTERM).
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
from typing import TYPE_CHECKING

import typer

from sameas.cli.options import in_options, option_of
from sameas.errors import Argument, InputError, printable

if TYPE_CHECKING:
    from types import FrameType

INPUT_ERROR, INTERRUPTED, TERMINATED = 1, 130, 143
#: Seconds for the main thread to end by itself after a signal (an answer within one second is promised), for a worker
#: (which should end before its parent), and for child processes.
PATIENCE_S, PATIENCE_OF_WORKERS_S, ENDING_S = 0.7, 0.2, 0.4
#: Errors of the operating system, which are not faults of sameas.
_OF_THE_SYSTEM = {
    errno.ENAMETOOLONG: "the name is too long for a file; give a shorter one",
    errno.ELOOP: "a link that leads to itself",
    errno.ENOTDIR: "a part of this path is a file, not a folder",
    errno.EMFILE: "too many open files; raise the limit (ulimit -n)",
    errno.ENFILE: "too many open files in this system",
    errno.EAGAIN: "no more threads or processes are allowed; raise the limit (ulimit -u)",
}


class Terminated(KeyboardInterrupt):
    """SIGTERM was received; draft files are removed on the way out, as after Ctrl-C."""


class WorkerTerminated(Terminated, SystemExit):
    """SIGTERM in a worker process; one that waits for work ends without a traceback, because of ``SystemExit``."""


def end_cleanly_on_sigterm(worker: bool = False) -> None:
    """Let the first SIGTERM raise ``Terminated`` in the main thread; a second one ends the process at once.

    Compiled loops do not check for signals: if the main thread has not ended the process ``PATIENCE_S`` after SIGINT or
    SIGTERM, a watching thread removes the drafts and ends it. worker : a worker process, which ends silently, sooner,
    and ignores a second SIGTERM.
    """
    signal.signal(signal.SIGTERM, _terminate_worker if worker else _terminate)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    previous_hook = sys.unraisablehook
    # Python only prints what is raised within a __del__ and continues; the watching thread then ends the process.
    sys.unraisablehook = lambda error: None if isinstance(error.exc_value, KeyboardInterrupt) else previous_hook(error)
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(read_end, worker), daemon=True).start()


def _watch(read_end: int, worker: bool) -> None:
    """Wait for a signal, then for the main thread to react; end the process if it does not."""
    while True:
        number = os.read(read_end, 1)
        if number and number[0] in (signal.SIGINT, signal.SIGTERM):
            time.sleep(PATIENCE_OF_WORKERS_S if worker else PATIENCE_S)
            end_now(TERMINATED if number[0] == signal.SIGTERM else INTERRUPTED, "" if worker else stopped())


def end_now(code: int, words: str = "") -> None:
    """End the process and its children at once: remove drafts, do not wait for library threads."""
    atomic = sys.modules.get("sameas.io.atomic")  # not imported: there are no drafts and no outputs
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


#: The exception raised by a signal in the main thread. A library may catch it, and then fail with another error.
_raised: list[type[KeyboardInterrupt]] = []


def _interrupt(number: int, frame: FrameType | None) -> None:
    _raised[:] = [KeyboardInterrupt]
    raise KeyboardInterrupt


def _terminate(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_DFL)
    _raised[:] = [Terminated]
    raise Terminated


def _terminate_worker(number: int, frame: FrameType | None) -> None:
    # An interrupted parent sends a second SIGTERM; the watching thread ends the worker in any case.
    signal.signal(number, signal.SIG_IGN)
    ended = WorkerTerminated()
    ended.code = TERMINATED
    raise ended


def exit_code(error: KeyboardInterrupt) -> int:
    """The exit code of a process that was interrupted or terminated."""
    return TERMINATED if isinstance(error, Terminated) else INTERRUPTED


@contextmanager
def answering(debug: bool, option: Callable[[Argument], str] = option_of) -> Iterator[None]:
    """Turn errors in the block into one line on stderr and an exit code.

    debug : also print the traceback. option : the command's option for an argument of the library.
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
        interrupt = interruption(error)
        if interrupt is not None:
            _end(stopped(), exit_code(interrupt), debug)
        _end(f"{fault(error)} with what --debug shows", INPUT_ERROR, debug)


def interruption(error: BaseException | None) -> KeyboardInterrupt | None:
    """The interruption that caused the error, if any.

    Compiled code turns an interruption into a SystemError; an import that catches it (NumPy's does) fails later.
    """
    if _raised:
        return _raised[0]()
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return error
        error = error.__cause__ or (error.__context__ if isinstance(error, SystemError) else None)
    return None


def unanswered(error: SystemExit) -> KeyboardInterrupt | None:
    """The interruption outside of ``answering``, which typer swallows: it prints nothing and knows SIGINT only."""
    cause = None if error.__context__ is None else error.__context__.__cause__
    return cause if isinstance(cause, KeyboardInterrupt) else None


def fault(error: Exception) -> str:
    """The message of an unforeseen error."""
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
