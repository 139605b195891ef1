"""Movers below the single-frame limit: detection by shift and stack, calibration, no light counted twice."""

import math
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

import naive
from sameas.errors import InputError
from sameas.kernels.linear import best_motion
from sameas.simulate.frames import Camera, GaussianProfile, frame_of
from sameas.sky.movers.below_limit import Plan, normalise, search_below_limit
from sameas.sky.movers.search import search
from sameas.sky.movers.stack import stack
from sameas.sky.series import Exposure, tie

SIDE, SCALE, RA, DEC, FWHM = 192, 1.0, 150.0, 20.0, 3.0
#: Flux of signal to noise 5 on a frame: 2 √π σ times the noise of a pixel, sky 300 e and read-out 25.
LIMIT_E = 5.0 * 2.0 * math.sqrt(math.pi) * FWHM / 2.3548 * math.sqrt(325.0)


def series(seed, magnitude=None, *, count=10, rate=(-0.4, 0.15), listed=False, stars=40):
    """Frames with stars and one mover, so many magnitudes below their limit; their measurements are those of the stars,
    and of the mover where it is ``listed``."""
    rng = np.random.default_rng(seed)
    at, light = rng.uniform(8, SIDE - 8, (stars, 2)), 10 ** rng.uniform(3.6, 4.8, stars)
    track = np.array([120.4, 70.7]) + np.arange(count)[:, None] * 8.0 * np.array(rate) / SCALE
    flux = [] if magnitude is None else [LIMIT_E * 10 ** (-0.4 * magnitude)]
    frames, exposures = [], []
    for k in range(count):
        xy = np.vstack([at, track[k : k + len(flux)]])
        made = frame_of(
            rng, x_px=xy[:, 0], y_px=xy[:, 1], flux_e=np.append(light, flux), psf=GaussianProfile(FWHM),
            camera=Camera(shape=(SIDE, SIDE), sky_e=300.0, read_noise_e=5.0, hot_pixels=0), name=f"f{k}",
        )  # fmt: skip
        frames.append(made.frame)
        seen = xy if listed else xy[:stars]
        seen = seen + 0.05 * rng.standard_normal(seen.shape)
        n, cov = len(seen), np.tile([0.0025, 0.0, 0.0025], (len(seen), 1))
        dec = DEC + (seen[:, 1] - SIDE / 2) * SCALE / 3600.0
        ra = RA + (seen[:, 0] - SIDE / 2) * SCALE / 3600.0 / np.cos(np.radians(dec))
        exposures.append(
            Exposure(
                f"f{k}", 59300.1 + k * 8.0 / 1440.0, seen[:, 0], seen[:, 1], cov, ra, dec, cov * SCALE**2,
                np.append(light, flux)[:n] / 1.5, np.full(n, 40.0), np.append(light, flux)[:n] / 60.0,
                np.zeros(n, np.int64), np.zeros(n), np.full(n, np.nan), SCALE, (SIDE, SIDE), 60.0, None, FWHM,
            )
        )  # fmt: skip
    return tie(exposures), frames, track


def glinting(frames, seed, each=60):
    """The frames with places of light, six times the noise of a star, at random: what stars leave in crowded fields."""
    rng, out = np.random.default_rng(seed), []
    v, u = np.mgrid[0:SIDE, 0:SIDE]
    for frame in frames:
        image = frame.image.copy()
        for x, y in rng.uniform(5, SIDE - 5, (each, 2)):
            image += 1.2 * LIMIT_E / 1.5 / 10.2 * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 1.274**2)
        out.append(replace(frame, image=image))
    return out


def one(frame):
    return frame


def searched(tied, frames, fastest=0.6, **options):
    found, tied = search(tied)
    return found, tied, search_below_limit(found, tied, [partial(one, frame) for frame in frames], fastest, **options)


