"""A static chart of a picture at one instant, for a report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.maps.outline import Outline, outline
from sameas.maps.sheet import MapSensor, MapSheet, members_of, seen_by_several
from sameas.plots.sheet import FAINT, INK, ellipse, nice_length, sheet
from sameas.representation import count, counted
from sameas.tracks.coordinates import MILE_M, LocalPlane

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The graticule of a part of a plane, or a grid of metres if the plane has no position on the earth.

#: Spacings of the lines, minutes of arc.
STEPS = (0.01, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800)
#: Metres per minute of latitude.
MINUTE_M = 1853.0
#: Points per line.
POINTS = 49
#: Latitude of the northernmost and southernmost lines, degrees.
LAST_DEG = 89.9


@dataclass(frozen=True)
class GridLine:
    """A line of the grid.

    points : (n, 2) metres in the plane. parallel : of constant latitude or y, else of constant longitude or x.
    """

    points: FloatArray
    words: str
    parallel: bool


def graticule(
    plane: LocalPlane | None, west_m: float, south_m: float, east_m: float, north_m: float, lines: int = 5
) -> list[GridLine]:
    """About ``lines`` lines in each direction over a box; a grid of metres if ``plane`` is None.

    >>> [line.words for line in graticule(None, 0.0, 0.0, 1000.0, 400.0) if not line.parallel]
    ['x 0 m', 'x 200 m', 'x 400 m', 'x 600 m', 'x 800 m', 'x 1000 m']
    """
    if plane is None:
        return _metres(west_m, south_m, east_m, north_m, lines)
    x, y = np.meshgrid(np.linspace(west_m, east_m, 9), np.linspace(south_m, north_m, 9))
    lat, lon = plane.to_geodetic(np.column_stack([x.ravel(), y.ravel()]))
    turn = (lon - plane.lon_deg + 180.0) % 360.0 - 180.0
    low, high, first, last = lat.min(), lat.max(), turn.min(), turn.max()
    for pole in (-90.0, 90.0):
        if abs(plane.lat_deg - pole) < 20.0 and _contains_pole(plane, pole, (west_m, south_m, east_m, north_m)):
            low, high, first, last = min(low, pole), max(high, pole), -180.0, 180.0
    wide = max(east_m - west_m, north_m - south_m) / lines / MINUTE_M
    up = next((step for step in STEPS if step >= wide), STEPS[-1]) / 60.0
    shrunk = max(np.cos(np.radians(plane.lat_deg)), 0.03)
    across = next((step for step in STEPS if step * shrunk >= wide), STEPS[-1]) / 60.0
    grid = []
    for value in np.arange(np.ceil(max(low, -LAST_DEG) / up), np.floor(min(high, LAST_DEG) / up) + 1) * up:
        along = plane.lon_deg + np.linspace(first, last, POINTS)
        grid.append(GridLine(plane.enu(np.full(POINTS, value), along)[:, :2], _words(value, "NS", 2, up), True))
    start, stop = plane.lon_deg + first, plane.lon_deg + last
    for value in np.arange(np.ceil(start / across), np.ceil(stop / across) + (last - first < 360.0)) * across:
        up_to = np.linspace(max(low, -LAST_DEG), min(high, LAST_DEG), POINTS)
        east = (value + 180.0) % 360.0 - 180.0
        grid.append(GridLine(plane.enu(up_to, np.full(POINTS, value))[:, :2], _words(east, "EW", 3, across), False))
    return grid


def _contains_pole(plane: LocalPlane, pole: float, box: tuple[float, float, float, float]) -> bool:
    x, y, _ = plane.enu(np.array([pole]), np.array([0.0]))[0]
    return bool(box[0] < x < box[2] and box[1] < y < box[3])


def _words(degrees: float, letters: str, width: int, step: float) -> str:
    """An angle as 50°46′N, with as many decimals of a minute as the step needs."""
    digits = next((d for d in (0, 1) if abs(step * 60 * 10**d - round(step * 60 * 10**d)) < 1e-6), 2)
    minutes = round(abs(degrees) * 60.0, digits)
    whole = int(minutes // 60)
    wide = 3 + digits if digits else 2
    return f"{whole:0{width}d}°{minutes - 60 * whole:0{wide}.{digits}f}′{letters[int(degrees < 0)]}"


def _metres(west: float, south: float, east: float, north: float, lines: int) -> list[GridLine]:
    power = 10.0 ** np.floor(np.log10(max(east - west, north - south) / lines))
    step = next(s * power for s in (1, 2, 5, 10) if s * power * lines >= max(east - west, north - south) * 0.999)
    unit, word = (1000.0, "km") if step >= 1000 else (1.0, "m")
    grid = []
    for value in np.arange(np.ceil(west / step), np.floor(east / step) + 1) * step:
        grid.append(GridLine(np.array([[value, south], [value, north]]), f"x {value / unit:g} {word}", False))
    for value in np.arange(np.ceil(south / step), np.floor(north / step) + 1) * step:
        grid.append(GridLine(np.array([[west, value], [east, value]]), f"y {value / unit:g} {word}", True))
    return grid


#: Colours and marks of sources, as on the page in day colours.
COLOURS = ("#0067a5", "#007a58", "#a8407e", "#7a6200", "#5a45a8", "#2f8fc4", "#5c5c5c")
MARKS, OWN_MARK = ("s", "D", "o", "x", "+", "v", "_"), "^"
SEA, LAND, COAST, BORDER, GRID, RING, DOUBT, ALARM = (
    "#e4eef4", "#efe7cd", "#9c8d62", "#b9ac86", "#c2d2dd", "#5f8aa8", "#a84300", "#b3121f",
)  # fmt: skip
#: Lengths of course vectors, seconds.
AHEAD_S = (1, 2, 5, 10, 30, 60, 180, 360, 720, 1800, 3600)
WIDTH_IN = 11.0
#: West, south, east and north in metres.
Box = tuple[float, float, float, float]
#: Maximum number of labels.
MAX_LABELS = 200
#: Line of objects that are not confirmed, or coast, and opacity of the mark of tentative ones.
TENTATIVE_LINE, TENTATIVE_ALPHA = (0, (4, 2.5)), 0.6


def chart(drawn: MapSheet, instant_s: float | None = None) -> Figure:
    """A chart of objects with courses, ellipses and records, on coast and grid.

    instant_s : the nearest instant of the sheet is drawn; None: the last.

    Raises InputError: matplotlib is not installed.

    >>> from sameas.plots import save
    >>> save(chart(shown), "map.png")  # doctest: +SKIP
    """
    k = len(drawn.instants_s) - 1 if instant_s is None else drawn.nearest(instant_s)
    now = _Snapshot.of(drawn, k)
    box = _box(drawn)
    # The chart fills the width; 1.7 inches of height are for title and legend.
    height_in = WIDTH_IN * (box[3] - box[1]) / (box[2] - box[0]) + 1.7
    figure = sheet(f"{drawn.title}: {now.finding}", now.time, WIDTH_IN, height_in)
    axes = _frame(figure, box)
    _ground(axes, drawn, box)
    for number, sensor in enumerate(drawn.sensors):
        _coverage(axes, sensor, COLOURS[number % len(COLOURS)])
    _rings(axes, drawn, box)
    ahead_s = _ahead_s(now, box)
    _records(axes, now)
    _objects(axes, now, ahead_s)
    _labels(axes, now, box)
    _scale(axes, box)
    _legend(figure, now, ahead_s)
    return figure


class _Snapshot:
    """One instant of a sheet.

    rows : of its objects. marks : rows of its records. row_of : row of each object by its number.
    """

    def __init__(self, drawn: MapSheet, rows: IntArray, marks: IntArray, time_s: float) -> None:
        self.drawn, self.rows, self.marks, self.time_s = drawn, rows, marks, time_s
        self.row_of = {int(drawn.objects["object"][row]): int(row) for row in rows}
        self.alarmed = {
            n
            for a in drawn.alarms
            if a.time_s is None or drawn.nearest(a.time_s) == drawn.nearest(time_s)
            for n in a.objects
        }

    @classmethod
    def of(cls, drawn: MapSheet, k: int) -> _Snapshot:
        o, r = drawn.objects, drawn.records
        present = (drawn.instant_of(o) == k) & (o["stage"] != "ended") & np.isfinite(o["x_m"].astype(np.float64))
        return cls(drawn, np.flatnonzero(present), np.flatnonzero(drawn.instant_of(r) == k), float(drawn.instants_s[k]))

    @property
    def finding(self) -> str:
        o = self.drawn.objects
        doubtful, several = int(o["ambiguous"][self.rows].sum()), int(seen_by_several(o)[self.rows].sum())
        words = counted(len(self.rows), "object")
        if len(np.unique(self.drawn.records["source"])) > 1:
            words += f", {count(several)} seen by two or more sources"
        return words + (f", {count(doubtful)} ambiguous" if doubtful else "")

    @property
    def time(self) -> str:
        if not self.drawn.utc:
            return f"{self.time_s:g} s"
        words = datetime.fromtimestamp(self.time_s, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")[:-4]
        return f"{words.removesuffix('.00')} UTC"

    def state(self, row: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position (2,) m, velocity (2,) m/s and position covariance (2, 2) m² of an object."""
        o = self.drawn.objects
        a, b, c = (o[name][row] for name in ("var_x_m2", "cov_xy_m2", "var_y_m2"))
        place = np.array([o["x_m"][row], o["y_m"][row]], np.float64)
        velocity = np.array([o["vx_m_per_s"][row], o["vy_m_per_s"][row]], np.float64)
        return place, velocity, np.array([[a, b], [b, c]], np.float64)

    def mark_of(self, r: int) -> FloatArray | None:
        """Where a record is drawn: at its position, or at the point of its ray nearest to its object."""
        m, owner = self.drawn.records, self.row_of.get(int(self.drawn.records["object"][r]))
        if np.isfinite(m["x_m"][r]):
            return np.array([m["x_m"][r], m["y_m"][r]], np.float64)
        if owner is None or not np.isfinite(m["sensor_x_m"][r]):
            return None
        angle, site = np.radians(m["bearing_deg"][r]), np.array([m["sensor_x_m"][r], m["sensor_y_m"][r]])
        along = np.array([np.sin(angle), np.cos(angle)])
        return np.asarray(site + max(float((self.state(owner)[0] - site) @ along), 0.0) * along)


