"""``sameas movers``: from tables of detections to tables of tracklets."""

import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from typer.testing import CliRunner

from sameas.cli.app import app
from sameas.io import read_table

sys.path.insert(0, str(Path(__file__).parents[1] / "sky"))
from moving import night_table


@pytest.fixture
def table(tmp_path):
    return night_table(tmp_path / "night.csv")


def run(*arguments):
    return CliRunner().invoke(app, ["movers", *map(str, arguments)])


def test_a_table_becomes_tracklets(table, tmp_path):
    out, tracklets = tmp_path / "movers.fits", tmp_path / "tracklets.ecsv"
    result = run(table, "--sigma", 0.2, "-o", out, "--tracklets", tracklets, "--least", 3)
    assert result.exit_code == 0, result.output
    assert "time mjd (MJD, UTC), exposures by equal times, no band" in result.output
    assert "expected by chance" in result.output
    found, each = read_table(out), read_table(tracklets)
    assert len(each) > 25 and set(found["tracklet"]) == set(each["tracklet"])
    assert each["n_detections"].sum() == len(found)


def test_one_table_per_exposure_gives_the_same(table, tmp_path):
    whole = read_table(table)
    parts = []
    for k, mjd in enumerate(sorted(set(whole["mjd"]))):
        parts.append(tmp_path / f"part{k}.csv")
        whole[whole["mjd"] == mjd].write(parts[-1])
    result = run(*parts, "--sigma", 0.2, "-o", tmp_path / "parts.csv", "--least", 3)
    one = run(table, "--sigma", 0.2, "-o", tmp_path / "one.csv", "--least", 3)
    assert result.exit_code == one.exit_code == 0, result.output
    assert len(read_table(tmp_path / "parts.csv")) == len(read_table(tmp_path / "one.csv"))


def test_the_remedy_names_the_options(table, tmp_path):
    out = tmp_path / "movers.csv"
    assert "--sigma ARCSEC" in run(table, "-o", out).output
    result = run(table, "--sigma", 0.2, "--time", "when", "-o", out)
    assert result.exit_code == 1 and "no column 'when'" in result.output and "--time NAME" in result.output
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "times", "words"),
    [
        ("jd", lambda minutes: 1.7e9 + 60.0 * minutes, "of seconds since 1970 the MJD is 40587 + seconds / 86400"),
        ("date_obs", lambda minutes: 60.0 * minutes, "column 'date_obs' (about 2400) is no MJD or JD"),
        ("mjd", lambda minutes: 50.0 * minutes, "column 'mjd' (about 2000) is no MJD or JD between 1890 and 2150"),
    ],
)
def test_times_in_seconds_are_refused_with_the_option_of_the_time(table, tmp_path, name, times, words):
    night = read_table(table)
    step = np.searchsorted(np.unique(night["mjd"]), night["mjd"])
    night.remove_column("mjd")
    night[name] = times(20.0 + 20.0 * step)
    night.write(tmp_path / "seconds.csv")
    result = run(tmp_path / "seconds.csv", "--sigma", 0.2, "-o", tmp_path / "movers.csv")
    assert result.exit_code == 1 and words in result.output
    assert "--time NAME with MJD, JD or dates in UTC" in result.output and "--epoch" not in result.output


def test_doubts_about_the_columns_of_a_table_are_said(table, tmp_path):
    night = read_table(table)
    night.add_column(0.2, name="err", index=0)
    night["ra"][3] += 360.0
    night.write(tmp_path / "night2.csv")
    words = " ".join(run(tmp_path / "night2.csv", "-o", tmp_path / "movers.csv").output.split())
    assert "doubt night2: the unit of err is not stated; by its size arcsec: give --sigma-unit UNIT" in words
    assert "values of ra is beyond 360° or below −180° and was reduced to one turn (first: row 3" in words


def test_an_error_behind_a_magnitude_is_offered_where_positions_have_none(table, tmp_path):
    night = read_table(table)
    night["mag"], night["err"] = 17.0, 0.2
    night.write(tmp_path / "night2.csv")
    result = run(tmp_path / "night2.csv", "-o", tmp_path / "movers.csv")
    words = " ".join(result.output.split())
    assert result.exit_code == 1 and "no column of position errors" in words
    assert "err is taken for the error of mag, which it follows; if it is the position's, give --sigma err" in words


