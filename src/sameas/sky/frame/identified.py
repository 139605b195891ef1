"""Identify and refine: which star each measurement is, and the plate model, alternately until both have converged.

Stars are predicted on the frame with their errors and those of the plate model; measurements and predictions are
identified in pixels (:func:`sameas.estimate.match`); the plate is fitted again to all candidate pairs, each with
its probability. Stars so faint that the frame shows none of them are no candidates.

``solve`` is the whole way: where the frame points, which star each measurement is, and the refined plate. It starts
from measurements: :mod:`sameas.sky.frame.image` and :mod:`sameas.sky.frame.detect` make these from pixels, and
:func:`sameas.sky.frame.outputs.listing` makes a table of its result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError, Message, naming
from sameas.estimate.match import Estimate, match
from sameas.evidence import Magnitudes
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.frame.field import Cone, StarField
from sameas.sky.frame.measurements import Flag, Measurements
from sameas.sky.frame.photometry import Completeness, PhotometryTuning, ZeroPoint, instrumental
from sameas.sky.frame.place import Placement, place
from sameas.sky.frame.plate import MatchedStars, PlateModel, PlateTuning, fit_plate
from sameas.sky.frame.pointing_hints import Aim, AllSky, ApproximateWcs, Hint, SkyIndex
from sameas.sky.frame.tangent import Pointing, directions_deg

#: Magnitudes of a relative error of one.
POGSON = 2.5 / math.log(10.0)
#: With fewer pairs the root mean square is given instead of the robust scatter (chosen).
FEW = 20
#: The catalogue reaches as faint as this share of the identified measurements; it is shallow where more than this share
#: of all measurements is fainter, and not identified (both chosen).
REACHED, SHALLOW = 0.98, 0.2
#: Stars of a catalogue that are fainter than this share of it are its faintest (chosen).
FAINTEST = 0.8
#: Stars that the frame shows with at least this probability are missing when they are not identified.
EXPECTED = 0.5
#: A star is not as bright as catalogued when it is off by this many robust standard deviations of the pairs and this
#: many magnitudes (both chosen): a variable, a wrong identification, another's light.
ODD_SIGMAS, ODD_MAG = 5.0, 0.5


@dataclass(frozen=True)
class RefinementTuning:
    """Numbers of the refinement, all chosen.

    Attributes
    ----------
    margin_px : stars predicted outside the frame by less than this may be measured on its edge.
    least_p_pair : pairs less probable than this are not used for the plate.
    pairs_beyond_linear : the first plate may be of higher order than linear with more pairs than this.
    saturated_mag : standard error of the magnitude of a saturated star, which loses some light, but not nearly all.
    least_p_detect : stars that the frame shows with less than this probability are no candidates.
    plate, photometry : numbers of the two fits.
    """

    margin_px: float = 2.0
    least_p_pair: float = 0.02
    saturated_mag: float = 0.5
    pairs_beyond_linear: int = 30
    least_p_detect: float = 0.01
    plate: PlateTuning = field(default_factory=PlateTuning)
    photometry: PhotometryTuning = field(default_factory=PhotometryTuning)


TUNING = RefinementTuning()


@dataclass(frozen=True)
class Refinement:
    """How identification and plate are refined.

    order : of the plate's polynomial, 1 … 5, None for the one of least BIC. iterations : at most.
    settled_px : converged when no prediction moves farther.
    magnitudes : "auto" takes brightness as evidence from the second iteration on, where the catalogue has magnitudes;
        "off" never does.
    """

    order: int | None = None
    iterations: int = 8
    settled_px: float = 0.01
    magnitudes: Literal["auto", "off"] = "auto"
    tuning: RefinementTuning = field(default=TUNING, repr=False)


@in_short
@dataclass(frozen=True)
class FrameIdentification:
    """A frame identified with a catalogue. Rows of ``result`` are rows of ``measured`` and of ``stars``.

    Attributes
    ----------
    measured : the measurements. stars : those of the field at the frame's epoch; the ones beyond the frame, and
        those far too faint, were no candidates.
    placement : where the search started. plate : the refined plate model.
    result, estimate : the identification in pixels, measurements first.
    predicted_px : (m, 2) pixel of each star by the plate model; predicted_covariance : (m, 3) of it, px².
    candidate : (m,) the stars that could be identified.
    zero_point, completeness : of brightness, None where no magnitudes are known.
    iterations, settled : of the refinement, and whether it converged. notes : what a user should know.
    """

    measured: Measurements
    stars: StarField
    placement: Placement
    plate: PlateModel
    result: Identification = field(repr=False)
    estimate: Estimate = field(repr=False)
    predicted_px: FloatArray = field(repr=False)
    predicted_covariance: FloatArray = field(repr=False)
    candidate: BoolArray = field(repr=False)
    zero_point: ZeroPoint | None
    completeness: Completeness | None
    iterations: int
    settled: bool
    notes: tuple[str, ...] = ()

    @property
    def pairs(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Rows of the measurements, rows of the stars, and probabilities of the identified pairs."""
        matches = self.result.matches
        return matches.rows_1, matches.rows_2, matches.p_match

    @cached_property
    def inside(self) -> BoolArray:
        """(m,) whether each star is predicted within the frame, where one can be measured."""
        return _measurable(self.predicted_px, self.measured, 0.0)

    @cached_property
    def p_detect(self) -> FloatArray:
        """(m,) the probability that the frame shows each star; where no magnitudes are known the same for all."""
        if self.completeness is not None:
            return self.completeness(self.stars.magnitude)
        return np.full(len(self.stars), self.estimate.share_2)

    @cached_property
    def missing(self) -> IntArray:
        """Rows of the stars: stars that the frame should show and that no measurement is identified with."""
        identified = np.zeros(len(self.stars), np.bool_)
        identified[self.pairs[1]] = True
        return np.flatnonzero(self.inside & ~identified & (self.p_detect >= EXPECTED))

    @cached_property
    def residual_px(self) -> FloatArray:
        """(k, 2) of the identified pairs: measured minus predicted."""
        i, j, _ = self.pairs
        return np.column_stack([self.measured.x_px[i], self.measured.y_px[i]]) - self.predicted_px[j]

    @cached_property
    def residual_arcsec(self) -> FloatArray:
        """(k, 2) of the identified pairs: measured minus predicted, east and north."""
        from sameas.space import sphere_offset

        i, j, _ = self.pairs
        ra, dec, _ = self.plate.to_sky(self.measured.x_px[i], self.measured.y_px[i])
        return sphere_offset(ra, dec, self.stars.ra_deg[j], self.stars.dec_deg[j])

    @cached_property
    def beyond_catalogue(self) -> IntArray:
        """Rows of the measurements that are not identified because the catalogue does not reach so faint.

        They are many, and fainter than nearly all identified ones, and the frame shows the faintest stars of the
        catalogue; else there are none.
        """
        magnitude = instrumental(self.measured.flux)
        alone, found = self.result.leftovers_1, magnitude[self.pairs[0]]
        found = found[np.isfinite(found)]
        identified = np.zeros(len(self.stars), np.bool_)
        identified[self.pairs[1]] = True
        identified, of_stars = identified[self.inside], self.stars.magnitude[self.inside]
        if np.isfinite(of_stars).any():
            identified = identified[of_stars > np.nanquantile(of_stars, FAINTEST)]
        if len(found) < FEW or not len(identified) or identified.mean() < EXPECTED:
            return np.empty(0, np.int64)
        fainter = alone[magnitude[alone] > np.quantile(found, REACHED)]
        return fainter if len(fainter) > SHALLOW * len(magnitude) else fainter[:0]

    @cached_property
    def excess_mag(self) -> FloatArray:
        """(k,) of the identified pairs: measured minus catalogued magnitude; NaN where one of them is not known."""
        i, j, _ = self.pairs
        if self.zero_point is None:
            return np.full(len(i), np.nan)
        return np.asarray(self.zero_point(self.measured.flux[i], self.stars.colour[j]) - self.stars.magnitude[j])

    @cached_property
    def odd_brightness(self) -> IntArray:
        """Which of the identified pairs are much brighter or fainter than catalogued, the farthest off first."""
        off = np.abs(np.nan_to_num(self.excess_mag))
        scatter = 0.0 if self.zero_point is None else self.zero_point.scatter
        odd = np.flatnonzero(off > max(ODD_SIGMAS * scatter, ODD_MAG))
        return odd[np.argsort(-off[odd], kind="stable")]

    @property
    def scatter_arcsec(self) -> FloatArray:
        """(2,) robust standard deviation (1.4826 · median |Δ|) of the residuals east and north; of few, whose median
        says little, the root mean square."""
        left = self.residual_arcsec
        if not len(left):
            return np.full(2, np.nan)
        if len(left) < FEW:
            return np.asarray(np.sqrt(np.mean(left**2, axis=0)))
        return np.asarray(1.4826 * np.median(np.abs(left - np.median(left, axis=0)), axis=0))


