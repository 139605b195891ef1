"""Identification of a frame: crossmatch of measurements and stars, and plate fit, alternately until convergence.

Stars are predicted on the frame with their errors and those of the plate model; measurements and predictions are
matched in pixels (:func:`sameas.estimate.match`); the plate is refitted to all candidate pairs, weighted by their
probabilities. Stars too faint for the frame are no candidates.

:func:`solve` does everything from the measurements on: placement, identification, and the refined plate.
:mod:`sameas.sky.frame.image` and :mod:`sameas.sky.frame.detect` make measurements from pixels;
:func:`sameas.sky.frame.outputs.listing` makes a table of the result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray, median, robust_scale
from sameas.errors import InputError, Message, naming
from sameas.estimate.match import match
from sameas.estimate.result import Estimate
from sameas.evidence import Magnitudes
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.frame.field import Cone, StarField
from sameas.sky.frame.measurements import POGSON, Flag, Measurements
from sameas.sky.frame.photometry import Completeness, ZeroPoint, instrumental
from sameas.sky.frame.place import Placement, place
from sameas.sky.frame.plate import MatchedStars, PlateModel, fit_plate, terms
from sameas.sky.frame.pointing import Pointing
from sameas.sky.frame.pointing_hints import AIM_LISTS, Aim, AimLists, AllSky, ApproximateWcs, Hint, SkyIndex
from sameas.sky.residual_epoch import LARGEST_SIGMAS, MovedPairs, Questioned
from sameas.space import chord_angle_deg, directions_deg, sphere_offset

#: Stars predicted up to this distance outside the frame, or of trails up to half their length, are candidates.
MARGIN_PX = 2.0
MIN_P_PAIR = 0.02  # minimum probability of a pair used for the plate
SATURATED_MAG = 0.5  # standard error of the magnitude of a saturated star, which loses part of its light
PAIRS_BEYOND_LINEAR = 30  # with more pairs than this the first plate may have an order above 1
MIN_P_DETECT = 0.01  # minimum detection probability of a candidate star
CALIBRATORS = 60.0  # unblended, or else unsaturated, stars for a zero point from these alone
FEW_PAIRS = 20  # with fewer pairs the root mean square is used instead of the robust scatter
#: Quantile of the identified magnitudes taken as the limit of the catalogue, and the minimum share of all measurements
#: that are fainter and unidentified in a shallow catalogue.
LIMIT_QUANTILE, SHALLOW_SHARE = 0.98, 0.2
FAINTEST_QUANTILE = 0.8  # quantile of magnitude above which the stars of a catalogue are its faintest
P_EXPECTED = 0.5  # minimum detection probability of a star that is reported as missing if not identified
#: Minimum deviation from the catalogued magnitude that is reported, in robust standard deviations of the pairs and in
#: magnitudes: a variable, a wrong identification, light of another star.
ODD_SIGMAS, ODD_MAG = 5.0, 0.5
ROOM = 1.1  # radius of the star field over that of the frame, to allow for a change of rotation and scale
LEAST_COMMON_PX, LARGEST_COMMON_PX, COMMON_STEPS = 1e-3, 10.0, 200  # grid of the common error of stars
P_SURE = 0.9  # minimum probability of the pairs used for it
TAIL_SHARE, TAIL_FACTOR = 0.05, 5.0  # share of outliers (doubles, blends) among them, and the factor on their errors
MERGED_WIDTHS = 1.5  # two stars closer than this, in FWHM, are measured as one
#: A saturated star hides others within this radius, in FWHM, that are fainter than it by at least this many magnitudes.
HIDDEN_WIDTHS, BRIGHTER_MAG = 4.0, 0.5


@dataclass(frozen=True)
class Refinement:
    """How identification and plate are refined.

    order : of the plate's polynomial, 1 … 5, None to choose it. iterations : maximum number.
    converged_px : maximum change of a prediction at convergence.
    magnitudes : "auto" uses magnitudes as evidence from the second iteration on, if the catalogue has them; "off" does
        not.
    """

    order: int | None = None
    iterations: int = 8
    converged_px: float = 0.01
    magnitudes: Literal["auto", "off"] = "auto"


REFINEMENT = Refinement()


@in_short
@dataclass(frozen=True)
class FrameIdentification:
    """The identification of a frame. Rows of ``result`` are rows of ``measured`` and of ``stars``.

    Attributes
    ----------
    measured : the measurements. stars : of the field at the frame's epoch; those outside the frame or far too faint are
        no candidates.
    placement : the initial placement. plate : the refined plate model.
    result, estimate : the crossmatch in pixels, measurements first.
    predicted_px : (m, 2) pixel of each star by the plate model; predicted_covariance : (m, 3) its covariance, px².
    candidate : (m,) mask of the candidate stars.
    zero_point, completeness : photometric, None without magnitudes.
    iterations, converged : number of iterations, and whether they converged. notes : lines for the user.
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
    converged: bool
    notes: tuple[str, ...] = ()

    @property
    def pairs(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Rows of the measurements, rows of the stars, and probabilities of the identified pairs."""
        matches = self.result.matches
        return matches.rows_1, matches.rows_2, matches.p_match

    @cached_property
    def inside(self) -> BoolArray:
        """(m,) mask of the stars predicted within the frame at usable pixels."""
        return _measurable(self.predicted_px, self.measured, 0.0)

    @cached_property
    def p_detect(self) -> FloatArray:
        """(m,) detection probability of each star; the same for all without magnitudes."""
        if self.completeness is not None:
            return self.completeness(self.stars.magnitude)
        return np.full(len(self.stars), self.estimate.share_2)

    @cached_property
    def missing(self) -> IntArray:
        """Rows of the stars that should be detected but are not identified."""
        identified = np.zeros(len(self.stars), np.bool_)
        identified[self.pairs[1]] = True
        return np.flatnonzero(self.inside & ~identified & (self.p_detect >= P_EXPECTED))

    @cached_property
    def residual_px(self) -> FloatArray:
        """(k, 2) residuals of the identified pairs, px: measured minus predicted."""
        i, j, _ = self.pairs
        return np.column_stack([self.measured.x_px[i], self.measured.y_px[i]]) - self.predicted_px[j]

    @cached_property
    def residual_arcsec(self) -> FloatArray:
        """(k, 2) residuals of the identified pairs, east and north: measured minus predicted."""
        i, j, _ = self.pairs
        ra, dec, _ = self.plate.to_sky(self.measured.x_px[i], self.measured.y_px[i])
        return sphere_offset(ra, dec, self.stars.ra_deg[j], self.stars.dec_deg[j])

    @cached_property
    def beyond_catalogue(self) -> IntArray:
        """Rows of the measurements that are unidentified because the catalogue is too shallow.

        These are fainter than nearly all identified ones. Empty unless there are many of them and the frame shows the
        faintest stars of the catalogue.
        """
        magnitude = instrumental(self.measured.flux)
        unidentified, identified_mag = self.result.leftovers_1, magnitude[self.pairs[0]]
        identified_mag = identified_mag[np.isfinite(identified_mag)]
        identified = np.zeros(len(self.stars), np.bool_)
        identified[self.pairs[1]] = True
        identified, star_mag = identified[self.inside], self.stars.magnitude[self.inside]
        if np.isfinite(star_mag).any():
            identified = identified[star_mag > np.nanquantile(star_mag, FAINTEST_QUANTILE)]
        if len(identified_mag) < FEW_PAIRS or not len(identified) or identified.mean() < P_EXPECTED:
            return np.empty(0, np.int64)
        fainter = unidentified[magnitude[unidentified] > np.quantile(identified_mag, LIMIT_QUANTILE)]
        return fainter if len(fainter) > SHALLOW_SHARE * len(magnitude) else fainter[:0]

    @cached_property
    def excess_mag(self) -> FloatArray:
        """(k,) measured minus catalogued magnitude of the identified pairs; NaN where one is not known."""
        i, j, _ = self.pairs
        if self.zero_point is None:
            return np.full(len(i), np.nan)
        return np.asarray(self.zero_point(self.measured.flux[i], self.stars.colour[j]) - self.stars.magnitude[j])

    @cached_property
    def odd_brightness(self) -> IntArray:
        """Indices of the identified pairs much brighter or fainter than catalogued, largest deviation first."""
        deviation = np.abs(np.nan_to_num(self.excess_mag))
        scatter = 0.0 if self.zero_point is None else self.zero_point.scatter
        odd = np.flatnonzero(deviation > max(ODD_SIGMAS * scatter, ODD_MAG))
        return odd[np.argsort(-deviation[odd], kind="stable")]

    @property
    def scatter_arcsec(self) -> FloatArray:
        """(2,) robust standard deviation of the residuals east and north; RMS for few pairs."""
        residual = self.residual_arcsec
        if not len(residual):
            return np.full(2, np.nan)
        if len(residual) < FEW_PAIRS:
            return np.asarray(np.sqrt(np.mean(residual**2, axis=0)))
        return np.array([robust_scale(axis - median(axis)) for axis in residual.T])


def identify_frame(
    measured: Measurements, stars: StarField, placement: Placement, refinement: Refinement
) -> FrameIdentification:
    """The identification of a placed frame with the stars of its field, and its refined plate.

    Parameters
    ----------
    measured : the measurements. stars : the field at the frame's epoch; ``placement.rows_stars`` are its rows.
    placement : the pointing of the frame. refinement : how identification and plate are refined.

    Raises
    ------
    InputError : too few pairs for a plate model; no star of the catalogue is on the frame.

    Example: ``identify_frame(measurements, stars, placement, Refinement()).plate.describe()``.
    """
    records, faintest = measured.records(), None
    plate = _first_plate(measured, stars, placement)
    px, covariance = _predicted(plate, stars)
    for iteration in range(1, refinement.iterations + 1):
        candidate = _candidates(px, stars, measured, faintest, np.maximum(_half_length_px(measured), MARGIN_PX))
        # With the first plate magnitudes would support wrong pairs as well as right ones.
        magnitudes = None if iteration == 1 or refinement.magnitudes == "off" else _brightness(measured, stars)
        result, estimate = match(records, _records(px, covariance, candidate, stars), brightness=magnitudes)
        completeness = _completeness(px, stars, result, measured)
        if completeness is not None:
            faintest = completeness.faintest(MIN_P_DETECT)
        pairs = _matched(measured, stars, result)
        plate = fit_plate(pairs, placement.pointing, measured.shape, order=refinement.order)
        previous_px, inside = px, _within(px, measured.shape, 0.0)
        px, covariance = _predicted(plate, stars)
        converged = bool(np.nanmax(np.abs(px - previous_px)[inside], initial=0.0) < refinement.converged_px)
        if converged and iteration > 1:
            break
    i, j, p = result.matches.rows_1, result.matches.rows_2, result.matches.p_match
    zero = _zero_point(measured, stars, i, j, p)
    notes = _notes(result, estimate, plate, converged)
    return FrameIdentification(
        measured=measured, stars=stars, placement=placement, plate=plate, result=result, estimate=estimate,
        predicted_px=px, predicted_covariance=covariance, candidate=candidate, zero_point=zero,
        completeness=completeness, iterations=iteration, converged=converged, notes=notes,
    )  # fmt: skip


def _zero_point(measured: Measurements, stars: StarField, i: IntArray, j: IntArray, p: FloatArray) -> ZeroPoint | None:
    """The zero point of unblended and unsaturated stars if there are enough and the detector is linear, else of all.

    Saturated stars have lost light, and blended ones keep some of their neighbours': with them, a linear detector would
    seem to need a curve. That of a photographic plate is fitted to all.
    """
    calibration = measured.flux[i], stars.magnitude[j], stars.colour[j]
    known = np.isfinite(stars.magnitude[j])
    for bits in (Flag.SATURATED | Flag.BLENDED, Flag.SATURATED):
        used = np.where((measured.flags[i] & np.uint16(bits)) == 0, p, 0.0)
        zero = ZeroPoint.of(*calibration, used) if used[known].sum() >= CALIBRATORS else None
        if zero is not None and not zero.bend:
            return zero
    return ZeroPoint.of(*calibration, p)


def _first_plate(measured: Measurements, stars: StarField, placement: Placement) -> PlateModel:
    """The plate fitted to the pairs of the placement; linear if they are few."""
    i, j = placement.rows_measured, placement.rows_stars
    pairs = _pairs(measured, stars, i, j, np.ones(len(i)))
    order = None if len(i) > PAIRS_BEYOND_LINEAR else 1
    return fit_plate(pairs, placement.pointing, measured.shape, order=order)


def _matched(measured: Measurements, stars: StarField, result: Identification) -> MatchedStars:
    """All candidate pairs above the minimum probability, with their probabilities, for the plate fit."""
    used = np.flatnonzero(result.p_pair >= MIN_P_PAIR)
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
    """(m, 2) predicted pixels and (m, 3) covariances, including the errors of stars and plate."""
    x, y, covariance = plate.predict(stars.ra_deg, stars.dec_deg, stars.covariance_arcsec)
    return np.column_stack([x, y]), covariance


def _half_length_px(measured: Measurements) -> FloatArray:
    """(2,) half the typical length of trails along x and y, those of a line with their second moments; 0 for stars."""
    angle = np.radians(measured.theta_deg)
    longer = measured.a_px**2 - measured.b_px**2
    moments = longer[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]) ** 2
    known = moments[np.isfinite(longer)]
    return np.sqrt(3.0 * np.median(known, axis=0)) if len(known) else np.zeros(2)


def _within(px: FloatArray, shape: tuple[int, int], margin_px: FloatArray | float) -> BoolArray:
    """(m,) mask of the pixels on the frame or at most a margin, of each axis or of both, outside."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((px >= -0.5 - margin_px) & (px <= np.array(shape[::-1]) - 0.5 + margin_px)).all(axis=1))


def _measurable(px: FloatArray, measured: Measurements, margin_px: FloatArray | float) -> BoolArray:
    """(m,) mask of the pixels on the frame or at most a margin outside, and not in a blind area."""
    measurable = _within(px, measured.shape, margin_px)
    if measured.blind is not None:
        rows, columns = measured.shape
        x, y = np.rint(np.nan_to_num(px)).astype(np.int64).T
        measurable &= ~measured.blind[np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)]
    return measurable


