"""The model of what moves: rates, brightness, how often it is seen again; and the surroundings it is seen in."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import betaln

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.ragged import places_in
from sameas.representation import in_short
from sameas.sky.movers.detections import Detections
from sameas.sky.movers.rates import (
    ECLIPTIC_POLE,
    SOLAR_SYSTEM,
    EclipticAxes,
    RateDensity,
    ecliptic_longitude_deg,
    reference_rate,
    sun_longitude_deg,
)
from sameas.space import ARCSEC_PER_RADIAN


@dataclass(frozen=True)
class Tuning:
    """How movers are searched.

    Attributes
    ----------
    fastest_arcsec_per_min : nothing faster is searched.
    least_log_ratio : two detections of less ln λ begin no track; links of more may join one.
    least_supported : the same of two that a third one lies in line with; it adds ten and more.
    links : most links that a detection has to later ones, the best of them.
    tracks : most tracks that end at one detection and are grown further, the best of them; of two detections, of two
        far apart, and of more, so many each.
    far_pairs : among so many detections that chance makes more than ``links``, pairs of two exposures are tried that a
        third detection lies in line with, so many at most. far_sigmas : in line, to so many standard deviations.
    misses : a track may pass over so many exposures in a row that saw its place, but not it.
    neighbours : the density around a detection is that of so many others of its exposure.
    wide, crowded : where detections are denser than ``crowded`` times the density of ``wide`` times as many neighbours,
        movers are no denser, for they do not crowd as false ones do; less is chance.
    bend_arcsec_per_min2, bend_rate : 1σ of the acceleration of a mover as slow as the second, arcsec/min; of faster,
        nearer ones in proportion. From the diurnal parallax at 1 au: 8.8″ (2π/1436 min)².
    outlier, outlier_scale : share of detections whose error is so many times the quoted one.
    variability_mag : 1σ of the change of brightness between two exposures, beside the errors.
    odd_brightness : share of detections whose brightness says nothing (blends, wrong bands).
    no_trail : share of the detections of fast movers whose trail is not measured.
    trail_range : trails of no common rate differ in length by so many e-folds, evenly in ln length.
    evenness : how alike movers are in how many exposures show them: the share of each is drawn from a Beta distribution
        of so many counts, for bright ones are shown nearly always, faint ones seldom.
    around : so many exposures before and after a track are asked whether they saw where it then was. least_ended : of
        tracks of more ln w.
    least_competing : tracks of less ln w do not compete for detections. Among many false detections chance makes ten
        to thirty of them for each of more, which change no probability by a hundredth.
    sure : tracks of another by one detection less, whose last one adds more than this to ln w, do not compete.
    """

    fastest_arcsec_per_min: float = 60.0
    least_log_ratio: float = -6.0
    least_supported: float = -20.0
    links: int = 12
    tracks: int = 8
    far_pairs: float = 3e5
    far_sigmas: float = 4.0
    misses: int = 4
    neighbours: int = 8
    wide: int = 10
    crowded: float = 2.0
    bend_arcsec_per_min2: float = 1.7e-4
    bend_rate: float = 0.5
    outlier: float = 0.02
    outlier_scale: float = 4.0
    variability_mag: float = 0.12
    odd_brightness: float = 0.05
    no_trail: float = 0.15
    trail_range: float = 3.0
    evenness: float = 2.0
    around: int = 8
    least_ended: float = -4.0
    least_competing: float = -6.0
    sure: float = 12.0


DEFAULT_TUNING = Tuning()


@in_short
@dataclass(frozen=True)
class MotionModel:
    """What is believed of movers.

    rates : their density. log_odds : ln of the odds with which a detection has a next one, before the evidence.
    log_begin : ln of the number of movers in the field for each detection of an exposure.
    p_detect : probability that an exposure that saw the place of a mover shows it.
    colour : (b, b) mean change of magnitude from a band to another; colour_sigma : (b, b) its spread beside the errors.
    """

    rates: RateDensity = SOLAR_SYSTEM
    log_odds: float = -4.0
    log_begin: float = -4.0
    p_detect: float = 0.7
    bands: tuple[str, ...] = ()
    colour: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    colour_sigma: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def for_bands(self, bands: tuple[str, ...], tuning: Tuning = DEFAULT_TUNING) -> MotionModel:
        """The model with the bands of some detections in their order; unknown ones may differ by a magnitude."""
        if bands == self.bands:
            return self
        n = len(bands)
        colour, sigma = np.zeros((n, n)), np.full((n, n), 1.0)
        for a, one in enumerate(bands):
            for b, other in enumerate(bands):
                if one in self.bands and other in self.bands:
                    at = self.bands.index(one), self.bands.index(other)
                    colour[a, b], sigma[a, b] = self.colour[at], self.colour_sigma[at]
                elif a == b:
                    sigma[a, b] = tuning.variability_mag
        return replace(self, bands=bands, colour=colour, colour_sigma=sigma)

    def log_pattern(self, shown: IntArray, saw: IntArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(k,) ln of the probability that of the exposures that saw a mover's place those show it that do.

        shown : so many show it. saw : so many saw its place. The share that shows it differs from mover to mover as a
        Beta distribution does (beta-binomial), so that a mover that was missed often is missed again.
        """
        a, b = tuning.evenness * self.p_detect, tuning.evenness * (1.0 - self.p_detect)
        return np.asarray(betaln(shown + a, np.maximum(saw - shown, 0) + b) - betaln(a, b))

    def tracked(self, saw: IntArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        """(k,) share of the movers, whose place so many exposures saw, that enough of them show to teach."""
        none, one, two = (np.exp(self.log_pattern(np.full_like(saw, k), saw, tuning)) for k in (0, 1, 2))
        few = np.where(fewest_shown(saw) > 2, 0.5 * saw * (saw - 1) * two, 0.0)
        return np.asarray(1.0 - none - saw * one - few)


def fewest_shown(saw: IntArray) -> IntArray:
    """(k,) detections of a track that teaches: three, and two where no more exposures saw its place."""
    return np.clip(saw, 2, 3)


@dataclass(frozen=True)
class Surroundings:
    """Where the detections are, what is around them, and which exposures saw their places.

    detections, axes : of all. minutes : (n,) since the first. covariance : (n, 2, 2) on the ecliptic axes.
    log_density : (n,) ln of the detections per arcsec² of the same exposure around each.
    log_crowding : (n,) ln of how many times denser they are there than chance makes them, by what is farther around.
    reference : (n,) rate in longitude of a circular orbit there, arcsec/min.
    log_brightness : (n,) ln of the density per magnitude of detections as bright in its band, NaN where not measured.
    coverage : which exposures saw which cell of the sky. cell : (n,) that of each detection.
    trail : (n, 2) rate that the trail shows, arcsec/min on these axes, either way; NaN without one.
    """

    detections: Detections
    axes: EclipticAxes
    minutes: FloatArray
    covariance: FloatArray
    log_density: FloatArray
    log_crowding: FloatArray
    reference: FloatArray
    log_brightness: FloatArray
    coverage: Coverage
    cell: IntArray
    trail: FloatArray

    @classmethod
    def of(cls, detections: Detections, tuning: Tuning = DEFAULT_TUNING) -> Surroundings:
        """Those of some detections."""
        axes = detections.axes()
        minutes = (detections.mjd_utc - detections.mjd_utc.min()) * 1440.0
        elongation = axes.longitude_deg - sun_longitude_deg(detections.mjd_utc)
        density, wide = _densities(detections, axes, (tuning.neighbours, tuning.wide * tuning.neighbours))
        coverage = Coverage.of(detections, axes, density)
        return cls(
            detections, axes, minutes, axes.rotated(detections.covariance), np.log(density),
            np.log(np.maximum(density / (tuning.crowded * wide), 1.0)), reference_rate(elongation),
            _brightness(detections), coverage, coverage.cell(axes.unit), _trail(detections, axes),
        )  # fmt: skip

    def misses(self, i: IntArray, j: IntArray) -> IntArray:
        """(m,) how many exposures between those of i and j saw the place of i."""
        frame, before = self.detections.frame, self.coverage.before
        return np.maximum(before[self.cell[i], frame[j]] - before[self.cell[i], frame[i] + 1], 0)


def _trail(detections: Detections, axes: EclipticAxes) -> FloatArray:
    if detections.trail is None:
        return np.full((len(detections), 2), np.nan)
    cos, sin = axes.turn.T
    east, north = detections.trail.arcsec_per_min.T
    return np.column_stack([cos * east + sin * north, cos * north - sin * east])


def _densities(detections: Detections, axes: EclipticAxes, neighbours: tuple[int, ...]) -> list[FloatArray]:
    """(n,) detections per arcsec² of the same exposure around each, itself counted, by each number of neighbours."""
    order = np.argsort(detections.frame, kind="stable")
    bounds = np.searchsorted(detections.frame[order], np.arange(len(detections.frame_names) + 1))
    out = [np.full(len(detections), np.nan) for _ in neighbours]
    for a, b in itertools.pairwise(bounds.tolist()):
        if b - a > 2:
            at = axes.unit[order[a:b]]
            numbers = [min(k, b - a - 1) for k in neighbours]
            reach = cKDTree(at).query(at, [k + 1 for k in numbers])[0] * ARCSEC_PER_RADIAN
            for density, k, radius in zip(out, numbers, reach.T, strict=True):
                # The k-th neighbour bounds an area in which k − 1 others lie, on average over places (Poisson).
                density[order[a:b]] = k / (math.pi * np.maximum(radius, 1.0) ** 2)
    rest = np.isnan(out[0])
    if rest.any():
        whole = axes.unit
        spread = float(np.linalg.norm(whole - whole.mean(axis=0), axis=1).max()) * ARCSEC_PER_RADIAN
        size = np.bincount(detections.frame)[detections.frame[rest]]
        for density in out:
            density[rest] = size / (math.pi * max(spread, 60.0) ** 2)
    return out


def _brightness(detections: Detections) -> FloatArray:
    """(n,) ln of the density per magnitude of detections as bright in the same band."""
    out = np.full(len(detections), np.nan)
    for band in range(len(detections.bands)):
        here = np.flatnonzero((detections.band == band) & np.isfinite(detections.magnitude))
        if len(here) < 2:
            continue
        values = detections.magnitude[here]
        low, high = np.floor(values.min()) - 1.0, np.ceil(values.max()) + 1.0
        counts, edges = np.histogram(values, np.linspace(low, high, int((high - low) * 10) + 1))
        kernel = np.exp(-0.5 * (np.arange(-9, 10) / 3.0) ** 2)
        smooth = np.convolve(counts + 0.05, kernel / kernel.sum(), mode="same")
        middle = 0.5 * (edges[1:] + edges[:-1])
        density = smooth / (smooth.sum() * (edges[1] - edges[0]))
        out[here] = np.log(np.interp(values, middle, density))
    return out


@dataclass(frozen=True)
class Coverage:
    """Which exposures saw which cell of the sky.

    An exposure saw a cell if it has a detection there or in one of the eight cells around. The cells are so large that
    three times three hold five detections of a typical exposure.

    side_deg : of a cell. key : (c,) ascending, of the cells with a detection. before : (c, frames+1) number of the
    exposures before each that saw the cell.
    """

    side_deg: float
    key: IntArray
    before: IntArray

    @classmethod
    def of(cls, detections: Detections, axes: EclipticAxes, density: FloatArray) -> Coverage:
        """That of some detections; density : (n,) per arcsec² of their exposures."""
        side = math.sqrt(5.0 / 9.0 / float(np.median(density))) / 3600.0
        row, longitude = _rows(axes.unit, side)
        key = np.unique(_keys(row, longitude, side))
        saw = np.zeros((len(key), len(detections.frame_names) + 1), np.int64)
        for drow in (-1, 0, 1):
            # Rows of another latitude have another number of cells.
            for dcolumn in (-1, 0, 1):
                at = places_in(key, _keys(row + drow, longitude, side, dcolumn))
                saw[at[at >= 0], detections.frame[at >= 0] + 1] = 1
        return cls(side, key, np.cumsum(saw, axis=1))

    def cell(self, unit: FloatArray) -> IntArray:
        """(n,) the cell of each direction (n, 3), −1 where none has a detection."""
        key = _keys(*_rows(unit, self.side_deg), self.side_deg)
        return places_in(self.key, key)

    def saw(self, unit: FloatArray, frame: IntArray) -> BoolArray:
        """(n,) whether an exposure saw each direction (n, 3)."""
        cell = self.cell(unit)
        return np.asarray((cell >= 0) & (self.before[cell, frame + 1] > self.before[cell, frame]))


def _rows(unit: FloatArray, side_deg: float) -> tuple[IntArray, FloatArray]:
    """(n,) the row of cells in ecliptic latitude, and the longitude in degrees, of directions (n, 3)."""
    row = np.floor((np.degrees(np.arcsin(np.clip(unit @ ECLIPTIC_POLE, -1, 1))) + 90.0) / side_deg).astype(np.int64)
    return row, ecliptic_longitude_deg(unit)


def _keys(row: IntArray, longitude_deg: FloatArray, side_deg: float, beside: int = 0) -> IntArray:
    """(n,) numbers of cells of rows at some longitudes, or of those so many columns beside them."""
    across = np.maximum(1, np.floor(360.0 * np.cos(np.radians((row + 0.5) * side_deg - 90.0)) / side_deg))
    column = np.floor(longitude_deg / 360.0 * across).astype(np.int64) + beside
    stride = math.ceil(360.0 / side_deg) + 3
    return np.asarray((row + 1) * stride + column + 1)
