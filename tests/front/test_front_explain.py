"""Outputs are explained from their contents, and compared with known differences."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

import sameas
from sameas import InputError
from sameas.cli.app import app
from sameas.front.comparison import ComparedObjects, comparison_lines
from sameas.io import read_provenance, write_table


@pytest.fixture(scope="module")
def crowded():
    """Two surveys in which records compete, with names."""
    rng = np.random.default_rng(8)
    place = rng.uniform(0.0, 60.0 / 3600.0, (60, 2))
    first = {"ra": 10.0 + place[:, 0], "dec": place[:, 1], "name": [f"a{k}" for k in range(60)]}
    scatter = 1.0 / 3600.0 * rng.standard_normal((45, 2))
    second = {"ra": 10.0 + place[:45, 0] + scatter[:, 0], "dec": place[:45, 1] + scatter[:, 1],
              "name": [f"b{k}" for k in range(45)]}  # fmt: skip
    return first, second


@pytest.fixture(scope="module")
def match(crowded):
    return sameas.match(*crowded, sigma1=0.7, sigma2=0.7, id="name")


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["fits", "vot", "ecsv", "csv", "parquet"])
def test_a_match_in_memory_is_explained_from_its_file(match, tmp_path, ending):
    path = tmp_path / f"out.{ending}"
    match.write(path)
    for row in range(60):
        text, answers = str(sameas.explain(path, f"a{row}")), match.identification.answers_1
        partner = answers.partner[row]
        if partner is np.ma.masked:
            assert text.startswith(f"first a{row} has no partner")
        else:
            assert text.startswith(f"first a{row} is second b{partner}, probability ")
        if answers.second[row] is not np.ma.masked:
            assert f"b{answers.second[row]}" in text
    assert str(sameas.explain(path, row=5)) == str(sameas.explain(path, "a5"))


@pytest.mark.slow
def test_a_record_of_the_second_catalogue_is_explained(match, tmp_path):
    path = tmp_path / "out.fits"
    match.write(path, "1or2")
    text = str(sameas.explain(path, "b3", source=2))
    assert text.startswith("second b3 ") and text == str(sameas.explain(path, "b3", source="second"))
    with pytest.raises(InputError, match="b3 is a record of second; give source=2"):
        sameas.explain(path, "b3")
    with pytest.raises(InputError, match="it has no source 3; give one of first, second"):
        sameas.explain(path, "b3", source=3)


def test_every_candidate_is_listed_if_the_table_has_them(match, tmp_path):
    path = tmp_path / "pairs.fits"
    match.write(path, "pairs")
    row = int(np.argmax(match.identification.answers_1.candidates.filled(0)))
    text = str(sameas.explain(path, f"a{row}"))
    names = {f"b{j}" for i, j in zip(match.identification.rows_1, match.identification.rows_2, strict=True) if i == row}
    assert len(names) > 2 and all(name in text for name in names) and "no partner" in text


@pytest.mark.slow
def test_records_without_ids_are_named_by_row(crowded, tmp_path):
    first, second = ({name: one[name] for name in ("ra", "dec")} for one in crowded)
    found = sameas.match(first, second, sigma=0.7)
    path = tmp_path / "out.fits"
    found.write(path)
    partner = found.identification.answers_1.partner
    text = str(sameas.explain(path, 3))
    assert ("has no partner" in text) == (partner[3] is np.ma.masked)
    with pytest.raises(InputError, match="because the output does not hold all its rows in their order"):
        sameas.explain(path, 3, source=2)


@pytest.mark.parametrize("named", [True, False])
def test_the_second_candidate_of_a_record_without_an_id_is_an_answer(named, tmp_path):
    """It was left out where the record's own catalogue has no ids."""
    names = {"name": ["b0", "b1"]} if named else {}
    second = {"ra": [10.0, 10.0], "dec": [20.0 + 0.2 / 3600.0, 20.0 - 0.3 / 3600.0], **names}
    match = sameas.match({"ra": [10.0], "dec": [20.0]}, second, sigma=0.3, error_scale=1, density=(1e6, 1e6))
    match.write(tmp_path / "out.fits")
    p = f"{match.table['p_second'][0]:.4f}"
    [line] = [line for line in str(sameas.explain(tmp_path / "out.fits", row=0)).splitlines() if p in line]
    assert line.split() == [*(["b1"] if named else ["row", "1"]), p, *["the", "most", "probable", "other", "candidate"]]


