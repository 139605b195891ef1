"""Surveys: the column names of known catalogues. Data only; :mod:`sameas.sky.columns` uses them.

A new survey is a new :class:`Convention` in :data:`CONVENTIONS`. Units given here apply if the table has none.
"""

from __future__ import annotations

from sameas.sky.conventions import (
    GAIA_MOTION,
    PLAIN_EPOCHS,
    PLAIN_IDS,
    PLAIN_MAGNITUDES,
    PLAIN_MOTIONS,
    SEXTRACTOR_MAGNITUDES,
    TWOMASS_MAGNITUDES,
    VIZIER_MOTION,
    Convention,
    ErrorNames,
    MotionNames,
    correlations_of,
    of_b1950,
    own_axes,
    plain,
)
from sameas.sky.surveys_xray_radio import HIGH_ENERGY, RADIO

_LSST_MOTION = MotionNames(
    ("parallax", "pmRa", "pmDec", "radialVelocity"), ("parallaxErr", "pmRaErr", "pmDecErr", "radialVelocityErr")
)
# Reference catalogues, in radians: pm_ra is "dra/dt * cos(dec)" (meas_algorithms, LoadReferenceObjectsTask).
_LSST_REFERENCE_MOTION = MotionNames(
    ("parallax", "pm_ra", "pm_dec", ""), ("parallaxErr", "pm_raErr", "pm_decErr", ""), unit="rad"
)
_GAIA_CORRELATIONS = correlations_of("{a}_{b}_corr", ("ra", "dec", "parallax", "pmra", "pmdec"))
_VIZIER_CORRELATIONS = correlations_of("{a}{b}cor", ("RA", "DE", "Plx", "pmRA", "pmDE"))
_KIC_MOTION = ("kic_parallax", "kic_pmra", "kic_pmdec", "")
_HIPPARCOS_NAMES = ("RA", "DE", "Plx", "pmRA", "pmDE")
_HIPPARCOS_CORRELATIONS = correlations_of("{b}:{a}", _HIPPARCOS_NAMES) + correlations_of("{b}_{a}", _HIPPARCOS_NAMES)
_GAIA_RELEASES = (
    (r"gaia[ _-]?dr1|\bI[/_]337\b", 2015.0),
    (r"gaia[ _-]?dr2|\bI[/_]345\b|I_345_", 2015.5),
    (r"gaia[ _-]?e?dr3|\bI[/_]35[05]\b|I_35[05]_", 2016.0),
)
_GAIA_RELEASE_COLUMNS = (
    ("DR2Name", 2015.5),
    ("EDR3Name", 2016.0),
    ("DR3Name", 2016.0),
    ("GaiaDR2", 2015.5),
    ("GaiaEDR3", 2016.0),
    ("GaiaDR3", 2016.0),
    ("dr2_radial_velocity", 2016.0),  # EDR3 repeats the velocities of DR2 under this name
    ("nu_eff_used_in_astrometry", 2016.0),
)


def _sextractor(flavour: str) -> tuple[Convention, ...]:
    return tuple(
        Convention(
            title=f"SExtractor{' ' + flavour if flavour else ''}",
            position=(f"X{flavour}_{frame}", f"Y{flavour}_{frame}")
            if frame == "WORLD"
            else (f"ALPHA{flavour}_{frame}", f"DELTA{flavour}_{frame}"),
            ids=("NUMBER",),
            # SExtractor manual, "Positions and shapes": _WORLD in degrees; _J2000, _SKY east of north.
            errors=(*_ellipses(flavour, frame),),
            magnitudes=SEXTRACTOR_MAGNITUDES,
            over={"J2000": (f"ALPHA{flavour}_SKY", f"X{flavour}_WORLD"), "SKY": (f"X{flavour}_WORLD",), "WORLD": ()}[
                frame
            ],
        )
        for frame in ("J2000", "SKY", "WORLD")
    )


