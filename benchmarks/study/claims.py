"""Claims: published figures of the rules compared with our measurements.

The second paper states that close objects decides correctly with a probability above 0.75 … 0.80 from d = 1.6 … 1.9 on.
The other figures are from our own earlier reconstruction of it (METHOD 8), whose ways of counting are not known in
every detail. A claim has a source, the range that its words allow, and the way in which the measurement is counted. It
agrees if the measurement is in the range, within the tolerance of the study or two standard errors of the measurement.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from benchmarks.study.study import Study
from benchmarks.study.tally import Ratio

#: Tolerance of the study, set before it was run.
TOLERANCE = 0.015
PAPER, RECONSTRUCTION = "paper", "earlier reconstruction"


@dataclass(frozen=True)
class Claim:
    """``source`` states that ``what`` is between ``low`` and ``high``; ``counted``: how ``measured`` is counted."""

    source: str
    what: str
    low: float
    high: float
    counted: str
    measured: Ratio

    @property
    def excess(self) -> float:
        """Distance of the measurement from the range, negative below it; 0 inside."""
        return max(self.measured.value - self.high, 0.0) + min(self.measured.value - self.low, 0.0)

    @property
    def claimed(self) -> str:
        """The range as text."""
        if self.high == 1.0:
            return f"above {self.low:.2f}"
        return f"{self.low:.2f}" if self.low == self.high else f"{self.low:.2f} … {self.high:.2f}"

    @property
    def agrees(self) -> bool:
        """Whether the measurement is in the range, within the tolerance or two of its standard errors."""
        error = 0.0 if math.isnan(self.measured.error) else self.measured.error
        return abs(self.excess) <= max(TOLERANCE, 2.0 * error)

    @property
    def verdict(self) -> str:
        """Yes, or the distance from the range."""
        if self.agrees:
            return "yes"
        return f"{abs(self.excess):.3f} {'above' if self.excess > 0 else 'below'}"


WHOLE, RECORDS, OPEN = "pairs wholly right", "records right", "records right in scenes where both sources have some"
#: (d, q) of pairs and lines.
PAIRS = ((1.6, 0.2), (1.9, 0.2), (1.6, 0.4), (1.9, 0.4))
LINES = ((1.6, 0.05), (1.9, 0.05), (1.6, 0.1), (1.9, 0.1))
#: Two targets at q = 0.5, d = 3: figures of the earlier reconstruction.
LAST_POINT = "2 targets, d 3, q 0.5"
LAST = (("close objects", 0.91), ("uniform", 0.70), ("k = min", 0.83))


def claims(study: Study) -> Iterator[Claim]:
    """The claims that the study has measured, the paper's first."""
    yield from _of_paper(study)
    for d, q in PAIRS:
        yield from _claim(study, RECONSTRUCTION, 2, d, q, WHOLE, 0.79, 0.83)
    for d, q in LINES:
        yield from _claim(study, RECONSTRUCTION, 5, d, q, RECORDS, *((0.70, 0.76) if d < 1.8 else (0.79, 0.84)))
    for rule, value in LAST:
        for counted in (OPEN, RECORDS, WHOLE):
            measured = _figure(study, LAST_POINT, f"{rule}, no gate", counted)
            if measured:
                what = f"two targets, d = 3, q = 0.5: {rule}"
                yield Claim(RECONSTRUCTION, what, value, value, f"{counted}, no gate", measured)
    for several, counts in study.several:
        if several.oracle:
            scene = "three sources, five targets, q = 0.1, 4σ apart on average"
            for way, value in (("joint", 0.30), ("sequential", 0.26)):
                measured = counts.mean(f"{way} whole")
                yield Claim(RECONSTRUCTION, f"{scene}: {way}", value, value, "scenes wholly right", measured)


def _of_paper(study: Study) -> Iterator[Claim]:
    for targets, places, counted in ((2, PAIRS, WHOLE), (5, LINES, RECORDS)):
        for d, q in places:
            yield from _claim(study, PAPER, targets, d, q, counted, 0.75 if d < 1.8 else 0.80, 1.0)


def _claim(
    study: Study, source: str, targets: int, d: float, q: float, counted: str, low: float, high: float
) -> Iterator[Claim]:
    """The claim about close objects at one spacing and q, if it was measured."""
    measured = _figure(study, f"{targets} targets, d {d:g}, q {q:g}", "close objects", counted)
    if measured:
        name = {2: "two targets", 5: "line of five"}[targets]
        yield Claim(source, f"{name}, d = {d:g}, q = {q:g}: close objects", low, high, counted, measured)


def _figure(study: Study, point: str, rule: str, counted: str) -> Ratio | None:
    tally = study.tally("claims", point, rule)
    if tally is None:
        return None
    return tally.figures()[{WHOLE: "whole", RECORDS: "right", OPEN: "right of open"}[counted]]
