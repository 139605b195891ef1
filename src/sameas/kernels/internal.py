"""Rows of one table: the best partition of each component into objects, and how sure it is.

With the model of :mod:`sameas.sky.internal`, ln w of an object of K rows x_i with errors S_i is

    ln ρ + c(K) + ln ∫ Π N(x_i; μ, S_i) dμ + (its second and further rows of an exposure) ln r.

A component begins as one object. Objects are divided in two while that weighs more, rows go to the object with which
they weigh most, and objects merge, until nothing gains.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import part, small_by

LOG_2PI = math.log(2.0 * math.pi)
LEAST_GAIN = 1e-9  # of ln w, against rounding
#: Most rounds of dividing, moving and merging; sweeps over the rows in each; steps of the fit of two parts, and of a
#: place with heavy tails.
ROUNDS, SWEEPS, PART_STEPS, PLACE_STEPS = 5, 20, 12, 6
FAR_SQ = 200.0  # squared normalised distance beyond which neither rows nor objects are joined
NEAR_SQ = 50.0  # the same for an exchange of two rows
ITEMS_OF_ROW = 5_000  # operations on a row, about
NEGLIGIBLE, LEAST_P = -700.0, 1e-300  # ln of what counts as 0; lower limit of a probability that divides


class RowModel(NamedTuple):
    """log_count : (m + 1,) c(K). scales, shares : of the mixture of normals of the errors. log_repeat : ln r."""

    log_count: FloatArray
    scales: FloatArray
    shares: FloatArray
    log_repeat: float


class RowArrays(NamedTuple):
    """xy : (n, 2) east and north within the component. precision : (n, 3) inverse covariances, xx, xy, yy. exposure :
    (n,) numbers; −1 where none is known. beside : (n,) the next row of the same exposure, after the last the first."""

    xy: FloatArray
    precision: FloatArray
    exposure: IntArray
    beside: IntArray


@small_by(lambda first, last, start, xy, *_: ITEMS_OF_ROW * len(xy))
def partition(
    first: int, last: int, start: IntArray, xy: FloatArray, precision: FloatArray, exposure: IntArray,
    log_density: FloatArray, model: RowModel, label: IntArray, p_row: FloatArray, p_object: FloatArray,
    place: FloatArray, alternative: FloatArray,
) -> None:  # fmt: skip
    """Fill the object of each row, a number within its component, its probabilities, and the place of its object.

    start : (g + 1,) rows of each component; those from ``first`` to ``last`` are filled. xy, precision, exposure : of
    all rows, see :class:`RowArrays`. log_density : (g,) ln ρ.
    p_row : (n,) that the row is of its object, all others as they are. p_object : (n,) that exactly these
    rows are the object. place : (n, 5) x, y, and the precision xx, xy, yy.
    alternative : (n, 4) at the first row of each object: the probability that it is two, and the rows of one of them;
    that it is one with another, and the rows of that.
    """
    for g in range(first, last):
        a, b = start[g], start[g + 1]
        some = RowArrays(xy[a:b], precision[a:b], exposure[a:b], _beside(exposure[a:b]))
        of_row = np.zeros(b - a, np.int64)
        count = _divided(some, log_density[g], model, of_row, 1)
        for _ in range(ROUNDS):
            if count == 1:
                break
            moved = _moved(some, log_density[g], model, of_row, count)
            merged = _merged(some, log_density[g], model, of_row, count)
            count = _renumbered(of_row, count)
            before = count
            count = _divided(some, log_density[g], model, of_row, count)
            if not (moved or merged or count > before):
                break
        out = p_row[a:b], p_object[a:b], place[a:b], alternative[a:b]
        _probabilities(some, log_density[g], model, of_row, count, *out)
        label[a:b] = of_row


@part
def _beside(exposure: IntArray) -> IntArray:
    """(n,) see :class:`RowArrays`."""
    order, beside = np.argsort(exposure, kind="mergesort"), np.arange(len(exposure))
    begin = 0
    for k in range(1, len(order) + 1):
        if k == len(order) or exposure[order[k]] != exposure[order[begin]]:
            if exposure[order[begin]] >= 0:
                for m in range(begin, k):
                    beside[order[m]] = order[m + 1] if m + 1 < k else order[begin]
            begin = k
    return beside


@part
def _profile(square: float, model: RowModel) -> tuple[float, float]:
    """ln Σ share s⁻² exp(−q/2s²) of a squared distance q, and the mean of s⁻² given it."""
    if len(model.scales) == 1:
        s = model.scales[0]
        return -0.5 * square / (s * s) - 2.0 * math.log(s) + math.log(model.shares[0]), 1.0 / (s * s)
    widest = 0.0
    for k in range(len(model.scales)):
        if model.shares[k] > 0.0 and model.scales[k] > widest:
            widest = model.scales[k]
    total, weighted = 0.0, 0.0
    for k in range(len(model.scales)):
        inverse = 1.0 / (model.scales[k] * model.scales[k])
        density = model.shares[k] * inverse * math.exp(-0.5 * square * (inverse - 1.0 / (widest * widest)))
        total += density
        weighted += density * inverse
    return math.log(total) - 0.5 * square / (widest * widest), weighted / total


@part
def _members(of_row: IntArray, wanted: int) -> IntArray:
    """The rows of an object."""
    return np.flatnonzero(of_row == wanted)


@part
def _place(members: IntArray, rows: RowArrays, model: RowModel, out: FloatArray) -> float:
    """The place of an object and its precision, ``out`` (5,): x, y, xx, xy, yy; returns ln ∫ Π N dμ."""
    weight = np.ones(len(members))
    steps = 1 if len(model.scales) == 1 else PLACE_STEPS
    if len(model.scales) == 1:
        weight[:] = 1.0 / (model.scales[0] * model.scales[0])
    log_sum = 0.0
    for step in range(steps + 1):
        xx, xy, yy, bx, by = 0.0, 0.0, 0.0, 0.0, 0.0
        for m in range(len(members)):
            i, w = members[m], weight[m]
            pxx, pxy, pyy = w * rows.precision[i, 0], w * rows.precision[i, 1], w * rows.precision[i, 2]
            xx += pxx
            xy += pxy
            yy += pyy
            bx += pxx * rows.xy[i, 0] + pxy * rows.xy[i, 1]
            by += pxy * rows.xy[i, 0] + pyy * rows.xy[i, 1]
        determinant = xx * yy - xy * xy
        out[0], out[1] = (yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant
        out[2], out[3], out[4] = xx, xy, yy
        log_sum = LOG_2PI - 0.5 * math.log(determinant)
        for m in range(len(members)):
            i = members[m]
            p = rows.precision[i]
            profile, w = _profile(_square(rows.xy[i, 0] - out[0], rows.xy[i, 1] - out[1], p[0], p[1], p[2]), model)
            log_sum += profile + 0.5 * math.log(p[0] * p[2] - p[1] * p[1]) - LOG_2PI
            if step < steps:
                weight[m] = w
    profile, w = _profile(0.0, model)
    return log_sum - profile + math.log(w)


@part
def _square(x: float, y: float, xx: float, xy: float, yy: float) -> float:
    return x * x * xx + 2.0 * x * y * xy + y * y * yy


@part
def _surplus(members: IntArray, rows: RowArrays) -> int:
    """The second and further rows of an exposure."""
    exposure = np.sort(rows.exposure[members])
    number = 0
    for m in range(1, len(exposure)):
        if exposure[m] >= 0 and exposure[m] == exposure[m - 1]:
            number += 1
    return number


@part
def _log_weight(members: IntArray, rows: RowArrays, log_density: float, model: RowModel, place: FloatArray) -> float:
    """ln w of an object, whose place is written."""
    log_sum = _place(members, rows, model, place)
    return log_density + model.log_count[len(members)] + log_sum + model.log_repeat * _surplus(members, rows)


@part
def _divided(rows: RowArrays, log_density: float, model: RowModel, of_row: IntArray, count: int) -> int:
    """Divide objects while that gains; returns their number."""
    o = 0
    while o < count:
        members = _members(of_row, o)
        if len(members) < 2:
            o += 1
            continue
        sides, gains = _divisions(members, rows, log_density, model)
        best = np.argmax(gains)
        if gains[best] > LEAST_GAIN:
            for m in range(len(members)):
                if sides[best, m]:
                    of_row[members[m]] = count
            count += 1
        else:
            o += 1
    return count


@part
def _divisions(members: IntArray, rows: RowArrays, log_density: float, model: RowModel) -> tuple[BoolArray, FloatArray]:
    """Three divisions (3, k) of an object, each the rows of its second part, and their gains (3,): halves along the
    longest axis and across it, and the farthest row alone."""
    k = len(members)
    place, other = np.empty(5), np.empty(5)
    whole = _log_weight(members, rows, log_density, model, place)
    xx, xy, yy = 0.0, 0.0, 0.0
    farthest, at = -1.0, 0
    for m in range(k):
        i = members[m]
        p = rows.precision[i]
        x, y = rows.xy[i, 0] - place[0], rows.xy[i, 1] - place[1]
        square, w = _square(x, y, p[0], p[1], p[2]), 0.5 * (p[0] + p[2])
        xx += w * x * x
        xy += w * x * y
        yy += w * y * y
        if square > farthest:
            farthest, at = square, m
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    sides, gains = np.zeros((3, k), np.bool_), np.full(3, NEGLIGIBLE)
    sides[2, at] = True
    for start in range(3):
        side = sides[start]
        if start < 2:
            along_x, along_y = math.cos(angle + start * 0.5 * math.pi), math.sin(angle + start * 0.5 * math.pi)
            for m in range(k):
                i = members[m]
                side[m] = (rows.xy[i, 0] - place[0]) * along_x + (rows.xy[i, 1] - place[1]) * along_y > 0.0
            _settle(members, rows, model, side)
        number = np.count_nonzero(side)
        if 0 < number < k:
            parts = _log_weight(members[~side], rows, log_density, model, other)
            parts += _log_weight(members[side], rows, log_density, model, other)
            gains[start] = parts - whole
    return sides, gains


@part
def _odds_of_two(members: IntArray, rows: RowArrays, log_density: float, model: RowModel) -> tuple[float, int]:
    """The sum of the weights of all divisions of an object, over its weight: those into halves and near to these; and
    the number of rows of a part of the best one.

    Two near objects have thousands of divisions, of which none weighs much: of eight rows each 2σ apart the best has a
    tenth of the sum. Single rows are moved by themselves, and left out here.
    """
    k = len(members)
    total = 0.0
    if k < 4:
        return total, 0
    sides, gains = _divisions(members, rows, log_density, model)
    for start in range(2):
        number = np.count_nonzero(sides[start])
        same = start == 1 and (np.all(sides[0] == sides[1]) or np.all(sides[0] != sides[1]))
        if same or number < 2 or number > k - 2:
            continue
        log_ways = _log_ways(members, sides[start], rows, log_density, model)
        total += math.exp(min(gains[start] + log_ways, -NEGLIGIBLE))
    return total, np.count_nonzero(sides[np.argmax(gains)])


@part
def _log_ways(members: IntArray, second: BoolArray, rows: RowArrays, log_density: float, model: RowModel) -> float:
    """ln of the weights of a division (k,) and of all that differ from it in some rows, over its own; the places of the
    parts stay, and parts of one row are left out."""
    some = RowArrays(rows.xy[members], rows.precision[members], rows.exposure[members], _beside(rows.exposure[members]))
    of_row, k = second.astype(np.int64), len(members)
    sizes, places, terms = np.zeros(2, np.int64), np.empty((2, 5)), np.empty(3)
    _places(some, model, of_row, sizes, places)
    # By the number of rows in the second part, c(K) apart.
    weight = np.zeros(k + 1)
    weight[0] = 1.0
    for i in range(k):
        own, other = of_row[i], 1 - of_row[i]
        _row_terms(i, some, log_density, model, of_row, sizes, places, terms)
        gain = terms[other] - model.log_count[sizes[other] + 1] + model.log_count[sizes[other]]
        gain -= terms[own] - model.log_count[sizes[own]] + model.log_count[sizes[own] - 1]
        moved = math.exp(min(gain, 0.0))
        in_second, in_first = (1.0, moved) if own == 1 else (moved, 1.0)
        for size in range(i + 1, 0, -1):
            weight[size] = weight[size] * in_first + weight[size - 1] * in_second
        weight[0] *= in_first
    total = 0.0
    for size in range(2, k - 1):
        log_count = model.log_count[size] + model.log_count[k - size]
        log_count -= model.log_count[sizes[1]] + model.log_count[sizes[0]]
        total += weight[size] * math.exp(min(log_count, -NEGLIGIBLE))
    return math.log(max(total, LEAST_P))


@part
def _settle(members: IntArray, rows: RowArrays, model: RowModel, side: BoolArray) -> None:
    """Each row to the nearer of the two parts, and of two rows of an exposure one to each, until they stay."""
    k = len(members)
    places = np.empty((2, 5))
    lead = np.empty(k)
    by_exposure = np.argsort(rows.exposure[members], kind="mergesort")
    for _ in range(PART_STEPS):
        number = np.count_nonzero(side)
        if number == 0 or number == k:
            return
        _place(members[~side], rows, model, places[0])
        _place(members[side], rows, model, places[1])
        for m in range(k):
            i = members[m]
            p = rows.precision[i]
            lead[m] = 0.0
            for one in range(2):
                x, y = rows.xy[i, 0] - places[one, 0], rows.xy[i, 1] - places[one, 1]
                profile, _w = _profile(_square(x, y, p[0], p[1], p[2]), model)
                lead[m] += profile if one == 1 else -profile
        changed = False
        for e in range(k):
            m = by_exposure[e]
            new = lead[m] > 0.0
            for beside in (e - 1, e + 1):
                if 0 <= beside < k:
                    n = by_exposure[beside]
                    same = rows.exposure[members[m]] >= 0 and rows.exposure[members[m]] == rows.exposure[members[n]]
                    if same and (lead[n] > 0.0) == new and abs(lead[m]) < abs(lead[n]):
                        new = not new
                        break
            changed = changed or new != side[m]
            side[m] = new
        if not changed:
            return


@part
def _of_exposure(i: int, o: int, rows: RowArrays, of_row: IntArray) -> int:
    """Another row of the same exposure in the object ``o``; −1 if there is none."""
    other = rows.beside[i]
    while other != i:
        if of_row[other] == o:
            return int(other)
        other = rows.beside[other]
    return -1


@part
def _row_terms(
    i: int, rows: RowArrays, log_density: float, model: RowModel, of_row: IntArray, sizes: IntArray, places: FloatArray,
    terms: FloatArray,
) -> None:  # fmt: skip
    """Fill ``terms`` (k + 1,), ln w with a row in each object, and in one of its own; common terms are left out."""
    own, p = of_row[i], rows.precision[i]
    for o in range(len(sizes)):
        terms[o], size = NEGLIGIBLE, sizes[o]
        if size == 0 or (o == own and size == 1):
            continue
        x, y, xx, xy, yy = places[o, 0], places[o, 1], places[o, 2], places[o, 3], places[o, 4]
        if o == own:
            # The place without this row.
            square = _square(rows.xy[i, 0] - x, rows.xy[i, 1] - y, p[0], p[1], p[2])
            _, w = _profile(square, model)
            bx = xx * x + xy * y - w * (p[0] * rows.xy[i, 0] + p[1] * rows.xy[i, 1])
            by = xy * x + yy * y - w * (p[1] * rows.xy[i, 0] + p[2] * rows.xy[i, 1])
            xx, xy, yy, size = xx - w * p[0], xy - w * p[1], yy - w * p[2], size - 1
            determinant = xx * yy - xy * xy
            x, y = (yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant
        determinant, of_p = xx * yy - xy * xy, p[0] * p[2] - p[1] * p[1]
        sxx, sxy, syy = p[2] / of_p + yy / determinant, -p[1] / of_p - xy / determinant, p[0] / of_p + xx / determinant
        of_s = sxx * syy - sxy * sxy
        square = _square(rows.xy[i, 0] - x, rows.xy[i, 1] - y, syy / of_s, -sxy / of_s, sxx / of_s)
        if square > FAR_SQ and o != own:
            continue
        terms[o] = model.log_count[size + 1] - model.log_count[size] - 0.5 * math.log(of_s) - LOG_2PI
        terms[o] += _profile(square, model)[0]
        if _of_exposure(i, o, rows, of_row) >= 0:
            terms[o] += model.log_repeat
    terms[-1] = log_density + model.log_count[1]
    if sizes[own] == 1:
        terms[own], terms[-1] = terms[-1], NEGLIGIBLE


@part
def _places(rows: RowArrays, model: RowModel, of_row: IntArray, sizes: IntArray, places: FloatArray) -> None:
    for o in range(len(sizes)):
        members = _members(of_row, o)
        sizes[o] = len(members)
        if len(members):
            _place(members, rows, model, places[o])


@part
def _exchange(
    i: int, o: int, rows: RowArrays, log_density: float, model: RowModel, of_row: IntArray, places: FloatArray
) -> tuple[float, int]:  # fmt: skip
    """The gain of exchanging a row with that of the same exposure in the object ``o``, and that row; −1 if none."""
    own, p = of_row[i], rows.precision[i]
    if o == own or _square(rows.xy[i, 0] - places[o, 0], rows.xy[i, 1] - places[o, 1], p[0], p[1], p[2]) > NEAR_SQ:
        return NEGLIGIBLE, -1
    other = _of_exposure(i, o, rows, of_row)
    if other < 0:
        return NEGLIGIBLE, -1
    trial = np.empty(5)
    gain = 0.0
    for sign in (-1.0, 1.0):
        for one in (own, o):
            gain += sign * _log_weight(_members(of_row, one), rows, log_density, model, trial)
        of_row[i], of_row[other] = of_row[other], of_row[i]
    return gain, other


@part
def _moved(rows: RowArrays, log_density: float, model: RowModel, of_row: IntArray, count: int) -> bool:
    """Move rows to where they weigh more, one by one; returns whether any was."""
    sizes, places, terms = np.zeros(count, np.int64), np.empty((count, 5)), np.empty(count + 1)
    any_moved = False
    for _ in range(SWEEPS):
        _places(rows, model, of_row, sizes, places)
        moved = False
        for i in range(len(of_row)):
            _row_terms(i, rows, log_density, model, of_row, sizes, places, terms)
            at = int(np.argmax(terms[:count]))
            if terms[at] <= terms[of_row[i]] + LEAST_GAIN:
                for o in range(count):
                    gain, other = _exchange(i, o, rows, log_density, model, of_row, places)
                    if gain > LEAST_GAIN:
                        of_row[i], of_row[other] = of_row[other], of_row[i]
                        moved = True
                        for one in (of_row[i], of_row[other]):
                            _place(_members(of_row, one), rows, model, places[one])
                continue
            own = of_row[i]
            of_row[i] = at
            moved = True
            for o in (own, at):
                members = _members(of_row, o)
                sizes[o] = len(members)
                if len(members):
                    _place(members, rows, model, places[o])
        any_moved = any_moved or moved
        if not moved:
            break
    return any_moved


@part
def _near(one: FloatArray, two: FloatArray, rows: RowArrays, a: IntArray, b: IntArray) -> bool:
    """Whether two objects are near enough to be one, by the errors of their best rows."""
    x, y = one[0] - two[0], one[1] - two[1]
    best = np.inf
    for members in (a, b):
        for m in range(len(members)):
            p = rows.precision[members[m]]
            best = min(best, _square(x, y, p[0], p[1], p[2]))
    return best < FAR_SQ


@part
def _union_gain(
    own: IntArray, o: int, other: int, rows: RowArrays, log_density: float, model: RowModel, of_row: IntArray,
    weights: FloatArray, places: FloatArray,
) -> float:  # fmt: skip
    """The gain of the union of two objects, of which the first has the rows ``own``; negligible if they are far."""
    members = _members(of_row, other)
    if not _near(places[o], places[other], rows, own, members):
        return NEGLIGIBLE
    union = np.sort(np.concatenate((own, members)))
    return _log_weight(union, rows, log_density, model, np.empty(5)) - weights[o] - weights[other]


@part
def _merged(rows: RowArrays, log_density: float, model: RowModel, of_row: IntArray, count: int) -> bool:
    """Merge objects whose union weighs more, the largest gain of each first; returns whether any was."""
    weights, places = np.full(count, np.nan), np.empty((count, 5))
    any_merged = False
    for o in range(count):
        members = _members(of_row, o)
        if len(members):
            weights[o] = _log_weight(members, rows, log_density, model, places[o])
    for o in range(count):
        while not math.isnan(weights[o]):
            own = _members(of_row, o)
            best, at = LEAST_GAIN, -1
            for other in range(count):
                if other == o or math.isnan(weights[other]):
                    continue
                gain = _union_gain(own, o, other, rows, log_density, model, of_row, weights, places)
                if gain > best:
                    best, at = gain, other
            if at < 0:
                break
            of_row[_members(of_row, at)] = o
            weights[at] = np.nan
            weights[o] = _log_weight(_members(of_row, o), rows, log_density, model, places[o])
            any_merged = True
    return any_merged


@part
def _renumbered(of_row: IntArray, count: int) -> int:
    """Number the objects by their first rows; returns their number."""
    number = np.full(count, -1)
    used = 0
    for i in range(len(of_row)):
        if number[of_row[i]] < 0:
            number[of_row[i]] = used
            used += 1
        of_row[i] = number[of_row[i]]
    return used


@part
def _probabilities(
    rows: RowArrays, log_density: float, model: RowModel, of_row: IntArray, count: int, p_row: FloatArray,
    p_object: FloatArray, place: FloatArray, alternative: FloatArray,
) -> None:  # fmt: skip
    """Fill what :func:`partition` says of the probabilities of the objects."""
    sizes, places, terms = np.zeros(count, np.int64), np.empty((count, 5)), np.empty(count + 1)
    exact = np.ones(count)
    _places(rows, model, of_row, sizes, places)
    for i in range(len(of_row)):
        own = of_row[i]
        _row_terms(i, rows, log_density, model, of_row, sizes, places, terms)
        stays, total = terms[own], 0.0
        for o in range(count + 1):
            terms[o] = 1.0 if o == own else math.exp(min(terms[o] - stays, -NEGLIGIBLE))
            if o < count and o != own:
                gain, _other = _exchange(i, o, rows, log_density, model, of_row, places)
                terms[o] += math.exp(min(gain, -NEGLIGIBLE))
            total += terms[o]
        p_row[i] = 1.0 / total
        exact[own] *= p_row[i]
        for o in range(count):
            if o != own:
                exact[o] *= 1.0 - terms[o] / total
    weights, trial = np.empty(count), np.empty(5)
    for o in range(count):
        weights[o] = _log_weight(_members(of_row, o), rows, log_density, model, trial)
    for o in range(count):
        own = _members(of_row, o)
        division, second_rows = _odds_of_two(own, rows, log_density, model)
        best_union, with_rows = 0.0, 0
        whole = 1.0 / max(exact[o], LEAST_P) + division
        for other in range(count):
            if other == o:
                continue
            gain = _union_gain(own, o, other, rows, log_density, model, of_row, weights, places)
            union = math.exp(min(gain, -NEGLIGIBLE))
            whole += union
            if union > best_union:
                best_union, with_rows = union, sizes[other]
        alternative[own[0], 0], alternative[own[0], 1] = division / whole, second_rows
        alternative[own[0], 2], alternative[own[0], 3] = best_union / whole, with_rows
        for i in own:
            p_object[i] = 1.0 / whole
            place[i] = places[o]
