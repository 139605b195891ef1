"""Two catalogues identified: brought to one epoch, everything unknown estimated, and what motion did to the residuals.

Data passes: two :class:`Catalogue` → epoch → two ``Records`` on the sphere → ``estimate.match`` → :class:`SkyMatch`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError, Message, naming
from sameas.estimate.blends import suspected
from sameas.estimate.companions import close_couples
from sameas.estimate.coverage import Coverage
from sameas.estimate.match import Estimate
from sameas.estimate.match import match as estimated
from sameas.estimate.sample import Setting
from sameas.evidence import Column, Errors, Related
from sameas.gate import ChiSquare, Radius
from sameas.kernels import threads
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification
from sameas.sky.bands import AUTO, columns_of, magnitudes_of
from sameas.sky.catalogue import Catalogue
from sameas.sky.doubts import apart_doubts, completed, epoch_doubt
from sameas.sky.systematics import WARP_TUNING, Rotation, Warp, find_rotation, find_warp, residual_rotation
from sameas.space import ARCSEC_PER_RADIAN, sphere_offset, unit_vectors


@in_short
@dataclass(frozen=True)
class Nearest:
    """The nearest neighbour, one record at a time: what most programs give, here to be compared with.

    rows : (n,) table row of the nearest record; separation_arcsec : (n,) its distance.
    """

    rows: IntArray
    separation_arcsec: FloatArray


def nearest(first: Records, second: Records) -> Nearest:
    """The nearest record of ``second`` to each record of ``first``, on the sphere, whatever their errors."""
    from scipy.spatial import cKDTree

    distance, at = cKDTree(unit_vectors(*second.features.T)).query(unit_vectors(*first.features.T), workers=-1)
    return Nearest(second.rows[at], 2.0 * np.arcsin(np.minimum(distance / 2.0, 1.0)) * ARCSEC_PER_RADIAN)


ARCSEC2_PER_DEG2 = 3600.0**2


@dataclass(frozen=True)
class CrossmatchTuning:
    """From where a result is refused or doubted; all chosen.

    Attributes
    ----------
    most_records_per_error : more records of either catalogue within one typical error are refused: positions cannot
        tell them apart, and the unit of the errors is probably wrong.
    sampled_from_rows, sampled_rings : from this number of rows on that is judged by one ring of cells in this number.
    least_common_share, least_common_sigmas : catalogues have hardly any objects in common where the expected number of
        common objects is at most this share of the smaller catalogue and at most this many of its standard errors.
    most_spacing_share : a quarter of the records nearer to another catalogue's than this share of what chance gives,
        without common objects, makes the errors doubtful.
    usual_scale : (least, largest) residuals over quoted errors that raise no doubt.
    usual_density : (least, largest) density that the user gave over the one that the data show that raise no doubt.
    twice_sigmas, twice_share : couples of records of one catalogue, nearer to each other than their errors, are doubted
        where they are more than chance lets expect by so many standard deviations, and by this share of the records.
    by_place : whether records are put in the order of their places: what is learned from every k-th of them does then
        not depend on the order of the tables' rows, and what lies together in the sky is asked for together, and
        fetched once (a million rows in the order of a table take a third longer).
    """

    most_records_per_error: float = 20.0
    sampled_from_rows: int = 100_000
    sampled_rings: float = 16.0
    least_common_share: float = 0.05
    least_common_sigmas: float = 3.0
    most_spacing_share: float = 0.2
    usual_scale: tuple[float, float] = (0.3, 5.0)
    usual_density: tuple[float, float] = (0.01, 100.0)
    twice_sigmas: float = 5.0
    twice_share: float = 0.03
    by_place: bool = True


TUNING = CrossmatchTuning()


@in_short
@dataclass(frozen=True)
class MatchOptions:
    """Options of a match; what is left out is estimated from the catalogues.

    epoch_jyr : common epoch, Julian year. gate_sigmas : radius of the gate in quoted standard deviations.
    error_scale : "auto" estimates how residuals spread about the quoted errors; a number takes that factor, ``Errors``
        that mixture of factors.
    density_per_deg2 : (first, second) densities of all records, instead of local ones from the data.
    magnitudes : "auto" takes those of both catalogues as evidence, "off" leaves it to the positions; columns by name
        as "G,BP:J,H" (see ``sky.bands``).
    precision : whether the sizes of the quoted errors are evidence too, where magnitudes tell too little.
    offset : "none" takes both catalogues to be on one frame, and doubts it where the pairs show an offset; "find"
        estimates the shift and rotation of the second catalogue and takes it away, and
        a smooth warp of the field beside it (see :mod:`sameas.sky.systematics`).
    evidence : columns of either catalogue that are evidence too, by name, alone or related to one of the other.
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
        """The spread of the residuals, None where it is to be estimated."""
        if self.error_scale == "auto":
            return None
        if isinstance(self.error_scale, Errors):
            return self.error_scale
        scale = _number(self.error_scale)
        if scale is None or not 0.0 < scale < math.inf:
            raise InputError(f'error scale is {self.error_scale!r}; give "auto" or a positive factor')
        return Errors((scale,), (1.0,))

    def gate(self) -> ChiSquare | Radius | None:
        """The gate, None where it is to be chosen."""
        return None if self.gate_sigmas is None else Radius(self.gate_sigmas)

    def density(self) -> tuple[float, float] | None:
        """Densities per arcsec², None where they come from the data."""
        if self.density_per_deg2 is None:
            return None
        if not all(0.0 < value < math.inf for value in self.density_per_deg2):
            raise InputError("density: give two positive numbers, records per square degree of either catalogue")
        return self.density_per_deg2[0] / ARCSEC2_PER_DEG2, self.density_per_deg2[1] / ARCSEC2_PER_DEG2


