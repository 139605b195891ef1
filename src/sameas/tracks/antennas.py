"""Antennas of ships: where along the hull AIS reports, from what radars see of the ship.

AIS reports the antenna. Where its message on the hull is missing, or the file gives no lengths, the antenna of a ship
of 300 m may be 100 m from the middle, far beyond all other errors: the ship and its echo would stay two objects. The
distance is constant along the heading, the same at every instant and on every course, while two ships that pass each
other change theirs. Where the length is known, the errors have it already (:mod:`sameas.io.sensors.ais`).

:func:`antenna_offsets` has for each track of AIS the separation (u, v) along and across its course of the only echo
near it, at instants of the common time. Its means ū and v̄, weighted by the variances of both positions, have the 1σ
that the scatter of all tracks shows, σ. The offset d of the antenna is a priori within the errors assumed for hulls,
N(0, s²), or larger with probability ``LARGE``, N(0, S²); that of a track is the mean of its posterior,

    d = ū Σ_k w_k σ_k² / (σ_k² + σ²),   w_k ∝ p_k N(ū; 0, σ_k² + σ²),   σ_1 = s,  σ_2 = S,

where u is constant and v̄ is not significant. :func:`with_antennas` moves the positions by it, along the courses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import softmax

from sameas.arrays import BoolArray, ColumnTable, FloatArray, IntArray
from sameas.tracks.alignment import States
from sameas.tracks.feed import Feed
from sameas.tracks.kinds import KINDS
from sameas.tracks.plot_pairs import shows_tracks
from sameas.tracks.snapshot import Snapshot, common_instants

#: Kind of the sources whose positions are those of an antenna.
OF_ANTENNAS = "ais"
#: Largest separation of an antenna and its echo, metres; only other objects farther than the second leave no doubt
#: which echo is the ship's (chosen).
LARGEST_M, ALONE_M = 250.0, 400.0
#: Ships are compared under way, m/s: slower, courses are not headings.
UNDER_WAY_M_PER_S = 2.0
#: Instants at which a source of AIS is compared with another.
INSTANTS = 48
#: Fewest instants of a track with one echo alone, and the least time between the first and the last (chosen).
MIN_LOOKS, MIN_SPAN_S = 5, 120.0
#: Prior 1σ of offsets, metres, and the probability of the larger ones: as of large ships.
USUAL_M, LARGE_M, LARGE = 10.0, 50.0, 0.2
#: 1σ of the middle of the echo from that of the hull, metres; it is constant (chosen).
ECHO_M = 6.0
#: An offset is constant if its mean square residual is at most so many times that of all tracks, and if its two halves
#: agree within so many σ, as its mean across does with 0 (chosen).
CONSTANT, AGREES = 4.0, 3.0
SMALLEST_M = 10.0  # smaller offsets are not taken: they are within the errors assumed for hulls


@dataclass(frozen=True)
class _Looks(ColumnTable):
    """Looks at ships with one echo alone, (n,) each: track, time, and the separation of the echo and its variance,
    along and across the course (n, 2)."""

    track: IntArray
    time_s: FloatArray
    apart: FloatArray
    variance: FloatArray


def antenna_offsets(feeds: Sequence[Feed]) -> dict[str, dict[str, float]]:
    """By source of AIS and track, by how many metres the middle of the ship is ahead of the reported positions.

    feeds : corrected for the biases of their sources.
    """
    out: dict[str, dict[str, float]] = {}
    for feed in feeds:
        if feed.description.kind == OF_ANTENNAS and shows_tracks(feed):
            offsets = _offsets(feed, [other for other in feeds if _shows_hulls(other)])
            if offsets:
                out[feed.description.name] = offsets
    return out


def with_antennas(feed: Feed, offsets: Mapping[str, float]) -> Feed:
    """The feed with the positions of tracks moved ahead by their offsets, metres along their courses; by less where
    they are slower than ``UNDER_WAY_M_PER_S``, so that a ship that stops has its antenna's place."""
    if not offsets or feed.reports.track is None:
        return feed
    ahead_m = np.array([offsets.get(track, 0.0) for track in feed.reports.track.tolist()])
    rows = np.flatnonzero(ahead_m)

    def moved(reports: States) -> States:
        velocity = reports.state[rows, 2:]
        speed = np.maximum(np.hypot(*velocity.T), UNDER_WAY_M_PER_S)
        state = reports.state.copy()
        state[rows, :2] += (ahead_m[rows] / speed)[:, None] * velocity
        return replace(reports, state=state)

    assert isinstance(feed.reports, States)
    measured = None if feed.measured is None else moved(feed.measured)
    # Their times stay, and so does which of them is current at an instant.
    out = replace(feed, reports=moved(feed.reports), measured=measured)
    return out.with_succession(feed.succession, feed.track_timeout_s)


def antenna_lines(antennas: Mapping[str, Mapping[str, float]]) -> tuple[str, ...]:
    """Printable sentences on the offsets of :func:`antenna_offsets`."""
    lines = []
    for source, offsets in antennas.items():
        metres = np.abs(list(offsets.values()))
        one = len(metres) == 1
        antennas_are = "the antenna of 1 ship is" if one else f"the antennas of {len(metres)} ships are"
        apart = f"{metres.min():.0f} m" if one else f"{metres.min():.0f} to {metres.max():.0f} m"
        lines.append(
            f"{source}: {antennas_are} {apart} before or behind what other sensors see, at all times; positions are "
            "moved by it along the course"
        )
    return tuple(lines)


