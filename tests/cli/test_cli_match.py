"""`sameas match`: printed text and written files, in every format."""

import json
import re

import numpy as np
import pytest
from astropy.table import Table
from fields import field, save

from sameas.estimate.quantity import Quantity
from sameas.front.request import Request
from sameas.io import read_provenance, read_table, write_table
from sameas.simulate import blended_field
from sameas.sky.many import ManyOptions


def pairs(path):
    table = read_table(path)
    p = np.ma.filled(np.ma.masked_invalid(table["p_match"]), 0.0)
    return sorted(
        zip(np.asarray(table["name_1"][p > 0]).tolist(), np.asarray(table["name_2"][p > 0]).tolist(), strict=True)
    )


@pytest.mark.slow
def test_blends_are_written_next_to_the_joined_table(tmp_path, sameas, refusal):
    made = blended_field(np.random.default_rng(7), objects=1000)
    files = [tmp_path / "coarse.csv", tmp_path / "fine.csv"]
    for records, path in zip((made.first, made.second), files, strict=True):
        ra, dec = records.features.T
        Table({"ra": ra, "dec": dec, "sigma": np.sqrt(records.covariance[:, 0])}).write(path)
    out = tmp_path / "out.fits"
    text = sameas("match", *files, "-o", out, "--sigma", "sigma", "--blends", "6").stdout
    assert "a match with --blends, the resolution of coarse in arcsec, lists them" in " ".join(text.split())
    facts = read_table(tmp_path / "out-blends.fits")
    two = np.flatnonzero(~np.ma.getmaskarray(facts["row_2b"]))
    assert f"at 6 arcsec {len(two)} of {len(made.first)} records are two objects" in text and len(two) > 5
    found_parts = np.sort(np.column_stack([facts["row_2"][two], facts["row_2b"][two]]), axis=1)
    assert (found_parts == np.sort(made.parts[two], axis=1)).all(axis=1).mean() > 0.6
    assert "give the resolution of the first catalogue" in refusal("match", *files, "-o", out, "--blends", "-1")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fits", "vot", "ecsv", "csv", "parquet"])
def test_every_format_gives_the_same_pairs_and_keeps_the_provenance(tmp_path, sameas, kind):
    unit = ["--sigma-unit", "arcsec"] if kind == "csv" else []
    first = save(field(120, 2), tmp_path / f"first.{kind}")
    second = save(field(100, 3), tmp_path / f"second.{kind}")
    out = tmp_path / f"out.{kind}"
    sameas("match", first, second, "-o", out, "--id", "name", *unit)
    assert pairs(out) == sorted((f"s{k}", f"s{k}") for k in range(100))
    facts = read_provenance(out)
    assert facts["pairs"] == 100 and facts["rows_1"] == 120 and facts["input_2"] == second
    assert facts["command"].startswith("sameas match ") and len(facts["sha256_1"]) == 64
    assert json.loads(facts["options_1"])["id"] == "name"
    assert sum(facts["error_shares"]) == pytest.approx(1.0)


def test_the_printed_text_lists_interpretation_estimates_and_matches(tmp_path, sameas, field_files):
    out = tmp_path / "out.fits"
    text = sameas("match", *field_files, "-o", out, "--compare-nearest", "--certify").stdout
    for words in (
        "First catalogue: first, 120 rows", "sigma [arcsec, unit of the column]", "common area",
        "  identified                       100           100", "100 identified among", "expected wrong",
        "Certificate: optimal: least reduced cost",
        "probabilities         100 groups by closed form", "expected from errors", "1.18",
        "  second, mag", "second: claimed more than once", f"Output: {out}, 120 rows", "peak memory",
    ):  # fmt: skip
        assert words in text
    assert "\x1b" not in text


@pytest.mark.slow
def test_provenance_is_equal_except_date_and_paths(tmp_path, sameas, field_files):
    facts = []
    for name in ("one.fits", "two.fits"):
        sameas("match", *field_files, "-o", tmp_path / name, "-q")
        facts.append(read_provenance(tmp_path / name))
    assert {key for key in facts[0] if facts[0][key] != facts[1][key]} <= {"date_utc", "command"}


@pytest.mark.slow
def test_provenance_keeps_every_estimate_with_its_standard_error(tmp_path, sameas, field_files):
    sameas("match", *field_files, "-o", tmp_path / "out.fits", "-q", "--offset", "find")
    facts = read_provenance(tmp_path / "out.fits")
    for name in ("common", "share_1", "share_2", "density_only_1", "density_only_2", "error_scale"):
        assert f"estimated_{name}" in facts and facts[f"estimated_{name}_error"] > 0.0
    assert facts["settled"] is True and len(facts["offset_arcsec"]) == len(facts["offset_arcsec_error"]) == 3
    for side in (1, 2):
        bins = len(facts[f"completeness_{side}_edges_mag"]) - 1
        for name in (f"completeness_{side}", f"density_only_{side}_per_deg2_mag"):
            assert len(facts[name]) == len(facts[f"{name}_error"]) == bins > 0


