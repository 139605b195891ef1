"""Crossmatch of two catalogues: moved to a common epoch, matched with estimated parameters, checked for doubts.

Data flow: two :class:`Catalogue` → common epoch → two ``Records`` on the sphere → ``estimate.match`` →
:class:`SkyMatch`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from sameas.arrays import BoolArray, FloatArray, median, within_turn
from sameas.errors import InputError, Message, naming
from sameas.estimate.blends import suspected_blends
from sameas.estimate.clustering import close_neighbours
from sameas.estimate.coverage import Coverage
from sameas.estimate.match import match as estimate_match
from sameas.estimate.result import Estimate
from sameas.estimate.sample import Setting
from sameas.evidence import Column, Errors, Related
from sameas.gate import ChiSquare, Radius
from sameas.kernels import threads
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import in_years
from sameas.sky.completion import completed
from sameas.sky.doubts import disjoint_doubt, epoch_doubt, in_icrs
from sameas.sky.evidence_columns import AUTO, columns_of, magnitudes_of
from sameas.sky.systematics import DEFAULT_WARP, Rotation, Warp, WarpTuning, find_rotation, find_warp, residual_rotation
from sameas.space import ARCSEC_PER_RADIAN, sphere_offset, unit_vectors


@in_short
@dataclass(frozen=True)
class Nearest:
    """The nearest neighbour of each record: the usual crossmatch, for comparison.

    rows : (n,) table row of the nearest record; separation_arcsec : (n,) its distance. Both are masked where there is
    none: in unusable rows, and if the other catalogue has no usable row.
    """

    rows: np.ma.MaskedArray[Any, np.dtype[np.int64]]
    separation_arcsec: np.ma.MaskedArray[Any, np.dtype[np.float64]]


def nearest(first: Records, second: Records) -> Nearest:
    """The nearest record of ``second`` to each record of ``first`` on the sphere; errors are ignored."""
    from scipy.spatial import cKDTree

    if not len(second):
        return _no_neighbours(len(first))
    distance, at = cKDTree(unit_vectors(*second.features.T)).query(unit_vectors(*first.features.T), workers=-1)
    separation = 2.0 * np.arcsin(np.minimum(distance / 2.0, 1.0)) * ARCSEC_PER_RADIAN
    return Nearest(np.ma.array(second.rows[at], mask=False), np.ma.array(separation, mask=False))


def _no_neighbours(n: int) -> Nearest:
    return Nearest(np.ma.array(np.zeros(n, np.int64), mask=True), np.ma.array(np.zeros(n), mask=True))


ARCSEC2_PER_DEG2 = 3600.0**2


@dataclass(frozen=True)
class CrossmatchTuning:
    """Thresholds for refusing or doubting a result; all chosen.

    Attributes
    ----------
    max_records_per_error : more records per typical error, in both catalogues, are refused: positions cannot separate
        them, and the unit of the errors is probably wrong.
    sampled_from_rows, sampled_rings : tables longer than ``sampled_from_rows`` are checked for this on one declination
        ring of cells in ``sampled_rings``.
    min_common_share, min_common_sigmas : two catalogues have hardly any objects in common if the expected number
        is at most this share of the smaller catalogue and at most this many of its standard errors.
    max_spacing_share : with hardly any common objects the errors are doubted if the lower quartile of the
        nearest-neighbour distances is below this share of its value for chance alone.
    usual_scale : (least, largest) ratio of residuals to quoted errors that raises no doubt.
    usual_density : (least, largest) ratio of the given density to the observed one that raises no doubt.
    duplicate_sigmas, duplicate_share : close pairs within one catalogue are doubted if they exceed the number expected
        by chance by this many standard deviations and by this share of the records.
    b1950_records, b1950_arcsec, b1950_share : with hardly any common objects the equinox of a catalogue may be B1950 if
        this share of about ``b1950_records`` of its records then lies within ``b1950_arcsec`` of a record of the other,
        and far more than else.
    same_epoch_years : a catalogue without motions whose epoch differs by more from a given common epoch raises a doubt.
    sort_by_position : whether records are sorted by position. Samples of every k-th record then do not depend on the
        order of the table's rows, and neighbours on the sky are neighbours in memory (a million rows in table order
        take a third longer).
    warp : of the smooth warp that is searched with a shift and rotation.
    """

    max_records_per_error: float = 20.0
    sampled_from_rows: int = 100_000
    sampled_rings: float = 16.0
    min_common_share: float = 0.05
    min_common_sigmas: float = 3.0
    max_spacing_share: float = 0.2
    usual_scale: tuple[float, float] = (0.3, 5.0)
    usual_density: tuple[float, float] = (0.01, 100.0)
    duplicate_sigmas: float = 5.0
    duplicate_share: float = 0.03
    b1950_records: int = 2_000
    b1950_arcsec: float = 2.0
    b1950_share: float = 0.2
    same_epoch_years: float = 0.5
    sort_by_position: bool = True
    warp: WarpTuning = DEFAULT_WARP


TUNING = CrossmatchTuning()


@in_short
@dataclass(frozen=True)
class MatchOptions:
    """Options of a match; options that are not given are estimated from the catalogues.

    epoch_jyr : common epoch, Julian year. gate_sigmas : radius of the gate in quoted standard deviations.
    error_scale : "auto" estimates the ratio of residuals to quoted errors; a number is taken as that factor, ``Errors``
        as a mixture of factors.
    density_per_deg2 : (first, second) densities of all records, instead of local ones from the data.
    magnitudes : "auto" uses the magnitudes of both catalogues as evidence, or those of the only one that has them;
        "off" uses positions only; columns by name as "G,BP:J,H" (see ``evidence_columns.magnitudes_of``).
    precision : whether the sizes of the quoted errors are used as evidence where magnitudes separate too little.
    offset : "none" assumes that both catalogues are on one frame, and reports a doubt if the pairs show an offset;
        "find" estimates and removes a shift and rotation of the second catalogue, and a smooth warp of the field (see
        :mod:`sameas.sky.systematics`).
    evidence : further columns used as evidence, by name, alone or related to a column of the other catalogue.
    """

    epoch_jyr: float | None = None
    gate_sigmas: float | None = None
    error_scale: float | str | Errors = "auto"
    density_per_deg2: tuple[float, float] | None = None
    magnitudes: str = AUTO
    offset: str = "none"
    precision: bool = True
    evidence: Sequence[Column | Related] = ()

    def errors(self) -> Errors | None:
        """The given mixture of error factors, None if it is to be estimated."""
        if self.error_scale == "auto":
            return None
        if isinstance(self.error_scale, Errors):
            return self.error_scale
        scale = _number(self.error_scale)
        if scale is None or not 0.0 < scale < math.inf:
            raise InputError(f'error scale is {self.error_scale!r}; give "auto" or a positive factor')
        return Errors((scale,), (1.0,))

    def gate(self) -> ChiSquare | Radius | None:
        """The given gate, None if it is to be chosen."""
        return None if self.gate_sigmas is None else Radius(self.gate_sigmas)

    def density(self) -> tuple[float, float] | None:
        """The given densities per arcsec², None if they come from the data."""
        if self.density_per_deg2 is None:
            return None
        if not all(0.0 < value < math.inf for value in self.density_per_deg2):
            raise InputError("density: give two positive numbers, records per square degree of either catalogue")
        return self.density_per_deg2[0] / ARCSEC2_PER_DEG2, self.density_per_deg2[1] / ARCSEC2_PER_DEG2

    def check(self) -> None:
        """Refuse invalid values, before any file is read."""
        self.errors()
        self.gate()
        self.density()


@in_short
@dataclass(frozen=True)
class SkyMatch:
    """Result of a crossmatch of two catalogues.

    epoch_jyr : common epoch, None if positions were not moved.
    moved : one sentence on which catalogue was moved and why. doubts : what looks wrong with the result.
    rotation : from the second catalogue onto the first; None if it was not searched for, or is not significant.
    warp : the smooth residual distortion after the rotation, also removed; None likewise.
    """

    first: Catalogue
    second: Catalogue
    epoch_jyr: float | None
    moved: str
    result: Identification
    estimate: Estimate
    doubts: tuple[str, ...]
    rotation: Rotation | None = None
    warp: Warp | None = None

    @cached_property
    def covered_1(self) -> BoolArray:
        """(n,) whether the second catalogue covers the position of each row of the first; True for unusable rows."""
        return self.result.first.over_table(self.estimate.coverage.covered[0])

    @cached_property
    def covered_2(self) -> BoolArray:
        """(n,) whether the first catalogue covers the position of each row of the second; True for unusable rows."""
        return self.result.second.over_table(self.estimate.coverage.covered[1])

    @cached_property
    def offsets_without_motion(self) -> FloatArray:
        """(k, 2) east and north offsets of the matched pairs, arcsec, each record at the epoch of its catalogue."""
        a, b = self.first.astrometry, self.second.astrometry
        i, j = self.result.matches.rows_1, self.result.matches.rows_2
        return sphere_offset(a.ra_deg[i], a.dec_deg[i], b.ra_deg[j], b.dec_deg[j])

    @cached_property
    def area_and_densities(self) -> tuple[float, float, float]:
        """Area covered by both catalogues, deg², and the mean density of each catalogue there, per deg²."""
        return area_and_densities(self.estimate.coverage)

    def nearest(self, moved: bool) -> Nearest:
        """The nearest record of the second catalogue to each row of the first table.

        moved : at the common epoch, or at the epochs of the catalogues.
        """
        one, two = self.result.first, self.result.second
        near = nearest(one, two) if moved else nearest(_unmoved(one, self.first), _unmoved(two, self.second))
        of_rows = _no_neighbours(one.n_table)
        of_rows.rows[one.rows], of_rows.separation_arcsec[one.rows] = near.rows, near.separation_arcsec
        return of_rows


def match(
    first: Catalogue,
    second: Catalogue,
    options: MatchOptions | None = None,
    *,
    progress: Callable[[str], None] = lambda stage: None,
    tuning: CrossmatchTuning = TUNING,
) -> SkyMatch:
    """Crossmatch of two catalogues.

    Parameters
    ----------
    first, second : the catalogues.
    options : given values. progress : called with the name of the current stage.
    tuning : thresholds for refusing or doubting the result, and of the warp.

    Raises
    ------
    InputError : no usable rows; a common epoch is needed and not known.
    """
    options = MatchOptions() if options is None else options
    progress("motion")
    (first, second), assumed = completed((first, second), options.epoch_jyr)
    epoch, epoch_note, one, two = at_common_epoch(first, second, options.epoch_jyr, tuning)
    if tuning.sort_by_position:
        one, two = threads.each([partial(by_position, records) for records in (one, two)], len(one) + len(two))
    _refuse_large_errors(one, two, tuning)
    search = find_rotation(one, two, progress) if options.offset == "find" else None
    rotation = None if search is None or search.by_chance else search
    if rotation is not None:
        two = rotation.of(two)
    run_match = partial(
        estimate_match, errors=options.errors(), gate=options.gate(), density=options.density(),
        brightness=magnitudes_of(first, second, options.magnitudes), precision=options.precision,
        evidence=columns_of(first, second, options.evidence, options.magnitudes), progress=progress,
    )  # fmt: skip
    result, estimate = run_match(one, two)
    warp: Warp | None = None
    for _ in range(tuning.warp.passes if search is not None else 0):
        progress("warp")
        next_warp = find_warp(result, warp, tuning.warp)
        if next_warp is None:
            break
        warp = next_warp
        result, estimate = run_match(one, warp.of(two))
    matched = SkyMatch(first, second, epoch, epoch_note, result, estimate, (), rotation, warp)
    disjoint = disjoint_doubt(first, second, one, two) if _hardly_any_common(result, estimate, tuning) else ()
    left_behind = left_behind_doubt(first, second, options.epoch_jyr, tuning)
    doubts = assumed + left_behind + density_doubts(estimate.coverage, options, tuning)
    doubts += _doubts(matched, search, disjoint, left_behind, tuning)
    return replace(matched, doubts=doubts)


def _doubts(
    match: SkyMatch,
    search: Rotation | None,
    disjoint: tuple[str, ...],
    left_behind: tuple[str, ...],
    tuning: CrossmatchTuning,
) -> tuple[str, ...]:
    """What looks wrong with a match.

    search : for a rotation, if any. disjoint, left_behind : doubts about two separate fields, and about a common epoch
    that one catalogue cannot be moved to: residuals along the motions then follow from it.
    """
    result, estimate = match.result, match.estimate
    # That nothing is common follows from fields that lie apart.
    notes = () if disjoint else estimate.notes
    doubts = (*notes, *_error_doubts(match, tuning), *_near_miss_doubts(result, estimate, tuning))
    epoch_line, offset_explained = "", False
    if not left_behind:
        epoch_line, offset_explained = epoch_doubt(match.first, match.second, match.epoch_jyr, result, estimate.errors)
    doubts += (*disjoint, epoch_line) if epoch_line else disjoint
    if search is not None:
        doubts += _search_doubts(search, match.warp)
    elif not disjoint and not offset_explained:
        doubts += _offset_doubts(result, estimate, tuning)
    return doubts + _blend_doubts(result, estimate) + _duplicate_doubts(result, estimate, tuning)


def at_common_epoch(
    first: Catalogue, second: Catalogue, epoch_jyr: float | None = None, tuning: CrossmatchTuning = TUNING
) -> tuple[float | None, str, Records, Records]:
    """The common epoch, a sentence that explains it, and the records of both catalogues at this epoch.

    Raises
    ------
    InputError : no usable rows; a common epoch is needed and not known.
    """
    epoch, note = common_epoch(first, second, epoch_jyr, tuning)
    calls = [partial(catalogue.records, epoch) for catalogue in (first, second)]
    one, two = threads.each(calls, len(first) + len(second))
    for catalogue, records in ((first, one), (second, two)):
        if not len(records):
            counts = records.set_aside.counts()
            reasons = ", ".join(f"{reason} ({n})" for reason, n in counts.items())
            remedy = naming("an error of 0 or less counts as none: give {sigma:ARCSEC}") if "no error" in counts else ""
            message = f"{catalogue.name}: none of its {len(catalogue)} rows can be used: {reasons}"
            raise InputError(message, remedy, source=catalogue.name)
    return epoch, note, one, two


#: Records in a square as high as a ring (sets the number of rings); bits of a ring number.
_IN_SQUARE, _RING_BITS = 10.0, 12


def by_position(records: Records) -> Records:
    """The records sorted by rings of declination from south to north, each ring by increasing right ascension."""
    lon, lat = (np.ascontiguousarray(angle) for angle in records.features.T)
    n, south, north = len(records), float(lat.min()), float(lat.max())
    rings = min(math.ceil(math.sqrt(n / _IN_SQUARE)), 2**_RING_BITS)
    row_bits = n.bit_length()
    along_bits = 64 - _RING_BITS - row_bits
    ring = np.minimum((lat - south) * (rings / max(north - south, 1e-300)), rings - 1).astype(np.uint64)
    if lon.min() < 0.0 or lon.max() > 360.0:
        lon = within_turn(lon)
    along = (lon * ((2.0**along_bits - 1.0) / 360.0)).astype(np.uint64)
    key = np.left_shift(ring, np.uint64(along_bits + row_bits), out=ring)  # in place, which saves four arrays
    key |= np.left_shift(along, np.uint64(row_bits), out=along)
    key |= np.arange(n, dtype=np.uint64)
    key.sort()  # NumPy sorts integers faster than it finds their order (argsort), so the row is part of the key
    return records.part((key & np.uint64(2**row_bits - 1)).astype(np.intp))


def _refuse_large_errors(one: Records, two: Records, tuning: CrossmatchTuning) -> None:
    """Refuses errors so large that every record is a candidate for every other: their unit is wrong."""
    n = len(one) + len(two)
    sigmas = threads.each([partial(_typical_sigma, records) for records in (one, two)], n)
    sigma = math.hypot(*sigmas)
    calls = [partial(_records_per_cell, records.features, sigma, tuning) for records in (one, two)]
    crowding = min(threads.each(calls, n))
    if crowding > tuning.max_records_per_error:
        worst = (one, two)[int(sigmas[1] > sigmas[0])].source
        raise InputError(
            f"{worst}: its typical error, {max(sigmas):.3g} arcsec, is so large that about {crowding:.0f} records lie "
            "within it in either catalogue",
            naming("are the errors in another unit? give {sigma_unit:UNIT}"),
            source=worst,
        )


def _typical_sigma(records: Records) -> float:
    """The median over the records of the root mean variance of both axes, arcsec."""
    return math.sqrt(median(0.5 * (records.covariance[:, 0] + records.covariance[:, -1])))


def _records_per_cell(position_deg: FloatArray, side_arcsec: float, tuning: CrossmatchTuning) -> float:
    """Mean number of records per occupied cell of this side."""
    lon, lat = position_deg.T
    side = side_arcsec / 3600.0
    ring = np.floor(lat / side)
    if len(ring) > tuning.sampled_from_rows:
        turns = (ring - ring[np.argmin(lat)]) / tuning.sampled_rings
        sampled = np.flatnonzero(np.floor(turns) == turns)
        lon, ring = lon[sampled], ring[sampled]
    along = np.floor(lon * np.cos(np.radians(ring * side)) / side)
    # Doubles hold integers up to 2⁵³: with cells below 5 mas some cells of different rings get the same number.
    cell = np.sort(ring * np.floor(360.0 / side + 2.0) + along)
    return len(lon) / (int(np.count_nonzero(np.diff(cell))) + 1)


def common_epoch(
    first: Catalogue, second: Catalogue, epoch_jyr: float | None, tuning: CrossmatchTuning = TUNING
) -> tuple[float | None, str]:
    """The common epoch, None if no positions are moved, and a sentence that explains it.

    A catalogue without proper motions stays at its epoch and the other one is moved; if both have proper motions, the
    epoch of the second is used.
    """
    if epoch_jyr is not None:
        return epoch_jyr, _given_epoch_note(first, second, epoch_jyr, tuning)
    epoch_1, epoch_2 = first.epoch_jyr, second.epoch_jyr
    if epoch_1 is None or epoch_2 is None:
        if not first.has_motion and not second.has_motion:
            return None, "neither catalogue has proper motions, and not both epochs are known: no positions are moved"
        without_epoch = first if epoch_1 is None else second
        raise InputError(
            f"{without_epoch.name}: its epoch is not known, so the other catalogue cannot be moved to it",
            naming("give {epoch:YEAR}"),
            source=without_epoch.name,
        )
    mover, target = (second, first) if second.has_motion and not first.has_motion else (first, second)
    epoch = target.epoch_jyr
    assert epoch is not None
    if abs(epoch_1 - epoch_2) < 0.01:
        return epoch, f"both catalogues are of epoch {epoch:.2f}"
    if mover.has_motion:
        return epoch, f"{mover.name} moved from {mover.epoch_jyr:.2f} to {epoch:.2f}, the epoch of {target.name}"
    return epoch, (
        f"neither catalogue has proper motions: the unknown motion of {mover.name} over "
        f"{abs(epoch_1 - epoch_2):.1f} years widens its errors"
    )


def _given_epoch_note(first: Catalogue, second: Catalogue, epoch_jyr: float, tuning: CrossmatchTuning) -> str:
    """A sentence that says which catalogues are moved to the epoch that was given."""
    moving = [catalogue for catalogue in (first, second) if catalogue.has_motion]
    if not moving:
        unmoved = "but neither catalogue has proper motions: no positions are moved, errors are widened"
        return f"{epoch_jyr:g} (option), {unmoved}"
    staying = _left_behind(first, second, epoch_jyr, tuning)
    if staying is None:
        names = "both catalogues" if len(moving) == 2 else moving[0].name
        return f"{names} moved to {epoch_jyr:g} (option)"
    stays = f"{staying.name} has no motions and stays at {staying.epoch_jyr:.2f}"
    return f"{moving[0].name} moved to {epoch_jyr:g} (option); {stays}"


def _left_behind(
    first: Catalogue, second: Catalogue, epoch_jyr: float | None, tuning: CrossmatchTuning
) -> Catalogue | None:
    """The catalogue without motions that stays years away from the given epoch while the other is moved; or None."""
    if epoch_jyr is None or first.has_motion == second.has_motion:
        return None
    staying = second if first.has_motion else first
    away = staying.epoch_jyr is not None and abs(staying.epoch_jyr - epoch_jyr) > tuning.same_epoch_years
    return staying if away else None


def left_behind_doubt(
    first: Catalogue, second: Catalogue, epoch_jyr: float | None, tuning: CrossmatchTuning = TUNING
) -> tuple[str, ...]:
    """A doubt about a given common epoch that only one catalogue can be moved to; empty if there is none.

    The stars of the other are then compared with where they were at its own epoch.
    """
    staying = _left_behind(first, second, epoch_jyr, tuning)
    if staying is None:
        return ()
    assert staying.epoch_jyr is not None
    moved = first if staying is second else second
    text = (
        f"{staying.name} has no proper motions and stays at {in_years(staying.epoch_jyr)}, while {moved.name} is moved "
        f"to {epoch_jyr:g}: stars that move are compared at two times; without a common epoch they are compared at "
        f"{in_years(staying.epoch_jyr)}"
    )
    return (text,)


def area_and_densities(coverage: Coverage) -> tuple[float, float, float]:
    """Area covered by both catalogues, deg², and the mean density of each catalogue there, per deg²."""
    area_deg2 = coverage.common_volume / ARCSEC2_PER_DEG2
    count_1, count_2 = (int(np.count_nonzero(covered)) for covered in coverage.covered)
    if not area_deg2 > 0.0:
        return 0.0, 0.0, 0.0
    return area_deg2, count_1 / area_deg2, count_2 / area_deg2


def density_doubts(coverage: Coverage, options: MatchOptions, tuning: CrossmatchTuning = TUNING) -> tuple[str, ...]:
    """Doubts about given densities that the data contradict."""
    if options.density_per_deg2 is None:
        return ()
    _, *observed = area_and_densities(coverage)
    least, largest = tuning.usual_density
    lines = []
    for records, per_deg2, option in zip(
        (coverage.first, coverage.second), observed, options.density_per_deg2, strict=True
    ):
        if per_deg2 and not least < option / per_deg2 < largest:
            lines.append(
                f"density: {option:g} per square degree was given for {records.source}, but in the common area "
                f"it has {per_deg2:.3g}: is the density per square degree?"
            )
    return tuple(lines)


def _error_doubts(match: SkyMatch, tuning: CrossmatchTuning) -> tuple[str, ...]:
    """Doubts about the unit of the errors and large groups."""
    result, estimate, doubts = match.result, match.estimate, []
    calls = [partial(median, records.covariance[:, 0]) for records in (result.first, result.second)]
    sigma = [math.sqrt(variance) for variance in threads.each(calls, len(result.first))]
    spacing = 0.5 * math.sqrt(estimate.coverage.common_volume / max(len(result.first), len(result.second)))
    widest = max(range(2), key=lambda k: sigma[k])
    if sigma[widest] > spacing > 0.0:
        name = (result.first, result.second)[widest].source
        doubts.append(
            f"{name}: its typical error, {sigma[widest]:.3g} arcsec, is larger than half the spacing of the records, "
            f"{spacing:.3g} arcsec: are the errors in the assumed unit?"
        )
    scale = estimate.typical_scale
    least, largest = tuning.usual_scale
    if scale > largest or scale < least:
        # Averaged over few pairs, the scale ends where the tried ones do.
        seen = estimate.quantities.get("error_scale") if estimate.error_ranges is not None else None
        size = f"the residuals are {scale if seen is None else seen.value:.2g} times what the quoted errors say: "
        years = _unmoved_years(match.first, match.second)
        if scale < least:
            doubts.append(f"{size}is one a copy of the other, or are their units wrong?")
        elif years < 1.0:
            doubts.append(f"{size}are their units right?")
        else:
            moved = f"are their units right? Or have objects moved farther in {years:.0f} years than "
            doubts.append(Message(size, moved, naming("{missing_pm}"), " says?"))
    if result.approximate_pairs:
        count = result.approximate_pairs
        doubts.append(f"{count} candidates lie in large groups; their probabilities are approximate")
    return tuple(doubts)


def _unmoved_years(first: Catalogue, second: Catalogue) -> float:
    """Years between the epochs of two catalogues without proper motions; 0 if one has some, or an epoch is unknown."""
    if first.has_motion or second.has_motion or first.epoch_jyr is None or second.epoch_jyr is None:
        return 0.0
    return abs(first.epoch_jyr - second.epoch_jyr)


def _blend_doubts(result: Identification, estimate: Estimate) -> tuple[str, ...]:
    """A doubt about one-to-one matching if records of one catalogue seem to be blends of two of the other."""
    doubts = []
    for coarse, fine in ((result.first, result.second), (result.second, result.first)):
        blends = suspected_blends(result, estimate.errors, estimate.coverage, 0 if coarse is result.first else 1)
        if blends is not None:
            count, within, sigmas = blends
            one, other = coarse.source, fine.source
            first = "" if coarse is result.first else f"; {one} must then be the first catalogue"
            seen = (
                f"{one} may show two objects of {other} as one: within {within:.2g} arcsec of {count} of its pairs "
                f"lies one of {other} without partner, and residuals point there ({sigmas:.0f} standard errors): "
            )
            remedy = "a match with ", naming("{blends}"), f", the resolution of {one} in arcsec, lists them{first}"
            doubts.append(Message(seen, *remedy))
    return tuple(doubts)


def _duplicate_doubts(result: Identification, estimate: Estimate, tuning: CrossmatchTuning) -> tuple[str, ...]:
    """A doubt about records of one catalogue that seem to be the same object."""
    found, doubts = close_neighbours(Setting.whole(result.pairs, estimate.coverage)), []
    for records, close in zip((result.first, result.second), found or (), strict=False):
        excess = close.n_pairs - close.by_chance
        significant = tuning.duplicate_sigmas * math.sqrt(close.by_chance + tuning.duplicate_sigmas)
        if excess > max(significant, tuning.duplicate_share * close.n_records):
            doubts.append(
                f"in {records.source} {close.n_pairs} couples of records lie within their errors of each other, where "
                f"chance makes {close.by_chance:.0f}: if they are one object given twice (two exposures, a deblender), "
                "its probability is divided between the two; give each object once, or add p_second to p_match"
            )
    return tuple(doubts)


def _fits_as_b1950(old: Records, new: Records, tuning: CrossmatchTuning) -> bool:
    """Whether far more records of ``old`` than by chance have a neighbour in ``new`` if their equinox is B1950."""
    some = old.part(np.arange(0, len(old), max(1, len(old) // tuning.b1950_records)))
    near = [
        np.count_nonzero(
            nearest(replace(some, features=at), new).separation_arcsec.filled(np.inf) < tuning.b1950_arcsec
        )
        for at in (some.features, in_icrs("B1950", some.features))
    ]
    return bool(near[1] > near[0] + 5.0 * math.sqrt(near[0] + 5.0) and near[1] > tuning.b1950_share * len(some))


def _search_doubts(search: Rotation, warp: Warp | None) -> tuple[str, ...]:
    """Doubts about a rotation that was searched for."""
    if not search.by_chance:
        return search.notes
    return (*search.notes, "no offset was removed" if warp is None else "no shift or rotation was removed")


def _offset_doubts(result: Identification, estimate: Estimate, tuning: CrossmatchTuning) -> tuple[str, ...]:
    """A doubt about the frames if the pairs have a mean offset, or there are hardly any pairs."""
    if _hardly_any_common(result, estimate, tuning):
        few = (
            f"{result.first.source} and {result.second.source} have hardly any objects in common "
            f"({estimate.quantities['common']} objects); "
        )
        sides = (result.first, result.second), (result.second, result.first)
        for old, new in sides:
            if _fits_as_b1950(old, new, tuning):
                fit = f"of the equinox B1950 the positions of {old.source} would be those of {new.source}: "
                return (f"{few}{fit}call its columns ra1950 and dec1950",)
        few += "one may be offset from the other by more than their errors: "
        return (Message(few, naming("{offset:'find'} searches for it")),)
    offset = residual_rotation(result, estimate.errors)
    if offset is None:
        return ()
    rotation, share = offset
    one, other = result.first.source, result.second.source
    share_words = f"{share:.1g}" if share < 9.5 else f"{share:.0f}"
    off = f"{other} is offset from {one} by up to {share_words} of a pair's error ({rotation}): "
    return (Message(off, naming("give {offset:'find'} to remove it")),)


def _hardly_any_common(result: Identification, estimate: Estimate, tuning: CrossmatchTuning) -> bool:
    """Whether the number of common objects is small and consistent with zero by its standard error."""
    if estimate.common > tuning.min_common_share * min(len(result.first), len(result.second)):
        return False
    return estimate.common <= max(0.5, tuning.min_common_sigmas * estimate.quantities["common"].standard_error)


def _near_miss_doubts(result: Identification, estimate: Estimate, tuning: CrossmatchTuning) -> tuple[str, ...]:
    """A doubt about the errors if records lie close to each other, but not within their errors."""
    first, second = result.first, result.second
    _, _, density_2 = area_and_densities(estimate.coverage)
    if estimate.common > tuning.min_common_share * min(len(first), len(second)) or not density_2:
        return ()
    near = float(np.quantile(nearest(first, second).separation_arcsec.filled(np.inf), 0.25))
    by_chance = math.sqrt(math.log(4.0 / 3.0) * ARCSEC2_PER_DEG2 / (math.pi * density_2))
    if near > tuning.max_spacing_share * by_chance:
        return ()
    missed = (
        f"a quarter of {first.source} lies within {near:.2g} arcsec of a record of {second.source}, by chance it would "
        f"be {by_chance:.2g}, but hardly any within its errors: are the errors in the assumed unit? "
    )
    return (Message(missed, naming("Or is one shifted ({offset:'find'})?")),)


def _unmoved(records: Records, catalogue: Catalogue) -> Records:
    """The records at the positions of the catalogue's own epochs."""
    astrometry = catalogue.astrometry
    position = np.column_stack([astrometry.ra_deg, astrometry.dec_deg])[records.rows]
    return Records(position, records.covariance, records.rows, records.ids, records.space, records.source)


def _number(value: float | str) -> float | None:
    try:
        return float(value)
    except ValueError:
        return None
