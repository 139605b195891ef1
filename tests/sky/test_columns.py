"""Columns are recognised by names, units and UCDs; ambiguous tables are refused with a remedy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from astropy import units as u
from astropy.table import MaskedColumn, QTable, Table
from astropy.time import Time

from sameas.errors import InputError
from sameas.sky import Catalogue
from sameas.sky.column_choice import CatalogueOptions, ColumnChoice
from sameas.sky.column_values import factor, is_in_seconds_of_time
from sameas.sky.columns import choose
from sameas.sky.conventions import ErrorNames
from sameas.sky.surveys import CONVENTIONS

GAIA = ["source_id", "ra", "dec", "ra_error", "dec_error", "ra_dec_corr", "ref_epoch", "phot_g_mean_mag"]
GAIA_MOTION = ["parallax", "parallax_error", "pmra", "pmra_error", "pmdec", "pmdec_error", "pmra_pmdec_corr"]
GAIA_VIZIER = ["RA_ICRS", "DE_ICRS", "Source", "e_RA_ICRS", "e_DE_ICRS", "RADEcor", "Plx", "pmRA", "pmDE", "Gmag"]
SEXTRACTOR = ["NUMBER", "ALPHA_J2000", "DELTA_J2000", "ERRA_WORLD", "ERRB_WORLD", "ERRTHETA_J2000", "MAG_AUTO"]
TWOMASS = ["ra", "dec", "err_maj", "err_min", "err_ang", "designation", "j_m", "j_msigcom", "jdate"]
LSST = ["diaSourceId", "ra", "dec", "raErr", "decErr", "ra_dec_Cov", "midpointMjdTai"]


def made(*names: str, units: dict[str, str] | None = None, meta: dict[str, str] | None = None) -> Table:
    table = Table({name: np.full(3, 0.5) + np.arange(3) for name in names}, meta=meta or {})
    for name, unit in (units or {}).items():
        table[name].unit = unit
    return table


def chosen(table: Table, **options: object) -> ColumnChoice:
    return choose(table, CatalogueOptions(**options), "cat.fits")  # type: ignore[arg-type]


def names_of(choice: ColumnChoice) -> list[str]:
    return [choice.ra.name, choice.dec.name, *(column.name for column in choice.error.columns)]


def test_the_gaia_archive_needs_no_units() -> None:
    choice = chosen(made(*GAIA, *GAIA_MOTION))
    assert names_of(choice) == ["ra", "dec", "ra_error", "dec_error"]
    assert [column.unit for column in choice.error.columns] == ["mas", "mas"]
    assert choice.error.correlation == "ra_dec_corr"
    assert [column and column.name for column in choice.motion] == ["parallax", "pmra", "pmdec", None]
    assert (3, 4, "pmra_pmdec_corr") in choice.correlations
    assert (choice.id, choice.magnitude, choice.epoch.column) == ("source_id", "phot_g_mean_mag", "ref_epoch")


def test_a_choice_describes_itself_with_reasons() -> None:
    lines = chosen(made(*GAIA, *GAIA_MOTION, units={"ra": "deg", "dec": "deg"})).describe("2016.0")
    assert "position: ra, dec [deg, unit of the column]; names of: Gaia archive" in lines
    assert "errors: ra_error, dec_error [mas, by convention], east and north, correlation ra_dec_corr" in lines
    assert "epoch: 2016.0 (column ref_epoch)" in lines


def test_the_unit_of_a_column_overrides_the_convention() -> None:
    choice = chosen(made(*GAIA, units={"ra_error": "arcsec"}))
    assert [column.unit for column in choice.error.columns] == ["arcsec", "mas"]


def test_columns_are_found_in_any_case() -> None:
    assert names_of(chosen(made(*(name.upper() for name in GAIA)))) == ["RA", "DEC", "RA_ERROR", "DEC_ERROR"]


@pytest.mark.parametrize(
    ("meta", "column", "epoch"),
    [
        ({"name": "gaiadr2.gaia_source"}, None, 2015.5),
        ({"ID": "I_355_gaiadr3", "name": "I/355/gaiadr3"}, None, 2016.0),
        ({}, "Gaia DR3 604697520872028160", 2016.0),
        ({}, "Gaia DR2 604697520872028160", 2015.5),
        ({"comment": "Gaia DR2 sources that are in Gaia DR3"}, None, None),
        ({}, None, None),
    ],
)
def test_the_epoch_of_gaia_is_that_of_the_release_it_names(
    meta: dict[str, str], column: str | None, epoch: float | None
) -> None:
    table = made(*(name for name in GAIA if name != "ref_epoch"), meta=meta)
    if column:
        table["DESIGNATION"] = [column] * 3
    assert chosen(table).epoch.jyr == epoch


def test_edr3_is_recognised_by_the_dr2_velocities() -> None:
    table = made("source_id", "ra", "dec", "dr2_radial_velocity")
    assert chosen(table, sigma=1).epoch.jyr == 2016.0


def test_names_that_differ_in_case_only_are_two_candidates() -> None:
    with pytest.raises(InputError, match="2 candidates for right ascension: 'RA', 'ra'; give ra=NAME"):
        chosen(made("ra", "dec", "RA", "DEC"), sigma=1)
    assert names_of(chosen(made("ra", "dec", "RA", "DEC"), ra="RA", dec="DEC", sigma=1)) == ["RA", "DEC"]


def test_gaia_at_vizier_is_not_confused_by_positions_moved_to_2000() -> None:
    choice = chosen(made(*GAIA_VIZIER, "RAJ2000", "DEJ2000", "e_RAJ2000", "e_DEJ2000", "_RAJ2000", "_DEJ2000"))
    assert names_of(choice) == ["RA_ICRS", "DE_ICRS", "e_RA_ICRS", "e_DE_ICRS"]
    assert choice.error.correlation == "RADEcor"
    assert "not used: RAJ2000, _RAJ2000" in choice.notes


def test_the_epoch_of_vizier_is_read_from_the_description() -> None:
    table = made(*GAIA_VIZIER)
    table["RA_ICRS"].description = "Right ascension (ICRS) at Ep=2016.000 (ra)"
    assert chosen(table).epoch.jyr == 2016.0


def test_equinox_2000_is_no_epoch() -> None:
    assert chosen(made("RAJ2000", "DEJ2000"), sigma=0.1).epoch.jyr is None


def test_hip2_is_in_radians() -> None:
    names = ["HIP", "RArad", "DErad", "Plx", "pmRA", "pmDE", "e_RArad", "e_DErad", "e_Plx", "e_pmRA", "e_pmDE"]
    weights = [f"UW{k}" for k in range(1, 16)]
    choice = chosen(made(*names, "Hpmag", "Ntr", "F2", *weights))
    assert (choice.ra.unit, choice.epoch.jyr, choice.magnitude) == ("rad", 1991.25, "Hpmag")
    assert choice.weights == (*weights, "F2", "Ntr")
    assert not chosen(made(*names, "Hpmag", *weights)).weights


def test_hipparcos_of_1997_has_its_correlations() -> None:
    choice = chosen(made("HIP", "RAICRS", "DEICRS", "e_RAICRS", "e_DEICRS", "DE:RA", "pmDE:pmRA", "pmRA", "pmDE"))
    assert choice.error.correlation == "DE:RA"
    assert (3, 4, "pmDE:pmRA") in choice.correlations
    assert choice.epoch.jyr == 1991.25


def test_sextractor_gives_ellipses_in_degrees() -> None:
    choice = chosen(made(*SEXTRACTOR, meta={"DATE-OBS": "2018-10-18T03:01:00"}))
    assert choice.error.kind == "ellipse"
    assert [column.unit for column in choice.error.columns] == ["deg"] * 3
    assert choice.epoch.jyr == pytest.approx(2018.795, abs=1e-3)
    assert choice.magnitude == "MAG_AUTO"


def test_two_positions_of_sextractor_are_refused() -> None:
    table = made(*SEXTRACTOR, "ALPHAWIN_J2000", "DELTAWIN_J2000", "ERRAWIN_WORLD", "ERRBWIN_WORLD", "ERRTHETAWIN_J2000")
    with pytest.raises(
        InputError, match=r"cat.fits: 2 candidates for right ascension: 'ALPHAWIN_J2000', 'ALPHA_J2000'"
    ):
        chosen(table)
    choice = chosen(table, ra="alphawin_j2000")
    assert names_of(choice)[1:3] == ["DELTAWIN_J2000", "ERRAWIN_WORLD"]


def test_2mass_has_ellipses_and_an_epoch_per_row() -> None:
    choice = chosen(made(*TWOMASS))
    assert (choice.error.kind, choice.error.columns[0].unit) == ("ellipse", "arcsec")
    assert (choice.epoch.column, choice.magnitude, choice.magnitude_error) == ("jdate", "j_m", "j_msigcom")
    choice = chosen(made("RAJ2000", "DEJ2000", "_2MASS", "errMaj", "errMin", "errPA", "Jmag", "e_Jmag", "Date"))
    assert (choice.error.kind, choice.epoch.column, choice.id) == ("ellipse", "Date", "_2MASS")


def test_lsst_has_covariances_in_square_degrees() -> None:
    choice = chosen(made(*LSST))
    assert (choice.error.covariance, choice.error.columns[0].unit) == ("ra_dec_Cov", "deg")
    assert choice.epoch.column == "midpointMjdTai"
    assert chosen(made(*LSST, "coord_ra", "coord_dec")).ra.name == "ra"


@pytest.mark.parametrize("position", [("RA", "DEC"), ("RAdeg", "DEdeg"), ("ra_deg", "dec_deg"), ("lon", "lat")])
def test_plain_names_are_recognised(position: tuple[str, str]) -> None:
    choice = chosen(made(*position, "sigma_arcsec", "mag", "magerr"))
    assert names_of(choice) == [*position, "sigma_arcsec"]
    assert (choice.error.columns[0].unit, choice.magnitude_error) == ("arcsec", "magerr")


def test_stdpipe_needs_a_sigma_only() -> None:
    table = made("obj", "x", "y", "ra", "dec", "mag", "magerr", "fwhm", "flags")
    assert chosen(table, sigma=0.3).error.sigma_arcsec == 0.3
    assert chosen(table).error.kind == "unknown"


@pytest.mark.parametrize(
    ("size", "more", "unit"),
    [(3e-5, (), "deg"), (0.1, (), "arcsec"), (0.1, ("pmra", "pmdec"), "mas"), (60.0, (), "mas")],
)
def test_the_unit_of_an_error_without_one_is_inferred_from_its_size(
    size: float, more: tuple[str, ...], unit: str
) -> None:
    table = made("ra", "dec", "ra_err", "dec_err", *more)
    table["ra_err"] = table["dec_err"] = size
    choice = chosen(table, epoch=2000)
    assert [column.unit for column in choice.error.columns] == [unit, unit] and choice.error.guessed_unit
    assert f"ra_err, dec_err [{unit}, guessed by its size]" in choice.describe()[1]
    assert [column.unit for column in chosen(table, sigma_unit="mas").error.columns] == ["mas", "mas"]


def test_two_kinds_of_errors_are_refused() -> None:
    table = made("ra", "dec", "pos_err", "sigma", units={"pos_err": "arcsec", "sigma": "arcsec"})
    with pytest.raises(InputError, match=r"2 candidates for the position error: sigma or pos_err; give sigma=NAME"):
        chosen(table)
    assert names_of(chosen(table, sigma="pos_err")) == ["ra", "dec", "pos_err"]


def test_errors_of_two_catalogues_of_one_position_are_refused() -> None:
    with pytest.raises(InputError, match=r"candidates for the position errors: err_maj,err_min,err_ang or ra_error"):
        chosen(made(*GAIA, *TWOMASS[2:]))


@pytest.mark.parametrize(
    "names", ["err_maj err_min err_pa", "ERR_MAJOR ERR_MINOR ERR_PA", "pos_err_a pos_err_b pos_err_angle"]
)
def test_an_ellipse_of_any_table_is_its_error(names: str) -> None:
    """``err_maj`` alone made a table of X-ray sources one of 2MASS, and its errors those of 2MASS."""
    axes = names.split()
    table = made("RA", "DEC", *axes, units={axes[0]: "arcsec", axes[1]: "arcsec", axes[2]: "deg"})
    choice = chosen(table)
    assert choice.error.kind == "ellipse" and names_of(choice)[2:5] == axes
    assert "2MASS" not in choice.describe()[0]


def test_errors_of_the_axes_of_the_sources_are_not_those_of_positions() -> None:
    """Aegean gives a, b and pa of the sources with the errors err_a, err_b and err_pa."""
    table = made("ra", "dec", "a", "err_a", "b", "err_b", "pa", "err_pa", units={"err_a": "arcsec", "err_b": "arcsec"})
    assert chosen(table).error.kind == "unknown"


def test_two_positions_are_refused() -> None:
    with pytest.raises(InputError, match=r"2 candidates for right ascension: 'RAJ2000', 'ra'; give ra=NAME"):
        chosen(made("ra", "dec", "RAJ2000", "DEJ2000"), sigma=1)


def test_the_position_with_its_own_errors_is_preferred() -> None:
    choice = chosen(made("ra", "dec", *GAIA_VIZIER))
    assert names_of(choice)[:2] == ["RA_ICRS", "DE_ICRS"]
    assert choice.notes == ("not used: ra",)


def test_the_main_position_of_a_votable_is_preferred() -> None:
    table = made("ra", "dec", "RAJ2000", "DEJ2000")
    table["ra"].meta = {"ucd": "pos.eq.ra"}
    table["RAJ2000"].meta = {"ucd": "pos.eq.ra;meta.main"}
    assert names_of(chosen(table, sigma=1)) == ["RAJ2000", "DEJ2000"]


@pytest.mark.parametrize(
    "place", ["150.5 +2.25", "10:02:00.1 -00:15:00", "10 02 00 -00 15 00", "10h02m00.1s, -00d15m00s"]
)
def test_a_column_of_both_coordinates_is_to_be_divided(place):
    with pytest.raises(InputError, match=r"where holds right ascension and declination together.*RA and DEC"):
        Catalogue.of(Table({"name": ["a", "b"], "when": ["2016-01-02 03:04:05"] * 2, "where": [place, place]}), "t")


def test_columns_of_unknown_names_are_found_by_their_ucds() -> None:
    table = made("alpha", "delta")
    with pytest.raises(InputError, match=r"no columns of right ascension and declination found among: alpha, delta"):
        chosen(table, sigma=1)
    table["alpha"].meta = {"ucd": "POS_EQ_RA_MAIN"}
    table["delta"].meta = {"ucd": "POS_EQ_DEC_MAIN"}
    assert names_of(chosen(table, sigma=1)) == ["alpha", "delta"]


def test_a_wrong_column_name_gets_a_suggestion() -> None:
    with pytest.raises(InputError, match=r"no column 'RA_ICRSS' for ra; did you mean 'RA_ICRS'"):
        chosen(made(*GAIA_VIZIER), ra="RA_ICRSS")
    with pytest.raises(InputError, match=r"no column 'sgima' for sigma; it has: ra, dec"):
        chosen(made("ra", "dec"), sigma="sgima")


def test_an_option_for_ra_alone_finds_its_partner() -> None:
    table = made("ra", "dec", "RAJ2000", "DEJ2000", "x", "y")
    assert names_of(chosen(table, ra="RAJ2000", sigma=1)) == ["RAJ2000", "DEJ2000"]
    assert names_of(chosen(table, dec="dec", sigma=1)) == ["ra", "dec"]
    assert names_of(chosen(table, ra="x", dec="y", sigma=1)) == ["x", "y"]
    with pytest.raises(InputError, match=r"'x' has no known partner; give ra=NAME and dec=NAME"):
        chosen(table, ra="x", sigma=1)


def test_motion_without_a_known_convention_is_not_used() -> None:
    table = made("ra", "dec", "pm_ra", "pm_dec")
    choice = chosen(table, sigma=1)
    assert choice.motion == (None,) * 4
    assert (
        "pm_ra, pm_dec not used: with or without cos(dec) is not stated; if with, give pm='pm_ra,pm_dec'"
        in choice.notes
    )
    assert chosen(table, sigma=1, pm="pm_ra,pm_dec").motion[1] is not None


@pytest.mark.parametrize("names", [("pmra", "pmdec"), ("pm_ra_cosdec", "pm_dec"), ("mu_alpha_star", "mu_delta")])
def test_motion_of_known_names_is_used_and_can_be_ignored(names: tuple[str, str]) -> None:
    table = made("ra", "dec", *names)
    assert [column and column.name for column in chosen(table, sigma=1).motion[1:3]] == list(names)
    assert chosen(table, sigma=1, pm="none").motion == (None,) * 4


def test_impossible_units_are_refused() -> None:
    with pytest.raises(InputError, match=r"'ra_error' is in pix, which is not an angle"):
        chosen(made(*GAIA, units={"ra_error": "pix"}))
    with pytest.raises(InputError, match=r"'pmdec' is in s / yr, which is not convertible to mas / yr"):
        chosen(made(*GAIA, *GAIA_MOTION, units={"pmdec": "s / yr"}))
    with pytest.raises(InputError, match=r"'sigma' is in parsec, which is not an angle"):
        chosen(made("ra", "dec"), sigma=1, sigma_unit="parsec")


def test_hours_and_sexagesimal_notation_are_recognised() -> None:
    assert chosen(made("ra", "dec", units={"ra": "hourangle"}), sigma=1).ra.unit == "hourangle"
    assert chosen(made("ra", "dec", units={"ra": "h"}), sigma=1).ra.unit == "hourangle"
    table = Table({"_RAJ2000": ["12 34 56.7"], "_DEJ2000": ["-00 12 03"]})
    choice = chosen(table, sigma=1)
    assert (choice.ra.unit, choice.dec.unit) == ("sexagesimal hours", "sexagesimal degrees")


def test_errors_of_other_quantities_are_ignored() -> None:
    assert chosen(made("ra", "dec", "err", "sigma", units={"err": "mag", "sigma": "arcsec"})).error.kind == "circle"


@pytest.mark.parametrize(("names", "units", "expected"), [
    (("VT", "e_VT"), ("mag", "mag"), ("VT", "e_VT")),
    (("i", "B", "B_err"), ("mag", "mag", "mag"), ("i", None)),
    (("V", "R"), ("km/s", "pc"), (None, None)),
    (("V", "B_V"), (None, "mag"), (None, None)),
])  # fmt: skip
def test_single_letter_bands_are_magnitudes_if_unit_or_ucd_says_so(names, units, expected) -> None:
    table = Table({"ra": [10.0], "dec": [20.0], **{name: [12.5] for name in names}})
    for name, unit in zip(names, units, strict=True):
        table[name].unit = unit
    choice = chosen(table)
    assert (choice.magnitude, choice.magnitude_error) == expected


@pytest.mark.parametrize(("names", "expected"), [
    (("class", "MAG_I", "MAG_I_err"), ("MAG_I", "MAG_I_err")),
    (("i_mag", "z_mag", "e_i_mag"), ("i_mag", "e_i_mag")),
    (("mag_F606W", "F814W_mag"), ("mag_F606W", None)),
    (("gmag", "gmagerr"), ("gmag", "gmagerr")),  # was without an error
    (("mag_g", "magerr_g", "mag_r"), ("mag_g", "magerr_g")),
    (("F475W_RATE", "F475W_VEGA", "F475W_ERR"), ("F475W_VEGA", None)),
    (("FLUXERR_AUTO", "FLUX_AUTO", "FLUX_APER"), ("FLUX_AUTO", None)),
    (("flux_r", "rmag"), ("rmag", None)),
    (("Total_flux", "flux", "flux_ratio"), (None, None)),
    (("e_mag", "n_mag", "magnification", "mag_type"), (None, None)),
])  # fmt: skip
def test_names_of_band_and_mag_are_magnitudes_without_a_unit(names, expected) -> None:
    choice = chosen(made("ra", "dec", *names))
    assert (choice.magnitude, choice.magnitude_error) == expected


def test_bands_without_a_unit_are_named() -> None:
    """A table with VT was read with "magnitude none", and no word of the column."""
    table = Table({"ra": [10.0], "dec": [1.0], "VT": [11.2], "z": [0.3], "sigma_arcsec": [0.1]})
    words = "not used: VT, whose unit is not stated; if it is mag, give magnitude='VT'"
    assert words in map(str, choose(table, CatalogueOptions(), "t").notes)
    for chosen in ("VT", "none"):
        assert not choose(table, CatalogueOptions(magnitude=chosen), "t").notes


def test_vector_columns_are_no_magnitudes() -> None:
    table = made(*SEXTRACTOR[:-1])
    table["MAG_AUTO"] = np.zeros((3, 2))
    table["MAG_PSF"] = MaskedColumn([1.0, 2.0, 3.0], unit=u.mag)
    assert chosen(table).magnitude == "MAG_PSF"


def test_radii_of_the_light_of_galaxies_are_no_errors() -> None:
    assert chosen(made("ra", "dec", "r50", "r90")).error.kind == "unknown"


def test_errors_of_motions_are_found_by_either_spelling() -> None:
    columns = ("RAJ2000", "DEJ2000", "pmRA", "pmDE", "e_pmRA", "e_pmDE")
    errors = chosen(made(*columns)).motion_errors
    assert [column and column.name for column in errors] == [None, "e_pmRA", "e_pmDE", None]


def test_inverse_variances_of_the_legacy_surveys() -> None:
    """They are of right ascension itself; 0 states that there is none."""
    table = made("ra", "dec", "ra_ivar", "dec_ivar", "objid", "brickid")
    table["dec"] = 60.0
    table["ra_ivar"] = table["dec_ivar"] = (0.2 / 3600.0) ** -2
    table["ra_ivar"][0] = table["dec_ivar"][0] = 0.0
    catalogue = Catalogue.of(table, "tractor")
    assert catalogue.choice.convention == "Legacy Surveys, tractor"
    east, north = (1e-3 * np.sqrt(catalogue.astrometry.variance(axis)) for axis in (0, 1))
    assert np.isnan([east[0], north[0]]).all()
    assert east[1:] == pytest.approx(0.1) and north[1:] == pytest.approx(0.2)


def test_positions_of_usno_b1_are_of_2000_whatever_their_column_epoch_says() -> None:
    table = made("USNO-B1.0", "RAJ2000", "DEJ2000", "e_RAJ2000", "e_DEJ2000", "Epoch", "pmRA", "pmDE")
    table["Epoch"] = 1971.3
    assert chosen(table).epoch.jyr == 2000.0 and chosen(table).epoch.column is None


def test_catwise_is_not_taken_for_allwise() -> None:
    columns = ("ra", "dec", "sigra", "sigdec", "sigradec", "w1mpro", "meanobsmjd", "ra_pm", "dec_pm")
    choice = chosen(made(*columns))
    assert (choice.convention, choice.epoch.column) == ("CatWISE2020", "meanobsmjd")


def test_positions_of_des_are_chosen_among_those_of_sextractor() -> None:
    choice = chosen(made("COADD_OBJECT_ID", "RA", "DEC", "ALPHAWIN_J2000", "DELTAWIN_J2000", "MAG_AUTO_R"))
    assert (choice.ra.name, choice.dec.name, choice.magnitude) == ("RA", "DEC", "MAG_AUTO_R")


def test_every_convention_is_recognised_by_its_own_names() -> None:
    for convention in CONVENTIONS:
        error = convention.errors[0] if convention.errors else ErrorNames("axes", ())
        table = made(*convention.position, *convention.marks[:1], *error.names)
        choice = chosen(table, sigma_unit=None if error.unit else "arcsec")
        assert names_of(choice) == [*convention.position, *error.names], convention.title


@pytest.mark.parametrize(
    ("columns", "divisor", "line"),
    [
        (
            ("ra", "dec", "err_ellipse_r0", "err_ellipse_r1", "err_ellipse_ang"),
            2.4477,
            "contains 95 %: divided by 2.448",
        ),
        (("RA", "Decl", "Err90"), 2.1460, "radius; contains 90 %: divided by 2.146"),
        (("RA", "DEC", "poserr_95"), 2.4477, "radius; contains 95 %: divided by 2.448"),
        (("RA", "DEC", "pos_r90"), 2.1460, "radius; contains 90 %: divided by 2.146"),
        (("RA", "DEC", "error_radius_68"), 1.5096, "radius; contains 68 %: divided by 1.51"),
        (("SC_RA", "SC_DEC", "SC_POSERR"), math.sqrt(2.0), "radius; contains 63 %: divided by 1.414"),
        (("RA", "DEC", "POSERR", "SYSERRCC", "SC_RA", "SC_DEC", "SC_POSERR"), math.sqrt(2.0), "POSERR [arcsec"),
        (("RA", "DEC", "RADEC_ERR"), math.sqrt(2.0), "radius; contains 63 %: divided by 1.414"),
        (("RA", "DEC", "RADEC_ERR", "POS_ERR"), 1.0, "POS_ERR [arcsec, by convention], on each axis"),
        (("RA", "DEC", "SC_POSERR"), math.sqrt(2.0), "SC_POSERR [arcsec, by convention], radius; contains 63 %"),
        (("RAJ2000", "DEJ2000", "1RXS", "PosErr"), 1.5158, "PosErr [arcsec, by convention], radius; contains 68 %"),
        (("ra", "dec", "r90"), 2.1460, "r90 [arcsec, by convention], radius; contains 90 %"),
        (("ra", "dec", "radius_95"), 2.4477, "radius; contains 95 %"),
    ],
)
def test_errors_with_a_containment_become_standard_deviations(
    columns: tuple[str, ...], divisor: float, line: str
) -> None:
    """Surveys in X-rays quote radii and ellipses of 63, 90 and 95 %."""
    numbers = {name: [3.0, 3.0] for name in columns}
    catalogue = Catalogue.of(numbers, "x")
    assert line in next(text for text in catalogue.interpretation if text.startswith("errors"))
    for axis in (0, 1):
        assert 1e-3 * np.sqrt(catalogue.astrometry.variance(axis)) == pytest.approx(3.0 / divisor, rel=1e-4)
    if "err_ellipse_r0" in columns:
        stated = CatalogueOptions(ellipse=",".join(columns[2:]))
    else:
        stated = CatalogueOptions(sigma=catalogue.choice.error.columns[0].name)
    again = Catalogue.of(numbers, "x", options=stated)
    assert again.astrometry.variance(0) == pytest.approx(catalogue.astrometry.variance(0))


@pytest.mark.parametrize(
    ("names", "stated", "divisor"),
    [
        (("Err90_corrected",), None, 2.1460),
        (("XRT 90% Error Radius [arcsec]",), None, 2.1460),
        (("R95_fit",), None, 2.4477),
        (("cl68_err",), None, 1.5096),
        (("Error50 [arcmin]",), None, 1.1774 / 60.0),
        (("POSERR", "SC_POSERR", "SYSERRCC"), "SC_POSERR", math.sqrt(2.0)),  # beside the survey's first choice
        (("err_ellipse_r0", "err_ellipse_r1", "err_ellipse_ang"), "err_ellipse_r0", 2.4477),
        (("sigma_1950",), None, 1.0),
    ],
)
def test_the_probability_of_a_radius_given_by_an_option_is_that_of_its_name(names, stated, divisor) -> None:
    """It was taken for a standard deviation: errors up to 2.4 times too large."""
    numbers = {"RA": [10.0, 11.0], "DEC": [1.0, 2.0]} | {name: [3.0, 3.0] for name in names}
    catalogue = Catalogue.of(numbers, "x", options=CatalogueOptions(sigma=stated or names[0]))
    assert 1e-3 * np.sqrt(catalogue.astrometry.variance(0)) == pytest.approx(3.0 / divisor, rel=1e-4)


@pytest.mark.parametrize(
    ("names", "percent"),
    [(("error90", "error50"), 0.9), (("positional_error_95_arcsec",), 0.95), (("err68", "err95"), 0.95)],
)
def test_one_of_several_radii_is_taken(names, percent) -> None:
    assert chosen(made("ra", "dec", *names)).error.containment == percent


def test_err_behind_a_magnitude_is_its_error() -> None:
    """It was the position error of lists of photometry; it may be, but not unsaid."""
    choice = chosen(made("name", "ra", "dec", "mag", "err"))
    assert (choice.error.kind, choice.magnitude_error) == ("unknown", "err")
    assert "err is taken for the error of mag, which it follows; if it is the position's, give sigma='err'" in map(
        str, choice.notes
    )
    of_band = chosen(made("ra", "dec", "g", "g_err", "V", "err"))
    assert (of_band.error.kind, of_band.magnitude_error) == ("unknown", None)
    for names, unit in ((("ra", "dec", "err", "mag"), None), (("ra", "dec", "mag", "err"), "arcsec")):
        assert chosen(made(*names, units={"err": unit} if unit else {})).error.kind == "circle"
    assert chosen(made("ra", "dec", "mag", "err"), sigma="err").error.kind == "circle"


def test_a_single_pair_named_alike_is_the_position() -> None:
    choice = chosen(made("oid", "meanra", "meandec", "sigmara", "sigmadec", "pmra", "pmdec", "dra", "ddec"))
    assert names_of(choice)[:2] == ["meanra", "meandec"]
    assert any("sigmara, sigmadec not used; if they are" in str(note) for note in choice.notes)
    words = "2 candidates for right ascension and declination: i_ra, i_dec; r_ra, r_dec; give ra='i_ra' dec='i_dec' or"
    with pytest.raises(InputError, match=words):
        chosen(made("i_ra", "i_dec", "r_ra", "r_dec"))
    assert names_of(chosen(made("i_ra", "i_dec", "r_ra", "r_dec"), ra="r_ra"))[:2] == ["r_ra", "r_dec"]


def test_pixels_are_named_where_there_is_no_position() -> None:
    """The table of a source finder was said to have no right ascension, and nothing of what to do."""
    words = r"but pixels xcentroid, ycentroid; convert them with the solution of their image \(astropy"
    with pytest.raises(InputError, match=words):
        chosen(made("id", "xcentroid", "ycentroid", "flux"))


def test_errors_by_their_names_are_listed_with_the_option_and_what_they_must_contain() -> None:
    notes = chosen(made("RA", "DEC", "RA_ERR_PLUS", "RA_ERR_MINUS", "DEC_ERR_PLUS", "DEC_ERR_MINUS", "magerr")).notes
    words = "RA_ERR_PLUS, RA_ERR_MINUS, DEC_ERR_PLUS, DEC_ERR_MINUS not used; if they are the position's, give "
    assert str(notes[0]) == words + (
        "sigma='RA_ERR_PLUS,DEC_ERR_PLUS' (one standard deviation on each axis: a radius of 90 % divided by 2.146, of "
        "95 % by 2.448)"
    )


def test_the_axes_of_an_ellipse_without_a_unit_have_the_same_one() -> None:
    table = {"ra": [10.0, 11.0], "dec": [1.0, 2.0], "a": [8.0, 6.0], "b": [2.0, 1.0], "pa": [10.0, 20.0]}
    catalogue = Catalogue.of(table, "x", options=CatalogueOptions(ellipse="a,b,pa"))
    assert "a, b [arcsec, guessed by its size]" in catalogue.interpretation[1]
    assert str(catalogue.doubts[0]).startswith("the unit of a, b is not stated; by its size arcsec")


def test_an_error_that_is_used_for_the_parallax_is_not_said_to_be_unused():
    """The listing named parallax_error as the parallax's, and below as not used."""
    table = Table({"ra": [10.0, 11.0], "dec": [1.0, 2.0], "parallax": [1.0, 2.0], "parallax_error": [0.1, 0.1],
                   "pmra": [1.0, 1.0], "pmdec": [1.0, 1.0]})  # fmt: skip
    for name, unit in (("ra", "deg"), ("dec", "deg"), ("parallax", "mas"), ("parallax_error", "mas")):
        table[name].unit = unit
    found = choose(table, CatalogueOptions(), "gaia")
    assert found.motion_errors[0].name == "parallax_error" and not any(
        "parallax_error" in str(note) for note in found.notes
    )


