"""Simulated catalogues with known truth: exposures of a field, and surveys that differ by more than quoted errors.

- :func:`exposure`: a frame and the catalogue of its field, with magnitudes. The frame detects stars down to its limit,
  with errors that increase towards it; some detections are not in the catalogue and some are false. The catalogue is
  deeper and years older: its stars have moved by catalogued or unknown proper motions, whose errors increase those of
  its positions.
- :func:`counterparts`: few sources with large errors in a deep catalogue.
- :func:`formal_field`, :func:`growing_field`: quoted errors are formal, of the noise alone; there are others as well.
- :func:`couples_field`: more close pairs of objects than a Poisson field has.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence import Magnitudes
from sameas.records import Records
from sameas.representation import in_short
from sameas.simulate.scenes import Cap, LonLatBox, SimulatedScene
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
    """A square frame of ``side_deg`` and its catalogue; missing : share of the magnitudes missing in each band.

    Example
    -------
    >>> made = exposure(np.random.default_rng(1), side_deg=0.05)
    >>> len(made.scene.first) < len(made.scene.second)
    True
    """
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
        still, motion = ((low + (high - low) * depth) for low, high in (
            sky.catalogue_sigma_arcsec, sky.motion_sigma_mas_per_yr,
        ))  # fmt: skip
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


def misquoted(scene: SimulatedScene, factor: float) -> SimulatedScene:
    """The scene with errors quoted ``factor`` times smaller than the true ones."""
    first, second = (replace(r, covariance=r.covariance / factor**2) for r in (scene.first, scene.second))
    return replace(scene, first=first, second=second)


def with_outliers(
    rng: np.random.Generator, scene: SimulatedScene, share: float, sigmas: float = 10.0
) -> SimulatedScene:
    """The scene with a share of either source's records displaced by ``sigmas`` of their σ in a random direction."""
    moved = []
    for records in (scene.first, scene.second):
        n = len(records)
        sigma = np.sqrt(0.5 * (records.covariance[:, 0] + records.covariance[:, -1]))
        far = np.where(rng.uniform(size=n) < share, sigmas * sigma, 0.0)
        angle = rng.uniform(0.0, 2.0 * np.pi, n)
        offset = far[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
        features = np.where(far[:, None] > 0.0, displaced(records.features, offset), records.features)
        moved.append(replace(records, features=features))
    return replace(scene, first=moved[0], second=moved[1])


#: Error of the positions of the catalogue of :func:`counterparts` on each axis, arcsec.
CATALOGUE_SIGMA_ARCSEC = 0.1


@in_short
@dataclass(frozen=True)
class Counterparts:
    """Few sources, a deep catalogue, and the columns of both.

    scene : records and truth. flux : (n₁,) log₁₀ of the sources' fluxes, correlated with the counterparts' magnitudes.
    magnitude, colour : (n₂,) mag. kind : (n₂,) "point" or "extended". noise : (n₂,) a column without information.
    area_arcsec2 : of the field.
    """

    scene: SimulatedScene
    flux: FloatArray
    magnitude: FloatArray
    colour: FloatArray
    kind: np.ndarray
    noise: FloatArray
    area_arcsec2: float


def counterparts(
    rng: np.random.Generator,
    *,
    sources: int = 1_500,
    records: int = 241_000,
    share: float = 0.9,
    chance: float = 0.3,
    sigma_arcsec: tuple[float, float] = (1.0, 2.0),
) -> Counterparts:
    """Sources some of which have a counterpart, brighter and bluer than the catalogue's other records.

    Parameters
    ----------
    rng : source of all random numbers.
    sources, records : numbers of records of the first and of the second source.
    share : of the sources with a counterpart.
    chance : mean number of unrelated records within 3σ of a source.
    sigma_arcsec : (low, high) error of a source on each axis, log-uniform; the catalogue's errors are 0.1″.

    Raises
    ------
    InputError : a number that is out of range.

    Source: modelled on NWAY's COSMOS example (X-ray sources with errors of 1–2″, counterparts' magnitudes about 21.5,
    counts of the catalogue rising as 10^(0.3 m) to 26).

    >>> made = counterparts(np.random.default_rng(1), sources=60, records=2_000)
    >>> len(made.scene.true_pairs()[0])
    54
    """
    if sources < 1 or records < sources or not 0.0 <= share <= 1.0 or not chance > 0.0:
        raise InputError(
            f"counterparts: {sources} sources, {records} records, share {share:g}, {chance:g} chance candidates; give "
            "positive numbers, and more records than sources"
        )
    low, high = sigma_arcsec
    square = 0.5 * (high**2 - low**2) / math.log(high / low) if high > low else low**2
    area = records * math.pi * 9.0 * square / chance
    radius_deg = math.degrees(2.0 * math.asin(math.sqrt(area / 3600.0**2 * (math.pi / 180.0) ** 2 / (4.0 * math.pi))))
    common = round(share * sources)
    objects = sources + records - common
    place = Cap(150.0, 2.0, radius_deg).draw(rng, objects)
    one, two = (
        rng.permutation(sources),
        rng.permutation(np.concatenate([np.arange(common), np.arange(sources, objects)])),
    )
    sigma = np.exp(rng.uniform(math.log(low), math.log(high), sources))
    xray = _measured_as(rng, place[one], "xray", sigma)
    optical = _measured_as(rng, place[two], "optical", np.full(records, CATALOGUE_SIGMA_ARCSEC))
    scene = _scene_without_false((xray, optical), (one, two))
    flux, bright = rng.normal(0.0, 0.6, objects), np.arange(objects) < sources
    # Counts rise as 10^(0.3 m) to magnitude 26; the sources' magnitudes follow their fluxes.
    counted = 26.0 + np.log10(rng.uniform(size=objects)) / 0.3
    magnitude = np.where(bright, 21.5 - 1.8 * flux + rng.normal(0.0, 1.3, objects), counted)
    colour = np.where(bright, 0.45, 0.9) + 0.06 * (magnitude - 22.0) + rng.normal(0.0, 0.4, objects)
    kind = np.where(rng.uniform(size=objects) < np.where(bright, 0.55, 0.25), "point", "extended")
    return Counterparts(scene, flux[one], magnitude[two], colour[two], kind[two], rng.normal(size=records), area)


def _measured_as(
    rng: np.random.Generator, place: FloatArray, name: str, sigma: ArrayLike, quoted: ArrayLike | None = None
) -> Records:
    """Records at these places with errors of 1σ ``sigma`` arcsec on each axis, which are quoted unless others are."""
    offset = np.reshape(sigma, (-1, 1)) * rng.standard_normal((len(place), 2))
    return Records.of(displaced(place, offset), sigma=sigma if quoted is None else quoted, space=Sphere(), source=name)


def _scene_without_false(sides: Sequence[Records], truths: Sequence[IntArray]) -> SimulatedScene:
    """The scene of two sources all of whose records are of real objects."""
    none = [np.zeros(len(truth), np.bool_) for truth in truths]
    return SimulatedScene(sides[0], sides[1], truths[0], truths[1], none[0], none[1])


def formal_field(
    rng: np.random.Generator,
    objects: int,
    *,
    per_deg2: float = 2_000.0,
    quoted_arcsec: tuple[float, float] = (0.003, 0.2),
    scale: float = 1.0,
    floor_arcsec: float = 0.0,
    tail: tuple[float, float] = (0.0, 1.0),
    missing: tuple[float, float] = (0.1, 0.2),
    false_share: float = 0.1,
) -> SimulatedScene:
    """Two sources of a square field on the sky whose residuals have the covariance scale² (Σ₁ + Σ₂) + floor² 1.

    Parameters
    ----------
    rng : source of all random numbers.
    objects : number of real objects in the field.
    per_deg2 : real objects per square degree.
    quoted_arcsec : (low, high) quoted error of a record on each axis, log-uniform.
    scale : true over quoted errors. floor_arcsec : additional error of the second source on each axis, not quoted.
    tail : share of the objects whose errors are larger than those of the others, and by which factor.
    missing : probability that the first and the second source miss an object.
    false_share : false records of either source per object, uniformly scattered.

    Raises
    ------
    InputError : a number that is out of range.

    Source: METHOD 6, "Error model".

    >>> scene = formal_field(np.random.default_rng(1), 40, floor_arcsec=0.15)
    >>> len(scene.true_pairs()[0])
    26
    """
    if objects < 1 or not per_deg2 > 0.0 or not scale > 0.0 or not floor_arcsec >= 0.0 or not false_share >= 0.0:
        raise InputError(
            f"formal_field: {objects} objects, {per_deg2:g} per square degree, scale {scale:g}, floor "
            f"{floor_arcsec:g} arcsec, {false_share:g} false records per object; give positive numbers"
        )
    share, wider = tail
    if not 0.0 <= share <= 1.0 or not wider >= 1.0:
        raise InputError(
            f"formal_field: a tail of share {share:g} with errors {wider:g} times as large; give a share from 0 to 1 "
            "and a factor of 1 or more"
        )
    side_deg = math.sqrt(objects / per_deg2)
    field = LonLatBox((150.0, 150.0 + side_deg / math.cos(math.radians(20.0))), (20.0, 20.0 + side_deg))
    false = rng.poisson(false_share * objects, 2)
    place = field.draw(rng, objects + int(false.sum()))
    numbers = np.split(np.arange(objects, len(place)), [false[0]])
    # Without a tail no number is drawn for it: the fields are those of earlier versions.
    of_object = np.where(rng.uniform(size=len(place)) < share, wider, 1.0) if share else np.ones(len(place))
    sides, truths = [], []
    for source, (name, own) in enumerate((("first", 0.0), ("second", floor_arcsec))):
        detected = np.flatnonzero(rng.uniform(size=objects) >= missing[source])
        truth = rng.permutation(np.concatenate([detected, numbers[source]]))
        sides.append(_with_formal_errors(rng, place[truth], quoted_arcsec, scale, own, of_object[truth], name))
        truths.append(truth)
    false_1, false_2 = (truth >= objects for truth in truths)
    return SimulatedScene(sides[0], sides[1], truths[0], truths[1], false_1, false_2)


def growing_field(
    rng: np.random.Generator,
    objects: int,
    error_arcsec: Callable[[FloatArray, FloatArray], FloatArray],
    *,
    quoted_arcsec: float = 0.1,
    chance: float = 1.0,
    missing: float = 0.15,
) -> tuple[SimulatedScene, tuple[FloatArray, FloatArray], FloatArray]:
    """Two sources of a crowded square that quote the same error for all records; the second source's errors grow.

    Parameters
    ----------
    rng : source of all random numbers.
    objects : number of real objects in the field.
    error_arcsec : function of magnitudes (n,) and of distances (n,) from the centre, relative to a corner's, that gives
        the true errors (n,) of the second source on each axis.
    quoted_arcsec : error quoted by both sources, the true one of the first.
    chance : mean number of other objects within 3σ of a pair with 1.5 times the quoted errors.
    missing : probability that a source misses an object.

    Returns
    -------
    The scene, the magnitudes of its records, and the true errors of the second source's records, arcsec.

    Raises
    ------
    InputError : a number that is out of range.

    >>> scene, (first, _), errors = growing_field(np.random.default_rng(1), 400, lambda m, r: 0.1 + 0.02 * (m - 12.0))
    >>> len(scene.first) == len(first), float(errors.min()) >= 0.1
    (True, True)
    """
    if objects < 1 or not quoted_arcsec > 0.0 or not chance > 0.0 or not 0.0 <= missing < 1.0:
        raise InputError(
            f"growing_field: {objects} objects, errors of {quoted_arcsec:g} arcsec, {chance:g} by chance, {missing:g} "
            "missed; give positive numbers"
        )
    per_arcsec2 = chance / (math.pi * (3.0 * 1.5 * math.sqrt(2.0) * quoted_arcsec) ** 2)
    side_deg = math.sqrt(objects / per_arcsec2) / 3600.0
    field = LonLatBox((150.0, 150.0 + side_deg), (-side_deg / 2.0, side_deg / 2.0))
    place = field.draw(rng, objects)
    magnitude = np.clip(22.0 - rng.exponential(1.5, objects), 12.0, 22.0)
    distance = np.hypot(place[:, 0] - 150.0 - side_deg / 2.0, place[:, 1]) / (side_deg / math.sqrt(2.0))
    sides, truths, magnitudes = [], [], []
    true = np.full(objects, quoted_arcsec), np.asarray(error_arcsec(magnitude, distance), np.float64)
    for name, sigma in zip(("first", "second"), true, strict=True):
        truth = rng.permutation(np.flatnonzero(rng.uniform(size=objects) >= missing))
        sides.append(_measured_as(rng, place[truth], name, sigma[truth], np.full(len(truth), quoted_arcsec)))
        truths.append(truth)
        magnitudes.append(magnitude[truth] + rng.normal(0.0, 0.05, len(truth)))
    return _scene_without_false(sides, truths), (magnitudes[0], magnitudes[1]), true[1][truths[1]]


def couples_field(
    rng: np.random.Generator,
    objects: int,
    *,
    share: float = 0.3,
    separation: float = 2.0,
    sigma_arcsec: tuple[float, float] = (0.1, 0.1),
    chance: float = 0.1,
    missing: float = 0.3,
    members: int = 2,
) -> SimulatedScene:
    """Two sources of a square with more close couples than a Poisson field; each source misses objects independently.

    Parameters
    ----------
    rng : source of all random numbers.
    objects : number of real objects in the field.
    share : of the objects that are in couples.
    separation : of a couple, in any direction, in standard errors of a record of the first source on each axis.
    sigma_arcsec : true and quoted error of the records of the first and of the second source on each axis.
    chance : mean number of other objects within 3σ of a pair, without companions.
    missing : probability that a source misses an object.
    members : of a couple; if more than two, the others are scattered about the first with ``separation`` as standard
        deviation on each axis.

    Raises
    ------
    InputError : a number that is out of range.

    >>> scene = couples_field(np.random.default_rng(1), 400)
    >>> len(scene.first) < 400
    True
    """
    possible = objects >= 1 and 0.0 <= share <= 1.0 and separation >= 0.0 and 0.0 <= missing < 1.0 and members >= 2
    if not possible or not chance > 0.0 or not min(sigma_arcsec) > 0.0:
        raise InputError(
            f"couples_field: {objects} objects, a share of {share:g} in groups of {members} at {separation:g} errors, "
            f"errors of {sigma_arcsec[0]:g} and {sigma_arcsec[1]:g} arcsec, {chance:g} by chance, {missing:g} missed; "
            "give positive numbers, and shares between 0 and 1"
        )
    per_arcsec2 = chance / (math.pi * 9.0 * (sigma_arcsec[0] ** 2 + sigma_arcsec[1] ** 2))
    side_deg = math.sqrt(objects / per_arcsec2) / 3600.0
    place = LonLatBox((150.0, 150.0 + side_deg), (-side_deg / 2.0, side_deg / 2.0)).draw(rng, objects)
    grouped = members * round(share * objects / members)
    first = np.arange(grouped) // members * members
    others = np.flatnonzero(first != np.arange(grouped))
    apart = rng.standard_normal((len(others), 2))
    if members == 2:
        apart /= np.hypot(*apart.T)[:, None]
    place[others] = displaced(place[first[others]], separation * sigma_arcsec[0] * apart)
    sides, truths = [], []
    for name, sigma in zip(("first", "second"), sigma_arcsec, strict=True):
        truth = rng.permutation(np.flatnonzero(rng.uniform(size=objects) >= missing))
        sides.append(_measured_as(rng, place[truth], name, sigma))
        truths.append(truth)
    return _scene_without_false(sides, truths)


def _with_formal_errors(
    rng: np.random.Generator,
    place: FloatArray,
    quoted: tuple[float, float],
    scale: float,
    floor: float,
    of_object: FloatArray,
    name: str,
) -> Records:
    """Records whose errors, after ``scale`` and ``floor``, are larger by a factor (n,) of each object."""
    sigma = np.exp(rng.uniform(math.log(quoted[0]), math.log(quoted[1]), len(place)))
    return _measured_as(rng, place, name, of_object * np.hypot(scale * sigma, floor), sigma)
