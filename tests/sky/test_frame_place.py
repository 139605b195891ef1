"""Placing a frame by header, aim or whole-sky search; false placements are refused."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS, Sip

from sameas.errors import InputError
from sameas.sky.frame.field import Stars
from sameas.sky.frame.odds import PlateProblem, SearchVolume, verify
from sameas.sky.frame.place import NoSolution, Placement, odds_in_words, place
from sameas.sky.frame.plate import MatchedStars, fit_plate
from sameas.sky.frame.pointing import Pointing
from sameas.sky.frame.pointing_hints import (
    AIM_LISTS,
    BRIGHTEST_PATTERNS,
    FURTHER_PATTERNS,
    Aim,
    AllSky,
    ApproximateWcs,
    PatternIndex,
    sky_index,
)
from sameas.space import ARCSEC_PER_RADIAN, directions_deg, from_plane, to_plane, unit_vectors

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
SHAPE = (900, 1100)
MIDDLE = np.array([549.5, 449.5])


@dataclass(frozen=True)
class Seen:
    """The attributes of measurements that a placement uses."""

    x_px: np.ndarray
    y_px: np.ndarray
    covariance: np.ndarray
    flux: np.ndarray
    shape: tuple[int, int] = SHAPE
    name: str = "frame 7"


def pointing(ra_deg: float, dec_deg: float, scale_arcsec: float, turn_deg: float, *, mirror: bool = False) -> Pointing:
    turn, hand = math.radians(turn_deg), 1.0 if mirror else -1.0
    cd = np.array([[hand * math.cos(turn), math.sin(turn)], [-hand * math.sin(turn), math.cos(turn)]])
    return Pointing(unit_vectors(ra_deg, dec_deg), cd * scale_arcsec / ARCSEC_PER_RADIAN, MIDDLE)


def sky(rng: np.random.Generator, n: int, side_deg: float, ra_deg: float = 120.0, dec_deg: float = 35.0) -> Stars:
    """Stars uniform in a square, more of them at fainter magnitudes."""
    plane = np.radians(rng.uniform(-side_deg / 2, side_deg / 2, (n, 2)))
    ra, dec = directions_deg(from_plane(plane, unit_vectors(ra_deg, dec_deg)))
    return Stars(ra, dec, 0.1, 12 + np.log10(rng.random(n)) / 0.3)


def picture(
    rng: np.random.Generator,
    stars: Stars,
    where: Pointing,
    *,
    brightest: int = 60,
    spurious: float = 0.0,
    bend_px: float = 0.0,
) -> tuple[Seen, np.ndarray]:
    """Shuffled detections of the stars in a frame, and the catalogue row of each (−1: spurious)."""
    px = where.to_px(unit_vectors(stars.ra_deg, stars.dec_deg))
    inside = np.all((px > 0) & (px < [SHAPE[1] - 1, SHAPE[0] - 1]), axis=1)
    rows = stars.order()[inside[stars.order()]][:brightest]
    offset = (px[rows] - MIDDLE) / 500.0
    xy = px[rows] + bend_px * offset * np.sum(offset**2, axis=1, keepdims=True) + rng.normal(0, 0.15, (len(rows), 2))
    magnitude = stars.magnitude[rows] + rng.normal(0, 0.3, len(rows))
    n_false = round(len(rows) * spurious / (1 - spurious))
    xy = np.vstack([xy, rng.uniform(0, 1, (n_false, 2)) * [SHAPE[1] - 1, SHAPE[0] - 1]])
    magnitude = np.concatenate([magnitude, rng.choice(magnitude, n_false)])
    truth = np.concatenate([rows, np.full(n_false, -1)])
    order = rng.permutation(len(xy))
    covariance = np.tile([0.15**2, 0.0, 0.15**2], (len(xy), 1))
    return Seen(xy[order, 0], xy[order, 1], covariance, 10 ** (-0.4 * magnitude[order])), truth[order]


def off_px(placed: Placement | Pointing, where: Pointing) -> float:
    """Placement error at the corners of the frame, in pixels."""
    got = placed.pointing if isinstance(placed, Placement) else placed
    corners = np.array([[0.0, 0.0], [SHAPE[1] - 1, 0], [0, SHAPE[0] - 1], [SHAPE[1] - 1, SHAPE[0] - 1]])
    return float(np.abs(got.to_px(where.to_sky(corners)) - corners).max())


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize(
    ("n", "brightest", "spurious"), [(150, 60, 0.0), (150, 60, 0.5), (150, 15, 0.5), (2000, 400, 0.3)]
)
def test_an_aim_and_an_approximate_scale_are_enough(mirror: bool, n: int, brightest: int, spurious: float) -> None:
    rng = np.random.default_rng(n + brightest)
    stars = sky(rng, n, 1.0)
    where = pointing(120.04, 34.97, 1.2, rng.uniform(0, 360), mirror=mirror)
    seen, truth = picture(rng, stars, where, brightest=brightest, spurious=spurious, bend_px=1.0)
    placed = place(seen, stars, Aim(120.0, 35.0, 0.1, (1.0, 1.4)))
    assert off_px(placed, where) < 2.0
    assert placed.parity == (1 if mirror else -1) and placed.scale_arcsec == pytest.approx(1.2, rel=0.005)
    # The pairs are rows of the caller's tables, and nearly all are right.
    right = truth[placed.rows_measured] == placed.rows_stars
    assert right.mean() > 0.9 and placed.n_matched >= 0.6 * min(brightest, int(np.sum(truth >= 0)))
    assert placed.log_odds - max(placed.runner_up_log_odds, 0) > math.log(1e6)


def test_seven_stars_of_the_whole_field_are_enough_among_as_many_false() -> None:
    rng = np.random.default_rng(8)
    where = pointing(120.0, 35.0, 1.2, 77.0, mirror=True)
    px = rng.uniform([50, 50], [1050, 850], (7, 2))
    ra, dec = directions_deg(where.to_sky(px))
    stars = Stars(ra, dec, 0.2, rng.uniform(9, 12, 7))
    seen, _ = picture(rng, stars, where, spurious=0.5)
    placed = place(seen, stars, Aim(120.03, 35.02, 5 / 60, (0.95, 1.45)))
    assert placed.n_matched == 7 and off_px(placed, where) < 1.0
    assert placed.rms_arcsec < 0.3 and "7 stars" in placed.describe() and ", mirrored;" in placed.describe()


@pytest.mark.slow
@pytest.mark.parametrize("dec_deg", [-90.0, 89.95, 0.0])
def test_frames_at_the_poles_and_the_zero_meridian_are_placed(dec_deg: float) -> None:
    rng = np.random.default_rng(9)
    stars = sky(rng, 150, 1.0, 0.0, dec_deg)
    where = pointing(0.01, dec_deg, 1.2, 200.0)
    placed = place(picture(rng, stars, where, spurious=0.3)[0], stars, Aim(0.0, dec_deg, 0.1, (1.0, 1.4)))
    assert off_px(placed, where) < 1.0


def test_the_wcs_is_the_pointing() -> None:
    rng = np.random.default_rng(10)
    stars, where = sky(rng, 150, 1.0), pointing(120.0, 35.0, 1.2, 30.0)
    placed = place(picture(rng, stars, where)[0], stars, Aim(120.0, 35.0, 0.1, (1.0, 1.4)))
    px = np.array([[0.0, 0.0], [1099.0, 17.0], [300.0, 899.0]])
    world = placed.wcs.all_pix2world(px, 0)
    assert np.allclose(unit_vectors(*world.T), placed.pointing.to_sky(px), rtol=0, atol=1e-12)
    # The y axis of the frame by definition: the direction on the sky of a step up from the centre.
    step = to_plane(where.to_sky(MIDDLE + np.array([[0.0, 100.0]])), where.centre)[0]
    assert math.degrees(math.atan2(*step)) % 360 == pytest.approx(placed.rotation_deg, abs=0.05)
    assert placed.wcs.array_shape == SHAPE


@pytest.mark.slow
def test_shuffling_rows_changes_nothing() -> None:
    rng = np.random.default_rng(11)
    stars = sky(rng, 150, 1.0)
    seen, _ = picture(rng, stars, pointing(120.0, 35.0, 1.2, 30.0), spurious=0.3)
    aim, order, turn = Aim(120.0, 35.0, 0.1, (1.0, 1.4)), rng.permutation(len(seen.x_px)), rng.permutation(150)
    mixed = replace(seen, **{key: getattr(seen, key)[order] for key in ("x_px", "y_px", "covariance", "flux")})
    other = Stars(stars.ra_deg[turn], stars.dec_deg[turn], 0.1, stars.magnitude[turn])
    one, two = place(seen, stars, aim), place(mixed, other, aim)
    assert one.log_odds == pytest.approx(two.log_odds, rel=1e-9)
    assert np.array_equal(one.rows_measured, order[two.rows_measured])
    assert np.array_equal(one.rows_stars, turn[two.rows_stars])


@pytest.mark.slow
@pytest.mark.parametrize(("n", "brightest"), [(100, 30), (12, 8)])
def test_another_field_is_refused_with_the_odds(n: int, brightest: int) -> None:
    for seed in range(2):
        rng = np.random.default_rng(100 + seed)
        seen, _ = picture(rng, sky(rng, n, 0.6), pointing(120.0, 35.0, 1.2, 30.0), brightest=brightest, spurious=0.3)
        with pytest.raises(
            InputError,
            match=r"frame 7: no solution: (by the aim 1.* the best has odds 1?.*\(\d+ stars\)|no fit by the aim 1)",
        ):
            place(seen, sky(rng, n, 0.6), Aim(120.0, 35.0, 0.1, (1.0, 1.4)))


@pytest.mark.slow
def test_a_search_in_two_steps_has_every_list_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor are the patterns of the same stars made twice: they take most of the time of a frame that is refused."""
    assert BRIGHTEST_PATTERNS + FURTHER_PATTERNS == AIM_LISTS
    (k, per_field, n), (next_k, next_per_field, next_n) = AIM_LISTS[:2]
    assert (k, per_field) == (next_k, next_per_field) and n < next_n, "the second step has the patterns of the first"
    made: list[tuple[int, int]] = []

    def counted(vectors: np.ndarray, rows: np.ndarray, *, k: int, **reach: float) -> PatternIndex:
        made.append((k, len(rows)))
        return of(vectors, rows, k=k, **reach)

    of = PatternIndex.of
    monkeypatch.setattr(PatternIndex, "of", counted)
    rng = np.random.default_rng(12)
    seen, _ = picture(rng, sky(rng, 300, 0.5, ra_deg=200.0), pointing(200.0, 35.0, 1.0, 20.0), brightest=60)
    with pytest.raises(NoSolution):
        place(seen, sky(rng, 300, 0.5), Aim(120.0, 35.0, 0.05, (0.9, 1.1)))
    assert len(made) == len(set(made)) >= 2


