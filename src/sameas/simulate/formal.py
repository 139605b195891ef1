"""Fields whose quoted errors are formal ones: of the noise alone, while the sources also err by what nobody quotes."""

from __future__ import annotations

import math
from collections.abc import Callable

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


def growing_field(
    rng: np.random.Generator,
    objects: int,
    error_arcsec: Callable[[FloatArray, FloatArray], FloatArray],
    *,
    quoted_arcsec: float = 0.1,
    chance: float = 1.0,
    missing: float = 0.15,
) -> tuple[SimulatedScene, tuple[FloatArray, FloatArray], FloatArray]:
    """Two sources of a crowded square that quote one error for all, which is that of the first; the second's grow.

    Parameters
    ----------
    rng : source of all random numbers.
    objects : number of real objects in the field.
    error_arcsec : (n,) errors of the second source per axis, of magnitudes (n,) and distances (n,) from the centre
        over that of a corner.
    quoted_arcsec : what both quote, and the error of the first.
    chance : other objects within 3σ of a pair with 1.5 times those errors, on average.
    missing : probability with which either source misses an object.

    Returns
    -------
    The scene, the magnitudes of its records, and the true errors of the second source's, arcsec.

    Raises
    ------
    InputError : a number that is out of range.

    >>> scene, (first, _), errors = growing_field(np.random.default_rng(1), 400, lambda m, r: 0.1 + 0.02 * (m - 12.0))
    >>> len(scene.first) == len(first), float(errors.min()) >= 0.1
    (True, True)
    """
    if objects < 1 or not quoted_arcsec > 0.0 or not chance > 0.0 or not 0.0 <= missing < 1.0:
        raise InputError(
            f"growing_field: {objects} objects, errors of {quoted_arcsec:g} arcsec, {chance:g} by chance, {missing:g} "
            "missed; give positive numbers"
        )
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
        measured = displaced(place[truth], sigma[truth, None] * rng.standard_normal((len(truth), 2)))
        sides.append(Records.of(measured, sigma=np.full(len(truth), quoted_arcsec), space=Sphere(), source=name))
        truths.append(truth)
        magnitudes.append(magnitude[truth] + rng.normal(0.0, 0.05, len(truth)))
    none = [np.zeros(len(truth), np.bool_) for truth in truths]
    scene = SimulatedScene(sides[0], sides[1], truths[0], truths[1], none[0], none[1])
    return scene, (magnitudes[0], magnitudes[1]), true[1][truths[1]]


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
    """Two sources of a square with more close couples than a Poisson field has; each misses objects by itself.

    Parameters
    ----------
    rng : source of all random numbers.
    objects : number of real objects in the field.
    share : of them that lie in couples.
    separation : of a couple, in standard errors of a record of the first source per axis, in any direction.
    sigma_arcsec : error of a record of either source per axis, quoted as it is.
    chance : other objects within 3σ of a pair, on average, beside companions.
    missing : probability with which either source misses an object.
    members : of a couple; where more than two, the others lie about the first with ``separation`` as their standard
        deviation per axis.

    Raises
    ------
    InputError : a number that is out of range.

    >>> scene = couples_field(np.random.default_rng(1), 400)
    >>> len(scene.first) < 400
    True
    """
    possible = objects >= 1 and 0.0 <= share <= 1.0 and separation >= 0.0 and 0.0 <= missing < 1.0 and members >= 2
    if not possible or not chance > 0.0 or not min(sigma_arcsec) > 0.0:
        raise InputError(
            f"couples_field: {objects} objects, a share of {share:g} in groups of {members} at {separation:g} errors, "
            f"errors of {sigma_arcsec[0]:g} and {sigma_arcsec[1]:g} arcsec, {chance:g} by chance, {missing:g} missed; "
            "give positive numbers, and shares between 0 and 1"
        )
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
        measured = displaced(place[truth], sigma * rng.standard_normal((len(truth), 2)))
        sides.append(Records.of(measured, sigma=sigma, space=Sphere(), source=name))
        truths.append(truth)
    none = [np.zeros(len(truth), np.bool_) for truth in truths]
    return SimulatedScene(sides[0], sides[1], truths[0], truths[1], none[0], none[1])


def _measured(
    rng: np.random.Generator, place: FloatArray, quoted: tuple[float, float], scale: float, floor: float, name: str
) -> Records:
    sigma = np.exp(rng.uniform(math.log(quoted[0]), math.log(quoted[1]), len(place)))
    offset = np.hypot(scale * sigma, floor)[:, None] * rng.standard_normal((len(place), 2))
    return Records.of(displaced(place, offset), sigma=sigma, space=Sphere(), source=name)