@in_short
@dataclass(frozen=True)
class SkyMatch:
    """Two catalogues identified.

    epoch_jyr : the epoch both were brought to, None where each stayed where it was observed.
    moved : one sentence on what was moved and why. doubts : what looks wrong with the result.
    rotation : of the second catalogue onto the first; None where it was not looked for, or chance explains it as well.
    warp : what is left after that, of higher order, and was taken away too; None likewise.
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
        """(n,) whether the second catalogue looks where each row of the first lies; True for unusable rows."""
        return self.result.first.over_table(self.estimate.coverage.covered[0])

    @cached_property
    def covered_2(self) -> BoolArray:
        """(n,) whether the first catalogue looks where each row of the second lies; True for unusable rows."""
        return self.result.second.over_table(self.estimate.coverage.covered[1])

    @cached_property
    def still_offsets(self) -> FloatArray:
        """(k, 2) east and north offsets of the identified pairs, arcsec, each at its own catalogue's epoch."""
        a, b = self.first.astrometry, self.second.astrometry
        i, j = self.result.matches.rows_1, self.result.matches.rows_2
        return sphere_offset(a.ra_deg[i], a.dec_deg[i], b.ra_deg[j], b.dec_deg[j])

    @cached_property
    def area_and_densities(self) -> tuple[float, float, float]:
        """Area where both catalogues look, deg², and mean densities there of all their records, per deg²."""
        return area_and_densities(self.estimate.coverage)

    def nearest(self, moved: bool) -> Nearest:
        """The nearest record of the second catalogue to each row of the first table, with or without motion.

        A row that cannot be used has none: −1, at infinity.
        """
        one, two = self.result.first, self.result.second
        near = nearest(one, two) if moved else nearest(_unmoved(one, self.first), _unmoved(two, self.second))
        rows, separation = np.full(one.n_table, -1), np.full(one.n_table, np.inf)
        rows[one.rows], separation[one.rows] = near.rows, near.separation_arcsec
        return Nearest(rows, separation)