def _ellipses(flavour: str, frame: str) -> tuple[ErrorNames, ...]:
    """The error ellipse: its angle counted from north, or by SExtractor's world axes from east; or its major axis."""
    a, b = f"ERRA{flavour}_WORLD", f"ERRB{flavour}_WORLD"
    from_north = ErrorNames("ellipse", (a, b, f"ERRTHETA{flavour}_{frame}"), "deg")
    from_east = ErrorNames("ellipse", (a, b, f"ERRTHETA{flavour}_WORLD"), "deg", angle_from="east")
    major = ErrorNames("circle", (a,), "deg")
    return (from_east, major) if frame == "WORLD" else (from_north, from_east, major)


_GAIA = Convention(
    title="Gaia archive",
    position=("ra", "dec"),
    marks=("source_id", "phot_g_mean_mag", "astrometric_params_solved", "ruwe"),
    ids=("source_id", "designation"),
    errors=(ErrorNames("axes", ("ra_error", "dec_error"), "mas"),),
    motions=(GAIA_MOTION,),
    correlations=_GAIA_CORRELATIONS,
    epochs=("ref_epoch",),
    releases=_GAIA_RELEASES,
    release_columns=_GAIA_RELEASE_COLUMNS,
    magnitudes=(("phot_g_mean_mag", "phot_g_mean_mag_error"),),
)

_GAIA_VIZIER = Convention(
    title="Gaia at VizieR",
    position=("RA_ICRS", "DE_ICRS"),
    marks=("Source", "DR3Name", "EDR3Name", "DR2Name", "GaiaDR3", "GaiaEDR3", "GaiaDR2", "RPlx", "RUWE", "FG", "BPmag"),
    # Of ATLAS Refcat2, which has Gaia's magnitudes; "e_Gmag" is no mark, as names ignore case: SDSS has e_gmag.
    without=("rp1", "r10"),
    ids=("Source", "DR3Name", "EDR3Name", "DR2Name", "GaiaDR3", "GaiaEDR3", "GaiaDR2"),
    errors=(ErrorNames("axes", ("e_RA_ICRS", "e_DE_ICRS"), "mas"),),
    motions=(VIZIER_MOTION,),
    correlations=_VIZIER_CORRELATIONS,
    epochs=("Epoch", "ref_epoch"),
    releases=_GAIA_RELEASES,
    release_columns=_GAIA_RELEASE_COLUMNS,
    magnitudes=(("Gmag", "e_Gmag"),),
    over=("RAJ2000",),  # I/345, I/350, I/355: moved to 2000.0 by CDS
)

_HIP2 = Convention(
    title="Hipparcos, the new reduction (I/311)",
    position=("RArad", "DErad"),
    unit="rad",
    ids=("HIP",),
    errors=(ErrorNames("axes", ("e_RArad", "e_DErad"), "mas"),),
    motions=(VIZIER_MOTION,),
    epoch_jyr=1991.25,
    magnitudes=(("Hpmag", "e_Hpmag"),),
    over=("RAJ2000", "RAhms"),
    weights="UW",
)

_HIPPARCOS = tuple(
    Convention(
        title="Hipparcos (I/239)",
        position=position,
        marks=("HIP",),
        without=("TIC", "Tmag", "Source", "DR3Name", "EDR3Name", "DR2Name"),
        ids=("HIP",),
        errors=(ErrorNames("axes", ("e_" + position[0], "e_" + position[1]), "mas"),),
        motions=(VIZIER_MOTION,),
        correlations=_HIPPARCOS_CORRELATIONS,
        epoch_jyr=1991.25,
        magnitudes=(("Hpmag", "e_Hpmag"), ("Vmag", "")),
        over=("RAhms",),
    )
    for position in (("RAICRS", "DEICRS"), ("RAdeg", "DEdeg"))
)

