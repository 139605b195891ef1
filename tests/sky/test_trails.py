"""Trails on long exposures: ends and errors, linking, satellites and comets."""

import numpy as np
import pytest

from sameas.report.movers import streak_lines
from sameas.simulate.frames import Camera, GaussianProfile, frame_of
from sameas.sky.frame.detect import detect
from sameas.sky.movers.search import search
from sameas.sky.movers.trails import TrailPixels, _long_lines, _Trail, streak_table, streaks, with_trails
from sameas.sky.series import Exposure, tie

SIDE, SCALE, RA, DEC, FWHM, EXPOSURE_MIN, EVERY_MIN = 320, 1.2, 150.0, 20.0, 3.0, 4.0, 6.0


def line(start, end, flux):
    """Positions (n, 2) and flux (n,) along a trail."""
    n = max(int(np.hypot(*(np.subtract(end, start))) * 2), 1)
    share = (np.arange(n) + 0.5) / n
    return np.asarray(start) + share[:, None] * np.subtract(end, start), np.full(n, flux / n)


def frames(seed, *, rate=None, flux=2e4, count=6, stars=90, extra=None):
    """Frames of a field, the exposures that are measured on them, and the mover's middle on each. rate : px/min."""
    rng = np.random.default_rng(seed)
    star, light = rng.uniform(8, SIDE - 8, (stars, 2)), 10 ** rng.uniform(3.5, 5.0, stars)
    middle = np.array([60.0, 250.0]) + np.arange(count)[:, None] * EVERY_MIN * np.array(rate or (0.0, 0.0))
    if rate is not None:
        track = np.concatenate([middle + s * EXPOSURE_MIN * np.array(rate) for s in (-0.5, 0.0, 0.5)])
        apart = np.hypot(*(star[:, None] - track).transpose(2, 0, 1)).min(axis=1) > 14.0
        star, light = star[apart], light[apart]
    out, exposures = [], []
    for k in range(count):
        parts = [(star, light)]
        if rate is not None:
            half = 0.5 * EXPOSURE_MIN * np.array(rate)
            parts.append(line(middle[k] - half, middle[k] + half, flux))
        if extra is not None:
            parts.append(extra(k, rng))
        xy, each = (np.concatenate(one) for one in zip(*parts, strict=True))
        made = frame_of(
            rng, x_px=xy[:, 0], y_px=xy[:, 1], flux_e=each, psf=GaussianProfile(FWHM),
            camera=Camera(shape=(SIDE, SIDE), sky_e=300.0, read_noise_e=5.0), name=f"f{k}",
        ).frame  # fmt: skip
        m = detect(made)
        dec = DEC + (m.y_px - SIDE / 2) * SCALE / 3600.0
        ra = RA - (m.x_px - SIDE / 2) * SCALE / 3600.0 / np.cos(np.radians(dec))
        exposures.append(
            Exposure(
                f"f{k}", 59300.1 + k * EVERY_MIN / 1440.0, m.x_px, m.y_px, m.covariance, ra, dec,
                m.covariance * SCALE**2, m.flux, m.flux_err, m.snr, m.flags.astype(np.int64), np.zeros(len(m)),
                np.full(len(m), np.nan), SCALE, (SIDE, SIDE), 60.0 * EXPOSURE_MIN, None, m.psf_fwhm_px,
            )
        )  # fmt: skip
        out.append(made)
    return out, exposures, middle


def test_ends_and_errors_of_a_trail_are_right():
    off, quoted = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        angle, length, middle = rng.uniform(0, np.pi), rng.uniform(6, 30), rng.uniform(40, 60, 2)
        half = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
        at, light = line(middle - half, middle + half, 15000.0)
        made = frame_of(rng, x_px=at[:, 0], y_px=at[:, 1], flux_e=light, psf=GaussianProfile(FWHM),
                        camera=Camera(shape=(100, 100), sky_e=300.0, read_noise_e=5.0)).frame  # fmt: skip
        pixels = TrailPixels.of(made, np.empty((0, 2)), np.empty(0), np.empty(0), FWHM)
        ((_, ends),) = pixels.candidates((middle + 0.2 * half)[None], np.full(1, 10.0))
        trail = pixels.fitted(middle + 0.2 * half, ends)
        turn = np.sign(trail.half @ half)
        off.append(np.concatenate([trail.middle - middle, turn * trail.half - half]))
        quoted.append(np.sqrt(np.diag(trail.covariance)))
        assert trail.flux * made.facts.gain_e_per_adu == pytest.approx(15000.0, rel=0.08)
    pull = np.array(off) / np.array(quoted)
    assert 0.6 < np.sqrt((pull**2).mean()) < 1.6 and np.abs(np.array(off)).max() < 1.0


