"""Detection of stars: positions within their errors; defects, neighbours, trails and edges are flagged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sameas.errors import InputError
from sameas.simulate.frames import Camera, GaussianProfile, Moffat, Trail, frame_of
from sameas.sky.frame.centroid import Background
from sameas.sky.frame.detect import Detection, detect
from sameas.sky.frame.image import Frame, MasterFrames, read
from sameas.sky.frame.measurements import Flag

pytest.importorskip("photutils")
DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
WIDE = Camera(shape=(640, 640), saturation_e=1e9)


def grid(rng, size=640, step=32, faint=2.9, bright=5.0):
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(20, size - 15, step), np.arange(20, size - 15, step)))
    x, y = x + rng.uniform(-2, 2, x.size), y + rng.uniform(-2, 2, x.size)
    return {"x_px": x, "y_px": y, "flux_e": 10 ** rng.uniform(faint, bright, x.size)}


def paired(seen, found, within=2.0):
    """Rows of measurements and truth that are mutual nearest neighbours."""
    truth, xy = np.column_stack([seen.truth.x_px, seen.truth.y_px]), np.column_stack([found.x_px, found.y_px])
    apart, row = cKDTree(xy).query(truth)
    _, back = cKDTree(truth).query(xy)
    mutual = np.flatnonzero((apart < within) & (back[row] == np.arange(len(truth))))
    return row[mutual], mutual, xy[row[mutual]] - truth[mutual]


def robust(values):
    return 1.4826 * np.median(np.abs(values))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("psf", "trail"),
    [(GaussianProfile(3.0), None), (Moffat(3.0), None), (Moffat(1.5), None), (Moffat(2.5), Trail(8.0, 30.0))],
    ids=["gaussian", "moffat", "undersampled", "trailed"],
)
@pytest.mark.long_after(1)
def test_normalised_errors_have_unit_variance(psf, trail):
    errors, snr, flux = [], [], []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        seen = frame_of(rng, **grid(rng), camera=WIDE, psf=psf, trail=trail)
        found = detect(seen.frame, Detection(defects=False))
        rows, stars, error = paired(seen, found)
        assert len(rows) > 0.9 * len(seen.truth)
        xx, cross, yy = found.covariance[rows].T
        root = np.linalg.cholesky(np.stack([np.stack([xx, cross], -1), np.stack([cross, yy], -1)], -2))
        errors.append(np.linalg.solve(root, error[..., None])[..., 0])
        snr.append(found.snr[rows])
        flux.append((found.flux[rows] * WIDE.gain_e_per_adu - seen.truth.flux_e[stars]) / seen.truth.flux_e[stars])
    chi, snr, flux = np.concatenate(errors), np.concatenate(snr), np.concatenate(flux)
    for axis in range(2):
        assert robust(chi[:, axis]) == pytest.approx(1.0, abs=0.1)
    for low, high in ((6, 30), (30, 100), (100, 1e5)):
        chosen = (snr >= low) & (snr < high)
        assert chosen.sum() > 25
        assert robust(chi[chosen]) == pytest.approx(1.0, abs=0.2)
    assert abs(np.median(flux[snr > 50])) < 0.03


def test_positions_count_from_the_centre_of_the_first_pixel():
    rng = np.random.default_rng(5)
    seen = frame_of(rng, x_px=[31.0], y_px=[17.0], flux_e=[1e6], camera=Camera(shape=(64, 64), saturation_e=1e9))
    found = detect(seen.frame)
    assert (found.x_px[0], found.y_px[0]) == pytest.approx((31.0, 17.0), abs=0.01)
    y, x = np.unravel_index(seen.frame.image.argmax(), seen.frame.shape)
    assert (int(x), int(y)) == (31, 17)


@pytest.mark.slow
def test_an_empty_sky_has_hardly_any_detection():
    frame = Frame.of(np.random.default_rng(6).normal(1000, 10, (500, 500)))
    try:
        assert len(detect(frame)) < 12
    except InputError as error:
        assert "no star above" in str(error)
    with pytest.raises(InputError, match="no star above 9σ; lower threshold_sigmas"):
        detect(frame, Detection(threshold_sigmas=9.0))


@pytest.mark.slow
def test_a_negative_is_refused_by_its_cause():
    rng = np.random.default_rng(5)
    frame = frame_of(rng, **grid(rng, 320), camera=Camera(shape=(320, 320))).frame
    negative = replace(frame, image=frame.image.max() - frame.image)
    with pytest.raises(InputError, match=r"\d\d dark spots above 4σ: it seems to be a negative.*largest value"):
        detect(negative)


@pytest.mark.slow
@pytest.mark.parametrize("step", [1e9, 300.0])
def test_a_sky_without_noise_is_refused_without_warnings(step):
    """Steps from box to box were divided by the noise of the boxes."""
    made = frame_of(np.random.default_rng(6), x_px=[40.0], y_px=[40.0], flux_e=[1e5], camera=Camera(shape=(200, 200)))
    clipped = replace(made.frame, image=(step * np.round(made.frame.image / step)).astype(np.float32))
    with pytest.raises(InputError, match="no noise at all; the frame is empty or was clipped"):
        detect(clipped)


def test_hot_pixels_and_cosmic_rays_are_masked_and_stars_are_not():
    rng = np.random.default_rng(7)
    camera = Camera(shape=(640, 640), hot_pixels=150, hot_e=5000.0, cosmics=60, saturation_e=1e9)
    seen = frame_of(rng, **grid(rng), camera=camera, psf=Moffat(2.0))
    found = detect(seen.frame)
    rows, _, _ = paired(seen, found)
    assert len(rows) > 0.93 * len(seen.truth)
    assert len(found) - len(rows) < 0.05 * len(found)
    raw = detect(seen.frame, Detection(defects=False))
    assert len(raw) > len(found) + 100
    assert any("pixels hot" in note for note in found.notes)
    flagged = (found.flags[rows] & (Flag.HOT | Flag.COSMIC)) != 0
    assert flagged.sum() < 0.1 * len(rows)


@pytest.mark.slow
def test_a_bad_column_is_masked():
    rng = np.random.default_rng(8)
    seen = frame_of(rng, **grid(rng, 320), camera=Camera(shape=(320, 320)))
    image = seen.frame.image.copy()
    image[:, 100] += 300
    found = detect(Frame.of(image, facts=seen.frame.facts))
    rows, _, _ = paired(seen, found)
    assert len(found) - len(rows) <= 4
    assert any("pixels masked" in note for note in found.notes)


@pytest.mark.slow
def test_close_pairs_are_resolved_without_bias_and_flagged():
    rng = np.random.default_rng(9)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(30, 610, 45.0), np.arange(30, 610, 45.0)))
    x, y, angle = x + rng.uniform(-1, 1, x.size), y + rng.uniform(-1, 1, x.size), rng.uniform(0, 2 * np.pi, x.size)
    flux = 10 ** rng.uniform(3.8, 4.8, x.size)
    both = {
        "x_px": np.r_[x, x + 6 * np.cos(angle)],
        "y_px": np.r_[y, y + 6 * np.sin(angle)],
        "flux_e": np.r_[flux, 0.5 * flux],
    }
    seen = frame_of(rng, **both, camera=WIDE, psf=Moffat(3.0))
    found = detect(seen.frame)
    rows, _, error = paired(seen, found)
    assert len(rows) > 0.95 * len(seen.truth)
    assert ((found.flags[rows] & Flag.BLENDED) != 0).mean() > 0.5
    assert robust(error / found.sigma_px()[rows]) < 1.3


@pytest.mark.slow
def test_a_moving_object_among_round_stars_is_flagged_as_trailed():
    rng = np.random.default_rng(10)
    stars = grid(rng, 320)
    away = np.hypot(stars["x_px"] - 160, stars["y_px"] - 160) > 40
    stars = {name: values[away] for name, values in stars.items()}
    dark = Camera(shape=(320, 320), sky_e=0.0, read_noise_e=0.0, bias_adu=0.0)
    streak = frame_of(rng, x_px=[160.3], y_px=[159.6], flux_e=[6e4], camera=dark, trail=Trail(20.0, 40.0))
    seen = frame_of(rng, **stars, camera=Camera(shape=(320, 320)))
    found = detect(Frame.of(seen.frame.image + streak.frame.image, facts=seen.frame.facts), Detection(defects=False))
    near = np.flatnonzero(np.hypot(found.x_px - 160.3, found.y_px - 159.6) < 12)
    assert len(near) == 1
    (row,) = near
    assert found.flags[row] & Flag.TRAILED
    assert found.theta_deg[row] == pytest.approx(40, abs=3)
    assert np.hypot(found.x_px[row] - 160.3, found.y_px[row] - 159.6) < 4 * found.sigma_px()[row].max() + 0.1
    assert ((found.flags & Flag.TRAILED) != 0).sum() <= 2


def test_a_faint_trail_beside_a_bright_one_is_detected():
    """The filter of trails, twice as long as they, covered the saddle between two that do not touch."""
    rng = np.random.default_rng(6)
    x, y = (axis.ravel() + 40.0 for axis in np.meshgrid(64.0 * np.arange(5), 64.0 * np.arange(5)))
    bright, faint = np.full(25, 3e5), np.full(25, 4e3)
    seen = frame_of(
        rng,
        x_px=np.concatenate([x, x + 22.0]),
        y_px=np.concatenate([y, y + 4.0]),
        flux_e=np.concatenate([bright, faint]),
        camera=Camera(shape=(350, 350)),
        psf=GaussianProfile(3.2),
        trail=Trail(13.0, 0.0),
    )
    measured = detect(seen.frame)
    assert len(paired(seen, measured)[0]) >= 48  # 25 without a second filter
    assert len(measured) <= 50


@pytest.mark.parametrize("psf", [GaussianProfile(3.5), Moffat(3.0)], ids=["gaussian", "moffat"])
def test_stars_cut_by_the_edge_have_the_errors_of_what_is_left_of_them(psf):
    normalised = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        along, inside = np.arange(30.0, 610.0, 40.0), rng.uniform(0.0, 4.0, (4, 15))
        x = np.concatenate([along, along, inside[0], 639.0 - inside[1]])
        y = np.concatenate([inside[2], 639.0 - inside[3], along, along])
        flux = 10 ** rng.uniform(3.7, 5.0, x.size)
        seen = frame_of(rng, x_px=x, y_px=y, flux_e=flux, camera=WIDE, psf=psf)
        found = detect(seen.frame, Detection(defects=False))
        rows, _, error = paired(seen, found, within=4.0)
        assert len(rows) > 0.8 * len(x)
        covariance = found.covariance[rows][:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        normalised.append(np.sqrt(np.einsum("nv,nvw,nw->n", error, np.linalg.inv(covariance), error) / 2.0))
    half, most = np.quantile(np.concatenate(normalised), [0.5, 0.9])
    assert half < 1.2 and most < 2.5, (half, most)


@pytest.mark.slow
def test_saturated_stars_and_edges_are_flagged():
    rng = np.random.default_rng(11)
    stars = grid(rng, 320)
    stars = {
        name: np.r_[values, extra] for (name, values), extra in zip(stars.items(), (150.2, 170.4, 3e6), strict=True)
    }
    stars = {name: np.r_[values, extra] for (name, values), extra in zip(stars.items(), (0.4, 100.0, 5e4), strict=True)}
    seen = frame_of(rng, **stars, camera=Camera(shape=(320, 320), saturation_e=30_000.0))
    found = detect(seen.frame)
    bright = np.argmin(np.hypot(found.x_px - 150.2, found.y_px - 170.4))
    assert found.flags[bright] & Flag.SATURATED
    assert np.hypot(found.x_px[bright] - 150.2, found.y_px[bright] - 170.4) < 0.2
    edge = np.argmin(np.hypot(found.x_px - 0.4, found.y_px - 100.0))
    assert found.flags[edge] & Flag.EDGE


@pytest.mark.slow
def test_correlated_noise_increases_position_errors():
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(12)
    stars = grid(rng, faint=3.4, bright=4.2)
    quiet = Camera(shape=(640, 640), sky_e=0.0, read_noise_e=0.0, saturation_e=1e9)
    clean = frame_of(rng, **stars, camera=quiet)
    grain = gaussian_filter(rng.normal(0, 1, (640, 640)), 0.8)
    seen = clean.frame.image + 12 * grain / grain.std()
    found = detect(Frame.of(seen), Detection(defects=False))
    rows, _, error = paired(clean, found)
    assert robust(error / found.sigma_px()[rows]) == pytest.approx(1.0, abs=0.2)
    assert any("noise of neighbouring pixels" in note for note in found.notes)


@pytest.mark.slow
def test_table_and_records_have_the_same_positions():
    rng = np.random.default_rng(13)
    found = detect(frame_of(rng, **grid(rng, 320), camera=Camera(shape=(320, 320))).frame)
    table, records = found.table(), found.records()
    np.testing.assert_array_equal(records.features[:, 0], table["x_px"].value)
    np.testing.assert_allclose(records.covariance, found.covariance)
    assert (np.diff(found.flux) <= 0).all()
    assert len(found[found.snr > 20]) == (found.snr > 20).sum()


def test_a_setting_out_of_range_is_refused():
    with pytest.raises(InputError, match="threshold_sigmas is 0; give a number above 0"):
        Detection(threshold_sigmas=0)


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "m67_poss1951").is_dir(), reason="the plate of M67 is not here")
def test_stars_of_a_photographic_plate_are_found():
    frame = read(DATA / "m67_poss1951" / "M6707HH.fits")
    found = detect(frame)
    assert 1500 < len(found) < 2300
    assert 1.8 < found.psf_fwhm_px < 3


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "asteroid_2713").is_dir(), reason="the frames of asteroid 2713 are not here")
def test_stars_of_a_raw_frame_with_darks_are_found():
    folder = DATA / "asteroid_2713"
    calibration = MasterFrames.of(darks=[read(path) for path in sorted(folder.glob("*Dark*"))])
    raw = read(sorted(folder.glob("*Light*"))[-1])
    found = detect(calibration(raw))
    assert 300 < len(found) < 1500
    assert raw.facts.station.lon_deg == pytest.approx(-71.485, abs=1e-3)
    assert raw.facts.aim_deg == pytest.approx((62.54, 22.84), abs=0.01)


@pytest.mark.slow
def test_correlated_noise_is_measured_despite_a_mask_in_the_centre():
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(12)
    image = 100.0 + 10.0 * gaussian_filter(rng.normal(size=(700, 700)), 0.8)
    y, x = np.mgrid[:700, :700]
    rho = [
        Background.of(Frame.of(image, mask=mask), box_px=50).correlation
        for mask in (None, np.hypot(x - 350, y - 350) < 290)
    ]
    np.testing.assert_allclose(rho[1], rho[0], atol=0.05)
    assert rho[1][4, 5] > 0.4


def with_gain(frame, gain):
    return replace(frame, facts=replace(frame.facts, gain_e_per_adu=gain))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("psf", "camera"),
    [
        (Moffat(3.0), replace(WIDE, sky_e=100.0)),
        (GaussianProfile(4.0), replace(WIDE, sky_e=800.0, gain_e_per_adu=3.0)),
        (Moffat(2.2, 2.5), replace(WIDE, sky_e=30.0, gain_e_per_adu=8.0)),
    ],
    ids=["moffat", "bright sky", "undersampled"],
)
def test_errors_of_bright_stars_are_right_without_a_gain(psf, camera):
    rng = np.random.default_rng(5)
    seen = frame_of(rng, **grid(rng, bright=6.0), camera=camera, psf=psf)
    found = detect(with_gain(seen.frame, np.nan))
    rows, stars, error = paired(seen, found)
    bright = seen.truth.flux_e[stars] > 1e4
    assert bright.sum() > 150
    # Without photon noise it is 1.9 to 3.3.
    assert 0.85 < robust((error / found.sigma_px()[rows])[bright]) < 1.2
    gain = float(found.notes[-1].split("gain not known: about ")[1].split(" ")[0])
    assert gain == pytest.approx(camera.gain_e_per_adu, rel=0.2)


@pytest.mark.slow
def test_a_gain_that_the_stars_contradict_is_doubted():
    rng = np.random.default_rng(6)
    seen = frame_of(rng, **grid(rng, bright=6.0), camera=WIDE, psf=Moffat(3.0))
    assert not any("doubt" in note for note in detect(seen.frame).notes)
    doubt = detect(with_gain(seen.frame, WIDE.gain_e_per_adu / 10)).notes[-1]
    assert "times the photon variance of the gain 0.15 e⁻/ADU: a mean of several frames? gain 1." in doubt
    assert "gain 1." in detect(with_gain(seen.frame, 20 * WIDE.gain_e_per_adu)).notes[-1]


def test_three_stars_tell_no_gain():
    rng = np.random.default_rng(7)
    camera = Camera(shape=(128, 128))
    seen = frame_of(rng, x_px=[30.0, 60.0, 90.0], y_px=[40.0, 90.0, 30.0], flux_e=[1e4, 2e4, 4e4], camera=camera)
    assert detect(with_gain(seen.frame, np.nan)).notes[-1].startswith("assumed: no photon noise of the stars")


def test_the_noise_under_a_steep_sky_is_not_its_slope():
    """Twilight or the moon: a slope of 27 ADU a pixel; its scatter within a box was taken for noise."""
    rng = np.random.default_rng(4)
    seen = frame_of(rng, **grid(rng), camera=WIDE, psf=GaussianProfile(3.0))
    x = np.arange(640.0)[None, :] / 640.0
    slope = 8000.0 * x**2
    noise = rng.normal(size=seen.frame.image.shape) * np.sqrt(slope / WIDE.gain_e_per_adu)
    steep = replace(seen.frame, image=(seen.frame.image + slope + noise).astype(np.float32))
    right = (slice(None), slice(480, 600))
    measured = np.median(np.sqrt(Background.of(steep).variance[right]))
    expected = np.median(np.sqrt(Background.of(seen.frame).variance[right] + slope[:, right[1]] / WIDE.gain_e_per_adu))
    assert 0.9 < measured / expected < 1.25
