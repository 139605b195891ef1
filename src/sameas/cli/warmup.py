"""The first compilation on a machine, shared out: what comes after the search is compiled beside it.

Kernels that are given many items are compiled when they are first called, and kept for later runs. The search takes
about as long to compile as the error scales and the sums over hypotheses; when the command begins with it, these are
compiled ``beside`` it, and it finds them in the cache when it gets there. Without it everything is the same, but later.
"""

from __future__ import annotations

import gc
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from sameas.assignment import Hypothesis
from sameas.groups import Groups
from sameas.kernels import compiled
from sameas.prior import PerPair

#: A compilation that has not ended after so many seconds has been stopped.
LONGEST_S = 120.0


def beside(cache: Path) -> None:
    """Start to compile scales and sums in a process of its own, unless one does already; without waiting.

    cache : the folder in which compiled kernels are kept.
    """
    if any(cache.glob("posterior.exact-*.nbi")) or not _claimed(cache / "compiling"):
        return
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    command = [sys.executable, "-m", "sameas.cli.warmup", str(cache)]
    threading.Thread(target=subprocess.run, args=(command,), kwargs=quiet, daemon=True).start()


def _claimed(mark: Path) -> bool:
    """Whether the mark of a compilation could be set: nobody has, or it was left behind."""
    try:
        mark.parent.mkdir(parents=True, exist_ok=True)
        if mark.exists() and time.time() - mark.stat().st_mtime > LONGEST_S:
            mark.unlink(missing_ok=True)
        mark.touch(exist_ok=False)
    except OSError:
        return False
    return True


def compile_sums() -> None:
    """Compile the kernels of the posterior, by summing over one small group: two records against two."""
    from sameas.posterior import log_evidence, posterior

    place = np.array([0, 0, 1, 1], np.int32), np.array([0, 1, 0, 1], np.int32)
    two, ends = np.arange(2, dtype=np.int32), np.array([0, 2])
    group = Groups(np.arange(4), np.array([0, 4]), two, ends, np.array([0, 2, 4]), two, ends, *place)
    weight, none = np.array([1.0, 0.0, 0.0, 1.0]), np.zeros(1)
    best = Hypothesis(weight > 0, weight, np.ones(2), np.zeros(2), none, PerPair(0.0)(group.sizes_1, group.sizes_2))
    log_evidence(group, best, posterior(group, best).p_pair)


def compile_scales() -> None:
    """Compile the kernels of the error scales, by fitting them to a few pairs."""
    from sameas.estimate.error_model import fit_errors
    from sameas.evidence import Errors

    fit_errors(np.linspace(0.1, 9.0, 20), np.linspace(-5.0, 5.0, 20), 2, Errors())


def _main() -> None:
    compiled.compile_all()
    gc.set_threshold(100_000, 50, 100)  # as in the command itself
    try:
        compile_sums()
        compile_scales()
    finally:
        for cache in sys.argv[1:]:
            (Path(cache) / "compiling").unlink(missing_ok=True)


if __name__ == "__main__":
    _main()
