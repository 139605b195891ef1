"""The heights of targets of which a radar measures none, for its slant ranges.

With a wrong height the position on the ground is wrong: 5 km instead of 700 m is 300 m at a range of 40 km, and more
nearby. Other sources, such as ADS-B, report heights:

- A track that keeps to the slant range and the azimuth of an aircraft of another source takes the height of that one
  (:data:`Partners`), as of several that are there, with their spread. If it is not that aircraft, their distance by
  this height shows it; the height itself is no evidence.
- Any other track has the median height and the spread of all that the sources report (:func:`with_target_heights`)
  instead of what is assumed for the kind. Targets without a transponder may fly lower than those with one, so the 1σ is
  at least :data:`LEAST_SPREAD` of the height.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray, numbers_of, within_turn
from sameas.gate import ChiSquare
from sameas.tracks.coordinates import geodesy
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description

#: Fewest heights that say how high the targets are (chosen).
MIN_HEIGHTS = 30
#: 1σ of the heights as a share of their median, at least (chosen).
LEAST_SPREAD = 0.5
#: A track keeps to an aircraft if this share of up to so many of its reports, at least the fewest, are in the gate;
#: the aircraft is known where it reports within so many seconds (chosen).
KEEPS, SAMPLES, FEWEST, NEAR_S = 0.9, 30, 5, 15.0
GATE = ChiSquare(0.99).limit(2)
#: The height of an aircraft is taken for so many seconds before its first and after its last report (chosen).
HELD_S = 60.0
#: A track is elsewhere if another height moves it over the ground by so many metres (chosen: some 3σ of a radar).
ELSEWHERE_M = 200.0

Sources = Sequence[tuple[Description, Reports]]
#: By track of a radar, the aircraft (name of the source, id) that it keeps to.
Partners = Mapping[str, tuple[tuple[str, str], ...]]


def with_target_heights(sources: Sources) -> tuple[list[tuple[Description, Reports]], dict[str, Partners]]:
    """The sources with the heights of targets that others report, where a radar has none and none are given; and by
    such radar the aircraft that its tracks keep to."""
    without = [k for k, (description, _) in enumerate(sources) if description.is_assumed("targets.height_m")]
    kept = {k: found for k in without if (found := _kept_to(k, sources))}
    partners: dict[str, Partners] = {
        sources[k][0].name: {track: tuple(one.key for one in flights) for track, flights in found.items()}
        for k, found in kept.items()
    }
    reported = np.concatenate([np.empty(0), *(reported_heights(reports) for _, reports in sources)])
    reported = reported[np.isfinite(reported)]
    out = list(sources)
    if len(reported) < MIN_HEIGHTS:
        return out, partners
    height_m = float(np.median(reported))
    sigma_m = max(float(np.std(reported)), LEAST_SPREAD * abs(height_m))
    why = f"the median and spread of {len(reported)} heights that the sources report"
    values = {"targets.height_m": (height_m, why), "targets.height_sigma_m": (sigma_m, why)}
    for k in without:
        description, reports = sources[k]
        heights = {
            track: np.array([flight.height_at(reports.time_s[reports.object_ids == track]) for flight in flights])
            for track, flights in kept.get(k, {}).items()
        }
        out[k] = description.with_assumed(values), with_heights(description, reports, heights)
    return out, partners


def reported_heights(reports: Reports) -> FloatArray:
    """(n,) the heights that the reports give, geometric where there are both, NaN where none."""
    pressure, geometric = (
        np.full(len(reports), np.nan) if column is None else column
        for column in (reports.pressure_alt_m, reports.alt_m)
    )
    return np.asarray(np.where(np.isfinite(geometric), geometric, pressure))


def with_heights(description: Description, reports: Reports, heights: Mapping[str, FloatArray]) -> Reports:
    """The reports of a radar with the heights of targets.

    heights : by track (aircraft, reports) the heights of what it keeps to at each of its reports, NaN where unknown;
        (aircraft, 1) for the same at all.
    """
    ids = reports.object_ids
    if ids is None or not heights:
        return reports
    target_m, sigma_m = np.full((2, len(reports)), np.nan)
    for track, each in heights.items():
        known = np.isfinite(each)
        n = np.where(known.any(axis=0), known.sum(axis=0), np.nan)
        mean = np.where(known, each, 0.0).sum(axis=0) / n
        spread = np.sqrt((np.where(known, each - mean, 0.0) ** 2).sum(axis=0) / n)
        own = ids == track
        target_m[own], sigma_m[own] = mean, np.hypot(spread, description.errors.height_m or 0.0)
    return replace(reports, target_height_m=target_m, sigma_target_height_m=sigma_m)


@dataclass(frozen=True)
class PartnerHeights:
    """The heights that tracks of radars take from the aircraft that they keep to, as the reports of both arrive: those
    of the last report of each aircraft.

    partners : by radar. last : (n, 2) time and height of the last report of each aircraft in ``aircraft``, NaN where
    none is known, and one row of NaN. used : by radar and track, the height by which it was last measured. ``last`` and
    ``used`` change in place.
    """

    partners: Mapping[str, Partners] = field(default_factory=dict)
    aircraft: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    last: FloatArray = field(default_factory=lambda: np.full((1, 2), np.nan))
    used: dict[str, dict[str, float]] = field(default_factory=dict)

    def with_partners(self, partners: Mapping[str, Partners]) -> PartnerHeights:
        """The heights with other partners; what is known of aircraft, and was used of tracks, stays."""
        keys = sorted({key for tracks in partners.values() for each in tracks.values() for key in each})
        aircraft: dict[str, dict[str, int]] = {}
        for number, (source, name) in enumerate(keys):
            aircraft.setdefault(source, {})[name] = number
        before = [self.aircraft.get(source, {}).get(name, -1) for source, name in keys]
        # A track that keeps to nothing any more goes back to the assumed height once it is measured again.
        used = {
            radar: {name: m for name, m in list(heights.items()) if name in partners.get(radar, {}) or name in tracks}
            for radar, heights in list(self.used.items())
            for tracks in [self.partners.get(radar, {})]
        }
        return PartnerHeights(partners, aircraft, self.last[[*before, -1]], used)

    def take(self, source: str, reports: Reports) -> None:
        """Takes the heights of such aircraft among new reports of a source."""
        ids, known = reports.object_ids, self.aircraft.get(source)
        if ids is None or not known:
            return
        height_m, number = reported_heights(reports), numbers_of(ids.tolist(), known)
        rows = np.flatnonzero((number >= 0) & np.isfinite(height_m))
        rows = rows[np.argsort(reports.time_s[rows], kind="stable")]
        # Of several of one aircraft, the last one stays.
        self.last[number[rows]] = np.column_stack([reports.time_s[rows], height_m[rows]])

    def applied(self, radar: Description, reports: Reports) -> tuple[Reports, bool]:
        """The reports of a radar with the heights of what its tracks keep to, and whether any track is elsewhere by
        them than by the height by which it was measured before."""
        ids, range_m, partners = reports.object_ids, reports.range_m, self.partners.get(radar.name, {})
        used = self.used.setdefault(radar.name, {}) if partners else self.used.get(radar.name, {})
        names = [] if ids is None else sorted({*ids.tolist()} & (partners.keys() | used.keys()))
        if ids is None or range_m is None or not names:
            return reports, False
        mean_m, spread_m = self._of_tracks([partners.get(name, ()) for name in names], float(reports.time_s.max()))
        number = numbers_of(ids.tolist(), {name: k for k, name in enumerate(names)})
        last_range_m = np.zeros(len(names))
        last_range_m[number[number >= 0]] = range_m[number >= 0]
        site_m, assumed_m = 0.0 if radar.site is None else radar.site.height_m, radar.targets.height_m or 0.0
        before_m = np.array([used.get(name, np.nan) for name in names])
        now, before = (
            np.sqrt(np.maximum(last_range_m**2 - (np.where(np.isnan(m), assumed_m, m) - site_m) ** 2, 0.0))
            for m in (mean_m, before_m)
        )
        used |= dict(zip(names, mean_m.tolist(), strict=True))
        for name in names:
            if name not in partners:
                del used[name]
        target_m, sigma_m = (np.append(each, np.nan)[number] for each in
                             (mean_m, np.hypot(spread_m, radar.errors.height_m or 0.0)))  # fmt: skip
        elsewhere = bool((np.abs(now - before) > ELSEWHERE_M).any())
        return replace(reports, target_height_m=target_m, sigma_target_height_m=sigma_m), elsewhere

    def _of_tracks(self, keys: Sequence[Sequence[tuple[str, str]]], now_s: float) -> tuple[FloatArray, FloatArray]:
        """(n,) mean and spread of the heights of what each track keeps to, NaN where none is known now."""
        # The last row stands for a track that keeps to nothing.
        rows = [[self.aircraft[source][name] for source, name in each] or [-1] for each in keys]
        n = np.array([len(each) for each in rows])
        start = np.cumsum(n) - n
        time_s, height_m = self.last[[row for each in rows for row in each]].T
        known = np.isfinite(height_m) & (now_s - time_s <= HELD_S)
        n_known = np.add.reduceat(known.astype(float), start)
        n_known = np.where(n_known > 0.0, n_known, np.nan)
        mean_m = np.add.reduceat(np.where(known, height_m, 0.0), start) / n_known
        off_m = np.where(known, height_m - np.repeat(mean_m, n), 0.0)
        return mean_m, np.sqrt(np.add.reduceat(off_m**2, start) / n_known)


@dataclass(frozen=True)
class _Flight:
    """An aircraft as a radar would measure it: (n,) times, slant ranges, azimuths that go on beyond a turn, heights.

    key : name of its source, and its id there. sigma_m : 1σ of its positions.
    """

    key: tuple[str, str]
    time_s: FloatArray
    range_m: FloatArray
    azimuth_deg: FloatArray
    height_m: FloatArray
    sigma_m: float

    def is_near(self, time_s: FloatArray, within_s: float) -> BoolArray:
        """(k,) whether it reports within so many seconds of these times."""
        after = np.searchsorted(self.time_s, time_s).clip(0, len(self.time_s) - 1)
        nearest = np.minimum(*(np.abs(self.time_s[k] - time_s) for k in (after, np.maximum(after - 1, 0))))
        return np.asarray(nearest <= within_s)

    def height_at(self, time_s: FloatArray) -> FloatArray:
        """(k,) its height at these times, NaN long before its first report and after its last."""
        held = (time_s >= self.time_s[0] - HELD_S) & (time_s <= self.time_s[-1] + HELD_S)
        return np.where(held, np.interp(time_s, self.time_s, self.height_m), np.nan)

    def is_at(self, radar: Description, time_s: FloatArray, range_m: FloatArray, azimuth_deg: FloatArray) -> BoolArray:
        """(k,) whether what a radar, with offsets as it may have, has measured is where this aircraft is."""
        errors, bias = radar.errors, radar.bias
        moved_m = np.hypot((bias.time_s or 0.0) * (radar.motion.speed_m_per_s or 0.0), self.sigma_m)
        moved_deg = np.degrees(moved_m / np.maximum(range_m, 1.0))
        sigma_r = np.sqrt(errors.sigma_range_m(range_m) ** 2 + (bias.range_m or 0.0) ** 2 + moved_m**2)
        sigma_a = np.sqrt((errors.bearing_deg or 0.0) ** 2 + (bias.azimuth_deg or 0.0) ** 2 + moved_deg**2)
        off_r = range_m - np.interp(time_s, self.time_s, self.range_m)
        off_a = within_turn(azimuth_deg - np.interp(time_s, self.time_s, self.azimuth_deg) + 180.0) - 180.0
        return np.asarray((off_r / sigma_r) ** 2 + (off_a / sigma_a) ** 2 <= GATE)


def _kept_to(k: int, sources: Sources) -> dict[str, list[_Flight]]:
    """By track of the source k, the aircraft of other sources that it keeps to; none if it measures heights."""
    (description, reports), ids = sources[k], sources[k][1].object_ids
    heights, site = (reports.alt_m, reports.pressure_alt_m, reports.elevation_deg), description.site
    is_placed = site is not None and site.lat_deg is not None and reports.position == "polar"
    if not is_placed or ids is None or reports.bearing_deg is None or any(column is not None for column in heights):
        return {}
    rows, number, names = _sampled(ids)
    measured = reports.time_s[rows], np.asarray(reports.range_m)[rows], reports.bearing_deg[rows]
    n, out = np.bincount(number, minlength=len(names)), dict[str, list[_Flight]]()
    for flight in (one for j, source in enumerate(sources) if j != k for one in _flights(description, *source)):
        known = flight.is_near(measured[0], NEAR_S)
        kept = known & flight.is_at(description, *measured)
        n_known, n_kept = (np.bincount(number[which], minlength=len(names)) for which in (known, kept))
        for one in np.flatnonzero((n_known >= np.maximum(FEWEST, n // 2)) & (n_kept >= KEEPS * n_known)).tolist():
            out.setdefault(names[one], []).append(flight)
    return out


def _sampled(ids: NDArray[Any]) -> tuple[IntArray, IntArray, list[str]]:
    """(k,) rows of at most ``SAMPLES`` reports of each track, spread over it, the number of each one's track; names."""
    names = sorted({one for one in ids.tolist() if one is not None})
    number = numbers_of(ids.tolist(), {name: k for k, name in enumerate(names)})
    order = np.argsort(number, kind="stable")[np.count_nonzero(number < 0) :]
    n = np.bincount(number[order], minlength=len(names))
    place = np.arange(len(order)) - np.repeat(np.cumsum(n) - n, n)
    every = np.repeat(-(-n // SAMPLES), n)
    rows = order[place % every == 0]
    return rows, number[rows], names


def _flights(radar: Description, description: Description, reports: Reports) -> Iterator[_Flight]:
    """The aircraft of a source of geodetic positions and heights, as a radar with a site would measure them."""
    ids, site = reports.object_ids, radar.site
    if ids is None or site is None or reports.lat_deg is None or reports.lon_deg is None:
        return
    height_m = reported_heights(reports)
    rows = np.flatnonzero(np.isfinite(height_m + reports.lat_deg + reports.lon_deg))
    names = sorted({one for one in ids[rows].tolist() if one is not None})
    number = numbers_of(ids[rows].tolist(), {name: k for k, name in enumerate(names)})
    rows, number = rows[number >= 0], number[number >= 0]
    order = np.lexsort([reports.time_s[rows], number])
    rows, number = rows[order], number[order]
    azimuth, _, range_m = geodesy().geodetic2aer(
        reports.lat_deg[rows], reports.lon_deg[rows], height_m[rows], site.lat_deg, site.lon_deg, site.height_m
    )
    for name, part in zip(names, np.split(np.arange(len(rows)), np.flatnonzero(np.diff(number)) + 1), strict=False):
        yield _Flight(
            (description.name, name), reports.time_s[rows[part]], range_m[part], np.unwrap(azimuth[part], period=360.0),
            height_m[rows[part]], description.errors.position_m or 0.0,
        )  # fmt: skip