def test_odds_against_chance_are_calibrated() -> None:
    # In random frames, odds of 1:1 or better may occur in at most one half, of 20:1 in one of 20.
    volume = SearchVolume((0.2 / 57.3) ** 2, 2 * math.pi, 0.4, 2)
    best = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        seen = rng.uniform(0, 1, (25, 2)) * SHAPE[::-1]
        where = pointing(120.0, 35.0, 1.2, 0.0)
        vectors = where.to_sky(rng.uniform(0, 1, (25, 2)) * SHAPE[::-1])
        problem = PlateProblem(seen, np.tile(0.02 * np.eye(2), (25, 1, 1)), SHAPE, vectors, np.full(25, 5e-7))
        best.append(max(verify(problem, pointing(120.0, 35.0, 1.2, turn), volume, 7.0).log_odds for turn in range(10)))
    assert np.mean(np.array(best) > math.log(20.0)) <= 0.05


@pytest.mark.slow
def test_a_wrong_scale_or_aim_is_refused() -> None:
    rng = np.random.default_rng(12)
    stars = sky(rng, 120, 0.6)
    seen, _ = picture(rng, stars, pointing(120.0, 35.0, 1.2, 30.0))
    for aim in (Aim(120.0, 35.0, 0.1, (1.5, 1.9)), Aim(120.3, 35.3, 0.05, (1.0, 1.4))):
        advice = (
            r"by the aim 120\.\d000°, \+35\.\d000°.*; give another aim, a larger radius than 0\.\d+°, a wider range "
            r"of scales than 1.* to 1\.\d″ per pixel \(are pixels"
        )
        with pytest.raises(InputError, match=advice):
            place(seen, stars, aim)


