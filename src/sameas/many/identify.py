"""Many sources: which of their records are the same objects, solved jointly, one line a stage.

Use :func:`identify_many` for two sources or more; the answer does not depend on their order. The papers' way, source
after source against the fused picture, is :func:`sameas.many.sequential.identify_sequentially`.

records → pooled → rules → sets → partition → marginals → objects: the pooled records in an order of their content,
their terms, the sets that could be one object, the best partition into such sets, the probability of each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sameas.gate import DEFAULT_GATE, Pairs
from sameas.many.marginals import answer
from sameas.many.objects import Objects
from sameas.many.observations import Region, Source
from sameas.many.pooled import pooled
from sameas.many.rules import MissedObjects, SetPrior, SetRule, terms_of
from sameas.many.sets import TUNING, ManyTuning, candidate_sets
from sameas.prior import EVIDENCE_ALONE
from sameas.records import Records


def identify_many(
    sources: Sequence[Source],
    *,
    rule: SetRule,
    prior: SetPrior = EVIDENCE_ALONE,
    gate: Callable[[Records, Records], Pairs] = DEFAULT_GATE,
    region: Region | None = None,
    time_limit_s: float = 60.0,
    tuning: ManyTuning = TUNING,
) -> Objects:
    """Which records of two sources or more are one object, at most one of each source, and how sure that is.

    Parameters
    ----------
    sources : Records in one feature space, or Observations of a part of the objects' state.
    rule : the weight of a set of records: ``PoissonObjects(density, q, false)`` where densities are known,
        ``CloseObjects(a, b)`` or ``Field(density)`` where they are not; and, added to it, rules on attributes,
        ``Identity(attributes)`` or your own (:mod:`sameas.many.rules` says how they are called).
    prior : ``MissedObjects(q)`` beside the latter two; ``PerPair`` odds for every record beyond an object's first.
    gate : which two records may be one object; all records of an object are pairs of the gate.
    region : where objects are; needed where a source observes a part of the state.
    time_limit_s : of branch and bound in one group; where it is reached the answer states its gap.
    tuning : numbers that bound the work of a group.

    Source: METHOD 7; for two sources it is :func:`sameas.identify` with ``PoissonField`` or ``CommonObjects``.

    Example
    -------
    >>> from sameas.many.rules import PoissonObjects
    >>> radar = Records.of([[0.0, 0.0], [10.0, 0.0]], sigma=1.0, source="radar")
    >>> ais = Records.of([[0.4, -0.2], [30.0, 5.0]], sigma=0.5, source="ais")
    >>> lidar = Records.of([[10.3, 0.3]], sigma=0.2, source="lidar")
    >>> picture = identify_many([radar, ais, lidar], rule=PoissonObjects(density=1e-3, q=0.2))
    >>> print(picture.members)
    [[1 -- 0]
     [0 0 --]
     [-- 1 --]]
    """
    together = pooled(sources, gate, region)
    terms = terms_of(rule, prior, together)
    sets = candidate_sets(together, terms, tuning)
    counts = prior if isinstance(prior, MissedObjects) else None
    best = answer(sets, together, counts, time_limit_s=time_limit_s, tuning=tuning)
    return Objects(tuple(sources), together, sets, best, terms)