_TWOMASS = (
    *(
        Convention(
            title="2MASS",
            position=("ra", declination),
            marks=("err_ang", "pts_key", "j_msigcom"),
            ids=("designation", "pts_key"),
            errors=(ErrorNames("ellipse", ("err_maj", "err_min", "err_ang"), "arcsec"),),
            epochs=("jdate", "date"),
            magnitudes=TWOMASS_MAGNITUDES,
        )
        for declination in ("dec", "decl")  # "decl" in the documentation of the All-Sky release, section 2.2a
    ),
    Convention(
        title="2MASS at VizieR (II/246)",
        position=("RAJ2000", "DEJ2000"),
        marks=("_2MASS", "2MASS", "errMaj"),
        ids=("_2MASS", "2MASS"),
        errors=(
            ErrorNames("ellipse", ("errMaj", "errMin", "errPA"), "arcsec"),
            ErrorNames("ellipse", ("errHalfMaj", "errHalfMin", "errPosAng"), "arcsec"),  # at the X-match service of CDS
        ),
        epochs=("Date", "_date", "JD"),
        magnitudes=TWOMASS_MAGNITUDES,
    ),
)

_LSST = tuple(
    Convention(
        title="LSST",
        position=position,
        marks=marks,
        ids=("diaSourceId", "sourceId", "diaObjectId", "objectId"),
        # raErr is along the sky, times cos δ (LSST reference catalogue schema).
        errors=(
            ErrorNames("axes", ("raErr", "decErr"), "deg", ("ra_dec_Cov",)),
            ErrorNames("axes", ("coord_raErr", "coord_decErr"), "deg", ("coord_ra_dec_Cov", "coord_ra_coord_dec_Cov")),
        ),
        motions=motions,
        # Objects have an epoch in each band, as MJD (pipe_tasks, ComputeObjectEpochsTask).
        epochs=("midpointMjdTai", "midPointTai", "radecMjdTai", "expMidptMJD", *(f"{band}_epoch" for band in "rizgyu")),
        one_campaign=True,
        magnitudes=(("mag", "magErr"), ("psfMag", "psfMagErr"), ("rPSMag", "rPSMagErr")),
        over=over,
    )
    for position, marks, over, motions in (
        (
            ("ra", "dec"), ("ra_dec_Cov", "diaObjectId", "diaSourceId", "midpointMjdTai", "radecMjdTai"),
            ("coord_ra",), (_LSST_MOTION,),
        ),
        (("coord_ra", "coord_dec"), (), (), (_LSST_MOTION, _LSST_REFERENCE_MOTION)),
    )
)  # fmt: skip

# Our own tables of frames: positions by the plate model, of stars that were not found those of the catalogue.
_SAMEAS_FRAME = Convention(
    title="frame of sameas",
    position=("ra_deg", "dec_deg"),
    marks=("cov_ee_arcsec2",),
    measured="measurement",
    errors=(ErrorNames("variances", ("cov_ee_arcsec2", "cov_nn_arcsec2"), "arcsec2", ("cov_en_arcsec2",)),),
    magnitudes=(("magnitude", "magnitude_err"),),
)

#: Columns of spectra: their dates are not those of the positions.
_FIBRES = ("fiberID", "plate", "lmjd")

_SDSS = tuple(
    Convention(
        title=title,
        position=("ra", "dec"),
        without=("ra_ivar", "brickid", "dplx", "nuv_mag", "fuv_mag", "unwise_detid", *_FIBRES),
        marks=marks,
        ids=("objID",),
        # SDSS schema, PhotoObjAll: raErr "error in RA (* cos(Dec), that is, proper units)", arcsec.
        errors=(ErrorNames("axes", ("raErr", "decErr"), "arcsec"),),
        epochs=("mjd", "mjd_r"),
        magnitudes=(("psfMag_r", "psfMagErr_r"), ("modelMag_r", "modelMagErr_r"), ("r", "err_r")),
    )
    for title, marks in (
        ("SDSS", ("psfMag_r", "modelMag_r", "petroMag_r", "cModelMag_r", "camcol", "rerun", "specObjID")),
        ("SDSS, by its objID", ("objID",)),  # others have such a column: the survey's errors are not assumed
    )
)

