"""Tracklets in the pixels: forced photometry on every frame, the stack, and its evidence for a candidate."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from browser import CHROMIUM, Browser
from sameas.simulate.frames import Camera, GaussianProfile, frame_of
from sameas.sky.movers.search import search
from sameas.sky.movers.stack import UNLISTED, confirmed, stack, stacked_evidence
from sameas.sky.series import Exposure, tie

SIDE, SCALE, RA, DEC = 256, 1.0, 150.0, 20.0
STARS = 70


def series(seed, flux_e=4000.0, *, seen=None, count=6, rate=(0.5, -0.1), hidden_frame=None, start=100.3):
    """Frames of a field, their exposures, and the mover's pixels. seen : frames on which it is listed, None for all."""
    rng = np.random.default_rng(seed)
    star, light = rng.uniform(12, SIDE - 12, (STARS, 2)), 10 ** rng.uniform(3.6, 4.8, STARS)
    track = np.array([start, 120.6]) + np.arange(count)[:, None] * 5.0 * np.array(rate)
    star = star[np.min(np.hypot(*(star[:, None] - track).transpose(2, 0, 1)), axis=1) > 9.0]
    light = light[: len(star)]
    if hidden_frame is not None:
        star, light = np.vstack([star, track[hidden_frame] + 0.8]), np.append(light, 3e4)
    frames, exposures = [], []
    for k in range(count):
        xy = np.vstack([star, track[k]])
        made = frame_of(
            rng, x_px=xy[:, 0], y_px=xy[:, 1], flux_e=np.append(light, flux_e), psf=GaussianProfile(3.0),
            camera=Camera(shape=(SIDE, SIDE), sky_e=300.0, read_noise_e=5.0), name=f"f{k}",
        )  # fmt: skip
        frames.append(made.frame)
        listed = xy if seen is None or k in seen else xy[:-1]
        sigma = np.full(len(listed), 0.05)
        at = listed + 0.05 * rng.standard_normal(listed.shape)
        dec = DEC + (at[:, 1] - SIDE / 2) * SCALE / 3600.0
        ra = RA - (at[:, 0] - SIDE / 2) * SCALE / 3600.0 / np.cos(np.radians(dec))
        n, cov = len(listed), np.column_stack([sigma**2, np.zeros(len(listed)), sigma**2])
        flux = np.append(light, flux_e)[:n] / 1.5
        exposures.append(
            Exposure(
                f"f{k}", 59300.1 + k * 5.0 / 1440.0, at[:, 0], at[:, 1], cov, ra, dec, cov * SCALE**2, flux,
                np.full(n, 40.0), flux / 40.0, np.zeros(n, np.int64), np.zeros(n), np.full(n, np.nan), SCALE,
                (SIDE, SIDE), 60.0, None, 3.0,
            )
        )  # fmt: skip
    return tie(exposures), frames, track


def test_forced_photometry_along_the_motion_on_every_frame():
    tied, frames, track = series(1)
    found, tied = search(tied)
    stacked = stack(found, tied, frames)
    assert len(found) == 1 and stacked.detected.all()
    np.testing.assert_allclose(stacked.chip[0], track, atol=0.3)
    assert np.median(np.abs(stacked.flux[0] - 4000.0 / 1.5) / stacked.error[0]) < 2.0
    np.testing.assert_allclose(stacked.flux[0], 4000.0 / 1.5, rtol=0.15)
    middle = stacked.stacked[0].shape[0] // 2
    top = np.unravel_index(np.argmax(stacked.stacked[0]), stacked.stacked[0].shape)
    assert max(abs(np.array(top) - middle)) <= 1 and stacked.snr[0] > 0.6 * np.sqrt(6) * np.median(
        stacked.snr[0] / 6**0.5
    )


