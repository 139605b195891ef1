"""A smooth distortion between two catalogues is found, distinguished from shift, rotation and chance, and removed."""

import numpy as np
import pytest

import sameas
from sameas.simulate import LonLatBox
from sameas.simulate.scenes import sky_field
from sameas.space import displaced


def field(seed, bend_arcsec, *, shift=(0.0, 0.0), turn_deg=0.0, n=1500, sigma=0.1):
    """Two tables of a field of a degree; the second bent by up to about ``bend_arcsec``, and what is true."""
    rng = np.random.default_rng(seed)
    side = 1.0
    scene = sky_field(
        rng, n_common=n, n_only_1=n // 5, n_only_2=n // 5, sigma_arcsec=sigma,
        area=LonLatBox((150.0, 150.0 + side / np.cos(np.radians(2.0))), (2.0, 2.0 + side)),
    )  # fmt: skip
    place = scene.second.features
    u, v = 2.0 * (place - place.min(axis=0)).T / np.ptp(place, axis=0)[:, None] - 1.0
    bent = bend_arcsec * np.column_stack([u * u - v * v * u, np.sin(1.5 * u + v) * v])
    turned = np.radians(turn_deg) * 1800.0 * np.column_stack([-v, u])
    moved = displaced(place, bent + np.asarray(shift) + turned)
    tables = [
        {"ra": at[:, 0], "dec": at[:, 1], "pos_err": np.full(len(at), sigma)} for at in (scene.first.features, moved)
    ]
    return tables, scene


def wrong_and_found(match, scene):
    from sameas.score.pairs import is_true_pair

    found = match.identification.matches
    right = is_true_pair((found.rows_1, found.rows_2), scene.true_pairs())
    return int((~right).sum()), int(right.sum())


@pytest.mark.slow
def test_a_warp_is_found_and_removed():
    tables, scene = field(1, 0.3)
    match = sameas.match(*tables, sigma_unit="arcsec", offset="find")
    warp = match.sky.warp
    assert warp is not None and 2 <= warp.order <= 6
    wrong, found = wrong_and_found(match, scene)
    assert wrong <= 3 and found > 0.995 * len(scene.true_pairs()[0])
    residual = match.identification.matches.residual
    assert np.all(np.std(residual, axis=0) < 1.1 * 0.1 * np.sqrt(2.0))
    assert "smooth warp of order" in str(match.report())


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("seed", range(4))
def test_without_a_warp_none_is_found(seed):
    tables, _ = field([2, seed], 0.0, n=300)
    assert sameas.match(*tables, sigma_unit="arcsec", offset="find").sky.warp is None


@pytest.mark.slow
def test_a_shift_and_a_rotation_are_no_warp():
    tables, _ = field(3, 0.0, shift=(2.0, -1.0), turn_deg=0.01)
    match = sameas.match(*tables, sigma_unit="arcsec", offset="find")
    assert match.sky.rotation is not None and match.sky.warp is None


@pytest.mark.slow
def test_a_warp_is_found_together_with_a_shift():
    tables, scene = field(4, 0.3, shift=(3.0, 2.0))
    match = sameas.match(*tables, sigma_unit="arcsec", offset="find")
    assert match.sky.rotation is not None and match.sky.warp is not None
    assert wrong_and_found(match, scene)[1] > 0.99 * len(scene.true_pairs()[0])
