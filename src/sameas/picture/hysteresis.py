"""Hysteresis: who is with whom changes only where the change has been earned.

Two vessels at one pier share an echo, and whose it is stays open for hours: 60 to 40, then 45 to 55. The most probable
answer of every instant would hand it to and fro. So the picture shows the partition that maximises

    ln P(partition) − ln b · links,

P being what all looks so far say, and ``links`` how many it breaks: one for every part but one into which it takes the
records that were one object at the last instant. Where two answers are even, or nearly, what was shown stays; what is b
times as probable per link is shown at once. To come together breaks nothing. Probabilities stay as they are: an
object that is kept against better ones says so by its own.

Only tracks with names have been anywhere; a record that is new costs nothing wherever it goes. Source: the decision of
least expected loss where a change that comes to nothing costs, too (Berger 1985, section 2).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sameas.objects import Objects
from sameas.partition import best_partition
from sameas.picture.roll import BoolArray
from sameas.records import FloatArray, IntArray
from sameas.sets import Sets

#: b: how many times as probable per link. Taken.
BOUND = 4.0
#: Of the search for the best partition in one group.
TIME_LIMIT_S = 10.0


def held(found: Objects, before: IntArray, log_bound: float) -> tuple[Objects, BoolArray]:
    """The objects of an instant, together as they were where nothing else is much more probable, and which (n,) of
    them are shown for that reason alone.

    Parameters
    ----------
    before : (records,) the object that each record's track was of at the last instant, in the order of the union's
        records; −1 for records that were not there.
    log_bound : ln b; 0 where the most probable answer is always shown.
    """
    sets, answer = found.sets, found.answer
    links = _links(sets, before)
    wanted = _changed(sets, before, answer.chosen) if log_bound > 0.0 else np.zeros(len(sets.start) - 1, bool)
    if not wanted.any():
        return found, np.zeros(len(found), bool)
    tilted = replace(sets, log_weight=sets.log_weight + log_bound * links)
    steady = best_partition(tilted, len(found.union), wanted, time_limit_s=TIME_LIMIT_S).chosen
    chosen = np.where(wanted[sets.group], steady, answer.chosen)
    lost = _value(sets, answer.chosen) - _value(sets, chosen)
    shown = replace(found, answer=replace(answer, chosen=chosen, gap=answer.gap + np.maximum(lost, 0.0)))
    return shown, ~answer.chosen[shown.set_of_object]


def _links(sets: Sets, before: IntArray) -> IntArray:
    """(k,) links that a set keeps: its records that were there, less the objects of the last instant that they were."""
    was = np.sort(np.append(before, -1)[sets.members], axis=1)
    there = was >= 0
    objects = (there[:, :1] + np.cumsum((was[:, 1:] != was[:, :-1]) & there[:, 1:], axis=1))[:, -1:].sum(axis=1)
    return np.asarray(there.sum(axis=1) - objects)


def _changed(sets: Sets, before: IntArray, chosen: BoolArray) -> BoolArray:
    """(g,) groups in which the chosen sets part what was together and could still be."""
    which = np.flatnonzero(chosen)
    at, source = np.nonzero(sets.members[which] >= 0)
    was = before[sets.members[which][at, source]]
    known = np.unique(np.column_stack([sets.group[which[at]], was, which[at]])[was >= 0], axis=0)
    parted = (known[1:, :2] == known[:-1, :2]).all(axis=1)
    out = np.zeros(len(sets.start) - 1, bool)
    out[known[1:][parted, 0]] = True
    return out


def _value(sets: Sets, chosen: BoolArray) -> FloatArray:
    """(g,) ln w of the partition of each group."""
    return np.asarray(np.bincount(sets.group[chosen], sets.log_weight[chosen], len(sets.start) - 1), np.float64)
