"""The report of an identified frame, made from its summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sameas.estimate.error_model import ErrorModel
from sameas.estimate.quantity import Quantity
from sameas.report.match import error_model_in_words, quoted_errors
from sameas.report.prose import DOUBT, entry
from sameas.representation import count
from sameas.sky.frame.identified import FEW
from sameas.sky.frame.outputs import ERROR_NAMES


def frame_lines(summary: Mapping[str, Any]) -> list[str]:
    """The full report of one frame."""
    place, plate, found = summary["place"], summary["plate"], summary["found"]
    size = f"{place['columns']} × {place['rows']} px, {_angle(place['width_deg'])} × {_angle(place['height_deg'])}"
    middle = f"RA {place['middle_ra_deg']:.5f}° Dec {place['middle_dec_deg']:+.5f}°"
    hand = "mirrored" if place["mirrored"] else "not mirrored"
    order = f"order {plate['order']} on {plate['effective_pairs']:.1f} pairs, errors {plate['error_scale']:.2f} times"
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
        *entry("plate model", f"{order} those quoted"),
        "",
        *_understood(summary),
        f"Found in {summary['catalogue']}",
        *entry("measurements", f"{count(found['measurements'])}, of which {count(found['identified'])} identified"),
        *entry("not in the catalogue", _unmatched(found)),
        *entry("missing stars", f"{count(found['missing'])} of {count(found['stars_on_frame'])} on the frame"),
        *entry(
            "expected wrong", f"{found['expected_wrong']:.1f}; {count(found['ambiguous'])} with probability below 0.9"
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
    parts = [line.partition(": ") for line in summary.get("understood", ())]
    lines = [entry(label, text) if text else entry("note", label) for label, _, text in parts]
    return [f"Catalogue: {summary['catalogue']}", *(line for part in lines for line in part), ""] if lines else []


def one_line(name: str, summary: Mapping[str, Any], state: str) -> str:
    """One line on a frame of a folder, from its summary. state : when it was done, or the run time."""
    found, place = summary["found"], summary["place"]
    words = (
        f"{count(found['identified'])} of {count(found['measurements'])} identified, {count(found['missing'])} missing"
    )
    return (
        f"{name}: {words}, scatter {_scatter(summary)}, {place['scale_arcsec_per_px']:.4f}″/px, "
        f"odds {place['odds']}; {state}"
    )


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
    few = summary["found"]["identified"] < FEW
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
    terms = {term: known.get(name) for term, name in ERROR_NAMES.items()}
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
