"""The summary of a picture: what there was, how sure it is, and what a user should look at, in printable lines."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.evidence.identity import Alarm
from sameas.picture.object_table import CONFIRMED
from sameas.picture.picture_state import Carried, PictureState
from sameas.picture.plot_picture import PlotObjects
from sameas.tracks.feed import Feed
from sameas.tracks.scene import Scene

#: Objects that a source ought to have shown, below which a share of misses says nothing.
FEWEST = 20
#: Stretches of the picture that its standard error is judged by: what one look misses, the next does as well.
STRETCHES = 12


@dataclass(frozen=True)
class Tally:
    """What the picture at one instant adds to the summary.

    objects : that sources show. expected_wrong : of them expected not to be exactly right.
    ambiguous_groups : groups with an ambiguous object.
    records, shared : per source its records, and those in one object with another source's.
    due, missed : per source the objects within its coverage that others show, and how many of them it does not.
    aged : per source rows of reports that had grown too uncertain. alarms : of the instant.
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
    alarms: tuple[Alarm, ...]

    @classmethod
    def of(cls, state: PictureState[Carried]) -> Tally:
        """Of the picture at an instant; sources are those of its scene."""
        feeds, now = state.now.feeds, state.now
        names = [description.name for description in state.scan.now.descriptions]
        there = np.zeros((len(state.members), len(feeds)), bool)
        for s, feed in enumerate(feeds):
            if feed.description.name in names:
                there[:, s] = state.members[:, names.index(feed.description.name)] >= 0
        due = np.array([_due(state, there, s) for s in range(len(feeds))]).reshape(len(feeds), len(there))
        ambiguous = len(np.unique(state.objects.group[state.ambiguous]))
        several = there.sum(axis=1) > 1
        return cls(
            now.instant_s, len(there), float(np.sum(1.0 - state.probability)), ambiguous, there.sum(axis=0),
            (there & several[:, None]).sum(axis=0), due.sum(axis=1), (due * ~there.T).sum(axis=1), now.aged,
            state.alarms,
        )  # fmt: skip


def _due(state: PictureState[Carried], there: BoolArray, s: int) -> FloatArray:
    """(n,) 1 where source s should show an object: others do, beyond doubt, and it lies where s sees."""
    others = np.delete(there, s, axis=1)
    honest = np.delete(np.array([feed.clutter(2) == 0.0 for feed in state.now.feeds], dtype=bool), s)
    beyond_doubt = (others & honest).any(axis=1) | (others.sum(axis=1) > 1)
    if len(honest) == 1:
        beyond_doubt = others[:, 0]
    if isinstance(state.known, PlotObjects):
        # A plot may be false, and two of them be so together; what was found again and again is there.
        known = state.known
        beyond_doubt = others.any(axis=1) & np.isin(state.number, known.number[known.stage == CONFIRMED])
    feed = state.now.feeds[s]
    sensor = feed.sensor_at(state.now.instant_s)
    seen = state.states.placed & beyond_doubt
    if sensor is None:
        return np.asarray(seen, np.float64)
    arm = state.states.state[:, :2] - sensor
    covers = feed.description.coverage.covers(np.hypot(*arm.T), np.degrees(np.arctan2(arm[:, 0], arm[:, 1])))
    return np.asarray(seen & covers, np.float64)


@dataclass(frozen=True)
class MissCount:
    """Of the objects that others show within a source's coverage, ``due``, the share of which it has no record.

    One object counts at every instant; a named track has one as long as its last report stands. error : standard error
    of the share, by how it differs from stretch to stretch of the picture; None where that is one stretch. described :
    what the source's description says of a look; None where it says nothing.
    """

    source: str
    due: float
    share: float
    error: float | None
    described: float | None

    def __str__(self) -> str:
        said = "" if self.described is None else f"; described: {100.0 * self.described:.0f} % at a look"
        error = "" if self.error is None else f" ± {100.0 * self.error:.1f}"
        share = f"{100.0 * self.share:.{1 if error else 0}f}{error} %"
        return f"{self.source} misses {share} of what others show within its coverage{said}"