@pytest.mark.parametrize(("shift", "turn"), [(0.0, 0.0), (40.0, 1.2), (-110.0, -1.5)])
def test_a_header_that_is_nearly_right_is_corrected(shift: float, turn: float) -> None:
    rng = np.random.default_rng(13)
    stars, where = sky(rng, 150, 1.0), pointing(120.0, 35.0, 1.2, 200.0)
    seen, _ = picture(rng, stars, where, spurious=0.5)
    header = where.moved(np.array([shift, -0.7 * shift, 0.004, math.radians(turn), 0, 0])).to_wcs()
    placed = place(seen, stars, ApproximateWcs(header))
    assert off_px(placed, where) < 1.0 and placed.hint == "the header's plate solution"


def test_a_headers_distortion_is_taken_out_before_the_frame_is_placed() -> None:
    rng = np.random.default_rng(14)
    stars, where = sky(rng, 400, 1.0), pointing(120.0, 35.0, 1.2, 20.0)
    seen, _ = picture(rng, stars, where, brightest=40)
    x = np.column_stack([seen.x_px, seen.y_px]) - MIDDLE
    a = np.zeros((3, 3))
    a[2, 0], a[0, 2] = 1.2e-4, -0.8e-4
    bent = where.to_wcs()
    bent.wcs.ctype = ["RA---TAN-SIP", "DEC--TAN-SIP"]
    bent.sip = Sip(a, np.zeros((3, 3)), None, None, bent.wcs.crpix)
    # Distorted positions: u + A(u) is the undistorted one, 36 px at the edge.
    u = x.copy()
    for _ in range(30):
        u[:, 0] = x[:, 0] - a[2, 0] * u[:, 0] ** 2 - a[0, 2] * u[:, 1] ** 2
    curved = replace(seen, x_px=u[:, 0] + MIDDLE[0], y_px=u[:, 1] + MIDDLE[1])
    placed = place(curved, stars, ApproximateWcs(bent))
    assert placed.rms_arcsec < 0.3 and placed.n_matched > 35
    assert np.abs(placed.residual_px).max() > 3.0  # of the linear solution, which is all that is returned