_SPECTRA = (
    *(
        Convention(
            title="SDSS, spectra",
            position=position,
            marks=("fiberID", "plate"),
            without=("lmjd",),
            ids=("specObjID", "objID"),
            errors=(ErrorNames("axes", ("raErr", "decErr"), "arcsec"),),
            only_epoch=True,
            magnitudes=(("psfMag_r", "psfMagErr_r"), ("modelMag_r", "modelMagErr_r")),
        )
        for position in (("ra", "dec"), ("PLUG_RA", "PLUG_DEC"))
    ),
    Convention(
        title="LAMOST",
        position=("ra", "dec"),
        marks=("lmjd",),
        ids=("obsid",),
        only_epoch=True,
        magnitudes=(("gaia_g_mean_mag", ""),),
    ),
    Convention(
        # Data model of DESI: TARGET_RA at REF_EPOCH, with PMRA from there; zeros where there is none.
        title="DESI",
        position=("TARGET_RA", "TARGET_DEC"),
        ids=("TARGETID",),
        motions=(GAIA_MOTION,),
        epochs=("REF_EPOCH",),
    ),
)

_TRACTOR = Convention(
    title="Legacy Surveys, tractor",
    position=("ra", "dec"),
    marks=("ra_ivar",),
    ids=("TARGETID", "ls_id"),
    # Files of DR10: "inverse variance of ra (no cosine term!), excluding astrometric calibration errors", 1/deg².
    errors=(ErrorNames("inverse variances", ("ra_ivar", "dec_ivar"), "1/deg2"),),
    # ref_epoch is that of Gaia's stars among them, 0 elsewhere.
    only_epoch=True,
)

_UCAC4 = Convention(
    title="UCAC4 (I/322)",
    position=("RAJ2000", "DEJ2000"),
    marks=("UCAC4",),
    ids=("UCAC4",),
    # The errors refer to the central epochs EpRA, EpDE, the position to 2000.0.
    errors=(ErrorNames("axes", ("e_RAJ2000", "e_DEJ2000"), "mas"), ErrorNames("circle", ("ePos",), "mas")),
    motions=(VIZIER_MOTION,),
    epoch_jyr=2000.0,
    magnitudes=(("f.mag", "e_f.mag"), ("fmag", "e_fmag"), ("f_mag", ""), ("amag", "")),
)

_USNO_B1 = tuple(
    Convention(
        title="USNO-B1.0 (I/284)",
        position=position,
        marks=("USNO-B1.0", "USNO_B1.0", "USNO_B1_0", "USNOB1.0"),
        ids=("USNO-B1.0", "USNO_B1.0", "USNO_B1_0", "USNOB1.0"),
        # ReadMe of I/284: positions "at Eq=J2000, Ep=J2000"; the column Epoch is that of the observations.
        errors=(ErrorNames("axes", ("e_" + position[0], "e_" + position[1]), "mas"),),
        motions=(VIZIER_MOTION,),
        epoch_jyr=2000.0,
        only_epoch=True,
        magnitudes=(("R2mag", ""), ("R1mag", ""), ("B2mag", ""), ("B1mag", "")),
    )
    for position in (("RAJ2000", "DEJ2000"), ("RAdeg", "DEdeg"))
)

_DES = tuple(
    Convention(
        title="Dark Energy Survey",
        position=position,
        marks=("COADD_OBJECT_ID",),
        ids=("COADD_OBJECT_ID",),
        errors=(
            ErrorNames("ellipse", ("ERRAWIN_WORLD_R", "ERRBWIN_WORLD_R", "ERRTHETAWIN_J2000_R"), "deg"),
            ErrorNames("circle", ("ERRAWIN_WORLD_R",), "deg"),
        ),
        magnitudes=(
            ("WAVG_MAG_PSF_R", "WAVG_MAGERR_PSF_R"),
            ("MAG_AUTO_R", "MAGERR_AUTO_R"),
            ("PSF_MAG_APER_8_R", "PSF_MAG_ERR_APER_8_R"),
            ("BDF_MAG_R", "BDF_MAG_ERR_R"),
        ),
        over=over,
    )
    for position, over in (
        (("RA", "DEC"), ("ALPHAWIN_J2000", "ALPHA_J2000")),
        (("ALPHAWIN_J2000", "DELTAWIN_J2000"), ("ALPHA_J2000",)),
    )
)

