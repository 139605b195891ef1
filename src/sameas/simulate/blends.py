"""Blends: a source of low resolution that sees two close objects of a fine one as a single record."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import ABSENT, FloatArray, IntArray
from sameas.errors import InputError
from sameas.records import Records
from sameas.representation import in_short
from sameas.simulate.scenes import Cap
from sameas.space import Sphere, displaced


@in_short
@dataclass(frozen=True)
class BlendedField:
    """A coarse source, a fine one, and the objects of each coarse record.

    parts : (n₁, 2) records of the fine source, −1 (ABSENT) for none. flux : (n₂,) in the coarse source's band.
    """

    first: Records
    second: Records
    parts: IntArray
    flux: FloatArray
    resolution_arcsec: float


def blended_field(
    rng: np.random.Generator, *, objects: int = 4_000, per_deg2: float = 20_000.0, resolution_arcsec: float = 6.0
) -> BlendedField:
    """A field like WISE's on Gaia's: two objects at separation s are blended with probability 2^−(s/ℓ)⁴.

    The coarse source has 70 % of the objects and blends, and records of its own, one for ten objects of the fine
    source. Their errors on each axis are log-uniform from 0.1″ to 0.4″, those of the fine source 0.001″.

    Parameters
    ----------
    rng : source of all random numbers.
    objects, per_deg2 : number and density of objects of the fine source.
    resolution_arcsec : ℓ. Closer couples are blended first; an object is in one blend at most.

    Raises
    ------
    InputError : a number that is out of range.

    >>> made = blended_field(np.random.default_rng(1), objects=500)
    >>> made.parts.shape[1], bool((made.parts[:, 1] >= 0).any())
    (2, True)
    """
    if objects < 2 or not per_deg2 > 0.0 or not resolution_arcsec > 0.0:
        raise InputError(
            f"blended_field: {objects} objects, {per_deg2:g} per square degree, resolution {resolution_arcsec:g}; give "
            "two objects or more, and positive numbers"
        )
    area = objects / per_deg2
    field = Cap(150.0, 2.0, math.degrees(math.acos(1.0 - area * (math.pi / 180.0) ** 2 / (2.0 * math.pi))))
    place = field.draw(rng, objects)
    flux = 10.0 ** rng.normal(0.0, 0.5, objects)
    flat = np.column_stack([(place[:, 0] - 150.0) * np.cos(np.radians(place[:, 1])), place[:, 1]]) * 3600.0
    taken = np.zeros(objects, np.bool_)
    units: list[tuple[int, int]] = []
    couples = cKDTree(flat).query_pairs(1.75 * resolution_arcsec, output_type="ndarray")
    couples = np.take_along_axis(couples, np.argsort(flat[couples, 1], axis=1, kind="stable"), axis=1)
    apart = np.hypot(*(flat[couples[:, 1]] - flat[couples[:, 0]]).T)
    for at in np.argsort(apart, kind="stable"):
        (j, k), s = couples[at].tolist(), float(apart[at])
        if not taken[j] and not taken[k] and rng.uniform() < 2.0 ** -((s / resolution_arcsec) ** 4.0):
            taken[[j, k]] = True
            units.append((j, k))
    units += [(int(j), -1) for j in np.flatnonzero(~taken)]
    detected = np.array(units)[rng.uniform(size=len(units)) < 0.7]
    one, two = detected[:, 0], np.where(detected[:, 1] < 0, detected[:, 0], detected[:, 1])
    w = (flux[one] / (flux[one] + flux[two]))[:, None]
    offset = np.column_stack(
        [(place[two, 0] - place[one, 0]) * np.cos(np.radians(place[one, 1])), place[two, 1] - place[one, 1]]
    )
    more = round(0.1 * objects)
    places = np.concatenate([displaced(place[one], 3600.0 * (1.0 - w) * offset), field.draw(rng, more)])
    parts = np.concatenate([detected, np.full((more, 2), ABSENT)])
    sigma = np.exp(rng.uniform(math.log(0.1), math.log(0.4), len(places)))
    order = rng.permutation(len(places))
    measured = displaced(places, sigma[:, None] * rng.standard_normal(places.shape))
    first = Records.of(measured[order], sigma=sigma[order], space=Sphere(), source="coarse")
    fine = displaced(place, 1e-3 * rng.standard_normal(place.shape))
    second = Records.of(fine, sigma=1e-3, space=Sphere(), source="fine")
    return BlendedField(first, second, parts[order], flux, resolution_arcsec)
