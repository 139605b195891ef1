"""Simulated frames and the catalogues of their fields, with magnitudes and known truth.

:func:`exposure` makes both. The frame detects stars down to its limit, with errors that increase towards it; some
detections are not in the catalogue and some are false. The catalogue is deeper and years older: its stars have moved by
catalogued or unknown proper motions, whose errors increase those of its positions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.evidence import Magnitudes
from sameas.records import Records
from sameas.representation import in_short
from sameas.simulate.scenes import LonLatBox, SimulatedScene
from sameas.space import Sphere, displaced


@dataclass(frozen=True)
class Sky:
    """Parameters of the stars, their catalogue and the frame.

    stars_per_deg2 : stars down to ``faintest``; counts grow as 10^(``steepness`` · m) from ``brightest`` on.
    catalogue_sigma_arcsec, motion_sigma_mas_per_yr : (bright, faint) errors of the catalogue at its epoch.
    unknown_motion : share of its stars without proper motion; their motions have 1σ = ``motion_mas_per_yr`` on each
    axis. gap_yr : from catalogue to frame. uncatalogued : share of the stars that are not in the catalogue.
    frame_sigma_arcsec : errors of the frame's positions, for bright stars and at the limit. plateau : largest detection
    probability of the frame; it is half of that at ``limit``, and falls over ``softness`` mag.
    false_share : share of the frame's measurements that are not stars, mostly near its limit.
    zero_point, colour_term, scatter : of the frame's magnitude against the catalogue's first and second band, mag.
    """

    stars_per_deg2: float = 240_000.0
    brightest: float = 12.0
    faintest: float = 20.5
    steepness: float = 0.25
    catalogue_sigma_arcsec: tuple[float, float] = (0.05, 0.2)
    motion_sigma_mas_per_yr: tuple[float, float] = (1.0, 6.0)
    motion_mas_per_yr: float = 12.0
    unknown_motion: float = 0.2
    gap_yr: float = 15.0
    uncatalogued: float = 0.08
    frame_sigma_arcsec: tuple[float, float] = (0.05, 0.26)
    plateau: float = 0.98
    limit: float = 19.0
    softness: float = 0.3
    false_share: float = 0.08
    zero_point: float = 0.35
    colour_term: float = 0.08
    scatter: float = 0.06

    def completeness(self, magnitude: FloatArray) -> FloatArray:
        """P_d(m): (n,) the probability that the frame detects a star."""
        return self.plateau / (1.0 + np.exp((magnitude - self.limit) / self.softness))

    def depth(self, magnitude: FloatArray, faint: float) -> FloatArray:
        """(n,) position of errors between their bright (0) and faint (1) values."""
        return np.clip((magnitude - self.brightest) / (faint - self.brightest), 0.0, 1.0) ** 2


@in_short
@dataclass(frozen=True)
class FrameAndCatalogue:
    """A frame (source 1) and the catalogue of its field (source 2), at the frame's epoch.

    scene : records and truth. brightness : magnitudes of both, the catalogue's in two bands. sky : the parameters.
    area_arcsec2 : of the frame. magnitude, colour : (n_objects,) true magnitudes in the catalogue's first band, and
    their difference to those in its second.
    """

    scene: SimulatedScene
    brightness: tuple[Magnitudes, Magnitudes]
    sky: Sky
    area_arcsec2: float
    magnitude: FloatArray
    colour: FloatArray


def exposure(
    rng: np.random.Generator, sky: Sky | None = None, *, side_deg: float = 0.1, missing: float = 0.0
) -> FrameAndCatalogue:
    """A square frame of ``side_deg`` and its catalogue; missing : share of the magnitudes missing in each band."""
    sky = Sky() if sky is None else sky
    field = LonLatBox((150.0, 150.0 + side_deg), (-0.5 * side_deg, 0.5 * side_deg))
    stars = _TrueStars.drawn(rng, sky, field, rng.poisson(sky.stars_per_deg2 * side_deg**2))
    detected = np.flatnonzero(rng.uniform(size=len(stars.magnitude)) < sky.completeness(stars.magnitude))
    catalogued = np.flatnonzero(rng.uniform(size=len(stars.magnitude)) >= sky.uncatalogued)
    false = rng.poisson(sky.false_share / (1.0 - sky.false_share) * len(detected))
    all_objects = stars.with_false(rng, sky, field, false)
    numbers = np.concatenate([detected, np.arange(len(stars.magnitude), len(all_objects.magnitude))])
    frame, frame_magnitudes, truth_1 = all_objects.framed(rng, sky, rng.permutation(numbers), missing)
    catalogue, magnitudes, truth_2 = all_objects.catalogued(rng, sky, rng.permutation(catalogued), missing)
    scene = SimulatedScene(
        frame, catalogue, truth_1, truth_2, truth_1 >= len(stars.magnitude), np.zeros(len(truth_2), np.bool_)
    )
    area = (side_deg * 3600.0) ** 2
    return FrameAndCatalogue(
        scene, (frame_magnitudes, magnitudes), sky, area, all_objects.magnitude, all_objects.colour
    )


@dataclass(frozen=True)
class _TrueStars:
    """Directions (n, 2) at the frame's epoch, magnitudes in the catalogue's first band, and colours (n,)."""

    position_deg: FloatArray
    magnitude: FloatArray
    colour: FloatArray

    @classmethod
    def drawn(cls, rng: np.random.Generator, sky: Sky, field: LonLatBox, n: int) -> _TrueStars:
        # Inverse of the cumulative counts, which grow as 10^(steepness · m).
        low, high = 10 ** (sky.steepness * np.array([sky.brightest, sky.faintest]))
        magnitude = np.log10(rng.uniform(low, high, n)) / sky.steepness
        colour = 0.8 + 0.08 * (magnitude - 16.0) + 0.35 * rng.standard_normal(n)
        return cls(field.draw(rng, n), magnitude, colour)

    def with_false(self, rng: np.random.Generator, sky: Sky, field: LonLatBox, n: int) -> _TrueStars:
        """These stars and n false detections, most of them with magnitudes near the limit."""
        magnitude = np.maximum(sky.limit + 0.4 - rng.exponential(0.8, n), sky.brightest)
        position = np.concatenate([self.position_deg, field.draw(rng, n)])
        return _TrueStars(position, np.append(self.magnitude, magnitude), np.append(self.colour, np.full(n, 0.8)))

    def framed(
        self, rng: np.random.Generator, sky: Sky, numbers: IntArray, missing: float
    ) -> tuple[Records, Magnitudes, IntArray]:
        """The frame's measurements of the stars ``numbers``."""
        magnitude, colour = self.magnitude[numbers], self.colour[numbers]
        low, high = sky.frame_sigma_arcsec
        spread = low + (high - low) * sky.depth(magnitude, sky.limit)
        records = _measured(rng, self.position_deg[numbers], spread, "frame")
        error = 0.01 + 0.12 * sky.depth(magnitude, sky.limit)
        true = magnitude + sky.zero_point + sky.colour_term * (colour - 0.8)
        measured = true + np.hypot(sky.scatter, error) * rng.standard_normal(len(numbers))
        return records, _bands(rng, measured[:, None], error[:, None], missing, ("frame",)), numbers

    def catalogued(
        self, rng: np.random.Generator, sky: Sky, numbers: IntArray, missing: float
    ) -> tuple[Records, Magnitudes, IntArray]:
        """The catalogue's records of the stars ``numbers``, moved to the frame's epoch by their proper motions."""
        magnitude = self.magnitude[numbers]
        depth = sky.depth(magnitude, sky.faintest)
        still, motion = (
            (low + (high - low) * depth) for low, high in (sky.catalogue_sigma_arcsec, sky.motion_sigma_mas_per_yr)
        )
        unknown = rng.uniform(size=len(numbers)) < sky.unknown_motion
        motion = np.where(unknown, sky.motion_mas_per_yr, motion)
        spread = np.hypot(still, 1e-3 * motion * sky.gap_yr)
        records = _measured(rng, self.position_deg[numbers], spread, "catalogue")
        true = np.column_stack([magnitude, magnitude - self.colour[numbers]])
        error = np.broadcast_to((0.01 + 0.05 * depth)[:, None], true.shape)
        measured = true + error * rng.standard_normal(true.shape)
        return records, _bands(rng, measured, error, missing, ("V", "I")), numbers