@pytest.mark.parametrize(
    ("columns", "title", "error", "epoch", "magnitude"),
    [
        # Names ignore case: e_gmag of SDSS and DES was Gaia's e_Gmag, and Gaia's errors were assumed.
        (("RA_ICRS", "DE_ICRS", "CoadID", "gmag", "e_gmag"), "plain names", (), None, "gmag"),
        (("RA_ICRS", "DE_ICRS", "objID", "e_RA_ICRS", "e_DE_ICRS", "gmag", "e_gmag"), "plain names",
         ("e_RA_ICRS", "e_DE_ICRS"), None, "gmag"),
        # A cross-identification with Hipparcos is not its catalogue of 1991.25.
        (("RAJ2000", "DEJ2000", "e_RAJ2000", "e_DEJ2000", "TIC", "HIP", "Tmag", "RAdeg", "DEdeg"),
         "TESS Input Catalog at VizieR (IV/38, IV/39)", ("e_RAJ2000", "e_DEJ2000"), 2000.0, "Tmag"),
        (("ra", "dec", "e_RA", "e_Dec", "ID", "Tmag"), "TESS Input Catalog", ("e_RA", "e_Dec"), 2000.0, "Tmag"),
        # 4XMM has a RADEC_ERR beside its POSERR and was refused.
        (("RA", "DEC", "POSERR", "RADEC_ERR", "SYSERRCC", "SC_RA", "SC_DEC", "SC_POSERR"), "XMM-Newton", ("POSERR",),
         None, None),
        (("RA_ICRS", "DE_ICRS", "4XMM", "ePos"), "XMM-Newton at VizieR", ("ePos",), None, None),
        (("RA_ICRS", "DE_ICRS", "1eRASS", "ePos"), "eROSITA at VizieR", ("ePos",), None, None),
        (("RAICRS", "DEICRS", "2CXO", "r0", "r1", "PA"), "Chandra Source Catalog at VizieR (IX/57)", ("r0", "r1", "PA"),
         None, None),
        (("ra", "dec", "objid", "nuv_mag", "fuv_mag", "nuv_poserr", "fuv_poserr"), "GALEX", ("nuv_poserr",), None,
         "nuv_mag"),
        # Any table may have an objID: SDSS' errors are not assumed for it.
        (("ra", "dec", "objid"), "SDSS, by its objID", (), None, None),
        (("RA", "Dec", "objid", "plx", "dplx", "pmra", "dpmra", "pmdec", "dpmdec", "Gaia"), "ATLAS Refcat2", (), 2015.5,
         "Gaia"),
        (("RAgaia", "DEgaia", "e_RAgaia", "e_DEgaia", "EPucac", "RAucac", "DEucac", "pmUR", "pmUD", "Gmag"),
         "UCAC5 (I/340)", ("e_RAgaia", "e_DEgaia"), 2015.0, "Gmag"),
        (("objectId", "coord_ra", "coord_dec", "coord_raErr", "coord_decErr", "coord_ra_dec_Cov", "r_psfMag"), "LSST",
         ("coord_raErr", "coord_decErr"), None, "r_psfMag"),
    ],
)  # fmt: skip
def test_surveys_are_read_as_their_archives_serve_them(columns, title, error, epoch, magnitude) -> None:
    choice = chosen(made(*columns))
    assert (choice.convention, choice.magnitude, choice.epoch.jyr) == (title, magnitude, epoch)
    assert tuple(column.name for column in choice.error.columns) == error
    assert choice.error.kind == "unknown" or error
    assert "coord_ra_dec_Cov" not in columns or choice.error.covariance == "coord_ra_dec_Cov"


