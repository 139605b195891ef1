"""Doubts: sentences on what looks wrong with a source as a whole.

A longitude of the wrong sign, kilometres for metres, a clock in another time zone: such a source matches no other as
given, and matches well in another unit, sign or order. These guesses (:class:`UnitGuess`) are tried only for sources
that match no other, and only to name the remedy: data are never changed.

- :func:`doubts`: on the sources of a scene. :func:`too_far_apart`: on sources too far apart for one plane,
  :func:`of_other_days`: for one time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.registration.weights import weigh
from sameas.tracks.alignment import States
from sameas.tracks.bearing_readings import MIRRORED, OF_BOW, OF_NORTH, best_other_reading
from sameas.tracks.bias_fit import BiasFit
from sameas.tracks.biases import TIME
from sameas.tracks.coordinates import FOOT_M, MILE_M, LocalPlane
from sameas.tracks.feed import Feed
from sameas.tracks.kinds import KINDS
from sameas.tracks.plot_offsets import PlotFits
from sameas.tracks.plot_pairs import has_bearings, shows_bare_plots, shows_tracks
from sameas.tracks.registration import unbiased
from sameas.tracks.reports import Reports
from sameas.tracks.snapshot import ComparedSource, bias_widths, common_scans
from sameas.tracks.source import Description, Site
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning

#: Units in which a length may be given, in metres.
LENGTHS = (("kilometres", 1000.0), ("nautical miles", MILE_M), ("feet", FOOT_M), ("millimetres", 0.001))
#: Seconds of a day.
DAY_S = 86400.0
#: Hours between time zones, and seconds by which GPS time is ahead of UTC since 2017.
HOURS, LEAP_S = (*range(-12, 0), *range(1, 15)), 18.0
DEGREE = 180.0 / math.pi

Source = tuple[Description, Reports]
Read = Callable[[Description, Reports], Source | None]


@dataclass(frozen=True)
class UnitGuess:
    """A possible mistake in a source's coordinates or units, in words. It is never applied to the data.

    suspicion : the mistake, after "its ". changed : the change tried, after "with ". remedy : what to do.
    read : makes the changed source; None if its values exclude the mistake.
    """

    suspicion: str
    changed: str
    remedy: str
    read: Read


def place_guesses(reports: Reports) -> Iterator[UnitGuess]:
    """Possible mistakes in geodetic coordinates: of positions, or of the sensor's site."""
    if reports.position == "geodetic":
        yield UnitGuess("longitudes look like they have the wrong sign", "the sign turned",
                      "turn the sign of its longitudes (west is negative)", _scaled(-1.0, "lon_deg"))  # fmt: skip
        yield UnitGuess("latitudes look like they have the wrong sign", "the sign turned",
                      "turn the sign of its latitudes (south is negative)", _scaled(-1.0, "lat_deg"))  # fmt: skip
        yield UnitGuess("latitudes and longitudes look exchanged", "them exchanged",
                      "exchange the two columns, or name them", _with_exchange)  # fmt: skip
        yield UnitGuess("latitudes and longitudes look like radians", "them read so",
                      "give their unit as rad", _with_radians)  # fmt: skip
        return
    yield UnitGuess("site's longitude looks like it has the wrong sign", "the sign turned",
                  "turn the sign of lon_deg in its site (west is negative)",
                  _with_site(lambda lat, lon: (lat, -lon)))  # fmt: skip
    yield UnitGuess("site's latitude and longitude look exchanged", "them exchanged",
                  "exchange lat_deg and lon_deg in its site", _with_site(lambda lat, lon: (lon, lat)))  # fmt: skip


