"""Tables of DAOPHOT, which are read only: text databases of IRAF, and files of Stetson's own DAOPHOT II and ALLSTAR.

They have pixels and no directions. These follow from the solution of their image if it is in the same folder: the one
that IRAF's ``#K IMAGE`` names, or else the one of the same name, ``ngc188.fits`` for ``ngc188.als``.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.io import ascii as text
from sameas.io.csv import content_of
from sameas.io.format import Format
from sameas.io.ldac import solution_of

if TYPE_CHECKING:
    from astropy.io.fits import Header
    from astropy.table import Table

#: Head of Stetson's files; the first number below it is the number of lines of a star: 1, or 2 in ``.ap``.
_HEAD = re.compile(rb"\A\s*NL\s+NX\s+NY\s+LOWBAD\b[^\n]*\n\s*(?P<lines>\d+)\s")
_COLUMNS = {6: "id x y mag sharp round", 7: "id x y mag sharp round round_y", 9: "id x y mag err sky niter chi sharp"}
_MAGNITUDES = ("mag", "err", "MAG", "MERR")
#: Extensions of images, and IRAF's section or number behind a name.
_IMAGES, _SECTION = (".fits", ".fit", ".fts", ".fits.gz", ".fits.fz"), re.compile(r"\[[^\]]*\]$")


def is_daophot(path: Path, first: bytes) -> bool:
    """Whether a text is IRAF's database of stars, or begins as DAOPHOT II writes it."""
    of_iraf = first.startswith((b"#K ", b"#N ")) and all(f"\n#{line} ".encode() in first for line in "UF")
    return of_iraf or _HEAD.match(first) is not None


def read(path: Path) -> Table:
    """The stars of a table of DAOPHOT, with directions if the solution of its image is at hand."""
    content = memoryview(content_of(path)).tobytes()
    head = _HEAD.match(content)
    if head is None:
        table, image = _of_iraf(content.decode("utf-8", "replace"))
    else:
        table, image = _of_stetson(content, int(head["lines"]), path), ""
    for name in table.colnames:
        if name.startswith(_MAGNITUDES):
            table[name].unit = "mag"
    stem = Path(image).name or path.name.removesuffix(".gz").rpartition(".")[0]
    return _with_directions(table, _image_of(path, stem), stem if stem.endswith(_IMAGES) else f"{stem}.fits")


def _of_iraf(content: str) -> tuple[Table, str]:
    """The table of a text database, and the name of its image."""
    from astropy.io import ascii as text_tables

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # units such as "imagename"
        table = text_tables.read(content.splitlines(), format="daophot", fill_values=[("INDEF", "0")])
    keywords = table.meta.pop("keywords", {})
    table.meta = {name: keyword["value"] for name, keyword in keywords.items()}
    for column in table.columns.values():
        column.unit = None  # IRAF's words for them are no units
    image = table.meta.get("IMAGE") or (str(table["IMAGE"][0]) if "IMAGE" in table.colnames and len(table) else "")
    return table, _SECTION.sub("", str(image))


def _of_stetson(content: bytes, lines: int, path: Path) -> Table:
    """The table below the three lines of DAOPHOT II. lines : of each star."""
    rows = [line for line in content.split(b"\n")[3:] if line.strip()]
    if lines == 2:
        rows = [b" ".join(pair) for pair in zip(rows[::2], rows[1::2], strict=False)]
    if not rows:
        raise InputError(f"{path}: holds no stars below its head")
    width = len(rows[0].split())
    if lines == 2:  # x, y and magnitudes of the apertures; sky, its scatter and skewness, and their errors
        apertures = (width - 6) // 2
        sky = ("sky", "sky_sd", "sky_skew")
        names = ["id", "x", "y", *_numbered("mag", apertures), *sky, *_numbered("mag_err", apertures)]
    else:
        names = _COLUMNS.get(width, "id x y").split()
    names += [f"column_{number}" for number in range(len(names) + 1, width + 1)]
    return text.rows_of(b"\n".join(rows), names[:width], 0, path)


def _numbered(name: str, count: int) -> list[str]:
    return [name, *(f"{name}_{number}" for number in range(1, count))]


def _image_of(path: Path, stem: str) -> Path | None:
    """The image of a table, if it is in its folder. stem : its name, with or without its extension."""
    candidates = (path.with_name(f"{stem}{ending}") for ending in ("", *_IMAGES))
    return next((one for one in candidates if one.name.lower().endswith(_IMAGES) and one.is_file()), None)


def _with_directions(table: Table, image: Path | None, wanted: str) -> Table:
    """The table with columns ``ra`` and ``dec`` by the solution of its image, and the header of it for the epoch.

    wanted : the name of the image, for a note if it is missing.
    """
    header = None if image is None else _header(image)
    wcs = None if header is None else solution_of(header)
    pixels = next((pair for pair in (("XCENTER", "YCENTER"), ("x", "y")) if set(pair) <= set(table.colnames)), None)
    if wcs is None or pixels is None or header is None or image is None:
        note = f"its pixels become directions if its image with a plate solution, {wanted}, is in its folder"
        table.meta["sameas_notes"] = [note]
        return table
    xy: list[FloatArray] = [np.ma.filled(np.ma.asarray(table[name], float), np.nan) for name in pixels]
    for name, degrees in zip(("ra", "dec"), wcs.all_pix2world(*xy, 1), strict=True):
        table[name] = degrees
        table[name].unit = "deg"
    table.meta = {key: header[key] for key in header if key and key not in ("COMMENT", "HISTORY")} | table.meta
    table.meta["sameas_notes"] = [f"ra and dec are pixels {' and '.join(pixels)} by the solution of {image.name}"]
    return table


def _header(image: Path) -> Header | None:
    """The header of an image with a solution of the sky, the first of its extensions; None without one."""
    from astropy.io import fits

    try:
        with fits.open(image) as hdus:
            return next((hdu.header for hdu in hdus if hdu.is_image and solution_of(hdu.header) is not None), None)
    except OSError:
        return None


FORMAT = Format(
    "daophot", "DAOPHOT table", (".als", ".coo", ".mag", ".ap", ".nst"), unmarked=True, recognised=is_daophot, read=read
)
