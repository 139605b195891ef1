"""Crossmatch of two catalogues: moved to a common epoch, matched with estimated parameters, checked for doubts.

Data flow: two :class:`Catalogue` → common epoch → two ``Records`` on the sphere → ``estimate.match`` →
:class:`SkyMatch`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sameas.arrays import FloatArray, median, within_turn
from sameas.errors import InputError, naming
from sameas.estimate.match import match as estimate_match
from sameas.evidence import Column, Errors, Related
from sameas.gate import ChiSquare, Radius
from sameas.kernels import threads
from sameas.records import Records
from sameas.representation import in_short
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import in_years
from sameas.sky.completion import completed
from sameas.sky.disjoint import disjoint_doubt
from sameas.sky.evidence_columns import AUTO, columns_of, magnitudes_of
from sameas.sky.match_doubts import density_doubts, hardly_any_common, match_doubts
from sameas.sky.sky_match import ARCSEC2_PER_DEG2, SkyMatch
from sameas.sky.systematics import WARP_PASSES, Warp, find_rotation, find_warp

#: More records per typical error, in both catalogues, are refused: positions cannot separate them, and the unit of the
#: errors is probably wrong.
MAX_RECORDS_PER_ERROR = 20.0
#: Tables longer than SAMPLED_FROM_ROWS are checked for this on one declination ring of cells in SAMPLED_RINGS.
SAMPLED_FROM_ROWS, SAMPLED_RINGS = 100_000, 16.0
#: A catalogue without motions whose epoch differs by more years from a given common epoch raises a doubt (chosen).
SAME_EPOCH_YEARS = 0.5


def error_factor(error_scale: float | str) -> float | None:
    """The given factor on the quoted errors, None for "auto": it is to be estimated.

    Raises InputError: anything else than "auto" or a positive number.
    """
    if error_scale == "auto":
        return None
    try:
        factor = float(error_scale)
    except ValueError:
        factor = math.nan
    if not 0.0 < factor < math.inf:
        raise InputError(f'error scale is {error_scale!r}; give "auto" or a positive factor')
    return factor


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
        if isinstance(self.error_scale, Errors):
            return self.error_scale
        factor = error_factor(self.error_scale)
        return None if factor is None else Errors((factor,), (1.0,))

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


def match(
    first: Catalogue,
    second: Catalogue,
    options: MatchOptions | None = None,
    *,
    progress: Callable[[str], None] = lambda stage: None,
) -> SkyMatch:
    """Crossmatch of two catalogues.

    Parameters
    ----------
    first, second : the catalogues.
    options : given values. progress : called with the name of the current stage.

    Raises
    ------
    InputError : no usable rows; a common epoch is needed and not known.
    """
    options = MatchOptions() if options is None else options
    progress("motion")
    (first, second), assumed = completed((first, second), options.epoch_jyr)
    epoch, epoch_note, one, two = at_common_epoch(first, second, options.epoch_jyr)
    # Samples of every k-th record then do not depend on the order of the rows, and neighbours on the sky are neighbours
    # in memory (a million rows in table order take a third longer).
    one, two = threads.each([partial(by_position, records) for records in (one, two)], len(one) + len(two))
    _refuse_large_errors(one, two)
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
    for _ in range(WARP_PASSES if search is not None else 0):
        progress("warp")
        next_warp = find_warp(result, warp)
        if next_warp is None:
            break
        warp = next_warp
        result, estimate = run_match(one, warp.of(two))
    matched = SkyMatch(first, second, epoch, epoch_note, result, estimate, (), rotation, warp)
    disjoint = disjoint_doubt(first, second, one, two) if hardly_any_common(result, estimate) else ()
    left_behind = left_behind_doubt(first, second, options.epoch_jyr)
    doubts = assumed + left_behind + density_doubts(estimate.coverage, options.density_per_deg2)
    doubts += match_doubts(matched, search, disjoint, left_behind)
    return replace(matched, doubts=doubts)


def at_common_epoch(
    first: Catalogue, second: Catalogue, epoch_jyr: float | None = None
) -> tuple[float | None, str, Records, Records]:
    """The common epoch, a sentence that explains it, and the records of both catalogues at this epoch.

    Raises InputError: no usable rows; a common epoch is needed and not known.
    """
    epoch, note = common_epoch(first, second, epoch_jyr)
    calls = [partial(catalogue.records, epoch) for catalogue in (first, second)]
    one, two = threads.each(calls, len(first) + len(second))
    for catalogue, records in ((first, one), (second, two)):
        refuse_unusable(catalogue, records)
    return epoch, note, one, two


def refuse_unusable(catalogue: Catalogue, records: Records) -> None:
    """Refuse a catalogue of which no row can be used, with the reasons."""
    if not len(records):
        counts = records.set_aside.counts()
        reasons = ", ".join(f"{reason} ({n})" for reason, n in counts.items())
        remedy = naming("an error of 0 or less counts as none: give {sigma:ARCSEC}") if "no error" in counts else ""
        message = f"{catalogue.name}: none of its {len(catalogue)} rows can be used: {reasons}"
        raise InputError(message, remedy, source=catalogue.name)


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


def _refuse_large_errors(one: Records, two: Records) -> None:
    """Refuses errors so large that every record is a candidate for every other: their unit is wrong."""
    n = len(one) + len(two)
    sigmas = threads.each([partial(typical_sigma_arcsec, records) for records in (one, two)], n)
    sigma = math.hypot(*sigmas)
    calls = [partial(_records_per_cell, records.features, sigma) for records in (one, two)]
    crowding = min(threads.each(calls, n))
    if crowding > MAX_RECORDS_PER_ERROR:
        worst = (one, two)[int(sigmas[1] > sigmas[0])].source
        raise InputError(
            f"{worst}: its typical error, {max(sigmas):.3g} arcsec, is so large that about {crowding:.0f} records lie "
            "within it in either catalogue",
            naming("are the errors in another unit? give {sigma_unit:UNIT}"),
            source=worst,
        )


def typical_sigma_arcsec(records: Records) -> float:
    """The median over the records of the root mean variance of both axes, arcsec."""
    return math.sqrt(median(0.5 * (records.covariance[:, 0] + records.covariance[:, -1])))


def _records_per_cell(position_deg: FloatArray, side_arcsec: float) -> float:
    """Mean number of records per occupied cell of this side."""
    lon, lat = position_deg.T
    side = side_arcsec / 3600.0
    ring = np.floor(lat / side)
    if len(ring) > SAMPLED_FROM_ROWS:
        turns = (ring - ring[np.argmin(lat)]) / SAMPLED_RINGS
        sampled = np.flatnonzero(np.floor(turns) == turns)
        lon, ring = lon[sampled], ring[sampled]
    along = np.floor(lon * np.cos(np.radians(ring * side)) / side)
    # Doubles hold integers up to 2⁵³: with cells below 5 mas some cells of different rings get the same number.
    cell = np.sort(ring * np.floor(360.0 / side + 2.0) + along)
    return len(lon) / (int(np.count_nonzero(np.diff(cell))) + 1)


def common_epoch(first: Catalogue, second: Catalogue, epoch_jyr: float | None) -> tuple[float | None, str]:
    """The common epoch, None if no positions are moved, and a sentence that explains it.

    A catalogue without proper motions stays at its epoch and the other one is moved; if both have proper motions, the
    epoch of the second is used.
    """
    if epoch_jyr is not None:
        return epoch_jyr, _given_epoch_note(first, second, epoch_jyr)
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


def _given_epoch_note(first: Catalogue, second: Catalogue, epoch_jyr: float) -> str:
    """A sentence that says which catalogues are moved to the epoch that was given."""
    moving = [catalogue for catalogue in (first, second) if catalogue.has_motion]
    if not moving:
        unmoved = "but neither catalogue has proper motions: no positions are moved, errors are widened"
        return f"{epoch_jyr:g} (option), {unmoved}"
    staying = _left_behind(first, second, epoch_jyr)
    if staying is None:
        names = "both catalogues" if len(moving) == 2 else moving[0].name
        return f"{names} moved to {epoch_jyr:g} (option)"
    stays = f"{staying.name} has no motions and stays at {staying.epoch_jyr:.2f}"
    return f"{moving[0].name} moved to {epoch_jyr:g} (option); {stays}"


def _left_behind(first: Catalogue, second: Catalogue, epoch_jyr: float | None) -> Catalogue | None:
    """The catalogue without motions that stays years away from the given epoch while the other is moved; or None."""
    if epoch_jyr is None or first.has_motion == second.has_motion:
        return None
    staying = second if first.has_motion else first
    away = staying.epoch_jyr is not None and abs(staying.epoch_jyr - epoch_jyr) > SAME_EPOCH_YEARS
    return staying if away else None


def left_behind_doubt(first: Catalogue, second: Catalogue, epoch_jyr: float | None) -> tuple[str, ...]:
    """A doubt about a given common epoch that only one catalogue can be moved to; empty if there is none.

    The stars of the other are then compared with where they were at its own epoch.
    """
    staying = _left_behind(first, second, epoch_jyr)
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
