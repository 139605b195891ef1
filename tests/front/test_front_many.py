"""`sameas.match_many`: several sources jointly, and the methods of the result."""

from typing import Any

import numpy as np
import pytest
from guises import GUISES

import sameas
from sameas import InputError
from sameas.io import read_provenance, read_table
from sameas.space import sphere_offset


def survey(rng, ra, dec, rows, sigma, east=0.0, north=0.0):
    scatter = sigma * rng.standard_normal((2, len(rows)))
    cos = np.cos(np.radians(dec[rows]))
    place = {"ra": ra[rows] + (scatter[0] + east) / 3600.0 / cos, "dec": dec[rows] + (scatter[1] + north) / 3600.0}
    return place | {"name": np.array([f"s{k}" for k in rows])}


@pytest.fixture(scope="module")
def three():
    """Three surveys of 150 stars; the third is 8 arcsec off."""
    rng = np.random.default_rng(3)
    ra, dec = 150.0 + 0.3 * rng.uniform(size=150), 2.0 + 0.3 * rng.uniform(size=150)
    return [survey(rng, ra, dec, np.arange(120), 0.05), survey(rng, ra, dec, np.arange(30, 150), 0.1),
            survey(rng, ra, dec, rng.permutation(150), 0.2, east=8.0, north=-3.0)]  # fmt: skip


def names(found):
    """The objects of three catalogues, by the stars' names, which must agree."""
    table = found.joined(3)
    same = (table["name_1"] == table["name_2"]) & (table["name_2"] == table["name_3"])
    return len(table), int(np.count_nonzero(same))


@pytest.fixture(scope="module")
def found(three):
    return sameas.match_many(*three, sigma1=0.05, sigma2=0.1, sigma3=0.2, id="name", offset="find")


@pytest.mark.slow
def test_an_offset_of_one_catalogue_is_found_and_removed(three, found):
    assert names(found) == (90, 90)
    assert set(found.sky.rotations) == {"second", "third"}
    rotation = found.sky.rotations["third"]
    assert np.allclose(rotation.vector[:2], [-8.0, 3.0], atol=0.15)
    assert "offset                added to third: " in found.report()
    seen = found.joined(3)
    off = sphere_offset(seen["ra_object"].data, seen["dec_object"].data, seen["ra_1"].data, seen["dec_1"].data)
    assert np.abs(off).max() < 0.5  # positions are in the frame of the most precise catalogue
    without = sameas.match_many(*three, sigma1=0.05, sigma2=0.1, sigma3=0.2)
    assert any("offset='find'" in doubt for doubt in without.doubts)


@pytest.mark.slow
def test_the_order_of_the_catalogues_changes_nothing(three, found):
    again = sameas.match_many(three[::-1], sigma1=0.2, sigma2=0.1, sigma3=0.05, id="name", offset="find")
    assert len(again) == len(found) and names(again) == names(found)


@pytest.mark.slow
def test_match_many_accepts_all_input_types_of_match(three):
    columns = [{name: values for name, values in one.items() if name != "name"} for one in three[:2]]
    plain = sameas.match_many(*columns, sigma=0.1)
    for guise in ("pandas", "lazy polars", "table"):
        assert len(sameas.match_many(*map(GUISES[guise], columns), sigma=0.1)) == len(plain)


def test_records_are_explained_by_id_and_by_row(found):
    by_id, by_row = found.explain("s40", source=2), found.explain(row=10, source="second")
    assert str(by_id) == str(by_row) == str(found.explain("s40", source=np.int64(2))) and "first s40" in str(by_id)
    refused: dict[str, dict[str, Any]] = {
        "give the id of a record, or row=": {}, "no record with the id x9": {"id": "x9"},
        "source is 4; give 1 to 3": {"id": "s1", "source": 4}, "no catalogue is named 'x'": {"id": "s1", "source": "x"},
    }  # fmt: skip
    for words, options in refused.items():
        with pytest.raises(InputError, match=words):
            found.explain(**options)


def test_a_written_table_has_its_provenance(found, tmp_path):
    found.write(tmp_path / "objects.fits", 2)
    facts = read_provenance(tmp_path / "objects.fits")
    assert facts["command"].startswith("sameas.match_many(dict, dict, dict, offset='find'")
    assert facts["offset_3"].startswith("-") and len(read_table(tmp_path / "objects.fits")) == len(found.joined(2))


@pytest.mark.slow
def test_the_command_accepts_the_option_named_by_its_doubt(three, tmp_path, monkeypatch):
    from astropy.table import Table
    from typer.testing import CliRunner

    from sameas.cli.app import app

    monkeypatch.chdir(tmp_path)
    for k, one in enumerate(three, 1):
        Table(one).write(f"s{k}.fits")
    arguments = ["many", "s1.fits", "s2.fits", "s3.fits", "--sigma1", "0.05", "--sigma2", "0.1", "--sigma3", "0.2"]
    without = CliRunner().invoke(app, [*arguments, "-o", "without.fits"])
    assert "--offset find" in " ".join(without.stdout.split())
    with_it = CliRunner().invoke(app, [*arguments, "--offset", "find", "-o", "with.fits"])
    assert with_it.exit_code == 0 and "added to s3: -" in with_it.stdout


def test_invalid_sources_and_options_are_refused(three):
    for words, sources, options in (
        ("1 catalogue given; give two to 12", three[:1], {}),
        ("no option 'sigma4'; did you mean", three, {"sigma4": 1.0}),
        ('magnitudes is \'V\'; give "auto" or "off"', three, {"magnitudes": "V"}),
        ("least is 4; give 1 to 3", three, {"least": 4}),
        ("second: no column 'err' for sigma; .* Also: third: no column 'err'", three, {"sigma1": 0.1, "sigma": "err"}),
    ):
        with pytest.raises(InputError, match=words):
            sameas.match_many(*sources, **options)


def test_two_of_several_catalogues_are_plotted(found):
    pytest.importorskip("matplotlib")
    assert found.plot("third", "first").axes
    with pytest.raises(InputError, match="no catalogues first and x; give two of first, second, third"):
        found.plot("first", "x")


@pytest.mark.slow
def test_names_with_accents_are_written_to_fits(three, tmp_path):
    """The runner-up tells names of catalogues, and FITS has letters of ASCII only."""
    crowded = [
        {**one, "ra": 150.0 + (one["ra"] - 150.0) / 60.0, "dec": 2.0 + (one["dec"] - 2.0) / 60.0} for one in three
    ]
    found = sameas.match_many(*crowded, sigma=1.0, names=("gäia", "ǳ", "c"), id="name")
    found.write(tmp_path / "out.fits")
    words = read_table(tmp_path / "out.fits")["runner_up"]
    assert any("gaia s" in word for word in np.ma.compressed(words).astype(str))
