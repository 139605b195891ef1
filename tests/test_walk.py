"""Probabilities by a walk over partitions agree with exact sums, with and without a list of the sets."""

from dataclasses import replace

import numpy as np
import pytest

from sameas import Records
from sameas.evidence import Identity
from sameas.many.identify import identify_many
from sameas.many.observations import Region
from sameas.many.rules import PoissonObjects
from sameas.many.sets import TUNING
from sameas.many.walk import can_walk

#: Objects per unit area: two of them within their errors in each part of a crowd.
DENSITY = 0.05
#: Every group is walked.
WALKED = replace(TUNING, walked_below=np.inf)


def crowd(seed, n_sources, n, density=DENSITY, missed=0.25):
    """Sources of one crowd of n objects in the plane with errors of 1 to 2, correlated, and some false records."""
    rng = np.random.default_rng(seed)
    side = np.sqrt(n / density)
    places = side * rng.random((n, 2))
    sources = []
    for s in range(n_sources):
        seen = places[rng.random(n) > missed]
        a = rng.uniform(1.0, 2.0, (len(seen), 2))
        covariance = a[:, :, None] * np.array([[1.0, 0.3], [0.3, 1.0]]) * a[:, None, :]
        errors = np.linalg.cholesky(covariance) @ rng.standard_normal((len(seen), 2, 1))
        sources.append(Records.of(seen + errors[:, :, 0], covariance=covariance, source=f"s{s}"))
    return sources


def both(sources, **arguments):
    """The objects by sums, and by the walk in every group."""
    by_sums = identify_many(sources, tuning=replace(TUNING, max_steps=10**7, block_steps=10**7), **arguments)
    return by_sums, identify_many(sources, tuning=WALKED, **arguments)


def apart(by_sums, by_walk):
    """Differences of the probabilities of all sets of two results; those of the second alone are 0 in the first."""
    codes = np.random.default_rng(1).integers(0, 1 << 60, len(by_sums.pooled) + 1)
    codes[-1] = 0
    keys = [codes[found.sets.members].sum(axis=1) for found in (by_sums, by_walk)]
    known = dict(zip(keys[0].tolist(), by_sums.answer.probability.tolist(), strict=True))
    assert set(known) <= set(keys[1].tolist())
    return by_walk.answer.probability - np.array([known.get(key, 0.0) for key in keys[1].tolist()])


@pytest.mark.parametrize(("n_sources", "n"), [(2, 12), (3, 8), (4, 5), (6, 3)])
def test_the_walk_agrees_with_the_sum(n_sources, n):
    for seed in range(3):
        rule = PoissonObjects(DENSITY, 0.25, [0.02] * n_sources)
        by_sums, by_walk = both(crowd(seed, n_sources, n), rule=rule)
        assert (by_sums.groups.cut >= 10.0).all()
        difference = apart(by_sums, by_walk)
        assert np.abs(difference).max() < 0.03
        assert np.sqrt(np.mean(difference[by_walk.answer.probability > 0.01] ** 2)) < 0.008
        np.testing.assert_array_equal(by_walk.members, by_sums.members)


def test_the_walk_knows_where_objects_are():
    region = Region(centre=np.array([5.0, 5.0]), spread=np.array([4.0, 4.0]))
    sources = crowd(1, 3, 7)
    by_sums, by_walk = both(sources, rule=PoissonObjects(DENSITY, 0.25), region=region)
    assert np.abs(apart(by_sums, by_walk)).max() < 0.03
    without = identify_many(sources, rule=PoissonObjects(DENSITY, 0.25))
    assert np.abs(without.answer.probability.sum() - by_walk.answer.probability.sum()) > 0.05


def test_sets_that_are_not_listed_count(monkeypatch):
    """Probabilities were those given the listed sets: too high where these are few."""
    few = replace(TUNING, max_sets=20, near_cost=1.0, near_breadth=1)
    listed_only, walks, exact = [], [], []
    for seed in range(4):
        sources, rule = crowd(seed, 5, 5), PoissonObjects(DENSITY, 0.25)
        whole = identify_many(sources, rule=rule)
        by_walk = identify_many(sources, rule=rule, tuning=few)
        monkeypatch.setattr("sameas.many.identify.can_walk", lambda *_: False)
        listed = identify_many(sources, rule=rule, tuning=few)
        monkeypatch.undo()
        assert np.isinf(listed.groups.floor).any()
        np.testing.assert_array_equal(listed.members, by_walk.members)
        same = (by_walk.members[:, None].filled(-1) == whole.members[None].filled(-1)).all(axis=2)
        at, of = np.nonzero(same)
        exact += whole.probability[of].tolist()
        walks += by_walk.probability[at].tolist()
        listed_only += listed.probability[at].tolist()
        total = np.bincount(by_walk.sets.entries()[1], by_walk.answer.probability[by_walk.sets.entries()[0]])
        np.testing.assert_allclose(total, 1.0, atol=0.15)
    assert np.abs(np.subtract(walks, exact)).max() < 0.03
    assert np.sum(listed_only) > np.sum(exact) + 0.5


def test_rules_of_pairs_are_not_walked():
    sources = crowd(2, 3, 6)
    named = Identity({source.source: {"icao": [f"4b18{k:02}" for k in range(len(source))]} for source in sources})
    for rule, walks in ((PoissonObjects(DENSITY, 0.25), True), (PoissonObjects(DENSITY, 0.25) + named, False)):
        found = identify_many(sources, rule=rule)
        assert found.terms is not None and can_walk(found.pooled, found.terms) is walks


def test_the_order_of_sources_changes_nothing():
    sources, rule = crowd(3, 4, 6), PoissonObjects(DENSITY, 0.25)
    one, two = (identify_many(given, rule=rule, tuning=WALKED) for given in (sources, sources[::-1]))
    np.testing.assert_array_equal(one.probability, two.probability)
