"""The report of ``sameas match`` as plain text: the columns used, the estimates, and the results.

Headings start at the margin, their entries are indented, doubts start with :data:`sameas.report.prose.DOUBT`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, median, taken
from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.coverage import Coverage
from sameas.estimate.error_model import ErrorModel
from sameas.estimate.quantity import Quantity
from sameas.estimate.result import Estimate
from sameas.evidence import Errors
from sameas.evidence.detection import DetectionCurve
from sameas.gate.gate import quantile
from sameas.kernels import threads
from sameas.records import Records
from sameas.report.prose import DOUBT, LABEL, entry, figures, labelled, percent, times
from sameas.representation import ORDINALS, count, counted
from sameas.result import AMBIGUOUS, Answers, Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.crossmatch import ARCSEC2_PER_DEG2, SkyMatch, area_and_densities

#: A radius within which nearest neighbours are often accepted.
USUAL_RADIUS_ARCSEC = 5.0
#: Quoted errors are called right if the error scale is within this of 1, or within this many standard errors.
ABOUT_RIGHT, SIGNIFICANT = 0.03, 3.0


def catalogue_lines(catalogue: Catalogue, side: int, path: str = "", words: Callable[[str], str] = str) -> list[str]:
    """How the columns of catalogue 1, 2, … are interpreted, and doubts about it.

    path : of its file. words : converts messages that name arguments, for example to command-line options.
    """
    where = f" ({path})" if path else ""
    lines = [f"{ORDINALS[side - 1].capitalize()} catalogue: {catalogue.name}, {counted(len(catalogue), 'row')}{where}"]
    lines += labelled([words(line) for line in catalogue.interpretation])
    for note in catalogue.table.meta.get("sameas_notes", ()):  # notes of the reader
        lines += entry("file", note)
    return lines + _doubt_lines(catalogue.named_doubts, words)


def coverage_lines(moved: str, coverage: Coverage, doubts: Sequence[str], words: Callable[[str], str]) -> list[str]:
    """The common epoch, and the common area of both catalogues. words : as for :func:`catalogue_lines`."""
    return ["Both catalogues", *entry("epoch", moved), *_area(coverage), *_doubt_lines(doubts, words)]


def estimate_lines(match: SkyMatch, words: Callable[[str], str] = str) -> list[str]:
    """The estimates from both catalogues. words : as for :func:`catalogue_lines`."""
    return [
        "Estimated",
        *entry("epoch", match.moved),
        *(entry("offset", f"added to {match.second.name}: {match.rotation}") if match.rotation else ()),
        *(entry("warp", f"added to {match.second.name}: {match.warp}") if match.warp else ()),
        *_common_objects(match),
        *_area(match.estimate.coverage),
        *_findings(match),
        *_doubt_lines(match.doubts, words),
    ]


def summary_lines(match: SkyMatch) -> list[str]:
    """The results: rows, groups, pairs, residuals before and after motion, identified shares by magnitude."""
    return [*_rows(match), *_pairs(match), "", *_residuals(match), *_magnitudes(match)]


def blends_lines(blended: Table, resolution_arcsec: float) -> list[str]:
    """The number of records of the first catalogue that are two objects of the second; blended : ``Match.blends``."""
    two = int(np.count_nonzero(~np.ma.getmaskarray(blended["row_2b"])))
    return entry(
        "blends", f"at {resolution_arcsec:g} arcsec {count(two)} of {count(len(blended))} records are two objects; "
        f"{float(np.sum(blended['p_blend'])):.1f} expected",
    )  # fmt: skip


def nearest_lines(match: SkyMatch) -> list[str]:
    """Comparison with the nearest neighbours, without and with motion."""
    result = match.result
    partner = np.full(result.first.n_table, ABSENT)
    partner[result.matches.rows_1] = result.matches.rows_2
    identified = partner >= 0
    numbers = []
    for moved in (False, True):
        near = match.nearest(moved)
        rows = near.rows.filled(ABSENT)
        within = near.separation_arcsec.filled(np.inf) <= USUAL_RADIUS_ARCSEC
        claims = np.bincount(rows[within], minlength=len(match.second))
        cases = claims > 1, identified & (rows != partner), identified & ~within, ~identified & within
        numbers.append([count(np.count_nonzero(case)) for case in cases])
    twice = np.bincount(result.matches.rows_2, minlength=len(match.second)) > 1
    radius = f"{USUAL_RADIUS_ARCSEC:g} arcsec"
    labels = (
        f"{match.second.name}: claimed more than once (within {radius})",
        f"{match.first.name}: the nearest is not the one identified",
        f"{match.first.name}: identified, but the nearest is beyond {radius}",
        f"{match.first.name}: not identified, but one is within {radius}",
    )
    wide = max(map(len, labels))
    lines = [f"{'Nearest neighbour':{wide + 2}}{'without motion':>17}{'with motion':>14}{'sameas':>9}"]
    for label, without_motion, with_motion, by_sameas in zip(
        labels, *numbers, (count(np.count_nonzero(twice)), "–", "–", "–"), strict=True
    ):
        lines.append(f"  {label:{wide}}{without_motion:>17}{with_motion:>14}{by_sameas:>9}")
    return lines


def _doubt_lines(doubts: Sequence[str], words: Callable[[str], str] = str) -> list[str]:
    """One unwrapped line per doubt, since a doubt may be printed alone."""
    return [DOUBT + words(doubt) for doubt in doubts]


def _area(coverage: Coverage) -> list[str]:
    area, density_1, density_2 = area_and_densities(coverage)
    names = coverage.first.source, coverage.second.source
    return [
        *_discs(coverage, names),
        *entry("common area", f"{figures(area)} square degrees"),
        *entry(
            "mean density there",
            f"{figures(density_1)} of {names[0]} and {figures(density_2)} of {names[1]} per square degree",
        ),
    ]


def _discs(coverage: Coverage, names: tuple[str, str]) -> list[str]:
    """The discs that the field consists of, if it does."""
    discs = coverage.discs
    if discs is None:
        return []
    radius = f"{discs.radius:.3g} arcsec"
    if not discs.centres:
        return entry("field", f"{count(len(discs.area))} discs of {radius}: neither has records elsewhere")
    around, other = names if discs.centres == 1 else names[::-1]
    return entry("field", f"discs of {radius} around the records of {around}: {other} has none elsewhere")


def _rows(match: SkyMatch) -> list[str]:
    """The table of the numbers of rows of both catalogues, by outcome."""
    result = match.result
    reasons = sorted({reason for records in (result.first, result.second) for reason in records.set_aside.counts()})
    lines: list[tuple[str, list[str]]] = [("rows", [count(len(match.first)), count(len(match.second))])]
    covered_1, covered_2 = match.estimate.coverage.covered
    works = [
        partial(_row_counts, result, result.first, covered_1, result.pairs.i, result.pairs.j, reasons),
        partial(_row_counts, result, result.second, covered_2, result.pairs.j, result.pairs.i, reasons),
    ]
    per_side = threads.each(works, len(result.pairs))
    lines += [(label, [side[label] for side in per_side]) for label in per_side[0]]
    wide = [max(len(name) + 3, 14) for name in (match.first.name, match.second.name)]
    head = f"{'Found':{2 + LABEL}}" + "".join(
        f"{name:>{w}}" for name, w in zip((match.first.name, match.second.name), wide, strict=True)
    )
    return [head] + [
        f"  {label:{LABEL}}" + "".join(f"{value:>{w}}" for value, w in zip(values, wide, strict=True))
        for label, values in lines
    ]


def _row_counts(
    result: Identification,
    records: Records,
    covered: BoolArray,
    record: NDArray[np.int32],
    other: NDArray[np.int32],
    reasons: Sequence[str],
) -> dict[str, str]:
    """The numbers of rows of one catalogue, by outcome.

    covered : (n,) records that the other catalogue covers. record, other : (m,) the records of this and of the other
    catalogue in each candidate pair. reasons : for excluded rows, of both catalogues.
    """
    identified = len(result.matches)
    not_covered = int(np.count_nonzero(~covered))
    if not_covered:
        not_covered -= int(np.count_nonzero(~covered[record[result.matches.pair]]))
    set_aside = records.set_aside.counts()
    return {
        **{f"set aside: {reason}": count(set_aside.get(reason, 0)) for reason in reasons},
        "used": count(len(records)),
        "not covered": count(not_covered),
        "without a partner": count(len(records) - identified - not_covered),
        "identified": count(identified),
        "  of those covered": percent(identified / max(len(records) - not_covered, 1)),
        "several candidates": count(np.count_nonzero(np.bincount(record) > 1)),
        "claimed by several": count(_claims(other, record, result.log_odds)),
    }


def _claims(claimant: NDArray[np.int32], claimed: NDArray[np.int32], log_odds: FloatArray) -> int:
    """The number of records that are the most probable candidate of several records of the other side."""
    from sameas.kernels.records import greatest_pair

    best = greatest_pair(claimant, int(claimant.max(initial=-1)) + 1, log_odds)
    return int(np.count_nonzero(np.bincount(taken(claimed, np.compress(best >= 0, best))) > 1))


def _pairs(match: SkyMatch) -> list[str]:
    result = match.result
    statistics = result.groups.statistics()
    largest = statistics.pop("records in the largest")
    sizes = ", ".join(f"{count(n)} {words}" for words, n in statistics.items() if n)
    groups = count(len(result.groups)) + (f": {sizes}; the largest has {counted(largest, 'record')}" if sizes else "")
    methods = ", ".join(f"{counted(n, 'group')} by {words}" for words, n in result.posterior.counts().items() if n)
    return [*entry("groups", groups), *_identified(result), *entry("probabilities", methods or "none")]


def _identified(result: Identification) -> list[str]:
    """The number of identified pairs, and how many are expected to be wrong."""
    wrong, pairs = result.expected_wrong, len(result.matches)
    ambiguous = int(np.count_nonzero(result.matches.p_match < AMBIGUOUS))
    return [
        *entry("pairs", f"{count(pairs)} identified among {counted(len(result.pairs), 'candidate')}"),
        *entry(
            "expected wrong",
            f"{wrong:.1f} of the identified ({percent(wrong / max(pairs, 1))}); missed: {result.expected_missed:.1f}",
        ),
        *entry("ambiguous", f"{count(ambiguous)} identified with a probability below {AMBIGUOUS:g}"),
    ]


def _residuals(match: SkyMatch) -> list[str]:
    """Residuals of the identified pairs, at the catalogues' own epochs and at the common one."""
    if not len(match.result.matches):
        return ["Residuals: no pair was identified"]
    after = match.result.matches.residual
    expected = math.sqrt(quantile(0.5, match.result.pairs.d))
    rows = [("at the common epoch", after, match.result.matches.mahalanobis)]
    if match.epoch_jyr is not None:
        before = match.offsets_without_motion
        rows.insert(0, ("at their own epochs", before, _mahalanobis_before_motion(match, before)))
    mean_and_rms = f"{'mean':>9}{'rms':>10}"
    lines = [
        f"{'Residuals, arcsec':{2 + LABEL}}{'east':>19}{'north':>19}{'distance':>12}{'in quoted σ':>14}",
        f"  {'(first minus second)':{LABEL}}{2 * mean_and_rms}{'median':>12}{'median':>14}",
    ]
    for label, offset, distance in rows:
        by_axis = np.ascontiguousarray(offset.T)  # sums along rows of memory are some ten times as fast
        mean, rms = by_axis.mean(axis=1), np.sqrt(np.mean(by_axis**2, axis=1))
        cells = f"{mean[0]:+9.4f}{rms[0]:10.4f}{mean[1]:+9.4f}{rms[1]:10.4f}"
        medians = f"{median(np.hypot(*by_axis)):12.4f}{median(np.compress(~np.isnan(distance), distance)):14.2f}"
        lines.append(f"  {label:{LABEL}}{cells}{medians}")
    return [*lines, f"  {'expected from errors':{LABEL}}{'':50}{expected:14.2f}"]