@pytest.mark.parametrize("join", ["all1", "1or2", "all2"])
def test_rows_are_counted_with_rows_that_lack_a_position_or_share_one(join, tmp_path):
    """One row without a position, or two of the same, and every row was refused: the catalogue had no ids, it said."""
    ra = np.array([np.nan, 10.0, 10.1, 10.1, 10.2])
    first = {"ra": ra, "dec": np.full(5, 1.0), "name": np.array([f"a{k}" for k in range(5)])}
    second = {"ra": ra[[4, 2, 0]], "dec": np.full(3, 1.0), "name": np.array([f"b{k}" for k in range(3)])}
    source, names = (2, "b") if join == "all2" else (1, "a")
    for id_column in ("name", None):
        sides = [{key: side[key] for key in ("ra", "dec", id_column) if key} for side in (first, second)]
        found = sameas.match(*sides, sigma=0.3, sigma_unit="arcsec", id=id_column)
        path = tmp_path / f"{id_column}.fits"
        found.write(path, join)
        for row in range(len(second["ra"] if source == 2 else ra)):
            text = str(sameas.explain(path, row=row, source=source))
            at = (second["ra"] if source == 2 else ra)[row]
            assert (f"{names}{row}" if id_column else f"at {at:.6f}" if at > 0 else "without a position") in text
    sexagesimal = {"ra": ["00:40:00.0", "00:41:00.0"], "dec": ["+01:00:00", "+01:00:00"]}
    sameas.match(sexagesimal, second, sigma=0.3, sigma_unit="arcsec").write(tmp_path / "text.fits", "all1")
    assert "at 00:41:00.0 +01:00:00" in str(sameas.explain(tmp_path / "text.fits", row=1))
    # Its id finds a record without a position, which is in the output.
    missing = "b2" if source == 2 else "a0"
    assert "could not be used" in str(sameas.explain(tmp_path / "name.fits", missing, source=source))
    with pytest.raises(InputError, match="rows cannot be counted"):
        sameas.explain(tmp_path / "name.fits", row=1, source=3 - source)


@pytest.mark.slow
def test_objects_of_several_catalogues_are_explained(crowded, tmp_path):
    first, second = crowded
    found = sameas.match_many(first, second, first | {"name": [f"c{k}" for k in range(60)]}, sigma=0.7, id="name")
    path = tmp_path / "objects.fits"
    found.write(path)
    for row in (0, 7, 50):
        text = str(sameas.explain(path, f"a{row}"))
        number = int(found.objects.of("first").object[row])
        members = found.objects.members[number]
        for word, member in zip("abc", members, strict=True):
            assert member is np.ma.masked or f"{word}{member}" in text
    assert str(sameas.explain(path, "b3", source=2)) == str(sameas.explain(path, row=3, source="second"))
    assert "offset_1" not in read_provenance(path)


def test_outputs_that_cannot_be_explained_are_refused(match, tmp_path):
    from astropy.table import Table

    write_table(Table({"a": [1]}), tmp_path / "other.fits", provenance={})
    match.write(tmp_path / "out.fits")
    for words, arguments in (
        ("has no provenance", ("other.fits", 1)),
        ("give the id of a record, or row=", ("out.fits",)),
        ("first has no record with the id zz in the output; its first ids are a0, a1, a2", ("out.fits", "zz")),
    ):
        with pytest.raises(InputError, match=words):
            sameas.explain(tmp_path / arguments[0], *arguments[1:])
    with pytest.raises(InputError, match=r"was made from .* in memory, which no longer exists"):
        sameas.explain(tmp_path / "out.fits", "a1", again=True)