def _box(drawn: MapSheet) -> Box:
    """West, south, east and north around sites and confirmed objects of all times; height 0.6 to 0.83 of the width."""
    west, south, east, north = drawn.home()
    pad = 0.06 * max(east - west, north - south)
    half_x, half_y = (east - west) / 2.0 + pad, (north - south) / 2.0 + pad
    half_x, half_y = max(half_x, 1.2 * half_y), max(half_y, 0.6 * half_x)
    x, y = (west + east) / 2.0, (south + north) / 2.0
    return x - half_x, y - half_y, x + half_x, y + half_y


def _frame(figure: Figure, box: Box) -> Axes:
    axes = figure.subplots()
    axes.set_xlim(box[0], box[2])
    axes.set_ylim(box[1], box[3])
    axes.set_aspect("equal")
    axes.set_facecolor(SEA)
    axes.tick_params(length=0, labelsize=8.5, labelcolor=FAINT)
    for spine in axes.spines.values():
        spine.set_color(FAINT)
    return axes


def _ground(axes: Axes, drawn: MapSheet, box: Box) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    lines = Outline()
    if drawn.plane is not None:
        lines = outline(drawn.plane, *box) if drawn.ground is None else drawn.ground.within(*box)
        credit = "coast: Natural Earth, ± 1 km, not for navigation" if drawn.ground is None else ""
        axes.text(0.006, 0.008, credit, transform=axes.transAxes, fontsize=7.5, color="#5c6b76", zorder=3)
    if lines.land:
        # One path: separate ones would show seams between adjacent cells.
        path = Path.make_compound_path(*(Path(np.vstack([ring, ring[:1]]), closed=True) for ring in lines.land))
        axes.add_patch(PathPatch(path, facecolor=LAND, edgecolor="none", zorder=0.1))
    for line in lines.coast:
        axes.plot(*line.T, color=COAST, lw=0.8, zorder=0.3)
    for line in lines.borders:
        axes.plot(*line.T, color=BORDER, lw=0.8, ls=(0, (6, 3)), zorder=0.3)
    ticks: dict[bool, list[tuple[float, str]]] = {True: [], False: []}
    for each in graticule(drawn.plane, *box):
        axes.plot(*each.points.T, color=GRID, lw=0.7, zorder=0.2)
        place = _crossing(each, box)
        if place is not None:
            ticks[each.parallel].append((place, each.words))
    axes.set_xticks([place for place, _ in ticks[False]], [words for _, words in ticks[False]])
    axes.set_yticks([place for place, _ in ticks[True]], [words for _, words in ticks[True]], rotation=90, va="center")


