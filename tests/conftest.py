"""Before all tests: compiled kernels of an older source are thrown away; of many like cases only the first are fast."""

from collections import Counter
from pathlib import Path

import pytest

import sameas


def pytest_configure(config):
    # numba looks at the file of a kernel, not at those of the kernels that it calls: a change of one file leaves the
    # others compiled with the old one inside.
    if hasattr(config, "workerinput"):
        return
    kernels = Path(sameas.__file__).parent / "kernels"
    newest = max(path.stat().st_mtime for path in kernels.glob("*.py"))
    for compiled in kernels.glob("__pycache__/*.nb[ci]"):
        if compiled.stat().st_mtime < newest:
            compiled.unlink(missing_ok=True)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """``slow_after(n)`` makes ``slow`` of all cases of a test but the first n; -m then sees it."""
    cases = Counter()
    for item in items:
        marker = item.get_closest_marker("slow_after")
        if marker is not None:
            test = item.nodeid.partition("[")[0]
            cases[test] += 1
            if cases[test] > marker.args[0]:
                item.add_marker("slow")
