"""The baseline methods agree with exhaustive search."""

import itertools

import numpy as np
import pytest

import naive
from problems import DRAWS, components_of, laid_out, many_blocks, plane_records
from sameas import Box, CommonObjects, InputError, PerPair, Radius, Records
from sameas.assignment import assign
from sameas.decision import Loss
from sameas.groups import groups
from sameas.score.baselines import classified, enumerated, most_pairs, mutual_nearest, nearest, number_of_hypotheses


def scene(seed, n1=12, n2=9, d=2, gate=3.0, scale=0.12):
    rng = np.random.default_rng(seed)
    pairs = Box(gate)(*(plane_records(rng, n, d, scale=scale, kind="full") for n in (n1, n2)))
    return pairs, groups(pairs)


def one_to_one(pairs, chosen):
    return all(len(np.unique(side[chosen])) == chosen.sum() for side in (pairs.i, pairs.j))


@pytest.mark.parametrize("seed", range(4))
def test_nearest_takes_each_records_nearest_candidate(seed):
    pairs, _ = scene(seed)
    for source, side in ((1, pairs.i), (2, pairs.j)):
        chosen = nearest(pairs, source=source)
        for record in np.unique(side):
            mine = np.flatnonzero(side == record)
            assert np.flatnonzero(chosen & (side == record)) == [mine[np.argmin(pairs.mahalanobis_sq[mine])]]
    both = mutual_nearest(pairs)
    assert one_to_one(pairs, both) and both.any()
    # Mutual nearest neighbours: exactly the pairs nearer than all others of both records.
    for e in range(len(pairs)):
        rivals = (pairs.i == pairs.i[e]) | (pairs.j == pairs.j[e])
        assert both[e] == (pairs.mahalanobis_sq[e] == pairs.mahalanobis_sq[rivals].min())


def test_nearest_may_match_one_record_twice():
    pairs = Radius(9.0)(Records.of([[0.0], [1.0]], sigma=1.0), Records.of([[0.4]], sigma=1.0))
    assert nearest(pairs).sum() == 2 and mutual_nearest(pairs).sum() == 1


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("seed", range(6))
def test_most_pairs_is_the_largest_set_with_the_least_sum(seed):
    pairs, grouped = scene(seed, n1=7 + seed % 3, n2=6)
    chosen = most_pairs(pairs, grouped)
    assert one_to_one(pairs, chosen)
    distance = dict(zip(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True), pairs.mahalanobis_sq, strict=True))
    size = least = 0.0
    for rows_1, rows_2, local in components_of(len(pairs.first), len(pairs.second), distance):
        per_k = naive.best_per_k(len(rows_1), len(rows_2), {edge: -x for edge, x in local.items()})
        most = max(k for k, total in enumerate(per_k) if total > -np.inf)
        size, least = size + most, least - per_k[most]
    assert chosen.sum() == size
    assert pairs.mahalanobis_sq[chosen].sum() == pytest.approx(least, rel=1e-9)


@pytest.mark.slow
def test_most_pairs_matches_all_records_of_the_smaller_source_if_possible():
    pairs, grouped = scene(3, gate=30.0)
    assert len(grouped) == 1 and most_pairs(pairs, grouped).sum() == 9
    nothing = Radius(1.0)(Records.of([0.0], sigma=1.0), Records.of([100.0], sigma=1.0))
    assert most_pairs(nothing, groups(nothing)).shape == nearest(nothing).shape == (0,)


# ---- independent classification ----


