"""A plugin of pytest that records every refusal: ``-p refusals``, with the file to write in SAMEAS_REFUSALS.

The messages of all ``InputError`` that are made during a run, paths of temporary folders and numbers of memory taken
out, with how often each was made. ``scripts/compare-outputs --refusals`` compares those of two checkouts. Tests of
hypothesis make other examples when anything moves: of their messages only the words are kept, not numbers and counts.
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
_random = False


def _clean(message: str) -> str:
    checkout = os.environ.get("SAMEAS_CHECKOUT", "")
    if checkout:
        message = message.replace(checkout, "<checkout>")
    for pattern, instead in _CLEAN:
        message = pattern.sub(instead, message)
    return message


def _made(self: InputError, *arguments: Any, **named: Any) -> None:
    _plain(self, *arguments, **named)
    message = _clean(str(self))
    if _random:
        _words.add(re.sub(r"[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?", "#", message))
    else:
        _counts[message] += 1


_plain = InputError.__init__


def pytest_configure(config: Any) -> None:
    InputError.__init__ = _made  # type: ignore[method-assign]


def pytest_runtest_setup(item: Any) -> None:
    global _random
    _random = bool(getattr(getattr(item, "obj", None), "is_hypothesis_test", False))


def pytest_sessionfinish(session: Any) -> None:
    """Each process of a run writes a file of its own; the one that only hands out the tests has nothing to tell."""
    InputError.__init__ = _plain  # type: ignore[method-assign]
    path = os.environ.get("SAMEAS_REFUSALS")
    if path and (_counts or _words):
        told = {"counts": dict(sorted(_counts.items())), "words": sorted(_words)}
        Path(f"{path}.{os.getpid()}").write_text(json.dumps(told, ensure_ascii=False, indent=1), encoding="utf-8")
