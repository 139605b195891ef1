"""Contents of outputs as they are compared: bytes, with nothing normalised that two right programs could not differ in.

What is taken out, and put in its place:

- The folder in which the commands ran, with as many letters: every run has another.
- Dates and times between the beginning of the run and its end, with zeros: when a file was made.
- Seconds of printed times and of the summaries of frames, the peak memory.
- In what is printed: the notice that kernels are compiled, and the lines of the program's help that list ``study``.

FITS and Parquet keep these texts where they cannot be replaced in place (cut into cards, or encoded): of FITS the cards
are compared, long texts joined, and the bytes of the data; of Parquet the bytes up to the footer, and of the footer the
metadata, the schema and the layout of columns.
"""

from __future__ import annotations

import hashlib
import io
import re
import struct
import time
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

_STAMP = re.compile(r"\d{4}-\d\d-\d\d(?:[T ]\d\d:\d\d:\d\d(?:\.\d+)?)?")
_SECONDS = (
    (re.compile(r"(?m)^(\s*Time: )[\d.]+ s(; peak memory: .*)?$"), r"\1… s"),
    (re.compile(r'(?m)^(\s*"to_(?:detections|identification|outputs)": )[\d.]+'), r"\1…"),
    (re.compile(r"(?m)(\bdone in |; |, )\d+\.\d s$"), r"\1… s"),
)
_COMPILING = re.compile(r"(?m)^sameas: compiling kernels for this machine.*\n")
_STUDY = re.compile(r"(?m)^│ study  .*\n(?:│ {10}.*\n)*")


@dataclass(frozen=True)
class Normaliser:
    """What is taken out of texts. folder : in which the commands ran. began_s : when, in seconds since 1970."""

    folder: Path
    began_s: float

    def __call__(self, text: str) -> str:
        """The text of a file."""
        text = text.replace(str(self.folder), "x" * len(str(self.folder)))
        text = _STAMP.sub(self._stamp, text)
        for pattern, instead in _SECONDS:
            text = pattern.sub(instead, text)
        return text

    def printed(self, text: str) -> str:
        """What a command printed."""
        return _STUDY.sub("", _COMPILING.sub("", self(text)))

    def _stamp(self, found: re.Match[str]) -> str:
        try:
            when = datetime.fromisoformat(found[0]).replace(tzinfo=UTC)
        except ValueError:
            return found[0]
        # A date alone is its midnight; local time is up to a day from UTC.
        first = datetime.fromtimestamp(self.began_s, UTC) - timedelta(days=1, minutes=1)
        last = datetime.fromtimestamp(time.time(), UTC) + timedelta(days=1)
        return re.sub(r"\d", "0", found[0]) if first <= when <= last else found[0]


@dataclass(frozen=True)
class Content:
    """A file: the checksum of what is compared, and a text of it for people, which need not tell everything."""

    sha256: str
    text: str


def content(path: Path, normalise: Normaliser) -> Content:
    """What is compared of a file."""
    data = path.read_bytes()
    if data.startswith(b"SIMPLE  ="):
        return _fits(data, normalise)
    if data.startswith(b"PAR1") and data.endswith(b"PAR1"):
        return _parquet(data, normalise)
    try:
        text = normalise(data.decode("utf-8"))
    except UnicodeDecodeError:
        return Content(_digest(data), f"{len(data)} bytes")
    return Content(_digest(text.encode()), text)


def _digest(*parts: bytes) -> str:
    whole = hashlib.sha256()
    for part in parts:
        whole.update(len(part).to_bytes(8, "big") + part)
    return whole.hexdigest()


def _fits(data: bytes, normalise: Normaliser) -> Content:
    from astropy.io import fits

    texts, parts = [], []
    with warnings.catch_warnings(), fits.open(io.BytesIO(data), memmap=False, disable_image_compression=True) as hdus:
        warnings.simplefilter("ignore")
        for number, hdu in enumerate(hdus):
            where = hdu.fileinfo()
            raw = data[where["datLoc"] : where["datLoc"] + where["datSpan"]]
            texts.append(f"HDU {number}\n{normalise(_cards(hdu.header))}")
            parts += [texts[-1].encode(), raw]
            if isinstance(hdu, fits.BinTableHDU):
                texts += [_column(name, hdu.data.field(name)) for name in hdu.columns.names]
            elif raw:
                texts.append(f"data: {len(raw)} bytes, {_digest(raw)[:16]}")
    return Content(_digest(*parts), "\n".join(texts))


def _cards(header: object) -> str:
    """The cards as they stand; long texts and entries that are continued joined."""
    lines: list[str] = []
    before = ""
    for card in header.cards:  # type: ignore[attr-defined]
        goes_on = card.keyword == before and not str(card.value).startswith("sameas:")
        if card.keyword in ("HISTORY", "COMMENT") and goes_on:
            lines[-1] += str(card.value)
        elif len(card.image) > 80:
            lines.append(f"{card.keyword} = {card.value} / {card.comment}")
        else:
            lines.append(card.image.rstrip())
        before = card.keyword
    return "\n".join(lines)


def _parquet(data: bytes, normalise: Normaliser) -> Content:
    import pyarrow.parquet

    [length] = struct.unpack("<I", data[-8:-4])
    body = data[: -8 - length]
    file = pyarrow.parquet.ParquetFile(io.BytesIO(data))
    layout = file.metadata.to_dict()
    layout.pop("serialized_size")  # of texts that are taken out
    schema = file.schema_arrow
    metadata = {key.decode(): value.decode("utf-8", "replace") for key, value in (schema.metadata or {}).items()}
    lines = [f"{key}: {normalise(value)}" for key, value in metadata.items()]
    lines += [f"{field.name}: {field.type}, {field.metadata}" for field in schema]
    table = file.read()
    text = "\n".join([*lines, *(_column(name, table[name].to_pylist()) for name in table.column_names)])
    return Content(_digest(body, repr(layout).encode(), "\n".join(lines).encode()), text)


def _column(name: str, values: object) -> str:
    """A column in a line: its checksum and first values."""
    cells = values.tolist() if hasattr(values, "tolist") else values
    shown = ", ".join(str(cell) for cell in cells[:4])  # type: ignore[index]
    return f"column {name}: {_digest(repr(cells).encode())[:16]}, {shown}"
