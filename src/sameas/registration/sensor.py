"""The biases of a sensor that measures range and azimuth: an offset that differs from place to place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.records import Records
from sameas.registration.offsets import RADIAN, Offset, require_plane, require_widths
from sameas.representation import in_short


@in_short
@dataclass(frozen=True, eq=False)
class SensorBias(Offset):
    """The biases of a sensor at a known position, in a plane of (east, north): range, azimuth, gain, time.

    θ, each only if its width is not 0: range (in the features' unit), azimuth_deg (clockwise from the second axis,
    north), range_gain (0.01 reads 1 % too far), time_offset (stamps are so much too late, in the velocity's unit of
    time). The second source's records are moved to where an unbiased sensor would measure them.

    Parameters
    ----------
    position : (2,) of the sensor that made the second source.
    range_width, azimuth_width_deg, gain_width, time_width : prior standard deviations; 0 leaves the bias out.
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
            raise InputError("SensorBias: all widths are 0, nothing is left to find; give one a positive width")
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
        measured, read_out, read_across = self._read(features)
        ratio = distance / np.maximum(measured, 1e-300)
        along = out[..., :, None] * read_out[..., None, :] / (1.0 + bias[..., 2])[..., None, None]
        return np.asarray(along + ratio[..., None, None] * across[..., :, None] * read_across[..., None, :])

    def chart(self, features: FloatArray) -> FloatArray:
        arm = features - np.array(self.position)
        return np.stack([np.hypot(arm[..., 0], arm[..., 1]), np.degrees(np.arctan2(arm[..., 0], arm[..., 1]))], axis=-1)

    def periods(self, d: int) -> list[float]:
        return [math.inf, 360.0]

    def voted(self, d: int) -> list[tuple[int | None, float]]:
        # A sensor that reads too much is moved back: θ is minus the shift in (range, azimuth).
        return [(self.which.index(k) if k in self.which else None, -1.0) for k in (0, 1)]

    def turns(self) -> list[tuple[FloatArray, float]]:
        p = len(self.which)
        return [(np.eye(p)[at], self.widths[at]) for at, k in enumerate(self.which) if k >= 2]

    def _read(self, features: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Range as it was read, and the unit vectors along and across (clockwise) the line of sight as read."""
        arm = features - np.array(self.position)
        angle = np.arctan2(arm[..., 0], arm[..., 1])
        sine, cosine = np.sin(angle), np.cos(angle)
        along, across = np.stack([sine, cosine], axis=-1), np.stack([cosine, -sine], axis=-1)
        return np.hypot(arm[..., 0], arm[..., 1]), along, across

    def _polar(self, features: FloatArray, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Range without the biases, the unit vectors along and across the true line of sight, all four biases."""
        bias = np.zeros((*theta.shape[:-1], 4))
        bias[..., list(self.which)] = theta
        read, along, across = self._read(features)
        distance = (read - bias[..., 0]) / (1.0 + bias[..., 2])
        turn = RADIAN * bias[..., 1]
        cosine, sine = np.cos(turn)[..., None], np.sin(turn)[..., None]
        return distance, cosine * along - sine * across, cosine * across + sine * along, bias

    def _motion(self, bias: FloatArray) -> FloatArray | float:
        # A record stamped too late shows where the object was before: it is moved on along its track.
        return 0.0 if self.velocity is None else bias[..., 3, None] * np.asarray(self.velocity)
