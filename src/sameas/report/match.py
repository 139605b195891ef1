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
from sameas.estimate.coverage import Coverage
from sameas.estimate.result import Estimate
from sameas.gate.gate import quantile
from sameas.kernels import threads
from sameas.records import Records
from sameas.report.estimates import common_objects_lines, finding_lines, quoted_errors
from sameas.report.prose import DOUBT, LABEL, entry, figures, labelled, percent
from sameas.representation import ORDINALS, count, counted
from sameas.result import AMBIGUOUS, Answers, Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.sky_match import SkyMatch, area_and_densities

#: A radius within which nearest neighbours are often accepted.
USUAL_RADIUS_ARCSEC = 5.0


def catalogue_lines(catalogue: Catalogue, side: int, path: str = "", words: Callable[[str], str] = str) -> list[str]:
    """How the columns of catalogue 1, 2, …, or of the only one (0), are interpreted, and doubts about it.

    path : of its file. words : converts messages that name arguments, for example to command-line options.
    """
    where = f" ({path})" if path else ""
    which = f"{ORDINALS[side - 1].capitalize()} catalogue" if side else "Catalogue"
    lines = [f"{which}: {catalogue.name}, {counted(len(catalogue), 'row')}{where}"]
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
        *common_objects_lines(match),
        *_area(match.estimate.coverage),
        *finding_lines(match),
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


def _doubt_lines(doubts: Sequence[str], words: Callable[[str], str]) -> list[str]:
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
    wide = max(8, 2 + max(len(cell) for _, cells in table for cell in cells))  # of millions of rows the cells are wider
    return [f"  {title}"] + [
        f"    {label:{LABEL - 6}}" + "".join(f"{cell:>{wide}}" for cell in cells) for label, cells in table
    ]


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
