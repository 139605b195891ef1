"""The estimates of a match of two catalogues in words, with standard errors."""

from __future__ import annotations

import numpy as np

from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.error_model import ErrorModel
from sameas.estimate.quantity import Quantity
from sameas.evidence import Errors
from sameas.evidence.detection import DetectionCurve
from sameas.report.prose import entry, percent, times
from sameas.representation import count, counted
from sameas.sky.evidence_columns import magnitude_columns
from sameas.sky.sky_match import ARCSEC2_PER_DEG2, SkyMatch

#: Quoted errors are called right if the error scale is within this of 1, or within this many standard errors.
ABOUT_RIGHT, SIGNIFICANT = 0.03, 3.0


def common_objects_lines(match: SkyMatch) -> list[str]:
    """The number of common objects, and their fraction of each catalogue."""
    e = match.estimate
    shares = [_share(e.quantities[name]) for name in ("share_1", "share_2")]
    words = f"{e.quantities['common']}: {shares[0]} of {match.first.name}, {shares[1]} of {match.second.name}"
    return entry("common objects", words)


def finding_lines(match: SkyMatch) -> list[str]:
    """Densities of unmatched records, errors, brightness, columns, gate and number of EM iterations."""
    e = match.estimate
    return [
        *_unmatched(match),
        *entry("errors", _errors_in_words(match)),
        *(entry("  by catalogue", words) if (words := by_source(match)) else ()),
        *(entry("  in the evidence", words) if (words := _evidence_errors(match)) else ()),
        *_resolution(match),
        *_brightness(match),
        *_columns(match),
        *entry("gate", f"{e.gate_sigmas:.1f} quoted σ"),
        *entry("iterations", f"{e.iterations}{_sampled(match)}, " + ("converged" if e.converged else "not converged")),
    ]


def _sampled(match: SkyMatch) -> str:
    """The size of the sample that the EM iterations used; "" where they used all records."""
    (one, two), result = match.estimate.learned_from, match.result
    if (one, two) == (len(result.first), len(result.second)):
        return ""
    return f" of a sample of {count(one)} and {count(two)} records"


def _share(share: Quantity) -> str:
    """A fraction with its standard error, in percent."""
    return str(Quantity(100.0 * share.value, 100.0 * share.standard_error, "%"))


def _unmatched(match: SkyMatch) -> list[str]:
    """Densities of the records that are in one catalogue only."""
    quantities = match.estimate.quantities
    if "density_only_1" not in quantities:
        return []
    per_deg2 = [
        Quantity(ARCSEC2_PER_DEG2 * q.value, ARCSEC2_PER_DEG2 * q.standard_error)
        for q in (quantities["density_only_1"], quantities["density_only_2"])
    ]
    words = f"{per_deg2[0]} of {match.first.name} and {per_deg2[1]} of {match.second.name} per square degree"
    return entry("only in one catalogue", words)


def _resolution(match: SkyMatch) -> list[str]:
    """The resolution of a catalogue that blends neighbours of the other; nothing if both resolve all."""
    resolution = match.estimate.resolution
    if resolution is None:
        return []
    names = match.first.name, match.second.name
    coarse, fine = names[resolution.coarse], names[1 - resolution.coarse]
    words = f"half of two objects of {fine} {resolution.separation:.2g} arcsec apart are one record of {coarse}"
    return entry("resolution", f"{words}, between them; it is taken for the brighter one")


def by_source(match: SkyMatch) -> str:
    """Error factors of each catalogue, where the data determine them; "" where no error model was fitted."""
    model = match.estimate.error_model
    return "" if model is None else error_model_in_words(model, (match.first.name, match.second.name))


def error_model_in_words(model: ErrorModel, names: tuple[str, str]) -> str:
    """Factors on the errors of the named sources, and a floor in arcsec; after a semicolon what is undetermined.

    >>> error_model_in_words(ErrorModel(both=Quantity(1.71, 0.04), note="whose cannot be told"), ("plate", "gaia"))
    'those of both × 1.710 ± 0.040; whose cannot be told'
    """
    factors = zip(names, (model.factor_1, model.factor_2), strict=True)
    words = [f"those of {name} × {q}" for name, q in factors if q is not None]
    if model.both is not None:
        words.append(f"those of both × {model.both}")
    if model.floor is not None:
        words.append(floor_in_words(model.floor))
    if model.floor_instead is not None:
        words.append(f"or, with both as quoted, {floor_in_words(model.floor_instead)}")
    return ", ".join(words) + ("; " if words and model.note else "") + model.note


