"""The pages of movers (blink and stack of each candidate, residuals, light, evidence) and of a series of frames."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, IntArray
from sameas.io.atomic import replacing
from sameas.pages.template import asset, column, page_of, png, rounded, script_safe
from sameas.report.movers import reasons
from sameas.sky.movers.known import KnownObjects
from sameas.sky.movers.search import Movers
from sameas.sky.movers.stack import Stack
from sameas.sky.series import MIN_FLOOR_ARCSEC, Series, Stars

#: Maximum number of candidates, and of frames per candidate, on the page (chosen: some megabytes).
MOST, MAX_FRAMES = 24, 40
#: In units of the pixel noise: distance of black below the sky, least white level, softening of asinh.
_BLACK, _WHITE, _SOFT = 2.0, 12.0, 4.0


def write_movers_page(
    path: str | os.PathLike[str], title: str, found: Movers, series: Series, pixels: Stack,
    known: KnownObjects | None = None, below: tuple[Movers, Stack, KnownObjects | None] | None = None,
    in_report: BoolArray | None = None,
) -> None:  # fmt: skip
    """Writes the page of the moving objects on a series of frames: one file, complete in itself.

    found : the tracklets. pixels : cut-outs of the first of them. known : their known objects, if elements were given.
    below : the same three for movers found only in the stacked frames, if these were searched. in_report : (k,) whether
    a tracklet is in the report; None without a report.

    Raises
    ------
    InputError : the path cannot be written.
    """
    count = min(len(pixels), MOST)
    more = f", the first {count} of them here" if count < len(found) else ""
    about = (
        f"{len(found)} {'candidate' if len(found) == 1 else 'candidates'}{more} on {len(series.exposures)} frames over "
        f"{1440.0 * (series.exposures[-1].mjd_utc - series.exposures[0].mjd_utc):.0f} minutes; "
        f"{found.p_tracklet.sum():.1f} expected to be real"
    )
    movers = [_mover(found, series, pixels, known, k) for k in range(count)]
    for k, one in enumerate(movers):
        one["report"] = None if in_report is None else bool(in_report[k])
    if below is not None:
        faint, light, names = below
        movers += [_mover(faint, series, light, names, k) for k in range(min(len(light), MOST))]
        about = about if len(found) else "No single frame shows a mover"
        about += f"; {len(faint) or 'none'} below the limit of single frames"
    data = {
        "about": about if movers or below else "No movers were found.", "asked": known is not None,
        "scale": series.stars.scale,
        "width": rounded(float(np.median([e.psf_fwhm_px for e in series.exposures])), 2),
        "movers": movers,
    }  # fmt: skip
    marks = {
        "css": asset("frame.css") + asset("series.css") + asset("movers.css"),
        "js": asset("chart.js") + asset("movers.js"),
        "data": script_safe(data),
    }
    with replacing(path) as draft:
        draft.write_text(page_of("movers.html", title, "movers", marks), encoding="utf-8")


def _mover(found: Movers, series: Series, pixels: Stack, known: KnownObjects | None, k: int) -> dict[str, Any]:
    shown = _frames(pixels, k)
    detections, rows = found.detections, found.members[k][found.members[k] >= 0]
    east, north = found.rate_arcsec_per_min[k]
    light = detections.magnitude[rows]
    fixed = pixels.fixed[k]
    usual = float(np.nanmedian(pixels.error[k])) if np.isfinite(pixels.error[k]).any() else 1.0
    top = max(_WHITE, 0.8 * float(np.nanpercentile(pixels.along[k][shown], 99.7)))
    at = np.zeros((len(series.exposures), 2))
    if fixed is not None:
        # East is to the left, north up.
        off = (pixels.place[k] - pixels.place[k].mean(axis=0)) / pixels.scale_arcsec_per_px
        at = (fixed.shape[1] - 1) / 2 + off * [-1.0, -1.0]
    frames = [
        {
            "name": series.exposures[n].name, "mjd": series.exposures[n].mjd_utc, "at": column(at[n], 2),
            "flux": rounded(pixels.flux[k, n] / usual, 3), "error": rounded(pixels.error[k, n] / usual, 3),
            "detected": bool(pixels.detected[k, n]), "hidden": bool(pixels.hidden[k, n]),
        }
        for n in shown
    ]  # fmt: skip
    each = [
        {
            "frame": detections.frame_names[detections.frame[row]], "mjd": float(detections.mjd_utc[row]),
            "ra": float(detections.ra_deg[row]), "dec": float(detections.dec_deg[row]),
            "magnitude": rounded(detections.magnitude[row], 3),
            "p": rounded(found.p_member[k, n], 6), "east": rounded(found.residual_arcsec[row, 0], 4),
            "north": rounded(found.residual_arcsec[row, 1], 4),
            "sigma": rounded(float(np.sqrt(detections.covariance[row, 0])), 4),
        }
        for n, row in enumerate(rows.tolist())
    ]  # fmt: skip
    return {
        "name": found.names[k], "p": float(found.p_tracklet[k]), "chance": float(found.expected_chance[k]),
        "rate": float(np.hypot(east, north)), "angle": float(np.degrees(np.arctan2(east, north)) % 360.0),
        "scatter": rounded(found.scatter_arcsec[k], 4),
        "magnitude": rounded(float(np.nanmedian(light)), 3) if np.isfinite(light).any() else None,
        "snr": rounded(pixels.snr[k], 2), "scale": pixels.scale_arcsec_per_px, "frames": frames, "rows": each,
        "reasons": [list(one) for one in reasons(found, pixels, k)], "known": _known(found, known, k),
        "added": found.added,
        "along": _sheet(pixels.along[k][shown], top), "fixed": None if fixed is None else _sheet(fixed[shown], top),
        "stack": _sheet(pixels.stacked[k][None], max(_WHITE, 0.8 * float(pixels.stacked[k].max()))),
    }  # fmt: skip


def _frames(pixels: Stack, k: int) -> NDArray[np.int64]:
    """The frames of a candidate on the page: those that cover it; of too many, evenly spaced detections or frames."""
    covering = np.flatnonzero(np.isfinite(pixels.flux[k]) | pixels.detected[k])
    if len(covering) <= MAX_FRAMES:
        return covering
    detected = covering[pixels.detected[k, covering]]
    choice = detected if len(detected) >= MAX_FRAMES else covering
    return np.asarray(choice[np.unique(np.linspace(0, len(choice) - 1, MAX_FRAMES).astype(np.int64))])


def _known(found: Movers, known: KnownObjects | None, k: int) -> dict[str, Any] | None:
    if known is None or known.object[k] < 0:
        return None
    east, north = known.mean_offset(found, k)
    return {
        "name": known.name(k), "p": float(known.p[k]), "east": rounded(east, 3), "north": rounded(north, 3),
        "v": rounded(known.magnitude[k], 2),
    }  # fmt: skip


def _sheet(cuts: NDArray[np.float32], top: float) -> dict[str, Any]:
    """Cut-outs (f, s, s) in units of their noise, side by side as one PNG."""
    light = np.arcsinh(np.maximum(np.nan_to_num(cuts) + _BLACK, 0.0) / _SOFT) / np.arcsinh((top + _BLACK) / _SOFT)
    grey = (255.0 * np.clip(light, 0.0, 1.0)).astype(np.uint8)
    wide = np.ascontiguousarray(grey.transpose(1, 0, 2).reshape(grey.shape[1], -1))
    return {"size": int(cuts.shape[1]), "png": base64.b64encode(png(wide)).decode("ascii")}


# The page of a series: frames with links to their pages, zero points, light curves of stars, doubts.

#: Maximum number of stars on the page, and how many of them are the least constant (chosen: some megabytes).
MAX_STARS, MIN_CONSTANT = 600, 200


def series_field(
    name: str, series: Series, summary: Sequence[Mapping[str, Any]], doubts: Sequence[Sequence[str]], filter: str = ""
) -> dict[str, Any]:
    """The data of one series for the page.

    summary : of each frame, doubts : of each frame, both in the order of time.
    """
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
            "scatter": rounded(series.floor_arcsec[k], 3),
            "below": bool(series.floor_arcsec[k] <= MIN_FLOOR_ARCSEC),
            "width": rounded(one.get("psf_fwhm_px") or np.nan, 2),
            "shift": column(series.shift_arcsec[k], 5), "doubts": list(doubts[k]),
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
    """Rows of the stars on the page: all, or the least constant and the brightest."""
    usable = np.flatnonzero(np.isfinite(stars.mean) & np.isfinite(stars.scatter_mag))
    if len(usable) <= MAX_STARS:
        return usable
    variable = usable[np.argsort(stars.p_constant[usable], kind="stable")][:MIN_CONSTANT]
    bright = usable[np.argsort(stars.mean[usable], kind="stable")]
    bright = bright[~np.isin(bright, variable)][: MAX_STARS - len(variable)]
    return np.sort(np.concatenate([variable, bright]))


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

    fields : results of :func:`series_field`. failed : (name, reason) of frames that could not be identified. reasons :
    why frames are in no series. movers : file of the page of movers, and the words of the link to it.

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
