"""What catalogues do not say and another tells: a common position error, the unit of the errors, an epoch.

Nothing here is certain; each assumption is a doubt of the match, with its value and how to say it better.

The common error s of a catalogue without errors follows from the distances r of nearest neighbours: where a share f of
the records has its partner in the other catalogue, and other records lie about with the local density ρ,

    p(r) = exp(−π ρ r²) { f exp(−r²/2σ²) [r/σ² + 2π ρ r] + (1 − f) 2π ρ r },   σ² = s² + the other's error².

s and f are those of the largest posterior on a grid, with a wide prior of s. The estimate of the match scales it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import Message, naming
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import GUESSED, Column, PositionError
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors


@dataclass(frozen=True)
class CommonErrorTuning:
    """How a common position error is estimated; all chosen.

    Attributes
    ----------
    usual_arcsec, spread_log : median and standard deviation of the logarithm of the prior of s.
    least_arcsec, largest_arcsec : of the grid. steps, share_steps : of the grid of s and of f.
    neighbours : the distance to this one, the nearest apart, tells the local density.
    copied_arcsec : records are copies where most lie no farther than this from the nearest.
    most_records : so many are looked at, drawn evenly.
    most_rows, strips : of larger catalogues about so many are looked at, in so many strips of declination.
    most_products : up to so many distances are computed at once, and all of them; of more those of records next along
        an axis, ``window`` at first (a tree would take 0.15 to 0.5 s to import).
    """

    usual_arcsec: float = 0.3
    spread_log: float = 2.0
    least_arcsec: float = 1e-3
    largest_arcsec: float = 60.0
    steps: int = 80
    share_steps: int = 16
    neighbours: int = 6
    copied_arcsec: float = 1e-6
    most_records: int = 4000
    most_rows: int = 40_000
    strips: int = 2
    most_products: int = 4_000_000
    window: int = 128


TUNING = CommonErrorTuning()
_UNITS = ("mas", "arcsec", "deg")


def completed(
    catalogues: Sequence[Catalogue], epoch_jyr: float | None = None, tuning: CommonErrorTuning = TUNING
) -> tuple[list[Catalogue], tuple[str, ...]]:
    """The catalogues with what they did not say, and the doubts that say what was assumed.

    epoch_jyr : that all will be moved to, None where that is not said.
    """
    made = list(catalogues)
    doubts: list[str] = []
    for k, catalogue in enumerate(made):
        epoch = _epoch_of_others(made, k, epoch_jyr)
        if epoch is not None:
            made[k] = catalogue.with_epoch(epoch, "assumed")
            text = f"{catalogue.name}: its epoch is not known; {epoch:g} was assumed, so its positions are not moved; "
            doubts.append(Message(text, naming(f"give {{epoch{k + 1}:YEAR}}")))
    before = tuple(made)
    for k, catalogue in enumerate(before):
        if catalogue.error_is_unknown:
            sigma, source = _error_against_others(before, k, tuning)
            text = (
                f"{catalogue.name}: it has no position errors; {sigma:.2g} arcsec on each axis was assumed, {source}; "
            )
            doubts.append(Message(text, naming(f"give {{sigma{k + 1}:ARCSEC}} or {{sigma{k + 1}:COLUMN}}")))
            made[k] = catalogue.with_error(PositionError("number", sigma_arcsec=sigma, reason="assumed"))
    for k, catalogue in enumerate(made):
        if catalogue.choice.error.guessed_unit:
            made[k], doubt = _with_likelier_unit(made, k, tuning)
            doubts += [doubt] if doubt else []
    return made, tuple(doubts)


def _epoch_of_others(catalogues: Sequence[Catalogue], k: int, epoch_jyr: float | None) -> float | None:
    """The epoch to assume for a catalogue without one, None where none is needed."""
    others = [c for c in (*catalogues[:k], *catalogues[k + 1 :]) if c.epoch_jyr is not None]
    if catalogues[k].epoch_jyr is not None:
        return None
    if epoch_jyr is not None:
        return epoch_jyr
    moving = [c.epoch_jyr for c in others if c.has_motion and c.epoch_jyr is not None]
    return float(np.median(moving)) if moving else None


def _error_against_others(catalogues: Sequence[Catalogue], k: int, tuning: CommonErrorTuning) -> tuple[float, str]:
    """The common error of catalogue ``k`` in arcsec, and in words where it is from."""
    found = []
    for other, catalogue in enumerate(catalogues):
        if other != k:
            shared = catalogue.error_is_unknown
            sigma, share = common_error(catalogues[k], catalogue, shared=shared, tuning=tuning)
            found.append((share, sigma, catalogue.name))
    share, sigma, name = max(found)
    if share <= 0.0:
        return sigma, f"a typical one, for its records do not lie near those of {name}, or are a copy of them"
    return sigma, f"estimated from the distances to {name}"


def _with_likelier_unit(catalogues: Sequence[Catalogue], k: int, tuning: CommonErrorTuning) -> tuple[Catalogue, str]:
    """The catalogue with its errors in the unit that fits the distances best, and a doubt where that is another."""
    catalogue, error = catalogues[k], catalogues[k].choice.error
    others = [other for j, other in enumerate(catalogues) if j != k and other.choice.error.reason != "assumed"]
    if not others:
        return catalogue, ""
    found = [common_error(catalogue, other, tuning=tuning) for other in others]
    sigma, share = max(found, key=lambda one: one[1])
    quoted = _median_sigma_arcsec(catalogue)
    if share <= 0.0 or not quoted > 0.0:
        return catalogue, ""
    in_arcsec = {"mas": 1e-3, "arcsec": 1.0, "deg": 3600.0}
    own = in_arcsec[error.columns[0].unit]
    best = min(_UNITS, key=lambda unit: abs(np.log(quoted * in_arcsec[unit] / own / sigma)))
    if best == error.columns[0].unit:
        return catalogue, ""
    angles = tuple(replace(column, unit=best) if _is_guessed(column) else column for column in error.columns)
    names = ", ".join(column.name for column in angles if _is_guessed(column))
    text = (
        f"{catalogue.name}: the unit of {names} is not stated; {best} fits the distances to the other catalogue best, "
    )
    doubt = Message(f"{text}so it was assumed; ", naming(f"give {{sigma_unit{k + 1}:UNIT}}"))
    return catalogue.with_error(replace(error, columns=angles, guessed_unit=False)), doubt


def _is_guessed(column: Column) -> bool:
    return column.reason == GUESSED


def _median_sigma_arcsec(catalogue: Catalogue) -> float:
    variance = 0.5 * (catalogue.astrometry.variance(0) + catalogue.astrometry.variance(1))
    known = variance[np.isfinite(variance)]
    return 1e-3 * float(np.sqrt(np.median(known))) if len(known) else np.nan


def common_error(
    catalogue: Catalogue, other: Catalogue, *, shared: bool = False, tuning: CommonErrorTuning = TUNING
) -> tuple[float, float]:
    """One position error an axis, arcsec, that explains the distances to another catalogue, and the share of partners.

    A copy of the same records tells nothing, so its share is 0.

    shared : the other catalogue's errors are not known either, and taken to be the same.
    """
    position, variances = _positions(*_in_strips(catalogue, other, tuning), shared)
    if not len(position[0]) or not len(position[1]):
        return tuning.usual_arcsec, 0.0
    # From the side of fewer records: of those of a deep catalogue next to none have a partner in a sparse one.
    if len(position[1]) < len(position[0]):
        distance, density, rows, partner = _neighbours(position[1], position[0], tuning)
    else:
        distance, density, partner, rows = _neighbours(*position, tuning)
    if np.median(distance) <= tuning.copied_arcsec:
        return tuning.usual_arcsec, 0.0
    known = variances[0][rows] + variances[1][partner]
    s = np.geomspace(tuning.least_arcsec, tuning.largest_arcsec, tuning.steps)[:, None]
    variance = s**2 * (2.0 if shared else 1.0) + known
    chance = 2.0 * np.pi * density * distance
    near = np.exp(-0.5 * distance**2 / variance) * (distance / variance + chance)
    prior = -0.5 * (np.log(s[:, 0] / tuning.usual_arcsec) / tuning.spread_log) ** 2
    shares = np.linspace(0.0, 1.0, tuning.share_steps + 1)[:-1]
    log_chance = np.log(np.maximum(chance, 1e-300))
    fit = [(np.log(np.maximum(f * near + (1.0 - f) * chance, 1e-300)) - log_chance).sum(axis=1) + prior for f in shares]
    at_share, at_s = np.unravel_index(int(np.argmax(fit)), (len(shares), len(s)))
    return float(s[at_s, 0]), float(shares[at_share])


def _in_strips(one: Catalogue, two: Catalogue, tuning: CommonErrorTuning) -> tuple[Catalogue, Catalogue]:
    """Both catalogues, large ones in strips of declination alone; the larger's are twice as high, so that the partners
    and neighbours of what lies at the border of a strip are there."""
    share = tuning.most_rows / max(len(one), len(two))
    if share >= 1.0:
        return one, two
    fewer = min(one, two, key=len)
    dec_deg = fewer.astrometry.dec_deg[np.isfinite(fewer.astrometry.dec_deg)]
    middle, half = (np.arange(tuning.strips) + 0.5) / tuning.strips, 0.25 * share / tuning.strips
    places = (np.array([middle - half, middle + half]) * (len(dec_deg) - 1)).round().astype(np.intp)
    low, high = np.partition(dec_deg, places.ravel())[places]
    margin = 0.5 * (high - low)

    def part(catalogue: Catalogue, low: FloatArray, high: FloatArray) -> Catalogue:
        edges = np.column_stack([np.nextafter(low, -np.inf), high]).ravel()
        within = np.searchsorted(edges, catalogue.astrometry.dec_deg) % 2 == 1
        return catalogue.alike(catalogue.table[np.flatnonzero(within)])

    wide = (low - margin, high + margin)
    return (part(one, low, high), part(two, *wide)) if fewer is one else (part(one, *wide), part(two, low, high))


def _positions(
    catalogue: Catalogue, other: Catalogue, shared: bool
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """(n, 3) and (m, 3) directions at the other's epoch; (n,) and (m,) variances an axis in arcsec², by the motions of
    what has no error of its own."""
    placed = [c.with_error(PositionError("number", sigma_arcsec=1e-3)) for c in (catalogue, other)]
    if not shared and not other.error_is_unknown:
        placed[1] = other
    epochs = [c.epoch_jyr for c in placed]
    epoch = None if None in epochs else epochs[0] if placed[1].has_motion else epochs[1]
    one, two = (c.records(epoch) for c in placed)
    known = [0.5 * (records.covariance[:, 0] + records.covariance[:, -1]) for records in (one, two)]
    return (unit_vectors(*one.features.T), unit_vectors(*two.features.T)), (known[0], known[1])


def _neighbours(
    one: FloatArray, two: FloatArray, tuning: CommonErrorTuning
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """(k,) distances to the nearest in arcsec, local densities per arcsec², which the nearest is, and whose it is."""
    own = np.arange(0, len(one), max(1, len(one) // tuning.most_records))
    some = one[own]
    count = min(tuning.neighbours, len(two))
    chord, which = _nearest(some, two, count, tuning)
    apart = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)) * ARCSEC_PER_RADIAN
    # The nearest may be the partner; of those beyond it the density follows. A lone record's is that of its distance.
    density = max(count - 1, 1) / (np.pi * np.maximum(apart[:, -1], 1e-3) ** 2)
    return np.maximum(apart[:, 0], tuning.copied_arcsec), density, which[:, 0], own


def _nearest(some: FloatArray, two: FloatArray, count: int, tuning: CommonErrorTuning) -> tuple[FloatArray, IntArray]:
    """(k, count) chords from some directions to the nearest of others, ascending, and which these are."""
    if len(some) * len(two) > tuning.most_products:
        return _nearest_along(some, two, count, tuning)
    which = np.argpartition(some @ -two.T, count - 1, axis=1)[:, :count]
    # The product tells which are nearest; the chord itself is taken from the differences, which lose no digits.
    return _by_chord(some, two, which)


def _nearest_along(
    some: FloatArray, two: FloatArray, count: int, tuning: CommonErrorTuning
) -> tuple[FloatArray, IntArray]:
    """The same, sought among those next along the axis on which they lie farthest apart, in ever wider windows, until
    whatever lies outside must be farther away."""
    axis, n = int(np.argmax(np.ptp(two, axis=0))), len(two)
    order = np.argsort(two[:, axis], kind="stable")
    along = np.concatenate([[-np.inf], two[order, axis], [np.inf]])
    chord, which = np.empty((len(some), count)), np.empty((len(some), count), np.intp)
    unsure, width = np.arange(len(some)), min(max(tuning.window, count), n)
    while len(unsure):
        settled = np.zeros(len(unsure), np.bool_)
        block = max(tuning.most_products // width, 1)
        for at in (slice(low, low + block) for low in range(0, len(unsure), block)):
            one = some[unsure[at]]
            low = np.clip(np.searchsorted(along[1:-1], one[:, axis]) - width // 2, 0, n - width)
            within = order[low[:, None] + np.arange(width)]
            apart_sq = np.square(one[:, None] - two[within]).sum(axis=2)
            near = np.argpartition(apart_sq, count - 1, axis=1)[:, :count]
            chord[unsure[at]], which[unsure[at]] = _by_chord(one, two, np.take_along_axis(within, near, axis=1))
            beyond = np.minimum(one[:, axis] - along[low], along[low + width + 1] - one[:, axis])
            settled[at] = chord[unsure[at], -1] <= beyond
        unsure, width = unsure[~settled], min(2 * width, n)
    return chord, which


def _by_chord(some: FloatArray, two: FloatArray, which: IntArray) -> tuple[FloatArray, IntArray]:
    """(k, c) chords from some directions to those of others that are theirs, (k, c), ascending, and which these are."""
    chord = np.sqrt(np.square(some[:, None] - two[which]).sum(axis=2))
    order = np.argsort(chord, axis=1, kind="stable")
    return np.take_along_axis(chord, order, axis=1), np.take_along_axis(which, order, axis=1)