@pytest.mark.slow
def test_provenance_keeps_undetermined_errors_and_the_reason(tmp_path, sameas, field_files):
    sameas("match", *field_files, "-o", tmp_path / "few.fits", "-q")
    assert "fewer than 200 pairs" in read_provenance(tmp_path / "few.fits")["error_note"]
    rng, names = np.random.default_rng(4), ("first.fits", "second.fits")
    ra, dec = rng.uniform(10.0, 10.6, 400), rng.uniform(-0.3, 0.3, 400)
    for name in names:
        off = 0.17 / 3600.0 * rng.standard_normal((2, 400))
        table = Table(
            {"ra": ra + off[0], "dec": dec + off[1], "sigma": np.full(400, 0.1)}, units=("deg", "deg", "arcsec")
        )
        save(table, tmp_path / name)
    text = sameas("match", *(tmp_path / name for name in names), "-o", tmp_path / "alike.fits").stdout
    facts = read_provenance(tmp_path / "alike.fits")
    both, error = facts["estimated_error_factor_both"], facts["estimated_error_factor_both_error"]
    assert both == pytest.approx(1.7, abs=4.0 * error) and facts["estimated_error_floor_instead"] > 0.1
    assert "estimated_error_factor_1" not in facts and "vary too little" in facts["error_note"]
    assert f"by catalogue those of both × {Quantity(both, error)}, or, with both as quoted, floor" in " ".join(
        text.split()
    )


@pytest.mark.slow
def test_all_possible_plots_are_drawn(tmp_path, sameas, field_files):
    pytest.importorskip("matplotlib", reason="plots need the extra sameas[plots]")
    text = sameas("match", *field_files, "-o", tmp_path / "out.fits", "--pictures", tmp_path / "drawn").stdout
    names = {path.name for path in (tmp_path / "drawn").iterdir()}
    assert {"residuals.png", "normalised.png", "scatter.png", "certainty.png"} <= names
    assert all(name in text for name in names)


@pytest.mark.slow
@pytest.mark.parametrize(("join", "rows"), [("1and2", 100), ("1not2", 20), ("1or2", 120), ("2not1", 0)])
def test_stilts_names_of_joins_are_accepted(tmp_path, sameas, field_files, join, rows):
    sameas("match", *field_files, "-o", tmp_path / "out.ecsv", "--join", join, "-q", "--nway-columns")
    table = read_table(tmp_path / "out.ecsv")
    assert len(table) == rows and {"p_any", "p_i", "dist_bayesfactor"} <= set(table.colnames)


def test_quiet_prints_only_doubts(tmp_path, sameas, field_files):
    result = sameas("match", *field_files, "-o", tmp_path / "out.fits", "-q", "--density", "1e9,700")
    assert result.stdout == ""
    assert result.stderr.startswith("sameas: doubt: density: 1e+09 per square degree was given for first")


def test_a_dry_run_prints_its_interpretation_and_writes_nothing(tmp_path, sameas, field_files):
    text = sameas("match", *field_files, "-o", tmp_path / "out.fits", "--dry-run").stdout
    assert "mean density there" in text and "Nothing was identified or written" in text
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_doubts_fields_that_lie_apart(tmp_path, sameas, field_files):
    """Only the match itself said so."""
    table = field(120, 2)
    table["ra"] = table["ra"] / 15.0
    text = " ".join(sameas("match", save(table, tmp_path / "hours.csv"), field_files[1], "--dry-run").stdout.split())
    assert "the fields lie apart" in text and "in hours, ra of hours would lie in the field" in text


@pytest.mark.slow
def test_a_dry_run_names_the_options_for_what_it_assumed(tmp_path, sameas, field_files):
    """It named the arguments of Python, sigma1=ARCSEC."""
    table = field(120, 2)
    table.remove_columns([name for name in table.colnames if name not in ("ra", "dec")])
    text = " ".join(sameas("match", save(table, tmp_path / "bare.csv"), field_files[1], "--dry-run").stdout.split())
    assert "--sigma1 ARCSEC" in text and "sigma1=" not in text


def test_options_of_one_catalogue_override_those_of_both(sameas, field_files):
    text = sameas("match", *field_files, "--dry-run", "--sigma", "0.3", "--sigma2", "0.2").stdout
    assert "0.3 arcsec on each axis (option)" in text and "0.2 arcsec on each axis (option)" in text