def unit_guesses(reports: Reports) -> Iterator[UnitGuess]:
    """All possible mistakes in the positions of a source."""
    yield from place_guesses(reports)
    if reports.position == "local":
        yield UnitGuess("x and y look exchanged", "them exchanged", "name the columns: x is east, y is north",
                      lambda about, reports: (about, replace(reports, x_m=reports.y_m, y_m=reports.x_m)))  # fmt: skip
        yield from (_in_length("coordinates", unit, _scaled(m, "x_m", "y_m")) for unit, m in LENGTHS)
    if reports.position == "polar":
        yield from (_in_length("ranges", unit, _scaled(m, "range_m")) for unit, m in LENGTHS)
    if reports.bearing_deg is not None:
        yield UnitGuess("bearings look like radians", "them read so", "give their unit as rad",
                      _with_bearings(lambda bearing: bearing * DEGREE, 2.0 * math.pi + 0.01))  # fmt: skip
        yield UnitGuess("bearings look like angles from the east, anticlockwise", "them read so",
                      "give 90° less the angle: bearings run clockwise from north",
                      _with_bearings(lambda angle: 90.0 - angle, 360.0))  # fmt: skip
        mirrored = _with_bearings(lambda angle: -angle, 360.0)
        yield UnitGuess(MIRRORED[0], "their sign turned", MIRRORED[2], mirrored)
        yield from bow_guesses(reports)


def bow_guesses(reports: Reports) -> Iterator[UnitGuess]:
    """That bearings from the bow of a vessel are read as from north, or the reverse."""
    heading_deg = reports.heading_deg if reports.station_heading_deg is None else reports.station_heading_deg
    if reports.position != "polar" or reports.bearing_deg is None or heading_deg is None:
        return
    of_bow = _with_bearings(lambda angle: angle + heading_deg, 360.0)
    yield UnitGuess(OF_BOW[0], "the heading added", OF_BOW[2], of_bow)
    of_north = _with_bearings(lambda angle: angle - heading_deg, 360.0)
    yield UnitGuess(OF_NORTH[0], "the heading taken off", OF_NORTH[2], of_north)


def clock_guesses() -> Iterator[tuple[str, str, float]]:
    """Suspicion, remedy, and the seconds by which the stamps would be ahead."""
    for hours in sorted(HOURS, key=abs):
        ahead = "ahead" if hours > 0 else "behind"
        yield (f"clock looks {abs(hours)} h {ahead}, as in another time zone", "give its times in UTC", 3600.0 * hours)
    yield "clock looks 18 s ahead, as that of satellites", "take the leap seconds off its times", LEAP_S


def _scaled(factor: float, *columns: str) -> Read:
    def read(about: Description, reports: Reports) -> Source | None:
        scaled: dict[str, Any] = {name: factor * np.asarray(getattr(reports, name)) for name in columns}
        return about, replace(reports, **scaled)

    return read


def _with_exchange(about: Description, reports: Reports) -> Source | None:
    lat, lon = np.asarray(reports.lat_deg), np.asarray(reports.lon_deg)
    return None if np.nanmax(np.abs(lon)) > 90.0 else (about, replace(reports, lat_deg=lon, lon_deg=lat))


def _with_radians(about: Description, reports: Reports) -> Source | None:
    lat, lon = np.asarray(reports.lat_deg), np.asarray(reports.lon_deg)
    if np.nanmax(np.abs(lat)) > math.pi / 2.0 or np.nanmax(np.abs(lon)) > math.pi:
        return None
    return about, replace(reports, lat_deg=DEGREE * lat, lon_deg=DEGREE * lon)


def _with_site(changed: Callable[[float, float], tuple[float, float]]) -> Read:
    def read(about: Description, reports: Reports) -> Source | None:
        if about.site is None or about.site.lat_deg is None or about.site.lon_deg is None:
            return None
        lat, lon = changed(about.site.lat_deg, about.site.lon_deg)
        site = Site(lat, lon, about.site.height_m)
        return None if abs(lat) > 90.0 else (replace(about, site=site), reports)

    return read


def _in_length(what: str, unit: str, read: Read) -> UnitGuess:
    return UnitGuess(
        f"{what} look like {unit}", "them read so", f"give their unit as {unit}, or convert them to metres", read
    )


def _with_bearings(changed: Callable[[FloatArray], FloatArray], most: float) -> Read:
    def read(about: Description, reports: Reports) -> Source | None:
        bearing = np.asarray(reports.bearing_deg)
        if not np.nanmax(bearing) <= most:
            return None
        return about, replace(reports, bearing_deg=np.mod(changed(bearing), 360.0))

    return read


