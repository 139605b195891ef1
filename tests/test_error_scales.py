"""The mixture of error scales maximises the likelihood, and a tail is fitted only if it is significant."""

import numpy as np
import pytest

from sameas.estimate.error_model import DEFAULT_SCALES, ScalesTuning, fit_errors
from sameas.evidence import Errors


def log_likelihood(errors, z2, log_odds, d):
    """The maximised quantity, pair by pair, with the pseudo-counts on the scale nearest to 1."""
    nearest = int(np.argmin(np.abs(np.log(errors.scales))))
    return np.log1p(np.exp(log_odds + errors.log_profile(z2, d))).sum() + 2.0 * np.log(errors.shares[nearest])


def pairs(rng, n, d=2, scale=1.3, chance=0):
    """True pairs with errors ``scale`` times too small, and chance pairs; odds for a density of 1 in 40."""
    true = scale**2 * rng.chisquare(d, n)
    false = 36.0 * rng.uniform(size=chance) ** (2.0 / d)
    z2 = np.concatenate([true, false])
    return z2, np.full(len(z2), np.log(40.0)) + rng.normal(0.0, 1.0, len(z2))


@pytest.mark.parametrize("seed, scale, chance", [(0, 1.3, 0), (1, 0.6, 200), (2, 2.4, 50), (3, 1.0, 800)])
def test_no_other_mixture_of_the_scales_is_more_likely(seed, scale, chance):
    rng = np.random.default_rng(seed)
    z2, log_odds = pairs(rng, 600, scale=scale, chance=chance)
    found = fit_errors(z2, log_odds, 2, Errors(), tuning=ScalesTuning(significant_tail_gain=0.0)).errors
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
    z2, log_odds = pairs(np.random.default_rng(4), 3000, scale=1.7, chance=500)
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
    assert max(without.errors.scales) < 2.0 and without.tail_gain < DEFAULT_SCALES.significant_tail_gain
    far = np.concatenate([core, 25.0 * rng.chisquare(2, 60)])
    found = fit_errors(far, np.full(3060, np.log(2e5)), 2, Errors())
    tail = sum(share for scale, share in zip(found.errors.scales, found.errors.shares, strict=True) if scale > 2.0)
    assert found.tail_gain > DEFAULT_SCALES.significant_tail_gain and tail == pytest.approx(0.02, abs=0.008)


def test_pairs_of_zero_odds_and_zero_pairs_give_the_prior():
    assert fit_errors(np.full(5, 4.0), np.full(5, -np.inf), 2, Errors()).errors == Errors()
    assert fit_errors(np.empty(0), np.empty(0), 3, Errors()).errors == Errors()
