"""The model of what moves: rates, brightness, how often it is seen again; and the surroundings it is seen in."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import FloatArray, IntArray
from sameas.representation import in_short
from sameas.sky.movers.detections import Detections
from sameas.space import ARCSEC_PER_RADIAN

# Rates: how fast what moves on the sky moves, as a density in ecliptic axes, learned from the data.
#
# The rate is told against that of a circular orbit in the ecliptic at 2.7 au, seen at the same elongation from the Sun:
# most asteroids then make one narrow component, whatever part of the sky is observed. A mixture of Gaussians convolves
# with the error of a measured rate in closed form (extreme deconvolution, Bovy, Hogg & Roweis 2011, AnnAS 5, 1657).

#: Angular speed of the Earth about the Sun, arcsec per minute (Gauss's constant).
_EARTH_ARCSEC_PER_MIN = 0.01720209895 * ARCSEC_PER_RADIAN / 1440.0
#: Obliquity of the ecliptic of J2000, degrees (IAU 1976).
_TILT = math.radians(23.4392911)
#: Direction of the pole of the ecliptic, ICRS.
ECLIPTIC_POLE = np.array([0.0, -math.sin(_TILT), math.cos(_TILT)])


def sun_longitude_deg(mjd: FloatArray) -> FloatArray:
    """Ecliptic longitude of the Sun, good to 0.4° over a century (Astronomical Almanac, low-precision formula)."""
    days = np.asarray(mjd) - 51544.5
    anomaly = np.radians(357.528 + 0.9856003 * days)
    # The mean longitude counts from the equinox of date, directions here from that of J2000: 0.0000382° a day.
    return (280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly) - 3.82e-5 * days) % 360.0


def reference_rate(elongation_deg: FloatArray, au: float = 2.7) -> FloatArray:
    """Rate in ecliptic longitude, arcsec/min, of a circular orbit in the ecliptic; elongation east of the Sun."""
    angle = np.radians(elongation_deg)
    cos, sin = np.cos(angle), np.sin(angle)
    distance = cos + np.sqrt(cos**2 + au**2 - 1.0)
    # The Sun at (1, 0) from the Earth, so that the Earth moves along −y.
    x, y = distance * cos - 1.0, distance * sin
    vx, vy = -y / au**1.5, x / au**1.5 + 1.0
    return np.asarray(_EARTH_ARCSEC_PER_MIN * (vy * cos - vx * sin) / distance)


@dataclass(frozen=True)
class EclipticAxes:
    """Directions and the axes of ecliptic longitude and latitude at them.

    unit, east, north : (n, 3) vectors of each direction and along growing longitude and latitude.
    turn : (n, 2) cosine and sine of the angle that turns (east, north) of the equator into these.
    """

    unit: FloatArray
    east: FloatArray
    north: FloatArray
    turn: FloatArray
    longitude_deg: FloatArray

    @classmethod
    def of(cls, ra_deg: FloatArray, dec_deg: FloatArray) -> EclipticAxes:
        """Of ICRS directions, (n,) each."""
        ra, dec = np.radians(ra_deg), np.radians(dec_deg)
        unit = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
        east = np.cross(ECLIPTIC_POLE, unit)
        east /= np.maximum(np.linalg.norm(east, axis=1, keepdims=True), 1e-12)
        north = np.cross(unit, east)
        east_equator = np.column_stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)])
        north_equator = np.cross(unit, east_equator)
        turn = np.column_stack([(east * east_equator).sum(1), (east * north_equator).sum(1)])
        y = unit[:, 1] * math.cos(_TILT) + unit[:, 2] * math.sin(_TILT)
        return cls(unit, east, north, turn, np.degrees(np.arctan2(y, unit[:, 0])) % 360.0)

    def offsets(self, origin: np.ndarray, other: np.ndarray) -> FloatArray:
        """(m, 2) places on the tangent plane at some directions of others, arcsec along longitude and latitude."""
        to = self.unit[other]
        depth = (self.unit[origin] * to).sum(1)
        along = (self.east[origin] * to).sum(1), (self.north[origin] * to).sum(1)
        return ARCSEC_PER_RADIAN * np.column_stack(along) / depth[:, None]

    def rotated(self, covariance: FloatArray) -> FloatArray:
        """(n, 2, 2) covariances (ee, en, nn) of the equator's axes, (n, 3), on these axes."""
        cos, sin = self.turn.T
        ee, en, nn = covariance.T
        xx = cos**2 * ee + 2 * cos * sin * en + sin**2 * nn
        yy = sin**2 * ee - 2 * cos * sin * en + cos**2 * nn
        xy = cos * sin * (nn - ee) + (cos**2 - sin**2) * en
        return np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)

    def to_equator(self, rows: np.ndarray, offsets: FloatArray) -> FloatArray:
        """(m, 2) offsets on these axes at some directions, turned to east and north of the equator."""
        cos, sin = self.turn[rows].T
        x, y = offsets.T
        return np.column_stack([cos * x - sin * y, sin * x + cos * y])