def _mahalanobis_before_motion(match: SkyMatch, offset: FloatArray) -> FloatArray:
    """(k,) distances of the identified pairs at their own epochs, in quoted σ at those epochs."""
    i, j = match.result.matches.rows_1, match.result.matches.rows_2
    covariance = 1e-6 * (match.first.astrometry[i].position_covariance + match.second.astrometry[j].position_covariance)
    xx, yy, xy = covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 0, 1]
    x, y = offset.T
    return np.asarray(np.sqrt((yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)))


def _magnitudes(match: SkyMatch) -> list[str]:
    """The identified share of the covered rows per magnitude bin, for each catalogue with magnitudes."""
    result = match.result
    lines: list[str] = []
    for catalogue, records, covered, found in (
        (match.first, result.first, match.covered_1, result.matches.rows_1),
        (match.second, result.second, match.covered_2, result.matches.rows_2),
    ):
        if catalogue.magnitude is None:
            continue
        identified = np.zeros(len(catalogue), np.bool_)
        identified[found] = True
        rows = records.rows[(covered | identified)[records.rows]]
        lines += _bins(f"{catalogue.name}, {catalogue.magnitude_name}", catalogue.magnitude[rows], identified[rows])
    return ["", "Identified by magnitude, of the rows covered", *lines] if lines else []


