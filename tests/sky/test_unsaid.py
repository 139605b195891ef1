"""Metadata missing from a table: inferred, or assumed with a doubt; problems are refused all at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import FK4, SkyCoord
from astropy.io import fits
from astropy.table import MaskedColumn, Table
from scipy.spatial import cKDTree

import sameas
from sameas.errors import InputError
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.column_choice import SURVEYS
from sameas.sky.column_values import year_of
from sameas.sky.completion import common_error, completed, in_strips, nearest_chords
from sameas.sky.table_astrometry import typical_errors


def catalogue(table: Table | dict[str, object], name: str = "cat", **options: object) -> Catalogue:
    return Catalogue.of(table, name, options=CatalogueOptions(**options))  # type: ignore[arg-type]


def scattered(n: int, sigma_arcsec: float, seed: int, spread_deg: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) positions at declination 0, and the same measured again."""
    rng = np.random.default_rng(seed)
    place = np.column_stack([10.0 + spread_deg * rng.random(n), spread_deg * rng.random(n)])
    return place, place + sigma_arcsec / 3600.0 * rng.standard_normal((n, 2))


# Where: other frames, other spellings, an angle in several columns.


@pytest.mark.parametrize(("lon", "lat", "frame"), [("l", "b", "galactic"), ("GLON", "GLAT", "galactic")])
def test_galactic_positions_agree_with_astropy(lon: str, lat: str, frame: str) -> None:
    truth = SkyCoord([10.0, 200.0, 359.9] * u.deg, [-60.0, 5.0, 89.0] * u.deg)
    there = catalogue({lon: truth.galactic.l.deg, lat: truth.galactic.b.deg}, sigma=0.1)
    assert there.choice.frame == frame and "names of: galactic coordinates" in there.interpretation[0]
    apart = truth.separation(SkyCoord(*there.records().features.T * u.deg))
    # astropy goes by way of FK5, which is turned by 0.02 arcsec against ICRS; Hipparcos and Gaia do not.
    assert apart.max().arcsec < 0.03


def test_ecliptic_positions_agree_with_astropy_up_to_the_obliquity() -> None:
    truth = SkyCoord([10.0, 200.0, 359.9] * u.deg, [-60.0, 5.0, 89.0] * u.deg)
    ecliptic = truth.transform_to("barycentricmeanecliptic")
    there = catalogue({"ecl_lon": ecliptic.lon.deg, "ecl_lat": ecliptic.lat.deg}, sigma=0.1)
    assert truth.separation(SkyCoord(*there.records().features.T * u.deg)).max().arcsec < 0.06


def test_equatorial_coordinates_are_preferred_to_galactic_ones() -> None:
    both = catalogue({"l": [1.0], "b": [2.0], "ra": [3.0], "dec": [4.0]}, sigma=0.1)
    assert list(both.records().features[0]) == [3.0, 4.0]
    chosen = catalogue({"l": [1.0], "b": [2.0], "ra": [3.0], "dec": [4.0]}, sigma=0.1, ra="l", dec="b")
    assert chosen.choice.frame == "galactic"


def test_errors_along_galactic_axes_are_rotated() -> None:
    truth = SkyCoord(40.0 * u.deg, 20.0 * u.deg)
    table = Table({"l": [truth.galactic.l.deg], "b": [truth.galactic.b.deg], "l_error": [3.0], "b_error": [0.5]})
    table["l_error"].unit = table["b_error"].unit = u.arcsec
    xx, xy, yy = catalogue(table).records().covariance[0]
    # The direction of growing longitude, by a small step of astropy's.
    step = SkyCoord(truth.galactic.l + 0.001 * u.deg, truth.galactic.b, frame="galactic").icrs
    angle = truth.position_angle(step).rad
    axes = np.array([[np.sin(angle), np.cos(angle)], [-np.cos(angle), np.sin(angle)]])
    due = axes.T @ np.diag([9.0, 0.25]) @ axes
    np.testing.assert_allclose([xx, yy, xy], [due[0, 0], due[1, 1], due[0, 1]], atol=1e-3)


