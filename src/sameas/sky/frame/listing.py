"""The listing of an identified frame: one row per measurement, and one per star of the frame that was not identified.

``fate`` is one of

- ``identified``: a measurement with its star;
- ``unidentified``: a measurement that is no star of the catalogue;
- ``missing``: a star that the frame should show and no measurement is; ``remark`` says what was measured there;
- ``too faint``: a star of the catalogue that the frame shows with a probability below a half.

Measurements come first, brightest first, then stars. Pixels are given twice: ``x_px`` counts from 0, ``x_image`` as in
FITS headers, DS9 and SExtractor from 1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.sky.frame.identified import EXPECTED, FrameIdentification
from sameas.sky.frame.measurements import Flag
from sameas.sky.output_columns import meta_of

if TYPE_CHECKING:
    from astropy.table import Table

#: Two stars nearer than this, in full widths of a star, are measured as one (chosen).
MERGED_WIDTHS = 1.5
#: A saturated star hides what lies within this distance, in full widths of a star (chosen).
HIDDEN_WIDTHS = 4.0
#: Magnitudes by which a saturated star must be brighter to hide another (chosen).
BRIGHTER = 0.5


def listing(identification: FrameIdentification, *, faint: bool = True) -> Table:
    """The table of a frame; absent values are masked.

    faint : whether the stars that the frame cannot show are listed too.
    """
    from astropy.table import MaskedColumn, Table

    lost = _lost(identification, faint)
    table = Table(masked=True)
    for name, (measured, star, unit, words) in _columns(identification, lost).items():
        parts = [_masked(measured, len(identification.measured)), _masked(star, len(lost))]
        kinds = [part for part in parts if part.dtype != object]
        dtype = np.result_type(*(part.dtype for part in kinds)) if kinds else np.dtype("U1")
        values = np.ma.concatenate([_cast(part, dtype) for part in parts])  # type: ignore[no-untyped-call]
        table[name] = MaskedColumn(values, unit=unit or None, description=words, meta=meta_of(name))
    table.meta.update(frame=identification.measured.name, catalogue=identification.stars.name)
    return table


def _lost(identification: FrameIdentification, faint: bool) -> IntArray:
    """Rows of the stars on the frame that no measurement is, brightest first."""
    alone = identification.inside.copy()
    alone[identification.pairs[1]] = False
    if not faint:
        alone &= identification.p_detect >= EXPECTED
    rows = np.flatnonzero(alone)
    return rows[np.argsort(np.nan_to_num(identification.stars.magnitude[rows], nan=99.0), kind="stable")]


#: Values for the measurements, values for the stars (None: absent), unit, description.
_Column = tuple[Any, Any, str, str]


def _columns(identification: FrameIdentification, lost: IntArray) -> dict[str, _Column]:
    return {
        **_what(identification, lost),
        **_where(identification, lost),
        **_how_sure(identification, lost),
        **_how_bright(identification, lost),
    }


def _what(identification: FrameIdentification, lost: IntArray) -> dict[str, _Column]:
    m, stars = identification.measured, identification.stars
    partner = identification.result.answers_1.partner
    fate = np.where(np.ma.getmaskarray(partner), "unidentified", "identified")
    ids = _taken(stars.ids, partner)
    expected = identification.p_detect[lost] >= EXPECTED
    return {
        "fate": (fate, np.where(expected, "missing", "too faint"), "", "fate of the row"),
        "measurement": (np.arange(len(m)), None, "", "number of the measurement, brightest first"),
        "star": (ids, stars.ids[lost], "", f"identifier in {stars.name}"),
        "star_row": (_taken(stars.rows, partner), stars.rows[lost], "", f"row in {stars.name}"),
        "remark": (
            np.array(_remarks(identification), dtype=str),
            np.array(why_missing(identification, lost), dtype=str),
            "",
            "flags of a measurement, and whether its star is brighter or fainter than catalogued; what stands in the "
            "place of a missing star",
        ),
        "flags": (m.flags, None, "", "bits: " + ", ".join(f"{int(f)} {str(f.name).lower()}" for f in Flag)),
    }


def _remarks(identification: FrameIdentification) -> list[str]:
    words = [Flag.words(bits) for bits in identification.measured.flags]
    for k in identification.odd_brightness:
        row = int(identification.pairs[0][k])
        words[row] = "; ".join(filter(None, [odd_words(float(identification.excess_mag[k])), words[row]]))
    return words


def odd_words(excess_mag: float) -> str:
    """How a star differs from its catalogued magnitude.

    >>> odd_words(-2.31)
    '2.3 mag brighter than catalogued'
    """
    return f"{abs(excess_mag):.1f} mag {'brighter' if excess_mag < 0 else 'fainter'} than catalogued"


def _where(identification: FrameIdentification, lost: IntArray) -> dict[str, _Column]:
    m, stars, px = identification.measured, identification.stars, identification.predicted_px
    partner = identification.result.answers_1.partner
    ra, dec, sky = identification.plate.to_sky(m.x_px, m.y_px, m.covariance)
    star_px, star_cov = px[lost], identification.predicted_covariance[lost]
    left_px, left_sky = (
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
        "ra_deg": (ra, stars.ra_deg[lost], "deg", "ICRS, of the measurement by the plate model"),
        "dec_deg": (dec, stars.dec_deg[lost], "deg", "ICRS, of the measurement by the plate model"),
        "cov_ee_arcsec2": (sky[:, 0], stars.covariance_arcsec[lost, 0], "arcsec2", "variance east"),
        "cov_en_arcsec2": (sky[:, 1], stars.covariance_arcsec[lost, 1], "arcsec2", "covariance of east and north"),
        "cov_nn_arcsec2": (sky[:, 2], stars.covariance_arcsec[lost, 2], "arcsec2", "variance north"),
        "star_x_px": (_taken(px[:, 0], partner), star_px[:, 0], "pix", "predicted by the plate model"),
        "star_y_px": (_taken(px[:, 1], partner), star_px[:, 1], "pix", "predicted by the plate model"),
        "star_ra_deg": (_taken(stars.ra_deg, partner), stars.ra_deg[lost], "deg", predicted),
        "star_dec_deg": (_taken(stars.dec_deg, partner), stars.dec_deg[lost], "deg", predicted),
        "moved_east_arcsec": (
            _moved(identification, partner, 0),
            stars.moved_arcsec[lost, 0],
            "arcsec",
            "since its own epoch",
        ),
        "moved_north_arcsec": (
            _moved(identification, partner, 1),
            stars.moved_arcsec[lost, 1],
            "arcsec",
            "since its own epoch",
        ),
        "residual_x_px": (left_px[:, 0], None, "pix", "measured minus predicted"),
        "residual_y_px": (left_px[:, 1], None, "pix", "measured minus predicted"),
        "residual_east_arcsec": (left_sky[:, 0], None, "arcsec", "measured minus catalogue"),
        "residual_north_arcsec": (left_sky[:, 1], None, "arcsec", "measured minus catalogue"),
    }


def _how_sure(identification: FrameIdentification, lost: IntArray) -> dict[str, _Column]:
    one, two = identification.result.answers_1, identification.result.answers_2
    distance = np.full(len(identification.measured), np.nan)
    distance[identification.pairs[0]] = identification.result.matches.mahalanobis
    other = _taken(np.arange(len(identification.measured)), two.second)[lost]
    return {
        "p_match": (one.p_match, None, "", "probability that the measurement is this star"),
        "p_none": (one.p_none, two.p_none[lost], "", "probability of having no partner"),
        "p_second": (one.p_second, two.p_second[lost], "", "probability of the next best candidate"),
        "second_star": (
            _taken(identification.stars.ids, one.second),
            None,
            "",
            "the next best candidate of a measurement",
        ),
        "second_measurement": (None, other, "", "the best candidate of a missing star"),
        "candidates": (one.candidates, two.candidates[lost], "", "candidates within the gate"),
        "distance_sigma": (distance, None, "", "residual over its quoted error"),
        "p_detect": (None, identification.p_detect[lost], "", "completeness of the frame at the star's magnitude"),
    }


def _how_bright(identification: FrameIdentification, lost: IntArray) -> dict[str, _Column]:
    m, stars = identification.measured, identification.stars
    partner = identification.result.answers_1.partner
    colour = _taken(stars.colour, partner)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(m.flux > 0, 1.0857 * m.flux_err / m.flux, np.nan)
    zero_point = identification.zero_point
    magnitude = None if zero_point is None else zero_point(m.flux, colour.filled(np.nan))
    return {
        "flux": (m.flux, None, "", "flux above the sky, in the unit of the frame"),
        "flux_err": (m.flux_err, None, "", "its standard deviation"),
        "magnitude": (magnitude, None, "mag", f"from the flux, in the band of {stars.name}"),
        "magnitude_err": (error, None, "mag", "from the error of the flux alone"),
        "star_magnitude": (_taken(stars.magnitude, partner), stars.magnitude[lost], "mag", f"from {stars.name}"),
        "star_colour": (colour, stars.colour[lost], "mag", stars.colour_name or "not known"),
        "snr": (m.snr, None, "", "significance of the detection"),
        "fwhm_px": (m.fwhm_px, None, "pix", "width at half maximum"),
    }


def why_missing(identification: FrameIdentification, lost: IntArray) -> list[str]:
    """Why these stars, (k,) rows, were not identified: what was measured in the place of each, in words."""
    from scipy.spatial import cKDTree

    m, px = identification.measured, identification.predicted_px
    width = m.psf_fwhm_px
    owner = identification.result.answers_1.partner
    tree = cKDTree(np.column_stack([m.x_px, m.y_px]))
    reach = [width * MERGED_WIDTHS, width * HIDDEN_WIDTHS]
    close, wide = (tree.query_ball_point(px[lost], radius, return_sorted=True) for radius in reach)
    edge = np.minimum(px[lost], np.array(m.shape[::-1]) - 1 - px[lost]).min(axis=1)
    words = []
    for k, row in enumerate(lost):
        hidden = [
            i for i in wide[k] if m.flags[i] & Flag.SATURATED and _is_brighter(identification, int(i), int(row), owner)
        ]
        if close[k]:
            i = min(close[k], key=lambda i: float(np.hypot(m.x_px[i] - px[row, 0], m.y_px[i] - px[row, 1])))
            words.append(_in_its_place(identification, int(i), int(row), owner))
        elif edge[k] < width:
            words.append("on the edge of the frame")
        elif identification.p_detect[row] < EXPECTED:
            words.append(f"completeness at its magnitude {100 * identification.p_detect[row]:.0f} %")
        elif hidden:
            words.append(f"in the wings of measurement {hidden[0]}, which is saturated")
        else:
            words.append("nothing was measured there")
    return words


def _is_brighter(identification: FrameIdentification, i: int, row: int, owner: np.ma.MaskedArray) -> bool:
    if np.ma.getmaskarray(owner)[i]:
        return True
    return bool(identification.stars.magnitude[owner[i]] < identification.stars.magnitude[row] - BRIGHTER)


def _in_its_place(identification: FrameIdentification, i: int, row: int, owner: np.ma.MaskedArray) -> str:
    m, px = identification.measured, identification.predicted_px[row]
    off = float(np.hypot(m.x_px[i] - px[0], m.y_px[i] - px[1]))
    if np.ma.getmaskarray(owner)[i]:
        return f"measurement {i} is {off:.1f} px away, too far for their errors"
    return f"measurement {i}, {off:.1f} px away, is {identification.stars.ids[owner[i]]}; one mark for both"


def _per_measurement(identification: FrameIdentification, values: FloatArray) -> FloatArray:
    """(n, d) values of the identified pairs, per measurement; NaN where it is not identified."""
    column = np.full((len(identification.measured), values.shape[1]), np.nan)
    column[identification.pairs[0]] = values
    return column


def _moved(identification: FrameIdentification, partner: np.ma.MaskedArray, axis: int) -> np.ma.MaskedArray:
    return _taken(identification.stars.moved_arcsec[:, axis], partner)


def _taken(values: NDArray[Any], rows: np.ma.MaskedArray) -> np.ma.MaskedArray:
    """``values`` at ``rows``, masked where there is no row."""
    absent = np.ma.getmaskarray(rows)
    return np.ma.MaskedArray(values[np.where(absent, 0, np.ma.getdata(rows))], absent.copy())


def _masked(values: Any, n: int) -> np.ma.MaskedArray:
    """A part of a column: all of it absent where there are no values, and where they are not finite."""
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