_CATWISE = Convention(
    title="CatWISE2020",
    position=("ra", "dec"),
    marks=("meanobsmjd",),
    ids=("source_name", "source_id"),
    # The solution without motion, at the mean epoch; motions of single faint sources are noise of 0.1″/yr.
    errors=(ErrorNames("axes", ("sigra", "sigdec"), "arcsec", co_sigma="sigradec"),),
    epochs=("meanobsmjd",),
    magnitudes=(("w1mpro", "w1sigmpro"),),
    over=("ra_pm",),
)

_CATWISE_VIZIER = Convention(
    title="CatWISE2020 at VizieR (II/365)",
    position=("RA_ICRS", "DE_ICRS"),
    marks=("W1mproPM", "RAPMdeg", "ePosPM"),
    ids=("Name", "objID"),
    errors=(ErrorNames("axes", ("e_RA_ICRS", "e_DE_ICRS"), "arcsec"),),
    epochs=("MJD",),
    magnitudes=(("W1mproPM", "e_W1mproPM"),),
)

# SkyMapper, table master: "RMS variation around the mean Right Ascension, in milliarcseconds"; mean_epoch is an MJD.
_SKYMAPPER = Convention(
    title="SkyMapper",
    position=("raj2000", "dej2000"),
    marks=("smss_j", "rms_epoch", "nimaflags"),
    ids=("object_id",),
    errors=(ErrorNames("axes", ("e_raj2000", "e_dej2000"), "mas"),),
    epochs=("mean_epoch",),
    magnitudes=(("r_psf", "e_r_psf"), ("i_psf", "e_i_psf"), ("g_psf", "e_g_psf")),
)

_NSC = Convention(
    title="NOIRLab Source Catalog",
    position=("ra", "dec"),
    marks=("deltamjd",),
    ids=("id",),
    # Nidever et al. 2021, AJ 161, 192: errors in arcsec, motions in mas/yr, at the mean date mjd.
    errors=(ErrorNames("axes", ("raerr", "decerr"), "arcsec"),),
    motions=(MotionNames(("", "pmra", "pmdec", ""), ("", "pmraerr", "pmdecerr", "")),),
    epochs=("mjd",),
    magnitudes=(("rmag", "rerr"), ("gmag", "gerr"), ("imag", "ierr")),
)

_PANSTARRS_VIZIER = Convention(
    title="Pan-STARRS1 at VizieR (II/349)",
    position=("RAJ2000", "DEJ2000"),
    marks=("f_objID",),
    ids=("objID",),
    errors=(ErrorNames("axes", ("e_RAJ2000", "e_DEJ2000"), "arcsec"),),
    epochs=("Epoch",),
    magnitudes=(("rmag", "e_rmag"), ("imag", "e_imag")),
)

_PANSTARRS = Convention(
    title="Pan-STARRS1",
    position=("raMean", "decMean"),
    # Lasair has ramean of ZTF, and names ignore case.
    marks=("objID", "objName", "raMeanErr", "epochMean", "nDetections", "gMeanPSFMag", "rMeanPSFMag", "iMeanPSFMag"),
    ids=("objID", "objName"),
    # Chambers et al. 2016, table ObjectThin: standard deviations, arcsec; epochMean is an MJD.
    errors=(ErrorNames("axes", ("raMeanErr", "decMeanErr"), "arcsec"),),
    epochs=("epochMean",),
    magnitudes=(("rMeanPSFMag", "rMeanPSFMagErr"), ("iMeanPSFMag", "iMeanPSFMagErr")),
    over=("raStack",),
)
_PANSTARRS_STACK = Convention(
    title="Pan-STARRS1, stacks",
    position=("raStack", "decStack"),
    ids=("objID", "objName"),
    errors=(ErrorNames("axes", ("raStackErr", "decStackErr"), "arcsec"),),
    magnitudes=(("rPSFMag", "rPSFMagErr"), ("iPSFMag", "iPSFMagErr")),
)

