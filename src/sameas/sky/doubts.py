"""Doubts of a match: what was assumed of a catalogue, fields that do not meet, an epoch that the residuals contradict.

What a catalogue does not say is taken from the other: a common position error, the unit of the errors, an epoch.
Nothing of it is certain; each assumption is a doubt of the match, with its value and how to say it better. The common
error s of a catalogue without errors follows from the distances r of nearest neighbours: where a share f of the records
has its partner in the other catalogue, and other records lie about with the local density ρ,

    p(r) = exp(−π ρ r²) { f exp(−r²/2σ²) [r/σ² + 2π ρ r] + (1 − f) 2π ρ r },   σ² = s² + the other's error².

s and f are those of the largest posterior on a grid, with a wide prior of s. The estimate of the match scales it.

Where fields do not meet, :func:`apart_doubts` looks for what would make them: hours taken for degrees, columns
exchanged.

With a wrong epoch (:func:`epoch_doubt`) residuals grow along the proper motions. The catalogue with motions μ was
carried to an epoch T. Where the other one was observed at T + δ, each pair misses what its object moves in δ years, −μ
δ, beside a common offset. Both are fitted by least squares.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import Argument, Message, naming
from sameas.gaussian import inverse
from sameas.records import Records
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import GUESSED, Column, ColumnChoice, PositionError, in_years
from sameas.sky.column_values import to_icrs
from sameas.sky.frame.tangent import directions_deg
from sameas.space import ARCSEC_PER_RADIAN, mean_direction, unit_vectors


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


COMMON_ERROR = CommonErrorTuning()
_UNITS = ("mas", "arcsec", "deg")


def completed(
    catalogues: Sequence[Catalogue], epoch_jyr: float | None = None, tuning: CommonErrorTuning = COMMON_ERROR
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
    catalogue: Catalogue, other: Catalogue, *, shared: bool = False, tuning: CommonErrorTuning = COMMON_ERROR
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


#: Records that a field is judged by, at most: its outline moves by little with more.
_ENOUGH = 10_000
#: Radii below this, in degrees, count as this: of a catalogue of one row (chosen).
_LEAST_RADIUS_DEG = 0.05


@dataclass(frozen=True)
class _Field:
    """A circle on the sky that holds all records. centre (3,) : unit vector. radius_deg : to the farthest record."""

    centre: FloatArray
    radius_deg: float

    @classmethod
    def of(cls, position_deg: FloatArray) -> _Field:
        vectors = unit_vectors(*position_deg.T)
        centre = mean_direction(vectors)
        return cls(centre, max(float(_degrees(vectors @ centre).max()), _LEAST_RADIUS_DEG))

    def to(self, other: _Field) -> float:
        """Degrees from centre to centre."""
        return float(_degrees(self.centre @ other.centre))

    def __str__(self) -> str:
        lon, lat = directions_deg(self.centre)
        return f"within {self.radius_deg:.2g}° of RA {lon:.2f}°, Dec {lat:+.2f}°"


def _degrees(cosine: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def apart_doubts(first: Catalogue, second: Catalogue, one: Records, two: Records) -> tuple[str, ...]:
    """One line where no record of one catalogue lies in the field of the other, with a misreading that explains it.

    one, two : their records.
    """
    positions = [records.features[:: max(1, len(records) // _ENOUGH)] for records in (one, two)]
    fields = [_Field.of(position) for position in positions]
    if fields[0].to(fields[1]) <= fields[0].radius_deg + fields[1].radius_deg:
        return ()
    said = f"the fields lie apart: {first.name} {fields[0]}, {second.name} {fields[1]}"
    sides = (2, second, positions[1], fields[0], first), (1, first, positions[0], fields[1], second)
    for side, catalogue, position, field, other in sides:
        for misread in _MISREADINGS:
            if misread.fits(catalogue.choice, position):
                meant = _Field.of(misread.correct(position))
                if meant.to(field) <= max(meant.radius_deg, field.radius_deg):
                    of = f"of {catalogue.name} would lie in the field of {other.name}: "
                    ra, dec = catalogue.choice.ra.name, catalogue.choice.dec.name
                    return (
                        Message(f"{said}; {misread.meant.format(ra=ra, dec=dec)} {of}", misread.remedy(ra, dec, side)),
                    )
    return (f"{said}: do they show the same part of the sky?",)


@dataclass(frozen=True)
class _Misreading:
    """What a table may mean instead.

    fits : whether it may, by its columns and positions. correct : the positions if so. meant : in words.
    remedy : what to do, for the columns of right ascension and declination of a side.
    """

    fits: Callable[[ColumnChoice, FloatArray], bool]
    correct: Callable[[FloatArray], FloatArray]
    meant: str
    remedy: Callable[[str, str, int], str]


def _no_unit(choice: ColumnChoice) -> bool:
    return choice.frame == "icrs" and choice.ra.unit == "deg" and choice.ra.reason == "by convention"


def _of_galactic(position_deg: FloatArray) -> FloatArray:
    ra, dec, _ = to_icrs("galactic", *position_deg.T)
    return np.column_stack([ra, dec])


def _exchanged(position_deg: FloatArray) -> FloatArray:
    return np.column_stack([position_deg[:, 1], (position_deg[:, 0] + 180.0) % 360.0 - 180.0])


_MISREADINGS = (
    _Misreading(
        lambda choice, at: _no_unit(choice) and bool(at[:, 0].max() <= 24.0),
        lambda at: at * [15.0, 1.0],
        "in hours, {ra}",
        lambda ra, dec, side: f"give the column its unit, h, or call it '{ra} [h]'",
    ),
    _Misreading(
        lambda choice, at: _no_unit(choice) and bool(at[:, 0].max() <= 2.0 * np.pi),
        lambda at: np.degrees(at),
        "in radians, {ra} and {dec}",
        lambda ra, dec, side: f"give the columns their unit, rad, or call them '{ra} [rad]', '{dec} [rad]'",
    ),
    _Misreading(
        lambda choice, at: choice.ra.unit == "sexagesimal hours",
        lambda at: at / [15.0, 1.0],
        "in degrees instead of hours, {ra}",
        lambda ra, dec, side: "give the column its unit, deg",
    ),
    _Misreading(
        lambda choice, at: bool((np.abs(_exchanged(at)[:, 1]) <= 90.0).all()),
        _exchanged,
        "exchanged, {ra} and {dec}",
        lambda ra, dec, side: Message("give ", Argument(f"ra{side}", dec), " ", Argument(f"dec{side}", ra)),
    ),
    _Misreading(
        lambda choice, at: True,
        lambda at: at * [1.0, -1.0],
        "with the other sign, {dec}",
        lambda ra, dec, side: "were its signs lost?",
    ),
    _Misreading(
        lambda choice, at: choice.frame == "icrs",
        _of_galactic,
        "as galactic longitude and latitude, {ra} and {dec}",
        lambda ra, dec, side: "call them l and b",
    ),
)


@dataclass(frozen=True)
class EpochTuning:
    """From where an epoch is doubted; all chosen.

    least_p_pair : pairs less probable are not used; nor are those with residuals of more than ``largest_sigmas``.
    fewest, most_pairs : with fewer pairs nothing is said, of more a regular sample is used.
    significant_sigmas : what motion, and what an offset beside it, must explain. significant_years : of δ, at least.
    significant_share : the fastest twentieth of the objects moves by this part of its error in δ years, at least.
    """

    least_p_pair: float = 0.9
    largest_sigmas: float = 6.0
    fewest: int = 20
    most_pairs: int = 30_000
    significant_sigmas: float = 5.0
    significant_years: float = 0.3
    significant_share: float = 0.3


EPOCH = EpochTuning()


def epoch_doubt(
    first: Catalogue,
    second: Catalogue,
    epoch_jyr: float | None,
    answer: Identification,
    scale: float,
    tuning: EpochTuning = EPOCH,
) -> tuple[str, bool]:
    """A doubt of the epoch that one catalogue was taken to have, empty where there is none, and whether it explains an
    offset of the pairs too.

    epoch_jyr : that both were brought to. scale : residuals over quoted errors.
    """
    side = _questioned(first, second)
    if side is None or epoch_jyr is None:
        return "", False
    questioned, other = (first, second) if side == 1 else (second, first)
    carried = questioned if questioned.has_motion else other
    records, at = (answer.first, answer.pairs.i) if carried is first else (answer.second, answer.pairs.j)
    use = np.flatnonzero(answer.p_pair > tuning.least_p_pair)
    use = use[:: -(-len(use) // tuning.most_pairs) or 1]
    of = carried.astrometry[records.rows[at[use]]]
    motion = 1e-3 * np.column_stack([of.pm_ra_mas_per_yr, of.pm_dec_mas_per_yr])
    # Residuals are first minus second; what was carried from a later epoch than was assumed was carried too far, what
    # was carried to an earlier one than it should, not far enough.
    sign = (1.0 if carried is first else -1.0) * (1.0 if carried is questioned else -1.0)
    residual, precision = answer.pairs.residual[use], inverse(answer.pairs.covariance_of(use)) / scale**2
    near = np.einsum("mv,mvw,mw->m", residual, precision, residual) < tuning.largest_sigmas**2
    known = near & np.isfinite(motion).all(axis=1)
    if np.count_nonzero(known) < tuning.fewest:
        return "", False
    motion, residual, precision = sign * motion[known], residual[known], precision[known]
    slope = np.concatenate([motion[:, :, None], np.broadcast_to(np.eye(2), (len(motion), 2, 2))], axis=2)
    years, error, gain = _fitted(slope, residual, precision)
    alone, error_alone, gain_alone = _fitted(slope[:, :, :1], residual, precision)
    least = tuning.significant_sigmas**2
    fast = np.sqrt(np.einsum("mv,mvw,mw->m", motion, precision, motion))
    if abs(years) < max(tuning.significant_years, tuning.significant_sigmas * error):
        return "", False
    if np.quantile(fast, 0.95) * abs(years) < tuning.significant_share:
        return "", False
    explains = gain - gain_alone < least
    years, error = (alone, error_alone) if explains else (years, error)
    was = questioned.epoch_jyr
    assert was is not None
    decimals = max(0, math.ceil(-math.log10(error)))
    text = (
        f"residuals follow the proper motions of {carried.name}, as if the epoch of {questioned.name} were "
        f"{was + years:.{decimals}f} ± {error:.{decimals}f}, not {in_years(was)}: "
    )
    return Message(text, naming(f"give {{epoch{side}:YEAR}}")), explains


def _questioned(first: Catalogue, second: Catalogue) -> int | None:
    """Whose epoch residuals can tell: of the catalogue whose epoch was assumed, or of the one without motions."""
    assumed = [catalogue.choice.epoch.reason == "assumed" for catalogue in (first, second)]
    moving = [catalogue.has_motion for catalogue in (first, second)]
    if first.epoch_jyr is None or second.epoch_jyr is None or not any(moving):
        return None
    if assumed[0] != assumed[1]:
        return 1 if assumed[0] else 2
    if moving[0] != moving[1]:
        return 2 if moving[0] else 1
    return None


def _fitted(slope: FloatArray, residual: FloatArray, precision: FloatArray) -> tuple[float, float, float]:
    """The first of the parameters with its standard error, and by how much all of them lower χ².

    slope (m, 2, k), residual (m, 2), precision (m, 2, 2).
    """
    pull = np.einsum("mvw,mwk->mvk", precision, slope)
    information = np.einsum("mvk,mvl->kl", pull, slope) + 1e-12 * np.eye(slope.shape[2])
    force = np.einsum("mvk,mv->k", pull, residual)
    found = np.linalg.solve(information, force)
    return float(found[0]), math.sqrt(float(np.linalg.inv(information)[0, 0])), float(found @ force)


__all__ = ["EpochTuning", "epoch_doubt"]