@pytest.fixture(scope="module")
def tables():
    """Ten stars, 20″ apart, in two catalogues; and the second one with two of its stars exchanged."""
    ra, dec = 10.0 + np.arange(10) * 20.0 / 3600.0, np.zeros(10)
    first = {"ra": ra, "dec": dec, "name": [f"a{k}" for k in range(10)]}
    second = {"ra": ra + 0.1 / 3600.0, "dec": dec, "name": [f"b{k}" for k in range(10)]}
    swapped = second | {"name": [*(f"b{k}" for k in (1, 0)), *(f"b{k}" for k in range(2, 10))]}
    return first, second, swapped


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("ending", ["fits", "csv", "parquet"])
def test_only_actual_changes_are_listed(tables, tmp_path, ending: str) -> None:
    first, second, swapped = tables
    for name, other in (("before", second), ("after", swapped)):
        sameas.match({**first}, other, sigma=0.2, id="name").write(tmp_path / f"{name}.{ending}")
    text = str(sameas.compare(tmp_path / f"before.{ending}", tmp_path / f"after.{ending}"))
    assert "20 in both" in text and "8 objects of two records or more" in text
    assert "4 of 20 are of another object" in text
    for words in ("first a0", "second b0, probability", "second b1, probability"):
        assert words in text
    assert "a5" not in text
    same = str(sameas.compare(tmp_path / f"before.{ending}", tmp_path / f"before.{ending}"))
    assert "0 of 20 are of another object" in same and "10 objects" in same


def test_a_partner_missing_from_the_other_table_is_a_difference(tmp_path) -> None:
    first = {"ra": [10.0, 10.1], "dec": [0.0, 0.0], "name": ["a0", "a1"]}
    for name, nearer in (("before", "b0"), ("after", "b2")):
        other = {"ra": [10.00001, 10.10001], "dec": [0.0, 0.0], "name": [nearer, "b1"]}
        sameas.match(first, other, sigma=0.2, id="name").write(tmp_path / f"{name}.fits", join="1and2")
    text = str(sameas.compare(tmp_path / "before.fits", tmp_path / "after.fits"))
    assert "1 only in before.fits" in text and "1 of 3 are of another object" in text
    assert "first a0" in text and "second b0, probability" in text and "second b2, probability" in text


def test_extra_candidates_of_a_join_of_all_are_no_difference(tables, tmp_path) -> None:
    first, second, _ = tables
    ra, dec = (np.concatenate([np.asarray(second[name]), np.asarray(second[name])]) for name in ("ra", "dec"))
    ra[10:] += 0.3 / 3600.0
    crowd = {"ra": ra, "dec": dec, "name": [f"b{k}" for k in range(20)]}
    for name, join in (("best", "1or2"), ("all", "pairs")):
        sameas.match(first, crowd, sigma=0.2, id="name").write(tmp_path / f"{name}.fits", join=join)
    text = str(sameas.compare(tmp_path / "best.fits", tmp_path / "all.fits"))
    assert " 0 of" in text.split("records moved")[1]


@pytest.mark.slow
def test_an_excluded_sensor_is_no_difference_by_itself(tmp_path) -> None:
    times = np.arange(0.0, 60.0, 5.0)
    ais = {"time": times, "mmsi": ["235000001"] * 12, "x_m": 5.0 * times, "y_m": 0.0 * times}
    radar = {"time": times, "track_id": ["7"] * 12, "x_m": 5.0 * times + 2.0, "y_m": 0.0 * times}
    lidar = {"time": times, "track_id": ["3"] * 12, "x_m": 5.0 * times - 1.0, "y_m": 0.0 * times}
    sensors = tmp_path / "sensors.toml"
    sensors.write_text("[sources.radar]\nkind = 'tracks'\nerrors = { position_m = 5 }\n")
    sources = {"ais": ais, "radar": radar, "lidar": lidar}
    for name, without in (("with", ()), ("without", "lidar")):
        found = sameas.match_picture(sources, sensors=sensors, every=20.0, without=without, registration=False)
        found.write(tmp_path / name, map=False, image=False)
    text = str(sameas.compare(tmp_path / "with", tmp_path / "without"))
    assert "6 in both; 3 only in with" in text and "0 of 6 are of another object" in text


