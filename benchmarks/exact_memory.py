"""What a picture with memory states of pairs of ships at anchor, beside the exact posterior of all their reports.

Two ships lie up to 170 m apart, far from all others, and are reported by AIS and two trackers as in ``memory.py``. Each
track has one ship for good, so there are four answers: which track of each tracker is of which ship. With the size and
correlation of all errors given and the ships known to lie still, the exact posterior is that of the weighted mean
positions of all reports of each track. The picture knows none of this: ships may move, tracks may swap their ids, and
errors are estimated or, in the second method, given.

Log loss and share right are those of the object that the picture shows for the first ship of each pair; that it is
another one than the most probable is its inertia. Standard errors are not given for differences: all methods are judged
on the same reports of the same ships.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from benchmarks.memory import KINDS, METHODS, SPAN_S, WARM_S, Errors, Kind, Trial
from benchmarks.tables import Table, report
from sameas.picture.picture import picture_states
from sameas.picture.picture_state import PictureState
from sameas.simulate.sensors import TrueMotion
from sameas.tracks.alignment import States
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, Motion, SensorErrors

#: Pairs of ships in a scene, in rows of six, and the distance of neighbouring pairs, metres.
PAIRS, ROW, APART_M = 24, 6, 2000.0
#: Largest offset of the second ship from the first along each axis, metres.
OFFSET_M = 120.0
#: The methods that are judged.
WAYS = ("memory", "memory, errors known")
#: Seconds of a picture before its statements are judged: the exact posterior counts reports before its first instant.
SETTLED_S = 300.0


def anchored(seed: int) -> tuple[TrueMotion, Reports]:
    """Ships 2k and 2k + 1 lie near each other; AIS reports them every ten seconds."""
    rng = np.random.default_rng((seed, PAIRS))
    places = np.column_stack(np.divmod(np.arange(PAIRS), ROW)) * APART_M
    places = np.repeat(places, 2, axis=0)
    places[1::2] += rng.uniform(-OFFSET_M, OFFSET_M, (PAIRS, 2))
    times = np.arange(0.0, SPAN_S + 20.0, 10.0)
    lat, lon = LocalPlane.about([50.0], [-1.0]).to_geodetic(np.repeat(places, len(times), axis=0))
    n = len(lat)
    log = Reports.of("ais", "ais", {
        "time_s": np.tile(times, len(places)), "lat_deg": lat, "lon_deg": lon, "speed_m_per_s": np.zeros(n),
        "course_deg": np.zeros(n), "mmsi": np.repeat([f"{235000000 + k}" for k in range(len(places))], len(times)),
    }).in_time_order()  # fmt: skip
    described = Description("ais", "ais", errors=SensorErrors(position_m=5.0), motion=Motion(0.01, 8.0))
    return TrueMotion.of(log, described), log


def mean_position(times_s: np.ndarray, position: np.ndarray, errors: Errors) -> tuple[np.ndarray, float]:
    """The weighted mean (2,) of a track's positions (k, 2) of a ship at rest, and its variance along each axis."""
    lag = np.abs(times_s[:, None] - times_s)
    new = 1.0 - errors.constant - errors.correlated
    shares = errors.constant + errors.correlated * np.exp(-lag / errors.tau_s) + new * np.eye(len(times_s))
    weight = np.linalg.solve(errors.sigma_m**2 * shares, np.ones(len(times_s)))
    return weight @ position / weight.sum(), 1.0 / float(weight.sum())


def exact_posterior(trial: Trial, kind: Kind, ships: tuple[int, int], first_s: float, now_s: float) -> np.ndarray:
    """(2, 2) probability that each tracker's tracks belong to the other ship: [0, 0] is the truth."""
    means = {}
    for s, (feed, errors) in enumerate(zip(trial.scene.feeds, (kind.ais, *kind.trackers), strict=True)):
        states = feed.reports
        assert isinstance(states, States)
        for side, ship in enumerate(ships):
            rows = np.flatnonzero(trial.truth[s] == ship)
            rows = rows[(states.time_s[rows] <= now_s) & (states.time_s[rows] > first_s - 30.0)]
            means[s, side] = mean_position(states.time_s[rows], states.state[rows, :2], errors)

    def log_density(members: Sequence[tuple[int, int]]) -> float:
        place, weight = np.array([means[m][0] for m in members]), np.array([1.0 / means[m][1] for m in members])
        middle = weight @ place / weight.sum()
        return -0.5 * float(weight @ np.sum((place - middle) ** 2, axis=1))

    logs = [sum(log_density([(0, k), (1, k ^ a), (2, k ^ b)]) for k in (0, 1)) for a, b in product((0, 1), repeat=2)]
    weight = np.exp(np.array(logs) - max(logs))
    return (weight / weight.sum()).reshape(2, 2)


