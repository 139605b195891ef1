"""Sensors aboard a vessel: where the sensor is at each of its reports, from another source's reports of the vessel.

A radar aboard a boat gives ranges and bearings, these at times from her bow; where the boat is, and how she heads, is
in the file of her GNSS receiver and compass or in AIS. Between two positions that are not too far apart in time the
boat is on the line between them, and heads in between; a live source may be some seconds ahead of them. A source of
such positions without any name of an object is no sensor, and makes none.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.errors import InputError, naming
from sameas.representation import listed
from sameas.tracks.kinds import KINDS
from sameas.tracks.reports import OWN_HEADING, Reports
from sameas.tracks.source import Description, Platform

#: Longest time between two positions of a vessel that carries a sensor, on whose line she is; between two headings; and
#: between a position and a report before the first or after the last.
PLATFORM_GAP_S, PLATFORM_HEADING_GAP_S, PLATFORM_AHEAD_S = 180.0, 30.0, 10.0
#: Lowest speed at which her course may be her heading.
PLATFORM_COURSE_M_PER_S = 1.5


def on_platform(
    description: Description, reports: Reports, others: Mapping[str, Sequence[Reports]]
) -> tuple[Reports, tuple[str, ...]]:
    """The reports with the position of their sensor, if it is aboard a vessel that another source reports, and notes.

    Bearings from the bow become bearings from north. Reports at times at which the vessel's position, or the heading
    that they need, is not known are set aside, with a note that counts them. A position and a heading that the reports
    have themselves stay as they are.

    others : by name, the reports of all sources; those of the sensor itself are not used.

    Raises InputError: no source reports the vessel, several do, or none at the times of the sensor's reports; bearings
    are from the bow, and no source has the heading.
    """
    if not len(reports):
        return reports, ()
    platform = description.platform
    notes: list[str] = []
    if platform is None and needs_place(description, reports):
        platform = _only_ship(description.name, others)
        if platform is not None:
            notes.append(
                f"{description.name}: taken to be aboard the {platform}, the only one whose own positions are known; "
                "if it is not, give its site"
            )
    if platform is None:
        if reports.relative_bearing_deg is not None:
            compasses = [name for name, parts in others.items() if any(part.kind == OWN_HEADING for part in parts)]
            if compasses:
                raise InputError(
                    f"{description.name}: its bearings are relative to the bow; {listed(tuple(compasses))} has the "
                    "heading, and no source the positions of the vessel",
                    naming("give the file of her GNSS receiver, or platform = {{ mmsi = … }} in its {description}"),
                )
            raise InputError(
                f"{description.name}: its bearings are relative to the bow, and no source gives the heading",
                naming(
                    "give the heading in a column own_heading, or the source that has it: platform = {{ source = … }} "
                    "in its {description}"
                ),
            )
        return reports, ()
    steps = []
    if reports.station_lat_deg is None and reports.station_x_m is None:
        steps.append(_placed)
    if reports.relative_bearing_deg is not None:
        steps.append(_turned)
    vessel = _reports_of(platform, description.name, others) if steps else []
    compass = _compass(platform, others) if steps else []
    if reports.position == "local" and steps and vessel[0].lat_deg is not None:
        reports = _from_ship(reports)
        notes.append(f"{description.name}: x and y are read as metres east and north of the {platform}")
    # She was there when they were measured, not when they were stamped.
    late_s = description.timing.latency_s or 0.0
    reports = replace(reports, time_s=reports.time_s - late_s)
    for step in steps:
        if len(reports):
            reports, of_step = step(description.name, platform, vessel, compass or vessel, reports)
            notes += of_step
    return replace(reports, time_s=reports.time_s + late_s), tuple(notes)


#: The kind of reports of the positions of a ship by her own receivers.
OWN_POSITIONS = "own ship"


def needs_place(description: Description, reports: Reports) -> bool:
    """Whether reports are measured from a sensor whose place neither they nor the description state: ranges, bearings,
    or positions of plots that a radar must have computed from these."""
    if reports.relative_bearing_deg is not None:
        return True
    if reports.station_lat_deg is not None or reports.station_x_m is not None or description.site is not None:
        return False
    is_radar = {"errors.range_m", "resolution.range_m"} <= KINDS[description.kind].defaults.keys()
    plots = is_radar and reports.object_ids is None and reports.covariance_m2 is None
    return reports.position in ("polar", "bearing") or plots


def _from_ship(reports: Reports) -> Reports:
    """Positions in metres east and north of the ship as ranges and bearings."""
    east, north = np.asarray(reports.x_m), np.asarray(reports.y_m)
    bearing_deg = np.mod(np.degrees(np.arctan2(east, north)), 360.0)
    return replace(reports, x_m=None, y_m=None, range_m=np.hypot(east, north), bearing_deg=bearing_deg)


def _only_ship(sensor: str, others: Mapping[str, Sequence[Reports]]) -> Platform | None:
    """The ship of the only source with own ship's positions; None if there is none, or several."""
    found = [name for name, parts in others.items() if name != sensor and any(map(gives_own_ship, parts))]
    return Platform(source=found[0]) if len(found) == 1 else None