_ALLWISE = (
    Convention(
        title="AllWISE",
        position=("ra", "dec"),
        marks=("w1mpro", "sigradec"),
        without=("meanobsmjd",),
        ids=("designation", "source_id"),
        # Explanatory supplement, II.1.a: one σ, and V = sigradec·|sigradec|.
        errors=(ErrorNames("axes", ("sigra", "sigdec"), "arcsec", co_sigma="sigradec"),),
        epochs=("w1mjdmean",),
        epoch_jyr=2010.5,
        magnitudes=(("w1mpro", "w1sigmpro"),),
    ),
    Convention(
        title="AllWISE at VizieR (II/328)",
        position=("RAJ2000", "DEJ2000"),
        marks=("AllWISE", "eeMaj"),
        ids=("AllWISE",),
        errors=(ErrorNames("ellipse", ("eeMaj", "eeMin", "eePA"), "arcsec"),),
        epoch_jyr=2010.5,
        magnitudes=(("W1mag", "e_W1mag"),),
    ),
)

# Archives of WFCAM and VISTA: errors in degrees, motions in mas/yr, epoch in years; −0.9999995e9 for none.
_WFAU = Convention(
    title="UKIDSS and VISTA surveys",
    position=("ra", "dec"),
    marks=("frameSetID", "cuEventID", "mergedClass", "jAperMag3", "ksAperMag3", "kAperMag3", "yAperMag3"),
    ids=("sourceID",),
    errors=(ErrorNames("axes", ("sigRa", "sigDec"), "deg"),),
    motions=(MotionNames(("", "muRa", "muDec", ""), ("", "sigMuRa", "sigMuDec", "")),),
    epochs=("epoch",),
)

_SIMBAD = tuple(
    Convention(
        title="SIMBAD",
        position=("ra", "dec"),
        marks=(ellipse[0],),
        ids=("main_id",),
        # The default display: ICRS, "ep=J2000"; the ellipse in mas is that of the source's catalogue, one σ for Gaia.
        errors=(ErrorNames("ellipse", ellipse, "mas"),),
        # The ellipse of the motion's error, whose axes are those of right ascension and declination for Gaia.
        motions=(
            MotionNames(
                ("plx_value", "pmra", "pmdec", "rvz_radvel"), ("plx_err", "pm_err_maj", "pm_err_min", "rvz_err")
            ),
        ),
        epoch_jyr=2000.0,
    )
    for ellipse in (("coo_err_maj", "coo_err_min", "coo_err_angle"), ("COO_ERR_MAJA", "COO_ERR_MINA", "COO_ERR_ANGLE"))
)

# Brown et al. 2011, AJ 142, 112: motions in arcsec/yr; the archive gives right ascension in hours, too.
_KEPLER = tuple(
    Convention(
        title=title,
        position=position,
        unit_of_ra=unit_of_ra,
        marks=("kic_kepmag", "kic_kepler_id", "kepmag"),
        ids=("kic_kepler_id", "KIC"),
        motions=tuple(MotionNames(names, ("", "", "", ""), unit="arcsec") for names in motions),
        epoch_jyr=2000.0,
        magnitudes=(("kic_kepmag", ""), ("kepmag", "")),
        over=over,
    )
    for title, position, unit_of_ra, motions, over in (
        ("Kepler Input Catalog", ("kic_degree_ra", "kic_dec"), "", (_KIC_MOTION,), ("kic_ra",)),
        ("Kepler Input Catalog", ("kic_ra", "kic_dec"), "hourangle", (_KIC_MOTION,), ()),
        ("Kepler Input Catalog (V/133)", ("RAJ2000", "DEJ2000"), "", (("Plx", "pmRA", "pmDE", ""),), ()),
    )
)