@pytest.mark.slow
def test_hints_are_tried_in_turn() -> None:
    rng = np.random.default_rng(15)
    stars, where = sky(rng, 150, 1.0), pointing(120.0, 35.0, 1.2, 200.0)
    seen, _ = picture(rng, stars, where)
    wrong = ApproximateWcs(pointing(120.0, 35.0, 1.2, 100.0).to_wcs())
    placed = place(seen, stars, [wrong, Aim(120.0, 35.0, 0.1, (1.0, 1.4))])
    assert placed.hint == "the aim" and off_px(placed, where) < 1.0
    with pytest.raises(InputError, match=r"by the header's plate solution .*; give a larger radius"):
        place(seen, stars, wrong)


def whole_sky(n: int = 20_000) -> Stars:
    rng = np.random.default_rng(16)
    vectors = rng.normal(size=(n, 3))
    return Stars(*directions_deg(vectors), 0.3, 8 + np.log10(rng.random(n)) / 0.4)


@pytest.mark.slow
def test_a_wide_field_is_found_anywhere_from_a_range_of_scales() -> None:
    stars, hint = whole_sky(), AllSky((28.0, 35.0))
    index = sky_index(stars, SHAPE, hint)
    for seed, mirror in ((0, False), (1, True)):
        rng = np.random.default_rng(seed)
        ra, dec = directions_deg(rng.normal(size=3))
        where = pointing(float(ra), float(dec), rng.uniform(28.5, 34.5), rng.uniform(0, 360), mirror=mirror)
        seen, _ = picture(rng, stars, where, brightest=40, spurious=0.5, bend_px=2.0)
        placed = place(seen, stars, hint, index=index)
        assert off_px(placed, where) < 6.0
    rng = np.random.default_rng(3)
    x, y = (rng.uniform(0, 1, (15, 2)) * SHAPE[::-1]).T
    nowhere = Seen(x, y, np.tile([0.02, 0, 0.02], (15, 1)), rng.random(15))
    with pytest.raises(InputError, match=r"whole sky the best has odds 1:.*give an aim, a wider range of scales"):
        place(nowhere, stars, hint, index=index)


