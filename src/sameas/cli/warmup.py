"""Kernels before they are called: the first compilation on a machine in two processes, cached kernels in a thread.

Kernels are compiled at their first call with many items and cached for later runs. While the command compiles what it
calls first, a second process compiles what the command calls later and then finds in the cache: of a match the error
scales and the posterior, of a frame the fit of magnitudes, of a picture all that comes after the sums of its groups.
A match of large tables needs compiled kernels in any case: it reads those in the cache while a reader waits for its
file.
"""

from __future__ import annotations

import gc
import importlib
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from sameas.assignment import Hypothesis
from sameas.groups import Groups
from sameas.kernels import compiled, threads
from sameas.prior import PerPair

#: Kernels that a match of two large tables calls, by module, in the order of their first calls.
KERNELS_OF_A_MATCH = {
    "coverage": ("sphere_cells", "renumber", "cell_sizes", "check_cells", "shared_part", "refine", "refine_share"),
    "zones": ("extent", "tally", "zones_of", "into_zones", "into_cells", "take_rows"),
    "search": ("sweep_sphere",),
    "components": ("label_pairs", "lay_out"),
    "assign": ("assign_linear",),
    "posterior": ("exact",),
    "messages": ("messages",),
    "probability_bounds": ("bounds",),
    "mixture": ("log_odds", "cells", "fit", "grade", "count_pairs", "count_alone"),
    "records": ("per_record", "greatest_pair", "by_row"),
}
#: Kernels that a picture calls after those that take longest to compile.
LATER_KERNELS_OF_A_PICTURE = {
    "search": ("sweep_few",),
    "track_pairs": ("pairs_stepped", "new_pair_errors", "best_others", "pair_distances"),
    "id_swaps": ("swap_factors", "add_set_gains"),
    "kalman": ("sum_of_records", "update_in_plane", "joint_in_plane"),
}
#: A compilation mark older than this, in seconds, was left behind by a process that was stopped.
LONGEST_S = 120.0


def start_second_process(cache: Path, result: str) -> None:
    """Start the compilation of a command's later kernels in a second process, unless one is running; do not wait.

    cache : folder of the compiled kernels. result : what the command makes, of :data:`IN_SECOND_PROCESS`.
    """
    kernel, _ = IN_SECOND_PROCESS[result]
    if any(cache.glob(f"{kernel}-*.nbi")) or not _claimed(cache / "compiling"):
        return
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    command = [sys.executable, "-m", "sameas.cli.warmup", result, str(cache)]
    threading.Thread(target=subprocess.run, args=(command,), kwargs=quiet, daemon=True).start()


def _claimed(mark: Path) -> bool:
    """Whether the mark of a running compilation could be created; marks left behind are replaced."""
    try:
        mark.parent.mkdir(parents=True, exist_ok=True)
        if mark.exists() and time.time() - mark.stat().st_mtime > LONGEST_S:
            mark.unlink(missing_ok=True)
        mark.touch(exist_ok=False)
    except OSError:
        return False
    return True


def read_ahead() -> None:
    """Read the cached kernels of a match in a thread; do not wait. An error is met again when a kernel is called."""
    threads.started(_read_cached)


def _read_cached() -> None:
    for module, names in KERNELS_OF_A_MATCH.items():
        of_module = importlib.import_module(f"sameas.kernels.{module}")
        for name in names:
            kernel = getattr(of_module, name)
            if isinstance(kernel, compiled.Kernel):
                kernel.read_cached()


def compile_sums() -> None:
    """Compile the kernels of the posterior on one small group of two by two records."""
    from sameas.posterior import log_evidence, posterior

    compiled.compile_all()
    place = np.array([0, 0, 1, 1], np.int32), np.array([0, 1, 0, 1], np.int32)
    two, ends = np.arange(2, dtype=np.int32), np.array([0, 2])
    group = Groups(np.arange(4), np.array([0, 4]), two, ends, np.array([0, 2, 4]), two, ends, *place)
    weight, none = np.array([1.0, 0.0, 0.0, 1.0]), np.zeros(1)
    best = Hypothesis(weight > 0, weight, np.ones(2), np.zeros(2), none, PerPair(0.0)(group.sizes_1, group.sizes_2))
    log_evidence(group, best, posterior(group, best).p_pair)


def compile_scales() -> None:
    """Compile the kernels of the error scales on a few pairs."""
    from sameas.estimate.error_scales import fit_errors
    from sameas.evidence import Errors

    compiled.compile_all()
    fit_errors(np.linspace(0.1, 9.0, 20), np.linspace(-5.0, 5.0, 20), 2, Errors())


def compile_relations() -> None:
    """Compile the fit of magnitudes, which takes longest to compile of a frame's kernels, on twenty stars."""
    from sameas.estimate.photometry import Sample, fit_relation
    from sameas.evidence.brightness import MagnitudeDensity
    from sameas.kernels.relation import learn

    learn.limit = 0
    magnitude, one = np.linspace(10.0, 14.0, 20), np.ones(20)
    sample = Sample.of(magnitude + 0.1, magnitude[:, None], 1e-4 * one, 1e-4 * one[:, None], 0.2 * one, one, one)
    fit_relation(sample, MagnitudeDensity(magnitude, np.log(0.2 * one)))


def compile_pictures() -> None:
    """Compile :data:`LATER_KERNELS_OF_A_PICTURE` on two ships seen by AIS and a radar, without the search for offsets,
    whose kernels the command compiles meanwhile."""
    from sameas.picture import Picture
    from sameas.tracks import Description, Reports, Scene

    for module, names in LATER_KERNELS_OF_A_PICTURE.items():
        of_module = importlib.import_module(f"sameas.kernels.{module}")
        for name in names:
            getattr(of_module, name).limit = 0
    seconds = np.repeat(np.arange(0.0, 60.0, 3.0), 2)
    ship = np.tile([0, 1], len(seconds) // 2)
    x, y = 5.0 * seconds + 40.0 * ship, 1000.0 + 30.0 * ship
    line, track = np.arange(len(seconds)), ship.astype(str)
    sources = [
        (Description("ais", "ais"), Reports("ais", "table", seconds, line, x_m=x, y_m=y, mmsi=track)),
        (Description("radar", "marine radar"), Reports("radar", "table", seconds, line, x_m=x, y_m=y, track_id=track)),
    ]
    Picture.of(Scene.of(sources), np.arange(10.0, 60.0, 10.0))


#: By what the command makes: the kernel whose presence in the cache shows that nothing is left to do, and what the
#: second process compiles, which is what the command needs last and what takes longest.
IN_SECOND_PROCESS = {
    "match": ("posterior.exact", (compile_sums, compile_scales)),
    "frame": ("relation.learn", (compile_relations, compile_scales, compile_sums)),
    "picture": ("kalman.sum_of_records", (compile_pictures,)),
}


def _main(result: str = "match", *caches: str) -> None:
    gc.set_threshold(400_000, 50, 100)  # as in the command itself
    try:
        _, works = IN_SECOND_PROCESS[result]
        for compile_some in works:
            compile_some()
    finally:
        for cache in caches:
            (Path(cache) / "compiling").unlink(missing_ok=True)


if __name__ == "__main__":
    _main(*sys.argv[1:])