def _bins(title: str, magnitude: FloatArray, identified: BoolArray) -> list[str]:
    """Three lines of bins, rows and percentages; at most ten bins, with sparse ends merged."""
    known = np.isfinite(magnitude)
    if not known.any():
        return []
    magnitude, identified = magnitude[known], identified[known]
    low, high = np.quantile(magnitude, (0.005, 0.995))
    step = max(1, int(np.ceil((high - low) / 9.0)))
    inner = np.arange(np.floor(low) + step, max(np.ceil(high), np.floor(low) + step + 1), step)
    at = np.searchsorted(inner, magnitude, side="right")
    number = np.bincount(at, minlength=len(inner) + 1)
    share = np.bincount(at, identified, len(inner) + 1) / np.maximum(number, 1)
    names = [f"<{inner[0]:g}", *(f"{a:g}–{b:g}" for a, b in pairwise(inner)), f"≥{inner[-1]:g}"]
    shares = [f"{100 * s:.1f}" if n else "–" for s, n in zip(share, number, strict=True)]
    table = (("magnitude", names), ("rows", [count(n) for n in number]), ("identified, %", shares))
    return [f"  {title}"] + [
        f"    {label:{LABEL - 6}}" + "".join(f"{cell:>8}" for cell in cells) for label, cells in table
    ]