def gives_own_ship(part: Reports) -> bool:
    """Whether reports have the positions of own ship: they are hers, or her log's."""
    return part.kind == OWN_POSITIONS or part.own_ship is not None


Step = tuple[Reports, list[str]]


def _placed(sensor: str, platform: Platform, vessel: list[Reports], compass: list[Reports], reports: Reports) -> Step:
    """The reports with the position of the vessel, where it is known, and notes."""
    names = ("lat_deg", "lon_deg") if vessel[0].lat_deg is not None else ("x_m", "y_m")
    time_s, place = _series(vessel, names)
    known, at = _interpolated(time_s, place, reports.time_s, PLATFORM_GAP_S, PLATFORM_AHEAD_S)
    if not known.any():
        raise InputError(
            f"{sensor}: the {platform}, which carries it, has no position at the times of its {len(reports)} "
            f"reports; it has {len(time_s)} at other times",
            "is one of the two clocks in another time zone, or of another day?",
        )
    latitude_or_x, longitude_or_y = STATION[names]
    out = replace(reports, **{latitude_or_x: at[:, 0], longitude_or_y: at[:, 1]})  # type: ignore[arg-type]
    if out.station_heading_deg is None and out.relative_bearing_deg is None:
        # Bearings that look to be from the bow are doubted.
        _, _, heading_deg = _headings(compass, reports.time_s)
        out = replace(out, station_heading_deg=heading_deg if np.isfinite(heading_deg).any() else None)
    return _where(known, out, sensor, f"where the {platform} was at their times is not known")


def _turned(sensor: str, platform: Platform, vessel: list[Reports], compass: list[Reports], reports: Reports) -> Step:
    """The reports with bearings from north, where the heading of the vessel is known, and notes."""
    notes: list[str] = []
    column, count, heading_deg = _headings(compass, reports.time_s)
    known = np.isfinite(heading_deg)
    if not known.any():
        raise InputError(
            f"{sensor}: its bearings are relative to the bow of the {platform}, which has no heading at the times of "
            f"its {len(reports)} reports; it has {count} at other times",
            naming("give the heading in a column own_heading, or a source that has it in the {description}"),
        )
    if column == "course_deg":
        notes.append(f"{sensor}: the course of the {platform} is used as its heading, which no report has")
    bearing_deg = np.mod(np.asarray(reports.relative_bearing_deg) + heading_deg, 360.0)
    out = replace(reports, bearing_deg=bearing_deg, relative_bearing_deg=None, station_heading_deg=heading_deg)
    kept, set_aside = _where(known, out, sensor, f"the heading of the {platform} at their times is not known")
    return kept, notes + set_aside


def _where(known: BoolArray, reports: Reports, sensor: str, reason: str) -> Step:
    """The reports of the known rows, and a note that counts the others."""
    if known.all():
        return reports, []
    return reports.where(known), [f"{sensor}: {int((~known).sum())} of {len(reports)} reports are set aside: {reason}"]


def _headings(vessel: list[Reports], wanted_s: FloatArray) -> tuple[str, int, FloatArray]:
    """The column of the headings, their number, and (n,) the heading at each time, NaN where it is not known.

    A vessel without headings heads along its course while it is under way.
    """
    column = "heading_deg"
    time_s, heading_deg = _series(vessel, (column,))
    if not len(time_s):
        column = "course_deg"
        time_s, heading_deg = _series([_under_way(part) for part in vessel], (column,))
    if not len(time_s):
        return column, 0, np.full(len(wanted_s), np.nan)
    # A heading is not continued beyond the last: of two a second apart, errors of a degree are a turn.
    gap_s, ahead_s = PLATFORM_HEADING_GAP_S, PLATFORM_AHEAD_S
    _, at = _interpolated(time_s, heading_deg, np.minimum(wanted_s, time_s[-1]), gap_s, ahead_s)
    return column, len(time_s), np.where(wanted_s <= time_s[-1] + ahead_s, np.mod(at[:, 0], 360.0), np.nan)


