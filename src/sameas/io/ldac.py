"""FITS_LDAC of SExtractor: a table of objects for every chip, each after a table whose cell is the chip's image header.

The chips of a mosaic become one table with a column ``CHIP``. Catalogues made for SCAMP have pixels and no directions:
these follow from the solution in each chip's header.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError

if TYPE_CHECKING:
    from astropy.io.fits import HDUList, Header
    from astropy.table import Table

#: Names of the extensions.
OBJECTS, IMAGE_HEADER = "LDAC_OBJECTS", "LDAC_IMHEAD"
#: The column with the number of the chip, 1, 2, …, and the one with the time of its exposure.
CHIP, EXPOSED = "CHIP", "OBS_MJD"
#: SExtractor's flavours of positions, the best first.
_FLAVOURS = ("WIN", "PSF", "")


def image_header(hdus: HDUList, number: int) -> Header | None:
    """The image header in front of the objects in extension ``number``; None without one."""
    from astropy.io import fits

    before = hdus[number - 1]
    if before.name != IMAGE_HEADER or not len(before.data):
        return None
    lines = [line.decode("ascii", "replace").ljust(80) for line in np.ravel(before.data.field(0)[0]).tolist()]
    header = fits.Header()
    for card in fits.Header.fromstring("".join(lines)).cards:
        with suppress(fits.VerifyError, ValueError):  # not a valid card
            if card.keyword and card.keyword not in ("COMMENT", "HISTORY", "END"):
                header[card.keyword] = card.value
    return header


def stacked(tables: Sequence[Table], headers: Sequence[Header | None], path: object) -> Table:
    """The objects of all chips in one table, with the number of each one's chip.

    tables, headers : one per chip. Columns that a chip lacks are left out, with a note; so is a column ``CHIP`` of the
    file's own if there is one, which is kept. Chips that were exposed at different times get a column of it.

    Raises InputError: a column has another shape or kind in another chip.
    """
    from astropy.table import Column, vstack

    common = [name for name in tables[0].colnames if all(name in table.colnames for table in tables)]
    left_out = sorted({name for table in tables for name in table.colnames} - set(common))
    times = [_exposed(header) for header in headers]
    parts = []
    for number, (table, time) in enumerate(zip(tables, times, strict=True), start=1):
        part = table[common]
        part.meta = {}
        if CHIP not in common:
            part.add_column(Column(np.full(len(part), number, np.int16), CHIP, description="chip of the mosaic"))
        if len(set(times)) > 1:
            part.add_column(Column(np.full(len(part), np.nan if time is None else time), EXPOSED, unit="d"))
        parts.append(part)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # units and descriptions that differ: those of the first chip
            whole = vstack(parts, join_type="exact")
    except Exception as error:  # astropy raises several kinds
        raise InputError(
            f"{path}: its {len(tables)} chips have different columns ({error}); give one of them"
        ) from None
    whole.meta = dict(tables[0].meta)
    notes = [f"{path} holds the objects of {len(tables)} chips: all are used, see column {CHIP}"]
    if left_out:
        notes.append(f"not in every chip, and left out: {', '.join(left_out)}")
    if len(set(times)) > 1:
        for key in ("MJD-OBS", "DATE-OBS", "MJD-AVG", "DATE-AVG", "MJD-MID"):
            whole.meta.pop(key, None)
        notes.append(f"the chips were exposed at different times: see column {EXPOSED}")
    whole.meta["sameas_notes"] = notes
    return whole


def _exposed(header: Header | None) -> float | None:
    """The start of the exposure as MJD; None if the header does not tell."""
    from astropy.time import Time

    if header is None:
        return None
    with suppress(ValueError, TypeError):
        if "MJD-OBS" in header:
            return float(header["MJD-OBS"])
        if "DATE-OBS" in header:
            return float(Time(str(header["DATE-OBS"])).mjd)
    return None


def with_directions(table: Table, header: Header | None) -> Table:
    """The table with directions and their errors, from pixels and the header's solution, if it has none of its own."""
    if header is None or any(name in table.colnames for name in _directions()):
        return table
    flavour = next((one for one in _FLAVOURS if f"X{one}_IMAGE" in table.colnames), None)
    wcs = None if flavour is None else solution_of(header)
    if wcs is None:
        return table
    x, y = (np.asarray(table[f"{axis}{flavour}_IMAGE"], float) for axis in "XY")
    ra, dec = wcs.all_pix2world(x, y, 1)
    table[f"ALPHA{flavour}_J2000"], table[f"DELTA{flavour}_J2000"] = ra, dec
    for name, words in ((f"ALPHA{flavour}_J2000", "right ascension"), (f"DELTA{flavour}_J2000", "declination")):
        table[name].unit, table[name].description = "deg", f"{words} by the solution in the image header"
    ellipse = [f"ERR{part}{flavour}_IMAGE" for part in ("A", "B", "THETA")]
    if all(name in table.colnames for name in ellipse):
        a, b, angle = (np.asarray(table[name], float) for name in ellipse)
        sizes = _on_the_sky(wcs, x, y, a, b, np.radians(angle))
        names = f"ERRA{flavour}_WORLD", f"ERRB{flavour}_WORLD", f"ERRTHETA{flavour}_J2000"
        for name, values in zip(names, sizes, strict=True):
            table[name] = values
            table[name].unit = "deg"
    return table


def _directions() -> list[str]:
    stems = [f"{stem}{one}" for one in (*_FLAVOURS, "PEAK", "MODEL") for stem in ("ALPHA", "X")]
    return [f"{stem}_{frame}" for stem in stems for frame in ("J2000", "SKY", "WORLD", "B1950")]


def solution_of(header: Header) -> Any:
    """The header's solution of the sky; None if it has none."""
    from astropy.wcs import WCS

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wcs = WCS(header, naxis=2)
    except Exception:  # astropy and wcslib raise many kinds
        return None
    return wcs if wcs.has_celestial else None


def _on_the_sky(
    wcs: Any, x: FloatArray, y: FloatArray, a: FloatArray, b: FloatArray, angle: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Error ellipses in pixels, (n,) each, on the sky: both axes in degrees, and the angle of the first, degrees east
    of north. Angles in pixels from x to y, in radians."""
    steps = []
    for dx, dy in ((0.5, 0.0), (0.0, 0.5)):
        ra, dec = wcs.all_pix2world(np.concatenate([x + dx, x - dx]), np.concatenate([y + dy, y - dy]), 1)
        ends = np.stack([ra, dec]).reshape(2, 2, -1)
        change = ends[:, 0] - ends[:, 1]
        change[0] = (change[0] + 180.0) % 360.0 - 180.0
        change[0] *= np.cos(np.radians(ends[1].mean(axis=0)))
        steps.append(change)
    jacobian = np.moveaxis(np.stack(steps, axis=1), -1, 0)  # (n, east and north, x and y)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    covariance = sum(
        (size**2)[:, None, None] * one[:, :, None] * one[:, None, :] for size, one in ((a, along), (b, across))
    )
    on_sky = jacobian @ np.where(np.isfinite(covariance), covariance, 0.0) @ jacobian.transpose(0, 2, 1)
    known = np.isfinite(a + b + angle) & np.isfinite(jacobian).all(axis=(1, 2))
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], on_sky, np.eye(2)))
    major = vectors[:, :, 1]
    sizes = np.sqrt(np.maximum(values, 0.0))
    position_angle = np.degrees(np.arctan2(major[:, 0], major[:, 1])) % 180.0
    return tuple(np.where(known, each, np.nan) for each in (sizes[:, 1], sizes[:, 0], position_angle))  # type: ignore[return-value]
