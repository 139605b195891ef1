"""The offsets of the sources of a watch: what is subtracted and why, and what an operator holds, sets and releases."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Collection, Mapping
from typing import Any

from sameas.errors import InputError
from sameas.live.journal import Store
from sameas.live.settings import LiveSource
from sameas.picture.live import LivePicture
from sameas.representation import listed
from sameas.tracks.source import Description

#: What an operator may set, in words, and the units in which, each in that of its name.
OFFSETS: Mapping[str, tuple[str, Mapping[str, float]]] = {
    "azimuth_deg": ("azimuth too far clockwise by", {"°": 1.0}),
    "range_m": ("range too long by", {"m": 1.0, "nm": 1852.0}),
    "range_gain": ("range too long by a share of", {"%": 0.01}),
    "time_s": ("stamps late by", {"s": 1.0}),
    "east_m": ("positions too far east by", {"m": 1.0}),
    "north_m": ("positions too far north by", {"m": 1.0}),
}


def read_offset(body: bytes) -> tuple[str, float]:
    """The name and the value of a bias in its unit, from the JSON that an operator's page sends.

    Raises InputError: no JSON; no such bias, no number, or another unit than those of :data:`OFFSETS`.
    """
    form = 'give JSON such as {"bias": "azimuth_deg", "value": 2.0, "unit": "°"}'
    try:
        given = json.loads(body)
    except (ValueError, RecursionError):
        raise InputError("the request is no JSON", form) from None
    bias = given.get("bias") if isinstance(given, dict) else None
    if not isinstance(bias, str) or bias not in OFFSETS:
        raise InputError(f"there is no offset {bias!r}", f"give as bias one of {', '.join(OFFSETS)}")
    value, units = given.get("value"), OFFSETS[bias][1]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{bias}: the value is {value!r}", form)
    factor = units.get(given.get("unit")) if isinstance(given.get("unit", ""), str) else None
    if "unit" in given and factor is None:
        raise InputError(f"{bias}: the unit is {given['unit']!r}", f"give one of {', '.join(units)}, or none")
    return bias, float(value) * (1.0 if factor is None else factor)


class SourceOffsets:
    """The offsets of the sources of a picture.

    picture : of the watch. sources : by name. store : whose journal records what an operator does, at once.
    lock : of picture and journal. clock : UTC in seconds.

    unsaved : whether an operator has changed any since the state was saved; the next tick saves it.
    """

    def __init__(
        self,
        picture: LivePicture,
        sources: Mapping[str, LiveSource],
        store: Store,
        lock: threading.Lock,
        clock: Callable[[], float],
    ) -> None:
        self.picture, self.sources, self.store, self.lock, self.clock = picture, sources, store, lock, clock
        self.unsaved = False

    def biases(self) -> dict[str, dict[str, Any]]:
        """By source with estimated biases, their text, whether they are established and so subtracted, and values."""
        return {
            name: {
                "text": found.values, "established": found.established, "log_evidence": round(found.log_evidence, 1),
                "values": {bias: {"value": one.value, "sigma": one.standard_error, "unit": one.unit}
                           for bias, one in found.parameters.items()},
            }
            for name, found in self.picture.estimates.items() if found.parameters
        }  # fmt: skip

    def in_words(self) -> dict[str, dict[str, Any]]:
        """By source, what is subtracted from its reports and why, in words, and whether an operator holds it."""
        out = {}
        for name, source in self.sources.items():
            found, held = self.picture.estimates.get(name), name in self.picture.held
            subtracted = name in self.picture.biases
            state = "subtracted" if subtracted else "not established, not subtracted"
            if found is None or not found.parameters:
                state = "the others are compared with it" if found is not None and not found.notes else "none estimated"
            last = self.picture.last_estimates.get(name)
            unused = (
                f"estimated now, not used: {last.values}" if held and last is not None and last is not found else ""
            )
            out[name] = {
                "described": _known_biases(source.description), "held": held, "state": state,
                "by_hand": list(self.picture.biases[name].by_hand) if subtracted else [],
                "settable": list(self.picture.settable(name)),
                "offsets": [] if found is None else [text for text in found.values.split(", ") if text],
                "by": "" if found is None or not found.against else f"{found.tracks:.0f} tracks in common with "
                f"{listed(found.against)}, log evidence {found.log_evidence:.0f}",
                "notes": [*([] if found is None else found.notes), *([unused] if unused else [])],
            }  # fmt: skip
        return out

    def hold(self, source: str, held: bool, who: str = "operator") -> bool:
        """Keeps the biases of a source as they are, or releases them; False for an unknown source."""
        with self.lock:
            if source not in self.sources:
                return False
            self.picture.hold(source, held)
            self._record(source, "held" if held else "released", who)
            return True

    def set(self, source: str, bias: str, value: float, who: str = "operator") -> bool:
        """Subtracts an offset as an operator sets it, and holds the source; False for an unknown source.

        Raises InputError: as of :meth:`sameas.picture.live.LivePicture.set_offset`.
        """
        with self.lock:
            if source not in self.sources:
                return False
            self.picture.set_offset(source, bias, value)
            unit = self.picture.biases[source].parameters[bias].unit
            self._record(source, "set", who, (bias, value, unit))
            return True

    def _record(self, source: str, event: str, who: str, set_: tuple[str, float, str] | None = None) -> None:
        time_s = self.picture.instant_s if math.isfinite(self.picture.instant_s) else self.clock()
        self.store.attempt(lambda journal: journal.offset(source, event, who, time_s, set_))
        self.unsaved = True

    def restore(self, changed: Collection[str]) -> None:
        """What an operator did after the state was saved counts, too; a source described anew begins anew.

        changed : names of the sources that are described differently since.
        """
        journal = self.store.journal
        if journal is None:
            return
        for name, values in journal.offsets().items():
            if name in changed or name not in self.sources:
                journal.offset(name, "released", "the sensor file", self.clock())
                continue
            for bias, value in values.items():
                self.picture.set_offset(name, bias, value)
            self.picture.hold(name)
        for name in self.picture.held - set(journal.offsets()):
            self.picture.hold(name, False)


def _known_biases(description: Description) -> str:
    """Printable: the biases that the description gives, and that are subtracted; empty for none."""
    known, late_s = description.calibration, description.timing.latency_s
    texts = {
        "range {:+g} m": known.range_m, "azimuth {:+g}°": known.azimuth_deg, "range gain {:+g}": known.range_gain,
        "east {:+g} m": known.east_m, "north {:+g} m": known.north_m, "stamps {:+g} s late": late_s or None,
    }  # fmt: skip
    return ", ".join(text.format(value) for text, value in texts.items() if value is not None)