def _candidates(
    px: FloatArray, stars: StarField, measured: Measurements, faintest: float | None, margin_px: FloatArray
) -> BoolArray:
    """(m,) mask of the stars on the frame that are not too faint to be detected."""
    candidate = _measurable(px, measured, margin_px)
    if faintest is not None:
        candidate &= ~(stars.magnitude > faintest)
    if not candidate.any():
        raise InputError(f"{stars.name}: none of its stars lies on the frame; does the catalogue cover the field?")
    return candidate


def _records(px: FloatArray, covariance: FloatArray, candidate: BoolArray, stars: StarField) -> Records:
    """The candidates as records in pixels; their rows are rows of the stars."""
    rows = np.flatnonzero(candidate)
    return Records(px[rows], covariance[rows], rows, stars.ids, source=stars.name)


def _brightness(measured: Measurements, stars: StarField) -> tuple[Magnitudes, Magnitudes] | None:
    """Instrumental and catalogue magnitudes; None if the catalogue has none.

    Measurements at the edge, or without the shape of a star, get no magnitude. Saturated ones keep theirs with a large
    error, which still excludes stars of a hundredth of the flux.
    """
    if not np.isfinite(stars.magnitude).any():
        return None
    usable = measured.clean(Flag.BLENDED | Flag.SATURATED) & (measured.flux > 0.0)
    flux = np.where(usable, measured.flux, np.nan)
    saturation_error = np.where((measured.flags & Flag.SATURATED) != 0, SATURATED_MAG, 0.0)
    error = np.hypot(POGSON * measured.flux_err / flux, saturation_error)
    return Magnitudes(-2.5 * np.log10(flux), error, ("instrumental",)), Magnitudes(
        stars.magnitude, names=("catalogue",)
    )