def shown(state: PictureState, trial: Trial, ships: tuple[int, int]) -> tuple[tuple[int, int] | None, float]:
    """Which tracks the object with the AIS of the first ship has (0 own, 1 those of the other), and its probability;
    None if it is none of the four answers."""
    source, true = trial.truth_of(state.scan)
    (own,) = np.flatnonzero((source == 0) & (true == ships[0]))
    (n,) = np.flatnonzero((state.members == own).any(axis=1))
    tracks = {int(source[k]): int(true[k]) for k in state.members[n] if k >= 0}
    if set(tracks) != {0, 1, 2} or not set(tracks.values()) <= set(ships):
        return None, float(state.probability[n])
    return (int(tracks[1] != ships[0]), int(tracks[2] != ships[0])), float(state.probability[n])


def judged(kind: Kind, seeds: Sequence[int], every_s: float) -> dict[str, np.ndarray]:
    """By method, (n, 3) of each pair and instant: probability stated, exact one of the same answer, whether it is
    right. Objects that are none of the four answers count as wrong, with an exact probability of 0."""
    rows: dict[str, list[tuple[float, float, bool]]] = {way: [] for way in WAYS}
    for seed in seeds:
        true, log = anchored(seed)
        trial = Trial.of(true, log, kind, seed, misses=0.01)
        first = float(log.time_s.min()) + WARM_S
        instants = np.arange(first, float(log.time_s.min()) + SPAN_S - 10.0, every_s)
        each_way = (picture_states(trial.scene, instants, METHODS[way](kind)) for way in WAYS)
        for states in zip(*each_way, strict=True):
            now_s = states[0].now.instant_s
            if now_s < first + SETTLED_S:
                continue
            for k in range(PAIRS):
                ships = 2 * k, 2 * k + 1
                posterior = exact_posterior(trial, kind, ships, first, now_s)
                for way, state in zip(WAYS, states, strict=True):
                    answer, stated = shown(state, trial, ships)
                    exact = 0.0 if answer is None else float(posterior[answer])
                    rows[way].append((stated, exact, answer == (0, 0)))
    return {way: np.array(some, np.float64) for way, some in rows.items()}


def table(seeds: Sequence[int], every_s: float, only: str) -> Iterator[Table]:
    """The table of the kinds of errors without swaps, of which the exact posterior is known."""
    rows: list[list[object]] = []
    for kind in (kind for kind in KINDS if not any(t.swaps for t in kind.trackers) and only in kind.words):
        for way, some in judged(kind, seeds, every_s).items():
            stated, exact, right = some.T
            losses = [-np.log(np.clip(np.where(right > 0, p, 1.0 - p), 1e-9, 1.0)).mean() for p in (stated, exact)]
            near = np.minimum(stated, exact) < 0.99
            odds = np.abs(np.log(stated / (1.0 - stated)) - np.log(exact / (1.0 - exact)))[
                near & (exact > 0) & (exact < 1)
            ]
            rows.append(
                [kind.words, way, len(stated), 100.0 * float(right.mean()), *map(float, losses), float(np.median(odds))]
            )
    yield Table(
        "Pairs of ships at anchor: what the picture states beside the exact posterior",
        ("errors", "way", "objects", "right, %", "log loss", "exact", "median |Δ ln odds|"), rows,
        (f"{len(seeds)} scenes of {PAIRS} pairs, every {every_s:g} s; Δ ln odds of the objects below 0.99 by either",),
    )  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench exact_memory", description=__doc__)
    parser.add_argument("--every", type=float, default=60.0, help="seconds between instants (default 60)")
    parser.add_argument("--seeds", type=int, default=12, help="scenes of each kind (default 12)")
    parser.add_argument("--only", default="", help="kinds whose name contains this")
    options = parser.parse_args()
    report("exact_memory", table(range(options.seeds), options.every, options.only))


if __name__ == "__main__":
    main()
