"""The chosen hypothesis is the most probable one: by enumeration, by its certificate, by other solvers."""

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

import naive
from problems import DRAWS, chosen_edges, components_of, crowd, laid_out, many_blocks, random_ratios, solved
from sameas import CloseObjects, CommonObjects, InputError, PerPair, Radius, Records, identify
from sameas.assignment import Certificate, assign, refuse_crowds
from sameas.estimate.match import match
from sameas.kernels import threads
from sameas.many.identify import identify_many
from sameas.many.rules import PoissonObjects
from sameas.prior import LogPrior
from sameas.score.picture import gospa

PRIORS = {
    "per pair": (PerPair(0.0), lambda n1, n2: lambda k: 0.0),
    "per pair, unlikely": (PerPair(-1.5), lambda n1, n2: lambda k: -1.5 * k),
    "common objects": (
        CommonObjects(0.1, 0.3),
        lambda n1, n2: lambda k: naive.common_objects_log_prior(k, n1, n2, 0.1, 0.3),
    ),
    "common objects, rare misses": (
        CommonObjects(1e-3, 1e-4),
        lambda n1, n2: lambda k: naive.common_objects_log_prior(k, n1, n2, 1e-3, 1e-4),
    ),
    "common objects, linear": (
        CommonObjects(0.1, 0.3, linear=True),
        lambda n1, n2: lambda k: naive.common_objects_linear(k, n1, n2, 0.1, 0.3),
    ),
}


def certified(grouped, best):
    return best.certificate(grouped).holds


def total(weight, edges):
    return sum(weight[edge] for edge in edges)


def one_to_one(edges):
    return len({i for i, _ in edges}) == len({j for _, j in edges}) == len(edges)


@pytest.mark.slow
@pytest.mark.parametrize("draw", DRAWS)
@pytest.mark.parametrize("name", PRIORS)
def test_the_hypothesis_is_the_most_probable_of_all(name, draw):
    prior, log_prior = PRIORS[name]
    rng = np.random.default_rng([len(name), len(draw)])
    n1, n2, ratios = many_blocks(rng, DRAWS[draw], blocks=25)
    pairs, grouped, best, _ = solved(n1, n2, ratios, prior)
    chosen = chosen_edges(pairs, grouped, best)
    assert one_to_one(chosen) and certified(grouped, best)
    for rows_1, rows_2, local in components_of(n1, n2, ratios):
        score, _ = naive.best(len(rows_1), len(rows_2), local, log_prior(len(rows_1), len(rows_2)))
        ours = {(rows_1.index(i), rows_2.index(j)) for i, j in chosen if i in rows_1}
        ours_score = log_prior(len(rows_1), len(rows_2))(len(ours)) + total(local, ours)
        assert ours_score == pytest.approx(score, rel=1e-9, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("draw", DRAWS)
def test_the_best_hypothesis_of_every_size_is_found(draw):
    rng = np.random.default_rng(len(draw))
    for _ in range(12):
        n1, n2 = rng.integers(1, 6, 2)
        ratios = random_ratios(rng, n1, n2, rng.choice([0.4, 0.8, 1.0]), DRAWS[draw])
        for rows_1, rows_2, local in components_of(n1, n2, ratios):
            a, b = len(rows_1), len(rows_2)
            for k, expected in enumerate(naive.best_per_k(a, b, local)):
                if expected == -math.inf:
                    continue
                # A prior that favours exactly k pairs gives W_k.
                table = np.where(np.arange(min(a, b) + 1) == k, 1e5, 0.0)
                pairs, grouped, best, _ = solved(a, b, local, LogPrior(None, np.array([0, len(table)]), table))
                chosen = chosen_edges(pairs, grouped, best)
                assert len(chosen) == k and one_to_one(chosen) and certified(grouped, best)
                assert total(local, chosen) == pytest.approx(expected, rel=1e-9, abs=1e-9)


# ---- larger groups, against other solvers ----


def gated_field(rng, n, degree):
    """Ratios of a crowded field, most of which is one component."""
    side = math.sqrt(n)
    one = rng.uniform(0, side, (n, 2))
    two = one + rng.normal(0, 0.4, (n, 2))
    gate = math.sqrt(degree / math.pi)
    ratios = {}
    for i in range(n):
        near = np.flatnonzero(((two - one[i]) ** 2).sum(axis=1) < gate**2)
        for j in near.tolist():
            ratios[i, j] = 3.0 - 0.5 * float(((two[j] - one[i]) ** 2).sum()) / 0.16 + rng.normal(0, 0.5)
    return ratios


def matched_by_scipy(n1, n2, ratios):
    """Optimal total weight; a dummy column for each row stands for no partner (weights shifted to be positive)."""
    i, j = np.array(list(ratios)).T
    weight = np.array(list(ratios.values()))
    shift = weight.max() + 1.0
    rows = np.concatenate([i, np.arange(n1)])
    columns = np.concatenate([j, n2 + np.arange(n1)])
    cost = np.concatenate([shift - weight, np.full(n1, shift)])
    row, column = min_weight_full_bipartite_matching(coo_array((cost, (rows, columns)), shape=(n1, n2 + n1)).tocsr())
    table = dict(zip(zip(rows.tolist(), columns.tolist(), strict=True), (shift - cost).tolist(), strict=True))
    return sum(table[pair] for pair in zip(row.tolist(), column.tolist(), strict=True))


@pytest.mark.slow
def test_the_optimum_in_a_crowded_field_agrees_with_scipy():
    rng = np.random.default_rng(0)
    n = 2000
    ratios = gated_field(rng, n, 8.0)
    pairs, grouped = laid_out(n, n, ratios)
    weight = np.array([ratios[edge] for edge in zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)])
    assert grouped.sizes_1.max() > 0.95 * n
    best = assign(grouped, weight, PerPair(0.0)(grouped.sizes_1, grouped.sizes_2))
    chosen = chosen_edges(pairs, grouped, best)
    assert one_to_one(chosen) and certified(grouped, best)
    assert total(ratios, chosen) == pytest.approx(matched_by_scipy(n, n, ratios), rel=1e-10)


