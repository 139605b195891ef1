"""Scenes with ships that exist in AIS only: a modelled coastal radar, weak boats, land, berths, and invented ships.

The radar (range and bearing, a scan every 3 s) sees each ship with her own detectability, less far away; its tracker
numbers its plots, or it gives bare plots among clutter. Behind a sector of land it sees nothing. Of the ships that
exist some are weak (seen in 2 to 30 % of the scans), one is never seen, some lie at berths where no radar tells them
from the quay. Invented ships sail on straight courses anywhere within its range. It is a model, not a recording.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.tables import Table
from benchmarks.watch_rules import SHIP_RULES, rule_alarms
from sameas.picture.phantoms import phantoms
from sameas.picture.picture import Picture
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Clutter, Description, MissRate, SensorCoverage, SensorErrors, Site, Timing

#: Seconds between scans and between the AIS reports of a ship; range of the radar, and from where on land hides, m.
SCAN_S, AIS_S, REACH_M, LAND_M = 3.0, 9.0, 12e3, 2500.0
#: 1σ of ranges (m), bearings (degrees), and AIS positions (m).
RANGE_M, BEARING_DEG, AIS_M = 20.0, 0.3, 8.0
#: Scans without a plot after which the tracker drops a track.
DROPPED_AFTER = 5


@dataclass(frozen=True)
class Waters:
    """One kind of scene. ships : sound ones under way. weak : rarely seen. plastic : never seen. land_deg : width of
    the sector of land, with ships behind it. berthed : at rest, never seen. invented : ships that do not exist.
    bare : whether the radar gives plots without track numbers, among clutter."""

    words: str
    ships: int = 16
    weak: int = 0
    plastic: int = 0
    land_deg: float = 0.0
    berthed: int = 0
    invented: int = 0
    bare: bool = False


_LAND = Waters("land hides 50°, 3 berthed", ships=40, land_deg=50.0, berthed=3)
_ALL = replace(_LAND, words="land, berths, 3 weak, 1 never seen", weak=3, plastic=1)
WATERS = (
    Waters("nothing, 16 ships"),
    Waters("3 weak boats, 1 never seen, 16 ships", weak=3, plastic=1),
    replace(_LAND, words="land hides 50°, 3 berthed, 16 ships", ships=16),
    _LAND,
    _ALL,
    replace(_ALL, words="the same, bare plots in clutter", bare=True),
    Waters("1 invented, 40 ships", ships=40, invented=1),
    Waters("3 invented, 16 ships", invented=3),
    Waters("3 invented, 40 ships", ships=40, invented=3),
    replace(_LAND, words="4 invented, land, berths", invented=4),
    replace(_ALL, words="6 invented, all of the above", invented=6),
    replace(_ALL, words="6 invented, the same, bare plots", invented=6, bare=True),
)


def drawn(waters: Waters, seed: int, minutes: float = 10.0) -> tuple[Scene, frozenset[str]]:
    """A scene, and the MMSI of the ships that are invented."""
    rng = np.random.default_rng((seed, waters.ships, waters.invented, waters.weak, int(waters.land_deg)))
    counts = (waters.ships, waters.weak, waters.plastic, waters.berthed, waters.invented)
    n, kind = sum(counts), np.repeat(np.arange(5), counts)
    detectability = np.select([kind == 0, kind == 1], [rng.beta(9.0, 1.0, n), rng.uniform(0.02, 0.3, n)], 0.0)
    middle_s = 30.0 * minutes
    angle, range_m = rng.uniform(0.0, 2.0 * np.pi, n), REACH_M * np.sqrt(rng.uniform(0.02, 0.7, n))
    place = range_m[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
    course, speed = rng.uniform(0.0, 2.0 * np.pi, n), np.where(kind == 3, 0.0, rng.uniform(2.5, 9.0, n))
    velocity = speed[:, None] * np.column_stack([np.sin(course), np.cos(course)])
    # Weak boats send no dimensions.
    length = np.where((kind == 1) | (kind == 2), np.nan, np.exp(rng.uniform(np.log(25.0), np.log(250.0), n)))
    mmsi = np.array([str(235000100 + k) for k in range(n)], object)
    described = (
        Description(
            "radar", "marine radar", site=Site(east_m=0.0, north_m=0.0), coverage=SensorCoverage(range_m=REACH_M),
            misses=MissRate(0.15), clutter=Clutter(0.02), timing=Timing(SCAN_S, 0.0, 0.1),
            errors=SensorErrors(range_m=RANGE_M, range_share=0.0, bearing_deg=BEARING_DEG, extent_m=10.0),
        ),
        Description("ais", "ais", errors=SensorErrors(position_m=AIS_M)),
    )  # fmt: skip
    land_from = float(rng.uniform(0.0, 360.0))
    plots: list[tuple[float, float, float, str]] = []
    number, missed, renumbered = np.arange(n), np.zeros(n, np.int64), n
    for t in np.arange(0.0, 60.0 * minutes, SCAN_S):
        at = place + velocity * (t - middle_s)
        distance, bearing = np.hypot(*at.T), np.degrees(np.arctan2(*at.T)) % 360.0
        hidden = ((bearing - land_from) % 360.0 < waters.land_deg) & (distance > LAND_M)
        p = detectability * np.clip(1.3 - 0.6 * distance / REACH_M, 0.0, 1.0)
        seen = (rng.random(n) < p) & ~hidden & (distance < REACH_M)
        missed = np.where(seen, 0, missed + 1)
        for k in np.flatnonzero(missed == DROPPED_AFTER):
            number[k], renumbered = renumbered, renumbered + 1
        r = distance + RANGE_M * rng.normal(size=n)
        b = bearing + BEARING_DEG * rng.normal(size=n)
        plots += [(t, r[k], b[k] % 360.0, str(number[k])) for k in np.flatnonzero(seen)]
        false = rng.poisson(0.02 * np.pi * (REACH_M / 1e3) ** 2) if waters.bare else 0
        wild = REACH_M * np.sqrt(rng.uniform(0.0, 1.0, false))
        plots += [(t, r, float(rng.uniform(0.0, 360.0)), "") for r in wild.tolist()]
    time_s, r, b, track = (np.array(column, object) for column in zip(*plots, strict=True))
    columns = {"time_s": time_s.astype(float), "range_m": r.astype(float), "bearing_deg": b.astype(float)}
    columns |= {} if waters.bare else {"track_id": track}
    radar = Reports.of("radar", "table", columns)
    which = np.repeat(np.arange(n), int(60.0 * minutes / AIS_S))
    time_s = rng.uniform(0.0, AIS_S, n)[which] + AIS_S * (np.arange(len(which)) % int(60.0 * minutes / AIS_S))
    at = place[which] + velocity[which] * (time_s - middle_s)[:, None] + AIS_M * rng.normal(size=(len(which), 2))
    v = velocity[which] + 0.1 * rng.normal(size=at.shape)
    columns = {
        "time_s": time_s, "x_m": at[:, 0], "y_m": at[:, 1], "vx_m_per_s": v[:, 0], "vy_m_per_s": v[:, 1],
        "mmsi": mmsi[which], "length_m": length[which],
    }  # fmt: skip
    order = np.argsort(time_s, kind="stable")
    ais = Reports.of("ais", "ais", {name: np.asarray(column)[order] for name, column in columns.items()})
    scene = Scene.of([(described[0], radar), (described[1], ais)])
    return scene, frozenset(str(one) for one in mmsi[kind == 4])


def table(scenes: int) -> Table:
    """Alarms of invented ships, and false ones, beside those of the simple rules."""
    lines: list[list[object]] = []
    for waters in WATERS:
        ships = judged = found = false = alarmed = by_rule = false_rules = 0
        for seed in range(scenes):
            scene, forged = drawn(waters, seed)
            picture = Picture.of(scene, np.arange(20.0, 600.0, 10.0))
            alarms = {fault.track for fault in picture.summary.faults if fault.kind == "phantom"}
            others = sum(fault.kind != "phantom" for fault in picture.summary.faults)
            ships, alarmed = ships + len(forged), alarmed + bool(alarms & forged)
            judged += sum(one.track in forged for one in phantoms(scene.feeds, picture.records))
            found, false = found + len(alarms & forged), false + len(alarms - forged) + others
            rules = {track for kind, source, track in rule_alarms(scene.feeds) if (kind, source) == ("alone", "ais")}
            by_rule, false_rules = by_rule + len(rules & forged), false_rules + len(rules - forged)
        found_or_none = (ships, judged, found, alarmed) if waters.invented else (None,) * 4
        lines.append([waters.words, scenes, *found_or_none, false, by_rule if waters.invented else None, false_rules])
    columns = (
        "scene", "scenes", "invented", "judged", "found", "scenes with one found", "false alarms", "rules: found",
        "rules: false alarms",
    )  # fmt: skip
    notes = (
        "ten minutes of a modelled coastal radar and AIS; judged: under way for 3 min or more at places that the radar "
        "demonstrably sees",
        SHIP_RULES,
    )
    return Table("Invented ships", columns, lines, notes)
