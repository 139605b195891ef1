"""Calibration of every rule and prior: if the truth follows the model, is the stated probability the frequency?"""

import math

import numpy as np
import pytest

from sameas import CloseObjects, CommonObjects, ConstantCost, Field, PerPair, PoissonField, Radius, Records, identify
from sameas.evidence import DetectionField, Errors
from sameas.score.pairs import is_true_pair, reliability, score_probabilities
from sameas.simulate.scenes import Cap, poisson_field, sky_field
from sameas.space import Plane

EVENTS = 20_000


def assert_calibrated(p, happened):
    """Assert an expected calibration error below 0.01 and no bin off by more than chance and clustering allow."""
    p, happened = np.concatenate(p), np.concatenate(happened)
    assert len(p) >= EVENTS
    assert np.mean((p > 0.05) & (p < 0.95)) > 0.02, "the scenes are too easy to judge anything"
    assert score_probabilities(p, happened).expected_calibration_error <= 0.01
    table = reliability(p, happened)
    enough = table.count > 100
    assert np.abs(table.deviation[enough]).max() < 4.5
    # The check itself must detect overconfident probabilities.
    sure = 1 / (1 + np.exp(-2 * np.log(np.clip(p, 1e-12, 1 - 1e-12) / (1 - np.clip(p, 1e-12, 1 - 1e-12)))))
    assert np.abs(reliability(sure, happened).deviation).max() > 4.5


def total(parts):
    return sum(map(len, parts))


def events(answer, scene):
    return answer.p_pair, is_true_pair((answer.rows_1, answer.rows_2), scene.true_pairs())


# ---- objects in a Poisson field, all densities known ----

DENSITY, Q1, Q2, FALSE_1, FALSE_2 = 1.0, 0.25, 0.15, 0.1, 0.05
COMMON = DENSITY * (1 - Q1) * (1 - Q2)
ONLY_1 = DENSITY * (1 - Q1) * Q2 + FALSE_1
ONLY_2 = DENSITY * Q1 * (1 - Q2) + FALSE_2

PLANE_RULES = {
    "poisson field": (PoissonField(COMMON, ONLY_1, ONLY_2), PerPair()),
    "field with prior odds": (Field(0.01), PerPair(math.log(COMMON * 0.01 / (ONLY_1 * ONLY_2)))),
    "constant cost": (ConstantCost(math.sqrt(ONLY_1 * ONLY_2 / COMMON)), PerPair()),
}


def plane_scene(rng, sigma, d=2, **changes):
    sides = {1: (400.0,), 2: (35.0, 35.0), 3: (11.0, 11.0, 11.0)}[d]
    given = {"density": DENSITY, "q1": Q1, "q2": Q2, "false_1": FALSE_1, "false_2": FALSE_2} | changes
    return poisson_field(rng, extent=sides, sigma_1=sigma, sigma_2=sigma, space=Plane(sides), **given)


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANE_RULES)
def test_rules_of_known_densities_are_calibrated(name):
    rule, prior = PLANE_RULES[name]
    rng = np.random.default_rng(1)
    p, happened = [], []
    while total(p) < EVENTS:
        scene = plane_scene(rng, (0.05, 0.25), correlated=name == "poisson field")
        one = events(identify(scene.first, scene.second, rule=rule, prior=prior), scene)
        p.append(one[0])
        happened.append(one[1])
    assert_calibrated(p, happened)


@pytest.mark.parametrize("d", [1, 3])
def test_the_poisson_field_is_calibrated_in_other_dimensions(d):
    rng = np.random.default_rng(d)
    p, happened = [], []
    while total(p) < EVENTS:
        scene = plane_scene(rng, 0.03 if d == 1 else 0.15, d)
        one = events(identify(scene.first, scene.second, rule=PoissonField(COMMON, ONLY_1, ONLY_2)), scene)
        p.append(one[0])
        happened.append(one[1])
    assert_calibrated(p, happened)


def test_detection_probabilities_of_every_record_are_calibrated():
    rng = np.random.default_rng(2)
    p, happened = [], []
    while total(p) < EVENTS:
        # Source 1 detects bright objects with 0.9 and faint ones with 0.4; source 2 contains all objects.
        side, n = 35.0, rng.poisson(35.0**2)
        place, bright = rng.uniform(0, side, (n, 2)), rng.uniform(size=n) < 0.5
        shown = np.flatnonzero(rng.uniform(size=n) < np.where(bright, 0.9, 0.4))
        false = rng.uniform(0, side, (rng.poisson(0.3 * side**2), 2))
        measured = np.concatenate([place[shown], false])
        space = Plane((side, side))
        first = Records.of((measured + rng.normal(0, 0.15, measured.shape)) % side, sigma=0.15, space=space)
        second = Records.of((place + rng.normal(0, 0.1, place.shape)) % side, sigma=0.1, space=space)
        answer = identify(first, second, rule=DetectionField(np.where(bright, 0.9, 0.4), 0.3))
        p.append(answer.p_pair)
        happened.append(is_true_pair((answer.rows_1, answer.rows_2), (np.arange(len(shown)), shown)))
    assert_calibrated(p, happened)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(
    "errors, scale_of",
    [
        (Errors(scales=(1.5,), shares=(1.0,)), lambda rng, n: np.full(n, 1.5)),
        (Errors(scales=(1.0, 4.0), shares=(0.8, 0.2)), lambda rng, n: np.where(rng.uniform(size=n) < 0.2, 4.0, 1.0)),
    ],
)
def test_errors_larger_than_quoted_are_calibrated_with_an_errors_mixture(errors, scale_of):
    rng = np.random.default_rng(3)
    p, happened = [], []
    while total(p) < EVENTS:
        side, n = 35.0, 1200
        place, scale = rng.uniform(0, side, (n, 2)), scale_of(rng, n)
        seen = [np.flatnonzero(rng.uniform(size=n) < 0.8) for _ in range(2)]
        records = [
            Records.of(
                (place[s] + rng.normal(0, 0.1, (len(s), 2)) * scale[s, None]) % side, sigma=0.1,
                space=Plane((side, side)),
            )
            for s in seen
        ]  # fmt: skip
        density = n / side**2
        rule = PoissonField(0.64 * density, 0.16 * density, 0.16 * density, errors)
        answer = identify(*records, rule=rule, gate=Radius(12.0))
        both = np.intersect1d(seen[0], seen[1])
        true = np.searchsorted(seen[0], both), np.searchsorted(seen[1], both)
        p.append(answer.p_pair)
        happened.append(is_true_pair((answer.rows_1, answer.rows_2), true))
    assert_calibrated(p, happened)