@pytest.mark.slow
def test_stars_are_no_trails():
    made, exposures, _ = frames(3, count=2)
    one = exposures[0]
    at = np.column_stack([one.x_px, one.y_px])
    pixels = TrailPixels.of(made[0], np.empty((0, 2)), np.empty(0), np.empty(0), one.psf_fwhm_px)
    alone = np.sort(np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1)), axis=1)[:, 1] > 15.0
    found = [
        pixels.fitted(at[alone][k], ends) for k, ends in pixels.candidates(at[alone], np.full(int(alone.sum()), 10.0))
    ]
    assert alone.sum() > 20 and not any(trail is not None for trail in found)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [(2.5, -1.8), (5.0, -4.0)])
def test_a_mover_that_trails_is_found_by_its_trails(rate):
    made, exposures, middle = frames(5, rate=rate, flux=1.5e4)
    series = with_trails(tie(exposures), made)
    found, series = search(series)
    assert len(found) == 1 and found.size[0] >= 5 and found.p_tracklet[0] > 0.99
    rows = found.detections.rows[found.members[0][found.members[0] >= 0]]
    length = np.hypot(*series.trails.arcsec[rows].T)
    np.testing.assert_allclose(length, np.hypot(*rate) * EXPOSURE_MIN * SCALE, rtol=0.15)
    at = np.array([[series.exposures[k].x_px[r], series.exposures[k].y_px[r]]
                   for k, r in zip(series.frame[rows], series.row[rows], strict=True)])  # fmt: skip
    np.testing.assert_allclose(at, middle[series.frame[rows]], atol=0.5)
    assert found.scatter_arcsec[0] < 0.4


def test_a_mover_whose_trails_touch_brighter_stars_is_found():
    rate = np.array([2.5, -1.8])
    middles = np.array([60.0, 250.0]) + np.arange(6)[:, None] * EVERY_MIN * rate
    beside = middles + 5.0 * np.array([1.8, 2.5]) / np.hypot(*rate)

    made, exposures, middle = frames(5, rate=tuple(rate), flux=1.5e4, extra=lambda k, rng: (beside, np.full(6, 8e4)))
    series = with_trails(tie(exposures), made)
    found, series = search(series)
    assert len(found) == 1 and found.size[0] >= 5 and found.p_tracklet[0] > 0.99
    rows = found.detections.rows[found.members[0][found.members[0] >= 0]]
    at = np.column_stack([series.measured(name, rows) for name in ("x_px", "y_px")])
    np.testing.assert_allclose(at, middle[series.frame[rows]], atol=0.7)
    assert series.trails.added >= 3 and (series.measured("snr", rows) > 8.0).all()


def test_links_against_the_direction_of_a_trail_are_less_probable():
    from dataclasses import replace

    from sameas.sky import Detections
    from sameas.sky.movers.detections import TrailRates
    from sameas.sky.movers.links import NO_TRAIL, ODD_BRIGHTNESS, trail_ratio
    from sameas.sky.movers.model import Surroundings

    bare = Detections.of([10.0, 10.01], [5.0, 5.0], [60000.0, 60000.005], sigma_arcsec=0.2)
    east = 36.0 * np.cos(np.radians(5.0)) / 7.2

    def log_ratios(vectors):
        rates = TrailRates(np.array(vectors, float), np.full(2, 0.05), np.full(2, 1.0))
        around = Surroundings.of(replace(bare, trail=rates))
        minutes, ends = np.array([7.2]), (np.array([0]), np.array([1]))
        rate = around.axes.offsets(*ends) / minutes[:, None]
        return [float(trail_ratio(around, end, rate, minutes)[0]) for end in ends]

    along, back = log_ratios([(east, 0.0), (-east, 0.0)])
    assert along == pytest.approx(back, abs=0.1) and along > 2.0
    across, none = log_ratios([(0.0, east), (np.nan, np.nan)])
    assert across == pytest.approx(np.log(ODD_BRIGHTNESS), abs=0.1)
    assert none == pytest.approx(np.log(NO_TRAIL))


