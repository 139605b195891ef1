"""The plate model: a known plate is recovered, errors are calibrated, and the WCS is consistent in both directions."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from sameas.errors import InputError
from sameas.sky.frame.plate import MatchedStars, PlateModel, Polynomial, fit_plate, sky_axes, terms
from sameas.sky.frame.pointing import Pointing
from sameas.space import ARCSEC_PER_RADIAN, directions_deg, from_plane, sphere_offset, unit_vectors

SHAPE = (1500, 2000)
MIDDLE = np.array([999.5, 749.5])


def pointing(ra_deg: float = 210.0, dec_deg: float = 54.0, scale_arcsec: float = 2.0) -> Pointing:
    turn = math.radians(33.0)
    cd = np.array([[-math.cos(turn), math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    return Pointing(
        unit_vectors(ra_deg, dec_deg), cd * scale_arcsec / ARCSEC_PER_RADIAN, MIDDLE + np.array([3.0, -2.0])
    )


def bent(order: int, size_px: float, seed: int = 0, **where: float) -> tuple[Pointing, Polynomial]:
    """A plate whose nonlinear terms reach ``size_px`` in the corners."""
    start = pointing(**where)
    plate = Polynomial.linear(start, MIDDLE, 0.5 * math.hypot(*SHAPE), order)
    coefficients = plate.coefficients.copy()
    rng = np.random.default_rng(seed)
    bend = rng.normal(0.0, size_px * start.scale_arcsec, coefficients.shape)
    coefficients[:, 3:] += bend[:, 3:]
    return start, plate.with_coefficients(coefficients)


def seen(
    start: Pointing,
    plate: Polynomial,
    n: int,
    rng: np.random.Generator,
    *,
    sigma_px: float = 0.05,
    sigma_arcsec: float = 0.05,
) -> MatchedStars:
    """Stars uniform over the frame; measurements and catalogue have correlated errors as quoted."""
    true_px = rng.uniform([0, 0], [SHAPE[1] - 1, SHAPE[0] - 1], (n, 2))
    px_factor = np.array([[1.0, 0.0], [0.6, 0.8]]) * sigma_px
    sky_factor = np.array([[1.0, 0.0], [-0.5, 1.2]]) * sigma_arcsec
    px_covariance, sky_covariance = px_factor @ px_factor.T, sky_factor @ sky_factor.T
    ra, dec = directions_deg(from_plane(plate(true_px) / ARCSEC_PER_RADIAN, start.centre))
    error = rng.normal(size=(n, 2)) @ sky_factor.T / 3600.0
    return MatchedStars(
        px=true_px + rng.normal(size=(n, 2)) @ px_factor.T,
        covariance_px=np.tile(px_covariance[np.triu_indices(2)], (n, 1)),
        ra_deg=ra + error[:, 0] / np.cos(np.radians(dec)),
        dec_deg=dec + error[:, 1],
        covariance_arcsec=np.tile(sky_covariance[np.triu_indices(2)], (n, 1)),
        p_match=np.ones(n),
    )


def grid(n: int = 15) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, SHAPE[1] - 1, n), np.linspace(0, SHAPE[0] - 1, n))
    return np.column_stack([x.ravel(), y.ravel()])


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_a_known_polynomial_is_recovered_exactly(order: int) -> None:
    start, plate = bent(order, 4.0)
    stars = seen(start, plate, 80, np.random.default_rng(1), sigma_px=1e-9, sigma_arcsec=1e-9)
    model = fit_plate(stars, start, SHAPE, order=order)
    assert np.abs(model.polynomial(grid()) - plate(grid())).max() < 1e-5


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_true_order_of_the_plate_is_chosen(order: int) -> None:
    chosen = []
    for seed in range(8):
        start, plate = bent(order, 2.0, seed)
        chosen.append(fit_plate(seen(start, plate, 60, np.random.default_rng(seed)), start, SHAPE).order)
    assert sum(p == order for p in chosen) >= 7


@pytest.mark.slow
def test_errors_of_predictions_are_calibrated() -> None:
    start, plate = bent(2, 3.0)
    points = np.array([[1000.0, 700.0], [10.0, 10.0], [1990.0, 20.0], [300.0, 1490.0]])
    ra, dec = directions_deg(from_plane(plate(points) / ARCSEC_PER_RADIAN, start.centre))
    squares, back = [], []
    for seed in range(200):
        stars = seen(start, plate, 40, np.random.default_rng(seed))
        model = fit_plate(stars, start, SHAPE, order=2)
        x, y, packed = model.predict(ra, dec)
        squares.append(mahalanobis_sq(np.column_stack([x, y]) - points, packed))
        model_ra, model_dec, packed = model.to_sky(*points.T)
        back.append(mahalanobis_sq(sphere_offset(model_ra, model_dec, ra, dec), packed))
    # Two degrees of freedom, 800 values, four of each frame alike: the mean is 2 within 0.2, the 68.3 % point 2.30.
    for values in (np.array(squares), np.array(back)):
        assert 1.7 < values.mean() < 2.2
        assert 0.63 < np.mean(values < 2.2957) < 0.75


def with_floor(stars: MatchedStars, rng: np.random.Generator, floor_px: float) -> MatchedStars:
    """Stars of all brightnesses, quoted errors of 0.004 to 0.3 px, that are off by a floor nobody quotes as well."""
    n = len(stars.px)
    sigma = 0.004 * 10 ** rng.uniform(0.0, 1.9, n)
    error = rng.normal(size=(n, 2)) * np.hypot(sigma, floor_px)[:, None]
    none = np.zeros(n)
    return replace(
        stars, px=stars.px + error, covariance_px=np.column_stack([sigma**2, none, sigma**2]),
        covariance_arcsec=np.full((n, 3), 1e-8) * [1.0, 0.0, 1.0],
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("floor_px", [0.03, 0.0])
def test_a_floor_of_bright_stars_is_found_and_does_not_bend_the_plate(floor_px: float) -> None:
    squares, errors, best, floors = [], [], [], []
    start, plate = bent(3, 3.0)
    points = grid(6)
    ra, dec = directions_deg(from_plane(plate(points) / ARCSEC_PER_RADIAN, start.centre))
    for seed in range(15):
        rng = np.random.default_rng(seed)
        stars = with_floor(seen(start, plate, 200, rng, sigma_px=1e-9, sigma_arcsec=1e-9), rng, floor_px)
        quoted = replace(stars, covariance_px=stars.covariance_px + floor_px**2 * np.array([1.0, 0.0, 1.0]))
        model = fit_plate(stars, start, SHAPE)
        x, y, packed = model.predict(ra, dec)
        squares.append(mahalanobis_sq(np.column_stack([x, y]) - points, packed).mean() / 2)
        floors.append(model.floor_arcsec / start.scale_arcsec)
        errors.append(np.mean((model.polynomial(points) - plate(points)) ** 2))
        best.append(np.mean((fit_plate(quoted, start, SHAPE, order=3).polynomial(points) - plate(points)) ** 2))
    assert 0.75 < np.mean(squares) < 1.3, "the stated errors of the plate are the true ones"
    assert np.sqrt(np.mean(errors)) < 1.1 * np.sqrt(np.mean(best)), "as good as with a floor that is known"
    if floor_px:
        assert 0.8 < np.median(floors) / floor_px < 1.2
    else:
        assert np.mean(np.array(floors) > 0) < 0.1, "no floor is invented"


def mahalanobis_sq(residual: np.ndarray, packed: np.ndarray) -> np.ndarray:
    full = packed[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return np.einsum("ni,nij,nj->n", residual, np.linalg.inv(full), residual)


def test_the_covariance_of_a_new_star_includes_its_own_error() -> None:
    start, plate = bent(1, 0.0)
    model = fit_plate(seen(start, plate, 50, np.random.default_rng(2)), start, SHAPE)
    ra, dec, _ = model.to_sky([500.0], [300.0])
    without = model.predict(ra, dec)[2]
    with_star = model.predict(ra, dec, [[4.0, 0.0, 4.0]])[2]
    # 2″ at 2″ per pixel is one pixel; circular errors do not change under rotation.
    assert np.allclose(with_star - without, [[1.0, 0.0, 1.0]], atol=2e-3)
    alone = model.to_sky([500.0], [300.0])[2]
    measured = model.to_sky([500.0], [300.0], [[0.25, 0.0, 0.25]])[2]
    assert np.allclose(measured - alone, [[1.0, 0.0, 1.0]], atol=2e-3)


@pytest.mark.parametrize("where", [{"dec_deg": 0.0}, {"dec_deg": 89.9}, {"dec_deg": -90.0}, {"scale_arcsec": 20.0}])
def test_both_directions_agree_everywhere_on_the_sphere(where: dict[str, Any]) -> None:
    start, plate = bent(3, 3.0, **where)
    model = fit_plate(seen(start, plate, 100, np.random.default_rng(4), sigma_arcsec=0.01), start, SHAPE, order=3)
    x, y, _ = model.predict(*model.to_sky(*grid().T)[:2])
    assert np.abs(np.column_stack([x, y]) - grid()).max() < 1e-6


def test_stars_behind_or_far_from_the_plane_have_no_position() -> None:
    start, plate = bent(3, 3.0)
    model = fit_plate(seen(start, plate, 100, np.random.default_rng(4)), start, SHAPE, order=3)
    assert np.isnan(model.predict([30.0, 300.0], [-54.0, 10.0])[0]).all()


@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_the_wcs_is_consistent_in_both_directions_and_through_a_header(order: int) -> None:
    start, plate = bent(order, 3.0)
    model = fit_plate(seen(start, plate, 150, np.random.default_rng(5)), start, SHAPE, order=order)
    ra, dec, _ = model.to_sky(*grid().T)
    wcs = WCS(fits.Header.fromstring(model.to_wcs().to_header(relax=True).tostring()))
    assert wcs.wcs.ctype[0] == ("RA---TAN" if order == 1 else "RA---TAN-SIP")
    sky = wcs.all_pix2world(grid(), 0)
    assert np.abs(sphere_offset(sky[:, 0], sky[:, 1], ra, dec)).max() < 1e-5
    # Astropy inverts iteratively; other programs use the header's reverse polynomial.
    assert np.abs(wcs.all_world2pix(np.column_stack([ra, dec]), 0) - grid()).max() < 0.01
    if order > 1:
        straight = wcs.wcs_world2pix(np.column_stack([ra, dec]), 1) - wcs.wcs.crpix
        powers = straight[:, :1, None] ** np.arange(10)[:, None] * straight[:, 1:, None] ** np.arange(10)
        bend = [(table * powers[:, : len(table), : len(table)]).sum(axis=(1, 2)) for table in (wcs.sip.ap, wcs.sip.bp)]
        reverse = straight + np.column_stack(bend) + wcs.wcs.crpix - 1.0
        assert np.abs(reverse - grid()).max() < 0.01


def test_false_pairs_do_not_bias_the_fit() -> None:
    start, plate = bent(2, 2.0)
    stars = seen(start, plate, 60, np.random.default_rng(6))
    px = stars.px.copy()
    px[:4] += [[40.0, 3.0], [-25.0, 60.0], [8.0, 8.0], [0.0, -30.0]]
    wrong = MatchedStars(**{**vars(stars), "px": px})
    clean, pulled = fit_plate(stars, start, SHAPE), fit_plate(wrong, start, SHAPE)
    assert pulled.order == clean.order == 2
    assert np.abs(pulled.polynomial(grid()) - clean.polynomial(grid())).max() < 0.25
    assert (pulled.weight[:4] < 0.05).all() and np.median(pulled.weight) == 1.0


def test_a_pair_counts_with_its_probability() -> None:
    start, plate = bent(1, 0.0)
    stars = seen(start, plate, 30, np.random.default_rng(7))
    p = np.ones(30)
    p[20:] = 0.0
    some = fit_plate(MatchedStars(**{**vars(stars), "p_match": p}), start, SHAPE, order=1)
    alone = fit_plate(MatchedStars(**{key: values[:20] for key, values in vars(stars).items()}), start, SHAPE, order=1)
    assert np.allclose(some.polynomial.coefficients, alone.polynomial.coefficients, rtol=0, atol=1e-6)
    assert np.allclose(some.covariance, alone.covariance, rtol=1e-6)
    assert some.effective_pairs == 20


def test_errors_that_are_too_small_are_detected() -> None:
    start, plate = bent(2, 2.0)
    stars = seen(start, plate, 150, np.random.default_rng(8))
    bold = MatchedStars(
        **{
            **vars(stars),
            "covariance_px": stars.covariance_px / 9.0,
            "covariance_arcsec": stars.covariance_arcsec / 9.0,
        }
    )
    model = fit_plate(bold, start, SHAPE)
    assert model.order == 2 and 2.6 < model.error_scale < 3.4
    assert f"errors {model.error_scale:.2f} times those quoted" in model.describe()


def test_the_axes_of_the_plane_are_those_of_the_sky_where_it_touches() -> None:
    centre = unit_vectors(40.0, 80.0)
    vectors = from_plane(np.array([[0.0, 0.0], [0.01, 0.02]]), centre)
    turn = sky_axes(vectors, centre)
    assert np.allclose(turn[0], np.eye(2), atol=1e-12)
    step = 1e-7
    for axis in range(2):
        moved = np.array([[0.01, 0.02]]) + step * np.eye(2)[axis]
        there = directions_deg(from_plane(moved, centre))
        here = directions_deg(vectors[1:])
        offset = sphere_offset(*there, *here)[0] / ARCSEC_PER_RADIAN / step
        assert np.allclose(turn[1][:, axis], offset, atol=1e-5)


def model_of(n: int, order: int | None = None) -> PlateModel:
    start, plate = bent(1, 0.0)
    return fit_plate(seen(start, plate, n, np.random.default_rng(9)), start, SHAPE, order=order)


def test_no_order_is_tried_that_the_stars_cannot_determine() -> None:
    assert list(model_of(7).bic) == [1, 2]
    assert list(model_of(3).bic) == [1]
    assert list(model_of(30).bic) == [1, 2, 3, 4, 5]
    assert len(terms(5)) == 21


@pytest.mark.parametrize(
    ("n", "options", "words"),
    [
        (2, {}, r"2\.0 identified stars are too few for order 1, which needs 3"),
        (6, {"order": 2}, r"too few for order 2, which needs 7; give a lower order"),
        (20, {"order": 6}, r"order is 6; give 1 … 5"),
    ],
)
def test_too_few_stars_are_refused(n: int, options: dict[str, int], words: str) -> None:
    with pytest.raises(InputError, match=words):
        model_of(n, **options)


def test_stars_on_a_line_and_nan_rows_are_refused() -> None:
    start, plate = bent(1, 0.0)
    stars = seen(start, plate, 10, np.random.default_rng(9))
    line = np.column_stack([np.arange(10.0) * 50, np.arange(10.0) * 30])
    with pytest.raises(InputError, match="lie on a line or in one place"):
        fit_plate(MatchedStars(**{**vars(stars), "px": line}), start, SHAPE)
    dec = stars.dec_deg.copy()
    dec[4] = np.nan
    with pytest.raises(InputError, match="dec_deg of pair 4 is not a number"):
        MatchedStars(**{**vars(stars), "dec_deg": dec})
    with pytest.raises(InputError, match="the star of pair 0 is 90° or more from the frame"):
        fit_plate(MatchedStars(**{**vars(stars), "dec_deg": -stars.dec_deg}), start, SHAPE)
    with pytest.raises(InputError, match="p_match must be within"):
        MatchedStars(**{**vars(stars), "p_match": np.full(10, 1.5)})


@pytest.mark.slow
def test_the_order_is_no_higher_than_the_pairs_support() -> None:
    """Two dozen pairs on a straight plate, two in five wrong by a few pixels: the order of least BIC was up to 5,
    with errors of up to 60 px over the frame."""
    start, plate = bent(1, 0.0)
    higher, errors = 0, []
    for seed in range(20):
        rng = np.random.default_rng([36, seed])
        stars = seen(start, plate, 24, rng, sigma_px=0.1)
        wrong = rng.uniform(size=(24, 1)) < 0.4
        stars = replace(stars, px=stars.px + np.where(wrong, rng.uniform(-4.0, 4.0, (24, 2)), 0.0))
        model = fit_plate(stars, start, SHAPE)
        higher += min(model.bic, key=lambda order: model.bic[order]) > model.order
        off = model.polynomial(grid()) - plate(grid())
        errors.append(math.sqrt(float(np.mean(off**2))) / start.scale_arcsec)
    assert higher >= 5  # what is tested happens
    assert max(errors) < 2.0 and np.median(errors) < 0.5


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("size_px", [0.5, 10.0, 40.0])
def test_every_chosen_plate_is_invertible(order: int, size_px: float) -> None:
    start, plate = bent(order, size_px, seed=order)
    model = fit_plate(seen(start, plate, 200, np.random.default_rng(6)), start, SHAPE)
    wcs = WCS(fits.Header.fromstring(model.to_wcs().to_header(relax=True).tostring()))
    back = wcs.all_world2pix(wcs.all_pix2world(grid(), 0), 0)
    assert np.abs(back - grid()).max() < 0.01
