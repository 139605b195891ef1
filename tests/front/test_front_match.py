"""`sameas.match`: all input types, and the methods of the result."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import MaskedColumn, QTable, Table
from astropy.time import Time
from guises import GUISES

import sameas
from sameas import InputError, Records, Sphere
from sameas.evidence import Column
from sameas.front.tables import odds_of, table_of
from sameas.io import read_provenance, read_table
from sameas.sky import Catalogue, CatalogueOptions


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("guise", GUISES)
def test_all_input_types_give_the_same_match(stars, in_memory, guise):
    first, second = GUISES[guise](stars.first), GUISES[guise](stars.second)
    found = sameas.match(first, second, sigma=0.05)
    assert found.pairs["row_2"].tolist() == stars.partner().tolist() == in_memory.pairs["row_2"].tolist()
    assert np.allclose(found.pairs["p_match"], in_memory.pairs["p_match"], atol=1e-9)
    assert len(found.table) == len(stars.ra) and found.table["sep_arcsec"].unit == "arcsec"


def test_input_types_can_be_mixed(stars):
    found = sameas.match(GUISES["skycoord"](stars.first), GUISES["lazy polars"](stars.second), sigma=0.05)
    assert len(found) == len(stars.ra) and found.sky.moved.startswith("first moved from 2016.00 to 2000.00")


def test_paths_and_catalogues(stars, tmp_path):
    path = tmp_path / "plate.fits"
    Table(stars.second).write(path)
    options = CatalogueOptions(sigma=0.05)
    for second in (path, str(path), Catalogue.of(stars.second, "plate", options=options)):
        sigma = {} if isinstance(second, Catalogue) else {"sigma2": 0.05}
        found = sameas.match(stars.first, second, sigma1=0.05, **sigma)
        assert found.names == ("first", "plate") and len(found) == len(stars.ra)


@pytest.mark.parametrize("end", ["ecsv", "fits"])
def test_a_column_of_skycoord_in_a_file_is_that_in_memory(stars, tmp_path, end):
    place = GUISES["skycoord"](stars.first)
    table = QTable({"place": place, "seen": Time(np.full(len(place), 57000.0), format="mjd")})
    table.write(tmp_path / f"first.{end}")
    found = sameas.match(tmp_path / f"first.{end}", stars.second, sigma=0.05)
    in_memory = sameas.match(table, stars.second, sigma=0.05)
    assert found.pairs["row_2"].tolist() == in_memory.pairs["row_2"].tolist()
    assert found.sky.moved == in_memory.sky.moved


def test_the_command_and_python_write_equal_tables(stars, tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from sameas.cli.app import app

    monkeypatch.chdir(tmp_path)
    Table(stars.first).write("first.fits"), Table(stars.second).write("second.fits")
    arguments = ["--sigma1", "0.05", "--sigma2", "0.06"]
    printed = CliRunner().invoke(app, ["match", "first.fits", "second.fits", *arguments, "-o", "command.ecsv"]).stdout
    found = sameas.match("first.fits", "second.fits", sigma1=0.05, sigma2=0.06)
    found.write("python.ecsv")
    as_said = printed.split("\nOutput:")[0].replace("--pm-sigma1 ", "pm_sigma1=")
    assert found.report().split() == as_said.split()
    of_command, of_python = read_table("command.ecsv"), read_table("python.ecsv")
    assert of_command.colnames == of_python.colnames
    for name in of_command.colnames:
        assert np.array_equal(np.ma.filled(of_command[name], 0), np.ma.filled(of_python[name], 0)), name
    command, python = read_provenance("command.ecsv"), read_provenance("python.ecsv")
    assert command.pop("command").startswith("sameas match first.fits second.fits --sigma1 0.05")
    assert python.pop("command") == "sameas.match('first.fits', 'second.fits', sigma1=0.05, sigma2=0.06)"
    differ = {key for key in command if command[key] != python[key]} | (command.keys() ^ python.keys())
    assert differ <= {"date_utc", "options_1", "options_2", "doubts"}  # options come as text from a command line


def test_a_galactic_skycoord_is_transformed_to_icrs_with_its_motion(stars):
    first = GUISES["skycoord"](stars.first).galactic
    found = sameas.match(first, stars.second, sigma=0.05)
    assert found.pairs["row_2"].tolist() == stars.partner().tolist()


def test_a_skycoord_with_times_of_its_own_and_distances():
    place = SkyCoord(
        [10.0, 10.1] * u.deg, [20.0, 20.1] * u.deg, distance=[10.0, 20.0] * u.pc,
        pm_ra_cosdec=[1.0, 2.0] * u.mas / u.yr, pm_dec=[3.0, 4.0] * u.mas / u.yr,
        radial_velocity=[5.0, 6.0] * u.km / u.s, obstime=Time([2016.0, 2015.0], format="jyear"),
    )  # fmt: skip
    found = sameas.match(place, {"ra": [10.0], "dec": [20.0], "epoch": [2016.0]}, sigma=0.1)
    astrometry = found.sky.first.astrometry
    assert np.allclose(astrometry.epoch_jyr, [2016.0, 2015.0]) and np.allclose(astrometry.parallax_mas, [100.0, 50.0])
    assert np.allclose(astrometry.pm_ra_mas_per_yr, [1.0, 2.0])
    assert np.allclose(astrometry.radial_velocity_km_per_s, [5.0, 6.0])


def test_masked_quantities_and_times_survive_the_join():
    first = QTable({
        "ra": [10.0, 10.1, 10.2] * u.deg, "dec": [20.0, 20.1, 20.2] * u.deg,
        "flux": MaskedColumn([1.0, 2.0, 3.0], mask=[False, True, False], unit="Jy"),
        "seen": Time([2016.0, 2016.1, 2016.2], format="jyear"),
    })  # fmt: skip
    found = sameas.match({"ra": [10.1, 50.0], "dec": [20.1, 0.0]}, first, sigma=0.1)
    table = found.joined("1or2")
    assert table["flux"].unit == "Jy" and table["flux"].mask.sum() == 2
    alone = table[table["ra_1"].mask]
    assert np.allclose(alone["seen"].jyear, [2016.0, 2016.2]) and table["seen"].mask.sum() == 1
    assert alone["flux"].tolist() == [1.0, 3.0]


def test_nulls_of_data_frames_are_masked():
    polars = pytest.importorskip("polars")
    first = polars.DataFrame({"ra": [10.0, None, 10.2], "dec": [20.0, 20.1, 20.2], "name": ["a", "b", None]})
    found = sameas.match(first, {"ra": [10.0], "dec": [20.0]}, sigma=0.1)
    assert found.identification.first.set_aside.rows.tolist() == [1]
    assert found.table["name"].tolist() == ["a", "b", None]


def test_an_index_of_names_is_kept():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"ra": [10.0, 10.1], "dec": [20.0, 20.1]}, index=pandas.Index(["x", "y"], name="id"))
    found = sameas.match(frame, {"ra": [10.1], "dec": [20.1]}, sigma=0.1)
    assert found.pairs["id_1"].tolist() == ["y"]
    assert "y" in str(found.explain("y")) and str(found.explain(row=1)) == str(found.explain("y"))


def test_quantities_and_times_as_options(stars):
    first = {name: values for name, values in stars.first.items() if name != "ref_epoch"}
    with_units = sameas.match(first, stars.second, sigma=50 * u.mas, epoch1=Time(2016.0, format="jyear"))
    plain = sameas.match(first, stars.second, sigma=0.05, epoch1=2016.0)
    assert np.allclose(with_units.pairs["log_odds"], plain.pairs["log_odds"])


def test_errors_by_names_of_columns(stars):
    first = stars.first | {"east": np.full(120, 0.05), "north": np.full(120, 0.06)}
    found = sameas.match(first, stars.second, sigma1=("east", "north"), sigma_unit1="arcsec", sigma2=0.05)
    assert np.allclose(found.sky.first.astrometry[:].position_covariance[:, [0, 1], [0, 1]], [2500.0, 3600.0])


def test_every_join_and_its_default(stars, in_memory):
    assert in_memory.table.colnames == in_memory.joined("all1").colnames and len(in_memory.joined("1not2")) == 0
    found = sameas.match(stars.first, stars.second, sigma=0.05, join="1and2", nway_columns=True)
    assert "p_any" in found.table.colnames


def test_records_give_indices():
    rng = np.random.default_rng(2)
    place = rng.uniform(0.0, 1000.0, (60, 2))
    radar = Records.of(place, sigma=1.0, ids=[f"R{k}" for k in range(60)], source="radar")
    ais = Records.of(place[:40] + rng.standard_normal((40, 2)), sigma=1.0, source="ais")
    found = sameas.match(radar, ais)
    assert found.sky is None and len(found) == len(found.pairs) >= 38
    assert found.pairs.colnames[:5] == ["row_1", "row_2", "id_1", "id_2", "p_match"]
    assert np.allclose(found.pairs["separation"], np.hypot(*found.identification.matches.residual.T))
    assert set(found.table.colnames) >= {"row_1", "id_1", "p_none", "residual_1", "residual_2"}
    assert len(found.table) == 60 and len(found.joined("2not1")) == 40 - len(found)
    assert "common objects" in found.report() and "radar R3 (row 3)" in str(found.explain("R3"))
    assert sameas.match(radar, ais, error_scale=1).estimate.errors == sameas.Errors()


def test_records_on_the_sphere_keep_their_table():
    place = np.array([[10.0, 20.0], [10.1, 20.1]])
    table = Table({"star": ["a", "b"]})
    first = Records.of(place, sigma=0.1, space=Sphere(), source="one", table=table)
    found = sameas.match(first, Records.of(place[:1], sigma=0.1, space=Sphere(), source="two"))
    assert found.table["star"].tolist() == ["a", "b"] and found.table["sep_arcsec"].unit == "arcsec"


def test_a_written_table_has_its_provenance(stars, in_memory, tmp_path):
    path = tmp_path / "out.fits"
    in_memory.write(path)
    facts = read_provenance(path)
    assert facts["command"] == "sameas.match(dict, dict, sigma=0.05)" and facts["input_1"] == "dict in memory"
    assert facts["pairs"] == len(in_memory) and len(read_table(path)) == len(stars.ra)
    in_memory.write(path, "1and2")
    with pytest.raises(InputError, match=r"out\.fits.* exists"):
        in_memory.write(path, overwrite=False)


def test_an_output_that_is_an_input_is_refused(stars, tmp_path):
    path = tmp_path / "first.fits"
    Table(stars.first).write(path)
    found = sameas.match(path, stars.second, sigma=0.05)
    with pytest.raises(InputError, match="is also an input"):
        found.write(path)


def test_plots_by_name(in_memory):
    pytest.importorskip("matplotlib")
    assert in_memory.plot().axes and in_memory.plot("normalised").axes
    with pytest.raises(InputError, match="there is no plot 'residual'; give one of residuals, "):
        in_memory.plot("residual")


REFUSED: dict[str, dict[str, Any]] = {
    "match has no option 'sigm1'; did you mean sigma1": {"sigm1": 0.1},
    "match has no option 'to_epock'; did you mean to_epoch": {"to_epock": 2000},
    "match has no option 'column2'; give evidence=Column\\(2, \"NAME\"\\), of sameas.evidence": {"column2": "MAG"},
    "match has no option 'zzz'; see its documentation": {"zzz": 1},
    "match has no option 'radius', for it needs none: how far to look follows from the errors": {"radius": 1.0},
    "first: no column 'rra' for ra1; did you mean 'ra'": {"ra1": "rra", "sigma": 0.1},
    "join 'both' is not known; choose one of": {"join": "both", "sigma": 0.1},
    "error scale is 'x'": {"error_scale": "x", "sigma": 0.1},
    "plate: no column 'x' for epoch2": {"names": ("gaia", "plate"), "epoch2": "x", "sigma": 0.1},
}


@pytest.mark.parametrize("words", REFUSED)
def test_refusals_name_the_options_as_python_has_them(stars, words):
    with pytest.raises(InputError, match=words):
        sameas.match(stars.first, stars.second, **REFUSED[words])


def test_input_without_positions_is_refused(stars, in_memory):
    for wrong, words in ((3, "int does not hold positions; give a path"), ([1, 2], "list does not"),
                         (np.zeros((3, 2)), "numpy ndarray does not hold positions")):  # fmt: skip
        with pytest.raises(InputError, match=words):
            sameas.match(wrong, stars.second)
    catalogue = Catalogue.of(stars.first, "gaia", options=CatalogueOptions(sigma=0.1))
    with pytest.raises(InputError, match="gaia: a Catalogue's columns are chosen already, so sigma1 changes nothing"):
        sameas.match(catalogue, stars.second, sigma1=0.3)
    with pytest.raises(InputError, match="Records are matched with Records, not with a dict"):
        sameas.match(in_memory.identification.first, stars.second)
    with pytest.raises(InputError, match="give the id of a record, or row=NUMBER"):
        in_memory.explain()
    with pytest.raises(InputError, match="first has no row 500; it has rows 0 to 119"):
        in_memory.explain(row=500)
    place = GUISES["skycoord"](stars.first)
    with pytest.raises(InputError, match=r"2 candidates .*: a_ra, a_dec; b_ra, b_dec; give ra1='a_ra' dec1='a_dec'"):
        sameas.match(QTable({"a": place, "b": place}), stars.second)


def test_the_corners_of_sources_are_no_positions(stars):
    """Catalogues of JWST have a SkyCoord for the centroid and for each corner of the box; they were refused."""
    place = GUISES["skycoord"](stars.first)
    table = table_of(QTable({"sky_bbox_ll": place, "sky_centroid": place, "sky_bbox_ur": place}), "jwst")
    assert [name for name in table.colnames if "bbox" not in name][:2] == ["ra", "dec"]
    assert {"sky_bbox_ll_ra", "sky_bbox_ur_dec"} < set(table.colnames)


def test_doubts_name_the_argument_of_their_catalogue():
    gaia = {
        "ra": [10.0, 10.1],
        "dec": [0.0, 0.0],
        "pmra": [1.0, 2.0],
        "pmdec": [0.0, 1.0],
        "phot_g_mean_mag": [15.0, 16.0],
    }
    found = sameas.match(gaia, {"ra": [10.0, 10.1], "dec": [0.0, 0.0]}, sigma2=0.1, epoch2=2000.0)
    for words in ("give epoch1=YEAR", "give pm_sigma1=MAS_PER_YR"):
        assert any(words in doubt for doubt in found.doubts) and words in repr(found)
    of_gaia = [doubt for doubt in found.doubts if "epoch is not stated" in doubt or "no column of errors" in doubt]
    assert len(of_gaia) == 2 and all(doubt.startswith("first: ") for doubt in of_gaia)
    assert (
        "pm_sigma1=MAS_PER_YR" in " ".join(found.report().split()) and max(map(len, found.report().splitlines())) <= 100
    )


def test_one_table_given_twice_is_doubted(stars):
    found = sameas.match(stars.first, (same := Table(stars.second)), sigma=0.05)
    assert not any("given twice" in doubt for doubt in found.doubts)
    found = sameas.match(same, same, sigma=0.05)
    assert "one astropy Table is given twice" in found.doubts[0] and "given twice" in found.report()


@pytest.mark.slow
def test_duplicate_objects_with_their_own_errors_are_doubted():
    rng = np.random.default_rng(4)
    place, sigma = rng.uniform([40.0, 0.0], [40.05, 0.05], (600, 2)), 0.2 / 3600.0

    def exposure(share: float) -> np.ndarray:
        return (place + rng.normal(0.0, sigma, place.shape))[rng.random(600) < share]

    def table(*exposures: np.ndarray) -> Table:
        ra, dec = np.concatenate(exposures).T
        return Table({"ra": ra, "dec": dec, "pos_err_arcsec": np.full(len(ra), 0.2)})

    once = sameas.match(table(exposure(0.9)), table(exposure(0.9)))
    assert not any("couples" in str(doubt) for doubt in once.sky.doubts)
    twice = sameas.match(table(exposure(0.9)), table(exposure(0.7), exposure(0.7)))
    (doubt,) = (str(doubt) for doubt in twice.sky.doubts if "couples" in str(doubt))
    assert doubt.startswith("in second ") and "one object given twice" in doubt and "sameas internal" in doubt


def test_an_object_in_several_rows_is_not_said_to_be_a_blend():
    """Its other rows lie beside the pair without partner, as neighbours do that are not resolved."""
    rng = np.random.default_rng(0)
    place = rng.uniform([40.0, 0.0], [40.05, 0.05], (600, 2))
    sigma, seen = rng.uniform(0.05, 0.4, 600)[:, None] / 3600.0, rng.random(600) < 0.9
    measured = [place + sigma * rng.normal(0.0, 1.0, place.shape) for _ in range(4)]
    rows = np.concatenate([exposure[seen & (rng.random(600) < 0.8)] for exposure in measured])
    first, second = ({"ra": one[:, 0], "dec": one[:, 1]} for one in (rows, place))
    doubts = [str(doubt) for doubt in sameas.match(first, second, sigma2=0.01).doubts]
    assert any("couples of records" in doubt for doubt in doubts)
    assert not any("two objects of first as one" in doubt for doubt in doubts)


@pytest.mark.slow
def test_data_frame_libraries_are_imported_only_for_data_frames():
    program = (
        "import sys, sameas; sameas.match({'ra': [1.0, 2.0], 'dec': [1.0, 2.0]}, {'ra': [1.0], 'dec': [1.0]}, sigma=1);"
        "print(sorted({'pandas', 'polars', 'matplotlib'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_column_names_that_are_no_text_or_repeated(stars):
    """Data frames have numbers, tuples and twins for names."""
    pandas, pyarrow = pytest.importorskip("pandas"), pytest.importorskip("pyarrow")
    frame = pandas.DataFrame(stars.first)
    numbered = frame.assign(**{"0": 1.0}).rename(columns={"0": 0})
    assert len(sameas.match(numbered, stars.second, sigma=0.05)) == len(stars.ra)
    leveled = pandas.concat({"one": frame}, axis=1)
    found = sameas.match(leveled, stars.second, sigma=0.05, ra1="one_ra", dec1="one_dec")
    assert len(found) and "one_ra" in found.table.colnames
    twins = pandas.concat([frame, frame[["ra"]]], axis=1)
    with pytest.raises(InputError, match="first: two columns are called ra; rename one"):
        sameas.match(twins, stars.second, sigma=0.05)
    with pytest.raises(InputError, match="first: two columns are called a; rename one"):
        sameas.match(pyarrow.Table.from_arrays([pyarrow.array([1.0])] * 2, names=["a", "a"]), stars.second)
    for alone in (frame["ra"], pyarrow.array([1.0])):
        with pytest.raises(InputError, match="does not hold positions"):
            sameas.match(alone, stars.second)


def test_rows_that_are_dicts_are_a_table(stars):
    names = list(stars.second)
    rows = [dict(zip(names, cells, strict=True)) for cells in zip(*stars.second.values(), strict=True)]
    assert len(sameas.match(stars.first, rows, sigma=0.05)) == len(stars.ra)


@pytest.mark.parametrize("values", [np.full(3, 0.1), np.full(3, 0.1) * u.arcsec])
def test_an_option_takes_one_value_for_all_rows(stars, values):
    with pytest.raises(InputError, match="sigma1 has 3 values, one for a row; make them a column of the table"):
        sameas.match(stars.first, stars.second, sigma1=values)


def test_categories_of_polars_are_text(stars):
    polars = pytest.importorskip("polars")
    kinds = polars.Series(["a", None, "bé"] * len(stars.ra), dtype=polars.Categorical)[: len(stars.ra)]
    frame = polars.DataFrame(stars.first).with_columns(kind=kinds)
    found = sameas.match(frame, stars.second, sigma=0.05)
    assert len(found) == len(stars.ra)
    assert found.table["kind"].filled("-").tolist()[:3] == ["a", "-", "bé"]


def test_a_right_ascension_that_is_infinite_is_set_aside_without_a_warning(stars):
    first = {**stars.first, "ra": np.where(np.arange(len(stars.ra)) == 3, np.inf, stars.first["ra"])}
    assert len(sameas.match(first, stars.second, sigma=0.05)) == len(stars.ra) - 1


@pytest.mark.parametrize(
    "columns, words",
    [
        ({"ra": [1.0, 2.0], "dec": [1.0]}, r"first: the columns have different lengths \(ra 2, dec 1\)"),
        ({"ra": 1.0, "dec": 2.0}, "first: ra is a single value, not a column"),
        ({"ra": [1.0], "dec": "x"}, "first: dec is a single value, not a column"),
    ],
)
def test_columns_that_are_no_table_are_refused_with_a_clear_message(columns, words):
    with pytest.raises(sameas.InputError, match=words):
        sameas.match(columns, {"ra": [1.0], "dec": [1.0]})


def test_a_table_of_odds_that_is_none_or_has_no_effect_is_told(stars, tmp_path):
    """Probabilities were once taken for odds, and single magnitudes for a prior that applies to no row."""
    (tmp_path / "p.csv").write_text("low,high,prob\n10,20,0.8\n")
    (tmp_path / "values.csv").write_text("mag,odds\n12.00001,8\n15.00001,3\n")
    second = Table(stars.second)
    second["brightness"] = np.linspace(11.0, 19.0, len(second))
    evidence = [Column(2, "brightness", odds=odds_of(tmp_path / "values.csv"))]
    report = " ".join(sameas.match(stars.first, second, sigma=0.05, evidence=evidence).report().split())
    assert "odds as given, other than 1 for 0 of " in report and "numbers need ranges" in report
    with pytest.raises(InputError, match="its last column is prob; give odds"):
        odds_of(tmp_path / "p.csv")