def test_a_field_that_holds_no_stars_of_the_catalogue_is_refused_at_once() -> None:
    with pytest.raises(InputError, match=r"a field of 0\.28° holds 0\.\d+ stars of the catalogue"):
        sky_index(whole_sky(), SHAPE, AllSky((1.0, 2.0)))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Aim(10.0, 95.0, 1.0, (1.0, 2.0)), r"Aim: \(10\.0, 95\.0\)"),
        (lambda: Aim(10.0, 5.0, 1.0, (2.0, 1.0)), r"scale_arcsec is \(2\.0, 1\.0\); give \(least, largest\)"),
        (lambda: AllSky((0.0, 1.0)), "AllSky: scale_arcsec"),
        (lambda: ApproximateWcs(WCS(naxis=2)), "no celestial axes; give an Aim"),
        (lambda: Stars(np.zeros(3), np.zeros(3), 0.1, np.zeros(2)), r"magnitude has shape \(2,\)"),
        (lambda: Stars(np.array([0.0, np.nan]), np.zeros(2), 0.1, np.zeros(2)), "row 1 has no position"),
    ],
)
def test_bad_hints_and_catalogues_are_refused(make: object, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()  # type: ignore[operator]


def test_too_few_stars_or_hints_are_refused() -> None:
    rng = np.random.default_rng(17)
    stars = sky(rng, 150, 1.0)
    seen, _ = picture(rng, stars, pointing(120.0, 35.0, 1.2, 0.0))
    three = Seen(seen.x_px[:3], seen.y_px[:3], seen.covariance[:3], seen.flux[:3])
    with pytest.raises(InputError, match="frame 7: 3 usable measurements"):
        place(three, stars, AllSky((1.0, 2.0)))
    with pytest.raises(InputError, match=r"the catalogue has 0 stars within 0\.\d+° of the aim"):
        place(seen, stars, Aim(300.0, 35.0, 0.1, (1.0, 1.4)))
    for hint in (Aim(120.0, 35.0, 1.0, (600.0, 700.0)), AllSky((600.0, 700.0))):  # of an all-sky camera: it was a fault
        with pytest.raises(InputError, match="is not flat; cut a part of less than 60° out of the frame"):
            place(seen, sky(rng, 3000, 180.0), hint)


@pytest.mark.parametrize(
    ("log_odds", "words"), [(math.log(250), "250:1"), (-math.log(30), "1:30"), (103.6, "10^45:1"), (-math.inf, "none")]
)
def test_odds_are_printed_readably(log_odds: float, words: str) -> None:
    assert odds_in_words(log_odds) == words


def detected(path: Path, dark: np.ndarray | float, name: str) -> Seen:
    """Plain detections with SciPy alone: connected pixels above 4σ, centroids of light."""
    from scipy import ndimage

    image = fits.getdata(path).astype(np.float64) - dark
    image -= ndimage.zoom(ndimage.median_filter(image[::8, ::8], 9), 8, order=1)[: image.shape[0], : image.shape[1]]
    noise = 1.4826 * np.median(np.abs(image - np.median(image)))
    smooth = ndimage.gaussian_filter(image, 1.0)
    label, n = ndimage.label(smooth > 4 * noise * 0.4)
    index = np.arange(1, n + 1)
    keep = index[ndimage.sum(np.ones_like(image), label, index) >= 6]
    y, x = np.array(ndimage.center_of_mass(np.maximum(image, 0), label, keep)).T
    flux = ndimage.sum(image, label, keep)
    return Seen(x, y, np.tile([0.01, 0.0, 0.01], (len(x), 1)), flux, image.shape, name)


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "asteroid_2713").exists(), reason="the frames of asteroid 2713 are not here")
def test_real_frames_without_a_solution_are_placed_by_eleven_tycho_stars() -> None:
    folder = DATA / "asteroid_2713"
    table = np.genfromtxt(folder / "tycho2_field_r0.3deg.csv", delimiter=",", names=True)
    stars = Stars(table["ra_deg"], table["dec_deg"], 0.3, table["VT"], "Tycho-2")
    dark = np.median([fits.getdata(path).astype(float) for path in sorted(folder.glob("*Dark*"))], axis=0)
    frames = sorted(folder.glob("*Light*"))
    assert len(frames) == 10
    aim = Aim(62.53667, 22.83959, 5 / 60, (1.176 * 0.8, 1.176 * 1.2))
    for path in frames:
        placed = place(detected(path, dark, path.name), stars, aim)
        assert placed.scale_arcsec == pytest.approx(1.176, abs=0.002)
        assert placed.n_matched >= 6 and placed.rms_arcsec < 0.3 and placed.log_odds > math.log(1e12)


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "m67_poss1951").exists(), reason="the plate of M67 is not here")
def test_a_real_plates_own_solution_is_verified_and_refined() -> None:
    folder = DATA / "m67_poss1951"
    gaia = np.genfromtxt(folder / "gaia_edr3_m67_r0.5deg.csv", delimiter=",", names=True)
    gaia = gaia[gaia["phot_g_mean_mag"] < 18.5]
    years = 1951.91 - 2016.0
    dec = gaia["dec"] + years * np.nan_to_num(gaia["pmdec"]) / 3.6e6
    ra = gaia["ra"] + years * np.nan_to_num(gaia["pmra"]) / 3.6e6 / np.cos(np.radians(dec))
    stars = Stars(ra, dec, 0.05, gaia["phot_g_mean_mag"], "Gaia")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        header = WCS(fits.getheader(folder / "M6707HH.fits"))
    seen = detected(folder / "M6707HH.fits", 0.0, "M67")
    placed = place(seen, stars, ApproximateWcs(header))
    assert placed.scale_arcsec == pytest.approx(1.70, abs=0.005) and placed.parity == -1
    assert placed.n_matched > 500 and placed.rms_arcsec < 0.4
    i, j, ones = placed.rows_measured, placed.rows_stars, np.ones(placed.n_matched)
    pairs = MatchedStars(
        px=np.column_stack([seen.x_px[i], seen.y_px[i]]),
        covariance_px=seen.covariance[i],
        ra_deg=ra[j],
        dec_deg=dec[j],
        covariance_arcsec=np.outer(ones, [0.0025, 0.0, 0.0025]),
        p_match=ones,
    )
    plate = fit_plate(pairs, placed.pointing, seen.shape)
    assert plate.order <= 2 and (plate.rms_arcsec < 0.3).all()
