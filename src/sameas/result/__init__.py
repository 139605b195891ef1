"""The result: which records are the same object, with probabilities and explanations.

- :class:`Identification`: the answer of :func:`sameas.identify`, with the values of all stages.
- :class:`Explanation`: why one record was identified as it was.
- :func:`least_loss`, :func:`most_right`: other choices of pairs, such as where wrong pairs cost more than missed ones.
"""

from sameas.result.explanation import Competitor, Explanation
from sameas.result.identification import (
    ALL_ALIKE,
    Answers,
    Decision,
    Identification,
    Loss,
    Matches,
    evaluate_choice,
    least_loss,
    most_right,
)

__all__ = [
    "ALL_ALIKE", "Answers", "Competitor", "Decision", "Explanation", "Identification", "Loss", "Matches",
    "evaluate_choice", "least_loss", "most_right",
]  # fmt: skip
