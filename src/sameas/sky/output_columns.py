"""Columns that sameas adds to tables of the sky, with their units, descriptions and UCDs, and the types of joins.

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


#: Unit and description of the columns of the joined table of two catalogues.
PAIR_COLUMNS = {
    "sep_arcsec": ("arcsec", "separation at the common epoch"),
    "dx_arcsec": ("arcsec", "first minus second, east"),
    "dy_arcsec": ("arcsec", "first minus second, north"),
    "mahalanobis": (None, "separation over its quoted error"),
    "log_odds": (None, "ln odds of the pair before one-to-one"),
    "p_match": (None, "probability of the pair"),
    "p_none": (None, "probability that the row has no partner"),
    "p_second": (None, "probability of the most probable other candidate"),
    "id_second": (None, "the most probable other candidate"),
    "match_flag": (None, "1 identified, 2 at least half as probable as the best, 0 other"),
    "group_id": (None, "group of competing records"),
    "group_size": (None, "records in the group"),
    "n_within": (None, "candidates of the row"),
    "covered": (None, "whether the other catalogue covers the place"),
    "p_any": (None, "NWAY: probability that the row has a partner"),
    "p_i": (None, "NWAY: probability of the pair if there is a partner"),
    "dist_bayesfactor": (None, "log10 of the odds of the pair"),
}
#: The same of the table of pairs, of records that are no catalogues, and of several catalogues.
OTHER_COLUMNS = {
    **{f"{what}_{side}": (None, f"{what} in the {one} source")
       for what in ("row", "id") for side, one in ((1, "first"), (2, "second"))},
    "separation": (None, "length of the residual, in the unit of the features"),
    "n_catalogues": (None, "number of catalogues that show the object"),
    "p_object": (None, "probability that exactly these records are one object"),
    "p_runner_up": (None, "probability of the most probable other answer"),
    "runner_up": (None, "the most probable other answer for one of the records"),
    "ra_object": ("deg", "right ascension from all records, at epoch_object"),
    "dec_object": ("deg", "declination from all records, at epoch_object"),
    "ra_object_error": ("mas", "its standard error, times cos(dec)"),
    "dec_object_error": ("mas", "its standard error"),
    "ra_dec_object_corr": (None, "correlation of both errors"),
    "pmra_object": ("mas / yr", "proper motion east, times cos(dec), from all records"),
    "pmdec_object": ("mas / yr", "proper motion north, from all records"),
    "pmra_object_error": ("mas / yr", "its standard error"),
    "pmdec_object_error": ("mas / yr", "its standard error"),
    "epoch_object": ("yr", "Julian year of the position"),
    "chi_sq": (None, "chi squared of the records about the object, by the quoted errors"),
}  # fmt: skip


def attributes_of(name: str) -> dict[str, Any]:
    """Unit, description and metadata of a column of a joined table, as of an astropy ``Column``."""
    feature = name.removeprefix("residual_")
    known = PAIR_COLUMNS | OTHER_COLUMNS
    unit, words = known[name] if feature == name else (None, f"first minus second, feature {feature}")
    return {"unit": unit, "description": words, "meta": meta_of(name)}