def _crossing(line: GridLine, box: Box) -> float | None:
    """Where a parallel crosses the left side of the frame, or a meridian the lower side; None if it does not."""
    axis, limit = (0, box[0]) if line.parallel else (1, box[1])
    across = line.points[:, axis] - limit
    sides = np.flatnonzero(across[:-1] * across[1:] <= 0)
    if not len(sides):
        return None
    k = int(sides[0])
    share = across[k] / (across[k] - across[k + 1]) if across[k] != across[k + 1] else 0.0
    place = line.points[k] + share * (line.points[k + 1] - line.points[k])
    other = float(place[1 - axis])
    low, high = (box[1], box[3]) if line.parallel else (box[0], box[2])
    return other if low <= other <= high else None


def _coverage(axes: Axes, sensor: MapSensor, colour: str) -> None:
    """The coverage of a sensor, and its site."""
    from matplotlib.patches import Wedge

    if sensor.x_m is None or sensor.y_m is None:
        return
    if sensor.range_m is not None:
        for start, stop in sensor.visible_deg:
            # Matplotlib counts angles anticlockwise from east.
            site, width = (sensor.x_m, sensor.y_m), sensor.range_m - sensor.nearest_m
            wedge = Wedge(
                site, sensor.range_m, 90.0 - stop, 90.0 - start, width=width, facecolor="none", edgecolor=colour,
                ls=(0, (7, 4)), lw=0.8, alpha=0.6, zorder=0.4,
            )  # fmt: skip
            axes.add_patch(wedge)
    axes.plot(sensor.x_m, sensor.y_m, marker="1", color=colour, ms=12, mew=1.8, zorder=2.0)
    axes.annotate(
        sensor.name, (sensor.x_m, sensor.y_m), (0, -11), textcoords="offset points", ha="center", va="top",
        fontsize=8.5, color=colour, annotation_clip=True,
    )  # fmt: skip