@dataclass(frozen=True)
class RateDensity:
    """A mixture of Gaussians of rates against the reference, arcsec/min along ecliptic longitude and latitude.

    share : (c,). mean : (c, 2). covariance : (c, 2, 2).
    """

    share: FloatArray
    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, share: list[float], mean: list[tuple[float, float]], sigma: list[tuple[float, float]]) -> RateDensity:
        """Of shares, means and standard deviations along both axes."""
        spread = np.zeros((len(share), 2, 2))
        spread[:, [0, 1], [0, 1]] = np.square(sigma)
        return cls(np.asarray(share) / np.sum(share), np.asarray(mean, float), spread)

    def _parts(self, rate: FloatArray, error: FloatArray) -> FloatArray:
        """(m, c) ln of share and density of each component at rates (m, 2) with errors (m, 2, 2)."""
        out = np.empty((len(rate), len(self.share)))
        for c, (share, mean, spread) in enumerate(zip(self.share, self.mean, self.covariance, strict=True)):
            out[:, c] = np.log(share) + log_normal(rate - mean, error + spread)
        return out

    def log_density(self, rate: FloatArray, error: FloatArray) -> FloatArray:
        """(m,) ln of the density per (arcsec/min)² at measured rates (m, 2) with covariances (m, 2, 2)."""
        parts = self._parts(rate, error)
        top = parts.max(axis=1)
        return np.asarray(top + np.log(np.exp(parts - top[:, None]).sum(axis=1)))

    def prior_at(self, rate: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(m, 2), (m, 2, 2): mean and covariance of the components, weighed by what they say of each measured rate."""
        parts = self._parts(rate, error)
        weight = np.exp(parts - parts.max(axis=1, keepdims=True))
        weight /= weight.sum(axis=1, keepdims=True)
        mean = weight @ self.mean
        off = self.mean[None] - mean[:, None]
        spread = np.einsum("mc,cij->mij", weight, self.covariance) + np.einsum("mc,mci,mcj->mij", weight, off, off)
        return mean, spread

    def refined(self, rate: FloatArray, error: FloatArray, weight: FloatArray, *, counts: float) -> RateDensity:
        """One round of expectation and maximisation; the present mixture counts as ``counts`` rates."""
        parts = self._parts(rate, error)
        share = np.exp(parts - parts.max(axis=1, keepdims=True))
        share *= (weight / share.sum(axis=1))[:, None]
        shares, means, spreads = np.empty_like(self.share), np.empty_like(self.mean), np.empty_like(self.covariance)
        for c in range(len(self.share)):
            r, own = share[:, c], self.covariance[c]
            gain = own @ np.linalg.inv(own + error)
            value = self.mean[c] + np.einsum("mij,mj->mi", gain, rate - self.mean[c])
            left = own - gain @ own
            kept = counts * self.share[c]
            total = r.sum() + kept
            means[c] = (r @ value + kept * self.mean[c]) / total
            off = value - means[c]
            spread = np.einsum("m,mi,mj->ij", r, off, off) + np.einsum("m,mij->ij", r, left)
            drift = self.mean[c] - means[c]
            spreads[c] = (spread + kept * (own + np.outer(drift, drift))) / total
            shares[c] = total
        return RateDensity(shares / shares.sum(), means, spreads)


def log_normal(residual: FloatArray, covariance: FloatArray) -> FloatArray:
    """(m,) ln N(residual; 0, covariance) in two dimensions; (m, 2), (m, 2, 2)."""
    a, b, d = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    determinant = a * d - b * b
    x, y = residual[..., 0], residual[..., 1]
    chi = (d * x * x - 2 * b * x * y + a * y * y) / determinant
    return np.asarray(-0.5 * (chi + np.log(determinant)) - np.log(2 * np.pi))


#: What moves, where nothing has been learned: the main belt, its edges, near-Earth objects, satellites. The first
#: three are as ``learn`` finds them on nights of ZTF alerts of March 2021, the others chosen wide.
SOLAR_SYSTEM = RateDensity.of(
    [0.55, 0.35, 0.07, 0.02, 0.01],
    [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],
    [(0.05, 0.07), (0.10, 0.16), (0.25, 0.35), (2.0, 2.0), (15.0, 15.0)],
)


@dataclass(frozen=True)
class Tuning:
    """How movers are searched.

    Attributes
    ----------
    fastest_arcsec_per_min : nothing faster is searched.
    least_log_ratio : two detections of less ln λ begin no track; links of more may join one.
    links : most links that a detection has to later ones, the best of them.
    tracks : most tracks that end at one detection and are grown further, the best of them.
    misses : a track may pass over so many exposures in a row that saw its place, but not it.
    neighbours : the density around a detection is that of so many others of its exposure.
    bend_arcsec_per_min2, bend_rate : 1σ of the acceleration of a mover as slow as the second, arcsec/min; of faster,
        nearer ones in proportion. From the diurnal parallax at 1 au: 8.8″ (2π/1436 min)².
    outlier, outlier_scale : share of detections whose error is so many times the quoted one.
    variability_mag : 1σ of the change of brightness between two exposures, beside the errors.
    odd_brightness : share of detections whose brightness says nothing (blends, wrong bands).
    no_trail : share of the detections of fast movers whose trail is not measured.
    trail_range : trails of no common rate differ in length by so many e-folds, evenly in ln length.
    sure : tracks of another by one detection less, whose last one adds more than this to ln w, do not compete.
    """

    fastest_arcsec_per_min: float = 60.0
    least_log_ratio: float = -6.0
    links: int = 12
    tracks: int = 8
    misses: int = 4
    neighbours: int = 8
    bend_arcsec_per_min2: float = 1.7e-4
    bend_rate: float = 0.5
    outlier: float = 0.02
    outlier_scale: float = 4.0
    variability_mag: float = 0.12
    odd_brightness: float = 0.05
    no_trail: float = 0.15
    trail_range: float = 3.0
    sure: float = 12.0


DEFAULT_TUNING = Tuning()


@in_short
@dataclass(frozen=True)
class MotionModel:
    """What is believed of movers.

    rates : their density. log_odds : ln of the odds with which a detection has a next one, before the evidence.
    p_detect : probability that an exposure that saw the place of a mover shows it.
    colour : (b, b) mean change of magnitude from a band to another; colour_sigma : (b, b) its spread beside the errors.
    """

    rates: RateDensity = SOLAR_SYSTEM
    log_odds: float = -4.0
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


@dataclass(frozen=True)
class Surroundings:
    """Where the detections are, what is around them, and which exposures saw their places.

    detections, axes : of all. minutes : (n,) since the first. covariance : (n, 2, 2) on the ecliptic axes.
    log_density : (n,) ln of the detections per arcsec² of the same exposure around each.
    reference : (n,) rate in longitude of a circular orbit there, arcsec/min.
    log_brightness : (n,) ln of the density per magnitude of detections as bright in its band, NaN where not measured.
    cell : (n,) of the sky. seen : (cells, frames+1) number of the exposures before each that saw the cell.
    trail : (n, 2) rate that the trail shows, arcsec/min on these axes, either way; NaN without one.
    """

    detections: Detections
    axes: EclipticAxes
    minutes: FloatArray
    covariance: FloatArray
    log_density: FloatArray
    reference: FloatArray
    log_brightness: FloatArray
    cell: IntArray
    seen: IntArray
    trail: FloatArray

    @classmethod
    def of(cls, detections: Detections, tuning: Tuning = DEFAULT_TUNING) -> Surroundings:
        """Those of some detections."""
        axes = detections.axes()
        minutes = (detections.mjd_utc - detections.mjd_utc.min()) * 1440.0
        elongation = axes.longitude_deg - sun_longitude_deg(detections.mjd_utc)
        density = _density(detections, axes, tuning.neighbours)
        cell, seen = _coverage(detections, axes, density)
        return cls(
            detections, axes, minutes, axes.rotated(detections.covariance), np.log(density),
            reference_rate(elongation), _brightness(detections), cell, seen, _trail(detections, axes),
        )  # fmt: skip

    def misses(self, i: IntArray, j: IntArray) -> IntArray:
        """(m,) how many exposures between those of i and j saw the place of i."""
        frame = self.detections.frame
        return np.maximum(self.seen[self.cell[i], frame[j]] - self.seen[self.cell[i], frame[i] + 1], 0)


def _trail(detections: Detections, axes: EclipticAxes) -> FloatArray:
    if detections.trail is None:
        return np.full((len(detections), 2), np.nan)
    cos, sin = axes.turn.T
    east, north = detections.trail.arcsec_per_min.T
    return np.column_stack([cos * east + sin * north, cos * north - sin * east])


def _density(detections: Detections, axes: EclipticAxes, neighbours: int) -> FloatArray:
    """(n,) detections per arcsec² of the same exposure around each, itself counted."""
    order = np.argsort(detections.frame, kind="stable")
    bounds = np.searchsorted(detections.frame[order], np.arange(len(detections.frame_names) + 1))
    out = np.full(len(detections), np.nan)
    for a, b in itertools.pairwise(bounds.tolist()):
        if b - a > 2:
            k = min(neighbours, b - a - 1)
            at = axes.unit[order[a:b]]
            reach = cKDTree(at).query(at, k + 1)[0][:, -1] * ARCSEC_PER_RADIAN
            # The k-th neighbour bounds an area in which k − 1 others lie, on average over places (Poisson).
            out[order[a:b]] = k / (math.pi * np.maximum(reach, 1.0) ** 2)
    rest = np.isnan(out)
    if rest.any():
        whole = axes.unit
        spread = float(np.linalg.norm(whole - whole.mean(axis=0), axis=1).max()) * ARCSEC_PER_RADIAN
        size = np.bincount(detections.frame)[detections.frame[rest]]
        out[rest] = size / (math.pi * max(spread, 60.0) ** 2)
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


def _coverage(detections: Detections, axes: EclipticAxes, density: FloatArray) -> tuple[IntArray, IntArray]:
    """(n,) cell of each detection, and (cells, frames+1) running number of the exposures that saw each cell.

    An exposure saw a cell if it has a detection there or in one of the eight cells around. The cells are so large that
    three times three hold five detections of a typical exposure.
    """
    frames = len(detections.frame_names)
    side_deg = math.sqrt(5.0 / 9.0 / float(np.median(density))) / 3600.0
    latitude = np.degrees(np.arcsin(np.clip(axes.unit @ ECLIPTIC_POLE, -1, 1)))
    row = np.floor((latitude + 90.0) / side_deg).astype(np.int64)
    across = np.maximum(1, np.floor(360.0 * np.cos(np.radians((row + 0.5) * side_deg - 90.0)) / side_deg)).astype(int)
    column = np.floor(axes.longitude_deg / 360.0 * across).astype(np.int64)
    stride = int(across.max(initial=1)) + 3
    cells, cell = np.unique((row + 1) * stride + column + 1, return_inverse=True)
    frame_saw = np.zeros((len(cells), frames + 1), np.int64)
    for drow in (-1, 0, 1):
        # Rows of another latitude have another number of cells.
        other = row + drow
        wide = np.maximum(1, np.floor(360.0 * np.cos(np.radians((other + 0.5) * side_deg - 90.0)) / side_deg))
        near = np.floor(axes.longitude_deg / 360.0 * wide).astype(np.int64)
        for dcolumn in (-1, 0, 1):
            key = (other + 1) * stride + near + dcolumn + 1
            at = np.minimum(np.searchsorted(cells, key), len(cells) - 1)
            same = cells[at] == key
            frame_saw[at[same], detections.frame[same] + 1] = 1
    return cell, np.cumsum(frame_saw, axis=1)
