"""Distress: locating devices that call for help by AIS, and are no vessels.

A survival craft has an AIS-SART, a person in the water a MOB device, a sunken ship an EPIRB: each sends positions under
an MMSI of its own (970…, 972…, 974…), with the navigational status 14 in distress and 15 in a test.

Source: ITU-R M.585-9, annex 2, section 2; ITU-R M.1371-5, table 48 and annex 9.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sameas.tracks.reports import Reports

#: The devices by the first three digits of their MMSI.
DEVICES = {"970": "AIS-SART", "972": "MOB device", "974": "EPIRB"}
#: The navigational status in a test.
TESTED = 15.0


def device_of(mmsi: object) -> str | None:
    """What sends under an MMSI, if it is a locating device.

    >>> device_of("972123456"), device_of("235000111")
    ('MOB device', None)
    """
    return DEVICES.get(str(mmsi)[:3]) if len(str(mmsi)) == 9 else None


@dataclass(frozen=True)
class DistressCall:
    """A locating device that is not being tested. mmsi : of it. source : that receives it. first_s, last_s : times of
    its first and last report. lat_deg, lon_deg : its place in the last one; None in a plane of the user's own."""

    mmsi: str
    source: str
    first_s: float
    last_s: float
    lat_deg: float | None = None
    lon_deg: float | None = None

    def __str__(self) -> str:
        where = "" if self.lat_deg is None or self.lon_deg is None else f" at {_place(self.lat_deg, self.lon_deg)}"
        return f"{device_of(self.mmsi)} {self.mmsi} calls for help{where}, received by {self.source}"


def calls_in(reports: Reports) -> Iterator[DistressCall]:
    """The calls in the reports of a source, by MMSI; a device whose status is unknown may be in distress."""
    if reports.mmsi is None:
        return
    status = reports.extra.get("nav_status")
    tested = np.zeros(len(reports), bool) if status is None else status == TESTED
    is_device = np.array([device_of(mmsi) is not None for mmsi in reports.mmsi.tolist()], bool) & ~tested
    which = np.flatnonzero(is_device)
    for mmsi in dict.fromkeys(reports.mmsi[which].tolist()):
        own = which[reports.mmsi[which] == mmsi]
        last = own[np.argmax(reports.time_s[own])]
        lat, lon = (None if one is None else float(one[last]) for one in (reports.lat_deg, reports.lon_deg))
        first_s, last_s = float(reports.time_s[own].min()), float(reports.time_s[last])
        yield DistressCall(str(mmsi), reports.source, first_s, last_s, lat, lon)


def distress_calls(sources: Sequence[Reports]) -> tuple[DistressCall, ...]:
    """The calls in the reports of all sources, in order of time."""
    return tuple(sorted((call for one in sources for call in calls_in(one)), key=lambda call: call.first_s))


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
