"""The turn between the frames of two catalogues: found together with the identification, and taken away.

Small fields stand off each other by a shift, whole skies by a rotation about three axes; both are one rotation of the
sphere, told here as what it does at a place: a shift to the east and north there, and a turn about it. A shift of many
errors is searched for in a patch of the sky (:func:`sameas.registration.register`); the turn is then refined with all
pairs, each weighed by its posterior, until it moves no record by a part of its error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.estimate.match import match
from sameas.records import Records
from sameas.registration import Registration, Shift, register
from sameas.registration.joint import DECISIVE
from sameas.result import Identification
from sameas.space import ARCSEC_PER_RADIAN, sphere_offset

#: Records of either source in the patch that is searched, about, and its largest radius.
PATCH_RECORDS, PATCH_DEG = 800, 3.0
#: Places that are looked at for the patch.
PLACES = 48
#: Rounds at most, and the part of a typical error of its own that a last step may move the catalogue by.
ROUNDS, SETTLED = 8, 0.05
#: Pairs less probable than this do not speak; of many, so many do.
UNLIKELY, MANY = 0.01, 30_000
#: A turn that nobody asked for is told from so many of its errors on, and where it moves a pair by so much of its own.
TOLD, MATTERS = 5.0, 0.3


@dataclass(frozen=True)
class Rotation:
    """A rotation of the sphere, small or not, that brings the second catalogue onto the first.

    centre_deg : where it is told. vector : (3,) shift east and north there and turn about it, from north to east
    seen from inside, arcsec. covariance : (3, 3) of it. found : whether nothing else explains the data as well.
    rounds : how many it took. notes : what is in doubt. by_chance : whether chance explains it as well as a turn does;
    it is then not refined, and nobody should take it away.
    """

    centre_deg: tuple[float, float]
    vector: FloatArray
    covariance: FloatArray
    found: bool = True
    rounds: int = 0
    notes: tuple[str, ...] = ()
    by_chance: bool = False

    @property
    def standard_errors(self) -> FloatArray:
        """(3,) arcsec."""
        return np.sqrt(np.diag(self.covariance))

    def __str__(self) -> str:
        """What is added to the second catalogue, where it is told."""
        east, north, turn = (f"{v:+.4g} ± {e:.2g}" for v, e in zip(self.vector, self.standard_errors, strict=True))
        lon, lat = self.centre_deg
        return f"{east} arcsec east, {north} north, turned by {turn} arcsec about RA {lon:.3f}°, Dec {lat:+.3f}°"

    def of(self, records: Records) -> Records:
        """The records turned; their covariances include what is not known of the turn."""
        moved = self.moved(records.features)
        slope = self._slope(records.features)
        more = slope @ self.covariance @ np.swapaxes(slope, 1, 2)
        total = records.full_covariance() + more
        packed = np.ascontiguousarray(total[:, [0, 0, 1], [0, 1, 1]])
        return replace(records, features=moved, covariance=packed)

    def moved(self, position_deg: FloatArray) -> FloatArray:
        """(n, 2) the directions turned (Rodrigues' formula)."""
        axes = _axes(self.centre_deg)
        shift_east, shift_north, turn = self.vector / ARCSEC_PER_RADIAN
        omega = shift_east * axes[1] - shift_north * axes[0] + turn * axes[2]
        angle = float(np.linalg.norm(omega))
        if angle == 0.0:
            return position_deg
        at = _vectors(position_deg)
        k = omega / angle
        # What is added is small and keeps its digits; the sum's direction is taken against the old meridian.
        cross = np.cross(k, at)
        step = math.sin(angle) * cross + 2.0 * math.sin(angle / 2.0) ** 2 * np.cross(k, cross)
        east, north = _local(position_deg)
        lat = np.radians(position_deg[:, 1])
        up, right, above = (np.einsum("nv,nv->n", step, axis) for axis in (at, east, north))
        outward = np.cos(lat) * (1.0 + up) - np.sin(lat) * above
        lon = position_deg[:, 0] + np.degrees(np.arctan2(right, outward))
        z = np.sin(lat) * (1.0 + up) + np.cos(lat) * above
        return np.stack([lon % 360.0, np.degrees(np.arctan2(z, np.hypot(outward, right)))], axis=1)

    def _slope(self, position_deg: FloatArray) -> FloatArray:
        """(n, 2, 3) what a unit of each component moves a record to its east and north."""
        axes = _axes(self.centre_deg)
        at, local = _vectors(position_deg), _local(position_deg)
        moves = [np.cross(omega, at) for omega in (axes[1], -axes[0], axes[2])]
        return np.stack([np.stack([np.einsum("nv,nv->n", m, a) for m in moves], axis=1) for a in local], axis=1)

    def refined(self, answer: Identification, scale: float) -> tuple[Rotation, float]:
        """The turn after one more step, by the pairs of ``answer``, and by how many typical errors the step moves.

        scale : by which residuals are larger than quoted.
        """
        use = np.flatnonzero(answer.p_pair > UNLIKELY)
        use = use[:: -(-len(use) // MANY) or 1]
        pairs, p = answer.pairs, answer.p_pair[use]
        slope = self._slope(answer.second.features[pairs.j[use]])
        covariance = pairs.covariance_of(use)
        precision = np.linalg.inv(covariance) / scale**2
        pull = np.einsum("mvw,mwk->mvk", precision, slope) * p[:, None, None]
        information = np.einsum("mvk,mvl->kl", pull, slope) + np.diag([1e-12, 1e-12, 1e-12])
        step = np.linalg.solve(information, np.einsum("mvk,mv->k", pull, pairs.residual[use]))
        moved = np.linalg.norm(np.einsum("mvk,k->mv", slope, step), axis=1)
        sigma = scale * np.sqrt(0.5 * np.einsum("mvv->m", covariance))
        share = float(np.max(moved / sigma, initial=0.0))
        turned = replace(self, vector=self.vector + step, covariance=np.linalg.inv(information), rounds=self.rounds + 1)
        return turned, share


def find_rotation(first: Records, second: Records, progress: Callable[[str], None] = lambda stage: None) -> Rotation:
    """The turn that brings the second catalogue's records onto the first's.

    Parameters
    ----------
    first, second : records on the sphere, at one epoch.

    Source: METHOD 6; the search as :func:`sameas.registration.register`.
    """
    progress("search for the offset")
    centre, patch_1, patch_2 = _patch(first, second)
    if not (len(patch_1) and len(patch_2)):
        apart = f"{first.source} and {second.source} lie more than {PATCH_DEG:g}° apart; so far no offset is looked for"
        return Rotation(centre, np.zeros(3), np.zeros((3, 3)), False, 0, (apart,), True)
    turn = _begun(centre, register(patch_1, patch_2, Shift()))
    before = math.inf
    while turn.rounds < ROUNDS and not turn.by_chance:
        progress("offset")
        answer, estimate = match(first, turn.of(second))
        turn, share = turn.refined(answer, estimate.typical_scale)
        if share < SETTLED or share > 0.9 * before:
            break
        before = share
    return turn


def left_over(answer: Identification, scale: float) -> tuple[Rotation, float] | None:
    """The turn that the pairs of an identification show beside their errors, and by how many of a pair's errors it
    moves one at most; None where it does not matter.

    A turn of many errors hides its own pairs: what is left of it is seen, and :func:`find_rotation` finds the rest.
    """
    if not len(answer.p_pair):
        return None
    at = answer.second.features[:: -(-len(answer.second) // MANY)]
    x, y, z = _vectors(at).mean(axis=0)
    centre = (float(np.degrees(np.arctan2(y, x)) % 360.0), float(np.degrees(np.arctan2(z, np.hypot(x, y)))))
    turn, share = Rotation(centre, np.zeros(3), np.zeros((3, 3))).refined(answer, scale)
    sure = float(np.sqrt(turn.vector @ np.linalg.solve(turn.covariance, turn.vector)))
    return (turn, share) if share > MATTERS and sure > TOLD else None


def _begun(centre: tuple[float, float], registration: Registration) -> Rotation:
    """The shift of the patch, told at its centre; the turn about it is not known yet."""
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = registration.covariance
    vector = np.array([*registration.theta, 0.0])
    by_chance = registration.log_evidence < DECISIVE
    return Rotation(centre, vector, covariance, registration.established, 0, registration.notes, by_chance)


def _patch(first: Records, second: Records) -> tuple[tuple[float, float], Records, Records]:
    """Where both catalogues have enough records for the search: its centre, and the records there."""
    fewer = min(first, second, key=len)
    order = np.lexsort(fewer.features.T)
    places = fewer.features[order[np.linspace(0, len(order) - 1, min(PLACES, len(order))).astype(np.int64)]]
    trees = [_tree(records) for records in (first, second)]
    best: tuple[int, float, FloatArray] | None = None
    for radius_deg in PATCH_DEG / 2.0 ** np.arange(9.0, -1.0, -1.0):
        chord = 2.0 * math.sin(math.radians(radius_deg) / 2.0)
        counts = [tree.query_ball_point(_vectors(places), chord, return_length=True) for tree in trees]
        poorer = np.minimum(*counts)
        at = int(np.argmax(poorer))
        if best is None or poorer[at] > best[0]:
            best = int(poorer[at]), float(radius_deg), places[at]
        if poorer[at] >= PATCH_RECORDS or max(c[at] for c in counts) > 8 * PATCH_RECORDS:
            break
    assert best is not None
    _, radius_deg, place = best
    parts = [_within(records, place, radius_deg) for records in (first, second)]
    return (float(place[0]), float(place[1])), parts[0], parts[1]


def _within(records: Records, place: FloatArray, radius_deg: float) -> Records:
    """The records near a place, on a sphere that is turned to have it at its origin, far from the poles.

    Errors become circles of the same size: the search needs no more.
    """
    offset = sphere_offset(records.features[:, 0], records.features[:, 1], place[0], place[1])
    near = np.flatnonzero(np.hypot(*offset.T) <= radius_deg * 3600.0)
    x, y, z = (_vectors(records.features[near]) @ _axes((place[0], place[1])).T).T
    turned = np.degrees(np.column_stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))]))
    variance = np.einsum("nvv->n", records.full_covariance()[near]) / 2.0
    return Records.of(turned, variance=variance[:, None], space=records.space, source=records.source)


def _tree(records: Records) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(_vectors(records.features))


def _vectors(position_deg: FloatArray) -> FloatArray:
    lon, lat = np.radians(position_deg).T
    return np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])


def _local(position_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3) unit vectors to the east and to the north of each direction."""
    lon, lat = np.radians(position_deg).T
    east = np.column_stack([-np.sin(lon), np.cos(lon), np.zeros(len(lon))])
    north = np.column_stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    return east, north


def _axes(centre_deg: tuple[float, float]) -> FloatArray:
    """(3, 3) east, north and outward at the centre."""
    at = np.array([centre_deg])
    east, north = _local(at)
    return np.stack([east[0], north[0], _vectors(at)[0]])