def test_the_track_of_a_particle_is_sharper_than_a_trail():
    for sharp in (False, True):
        at, light = line((30.0, 40.0), (56.0, 54.0), 8000.0)
        camera = Camera(shape=(100, 100), sky_e=300.0, read_noise_e=5.0)
        xy, flux = (np.zeros((0, 2)), np.zeros(0)) if sharp else (at, light)
        made = frame_of(np.random.default_rng(4), x_px=xy[:, 0], y_px=xy[:, 1], flux_e=flux, psf=GaussianProfile(FWHM),
                        camera=camera).frame  # fmt: skip
        if sharp:
            np.add.at(made.image, tuple(np.rint(at).astype(int).T[::-1]), light / camera.gain_e_per_adu)
        pixels = TrailPixels.of(made, np.empty((0, 2)), np.empty(0), np.empty(0), FWHM)
        ((_, ends),) = pixels.candidates(np.array([[43.0, 47.0]]), np.full(1, 10.0))
        assert pixels.fitted(np.array([43.0, 47.0]), ends).sharp == sharp


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ends", "accuracy_px"), [([(60.0, 70.0), (98.0, 84.0)], 1.5), ([(5.0, 40.0), (SIDE - 5.0, 260.0)], 15.0)]
)
def test_streaks_of_one_frame_are_listed_with_their_ends_and_are_no_movers(ends, accuracy_px):
    made, exposures, _ = frames(
        7, extra=lambda k, rng: line(ends[0], ends[1], 4e5) if k == 2 else (np.empty((0, 2)), np.empty(0)), stars=60
    )
    found, series = search(with_trails(tie(exposures), made))
    assert len(found) == 0
    (one,) = streaks(series, np.array([], np.int64))
    assert one.frame == 2 and one.snr > 50.0
    table = streak_table(series, [one])
    east, north = -SCALE * (np.array(ends)[:, 0] - SIDE / 2), SCALE * (np.array(ends)[:, 1] - SIDE / 2)
    for k, end in ((1, np.argmin(east)), (2, np.argmax(east))):  # the first end is the one to the west
        ra = RA + east[end] / 3600.0 / np.cos(np.radians(DEC + north[end] / 3600.0))
        off = np.array([table[f"ra_{k}_deg"][0] - ra, table[f"dec_{k}_deg"][0] - DEC - north[end] / 3600.0])
        away = off * [np.cos(np.radians(DEC)), 1.0]
        assert np.hypot(*away) * 3600.0 < accuracy_px * SCALE
    length = np.hypot(*np.subtract(*ends)) * SCALE
    assert table["length_arcsec"][0] == pytest.approx(length, abs=accuracy_px * SCALE)
    assert table["rate_arcsec_per_min"][0] == pytest.approx(length / EXPOSURE_MIN, rel=0.06)
    assert table["angle_deg"][0] == pytest.approx(
        np.degrees(np.arctan2(np.ptp(-east), -np.ptp(north))) % 180.0, abs=1.5
    )
    assert "no tracklet" in streak_lines(table)[0] and "f2" in streak_lines(table)[2]


@pytest.mark.slow
@pytest.mark.long
def test_a_comet_with_a_coma_is_one_mover():
    rate = np.array([0.9, -0.6])

    def comet(k, rng):
        nucleus = np.array([80.0, 200.0]) + k * EVERY_MIN * rate
        angle, radius = rng.uniform(0, 2 * np.pi, 1500), rng.exponential(7.0, 1500)
        coma = nucleus + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return np.vstack([nucleus, coma]), np.append(1.5e4, np.full(1500, 40.0))

    made, exposures, _ = frames(9, extra=comet, stars=60)
    found, _ = search(with_trails(tie(exposures), made))
    assert len(found) == 1 and found.size[0] >= 5
    east, north = found.rate_arcsec_per_min[0]
    np.testing.assert_allclose([-east / SCALE, north / SCALE], rate, atol=0.05)


def test_parts_of_a_long_line_are_one_though_the_direction_of_each_is_uncertain():
    parts = [
        _Trail(np.array([x, 0.01 * x]), 15.0 * np.array([np.cos(turn), np.sin(turn)]), np.eye(4), 1e4, 100.0, False)
        for x, turn in ((40.0, 0.03), (120.0, -0.02), (300.0, 0.02), (620.0, -0.01))
    ]
    (line,) = _long_lines(parts, 3.0, 108.0)
    assert line.length == pytest.approx(610.0, abs=1.0) and line.flux / line.flux_err == pytest.approx(200.0)
    assert abs(line.half[1] / line.half[0] - 0.01) < 0.003