@pytest.mark.parametrize(
    ("ra", "dec", "unit"),
    [
        ("RA (J2000)", "Dec (J2000)", "deg"), ("R.A.", "Dec.", "deg"), ("RA [deg]", "DEC [deg]", "deg"),
        ("Right Ascension", "Declination", "deg"), ("RA (hours)", "Dec (deg)", "hourangle"),
    ],
)  # fmt: skip
def test_common_spellings_of_column_names_are_recognised(ra: str, dec: str, unit: str) -> None:
    choice = catalogue({ra: [12.0], dec: [4.0], "err (mas)": [80.0]}).choice
    assert (choice.ra.name, choice.dec.name, choice.ra.unit) == (ra, dec, unit)
    assert (choice.error.columns[0].name, choice.error.columns[0].unit) == ("err (mas)", "mas")


def test_an_angle_in_several_columns_is_read() -> None:
    table = Table({"RAh": [10, 0], "RAm": [0, 30], "RAs": [36.0, 0.0], "DE-": ["-", "+"], "DEd": [0, 20]})
    table["DEm"], table["DEs"] = [30, 15], MaskedColumn([36.0, 0.0], mask=[False, True])
    there = catalogue(table, sigma=0.1)
    np.testing.assert_allclose(there.records().features, [[150.15, -0.51], [7.5, 20.25]])
    assert "RAh [hours in RAh, RAm, RAs, by convention]" in there.interpretation[0]


def test_sextractors_world_ellipse_is_counted_from_east() -> None:
    table = Table({"X_WORLD": [10.0], "Y_WORLD": [0.0], "ERRA_WORLD": [2e-4], "ERRB_WORLD": [1e-4]})
    table["ERRTHETA_WORLD"] = [0.0]
    assert np.allclose(catalogue(table).records().covariance, [[0.72**2, 0.0, 0.36**2]])
    table["ALPHA_J2000"], table["DELTA_J2000"] = [11.0], [0.0]
    assert catalogue(table).records().features[0, 0] == 11.0


def test_errors_with_a_survey_prefix_are_recognised() -> None:
    assert catalogue({"ra": [1.0], "dec": [2.0], "xmm_poserr_arcsec": [1.5]}).records().covariance[0, 0] == 2.25


# When.


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("2017-12-19T18:33:43.317-0700", "2017-12-20T01:33:43.317"),
        ("2017-12-20T03:33:43+02:00", "2017-12-20T01:33:43"),
        ("2017-12-20T01:33:43Z", "2017-12-20T01:33:43"), ("2017-12-20 01:33:43+00", "2017-12-20T01:33:43"),
    ],
)  # fmt: skip
def test_a_date_with_a_time_zone_is_converted(text: str, same: str) -> None:
    assert year_of(text) == pytest.approx(year_of(same), abs=1e-9)


@pytest.mark.parametrize(("name", "value"), [("ref_epoch", 2016.0), ("obstime", 57388.5), ("mjd", 57388.5)])
def test_a_column_of_epochs_is_used_for_any_position_name(name: str, value: float) -> None:
    table = {"ALPHA_J2000": [1.0], "DELTA_J2000": [2.0], name: [value]}
    assert catalogue(table, sigma=0.1).epoch_jyr == pytest.approx(2016.0, abs=2e-3)
    assert catalogue(table | {name: [3.0]}, sigma=0.1).epoch_jyr is None  # the third visit is not an epoch


def test_the_epoch_is_assumed_if_only_the_other_catalogue_has_motions() -> None:
    moving = catalogue({"ra": [1.0], "dec": [2.0], "pmra": [5.0], "pmdec": [5.0]}, "moving", sigma=0.1, epoch=2016)
    still = catalogue({"ra": [1.0], "dec": [2.0]}, "still", sigma=0.1)
    (first, second), doubts = completed((moving, still))
    assert (first.epoch_jyr, second.epoch_jyr) == (2016.0, 2016.0)
    assert doubts[0].startswith("still: its epoch is not known; 2016 was assumed") and "give epoch2=YEAR" in doubts[0]
    assert completed((still, still))[1] == ()
    assert completed((still, still), 2010.0)[0][0].epoch_jyr == 2010.0