@dataclass(frozen=True)
class Shared:
    """How well two sources match: mean per instant of the expected number of pairs, of the records of the smaller
    source, and of the log-likelihood ratio (gain)."""

    other: str
    pairs: float
    records: float
    gain: float

    @property
    def share(self) -> float:
        """Share of the smaller source's records that have a partner."""
        return self.pairs / max(self.records, 1e-9)


@dataclass(frozen=True)
class Doubt:
    """What looks wrong with a source as a whole, in a sentence. misread : the sources of which one has wrong positions,
    since they match if reports are read in another way; empty if that is not the doubt."""

    sentence: str
    misread: frozenset[str] = frozenset()


def doubts(
    feeds: Sequence[Feed], plane: LocalPlane | None, tuning: Tuning = DEFAULT_TUNING, fits: PlotFits | None = None
) -> tuple[Doubt, ...]:
    """One doubt for each source that looks wrong as a whole; see :meth:`sameas.tracks.scene.Scene.doubts`.

    fits : of sources of plots, where already made.
    """
    fits = fits or PlotFits()
    # A radar in clutter matches little at any one instant; the plots of all its scans decide.
    by_plots = [_by_plots(feed, feeds, fits) for feed in feeds]
    matched = {name for fit in by_plots if fit is not None and fit[0].established for name in fit[1]}
    tolerant = [_tolerant(feed) for feed in feeds]
    examined = [
        _Examined.of(feed, own, tolerant, fit, feed.description.name in matched, plane, tuning)
        for feed, own, fit in zip(feeds, tolerant, by_plots, strict=True)
    ]
    sentences: dict[str, str] = {}
    for one in examined:
        # Of two that contradict each other one sentence is enough.
        if one.guess is not None and one.guess.other not in sentences:
            sentences[one.name] = one.guess.sentence
    guesses = {one.name: one.guess for one in examined if one.guess is not None}
    named = {guess.other for guess in guesses.values()}
    misread = {name: guess.either for name, guess in guesses.items()}
    for one in examined:
        accused = all(other.description.name in sentences for other in one.partners)
        if one.is_matched or one.name in sentences or one.name in named or accused:
            continue
        if sentence := _reading_sentence(one, tuning):
            sentences[one.name], misread[one.name] = sentence, frozenset({one.name})
        elif not one.has_common(tuning):
            sentences[one.name] = one.unmatched(tuning)
    names = (one.name for one in examined if one.name in sentences)
    return tuple(Doubt(sentences[name], misread.get(name, frozenset())) for name in names)


@dataclass(frozen=True)
class _Examined:
    """A source beside the others.

    partners : the sources with comparable reports. in_common : what it has in common with the best of them.
    by_plots : as of :func:`_by_plots`. is_matched : whether the plots of all scans show that it matches another source.
    guess : the mistake by which it would match one; None if none is likely.
    """

    feed: Feed
    partners: Sequence[Feed]
    in_common: Shared | None
    by_plots: tuple[BiasFit, tuple[str, ...]] | None
    is_matched: bool
    guess: BestGuess | None

    @classmethod
    def of(
        cls,
        feed: Feed,
        own: Feed,
        tolerant: Sequence[Feed],
        by_plots: tuple[BiasFit, tuple[str, ...]] | None,
        is_matched: bool,
        plane: LocalPlane | None,
        tuning: Tuning,
    ) -> _Examined:
        """own : the feed as of :func:`_tolerant`, one of ``tolerant``."""
        partners = _comparable(feed, [other for other in tolerant if other.description != feed.description])
        in_common, guess = _best(own, partners, tuning), None
        if partners and not is_matched and (in_common is None or in_common.share < tuning.guess_share):
            guess = _best_guess(feed, partners, in_common, plane, tuning)
        return cls(feed, partners, in_common, by_plots, is_matched, guess)

    @property
    def name(self) -> str:
        return self.feed.description.name

    def has_common(self, tuning: Tuning) -> bool:
        """Whether it has more in common with another source than by chance."""
        best = self.in_common
        return self.is_matched or (best is not None and best.share > tuning.unrelated_share and best.gain > 0.0)

    def unmatched(self, tuning: Tuning) -> str:
        """The sentence on a source that has nothing in common with the others."""
        if self.by_plots is not None and self.by_plots[0].log_evidence > -tuning.registration.decisive:
            return _undecided(*self.by_plots)
        return _nothing_in_common(self.feed, self.partners, self.in_common)


