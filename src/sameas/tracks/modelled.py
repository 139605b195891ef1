"""Modelled sensors: what a sensor would report of objects whose true motion is known, and which object each report is.

For trials of the picture where no truth is at hand. The sensor is its :class:`~sameas.tracks.source.Description`:
coverage, misses, errors, clutter, resolution, timing; a :class:`Bias` is what it reads wrong and its description does
not say. The motion may be real (:class:`~sameas.tracks.true_motion.TrueMotion`); what is quoted from such trials should
say both: *real motion, modelled sensors*. Modelled are independent errors, misses and false reports; weather, sea
clutter, masts in the way and trackers that swap targets are not.

- :class:`Sensor`: bare plots, or with a :class:`Tracker` numbered ones with velocities. ``Sensor(…)(motion, …)`` gives
  :class:`Heard`: the reports, as a reader would give them, and the hidden truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sameas.errors import InputError
from sameas.records import FloatArray, IntArray
from sameas.tracks.coordinates import geodesy
from sameas.tracks.modelled_tracks import Tracker, tracked
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description
from sameas.tracks.true_motion import TrueMotion

#: Flight levels are told in steps of 100 feet.
LEVEL_M = 30.48


@dataclass(frozen=True)
class Bias:
    """What a sensor reads too much, and nobody is told: range and azimuth (clockwise), gain, stamps that are late.

    east_m, north_m : by which the positions of a source without a site are shifted.
    """

    range_m: float = 0.0
    azimuth_deg: float = 0.0
    range_gain: float = 0.0
    time_s: float = 0.0
    east_m: float = 0.0
    north_m: float = 0.0


@dataclass(frozen=True)
class Heard:
    """What a modelled sensor reports.

    reports : in the order of their stamps. truth : (n,) number of the object of the true motion, −1 for false reports.
    looked_s : (l,) stamps of all looks, those that showed nothing among them.
    """

    reports: Reports
    truth: IntArray
    looked_s: FloatArray


@dataclass(frozen=True)
class Echoes:
    """What is there to be reported (n,): the look and the object (−1: false) of each, when it was measured, its place.

    place : (n, 3) east, north, height in the plane of the motion. sight : (n, 2) range and bearing from the sensor, as
    they are.
    """

    look: IntArray
    object: IntArray
    time_s: FloatArray
    place: FloatArray
    sight: FloatArray

    def __len__(self) -> int:
        return len(self.look)

    def take(self, which: NDArray[np.generic]) -> Echoes:
        """Some of them."""
        return Echoes(self.look[which], self.object[which], self.time_s[which], self.place[which], self.sight[which])

    def and_those_of(self, other: Echoes) -> Echoes:
        """Both, look by look in the order of time."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        both = Echoes(*(np.concatenate(pair) for pair in pairs))
        return both.take(np.lexsort([both.object, both.time_s]))


