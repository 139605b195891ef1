"""Explanation of an object: its terms against those of every other set that one of its records could belong to.

Made by :meth:`sameas.many.objects.Objects.explain`. For two sources, :mod:`sameas.result.explanation` also has the cost
of every other answer for the whole group.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from scipy.sparse import csr_array

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.many.marginals import Answer
from sameas.many.observations import NO_RECORD, records_of
from sameas.many.pooled import PooledRecords
from sameas.many.rules import Terms, pairs_of
from sameas.many.sets import Sets
from sameas.representation import in_short
from sameas.result.explanation import probability_text

#: Least probability of a listed rival (chosen).
MIN_PROBABILITY = 1e-9
#: Most rivals in the text.
MAX_RIVALS = 8

#: A record: the name of its source and its id there.
Name = tuple[str, Any]


class Identified(Protocol):
    """The attributes of :class:`~sameas.many.objects.Objects` that an explanation needs."""

    @property
    def pooled(self) -> PooledRecords: ...
    @property
    def sets(self) -> Sets: ...
    @property
    def answer(self) -> Answer: ...
    @property
    def terms(self) -> Terms | None: ...
    @property
    def set_of_object(self) -> IntArray: ...
    @property
    def object_of_record(self) -> IntArray: ...


@in_short
@dataclass(frozen=True)
class Rival:
    """A set of records that could be one object; the object itself is the ``chosen`` one.

    Attributes
    ----------
    members : the records, in the order in which the sources were given.
    probability : that exactly these records are one object.
    log_odds : ln of the odds of one object against every record being a separate one; 0 for one record.
    terms : the parts of ``log_odds`` by name; none for one record.
    taken : (record, number of its object) of the members that belong to another object of the answer.
    """

    members: tuple[Name, ...]
    probability: float
    log_odds: float
    terms: Mapping[str, float]
    taken: tuple[tuple[Name, int], ...]
    chosen: bool

    def __str__(self) -> str:
        return " = ".join(f"{source} {record}" for source, record in self.members)


@in_short
@dataclass(frozen=True)
class ObjectExplanation:
    """The result of :meth:`sameas.many.objects.Objects.explain`; ``str()`` of it is a readable text.

    Attributes
    ----------
    number : of the object. group, records : number of its group, and of the records in it.
    exact : whether the probabilities are sums over all partitions of the group.
    rivals : all sets that share a record with the object, including itself, the most probable first.
    stays : why the object is the answer although a rival is more probable; "" if none is.
    """

    number: int
    group: int
    records: int
    exact: bool
    rivals: tuple[Rival, ...]
    stays: str = ""

    @property
    def chosen(self) -> Rival:
        """The object."""
        return next(rival for rival in self.rivals if rival.chosen)

    @property
    def runner_up(self) -> Rival | None:
        """The most probable other set, if any is possible."""
        return next((rival for rival in self.rivals if not rival.chosen), None)

    @property
    def against_runner_up(self) -> dict[str, float]:
        """Each term of the object minus that of its runner-up, by name; they sum to the difference of ln w."""
        other = self.runner_up
        if other is None:
            return {}
        one, two = self.chosen.terms, other.terms
        return {name: one.get(name, 0.0) - two.get(name, 0.0) for name in {**one, **two}}

    def __str__(self) -> str:
        return "\n".join(_lines(self))


@in_short
@dataclass(frozen=True)
class Weights:
    """The terms of the probable sets of an answer.

    kept : (r,) the sets of a probability of at least :data:`MIN_PROBABILITY`, or chosen. terms : (r,) by name.
    sets_of : (n, r) records in sets. names : (n) of all records.
    """

    objects: Identified
    kept: IntArray
    terms: Mapping[str, FloatArray]
    sets_of: csr_array
    names: Sequence[Name]

    @classmethod
    def of(cls, objects: Identified) -> Weights:
        """The weights of a result of ``identify_many``."""
        if objects.terms is None:
            raise InputError("only the objects of identify_many are explained: others have no candidate sets")
        kept = np.flatnonzero((objects.answer.probability >= MIN_PROBABILITY) | objects.answer.chosen)
        members = objects.sets.members[kept]
        at, source = np.nonzero(members != NO_RECORD)
        shape = (len(objects.pooled), len(kept))
        sets_of = csr_array((np.ones(len(at), bool), (members[at, source], at)), shape=shape)
        sources = [records_of(source) for source in objects.pooled.sources]
        names = [(source.source, name) for source in sources for name in source.ids[source.rows].tolist()]
        return cls(objects, kept, _terms(objects, objects.terms, kept), sets_of, names)

    def of_object(self, number: int) -> ObjectExplanation:
        """The explanation of one object."""
        objects = self.objects
        own = int(objects.set_of_object[number])
        records = objects.sets.members[own]
        indptr, indices = self.sets_of.indptr, self.sets_of.indices
        near = np.unique(np.concatenate([indices[indptr[r] : indptr[r + 1]] for r in records[records != NO_RECORD]]))
        # Ties go to the object itself, then to the first by content.
        p, other = objects.answer.probability[self.kept[near]], self.kept[near] != own
        rivals = tuple(self._rival(at, number) for at in near[np.lexsort([near, other, -p])].tolist())
        group = int(objects.sets.group[own])
        exact = bool(objects.answer.exact(objects.sets.floor)[group])
        return ObjectExplanation(number, group, int(objects.pooled.sizes[group]), exact, rivals)

    def _rival(self, at: int, number: int) -> Rival:
        objects, which = self.objects, int(self.kept[at])
        records = [r for r in objects.sets.members[which, self._columns].tolist() if r != NO_RECORD]
        holders = objects.object_of_record[records].tolist()
        pairs = zip(records, holders, strict=True)
        return Rival(
            tuple(self.names[r] for r in records),
            float(objects.answer.probability[which]),
            float(objects.sets.log_weight[which]),
            {name: float(values[at]) for name, values in self.terms.items() if values[at] != 0.0},
            tuple((self.names[r], holder) for r, holder in pairs if holder != number),
            which == int(objects.set_of_object[number]),
        )

    @cached_property
    def _columns(self) -> IntArray:
        """Columns of the sets' members in the caller's order of sources."""
        return np.argsort(self.objects.pooled.given)


def _terms(objects: Identified, terms: Terms, kept: IntArray) -> dict[str, FloatArray]:
    """(r,) every term of the kept sets by name; the position term is ln w minus the others."""
    pooled, sets = objects.pooled, objects.sets
    out: dict[str, FloatArray] = {"position": np.zeros(len(kept))}
    for size in np.unique(sets.size[kept]).tolist():
        if size == 1:
            continue
        at = np.flatnonzero(sets.size[kept] == size)
        members = sets.members[kept[at]]
        records = members[members != NO_RECORD].reshape(-1, size)
        named = terms.by_name(records, pairs_of(pooled, records))
        named["position"] = sets.log_weight[kept[at]] - np.sum(
            [np.zeros(len(at)), *(values for name, values in named.items() if name != "position")], axis=0
        )
        for name, values in named.items():
            out.setdefault(name, np.zeros(len(kept)))[at] = values
    return out


def _lines(x: ObjectExplanation) -> list[str]:
    chosen, other = x.chosen, x.runner_up
    summed = "summed over all partitions" if x.exact else "approximate, improbable sets left out"
    lines = [
        f"Object {x.number} is {chosen}, probability {probability_text(chosen.probability)}.",
        f"Group {x.group}: {x.records} records; probabilities are {summed}.",
        "",
    ]
    first = x.rivals[:MAX_RIVALS]
    listed = first if chosen in first else (*first[:-1], chosen)
    width = max(len(str(rival)) for rival in listed) + 2
    lines.append(f"{'records':>{width}}  {'probability':>11}  {'log-odds':>8}  terms")
    for rival in listed:
        mark = "→ " if rival.chosen else "  "
        line = f"{mark + str(rival):>{width}}  {probability_text(rival.probability):>11}"
        lines.append(line + (f"  {rival.log_odds:+8.2f}  {_in_words(rival.terms)}" if rival.terms else ""))
    if len(x.rivals) > len(listed):
        lines.append(f"({len(x.rivals) - len(listed)} less probable not shown)")
    if other is None:
        return [*lines, "Nothing else is possible."]
    if other.probability > chosen.probability:
        why = x.stays or "the answer is the most probable for all records together"
        lines += ["", f"By itself {other} is more probable; {why}."]
    elif x.stays:
        lines += ["", f"For all records together another answer is more probable; {x.stays}."]
    total = chosen.log_odds - other.log_odds
    lines += ["", f"Against the runner-up, {other}: log-odds {total:+.2f}, of which {_in_words(x.against_runner_up)}."]
    if other.taken:
        taken = ", ".join(f"{source} {record} from object {holder}" for (source, record), holder in other.taken)
        lines.append(f"It would take {taken}.")
    return lines


def _in_words(terms: Mapping[str, float]) -> str:
    """Terms as text, without those that round to zero."""
    return ", ".join(f"{name} {value:+.2f}" for name, value in terms.items() if abs(value) >= 0.005) or "nothing"