@pytest.mark.parametrize("loss", [Loss(1, 1, 1), Loss(), Loss(5.0, 1.0, 2.0), Loss(0.2, 3.0)])
def test_classification_is_the_average_risk_of_the_paper(loss):
    """z_j = −Σ_k P(k) Π_kj f_k with the full matrix; the last column is no partner."""
    swapped = loss.wrong + loss.missed if loss.swapped is None else loss.swapped
    named = left = 0
    for seed in range(4):
        pairs, _ = scene(seed, gate=1.5)
        log_odds = np.random.default_rng(seed).normal(0, 3, len(pairs))
        chosen = classified(pairs, log_odds, loss)
        for record in range(len(pairs.first)):
            mine = np.flatnonzero(pairs.i == record)
            n = len(mine)
            matrix = np.full((n + 1, n + 1), float(swapped))
            matrix[n, :], matrix[:, n] = loss.wrong, loss.missed
            np.fill_diagonal(matrix, 0.0)
            z = -np.append(np.exp(log_odds[mine]), 1.0) @ matrix
            expected = mine[[np.argmax(z)]] if np.argmax(z) < n else []
            assert np.flatnonzero(chosen & (pairs.i == record)).tolist() == list(expected)
            named, left = named + len(expected), left + (n > 0 and not len(expected))
    assert named > 5 and left > 0


def test_classification_accepts_losses_per_candidate():
    pairs = Radius(9.0)(Records.of([[0.0]], sigma=1.0), Records.of([[0.4], [0.6]], sigma=1.0))
    log_odds = np.array([1.0, 0.5])
    assert classified(pairs, log_odds).tolist() == [True, False]
    assert classified(pairs, log_odds, Loss([50.0, 0.2], 1.0)).tolist() == [False, True]
    assert classified(pairs, log_odds, Loss([50.0, 50.0], 1.0)).tolist() == [False, False]


def test_classification_does_not_overflow():
    pairs, _ = scene(1)
    assert classified(pairs, np.full(len(pairs), 900.0)).sum() == len(np.unique(pairs.i))
    assert not classified(pairs, np.full(len(pairs), -900.0)).any()


# ---- enumeration ----


@pytest.mark.parametrize("draw", DRAWS)
@pytest.mark.parametrize("prior", [PerPair(0.3), CommonObjects(0.2, 0.3), CommonObjects(0.2, 0.3, linear=True)])
def test_enumeration_agrees_with_assignment(prior, draw):
    rng = np.random.default_rng(len(draw))
    n1, n2, ratios = many_blocks(rng, DRAWS[draw], blocks=8, most=3)
    pairs, grouped = laid_out(n1, n2, ratios)
    weight = np.array([ratios[edge] for edge in zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)])
    log_prior = prior(grouped.sizes_1, grouped.sizes_2)
    chosen = enumerated(grouped, weight, log_prior)
    assert one_to_one(pairs, chosen)
    best = assign(grouped, weight, log_prior)

    def score(taken):
        k = np.bincount(grouped.group, taken[grouped.order], len(grouped)).astype(int)
        slope = log_prior.slope
        prior_part = (slope * k).sum() if slope is not None else log_prior.table[log_prior.start[:-1] + k].sum()
        return weight[taken].sum() + prior_part

    other = np.empty(len(weight), bool)
    other[grouped.order] = best.chosen
    assert score(chosen) == pytest.approx(score(other), abs=1e-9)


def test_enumeration_refuses_too_many_hypotheses():
    edges = dict.fromkeys(itertools.product(range(20), range(20)), 0.0)
    _, grouped = laid_out(20, 20, edges)
    with pytest.raises(InputError, match=r"group 0 of 20 and 20 records has up to .*e.\d+ hypotheses; use sameas"):
        enumerated(grouped, np.zeros(400), PerPair(0.0)(grouped.sizes_1, grouped.sizes_2))


@pytest.mark.parametrize("n1, n2", [(1, 1), (2, 3), (4, 4), (0, 3)])
def test_the_number_of_hypotheses_is_counted(n1, n2):
    everything = list(naive.hypotheses(n1, n2, itertools.product(range(n1), range(n2))))
    assert number_of_hypotheses(n1, n2) == len(everything)


def test_invalid_options_are_refused_with_a_clear_message():
    pairs, _ = scene(0)
    with pytest.raises(InputError, match="source is 3; give 1 or 2"):
        nearest(pairs, source=3)
    with pytest.raises(InputError, match=r"log_odds has shape \(3,\); give"):
        classified(pairs, np.zeros(3))
