"""Doubts about a match: assumed errors, units and epochs, disjoint fields, an epoch that the residuals contradict.

Values missing in one catalogue are assumed from the others: a common position error, the unit of the errors, an epoch
(:func:`completed`). Each assumption is reported as a doubt with its value and the option to give instead. The common
error s of a catalogue without errors is estimated from the distances r to the nearest neighbours in the other one. With
a fraction f of records that have a partner, and unrelated records of local density ρ,

    p(r) = exp(−π ρ r²) { f exp(−r²/2σ²) [r/σ² + 2π ρ r] + (1 − f) 2π ρ r },   σ² = s² + (error of the other)².

s and f maximise the posterior on a grid, with a wide prior of s. The match then estimates a scale of this error.

If the fields are disjoint, :func:`disjoint_doubt` tests misreadings that would explain it: hours read as degrees,
swapped columns.

With a wrong epoch (:func:`epoch_doubt`, :class:`MovedPairs`) residuals grow along the proper motions. The catalogue
with proper motions μ was moved to an epoch T. If the other one was observed at T + δ, each pair has a residual −μ δ,
plus a common offset. Both are fitted by least squares. Motions in another convention (without cos δ, exchanged, with
the other sign, in arcsec/yr) are tested in the same way, and preferred where they lower χ² further.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sameas.arrays import FloatArray, IntArray, median
from sameas.errors import Argument, Message, naming
from sameas.evidence import Errors
from sameas.gaussian import inverse
from sameas.records import Records
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import GUESSED, ChosenColumn, ColumnChoice, PositionError, in_years
from sameas.sky.column_values import to_icrs
from sameas.sky.conventions import SkyFrame
from sameas.sky.frame.pointing import directions_deg
from sameas.space import ARCSEC_PER_RADIAN, mean_direction, unit_vectors


@dataclass(frozen=True)
class CommonErrorTuning:
    """How a common position error is estimated; all chosen.

    Attributes
    ----------
    usual_arcsec, spread_log : median of the prior of s, and standard deviation of its natural logarithm.
    min_arcsec, largest_arcsec : range of the grid of s. steps, share_steps : grid points of s and of f.
    neighbours : the local density is taken from the distance to the neighbour of this rank.
    copied_arcsec : the catalogues are copies if the median nearest-neighbour distance is at most this.
    max_records : maximum number of records used, evenly sampled.
    max_rows, strips : larger catalogues are reduced to about ``max_rows`` rows, in this many strips of declination.
    max_products : all distances are computed if they are at most this many; else only those to records close along one
        axis, ``window`` of them at first (importing a k-d tree would take 0.15 to 0.5 s).
    """

    usual_arcsec: float = 0.3
    spread_log: float = 2.0
    min_arcsec: float = 1e-3
    largest_arcsec: float = 60.0
    steps: int = 80
    share_steps: int = 16
    neighbours: int = 6
    copied_arcsec: float = 1e-6
    max_records: int = 4000
    max_rows: int = 40_000
    strips: int = 2
    max_products: int = 4_000_000
    window: int = 128


COMMON_ERROR = CommonErrorTuning()
_UNITS = ("mas", "arcsec", "deg")


def completed(
    catalogues: Sequence[Catalogue], epoch_jyr: float | None = None, tuning: CommonErrorTuning = COMMON_ERROR
) -> tuple[list[Catalogue], tuple[str, ...]]:
    """The catalogues with missing epochs, errors and units assumed, and one doubt per assumption.

    epoch_jyr : common epoch of the match, None if not given.
    """
    with_epochs, of_epochs = with_known_epochs(catalogues, epoch_jyr)
    result, doubts = list(with_epochs), list(of_epochs)
    for k, catalogue in enumerate(with_epochs):
        if catalogue.error_is_unknown:
            sigma, source = _error_against_others(with_epochs, k, tuning)
            text = (
                f"{catalogue.name}: it has no position errors; {sigma:.2g} arcsec on each axis was assumed, {source}; "
            )
            doubts.append(Message(text, naming(f"give {{sigma{k + 1}:ARCSEC}} or {{sigma{k + 1}:COLUMN}}")))
            result[k] = catalogue.with_error(PositionError("number", sigma_arcsec=sigma, reason="assumed"))
    for k, catalogue in enumerate(result):
        if catalogue.choice.error.guessed_unit:
            result[k], doubt = _with_likelier_unit(result, k, tuning)
            doubts += [doubt] if doubt else []
    return result, tuple(doubts)


def with_known_epochs(
    catalogues: Sequence[Catalogue], epoch_jyr: float | None = None
) -> tuple[tuple[Catalogue, ...], tuple[str, ...]]:
    """The catalogues with missing epochs assumed, and one doubt for each.

    epoch_jyr : common epoch of the match, None if not given.
    """
    result = list(catalogues)
    doubts: list[str] = []
    for k, catalogue in enumerate(result):
        epoch = _epoch_of_others(result, k, epoch_jyr)
        if epoch is not None:
            result[k] = catalogue.with_epoch(epoch)
            text = f"{catalogue.name}: its epoch is not known; {epoch:g} was assumed, so its positions are not moved; "
            doubts.append(Message(text, naming(f"give {{epoch{k + 1}:YEAR}}")))
    return tuple(result), tuple(doubts)


def _epoch_of_others(catalogues: Sequence[Catalogue], k: int, epoch_jyr: float | None) -> float | None:
    """The epoch to assume for catalogue ``k`` if it has none; None if no epoch is needed."""
    others = [c for c in (*catalogues[:k], *catalogues[k + 1 :]) if c.epoch_jyr is not None]
    if catalogues[k].epoch_jyr is not None:
        return None
    if epoch_jyr is not None:
        return epoch_jyr
    moving = [c.epoch_jyr for c in others if c.has_motion and c.epoch_jyr is not None]
    return float(np.median(moving)) if moving else None


def _error_against_others(catalogues: Sequence[Catalogue], k: int, tuning: CommonErrorTuning) -> tuple[float, str]:
    """The common error of catalogue ``k``, arcsec, and a text on its origin."""
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
    """Catalogue ``k`` with its errors in the unit that fits the distances best, and a doubt if the unit changed."""
    catalogue, error = catalogues[k], catalogues[k].choice.error
    others = [other for j, other in enumerate(catalogues) if j != k and other.choice.error.reason != "assumed"]
    if not others:
        return catalogue, ""
    estimates = [common_error(catalogue, other, tuning=tuning) for other in others]
    sigma, share = max(estimates, key=lambda estimate: estimate[1])
    quoted = _median_sigma_arcsec(catalogue)
    if share <= 0.0 or not quoted > 0.0:
        return catalogue, ""
    in_arcsec = {"mas": 1e-3, "arcsec": 1.0, "deg": 3600.0}
    current = in_arcsec[error.columns[0].unit]
    unit = min(_UNITS, key=lambda candidate: abs(np.log(quoted * in_arcsec[candidate] / current / sigma)))
    if unit == error.columns[0].unit:
        return catalogue, ""
    columns = tuple(replace(column, unit=unit) if _is_guessed(column) else column for column in error.columns)
    names = ", ".join(column.name for column in columns if _is_guessed(column))
    text = (
        f"{catalogue.name}: the unit of {names} is not stated; {unit} fits the distances to the other catalogue best, "
    )
    doubt = Message(f"{text}so it was assumed; ", naming(f"give {{sigma_unit{k + 1}:UNIT}}"))
    return catalogue.with_error(replace(error, columns=columns, guessed_unit=False)), doubt


def _is_guessed(column: ChosenColumn) -> bool:
    return column.reason == GUESSED


def _median_sigma_arcsec(catalogue: Catalogue) -> float:
    variance = 0.5 * (catalogue.astrometry.variance(0) + catalogue.astrometry.variance(1))
    known = variance[np.isfinite(variance)]
    return 1e-3 * math.sqrt(median(known)) if len(known) else np.nan


def common_error(
    catalogue: Catalogue, other: Catalogue, *, shared: bool = False, tuning: CommonErrorTuning = COMMON_ERROR
) -> tuple[float, float]:
    """The position error per axis, arcsec, from the distances to another catalogue, and the share of partners.

    The share is 0 where nothing can be estimated: no records, or a copy of the same records.

    shared : the errors of the other catalogue are unknown too, and assumed equal.
    """
    position, variances = _positions(*_in_strips(catalogue, other, tuning), shared)
    if not len(position[0]) or not len(position[1]):
        return tuning.usual_arcsec, 0.0
    # Start from the smaller catalogue: hardly any records of a deep one have a partner in a sparse one.
    if len(position[1]) < len(position[0]):
        distance, density, row, partner_row = _neighbours(position[1], position[0], tuning)
    else:
        distance, density, partner_row, row = _neighbours(*position, tuning)
    if np.median(distance) <= tuning.copied_arcsec:
        return tuning.usual_arcsec, 0.0
    quoted_variance = variances[0][row] + variances[1][partner_row]
    s = np.geomspace(tuning.min_arcsec, tuning.largest_arcsec, tuning.steps)[:, None]
    variance = s**2 * (2.0 if shared else 1.0) + quoted_variance
    chance = 2.0 * np.pi * density * distance
    near = np.exp(-0.5 * distance**2 / variance) * (distance / variance + chance)
    prior = -0.5 * (np.log(s[:, 0] / tuning.usual_arcsec) / tuning.spread_log) ** 2
    shares = np.linspace(0.0, 1.0, tuning.share_steps + 1)[:-1]
    log_chance = np.log(np.maximum(chance, 1e-300))
    log_posterior = [
        (np.log(np.maximum(f * near + (1.0 - f) * chance, 1e-300)) - log_chance).sum(axis=1) + prior for f in shares
    ]
    best_share, best_s = np.unravel_index(int(np.argmax(log_posterior)), (len(shares), len(s)))
    return float(s[best_s, 0]), float(shares[best_share])


def _in_strips(one: Catalogue, two: Catalogue, tuning: CommonErrorTuning) -> tuple[Catalogue, Catalogue]:
    """Both catalogues, large ones reduced to strips of declination.

    The strips of the larger catalogue are twice as high, so that records at the edge of a strip keep their partners and
    neighbours.
    """
    share = tuning.max_rows / max(len(one), len(two))
    if share >= 1.0:
        return one, two
    smaller = min(one, two, key=len)
    dec_deg = smaller.astrometry.dec_deg[np.isfinite(smaller.astrometry.dec_deg)]
    middle, half = (np.arange(tuning.strips) + 0.5) / tuning.strips, 0.25 * share / tuning.strips
    ranks = (np.array([middle - half, middle + half]) * (len(dec_deg) - 1)).round().astype(np.intp)
    low, high = np.partition(dec_deg, ranks.ravel())[ranks]
    margin = 0.5 * (high - low)

    def part(catalogue: Catalogue, low: FloatArray, high: FloatArray) -> Catalogue:
        edges = np.column_stack([np.nextafter(low, -np.inf), high]).ravel()
        within = np.searchsorted(edges, catalogue.astrometry.dec_deg) % 2 == 1
        return catalogue.with_rows(catalogue.table[np.flatnonzero(within)])

    wide = (low - margin, high + margin)
    return (part(one, low, high), part(two, *wide)) if smaller is one else (part(one, *wide), part(two, low, high))


def _positions(
    catalogue: Catalogue, other: Catalogue, shared: bool
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """(n, 3) and (m, 3) directions at a common epoch; (n,) and (m,) variances per axis, arcsec².

    The variance of a catalogue without errors is that of its propagated motions only.
    """
    with_errors = [c.with_error(PositionError("number", sigma_arcsec=1e-3)) for c in (catalogue, other)]
    if not shared and not other.error_is_unknown:
        with_errors[1] = other
    epochs = [c.epoch_jyr for c in with_errors]
    epoch = None if None in epochs else epochs[0] if with_errors[1].has_motion else epochs[1]
    one, two = (c.records(epoch) for c in with_errors)
    variances = [0.5 * (records.covariance[:, 0] + records.covariance[:, -1]) for records in (one, two)]
    return (unit_vectors(*one.features.T), unit_vectors(*two.features.T)), (variances[0], variances[1])


def _neighbours(
    one: FloatArray, two: FloatArray, tuning: CommonErrorTuning
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """(k,) distances to the nearest, arcsec, local densities per arcsec², its row in ``two``, the row in ``one``."""
    sampled = np.arange(0, len(one), max(1, len(one) // tuning.max_records))
    directions = one[sampled]
    count = min(tuning.neighbours, len(two))
    chord, rows = _nearest(directions, two, count, tuning)
    separation = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)) * ARCSEC_PER_RADIAN
    # The nearest may be the partner, so it is excluded from the density (unless it is the only one).
    density = max(count - 1, 1) / (np.pi * np.maximum(separation[:, -1], 1e-3) ** 2)
    return np.maximum(separation[:, 0], tuning.copied_arcsec), density, rows[:, 0], sampled


def _nearest(one: FloatArray, two: FloatArray, count: int, tuning: CommonErrorTuning) -> tuple[FloatArray, IntArray]:
    """(k, count) chords to the nearest directions in ``two``, ascending, and their rows."""
    if len(one) * len(two) > tuning.max_products:
        return _nearest_along(one, two, count, tuning)
    rows = np.argpartition(one @ -two.T, count - 1, axis=1)[:, :count]
    # The scalar product finds the nearest; the chord is computed from differences, without cancellation.
    return _by_chord(one, two, rows)


def _nearest_along(
    one: FloatArray, two: FloatArray, count: int, tuning: CommonErrorTuning
) -> tuple[FloatArray, IntArray]:
    """The same as :func:`_nearest`, searched in windows along the axis of largest extent.

    Windows are doubled until every direction outside must be farther away than the ``count`` found.
    """
    axis, n = int(np.argmax(np.ptp(two, axis=0))), len(two)
    order = np.argsort(two[:, axis], kind="stable")
    along = np.concatenate([[-np.inf], two[order, axis], [np.inf]])
    chord, rows = np.empty((len(one), count)), np.empty((len(one), count), np.intp)
    pending, width = np.arange(len(one)), min(max(tuning.window, count), n)
    while len(pending):
        complete = np.zeros(len(pending), np.bool_)
        chunk_size = max(tuning.max_products // width, 1)
        for chunk in (slice(low, low + chunk_size) for low in range(0, len(pending), chunk_size)):
            part = one[pending[chunk]]
            low = np.clip(np.searchsorted(along[1:-1], part[:, axis]) - width // 2, 0, n - width)
            window_rows = order[low[:, None] + np.arange(width)]
            chord_sq = np.square(part[:, None] - two[window_rows]).sum(axis=2)
            nearest = np.argpartition(chord_sq, count - 1, axis=1)[:, :count]
            chord[pending[chunk]], rows[pending[chunk]] = _by_chord(
                part, two, np.take_along_axis(window_rows, nearest, axis=1)
            )
            reach = np.minimum(part[:, axis] - along[low], along[low + width + 1] - part[:, axis])
            complete[chunk] = chord[pending[chunk], -1] <= reach
        pending, width = pending[~complete], min(2 * width, n)
    return chord, rows


def _by_chord(one: FloatArray, two: FloatArray, rows: IntArray) -> tuple[FloatArray, IntArray]:
    """The chords from each direction to its rows (k, c) of ``two``, ascending, and the rows in this order."""
    chord = np.sqrt(np.square(one[:, None] - two[rows]).sum(axis=2))
    order = np.argsort(chord, axis=1, kind="stable")
    return np.take_along_axis(chord, order, axis=1), np.take_along_axis(rows, order, axis=1)


#: Maximum number of records that determine a field: more hardly change its outline.
_MOST_RECORDS = 10_000
#: Minimum radius of a field, degrees, as for a catalogue of one row (chosen).
_LEAST_RADIUS_DEG = 0.05


@dataclass(frozen=True)
class _Field:
    """A circle on the sky around all records. centre (3,) : unit vector. radius_deg : to the farthest record."""

    centre: FloatArray
    radius_deg: float

    @classmethod
    def of(cls, position_deg: FloatArray) -> _Field:
        vectors = unit_vectors(*position_deg.T)
        centre = mean_direction(vectors)
        return cls(centre, max(float(_degrees(vectors @ centre).max()), _LEAST_RADIUS_DEG))

    def distance_deg(self, other: _Field) -> float:
        """Degrees from centre to centre."""
        return float(_degrees(self.centre @ other.centre))

    def __str__(self) -> str:
        lon, lat = directions_deg(self.centre)
        return f"within {self.radius_deg:.2g}° of RA {lon:.2f}°, Dec {lat:+.2f}°"


def _degrees(cosine: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def disjoint_doubt(first: Catalogue, second: Catalogue, one: Records, two: Records) -> tuple[str, ...]:
    """One line if the fields of the catalogues do not overlap, with a misreading that would explain it.

    one, two : the records of the catalogues.
    """
    positions = [records.features[:: max(1, len(records) // _MOST_RECORDS)] for records in (one, two)]
    fields = [_Field.of(position) for position in positions]
    if fields[0].distance_deg(fields[1]) <= fields[0].radius_deg + fields[1].radius_deg:
        return ()
    text = f"the fields lie apart: {first.name} {fields[0]}, {second.name} {fields[1]}"
    sides = (2, second, positions[1], fields[0], first), (1, first, positions[0], fields[1], second)
    for side, catalogue, position, field, other in sides:
        for misread in _MISREADINGS:
            if misread.possible(catalogue.choice, position):
                corrected_field = _Field.of(misread.corrected(position))
                if corrected_field.distance_deg(field) <= max(corrected_field.radius_deg, field.radius_deg):
                    of = f"of {catalogue.name} would lie in the field of {other.name}: "
                    ra, dec = catalogue.choice.ra.name, catalogue.choice.dec.name
                    meaning = misread.meaning.format(ra=ra, dec=dec)
                    return (Message(f"{text}; {meaning} {of}", misread.remedy(ra, dec, side)),)
    return (f"{text}: do they show the same part of the sky?",)


@dataclass(frozen=True)
class _Misreading:
    """One possible misreading of the position columns.

    possible : whether the columns and positions allow it. corrected : the positions after correction. meaning : text.
    remedy : what to do, given the names of the two columns and the side (1 or 2).
    """

    possible: Callable[[ColumnChoice, FloatArray], bool]
    corrected: Callable[[FloatArray], FloatArray]
    meaning: str
    remedy: Callable[[str, str, int], str]


def _no_unit(choice: ColumnChoice) -> bool:
    return choice.frame == "icrs" and choice.ra.unit == "deg" and choice.ra.reason == "by convention"


def in_icrs(frame: SkyFrame, position_deg: FloatArray) -> FloatArray:
    """(n, 2) positions in ICRS, degrees, of those in another frame."""
    ra, dec, _ = to_icrs(frame, *position_deg.T)
    return np.column_stack([ra, dec])


def _swapped(position_deg: FloatArray) -> FloatArray:
    return np.column_stack([position_deg[:, 1], (position_deg[:, 0] + 180.0) % 360.0 - 180.0])


_MISREADINGS = (
    _Misreading(
        lambda choice, at: choice.frame == "icrs",
        partial(in_icrs, "B1950"),
        "of the equinox B1950, {ra} and {dec}",
        lambda ra, dec, side: "call them ra1950 and dec1950",
    ),
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
        lambda choice, at: bool((np.abs(_swapped(at)[:, 1]) <= 90.0).all()),
        _swapped,
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
        partial(in_icrs, "galactic"),
        "as galactic longitude and latitude, {ra} and {dec}",
        lambda ra, dec, side: "call them l and b",
    ),
)


@dataclass(frozen=True)
class EpochTuning:
    """Thresholds for doubting an epoch; all chosen.

    min_p_pair, largest_sigmas : pairs with a lower probability or a larger residual are not used.
    fewest, max_pairs : with fewer pairs no doubt is reported; more are sampled regularly.
    significant_sigmas : minimum significance of δ, and of an offset in addition. significant_years : minimum of |δ|.
    significant_share : the fastest 5 % of the objects must move by at least this fraction of their errors in δ years.
    largest_axis_ratio, epochs_jyr : an epoch does not explain δ that differ by more than this share between east and
        north, nor one outside this range.
    """

    min_p_pair: float = 0.9
    largest_sigmas: float = 6.0
    fewest: int = 20
    max_pairs: int = 30_000
    significant_sigmas: float = 5.0
    significant_years: float = 0.3
    significant_share: float = 0.3
    largest_axis_ratio: float = 0.3
    epochs_jyr: tuple[float, float] = (1800.0, 2100.0)


EPOCH = EpochTuning()


def epoch_doubt(
    first: Catalogue, second: Catalogue, epoch_jyr: float | None, answer: Identification, errors: Errors
) -> tuple[str, bool]:
    """A doubt about the epoch of one catalogue, or about the convention of the motions (empty if none), and whether the
    epoch also explains a common offset.

    epoch_jyr : common epoch of the match. errors : estimated ones. With the quoted ones bright stars, whose errors are
    mostly a floor, would have most of the weight, and those of them that moved most would count as outliers.
    """
    side = _questioned(first, second)
    if side is None or epoch_jyr is None:
        return "", False
    questioned, other = (first, second) if side == 1 else (second, first)
    moved, moved_side = (questioned, side) if questioned.has_motion else (other, 3 - side)
    assert questioned.epoch_jyr is not None
    return _moved_pairs(moved, moved_side, epoch_jyr, answer, errors).doubt(
        moved,
        moved_side,
        Questioned(questioned.name, questioned.epoch_jyr, naming(f"give {{epoch{side}:YEAR}}"), moved is questioned),
    )


@dataclass(frozen=True)
class Questioned:
    """Whose epoch the residuals test: its name, the assumed or stated epoch, how to give another.

    moved : whether it is the source with the motions itself.
    """

    name: str
    epoch_jyr: float
    remedy: Message
    moved: bool = False


def _moved_pairs(moved: Catalogue, side: int, epoch_jyr: float, answer: Identification, errors: Errors) -> MovedPairs:
    """Some sure pairs with a known proper motion. side : of the moved catalogue, 1 or 2."""
    records, index = (answer.first, answer.pairs.i) if side == 1 else (answer.second, answer.pairs.j)
    use = np.flatnonzero(answer.p_pair > EPOCH.min_p_pair)
    use = use[:: -(-len(use) // EPOCH.max_pairs) or 1]
    astrometry = moved.astrometry[records.rows[index[use]]]
    motion = astrometry.motion_arcsec_per_yr
    return MovedPairs(
        motion,
        (epoch_jyr - astrometry.epoch_jyr)[:, None] * motion,
        answer.pairs.residual[use] if side == 1 else -answer.pairs.residual[use],
        inverse(errors.typical_covariance(answer.pairs, use)),
        np.cos(np.radians(astrometry.dec_deg)),
    )._sure()


def _as_they_are(values: FloatArray) -> FloatArray:
    return values


@dataclass(frozen=True)
class MovedPairs:
    """Pairs with objects that were moved by their proper motions, as a test of epoch and motions.

    Attributes
    ----------
    motion : (m, 2) arcsec/yr, east with cos δ, and north. displaced : (m, 2) arcsec by which the objects were moved.
    residual : (m, 2) arcsec, their position minus that in the other source. precision : (m, 2, 2) of the residuals.
    cos_dec : (m,) cosine of declination. remaining : what a fit to the residuals leaves of (m, 2) values, for residuals
        from a fitted model.
    """

    motion: FloatArray
    displaced: FloatArray
    residual: FloatArray
    precision: FloatArray
    cos_dec: FloatArray
    remaining: Callable[[FloatArray], FloatArray] = _as_they_are

    def _sure(self) -> MovedPairs:
        """Those with known motions and without large residuals."""
        near = np.einsum("mv,mvw,mw->m", self.residual, self.precision, self.residual) < EPOCH.largest_sigmas**2
        some = near & np.isfinite(self.motion).all(axis=1)
        parts = (self.motion, self.displaced, self.residual, self.precision, self.cos_dec)
        return MovedPairs(*(part[some] for part in parts))

    def doubt(self, moved: Catalogue, side: int | str, questioned: Questioned) -> tuple[str, bool]:
        """A doubt about an epoch or the convention of the motions (empty if none), and whether the epoch also explains
        a common offset. side : of the moved catalogue, for the names of options.
        """
        if len(self.motion) < EPOCH.fewest:
            return "", False
        # A catalogue moved from a later epoch than assumed was moved too far; one moved to an earlier epoch than it
        # should, not far enough.
        motion = self.remaining(self.motion if questioned.moved else -self.motion)
        design = np.concatenate([motion[:, :, None], np.broadcast_to(np.eye(2), (len(motion), 2, 2))], axis=2)
        solution, covariance, gain = _least_squares(design, self.residual, self.precision)
        years, error = float(solution[0]), math.sqrt(float(covariance[0, 0]))
        significant_gain = EPOCH.significant_sigmas**2
        motion_sigmas = np.sqrt(np.einsum("mv,mvw,mw->m", motion, self.precision, motion))
        if abs(years) < max(EPOCH.significant_years, EPOCH.significant_sigmas * error):
            return "", False
        if np.quantile(motion_sigmas, 0.95) * abs(years) < EPOCH.significant_share:
            return "", False
        text = f"residuals follow the proper motions of {moved.name}, "
        possible = EPOCH.epochs_jyr[0] <= questioned.epoch_jyr + years <= EPOCH.epochs_jyr[1]
        misread = self.misreading(gain + (significant_gain if possible else -significant_gain))
        if misread is not None:
            return Message(text, *misread.words(moved, side)), False
        factors = self.different_factors()
        if factors or not possible:
            fits = factors or f"as if the epoch of {questioned.name} were {questioned.epoch_jyr + years:.0f}"
            return (
                f"{text}{fits}, which no epoch explains: are they in the right columns, and their units right?",
                False,
            )
        alone, covariance_alone, gain_only = _least_squares(design[:, :, :1], self.residual, self.precision)
        explains = gain - gain_only < significant_gain
        if explains:
            years, error = float(alone[0]), math.sqrt(float(covariance_alone[0, 0]))
        decimals = max(0, math.ceil(-math.log10(error)))
        text += (
            f"as if the epoch of {questioned.name} were {questioned.epoch_jyr + years:.{decimals}f} ± "
            f"{error:.{decimals}f}, not {in_years(round(questioned.epoch_jyr, max(decimals, 1)))}: "
        )
        return Message(text, questioned.remedy), explains

    def misreading(self, min_gain: float) -> _MotionMisreading | None:
        """The misreading of the motions that lowers χ² most, with an offset, and by more than ``min_gain``; or None."""
        offset = np.broadcast_to(np.eye(2), (len(self.residual), 2, 2))
        before, best = _chi_square(self.residual, self.precision), None
        for misread in _MOTION_MISREADINGS:
            corrected = misread.corrected(self.displaced, self.cos_dec)
            residual = self.residual + self.remaining(corrected - self.displaced)
            after = _chi_square(residual, self.precision) - _least_squares(offset, residual, self.precision)[2]
            if before - after > min_gain:
                min_gain, best = before - after, misread
        return best

    def different_factors(self) -> str:
        """The factors on the motions east and north that fit best, as text, if they differ; else empty."""
        if not self.displaced.any():
            return ""
        displaced = self.remaining(self.displaced)
        design = np.concatenate([displaced[:, :, None] * np.eye(2), np.zeros_like(self.precision) + np.eye(2)], 2)
        solution, covariance, _ = _least_squares(design, self.residual, self.precision)
        east, north = 1.0 - solution[:2]
        error = math.sqrt(float(covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1]))
        least = EPOCH.largest_axis_ratio * max(abs(solution[0]), abs(solution[1]))
        if abs(east - north) < max(EPOCH.significant_sigmas * error, least):
            return ""
        return f"which fit best multiplied by {east:.2f} east and {north:.2f} north"


@dataclass(frozen=True)
class _MotionMisreading:
    """One possible misreading of the columns of proper motion.

    meaning : text with the names of the columns. remedy : template of :func:`naming`, with the side (1 or 2).
    corrected : displacements (m, 2) east and north after correction, given those before and cos δ (m,).
    """

    meaning: str
    remedy: str
    corrected: Callable[[FloatArray, FloatArray], FloatArray]

    def words(self, catalogue: Catalogue, side: int | str) -> tuple[str, Message]:
        """The meaning and the remedy, for a catalogue and its side (1, 2, or empty if it is the only one)."""
        ra, dec = ("" if column is None else column.name for column in catalogue.choice.motion[1:3])
        return f"{self.meaning.format(ra=ra, dec=dec)}: ", naming(self.remedy.format(ra=ra, dec=dec, side=side))


_MOTION_MISREADINGS = (
    _MotionMisreading(
        "as if {ra} did not contain cos(dec)",
        "multiply it by cos(dec)",
        lambda moved, cos_dec: moved * np.column_stack([cos_dec, np.ones_like(cos_dec)]),
    ),
    _MotionMisreading(
        "as if {ra} and {dec} were exchanged",
        "give {{pm{side}:'{dec},{ra}'}}",
        lambda moved, cos_dec: moved[:, ::-1],
    ),
    _MotionMisreading("as if {ra} had the other sign", "was it lost?", lambda moved, cos_dec: moved * [-1.0, 1.0]),
    _MotionMisreading("as if {dec} had the other sign", "was it lost?", lambda moved, cos_dec: moved * [1.0, -1.0]),
    _MotionMisreading(
        "as if {ra} and {dec} were in arcsec/yr, not mas/yr",
        "give the columns their unit, arcsec / yr",
        lambda moved, cos_dec: 1e3 * moved,
    ),
)


def _chi_square(residual: FloatArray, precision: FloatArray) -> float:
    return float(np.einsum("mv,mvw,mw->", residual, precision, residual))


def _questioned(first: Catalogue, second: Catalogue) -> int | None:
    """The side whose epoch the residuals test: the one with an assumed epoch, or the one without motions; or None."""
    assumed = [catalogue.choice.epoch.reason == "assumed" for catalogue in (first, second)]
    moving = [catalogue.has_motion for catalogue in (first, second)]
    if first.epoch_jyr is None or second.epoch_jyr is None or not any(moving):
        return None
    if assumed[0] != assumed[1]:
        return 1 if assumed[0] else 2
    if moving[0] != moving[1]:
        return 2 if moving[0] else 1
    return None


def _least_squares(
    design: FloatArray, residual: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Least squares: the (k,) parameters, their (k, k) covariance, and the decrease of χ² by all of them.

    design (m, 2, k), residual (m, 2), precision (m, 2, 2).
    """
    weighted = np.einsum("mvw,mwk->mvk", precision, design)
    information = np.einsum("mvk,mvl->kl", weighted, design) + 1e-12 * np.eye(design.shape[2])
    projection = np.einsum("mvk,mv->k", weighted, residual)
    solution = np.linalg.solve(information, projection)
    return solution, inverse(information), float(solution @ projection)


__all__ = ["EpochTuning", "MovedPairs", "Questioned", "epoch_doubt"]