def test_errors_of_other_names_are_found_by_their_ucds_and_contain_what_their_descriptions_say() -> None:
    """As VizieR serves catalogues of γ-ray sources: ellipses of 68 and of 95 %."""
    table = made(
        "RAdeg", "DEdeg", "a68", "b68", "t68", "a95", "b95", "t95", units=dict.fromkeys(["RAdeg", "DEdeg"], "deg")
    )
    for percent in ("68", "95"):
        for name, ucd in (("a", "phys.angSize.smajAxis"), ("b", "phys.angSize.sminAxis"), ("t", "pos.posAng")):
            column = table[name + percent]
            column.unit, column.meta = "deg", {"ucd": f"{ucd};pos.errorEllipse"}
            column.description = f"Of the error ellipse at {percent}% confidence"
    choice = chosen(table)
    assert [column.name for column in choice.error.columns] == ["a68", "b68", "t68"]
    assert (choice.error.kind, choice.error.containment) == ("ellipse", 0.68)
    plain = made("RAdeg", "DEdeg", "x", "y")
    for name, axis in (("x", "ra"), ("y", "dec")):
        plain[name].unit, plain[name].meta = "arcsec", {"ucd": f"stat.error;pos.eq.{axis}"}
    assert [column.name for column in chosen(plain).error.columns] == ["x", "y"]


