"""Kernels of track pairs agree with NumPy formulas, interpreted and compiled."""

import numpy as np
import pytest
from scipy.special import expit

from problems import random_covariances
from sameas.gaussian import Gaussian, inverse, log_density, mahalanobis_sq, symmetric
from sameas.kernels.track_pairs import (
    CONVOY,
    COVARIANCE,
    MEAN,
    ONE,
    WIDTH,
    best_others,
    mix,
    new_pair_errors,
    pair_distances,
    pairs_stepped,
)
from sameas.picture.error_correlation import MIN_M2
from sameas.picture.error_factors import error_update
from sameas.picture.id_swaps import SWAP_MODELS, SWAP_RANGES, Rivals, SwapRates
from sameas.picture.named_tracks import prior_covariance
from sameas.picture.track_pairs import TrackPairs
from sameas.picture.tuning import DEFAULT_TUNING

WAYS = ("interpreted", "compiled")


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def packed(mean, covariance):
    """(k, WIDTH) the rows of means (k, 2, 8) and covariances (k, 2, 8, 8) of both ways."""
    out = np.empty((len(mean), WIDTH))
    for way, d in enumerate((ONE, CONVOY)):
        lower = np.tril_indices(d)
        out[:, MEAN[way] : MEAN[way] + d] = mean[:, way, :d]
        out[:, COVARIANCE[way] : COVARIANCE[way] + len(lower[0])] = covariance[:, way][:, *lower]
    return out


def unpacked(rows):
    """The means and covariances of rows; d is 0 where both tracks are one object."""
    mean, covariance = np.zeros((len(rows), 2, 8)), np.zeros((len(rows), 2, 8, 8))
    for way, d in enumerate((ONE, CONVOY)):
        lower = np.tril_indices(d)
        mean[:, way, :d] = rows[:, MEAN[way] : MEAN[way] + d]
        covariance[:, way][:, *lower] = rows[:, COVARIANCE[way] : COVARIANCE[way] + len(lower[0])]
        covariance[:, way][:, *lower[::-1]] = covariance[:, way][:, *lower]
    return mean, covariance


def without_past(delta, covariances, lasting):
    """By the conditional of (e_a, z_a, z_b) given δ."""
    k, total = len(delta), covariances[0] + covariances[1]
    mean, covariance, onto = np.zeros((k, 2, 8)), np.zeros((k, 2, 8, 8)), np.zeros((k, 6, 2))
    covariance[..., :4, :4] = prior_covariance(covariances[0], lasting[0])[:, None]
    covariance[..., 4:6, 4:6] = np.eye(2)
    onto[:, :4], onto[:, 4:] = covariance[:, 0, :4, :2], -lasting[1].transpose(0, 2, 1)
    one = Gaussian(mean[:, 0, :6], covariance[:, 0, :6, :6]).conditional(onto, delta, total)
    mean[:, 0, :6], covariance[:, 0, :6, :6] = one.mean, one.covariance
    mean[:, 1, 6:], covariance[:, 1, 6:, 6:] = delta, total
    covariance[:, 1, :6, 6:], covariance[:, 1, 6:, :6] = -onto, -onto.transpose(0, 2, 1)
    return mean, covariance


