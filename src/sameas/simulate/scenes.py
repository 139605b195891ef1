"""Scenes of known truth: two sources of the same objects whose errors follow the quoted covariances.

Use :func:`poisson_field` for the assumptions of the method in any number of features, :func:`sky_field` and
:func:`crowded_sky` for large catalogues on the sphere, :func:`line` and :func:`grid` for the papers' targets. Rows are
shuffled, and every random number comes from the caller's Generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import ARCSEC_PER_RADIAN, Plane, Sphere, displaced, half_convergence, rotations

#: The names of the two sources.
NAMES = ("first", "second")
#: Least and largest error of a record of the benchmarks on each axis, arcsec.
SIGMA_ARCSEC = (0.05, 0.5)


@dataclass(frozen=True)
class WholeSky:
    """All directions."""

    def steradians(self) -> float:
        """Area."""
        return 4 * math.pi

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """(n, 2) directions, evenly scattered: longitude, latitude in degrees."""
        return LonLatBox((0.0, 360.0), (-90.0, 90.0)).draw(rng, n)


@dataclass(frozen=True)
class Cap:
    """The directions within ``radius_deg`` of a centre."""

    lon_deg: float
    lat_deg: float
    radius_deg: float

    def __post_init__(self) -> None:
        if not 0 < self.radius_deg <= 180:
            raise InputError(f"Cap: radius_deg is {self.radius_deg}; give a radius above 0 and up to 180")

    def steradians(self) -> float:
        """Area."""
        return 4 * math.pi * math.sin(math.radians(self.radius_deg) / 2) ** 2

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """(n, 2) directions, evenly scattered: longitude, latitude in degrees."""
        distance = 2 * np.arcsin(math.sin(math.radians(self.radius_deg) / 2) * np.sqrt(rng.uniform(size=n)))
        angle = rng.uniform(0, 2 * np.pi, n)
        offset = distance[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1) * ARCSEC_PER_RADIAN
        return displaced(np.broadcast_to([self.lon_deg, self.lat_deg], (n, 2)), offset)


@dataclass(frozen=True)
class LonLatBox:
    """The directions between two meridians and two parallels, (low, high) each; longitude may exceed 360."""

    lon_deg: tuple[float, float]
    lat_deg: tuple[float, float]

    def __post_init__(self) -> None:
        if not 0 < self.lon_deg[1] - self.lon_deg[0] <= 360:
            raise InputError(f"LonLatBox: lon_deg is {self.lon_deg}; give (low, high) that span up to 360")
        if not -90 <= self.lat_deg[0] < self.lat_deg[1] <= 90:
            raise InputError(f"LonLatBox: lat_deg is {self.lat_deg}; give (low, high) within ±90")

    def steradians(self) -> float:
        """Area."""
        low, high = np.sin(np.radians(self.lat_deg))
        return float(math.radians(self.lon_deg[1] - self.lon_deg[0]) * (high - low))

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """(n, 2) directions, evenly scattered: longitude, latitude in degrees."""
        low, high = np.sin(np.radians(self.lat_deg))
        sine = rng.uniform(low, high, n)
        return np.stack([rng.uniform(*self.lon_deg, n) % 360, np.degrees(np.arcsin(sine))], axis=1)


Sigma = float | tuple[float, float]


@in_short
@dataclass(frozen=True)
class SimulatedScene:
    """Two sources and the true objects of their records.

    Attributes
    ----------
    first, second : the records of the two sources, n1 and n2.
    truth_1, truth_2 : (n1,) and (n2,) number of the true object of each record. A false detection has its own number,
        so that the numbers of a source are distinct.
    false_1, false_2 : (n1,) and (n2,) masks of the false detections.
    """

    first: Records
    second: Records
    truth_1: IntArray
    truth_2: IntArray
    false_1: np.ndarray
    false_2: np.ndarray

    def true_pairs(self) -> tuple[IntArray, IntArray]:
        """Rows of the records of one object: (rows_1, rows_2), each (k,), rows_1 ascending."""
        n_objects = 1 + max(self.truth_1.max(initial=-1), self.truth_2.max(initial=-1))
        row_of = np.empty(n_objects, np.int64)
        row_of[self.truth_2] = np.arange(len(self.truth_2))
        in_second = np.zeros(n_objects, bool)
        in_second[self.truth_2] = True
        rows_1 = np.flatnonzero(in_second[self.truth_1])
        return rows_1, row_of[self.truth_1[rows_1]]


# ---- in a plane ----


def poisson_field(
    rng: np.random.Generator,
    *,
    density: float,
    extent: tuple[float, ...],
    q1: float,
    q2: float,
    sigma_1: Sigma,
    sigma_2: Sigma,
    false_1: float = 0.0,
    false_2: float = 0.0,
    correlated: bool = False,
    space: Plane | None = None,
) -> SimulatedScene:
    """Objects scattered at random in a box, each missed by the sources with probabilities q1 and q2.

    Parameters
    ----------
    rng : source of all random numbers.
    density : mean number of objects per unit volume of feature space (ρ of METHOD 4).
    extent : (d,) sizes of the box; its low corner is the origin.
    q1, q2 : probability that the source misses an object.
    sigma_1, sigma_2 : standard deviation of each feature's error; (low, high) draws one per record,
        log-uniform.
    false_1, false_2 : mean number of false detections per unit volume, scattered like objects.
    correlated : give each record a full covariance: the axes of its error are rotated at random and stretched by
        independent log-uniform factors in ½ … 2.
    space : a Plane; records are wrapped into its periods. Periods equal to ``extent`` leave no edge.

    Source: METHOD 4.3 (objects a Poisson field).

    >>> scene = poisson_field(np.random.default_rng(1), density=1.0, extent=(10.0, 10.0), q1=0.1, q2=0.2,
    ...                       sigma_1=0.05, sigma_2=(0.05, 0.2))
    >>> rows_1, rows_2 = scene.true_pairs()
    >>> bool((scene.truth_1[rows_1] == scene.truth_2[rows_2]).all())
    True
    """
    size = np.asarray(extent, float)
    for name, value in (("density", density), ("false_1", false_1), ("false_2", false_2)):
        if not 0 <= value < math.inf:
            raise InputError(f"poisson_field: {name} is {value}; give a number that is not negative")
    if size.ndim != 1 or not len(size) or not (size > 0).all():
        raise InputError(f"poisson_field: extent is {extent}; give one positive size per feature")
    count, *n_false = rng.poisson(size.prod() * np.array([density, false_1, false_2]))
    positions = rng.uniform(size=(count + sum(n_false), len(size))) * size
    detected_1, detected_2 = _detected(rng, count, q1, q2)
    numbers = np.split(np.arange(len(positions)), [count, count + n_false[0]])
    objects = (np.concatenate([detected_1, numbers[1]]), np.concatenate([detected_2, numbers[2]]))
    return _plane_scene(rng, positions, objects, count, (sigma_1, sigma_2), correlated, space or Plane())


def line(
    rng: np.random.Generator,
    *,
    n: int,
    spacing_sigmas: float,
    q1: float,
    q2: float,
    sigma_1: float = 1.0,
    sigma_2: float = 1.0,
    d: int = 2,
) -> SimulatedScene:
    """The papers' n targets in a line: neighbours differ by ``spacing_sigmas`` · σ in the first feature.

    σ² = σ₁² + σ₂² is the variance of the residual of one feature. Source: METHOD 8 [T].
    """
    return grid(
        rng, shape=(n,) + (1,) * (d - 1), spacing_sigmas=spacing_sigmas, q1=q1, q2=q2, sigma_1=sigma_1, sigma_2=sigma_2
    )


def grid(
    rng: np.random.Generator,
    *,
    shape: tuple[int, ...],
    spacing_sigmas: float,
    q1: float,
    q2: float,
    sigma_1: float = 1.0,
    sigma_2: float = 1.0,
) -> SimulatedScene:
    """The papers' targets on a lattice: two neighbours differ by ``spacing_sigmas`` · σ in one feature only.

    Parameters
    ----------
    shape : (d,) number of targets along each feature; one target is at the origin.
    spacing_sigmas : the papers' d, in units of the residual's standard deviation σ = √(σ₁² + σ₂²).
    q1, q2 : probability that the source misses a target.
    sigma_1, sigma_2 : standard deviation of every feature's error.

    Source: METHOD 8 [T].
    """
    if not shape or min(shape) < 1:
        raise InputError(f"grid: shape is {shape}; give one positive count per feature")
    if not spacing_sigmas >= 0:
        raise InputError(f"grid: spacing_sigmas is {spacing_sigmas}; give a number that is not negative")
    steps = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    positions = steps.reshape(-1, len(shape)).astype(np.float64) * (spacing_sigmas * math.hypot(sigma_1, sigma_2))
    detected = _detected(rng, len(positions), q1, q2)
    return _plane_scene(rng, positions, detected, len(positions), (sigma_1, sigma_2), False, Plane())


def _plane_scene(
    rng: np.random.Generator, positions: FloatArray, objects: tuple[IntArray, IntArray], n_real: int,
    sigmas: tuple[Sigma, Sigma], correlated: bool, space: Plane,
) -> SimulatedScene:  # fmt: skip
    """The scene of sources that detected ``objects`` (numbers) at ``positions`` (n, d), false from n_real on."""
    d = positions.shape[1]
    period = np.array(space.period_list(d))
    wraps = np.isfinite(period)
    sources, truths = [], []
    for numbers, sigma, name in zip(objects, sigmas, NAMES, strict=True):
        truth = rng.permutation(numbers)
        spread = _log_uniform(rng, sigma, len(truth), name)
        axes = _random_axes(rng, spread, d) if correlated else spread[:, None, None] * np.eye(d)
        features = positions[truth] + np.einsum("nvw,nw->nv", axes, rng.standard_normal((len(truth), d)))
        features[:, wraps] %= period[wraps]
        covariance = axes @ axes.transpose(0, 2, 1)
        if correlated:
            sources.append(Records.of(features, covariance=covariance, space=space, source=name))
        else:
            variance = np.einsum("nvv->nv", covariance)
            sources.append(Records.of(features, variance=variance, space=space, source=name))
        truths.append(truth)
    return SimulatedScene(sources[0], sources[1], truths[0], truths[1], truths[0] >= n_real, truths[1] >= n_real)


def _random_axes(rng: np.random.Generator, spread: FloatArray, d: int) -> FloatArray:
    """(n, d, d) factors A of covariances A Aᵀ: rotated at random, stretched by ½ … 2 along each axis."""
    rotated = np.linalg.qr(rng.standard_normal((len(spread), d, d)))[0] if len(spread) else np.empty((0, d, d))
    return rotated * (spread[:, None] * 2.0 ** rng.uniform(-1, 1, (len(spread), d)))[:, None, :]


# ---- on the sphere ----


def sky_field(
    rng: np.random.Generator,
    *,
    n_common: int,
    n_only_1: int,
    n_only_2: int,
    sigma_arcsec: Sigma = SIGMA_ARCSEC,
    area: WholeSky | Cap | LonLatBox | None = None,
    elliptical: bool = False,
) -> SimulatedScene:
    """Directions uniformly scattered over an area of the sky, some in both sources and some in one of them.

    Parameters
    ----------
    rng : source of all random numbers.
    n_common, n_only_1, n_only_2 : number of objects in both, in the first only, in the second only.
    sigma_arcsec : error on each axis; (low, high) draws one per record, log-uniform.
    area : of the objects; by default the whole sky.
    elliptical : give each record a full covariance of mean variance σ²: variances σ²(1 ± e) along two axes at
        a random position angle, e uniform in 0 … 0.8.

    Source: the workload of the benchmarks (``benchmarks/README.md``).
    """
    counts = n_common, n_only_1, n_only_2
    if min(counts) < 0:
        raise InputError(f"sky_field: the numbers of objects are {counts}; give none below 0")
    positions = (area or WholeSky()).draw(rng, sum(counts))
    numbers = np.arange(sum(counts))
    detected = (numbers[: n_common + n_only_1], np.concatenate([numbers[:n_common], numbers[n_common + n_only_1 :]]))
    sources, truths = [], []
    for objects, name in zip(detected, NAMES, strict=True):
        truth = rng.permutation(objects)
        spread = _log_uniform(rng, sigma_arcsec, len(truth), name)
        draw = _elliptical_sky if elliptical else _circular_sky
        sources.append(draw(rng, positions[truth], spread, name))
        truths.append(truth)
    false_1, false_2 = (np.zeros(len(truth), bool) for truth in truths)
    return SimulatedScene(sources[0], sources[1], truths[0], truths[1], false_1, false_2)


def crowded_sky(
    rng: np.random.Generator,
    n: int,
    lam: float,
    *,
    elliptical: bool = False,
    centre_deg: tuple[float, float] = (150.0, 40.0),
) -> SimulatedScene:
    """The workload of the benchmarks: a cap in which a record has ``lam`` chance candidates on average.

    80 % of the objects are in both sources and 10 % in each alone; each source has ``n`` rows. A chance candidate is
    another object within 3 √(σ₁² + σ₂²). ``elliptical`` (see :func:`sky_field`) keeps the mean variance; its gates
    ΔᵀΣ⁻¹Δ ≤ 9 are a few per cent smaller, and so is the true ``lam``.

    Parameters
    ----------
    n : rows of each source.
    lam : mean number of chance candidates of a record (the benchmarks take 0.05, 0.5, 2, 8).
    centre_deg : longitude and latitude of the cap's centre; with latitude ±90 it contains a pole.
    """
    steradians = chance_area_steradians(n, lam, SIGMA_ARCSEC)
    if steradians > 4 * math.pi:
        raise InputError(
            f"crowded_sky: {n} rows with {lam} chance candidates each would fill "
            f"{steradians / (4 * math.pi):.3g} skies; give fewer rows or a larger lam"
        )
    radius_deg = math.degrees(2 * math.asin(math.sqrt(steradians / (4 * math.pi))))
    n_common = round(n * 8 / 9)
    return sky_field(
        rng,
        n_common=n_common,
        n_only_1=n - n_common,
        n_only_2=n - n_common,
        area=Cap(*centre_deg, radius_deg),
        elliptical=elliptical,
    )


def chance_area_steradians(n: int, lam: float, sigma_arcsec: Sigma) -> float:
    """The area over which ``n`` rows of the other source give a record ``lam`` chance candidates on average.

    λ = n π 3² E[σ₁² + σ₂²] / area; for σ log-uniform in (l, h), E σ² = (h² − l²) / (2 ln(h/l)).
    """
    if not (n > 0 and lam > 0):
        raise InputError(f"{n} rows, {lam} chance candidates; give positive numbers")
    low, high = _bounds(sigma_arcsec, "sigma_arcsec")
    mean_square = low**2 if low == high else (high**2 - low**2) / (2 * math.log(high / low))
    return n * math.pi * 9.0 * 2 * mean_square / lam / ARCSEC_PER_RADIAN**2


def _circular_sky(rng: np.random.Generator, position_deg: FloatArray, spread: FloatArray, name: str) -> Records:
    """Directions displaced by their quoted errors, σ (n,) on both axes."""
    offset = rng.standard_normal(position_deg.shape) * spread[:, None]
    return Records.of(displaced(position_deg, offset), variance=(spread**2)[:, None], space=Sphere(), source=name)


def _elliptical_sky(rng: np.random.Generator, position_deg: FloatArray, spread: FloatArray, name: str) -> Records:
    """Directions displaced by their quoted errors, with covariances along their own east and north."""
    stretch = rng.uniform(0, 0.8, len(spread))
    axes = rotations(rng.uniform(0, np.pi, len(spread)))
    axes *= (spread[:, None] * np.sqrt(np.stack([1 + stretch, 1 - stretch], axis=1)))[:, None, :]
    offset = np.einsum("nvw,nw->nv", axes, rng.standard_normal(position_deg.shape))
    features = displaced(position_deg, offset)
    axes = rotations(2.0 * half_convergence(*features.T, *position_deg.T)) @ axes
    covariance = axes @ axes.transpose(0, 2, 1)
    return Records.of(features, covariance=covariance, space=Sphere(), source=name)


# ---- of both ----


def _detected(rng: np.random.Generator, n: int, q1: float, q2: float) -> tuple[IntArray, IntArray]:
    """Numbers of the n objects that each source detects."""
    for name, q in (("q1", q1), ("q2", q2)):
        if not 0 <= q <= 1:
            raise InputError(f"{name} is {q}; give a probability between 0 and 1")
    return np.flatnonzero(rng.uniform(size=n) >= q1), np.flatnonzero(rng.uniform(size=n) >= q2)


def _log_uniform(rng: np.random.Generator, sigma: Sigma, n: int, name: str) -> FloatArray:
    """(n,) standard deviations: the given number, or log-uniform between two."""
    low, high = _bounds(sigma, name)
    return np.full(n, low) if low == high else low * (high / low) ** rng.uniform(size=n)


def _bounds(sigma: Sigma, name: str) -> tuple[float, float]:
    low, high = sigma if isinstance(sigma, tuple) else (sigma, sigma)
    if not 0 < low <= high < math.inf:
        raise InputError(f"{name}: sigma is {sigma}; give a positive number, or (low, high) with 0 < low ≤ high")
    return float(low), float(high)
