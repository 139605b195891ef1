"""The summary of a picture in printable lines: its objects, their probabilities, alarms and doubts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.evidence.identity import IdentityConflict
from sameas.picture.picture_state import Carried, PictureState
from sameas.picture.plot_picture import PlotObjects
from sameas.picture.tables import CONFIRMED
from sameas.picture.texts import TEXTS
from sameas.tracks.distress import DistressCall
from sameas.tracks.faults import Fault
from sameas.tracks.feed import FASTEST_VESSEL_M_PER_S, Feed
from sameas.tracks.kinds import KINDS
from sameas.tracks.scene import Scene
from sameas.tracks.source import SensorCoverage

#: Attributes of identity that only aircraft have.
_OF_AIRCRAFT = [TEXTS.index(name) for name in ("icao", "mode_a")]

MIN_EXPECTED = 20  # the summary gives a miss rate from this many expected detections on
BLOCKS = 12  # number of blocks of successive instants from whose scatter a miss rate's standard error is estimated


@dataclass(frozen=True)
class Tally:
    """The contribution of one instant to the summary.

    objects : number of detected objects. expected_wrong : expected number of these with wrong records.
    ambiguous_groups : number of groups with an ambiguous object.
    records, shared : per source, its records, and those in one object with another source's.
    due, missed : per source, the objects within its coverage that others detect, and those of them that it misses.
    aged : per source, rows of reports that became too uncertain. alarms : of the instant.
    """

    instant_s: float
    objects: int
    expected_wrong: float
    ambiguous_groups: int
    records: IntArray
    shared: IntArray
    due: FloatArray
    missed: FloatArray
    aged: tuple[IntArray, ...]
    alarms: tuple[IdentityConflict, ...]

    @classmethod
    def of(cls, state: PictureState[Carried]) -> Tally:
        """Of a picture state; sources are those of its scene."""
        feeds, now = state.now.feeds, state.now
        names = [description.name for description in state.scan.now.descriptions]
        shows = np.zeros((len(state.members), len(feeds)), bool)
        for s, feed in enumerate(feeds):
            if feed.description.name in names:
                shows[:, s] = state.members[:, names.index(feed.description.name)] >= 0
        due = np.array([_due(state, shows, s) for s in range(len(feeds))]).reshape(len(feeds), len(shows))
        ambiguous = len(np.unique(state.detections.group[state.ambiguous]))
        several = shows.sum(axis=1) > 1
        return cls(
            instant_s=now.instant_s, objects=len(shows), expected_wrong=float(np.sum(1.0 - state.probability)),
            ambiguous_groups=ambiguous, records=shows.sum(axis=0), shared=(shows & several[:, None]).sum(axis=0),
            due=due.sum(axis=1), missed=(due * ~shows.T).sum(axis=1), aged=now.aged, alarms=state.alarms,
        )  # fmt: skip


def _due(state: PictureState[Carried], shows: BoolArray, s: int) -> FloatArray:
    """(n,) 1 where source s should detect an object: others certainly detect it, and it is within the coverage of s."""
    others = np.delete(shows, s, axis=1)
    clutter_free = np.delete(np.array([feed.clutter(2) == 0.0 for feed in state.now.feeds], dtype=bool), s)
    # One or two plots may be false; a confirmed object is real.
    objects = state.objects
    confirmed = others.any(axis=1) & np.isin(state.number, objects.number[objects.stage == CONFIRMED])
    is_real = (others & clutter_free).any(axis=1) | (others.sum(axis=1) > 1)
    if len(clutter_free) == 1:
        is_real |= confirmed
    if isinstance(objects, PlotObjects):
        is_real = confirmed
    feed = state.now.feeds[s]
    is_real &= ~_of_another_kind(state, shows, s)
    sensor = feed.sensor_at(state.now.instant_s)
    placed = state.states.placed & is_real
    if sensor is None:
        return np.asarray(placed, np.float64)
    arm = state.states.state[:, :2] - sensor
    covers = feed.description.coverage.covers(np.hypot(*arm.T), np.degrees(np.arctan2(arm[:, 0], arm[:, 1])))
    return np.asarray(placed & covers, np.float64)


def _of_another_kind(state: PictureState[Carried], shows: BoolArray, s: int) -> BoolArray:
    """(n,) whether source s cannot receive an object: an aircraft that is known as one where it receives vessels only,
    and all others where it receives aircraft only. A ship that only radars see is no aircraft that ADS-B misses."""
    target = KINDS[state.now.feeds[s].description.kind].target
    if not target:
        return np.zeros(len(shows), bool)
    is_aircraft = _aircraft(state, shows)
    return ~is_aircraft if target == "aircraft" else is_aircraft


def _aircraft(state: PictureState[Carried], shows: BoolArray) -> BoolArray:
    """(n,) whether an object is known as an aircraft: a source of these shows it, it has an address or a Mode A code,
    or is faster than vessels."""
    feeds, texts = state.now.feeds, state.watch.texts
    shown = shows[:, [KINDS[feed.description.kind].target == "aircraft" for feed in feeds]].any(axis=1)
    named = [any(n in texts and texts[n][column] != "" for column in _OF_AIRCRAFT) for n in state.number.tolist()]
    speed = np.hypot(*state.states.state[:, 2:4].T)
    is_fast = state.states.moving & (speed > FASTEST_VESSEL_M_PER_S)
    return np.asarray(shown | np.array(named, bool) | is_fast)


@dataclass(frozen=True)
class MissCount:
    """The share of objects without a record of the source, of those that others detect within its coverage (``due``).

    An object counts at each instant; a named track has a record until its timeout. error : standard error of the share,
    from its scatter between blocks of successive instants; None for a single block. described : the miss probability
    per scan that the picture uses: described, assumed or estimated; None without one. bounded : whether its coverage is
    described; without it a source is due to show objects at any distance.
    """

    source: str
    due: float
    share: float
    error: float | None
    described: float | None
    bounded: bool = True

    def __str__(self) -> str:
        described = "" if self.described is None else f"; used: {100.0 * self.described:.0f} % per scan"
        error = "" if self.error is None else f" ± {100.0 * self.error:.1f}"
        share = f"{100.0 * self.share:.{1 if error else 0}f}{error} %"
        where = "within its coverage" if self.bounded else "at any distance, as its coverage is not described"
        return f"{self.source} misses {share} of the others' objects {where}{described}"


@dataclass(frozen=True)
class PositionErrors:
    """Median 1σ per axis of the positions of confirmed objects; None if there are none.

    shown_m : of detected objects. coasting_m : of coasting objects. coasting : mean number of these per instant.
    """

    shown_m: float | None
    coasting_m: float | None
    coasting: float

    @classmethod
    def of(cls, objects: Mapping[str, NDArray[Any]], instants: int) -> PositionErrors:
        """Of the columns of a picture's objects."""
        sigma = np.ma.sqrt(0.5 * (np.ma.asarray(objects["var_x_m2"]) + objects["var_y_m2"]))
        coasts = objects["stage"] == "coasting"
        sigmas = [sigma[of].compressed() for of in (objects["stage"] == "confirmed", coasts)]
        shown_m, coasting_m = (float(np.median(each)) if len(each) else None for each in sigmas)
        return cls(shown_m, coasting_m, float(np.sum(coasts)) / instants)

    def __str__(self) -> str:
        words = [f"known to {_metres(self.shown_m)} (1σ, the median object)"] if self.shown_m is not None else []
        if self.coasting:
            uncertainty = f", known to {_metres(self.coasting_m)}" if self.coasting_m is not None else ""
            words.append(f"{self.coasting:.2g} per instant coast without a report{uncertainty}")
        return "; ".join(words)