def stepped(mean, covariance, rows, a, b, step, total):
    """The motion and the two updates, each along all pairs."""
    last, moved, drift, slopes, noise, shifts, new = step
    mean, covariance, k = mean[rows], covariance[rows], len(rows)
    went = (moved[a] - moved[b]) - (last[a] - last[b])
    gain = drift[a] @ inverse(drift[a] + drift[b] + 1e-4 * MIN_M2 * np.eye(2))
    mean[..., :2] += np.einsum("kvw,kw->kv", gain, went)[:, None]
    covariance[..., :2, :2] += symmetric(drift[a] - gain @ drift[a])[:, None]
    mean, covariance = mean.reshape(2 * k, 8), covariance.reshape(2 * k, 8, 8)
    log_reports, delta, twice = np.zeros((k, 2)), moved[a] - moved[b], np.repeat(np.arange(k), 2)
    for track, is_first in ((a, True), (b, False)):
        slope = np.zeros((k, 2, 8))
        slope[:, :, :2], shift = slopes[track, :, :2], shifts[track]
        expected = np.zeros((k, 2))
        if is_first:
            slope[:, :, 2:4] = slopes[track, :, 2:]
        else:
            slope[:, :, 4:6], slope[:, :, 6:] = slopes[track, :, 2:], slope[:, :, :2]
            expected = np.einsum("kvw,kw->kv", slope[:, :, :2], delta)
        mean, covariance, log_p, _ = error_update(
            mean, covariance, slope[twice], noise[track][twice], (shift + expected)[twice]
        )
        if is_first:
            mean[:, :2] += shift[twice]
        delta = delta + (shift if is_first else -shift)
        log_reports += np.where(new[track, None], log_p.reshape(k, 2), 0.0)
    spread = total[a] + total[b]
    return (
        mean.reshape(k, 2, 8), covariance.reshape(k, 2, 8, 8), log_reports, log_density(delta, spread),
        mahalanobis_sq(delta, spread),
    )  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_the_update_of_pairs_agrees_with_the_formulas(rng, way):
    m, n = 7, 20
    total = random_covariances(rng, m, 2)
    root = np.linalg.cholesky(total)
    new = np.arange(m) % 3 > 0
    zero = ~new[:, None, None]
    step = (
        rng.standard_normal((m, 2)), rng.standard_normal((m, 2)), random_covariances(rng, m, 2),
        np.where(zero, 0.0, rng.standard_normal((m, 2, 4))), np.where(zero, 0.0, random_covariances(rng, m, 2)),
        np.where(new[:, None], rng.standard_normal((m, 2)), 0.0), new,
    )  # fmt: skip
    a, b = (rng.integers(0, m, n) for _ in range(2))
    delta = rng.standard_normal((n, 2))
    errors = np.empty((n, WIDTH))
    given = delta, total[a], total[b], 0.3 * root[a], 0.5 * root[b]
    getattr(new_pair_errors, way)(*given, errors)
    mean, covariance = unpacked(errors)
    for ours, theirs in zip((mean, covariance), without_past(given[0], given[1:3], given[3:]), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-10)
    rows = np.flatnonzero(rng.random(n) < 0.8)
    a, b = a[rows], b[rows]
    out = [np.empty((len(rows), *shape)) for shape in ((WIDTH,), (2,), (), ())]
    last, moved, drift, slope, noise, shift, _ = step
    getattr(pairs_stepped, way)(
        errors[:12], errors[12:], rows, a, b, last, moved, drift, slope, noise, shift, new, total, MIN_M2, *out
    )
    after = stepped(mean, covariance, rows, a, b, step, total)
    for ours, theirs in zip((*unpacked(out[0]), *out[1:]), after, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-9)
    # What the reports tell is the same where nothing is kept.
    told = [np.empty((0, WIDTH)), *(np.empty(one.shape) for one in out[1:])]
    getattr(pairs_stepped, way)(
        errors[:12], errors[12:], rows, a, b, last, moved, drift, slope, noise, shift, new, total, MIN_M2, *told
    )
    assert all(np.array_equal(one, other) for one, other in zip(told[1:], out[1:], strict=True))


@pytest.mark.parametrize("way", WAYS)
def test_distances_of_pairs_are_those_of_the_formulas(rng, way):
    state, covariance = rng.standard_normal((9, 4)), random_covariances(rng, 9, 4)
    one, other = rng.integers(0, 9, (2, 20))
    for column in (0, 2):
        chi_sq, determinant = np.empty((2, 20))
        getattr(pair_distances, way)(state, covariance, one, other, column, chi_sq, determinant)
        cut = slice(column, column + 2)
        total = covariance[one, cut, cut] + covariance[other, cut, cut]
        np.testing.assert_allclose(chi_sq, mahalanobis_sq(state[one, cut] - state[other, cut], total), rtol=1e-12)
        np.testing.assert_allclose(determinant, np.linalg.det(total), rtol=1e-9)


@pytest.mark.parametrize("way", WAYS)
def test_a_merged_mixture_has_the_moments_of_its_samples(rng, way):
    (mean, other), (covariance, other_covariance) = rng.normal(size=(2, 3, 2, 8)), random_covariances(rng, 2, 3, 2, 8)
    rows, others = packed(mean, covariance), packed(other[:2], other_covariance[:2])
    before, (means, covariances), (other_means, others_covariances) = rows.copy(), unpacked(rows), unpacked(others)
    at, share = np.array([2, 0]), np.array([0.3, 0.8])
    getattr(mix, way)(rows, at, share, others)
    mixed = unpacked(rows)
    for n, (row, s) in enumerate(zip(at, share, strict=True)):
        # E[x] and E[x xᵀ] of a mixture are the means of those of its parts.
        first = (1 - s) * means[row] + s * other_means[n]
        second = sum(
            w * (p + m[..., :, None] * m[..., None, :])
            for w, m, p in ((1 - s, means[row], covariances[row]), (s, other_means[n], others_covariances[n]))
        )
        np.testing.assert_allclose(mixed[0][row], first, atol=1e-12)
        np.testing.assert_allclose(mixed[1][row], second - first[..., :, None] * first[..., None, :], atol=1e-12)
    assert np.array_equal(rows[1], before[1])