@pytest.mark.slow
@pytest.mark.parametrize("elliptical", [False, True])
@pytest.mark.parametrize("lat", [30.0, 90.0])
def test_the_sky_is_calibrated(elliptical, lat):
    rng = np.random.default_rng([int(elliptical), int(lat)])
    cap = Cap(0.0, lat, 0.02)
    area = cap.steradians() * 206264.80624709636**2
    counts = 2000, 400, 600
    p, happened = [], []
    while total(p) < EVENTS:
        scene = sky_field(
            rng, n_common=counts[0], n_only_1=counts[1], n_only_2=counts[2], sigma_arcsec=(0.2, 0.7), area=cap,
            elliptical=elliptical,
        )  # fmt: skip
        rule = PoissonField(counts[0] / area, counts[1] / area, counts[2] / area)
        one = events(identify(scene.first, scene.second, rule=rule), scene)
        p.append(one[0])
        happened.append(one[1])
    assert_calibrated(p, happened)


# ---- only the miss probabilities are known ----


@pytest.mark.slow
def test_common_objects_are_calibrated_for_a_flat_number_of_objects():
    """Objects uniform in a periodic box, a flat prior of their number, and a gate so wide that a scene is one group.

    A third feature, equal for both records of a pair, separates the scenes.
    """
    rng = np.random.default_rng(4)
    q1, q2, sigma = 0.3, 0.2, 0.07
    places, numbers, scenes = ([], []), ([], []), 0
    while scenes < 3000:
        # Scenes of at most six records come from far fewer than 26 objects.
        place = rng.uniform(0, 1, (rng.integers(0, 26), 2))
        seen = [np.flatnonzero(rng.uniform(size=len(place)) >= q) for q in (q1, q2)]
        if not all(1 <= len(s) <= 6 for s in seen):
            continue
        scenes += 1
        for side, s in enumerate(seen):
            measured = (place[s] + rng.normal(0, sigma, (len(s), 2))) % 1.0
            places[side].append(np.column_stack([measured, np.full(len(s), 1000.0 * scenes)]))
            numbers[side].append(100 * scenes + s)
    records = [Records.of(np.concatenate(p), sigma=[sigma, sigma, 1.0], space=Plane((1.0, 1.0, None))) for p in places]
    density = 1.0 / math.sqrt(2 * math.pi * 2.0)
    answer = identify(*records, rule=Field(density), prior=CommonObjects(q1, q2), gate=Radius(100.0))
    assert len(answer.groups) == scenes
    number_1, number_2 = (np.concatenate(n) for n in numbers)
    assert_calibrated([answer.p_pair], [number_1[answer.rows_1] == number_2[answer.rows_2]])


@pytest.mark.parametrize("b", [3.0, None])
@pytest.mark.parametrize("prior", ["per pair", "common objects"])
def test_close_objects_are_calibrated_if_the_other_object_is_a_neighbour(prior, b):
    """Isolated pairs of records: of one object, or of two neighbours between the boxes a and b."""
    rng = np.random.default_rng(5)
    n, a = 25_000, 0.8
    q1, q2 = 0.5, 0.6
    odds = 0.7 if prior == "per pair" else (1 - q1 * q2) / (2 * q1 * q2)
    common = rng.uniform(size=n) < odds / (1 + odds)
    neighbour = rng.uniform(-1, 1, (n, 2))
    if b is None:
        # On the surface of the box one feature is at its limit; all faces of a square are equally probable.
        face = rng.integers(0, 2, n)
        neighbour[np.arange(n), face] = rng.choice([-1.0, 1.0], n)
        neighbour *= a
    else:
        neighbour *= b
        while (inside := (np.abs(neighbour) < a).all(axis=1)).any():
            neighbour[inside] = rng.uniform(-b, b, (inside.sum(), 2))
    place = np.stack([np.arange(n) * 100.0, np.zeros(n)], axis=1)
    first = Records.of(place + rng.normal(0, 0.4, (n, 2)), sigma=0.4)
    second = Records.of(place + np.where(common[:, None], 0.0, neighbour) + rng.normal(0, 0.3, (n, 2)), sigma=0.3)
    stated_prior = PerPair(math.log(odds)) if prior == "per pair" else CommonObjects(q1, q2)
    answer = identify(first, second, rule=CloseObjects(a, b), prior=stated_prior, gate=Radius(30.0))
    assert len(answer.pairs) == n
    assert_calibrated([answer.p_pair], [common[answer.rows_1]])