def test_cut_outs_have_north_up_and_east_to_the_left():
    # East is −x here: a mover of growing x goes west, to the right.
    tied, frames, _ = series(2, 20000.0, rate=(1.0, 0.0))
    found, tied = search(tied)
    fixed = stack(found, tied, frames).fixed[0]
    columns = [np.unravel_index(np.argmax(one[one.shape[0] // 2 - 3 : one.shape[0] // 2 + 4]), (7, one.shape[1]))[1]
               for one in fixed]  # fmt: skip
    np.testing.assert_allclose(np.diff(columns), 5, atol=1.5)


def test_light_on_frames_without_detection_confirms_a_mover():
    tied, frames, _ = series(3, seen=(0, 2, 5))
    found, tied = search(tied, min_probability=0.0)
    stacked = stack(found, tied, frames)
    assert found.size[0] == 3 and stacked.detected[0].sum() == 3
    assert stacked.log_ratio[0] > 3.5 and stacked.p[0] >= found.p_tracklet[0]


def test_frames_without_light_refute_a_tracklet():
    # Three noise detections in a line: no light on the other frames.
    tied, frames, _ = series(4, seen=(0, 2, 5))
    _, empty, _ = series(4, 0.0, seen=(0, 2, 5))
    found, tied = search(tied, min_probability=0.0)
    frames = [one if k in (0, 2, 5) else blank for k, (one, blank) in enumerate(zip(frames, empty, strict=True))]
    stacked = stack(found, tied, frames)
    assert stacked.log_ratio[0] < -1.0 and stacked.p[0] <= found.p_tracklet[0]
    doubtful = replace(found, p_tracklet=np.full(len(found), 0.6))
    stacked = stack(doubtful, tied, frames)
    kept, left = confirmed(doubtful, stacked, 0.5)
    assert stacked.p[0] < 0.5 and len(kept) == len(left) == 0


def test_light_of_an_unlisted_star_on_other_frames_makes_nothing_certain():
    """Six frames of it gave a factor of 10⁸; one place in a hundred of real frames has such light."""
    tied, _, _ = series(4, seen=(0, 2, 5))
    found, _ = search(tied, min_probability=0.0)
    found = replace(found.only(np.zeros(1, int)), log_missed=np.array([-2.0]))
    detected = np.array([[True] * 3 + [False] * 6])
    seen = np.zeros((1, 9), bool), detected
    bright = stacked_evidence(found, np.full((1, 9), 100.0), np.full((1, 9), 10.0), *seen)[0] - 2.0
    assert 3.8 < bright <= np.log(1 / UNLISTED)
    # Frames without light refute as before.
    dark = stacked_evidence(found, np.where(detected, 100.0, 0.0), np.full((1, 9), 10.0), *seen)[0] - 2.0
    assert -14.0 < dark < -10.0


def test_every_number_of_a_tracklet_has_the_evidence_of_forced_photometry():
    """A tracklet of p = 1.0000 once had the chance number and the odds of before the measurement."""
    tied, frames, _ = series(4, seen=(0, 2, 5))
    found, tied = search(tied, min_probability=0.0)
    found = replace(
        found, p_tracklet=np.full(len(found), 0.6), p_exact=np.full(len(found), 0.5),
        p_member=np.where(found.members >= 0, 0.6, 0.0),
    )  # fmt: skip
    stacked = stack(found, tied, frames)
    kept, _ = confirmed(found, stacked, 0.5)
    change = kept.log_weight[0] - found.log_weight[0]
    assert change == pytest.approx(stacked.log_ratio[0]) and change > 2.0
    assert kept.expected_chance[0] == pytest.approx(found.expected_chance[0] * np.exp(-change))
    assert 0.9 < kept.p_tracklet[0] <= kept.p_member[0].max() + 1e-12 and kept.log_missed[0] == 0.0
    assert kept.p_exact[0] == pytest.approx(kept.p_tracklet[0] * 0.5 / 0.6)


def test_a_bright_mover_of_one_and_a_half_pixels_in_total_is_no_blend():
    tied, _, track = series(7, 20000.0, rate=(0.06, 0.0))
    assert np.hypot(*(track[-1] - track[0])) < 2.0
    found, _ = search(tied)
    assert len(found) == 1 and found.size[0] == 6 and abs(np.hypot(*found.rate_arcsec_per_min[0]) - 0.06) < 0.01
    still, _, _ = series(7, 20000.0, rate=(0.0, 0.0))
    assert len(search(still)[0]) == 0


def test_frames_with_a_star_on_the_track_are_neutral():
    tied, frames, _ = series(5, seen=(0, 1, 2, 4, 5), hidden_frame=3)
    found, tied = search(tied, min_probability=0.0)
    stacked = stack(found, tied, frames)
    assert stacked.hidden[0, 3] and not stacked.hidden[0, [0, 5]].any() and stacked.detected[0, [0, 1, 2, 4, 5]].all()
    # The search's penalty for an exposure without detection is removed.
    assert abs(stacked.log_ratio[0] + found.log_missed[0]) < 1e-9


def test_a_mover_that_leaves_the_frame_is_measured_while_inside():
    tied, frames, track = series(6, count=8, rate=(1.0, 0.0), seen=(0, 1, 2, 3, 4), start=220.3)
    found, tied = search(tied, min_probability=0.0)
    stacked = stack(found, tied, frames)
    inside = track[:, 0] < SIDE - 12
    assert np.isfinite(stacked.flux[0])[inside].all() and np.isnan(stacked.flux[0])[track[:, 0] > SIDE - 8].all()


@pytest.mark.slow
def test_the_page_blinks_steps_and_explains(tmp_path):
    from sameas.pages.frame import write_movers_page

    tied, frames, _ = series(7, seen=(0, 2, 3, 5))
    found, tied = search(tied)
    path = Path(tmp_path / "movers.html")
    write_movers_page(path, "night <1>", found, tied, stack(found, tied, frames))
    text = path.read_text()
    assert "night &lt;1&gt;" in text and "2 frames do not show it" in text and "by chance " in text
    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    with Browser(path) as browser:
        assert browser.js("document.getElementById('name').textContent") == "sa00001"
        assert browser.js("document.querySelectorAll('#rows tr').length") == 5
        browser.js("document.getElementById('play').click()")
        assert browser.js("document.getElementById('play').textContent") == "play"
        browser.js("(e => { e.value = 1; e.dispatchEvent(new Event('input')); })(document.getElementById('frame'))")
        assert browser.js("document.getElementById('blink-words').textContent").startswith("f1: not detected")
        lit = "(c => { const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let m = 0; "
        lit += "for (let i = 0; i < d.length; i += 4) m = Math.max(m, d[i]); return m; })"
        assert browser.js(f"{lit}(document.getElementById('stack'))") > 150
        assert browser.errors == []


def test_the_picture_shows_a_row_of_dots_and_the_stack():
    from sameas.plots.frame import mover_picture

    tied, frames, _ = series(7, seen=(0, 2, 3, 5))
    found, tied = search(tied)
    stacked = stack(found, tied, frames)
    left, right = (figure := mover_picture(found, tied, stacked)).axes
    words = [text.get_text() for text in figure.texts]
    assert words[0] == "sa00001" and "4 of 6 frames" in words[1] and "O−C" not in words[1]
    # A tick for each frame, and the scale; the times of the first and the last detection.
    assert len(left.lines) == 6 + 1 and len(left.texts) == 2 + 1
    shown = left.images[0].get_array()
    assert shown.shape == stacked.fixed[0].shape[1:] and right.images[0].get_array().shape == stacked.stacked[0].shape
    # The dots lie where the ticks say, and are bright there.
    for line in left.lines[:6]:
        assert 0 <= np.asarray(line.get_xdata()).mean() <= shown.shape[1]
    middle = (np.array(stacked.stacked[0].shape) - 1) // 2
    assert right.images[0].get_array()[tuple(middle)] > 0.6


def test_the_page_of_a_series_without_movers_says_so(tmp_path):
    from sameas.pages.frame import write_movers_page

    tied, frames, _ = series(8, seen=())
    found, tied = search(tied)
    assert len(found) == 0
    for streaks, said in ((0, 'No movers were found"'), (2, "No movers were found; 2 streaks on single frames")):
        write_movers_page(tmp_path / "movers.html", "night", found, tied, stack(found, tied, frames), streaks=streaks)
        assert said in (tmp_path / "movers.html").read_text()
