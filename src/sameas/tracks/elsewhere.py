"""Sentences on sources that are at another place or of another day than most others, before they are in one scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from sameas.arrays import FloatArray
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description
from sameas.tracks.unit_guesses import Source, place_guesses

#: Seconds of a day; below it, seconds count from an arbitrary start.
DAY_S, COUNTED_S = 86400.0, 1e8

APART_M = 900e3  # sources farther apart than this, and than either is wide, are not of one area
#: A guess of positions must bring a source to within this many extents of another, or metres.
NEAR_EXTENTS, NEAR_M = 3.0, 50e3


def too_far_apart(sources: Sequence[Source]) -> dict[str, str]:
    """By name, sentences on sources too far for one plane from that which is near most others.

    Sources of a continent are as far apart as they are wide. Of several that are near most others, that with the most
    positions counts, and the site of a sensor where its reports have no positions in degrees.
    """
    positions = [_geodetic_positions(*source) for source in sources]
    known = {k: position for k, position in enumerate(positions) if position is not None and len(position[0])}
    if not known:
        return {}
    middle = {k: LocalPlane.about(*position) for k, position in known.items()}
    extent_m = {k: float(np.quantile(middle[k].great_circle_m(*position), 0.9)) for k, position in known.items()}
    far = {
        k: [n for n, m in middle.items() if _apart_m(middle[k], m) > max(APART_M, extent_m[k], extent_m[n])]
        for k in known
    }
    home = min(known, key=lambda k: (len(far[k]), -len(known[k][0]), k))
    if not far[home]:
        return {}
    reach = max(NEAR_EXTENTS * extent_m[home], NEAR_M)
    return {sources[k][0].name: _far_sentence(sources[k], sources[home], reach) for k in far[home]}


def of_other_days(sources: Sequence[Source]) -> dict[str, str]:
    """By name, sentences on sources whose reports are days from those of most others: a picture has one time.

    Most are the most sources without a pause of a day between them, and of several such, those with most reports. The
    pause to the others is longer than all of these last.
    """
    spans = sorted((float(r.time_s.min()), float(r.time_s.max()), d.name, len(r)) for d, r in sources if len(r))
    sessions: list[list[tuple[float, float, str, int]]] = []
    last_s = -math.inf
    for span in spans:
        if span[0] - last_s > DAY_S:
            sessions.append([])
        sessions[-1].append(span)
        last_s = max(last_s, span[1])
    if len(sessions) < 2:
        return {}
    home = max(sessions, key=lambda session: (len(session), sum(span[3] for span in session)))
    first_s, last_s = home[0][0], max(span[1] for span in home)
    theirs = " to ".join(span_of(np.array([first_s, last_s])))
    return {
        name: f"{name}: its reports are of {' to '.join(span_of(np.array([first, last])))}, days from those of others, "
        f"{theirs}; check its clock and its date"
        for session in sessions if session is not home
        for first, last, name, _ in session
        if max(first_s - last, first - last_s) > last_s - first_s
    }  # fmt: skip


def _far_sentence(source: Source, home: Source, reach_m: float) -> str:
    """The sentence on a source beyond the plane of another, ``home``; reach_m : radius of the positions of that one."""
    positions, home_positions = _geodetic_positions(*source), _geodetic_positions(*home)
    assert positions is not None and home_positions is not None
    distance_m = _apart_m(LocalPlane.about(*home_positions), LocalPlane.about(*positions))
    opening = f"{source[0].name}: lies {distance_m / 1e3:.0f} km from {home[0].name}, too far for one plane"
    # Wrong columns are tried first: they are more frequent than wrong sites.
    pairs = sorted([(source, home), (home, source)], key=lambda pair: pair[0][1].lat_deg is None)
    explanations = [one for pair in pairs if (one := _explanation(*pair, reach_m))]
    if len(explanations) == 2:
        return f"{opening}; {'; or '.join(explanations)}"
    if explanations:
        wrong = home if explanations[0].startswith(f"{source[0].name}: ") else source
        return f"{opening}; {explanations[0]}, unless it is {wrong[0].name} that is wrong"
    return f"{opening}; check the sign and the order of its coordinates, or make a picture of one of the two areas"


def _explanation(source: Source, other: Source, reach_m: float) -> str:
    """The mistake in a source that would explain its distance from another one, and its remedy; "" if there is none."""
    name, positions = source[0].name, _geodetic_positions(*other)
    assert positions is not None
    for guess in place_guesses(source[1]):
        changed = guess.read(*source)
        corrected = None if changed is None else _geodetic_positions(*changed)
        if corrected is None:
            continue
        inside = int(np.sum(LocalPlane.about(*positions).great_circle_m(*corrected) < reach_m))
        if 2 * inside > len(corrected[0]):
            what = "its site lies" if source[1].lat_deg is None else f"{inside} of {len(corrected[0])} positions lie"
            where = f"{what} where {other[0].name} is"
            return f"{name}: its {guess.suspicion}: with {guess.changed}, {where}; {guess.remedy}"
    return ""


def _geodetic_positions(description: Description, reports: Reports) -> tuple[FloatArray, FloatArray] | None:
    """Latitudes and longitudes of the positions, or of the sensor; None if none are given in degrees."""
    for lat, lon in ((reports.lat_deg, reports.lon_deg), (reports.station_lat_deg, reports.station_lon_deg)):
        if lat is not None and lon is not None:
            is_known = np.isfinite(lat) & np.isfinite(lon)
            return (lat[is_known], lon[is_known]) if is_known.any() else None
    site = description.site
    if site is None or site.lat_deg is None or site.lon_deg is None:
        return None
    return np.array([site.lat_deg]), np.array([site.lon_deg])


def _apart_m(first: LocalPlane, second: LocalPlane) -> float:
    """The great-circle distance between the origins of two planes."""
    return float(first.great_circle_m([second.lat_deg], [second.lon_deg])[0])


def span_of(time_s: FloatArray) -> tuple[str, str]:
    """The first and the last time: in UTC, or in seconds if below COUNTED_S, which count from an arbitrary start."""
    first, last = float(np.min(time_s)), float(np.max(time_s))
    if abs(last) < COUNTED_S:
        return f"{first:.0f} s", f"{last:.0f} s"
    dates = [datetime.fromtimestamp(t, UTC).strftime("%Y-%m-%d %H:%M:%S") for t in (first, last)]
    return dates[0], dates[1]
