"""Claims: what was said of the rules, beside what we measure.

The second paper says that close objects decides rightly with a probability above 0.75 … 0.80 from d = 1.6 … 1.9 on. Its
other figures come from our own earlier reconstruction of it (METHOD 8), of which the ways of counting are not known in
every detail. A claim names its source, the range that its words allow, and how ours is counted. It holds where our
figure lies in the range, give or take the tolerance that was asked of the study or two standard errors of ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from benchmarks.study.study import Study
from benchmarks.study.tally import Ratio

#: The tolerance asked of the study, set before it was run.
TOLERANCE = 0.015
PAPER, RECONSTRUCTION = "paper", "earlier reconstruction"


@dataclass(frozen=True)
class Claim:
    """``source`` says that ``what`` lies in ``low`` … ``high``; ``counted`` is how ``ours`` is counted."""

    source: str
    what: str
    low: float
    high: float
    counted: str
    ours: Ratio

    @property
    def miss(self) -> float:
        """How far ours lies outside the range, above or below it (negative); 0 inside."""
        return max(self.ours.value - self.high, 0.0) + min(self.ours.value - self.low, 0.0)

    @property
    def said(self) -> str:
        """The range in words."""
        if self.high == 1.0:
            return f"above {self.low:.2f}"
        return f"{self.low:.2f}" if self.low == self.high else f"{self.low:.2f} … {self.high:.2f}"

    @property
    def holds(self) -> bool:
        """Whether ours lies in the range, to the tolerance or to two standard errors of ours."""
        error = 0.0 if math.isnan(self.ours.error) else self.ours.error
        return abs(self.miss) <= max(TOLERANCE, 2.0 * error)

    @property
    def verdict(self) -> str:
        """In words."""
        if self.holds:
            return "yes"
        return f"{abs(self.miss):.3f} {'above' if self.miss > 0 else 'below'}"


WHOLE, RECORDS, OPEN = "pairs wholly right", "records right", "records right, both sources having some"
#: (d, q) of pairs and lines.
PAIRS = ((1.6, 0.2), (1.9, 0.2), (1.6, 0.4), (1.9, 0.4))
LINES = ((1.6, 0.05), (1.9, 0.05), (1.6, 0.1), (1.9, 0.1))
#: Two targets at q = 0.5, d = 3: what the earlier reconstruction saw.
LAST_POINT = "2 targets, d 3, q 0.5"
LAST = (("close objects", 0.91), ("uniform", 0.70), ("k = min", 0.83))


def claims(study: Study) -> Iterator[Claim]:
    """The claims that the study looked at, the paper's first."""
    yield from _of_paper(study)
    for d, q in PAIRS:
        yield from _claim(study, RECONSTRUCTION, 2, d, q, WHOLE, 0.79, 0.83)
    for d, q in LINES:
        yield from _claim(study, RECONSTRUCTION, 5, d, q, RECORDS, *((0.70, 0.76) if d < 1.8 else (0.79, 0.84)))
    for rule, value in LAST:
        for counted in (OPEN, RECORDS, WHOLE):
            ours = _figure(study, LAST_POINT, f"{rule}, no gate", counted)
            if ours:
                what = f"two targets, d = 3, q = 0.5: {rule}"
                yield Claim(RECONSTRUCTION, what, value, value, f"{counted}, no gate", ours)
    for several, counts in study.several:
        if several.oracle:
            scene = "three sources, five targets, q = 0.1, 4σ apart on average"
            for way, value in (("joint", 0.30), ("sequential", 0.26)):
                ours = counts.mean(f"{way} whole")
                yield Claim(RECONSTRUCTION, f"{scene}: {way}", value, value, "scenes wholly right", ours)


def _of_paper(study: Study) -> Iterator[Claim]:
    for targets, places, counted in ((2, PAIRS, WHOLE), (5, LINES, RECORDS)):
        for d, q in places:
            yield from _claim(study, PAPER, targets, d, q, counted, 0.75 if d < 1.8 else 0.80, 1.0)


def _claim(
    study: Study, source: str, targets: int, d: float, q: float, counted: str, low: float, high: float
) -> Iterator[Claim]:
    """What is said of close objects at one spacing and q, if it was looked at."""
    ours = _figure(study, f"{targets} targets, d {d:g}, q {q:g}", "close objects", counted)
    if ours:
        name = {2: "two targets", 5: "line of five"}[targets]
        yield Claim(source, f"{name}, d = {d:g}, q = {q:g}: close objects", low, high, counted, ours)


def _figure(study: Study, point: str, rule: str, counted: str) -> Ratio | None:
    tally = study.tally("claims", point, rule)
    if tally is None:
        return None
    return tally.figures()[{WHOLE: "whole", RECORDS: "right", OPEN: "right of open"}[counted]]