def identify_frame(
    measured: Measurements, stars: StarField, placement: Placement, refinement: Refinement | None = None
) -> FrameIdentification:
    """A placed frame identified with the stars of its field, and its plate refined.

    Parameters
    ----------
    measured : the measurements. stars : the field, at the frame's epoch; the placement's star rows are its rows.
    placement : where the frame points. refinement : how identification and plate are refined.

    Raises
    ------
    InputError : too few pairs for a plate model; nothing of the catalogue is on the frame.

    Example: ``identify_frame(measurements, stars, placement).plate.describe()``.
    """
    refinement = refinement or Refinement()
    tuning, records, faintest = refinement.tuning, measured.records(), None
    plate = _first_plate(measured, stars, placement, tuning)
    px, covariance = _predicted(plate, stars)
    for iteration in range(1, refinement.iterations + 1):
        candidate = _candidates(px, stars, measured, faintest, tuning.margin_px)
        # By the first plate brightness would confirm wrong pairs as well as right ones.
        bright = None if iteration == 1 or refinement.magnitudes == "off" else _brightness(measured, stars, tuning)
        result, estimate = match(records, _records(px, covariance, candidate, stars), brightness=bright)
        completeness = _completeness(px, stars, result, measured, tuning)
        if completeness is not None:
            faintest = completeness.faintest(tuning.least_p_detect)
        pairs = _matched(measured, stars, result, tuning.least_p_pair)
        plate = fit_plate(pairs, placement.pointing, measured.shape, order=refinement.order, tuning=tuning.plate)
        before, inside = px, _within(px, measured.shape, 0.0)
        px, covariance = _predicted(plate, stars)
        settled = bool(np.nanmax(np.abs(px - before)[inside], initial=0.0) < refinement.settled_px)
        if settled and iteration > 1:
            break
    i, j, p = result.matches.rows_1, result.matches.rows_2, result.matches.p_match
    zero = ZeroPoint.of(measured.flux[i], stars.magnitude[j], stars.colour[j], p, tuning.photometry)
    notes = _notes(result, estimate, plate, settled)
    return FrameIdentification(
        measured, stars, placement, plate, result, estimate, px, covariance, candidate, zero, completeness, iteration,
        settled, notes,
    )  # fmt: skip


