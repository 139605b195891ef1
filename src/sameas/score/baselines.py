"""Baselines: matching rules without one-to-one hypotheses, for comparison (METHOD 4.4, 3.5).

- :func:`nearest`: the nearest candidate of each record; several records may have the same one.
- :func:`mutual_nearest`: pairs of records that are each other's nearest candidates.
- :func:`most_pairs`: the largest number of pairs, k = min(N₁, N₂) in every group, with least Σ ΔᵀΣ⁻¹Δ [T3].
- :func:`classified`: for each record separately, the candidate or no partner, of least average risk [F8–F13]; several
  records may have the same candidate.
- :func:`enumerated`: the most probable hypothesis by enumeration. Exact like ``sameas.assignment``, but only feasible
  up to about ten records in a group: the reference for small groups.

Each returns the chosen candidates, (m,) bool in the order of the gate. Distances are Mahalanobis distances; ties go to
the candidate that the gate lists first.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray
from sameas.decision import ALL_ALIKE, Loss
from sameas.errors import InputError
from sameas.gate import Pairs
from sameas.groups import Groups
from sameas.prior import LogPrior

#: Most hypotheses of a group that are enumerated: some seconds.
AT_MOST = 2_000_000


def nearest(pairs: Pairs, *, source: int = 1) -> BoolArray:
    """(m,) the nearest candidate of each record of ``source``. Not one to one."""
    if source not in (1, 2):
        raise InputError(f"source is {source}; give 1 or 2")
    return _first_of_each(pairs.i if source == 1 else pairs.j, pairs.mahalanobis_sq)


def mutual_nearest(pairs: Pairs) -> BoolArray:
    """(m,) the pairs whose records are each other's nearest candidates. One to one."""
    return nearest(pairs, source=1) & nearest(pairs, source=2)


