"""Surveys in X-rays, γ-rays and radio: their column names, for :mod:`sameas.sky.surveys`. Data only."""

from __future__ import annotations

from sameas.sky.conventions import RADIAL_CONTAINMENT, Convention, ErrorNames

_XMM = tuple(
    Convention(
        title="XMM-Newton",
        position=position,
        marks=("SC_POSERR", "SYSERRCC", "SC_DET_ML", "EP_8_FLUX"),
        ids=ids,
        # 4XMM user guide, POSERR: "Total radial position uncertainty", within it 63 %.
        errors=tuple(ErrorNames("circle", (error,), "arcsec", containment=RADIAL_CONTAINMENT) for error in errors),
        epochs=epochs,
        over=over,
    )
    for position, errors, ids, epochs, over in (
        (("RA", "DEC"), ("POSERR", "SC_POSERR"), ("DETID",), ("MJD_START",), ("SC_RA",)),
        (("SC_RA", "SC_DEC"), ("SC_POSERR",), ("SRCID",), (), ()),
    )
)

_XMM_STACKED = Convention(
    title="XMM-Newton, stacked",
    position=("RA", "DEC"),
    marks=("N_CONTRIB", "STACK_FLAG"),
    ids=("SRCID", "IAUNAME"),
    errors=(ErrorNames("circle", ("RADEC_ERR",), "arcsec", containment=RADIAL_CONTAINMENT),),
)

_XMM_HEASARC = Convention(
    title="XMM-Newton at HEASARC",
    position=("ra", "dec"),
    marks=("ep_8_flux",),
    ids=("name",),
    # The statistical and the systematic error together, as POSERR.
    errors=(ErrorNames("circle", ("error_radius",), "arcsec", containment=RADIAL_CONTAINMENT),),
)

_X_RAYS_AT_VIZIER = tuple(
    Convention(
        title=title,
        position=position,
        marks=marks,
        ids=marks,
        errors=errors,
        epochs=("MJD",),
    )
    for title, marks, position, errors in (
        (
            "XMM-Newton at VizieR", ("4XMM", "_4XMM", "3XMM", "_3XMM", "2XMM", "_2XMM"), ("RA_ICRS", "DE_ICRS"),
            (ErrorNames("circle", ("ePos",), "arcsec", containment=RADIAL_CONTAINMENT),),
        ),
        (
            "eROSITA at VizieR", ("1eRASS", "_1eRASS", "DetUID"), ("RA_ICRS", "DE_ICRS"),
            (ErrorNames("circle", ("ePos",), "arcsec"),),
        ),
        (
            # Evans et al. 2020, ApJS 247, 54: the radius of 90 % confidence.
            "Swift XRT at VizieR (IX/58)", ("2SXPS", "_2SXPS"), ("RA_ICRS", "DE_ICRS"),
            tuple(ErrorNames("circle", (name,), "arcsec", containment=0.9) for name in ("Err90", "ePos", "e_Pos")),
        ),
        (
            "Chandra Source Catalog at VizieR (IX/57)", ("2CXO", "_2CXO"), ("RAICRS", "DEICRS"),
            (ErrorNames("ellipse", ("r0", "r1", "PA"), "arcsec", containment=0.95),),
        ),
    )
)  # fmt: skip

_EROSITA = Convention(
    title="eROSITA",
    position=("RA", "DEC"),
    marks=("RADEC_ERR", "DETUID", "ML_FLUX_1", "ID_SRC"),
    without=(
        "POSERR",
        "SC_POSERR",
        "SYSERRCC",
        "N_CONTRIB",
        "STACK_FLAG",
    ),  # 4XMM has a RADEC_ERR without the systematic error
    ids=("DETUID", "IAUNAME"),
    # Merloni et al. 2024, A&A 682, A34, table D.1 and section 6.2: POS_ERR is the σ of a Rayleigh distribution.
    errors=(
        ErrorNames("circle", ("POS_ERR",), "arcsec"),
        ErrorNames("circle", ("RADEC_ERR",), "arcsec", containment=RADIAL_CONTAINMENT),
    ),
    epochs=("MJD",),
)

