"""The description of a source: place, coverage, misses, errors, timing, motion, biases.

A :class:`Description` is written in Python, or read from TOML with :func:`read_descriptions`. It has the
user's numbers; the rest is assumed for the source's kind (``sameas.tracks.kinds``), and every assumed number is in
``assumed``, with the reason, to be printed with the result.

    [sources.harbour]
    kind = "marine radar"
    site = { lat_deg = 50.77, lon_deg = -1.30, height_m = 25 }
    coverage = { range_m = 20000, sector_deg = [300, 120], shadows_deg = [[40, 55]] }
    misses = { q = [0.05, 0.1, 0.5], range_m = [0, 10000, 20000] }
    errors = { range_m = 10, bearing_deg = 0.4 }
    bias = { azimuth_deg = 2 }
    calibration = { range_m = -35 }
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import BoolArray, FloatArray
from sameas.errors import InputError
from sameas.representation import in_short
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.kinds import AIRCRAFT_MOTION, KINDS


@dataclass(frozen=True)
class Site:
    """Position of a sensor: latitude, longitude and height, or metres east and north in a plane of the user's own."""

    lat_deg: float | None = None
    lon_deg: float | None = None
    height_m: float = 0.0
    east_m: float | None = None
    north_m: float | None = None

    def __post_init__(self) -> None:
        pairs = [(self.lat_deg, self.lon_deg), (self.east_m, self.north_m)]
        if [None not in pair for pair in pairs].count(True) != 1 or sum(v is not None for p in pairs for v in p) != 2:
            raise InputError("site: give lat_deg and lon_deg, or east_m and north_m")

    def in_plane(self, plane: LocalPlane | None) -> tuple[float, float]:
        """(east, north) in metres; plane : None for the user's own plane."""
        if (plane is None) == (self.east_m is None):
            raise InputError(
                "site: its coordinates are not those of the picture; give both in degrees, or both in metres"
            )
        if plane is None:
            return float(self.east_m or 0.0), float(self.north_m or 0.0)
        east, north = plane.of_geodetic(self.lat_deg, self.lon_deg, "site")[0]  # type: ignore[arg-type]
        return float(east), float(north)


@dataclass(frozen=True)
class Platform:
    """The vessel that carries a sensor: the one of this MMSI, or the one that a source reports.

    mmsi : nine digits. source : name of the source that has her positions; None if only one has the MMSI.
    """

    mmsi: str | None = None
    source: str | None = None

    def __post_init__(self) -> None:
        if self.mmsi is None and self.source is None:
            raise InputError("platform: give the mmsi of the vessel, or the source that has her positions")
        if self.mmsi is not None and not re.fullmatch(r"\d{9}", self.mmsi):
            raise InputError(f"platform: mmsi is {self.mmsi!r}; give nine digits")

    def __str__(self) -> str:
        of_source = "" if self.source is None else f"{' of' if self.mmsi else ''} source {self.source}"
        return f"vessel{f' {self.mmsi}' if self.mmsi else ' of'}{of_source}"


@in_short
@dataclass(frozen=True)
class SensorCoverage:
    """The coverage of a sensor. sector_deg : (from, to), clockwise. shadows_deg : sectors in which it is blind."""

    range_m: float | None = None
    nearest_m: float = 0.0
    sector_deg: tuple[float, float] | None = None
    shadows_deg: tuple[tuple[float, float], ...] = ()

    def covers(self, range_m: ArrayLike, bearing_deg: ArrayLike) -> BoolArray:
        """(n,) whether places at these ranges and bearings (clockwise from north) are covered."""
        distance, bearing = np.broadcast_arrays(np.asarray(range_m, float), np.asarray(bearing_deg, float))
        inside = (distance >= self.nearest_m) & (distance <= (math.inf if self.range_m is None else self.range_m))
        if self.sector_deg is not None:
            inside &= _within(bearing, self.sector_deg)
        for shadow in self.shadows_deg:
            inside &= ~_within(bearing, shadow)
        return inside


def _within(bearing: FloatArray, sector: tuple[float, float]) -> BoolArray:
    """Clockwise from the first bearing to the second, through north where need be."""
    width = (sector[1] - sector[0]) % 360.0
    return np.asarray((bearing - sector[0]) % 360.0 <= (width or 360.0))


#: Names of two numbers of a description that are counted where they were assumed.
MISSES, CLUTTER = "misses.q", "clutter.per_km2"


