"""The best partition of every group's records into objects, exact or with its gap.

Choosing sets that share no record is set packing. Under additive weights the linear relaxation of all groups is solved
at once (SciPy's HiGHS). Where its solution is integral it is the best partition; other groups are solved by branch and
bound. The bound is the relaxation's dual value, so every group's gap is known. A count prior is carried through: exact
elimination (:mod:`sameas.many.marginals`) where that is small, otherwise branch and bound with one binary for every
number of merges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linprog, milp
from scipy.sparse import csr_array, hstack, vstack

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.many.joint import NO_RECORD
from sameas.many.sets import Sets
from sameas.representation import in_short


@in_short
@dataclass(frozen=True)
class Partition:
    """The best partition.

    Attributes
    ----------
    chosen : (k,) the sets that are objects; every record is in one of them.
    gap : (g,) ln of how much more probable a better partition of the group could be at most; 0 where it is the best.
    dual : (n,) dual values of the records: no set weighs more than those of its records together.
    slack : (g,) the relaxation's value less the partition's.
    """

    chosen: BoolArray
    gap: FloatArray
    dual: FloatArray
    slack: FloatArray


def best_partition(sets: Sets, n_records: int, groups: BoolArray | None = None, *, time_limit_s: float) -> Partition:
    """The partition of greatest Σ ln w of every group, or of the ``groups`` (g,); all records alone in the others."""
    incidence = incidence_of(sets, n_records)
    active, x, dual = _relaxation(sets, incidence, np.ones(len(sets.start) - 1, bool) if groups is None else groups)
    n_groups = len(sets.start) - 1
    chosen = np.zeros(len(sets), bool)
    chosen[active[x > 0.5]] = True
    fractional = np.zeros(n_groups, bool)
    fractional[sets.group[active[np.abs(x - np.round(x)) > 1e-6]]] = True
    _, group_of_record = _group_of(sets, n_records)
    bound = np.bincount(group_of_record, dual, n_groups)
    for g in np.flatnonzero(fractional):
        own = slice(*np.searchsorted(active, sets.start[g : g + 2]))
        chosen[active[own]] = False
        packing, tighter = _best_packing(sets, active[own], x[own], dual, incidence, time_limit_s)
        chosen[packing] = True
        bound[g] = min(bound[g], tighter)
    chosen |= _left_alone(sets, chosen, incidence)
    value = np.bincount(sets.group[chosen], sets.log_weight[chosen], n_groups)
    scale = np.maximum(1.0, np.abs(value))
    slack = np.maximum(np.bincount(group_of_record, dual, n_groups) - value, 0.0)
    gap = np.maximum(bound - value, 0.0)
    gap = np.where(gap <= 1e-7 * scale, 0.0, gap)
    # A set below the floor has two records or more: duals of half a floor cover it.
    cut = sets.floor > 0
    half = np.where(cut, 0.5 * np.where(cut, sets.floor, 0.0), 0.0)[group_of_record]
    covered = np.bincount(group_of_record, np.maximum(dual, half), n_groups) - value
    return Partition(chosen, np.where(cut, np.maximum(gap, covered), gap), dual, slack)


def best_counted(weight: FloatArray, merges: IntArray, incidence: csr_array, log_p: FloatArray, time_limit_s: float
                 ) -> tuple[IntArray, float]:  # fmt: skip
    """The sets of one group that maximise Σ ln w + ln P(Σ merges), and the gap."""
    n, m = len(weight), len(log_p)
    cover = hstack([incidence, csr_array((incidence.shape[0], m))])
    balance = np.concatenate([merges, -np.arange(m)]).astype(np.float64)
    one = np.concatenate([np.zeros(n), np.ones(m)])
    rows = vstack([cover, csr_array(balance[None]), csr_array(one[None])]).tocsr()
    low = np.concatenate([np.zeros(incidence.shape[0]), [0.0, 1.0]])
    high = np.concatenate([np.ones(incidence.shape[0]), [0.0, 1.0]])
    x, bound, value = _branched(np.concatenate([weight, log_p]), rows, low, high, time_limit_s)
    return np.flatnonzero(x[:n] > 0.5), max(bound - value, 0.0)


def _relaxation(sets: Sets, incidence: csr_array, groups: BoolArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """(sets in it, their shares, dual values of all records) of the linear relaxation of all groups."""
    # A set that weighs no more than its records alone, or than the set without one of them, is never needed: the duals
    # that cover the others cover it too.
    heavy = (sets.log_weight > 0) & groups[sets.group]
    useful = np.flatnonzero(heavy & ~_dominated(sets)) if heavy.any() else np.empty(0, np.int64)
    n_records = incidence.shape[0]
    if not len(useful):
        return useful, np.empty(0), np.zeros(n_records)
    solution = linprog(-sets.log_weight[useful], A_ub=incidence[:, useful], b_ub=np.ones(n_records), method="highs-ds")
    if solution.status != 0:
        raise RuntimeError(f"the linear relaxation was not solved: {solution.message}")
    return useful, solution.x, np.maximum(-solution.ineqlin.marginals, 0.0)


def _dominated(sets: Sets) -> BoolArray:
    """(k,) the sets that weigh no more than the set without one of their records."""
    # Sets are looked up by a sum of random numbers of their records, and then compared record by record.
    code = np.random.default_rng(0).integers(0, 1 << 62, sets.members.max(initial=0) + 2, dtype=np.uint64)
    code[-1] = 0
    total = code[sets.members].sum(axis=1, dtype=np.uint64)
    order = np.argsort(total, kind="stable")
    ordered = total[order]
    out = np.zeros(len(sets), bool)
    for s in range(sets.members.shape[1]):
        k = np.flatnonzero((sets.members[:, s] != NO_RECORD) & (sets.size > 2))
        sought = total[k] - code[sets.members[k, s]]
        candidate = order[np.minimum(np.searchsorted(ordered, sought), len(order) - 1)]
        rest = sets.members[k]
        rest[:, s] = NO_RECORD
        same = (sets.members[candidate] == rest).all(axis=1)
        out[k] |= same & (sets.log_weight[k] <= sets.log_weight[candidate])
    return out


def _best_packing(
    sets: Sets, here: IntArray, share: FloatArray, dual: FloatArray, incidence: csr_array, time_limit_s: float
) -> tuple[IntArray, float]:
    """The best packing of one group's sets, and the bound, from their shares in the relaxation and its duals.

    A good packing comes first: the sets whose share is 1, and the best of those that share no record with them. In a
    better one every set has a reduced cost of at most the good one's distance from the relaxation.
    """
    within, weight = incidence[:, here], sets.log_weight[here]
    whole = share > 1.0 - 1e-6
    apart = np.flatnonzero(within.T @ (within[:, whole].sum(axis=1) > 0) == 0)
    added, _ = _branched_packing(weight[apart], within[:, apart], 0.5 * time_limit_s)
    good = np.concatenate([np.flatnonzero(whole), apart[added]])
    value, cost = float(weight[good].sum()), within.T @ dual - weight
    relaxed = float(dual[within.sum(axis=1) > 0].sum())
    cheap = np.flatnonzero(cost <= relaxed - value + 1e-6 * max(1.0, abs(relaxed)))
    packing, bound = _branched_packing(weight[cheap], within[:, cheap], 0.5 * time_limit_s)
    best = cheap[packing]
    return here[best if weight[best].sum() >= value else good], max(bound, value)


def _branched_packing(weight: FloatArray, incidence: csr_array, time_limit_s: float) -> tuple[IntArray, float]:
    """The best packing of some sets by branch and bound, and the bound."""
    if not len(weight):
        return np.empty(0, np.int64), 0.0
    high = np.ones(incidence.shape[0])
    x, bound, _ = _branched(weight, incidence, np.full(len(high), -np.inf), high, time_limit_s)
    return np.flatnonzero(x > 0.5), bound


def _branched(
    weight: FloatArray, rows: csr_array, low: FloatArray, high: FloatArray, time_limit_s: float
) -> tuple[FloatArray, float, float]:
    """(answer, bound, value) of the binary programme of greatest weight; nothing chosen where time ran out first."""
    used = np.diff(rows.tocsr().indptr) > 0
    constraint = LinearConstraint(rows.tocsr()[used], low[used], high[used])
    options = {"mip_rel_gap": 0.0, "time_limit": time_limit_s}
    solution = milp(-weight, constraints=constraint, integrality=np.ones(len(weight)), bounds=Bounds(0, 1),
                    options=options)  # fmt: skip
    bound = np.inf if solution.mip_dual_bound is None else -float(solution.mip_dual_bound)
    if solution.x is None:
        return np.zeros(len(weight)), bound, 0.0
    return np.round(solution.x), bound, float(weight @ np.round(solution.x))


def _left_alone(sets: Sets, chosen: BoolArray, incidence: csr_array) -> BoolArray:
    """(k,) the sets of one record that is in no chosen set."""
    in_chosen = np.asarray(incidence[:, chosen].sum(axis=1) > 0)
    lone = sets.size == 1
    return np.asarray(lone & ~in_chosen[sets.members.max(axis=1)] & ~chosen)


def incidence_of(sets: Sets, n_records: int) -> csr_array:
    """(n, k) which record is in which set."""
    at, record = sets.entries()
    return csr_array((np.ones(len(at)), (record, at)), shape=(n_records, len(sets)))


def _group_of(sets: Sets, n_records: int) -> tuple[IntArray, IntArray]:
    lone = np.flatnonzero(sets.size == 1)
    group = np.empty(n_records, np.int64)
    group[sets.members[lone].max(axis=1)] = sets.group[lone]
    return lone, group
