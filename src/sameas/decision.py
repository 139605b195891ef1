"""Decisions by loss: other one-to-one choices of pairs than the most probable hypothesis.

Which one-to-one decision is best depends on the cost of errors:

- The most probable hypothesis (``Identification.chosen``, the MAP) maximises the probability that *all* records are
  right, which is negligible for 1000 uncertain records; it is the papers' answer and good for small groups.
- :func:`most_right` maximises the *expected number of records* of both sources that are decided correctly.
- :func:`least_loss` minimises the *expected loss* where wrong and missed pairs cost differently (METHOD 3.5 [F8–F13],
  one to one): raise ``wrong`` for a list that must be pure, ``missed`` for one that must be complete.

All need only the probabilities of pairs: expected losses add over records, so an assignment finds the exact optimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import BoolArray, FloatArray
from sameas.assignment import assign
from sameas.errors import InputError
from sameas.prior import EVIDENCE_ALONE
from sameas.representation import in_short
from sameas.result import Identification


@in_short
@dataclass(frozen=True)
class Loss:
    """The loss matrix Π of a record of source 1: the cost of one decision where another is true.

    Parameters
    ----------
    wrong : cost of assigning candidate e to a record without a partner; a number, or (m,) at the candidates.
    missed : cost of assigning no partner to a record whose partner is candidate e; a number, or (m,).
    swapped : cost of assigning candidate e to a record whose partner is another; a number, or (m,). None is the sum of
        both errors, ``wrong`` of the assigned and ``missed`` of the true one: the same for both sources.
    """

    wrong: ArrayLike = 1.0
    missed: ArrayLike = 1.0
    swapped: ArrayLike | None = None

    def at(self, m: int) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """``wrong``, ``missed`` and ``swapped`` at m candidates, (m,) each."""
        swapped = None if self.swapped is None else _at(self.swapped, m, "swapped")
        return _at(self.wrong, m, "wrong"), _at(self.missed, m, "missed"), swapped

    def expected(self, p: FloatArray, record: NDArray[np.integer], p_none: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Expected loss (m,) of assigning each candidate to its record, and (n,) of assigning no partner.

        p (m,) and ``p_none`` (n,) are probabilities, of the candidates of ``record`` (m,) and of no partner.
        """
        wrong, missed, swapped = self.at(len(p))
        alone: FloatArray = np.bincount(record, missed * p, len(p_none)).astype(np.float64)
        if swapped is None:
            return wrong * (1.0 - p) + alone[record] - missed * p, alone
        others = np.clip(1.0 - p_none[record] - p, 0.0, 1.0)
        return wrong * p_none[record] + swapped * others, alone


@in_short
@dataclass(frozen=True)
class Decision:
    """A one-to-one decision.

    chosen : (m,) whether each candidate is accepted, in the order of the gate.
    expected_loss : of all records of source 1 that have candidates, in the unit of the losses.
    expected_right : expected number of records of both sources, of those with candidates, that are decided correctly.
    """

    chosen: BoolArray
    expected_loss: float
    expected_right: float


#: Every wrong and every missed pair costs one, a swapped record both.
ONE_EACH = Loss()
#: Every error of a record costs the same, so that its most probable answer is the best.
ALL_ALIKE = Loss(1.0, 1.0, 1.0)


def least_loss(result: Identification, loss: Loss = ONE_EACH) -> Decision:
    """The one-to-one decision of least expected loss.

    Example
    -------
    >>> from sameas import CloseObjects, CommonObjects, Records, identify
    >>> radar = Records.of([[0.0, 0.0], [3.0, 0.0]], sigma=1.0)
    >>> ais = Records.of([[1.4, 0.0]], sigma=1.0)
    >>> answer = identify(radar, ais, rule=CloseObjects(a=1.5, b=6.0), prior=CommonObjects(q1=0.1, q2=0.2))
    >>> int(least_loss(answer).chosen.sum()), int(least_loss(answer, Loss(wrong=20.0)).chosen.sum())
    (1, 0)
    """
    assigned, alone = _losses(result, loss)
    return _decision(result, alone[result.pairs.i] - assigned, loss)


def most_right(result: Identification) -> Decision:
    """The one-to-one decision with the largest expected number of correctly decided records of both sources.

    Its ``expected_loss`` is that of :class:`Loss` with one for each error.
    """
    none_1, none_2 = _p_none(result)
    return _decision(result, 2.0 * result.p_pair - none_1[result.pairs.i] - none_2[result.pairs.j], ONE_EACH)


def evaluate_choice(result: Identification, chosen: BoolArray, loss: Loss = ONE_EACH) -> Decision:
    """Any one-to-one decision among ``result``'s candidates, with its expected loss and number of correct records.

    ``evaluate_choice(result, result.chosen)`` evaluates the most probable hypothesis.
    """
    pairs = result.pairs
    if chosen.shape != (len(pairs),):
        raise InputError(
            f"evaluate_choice: chosen has shape {chosen.shape}; give ({len(pairs)},), one for each candidate"
        )
    for source, record in ((1, pairs.i), (2, pairs.j)):
        if len(np.unique(record[chosen])) != np.count_nonzero(chosen):
            raise InputError(
                f"evaluate_choice: a record of source {source} is chosen twice; give a one-to-one decision"
            )
    assigned, alone = _losses(result, loss)
    without_1 = np.setdiff1d(pairs.i, pairs.i[chosen])
    without_2 = np.setdiff1d(pairs.j, pairs.j[chosen])
    none_1, none_2 = _p_none(result)
    right = 2.0 * result.p_pair[chosen].sum() + none_1[without_1].sum() + none_2[without_2].sum()
    return Decision(chosen, float(assigned[chosen].sum() + alone[without_1].sum()), float(right))


def _decision(result: Identification, gain: FloatArray, loss: Loss) -> Decision:
    """The one-to-one decision of greatest total gain; pairs without a gain are not chosen."""
    groups = result.groups
    best = assign(groups, gain, EVIDENCE_ALONE(groups.sizes_1, groups.sizes_2))
    return evaluate_choice(result, groups.in_given_order(best.chosen), loss)


def _losses(result: Identification, loss: Loss) -> tuple[FloatArray, FloatArray]:
    return loss.expected(result.p_pair, result.pairs.i, _p_none(result)[0])


def _p_none(result: Identification) -> tuple[FloatArray, FloatArray]:
    """(n₁,), (n₂,) probabilities of no partner."""
    p, pairs = result.p_pair, result.pairs
    totals = (np.bincount(pairs.i, p, len(pairs.first)), np.bincount(pairs.j, p, len(pairs.second)))
    return np.clip(1.0 - totals[0], 0.0, 1.0), np.clip(1.0 - totals[1], 0.0, 1.0)


def _at(value: ArrayLike, m: int, name: str) -> FloatArray:
    values = np.asarray(value, np.float64)
    if values.shape not in ((), (m,)):
        raise InputError(f"Loss: {name} has shape {values.shape}; give a number or ({m},), one for each candidate")
    if not np.all((values >= 0.0) & (values < np.inf)):
        raise InputError(f"Loss: {name} is negative or not finite; give what the mistake costs, zero or more")
    return np.broadcast_to(values, m)
