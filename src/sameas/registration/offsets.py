"""Offset models: functions with parameters θ that move the *second* source's records onto the first source's.

- :class:`Shift`: a constant shift, in any number of features; on the sphere an east and north shift of a small field.
- :class:`Similarity`: shift, rotation and stretch in the plane: two pictures of different orientation and scale.
- :class:`Affine`: shift and any linear distortion, in any number of features: a plate, a camera.
- :class:`~sameas.registration.offsets.SensorBias`: the second source is a sensor with biases of range, azimuth, range
  scale and clock.

A width is the prior standard deviation of a parameter around zero: 0 removes the parameter, infinity is no prior.
A new offset is a frozen dataclass with the methods of :class:`Offset`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Plane, Sphere, directions_deg, displaced, sphere_offset, unit_vectors

RADIAN = math.pi / 180.0
#: Largest radius of a field on the sphere that has one shift in its tangent plane.
SMALL_FIELD_DEG = 5.0

EVERYWHERE_FLAT = Plane()


def range_and_azimuth(arm: FloatArray) -> FloatArray:
    """(…, 2) range, and azimuth in degrees clockwise from north, of positions (…, 2) relative to a sensor."""
    return np.stack([np.hypot(arm[..., 0], arm[..., 1]), np.degrees(np.arctan2(arm[..., 0], arm[..., 1]))], axis=-1)


def line_of_sight(arm: FloatArray, least: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Range, at least ``least``, of positions (…, 2) relative to a sensor, and the unit vectors along and across
    (clockwise) the line of sight."""
    angle = np.arctan2(arm[..., 0], arm[..., 1])
    sine, cosine = np.sin(angle), np.cos(angle)
    along, across = np.stack([sine, cosine], axis=-1), np.stack([cosine, -sine], axis=-1)
    return np.maximum(np.hypot(arm[..., 0], arm[..., 1]), least), along, across


@dataclass(frozen=True, eq=False)
class Displaced:
    """Displaced positions (…, n, d), and their derivatives by those before (…, n, d, d).

    slopes : gives those by the parameters θ, (…, n, d, p): most users ask for the positions only.
    """

    position: FloatArray
    by_position: FloatArray
    slopes: Callable[[], FloatArray]

    @cached_property
    def by_theta(self) -> FloatArray:
        return self.slopes()


