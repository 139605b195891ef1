"""Frames of many observatories are read; unusable ones are refused in one clear line."""

import gzip
import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits

from sameas.errors import InputError
from sameas.sky.frame.image import Frame, decoder_can_crash, read
from sameas.sky.frame.keywords import Given
from sameas.sky.frame.measurements import Flag

SKY = np.random.default_rng(2).normal(1000.0, 10.0, (40, 60))


def saved(path, *hdus):
    fits.HDUList(list(hdus)).writeto(path)
    return path


def test_all_file_types_give_the_same_pixels(tmp_path):
    whole = np.rint(SKY).astype(np.uint16)
    plain = saved(tmp_path / "plain.fits", fits.PrimaryHDU(whole))
    packed = tmp_path / "packed.fits.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    tiled = saved(tmp_path / "tiled.fits.fz", fits.PrimaryHDU(), fits.CompImageHDU(whole))
    cube = saved(tmp_path / "cube.fits", fits.PrimaryHDU(whole[None].astype(np.float64)))
    scaled = fits.PrimaryHDU(whole.astype(np.float32))
    scaled.scale("int16", bscale=0.5, bzero=900.0)
    for path in (plain, packed, tiled, cube, saved(tmp_path / "scaled.fits", scaled)):
        np.testing.assert_allclose(read(path).image, whole, atol=0.3)


def test_the_image_extension_is_chosen_and_reported(tmp_path):
    path = saved(
        tmp_path / "multi.fits",
        fits.PrimaryHDU(),
        fits.ImageHDU(SKY, name="CHIP1"),
        fits.ImageHDU(SKY + 5, name="CHIP2"),
    )
    first = read(path)
    assert any("extension 1 (CHIP1) taken; also there: 2 (CHIP2)" in line for line in first.facts.lines)
    assert read(path, hdu="CHIP2").image.mean() == pytest.approx(first.image.mean() + 5, abs=1e-3)
    assert read(path, hdu=2).image.mean() == pytest.approx(first.image.mean() + 5, abs=1e-3)
    with pytest.raises(InputError, match=r"no image in extension CHIP3; images: 1 \(CHIP1\), 2 \(CHIP2\)"):
        read(path, hdu="CHIP3")


def test_quality_and_error_planes_are_read_with_the_image(tmp_path):
    quality = np.zeros(SKY.shape, np.int16)
    quality[3, 4] = 16
    path = saved(
        tmp_path / "hst.fits",
        fits.PrimaryHDU(),
        fits.ImageHDU(SKY, name="SCI"),
        fits.ImageHDU(np.full(SKY.shape, 3.0), name="ERR"),
        fits.ImageHDU(quality, name="DQ"),
    )
    frame = read(path)
    assert frame.masked.sum() == 1 and frame.masked[3, 4]
    assert frame.sigma[0, 0] == 3.0


def test_named_bits_of_a_mask_are_understood(tmp_path):
    plane = fits.ImageHDU(np.zeros(SKY.shape, np.int32), name="MASK")
    plane.data[1, 1], plane.data[2, 2], plane.data[3, 3] = 1 << 0, 1 << 2, 1 << 5
    plane.header.update({"MP_BAD": 0, "MP_SAT": 2, "HIERARCH MP_DETECTED": 5})
    frame = read(saved(tmp_path / "rubin.fits", fits.PrimaryHDU(), fits.ImageHDU(SKY, name="IMAGE"), plane))
    assert frame.flags[1, 1] == Flag.MASKED and frame.flags[2, 2] == Flag.SATURATED and frame.flags[3, 3] == 0


def test_pixels_in_the_users_mask_and_nan_pixels_are_excluded(tmp_path):
    image = SKY.copy()
    image[0, 0] = np.nan
    mask = np.zeros(SKY.shape, np.uint16)
    mask[5, 6] = 1
    frame = read(
        saved(tmp_path / "a.fits", fits.PrimaryHDU(image)), mask=saved(tmp_path / "m.fits", fits.PrimaryHDU(mask))
    )
    assert np.argwhere(frame.masked).tolist() == [[0, 0], [5, 6]]
    assert np.isfinite(frame.image).all()


