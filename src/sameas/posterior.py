"""How sure: the probability of every pair, summed over all one-to-one hypotheses of its group (METHOD 5).

Groups in which one record has all the pairs are a closed form. Others are summed exactly by eliminating their records
one by one, with the count of pairs carried where the prior asks for it; that covers every group of up to about 16
records on its smaller side and larger ones that are thin, such as chains. What is too entangled is approximated:
every record is solved exactly together with the records that compete with it most, and sum-product messages stand for
what lies beyond. Which method a group got is part of the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sameas import threads
from sameas.assignment import Hypothesis
from sameas.groups import Groups
from sameas.records import FloatArray

#: Names of the methods, by the number in :attr:`Posterior.method`.
METHODS = ("closed form", "exact elimination", "local: exact around each record, messages beyond")
APPROXIMATE = 2

#: Size of the exact neighbourhood around a record of an entangled group: rows, and log2 of the choices among them.
NEIGHBOURHOOD_ROWS = 12
NEIGHBOURHOOD_BITS = 24.0
SWEEPS = 400


@dataclass(frozen=True)
class Posterior:
    """Posterior probabilities.

    Attributes
    ----------
    p_pair : (m,) probability of each pair, in the order of the gate.
    method : (g,) number into :data:`METHODS`.
    unsettled : largest relative change of a message in the last sweep (0 where no messages were needed).
    """

    p_pair: FloatArray
    method: NDArray[np.int8]
    unsettled: float

    def counts(self) -> dict[str, int]:
        """How many groups were solved by which method."""
        return {name: int(np.count_nonzero(self.method == k)) for k, name in enumerate(METHODS)}


def posterior(groups: Groups, best: Hypothesis) -> Posterior:
    """Probabilities of all pairs, given the evidence and prior that made ``best``."""
    from sameas.kernels.posterior import exact

    m = len(groups.order)
    share = np.zeros(m)
    method = np.zeros(len(groups), np.int8)
    counted = best.prior.slope is None
    table = (best.prior.start, best.prior.table, best.multiplier)
    shape = (groups.start, groups.start_1, groups.start_2, groups.local_1, groups.local_2)
    state = (best.weight, best.chosen, best.dual_1, best.dual_2)
    threads.over(
        lambda a, b: exact(a, b, *shape, *state, counted, *table, share, method),
        groups.bounds(len(threads.even(m)) - 1),
    )
    unsettled = 0.0
    if np.any(method == APPROXIMATE):
        unsettled = _local(groups, best, method, share)
    p_pair = np.empty(m)
    p_pair[groups.order] = np.clip(share, 0.0, 1.0)
    return Posterior(p_pair, method, unsettled)


def _local(groups: Groups, best: Hypothesis, method: NDArray[np.int8], share: FloatArray) -> float:
    """Fill ``share`` for the groups that elimination gave up."""
    from sameas.kernels.posterior import balls, columns_of, messages

    weight, multiplier = best.weight, best.multiplier
    if best.prior.slope is None:
        weight = weight + np.repeat(_local_slopes(groups, best), groups.pair_counts)
        multiplier = np.zeros(len(groups))
    claims = np.zeros(len(weight))
    start, start1, start2 = groups.start, groups.start_1, groups.start_2
    local1, local2 = groups.local_1, groups.local_2
    unsettled = messages(
        0, len(groups), start, start1, start2, groups.edges_1, local2, weight, best.dual_1, best.dual_2, method,
        claims, SWEEPS,
    )  # fmt: skip
    column_start, column_pairs = columns_of(len(groups), start, start1, start2, groups.edges_1, local2, method)
    group1 = np.repeat(np.arange(len(groups), dtype=np.int32), groups.sizes_1)
    shape = (group1, start1, start2, groups.edges_1, local1, local2, column_start, column_pairs)
    threads.over(
        lambda a, b: balls(
            a, b, *shape, weight, best.dual_1, best.dual_2, method, claims, NEIGHBOURHOOD_ROWS, NEIGHBOURHOOD_BITS, share
        ),
        threads.even(len(group1), least=256),
    )
    return float(unsettled)


def _local_slopes(groups: Groups, best: Hypothesis) -> FloatArray:
    """(g,) the slope of ln P(k) at the best hypothesis' number of pairs."""
    size = np.add.reduceat(best.chosen.astype(np.int64), groups.start[:-1])
    most = np.diff(best.prior.start) - 1
    low, high = np.maximum(size - 1, 0), np.minimum(size + 1, most)
    table, start = best.prior.table, best.prior.start[:-1]
    return (table[start + high] - table[start + low]) / (high - low)
