"""Exact sums in the balls around records of groups that cannot be summed exactly, with messages from beyond.

The *ball* of a row is that row, its center, and the rows that compete with it most. Messages from outside act on the
columns. The odds of each pair are divided by what its column counts if no row of the ball takes it, so that an untaken
column counts 1; a column that only one row of the ball can take is part of that row's odds to take none of the others.

The options of the rows except the center are enumerated, except for the last two rows, whose sum is a product minus the
terms in which both take the same column. With every sum, its part in which a column is taken is summed too: the rest is
available to the center.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from sameas.arrays import FloatArray, Int32Array
from sameas.kernels.compiled import inlined, kernel, part

#: Lower limit of the divisor of odds, so that their products over the rows of a ball stay finite.
TINY = 1e-30
#: Rivals of a weaker claim are not in the ball, unless the reduced odds of both pairs have a product above TIGHT:
#: around a loop of pairs that nearly exclude no partner, messages become over-confident without bound.
WEAKEST, TIGHT = 1e-9, 1e-6
#: If less than this share of the sums is available to the center, differences have lost digits.
CANCELLED = 1e-6
#: If less than this is available to the center, its probabilities are by messages alone.
LEAST = 1e-200
UNKNOWN, NONE = -1, -1

#: A graph. By row: CSR starts; columns, reduced odds and messages to the columns (claims) of the pairs. By column: CSR
#: starts, rows, claims and reduced odds of the pairs. Odds of rows and of columns to have no partner.
Graph = namedtuple("Graph", "start column odds claim column_start rival rival_claim rival_odds none free")
#: Workspace of a ball. Its rows, and the next rival of each; of all rows whether they are inside; of all columns the
#: number in the ball. Of the ball's columns: what each counts untaken, whether rows share it, whether it is taken, the
#: part of the sum that is then lost to the center, the weights of it of the last two rows. Options of the rows: first
#: and last, columns, weights. By depth of the enumeration: the weight so far, the sum of deeper levels, the next
#: option, the column held.
Ball = namedtuple(
    "Ball",
    "row next inside place unused shared taken lost weight_a weight_b first last column weight "
    "so_far total option held",
)


@kernel
def rank_rivals(first: int, last: int, graph: Graph, rivals: Int32Array, strength: FloatArray) -> None:
    """Write to ``rivals`` (n1, k) the k rows that compete most with each of some rows, NONE if there are fewer.

    strength (n1, k) : the product of both rows' claims on a column, each at most 1; negligible claims of pairs with
    large reduced odds have the smallest strength.
    """
    most = rivals.shape[1]
    for row in range(first, last):
        count = np.int64(0)
        for e in range(graph.start[row], graph.start[row + 1]):
            own_claim = min(graph.claim[e], 1.0)
            c = graph.column[e]
            for p in range(graph.column_start[c], graph.column_start[c + 1]):
                claim = min(graph.rival_claim[p], 1.0) * own_claim
                rival = graph.rival[p]
                if claim <= WEAKEST:
                    tight = graph.rival_odds[p] * graph.odds[e]
                    claim = WEAKEST * tight if tight > TIGHT else 0.0
                if claim == 0.0 or rival == row or (count == most and claim <= strength[row, most - 1]):
                    continue
                at = np.int64(0)
                while at < count and rivals[row, at] != rival:
                    at += 1
                if at == count:
                    count = min(count + 1, most)
                    at = count - 1
                elif claim <= strength[row, at]:
                    continue
                while at > 0 and strength[row, at - 1] < claim:
                    rivals[row, at], strength[row, at] = rivals[row, at - 1], strength[row, at - 1]
                    at -= 1
                rivals[row, at], strength[row, at] = rival, claim
        for k in range(count, most):
            rivals[row, k] = NONE


@kernel
def balls(
    first: int, last: int, graph: Graph, rivals: Int32Array, strength: FloatArray, max_bits: float, share: FloatArray
) -> None:
    """Write the posterior ``share`` of the pairs of rows first … last − 1 of a :data:`Graph`.

    Each row is summed exactly together with the rows that compete with it most, at most as many as ``rivals`` has
    columns, with at most ``max_bits`` of choices; other rows act by their messages.
    """
    ball = room_for(graph, rivals.shape[1])
    for center in range(first, last):
        low, high = graph.start[center], graph.start[center + 1]
        count = gather_rows(center, graph, rivals, strength, max_bits, ball)
        rows = gather_options(count, graph, ball)
        if not sum_ball(rows, ball, share[low:high]):
            from_messages(center, graph, share[low:high])
        for t in range(count):
            ball.inside[ball.row[t]] = False
            for e in range(graph.start[ball.row[t]], graph.start[ball.row[t] + 1]):
                ball.place[graph.column[e]] = UNKNOWN


@part
def room_for(graph: Graph, max_rows: int) -> Ball:
    """A workspace for balls of a graph."""
    longest = np.int64(0)
    for r in range(len(graph.none)):
        longest = max(longest, graph.start[r + 1] - graph.start[r])
    rows = max_rows + 2
    pairs = rows * (longest + 1)
    return Ball(
        np.empty(rows, np.int64),
        np.empty(rows, np.int64),
        np.zeros(len(graph.none), np.bool_),
        np.full(len(graph.free), UNKNOWN, np.int32),
        np.empty(pairs),
        np.empty(pairs, np.bool_),
        np.empty(pairs, np.bool_),
        np.empty(pairs),
        np.empty(pairs),
        np.empty(pairs),
        np.empty(rows, np.int64),
        np.empty(rows, np.int64),
        np.empty(pairs, np.int64),
        np.empty(pairs),
        np.empty(rows),
        np.empty(rows),
        np.empty(rows, np.int64),
        np.empty(rows, np.int64),
    )


@part
def gather_rows(
    center: int, graph: Graph, rivals: Int32Array, strength: FloatArray, max_bits: float, ball: Ball
) -> int:
    """List the rows of a ball, adding the strongest rival of any row inside; returns their number."""
    most = rivals.shape[1]
    count = np.int64(0)
    row = np.int64(center)
    bits = 0.0
    while True:
        bits += math.log2(1.0 + graph.start[row + 1] - graph.start[row])
        if count > 0 and bits > max_bits:
            break
        ball.row[count], ball.next[count] = row, 0
        ball.inside[row] = True
        count += 1
        if count == most:
            break
        strongest = 0.0
        for t in range(count):
            one, k = ball.row[t], ball.next[t]
            while k < most and rivals[one, k] != NONE and ball.inside[rivals[one, k]]:
                k += 1
            ball.next[t] = k
            if k < most and rivals[one, k] != NONE and strength[one, k] > strongest:
                row, strongest = np.int64(rivals[one, k]), strength[one, k]
        if strongest == 0.0:
            break
    return count


@part
def gather_options(count: int, graph: Graph, ball: Ball) -> int:
    """List the options of the rows of a ball: every pair of the center, of other rows those with shared columns.

    The last option of a row stands for all others. Weights of a row sum to 1. Returns the number of rows, at least 3.
    """
    columns, pairs = np.int64(0), np.int64(0)
    for t in range(count):
        row = ball.row[t]
        else_ = graph.none[row]
        low = pairs
        for e in range(graph.start[row], graph.start[row + 1]):
            c = graph.column[e]
            at = np.int64(ball.place[c])
            if at == UNKNOWN:
                at = columns
                columns += 1
                ball.place[c] = at
                unused, inside = graph.free[c], 0
                for p in range(graph.column_start[c], graph.column_start[c + 1]):
                    if ball.inside[graph.rival[p]]:
                        inside += 1
                    else:
                        unused += graph.rival_claim[p]
                ball.unused[at] = max(unused, TINY)
                ball.shared[at] = inside > 1
                ball.taken[at] = False
                ball.lost[at] = ball.weight_a[at] = ball.weight_b[at] = 0.0
            odds = graph.odds[e] / ball.unused[at]
            if t == 0 or ball.shared[at]:
                ball.column[pairs], ball.weight[pairs] = at, odds
                pairs += 1
            else:
                else_ += odds
        ball.column[pairs], ball.weight[pairs] = NONE, else_
        pairs += 1
        ball.first[t], ball.last[t] = low, pairs
        total = 0.0
        for k in range(low, pairs):
            total += ball.weight[k]
        for k in range(low, pairs):
            ball.weight[k] /= total
    # The two rows of most options come last, as they are summed together.
    for t in range(2, count):
        low, high = ball.first[t], ball.last[t]
        at = t
        while at > 1 and ball.last[at - 1] - ball.first[at - 1] > high - low:
            ball.first[at], ball.last[at] = ball.first[at - 1], ball.last[at - 1]
            at -= 1
        ball.first[at], ball.last[at] = low, high
    rows = count
    while rows < 3:
        ball.column[pairs], ball.weight[pairs] = NONE, 1.0
        ball.first[rows], ball.last[rows] = pairs, pairs + 1
        pairs += 1
        rows += 1
    for k in range(ball.first[rows - 2], ball.last[rows - 2] - 1):
        ball.weight_a[ball.column[k]] = ball.weight[k]
    for k in range(ball.first[rows - 1], ball.last[rows - 1] - 1):
        ball.weight_b[ball.column[k]] = ball.weight[k]
    return rows


@part
def sum_others(rows: int, ball: Ball) -> float:
    """Sum of the weights of all combinations of options, without conflict, of the rows except the center.

    ``lost`` of each column is increased by the part of the sum in which that column is taken.
    """
    depth, inner = np.int64(1), rows - 2
    ball.so_far[1], ball.option[1], ball.held[1], ball.total[1] = 1.0, ball.first[1], NONE, 0.0
    ball.total[0] = 0.0
    while depth > 0:
        if depth == inner:
            ball.total[depth] = sum_two(ball.so_far[depth], inner, ball)
        else:
            if ball.held[depth] != NONE:
                ball.taken[ball.held[depth]] = False
            k = ball.option[depth]
            while k < ball.last[depth] - 1 and ball.taken[ball.column[k]]:
                k += 1
            if k < ball.last[depth]:
                c = ball.column[k]
                ball.option[depth], ball.held[depth] = k + 1, c
                if c != NONE:
                    ball.taken[c] = True
                weight = ball.so_far[depth] * ball.weight[k]
                depth += 1
                ball.so_far[depth], ball.option[depth], ball.total[depth] = weight, ball.first[depth], 0.0
                ball.held[depth] = NONE
                continue
        total = ball.total[depth]
        depth -= 1
        ball.total[depth] += total
        if depth > 0 and ball.held[depth] != NONE:
            ball.lost[ball.held[depth]] += total
    return ball.total[0]


@inlined
def sum_two(weight: float, a: int, ball: Ball) -> float:
    """:func:`sum_others` for the last two rows, a and b, given the other rows: the product of their sums without the
    terms in which both take the same column.

    No difference loses digits: a row's largest weight is not subtracted, but the others are summed.
    """
    first_a, last_a, first_b, last_b = ball.first[a], ball.last[a] - 1, ball.first[a + 1], ball.last[a + 1] - 1
    at_a, top_a, rest_a = greatest(first_a, last_a, ball)
    at_b, top_b, rest_b = greatest(first_b, last_b, ball)
    all_a, all_b = rest_a + top_a, rest_b + top_b
    total = ball.weight[last_a] * all_b
    for k in range(first_a, last_a):
        c = ball.column[k]
        if not ball.taken[c]:
            part = ball.weight[k] * (rest_b if c == at_b else all_b - ball.weight_b[c])
            total += part
            ball.lost[c] += weight * part
    for k in range(first_b, last_b):
        c = ball.column[k]
        if not ball.taken[c]:
            ball.lost[c] += weight * ball.weight[k] * (rest_a if c == at_a else all_a - ball.weight_a[c])
    return weight * total


@inlined
def greatest(first: int, last: int, ball: Ball) -> tuple[int, float, float]:
    """Column (NONE for that at ``last``) and weight of a row's possible option of largest weight, and the sum of the
    other weights."""
    at, top, rest = np.int64(NONE), ball.weight[last], 0.0
    for k in range(first, last):
        if not ball.taken[ball.column[k]]:
            w = ball.weight[k]
            if w > top:
                rest += top
                top, at = w, ball.column[k]
            else:
                rest += w
    return at, top, rest


@part
def sum_ball(rows: int, ball: Ball, share: FloatArray) -> bool:
    """Write ``share`` of the center's pairs; False if the sum of its options underflows."""
    pairs = len(share)
    others = sum_others(rows, ball)
    alone = ball.weight[pairs] * others
    total = alone
    for k in range(pairs):
        share[k] = ball.weight[k] * (others - ball.lost[ball.column[k]])
        total += share[k]
    if not total > CANCELLED * others:
        # Nearly all columns of the center are taken by others: each option is summed separately, without a difference.
        total = alone
        for k in range(pairs):
            ball.taken[ball.column[k]] = True
            share[k] = ball.weight[k] * sum_others(rows, ball)
            ball.taken[ball.column[k]] = False
            total += share[k]
    if not total > LEAST:
        return False
    for k in range(pairs):
        share[k] /= total
    return True


@part
def from_messages(row: int, graph: Graph, share: FloatArray) -> None:
    """Write the posterior of one row from messages alone."""
    low = graph.start[row]
    total = graph.none[row]
    for k in range(len(share)):
        c = graph.column[low + k]
        unused = graph.free[c]
        for p in range(graph.column_start[c], graph.column_start[c + 1]):
            if graph.rival[p] != row:
                unused += graph.rival_claim[p]
        share[k] = graph.odds[low + k] / unused
        total += share[k]
    for k in range(len(share)):
        share[k] /= total