@pytest.mark.parametrize("compiled", [False, True])
def test_the_best_motion_of_every_pixel_agrees_with_the_reference(compiled):
    rng = np.random.default_rng(4)
    shape = (4, 9, 11)
    weight = np.where(rng.random(shape) < 0.8, rng.uniform(0.5, 2.0, shape), 0.0).astype(np.float32)
    signal = (rng.standard_normal(shape) * np.sqrt(weight)).astype(np.float32)
    down, right = rng.integers(-3, 4, (6, 4)), rng.integers(-3, 4, (6, 4))
    best, which = np.zeros(shape[1:], np.float32), np.zeros(shape[1:], np.int64)
    run = best_motion.compiled if compiled else best_motion.interpreted
    for a, b in pairwise([0, 4, 9]):
        run(signal, weight, down, right, 2.0, a, b, best, which)
    expected, rate = naive.best_motion(signal, weight, down, right, 2.0)
    np.testing.assert_allclose(best, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(which[best > 0], rate[best > 0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_mover_below_the_single_frame_limit_is_found_and_measured(seed):
    tied, frames, track = series(seed, 0.6)
    found, tied, below = searched(tied, frames)
    assert len(found) == 0 and len(below) == 1 and below.movers.p_tracklet[0] > 0.9
    np.testing.assert_allclose(below.movers.rate_arcsec_per_min[0], [-0.4, 0.15], atol=0.03)
    # In arcsec of the system of the series, whose middle is the middle of the field to a pixel.
    east = (track - track.mean(axis=0)) * SCALE
    np.testing.assert_allclose(below.place[0] - below.place[0].mean(axis=0), east, atol=1.0)
    assert 6.0 < below.snr[0] < 14.0 and below.movers.names == ("sb00001",)
    off = np.hypot(*below.movers.residual_arcsec.T)
    assert (off < 4.0 * np.sqrt(below.movers.detections.covariance[:, 0])).all()
    pixels = stack(below.movers, tied, frames, place=below.place)
    assert not pixels.detected.any() and pixels.snr[0] > 5.0 and pixels.p[0] == pytest.approx(
        below.movers.p_tracklet[0])  # fmt: skip


@pytest.mark.slow
def test_linked_movers_are_not_found_again():
    tied, frames, _ = series(3, -1.5, listed=True)
    found, tied, below = searched(tied, frames)
    assert len(found) == 1 and len(below) == 0
    # Without the tracklet its light is there to be found, once.
    empty = found.only(np.empty(0, np.int64))
    again = search_below_limit(empty, tied, [partial(one, frame) for frame in frames], 0.6)
    assert len(again) == 1


@pytest.mark.slow
def test_noise_and_stars_alone_give_no_probable_candidate():
    tied, frames, _ = series(5)
    _, _, below = searched(tied, frames, min_probability=0.0)
    p = below.movers.p_tracklet
    assert (p > 0.5).sum() == 0 and p.sum() < 1.0
    many, u, s = below.tail
    assert many > 20 and 3.0 < u < 6.0 and 0.85 < s < 1.4


@pytest.mark.slow
def test_aligned_star_residuals_are_no_mover_and_hide_none():
    for magnitude, seed in ((None, 10), (0.4, 9)):
        tied, frames, _ = series(8, magnitude)
        _, _, below = searched(tied, glinting(frames, seed))
        assert (below.movers.p_tracklet > 0.5).sum() == (magnitude is not None)


def test_noise_is_normalised_on_an_uneven_sky():
    rng = np.random.default_rng(2)
    phi = np.ones((256, 256), np.float32)
    v, u = np.mgrid[0:256, 0:256]
    psi = ((1.0 + u / 256) * rng.standard_normal(phi.shape) + 4.0 * v / 256).astype(np.float32)
    normalise(psi, phi)
    z = psi / np.sqrt(phi)
    assert [z[:, part].std() for part in (slice(0, 64), slice(192, 256))] == pytest.approx([1.0, 1.0], abs=0.1)


@pytest.mark.slow
def test_processing_in_strips_changes_nothing():
    tied, frames, _ = series(1, 0.4)
    _, _, whole = searched(tied, frames)
    small = 18 * 10 * SIDE * 150
    assert len(Plan.of(tied, 0.6, small).strips) > 2
    assert Plan.of(tied, 0.6, small).peak_bytes < Plan.of(tied, 0.6).peak_bytes
    _, _, cut = searched(tied, frames, max_bytes=small)
    assert len(whole) == len(cut) == 1 and cut.snr[0] == pytest.approx(whole.snr[0], abs=0.4)
    np.testing.assert_allclose(cut.movers.rate_arcsec_per_min, whole.movers.rate_arcsec_per_min, atol=0.03)


def test_few_frames_and_low_rates_are_refused():
    tied, _, _ = series(1, count=4)
    with pytest.raises(InputError, match="4 frames: stacking needs at least 5"):
        Plan.of(tied, 1.0)
    tied, _, _ = series(1)
    with pytest.raises(InputError, match="less than the PSF width needed"):
        Plan.of(tied, 0.05)
    # The cost grows with the square of the rate.
    assert Plan.of(tied, 1.2).sums > 3.0 * Plan.of(tied, 0.6).sums
