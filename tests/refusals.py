"""Pytest plugin that records every refusal: ``-p refusals``, with the output file in SAMEAS_REFUSALS.

Messages and counts of all ``InputError`` created during a run, with temporary paths and memory addresses replaced.
``scripts/compare-outputs --refusals`` compares two checkouts. Hypothesis generates other examples whenever the code
changes, so the messages of its tests are kept without numbers and counts.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from pathlib import Path
from typing import Any

from sameas.errors import InputError

_CLEAN = (
    (re.compile(r"[^\s'\"(=]*/pytest-of-[^/\s]+/pytest-\d+(?:/popen-gw\d+)?/[^/\s:;,'\")]+"), "<tmp>"),
    (re.compile(r"0x[0-9a-f]{6,}"), "0x…"),
    (re.compile(r"(?<=127\.0\.0\.1:)\d+"), "<port>"),
    (re.compile(r"(?<=localhost:)\d+"), "<port>"),
)
_counts: Counter[str] = Counter()
_words: set[str] = set()
_hypothesis_test = False


def _clean(message: str) -> str:
    checkout = os.environ.get("SAMEAS_CHECKOUT", "")
    if checkout:
        message = message.replace(checkout, "<checkout>")
    for pattern, instead in _CLEAN:
        message = pattern.sub(instead, message)
    return message


def _recording_init(self: InputError, *arguments: Any, **named: Any) -> None:
    _original_init(self, *arguments, **named)
    message = _clean(str(self))
    if _hypothesis_test:
        _words.add(re.sub(r"[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?", "#", message))
    else:
        _counts[message] += 1


_original_init = InputError.__init__


def pytest_configure(config: Any) -> None:
    InputError.__init__ = _recording_init  # type: ignore[method-assign]


def pytest_runtest_setup(item: Any) -> None:
    global _hypothesis_test
    _hypothesis_test = bool(getattr(getattr(item, "obj", None), "is_hypothesis_test", False))


def pytest_sessionfinish(session: Any) -> None:
    """Every process writes its own file; the xdist controller has no messages and writes none."""
    InputError.__init__ = _original_init  # type: ignore[method-assign]
    path = os.environ.get("SAMEAS_REFUSALS")
    if path and (_counts or _words):
        report = {"counts": dict(sorted(_counts.items())), "words": sorted(_words)}
        Path(f"{path}.{os.getpid()}").write_text(json.dumps(report, ensure_ascii=False, indent=1), encoding="utf-8")
