"""Frames of DSLR cameras and smart telescopes: photographs, mosaics of colour filters, wrapped numbers."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

from sameas.errors import InputError
from sameas.simulate.frames import Camera, GaussianProfile, frame_of
from sameas.sky.frame.bayer import without_mosaic
from sameas.sky.frame.detect import Detection, detect
from sameas.sky.frame.image import read

pytest.importorskip("photutils", reason="finding stars needs the extra sameas[frames]")

SIDE, RESPONSE = 400, np.array([[1.0, 0.6], [0.5, 0.95]])


@pytest.fixture(scope="module")
def plain():
    """A frame of 300 stars without a mosaic."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(10, SIDE - 10, (2, 300))
    return frame_of(
        rng, x_px=x, y_px=y, flux_e=200 * rng.pareto(0.7, 300) + 200, psf=GaussianProfile(2.4),
        camera=Camera(shape=(SIDE, SIDE)),
    ).frame  # fmt: skip


@pytest.fixture(scope="module")
def mosaic(plain):
    """The same light, and a sky with a slope, through filters."""
    filters = np.tile(RESPONSE, (SIDE // 2, SIDE // 2))
    sky = np.median(plain.image)
    slope = np.linspace(0.0, 300.0, SIDE)
    return replace(plain, image=((plain.image - sky) * filters + (1000.0 + slope) * filters**2).astype(np.float32))


def test_levels_and_responses_of_a_mosaic_are_made_equal(plain, mosaic):
    even = without_mosaic(mosaic)
    medians = [np.median(even.image[y::2, x::2]) for y in (0, 1) for x in (0, 1)]
    assert np.ptp(medians) < 2.0
    shown = next(line for line in even.facts.lines if "a mosaic of colours" in line)
    found = [float(word) for word in shown[shown.index("(") + 1 : shown.index(")")].split(", ")]
    assert found == pytest.approx(RESPONSE.ravel(), abs=0.06)


@pytest.mark.slow
def test_faint_stars_on_a_mosaic_are_found(plain, mosaic):
    """The pattern of the sky was taken for noise."""
    raw, even, best = (len(detect(frame, Detection())) for frame in (mosaic, without_mosaic(mosaic), plain))
    assert raw < 0.7 * best and even > 0.8 * best


def test_an_odd_number_of_rows_makes_no_difference(mosaic):
    odd = replace(mosaic, image=mosaic.image[:-17], flags=mosaic.flags[:-17])
    even = without_mosaic(odd).image
    assert np.ptp([np.median(even[y::2, x::2]) for y in (0, 1) for x in (0, 1)]) < 2.0


def test_a_frame_without_a_mosaic_stays_as_it_is(plain):
    assert without_mosaic(plain) is plain


def test_numbers_that_were_stored_as_signed_are_unsigned_again(plain, tmp_path):
    """Every bright star had a hole in it."""
    counts = np.clip(25 * plain.image, 0, 65535).astype(np.uint16)
    fits.writeto(tmp_path / "wrapped.fits", counts.view(np.int16))
    frame = read(tmp_path / "wrapped.fits")
    np.testing.assert_array_equal(frame.image, counts)
    assert any(line.startswith("doubt: numbers below zero") for line in frame.facts.lines)
    fits.writeto(tmp_path / "signed.fits", (plain.image - np.median(plain.image)).astype(np.int16))
    assert read(tmp_path / "signed.fits").image.min() < 0


@pytest.mark.parametrize("name", ["m.png", "m.tif", "m.jpg"])
def test_a_photograph_is_read_from_its_lowest_row(name, tmp_path):
    pictures = pytest.importorskip("PIL.Image", reason="reading photographs needs Pillow")
    levels = np.add.outer(np.arange(40), np.arange(60)).astype(np.uint8)
    exif = pictures.Exif()
    exif.get_ifd(0x8769).update({0x9003: "2024:10:18 22:00:00", 0x829A: 30.0})
    for pixels in (levels, np.stack([levels, levels, levels], axis=-1)):
        pictures.fromarray(pixels).save(tmp_path / name, exif=exif)
        frame = read(tmp_path / name)
        np.testing.assert_allclose(frame.image, levels[::-1], atol=3)
        if name == "m.jpg":  # Pillow saves no EXIF in the others
            assert frame.facts.mid_time.isot == "2024-10-18T22:00:15.000"
            assert any("the time is that of the camera, taken for UTC" in line for line in frame.facts.lines)
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:60])
    with pytest.raises(InputError, match="the photograph cannot be read"):
        read(tmp_path / name)
