"""Groups of more sets than can be listed, which have those near a good partition instead."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from benchmarks.many import right_objects, scene

from sameas import CloseObjects, Objects, PoissonObjects, Records, identify_many
from sameas.gate import DEFAULT_GATE
from sameas.many.near_sets import near_sets
from sameas.many.pooled import pooled
from sameas.many.rules import MissedObjects, terms_of
from sameas.many.sets import ManyTuning, candidate_sets

#: Probability of a miss.
MISSED = 0.2


def value(found: Objects) -> float:
    """ln w of the partition."""
    return float(found.sets.log_weight[found.answer.chosen].sum())


def by_records(found: Objects) -> dict[tuple[int, ...], float]:
    """The probability of every candidate set."""
    return dict(zip(map(tuple, found.sets.members.tolist()), found.answer.probability.tolist(), strict=True))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n_sources", [3, 5])
def test_sets_near_a_partition_give_the_answer_of_all_sets(n_sources, seed):
    rng = np.random.default_rng(seed)
    sources, _, _ = scene(rng, n_sources, 24, 0.05, MISSED)
    rule = PoissonObjects(24.0, 0.2)
    whole = identify_many(sources, rule=rule)
    near = identify_many(sources, rule=rule, tuning=ManyTuning(max_sets=12))
    assert not whole.groups.gap.any() and (near.groups.floor == np.inf).any()
    assert value(near) == pytest.approx(value(whole), abs=1e-6)
    p, missing = by_records(near), 0.0
    for members, expected in by_records(whole).items():
        missing = max(missing, abs(p.get(members, 0.0) - expected))
    assert missing < 1e-3


@pytest.mark.long
def test_twelve_sources_of_which_objects_have_too_many_subsets_give_the_objects():
    """Formerly 452 objects were found where there were 100, and none of them was right."""
    right, stated = 0, 0.0
    for seed in range(3):
        made = scene(np.random.default_rng(seed), 12, 40, 0.05, MISSED)
        sources, objects, _ = made
        found = identify_many(sources, rule=PoissonObjects(40.0, 0.2), tuning=ManyTuning(max_sets=20_000))
        near = found.groups.floor == np.inf
        assert near.any() and not found.groups.exact[near].any()
        right += right_objects(made, np.ma.filled(found.members, -1))
        stated += float(found.probability.sum())
        assert value(found) >= true_value(found, objects) - 1e-6
    assert right > 90 and stated == pytest.approx(right, abs=8.0)


@pytest.mark.parametrize("close", [0.05, pytest.param(0.2, marks=pytest.mark.long)])
@pytest.mark.long
def test_the_partition_of_twenty_sources_is_at_least_as_probable_as_the_true_one(close):
    """Merging clusters alone ends with two objects of many records in three clusters, e⁷⁰ times less probable."""
    sources, objects, _ = scene(np.random.default_rng(3), 20, 30, close, MISSED)
    found = identify_many(sources, rule=PoissonObjects(30.0, 0.2), tuning=ManyTuning(max_sets=2_000))
    assert value(found) >= true_value(found, objects) - 1e-6


@pytest.mark.long
def test_objects_that_sit_in_fewer_clusters_are_divided():
    """Merging and assigning alone end with the twelve objects in eleven clusters, e³⁷ times less probable."""
    sources, objects, _ = scene(np.random.default_rng(0), 20, 12, 0.4, MISSED)
    found = identify_many(sources, rule=PoissonObjects(12.0, 0.2), tuning=ManyTuning(max_sets=2_000))
    assert len(found) == 12 and value(found) >= true_value(found, objects)


def test_a_source_without_records_in_a_group_of_too_many_sets():
    sources, _, _ = scene(np.random.default_rng(2), 4, 12, 0.05, MISSED)
    far = Records.of([[50.0, 50.0]], sigma=0.01, source="far")
    with_far = identify_many([*sources, far], rule=PoissonObjects(12.0, 0.2), tuning=ManyTuning(max_sets=12))
    assert (with_far.groups.floor == np.inf).any() and len(with_far) == 13


def true_value(found: Objects, objects: list[np.ndarray]) -> float:
    """ln w of the true partition."""
    terms, records = found.terms, found.pooled
    assert terms is not None
    together: dict[int, list[int]] = {}
    for s, source in enumerate(records.sources):
        assert isinstance(source, Records)
        for at, row in enumerate(source.rows.tolist()):
            together.setdefault(int(objects[records.given[s]][row]), []).append(int(records.start[s]) + at)
    several = [np.array([members]) for members in together.values() if len(members) > 1]
    return float(sum(terms.linear_of(one)[0] + records.log_joint(one)[0] for one in several))


@pytest.mark.long
def test_the_order_of_many_sources_changes_nothing():
    rng = np.random.default_rng(5)
    sources, _, _ = scene(rng, 10, 30, 0.05, MISSED)
    tuning = ManyTuning(max_sets=500)
    first = identify_many(sources, rule=PoissonObjects(30.0, 0.2), tuning=tuning)
    turn = rng.permutation(len(sources))
    again = identify_many([sources[s] for s in turn], rule=PoissonObjects(30.0, 0.2), tuning=tuning)
    back = np.ma.filled(again.members, -1)[:, np.argsort(turn)]
    expected = dict(zip(map(tuple, np.ma.filled(first.members, -1).tolist()), first.probability.tolist(), strict=True))
    assert dict(zip(map(tuple, back.tolist()), again.probability.tolist(), strict=True)) == expected


@pytest.mark.parametrize("rule", [PoissonObjects(30.0, 0.2), CloseObjects(0.02, 0.2)])
def test_near_sets_include_their_partition_and_weigh_what_all_sets_weigh(rule: Any):
    sources, _, _ = scene(np.random.default_rng(8), 4, 30, 0.1, MISSED)
    prior = MissedObjects(0.2)
    together = pooled(sources, DEFAULT_GATE)
    terms = terms_of(rule, prior, together) if isinstance(rule, CloseObjects) else rule.terms(together)
    near = near_sets(together, terms, np.ones(len(together.sizes), bool), 20.0, 4)
    listed = candidate_sets(together, terms)
    weight = dict(zip(map(tuple, listed.members.tolist()), listed.log_weight.tolist(), strict=True))
    for members, log_weight in zip(near.members.tolist(), near.log_weight.tolist(), strict=True):
        assert weight[tuple(members)] == pytest.approx(log_weight, abs=1e-9)
    covered = np.sort(near.partition[near.partition >= 0])
    np.testing.assert_array_equal(covered, np.arange(len(together)))
    found = set(map(tuple, near.members.tolist()))
    assert all(tuple(members) in found for members in near.partition.tolist() if sum(m >= 0 for m in members) > 1)


def test_a_count_prior_with_sets_near_a_partition():
    sources, _, _ = scene(np.random.default_rng(3), 4, 10, 0.1, MISSED)
    arguments: dict[str, Any] = {"rule": CloseObjects(0.02, 0.4), "prior": MissedObjects(0.2)}
    whole = identify_many(sources, **arguments)
    near = identify_many(sources, **arguments, tuning=ManyTuning(max_sets=12))
    assert np.isinf(near.groups.gap).any()
    assert set(map(tuple, np.ma.filled(near.members, -1))) == set(map(tuple, np.ma.filled(whole.members, -1)))
    np.testing.assert_allclose(near.probability.sum(), whole.probability.sum(), rtol=0.02)
