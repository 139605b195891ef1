"""Propagation to another epoch: against STILTS (stored), astropy, differences, random draws, and invariances."""

from __future__ import annotations

import dataclasses
import doctest
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.time import Time
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sameas.errors import InputError
from sameas.sky import motion
from sameas.sky.motion import PARAMETERS, Astrometry, MissingMotion, Variances, position_at, propagate

MAS = np.radians(1 / 3.6e6)
BARNARD: dict[str, Any] = {"parallax_mas": [547.45], "pm_ra_mas_per_yr": [-801.551], "pm_dec_mas_per_yr": [10362.394]}
EXACT = MissingMotion(0.0, 0.0, 0.0)


def values_of(astrometry):
    return np.stack([getattr(astrometry, name) for name in PARAMETERS], axis=1)


def astrometry_of(values, sigma, *, epoch_jyr=2016.0, missing=None, correlation=None):
    named = dict(zip(PARAMETERS, np.asarray(values, float).T, strict=True))
    return Astrometry.of(**named, sigma=sigma, epoch_jyr=epoch_jyr, missing=missing, correlation=correlation)


def offset_mas(astrometry, other):
    """(n, 2) east and north of ``astrometry``; small, anywhere on the sky."""
    tangents = triad(astrometry)
    return np.einsum("nkx,nx->nk", tangents[:, :2], triad(other)[:, 2]) / MAS


def triad(astrometry):
    """(n, 3, 3) unit vectors east, north and outwards."""
    ra, dec = np.radians(astrometry.ra_deg), np.radians(astrometry.dec_deg)
    zero = np.zeros_like(ra)
    east = [-np.sin(ra), np.cos(ra), zero]
    north = [-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)]
    outwards = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    return np.array([east, north, outwards]).transpose(2, 0, 1)


def pm_vectors(astrometry):
    """(n, 3) proper motions as vectors in space."""
    pm = np.stack([astrometry.pm_ra_mas_per_yr, astrometry.pm_dec_mas_per_yr], axis=1)
    return np.einsum("nk,nkx->nx", pm, triad(astrometry)[:, :2])


def placed(vectors, tangential, parallax, velocity, template):
    """Astrometry from places and proper motions as vectors (n, 3), with the errors of ``template``."""
    ra = np.degrees(np.arctan2(vectors[:, 1], vectors[:, 0])) % 360.0
    dec = np.degrees(np.arctan2(vectors[:, 2], np.hypot(vectors[:, 0], vectors[:, 1])))
    here = dataclasses.replace(template, ra_deg=ra, dec_deg=dec, parallax_mas=parallax)
    pm = np.einsum("nkx,nx->nk", triad(here)[:, :2], tangential)
    return dataclasses.replace(
        here, pm_ra_mas_per_yr=pm[:, 0], pm_dec_mas_per_yr=pm[:, 1], radial_velocity_km_per_s=velocity
    )


def random_stars(rng, n, sigma_scale=1.0):
    ra, dec = rng.uniform(0, 360, n), np.degrees(np.arcsin(rng.uniform(-1, 1, n)))
    moves = (rng.uniform(1, 300, n), rng.normal(0, 2000, (n, 2)), rng.normal(0, 60, n))
    values = np.column_stack([ra, dec, *moves])
    roots = rng.normal(size=(n, 6, 8))
    spread = roots @ roots.swapaxes(1, 2)
    size = np.sqrt(np.einsum("nii->ni", spread))
    correlation = spread / size[:, :, None] / size[:, None, :]
    return astrometry_of(values, sigma_scale * rng.uniform(0.1, 2, (n, 6)), correlation=correlation)


# --- external references


@pytest.fixture(scope="module")
def stilts():
    """Results of STILTS for edge cases and random stars; see data/make_motion_oracle.py."""
    path = Path(__file__).parent / "data/motion_oracle.csv"
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    years, taken, answer = table[:, 0], table[:, 1:23], table[:, 23:]
    correlation = np.zeros((len(table), 5, 5))
    correlation[:, *np.triu_indices(5, 1)] = taken[:, 12:]
    correlation += correlation.swapaxes(1, 2)
    # STILTS treats a missing radial velocity as exactly zero.
    missing = MissingMotion(radial_velocity_sigma_km_per_s=0.0)
    old = astrometry_of(taken[:, :6], taken[:, 6:12], epoch_jyr=0.0, missing=missing, correlation=correlation)
    return old, propagate(old, years), years, answer


