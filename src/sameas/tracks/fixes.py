"""Fixes: which reports of a track measured its position anew, and which repeat the last one.

Receivers and data bases hand out the last position that they have again and again, each time with the time of the day
and perhaps a new velocity. Taken for measured ones such positions show a moving object standing still. :func:`fresh`
sets them aside; the old fix then stands for the object, as old as it is.
"""

from __future__ import annotations

import numpy as np

from sameas.gate import ChiSquare
from sameas.records import FloatArray
from sameas.tracks.alignment import States

#: An object moves whose velocity cannot be 0, but for one chance in so many.
MOVES = ChiSquare(1.0 - 1e-6)


def fresh(reports: States) -> tuple[States, tuple[str, ...]]:
    """The reports without positions that are repeated to the last digit though their object moves, and notes.

    An object that stands, or whose velocity is not told, may show one place twice. What is set aside has no position
    any more, and is not used.

    >>> track, v = ["a"] * 3, [[50.0, 0.0]] * 3
    >>> said = States.of([0.0, 1.0, 2.0], [[0.0, 0.0], [0.0, 0.0], [99.0, 0.0]], np.eye(2), speed_m_per_s=150.0,
    ...                  velocity=v, velocity_covariance=np.eye(2), track=track)
    >>> fresh(said)[0].usable.tolist()
    [True, False, True]
    """
    if reports.track is None or len(reports) < 2:
        return reports, ()
    usable = np.flatnonzero(reports.usable)
    _, number = np.unique(reports.track[usable].astype(str), return_inverse=True)
    rows = usable[np.lexsort([reports.time_s[usable], number])]
    number = np.sort(number)
    again = (number[1:] == number[:-1]) & (reports.state[rows[1:], :2] == reports.state[rows[:-1], :2]).all(axis=1)
    repeated = rows[1:][again]
    repeated = repeated[_moves(reports.state[repeated, 2:], reports.covariance[repeated, 2:, 2:])]
    if not len(repeated):
        return reports, ()
    state = reports.state.copy()
    state[repeated] = np.nan
    told = "1 report repeats the position" if len(repeated) == 1 else f"{len(repeated)} reports repeat the positions"
    note = f"{told} of before though the object moves: set aside, no position was measured"
    return States(reports.time_s, state, reports.covariance, reports.track, reports.rows), (note,)


def _moves(velocity: FloatArray, covariance: FloatArray) -> np.ndarray:
    """(n,) whether velocities (n, 2) are surely not 0."""
    square = np.einsum("nv,nv->n", velocity, np.linalg.solve(covariance, velocity[..., None])[..., 0])
    return np.asarray(square > MOVES.limit(2))
