"""The reports of ``sameas frame`` (an identified frame, from its summary) and ``sameas movers`` (search, tracklets)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.estimate.error_model import ErrorModel
from sameas.estimate.quantity import Quantity
from sameas.report.estimates import error_model_in_words, quoted_errors
from sameas.report.prose import DOUBT, entry, labelled
from sameas.representation import count, counted
from sameas.sky.frame.identified import DEFAULT_REFINEMENT
from sameas.sky.frame.outputs import ERROR_TERM_NAMES

if TYPE_CHECKING:
    from sameas.sky.movers import Detections, Movers
    from sameas.sky.movers.below_limit import BelowLimit, Plan
    from sameas.sky.movers.known import KnownObjects
    from sameas.sky.movers.stack import Stack
    from sameas.sky.series import Series


def frame_lines(summary: Mapping[str, Any]) -> list[str]:
    """The full report of one frame."""
    place, plate, counts = summary["place"], summary["plate"], summary["found"]
    size = f"{place['columns']} × {place['rows']} px, {_angle(place['width_deg'])} × {_angle(place['height_deg'])}"
    middle = f"RA {place['middle_ra_deg']:.5f}° Dec {place['middle_dec_deg']:+.5f}°"
    hand = "mirrored" if place["mirrored"] else "not mirrored"
    order = f"order {plate['order']} on {plate['effective_pairs']:.1f} pairs, errors {plate['error_scale']:.2f} times"
    order += " those quoted" + (f" and a floor of {plate['floor_arcsec']:.2g}″" if plate.get("floor_arcsec") else "")
    lines = [
        f"Frame: {summary['frame']}",
        *(line for words in summary.get("exposure", {}).get("read", ()) for line in _note_lines(words)),
        "",
        "Placed",
        *entry("by", f"{place['found_by']}, odds {place['odds']}; next best {place['next_best_odds']}"),
        *entry("middle", f"{middle}; {size}"),
        *entry(
            "scale", f"{place['scale_arcsec_per_px']:.4f}″ per pixel; y axis at {place['rotation_deg']:.2f}°, {hand}"
        ),
        *entry("plate model", order),
        "",
        *_understood(summary),
        f"Found in {summary['catalogue']}",
        *entry("measurements", f"{count(counts['measurements'])}, of which {count(counts['identified'])} identified"),
        *entry("not in the catalogue", _unmatched(counts)),
        *entry("missing stars", f"{count(counts['missing'])} of {count(counts['stars_on_frame'])} on the frame"),
        *entry(
            "expected wrong", f"{counts['expected_wrong']:.1f}; {count(counts['ambiguous'])} with probability below 0.9"
        ),
        *entry("scatter", _scatter(summary)),
        *_estimated(summary),
    ]
    brightness = summary["brightness"]
    for label, what in (("magnitudes", "zero_point"), ("brightness", "odd"), ("completeness", "completeness")):
        if brightness.get(what):
            lines += entry(label, brightness[what]["words"])
    return [*lines, *(line for words in summary["notes"] for line in _note_lines(words))]


def _understood(summary: Mapping[str, Any]) -> list[str]:
    """The interpretation of the catalogue; summaries of earlier versions lack it."""
    lines = labelled(summary.get("understood", ()))
    return [f"Catalogue: {summary['catalogue']}", *lines, ""] if lines else []


def one_line(name: str, summary: Mapping[str, Any], state: str) -> str:
    """One line on a frame of a folder, from its summary. state : when it was done, or the run time."""
    counts, place = summary["found"], summary["place"]
    words = f"{count(counts['identified'])} of {count(counts['measurements'])} identified"
    return (
        f"{name}: {words}, {count(counts['missing'])} missing, scatter {_scatter(summary)}, "
        f"{place['scale_arcsec_per_px']:.4f}″/px, odds {place['odds']}; {state}"
    )


def frames_lines(summaries: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is alike on several frames: the interpretation of their catalogue, and the doubts."""
    if not summaries:
        return []
    understood = _understood(summaries[0])
    return [*(["", *understood[:-1]] if understood else []), *(DOUBT + doubt for doubt in doubts_of_frames(summaries))]


def doubts_of(summary: Mapping[str, Any]) -> list[str]:
    """The doubts in the summary of a frame."""
    notes = (*summary["exposure"]["read"], *summary["notes"])
    return [note.removeprefix("doubt: ") for note in notes if note.startswith("doubt") or "not converged" in note]


def doubts_of_frames(summaries: Sequence[Mapping[str, Any]]) -> list[str]:
    """The doubts of several frames; those that differ in numbers only are one."""
    alike: dict[str, list[str]] = {}
    for summary in summaries:
        for doubt in doubts_of(summary):
            alike.setdefault(re.sub(r"[0-9.e]+", "#", doubt), []).append(f"{summary['frame']}: {doubt}")
    return [f"{len(same)} frames, the first {same[0]}" if len(same) > 1 else same[0] for same in alike.values()]