def test_values_agree_with_stilts(stilts):
    old, new, _, answer = stilts
    theirs = dataclasses.replace(new, ra_deg=answer[:, 0], dec_deg=answer[:, 1])
    assert np.abs(offset_mas(new, theirs)).max() < 0.01
    assert np.allclose(values_of(new)[:, 2:5], answer[:, 2:5], rtol=1e-8, atol=1e-6)
    known = np.isfinite(answer[:, 5]) & (old.parallax_mas != 0)
    assert known.sum() > 180
    assert np.allclose(new.radial_velocity_km_per_s[known], answer[known, 5], rtol=1e-7)


def test_errors_and_correlations_agree_with_stilts(stilts):
    _, new, _, answer = stilts
    sigma = np.sqrt(np.einsum("nii->ni", new.covariance))[:, :5]
    assert np.allclose(sigma, answer[:, 6:11], rtol=1e-7, atol=0)
    correlation = new.covariance[:, :5, :5] / sigma[:, :, None] / sigma[:, None, :]
    assert np.allclose(correlation[:, *np.triu_indices(5, 1)], answer[:, 12:], rtol=1e-6, atol=1e-8)


def test_error_of_radial_velocity_agrees_with_stilts_under_its_approximation(stilts):
    """STILTS neglects the correlation of the new radial velocity with the new parallax."""
    old, new, years, answer = stilts
    known = np.isfinite(answer[:, 11]) & (old.parallax_mas != 0)
    assert known.sum() > 120
    old, new, years, answer = old[known], new[known], years[known], answer[known]
    parallax, velocity, covariance = new.parallax_mas, new.radial_velocity_km_per_s, new.covariance
    nearer = parallax / old.parallax_mas
    turn = np.arccos(np.clip(np.einsum("nx,nx->n", triad(old)[:, 2], triad(new)[:, 2]), -1, 1))
    product = old.covariance[:, 2, 2] * old.covariance[:, 5, 5]
    by_radial = parallax * nearer * years * MAS * np.cos(turn) / motion.AU_KM_PER_S_YR
    neglect = 2 * velocity * parallax * covariance[:, 2, 5] - product * (velocity * by_radial) ** 2
    variance = parallax**2 * covariance[:, 5, 5] + neglect + product * (nearer**2 * np.cos(2 * turn)) ** 2
    variance /= parallax**2 + covariance[:, 2, 2]
    assert np.allclose(np.sqrt(variance), answer[:, 11], rtol=1e-6)


def space_motion_of_astropy(astrometry, years):
    start = SkyCoord(
        astrometry.ra_deg * u.deg,
        astrometry.dec_deg * u.deg,
        distance=1000 / astrometry.parallax_mas * u.pc,
        pm_ra_cosdec=astrometry.pm_ra_mas_per_yr * u.mas / u.yr,
        pm_dec=astrometry.pm_dec_mas_per_yr * u.mas / u.yr,
        radial_velocity=astrometry.radial_velocity_km_per_s * u.km / u.s,
        obstime=Time(2016.0, format="jyear", scale="tdb"),
    )
    end = start.apply_space_motion(new_obstime=Time(2016.0 + years, format="jyear", scale="tdb"))
    return dataclasses.replace(astrometry, ra_deg=end.ra.deg, dec_deg=end.dec.deg)


def test_positions_differ_from_astropy_by_its_light_time_effect():
    """ERFA's starpm includes the light-time effect: second order in time, of the order μt (V/c) (Vt/d)."""
    rng = np.random.default_rng(5)
    stars, years = random_stars(rng, 300), 50.0
    values = values_of(stars)
    values[:, 2] = 10 ** rng.uniform(0, 2.5, 300)
    values[:, 3:5] = values[:, 2:3] * rng.normal(0, 10, (300, 2))
    values[0, 2:] = [547.45, -801.551, 10362.394, -110.5]
    stars = astrometry_of(values, np.ones((300, 6)))
    transverse = np.hypot(values[:, 3], values[:, 4])
    speed = np.hypot(motion.AU_KM_PER_S_YR * transverse / values[:, 2], values[:, 5])
    travelled = speed * years * values[:, 2] * MAS / motion.AU_KM_PER_S_YR
    light_time_mas = transverse * years * travelled * speed / 299792.458
    apart = np.abs(offset_mas(propagate(stars, 2016.0 + years), space_motion_of_astropy(stars, years)))
    assert (apart.max(axis=1) < light_time_mas + 1e-4).all()
    assert np.median(apart) < 1e-4
    assert 0.1 < apart[0].max() < 0.5  # Barnard's star


