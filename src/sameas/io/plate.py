"""Outputs of an identified frame for other programs: plate solutions in FITS, and regions for DS9.

A plate solution is written as a header file (``.wcs``), or into a copy of the frame. The copy has every extension, card
and pixel of the frame except the old solution: the WCS cards of the image and, for digitised plates, the polynomials of
the DSS.
"""

from __future__ import annotations

import os
import re
import shutil
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.errors import InputError, printable
from sameas.io.atomic import replacing
from sameas.sky.frame.image import PHOTOGRAPHS
from sameas.sky.frame.plate import PlateModel

if TYPE_CHECKING:
    from astropy.io.fits import HDUList, Header
    from astropy.table import Table

_OLD = re.compile(
    r"(WCSAXES|WCSNAME|RADESYS|RADECSYS|EQUINOX|LONPOLE|LATPOLE|"
    r"(CTYPE|CRVAL|CRPIX|CDELT|CUNIT|CROTA)\d|(CD|PC|PV|PS|DP|DQ)\d+_\d+|CPDIS\d|CQDIS\d|"
    r"[AB]P?_(ORDER|DMAX|\d+_\d+)|AMD[XY]\d+|PPO\d|PLT(RA|DEC)[HMSDN]*|CNPIX\d|[XY]PIXELSZ)$"
)


def solution_cards(plate: PlateModel) -> Header:
    """The plate model as header cards: TAN, or TAN-SIP with forward and inverse polynomials, and a HISTORY line."""
    header = plate.to_wcs().to_header(relax=True)
    cd = {}
    for i in (1, 2):
        for j in (1, 2):
            pc = header.pop(f"PC{i}_{j}", float(i == j))
            cd[f"CD{i}_{j}"] = float(pc) * float(header.get(f"CDELT{i}", 1.0))
    for name in ("CDELT1", "CDELT2"):
        header.pop(name, None)
    for name, value in cd.items():
        header[name] = value
    for name in ("DATE-OBS", "MJD-OBS", "MJDREF", "TIMESYS", "DATEREF"):
        header.pop(name, None)  # the frame has its own
    header.add_history(f"sameas: {_ascii(plate.describe())}"[:300])
    return header


def write_solution(plate: PlateModel, path: str | os.PathLike[str]) -> None:
    """Writes a FITS file without data whose header is the solution, as other programs expect next to a frame.

    Raises InputError: the path cannot be written.
    """
    from astropy.io import fits

    rows, columns = plate.shape
    primary = fits.PrimaryHDU()
    primary.header.extend(solution_cards(plate), end=True)
    primary.header["IMAGEW"] = (columns, "columns of the frame")
    primary.header["IMAGEH"] = (rows, "rows of the frame")
    with replacing(path) as draft:
        primary.writeto(draft, overwrite=True)


def write_copy(plate: PlateModel, frame: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Writes a copy of a frame with the solution in the header of its image.

    Raises InputError: the copy would replace the frame; no image has the plate's shape; the path cannot be written.
    """
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyWarning

    frame, path = Path(frame), Path(path)
    if frame.suffix.lower() in PHOTOGRAPHS:
        raise InputError(f"{frame.name}: a photograph has no header for the solution; use the one written beside it")
    if path.exists() and path.samefile(frame):
        raise InputError(f"{path}: is the frame itself; give the copy another name")
    with replacing(path) as draft:
        if frame.name.lower().endswith(".gz") == path.name.lower().endswith(".gz"):
            shutil.copyfile(frame, draft)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropyWarning)
            with fits.open(frame, memmap=False, do_not_scale_image_data=True) as hdus:
                chosen = _image(hdus, plate.shape)
                if chosen is None:
                    raise InputError(f"{frame.name}: no image of {plate.shape[0]} rows and {plate.shape[1]} columns")
                _replace(hdus[chosen].header, solution_cards(plate))
                hdus.writeto(draft, overwrite=True, output_verify="silentfix")


def _image(hdus: HDUList, shape: tuple[int, int]) -> int | None:
    """The number of the measured image: the first of this shape, preferably one named SCI; None without one."""
    candidates = [k for k, each in enumerate(hdus) if each.is_image and _shape(each) == shape]
    named = [k for k in candidates if hdus[k].name.upper() == "SCI"]
    return next(iter(named or candidates), None)


def _shape(hdu: Any) -> tuple[int, ...]:
    shape = tuple(int(size) for size in hdu.shape)
    # One plane, or three of colours.
    return shape[-2:] if len(shape) >= 2 and int(np.prod(shape[:-2])) in (1, 3) else ()


def _replace(header: Header, cards: Header) -> None:
    for name in [name for name in header if _OLD.fullmatch(name)]:
        header.remove(name, ignore_missing=True, remove_all=True)
    for card in cards.cards:
        if card.keyword == "HISTORY":
            header.add_history(card.value)
        elif card.keyword:
            header[card.keyword] = (card.value, card.comment)


def _ascii(words: str) -> str:
    return words.replace("″", " arcsec").replace("×", "x").replace("−", "-").encode("ascii", "ignore").decode()


# Regions of DS9: the result, as an overlay of the frame.
#
# Identified measurements are green circles, unidentified ones yellow boxes, missing stars red diamonds. Each has its
# star and its probability as a tag, by which DS9 can select.

_HEAD = (
    "# Region file format: DS9 version 4.1",
    'global color=green dashlist=8 3 width=1 font="helvetica 10 normal roman" select=1 highlite=1 dash=0 fixed=0 '
    "edit=1 move=1 delete=1 include=1 source=1",
    "icrs",
)
#: The columns of a listing that regions show.
_COLUMNS = ("ra_deg", "dec_deg", "fate", "star", "remark", "measurement", "p_match", "p_none")


def write_regions(listing: Table, path: str | os.PathLike[str], *, radius_arcsec: float) -> int:
    """Writes the rows of a frame's listing as regions, without stars below the limit; returns their number.

    radius_arcsec : of the symbols.

    Raises InputError: the path cannot be written.
    """
    # Rows of an astropy table take a hundred times as long to read as lists.
    columns = [["--" if cell is None else cell for cell in listing[name].tolist()] for name in _COLUMNS]
    rows = (dict(zip(_COLUMNS, cells, strict=True)) for cells in zip(*columns, strict=True))
    lines = [line for row in rows if (line := _line(row, radius_arcsec))]
    with replacing(path) as draft:
        draft.write_text("\n".join([*_HEAD, *lines]) + "\n", encoding="utf-8")
    return len(lines)


def _line(row: dict[str, Any], radius: float) -> str:
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
    """The text without characters that end a tag (braces) or a region (semicolon, line end) in DS9."""
    return printable(str(text)).translate(str.maketrans("{};", "(),"))