def test_three_planes_of_colours_are_one_image(tmp_path):
    planes = np.stack([0.5 * SKY, SKY, 0.6 * SKY])
    planes[1, 10:16, 10:20] = 65_535
    header = fits.Header({"GAIN": 1.5, "EXPTIME": 10.0})
    fits.writeto(tmp_path / "rgb.fits", planes.astype(np.uint16), header)
    frame = read(tmp_path / "rgb.fits")
    assert frame.shape == SKY.shape
    assert frame.image == pytest.approx(planes.astype(np.uint16).mean(axis=0), rel=1e-6)
    assert ((frame.flags & Flag.SATURATED) != 0).sum() == 60
    assert "image: the mean of three planes of colours" in frame.facts.lines
    assert np.isnan(frame.facts.gain_e_per_adu)
    assert read(tmp_path / "rgb.fits", given=Given(gain_e_per_adu=2.0)).facts.gain_e_per_adu == 2.0
    fits.writeto(tmp_path / "cube.fits", np.stack([SKY] * 5))
    with pytest.raises(InputError, match=r"shape \(5, .* three planes of colours"):
        read(tmp_path / "cube.fits")


def test_saturation_is_estimated_from_the_pixels_if_not_given():
    image = SKY.copy()
    image[10:16, 10:20] = 30_000.0
    image[20:24, 10:13] += np.linspace(500, 20_000, 12).reshape(4, 3)
    frame = Frame.of(image)
    assert ((frame.flags & Flag.SATURATED) != 0).sum() == 60
    assert Frame.of(SKY.astype(np.uint16)).facts.saturation_adu == 65535


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: p.write_bytes(b"not a fits file" * 300), "cannot be read as FITS"),
        (lambda p: saved(p, fits.PrimaryHDU()), "no image of two dimensions"),
        (lambda p: saved(p, fits.PrimaryHDU(np.full((20, 20), np.nan))), "no pixel is a finite number"),
        (lambda p: saved(p, fits.PrimaryHDU(np.full((20, 20), 65535, np.uint16))), "all pixels have the value 65535"),
        (lambda p: saved(p, fits.PrimaryHDU(np.ones((3, 3)))), r"shape \(3, 3\); give one of two dimensions"),
    ],
)
def test_bad_files_are_refused_by_name(tmp_path, make, message):
    path = tmp_path / "bad.fits"
    make(path)
    with pytest.raises(InputError, match=message) as error:
        read(path)
    assert "bad.fits" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("packed", [False, True])
def test_a_file_cut_short_is_refused(tmp_path, packed):
    path = saved(tmp_path / "whole.fits", fits.PrimaryHDU(SKY))
    content = gzip.compress(path.read_bytes()) if packed else path.read_bytes()
    short = tmp_path / ("short.fits.gz" if packed else "short.fits")
    short.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"short\.fits.* cut (short|off) .*copy it again"):
        read(short)


def test_a_missing_file_and_a_frame_full_of_light_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read(tmp_path / "nowhere.fits")
    path = saved(tmp_path / "bright.fits", fits.PrimaryHDU(SKY))
    with pytest.raises(InputError, match="of the pixels are saturated"):
        read(path, given=Given(saturation_adu=900.0))


def test_a_missing_time_is_a_doubt_and_refused_only_if_needed(tmp_path):
    frame = read(saved(tmp_path / "timeless.fits", fits.PrimaryHDU(SKY)))
    assert any(line.startswith("doubt: the header has no time") for line in frame.facts.lines)
    with pytest.raises(InputError, match=r"timeless\.fits: the header has no time"):
        frame.facts.time()


