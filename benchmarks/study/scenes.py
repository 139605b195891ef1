"""Scenes of the study: many at once, in one feature space, with known truth.

A formation describes the positions of targets and the errors and misses of the sources; calling it draws scenes. Scenes
are so far apart that no gate joins two of them: groups never cross scenes, so one call for all of them gives the same
answers as one call per scene (tested), in less time. The unit is σ, the standard deviation of one feature of a residual
between the first two sources.

- :class:`Lattice`: the papers' targets in a line or on a grid (METHOD 8).
- :class:`Scatter`: a Poisson field in a box, the assumption of METHOD 4.3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.records import Records

#: Distance of neighbouring scenes in σ, beyond their own size; a power of two keeps coordinates exact.
FAR = 2.0**14
#: Two equal sources whose residuals have the standard deviation 1.
EQUAL = (math.sqrt(0.5), math.sqrt(0.5))
#: The same with errors of 3 to 1.
UNEQUAL = (math.sqrt(0.9), math.sqrt(0.1))


@dataclass(frozen=True)
class Scenes:
    """``count`` scenes: the records of the sources, the target of each record, and the positions of the targets.

    Attributes
    ----------
    sources : the records of every source, all scenes together.
    stride : distance from one scene to the next along the first feature.
    scene, truth : per source (n,) the scene of each record, and the number of its target.
    targets : (k, d) positions of the targets. target_scene : (k,) the scene of each.
    """

    count: int
    stride: float
    sources: tuple[Records, ...]
    scene: tuple[IntArray, ...]
    truth: tuple[IntArray, ...]
    targets: FloatArray
    target_scene: IntArray

    def __len__(self) -> int:
        return self.count

    @cached_property
    def sizes(self) -> IntArray:
        """(S, count) records of each source in each scene."""
        return np.stack([np.bincount(scene, minlength=self.count) for scene in self.scene])

    @property
    def open(self) -> np.ndarray:
        """(count,) whether at least two sources have a record, so that there is something to decide."""
        return np.count_nonzero(self.sizes, axis=0) >= 2

    def one(self, scene: int) -> tuple[tuple[IntArray, ...], tuple[Records, ...]]:
        """One scene alone, moved to the origin: per source the rows of its records, and the records."""
        rows = tuple(np.flatnonzero(k == scene) for k in self.scene)
        offset = np.zeros(self.targets.shape[1])
        offset[0] = scene * self.stride
        records = tuple(
            Records.of(s.features[k] - offset, variance=s.covariance[k], source=s.source)
            for s, k in zip(self.sources, rows, strict=True)
        )
        return rows, records

    def boxes(self, margin: float) -> FloatArray:
        """(count,) volume of the box around a scene's records, ``margin`` wider on each side; NaN without records."""
        d = self.targets.shape[1]
        low, high = np.full((self.count, d), np.inf), np.full((self.count, d), -np.inf)
        for records, scene in zip(self.sources, self.scene, strict=True):
            np.minimum.at(low, scene, records.features)
            np.maximum.at(high, scene, records.features)
        with np.errstate(invalid="ignore"):
            return np.prod(high - low + 2.0 * margin, axis=1)


class Formation(Protocol):
    """The parameters of scenes, which a point of the study varies."""

    @property
    def q(self) -> tuple[float, ...]:
        """Per source the probability that it misses a target."""

    @property
    def sigma(self) -> tuple[float, ...]:
        """Per source the standard deviation of its errors, in σ."""

    @property
    def d(self) -> int:
        """Number of features."""

    @property
    def spacing(self) -> float:
        """Distance of neighbours in σ."""

    @property
    def density(self) -> float:
        """Targets per unit volume around a target."""

    @property
    def targets(self) -> int:
        """Mean number of targets in a scene."""

    def __call__(self, rng: np.random.Generator, count: int) -> Scenes:
        """Draw scenes."""