def _metres(sigma_m: float) -> str:
    return f"{sigma_m:.1f} m" if sigma_m < 10.0 else f"{sigma_m:.0f} m"


@dataclass(frozen=True)
class Alarmed:
    """An alarm over time: its first and last instant, their number, and the source and line of its first two
    reports."""

    alarm: IdentityConflict
    where: tuple[str, str]
    first_s: float
    last_s: float
    instants: int

    def __str__(self) -> str:
        alarm = self.alarm
        return (
            f"{alarm.attribute.upper()} {alarm.value} is reported at two places {alarm.distance:.0f} m apart "
            f"({math.sqrt(alarm.chi_sq):.0f} σ) by {self.where[0]} and {self.where[1]}: forged, duplicate or wrong "
            f"(at {self.instants} instant{'s' * (self.instants > 1)})"
        )


@dataclass(frozen=True)
class Summary:
    """The summary of a picture.

    Attributes
    ----------
    instants : their number. first_s, last_s : the first and the last.
    by_sources : confirmed objects by the largest number of sources that detected them at one instant, from 0.
    unconfirmed : number of objects that were never confirmed.
    detected, expected_wrong, ambiguous_groups : means per instant of the number of detected objects, of the expected
        number of these with wrong records, and of the number of groups with an ambiguous object.
    calls : for help. faults : alarms on sources and tracks: clocks, ends, floods, deception, each with its probability.
    places : uncertainty of positions. misses : per source. biases : printable lines, as given. alarms : on identities.
    assumed : printable lines on all assumed numbers. notes : other doubts. errors : printable lines on sources whose
        errors are not as stated.
    """

    instants: int
    first_s: float
    last_s: float
    by_sources: tuple[int, ...]
    unconfirmed: int
    detected: float
    expected_wrong: float
    ambiguous_groups: float
    places: PositionErrors
    misses: tuple[MissCount, ...]
    biases: tuple[str, ...]
    alarms: tuple[Alarmed, ...]
    assumed: tuple[str, ...]
    notes: tuple[str, ...]
    faults: tuple[Fault, ...] = ()
    errors: tuple[str, ...] = ()
    calls: tuple[DistressCall, ...] = ()

    @classmethod
    def of(
        cls,
        scene: Scene,
        objects: Mapping[str, NDArray[Any]],
        tallies: Sequence[Tally],
        biases: Sequence[str] = (),
        faults: Sequence[Fault] = (),
        errors: Sequence[str] = (),
        calls: Sequence[DistressCall] = (),
    ) -> Summary:
        """From the columns of a picture's objects and the tallies of its instants.

        biases, errors : printable lines. faults : of sources and tracks. calls : for help.
        """
        by_sources, unconfirmed = _by_sources(objects, len(scene.feeds))
        assumed = tuple(str(line) for feed in scene.feeds for line in feed.description.assumed)
        return cls(
            instants=len(tallies), first_s=tallies[0].instant_s, last_s=tallies[-1].instant_s, by_sources=by_sources,
            unconfirmed=unconfirmed, detected=float(np.mean([tally.objects for tally in tallies])),
            expected_wrong=float(np.mean([tally.expected_wrong for tally in tallies])),
            ambiguous_groups=float(np.mean([tally.ambiguous_groups for tally in tallies])),
            places=PositionErrors.of(objects, len(tallies)), misses=tuple(_misses(scene.feeds, tallies)),
            biases=tuple(biases), alarms=tuple(_alarms(scene.feeds, tallies)), assumed=assumed,
            notes=tuple(_notes(scene.feeds, tallies)), faults=tuple(faults), errors=tuple(errors),
            calls=tuple(calls),
        )  # fmt: skip

    @property
    def urgent(self) -> tuple[DistressCall | Alarmed | Fault, ...]:
        """All alarms, calls for help first."""
        return (*self.calls, *self.alarms, *self.faults)

    def entries(self) -> list[tuple[str, str]]:
        """Labels and printable words, the most important first; without alarms and assumed numbers."""
        several = len(self.by_sources) > 2
        entries = [("objects", self._objects() if several else f"{sum(self.by_sources)} confirmed")]
        if self.unconfirmed:
            entries.append(("not confirmed", f"{self.unconfirmed} more, seen too briefly to be told from false echoes"))
        if several:
            entries.append(("confidence", self._sure()))
            entries += [("places", str(self.places))] if str(self.places) else []
        labelled = {"doubt": self.notes, "offset": self.biases, "errors": self.errors, "misses": self.misses}
        return entries + [(label, str(words)) for label, lines in labelled.items() for words in lines]

    def lines(self) -> list[str]:
        """Printable lines, the most important first, assumed numbers at the end."""
        entries = [("alarm", str(alarm)) for alarm in self.urgent] + self.entries()
        return [*(f"{label}: {words}" for label, words in entries), *self.assumed]

    def _objects(self) -> str:
        counts = [(k, n) for k, n in enumerate(self.by_sources) if n and k][::-1]
        words = [f"{n} by {k}{' sources at once' if at == 0 and k > 1 else ' alone' if k == 1 else ''}"
                 for at, (k, n) in enumerate(counts)]  # fmt: skip
        return f"{sum(self.by_sources)} confirmed" + (f"; seen: {', '.join(words)}" if words else "")

    def _sure(self) -> str:
        wrong, groups = _few(self.expected_wrong, "none"), _few(self.ambiguous_groups, "no")
        detected = f"{self.detected:.4g}" if self.detected < 1e4 else f"{self.detected:.0f}"
        one = self.ambiguous_groups == 1.0
        return (
            f"of {detected} objects per instant {wrong} are expected to be wrong; "
            f"{groups} group{'' if one else 's'} of neighbours {'is' if one else 'are'} ambiguous"
        )