def test_a_radius_contains_what_its_description_says() -> None:
    table = made("RA", "DEC", "poserr", units={"poserr": "arcsec"})
    assert chosen(table).error.containment == 0.0
    table["poserr"].description = "Position error (90% confidence)"
    assert chosen(table).error.containment == 0.9


@pytest.mark.parametrize(
    "of_ra, of_dec, factor_ra, factor_dec",
    [
        ("s/yr", "arcsec/yr", 15e3, 1e3),  # SAO, PPM
        ("s/ha", "arcsec/ha", 150.0, 10.0),  # FK5: per hundred years; astropy's ha is the hectare
        ("s/cy", "arcsec/cy", 150.0, 10.0),  # astropy's cy is the cycle
        ("ms/yr", "mas/yr", 15.0, 1.0),
        ("sec/year", "arcsec/century", 15e3, 10.0),
        ("milliarcsec/year", "milliarcsec/year", None, 1.0),
    ],
)
def test_motions_in_seconds_of_time_and_in_centuries_are_read(of_ra, of_dec, factor_ra, factor_dec):
    columns = {"RAJ2000": [10.0, 20.0], "DEJ2000": [60.0, 60.0], "pmRA": [0.3, -0.2], "pmDE": [1.5, 0.4]}
    table = Table(columns | {"e_pmRA": [0.02, 0.02], "e_pmDE": [0.1, 0.1], "e_pos": [0.1, 0.1]})
    units = {"pmRA": of_ra, "e_pmRA": of_ra, "pmDE": of_dec, "e_pmDE": of_dec, "RAJ2000": "deg", "DEJ2000": "deg"}
    for name, unit in units.items():
        table[name].unit = u.Unit(unit, parse_strict="silent")
    catalogue = Catalogue.of(table, "old", options=CatalogueOptions(epoch="2000", pm="pmRA,pmDE", sigma_unit="arcsec"))
    east = 1.0 if factor_ra is None else 0.5 * factor_ra  # cos 60°
    motion = catalogue.astrometry
    np.testing.assert_allclose(motion.pm_ra_mas_per_yr, east * np.array([0.3, -0.2]), rtol=1e-12)
    np.testing.assert_allclose(motion.pm_dec_mas_per_yr, factor_dec * np.array([1.5, 0.4]), rtol=1e-12)
    np.testing.assert_allclose(np.sqrt(motion.covariance[:, 3, 3]), east * 0.02, rtol=1e-6)