WHO = (
    '[observatory]\nmpcCode = "810"\n[submitter]\nname = "J. Doe"\n[telescope]\ndesign = "Reflector"\n'
    'aperture = "0.36"\ndetector = "CCD"\n[report]\nastCat = "Gaia3"\nband = "G"\n'
)


@pytest.fixture
def luxembourg(tmp_path):
    """A table of four exposures of (2713) and of another mover, seen from Westfield (observatory 810)."""
    pytest.importorskip("jplephem")
    import numpy as np
    from astropy.table import Table

    from sameas.sky.movers.orbits import Elements, ephemeris, geocentric_km

    rng = np.random.default_rng(3)
    mjd = np.asarray(58409.13 + np.arange(4) * 25.0 / 1440.0, np.float64)
    asteroid = Elements.read("demo").some(np.array([4]))
    there = ephemeris(asteroid, mjd, geocentric_km(42.6, -71.5, 100.0, mjd))
    ra, dec = there.ra_deg[0], there.dec_deg[0]
    ra = np.concatenate([ra, ra[0] + 0.05 + np.arange(4) * 25 * -0.0001])
    dec = np.concatenate([dec, np.full(4, dec[0])]) + 0.1 / 3600.0 * rng.standard_normal(8)
    path = tmp_path / "night.csv"
    columns = {"ra": ra, "dec": dec, "mjd": np.tile(mjd, 2), "mag": np.repeat([16.3, 18.0], 4), "e_mag": [0.05] * 8}
    Table(columns).write(path)
    return path


@pytest.mark.parametrize("others", [0, 1])
def test_known_objects_in_the_field_that_are_no_tracklet_are_named(luxembourg, tmp_path, others):
    """The detections of (2713) are displaced, as if it were hidden; with and without another tracklet."""
    night = read_table(luxembourg)
    rng, scatter = np.random.default_rng(4), 0.05
    night["ra"][:4] += rng.uniform(-scatter, scatter, 4)
    night["dec"][:4] += rng.uniform(-scatter, scatter, 4)
    if not others:
        night["ra"][4:] += rng.uniform(-scatter, scatter, 4)
    night.write(tmp_path / "hidden.csv")
    options = ["--sigma", 0.15, "--least", 3, "--elements", "demo", "--site", "42.6,-71.5,100"]
    result = run(tmp_path / "hidden.csv", *options, "-o", tmp_path / "movers.csv")
    assert result.exit_code == 0, result.output
    assert f"Movers: {others or 'none'}" in result.output
    assert "in the field and no tracklet, by prediction: 1 (2713 Luxembourg (1938 EA), V 1" in result.output


@pytest.mark.slow
def test_tracklets_of_a_table_are_named_and_reported(luxembourg, tmp_path):
    header = tmp_path / "who.toml"
    header.write_text(WHO)
    options = ["--sigma", 0.15, "--least", 3, "--elements", "demo", "--site", "42.6,-71.5,100", "--report", header]
    out, tracklets = tmp_path / "movers.csv", tmp_path / "tracklets.ecsv"
    result = run(luxembourg, *options, "-o", out, "--tracklets", tracklets)
    assert result.exit_code == 0, result.output
    assert "is 2713 Luxembourg" in result.output and "positions are geocentric" not in result.output
    each = read_table(tracklets)
    named = [str(name).startswith("2713") for name in each["object"].filled("")]
    assert sum(named) == 1 and abs(each["o_c_east_arcsec"][named.index(True)]) < 0.3
    report = (tmp_path / "movers.psv").read_text()
    assert report.count("|2018-10-18T") == len(read_table(out)) and "2713" in report
    assert all((tmp_path / f"movers.{end}").exists() for end in ("xml", "txt"))
    assert "it contains 2 tracklets" in result.output and each["in_report"].all()
    again = run(luxembourg, *options, "-o", tmp_path / "movers.fits", "--no-overwrite")
    assert again.exit_code == 1 and "movers.psv: is there already" in again.output
    result = run(luxembourg, "--sigma", 0.15, "--elements", "demo", "-o", out)
    assert "positions are geocentric" in " ".join(result.output.split())
    assert run(luxembourg, "--site", "north", "-o", out).exit_code == 2


