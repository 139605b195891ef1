"""Before a run: delete kernels compiled from older sources. At collection: the markers ``slow_after`` and
``long_after``."""

from collections import Counter
from pathlib import Path

import pytest

import sameas


def pytest_configure(config):
    # numba checks the source file of a kernel, but not those of the kernels it calls: after a change of one file the
    # others would keep the old code inlined.
    if hasattr(config, "workerinput"):
        return
    kernels = Path(sameas.__file__).parent / "kernels"
    newest = max(path.stat().st_mtime for path in kernels.glob("*.py"))
    for compiled in kernels.glob("__pycache__/*.nb[ci]"):
        if compiled.stat().st_mtime < newest:
            compiled.unlink(missing_ok=True)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """``slow_after(n)`` marks all cases of a test after the first n as ``slow``, ``long_after(n)`` as ``long``, before
    ``-m`` selects."""
    cases = Counter()
    for item in items:
        for mark in ("slow", "long"):
            marker = item.get_closest_marker(f"{mark}_after")
            if marker is not None:
                test = mark, item.nodeid.partition("[")[0]
                cases[test] += 1
                if cases[test] > marker.args[0]:
                    item.add_marker(mark)
