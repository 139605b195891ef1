"""Rotations and smooth distortions between catalogues are distinguished from chance, and removed."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

import sameas
from sameas.estimate.match import match
from sameas.score.pairs import score_pairs
from sameas.simulate import LonLatBox
from sameas.simulate.scenes import Cap, WholeSky, sky_field
from sameas.sky.catalogue import Catalogue
from sameas.sky.crossmatch import MatchOptions
from sameas.sky.crossmatch import match as match_catalogues
from sameas.sky.systematics import Rotation, find_rotation
from sameas.space import displaced, sphere_offset


def scene(area, n, seed=1):
    return sky_field(
        np.random.default_rng(seed), n_common=n, n_only_1=n // 4, n_only_2=n // 4, sigma_arcsec=(0.2, 0.5), area=area
    )


def turned(records, centre, vector):
    """The records rotated so that ``vector`` rotates them back."""
    away = Rotation(centre, -np.array(vector), np.zeros((3, 3)))
    return replace(records, features=away.moved(records.features))


def left(found, moved, truth):
    """(n,) arcsec between corrected and true positions."""
    at = found.moved(moved.features)
    return np.hypot(*sphere_offset(at[:, 0], at[:, 1], truth.features[:, 0], truth.features[:, 1]).T)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(
    ("area", "n", "vector"),
    [
        (Cap(40.0, 60.0, 0.5), 1500, (8.0, -5.0, 60.0)),
        (Cap(40.0, 89.9, 0.5), 1500, (8.0, -5.0, 60.0)),
        (Cap(1.0, -30.0, 0.05), 60, (3.0, 2.0, 0.0)),
        (WholeSky(), 20000, (2.0, 1.0, 3.0)),
    ],
    ids=["field", "pole", "small", "sky"],
)
def test_the_rotation_is_found_within_its_errors(area, n, vector):
    made = scene(area, n)
    centre = (area.lon_deg, area.lat_deg) if isinstance(area, Cap) else (10.0, 20.0)
    moved = turned(made.second, centre, vector)
    found = find_rotation(made.first, moved)
    assert found.established and not found.notes
    # The remaining residuals agree with the covariance of the rotation.
    back = found.of(moved)
    more = np.einsum("nvv->n", back.full_covariance() - made.second.full_covariance())
    assert np.max(left(found, moved, made.second) / np.sqrt(more)) < 4.0
    answer, _ = match(made.first, back)
    unturned, _ = match(made.first, made.second)
    f1 = [score_pairs((a.matches.rows_1, a.matches.rows_2), made.true_pairs()).f1 for a in (answer, unturned)]
    assert f1[0] > f1[1] - 0.02


@pytest.mark.slow
@pytest.mark.long
def test_standard_errors_are_those_of_repeated_trials():
    area, vector = Cap(200.0, 30.0, 0.3), np.array([4.0, -3.0, 0.0])
    pulls = []
    for seed in range(25):
        made = scene(area, 200, seed)
        found = find_rotation(made.first, turned(made.second, (200.0, 30.0), vector))
        there = Rotation((200.0, 30.0), vector, np.zeros((3, 3)))
        at = np.array([[200.0, 30.0]])
        gap = sphere_offset(*found.moved(at).T, *there.moved(at).T)[0]
        pulls.append(gap / found.standard_errors[:2])
    assert 0.75 < np.sqrt(np.mean(np.square(pulls))) < 1.35


def test_a_rotation_is_shown_with_the_digits_of_its_errors():
    rotation = Rotation((11.8, 85.2), np.array([-1.054e-4, -0.02352, 2.944]), np.diag([0.0015, 0.0015, 0.28]) ** 2)
    shift = "-0.0001 ± 0.0015 arcsec east, -0.0235 ± 0.0015 north"
    assert str(rotation) == f"{shift}, rotated by +2.94 ± 0.28 arcsec about RA 11.800°, Dec +85.200°"


@pytest.mark.slow
def test_unrelated_catalogues_are_reported():
    one, two = scene(Cap(10.0, 0.0, 0.3), 40, 1), scene(Cap(10.0, 0.0, 0.3), 40, 2)
    found = find_rotation(one.first, two.second)
    assert not found.established
    assert any("nothing in common" in note or "explain" in note for note in found.notes)


@pytest.mark.parametrize("n", [1, 40])
def test_an_insignificant_offset_is_not_removed(n):
    one, two = scene(Cap(10.0, 0.0, 0.3), n, 1), scene(Cap(10.0, 0.0, 0.3), n, 2)
    found = match_catalogues(catalogue(one.first, "a"), catalogue(two.second, "b"), MatchOptions(offset="find"))
    assert found.rotation is None and "no offset was removed" in found.doubts
    assert not any("unit" in doubt or "offset=" in doubt for doubt in found.doubts)


def test_catalogues_of_disjoint_fields_are_reported():
    one, two = scene(Cap(10.0, 0.0, 0.3), 40, 1), scene(Cap(90.0, 0.0, 0.3), 40, 2)
    found = match_catalogues(catalogue(one.first, "a"), catalogue(two.second, "b"), MatchOptions(offset="find"))
    assert found.rotation is None and len(found.result.matches) == 0
    assert any("apart" in doubt for doubt in found.doubts)


def test_zero_rotation_changes_nothing():
    made = scene(Cap(10.0, -80.0, 0.3), 50)
    still = Rotation((10.0, -80.0), np.zeros(3), np.zeros((3, 3)))
    np.testing.assert_array_equal(still.moved(made.second.features), made.second.features)


def catalogue(records, name):
    ra, dec = records.features.T
    return Catalogue.of(Table({"ra": ra, "dec": dec, "sigma_arcsec": np.sqrt(records.covariance[:, 0])}), name)


@pytest.mark.slow
@pytest.mark.parametrize("vector", [(0.15, -0.1, 0.0), (8.0, -5.0, 0.0)], ids=["part of an error", "many errors"])
def test_offset_catalogues_raise_a_doubt_and_are_aligned(vector):
    made = scene(Cap(40.0, 60.0, 0.4), 1500)
    first, second = catalogue(made.first, "a"), catalogue(turned(made.second, (40.0, 60.0), vector), "b")
    unrotated = match_catalogues(first, second)
    assert any("offset='find'" in doubt for doubt in unrotated.doubts) and unrotated.rotation is None
    found = match_catalogues(first, second, MatchOptions(offset="find"))
    assert found.rotation is not None and not any("offset=" in doubt for doubt in found.doubts)
    assert np.abs(found.rotation.vector[:2] - vector[:2]).max() < 0.1
    assert len(found.result.matches) > 0.98 * 1500
    still = match_catalogues(first, catalogue(made.second, "b"))
    assert not any("offset=" in doubt for doubt in still.doubts)


def test_an_offset_of_many_errors_is_stated_in_digits(monkeypatch):
    """It was 1e+01."""
    made = scene(Cap(40.0, 60.0, 0.4), 300)
    rotation = Rotation((40.0, 60.0), np.ones(3), np.eye(3))
    monkeypatch.setattr("sameas.sky.match_doubts.residual_rotation", lambda *arguments: (rotation, 12.3))
    found = match_catalogues(catalogue(made.first, "a"), catalogue(made.second, "b"))
    assert any("b is offset from a by up to 12 of a pair's error" in doubt for doubt in found.doubts)


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
