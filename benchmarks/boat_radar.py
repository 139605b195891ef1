"""A modelled small radar on a moving boat, among vessels with AIS, land, buoys and sea.

Modelled on recordings of a research vessel in a strait: a scan takes 2.5 s, the range is 7.4 km, azimuths have steps of
half a degree. A scan has about ten plots. One or two are of vessels with AIS, each detected in 10 to 30 % of the scans,
a long hull sometimes as several plots; the others are returns of a shore, of buoys and of the sea. Shore and buoys are
stationary while the boat moves; sea clutter surrounds the boat. There are also vessels without AIS.

:func:`boat_radar` draws such a scene. Echoes may fade, and the compass may drift. It is a model, not a recording: it
has no rain, blind sectors, side lobes or second echoes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.arrays import ABSENT, FloatArray, IntArray
from sameas.errors import InputError
from sameas.representation import in_short
from sameas.simulate.sensors import Bias
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, SensorCoverage, Timing

#: Latitude and longitude of the middle of the strait, degrees, and the start of every scene, s.
MIDDLE, START_S = (50.78, -1.30), 1.7e9
TURN_S, REACH_M, STEP_DEG = 2.5, 7400.0, 0.5
#: 1σ of a plot's range and, without the steps, bearing; 1σ and correlation time of the boat's heading.
RANGE_M, BEARING_DEG, HEADING_DEG, HEADING_S = 12.0, 0.4, 0.3, 20.0
#: Plots in a scan of the shore and of the sea; scatterers of the shore, buoys, mean distance of the sea's plots.
SHORE_PLOTS, SEA_PLOTS, SCATTERERS, BUOYS, SEA_M = 6.0, 1.0, 150, 6, 500.0


@in_short
@dataclass(frozen=True)
class BoatRadarScene:
    """A drawn scene.

    sources : the radar and AIS, each with a description as a user would write it.
    truth : (n,) number of the vessel of each plot, −1 (ABSENT) for land, buoys and sea. Vessels with AIS come first.
    mmsi : of the vessels with AIS, in their order. common : (k,) numbers of those under way that the radar sees.
    bias : of the radar. heading_error_deg : (turns,) in addition to the bias of its azimuth.
    """

    sources: tuple[tuple[Description, Reports], tuple[Description, Reports]]
    truth: IntArray
    mmsi: tuple[str, ...]
    common: IntArray
    bias: Bias
    heading_error_deg: FloatArray


@dataclass(frozen=True)
class _Hulls:
    """Vessels on gently curved courses: place (2,), speed, course and rate of turn (rad/s), length and antenna (m)."""

    start: FloatArray
    speed: FloatArray
    course: FloatArray
    turning: FloatArray
    length: FloatArray

    @classmethod
    def drawn(cls, count: int, rng: np.random.Generator, within_m: float = 4500.0) -> _Hulls:
        angle, range_m = rng.uniform(0.0, 2.0 * np.pi, count), within_m * np.sqrt(rng.uniform(0.02, 1.0, count))
        return cls(
            range_m[:, None] * np.column_stack([np.sin(angle), np.cos(angle)]), rng.uniform(1.0, 8.0, count),
            rng.uniform(0.0, 2.0 * np.pi, count), rng.normal(0.0, 3e-4, count),
            np.exp(rng.uniform(np.log(12.0), np.log(150.0), count)),
        )  # fmt: skip

    def at(self, which: IntArray, since_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 2) positions of the middles and (n,) courses of some vessels; since_s : from the middle of the scene."""
        turn = self.turning[which] * since_s / 2.0
        chord = self.speed[which] * since_s * np.sinc(turn / np.pi)
        heading = self.course[which] + turn
        return self.start[which] + chord[:, None] * _unit(heading), heading + turn


