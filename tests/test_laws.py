"""Invariances of `identify`: order of the sources and rows, shifts, units, a wider gate."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from problems import by_id, plane_records, shuffled, sky_records
from sameas import (
    ChiSquare,
    CloseObjects,
    CommonObjects,
    ConstantCost,
    Field,
    PerPair,
    PoissonField,
    Radius,
    Records,
    identify,
)
from sameas.simulate.scenes import crowded_sky, poisson_field

quickly = settings(max_examples=25, deadline=None, derandomize=True)
seeds = st.integers(0, 10**6)

# Every rule in d features, for feature values multiplied by ``unit``.
RULES = {
    "field": lambda d, unit: Field(0.5 / unit**d),
    "poisson": lambda d, unit: PoissonField(2.0 / unit**d, 3.0 / unit**d, 1.0 / unit**d),
    "constant": lambda d, unit: ConstantCost(1.5 / unit ** (d / 2)),
    "close": lambda d, unit: CloseObjects(0.05 * unit, 0.6 * unit),
    "close surface": lambda d, unit: CloseObjects(0.2 * unit),
}
SWAPPED = {"poisson": PoissonField(2.0, 1.0, 3.0)}
PRIORS: dict[str, tuple[PerPair | CommonObjects, PerPair | CommonObjects]] = {
    "per pair": (PerPair(-0.2), PerPair(-0.2)),
    "common": (CommonObjects(0.1, 0.3), CommonObjects(0.3, 0.1)),
    "linear": (CommonObjects(0.1, 0.3, linear=True), CommonObjects(0.3, 0.1, linear=True)),
}
every_rule_and_prior = pytest.mark.parametrize("rule, prior", [(r, p) for r in RULES for p in PRIORS])


def scene(seed, d=2):
    rng = np.random.default_rng(seed)
    n = rng.integers(0, 14, 2)
    kind = rng.choice(["one sigma", "axis sigmas", "full"], 2)
    return [plane_records(rng, n[k], d, scale=0.05, kind=kind[k], source=("a", "b")[k]) for k in range(2)]


def by_ids(answer, turned=False):
    """The result by ids: {(id of 1, id of 2): (p, chosen)}."""
    ids = [(b, a) if turned else (a, b) for a, b in by_id(answer.pairs)]
    return dict(zip(ids, zip(answer.p_pair.tolist(), answer.chosen.tolist(), strict=True), strict=True))


def same(one, two, tolerance=1e-9):
    assert one.keys() == two.keys()
    for key in one:
        assert one[key][0] == pytest.approx(two[key][0], abs=tolerance)
        assert one[key][1] == two[key][1]


@pytest.mark.slow_after(3)
@every_rule_and_prior
@quickly
@given(seed=seeds)
def test_swapping_the_sources_transposes_the_answer(rule, prior, seed):
    first, second = scene(seed)
    rules = RULES[rule](2, 1.0), SWAPPED.get(rule, RULES[rule](2, 1.0))
    straight = identify(first, second, rule=rules[0], prior=PRIORS[prior][0])
    swapped = identify(second, first, rule=rules[1], prior=PRIORS[prior][1])
    same(by_ids(straight), by_ids(swapped, turned=True))


@pytest.mark.slow_after(3)
@every_rule_and_prior
@quickly
@given(seed=seeds)
def test_shuffling_rows_changes_nothing(rule, prior, seed):
    first, second = scene(seed)
    rng = np.random.default_rng(seed)
    method: dict[str, Any] = {"rule": RULES[rule](2, 1.0), "prior": PRIORS[prior][0]}
    other = identify(shuffled(rng, first), shuffled(rng, second), **method)
    straight = identify(first, second, **method)
    assert by_id(straight.pairs) == by_id(other.pairs)
    same(by_ids(straight), by_ids(other), tolerance=0)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("prior", PRIORS)
@quickly
@given(seed=seeds)
def test_ties_are_broken_independently_of_the_row_order(prior, seed):
    rng = np.random.default_rng(seed)
    sides = []
    for n in rng.integers(2, 9, 2):
        sides.append(Records.of(rng.integers(0, 2, (n, 2)) * 1.0, sigma=0.7, ids=rng.permutation(n)))
    method: dict[str, Any] = {"rule": Field(0.01), "prior": PRIORS[prior][0], "gate": Radius(3.0)}
    straight = identify(*sides, **method)
    for _ in range(3):
        same(by_ids(straight), by_ids(identify(*(shuffled(rng, side) for side in sides), **method)), tolerance=0)


@pytest.mark.slow_after(2)
@every_rule_and_prior
@quickly
@given(seed=seeds, shift=st.floats(-5, 5), power=st.integers(-6, 6))
def test_shifting_and_rescaling_change_nothing(rule, prior, seed, shift, power):
    first, second = scene(seed)
    unit = 10.0**power
    moved = [
        Records((r.features + shift) * unit, r.covariance * unit**2, r.rows, r.ids, r.space, r.source)
        for r in (first, second)
    ]
    straight = identify(first, second, rule=RULES[rule](2, 1.0), prior=PRIORS[prior][0])
    other = identify(*moved, rule=RULES[rule](2, unit), prior=PRIORS[prior][0])
    same(by_ids(straight), by_ids(other), tolerance=1e-7)


@pytest.mark.slow_after(3)
@every_rule_and_prior
@quickly
@given(seed=seeds)
def test_probabilities_of_a_record_sum_to_one(rule, prior, seed):
    answer = identify(*scene(seed), rule=RULES[rule](2, 1.0), prior=PRIORS[prior][0])
    for answers, position in ((answer.answers_1, answer.pairs.i), (answer.answers_2, answer.pairs.j)):
        total = answers.p_none.filled(np.nan) + np.bincount(position, answer.p_pair, len(answers.p_none))
        np.testing.assert_allclose(total, 1.0, rtol=0, atol=1e-12)
    assert np.all((answer.p_pair >= 0) & (answer.p_pair <= 1))


@pytest.mark.slow
@pytest.mark.parametrize("lon_shift", [17.0, 180.0, 359.0])
def test_rotating_the_sky_about_its_axis_changes_nothing(lon_shift):
    rng = np.random.default_rng(int(lon_shift))
    records = [
        sky_records(rng, rng.uniform(0, 0.02, 25), rng.uniform(70, 70.01, 25), scale_arcsec=1.5, kind="full")
        for _ in range(2)
    ]
    turned = [
        Records((r.features + np.array([lon_shift, 0.0])) % 360.0, r.covariance, r.rows, r.ids, r.space)
        for r in records
    ]
    for prior, _ in PRIORS.values():
        answers = [identify(*pair, rule=Field(1e-3), prior=prior) for pair in (records, turned)]
        same(by_ids(answers[0]), by_ids(answers[1]), tolerance=1e-6)


def probabilities_by_gate(first, second, rule, gates):
    """For each gate {(row of 1, row of 2): p}."""
    answers = [identify(first, second, rule=rule, gate=gate) for gate in gates]
    return [dict(zip(zip(a.rows_1.tolist(), a.rows_2.tolist(), strict=True), a.p_pair, strict=True)) for a in answers]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("lam", [0.5, 1.0])
def test_a_wider_gate_than_the_default_changes_no_probability_noticeably(seed, lam):
    rng = np.random.default_rng([seed, int(10 * lam)])
    if seed < 2:
        simulated = crowded_sky(rng, 1000, lam, elliptical=seed == 1)
        area = 1000 * 2 * 9 * math.pi * (0.5**2 - 0.05**2) / (2 * math.log(10)) / lam
        common, only = 889 / area, 111 / area
    else:
        simulated = poisson_field(
            rng, density=1.0, extent=(30.0, 30.0), q1=0.1, q2=0.1, sigma_1=0.1 * lam, sigma_2=0.1 * lam
        )
        common, only = 0.81, 0.09
    default, wide = probabilities_by_gate(
        simulated.first, simulated.second, PoissonField(common, only, only), (ChiSquare(), Radius(10.0))
    )
    assert len(wide) > 1.5 * len(default)
    assert max(abs(p - default.get(edge, 0.0)) for edge, p in wide.items()) < 1e-3
