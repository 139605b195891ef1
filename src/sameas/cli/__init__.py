"""The command ``sameas``. Nothing heavy is imported before a command runs: ``--help`` answers at once."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command ``sameas``; exits with its exit code."""
    try:
        import gc
        import warnings

        # Imports and compilations create many permanent objects; the default thresholds cost a tenth of a short run.
        # Fewer than 400 000 need no collection; one of 100 000 takes 30 ms.
        gc.set_threshold(400_000, 50, 100)
        from sameas.cli.app import app
        from sameas.cli.outcome import end_cleanly_on_sigterm

        end_cleanly_on_sigterm()
        _open_closed_streams()
        for stream in (sys.stdout, sys.stderr):
            stream.reconfigure(errors="replace")  # type: ignore[union-attr]  # terminals without σ
        if "--debug" not in sys.argv:
            warnings.simplefilter("ignore")
            # The resource tracker cleans up after killed workers; its warnings would confuse the user.
            sys.warnoptions.append("ignore:resource_tracker")
        app()
    except KeyboardInterrupt as error:
        from sameas.cli.outcome import end_now, exit_code, stopped

        end_now(exit_code(error), stopped())
    except SystemExit as error:
        import signal

        from sameas.cli.outcome import INTERRUPTED, TERMINATED, end_now, exit_code, stopped, unanswered

        try:
            for number in (signal.SIGINT, signal.SIGTERM):  # from here on a signal simply ends the process
                signal.signal(number, signal.SIG_DFL)
        except KeyboardInterrupt as interrupt:
            end_now(exit_code(interrupt), stopped())
        early = unanswered(error)
        if early is not None:
            end_now(exit_code(early), stopped())
        if error.code in (INTERRUPTED, TERMINATED):
            # A normal exit would wait for library threads, or crash in their C++ destructors.
            end_now(error.code)
        raise
    except Exception as error:
        from sameas.cli.outcome import end_now, exit_code, interruption, stopped

        raised = interruption(error)
        if raised is None:
            raise
        end_now(exit_code(raised), stopped())


def process() -> None:
    """:func:`main` as the only task of the process, which then exits without tearing down its modules (0.2 s)."""
    import os

    _use_one_arena()
    # OpenBLAS wakes a thread per processor for every long product, which then spins for 20 ms while our threads work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # NumPy asks for huge pages. In a virtual machine the kernel often takes three times as long to clear them: 1.8 s
    # instead of 0.6 for a million rows.
    os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
    try:
        main()
    except SystemExit as error:
        if error.code is None or isinstance(error.code, int):
            _end_at_once(error.code or 0)
        raise


def _use_one_arena() -> None:
    """Let all threads allocate from one glibc arena.

    By default each thread has its own, and memory freed in one cannot be reused in another: 7 % of the peak of a
    million rows. Arrays are few and large, so threads hardly ever contend for the arena.
    """
    set_malloc(-8, 1)  # M_ARENA_MAX of glibc's malloc.h


def set_malloc(parameter: int, value: int) -> None:
    """Set a parameter of glibc's malloc; does nothing with another C library."""
    import ctypes
    from contextlib import suppress

    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).mallopt(parameter, value)


def _end_at_once(code: int) -> None:
    """Exit without tearing down modules. Returns if a normal exit is needed instead.

    That is the case with a profiler, debugger or interactive session, with running threads or child processes, and
    when the output streams cannot be flushed, which Python then reports.
    """
    import atexit
    import os
    import threading

    tools = getattr(sys, "monitoring", None)
    watched = sys.gettrace() or sys.getprofile() or (tools and any(map(tools.get_tool, range(6))))
    running = [thread for thread in threading.enumerate() if not thread.daemon]
    processes = sys.modules.get("multiprocessing.process")
    if watched or sys.flags.interactive or len(running) > 1 or (processes and processes.active_children()):
        return
    try:
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):
        return
    os._exit(code)


def _open_closed_streams() -> None:
    """Open the null device for closed standard streams; otherwise the next file opened would get their number, and
    the messages meant for them."""
    import os

    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115 (it stays open)


__all__ = ["main", "process", "set_malloc"]
