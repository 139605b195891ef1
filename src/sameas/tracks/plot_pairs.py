"""Pairs of a radar's plots with tracks, and the density of other plots at each, for the offsets of the radar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ColumnTable, FloatArray, IntArray
from sameas.ragged import flattened
from sameas.registration.offsets import RADIAN, line_of_sight, range_and_azimuth
from sameas.tracks.alignment import States, Succession, moved
from sameas.tracks.biases import AZIMUTH, EAST, GAIN, NORTH, RANGE, TIME
from sameas.tracks.duplicate_ids import WAY_M_PER_S
from sameas.tracks.feed import Feed
from sameas.tracks.snapshot import bias_widths
from sameas.tracks.source import CLUTTER, MISSES, MissRate

#: The biases of a radar's plots, in the order of BIASES.
FITTED = (RANGE, AZIMUTH, GAIN, TIME)

AZIMUTH_REACH = 20.0  # the azimuth of bare plots is searched within this many prior widths
#: Gate of plots and tracks in range, and maximum 1σ of the position of a compared track.
GATE_SIGMAS, MAX_SIGMA_M = 3.5, 100.0
#: Blocks of plots that are left out at once while a track is out of reach, and by how many of the largest errors it may
#: be elsewhere than its motion within a block tells.
BLOCKS, BLOCK_SIGMAS = 100, 10.0
OWN_PLATFORM_M = 50.0  # tracks nearer to the sensor than this are excluded, as the sensor's own platform
#: Plots at the same place, between these times before and after a plot, are background: a moving object has left the
#: place by then. ECHO_M is added to the width within which they are counted.
BACKGROUND_FROM_S, BACKGROUND_TO_S, ECHO_M = 40.0, 240.0, 15.0
CLUTTER_CELL_M = 100.0  # width of the cells in which the clutter of a picture is counted
RING_SHARE = 0.03  # the density of plots at a range is that of this share of the plots to either side of it in range
#: Trial factors on the errors of plots, with 1σ of the drift of the azimuth in degrees, if the sensor moves.
PLOT_SPREADS = ((1.0, 0.0), (2.0, 0.0), (1.0, 1.5), (1.0, 3.0))
COMPASS_MOVED_M = 50.0  # a sensor that moves at least so far has a drift of its azimuth (chosen)
#: Mean numbers of plots of a track per scan, averaged over.
PLOT_RATES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
#: Probability that another object accompanies a track; it limits the evidence of one track to −ln COMPANION.
COMPANION = 3e-4
#: Shares of the tracks that a radar sees, averaged over: it does not see boats in a marina, behind land or far off.
SEEN_SHARES = (0.05, 0.15, 0.3, 0.5, 0.7, 0.9)


def shows_bare_plots(feed: Feed) -> bool:
    """Whether a source's offsets are fitted from its plots: positions without ids, from a sensor with unknown
    azimuth bias and no unknown shift."""
    widths = bias_widths(feed)
    return has_bearings(feed) and not shows_tracks(feed) and not (widths[EAST] or widths[NORTH])


def has_bearings(feed: Feed) -> bool:
    """Whether a source gives ranges and bearings from a known place, with an unknown azimuth bias."""
    return isinstance(feed.reports, States) and feed.sensor_m is not None and bool(bias_widths(feed)[AZIMUTH] > 0.0)


def shows_tracks(feed: Feed) -> bool:
    """Whether a source's records are tracks of objects."""
    return isinstance(feed.reports, States) and feed.reports.track is not None


#: 1σ of the constant error of a track of objects without a hull, such as aircraft, metres (chosen; fitted then).
LEAST_LASTING_M = 1.0


