"""Hysteresis: the partition of the previous instant is kept until another is much more probable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, entries, over_columns, taken
from sameas.kernels.components import label_components
from sameas.many.marginals import best_sets
from sameas.many.objects import Objects
from sameas.many.sets import TUNING, ManyTuning, Sets, packed_order


def with_hysteresis(
    identification: Objects, previous_object: IntArray, log_bound: float, *, tuning: ManyTuning = TUNING
) -> tuple[Objects, BoolArray]:
    """The objects of an instant, with those of the previous instant kept unless another answer is much more probable;
    and (n,) whether each object is shown only because it is kept.

    Two vessels at one pier share an echo whose owner stays uncertain for hours: 60 to 40, then 45 to 55. The most
    probable answer would switch back and forth. So the picture shows the partition that maximises

        ln P(partition) − ln b · links,

    with P from all scans, and ``links`` the number of links that the partition breaks: n − 1 where it splits the
    records of one object of the previous instant into n parts. Joining breaks no link, and only records of named tracks
    have a previous object. Two trackers that exchange two ships' ids once are one change, which breaks two links or
    more; so where this partition and the most probable one differ, each connected part of the difference is kept only
    while the other answer is less than b times as probable. Probabilities do not change.
    Source: the decision of least expected loss when a reversed change has a cost (Berger 1985, section 2).

    Parameters
    ----------
    previous_object : (records,) the object of each pooled record's track at the previous instant, ABSENT without one.
    log_bound : ln b; 0 to show the most probable answer always.
    tuning : as of :func:`sameas.identify_many`, of which only the best partition is computed again.
    """
    sets, answer, n = identification.sets, identification.answer, len(identification.pooled)
    if log_bound <= 0.0:
        return identification, np.zeros(len(identification), bool)
    # Components that no possible set connects are independent; only those that split a previous object are re-solved.
    possible, record = answer.probability > 0.0, over_columns(np.maximum, sets.members)
    component = _components(sets, possible | answer.chosen, n)[record]
    resolve = _splits(sets, component, previous_object, answer.chosen)[component]
    if not resolve.any():
        return identification, np.zeros(len(identification), bool)
    which = np.flatnonzero(resolve)
    log_weight = sets.log_weight.copy()
    log_weight[which] += log_bound * _links(taken(sets.members, which), previous_object)
    with_links = replace(sets, log_weight=log_weight)
    best = best_sets(with_links, n, possible & resolve, tuning=tuning)
    chosen = np.where(resolve, best, answer.chosen)
    change = _components(sets, chosen ^ answer.chosen, n)[record]
    gain = np.bincount(change, sets.log_weight * (answer.chosen.astype(np.int64) - chosen), n)
    chosen = np.where(gain[change] < log_bound, chosen, answer.chosen)
    log_loss = _log_weight(sets, answer.chosen) - _log_weight(sets, chosen)
    kept = replace(identification, answer=replace(answer, chosen=chosen, gap=answer.gap + np.maximum(log_loss, 0.0)))
    return kept, ~answer.chosen[kept.set_of_object]


def _components(sets: Sets, which: BoolArray, n_records: int) -> IntArray:
    """(records,) the connected component of each record, by the sets ``which``."""
    several = np.flatnonzero(which & (sets.size > 1))
    members = taken(sets.members, several)
    at, record = entries(members)
    edges = (n_records + at, record)
    parent, component = np.empty((2, n_records + len(several)), np.int64)
    label_components(*edges, parent, component)
    return component[:n_records]


def _links(members: IntArray, previous_object: IntArray) -> IntArray:
    """(k,) links within each set (k, S): its records with a previous object, minus the number of these objects."""
    previous = np.sort(np.append(previous_object, ABSENT)[members], axis=1)
    has_previous = previous >= 0
    is_first = has_previous.copy()
    is_first[:, 1:] &= previous[:, 1:] != previous[:, :-1]
    return np.asarray((has_previous & ~is_first).sum(axis=1))


def _splits(sets: Sets, component: IntArray, previous_object: IntArray, chosen: BoolArray) -> BoolArray:
    """(components,) whether the chosen sets split a previous object; component : (k,) of each set."""
    which = np.flatnonzero(chosen)
    members = taken(sets.members, which)
    at, record = entries(members)
    previous, own = previous_object[record], which[at]
    known = np.flatnonzero(previous >= 0)
    previous, own = previous[known], own[known]
    order = packed_order([previous, component[own], own])
    one, other = order[:-1], order[1:]
    same_component = component[own[one]] == component[own[other]]
    split = (previous[one] == previous[other]) & same_component & (own[one] != own[other])
    out = np.zeros(int(component.max(initial=-1)) + 1, bool)
    out[component[own[other[split]]]] = True
    return out


def _log_weight(sets: Sets, chosen: BoolArray) -> FloatArray:
    """(g,) ln w of the partition of each group."""
    return np.asarray(np.bincount(sets.group[chosen], sets.log_weight[chosen], len(sets.start) - 1), np.float64)