@pytest.mark.parametrize("way", WAYS)
def test_the_best_other_of_a_set_is_the_first_of_the_highest(rng, way):
    label, values = rng.integers(0, 6, 30), rng.integers(0, 5, 30).astype(float)
    best = np.empty(30, np.int64)
    getattr(best_others, way)(label, values, best)
    for k in range(30):
        others = [at for at in range(30) if label[at] == label[k] and at != k]
        assert best[k] == (max(others, key=lambda at: (values[at], -at)) if others else -1)


def test_pairs_of_one_track_are_rivals_whichever_track_began_first():
    # Tracks 0 and 3 of source 0, tracks 1 and 2 of source 1: track 3 began last, so it is the second of its pairs.
    source = np.array([0, 1, 1, 0])
    first, second = np.array([0, 0, 1, 2]), np.array([1, 2, 3, 3])
    rivals = Rivals.of(first, second, source[first], source[second])
    values = np.arange(4.0)
    # Pairs (0, 1), (0, 2), (1, 3), (2, 3): the rivals of each share one of its tracks.
    assert rivals.best_other(values, 0).tolist() == [1, 0, 3, 2]
    assert rivals.best_other(values, 1).tolist() == [2, 3, 0, 1]
    assert rivals.max_other(values).tolist() == [2.0, 3.0, 3.0, 2.0]


def two_by_two():
    """Tracks 0 and 1 of source 0 with tracks 2 and 3 of source 1: rivals, and ln r for (0, 2) and (1, 3)."""
    source = np.array([0, 0, 1, 1])
    first, second = np.array([0, 0, 1, 1]), np.array([2, 3, 2, 3])
    return Rivals.of(first, second, source[first], source[second]), np.array([6.0, -5.0, -5.0, 6.0])


def test_one_swap_bounds_the_joint_odds_of_the_two_pairs_that_it_exchanges():
    rivals, log_ratio = two_by_two()
    p = 0.1

    def swaps_of_source_1(side, pair, rival):
        some = np.arange(len(pair) if side == 0 else 0)
        return some, np.full((len(some), 1), p), np.ones((len(some), 1))

    now = rivals.with_joint_swaps(log_ratio, np.zeros((4, 1)), log_ratio, swaps_of_source_1)
    # A hidden state with two values, exchanged with probability p: its odds after the prediction step.
    before = np.exp(log_ratio[0] + log_ratio[3] - log_ratio[1] - log_ratio[2])
    expected = ((1.0 - p) * before + p) / ((1.0 - p) + p * before)
    assert now[0] + now[3] - now[1] - now[2] == pytest.approx(np.log(expected))
    # Whether a track of the one source has a partner among the two of the other does not change.
    np.testing.assert_allclose(np.logaddexp(now[0], now[1]), np.logaddexp(log_ratio[0], log_ratio[1]))


def test_a_swap_that_exchanges_one_pair_only_or_is_impossible_changes_no_history():
    def swaps_of_source_1(p):
        def swaps(side, pair, _):
            return np.arange(len(pair)), np.full((len(pair), 1), p * (side == 0)), np.ones((len(pair), 1))

        return swaps

    rivals, log_ratio = two_by_two()
    same = np.zeros((4, 1))
    unchanged = rivals.with_joint_swaps(log_ratio, same, log_ratio, swaps_of_source_1(0.0))
    assert unchanged == pytest.approx(log_ratio)
    # Track 1 has no partner: pairs (1, 2) and (1, 3) are less probable than chance.
    alone = np.array([6.0, 5.0, -5.0, -5.0])
    now = rivals.with_joint_swaps(alone, same, alone, swaps_of_source_1(0.1))
    assert now[:2] == pytest.approx(alone[:2])


def test_joint_swaps_are_a_mean_of_probabilities_over_the_swap_models():
    rivals, log_ratio = two_by_two()

    def one_of_two_models_loses_the_history(side, pair, _):
        p = np.tile([0.0, 0.5 * (side == 0)], (len(pair), 1))
        return np.arange(len(pair)), p, np.full((len(pair), 2), 0.5)

    now = rivals.with_joint_swaps(log_ratio, np.zeros((4, 2)), log_ratio, one_of_two_models_loses_the_history)
    p = expit(log_ratio[0] - log_ratio[1])
    assert expit(now[0] - now[1]) == pytest.approx(0.5 * p + 0.25, rel=1e-4)


