"""Tracks from a source's plots: a Kalman filter of nearly constant velocity, over all of its tracks at once.

For sources with track ids that report bare positions, or positions better than their velocities: AIS, ADS-B, a radar's
plots with track numbers. One pass in the order of time gives every report the state by all reports of its track so
far, with a covariance that is checked by NIS: the mean of the normalised innovations squared is their dimension where
noise and motion are described rightly.

- :func:`follow`: the tracks. :func:`measures_anew`: whether reports are plots, which it betters, or smoothed already.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.gate import ChiSquare
from sameas.gaussian import Gaussian, mahalanobis_sq
from sameas.ragged import Ragged
from sameas.tracks.alignment import States, moved
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning

#: Median of χ² of two degrees of freedom.
MEDIAN = 2.0 * math.log(2.0)


@dataclass(frozen=True)
class FilteredTracks:
    """What the filter made of a source's reports.

    Attributes
    ----------
    states : the reports with the state of their track after each of them.
    nis : (n,) normalised innovation squared of every report; NaN where it began a track.
    began : (n,) whether the report began a track: its first, or one so far off that the id must have gone to another
        object, or the object moved as its motion does not allow.
    """

    states: States
    nis: FloatArray
    began: BoolArray


def follow(
    reports: States, *, acceleration_m2_per_s3: float, features: int = 2, tuning: Tuning = DEFAULT_TUNING
) -> FilteredTracks:
    """The track state after every report of a source with track ids.

    Parameters
    ----------
    reports : in any order of time; a report of a time already passed by its track is filtered in its place.
    acceleration_m2_per_s3 : power density of the velocity's random walk.
    features : 2 measures positions only, the velocity that a report states serving where its track begins; 4 measures
        both, for sources whose velocities are measured on their own (Doppler).

    Source: METHOD 1 (prediction); Bar-Shalom, Li and Kirubarajan 2001, sections 5.2 and 6.2.
    """
    if reports.track is None:
        raise InputError("follow: reports name no tracks; give the source's own track numbers or identities")
    if features not in (2, 4):
        raise InputError(f"follow: features is {features}; give 2 (positions) or 4 (positions and velocities)")
    usable = reports.usable
    state, covariance = reports.state.copy(), reports.covariance.copy()
    nis, began = np.full(len(reports), np.nan), np.zeros(len(reports), bool)
    limit = ChiSquare(1.0 - tuning.new_track_probability).limit(features)
    before = np.empty(0, np.int64)
    for now in _rounds(reports, usable):
        if not len(before):
            began[now] = True
            before = now
            continue
        before = before[: len(now)]
        dt = reports.time_s[now] - reports.time_s[before]
        ahead, spread = moved(state[before], covariance[before], dt, acceleration_m2_per_s3)
        innovation = reports.state[now, :features] - ahead[:, :features]
        total = spread[:, :features, :features] + reports.covariance[now, :features, :features]
        after = Gaussian(ahead, spread).updated(
            Gaussian(reports.state[now, :features], reports.covariance[now, :features, :features])
        )
        square = mahalanobis_sq(innovation, total)
        anew = square > limit
        keep = now[~anew]
        state[keep], covariance[keep] = after.mean[~anew], after.covariance[~anew]
        nis[keep], began[now[anew]] = square[~anew], True
        before = now
    return FilteredTracks(States(reports.time_s, state, covariance, reports.track, reports.rows), nis, began)


def measures_anew(reports: States, *, acceleration_m2_per_s3: float, tuning: Tuning = DEFAULT_TUNING) -> bool:
    """Whether every report of a source with track ids is an independent measurement, or smoothed by a tracker.

    Measurements scatter about their tracks by as much as they state, and the innovations of a filter are χ² distributed
    with two degrees of freedom; the reports of a tracker follow each other more closely than their errors allow them.
    The median decides, which a few breaks of tracks do not change. False with too few reports.
    """
    nis = follow(reports, acceleration_m2_per_s3=acceleration_m2_per_s3, tuning=tuning).nis
    nis = nis[np.isfinite(nis)]
    return len(nis) >= tuning.measured_fewest and float(np.median(nis)) > tuning.measured_ratio * MEDIAN


def _rounds(reports: States, usable: BoolArray) -> list[IntArray]:
    """The first report of every track, then the second, …: tracks with more reports stand first in every round."""
    rows = np.flatnonzero(usable)
    assert reports.track is not None
    _, number = np.unique(reports.track[rows].astype(str), return_inverse=True)
    count = np.bincount(number)
    # Tracks by their number of reports, most first, so that those of a round are the first of the one before.
    rank = np.empty(len(count), np.int64)
    rank[np.argsort(-count, kind="stable")] = np.arange(len(count))
    order = np.lexsort([reports.time_s[rows], rank[number]])
    rows, owner = rows[order], rank[number][order]
    turn = Ragged.of_sorted(owner, len(count)).index
    by_turn = np.lexsort([owner, turn])
    cuts = Ragged.of_sorted(turn[by_turn], int(count.max(initial=0))).start
    return [rows[by_turn[a:b]] for a, b in pairwise(cuts)]