def test_a_motion_in_a_unit_that_cannot_be_read_is_refused():
    # It was taken as mas/yr.
    table = Table({"RAJ2000": [10.0], "DEJ2000": [60.0], "pmRA": [0.3], "pmDE": [1.5], "e_pos": [0.1]})
    table["pmRA"].unit = table["pmDE"].unit = u.Unit("parsecs/fortnite", parse_strict="silent")
    with pytest.raises(
        InputError, match="'pmRA' is in parsecs/fortnite, which is not convertible to mas / yr"
    ) as caught:
        Catalogue.of(table, "old", options=CatalogueOptions(epoch="2000", sigma_unit="arcsec"))
    assert "convert" in str(caught.value)


@pytest.mark.parametrize(
    "of_ra, of_error, ra_deg, error_arcsec",
    [
        ("hours", "arcseconds", 22.5, 150.0),  # taken for degrees, and for mas by their size
        ("radians", "milliarcsec", math.degrees(1.5), 0.15),
        ("degrees (J2000)", '"', 1.5, 150.0),
        ("Angle[deg]", "microarcsec", 1.5, 1.5e-4),
        ("h", "arc sec", 22.5, 150.0),
        ("gon", "arcsec", 1.35, 150.0),  # taken for degrees
        ("grad", "arcsec", 1.35, 150.0),
        ("turns", "arcsec", 180.0, 150.0),
    ],
)
def test_units_that_astropy_does_not_know_are_read_as_they_are_written(of_ra, of_error, ra_deg, error_arcsec):
    table = Table({"RA": [1.5], "DEC": [10.0], "e_pos": [150.0]})
    for name, unit in {"RA": of_ra, "DEC": "deg", "e_pos": of_error}.items():
        table[name].unit = u.Unit(unit, parse_strict="silent")
    catalogue = Catalogue.of(table, "old", options=CatalogueOptions(epoch="2000"))
    np.testing.assert_allclose(catalogue.astrometry.ra_deg, ra_deg, rtol=1e-12)
    sigma = 1e-3 * np.sqrt(catalogue.astrometry.position_covariance[:, 1, 1])
    np.testing.assert_allclose(sigma, error_arcsec, rtol=1e-9)