def _measured(rng: np.random.Generator, position_deg: FloatArray, spread: FloatArray, name: str) -> Records:
    """Directions displaced by errors of variances spread² (1 ± e), e uniform in 0 … 0.5, along random axes."""
    n = len(spread)
    stretch, angle = rng.uniform(0.0, 0.5, n), rng.uniform(0.0, np.pi, n)
    major, minor = spread * np.sqrt(1.0 + stretch), spread * np.sqrt(1.0 - stretch)
    sine, cosine = np.sin(angle), np.cos(angle)
    along, across = major * rng.standard_normal(n), minor * rng.standard_normal(n)
    offset = np.column_stack([along * sine - across * cosine, along * cosine + across * sine])
    east, north = (major * sine) ** 2 + (minor * cosine) ** 2, (major * cosine) ** 2 + (minor * sine) ** 2
    both = (major**2 - minor**2) * sine * cosine
    covariance = np.stack([east, both, both, north], axis=1).reshape(-1, 2, 2)
    return Records.of(displaced(position_deg, offset), covariance=covariance, space=Sphere(), source=name)


def _bands(
    rng: np.random.Generator, measured: FloatArray, error: FloatArray, missing: float, names: tuple[str, ...]
) -> Magnitudes:
    absent = rng.uniform(size=measured.shape) < missing
    return Magnitudes(np.where(absent, np.nan, measured), np.where(absent, np.nan, error), names)
