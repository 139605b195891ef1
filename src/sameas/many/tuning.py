"""Where the identification of many sources goes over to approximations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ManyTuning:
    """Numbers that bound the work of :func:`sameas.many.identify_many`, chosen so that a group takes seconds at most.

    Attributes
    ----------
    floors : ln w below which sets are left out of a group, tried in this order until it has few enough sets.
    most_sets : of one group.
    cuts : reduced costs above which sets are left out of a group's sum, tried in this order until it is short enough.
    most_steps : from state to state in the sum of one group.
    small : groups of at most this many records are summed with all their sets.
    block_steps : from state to state in the sum of a part of a group that has a cut of its own.
    """

    floors: tuple[float, ...] = (-np.inf, 0.0, 6.0, 15.0, 30.0, 80.0, np.inf)
    most_sets: int = 400_000
    cuts: tuple[float, ...] = (30.0, 20.0, 14.0, 10.0, 8.0, 6.0, 4.0, 2.0, 1.0)
    most_steps: int = 300_000
    small: int = 8
    block_steps: int = 300_000


TUNING = ManyTuning()
