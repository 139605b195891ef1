"""Manoeuvres: reports that their object has left behind by moving as its report did not foretell.

A report is moved to the instant by a random walk of its velocity, which is how objects move nearly always. A ferry that
stops at a pier leaves it by six of its σ within a minute, and her AIS of before the stop is of nobody, by the normal
law, however long the radar's track has gone with it. So each report of a named track may be followed by a manoeuvre,
:data:`EVERY_S` apart on average: at an unknown moment since, its velocity v became that of any object, 0 ± s per axis,
and leaves open

    D = (s² I + v vᵀ) ⊗ [t²/3, t/2; t/2, 1],   t the report's age.

Which report was followed by one is told by the tracks of other sources that have been with it so far, one of each
source: where they together are more probable with D than without, by more than the odds against a manoeuvre. A radar
that is too coarse to see it does not outvote one that does. Its position stays what its source said;
only its covariance grows, and evidence, memory and fused states find it as uncertain as it is.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sameas.observations import Source
from sameas.picture.couples import Couples, Rivals
from sameas.picture.named import NamedTracks, found_in
from sameas.picture.roll import Roll
from sameas.picture.weighing import log_normal
from sameas.records import FloatArray, IntArray, Records

#: Between two manoeuvres of an object, on average. Taken.
EVERY_S = 600.0
#: A track may be another's although so much less probable, in ln r, than a stranger by their places alone: that sources
#: would have missed both speaks for it, too.
TOGETHER = math.log(20.0)


def loosened(roll: Roll, tracks: NamedTracks, couples: Couples, said: FloatArray, per_m2: float) -> Roll:
    """The roll with the covariances of reports that their objects have left behind.

    tracks, couples : of the instant before. said : (k,) ln r of the couples then.
    """
    a, b = (_places(roll, tracks, number) for number in (couples.first, couples.second))
    there = (a >= 0) & (b >= 0) & (said + couples.now >= math.log(per_m2) - TOGETHER)
    a, b, said = a[there], b[there], said[there]
    if not len(a):
        return roll
    open_ = left_open(roll)
    delta, spread = roll.state[a, :2] - roll.state[b, :2], roll.covariance[a, :2, :2] + roll.covariance[b, :2, :2]
    usual, _ = log_normal(delta, spread)
    with np.errstate(divide="ignore"):
        # ln of the odds that there was a manoeuvre since the report.
        log_odds = np.log(np.expm1(np.maximum(roll.now.instant_s - roll.time_s, 0.0) / EVERY_S))
    foretold = said + usual
    best = Rivals.of(a, b, roll.source[a], roll.source[b]).most(foretold)
    # Either of the two may be the one that was left behind.
    own, other, k = np.append(a, b), np.append(b, a), np.tile(np.arange(len(a)), 2)
    moved, _ = log_normal(delta[k], spread[k] + open_[own, :2, :2])
    gone = log_odds[own] + said[k] + moved
    likely = np.maximum(foretold[k], gone)
    partner = likely == _most(own * len(roll.start) + roll.source[other], likely)
    told = np.bincount(own[partner], (moved - usual[k])[partner], len(roll)) + log_odds
    left = np.zeros(len(roll), bool)
    # No rival explains the other without a manoeuvre, and its partners in all sources together say that there was one.
    left[own[(gone > best[k]) & (told[own] > 0.0)]] = True
    return _with(roll, np.where(left[:, None, None], open_, 0.0)) if left.any() else roll


def left_open(roll: Roll) -> FloatArray:
    """(n, 4, 4) D of every record; 0 where nothing is known of how fast its objects are."""
    age = np.maximum(roll.now.instant_s - roll.time_s, 0.0)
    speed = np.where(np.isfinite(roll.speed_m_per_s), roll.speed_m_per_s, 0.0)
    v = np.where(roll.moving[:, None], roll.state[:, 2:], 0.0)
    change = np.einsum("nv,nw->nvw", v, v) + speed[:, None, None] ** 2 * np.eye(2)
    change[speed == 0.0] = 0.0
    out = np.zeros((len(roll), 4, 4))
    out[:, :2, :2] = change * (age**2 / 3.0)[:, None, None]
    out[:, :2, 2:] = out[:, 2:, :2] = change * (age / 2.0)[:, None, None]
    out[:, 2:, 2:] = change
    return out


def _places(roll: Roll, tracks: NamedTracks, number: IntArray) -> IntArray:
    """(k,) where tracks stand on a new roll, −1 for those that do not."""
    on = tracks.numbers_on(roll)
    order = np.argsort(on, kind="stable")
    at = found_in(on[order], number)
    return np.where(at >= 0, np.append(order, -1)[at], -1)


def _with(roll: Roll, more: FloatArray) -> Roll:
    """The roll with covariances that are larger by ``more`` (n, 4, 4)."""
    sources = list(roll.now.sources)
    for s, source in enumerate(sources):
        here = slice(roll.start[s], roll.start[s + 1])
        sources[s] = _grown(source, roll.table[here], more[here])
    now = replace(roll.now, sources=tuple(sources))
    return replace(roll, now=now, covariance=roll.covariance + more, loose=more)


def _grown(source: Source, table: IntArray, more: FloatArray) -> Source:
    """A source's records with larger covariances; ``table`` their rows, ascending."""
    if not isinstance(source, Records) or not more.any():
        return source
    d = source.d
    covariance = source.full_covariance() + more[np.searchsorted(table, source.rows), :d, :d]
    upper = np.triu_indices(d)
    return replace(source, covariance=covariance[:, upper[0], upper[1]])


def _most(crowd: IntArray, values: FloatArray) -> FloatArray:
    """(k,) the highest value in the crowd of each."""
    best = np.full(int(crowd.max(initial=-1)) + 1, -np.inf)
    np.maximum.at(best, crowd, values)
    return best[crowd]
