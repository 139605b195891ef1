"""Standing: vessels at anchor or alongside stay where they are, and say so with a velocity of about 0.

The walk of velocities that is right for a vessel under way lets one at anchor, which reports every three minutes,
stray by 150 m between two reports; it swings by some 15. :func:`standing` takes every reported velocity v, of
covariance C, for that of one of two kinds of objects:

    stands   v ~ N(0, C + s² 1), a share w of all,  s = motion.standing_m_per_s, w = motion.standing_share
    goes     v ~ N(0, C + V² 1), all others,        V = motion.speed_m_per_s

Of one that stands the velocity is 0 ± s before it is told, and does not walk. The state is the mean of both by their
probabilities, its covariance that of the mixture; the walk is that of those that go times the probability to go
(Bar-Shalom, Li and Kirubarajan 2001, 1.4.16). There is no threshold: who makes 2 knots goes, who makes 0.2 stands, and
between the two a covariance holds both. Velocities that nobody told stay unknown.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import expit

from sameas.errors import InputError
from sameas.records import FloatArray
from sameas.tracks.alignment import States
from sameas.tracks.source import Motion

#: A variance of a velocity not below this share of that of all objects is that of a velocity not told.
UNTOLD = 0.9


def standing(reports: States, motion: Motion) -> tuple[States, FloatArray | None]:
    """The reports with the velocities that standing objects have, and (n,) the probability that each stands.

    None, and the reports as they are, where the motion says nothing of objects that stand.

    >>> told = States.of([0.0, 0.0], [[0.0, 0.0]] * 2, np.eye(2), speed_m_per_s=8.0, velocity=[[0.1, 0.0], [4.0, 0.0]],
    ...                  velocity_covariance=0.09 * np.eye(2))
    >>> motion = Motion(speed_m_per_s=8.0, standing_m_per_s=0.1, standing_share=0.2)
    >>> now, stands = standing(told, motion)
    >>> stands.round(2).tolist(), now.state[:, 2].round(2).tolist()
    ([0.99, 0.0], [0.01, 4.0])
    """
    slow, speed, share = motion.standing_m_per_s, motion.speed_m_per_s, motion.standing_share
    if not slow or not speed or not share:
        return reports, None
    if share >= 1.0:
        raise InputError(f"motion.standing_share is {share}; give the share of objects that stand, below 1")
    stands, state, covariance = np.zeros(len(reports)), reports.state.copy(), reports.covariance.copy()
    told = np.flatnonzero(reports.usable & (reports.covariance[:, 2, 2] < UNTOLD * speed**2))
    x, p = state[told], covariance[told]
    odds = math.log(share) - math.log1p(-share) + _log_density(x, p, slow) - _log_density(x, p, speed)
    chance = np.asarray(expit(odds))
    gain = p[:, :, 2:] @ np.linalg.inv(p[:, 2:, 2:] + slow**2 * np.eye(2))
    step = -np.einsum("nvw,nw->nv", gain, x[:, 2:])
    still = p - gain @ p[:, 2:, :]
    weight = chance[:, None, None]
    state[told] = x + chance[:, None] * step
    mixed = weight * still + (1.0 - weight) * p + weight * (1.0 - weight) * step[:, :, None] * step[:, None, :]
    covariance[told], stands[told] = 0.5 * (mixed + mixed.transpose(0, 2, 1)), chance
    return States(reports.time_s, state, covariance, reports.track, reports.rows), stands


def _log_density(state: FloatArray, covariance: FloatArray, spread: float) -> FloatArray:
    """(n,) ln of the density of velocities, up to what is the same for any spread."""
    total = covariance[:, 2:, 2:] + spread**2 * np.eye(2)
    square = np.einsum("nv,nv->n", state[:, 2:], np.linalg.solve(total, state[:, 2:, None])[..., 0])
    return np.asarray(-0.5 * square - 0.5 * np.log(np.linalg.det(total)))