def test_degrees_assumed_for_a_unit_that_cannot_be_read_are_named():
    table = Table({"RA": [1.5], "DEC": [10.0], "e_pos": [0.1]})
    table["RA"].unit = u.Unit("sterns", parse_strict="silent")
    choice = choose(table, CatalogueOptions(epoch="2000"), "old")
    assert (choice.ra.unit, choice.ra.reason) == ("deg", "assumed: its unit 'sterns' cannot be read")
    assert choice.dec.reason == "by convention"


def test_a_unit_beyond_the_range_of_numbers_is_no_unit():
    """Met in a damaged FITS header: it was a fault of the program."""
    with pytest.raises(ValueError, match="beyond the range of numbers"):
        factor("1PB(99999999)", "s / yr")
    assert not is_in_seconds_of_time("1PB(99999999)")


@pytest.mark.parametrize(
    ("keywords", "year", "words"),
    [
        ({"DATE-OBS": "31/12/98"}, 1998.997, "header DATE-OBS"),
        ({"MJD-OBS": 0.0, "DATE-OBS": "2001-01-01T00:00:00"}, 2001.0, "header DATE-OBS; MJD-OBS = '0.0' is no time"),
        ({"JD": 2451545.0}, 2000.0, "header JD"),
        ({"MJDREF": 50814.0, "TSTART": 0.0, "TSTOP": 2.0 * 86400.0}, 1998.0027, "header TSTART, TSTOP and MJDREF"),
        ({"BJDREFI": 2457000, "BJDREFF": 0.0, "TSTART": 389.0, "TIMEUNIT": "d"}, 2016.0, "header TSTART and BJDREFI"),
    ],
)
def test_the_epoch_is_read_from_every_way_a_header_states_it(keywords, year, words):
    """These were not read, and the epoch of the other catalogue was assumed; an MJD that was not set was year 0."""
    table = Table({"ra": [10.0, 10.1], "dec": [5.0, 5.1]}, meta=keywords)
    seen = Catalogue.of(table, "seen", options=CatalogueOptions(sigma=0.2))
    assert seen.epoch_jyr == pytest.approx(year, abs=2e-3)
    assert any(words in line for line in seen.interpretation)


