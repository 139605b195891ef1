"""Hints of where a frame points before it is placed, and the pointings that are tested under each.

A hint states the volume that it searches (:class:`~sameas.sky.frame.odds.SearchVolume`, which lowers the odds), the
placements that it allows, and the order in which pointings are proposed: in lists, the cheapest and likeliest first.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.representation import in_short
from sameas.sky.frame.odds import OddsTuning, PlateProblem, SearchVolume
from sameas.sky.frame.pattern import PatternIndex, Patterns, brightest_per_cell, patterns
from sameas.sky.frame.tangent import Pointing, from_plane, similarities
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

if TYPE_CHECKING:
    from sameas.sky.frame.field import Stars


@dataclass(frozen=True)
class SearchTuning:
    """Numbers of the search for a pointing, tuned on simulated frames unless stated otherwise.

    Attributes
    ----------
    code_tolerance : largest distance of two codes of patterns that are alike: 1.5 % of the longest side per coordinate.
    sides_all_sky, sides_few, sides_many : least and largest longest side of a pattern over the side of the field: in
        the index of the whole sky, and about an aim where a field has few or many stars.
    many : a field with more stars than this has many: no longest patterns, no triangles of faint stars.
    stars_per_field : bright stars per field in the index of the whole sky.
    measured : numbers of the brightest measurements that are tried with the index, one after the other.
    aim_lists : about an aim, one after the other: points of a pattern, bright stars per field, brightest measurements.
    batch : pairs of patterns that are counted at a time, which bounds the memory.
    best : most pointings of a list.
    verified : most different pointings of a list that are verified.
    odds : numbers of the verification.
    """

    code_tolerance: float = 0.02
    sides_all_sky: tuple[float, float] = (0.2, 0.6)
    sides_few: tuple[float, float] = (0.15, 1.3)
    sides_many: tuple[float, float] = (0.2, 0.7)
    many: int = 20
    stars_per_field: int = 14
    measured: tuple[int, ...] = (12, 20, 30)
    aim_lists: tuple[tuple[int, int, int], ...] = ((4, 16, 16), (4, 16, 30), (3, 16, 25), (4, 32, 32), (3, 32, 36))
    batch: int = 20_000
    best: int = 500
    verified: int = 20
    odds: OddsTuning = field(default_factory=OddsTuning)


TUNING = SearchTuning()


@in_short
@dataclass(frozen=True)
class ApproximateWcs:
    """A plate solution that is nearly right.

    Parameters
    ----------
    wcs : any celestial astropy WCS, distorted or not.
    radius_deg : how far off it may be; a quarter of the frame's shorter side if not given.
    turn_deg : by how much it may be rotated, either way. scale_tolerance : by what share its scale may be wrong.
    """

    wcs: Any
    radius_deg: float | None = None
    turn_deg: float = 2.0
    scale_tolerance: float = 0.02

    words = "the header's plate solution"

    def __post_init__(self) -> None:
        if not getattr(self.wcs, "has_celestial", False):
            raise InputError("ApproximateWcs: the WCS has no celestial axes; give an Aim instead")
        if not (self.radius_deg is None or self.radius_deg > 0) or not 0 < self.turn_deg <= 180:
            raise InputError("ApproximateWcs: radius_deg must be positive, and turn_deg within 0 … 180")
        if not 0 < self.scale_tolerance < 0.5:
            raise InputError(f"ApproximateWcs: scale_tolerance is {self.scale_tolerance}; give a share such as 0.02")

    def radius_px(self, pointing: Pointing, problem: PlateProblem) -> float:
        """How far off, in pixels."""
        if self.radius_deg is None:
            return 0.25 * min(problem.shape)
        return self.radius_deg * 3600.0 / pointing.scale_arcsec

    def search_volume(self, problem: PlateProblem) -> SearchVolume:
        """The volume that is searched."""
        pointing = Pointing.of_wcs(self.wcs, problem.shape)
        side = 2 * self.radius_px(pointing, problem) * pointing.scale_arcsec / ARCSEC_PER_RADIAN
        return SearchVolume(side**2, 2 * math.radians(self.turn_deg), 2 * self.scale_tolerance, 1)

    def allows(self, pointing: Pointing, problem: PlateProblem) -> bool:
        """Whether a placement agrees with the hint."""
        header = Pointing.of_wcs(self.wcs, problem.shape)
        off = header.to_px(pointing.to_sky(problem.middle_px[None]))[0] - problem.middle_px
        ratio = math.log(pointing.scale_arcsec / header.scale_arcsec)
        near = bool(np.hypot(*off) <= 1.5 * self.radius_px(header, problem))
        return near and abs(ratio) <= 1.5 * self.scale_tolerance and pointing.parity == header.parity


@dataclass(frozen=True)
class Aim:
    """A direction, how far from it the frame's middle may be, and the least and largest scale in arcsec per pixel."""

    ra_deg: float
    dec_deg: float
    radius_deg: float
    scale_arcsec: tuple[float, float]

    words = "the aim"

    def __post_init__(self) -> None:
        _check_scales("Aim", self.scale_arcsec)
        if not (math.isfinite(self.ra_deg) and -90 <= self.dec_deg <= 90 and 0 < self.radius_deg <= 180):
            raise InputError(
                f"Aim: ({self.ra_deg}, {self.dec_deg}) within {self.radius_deg}; give degrees, and a radius above 0"
            )

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector."""
        return unit_vectors(self.ra_deg, self.dec_deg)

    def search_volume(self, problem: PlateProblem) -> SearchVolume:
        """The volume that is searched."""
        area = 4 * math.pi * math.sin(math.radians(self.radius_deg) / 2) ** 2
        return SearchVolume(area, 2 * math.pi, _log_range(self.scale_arcsec), 2)

    def allows(self, pointing: Pointing, problem: PlateProblem) -> bool:
        """Whether a placement agrees with the hint."""
        middle = pointing.to_sky(problem.middle_px[None])[0]
        off = math.degrees(2 * math.asin(min(1.0, float(np.linalg.norm(middle - self.direction)) / 2)))
        return off <= 1.05 * self.radius_deg and _within(self.scale_arcsec, pointing)


@dataclass(frozen=True)
class AllSky:
    """Nothing but the least and largest scale in arcsec per pixel."""

    scale_arcsec: tuple[float, float]

    words = "a search of the whole sky"

    def __post_init__(self) -> None:
        _check_scales("AllSky", self.scale_arcsec)

    def search_volume(self, problem: PlateProblem) -> SearchVolume:
        """The volume that is searched."""
        return SearchVolume(4 * math.pi, 2 * math.pi, _log_range(self.scale_arcsec), 2)

    def allows(self, pointing: Pointing, problem: PlateProblem) -> bool:
        """Whether a placement agrees with the hint."""
        return _within(self.scale_arcsec, pointing)


Hint = ApproximateWcs | Aim | AllSky


def _check_scales(name: str, scales: tuple[float, float]) -> None:
    if not (len(scales) == 2 and 0 < scales[0] <= scales[1] < 7200):
        raise InputError(f"{name}: scale_arcsec is {scales}; give (least, largest) in arcsec per pixel")


def _log_range(scales: tuple[float, float]) -> float:
    # A scale that is given as exact is searched within one percent.
    return max(math.log(scales[1] / scales[0]), 0.01)


def _within(scales: tuple[float, float], pointing: Pointing) -> bool:
    return 0.99 * scales[0] <= pointing.scale_arcsec <= 1.01 * scales[1]


@dataclass(frozen=True)
class SkyIndex:
    """Patterns of the whole sky's bright stars, one :class:`PatternIndex` for every size of field. Keep it."""

    levels: tuple[PatternIndex, ...]


