"""The result: which records are the same object, how sure it is, and why.

- :class:`Identification`: the answer of :func:`sameas.identify`, with every stage's value.
- :class:`Explanation`: why one record was identified as it was.
- :func:`least_loss`, :func:`most_right`: another choice of pairs, where a wrong one costs more than a missed one.
"""

from sameas.result.explanation import Competitor, Explanation
from sameas.result.identification import (
    ALL_ALIKE,
    Answers,
    Decision,
    Identification,
    Loss,
    Matches,
    judged,
    least_loss,
    most_right,
)

__all__ = [
    "ALL_ALIKE", "Answers", "Competitor", "Decision", "Explanation", "Identification", "Loss", "Matches", "judged",
    "least_loss", "most_right",
]  # fmt: skip
