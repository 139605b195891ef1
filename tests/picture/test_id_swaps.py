"""The compiled evidence of reports on swaps of ids agrees with its formulas, pair by pair and model by model."""

import math

import numpy as np
import pytest
from scipy.special import logsumexp

from sameas.kernels.id_swaps import MAX_LOG_WEIGHT, MAX_SWAP, add_set_gains, swap_factors

WAYS = ("interpreted", "compiled")
RATES, N_RANGES, K = np.array([1e-5, 0.01, 0.3]), 2, 30


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("spread", [3.0, 300.0])
def test_factors_of_swaps_are_those_of_the_logarithms(rng, way, spread):
    log_old, log_reported, log_stays = spread * rng.standard_normal((3, K))
    by_model = rng.uniform(-20.0, 20.0, (K, len(RATES) * N_RANGES))
    at = np.flatnonzero(rng.random(K) < 0.7)
    rival = rng.integers(-1, K, (len(at), 2))
    log_report, near = rng.standard_normal((len(at), 2)), rng.random((len(at), 2, N_RANGES))
    may_swap = rng.random((len(at), 2)) < 0.7
    factor, swapped, with_reports = np.empty((3, len(at), by_model.shape[1]))
    log_top = np.empty(len(at))
    getattr(swap_factors, way)(
        at, (log_old, log_reported), log_stays, np.exp(by_model), (rival, log_report, near), may_swap, RATES, factor,
        swapped, with_reports, log_top,
    )  # fmt: skip
    for n, own in enumerate(at):
        for model in range(by_model.shape[1]):
            stays, present, both = 1.0, 0.0, 0.0
            for side in range(2):
                r, rate = rival[n, side], RATES[model % len(RATES)] if may_swap[n, side] else RATES[0]
                if r < 0:
                    continue
                p = min(rate * near[n, side, model // len(RATES)], MAX_SWAP)
                stays -= p
                log_rival = log_old[r] + by_model[r, model] - log_stays[own] - by_model[own, model]
                p *= math.exp(min(log_rival, MAX_LOG_WEIGHT))
                present += p
                both += p * math.exp(min(log_reported[r] + log_report[n, side], MAX_LOG_WEIGHT))
            assert swapped[n, model] == pytest.approx(present, rel=1e-10)
            assert factor[n, model] == pytest.approx(stays + present, rel=1e-10)
            expected = by_model[own, model] + math.log(stays + both)
            assert log_top[n] + np.log(with_reports[n, model]) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("way", WAYS)
def test_a_model_gains_what_the_weights_of_its_sets_grow(rng, way):
    label, least = rng.integers(0, 8, K), -4.0
    source, (log_before, log_after) = label % 3, 50.0 * rng.standard_normal((2, K))
    before, after = rng.uniform(0.1, 9.0, (2, K, 5))
    gain = np.ones((3, 5))
    getattr(add_set_gains, way)(label, source, (log_before, before), (log_after, after), least, 0.5, gain)
    expected = np.ones((3, 5))
    for one in np.unique(label):
        of_set = label == one
        for model in range(5):
            sums = [
                logsumexp([least, *(log[of_set] + np.log(weight[of_set, model]))])
                for log, weight in ((log_before, before), (log_after, after))
            ]
            expected[one % 3, model] += 0.5 * (sums[1] - sums[0])
    np.testing.assert_allclose(gain, expected, rtol=1e-10)
