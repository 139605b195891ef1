"""Pages made of a template: its marks filled in, and a policy by which a browser runs only the page's own script."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import struct
import zlib
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sameas
from sameas.errors import printable

#: Content-Security-Policy: no network, no frame, no form; the one script of the given digest.
POLICY = (
    "default-src 'none'; script-src '{}'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
)
_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL)


def asset(name: str) -> str:
    """A file of the pages as text."""
    return (files("sameas.pages") / name).read_text(encoding="utf-8")


#: The same of a page that is served: it may talk to the server that it came from, and to no other.
SERVED_POLICY = POLICY + "; connect-src 'self'"


def page_of(template: str, title: str, kind: str, marks: Mapping[str, str], policy: str = POLICY) -> str:
    """The head that all pages have and a template, with their marks ``{{name}}`` filled in.

    title, kind : what the window is called; the title is any text, the kind a word of ours.
    policy : that of the page, to which the digest of its script is added.

    The marks of the script must be files of ours. All are filled in one pass: what stands for one is no mark itself.
    """
    text = asset("head.html") + asset(template)
    marks = {"title": html.escape(printable(title)), "kind": kind, "version": html.escape(sameas.__version__), **marks}
    script = _filled(_SCRIPT.findall(text)[0], marks)
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    return _filled(text, {**marks, "policy": policy.format(f"sha256-{digest}")})


def _filled(text: str, marks: Mapping[str, str]) -> str:
    return re.sub(r"\{\{(\w+)\}\}", lambda found: marks[found[1]], text)


def script_safe(value: Any) -> str:
    """JSON in which nothing can end or open the element that holds it: names come from files and from radio."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


# What pages hold in their data: numbers rounded, and images.


def png(grey: NDArray[np.uint8]) -> bytes:
    """A grey image (rows, columns) of eight bits as the bytes of a PNG file (ISO/IEC 15948), first row on top."""
    rows, columns = grey.shape
    # Filter 1 (sub) keeps each byte less the one to its left: smooth images compress better.
    less = grey.copy()
    less[:, 1:] -= grey[:, :-1]
    lines = np.concatenate([np.ones((rows, 1), np.uint8), less], axis=1)
    head = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    body = zlib.compress(lines.tobytes(), 6)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def column(values: NDArray[Any], digits: int) -> list[float | None]:
    """Numbers rounded, null where they are none."""
    kept = np.round(np.asarray(values, np.float64), digits)
    return [None if value != value or abs(value) == float("inf") else value for value in kept.tolist()]


def rounded(value: float, digits: int) -> float | None:
    """A number rounded, null where it is none."""
    return column(np.array([value]), digits)[0]