@dataclass(frozen=True)
class Plots(ColumnTable):
    """A radar's plots (n,): time, scan, position east and north, position of the sensor, range, azimuth (°).

    variance : (n, 2) m² along and across the line of sight, without the constant errors of an object.
    rows : of the feed's reports.
    """

    time_s: FloatArray
    scan: IntArray
    position: FloatArray
    sensor: FloatArray
    range_m: FloatArray
    azimuth_deg: FloatArray
    variance: FloatArray
    rows: IntArray

    @classmethod
    def of(cls, feed: Feed) -> Plots:
        """The plots of a feed, in order of time."""
        reports = feed.reports
        assert isinstance(reports, States) and feed.sensor_m is not None
        rows = np.flatnonzero(reports.usable & np.isfinite(feed.sensor_m).all(axis=1))
        rows = rows[np.argsort(reports.time_s[rows], kind="stable")]
        position, sensor = reports.state[rows, :2], feed.sensor_m[rows]
        range_m, azimuth, frame = _sight(position - sensor)
        stated = np.einsum("nav,nvw,naw->na", frame, reports.covariance[rows, :2, :2], frame)
        variance = np.maximum(stated - (feed.description.errors.extent_m or 0.0) ** 2, 0.05 * stated)
        scan = np.unique(feed.scan_s[rows], return_inverse=True)[1]
        return cls(reports.time_s[rows], scan, position, sensor, range_m, azimuth, variance, rows)

    def __len__(self) -> int:
        return len(self.time_s)

    def spreads(self) -> list[tuple[float, float]]:
        """The trial factors on their errors, with 1σ of the drift in degrees: none for a fixed sensor."""
        drifts = moves(self.sensor)
        return [spread for spread in PLOT_SPREADS if drifts or not spread[1]]


def azimuth_limit_deg(width_deg: float) -> float:
    """The largest offset of the azimuth that is searched; ``width_deg`` : its prior 1σ."""
    return min(AZIMUTH_REACH * width_deg, 180.0)


def moves(sensor: FloatArray) -> bool:
    """Whether a sensor at these places (n, 2) moves, so that its azimuth drifts with the heading of its vessel."""
    return len(sensor) > 0 and float(np.ptp(sensor, axis=0).max()) >= COMPASS_MOVED_M


def log_prior_of_azimuth(azimuth_deg: FloatArray, width_deg: float) -> FloatArray:
    """(g,) log prior density of azimuth biases, a Cauchy distribution of this width."""
    return np.asarray(-np.log(np.pi * width_deg * (1.0 + (azimuth_deg / width_deg) ** 2)))


def log_mean_over_seen(log_likelihood: FloatArray) -> FloatArray:
    """(…, g) ln of the likelihood of all tracks, averaged over the share of them that the radar sees, from that of each
    track (…, v, g) against not being seen. Two are seen at least, as one alone shows no offset."""
    least = 2.0 / max(log_likelihood.shape[-2], 1)
    shares = [seen for seen in SEEN_SHARES if seen >= least] or SEEN_SHARES[-1:]
    terms = [np.logaddexp(np.log1p(-seen), np.log(seen) + log_likelihood).sum(axis=-2) for seen in shares]
    return np.asarray(np.logaddexp.reduce(terms, axis=0) - np.log(len(shares)))