def sky_index(stars: Stars, shape: tuple[int, int], hint: AllSky, tuning: SearchTuning = TUNING) -> SkyIndex:
    """The index for frames of ``shape`` (rows, columns) and the scales of the hint, of a catalogue of the whole sky.

    Raises
    ------
    InputError : the catalogue has too few stars for fields of that size.
    """
    order = stars.order()
    vectors = unit_vectors(np.asarray(stars.ra_deg)[order], np.asarray(stars.dec_deg)[order])
    return _index_of(vectors, shape, hint, tuning)


def _index_of(vectors: FloatArray, shape: tuple[int, int], hint: AllSky, tuning: SearchTuning) -> SkyIndex:
    least, most = (side / ARCSEC_PER_RADIAN * math.sqrt(shape[0] * shape[1]) for side in hint.scale_arcsec)
    per_field = len(vectors) * least**2 / (4 * math.pi)
    if per_field < 4:
        raise InputError(
            f"a field of {math.degrees(least):.2g}° holds {per_field:.2g} stars of the catalogue; a search of the "
            "whole sky needs a deeper catalogue or a wider field; give an aim"
        )
    if least > math.radians(60):
        raise InputError(f"a field of {math.degrees(least):.0f}° is not flat; give an aim and a part of the frame")
    steps = max(1, math.ceil(math.log(most / least) / math.log(math.sqrt(2.0)) - 0.3))
    fields = least * math.sqrt(2.0) ** np.arange(steps)
    number, sides = tuning.stars_per_field, tuning.sides_all_sky
    return SkyIndex(tuple(_level(vectors, float(side), number, 4, sides) for side in fields))