# How well.


@pytest.mark.parametrize(("survey", "magnitude", "mas"), [("Gaia DR3", 17.0, 0.05), ("2MASS", 9.5, 75.0)])
def test_missing_errors_of_a_survey_follow_from_magnitudes(survey: str, magnitude: float, mas: float) -> None:
    known = next(one for one in SURVEYS if one.title == survey)
    assert known.sigma_mas(np.array([magnitude]), 1)[0] == pytest.approx(mas)
    assert known.sigma_mas(None, 2).tolist() == [known.typical_mas] * 2


def test_a_gaia_table_without_errors_gets_those_of_its_release() -> None:
    table = {"source_id": [1, 2], "ra": [1.0, 2.0], "dec": [2.0, 3.0], "phot_g_mean_mag": [20.0, np.nan]}
    for epoch, faint, typical in ((2016.0, 0.4, 0.1), (2015.5, 0.7, 0.2)):
        source = catalogue(table | {"ref_epoch": [epoch] * 2})
        np.testing.assert_allclose(source.records().covariance[:, 0], [(1e-3 * faint) ** 2, (1e-3 * typical) ** 2])
    assert source.doubts[0].startswith(
        "no column of position errors: those of Gaia DR2 at its phot_g_mean_mag are assumed"
    )
    assert "give sigma=ARCSEC" in source.doubts[0]


def test_motions_without_errors_get_those_of_the_release() -> None:
    table = {
        "source_id": [1, 2, 3], "ra": [1.0, 2.0, 3.0], "dec": [2.0, 3.0, 4.0], "phot_g_mean_mag": [20.0, 15.0, 20.0],
        "pmra": [3.0, 4.0, np.nan], "pmdec": [5.0, 6.0, np.nan], "ref_epoch": [2016.0] * 3,
    }  # fmt: skip
    source = catalogue(table)
    due = [np.hypot(0.4, 10 * 0.5), np.hypot(0.015, 10 * 0.02)]
    found = 1e3 * np.sqrt(source.records(2026.0).covariance[:2, 0])
    # The proper motion's error is all but that of the parallax, which the table does not have.
    np.testing.assert_allclose(found, due, rtol=0.02)
    assert np.sqrt(source.records(2026.0).covariance[2, 0]) > 0.09
    records = catalogue(table, pm_sigma_mas_per_yr=7.0).records(2026.0)
    np.testing.assert_allclose(1e3 * np.sqrt(records.covariance[0, 0]), np.hypot(0.4, 70.0), rtol=0.02)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("sigma", [0.02, 0.3, 2.0])
@pytest.mark.parametrize("unrelated", [0, 300])
def test_a_common_error_is_estimated_from_the_distances(sigma: float, unrelated: int) -> None:
    here, there = scattered(600, sigma, seed=3)
    others, _ = scattered(unrelated, 1.0, seed=4)
    one = catalogue({"ra": here[:, 0], "dec": here[:, 1]}, "one")
    there = np.concatenate([there, others])
    two = catalogue({"ra": there[:, 0], "dec": there[:, 1]}, "two", sigma=1e-3)
    found, share = common_error(one, two)
    assert found == pytest.approx(sigma, rel=0.2) and share > 0.8
    both = catalogue({"ra": there[:, 0], "dec": there[:, 1]}, "both")
    assert common_error(one, both, shared=True)[0] == pytest.approx(sigma / np.sqrt(2.0), rel=0.2)


