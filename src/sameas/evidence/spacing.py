"""How far neighbours are: the boxes a and b of :class:`sameas.evidence.CloseObjects`, estimated from the data.

Whoever knows the formation of the targets knows b. Who does not can look at each source's own records: how far apart
nearest neighbours are, without what the source's errors add. A b much too small is harmful, for residuals between
the boxes and the true neighbours look impossible for two objects; one that is too large costs little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Sphere, sphere_offset, unit_vectors

#: The inner box in standard deviations of a residual's feature, as in the papers [T].
INNER_SIGMAS = 1.1
#: The least outer box, in the same unit: a few neighbours may look nearer than they are, and 4 σ is never too large.
LEAST_SIGMAS = 4.0
#: A given box is doubted where neighbours lie outside by more than this number of standard errors (chosen).
SURE = 2.0


@in_short
@dataclass(frozen=True)
class Spacing:
    """The distance of neighbours in the sources, per feature, in the unit of the residuals.

    Attributes
    ----------
    a : (d,) inner box: 1.1 σ of a typical residual [T], below which two objects look like one.
    b : (d,) outer box: twice the distance of a typical neighbour, and not below 4 σ.
    neighbour : (d,) distance of a typical neighbour that can lie along any feature: √(d · mean square), 0 where the
        errors explain all of it.
    error : (d,) standard error of ``neighbour``; infinite where that is 0.
    sigma : (d,) standard deviation of a typical residual.
    neighbours : number of pairs of nearest neighbours that this rests on, both sources together.
    """

    a: FloatArray
    b: FloatArray
    neighbour: FloatArray
    error: FloatArray
    sigma: FloatArray
    neighbours: int

    def doubt(self, b: ArrayLike) -> str:
        """A sentence where the data contradict a given ``b`` (a number or (d,)): neighbours lie outside; else ''."""
        given = np.broadcast_to(np.asarray(b, np.float64), self.b.shape)
        finite = np.isfinite(self.error)
        least = np.where(finite, self.neighbour - SURE * np.where(finite, self.error, 0.0), 0.0)
        # Residuals cannot show that neighbours nearer than the errors lie outside of any box.
        feature = int(np.argmax(least / np.maximum(given, self.sigma)))
        if least[feature] <= max(given[feature], self.sigma[feature]):
            return ""
        return (
            f"b is {given[feature]:.3g} in feature {feature}, but the sources' own neighbours lie "
            f"{self.neighbour[feature]:.3g} ± {self.error[feature]:.2g} apart there: true pairs and chance "
            f"pairs are confused; give b of {self.b[feature]:.3g} or more"
        )


def estimate_reach(first: Records, second: Records) -> Spacing:
    """The boxes of ``CloseObjects`` from the records of the sources themselves.

    Every record's displacement u to the nearest other record of its own source has the variance of both errors in
    addition to that of the objects; its mean square without them is that of neighbours. Where every neighbour differs
    in one feature only, as in the papers' scenes, each feature shows a share of them, of 1/d on a lattice: hence the
    factor d. Choosing the nearest of several makes displacements small, by up to a third on a lattice of spacing 4 σ;
    objects that a source missed make them large. Decisions with this b come within 0.02 of those with the true one.

    Raises
    ------
    InputError : neither source has two records.

    Example
    -------
    >>> from sameas import CloseObjects, Records
    >>> radar = Records.of([[0.0, 0.0], [5.0, 0.3], [10.1, -0.2]], sigma=0.5)
    >>> ais = Records.of([[0.2, 0.0], [9.8, 0.3]], sigma=0.3)
    >>> spacing = estimate_reach(radar, ais)
    >>> rule = CloseObjects(tuple(spacing.a), tuple(spacing.b))
    """
    sources = [source for source in (first, second) if len(source) >= 2]
    if not sources:
        raise InputError(
            f"{first.source} has {len(first)} records, {second.source} {len(second)}: no neighbours to measure; "
            "give b, the reach of a neighbour"
        )
    measured = [_excess(source) for source in sources]
    excess = np.concatenate([values for values, _ in measured])
    count = sum(pairs for _, pairs in measured)
    d = first.d
    mean_square = excess.mean(axis=0)
    # Two records that are each other's nearest are one pair, measured once.
    spread = excess.std(axis=0) / math.sqrt(max(count, 1))
    neighbour = np.sqrt(d * np.maximum(mean_square, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(neighbour > 0.0, 0.5 * d * spread / neighbour, np.inf)
    sigma = np.sqrt(sum(_typical_variance(source) for source in (first, second)))
    a = INNER_SIGMAS * sigma
    b = np.maximum(2.0 * neighbour, LEAST_SIGMAS * sigma)
    return Spacing(a, b, neighbour, error, sigma, count)


def _excess(source: Records) -> tuple[FloatArray, int]:
    """(n, d) squares of the displacements to the nearest other record, less the errors' share; number of pairs."""
    other = _nearest(source)
    variance = source.variances
    excess = _displacement(source, other) ** 2 - variance - variance[other]
    own = np.arange(len(source))
    mutual = int(np.count_nonzero(other[other] == own))
    return excess, len(source) - mutual // 2


def _typical_variance(source: Records) -> FloatArray:
    """(d,) typical variance of every feature; none of a source without records."""
    return np.broadcast_to(np.median(source.variances, axis=0) if len(source) else 0.0, (source.d,))


def _nearest(source: Records) -> IntArray:
    """(n,) the nearest other record of the same source, every feature in units of its typical error."""
    from scipy.spatial import cKDTree

    if isinstance(source.space, Sphere):
        points = unit_vectors(*source.features.T)
        tree = cKDTree(points)
    else:
        scale = np.sqrt(_typical_variance(source))
        periods = np.array(source.space.period_list(source.d)) / scale
        wraps = np.isfinite(periods)
        points = source.features / scale
        points[:, wraps] %= periods[wraps]
        tree = cKDTree(points, boxsize=np.where(wraps, periods, 0.0))
    place = np.arange(len(source))
    nearest = tree.query(points, k=2)[1]
    # Records on one spot may be listed in any order.
    return np.asarray(np.where(nearest[:, 0] == place, nearest[:, 1], nearest[:, 0]), np.int64)


def _displacement(source: Records, other: IntArray) -> FloatArray:
    """(n, d) from every record to ``other`` of the same source, in the unit of the residuals."""
    if isinstance(source.space, Sphere):
        return sphere_offset(*source.features[other].T, *source.features.T)
    delta = source.features[other] - source.features
    for v, period in enumerate(source.space.period_list(source.d)):
        if math.isfinite(period):
            delta[:, v] -= period * np.round(delta[:, v] / period)
    return delta