_TYCHO2 = Convention(
    title="Tycho-2 (I/259)",
    position=("RAmdeg", "DEmdeg"),
    marks=("TYC1", "VTmag", "BTmag"),
    ids=("TYC",),
    # The errors refer to the mean epoch of the observations, near 1991.5, the position to 2000.0.
    errors=(ErrorNames("axes", ("e_RAmdeg", "e_DEmdeg"), "mas"),),
    motions=(VIZIER_MOTION,),
    epoch_jyr=2000.0,
    magnitudes=(("VTmag", "e_VTmag"), ("BTmag", "e_BTmag")),
    over=("RA(ICRS)", "RAdeg", "_RAJ2000", "RAJ2000"),
)

_GALEX = Convention(
    title="GALEX",
    position=("ra", "dec"),
    marks=("nuv_mag", "fuv_mag"),
    ids=("objid",),
    # The position is that of the near ultraviolet where it has one.
    errors=tuple(ErrorNames("circle", (name,), "arcsec") for name in ("nuv_poserr", "fuv_poserr")),
    magnitudes=(("nuv_mag", "nuv_magerr"), ("fuv_mag", "fuv_magerr")),
)

_REFCAT2 = Convention(
    title="ATLAS Refcat2",
    position=("RA", "Dec"),
    marks=("dpmra", "dplx"),
    ids=("objid",),
    motions=(MotionNames(("plx", "pmra", "pmdec", ""), ("dplx", "dpmra", "dpmdec", "")),),
    # Tonry et al. 2018, ApJ 867, 105: positions of Gaia DR2 where it has the star.
    epoch_jyr=2015.5,
    magnitudes=(("Gaia", "dGaia"), ("r", "dr")),
)

_TIC = (
    Convention(
        title="TESS Input Catalog",
        position=("ra", "dec"),
        marks=("Tmag",),
        ids=("TIC", "ID"),
        # Stassun et al. 2018, AJ 156, 102, appendix: ra, dec at the epoch 2000.0, their errors in mas.
        errors=(ErrorNames("axes", ("e_RA", "e_Dec"), "mas"),),
        motions=(MotionNames(("plx", "pmRA", "pmDEC", ""), ("e_plx", "e_pmRA", "e_pmDEC", "")),),
        epoch_jyr=2000.0,
        magnitudes=(("Tmag", "e_Tmag"),),
        over=("RA_orig",),
    ),
    Convention(
        title="TESS Input Catalog at VizieR (IV/38, IV/39)",
        position=("RAJ2000", "DEJ2000"),
        marks=("TIC", "Tmag"),
        ids=("TIC",),
        errors=(
            ErrorNames("axes", ("e_RAJ2000", "e_DEJ2000"), "mas"),
            ErrorNames("axes", ("e_RAdeg", "e_DEdeg"), "mas"),
        ),
        motions=(VIZIER_MOTION,),
        epoch_jyr=2000.0,
        magnitudes=(("Tmag", "e_Tmag"),),
        over=("RAOdeg", "RAdeg"),
    ),
)

_UCAC5 = Convention(
    title="UCAC5 (I/340)",
    position=("RAgaia", "DEgaia"),
    ids=("SrcIDgaia",),
    # Zacharias et al. 2017, AJ 153, 166: Gaia's positions at 2015.0, motions from the UCAC to them.
    errors=(ErrorNames("axes", ("e_RAgaia", "e_DEgaia"), "mas"),),
    motions=(MotionNames(("", "pmUR", "pmUD", ""), ("", "e_pmUR", "e_pmUD", "")),),
    epoch_jyr=2015.0,
    only_epoch=True,
    magnitudes=(("Gmag", ""), ("f.mag", ""), ("f_mag", "")),
)