def _first_plate(
    measured: Measurements, stars: StarField, placement: Placement, tuning: RefinementTuning
) -> PlateModel:
    """The plate of the pairs of the placement."""
    i, j = placement.rows_measured, placement.rows_stars
    pairs = _pairs(measured, stars, i, j, np.ones(len(i)))
    order = None if len(i) > tuning.pairs_beyond_linear else 1
    return fit_plate(pairs, placement.pointing, measured.shape, order=order, tuning=tuning.plate)


def _matched(measured: Measurements, stars: StarField, result: Identification, least_p_pair: float) -> MatchedStars:
    """All candidate pairs that are probable enough to be used for the plate, with their probabilities."""
    used = np.flatnonzero(result.p_pair >= least_p_pair)
    p = np.minimum(result.p_pair[used], 1.0)
    return _pairs(measured, stars, result.rows_1[used], result.rows_2[used], p)


def _pairs(measured: Measurements, stars: StarField, i: IntArray, j: IntArray, p: FloatArray) -> MatchedStars:
    return MatchedStars(
        px=np.column_stack([measured.x_px[i], measured.y_px[i]]),
        covariance_px=measured.covariance[i],
        ra_deg=stars.ra_deg[j],
        dec_deg=stars.dec_deg[j],
        covariance_arcsec=stars.covariance_arcsec[j],
        p_match=p,
    )


