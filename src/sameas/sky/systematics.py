"""Systematic differences between two catalogues: the rotation between their frames, and a smooth local warp.

The rotation is estimated together with the crossmatch, and removed. Small fields are offset by a shift, whole skies by
a rotation about three axes; both are one rotation of the sphere, given here at a centre: a shift east and north there,
and a rotation about it. A shift of many errors is searched in a patch of the sky
(:func:`sameas.registration.register`); the rotation is then refined with all pairs, weighted by their probabilities,
until a step moves every record by less than a given fraction of its error.

After shift and rotation the second catalogue may still be distorted against the first (plates, drift scans). The
residuals of the matched pairs, weighted by their probabilities and by their errors with an estimated extra scatter, are
fitted by

    (east, north) = Σ_{a+b ≤ p} c_ab uᵃ vᵇ ,   (u, v): position on the tangent plane of the field, within ±1,

for every order p that the pairs determine. The lowest order whose leave-one-out likelihood is close to the best is
chosen; order 0, a shift alone, is no warp.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import FloatArray
from sameas.estimate.match import match
from sameas.estimate.quantity import Quantity
from sameas.evidence import Errors
from sameas.gaussian import inverse, mahalanobis_sq, propagated
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification
from sameas.sky.frame.plate import terms
from sameas.space import (
    ARCSEC_PER_RADIAN,
    directions_deg,
    displaced,
    local_axes,
    mean_direction,
    sphere_offset,
    to_plane,
    unit_vectors,
)

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from sameas.registration import Registration


# Parameters of the search for a rotation, all chosen.
PATCH_RECORDS = 800  # approximate number of records of either source in the searched patch
PATCH_DEG = 3.0  # maximum radius of the patch, degrees
PATCH_PLACES = 48  # number of centres that are tried
ITERATIONS = 8  # maximum number
CONVERGED_SHARE = 0.05  # maximum step at convergence, as a fraction of a record's error
MIN_P_PAIR = 0.01  # minimum probability of a pair that is used
MAX_PAIRS = 30_000  # more pairs are sampled regularly
#: A residual rotation is reported if it exceeds this many of its standard errors and moves a pair by more than this
#: fraction of its error.
SIGNIFICANT_SIGMAS, SIGNIFICANT_SHARE = 5.0, 0.3


@dataclass(frozen=True)
class Rotation:
    """A rotation of the sphere, of any size, from the second catalogue to the first.

    centre_deg : reference position. vector : (3,) shift east and north there, and rotation about it from north to east
    as seen from inside, arcsec. covariance : (3, 3) of the vector. established : whether no other rotation fits equally
    well. iterations : of the refinement. notes : doubts. by_chance : whether chance explains the data as well; the
    rotation is then not refined and must not be removed.
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
        """The shift and rotation to be added to the second catalogue at the centre."""
        each = (Quantity(float(v), float(e)) for v, e in zip(self.vector, self.standard_errors, strict=True))
        east, north, about = (str(one) if str(one).startswith("-") else f"+{one}" for one in each)
        lon, lat = self.centre_deg
        return f"{east} arcsec east, {north} north, rotated by {about} arcsec about RA {lon:.3f}°, Dec {lat:+.3f}°"

    def of(self, records: Records) -> Records:
        """The records rotated; their covariances include that of the rotation."""
        moved = self.moved(records.features)
        slope = self._slope(records.features)
        extra_covariance = propagated(slope, self.covariance)
        total = records.full_covariance() + extra_covariance
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
        # The step is computed separately, without cancellation; the new longitude is relative to the old meridian.
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
        """(n, 2, 3) derivatives of a record's east and north by each component of the vector."""
        axes = _axes(self.centre_deg)
        at, local = unit_vectors(*position_deg.T), local_axes(*np.radians(position_deg).T)
        moves = [np.cross(omega, at) for omega in (axes[1], -axes[0], axes[2])]
        return np.stack([np.stack([np.einsum("nv,nv->n", m, a) for m in moves], axis=1) for a in local], axis=1)

    def refined(self, answer: Identification, errors: Errors) -> tuple[Rotation, float]:
        """The rotation after one more step from the pairs of ``answer``, and the largest move in units of the error.

        errors : estimated ones.
        """
        use = np.flatnonzero(answer.p_pair > MIN_P_PAIR)
        use = use[:: -(-len(use) // MAX_PAIRS) or 1]
        pairs, p = answer.pairs, answer.p_pair[use]
        slope = self._slope(answer.second.features[pairs.j[use]])
        covariance = errors.typical_covariance(pairs, use)
        precision = inverse(covariance)
        weighted = np.einsum("mvw,mwk->mvk", precision, slope) * p[:, None, None]
        information = np.einsum("mvk,mvl->kl", weighted, slope) + np.diag([1e-12, 1e-12, 1e-12])
        step = np.linalg.solve(information, np.einsum("mvk,mv->k", weighted, pairs.residual[use]))
        shift = np.linalg.norm(np.einsum("mvk,k->mv", slope, step), axis=1)
        sigma = np.sqrt(0.5 * np.einsum("mvv->m", covariance))
        share = float(np.max(shift / sigma, initial=0.0))
        vector, covariance = self.vector + step, inverse(information)
        return replace(self, vector=vector, covariance=covariance, iterations=self.iterations + 1), share


def find_rotation(first: Records, second: Records, progress: Callable[[str], None] = lambda stage: None) -> Rotation:
    """The rotation from the records of the second catalogue to those of the first.

    first, second : records on the sphere, at one epoch. progress : called with the name of the current stage.

    Source: METHOD 6; the search as :func:`sameas.registration.register`.
    """
    from sameas.registration import Shift, register

    progress("search for the offset")
    centre, patch_1, patch_2 = _patch(first, second)
    if not (len(patch_1) and len(patch_2)):
        note = (
            f"{first.source} and {second.source} lie more than {PATCH_DEG:g}° apart; "
            "offsets are searched for in small fields only"
        )
        return Rotation(centre, np.zeros(3), np.zeros((3, 3)), False, 0, (note,), True)
    rotation = _initial(centre, register(patch_1, patch_2, Shift()))
    previous_share = math.inf
    while rotation.iterations < ITERATIONS and not rotation.by_chance:
        progress("offset")
        answer, estimate = match(first, rotation.of(second))
        rotation, share = rotation.refined(answer, estimate.errors)
        if share < CONVERGED_SHARE or share > 0.9 * previous_share:
            break
        previous_share = share
    return rotation


def residual_rotation(answer: Identification, errors: Errors) -> tuple[Rotation, float] | None:
    """A significant residual rotation of the pairs, and its largest shift in units of a pair's error; else None.

    With a rotation of many errors most true pairs are missed, and only part of it is seen here; :func:`find_rotation`
    finds all of it.
    """
    if not len(answer.p_pair):
        return None
    at = answer.second.features[:: -(-len(answer.second) // MAX_PAIRS)]
    lon, lat = directions_deg(mean_direction(unit_vectors(*at.T)))
    centre = float(lon), float(lat)
    rotation, share = Rotation(centre, np.zeros(3), np.zeros((3, 3))).refined(answer, errors)
    sigmas = float(np.sqrt(mahalanobis_sq(rotation.vector, rotation.covariance)))
    return (rotation, share) if share > SIGNIFICANT_SHARE and sigmas > SIGNIFICANT_SIGMAS else None


def _initial(centre: tuple[float, float], registration: Registration) -> Rotation:
    """The shift found in the patch, at its centre, without a rotation about it."""
    from sameas.registration.solution import DECISIVE

    covariance = np.zeros((3, 3))
    covariance[:2, :2] = registration.covariance
    vector = np.array([*registration.theta, 0.0])
    by_chance = registration.log_evidence < DECISIVE
    return Rotation(centre, vector, covariance, registration.established, 0, registration.notes, by_chance)


def _patch(first: Records, second: Records) -> tuple[tuple[float, float], Records, Records]:
    """A patch where both catalogues have enough records for the search: its centre, and the records there."""
    smaller = min(first, second, key=len)
    order = np.lexsort(smaller.features.T)
    centres = smaller.features[order[np.linspace(0, len(order) - 1, min(PATCH_PLACES, len(order))).astype(np.int64)]]
    trees = [_tree(records) for records in (first, second)]
    best: tuple[int, float, FloatArray] | None = None
    for radius_deg in PATCH_DEG / 2.0 ** np.arange(9.0, -1.0, -1.0):
        chord = 2.0 * math.sin(math.radians(radius_deg) / 2.0)
        counts = [tree.query_ball_point(unit_vectors(*centres.T), chord, return_length=True) for tree in trees]
        least_count = np.minimum(*counts)
        at = int(np.argmax(least_count))
        if best is None or least_count[at] > best[0]:
            best = int(least_count[at]), float(radius_deg), centres[at]
        if least_count[at] >= PATCH_RECORDS or max(c[at] for c in counts) > 8 * PATCH_RECORDS:
            break
    assert best is not None
    _, radius_deg, centre = best
    parts = [_within(records, centre, radius_deg) for records in (first, second)]
    return (float(centre[0]), float(centre[1])), parts[0], parts[1]


def _within(records: Records, centre: FloatArray, radius_deg: float) -> Records:
    """The records around a centre, on a sphere rotated to have it at the origin, far from the poles.

    Errors are replaced by circular ones of the same mean variance, sufficient for the search.
    """
    offset = sphere_offset(records.features[:, 0], records.features[:, 1], centre[0], centre[1])
    near = np.flatnonzero(np.hypot(*offset.T) <= radius_deg * 3600.0)
    x, y, z = (unit_vectors(*records.features[near].T) @ _axes((centre[0], centre[1])).T).T
    rotated = np.degrees(np.column_stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))]))
    variance = np.einsum("nvv->n", records.full_covariance()[near]) / 2.0
    return Records.of(rotated, variance=variance[:, None], space=records.space, source=records.source)


