"""The model of movers (rates, brightness, detection probability) and the surroundings of the detections."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import betaln

from sameas.arrays import BoolArray, FloatArray, IntArray, places_in
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

NEIGHBOURS = 8  # number of neighbours of the same exposure for the density around a detection
#: Where the density exceeds CROWDED times that of WIDE times as many neighbours, movers are not assumed denser too:
#: false detections cluster, movers do not. A smaller excess is chance.
WIDE, CROWDED = 10, 2.0
#: The acceleration of movers is that of the tuning at this rate, arcsec/min, and below; proportional to the rate above.
BEND_RATE = 0.5
OUTLIER, OUTLIER_SCALE = 0.02, 4.0  # share of outliers, and the factor on their errors
VARIABILITY_MAG = 0.12  # 1σ of the intrinsic change of magnitude between two exposures
#: Counts of the Beta distribution of detection probabilities among movers: bright ones are detected nearly always,
#: faint ones seldom.
BETA_COUNTS = 2.0


@dataclass(frozen=True)
class Tuning:
    """Parameters of the search for movers that may be changed; others are constants beside their use.

    min_log_ratio : minimum ln λ of a link that starts or extends a track.
    tracks : maximum number of tracks kept per last detection, the best ones, for each of three kinds: two detections,
        two far apart, and more than two.
    bend_arcsec_per_min2 : 1σ of the acceleration of movers at ``BEND_RATE``. From the diurnal parallax at 1 au: 8.8″
        (2π/1436 min)².
    min_competing : minimum ln w of the tracks that compete for detections. Among many false detections there are ten
        to thirty chance tracks below it for each one above, and they change no probability by 0.01.
    certain_gain : a track does not compete if its extension by one detection gains more than this in ln w.
    pairs_at_once : pairs per chunk, which bounds the memory.
    """

    min_log_ratio: float = -6.0
    tracks: int = 8
    bend_arcsec_per_min2: float = 1.7e-4
    min_competing: float = -6.0
    certain_gain: float = 12.0
    pairs_at_once: int = 200_000


DEFAULT_TUNING = Tuning()


@in_short
@dataclass(frozen=True)
class MotionModel:
    """The prior model of movers.

    rates : density of rates. log_odds : ln of the prior odds that a detection has a next one.
    log_begin : ln of the number of movers per detection of an exposure.
    p_detect : probability that an exposure that covers a mover's position detects it.
    colour : (b, b) mean difference of magnitude between bands; colour_sigma : (b, b) its intrinsic scatter.
    """

    rates: RateDensity = SOLAR_SYSTEM
    log_odds: float = -4.0
    log_begin: float = -4.0
    p_detect: float = 0.7
    bands: tuple[str, ...] = ()
    colour: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    colour_sigma: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def for_bands(self, bands: tuple[str, ...]) -> MotionModel:
        """The model for the given bands in their order; the scatter between unknown bands is 1 mag."""
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
                    sigma[a, b] = VARIABILITY_MAG
        return replace(self, bands=bands, colour=colour, colour_sigma=sigma)

    def log_pattern(self, n_detected: IntArray, n_covered: IntArray) -> FloatArray:
        """(k,) ln of the probability of a mover's pattern of detections and misses (beta-binomial).

        n_detected : (k,) number of exposures with a detection. n_covered : (k,) of exposures that covered its position.
        The detection probability varies between movers (Beta distribution): one missed often is likely missed again.
        """
        a, b = BETA_COUNTS * self.p_detect, BETA_COUNTS * (1.0 - self.p_detect)
        return np.asarray(betaln(n_detected + a, np.maximum(n_covered - n_detected, 0) + b) - betaln(a, b))

    def tracked(self, n_covered: IntArray) -> FloatArray:
        """(k,) share of movers with enough detections for training, among those covered by ``n_covered`` exposures."""
        none, one, two = (np.exp(self.log_pattern(np.full_like(n_covered, k), n_covered)) for k in (0, 1, 2))
        few = np.where(min_detected(n_covered) > 2, 0.5 * n_covered * (n_covered - 1) * two, 0.0)
        return np.asarray(1.0 - none - n_covered * one - few)


def min_detected(n_covered: IntArray) -> IntArray:
    """(k,) minimum detections of a track used for training: three, or two if no more exposures covered its position."""
    return np.clip(n_covered, 2, 3)


@dataclass(frozen=True)
class Surroundings:
    """The detections with their local densities and the coverage of the sky by the exposures.

    detections, axes : of all. minutes : (n,) since the first. covariance : (n, 2, 2) on the ecliptic axes.
    log_density : (n,) ln of the local density of detections of the same exposure, per arcsec².
    log_crowding : (n,) ln of the excess of this density over the wider surroundings, 0 if not significant.
    reference : (n,) rate in longitude of a circular orbit there, arcsec/min.
    log_brightness : (n,) ln of the density per magnitude at its magnitude in its band, NaN where not measured.
    coverage : which exposures cover which cell of the sky. cell : (n,) the cell of each detection.
    trail : (n, 2) rate by the trail, arcsec/min on these axes, of either sign; NaN without one.
    tuning : of the search among them.
    """

    detections: Detections
    axes: EclipticAxes
    minutes: FloatArray
    covariance: FloatArray
    log_density: FloatArray
    log_crowding: FloatArray
    reference: FloatArray
    log_brightness: FloatArray
    coverage: ExposureCoverage
    cell: IntArray
    trail: FloatArray
    tuning: Tuning = DEFAULT_TUNING

    @classmethod
    def of(cls, detections: Detections, tuning: Tuning = DEFAULT_TUNING) -> Surroundings:
        """The surroundings of some detections."""
        axes = detections.axes()
        minutes = (detections.mjd_utc - detections.mjd_utc.min()) * 1440.0
        elongation = axes.longitude_deg - sun_longitude_deg(detections.mjd_utc)
        density, wide = _densities(detections, axes, (NEIGHBOURS, WIDE * NEIGHBOURS))
        coverage = ExposureCoverage.of(detections, axes, density)
        return cls(
            detections=detections, axes=axes, minutes=minutes, covariance=axes.rotated(detections.covariance),
            log_density=np.log(density), log_crowding=np.log(np.maximum(density / (CROWDED * wide), 1.0)),
            reference=reference_rate(elongation), log_brightness=_brightness(detections), coverage=coverage,
            cell=coverage.cell(axes.unit), trail=_trail(detections, axes), tuning=tuning,
        )  # fmt: skip

    def misses(self, i: IntArray, j: IntArray) -> IntArray:
        """(m,) number of exposures between those of i and j that covered the position of i."""
        frame, before = self.detections.frame, self.coverage.before
        return np.maximum(before[self.cell[i], frame[j]] - before[self.cell[i], frame[i] + 1], 0)


def _trail(detections: Detections, axes: EclipticAxes) -> FloatArray:
    if detections.trail is None:
        return np.full((len(detections), 2), np.nan)
    cos, sin = axes.rotation.T
    east, north = detections.trail.arcsec_per_min.T
    return np.column_stack([cos * east + sin * north, cos * north - sin * east])


def _densities(detections: Detections, axes: EclipticAxes, neighbours: tuple[int, ...]) -> list[FloatArray]:
    """(n,) local density per arcsec² of detections of the same exposure, including itself, per neighbour number."""
    order = np.argsort(detections.frame, kind="stable")
    bounds = np.searchsorted(detections.frame[order], np.arange(len(detections.frame_names) + 1))
    out = [np.full(len(detections), np.nan) for _ in neighbours]
    for a, b in itertools.pairwise(bounds.tolist()):
        if b - a > 2:
            at = axes.unit[order[a:b]]
            numbers = [min(k, b - a - 1) for k in neighbours]
            reach = cKDTree(at).query(at, [k + 1 for k in numbers])[0] * ARCSEC_PER_RADIAN
            for density, k, radius in zip(out, numbers, reach.T, strict=True):
                # The k-th neighbour bounds an area with k − 1 others inside, averaged over positions (Poisson).
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
    """(n,) ln of the smoothed density per magnitude of the same band, at each magnitude."""
    out = np.full(len(detections), np.nan)
    for band in range(len(detections.bands)):
        rows = np.flatnonzero((detections.band == band) & np.isfinite(detections.magnitude))
        if len(rows) < 2:
            continue
        values = detections.magnitude[rows]
        low, high = np.floor(values.min()) - 1.0, np.ceil(values.max()) + 1.0
        counts, edges = np.histogram(values, np.linspace(low, high, int((high - low) * 10) + 1))
        kernel = np.exp(-0.5 * (np.arange(-9, 10) / 3.0) ** 2)
        smooth = np.convolve(counts + 0.05, kernel / kernel.sum(), mode="same")
        middle = 0.5 * (edges[1:] + edges[:-1])
        density = smooth / (smooth.sum() * (edges[1] - edges[0]))
        out[rows] = np.log(np.interp(values, middle, density))
    return out


@dataclass(frozen=True)
class ExposureCoverage:
    """Which exposures cover which cell of the sky.

    An exposure covers a cell if it has a detection there or in one of the eight neighbouring cells. The cell size is
    chosen so that 3 × 3 cells contain five detections of a typical exposure.

    side_deg : of a cell. key : (c,) ascending, of the cells with a detection. before : (c, frames+1) cumulative number
    of exposures that covered the cell, before each exposure.
    """

    side_deg: float
    key: IntArray
    before: IntArray

    @classmethod
    def of(cls, detections: Detections, axes: EclipticAxes, density: FloatArray) -> ExposureCoverage:
        """The coverage of some detections. density : (n,) local densities, per arcsec²."""
        side = math.sqrt(5.0 / 9.0 / float(np.median(density))) / 3600.0
        row, longitude = _rows(axes.unit, side)
        key = np.unique(_keys(row, longitude, side))
        covered = np.zeros((len(key), len(detections.frame_names) + 1), np.int64)
        for drow in (-1, 0, 1):
            # The number of cells depends on the row.
            for dcolumn in (-1, 0, 1):
                at = places_in(key, _keys(row + drow, longitude, side, dcolumn))
                covered[at[at >= 0], detections.frame[at >= 0] + 1] = 1
        return cls(side, key, np.cumsum(covered, axis=1))

    def cell(self, unit: FloatArray) -> IntArray:
        """(n,) the cell of each direction (n, 3), ABSENT for cells without any detection."""
        key = _keys(*_rows(unit, self.side_deg), self.side_deg)
        return places_in(self.key, key)

    def covers(self, unit: FloatArray, frame: IntArray) -> BoolArray:
        """(n,) whether an exposure covers each direction (n, 3)."""
        cell = self.cell(unit)
        return np.asarray((cell >= 0) & (self.before[cell, frame + 1] > self.before[cell, frame]))


def _rows(unit: FloatArray, side_deg: float) -> tuple[IntArray, FloatArray]:
    """(n,) the row of cells in ecliptic latitude, and the longitude in degrees, of directions (n, 3)."""
    row = np.floor((np.degrees(np.arcsin(np.clip(unit @ ECLIPTIC_POLE, -1, 1))) + 90.0) / side_deg).astype(np.int64)
    return row, ecliptic_longitude_deg(unit)


def _keys(row: IntArray, longitude_deg: FloatArray, side_deg: float, shift: int = 0) -> IntArray:
    """(n,) keys of the cells at rows and longitudes, shifted by ``shift`` columns."""
    across = np.maximum(1, np.floor(360.0 * np.cos(np.radians((row + 0.5) * side_deg - 90.0)) / side_deg))
    column = np.floor(longitude_deg / 360.0 * across).astype(np.int64) + shift
    stride = math.ceil(360.0 / side_deg) + 3
    return np.asarray((row + 1) * stride + column + 1)
