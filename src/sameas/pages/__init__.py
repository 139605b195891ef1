"""Pages: one HTML file each that shows a result in a browser, without a network; made here from templates.

:mod:`sameas.pages.frame` writes the pages of frames, of series of them and of movers, :mod:`sameas.pages.map` that of a
picture. Under a page's Content-Security-Policy the browser runs only the page's own script.
"""

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
    """Text of a template, style sheet or script of the pages."""
    return (files("sameas.pages") / name).read_text(encoding="utf-8")


#: The policy of a served page: it may also connect to its own server.
SERVED_POLICY = POLICY + "; connect-src 'self'"


def page_of(template: str, title: str, kind: str, marks: Mapping[str, str], policy: str = POLICY) -> str:
    """The common head and a template, with their placeholders ``{{name}}`` replaced.

    title, kind : of the window; the title is any text (escaped here), the kind a fixed word.
    marks : text of each placeholder; those inside the script must come from this package.
    policy : of the page, with ``{}`` for the digest of its script.

    All placeholders are replaced in one pass, so a replacement that contains ``{{name}}`` stays as it is.
    """
    text = asset("head.html") + asset(template)
    marks = {"title": html.escape(printable(title)), "kind": kind, "version": html.escape(sameas.__version__), **marks}
    script = _replaced(_SCRIPT.findall(text)[0], marks)
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    return _replaced(text, {**marks, "policy": policy.format(f"sha256-{digest}")})


def _replaced(text: str, marks: Mapping[str, str]) -> str:
    return re.sub(r"\{\{(\w+)\}\}", lambda found: marks[found[1]], text)


def script_safe(value: object) -> str:
    """JSON that cannot end or open the script element around it, whatever names from files and radio contain."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


# Data of pages: rounded numbers and images.


def png(grey: NDArray[np.uint8]) -> bytes:
    """A PNG file (ISO/IEC 15948) of a grey image (rows, columns) of eight bits, first row on top."""
    rows, columns = grey.shape
    # Filter 1 (sub) stores differences to the left neighbour: smooth images compress better.
    differences = grey.copy()
    differences[:, 1:] -= grey[:, :-1]
    lines = np.concatenate([np.ones((rows, 1), np.uint8), differences], axis=1)
    head = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    body = zlib.compress(lines.tobytes(), 6)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def column(values: NDArray[Any], digits: int) -> list[float | None]:
    """Numbers rounded to some digits; None where they are NaN or infinite."""
    numbers = np.round(np.asarray(values, np.float64), digits).tolist()
    return [None if value != value or abs(value) == float("inf") else value for value in numbers]


def rounded(value: float, digits: int) -> float | None:
    """A number rounded to some digits; None where it is NaN or infinite."""
    return column(np.array([value]), digits)[0]
