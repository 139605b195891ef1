"""Darks, biases and flats: calibrated frames, and masks of bad pixels."""

from dataclasses import replace

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.sky.frame.image import Frame, MasterFrames
from sameas.sky.frame.keywords import Facts
from sameas.sky.frame.measurements import Flag

SHAPE = (60, 80)
RNG = np.random.default_rng(4)
CURRENT = RNG.gamma(2.0, 0.05, SHAPE)
CURRENT[7, 9] = 40.0
SENSITIVITY = 1 + 0.2 * np.cos(np.arange(80) / 20)[None, :] * np.ones(SHAPE)
SENSITIVITY[30, 40] = 0.05


def exposed(seconds, light, name="f"):
    """A frame of a camera with a bias of 500, dark current and uneven sensitivity."""
    image = 500 + CURRENT * seconds + light * SENSITIVITY + RNG.normal(0, 2.0, SHAPE)
    return Frame.of(image, facts=Facts(exposure_s=seconds, gain_e_per_adu=1.0, name=name), name=name)


BIASES = [exposed(0.0, 0.0) for _ in range(15)]


def test_a_scaled_dark_and_a_flat_recover_the_light():
    calibration = MasterFrames.of(
        biases=BIASES,
        darks=[exposed(100.0, 0.0) for _ in range(15)],
        flats=[exposed(2.0, k * 5000.0) for k in (1, 2, 3)],
    )
    result = calibration(exposed(50.0, 300.0))
    good = (result.flags & (Flag.HOT | Flag.MASKED)) == 0
    # The sensitivity is 1 at its median.
    assert np.median(result.image[good]) / 300 == pytest.approx(np.median(SENSITIVITY), rel=0.01)
    assert result.image[good].std() < 4.5
    assert result.flags[7, 9] & Flag.HOT
    assert result.flags[30, 40] & Flag.MASKED
    assert (~good).sum() < 10


def test_a_dark_that_contains_the_bias_is_used_and_mismatches_are_reported():
    calibration = MasterFrames.of(darks=[exposed(100.0, 0.0) for _ in range(5)])
    assert np.median(calibration(exposed(100.0, 200.0)).image / SENSITIVITY) == pytest.approx(200, abs=2)
    assert any("its dark is not scaled" in line for line in calibration(exposed(30.0, 200.0)).facts.lines)


def test_a_cosmic_ray_in_one_dark_does_no_harm():
    darks = [exposed(10.0, 0.0) for _ in range(3)]
    struck = darks[0].image.copy()
    struck[20, 20] += 10_000
    darks[0] = replace(darks[0], image=struck)
    assert abs(MasterFrames.of(darks=darks)(exposed(10.0, 100.0)).image[20, 20] - 100 * SENSITIVITY[20, 20]) < 20


def test_the_saturation_level_shifts_with_the_dark():
    frame = exposed(10.0, 100.0)
    frame = replace(frame, facts=replace(frame.facts, saturation_adu=10_000.0))
    assert MasterFrames.of(biases=BIASES)(frame).facts.saturation_adu == pytest.approx(9500, abs=2)


def test_a_pedestal_is_subtracted_once():
    frame = exposed(10.0, 100.0)
    frame = replace(frame, facts=replace(frame.facts, pedestal_adu=100.0))
    without = MasterFrames()(frame)
    assert np.median(frame.image - without.image) == pytest.approx(100)
    np.testing.assert_array_equal(MasterFrames()(without).image, without.image)


def test_masters_of_other_frames_are_refused():
    with pytest.raises(InputError, match="exposures from 10 to 30 s; give a bias"):
        MasterFrames.of(darks=[exposed(10.0, 0.0), exposed(30.0, 0.0)])
    small = Frame.of(RNG.normal(500, 2, (20, 20)), name="small")
    with pytest.raises(InputError, match=r"small: the frame has shape \(20, 20\), the calibration \(60, 80\)"):
        MasterFrames.of(biases=BIASES)(small)
    with pytest.raises(InputError, match=r"small: its shape \(20, 20\) is not that of"):
        MasterFrames.of(biases=[BIASES[0], small])
    with pytest.raises(InputError, match="the flat has no signal"):
        MasterFrames.of(biases=BIASES, flats=[exposed(0.0, -50.0)])
