"""GOSPA: how far a fused picture is from the truth, wrong places, missed objects and false ones in one number.

Generalized optimal sub-pattern assignment with α = 2 (Rahmathullah, García-Fernández, Svensson, "Generalized optimal
sub-pattern assignment metric", FUSION 2017, definition 1 and proposition 1):

    GOSPA^p = min over one-to-one sets of pairs of  Σ_pairs min(d, c)^p + c^p/2 · (missed + false),

d the distance, c the cutoff. It is a matching of greatest Σ (c^p − d^p) over pairs nearer than c, which the gate, the
groups and the assignment of this package solve, whatever the size of the picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray, IntArray
from sameas.assignment import assign, refuse_crowds
from sameas.errors import InputError
from sameas.gate import Radius
from sameas.groups import groups
from sameas.prior import PerPair
from sameas.records import Records


@dataclass(frozen=True)
class Gospa:
    """The metric and its parts; ``distance`` is in the unit of the positions, the parts in that unit to the ``order``.

    localisation : Σ d^p of the matched. missed, false : numbers of objects that nothing was matched to, and of found
    ones that are matched to nothing.
    """

    localisation: float
    missed: int
    false: int
    cutoff: float
    order: float

    @property
    def distance(self) -> float:
        """The metric: (localisation + c^p/2 · (missed + false))^(1/p)."""
        total = self.localisation + 0.5 * self.cutoff**self.order * (self.missed + self.false)
        return float(total ** (1.0 / self.order))


def gospa(found: ArrayLike, true: ArrayLike, *, cutoff: float, order: float = 2.0) -> Gospa:
    """How far the objects ``found`` (n, d) are from the ``true`` ones (m, d).

    Parameters
    ----------
    cutoff : c, the distance from which on a found object is no estimate of a true one.
    order : p ≥ 1; 2 weighs distances as variances do.

    Example
    -------
    >>> picture = gospa([[0.0, 0.0], [9.0, 9.0]], [[0.0, 1.0], [5.0, 0.0]], cutoff=2.0)
    >>> picture.missed, picture.false, round(picture.distance**2, 6)
    (1, 1, 5.0)
    """
    rows_found, rows_true, distance = nearest_match(found, true, cutoff=cutoff, order=order)
    missed, false = len(np.asarray(true)) - len(rows_true), len(np.asarray(found)) - len(rows_found)
    return Gospa(float(np.sum(distance**order)), missed, false, cutoff, order)


def nearest_match(
    found: ArrayLike, true: ArrayLike, *, cutoff: float, order: float = 2.0
) -> tuple[IntArray, IntArray, FloatArray]:
    """The one-to-one match that the metric takes: rows of ``found`` and ``true``, (k,) each, and their distances (k,).

    Pictures that lie farther apart than ``cutoff`` can be matched all at once: the match of each is that of it alone.
    """
    if not (0.0 < cutoff < math.inf and 1.0 <= order < math.inf):
        raise InputError(
            f"gospa: cutoff is {cutoff}, order {order}; give a positive distance and an order of 1 or more"
        )
    # Errors of c/√2 each: Mahalanobis distances are distances over the cutoff.
    sides = [Records.of(_places(x), sigma=cutoff / math.sqrt(2.0)) for x in (found, true)]
    if sides[0].d != sides[1].d:
        raise InputError(f"gospa: found objects have {sides[0].d} features, true ones {sides[1].d}; give the same")
    for side, name in zip(sides, ("found", "true"), strict=True):
        if len(side) < side.n_table:
            raise InputError(f"gospa: a {name} object has no position (first: row {side.set_aside.rows[0]})")
    pairs = Radius(1.0)(*sides)
    refuse_crowds(pairs)
    grouped = groups(pairs)
    gain = 1.0 - pairs.mahalanobis_sq ** (order / 2.0)
    best = assign(grouped, gain, PerPair(0.0)(grouped.sizes_1, grouped.sizes_2))
    chosen = grouped.order[best.chosen]
    distance = cutoff * np.sqrt(pairs.mahalanobis_sq[chosen])
    return pairs.i[chosen].astype(np.int64), pairs.j[chosen].astype(np.int64), distance


def _places(positions: ArrayLike) -> FloatArray:
    places = np.asarray(positions, np.float64)
    if places.ndim != 2 or not places.shape[1]:
        raise InputError(f"gospa: positions have shape {places.shape}; give (objects, features), (0, d) for none")
    return places
