"""Systematic differences between two catalogues: the rotation between their frames, and a smooth local warp.

The rotation is estimated together with the identification, and taken away. Small fields are offset by a shift, whole
skies by a rotation about three axes; both are one rotation of the sphere, stated here by what it does at a place: a
shift to the east and north there, and a rotation about it. A shift of many errors is searched for in a patch of the sky
(:func:`sameas.registration.register`); the rotation is then refined with all pairs, each weighted by its posterior,
until a step moves no record by a given part of its error.

After shift and rotation the second catalogue may still be distorted against the first: plates, drift scans. The
residuals of the identified pairs, each weighted by its probability and its errors with a scatter that is estimated, are
fitted by

    (east, north) = Σ_{a+b ≤ p} c_ab uᵃ vᵇ ,   (u, v): the place on the tangent plane of the field, within ±1,

for every order p that the pairs determine. The order is the lowest that predicts each residual from the others about as
well as the best (leave-one-out); order 0, a shift alone, is no warp. So a warp stands out from shift and from chance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.estimate.match import match
from sameas.gaussian import inverse, mahalanobis_sq, propagated
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification
from sameas.sky.frame.tangent import directions_deg, to_plane
from sameas.space import ARCSEC_PER_RADIAN, displaced, local_axes, mean_direction, sphere_offset, unit_vectors

if TYPE_CHECKING:
    from sameas.registration import Registration


@dataclass(frozen=True)
class RotationTuning:
    """Numbers of the search for a rotation, all chosen.

    Attributes
    ----------
    patch_records : either source has about this many records in the patch that is searched.
    patch_deg : largest radius of the patch, degrees. patch_places : places that are tried as its centre.
    iterations : at most. settled : the estimate has converged when a step moves no record by more than this part of its
        error.
    least_p_pair : pairs less probable than this are not used. most_pairs : of more pairs a regular sample is used.
    significant_sigmas, significant_share : a rotation that was not asked for is reported when it is larger than this
        many of its standard errors and moves a pair by more than this part of the pair's error.
    """

    patch_records: int = 800
    patch_deg: float = 3.0
    patch_places: int = 48
    iterations: int = 8
    settled: float = 0.05
    least_p_pair: float = 0.01
    most_pairs: int = 30_000
    significant_sigmas: float = 5.0
    significant_share: float = 0.3


TUNING = RotationTuning()


@dataclass(frozen=True)
class Rotation:
    """A rotation of the sphere, small or not, that brings the second catalogue onto the first.

    centre_deg : where the vector is given. vector : (3,) shift east and north there and rotation about it, from north
    to east seen from inside, arcsec. covariance : (3, 3) of it. established : whether nothing else explains the data as
    well. iterations : how many it took. notes : what is in doubt. by_chance : whether chance explains the data as well
    as a rotation; it is then not refined, and must not be taken away.
    """

    centre_deg: tuple[float, float]
    vector: FloatArray
    covariance: FloatArray
    established: bool = True
    iterations: int = 0
    notes: tuple[str, ...] = ()
    by_chance: bool = False

    @property
    def standard_errors(self) -> FloatArray:
        """(3,) arcsec."""
        return np.sqrt(np.diag(self.covariance))

    def __str__(self) -> str:
        """What is added to the second catalogue, at the centre."""
        east, north, about = (f"{v:+.4g} ± {e:.2g}" for v, e in zip(self.vector, self.standard_errors, strict=True))
        lon, lat = self.centre_deg
        return f"{east} arcsec east, {north} north, rotated by {about} arcsec about RA {lon:.3f}°, Dec {lat:+.3f}°"

    def of(self, records: Records) -> Records:
        """The records rotated; their covariances include that of the rotation."""
        moved = self.moved(records.features)
        slope = self._slope(records.features)
        more = propagated(slope, self.covariance)
        total = records.full_covariance() + more
        packed = np.ascontiguousarray(total[:, [0, 0, 1], [0, 1, 1]])
        return replace(records, features=moved, covariance=packed)

    def moved(self, position_deg: FloatArray) -> FloatArray:
        """(n, 2) the directions rotated (Rodrigues' formula)."""
        axes = _axes(self.centre_deg)
        shift_east, shift_north, about = self.vector / ARCSEC_PER_RADIAN
        omega = shift_east * axes[1] - shift_north * axes[0] + about * axes[2]
        angle = float(np.linalg.norm(omega))
        if angle == 0.0:
            return position_deg
        at = unit_vectors(*position_deg.T)
        k = omega / angle
        # The step is computed apart, which keeps its digits; the new longitude is relative to the old meridian.
        cross = np.cross(k, at)
        step = math.sin(angle) * cross + 2.0 * math.sin(angle / 2.0) ** 2 * np.cross(k, cross)
        east, north = local_axes(*np.radians(position_deg).T)
        lat = np.radians(position_deg[:, 1])
        up, right, above = (np.einsum("nv,nv->n", step, axis) for axis in (at, east, north))
        outward = np.cos(lat) * (1.0 + up) - np.sin(lat) * above
        lon = position_deg[:, 0] + np.degrees(np.arctan2(right, outward))
        z = np.sin(lat) * (1.0 + up) + np.cos(lat) * above
        return np.stack([lon % 360.0, np.degrees(np.arctan2(z, np.hypot(outward, right)))], axis=1)

    def _slope(self, position_deg: FloatArray) -> FloatArray:
        """(n, 2, 3) derivatives of a record's east and north by each component."""
        axes = _axes(self.centre_deg)
        at, local = unit_vectors(*position_deg.T), local_axes(*np.radians(position_deg).T)
        moves = [np.cross(omega, at) for omega in (axes[1], -axes[0], axes[2])]
        return np.stack([np.stack([np.einsum("nv,nv->n", m, a) for m in moves], axis=1) for a in local], axis=1)

    def refined(self, answer: Identification, scale: float, tuning: RotationTuning = TUNING) -> tuple[Rotation, float]:
        """The rotation after one more step, by the pairs of ``answer``, and by how many errors the step moves at most.

        scale : residuals over quoted errors.
        """
        use = np.flatnonzero(answer.p_pair > tuning.least_p_pair)
        use = use[:: -(-len(use) // tuning.most_pairs) or 1]
        pairs, p = answer.pairs, answer.p_pair[use]
        slope = self._slope(answer.second.features[pairs.j[use]])
        covariance = pairs.covariance_of(use)
        precision = inverse(covariance) / scale**2
        pull = np.einsum("mvw,mwk->mvk", precision, slope) * p[:, None, None]
        information = np.einsum("mvk,mvl->kl", pull, slope) + np.diag([1e-12, 1e-12, 1e-12])
        step = np.linalg.solve(information, np.einsum("mvk,mv->k", pull, pairs.residual[use]))
        moved = np.linalg.norm(np.einsum("mvk,k->mv", slope, step), axis=1)
        sigma = scale * np.sqrt(0.5 * np.einsum("mvv->m", covariance))
        share = float(np.max(moved / sigma, initial=0.0))
        vector, covariance = self.vector + step, inverse(information)
        return replace(self, vector=vector, covariance=covariance, iterations=self.iterations + 1), share


def find_rotation(
    first: Records,
    second: Records,
    progress: Callable[[str], None] = lambda stage: None,
    *,
    tuning: RotationTuning = TUNING,
) -> Rotation:
    """The rotation that brings the second catalogue's records onto the first's.

    Parameters
    ----------
    first, second : records on the sphere, at one epoch. progress : called with the name of what is being done.

    Source: METHOD 6; the search as :func:`sameas.registration.register`.
    """
    from sameas.registration import Shift, register

    progress("search for the offset")
    centre, patch_1, patch_2 = _patch(first, second, tuning)
    if not (len(patch_1) and len(patch_2)):
        apart = (
            f"{first.source} and {second.source} lie more than {tuning.patch_deg:g}° apart; "
            "offsets are searched for in small fields only"
        )
        return Rotation(centre, np.zeros(3), np.zeros((3, 3)), False, 0, (apart,), True)
    rotation = _initial(centre, register(patch_1, patch_2, Shift()))
    before = math.inf
    while rotation.iterations < tuning.iterations and not rotation.by_chance:
        progress("offset")
        answer, estimate = match(first, rotation.of(second))
        rotation, share = rotation.refined(answer, estimate.typical_scale, tuning)
        if share < tuning.settled or share > 0.9 * before:
            break
        before = share
    return rotation


def residual_rotation(
    answer: Identification, scale: float, tuning: RotationTuning = TUNING
) -> tuple[Rotation, float] | None:
    """The rotation that the pairs of an identification show beside their errors, and by how many of a pair's errors it
    moves one at most; None where it is not significant.

    A rotation of many errors hides its own pairs: only a part of it shows here, :func:`find_rotation` finds all of it.
    """
    if not len(answer.p_pair):
        return None
    at = answer.second.features[:: -(-len(answer.second) // tuning.most_pairs)]
    lon, lat = directions_deg(mean_direction(unit_vectors(*at.T)))
    centre = float(lon), float(lat)
    rotation, share = Rotation(centre, np.zeros(3), np.zeros((3, 3))).refined(answer, scale, tuning)
    sigmas = float(np.sqrt(mahalanobis_sq(rotation.vector, rotation.covariance)))
    return (rotation, share) if share > tuning.significant_share and sigmas > tuning.significant_sigmas else None


def _initial(centre: tuple[float, float], registration: Registration) -> Rotation:
    """The shift of the patch, at its centre; the rotation about it is not known yet."""
    from sameas.registration.hough import DEFAULT_TUNING as REGISTRATION_TUNING

    covariance = np.zeros((3, 3))
    covariance[:2, :2] = registration.covariance
    vector = np.array([*registration.theta, 0.0])
    by_chance = registration.log_evidence < REGISTRATION_TUNING.decisive
    return Rotation(centre, vector, covariance, registration.established, 0, registration.notes, by_chance)


def _patch(first: Records, second: Records, tuning: RotationTuning) -> tuple[tuple[float, float], Records, Records]:
    """Where both catalogues have enough records for the search: its centre, and the records there."""
    fewer = min(first, second, key=len)
    order = np.lexsort(fewer.features.T)
    places = fewer.features[
        order[np.linspace(0, len(order) - 1, min(tuning.patch_places, len(order))).astype(np.int64)]
    ]
    trees = [_tree(records) for records in (first, second)]
    best: tuple[int, float, FloatArray] | None = None
    for radius_deg in tuning.patch_deg / 2.0 ** np.arange(9.0, -1.0, -1.0):
        chord = 2.0 * math.sin(math.radians(radius_deg) / 2.0)
        counts = [tree.query_ball_point(unit_vectors(*places.T), chord, return_length=True) for tree in trees]
        poorer = np.minimum(*counts)
        at = int(np.argmax(poorer))
        if best is None or poorer[at] > best[0]:
            best = int(poorer[at]), float(radius_deg), places[at]
        if poorer[at] >= tuning.patch_records or max(c[at] for c in counts) > 8 * tuning.patch_records:
            break
    assert best is not None
    _, radius_deg, place = best
    parts = [_within(records, place, radius_deg) for records in (first, second)]
    return (float(place[0]), float(place[1])), parts[0], parts[1]


def _within(records: Records, place: FloatArray, radius_deg: float) -> Records:
    """The records near a place, on a sphere that is rotated to have it at its origin, far from the poles.

    Errors become circles of the same size: the search needs no more.
    """
    offset = sphere_offset(records.features[:, 0], records.features[:, 1], place[0], place[1])
    near = np.flatnonzero(np.hypot(*offset.T) <= radius_deg * 3600.0)
    x, y, z = (unit_vectors(*records.features[near].T) @ _axes((place[0], place[1])).T).T
    rotated = np.degrees(np.column_stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))]))
    variance = np.einsum("nvv->n", records.full_covariance()[near]) / 2.0
    return Records.of(rotated, variance=variance[:, None], space=records.space, source=records.source)


def _tree(records: Records) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(unit_vectors(*records.features.T))


def _axes(centre_deg: tuple[float, float]) -> FloatArray:
    """(3, 3) east, north and outward at the centre."""
    at = np.array([centre_deg])
    east, north = local_axes(*np.radians(at).T)
    return np.stack([east[0], north[0], unit_vectors(*at.T)[0]])


@dataclass(frozen=True)
class WarpTuning:
    """Numbers of the fit of a warp, all chosen.

    Attributes
    ----------
    highest : order that is tried. pairs_per_term : that an order needs at least.
    most_pairs : of more a regular sample is used. widest_deg : radius of a field that has a tangent plane.
    iterations : of fitting and weighing down. tail_sigmas : residuals beyond this count less.
    foretelling : a higher order must better −2 ln L of pairs foretold by the others by more than this.
    passes : of identification and fit.
    """

    highest: int = 6
    pairs_per_term: float = 5.0
    most_pairs: int = 20_000
    widest_deg: float = 40.0
    iterations: int = 6
    tail_sigmas: float = 3.5
    foretelling: float = 10.0
    passes: int = 3


WARP_TUNING = WarpTuning()


@in_short
@dataclass(frozen=True)
class Warp:
    """A smooth displacement of the second catalogue, to be added to its positions.

    Attributes
    ----------
    centre : (3,) of the tangent plane. radius_arcsec : that u and v are in units of. order : of the polynomial.
    coefficients : (q, 2) arcsec, east and north. rms_arcsec, largest_arcsec : of the displacement at the pairs.
    gain : by how much −2 ln L of pairs foretold by the others is better than with a shift alone. pairs : used.
    """

    centre: FloatArray
    radius_arcsec: float
    order: int
    coefficients: FloatArray
    rms_arcsec: float
    largest_arcsec: float
    gain: float
    pairs: int

    def displacement(self, position_deg: FloatArray) -> FloatArray:
        """(n, 2) arcsec east and north at positions (n, 2)."""
        # Beyond the field a polynomial runs away: it stays what it is at the edge.
        place = _places(position_deg, self.centre) / self.radius_arcsec
        place /= np.maximum(np.hypot(*place.T), 1.0)[:, None]
        return np.asarray(_basis(place, self.order) @ self.coefficients)

    def of(self, records: Records) -> Records:
        """The second catalogue's records, where they were without the warp."""
        return replace(records, features=displaced(records.features, self.displacement(records.features)))

    @property
    def scale(self) -> float:
        """Mean change of scale, in parts of one."""
        return float(0.5 * (self.coefficients[1, 0] + self.coefficients[2, 1]) / self.radius_arcsec)

    @property
    def turn_arcsec(self) -> float:
        """Mean turn, arcsec, north through east."""
        turn = 0.5 * (self.coefficients[2, 0] - self.coefficients[1, 1]) / self.radius_arcsec
        return float(turn * ARCSEC_PER_RADIAN)

    def __str__(self) -> str:
        return (
            f"a smooth warp of order {self.order}, {self.rms_arcsec:.2g}″ rms and up to {self.largest_arcsec:.2g}″ "
            f"(scale {1e6 * self.scale:+.2g} parts in a million, turn {self.turn_arcsec:+.2g}″), from "
            f"{self.pairs} pairs"
        )


def _places(position_deg: FloatArray, centre: FloatArray) -> FloatArray:
    return to_plane(unit_vectors(*position_deg.T), centre) * ARCSEC_PER_RADIAN


def _basis(place: FloatArray, order: int) -> FloatArray:
    u, v = place.T
    return np.stack([u ** (total - b) * v**b for total in range(order + 1) for b in range(total + 1)], axis=1)


def find_warp(result: Identification, before: Warp | None = None, tuning: WarpTuning = WARP_TUNING) -> Warp | None:
    """The warp of the second source that the identified pairs show; None where a shift and chance explain them as well.

    before : what was added to the second source's positions already; the whole warp is returned.
    """
    pairs, used = result.pairs, np.flatnonzero(result.chosen)
    rows = used[:: max(1, -(-len(used) // tuning.most_pairs))]
    p, residual = result.p_pair[rows], pairs.residual[rows]
    if len(rows) < 3.0 * tuning.pairs_per_term:
        return None
    position = pairs.second.features[pairs.j[rows]]
    if before is not None:
        residual = residual + before.displacement(position)
    vectors = unit_vectors(*position.T)
    centre = mean_direction(vectors)
    if float((vectors @ centre).min()) < math.cos(math.radians(tuning.widest_deg)):
        return None
    place = to_plane(vectors, centre) * ARCSEC_PER_RADIAN
    radius = float(np.hypot(*place.T).max())
    variance = np.sqrt(np.maximum(pairs.determinant[rows], 0.0))
    fits = {
        order: _fitted(_basis(place / radius, order), residual, variance, p, tuning)
        for order in range(tuning.highest + 1)
        if len(rows) >= tuning.pairs_per_term * (order + 1) * (order + 2) / 2
    }
    least = min(left_out for _, left_out in fits.values())
    order = min(order for order, (_, left_out) in fits.items() if left_out <= least + tuning.foretelling)
    if order == 0:
        return None
    coefficients, left_out = fits[order]
    size = np.hypot(*(_basis(place / radius, order) @ coefficients).T)
    rms, largest = float(np.sqrt(np.mean(size**2))), float(size.max())
    return Warp(centre, radius, order, coefficients, rms, largest, fits[0][1] - left_out, len(rows))


def _fitted(
    basis: FloatArray, residual: FloatArray, variance: FloatArray, p: FloatArray, tuning: WarpTuning
) -> tuple[FloatArray, float]:
    """(q, 2) coefficients, and −2 ln L of every residual (n, 2) by a fit to the others.

    variance : (n,) of each pair's residual per axis by its errors; a scatter common to all is estimated beside it.
    """
    more, down = 0.0, np.ones(len(p))
    for _ in range(tuning.iterations):
        weight = p * down / (variance + more)
        normal = (basis * weight[:, None]).T @ basis
        inverse = np.linalg.pinv(normal)
        coefficients = inverse @ (basis * weight[:, None]).T @ residual
        square = ((residual - basis @ coefficients) ** 2).sum(axis=1)
        freedom = max(2.0 * float(p.sum()) - 2.0 * basis.shape[1], 1.0)
        # Of normal errors the mean of what exceeds the quoted variances is the scatter; tails count less.
        more = max(float((p * down * square).sum()) / freedom - float((p * variance).sum() / p.sum()), 0.0)
        down = np.minimum(1.0, tuning.tail_sigmas**2 * (variance + more) / np.maximum(square, 1e-300))
    leverage = weight * np.einsum("nq,qr,nr->n", basis, inverse, basis)
    foretold = square / np.maximum(1.0 - leverage, 1e-6) ** 2
    # One common scale of the errors beside their model; what lies in the tail costs its logarithm.
    total = variance + more
    ratio = foretold / total
    tail = tuning.tail_sigmas**2
    loss = np.where(ratio > tail, tail * (1.0 + np.log(np.maximum(ratio, tail) / tail)), ratio)
    return coefficients, float((p * (2.0 * np.log(total) + loss)).sum())