def _by_plots(feed: Feed, feeds: Sequence[Feed], fits: PlotFits) -> tuple[BiasFit, tuple[str, ...]] | None:
    """The offset fit of a source of plots by all its scans, and the names of the sources in it."""
    if not shows_bare_plots(feed):
        return None
    named = [other for other in feeds if other is not feed and shows_tracks(other)]
    fit = fits(feed, named)
    return None if fit is None else (fit, tuple(one.description.name for one in (feed, *named)))


def _reading_sentence(one: _Examined, tuning: Tuning) -> str:
    """The sentence on bearings that all reports show to be of another kind; "" if they do not."""
    named = [other for other in one.partners if shows_tracks(other)]
    if one.by_plots is not None:
        misread = one.by_plots[0].misread
    elif named and has_bearings(one.feed) and not one.has_common(tuning):
        reading = best_other_reading(one.feed, named)
        misread = reading if reading is not None and reading.is_decisive(tuning) else None
    else:
        return ""
    if misread is None:
        return ""
    others = " and ".join(other.description.name for other in named)
    return (
        f"{one.name}: its {misread.suspicion}: {misread.changed}, its plots are on the tracks of {others} "
        f"(log evidence {misread.log_evidence:.0f}); {misread.remedy}"
    )


def _undecided(fit: BiasFit, names: tuple[str, ...]) -> str:
    return (
        f"{names[0]}: its plots do not establish whether it shows the objects of {' or '.join(names[1:])} (log "
        f"evidence {fit.log_evidence:.1f}, by {fit.instants} scans); give more scans, or "
        "its calibration"
    )


def _comparable(feed: Feed, others: Sequence[Feed]) -> list[Feed]:
    """The other sources with comparable reports; directions cannot be compared with directions."""
    own = isinstance(feed.reports, States)
    return [o for o in others if len(feed.reports) and len(o.reports) and (own or isinstance(o.reports, States))]


