"""Columns that sameas adds to tables of the sky, with their UCDs, and the types of joins.

UCDs are IVOA's Unified Content Descriptors, version 1+.
"""

from __future__ import annotations

from typing import Any

#: Types of joins of two catalogues, with the names of STILTS; the first is the default.
JOINS = ("all1", "1and2", "all2", "1or2", "1not2", "2not1", "1xor2", "pairs")


_X, _Y, _RA, _DEC = "pos.cartesian.x", "pos.cartesian.y", "pos.eq.ra", "pos.eq.dec"
UCDS = {
    # Two catalogues.
    "sep_arcsec": "pos.angDistance", "dx_arcsec": f"{_RA};arith.diff", "dy_arcsec": f"{_DEC};arith.diff",
    "mahalanobis": "stat.fit.residual", "log_odds": "stat.likelihood", "p_match": "stat.probability",
    "p_none": "stat.probability", "p_second": "stat.probability", "id_second": "meta.id.cross",
    "match_flag": "meta.code", "group_id": "meta.id.assoc", "group_size": "meta.number", "n_within": "meta.number",
    "covered": "meta.code", "p_any": "stat.probability", "p_i": "stat.probability",
    "dist_bayesfactor": "stat.likelihood", "id_1": "meta.id", "id_2": "meta.id.cross", "row_1": "meta.record",
    "row_2": "meta.record",
    # Three or more catalogues.
    "n_catalogues": "meta.number", "p_object": "stat.probability", "p_runner_up": "stat.probability",
    "runner_up": "meta.id.cross", "ra_object": f"{_RA};meta.main", "dec_object": f"{_DEC};meta.main",
    "ra_object_error": f"stat.error;{_RA};meta.main", "dec_object_error": f"stat.error;{_DEC};meta.main",
    "ra_dec_object_corr": f"stat.correlation;{_RA};{_DEC}", "pmra_object": f"pos.pm;{_RA}",
    "pmdec_object": f"pos.pm;{_DEC}", "pmra_object_error": f"stat.error;pos.pm;{_RA}",
    "pmdec_object_error": f"stat.error;pos.pm;{_DEC}", "epoch_object": "time.epoch", "chi_sq": "stat.fit.chi2",
    # A frame.
    "fate": "meta.code.class", "measurement": "meta.id;meta.main", "star": "meta.id.cross", "star_row": "meta.record",
    "remark": "meta.note", "flags": "meta.code.qual", "x_px": f"{_X};instr.det", "y_px": f"{_Y};instr.det",
    "x_image": f"{_X};instr.det", "y_image": f"{_Y};instr.det", "cov_xx_px2": f"stat.variance;{_X};instr.det",
    "cov_xy_px2": f"stat.covariance;{_X};{_Y}", "cov_yy_px2": f"stat.variance;{_Y};instr.det",
    "ra_deg": f"{_RA};meta.main", "dec_deg": f"{_DEC};meta.main", "cov_ee_arcsec2": f"stat.variance;{_RA};meta.main",
    "cov_en_arcsec2": f"stat.covariance;{_RA};{_DEC}", "cov_nn_arcsec2": f"stat.variance;{_DEC};meta.main",
    "star_x_px": f"{_X};instr.det", "star_y_px": f"{_Y};instr.det", "star_ra_deg": _RA, "star_dec_deg": _DEC,
    "moved_east_arcsec": f"{_RA};arith.diff", "moved_north_arcsec": f"{_DEC};arith.diff",
    "residual_x_px": f"stat.fit.residual;{_X}", "residual_y_px": f"stat.fit.residual;{_Y}",
    "residual_east_arcsec": f"stat.fit.residual;{_RA}", "residual_north_arcsec": f"stat.fit.residual;{_DEC}",
    "second_star": "meta.id.cross", "second_measurement": "meta.id.cross", "candidates": "meta.number",
    "distance_sigma": "stat.fit.residual", "p_detect": "stat.probability", "flux": "phot.flux",
    "flux_err": "stat.error;phot.flux", "magnitude": "phot.mag", "magnitude_err": "stat.error;phot.mag",
    "star_magnitude": "phot.mag", "star_colour": "phot.color", "snr": "stat.snr", "fwhm_px": "phys.angSize;instr.det",
}  # fmt: skip


def meta_of(name: str) -> dict[str, Any]:
    """The metadata of a column by its name: its UCD, if it has one.

    >>> meta_of("p_match"), meta_of("x_m")
    ({'ucd': 'stat.probability'}, {})
    """
    return {"ucd": UCDS[name]} if name in UCDS else {}
