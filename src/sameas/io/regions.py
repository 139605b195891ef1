"""Regions of DS9: what was made of a frame, to be laid over it.

Identified measurements are green circles, unidentified ones yellow boxes, stars that are missing red diamonds. Each
carries its star and its probability as a tag, which DS9 lists and can select by.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from sameas.errors import printable
from sameas.io.atomic import replacing

if TYPE_CHECKING:
    from astropy.table import Table

_HEAD = (
    "# Region file format: DS9 version 4.1",
    'global color=green dashlist=8 3 width=1 font="helvetica 10 normal roman" select=1 highlite=1 dash=0 fixed=0 '
    "edit=1 move=1 delete=1 include=1 source=1",
    "icrs",
)


def write_regions(listing: Table, path: str | os.PathLike[str], *, radius_arcsec: float) -> int:
    """Writes the rows of a frame's listing as regions, those too faint to be seen left out; returns how many.

    radius_arcsec : of the marks.

    Raises
    ------
    InputError : the path cannot be written.
    """
    lines = [line for row in listing if (line := _line(row, radius_arcsec))]
    with replacing(path) as draft:
        draft.write_text("\n".join([*_HEAD, *lines]) + "\n", encoding="utf-8")
    return len(lines)


def _line(row: Any, radius: float) -> str:
    cell = row.__getitem__
    at, fate = f"{cell('ra_deg'):.7f},{cell('dec_deg'):+.7f}", str(cell("fate"))
    if fate == "identified":
        return f'circle({at},{radius:.2f}") # tag={{identified}} tag={{{_tag(cell("star"))} p={cell("p_match"):.4f}}}'
    if fate == "unidentified":
        side = 1.8 * radius
        tag = f"measurement {cell('measurement')} p_none={cell('p_none'):.4f}"
        return f'box({at},{side:.2f}",{side:.2f}",0) # color=yellow tag={{unidentified}} tag={{{tag}}}'
    if fate == "missing":
        tag = _tag(f"{cell('star')} {cell('remark')}")
        return f"point({at}) # point=diamond color=red tag={{missing}} tag={{{tag}}}"
    return ""


def _tag(text: object) -> str:
    """A text as a tag may hold it: DS9 ends a tag at a brace, and a region at a semicolon or the end of the line."""
    return printable(str(text)).translate(str.maketrans("{};", "(),"))
