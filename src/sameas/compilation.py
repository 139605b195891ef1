"""The first compilation on a machine, shared out: what sums over hypotheses is compiled beside what comes before it.

The kernels are compiled when they are first called and kept for later runs. The search and the sums take about as long
to compile; a program that is about to identify for the first time says ``beside()``, and finds the sums in the cache
when it gets there. Without it everything is the same, but later.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import numpy as np

from sameas.assignment import Hypothesis
from sameas.groups import Groups
from sameas.prior import PerPair


def needed() -> bool:
    """Whether this machine has no compiled sums yet."""
    from sameas.kernels import posterior

    statistics = getattr(posterior.exact, "stats", None)  # a plain function where compilation is switched off
    where = getattr(statistics, "cache_path", None)
    return bool(where) and not any(Path(str(where)).glob("posterior.exact-*.nbi"))


def beside() -> None:
    """Start to compile the sums in a process of its own; nobody has to wait for it, nor to end it."""
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    command = [sys.executable, "-m", "sameas.compilation"]
    threading.Thread(target=subprocess.run, args=(command,), kwargs=quiet, daemon=True).start()


def compile_sums() -> None:
    """Compile the kernels of the posterior, by summing over one small group: two records against two."""
    from sameas.posterior import by_messages, posterior

    place = np.array([0, 0, 1, 1], np.int32), np.array([0, 1, 0, 1], np.int32)
    two, ends = np.arange(2, dtype=np.int32), np.array([0, 2])
    group = Groups(np.arange(4), np.array([0, 4]), two, ends, np.array([0, 2, 4]), two, ends, *place)
    weight, none = np.array([1.0, 0.0, 0.0, 1.0]), np.zeros(1)
    best = Hypothesis(weight > 0, weight, np.ones(2), np.zeros(2), none, PerPair(0.0)(group.sizes_1, group.sizes_2))
    posterior(group, best)
    by_messages(group, best)


if __name__ == "__main__":
    compile_sums()
