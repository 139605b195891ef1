"""Doubts: sentences on what looks wrong with a source as a whole.

A longitude of the wrong sign, kilometres for metres, a clock in another time zone: such a source matches no other as
given, and matches well in another unit, sign or order (:mod:`sameas.tracks.unit_guesses`). Doubts that need no scene,
of sources at another place or of other days, are in :mod:`sameas.tracks.elsewhere`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sameas.errors import InputError
from sameas.registration.solution import DECISIVE
from sameas.registration.weights import PlacedSources, weigh
from sameas.tracks.alignment import States
from sameas.tracks.bearing_readings import best_other_reading
from sameas.tracks.bias_fit import BiasFit, fit_biases
from sameas.tracks.biases import TIME
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.elsewhere import COUNTED_S, span_of
from sameas.tracks.feed import Feed
from sameas.tracks.kinds import KINDS
from sameas.tracks.plot_offsets import PlotFits
from sameas.tracks.plot_pairs import has_bearings, shows_bare_plots, shows_tracks
from sameas.tracks.registration import observable, scans_of_both, unbiased
from sameas.tracks.snapshot import ComparedSource, bias_widths, common_scans
from sameas.tracks.unit_guesses import (
    DELAYS,
    HOURS,
    UnitGuess,
    clock_guesses,
    delay_guesses,
    range_guesses,
    unit_guesses,
)

DOUBT_INSTANTS, DOUBT_STEPS = 5, 8  # compared instants, and iterations of the number of common objects
#: A source whose share of records with a partner is not above the first has nothing in common with another; a guess
#: must reach the second.
UNRELATED_SHARE, GUESS_SHARE = 0.1, 0.5
GUESS_GAIN = 8.0  # minimum gain of the log likelihood per instant by a guess, among some thirty guesses
TINY_RANGE = 0.002  # ranges of a radar's plots up to this part of its reach are hardly metres


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


def doubts(feeds: Sequence[Feed], plane: LocalPlane | None, fits: PlotFits | None = None) -> tuple[Doubt, ...]:
    """One doubt for each source that looks wrong as a whole; see :meth:`sameas.tracks.scene.Scene.doubts`.

    fits : of sources of plots, where already made.
    """
    fits = fits or PlotFits()
    # A radar in clutter matches little at any one instant; the plots of all its scans decide.
    by_plots = [_by_plots(feed, feeds, fits) for feed in feeds]
    matched = {name for fit in by_plots if fit is not None and fit[0].established for name in fit[1]}
    tolerant = [_tolerant(feed) for feed in feeds]
    examined = [
        _Examined.of(feed, own, tolerant, fit, feed.description.name in matched, plane)
        for feed, own, fit in zip(feeds, tolerant, by_plots, strict=True)
    ]
    examined = [replace(one, guess=None) if _is_offset(one, feeds) else one for one in examined]
    sentences: dict[str, str] = {}
    for one in examined:
        # Of two that contradict each other one sentence is enough.
        if one.guess is not None and one.guess.other not in sentences:
            sentences[one.name] = one.guess.sentence
    guesses = {one.name: one.guess for one in examined if one.guess is not None}
    named = {guess.other for guess in guesses.values()}
    misread = {name: guess.either for name, guess in guesses.items()}

    def unexplained() -> Iterator[_Examined]:
        for one in examined:
            accused = all(other.description.name in sentences for other in one.partners)
            if not (one.is_matched or one.name in sentences or one.name in named or accused):
                yield one

    # A source that is read wrongly explains why another matches nothing.
    for one in unexplained():
        if sentence := _range_sentence(one, fits, plane) or _reading_sentence(one):
            sentences[one.name], misread[one.name] = sentence, frozenset({one.name})
    for one in unexplained():
        if not one.has_common() and not (one.in_common is None and _show_offsets(one, feeds)):
            sentences[one.name] = one.unmatched()
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
    ) -> _Examined:
        """own : the feed as of :func:`_tolerant`, one of ``tolerant``."""
        partners = _comparable(feed, [other for other in tolerant if other.description != feed.description])
        in_common, guess = _best(own, partners), None
        if partners and not is_matched and (in_common is None or in_common.share < GUESS_SHARE):
            guess = _best_guess(feed, partners, in_common, plane)
        return cls(feed, partners, in_common, by_plots, is_matched, guess)

    @property
    def name(self) -> str:
        return self.feed.description.name

    def has_common(self) -> bool:
        """Whether it has more in common with another source than by chance."""
        best = self.in_common
        return self.is_matched or (best is not None and best.share > UNRELATED_SHARE and best.gain > 0.0)

    def unmatched(self) -> str:
        """The sentence on a source that has nothing in common with the others."""
        if self.by_plots is not None and self.by_plots[0].log_evidence > -DECISIVE:
            return _undecided(*self.by_plots)
        return _nothing_in_common(self.feed, self.partners, self.in_common)


def _is_offset(one: _Examined, feeds: Sequence[Feed]) -> bool:
    """Whether a source that looks late matches the other no worse as it is, with offsets of the sensors.

    A radar that is turned by some degrees shows ships where they were or will be within the minute.
    """
    if one.guess is None or not one.guess.delay_share:
        return False
    other = next(feed for feed in feeds if feed.description.name == one.guess.other)
    scans = scans_of_both(other, one.feed)
    if not observable(scans):
        return False
    fit = fit_biases(scans)
    records = sum(scan.most_pairs for scan in scans)
    return fit.established and fit.pairs >= one.guess.delay_share * records


def _show_offsets(one: _Examined, feeds: Sequence[Feed]) -> bool:
    """Whether offsets of a source are established that cannot be compared with the others before these are known, such
    as beside a convoy whose ships are nearer to each other than the offsets may be."""
    named = {other.description.name for other in one.partners}
    scans = (scans_of_both(other, one.feed) for other in feeds if other.description.name in named)
    return any(observable(common) and fit_biases(common).established for common in scans)


def _by_plots(feed: Feed, feeds: Sequence[Feed], fits: PlotFits) -> tuple[BiasFit, tuple[str, ...]] | None:
    """The offset fit of a source of plots by all its scans, and the names of the sources in it."""
    if not shows_bare_plots(feed):
        return None
    named = [other for other in feeds if other is not feed and shows_tracks(other)]
    fit = fits(feed, named)
    return None if fit is None else (fit, tuple(one.description.name for one in (feed, *named)))


def _reading_sentence(one: _Examined) -> str:
    """The sentence on bearings that all reports show to be of another kind; "" if they do not."""
    named = [other for other in one.partners if shows_tracks(other)]
    if one.by_plots is not None:
        misread = one.by_plots[0].misread
    elif named and has_bearings(one.feed) and not one.has_common():
        reading = best_other_reading(one.feed, named)
        misread = reading if reading is not None and reading.is_decisive() else None
    else:
        return ""
    if misread is None:
        return ""
    others = " and ".join(other.description.name for other in named)
    return (
        f"{one.name}: its {misread.suspicion}: {misread.changed}, its plots are on the tracks of {others} "
        f"(log evidence {misread.log_evidence:.0f}); {misread.remedy}"
    )


def _range_sentence(one: _Examined, fits: PlotFits, plane: LocalPlane | None) -> str:
    """The sentence on the unit of ranges of a radar's plots that all are a tiny part of its reach; "" for others."""
    reports, reach_m = one.feed.raw_reports, one.feed.description.coverage.range_m
    if reports is None or reports.range_m is None or reach_m is None or not shows_bare_plots(one.feed):
        return ""
    far = float(np.quantile(reports.range_m, 0.99))
    if far > TINY_RANGE * reach_m:
        return ""
    named = [other for other in one.partners if shows_tracks(other)]
    best: tuple[float, UnitGuess] | None = None
    for guess in range_guesses(at_least_m=1.0):
        source = guess.read(one.feed.description, reports)
        fit = None if source is None or not named else fits(Feed.of(*source, plane), named)
        if fit is not None and fit.established and (best is None or fit.log_evidence > best[0]):
            best = fit.log_evidence, guess
    if best is None:
        return (
            f"{one.name}: its ranges reach {far:.3g} m, which is little for the kind {one.feed.description.kind}; are "
            "they kilometres or nautical miles? Give their unit"
        )
    evidence, guess = best
    others = " and ".join(other.description.name for other in named)
    return (
        f"{one.name}: its {guess.suspicion}: with {guess.changed}, its plots are on the tracks of {others} "
        f"(log evidence {evidence:.0f}); {guess.remedy}"
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


def _tolerant(feed: Feed) -> Feed:
    """The feed with covariances increased by the prior uncertainty of its biases."""
    widths = bias_widths(feed)
    return unbiased(feed, np.zeros(len(widths)), np.diag(widths**2)) if widths.any() else feed


def _best(feed: Feed, others: Sequence[Feed]) -> Shared | None:
    """The match with the source that it matches best; None without common scans."""
    candidates = [shared for other in others if (shared := _shared(feed, other)) is not None]
    return max(candidates, key=lambda shared: shared.gain) if candidates else None


def _shared(feed: Feed, other: Feed) -> Shared | None:
    scans = common_scans(ComparedSource(other, None), ComparedSource(feed, None), DOUBT_INSTANTS)
    if not scans:
        return None
    pairs = records = gain = 0.0
    for scan, weighing in zip(scans, _in_one_field([scan.weighing for scan in scans]), strict=True):
        none = np.zeros((1, len(scan.biases)))
        common = np.array([0.5 * scan.most_pairs])
        for _ in range(DOUBT_STEPS):
            weights = weigh(weighing, none, common, 1.0)
            common = weights.common
        pairs, gain = pairs + float(common[0]), gain + float(weights.gain[0])
        records += scan.most_pairs
    count = len(scans)
    return Shared(other.description.name, pairs / count, records / count, gain / count)


def _in_one_field(weighings: Sequence[PlacedSources]) -> list[PlacedSources]:
    """The scans with fields as wide as that of all instants: one aircraft at an instant fills no field, and is where
    another source shows one by chance; on a path of kilometres it is not."""
    if any(not math.isinf(one.periods.min()) for one in weighings):
        return list(weighings)
    places = [np.concatenate([one.flat, one.second.features]) for one in weighings]
    whole = np.ptp(np.concatenate(places), axis=0)
    out = []
    for one, place in zip(weighings, places, strict=True):
        wider = float(np.max(whole - np.ptp(place, axis=0))) / 2.0
        out.append(replace(one, box=one.box + np.array([[-wider], [wider]]), sigma=one.sigma + wider))
    return out


@dataclass(frozen=True)
class BestGuess:
    """The guess by which a source matches another best: the sentence, the other source, the log-likelihood ratio, and
    the source, with the other where it may be that which is wrong.

    delay_share : share of the records that match, for stamps that are late by up to three minutes; 0 for other guesses.
    """

    sentence: str
    other: str
    gain: float
    either: frozenset[str]
    delay_share: float = 0.0


def _best_guess(feed: Feed, others: Sequence[Feed], as_is: Shared | None, plane: LocalPlane | None) -> BestGuess | None:
    """The guess by which the source matches best; None if none matches well."""
    unchanged = as_is or Shared("", 0.0, 0.0, 0.0)
    best: BestGuess | None = None
    for suspicion, changed, remedy, is_delay, guessed in _guessed_feeds(feed, plane):
        shared = _best(guessed, others)
        if shared is None or shared.share < max(GUESS_SHARE, 2.0 * unchanged.share):
            continue
        if shared.gain > (max(unchanged.gain, 0.0) + GUESS_GAIN if best is None else best.gain):
            name, is_mutual = feed.description.name, len(others) == 1
            either = f", unless it is {shared.other} that is wrong" if is_mutual else ""
            sentence = (
                f"{name}: its {suspicion}: with {changed}, {shared.pairs:.0f} of {shared.records:.0f} "
                f"records of an instant match {shared.other}, as given {unchanged.pairs:.0f}; "
                f"{remedy}{either}"
            )
            wrong = frozenset({name, shared.other} if is_mutual else {name})
            delay_share = shared.share if is_delay else 0.0
            best = BestGuess(sentence, shared.other, shared.gain, wrong, delay_share)
    return best


def _guessed_feeds(feed: Feed, plane: LocalPlane | None) -> Iterator[tuple[str, str, str, bool, Feed]]:
    """Suspicion, change, remedy, whether it is one of ``DELAYS``, and the resulting feed, for each guess."""
    if feed.raw_reports is not None:
        # Delays of plots without numbers would take a quarter of a minute.
        guesses = [(guess, False) for guess in unit_guesses(feed.raw_reports)]
        if shows_tracks(feed):
            guesses += [(guess, True) for guess in delay_guesses(feed.raw_reports)]
        for guess, is_delay in guesses:
            source = guess.read(feed.description, feed.raw_reports)
            if source is None:
                continue
            try:
                changed = Feed.of(*source, plane)
            except InputError:
                continue
            yield guess.suspicion, guess.changed, guess.remedy, is_delay, _tolerant(changed)
    tolerant = _tolerant(feed)
    for suspicion, remedy, ahead_s in clock_guesses():
        biases = np.zeros(6)
        biases[TIME] = ahead_s
        yield suspicion, "that removed", remedy, ahead_s in DELAYS, unbiased(tolerant, biases, np.zeros((6, 6)))


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
    time_s = np.concatenate([other.reports.time_s for other in others])
    own, theirs = span_of(feed.reports.time_s), span_of(time_s)
    first_s, last_s = float(time_s.min()), float(time_s.max())
    if np.mean((feed.reports.time_s >= first_s) & (feed.reports.time_s <= last_s)) > 0.5:
        return (
            f"{name}: cannot be compared with the others at any instant: the errors of one are too large to separate "
            "objects as near as these; state errors.position_m, or check positions and units"
        )
    remedy = "check its clock and its date, or leave it out"
    if (float(time_s.max()) < COUNTED_S) != (float(feed.reports.time_s.max()) < COUNTED_S):
        remedy = "some count from a start of their own: give start, the UTC of their 0"
    hours, apart_s = round((feed.reports.time_s.min() - first_s) / 3600.0), feed.reports.time_s.min() - first_s
    if 1 <= abs(hours) <= max(HOURS) and abs(apart_s - 3600.0 * hours) < 0.5 * min(
        np.ptp(feed.reports.time_s), last_s - first_s
    ):
        ahead = "ahead of" if hours > 0 else "behind"
        remedy = f"it is {abs(hours)} h {ahead} them, as with local times: give their time_zone, or {remedy}"
    return (
        f"{name}: has no reports while others do: its reports are of {own[0]} to {own[1]}, theirs of "
        f"{theirs[0]} to {theirs[1]}; {remedy}"
    )