def test_improbable_tracklets_are_omitted_from_a_report_and_counted(luxembourg, tmp_path):
    header = tmp_path / "who.toml"
    header.write_text(WHO)
    # Two detections of the second mover remain, with inconsistent magnitudes.
    night = read_table(luxembourg)
    night["mag"][5] = 18.45
    night[:6].write(tmp_path / "pair.csv")
    options = ["--sigma", 0.15, "--probability", 0.0, "--report", header, "--tracklets", tmp_path / "t.csv"]
    result = run(tmp_path / "pair.csv", *options, "-o", tmp_path / "movers.csv")
    assert result.exit_code == 0, result.output
    each, report = read_table(tmp_path / "t.csv"), (tmp_path / "movers.psv").read_text()
    sure = [str(p) for p in each["tracklet"][each["p_tracklet"] >= 0.9]]
    unsure = [str(p) for p in each["tracklet"][each["p_tracklet"] < 0.9]]
    assert len(sure) == len(unsure) == 1 and sure[0] in report and unsure[0] not in report
    words = " ".join(result.output.split())
    assert "it contains 1 tracklet; 1 is excluded, less probable than 0.9" in words and unsure[0] in words
    assert list(each["in_report"]) == [str(name) in sure for name in each["tracklet"]]
    result = run(tmp_path / "pair.csv", *options, "-o", tmp_path / "movers.csv", "--report-probability", 0)
    assert "it contains 2 tracklets" in result.output and unsure[0] in (tmp_path / "movers.psv").read_text()
    alone = run(luxembourg, "--sigma", 0.15, "-o", tmp_path / "m.csv", "--report-probability", 0.5)
    assert alone.exit_code == 2 and "there is no report" in " ".join(alone.output.split())


def test_one_exposure_and_images_are_refused_with_what_to_do(table, tmp_path):
    """It named --frame, which is no option."""
    whole, one = read_table(table), tmp_path / "one.csv"
    whole[:1].write(one)
    said = " ".join(run(one, "--sigma", 0.2, "-o", tmp_path / "out.csv").output.split())
    assert "1 usable row is of one exposure" in said and said.endswith("give --time NAME or --exposure NAME")
    fits.PrimaryHDU(np.zeros((8, 8), np.float32)).writeto(tmp_path / "image.fits")
    said = " ".join(run(tmp_path / "image.fits", "--sigma", 0.2, "-o", tmp_path / "out.csv").output.split())
    assert "holds images only, no table" in said and "`sameas movers` with --catalog" in said


def test_without_an_output_it_is_wrong_usage(table):
    assert run(table, "--sigma", 0.2).exit_code == 2


def test_a_folder_without_a_catalogue_is_wrong_usage(tmp_path):
    done = CliRunner().invoke(app, ["movers", str(tmp_path), "-o", str(tmp_path / "found")])
    words = " ".join(done.output.replace("│", " ").split())  # of a frame around the message
    assert done.exit_code == 2 and "--catalog" in words and "is a folder" in words


def test_two_exposures_raise_a_doubt(table, tmp_path):
    whole = read_table(table)
    first = sorted(set(whole["mjd"]))[:2]
    whole[[mjd in first for mjd in whole["mjd"]]].write(tmp_path / "two.csv")
    result = run(tmp_path / "two.csv", "--sigma", 0.2, "-o", tmp_path / "out.csv")
    assert result.exit_code == 0 and "nothing confirms that motion is straight" in " ".join(result.output.split())


def test_files_that_are_no_frames_are_refused_one_by_one(tmp_path):
    """The way of a series of frames is begun: every file is told what it lacks, then the series."""
    other = tmp_path / "other.fits"
    other.write_text("no frame")
    result = run(other, tmp_path / "gone.fits", "--catalog", "bright", "-j", 1, "-o", tmp_path / "out")
    assert result.exit_code == 1 and "0 of 2 frames could be identified" in result.output
    assert "gone" in result.output and "other" in result.output
