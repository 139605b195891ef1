"""Before all tests: compiled kernels of an older source are thrown away."""

from pathlib import Path

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