# --- the derivatives


def test_derivatives_agree_with_finite_differences():
    stars = random_stars(np.random.default_rng(1), 50)
    end_epoch = 2016.0 + 80.0
    end = propagate(stars, end_epoch)
    numeric = np.empty((50, 6, 6))
    steps = np.array([2000.0, 2000.0, 1e-3, 1.0, 1.0, 1e-2])
    for parameter, step in enumerate(steps):
        there, back = (propagate(shifted(stars, parameter, h), end_epoch) for h in (step, -step))
        numeric[:, :, parameter] = difference(there, back, end) / (2 * step)
    first = numeric @ stars.covariance @ numeric.swapaxes(1, 2)
    product = stars.covariance[:, 2, 2] * stars.covariance[:, 5, 5] + stars.covariance[:, 2, 5] ** 2
    by_radial = numeric[:, :, 5] / stars.parallax_mas[:, None]
    by_radial[:, 5] = 0.0
    expected = first + product[:, None, None] * by_radial[:, :, None] * by_radial[:, None, :]
    scale = np.sqrt(np.einsum("nii->ni", expected))
    assert (np.abs(end.covariance - expected) < 1e-5 * scale[:, :, None] * scale[:, None, :]).all()


def shifted(stars, parameter, step):
    """``stars`` with one parameter changed; a change of position parallel-transports the proper motion."""
    if parameter >= 2:
        name = PARAMETERS[parameter]
        return dataclasses.replace(stars, **{name: getattr(stars, name) + step})
    tangent, outwards, pm = triad(stars)[:, parameter], triad(stars)[:, 2], pm_vectors(stars)
    along = np.einsum("nx,nx->n", pm, tangent)[:, None]
    angle = step * MAS
    carried = pm + along * ((np.cos(angle) - 1) * tangent - np.sin(angle) * outwards)
    place = np.cos(angle) * outwards + np.sin(angle) * tangent
    return placed(place, carried, stars.parallax_mas, stars.radial_velocity_km_per_s, stars)


def difference(there, back, middle):
    """(n, 6) there - back in the axes of ``middle``."""
    place = offset_mas(middle, there) - offset_mas(middle, back)
    pm = np.einsum("nkx,nx->nk", triad(middle)[:, :2], pm_vectors(there) - pm_vectors(back))
    rest = values_of(there)[:, [2, 5]] - values_of(back)[:, [2, 5]]
    return np.column_stack([place, rest[:, 0], pm, rest[:, 1]])


@pytest.mark.slow
def test_covariance_agrees_with_random_draws():
    rng = np.random.default_rng(2)
    star = random_stars(rng, 1, sigma_scale=5.0)
    draws = rng.multivariate_normal(np.zeros(6), star.covariance[0], 200_000)
    values = values_of(star) + draws / [3.6e6 * np.cos(np.radians(star.dec_deg[0])), 3.6e6, 1, 1, 1, 1]
    ends = propagate(astrometry_of(values, np.ones((200_000, 6)), missing=EXACT), 2096.0)
    end = propagate(star, 2096.0)
    middle = dataclasses.replace(ends, ra_deg=np.full(200_000, end.ra_deg), dec_deg=np.full(200_000, end.dec_deg))
    sample = np.column_stack([offset_mas(middle, ends), values_of(ends)[:, 2:]])
    scale = np.sqrt(np.diag(end.covariance[0]))
    assert np.abs((np.cov(sample.T) - end.covariance[0]) / np.outer(scale, scale)).max() < 0.02


# --- invariances


