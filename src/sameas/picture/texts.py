"""Texts of objects: their names, and what is reported with names, by the records that the objects have had."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import IntArray, entries
from sameas.evidence.identity import UNSET
from sameas.picture.tables import PictureObjects, Scan

#: Attributes of identity in the tables of a picture: names of an object, and what is reported with them.
NAMES, WITH_NAMES = ("mmsi", "icao", "callsign", "name"), ("mode_a", "type")
TEXTS = (*NAMES, *WITH_NAMES)
#: The columns of text of an object in tables and on maps.
LABELS = ("label", *TEXTS)
#: The texts of an object without any.
NO_TEXTS = np.full(len(TEXTS), "", dtype=object)


#: Kinds of sources whose objects have ids by which others know them, too: of the tracker of a glider, of a drone.
_OWN_IDS = ("ads-b", "drone")


def texts_of(scan: Scan) -> dict[str, NDArray[Any]]:
    """(records,) the texts of an instant by column, of the columns that a source reports.

    What sends an id of its own, and no other name, is called by that.
    """
    out = {name: scan.texts(name) for name in TEXTS if scan.reports(name)}
    sends = np.array([one.kind in _OWN_IDS for one in scan.now.descriptions], bool)
    if not sends.any():
        return out
    unnamed = sends[scan.source] & ~np.isin(scan.track.astype(str), ["", *UNSET["icao"]])
    for name in NAMES:
        unnamed &= out[name] == "" if name in out else True
    if unnamed.any():
        names = out.get("name", np.full(len(scan), "", dtype=object))
        out["name"] = np.where(unnamed, [track.upper() for track in scan.track.tolist()], names).astype(object)
    return out


@dataclass(frozen=True)
class RecordTexts:
    """The texts of the records of an instant, one column of :data:`TEXTS` each.

    newest : (n, texts) of each detected object, that of its newest record with it; "" for none. holders : by column and
    text, the numbers of the objects that have a record with it.
    """

    newest: NDArray[Any]
    holders: Mapping[tuple[int, str], set[int]]

    @classmethod
    def of(
        cls, scan: Scan, members: IntArray, texts: Mapping[str, NDArray[Any]], objects: PictureObjects
    ) -> RecordTexts:
        """members : (n, S) records of the detected objects. texts : (records,) by column, if reported."""
        at, record = entries(members)
        newest = np.full((len(members), len(TEXTS)), "", dtype=object)
        holders: dict[tuple[int, str], set[int]] = {}
        number_of = np.zeros(len(members) + 1, np.int64)  # the last place is that of objects without records
        number_of[objects.detection] = objects.number
        number_of[-1] = 0
        for column, name in enumerate(TEXTS):
            if name not in texts:
                continue
            values = texts[name][record]
            with_value = np.flatnonzero(values != "")
            if not len(with_value):
                continue
            # The newest is written last; of ties the first in alphabetical order.
            alphabetical = np.argsort(np.argsort(values[with_value].astype(str)[::-1]))
            order = with_value[np.lexsort([alphabetical, scan.time_s[record[with_value]]])]
            newest[at[order], column] = values[order]
            for value, number in zip(values[with_value], number_of[at[with_value]].tolist(), strict=True):
                if number:
                    holders.setdefault((column, value), set()).add(number)
        return cls(newest, holders)

    def of_objects(self, objects: PictureObjects, previous: Mapping[int, NDArray[Any]]) -> Mapping[int, NDArray[Any]]:
        """By number of the object, its texts: those of its records, else the previous ones, except those that another
        object has now."""
        out = {number: previous.get(number, NO_TEXTS) for number in objects.number.tolist()}
        has_text = np.append((self.newest != "").any(axis=1), False)[objects.detection]
        for number, k in zip(objects.number[has_text].tolist(), objects.detection[has_text].tolist(), strict=True):
            out[number] = np.where(self.newest[k] != "", self.newest[k], out[number])
        if not self.holders:
            return out
        return {number: self._without_foreign(number, words) for number, words in out.items()}

    def _without_foreign(self, number: int, words: NDArray[Any]) -> NDArray[Any]:
        """The texts of an object without the names that only others have now; then what came with them goes, too."""
        foreign = [
            column
            for column, value in enumerate(words[: len(NAMES)].tolist())
            if value != "" and number not in self.holders.get((column, value), {number})
        ]
        if not foreign:
            return words
        dropped = np.isin(np.arange(len(TEXTS)), [*foreign, *range(len(NAMES), len(TEXTS))])
        return np.where(dropped, "", words).astype(object)