def _rings(axes: Axes, drawn: MapSheet, box: Box) -> None:
    """Range rings around the first sensor with a site, in nautical miles, or in metres for small charts."""
    from matplotlib.patches import Circle

    site = next(((s.x_m, s.y_m) for s in drawn.sensors if s.x_m is not None and s.y_m is not None), None)
    if site is None:
        return
    wanted = (box[2] - box[0]) / 6.0
    unit, words = (MILE_M, "nm") if wanted > 0.2 * MILE_M else (1.0, "m")
    step = nice_length(wanted / unit)
    for k in range(1, 7):
        radius = k * step * unit
        axes.add_patch(Circle(site, radius, fill=False, ec=RING, lw=0.6, alpha=0.7, zorder=0.35))
        axes.text(
            site[0], site[1] + radius, f"{k * step:g} {words}", fontsize=7.5, color=RING, ha="center", va="center",
            clip_on=True, zorder=0.5, bbox={"facecolor": SEA, "edgecolor": "none", "pad": 0.8, "alpha": 0.7},
        )  # fmt: skip


def marks_of(sensors: tuple[MapSensor, ...]) -> list[str]:
    """A mark for each source: triangles for AIS and ADS-B, which report their own position."""
    other_marks = iter(MARKS * (1 + len(sensors)))
    return [OWN_MARK if sensor.kind in ("ais", "ads-b") else next(other_marks) for sensor in sensors]