def best_of_size(matrix, k):
    """W_k of a dense matrix: n1 − k rows and n2 − k columns are assigned to dummies."""
    n1, n2 = matrix.shape
    padded = np.zeros((n1 + n2 - k, n1 + n2 - k))
    padded[:n1, :n2] = matrix
    padded[n1:, n2:] = -1e9
    row, column = linear_sum_assignment(padded, maximize=True)
    return padded[row, column].sum()


@pytest.mark.parametrize("n1, n2", [(12, 12), (15, 30), (30, 18), (25, 25)])
@pytest.mark.parametrize("q", [0.01, 0.3, 0.8])
def test_a_prior_by_count_takes_the_best_of_all_sizes(n1, n2, q):
    rng = np.random.default_rng([n1, n2, int(100 * q)])
    matrix = rng.normal(-1.0, 2.0, (n1, n2))
    ratios = {(i, j): float(matrix[i, j]) for i in range(n1) for j in range(n2)}
    prior = CommonObjects(q, 0.5 * q)
    pairs, grouped = laid_out(n1, n2, ratios)
    weight = np.array([ratios[edge] for edge in zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)])
    log_prior = prior(grouped.sizes_1, grouped.sizes_2)
    best = assign(grouped, weight, log_prior)
    chosen = chosen_edges(pairs, grouped, best)
    scores = [
        naive.common_objects_log_prior(k, n1, n2, q, 0.5 * q) + best_of_size(matrix, k) for k in range(min(n1, n2) + 1)
    ]
    ours = naive.common_objects_log_prior(len(chosen), n1, n2, q, 0.5 * q) + total(ratios, chosen)
    assert one_to_one(chosen) and certified(grouped, best)
    assert ours == pytest.approx(max(scores), rel=1e-10, abs=1e-9)