@in_short
@dataclass(frozen=True)
class MissRate:
    """Probability that an object within the coverage is missed: one number, or a table over the range."""

    q: float | tuple[float, ...] | None = None
    range_m: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.q is None:
            return
        q = np.atleast_1d(np.asarray(self.q, dtype=np.float64))
        if len(q) != max(len(self.range_m), 1) or np.any(np.diff(self.range_m) <= 0):
            raise InputError(
                f"misses: {len(q)} q for ranges {self.range_m}; give one q, or one for each ascending range_m"
            )
        if not np.all((q > 0.0) & (q < 1.0)):
            raise InputError(f"misses: q is {self.q}; give probabilities of a miss, strictly between 0 and 1")

    @classmethod
    def counted(cls, q: float) -> MissRate:
        """A counted rate, which is never taken for 0 or 1."""
        return cls(float(np.clip(q, 0.02, 0.98)))

    def at(self, range_m: ArrayLike) -> FloatArray:
        """(n,) q at these ranges."""
        distance = np.asarray(range_m, dtype=np.float64)
        if not self.range_m:
            return np.full(distance.shape, np.nan if self.q is None else float(np.atleast_1d(self.q)[0]))
        return np.interp(distance, self.range_m, np.atleast_1d(self.q))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Clutter:
    """Density of records that are no object: per km² of the plane, or per degree for directions."""

    per_km2: float | None = None
    per_deg: float | None = None


@dataclass(frozen=True)
class Resolution:
    """Least distance of two separate records. split : probability that a scan shows one object as two."""

    range_m: float | None = None
    bearing_deg: float | None = None
    split: float | None = None

    def __post_init__(self) -> None:
        if self.split is not None and not 0.0 < self.split < 1.0:
            raise InputError(f"resolution: split is {self.split}; give a probability, strictly between 0 and 1")


@dataclass(frozen=True)
class SensorErrors:
    """1σ errors where a record does not state its own.

    range_share : part of the range that adds to range_m. position_m : per axis. extent_m : of the measured point
    about the object's centre, per axis; added wherever a record does not state a covariance, and to directions as an
    angle at the range of other sources' records there.
    """

    range_m: float | None = None
    range_share: float | None = None
    bearing_deg: float | None = None
    position_m: float | None = None
    height_m: float | None = None
    extent_m: float | None = None
    speed_m_per_s: float | None = None
    course_deg: float | None = None

    def sigma_range_m(self, range_m: ArrayLike) -> FloatArray:
        """(n,) 1σ of these ranges."""
        return np.hypot(self.range_m or 0.0, (self.range_share or 0.0) * np.asarray(range_m, dtype=np.float64))


@dataclass(frozen=True)
class Targets:
    """The height of targets without a reported one, and its 1σ."""

    height_m: float | None = None
    height_sigma_m: float | None = None


@dataclass(frozen=True)
class Timing:
    """The timing: period_s between scans; latency_s by which stamps are late, ± latency_sigma_s."""

    period_s: float | None = None
    latency_s: float | None = None
    latency_sigma_s: float | None = None


@dataclass(frozen=True)
class Motion:
    """The motion of objects: a random walk of velocity (m²/s³) from 0 ± speed; a share of them may be stationary.

    manoeuvring_share : of the time in which they turn or change speed, with a walk ``MANOEUVRE_NOISE`` times as large;
    plots without ids are followed with the mean of both.
    """

    acceleration_m2_per_s3: float | None = None
    speed_m_per_s: float | None = None
    stationary_m_per_s: float | None = None
    stationary_share: float | None = None
    manoeuvring_share: float | None = None


@dataclass(frozen=True)
class BiasPrior:
    """Prior 1σ of unknown biases, 0 or None for no bias. ``Scene.registered`` estimates them.

    range_m, azimuth_deg, range_gain : of a sensor with a site. time_s : latency in addition to timing.latency_s; None
    if it is unknown: a delay is then removed where the data establish it; 0 for an exact clock.
    shift_m : of the whole source, per axis (east and north).
    """

    range_m: float | None = None
    azimuth_deg: float | None = None
    range_gain: float | None = None
    time_s: float | None = None
    shift_m: float | None = None


@dataclass(frozen=True)
class KnownBiases:
    """Known biases: subtracted from every report, and not estimated unless ``bias`` has a prior of their errors.

    That of late stamps is timing.latency_s.

    range_m : by which ranges are too long. azimuth_deg : too far clockwise. range_gain : 0.01 is 1 % too far.
    east_m, north_m : by which positions are too far east and north.
    """

    range_m: float | None = None
    azimuth_deg: float | None = None
    range_gain: float | None = None
    east_m: float | None = None
    north_m: float | None = None

    def known(self, bias: str) -> bool:
        """Whether it has the value of a bias of :class:`BiasPrior`."""
        names = ("east_m", "north_m") if bias == "shift_m" else (bias,)
        return any(getattr(self, name, None) is not None for name in names)


