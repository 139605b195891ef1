"""FITS_LDAC of several chips: one table, with directions by the solution of each chip."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from sameas.errors import InputError
from sameas.io import read_table
from sameas.sky import Catalogue


def solution(crpix, mirrored=True):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [0.01, 60.0], crpix
    angle = np.radians(30.0)
    axes = [[-1.0 if mirrored else 1.0, 0.0], [0.0, 1.0]]
    turn = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    wcs.wcs.cd = 0.3 / 3600.0 * np.array(axes) @ turn
    return wcs


def chip(wcs, columns, mjd=58000.5):
    header = wcs.to_header()
    header["MJD-OBS"] = mjd
    lines = [*(card.ljust(80) for card in repr(header).split("\n")), "END".ljust(80)]
    text = np.array([lines], dtype="S80")
    cards = fits.Column("Field Header Card", f"{80 * len(lines)}A", dim=f"(80, {len(lines)})", array=text)
    objects = [fits.Column(name, "D", array=np.asarray(values, float)) for name, values in columns.items()]
    head, table = (fits.BinTableHDU.from_columns(each) for each in ([cards], objects))
    head.name, table.name = "LDAC_IMHEAD", "LDAC_OBJECTS"
    return [head, table]


def written(path, *chips):
    fits.HDUList([fits.PrimaryHDU(), *(hdu for each in chips for hdu in each)]).writeto(path)
    return path


def objects(x, y, a=1.0, b=0.5, theta=20.0):
    ones = np.ones(len(x))
    return {
        "NUMBER": np.arange(1, len(x) + 1), "XWIN_IMAGE": x, "YWIN_IMAGE": y, "ERRAWIN_IMAGE": a * ones,
        "ERRBWIN_IMAGE": b * ones, "ERRTHETAWIN_IMAGE": theta * ones,
    }  # fmt: skip


def test_all_chips_are_one_table_each_with_its_own_solution(tmp_path):
    one, two = solution([1000.0, 1000.0]), solution([-1100.0, 1000.0])
    x, y = np.array([10.0, 500.0, 2000.0]), np.array([30.0, 40.0, 1500.0])
    table = read_table(written(tmp_path / "m.cat", chip(one, objects(x, y)), chip(two, objects(x[:2], y[:2]))))
    assert table["CHIP"].tolist() == [1, 1, 1, 2, 2]
    expected = np.hstack([one.all_pix2world(x, y, 1), two.all_pix2world(x[:2], y[:2], 1)])
    assert np.allclose(table["ALPHAWIN_J2000"], expected[0]) and np.allclose(table["DELTAWIN_J2000"], expected[1])
    assert "2 chips: all are used" in table.meta["sameas_notes"][0] and table.meta["MJD-OBS"] == 58000.5
    assert len(read_table(tmp_path / "m.cat", hdu=4)) == 2
    catalogue = Catalogue.of(table, "mosaic")
    assert catalogue.choice.error.kind == "ellipse" and not catalogue.doubts


@pytest.mark.parametrize("mirrored", [True, False])
def test_error_ellipses_in_pixels_are_those_on_the_sky(mirrored, tmp_path):
    wcs = solution([1000.0, 1000.0], mirrored)
    x, y = np.array([1000.0]), np.array([1000.0])
    columns = chip(wcs, objects(x, y, a=2.0, b=0.5, theta=20.0))
    catalogue = Catalogue.of(read_table(written(tmp_path / "m.cat", columns, columns)), "mosaic")
    # The end of the long axis, a thousandth of it away, is in the direction of the covariance's first axis.
    step = 1e-3 * 2.0 * np.array([np.cos(np.radians(20.0)), np.sin(np.radians(20.0))])
    ra, dec = wcs.all_pix2world([1000.0, 1000.0 + step[0]], [1000.0, 1000.0 + step[1]], 1)
    end = np.array([np.diff(ra)[0] * np.cos(np.radians(dec[0])), np.diff(dec)[0]]) * 3600.0 / 1e-3
    covariance = 1e-6 * catalogue.astrometry.covariance[0, :2, :2]
    values, vectors = np.linalg.eigh(covariance)
    assert np.sqrt(values) == pytest.approx([0.15, 0.6], rel=1e-4)
    assert np.abs(vectors[:, 1] @ end) == pytest.approx(0.6, rel=1e-4)


def test_chips_of_different_times_and_columns(tmp_path):
    x, y = np.array([10.0, 500.0]), np.array([30.0, 40.0])
    wcs = solution([1000.0, 1000.0])
    second = objects(x, y) | {"FLAGS": [0, 1]}
    table = read_table(written(tmp_path / "m.cat", chip(wcs, objects(x, y)), chip(wcs, second, mjd=58001.5)))
    assert "FLAGS" not in table.colnames and "FLAGS" in table.meta["sameas_notes"][1]
    assert table["OBS_MJD"].tolist() == [58000.5, 58000.5, 58001.5, 58001.5] and "MJD-OBS" not in table.meta
    assert Catalogue.of(table, "mosaic").choice.epoch.column == "OBS_MJD"


def test_a_chip_without_a_solution_is_refused_for_its_position(tmp_path):
    empty = WCS(naxis=2)
    path = written(tmp_path / "m.cat", chip(empty, objects(np.ones(2), np.ones(2))))
    with pytest.raises(InputError, match="no columns of right ascension and declination"):
        Catalogue.of(read_table(path), "mosaic")
