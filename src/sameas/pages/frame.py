"""The pages of an identified frame, of a series of frames, and of the movers on them.

A frame: its image with marks, and records, residuals, magnitudes and plate model. Movers: blink and stack of each
candidate, residuals, light, evidence.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, IntArray
from sameas.io.atomic import replacing
from sameas.pages import asset, column, page_of, png, rounded, script_safe
from sameas.plots.frame import binned, binning, stretched
from sameas.report.frame import doubts_of, doubts_of_frames
from sameas.report.movers import reasons
from sameas.representation import counted
from sameas.sky.frame.identified import P_EXPECTED, FrameIdentification
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag
from sameas.sky.frame.outputs import why_missing
from sameas.sky.frame.photometry import instrumental

if TYPE_CHECKING:
    from sameas.sky.movers.known import KnownObjects
    from sameas.sky.movers.search import Movers
    from sameas.sky.movers.stack import Stack
    from sameas.sky.series import Series
    from sameas.sky.series_stars import SeriesStars

#: Maximum number of candidates per measurement on the page, and their minimum probability (chosen).
COMPETITORS, LEAST = 6, 1e-6


def write_frame_page(
    match: FrameIdentification, frame: Frame, path: str | os.PathLike[str], facts: Mapping[str, Any],
    brightest: int | None,
) -> None:  # fmt: skip
    """Writes the page of an identified frame: one file, complete in itself.

    facts : result of :func:`sameas.sky.frame.outputs.summary` for this frame, with its provenance. brightest : number
    of the brightest identified stars marked at first, None for all; the page has a slider.

    Raises InputError: the path cannot be written.
    """
    factor = binning(frame.shape)
    grey = stretched(binned(frame.image, factor))[::-1]
    marks = {
        "css": asset("frame.css"),
        "js": asset("chart.js") + asset("frame.js"),
        "picture": base64.b64encode(png(np.ascontiguousarray(grey))).decode("ascii"),
        "data": script_safe(_data(match, facts, factor, brightest)),
    }
    with replacing(path) as draft:
        draft.write_text(page_of("frame.html", match.measured.name, "identified", marks), encoding="utf-8")


def _data(match: FrameIdentification, facts: Mapping[str, Any], factor: int, brightest: int | None) -> dict[str, Any]:
    rows, columns = match.measured.shape
    listed = _listed_stars(match)
    number = np.full(len(match.stars), ABSENT)
    number[listed] = np.arange(len(listed))
    return {
        "name": match.measured.name,
        "catalogue": match.stars.name,
        "colour": match.stars.colour_name,
        "shape": [rows, columns],
        "bin": factor,
        "width_px": rounded(match.measured.psf_fwhm_px, 2),
        "brightest": brightest,
        "expected": P_EXPECTED,
        "odd": match.pairs[0][match.odd_brightness].tolist(),
        "summary": facts,
        "measured": _measured(match, number),
        "stars": _stars(match, listed),
        "relation": _relation(match),
    }


def _listed_stars(match: FrameIdentification) -> IntArray:
    """Rows of the catalogue stars on the page: identified, candidates, or missing."""
    listed = np.zeros(len(match.stars), np.bool_)
    listed[match.missing] = True
    listed[match.result.rows_2[match.result.p_pair >= LEAST]] = True
    listed[match.pairs[1]] = True
    return np.flatnonzero(listed)


def _measured(match: FrameIdentification, number: IntArray) -> dict[str, Any]:
    m, result = match.measured, match.result
    ra, dec, _ = match.plate.to_sky(m.x_px, m.y_px)
    partner = result.answers_1.partner
    sigma = m.sigma_px()
    flags = sorted({Flag.words(bits) for bits in m.flags})
    magnitude = np.full(len(m), np.nan)
    if match.zero_point is not None:
        rows = np.where(np.ma.getmaskarray(partner), 0, np.ma.getdata(partner))
        colour = np.where(np.ma.getmaskarray(partner), np.nan, match.stars.colour[rows])
        magnitude = match.zero_point(m.flux, colour)
    px, arc, chi = np.full((len(m), 2), np.nan), np.full((len(m), 2), np.nan), np.full(len(m), np.nan)
    i = match.pairs[0]
    px[i], arc[i], chi[i] = match.residual_px, match.residual_arcsec, result.matches.mahalanobis
    excess = np.full(len(m), np.nan)
    excess[i] = match.excess_mag
    return {
        "x": column(m.x_px, 2), "y": column(m.y_px, 2), "sx": column(sigma[:, 0], 3), "sy": column(sigma[:, 1], 3),
        "ra": column(ra, 6), "dec": column(dec, 6), "flux": column(m.flux, 1),
        "inst": column(instrumental(m.flux), 3),
        "mag": column(magnitude, 3), "excess": column(excess, 2), "snr": column(m.snr, 1), "fwhm": column(m.fwhm_px, 2),
        "beyond": match.beyond_catalogue.tolist(),
        "words": flags, "flags": [flags.index(Flag.words(bits)) for bits in m.flags],
        "star": [None if masked else int(number[row]) for row, masked in _masked(partner)],
        "none": column(result.answers_1.p_none.filled(np.nan), 6),
        "dx": column(px[:, 0], 3), "dy": column(px[:, 1], 3), "de": column(arc[:, 0], 4),
        "dn": column(arc[:, 1], 4), "chi": column(chi, 2),
        "rivals": _rivals(match, number),
    }  # fmt: skip


def _rivals(match: FrameIdentification, number: IntArray) -> list[list[list[Any]]]:
    """Per measurement its candidates, most probable first.

    Each is [star, probability, offset x, y in px, distance in quoted σ, 1 if chosen].
    """
    result = match.result
    candidates = np.flatnonzero((result.p_pair >= LEAST) | result.chosen)
    candidates = candidates[np.argsort(-result.p_pair[candidates], kind="stable")]
    rivals: list[list[list[Any]]] = [[] for _ in range(len(match.measured))]
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


def _stars(match: FrameIdentification, listed: IntArray) -> dict[str, Any]:
    stars, px = match.stars, match.predicted_px[listed]
    owner = np.full(len(stars), ABSENT)
    owner[match.pairs[1]] = match.pairs[0]
    missing = np.zeros(len(stars), np.bool_)
    missing[match.missing] = True
    missing_rows = np.flatnonzero(missing[listed])
    words = [""] * len(listed)
    for k, why in zip(missing_rows, why_missing(match, listed[missing_rows]), strict=True):
        words[int(k)] = why
    return {
        "id": [str(name) for name in stars.ids[listed]], "x": column(px[:, 0], 2), "y": column(px[:, 1], 2),
        "ra": column(stars.ra_deg[listed], 6), "dec": column(stars.dec_deg[listed], 6),
        "mag": column(stars.magnitude[listed], 3), "tint": column(stars.colour[listed], 3),
        "east": column(stars.moved_arcsec[listed, 0], 3), "north": column(stars.moved_arcsec[listed, 1], 3),
        "shown": column(match.p_detect[listed], 3), "missing": missing[listed].astype(int).tolist(), "why": words,
        "owner": [None if row < 0 else int(row) for row in owner[listed]],
    }  # fmt: skip


def _relation(match: FrameIdentification) -> list[list[float | None]]:
    """Points (instrumental magnitude, magnitude) of the fitted relation, for a line in the diagram."""
    if match.zero_point is None or not len(match.pairs[0]):
        return []
    measured = instrumental(match.measured.flux[match.pairs[0]])
    grid = np.linspace(np.nanmin(measured), np.nanmax(measured), 60)
    return [[rounded(a, 5), rounded(b, 5)] for a, b in zip(grid, match.zero_point(10 ** (-0.4 * grid)), strict=True)]


def _masked(column: np.ma.MaskedArray) -> zip[tuple[Any, Any]]:
    return zip(np.ma.getdata(column), np.ma.getmaskarray(column), strict=True)


#: Maximum number of candidates, and of frames per candidate, on the page (chosen: some megabytes).
MOST, MAX_FRAMES = 24, 40
#: In units of the pixel noise: distance of black below the sky, least white level, softening of asinh.
_BLACK, _WHITE, _SOFT = 2.0, 12.0, 4.0


def write_movers_page(
    path: str | os.PathLike[str], title: str, found: Movers, series: Series, pixels: Stack,
    known: KnownObjects | None = None, below: tuple[Movers, Stack, KnownObjects | None] | None = None,
    in_report: BoolArray | None = None, streaks: int = 0,
) -> None:  # fmt: skip
    """Writes the page of the moving objects on a series of frames: one file, complete in itself.

    found : the tracklets. pixels : cut-outs of the first of them. known : their known objects, if elements were given.
    below : the same three for movers found only in the stacked frames, if these were searched. in_report : (k,) whether
    a tracklet is in the report; None without a report. streaks : number of trails on single frames.

    Raises InputError: the path cannot be written.
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
    about = about if movers or below else "No movers were found"
    about += f"; {counted(streaks, 'streak')} on single frames in streaks.fits" if streaks else ""
    data = {
        "about": about, "asked": known is not None,
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


def _mover(movers: Movers, series: Series, pixels: Stack, known: KnownObjects | None, k: int) -> dict[str, Any]:
    shown = _frames(pixels, k)
    detections, rows = movers.detections, movers.members[k][movers.members[k] >= 0]
    east, north = movers.rate_arcsec_per_min[k]
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
            "p": rounded(movers.p_member[k, n], 6), "east": rounded(movers.residual_arcsec[row, 0], 4),
            "north": rounded(movers.residual_arcsec[row, 1], 4),
            "sigma": rounded(float(np.sqrt(detections.covariance[row, 0])), 4),
        }
        for n, row in enumerate(rows.tolist())
    ]  # fmt: skip
    return {
        "name": movers.names[k], "p": float(movers.p_tracklet[k]), "chance": float(movers.expected_chance[k]),
        "rate": float(np.hypot(east, north)), "angle": float(np.degrees(np.arctan2(east, north)) % 360.0),
        "scatter": rounded(movers.scatter_arcsec[k], 4),
        "magnitude": rounded(float(np.nanmedian(light)), 3) if np.isfinite(light).any() else None,
        "snr": rounded(pixels.snr[k], 2), "scale": pixels.scale_arcsec_per_px, "frames": frames, "rows": each,
        "reasons": [list(one) for one in reasons(movers, pixels, k)], "known": _known(movers, known, k),
        "added": movers.added,
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


def _known(movers: Movers, known: KnownObjects | None, k: int) -> dict[str, Any] | None:
    if known is None or known.object[k] < 0:
        return None
    east, north = known.mean_offset(movers, k)
    return {
        "name": known.name(k), "p": float(known.p[k]), "east": rounded(east, 3), "north": rounded(north, 3),
        "v": rounded(known.magnitude[k], 1),
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


def series_field(name: str, series: Series, summaries: Sequence[Mapping[str, Any]], filter: str) -> dict[str, Any]:
    """The data of one series for the page. summaries : of the frames in the order of time."""
    from sameas.sky.series import MIN_FLOOR_ARCSEC

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
            "shift": column(series.shift_arcsec[k], 5), "doubts": len(doubts_of(one)),
        }
        for k, (one, exposure) in enumerate(zip(summaries, series.exposures, strict=True))
    ]  # fmt: skip
    return {
        "name": name, "filter": filter, "middle": list(series.middle_deg), "frames": frames, "count": len(stars),
        "scale": stars.scale, "floor": rounded(stars.floor_mag, 5),
        "notes": [*series.notes, *doubts_of_frames(summaries)],
        "stars": {
            "number": shown.tolist(), "id": stars.name[shown].tolist(), "ra": column(ra, 6), "dec": column(dec, 6),
            "mag": column(stars.mean[shown], 3), "scatter": column(stars.scatter_mag[shown], 5),
            "p": column(stars.p_constant[shown], 9), "curve": [column(row, 4) for row in stars.magnitude[shown]],
            "err": [column(row, 4) for row in stars.error[shown]], "de": [column(row, 3) for row in left[..., 0]],
            "dn": [column(row, 3) for row in left[..., 1]],
        },
    }  # fmt: skip


def _shown(stars: SeriesStars) -> IntArray:
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
    failed: Sequence[tuple[str, str]],
    reasons: Sequence[str],
    movers: tuple[str, str] | None,
) -> None:
    """Writes the page of a folder of frames: one file, complete in itself.

    fields : results of :func:`series_field`. failed : (name, reason) of frames that could not be identified. reasons :
    why frames are in no series. movers : file of the page of movers, and the words of the link to it.

    Raises InputError: the path cannot be written.
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