def _predicted(plate: PlateModel, stars: StarField) -> tuple[FloatArray, FloatArray]:
    """(m, 2) pixels and (m, 3) covariances, errors of the stars and of the plate together."""
    x, y, covariance = plate.predict(stars.ra_deg, stars.dec_deg, stars.covariance_arcsec)
    return np.column_stack([x, y]), covariance


def _within(px: FloatArray, shape: tuple[int, int], margin_px: float) -> BoolArray:
    """(m,) whether pixels lie on the frame, or not farther outside than a margin."""
    x, y = px.T
    low, rows, columns = -0.5 - margin_px, shape[0] - 0.5 + margin_px, shape[1] - 0.5 + margin_px
    with np.errstate(invalid="ignore"):
        return np.asarray((x >= low) & (x <= columns) & (y >= low) & (y <= rows))


def _measurable(px: FloatArray, measured: Measurements, margin_px: float) -> BoolArray:
    """(m,) whether pixels lie on the frame, or not farther outside than a margin, and not where it is blind."""
    measurable = _within(px, measured.shape, margin_px)
    if measured.blind is not None:
        rows, columns = measured.shape
        x, y = np.rint(np.nan_to_num(px)).astype(np.int64).T
        measurable &= ~measured.blind[np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)]
    return measurable


def _candidates(
    px: FloatArray, stars: StarField, measured: Measurements, faintest: float | None, margin_px: float
) -> BoolArray:
    """(m,) stars on the frame that are not too faint to be measured."""
    candidate = _measurable(px, measured, margin_px)
    if faintest is not None:
        candidate &= ~(stars.magnitude > faintest)
    if not candidate.any():
        raise InputError(f"{stars.name}: none of its stars lies on the frame; does the catalogue cover the field?")
    return candidate


def _records(px: FloatArray, covariance: FloatArray, candidate: BoolArray, stars: StarField) -> Records:
    """The candidates in pixels; their rows are those of the stars."""
    rows = np.flatnonzero(candidate)
    return Records(px[rows], covariance[rows], rows, stars.ids, source=stars.name)


def _brightness(
    measured: Measurements, stars: StarField, tuning: RefinementTuning
) -> tuple[Magnitudes, Magnitudes] | None:
    """Instrumental magnitudes and those of the stars; None where the catalogue has none.

    Cut measurements and those that have no star's shape get no magnitude. Saturated ones keep theirs with a wide error:
    none is a star of a hundredth of its light.
    """
    if not np.isfinite(stars.magnitude).any():
        return None
    usable = measured.clean(Flag.BLENDED | Flag.SATURATED) & (measured.flux > 0.0)
    flux = np.where(usable, measured.flux, np.nan)
    lost = np.where((measured.flags & Flag.SATURATED) != 0, tuning.saturated_mag, 0.0)
    error = np.hypot(POGSON * measured.flux_err / flux, lost)
    return Magnitudes(-2.5 * np.log10(flux), error, ("instrumental",)), Magnitudes(
        stars.magnitude, names=("catalogue",)
    )


def _completeness(
    px: FloatArray, stars: StarField, result: Identification, measured: Measurements, tuning: RefinementTuning
) -> Completeness | None:
    """The share of the stars on the frame that are identified, by magnitude."""
    p_identified = np.zeros(len(stars))
    np.add.at(p_identified, result.rows_2, result.p_pair)
    inside = _measurable(px, measured, -tuning.margin_px)
    if not inside.any():
        return None
    return Completeness.of(stars.magnitude[inside], p_identified[inside], tuning.photometry)


def _notes(result: Identification, estimate: Estimate, plate: PlateModel, settled: bool) -> tuple[str, ...]:
    notes = list(estimate.notes)
    if not settled:
        notes.append("identification and plate had not converged at the last iteration")
    if plate.error_scale > 3.0:
        notes.append(f"residuals from the plate model are {plate.error_scale:.1f} times the quoted errors")
    if result.approximate_pairs:
        notes.append(f"{result.approximate_pairs} candidates lie in large groups; their probabilities are approximate")
    return tuple(notes)


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
