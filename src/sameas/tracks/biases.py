"""Biases: the effect of a source's calibration errors on its positions, and reports corrected for them.

Six numbers, in the order of :data:`BIASES`: a sensor with a site has offsets of range and azimuth and a range gain; any
source may be late and displaced as a whole.

- :class:`BiasModel`: from the position of an object to its measured position, and back, with derivatives.
- :class:`RelativeBias`: the offset between two such sources, for :mod:`sameas.registration`.
- :class:`AzimuthBias`: the same for directions.

The range bias is along the ground; at steep elevations it differs from that of the slant range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.gaussian import propagated
from sameas.records import Records
from sameas.registration.offsets import RADIAN, Displaced, Offset, line_of_sight, range_and_azimuth
from sameas.tracks.alignment import States
from sameas.tracks.placement import Directions

#: Range too long (m), azimuth too far clockwise (°), range gain (0.01 is 1 % too far), stamps too late (s), positions
#: too far east and north (m).
BIASES = ("range_m", "azimuth_deg", "range_gain", "time_s", "east_m", "north_m")
RANGE, AZIMUTH, GAIN, TIME, EAST, NORTH = range(6)
#: Least range of an object from its sensor in metres, for the derivatives.
MIN_RANGE_M = 1e-6


@dataclass(frozen=True, eq=False)
class BiasModel:
    """The effect of biases θ (…, 6), in the order of :data:`BIASES`, on the positions of one source.

    site_m : (2,), or (n, 2) if it moves, east and north of the sensor; None for a source without a site.
    """

    site_m: ArrayLike | None = None

    def forward(self, position: FloatArray, velocity: FloatArray, theta: FloatArray) -> Displaced:
        """The measured positions of objects at ``position`` (…, n, 2) with ``velocity`` (n, 2)."""
        before = position - velocity * theta[..., TIME, None]
        if self.site_m is None:
            eye = np.broadcast_to(np.eye(2), (*before.shape, 2))
            no_polar = np.zeros((*before.shape, 3))
            return Displaced(before + theta[..., EAST:], eye, lambda: _with_late_and_shift(no_polar, eye, velocity))
        site = np.asarray(self.site_m, dtype=np.float64)
        true_m, along, across = line_of_sight(before - site, MIN_RANGE_M)
        measured_m = true_m * (1.0 + theta[..., GAIN]) + theta[..., RANGE]
        along_out, across_out = _rotated(along, across, theta[..., AZIMUTH])
        by_range = (1.0 + theta[..., GAIN])[..., None, None] * _outer(along_out, along)
        by_position = by_range + (measured_m / true_m)[..., None, None] * _outer(across_out, across)

        def by_theta() -> FloatArray:
            by_polar = along_out, RADIAN * measured_m[..., None] * across_out, true_m[..., None] * along_out
            return _with_late_and_shift(np.stack(np.broadcast_arrays(*by_polar), axis=-1), by_position, velocity)

        return Displaced(site + measured_m[..., None] * along_out + theta[..., EAST:], by_position, by_theta)

    def inverse(self, measured_position: FloatArray, velocity: FloatArray, theta: FloatArray) -> Displaced:
        """The positions of objects measured at ``measured_position`` (…, n, 2): the inverse of :meth:`forward`."""
        measured = measured_position - theta[..., EAST:]
        if self.site_m is not None:
            site = np.asarray(self.site_m, dtype=np.float64)
            measured_m, along_out, across_out = line_of_sight(measured - site, MIN_RANGE_M)
            along, _ = _rotated(along_out, across_out, -theta[..., AZIMUTH])
            measured = site + ((measured_m - theta[..., RANGE]) / (1.0 + theta[..., GAIN]))[..., None] * along
        position = measured + velocity * theta[..., TIME, None]
        forward = self.forward(position, velocity, theta)
        back = _inverse(forward.by_position)
        return Displaced(position, back, lambda: -back @ forward.by_theta)


def _with_late_and_shift(polar: FloatArray, by_position: FloatArray, velocity: FloatArray) -> FloatArray:
    """(…, n, 2, 6) derivatives by all biases, from those by range, azimuth and gain, (…, n, 2, 3)."""
    late = -np.einsum("...vw,...w->...v", by_position, np.broadcast_to(velocity, by_position.shape[:-1]))
    shift = np.broadcast_to(np.eye(2), by_position.shape)
    return np.concatenate([polar, late[..., None], shift], axis=-1)


def _rotated(along: FloatArray, across: FloatArray, azimuth_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The unit vectors rotated clockwise by an angle."""
    cosine, sine = np.cos(RADIAN * azimuth_deg)[..., None], np.sin(RADIAN * azimuth_deg)[..., None]
    return cosine * along + sine * across, cosine * across - sine * along