@pytest.mark.parametrize("nothing", [0.0, -1.0, np.nan])
def test_a_column_of_errors_without_any_is_as_no_column(nothing: float) -> None:
    place, again = scattered(300, 0.4, 5)
    first = Table({"ra": place[:, 0], "dec": place[:, 1], "e_pos": np.full(300, nothing)})
    found = sameas.match(first, Table({"ra": again[:, 0], "dec": again[:, 1]}), sigma2=0.01)
    assert len(found) == 300
    assert any("it has no position errors" in str(doubt) for doubt in found.doubts)


def test_two_catalogues_without_errors_get_the_same_one_whichever_moves() -> None:
    # What the years make of motions without an error counts from either side.
    here, there = scattered(600, 0.3, seed=3)
    pm = {"pmra": np.full(600, 3.0), "pmdec": np.zeros(600)}
    one = catalogue({"ra": here[:, 0], "dec": here[:, 1]} | pm, "one", epoch=2016.0, pm_sigma_mas_per_yr=10.0)
    two = catalogue({"ra": there[:, 0], "dec": there[:, 1]}, "two", epoch=2000.0)
    found = [common_error(*of, shared=True)[0] for of in ((one, two), (two, one))]
    assert found[0] == pytest.approx(found[1], rel=0.1)
    assert 2.0 * found[0] ** 2 + 0.16**2 == pytest.approx(0.3**2, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("covered", [1.0, 0.4])
def test_the_error_of_large_catalogues_is_estimated_from_strips(covered: float) -> None:
    rng = np.random.default_rng(7)
    ra, dec = rng.uniform(10.0, 11.0, 40_000), rng.uniform(-0.5, 0.5, 40_000)
    dec[:100] = 0.25  # a drift scan
    in_one, in_two = rng.random((2, 40_000)) < 0.8
    in_two &= dec < covered - 0.5
    one = Catalogue.of({"ra": ra[in_one] + rng.normal(0, 0.3, in_one.sum()) / 3600, "dec": dec[in_one]}, "one")
    two = Catalogue.of({"ra": ra[in_two], "dec": dec[in_two]}, "two")
    parts = in_strips(one, two, 8_000)
    assert sum(map(len, parts)) < 16_000
    for of in ((one, two), (two, one)):
        sigma, share = common_error(*of, shared=True, max_rows=8_000)
        whole, of_whole = common_error(*of, shared=True)
        assert sigma == pytest.approx(whole, rel=0.3)
        assert share == pytest.approx(of_whole, abs=0.15)
    flat = Catalogue.of({"ra": ra, "dec": np.zeros(len(ra))}, "flat")
    assert len(in_strips(flat, flat, 8_000)[0]) == len(flat)


@pytest.mark.parametrize("field", [1.0, 0.01, 0.0])
@pytest.mark.parametrize("most", [500, 10**6])
def test_neighbours_are_the_same_with_a_tree_and_without(field: float, most: int) -> None:
    """Over the whole sky, a small field, and where many lie in one place."""
    rng = np.random.default_rng(4)
    middle = np.array([0.6, -0.64, 0.48])
    one, two = (middle * (field < 1.0) + field * rng.normal(0.0, 1.0, (n, 3)) for n in (300, 2_000))
    two[:400] = two[0]
    one, two = (x / np.linalg.norm(x, axis=1)[:, None] for x in (one, two))
    chord, which = nearest_chords(one, two, 6, most)
    due, _ = cKDTree(two).query(one, k=6)
    np.testing.assert_allclose(chord, due, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(one[:, None] - two[which], axis=2), due, rtol=1e-12, atol=1e-15)
    assert all(len(set(row)) == 6 for row in which)


def test_a_common_error_is_reported_with_its_value() -> None:
    here, there = scattered(300, 0.3, seed=5)
    one = catalogue({"ra": here[:, 0], "dec": here[:, 1]}, "one", sigma=0.01)
    two = catalogue({"ra": there[:, 0], "dec": there[:, 1]}, "two")
    with pytest.raises(InputError, match=r"two: no column of position errors \(plain names\); give sigma=ARCSEC"):
        two.records()
    (_, second), (doubt,) = completed((one, two))
    sigma = second.choice.error.sigma_arcsec
    assert sigma == pytest.approx(0.3, rel=0.2) and second.records().covariance[0, 0] == pytest.approx(sigma**2)
    assert doubt.startswith(
        f"two: it has no position errors; {sigma:.2g} arcsec on each axis was assumed, estimated from "
    )
    assert doubt.endswith("the distances to one; give sigma2=ARCSEC or sigma2=COLUMN")


def test_disjoint_catalogues_get_a_default_error() -> None:
    one = catalogue({"ra": [10.0, 11.0], "dec": [0.0, 0.0]}, "one")
    two = catalogue({"ra": [200.0], "dec": [50.0]}, "two", sigma=0.1)
    (first, _), (doubt,) = completed((one, two))
    assert 0.2 < first.choice.error.sigma_arcsec < 0.4 and "its records do not lie near those of two" in doubt


def test_the_unit_of_errors_is_inferred_from_the_distances() -> None:
    here, there = scattered(300, 0.05, seed=6)
    one = catalogue({"ra": here[:, 0], "dec": here[:, 1]}, "one", sigma=0.001)
    two = catalogue(
        {"ra": there[:, 0], "dec": there[:, 1], "err": np.full(300, 0.05 / 3600 * 1e3)}, "two", sigma_unit=None
    )
    assert two.choice.error.columns[0].unit == "arcsec"  # 0.014
    assert completed((one, two))[1] == ()
    mas = catalogue({"ra": there[:, 0], "dec": there[:, 1], "err": np.full(300, 4.0)}, "two")
    tiny = catalogue({"ra": here[:, 0], "dec": here[:, 1]}, "one", sigma=0.0001)
    near = catalogue({"ra": here[:, 0] + 5e-7, "dec": here[:, 1], "err": np.full(300, 2.0)}, "two")
    (_, second), (doubt,) = completed((tiny, near))
    assert second.choice.error.columns[0].unit == "mas" and "mas fits the distances" in doubt
    assert mas.choice.error.guessed_unit


def test_a_copy_of_a_catalogue_determines_no_unit_and_no_error() -> None:
    rng = np.random.default_rng(3)
    lon, lat = rng.uniform(10.0, 10.2, 400), rng.uniform(20.0, 20.2, 400)
    one = {"ra": lon, "dec": lat, "sigma": np.full(400, 0.2)}
    two = {"ra": lon + rng.normal(0.0, 8e-5, 400), "dec": lat + rng.normal(0.0, 8e-5, 400), "sigma": np.full(400, 0.2)}
    tables = [Catalogue.of(table, name) for table, name in ((one, "one"), (two, "two"), (one, "again"))]
    for some in (tables, tables[::2]):
        made, doubts = completed(some)
        assert [each.choice.error.columns[0].unit for each in made] == ["arcsec"] * len(some)
        assert not any("fits the distances" in doubt for doubt in doubts)
    bare = [Catalogue.of({"ra": table["ra"], "dec": table["dec"]}, str(k)) for k, table in enumerate((one, two, one))]
    found = [each.choice.error.sigma_arcsec for each in completed(bare)[0]]
    assert all(0.1 < sigma < 0.5 for sigma in found)


def test_empty_errors_are_filled_on_request() -> None:
    rng = np.random.default_rng(7)
    magnitude = rng.uniform(10.0, 20.0, 1000)
    sigma = 0.01 * 10.0 ** (0.2 * (magnitude - 10.0))
    empty = np.arange(1000) % 10 == 0
    sigma[empty] = 0.0
    table = Table({"ra": 10.0 + rng.random(1000), "dec": rng.random(1000), "mag": magnitude})
    table["pos_err_arcsec"] = MaskedColumn(sigma, mask=np.arange(1000) % 20 == 0)
    assert len(catalogue(table).records()) == 900
    filled = catalogue(table, fill_errors=True)
    found = np.sqrt(filled.records().covariance[empty, 0])
    np.testing.assert_allclose(found, 0.01 * 10.0 ** (0.2 * (magnitude[empty] - 10.0)), rtol=0.15)
    assert filled.doubts[0].startswith(
        "100 rows have no position error and were given the typical one of their magnitude"
    )
    assert np.isnan(typical_errors(np.array([np.nan, 0.0]), None)).all()


# Which rows.


def test_duplicate_rows_are_reported() -> None:
    rng = np.random.default_rng(8)
    table = Table({"ra": rng.random(100), "dec": rng.random(100), "name": [f"s{k}" for k in range(100)]})
    table["flux"] = MaskedColumn(rng.random(100), mask=np.arange(100) == 3)
    assert not any("twice" in doubt for doubt in catalogue(table, sigma=0.1).doubts)
    twice = table[[*range(100), 3, 4, 5]]
    message = "3 of 103 rows are given twice (first: rows"
    assert any(doubt.startswith(message) for doubt in catalogue(twice, sigma=0.1).doubts)
    twice["name"][100:] = ["a", "b", "c"]
    message = "3 of 103 rows have exactly the position of another row"
    assert any(doubt.startswith(message) for doubt in catalogue(twice, sigma=0.1).doubts)


def test_a_frame_table_of_sameas_has_errors_and_epoch_and_measured_stars_only() -> None:
    table = Table({"ra_deg": [10.0, 11.0, 12.0], "dec_deg": [1.0, 2.0, 3.0]}, meta={"REFEPOCH": 1951.9})
    table["measurement"] = MaskedColumn([0, 1, 0], mask=[False, False, True])
    for name, square in (("ee", 0.04), ("en", 0.01), ("nn", 0.09)):
        table[f"cov_{name}_arcsec2"] = np.full(3, square)
        table[f"cov_{name}_arcsec2"].unit = "arcsec2"
    source = catalogue(table)
    assert source.epoch_jyr == 1951.9 and list(source.records().rows) == [0, 1]
    np.testing.assert_allclose(source.records().covariance, [[0.04, 0.01, 0.09]] * 2)
    assert "1 row is a star that was not measured, and is set aside" in source.doubts


def test_all_problems_are_reported_at_once() -> None:
    with pytest.raises(InputError) as refused:
        catalogue({"ra": [1.0], "dec": [2.0]}, sigma="nosuch", id="nobody", magnitude="dark")
    for words in ("'nosuch' for sigma", "'nobody' for id", "'dark' for magnitude"):
        assert words in str(refused.value)


@pytest.mark.parametrize("names", [("RAB1950", "DEB1950"), ("ra1950", "dec1950"), ("RA_B1950", "DEC_B1950")])
def test_positions_of_the_equinox_b1950_agree_with_astropy(names: tuple[str, str]) -> None:
    old = SkyCoord([10.0, 200.0, 359.99, 80.0] * u.deg, [-5.0, 60.0, 0.01, 89.5] * u.deg, frame=FK4(equinox="B1950"))
    there = catalogue(dict(zip(names, (old.ra.deg, old.dec.deg), strict=True)), sigma=0.1)
    assert there.choice.frame == "B1950" and "equinox B1950, FK4" in there.interpretation[0]
    found = SkyCoord(*there.records().features.T * u.deg)
    # FK5 and ICRS differ by 0.025 arcsec.
    assert found.separation(old.transform_to("icrs")).arcsec.max() < 0.04


def test_sexagesimal_positions_of_b1950_are_hours_and_their_motions_are_not_used() -> None:
    old = SkyCoord("12h00m10.00s +30d00m05.0s", frame=FK4(equinox="B1950"))
    there = catalogue({"RAB1950": ["12 00 10.00"], "DEB1950": ["+30 00 05.0"], "pmRA": [5.0], "pmDE": [5.0]}, sigma=0.1)
    assert SkyCoord(*there.records().features.T * u.deg).separation(old.transform_to("icrs")).arcsec.max() < 0.04
    assert "motion: none" in there.interpretation


@pytest.mark.parametrize(
    ("meta", "frame"),
    [({"RADESYS": "FK4"}, "B1950"), ({"coosys_system": "eq_FK4"}, "B1950"), ({"EQUINOX": 1950.0}, "B1950"),
     ({"RADESYS": "FK5", "EQUINOX": 1950.0}, "icrs"), ({"EQUINOX": 2000.0}, "icrs")],
)  # fmt: skip
def test_a_header_states_the_equinox_unless_the_columns_do(meta: dict[str, object], frame: str) -> None:
    table = Table({"ra": [10.0], "dec": [20.0]}, meta=meta)
    assert catalogue(table, sigma=0.1).choice.frame == frame
    assert catalogue(Table({"RAJ2000": [10.0], "DEJ2000": [20.0]}, meta=meta), sigma=0.1).choice.frame == "icrs"


def test_a_catalogue_of_b1950_read_as_j2000_is_named_as_such() -> None:
    rng = np.random.default_rng(1)
    new = SkyCoord(rng.uniform(10.0, 11.5, 400) * u.deg, rng.uniform(40.0, 41.0, 400) * u.deg)
    old = new[:150].transform_to(FK4(equinox="B1950"))
    found = sameas.match(
        {"alpha": old.ra.deg, "delta": old.dec.deg}, {"ra": new.ra.deg, "dec": new.dec.deg},
        ra1="alpha", dec1="delta", sigma=0.3,
    )  # fmt: skip
    assert any("of the equinox B1950" in str(doubt) and "ra1950" in str(doubt) for doubt in found.doubts)


def test_columns_that_may_be_the_position_error_are_listed_with_the_option() -> None:
    table = Table(
        {"ra": [1.0], "dec": [2.0], "E_MAJ_ERR": [1.0], "E_MIN_ERR": [0.5], "E_PA_ERR": [30.0], "FLUX_ERR": [1.0]}
    )
    table["E_MAJ_ERR"].unit = table["E_MIN_ERR"].unit = u.arcsec
    table["E_PA_ERR"].unit = u.deg
    notes = "\n".join(map(str, catalogue(table).choice.notes))
    assert "E_MAJ_ERR, E_MIN_ERR, E_PA_ERR not used; if they are the position's, give " in notes
    assert "ellipse='E_MAJ_ERR,E_MIN_ERR,E_PA_ERR'" in notes and "FLUX_ERR" not in notes


def test_the_error_ellipse_and_magnitude_of_2mass_are_known_with_decl_too() -> None:
    table = {"ra": [1.0], "decl": [2.0], "err_maj": [0.1], "err_min": [0.08], "err_ang": [45.0], "k_m": [14.0]}
    there = catalogue(table)
    assert there.choice.error.kind == "ellipse" and there.choice.magnitude == "k_m"


def test_a_fits_table_without_positions_names_the_other_tables_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "events.fits"
    tables = [Table({"start": [1.0]}), Table({"ra": [1.0], "dec": [2.0]})]
    hdus = [
        fits.PrimaryHDU(),
        *(fits.BinTableHDU(table, name=n) for table, n in zip(tables, ("GTI", "SRCLIST"), strict=True)),
    ]
    fits.HDUList(hdus).writeto(path)
    with pytest.raises(InputError, match=r"extensions 1 \(GTI\), 2 \(SRCLIST\); used 1.*give hdu1=NAME"):
        sameas.match(path, {"ra": [1.0], "dec": [2.0]}, sigma=0.1)


def test_errors_of_right_ascension_in_seconds_of_time_are_15_cos_dec_arcsec() -> None:
    """As in the radio surveys at the CDS (NVSS, VIII/65)."""
    table = Table({"RAJ2000": [10.0, 20.0], "DEJ2000": [60.0, 0.0]})
    table["e_RAJ2000"], table["e_DEJ2000"] = [0.1, 0.03] * u.s, [0.6, 0.5] * u.arcsec
    there = catalogue(table)
    assert "s of right ascension" in there.interpretation[1]
    assert np.sqrt(there.records().variances) == pytest.approx(np.array([[0.75, 0.6], [0.45, 0.5]]))
    table["e_DEJ2000"].unit = u.s
    with pytest.raises(InputError, match="'e_DEJ2000' is in s, which is not an angle"):
        catalogue(table)


def test_errors_of_positions_in_parts_are_those_of_their_seconds() -> None:
    table = Table({"RAh": [1], "RAm": [2], "RAs": [3.0], "DE-": ["-"], "DEd": [60], "DEm": [0], "DEs": [0.0]})
    table["e_RAs"], table["e_DEs"] = [0.1] * u.s, [0.6] * u.arcsec
    assert np.sqrt(catalogue(table).records().variances) == pytest.approx(np.array([[0.75, 0.6]]))


def test_rows_without_proper_motion_are_counted_with_the_scatter_that_is_assumed() -> None:
    table = {
        "ra": [1.0, 2.0],
        "dec": [2.0, 3.0],
        "pmra": [5.0, np.nan],
        "pmdec": [5.0, np.nan],
        "ref_epoch": [2016.0, 2016.0],
    }
    notes = [str(note) for note in catalogue(table, sigma=0.1).choice.notes]
    assert notes == ["1 of 2 rows has no proper motion: 0 ± 10 mas/yr on each axis is assumed; give missing_pm=MAS/YR"]
    notes = [str(note) for note in catalogue(table, sigma=0.1, missing_pm_mas_per_yr=25.0).choice.notes]
    assert notes == ["1 of 2 rows has no proper motion: 0 ± 25 mas/yr on each axis is assumed"]
    assert not catalogue({"ra": [1.0], "dec": [2.0], "pmra": [np.nan], "pmdec": [np.nan]}, sigma=0.1).choice.notes


def test_residuals_of_catalogues_without_motions_may_be_motions():
    """The doubt asked for the units of the errors only."""
    rng, n = np.random.default_rng(5), 300
    ra, dec = rng.uniform(150.0, 150.4, n), rng.uniform(-0.2, 0.2, n)
    motion = 16.0 * rng.normal(0.0, 0.3, (2, n)) / 3600.0
    tables = {"ra": ra, "dec": dec, "id": np.arange(n)}, {"ra": ra + motion[0], "dec": dec + motion[1]}
    found = sameas.match(*tables, sigma=0.02, epoch1=2000, epoch2=2016)
    said = next(doubt for doubt in found.doubts if "residuals are" in doubt)
    assert said.endswith("are their units right? Or have objects moved farther in 16 years than missing_pm says?")


def test_fields_that_lie_apart_are_one_doubt():
    """That no object is common, and that pairs are too few, follows."""
    rng, n = np.random.default_rng(6), 200
    ra, dec = rng.uniform(150.0, 150.2, n), rng.uniform(-0.1, 0.1, n)
    found = sameas.match({"ra": ra, "dec": dec}, {"ra": ra + 20.0, "dec": dec}, sigma=0.2)
    assert [doubt.partition(":")[0] for doubt in found.doubts] == ["the fields lie apart"]


def test_the_doubt_about_tiny_residuals_states_those_of_the_report():
    """It stated 0.17, the smallest scale that is tried, beside a median residual of 0.05 in the report."""
    rng, n = np.random.default_rng(7), 200
    ra, dec = rng.uniform(150.0, 150.4, n), rng.uniform(-0.2, 0.2, n)
    one, two = (
        {"ra": ra + rng.normal(0.0, 0.05, n) / 3600, "dec": dec + rng.normal(0.0, 0.05, n) / 3600} for _ in (1, 2)
    )
    found = sameas.match(one, two, sigma=1.0)
    said = next(doubt for doubt in found.doubts if "residuals are" in doubt)
    stated = float(said.removeprefix("the residuals are ").partition(" ")[0])
    assert stated == pytest.approx(0.05, abs=0.01) and stated == pytest.approx(
        found.estimate.quantities["error_scale"].value, rel=0.1
    )
