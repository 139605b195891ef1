"""Runs ``python -m sameas`` many times, with the packages that it needs imported once: half the time of a command.

A line of JSON on stdin, ``{"folder", "arguments", "stdout", "stderr"}``, is answered by the exit code on stdout. Each
command is a process of its own, forked before anything of sameas is imported. An import that sameas itself forgets is
not seen here; ``scripts/compare-outputs`` runs the first commands of each kind without this.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import runpy
import signal
import sys
import traceback
from contextlib import suppress
from typing import NoReturn

NEEDED = (
    "numpy", "scipy.special", "scipy.optimize", "scipy.spatial", "scipy.ndimage", "numba", "pyarrow.parquet",
    "astropy.table", "astropy.io.fits", "astropy.io.votable", "astropy.io.ascii", "astropy.time", "astropy.wcs",
    "astropy.coordinates", "photutils.detection", "photutils.background", "matplotlib.figure",
    "matplotlib.backends.backend_agg", "pymap3d", "pyais", "rs1090", "typer", "rich.console", "rich.progress",
    "multiprocessing", "concurrent.futures",
)  # fmt: skip
#: Seconds after which a command is stopped.
LONGEST_S = 900


def serve() -> None:
    """Answers until stdin ends."""
    for name in NEEDED:
        with suppress(ImportError):
            importlib.import_module(name)
    if any(name.partition(".")[0] == "sameas" for name in sys.modules):
        sys.exit("sameas was imported by another package")
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if child == 0:
            _run(**request)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def _run(folder: str, arguments: list[str], stdout: str, stderr: str) -> NoReturn:
    code: object = 0
    signal.alarm(LONGEST_S)
    os.chdir(folder)
    for number, path in ((0, os.devnull), (1, stdout), (2, stderr)):
        os.dup2(os.open(path, os.O_RDWR | os.O_CREAT, 0o644), number)
    sys.argv, sys.path[0] = ["sameas", *arguments], folder
    try:
        runpy.run_module("sameas", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
        code = 1
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(code if isinstance(code, int) else 0 if code is None else 1)


if __name__ == "__main__":
    serve()
