"""Counterparts of few sources with wide errors in a deep catalogue: X-ray sources and optical objects."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.records import Records
from sameas.representation import in_short
from sameas.simulate.areas import Cap
from sameas.simulate.scenes import SimulatedScene
from sameas.space import Sphere, displaced

#: Error of the catalogue's positions per axis, arcsec.
CATALOGUE_SIGMA_ARCSEC = 0.1


@in_short
@dataclass(frozen=True)
class Counterparts:
    """Few sources, a deep catalogue, and what stands in the columns of both.

    scene : records and truth. flux : (n₁,) log₁₀ of the sources' fluxes, which counterparts' magnitudes go with.
    magnitude, colour : (n₂,) mag. kind : (n₂,) "point" or "extended". noise : (n₂,) a column that tells nothing.
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
    rng: np.random.Generator,
    *,
    sources: int = 1_500,
    records: int = 241_000,
    share: float = 0.9,
    chance: float = 0.3,
    sigma_arcsec: tuple[float, float] = (1.0, 2.0),
) -> Counterparts:
    """Sources of which a share has a counterpart, brighter and bluer than the catalogue's other records.

    Parameters
    ----------
    rng : source of all random numbers.
    sources, records : of the first and of the second source.
    share : of the sources that have a counterpart.
    chance : mean number of unrelated records within 3σ of a source.
    sigma_arcsec : error of a source per axis, log-uniform between; the records of the catalogue have 0.1″.

    Raises
    ------
    InputError : a number that is out of range.

    Source: the manner of NWAY's COSMOS example (X-ray sources with errors of 1–2″, the counterparts' magnitudes about
    21.5, the catalogue's counts rising as 10^(0.3 m) to 26).

    >>> made = counterparts(np.random.default_rng(1), sources=60, records=2_000)
    >>> len(made.scene.true_pairs()[0])
    54
    """
    if sources < 1 or records < sources or not 0.0 <= share <= 1.0 or not chance > 0.0:
        raise InputError(
            f"counterparts: {sources} sources, {records} records, share {share:g}, {chance:g} chance candidates; give "
            "positive numbers, and more records than sources"
        )
    low, high = sigma_arcsec
    square = 0.5 * (high**2 - low**2) / math.log(high / low) if high > low else low**2
    area = records * math.pi * 9.0 * square / chance
    radius_deg = math.degrees(2.0 * math.asin(math.sqrt(area / 3600.0**2 * (math.pi / 180.0) ** 2 / (4.0 * math.pi))))
    common = round(share * sources)
    objects = sources + records - common
    place = Cap(150.0, 2.0, radius_deg).draw(rng, objects)
    one, two = (
        rng.permutation(sources),
        rng.permutation(np.concatenate([np.arange(common), np.arange(sources, objects)])),
    )
    scene = SimulatedScene(
        _measured(rng, place[one], np.exp(rng.uniform(math.log(low), math.log(high), sources)), "xray"),
        _measured(rng, place[two], np.full(records, CATALOGUE_SIGMA_ARCSEC), "optical"),
        one, two, np.zeros(sources, np.bool_), np.zeros(records, np.bool_),
    )  # fmt: skip
    flux, bright = rng.normal(0.0, 0.6, objects), np.arange(objects) < sources
    # Counts that rise as 10^(0.3 m) to magnitude 26; those of sources follow their fluxes.
    counted = 26.0 + np.log10(rng.uniform(size=objects)) / 0.3
    magnitude = np.where(bright, 21.5 - 1.8 * flux + rng.normal(0.0, 1.3, objects), counted)
    colour = np.where(bright, 0.45, 0.9) + 0.06 * (magnitude - 22.0) + rng.normal(0.0, 0.4, objects)
    kind = np.where(rng.uniform(size=objects) < np.where(bright, 0.55, 0.25), "point", "extended")
    return Counterparts(scene, flux[one], magnitude[two], colour[two], kind[two], rng.normal(size=records), area)


def _measured(rng: np.random.Generator, place: FloatArray, sigma: FloatArray, name: str) -> Records:
    offset = sigma[:, None] * rng.standard_normal((len(place), 2))
    return Records.of(displaced(place, offset), sigma=sigma, space=Sphere(), source=name)