class Offset:
    """Interface of an offset model. Features are (…, n, d), θ is (p,) or (…, 1, p): all methods broadcast.

    names, units, widths : of the p parameters; a width is a prior standard deviation, infinity for none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    widths: tuple[float, ...]

    def placed(self, first: Records, second: Records) -> Offset:
        """The model with what it takes from the data, such as a centre; refuses unsuitable data."""
        raise self._unfinished()

    def moved(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        """(…, n, d) the second source's positions in the first's space."""
        raise self._unfinished()

    def jacobian(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        """(…, n, d, p) ∂ moved / ∂ θ, in the residual's unit."""
        raise self._unfinished()

    def _unfinished(self) -> TypeError:
        name = type(self).__name__
        return TypeError(f"{name} is the interface of offsets; use Shift, Similarity, Affine, SensorBias")

    def carried(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        """(…, n, d, d) ∂ moved / ∂ features, which propagates the records' errors; identity by default."""
        d, shape = features.shape[-1], np.broadcast_shapes(features.shape[:-1], theta.shape[:-1])
        return np.broadcast_to(np.eye(d), (*shape, d, d))

    def displaced(self, features: FloatArray, theta: FloatArray) -> Displaced:
        """:meth:`moved`, :meth:`carried` and :meth:`jacobian`, of which a model may compute common parts once."""
        position, by_position = self.moved(features, theta), self.carried(features, theta)
        return Displaced(position, by_position, lambda: self.jacobian(features, theta))

    def chart(self, features: FloatArray) -> FloatArray:
        """(…, n, d) coordinates in which each parameter of ``voted`` shifts all records by the same amount."""
        return features

    def periods(self, d: int) -> list[float]:
        """Periods of the chart's axes."""
        return [math.inf] * d

    def voted(self, d: int) -> list[tuple[int | None, float]]:
        """For each axis of the chart: the parameter that shifts it (None for none), and θ per unit of shift."""
        return [(axis, 1.0) for axis in range(d)]

    def turns(self) -> list[tuple[FloatArray, float]]:
        """Directions in θ that do not shift the chart and are searched on a grid, with their prior widths."""
        return []


def require_plane(model: Offset, second: Records, d: int | None = None) -> None:
    """Refuse spheres and periodic features, and any number of features but ``d`` if given."""
    name = type(model).__name__
    if not isinstance(second.space, Plane):
        raise InputError(f"{name}: {second.source} is on a sphere; project both sources to a plane, or use Shift")
    if any(period < math.inf for period in second.space.period_list(second.d)):
        raise InputError(f"{name}: a feature of {second.source} is periodic; give coordinates in a plane, or use Shift")
    if d is not None and second.d != d:
        raise InputError(f"{name}: {second.source} has {second.d} features; {name} is for {d}")


def require_widths(model: Offset, **widths: float) -> None:
    """Refuse negative widths."""
    for name, width in widths.items():
        if not width >= 0.0:
            raise InputError(f"{type(model).__name__}: {name} is {width}; give 0 to leave it out, or a positive width")


def _axes(prefix: str, d: int) -> tuple[str, ...]:
    return tuple(f"{prefix}_{'xyz'[v]}" if d <= 3 else f"{prefix}_{v + 1}" for v in range(d))


@in_short
@dataclass(frozen=True)
class Shift(Offset):
    """A constant shift, added to the second source's records to bring them onto the first's.

    Parameters
    ----------
    width : prior standard deviation of every component in the residual's unit; infinity (default) is no prior.

    On a :class:`~sameas.space.Sphere` the shift is one of the tangent plane at the field's centre, east and north in
    arcsec, and the field must be small (within 5° of its centre).
    """

    width: float = math.inf
    space: Plane | Sphere = EVERYWHERE_FLAT
    d: int = 0
    centre: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        require_widths(self, width=self.width)
        if self.width == 0.0:
            raise InputError("Shift: width is 0, no parameter is left to fit; give a positive width")

    @property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("shift_east", "shift_north") if isinstance(self.space, Sphere) else _axes("shift", self.d)

    @property
    def units(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("arcsec" if isinstance(self.space, Sphere) else "",) * self.d

    @property
    def widths(self) -> tuple[float, ...]:  # type: ignore[override]
        return (self.width,) * self.d

    def placed(self, first: Records, second: Records) -> Shift:
        if not isinstance(second.space, Sphere):
            return replace(self, space=second.space, d=second.d, centre=())
        centre = _centre_deg(second)
        for records in (first, second):
            lon, lat = records.features.T
            east, north = sphere_offset(lon, lat, centre[0], centre[1]).T
            reach = np.hypot(east, north).max() / 3600.0
            if reach > SMALL_FIELD_DEG or abs(centre[1]) > 90.0 - SMALL_FIELD_DEG:
                raise InputError(
                    f"Shift: {records.source} reaches {reach:.3g}° from the centre of {second.source} "
                    f"({centre[0]:.4g}°, {centre[1]:.4g}°); a shift on the sphere is for fields within "
                    f"{SMALL_FIELD_DEG:g}° of their centre and not around a pole: register field by field"
                )
        return replace(self, space=second.space, d=2, centre=centre)

    def moved(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        if not isinstance(self.space, Sphere):
            return features + theta
        offset = np.einsum("...vp,...p->...v", self.jacobian(features, theta), theta)
        shape = np.broadcast_shapes(features.shape, offset.shape)
        flat = [np.broadcast_to(x, shape).reshape(-1, 2) for x in (features, offset)]
        return displaced(flat[0], flat[1]).reshape(shape)

    def jacobian(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        shape = np.broadcast_shapes(features.shape, theta.shape)
        if not isinstance(self.space, Sphere):
            return np.broadcast_to(np.eye(self.d), (*shape, self.d))
        # The record's east and north are rotated relative to those of the centre (see Sphere).
        cosine, sine = self._turned(features, 1.0)
        turn = np.stack([np.stack([cosine, -sine], axis=-1), np.stack([sine, cosine], axis=-1)], axis=-2)
        return np.broadcast_to(turn, (*shape, 2))

    def chart(self, features: FloatArray) -> FloatArray:
        if not isinstance(self.space, Sphere):
            return features
        flat = sphere_offset(features[..., 0], features[..., 1], self.centre[0], self.centre[1])
        cosine, sine = self._turned(features, 0.5)
        east, north = flat[..., 0], flat[..., 1]
        return np.stack([cosine * east + sine * north, cosine * north - sine * east], axis=-1)

    def periods(self, d: int) -> list[float]:
        return [math.inf] * d if isinstance(self.space, Sphere) else self.space.period_list(d)

    def _turned(self, features: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
        """cos and −sin of a share of the angle by which position angles increase from the centre to each record."""
        lon, lat = self.centre
        half_lon = np.radians((features[..., 0] - lon + 180.0) % 360.0 - 180.0) / 2.0
        middle, half_lat = np.radians(features[..., 1] + lat) / 2.0, np.radians(features[..., 1] - lat) / 2.0
        angle = 2.0 * share * np.arctan2(np.sin(half_lon) * np.sin(middle), np.cos(half_lon) * np.cos(half_lat))
        return np.cos(angle), -np.sin(angle)


def _centre_deg(records: Records) -> tuple[float, float]:
    """Longitude and latitude of the mean direction of the records."""
    lon, lat = directions_deg(np.array([axis.mean() for axis in unit_vectors(*records.features.T).T]))
    return float(lon), float(lat)


def _mean_position(records: Records) -> tuple[float, ...]:
    return tuple(float(x) for x in records.features.mean(axis=0))


@in_short
@dataclass(frozen=True)
class Similarity(Offset):
    """Shift, rotation and stretch of the second source's records about a centre, in two features.

    θ: shift_x, shift_y in the features' unit, rotation_deg counter-clockwise, and stretch (0.01 moves the records apart
    by 1 %).

    Parameters
    ----------
    rotation_deg, stretch : prior standard deviations. shift : prior standard deviation of the shift.
    centre : of the rotation and stretch; by default the mean position of the second source.
    """

    rotation_deg: float = 5.0
    stretch: float = 0.03
    shift: float = math.inf
    centre: tuple[float, ...] = ()

    names = ("shift_x", "shift_y", "rotation_deg", "stretch")
    units = ("", "", "deg", "")

    def __post_init__(self) -> None:
        require_widths(self, rotation_deg=self.rotation_deg, stretch=self.stretch, shift=self.shift)

    @property
    def widths(self) -> tuple[float, ...]:  # type: ignore[override]
        return (self.shift, self.shift, min(self.rotation_deg, 180.0), min(self.stretch, 0.5))

    def placed(self, first: Records, second: Records) -> Similarity:
        require_plane(self, second, 2)
        return replace(self, centre=self.centre or _mean_position(second))

    def moved(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        arm = np.einsum("...vw,...w->...v", self.carried(features, theta), features - np.array(self.centre))
        return np.asarray(arm + np.array(self.centre) + theta[..., :2])

    def jacobian(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        arm = np.einsum("...vw,...w->...v", self.carried(features, theta), features - np.array(self.centre))
        out = np.zeros((*arm.shape, 4))
        out[..., 0, 0] = out[..., 1, 1] = 1.0
        out[..., 0, 2], out[..., 1, 2] = -RADIAN * arm[..., 1], RADIAN * arm[..., 0]
        out[..., :, 3] = arm / (1.0 + theta[..., 3])[..., None]
        return out

    def carried(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        angle, factor = RADIAN * theta[..., 2], 1.0 + theta[..., 3]
        cosine, sine = factor * np.cos(angle), factor * np.sin(angle)
        turn = np.stack([np.stack([cosine, -sine], axis=-1), np.stack([sine, cosine], axis=-1)], axis=-2)
        return np.broadcast_to(turn, (*np.broadcast_shapes(features.shape[:-1], turn.shape[:-2]), 2, 2))

    def turns(self) -> list[tuple[FloatArray, float]]:
        return [(np.eye(4)[k], self.widths[k]) for k in (2, 3) if self.widths[k] > 0.0]


@in_short
@dataclass(frozen=True)
class Affine(Offset):
    """Shift and any linear distortion of the second source's records about a centre: X + θ_shift + M (X − centre).

    Parameters
    ----------
    distortion : prior standard deviation of every element of M; a rotation of 5° makes elements of 0.09.
    shift : prior standard deviation of the shift.
    centre : by default the mean position of the second source.
    """

    distortion: float = 0.05
    shift: float = math.inf
    centre: tuple[float, ...] = ()
    d: int = 2

    def __post_init__(self) -> None:
        require_widths(self, distortion=self.distortion, shift=self.shift)

    @property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]
        axes = ["xyz"[v] if self.d <= 3 else str(v + 1) for v in range(self.d)]
        return (*_axes("shift", self.d), *(f"distortion_{v}{w}" for v in axes for w in axes))

    @property
    def units(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("",) * (self.d + self.d**2)

    @property
    def widths(self) -> tuple[float, ...]:  # type: ignore[override]
        return (self.shift,) * self.d + (min(self.distortion, 1.0),) * self.d**2

    def placed(self, first: Records, second: Records) -> Affine:
        require_plane(self, second)
        return replace(self, centre=self.centre or _mean_position(second), d=second.d)

    def moved(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        arm = np.einsum("...vw,...w->...v", self.carried(features, theta), features - np.array(self.centre))
        return np.asarray(arm + np.array(self.centre) + theta[..., : self.d])

    def jacobian(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        arm = features - np.array(self.centre)
        out = np.zeros((*np.broadcast_shapes(features.shape[:-1], theta.shape[:-1]), self.d, self.d + self.d**2))
        for v in range(self.d):
            out[..., v, v] = 1.0
            out[..., v, self.d * (v + 1) : self.d * (v + 2)] = arm
        return out

    def carried(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        matrix = np.eye(self.d) + theta[..., self.d :].reshape(*theta.shape[:-1], self.d, self.d)
        return np.broadcast_to(matrix, (*np.broadcast_shapes(features.shape[:-1], matrix.shape[:-2]), self.d, self.d))

    def turns(self) -> list[tuple[FloatArray, float]]:
        if self.d != 2 or not self.distortion:
            return []
        # Unit steps of rotation (radian) and stretch; the two shears are left to the refinement.
        return [(np.array(v), self.widths[2]) for v in ([0.0, 0, 0, -1, 1, 0], [0.0, 0, 1, 0, 0, 1])]


@in_short
@dataclass(frozen=True, eq=False)
class SensorBias(Offset):
    """Biases of a sensor at a known position that measures range and azimuth, in a plane of (east, north).

    θ, each only if its width is not 0: range (in the features' unit), azimuth_deg (clockwise from the second axis,
    north), range_gain (0.01 reads 1 % too far), time_offset (by which time stamps are too late, in the velocity's unit
    of time). The second source's records are moved to where an unbiased sensor would measure them.

    Parameters
    ----------
    position : (2,) of the sensor that made the second source.
    range_width, azimuth_width_deg, gain_width, time_width : prior standard deviations; 0 removes the bias.
    velocity : (n₂, 2) velocities of the second source's usable records; a time offset needs them.
    """

    position: Sequence[float]
    range_width: float = math.inf
    azimuth_width_deg: float = 10.0
    gain_width: float = 0.0
    time_width: float = 0.0
    velocity: ArrayLike | None = None

    def __post_init__(self) -> None:
        require_widths(
            self, range_width=self.range_width, azimuth_width_deg=self.azimuth_width_deg, gain_width=self.gain_width,
            time_width=self.time_width,
        )  # fmt: skip
        if np.shape(self.position) != (2,) or not np.isfinite(self.position).all():
            raise InputError(f"SensorBias: position is {self.position}; give (east, north) of the sensor")
        if not self.which:
            raise InputError("SensorBias: all widths are 0, no parameter is left to fit; give one a positive width")
        if self.time_width > 0.0 and self.velocity is None:
            raise InputError("SensorBias: a time offset needs velocity, (n, 2) of the second source's records")
        for name, width in (("gain_width", self.gain_width), ("time_width", self.time_width)):
            if width == math.inf:
                raise InputError(f"SensorBias: {name} is infinite; give how large it may be (a standard deviation)")

    @property
    def which(self) -> tuple[int, ...]:
        """Numbers of the biases that are fitted: 0 range, 1 azimuth, 2 gain, 3 time."""
        widths = (self.range_width, self.azimuth_width_deg, self.gain_width, self.time_width)
        return tuple(k for k in range(4) if widths[k] > 0.0)

    @property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(("range", "azimuth_deg", "range_gain", "time_offset")[k] for k in self.which)

    @property
    def units(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(("", "deg", "", "")[k] for k in self.which)

    @property
    def widths(self) -> tuple[float, ...]:  # type: ignore[override]
        widths = (self.range_width, min(self.azimuth_width_deg, 180.0), self.gain_width, self.time_width)
        return tuple(widths[k] for k in self.which)

    def placed(self, first: Records, second: Records) -> SensorBias:
        require_plane(self, second, 2)
        if self.velocity is None:
            return self
        velocity = np.asarray(self.velocity, dtype=np.float64)
        if velocity.shape != second.features.shape or not np.isfinite(velocity).all():
            raise InputError(
                f"SensorBias: velocity has shape {velocity.shape} (or is not finite); give ({len(second)}, 2), one for "
                f"each usable record of {second.source}"
            )
        return replace(self, velocity=velocity)

    def moved(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        distance, out, _, bias = self._polar(features, theta)
        return np.asarray(np.array(self.position) + distance[..., None] * out + self._motion(bias))

    def jacobian(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        distance, out, across, bias = self._polar(features, theta)
        gain = (1.0 + bias[..., 2])[..., None]
        parts = [-out / gain, -RADIAN * distance[..., None] * across, -distance[..., None] * out / gain]
        if self.velocity is not None:
            parts.append(np.broadcast_to(np.asarray(self.velocity), out.shape))
        return np.stack([parts[k] for k in self.which], axis=-1)

    def carried(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        distance, out, across, bias = self._polar(features, theta)
        measured, read_out, read_across = line_of_sight(features - np.array(self.position))
        ratio = distance / np.maximum(measured, 1e-300)
        along = out[..., :, None] * read_out[..., None, :] / (1.0 + bias[..., 2])[..., None, None]
        return np.asarray(along + ratio[..., None, None] * across[..., :, None] * read_across[..., None, :])

    def chart(self, features: FloatArray) -> FloatArray:
        return range_and_azimuth(features - np.array(self.position))

    def periods(self, d: int) -> list[float]:
        return [math.inf, 360.0]

    def voted(self, d: int) -> list[tuple[int | None, float]]:
        # Readings that are too large are reduced: θ is minus the shift in (range, azimuth).
        return [(self.which.index(k) if k in self.which else None, -1.0) for k in (0, 1)]

    def turns(self) -> list[tuple[FloatArray, float]]:
        p = len(self.which)
        return [(np.eye(p)[at], self.widths[at]) for at, k in enumerate(self.which) if k >= 2]

    def _polar(self, features: FloatArray, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Corrected range, unit vectors along and across the corrected line of sight, and all four biases."""
        bias = np.zeros((*theta.shape[:-1], 4))
        bias[..., list(self.which)] = theta
        read, along, across = line_of_sight(features - np.array(self.position))
        distance = (read - bias[..., 0]) / (1.0 + bias[..., 2])
        turn = RADIAN * bias[..., 1]
        cosine, sine = np.cos(turn)[..., None], np.sin(turn)[..., None]
        return distance, cosine * along - sine * across, cosine * across + sine * along, bias

    def _motion(self, bias: FloatArray) -> FloatArray | float:
        # A record with a late time stamp shows an earlier position: it is moved forward along its track.
        return 0.0 if self.velocity is None else bias[..., 3, None] * np.asarray(self.velocity)