def _level(vectors: FloatArray, side_rad: float, per_field: int, k: int, sides: tuple[float, float]) -> PatternIndex:
    """The patterns of k of the brightest ``per_field`` stars of every field of a side."""
    rank = np.arange(len(vectors))
    rows = brightest_per_cell(vectors, rank, side_rad / 2.0, max(1, round(per_field / 4)))
    return PatternIndex.of(vectors, rows, k=k, shortest_rad=sides[0] * side_rad, longest_rad=sides[1] * side_rad)


def candidates(
    problem: PlateProblem, hint: Hint, index: SkyIndex | None, tuning: SearchTuning = TUNING
) -> Iterator[Iterator[Pointing]]:
    """Lists of pointings, the most promising of each first."""
    if isinstance(hint, ApproximateWcs):
        yield _correlated(problem, hint)
        return
    scale = (hint.scale_arcsec[0] / ARCSEC_PER_RADIAN, hint.scale_arcsec[1] / ARCSEC_PER_RADIAN)
    if isinstance(hint, AllSky):
        index = index or _index_of(problem.vectors, problem.shape, hint, tuning)
        for n in tuning.measured:
            if n == tuning.measured[0] or n // 2 < len(problem.px):
                yield _alike(problem, index.levels, n, 4, scale, tuning)
        return
    yield from _about_aim(problem, hint, scale, tuning)


def _about_aim(
    problem: PlateProblem, aim: Aim, scale: tuple[float, float], tuning: SearchTuning
) -> Iterator[Iterator[Pointing]]:
    reach = math.radians(aim.radius_deg) + problem.half_diagonal_px * scale[1]
    cone = problem.vectors[problem.stars_near(aim.direction, reach)]
    if len(cone) < 3:
        raise InputError(
            f"the catalogue has {len(cone)} stars within {math.degrees(reach):.2g}° of the aim; give one that covers it"
        )
    side = math.sqrt(problem.shape[0] * problem.shape[1] * scale[0] * scale[1])
    many = len(cone) * side**2 / (4 * math.pi * math.sin(reach / 2) ** 2) > tuning.many
    done: set[tuple[int, int, int]] = set()
    for k, per_field, n in tuning.aim_lists:
        if many and k == 3 and per_field > tuning.aim_lists[0][1]:
            continue
        level = _level(cone, side, per_field, k, tuning.sides_many if many else tuning.sides_few)
        # With few stars or measurements later lists are the same as earlier ones.
        key = (k, len(level.vectors), min(n, len(problem.px)))
        if key not in done and len(level.patterns):
            done.add(key)
            yield _alike(problem, (level,), n, k, scale, tuning)


def _alike(
    problem: PlateProblem,
    levels: tuple[PatternIndex, ...],
    n: int,
    k: int,
    scale: tuple[float, float],
    tuning: SearchTuning,
) -> Iterator[Pointing]:
    """Pointings that put a pattern of the n brightest measurements on one of stars; most other matches first."""
    # A pattern of near neighbours determines neither the rotation nor the scale of the frame.
    measured = patterns(problem.px[:n], k, 0.1 * min(problem.shape))
    hits, centres, matrices = [], [], []
    for level in levels:
        i, j, flipped = level.alike(measured, tuning.code_tolerance * math.sqrt(k - 2) / math.sqrt(2.0), scale)
        for start in range(0, len(i), tuning.batch):
            part = slice(start, start + tuning.batch)
            count, centre, cd = _counted(problem, level, measured, i[part], j[part], flipped[part], n)
            top = np.argsort(-count, kind="stable")[: tuning.best]
            top = top[count[top] >= k]
            hits.append(count[top])
            centres.append(centre[top])
            matrices.append(cd[top])
    if not hits:
        return
    count, centre, cd = np.concatenate(hits), np.concatenate(centres), np.concatenate(matrices)
    for row in np.argsort(-count, kind="stable")[: tuning.best]:
        yield Pointing(centre[row], cd[row], problem.middle_px)


