"""Outcomes: how a command ends, in one line and an exit code.

0 done; 1 the input cannot be used, or nothing useful was done; 2 wrong usage (typer's); 130 interrupted; 143 asked to
end (SIGTERM).
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer

from sameas.cli.options import in_options, option_of
from sameas.errors import Argument, InputError, printable

INPUT_ERROR, INTERRUPTED, TERMINATED = 1, 130, 143


class Terminated(KeyboardInterrupt):
    """The process was asked to end (SIGTERM): drafts are removed on the way out, as after Ctrl-C."""


def end_cleanly_when_asked() -> None:
    """From now on SIGTERM raises ``Terminated`` in the main thread, the first time; a second one ends at once."""
    signal.signal(signal.SIGTERM, _terminate)


def _terminate(number: int, frame: Any) -> None:
    signal.signal(number, signal.SIG_DFL)
    raise Terminated


def exit_code(error: KeyboardInterrupt) -> int:
    """That of a process that was interrupted, or asked to end."""
    return TERMINATED if isinstance(error, Terminated) else INTERRUPTED


@contextmanager
def answering(debug: bool, option: Callable[[Argument], str] = option_of) -> Iterator[None]:
    """Errors in the block become one line on stderr and an exit code.

    debug : print the traceback too. option : what the command has instead of an argument of the library.
    """
    try:
        yield
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except KeyboardInterrupt as error:
        _end("stopped; nothing was written", exit_code(error), debug)
    except InputError as error:
        _end(in_options(error.words, option), INPUT_ERROR, debug)
    except MemoryError:
        _end("not enough memory for these catalogues; nothing was written", INPUT_ERROR, debug)
    except Exception as error:
        _end(f"{fault(error)} with what --debug shows", INPUT_ERROR, debug)


def fault(error: Exception) -> str:
    """What is said of an error that nobody foresaw."""
    words = InputError(" ".join(str(error).split()))
    return f"unexpected {type(error).__name__}: {words}; this is a fault of sameas, please report it"


def _end(message: str, code: int, debug: bool) -> None:
    if debug:
        import traceback

        traceback.print_exc()
    sys.stderr.write(f"sameas: {printable(message)}\n")
    raise typer.Exit(code)