def _completeness(
    px: FloatArray, stars: StarField, result: Identification, measured: Measurements
) -> Completeness | None:
    """The identified share of the stars on the frame, by magnitude, without those within the margin of its edge."""
    p_identified = np.zeros(len(stars))
    np.add.at(p_identified, result.rows_2, result.p_pair)
    inside = _measurable(px, measured, -MARGIN_PX)
    if not inside.any():
        return None
    return Completeness.of(stars.magnitude[inside], p_identified[inside])


def _notes(result: Identification, estimate: Estimate, plate: PlateModel, converged: bool) -> tuple[str, ...]:
    notes = list(estimate.notes)
    if not converged:
        notes.append("identification and plate had not converged at the last iteration")
    if plate.error_scale > 3.0:
        notes.append(f"residuals from the plate model are {plate.error_scale:.1f} times the quoted errors")
    elif plate.floor_arcsec > 0.9 * float(np.sqrt(np.mean(plate.rms_arcsec**2))):
        notes.append(f"residuals from the plate model are {plate.floor_arcsec:.2g}″ whatever the quoted errors")
    if result.approximate_pairs:
        notes.append(f"{result.approximate_pairs} candidates lie in large groups; their probabilities are approximate")
    return tuple(notes)


def solve(
    measured: Measurements,
    catalogue: Catalogue,
    hints: Hint | Sequence[Hint],
    *,
    epoch_jyr: float | None,
    refinement: Refinement = REFINEMENT,
    index: SkyIndex | None = None,
    motion: bool = True,
    faintest: float | None = None,
    aim_lists: AimLists = AIM_LISTS,
) -> FrameIdentification:
    """A frame solved: placement, identification of its stars, and refined plate.

    Parameters
    ----------
    measured : the measurements of the frame. catalogue : of the field, or of the whole sky.
    hints : on the pointing of the frame, tried in this order.
    epoch_jyr : middle of the exposure, Julian year; None only if the catalogue has no proper motions.
    refinement : how identification and plate are refined. index : for :class:`AllSky` hints, reusable between frames.
    motion : False keeps the stars at their own epochs, for comparison.
    faintest : limiting magnitude of the stars; None for the limit of the frame. aim_lists : patterns that are tried.

    Raises
    ------
    InputError : no placement has high enough odds; the catalogue does not cover the field; a time is missing.

    Example
    -------
    >>> found = solve(detect(frame), catalogue, ApproximateWcs(wcs), epoch_jyr=2018.8)  # doctest: +SKIP
    >>> found.plate.to_wcs()  # doctest: +SKIP
    """
    hints = [hints] if isinstance(hints, ApproximateWcs | Aim | AllSky) else list(hints)
    near = search_cone(hints, measured.shape, ROOM)
    stars = StarField.of(catalogue, epoch_jyr, motion=motion, near=near)
    if faintest is not None:
        stars = stars[~(stars.magnitude > faintest)]
    if len(stars) < 4:
        where = "" if near is None else f" within {near.radius_deg:.3g}° of {near.ra_deg:.4f}°, {near.dec_deg:+.4f}°"
        by = "" if near is None else f" ({', '.join(dict.fromkeys(hint.words for hint in hints))})"
        raise InputError(
            f"{catalogue.name}: {len(stars)} stars{where}{by}, a frame needs four; does the catalogue cover the field?"
        )
    placement = place(measured, stars.stars(), hints, index=index, aim_lists=aim_lists)
    near_frame = stars.within(footprint(placement.pointing, measured.shape, ROOM))
    near_frame[placement.rows_stars] = True
    new_row = np.cumsum(near_frame) - 1
    placement = replace(placement, rows_stars=new_row[placement.rows_stars])
    match = identify_frame(measured, stars[near_frame], placement, refinement)
    if catalogue.error_is_unknown:
        match = _with_common_error(match, refinement)
    doubt = _epoch_doubt(match, catalogue)
    return replace(match, notes=(*match.notes, doubt)) if doubt else match