def _counted(
    problem: PlateProblem, level: PatternIndex, measured: Patterns, i: IntArray, j: IntArray, flipped: Any, n: int
) -> tuple[IntArray, FloatArray, FloatArray]:
    """For each pair of patterns how many of the n brightest measurements lie on a star, and the pointing."""
    px = problem.px[measured.members[i]]
    centre, cd = similarities(px, level.vectors[level.patterns.members[j]], flipped, problem.middle_px)
    offset = problem.px[: max(n, 20)] - problem.middle_px
    plane = np.einsum("nb,cab->cna", offset, cd)
    directions = from_plane(plane, centre[:, None, :])
    near = 0.01 * problem.half_diagonal_px * np.sqrt(np.abs(np.linalg.det(cd)))
    distance, star = level.star_tree.query(directions, distance_upper_bound=float(near.max(initial=0.0)), workers=2)
    hit = distance <= near[:, None]
    # A star counts once, also where several measurements lie near it.
    star = np.sort(np.where(hit, star, len(level.vectors)), axis=1)
    fresh = (star < len(level.vectors)) & np.diff(star, axis=1, prepend=-1).astype(bool)
    return fresh.sum(axis=1), centre, cd


def _correlated(problem: PlateProblem, header: ApproximateWcs) -> Iterator[Pointing]:
    """Pointings near the header's, rotated and shifted to where most measurements lie on stars."""
    given = Pointing.of_wcs(header.wcs, problem.shape)
    radius, middle = header.radius_px(given, problem), problem.middle_px
    bin_px = max(4.0, 0.004 * problem.half_diagonal_px)
    reach = (problem.half_diagonal_px + radius) * given.scale_arcsec / ARCSEC_PER_RADIAN
    stars = problem.vectors[problem.stars_near(given.to_sky(middle[None])[0], reach)]
    predicted = given.to_px(stars)
    predicted = predicted[problem.inside(predicted, radius)] - given.origin_px
    steps = math.ceil(math.radians(header.turn_deg) * problem.half_diagonal_px / bin_px)
    proposals = []
    for depth in (50, 200):
        measured = problem.px[:depth] - given.origin_px
        for angle in np.linspace(-1, 1, 2 * steps + 1) * math.radians(header.turn_deg):
            sine, cosine = math.sin(angle), math.cos(angle)
            rotated = predicted[:depth] @ np.array([[cosine, sine], [-sine, cosine]])
            for excess, shift in _peaks(measured, rotated, radius, bin_px):
                proposals.append((excess, given.moved(np.array([*shift, 0.0, angle, 0.0, 0.0]))))
    yield given
    for _, pointing in sorted(proposals, key=lambda proposal: -proposal[0]):
        yield pointing


def _peaks(measured: FloatArray, predicted: FloatArray, radius: float, bin_px: float) -> list[tuple[float, FloatArray]]:
    """The two shifts within ``radius`` that bring most points together, each with its count above chance in σ."""
    from scipy.ndimage import uniform_filter

    if not len(predicted) or not len(measured):
        return []
    apart = (measured[:, None, :] - predicted[None, :, :]).reshape(-1, 2)
    bins = max(3, math.ceil(2 * radius / bin_px))
    count = np.histogram2d(apart[:, 0], apart[:, 1], bins=bins, range=[[-radius, radius]] * 2)[0]
    # Three by three bins, so that a peak on a border is not cut.
    count = uniform_filter(count, 3, mode="constant") * 9.0
    expected = max(float(count.mean()), 1e-3)
    peaks = []
    for flat in np.argsort(-count, axis=None, kind="stable")[:2]:
        place = np.array(np.unravel_index(flat, count.shape))
        peaks.append(
            (float((count.flat[flat] - expected) / math.sqrt(expected)), (place + 0.5) * 2 * radius / bins - radius)
        )
    return peaks
