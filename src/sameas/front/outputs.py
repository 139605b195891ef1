"""Outputs: files that are written and must not be one of the inputs."""

from __future__ import annotations

import os
from collections.abc import Sequence

from sameas.errors import InputError


def is_input(path: str | os.PathLike[str], inputs: Sequence[str]) -> bool:
    """Whether a path is that of one of the inputs."""
    return any(
        (os.path.exists(one) and os.path.exists(path) and os.path.samefile(path, one))
        or os.path.realpath(one) == os.path.realpath(path)
        for one in inputs
    )


def refuse_inputs(path: str | os.PathLike[str], inputs: Sequence[str]) -> None:
    """Refuses an output that would destroy an input."""
    if is_input(path, inputs):
        raise InputError(f"{os.fspath(path)}: is also an input; it would be overwritten", "give another name")
