"""Sensors aboard a vessel: where the sensor is at each of its reports, from another source's reports of the vessel.

A radar aboard a boat gives ranges and bearings; where the boat is, is in the file of her GNSS receiver or in AIS.
Between two positions that are not too far apart in time the boat is on the line between them; a live source may be some
seconds ahead of the positions. A source of such positions without any name of an object is no sensor, and makes none.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.errors import InputError, naming
from sameas.representation import listed
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, Platform
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning


def on_platform(
    description: Description,
    reports: Reports,
    others: Mapping[str, Sequence[Reports]],
    tuning: Tuning = DEFAULT_TUNING,
) -> tuple[Reports, tuple[str, ...]]:
    """The reports with the position of their sensor, if it is aboard a vessel that another source reports, and notes.

    Reports at times at which the vessel's position is not known are set aside, with a note that counts them. Reports
    that have the sensor's position themselves stay as they are.

    Parameters
    ----------
    others : by name, the reports of all sources; those of the sensor itself are not used.
    tuning : ``platform_gap_s`` and ``platform_ahead_s``.

    Raises
    ------
    InputError : no source reports the vessel, several do, or none at the times of the sensor's reports.
    """
    platform, has_own = description.platform, reports.station_lat_deg is not None or reports.station_x_m is not None
    if platform is None or has_own or not len(reports):
        return reports, ()
    vessel = _reports_of(platform, description.name, others)
    names = ("lat_deg", "lon_deg") if vessel[0].lat_deg is not None else ("x_m", "y_m")
    time_s, place = _positions(vessel, names)
    known, at = _interpolated(time_s, place, reports.time_s, tuning)
    if not known.any():
        raise InputError(
            f"{description.name}: the {platform}, which carries it, has no position at the times of its {len(reports)} "
            f"reports; it has {len(time_s)} at other times",
            "is one of the two clocks in another time zone, or of another day?",
        )
    latitude_or_x, longitude_or_y = STATION[names]
    out = replace(reports, **{latitude_or_x: at[:, 0], longitude_or_y: at[:, 1]})  # type: ignore[arg-type]
    if known.all():
        return out, ()
    note = (
        f"{description.name}: {int((~known).sum())} of {len(reports)} reports are set aside: where the {platform} was "
        "at their times is not known"
    )
    return out.where(known), (note,)


def only_carries(source: str, reports: Reports, descriptions: Iterable[Description]) -> bool:
    """Whether a source gives the position of a vessel that carries sensors, and names no object: it is no sensor."""
    carriers = {description.platform.source for description in descriptions if description.platform is not None}
    return source in carriers and reports.object_ids is None


#: The columns of a sensor's position, by those of positions.
STATION = {
    ("lat_deg", "lon_deg"): ("station_lat_deg", "station_lon_deg"),
    ("x_m", "y_m"): ("station_x_m", "station_y_m"),
}


def _reports_of(platform: Platform, sensor: str, others: Mapping[str, Sequence[Reports]]) -> list[Reports]:
    """The reports of the vessel, of the one source that has any."""
    if platform.source is not None and platform.source not in others:
        raise InputError(
            f"{sensor}: it is aboard the {platform}, and there is no source {platform.source!r}",
            f"give the file of that source too; there {'are' if len(others) > 1 else 'is'} {listed(tuple(others))}",
        )
    found: dict[str, list[Reports]] = {}
    for source, parts in others.items():
        if source == sensor or platform.source not in (None, source):
            continue
        own = [part.where(_is_of(platform, part)) for part in parts]
        own = [part for part in own if len(part) and (part.lat_deg is not None or part.x_m is not None)]
        if own:
            found[source] = own
    if not found:
        raise InputError(
            f"{sensor}: it is aboard the {platform}, of which no source has a position",
            naming(
                "correct platform in its {description}, or give the sensor's own position in columns own_lat, own_lon"
            ),
        )
    if len(found) > 1:
        raise InputError(
            f"{sensor}: it is aboard the {platform}, which {listed(tuple(found))} report",
            naming("give the one to use: platform = {{ source = …, mmsi = … }} in its {description}"),
        )
    [(source, own)] = found.items()
    ids = {str(each) for part in own for each in (() if part.object_ids is None else part.object_ids)} - {"None"}
    if platform.mmsi is None and len(ids) > 1:
        raise InputError(
            f"{sensor}: it is aboard the {platform}, which has {len(ids)} tracks: {listed(sorted(ids)[:5])}",
            naming("give the MMSI of the one: platform = {{ source = …, mmsi = … }} in its {description}"),
        )
    return own


def _is_of(platform: Platform, reports: Reports) -> BoolArray:
    """(n,) whether each report is of the vessel."""
    if platform.mmsi is None:
        return np.ones(len(reports), bool)
    if reports.mmsi is None:
        return np.zeros(len(reports), bool)
    return np.asarray(reports.mmsi == platform.mmsi)


def _positions(parts: Sequence[Reports], names: tuple[str, str]) -> tuple[FloatArray, FloatArray]:
    """(k,) times, ascending, and (k, 2) positions, longitudes without jumps at 180°."""
    time_s = np.concatenate([part.time_s for part in parts])
    place = np.column_stack([np.concatenate([getattr(part, name) for part in parts]) for name in names])
    usable = np.isfinite(place).all(axis=1) & np.isfinite(time_s)
    time_s, first = np.unique(time_s[usable], return_index=True)
    place = place[usable][first]
    if names[1] == "lon_deg":
        place[:, 1] = np.unwrap(place[:, 1], period=360.0)
    return time_s, place


def _interpolated(
    time_s: FloatArray, place: FloatArray, wanted_s: FloatArray, tuning: Tuning
) -> tuple[BoolArray, FloatArray]:
    """(n,) whether the position is known at each wanted time, and (n, 2) the positions, NaN where it is not."""
    out = np.full((len(wanted_s), 2), np.nan)
    if len(time_s) == 0:
        return np.zeros(len(wanted_s), bool), out
    if len(time_s) == 1:
        known = np.abs(wanted_s - time_s[0]) <= tuning.platform_ahead_s
        out[known] = place[0]
        return known, out
    after = np.clip(np.searchsorted(time_s, wanted_s), 1, len(time_s) - 1)
    width = time_s[after] - time_s[after - 1]
    beyond = np.maximum(time_s[after - 1] - wanted_s, wanted_s - time_s[after])
    close = width <= tuning.platform_gap_s
    known = np.where(close, beyond <= tuning.platform_ahead_s, False)
    # Between two positions far apart in time, a time next to one of them.
    nearest = np.where(wanted_s - time_s[after - 1] < time_s[after] - wanted_s, after - 1, after)
    beside = ~close & (np.abs(wanted_s - time_s[nearest]) <= tuning.platform_ahead_s)
    share = (wanted_s - time_s[after - 1]) / width
    line = place[after - 1] + share[:, None] * (place[after] - place[after - 1])
    out[known], out[beside] = line[known], place[nearest[beside]]
    return known | beside, out
