"""Fields whose quoted errors are formal ones: of the noise alone, while the sources also err by what nobody quotes."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
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
    missing: tuple[float, float] = (0.1, 0.2),
    false_share: float = 0.1,
) -> SimulatedScene:
    """Two sources of a square field on the sky whose residuals have the covariance scale² (Σ₁ + Σ₂) + floor² 1.

    Parameters
    ----------
    rng : source of all random numbers.
    objects : number of real objects in the field.
    per_deg2 : real objects per square degree.
    quoted_arcsec : least and largest quoted error of a record per axis, log-uniform between, arcsec.
    scale : errors over those quoted. floor_arcsec : error of the second source that is not quoted, per axis, arcsec.
    missing : probability with which either source misses an object.
    false_share : false records of either source per object, scattered evenly.

    Raises
    ------
    InputError : a number that is out of range.

    Source: METHOD 11.1.

    >>> scene = formal_field(np.random.default_rng(1), 40, floor_arcsec=0.15)
    >>> len(scene.true_pairs()[0])
    26
    """
    if objects < 1 or not per_deg2 > 0.0 or not scale > 0.0 or not floor_arcsec >= 0.0 or not false_share >= 0.0:
        raise InputError(
            f"formal_field: {objects} objects, {per_deg2:g} per square degree, scale {scale:g}, floor "
            f"{floor_arcsec:g} arcsec, {false_share:g} false records per object; give positive numbers"
        )
    side_deg = math.sqrt(objects / per_deg2)
    field = LonLatBox((150.0, 150.0 + side_deg / math.cos(math.radians(20.0))), (20.0, 20.0 + side_deg))
    false = rng.poisson(false_share * objects, 2)
    place = field.draw(rng, objects + int(false.sum()))
    numbers = np.split(np.arange(objects, len(place)), [false[0]])
    sides, truths = [], []
    for source, (name, own) in enumerate((("first", 0.0), ("second", floor_arcsec))):
        seen = np.flatnonzero(rng.uniform(size=objects) >= missing[source])
        truth = rng.permutation(np.concatenate([seen, numbers[source]]))
        sides.append(_measured(rng, place[truth], quoted_arcsec, scale, own, name))
        truths.append(truth)
    false_1, false_2 = (truth >= objects for truth in truths)
    return SimulatedScene(sides[0], sides[1], truths[0], truths[1], false_1, false_2)


def _measured(
    rng: np.random.Generator, place: FloatArray, quoted: tuple[float, float], scale: float, floor: float, name: str
) -> Records:
    sigma = np.exp(rng.uniform(math.log(quoted[0]), math.log(quoted[1]), len(place)))
    offset = np.hypot(scale * sigma, floor)[:, None] * rng.standard_normal((len(place), 2))
    return Records.of(displaced(place, offset), sigma=sigma, space=Sphere(), source=name)
