"""Columns that sameas adds to tables of the sky, with their units, descriptions and UCDs, and the types of joins.

UCDs are IVOA's Unified Content Descriptors, version 1+.
"""

from __future__ import annotations

from collections.abc import Container
from typing import Any

from sameas.errors import InputError

#: Types of joins of two catalogues, with the names of STILTS; the first is the default.
JOINS = ("all1", "1and2", "all2", "1or2", "1not2", "2not1", "1xor2", "pairs")


_X, _Y, _RA, _DEC = "pos.cartesian.x", "pos.cartesian.y", "pos.eq.ra", "pos.eq.dec"
#: Unit, UCD and description of the columns of joined tables.
COLUMNS: dict[str, tuple[str | None, str | None, str]] = {
    # Of the joined table of two catalogues.
    "sep_arcsec": ("arcsec", "pos.angDistance", "separation at the common epoch"),
    "dx_arcsec": ("arcsec", f"{_RA};arith.diff", "first minus second, east"),
    "dy_arcsec": ("arcsec", f"{_DEC};arith.diff", "first minus second, north"),
    "mahalanobis": (None, "stat.fit.residual", "separation over its quoted error"),
    "log_odds": (None, "stat.likelihood", "ln odds of the pair before one-to-one"),
    "p_match": (None, "stat.probability", "probability of the pair"),
    "p_none": (None, "stat.probability", "probability that the row has no partner"),
    "p_second": (None, "stat.probability", "probability of the most probable other candidate"),
    "id_second": (None, "meta.id.cross", "the most probable other candidate"),
    "match_flag": (None, "meta.code", "1 identified, 2 at least half as probable as the best, 0 other"),
    "group_id": (None, "meta.id.assoc", "group of competing records"),
    "group_size": (None, "meta.number", "records in the group"),
    "n_within": (None, "meta.number", "candidates of the row"),
    "covered": (None, "meta.code", "whether the other catalogue covers the place"),
    "p_any": (None, "stat.probability", "NWAY: probability that the row has a partner"),
    "p_i": (None, "stat.probability", "NWAY: probability of the pair if there is a partner"),
    "dist_bayesfactor": (None, "stat.likelihood", "log10 of the odds of the pair"),
    # Of the table of pairs, and of records that are no catalogues.
    "row_1": (None, "meta.record", "row in the first source"),
    "row_2": (None, "meta.record", "row in the second source"),
    "id_1": (None, "meta.id", "id in the first source"),
    "id_2": (None, "meta.id.cross", "id in the second source"),
    "separation": (None, None, "length of the residual, in the unit of the features"),
    # Of several catalogues.
    "n_catalogues": (None, "meta.number", "number of catalogues that show the object"),
    "p_object": (None, "stat.probability", "probability that exactly these records are one object"),
    "p_runner_up": (None, "stat.probability", "probability of the most probable other answer"),
    "runner_up": (None, "meta.id.cross", "the most probable other answer for one of the records"),
    "ra_object": ("deg", f"{_RA};meta.main", "right ascension from all records, at epoch_object"),
    "dec_object": ("deg", f"{_DEC};meta.main", "declination from all records, at epoch_object"),
    "ra_object_error": ("mas", f"stat.error;{_RA};meta.main", "its standard error, times cos(dec)"),
    "dec_object_error": ("mas", f"stat.error;{_DEC};meta.main", "its standard error"),
    "ra_dec_object_corr": (None, f"stat.correlation;{_RA};{_DEC}", "correlation of both errors"),
    "pmra_object": ("mas / yr", f"pos.pm;{_RA}", "proper motion east, times cos(dec), from all records"),
    "pmdec_object": ("mas / yr", f"pos.pm;{_DEC}", "proper motion north, from all records"),
    "pmra_object_error": ("mas / yr", f"stat.error;pos.pm;{_RA}", "its standard error"),
    "pmdec_object_error": ("mas / yr", f"stat.error;pos.pm;{_DEC}", "its standard error"),
    "epoch_object": ("yr", "time.epoch", "Julian year of the position"),
    "chi_sq": (None, "stat.fit.chi2", "chi squared of the records about the object, by the quoted errors"),
    # Of an internal match: of rows, and of objects.
    "object_id": (None, "meta.id.assoc", "object of the row, counted from 1"),
    "object_rows": (None, "meta.number", "rows of the object"),
    "object_rank": (None, "meta.number", "place of the row among those of its object, from the smallest error"),
    "object_sep_arcsec": ("arcsec", "pos.angDistance", "distance from the mean place of the object"),
    "p_row": (None, "stat.probability", "probability that the row is of this object"),
    "ra": ("deg", f"{_RA};meta.main", "right ascension, mean of all rows"),
    "dec": ("deg", f"{_DEC};meta.main", "declination, mean of all rows"),
    "ra_error_arcsec": ("arcsec", f"stat.error;{_RA};meta.main", "its standard error, times cos(dec)"),
    "dec_error_arcsec": ("arcsec", f"stat.error;{_DEC};meta.main", "its standard error"),
    "epoch": ("yr", "time.epoch", "mean Julian year of the rows"),
    "epoch_first": ("yr", "time.start", "Julian year of the first row"),
    "epoch_last": ("yr", "time.end", "Julian year of the last row"),
    "magnitude_mean": ("mag", "phot.mag;stat.mean", "mean magnitude of the rows that have one"),
    "magnitude_scatter": ("mag", "stat.stdev;phot.mag", "standard deviation of the magnitudes"),
}
#: By name of the column; those of frames, which have their units and descriptions in ``sky.frame.outputs``, too.
UCDS = {
    **{name: ucd for name, (_, ucd, _) in COLUMNS.items() if ucd is not None}, "fate": "meta.code.class",
    "measurement": "meta.id;meta.main", "star": "meta.id.cross", "star_row": "meta.record", "remark": "meta.note",
    "flags": "meta.code.qual", "x_px": f"{_X};instr.det", "y_px": f"{_Y};instr.det", "x_image": f"{_X};instr.det",
    "y_image": f"{_Y};instr.det", "cov_xx_px2": f"stat.variance;{_X};instr.det",
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


def attributes_of(name: str) -> dict[str, Any]:
    """Unit, description and metadata of a column of a joined table, as of an astropy ``Column``."""
    feature = name.removeprefix("residual_")
    unit, _, words = COLUMNS[name] if feature == name else (None, None, f"first minus second, feature {feature}")
    return {"unit": unit, "description": words, "meta": meta_of(name)}


def free_name(name: str, taken: Container[str]) -> str:
    """The name of an added column, with an ending if the user's table has one of that name."""
    return name if name not in taken else f"{name}_sameas"


def check_join(join: str) -> None:
    """Refuse a type of join that does not exist."""
    if join not in JOINS:
        raise InputError(f"join {join!r} is not known; choose one of {', '.join(JOINS)}")