def _tree(records: Records) -> cKDTree:
    from scipy.spatial import cKDTree

    return cKDTree(unit_vectors(*records.features.T))


def _axes(centre_deg: tuple[float, float]) -> FloatArray:
    """(3, 3) unit vectors east, north and outward at the centre."""
    at = np.array([centre_deg])
    east, north = local_axes(*np.radians(at).T)
    return np.stack([east[0], north[0], unit_vectors(*at.T)[0]])


# Parameters of the fit of a warp, all chosen.
HIGHEST = 6  # maximum order
PAIRS_PER_TERM = 5.0  # minimum number of pairs per term of an order
WARP_MAX_PAIRS = 20_000  # more pairs are sampled regularly
MAX_RADIUS_DEG = 40.0  # maximum radius of a field
WARP_ITERATIONS = 6  # number of reweighted fits
TAIL_SIGMAS = 3.5  # larger residuals get a lower weight
MIN_GAIN = 10.0  # a higher order must lower the leave-one-out −2 ln L by more than this
WARP_PASSES = 3  # number of passes of crossmatch and fit


@in_short
@dataclass(frozen=True)
class Warp:
    """A smooth displacement of the second catalogue, to be added to its positions.

    centre : (3,) of the tangent plane. radius_arcsec : unit of u and v. order : of the polynomial.
    coefficients : (q, 2) arcsec, east and north. rms_arcsec, largest_arcsec : of the displacement at the pairs.
    gain : decrease of the leave-one-out −2 ln L against a shift alone. pairs : number used.
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
        # Outside the field the polynomial would diverge: its value at the edge is used.
        position = (to_plane(unit_vectors(*position_deg.T), self.centre) * ARCSEC_PER_RADIAN) / self.radius_arcsec
        position /= np.maximum(np.hypot(*position.T), 1.0)[:, None]
        return np.asarray(_basis(position, self.order) @ self.coefficients)

    def of(self, records: Records) -> Records:
        """The records of the second catalogue with the warp removed."""
        return replace(records, features=displaced(records.features, self.displacement(records.features)))

    @property
    def scale(self) -> float:
        """Mean relative change of scale."""
        return float(0.5 * (self.coefficients[1, 0] + self.coefficients[2, 1]) / self.radius_arcsec)

    @property
    def rotation_arcsec(self) -> float:
        """Mean rotation, arcsec, north through east."""
        turn = 0.5 * (self.coefficients[2, 0] - self.coefficients[1, 1]) / self.radius_arcsec
        return float(turn * ARCSEC_PER_RADIAN)

    def __str__(self) -> str:
        return (
            f"a smooth warp of order {self.order}, {self.rms_arcsec:.2g}″ rms and up to {self.largest_arcsec:.2g}″ "
            f"(scale {1e6 * self.scale:+.2g} parts in a million, turn {self.rotation_arcsec:+.2g}″), from "
            f"{self.pairs} pairs"
        )


def _basis(position: FloatArray, order: int) -> FloatArray:
    """(n, q) the terms uᵃ vᵇ of a polynomial at positions (n, 2)."""
    u, v = position.T
    return np.stack([u**a * v**b for a, b in terms(order)], axis=1)


def find_warp(result: Identification, before: Warp | None) -> Warp | None:
    """The warp of the second source from the matched pairs; None if a shift explains them as well.

    before : warp already applied to the second source; the total warp is returned.
    """
    pairs, used = result.pairs, np.flatnonzero(result.chosen)
    rows = used[:: max(1, -(-len(used) // WARP_MAX_PAIRS))]
    p, residual = result.p_pair[rows], pairs.residual[rows]
    if len(rows) < 3.0 * PAIRS_PER_TERM:
        return None
    position = pairs.second.features[pairs.j[rows]]
    if before is not None:
        residual = residual + before.displacement(position)
    vectors = unit_vectors(*position.T)
    centre = mean_direction(vectors)
    if float((vectors @ centre).min()) < math.cos(math.radians(MAX_RADIUS_DEG)):
        return None
    plane = to_plane(vectors, centre) * ARCSEC_PER_RADIAN
    radius = float(np.hypot(*plane.T).max())
    variance = np.sqrt(np.maximum(pairs.determinant[rows], 0.0))
    fits = {
        order: _fitted(_basis(plane / radius, order), residual, variance, p)
        for order in range(HIGHEST + 1)
        if len(rows) >= PAIRS_PER_TERM * (order + 1) * (order + 2) / 2
    }
    least = min(leave_one_out for _, leave_one_out in fits.values())
    order = min(order for order, (_, leave_one_out) in fits.items() if leave_one_out <= least + MIN_GAIN)
    if order == 0:
        return None
    coefficients, leave_one_out = fits[order]
    size = np.hypot(*(_basis(plane / radius, order) @ coefficients).T)
    rms, largest = float(np.sqrt(np.mean(size**2))), float(size.max())
    return Warp(centre, radius, order, coefficients, rms, largest, fits[0][1] - leave_one_out, len(rows))


def _fitted(basis: FloatArray, residual: FloatArray, variance: FloatArray, p: FloatArray) -> tuple[FloatArray, float]:
    """(q, 2) coefficients, and the leave-one-out −2 ln L of the residuals (n, 2).

    variance : (n,) of each pair's residual per axis by its errors; a common extra scatter is estimated.
    """
    extra_variance, tail_weight = 0.0, np.ones(len(p))
    for _ in range(WARP_ITERATIONS):
        weight = p * tail_weight / (variance + extra_variance)
        normal = (basis * weight[:, None]).T @ basis
        inverse = np.linalg.pinv(normal)
        coefficients = inverse @ (basis * weight[:, None]).T @ residual
        residual_sq = ((residual - basis @ coefficients) ** 2).sum(axis=1)
        freedom = max(2.0 * float(p.sum()) - 2.0 * basis.shape[1], 1.0)
        # The extra variance is the mean excess over the quoted variances, with outliers downweighted.
        extra_variance = max(
            float((p * tail_weight * residual_sq).sum()) / freedom - float((p * variance).sum() / p.sum()), 0.0
        )
        tail_weight = np.minimum(1.0, TAIL_SIGMAS**2 * (variance + extra_variance) / np.maximum(residual_sq, 1e-300))
    leverage = weight * np.einsum("nq,qr,nr->n", basis, inverse, basis)
    predicted_sq = residual_sq / np.maximum(1.0 - leverage, 1e-6) ** 2
    # Normal likelihood; beyond the tail limit the loss grows logarithmically.
    total = variance + extra_variance
    ratio = predicted_sq / total
    tail = TAIL_SIGMAS**2
    loss = np.where(ratio > tail, tail * (1.0 + np.log(np.maximum(ratio, tail) / tail)), ratio)
    return coefficients, float((p * (2.0 * np.log(total) + loss)).sum())
