"""User errors give one clear line, exit code 1 or 2, and no output."""

from pathlib import Path

import numpy as np
import pytest
from fields import field, save
from typer.testing import CliRunner

from sameas.cli.app import app


@pytest.fixture
def refused(tmp_path, refusal, field_files):
    """A function that returns the refusal of a match with a changed first table and checks that nothing is written."""

    def run(change=lambda table: None, *options, name="wrong.fits"):
        table = field(120, 2)
        changed = change(table)
        path = save(table if changed is None else changed, tmp_path / name)
        words = refusal("match", path, field_files[1], "-o", tmp_path / "o.fits", *options)
        assert sorted(entry.name for entry in tmp_path.iterdir()) == [name]
        return words

    return run


def test_missing_files_and_files_that_are_no_table(tmp_path, refusal, field_files):
    out = tmp_path / "o.fits"
    assert "frist.fits: no such file; did you mean first.fits" in refusal(
        "match", field_files[0].replace("first", "frist"), field_files[1], "-o", out
    )
    page = tmp_path / "page.csv"
    page.write_text("<!DOCTYPE html><html></html>")
    assert "is a web page (HTML), not CSV; the download probably failed" in refusal(
        "match", page, field_files[1], "-o", out
    )
    page.rename(tmp_path / "page.xyz")
    assert "is a web page (HTML), not a table" in refusal("match", tmp_path / "page.xyz", field_files[1], "-o", out)
    (tmp_path / "stars.xyz").write_bytes(bytes(range(1, 9)))
    assert "or give --format1 NAME" in refusal("match", tmp_path / "stars.xyz", field_files[1], "-o", out)


def test_missing_or_ambiguous_positions_name_the_option_of_that_catalogue(refused):
    assert "give --ra1 NAME --dec1 NAME" in refused(lambda t: t.remove_column("ra"))

    def second_position(table):
        table["ALPHA_J2000"], table["DELTA_J2000"] = table["ra"], table["dec"]

    assert "2 candidates for right ascension: 'ALPHA_J2000', 'ra'; give --ra1 NAME" in refused(second_position)


def test_an_unknown_column_names_the_typed_option(refused):
    assert "no column 'sigmas' for --sigma1; did you mean 'sigma'?" in refused(lambda t: None, "--sigma1", "sigmas")
    assert "no column 'sigmas' for --sigma; did you mean" in refused(lambda t: None, "--sigma", "sigmas")


def test_problems_of_both_catalogues_are_reported_in_sentences(refused):
    assert "did you mean 'ra'? Also: second: no column 'rra' for --ra" in refused(lambda t: None, "--ra", "rra")


@pytest.mark.parametrize(("typed", "alternative"), [
    (["--prior-completeness", "0.9"], "Completeness is estimated"),
    (["--mag", "OPT:MAG", "auto"], "--column2 NAME"),
    (["--acceptable-prob", "0.5"], "match_flag"),
    (["--min-prob", "0.1"], "p_match"),
    (["join=all1"], "--join all1"),
    (["find=best"], "always one to one"),
    (["error=1"], "No radius is needed"),
    (["ra1=RA"], "--ra1 RA"),
    (["values1=ra dec 3*err"], "--sigma1"),
    (["ifmt2=csv"], "--format2 csv"),
])  # fmt: skip
def test_arguments_of_nway_and_stilts_are_refused_with_ours(typed, alternative):
    done = CliRunner().invoke(app, ["match", "a.csv", "b.csv", "-o", "c.csv", *typed])
    words = " ".join(done.output.replace("│", " ").split())
    assert done.exit_code == 2 and alternative in words, words


def test_tables_named_as_in_stilts_are_refused_with_the_order_of_ours():
    done = CliRunner().invoke(app, ["match", "in1=a.csv", "in2=b.csv", "out=c.csv"])
    words = " ".join(done.output.replace("│", " ").split())
    assert done.exit_code == 2 and "sameas match FIRST SECOND -o OUT" in words, words


@pytest.mark.parametrize("option", ["--radius", "--within", "--max-sep"])
@pytest.mark.parametrize("command", ["match", "many"])
def test_a_radius_option_is_refused_with_the_alternative(command, option):
    done = CliRunner().invoke(app, [command, "a.csv", "b.csv", "-o", "c.csv", option, "1"])
    words = " ".join(done.output.replace("│", " ").split())
    assert done.exit_code == 2 and f"No such option: {option}. No radius is needed" in words
    assert "give --sigma ARCSEC" in words and "Possible options" not in words


def test_swapped_columns_and_marks_of_missing_declinations(refused):
    def swapped(table):
        table["ra"], table["dec"] = np.full(len(table), 20.0), np.full(len(table), 150.0)

    def marked(table):
        table["dec"][3] = -95.0

    words = refused(swapped)
    assert "(first: row 0), right ascensions within it; are the two swapped? give --ra1 NAME --dec1 NAME" in words
    assert "beyond ±90° in 1 row (first: row 3); leave cells empty that were not measured (-95 there)" in refused(
        marked
    )


