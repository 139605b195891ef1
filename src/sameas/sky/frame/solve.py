"""A frame solved: where it points, which star each measurement is, and the refined plate, one line a step.

``solve`` starts from measurements: :mod:`sameas.sky.frame.image` and :mod:`sameas.sky.frame.detect` make these from
pixels, and :func:`sameas.sky.frame.listing.listing` makes a table of its result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError, Message, naming
from sameas.sky.catalogue import Catalogue
from sameas.sky.frame.field import Cone, StarField
from sameas.sky.frame.identified import FrameIdentification, Refinement, identify_frame
from sameas.sky.frame.measurements import Measurements
from sameas.sky.frame.place import place
from sameas.sky.frame.pointing_hints import Aim, AllSky, ApproximateWcs, Hint, SkyIndex
from sameas.sky.frame.tangent import Pointing, directions_deg

#: Stars are taken from a field this factor wider than the frame, which may be rotated or scaled a little (chosen).
ROOM = 1.1


def solve(
    measured: Measurements,
    catalogue: Catalogue,
    hints: Hint | Sequence[Hint],
    *,
    epoch_jyr: float | None,
    refinement: Refinement | None = None,
    index: SkyIndex | None = None,
    motion: bool = True,
    faintest: float | None = None,
) -> FrameIdentification:
    """A frame placed, identified and refined.

    Parameters
    ----------
    measured : the measurements of the frame. catalogue : of the field, or of the whole sky.
    hints : on the direction of the frame, tried in this order.
    epoch_jyr : the middle of the exposure, Julian year; None if it is not known and the catalogue does not move.
    refinement : how identification and plate are refined. index : for an :class:`AllSky` hint, reused for every frame.
    motion : False leaves the stars at their own epoch, for comparison.
    faintest : magnitude of the faintest star that is used; None for as faint as the frame shows them.

    Raises
    ------
    InputError : no placement has high enough odds; the catalogue does not cover the field; a time is missing.

    Example
    -------
    >>> found = solve(detect(frame), catalogue, ApproximateWcs(wcs), epoch_jyr=2018.8)  # doctest: +SKIP
    >>> found.plate.to_wcs()  # doctest: +SKIP
    """
    hints = [hints] if isinstance(hints, ApproximateWcs | Aim | AllSky) else list(hints)
    near = searched(hints, measured.shape)
    stars = StarField.of(catalogue, epoch_jyr, motion=motion, near=near)
    if faintest is not None:
        stars = stars[~(stars.magnitude > faintest)]
    if len(stars) < 4:
        where = "" if near is None else f" within {near.radius_deg:.3g}° of {near.ra_deg:.4f}°, {near.dec_deg:+.4f}°"
        raise InputError(
            f"{catalogue.name}: {len(stars)} stars{where}, a frame needs four; does the catalogue cover the field?"
        )
    placement = place(measured, stars.stars(), hints, index=index)
    near_frame = stars.within(footprint(placement.pointing, measured.shape))
    near_frame[placement.rows_stars] = True
    number = np.cumsum(near_frame) - 1
    placement = replace(placement, rows_stars=number[placement.rows_stars])
    found = identify_frame(measured, stars[near_frame], placement, refinement)
    return _with_own_error(found, refinement) if catalogue.error_is_unknown else found


#: The common error of stars is sought between these shares of a pixel, in so many steps (chosen).
LEAST_PX, LARGEST_PX, STEPS = 1e-3, 10.0, 200
#: Pairs more probable than this tell it. A share of them has errors larger by a factor: doubles, blends (chosen).
SURE, TAIL_SHARE, TAIL = 0.9, 0.05, 5.0


def common_star_error(found: FrameIdentification) -> float:
    """One position error of the stars, arcsec an axis, that explains the residuals beside the measurements' errors.

    The likeliest s of residuals r with variances σ² + s², σ that of the measurement; what the plate model has taken
    away of them is given back by their degrees of freedom.
    """
    i, _, p = found.pairs
    sure = p >= SURE
    scale = found.placement.pointing.scale_arcsec
    left = found.residual_arcsec[sure]
    count = (found.plate.order + 1) * (found.plate.order + 2) // 2
    left2 = left**2 * len(left) / max(len(left) - count, 1)
    sigma2 = scale**2 * found.measured.covariance[i[sure]][:, [0, 2]].mean(axis=1, keepdims=True)
    s2 = (scale * np.geomspace(LEAST_PX, LARGEST_PX, STEPS)) ** 2
    fit = [_log_tailed(left2, sigma2 + one).sum() for one in s2]
    return float(np.sqrt(s2[int(np.argmax(fit))]))


def _log_tailed(square: FloatArray, variance: FloatArray) -> FloatArray:
    """Logarithm of a normal density at residuals squared, with a tail: a few stars far off do not pull."""
    near = np.exp(-0.5 * square / variance) / np.sqrt(variance)
    far = np.exp(-0.5 * square / (TAIL**2 * variance)) / (TAIL * np.sqrt(variance))
    return np.asarray(np.log((1.0 - TAIL_SHARE) * near + TAIL_SHARE * far + 1e-300))


def _with_own_error(found: FrameIdentification, refinement: Refinement | None) -> FrameIdentification:
    """Identified anew with the common error that the residuals tell, and the doubt that says so."""
    sigma = common_star_error(found)
    again = identify_frame(found.measured, found.stars.with_error(sigma), found.placement, refinement)
    words = (
        f"doubt: {found.stars.name}: it has no position errors; {sigma:.2g} arcsec on each axis was assumed, estimated "
        "from the residuals; "
    )
    return replace(again, notes=(*again.notes, Message(words, naming("give {sigma:ARCSEC} or {sigma:COLUMN}"))))


def footprint(pointing: Pointing, shape: tuple[int, int]) -> Cone:
    """The cone about a frame, its radius larger by the factor :data:`ROOM`."""
    rows, columns = shape
    corners = np.array([[0.0, 0.0], [columns - 1.0, 0.0], [0.0, rows - 1.0], [columns - 1.0, rows - 1.0]])
    middle = pointing.to_sky(np.array([[(columns - 1) / 2.0, (rows - 1) / 2.0]]))[0]
    chord = np.linalg.norm(pointing.to_sky(corners) - middle, axis=1).max()
    radius = math.degrees(2 * math.asin(min(1.0, float(chord) / 2)))
    ra, dec = directions_deg(middle)
    return Cone(float(ra), float(dec), min(ROOM * radius, 180.0))


def searched(hints: Sequence[Hint], shape: tuple[int, int]) -> Cone | None:
    """A cone that holds all directions that the hints allow; None for the whole sky."""
    cones = []
    for hint in hints:
        if isinstance(hint, AllSky):
            return None
        if isinstance(hint, ApproximateWcs):
            frame = footprint(Pointing.of_wcs(hint.wcs, shape), shape)
            off = hint.radius_deg if hint.radius_deg is not None else 0.5 * frame.radius_deg
            cones.append(replace(frame, radius_deg=frame.radius_deg + off))
        else:
            half = 0.5 * math.hypot(*shape) * hint.scale_arcsec[1] / 3600.0
            cones.append(Cone(hint.ra_deg, hint.dec_deg, hint.radius_deg + ROOM * half))
    middle = np.sum([cone.direction for cone in cones], axis=0)
    ra, dec = directions_deg(middle)
    about = Cone(float(ra), float(dec), 0.0)
    apart = [
        math.degrees(2 * math.asin(min(1.0, float(np.linalg.norm(c.direction - about.direction)) / 2))) for c in cones
    ]
    radius = max(off + cone.radius_deg for off, cone in zip(apart, cones, strict=True))
    return replace(about, radius_deg=min(radius, 180.0))