THOUSANDS = """
import resource
import numpy as np
from problems import laid_out
from sameas import CommonObjects, PerPair
from sameas.assignment import assign

n, width = {n}, {width}
prior = {prior}
_, small = laid_out(2, 2, {{(0, 0), (0, 1), (1, 1)}})
assign(small, np.ones(3), prior(small.sizes_1, small.sizes_2))
i, j = np.repeat(np.arange(n), width), np.add.outer(np.arange(n), np.arange(width)).ravel()
keep = j < n
_, grouped = laid_out(n, n, set(zip(i[keep].tolist(), j[keep].tolist(), strict=True)))
weight = np.random.default_rng(2).normal(1.0, 3.0, keep.sum())
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
best = assign(grouped, weight, prior(grouped.sizes_1, grouped.sizes_2))
assert len(grouped) == 1 and 0 < best.chosen.sum() <= n and best.certificate(grouped).holds
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.slow
@pytest.mark.parametrize("width, prior", [(6, "PerPair(0.0)"), (2, "CommonObjects(0.2, 0.1)")])
@pytest.mark.long_after(1)
def test_memory_of_a_group_of_5000_records_grows_with_its_candidates_only(width, prior):
    program = THOUSANDS.format(n=5000, width=width, prior=prior)
    # The small group loads the compiler first, so that its memory does not count.
    run = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parent, capture_output=True, text=True,
        env={**os.environ, "SAMEAS_COMPILE": "1"},
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    # In KiB; a matrix of 5000 × 5000 would take 200 MB, the candidates take one or two.
    assert int(run.stdout) < 30_000


# ---- the certificate ----


def test_identify_refuses_a_hypothesis_without_proof_of_optimality(monkeypatch):
    from sameas import Field, Records, identify

    first, second = Records.of([[0.0], [1.0]], sigma=0.3), Records.of([[0.1], [1.1]], sigma=0.3)
    answer = identify(first, second, rule=Field(0.1), certify=True)
    certificate = answer.best.certificate(answer.groups)
    assert certificate.holds and str(certificate).startswith("optimal: least reduced cost")

    def worse(*arguments):
        best = assign(*arguments)
        return replace(best, chosen=np.zeros_like(best.chosen))

    monkeypatch.setitem(identify.__globals__, "assign", worse)
    with pytest.raises(ArithmeticError, match=r"NOT PROVED OPTIMAL: .* duality gap \d"):
        identify(first, second, rule=Field(0.1), certify=True)
    assert len(identify(first, second, rule=Field(0.1)).matches) == 0


# ---- ties, no candidates, threads ----


def test_a_pair_exactly_as_probable_as_no_pair_is_not_chosen():
    pairs, grouped, best, _ = solved(2, 2, {(0, 0): 0.0, (1, 1): 1e-9}, PerPair(0.0))
    assert chosen_edges(pairs, grouped, best) == {(1, 1)}


@pytest.mark.parametrize("prior", [PerPair(0.0), CommonObjects(0.1, 0.1)])
def test_without_candidates_the_hypothesis_is_empty(prior):
    _, grouped = laid_out(2, 3, set())
    best = assign(grouped, np.empty(0), prior(grouped.sizes_1, grouped.sizes_2))
    assert len(best.chosen) == 0 and best.certificate(grouped) == Certificate(0.0, 0.0)


@pytest.mark.parametrize("prior", [PerPair(0.5), CommonObjects(0.2, 0.1)])
def test_threads_do_not_change_the_hypothesis(monkeypatch, prior):
    rng = np.random.default_rng(4)
    n1, n2, ratios = many_blocks(rng, DRAWS["ties"], blocks=60, most=7)
    even = threads.even
    monkeypatch.setattr(threads, "even", lambda n, least=4096: even(n, 8))
    answers = []
    for count in ("1", "2", "7"):
        monkeypatch.setenv("SAMEAS_THREADS", count)
        _, _, best, sure = solved(n1, n2, ratios, prior)
        answers.append((best.chosen, best.dual_1, best.dual_2, best.multiplier, sure.p_pair))
    for other in answers[1:]:
        for ours, theirs in zip(answers[0], other, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_a_crowd_that_would_take_hours_is_refused_with_its_row():
    gate, most = Radius(6.0), 20.0**3
    refuse_crowds(gate(crowd(20), crowd(20, "b", 2)), most)
    apart = Records.of([[1000.0, 0.0], *crowd(21).features], sigma=1.0, source="a")
    with pytest.raises(InputError, match=r"a: at row \d+, 21 records of b may each be any of 21: .* some 0 minutes"):
        refuse_crowds(gate(apart, crowd(21, "b", 2)), most)
    # Not a crowd: one record with many candidates, or many records with few candidates each.
    refuse_crowds(gate(crowd(1), crowd(2000, "b", 2)), most)
    refuse_crowds(gate(crowd(2000), crowd(1, "b", 2)), most)


CHOOSERS: dict[str, Any] = {
    "identify": lambda a, b: identify(a, b, rule=CloseObjects(a=2.0, b=20.0)),
    "match": match,
    "match with errors": lambda a, b: match(a, b, gate=Radius(6.0)),
    "many": lambda a, b: identify_many([a, b], rule=PoissonObjects(1.0, [0.1, 0.1])),
    "gospa": lambda a, b: gospa(a.features, b.features, cutoff=9.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHOOSERS)
def test_functions_that_choose_pairs_refuse_a_crowd_at_once(name):
    with pytest.raises(InputError, match=r"at row \d+, 1800 records of .* may each be any of 1800: .* some 6 minutes"):
        CHOOSERS[name](crowd(1800), crowd(1800, "b", 2))


@pytest.mark.slow
def test_functions_that_only_weigh_pairs_accept_a_crowd():
    assert len(Radius(6.0)(crowd(1800), crowd(1800, "b", 2))) == 1800**2