def test_unknown_units(refused):
    def unitless(table):
        table["sigma"].unit = None

    said = refused(unitless, "--sigma-unit1", "furlong")
    assert said.endswith("is in furlong, which is not an angle; give --sigma-unit1 UNIT, such as mas")
    assert "--sigma1 0 is not positive" in refused(unitless, "--sigma1", "0")


def test_absurd_errors_are_refused_at_once(refused):
    words = refused(lambda t: None, "--sigma1", "0.4", "--sigma-unit1", "deg")
    assert "so large that about" in words and "give --sigma-unit1 UNIT" in words


def test_correlations_beyond_one_name_the_row(refused):
    def correlated(table):
        table["north"], table["rho"] = table["sigma"], np.zeros(120)
        table["rho"][11] = 1.5

    words = refused(correlated, "--sigma1", "sigma,north", "--correlation1", "rho")
    assert "correlations beyond ±1 in 1 row (first: row 11)" in words


def test_given_ids_must_be_unique(refused):
    def twice(table):
        table["name"][2] = "s1"

    assert "1 id is not unique (first: s1 in rows 1 and 2)" in refused(twice, "--id1", "name")


def test_tables_without_usable_rows(refused):
    assert refused(lambda t: t[:0]) == "wrong: the table has no rows"

    def no_errors(table):
        table["sigma"] = np.nan

    assert "none of its 120 rows can be used: no error (120)" in refused(no_errors, "--sigma1", "sigma")


def test_impossible_outputs_are_refused_at_the_start(tmp_path, refusal, field_files):
    copy = tmp_path / "copy.fits"
    copy.symlink_to(field_files[0])
    before = Path(field_files[0]).read_bytes()
    for out, words in (
        (field_files[0], "is also an input; it would be overwritten"),
        (copy, "is also an input; it would be overwritten"),
        (tmp_path / "missing" / "o.fits", "missing does not exist; make it first"),
        (tmp_path / "o.dat", "its extension is not that of a format; see `sameas formats`"),
        (tmp_path, "its extension is not that of a format"),
    ):
        assert words in refusal("match", *field_files, "-o", out)
    assert Path(field_files[0]).read_bytes() == before
    there = tmp_path / "there.fits"
    there.write_text("mine")
    assert "exists already" in refusal("match", *field_files, "-o", there, "--no-overwrite")
    assert there.read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--density", "5"], "--density 5: give two numbers N1,N2"),
        (["--density", "5,-1"], "density: give two positive numbers"),
        (["--error-scale", "much"], "error scale is 'much'"),
        (["--magnitudes", "J"], "--magnitudes J: give auto, off, or columns of both catalogues"),
        (["--magnitudes", "mag:J"], "no column 'J' of magnitudes; it has"),
        (["--gate-sigmas", "-1"], "sigmas is -1.0; give a positive number"),
        (["--hdu1", "7"], "has no extension 7"),
    ],
)
def test_invalid_match_options(tmp_path, refusal, field_files, options, words):
    assert words in refusal("match", *field_files, "-o", tmp_path / "o.fits", *options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["-o", "o.fits", "--join", "al1"], "did you mean all1"),
        (["-o", "o.fits", "--jion", "all1"], "--join"),
        (["-o", "o.fits", "--out-format", "fist"], "did you mean fits"),
        ([], "give -o OUT"),
    ],
)
def test_wrong_usage_exits_with_2_and_suggests_the_right_option(sameas, field_files, options, words):
    result = sameas("match", *field_files, *options, exit_code=2)
    assert words in " ".join(result.stderr.replace("│", " ").split())


@pytest.mark.slow
def test_an_interruption_writes_nothing(tmp_path, sameas, field_files, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("sameas.sky.joins.joined", interrupted)
    result = sameas("match", *field_files, "-o", tmp_path / "o.fits", exit_code=130)
    assert result.stderr.splitlines()[-1] == "sameas: stopped; nothing was written"
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_the_traceback_of_an_error_before_its_line(sameas, field_files, tmp_path):
    result = sameas("match", "nowhere.fits", field_files[1], "-o", tmp_path / "o.fits", "--debug", exit_code=1)
    assert result.stderr.startswith("Traceback") and "\nsameas: nowhere.fits: no such file" in result.stderr


def test_an_internal_error_is_reported_as_such(tmp_path, refusal, field_files, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("division\nby zero")

    monkeypatch.setattr("sameas.sky.joins.joined", broken)
    words = refusal("match", *field_files, "-o", tmp_path / "o.fits")
    assert words.startswith("unexpected ZeroDivisionError: division by zero; this is a fault of sameas")
