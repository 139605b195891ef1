"""The report of ``sameas many``: what was estimated of several catalogues, and the objects found among them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import ABSENT
from sameas.records import Records
from sameas.report.prose import DOUBT, entry, figures
from sameas.representation import count, counted
from sameas.result import AMBIGUOUS
from sameas.sky.column_choice import in_years

if TYPE_CHECKING:
    from sameas.sky.many import ManyMatch  # with its linear programmes: a fifth of the imports of a match

_COLUMN_WIDTHS = (12, 12, 12, 13)
#: Most combinations of catalogues that the summary lists, and most catalogues of which each lists those it has.
MOST_COMBINATIONS, FEW_NAMES = 30, 5


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
    lines += _two_by_two(match) if len(match.catalogues) <= FEW_NAMES else _with_the_others(match)
    rounds = f"{match.iterations} iteration{'s' * (match.iterations > 1)}" + (
        "" if match.converged else ", not converged"
    )
    lines += entry("all together", f"estimated in {rounds}")
    return [*lines, *(DOUBT + words(doubt) for doubt in match.doubts)]


def _two_by_two(match: ManyMatch) -> list[str]:
    """The estimates of every two catalogues."""
    lines = []
    for (first, second), pair in match.two_by_two.items():
        estimate = pair.estimate
        numbers = f"{figures(estimate.common)} common, gate {estimate.gate_sigmas:.1f} σ"
        lines += entry("two by two", f"{first} and {second}: {numbers}, residuals {estimate.typical_scale:.2f} σ")
    for (first, second), information in match.magnitude_information.items():
        lines += entry("magnitudes", f"{first} and {second}: worth {information:.2f} (ln) for a common object")
    return lines


def _with_the_others(match: ManyMatch) -> list[str]:
    """The same, the smallest and the largest of each catalogue with the others."""
    lines = []
    for name in (catalogue.name for catalogue in match.catalogues):
        estimates = [pair.estimate for both, pair in match.two_by_two.items() if name in both]
        common, gate, scale = (
            "–".join(dict.fromkeys((words(min(values)), words(max(values)))))
            for values, words in (
                ([each.common for each in estimates], figures),
                ([each.gate_sigmas for each in estimates], "{:.1f}".format),
                ([each.typical_scale for each in estimates], "{:.2f}".format),
            )
        )
        lines += entry("with the others", f"{name}: {common} common, gate {gate} σ, residuals {scale} σ")
    for name in (catalogue.name for catalogue in match.catalogues):
        most = next(((both, worth) for both, worth in match.magnitude_information.items() if name in both), None)
        if most is not None:
            other = next(one for one in most[0] if one != name)
            lines += entry("magnitudes", f"{name}: worth up to {most[1]:.2f} (ln) for a common object, with {other}")
    return lines


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
    """The objects by their catalogues; of many combinations, the most frequent ones and the sum of the others."""
    from sameas.sky.population import patterns_of

    names = [catalogue.name for catalogue in match.catalogues]
    bit = {name: 1 << k for k, name in enumerate(names)}
    number = np.bincount(patterns_of(match.objects.members.filled(ABSENT)), minlength=1 << len(names)).tolist()
    rows = []
    for pattern, expected in match.expected.items():
        found = number[sum(bit[name] for name in pattern)]
        if found or expected >= 0.5:
            rows.append((len(pattern), _combination(names, pattern), found, expected))
    rows.sort(key=lambda row: -max(row[2:]))
    rows, others = sorted(rows[:MOST_COMBINATIONS], key=lambda row: (-row[0], -row[2])), rows[MOST_COMBINATIONS:]
    if others:
        rows.append((0, f"{len(others)} other combinations", *np.sum([row[2:] for row in others], axis=0).tolist()))
    wide = max(len("Objects shown by"), *(len(words) + 2 for _, words, _, _ in rows)) + 2
    lines = [f"{'Objects shown by':{wide}}{'found':>12}{'expected':>12}"]
    lines += [f"  {words:{wide - 2}}{count(int(n)):>12}{count(round(e)):>12}" for _, words, n, e in rows]
    return [*lines, f"{'  all':{wide}}{count(len(match.objects)):>12}"]


def _combination(names: list[str], pattern: tuple[str, ...]) -> str:
    """The catalogues of an object; of most of many, those without it."""
    missing = [name for name in names if name not in pattern]
    if len(names) <= FEW_NAMES or len(missing) >= len(pattern):
        return " = ".join(name for name in names if name in pattern)
    return f"all but {', '.join(missing)}" if missing else f"all {len(names)}"


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
