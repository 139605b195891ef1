"""Numbers of tracks that a modelled sensor gives to its plots, and the velocities that come of following them.

The tracker knows which plots are of one object, so its tracks never swap targets; they begin late, break and are
numbered anew, and false ones live for some looks, as those of real trackers do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sameas.errors import InputError
from sameas.records import FloatArray, IntArray
from sameas.tracks.alignment import States
from sameas.tracks.coordinates import LocalPlane, turned
from sameas.tracks.feed import walk_of
from sameas.tracks.filter import follow
from sameas.tracks.placement import placed
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description


@dataclass(frozen=True)
class Tracker:
    """How a sensor numbers what it sees.

    begins_after : plots that a track has before it is reported; its velocity is known from the second on.
    breaks_after : looks without a plot after which a track ends; the object gets a new number when it is seen again.
    breaks : probability per look that a track ends for no reason of that kind.
    false_looks : looks for which a false echo stays on average.
    """

    begins_after: int = 2
    breaks_after: int = 5
    breaks: float = 0.0
    false_looks: float = 4.0

    def __post_init__(self) -> None:
        if self.begins_after < 0 or self.breaks_after < 1 or not 0.0 <= self.breaks < 1.0 or self.false_looks < 1.0:
            raise InputError(f"{self}: give begins_after ≥ 0, breaks_after ≥ 1, 0 ≤ breaks < 1, false_looks ≥ 1")

    def numbers(self, look: IntArray, object: IntArray, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
        """(n,) number of the track of every plot, in the order in which tracks begin, and its place in its track."""
        order = np.lexsort([look, object])
        begins = np.ones(len(order), bool)
        same = object[order][1:] == object[order][:-1]
        silent = np.diff(look[order]) > self.breaks_after
        begins[1:] = ~same | silent | (rng.random(max(len(order) - 1, 0)) < self.breaks)
        track = np.cumsum(begins) - 1
        first = np.flatnonzero(begins)
        rank = np.empty(len(first), np.int64)
        rank[np.lexsort([object[order][first], look[order][first]])] = np.arange(1, len(first) + 1)
        number, place = np.empty(len(order), np.int64), np.empty(len(order), np.int64)
        number[order], place[order] = rank[track], np.arange(len(order)) - first[track]
        return number, place


def tracked(
    description: Description,
    tracker: Tracker,
    reports: Reports,
    plots: tuple[IntArray, IntArray],
    truth: IntArray,
    plane: LocalPlane,
    rng: np.random.Generator,
) -> tuple[Reports, IntArray]:
    """The plots that belong to reported tracks, with their numbers and velocities, and the truth of each.

    plots : look and object of every report, false objects told apart by numbers below −1.
    """
    number, place = tracker.numbers(*plots, rng)
    names = np.array([*(str(k) for k in number), None], object)[:-1]
    numbered = replace(reports, track_id=names)
    reported = np.flatnonzero(place >= tracker.begins_after)
    if numbered.position != "bearing":
        velocity, covariance = _followed(description, numbered, plane)
        velocity[place == 0] = np.nan
        numbered = replace(
            numbered, speed_m_per_s=np.hypot(*velocity.T), course_deg=np.degrees(np.arctan2(*velocity.T)) % 360.0,
            velocity_covariance_m2_per_s2=covariance,
        )  # fmt: skip
    return numbered.where(reported), truth[reported]


def _followed(description: Description, reports: Reports, plane: LocalPlane) -> tuple[FloatArray, FloatArray]:
    """(n, 2) velocities east and north that a filter over each track has come to, and (n, 3) their covariances."""
    there = placed(description, reports, plane)
    assert isinstance(there, States)
    state = follow(there, acceleration_m2_per_s3=walk_of(description)).states
    back = np.asarray(np.linalg.inv(plane.turn(*plane.to_geodetic(state.state[:, :2]))), np.float64)
    velocity = np.einsum("nvw,nw->nv", back, state.state[:, 2:])
    return velocity, turned(state.covariance[:, 2:, 2:], back)[:, [0, 0, 1], [0, 1, 1]]
