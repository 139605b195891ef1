"""Compiled evidence of reports on swaps of ids under each swap model (:mod:`sameas.picture.id_swaps`).

For each pair of tracks and each of a dozen models, weights are multiplied rather than their logarithms added: a
crowded picture has tens of thousands of pairs, and their exponentials would take longer than all else.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import small_by

#: Maximum probability of a swap, and maximum ln of a weight relative to that without a swap.
MAX_SWAP, MAX_LOG_WEIGHT = 0.4, 300.0


@small_by(lambda at, *_: 50 * len(at))
def swap_factors(
    at: IntArray, before: tuple[FloatArray, FloatArray], log_stays: FloatArray, weight: FloatArray,
    swap: tuple[IntArray, FloatArray, FloatArray], may_swap: BoolArray, rates: FloatArray, factor: FloatArray,
    swapped: FloatArray, with_reports: FloatArray, log_top: FloatArray,
) -> None:  # fmt: skip
    """Write by which factor swaps of ids change the weights of pairs of tracks, under each of r models.

    Parameters
    ----------
    at : (n,) the pairs, of k. before : (k,), (k,) ln r, and ln N of the positions of the last reports. log_stays : (k,)
        ln r after the reports if ids are not swapped. weight : (k, r) r under each model relative to the mean.
    swap : (n, 2), (n, 2), (n, 2, c) of :func:`sameas.picture.id_swaps.swap_hypotheses`. may_swap : (n, 2) whether the
        sources may swap ids. rates : (h,) of the models: each with each of c ranges, r = c h.
    factor, swapped : (n, r) are written: the factors, and the parts of them that come from swaps. with_reports,
        log_top : (n, r), (n,) are written: the weights with the positions of the last reports, too, relative to the
        largest, and ln of this.
    """
    n_rates, lowest, most = len(rates), rates.min(), math.exp(MAX_LOG_WEIGHT)
    stays, by_both = np.empty(weight.shape[1]), np.empty(weight.shape[1])
    for n in range(len(at)):
        own = at[n]
        stays[:], by_both[:], swapped[n] = 1.0, 0.0, 0.0
        for side in range(2):
            rival = swap[0][n, side]
            if rival < 0:
                continue
            of_rival = math.exp(min(before[0][rival] - log_stays[own], 2.0 * MAX_LOG_WEIGHT))
            of_last = math.exp(min(before[1][rival] + swap[1][n, side], MAX_LOG_WEIGHT))
            for model in range(len(stays)):
                rate = rates[model % n_rates] if may_swap[n, side] else lowest
                p = min(rate * swap[2][n, side, model // n_rates], MAX_SWAP)
                stays[model] -= p
                p *= min(of_rival * weight[rival, model] / weight[own, model], most)
                swapped[n, model] += p
                by_both[model] += p * of_last
        highest = 0.0
        for model in range(len(stays)):
            factor[n, model] = stays[model] + swapped[n, model]
            with_reports[n, model] = weight[own, model] * (stays[model] + by_both[model])
            highest = max(highest, with_reports[n, model])
        for model in range(len(stays)):
            with_reports[n, model] /= highest
        log_top[n] = math.log(highest)


@small_by(lambda label, *_: 50 * len(label))
def add_set_gains(
    label: IntArray, source: IntArray, before: tuple[FloatArray, FloatArray], after: tuple[FloatArray, FloatArray],
    log_least: float, share: float, gain: FloatArray,
) -> None:  # fmt: skip
    """Add ``share`` times ln of the growth of the weight of each set of pairs under each model to its source's.

    label : (n,) set of each pair, numbers without large gaps. source : (n,) its source. before, after : weights of the
    pairs, (n, r), and ln of what they are relative to, (n,). log_least : ln of the weight of no pair. gain : (S, r).
    """
    n_labels = 0
    for one in label:
        n_labels = max(n_labels, one + 1)
    first, top, top_after = np.full(n_labels, -1), np.full(n_labels, log_least), np.full(n_labels, log_least)
    total, total_after = np.zeros((n_labels, gain.shape[1])), np.zeros((n_labels, gain.shape[1]))
    for n in range(len(label)):
        one = label[n]
        if first[one] < 0:
            first[one] = n
        top[one], top_after[one] = max(top[one], before[0][n]), max(top_after[one], after[0][n])
    for n in range(len(label)):
        one = label[n]
        scale, scale_after = math.exp(before[0][n] - top[one]), math.exp(after[0][n] - top_after[one])
        for model in range(gain.shape[1]):
            total[one, model] += scale * before[1][n, model]
            total_after[one, model] += scale_after * after[1][n, model]
    for one in range(n_labels):
        if first[one] < 0:
            continue
        least, least_after = math.exp(log_least - top[one]), math.exp(log_least - top_after[one])
        for model in range(gain.shape[1]):
            growth = math.log((total_after[one, model] + least_after) / (total[one, model] + least))
            gain[source[first[one]], model] += share * (growth + top_after[one] - top[one])