def test_the_epoch_is_read_from_times_at_the_sun_and_counted_ones_are_passed_over():
    for name, values, year in (("HJD", [2451545.0] * 2, 2000.0), ("BJD", [7389.0] * 2, None)):
        table = Table({"ra": [10.0, 10.1], "dec": [5.0, 5.1], name: values})
        assert Catalogue.of(table, "seen", options=CatalogueOptions(sigma=0.2)).epoch_jyr == year


@pytest.mark.parametrize(
    ("name", "days"),
    [
        ("BJD-2457000", 389.5), ("HJD (2450000+)", 7389.5), ("BTJD", 389.5), ("BJD_TDB - 2454833", 2556.5),
        ("MJD-50000", 7389.0), ("JD-2400000.5", 57389.0), ("obsmjd", 57389.0), ("epoch_jd", 2457389.5),
    ],
)  # fmt: skip
def test_days_are_counted_from_the_zero_that_their_column_states(name, days):
    """These columns were passed over."""
    table = Table({"ra": [10.0, 10.1], "dec": [5.0, 5.1], name: [days] * 2})
    seen = Catalogue.of(table, "seen", options=CatalogueOptions(sigma=0.2))
    assert seen.epoch_jyr == pytest.approx(2016.0, abs=2e-3)


def test_a_zero_in_a_unit_or_description_counts_only_for_a_time():
    table = Table({"ra": [10.0, 10.1], "dec": [5.0, 5.1], "HJD": [7389.5] * 2, "T0": [7000.0] * 2})
    table["HJD"].description = "Heliocentric Julian date (HJD-2450000)"
    table["T0"].unit = "BJD - 2450000, days"
    options = CatalogueOptions(sigma=0.2)
    assert Catalogue.of(table, "seen", options=options).epoch_jyr == pytest.approx(2016.0, abs=2e-3)
    del table["HJD"]
    assert Catalogue.of(table, "seen", options=options).epoch_jyr is None


