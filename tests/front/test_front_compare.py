"""Comparison of two outputs with known differences."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

import sameas
from sameas import InputError
from sameas.cli.app import app


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