@dataclass(frozen=True)
class Assumption:
    """One assumed number: ``name`` is part.field."""

    source: str
    kind: str
    name: str
    value: Any
    why: str

    def __str__(self) -> str:
        value = f"{self.value:g}" if isinstance(self.value, float) else str(self.value)
        return f"{self.source}: {self.name} = {value}, assumed for {self.kind}: {self.why}"


@in_short
@dataclass(frozen=True)
class Description:
    """The description of one source by its user, completed from its kind.

    Parameters
    ----------
    name : of the source, used in messages and results.
    kind : marine radar, air radar, ais, ads-b, mlat, lidar, camera, esm, tracks or other (``sameas.tracks.kinds``).
    site : its place; None for a source without one, or whose reports have it. platform : the vessel that carries it.
    assumed : every number that came from the kind; filled in here.

    Example
    -------
    >>> radar = Description("harbour", "marine radar", errors=SensorErrors(bearing_deg=0.4))
    >>> radar.errors.bearing_deg, radar.errors.range_m
    (0.4, 15.0)
    >>> print([line for line in radar.assumed if line.name == "errors.range_m"][0])
    harbour: errors.range_m = 15, assumed for marine radar: IMO MSC.192(79) allows 30 m, taken as 2σ
    """

    name: str
    kind: str = "other"
    site: Site | None = None
    coverage: SensorCoverage = SensorCoverage()
    misses: MissRate = MissRate()
    clutter: Clutter = Clutter()
    resolution: Resolution = Resolution()
    errors: SensorErrors = SensorErrors()
    targets: Targets = Targets()
    timing: Timing = Timing()
    motion: Motion = Motion()
    bias: BiasPrior = BiasPrior()
    calibration: KnownBiases = KnownBiases()
    platform: Platform | None = None
    assumed: tuple[Assumption, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"{self.name}: kind is {self.kind!r}; give one of {', '.join(KINDS)}")
        if self.site is not None and self.platform is not None:
            raise InputError(f"{self.name}: has a site and a platform; give the one where the sensor is")
        assumptions, timed = list(self.assumed), self.timing.latency_s is not None
        for name, part in self._parts().items():
            _require_numbers(self.name, name, part)
            missing = {f.name for f in fields(part) if getattr(part, f.name) is None}
            if name == "bias":
                # A known bias is not estimated, unless the user also gives a prior of its error.
                missing = {f for f in missing if not (self.calibration.known(f) or (f == "time_s" and timed))}
            defaults = {
                key.partition(".")[2]: default
                for key, default in KINDS[self.kind].defaults.items()
                if key.partition(".")[0] == name and key.partition(".")[2] in missing
            }
            object.__setattr__(self, name, replace(part, **{field: default[0] for field, default in defaults.items()}))
            for field, (value, why) in defaults.items():
                assumptions.append(Assumption(self.name, self.kind, f"{name}.{field}", value, why))
        object.__setattr__(self, "assumed", tuple(assumptions))

    def _parts(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in PARTS if name not in ("site", "platform")}

    @classmethod
    def from_mapping(cls, name: str, given: Mapping[str, Any]) -> Description:
        """A description from nested names and numbers, as TOML or JSON give them. Unknown names are refused."""
        parts: dict[str, Any] = {}
        for key, value in given.items():
            if key == "kind":
                # AIS and adsb are ais and ads-b.
                plain = {re.sub(r"[ _-]", "", kind): kind for kind in KINDS}
                parts["kind"] = plain.get(re.sub(r"[ _-]", "", str(value).lower()), str(value))
            elif key not in PARTS:
                raise InputError(_unknown(name, key, ["kind", *PARTS]))
            elif not isinstance(value, Mapping):
                raise InputError(f"{name}: {key} is {value!r}; give a table, such as {key} = {{ … }}")
            else:
                parts[key] = _part(name, key, PARTS[key], value)
        return cls(name, **parts)

    def with_motion_of_aircraft(self) -> Description:
        """The description with the motion of aircraft where none was given, for a kind that assumes that of vessels."""
        return self.with_assumed(AIRCRAFT_MOTION, kind=f"{self.kind} of aircraft")

    def with_assumed(self, values: Mapping[str, tuple[float, str]], *, kind: str = "") -> Description:
        """The description with other numbers, by part.field, and why, where it has assumed ones. kind : in words."""
        changed, lines = self, []
        for line in self.assumed:
            if line.name in values:
                part, _, name = line.name.partition(".")
                value, why = values[line.name]
                changed = replace(changed, **{part: replace(getattr(changed, part), **{name: value})})
                line = replace(line, kind=kind or line.kind, value=value, why=why)
            lines.append(line)
        return replace(changed, assumed=tuple(lines))

    def is_assumed(self, name: str) -> bool:
        """Whether a number, ``part.field``, was assumed for the kind."""
        return any(line.name == name for line in self.assumed)

    def q_at(self, range_m: ArrayLike, bearing_deg: ArrayLike) -> FloatArray:
        """(n,) probability that an object at this range and bearing is missed: 1 outside the coverage."""
        return np.where(self.coverage.covers(range_m, bearing_deg), self.misses.at(range_m), 1.0)


