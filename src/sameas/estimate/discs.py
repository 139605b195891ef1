"""Fields that are discs around the records of one source: the other was queried within a radius around each of them.

Such discs (cone searches around a list of targets) may hold two or three records each, and fill a millionth of the sky
that the list spans. Cells find a density from four records on, so they would take the sky between the discs for a part
of the field, its density for that of chance, and every neighbour for the partner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.representation import in_short
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

#: Records whose nearest centres are found first, since few fields are discs; and the number of centres above which none
#: are looked for.
SOME, MOST_CENTRES = 16, 200_000
#: Discs must fill at most this fraction of the region of all records.
FULL = 0.25
#: Least number of records in the outer half of the discs, and in the outer half per record in the quarter of the area
#: next to it: in discs 2, around partners alone (residuals of any distribution that falls outwards) less than 1.
OUTER, FLAT = 8, 1.2
#: Least number of records that have the same nearest centre as another, per record in the outer half. Two catalogues of
#: the same objects with a shift or a rotation between them fill discs as well, but with one record each.
REPEATED = 0.5
#: Most pairs of a centre and a record for finding the nearest centres without a tree, whose import takes longer; 2 SOME
#: records, which are the most that are looked at first, stay below it.
FEW_PAIRS = 8_000_000
#: Points per disc at which the number of discs that overlap is counted.
POINTS = 64


@in_short
@dataclass(frozen=True)
class Discs:
    """Discs around the records of one source that hold all records of the other.

    centres : source (1 or 2) that has the centres. radius : in arcsec. nearest : (m,) centre nearest to each record of
    the other source. area : (n,) of each disc in square arcsec, with its share of what overlapping discs have in
    common.
    """

    centres: int
    radius: float
    nearest: IntArray
    area: FloatArray

    @classmethod
    def of(cls, positions: tuple[FloatArray, FloatArray], region: float) -> Discs | None:
        """The discs of two sources on the sphere, or None if their fields are something else.

        positions : (n₁, 2), (n₂, 2) longitude and latitude in degrees. region : area of the region of all records.
        """
        for centres, others in ((0, 1), (1, 0)):
            found = _around(positions[centres], positions[others], FULL * region)
            if found is not None:
                return cls(centres + 1, *found)
        return None


def _around(centres: FloatArray, others: FloatArray, most: float) -> tuple[float, IntArray, FloatArray] | None:
    """Radius, nearest centres and areas of discs of at most this total area; None if ``others`` fill no discs."""
    if len(centres) > MOST_CENTRES or len(others) < OUTER:
        return None
    ground = unit_vectors(*centres.T)
    some = unit_vectors(*others[:: max(1, len(others) // SOME)].T)
    least = float(_nearest(ground, some)[0].max()) * ARCSEC_PER_RADIAN
    # Discs that overlap at most by half.
    if 0.5 * len(centres) * math.pi * least**2 > most:
        return None
    chord, of = _nearest(ground, unit_vectors(*others.T))
    # The outermost of n records lies at about 1 − 1/2n of the radius.
    reach = float(chord.max()) * (1.0 + 0.5 / len(others))
    outer = int(np.count_nonzero(chord > reach * math.sqrt(0.5)))
    next_to_it = int(np.count_nonzero(chord > 0.5 * reach)) - outer
    if outer < OUTER or outer < FLAT * next_to_it or len(of) - len(np.unique(of)) < REPEATED * outer:
        return None
    from scipy.spatial import cKDTree

    tree = cKDTree(ground)
    # A sunflower: POINTS points that share the area of a disc evenly.
    k = np.arange(POINTS) + 0.5
    at, angle = reach * np.sqrt(k / POINTS), k * math.pi * (3.0 - math.sqrt(5.0))
    pole = np.eye(3)[np.argmin(np.abs(ground), axis=1)]
    east = np.cross(ground, pole)
    east /= np.linalg.norm(east, axis=1)[:, None]
    north = np.cross(ground, east)
    share = np.zeros(len(ground))
    for x, y in zip(at * np.cos(angle), at * np.sin(angle), strict=True):
        share += 1.0 / np.maximum(tree.query_ball_point(ground + x * east + y * north, reach, return_length=True), 1)
    radius = reach * ARCSEC_PER_RADIAN
    area = math.pi * radius**2 * share / POINTS
    return None if area.sum() > most else (radius, np.asarray(of, np.int64), area)


def _nearest(centres: FloatArray, others: FloatArray) -> tuple[FloatArray, IntArray]:
    """(m,) distance to the nearest of ``centres`` (n, 3) and its index, for ``others`` (m, 3); unit vectors."""
    if len(centres) * len(others) > FEW_PAIRS:
        from scipy.spatial import cKDTree

        distance, index = cKDTree(centres).query(others)
        return distance, index
    index = np.argmax(others @ centres.T, axis=1)
    return np.linalg.norm(others - centres[index], axis=1), index