def too_far_apart(sources: Sequence[Source], tuning: Tuning) -> dict[str, str]:
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
        k: [n for n, m in middle.items() if _apart_m(middle[k], m) > max(tuning.apart_m, extent_m[k], extent_m[n])]
        for k in known
    }
    home = min(known, key=lambda k: (len(far[k]), -len(known[k][0]), k))
    if not far[home]:
        return {}
    reach = max(tuning.near_extents * extent_m[home], tuning.near_m)
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
    theirs = " to ".join(_span(np.array([first_s, last_s])))
    return {
        name: f"{name}: its reports are of {' to '.join(_span(np.array([first, last])))}, days from those of others, "
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


def _tolerant(feed: Feed) -> Feed:
    """The feed with covariances increased by the prior uncertainty of its biases."""
    widths = bias_widths(feed)
    return unbiased(feed, np.zeros(len(widths)), np.diag(widths**2)) if widths.any() else feed


def _best(feed: Feed, others: Sequence[Feed], tuning: Tuning) -> Shared | None:
    """The match with the source that it matches best; None without common scans."""
    candidates = [shared for other in others if (shared := _shared(feed, other, tuning)) is not None]
    return max(candidates, key=lambda shared: shared.gain) if candidates else None


def _shared(feed: Feed, other: Feed, tuning: Tuning) -> Shared | None:
    scans = common_scans(ComparedSource(other, None), ComparedSource(feed, None), tuning.doubt_instants)
    if not scans:
        return None
    pairs = records = gain = 0.0
    for scan in scans:
        weighing = scan.weighing
        none = np.zeros((1, len(scan.biases)))
        common = np.array([0.5 * min(len(weighing.first), len(weighing.second))])
        for _ in range(tuning.doubt_steps):
            weights = weigh(weighing, none, common, 1.0)
            common = weights.common
        pairs, gain = pairs + float(common[0]), gain + float(weights.gain[0])
        records += min(len(weighing.first), len(weighing.second))
    count = len(scans)
    return Shared(other.description.name, pairs / count, records / count, gain / count)


@dataclass(frozen=True)
class BestGuess:
    """The guess by which a source matches another best: the sentence, the other source, the log-likelihood ratio, and
    the source, with the other where it may be that which is wrong."""

    sentence: str
    other: str
    gain: float
    either: frozenset[str]


def _best_guess(
    feed: Feed, others: Sequence[Feed], as_is: Shared | None, plane: LocalPlane | None, tuning: Tuning
) -> BestGuess | None:
    """The guess by which the source matches best; None if none matches well."""
    unchanged = as_is or Shared("", 0.0, 0.0, 0.0)
    best: BestGuess | None = None
    for suspicion, changed, remedy, guessed in _guessed_feeds(feed, plane):
        shared = _best(guessed, others, tuning)
        if shared is None or shared.share < max(tuning.guess_share, 2.0 * unchanged.share):
            continue
        if shared.gain > (max(unchanged.gain, 0.0) + tuning.guess_gain if best is None else best.gain):
            name, is_mutual = feed.description.name, len(others) == 1
            either = f", unless it is {shared.other} that is wrong" if is_mutual else ""
            sentence = (
                f"{name}: its {suspicion}: with {changed}, {shared.pairs:.0f} of {shared.records:.0f} "
                f"records of an instant match {shared.other}, as given {unchanged.pairs:.0f}; "
                f"{remedy}{either}"
            )
            wrong = frozenset({name, shared.other} if is_mutual else {name})
            best = BestGuess(sentence, shared.other, shared.gain, wrong)
    return best


def _guessed_feeds(feed: Feed, plane: LocalPlane | None) -> Iterator[tuple[str, str, str, Feed]]:
    """Suspicion, change, remedy, and the resulting feed, for each guess."""
    if feed.raw_reports is not None:
        for guess in unit_guesses(feed.raw_reports):
            source = guess.read(feed.description, feed.raw_reports)
            if source is None:
                continue
            try:
                changed = Feed.of(*source, plane, tuning=feed.tuning)
            except InputError:
                continue
            yield guess.suspicion, guess.changed, guess.remedy, _tolerant(changed)
    tolerant = _tolerant(feed)
    for suspicion, remedy, ahead_s in clock_guesses():
        biases = np.zeros(6)
        biases[TIME] = ahead_s
        yield suspicion, "that removed", remedy, unbiased(tolerant, biases, np.zeros((6, 6)))


def _nothing_in_common(feed: Feed, others: Sequence[Feed], best: Shared | None) -> str:
    name = feed.description.name
    if best is not None:
        remedy = "check its position, clock and errors, or leave it out"
        target = KINDS[feed.description.kind].target
        if target and all(KINDS[other.description.kind].target != target for other in others):
            objects = "aircraft" if target == "aircraft" else "vessels"
            remedy = f"do they observe its {objects} at all? If so, {remedy}"
        return (
            f"{name}: matches the others no better than by chance: {best.pairs:.0f} of {best.records:.0f} "
            f"records of an instant match {best.other}; {remedy}"
        )
    own, theirs = _span(feed.reports.time_s), _span(np.concatenate([other.reports.time_s for other in others]))
    return (
        f"{name}: has no reports while others do: its reports are of {own[0]} to {own[1]}, theirs of "
        f"{theirs[0]} to {theirs[1]}; check its clock and its date, or leave it out"
    )


def _span(time_s: FloatArray) -> tuple[str, str]:
    """The first and the last time: in UTC, or in seconds if below 1e8, which count from an arbitrary start."""
    first, last = float(np.min(time_s)), float(np.max(time_s))
    if abs(last) < 1e8:
        return f"{first:.0f} s", f"{last:.0f} s"
    dates = [datetime.fromtimestamp(t, UTC).strftime("%Y-%m-%d %H:%M:%S") for t in (first, last)]
    return dates[0], dates[1]
