"""``sameas movers``: from tables of detections to tables of tracklets."""

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sameas.cli.app import app
from sameas.io import read_table

sys.path.insert(0, str(Path(__file__).parents[1] / "sky"))
from moving import night


@pytest.fixture
def table(tmp_path):
    from astropy.table import Table

    seen, _ = night(21)
    path = tmp_path / "night.csv"
    columns = {"ra": seen.ra_deg, "dec": seen.dec_deg, "mjd": seen.mjd_utc, "mag": seen.magnitude}
    Table(columns).write(path)
    return path


def run(*arguments):
    return CliRunner().invoke(app, ["movers", *map(str, arguments)])


def test_a_table_becomes_tracklets(table, tmp_path):
    out, tracklets = tmp_path / "movers.fits", tmp_path / "tracklets.ecsv"
    told = run(table, "--sigma", 0.2, "-o", out, "--tracklets", tracklets, "--least", 3)
    assert told.exit_code == 0, told.output
    assert "time mjd (MJD, UTC), exposures by equal times, no band" in told.output
    assert "expected by chance" in told.output
    found, each = read_table(out), read_table(tracklets)
    assert len(each) > 25 and set(found["tracklet"]) == set(each["tracklet"])
    assert each["n_detections"].sum() == len(found)


def test_one_table_an_exposure_is_the_same(table, tmp_path):
    whole = read_table(table)
    parts = []
    for k, mjd in enumerate(sorted(set(whole["mjd"]))):
        parts.append(tmp_path / f"part{k}.csv")
        whole[whole["mjd"] == mjd].write(parts[-1])
    told = run(*parts, "--sigma", 0.2, "-o", tmp_path / "parts.csv", "--least", 3)
    one = run(table, "--sigma", 0.2, "-o", tmp_path / "one.csv", "--least", 3)
    assert told.exit_code == one.exit_code == 0, told.output
    assert len(read_table(tmp_path / "parts.csv")) == len(read_table(tmp_path / "one.csv"))


def test_the_remedy_names_the_options(table, tmp_path):
    out = tmp_path / "movers.csv"
    assert "--sigma ARCSEC" in run(table, "-o", out).output
    told = run(table, "--sigma", 0.2, "--time", "when", "-o", out)
    assert told.exit_code == 1 and "no column 'when'" in told.output and "--time NAME" in told.output
    assert not out.exists()


def test_without_an_output_it_is_wrong_usage(table):
    assert run(table, "--sigma", 0.2).exit_code == 2


def test_two_exposures_are_doubted(table, tmp_path):
    whole = read_table(table)
    first = sorted(set(whole["mjd"]))[:2]
    whole[[mjd in first for mjd in whole["mjd"]]].write(tmp_path / "two.csv")
    told = run(tmp_path / "two.csv", "--sigma", 0.2, "-o", tmp_path / "out.csv")
    assert told.exit_code == 0 and "nothing confirms that motion is straight" in " ".join(told.output.split())


def test_frames_that_are_none_are_refused_one_by_one(table, tmp_path):
    """The way of a series of frames is begun: every file is told what it lacks, then the series."""
    other = tmp_path / "other.fits"
    other.write_text("no frame")
    told = run(other, tmp_path / "gone.fits", "--catalog", "bright", "-j", 1, "-o", tmp_path / "out")
    assert told.exit_code == 1 and "0 of 2 frames could be identified" in told.output
    assert "gone" in told.output and "other" in told.output
