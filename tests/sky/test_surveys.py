"""Tables as the archives of surveys serve them, without units: position, errors, motion, epoch, magnitude and id."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from sameas.sky import Catalogue

RA, DEC = 150.1, 60.2


def served(names: str, **values: object) -> Catalogue:
    """Two rows of the columns; the values of those that matter, other columns are small numbers."""
    return Catalogue.of(Table({name: np.array([values.get(name, 0.5)] * 2) for name in names.split()}), "mine")


@pytest.mark.parametrize(
    ("title", "names", "values", "sigma_arcsec", "epoch", "magnitude", "ids"),
    [
        (
            "Gaia archive",
            "solution_id source_id ref_epoch ra ra_error dec dec_error parallax parallax_error pmra pmra_error pmdec "
            "pmdec_error ra_dec_corr phot_g_mean_mag ruwe l b ecl_lon ecl_lat",
            {"ra": RA, "dec": DEC, "ra_error": 30.0, "dec_error": 40.0, "ref_epoch": 2016.0},
            (0.03, 0.04), 2016.0, "phot_g_mean_mag", "source_id",
        ),
        (
            "SDSS", "objID ra dec raErr decErr run rerun camcol field mjd psfMag_r psfMagErr_r l b",
            {"ra": RA, "dec": DEC, "raErr": 0.03, "decErr": 0.04, "mjd": 51464},
            (0.03, 0.04), 1999.78, "psfMag_r", "objID",
        ),
        # The date of a spectrum is not that of the position.
        (
            "SDSS, spectra", "specObjID bestObjID mjd plate fiberID ra dec z zErr",
            {"ra": RA, "dec": DEC, "mjd": 58000}, None, None, None, "specObjID",
        ),
        (
            "Pan-STARRS1",
            "objID raStack decStack raStackErr decStackErr raMean decMean raMeanErr decMeanErr epochMean "
            "rMeanPSFMag rMeanPSFMagErr",
            {"raMean": RA, "decMean": DEC, "raMeanErr": 0.001, "decMeanErr": 0.0015, "epochMean": 56000},
            (0.001, 0.0015), 2012.2, "rMeanPSFMag", "objID",
        ),
        (
            "Pan-STARRS1, stacks", "objID raStack decStack raStackErr decStackErr rPSFMag rPSFMagErr",
            {"raStack": RA, "decStack": DEC, "raStackErr": 0.001, "decStackErr": 0.0015},
            (0.001, 0.0015), None, "rPSFMag", "objID",
        ),
        (
            "Pan-STARRS1 at VizieR (II/349)",
            "RAJ2000 DEJ2000 objID f_objID Qual e_RAJ2000 e_DEJ2000 Epoch gmag e_gmag rmag e_rmag",
            {"RAJ2000": RA, "DEJ2000": DEC, "e_RAJ2000": 0.001, "e_DEJ2000": 0.0015, "Epoch": 56000},
            (0.001, 0.0015), 2012.2, "rmag", "objID",
        ),
        (
            "2MASS", "designation ra dec err_maj err_min err_ang j_m j_cmsig j_msigcom ph_qual jdate",
            {"ra": RA, "dec": DEC, "err_maj": 0.08, "err_min": 0.06, "err_ang": 0.0, "jdate": 2451000.0},
            (0.06, 0.08), 1998.51, "j_m", "designation",
        ),
        (
            "Dark Energy Survey",
            "coadd_object_id ra dec alphawin_j2000 deltawin_j2000 errawin_world_r errbwin_world_r errthetawin_j2000_r "
            "wavg_mag_psf_r wavg_magerr_psf_r",
            {"ra": RA, "dec": DEC, "errawin_world_r": 1e-5, "errbwin_world_r": 0.5e-5, "errthetawin_j2000_r": 0.0},
            (0.018, 0.036), None, "wavg_mag_psf_r", "coadd_object_id",
        ),
        (
            "LSST", "objectId coord_ra coord_dec coord_raErr coord_decErr coord_ra_dec_Cov refBand g_ra g_dec g_raErr "
            "g_decErr r_psfMag r_psfMagErr",
            {"coord_ra": RA, "coord_dec": DEC, "coord_raErr": 1e-5, "coord_decErr": 2e-5, "coord_ra_dec_Cov": 1e-10},
            (0.036, 0.072), None, "r_psfMag", "objectId",
        ),
        # The epoch of one band, as MJD; without it Gaia's motions of nine years were not used.
        (
            "LSST", "objectId coord_ra coord_dec coord_raErr coord_decErr coord_ra_dec_Cov r_epoch g_epoch r_psfMag",
            {"coord_ra": RA, "coord_dec": DEC, "coord_raErr": 1e-5, "coord_decErr": 2e-5, "coord_ra_dec_Cov": 0.0,
             "r_epoch": 60600.0, "g_epoch": 60000.0},
            (0.036, 0.072), 2024.79, "r_psfMag", "objectId",
        ),
        (
            "LSST", "diaObjectId ra dec raErr decErr ra_dec_Cov radecMjdTai nDiaSources g_psfFluxMean",
            {"ra": RA, "dec": DEC, "raErr": 1e-5, "decErr": 2e-5, "ra_dec_Cov": 1e-10, "radecMjdTai": 60600.0},
            (0.036, 0.072), 2024.79, None, "diaObjectId",
        ),
        # In mas; 4 was read as arcsec.
        (
            "SkyMapper", "object_id raj2000 dej2000 e_raj2000 e_dej2000 smss_j mean_epoch rms_epoch r_psf e_r_psf",
            {"raj2000": RA, "dej2000": DEC, "e_raj2000": 3.0, "e_dej2000": 4.0, "mean_epoch": 57000.0},
            (0.003, 0.004), 2014.94, "r_psf", "object_id",
        ),
        (
            "UKIDSS and VISTA surveys",
            "sourceID cuEventID ra dec l b mergedClass jAperMag3 jAperMag3Err ksAperMag3 ksAperMag3Err",
            {"ra": RA, "dec": DEC}, None, None, "ksAperMag3", "sourceID",
        ),
        (
            "CatWISE2020",
            "source_name source_id ra dec sigra sigdec sigradec w1mpro w1sigmpro meanobsmjd ra_pm dec_pm "
            "pmra pmdec sigpmra sigpmdec",
            {"ra": RA, "dec": DEC, "sigra": 0.3, "sigdec": 0.4, "sigradec": 0.01, "meanobsmjd": 57000.0},
            (0.3, 0.4), 2014.94, "w1mpro", "source_name",
        ),
        # In arcsec, with motions beside them; they were taken for mas.
        (
            "CatWISE2020 at VizieR (II/365)", "objID Name RA_ICRS DE_ICRS e_RA_ICRS e_DE_ICRS W1mproPM e_W1mproPM MJD "
            "RAPMdeg DEPMdeg pmRA pmDE e_pmRA e_pmDE",
            {"RA_ICRS": RA, "DE_ICRS": DEC, "e_RA_ICRS": 0.3, "e_DE_ICRS": 0.4, "MJD": 57000.0},
            (0.3, 0.4), 2014.94, "W1mproPM", "Name",
        ),
        (
            "NOIRLab Source Catalog",
            "id ra dec raerr decerr pmra pmraerr pmdec pmdecerr mjd deltamjd ndet gmag rmag rerr",
            {"ra": RA, "dec": DEC, "raerr": 0.03, "decerr": 0.04, "mjd": 57000.0}, (0.03, 0.04), 2014.94, "rmag", "id",
        ),
        (
            "eROSITA", "IAUNAME DETUID RA DEC RA_LOWERR RA_UPERR POS_ERR RADEC_ERR LII BII MJD ML_FLUX_1",
            {"RA": RA, "DEC": DEC, "POS_ERR": 3.0, "RADEC_ERR": 5.0, "MJD": 58900.0},
            (3.0, 3.0), 2020.14, None, "DETUID",
        ),
        # RA_UNC is the position before the rectification; it was a second candidate for the error.
        (
            "XMM-Newton",
            "DETID SRCID MJD_START RA DEC POSERR RADEC_ERR SYSERRCC RA_UNC DEC_UNC EP_8_FLUX SC_RA SC_DEC "
            "SC_POSERR SC_DET_ML",
            {"RA": RA, "DEC": DEC, "RA_UNC": RA, "DEC_UNC": DEC, "SC_RA": RA, "SC_DEC": DEC, "POSERR": 2**0.5,
             "MJD_START": 55000.0},
            (1.0, 1.0), 2009.46, None, "DETID",
        ),
        (
            "Chandra Source Catalog",
            "name ra dec err_ellipse_r0 err_ellipse_r1 err_ellipse_ang significance flux_aper_b",
            {"ra": RA, "dec": DEC, "err_ellipse_r0": 2.4477, "err_ellipse_r1": 1.22387, "err_ellipse_ang": 0.0},
            (0.5, 1.0), None, None, "name",
        ),
        (
            "LoTSS", "Source_Name RA E_RA E_RA_tot DEC E_DEC E_DEC_tot Peak_flux Total_flux Maj Min PA Isl_rms S_Code "
            "Mosaic_ID",
            {"RA": RA, "DEC": DEC, "E_RA_tot": 0.3, "E_DEC_tot": 0.4}, (0.3, 0.4), None, None, "Source_Name",
        ),
        (
            "VLASS", "Component_name RA DEC E_RA E_DEC Total_flux Peak_flux Maj Min NVSS_distance QL_cutout",
            {"RA": RA, "DEC": DEC, "E_RA": 1e-5, "E_DEC": 2e-5}, (0.036, 0.072), None, None, "Component_name",
        ),
        # Seconds of time, which a table without units does not say.
        (
            "NVSS at VizieR (VIII/65)", "Field NVSS RAJ2000 DEJ2000 e_RAJ2000 e_DEJ2000 S1.4 e_S1.4 f_resFlux resFlux",
            {"RAJ2000": "10 00 24.00", "DEJ2000": "+60 12 00.0", "e_RAJ2000": 0.1, "e_DEJ2000": 0.6},
            (1.5 * np.cos(np.radians(DEC)), 0.6), None, None, "NVSS",
        ),
        (
            "plain names", "RA DEC SIDEPROB FPEAK FINT RMS MAJOR MINOR POSANG FLDNAME YEAR MJD",
            {"RA": RA, "DEC": DEC, "MJD": 50000.0}, None, 1995.77, None, None,
        ),
        (
            "LAMOST", "obsid uid designation obsdate lmjd mjd planid spid fiberid ra_obs dec_obs snrg z gaia_source_id "
            "gaia_g_mean_mag ra dec",
            {"ra": RA, "dec": DEC, "mjd": 57000, "lmjd": 57000}, None, None, "gaia_g_mean_mag", "obsid",
        ),
        (
            "plain names", "OBJECT_ID RIGHT_ASCENSION DECLINATION RIGHT_ASCENSION_PSF_FITTING DECLINATION_PSF_FITTING "
            "FLUX_VIS_PSF FLUXERR_VIS_PSF POINT_LIKE_PROB",
            {"RIGHT_ASCENSION": RA, "DECLINATION": DEC}, None, None, "FLUX_VIS_PSF", "OBJECT_ID",
        ),
        (
            "DESI", "TARGETID SURVEY Z ZERR ZWARN TARGET_RA TARGET_DEC PMRA PMDEC REF_EPOCH FLUX_G MEAN_FIBER_RA "
            "STD_FIBER_RA MEAN_FIBER_DEC MEAN_MJD",
            {"TARGET_RA": RA, "TARGET_DEC": DEC, "REF_EPOCH": 2015.5}, None, 2015.5, "FLUX_G", "TARGETID",
        ),
        # Gaia's epoch is 0 for all that is not of Gaia, and was refused.
        (
            "Legacy Surveys, tractor",
            "release brickid objid ra dec ra_ivar dec_ivar flux_r ref_cat ref_epoch pmra pmdec",
            {"ra": RA, "dec": DEC, "ra_ivar": (0.1 / 3600 / np.cos(np.radians(DEC))) ** -2.0,
             "dec_ivar": (0.2 / 3600) ** -2.0,
             "ref_epoch": 0.0},
            (0.1, 0.2), None, "flux_r", None,
        ),
        # Errors in degrees and motions were not used.
        (
            "UKIDSS and VISTA surveys",
            "sourceID ra dec sigRa sigDec epoch muRa muDec sigMuRa sigMuDec chi2 nFrames ksAperMag3 ksAperMag3Err",
            {"ra": RA, "dec": DEC, "sigRa": 3e-5, "sigDec": 4e-5, "epoch": 2008.2},
            (0.108, 0.144), 2008.2, "ksAperMag3", "sourceID",
        ),
        # All errors and epochs are the archive's default: no row could be matched.
        (
            "UKIDSS and VISTA surveys", "sourceID ra dec sigRa sigDec epoch muRa muDec sigMuRa sigMuDec ksAperMag3",
            {"ra": RA, "dec": DEC, **dict.fromkeys(("sigRa", "sigDec", "epoch", "muRa", "muDec"), -0.9999995e9)},
            None, None, "ksAperMag3", "sourceID",
        ),
        # Right ascension in hours, motions in arcsec a year.
        (
            "Kepler Input Catalog", "kic_kepler_id kic_ra kic_dec kic_pmra kic_pmdec kic_gmag kic_kepmag",
            {"kic_ra": RA / 15.0, "kic_dec": DEC}, None, 2000.0, "kic_kepmag", "kic_kepler_id",
        ),
        (
            "SIMBAD", "main_id ra dec coo_err_maj coo_err_min coo_err_angle coo_wavelength coo_bibcode pmra pmdec V",
            {"ra": RA, "dec": DEC, "coo_err_maj": 30.0, "coo_err_min": 20.0, "coo_err_angle": 90.0},
            (0.03, 0.02), 2000.0, None, "main_id",
        ),
        (
            "XMM-Newton, stacked", "SRCID N_OBS N_CONTRIB RA DEC RADEC_ERR EP_FLUX MJD_FIRST MJD_LAST STACK_FLAG",
            {"RA": RA, "DEC": DEC, "RADEC_ERR": 2**0.5}, (1.0, 1.0), None, None, "SRCID",
        ),
        (
            "Dark Energy Survey", "COADD_OBJECT_ID RA DEC ALPHAWIN_J2000 DELTAWIN_J2000 EXT_MASH BDF_MAG_R "
            "PSF_MAG_APER_8_R PSF_MAG_ERR_APER_8_R",
            {"RA": RA, "DEC": DEC}, None, None, "PSF_MAG_APER_8_R", "COADD_OBJECT_ID",
        ),
        # Names ignore case: these were of Pan-STARRS1, with its errors of 12 mas.
        ("a pair named alike", "objectId ramean decmean gmag rmag jdmax ncand", {"ramean": RA, "decmean": DEC},
            None, None, "gmag", "objectId"),
        ("a pair named alike", "source_id world_centroid_alpha world_centroid_delta auto_mag auto_mag_err",
            {"world_centroid_alpha": RA, "world_centroid_delta": DEC}, None, None, "auto_mag", "source_id"),
        ("plain names", "permID obsTime ra dec rmsRA rmsDec rmsCorr mag rmsMag band astCat",
            {"ra": RA, "dec": DEC, "rmsRA": 0.3, "rmsDec": 0.4, "obsTime": 57000.0}, (0.3, 0.4), 2014.94, "mag", None),
        ("plain names", "name ra declination discoverymag", {"ra": RA, "declination": DEC}, None, None, None, "name"),
        # The error of forced photometry of ATLAS is a code.
        ("plain names", "MJD m dm uJy duJy F err chi/N RA Dec x y maj min phi apfit mag5sig Sky Obs",
            {"RA": RA, "Dec": DEC, "MJD": 57000.0, "err": 1}, None, 2014.94, None, None),
        # Any table may have a raErr: degrees are not assumed for it.
        ("plain names", "ra dec raErr decErr", {"ra": RA, "dec": DEC, "raErr": 0.1, "decErr": 0.2},
            (0.1, 0.2), None, None, None),
    ],
)  # fmt: skip
def test_tables_of_surveys_are_read_without_units(title, names, values, sigma_arcsec, epoch, magnitude, ids) -> None:
    source = served(names, **values)
    choice, astrometry = source.choice, source.astrometry
    assert (choice.convention, choice.magnitude) == (title, magnitude)
    assert choice.id == ids or (ids is None and choice.id in (None, "objid"))
    np.testing.assert_allclose([astrometry.ra_deg[0], astrometry.dec_deg[0]], [RA, DEC], atol=1e-9)
    assert source.error_is_unknown == (sigma_arcsec is None)
    if sigma_arcsec is not None:
        found = np.sqrt([astrometry.variance(axis)[0] for axis in (0, 1)]) / 1000.0
        np.testing.assert_allclose(found, sigma_arcsec, rtol=2e-3)
    assert source.epoch_jyr == (None if epoch is None else pytest.approx(epoch, abs=0.006))


def test_the_covariance_of_variances_is_read_in_its_own_unit() -> None:
    variances = {"cov_ee_arcsec2": [0.04, 0.09], "cov_nn_arcsec2": [0.09, 0.04], "cov_en_arcsec2": [0.03, -0.012]}
    place = {"measurement": ["1", "2"], "ra_deg": [10.0, 10.1], "dec_deg": [5.0, 5.1]}
    correlations = []
    for mas in ((), ("cov_en_arcsec2",), tuple(variances)):
        table = Table(place | variances)
        for name in mas:
            table[name] = table[name] * 1e6
            table[name].unit = "mas2"
        records = Catalogue.of(table, name="frame").records()
        correlations.append(records.covariance[:, 1] / np.sqrt(records.covariance[:, 0] * records.covariance[:, 2]))
    np.testing.assert_allclose(correlations[0], [0.5, -0.2])
    np.testing.assert_allclose(correlations[1:], [correlations[0]] * 2)


def test_rows_of_lsst_without_an_epoch_in_the_band_are_of_the_median_one() -> None:
    table = {"coord_ra": [RA, RA, RA], "coord_dec": [1.0, 2.0, 3.0], "r_epoch": [60600.0, np.nan, 60610.0]}
    source = Catalogue.of(table, "mine")
    np.testing.assert_allclose(source.astrometry.epoch_jyr, [2024.793, 2024.807, 2024.820], atol=1e-3)
    assert any("in rows without one its median 2024.81" in line for line in source.interpretation)


@pytest.mark.parametrize("missing", [-9999.99, -999.0, 9999.0, 1e20, -0.9999995e9])
def test_numbers_for_missing_motions_are_no_motions(missing: float) -> None:
    """Rows were moved by ten arcsec a year, or the table was refused for its negative errors."""
    table = {"ra": [RA, RA], "dec": [1.0, 2.0], "pmra": [99.9, missing], "pmdec": [2.0, missing],
             "pmra_error": [0.1, missing], "pmdec_error": [0.1, -1.0], "parallax": [1.0, -abs(missing)],
             "ref_epoch": [2016.0, 2016.0]}  # fmt: skip
    source = Catalogue.of(table, "mine")
    assert source.astrometry.pm_ra_mas_per_yr.tolist() == [99.9, 0.0]
    assert source.astrometry.parallax_mas.tolist() == [1.0, 0.0]
    assert np.sqrt(source.astrometry.variance(3)).tolist() == pytest.approx([0.1, 10.0])
    assert any("1 of 2 rows has no proper motion" in line for line in source.interpretation)


def test_motions_of_the_kepler_input_catalog_are_in_arcsec_a_year() -> None:
    table = {"KIC": [1], "RAJ2000": [RA], "DEJ2000": [DEC], "pmRA": [0.12], "pmDE": [-0.2], "kepmag": [14.0]}
    assert Catalogue.of(table, "mine").astrometry.pm_dec_mas_per_yr.tolist() == pytest.approx([-200.0])


def test_motions_of_gaia_without_their_errors_have_those_of_the_release_beside_quoted_errors_of_positions() -> None:
    """The spread of unmeasured motions, 10 mas/yr, was assumed: 90 mas at the epoch of Rubin."""
    table = {"source_id": [1], "ra": [RA], "dec": [DEC], "ra_error": [0.1], "dec_error": [0.1], "pmra": [3.0],
             "pmdec": [2.0], "ref_epoch": [2016.0], "phot_g_mean_mag": [17.0]}  # fmt: skip
    source = Catalogue.of(table, "mine")
    assert np.sqrt(source.astrometry.variance(3)).tolist() == pytest.approx([0.07])
    assert any("pmra has no column of errors: those of Gaia DR3 are assumed" in doubt for doubt in source.doubts)


def test_motions_in_degrees_a_year_are_doubted() -> None:
    table = {"ra": [RA, RA], "dec": [1.0, 2.0], "pmra": [1e-6, 2e-6], "pmdec": [0.0, -1e-6], "epoch": [2000.0] * 2}
    assert any("half of the proper motions are below 1.6e-06 mas/yr" in one for one in Catalogue.of(table, "a").doubts)


def test_motions_of_simbad_have_their_errors() -> None:
    """The spread of unmeasured motions was assumed."""
    table = {"main_id": ["a"], "ra": [RA], "dec": [DEC], "coo_err_maj": [0.03], "coo_err_min": [0.02],
             "coo_err_angle": [90], "pmra": [5.0], "pmdec": [4.0], "pm_err_maj": [0.04], "pm_err_min": [0.05],
             "plx_value": [2.0], "plx_err": [0.1]}  # fmt: skip
    source = Catalogue.of(table, "mine")
    sigmas = [float(np.sqrt(source.astrometry.variance(k)[0])) for k in (2, 3, 4)]
    assert sigmas == pytest.approx([0.1, 0.04, 0.05]) and not any("column of errors" in one for one in source.doubts)