def _few(mean: float, none: str) -> str:
    """A mean count with two digits, or whole where it has more."""
    if mean >= 99.5:
        return f"{mean:.0f}"
    return f"{mean:.2g}" if mean >= 1e-3 else "fewer than 0.001" if mean else none


def _by_sources(objects: Mapping[str, NDArray[Any]], n_sources: int) -> tuple[tuple[int, ...], int]:
    if not len(objects["object"]):
        return (0,) * (n_sources + 1), 0
    number, index = np.unique(objects["object"], return_inverse=True)
    max_sources, confirmed = np.zeros(len(number), np.int64), np.zeros(len(number), bool)
    np.maximum.at(max_sources, index, objects["n_sources"])
    confirmed[index[np.isin(objects["stage"], ["confirmed", "coasting"])]] = True
    return tuple(np.bincount(max_sources[confirmed], minlength=n_sources + 1).tolist()), int(np.sum(~confirmed))


def _misses(feeds: Sequence[Feed], tallies: Sequence[Tally]) -> Iterable[MissCount]:
    due, missed = (np.array([getattr(tally, name) for tally in tallies]) for name in ("due", "missed"))
    for s, feed in enumerate(feeds):
        whole = float(due[:, s].sum())
        if whole >= MIN_EXPECTED:
            q = feed.description.misses.q
            described = None if q is None else float(np.mean(q))
            share = float(missed[:, s].sum() / whole)
            error = share_error(due[:, s], missed[:, s], BLOCKS)
            bounded = feed.description.coverage != SensorCoverage()
            yield MissCount(feed.description.name, whole, share, error, described, bounded)


