"""Tables of DAOPHOT: IRAF's text databases and Stetson's files, with directions by the image beside them."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from sameas.errors import InputError
from sameas.io import read_table
from sameas.sky import Catalogue

#: As IRAF's allstar writes it, with lines that continue.
ALS = """\
#K IRAF       = NOAO/IRAFV2.16.1        version    %-23s
#K TASK       = allstar                 name       %-23s
#K IMAGE      = ngc.fits[1]             imagename  %-23s
#
#N ID    XCENTER   YCENTER   MAG         MERR          MSKY           NITER    \\
#U ##    pixels    pixels    magnitudes  magnitudes    counts         ##       \\
#F %-9d  %-10.3f   %-10.3f   %-12.3f     %-14.3f       %-15.7g        %-6d
#
#N         SHARPNESS   CHI         PIER  PERROR                                \\
#U         ##          ##          ##    perrors                               \\
#F         %-23.3f     %-12.3f     %-6d  %-13s
#
14       138.538   256.405   15.461      0.003         34.85955       4        \\
           -0.032      0.802       0     No_error
18       18.114    280.170   22.329      0.206         INDEF          4        \\
           -2.544      1.104       0     No_error
"""
#: Two apertures; the last block is repeated for each.
MAG = """\
#K IRAF       = NOAO/IRAFV2.16.1        version    %-23s
#K TASK       = phot                    name       %-23s
#
#N IMAGE               XINIT     YINIT     ID    COORDS                 LID    \\
#U imagename           pixels    pixels    ##    filename               ##     \\
#F %-23s               %-10.3f   %-10.3f   %-6d  %-23s                  %-6d
#
#N XCENTER    YCENTER    XSHIFT  YSHIFT  XERR    YERR            CIER CERROR   \\
#U pixels     pixels     pixels  pixels  pixels  pixels          ##   cerrors  \\
#F %-14.3f    %-11.3f    %-8.3f  %-8.3f  %-8.3f  %-15.3f         %-5d %-9s
#
#N RAPERT   SUM           AREA       FLUX          MAG    MERR   PIER PERROR   \\
#U scale    counts        pixels     counts        mag    mag    ##   perrors  \\
#F %-12.2f  %-14.7g       %-11.7g    %-14.7g       %-7.3f %-6.3f %-5d %-9s
#
ngc.fits               138.100   256.100   14    ngc.coo                1      \\
   138.538    256.405    0.048   -0.098  0.016   0.014          0    NoError   \\
   3.00     1234.5        28.5       1000.         15.561 0.003 0    NoError  *\\
   6.00     1234.5        113.       1100.         15.461 0.004 0    NoError  *
ngc.fits               18.100    280.100   18    ngc.coo                2      \\
   18.114     280.170    0.048   -0.098  0.016   0.014          0    NoError   \\
   3.00     1234.5        28.5       1000.         22.329 0.206 0    NoError  *\\
   6.00     1234.5        113.       1100.         INDEF  INDEF 305  BadPixels*
"""
HEAD = """\
 NL    NX    NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD
  {}  2048  2048   -57.1 30000.0   12.50    3.00    1.60    4.20    5.00

"""
STETSON = {
    "ngc.als": HEAD.format(1)
    + """\
     14  138.538  256.405   15.461   0.0030   34.860       4.    0.802   -0.032
     18   18.114  280.170   22.329   0.2060   34.860       4.    1.104   -2.544
""",
    "ngc.coo": HEAD.format(1)
    + """\
     14  138.538  256.405   -4.539    0.601    0.102    0.002
     18   18.114  280.170    2.329    0.551   -0.030   -0.010
""",
    "ngc.ap": HEAD.format(2)
    + """\

     14  138.538  256.405   15.461   15.361
      34.860  5.12  0.10  0.0030  0.0040

     18   18.114  280.170   22.329   99.999
      34.860  5.12  0.10  0.2060  9.9999
""",
}
TABLES = STETSON | {"ngc.fits.als.1": ALS, "ngc.fits.mag.1": MAG, "ngc.txt": ALS, "stars.als": ALS}


def solved_image(path):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [83.0, -0.1], [100.0, 200.0]
    wcs.wcs.cd = np.array([[-0.5, 0.1], [0.1, 0.5]]) / 3600.0
    header = wcs.to_header()
    header["DATE-OBS"] = "2020-03-01T03:00:00"
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.zeros((4, 4), np.int16), header)]).writeto(path)
    return wcs


@pytest.mark.parametrize("name", TABLES)
def test_pixels_become_directions_by_the_image_beside_the_table(name, tmp_path):
    (tmp_path / name).write_text(TABLES[name])
    wcs = solved_image(tmp_path / "ngc.fits")
    table = read_table(tmp_path / name)
    expected = wcs.all_pix2world([138.538, 18.114], [256.405, 280.17], 1)
    assert np.allclose([table["ra"], table["dec"]], expected, rtol=0, atol=1e-12)
    assert table["ID" if "ID" in table.colnames else "id"].tolist() == [14, 18]
    assert "by the solution of ngc.fits" in table.meta["sameas_notes"][0]
    catalogue = Catalogue.of(table, "ngc")
    assert catalogue.choice.epoch.jyr == pytest.approx(2020.163, abs=0.001)
    assert catalogue.choice.error.kind == "unknown", "errors of magnitudes and pixels are no errors of directions"
    first_aperture = catalogue.magnitude[0]
    assert first_aperture == pytest.approx({"ngc.coo": -4.539, "ngc.fits.mag.1": 15.561}.get(name, 15.461))


def test_cells_and_magnitudes_without_a_value_are_missing(tmp_path):
    for name, content in TABLES.items():
        (tmp_path / name).write_text(content)
    assert read_table(tmp_path / "ngc.txt")["MSKY"].mask.tolist() == [False, True]
    assert read_table(tmp_path / "ngc.fits.mag.1")["MAG2"].mask.tolist() == [False, True]
    two = read_table(tmp_path / "ngc.ap")
    assert two.colnames[:5] == ["id", "x", "y", "mag", "mag_1"] and two["mag_err_1"].tolist() == [0.004, 9.9999]


@pytest.mark.parametrize("name", ["ngc.als", "ngc.fits.als.1"])
def test_without_the_image_the_refusal_names_it(name, tmp_path):
    (tmp_path / name).write_text(TABLES[name])
    table = read_table(tmp_path / name)
    assert len(table) == 2 and "ra" not in table.colnames
    with pytest.raises(InputError, match=r"but pixels .*; .* plate solution, ngc.fits, is in its folder"):
        Catalogue.of(table, "ngc")


def test_other_text_under_the_extensions_of_daophot_is_read_as_what_it_is(tmp_path):
    (tmp_path / "list.coo").write_text("ra dec\n150.0 2.0\n150.1 2.1\n")
    assert read_table(tmp_path / "list.coo")["ra"].tolist() == [150.0, 150.1]


def test_a_head_without_stars_is_refused(tmp_path):
    (tmp_path / "ngc.als").write_text(HEAD.format(1))
    with pytest.raises(InputError, match="no stars below its head"):
        read_table(tmp_path / "ngc.als")
