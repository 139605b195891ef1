"""Metrics of a picture: against enumeration, against Stone Soup, and on hand-counted cases."""

from __future__ import annotations

import datetime
import itertools
import math
from typing import Any

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.score.picture import (
    FALSE,
    Identities,
    gospa,
    majority_votes,
    mean_gospa,
    nearest_match,
    nees,
    pair_score,
    siap,
)


def table(seed: int, instants: int = 6, objects: int = 5, sources: int = 3) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """A random picture: every source detects most objects, one in five is misassigned, some records are false."""
    rng = np.random.default_rng(seed)
    rows, true = [], []
    for t, s in itertools.product(range(instants), range(sources)):
        shown = np.flatnonzero(rng.random(objects) < 0.8)
        assigned = np.where(rng.random(len(shown)) < 0.2, shown + 1, shown) % objects
        _, first = np.unique(assigned, return_index=True)
        rows += [(t, f"s{s}", int(k)) for k in assigned[first]]
        true += [FALSE if rng.random() < 0.1 else int(k) for k in shown[first]]
    time_s, source, number = zip(*rows, strict=True)
    return {"time_s": np.array(time_s, float), "source": np.array(source), "object": np.array(number)}, np.array(true)


def counted(records: dict[str, np.ndarray], true: np.ndarray) -> tuple[int, int, int]:
    """Numbers of reported, true and correct pairs, counted one by one."""
    told_pairs = true_pairs = right = 0
    for a, b in itertools.combinations(range(len(true)), 2):
        if records["time_s"][a] != records["time_s"][b] or records["source"][a] == records["source"][b]:
            continue
        assigned, same = records["object"][a] == records["object"][b], true[a] == true[b] != FALSE
        told_pairs, true_pairs, right = told_pairs + assigned, true_pairs + same, right + (assigned and same)
    return told_pairs, true_pairs, right


@pytest.mark.parametrize("seed", range(8))
def test_pairs_agree_with_the_definition(seed: int) -> None:
    records, true = table(seed)
    found = pair_score(Identities.of(records, true)).pairs
    assert (found.n_claimed, found.n_true, found.n_right) == counted(records, true)


def test_the_order_of_rows_and_the_names_of_sources_change_nothing() -> None:
    records, true = table(3)
    shuffled = np.random.default_rng(1).permutation(len(true))
    other = {name: column[shuffled] for name, column in records.items()} | {"source": records["source"][shuffled]}
    one, two = Identities.of(records, true), Identities.of(other, true[shuffled])
    assert pair_score(one).pairs == pair_score(two).pairs and siap(one) == siap(two)


def test_a_perfect_picture() -> None:
    records, true = table(4)
    honest = true != FALSE
    identities = Identities.of({k: v[honest] for k, v in records.items()} | {"object": true[honest] + 7}, true[honest])
    score, found = pair_score(identities), siap(identities)
    assert score.pairs.f1 == 1.0 and score.share_right == 1.0
    assert (found.completeness, found.ambiguity, found.spuriousness, found.switches) == (1.0, 1.0, 0.0, 0)
    assert found.continuity == 1.0 and found.number_changes_per_hour == 0.0


def test_an_instant_is_correct_only_with_all_records() -> None:
    records: dict[str, Any] = {"time_s": [0, 0, 1, 1], "source": ["a", "b", "a", "b"], "object": [1, 1, 1, 2]}
    assert pair_score(Identities.of(records, [5, 5, 5, 5])).right.tolist() == [True, False]
    assert pair_score(Identities.of(records, [5, 5, 5, FALSE])).right.tolist() == [True, True]


def test_a_record_in_two_objects_is_an_extra_pair() -> None:
    records: dict[str, Any] = {"time_s": [0, 0, 0], "source": ["a", "b", "b"], "object": [1, 1, 1]}
    found = pair_score(Identities.of(records, [5, 5, 6])).pairs
    assert (found.n_claimed, found.n_true, found.n_right) == (2, 1, 1)