def match(
    first: Catalogue,
    second: Catalogue,
    options: MatchOptions | None = None,
    *,
    progress: Callable[[str], None] = lambda stage: None,
    tuning: CrossmatchTuning = TUNING,
) -> SkyMatch:
    """Identify two catalogues.

    Parameters
    ----------
    first, second : the catalogues.
    options : what is known beforehand. progress : called with the name of what is being done.
    tuning : from where the result is refused or doubted.

    Raises
    ------
    InputError : no usable rows; a common epoch is needed and not known.
    """
    options = MatchOptions() if options is None else options
    progress("motion")
    (first, second), assumed = completed((first, second), options.epoch_jyr)
    epoch, words, one, two = brought_together(first, second, options.epoch_jyr)
    if tuning.by_place:
        one, two = threads.each([partial(by_place, records) for records in (one, two)], len(one) + len(two))
    _refuse_blur(one, two, tuning)
    search = find_rotation(one, two, progress) if options.offset == "find" else None
    rotation = None if search is None or search.by_chance else search
    if rotation is not None:
        two = rotation.of(two)
    identified = partial(
        estimated, errors=options.errors(), gate=options.gate(), density=options.density(),
        brightness=magnitudes_of(first, second, options.magnitudes), precision=options.precision,
        evidence=columns_of(first, second, options.evidence, options.magnitudes), progress=progress,
    )  # fmt: skip
    result, estimate = identified(one, two)
    warp: Warp | None = None
    for _ in range(WARP_TUNING.passes if search is not None else 0):
        progress("warp")
        found = find_warp(result, warp)
        if found is None:
            break
        warp = found
        result, estimate = identified(one, warp.of(two))
    doubts = assumed + density_doubts(estimate.coverage, options, tuning)
    doubts += _error_doubts(result, estimate, tuning) + _near_miss_doubts(result, estimate, tuning)
    apart = apart_doubts(first, second, one, two) if _next_to_nothing(result, estimate, tuning) else ()
    late, explained = epoch_doubt(first, second, epoch, result, estimate.typical_scale)
    doubts += (*apart, late) if late else apart
    if search is not None:
        doubts += _search_doubts(search, warp)
    elif not apart and not explained:
        doubts += _offset_doubts(result, estimate, tuning)
    doubts += _blend_doubts(result, estimate) + _twice_doubts(result, estimate, tuning)
    return SkyMatch(first, second, epoch, words, result, estimate, doubts, rotation, warp)


def brought_together(
    first: Catalogue, second: Catalogue, epoch_jyr: float | None = None
) -> tuple[float | None, str, Records, Records]:
    """The common epoch, the sentence that says so, and both catalogues' records at it.

    Raises
    ------
    InputError : no usable rows; a common epoch is needed and not known.
    """
    epoch, words = common_epoch(first, second, epoch_jyr)
    works = [partial(catalogue.records, epoch) for catalogue in (first, second)]
    one, two = threads.each(works, len(first) + len(second))
    for catalogue, records in ((first, one), (second, two)):
        if not len(records):
            counts = records.set_aside.counts()
            reasons = ", ".join(f"{reason} ({n})" for reason, n in counts.items())
            remedy = naming("an error of 0 counts as none: give {sigma:ARCSEC}") if "no error" in counts else ""
            message = f"{catalogue.name}: none of its {len(catalogue)} rows can be used: {reasons}"
            raise InputError(message, remedy, source=catalogue.name)
    return epoch, words, one, two


#: Mean number of records to a ring of equal height for each of the rings: a ring is so high that some ten records lie
#: in a square of it. Bits of the number of a ring.
_IN_SQUARE, _RING_BITS = 10.0, 12


def by_place(records: Records) -> Records:
    """The records ring of declination by ring, along each ring from west to east."""
    lon, lat = (np.ascontiguousarray(of) for of in records.features.T)
    n, south, north = len(records), float(lat.min()), float(lat.max())
    rings = min(math.ceil(math.sqrt(n / _IN_SQUARE)), 2**_RING_BITS)
    row_bits = n.bit_length()
    along_bits = 64 - _RING_BITS - row_bits
    ring = np.minimum((lat - south) * (rings / max(north - south, 1e-300)), rings - 1).astype(np.uint64)
    if lon.min() < 0.0 or lon.max() > 360.0:
        lon = np.mod(lon, 360.0)
    along = (lon * ((2.0**along_bits - 1.0) / 360.0)).astype(np.uint64)
    key = ring << np.uint64(along_bits + row_bits) | along << np.uint64(row_bits) | np.arange(n, dtype=np.uint64)
    key.sort()  # of numbers NumPy sorts many at a time; their order it finds one by one
    return records.part((key & np.uint64(2**row_bits - 1)).astype(np.intp))


def _refuse_blur(one: Records, two: Records, tuning: CrossmatchTuning) -> None:
    """Refuses errors so large that all records are candidates of all others: their unit is wrong."""
    n = len(one) + len(two)
    sigmas = threads.each([partial(_typical_sigma, records) for records in (one, two)], n)
    sigma = math.hypot(*sigmas)
    works = [partial(_records_per_cell, records.features, sigma, tuning) for records in (one, two)]
    crowd = min(threads.each(works, n))
    if crowd > tuning.most_records_per_error:
        worst = (one, two)[int(sigmas[1] > sigmas[0])].source
        raise InputError(
            f"{worst}: its typical error, {max(sigmas):.3g} arcsec, is so large that about {crowd:.0f} records lie "
            "within it in either catalogue",
            naming("are the errors in another unit? give {sigma_unit:UNIT}"),
            source=worst,
        )


