"""Epoch propagation: catalogue astrometry and its covariance moved to another epoch.

Objects move uniformly in space: the standard model of stellar motion (The Hipparcos and Tycho Catalogues, ESA SP-1200,
vol. 1, sect. 1.5.5; Butkevich & Lindegren 2014, A&A 570, A62), in which radial motion changes the proper motion.
Light-time is neglected, as in EPOCH_PROP of the Gaia archive; astropy includes it: the difference after 50 years is
0.3 mas for Barnard's star, less than 0.0001 mas for most. Directions are barycentric: the annual parallax of an
observer on the Earth is not added.

Make an :class:`Astrometry` with :meth:`Astrometry.of`, which fills in missing parameters. Use :func:`position_at` for
the position and its covariance at the new epoch (as a match does), :func:`propagate` for all six parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray, within_turn
from sameas.errors import InputError
from sameas.gaussian import propagated
from sameas.records import unpack
from sameas.representation import counted, in_short
from sameas.space import ARCSEC_PER_RADIAN


@dataclass(frozen=True)
class Variances:
    """(n,) variances of uncorrelated parameters; a constant column takes no memory (broadcast).

    >>> Variances((np.array([1.0, 4.0]), np.broadcast_to(9.0, 2))).matrices(2)[1]
    array([[4., 0.],
           [0., 9.]])
    """

    columns: tuple[FloatArray, ...]

    @classmethod
    def of(cls, sigmas: tuple[FloatArray, ...]) -> Variances:
        """The squares of standard deviations (n,); a broadcast constant stays broadcast, equal errors share memory."""
        columns: list[FloatArray] = []
        for k, sigma in enumerate(sigmas):
            same = k > 0 and np.array_equal(sigma, sigmas[k - 1], equal_nan=True)
            columns.append(columns[-1] if same else _squared(sigma))
        return cls(tuple(columns))

    def __getitem__(self, rows: Any) -> Variances:
        """The variances of some rows."""
        return Variances(tuple(column[rows] for column in self.columns))

    def stacked(self, k: int) -> FloatArray:
        """(n, k) of the first k parameters."""
        return np.column_stack(self.columns[:k])

    def matrices(self, k: int) -> FloatArray:
        """(n, k, k) covariances of the first k parameters."""
        return unpack(self.stacked(k), k)


def _squared(sigma: FloatArray) -> FloatArray:
    if sigma.strides == (0,) and len(sigma):
        return np.broadcast_to(np.square(sigma[0]), sigma.shape)
    return np.square(sigma)


@dataclass(frozen=True)
class MissingMotion:
    """Prior of an unmeasured motion: uncorrelated normal distributions, mean zero, with these standard deviations.

    The defaults are for a faint field star. Michalik et al. 2015 (A&A 583, A68) give the prior that Gaia
    uses for its two-parameter solutions: at G = 20 a parallax scatter of 0.4 mas (galactic plane) to 1.1 mas
    (poles), and 10 /yr times that in proper motion. Radial velocities near the Sun scatter by some 50 km/s
    (both discs, and the Sun's own motion). A brighter or nearer sample deserves larger values.
    """

    pm_sigma_mas_per_yr: float = 10.0
    parallax_sigma_mas: float = 1.0
    radial_velocity_sigma_km_per_s: float = 50.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < np.inf:
                raise InputError(f"MissingMotion: {name} is {value}; give a standard deviation, zero or more")

    def __call__(
        self, parameter: int, value: FloatArray | None, error: FloatArray | None, n: int
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """(n,) values and errors of a parameter with unknown ones (NaN or None) filled, and the mask of filled rows.

        Positions are not filled. A value without an error keeps its value and gets the prior's error. An error without
        a value is replaced by the prior's.
        """
        pm = self.pm_sigma_mas_per_yr
        prior = (np.nan, np.nan, self.parallax_sigma_mas, pm, pm, self.radial_velocity_sigma_km_per_s)[parameter]
        if value is None:
            return np.broadcast_to(0.0, n), np.broadcast_to(prior, n), np.broadcast_to(True, n)
        error = np.broadcast_to(np.nan, n) if error is None else error
        if parameter < 2:
            return value, error, np.broadcast_to(False, n)
        no_value = np.isnan(value)
        filled = no_value | np.isnan(error)
        return np.where(no_value, 0.0, value), np.where(filled, prior, error), filled


FloatTriple = tuple[FloatArray, FloatArray, FloatArray]

#: The astronomical unit in km (IAU 2012 resolution B2); one per Julian year in km/s.
AU_KM = 149597870.7
AU_KM_PER_S_YR = AU_KM / (365.25 * 86400.0)
_RADIAN_PER_MAS = 1e-3 / ARCSEC_PER_RADIAN
#: Limit of Julian years, so that an MJD or JD given as an epoch is refused.
_FARTHEST_JYR = 10_000.0
#: Rows per chunk: intermediate arrays stay in the processor's cache (timed).
CHUNK = 8192


@in_short
@dataclass(frozen=True)
class Astrometry:
    """Six astrometric parameters of each object at an epoch, with covariances. Make it with :meth:`Astrometry.of`.

    ra_deg, dec_deg : (n,) ICRS, NaN where there is no position.
    parallax_mas : (n,) as measured; may be zero or negative.
    pm_ra_mas_per_yr, pm_dec_mas_per_yr : (n,) proper motion; ``pm_ra`` includes cos(dec).
    radial_velocity_km_per_s : (n,) barycentric, positive for a receding object.
    packed : covariances in the order of ``PARAMETERS``: ra·cos(dec) and dec [mas], parallax [mas], proper motions
        [mas/yr], radial velocity [km/s]; (n, 6, 6), or ``Variances`` if uncorrelated.
    epoch_jyr : (n,) Julian year of each row.
    """

    ra_deg: FloatArray
    dec_deg: FloatArray
    parallax_mas: FloatArray
    pm_ra_mas_per_yr: FloatArray
    pm_dec_mas_per_yr: FloatArray
    radial_velocity_km_per_s: FloatArray
    packed: FloatArray | Variances
    epoch_jyr: FloatArray

    def __len__(self) -> int:
        return len(self.ra_deg)

    def __getitem__(self, rows: slice | IntArray | BoolArray) -> Astrometry:
        """The astrometry of some rows."""
        return Astrometry(**{name: array[rows] for name, array in vars(self).items()})

    @property
    def covariance(self) -> FloatArray:
        """(n, 6, 6) covariances, unpacked."""
        return self.packed.matrices(6) if isinstance(self.packed, Variances) else self.packed

    @property
    def position_covariance(self) -> FloatArray:
        """(n, 2, 2) of ra·cos(dec) and dec, mas²."""
        return self.packed.matrices(2) if isinstance(self.packed, Variances) else self.packed[:, :2, :2]

    @property
    def motion_arcsec_per_yr(self) -> FloatArray:
        """(n, 2) proper motion, east with cos(dec), and north."""
        return 1e-3 * np.column_stack([self.pm_ra_mas_per_yr, self.pm_dec_mas_per_yr])

    def variance(self, parameter: int) -> FloatArray:
        """(n,) variances of one of the six parameters."""
        if isinstance(self.packed, Variances):
            return self.packed.columns[parameter]
        return self.packed[:, parameter, parameter]

    @classmethod
    def of(
        cls,
        ra_deg: ArrayLike,
        dec_deg: ArrayLike,
        *,
        epoch_jyr: ArrayLike,
        sigma: ArrayLike,
        correlation: ArrayLike | None = None,
        parallax_mas: ArrayLike | None = None,
        pm_ra_mas_per_yr: ArrayLike | None = None,
        pm_dec_mas_per_yr: ArrayLike | None = None,
        radial_velocity_km_per_s: ArrayLike | None = None,
        missing: MissingMotion | None = None,
        source: str = "source",
    ) -> Astrometry:
        """Astrometry from the columns of a catalogue, checked; unmeasured parameters get the prior ``missing``.

        ra_deg, dec_deg : (n,). A missing position or error (NaN or masked) stays missing at other epochs.
        epoch_jyr : Julian year, one for all or (n,).
        sigma : (n, k) standard deviations of the first k of ``PARAMETERS``, 2 ≤ k ≤ 6, in the units of
            :class:`Astrometry`; NaN or masked where unknown.
        correlation : (n, k, k) coefficients; zero where not given, NaN, or if a parameter was filled.
        parallax_mas, pm_ra_mas_per_yr, pm_dec_mas_per_yr, radial_velocity_km_per_s : (n,); NaN, masked or not
            given where not measured.
        missing : prior of unmeasured motion, ``MissingMotion()`` by default; it also defines the error of a value
            without an error.
        source : name used in messages.

        Raises InputError: columns of different lengths, dec beyond ±90°, negative errors, correlations beyond ±1, an
        epoch that is not a Julian year.

        Example
        -------
        A position with an error of 0.05" in 2000 and unknown proper motion has an error of 0.17" in 2016:

        >>> star = Astrometry.of([10.0], [20.0], epoch_jyr=2000.0, sigma=[[50.0, 50.0]])
        >>> position_at(star, 2016.0).covariance_arcsec2.round(4)
        array([[[0.0281, 0.    ],
                [0.    , 0.0281]]])
        """
        given = (ra_deg, dec_deg, parallax_mas, pm_ra_mas_per_yr, pm_dec_mas_per_yr, radial_velocity_km_per_s)
        n = np.size(ra_deg)
        values = [
            None if v is None else _floats(v, (n,), f"{source}: {p}") for p, v in zip(PARAMETERS, given, strict=True)
        ]
        _refuse(np.abs(_floats(dec_deg, (n,), source)) > 90.0, f"{source}: declinations beyond ±90°", "give degrees")
        missing, errors = missing or MissingMotion(), _errors(sigma, n, source)
        complete = [missing(k, values[k], errors[k] if k < len(errors) else None, n) for k in range(6)]
        filled, sigmas, unknown = zip(*complete, strict=True)
        packed = _packed(sigmas, unknown, correlation, source)
        columns = dict(zip(PARAMETERS, filled, strict=True))
        return cls(**columns, packed=packed, epoch_jyr=_epochs(epoch_jyr, n, source))


PARAMETERS = tuple(field.name for field in fields(Astrometry))[:6]


class Position(NamedTuple):
    """Positions: ``ra_deg`` in 0..360 and ``dec_deg``, (n,); covariance of east and north, (n, 2, 2)."""

    ra_deg: FloatArray
    dec_deg: FloatArray
    covariance_arcsec2: FloatArray


def position_at(astrometry: Astrometry, epoch_jyr: ArrayLike) -> Position:
    """Positions at another epoch, with covariances along east and north at the new position.

    The same numbers as the first two parameters of :func:`propagate`, in less time.
    epoch_jyr : one Julian year for all rows, or (n,).
    """
    n = len(astrometry)
    epochs = _epochs(epoch_jyr, n, "position_at")
    if np.array_equal(epochs, astrometry.epoch_jyr):
        return Position(within_turn(astrometry.ra_deg), astrometry.dec_deg, 1e-6 * astrometry.position_covariance)
    ra, dec, covariance = np.empty(n), np.empty(n), np.empty((n, 2, 2))
    for rows in _chunks(n):
        part = astrometry[rows]
        path = _path(part, epochs[rows])
        ra[rows], dec[rows] = path.ra_deg, path.dec_deg
        covariance[rows] = 1e-6 * _propagated_covariance(part, _position_derivatives(path))
    return Position(ra, dec, covariance)


def propagate(astrometry: Astrometry, epoch_jyr: ArrayLike) -> Astrometry:
    """The six parameters at another epoch, with their full covariance along the axes at the new position.

    epoch_jyr : one Julian year for all rows, or (n,). Propagating back restores everything except the second-order term
    below, which is added twice.

    The covariance is J C Jᵀ with the derivatives J of SP-1200 sect. 1.5.5. Errors of position and motion are vectors on
    the sky and are transported parallel, so the result does not depend on the position of the pole. The variance of the
    product of the errors of parallax and radial velocity, neglected there, is added to that of the radial motion
    (Michalik et al. 2014, A&A 571, A85, eq. 17).

    Zero and negative parallaxes are used as they are: the radial motion v π / A is zero or reversed. Where the parallax
    is exactly zero, the radial velocity is kept (its formula diverges).
    """
    n = len(astrometry)
    epochs = _epochs(epoch_jyr, n, "propagate")
    values, covariance = np.empty((6, n)), np.empty((n, 6, 6))
    for rows in _chunks(n):
        part = astrometry[rows]
        path = _path(part, epochs[rows])
        values[:, rows] = _end_values(part, path)
        covariance[rows] = _propagated_covariance(part, _derivatives(part, path, values[5, rows]))
    columns = dict(zip(PARAMETERS, values, strict=True))
    return Astrometry(**columns, packed=covariance, epoch_jyr=epochs)


class _GreatCircle(NamedTuple):
    """The great circle from one epoch to the other, each field (n,) or (n, 2), used by the derivatives.

    With radial and transverse motion ζ = v π / A and μ, the distance grows by the factor 1/f and the direction moves by
    the angle θ: (cos θ, sin θ) = f (1 + ζt, μt). So z = ζ + iμ becomes z / (1 + zt), derivative (f exp(-iθ))².
    """

    ra_deg: FloatArray
    dec_deg: FloatArray
    span_yr: FloatArray
    transverse: FloatArray  # μ, mas/yr
    radial: FloatArray  # ζ, mas/yr
    distance_ratio: FloatArray  # f, old over new distance
    cos: FloatArray
    sin: FloatArray
    start: FloatArray  # unit vector along the motion, east and north at the old position
    end: FloatArray  # the same at the new position


def _path(part: Astrometry, epochs: FloatArray) -> _GreatCircle:
    span = epochs - part.epoch_jyr
    transverse = np.hypot(part.pm_ra_mas_per_yr, part.pm_dec_mas_per_yr)
    at_rest = transverse == 0.0
    start = np.stack([part.pm_ra_mas_per_yr, np.where(at_rest, 1.0, part.pm_dec_mas_per_yr)], axis=1)
    start /= np.where(at_rest, 1.0, transverse)[:, None]
    radial = part.radial_velocity_km_per_s * part.parallax_mas / AU_KM_PER_S_YR
    ahead, across = 1.0 + _RADIAN_PER_MAS * radial * span, _RADIAN_PER_MAS * transverse * span
    distance_ratio = 1.0 / np.sqrt(ahead * ahead + across * across)
    cos, sin = distance_ratio * ahead, distance_ratio * across
    change_of_ra, dec, end = _arc(np.radians(part.dec_deg), cos, sin, start)
    ra_deg = within_turn(part.ra_deg + np.degrees(change_of_ra))
    return _GreatCircle(ra_deg, np.degrees(dec), span, transverse, radial, distance_ratio, cos, sin, start, end)


def _arc(dec: FloatArray, cos: FloatArray, sin: FloatArray, start: FloatArray) -> FloatTriple:
    """Change of ra, new dec and end direction after the angle θ along the great circle from ``dec`` along ``start``."""
    east, north = start.T
    # Cartesian axes: x on the meridian of the old position, z at the pole.
    sin_dec, cos_dec = np.sin(dec), np.cos(dec)
    x, y, z = cos * cos_dec - sin * north * sin_dec, sin * east, cos * sin_dec + sin * north * cos_dec
    ahead_x, ahead_y = -cos * north * sin_dec - sin * cos_dec, cos * east
    ahead_z = cos * north * cos_dec - sin * sin_dec
    off_axis = np.hypot(x, y)
    at_pole = off_axis == 0.0  # exactly at the pole the meridian is kept
    scale = 1.0 / np.where(at_pole, 1.0, off_axis)
    cos_turn, sin_turn = np.where(at_pole, 1.0, x * scale), y * scale
    end_east = ahead_y * cos_turn - ahead_x * sin_turn
    end_north = off_axis * ahead_z - z * (ahead_x * cos_turn + ahead_y * sin_turn)
    return np.arctan2(y, x), np.arctan2(z, off_axis), np.stack([end_east, end_north], axis=1)


def _end_values(part: Astrometry, path: _GreatCircle) -> FloatArray:
    """(6, n) the parameters at the new epoch."""
    f, parallax, velocity = path.distance_ratio, part.parallax_mas, part.radial_velocity_km_per_s
    motion = f * f * path.transverse
    # v₁ = A ζ₁ / π₁, without the quotient ζ / π
    gained = _RADIAN_PER_MAS * path.span_yr * (path.transverse**2 + path.radial**2)
    with_parallax = np.where(parallax == 0.0, np.inf, parallax)
    velocity = np.where(parallax == 0.0, velocity, f * (velocity + AU_KM_PER_S_YR * gained / with_parallax))
    east, north = path.end.T
    return np.stack([path.ra_deg, path.dec_deg, f * parallax, motion * east, motion * north, velocity])


def _position_derivatives(path: _GreatCircle) -> FloatArray:
    """(n, 2, 7) ∂(east, north at the new position) by the six old parameters and, separately, by ζ.

    Along the motion  a₁ = a + f t (cos θ μ_a - sin θ ζ),  across it  b₁ = cos θ b + f t μ_b.
    """
    scaled_span = path.distance_ratio * path.span_yr
    derivatives = np.zeros((len(path.cos), 2, 7))
    derivatives[:, :, 0:2] = _along_and_across(path, 1.0, path.cos)
    derivatives[:, :, 3:5] = _along_and_across(path, scaled_span * path.cos, scaled_span)
    derivatives[:, :, 6] = -(scaled_span * path.sin)[:, None] * path.end
    return derivatives


def _derivatives(part: Astrometry, path: _GreatCircle, velocity: FloatArray) -> FloatArray:
    """(n, 6, 7) ∂(new parameters) by the six old parameters and, separately, by ζ.

    velocity : the new radial velocity, km/s.

    π₁ = f π;  along the motion  f² (cos 2θ μ_a - sin 2θ ζ),  across it  f² (cos θ μ_b - μ sin θ b),
    radially  ζ₁ = f² (sin 2θ μ_a + cos 2θ ζ),  v₁ = A ζ₁ / π₁.
    """
    f, cos, sin = path.distance_ratio, path.cos, path.sin
    f2, cos2, sin2 = f * f, cos * cos - sin * sin, 2.0 * sin * cos
    shrink = -_RADIAN_PER_MAS * part.parallax_mas * f2 * path.span_yr
    derivatives = np.zeros((len(f), 6, 7))
    derivatives[:, 0:2] = _position_derivatives(path)
    derivatives[:, 2, 2] = f
    derivatives[:, 2, 3:5] = (shrink * sin)[:, None] * path.start
    derivatives[:, 2, 6] = shrink * cos
    derivatives[:, 3:5, 0:2] = _along_and_across(path, 0.0, -_RADIAN_PER_MAS * path.transverse * f2 * sin)
    derivatives[:, 3:5, 3:5] = _along_and_across(path, f2 * cos2, f2 * cos)
    derivatives[:, 3:5, 6] = -(f2 * sin2)[:, None] * path.end

    # v₁ directly by its parameters: the derivative through ζ is undefined at zero parallax.
    no_parallax = part.parallax_mas == 0.0
    parallax = np.where(no_parallax, np.inf, f * part.parallax_mas)
    by_transverse = (AU_KM_PER_S_YR * f2 * sin2 - velocity * shrink * sin) / parallax
    by_radial = (AU_KM_PER_S_YR * f2 * cos2 - velocity * shrink * cos) / parallax
    derivatives[:, 5, 2] = by_radial * part.radial_velocity_km_per_s / AU_KM_PER_S_YR - velocity * f / parallax
    derivatives[:, 5, 3:5] = by_transverse[:, None] * path.start
    derivatives[:, 5, 5] = np.where(no_parallax, 1.0, by_radial * part.parallax_mas / AU_KM_PER_S_YR)
    return derivatives


def _propagated_covariance(part: Astrometry, derivatives: FloatArray) -> FloatArray:
    """(n, k, k) covariances at the new epoch, from the ``derivatives`` (n, k, 7) of k new parameters."""
    by_radial = derivatives[:, :, 6]
    jacobian = derivatives[:, :, :6].copy()
    jacobian[:, :, 2] += by_radial * (part.radial_velocity_km_per_s / AU_KM_PER_S_YR)[:, None]
    jacobian[:, :, 5] += by_radial * (part.parallax_mas / AU_KM_PER_S_YR)[:, None]
    old = part.covariance
    new = propagated(jacobian, old)
    # The second-order variance of v π: Michalik et al. 2014 eq. 17, with v and π correlated.
    product = (old[:, 2, 2] * old[:, 5, 5] + old[:, 2, 5] ** 2) / AU_KM_PER_S_YR**2
    new += product[:, None, None] * (by_radial[:, :, None] * by_radial[:, None, :])
    return new


def _along_and_across(path: _GreatCircle, along: FloatArray | float, across: FloatArray) -> FloatArray:
    """(n, 2, 2) matrices from old to new axes (east, north) that scale along and across the motion."""
    (east, north), (end_east, end_north) = path.start.T, path.end.T
    matrices = np.empty((len(east), 2, 2))
    matrices[:, 0, 0] = along * end_east * east + across * end_north * north
    matrices[:, 0, 1] = along * end_east * north - across * end_north * east
    matrices[:, 1, 0] = along * end_north * east - across * end_east * north
    matrices[:, 1, 1] = along * end_north * north + across * end_east * east
    return matrices


def _chunks(n: int) -> Iterator[slice]:
    return (slice(start, start + CHUNK) for start in range(0, n, CHUNK))


def _errors(sigma: ArrayLike, n: int, source: str) -> list[FloatArray]:
    """Standard deviations of the first k parameters, each (n,), NaN where unknown."""
    k = np.shape(sigma)[-1] if np.ndim(sigma) == 2 else 0
    if not 2 <= k <= 6:
        raise InputError(f"{source}: sigma has shape {np.shape(sigma)}; give ({n}, 2) up to ({n}, 6)")
    errors = _floats(sigma, (n, k), f"{source}: sigma")
    if (errors < 0.0).any():  # of all at once: by row takes ten times as long
        _refuse(np.any(errors < 0.0, axis=1), f"{source}: negative errors", "leave unknown errors empty")
    return list(errors.T)


def _packed(
    sigmas: tuple[FloatArray, ...], filled: tuple[BoolArray, ...], correlation: ArrayLike | None, source: str
) -> FloatArray | Variances:
    """Variances, or (n, 6, 6) covariances if correlations are given. filled : mask of filled values per parameter."""
    if correlation is None:
        return Variances.of(sigmas)
    n, errors = len(sigmas[0]), np.column_stack(sigmas)
    is_filled, covariance = np.stack(filled, axis=1), np.empty((n, 6, 6))
    k = min(np.shape(correlation)[-1], 6) if np.ndim(correlation) == 3 else 6
    rho = _floats(correlation, (n, k, k), f"{source}: correlations")
    beyond, asymmetric = np.zeros(n, bool), np.zeros(n, bool)
    for rows in _chunks(n):
        transposed = rho[rows].swapaxes(1, 2)
        beyond[rows] = np.any(np.abs(rho[rows]) > 1.0 + 1e-6, axis=(1, 2))  # a float32 may be rounded up
        asymmetric[rows] = np.any(np.abs(rho[rows] - transposed) > 1e-6, axis=(1, 2))
        unknown = np.isnan(rho[rows]) | is_filled[rows, :k, None] | is_filled[rows, None, :k]
        product = errors[rows, :, None] * errors[rows, None, :]
        coefficient = np.zeros(product.shape)
        coefficient[:, :k, :k] = np.where(unknown, 0.0, rho[rows])
        coefficient[:, np.arange(6), np.arange(6)] = 1.0
        covariance[rows] = product * coefficient
    _refuse(beyond, f"{source}: correlations beyond ±1", "give coefficients")
    _refuse(asymmetric, f"{source}: correlations that are not symmetric", "give both halves")
    return covariance


def _floats(values: ArrayLike | None, shape: tuple[int, ...], what: str) -> FloatArray:
    """Floats of the shape, NaN where masked or not finite; a scalar is broadcast. Refused: other shapes, text."""
    try:
        column = np.ma.masked_array(np.nan if values is None else values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: not numbers ({error})") from None
    if column.shape not in ((), shape):
        raise InputError(f"{what}: shape {column.shape}; give {shape}")
    array = np.ma.filled(column, np.nan)
    finite = np.isfinite(array)
    return np.broadcast_to(array if finite.all() else np.where(finite, array, np.nan), shape)


def _epochs(epoch_jyr: ArrayLike, n: int, source: str) -> FloatArray:
    epochs = _floats(epoch_jyr, (n,), f"{source}: epoch")
    remedy = "give e.g. 2016.0, of an MJD 2000 + (MJD - 51544.5) / 365.25"
    _refuse(~(np.abs(epochs) < _FARTHEST_JYR), f"{source}: epochs that are not Julian years", remedy)
    return epochs


def _refuse(invalid: NDArray[Any], what: str, remedy: str) -> None:
    rows = np.flatnonzero(invalid)
    if len(rows):
        raise InputError(f"{what} in {counted(len(rows), 'row')} (first: row {rows[0]}); {remedy}")