def test_a_track_and_its_successor_make_one_true_pair() -> None:
    records: dict[str, Any] = {"time_s": [0, 0, 0], "source": ["a", "b", "b"], "object": [1, 1, 2]}
    found = pair_score(Identities.of(records, [5, 5, 5])).pairs
    assert (found.n_claimed, found.n_true, found.n_right) == (1, 1, 1)


def test_records_without_an_object_are_alone() -> None:
    numbers = np.ma.MaskedArray([1, 1, 3, 3], [False, False, True, True])
    records: dict[str, Any] = {"time_s": [0, 0, 1, 1], "source": ["a", "b", "a", "b"], "object": numbers}
    found = pair_score(Identities.of(records, [0, 0, 0, 0])).pairs
    assert (found.n_claimed, found.n_true, found.n_right) == (1, 2, 1)


def test_false_records_are_never_a_true_pair() -> None:
    records: dict[str, Any] = {"time_s": [0, 0], "source": ["a", "b"], "object": [1, 1]}
    found = pair_score(Identities.of(records, [FALSE, FALSE])).pairs
    assert (found.n_claimed, found.n_true, found.n_right) == (1, 0, 0)


def test_an_object_represents_the_majority_of_its_records() -> None:
    records: dict[str, Any] = {"time_s": [0] * 7, "source": list("abcabab"), "object": [1, 1, 1, 2, 2, 3, 3]}
    found = majority_votes(Identities.of(records, [4, 4, 9, 4, 9, FALSE, FALSE]))
    assert dict(zip(found.assigned.tolist(), found.true.tolist(), strict=True)) == {1: 4, 2: FALSE, 3: FALSE}


def test_only_necessary_switches_are_counted() -> None:
    # Number 2 begins while 1 still exists: no switch until 1 has ended.
    records: dict[str, Any] = {"time_s": [0, 1, 1, 2, 3], "source": list("aabaa"), "object": [1, 1, 2, 2, 1]}
    found = siap(Identities.of(records, [0, 0, 0, 0, 0]))
    assert found.switches == 2 and found.ambiguity == 5 / 4 and found.continuity == 3 / 4
    assert found.number_changes_per_hour == pytest.approx(2 / (4 / 3600.0))


def test_continuity_counts_uncovered_time() -> None:
    records: dict[str, Any] = {"time_s": [0, 1, 1, 2], "source": list("aaba"), "object": [1, 1, 1, 1]}
    # At instant 1 the two records are of two objects, so it represents none.
    found = siap(Identities.of(records, [0, 0, 3, 0]))
    assert found.completeness == 2 / 4 and found.continuity == 2 / 4 and found.spuriousness == 1 / 3