def _records(axes: Axes, now: _Snapshot) -> None:
    from matplotlib.collections import LineCollection

    r, marks = now.drawn.records, marks_of(now.drawn.sensors)
    for number, sensor in enumerate(now.drawn.sensors):
        colour, mark = COLOURS[number % len(COLOURS)], marks[number]
        own = now.marks[r["source"][now.marks] == sensor.name]
        places = [(int(row), place) for row in own if (place := now.mark_of(int(row))) is not None]
        rays, member_lines = [], []
        for row, place in places:
            owner = now.row_of.get(int(r["object"][row]))
            if np.isfinite(r["bearing_deg"][row]):
                rays.append(np.stack([np.array([r["sensor_x_m"][row], r["sensor_y_m"][row]]), place]))
            if owner is not None:
                member_lines.append(np.stack([now.state(owner)[0], place]))
        axes.add_collection(LineCollection(rays, color=colour, lw=0.6, alpha=0.6, zorder=1.0), autolim=False)
        axes.add_collection(LineCollection(member_lines, color=colour, lw=0.9, zorder=1.2), autolim=False)
        face = colour if mark in "x+_" else "none"
        points = np.reshape([place for _, place in places], (-1, 2))
        axes.plot(*points.T, ls="", marker=mark, ms=5.0, mew=1.1, mec=colour, mfc=face, zorder=1.6)
    axes.add_collection(
        LineCollection(list(_rival_lines(now)), color=DOUBT, lw=1.2, ls=(0, (4, 3)), zorder=1.3), autolim=False
    )


