"""Fixes: positions without a velocity, which measure where an object was when they were made.

A plot that is some seconds old says nothing of where a fast object is now, but for what is known of its velocity. As a
position now, with the error of any velocity, it draws the object back: aircraft were shown half a kilometre behind.
With x the state at the instant and a the age of the fix, z = H x + e, H = [I, −a I]. The moved state of a plot has the
covariance P = F diag(R, V) Fᵀ + Q, and e that of H P Hᵀ = R + H Q Hᵀ, whatever velocities V allows. Source: the
measurement update of a Kalman filter, Bar-Shalom, Li and Kirubarajan 2001, 5.2.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.gate import Pairs
from sameas.gaussian import Gaussian, determinant, mahalanobis_sq, propagated
from sameas.picture.tables import Scan
from sameas.tracks.alignment import transition


@dataclass(frozen=True)
class Fixes:
    """The plots of each object of an instant, (n, S), the newest first.

    only : (n,) whether the object has plots without a velocity, and nothing else. found, new : whether there is a fix,
    and a new one.
    age_s, place, covariance : (n, S), (n, S, 2), (n, S, 2, 2) of the fixes, 1 where there is none.
    begun, begun_covariance : (n, 4), (n, 4, 4) the state by the newest fix alone.
    """

    only: BoolArray
    found: BoolArray
    new: BoolArray
    age_s: FloatArray
    place: FloatArray
    covariance: FloatArray
    begun: FloatArray
    begun_covariance: FloatArray

    @classmethod
    def none(cls, n: int) -> Fixes:
        """No fix of n objects."""
        no, empty = np.zeros((n, 0), bool), np.empty((n, 0))
        return cls(np.zeros(n, bool), no, no, empty, empty[..., None], empty[..., None, None], empty, empty)

    @classmethod
    def of(cls, scan: Scan, members: IntArray, is_new: BoolArray) -> Fixes:
        """members : (n, S) records of the objects, ABSENT for none. is_new : (records,) whether the report is new."""
        is_fix, last = scan.placed & ~scan.moving, len(scan)  # of no record
        if not is_fix.any():
            return cls.none(len(members))
        is_fix, time_s = np.append(is_fix, True), np.append(scan.time_s, -np.inf)
        members = np.where(members >= 0, members, last)
        members = np.take_along_axis(members, np.argsort(-time_s[members], axis=1, kind="stable"), axis=1)
        only = is_fix[members].all(axis=1) & (members != last).any(axis=1)
        is_member = (members != last) & only[:, None]
        n, sources = members.shape
        age_s, place = np.ones((n, sources)), np.zeros((n, sources, 2))
        covariance = np.tile(np.eye(2), (n, sources, 1, 1))
        record = members[is_member]
        age_s[is_member] = scan.now.instant_s - scan.time_s[record]
        place[is_member] = scan.state[record, :2]
        moved = scan.covariance[record].copy()
        moved[:, :2, :2] -= scan.hull_covariance[record]
        covariance[is_member] = propagated(observed(age_s[is_member]), moved)
        begun, begun_covariance = np.zeros((n, 4)), np.tile(np.eye(4), (n, 1, 1))
        newest = members[only, :1].ravel()
        begun[only], begun_covariance[only] = scan.state[newest], scan.covariance[newest]
        begun_covariance[only, :2, :2] -= scan.hull_covariance[newest]
        new = is_member & np.append(is_new, False)[members]
        return cls(only, is_member, new, age_s, place, covariance, begun, begun_covariance)

    def updated(
        self, which: IntArray, state: FloatArray, covariance: FloatArray, extent: FloatArray | float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """The predicted states (k, 4) and covariances (k, 4, 4) of the objects ``which``, updated by their new fixes.

        extent : (k, 2, 2) added to the covariance of fixes.
        """
        state, covariance = state.copy(), covariance.copy()
        for column in range(self.new.shape[1]):
            at = np.flatnonzero(self.new[which, column])
            if not len(at):
                continue
            before = Gaussian(state[at], covariance[at])
            observe, innovation, total = self._observed(which[at], column, before)
            total = total + (extent[at] if isinstance(extent, np.ndarray) else extent)
            after = before.conditional(before.covariance @ np.swapaxes(observe, 1, 2), innovation, total)
            state[at], covariance[at] = after.mean, after.covariance
        return state, covariance

    def _observed(self, which: IntArray, column: int, objects: Gaussian) -> tuple[FloatArray, FloatArray, FloatArray]:
        """H (k, 2, 4), the fixes less those expected (k, 2), and the covariances of these differences (k, 2, 2), of the
        fixes in a column of the objects ``which`` with these predicted states."""
        observe = observed(self.age_s[which, column])
        innovation = self.place[which, column] - np.einsum("kab,kb->ka", observe, objects.mean)
        return observe, innovation, propagated(observe, objects.covariance) + self.covariance[which, column]

    def observed_in(self, pairs: Pairs, state: FloatArray, covariance: FloatArray) -> Pairs:
        """Pairs of objects with predicted states (k, 4), (k, 4, 4) and of these, with residuals at the newest fixes."""
        i, j = pairs.first.rows[pairs.i], pairs.second.rows[pairs.j]
        at = np.flatnonzero(self.only[j])
        if not len(at):
            return pairs
        _, innovation, total = self._observed(j[at], 0, Gaussian(state[i[at]], covariance[i[at]]))
        residual, chi_sq, size = pairs.residual.copy(), pairs.mahalanobis_sq.copy(), pairs.determinant.copy()
        residual[at], chi_sq[at], size[at] = -innovation, mahalanobis_sq(innovation, total), determinant(total)
        return replace(pairs, residual=residual, mahalanobis_sq=chi_sq, determinant=size)

    def started(self, which: IntArray) -> tuple[FloatArray, FloatArray]:
        """The states (k, 4) and covariances (k, 4, 4) of the objects ``which`` by their fixes alone."""
        others = self.found.copy()
        others[:, :1] = False
        return replace(self, new=others).updated(which, self.begun[which], self.begun_covariance[which])


def observed(age_s: FloatArray) -> FloatArray:
    """(n, 2, 4) the positions this long before the instant, as linear functions of the states at it."""
    return transition(-age_s)[:, :2]