@dataclass(frozen=True)
class Sensor:
    """One modelled sensor, called with a true motion, a span of time and a generator of random numbers.

    A sensor with a site measures range and bearing; of kind camera or esm the bearing alone; without a site positions.
    Errors are ``errors.position_m`` per axis where the description gives one (a range and a bearing that good are then
    stated with every report), else range_m, range_share and bearing_deg. An antenna turns once a period, from north,
    and measures what it passes. Two objects within both the range's and the bearing's resolution show one echo, that
    of the object with the smaller number.

    Parameters
    ----------
    description : of the sensor, as its user knows it; the latency is on its stamps.
    bias : that its user does not know.
    tracker : numbers the plots; None: bare plots.

    Example
    -------
    >>> from sameas.tracks.source import Misses, Site
    >>> said = {"time_s": [0.0, 60.0], "lat_deg": [50.8, 50.8], "lon_deg": [-1.30, -1.29], "mmsi": ["235070762"] * 2}
    >>> motion = TrueMotion.of(Reports.of("ais", "table", said))
    >>> radar = Description("radar", "marine radar", site=Site(50.75, -1.3), misses=Misses(0.01))
    >>> heard = Sensor(radar)(motion, (0.0, 60.0), np.random.default_rng(1))
    >>> heard.reports.position, len(heard.looked_s), int(np.sum(heard.truth == 0)) in (18, 19, 20)
    ('polar', 20, True)
    """

    description: Description
    bias: Bias = Bias()
    tracker: Tracker | None = None

    def __call__(self, motion: TrueMotion, span_s: tuple[float, float], rng: np.random.Generator) -> Heard:
        period = self.description.timing.period_s
        if period is None:
            raise InputError(f"{self.description.name}: timing.period_s is not known; give seconds between looks")
        looks = np.arange(*span_s, period)
        true = self._resolved(self._seen(self._passed(motion, looks, period), rng))
        echoes = true.and_those_of(self._false(motion, looks, period, rng))
        jitter = rng.normal(size=len(looks)) * (self.description.timing.latency_sigma_s or 0.0)
        late = (self.description.timing.latency_s or 0.0) + self.bias.time_s + jitter
        columns = self._measured(motion, echoes, rng) | {"time_s": echoes.time_s + late[echoes.look]}
        truth = np.maximum(echoes.object, -1)
        reports = Reports.of(self.description.name, "table", columns)
        if self.tracker is not None:
            sight = (echoes.look, echoes.object)
            reports, truth = tracked(self.description, self.tracker, reports, sight, truth, motion.plane, rng)
        order = np.argsort(reports.time_s, kind="stable")
        reports = replace(reports.where(order), line=np.arange(1, len(reports) + 1))
        return Heard(reports, truth[order], looks + late)

    @property
    def _turns(self) -> bool:
        return self.description.site is not None and self.description.kind not in ("camera", "esm")

    def _passed(self, motion: TrueMotion, looks: FloatArray, period: float) -> Echoes:
        """Every object at every look, where it was when the antenna passed it."""
        times = np.broadcast_to(looks[:, None], (len(looks), len(motion))).copy()
        place = motion.along(times)
        sight = self._sight(motion, place)
        if self._turns:
            times += np.nan_to_num(sight[..., 1]) / 360.0 * period
            place = motion.along(times)
            sight = self._sight(motion, place)
        look, number = np.nonzero(np.isfinite(place).all(axis=-1))
        there = (look, number)
        return Echoes(look, number, times[there], place[there], sight[there])

    def _sight(self, motion: TrueMotion, place: FloatArray) -> FloatArray:
        """(..., 2) slant range and bearing from the sensor; NaN where the sensor is in no one place."""
        out = np.full((*place.shape[:-1], 2), np.nan)
        site, known = self.description.site, np.isfinite(place).all(axis=-1)
        if site is None or not known.any():
            return out
        if site.lat_deg is None or site.lon_deg is None:
            raise InputError(f"{self.description.name}: a modelled sensor needs site = {{ lat_deg, lon_deg }}")
        lat, lon = motion.plane.to_geodetic(place[known][:, :2])
        there = (lat, lon, place[known][:, 2], site.lat_deg, site.lon_deg, site.height_m)
        bearing, _, distance = geodesy().geodetic2aer(*there)
        out[known] = np.column_stack([distance, bearing])
        return out

    def _seen(self, echoes: Echoes, rng: np.random.Generator) -> Echoes:
        """Those within the coverage that are not missed."""
        if self.description.site is None:
            q = np.broadcast_to(self.description.misses.at(0.0), (len(echoes),))
        else:
            q = self.description.q_at(*echoes.sight.T)
        return echoes.take(rng.random(len(echoes)) >= np.nan_to_num(q))

    def _resolved(self, echoes: Echoes) -> Echoes:
        """Without those that another echo of the same look hides."""
        beam, cell = self.description.resolution.bearing_deg or 0.0, self.description.resolution.range_m or 0.0
        if self.description.site is None or not (beam and cell):
            return echoes
        keep = np.ones(len(echoes), bool)
        # Echoes stand look by look, objects in the order of their numbers.
        starts = np.searchsorted(echoes.look, np.arange(echoes.look.max(initial=-1) + 2))
        for low, high in pairwise(starts):
            apart = np.abs(echoes.sight[low:high, None] - echoes.sight[None, low:high])
            turn = np.minimum(apart[..., 1], 360.0 - apart[..., 1])
            keep[low:high] = ~np.tril((apart[..., 0] < cell) & (turn < beam), -1).any(axis=1)
        return echoes.take(keep)

    def _false(self, motion: TrueMotion, looks: FloatArray, period: float, rng: np.random.Generator) -> Echoes:
        """False echoes, evenly over the coverage; under a tracker each stays where it is for some looks."""
        site, reach = self.description.site, self.description.coverage.range_m
        per_m2 = (self.description.clutter.per_km2 or 0.0) / 1e6
        if site is None or not self._turns or reach is None or not per_m2:
            none = np.empty(0, np.int64)
            return Echoes(none, none, np.empty(0), np.empty((0, 3)), np.empty((0, 2)))
        lasting = 1.0 if self.tracker is None else self.tracker.false_looks
        count = rng.poisson(per_m2 * np.pi * reach**2 * (len(looks) + lasting - 1.0) / lasting)
        begin = rng.integers(-int(lasting - 1), len(looks), count)
        end = begin + rng.geometric(1.0 / lasting, count)
        sight = np.column_stack([reach * np.sqrt(rng.random(count)), rng.uniform(0.0, 360.0, count)])
        covered = self.description.coverage.covers(*sight.T)
        owner = np.repeat(np.arange(count), np.where(covered, end - begin, 0))
        look = begin[owner] + np.arange(len(owner)) - np.searchsorted(owner, owner)
        inside = (look >= 0) & (look < len(looks))
        owner, look = owner[inside], look[inside]
        centre = motion.plane.of_geodetic(site.lat_deg, site.lon_deg)[0]  # type: ignore[arg-type]
        angle = np.radians(sight[owner, 1])
        flat = centre + sight[owner, :1] * np.column_stack([np.sin(angle), np.cos(angle)])
        place = np.column_stack([flat, np.zeros(len(owner))])
        # Numbers below −1 tell false objects apart until the truth is handed out.
        return Echoes(look, -2 - owner, looks[look] + sight[owner, 1] / 360.0 * period, place, sight[owner])

    def _measured(self, motion: TrueMotion, echoes: Echoes, rng: np.random.Generator) -> dict[str, FloatArray]:
        """The columns of a position, with errors and bias."""
        errors, bias, n = self.description.errors, self.bias, len(echoes)
        wander = (errors.extent_m or 0.0) * rng.normal(size=(n, 2))
        place = echoes.place + np.column_stack([wander, np.zeros(n)])
        if self.description.site is None:
            position = place[:, :2] + (errors.position_m or 0.0) * rng.normal(size=(n, 2)) + (bias.east_m, bias.north_m)
            lat, lon = motion.plane.to_geodetic(position)
            return {"lat_deg": lat, "lon_deg": lon}
        distance, bearing = np.where(echoes.object[:, None] < 0, echoes.sight, self._sight(motion, place)).T
        sigma_range, sigma_bearing = self._sigmas(distance)
        azimuth = (bearing + bias.azimuth_deg + sigma_bearing * rng.normal(size=n)) % 360.0
        if not self._turns:
            return {"bearing_deg": azimuth}
        read = distance * (1.0 + bias.range_gain) + bias.range_m + sigma_range * rng.normal(size=n)
        columns = {"range_m": np.maximum(read, 1.0), "bearing_deg": azimuth}
        if errors.position_m is not None:
            columns |= {"sigma_range_m": sigma_range, "sigma_bearing_deg": sigma_bearing}
        return columns | self._levels(echoes, rng)

    def _sigmas(self, distance: FloatArray) -> tuple[FloatArray, FloatArray]:
        errors = self.description.errors
        if errors.position_m is not None:
            sigma = np.full(len(distance), errors.position_m)
            return sigma, np.degrees(sigma / np.maximum(distance, 10.0 * sigma))
        return errors.sigma_range_m(distance), np.full(len(distance), errors.bearing_deg or 0.0)

    def _levels(self, echoes: Echoes, rng: np.random.Generator) -> dict[str, FloatArray]:
        """Flight levels of what flies, as transponders tell them; false echoes tell none."""
        height = echoes.place[:, 2]
        if not height.any():
            return {}
        told = height + (self.description.errors.height_m or 0.0) * rng.normal(size=len(echoes))
        level = LEVEL_M * np.round(told / LEVEL_M)
        return {"pressure_alt_m": np.where(echoes.object < 0, np.nan, level)}
