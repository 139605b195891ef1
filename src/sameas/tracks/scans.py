"""Scans: the current reports at an instant of a source of plots without ids, with each object at most once.

Reports without track ids cannot replace each other one by one; the last scan replaces all before it. There are two
kinds of scans, which :func:`scans_of` distinguishes by the reports:

- an **exposure** detects everything at once: a camera, a laser scanner, a radar that gives all plots of a rotation one
  stamp. The last exposure is current.
- a **rotating antenna** sweeps the bearings, and each plot has its own stamp. The plots of the last rotation are
  current, (t − T, t], in which each bearing was swept once. That needs an accurate T: with one 1 % too long, one object
  in a hundred appears twice. T is estimated from the bearings and stamps of the plots; the described period is the
  start of the search.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray

#: The rotation period is searched within ROTATION_SEARCH of the described one, by at most ROTATION_PLOTS plots, with
#: ROTATION_STEPS steps per resolvable frequency; then within ROTATION_FAR times it.
ROTATION_SEARCH, ROTATION_FAR, ROTATION_PLOTS, ROTATION_STEPS = 0.3, 3.0, 3000, 6.0
ROTATION_LOG_ODDS = 12.0  # minimum log-odds of a period against chance
ROTATION_UNEXPLAINED = 0.5  # an antenna rotates if its rotation leaves less than this share of the scatter of bearings
PAUSE_QUANTILE = 0.99  # the pause of an antenna is this quantile of the gaps between its plots
#: Maximum gap between successive reports of one exposure, and its maximum length, as shares of the period.
EXPOSURE_GAP, EXPOSURE_LENGTH = 0.1, 0.5
#: Maximum number of exposures per period, and maximum share of those that follow the previous one in less than half the
#: usual time.
EXPOSURES_PER_PERIOD, HURRIED_SHARE = 1.5, 0.1


def usual_period_s(times_s: FloatArray) -> float:
    """The median time between successive scans, from their times (l,) in order; infinite for a single scan."""
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else math.inf


def joint_times(times_s: FloatArray, gap_s: float) -> list[float]:
    """The ascending times (l,) of scans, those within ``gap_s`` of a first one as one scan at the time of the last.

    >>> joint_times(np.array([0.0, 0.25, 1.0, 2.5]), 0.5)
    [0.25, 1.0, 2.5]
    """
    out: list[float] = []
    first = -math.inf
    for time_s in times_s.tolist():
        if not out or time_s - first > gap_s:
            out.append(time_s)
            first = time_s
        else:
            out[-1] = time_s
    return out


@dataclass(frozen=True)
class AntennaRotation:
    """The rotation of an antenna: its period, and the longest pause without plots that is normal."""

    period_s: float
    pause_s: float


@dataclass(frozen=True)
class Scans:
    """The scans of reports. scan_s : (n,) time of the scan of each report. rotation : None for exposures."""

    scan_s: FloatArray
    rotation: AntennaRotation | None = None


def scans_of(
    time_s: FloatArray,
    period_s: float | None,
    bearing_deg: FloatArray | None = None,
    scan_times_s: FloatArray | None = None,
) -> Scans:
    """The scans of bare plots.

    time_s : (n,) in any order. period_s : between scans, as described; without it each stamp is a scan.
    bearing_deg : (n,) of the plots from the sensor, NaN where unknown; None if the sensor's position is unknown.
    scan_times_s : (l,) times of all scans, where known.

    >>> scans_of(np.array([5.0, 0.0, 0.0, 5.0]), 5.0)
    Scans(scan_s=array([5., 0., 0., 5.]), rotation=None)
    """
    is_known = scan_times_s is not None and bool(np.isin(time_s, scan_times_s).all())
    if is_known or period_s is None or period_s <= 0.0 or not len(time_s):
        return Scans(time_s.copy())
    _, stamp, count = np.unique(time_s, return_inverse=True, return_counts=True)
    shared = float(np.mean(count[stamp] > 1)) >= 0.5
    exposures = _exposures(time_s, period_s, 0.0 if shared else EXPOSURE_GAP * period_s)
    if exposures is not None:
        return Scans(exposures)
    rotation_s = None if bearing_deg is None else rotation_period_s(time_s, bearing_deg, period_s)
    if shared and rotation_s is None:
        return Scans(time_s.copy())
    period = period_s if rotation_s is None else rotation_s
    gaps, first = np.diff(np.sort(time_s)), float(time_s.min())
    # Below one period, so that the rotation includes its last plot.
    pause_s = min(float(np.quantile(gaps, PAUSE_QUANTILE)), 0.999 * period)
    return Scans(first + period * np.floor((time_s - first) / period), AntennaRotation(period, pause_s))


def rotation_period_s(time_s: FloatArray, bearing_deg: FloatArray, near_s: float) -> float | None:
    """The period of a clockwise rotation, from bearings and stamps; None without one, or with too few plots.

    The frequency f that maximises R = |Σ exp i(β − 2π f t)| / n. It is accepted if n R² exceeds the level that the
    search reaches by chance, and R clearly exceeds |Σ exp iβ| / n, the value of a fixed sector. Periods near
    ``near_s`` are tried first, then shorter and longer ones: radars of one kind turn at different speeds.
    Source: Rayleigh's test, Mardia and Jupp, Directional Statistics (2000), 6.3.1.

    >>> t = np.arange(0.0, 60.0, 0.37)
    >>> round(rotation_period_s(t, 360.0 * t / 2.5, 3.0), 3)
    2.5
    """
    known = np.flatnonzero(np.isfinite(bearing_deg))
    order = known[np.argsort(time_s[known], kind="stable")]
    skipped = max(len(order) - ROTATION_PLOTS, 0) // 2
    order = order[skipped : skipped + ROTATION_PLOTS]
    time, sight = time_s[order], np.exp(1j * np.radians(bearing_deg[order]))
    span = float(np.ptp(time)) if len(time) else 0.0
    if span < 2.0 * near_s:
        return None
    time = time - time.mean()

    def explained(frequency: FloatArray) -> FloatArray:
        """(k,) R at these frequencies."""
        parts = np.array_split(frequency, max(len(frequency) // 64, 1))
        sums = [np.exp(-2j * math.pi * part[:, None] * time) @ sight for part in parts]
        return np.asarray(np.abs(np.concatenate(sums)) / len(time), np.float64)

    def accepted(shortest_s: float, longest_s: float) -> float | None:
        """The best period between these, where it is accepted."""
        low, high = 1.0 / longest_s, 1.0 / shortest_s
        count = math.ceil((high - low) * span * ROTATION_STEPS)
        tried = np.linspace(low, high, count + 1)
        for step in (high - low) / count * np.array([1.0, 0.1, 0.01]):
            best = float(tried[np.argmax(explained(tried))])
            tried = best + 0.1 * step * np.arange(-10, 11)
        strength = float(explained(np.array([best]))[0])
        chance = len(time) * strength**2 < ROTATION_LOG_ODDS + math.log(count)
        return None if chance or 1.0 - strength > ROTATION_UNEXPLAINED * (1.0 - fixed) else 1.0 / best

    fixed, near, far = float(np.abs(sight.mean())), ROTATION_SEARCH, ROTATION_FAR
    found = accepted((1.0 - near) * near_s, (1.0 + near) * near_s)
    return accepted(near_s / far, near_s * far) if found is None else found


def _exposures(time_s: FloatArray, period_s: float, gap_s: float) -> FloatArray | None:
    """(n,) the begin of the exposure of each report, if reports come in short bursts, one per period; else None."""
    order = np.argsort(time_s, kind="stable")
    stamps = time_s[order]
    begins = np.concatenate([[True], np.diff(stamps) > gap_s])
    starts = stamps[begins]
    out = np.empty_like(stamps)
    out[order] = starts[np.cumsum(begins) - 1]
    if np.any(time_s - out > EXPOSURE_LENGTH * period_s):
        return None
    gaps = np.diff(starts)
    too_many = len(starts) > EXPOSURES_PER_PERIOD * (np.ptp(starts) / period_s + 1.0)
    irregular = len(gaps) > 0 and np.mean(gaps < 0.5 * np.median(gaps)) > HURRIED_SHARE
    return None if too_many or irregular else out


def last_exposure(scan_s: FloatArray, scan_times_s: FloatArray, instant_s: float) -> IntArray:
    """Rows of the last exposure at or before an instant; none if that one of ``scan_times_s`` has no reports."""
    past = scan_times_s[scan_times_s <= instant_s]
    return np.flatnonzero(scan_s == past.max()) if len(past) else np.empty(0, np.int64)


def last_rotation(
    time_s: FloatArray, rotation: AntennaRotation, scan_times_s: FloatArray, instant_s: float
) -> IntArray:
    """Rows of the last rotation of an antenna before an instant: the reports of (t − T, t].

    After a gap longer than its pause the antenna has stopped or its plots are late; then the last rotation with plots
    is current. scan_times_s : times at which the antenna is known to rotate.
    """
    past, begun = time_s[time_s <= instant_s], scan_times_s[scan_times_s <= instant_s]
    if not len(past):
        return np.empty(0, np.int64)
    end = min(instant_s, max(float(past.max()) + rotation.pause_s, float(begun.max(initial=-math.inf))))
    return np.flatnonzero((time_s > end - rotation.period_s) & (time_s <= end))


def seen_from(position: FloatArray, sensor_m: FloatArray | None) -> FloatArray | None:
    """(n,) bearings of positions (n, 2) from the sensor (n, 2), degrees; None if the sensor's position is unknown."""
    if sensor_m is None:
        return None
    from_sensor = position - sensor_m
    return np.asarray(np.degrees(np.arctan2(from_sensor[:, 0], from_sensor[:, 1])))
