"""The summary of an identified frame as plain numbers and texts, ready for JSON."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sameas.result.identification import AMBIGUOUS
from sameas.sky.frame.identified import FrameIdentification
from sameas.sky.frame.image import Frame
from sameas.sky.frame.listing import odd_words
from sameas.sky.frame.place import odds_in_words
from sameas.sky.frame.tangent import directions_deg

#: The names of the terms of the error model in a summary.
ERROR_NAMES = {
    "factor_1": "error_factor_frame",
    "factor_2": "error_factor_catalogue",
    "both": "error_factor_both",
    "floor": "error_floor_arcsec",
    "floor_instead": "error_floor_instead_arcsec",
}


def summary(identification: FrameIdentification, frame: Frame | None = None) -> dict[str, Any]:
    """Numbers, texts, lists and nulls, ready for JSON; angles in degrees, units in the names.

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
    """Arcsec per pixel, direction of the y axis from north through east in degrees, and the parity, in the middle."""
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
        "left_out": {str(order): float(value) for order, value in plate.left_out.items()},
        "effective_pairs": plate.effective_pairs,
        "error_scale": plate.error_scale,
        "tangent_ra_deg": float(ra),
        "tangent_dec_deg": float(dec),
        "middle_px": plate.polynomial.middle_px.tolist(),
        "unit_px": plate.polynomial.unit_px,
        "coefficients_arcsec": plate.polynomial.coefficients.tolist(),
        "coefficients_sigma_arcsec": spread.tolist(),
        "rms_arcsec": plate.rms_arcsec.tolist(),
        "rounds": identification.iterations,
        "settled": identification.settled,
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
    """The quantities that were estimated with the identification, each with its standard error.

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
            (ERROR_NAMES[name], scale if name.startswith("floor") else 1.0): q for name, q in model.terms.items()
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
    """The stars that are much brighter or fainter than catalogued, None where there are none."""
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
