"""Identify and refine: which star each measurement is, and the plate model, each from the other until both rest.

Stars are predicted on the frame with their errors and those of the plate model; measurements and predictions are
identified in pixels (:func:`sameas.estimate.match`); the plate is fitted again to all candidate pairs, each with
its probability. Stars so faint that the frame shows none of them are no candidates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.estimate.match import Estimate, match
from sameas.evidence import Magnitudes
from sameas.records import Records
from sameas.result import Identification
from sameas.sky.frame.field import StarField
from sameas.sky.frame.measurements import Flag, Measurements
from sameas.sky.frame.photometry import Completeness, ZeroPoint
from sameas.sky.frame.place import Placement
from sameas.sky.frame.plate import MatchedStars, PlateModel, fit_plate

#: Magnitudes of a relative error of one.
POGSON = 2.5 / math.log(10.0)
#: Stars predicted outside the frame by less than this, px, may be measured on its edge (chosen).
MARGIN_PX = 2.0
#: Pairs less probable than this are not used for the plate (chosen).
LEAST_WEIGHT = 0.02
#: A first plate of more pairs than this may be of higher order than linear (chosen).
SURE_OF_ORDER = 30
#: Stars that the frame shows with less than this probability are no candidates.
UNSEEN = 0.01
#: Stars that the frame shows with at least this probability are missing when they are not found.
EXPECTED = 0.5


@dataclass(frozen=True)
class Refinement:
    """How the loop goes.

    order : of the plate's polynomial, 1 … 5, None for the one of least BIC. rounds : at most so many.
    settled_px : the loop rests when no prediction moves farther.
    magnitudes : "auto" takes brightness as evidence, once the places agree and where the catalogue knows it; "off".
    """

    order: int | None = None
    rounds: int = 8
    settled_px: float = 0.01
    magnitudes: Literal["auto", "off"] = "auto"


@dataclass(frozen=True)
class FrameIdentification:
    """A frame identified with a catalogue. Rows of ``result`` are rows of ``measured`` and of ``stars``.

    Attributes
    ----------
    measured : the measurements. stars : those of the field at the frame's epoch; the ones beyond the frame, and
        those far too faint, were no candidates.
    placement : where the search started. plate : the refined plate model.
    result, estimate : the identification in pixels, measurements first.
    predicted_px : (m, 2) where the plate sees each star; predicted_covariance : (m, 3) of it, px².
    candidate : (m,) the stars that took part.
    zero_point, completeness : of brightness, None where nothing is known of it.
    rounds, settled : of the loop. notes : what a user should know.
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
    rounds: int
    settled: bool
    notes: tuple[str, ...] = ()

    @property
    def pairs(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Rows of the measurements, rows of the stars, and probabilities of the identified pairs."""
        found = self.result.matches
        return found.rows_1, found.rows_2, found.p_match

    @cached_property
    def inside(self) -> BoolArray:
        """(m,) whether each star is predicted within the frame, where one can be measured."""
        return _seeable(self.predicted_px, self.measured, 0.0)

    @cached_property
    def p_detect(self) -> FloatArray:
        """(m,) the probability that the frame shows each star; where no magnitudes are known the same for all."""
        if self.completeness is not None:
            return self.completeness(self.stars.magnitude)
        return np.full(len(self.stars), self.estimate.share_2)

    @cached_property
    def missing(self) -> IntArray:
        """Rows of the stars: stars that the frame should show and that no measurement is identified with."""
        found = np.zeros(len(self.stars), np.bool_)
        found[self.pairs[1]] = True
        return np.flatnonzero(self.inside & ~found & (self.p_detect >= EXPECTED))

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

    @property
    def scatter_arcsec(self) -> FloatArray:
        """(2,) robust standard deviation (1.4826 · median |Δ|) of the residuals east and north."""
        left = self.residual_arcsec
        if not len(left):
            return np.full(2, np.nan)
        return np.asarray(1.4826 * np.median(np.abs(left - np.median(left, axis=0)), axis=0))


def identify_frame(
    measured: Measurements, stars: StarField, placement: Placement, refinement: Refinement | None = None
) -> FrameIdentification:
    """A placed frame identified with the stars of its field, and its plate refined.

    Parameters
    ----------
    measured : the measurements. stars : the field, at the frame's epoch; the placement's star rows are its rows.
    placement : where the frame points. refinement : how the loop goes.

    Raises
    ------
    InputError : too few pairs for a plate model; nothing of the catalogue is on the frame.

    Example: ``identify_frame(measurements, stars, placement).plate.describe()``.
    """
    how = refinement or Refinement()
    first, faintest = measured.records(), None
    plate = _first_plate(measured, stars, placement, how)
    px, covariance = _predicted(plate, stars)
    for rounds in range(1, how.rounds + 1):
        candidate = _candidates(px, stars, measured, faintest)
        # Brightness would hold wrong pairs of the first plate as fast as right ones.
        bright = None if rounds == 1 or how.magnitudes == "off" else _brightness(measured, stars)
        result, estimate = match(first, _records(px, covariance, candidate, stars), brightness=bright)
        completeness = _completeness(px, stars, result, measured)
        if completeness is not None:
            faintest = completeness.faintest(UNSEEN)
        plate = fit_plate(_matched(measured, stars, result), placement.pointing, measured.shape, order=how.order)
        before, inside = px, _within(px, measured.shape, 0.0)
        px, covariance = _predicted(plate, stars)
        settled = bool(np.nanmax(np.abs(px - before)[inside], initial=0.0) < how.settled_px)
        if settled and rounds > 1:
            break
    i, j = result.matches.rows_1, result.matches.rows_2
    zero = ZeroPoint.of(measured.flux[i], stars.magnitude[j], stars.colour[j], result.matches.p_match)
    notes = _notes(result, estimate, plate, settled)
    return FrameIdentification(
        measured, stars, placement, plate, result, estimate, px, covariance, candidate, zero, completeness, rounds,
        settled, notes,
    )  # fmt: skip


def _first_plate(measured: Measurements, stars: StarField, placement: Placement, how: Refinement) -> PlateModel:
    """The plate of the pairs that the placement stands on."""
    i, j = placement.rows_measured, placement.rows_stars
    pairs = _pairs(measured, stars, i, j, np.ones(len(i)))
    return fit_plate(pairs, placement.pointing, measured.shape, order=None if len(i) > SURE_OF_ORDER else 1)


def _matched(measured: Measurements, stars: StarField, result: Identification) -> MatchedStars:
    """All candidate pairs that say something of the plate, with their probabilities."""
    telling = np.flatnonzero(result.p_pair >= LEAST_WEIGHT)
    p = np.minimum(result.p_pair[telling], 1.0)
    return _pairs(measured, stars, result.rows_1[telling], result.rows_2[telling], p)


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


def _seeable(px: FloatArray, measured: Measurements, margin_px: float) -> BoolArray:
    """(m,) whether pixels lie on the frame, or not farther outside than a margin, and not where it is blind."""
    seen = _within(px, measured.shape, margin_px)
    if measured.blind is not None:
        rows, columns = measured.shape
        x, y = np.rint(np.nan_to_num(px)).astype(np.int64).T
        seen &= ~measured.blind[np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)]
    return seen


def _candidates(px: FloatArray, stars: StarField, measured: Measurements, faintest: float | None) -> BoolArray:
    """(m,) stars on the frame that are not too faint to be seen."""
    candidate = _seeable(px, measured, MARGIN_PX)
    if faintest is not None:
        candidate &= ~(stars.magnitude > faintest)
    if not candidate.any():
        raise InputError(f"{stars.name}: none of its stars lies on the frame; does the catalogue cover the field?")
    return candidate


def _records(px: FloatArray, covariance: FloatArray, candidate: BoolArray, stars: StarField) -> Records:
    """The candidates in pixels; their rows are those of the stars."""
    rows = np.flatnonzero(candidate)
    return Records(px[rows], covariance[rows], rows, stars.ids, source=stars.name)


def _brightness(measured: Measurements, stars: StarField) -> tuple[Magnitudes, Magnitudes] | None:
    """Instrumental magnitudes and those of the stars; None where the catalogue has none.

    The light of what is saturated, cut or not of a star's form says nothing.
    """
    if not np.isfinite(stars.magnitude).any():
        return None
    usable = measured.clean(Flag.BLENDED) & (measured.flux > 0.0)
    flux = np.where(usable, measured.flux, np.nan)
    shown = Magnitudes(-2.5 * np.log10(flux), POGSON * measured.flux_err / flux, ("instrumental",))
    return shown, Magnitudes(stars.magnitude, names=("catalogue",))


def _completeness(
    px: FloatArray, stars: StarField, result: Identification, measured: Measurements
) -> Completeness | None:
    """The share of the stars on the frame that is found, by magnitude."""
    p_found = np.zeros(len(stars))
    np.add.at(p_found, result.rows_2, result.p_pair)
    inside = _seeable(px, measured, -MARGIN_PX)
    return Completeness.of(stars.magnitude[inside], p_found[inside]) if inside.any() else None


def _notes(result: Identification, estimate: Estimate, plate: PlateModel, settled: bool) -> tuple[str, ...]:
    notes = list(estimate.notes)
    if not settled:
        notes.append("identification and plate had not settled when the rounds ran out")
    if plate.error_scale > 3.0:
        notes.append(f"the stars lie {plate.error_scale:.1f} times farther from the plate model than their errors say")
    if result.approximate_pairs:
        notes.append(f"{result.approximate_pairs} candidates lie in entangled groups; their probabilities are near")
    return tuple(notes)
