"""Factors on the errors of each source and a common floor; the mixture of error scales; tails of the errors."""

import numpy as np
import pytest

from sameas import Records
from sameas.estimate.error_model import ErrorModel, error_model, tail
from sameas.estimate.error_scales import SIGNIFICANT_TAIL_GAIN, fit_errors
from sameas.estimate.match import match
from sameas.estimate.quantity import Quantity
from sameas.evidence import Errors
from sameas.simulate.scenes import poisson_field


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
@pytest.mark.long_after(1)
def test_factors_and_floor_are_recovered_within_their_errors(factors, floor):
    found = [error_model(answer([1, k], factors=factors, floor=floor)) for k in range(8)]
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
@pytest.mark.long
def test_without_a_floor_the_fitted_floor_is_within_its_error_of_zero():
    floors = [error_model(answer([6, k])).floor for k in range(20)]
    beyond = np.mean([floor.value > 1.96 * floor.standard_error for floor in floors])
    assert beyond <= 0.15 and all(floor.standard_error > 0.0 for floor in floors)


@pytest.mark.slow
@pytest.mark.long
def test_displaced_records_do_not_bias_floor_and_factor():
    found = [error_model(answer([2, k], factors=(1.7, 1.0), displaced=0.02)) for k in range(8)]
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


# The mixture of error scales maximises the likelihood, and a tail is fitted only if it is significant.


def log_likelihood(errors, z2, log_odds, d):
    """The maximised quantity, pair by pair, with the pseudo-counts on the scale nearest to 1."""
    nearest = int(np.argmin(np.abs(np.log(errors.scales))))
    return np.log1p(np.exp(log_odds + errors.log_profile(z2, d))).sum() + 2.0 * np.log(errors.shares[nearest])


def scaled_pairs(rng, n, d=2, scale=1.3, chance=0):
    """True pairs with errors ``scale`` times too small, and chance pairs; odds for a density of 1 in 40."""
    true = scale**2 * rng.chisquare(d, n)
    false = 36.0 * rng.uniform(size=chance) ** (2.0 / d)
    z2 = np.concatenate([true, false])
    return z2, np.full(len(z2), np.log(40.0)) + rng.normal(0.0, 1.0, len(z2))


@pytest.mark.parametrize("seed, scale, chance", [(0, 1.3, 0), (1, 0.6, 200), (2, 2.4, 50), (3, 1.0, 800)])
def test_no_other_mixture_of_the_scales_is_more_likely(seed, scale, chance):
    rng = np.random.default_rng(seed)
    z2, log_odds = scaled_pairs(rng, 600, scale=scale, chance=chance)
    found = fit_errors(z2, log_odds, 2, Errors(), significant_tail_gain=0.0).errors
    ladder = found.scales[0] * 1.5 ** np.arange(-8.0, 9.0)
    ladder = ladder[(ladder > 0.1) & (ladder < 8.0)]
    known = dict(zip(np.round(found.scales, 9), found.shares, strict=True))
    shares = np.array([known.get(s, 1e-300) for s in np.round(ladder, 9)])
    best = log_likelihood(Errors(tuple(ladder), tuple(shares)), z2, log_odds, 2)
    for k, here in enumerate(ladder):
        # Perturb one share, at the expense of all others.
        moved = shares * 0.98
        moved[k] += 0.02
        # Binning rounds distances and odds, which costs a little likelihood.
        assert log_likelihood(Errors(tuple(ladder), tuple(moved / moved.sum())), z2, log_odds, 2) < best + 0.3, here


def test_the_start_of_the_search_does_not_matter():
    z2, log_odds = scaled_pairs(np.random.default_rng(4), 3000, scale=1.7, chance=500)
    one = fit_errors(z2, log_odds, 2, Errors()).errors
    two = fit_errors(z2, log_odds, 2, Errors((1.5**-4, 1.0), (0.9, 0.1))).errors
    grid = np.linspace(0.0, 30.0, 50)
    np.testing.assert_allclose(one.log_profile(grid, 2), two.log_profile(grid, 2), atol=0.02)


@pytest.mark.parametrize("scale", [1.25, 1.7, 2.0, 2.7])
def test_one_normal_has_no_tail_whatever_its_scale(scale):
    rng = np.random.default_rng(8)
    z2 = scale**2 * rng.chisquare(2, 20_000)
    found = fit_errors(z2, np.full(len(z2), np.log(1e4)), 2, Errors()).errors
    assert found.typical_scale == pytest.approx(scale, rel=0.08)
    # Compare densities out to the 1e-4 quantile.
    reach = np.linspace(0.0, 2.0 * np.log(1e4), 50) * scale**2
    true = -0.5 * reach / scale**2 - 2.0 * np.log(scale)
    assert np.abs(found.log_profile(reach, 2) - true)[reach < 12.0 * scale**2].max() < 0.35
    assert (found.log_profile(reach, 2) - true).max() < 1.0


