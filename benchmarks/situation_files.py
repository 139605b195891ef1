"""What the sensors of a situation show, written as files of the field: NMEA of AIS, SBS, APRS of FLARM, CSV of radars.

A radar shows objects nearer to each other than its resolution as one echo, between them by their strengths, which
fade from scan to scan. Its tracker gives that the number of the stronger one, and an object another number after a
pause. Every sensor keeps, for each line that it has written, the objects that the line is of.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
import pyais

from benchmarks.traffic import TIME_S, Paths
from sameas.io.sensors.format import FEET_PER_MINUTE_M_PER_S, KNOT_M_PER_S
from sameas.io.sensors.nmea import checksum
from sameas.tracks.coordinates import FOOT_M, LocalPlane

START_S, PLANE = 1_779_235_200.0, LocalPlane(54.2, 8.1)
#: Seconds for which paths go on after the last report.
AFTER_S = 6.0
#: Seconds without an echo after which a tracker gives an object another number.
TRACK_GAP_S = 15.0


@dataclass(frozen=True)
class Truth:
    """Of each report of a file, its line, time, s, and track, and the objects that it is of; none for a false echo."""

    line: np.ndarray
    time_s: np.ndarray
    track: np.ndarray
    of: list[frozenset[int]]

    def of_lines(self, line: Sequence[int]) -> list[frozenset[int]]:
        """The objects of lines."""
        row = {k: n for n, k in enumerate(self.line.tolist())}
        return [self.of[row[k]] for k in line]

    def of_times(self, track: Sequence[str], time_s: np.ndarray) -> list[frozenset[int]]:
        """The objects of the reports of these tracks nearest to these times."""
        out = []
        for name, t in zip(track, time_s.tolist(), strict=True):
            rows = np.flatnonzero(self.track == name)
            out.append(self.of[int(rows[np.argmin(np.abs(self.time_s[rows] - t))])])
        return out


@dataclass(frozen=True)
class World:
    """The objects of a situation (n,): their paths, heights (n, times), lengths, m, and strengths as echoes."""

    paths: Paths
    height_m: np.ndarray
    length_m: np.ndarray
    strength: np.ndarray
    span_s: float

    @classmethod
    def of(cls, position: npt.ArrayLike, *, height_m: npt.ArrayLike = 0.0, length_m: npt.ArrayLike = 15.0,
           strength: npt.ArrayLike = 1.0) -> World:  # fmt: skip
        """position : (n, times, 2) every second from the first of :data:`benchmarks.traffic.TIME_S` to AFTER_S after
        the last report. height_m : of all, (n,) of each, or (n, times)."""
        places, height = np.asarray(position), np.asarray(height_m, float)
        n, times = places.shape[:2]
        height = np.broadcast_to(height[:, None] if height.ndim == 1 else height, (n, times))
        length, strong = (np.broadcast_to(np.asarray(x, float), n) for x in (length_m, strength))
        return cls(Paths(places, np.zeros(n)), height, length, strong, float(TIME_S[0] + times - 1 - AFTER_S))

    def __len__(self) -> int:
        return len(self.length_m)

    def heights(self, rows: np.ndarray, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(k,) heights and climbs of objects at times."""
        k = np.clip(np.floor(time_s - TIME_S[0]).astype(int), 0, self.height_m.shape[1] - 2)
        climb = self.height_m[rows, k + 1] - self.height_m[rows, k]
        return self.height_m[rows, k] + climb * (time_s - TIME_S[0] - k), climb

    def directions(self, rows: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """(k, 2) along the hulls: the way that objects go, east where they do not."""
        _, velocity = self.paths.at(rows, time_s)
        speed = np.hypot(*velocity.T)[:, None]
        return np.where(speed > 0.3, velocity / np.maximum(speed, 0.3), [1.0, 0.0])


class Sensor(Protocol):
    """A sensor of a situation."""

    @property
    def name(self) -> str:
        """Of the source."""

    @property
    def file(self) -> str:
        """Its name."""

    @property
    def toml(self) -> str:
        """What its user has written of it."""

    def write(self, path: Path, world: World, rng: np.random.Generator) -> Truth:
        """Writes its file."""


@dataclass(frozen=True)
class Sent:
    """What objects send of themselves, (k,) reports in the order of their times: objects, times, places, velocities."""

    of: np.ndarray
    time_s: np.ndarray
    place: np.ndarray
    velocity: np.ndarray

    @classmethod
    def by(cls, world: World, period_s: dict[int, float], misses: float, rng: np.random.Generator) -> Sent:
        """Of each object by its period."""
        rows = []
        for k, period in period_s.items():
            times = np.arange(rng.uniform(0.0, period), world.span_s, period) + rng.uniform(-0.05, 0.05)
            times = np.maximum(times[rng.random(len(times)) >= misses], 0.0)
            rows.append(np.column_stack([np.full(len(times), k), times]))
        out = np.concatenate(rows)
        of, time_s = out[np.argsort(out[:, 1], kind="stable")].T
        of = of.astype(int)
        return cls(of, time_s, *world.paths.at(of, time_s))

    def __len__(self) -> int:
        return len(self.of)

    @property
    def course_deg(self) -> np.ndarray:
        """(k,) courses."""
        return np.degrees(np.arctan2(*self.velocity.T)) % 360.0

    def fixes(self, sigma_m: float, rng: np.random.Generator, antenna_m: np.ndarray | float = 0.0) -> np.ndarray:
        """(2, k) latitudes and longitudes as measured. antenna_m : (k, 2) from the middle of the object."""
        return np.array(PLANE.to_geodetic(self.place + antenna_m + sigma_m * rng.normal(size=self.place.shape)))

    def truth(self, line: np.ndarray, names: Callable[[int], str]) -> Truth:
        """What the reports in these lines are of. names : the track of each object."""
        of = self.of.tolist()
        return Truth(line, START_S + self.time_s, np.array(list(map(names, of))), [frozenset([k]) for k in of])


@dataclass(frozen=True)
class Ais:
    """AIS, whose messages have no lengths, received by a station that stamps whole seconds.

    period_s : by object. moored : objects whose status is that.
    """

    period_s: dict[int, float]
    class_b: frozenset[int] = frozenset()
    moored: frozenset[int] = frozenset()
    name: str = "ais"
    file: str = "ais.nmea"
    sigma_m: float = 5.0
    misses: float = 0.1

    @property
    def toml(self) -> str:
        return 'kind = "ais"'

    def write(self, path: Path, world: World, rng: np.random.Generator) -> Truth:
        sent = Sent.by(world, self.period_s, self.misses, rng)
        ahead = world.directions(sent.of, sent.time_s)
        antenna = (rng.uniform(-0.3, 0.3, len(world)) * world.length_m)[sent.of, None] * ahead
        lat, lon = sent.fixes(self.sigma_m, rng, antenna)
        speed = np.abs(np.hypot(*sent.velocity.T) / KNOT_M_PER_S + 0.1 * rng.normal(size=len(sent)))
        course = (sent.course_deg + 2.0 * rng.normal(size=len(sent))) % 360.0
        # Of class A, the compass; of all, whether the receiver is corrected.
        heading, accurate = np.degrees(np.arctan2(*ahead.T)) % 360.0, rng.random(len(world)) < 0.5
        lines = []
        for k, (one, t) in enumerate(zip(sent.of.tolist(), sent.time_s.tolist(), strict=True)):
            message = {"type": 18 if one in self.class_b else 1, "mmsi": 211000001 + one, "lat": lat[k], "lon": lon[k],
                       "speed": round(speed[k], 1), "course": round(course[k], 1), "second": int(t) % 60,
                       "accuracy": bool(accurate[one]), "heading": 511}  # fmt: skip
            if one not in self.class_b:
                message |= {"status": 5 if one in self.moored else 0, "heading": int(heading[k])}
            [sentence] = pyais.encode_dict(message, talker_id="AI", sentence_type="VDM")
            tag = f"c:{int(START_S + t + 0.3)}"
            lines.append(f"\\{tag}*{checksum(tag):02X}\\{sentence}")
        path.write_text("\n".join(lines) + "\n")
        return sent.truth(1 + np.arange(len(sent)), lambda k: str(211000001 + k))


@dataclass(frozen=True)
class AdsB:
    """ADS-B once a second, as lines of SBS; the height is that of the pressure, which has an offset."""

    which: Sequence[int]
    name: str = "adsb"
    file: str = "adsb.sbs"
    sigma_m: float = 15.0
    misses: float = 0.15
    pressure_offset_m: float = 40.0

    @property
    def toml(self) -> str:
        return 'kind = "ads-b"'

    def write(self, path: Path, world: World, rng: np.random.Generator) -> Truth:
        sent = Sent.by(world, dict.fromkeys(self.which, 1.0), self.misses, rng)
        lat, lon = sent.fixes(self.sigma_m, rng)
        height, climb = world.heights(sent.of, sent.time_s)
        feet = 25.0 * np.round((height + self.pressure_offset_m) / FOOT_M / 25.0)
        speed = np.hypot(*(sent.velocity + 0.5 * rng.normal(size=sent.velocity.shape)).T) / KNOT_M_PER_S
        course, lines = sent.course_deg, []
        for k, (one, t) in enumerate(zip(sent.of.tolist(), sent.time_s.tolist(), strict=True)):
            when = datetime.fromtimestamp(START_S + t + 0.1, UTC).strftime("%Y/%m/%d,%H:%M:%S.%f")[:-3]
            head = f"1,1,{0x3C6500 + one:06X},1,{when},{when}"
            rate = climb[k] / FEET_PER_MINUTE_M_PER_S
            lines.append(f"MSG,4,{head},,,{speed[k]:.0f},{course[k]:.0f},,,{rate:.0f},,,,,0")
            lines.append(f"MSG,3,{head},,{feet[k]:.0f},,,{lat[k]:.5f},{lon[k]:.5f},,,0,0,0,0")
        path.write_text("\n".join(lines) + "\n")
        return sent.truth(2 + 2 * np.arange(len(sent)), lambda k: f"{0x3C6500 + k:06x}")


@dataclass(frozen=True)
class Flarm:
    """FLARM through the Open Glider Network, with addresses of its own and heights of GNSS."""

    which: Sequence[int]
    name: str = "flarm"
    file: str = "flarm.aprs"
    sigma_m: float = 6.0
    misses: float = 0.3

    @property
    def toml(self) -> str:
        return ""

    def write(self, path: Path, world: World, rng: np.random.Generator) -> Truth:
        sent = Sent.by(world, dict.fromkeys(self.which, 2.0), self.misses, rng)
        lat, lon = sent.fixes(self.sigma_m, rng)
        height, climb = world.heights(sent.of, sent.time_s)
        when = datetime.fromtimestamp(START_S, UTC)
        lines = [f"# aprsc 2.1.19 {when:%d %b %Y %H:%M:%S} GMT GLIDERN1"]
        course, knots = sent.course_deg, np.hypot(*sent.velocity.T) / KNOT_M_PER_S
        for k, (one, t) in enumerate(zip(sent.of.tolist(), sent.time_s.tolist(), strict=True)):
            when = datetime.fromtimestamp(np.floor(START_S + t), UTC)
            north, east = (np.floor(60_000.0 * degrees).astype(int) for degrees in (lat[k], lon[k]))
            places = [f"{x // 60_000:0{n}d}{x % 60_000 // 1000:02d}.{x % 1000 // 10:02d}" for x, n in
                      ((north, 2), (east, 3))]  # fmt: skip
            lines.append(
                f"FLRDD{one:04X}>APRS,qAS,STATION:/{when:%H%M%S}h{places[0]}N/{places[1]}E'{course[k]:03.0f}/"
                f"{knots[k]:03.0f}/A={height[k] / FOOT_M:06.0f} !W{north % 10}{east % 10}! id06DD{one:04X} "
                f"{climb[k] / FEET_PER_MINUTE_M_PER_S:+04.0f}fpm +0.0rot 9.5dB gps2x3"
            )
        path.write_text("\n".join(lines) + "\n")
        return sent.truth(2 + np.arange(len(sent)), lambda k: f"dd{k:04x}")


def everywhere(place: np.ndarray, height_m: np.ndarray) -> np.ndarray:
    """(k,) whether a radar sees these places."""
    return np.ones(len(place), bool)


@dataclass(frozen=True)
class Radar:
    """A radar, as CSV of tracks with numbers or of plots.

    site : east and north, m. resolution : metres of range and degrees within which two objects are one echo. hull : in
    lengths, 1σ of the bright spot along it, which lasts a minute. heights : share of the echoes with Mode C, which has
    the height of the pressure; a reply is of one object. azimuth_deg, range_m : offsets that no file states. clutter :
    mean number of false plots a scan. described : more of its table in the sensor file.
    """

    name: str
    site: tuple[float, float] = (0.0, -3000.0)
    kind: str = "marine radar"
    period_s: float = 3.0
    sigma_m: float = 8.0
    sigma_deg: float = 0.25
    resolution: tuple[float, float] = (30.0, 1.0)
    misses: float = 0.1
    numbers: bool = True
    hull: float = 0.2
    heights: float = 0.0
    clutter: float = 0.0
    reach_m: float = 20e3
    azimuth_deg: float = 0.3
    range_m: float = 10.0
    sees: Callable[[np.ndarray, np.ndarray], np.ndarray] = field(default=everywhere)
    described: str = ""

    @property
    def file(self) -> str:
        return f"{self.name}.csv"

    @property
    def toml(self) -> str:
        lat, lon = PLANE.to_geodetic(np.array([self.site]))
        place = f"site = {{ lat_deg = {lat[0]:.6f}, lon_deg = {lon[0]:.6f}, height_m = 20 }}"
        return f'kind = "{self.kind}"\n{place}\n{self.described}'

    def write(self, path: Path, world: World, rng: np.random.Generator) -> Truth:
        n, scans = len(world), np.arange(rng.uniform(0.0, self.period_s), world.span_s - 1.0, self.period_s)
        offset, keep = rng.normal(0.0, self.hull, n), np.exp(-self.period_s / 60.0)
        number, last_s, numbered, rows = np.zeros(n, int), np.full(n, -np.inf), 0, []
        for begin_s in scans.tolist():
            offset = keep * offset + np.sqrt(1.0 - keep**2) * self.hull * rng.normal(size=n)
            for t, parts, arm, height in self._echoes(world, begin_s, offset, rng):
                first = parts[0]
                if t - last_s[first] > TRACK_GAP_S:
                    numbered += 1
                    number[first] = numbered
                last_s[first] = t
                rows.append((t, arm[0], arm[1], number[first], height, frozenset(parts)))
            for _ in range(rng.poisson(self.clutter)):
                angle, far = rng.uniform(0.0, 360.0), self.reach_m * np.sqrt(rng.uniform(0.0, 0.3))
                numbered += 1
                t = begin_s + angle / 360.0 * self.period_s
                rows.append((t, far, angle, numbered, np.nan, frozenset[int]()))
        rows.sort(key=lambda row: row[0])
        return self._table(path, rows, rng)

    def _echoes(
        self, world: World, begin_s: float, offset: np.ndarray, rng: np.random.Generator
    ) -> list[tuple[float, list[int], tuple[float, float], float]]:
        """Of a scan, time, objects, the strongest first, range and azimuth, and height of each echo."""
        rows = np.arange(len(world))
        arm = world.paths.at(rows, np.full(len(rows), begin_s))[0] - self.site
        at_s = begin_s + np.degrees(np.arctan2(*arm.T)) % 360.0 / 360.0 * self.period_s
        place, _ = world.paths.at(rows, at_s)
        height, _ = world.heights(rows, at_s)
        spot = place + (offset * world.length_m)[:, None] * world.directions(rows, at_s)
        arm = spot - self.site
        range_m, azimuth = np.hypot(np.hypot(*arm.T), height), np.degrees(np.arctan2(*arm.T))
        seen = self.sees(place, height) & (range_m < self.reach_m) & (rng.random(len(rows)) >= self.misses)
        power, out = world.strength * rng.exponential(size=len(rows)), []
        left = set(np.flatnonzero(seen).tolist())
        for k in sorted(left, key=lambda one: -power[one]):
            if k not in left:
                continue
            near = [j for j in left if abs(range_m[j] - range_m[k]) < self.resolution[0]
                    and abs((azimuth[j] - azimuth[k] + 180.0) % 360.0 - 180.0) < self.resolution[1]]  # fmt: skip
            parts = sorted(near, key=lambda one: -power[one])
            left -= set(parts)
            read = range_m[k] + self.range_m + self.sigma_m * rng.normal()
            if len(parts) > 1:
                share = power[parts] / power[parts].sum()
                read += float(share @ (range_m[parts] - range_m[k]))
            turned = azimuth[k]
            if len(parts) > 1:
                turned += float(share @ ((azimuth[parts] - azimuth[k] + 180.0) % 360.0 - 180.0))
            turned = (turned + self.azimuth_deg + self.sigma_deg * rng.normal()) % 360.0
            reply = height[k] + 40.0 if rng.random() < self.heights else np.nan
            out.append((float(at_s[k]), parts, (max(read, 1.0), turned), float(reply)))
        return out

    def _table(
        self, path: Path, rows: list[tuple[float, float, float, int, float, frozenset[int]]], rng: np.random.Generator
    ) -> Truth:
        head = ["time", *(["track_id"] if self.numbers else []), "range_m", "bearing_deg"]
        # A tracker's numbers are in no order of the objects.
        name = rng.permutation(10 * max((row[3] for row in rows), default=0) + 10)
        lines = [",".join([*head, *(["pressure_alt_m"] if self.heights else [])])]
        for t, range_m, azimuth, number, height, _ in rows:
            cells = [f"{START_S + t:.2f}", *([str(name[number])] if self.numbers else [])]
            cells += [f"{range_m:.1f}", f"{azimuth:.3f}"]
            if self.heights:
                cells.append("" if np.isnan(height) else f"{30.48 * round(height / 30.48):.1f}")
            lines.append(",".join(cells))
        path.write_text("\n".join(lines) + "\n")
        times = START_S + np.array([row[0] for row in rows])
        tracks = np.array([str(name[row[3]]) if self.numbers else "" for row in rows])
        return Truth(2 + np.arange(len(rows)), times, tracks, [row[5] for row in rows])


def write(folder: Path, world: World, sensors: Sequence[Sensor], rng: np.random.Generator) -> dict[str, Truth]:
    """Writes the files of all sensors and their description, sensors.toml; returns the truth by source."""
    truth, toml = {}, []
    for sensor in sensors:
        truth[sensor.name] = sensor.write(folder / sensor.file, world, rng)
        if sensor.toml:
            toml.append(f"[sources.{sensor.name}]\n{sensor.toml}")
    (folder / "sensors.toml").write_text("\n\n".join(toml) + "\n")
    return truth
