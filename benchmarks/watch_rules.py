"""Simple rules that operators use today for faults and deception, on the feeds of a scene: thresholds only.

- jumped: two successive reports of one identity need more than 60 kn (vessels) or 1 000 kn (aircraft).
- alone: a moving ship of AIS (1.5 m/s, aircraft 40) within a radar's range has had no echo within 500 m (aircraft
  2 km) for 3 min.
- silent: a radar's track has had no AIS within 500 m (2 km) for 3 min, or a ship of AIS none of its own for 6 min.
- clock: stamps go back by more than 10 s in the order of the file, or no report has a stamp within 20 s.
- ended: the last report is 60 s before that of the other sources.
- frozen: three successive reports of a ship under way have one position.
- flood: a minute has more than three times as many reports as the median one.

The rules are on at once, as a watch would have them; thresholds are round numbers about those of VTS manuals, the
same for all scenes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sameas.tracks.alignment import States
from sameas.tracks.feed import CORRELATED_KINDS, Feed
from sameas.tracks.kinds import KINDS

SOURCE_RULES = (
    "rules: stamps back by 10 s or none for 20 s (clock); 60 s before the others (ended); one position three times "
    "under way (frozen); a minute with three times the median (flood)"
)
SHIP_RULES = (
    "rules: above 60 kn between two reports; no echo within 500 m of a moving ship in range for 3 min; no AIS within "
    "500 m of a radar's track for 3 min, or none of a ship for 6 min"
)


@dataclass(frozen=True)
class Limits:
    """Thresholds of the rules, for vessels or aircraft."""

    speed_m_per_s: float = 60.0 * 0.5144
    radius_m: float = 500.0
    moving_m_per_s: float = 1.5
    alone_s: float = 180.0
    lost_s: float = 360.0
    back_s: float = 10.0
    gap_s: float = 20.0
    ended_s: float = 60.0
    repeats: int = 3
    flood: float = 3.0


VESSELS, AIRCRAFT = Limits(), Limits(speed_m_per_s=1000.0 * 0.5144, radius_m=2000.0, moving_m_per_s=40.0)
#: Seconds between the checks of the rules of distance; an echo is one of the last of these, a radar's track of three.
STEP_S = 10.0
#: Kind, source and track of an alarm; the track is empty for a whole source.
RuleAlarm = tuple[str, str, str]


def source_alarms(feeds: Sequence[Feed]) -> frozenset[RuleAlarm]:
    """The alarms of the rules that need one source at a time."""
    return frozenset(alarm for feed in feeds for alarm in _of_one(feed, feeds))


def rule_alarms(feeds: Sequence[Feed]) -> frozenset[RuleAlarm]:
    """All alarms of the rules."""
    out = set(source_alarms(feeds))
    for ships in (feed for feed in feeds if feed.description.kind in CORRELATED_KINDS):
        for radar in feeds:
            if radar.description.kind not in CORRELATED_KINDS and isinstance(radar.reports, States):
                out |= set(_of_both(ships, radar))
    return frozenset(out)


def limits_of(feed: Feed) -> Limits:
    """The thresholds for the objects of a source."""
    return AIRCRAFT if KINDS[feed.description.kind].target == "aircraft" else VESSELS


def _of_one(feed: Feed, feeds: Sequence[Feed]) -> Iterator[RuleAlarm]:
    raw, limits, name = feed.raw_reports, limits_of(feed), feed.description.name
    if raw is None or not len(raw):
        return
    ends = [float(other.reports.time_s.max()) for other in feeds if other is not feed and len(other.reports)]
    if ends and max(ends) - float(raw.time_s.max()) > limits.ended_s:
        yield "ended", name, ""
    steps = np.diff(raw.time_s)
    if len(raw) > 1 and (steps.min() < -limits.back_s or np.diff(np.sort(raw.time_s)).max() > limits.gap_s):
        yield "clock", name, ""
    count = np.bincount(((raw.time_s - raw.time_s.min()) // 60.0).astype(np.int64))
    if len(count) > 2 and count.max() > limits.flood * np.median(count):
        yield "flood", name, ""
    if feed.description.kind not in CORRELATED_KINDS or raw.object_ids is None:
        return
    reports = feed.reports
    assert isinstance(reports, States)
    ids = raw.object_ids[reports.rows].astype(str)
    frozen = False
    for track in np.unique(ids):
        rows = np.flatnonzero((ids == track) & np.isfinite(reports.state[:, 0]))
        rows = rows[np.argsort(reports.time_s[rows], kind="stable")]
        place, time_s = reports.state[rows, :2], reports.time_s[rows]
        moved, spent = np.hypot(*np.diff(place, axis=0).T), np.diff(time_s)
        # Positions have errors of some metres, and a stamp may be of the same second.
        if (moved - 50.0 > limits.speed_m_per_s * np.maximum(spent, 1.0)).any():
            yield "jumped", name, str(track)
        if float(reports.time_s.max()) - time_s.max(initial=-np.inf) > limits.lost_s:
            yield "silent", name, str(track)
        own = np.flatnonzero(raw.object_ids.astype(str) == track)
        own = own[np.argsort(raw.time_s[own], kind="stable")]
        given = next((pair for pair in ((raw.lat_deg, raw.lon_deg), (raw.x_m, raw.y_m)) if pair[0] is not None), None)
        speed = raw.velocity_m_per_s()
        if given is None or speed is None:
            continue
        same = (np.diff(given[0][own]) == 0.0) & (np.diff(given[1][own]) == 0.0)  # type: ignore[index]
        same &= np.hypot(*speed[own].T)[1:] > limits.moving_m_per_s
        frozen |= _longest(same) >= limits.repeats - 1
    if frozen:
        yield "frozen", name, ""


def _of_both(ships: Feed, radar: Feed) -> Iterator[RuleAlarm]:
    """The rules of distance between AIS and one radar."""
    named, echoes, limits = ships.reports, radar.reports, limits_of(ships)
    assert isinstance(named, States) and isinstance(echoes, States)
    if named.track is None or not len(named) or not len(echoes):
        return
    names, ship = np.unique(named.track.astype(str), return_inverse=True)
    tracks = np.zeros(len(echoes), np.int64)
    track_names = np.array([""])
    if echoes.track is not None:
        track_names, tracks = np.unique(echoes.track.astype(str), return_inverse=True)
    alone = np.zeros((len(names), 0), bool)
    lonely = np.zeros((len(track_names), 0), bool)
    reach = radar.description.coverage.range_m or np.inf
    start = max(float(named.time_s.min()), float(echoes.time_s.min()))
    for now_s in np.arange(start + STEP_S, min(float(named.time_s.max()), float(echoes.time_s.max())), STEP_S):
        at = _last(ship, named.time_s, now_s, 6.0 * STEP_S, len(names), named.usable)
        place = np.full((len(names), 2), np.nan)
        known = at >= 0
        state = named.state[at[known]]
        place[known] = state[:, :2] + np.nan_to_num(state[:, 2:]) * (now_s - named.time_s[at[known]])[:, None]
        fast = np.zeros(len(names), bool)
        fast[known] = np.hypot(*np.nan_to_num(state[:, 2:]).T) > limits.moving_m_per_s
        kept_s = STEP_S if echoes.track is None else 3.0 * STEP_S
        lately = (echoes.time_s > now_s - kept_s) & (echoes.time_s <= now_s) & echoes.usable
        sensor = radar.sensor_at(float(now_s))
        inside = known if sensor is None else known & (np.hypot(*(place - sensor).T) < reach)
        shown = echoes.state[lately, :2]
        free = np.zeros(len(names), bool)
        if lately.any() and inside.any():
            free[inside] = cKDTree(shown).query(place[inside])[0] > limits.radius_m
        alone = np.column_stack([alone, free & inside & fast])
        without = np.zeros(len(track_names), bool)
        if lately.any() and known.any():
            far = cKDTree(place[known]).query(shown)[0] > limits.radius_m
            without[tracks[lately][far]] = True
        lonely = np.column_stack([lonely, without])
    needed = int(limits.alone_s / STEP_S)
    for k in np.flatnonzero([_longest(row) >= needed for row in alone]).tolist():
        yield "alone", ships.description.name, str(names[k])
    for k in np.flatnonzero([_longest(row) >= needed for row in lonely]).tolist() if echoes.track is not None else ():
        yield "silent", radar.description.name, str(track_names[k])


def _last(
    owner: NDArray[np.int64],
    time_s: NDArray[np.float64],
    now_s: float,
    within_s: float,
    n: int,
    usable: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """(n,) row of the last report of each track up to now; −1 without one within ``within_s``."""
    rows = np.flatnonzero((time_s <= now_s) & (time_s > now_s - within_s) & usable)
    out = np.full(n, -1)
    out[owner[rows[np.argsort(time_s[rows], kind="stable")]]] = rows[np.argsort(time_s[rows], kind="stable")]
    return out


def _longest(flags: NDArray[np.bool_]) -> int:
    """The length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(flags, np.int64), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))
