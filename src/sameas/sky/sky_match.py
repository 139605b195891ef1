"""The result of a crossmatch of two catalogues, and the nearest neighbours for comparison."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.estimate.coverage import Coverage
from sameas.estimate.result import Estimate
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.systematics import Rotation, Warp
from sameas.space import ARCSEC_PER_RADIAN, sphere_offset, unit_vectors

ARCSEC2_PER_DEG2 = 3600.0**2


@in_short
@dataclass(frozen=True)
class Nearest:
    """The nearest neighbour of each record: the usual crossmatch, for comparison.

    rows : (n,) table row of the nearest record; separation_arcsec : (n,) its distance. Both are masked where there is
    none: in unusable rows, and if the other catalogue has no usable row.
    """

    rows: np.ma.MaskedArray[Any, np.dtype[np.int64]]
    separation_arcsec: np.ma.MaskedArray[Any, np.dtype[np.float64]]


def nearest(first: Records, second: Records) -> Nearest:
    """The nearest record of ``second`` to each record of ``first`` on the sphere; errors are ignored."""
    from scipy.spatial import cKDTree

    if not len(second):
        return _no_neighbours(len(first))
    distance, at = cKDTree(unit_vectors(*second.features.T)).query(unit_vectors(*first.features.T), workers=-1)
    separation = 2.0 * np.arcsin(np.minimum(distance / 2.0, 1.0)) * ARCSEC_PER_RADIAN
    return Nearest(np.ma.array(second.rows[at], mask=False), np.ma.array(separation, mask=False))


def _no_neighbours(n: int) -> Nearest:
    return Nearest(np.ma.array(np.zeros(n, np.int64), mask=True), np.ma.array(np.zeros(n), mask=True))


@in_short
@dataclass(frozen=True)
class SkyMatch:
    """Result of a crossmatch of two catalogues.

    epoch_jyr : common epoch, None if positions were not moved.
    moved : one sentence on which catalogue was moved and why. doubts : what looks wrong with the result.
    rotation : from the second catalogue onto the first; None if it was not searched for, or is not significant.
    warp : the smooth residual distortion after the rotation, also removed; None likewise.
    """

    first: Catalogue
    second: Catalogue
    epoch_jyr: float | None
    moved: str
    result: Identification
    estimate: Estimate
    doubts: tuple[str, ...]
    rotation: Rotation | None = None
    warp: Warp | None = None

    @cached_property
    def covered_1(self) -> BoolArray:
        """(n,) whether the second catalogue covers the position of each row of the first; True for unusable rows."""
        return self.result.first.over_table(self.estimate.coverage.covered[0])

    @cached_property
    def covered_2(self) -> BoolArray:
        """(n,) whether the first catalogue covers the position of each row of the second; True for unusable rows."""
        return self.result.second.over_table(self.estimate.coverage.covered[1])

    @cached_property
    def offsets_without_motion(self) -> FloatArray:
        """(k, 2) east and north offsets of the matched pairs, arcsec, each record at the epoch of its catalogue."""
        a, b = self.first.astrometry, self.second.astrometry
        i, j = self.result.matches.rows_1, self.result.matches.rows_2
        return sphere_offset(a.ra_deg[i], a.dec_deg[i], b.ra_deg[j], b.dec_deg[j])

    @cached_property
    def area_and_densities(self) -> tuple[float, float, float]:
        """Area covered by both catalogues, deg², and the mean density of each catalogue there, per deg²."""
        return area_and_densities(self.estimate.coverage)

    def nearest(self, moved: bool) -> Nearest:
        """The nearest record of the second catalogue to each row of the first table.

        moved : at the common epoch, or at the epochs of the catalogues.
        """
        one, two = self.result.first, self.result.second
        near = nearest(one, two) if moved else nearest(_unmoved(one, self.first), _unmoved(two, self.second))
        of_rows = _no_neighbours(one.n_table)
        of_rows.rows[one.rows], of_rows.separation_arcsec[one.rows] = near.rows, near.separation_arcsec
        return of_rows


def area_and_densities(coverage: Coverage) -> tuple[float, float, float]:
    """Area covered by both catalogues, deg², and the mean density of each catalogue there, per deg²."""
    area_deg2 = coverage.common_volume / ARCSEC2_PER_DEG2
    count_1, count_2 = (int(np.count_nonzero(covered)) for covered in coverage.covered)
    if not area_deg2 > 0.0:
        return 0.0, 0.0, 0.0
    return area_deg2, count_1 / area_deg2, count_2 / area_deg2


def _unmoved(records: Records, catalogue: Catalogue) -> Records:
    """The records at the positions of the catalogue's own epochs."""
    astrometry = catalogue.astrometry
    position = np.column_stack([astrometry.ra_deg, astrometry.dec_deg])[records.rows]
    return Records(position, records.covariance, records.rows, records.ids, records.space, records.source)