def share_error(due: FloatArray, missed: FloatArray, blocks: int = BLOCKS) -> float | None:
    """Standard error of the share Σ missed / Σ due of instants (n,), from the scatter between up to ``BLOCKS``
    blocks; None for a single one.

    It is at least that of independent scans: few blocks may agree by chance.
    """
    parts = np.array_split(np.arange(len(due)), min(blocks, len(due)))
    if len(parts) < 2:
        return None
    of_due, of_missed = (np.array([values[part].sum() for part in parts]) for values in (due, missed))
    total_due, total_missed = float(of_due.sum()), float(of_missed.sum())
    excess = of_missed - of_due * (total_missed / total_due)
    between_blocks = math.sqrt(len(parts) / (len(parts) - 1) * float((excess**2).sum())) / total_due
    share = (total_missed + 0.5) / (total_due + 1.0)
    return max(between_blocks, math.sqrt(share * (1.0 - share) / (total_due + 1.0)))


def _alarms(feeds: Sequence[Feed], tallies: Sequence[Tally]) -> list[Alarmed]:
    by_identity: dict[tuple[str, str, str, str], list[tuple[float, IdentityConflict]]] = {}
    for tally in tallies:
        for alarm in tally.alarms:
            key = (alarm.attribute, alarm.value, alarm.first[0], alarm.second[0])
            by_identity.setdefault(key, []).append((tally.instant_s, alarm))
    by_name = {feed.description.name: feed for feed in feeds}

    def line_of(source: str, row: int) -> str:
        raw = by_name[source].raw_reports
        return f"{source} row {row}" if raw is None else f"{source} {raw.damaged.unit} {raw.line[row]}"

    return [
        Alarmed(
            alarm, (line_of(*alarm.first), line_of(*alarm.second)), first_s, times[-1][0], len({t for t, _ in times})
        )
        for times in by_identity.values()
        for first_s, alarm in times[:1]
    ]


def _notes(feeds: Sequence[Feed], tallies: Sequence[Tally]) -> Iterable[str]:
    records, shared = (np.sum([getattr(tally, name) for tally in tallies], axis=0) for name in ("records", "shared"))
    for s, feed in enumerate(feeds):
        name = feed.description.name
        yield from feed.notes
        old = np.unique(np.concatenate([tally.aged[s] for tally in tallies]))
        if len(old):
            reports = f"{len(old)} report{'s' * (len(old) > 1)}"
            were = "was" if len(old) == 1 else "were"
            yield f"{name}: {reports} became too uncertain to separate objects, and {were} not used from then on"
        if not records[s]:
            yield f"{name} has no report at any instant; are its times within the picture's?"
        elif len(feeds) > 1 and not shared[s]:
            yield (
                f"{name} shares no object with the others; check its times, its position, the sign of its "
                "longitudes, and how large its errors and offsets may be"
            )
