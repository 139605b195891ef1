"""Phantoms: ships of AIS, or aircraft of ADS-B, that stand where a radar sees others and that it never sees.

A transmitter can report ships that do not exist. What a radar says of a ship is a number of *looks*: intervals of
``LOOK_S`` in which the ship was under way within the coverage of the radar, at a place that it demonstrably sees
(another ship, seen at about the same bearing, stood as far away or farther), and the number of these in which the radar
showed anything near her.

- A ship that exists is seen in a look with probability d·ρ(r): ρ is the relative rate of detections at range r, from
  the ships that are seen; d, her detectability, is Beta distributed, with the mean and width that all ships together
  show. Weak boats make that distribution wide.
- A share h of the ships that exist is never seen (a hull of plastic, a filter of the radar), ``HIDDEN_SHARE`` a priori;
  of aircraft and of hulls that state ``STEEL_M`` or more, ``STEEL_SHARE`` as many. Shorter ones do not count.
- A phantom is seen by chance only: at the rate c(r) at which the radar shows anything near places turned about it.

Either no ship is invented, or a share θ of them is, a priori with ``INVENTED_ODDS``. The unknown h, θ and the two
parameters of the Beta distribution are integrated over, so the ships decide together: one that is never seen may be a
plastic yacht, five of them among forty others are no chance. The model is a Beta-binomial mixture, as for occupancy
with imperfect detection (Royle 2006, Biometrics 62, 97).

:func:`phantoms` gives every ship that some radar should have seen, with her log-odds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc, expit, logit, logsumexp

from sameas.arrays import BoolArray, ColumnTable, FloatArray, IntArray
from sameas.kernels.nearest import nearest_at_once
from sameas.ragged import Ragged
from sameas.tracks.alignment import named_tracks
from sameas.tracks.feed import CORRELATED_KINDS, Feed
from sameas.tracks.kinds import KINDS

#: Cells of bearing.
CELLS = 720

APART_SIGMAS = 5.0  # two tracks are apart beyond this
TRACKER_LAG_S = 5.0  # 1σ of the time by which a sensor's tracker follows the path of a ship late
LOOK_S, MIN_LOOKS = 30.0, 6  # one look of a radar at a ship lasts this long; a ship with fewer looks is no phantom yet
COVERED_Q = 0.9  # places at which the described probability of a miss is as high are not covered
#: Least speed of vessels, and of aircraft, that a radar is expected to see: land returns those at rest, too.
UNDER_WAY_M_PER_S = (1.5, 40.0)
#: A radar sees a ship within this share of her range, besides the errors of both: its biases may be unknown.
NEAR_SHARE = 0.01
#: Angles about the radar of the places that give the rate of chance.
TURNED_DEG = (-75.0, -45.0, -25.0, 25.0, 45.0, 75.0)
#: A place is seen if another ship within the first angle of it is, or one on either side within the second, in layers
#: of the third for aircraft.
SIGHT_DEG, SIGHT_BETWEEN_DEG, SIGHT_HEIGHT_M = 3.0, 8.0, 1000.0
SIGHT_MOVES_M = 200.0  # a radar that moves farther is on a ship
COMPARABLE_SHIPS = 4  # least number of ships that a radar sees, at a range and altogether
RANGE_BINS = 5  # of the rate at which she is seen
#: Shorter hulls are not expected to be seen, and longer ones are never seen this many times as often as those of
#: unknown length.
STEEL_M, STEEL_SHARE = 20.0, 0.2
DETECTABILITIES = 50  # number of steps of d
#: Grids of the mean and of a + b of the Beta distribution of d; the prior is uniform.
MEAN_DETECTABILITIES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98)
DETECTABILITY_WIDTHS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
HIDDEN_SHARE, INVENTED_SHARE = (0.5, 200.0), (1.0, 3.0)  # a and b of the Beta priors of h and θ
INVENTED_ODDS = 0.1  # prior odds that any ship is invented


@dataclass(frozen=True)
class Phantom:
    """A ship that a radar should have seen.

    source, track : of her reports. radar : its name. looks, seen : her looks, and those in which it showed anything
    near her. others : number of the other ships that it sees, share : of their looks in which it does, within_m : the
    range up to which it does. first_s, last_s : the first and the last look. log_odds : that she is invented.
    """

    source: str
    track: str
    radar: str
    looks: int
    seen: int
    minutes: float
    others: int
    share: float
    within_m: float
    first_s: float
    last_s: float
    log_odds: float


def phantoms(feeds: Sequence[Feed], records: Mapping[str, NDArray[Any]]) -> list[Phantom]:
    """The ships that some radar should have seen, with the log-odds that they are invented, in order of their ids.

    records : columns as of :func:`sameas.picture.deception.sightings_of`, of some minutes or of a whole picture. Where
    two radars should have seen a ship, the one that has the least doubt that she exists decides.
    """
    if not len(records["time_s"]):
        return []
    least: dict[tuple[str, str], Phantom] = {}
    for ships in (feed for feed in feeds if feed.description.kind in CORRELATED_KINDS):
        for radar in filter(_sees_by_itself, feeds):
            looks = RadarLooks.of(ships, radar, records)
            for one in () if looks is None else looks.phantoms():
                known = least.get((one.source, one.track))
                if known is None or one.log_odds < known.log_odds:
                    least[one.source, one.track] = one
    return [least[key] for key in sorted(least)]


def _sees_by_itself(feed: Feed) -> bool:
    """Whether a source measures the positions of all that is in its range. ARPA targets may be acquired by hand."""
    return (
        feed.description.kind not in CORRELATED_KINDS
        and not KINDS[feed.description.kind].directions
        and feed.sensor_m is not None
        and not (feed.raw_reports is not None and feed.raw_reports.kind == "arpa")
    )


@dataclass(frozen=True)
class ShipSightings(ColumnTable):
    """The records of the ships at the instants at which the radar shows anything, (k,) each.

    ship : index of its track in ``names``. arm : (k, 2) position from the radar. moved : whether the ship is under way.
    height_m : of the aircraft, NaN if unknown; 0 for vessels. seen : whether the radar shows anything near it.
    chance : the share of the places turned about the radar near which it does.
    """

    WHOLE = frozenset({"names"})

    names: tuple[str, ...]
    ship: IntArray
    time_s: FloatArray
    arm: FloatArray
    moved: BoolArray
    height_m: FloatArray
    seen: BoolArray
    chance: FloatArray

    @property
    def range_m(self) -> FloatArray:
        return np.asarray(np.hypot(*self.arm.T))


def _sightings(ships: Feed, radar: Feed, records: Mapping[str, NDArray[Any]]) -> ShipSightings | None:
    """None where the source has no ids or the radar shows nothing."""
    placed = ~np.ma.getmaskarray(records["x_m"])
    position = np.column_stack([np.ma.filled(records[name], np.nan) for name in ("x_m", "y_m")])
    variance = np.maximum(*(np.ma.filled(records[name], np.nan) for name in ("var_x_m2", "var_y_m2")))
    own = np.flatnonzero((records["source"] == ships.description.name) & placed)
    shown = np.flatnonzero((records["source"] == radar.description.name) & placed)
    own = own[np.isin(records["time_s"][own], records["time_s"][shown])]
    if not len(own) or ships.reports.track is None:
        return None
    names, ship = np.unique(records["track_id"][own].astype(str), return_inverse=True)
    time_s, place = records["time_s"][own], position[own]
    speed = _speeds(ship, time_s, place)
    instants, at = np.unique(time_s, return_inverse=True)
    sensor = np.array([radar.sensor_at(instant_s) for instant_s in instants.tolist()])
    shown = shown[np.isin(records["time_s"][shown], instants)]
    shown_at = np.searchsorted(instants, records["time_s"][shown])
    order = np.argsort(shown_at, kind="stable")
    shown, shown_at = shown[order], shown_at[order]
    arm, echoes = place - sensor[at], position[shown] - sensor[shown_at]
    angle = np.radians(TURNED_DEG)
    turns = np.stack([np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([-np.sin(angle), np.cos(angle)], -1)], 1)
    # The places themselves, and turned about the radar.
    places = np.concatenate([arm[None], arm @ turns])
    distance, nearest = np.empty(places.shape[:2]), np.empty(places.shape[:2], np.int64)
    nearest_at_once(places, at, echoes, Ragged.of_sorted(shown_at, len(instants)).start, distance, nearest)
    lag_s = 0.0 if radar.reports.track is None else TRACKER_LAG_S
    reach = NEAR_SHARE * np.hypot(*arm.T) + lag_s * speed + APART_SIGMAS * np.sqrt(variance[own])
    near = distance <= reach + APART_SIGMAS * np.sqrt(variance[shown])[nearest]
    with_radar = np.isin(instant_keys(at, records["object"][own]), instant_keys(shown_at, records["object"][shown]))
    seen, chance = near[0] | with_radar, near[1:].mean(axis=0)
    fast = UNDER_WAY_M_PER_S[KINDS[ships.description.kind].target == "aircraft"]
    heights = _heights(ships, names, ship, time_s)
    return ShipSightings(tuple(names.tolist()), ship, time_s, arm, speed > fast, heights, seen, chance)


def _speeds(ship: IntArray, time_s: FloatArray, place: FloatArray) -> FloatArray:
    """(k,) speeds over ground, from the positions of each ship; 0 for a ship with one record."""
    rows = np.lexsort([time_s, ship])
    rows = rows[np.append(True, (np.diff(ship[rows]) > 0) | (np.diff(time_s[rows]) > 0.0))]
    of_ship = Ragged.of_sorted(ship[rows], int(ship.max()) + 1)
    # Between the neighbours on both sides: errors of positions are no speed.
    every, number = np.arange(len(rows)), ship[rows]
    low, high = np.maximum(every - 2, of_ship.start[number]), np.minimum(every + 2, of_ship.start[number + 1] - 1)
    rows, low, high = rows[low < high], rows[low[low < high]], rows[high[low < high]]
    out = np.zeros(len(ship))
    out[rows] = np.hypot(*(place[high] - place[low]).T) / (time_s[high] - time_s[low])
    return out


def instant_keys(at: IntArray, number: IntArray) -> IntArray:
    """(k,) instant and object in one number."""
    return np.asarray(at.astype(np.int64) << 32 | number.astype(np.int64))


def _heights(ships: Feed, names: NDArray[Any], ship: IntArray, time_s: FloatArray) -> FloatArray:
    """(k,) heights of aircraft, interpolated in time; NaN where unknown. 0 for vessels."""
    if KINDS[ships.description.kind].target != "aircraft":
        return np.zeros(len(ship))
    out, raw, rows = np.full(len(ship), np.nan), ships.raw_reports, ships.reports.rows
    columns = () if raw is None else (raw.pressure_alt_m, raw.alt_m)
    given = next((column for column in columns if column is not None and np.isfinite(column).any()), None)
    if given is None or rows is None or ships.reports.track is None:
        return out
    track, height = ships.reports.track.astype(str), given[rows]
    for k, name in enumerate(names):
        own = np.flatnonzero((track == name) & np.isfinite(height))
        if len(own):
            own = own[np.argsort(ships.reports.time_s[own], kind="stable")]
            out[ship == k] = np.interp(time_s[ship == k], ships.reports.time_s[own], height[own])
    return out


def proven(one: ShipSightings, bearing_deg: FloatArray, moving: bool) -> BoolArray:
    """(k,) whether the radar demonstrably sees the place of each record.

    It saw another ship that was as far away or farther, and no higher, within ``SIGHT_DEG`` of its bearing, or one on
    either side within ``SIGHT_BETWEEN_DEG``. Land hides what is behind it, and nobody is seen there. The land about a
    radar that moves changes: then within a minute.
    """
    known = np.isfinite(one.height_m)
    band = (np.where(known, one.height_m, 0.0).clip(min=0.0) // SIGHT_HEIGHT_M).astype(np.int64)
    minute = ((one.time_s - one.time_s.min()) // 60.0).astype(np.int64) if moving else np.zeros(len(band), np.int64)
    cell = (bearing_deg % 360.0 * CELLS / 360.0).astype(np.int64) % CELLS
    seen, out = one.seen & known, np.zeros(len(band), bool)
    # Two bearings this many cells apart differ by less than the angle.
    near, wide = (int(angle * CELLS / 360.0) - 1 for angle in (SIGHT_DEG, SIGHT_BETWEEN_DEG))
    for m, b in np.unique(np.column_stack([minute, band])[known], axis=0).tolist():
        rows = np.flatnonzero((minute == m) & (band == b) & known)
        by = np.flatnonzero(seen & (np.abs(minute - m) <= 1) & (band <= b))
        farthest = _two_farthest(cell[by], one.range_m[by], one.ship[by])
        own = cell[rows], one.range_m[rows], one.ship[rows]
        ahead, left, right = (
            _as_far(_within(farthest, low, high), *own) for low, high in ((-near, near), (-wide, 0), (0, wide))
        )
        out[rows] = ahead | (left & right)
    return out


def _as_far(farthest: tuple[FloatArray, IntArray], cell: IntArray, range_m: FloatArray, ship: IntArray) -> BoolArray:
    """(k,) whether another ship is as far away as each of these."""
    distance, owner = farthest
    return np.asarray(np.where(owner[cell, 0] == ship, distance[cell, 1], distance[cell, 0]) >= range_m)


def _two_farthest(cell: IntArray, range_m: FloatArray, ship: IntArray) -> tuple[FloatArray, IntArray]:
    """(CELLS, 2) ranges of the two farthest ships in each cell of bearing, −∞ for none, and (CELLS, 2) the ships."""
    distance, owner = np.full((CELLS, 2), -np.inf), np.full((CELLS, 2), -1)
    order = np.lexsort([-range_m, cell])
    for place in range(2):
        at, first = np.unique(cell[order], return_index=True)
        distance[at, place], owner[at, place] = range_m[order[first]], ship[order[first]]
        order = order[ship[order] != owner[cell[order], place]]
    return distance, owner


def _within(farthest: tuple[FloatArray, IntArray], low: int, high: int) -> tuple[FloatArray, IntArray]:
    """The same of the cells from ``low`` to ``high`` about each one."""
    cells = (np.arange(CELLS)[:, None] + np.arange(low, high + 1)) % CELLS
    distance, owner = (column[cells].reshape(CELLS, -1) for column in farthest)
    every = np.arange(CELLS)
    out = np.full((CELLS, 2), -np.inf), np.full((CELLS, 2), -1)
    for place in range(2):
        best = distance.argmax(axis=1)
        out[0][:, place], out[1][:, place] = distance[every, best], owner[every, best]
        distance = np.where(owner == out[1][:, place, None], -np.inf, distance)
    return out


@dataclass(frozen=True)
class RadarLooks:
    """The looks of a radar at ships: (n, b) their numbers by ship and range, and those with anything near the ship.

    chance, relative : (b,) c and ρ. hidden : (n,) how many times h is each ship's. first_s, last_s : (n,) of each ship.
    within_m : the range up to which it sees. mean_detectabilities, detectability_widths : grids of its distribution.
    """

    source: str
    radar: str
    names: tuple[str, ...]
    looks: IntArray
    seen: IntArray
    chance: FloatArray
    relative: FloatArray
    hidden: FloatArray
    first_s: FloatArray
    last_s: FloatArray
    within_m: float
    mean_detectabilities: tuple[float, ...] = MEAN_DETECTABILITIES
    detectability_widths: tuple[float, ...] = DETECTABILITY_WIDTHS

    @classmethod
    def of(cls, ships: Feed, radar: Feed, records: Mapping[str, NDArray[Any]]) -> RadarLooks | None:
        """None where the radar sees too few ships."""
        one = _sightings(ships, radar, records)
        if one is None:
            return None
        sensor_m = radar.sensor_m
        assert sensor_m is not None
        moving = bool(np.ptp(sensor_m, axis=0).max() > SIGHT_MOVES_M)
        bearing = np.degrees(np.arctan2(one.arm[:, 0], one.arm[:, 1]))
        covered = radar.description.q_at(one.range_m, bearing) < COVERED_Q
        length_m = _lengths(ships, one.names)
        long_enough = ~(length_m < STEEL_M)[one.ship]
        one = one.take(one.moved & covered & long_enough & proven(one, bearing, moving))
        if np.unique(one.ship[one.seen]).size < COMPARABLE_SHIPS:
            return None
        # One look an interval: a tracker that shows a ship shows it again ten seconds later.
        interval = ((one.time_s - one.time_s.min()) // LOOK_S).astype(np.int64)
        key, number = np.unique(one.ship * (int(interval.max()) + 1) + interval, return_inverse=True)
        of_look = np.bincount(number)
        seen = np.bincount(number, one.seen) > 0.0
        range_m, chance = (np.bincount(number, column) / of_look for column in (one.range_m, one.chance))
        ship = key // (int(interval.max()) + 1)
        bins, far = _range_bins(range_m, seen, ship)
        if not far > 0.0:
            return None
        n, n_bins = len(one.names), int(bins.max()) + 1
        kept = range_m <= far
        at = ship[kept] * n_bins + bins[kept]
        looks, hits = (np.bincount(at, w, n * n_bins).reshape(n, -1) for w in (None, seen[kept]))
        c = (np.bincount(bins[kept], chance[kept], n_bins) + 0.5) / (looks.sum(axis=0) + 1.0)
        # Of ships that are seen more often than by chance; farther off never more often than nearer.
        visible = hits.sum(axis=1) > looks.sum(axis=1) * max(2.0 * float(c.max()), 0.1)
        rate = (hits[visible].sum(axis=0) + 0.5) / (looks[visible].sum(axis=0) + 1.0)
        rate = np.minimum.accumulate(rate)
        aircraft = KINDS[ships.description.kind].target == "aircraft"
        hidden = np.where(aircraft | (length_m >= STEEL_M), STEEL_SHARE, 1.0)
        first, last = np.full(n, np.inf), np.full(n, -np.inf)
        np.minimum.at(first, one.ship, one.time_s)
        np.maximum.at(last, one.ship, one.time_s)
        return cls(
            source=ships.description.name, radar=radar.description.name, names=one.names, looks=looks.astype(np.int64),
            seen=hits.astype(np.int64), chance=np.clip(c, 1e-3, 0.5), relative=rate / rate.max(), hidden=hidden,
            first_s=first, last_s=last, within_m=far,
        )  # fmt: skip

    def phantoms(self) -> Iterator[Phantom]:
        """The ships with enough looks, in the order of their ids."""
        looks, seen = self.looks.sum(axis=1), self.seen.sum(axis=1)
        chance = self.looks @ self.chance
        are_seen = seen > np.maximum(2.0 * chance, 0.1 * looks)
        if are_seen.sum() < COMPARABLE_SHIPS:
            return
        share = float(seen[are_seen].sum() / looks[are_seen].sum())
        log_odds = self.log_odds()
        minutes = looks * LOOK_S / 60.0
        for k in np.flatnonzero(looks >= MIN_LOOKS).tolist():
            yield Phantom(
                source=self.source, track=self.names[k], radar=self.radar, looks=int(looks[k]), seen=int(seen[k]),
                minutes=float(minutes[k]), others=int(are_seen.sum() - are_seen[k]), share=share,
                within_m=self.within_m, first_s=float(self.first_s[k]), last_s=float(self.last_s[k]),
                log_odds=float(log_odds[k]),
            )  # fmt: skip

    def log_odds(self) -> FloatArray:
        """(n,) log-odds that each ship is invented; 0 for those without looks."""
        judged = self.looks.sum(axis=1) > 0
        looks, seen = self.looks[judged], self.seen[judged]
        middles, weight = _detectabilities(self.mean_detectabilities, self.detectability_widths)
        missed = (1.0 - middles[:, None] * self.relative) * (1.0 - self.chance)
        # (m, d) ln of the probability of the looks of each ship with each detectability, and (m,) with none.
        log_seen = seen @ np.log1p(-missed).T + (looks - seen) @ np.log(missed).T
        log_none = seen @ np.log(self.chance) + (looks - seen) @ np.log1p(-self.chance)
        share, p_hidden = _cells(np.append(0.0, np.logspace(-4.0, 0.0, 33)), *HIDDEN_SHARE)
        theta, p_theta = _cells(np.linspace(0.0, 1.0, 21), *INVENTED_SHARE)
        h, log_prior = share * self.hidden[judged, None], np.log(p_hidden)[:, None] + np.log(p_theta)
        peak = log_seen.max(axis=1)[:, None]
        real = peak + np.log(np.maximum(np.exp(log_seen - peak) @ weight, 1e-300))
        # (m, c, h) ships that exist, hidden or not; the ratio of an invented one to that is 1/h at most.
        log_hidden = log_none[:, None] + np.log(h)
        exists = np.logaddexp(real[:, :, None] + np.log1p(-h)[:, None], log_hidden[:, None])
        ratios, log_exists = np.exp(log_none[:, None, None] - exists), exists.sum(axis=0)
        # For each mean and width: ln of the evidence without and with invented ships, and the posterior with them.
        log_without = log_exists + np.log(p_hidden)
        log_with, own = [], []
        # Written in place: new arrays of this size take three times as long as what is computed.
        mixed, part = np.empty((2, *ratios[:, 0].shape, len(theta)))
        for c, log_real in enumerate(log_exists):
            ratio = ratios[:, c]
            np.add(np.multiply(theta, ratio[:, :, None] - 1.0, out=mixed), 1.0, out=mixed)
            together = log_real[:, None] + np.log(mixed, out=part).sum(axis=0) + log_prior
            most = together.max()
            posterior = np.exp(together - most)
            log_with.append(most + math.log(posterior.sum()))
            of_share = np.divide(theta * posterior, mixed, out=part)
            own.append(np.einsum("mht,mh->m", of_share, ratio) / posterior.sum())
        log_odds = logsumexp(log_with) - logsumexp(log_without) + math.log(INVENTED_ODDS)
        of_grid = np.exp(np.array(log_with) - logsumexp(log_with))
        p = expit(log_odds) * (of_grid @ np.array(own))
        out = np.zeros(len(judged))
        out[judged] = logit(np.clip(p, 1e-300, 1.0 - 1e-12))
        return out


@cache
def _detectabilities(means: tuple[float, ...], widths: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Middles (d,) of steps of detectability, and their probabilities (d, c) for each mean and width of the Beta
    distribution."""
    edges = np.linspace(0.0, 1.0, DETECTABILITIES + 1)
    mean, width = np.array(list(product(means, widths))).T
    weight = np.diff(betainc(mean * width, (1.0 - mean) * width, edges[:, None]), axis=0)
    return 0.5 * (edges[1:] + edges[:-1]), weight