def most_pairs(pairs: Pairs, groups: Groups) -> BoolArray:
    """(m,) the largest one-to-one set of pairs of every group, of those the one of least Σ ΔᵀΣ⁻¹Δ [T3].

    It has min(N₁, N₂) pairs, or fewer if the candidates do not allow that many.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    if not len(pairs):
        return np.zeros(0, np.bool_)
    n1, n2 = len(groups.rows_1), len(groups.rows_2)
    place_1, place_2 = groups.places
    cost = pairs.mahalanobis_sq[groups.order]
    # A record without partner costs more than any rearrangement of its group.
    largest = np.maximum.reduceat(cost, groups.start[:-1])
    price = 2.0 + (largest + 1.0) * (np.minimum(groups.sizes_1, groups.sizes_2) + 1)
    alone = np.repeat(price, groups.sizes_1)
    rows, columns = np.concatenate([place_1, np.arange(n1)]), np.concatenate([place_2, n2 + np.arange(n1)])
    # The solver treats 0 as no edge; adding 1 to every pair does not change the order of sets of equal size.
    weights = np.concatenate([cost + 1.0, alone])
    graph = csr_matrix((weights, (rows, columns)), shape=(n1, n2 + n1))
    partner = np.full(n1, n2, np.int64)
    matched_1, matched_2 = min_weight_full_bipartite_matching(graph)
    partner[matched_1] = matched_2
    return groups.in_given_order(partner[place_1] == place_2)


def classified(pairs: Pairs, log_odds: FloatArray, loss: Loss = ALL_ALIKE) -> BoolArray:
    """(m,) for each record of source 1 the candidate of least average risk, unless no partner has less. Not one to one.

    z_j = −Σ_k P(k) Π_kj f_k(Y), k over the candidates of the record and no partner (METHOD 3.5 [F8–F13]).

    Parameters
    ----------
    log_odds : (m,) ln of λ times the prior odds of every candidate against no partner, f and P of the formula;
        ``Identification.log_odds`` where the prior is linear.
    loss : the matrix Π. If every mistake costs the same, the most probable answer is chosen.
    """
    if log_odds.shape != (len(pairs),):
        raise InputError(f"classified: log_odds has shape {log_odds.shape}; give ({len(pairs)},), one per candidate")
    n = len(pairs.first)
    top = np.zeros(n)
    np.maximum.at(top, pairs.i, log_odds)
    odds, p_none = np.exp(log_odds - top[pairs.i]), np.exp(-top)
    total = p_none + np.bincount(pairs.i, odds, n)
    naming, alone = loss.expected(odds / total[pairs.i], pairs.i, p_none / total)
    return _first_of_each(pairs.i, naming) & (naming < alone[pairs.i])


def enumerated(groups: Groups, log_ratio: FloatArray, prior: LogPrior) -> BoolArray:
    """(m,) the most probable hypothesis of every group, by enumeration. One to one.

    Raises
    ------
    InputError : a group has more than AT_MOST hypotheses.
    """
    best = np.zeros(len(groups.order), np.bool_)
    weight = log_ratio[groups.order]
    for group in range(len(groups)):
        part = slice(int(groups.start[group]), int(groups.start[group + 1]))
        n1, n2 = int(groups.sizes_1[group]), int(groups.sizes_2[group])
        degree = np.bincount(groups.local_1[part], minlength=n1)
        number = min(math.prod((degree + 1).tolist()), number_of_hypotheses(n1, n2))
        if number > AT_MOST:
            raise InputError(
                f"enumerated: group {group} of {n1} and {n2} records has up to {number:.3g} hypotheses; "
                "use sameas.assignment.assign, which finds the same answer"
            )
        if prior.slope is not None:
            log_prior = prior.slope[group] * np.arange(min(n1, n2) + 1)
        else:
            log_prior = prior.table[prior.start[group] : prior.start[group + 1]]
        taken = _best_of_all(groups.local_1[part], groups.local_2[part], weight[part], n1, log_prior.tolist())
        best[part.start + np.array(taken, np.int64)] = True
    return groups.in_given_order(best)


def number_of_hypotheses(n1: int, n2: int) -> int:
    """Σ_k C(N₁, k) C(N₂, k) k!, the hypotheses of a group in which every pair is a candidate [T1]."""
    return sum(math.comb(n1, k) * math.comb(n2, k) * math.factorial(k) for k in range(min(n1, n2) + 1))


def _best_of_all(
    local_1: NDArray[np.int32], local_2: NDArray[np.int32], weight: FloatArray, n1: int, log_prior: list[float]
) -> list[int]:
    """The candidates of the best hypothesis of one group, by depth-first search over the records of source 1."""
    choices: list[list[tuple[int, int, float]]] = [[] for _ in range(n1)]
    for edge, (i, j, w) in enumerate(zip(local_1.tolist(), local_2.tolist(), weight.tolist(), strict=True)):
        choices[i].append((edge, 1 << j, w))
    best, winner = -math.inf, 0
    # Partial hypotheses: next record, records of source 2 in use and pairs taken (bits), their number, their total.
    open_ = [(0, 0, 0, 0, 0.0)]
    while open_:
        i, used, taken, k, total = open_.pop()
        if i == n1:
            if total + log_prior[k] > best:
                best, winner = total + log_prior[k], taken
            continue
        open_.append((i + 1, used, taken, k, total))
        open_ += [
            (i + 1, used | bit, taken | 1 << edge, k + 1, total + w) for edge, bit, w in choices[i] if not used & bit
        ]
    return [edge for edge in range(len(weight)) if winner >> edge & 1]


def _first_of_each(record: NDArray[np.int32], cost: FloatArray) -> BoolArray:
    """(m,) the candidate of least cost of each record, the first of ties."""
    order = np.lexsort((cost, record))
    ordered = record[order]
    chosen = np.zeros(len(record), np.bool_)
    chosen[order[np.concatenate([[True], ordered[1:] != ordered[:-1]])] if len(order) else order] = True
    return chosen