def _under_way(reports: Reports) -> Reports:
    """The reports fast enough for the course to be the heading, nearly."""
    velocity = reports.velocity_m_per_s()
    if velocity is None:
        return reports
    with np.errstate(invalid="ignore"):
        return reports.where(np.hypot(*velocity.T) >= PLATFORM_COURSE_M_PER_S)


def only_carries(source: str, reports: Reports, descriptions: Iterable[Description]) -> bool:
    """Whether a source gives the position or the heading of a vessel that carries sensors, and names no object: it is
    no sensor."""
    platforms = (description.platform for description in descriptions)
    carries = reports.kind in (OWN_POSITIONS, OWN_HEADING) or any(
        one is not None and one.source == source for one in platforms
    )
    return reports.object_ids is None and carries


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
        tracks = [part.own_ship for part in parts if part.own_ship is not None]
        own = [track for track in tracks if platform.mmsi is None or _is_of(platform, track).any()]
        own = own or [part.where(_is_of(platform, part)) for part in parts]
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


def _compass(platform: Platform, others: Mapping[str, Sequence[Reports]]) -> list[Reports]:
    """The reports of the vessel's compass, if it has a source of its own.

    Raises InputError: there are several.
    """
    found = {name: list(parts) for name, parts in others.items() if any(part.kind == OWN_HEADING for part in parts)}
    if len(found) > 1:
        raise InputError(
            f"the heading of the {platform} is in {listed(tuple(found))}", "give the file of one compass only"
        )
    return next(iter(found.values()), [])


def _is_of(platform: Platform, reports: Reports) -> BoolArray:
    """(n,) whether each report is of the vessel."""
    if platform.mmsi is None:
        return np.ones(len(reports), bool)
    if reports.mmsi is None:
        return np.zeros(len(reports), bool)
    return np.asarray(reports.mmsi == platform.mmsi)


def _series(parts: Sequence[Reports], names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """(k,) times, ascending, and (k, v) values of the columns at these, those of angles without jumps of a turn."""
    parts = [part for part in parts if all(getattr(part, name) is not None for name in names)]
    time_s = np.concatenate([np.empty(0), *(part.time_s for part in parts)])
    columns = [np.concatenate([np.empty(0), *(getattr(part, name) for part in parts)]) for name in names]
    values = np.column_stack(columns)
    usable = np.isfinite(values).all(axis=1) & np.isfinite(time_s)
    time_s, first = np.unique(time_s[usable], return_index=True)
    values = values[usable][first]
    for k, name in enumerate(names):
        if name in ("lon_deg", "heading_deg", "course_deg"):
            values[:, k] = np.unwrap(values[:, k], period=360.0)
    return time_s, values


def _interpolated(
    time_s: FloatArray, values: FloatArray, wanted_s: FloatArray, gap_s: float, ahead_s: float
) -> tuple[BoolArray, FloatArray]:
    """(n,) whether the values are known at each wanted time, and (n, v) the values, NaN where they are not.

    time_s, values : (k,) and (k, v). gap_s, ahead_s : longest time between two values on whose line one is, and beyond
    all or from the nearest one.
    """
    out = np.full((len(wanted_s), values.shape[1]), np.nan)
    if len(time_s) == 0:
        return np.zeros(len(wanted_s), bool), out
    if len(time_s) == 1:
        known = np.abs(wanted_s - time_s[0]) <= ahead_s
        out[known] = values[0]
        return known, out
    after = np.clip(np.searchsorted(time_s, wanted_s), 1, len(time_s) - 1)
    width = time_s[after] - time_s[after - 1]
    beyond = np.maximum(time_s[after - 1] - wanted_s, wanted_s - time_s[after])
    close = width <= gap_s
    known = np.where(close, beyond <= ahead_s, False)
    # Between two positions far apart in time, a time next to one of them.
    nearest = np.where(wanted_s - time_s[after - 1] < time_s[after] - wanted_s, after - 1, after)
    beside = ~close & (np.abs(wanted_s - time_s[nearest]) <= ahead_s)
    share = (wanted_s - time_s[after - 1]) / width
    line = values[after - 1] + share[:, None] * (values[after] - values[after - 1])
    out[known], out[beside] = line[known], values[nearest[beside]]
    return known | beside, out