#: The parts of a description: sections of a file.
PARTS: dict[str, Any] = {
    "site": Site, "platform": Platform, "coverage": SensorCoverage, "misses": MissRate, "clutter": Clutter,
    "resolution": Resolution, "errors": SensorErrors, "targets": Targets, "timing": Timing, "motion": Motion,
    "bias": BiasPrior, "calibration": KnownBiases,
}  # fmt: skip


def read_descriptions(path: str | Path) -> tuple[Description, ...]:
    """The descriptions of a TOML file, one table ``[sources.NAME]`` each.

    Raises
    ------
    InputError : not TOML, no sources, a name that is not known, a number out of its range.
    """
    return tuple(Description.from_mapping(name, table) for name, table in source_tables(path).items())


def source_tables(path: str | Path) -> Mapping[str, Mapping[str, Any]]:
    """The tables ``[sources.NAME]`` of a TOML file as they stand, by name; refused as by :func:`read_descriptions`."""
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({getattr(error, 'strerror', None) or error})") from error
    sources = content.get("sources")
    if not isinstance(sources, Mapping) or not sources:
        raise InputError(f"{path}: describes no sources; give tables such as [sources.radar]")
    for name, table in sources.items():
        if not isinstance(table, Mapping):
            raise InputError(f"{path}: sources.{name} is no table; give [sources.{name}] with its kind")
    return sources


def _part(source: str, section: str, part: Any, given: Mapping[str, Any]) -> Any:
    known = [f.name for f in fields(part)]
    for key in given:
        if key not in known:
            raise InputError(_unknown(source, key, known, f" in {section}"))
        if part is Platform:
            given = {**given, key: str(given[key])}
        elif not _is_numeric(given[key]):
            form = (
                "decimal degrees, south and west negative"
                if key in ("lat_deg", "lon_deg")
                else "a number, or a list of numbers"
            )
            raise InputError(f"{source}: {section}.{key} is {given[key]!r}; give {form}")
    try:
        return part(**{key: _tuples(value) for key, value in given.items()})
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def _is_numeric(value: object) -> bool:
    return all(map(_is_numeric, value)) if isinstance(value, list) else type(value) in (int, float)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value


def _unknown(source: str, key: str, known: list[str], where: str = "") -> str:
    near = difflib.get_close_matches(key, known, 1)
    hint = f"did you mean {near[0]}?" if near else f"give one of {', '.join(known)}"
    return f"{source}: {key!r}{where} is not known; {hint}"


def _require_numbers(source: str, section: str, part: Any) -> None:
    """All numbers of a part are finite and none is negative."""
    values = {f.name: value for f in fields(part) if (value := getattr(part, f.name)) is not None}
    for field, value in values.items():
        try:
            numbers = np.asarray(value)
            signed = field in ("sector_deg", "shadows_deg", "height_m") or section == "calibration"
            good = numbers.dtype.kind in "iuf" and bool(np.isfinite(numbers).all() and (signed or (numbers >= 0).all()))
        except (TypeError, ValueError):
            good = False
        if not good:
            raise InputError(f"{source}: {section}.{field} is {value!r}; give numbers of zero or more")
    shapes = {"sector_deg": (2,), "shadows_deg": (len(getattr(part, "shadows_deg", ())), 2)}
    for name, shape in shapes.items():
        if values.get(name) and np.shape(values[name]) != shape:
            raise InputError(f"{source}: {section}.{name} is {values[name]!r}; give (from, to) in degrees, clockwise")
