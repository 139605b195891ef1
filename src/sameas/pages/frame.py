"""The page of an identified frame: its image with marks, and records, residuals, magnitudes and plate model."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from sameas.arrays import IntArray
from sameas.io.atomic import replacing
from sameas.pages.template import asset, column, page_of, png, rounded, script_safe
from sameas.plots.frame import binned, binning, stretched
from sameas.sky.frame.identified import EXPECTED, FrameIdentification
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag
from sameas.sky.frame.outputs import summary, why_missing
from sameas.sky.frame.photometry import instrumental

#: Maximum number of candidates per measurement on the page, and their minimum probability (chosen).
COMPETITORS, LEAST = 6, 1e-6


def write_frame_page(
    found: FrameIdentification,
    frame: Frame,
    path: str | os.PathLike[str],
    *,
    brightest: int | None = None,
    facts: Mapping[str, Any] | None = None,
) -> None:
    """Writes the page of an identified frame: one file, complete in itself.

    brightest : number of the brightest identified stars marked at first, None for all; the page has a slider.
    facts : result of :func:`sameas.sky.frame.outputs.summary` for this frame; computed here if None.

    Raises
    ------
    InputError : the path cannot be written.
    """
    with replacing(path) as draft:
        draft.write_text(frame_page(found, frame, brightest=brightest, facts=facts), encoding="utf-8")


def frame_page(
    found: FrameIdentification, frame: Frame, *, brightest: int | None = None, facts: Mapping[str, Any] | None = None
) -> str:
    """The page as text; arguments as for :func:`write_frame_page`."""
    factor = binning(frame.shape)
    grey = stretched(binned(frame.image, factor))[::-1]
    picture = base64.b64encode(png(np.ascontiguousarray(grey))).decode("ascii")
    facts = summary(found, frame) if facts is None else facts
    marks = {
        "css": asset("frame.css"),
        "js": asset("chart.js") + asset("frame.js"),
        "picture": picture,
        "data": script_safe(_data(found, facts, factor, brightest)),
    }
    return page_of("frame.html", found.measured.name, "identified", marks)


def _data(found: FrameIdentification, facts: Mapping[str, Any], factor: int, brightest: int | None) -> dict[str, Any]:
    rows, columns = found.measured.shape
    listed = _listed_stars(found)
    number = np.full(len(found.stars), -1)
    number[listed] = np.arange(len(listed))
    return {
        "name": found.measured.name,
        "catalogue": found.stars.name,
        "colour": found.stars.colour_name,
        "shape": [rows, columns],
        "bin": factor,
        "width_px": rounded(found.measured.psf_fwhm_px, 2),
        "brightest": brightest,
        "expected": EXPECTED,
        "odd": found.pairs[0][found.odd_brightness].tolist(),
        "summary": facts,
        "measured": _measured(found, number),
        "stars": _stars(found, listed),
        "relation": _relation(found),
    }


def _listed_stars(found: FrameIdentification) -> IntArray:
    """Rows of the catalogue stars on the page: identified, candidates, or missing."""
    listed = np.zeros(len(found.stars), np.bool_)
    listed[found.missing] = True
    listed[found.result.rows_2[found.result.p_pair >= LEAST]] = True
    listed[found.pairs[1]] = True
    return np.flatnonzero(listed)


def _measured(found: FrameIdentification, number: IntArray) -> dict[str, Any]:
    m, result = found.measured, found.result
    ra, dec, _ = found.plate.to_sky(m.x_px, m.y_px)
    partner = result.answers_1.partner
    sigma = m.sigma_px()
    flags = sorted({Flag.words(bits) for bits in m.flags})
    magnitude = np.full(len(m), np.nan)
    if found.zero_point is not None:
        rows = np.where(np.ma.getmaskarray(partner), 0, np.ma.getdata(partner))
        colour = np.where(np.ma.getmaskarray(partner), np.nan, found.stars.colour[rows])
        magnitude = found.zero_point(m.flux, colour)
    px, arc, chi = np.full((len(m), 2), np.nan), np.full((len(m), 2), np.nan), np.full(len(m), np.nan)
    i = found.pairs[0]
    px[i], arc[i], chi[i] = found.residual_px, found.residual_arcsec, result.matches.mahalanobis
    excess = np.full(len(m), np.nan)
    excess[i] = found.excess_mag
    return {
        "x": column(m.x_px, 2), "y": column(m.y_px, 2), "sx": column(sigma[:, 0], 3), "sy": column(sigma[:, 1], 3),
        "ra": column(ra, 6), "dec": column(dec, 6), "flux": column(m.flux, 1),
        "inst": column(instrumental(m.flux), 3),
        "mag": column(magnitude, 3), "excess": column(excess, 2), "snr": column(m.snr, 1), "fwhm": column(m.fwhm_px, 2),
        "beyond": found.beyond_catalogue.tolist(),
        "words": flags, "flags": [flags.index(Flag.words(bits)) for bits in m.flags],
        "star": [None if masked else int(number[row]) for row, masked in _masked(partner)],
        "none": column(result.answers_1.p_none.filled(np.nan), 6),
        "dx": column(px[:, 0], 3), "dy": column(px[:, 1], 3), "de": column(arc[:, 0], 4),
        "dn": column(arc[:, 1], 4), "chi": column(chi, 2),
        "rivals": _rivals(found, number),
    }  # fmt: skip


def _rivals(found: FrameIdentification, number: IntArray) -> list[list[list[Any]]]:
    """Per measurement its candidates, most probable first.

    Each is [star, probability, offset x, y in px, distance in quoted σ, 1 if chosen].
    """
    result = found.result
    candidates = np.flatnonzero((result.p_pair >= LEAST) | result.chosen)
    candidates = candidates[np.argsort(-result.p_pair[candidates], kind="stable")]
    rivals: list[list[list[Any]]] = [[] for _ in range(len(found.measured))]
    for e in candidates:
        candidates_of = rivals[int(result.rows_1[e])]
        if len(candidates_of) < COMPETITORS:
            dx, dy = result.pairs.residual[e]
            chi = float(np.sqrt(result.pairs.mahalanobis_sq[e]))
            candidates_of.append([
                int(number[result.rows_2[e]]), rounded(result.p_pair[e], 6), rounded(dx, 2), rounded(dy, 2),
                rounded(chi, 2), int(result.chosen[e]),
            ])  # fmt: skip
    return rivals


def _stars(found: FrameIdentification, listed: IntArray) -> dict[str, Any]:
    stars, px = found.stars, found.predicted_px[listed]
    owner = np.full(len(stars), -1)
    owner[found.pairs[1]] = found.pairs[0]
    missing = np.zeros(len(stars), np.bool_)
    missing[found.missing] = True
    missing_rows = np.flatnonzero(missing[listed])
    words = [""] * len(listed)
    for k, why in zip(missing_rows, why_missing(found, listed[missing_rows]), strict=True):
        words[int(k)] = why
    return {
        "id": [str(name) for name in stars.ids[listed]], "x": column(px[:, 0], 2), "y": column(px[:, 1], 2),
        "ra": column(stars.ra_deg[listed], 6), "dec": column(stars.dec_deg[listed], 6),
        "mag": column(stars.magnitude[listed], 3), "tint": column(stars.colour[listed], 3),
        "east": column(stars.moved_arcsec[listed, 0], 3), "north": column(stars.moved_arcsec[listed, 1], 3),
        "shown": column(found.p_detect[listed], 3), "missing": missing[listed].astype(int).tolist(), "why": words,
        "owner": [None if row < 0 else int(row) for row in owner[listed]],
    }  # fmt: skip


def _relation(found: FrameIdentification) -> list[list[float | None]]:
    """Points (instrumental magnitude, magnitude) of the fitted relation, for a line in the diagram."""
    if found.zero_point is None or not len(found.pairs[0]):
        return []
    measured = instrumental(found.measured.flux[found.pairs[0]])
    grid = np.linspace(np.nanmin(measured), np.nanmax(measured), 60)
    return [[rounded(a, 3), rounded(b, 3)] for a, b in zip(grid, found.zero_point(10 ** (-0.4 * grid)), strict=True)]


def _masked(column: np.ma.MaskedArray) -> zip[tuple[Any, Any]]:
    return zip(np.ma.getdata(column), np.ma.getmaskarray(column), strict=True)