def _unit(angle: FloatArray) -> FloatArray:
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def boat_radar(
    rng: np.random.Generator,
    *,
    bias: Bias | None = None,
    common: int = 4,
    moored: int = 1,
    unseen: int = 1,
    silent: int = 1,
    berthed: int = 0,
    berthed_seen: bool = True,
    minutes: float = 10.0,
    compass_deg: float = HEADING_DEG,
    compass_s: float = HEADING_S,
    fading_s: float = 0.0,
) -> BoatRadarScene:
    """A scene of this many minutes.

    bias : of the radar; by default an azimuth too far clockwise by 3° and a range too long by 20 m.
    common : vessels under way with AIS that the radar detects. moored : further ones that are stationary.
    unseen : vessels with AIS that it never detects. silent : vessels without AIS that it detects.
    berthed : stationary vessels with AIS among the returns of the shore. berthed_seen : whether the radar detects them.
    compass_deg, compass_s : 1σ and correlation time of the heading's error.
    fading_s : mean time for which a hull is seen, and for which it is not, since echoes fade; 0 for independent scans.

    Raises InputError: a negative number of vessels, or no time.

    >>> scene = boat_radar(np.random.default_rng(1), minutes=5.0)
    >>> radar, ais = (reports for _, reports in scene.sources)
    >>> round(len(radar) / (300.0 / 2.5)), len(scene.mmsi)
    (9, 6)
    """
    counts = (common, moored, unseen, silent, berthed)
    if min(counts) < 0 or not minutes > 0.0:
        raise InputError(f"boat_radar: {counts} vessels in {minutes} minutes; give none or more, and a time above 0")
    bias = Bias(range_m=20.0, azimuth_deg=3.0) if bias is None else bias
    plane, span_s = LocalPlane.about(*(np.array([each]) for each in MIDDLE)), 60.0 * minutes
    turns = np.arange(0.0, span_s, TURN_S)
    moored += berthed
    named = common + moored + unseen
    vessels, boat = _Hulls.drawn(named + silent, rng), _Hulls.drawn(1, rng, 500.0)
    vessels.speed[common : common + moored], boat.speed[:] = 0.0, rng.uniform(2.5, 5.0)
    since = turns - span_s / 2.0
    station = boat.at(np.zeros(len(turns), np.int64), since)[0]
    detected = common + moored - (0 if berthed_seen else berthed)
    rows = np.concatenate([np.arange(detected), np.arange(named, named + silent)])
    rows = rows.astype(np.int64)
    coast = _Coast.drawn(rng, vessels, common + moored - berthed, berthed) if berthed else None
    echoes = [
        _hull_echoes(vessels, rows, since, rng, fading_s),
        (coast or _Coast.drawn(rng)).echoes(station, rng),
        _sea(station, rng),
    ]
    scan, place, truth = (np.concatenate(part) for part in zip(*echoes, strict=True))
    arm = place - station[scan]
    range_m = np.hypot(*arm.T)
    kept = (range_m < REACH_M) & (range_m > 60.0)
    scan, arm, range_m, truth = scan[kept], arm[kept], range_m[kept], truth[kept]
    heading_error = compass_deg * _heading_error(len(turns), rng, compass_s)
    bearing = np.degrees(np.arctan2(arm[:, 0], arm[:, 1])) + bias.azimuth_deg + heading_error[scan]
    bearing = STEP_DEG * np.round((bearing + BEARING_DEG * rng.normal(size=len(scan))) / STEP_DEG) % 360.0
    lat, lon = plane.to_geodetic(station + 3.0 * rng.normal(size=station.shape))
    # The antenna rotates during a scan; time stamps are rounded to tenths of a second.
    stamp = np.round(turns[scan] + bearing / 360.0 * TURN_S + bias.time_s, 1)
    order = np.argsort(stamp, kind="stable")
    columns = {
        "time_s": START_S + stamp,
        "bearing_deg": bearing,
        "station_lat_deg": lat[scan],
        "station_lon_deg": lon[scan],
    }
    read_m = range_m * (1.0 + bias.range_gain) + bias.range_m + RANGE_M * rng.normal(size=len(scan))
    columns["range_m"] = np.maximum(read_m, 1.0)
    radar = Reports.of("radar", "table", {name: column[order] for name, column in columns.items()})
    ais, mmsi = _ais(vessels, named, span_s, plane, rng)
    described = (
        Description("radar", "marine radar", coverage=SensorCoverage(range_m=REACH_M), timing=Timing(period_s=TURN_S)),
        Description("ais", "ais"),
    )
    return BoatRadarScene(
        ((described[0], radar), (described[1], ais)), truth[order], mmsi, np.arange(common), bias, heading_error
    )


Echoes = tuple[IntArray, FloatArray, IntArray]


def _hull_echoes(
    vessels: _Hulls, rows: IntArray, since: FloatArray, rng: np.random.Generator, fading_s: float
) -> Echoes:
    """Scan, position and vessel of the echoes of hulls: in 10 to 30 % of the scans, several of a long hull."""
    share = rng.uniform(0.1, 0.3, len(rows))[:, None]
    if fading_s:
        changes = rng.random((len(rows), len(since))) < np.where(np.arange(len(since)), TURN_S / fading_s, 0.5)
        share = 2.0 * share * (np.cumsum(changes, axis=1) % 2)
    seen, scan = np.nonzero(rng.random((len(rows), len(since))) < share)
    times = 1 + rng.poisson(vessels.length[rows[seen]] / 150.0)
    which, scan = np.repeat(rows[seen], times), np.repeat(scan, times)
    place, course = vessels.at(which, since[scan])
    along = rng.uniform(-0.4, 0.4, len(which)) * vessels.length[which]
    return scan, place + along[:, None] * _unit(course), which