@dataclass(frozen=True)
class Places:
    """How well the places of confirmed objects are known: the median of their 1σ per axis; None where there are none.

    shown_m : of those that a source shows. coasting_m : of those that nobody shows just now. coasting : how many these
    are at an instant, on average.
    """

    shown_m: float | None
    coasting_m: float | None
    coasting: float

    @classmethod
    def of(cls, objects: Mapping[str, NDArray[Any]], instants: int) -> Places:
        """Of the columns of a picture's objects."""
        sigma = np.ma.sqrt(0.5 * (np.ma.asarray(objects["var_x_m2"]) + objects["var_y_m2"]))
        coasts = objects["stage"] == "coasting"
        known = [sigma[of].compressed() for of in (objects["stage"] == "confirmed", coasts)]
        shown_m, coasting_m = (float(np.median(each)) if len(each) else None for each in known)
        return cls(shown_m, coasting_m, float(np.sum(coasts)) / instants)

    def __str__(self) -> str:
        words = [f"known to {_metres(self.shown_m)} (1σ, the median object)"] if self.shown_m is not None else []
        if self.coasting:
            known = f", known to {_metres(self.coasting_m)}" if self.coasting_m is not None else ""
            words.append(f"{self.coasting:.2g} at an instant coast, unseen{known}")
        return "; ".join(words)


def _metres(sigma_m: float) -> str:
    return f"{sigma_m:.1f} m" if sigma_m < 10.0 else f"{sigma_m:.0f} m"


@dataclass(frozen=True)
class Alarmed:
    """An alarm, from its first instant to its last, and at how many; where : source and line of both reports, first."""

    alarm: Alarm
    where: tuple[str, str]
    first_s: float
    last_s: float
    instants: int

    def __str__(self) -> str:
        alarm = self.alarm
        return (
            f"{alarm.attribute.upper()} {alarm.value} is shown at two places {alarm.distance:.0f} m apart "
            f"({math.sqrt(alarm.chi_sq):.0f} σ) by {self.where[0]} and {self.where[1]}: forged, duplicate or wrong "
            f"(at {self.instants} instant{'s' * (self.instants > 1)})"
        )


@dataclass(frozen=True)
class Summary:
    """What there is to know of a picture as a whole.

    Attributes
    ----------
    instants : how many. first_s, last_s : the first and the last.
    by_sources : confirmed objects by the most sources that showed them at one instant, from 0.
    unconfirmed : objects that were never confirmed.
    shown, expected_wrong, ambiguous_groups : per instant the objects that sources show, those of them expected not to
        be exactly right, and groups with an ambiguous object.
    places : how well they are known. misses : per source; biases : printable lines, as given; alarms; assumed : every
        number that nobody gave.
    notes : what else a user should know.
    """

    instants: int
    first_s: float
    last_s: float
    by_sources: tuple[int, ...]
    unconfirmed: int
    shown: float
    expected_wrong: float
    ambiguous_groups: float
    places: Places
    misses: tuple[MissCount, ...]
    biases: tuple[str, ...]
    alarms: tuple[Alarmed, ...]
    assumed: tuple[str, ...]
    notes: tuple[str, ...]

    @classmethod
    def of(
        cls, scene: Scene, objects: Mapping[str, NDArray[Any]], tallies: Sequence[Tally], biases: Sequence[str] = ()
    ) -> Summary:
        """Of the columns of a picture's objects and the tallies of its instants."""
        by_sources, unconfirmed = _by_sources(objects, len(scene.feeds))
        assumed = tuple(str(line) for feed in scene.feeds for line in feed.description.assumed)
        return cls(
            len(tallies), tallies[0].instant_s, tallies[-1].instant_s, by_sources, unconfirmed,
            float(np.mean([tally.objects for tally in tallies])),
            float(np.mean([tally.expected_wrong for tally in tallies])),
            float(np.mean([tally.ambiguous_groups for tally in tallies])), Places.of(objects, len(tallies)),
            tuple(_misses(scene.feeds, tallies)), tuple(biases), tuple(_alarms(scene.feeds, tallies)), assumed,
            tuple(_notes(scene.feeds, tallies)),
        )  # fmt: skip

    def entries(self) -> list[tuple[str, str]]:
        """Labels and printable words, the most important first; without alarms and what was assumed."""
        several = len(self.by_sources) > 2
        said = [("objects", self._objects() if several else f"{sum(self.by_sources)} confirmed")]
        if self.unconfirmed:
            said.append(("not confirmed", f"{self.unconfirmed} more, seen too briefly, as false echoes are"))
        if several:
            said.append(("how sure", self._sure()))
            said += [("places", str(self.places))] if str(self.places) else []
        labelled = {"doubt": self.notes, "offset": self.biases, "misses": self.misses}
        return said + [(label, str(words)) for label, told in labelled.items() for words in told]

    def lines(self) -> list[str]:
        """Printable, the most important first, what was assumed at the end."""
        told = [("alarm", str(alarm)) for alarm in self.alarms] + self.entries()
        return [*(f"{label}: {words}" for label, words in told), *self.assumed]

    def _objects(self) -> str:
        seen = [(k, n) for k, n in enumerate(self.by_sources) if n and k][::-1]
        words = [f"{n} by {k}{' sources at once' if at == 0 and k > 1 else ' alone' if k == 1 else ''}"
                 for at, (k, n) in enumerate(seen)]  # fmt: skip
        return f"{sum(self.by_sources)} confirmed" + (f"; seen: {', '.join(words)}" if words else "")

    def _sure(self) -> str:
        wrong, groups = _few(self.expected_wrong, "none"), _few(self.ambiguous_groups, "no")
        shown = f"{self.shown:.4g}" if self.shown < 1e4 else f"{self.shown:.0f}"
        return (
            f"of {shown} objects at an instant {wrong} are expected to be put together wrongly; "
            f"{groups} groups of neighbours are ambiguous"
        )