def _epoch_doubt(match: FrameIdentification, catalogue: Catalogue) -> str:
    """A doubt about the time of the frame or the convention of the proper motions; empty if none.

    The plate model has taken the mean of the motions, and what varies with the place, out of the residuals; the same
    polynomials are taken out of the motions.
    """
    epoch_jyr, stars, result = match.stars.epoch_jyr, match.stars, match.result
    if epoch_jyr is None or not catalogue.has_motion:
        return ""
    scale = match.placement.pointing.scale_arcsec
    some = np.flatnonzero(match.pairs[2] >= P_SURE)
    variance = scale**2 * np.einsum(
        "mvv->m", match.estimate.errors.typical_covariance(result.pairs, result.matches.pair[some])
    )
    astrometry = catalogue.astrometry[stars.rows[match.pairs[1][some]]]
    motion = astrometry.motion_arcsec_per_yr
    residual = -match.residual_arcsec[some]
    known = np.isfinite(motion).all(axis=1) & ((residual**2).sum(axis=1) < LARGEST_SIGMAS**2 * variance / 2.0)
    weight = np.sqrt(2.0 / variance[known])[:, None]
    xy = match.predicted_px[match.pairs[1][some[known]]] / max(match.measured.shape)
    basis = weight * np.stack([xy[:, 0] ** a * xy[:, 1] ** b for a, b in terms(match.plate.order)], axis=1)

    def remaining(values: FloatArray) -> FloatArray:
        """(m, 2) without what the plate model could take up."""
        fit = np.linalg.lstsq(basis, weight * values, rcond=None)[0]
        return np.asarray(values - basis @ fit / weight)

    pairs = MovedPairs(
        motion[known],
        (epoch_jyr - astrometry.epoch_jyr[known])[:, None] * motion[known],
        residual[known],
        (weight**2)[:, :, None] * np.eye(2),
        np.cos(np.radians(astrometry.dec_deg[known])),
        remaining,
    )
    questioned = Questioned(match.measured.name, epoch_jyr, naming("give {epoch_jyr:YEAR}"))
    if catalogue.choice.epoch.reason == "assumed" and catalogue.epoch_jyr is not None:
        questioned = Questioned(catalogue.name, catalogue.epoch_jyr, naming("give {epoch:YEAR}"), moved=True)
    text, _ = pairs.doubt(catalogue, "", questioned)
    return Message("doubt: ", text) if text else ""