@pytest.mark.slow
def test_a_damaged_compressed_image_is_refused_without_a_crash(tmp_path):
    sky = SKY.astype(np.int16)
    image = fits.CompImageHDU(sky, compression_type="HCOMPRESS_1")
    path = saved(tmp_path / "h.fits.fz", fits.PrimaryHDU(), image)
    content = bytearray(path.read_bytes())
    np.testing.assert_array_equal(read(path).image, sky)
    with fits.open(path) as hdus:
        begin = hdus[1].fileinfo()["datLoc"] + 30
    content[begin:] = np.random.default_rng(3).bytes(len(content) - begin)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"h\.fits\.fz: its compressed image is damaged \(.*\); copy it again"):
        read(path)


def cut_short(kind, path):
    """A compressed image whose tile is shorter than its decoder believes: it reads on until its memory ends."""
    image = fits.CompImageHDU(np.zeros((4000, 4000), np.int16), compression_type=kind, tile_shape=(4000, 4000))
    saved(path, fits.PrimaryHDU(), image)
    content = bytearray(path.read_bytes())
    with fits.open(path, disable_image_compression=True) as hdus:
        descriptor = hdus[1].fileinfo()["datLoc"]
    tile = descriptor + 8
    if kind == "PLIO_1":
        content[tile + 6 : tile + 12] = np.array([0, 32767, 32767], ">i2").tobytes()  # length of the list
        content[tile + 14 :] = bytes(len(content) - tile - 14)
    else:
        content[descriptor : descriptor + 4] = (6).to_bytes(4, "big")
        content[tile : tile + 6] = bytes([0, 0, 0x10, 0, 0, 0])
        card = content.index(b"ZVAL1   =")
        content[card : card + 80] = f"ZVAL1   = {1 << 30:>20}".encode().ljust(80)
    path.write_bytes(content)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["PLIO_1", "RICE_1"])
def test_a_decoder_that_reads_beyond_its_memory_ends_only_its_own_process(tmp_path, kind):
    program = """
import sys
from sameas.errors import InputError
from sameas.sky.frame.image import read

try:
    read(sys.argv[1])
except InputError as error:
    print(error)
"""
    path = cut_short(kind, tmp_path / "cut.fits.fz")
    run = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True)
    assert run.returncode == 0 and "cut.fits.fz: its compressed image is damaged" in run.stdout, run


@pytest.mark.parametrize(
    ("cards", "can_crash"),
    [({}, False), ({"ZVAL1": 1 << 20}, True), ({"ZVAL2": 8}, True), ({"ZTILE2": 2000}, True),
     ({"ZCMPTYPE": "PLIO_1"}, True), ({"ZCMPTYPE": "GZIP_1"}, False)],
)  # fmt: skip
def test_usual_rice_images_are_decoded_in_the_process_itself(cards, can_crash):
    usual = {
        "ZCMPTYPE": "RICE_1", "ZNAXIS": 2, "ZNAXIS1": 4000, "ZNAXIS2": 4000, "ZTILE1": 4000, "ZTILE2": 1,
        "ZNAME1": "BLOCKSIZE", "ZVAL1": 32, "ZNAME2": "BYTEPIX", "ZVAL2": 2,
    }  # fmt: skip
    assert decoder_can_crash(fits.Header(usual | cards)) is can_crash


def test_a_decoder_that_hangs_is_stopped(tmp_path, monkeypatch):

    path = saved(
        tmp_path / "h.fits.fz",
        fits.PrimaryHDU(),
        fits.CompImageHDU(SKY.astype(np.int16), compression_type="HCOMPRESS_1"),
    )
    run = subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda command, timeout, **given: run(
        [command[0], "-c", "import time; time.sleep(60)"], timeout=0.2 * bool(timeout), **given
    ))  # fmt: skip
    with pytest.raises(InputError, match=r"h\.fits\.fz: its compressed image could not be decoded in 120 s"):
        read(path)
