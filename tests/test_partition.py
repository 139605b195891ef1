"""The best partition is exact also where the linear relaxation is fractional and sets were pruned."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

from sameas.kernels import packing, partitions
from sameas.many.identify import identify_many
from sameas.many.marginals import EXACT, MAX_RECORDS, best_partition, best_sets, incidence_of, sum_pruned_groups
from sameas.many.rules import PoissonObjects
from sameas.many.sets import TUNING, Sets
from sameas.records import Records


def random_sets(rng, per_source=9, triples=50):
    """One group: single records of three sources, and random sets of three of about equal weight."""
    n = 3 * per_source
    drawn = np.unique(rng.integers(0, per_source, (triples, 3)), axis=0) + per_source * np.arange(3)
    alone = np.full((n, 3), -1)
    alone[np.arange(n), np.arange(n) // per_source] = np.arange(n)
    members = np.concatenate([alone, drawn])
    weight = np.concatenate([np.zeros(n), rng.uniform(4.0, 6.0, len(drawn))])
    size = (members >= 0).sum(axis=1)
    group = np.zeros(len(members), np.int64)
    return Sets(members, size, weight, group, np.array([0, len(members)]), np.array([-np.inf])), n


def direct(sets, n, whole):
    """The greatest weight of disjoint sets, by one integer programme over all sets."""
    incidence, ones = incidence_of(sets, n), np.ones(len(sets))
    if not whole:
        return -linprog(-sets.log_weight, A_ub=incidence, b_ub=np.ones(n)).fun
    constraint = LinearConstraint(incidence, -np.inf, 1.0)
    options = {"mip_rel_gap": 0.0}
    return -milp(-sets.log_weight, constraints=constraint, integrality=ones, bounds=Bounds(0, 1), options=options).fun


@pytest.mark.slow
def test_the_partition_is_optimal_where_the_relaxation_is_fractional():
    broken = 0
    for seed in range(12):
        sets, n = random_sets(np.random.default_rng(seed))
        best = direct(sets, n, whole=True)
        broken += direct(sets, n, whole=False) > best + 1e-6
        found = best_partition(sets, n)
        taken = incidence_of(sets, n)[:, found.chosen].sum(axis=1)
        assert (taken == 1).all()
        assert sets.log_weight[found.chosen].sum() == pytest.approx(best, abs=1e-6)
        assert found.gap[0] == 0.0
        # The duals bound every set; their slack is the duality gap.
        assert found.dual[sets.members[n:]].sum(axis=1) == pytest.approx(
            np.maximum(found.dual[sets.members[n:]].sum(axis=1), sets.log_weight[n:]), abs=1e-6
        )
        assert found.dual.sum() - found.slack[0] == pytest.approx(best, abs=1e-6)
    assert broken >= 3


@pytest.mark.parametrize("seed", range(4))
def test_sets_that_duals_prove_improbable_change_no_probability(seed):
    sets, n = random_sets(np.random.default_rng(seed), per_source=6, triples=30)
    every = np.ones(1, bool)
    whole = sum_pruned_groups(sets, n, every, replace(TUNING, small=n))
    pruned = sum_pruned_groups(sets, n, every, replace(TUNING, small=0))
    assert (whole[2] >= EXACT).all() and (pruned[2] >= EXACT).all()
    np.testing.assert_allclose(pruned[0], whole[0], rtol=0.0, atol=1e-10)
    assert (pruned[1] == whole[1]).all()
    assert sets.log_weight[pruned[1]].sum() == pytest.approx(direct(sets, n, whole=True), abs=1e-6)
    # With few steps allowed, the sum omits more sets, reports it, and still contains the best partition.
    short = sum_pruned_groups(sets, n, every, replace(TUNING, small=0, block_steps=300))
    if short[2][0] >= 0.0:
        assert short[2][0] < EXACT and (short[1] == whole[1]).all()


def test_groups_of_three_records_summed_by_enumeration_agree_with_the_general_sum():
    rng = np.random.default_rng(5)
    every = np.array([[0, -1, -1], [-1, 1, -1], [-1, -1, 2], [0, 1, -1], [0, -1, 2], [-1, 1, 2], [0, 1, 2]])
    members, group = [], []
    for which in range(2**4):
        several = np.array([True] * 3 + [bool(which >> k & 1) for k in range(4)])
        members.append(np.where(every[several] >= 0, every[several] + 3 * which, -1))
        group += [which] * int(several.sum())
    members, group = np.concatenate(members), np.array(group)
    size = (members >= 0).sum(axis=1)
    start = np.searchsorted(group, np.arange(17))
    for spread in (1.0, 10.0, 400.0):
        weight = np.where(size > 1, spread * rng.standard_normal(len(size)), 0.0)
        sets = Sets(members, size, weight, group, start, np.full(16, -np.inf))
        few, general = (sum_pruned_groups(sets, 48, np.ones(16, bool), replace(TUNING, small=n)) for n in (8, 2))
        np.testing.assert_allclose(few[0], general[0], rtol=1e-12, atol=1e-14)
        assert (few[1] == general[1]).all() and (few[2] >= EXACT).all()
    # The choice between two tied partitions does not depend on the method.
    equal = Sets(members, size, np.zeros(len(size)), group, start, np.full(16, -np.inf))
    few, general = (sum_pruned_groups(equal, 48, np.ones(16, bool), replace(TUNING, small=n)) for n in (8, 2))
    np.testing.assert_allclose(few[0], general[0], rtol=1e-12)
    assert (few[1] == general[1]).all()


def test_the_best_partition_of_possible_sets_is_found_with_and_without_block_sums():
    for seed in range(3):
        sets, n = random_sets(np.random.default_rng(seed), per_source=6, triples=30)
        share, chosen, _ = sum_pruned_groups(sets, n, np.ones(1, bool), TUNING)
        tilted = replace(sets, log_weight=sets.log_weight + 0.5 * (sets.size - 1) * (np.arange(len(sets)) % 3 == 0))
        for tuning in (TUNING, replace(TUNING, small=0, cuts=(30.0,), block_steps=1)):
            best = best_sets(tilted, n, share > 0.0, tuning=tuning)
            assert (incidence_of(sets, n)[:, best].sum(axis=1) == 1).all()
            assert tilted.log_weight[best].sum() == pytest.approx(direct(tilted, n, whole=True), abs=1e-6)
            assert tilted.log_weight[best].sum() >= tilted.log_weight[chosen].sum() - 1e-9
    # Impossible sets are never chosen, and records outside all sets stay unchanged.
    here = np.flatnonzero(chosen)[:2]
    some = best_sets(sets, n, np.isin(np.arange(len(sets)), here))
    assert np.flatnonzero(some).tolist() == here.tolist()


def test_annealed_duals_agree_with_the_relaxation():
    for seed in range(3):
        sets, n = random_sets(np.random.default_rng(seed), per_source=6, triples=30)
        begin = np.concatenate([[0], np.cumsum(sets.size)])
        entry = sets.members[sets.members >= 0]
        dual = np.full(n, sets.log_weight.max())
        chosen = packing.anneal(begin, entry, sets.log_weight, packing.ANNEALINGS[-1], dual)
        assert (np.add.reduceat(dual[entry], begin[:-1]) >= sets.log_weight - 1e-9).all()
        best = direct(sets, n, whole=False)
        assert best - 1e-6 <= dual.sum() <= best + 0.01 * n
        assert sets.log_weight[chosen].sum() <= best + 1e-6


def test_a_group_of_more_records_than_a_sum_can_hold_is_summed_without_improbable_sets():
    rng = np.random.default_rng(3)
    place = np.sort(rng.uniform(0.0, 200.0, 60))
    sources = [
        Records.of(np.column_stack([place, np.zeros(60)]) + rng.standard_normal((60, 2)), sigma=1.0, source=name)
        for name in ("one", "two", "three")
    ]
    found = identify_many(sources, rule=PoissonObjects(0.1, 0.1))
    widest = int(np.argmax(found.pooled.sizes))
    assert found.pooled.sizes[widest] > MAX_RECORDS
    assert found.groups.cut[widest] in TUNING.cuts
    total = np.zeros(len(found.pooled))
    at, record = found.sets.entries()
    np.add.at(total, record, found.answer.probability[at])
    np.testing.assert_allclose(total, 1.0, atol=1e-9)


def by_samples(sets, n, chosen):
    share = np.zeros(len(sets))
    groups = np.arange(len(sets.start) - 1)
    partitions.set_samples(groups, sets.start, sets.members, sets.log_weight, chosen, n, share)
    return share


@pytest.mark.slow
def test_samples_agree_with_the_sum():
    apart = []
    for seed in range(12):
        sets, n = random_sets(np.random.default_rng(seed), per_source=6, triples=10)
        # Where sets of three have no parts, all three records are single in between, which takes long where they are
        # much more probable than that.
        sets = replace(sets, log_weight=0.4 * sets.log_weight)
        exact, chosen, cut = sum_pruned_groups(sets, n, np.ones(1, bool))
        assert cut[0] >= EXACT
        sampled = by_samples(sets, n, chosen)
        total = np.bincount(sets.entries()[1], sampled[sets.entries()[0]], n)
        np.testing.assert_allclose(total, 1.0, atol=1e-9)
        apart.append(sampled - exact)
    assert np.abs(np.concatenate(apart)).max() < 0.1
    assert np.sqrt(np.mean(np.concatenate(apart) ** 2)) < 0.02
    chain = np.array([[0, -1], [-1, 1], [2, -1], [-1, 3], [0, 1], [2, 1], [2, 3]])
    weight = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.5, -12.0])
    sets = Sets(chain, (chain >= 0).sum(axis=1), weight, np.zeros(7, np.int64), np.array([0, 7]), np.array([-np.inf]))
    exact, chosen, _ = sum_pruned_groups(sets, 4, np.ones(1, bool))
    sampled = by_samples(sets, 4, chosen)
    np.testing.assert_allclose(sampled, exact, atol=0.01)
    # Sets the chain rarely visits keep a probability above 0.
    assert 0.01 * exact[6] < sampled[6] < 10.0 * exact[6]


def couples(rng, n=4):
    """One group of n couples of objects 25 m apart, observed by three sources with few misses."""
    place = np.repeat(np.arange(n)[:, None] * [60.0, 0.0], 2, axis=0) + np.tile([[0.0, 0.0], [0.0, 25.0]], (n, 1))
    sources = [
        Records.of(place + sigma * rng.standard_normal((2 * n, 2)), sigma=sigma, source=name)
        for name, sigma in (("ais", 8.0), ("west", 20.0), ("east", 20.0))
    ]
    return identify_many(sources, rule=PoissonObjects(1e-5, 0.01), tuning=replace(TUNING, max_steps=3_000_000))


@pytest.mark.slow
def test_samples_agree_with_the_sum_for_certain_objects_with_exchangeable_neighbours():
    """Belief propagation converges to one of the two assignments here: rms error 0.17, largest 0.77."""
    apart = []
    for seed in range(6):
        found = couples(np.random.default_rng(seed))
        sampled = by_samples(found.sets, len(found.pooled), found.answer.chosen)
        apart.append((sampled - found.answer.probability)[found.answer.probability > 1e-3])
    assert np.sqrt(np.mean(np.concatenate(apart) ** 2)) < 0.02
    assert np.abs(np.concatenate(apart)).max() < 0.1


@pytest.mark.parametrize("n", [25, 60])
def test_indistinguishable_objects_are_not_certain(n):
    """Too many for a sum; the best partition alone would make each of its pairs certain."""
    rng = np.random.default_rng(0)
    sources = [Records.of(rng.normal(0.0, 5.0, (n, 2)), sigma=15.0, source=name) for name in ("radar", "ais")]
    found = identify_many(sources, rule=PoissonObjects(n / 2000.0, 0.1))
    total = np.zeros(len(found.pooled))
    at, record = found.sets.entries()
    np.add.at(total, record, found.answer.probability[at])
    np.testing.assert_allclose(total, 1.0, atol=1e-5)
    assert found.probability.max() < 0.2 and not found.groups.exact.any()
    paired = found.n_members == 2
    assert np.median(found.probability[paired]) == pytest.approx(1.0 / n, rel=0.3)


@pytest.mark.slow
@pytest.mark.long
def test_a_crowd_with_too_many_sets_is_not_declared_single():
    """Any floor that keeps few enough sets keeps none, and every record would be single with certainty."""
    rng = np.random.default_rng(0)
    sources = [Records.of(rng.normal(0.0, 5.0, (90, 2)), sigma=15.0, source=name) for name in ("one", "two", "three")]
    found = identify_many(sources, rule=PoissonObjects(90 / 2000.0, 0.1))
    assert not found.groups.exact.any() and found.probability.max() < 0.3


def test_bit_states_and_hash_table_states_give_the_same_sum():
    # More steps than the buffers hold at first; a neutral count prior forces the hash table.
    sets, n = random_sets(np.random.default_rng(3), per_source=8, triples=120)
    mask = np.where(sets.members >= 0, np.uint64(1) << np.maximum(sets.members, 0).astype(np.uint64), np.uint64(0))
    mask = np.bitwise_or.reduce(mask, axis=1)
    first = np.array([int(one & -one).bit_length() - 1 for one in mask.tolist()])
    order = np.argsort(first, kind="stable")
    share, chosen, cut = np.zeros(len(order)), np.zeros(len(order), bool), np.zeros(1)
    one = np.array([0]), np.array([0, len(order)])
    partitions.sum_pruned(
        *one, sets.members[order], sets.log_weight[order], n, np.array([30.0]), n, 1_000_000, np.zeros(n), share,
        chosen, cut,
    )  # fmt: skip
    sums, solved = [(share, chosen)], np.zeros(1, bool)
    share, chosen = np.zeros(len(order)), np.zeros(len(order), bool)
    partitions.eliminate(
        *one, np.array([n]), first[order], mask[order], sets.log_weight[order], sets.size[order] - 1,
        np.array([0, n + 1]), np.zeros(n + 1), 1_000_000, share, chosen, solved,
    )  # fmt: skip
    sums.append((share, chosen))
    assert solved[0] and cut[0] == 30.0
    assert (sums[0][1] == sums[1][1]).all()
    assert sums[0][0] == pytest.approx(sums[1][0], abs=1e-12)
    records = np.bitwise_and.outer(mask[order], np.uint64(1) << np.arange(n, dtype=np.uint64)) > 0
    assert sums[0][0] @ records == pytest.approx(np.ones(n), abs=1e-12)
