"""Doubts: in words, what looks wrong with a source as a whole.

A longitude of the wrong sign, kilometres for metres, a clock in another zone: such a source shares nothing with the
others as it stands, and much when it is read in another way. The other ways (:mod:`sameas.tracks.readings`) are tried
only where a source makes no sense, and only to say which of them would: data are never changed.

- :func:`doubts`: of the sources of a scene. :func:`apart`: of sources that lie too far apart for any scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from sameas.errors import InputError
from sameas.records import FloatArray
from sameas.registration.weights import weigh
from sameas.tracks.alignment import States
from sameas.tracks.biases import TIME
from sameas.tracks.coordinates import EARTH_M, FARTHEST_M, LocalPlane
from sameas.tracks.encounters import Side, encounters, looked_for
from sameas.tracks.feed import Feed
from sameas.tracks.readings import Source, clock_readings, readings, readings_of_place
from sameas.tracks.registration import unbiased
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description

#: Instants at which sources are compared, and rounds in which the number of common objects settles.
INSTANTS, ROUNDS = 5, 8
#: A source whose records have partners at most so often shares nothing; another reading must give so many.
NOTHING, MUCH = 0.1, 0.5
#: The other reading must explain the records better by this log likelihood at an instant: some thirty are tried.
CLEARLY = 8.0
#: A reading of places brings a source to another where its middle comes so near, in the other's extents, and in metres.
EXTENTS, NEAR_M = 3.0, 50e3


@dataclass(frozen=True)
class Shared:
    """What two sources share at an instant, on average: pairs, of so many records of the first; the log likelihood."""

    other: str
    pairs: float
    records: float
    gain: float

    @property
    def share(self) -> float:
        """Part of the records that have a partner, of those that could."""
        return self.pairs / max(self.records, 1e-9)


def doubts(feeds: Sequence[Feed], plane: LocalPlane | None) -> tuple[str, ...]:
    """One sentence for each source that looks wrong as a whole; see :meth:`sameas.tracks.scene.Scene.doubts`."""
    tolerant = [_tolerant(feed) for feed in feeds]
    others = [
        _comparable(feed, [other for other in tolerant if other.description != feed.description]) for feed in feeds
    ]
    stands = [_best(feed, partners) for feed, partners in zip(tolerant, others, strict=True)]
    read = [
        _other_reading(feed, partners, stood, plane) if partners and (stood is None or stood.share < MUCH) else None
        for feed, partners, stood in zip(feeds, others, stands, strict=True)
    ]
    said: dict[str, str] = {}
    for feed, reading in zip(feeds, read, strict=True):
        # Of two that contradict each other one sentence is enough.
        if reading is not None and reading.other not in said:
            said[feed.description.name] = reading.sentence
    named = {reading.other for reading in read if reading is not None}
    for feed, partners, stood in zip(feeds, others, stands, strict=True):
        name = feed.description.name
        shares = stood is not None and stood.share > NOTHING and stood.gain > 0.0
        accused = all(other.description.name in said for other in partners)
        if not (shares or name in said or name in named or accused):
            said[name] = _nothing_shared(feed, partners, stood)
    return tuple(said[feed.description.name] for feed in feeds if feed.description.name in said)


def _comparable(feed: Feed, others: Sequence[Feed]) -> list[Feed]:
    """Those of the others that have reports which can be compared: a direction with a direction cannot."""
    own = isinstance(feed.reports, States)
    return [o for o in others if len(feed.reports) and len(o.reports) and (own or isinstance(o.reports, States))]


def apart(sources: Sequence[Source]) -> tuple[str, ...]:
    """Sentences for sources too far from the one of most positions to be in one plane with it; none where all are near.

    Sensors without positions of their own stand for theirs.
    """
    places = [_places(*source) for source in sources]
    counts = [0 if p is None else len(p[0]) for p in places]
    if not counts or not max(counts):
        return ()
    most = int(np.argmax(counts))
    home = places[most]
    assert home is not None
    middle = LocalPlane.about(*home)
    reach = max(EXTENTS * float(np.quantile(_distance_m(middle, home), 0.9)), NEAR_M)
    said = []
    for k, place in enumerate(places):
        if place is not None and k != most and _typical_m(middle, place) > FARTHEST_M:
            said.append(_far(sources[k], sources[most], reach))
    return tuple(said)


def _far(source: Source, home: Source, reach_m: float) -> str:
    """What to say of a source that lies beyond the plane of another, ``home``, whose positions reach so far."""
    far, near = _places(*source), _places(*home)
    assert far is not None and near is not None
    away = _typical_m(LocalPlane.about(*near), far)
    opening = f"{source[0].name}: lies {away / 1e3:.0f} km from {home[0].name}, too far for one plane"
    # Columns are mixed up more often than sites are.
    for one, other in sorted([(source, home), (home, source)], key=lambda pair: pair[0][1].lat_deg is None):
        for reading in readings_of_place(one[1]):
            changed = reading.read(*one)
            moved, there = None if changed is None else _places(*changed), _places(*other)
            if moved is None or there is None:
                continue
            inside = int(np.sum(_distance_m(LocalPlane.about(*there), moved) < reach_m))
            if 2 * inside > len(moved[0]):
                what = "its site lies" if one[1].lat_deg is None else f"{inside} of {len(moved[0])} positions lie"
                return (
                    f"{opening}; {one[0].name}: its {reading.suspicion}: with {reading.changed}, {what} where "
                    f"{other[0].name} is; {reading.remedy}, unless it is {other[0].name} that is wrong"
                )
    return f"{opening}; check the sign and the order of its coordinates, or make a picture of one of the two areas"


def _places(description: Description, reports: Reports) -> tuple[FloatArray, FloatArray] | None:
    """Latitudes and longitudes of the positions, or of the sensor; None where no degrees are given."""
    for lat, lon in ((reports.lat_deg, reports.lon_deg), (reports.station_lat_deg, reports.station_lon_deg)):
        if lat is not None and lon is not None:
            known = np.isfinite(lat) & np.isfinite(lon)
            return (lat[known], lon[known]) if known.any() else None
    site = description.site
    if site is None or site.lat_deg is None or site.lon_deg is None:
        return None
    return np.array([site.lat_deg]), np.array([site.lon_deg])


def _distance_m(middle: LocalPlane, place: tuple[FloatArray, FloatArray]) -> FloatArray:
    """(n,) along the surface, near enough."""
    phi, lam = np.radians(place[0]), np.radians(place[1] - middle.lon_deg)
    start = np.radians(middle.lat_deg)
    half = np.sin((phi - start) / 2.0) ** 2 + np.cos(phi) * np.cos(start) * np.sin(lam / 2.0) ** 2
    return np.asarray(2.0 * EARTH_M * np.arcsin(np.sqrt(np.clip(half, 0.0, 1.0))))


def _typical_m(middle: LocalPlane, place: tuple[FloatArray, FloatArray]) -> float:
    return float(np.median(_distance_m(middle, place)))


def _tolerant(feed: Feed) -> Feed:
    """The feed with covariances that allow for the biases that it may have."""
    widths = looked_for(feed)
    return unbiased(feed, np.zeros(len(widths)), np.diag(widths**2)) if widths.any() else feed


def _best(feed: Feed, others: Sequence[Feed]) -> Shared | None:
    """What the source shares with the one with which it shares most; None where it meets none."""
    found = [shared for other in others if (shared := _shared(feed, other)) is not None]
    return max(found, key=lambda shared: shared.gain) if found else None


def _shared(feed: Feed, other: Feed) -> Shared | None:
    met = encounters(Side(other, None), Side(feed, None), INSTANTS)
    if not met:
        return None
    pairs = records = gain = 0.0
    for encounter in met:
        weighing = encounter.weighing
        none = np.zeros((1, len(encounter.biases)))
        common = np.array([0.5 * min(len(weighing.first), len(weighing.second))])
        for _ in range(ROUNDS):
            found = weigh(weighing, none, common, 1.0)
            common = found.common
        pairs, gain = pairs + float(common[0]), gain + float(found.gain[0])
        records += min(len(weighing.first), len(weighing.second))
    count = len(met)
    return Shared(other.description.name, pairs / count, records / count, gain / count)


@dataclass(frozen=True)
class Found:
    """A reading that makes much of a source: in words, what it shares then with which other, and how well."""

    sentence: str
    other: str
    gain: float


def _other_reading(feed: Feed, others: Sequence[Feed], stands: Shared | None, plane: LocalPlane | None) -> Found | None:
    """The reading that makes most of the source; None where none makes much of it."""
    stood = Shared("", 0.0, 0.0, 0.0) if stands is None else stands
    best: Found | None = None
    for suspicion, changed, remedy, read in _read_otherwise(feed, plane):
        shared = _best(read, others)
        if shared is None or shared.share < max(MUCH, 2.0 * stood.share):
            continue
        if shared.gain > (max(stood.gain, 0.0) + CLEARLY if best is None else best.gain):
            either = f", unless it is {shared.other} that is wrong" if len(others) == 1 else ""
            sentence = (
                f"{feed.description.name}: its {suspicion}: with {changed}, {shared.pairs:.0f} of {shared.records:.0f} "
                f"records of an instant are those of {shared.other}, as it stands {stood.pairs:.0f}; {remedy}{either}"
            )
            best = Found(sentence, shared.other, shared.gain)
    return best


def _read_otherwise(feed: Feed, plane: LocalPlane | None) -> Iterator[tuple[str, str, str, Feed]]:
    """Suspicion, change, remedy, and the feed that would result."""
    if feed.given is not None:
        for reading in readings(feed.given):
            source = reading.read(feed.description, feed.given)
            if source is None:
                continue
            try:
                changed = Feed.of(*source, plane)
            except InputError:
                continue
            yield reading.suspicion, reading.changed, reading.remedy, _tolerant(changed)
    tolerant = _tolerant(feed)
    for suspicion, remedy, ahead_s in clock_readings():
        biases = np.zeros(6)
        biases[TIME] = ahead_s
        yield suspicion, "that taken off", remedy, unbiased(tolerant, biases, np.zeros((6, 6)))


def _nothing_shared(feed: Feed, others: Sequence[Feed], best: Shared | None) -> str:
    name = feed.description.name
    if best is not None:
        return (
            f"{name}: has no more in common with the others than chance: {best.pairs:.0f} of {best.records:.0f} "
            f"records of an instant can be those of {best.other}; check its position, clock and errors, or leave it out"
        )
    own, theirs = _span(feed.reports.time_s), _span(np.concatenate([other.reports.time_s for other in others]))
    return (
        f"{name}: says nothing while others do: it speaks from {own[0]} to {own[1]}, they from {theirs[0]} to "
        f"{theirs[1]}; check its clock and its date, or leave it out"
    )


def _span(time_s: FloatArray) -> tuple[str, str]:
    """The first and the last time: UTC, or seconds where they count from a start of their own."""
    first, last = float(np.min(time_s)), float(np.max(time_s))
    if abs(last) < 1e8:
        return f"{first:.0f} s", f"{last:.0f} s"
    dates = [datetime.fromtimestamp(t, UTC).strftime("%Y-%m-%d %H:%M:%S") for t in (first, last)]
    return dates[0], dates[1]
