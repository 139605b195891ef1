"""The report of ``sameas many``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sameas.records import Records
from sameas.report.prose import DOUBT, entry, figures
from sameas.representation import count, counted
from sameas.result.identification import AMBIGUOUS
from sameas.sky.column_choice import in_years
from sameas.sky.many import ManyMatch


def estimate_lines(match: ManyMatch, words: Callable[[str], str] = str) -> list[str]:
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
        found = pair.estimate
        numbers = f"{figures(found.common)} common, gate {found.gate_sigmas:.1f} σ"
        lines += entry("two by two", f"{first} and {second}: {numbers}, residuals {found.typical_scale:.2f} σ")
    rounds = f"{match.iterations} iteration{'s' * (match.iterations > 1)}" + (
        "" if match.converged else ", not converged"
    )
    lines += entry("all together", f"estimated in {rounds}")
    return [*lines, *(DOUBT + words(doubt) for doubt in match.doubts)]


def summary_lines(match: ManyMatch) -> list[str]:
    """The results: rows, objects by combination of catalogues, confidence."""
    return [*_rows(match), "", *_objects(match), "", *_confidence(match)]


def _rows(match: ManyMatch) -> list[str]:
    wide = max(len("Rows"), *(len(c.name) for c in match.catalogues)) + 2
    lines = [f"{'Rows':{wide}}{'rows':>12}{'set aside':>12}{'alone':>12}{'with others':>13}"]
    members = np.ma.getmaskarray(match.objects.members)
    for k, (catalogue, records) in enumerate(zip(match.catalogues, match.objects.given, strict=True)):
        assert isinstance(records, Records)
        alone = int(np.count_nonzero(~members[:, k] & (match.objects.n_members == 1)))
        numbers = len(catalogue), len(catalogue) - len(records), alone, len(records) - alone
        lines.append(
            f"  {catalogue.name:{wide - 2}}"
            + "".join(f"{count(n):>{w}}" for n, w in zip(numbers, _WIDTHS, strict=True))
        )
        lines += [f"    set aside: {why} ({count(n)})" for why, n in records.set_aside.counts().items()]
    return lines


_WIDTHS = (12, 12, 12, 13)


def _objects(match: ManyMatch) -> list[str]:
    found = ~np.ma.getmaskarray(match.objects.members)
    names = [catalogue.name for catalogue in match.catalogues]
    rows = []
    for pattern, expected in match.expected.items():
        inside = np.array([name in pattern for name in names])
        number = int((found == inside).all(axis=1).sum())
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