def test_zero_time_changes_nothing():
    stars = random_stars(np.random.default_rng(3), 200)
    same = propagate(stars, 2016.0)
    assert np.abs(offset_mas(stars, same)).max() < 1e-7
    assert np.allclose(values_of(same)[:, 2:], values_of(stars)[:, 2:], rtol=1e-13)
    assert np.allclose(same.covariance[:, :5, :5], stars.covariance[:, :5, :5], rtol=1e-12, atol=1e-12)
    assert np.allclose(same.covariance, stars.covariance, rtol=1e-9, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), years=st.floats(-150, 150))
@example(seed=2538, years=115.0)
def test_propagation_there_and_back_is_the_identity(seed, years):
    # The second-order term is added both ways. Its share of a covariance is proportional to the squared errors: over
    # 150 years up to 1e-3 for errors of a thousandth of random_stars', 1e-7 for these.
    stars = random_stars(np.random.default_rng(seed), 20, sigma_scale=1e-5)
    back = propagate(propagate(stars, 2016.0 + years), stars.epoch_jyr)
    assert np.abs(offset_mas(stars, back)).max() < 1e-6
    assert np.allclose(values_of(back)[:, 2:], values_of(stars)[:, 2:], rtol=1e-9, atol=1e-9)
    scale = np.sqrt(np.einsum("nii->ni", stars.covariance))
    change = np.abs(back.covariance - stars.covariance)
    assert (change < 1e-6 * scale[:, :, None] * scale[:, None, :]).all()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), years=st.floats(-100, 100))
def test_a_rotated_sky_gives_the_same(seed, years):
    """Propagation commutes with rotations of the sky, also over a pole."""
    rng = np.random.default_rng(seed)
    stars = random_stars(rng, 20)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    turn = np.concatenate([np.repeat(turn[None], 19, 0), [to_pole(stars, years)]])
    turned = propagate(turned_sky(stars, turn), 2016.0 + years)
    expected = turned_sky(propagate(stars, 2016.0 + years), turn)
    assert np.abs(offset_mas(expected, turned)).max() < 1e-6
    # East is arbitrary at the pole itself; compare vectors.
    scale = np.sqrt(np.einsum("nii->ni", as_vectors(expected)))[:, :, None]
    assert (np.abs(as_vectors(turned) - as_vectors(expected)) <= 1e-6 * scale * scale.swapaxes(1, 2) + 1e-9).all()


def to_pole(stars, years):
    """A rotation that puts the last star, after its motion, within 0.1 mas of the pole."""
    outwards = triad(propagate(stars, 2016.0 + years))[-1, 2]
    rows = np.linalg.svd(outwards[None] + [0, 1e-10, 0])[2][[1, 2, 0]]
    rows[2] *= np.sign(rows[2] @ outwards)
    rows[0] *= np.sign(np.linalg.det(rows))
    return rows


def turned_sky(stars, turn):
    axes = triad(stars)
    place, pm = (np.einsum("nxy,ny->nx", turn, v) for v in (axes[:, 2], pm_vectors(stars)))
    result = placed(place, pm, stars.parallax_mas, stars.radial_velocity_km_per_s, stars)
    change = np.einsum("nkx,nxy,nly->nkl", triad(result)[:, :2], turn, axes[:, :2])
    jacobian = np.repeat(np.eye(6)[None], len(stars), 0)
    jacobian[:, :2, :2] = jacobian[:, 3:5, 3:5] = change
    return dataclasses.replace(result, packed=jacobian @ stars.covariance @ jacobian.swapaxes(1, 2))


def as_vectors(stars):
    """(n, 8, 8) covariances with position and proper motion as vectors in space."""
    tangents = triad(stars)[:, :2].swapaxes(1, 2)
    jacobian = np.zeros((len(stars), 8, 6))
    jacobian[:, 0:3, 0:2] = jacobian[:, 4:7, 3:5] = tangents
    jacobian[:, 3, 2] = jacobian[:, 7, 5] = 1.0
    return jacobian @ stars.covariance @ jacobian.swapaxes(1, 2)


# --- missing values and refusals


def test_the_error_from_missing_proper_motion_grows_with_time():
    star = Astrometry.of([10.0], [60.0], epoch_jyr=2016.0, sigma=[[0.3, 0.4]], missing=MissingMotion(7.0))
    for year in (2016.0, 2026.0, 1951.9):
        position = position_at(star, year)
        spread = (7.0 * (year - 2016.0)) ** 2
        assert np.allclose(position.covariance_arcsec2[0], np.diag([0.09 + spread, 0.16 + spread]) * 1e-6)
        assert np.allclose([position.ra_deg[0], position.dec_deg[0]], [10.0, 60.0], rtol=1e-14)