def floor_in_words(floor_arcsec: Quantity) -> str:
    """The error floor in addition to the quoted errors, or its upper limit (2σ)."""
    significant = floor_arcsec.value > SIGNIFICANT * floor_arcsec.standard_error
    upper_limit = floor_arcsec.value + 2.0 * floor_arcsec.standard_error
    floor = f"{floor_arcsec} arcsec" if significant else f"none seen, less than {upper_limit:.2g} arcsec"
    return f"floor in quadrature on each axis: {floor}"


def _brightness(match: SkyMatch) -> list[str]:
    """The relation of the magnitudes, the completeness of each catalogue, and the weight of every term."""
    e, lines = match.estimate, []
    relation = None if e.photometry is None else e.photometry.first_relation
    if e.photometry is not None and relation is not None:
        (one, *_), (two, *_) = e.photometry.names
        of_one, of_two = (one, two) if one != two else (f"{one} of {match.first.name}", f"{two} of {match.second.name}")
        colours = [
            f", {q} per mag of {name.removeprefix('colour_')} − {two}"
            for name, q in e.quantities.items()
            if name.startswith("colour_")
        ]
        ends = ", ".join(f"{relation.offset[k]:+z.2f} at {two} {relation.knots[k]:.1f}" for k in (0, -1))
        lines += entry(
            "brightness",
            f"{of_one} − {of_two} is {e.quantities['zero_point']} ({ends}){''.join(colours)}; scatter "
            f"{e.quantities['scatter']}; {percent(relation.unrelated)} of the pairs are off the relation",
        )
    for curve, (mine, other) in zip(
        (e.detection_1, e.detection_2), ((match.first, match.second), (match.second, match.first)), strict=True
    ):
        if curve is not None:
            lines += entry("completeness", f"of {mine.name} {other.name} shows {_completeness(curve)}")
    weights = ", ".join(f"{name} {value:.1f}" for name, value in e.decisive.items() if value)
    if weights:
        changed = (
            [f"; brightness changes {counted(e.changed_by_brightness, 'answer')}"] if e.photometry is not None else []
        )
        if "precision" in e.decisive:
            precision = counted(e.changed_by_precision, "answer")
            changed.append(f"; precision, the sizes of the quoted errors, changes {precision}")
        lines += entry("what decides", f"median |ln odds| over the identified: {weights}{''.join(changed)}")
    return lines


def _columns(match: SkyMatch) -> list[str]:
    """The evidence of each additional column."""
    columns = match.estimate.columns
    if columns is None:
        return []
    lines = column_lines(columns, (match.first.name, match.second.name))
    if not lines:
        return entry("columns", "too few pairs to fit them; they are not used")
    given = any(column.log_odds is not None for side in columns.sides for column in side)
    if given or any(finding.used for finding in columns.findings):
        lines += entry("  they change", f"{count(match.estimate.changed_by_columns)} answers")
    for source, catalogue in ((1, match.first), (2, match.second)):
        used = {finding.name for finding in columns.findings if finding.source == source}
        others = [name for name in magnitude_columns(catalogue) if name not in used]
        if others and catalogue.magnitude_name in used:
            names = f"{', '.join(others[:4])}{' …' if others[4:] else ''} of {catalogue.name}"
            lines += entry("  not used", f"{names}: given as columns, further magnitudes may be evidence too")
    return lines