def test_completeness_ambiguity_and_spuriousness_agree_with_stone_soup() -> None:
    pytest.importorskip("stonesoup", reason="the extra sameas[study] is not installed")
    from stonesoup.measures import Euclidean
    from stonesoup.metricgenerator.manager import MultiManager
    from stonesoup.metricgenerator.tracktotruthmetrics import SIAPMetrics
    from stonesoup.types.association import AssociationSet, TimeRangeAssociation
    from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
    from stonesoup.types.state import GaussianState
    from stonesoup.types.time import TimeRange
    from stonesoup.types.track import Track

    records, true = table(11)
    identities = Identities.of(records, true)
    begin = datetime.datetime(2026, 1, 1)

    def when(t: float) -> datetime.datetime:
        return begin + datetime.timedelta(seconds=float(t))

    stands = majority_votes(identities)
    shown = {(t, k) for t, k in zip(identities.time_s, identities.true, strict=True) if k != FALSE}
    truths = {
        k: GroundTruthPath([GroundTruthState([0.0, 0.0], timestamp=when(t)) for t, j in sorted(shown) if j == k])
        for k in {k for _, k in shown}
    }
    tracks = {
        k: Track(
            [GaussianState([[0.0], [0.0]], np.eye(2), timestamp=when(t)) for t in stands.time_s[stands.assigned == k]]
        )
        for k in np.unique(stands.assigned).tolist()
    }
    associations = AssociationSet({
        TimeRangeAssociation({tracks[assigned], truths[k]}, TimeRange(when(t - 0.2), when(t + 0.2)))
        for t, assigned, k in zip(stands.time_s, stands.assigned.tolist(), stands.true.tolist(), strict=True)
        if k != FALSE
    })  # fmt: skip
    manager = MultiManager([])
    manager.association_set = associations
    manager.states_sets = {"groundtruth_paths": set(truths.values()), "tracks": set(tracks.values())}
    theirs = {
        metric.title: metric.value
        for metric in SIAPMetrics(Euclidean((0, 1)), Euclidean((0, 1))).compute_metric(manager)
    }
    ours = siap(identities)
    assert ours.completeness == pytest.approx(theirs["SIAP Completeness"])
    assert ours.ambiguity == pytest.approx(theirs["SIAP Ambiguity"])
    assert ours.spuriousness == pytest.approx(theirs["SIAP Spuriousness"])


def test_nees_of_consistent_covariances_is_the_dimension() -> None:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(4000, 2, 2)) + 2.0 * np.eye(2)
    spread = root @ root.transpose(0, 2, 1)
    off = np.einsum("nvw,nw->nv", root, rng.normal(size=(4000, 2)))
    honest = nees(off, spread, np.zeros((4000, 2)))
    assert honest.low < honest.mean < honest.high and honest.low < 2.0 < honest.high
    assert abs(honest.median / honest.median_due - 1.0) < 0.1
    assert nees(off, spread / 4.0, np.zeros((4000, 2))).mean == pytest.approx(4.0 * honest.mean)


def test_unknown_states_are_excluded() -> None:
    found = nees([[1.0, 0.0], [np.nan, 0.0]], [np.eye(2)] * 2, np.zeros((2, 2)))
    assert (found.n, found.mean) == (1, 1.0)
    assert math.isnan(nees(np.empty((0, 2)), np.empty((0, 2, 2)), np.empty((0, 2))).mean)


def test_mean_gospa_is_the_mean_over_instants() -> None:
    pictures = [(np.array([[0.0, 0.0]]), np.array([[3.0, 4.0], [90.0, 0.0]])), (np.empty((0, 2)), np.empty((0, 2)))]
    mean, parts = mean_gospa(pictures, cutoff=20.0)
    assert mean == pytest.approx(0.5 * gospa(*pictures[0], cutoff=20.0).distance) and parts[0].missed == 1


def test_refusals_say_what_to_give() -> None:
    with pytest.raises(InputError, match="no column object; give time_s, source and object"):
        Identities.of({"time_s": [0.0], "source": ["a"]}, [0])
    with pytest.raises(InputError, match="2 times for 2 objects and 1 truths"):
        Identities.of({"time_s": [0.0, 1.0], "source": ["a", "b"], "object": [1, 2]}, [0])
    with pytest.raises(InputError, match=r"give \(n, d\) and \(n, d, d\)"):
        nees([[0.0, 1.0]], [1.0], [[0.0, 0.0]])


def test_empty_pictures_give_nan() -> None:
    empty = Identities.of({"time_s": [], "source": [], "object": []}, [])
    found = siap(empty)
    assert math.isnan(pair_score(empty).pairs.f1) and math.isnan(pair_score(empty).share_right)
    assert found.switches == 0 and math.isnan(found.completeness)


def by_definition(found, true, cutoff, order):
    """The metric to the power ``order``, minimised over all one-to-one sets of pairs (definition)."""
    if len(found) > len(true):
        found, true = true, found
    best = np.inf
    for taken in itertools.permutations(range(len(true)), len(found)):
        d = np.linalg.norm(found - true[list(taken)], axis=1)
        best = min(best, float(np.sum(np.minimum(d, cutoff) ** order)))
    return best + cutoff**order / 2 * (len(true) - len(found))


