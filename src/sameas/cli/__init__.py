"""The command ``sameas``. Nothing heavy is imported before a command runs: ``--help`` answers at once."""

from __future__ import annotations

import sys


def main() -> None:
    """What the command ``sameas`` runs; ends the process with its exit code."""
    try:
        import gc
        import warnings

        # Imports make many objects to stay, and a compilation more: looking for garbage among them takes a tenth.
        gc.set_threshold(100_000, 50, 100)
        from sameas.cli.app import app
        from sameas.cli.outcome import end_cleanly_when_asked

        end_cleanly_when_asked()
        _open_what_is_closed()
        for stream in (sys.stdout, sys.stderr):
            stream.reconfigure(errors="replace")  # type: ignore[union-attr]  # σ where the terminal has none
        if "--debug" not in sys.argv:
            warnings.simplefilter("ignore")
            # What a process leaves that is stopped at once another removes, and is not to speak of it.
            sys.warnoptions.append("ignore:resource_tracker")
        app()
    except KeyboardInterrupt as error:
        from sameas.cli.outcome import end_now, exit_code, stopped

        end_now(exit_code(error), stopped())
    except SystemExit as error:
        import signal

        from sameas.cli.outcome import INTERRUPTED, TERMINATED, end_now, exit_code, stopped, unanswered

        try:
            for number in (signal.SIGINT, signal.SIGTERM):  # nothing is begun any more: Python ends, or is ended
                signal.signal(number, signal.SIG_DFL)
        except KeyboardInterrupt as asked:
            end_now(exit_code(asked), stopped())
        early = unanswered(error)
        if early is not None:
            end_now(exit_code(early), stopped())
        if error.code in (INTERRUPTED, TERMINATED):
            # Libraries may still have threads at work, which C++ does not let end with the process.
            end_now(error.code)
        raise
    except Exception as error:
        from sameas.cli.outcome import end_now, exit_code, interruption, stopped

        raised = interruption(error)
        if raised is None:
            raise
        end_now(exit_code(raised), stopped())


def process() -> None:
    """:func:`main` as all that its process does, which ends with it at once: to take five hundred modules apart, object
    by object, lasts a fifth of a second."""
    _share_memory()
    try:
        main()
    except SystemExit as error:
        if error.code is None or isinstance(error.code, int):
            _end_at_once(error.code or 0)
        raise


def _share_memory() -> None:
    """All threads allocate from one pool: glibc gives each its own, and what one has freed no other could use, a
    fifteenth of the peak of a million rows. Arrays are few and large: threads hardly ever wait for each other."""
    import ctypes
    from contextlib import suppress

    most_arenas = -8  # M_ARENA_MAX of glibc's malloc.h
    with suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).mallopt(most_arenas, 1)


def _end_at_once(code: int) -> None:
    """Ends the process without taking apart what it holds; returns where something else has to be waited for.

    A profiler or debugger speaks when all has ended; others' threads and processes may be at work; and what cannot be
    written Python says itself.
    """
    import atexit
    import os
    import threading

    tools = getattr(sys, "monitoring", None)
    watched = sys.gettrace() or sys.getprofile() or (tools and any(map(tools.get_tool, range(6))))
    at_work = [thread for thread in threading.enumerate() if not thread.daemon]
    processes = sys.modules.get("multiprocessing.process")
    if watched or sys.flags.interactive or len(at_work) > 1 or (processes and processes.active_children()):
        return
    try:
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):
        return
    os._exit(code)


def _open_what_is_closed() -> None:
    """Puts the null device where a stream is closed; the next file opened would have its number, and its words."""
    import os

    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115 (it stays open)


__all__ = ["main", "process"]