@pytest.mark.slow
def test_two_records_of_a_picture_are_one_or_two_with_a_reason(tmp_path) -> None:
    times = np.arange(0.0, 60.0, 5.0)
    east, mmsi = np.concatenate([5.0 * times, 9000.0 + 5.0 * times]), ["235000001"] * 12 + ["235000002"] * 12
    ais = {"time": np.tile(times, 2), "mmsi": mmsi, "x_m": east, "y_m": 0.0 * east}
    radar = {"time": times, "track_id": ["7"] * 12, "x_m": 5.0 * times + 2.0, "y_m": 0.0 * times}
    sensors = tmp_path / "sensors.toml"
    sensors.write_text("[sources.radar]\nkind = 'tracks'\nerrors = { position_m = 5 }\n")
    found = sameas.match_picture({"ais": ais, "radar": radar}, sensors=sensors, every=20.0, registration=False)
    found.write(tmp_path / "out", map=False, image=False)
    for explain in (found.explain, lambda *one, **more: sameas.explain(tmp_path / "out", *one, **more)):
        one = str(explain("235000001", other="radar:7"))
        assert "ais 235000001 and radar 7 are one object" in one and "together              at 3 of the 3" in one
        assert "apart                 2 m, " in one and "Why, as at " in one and "log-odds  terms" in one
        two = str(explain("radar:7", other="235000002"))
        assert "are two objects" in two and "at 0 of the 3" in two and "never a probable pair" in two
        assert "apart                 ais 235000001 and radar 7: 2 m" in str(explain("235000001"))
        with pytest.raises(InputError, match="no object and no track 9"):
            explain("235000001", other="9")
        with pytest.raises(InputError, match="have no tracks of two sources"):
            explain("ais:235000001", other="ais:235000002")


def test_the_command_compares_and_refuses_unrelated_outputs(tables, tmp_path) -> None:
    from typer.testing import CliRunner

    first, second, swapped = tables
    for name, other in (("before", second), ("after", swapped)):
        sameas.match(first, other, sigma=0.2, id="name").write(tmp_path / f"{name}.fits")
    shown = CliRunner().invoke(app, ["compare", str(tmp_path / "before.fits"), str(tmp_path / "after.fits")])
    assert shown.exit_code == 0 and "4 of 20 are of another object" in shown.output
    elsewhere = {"ra": second["ra"], "dec": second["dec"], "name": [f"z{k}" for k in range(10)]}
    others = {"ra": first["ra"], "dec": first["dec"], "name": [f"y{k}" for k in range(10)]}
    sameas.match(others, elsewhere, sigma=0.2, id="name").write(tmp_path / "other.fits")
    with pytest.raises(InputError, match="have no record in common; give outputs of the same catalogues"):
        sameas.compare(tmp_path / "before.fits", tmp_path / "other.fits")
    with pytest.raises(InputError, match=r"has no objects.parquet"):
        sameas.compare(tmp_path, tmp_path)


def test_names_in_tables_are_printed_escaped(tmp_path) -> None:
    ra, evil = 10.0 + np.arange(10) * 20.0 / 3600.0, "\x1b[31m<script>\n=cmd()\u202e"
    for name, order in (("before", range(10)), ("after", (1, 0, *range(2, 10)))):
        second = {"ra": ra + 0.1 / 3600.0, "dec": np.zeros(10), "name": [f"{evil}{k}" for k in order]}
        answer = sameas.match({"ra": ra, "dec": np.zeros(10), "name": [f"{evil}a{k}" for k in range(10)]}, second,
                              sigma=0.2, id="name")  # fmt: skip
        answer.write(tmp_path / f"{name}.parquet")
    done = CliRunner().invoke(app, ["compare", *(str(path) for path in sorted(tmp_path.iterdir()))])
    assert done.exit_code == 0 and "\\x1b[31m<script>" in done.output
    assert all(line.isprintable() for line in done.output.split("\n"))


def test_a_difference_that_lasts_is_listed_once_with_its_span() -> None:
    """It was listed at each of its instants, and hid the others."""
    times = [100.0 + 10.0 * k for k in range(30)]
    records = [(t, source, "7") for t in times for source in ("ais", "radar")]
    joined = ComparedObjects("one", {r: k // 2 for k, r in enumerate(records)}, {k: 0.9 + 0.003 * k for k in range(30)})
    apart = ComparedObjects("two", {r: k for k, r in enumerate(records)}, dict.fromkeys(range(60), 0.8))
    lines = "\n".join(comparison_lines(joined, apart, set(records)))
    assert lines.count("ais 7 at 30 instants from 100 s to 390 s") == 1 and "\nand " not in lines
    assert "radar 7, probability 0.9000 to 0.9870" in lines and "no partner, probability 0.8000" in lines