def _inverse(matrix: FloatArray) -> FloatArray:
    """The inverse of (…, 2, 2), in closed form: faster than ``np.linalg.inv``."""
    (a, b), (c, d) = (matrix[..., 0, 0], matrix[..., 0, 1]), (matrix[..., 1, 0], matrix[..., 1, 1])
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    return np.asarray(adjugate / (a * d - b * c)[..., None, None])


def _joined(by_first: FloatArray, by_second: FloatArray) -> FloatArray:
    """(…, n, 2, 12) derivatives by the biases of both sources."""
    return np.concatenate(np.broadcast_arrays(by_first, by_second), axis=-1)


def _outer(one: FloatArray, other: FloatArray) -> FloatArray:
    return np.asarray(one[..., :, None] * other[..., None, :])


@dataclass(frozen=True, eq=False)
class RelativeBias(Offset):
    """The offset between two sources: moves the second's records to where the first would measure them.

    first, second : their models. velocity : (n, 2) of the second source's records, 0 where unknown.
    prior : (12,) prior standard deviations of the biases of the first and the second; 0 to exclude one.
    """

    first: BiasModel
    second: BiasModel
    velocity: FloatArray
    prior: tuple[float, ...]

    @cached_property
    def which(self) -> tuple[int, ...]:
        """Numbers of the biases that are fitted; those of the second source count from 6."""
        return tuple(k for k, width in enumerate(self.prior) if width > 0.0)

    @property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(f"{('first', 'second')[k // 6]}_{BIASES[k % 6]}" for k in self.which)

    @property
    def units(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(("m", "deg", "", "s", "m", "m")[k % 6] for k in self.which)

    @property
    def widths(self) -> tuple[float, ...]:  # type: ignore[override]
        return tuple(self.prior[k] for k in self.which)

    def placed(self, first: Records, second: Records) -> RelativeBias:
        return self

    def moved(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        return self.displaced(features, theta).position

    def jacobian(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        return self.displaced(features, theta).by_theta

    def carried(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        return self.displaced(features, theta).by_position

    def displaced(self, features: FloatArray, theta: FloatArray) -> Displaced:
        true = self._displaced(features, theta)
        return replace(true, slopes=lambda: true.by_theta[..., list(self.which)])

    def _displaced(self, features: FloatArray, theta: FloatArray) -> Displaced:
        theta_12 = np.zeros((*theta.shape[:-1], 12))
        theta_12[..., list(self.which)] = theta
        if not any(self.prior[:6]):
            true = self.second.inverse(features, self.velocity, theta_12[..., 6:])
            return replace(true, slopes=lambda: _joined(np.zeros_like(true.by_theta), true.by_theta))
        if not any(self.prior[6:]):
            measured = self.first.forward(features, self.velocity, theta_12[..., :6])
            return replace(measured, slopes=lambda: _joined(measured.by_theta, np.zeros_like(measured.by_theta)))
        true = self.second.inverse(features, self.velocity, theta_12[..., 6:])
        measured = self.first.forward(true.position, self.velocity, theta_12[..., :6])
        back = measured.by_position
        return Displaced(
            measured.position, back @ true.by_position, lambda: _joined(measured.by_theta, back @ true.by_theta)
        )

    def chart(self, features: FloatArray) -> FloatArray:
        site = self._charted()[1]
        return features if site is None else range_and_azimuth(features - np.asarray(site))

    def periods(self, d: int) -> list[float]:
        return [math.inf, math.inf if self._charted()[1] is None else 360.0]

    def voted(self, d: int) -> list[tuple[int | None, float]]:
        start, site = self._charted()
        pair = (EAST, NORTH) if site is None else (RANGE, AZIMUTH)
        # Biases of the first source are added to the records, those of the second subtracted.
        sign = -1.0 if start else 1.0
        return [(self.which.index(k + start) if k + start in self.which else None, sign) for k in pair]

    def turns(self) -> list[tuple[FloatArray, float]]:
        charted = {at for at, _ in self.voted(2)}
        p = len(self.which)
        return [(np.eye(p)[at], self.widths[at]) for at in range(p) if at not in charted]

    def _charted(self) -> tuple[int, ArrayLike | None]:
        """The source whose biases the chart has (0 or 6), and its site: the one with the wider azimuth prior."""
        polar = [side for side in (0, 6) if self.prior[side + RANGE] or self.prior[side + AZIMUTH]]
        if polar:
            start = max(polar, key=lambda side: self.prior[side + AZIMUTH])
            return start, (self.second if start else self.first).site_m
        return (0 if self.prior[EAST] > self.prior[EAST + 6] else 6), None


@dataclass(frozen=True)
class AzimuthBias(Offset):
    """The azimuth bias of the second source, one of directions; features are degrees clockwise from north.

    azimuth_deg : its prior standard deviation.
    """

    azimuth_deg: float

    names = ("second_azimuth_deg",)
    units = ("deg",)

    @property
    def which(self) -> tuple[int, ...]:
        """As :attr:`RelativeBias.which`."""
        return (AZIMUTH + 6,)

    @property
    def widths(self) -> tuple[float, ...]:  # type: ignore[override]
        return (self.azimuth_deg,)

    def placed(self, first: Records, second: Records) -> AzimuthBias:
        return self

    def moved(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        return features - theta

    def jacobian(self, features: FloatArray, theta: FloatArray) -> FloatArray:
        return np.full((*np.broadcast_shapes(features.shape, theta.shape), 1), -1.0)

    def periods(self, d: int) -> list[float]:
        return [360.0]

    def voted(self, d: int) -> list[tuple[int | None, float]]:
        return [(0, -1.0)]


@dataclass(frozen=True)
class AzimuthDrift:
    """The azimuth bias minus its mean over the recording, between knots of time.

    time_s : (k,) of the knots. azimuth_deg : (k,) the drift there. variance_deg2 : (k,) of the whole azimuth bias.
    process_deg2, correlation_s : variance and correlation time of the drift, for times beyond the knots.
    """

    time_s: FloatArray
    azimuth_deg: FloatArray
    variance_deg2: FloatArray
    process_deg2: float = 0.0
    correlation_s: float = math.inf

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) drift at these times, and (n,) variance of the whole azimuth bias.

        Before the first and after the last knot the drift returns to its mean, 0, as an Ornstein-Uhlenbeck process.
        """
        outside_s = np.abs(time_s - np.clip(time_s, self.time_s[0], self.time_s[-1]))
        kept = np.exp(-outside_s / self.correlation_s)
        variance = kept**2 * np.interp(time_s, self.time_s, self.variance_deg2)
        return (kept * np.interp(time_s, self.time_s, self.azimuth_deg), variance + (1.0 - kept**2) * self.process_deg2)

    @property
    def spread_deg(self) -> float:
        """Root mean square of the drift over the knots."""
        return float(np.sqrt(np.mean(self.azimuth_deg**2))) if len(self.azimuth_deg) else 0.0


#: Covariance of known biases.
CERTAIN = np.zeros((len(BIASES), len(BIASES)))


def corrected(
    reports: States | Directions, sensor_m: FloatArray | None, biases: FloatArray, covariance: FloatArray = CERTAIN
) -> States | Directions:
    """The reports of a source corrected for its biases.

    Covariances are transformed as well: an error along the line of sight stays along the corrected one. The uncertainty
    of the biases is added to each report; its correlation between reports is ignored.

    sensor_m : (n, 2) position of the sensor at each report; None for a source without a site, which has no range and
        azimuth biases.
    biases, covariance : (6,) and (6, 6), in the order of :data:`BIASES`, or (n, 6) and (n, 6, 6), of each report.
    """
    time_s = reports.time_s - biases[..., TIME]
    if isinstance(reports, Directions):
        lasting = np.sqrt(covariance[..., AZIMUTH, AZIMUTH])
        sigma, lasting = np.hypot(reports.sigma_deg, lasting), np.hypot(reports.lasting_deg, lasting)
        bearing = (reports.bearing_deg - biases[..., AZIMUTH]) % 360.0
        return replace(reports, time_s=time_s, bearing_deg=bearing, sigma_deg=sigma, lasting_deg=lasting)
    usable = reports.usable
    if biases.ndim == 2:
        biases, covariance = biases[usable], covariance[usable]
    state, out_covariance = reports.state.copy(), reports.covariance.copy()
    model = BiasModel(None if sensor_m is None else sensor_m[usable])
    # The time bias is corrected in the stamps; positions must not be moved for it again.
    without_time = np.where(np.arange(len(BIASES)) == TIME, 0.0, biases)
    true = model.inverse(state[usable, :2], state[usable, 2:], without_time)
    jacobian = np.zeros((len(true.position), 4, 4))
    jacobian[:, :2, :2] = jacobian[:, 2:, 2:] = true.by_position
    state[usable] = np.einsum("nvw,nw->nv", jacobian, state[usable])
    state[usable, :2] = true.position
    corrected_covariance = propagated(jacobian, out_covariance[usable])
    corrected_covariance[:, :2, :2] += propagated(true.by_theta, covariance)
    out_covariance[usable] = corrected_covariance
    return replace(reports, time_s=time_s, state=state, covariance=out_covariance)
