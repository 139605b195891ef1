"""The report of ``sameas frame``: identified frames, from their summaries, and the stars of a series."""

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
from sameas.sky.frame.identified import FEW_PAIRS
from sameas.sky.frame.outputs import ERROR_TERM_NAMES

if TYPE_CHECKING:
    from sameas.sky.series import Series

#: Stars with a smaller probability of being constant are counted as possible variables.
UNLIKELY = 0.001


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
        *understood_lines(summary),
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


def understood_lines(summary: Mapping[str, Any]) -> list[str]:
    """The interpretation of the catalogue; nothing if the summary lacks it."""
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
    understood = understood_lines(summaries[0])
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
    few = summary["found"]["identified"] < FEW_PAIRS
    east, north = summary["residuals"]["rms_arcsec" if few else "scatter_arcsec"]
    return "not known" if east is None else f"{east:#.2g}″ × {north:#.2g}″{' rms' if few else ''}"


def _estimated(summary: Mapping[str, Any]) -> list[str]:
    """Densities of unmatched measurements and stars, and the errors."""
    known = {name: Quantity(value, error) for name, (value, error) in summary["estimated"].items()}
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
