"""A smooth local warp between two catalogues: plates, drift scans, a distortion that was not removed.

Beside a shift and a turn (:mod:`sameas.sky.rotation`) the second catalogue may be bent against the first. The residuals
of the identified pairs, each weighted by its probability and its errors with a scatter that is estimated, are fitted by

    (east, north) = Σ_{a+b ≤ p} c_ab uᵃ vᵇ ,   (u, v): the place on the tangent plane of the field, within ±1,

for every order p that the pairs can tell. The order is the lowest that foretells each residual from the others about as
well as the best (leave-one-out); order 0, a shift alone, is no warp. So a warp stands out from shift and from chance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import FloatArray
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification
from sameas.sky.frame.tangent import to_plane
from sameas.space import ARCSEC_PER_RADIAN, displaced, unit_vectors


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


TUNING = WarpTuning()


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


def find_warp(result: Identification, before: Warp | None = None, tuning: WarpTuning = TUNING) -> Warp | None:
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
    centre = vectors.mean(axis=0)
    centre /= np.linalg.norm(centre)
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