@dataclass(frozen=True)
class _Coast:
    """Scatterers of a shore on one side, and buoys: (n, 2) places and (n,) strengths."""

    place: FloatArray
    strength: FloatArray

    @classmethod
    def drawn(cls, rng: np.random.Generator, vessels: _Hulls | None = None, first: int = 0, berthed: int = 0) -> _Coast:
        """A coast; of the vessels, ``berthed`` from number ``first`` on are moved to its scatterers within reach."""
        along, off = rng.uniform(-7000.0, 7000.0, SCATTERERS), 2500.0 + rng.gamma(1.5, 500.0, SCATTERERS)
        side = rng.uniform(0.0, 2.0 * np.pi)
        coast = along[:, None] * _unit(np.array([side])) + off[:, None] * _unit(np.array([side + np.pi / 2.0]))
        place = np.concatenate([coast, rng.uniform(-4000.0, 4000.0, (BUOYS, 2))])
        if vessels is not None:
            near = rng.permutation(np.flatnonzero(np.hypot(*coast.T) < 5000.0))[:berthed]
            vessels.start[first : first + len(near)] = coast[near] + rng.normal(0.0, 40.0, (len(near), 2))
        return cls(place, np.concatenate([rng.gamma(0.7, 1.0, SCATTERERS), np.full(BUOYS, 2.0)]))

    def echoes(self, station: FloatArray, rng: np.random.Generator) -> Echoes:
        """Returns of all of it."""
        share = np.minimum(SHORE_PLOTS * self.strength / self.strength.sum(), 0.6)
        scan, which = np.nonzero(rng.random((len(station), len(self.place))) < share)
        place = self.place[which] + 8.0 * rng.normal(size=(len(which), 2))
        return scan, place, np.full(len(scan), ABSENT)


def _sea(station: FloatArray, rng: np.random.Generator) -> Echoes:
    """Returns of the sea around the boat."""
    scan = np.repeat(np.arange(len(station)), rng.poisson(SEA_PLOTS, len(station)))
    range_m = 60.0 + rng.exponential(SEA_M, len(scan))
    return (
        scan,
        station[scan] + range_m[:, None] * _unit(rng.uniform(0.0, 2.0 * np.pi, len(scan))),
        np.full(len(scan), ABSENT),
    )


def _heading_error(turns: int, rng: np.random.Generator, correlation_s: float) -> FloatArray:
    """(turns,) error of the heading in units of its 1σ, correlated over this time."""
    keep = np.exp(-TURN_S / correlation_s)
    error, steps = np.zeros(turns), rng.normal(size=turns)
    error[0] = steps[0]
    for k in range(1, turns):
        error[k] = keep * error[k - 1] + np.sqrt(1.0 - keep**2) * steps[k]
    return error


def _ais(
    vessels: _Hulls, count: int, span_s: float, plane: LocalPlane, rng: np.random.Generator
) -> tuple[Reports, tuple[str, ...]]:
    """The reports of the vessels with AIS, every 5, 10 or 30 s, of an antenna at a random position on the hull."""
    period = rng.choice([5.0, 10.0, 30.0], count)
    mmsi = tuple(str(235000001 + k) for k in range(count))
    times = [np.arange(rng.uniform(-each, 0.0), span_s + each, each) for each in period]
    which = np.repeat(np.arange(count), [len(each) for each in times])
    time_s = np.concatenate([*times, np.empty(0)])
    place, course = vessels.at(which, time_s - span_s / 2.0)
    antenna = (rng.uniform(-0.35, 0.35, count) * vessels.length[:count])[which]
    place = place + antenna[:, None] * _unit(course) + 4.0 * rng.normal(size=place.shape)
    lat, lon = plane.to_geodetic(place) if count else (np.empty(0), np.empty(0))
    columns = {
        "time_s": START_S + np.round(time_s), "lat_deg": lat, "lon_deg": lon,
        "speed_m_per_s": np.abs(vessels.speed[which] + 0.1 * rng.normal(size=len(which))),
        "course_deg": np.degrees(course + 0.02 * rng.normal(size=len(which))) % 360.0,
        "mmsi": np.array([mmsi[k] for k in which], object), "length_m": vessels.length[which],
    }  # fmt: skip
    order = np.argsort(columns["time_s"], kind="stable")
    return Reports.of("ais", "ais", {name: column[order] for name, column in columns.items()}), mmsi