def common_star_error(match: FrameIdentification) -> float:
    """The common position error of the stars, arcsec per axis, from the residuals and the errors of the measurements.

    The maximum-likelihood s for residuals with variances σ² + s², σ the error of the measurement. The residuals are
    scaled for the degrees of freedom of the plate model.
    """
    i, _, p = match.pairs
    sure = p >= P_SURE
    scale = match.placement.pointing.scale_arcsec
    residual = match.residual_arcsec[sure]
    parameters = (match.plate.order + 1) * (match.plate.order + 2) // 2
    residual_sq = residual**2 * len(residual) / max(len(residual) - parameters, 1)
    sigma2 = scale**2 * match.measured.covariance[i[sure]][:, [0, 2]].mean(axis=1, keepdims=True)
    s2 = (scale * np.geomspace(LEAST_COMMON_PX, LARGEST_COMMON_PX, COMMON_STEPS)) ** 2
    log_likelihood = [_log_tailed(residual_sq, sigma2 + variance).sum() for variance in s2]
    return float(np.sqrt(s2[int(np.argmax(log_likelihood))]))


def _log_tailed(residual_sq: FloatArray, variance: FloatArray) -> FloatArray:
    """Log density of a normal distribution with outliers at squared residuals (up to a constant)."""
    core = np.exp(-0.5 * residual_sq / variance) / np.sqrt(variance)
    tail = np.exp(-0.5 * residual_sq / (TAIL_FACTOR**2 * variance)) / (TAIL_FACTOR * np.sqrt(variance))
    return np.asarray(np.log((1.0 - TAIL_SHARE) * core + TAIL_SHARE * tail + 1e-300))


