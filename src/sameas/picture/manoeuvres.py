"""Manoeuvres: reports whose objects have changed their velocity since, as far as the other sources show it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, taken, taken_plane
from sameas.gaussian import LOG_2PI, log_density
from sameas.kernels.tracks import places_of
from sameas.picture.error_correlation import MANOEUVRE_CHI_SQ
from sameas.picture.id_swaps import Rivals, group_maximum
from sameas.picture.tables import Scan, distances
from sameas.picture.track_pairs import TrackPairs
from sameas.tracks.stationary import REST_S

MANOEUVRE_EVERY_S = 600.0  # mean time between two manoeuvres of an object
PARTNER_ODDS = 20.0  # two tracks may be partners unless their positions make chance this many times more probable


def with_manoeuvres(
    scan: Scan,
    track_of_record: IntArray,
    previous: Scan | None,
    track_pairs: TrackPairs,
    log_ratio: FloatArray,
    per_m2: float,
    swap_rate: FloatArray,
    together: Callable[[IntArray, IntArray], BoolArray],
) -> Scan:
    """The scan with larger covariances for reports whose objects have manoeuvred since.

    A report is moved to the instant by a random walk of its velocity, which fits nearly all motion. But a ferry that
    stops at a pier is 6σ from her prediction within a minute; by the normal distribution her AIS report from before the
    stop then matches no object, whatever its history with the radar's track. So a report of a named track may be
    followed by a manoeuvre, on average one every ``MANOEUVRE_EVERY_S``, and of a stationary object one every
    ``rest_s``: at an unknown time since the report, the velocity v changed to that of any object, 0 ± s per axis, which
    adds the covariance

        D = (s² I + v vᵀ) ⊗ [t²/3, t/2; t/2, 1],   t the report's age.

    A manoeuvre is assumed where the report's partners, one track of each other source, are jointly more probable with D
    than without by more than the prior odds against a manoeuvre, and no rival explains their reports without one.
    Tracks that never were one object need none: without a manoeuvre, they are as probable as two objects by chance. A
    rival that only passes does not: its own partner is where it should be. An assumed manoeuvre stays in the past of
    its report until the partners favour the prediction again. A radar too coarse to resolve the manoeuvre does not
    outvote one that does. The position stays as reported; only the covariance grows, for evidence, memory and fused
    states alike.

    track_of_record : (n,) numbers of the records' tracks, ABSENT for new ones. previous : the scan of the previous
    instant. track_pairs, log_ratio : its pairs, and (k,) their ln r. swap_rate : (S,) h of the scan's sources, 0 for
    new ones.
    together : gives of numbers of tracks, (n,) and (n,), whether each two were one object before.
    """
    assumed = _assumed_before(scan, previous)
    log_limit = math.log(per_m2) - math.log(PARTNER_ODDS)
    near = np.flatnonzero(log_ratio + track_pairs.log_now >= log_limit)
    a, b = _places(track_of_record, np.stack([track_pairs.first[near], track_pairs.second[near]]))
    present = (a >= 0) & (b >= 0)
    a, b, log_ratio = a[present], b[present], log_ratio[near[present]]
    if not len(a):
        return _with_manoeuvres_of(scan, assumed)
    chi_sq, determinant = distances(scan.state, scan.covariance, a, b)
    log_steady = -0.5 * (chi_sq + np.log(determinant) + 2.0 * LOG_2PI)
    log_odds = _log_manoeuvre_odds(scan)
    log_pair_steady = log_ratio + log_steady
    # Either of the two may have manoeuvred.
    own, other, k = np.append(a, b), np.append(b, a), np.tile(np.arange(len(a)), 2)
    # No covariance raises ln p by more than χ²/2, which excludes most records early.
    has_partner = np.bincount(own, minlength=len(scan)) > 0
    possible = np.bincount(own, 0.5 * chi_sq[k], len(scan)) + log_odds > 0.0
    assumed &= possible | ~has_partner
    own, other, k = own[possible[own]], other[possible[own]], k[possible[own]]
    if not len(own):
        return _with_manoeuvres_of(scan, assumed)
    log_apart = np.where(together(track_of_record[own], track_of_record[other]), -np.inf, math.log(per_m2))
    rivals = Rivals.of(a, b, scan.source[a], scan.source[b])
    # Where a swap of ids is more probable than a manoeuvre, a rival may have the history of its better pair.
    free = rivals.most_free(log_pair_steady, chi_sq <= MANOEUVRE_CHI_SQ)
    is_swap = np.exp(log_odds[own]) < swap_rate[scan.source[other]]
    best = np.maximum(np.where(is_swap, rivals.most(log_pair_steady)[k], free[k]), log_apart)
    delta = (taken(scan.state, own) - taken(scan.state, other))[:, :2]
    total = taken_plane(scan.covariance, own) + taken_plane(scan.covariance, other)
    age_s, change = _velocity_changes(scan, own)
    total += change * (age_s**2 / 3.0)[:, None, None]
    log_with_d = log_density(delta, total)
    log_pair_with_d = log_odds[own] + log_ratio[k] + log_with_d
    log_pair = np.maximum(log_pair_steady[k], log_pair_with_d)
    is_partner = log_pair == group_maximum(own * len(scan.start) + scan.source[other], log_pair)
    gain = log_ratio[k] + log_with_d - np.maximum(log_pair_steady[k], log_apart)
    log_manoeuvre = np.bincount(own[is_partner], gain[is_partner], len(scan)) + log_odds
    assumed &= (log_manoeuvre > 0.0) | ~has_partner
    # No rival explains the other record without a manoeuvre, and the partners of all sources jointly favour one.
    assumed[own[(log_pair_with_d > best) & (log_manoeuvre[own] > 0.0)]] = True
    return _with_manoeuvres_of(scan, assumed)


def _log_manoeuvre_odds(scan: Scan) -> FloatArray:
    """(n,) ln of the prior odds of a manoeuvre since each report."""
    age = np.maximum(scan.now.instant_s - scan.time_s, 0.0)
    rest_s = np.array([REST_S for feed in scan.now.feeds])[scan.source]
    since = [-np.expm1(-age / every_s) for every_s in (MANOEUVRE_EVERY_S, rest_s)]
    p = (1.0 - scan.p_stationary) * since[0] + scan.p_stationary * since[1]
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(p) - np.log1p(-p))


def _assumed_before(scan: Scan, previous: Scan | None) -> BoolArray:
    """(n,) whether a manoeuvre since the same report was assumed in the previous scan."""
    out = np.zeros(len(scan), bool)
    if previous is None:
        return out
    assumed = previous.manoeuvre_covariance[:, 0, 0] > 0.0
    names = [description.name for description in previous.now.descriptions]
    for s, description in enumerate(scan.now.descriptions):
        if assumed.any() and description.name in names:
            t = names.index(description.name)
            before = np.arange(previous.start[t], previous.start[t + 1])
            before, records = before[assumed[before]], slice(scan.start[s], scan.start[s + 1])
            out[records] = np.isin(scan.row[records], previous.row[before])
    return out


def _with_manoeuvres_of(scan: Scan, manoeuvred: BoolArray) -> Scan:
    """The scan with D added to the covariances of the records (n,) whose objects have manoeuvred."""
    if not manoeuvred.any():
        return scan
    extra, records = np.zeros((len(scan), 4, 4)), np.flatnonzero(manoeuvred)
    extra[records] = manoeuvre_covariance(scan, records)
    return replace(scan.with_covariance(extra), manoeuvre_covariance=extra)


def manoeuvre_covariance(scan: Scan, records: IntArray) -> FloatArray:
    """(k, 4, 4) D of records (k,); 0 where the speed of its objects is unknown."""
    age_s, change = _velocity_changes(scan, records)
    out = np.zeros((len(records), 4, 4))
    out[:, :2, :2] = change * (age_s**2 / 3.0)[:, None, None]
    out[:, :2, 2:] = out[:, 2:, :2] = change * (age_s / 2.0)[:, None, None]
    out[:, 2:, 2:] = change
    return out


def _velocity_changes(scan: Scan, records: IntArray) -> tuple[FloatArray, FloatArray]:
    """(k,) t and (k, 2, 2) s² I + v vᵀ of records (k,)."""
    age_s = np.maximum(scan.now.instant_s - scan.time_s[records], 0.0)
    speed = scan.speed_m_per_s[records]
    speed = np.where(np.isfinite(speed), speed, 0.0)
    v = np.where(scan.moving[records, None], taken(scan.state, records)[:, 2:], 0.0)
    change = v[:, :, None] * v[:, None, :] + speed[:, None, None] ** 2 * np.eye(2)
    change[speed == 0.0] = 0.0
    return age_s, change


def _places(track_of_record: IntArray, number: IntArray) -> IntArray:
    """(…) the record of each track in a scan, ABSENT without one; track_of_record : (n,) of that scan."""
    order = np.argsort(track_of_record)
    at = places_of(track_of_record[order], number)
    return np.where(at >= 0, np.append(order, ABSENT)[at], ABSENT)
