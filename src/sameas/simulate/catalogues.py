"""Simulated catalogues with known truth: few sources with large errors in a deep catalogue."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.records import Records
from sameas.representation import in_short
from sameas.simulate.scenes import Cap, SimulatedScene
from sameas.space import Sphere, displaced

#: Least and largest error of the sources of :func:`counterparts` on each axis, and that of their catalogue, arcsec.
SIGMA_ARCSEC, CATALOGUE_SIGMA_ARCSEC = (1.0, 2.0), 0.1


@in_short
@dataclass(frozen=True)
class Counterparts:
    """Few sources, a deep catalogue, and the columns of both.

    scene : records and truth. flux : (n₁,) log₁₀ of the sources' fluxes, correlated with the counterparts' magnitudes.
    magnitude, colour : (n₂,) mag. kind : (n₂,) "point" or "extended". noise : (n₂,) a column without information.
    area_arcsec2 : of the field.
    """

    scene: SimulatedScene
    flux: FloatArray
    magnitude: FloatArray
    colour: FloatArray
    kind: np.ndarray
    noise: FloatArray
    area_arcsec2: float


def counterparts(
    rng: np.random.Generator, *, sources: int = 1_500, records: int = 241_000, chance: float = 0.3
) -> Counterparts:
    """Sources of which 90 % have a counterpart, brighter and bluer than the catalogue's other records.

    The error of a source on each axis is log-uniform from 1″ to 2″, that of the catalogue 0.1″.

    Parameters
    ----------
    rng : source of all random numbers.
    sources, records : numbers of records of the first and of the second source.
    chance : mean number of unrelated records within 3σ of a source.

    Raises
    ------
    InputError : a number that is out of range.

    Source: modelled on NWAY's COSMOS example (X-ray sources with errors of 1–2″, counterparts' magnitudes about 21.5,
    counts of the catalogue rising as 10^(0.3 m) to 26).

    >>> made = counterparts(np.random.default_rng(1), sources=60, records=2_000)
    >>> len(made.scene.true_pairs()[0])
    54
    """
    if sources < 1 or records < sources or not chance > 0.0:
        raise InputError(
            f"counterparts: {sources} sources, {records} records, {chance:g} chance candidates; give positive numbers, "
            "and more records than sources"
        )
    low, high = SIGMA_ARCSEC
    square = 0.5 * (high**2 - low**2) / math.log(high / low)
    area = records * math.pi * 9.0 * square / chance
    radius_deg = math.degrees(2.0 * math.asin(math.sqrt(area / 3600.0**2 * (math.pi / 180.0) ** 2 / (4.0 * math.pi))))
    common = round(0.9 * sources)
    objects = sources + records - common
    place = Cap(150.0, 2.0, radius_deg).draw(rng, objects)
    one = rng.permutation(sources)
    two = rng.permutation(np.concatenate([np.arange(common), np.arange(sources, objects)]))
    sigma = np.exp(rng.uniform(math.log(low), math.log(high), sources))
    xray = _measured_as(rng, place[one], "xray", sigma)
    optical = _measured_as(rng, place[two], "optical", np.full(records, CATALOGUE_SIGMA_ARCSEC))
    scene = SimulatedScene(xray, optical, one, two, np.zeros(sources, np.bool_), np.zeros(records, np.bool_))
    flux, bright = rng.normal(0.0, 0.6, objects), np.arange(objects) < sources
    # Counts rise as 10^(0.3 m) to magnitude 26; the sources' magnitudes follow their fluxes.
    counted = 26.0 + np.log10(rng.uniform(size=objects)) / 0.3
    magnitude = np.where(bright, 21.5 - 1.8 * flux + rng.normal(0.0, 1.3, objects), counted)
    colour = np.where(bright, 0.45, 0.9) + 0.06 * (magnitude - 22.0) + rng.normal(0.0, 0.4, objects)
    kind = np.where(rng.uniform(size=objects) < np.where(bright, 0.55, 0.25), "point", "extended")
    return Counterparts(scene, flux[one], magnitude[two], colour[two], kind[two], rng.normal(size=records), area)


def _measured_as(rng: np.random.Generator, place: FloatArray, name: str, sigma: FloatArray) -> Records:
    """Records at these places with errors of 1σ ``sigma`` (n,) arcsec on each axis."""
    offset = sigma[:, None] * rng.standard_normal((len(place), 2))
    return Records.of(displaced(place, offset), sigma=sigma, space=Sphere(), source=name)
