"""The explanation of one record, as ``sameas explain`` prints it."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np

from sameas.report.prose import WIDTH, entry
from sameas.result.explanation import Competitor, Explanation, probability_text
from sameas.sky.catalogue import Catalogue
from sameas.sky.crossmatch import SkyMatch


def explanation_lines(match: SkyMatch, explanation: Explanation, source: int) -> list[str]:
    """The explanation of one record: its answer, its competitors, and the cost of other answers."""
    mine, other = (match.first, match.second) if source == 1 else (match.second, match.first)
    head = f"{explanation.source} {explanation.id} (row {explanation.row})"
    if explanation.usable:
        return [f"{head} could not be used: {explanation.usable}"]
    covered = (match.covered_1 if source == 1 else match.covered_2)[explanation.row]
    properties = [
        *entry("position", _position(mine, explanation.row)),
        *entry("brightness", _brightness(mine, explanation.row)),
    ]
    if explanation.group is None:
        why = "passes the gate" if covered else "passes the gate: it does not cover that place"
        return [f"{head} has no partner: no record of {other.name} {why}", *properties]
    chosen = next(c for c in explanation.competitors if c.chosen)
    who = "has no partner" if chosen.id is None else f"is {other.name} {chosen.id}"
    when = "" if match.epoch_jyr is None else f" at {match.epoch_jyr:.2f}"
    sizes = f"{explanation.records[0]} of {match.first.name} and {explanation.records[1]} of {match.second.name}"
    lines = [
        f"{head} {who}, probability {probability_text(chosen.probability)}",
        *properties,
        *entry("group", f"{explanation.group}: {sizes}; probabilities by {explanation.method}"),
        "",
        f"Answers ({other.name}{when}), and the factor each costs in the group's probability",
    ]
    lines += _answers(explanation.competitors, other)
    return lines + _next_best(explanation)


def _next_best(explanation: Explanation) -> list[str]:
    if explanation.next_best_cost is None:
        return []
    added, removed = (", ".join(f"{a} = {b}" for a, b in pairs) for pairs in explanation.next_best)
    change = f"without {removed}"
    if added:
        change = f"with {added}" + (f" instead of {removed}" if removed else "")
    words = f"The group's next best answer is {_times(explanation.next_best_cost)} times less probable: {change}."
    return ["", *textwrap.wrap(words, WIDTH, break_long_words=False, break_on_hyphens=False)]


def _answers(competitors: Sequence[Competitor], other: Catalogue) -> list[str]:
    ids = ["no partner" if c.id is None else str(c.id) for c in competitors]
    wide = max(map(len, ids))
    lines = [
        f"    {'answer':{wide}}{'probability':>13}{'cost factor':>12}{'arcsec':>9}{'east':>9}{'north':>9}"
        f"{'σ':>8}{'mag':>8}{'ln odds':>9}  of which"
    ]
    row_of = {str(name): row for row, name in enumerate(other.ids)}
    for name, c in zip(ids, competitors, strict=True):
        mark = "→" if c.chosen else " "
        line = f"  {mark} {name:{wide}}{probability_text(c.probability):>13}{_times(c.cost):>12}"
        if c.id is not None:
            line += _candidate(c, other, row_of[name])
        lines.append(line.rstrip())
    return lines


def _candidate(c: Competitor, other: Catalogue, row: int) -> str:
    assert c.residual is not None and c.log_odds is not None
    magnitude = np.nan if other.magnitude is None else other.magnitude[row]
    terms = ", ".join(f"{key} {value:+.2f}" for key, value in c.terms.items())
    return (
        f"{np.hypot(*c.residual):9.3f}{c.residual[0]:+9.3f}{c.residual[1]:+9.3f}{c.mahalanobis:8.2f}"
        f"{f'{magnitude:.2f}' if np.isfinite(magnitude) else '':>8}{c.log_odds:+9.2f}  {terms}"
    )


def _times(cost: float) -> str:
    """The factor exp(cost) as text; "best" for a cost of 0."""
    if cost <= 0:
        return "best"
    return f"{np.exp(cost):.3g}" if cost < 14 else f"10^{cost / np.log(10):.0f}"


def _position(catalogue: Catalogue, row: int) -> str:
    at = catalogue.astrometry
    pm = at.pm_ra_mas_per_yr[row], at.pm_dec_mas_per_yr[row]
    epoch = at.epoch_jyr[row]
    words = f"{at.ra_deg[row]:.6f}, {at.dec_deg[row]:+.6f} deg"
    if np.isfinite(epoch):
        words += f" at {epoch:.2f}"
    if catalogue.has_motion and np.isfinite(pm).all():
        words += f", moving {pm[0]:+.1f}, {pm[1]:+.1f} mas/yr"
    return words


def _brightness(catalogue: Catalogue, row: int) -> str:
    if catalogue.magnitude is None or not np.isfinite(catalogue.magnitude[row]):
        return "not known"
    return f"{catalogue.magnitude_name} {catalogue.magnitude[row]:.2f}"
