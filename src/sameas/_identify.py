"""The whole method, one line per stage."""

from __future__ import annotations

from collections.abc import Callable

from sameas.assignment import assign, refuse_crowds
from sameas.evidence import Rule
from sameas.gate import DEFAULT_GATE, Pairs
from sameas.groups import groups
from sameas.kernels.threads import both
from sameas.posterior import posterior
from sameas.prior import EVIDENCE_ALONE, Prior
from sameas.records import Records
from sameas.result import Identification


def identify(
    first: Records,
    second: Records,
    *,
    rule: Rule,
    prior: Prior = EVIDENCE_ALONE,
    gate: Callable[[Records, Records], Pairs] = DEFAULT_GATE,
    certify: bool = False,
) -> Identification:
    """Which records of two sources are the same object, one to one, with probabilities.

    Parameters
    ----------
    first, second : records of the two sources, in one feature space.
    rule : the evidence, e.g. ``CloseObjects(a, b)``, ``PoissonField(…)``; rules add with ``+``.
    prior : of the number of common objects; ``PerPair(0)`` leaves it to the rule.
    gate : which pairs are candidates.
    certify : refuse to answer unless dual variables prove that no other hypothesis is more probable.

    Example
    -------
    >>> from sameas import CloseObjects, CommonObjects, Records, identify
    >>> radar = Records.of([[0.0, 0.0], [10.0, 0.0]], sigma=1.0, source="radar")
    >>> ais = Records.of([[0.4, -0.2], [30.0, 5.0]], sigma=0.5, source="ais")
    >>> answer = identify(radar, ais, rule=CloseObjects(a=2.0, b=20.0), prior=CommonObjects(q1=0.1, q2=0.2))
    >>> answer.matches.rows_1, answer.matches.rows_2
    (array([0]), array([0]))
    """
    pairs = gate(first, second)
    refuse_crowds(pairs)
    grouped, evidence = both(lambda: groups(pairs), lambda: rule(pairs), len(pairs))
    log_prior = prior(grouped.sizes_1, grouped.sizes_2)
    best = assign(grouped, evidence.log_ratio, log_prior)
    if certify:
        best.certify(grouped)
    probabilities = posterior(grouped, best)
    return Identification(pairs, grouped, evidence, best, probabilities)