def after_reports(rng, chi_sq, swap_probability, count, swaps=None):
    """ln r with the last report, and the rates, after reports of tracks 2 and 3 at this distance; track pairs as of
    :func:`two_by_two`. A report is worth N(4, 8) in favour of the true two pairs; the true ids may be swapped."""
    rivals, _ = two_by_two()
    swaps = swaps or SwapRates().of_sources(("ais", "tracks"))
    log_ratio, log_reported, by_model = np.zeros(4), np.zeros(4), np.zeros((4, len(SWAP_MODELS[0])))
    near = np.zeros((4, 2, len(SWAP_RANGES)))
    near[:, 0] = np.exp(-chi_sq / np.array(SWAP_RANGES))
    swapped = np.cumsum(rng.random(count) < swap_probability) % 2 == 1
    for sign in np.where(swapped, -1.0, 1.0):
        log_now = sign * rng.normal(4.0, np.sqrt(8.0)) / 4.0 * np.array([1.0, -1.0, -1.0, 1.0])
        rival = np.column_stack([rivals.best_other(log_ratio + log_reported, 0), np.full(4, -1)])
        log_ratio, by_model, p_swapped, swaps = swaps.updated(
            (log_ratio, log_reported, by_model), log_ratio + log_reported, log_now, (rival, np.zeros((4, 2)), near),
            rivals, (np.ones(4, int), np.zeros(4, int)), -9.0,
        )  # fmt: skip
        assert ((p_swapped >= 0.0) & (p_swapped <= 1.0)).all()
        log_ratio, log_reported = rivals.bounded(log_ratio, np.ones(4, bool), DEFAULT_TUNING), log_now
    return log_ratio + log_reported, swaps


def test_a_history_is_kept_while_it_is_not_known_whether_a_tracker_swaps(rng):
    log_ratio, swaps = after_reports(rng, 0.0, 0.0, 10)
    # By the mean rate, the odds of a pair would be bounded by its inverse.
    mean = swaps.rate(np.array([1]))[0]
    assert mean > 1e-3
    assert log_ratio[0] - log_ratio[1] > np.log(1.0 / mean) + 1.0


def test_rate_and_range_of_swaps_are_estimated_together(rng):
    _, near = after_reports(rng, 0.0, 0.1, 300)
    assert near.rate(np.array([0, 1])) == pytest.approx([1e-5, 0.1], rel=0.01)
    short, long = SWAP_RANGES
    for swap_probability, expected in ((0.0, short), (0.1, long)):
        _, swaps = after_reports(rng, 4.0, swap_probability, 300, near)
        ranges = SWAP_MODELS[1]
        assert swaps.probability[1, ranges == expected].sum() > 0.99


def test_what_is_known_of_errors_stays_known_in_other_units(rng):
    k, delta = 4, 30.0 * rng.standard_normal((4, 2))
    p, share = [m2 * np.eye(2)[None].repeat(k, axis=0) for m2 in (900.0, 400.0)], np.sqrt(0.5)
    number, root = np.arange(k), [share * np.sqrt(each) for each in p]

    def pairs(one, other):
        """Pairs given δ only, if the errors are these times as large."""
        covariances, roots = (one**2 * p[0], other**2 * p[1]), (one * root[0], other * root[1])
        return TrackPairs.of(number, number + k, delta, covariances, roots, 0.0)

    def changed(before, one, other):
        covariances = one**2 * p[0], other**2 * p[1]
        return before.with_errors(number, delta, (p[0], p[1]), covariances, (np.full(k, one), np.full(k, other)))

    new, exact = changed(pairs(1.0, 1.0), 1.5, 1.5), pairs(1.5, 1.5)
    assert new.errors[:, : MEAN[1]] == pytest.approx(exact.errors[:, : MEAN[1]])
    assert new.errors[:, slice(*COVARIANCE)] == pytest.approx(exact.errors[:, slice(*COVARIANCE)])
    assert new.log_now == pytest.approx(exact.log_now) and new.chi_sq == pytest.approx(exact.chi_sq)
    # With different factors the means and the covariance of e_a are those given δ as well.
    new, exact = changed(pairs(1.0, 1.0), 1.0, 2.0), pairs(1.0, 2.0)
    assert new.errors[:, : MEAN[1]] == pytest.approx(exact.errors[:, : MEAN[1]])
    of_e = slice(COVARIANCE[0], COVARIANCE[0] + 3)
    assert new.errors[:, of_e] == pytest.approx(exact.errors[:, of_e])