def column_lines(columns: ColumnEvidence, names: tuple[str, str]) -> list[str]:
    """The evidence of each additional column of the named catalogues; no lines where nothing was fitted."""
    lines = []
    for one in columns.findings:
        what = f"{one.name} of {names[one.source - 1]}" if one.source else f"{one.name} of {names[0]} with {one.other}"
        if not one.used:
            words = "is not informative, and is not used"
        elif one.other:
            words = f"are related in pairs: they raise ln likelihood by {one.gain:.1f}"
        else:
            low, high = one.span
            words = f"ln odds of a partner {low:+.1f} to {high:+.1f}; it raises ln likelihood by {one.gain:.1f}"
        lines += entry("column" if one.source else "related", f"{what}: {words}")
    for source, side in enumerate(columns.sides):
        for column in side:
            if column.log_odds is not None:
                some = int(np.count_nonzero(column.log_odds))
                words = f"odds as given, other than 1 for {count(some)} of {count(len(column.log_odds))} records"
                if not some:
                    words += ": no value is in the table; numbers need ranges, low, high, odds"
                lines += entry("column", f"{column.name} of {names[source]}: {words}")
    return lines


def _completeness(curve: DetectionCurve) -> str:
    """The largest completeness, and the magnitude at which it falls to half of that."""
    best = int(np.argmax(curve.probability - curve.standard_error))
    words = f"{100 * curve.probability[best]:.1f} % at {curve.band} {curve.edges[best]:g}–{curve.edges[best + 1]:g}"
    fainter = np.flatnonzero(curve.probability[best:] < 0.5 * curve.probability[best]) + best
    if len(fainter):
        k = int(fainter[0])
        low, high, half = curve.probability[k], curve.probability[k - 1], 0.5 * curve.probability[best]
        at = curve.middle[k] + (half - low) / (high - low) * (curve.middle[k - 1] - curve.middle[k])
        return f"{words}, half as many at {at:.1f}"
    return f"{words}, {100 * curve.probability[-1]:.1f} % of the faintest"


def _errors_in_words(match: SkyMatch) -> str:
    """The scale of the errors relative to the quoted ones, and the fraction of pairs in a wide tail."""
    e = match.estimate
    scales, scale = e.errors.scales, e.quantities.get("error_scale")
    if scale is None and len(scales) == 1 and not e.errors.as_modelled:
        return "taken as quoted" if scales[0] == 1.0 else f"{scales[0]:g} times the quoted ones"
    words = f"typically {e.typical_scale:.2f} times the quoted ones" if scale is None else quoted_errors(scale)
    if e.tail is None or e.tail.share.value < 2.0 * e.tail.share.standard_error:  # few pairs do not show one
        return words
    far = f"{_share(e.tail.share)} of the pairs have errors about {times(e.tail.factor)} times the quoted ones"
    return f"{words}; a tail: {far}"


def _evidence_errors(match: SkyMatch) -> str:
    """The error model used as evidence; "" where it is the quoted errors with fitted scales."""
    errors, left = match.estimate.errors, match.estimate.error_ranges
    if left is not None:
        (low, high), (least, most) = left.factors, left.floors
        return (
            f"averaged over what few pairs leave open: {low:.2g} to {high:.2g} times those quoted, with a floor of "
            f"{least:.2g} to {most:.2g} arcsec (95 %)"
        )
    if not errors.as_modelled:
        return ""
    names = match.first.name, match.second.name
    if trends := [trend.words(names[trend.source], errors.typical_scale) for trend in match.estimate.trends]:
        return f"those of a pair on each axis, in arcsec, {'; '.join(trends)}"
    return modelled_errors(errors)


def modelled_errors(errors: Errors) -> str:
    """The factors and the floor of an error model."""
    factors = [errors.typical_scale * factor for factor in (errors.factor_1, errors.factor_2)]
    both = (
        f"{factors[0]:.2f} times those quoted"
        if factors[0] == factors[1]
        else (f"{factors[0]:.2f} and {factors[1]:.2f} times those quoted")
    )
    return f"{both}, with a floor of {errors.typical_scale * float(np.max(errors.floor)):.3g} arcsec for both together"


def quoted_errors(scale: Quantity) -> str:
    """Whether the quoted errors are right, from the median residual relative to its expectation."""
    off = scale.value - 1.0
    if abs(off) <= max(ABOUT_RIGHT, SIGNIFICANT * scale.standard_error):
        return f"as quoted (median residual {scale} times the expected one)"
    if off > 0.0:
        return f"quoted {scale} times too small (median residual over the expected one)"
    return f"quoted too large (median residual {scale} times the expected one)"
