"""Doubts about the result of a crossmatch: units of errors, densities, duplicates, blends, offsets, equinox.

Doubts about one table are in :mod:`sameas.sky.catalogue_doubts`, those about fields that lie apart in
:mod:`sameas.sky.disjoint`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from sameas.arrays import median
from sameas.errors import Message, naming
from sameas.estimate.blends import suspected_blends
from sameas.estimate.clustering import close_neighbours
from sameas.estimate.coverage import Coverage
from sameas.estimate.result import Estimate
from sameas.estimate.sample import Setting
from sameas.kernels import threads
from sameas.records import Records
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.celestial_frames import in_icrs
from sameas.sky.residual_epoch import epoch_doubt
from sameas.sky.sky_match import ARCSEC2_PER_DEG2, SkyMatch, area_and_densities, nearest
from sameas.sky.systematics import Rotation, Warp, residual_rotation

# Thresholds for doubting a result; all chosen.
#: Two catalogues have hardly any objects in common if the expected number is at most this share of the smaller
#: catalogue and at most this many of its standard errors.
MIN_COMMON_SHARE, MIN_COMMON_SIGMAS = 0.05, 3.0
#: With hardly any common objects the errors are doubted if the lower quartile of the nearest-neighbour distances is
#: below this share of its value for chance alone.
MAX_SPACING_SHARE = 0.2
USUAL_SCALE = (0.3, 5.0)  # (least, largest) ratio of residuals to quoted errors that raises no doubt
USUAL_DENSITY = (0.01, 100.0)  # (least, largest) ratio of the given density to the observed one that raises no doubt
#: Close pairs within one catalogue are doubted if they exceed the number expected by chance by this many standard
#: deviations and by this share of the records.
DUPLICATE_SIGMAS, DUPLICATE_SHARE = 5.0, 0.03
#: With hardly any common objects the equinox of a catalogue may be B1950 if this share of about B1950_RECORDS of its
#: records then lies within B1950_ARCSEC of a record of the other, and far more than else.
B1950_RECORDS, B1950_ARCSEC, B1950_SHARE = 2_000, 2.0, 0.2

#: The end of a doubt about the frames of two catalogues.
REMOVE_OFFSET = naming("give {offset:'find'} to remove it")


def match_doubts(
    match: SkyMatch, search: Rotation | None, disjoint: tuple[str, ...], left_behind: tuple[str, ...]
) -> tuple[str, ...]:
    """What looks wrong with a match.

    search : for a rotation, if any. disjoint, left_behind : doubts about two separate fields, and about a common epoch
    that one catalogue cannot be moved to: residuals along the motions then follow from it.
    """
    result, estimate = match.result, match.estimate
    # That nothing is common follows from fields that lie apart.
    notes = () if disjoint else estimate.notes
    doubts = (*notes, *_error_doubts(match), *_near_miss_doubts(result, estimate))
    epoch_line, offset_explained = "", False
    if not left_behind:
        epoch_line, offset_explained = epoch_doubt(match.first, match.second, match.epoch_jyr, result, estimate.errors)
    doubts += (*disjoint, epoch_line) if epoch_line else disjoint
    if search is not None:
        doubts += _search_doubts(search, match.warp)
    elif not disjoint and not offset_explained:
        doubts += _offset_doubts(result, estimate)
    # Of an object with several rows all but one have no partner, and look like neighbours that are not resolved.
    return doubts + (_duplicate_doubts(result, estimate) or _blend_doubts(result, estimate))


def density_doubts(coverage: Coverage, given_per_deg2: tuple[float, float] | None) -> tuple[str, ...]:
    """Doubts about given densities that the data contradict."""
    if given_per_deg2 is None:
        return ()
    _, *observed = area_and_densities(coverage)
    least, largest = USUAL_DENSITY
    lines = []
    for records, per_deg2, given in zip((coverage.first, coverage.second), observed, given_per_deg2, strict=True):
        if per_deg2 and not least < given / per_deg2 < largest:
            lines.append(
                f"density: {given:g} per square degree was given for {records.source}, but in the common area "
                f"it has {per_deg2:.3g}: is the density per square degree?"
            )
    return tuple(lines)


def _error_doubts(match: SkyMatch) -> tuple[str, ...]:
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
    least, largest = USUAL_SCALE
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


def _duplicate_doubts(result: Identification, estimate: Estimate) -> tuple[str, ...]:
    """A doubt about records of one catalogue that seem to be the same object."""
    found, doubts = close_neighbours(Setting.whole(result.pairs, estimate.coverage)), []
    for records, close in zip((result.first, result.second), found or (), strict=False):
        excess = close.n_pairs - close.by_chance
        significant = DUPLICATE_SIGMAS * math.sqrt(close.by_chance + DUPLICATE_SIGMAS)
        if excess > max(significant, DUPLICATE_SHARE * close.n_records):
            doubts.append(
                f"in {records.source} {close.n_pairs} couples of records lie within their errors of each other, where "
                f"chance makes {close.by_chance:.0f}: if they are one object given twice (two exposures, a deblender), "
                "its probability is divided between the two; give each object once: `sameas internal` gathers its rows"
            )
    return tuple(doubts)


def _fits_as_b1950(old: Records, new: Records) -> bool:
    """Whether far more records of ``old`` than by chance have a neighbour in ``new`` if their equinox is B1950."""
    some = old.part(np.arange(0, len(old), max(1, len(old) // B1950_RECORDS)))
    near = [
        np.count_nonzero(nearest(replace(some, features=at), new).separation_arcsec.filled(np.inf) < B1950_ARCSEC)
        for at in (some.features, in_icrs("B1950", some.features))
    ]
    return bool(near[1] > near[0] + 5.0 * math.sqrt(near[0] + 5.0) and near[1] > B1950_SHARE * len(some))


def _search_doubts(search: Rotation, warp: Warp | None) -> tuple[str, ...]:
    """Doubts about a rotation that was searched for."""
    if not search.by_chance:
        return search.notes
    return (*search.notes, "no offset was removed" if warp is None else "no shift or rotation was removed")


def _offset_doubts(result: Identification, estimate: Estimate) -> tuple[str, ...]:
    """A doubt about the frames if the pairs have a mean offset, or there are hardly any pairs."""
    if hardly_any_common(result, estimate):
        few = (
            f"{result.first.source} and {result.second.source} have hardly any objects in common "
            f"({estimate.quantities['common']} objects); "
        )
        sides = (result.first, result.second), (result.second, result.first)
        for old, new in sides:
            if _fits_as_b1950(old, new):
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
    return (Message(off, REMOVE_OFFSET),)


def hardly_any_common(result: Identification, estimate: Estimate) -> bool:
    """Whether the number of common objects is small and consistent with zero by its standard error."""
    if estimate.common > MIN_COMMON_SHARE * min(len(result.first), len(result.second)):
        return False
    return estimate.common <= max(0.5, MIN_COMMON_SIGMAS * estimate.quantities["common"].standard_error)


def _near_miss_doubts(result: Identification, estimate: Estimate) -> tuple[str, ...]:
    """A doubt about the errors if records lie close to each other, but not within their errors."""
    first, second = result.first, result.second
    _, _, density_2 = area_and_densities(estimate.coverage)
    if estimate.common > MIN_COMMON_SHARE * min(len(first), len(second)) or not density_2:
        return ()
    near = float(np.quantile(nearest(first, second).separation_arcsec.filled(np.inf), 0.25))
    by_chance = math.sqrt(math.log(4.0 / 3.0) * ARCSEC2_PER_DEG2 / (math.pi * density_2))
    if near > MAX_SPACING_SHARE * by_chance:
        return ()
    missed = (
        f"a quarter of {first.source} lies within {near:.2g} arcsec of a record of {second.source}, by chance it would "
        f"be {by_chance:.2g}, but hardly any within its errors: are the errors in the assumed unit? "
    )
    return (Message(missed, naming("Or is one shifted ({offset:'find'})?")),)