def test_missing_radial_velocity_matters_for_near_stars_only():
    sigma = np.full((1, 6), 1e-3)
    near = Astrometry.of([269.45], [4.69], epoch_jyr=2016.0, sigma=sigma, **BARNARD)
    hundredth: dict[str, Any] = {name: [value[0] / 100] for name, value in BARNARD.items()}
    far = Astrometry.of([269.45], [4.69], epoch_jyr=2016.0, sigma=sigma, **hundredth)
    # ∂(position)/∂v = μ t² π / A, for σ = 50 km/s over 50 years
    expected = 10393.35 * 50**2 * 547.45 * MAS / motion.AU_KM_PER_S_YR * 50 * 1e-3
    spread = [position_at(star, 2066.0).covariance_arcsec2[0, 1, 1] ** 0.5 for star in (near, far)]
    assert spread[0] == pytest.approx(expected, rel=0.02)
    assert spread[1] < 2e-4 * expected


def test_each_missing_component_is_filled_separately():
    masked = np.ma.masked_array([3.0, 3.0], [False, True])
    stars = Astrometry.of(
        [1.0, 2.0],
        [1.0, 2.0],
        epoch_jyr=[2000.0, 2016.0],
        sigma=[[1, 1, 1, np.nan, 0.5]] * 2,
        correlation=np.full((2, 5, 5), 0.5),
        parallax_mas=masked,
        pm_ra_mas_per_yr=[20.0, 20.0],
        pm_dec_mas_per_yr=[np.nan, -5.0],
        missing=MissingMotion(10.0, 2.0, 40.0),
    )
    assert stars.parallax_mas.tolist() == [3.0, 0.0]
    assert stars.pm_ra_mas_per_yr.tolist() == [20.0, 20.0]  # a value without an error is kept
    assert stars.pm_dec_mas_per_yr.tolist() == [0.0, -5.0]
    sigma = np.sqrt(np.einsum("nii->ni", stars.covariance))
    assert sigma.tolist() == [[1, 1, 1, 10, 10, 40], [1, 1, 2, 10, 0.5, 40]]
    assert stars.covariance[0, 0].tolist() == [1, 0.5, 0.5, 0, 0, 0]
    assert stars.covariance[1, 0].tolist() == [1, 0.5, 0, 0, 0.25, 0]


def test_rows_without_position_or_error_are_nan_and_affect_no_others():
    sigma = [[1.0, 1.0], [np.nan, 1.0], [1.0, 1.0]]
    stars = Astrometry.of([1.0, 2.0, np.inf], [1.0, 2.0, 3.0], epoch_jyr=2000.0, sigma=sigma)
    ra, dec, covariance = position_at(stars, 2016.0)
    assert np.isnan(ra).tolist() == [False, False, True]
    assert np.isfinite(dec[:2]).all()
    assert np.isnan(covariance).any(axis=(1, 2)).tolist() == [False, True, False]
    assert np.isfinite(values_of(propagate(stars, 2016.0))[:2]).all()


def test_without_parallax_the_radial_velocity_is_unchanged():
    star = astrometry_of([[10, 20, 0, 500, -300, 35]], np.ones((1, 6)))
    end = propagate(star, 2116.0)
    assert end.radial_velocity_km_per_s[0] == 35
    assert end.covariance[0, 5, 5] == pytest.approx(1.0)
    assert np.isfinite(end.covariance).all()