_ROSAT = Convention(
    title="ROSAT all-sky survey (IX/10, IX/29)",
    position=("RAJ2000", "DEJ2000"),
    marks=("1RXS", "_1RXS"),
    ids=("1RXS", "_1RXS"),
    # Voges et al. 1999, A&A 349, 389: the radius of 1σ, including 6″ of systematic errors.
    errors=(ErrorNames("circle", ("PosErr",), "arcsec", containment=0.683),),
)

_CHANDRA = Convention(
    title="Chandra Source Catalog",
    position=("ra", "dec"),
    marks=("err_ellipse_r0", "error_ellipse_major_axis"),
    ids=("name",),
    # CSC 2, Source Position and Position Errors: the 95 % confidence level error ellipse, arcsec; also at HEASARC.
    errors=tuple(
        ErrorNames("ellipse", names, "arcsec", containment=0.95)
        for names in (
            ("err_ellipse_r0", "err_ellipse_r1", "err_ellipse_ang"),
            ("error_ellipse_major_axis", "error_ellipse_minor_axis", "error_ellipse_angle"),
        )
    ),
)


def _ellipses_of_95_and_68(*names: str) -> tuple[ErrorNames, ...]:
    """The 95 % and the 68 % ellipses of a table: names of the axes and the position angle, {} for the percentage."""
    return tuple(
        ErrorNames("ellipse", tuple(name.format(percent) for name in names), "deg", containment=percent / 100.0)
        for percent in (95, 68)
    )


_FERMI = (
    Convention(
        title="Fermi LAT",
        position=("RAJ2000", "DEJ2000"),
        marks=("Conf_95_SemiMajor", "Conf_68_SemiMajor"),
        ids=("Source_Name",),
        errors=_ellipses_of_95_and_68("Conf_{}_SemiMajor", "Conf_{}_SemiMinor", "Conf_{}_PosAng"),
    ),
    Convention(
        title="Fermi LAT at HEASARC",
        position=("ra", "dec"),
        marks=("semi_major_axis_95", "semi_major_axis_68"),
        ids=("name", "source_name"),
        errors=_ellipses_of_95_and_68("semi_major_axis_{}", "semi_minor_axis_{}", "position_angle_{}"),
    ),
)

# Components of Selavy, the source finder of ASKAP (EMU, RACS): ra_err and dec_err are along the sky, arcsec.
_ASKAP = Convention(
    title="ASKAP",
    position=("ra_deg_cont", "dec_deg_cont"),
    ids=("component_name", "component_id"),
    errors=(ErrorNames("axes", ("ra_err", "dec_err"), "arcsec"),),
)

HIGH_ENERGY: tuple[Convention, ...] = (
    *_XMM,
    _XMM_STACKED,
    _XMM_HEASARC,
    _EROSITA,
    _ROSAT,
    _CHANDRA,
    *_FERMI,
    *_X_RAYS_AT_VIZIER,
)

RADIO: tuple[Convention, ...] = (
    Convention(
        title="LoTSS",
        position=("RA", "DEC"),
        marks=("Mosaic_ID",),
        ids=("Source_Name",),
        # Shimwell et al. 2019, A&A 622, A1: with the error of the astrometry, and of the fit alone, arcsec.
        errors=tuple(ErrorNames("axes", names, "arcsec") for names in (("E_RA_tot", "E_DEC_tot"), ("E_RA", "E_DEC"))),
    ),
    Convention(
        title="VLASS",
        position=("RA", "DEC"),
        marks=("QL_cutout", "QL_image_RA", "NVSS_distance"),
        ids=("Component_name",),
        errors=(ErrorNames("axes", ("E_RA", "E_DEC"), "deg"),),
    ),
    Convention(
        title="NVSS at VizieR (VIII/65)",
        position=("RAJ2000", "DEJ2000"),
        marks=("resFlux", "f_resFlux"),
        ids=("NVSS",),
        # ReadMe of VIII/65: the error of right ascension is in seconds of time.
        errors=(ErrorNames("axes", ("e_RAJ2000", "e_DEJ2000"), "arcsec", unit_of_ra="s"),),
    ),
    _ASKAP,
)
