"""Outputs of an identified frame: its listing as a table, and its summary as numbers and texts for JSON.

The listing has one row per measurement, and one per star on the frame that was not identified. ``fate`` is one of

- ``identified``: a measurement with its star;
- ``unidentified``: a measurement without a star of the catalogue;
- ``missing``: a star that should be detected but has no measurement; ``remark`` says what was measured there;
- ``too faint``: a star of the catalogue with a detection probability below a half.

Measurements come first, brightest first, then stars. Pixels are given twice: ``x_px`` is 0-based, ``x_image`` 1-based
as in FITS headers, DS9 and SExtractor.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.result import AMBIGUOUS
from sameas.sky.frame.identified import BRIGHTER_MAG, HIDDEN_WIDTHS, MERGED_WIDTHS, P_EXPECTED, FrameIdentification
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import POGSON, Flag
from sameas.sky.frame.place import odds_in_words
from sameas.sky.output_columns import meta_of
from sameas.space import directions_deg

if TYPE_CHECKING:
    from astropy.table import Table


def listing(identification: FrameIdentification) -> Table:
    """The table of a frame; absent values are masked."""
    from astropy.table import MaskedColumn, Table

    unidentified = _unidentified_stars(identification)
    table = Table(masked=True)
    for name, (measured, star, unit, words) in _columns(identification, unidentified).items():
        parts = [_masked(measured, len(identification.measured)), _masked(star, len(unidentified))]
        kinds = [part for part in parts if part.dtype != object]
        dtype = np.result_type(*(part.dtype for part in kinds)) if kinds else np.dtype("U1")
        values = np.ma.concatenate([_cast(part, dtype) for part in parts])  # type: ignore[no-untyped-call]
        table[name] = MaskedColumn(values, unit=unit or None, description=words, meta=meta_of(name))
    table.meta.update(frame=identification.measured.name, catalogue=identification.stars.name)
    return table


def _unidentified_stars(identification: FrameIdentification) -> IntArray:
    """Rows of the stars on the frame without a measurement, brightest first."""
    unidentified = identification.inside.copy()
    unidentified[identification.pairs[1]] = False
    rows = np.flatnonzero(unidentified)
    return rows[np.argsort(np.nan_to_num(identification.stars.magnitude[rows], nan=99.0), kind="stable")]


#: Values for the measurements, values for the stars (None: absent), unit, description.
_Column = tuple[Any, Any, str, str]


def _columns(identification: FrameIdentification, unidentified: IntArray) -> dict[str, _Column]:
    return {
        **_identity_columns(identification, unidentified),
        **_position_columns(identification, unidentified),
        **_probability_columns(identification, unidentified),
        **_photometry_columns(identification, unidentified),
    }


def _identity_columns(identification: FrameIdentification, unidentified: IntArray) -> dict[str, _Column]:
    m, stars = identification.measured, identification.stars
    partner = identification.result.answers_1.partner
    fate = np.where(np.ma.getmaskarray(partner), "unidentified", "identified")
    ids = _selected(stars.ids, partner)
    expected = identification.p_detect[unidentified] >= P_EXPECTED
    words = [Flag.words(bits) for bits in identification.measured.flags]
    for k in identification.odd_brightness:
        row = int(identification.pairs[0][k])
        words[row] = "; ".join(filter(None, [odd_words(float(identification.excess_mag[k])), words[row]]))
    return {
        "fate": (fate, np.where(expected, "missing", "too faint"), "", "fate of the row"),
        "measurement": (np.arange(len(m)), None, "", "number of the measurement, brightest first"),
        "star": (ids, stars.ids[unidentified], "", f"identifier in {stars.name}"),
        "star_row": (_selected(stars.rows, partner), stars.rows[unidentified], "", f"row in {stars.name}"),
        "remark": (
            np.array(words, dtype=str),
            np.array(why_missing(identification, unidentified), dtype=str),
            "",
            "flags of a measurement, and whether its star is brighter or fainter than catalogued; what stands in the "
            "place of a missing star",
        ),
        "flags": (m.flags, None, "", "bits: " + ", ".join(f"{int(f)} {str(f.name).lower()}" for f in Flag)),
    }


def odd_words(excess_mag: float) -> str:
    """Text on the difference of a star from its catalogued magnitude.

    >>> odd_words(-2.31)
    '2.3 mag brighter than catalogued'
    """
    return f"{abs(excess_mag):.1f} mag {'brighter' if excess_mag < 0 else 'fainter'} than catalogued"


def _position_columns(identification: FrameIdentification, unidentified: IntArray) -> dict[str, _Column]:
    m, stars, px = identification.measured, identification.stars, identification.predicted_px
    partner = identification.result.answers_1.partner
    ra, dec, sky = identification.plate.to_sky(m.x_px, m.y_px, m.covariance)
    star_px, star_cov = px[unidentified], identification.predicted_covariance[unidentified]
    residual_px, residual_sky = (
        _per_measurement(identification, values)
        for values in (identification.residual_px, identification.residual_arcsec)
    )
    measured, predicted = "measured, of a missing star predicted", "at the frame's epoch, from the catalogue"
    return {
        "x_px": (m.x_px, star_px[:, 0], "pix", f"{measured}; the first pixel is 0"),
        "y_px": (m.y_px, star_px[:, 1], "pix", f"{measured}; the first pixel is 0"),
        "x_image": (m.x_px + 1, star_px[:, 0] + 1, "pix", f"{measured}; the first pixel is 1"),
        "y_image": (m.y_px + 1, star_px[:, 1] + 1, "pix", f"{measured}; the first pixel is 1"),
        "cov_xx_px2": (m.covariance[:, 0], star_cov[:, 0], "pix2", "variance along x"),
        "cov_xy_px2": (m.covariance[:, 1], star_cov[:, 1], "pix2", "covariance of x and y"),
        "cov_yy_px2": (m.covariance[:, 2], star_cov[:, 2], "pix2", "variance along y"),
        "ra_deg": (ra, stars.ra_deg[unidentified], "deg", "ICRS, of the measurement by the plate model"),
        "dec_deg": (dec, stars.dec_deg[unidentified], "deg", "ICRS, of the measurement by the plate model"),
        "cov_ee_arcsec2": (sky[:, 0], stars.covariance_arcsec[unidentified, 0], "arcsec2", "variance east"),
        "cov_en_arcsec2": (
            sky[:, 1],
            stars.covariance_arcsec[unidentified, 1],
            "arcsec2",
            "covariance of east and north",
        ),
        "cov_nn_arcsec2": (sky[:, 2], stars.covariance_arcsec[unidentified, 2], "arcsec2", "variance north"),
        "star_x_px": (_selected(px[:, 0], partner), star_px[:, 0], "pix", "predicted by the plate model"),
        "star_y_px": (_selected(px[:, 1], partner), star_px[:, 1], "pix", "predicted by the plate model"),
        "star_ra_deg": (_selected(stars.ra_deg, partner), stars.ra_deg[unidentified], "deg", predicted),
        "star_dec_deg": (_selected(stars.dec_deg, partner), stars.dec_deg[unidentified], "deg", predicted),
        "moved_east_arcsec": (
            _moved(identification, partner, 0),
            stars.moved_arcsec[unidentified, 0],
            "arcsec",
            "since its own epoch",
        ),
        "moved_north_arcsec": (
            _moved(identification, partner, 1),
            stars.moved_arcsec[unidentified, 1],
            "arcsec",
            "since its own epoch",
        ),
        "residual_x_px": (residual_px[:, 0], None, "pix", "measured minus predicted"),
        "residual_y_px": (residual_px[:, 1], None, "pix", "measured minus predicted"),
        "residual_east_arcsec": (residual_sky[:, 0], None, "arcsec", "measured minus catalogue"),
        "residual_north_arcsec": (residual_sky[:, 1], None, "arcsec", "measured minus catalogue"),
    }


def _probability_columns(identification: FrameIdentification, unidentified: IntArray) -> dict[str, _Column]:
    one, two = identification.result.answers_1, identification.result.answers_2
    distance = np.full(len(identification.measured), np.nan)
    distance[identification.pairs[0]] = identification.result.matches.mahalanobis
    second_measurement = _selected(np.arange(len(identification.measured)), two.second)[unidentified]
    return {
        "p_match": (one.p_match, None, "", "probability that the measurement is this star"),
        "p_none": (one.p_none, two.p_none[unidentified], "", "probability of having no partner"),
        "p_second": (one.p_second, two.p_second[unidentified], "", "probability of the next best candidate"),
        "second_star": (
            _selected(identification.stars.ids, one.second),
            None,
            "",
            "the next best candidate of a measurement",
        ),
        "second_measurement": (None, second_measurement, "", "the best candidate of a missing star"),
        "candidates": (one.candidates, two.candidates[unidentified], "", "candidates within the gate"),
        "distance_sigma": (distance, None, "", "residual over its quoted error"),
        "p_detect": (
            None,
            identification.p_detect[unidentified],
            "",
            "completeness of the frame at the star's magnitude",
        ),
    }


def _photometry_columns(identification: FrameIdentification, unidentified: IntArray) -> dict[str, _Column]:
    m, stars = identification.measured, identification.stars
    partner = identification.result.answers_1.partner
    colour = _selected(stars.colour, partner)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(m.flux > 0, POGSON * m.flux_err / m.flux, np.nan)
    zero_point = identification.zero_point
    magnitude = None if zero_point is None else zero_point(m.flux, colour.filled(np.nan))
    return {
        "flux": (m.flux, None, "", "flux above the sky, in the unit of the frame"),
        "flux_err": (m.flux_err, None, "", "its standard deviation"),
        "magnitude": (magnitude, None, "mag", f"from the flux, in the band of {stars.name}"),
        "magnitude_err": (error, None, "mag", "from the error of the flux alone"),
        "star_magnitude": (
            _selected(stars.magnitude, partner),
            stars.magnitude[unidentified],
            "mag",
            f"from {stars.name}",
        ),
        "star_colour": (colour, stars.colour[unidentified], "mag", stars.colour_name or "not known"),
        "snr": (m.snr, None, "", "significance of the detection"),
        "fwhm_px": (m.fwhm_px, None, "pix", "width at half maximum"),
    }


def why_missing(identification: FrameIdentification, rows: IntArray) -> list[str]:
    """Texts on why stars, rows (k,), were not identified: what was measured at the position of each."""
    from scipy.spatial import cKDTree

    m, px = identification.measured, identification.predicted_px
    width = m.psf_fwhm_px
    owner = identification.result.answers_1.partner
    tree = cKDTree(np.column_stack([m.x_px, m.y_px]))
    reach = [width * MERGED_WIDTHS, width * HIDDEN_WIDTHS]
    close, in_wings = (tree.query_ball_point(px[rows], radius, return_sorted=True) for radius in reach)
    edge = np.minimum(px[rows], np.array(m.shape[::-1]) - 1 - px[rows]).min(axis=1)
    words = []
    for k, row in enumerate(rows):
        hidden = [
            i
            for i in in_wings[k]
            if m.flags[i] & Flag.SATURATED and _is_brighter(identification, int(i), int(row), owner)
        ]
        if close[k]:
            i = min(close[k], key=lambda i: float(np.hypot(m.x_px[i] - px[row, 0], m.y_px[i] - px[row, 1])))
            words.append(_nearby_measurement(identification, int(i), int(row), owner))
        elif edge[k] < width:
            words.append("on the edge of the frame")
        elif identification.p_detect[row] < P_EXPECTED:
            words.append(f"completeness at its magnitude {100 * identification.p_detect[row]:.0f} %")
        elif hidden:
            words.append(f"in the wings of measurement {hidden[0]}, which is saturated")
        else:
            words.append("nothing was measured there")
    return words


def _is_brighter(identification: FrameIdentification, i: int, row: int, owner: np.ma.MaskedArray) -> bool:
    if np.ma.getmaskarray(owner)[i]:
        return True
    magnitude = identification.stars.magnitude
    return bool(magnitude[owner[i]] < magnitude[row] - BRIGHTER_MAG)


def _nearby_measurement(identification: FrameIdentification, i: int, row: int, owner: np.ma.MaskedArray) -> str:
    m, px = identification.measured, identification.predicted_px[row]
    distance = float(np.hypot(m.x_px[i] - px[0], m.y_px[i] - px[1]))
    if np.ma.getmaskarray(owner)[i]:
        return f"measurement {i} is {distance:.1f} px away, too far for their errors"
    return f"measurement {i}, {distance:.1f} px away, is {identification.stars.ids[owner[i]]}; one mark for both"


def _per_measurement(identification: FrameIdentification, values: FloatArray) -> FloatArray:
    """(n, d) values of the identified pairs per measurement; NaN for unidentified ones."""
    column = np.full((len(identification.measured), values.shape[1]), np.nan)
    column[identification.pairs[0]] = values
    return column


def _moved(identification: FrameIdentification, partner: np.ma.MaskedArray, axis: int) -> np.ma.MaskedArray:
    return _selected(identification.stars.moved_arcsec[:, axis], partner)


def _selected(values: NDArray[Any], rows: np.ma.MaskedArray) -> np.ma.MaskedArray:
    """``values`` at ``rows``, masked where the row is masked."""
    absent = np.ma.getmaskarray(rows)
    return np.ma.MaskedArray(values[np.where(absent, 0, np.ma.getdata(rows))], absent.copy())


def _masked(values: Any, n: int) -> np.ma.MaskedArray:
    """Part of a column, masked where not finite; all masked if ``values`` is None."""
    if values is None:
        return np.ma.MaskedArray(np.zeros(n, dtype=object), np.ones(n, bool))
    column: np.ma.MaskedArray = np.ma.MaskedArray(values, copy=True)
    if column.dtype.kind == "f":
        column[~np.isfinite(np.ma.getdata(column))] = np.ma.masked
    return column


def _cast(values: np.ma.MaskedArray, dtype: np.dtype[Any]) -> np.ma.MaskedArray:
    if values.dtype == object:
        return np.ma.MaskedArray(np.zeros(len(values), dtype), np.ones(len(values), bool))
    return np.ma.MaskedArray(values, dtype=dtype)


#: Names of the terms of the error model in the summary.
ERROR_TERM_NAMES = {
    "factor_1": "error_factor_frame",
    "factor_2": "error_factor_catalogue",
    "both": "error_factor_both",
    "floor": "error_floor_arcsec",
    "floor_instead": "error_floor_instead_arcsec",
}


def summary(identification: FrameIdentification, frame: Frame | None = None) -> dict[str, Any]:
    """The summary for JSON; angles in degrees, units in the names.

    frame : adds the facts of its header.
    """
    return {
        "frame": identification.measured.name,
        "catalogue": identification.stars.name,
        "epoch_jyr": identification.stars.epoch_jyr,
        **({} if frame is None else {"exposure": _exposure(frame)}),
        "psf_fwhm_px": _number(identification.measured.psf_fwhm_px),
        "place": _place(identification),
        "plate": _plate(identification),
        "found": _counts(identification),
        "estimated": _estimated(identification),
        "error_note": "" if identification.estimate.error_model is None else identification.estimate.error_model.note,
        "residuals": _residuals(identification),
        "brightness": _brightness(identification),
        "notes": [*identification.measured.notes, *identification.notes],
    }


def _exposure(frame: Frame) -> dict[str, Any]:
    facts = frame.facts
    time = facts.mid_time
    return {
        "mid_time": None if time is None else f"{time.isot} {time.scale.upper()}",
        "exposure_s": _number(facts.exposure_s),
        "filter": None if frame.header is None else str(frame.header.get("FILTER", "")).strip() or None,
        "gain_e_per_adu": _number(facts.gain_e_per_adu),
        "saturation_adu": _number(facts.saturation_adu),
        "read": list(facts.lines),
    }


def _place(identification: FrameIdentification) -> dict[str, Any]:
    rows, columns = identification.measured.shape
    middle = (columns - 1) / 2.0, (rows - 1) / 2.0
    ra, dec, _ = identification.plate.to_sky(*middle)
    scale, rotation, parity = orientation(identification)
    placement = identification.placement
    return {
        "found_by": placement.hint,
        "odds": odds_in_words(placement.log_odds),
        "log_odds": _number(placement.log_odds),
        "next_best_odds": odds_in_words(placement.runner_up_log_odds),
        "stars": placement.n_matched,
        "middle_ra_deg": float(ra[0]),
        "middle_dec_deg": float(dec[0]),
        "scale_arcsec_per_px": scale,
        "rotation_deg": rotation,
        "mirrored": parity > 0,
        "columns": columns,
        "rows": rows,
        "width_deg": columns * scale / 3600.0,
        "height_deg": rows * scale / 3600.0,
    }


def orientation(identification: FrameIdentification) -> tuple[float, float, int]:
    """Arcsec per pixel, direction of the y axis in degrees from north through east, and parity, at the middle."""
    plate, rows, columns = identification.plate, *identification.measured.shape
    slope = plate.polynomial.slope(np.array([[(columns - 1) / 2.0, (rows - 1) / 2.0]]))[0]
    determinant = float(np.linalg.det(slope))
    rotation = math.degrees(math.atan2(slope[0, 1], slope[1, 1])) % 360.0
    return math.sqrt(abs(determinant)), rotation, 1 if determinant > 0 else -1


def _plate(identification: FrameIdentification) -> dict[str, Any]:
    plate = identification.plate
    ra, dec = directions_deg(plate.centre)
    spread = np.sqrt(np.diag(plate.covariance)).reshape(2, -1)
    return {
        "order": plate.order,
        "bic": {str(order): float(value) for order, value in plate.bic.items()},
        "left_out": {str(order): float(value) for order, value in plate.leave_one_out.items()},
        "effective_pairs": plate.effective_pairs,
        "error_scale": plate.error_scale,
        "floor_arcsec": plate.floor_arcsec,
        "tangent_ra_deg": float(ra),
        "tangent_dec_deg": float(dec),
        "middle_px": plate.polynomial.middle_px.tolist(),
        "unit_px": plate.polynomial.unit_px,
        "coefficients_arcsec": plate.polynomial.coefficients.tolist(),
        "coefficients_sigma_arcsec": spread.tolist(),
        "rms_arcsec": plate.rms_arcsec.tolist(),
        "rounds": identification.iterations,
        "settled": identification.converged,
    }


def _counts(identification: FrameIdentification) -> dict[str, Any]:
    result, (i, _, p) = identification.result, identification.pairs
    return {
        "measurements": len(identification.measured),
        "stars_on_frame": int(identification.inside.sum()),
        "candidate_stars": int(identification.candidate.sum()),
        "identified": len(i),
        "unidentified": len(identification.measured) - len(i),
        "beyond_catalogue": len(identification.beyond_catalogue),
        "missing": len(identification.missing),
        "ambiguous": int(np.count_nonzero(p < AMBIGUOUS)),
        "expected_wrong": result.expected_wrong,
        "expected_missed": result.expected_missed,
        "gate_sigmas": identification.estimate.gate_sigmas,
        "typical_error_scale": identification.estimate.typical_scale,
    }


def _estimated(identification: FrameIdentification) -> dict[str, list[float]]:
    """The quantities estimated with the identification, each with its standard error.

    Densities per square arcminute of measurements without a star and of candidate stars without a measurement; the
    error scale; factors on the errors of the frame and of the catalogue or of both, and floors in arcsec.
    """
    estimate, scale = identification.estimate, orientation(identification)[0]
    per_arcmin2 = (60.0 / scale) ** 2
    quantities = {
        ("only_on_frame_per_arcmin2", per_arcmin2): estimate.quantities.get("density_only_1"),
        ("only_in_catalogue_per_arcmin2", per_arcmin2): estimate.quantities.get("density_only_2"),
        ("error_scale", 1.0): estimate.quantities.get("error_scale"),
    }
    model = estimate.error_model
    if model is not None:
        quantities |= {
            (ERROR_TERM_NAMES[name], scale if name.startswith("floor") else 1.0): q for name, q in model.terms.items()
        }
    estimates = {
        name: (unit * q.value, unit * q.standard_error) for (name, unit), q in quantities.items() if q is not None
    }
    if estimate.tail is not None:
        estimates["error_tail_share"] = estimate.tail.share.value, estimate.tail.share.standard_error
    return {name: list(values) for name, values in estimates.items() if all(map(math.isfinite, values))}


def _residuals(identification: FrameIdentification) -> dict[str, Any]:
    residual = identification.residual_arcsec
    if not len(residual):
        return {"scatter_arcsec": [None, None], "rms_arcsec": [None, None], "median_arcsec": [None, None]}
    return {
        "scatter_arcsec": identification.scatter_arcsec.tolist(),
        "rms_arcsec": np.sqrt(np.mean(residual**2, axis=0)).tolist(),
        "median_arcsec": np.median(residual, axis=0).tolist(),
    }


def _brightness(identification: FrameIdentification) -> dict[str, Any]:
    zero, curve = identification.zero_point, identification.completeness
    values: dict[str, Any] = {
        "colour": identification.stars.colour_name or None,
        "zero_point": None,
        "completeness": None,
        "odd": _odd(identification),
    }
    if zero is not None:
        values["zero_point"] = {
            "zero_point_mag": zero.zero_point,
            "sigma_mag": zero.sigma,
            "colour_term": zero.colour_term,
            "colour_term_sigma": zero.colour_sigma,
            "bend": list(zero.bend),
            "scatter_mag": zero.scatter,
            "words": zero.describe(),
        }
    if curve is not None:
        values["completeness"] = {
            "top": curve.top,
            "limit_mag": curve.limit,
            "width_mag": curve.width,
            "edges_mag": curve.edges.tolist(),
            "stars": curve.stars.tolist(),
            "found": curve.identified.tolist(),
            "sigma": curve.sigma.tolist(),
            "words": curve.describe(),
        }
    return values


def _odd(identification: FrameIdentification) -> dict[str, Any] | None:
    """The number of stars much brighter or fainter than catalogued, None if there are none."""
    odd, excess = identification.odd_brightness, identification.excess_mag
    if not len(odd):
        return None
    brighter = int(np.count_nonzero(excess[odd] < 0))
    first = str(identification.stars.ids[identification.pairs[1][odd[0]]])
    words = f"{brighter} brighter and {len(odd) - brighter} fainter than catalogued; most so {first}: "
    return {"brighter": brighter, "fainter": len(odd) - brighter, "words": words + odd_words(float(excess[odd[0]]))}


def _number(value: float) -> float | None:
    """A finite number, else None."""
    return float(value) if math.isfinite(value) else None