def totals(done: int, skipped: int, failed: int) -> str:
    """The numbers of frames done now, done before, and failed."""
    parts = [
        f"{done} done",
        *([f"{skipped} done before"] if skipped else []),
        *([f"{failed} failed"] if failed else []),
    ]
    return f"Frames: {done + skipped + failed}; " + ", ".join(parts)


def _unmatched(found: Mapping[str, Any]) -> str:
    beyond = found.get("beyond_catalogue", 0)
    return count(found["unidentified"]) + (f", {count(beyond)} of them fainter than its limit" if beyond else "")


def _scatter(summary: Mapping[str, Any]) -> str:
    # The median is unreliable for few residuals.
    few = summary["found"]["identified"] < DEFAULT_REFINEMENT.few_pairs
    east, north = summary["residuals"]["rms_arcsec" if few else "scatter_arcsec"]
    return "not known" if east is None else f"{east:.2g}″ × {north:.2g}″{' rms' if few else ''}"


def _estimated(summary: Mapping[str, Any]) -> list[str]:
    """Densities of unmatched measurements and stars, and the errors."""
    # Summaries of earlier versions may lack them.
    known = {name: Quantity(value, error) for name, (value, error) in summary.get("estimated", {}).items()}
    lines = []
    if "only_on_frame_per_arcmin2" in known:
        alone = f"{known['only_on_frame_per_arcmin2']} of the frame and {known['only_in_catalogue_per_arcmin2']}"
        lines += entry("only in one catalogue", f"{alone} of the catalogue per square arcminute")
    words = [quoted_errors(known["error_scale"])] if "error_scale" in known else []
    if "error_tail_share" in known:
        share = known["error_tail_share"]
        percent = Quantity(100.0 * share.value, 100.0 * share.standard_error, "%")
        words.append(f"a tail: {percent} of the pairs lie far beyond")
    lines += entry("errors", "; ".join(words)) if words else []
    terms = {term: known.get(name) for term, name in ERROR_TERM_NAMES.items()}
    model = ErrorModel(**terms, note=summary.get("error_note", ""))
    apart = error_model_in_words(model, (summary["frame"], summary["catalogue"]))
    return lines + (entry("  by source", apart) if apart else [])


def _angle(deg: float) -> str:
    return f"{deg:.2f}°" if deg >= 1 else f"{60 * deg:.1f}′"


def _note_lines(words: str) -> list[str]:
    for mark in ("doubt", "assumed"):
        if words.startswith(f"{mark}: "):
            text = words.removeprefix(f"{mark}: ")
            return [DOUBT + text] if mark == "doubt" else entry("assumed", text)
    return entry("note", words)


#: Number of tracklets that are listed; the output has all.
MAX_LISTED = 20
#: With fewer exposures, a tracklet is supported by rate and brightness only.
MIN_EXPOSURES = 3
#: Pixels that one core adds per second in the search below the limit of single frames (measured, 2 GHz).
SUMS_PER_S = 2.5e9

#: Error scales above this are reported.
WORTH_SAYING = 1.2
#: Stars with a smaller probability of being constant are counted as possible variables.
UNLIKELY = 0.001


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
    minutes = 1440.0 * (series.exposures[-1].mjd_utc - series.exposures[0].mjd_utc)
    lines = [
        f"Series: {counted(len(series.exposures), 'frame')} over {minutes:.1f} minutes, {count(n)} measurements",
        f"  in the star catalogue {count(int(series.star.sum()))}, stationary {count(int(series.stationary.sum()))},"
        f" fixed on the chip {count(int(series.fixed.sum()))}, on bad pixels {count(int(series.unreliable.sum()))}; "
        f"candidates {count(int(series.unexplained.sum()))}",
        f"  registered by {count(int(series.ties.min()))} to {count(int(series.ties.max()))} sources a frame",
    ]
    return [*lines, *(f"{DOUBT}{note}" for note in series.notes)]


def star_lines(series: Series, filter: str) -> list[str]:
    """The series: its stars, zero points and variables."""
    stars = series.stars
    minutes = 1440.0 * (series.exposures[-1].mjd_utc - series.exposures[0].mjd_utc)
    zero, often = stars.zero_point, (stars.measurement >= 0).sum(axis=1)
    lines = [
        f"Series: {counted(len(series.exposures), 'frame')}{f' in {filter}' if filter else ''} "
        f"over {minutes:.1f} minutes, "
        f"{count(len(stars))} stars, {count(int((stars.name != '').sum()))} of them in the catalogue, "
        f"{count(int((often == len(zero)).sum()))} on all frames",
        f"  registered by {count(int(series.ties.min()))} to {count(int(series.ties.max()))} sources a frame",
    ]
    if np.isfinite(zero).any():
        odd, width = int((stars.p_constant < UNLIKELY).sum()), np.nanmax(zero) - np.nanmin(zero)
        lines.append(
            f"  zero points within {width:.3f} mag, ± {np.nanmedian(stars.zero_error):.4f}; bright stars "
            f"scatter by {stars.floor_mag:.4f} mag beside their errors; {count(odd)} stars may be variable"
        )
    else:
        lines.append(f"{DOUBT}too few stars in common for zero points; no light curves")
    return [*lines, *(f"{DOUBT}{note}" for note in series.notes)]


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