# Sexagesimal parts in separate columns, as at the CDS and in journals.
_IN_PARTS = Convention(
    title="CDS, in parts",
    position=("RAh", "DEd"),
    ids=PLAIN_IDS,
    motions=PLAIN_MOTIONS,
    epochs=PLAIN_EPOCHS,
    magnitudes=PLAIN_MAGNITUDES,
    errors=(*own_axes("RA", "DE"), ErrorNames("axes", ("e_RAs", "e_DEs"))),
    parts=(("RAh", "RAm", "RAs"), ("DE-", "DEd", "DEm", "DEs")),
)

_PLAIN_POSITIONS = (
    ("ra", "dec"), ("ra", "de"), ("ra", "decl"), ("RAdeg", "DEdeg"), ("ra_deg", "dec_deg"), ("RA_ICRS", "DE_ICRS"),
    ("RAICRS", "DEICRS"), ("RAJ2000", "DEJ2000"), ("RAJ2000", "DECJ2000"), ("ra2000", "dec2000"),
    ("ra_j2000", "dec_j2000"), ("RAhms", "DEdms"),
    *((hours, declination) for hours in ("ra_h", "ra_hr", "ra_hrs", "ra_hours") for declination in ("dec_deg", "dec")),
    ("RightAscension", "Declination"), ("right_ascension", "declination"), ("ra", "declination"), ("lon", "lat"),
    ("MatchRA", "MatchDec"),
    ("_RAJ2000", "_DEJ2000"), ("_RA", "_DE"), ("_RA_icrs", "_DE_icrs"), ("_RA.icrs", "_DE.icrs"),
)  # fmt: skip
_GALACTIC_POSITIONS = (
    ("GLON", "GLAT"), ("l", "b"), ("l_deg", "b_deg"), ("gal_lon", "gal_lat"), ("gallon", "gallat"), ("lii", "bii"),
    ("galactic_longitude", "galactic_latitude"), ("_Glon", "_Glat"),
)  # fmt: skip
_ECLIPTIC_POSITIONS = (
    ("ELON", "ELAT"), ("ecl_lon", "ecl_lat"), ("ecliptic_longitude", "ecliptic_latitude"), ("_Elon", "_Elat"),
)  # fmt: skip
_B1950_POSITIONS = (
    ("RAB1950", "DEB1950"), ("RAB1950", "DECB1950"), ("ra1950", "dec1950"), ("ra1950", "de1950"),
    ("ra_b1950", "dec_b1950"), ("ra_1950", "dec_1950"), ("_RAB1950", "_DEB1950"),
)  # fmt: skip

# The order only breaks ties: known surveys first.
CONVENTIONS: tuple[Convention, ...] = (
    _GAIA, _GAIA_VIZIER, _HIP2, *_HIPPARCOS, _TYCHO2, *_TWOMASS, *_ALLWISE, _CATWISE, _TRACTOR, *_SDSS, *_SPECTRA,
    _PANSTARRS, _PANSTARRS_STACK, _PANSTARRS_VIZIER, _CATWISE_VIZIER, _SKYMAPPER, _NSC, _WFAU, *_SIMBAD, *_KEPLER,
    _UCAC4, *_USNO_B1, *_DES,
    *_LSST, *HIGH_ENERGY,
    *RADIO, _GALEX, _REFCAT2, *_TIC, _UCAC5, _SAMEAS_FRAME, *_sextractor("WIN"), *_sextractor("PSF"),
    *_sextractor("PEAK"), *_sextractor(""), *(plain(position) for position in _PLAIN_POSITIONS), _IN_PARTS,
)  # fmt: skip

#: Used if there is no right ascension.
OTHER_FRAMES: tuple[Convention, ...] = (
    *(plain(position, "galactic coordinates", "galactic") for position in _GALACTIC_POSITIONS),
    *(plain(position, "ecliptic coordinates", "ecliptic") for position in _ECLIPTIC_POSITIONS),
    *(of_b1950(plain(position, "equinox B1950, FK4")) for position in _B1950_POSITIONS),
)
