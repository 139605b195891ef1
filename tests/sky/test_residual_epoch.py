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


MISREAD = {
    "without cos": (lambda east, north, cos: (east / cos, north), "pmra did not contain cos(dec): multiply it"),
    "exchanged": (lambda east, north, cos: (north, east), "pmra and pmdec were exchanged: give pm{side}='pmdec,pmra'"),
    "sign east": (lambda east, north, cos: (-east, north), "pmra had the other sign"),
    "sign north": (lambda east, north, cos: (east, -north), "pmdec had the other sign"),
    "arcsec": (lambda east, north, cos: (1e-3 * east, 1e-3 * north), "were in arcsec/yr, not mas/yr"),
    "unequal": (lambda east, north, cos: (0.3 * east, 0.6 * north), " north, which no epoch explains: are they in the"),
}


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("misread", MISREAD)
def test_motions_in_another_convention_are_not_taken_for_a_wrong_epoch(misread: str, swapped: bool) -> None:
    """Each was once doubted as a wrong epoch, up to the year 26612."""
    change, words = MISREAD[misread]
    rng = np.random.default_rng(3)
    n, cos = 800, np.cos(np.radians(60.0))
    ra, dec = 100.0 + rng.uniform(0.0, 1.0, n), 60.0 + rng.uniform(-0.25, 0.25, n)
    motion = rng.normal(0.0, 12.0, (n, 2))
    off = -16.0 * 1e-3 * motion + rng.normal(0.0, 0.1, (n, 2))
    old = Table({"RA": ra + off[:, 0] / 3600.0 / np.cos(np.radians(dec)), "DEC": dec + off[:, 1] / 3600.0})
    old["sigma_arcsec"] = 0.1
    pmra, pmdec = change(motion[:, 0], motion[:, 1], cos)
    gaia = Table({"ra": ra, "dec": dec, "pmra": pmra, "pmdec": pmdec})
    gaia["ra_error"] = gaia["dec_error"] = gaia["pmra_error"] = gaia["pmdec_error"] = 0.1
    tables, epochs = ((old, gaia), (2000.0, 2016.0)) if swapped else ((gaia, old), (2016.0, 2000.0))
    doubts = [doubt for doubt in _doubts(*tables, epochs) if "follow the proper motions" in doubt]
    assert len(doubts) == 1 and words.format(side=2 if swapped else 1) in doubts[0], doubts


@pytest.mark.slow
def test_quoted_errors_below_a_floor_do_not_bias_the_epoch():
    """By the quoted errors the brightest stars had all the weight, and those that moved most counted as outliers."""
    years = []
    for seed in range(3):
        rng, n = np.random.default_rng(seed), 1500
        ra, dec = 100.0 + rng.uniform(0.0, 0.5, n), 30.0 + rng.uniform(0.0, 0.5, n)
        pm, magnitude = rng.normal(0.0, 8.0, (n, 2)), np.minimum(20.0, 21.0 - rng.exponential(1.5, n))
        quoted = 0.05 * 10.0 ** (0.2 * (magnitude - 20.0))
        off = -12.8e-3 * pm + np.hypot(quoted, 0.03)[:, None] * rng.normal(size=(n, 2))  # at 2003.2
        gaia = Table({"ra": ra, "dec": dec, "pmra": pm[:, 0], "pmdec": pm[:, 1], "phot_g_mean_mag": magnitude})
        east, north = off.T / 3600.0
        old = Table({"RA": ra + east / np.cos(np.radians(dec)), "DEC": dec + north, "sigma_arcsec": quoted})
        doubts = _doubts(gaia, old, (2016.0, None))
        (found,) = [re.search(r"were (\d+\.\d+) ±", doubt) for doubt in doubts if "follow the proper motions" in doubt]
        years.append(float(found[1]))
    assert abs(np.mean(years) - 2003.2) < 0.3


@pytest.mark.parametrize("swapped", [False, True])
def test_a_common_epoch_that_a_catalogue_without_motions_cannot_reach_is_named(swapped):
    # The stars of one were moved past those of two, which were said to be moved too; then its right epoch was doubted.
    gaia, old = _sky()
    gaia["pmra"], gaia["pmdec"] = 10.0 * gaia["pmra"], 10.0 * gaia["pmdec"]
    tables = (old, gaia) if swapped else (gaia, old)
    epochs = ("2000", "2016") if swapped else ("2016", "2000")
    first, second = (
        Catalogue.of(table, name, options=CatalogueOptions(epoch=epoch))
        for table, name, epoch in zip(tables, ("one", "two"), epochs, strict=True)
    )
    moving, staying = ("two", "one") if swapped else ("one", "two")
    found = match(first, second, MatchOptions(epoch_jyr=2024.0, magnitudes="off"))
    assert found.moved == f"{moving} moved to 2024 (option); {staying} has no motions and stays at 2000.00"
    doubts = [str(doubt) for doubt in found.doubts]
    assert not any("as if the epoch" in doubt for doubt in doubts)
    (named,) = [doubt for doubt in doubts if "has no proper motions" in doubt]
    assert named.startswith(f"{staying} has no proper motions and stays at 2000.0, while {moving} is moved to 2024")
    assert "without a common epoch" in named
    reached = match(first, second, MatchOptions(epoch_jyr=2000.0, magnitudes="off"))
    assert not any("has no proper motions" in str(doubt) for doubt in reached.doubts)


def test_a_common_epoch_of_catalogues_without_motions_is_not_said_to_move_them():
    gaia, old = _sky()
    del gaia["pmra"], gaia["pmdec"]
    first, second = Catalogue.of(gaia, "one", options=CatalogueOptions(epoch="2000")), Catalogue.of(old, "two")
    note = match(first, second, MatchOptions(epoch_jyr=2024.0, magnitudes="off")).moved
    assert note == "2024 (option), but neither catalogue has proper motions: no positions are moved, errors are widened"
