"""Which records of two or more sources are the same objects.

- :func:`identify_many` solves all sources jointly; the result does not depend on their order.
- :func:`identify_sequentially` identifies source after source with the fused picture (METHOD 7 [T]). It is fast, but
  depends on the order, since a wrong pair of an early step is never undone; use it for comparison.

records → pooled → terms → sets → partition → marginals → objects: the pooled records ordered by content, the terms of
their evidence, the sets that could be one object, the best partition into such sets, the probability of each set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array

from sameas._identify import identify
from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence import PoissonField, Rule
from sameas.gate import DEFAULT_GATE, Pairs
from sameas.many.marginals import EXACT, Answer, answer, walked_answer
from sameas.many.objects import Objects
from sameas.many.observations import Region, Source
from sameas.many.pooled import PooledRecords, numbered_groups, pooled
from sameas.many.rules import MissedObjects, Pairwise, PoissonObjects, SetPrior, SetRule, parts_of, terms_of
from sameas.many.sets import TUNING, ManyTuning, Sets, candidate_sets
from sameas.many.walk import can_walk
from sameas.prior import EVIDENCE_ALONE, CommonObjects, Prior
from sameas.ragged import Ragged
from sameas.records import Records


def identify_many(
    sources: Sequence[Source],
    *,
    rule: SetRule,
    prior: SetPrior = EVIDENCE_ALONE,
    gate: Callable[[Records, Records], Pairs] = DEFAULT_GATE,
    region: Region | None = None,
    tuning: ManyTuning = TUNING,
) -> Objects:
    """Objects, each of at most one record per source, with their probabilities.

    Parameters
    ----------
    sources : two or more of Records in one feature space, or Observations of a part of the objects' state.
    rule : the weight of a set of records: ``PoissonObjects(density, q, false)`` if densities are known, otherwise
        ``CloseObjects(a, b)`` or ``Field(density)``; add rules on attributes with ``+``, ``Identity(attributes)`` or
        your own (:mod:`sameas.many.rules` describes how they are called).
    prior : ``MissedObjects(q)`` for the latter two rules; ``PerPair`` odds for every record of an object after its
        first.
    gate : which two records may be one object; every two records of an object are a pair of the gate.
    region : where objects are; required if a source observes a part of the state.
    tuning : limits of the work on a group.

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
    if counts is None and tuning.walked_below > 0.0 and can_walk(together, terms):
        sets, best = walked_answer(sets, together, terms, tuning=tuning)
    else:
        best = answer(sets, together, counts, tuning=tuning)
    return Objects(tuple(sources), together, sets, best, terms)


def identify_sequentially(
    sources: Sequence[Records],
    *,
    rule: SetRule,
    prior: SetPrior = EVIDENCE_ALONE,
    gate: Callable[[Records, Records], Pairs] = DEFAULT_GATE,
) -> Objects:
    """Objects from identifying each source, in the given order, with the fused picture of the previous sources.

    Arguments are those of :func:`sameas.identify_many`. The picture misses an object with the product of the q of
    its sources. An object's probability is the product of those of its steps, as if each step's picture were certain:
    it is not the posterior of ``identify_many``. There is no bound on better partitions: the gap of groups of more than
    one record is infinite.

    Raises
    ------
    InputError : a rule on attributes, which fused objects do not have; a rule that is not made of pairs.
    """
    positions, attributes = parts_of(rule)
    if attributes:
        raise InputError(
            f"identify_sequentially compares positions, and {type(attributes[0]).__name__} needs records, which the "
            "fused picture is not; use it in identify_many"
        )
    if not isinstance(positions, PoissonObjects | Pairwise):
        raise InputError(f"{type(positions).__name__} needs whole sets of records; use it in identify_many")
    together = pooled(sources, gate)
    if len(together.observers.whole) < len(sources):
        raise InputError("identify_sequentially needs sources of whole positions; give the parts to identify_many")
    picture = _Picture.of(together, together.given.index(0))
    for step in range(1, len(sources)):
        picture = picture.with_source(
            together.given.index(step),
            _pair_rule(positions, step, len(sources)),
            _prior(prior, step, len(sources)),
            gate,
        )
    return picture.objects(tuple(sources))


