"""Simulated catalogues that differ by more than their quoted errors, with known truth.

- :func:`formal_field`, :func:`growing_field`: quoted errors are formal, of the noise alone; there are others as well.
- :func:`couples_field`: more close pairs of objects than a Poisson field has.
- :func:`misquoted`, :func:`with_outliers`: a scene with errors quoted too small, or with records displaced by far more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray, IntArray
from sameas.records import Records
from sameas.simulate.scenes import LonLatBox, SimulatedScene
from sameas.space import Sphere, displaced


def formal_field(
    rng: np.random.Generator,
    objects: int,
    *,
    per_deg2: float = 2_000.0,
    quoted_arcsec: tuple[float, float] = (0.003, 0.2),
    scale: float = 1.0,
    floor_arcsec: float = 0.0,
    tail: tuple[float, float] = (0.0, 1.0),
    missing: tuple[float, float] = (0.1, 0.2),
    false_share: float = 0.1,
) -> SimulatedScene:
    """Two sources of a square field on the sky whose residuals have the covariance scale² (Σ₁ + Σ₂) + floor² 1.

    Parameters
    ----------
    rng : source of all random numbers.
    objects : number of real objects in the field.
    per_deg2 : real objects per square degree.
    quoted_arcsec : (low, high) quoted error of a record on each axis, log-uniform.
    scale : true over quoted errors. floor_arcsec : additional error of the second source on each axis, not quoted.
    tail : share of the objects whose errors are larger than those of the others, and by which factor.
    missing : probability that the first and the second source miss an object.
    false_share : false records of either source per object, uniformly scattered.

    Source: METHOD 6, "Error model".
    """
    share, wider = tail
    side_deg = math.sqrt(objects / per_deg2)
    field = LonLatBox((150.0, 150.0 + side_deg / math.cos(math.radians(20.0))), (20.0, 20.0 + side_deg))
    false = rng.poisson(false_share * objects, 2)
    place = field.draw(rng, objects + int(false.sum()))
    numbers = np.split(np.arange(objects, len(place)), [false[0]])
    # Without a tail no number is drawn for it: the fields are those of earlier versions.
    of_object = np.where(rng.uniform(size=len(place)) < share, wider, 1.0) if share else np.ones(len(place))
    sides, truths = [], []
    for source, (name, own) in enumerate((("first", 0.0), ("second", floor_arcsec))):
        detected = np.flatnonzero(rng.uniform(size=objects) >= missing[source])
        truth = rng.permutation(np.concatenate([detected, numbers[source]]))
        quoted = np.exp(rng.uniform(math.log(quoted_arcsec[0]), math.log(quoted_arcsec[1]), len(truth)))
        sigma = of_object[truth] * np.hypot(scale * quoted, own)
        sides.append(_measured_as(rng, place[truth], name, sigma, quoted))
        truths.append(truth)
    false_1, false_2 = (truth >= objects for truth in truths)
    return SimulatedScene(sides[0], sides[1], truths[0], truths[1], false_1, false_2)


def growing_field(
    rng: np.random.Generator,
    objects: int,
    error_arcsec: Callable[[FloatArray, FloatArray], FloatArray],
    *,
    quoted_arcsec: float = 0.1,
    chance: float = 1.0,
    missing: float = 0.15,
) -> tuple[SimulatedScene, tuple[FloatArray, FloatArray], FloatArray]:
    """Two sources of a crowded square that quote the same error for all records; the second source's errors grow.

    Parameters
    ----------
    rng : source of all random numbers.
    objects : number of real objects in the field.
    error_arcsec : function of magnitudes (n,) and of distances (n,) from the centre, relative to a corner's, that gives
        the true errors (n,) of the second source on each axis.
    quoted_arcsec : error quoted by both sources, the true one of the first.
    chance : mean number of other objects within 3σ of a pair with 1.5 times the quoted errors.
    missing : probability that a source misses an object.

    Returns
    -------
    The scene, the magnitudes of its records, and the true errors of the second source's records, arcsec.
    """
    per_arcsec2 = chance / (math.pi * (3.0 * 1.5 * math.sqrt(2.0) * quoted_arcsec) ** 2)
    side_deg = math.sqrt(objects / per_arcsec2) / 3600.0
    field = LonLatBox((150.0, 150.0 + side_deg), (-side_deg / 2.0, side_deg / 2.0))
    place = field.draw(rng, objects)
    magnitude = np.clip(22.0 - rng.exponential(1.5, objects), 12.0, 22.0)
    distance = np.hypot(place[:, 0] - 150.0 - side_deg / 2.0, place[:, 1]) / (side_deg / math.sqrt(2.0))
    sides, truths, magnitudes = [], [], []
    true = np.full(objects, quoted_arcsec), np.asarray(error_arcsec(magnitude, distance), np.float64)
    for name, sigma in zip(("first", "second"), true, strict=True):
        truth = rng.permutation(np.flatnonzero(rng.uniform(size=objects) >= missing))
        sides.append(_measured_as(rng, place[truth], name, sigma[truth], np.full(len(truth), quoted_arcsec)))
        truths.append(truth)
        magnitudes.append(magnitude[truth] + rng.normal(0.0, 0.05, len(truth)))
    return _scene_without_false(sides, truths), (magnitudes[0], magnitudes[1]), true[1][truths[1]]


def couples_field(
    rng: np.random.Generator,
    objects: int,
    *,
    share: float = 0.3,
    separation: float = 2.0,
    sigma_arcsec: tuple[float, float] = (0.1, 0.1),
    chance: float = 0.1,
    missing: float = 0.3,
    members: int = 2,
) -> SimulatedScene:
    """Two sources of a square with more close couples than a Poisson field; each source misses objects independently.

    Parameters
    ----------
    rng : source of all random numbers.
    objects : number of real objects in the field.
    share : of the objects that are in couples.
    separation : of a couple, in any direction, in standard errors of a record of the first source on each axis.
    sigma_arcsec : true and quoted error of the records of the first and of the second source on each axis.
    chance : mean number of other objects within 3σ of a pair, without companions.
    missing : probability that a source misses an object.
    members : of a couple; if more than two, the others are scattered about the first with ``separation`` as standard
        deviation on each axis.
    """
    per_arcsec2 = chance / (math.pi * 9.0 * (sigma_arcsec[0] ** 2 + sigma_arcsec[1] ** 2))
    side_deg = math.sqrt(objects / per_arcsec2) / 3600.0
    place = LonLatBox((150.0, 150.0 + side_deg), (-side_deg / 2.0, side_deg / 2.0)).draw(rng, objects)
    grouped = members * round(share * objects / members)
    first = np.arange(grouped) // members * members
    others = np.flatnonzero(first != np.arange(grouped))
    apart = rng.standard_normal((len(others), 2))
    if members == 2:
        apart /= np.hypot(*apart.T)[:, None]
    place[others] = displaced(place[first[others]], separation * sigma_arcsec[0] * apart)
    sides, truths = [], []
    for name, sigma in zip(("first", "second"), sigma_arcsec, strict=True):
        truth = rng.permutation(np.flatnonzero(rng.uniform(size=objects) >= missing))
        sides.append(_measured_as(rng, place[truth], name, sigma))
        truths.append(truth)
    return _scene_without_false(sides, truths)


def misquoted(scene: SimulatedScene, factor: float) -> SimulatedScene:
    """The scene with errors quoted ``factor`` times smaller than the true ones."""
    first, second = (replace(r, covariance=r.covariance / factor**2) for r in (scene.first, scene.second))
    return replace(scene, first=first, second=second)


def with_outliers(
    rng: np.random.Generator, scene: SimulatedScene, share: float, sigmas: float = 10.0
) -> SimulatedScene:
    """The scene with a share of either source's records displaced by ``sigmas`` of their σ in a random direction."""
    moved = []
    for records in (scene.first, scene.second):
        n = len(records)
        sigma = np.sqrt(0.5 * (records.covariance[:, 0] + records.covariance[:, -1]))
        far = np.where(rng.uniform(size=n) < share, sigmas * sigma, 0.0)
        angle = rng.uniform(0.0, 2.0 * np.pi, n)
        offset = far[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
        features = np.where(far[:, None] > 0.0, displaced(records.features, offset), records.features)
        moved.append(replace(records, features=features))
    return replace(scene, first=moved[0], second=moved[1])


def _measured_as(
    rng: np.random.Generator, place: FloatArray, name: str, sigma: ArrayLike, quoted: ArrayLike | None = None
) -> Records:
    """Records at these places with errors of 1σ ``sigma`` arcsec on each axis, which are quoted unless others are."""
    offset = np.reshape(sigma, (-1, 1)) * rng.standard_normal((len(place), 2))
    return Records.of(displaced(place, offset), sigma=sigma if quoted is None else quoted, space=Sphere(), source=name)


def _scene_without_false(sides: Sequence[Records], truths: Sequence[IntArray]) -> SimulatedScene:
    """The scene of two sources all of whose records are of real objects."""
    none = [np.zeros(len(truth), np.bool_) for truth in truths]
    return SimulatedScene(sides[0], sides[1], truths[0], truths[1], none[0], none[1])
