"""Simulated frames contain the given flux at the given positions, with the stated noise and defects."""

import numpy as np
import pytest
from astropy.wcs import WCS

from sameas.errors import InputError
from sameas.simulate.frames import Camera, GaussianProfile, Lens, Moffat, Trail, frame_of, frame_of_sky

QUIET = Camera(shape=(101, 101), sky_e=0.0, read_noise_e=0.0, gain_e_per_adu=1.0, bias_adu=0.0, saturation_e=1e9)


@pytest.mark.parametrize("psf", [GaussianProfile(1.5), GaussianProfile(4.0), Moffat(2.0, 4.0)])
@pytest.mark.parametrize("trail", [None, Trail(15.0, 70.0)])
def test_all_flux_of_a_star_is_around_its_position(psf, trail):
    rng = np.random.default_rng(1)
    image = frame_of(rng, x_px=[50.3], y_px=[48.8], flux_e=[1e5], camera=QUIET, psf=psf, trail=trail).frame.image
    y, x = np.indices(image.shape)
    assert image.sum() == pytest.approx(1e5, rel=0.02)
    assert (image * x).sum() / image.sum() == pytest.approx(50.3, abs=0.05)
    assert (image * y).sum() / image.sum() == pytest.approx(48.8, abs=0.05)


def test_noise_is_photon_and_read_out_noise():
    camera = Camera(shape=(200, 200), sky_e=400.0, read_noise_e=10.0, gain_e_per_adu=2.0, bias_adu=100.0)
    image = frame_of(np.random.default_rng(2), x_px=[], y_px=[], flux_e=[], camera=camera).frame.image
    assert image.mean() == pytest.approx(300, abs=0.5)
    assert image.std() == pytest.approx(np.sqrt(500) / 2, rel=0.03)


def test_defects_are_at_their_stated_pixels():
    camera = Camera(shape=(200, 200), hot_pixels=50, hot_e=1e4, cosmics=20)
    seen = frame_of(np.random.default_rng(3), x_px=[], y_px=[], flux_e=[], camera=camera)
    assert seen.truth.hot.sum() == 50 and seen.truth.struck.sum() >= 20
    clean = ~(seen.truth.hot | seen.truth.struck)
    assert seen.frame.image[seen.truth.struck].min() > np.median(seen.frame.image[clean])
    assert seen.frame.image[clean].max() < 1150


def test_the_same_seed_gives_the_same_frame():
    first, second = (frame_of(np.random.default_rng(4), x_px=[9.0], y_px=[9.0], flux_e=[1e4]).frame for _ in range(2))
    np.testing.assert_array_equal(first.image, second.image)


def test_catalogue_stars_fall_where_the_wcs_and_the_lens_put_them():
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [359.9, 60.0], [256.5, 256.5]
    wcs.wcs.cdelt = [-30 / 3600, 30 / 3600]
    rng = np.random.default_rng(5)
    ra, dec = rng.uniform(350, 370, 3000) % 360, rng.uniform(55, 65, 3000)
    magnitude = np.full(3000, 8.0)
    sky = {"ra_deg": ra, "dec_deg": dec, "magnitude": magnitude, "wcs": wcs, "lens": Lens(6.0)}
    seen = frame_of_sky(rng, **sky, zero_point=16.0, exposure_s=10.0)
    x, y = wcs.all_world2pix(ra[seen.truth.star], dec[seen.truth.star], 0)
    shift = np.hypot(seen.truth.x_px - x, seen.truth.y_px - y)
    radius = np.hypot(x - 255.5, y - 255.5) / np.hypot(255.5, 255.5)
    np.testing.assert_allclose(shift, 6 * radius**3, atol=1e-6)
    assert seen.truth.flux_e[0] == pytest.approx(10 * 10 ** (0.4 * 8))
    inside = (np.abs(wcs.all_world2pix(ra, dec, 0)[0] - 255.5) < 240) & (
        np.abs(wcs.all_world2pix(ra, dec, 0)[1] - 255.5) < 240
    )
    assert np.isin(np.flatnonzero(inside), seen.truth.star).all()


def test_saturated_pixels_stop_at_the_limit():
    camera = Camera(shape=(64, 64), saturation_e=3000.0, gain_e_per_adu=1.0, bias_adu=100.0)
    frame = frame_of(np.random.default_rng(6), x_px=[30.0], y_px=[30.0], flux_e=[1e6], camera=camera).frame
    assert frame.image.max() == camera.saturation_adu() == 3100
    assert (frame.flags & 1).sum() > 4


def test_bad_cameras_and_stars_are_refused():
    with pytest.raises(InputError, match=r"gain_e_per_adu is 0\.0; give a number above zero"):
        Camera(gain_e_per_adu=0.0)
    with pytest.raises(InputError, match=r"beta is 1\.0; above 1 the light is finite"):
        Moffat(beta=1.0)
    with pytest.raises(InputError, match="positions and fluxes that are finite"):
        frame_of(np.random.default_rng(7), x_px=[np.nan], y_px=[1.0], flux_e=[1.0])
