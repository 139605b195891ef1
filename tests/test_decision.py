"""Each decision from posteriors minimises its own expected loss over all one-to-one decisions."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive
from sameas import CloseObjects, CommonObjects, InputError, Radius, Records, identify
from sameas.decision import ALL_ALIKE, Loss, evaluate_choice, least_loss, most_right


def small_answer(seed, n1=3, n2=3):
    rng = np.random.default_rng(seed)
    first = Records.of(rng.uniform(0, 4, (n1, 2)), sigma=1.0)
    second = Records.of(rng.uniform(0, 4, (n2, 2)), sigma=0.8)
    return identify(first, second, rule=CloseObjects(1.0, 5.0), prior=CommonObjects(0.3, 0.2), gate=Radius(4.0))


def hypotheses_of(answer):
    """All hypotheses (sets of candidates) with their probabilities, computed from the evidence."""
    pairs = answer.pairs
    edge = {(i, j): e for e, (i, j) in enumerate(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True))}
    ratios = {key: answer.evidence.log_ratio[e] for key, e in edge.items()}
    n1, n2 = len(pairs.first), len(pairs.second)
    sizes = {}
    for group in range(len(answer.groups)):
        for e in answer.groups.order[answer.groups.start[group] : answer.groups.start[group + 1]]:
            sizes[int(e)] = group
    prior = answer.best.prior
    found = []
    for hypothesis in naive.hypotheses(n1, n2, ratios):
        taken = [edge[pair] for pair in hypothesis]
        k = np.bincount([sizes[e] for e in taken], minlength=len(answer.groups))
        found.append((sum(answer.evidence.log_ratio[taken]) + prior.table[prior.start[:-1] + k].sum(), set(taken)))
    top = max(score for score, _ in found)
    weights = np.exp([score - top for score, _ in found])
    return [(w, taken) for w, (_, taken) in zip(weights / weights.sum(), found, strict=True)]


def loss_of(answer, decided, true, wrong, missed, swapped):
    """Loss of one decision under one true hypothesis, summed over the records of source 1."""
    i = answer.pairs.i
    total = 0.0
    for record in np.unique(i):
        named = [e for e in decided if i[e] == record]
        real = [e for e in true if i[e] == record]
        if named == real:
            continue
        if not real:
            total += wrong[named[0]]
        elif not named:
            total += missed[real[0]]
        elif swapped is None:
            total += wrong[named[0]] + missed[real[0]]
        else:
            total += swapped[named[0]]
    return total


def right_in(answer, decided, true):
    """Number of correctly decided records of both sources, among those with candidates."""
    count = 0
    for side in (answer.pairs.i, answer.pairs.j):
        for record in np.unique(side):
            count += [e for e in decided if side[e] == record] == [e for e in true if side[e] == record]
    return count


def losses(kind, m, rng):
    if kind == "numbers":
        return Loss(3.0, 1.0, 2.5)
    if kind == "both mistakes":
        return Loss(2.0, 0.7)
    if kind == "one for all":
        return ALL_ALIKE
    return Loss(rng.uniform(0, 3, m), rng.uniform(0, 3, m), rng.uniform(0, 3, m) if kind == "arrays" else None)


KINDS = ("numbers", "both mistakes", "one for all", "arrays", "arrays, both mistakes")


@pytest.mark.slow
@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from(KINDS))
def test_no_one_to_one_decision_has_a_smaller_expected_loss(seed, kind):
    rng = np.random.default_rng(seed)
    answer = small_answer(seed)
    m = len(answer.pairs)
    if not m:
        return
    loss = losses(kind, m, rng)
    worlds = hypotheses_of(answer)
    tables = loss.at(m)
    expected = {
        frozenset(decided): sum(p * loss_of(answer, decided, true, *tables) for p, true in worlds)
        for _, decided in worlds
    }
    decision = least_loss(answer, loss)
    ours = frozenset(np.flatnonzero(decision.chosen).tolist())
    assert expected[ours] == pytest.approx(min(expected.values()), abs=1e-9)
    assert decision.expected_loss == pytest.approx(expected[ours], abs=1e-9)
    right = sum(p * right_in(answer, ours, true) for p, true in worlds)
    assert decision.expected_right == pytest.approx(right, abs=1e-9)


@pytest.mark.slow
@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000))
def test_no_one_to_one_decision_has_more_correct_records(seed):
    answer = small_answer(seed)
    if not len(answer.pairs):
        return
    worlds = hypotheses_of(answer)
    expected = [sum(p * right_in(answer, decided, true) for p, true in worlds) for _, decided in worlds]
    assert most_right(answer).expected_right == pytest.approx(max(expected), abs=1e-9)


def test_the_three_decisions_differ_and_each_minimises_its_own_loss():
    differ = 0
    for seed in range(60):
        answer = small_answer(seed, 5, 5)
        if not len(answer.pairs):
            continue
        loss = Loss(3.0, 1.0)
        best, right, cheap = evaluate_choice(answer, answer.chosen, loss), most_right(answer), least_loss(answer, loss)
        assert right.expected_right >= max(best.expected_right, cheap.expected_right) - 1e-12
        assert (
            cheap.expected_loss
            <= min(best.expected_loss, evaluate_choice(answer, right.chosen, loss).expected_loss) + 1e-12
        )
        differ += not np.array_equal(best.chosen, right.chosen)
    assert differ > 3


@pytest.mark.slow
def test_costly_false_matches_give_purity_and_costly_misses_give_completeness():
    answer = small_answer(1, 6, 6)
    counts = [least_loss(answer, Loss(wrong, 1.0)).chosen.sum() for wrong in (1e-6, 1.0, 1e9)]
    assert counts[0] > counts[1] > counts[2] == 0


def test_with_both_losses_the_decision_does_not_depend_on_the_source():
    for seed in range(20):
        answer = small_answer(seed)
        pairs = answer.pairs
        turned = identify(
            pairs.second, pairs.first, rule=CloseObjects(1.0, 5.0), prior=CommonObjects(0.2, 0.3), gate=Radius(4.0)
        )
        one, other = (least_loss(each, Loss(2.0, 1.0)) for each in (answer, turned))
        assert set(zip(pairs.i[one.chosen], pairs.j[one.chosen], strict=True)) == set(
            zip(turned.pairs.j[other.chosen], turned.pairs.i[other.chosen], strict=True)
        )
        assert one.expected_loss == pytest.approx(other.expected_loss, abs=1e-9)


def test_without_candidates_there_is_no_loss():
    answer = identify(Records.of([0.0], sigma=1.0), Records.of([100.0], sigma=1.0), rule=CloseObjects(1.0, 5.0))
    for decision in (least_loss(answer), most_right(answer)):
        assert decision.chosen.shape == (0,) and decision.expected_loss == decision.expected_right == 0.0


@pytest.mark.parametrize(
    "loss, words",
    [
        (Loss(wrong=-1.0), "wrong is negative or not finite; give what the mistake costs"),
        (Loss(missed=math.nan), "missed is negative or not finite"),
        (Loss(swapped=np.ones(99)), r"swapped has shape \(99,\); give a number or"),
    ],
)
def test_invalid_losses_are_refused_with_a_clear_message(loss, words):
    with pytest.raises(InputError, match=words):
        least_loss(small_answer(0), loss)


def test_only_one_to_one_decisions_are_accepted():
    first, second = Records.of([[0.0], [1.0]], sigma=1.0), Records.of([[0.4]], sigma=1.0)
    answer = identify(first, second, rule=CloseObjects(1.0, 5.0))
    with pytest.raises(InputError, match="a record of source 2 is chosen twice; give a one-to-one decision"):
        evaluate_choice(answer, np.ones(2, bool))
    with pytest.raises(InputError, match=r"chosen has shape \(3,\); give \(2,\)"):
        evaluate_choice(answer, np.ones(3, bool))