def _cells(edges: FloatArray, a: float, b: float) -> tuple[FloatArray, FloatArray]:
    """Middles of cells of a share, and their probabilities under Beta(a, b)."""
    return 0.5 * (edges[1:] + edges[:-1]), np.maximum(np.diff(betainc(a, b, edges)), 1e-300)


def _range_bins(range_m: FloatArray, seen: BoolArray, ship: IntArray) -> tuple[IntArray, float]:
    """(k,) bin of each look, of equal numbers of looks with detections, and the range within which ships are compared.

    That is the range beyond which fewer than ``COMPARABLE_SHIPS`` ships are seen.
    """
    farthest = np.zeros(int(ship.max()) + 1)
    np.maximum.at(farthest, ship[seen], range_m[seen])
    far = float(np.sort(farthest)[-COMPARABLE_SHIPS]) if len(farthest) >= COMPARABLE_SHIPS else 0.0
    inside = range_m[seen & (range_m <= far)]
    if not len(inside):
        return np.zeros(len(range_m), np.int64), 0.0
    edges = np.quantile(inside, np.linspace(0.0, 1.0, RANGE_BINS + 1))[1:-1]
    return np.searchsorted(edges, range_m), far


def _lengths(ships: Feed, names: Sequence[str]) -> FloatArray:
    """(n,) the least length that each track states, NaN without one."""
    raw, track, rows = ships.raw_reports, ships.reports.track, ships.reports.rows
    if raw is None or raw.length_m is None or track is None or rows is None:
        return np.full(len(names), np.nan)
    known, number = named_tracks(track)
    length, least = raw.length_m[rows], np.full(len(known), np.inf)
    np.minimum.at(least, number, np.where(length > 0.0, length, np.inf))
    of_name = dict(zip(known, np.where(np.isfinite(least), least, np.nan).tolist(), strict=True))
    return np.array([of_name.get(name, np.nan) for name in names])