def _few(mean: float, none: str) -> str:
    """A mean count, as far as anybody wants to know it."""
    return f"{mean:.2g}" if mean >= 1e-3 else "fewer than 0.001" if mean else none


def _by_sources(objects: Mapping[str, NDArray[Any]], n_sources: int) -> tuple[tuple[int, ...], int]:
    if not len(objects["object"]):
        return (0,) * (n_sources + 1), 0
    number, at = np.unique(objects["object"], return_inverse=True)
    most, confirmed = np.zeros(len(number), np.int64), np.zeros(len(number), bool)
    np.maximum.at(most, at, objects["n_sources"])
    confirmed[at[np.isin(objects["stage"], ["confirmed", "coasting"])]] = True
    return tuple(np.bincount(most[confirmed], minlength=n_sources + 1).tolist()), int(np.sum(~confirmed))


def _misses(feeds: Sequence[Feed], tallies: Sequence[Tally]) -> Iterable[MissCount]:
    due, missed = (np.array([getattr(tally, name) for tally in tallies]) for name in ("due", "missed"))
    for s, feed in enumerate(feeds):
        whole = float(due[:, s].sum())
        if whole >= FEWEST:
            told = feed.description.misses.q
            described = None if told is None else float(np.mean(told))
            share = float(missed[:, s].sum() / whole)
            yield MissCount(feed.description.name, whole, share, share_error(due[:, s], missed[:, s]), described)


def share_error(due: FloatArray, missed: FloatArray) -> float | None:
    """Standard error of the share Σ missed / Σ due of some instants (n,), from the stretches they make; None of one.

    No less than that of looks that have nothing to do with each other: stretches are few, and may agree by accident.
    """
    parts = np.array_split(np.arange(len(due)), min(STRETCHES, len(due)))
    if len(parts) < 2:
        return None
    of_due, of_missed = (np.array([values[part].sum() for part in parts]) for values in (due, missed))
    whole, lost = float(of_due.sum()), float(of_missed.sum())
    off = of_missed - of_due * (lost / whole)
    of_stretches = math.sqrt(len(parts) / (len(parts) - 1) * float((off**2).sum())) / whole
    share = (lost + 0.5) / (whole + 1.0)
    return max(of_stretches, math.sqrt(share * (1.0 - share) / (whole + 1.0)))


def _alarms(feeds: Sequence[Feed], tallies: Sequence[Tally]) -> list[Alarmed]:
    found: dict[tuple[str, str, str, str], list[tuple[float, Alarm]]] = {}
    for tally in tallies:
        for alarm in tally.alarms:
            key = (alarm.attribute, alarm.value, alarm.first[0], alarm.second[0])
            found.setdefault(key, []).append((tally.instant_s, alarm))
    by_name = {feed.description.name: feed for feed in feeds}

    def line_of(source: str, row: int) -> str:
        given = by_name[source].given
        return f"{source} row {row}" if given is None else f"{source} {given.damaged.unit} {given.line[row]}"

    return [
        Alarmed(alarm, (line_of(*alarm.first), line_of(*alarm.second)), first_s, said[-1][0], len({t for t, _ in said}))
        for said in found.values() for first_s, alarm in said[:1]
    ]  # fmt: skip


def _notes(feeds: Sequence[Feed], tallies: Sequence[Tally]) -> Iterable[str]:
    records, shared = (np.sum([getattr(tally, name) for tally in tallies], axis=0) for name in ("records", "shared"))
    for s, feed in enumerate(feeds):
        name = feed.description.name
        yield from feed.notes
        old = np.unique(np.concatenate([tally.aged[s] for tally in tallies]))
        if len(old):
            reports = f"{len(old)} report{'s' * (len(old) > 1)}"
            yield f"{name}: {reports} too uncertain to tell objects apart after a while, and left out from then on"
        if not records[s]:
            yield f"{name} says nothing at any instant; do its times lie within the picture's?"
        elif len(feeds) > 1 and not shared[s]:
            yield (
                f"{name} shares no object with the others; check its times, its place, the sign of its longitudes, and "
                "how large its errors and offsets may be"
            )
