"""Which source's errors are too small, by how much, and when that cannot be told."""

import numpy as np
import pytest

from sameas import PoissonField, Radius, Records, identify
from sameas.chisquare import quantile, share_within
from sameas.error_model import CORE, _widened, error_model


def answer(seed, *, factors=(1.0, 1.0), floor=0.0, alike=False, n=1500, outliers=0.0):
    """Pairs in a wide field, with errors that are what is said of them times the factors, and a floor."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(0.0, 2000.0, (n, 2))
    quoted = [np.full(n, 0.1) if alike else 0.03 * 10 ** rng.uniform(0.0, 1.0, n) for _ in range(2)]
    sides = []
    for factor, sigma in zip(factors, quoted, strict=True):
        seen = place + factor * sigma[:, None] * rng.standard_normal((n, 2))
        sides.append(Records.of(seen, sigma=sigma[:, None]))
    moved = sides[0].features + floor * rng.standard_normal((n, 2))
    moved[: int(outliers * n)] += 1.0
    first = Records.of(moved, sigma=quoted[0][:, None])
    return identify(first, sides[1], rule=PoissonField(4e-4, 1e-6, 1e-6), gate=Radius(40.0))


@pytest.mark.parametrize("factors, floor", [((1.0, 1.0), 0.0), ((1.7, 1.0), 0.0), ((1.0, 1.5), 0.1), ((0.7, 2.0), 0.0)])
def test_factors_and_floor_are_recovered_with_their_errors(factors, floor):
    found = [error_model(answer([1, k], factors=factors, floor=floor)) for k in range(12)]
    for name, true in (("factor_1", factors[0]), ("factor_2", factors[1])):
        deviation = np.array([(getattr(m, name).value - true) / getattr(m, name).standard_error for m in found])
        assert np.abs(deviation.mean()) < 1.0 and np.mean(np.abs(deviation) < 2.0) >= 0.75, (name, deviation)
        assert all(getattr(m, name).standard_error < 0.1 * true for m in found)
    floors = np.array([m.floor.value for m in found])
    if floor:
        assert floors.mean() == pytest.approx(floor, rel=0.05)
    else:
        assert np.all(floors < 3.5 * np.array([m.floor.standard_error for m in found]))
    assert all(m.note == "" for m in found)


def test_a_floor_that_is_not_there_is_within_its_error_of_none():
    floors = [error_model(answer([6, k])).floor for k in range(40)]
    beyond = np.mean([floor.value > 1.96 * floor.standard_error for floor in floors])
    assert beyond <= 0.15 and all(floor.standard_error > 0.0 for floor in floors)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_leaving_the_tail_out_costs_as_much_as_in_simulation(d):
    limit, n, rng = quantile(CORE, d), 1000, np.random.default_rng(1)
    kept = share_within(limit, d + 2) / CORE
    found = []
    for _ in range(1000):
        squares, factor = rng.chisquare(d, n), 1.0
        for _ in range(40):
            factor = squares[squares <= factor * limit].mean() / (d * kept)
        found.append(factor)
    assert _widened(d, limit, kept) == pytest.approx(np.var(found) * 0.5 * d * CORE * n, rel=0.12)


def test_a_few_outliers_do_not_move_the_factors():
    found = error_model(answer(2, factors=(1.3, 1.0), outliers=0.02))
    assert found.factor_1.value == pytest.approx(1.3, abs=0.1) and found.factor_2.value == pytest.approx(1.0, abs=0.1)


def test_errors_that_are_all_alike_cannot_be_told_apart():
    found = error_model(answer(3, alike=True))
    assert found.factor_1 is found.factor_2 is found.floor is None and "vary too little" in found.note


def test_few_pairs_do_not_judge_the_sources_apart():
    found = error_model(answer(4, n=50))
    assert found.factor_1 is None and "fewer than 200 pairs" in found.note


def test_one_source_that_is_far_better_is_not_judged():
    rng = np.random.default_rng(5)
    place = rng.uniform(0.0, 2000.0, (1000, 2))
    first = Records.of(place + 0.1 * rng.standard_normal((1000, 2)), sigma=0.05 * 2 ** rng.uniform(0, 2, 1000)[:, None])
    second = Records.of(place, sigma=1e-4 * 2 ** rng.uniform(0, 2, 1000)[:, None])
    found = error_model(identify(first, second, rule=PoissonField(4e-4, 1e-6, 1e-6), gate=Radius(40.0)))
    assert found.factor_1 is not None and found.factor_2 is None and "judge the sources apart" in found.note