def test_positions_alone_agree_with_the_full_propagation_for_any_chunk_size():
    stars = random_stars(np.random.default_rng(4), motion.CHUNK + 3)
    end = propagate(stars, 1991.25)
    ra, dec, covariance = position_at(stars, 1991.25)
    assert (ra == end.ra_deg).all() and (dec == end.dec_deg).all()
    assert np.allclose(covariance, end.covariance[:, :2, :2] * 1e-6, rtol=1e-12)
    alone = position_at(stars[-2:], 1991.25)
    assert (alone.ra_deg == ra[-2:]).all()
    assert np.allclose(alone.covariance_arcsec2, covariance[-2:], rtol=1e-12)
    assert len(position_at(stars[:0], 1991.25).ra_deg) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dec_deg": [0.0, 91.0]}, "hip: declinations beyond ±90° in 1 row (first: row 1); give degrees"),
        ({"epoch_jyr": 57388.0}, "not Julian years in 2 rows (first: row 0); give e.g. 2016.0"),
        ({"epoch_jyr": [2016.0, np.nan]}, "not Julian years in 1 row (first: row 1)"),
        ({"sigma": [[1.0, 1.0], [1.0, -1.0]]}, "hip: negative errors in 1 row (first: row 1)"),
        ({"sigma": [1.0, 1.0]}, "sigma has shape (2,); give (2, 2) up to (2, 6)"),
        ({"parallax_mas": [1.0]}, "hip: parallax_mas: shape (1,); give (2,)"),
        ({"pm_ra_mas_per_yr": ["a", "b"]}, "hip: pm_ra_mas_per_yr: not numbers"),
        ({"correlation": np.full((2, 2, 2), 1.5)}, "correlations beyond ±1 in 2 rows"),
        ({"correlation": np.triu(np.full((2, 2, 2), 0.5))}, "correlations that are not symmetric in 2 rows"),
        ({"correlation": np.ones((2, 7, 7))}, "correlations: shape (2, 7, 7); give (2, 6, 6)"),
    ],
)
def test_refused_with_the_row_and_the_remedy(change, words):
    taken = {"ra_deg": [0.0, 1.0], "dec_deg": [0.0, 1.0], "epoch_jyr": 2016.0, "sigma": np.ones((2, 2))}
    with pytest.raises(InputError) as error:
        Astrometry.of(**{**taken, **change}, source="hip")
    assert words in str(error.value)


def test_invalid_missing_motions_and_epochs_are_refused():
    with pytest.raises(InputError, match="pm_sigma_mas_per_yr is -1"):
        MissingMotion(pm_sigma_mas_per_yr=-1)
    star = Astrometry.of([0.0], [0.0], epoch_jyr=2016.0, sigma=[[1.0, 1.0]])
    with pytest.raises(InputError, match="position_at: epochs that are not Julian years"):
        position_at(star, 2457206.0)


def test_examples_run():
    assert doctest.testmod(motion).failed == 0


def test_at_their_own_epochs_positions_are_unchanged():
    stars = Astrometry.of(
        [10.0, 359.9], [20.0, -89.0], epoch_jyr=[2000.0, 2016.0], sigma=[[50.0, 40.0], [3.0, 4.0]],
        pm_ra_mas_per_yr=[100.0, np.nan], pm_dec_mas_per_yr=[5.0, np.nan],
    )  # fmt: skip
    here = position_at(stars, stars.epoch_jyr)
    assert here.ra_deg.tolist() == stars.ra_deg.tolist() and here.dec_deg.tolist() == stars.dec_deg.tolist()
    np.testing.assert_allclose(here.covariance_arcsec2, 1e-6 * stars.covariance[:, :2, :2], rtol=1e-15)
    near = position_at(stars, stars.epoch_jyr + 1e-9)
    np.testing.assert_allclose(near.covariance_arcsec2, here.covariance_arcsec2, rtol=1e-9, atol=1e-12)


def test_without_correlations_only_variances_are_kept():
    plain = Astrometry.of([10.0, 20.0], [0.0, 1.0], epoch_jyr=2000.0, sigma=[[3.0, 4.0], [5.0, 6.0]])
    full = Astrometry.of(
        [10.0, 20.0], [0.0, 1.0], epoch_jyr=2000.0, sigma=[[3.0, 4.0], [5.0, 6.0]], correlation=np.zeros((2, 2, 2))
    )
    assert isinstance(plain.packed, Variances)
    assert isinstance(full.packed, np.ndarray) and full.packed.shape == (2, 6, 6)
    np.testing.assert_array_equal(plain.covariance, full.covariance)
    np.testing.assert_array_equal(plain.position_covariance, full.position_covariance)
    np.testing.assert_array_equal(plain.variance(4), full.variance(4))
    one, other = (position_at(stars, 2010.0).covariance_arcsec2 for stars in (plain, full))
    np.testing.assert_allclose(one, other, rtol=1e-14)
