"""The factor of each source's errors and a common floor, and when they cannot be separated."""

import numpy as np
import pytest

from sameas import Records
from sameas.estimate.error_model import ErrorModel, error_model
from sameas.estimate.match import match
from sameas.estimate.quantity import Quantity


def answer(seed, *, factors=(1.0, 1.0), floor=0.0, alike=(False, False), size_2=1.0, n=1500, displaced=0.0):
    """Pairs in a sparse field; true errors are the quoted ones times the factors, plus a floor.

    alike : whether a source quotes one error for all records. size_2 : quoted errors of source 2 / source 1.
    displaced : share of the first source's records that are off by 10 σ.
    """
    rng = np.random.default_rng(seed)
    place = rng.uniform(0.0, 2000.0, (n, 2))
    quoted = [np.full(n, 0.1) if same else 0.03 * 10 ** rng.uniform(0.0, 1.0, n) for same in alike]
    quoted[1] *= size_2
    seen = [
        place + factor * sigma[:, None] * rng.standard_normal((n, 2))
        for factor, sigma in zip(factors, quoted, strict=True)
    ]
    seen[0] += floor * rng.standard_normal((n, 2))
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    far = 10.0 * quoted[0] * (rng.uniform(size=n) < displaced)
    seen[0] += far[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    sides = [
        Records.of(x, sigma=sigma[:, None], source=name)
        for x, sigma, name in zip(seen, quoted, ("plate", "gaia"), strict=True)
    ]
    return match(*sides)[0]


@pytest.mark.slow
@pytest.mark.parametrize("factors, floor", [((1.0, 1.0), 0.0), ((1.7, 1.0), 0.0), ((1.0, 1.5), 0.1), ((0.7, 2.0), 0.0)])
def test_factors_and_floor_are_recovered_within_their_errors(factors, floor):
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


@pytest.mark.slow
def test_without_a_floor_the_fitted_floor_is_within_its_error_of_zero():
    floors = [error_model(answer([6, k])).floor for k in range(40)]
    beyond = np.mean([floor.value > 1.96 * floor.standard_error for floor in floors])
    assert beyond <= 0.15 and all(floor.standard_error > 0.0 for floor in floors)


@pytest.mark.slow
def test_displaced_records_do_not_bias_floor_and_factor():
    found = [error_model(answer([2, k], factors=(1.7, 1.0), displaced=0.02)) for k in range(12)]
    for name, true in (("factor_1", 1.7), ("factor_2", 1.0)):
        deviation = [(getattr(m, name).value - true) / getattr(m, name).standard_error for m in found]
        assert abs(np.mean(deviation)) < 1.0, name
    assert sum(m.floor.value > 3.0 * m.floor.standard_error for m in found) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("size_2", [1.0, 0.01])
def test_a_floor_is_found_if_one_source_quotes_one_error_for_all(size_2):
    found = [
        error_model(answer([3, k], factors=(1.4, 1.0), floor=0.1, alike=(False, True), size_2=size_2)) for k in range(8)
    ]
    for m in found:
        assert m.factor_2 is None and m.both is None and "those of gaia taken as quoted" in m.note
        assert m.factor_1.value == pytest.approx(1.4, abs=3.5 * m.factor_1.standard_error)
        assert m.floor.value == pytest.approx(0.1, abs=3.5 * m.floor.standard_error)
    assert np.mean([m.floor.value for m in found]) == pytest.approx(0.1, rel=0.05)


@pytest.mark.slow
def test_equal_errors_of_all_records_determine_only_one_number():
    found = error_model(answer(3, alike=(True, True), factors=(1.7, 1.7)))
    assert found.factor_1 is found.factor_2 is found.floor is None and "vary too little" in found.note
    assert found.both.value == pytest.approx(1.7, abs=3.5 * found.both.standard_error)
    due = np.sqrt((1.7**2 - 1.0) * 0.02)
    assert found.floor_instead.value == pytest.approx(due, abs=3.5 * found.floor_instead.standard_error)


@pytest.mark.slow
def test_proportional_errors_determine_one_common_factor():
    rng = np.random.default_rng(8)
    place, sigma = rng.uniform(0.0, 2000.0, (1500, 2)), 0.03 * 10 ** rng.uniform(0.0, 1.0, (1500, 1))
    sides = [
        Records.of(place + 1.4 * size * sigma * rng.standard_normal(place.shape), sigma=size * sigma)
        for size in (1.0, 1.2)
    ]
    found = error_model(match(*sides)[0])
    assert found.factor_1 is found.factor_2 is None and "which are too small cannot be determined" in found.note
    assert found.both.value == pytest.approx(1.4, abs=3.5 * found.both.standard_error)
    assert found.floor.value <= 3.0 * found.floor.standard_error


@pytest.mark.slow
def test_with_negligible_quoted_errors_only_a_floor_is_reported():
    found = error_model(answer(9, floor=0.1, alike=(True, True), size_2=0.3))
    assert found.floor_instead is not None and found.both is not None
    rng = np.random.default_rng(9)
    place = rng.uniform(0.0, 2000.0, (1500, 2))
    tiny = 1e-3 * 10 ** rng.uniform(0.0, 1.0, (1500, 1))
    found = error_model(
        match(
            Records.of(place + 0.02 * rng.standard_normal(place.shape), sigma=tiny), Records.of(place, sigma=tiny[::-1])
        )[0]
    )
    assert found.both is found.factor_1 is found.factor_2 is None
    assert found.floor.value == pytest.approx(0.02, rel=0.1) and "their own sizes" in found.note


def test_few_pairs_do_not_separate_the_sources():
    found = error_model(answer(4, n=50))
    assert not found.is_estimated and "fewer than 200 pairs" in found.note


def test_parameters_not_determined_leave_the_quoted_variance():
    quoted = np.array([1.0, 2.0]), np.array([3.0, 3.0])
    two, three = Quantity(2.0, 0.1), Quantity(3.0, 0.1)
    assert ErrorModel(factor_1=two, floor=three).variance(*quoted).tolist() == [16.0, 20.0]
    assert ErrorModel(both=two).variance(*quoted).tolist() == [16.0, 20.0]
    assert ErrorModel(floor_instead=three).variance(*quoted).tolist() == [4.0, 5.0]


def test_errors_of_a_far_more_precise_source_are_taken_as_quoted():
    found = error_model(answer(5, factors=(2.0, 1.0), size_2=1e-3))
    assert found.factor_1.value == pytest.approx(2.0, abs=0.1) and found.factor_2 is None
    assert "those of gaia taken as quoted" in found.note


@pytest.mark.parametrize("alike", [(True, True), (False, True), (False, False)])
@pytest.mark.parametrize("factors", [(0.6, 0.6), (0.3, 0.3)])
def test_errors_quoted_too_large_leave_no_floor(factors, alike):
    """If only a floor is fitted and it is zero, the information matrix is empty and is not inverted."""
    found = error_model(answer(4, factors=factors, alike=alike))
    factor = found.both or found.factor_1
    assert factor.value == pytest.approx(factors[0], abs=4.0 * factor.standard_error)
    for floor in (found.floor, found.floor_instead):
        assert floor is None or floor.value <= 3.0 * floor.standard_error