def test_gospa_of_an_example_computed_by_hand():
    # One found 0.6 away, one 3 away from anything with cutoff 2, one true object missed twice over.
    score = gospa([[0.6, 0.0], [10.0, 3.0]], [[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]], cutoff=2.0)
    assert (score.missed, score.false) == (2, 1)
    assert score.localisation == pytest.approx(0.36)
    assert score.distance == pytest.approx(np.sqrt(0.36 + 2.0**2 / 2 * 3))


@pytest.mark.parametrize("order", [1.0, 2.0, 3.5])
def test_gospa_is_the_minimum_over_all_assignments(order):
    rng = np.random.default_rng(1)
    for _ in range(40):
        n, m, d = rng.integers(0, 6), rng.integers(0, 6), rng.integers(1, 4)
        found, true = rng.normal(0, 1.5, (n, d)), rng.normal(0, 1.5, (m, d))
        due = by_definition(found, true, 1.7, order)
        assert gospa(found, true, cutoff=1.7, order=order).distance ** order == pytest.approx(due, abs=1e-9)


def test_empty_sets():
    nothing = np.empty((0, 2))
    assert gospa(nothing, nothing, cutoff=1.0).distance == 0.0
    assert gospa(nothing, [[0.0, 0.0]], cutoff=2.0).distance == pytest.approx(np.sqrt(2.0))
    assert gospa([[0.0, 0.0]], nothing, cutoff=2.0).false == 1


def test_gospa_is_a_metric():
    rng = np.random.default_rng(2)
    for _ in range(30):
        a, b, c = (rng.normal(0, 2, (rng.integers(0, 5), 2)) for _ in range(3))
        one, two, three = (gospa(x, y, cutoff=2.0).distance for x, y in ((a, b), (b, c), (a, c)))
        assert three <= one + two + 1e-9
        assert gospa(b, a, cutoff=2.0).distance == pytest.approx(one, abs=1e-12)
    assert gospa(a, a, cutoff=2.0).distance == 0.0


def test_distant_clusters_are_matched_independently():
    rng = np.random.default_rng(3)
    pictures = [(rng.normal(0, 2, (5, 2)), rng.normal(0, 2, (4, 2))) for _ in range(6)]
    far = np.arange(6)[:, None, None] * np.array([1000.0, 0.0])
    rows, _, distance = nearest_match(
        np.concatenate([p[0] for p in pictures] + far.repeat(5, 1).reshape(6, 5, 2)),
        np.concatenate([p[1] for p in pictures] + far.repeat(4, 1).reshape(6, 4, 2)),
        cutoff=2.0,
    )
    alone = [gospa(found, true, cutoff=2.0).localisation for found, true in pictures]
    np.testing.assert_allclose(np.bincount(rows // 5, distance**2, 6), alone, rtol=1e-9)


@pytest.mark.parametrize(
    "found, true, keywords, words",
    [
        ([[0.0]], [[0.0]], {"cutoff": 0.0}, "cutoff is 0.0, order 2.0; give a positive distance"),
        ([[0.0]], [[0.0]], {"cutoff": 1.0, "order": 0.5}, "an order of 1 or more"),
        ([0.0, 1.0], [[0.0]], {"cutoff": 1.0}, r"shape \(2,\); give \(objects, features\)"),
        ([[0.0, 1.0]], [[0.0]], {"cutoff": 1.0}, "2 features, true ones 1"),
        ([[0.0], [np.nan]], [[0.0]], {"cutoff": 1.0}, r"a found object has no position \(first: row 1\)"),
    ],
)
def test_refusals_say_what_and_where(found, true, keywords, words):
    with pytest.raises(InputError, match=words):
        gospa(found, true, **keywords)