def _shows_hulls(feed: Feed) -> bool:
    """Whether a source shows the places of hulls, as tracks."""
    kind = feed.description.kind
    return shows_tracks(feed) and kind != OF_ANTENNAS and KINDS[kind].target != "aircraft"


def _has_length(feed: Feed) -> BoolArray:
    """(n,) whether a report of a feed gives the length of its ship."""
    length_m = None if feed.raw_reports is None else feed.raw_reports.length_m
    return np.zeros(len(feed.reports), bool) if length_m is None else np.isfinite(length_m[feed.reports.rows])


def _offsets(feed: Feed, others: Sequence[Feed]) -> dict[str, float]:
    """By track of a source of AIS, its offset, where it is taken."""
    names, number = np.unique(np.asarray(feed.reports.track, np.str_), return_inverse=True)
    of_known_length = set(number[_has_length(feed)].tolist())
    parts = [look for other in others for look in _looks(feed, other, number)]
    if not parts:
        return {}
    looks = parts[0].stacked(*parts[1:])
    enough = [np.flatnonzero(looks.track == k) for k in np.unique(looks.track) if k not in of_known_length]
    enough = [at for at in enough if len(at) >= MIN_LOOKS and np.ptp(looks.time_s[at]) >= MIN_SPAN_S]
    means = [_mean(looks.apart[at], looks.variance[at]) for at in enough]
    residual_sq = [
        np.mean((looks.apart[at] - m) ** 2 / looks.variance[at]) for at, m in zip(enough, means, strict=True)
    ]
    scale_sq = float(np.median(residual_sq)) if residual_sq else 0.0
    out = {}
    for at, mean, square in zip(enough, means, residual_sq, strict=True):
        in_time = at[np.argsort(looks.time_s[at], kind="stable")]
        halves = [_mean(looks.apart[half], looks.variance[half]) for half in np.array_split(in_time, 2)]
        variance = scale_sq / np.sum(1.0 / looks.variance[at], axis=0)
        sigma = np.sqrt(variance + ECHO_M**2)
        is_constant = square <= CONSTANT * scale_sq and abs(halves[0][0] - halves[1][0]) <= AGREES * 2.0 * sigma[0]
        offset_m = _posterior_mean(float(mean[0]), float(sigma[0]))
        if is_constant and abs(mean[1]) <= AGREES * sigma[1] and SMALLEST_M <= abs(offset_m) <= LARGEST_M:
            out[str(names[looks.track[at[0]]])] = offset_m
    return out


def _looks(feed: Feed, other: Feed, number: IntArray) -> Iterator[_Looks]:
    """The looks at each instant of the common time; number : (n,) of the tracks of the reports."""
    for instant_s in common_instants(feed, other, INSTANTS).tolist():
        ships, echoes = (Snapshot.of(one.as_measured, instant_s).between_reports(instant_s) for one in (feed, other))
        ship, echo = _alone(ships.state[:, :2], echoes.state[:, :2])
        velocity = ships.state[ship, 2:]
        apart, speed = echoes.state[echo, :2] - ships.state[ship, :2], np.hypot(*velocity.T)
        near = np.flatnonzero((speed > UNDER_WAY_M_PER_S) & (np.hypot(*apart.T) <= LARGEST_M))
        ahead = velocity[near] / speed[near, None]
        axes = np.stack([ahead, ahead[:, ::-1] * (1.0, -1.0)], axis=1)
        covariance = (ships.covariance[ship] + echoes.covariance[echo])[near, :2, :2]
        yield _Looks(
            track=number[ships.rows[ship[near]]], time_s=np.full(len(near), instant_s),
            apart=np.einsum("nvw,nw->nv", axes, apart[near]),
            variance=np.einsum("nvw,nwx,nvx->nv", axes, covariance, axes),
        )  # fmt: skip


def _alone(ships: FloatArray, echoes: FloatArray) -> tuple[IntArray, IntArray]:
    """(k,), (k,) ships (n, 2) and echoes (m, 2) with nothing else of either source within ``ALONE_M`` of the ship."""
    if not len(ships) or not len(echoes):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    tree = cKDTree(echoes)
    of_echoes, of_ships = (each.query_ball_point(ships, ALONE_M, return_length=True) for each in (tree, cKDTree(ships)))
    one = np.flatnonzero((of_echoes == 1) & (of_ships == 1))
    return one, np.asarray(tree.query(ships[one])[1], np.int64)


def _mean(values: FloatArray, variance: FloatArray) -> FloatArray:
    """(2,) means of values (n, 2) with these variances."""
    return np.asarray(np.sum(values / variance, axis=0) / np.sum(1.0 / variance, axis=0))


def _posterior_mean(mean_m: float, sigma_m: float) -> float:
    """The mean of the posterior of an offset.

    >>> round(_posterior_mean(80.0, 10.0)), round(_posterior_mean(15.0, 10.0))
    (77, 8)
    """
    widths, log_prior = np.array([USUAL_M, LARGE_M]), np.log([1.0 - LARGE, LARGE])
    total = widths**2 + sigma_m**2
    weight = softmax(log_prior - 0.5 * (mean_m**2 / total + np.log(total)))
    return mean_m * float(weight @ (widths**2 / total))
