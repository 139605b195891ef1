"""The page of a series: its frames with links to their pages, zero points, light curves of its stars, doubts."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sameas.arrays import IntArray
from sameas.io.atomic import replacing
from sameas.pages.numbers import column, rounded
from sameas.pages.template import asset, page_of, script_safe
from sameas.sky.series.stars import Stars
from sameas.sky.series.tied import Series

#: Most stars on the page, the least constant among them (chosen: a page of some megabytes).
MOST, LEAST_CONSTANT = 600, 200


def series_field(
    name: str, series: Series, summary: Sequence[Mapping[str, Any]], doubts: Sequence[Sequence[str]], filter: str = ""
) -> dict[str, Any]:
    """What the page has of one series. told : summaries of its frames, doubts : of each, in the order of time."""
    stars = series.stars
    shown = _shown(stars)
    ra, dec = series.sky(stars.place[shown])
    left = stars.residual_arcsec[shown]
    frames = [
        {
            "name": one["frame"], "page": one.get("outputs", {}).get("page"), "mjd": exposure.mjd_utc,
            "measured": one["found"]["measurements"], "identified": one["found"]["identified"],
            "missing": one["found"]["missing"], "zero": rounded(stars.zero_point[k], 4),
            "zero_err": rounded(stars.zero_error[k], 4), "ensemble": int(stars.ensemble[k]),
            "scatter": rounded(series.floor_arcsec[k], 3), "width": rounded(one.get("psf_fwhm_px") or np.nan, 2),
            "shift": column(series.shift_arcsec[k], 3), "doubts": list(doubts[k]),
        }
        for k, (one, exposure) in enumerate(zip(summary, series.exposures, strict=True))
    ]  # fmt: skip
    return {
        "name": name, "filter": filter, "middle": list(series.middle_deg), "frames": frames, "count": len(stars),
        "scale": stars.scale, "floor": rounded(stars.floor_mag, 5), "notes": list(series.notes),
        "stars": {
            "number": shown.tolist(), "id": stars.name[shown].tolist(), "ra": column(ra, 6), "dec": column(dec, 6),
            "mag": column(stars.mean[shown], 3), "scatter": column(stars.scatter_mag[shown], 5),
            "p": column(stars.p_constant[shown], 6), "curve": [column(row, 4) for row in stars.magnitude[shown]],
            "err": [column(row, 4) for row in stars.error[shown]], "de": [column(row, 3) for row in left[..., 0]],
            "dn": [column(row, 3) for row in left[..., 1]],
        },
    }  # fmt: skip


def _shown(stars: Stars) -> IntArray:
    """Rows of the stars that the page has: all, or the least constant and the brightest."""
    usable = np.flatnonzero(np.isfinite(stars.mean) & np.isfinite(stars.scatter_mag))
    if len(usable) <= MOST:
        return usable
    odd = usable[np.argsort(stars.p_constant[usable], kind="stable")][:LEAST_CONSTANT]
    bright = usable[np.argsort(stars.mean[usable], kind="stable")]
    bright = bright[~np.isin(bright, odd)][: MOST - len(odd)]
    return np.sort(np.concatenate([odd, bright]))


def write_series_page(
    path: str | os.PathLike[str],
    title: str,
    fields: Sequence[Mapping[str, Any]],
    *,
    failed: Sequence[tuple[str, str]] = (),
    reasons: Sequence[str] = (),
    movers: tuple[str, str] | None = None,
) -> None:
    """Writes the page of a folder of frames: one file, complete in itself.

    fields : of :func:`series_field`. failed : frames that could not be identified, and why. reasons : why frames are in
    no series. movers : the file of the page of what moves, and the words of the link.

    Raises
    ------
    InputError : the path cannot be written.
    """
    data = {
        "fields": list(fields), "failed": [list(one) for one in failed], "reasons": list(reasons),
        "movers": None if movers is None else {"page": movers[0], "words": movers[1]},
    }  # fmt: skip
    marks = {
        "css": asset("frame.css") + asset("series.css"),
        "js": asset("chart.js") + asset("series.js"),
        "data": script_safe(data),
    }
    with replacing(path) as draft:
        draft.write_text(page_of("series.html", title, "series", marks), encoding="utf-8")