def _with_common_error(match: FrameIdentification, refinement: Refinement) -> FrameIdentification:
    """The identification repeated with the common error estimated from the residuals, and a doubt that reports it."""
    sigma = common_star_error(match)
    repeated = identify_frame(match.measured, match.stars.with_error(sigma), match.placement, refinement)
    text = (
        f"doubt: {match.stars.name}: it has no position errors; {sigma:.2g} arcsec on each axis was assumed, estimated "
        "from the residuals; "
    )
    return replace(repeated, notes=(*repeated.notes, Message(text, naming("give {sigma:ARCSEC} or {sigma:COLUMN}"))))


def footprint(pointing: Pointing, shape: tuple[int, int], room: float = ROOM) -> Cone:
    """The cone around a frame, with a radius larger by the factor ``room``."""
    rows, columns = shape
    corners = np.array([[0.0, 0.0], [columns - 1.0, 0.0], [0.0, rows - 1.0], [columns - 1.0, rows - 1.0]])
    middle = pointing.to_sky(np.array([[(columns - 1) / 2.0, (rows - 1) / 2.0]]))[0]
    chord = np.linalg.norm(pointing.to_sky(corners) - middle, axis=1).max()
    ra, dec = directions_deg(middle)
    return Cone(float(ra), float(dec), min(room * chord_angle_deg(float(chord)), 180.0))