@pytest.mark.parametrize("axes_columns", [["sigma", "sigma", "angle"], ["sigma,sigma,angle"]])
def test_an_ellipse_is_given_by_three_columns(tmp_path, sameas, field_files, axes_columns):
    table = field(120, 2)
    table["angle"] = np.zeros(120)
    path = save(table, tmp_path / "ellipses.fits")
    text = sameas("match", path, field_files[1], "--dry-run", "--ellipse1", *axes_columns).stdout
    assert "ellipse, angle east of north" in text


def test_unusable_rows_are_counted_by_reason(tmp_path, sameas, field_files):
    table = field(120, 2)
    table["sigma"][[0, 1, 2]] = 0.0, -1.0, np.nan
    table["ra"][3] = np.nan
    table = type(table)(table, masked=True)
    table["dec"].mask[4] = True
    text = sameas("match", save(table, tmp_path / "holes.ecsv"), field_files[1], "-o", tmp_path / "o.fits").stdout
    assert "set aside: no error                3             0" in text
    assert "set aside: no position             2             0" in text
    assert "5 of 120 rows lack a position or a positive error" in text


@pytest.mark.slow
def test_one_row_and_the_same_file_twice_work(tmp_path, sameas, field_files):
    one = save(field(1, 2), tmp_path / "one.fits")
    sameas("match", one, field_files[1], "-o", tmp_path / "o.fits")
    assert len(read_table(tmp_path / "o.fits")) == 1
    text = sameas("match", field_files[0], field_files[0], "-o", tmp_path / "o.fits").stdout
    assert "is given twice: every record would match itself" in " ".join(text.split())
    assert re.search(r"identified +120 +120\n", text)


def test_guessed_ids_that_are_not_unique_are_replaced_by_row_numbers(tmp_path, sameas, field_files):
    table = field(120, 2)
    table.rename_column("name", "id")
    table["id"][1] = "s0"
    text = sameas("match", save(table, tmp_path / "twice.fits"), field_files[1], "--dry-run").stdout
    assert "id is not unique, so rows are numbered" in text


def test_errors_in_another_unit_raise_a_doubt(tmp_path, sameas, field_files):
    too_small = sameas("match", *field_files, "-o", tmp_path / "o.fits", "--sigma", "2.8e-5")
    assert re.search(r"the residuals are \S+ times what the quoted errors say: are their units right\?",
                     " ".join(too_small.stdout.split()))  # fmt: skip


@pytest.mark.slow
def test_magnitudes_are_evidence_unless_switched_off(tmp_path, sameas, field_files):
    reports = {how: sameas("match", *field_files, "-o", tmp_path / "o.fits", *how).stdout for how in (
        (), ("--magnitudes", "off"), ("--magnitudes", "mag:mag"),
    )}  # fmt: skip
    assert (
        "brightness" in reports[()]
        and "completeness" in reports[()]
        and "brightness" in reports["--magnitudes", "mag:mag"]
    )
    assert "brightness" not in reports["--magnitudes", "off"]


def test_formats_and_version(sameas):
    listed = sameas("formats").stdout
    assert "parquet     .parquet .pq .parq\n" in listed
    assert "ipac        .tbl .ipac .tbl.gz .ipac.gz  (read only)" in listed
    assert sameas("--version").stdout == "sameas 0.1.0\n"


@pytest.mark.parametrize("ending", [".fits", ".parquet"])
def test_large_tables_are_read_two_at_a_time_with_the_same_result(
    ending, tmp_path, sameas, field_files, refusal, monkeypatch
):
    paths = [tmp_path / f"{name}{ending}" for name in ("first", "second", "none", "cut")]
    for source, path in zip(field_files, paths, strict=False):
        write_table(read_table(source), path, provenance={})
    paths[3].write_bytes(paths[0].read_bytes()[:1000] if ending == ".parquet" else b"no table")

    def outcome():
        printed = sameas("match", *paths[:2], "-o", tmp_path / "out.csv").stdout
        refused = [
            refusal("match", *bad, "-o", tmp_path / "out.csv") for bad in ((paths[2], paths[3]), paths[2:][::-1])
        ]
        lines = [line for line in printed.splitlines() if "Time:" not in line]
        return lines, (tmp_path / "out.csv").read_text(), refused

    expected = outcome()
    monkeypatch.setattr(Request, "n_bytes", 1 << 30)
    assert outcome() == expected


@pytest.mark.parametrize("count", [2, 3])
def test_catalogues_read_two_at_a_time_are_described_in_order(field_files, count):
    request = Request((*field_files, field_files[0])[:count], ManyOptions())
    described = []
    both = request.catalogues(lambda side, catalogue: described.append((side, len(catalogue))), two_at_once=True)
    assert [len(catalogue) for catalogue in both] == [120, 100, 120][:count]
    assert described == list(enumerate([120, 100, 120][:count], 1))
