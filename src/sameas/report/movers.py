"""The report of ``sameas movers``: the search, the tracklets, and the known objects."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

import numpy as np

from sameas.report.prose import DOUBT, percent
from sameas.representation import count, counted

if TYPE_CHECKING:
    from astropy.table import Table

    from sameas.sky.movers import Detections, Movers
    from sameas.sky.movers.below_limit import BelowLimit, Plan
    from sameas.sky.movers.known import KnownObjects
    from sameas.sky.movers.stack import Stack
    from sameas.sky.series import Series

#: Number of tracklets that are listed; the output has all.
MAX_LISTED = 20
#: With fewer exposures, a tracklet is supported by rate and brightness only.
MIN_EXPOSURES = 3
#: Pixels that one core adds per second in the search below the limit of single frames (measured, 2 GHz).
SUMS_PER_S = 2.5e9

#: Error scales above this are reported.
WORTH_SAYING = 1.2


def searched_lines(seen: Detections) -> list[str]:
    """What was searched, with doubts about the input."""
    time = seen.frame_mjd
    lines = [
        f"Detections: {count(len(seen))} of {count(len(seen.frame_names))} exposures over "
        f"{1440.0 * float(np.ptp(time)):.1f} minutes"
    ]
    for reason, number in seen.set_aside.counts().items():
        lines.append(f"{DOUBT}{counted(number, 'row is', 'rows are')} set aside: {reason}")
    if len(seen.frame_names) < MIN_EXPOSURES:
        lines.append(f"{DOUBT}two exposures: nothing confirms that motion is straight; take three or more")
    days = float(np.ptp(time))
    if days > 1.0:
        lines.append(
            f"{DOUBT}the exposures span {days:.1f} days: tracklets are of one night, search each night by itself, "
            "or is their time in another unit than days?"
        )
    return lines


def excluded_lines(movers: Movers) -> list[str]:
    """What was excluded: stationary sources, detections fixed on the chip, and tracklets of one common rate."""
    lines, stationary = [], movers.stationary
    if stationary is not None and stationary.places:
        rows, places = counted(int(stationary.rows.sum()), "detection"), counted(stationary.places, "place")
        lines.append(f"Stationary: {rows} at {places}, excluded")
        off = float(np.hypot(*stationary.offset_arcsec.T).max())
        if off > 0.5 * movers.detections.typical_sigma_arcsec:
            lines.append(
                f"{DOUBT}positions of an exposure differ from those of the others by up to {off:.2f}″; "
                "the search corrects this, the output has the positions as given"
            )
        if stationary.error_scale > WORTH_SAYING:
            lines.append(
                f"{DOUBT}stationary sources scatter {stationary.error_scale:.2f} times as much as the errors allow; "
                "the search multiplies the errors by that"
            )
    if movers.fixed:
        lines.append(
            f"{DOUBT}{count(movers.fixed)} detections move by one step from exposure to exposure, and by another to "
            "the next: they are fixed on the chip, and excluded"
        )
    if movers.same_rate:
        lines.append(
            f"{DOUBT}{count(movers.same_rate)} tracklets of one rate are excluded: chip defects under a drifting "
            "telescope look like this; give the frames themselves, with a catalogue, to tell them from movers"
        )
    return lines


def mover_lines(movers: Movers) -> list[str]:
    """The tracklets."""
    if not len(movers):
        return ["Movers: none"]
    expected = float(movers.p_tracklet.sum())
    lines = [
        f"Movers: {count(len(movers))}, of which {expected:.1f} are expected to be real",
        "  name      n       p  expected by chance  rate ″/min   angle  scatter ″",
    ]
    rate = np.hypot(*movers.rate_arcsec_per_min.T)
    angle = np.degrees(np.arctan2(*movers.rate_arcsec_per_min.T)) % 360.0
    for k in range(min(len(movers), MAX_LISTED)):
        scatter = movers.scatter_arcsec[k]
        scatter_text = f"{scatter:9.3f}" if np.isfinite(scatter) else "        –"
        lines.append(
            f"  {movers.names[k]:8} {movers.size[k]:3d}  {movers.p_tracklet[k]:.4f}  {movers.expected_chance[k]:18.1e}"
            f"  {rate[k]:10.3f}  {angle[k]:5.1f}°  {scatter_text}"
        )
    if movers.near_earth is not None:
        near = [f"{movers.names[k]} {movers.near_earth[k]:.0f}" for k in range(min(len(movers), MAX_LISTED))]
        lines.append(f"  digest2 score for a near-Earth object, of 100: {', '.join(near)}")
    if len(movers) > MAX_LISTED:
        lines.append(f"  … and {count(len(movers) - MAX_LISTED)} more")
    return lines


def model_lines(movers: Movers) -> list[str]:
    """The model of the movers: detection probability and distribution of rates."""
    m = movers.model
    top = int(np.argmax(m.rates.share))
    sigma = np.sqrt(np.diag(m.rates.covariance[top]))
    return [
        f"Model: an exposure shows {100 * m.p_detect:.0f} % of the movers in its field; their rates scatter by "
        f"{sigma[0]:.2f} and {sigma[1]:.2f} ″/min",
        "  about that of a main-belt orbit (ecliptic longitude, latitude)",
    ]


def report_lines(movers: Movers, least: float, changed_by: str, doubts: Sequence[str] = ()) -> list[str]:
    """The number of tracklets in the report, those excluded by their probability, which ``changed_by`` changes, and
    doubts about its header."""
    reported, doubtful = movers.p_tracklet >= least, [DOUBT + doubt for doubt in doubts]
    if reported.all():
        return [f"  it contains {counted(len(movers), 'tracklet')}", *doubtful]
    excluded = np.flatnonzero(~reported)
    shown = ", ".join(f"{movers.names[k]} ({movers.p_tracklet[k]:.2f})" for k in excluded[:5])
    are, them = ("is", "it") if len(excluded) == 1 else ("are", "them")
    return [
        f"  it contains {counted(int(reported.sum()), 'tracklet')}; {count(len(excluded))} {are} excluded, "
        f"less probable than {least:g}: {shown}{' …' if len(excluded) > 5 else ''}",
        f"  look at {them}; {changed_by} changes what is reported",
        *doubtful,
    ]


def plan_lines(plan: Plan) -> list[str]:
    """The cost of a search below the limit of single frames, before it starts."""
    seconds = plan.sums / SUMS_PER_S
    fastest = float(np.hypot(*plan.rates.T).max())
    return [
        f"Below the limit: {count(len(plan.rates))} rates to {fastest:.2f} ″/min on {count(len(plan.minutes))} frames "
        f"of {plan.shape[1]} × {plan.shape[0]} px, once in time order and once scrambled",
        f"  about {seconds:.0f} s of one core and {plan.peak_bytes / 1e6:.0f} MB",
    ]


def below_lines(below: BelowLimit) -> list[str]:
    """The movers found by stacking, below the limit of single frames."""
    movers = below.movers
    if not len(movers):
        return ["  no more are found there"]
    lines = [
        f"  {count(len(movers))} more, of which {float(movers.p_tracklet.sum()):.1f} are expected to be real",
        "  name      S/N       p  expected by chance  rate ″/min   angle  frames",
    ]
    rate, angle = np.hypot(*movers.rate_arcsec_per_min.T), np.degrees(np.arctan2(*movers.rate_arcsec_per_min.T)) % 360.0
    lines += [
        f"  {movers.names[k]:8} {below.snr[k]:4.1f}  {movers.p_tracklet[k]:.4f}  {movers.expected_chance[k]:18.1e}"
        f"  {rate[k]:10.3f}  {angle[k]:5.1f}°  {below.frames[k]:6d}"
        for k in range(min(len(movers), MAX_LISTED))
    ]
    return [*lines, *([f"  … and {count(len(movers) - MAX_LISTED)} more"] if len(movers) > MAX_LISTED else [])]


def series_lines(series: Series) -> list[str]:
    """The series of frames: numbers of stars, stationary sources and candidates."""
    n = len(series.frame)
    first, last = (series.exposures[k].mjd_utc for k in (0, -1))
    lines = [
        f"Series: {counted(len(series.exposures), 'frame')} over {1440.0 * (last - first):.1f} minutes, "
        f"{count(n)} measurements",
        f"  middle of the first exposure {_date_of(first)} UTC, of the last {_date_of(last)}: a report needs UTC, "
        "not local time",
        f"  in the star catalogue {count(int(series.star.sum()))}, stationary {count(int(series.stationary.sum()))},"
        f" fixed on the chip {count(int(series.fixed.sum()))}, on bad pixels {count(int(series.unreliable.sum()))}; "
        f"candidates {count(int(series.unexplained.sum()))}",
        f"  registered by {count(int(series.ties.min()))} to {count(int(series.ties.max()))} sources a frame",
    ]
    if series.trails is not None and np.isfinite(series.trails.hidden):
        lines.append(
            f"  {percent(series.trails.hidden)} of the pixels are unusable or close to stars: movers there are not seen"
        )
    return [*lines, *(f"{DOUBT}{note}" for note in series.notes)]


def _date_of(mjd: float) -> str:
    """A date and time to the second, in the scale of the MJD."""
    return (datetime(1858, 11, 17) + timedelta(seconds=round(86400.0 * mjd))).isoformat(" ")


def streak_lines(streaks: Table) -> list[str]:
    """The trails of single frames that are in no tracklet, as tabulated."""
    if not len(streaks):
        return []
    lines = [
        f"Streaks: {count(len(streaks))} on single frames, in no tracklet, as of satellites",
        "       ra °     dec °  length ″  angle  rate ″/min    S/N  frame",
    ]
    for row in streaks[:MAX_LISTED]:
        rate = "         –" if np.ma.is_masked(row["rate_arcsec_per_min"]) else f"{row['rate_arcsec_per_min']:10.1f}"
        lines.append(
            f"  {row['ra_1_deg']:9.4f}  {row['dec_1_deg']:+8.4f}  {row['length_arcsec']:8.1f}"
            f"  {row['angle_deg']:4.0f}°  {rate}  {row['snr']:5.0f}  {row['frame']}"
        )
    return [*lines, *([f"  … and {count(len(streaks) - MAX_LISTED)} more"] if len(streaks) > MAX_LISTED else [])]


def known_lines(movers: Movers, known: KnownObjects, on_earth: bool) -> list[str]:
    """The tracklets identified with known objects, with O−C."""
    lines = [f"Known objects: {count(len(known.elements))} predicted near the tracklets"]
    if not on_earth:
        lines.append(f"{DOUBT}the place of the observer is not known, so positions are geocentric; give its site")
    for k, owner in enumerate(known.object):
        if owner < 0:
            continue
        east, north = known.mean_offset(movers, k)
        lines.append(
            f"  {movers.names[k]} is {known.name(k)}, p {known.p[k]:.4f}, O−C {east:+.2f}″ east, {north:+.2f}″ north, "
            f"predicted V {known.magnitude[k]:.1f}"
        )
    unknown = int((known.object < 0).sum())
    if unknown:
        lines.append(f"  {unknown} of {len(movers)} tracklets match none of them")
    if known.missing:
        shown = "; ".join(
            f"{one.name}, V {one.magnitude:.1f}, at {one.ra_deg:.4f} {one.dec_deg:+.4f}°"
            for one in known.missing[:MISSING_SHOWN]
        )
        more = " …" if len(known.missing) > MISSING_SHOWN else ""
        lines.append(f"  in the field and no tracklet, by prediction: {count(len(known.missing))} ({shown}{more})")
    return lines


#: Known objects that were not found are listed up to this number, the brightest first.
MISSING_SHOWN = 5


def reasons(movers: Movers, pixels: Stack, k: int) -> list[tuple[str, bool]]:
    """The evidence for tracklet k: sentences, each with whether it is a doubt."""
    seen, rows = movers.detections, movers.members[k][movers.members[k] >= 0]
    frames = len(pixels.flux[k])
    if movers.added:
        return [
            ("too faint for one frame; found by stacking the frames along its motion", False),
            (f"by chance {_small(movers.expected_chance[k])} peaks as bright are expected at such rates, by the same "
             "frames in scrambled order", bool(movers.expected_chance[k] > 0.1)),
            ("its three positions are from stacks of the first, middle and last frames", False),
            _stacked(float(pixels.snr[k])),
        ]  # fmt: skip
    out = [(f"by chance {_small(movers.expected_chance[k])} tracklets with as much evidence are expected",
            bool(movers.expected_chance[k] > 0.1))]  # fmt: skip
    scatter, quoted = movers.scatter_arcsec[k], float(np.sqrt(seen.covariance[rows][:, [0, 2]].mean()))
    if np.isfinite(scatter):
        ratio = scatter / quoted
        words = f"{len(rows)} detections scatter by {scatter:.2f}″ about straight motion, {ratio:.1f} times quoted"
        out.append((words, bool(ratio > 2.5)))
    light = seen.magnitude[rows]
    if np.isfinite(light).sum() > 2:
        spread = float(np.nanstd(light))
        out.append((f"its brightness scatters by {spread:.2f} mag", spread > 0.7))
    usable = np.isfinite(pixels.flux[k])
    missed, hidden = usable & ~pixels.detected[k] & ~pixels.hidden[k], usable & ~pixels.detected[k] & pixels.hidden[k]
    if missed.any():
        ratio = pixels.log_ratio[k]
        times = f"{abs(ratio) / np.log(10):.1f} powers of ten {'more' if ratio >= 0 else 'less'} probable"
        unseen = counted(int(missed.sum()), "frame does", "frames do")
        out.append((f"{unseen} not show it; forced photometry there makes it {times}", bool(ratio < 0)))
    if hidden.any():
        out.append((f"on {counted(int(hidden.sum()), 'frame')} it lies on a star", False))
    off = frames - int(usable.sum())
    if off:
        out.append((f"on {off} of {frames} frames it is off the edge or on unusable pixels", False))
    if movers.near_earth is not None and np.isfinite(movers.near_earth[k]):
        out.append((f"its digest2 score is {movers.near_earth[k]:.0f} of 100 for a near-Earth object", False))
    out.append(_stacked(float(pixels.snr[k])))
    return out


def _stacked(snr: float) -> tuple[str, bool]:
    """The S/N of the stack along the motion, and whether it is a doubt (below 4)."""
    return f"the stack along its motion has S/N {snr:.{0 if snr >= 100.0 else 1}f}", snr < 4.0


def _small(value: float) -> str:
    """A number as printed text, below 0.001 with a power of ten."""
    if value >= 1e-3:
        return f"{value:.2g}"
    digit, power = f"{value:.0e}".split("e")
    return f"{digit}·10" + str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
