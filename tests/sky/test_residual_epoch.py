"""Residuals along the proper motions reveal a wrongly assumed or stated epoch."""

from __future__ import annotations

import re

import numpy as np
import pytest
from astropy.table import Table

from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import MatchOptions, match


def _sky(shift: float = 0.0, common: float = 0.0) -> tuple[Table, Table]:
    """Gaia's stars at 2016.0 with motions, and the same ones at 2000.0 without."""
    rng = np.random.default_rng(12)
    n = 600
    ra, dec = 100.0 + rng.uniform(0.0, 0.5, n), 30.0 + rng.uniform(0.0, 0.5, n)
    pm = common + rng.normal(0.0, 8.0, (n, 2))
    gaia = Table({"ra": ra, "dec": dec, "pmra": pm[:, 0], "pmdec": pm[:, 1], "phot_g_mean_mag": rng.uniform(12, 17, n)})
    off = -16.0 * 1e-3 * pm + shift + rng.normal(0.0, 0.1, (n, 2))
    old = Table({"RA": ra + off[:, 0] / 3600.0 / np.cos(np.radians(dec)), "DEC": dec + off[:, 1] / 3600.0})
    return gaia, old


def _doubts(one: Table, two: Table, epochs: tuple[float | None, float | None]) -> list[str]:
    first, second = (
        Catalogue.of(table, name, options=CatalogueOptions(epoch=None if epoch is None else str(epoch)))
        for table, name, epoch in ((one, "one", epochs[0]), (two, "two", epochs[1]))
    )
    return [str(doubt) for doubt in match(first, second, MatchOptions(magnitudes="off")).doubts]


@pytest.mark.parametrize("common", [0.0, 10.0])
@pytest.mark.parametrize("assumed", [None, 2010.0])
@pytest.mark.parametrize("swapped", [False, True])
def test_a_wrong_epoch_raises_a_doubt_that_names_the_right_one(common, assumed, swapped):
    gaia, old = _sky(common=common)
    tables, epochs = ((old, gaia), (assumed, 2016.0)) if swapped else ((gaia, old), (2016.0, assumed))
    doubts = _doubts(*tables, epochs)
    stated = [re.search(r"were (\d+\.?\d*) ± (\d+\.?\d*), not", doubt) for doubt in doubts]
    found = [match for match in stated if match]
    assert len(found) == 1, doubts
    year, error = map(float, found[0].groups())
    assert abs(year - 2000.0) < 4.0 * error < 8.0
    assert any(f"give epoch{1 if swapped else 2}=YEAR" in doubt or "give epoch=YEAR" in doubt for doubt in doubts)
    assert not any("offset='find'" in doubt for doubt in doubts), doubts


def test_an_assumed_epoch_of_the_moving_catalogue_is_doubted():
    gaia, old = _sky()
    gaia["ra"].unit = gaia["dec"].unit = "deg"
    doubts = _doubts(gaia, old, (None, 2000.0))  # 2016.0 is assumed, and right
    assert not any("follow the proper motions" in doubt for doubt in doubts)
    off = 6.0 * 1e-3 * np.column_stack([gaia["pmra"], gaia["pmdec"]])  # of 2022
    gaia["ra"] += off[:, 0] / 3600.0 / np.cos(np.radians(gaia["dec"]))
    gaia["dec"] += off[:, 1] / 3600.0
    doubts = _doubts(gaia, old, (None, 2000.0))
    epochs = [re.search(r"epoch of one were (\d+\.?\d*) ± (\d+\.?\d*), not 2016.0", doubt) for doubt in doubts]
    assert any(epochs), doubts


def test_offsets_and_right_epochs_raise_no_doubt():
    gaia, old = _sky(shift=0.1)
    doubts = _doubts(gaia, old, (2016.0, 2000.0))
    assert not any("follow the proper motions" in doubt for doubt in doubts)
    assert any("offset='find'" in doubt for doubt in doubts)
    doubts = _doubts(gaia, old, (2016.0, None))
    assert any("follow the proper motions" in doubt for doubt in doubts)
    assert any("offset='find'" in doubt for doubt in doubts)
