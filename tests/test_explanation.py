"""An explanation states the cost of every other answer, as found by enumeration, in readable text."""

import math
from collections.abc import Callable

import numpy as np
import pytest

import naive
from problems import plane_records
from sameas import Box, CloseObjects, CommonObjects, Field, InputError, PerPair, Records, identify

PRIORS: dict[str, tuple[PerPair | CommonObjects, Callable]] = {
    "per pair": (PerPair(-0.7), lambda n1, n2: lambda k: 0.0),
    "common objects": (
        CommonObjects(0.2, 0.3),
        lambda n1, n2: lambda k: naive.common_objects_log_prior(k, n1, n2, 0.2, 0.3),
    ),
    "rare misses": (
        CommonObjects(0.01, 0.01),
        lambda n1, n2: lambda k: naive.common_objects_log_prior(k, n1, n2, 0.01, 0.01),
    ),
}


def enumerated(answer, group, log_prior):
    """All hypotheses of a group as (score, set of candidates), best first."""
    own = np.flatnonzero(answer.groups.of_pairs() == group)
    rows = [sorted(set(rows[own].tolist())) for rows in (answer.rows_1, answer.rows_2)]
    edges = {(rows[0].index(answer.rows_1[e]), rows[1].index(answer.rows_2[e])): int(e) for e in own}
    n1, n2 = map(len, rows)
    ratios = {edge: float(answer.log_odds[e]) for edge, e in edges.items()}
    listed = naive.scored_hypotheses(n1, n2, ratios, log_prior(n1, n2))
    return sorted(((score, {edges[pair] for pair in pairs}) for score, pairs in listed), key=lambda x: -x[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", PRIORS)
def test_costs_are_those_of_enumeration(name):
    prior, log_prior = PRIORS[name]
    checked = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        first, second = (plane_records(rng, 5, 2, scale=0.12, kind="full", source=s) for s in ("radar", "ais"))
        answer = identify(first, second, rule=CloseObjects(0.05, 0.5), prior=prior, gate=Box(3.0))
        for source, rows, records in ((1, answer.rows_1, first), (2, answer.rows_2, second)):
            for row in sorted(set(rows.tolist())):
                explanation = answer.explain(records.ids[row], source=source)
                every = enumerated(answer, explanation.group, log_prior)
                best = every[0][0]
                own = np.flatnonzero(rows == row)
                others = (answer.rows_2, answer.rows_1)[source - 1]
                ids = (second.ids, first.ids)[source - 1]
                expected = {
                    ids[others[e]]: best - max(score for score, pairs in every if e in pairs) for e in own.tolist()
                }
                expected[None] = best - max(score for score, pairs in every if not pairs & set(own.tolist()))
                costs = {c.id: c.cost for c in explanation.competitors}
                assert costs.keys() == expected.keys()
                for key, cost in expected.items():
                    assert costs[key] == pytest.approx(cost, abs=1e-7)
                assert sum(c.chosen for c in explanation.competitors) == 1
                assert next(c for c in explanation.competitors if c.chosen).cost == pytest.approx(0.0, abs=1e-9)
                assert sum(c.probability for c in explanation.competitors) == pytest.approx(1.0, abs=1e-9)
                assert explanation.next_best_cost == pytest.approx(best - every[1][0], abs=1e-7)
                checked += 1
                # The listed differences turn the best hypothesis into the second best, by ids.
                first_ids = {(first.ids[answer.rows_1[e]], second.ids[answer.rows_2[e]]) for e in every[0][1]}
                changed = first_ids - set(explanation.next_best[1]) | set(explanation.next_best[0])
                seconds = [
                    {(first.ids[answer.rows_1[e]], second.ids[answer.rows_2[e]]) for e in pairs}
                    for score, pairs in every[1:] if score > every[1][0] - 1e-7
                ]  # fmt: skip
                assert changed in seconds
    assert checked > 20


def simple():
    first = Records.of(
        [[0.0, 0.0], [10.0, 0.0], [50.0, 0.0], [np.nan, 0.0]], sigma=1.0, ids=["A1", "A2", "A3", "A4"], source="radar"
    )
    second = Records.of([[0.5, 0.0], [2.5, 0.0], [10.2, 0.1]], sigma=1.0, ids=[7, 8, 9], source="ais")
    return identify(first, second, rule=Field(1e-3), prior=PerPair(0.5), gate=Box(3.0))


def test_an_explanation_lists_the_candidates_and_the_next_best_identification():
    text = str(simple().explain("A1"))
    first, *rest = text.splitlines()
    assert first.startswith("radar A1 (row 0) is ais 7, probability 0.")
    assert "1 + 2 records; posterior by closed form." in rest[0]
    table = [line for line in rest if " σ " in line]
    assert len(table) == 2 and table[0].lstrip().startswith("→ 7") and "0.35 σ" in table[0]
    assert any("no partner" in line for line in rest)
    assert "position" in table[0] and "elsewhere +6.91" in table[0] and "prior +0.50" in table[0]
    assert "The next best identification of the group is" in text and "it has A1 = 8 instead of A1 = 7." in text


def test_every_kind_of_answer_has_its_text():
    answer = simple()
    assert str(answer.explain("A3")) == "radar A3 (row 2): no record of ais passes the gate; it has no partner."
    assert str(answer.explain("A4")) == "radar A4 (row 3) could not be used: no position."
    assert str(answer.explain(8, source=2)).startswith("ais 8 (row 1) has no partner, probability 0.")
    alone = answer.explain("A3").competitors
    assert len(alone) == 1 and alone[0].id is None and alone[0].probability == 1.0 and alone[0].chosen


def test_the_id_of_a_record_may_be_given_as_text():
    answer = simple()
    assert answer.explain("9", source=2).id == answer.explain(9, source=2).id == 9
    assert answer.explain(" A2 ").id == "A2"
    numbers = identify(Records.of([0.0], sigma=1.0, ids=["5"]), Records.of([0.0], sigma=1.0), rule=Field(1.0))
    assert numbers.explain(5).id == "5"


@pytest.mark.parametrize("record, source", [("B7", 1), (100, 2), ("", 1), (None, 2)])
def test_an_unknown_record_is_refused_with_examples_of_known_ids(record, source):
    known = {1: "radar has no record with the id .*; its first ids are A1, A2, A3", 2: "ais has no .* are 7, 8, 9"}
    with pytest.raises(InputError, match=known[source]):
        simple().explain(record, source=source)


def test_residuals_are_measured_from_the_explained_record():
    answer = simple()
    forth = next(c for c in answer.explain("A1").competitors if c.id == 7)
    back = next(c for c in answer.explain(7, source=2).competitors if c.id == "A1")
    np.testing.assert_allclose(forth.residual, [-0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(back.residual, [0.5, 0.0], atol=1e-12)
    assert forth.mahalanobis == back.mahalanobis == pytest.approx(0.5 / math.sqrt(2))


def test_terms_add_up_to_the_log_odds():
    candidates = [one for one in simple().explain("A1").competitors if one.id is not None]
    assert candidates
    for competitor in candidates:
        assert sum(competitor.terms.values()) == pytest.approx(competitor.log_odds, abs=1e-9)


def test_a_group_of_hundreds_of_pairs_is_explained_without_its_second_best_hypothesis():
    n = 300
    first = Records.of(np.arange(n) * 1.0, sigma=0.2, source="radar")
    second = Records.of(np.arange(n) * 1.0 + 0.3, sigma=0.2, source="ais")
    answer = identify(first, second, rule=Field(1e-2), gate=Box(3.0))
    explanation = answer.explain(150)
    assert explanation.records == (n, n) and explanation.next_best_cost is None
    assert "next best" not in str(explanation) and len(explanation.competitors) == 3
