"""Distress: locating devices that call for help by AIS, and aircraft whose transponders do by their code.

A survival craft has an AIS-SART, a person in the water a MOB device, a sunken ship an EPIRB: each sends positions under
an MMSI of its own (970…, 972…, 974…), with the navigational status 14 in distress and 15 in a test. They are no
vessels. An aircraft in distress sets one of three Mode A codes. A radar may garble a code, so two reports have it.

Source: ITU-R M.585-9, annex 2, section 2; ITU-R M.1371-5, table 48 and annex 9; ICAO Annex 10, volume IV, 2.1.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import IntArray
from sameas.tracks.reports import Reports, TextArray

#: The devices by the first three digits of their MMSI.
DEVICES = {"970": "AIS-SART", "972": "MOB device", "974": "EPIRB"}
#: The navigational status in a test.
TESTED = 15.0
#: The codes of aircraft, and what each says.
CODES = {"7500": "unlawful interference", "7600": "radio failure", "7700": "emergency"}
#: A call lasts until this many seconds after its last report (chosen). A device sends eight times within a minute, and
#: again after a minute; waves hide it for longer.
CALL_S = 600.0
#: The same for a code, which is in every answer; two reports of one are at most so far apart (chosen).
CODE_S = 60.0


def device_of(mmsi: object) -> str | None:
    """What sends under an MMSI, if it is a locating device.

    >>> device_of("972123456"), device_of("235000111")
    ('MOB device', None)
    """
    return DEVICES.get(str(mmsi)[:3]) if len(str(mmsi)) == 9 else None


@dataclass(frozen=True)
class DistressCall:
    """A call for help that is no test.

    column, identity : of whom, as in the tables of objects: an MMSI, an ICAO address, a call sign, or the code alone.
    words : who calls. source : that receives it. first_s, last_s : times of its first and last report. lat_deg,
    lon_deg : its place in the last one; None in a plane of the user's own. is_sure : False of a code in one report.
    """

    column: str
    identity: str
    words: str
    source: str
    first_s: float
    last_s: float
    lat_deg: float | None = None
    lon_deg: float | None = None
    is_sure: bool = True

    def __str__(self) -> str:
        where = "" if self.lat_deg is None or self.lon_deg is None else f" at {_place(self.lat_deg, self.lon_deg)}"
        return f"{self.words}{where}, received by {self.source}"

    @property
    def ends_s(self) -> float:
        """The time from which the call has ended, if it is not repeated."""
        return self.last_s + (CALL_S if self.column == "mmsi" else CODE_S)

    def after(self, before: DistressCall | None) -> DistressCall:
        """This call as one that goes on from another."""
        if before is None:
            return self
        repeats = self.first_s - before.last_s <= CODE_S
        return replace(self, first_s=before.first_s, is_sure=self.is_sure or before.is_sure or repeats)


def calls_in(reports: Reports) -> Iterator[DistressCall]:
    """The calls in the reports of a source, by identity: those of devices first."""
    if reports.mmsi is not None:
        yield from _of_devices(reports, reports.mmsi)
    if reports.mode_a is not None:
        for code, rows in _by_text(reports.mode_a, np.flatnonzero(np.isin(reports.mode_a, list(CODES)))):
            yield from _of_aircraft(reports, code, rows)


def _of_devices(reports: Reports, mmsis: TextArray) -> Iterator[DistressCall]:
    """The calls of locating devices; one whose status is unknown may be in distress."""
    status = reports.extra.get("nav_status")
    tested = np.zeros(len(reports), bool) if status is None else status == TESTED
    given = mmsis.tolist()
    devices = {mmsi for mmsi in set(given) if device_of(mmsi)}
    if not devices:
        return
    is_device = np.array([mmsi in devices for mmsi in given], bool)
    for mmsi, rows in _by_text(mmsis, np.flatnonzero(is_device & ~tested)):
        yield _call(reports, rows, "mmsi", mmsi, f"{device_of(mmsi)} {mmsi} calls for help")


def _of_aircraft(reports: Reports, code: str, rows: IntArray) -> Iterator[DistressCall]:
    """The calls of the aircraft with a code in these rows, by the best name that each report has."""
    for column in ("icao", "callsign", "mode_a"):
        texts = getattr(reports, column)
        if texts is None:
            continue
        named = np.array([bool(text) for text in texts[rows].tolist()], bool)
        for text, own in _by_text(texts, rows[named]):
            who = "an aircraft" if column == "mode_a" else f"aircraft {text}"
            call = _call(reports, own, column, text, f"{who} squawks {code}, {CODES[code]},")
            yield replace(call, is_sure=bool((np.diff(np.unique(reports.time_s[own])) <= CODE_S).any()))
        rows = rows[~named]


def _by_text(texts: TextArray, rows: IntArray) -> Iterator[tuple[str, IntArray]]:
    """The different texts of some rows, in the order of their first, each with its rows."""
    for text in dict.fromkeys(texts[rows].tolist()):
        yield str(text), rows[texts[rows] == text]


def _call(reports: Reports, rows: IntArray, column: str, identity: str, words: str) -> DistressCall:
    last = rows[np.argmax(reports.time_s[rows])]
    lat, lon = (None if one is None else float(one[last]) for one in (reports.lat_deg, reports.lon_deg))
    first_s, last_s = float(reports.time_s[rows].min()), float(reports.time_s[last])
    return DistressCall(column, identity, words, reports.source, first_s, last_s, lat, lon)


def distress_calls(sources: Sequence[Reports]) -> tuple[DistressCall, ...]:
    """The calls in the reports of all sources, in order of time."""
    calls = (call for one in sources for call in calls_in(one) if call.is_sure)
    return tuple(sorted(calls, key=lambda call: call.first_s))


def _place(lat_deg: float, lon_deg: float) -> str:
    """Degrees and minutes, as in a distress message.

    >>> _place(54.6135, -12.5)
    "54°36.81' N 012°30.00' W"
    """
    parts = []
    for degrees, digits, sides in ((lat_deg, 2, "NS"), (lon_deg, 3, "EW")):
        whole, minutes = divmod(round(abs(degrees) * 60.0, 2), 60.0)
        parts.append(f"{whole:0{digits}.0f}°{minutes:05.2f}' {sides[degrees < 0.0]}")
    return " ".join(parts)