def test_a_tail_is_fitted_where_it_is_significant():
    rng = np.random.default_rng(5)
    # Chance candidates are rare: about one in 3000 within 12 standard deviations.
    core, odds = rng.chisquare(2, 3000), np.full(3000, np.log(2e5))
    without = fit_errors(core, odds, 2, Errors())
    assert max(without.errors.scales) < 2.0 and without.tail_gain < SIGNIFICANT_TAIL_GAIN
    far = np.concatenate([core, 25.0 * rng.chisquare(2, 60)])
    found = fit_errors(far, np.full(3060, np.log(2e5)), 2, Errors())
    tail = sum(share for scale, share in zip(found.errors.scales, found.errors.shares, strict=True) if scale > 2.0)
    assert found.tail_gain > SIGNIFICANT_TAIL_GAIN and tail == pytest.approx(0.02, abs=0.008)


def test_pairs_of_zero_odds_and_zero_pairs_give_the_prior():
    assert fit_errors(np.full(5, 4.0), np.full(5, -np.inf), 2, Errors()).errors == Errors()
    assert fit_errors(np.empty(0), np.empty(0), 3, Errors()).errors == Errors()


# The tail: none if all errors are too small by one factor, otherwise its share within its error.


def estimated_tail(seed, *, share, times, quoted=1.0):
    """The estimated tail if a ``share`` of the first source's records has errors larger than quoted by a factor."""
    rng = np.random.default_rng(seed)
    scene = poisson_field(rng, density=2e-4, extent=(4500.0, 4500.0), q1=0.1, q2=0.1, sigma_1=0.5, sigma_2=0.05)
    far = rng.uniform(size=len(scene.first)) < share
    more = np.sqrt(times**2 - 1.0) * 0.5 * rng.standard_normal((len(far), 2)) * far[:, None]
    first = Records.of(scene.first.features + more, sigma=0.5 / quoted, source="first")
    second = Records.of(scene.second.features, sigma=0.05 / quoted, source="second")
    answer, estimate = match(first, second)
    return tail(answer, estimate.errors)


@pytest.mark.parametrize("quoted", [0.6, 1.0, 1.7])
def test_errors_all_wrong_by_one_factor_have_no_tail(quoted):
    beyond = estimated_tail(1, share=0.0, times=1.0, quoted=quoted)
    assert beyond is None or beyond.share.value < 0.002


@pytest.mark.slow
@pytest.mark.long
def test_the_share_of_the_tail_is_found_within_its_standard_error():
    tails = [estimated_tail(seed, share=0.04, times=6.0) for seed in range(20)]
    pull = np.array([(one.share.value - 0.04) / one.share.standard_error for one in tails])
    assert abs(pull.mean()) < 0.8 and 0.75 < np.std(pull) < 1.3
    assert 5.0 < np.mean([one.factor for one in tails]) < 7.5


@pytest.mark.slow
def test_a_tail_is_found_on_top_of_errors_that_are_too_small():
    beyond = estimated_tail(3, share=0.05, times=6.0, quoted=1.7)
    assert abs(beyond.share.value - 0.05) < 4.0 * beyond.share.standard_error
    assert 8.0 < beyond.factor < 13.0


def test_the_last_pairs_of_a_thin_tail_are_not_certain_to_have_no_partner():
    """Double stars decades later: six in a thousand lie up to 1.5 arcsec apart, among errors of 0.01 arcsec, where
    chance neighbours are 30 arcsec away. A gate that ended with the last but one of them lost 13."""
    rng = np.random.default_rng(2)
    n, far = 6000, 60
    place = rng.uniform(-36_000.0, 36_000.0, (n, 2))
    quoted = 0.005 * np.exp(rng.normal(0.0, 0.4, n))
    true = np.hypot(1.2 * quoted, 0.01) * np.where(rng.random(n) < 0.05, 8.0, 1.0)
    residual = rng.normal(size=(n, 2)) * true[:, None]
    doubles, angle = rng.choice(n, far, replace=False), rng.uniform(0.0, 6.28, far)
    apart = np.exp(rng.uniform(np.log(0.05), np.log(1.5), far))
    residual[doubles] = np.column_stack([apart * np.cos(angle), apart * np.sin(angle)])
    others = [rng.uniform(-36_000.0, 36_000.0, (count, 2)) for count in (4 * n, n // 10)]
    sigma = np.append(quoted, 0.005 * np.exp(rng.normal(0.0, 0.4, n // 10)))
    first = Records.of(np.concatenate([place + residual, others[1]]), sigma=sigma, source="first")
    second = Records.of(np.concatenate([place, others[0]]), sigma=1e-4, source="second")
    matches = match(first, second)[0].matches
    right = (matches.rows_1 == matches.rows_2) & (matches.rows_1 < n)
    assert right.all() and len(right) >= n - 1