def _typical_sigma(records: Records) -> float:
    """The median of the errors, each the root of the mean variance of both axes."""
    return math.sqrt(float(np.median(0.5 * (records.covariance[:, 0] + records.covariance[:, -1]))))


def _records_per_cell(position_deg: FloatArray, side_arcsec: float, tuning: CrossmatchTuning) -> float:
    """Mean number of records in the occupied cells of this size."""
    lon, lat = position_deg.T
    side = side_arcsec / 3600.0
    ring = np.floor(lat / side)
    if len(ring) > tuning.sampled_from_rows:
        some = np.flatnonzero(np.mod(ring - ring[np.argmin(lat)], tuning.sampled_rings) == 0.0)
        lon, ring = lon[some], ring[some]
    along = np.floor(lon * np.cos(np.radians(ring * side)) / side)
    # Doubles hold whole numbers up to 2⁵³: rings of cells smaller than 5 mas would be taken together here and there.
    cell = np.sort(ring * np.floor(360.0 / side + 2.0) + along)
    return len(lon) / (int(np.count_nonzero(np.diff(cell))) + 1)


def common_epoch(first: Catalogue, second: Catalogue, epoch_jyr: float | None) -> tuple[float | None, str]:
    """The epoch to bring both catalogues to, None for no motion at all, and a sentence that says so.

    A catalogue without proper motions stays at its own epoch and the other one moves; where both can move, the
    second one's epoch is taken.
    """
    if epoch_jyr is not None:
        return epoch_jyr, f"both catalogues moved to {epoch_jyr:g} (option)"
    epoch_1, epoch_2 = first.epoch_jyr, second.epoch_jyr
    if epoch_1 is None or epoch_2 is None:
        if not first.has_motion and not second.has_motion:
            return None, "neither catalogue has proper motions, and not both epochs are known: no positions are moved"
        still = first if epoch_1 is None else second
        raise InputError(
            f"{still.name}: its epoch is not known, so the other catalogue cannot be moved to it",
            naming("give {epoch:YEAR}"),
            source=still.name,
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


def area_and_densities(coverage: Coverage) -> tuple[float, float, float]:
    """Area where both catalogues look, deg², and mean densities there of all their records, per deg²."""
    area_deg2 = coverage.common_volume / ARCSEC2_PER_DEG2
    count_1, count_2 = (int(np.count_nonzero(covered)) for covered in coverage.covered)
    if not area_deg2 > 0.0:
        return 0.0, 0.0, 0.0
    return area_deg2, count_1 / area_deg2, count_2 / area_deg2


def density_doubts(coverage: Coverage, options: MatchOptions, tuning: CrossmatchTuning = TUNING) -> tuple[str, ...]:
    """Doubts of densities that the user gave and the data contradict."""
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


def _error_doubts(result: Identification, estimate: Estimate, tuning: CrossmatchTuning) -> tuple[str, ...]:
    """Doubts of the errors' unit, and the notes of the estimate."""
    doubts = list(estimate.notes)
    works = [partial(np.median, records.covariance[:, 0]) for records in (result.first, result.second)]
    sigma = [math.sqrt(float(median)) for median in threads.each(works, len(result.first))]
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
        asked = "is one a copy of the other, or are their units wrong?" if scale < least else "are their units right?"
        doubts.append(f"the residuals are {scale:.2g} times what the quoted errors say: {asked}")
    if result.approximate_pairs:
        count = result.approximate_pairs
        doubts.append(f"{count} candidates lie in large groups; their probabilities are approximate")
    return tuple(doubts)


def _blend_doubts(result: Identification, estimate: Estimate) -> tuple[str, ...]:
    """A doubt of one-to-one where records of one catalogue seem to be two objects of the other."""
    doubts = []
    for coarse, fine in ((result.first, result.second), (result.second, result.first)):
        seen = suspected(result, estimate.errors, estimate.coverage, 0 if coarse is result.first else 1)
        if seen is not None:
            number, within, sigmas = seen
            one, other = coarse.source, fine.source
            first = "" if coarse is result.first else f", {one} given first,"
            doubts.append(
                f"{one} may show two objects of {other} as one: within {within:.2g} arcsec of {number} of its pairs "
                f"lies one of {other} without partner, and residuals point there ({sigmas:.0f} standard errors): "
                f"`blends`{first} lists them, given the resolution of {one}"
            )
    return tuple(doubts)


def _twice_doubts(result: Identification, estimate: Estimate, tuning: CrossmatchTuning) -> tuple[str, ...]:
    """A doubt of records that seem to be of one object of the same catalogue."""
    found, doubts = close_couples(Setting.whole(result.pairs, estimate.coverage)), []
    for records, close in zip((result.first, result.second), found or (), strict=False):
        beyond = close.couples - close.by_chance
        significant = tuning.twice_sigmas * math.sqrt(close.by_chance + tuning.twice_sigmas)
        if beyond > max(significant, tuning.twice_share * close.records):
            doubts.append(
                f"in {records.source} {close.couples} couples of records lie within their errors of each other, where "
                f"chance makes {close.by_chance:.0f}: if they are one object given twice (two exposures, a deblender), "
                "its probability is divided between the two; give each object once, or add p_second to p_match"
            )
    return tuple(doubts)


def _search_doubts(search: Rotation, warp: Warp | None) -> tuple[str, ...]:
    """Doubts of a rotation that was looked for."""
    if not search.by_chance:
        return search.notes
    return (*search.notes, "no offset was removed" if warp is None else "no shift or rotation was removed")


def _offset_doubts(result: Identification, estimate: Estimate, tuning: CrossmatchTuning) -> tuple[str, ...]:
    """A doubt of the frames where the pairs are offset on the average, or there are no pairs."""
    if _next_to_nothing(result, estimate, tuning):
        few = (
            f"{result.first.source} and {result.second.source} have hardly any objects in common "
            f"({estimate.quantities['common']} objects); one may be offset from the other by more than their errors: "
        )
        return (Message(few, naming("{offset:'find'} searches for it")),)
    offset = residual_rotation(result, estimate.typical_scale)
    if offset is None:
        return ()
    rotation, share = offset
    one, other = result.first.source, result.second.source
    off = f"{other} is offset from {one} by up to {share:.1g} of a pair's error ({rotation}): "
    return (Message(off, naming("give {offset:'find'} to remove it")),)


def _next_to_nothing(result: Identification, estimate: Estimate, tuning: CrossmatchTuning) -> bool:
    """Whether the common objects are few, and no more than their standard error lets chance give."""
    if estimate.common > tuning.least_common_share * min(len(result.first), len(result.second)):
        return False
    return estimate.common <= max(0.5, tuning.least_common_sigmas * estimate.quantities["common"].standard_error)


def _near_miss_doubts(result: Identification, estimate: Estimate, tuning: CrossmatchTuning) -> tuple[str, ...]:
    """A doubt of the errors where the records coincide, but not within their errors."""
    first, second = result.first, result.second
    _, _, density_2 = area_and_densities(estimate.coverage)
    if estimate.common > tuning.least_common_share * min(len(first), len(second)) or not density_2:
        return ()
    near = float(np.quantile(nearest(first, second).separation_arcsec, 0.25))
    by_chance = math.sqrt(math.log(4.0 / 3.0) * ARCSEC2_PER_DEG2 / (math.pi * density_2))
    if near > tuning.most_spacing_share * by_chance:
        return ()
    missed = (
        f"a quarter of {first.source} lies within {near:.2g} arcsec of a record of {second.source}, by chance it would "
        f"be {by_chance:.2g}, but hardly any within its errors: are the errors in the assumed unit? "
    )
    return (Message(missed, naming("Or is one shifted ({offset:'find'})?")),)


def _unmoved(records: Records, catalogue: Catalogue) -> Records:
    at = catalogue.astrometry
    position = np.column_stack([at.ra_deg, at.dec_deg])[records.rows]
    return Records(position, records.covariance, records.rows, records.ids, records.space, records.source)


def _number(value: float | str) -> float | None:
    try:
        return float(value)
    except ValueError:
        return None


__all__ = [
    "MatchOptions", "SkyMatch", "area_and_densities", "brought_together", "by_place", "common_epoch",
    "density_doubts", "match",
]  # fmt: skip