def hints_by_field(hints: Sequence[Hint], shape: tuple[int, int]) -> list[list[Hint]]:
    """The hints in lists, each of one part of the sky, so that no catalogue is read between distant directions."""
    lists: list[list[Hint]] = []
    for hint in hints:
        cone = search_cone([hint], shape)
        for near in lists:
            other = search_cone(near[:1], shape)
            if cone is None or other is None or cone.touches(other):
                near.append(hint)
                break
        else:
            lists.append([hint])
    return lists


def search_cone(hints: Sequence[Hint], shape: tuple[int, int], room: float = ROOM) -> Cone | None:
    """A cone around all directions allowed by the hints; None for the whole sky."""
    cones = []
    for hint in hints:
        if isinstance(hint, AllSky):
            return None
        if isinstance(hint, ApproximateWcs):
            frame = footprint(Pointing.of_wcs(hint.wcs, shape), shape, room)
            uncertainty_deg = hint.radius_deg if hint.radius_deg is not None else 0.5 * frame.radius_deg
            cones.append(replace(frame, radius_deg=frame.radius_deg + uncertainty_deg))
        else:
            half = 0.5 * math.hypot(*shape) * hint.scale_arcsec[1] / 3600.0
            cones.append(Cone(hint.ra_deg, hint.dec_deg, hint.radius_deg + room * half))
    middle = np.sum([cone.direction for cone in cones], axis=0)
    ra, dec = directions_deg(middle)
    centre = Cone(float(ra), float(dec), 0.0)
    distance_deg = [chord_angle_deg(float(np.linalg.norm(cone.direction - centre.direction))) for cone in cones]
    radius = max(uncertainty_deg + cone.radius_deg for uncertainty_deg, cone in zip(distance_deg, cones, strict=True))
    return replace(centre, radius_deg=min(radius, 180.0))
