"""Compiled curves of a share against magnitude, straight between knots."""

from __future__ import annotations

import numpy as np

from sameas.kernels.compiled import kernel, part
from sameas.kernels.linear import solve


@part
def directory(knots):
    """For steps of a 128th from the first knot to the last, the knot at or before each: where a search begins."""
    found, at = np.zeros(128, np.int64), 0
    for step in range(len(found)):
        x = knots[0] + (knots[-1] - knots[0]) * step / len(found)
        while at < len(knots) - 2 and knots[at + 1] <= x:
            at += 1
        found[step] = at
    return found


@part
def interval(knots, found, x):
    """The knot at or before x, that after it, and how far x is between them, 0 … 1; nothing changes beyond the ends.

    found : the ``directory`` of the knots.
    """
    last = len(knots) - 1
    if last == 0 or x <= knots[0]:
        return 0, min(1, last), 0.0
    if x >= knots[last]:
        return last - 1, last, 1.0
    low = found[int((x - knots[0]) / (knots[last] - knots[0]) * len(found))]
    while knots[low + 1] <= x:
        low += 1
    return low, low + 1, (x - knots[low]) / (knots[low + 1] - knots[low])


@kernel
def climb(magnitude, log_odds, shown, knots, penalty, values, steps, longest, settled):
    """Newton's steps towards the penalised maximum of the likelihood of ``values`` (k,) at ``knots``, in place.

    magnitude, log_odds, shown : (n,) of the records, what their log odds are without the curve, and the probability
    that they are shown. penalty : (k, k). No value changes by more than ``longest`` in a step; when none changes by
    more than ``settled``, no more steps are taken.
    """
    n, k = len(magnitude), len(knots)
    low, along, found = np.empty(n, np.int64), np.empty(n), directory(knots)
    for e in range(n):
        low[e], _, along[e] = interval(knots, found, magnitude[e])
    for _ in range(steps):
        gram, step = penalty.copy(), np.zeros((k, 1))
        for a in range(k):
            for b in range(k):
                step[a, 0] -= penalty[a, b] * values[b]
        for e in range(n):
            a, t = low[e], along[e]
            b = min(a + 1, k - 1)
            expected = 1.0 / (1.0 + np.exp(-(log_odds[e] + values[a] + t * (values[b] - values[a]))))
            missing, weight = shown[e] - expected, expected * (1.0 - expected)
            step[a, 0] += missing * (1.0 - t)
            gram[a, a] += weight * (1.0 - t) ** 2
            if b > a:
                step[b, 0] += missing * t
                gram[b, b] += weight * t**2
                gram[a, b] += weight * t * (1.0 - t)
                gram[b, a] += weight * t * (1.0 - t)
        solve(gram, step)
        furthest = 0.0
        for a in range(k):
            values[a] += min(max(step[a, 0], -longest), longest)
            furthest = max(furthest, abs(step[a, 0]))
        if furthest <= settled:
            break


@kernel
def weigh(magnitude, share, wanted, least, knots, values, out):
    """Fill ``out`` (n,) at the records ``wanted`` with what ½ ln s − ln (1 − s) gains when shares s (n,) follow the
    curve: ½ [v + ln (1 − s + s eᵛ)] where its value is v; 0 of a NaN magnitude.

    Shares are kept ``least`` away from 0 and 1.
    """
    found = directory(knots)
    for e in wanted:
        out[e] = 0.0
        if not np.isnan(magnitude[e]):
            low, high, along = interval(knots, found, magnitude[e])
            s, v = min(max(share[e], least), 1.0 - least), values[low] + along * (values[high] - values[low])
            out[e] = 0.5 * (v + np.log(1.0 + s * (np.exp(v) - 1.0)))