@dataclass(frozen=True)
class Lattice:
    """Targets on a lattice: neighbours differ by ``spacing`` σ in one feature (METHOD 8 [T]).

    Parameters
    ----------
    shape : (d,) number of targets along every feature; (5, 1) is five in a line of two features.
    spacing : the papers' d, in units of σ.
    q : per source the probability that it misses a target.
    sigma : per source the standard deviation of its errors, in σ.
    """

    shape: tuple[int, ...]
    spacing: float
    q: tuple[float, ...] = (0.1, 0.1)
    sigma: tuple[float, ...] = EQUAL

    def __post_init__(self) -> None:
        _check(self.q, self.sigma)

    @property
    def d(self) -> int:
        return len(self.shape)

    @property
    def targets(self) -> int:
        """Number of targets in a scene."""
        return math.prod(self.shape)

    @property
    def density(self) -> float:
        """Targets per unit volume, one per lattice cell."""
        return self.spacing**-self.d

    @property
    def offsets(self) -> tuple[FloatArray, FloatArray]:
        """(k, d) displacements from a target to another, and their frequencies (k,), with sum 1."""
        steps = _steps(self.shape)
        offset = (steps[:, None] - steps[None]).reshape(-1, self.d)
        offsets, counts = np.unique(offset[np.any(offset != 0, axis=1)], axis=0, return_counts=True)
        return offsets * float(self.spacing), counts / counts.sum()

    def __call__(self, rng: np.random.Generator, count: int) -> Scenes:
        steps = _steps(self.shape)
        places = np.tile(steps * float(self.spacing), (count, 1))
        scene = np.repeat(np.arange(count), len(steps))
        return _observed(rng, places, scene, count, self.q, self.sigma, self.spacing * max(self.shape))


@dataclass(frozen=True)
class Scatter:
    """Targets evenly scattered in a box, ``density`` per unit volume.

    Parameters
    ----------
    density : targets per σ^d; ``mean`` : number of targets of a scene.
    numbers : "fixed" for exactly ``mean`` targets in every scene, "Poisson" for a Poisson number of them.
    q, sigma : as of :class:`Lattice`. d : number of features.
    """

    density: float
    mean: int
    q: tuple[float, ...] = (0.1, 0.1)
    sigma: tuple[float, ...] = EQUAL
    d: int = 2
    numbers: str = "Poisson"

    def __post_init__(self) -> None:
        _check(self.q, self.sigma)
        if self.numbers not in ("fixed", "Poisson"):
            raise InputError(f'Scatter: numbers is {self.numbers!r}; give "fixed" or "Poisson"')

    @property
    def spacing(self) -> float:
        """Edge of the mean volume per target, in σ."""
        return self.density ** (-1.0 / self.d)

    @property
    def side(self) -> float:
        """Length of the box's edges, in σ."""
        return self.spacing * self.mean ** (1.0 / self.d)

    @property
    def targets(self) -> int:
        """Mean number of targets in a scene."""
        return self.mean

    def __call__(self, rng: np.random.Generator, count: int) -> Scenes:
        numbers = rng.poisson(self.mean, count) if self.numbers == "Poisson" else np.full(count, self.mean)
        places = rng.uniform(0.0, self.side, (int(numbers.sum()), self.d))
        return _observed(rng, places, np.repeat(np.arange(count), numbers), count, self.q, self.sigma, self.side)


def _steps(shape: tuple[int, ...]) -> IntArray:
    """(k, d) the points of a lattice."""
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, len(shape))


def _observed(
    rng: np.random.Generator,
    places: FloatArray,
    scene: IntArray,
    count: int,
    q: tuple[float, ...],
    sigma: tuple[float, ...],
    extent: float,
) -> Scenes:
    """Scenes with targets at ``places`` (k, d) of ``scene`` (k,), each observed by every source."""
    stride = FAR * math.ceil(1.0 + extent / FAR)
    targets = places.copy()
    targets[:, 0] += scene * stride
    sources, scenes, truths = [], [], []
    for s, (missed, spread) in enumerate(zip(q, sigma, strict=True)):
        truth = rng.permutation(np.flatnonzero(rng.uniform(size=len(targets)) >= missed))
        features = targets[truth] + spread * rng.standard_normal((len(truth), targets.shape[1]))
        sources.append(Records.of(features, sigma=np.full(len(truth), spread), source=f"source {s + 1}"))
        scenes.append(scene[truth])
        truths.append(truth)
    return Scenes(count, stride, tuple(sources), tuple(scenes), tuple(truths), targets, scene)


def _check(q: tuple[float, ...], sigma: tuple[float, ...]) -> None:
    if len(q) < 2 or len(q) != len(sigma):
        raise InputError(f"a formation has {len(q)} q and {len(sigma)} sigma; give as many of both, one a source")
    if not (all(0.0 <= x < 1.0 for x in q) and all(x > 0.0 for x in sigma)):
        raise InputError(f"a formation has q {q} and sigma {sigma}; give probabilities below 1 and positive errors")
