"""Lines on two sources of records identified, which have no columns, magnitudes or epochs."""

from __future__ import annotations

import numpy as np

from sameas.estimate.match import Estimate
from sameas.records import Records
from sameas.report.findings import judged
from sameas.report.prose import DOUBT, count, entry, percent
from sameas.result import Answers, Identification
from sameas.result.identification import AMBIGUOUS


def records_lines(found: Identification, estimate: Estimate) -> list[str]:
    """What was estimated of both sources and found."""
    one, two = found.first.source, found.second.source
    shares = [f"{percent(share)} of {name}" for share, name in ((estimate.share_1, one), (estimate.share_2, two))]
    scale = estimate.quantities.get("error_scale")
    errors = f"typically {estimate.typical_scale:.2f} times the quoted ones" if scale is None else judged(scale)
    wrong, pairs = found.expected_wrong, len(found.matches)
    ambiguous = int(np.count_nonzero(found.matches.p_match < AMBIGUOUS))
    return [
        "Estimated",
        *entry("common objects", f"{estimate.quantities['common']}: {', '.join(shares)}"),
        *entry("errors", errors),
        *entry("gate", f"{estimate.gate_sigmas:.1f} quoted σ"),
        *(DOUBT + note for note in estimate.notes),
        "",
        "Found",
        *_rows(found.first, found.answers_1),
        *_rows(found.second, found.answers_2),
        *entry("pairs", f"{count(pairs)} identified among {count(len(found.pairs))} candidates"),
        *entry(
            "expected wrong",
            f"{wrong:.1f} of the identified ({percent(wrong / max(pairs, 1))}); missed: {found.expected_missed:.1f}",
        ),
        *entry("ambiguous", f"{count(ambiguous)} identified with a probability below {AMBIGUOUS:g}"),
    ]


def _rows(records: Records, answers: Answers) -> list[str]:
    identified = int(np.count_nonzero(~np.ma.getmaskarray(answers.partner)))
    aside = "".join(f", {count(n)} set aside ({reason})" for reason, n in records.set_aside.counts().items())
    words = f"{count(records.n_table)} rows{aside}, {count(identified)} identified"
    return entry(records.source, words)
