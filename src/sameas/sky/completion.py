"""Completion: what one catalogue lacks is assumed from the others: a common position error, a unit, an epoch.

Each assumption is reported as a doubt with its value and the option to give instead (:func:`completed`). The common
error s of a catalogue without errors is estimated from the distances r to the nearest neighbours in the other one. With
a fraction f of records that have a partner, and unrelated records of local density ρ,

    p(r) = exp(−π ρ r²) { f exp(−r²/2σ²) [r/σ² + 2π ρ r] + (1 − f) 2π ρ r },   σ² = s² + (error of the other)².

s and f maximise the posterior on a grid, with a wide prior of s. The match then estimates a scale of this error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sameas.arrays import FloatArray, IntArray, median
from sameas.errors import Message, naming
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import GUESSED, ChosenColumn, PositionError
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

USUAL_ARCSEC, SPREAD_LOG = 0.3, 2.0  # median of the prior of s, and standard deviation of its natural logarithm
MIN_ARCSEC, LARGEST_ARCSEC = 1e-3, 60.0  # range of the grid of s
STEPS, SHARE_STEPS = 80, 16  # grid points of s and of f
NEIGHBOURS = 6  # the local density is taken from the distance to the neighbour of this rank
COPIED_ARCSEC = 1e-6  # the catalogues are copies if the median nearest-neighbour distance is at most this
MAX_RECORDS = 4000  # maximum number of records used, evenly sampled
#: All distances are computed if they are at most this many, which takes less time than to import a k-d tree.
MAX_PRODUCTS = 4_000_000


#: Larger catalogues are reduced to about this many rows, in this many strips of declination.
MAX_ROWS, STRIPS = 40_000, 2

_UNITS = ("mas", "arcsec", "deg")


def completed(
    catalogues: Sequence[Catalogue], epoch_jyr: float | None = None
) -> tuple[list[Catalogue], tuple[str, ...]]:
    """The catalogues with missing epochs, errors and units assumed, and one doubt per assumption.

    epoch_jyr : common epoch of the match, None if not given.
    """
    with_epochs, of_epochs = with_known_epochs(catalogues, epoch_jyr)
    result, doubts = list(with_epochs), list(of_epochs)
    for k, catalogue in enumerate(with_epochs):
        if catalogue.error_is_unknown:
            sigma, source = _error_against_others(with_epochs, k)
            text = (
                f"{catalogue.name}: it has no position errors; {sigma:.2g} arcsec on each axis was assumed, {source}; "
            )
            doubts.append(Message(text, naming(f"give {{sigma{k + 1}:ARCSEC}} or {{sigma{k + 1}:COLUMN}}")))
            result[k] = catalogue.with_error(PositionError("number", sigma_arcsec=sigma, reason="assumed"))
    for k, catalogue in enumerate(result):
        if catalogue.choice.error.guessed_unit:
            result[k], doubt = _with_likelier_unit(result, k)
            doubts += [doubt] if doubt else []
    return result, tuple(doubts)


def with_known_epochs(
    catalogues: Sequence[Catalogue], epoch_jyr: float | None
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


def _error_against_others(catalogues: Sequence[Catalogue], k: int) -> tuple[float, str]:
    """The common error of catalogue ``k``, arcsec, and a text on its origin."""
    found = []
    for other, catalogue in enumerate(catalogues):
        if other != k:
            shared = catalogue.error_is_unknown
            sigma, share = common_error(catalogues[k], catalogue, shared=shared)
            found.append((share, sigma, catalogue.name))
    share, sigma, name = max(found)
    if share <= 0.0:
        return sigma, f"a typical one, for its records do not lie near those of {name}, or are a copy of them"
    return sigma, f"estimated from the distances to {name}"


def _with_likelier_unit(catalogues: Sequence[Catalogue], k: int) -> tuple[Catalogue, str]:
    """Catalogue ``k`` with its errors in the unit that fits the distances best, and a doubt if the unit changed."""
    catalogue, error = catalogues[k], catalogues[k].choice.error
    others = [other for j, other in enumerate(catalogues) if j != k and other.choice.error.reason != "assumed"]
    if not others:
        return catalogue, ""
    estimates = [common_error(catalogue, other) for other in others]
    sigma, share = max(estimates, key=lambda estimate: estimate[1])
    variance = 0.5 * (catalogue.astrometry.variance(0) + catalogue.astrometry.variance(1))
    known = variance[np.isfinite(variance)]
    quoted = 1e-3 * math.sqrt(median(known)) if len(known) else np.nan
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


def common_error(
    catalogue: Catalogue, other: Catalogue, *, shared: bool = False, max_rows: int = MAX_ROWS
) -> tuple[float, float]:
    """The position error per axis, arcsec, from the distances to another catalogue, and the share of partners.

    The share is 0 where nothing can be estimated: no records, or a copy of the same records.

    shared : the errors of the other catalogue are unknown too, and assumed equal. max_rows : of :func:`in_strips`.
    """
    position, variances = _positions(*in_strips(catalogue, other, max_rows), shared)
    if not len(position[0]) or not len(position[1]):
        return USUAL_ARCSEC, 0.0
    # Start from the smaller catalogue: hardly any records of a deep one have a partner in a sparse one.
    if len(position[1]) < len(position[0]):
        distance, density, row, partner_row = _neighbours(position[1], position[0])
    else:
        distance, density, partner_row, row = _neighbours(*position)
    if np.median(distance) <= COPIED_ARCSEC:
        return USUAL_ARCSEC, 0.0
    quoted_variance = variances[0][row] + variances[1][partner_row]
    s = np.geomspace(MIN_ARCSEC, LARGEST_ARCSEC, STEPS)[:, None]
    variance = s**2 * (2.0 if shared else 1.0) + quoted_variance
    chance = 2.0 * np.pi * density * distance
    near = np.exp(-0.5 * distance**2 / variance) * (distance / variance + chance)
    prior = -0.5 * (np.log(s[:, 0] / USUAL_ARCSEC) / SPREAD_LOG) ** 2
    shares = np.linspace(0.0, 1.0, SHARE_STEPS + 1)[:-1]
    log_chance = np.log(np.maximum(chance, 1e-300))
    log_posterior = [
        (np.log(np.maximum(f * near + (1.0 - f) * chance, 1e-300)) - log_chance).sum(axis=1) + prior for f in shares
    ]
    best_share, best_s = np.unravel_index(int(np.argmax(log_posterior)), (len(shares), len(s)))
    return float(s[best_s, 0]), float(shares[best_share])


def in_strips(one: Catalogue, two: Catalogue, max_rows: int) -> tuple[Catalogue, Catalogue]:
    """Both catalogues, large ones reduced to strips of declination with about ``max_rows`` rows.

    The strips of the larger catalogue are twice as high, so that records at the edge of a strip keep their partners and
    neighbours.
    """
    share = max_rows / max(len(one), len(two))
    if share >= 1.0:
        return one, two
    smaller = min(one, two, key=len)
    dec_deg = smaller.astrometry.dec_deg[np.isfinite(smaller.astrometry.dec_deg)]
    middle, half = (np.arange(STRIPS) + 0.5) / STRIPS, 0.25 * share / STRIPS
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


def _neighbours(one: FloatArray, two: FloatArray) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """(k,) distances to the nearest, arcsec, local densities per arcsec², its row in ``two``, the row in ``one``."""
    sampled = np.arange(0, len(one), max(1, len(one) // MAX_RECORDS))
    directions = one[sampled]
    count = min(NEIGHBOURS, len(two))
    chord, rows = nearest_chords(directions, two, count, MAX_PRODUCTS)
    separation = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)) * ARCSEC_PER_RADIAN
    # The nearest may be the partner, so it is excluded from the density (unless it is the only one).
    density = max(count - 1, 1) / (np.pi * np.maximum(separation[:, -1], 1e-3) ** 2)
    return np.maximum(separation[:, 0], COPIED_ARCSEC), density, rows[:, 0], sampled


def nearest_chords(one: FloatArray, two: FloatArray, count: int, max_products: int) -> tuple[FloatArray, IntArray]:
    """(k, count) chords to the nearest directions in ``two``, ascending, and their rows."""
    if len(one) * len(two) > max_products:
        from scipy.spatial import cKDTree

        rows = cKDTree(two).query(one, k=np.arange(1, count + 1))[1]
    else:
        rows = np.argpartition(one @ -two.T, count - 1, axis=1)[:, :count]
    # Products of directions lose digits, so the chords are computed from differences.
    return _by_chord(one, two, rows)


def _by_chord(one: FloatArray, two: FloatArray, rows: IntArray) -> tuple[FloatArray, IntArray]:
    """The chords from each direction to its rows (k, c) of ``two``, ascending, and the rows in this order."""
    chord = np.sqrt(np.square(one[:, None] - two[rows]).sum(axis=2))
    order = np.argsort(chord, axis=1, kind="stable")
    return np.take_along_axis(chord, order, axis=1), np.take_along_axis(rows, order, axis=1)