# The estimates of a match of two catalogues in words, with standard errors.


def _common_objects(match: SkyMatch) -> list[str]:
    """The number of common objects, and their fraction of each catalogue."""
    e = match.estimate
    shares = [_share(e.quantities[name]) for name in ("share_1", "share_2")]
    words = f"{e.quantities['common']}: {shares[0]} of {match.first.name}, {shares[1]} of {match.second.name}"
    return entry("common objects", words)


def _findings(match: SkyMatch) -> list[str]:
    """Densities of unmatched records, errors, brightness, columns, gate and number of EM iterations."""
    e = match.estimate
    return [
        *_unmatched(match),
        *entry("errors", _errors_in_words(match)),
        *(entry("  by catalogue", words) if (words := by_source(match)) else ()),
        *(entry("  in the evidence", words) if (words := _evidence_errors(match)) else ()),
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
    if not given and not any(finding.used for finding in columns.findings):
        return lines
    return [*lines, *entry("  they change", f"{count(match.estimate.changed_by_columns)} answers")]


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


# Of two identified sources of records, without columns, magnitudes or epochs.


def records_lines(result: Identification, estimate: Estimate) -> list[str]:
    """The estimates from both sources, and the results."""
    one, two = result.first.source, result.second.source
    shares = [f"{percent(share)} of {name}" for share, name in ((estimate.share_1, one), (estimate.share_2, two))]
    scale = estimate.quantities.get("error_scale")
    errors = f"typically {estimate.typical_scale:.2f} times the quoted ones" if scale is None else quoted_errors(scale)
    return [
        "Estimated",
        *entry("common objects", f"{estimate.quantities['common']}: {', '.join(shares)}"),
        *entry("errors", errors),
        *entry("gate", f"{estimate.gate_sigmas:.1f} quoted σ"),
        *(DOUBT + note for note in estimate.notes),
        "",
        "Found",
        *_records_row(result.first, result.answers_1),
        *_records_row(result.second, result.answers_2),
        *_identified(result),
    ]


def _records_row(records: Records, answers: Answers) -> list[str]:
    identified = int(np.count_nonzero(~np.ma.getmaskarray(answers.partner)))
    aside = "".join(f", {count(n)} set aside ({reason})" for reason, n in records.set_aside.counts().items())
    words = f"{counted(records.n_table, 'row')}{aside}, {count(identified)} identified"
    return entry(records.source, words)