def test_a_julian_date_without_its_zero_is_refused_with_the_remedy():
    table = Table({"ra": [10.0, 10.1], "dec": [5.0, 5.1], "jd": [7389.5] * 2})
    with pytest.raises(InputError, match="add what was subtracted from the JD, such as 2450000"):
        Catalogue.of(table, "seen", options=CatalogueOptions(sigma=0.2))


def test_a_column_of_times_is_the_epoch_beside_angles():
    table = QTable({"ra": [1.0] * u.deg, "dec": [2.0] * u.deg, "obstime": Time([58849.0], format="mjd")})
    catalogue = Catalogue.of(table, "a", options=CatalogueOptions(sigma=0.2))
    assert catalogue.astrometry.epoch_jyr == pytest.approx([2020.0], abs=0.01)


def test_the_ellipses_of_2mass_at_the_x_match_service_are_its_errors():
    names = ("RAJ2000", "DEJ2000", "errHalfMaj", "errHalfMin", "errPosAng", "2MASS", "Jmag")
    error = chosen(made(*names)).error
    assert error.kind == "ellipse" and [c.name for c in error.columns] == list(names[2:5])


def test_positions_in_the_notation_of_astropy_are_read():
    table = {"ra": ["05ʰ32ᵐ47.461ˢ"], "dec": ["-00°06′30.5″"]}
    catalogue = Catalogue.of(table, "a", options=CatalogueOptions(sigma=0.2))
    assert catalogue.astrometry.ra_deg == pytest.approx([83.1977542], abs=1e-6)
    assert catalogue.astrometry.dec_deg == pytest.approx([-0.1084722], abs=1e-6)