def _sight(arm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Range (at least 1 m), azimuth (°) and (n, 2, 2) unit vectors along and across (clockwise) lines of sight."""
    range_m, *frame = line_of_sight(arm, 1.0)
    return range_m, range_and_azimuth(arm)[:, 1], np.stack(frame, axis=-2)


@dataclass(frozen=True)
class PlotPairs:
    """Pairs of a plot and a track that are possible under any allowed biases, (m,) each.

    plot, track : their numbers. residual : (m, 2) range (m) and azimuth (as metres across) of the plot minus that of
    the track. jacobian : (m, 2, 4) of the residual by FITTED. variance : (m, 2) m², without the constant errors of a
    track. background : density of other plots at the plot, per m² and scan. scans : (v,) number of scans that may
    detect each track. lasting_m2 : variance per axis of the constant errors of a track. hull : (m, 2, 2) derivatives of
    the residual by the place of the echo along and across the hull (to starboard). frame : (m, 2, 2) unit vectors along
    and across the line of sight.
    """

    plot: IntArray
    track: IntArray
    residual: FloatArray
    jacobian: FloatArray
    variance: FloatArray
    background: FloatArray
    scans: FloatArray
    lasting_m2: float
    hull: FloatArray
    frame: FloatArray

    def variance_without_azimuth(self, widths: FloatArray) -> FloatArray:
        """(m, 2) prior variances of the residual by all biases but the azimuth, of these widths."""
        others = widths[list(FITTED)] * (np.arange(len(FITTED)) != FITTED.index(AZIMUTH))
        return np.einsum("map,p,map->ma", self.jacobian, others**2, self.jacobian)


@dataclass(frozen=True)
class Blocks:
    """Plots in order of time, in blocks (b,) of about equal numbers, as most tracks of a coast are far beyond the reach
    of a radar for most of the time. sizes, first : number and first plot of each block. span_s, moved_m : its seconds,
    and how far the sensor moves in it."""

    plots: Plots
    sizes: IntArray
    first: IntArray
    span_s: FloatArray
    moved_m: FloatArray

    @classmethod
    def of(cls, plots: Plots) -> Blocks:
        bounds = np.linspace(0, len(plots), min(BLOCKS, len(plots)) + 1).astype(np.int64)
        first, last = bounds[:-1], bounds[1:] - 1
        moved = np.maximum.reduceat(plots.sensor, first) - np.minimum.reduceat(plots.sensor, first)
        return cls(plots, np.diff(bounds), first, plots.time_s[last] - plots.time_s[first], np.hypot(*moved.T))

    def within(self, reach_m: float, path: Path) -> IntArray:
        """The plots at whose times a track may be within reach of the sensor."""
        state, _ = path.at(self.plots.time_s[self.first])
        apart_m = np.hypot(*(state[:, :2] - self.plots.sensor[self.first]).T)
        room_m = np.hypot(*state[:, 2:].T) * self.span_s + self.moved_m + BLOCK_SIGMAS * MAX_SIGMA_M
        return np.flatnonzero(np.repeat(apart_m <= reach_m + room_m, self.sizes))


def candidates(plots: Plots, feed: Feed, partners: Sequence[Feed], reach_deg: float | None = None) -> PlotPairs:
    """The candidate pairs of all plots and all tracks of the partners.

    reach_deg : the most by which their azimuths differ; by default the reach of the search.
    """
    widths = bias_widths(feed)
    reach_deg = azimuth_limit_deg(widths[AZIMUTH]) if reach_deg is None else reach_deg
    parts: list[tuple[NDArray[Any], ...]] = []
    scans: list[float] = []
    lasting = max(feed.description.errors.extent_m or 0.0, LEAST_LASTING_M) ** 2
    begins_scan = np.zeros(len(plots), bool)
    begins_scan[first_of_scans(plots)] = True
    reach_m, blocks = feed.description.coverage.range_m or np.inf, Blocks.of(plots)
    for partner in partners:
        lasting = max(lasting, sum((f.description.errors.extent_m or 0.0) ** 2 for f in (feed, partner)))
        for path in _paths(partner):
            rows = blocks.within(reach_m, path)
            state, covariance = path.at(plots.time_s[rows])
            arm = state[:, :2] - plots.sensor[rows]
            range_m, azimuth, frame = _sight(arm)
            along, across = (np.einsum("nv,nvw,nw->n", frame[:, a], covariance[:, :2, :2], frame[:, a]) for a in (0, 1))
            known = np.maximum(along, across) < MAX_SIGMA_M**2
            known &= (range_m > OWN_PLATFORM_M) & (range_m <= reach_m)
            if not known.any():
                continue
            d_azimuth = (plots.azimuth_deg[rows] - azimuth + 180.0) % 360.0 - 180.0
            variance = plots.variance[rows] + np.column_stack([along, across])
            gate_m = GATE_SIGMAS * np.sqrt(
                variance[:, 0] + lasting + widths[RANGE] ** 2 + (widths[GAIN] * range_m) ** 2
            )
            d_range = plots.range_m[rows] - range_m
            near = np.flatnonzero(known & (np.abs(d_range) <= gate_m) & (np.abs(d_azimuth) <= reach_deg))
            velocity = np.einsum("nav,nv->na", frame, state[:, 2:])[near]
            one, zero, r = np.ones(len(near)), np.zeros(len(near)), range_m[near]
            jacobian = np.stack(
                [np.stack([one, zero, r, -velocity[:, 0]], axis=-1),
                 np.stack([zero, RADIAN * r, zero, -velocity[:, 1]], axis=-1)], axis=-2,
            )  # fmt: skip
            residual = np.column_stack([d_range[near], RADIAN * d_azimuth[near] * r])
            hull = frame[near] @ _axes(state[near, 2:])
            track = np.full(len(near), len(scans))
            parts.append((rows[near], track, residual, jacobian, variance[near], hull, frame[near]))
            scans.append(float(np.sum(known & begins_scan[rows])))
    if not sum(len(part[0]) for part in parts):
        none, empty = np.empty(0, np.int64), np.empty((0, 2))
        return PlotPairs(
            none, none, empty, np.empty((0, 2, 4)), empty, np.empty(0), np.empty(0), lasting, np.empty((0, 2, 2)),
            np.empty((0, 2, 2)),
        )  # fmt: skip
    plot, track, residual, jacobian, variance, *axes = (np.concatenate(part) for part in zip(*parts, strict=True))
    in_gate = np.unique(plot)
    background = np.zeros(len(plots))
    background[in_gate] = _background(plots, in_gate)
    return PlotPairs(
        plot, track, residual, jacobian, variance, background[plot], np.array(scans), lasting, *axes
    )  # fmt: skip


def _axes(velocity: FloatArray) -> FloatArray:
    """(n, 2, 2) unit vectors along and across the courses, as columns; north and east for objects without way."""
    speed = np.hypot(*velocity.T)[:, None]
    along = np.where(speed > WAY_M_PER_S, velocity / np.maximum(speed, 1e-9), [0.0, 1.0])
    return np.stack([along, np.column_stack([along[:, 1], -along[:, 0]])], axis=-1)


def first_of_scans(plots: Plots) -> IntArray:
    """(l,) the first plot of each scan."""
    return np.unique(plots.scan, return_index=True)[1]


@dataclass(frozen=True)
class Path:
    """One track's reports in order: times (k,), states (k, 4), covariances (k, 4, 4), motion noise (k,) in m²/s³."""

    time_s: FloatArray
    state: FloatArray
    covariance: FloatArray
    walk: FloatArray

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States and covariances at any times: the weighted mean of the reports before and after, moved there."""
        after = np.searchsorted(self.time_s, time_s, side="right")
        before, after = np.maximum(after - 1, 0), np.minimum(after, len(self.time_s) - 1)
        ends = [
            moved(self.state[k], self.covariance[k], time_s - self.time_s[k], self.walk[k]) for k in (before, after)
        ]
        # The weights are the precisions of the two moved positions.
        precision = [1.0 / np.einsum("nvv->n", covariance[:, :2, :2]) for _, covariance in ends]
        share = precision[0] / (precision[0] + precision[1])
        state = share[:, None] * ends[0][0] + (1.0 - share)[:, None] * ends[1][0]
        return state, share[:, None, None] * ends[0][1] + (1.0 - share)[:, None, None] * ends[1][1]


def _paths(feed: Feed) -> list[Path]:
    """The tracks of a source."""
    reports = feed.reports
    assert isinstance(reports, States) and reports.track is not None
    usable = np.flatnonzero(reports.usable)
    order = Succession.of(reports.time_s[usable], reports.track[usable])
    rows, walk = usable[order.rows], feed.walk_m2_per_s3
    ends = np.flatnonzero(order.final) + 1
    return [
        Path(reports.time_s[part], reports.state[part], reports.covariance[part], walk[part])
        for part in np.split(rows, ends[:-1])
    ]


def _background(plots: Plots, rows: IntArray) -> FloatArray:
    """(m,) density of other plots at the plots ``rows``, per m² and scan: of fixed echoes, plus that of the range."""
    from scipy.spatial import cKDTree

    tree = cKDTree(plots.position)
    scans_s = plots.time_s[first_of_scans(plots)]
    width = np.sqrt(2.0 * plots.variance[rows]) + ECHO_M
    frame = _sight(plots.position[rows] - plots.sensor[rows])[2]
    owner, other = flattened(tree.query_ball_point(plots.position[rows], 3.0 * width.max(axis=1), return_sorted=False))
    apart_s = np.abs(plots.time_s[other] - plots.time_s[rows[owner]])
    kept = (apart_s >= BACKGROUND_FROM_S) & (apart_s <= BACKGROUND_TO_S)
    owner, other = owner[kept], other[kept]
    step = np.einsum("mav,mv->ma", frame[owner], plots.position[other] - plots.position[rows[owner]]) / width[owner]
    kernel = np.exp(-0.5 * np.sum(step**2, axis=1)) / (2.0 * np.pi * width[owner].prod(axis=1))
    at = plots.time_s[rows]
    window = sum(
        np.searchsorted(scans_s, at + high) - np.searchsorted(scans_s, at + low)
        for low, high in ((-BACKGROUND_TO_S, -BACKGROUND_FROM_S), (BACKGROUND_FROM_S, BACKGROUND_TO_S))
    )
    fixed = np.bincount(owner, kernel, len(rows)) / np.maximum(window, 1)
    return fixed + _by_range(plots, rows, len(scans_s))


def _by_range(plots: Plots, rows: IntArray, n_scans: int) -> FloatArray:
    """(m,) plots per m² and scan at the range of the plots ``rows``, averaged over all directions."""
    order = np.sort(plots.range_m)
    count = max(int(RING_SHARE * len(order)), 10)
    middle = np.searchsorted(order, plots.range_m[rows])
    low, high = np.maximum(middle - count, 0), np.minimum(middle + count, len(order) - 1)
    inner, outer = np.where(low == 0, 0.0, order[low]), order[high] + 1.0
    return np.asarray((high - low) / (np.pi * (outer**2 - inner**2) * n_scans))


def with_plot_statistics(feed: Feed, missed: float) -> Feed:
    """A registered source of bare plots with this miss rate, and with the clutter that its plots show, where these were
    assumed for its kind.

    The clutter at a plot is the density of fixed echoes and that of the sea. The first is that of all plots around it,
    in cells of ``CLUTTER_CELL_M`` without the nearest ones: an echo at one place is the ship that AIS has there, unless
    there are more echoes beside it, as on a shore. The second is that of the plots at its range in all directions.
    """
    description = feed.description
    estimated = [name for name in (MISSES, CLUTTER) if description.is_assumed(name)]
    clutter_per_m2 = None
    if MISSES in estimated:
        description = replace(description, misses=MissRate.counted(missed))
    if CLUTTER in estimated:
        clutter_per_m2, mean_per_km2 = _clutter(feed)
        description = replace(description, clutter=replace(description.clutter, per_km2=mean_per_km2))
    lines = tuple(line for line in description.assumed if line.name not in estimated)
    return replace(feed, description=replace(description, assumed=lines), clutter_per_m2=clutter_per_m2)


def _clutter(feed: Feed) -> tuple[FloatArray, float]:
    """(n,) density of plots about each report of a feed, per m² and scan, and their mean per km² and scan."""
    from scipy.ndimage import gaussian_filter, uniform_filter
    from scipy.special import erf

    plots, cell_m = Plots.of(feed), CLUTTER_CELL_M
    scans = len(first_of_scans(plots))
    at = ((plots.position - plots.position.min(axis=0)) / cell_m).astype(np.int64) + 8
    counts = np.zeros(at.max(axis=0) + 9)
    np.add.at(counts, tuple(at.T), 1.0)
    # A normal distribution of two cells, without the 3 × 3 in the middle and their share of it.
    share = float(erf(1.5 / 2.0 / np.sqrt(2.0)) ** 2)
    middle = uniform_filter(counts, 3, mode="constant")
    around = np.maximum(gaussian_filter(counts, 2.0, mode="constant") - share * middle, 0.0) / (1.0 - share)
    density = around[tuple(at.T)] / (cell_m**2 * scans) + _by_range(plots, np.arange(len(plots)), scans)
    reach_m = min(feed.description.coverage.range_m or np.inf, float(plots.range_m.max()))
    mean_per_m2 = len(plots) / (scans * np.pi * reach_m**2)
    out = np.full(len(feed.reports), mean_per_m2)
    out[plots.rows] = density
    return out, 1e6 * mean_per_m2
