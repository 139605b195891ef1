"""Hull echoes: several plots a scan of one ship, which are no further objects.

A radar shows a ferry of 200 m a kilometre away as several plots a scan, anywhere along her hull, and one record of a
source is of one object. The others are clutter that moves with her: as dense as those of the last looks were about her,
in her own frame. So a plot of an extended target is one of a Poisson number with a normal density about it (Gilholm and
Salmond 2005, IEE Proc. Radar 152, 364; the covariance as Koch 2008, IEEE Trans. AES 44, 1042), and a further object
must return at its own place more often than they do.

An object about which others are looked for is an *owner*: one with a name, or of two others the one confirmed first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import BoolArray, ColumnTable, FloatArray, IntArray, places_in, spans_in
from sameas.gate import ChiSquare
from sameas.gaussian import log_density, mahalanobis_sq
from sameas.picture.bernoulli import SAME_QUANTILE
from sameas.picture.tables import ObjectTable
from sameas.ragged import ranges

#: EM steps of the density of a hull beside that of an object at a place.
STEPS = 8
#: Added to densities that are divided by, per m².
MIN_DENSITY = 1e-300

OWN_LOOKS_KEPT = 24.0  # number of an object's last looks that count
CLUTTER_SIGMAS = 2.0  # the clutter about a plot is counted within so many 1σ of its position
HULL_M, HULL_PLOTS = 200.0, 3.0  # plots within this of an object with a name may be of its hull; how many show it


@dataclass(frozen=True)
class ScanPlots:
    """Plots of one scan of a source, (n,) each.

    place, covariance : (n, 2), (n, 2, 2). own : number of the object that has each, 0 for a new one.
    """

    place: FloatArray
    covariance: FloatArray
    own: IntArray


@dataclass(frozen=True)
class HullEchoes(ColumnTable):
    """The last plots of a source about owners, (m,) each, by owner.

    number : of the owner. is_own : whether the owner has the plot itself. look : of the source, counted from 1.
    offset, covariance : (m, 2), (m, 2, 2) of the plot from the owner. looks : of the source.
    """

    WHOLE = frozenset({"looks"})

    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    is_own: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    look: FloatArray = field(default_factory=lambda: np.empty(0))
    offset: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    looks: float = 0.0

    def after(self, share: float, owners: ObjectTable, plots: ScanPlots) -> HullEchoes:
        """With those of a look, of which a ``share`` was taken in; owners : at the look."""
        number, offset, covariance = _nearest_owner(plots, owners)
        is_own = plots.own == number
        near = np.flatnonzero((number > 0) & (is_own | ~np.isin(plots.own, owners.number)))
        looks = self.looks + share
        added = HullEchoes(number[near], is_own[near], np.full(len(near), looks), offset[near], covariance[near])
        echoes = replace(self, looks=looks).stacked(added)
        echoes = echoes.take(echoes.look > looks - OWN_LOOKS_KEPT)
        return echoes.take(np.argsort(echoes.number, kind="stable"))

    def per_m2(self, plots: ScanPlots, owners: ObjectTable) -> FloatArray:
        """(n,) density of the echoes of hulls at plots, per m² and look, besides the clutter there.

        Those at the place of a plot itself, as of a boat that keeps beside the owner, count as far as a normal density
        of the others has plots there. owners : predicted to the look.
        """
        density, _ = self._density(*_nearest_owner(plots, owners))
        return density / min(max(self.looks, 1.0), OWN_LOOKS_KEPT)

    def extent(self, plots: ScanPlots, owners: ObjectTable) -> FloatArray:
        """(n, 2, 2) mean square of the places about its owner that a plot which may be an echo of a hull can be of; 0
        for other plots. Arguments as of :meth:`per_m2`."""
        out = np.zeros((len(plots.place), 2, 2))
        number, offset, covariance = _nearest_owner(plots, owners)
        near = self.take(np.isin(self.number, number))
        if not len(near.number):
            return out
        _, share = near._density(near.number, near.offset, near.covariance)
        weight = np.where(near.is_own, 0.0, share)
        at, row = ranges(*spans_in(near.number, number))
        # The owner has the plot of the place at which it is.
        n = np.bincount(at, weight[row] + near.is_own[row], len(number))
        which = np.flatnonzero(np.bincount(at, weight[row], len(number)) >= HULL_PLOTS)
        square = weight[:, None, None] * near.offset[:, :, None] * near.offset[:, None, :]
        square = _summed(square[row], at, len(number))[which] / n[which, None, None]
        within = mahalanobis_sq(offset[which], square + covariance[which]) < ChiSquare(SAME_QUANTILE).limit(2)
        out[which[within]] = square[within]
        return out

    def _density(self, number: IntArray, offset: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) density at places about owners, per m², of all echoes of the hulls that are kept, and (n,) their share
        in it beside an object at the place itself.

        EM for the plots as a mixture of both, each normal: an object at the place, with the errors of plots, and a hull
        of unknown mean and covariance; at first of the plots that are not at the place.
        """
        density, share = np.zeros((2, len(number)))
        at, row = ranges(*spans_in(self.number, number))
        echo = np.flatnonzero(~self.is_own[row])
        at, row = at[echo], row[echo]
        errors = self.covariance[row] + covariance[at]
        here = mahalanobis_sq(self.offset[row] - offset[at], errors) < CLUTTER_SIGMAS**2
        enough = np.bincount(at, ~here, len(number)) >= HULL_PLOTS
        kept = enough[at]
        at, row, errors, p_hull = at[kept], row[kept], errors[kept], (~here[kept]).astype(np.float64)
        if not len(at):
            return density, share
        which, at = np.unique(at, return_inverse=True)
        apart, total = self.offset[row] - offset[which[at]], np.bincount(at).astype(np.float64)
        own = np.exp(log_density(apart, errors))
        for _ in range(STEPS):
            n = np.bincount(at, p_hull)
            mean = _summed(p_hull[:, None] * apart, at, len(which)) / n[:, None]
            off = apart - mean[at]
            spread = _summed(p_hull[:, None, None] * off[:, :, None] * off[:, None, :], at, len(which))
            spread = spread / n[:, None, None] + covariance[which]
            of_hull = n[at] * np.exp(log_density(off, spread[at]))
            p_hull = of_hull / (of_hull + (total - n)[at] * own + MIN_DENSITY)
        density[which] = n * np.exp(log_density(mean, spread))
        at_place = (total - n) * np.exp(log_density(np.zeros((len(which), 2)), 2.0 * covariance[which]))
        share[which] = density[which] / (density[which] + at_place)
        return density, share