def _rival_lines(now: _Snapshot) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Lines from ambiguous objects to the records of their runner-up that are not theirs."""
    r, o = now.drawn.records, now.drawn.objects
    row_of = {(str(r["source"][k]), int(r["row"][k])): int(k) for k in now.marks}
    for row in now.rows[o["ambiguous"][now.rows].astype(bool)]:
        for member in members_of(str(o["runner_up"][row])):
            mark = row_of.get(member)
            if mark is not None and r["object"][mark] != o["object"][row]:
                end = now.mark_of(mark)
                if end is not None:
                    yield now.state(int(row))[0], end


def _objects(axes: Axes, now: _Snapshot, ahead_s: float) -> None:
    """Symbols like those of tracked radar targets: pale while tentative, crossed while coasting."""
    o = now.drawn.objects
    rows_by_style: dict[tuple[str, str], list[int]] = {}
    for row in now.rows.tolist():
        colour = ALARM if int(o["object"][row]) in now.alarmed else DOUBT if o["ambiguous"][row] else INK
        stage = str(o["stage"][row])
        rows_by_style.setdefault((FAINT if stage == "coasting" and colour == INK else colour, stage), []).append(row)
    for (colour, stage), rows in rows_by_style.items():
        _objects_of_style(axes, now, ahead_s, colour, stage, rows)
    ambiguous = [now.state(row)[0] for row in now.rows.tolist() if o["ambiguous"][row]]
    axes.plot(*np.reshape(ambiguous, (-1, 2)).T, ls="", marker="o", ms=15, mfc="none", mec=DOUBT, mew=0.9, zorder=2.1)
    alarmed = [now.state(row)[0] for row in now.rows.tolist() if int(o["object"][row]) in now.alarmed]
    axes.plot(*np.reshape(alarmed, (-1, 2)).T, ls="", marker="^", ms=22, mfc="none", mec=ALARM, mew=1.3, zorder=2.2)


def _objects_of_style(axes: Axes, now: _Snapshot, ahead_s: float, colour: str, stage: str, rows: Sequence[int]) -> None:
    """Objects of one colour and stage, as few collections: thousands of artists take minutes to draw."""
    from matplotlib.collections import LineCollection

    places, velocities, covariances = map(np.array, zip(*(now.state(row) for row in rows), strict=True))
    has_covariance, has_velocity = np.isfinite(covariances).all(axis=(1, 2)), np.isfinite(velocities).all(axis=1)
    outlines = [
        ellipse(*each, 2.0, 61) for each in zip(places[has_covariance], covariances[has_covariance], strict=True)
    ]
    axes.add_collection(LineCollection(outlines, color=colour, lw=0.8, alpha=0.7, zorder=1.1), autolim=False)
    style = "-" if stage == "confirmed" else TENTATIVE_LINE
    vectors = np.stack([places, places + ahead_s * velocities], axis=1)[has_velocity]
    axes.add_collection(LineCollection(vectors, color=colour, lw=1.3, ls=style, zorder=1.8), autolim=False)
    axes.plot(*places.T, ls="", marker="o", ms=9.5, mfc="none", mec=colour, mew=1.4 if stage == "confirmed" else 1.0,
              zorder=2.1, alpha=TENTATIVE_ALPHA if stage == "tentative" else 1.0)  # fmt: skip
    if stage == "coasting":
        axes.plot(*places.T, ls="", marker="x", ms=6, mec=colour, mew=1.0, zorder=2.1)
    else:
        several = seen_by_several(now.drawn.objects)[rows]
        axes.plot(*places[several].T, ls="", marker="o", ms=2.6, mfc=colour, mec="none", zorder=2.1)


def _labels(axes: Axes, now: _Snapshot, box: Box) -> None:
    """Names where there is room, those of alarms and ambiguous objects first."""
    from matplotlib.patheffects import withStroke

    o = now.drawn.objects
    important = [int(o["object"][row]) in now.alarmed or bool(o["ambiguous"][row]) for row in now.rows]
    metres_per_point = (box[2] - box[0]) / (9.2 * 72.0)
    taken = [np.concatenate([p - 6 * metres_per_point, p + 6 * metres_per_point])
             for p in (now.state(int(row))[0] for row in now.rows)]  # fmt: skip
    for k in np.argsort(~np.array(important, bool), kind="stable")[:MAX_LABELS]:
        row = int(now.rows[k])
        words = str(o["label"][row])[:24] or f"#{o['object'][row]}"
        size = np.array([5.4 * len(words), 11.0]) * metres_per_point
        place = now.state(row)[0]
        ahead = -1 if o["vx_m_per_s"][row] > 0 else 1
        for side, up in ((1, -0.5), (-1, -0.5), (1, 0.4), (1, -1.4), (-1, 0.4), (-1, -1.4)):
            right = side * ahead
            aside = 9.0 * metres_per_point * right - (size[0] if right < 0 else 0.0)
            corner = place + np.array([aside, up * size[1]])
            spot = np.concatenate([corner, corner + size])
            if _free(spot, taken) and box[0] < spot[0] and spot[2] < box[2]:
                taken.append(spot)
                axes.text(
                    corner[0], corner[1] + size[1] / 2, words, fontsize=8.5, va="center", zorder=3, clip_on=True,
                    color=DOUBT if o["ambiguous"][row] else INK, parse_math=False,
                    path_effects=[withStroke(linewidth=2.2, foreground="white")],
                )  # fmt: skip
                break


def _free(spot: FloatArray, taken: list[FloatArray]) -> bool:
    return all(spot[0] >= t[2] or spot[2] <= t[0] or spot[1] >= t[3] or spot[3] <= t[1] for t in taken)


def _ahead_s(now: _Snapshot, box: Box) -> float:
    """Length of course vectors, s: for fast objects a tenth of the chart, shorter if there are many objects."""
    speed = np.array([np.hypot(*now.state(int(row))[1]) for row in now.rows])
    moving = speed[speed > 0.5]
    share = min(0.1, 1.0 / np.sqrt(max(len(now.rows), 1)))
    wanted = share * (box[2] - box[0]) / float(np.quantile(moving, 0.9)) if len(moving) else 60.0
    return float(min(AHEAD_S, key=lambda s: abs(np.log(s / wanted))))


def _scale(axes: Axes, box: Box) -> None:
    """Scale bars in metres and nautical miles, and a north arrow."""
    wide, high = box[2] - box[0], box[3] - box[1]
    metres, miles = nice_length(wide / 5.0), nice_length(wide / 5.0 / MILE_M)
    bars = [(metres, f"{metres / 1e3:g} km" if metres >= 1e3 else f"{metres:g} m")]
    if miles >= 0.1:
        bars.append((miles * MILE_M, f"{miles:g} nm"))
    right = box[2] - 0.025 * wide
    for k, (length, words) in enumerate(bars):
        y = box[1] + (0.02 + 0.035 * k) * high
        axes.plot([right - length, right], [y, y], color=INK, lw=2.0, solid_capstyle="butt", zorder=3)
        axes.text(
            right - length / 2, y + 0.004 * high, words, ha="center", va="bottom", fontsize=8.5, color=INK, zorder=3
        )
    x, y = box[2] - 0.03 * wide, box[3] - 0.035 * high
    axes.annotate("", (x, y), (x, y - 0.06 * high), arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.2}, zorder=3)
    axes.text(x, y + 0.004 * high, "N", ha="center", va="bottom", fontsize=10, fontweight="bold", color=INK, zorder=3)


def _legend(figure: Figure, now: _Snapshot, ahead_s: float) -> None:
    from matplotlib.lines import Line2D

    r, marks = now.drawn.records, marks_of(now.drawn.sensors)
    handles = []
    for number, sensor in enumerate(now.drawn.sensors):
        seen = int((r["source"][now.marks] == sensor.name).sum())
        handles.append(Line2D([], [], ls="", marker=marks[number], color=COLOURS[number % len(COLOURS)], ms=6,
                              mfc="none", label=f"{sensor.name} ({count(seen)})"))  # fmt: skip
    ahead = f"{ahead_s / 60:g} min" if ahead_s >= 60 else f"{ahead_s:g} s"
    handles += [
        Line2D([], [], color=INK, marker="o", mfc="none", ms=8, markevery=[0], label=f"object, {ahead} ahead"),
        Line2D([], [], ls="", marker="o", mfc="none", color=INK, ms=12, mew=0.8, alpha=0.7, label="2σ"),
        Line2D([], [], ls="", marker="o", mfc="none", color=DOUBT, ms=9, label="ambiguous"),
        Line2D([], [], ls="", marker="x", color=FAINT, ms=6, label="coasting"),
    ]
    if (now.drawn.objects["stage"][now.rows] == "tentative").any():
        handles.insert(-3, Line2D([], [], color=INK, ls=TENTATIVE_LINE, lw=1.3, marker="o", mfc="none", ms=8, mew=1.0,
                                  markevery=[0], alpha=TENTATIVE_ALPHA, label="tentative"))  # fmt: skip
    if now.alarmed:
        handles.append(Line2D([], [], ls="", marker="^", mfc="none", color=ALARM, ms=9, label="alarm"))
    # Long names of sources need fewer columns.
    for columns in range(min(len(handles), 8), 0, -1):
        legend = figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()
