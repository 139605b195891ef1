"""Real frames and tables of observers."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

import sameas

FIELD = Path(__file__).parents[2] / ".." / "shared" / "data" / "field"
TYCHO = Path(__file__).parent / "data" / "tycho2_fields.csv"
pytestmark = pytest.mark.skipif(not FIELD.is_dir(), reason="the frames of observers are not here")


@pytest.mark.long
@pytest.mark.parametrize("number", ["20013343", "20014212", "20015412", "20020612"])
def test_every_bright_star_of_a_small_telescope_is_found(number: str) -> None:
    """Trailed and saturated stars on 5″ pixels, an aim and IM_SCALE; measurements outnumber Tycho-2 thirty to one."""
    pytest.importorskip("photutils", reason="finding stars needs the extra sameas[frames]")
    found = sameas.match_frame(FIELD / f"HATP-321712{number}.FITS", TYCHO, sigma="sigma", epoch="epoch", magnitude="VT")
    assert len(found) >= found.sky.inside.sum() - 3 >= 40
    assert found.sky.result.expected_wrong < 3.0 and (found.sky.scatter_arcsec < 4.0).all()


@pytest.mark.long
def test_a_good_header_solution_is_not_degraded() -> None:
    """2MASS towards the Galactic centre: the header is right to 0.2 px; 10 000 measurements, 72 stars of Tycho-2.

    Blends move the bright stars by 2.7″, a quarter of a pixel: the plate states an error of 0.19 px.
    """
    pytest.importorskip("photutils", reason="finding stars needs the extra sameas[frames]")
    found = sameas.match_frame(FIELD / "gc_2mass_j.fits", TYCHO, sigma="sigma", epoch="epoch", time=1999.5)
    assert len(found) >= 60
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        header = WCS(fits.getheader(FIELD / "gc_2mass_j.fits"))
    x, y = (at.ravel() for at in np.meshgrid(np.linspace(0, 720, 9), np.linspace(0, 719, 9)))
    off = np.column_stack(header.all_world2pix(*found.wcs.all_pix2world(x, y, 0), 0)) - np.column_stack([x, y])
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.25 and np.hypot(*off.T).max() < 0.5


def test_two_lists_of_members_of_a_cluster_agree_with_their_identifiers() -> None:
    """Praesepe of Gaia DR2 and of DR3, as VizieR sends them; most stars kept their identifier."""
    formats = FIELD / "formats"
    found = sameas.match(formats / "cg18.tsv", formats / "asu.tsv")
    dr2, dr3 = (np.asarray(found.sky.first.ids), np.asarray(found.sky.second.ids))
    rows_1, rows_2 = found.identification.matches.rows_1, found.identification.matches.rows_2
    same = dr2[rows_1] == dr3[rows_2]
    assert same.sum() == len(np.intersect1d(dr2, dr3)) > 500 and len(rows_1) - same.sum() < 25