def _nearest_owner(plots: ScanPlots, owners: ObjectTable) -> tuple[IntArray, FloatArray, FloatArray]:
    """(m,) the number of the nearest owner within ``HULL_M`` of each plot, 0 for none, and (m, 2), (m, 2, 2) the place
    from it with its covariance."""
    if not len(owners) or not len(plots.place):
        return np.zeros(len(plots.place), np.int64), np.zeros((len(plots.place), 2)), plots.covariance
    distance, row = cKDTree(owners.state[:, :2]).query(plots.place)
    number = np.where(distance <= HULL_M, owners.number[row], 0)
    return number, plots.place - owners.state[row, :2], plots.covariance + owners.covariance[row, :2, :2]


def _summed(values: FloatArray, group: IntArray, n: int) -> FloatArray:
    """(n, …) sums of values (m, …) by group."""
    out = np.zeros((n, *values.shape[1:]))
    np.add.at(out, group, values)
    return out


def owners_among(place: FloatArray, is_sure: BoolArray) -> BoolArray:
    """(k,) which of confirmed objects, those confirmed first before others, own the echoes about them.

    place : (k, 2) of these. is_sure : (k,) whether an object has a name. The others are owners where none before them
    is within ``HULL_M``.

    >>> owners_among(np.array([[0.0, 0.0], [90.0, 0.0], [250.0, 0.0]]), np.zeros(3, bool)).tolist()
    [True, False, True]
    """
    out = is_sure.copy()
    if is_sure.all():
        return out
    neighbours = cKDTree(place).query_ball_point(place[~is_sure], HULL_M)
    for k, near in zip(np.flatnonzero(~is_sure).tolist(), neighbours, strict=True):
        out[k] = not out[near].any()
    return out


@dataclass(frozen=True)
class Hulls:
    """The owners at a look, predicted to it, and the echoes about them by name of the source."""

    owners: ObjectTable = field(default_factory=ObjectTable)
    echoes: Mapping[str, HullEchoes] = field(default_factory=dict)

    def per_m2(self, source: str, plots: ScanPlots) -> FloatArray:
        """(n,) density of the echoes at plots of a source, as of :meth:`HullEchoes.per_m2`; 0 for those of owners."""
        if source not in self.echoes:
            return np.zeros(len(plots.own))
        density = self.echoes[source].per_m2(plots, self.owners)
        return np.where(np.isin(plots.own, self.owners.number), 0.0, density)

    def extent(self, source: str, plots: ScanPlots) -> FloatArray:
        """(n, 2, 2) of plots of a source, as of :meth:`HullEchoes.extent`."""
        if source not in self.echoes:
            return np.zeros((len(plots.own), 2, 2))
        return self.echoes[source].extent(plots, self.owners)

    def of_objects(self, number: IntArray) -> FloatArray:
        """(k, 2, 2) the largest extent by any source of the hulls of objects with these numbers; 0 without one."""
        out, rows = np.zeros((len(number), 2, 2)), np.flatnonzero(np.isin(number, self.owners.number))
        if not len(rows):
            return out
        owner = places_in(self.owners.number, number[rows])
        plots = ScanPlots(self.owners.state[owner, :2], self.owners.covariance[owner, :2, :2], number[rows])
        for source in self.echoes:
            extent = self.extent(source, plots)
            larger = np.trace(extent, axis1=1, axis2=2) > np.trace(out[rows], axis1=1, axis2=2)
            out[rows[larger]] = extent[larger]
        return out
