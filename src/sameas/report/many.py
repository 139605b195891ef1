"""The report of ``sameas many``: what was estimated of several catalogues, and the objects found among them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from sameas.records import Records
from sameas.report.prose import DOUBT, entry, figures
from sameas.representation import count, counted
from sameas.result import AMBIGUOUS
from sameas.sky.column_choice import in_years

if TYPE_CHECKING:
    from sameas.sky.many import ManyMatch  # with its linear programmes: a fifth of the imports of a match

_COLUMN_WIDTHS = (12, 12, 12, 13)


def many_estimate_lines(match: ManyMatch, words: Callable[[str], str]) -> list[str]:
    """The estimates. words : formats a message that names arguments."""
    lines = ["Estimated"]
    if match.epoch_jyr is None:
        lines += entry("epoch", "not all epochs are known: no positions are moved")
    else:
        epochs = [f"{c.name} {in_years(c.epoch_jyr)}" for c in match.catalogues if c.epoch_jyr is not None]
        lines += entry("epoch", f"object positions are at {in_years(match.epoch_jyr)} ({', '.join(epochs)})")
    for name, rotation in match.rotations.items():
        lines += entry("offset", f"added to {name}: {rotation}")
    for (first, second), pair in match.two_by_two.items():
        estimate = pair.estimate
        numbers = f"{figures(estimate.common)} common, gate {estimate.gate_sigmas:.1f} σ"
        lines += entry("two by two", f"{first} and {second}: {numbers}, residuals {estimate.typical_scale:.2f} σ")
    for (first, second), information in match.magnitude_information.items():
        lines += entry("magnitudes", f"{first} and {second}: worth {information:.2f} (ln) for a common object")
    rounds = f"{match.iterations} iteration{'s' * (match.iterations > 1)}" + (
        "" if match.converged else ", not converged"
    )
    lines += entry("all together", f"estimated in {rounds}")
    return [*lines, *(DOUBT + words(doubt) for doubt in match.doubts)]


def many_summary_lines(match: ManyMatch) -> list[str]:
    """The results: rows, objects by combination of catalogues, confidence."""
    return [*_rows_of_many(match), "", *_objects(match), "", *_confidence(match)]


def _rows_of_many(match: ManyMatch) -> list[str]:
    wide = max(len("Rows"), *(len(c.name) for c in match.catalogues)) + 2
    lines = [f"{'Rows':{wide}}{'rows':>12}{'set aside':>12}{'alone':>12}{'with others':>13}"]
    members = np.ma.getmaskarray(match.objects.members)
    for k, (catalogue, records) in enumerate(zip(match.catalogues, match.objects.given, strict=True)):
        assert isinstance(records, Records)
        alone = int(np.count_nonzero(~members[:, k] & (match.objects.n_members == 1)))
        numbers = len(catalogue), len(catalogue) - len(records), alone, len(records) - alone
        lines.append(
            f"  {catalogue.name:{wide - 2}}"
            + "".join(f"{count(n):>{w}}" for n, w in zip(numbers, _COLUMN_WIDTHS, strict=True))
        )
        lines += [f"    set aside: {why} ({count(n)})" for why, n in records.set_aside.counts().items()]
    return lines


def _objects(match: ManyMatch) -> list[str]:
    present = ~np.ma.getmaskarray(match.objects.members)
    names = [catalogue.name for catalogue in match.catalogues]
    rows = []
    for pattern, expected in match.expected.items():
        inside = np.array([name in pattern for name in names])
        number = int((present == inside).all(axis=1).sum())
        if number or expected >= 0.5:
            rows.append((len(pattern), " = ".join(name for name in names if name in pattern), number, expected))
    rows.sort(key=lambda row: (-row[0], -row[2]))
    wide = max(len("Objects shown by"), *(len(words) + 2 for _, words, _, _ in rows)) + 2
    lines = [f"{'Objects shown by':{wide}}{'found':>12}{'expected':>12}"]
    lines += [f"  {words:{wide - 2}}{count(n):>12}{count(round(e)):>12}" for _, words, n, e in rows]
    return [*lines, f"{'  all':{wide}}{count(len(match.objects)):>12}"]


def _confidence(match: ManyMatch) -> list[str]:
    several = match.objects.n_members > 1
    p = match.objects.probability
    groups = match.objects.groups
    return [
        "Confidence",
        *entry(
            "expected wrong", f"{figures(float(np.sum(1.0 - p[several])))} of {count(several.sum())} of several records"
        ),
        *entry("ambiguous", f"{count(np.count_nonzero(several & (p < AMBIGUOUS)))} less probable than {AMBIGUOUS:g}"),
        *entry("two by two", f"{counted(match.broken, 'pair')} of two catalogues in no object"),
        *entry("largest group", f"{counted(groups.records.max(initial=0), 'record')}"),
    ]
