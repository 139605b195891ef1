"""Compiled exact sums around each record, with messages for what lies beyond.

The *ball* of a row is that row, its center, and the rows that compete with it most. Claims from outside weigh on the
columns: with the odds of a pair divided by what the column counts when nobody inside takes it, a column that is left
counts 1, and one that a single row of the ball wants is no more than odds of that row to need none of the others.

What the rows but the center do is enumerated, but for two of them: these can do all that the one can, times all that
the other can, except where both take one column. With every sum goes the part of it in which a column is taken: the
rest of it is what is left to the center.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from sameas.arrays import FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import inlined, kernel, part

#: Odds are not divided by less: products of them over the rows of a ball stay finite.
TINY = 1e-30
#: Weaker claims call no row into a ball, unless the reduced odds of both pairs are a good part of those of the best
#: hypothesis: around a loop of pairs that hardly leave each other alone messages grow over-confident without bound.
WEAKEST, TIGHT = 1e-9, 1e-6
#: Where less than this share of the sums is left to the center, differences have lost digits.
CANCELLED = 1e-6
#: Where less than this is left, messages alone answer.
LEAST = 1e-200
UNKNOWN, NONE = -1, -1

#: A graph by rows: CSR starts; of the pairs the columns, the reduced odds, and those with which rows claim columns.
#: The same pairs by columns: CSR starts, rows, claims, reduced odds. Odds of rows and of columns to have no partner.
Graph = namedtuple("Graph", "start column odds claim column_start rival rival_claim rival_odds none free")
#: Room for a ball. Its rows, and the next rival of each. Of all rows whether they are inside, of all columns the number
#: in the ball. Of the ball's columns what each counts when nobody takes it, whether rows share it, whether one has
#: taken it, what is lost to the center by that, the weights that the last two rows give it. Options of the rows: where
#: they begin and end, columns, weights. By depth of the enumeration: the weight so far, the sum beyond, the next
#: option, the column held.
Ball = namedtuple(
    "Ball",
    "row next inside place unused shared taken lost weight_a weight_b first last column weight "
    "so_far total option held",
)


@kernel
def by_columns(
    columns: int, start: IntArray, column: Int32Array, claim: FloatArray, odds: FloatArray
) -> tuple[IntArray, Int32Array, FloatArray, FloatArray]:
    """The pairs of a graph by column and, within it, by row: CSR starts, rows (m,), claims (m,), reduced odds (m,)."""
    starts = np.zeros(columns + 1, np.int64)
    for e in range(len(column)):
        starts[column[e] + 1] += 1
    for c in range(columns):
        starts[c + 1] += starts[c]
    fill = starts[:-1].copy()
    rival, rival_claim, rival_odds = np.empty(len(column), np.int32), np.empty(len(column)), np.empty(len(column))
    for r in range(len(start) - 1):
        for e in range(start[r], start[r + 1]):
            at = fill[column[e]]
            fill[column[e]] += 1
            rival[at], rival_claim[at], rival_odds[at] = r, claim[e], odds[e]
    return starts, rival, rival_claim, rival_odds


@kernel
def rank_rivals(first: int, last: int, graph: Graph, rivals: Int32Array, strength: FloatArray) -> None:
    """Fill ``rivals`` (n1, k) with the k rows that compete with each of some rows most, NONE where there are fewer.

    strength (n1, k) : a rival's claim on a column counts for as much as the row itself can want that; claims that are
    next to nothing although duality lets them be count least.
    """
    most = rivals.shape[1]
    for row in range(first, last):
        found = np.int64(0)
        for e in range(graph.start[row], graph.start[row + 1]):
            wanted = min(graph.claim[e], 1.0)
            c = graph.column[e]
            for p in range(graph.column_start[c], graph.column_start[c + 1]):
                claim = min(graph.rival_claim[p], 1.0) * wanted
                rival = graph.rival[p]
                if claim <= WEAKEST:
                    tight = graph.rival_odds[p] * graph.odds[e]
                    claim = WEAKEST * tight if tight > TIGHT else 0.0
                if claim == 0.0 or rival == row or (found == most and claim <= strength[row, most - 1]):
                    continue
                at = np.int64(0)
                while at < found and rivals[row, at] != rival:
                    at += 1
                if at == found:
                    found = min(found + 1, most)
                    at = found - 1
                elif claim <= strength[row, at]:
                    continue
                while at > 0 and strength[row, at - 1] < claim:
                    rivals[row, at], strength[row, at] = rivals[row, at - 1], strength[row, at - 1]
                    at -= 1
                rivals[row, at], strength[row, at] = rival, claim
        for k in range(found, most):
            rivals[row, k] = NONE


@kernel
def balls(
    first: int,
    last: int,
    graph: Graph,
    rivals: Int32Array,
    strength: FloatArray,
    most_bits: float,
    share: FloatArray,
) -> None:
    """Posterior of the pairs of rows first … last − 1 of a :data:`Graph`.

    Each row is solved exactly together with the rows that compete with it most, up to as many as ``rivals`` has columns
    and ``most_bits`` of choices; what lies outside answers by its messages at the border.
    """
    ball = room_for(graph, rivals.shape[1])
    for center in range(first, last):
        low, high = graph.start[center], graph.start[center + 1]
        count = gather_rows(center, graph, rivals, strength, most_bits, ball)
        rows = gather_options(count, graph, ball)
        if not sum_ball(rows, ball, share[low:high]):
            from_messages(center, graph, share[low:high])
        for t in range(count):
            ball.inside[ball.row[t]] = False
            for e in range(graph.start[ball.row[t]], graph.start[ball.row[t] + 1]):
                ball.place[graph.column[e]] = UNKNOWN


@part
def room_for(graph: Graph, most_rows: int) -> Ball:
    """Room for balls of a graph."""
    longest = np.int64(0)
    for r in range(len(graph.none)):
        longest = max(longest, graph.start[r + 1] - graph.start[r])
    rows = most_rows + 2
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
    center: int, graph: Graph, rivals: Int32Array, strength: FloatArray, most_bits: float, ball: Ball
) -> int:
    """List the rows of a ball, always the strongest rival of one of those inside; returns their number."""
    most = rivals.shape[1]
    count = np.int64(0)
    row = np.int64(center)
    bits = 0.0
    while True:
        bits += math.log2(1.0 + graph.start[row + 1] - graph.start[row])
        if count > 0 and bits > most_bits:
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
    """List what the rows of a ball can do: of the center every pair, of others those with columns that are shared.

    The last entry of a row is all else. Weights of a row sum to 1. Returns the number of rows, at least three.
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
    # Two rows are summed at once: those that can do most.
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
    """Sum of the weights of all that the rows but the center can do without conflict.

    ``lost`` of each column grows by the part of it in which that column is taken.
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
    """The same for the last two rows, a and b, of what others leave: all that a can do times all that b can, except
    where both take one column.

    No difference loses digits: the greatest weight of a row is not subtracted, but left out.
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
    """Of what one row can do without conflict, all else at ``last``: the column of the greatest weight, NONE for all
    else, that weight, and the sum of the others."""
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
    """Fill ``share`` of the center's pairs; False where all that is left to it underflows."""
    pairs = len(share)
    every = sum_others(rows, ball)
    alone = ball.weight[pairs] * every
    total = alone
    for k in range(pairs):
        share[k] = ball.weight[k] * (every - ball.lost[ball.column[k]])
        total += share[k]
    if not total > CANCELLED * every:
        # Others want whatever the center wants: each of its options is summed by itself, without a difference.
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
    """The posterior of one row from its messages alone."""
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