@dataclass(frozen=True)
class _Picture:
    """The objects of the first sources: ``members`` (k, S) record numbers or ABSENT, probabilities ``p`` (k,)."""

    pooled: PooledRecords
    members: IntArray
    p: FloatArray

    @classmethod
    def of(cls, pooled: PooledRecords, s: int) -> _Picture:
        """Every record of source s as an object."""
        numbers = np.arange(pooled.start[s], pooled.start[s + 1])
        members = np.full((len(numbers), len(pooled.sources)), ABSENT)
        members[:, s] = numbers
        return cls(pooled, members, np.ones(len(members)))

    def with_source(self, s: int, rule: Rule, prior: Prior, gate: Callable[[Records, Records], Pairs]) -> _Picture:
        """The picture with the records of source s identified."""
        fused = self.pooled.observers.joint(self.pooled.positions(self.members))
        source = self.pooled.sources[s]
        assert isinstance(source, Records)
        picture = Records.of(fused.state, covariance=fused.covariance, space=source.space, source="picture")
        result = identify(picture, source, rule=rule, prior=prior, gate=gate)
        i, j, p_pair, chosen = result.pairs.i, result.pairs.j, result.p_pair, result.chosen
        p_step = np.clip(1.0 - np.bincount(i, p_pair, len(picture)), 0.0, 1.0)
        p_step[i[chosen]] = p_pair[chosen]
        p_alone = np.clip(1.0 - np.bincount(j, p_pair, len(source)), 0.0, 1.0)
        members = self.members.copy()
        members[i[chosen], s] = j[chosen] + self.pooled.start[s]
        new = _Picture.of(self.pooled, s)
        unmatched = np.setdiff1d(np.arange(len(source)), j[chosen])
        return _Picture(
            self.pooled,
            np.concatenate([members, new.members[unmatched]]),
            np.concatenate([self.p * p_step, p_alone[unmatched]]),
        )

    def objects(self, given: tuple[Records, ...]) -> Objects:
        """The result, whose sets are the picture's objects and all single records."""
        n = len(self.pooled)
        at, source = np.nonzero(self.members != ABSENT)
        membership = coo_array((np.ones(len(at)), (self.members[at, source], at)), shape=(n, len(self.p))).tocsr()
        i, j = (membership @ membership.T).nonzero()
        group = numbered_groups(np.append(self.pooled.i, i), np.append(self.pooled.j, j), n)
        together = replace(self.pooled, group=group)
        singles = np.full((n, self.members.shape[1]), ABSENT)
        singles[np.arange(n), together.source] = np.arange(n)
        size = (self.members != ABSENT).sum(axis=1)
        several = size > 1
        single = ~several
        p_alone, chosen = np.zeros(n), np.zeros(n, bool)
        p_alone[self.members[single].max(axis=1)] = self.p[single]
        chosen[self.members[single].max(axis=1)] = True
        return _result(
            given,
            together,
            np.concatenate([singles, self.members[several]]),
            np.concatenate([p_alone, self.p[several]]),
            np.concatenate([chosen, np.ones(several.sum(), bool)]),
        )


def _result(
    given: tuple[Records, ...], together: PooledRecords, members: IntArray, p: FloatArray, chosen: BoolArray
) -> Objects:
    """Objects from sets (k, S) with their probabilities, of unknown weight and gap."""
    group = together.group[members.max(axis=1)]
    size = (members != ABSENT).sum(axis=1)
    order = np.lexsort([*members.T[::-1], size, group])
    start = Ragged.of_sorted(group[order], len(together.sizes)).start
    several = together.sizes > 1
    sets = Sets(members[order], size[order], np.zeros(len(order)), group[order], start, np.where(several, np.inf, 0.0))
    unknown = np.where(several, np.inf, 0.0)
    solved = Answer(chosen[order], p[order], unknown, np.where(several, 0.0, EXACT))
    return Objects(given, together, sets, solved, terms=None)


def _pair_rule(rule: PoissonObjects | Pairwise, step: int, n_sources: int) -> Rule:
    """The rule of two sources for the picture of the first ``step`` sources and the next source."""
    if isinstance(rule, Pairwise):
        return rule.rule
    q = np.broadcast_to(np.asarray(rule.q, dtype=np.float64), n_sources)
    false = rule.mean_false(n_sources)
    missed = float(np.prod(q[:step]))
    detected = rule.density * (1.0 - missed)
    only_2 = rule.density * missed * (1.0 - q[step]) + float(false[step])
    return PoissonField(detected * (1.0 - q[step]), detected * q[step] + float(false[:step].sum()), only_2)


def _prior(prior: SetPrior, step: int, n_sources: int) -> Prior:
    """The prior of two sources for the picture of the first ``step`` sources and the next source."""
    if not isinstance(prior, MissedObjects):
        return prior
    q = np.broadcast_to(np.asarray(prior.q, dtype=np.float64), n_sources)
    return CommonObjects(float(np.prod(q[:step])), float(q[step]))
