"""Outcomes: how a command ends, in one line and an exit code.

0 done; 1 the input cannot be used, or nothing useful was done; 2 wrong usage (typer's); 130 interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer

from sameas.cli.options import in_options, option_of
from sameas.errors import Argument, InputError

INPUT_ERROR, INTERRUPTED = 1, 130


@contextmanager
def answering(debug: bool, option: Callable[[Argument], str] = option_of) -> Iterator[None]:
    """Errors in the block become one line on stderr and an exit code.

    debug : print the traceback too. option : what the command has instead of an argument of the library.
    """
    try:
        yield
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except KeyboardInterrupt:
        _end("stopped; nothing was written", INTERRUPTED, debug)
    except InputError as error:
        _end(in_options(error.words, option), INPUT_ERROR, debug)
    except MemoryError:
        _end("not enough memory for these catalogues; nothing was written", INPUT_ERROR, debug)
    except Exception as error:
        told = " ".join(str(error).split())
        _end(
            f"unexpected {type(error).__name__}: {told}; this is a fault of sameas, please report it with "
            "what --debug shows",
            INPUT_ERROR,
            debug,
        )


def _end(message: str, code: int, debug: bool) -> None:
    if debug:
        import traceback

        traceback.print_exc()
    sys.stderr.write(f"sameas: {message}\n")
    raise typer.Exit(code)
