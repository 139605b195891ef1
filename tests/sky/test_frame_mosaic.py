"""Frames through a mosaic of colour filters, as of DSLR and smart telescopes."""

from dataclasses import replace

import numpy as np
import pytest

from sameas.simulate.frames import Camera, GaussianProfile, frame_of
from sameas.sky.frame.detect import Detection, detect
from sameas.sky.frame.mosaic import without_mosaic

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
