"""Magnitudes as evidence for sets of records of many catalogues.

The relations of the magnitudes of every two catalogues are known from their pairwise match
(:mod:`sameas.estimate.photometry`). For a set of records with magnitudes m_1 … m_k

    ln p(m_1, …, m_k | one object) − Σ_i ln p(m_i)
        ≈ Σ_(a,b) in T  [ln p(m_a, m_b | one object) − ln p(m_a) − ln p(m_b)] ,

T a tree that connects the records. This is exact if magnitudes that T does not join are independent given those
between them; of all trees that with the most informative edges is closest to the truth (Chow & Liu 1968, IEEE Trans.
Inf. Theory 14, 462). The sum over all pairs instead would count one agreement several times: three catalogues have
three pairs, but two independent differences of magnitude.

Each set has its own tree, from its records with a magnitude: edges are taken in the order of their mean information
per object, unless they close a circle (Kruskal).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.evidence.brightness import Chain, SourceMagnitudes
from sameas.records import Records
from sameas.sky.catalogue import Catalogue
from sameas.sky.evidence_columns import AUTO, magnitudes_of
from sameas.sky.sky_match import SkyMatch

#: Minimum mean information of an edge, ln per object: less cannot change an answer (chosen).
LEAST_INFORMATION = 0.05


@dataclass(frozen=True)
class MagnitudeEdge:
    """The relation of the magnitudes of two catalogues.

    sides : their magnitudes, in the order of their records. chains : p(m₁ | m₂) and p(m₂ | m₁). information : mean of
    the log-ratio over the common objects.
    """

    sides: tuple[SourceMagnitudes, SourceMagnitudes]
    chains: tuple[Chain, Chain]
    information: float = 0.0

    @classmethod
    def of(
        cls,
        match: SkyMatch,
        catalogues: tuple[Catalogue, Catalogue],
        records: tuple[Records, Records],
        candidates: tuple[IntArray, IntArray, FloatArray],
    ) -> MagnitudeEdge | None:
        """The relation fitted by a match of two catalogues; None without one.

        records : of the catalogues, in any order. candidates : indices in these records, and probabilities.
        """
        photometry = match.estimate.photometry
        magnitudes = magnitudes_of(*catalogues, AUTO)
        if photometry is None or photometry.chains is None or not photometry.has_relation or magnitudes is None:
            return None
        one, two = (
            replace(side, measured=given.of(some))
            for side, given, some in zip(photometry.sides, magnitudes, records, strict=True)
        )
        edge = cls((one, two), photometry.chains)
        i, j, p = candidates
        likely = np.flatnonzero(p > 0.5)
        if not len(likely):
            return None
        log_ratio = edge(i[likely], j[likely])
        return replace(edge, information=float(np.average(log_ratio, weights=p[likely])))

    def __call__(self, i: IntArray, j: IntArray) -> FloatArray:
        """(m,) ln p(m₁, m₂ | one object) − ln p(m₁) − ln p(m₂) of records i and j (m,); each pair is computed once."""
        n = len(self.sides[1].measured.values)
        pairs, inverse = np.unique(i.astype(np.int64) * n + j, return_inverse=True)
        i, j = pairs // n, pairs % n
        one, two = self.sides
        forth = self.chains[0].log_ratio(one.compared(i, two.measured.take(j)))
        back = self.chains[1].log_ratio(two.compared(j, one.measured.take(i)))
        return np.asarray((0.5 * (forth + back))[inverse])

    def measured(self, side: int) -> BoolArray:
        """(n,) mask of the records of one side with a magnitude."""
        return np.asarray(np.isfinite(self.sides[side].measured.values).any(axis=1))


@dataclass(frozen=True)
class SetMagnitudes:
    """The evidence of the magnitudes of a set. edges : by numbers of catalogues a < b, the most informative first."""

    edges: Mapping[tuple[int, int], MagnitudeEdge]

    @classmethod
    def of(
        cls,
        matches: Mapping[tuple[int, int], SkyMatch],
        catalogues: Sequence[Catalogue],
        records: Sequence[Records],
        candidates: Mapping[tuple[int, int], tuple[IntArray, IntArray, FloatArray]],
    ) -> SetMagnitudes:
        """From the pairwise matches of the catalogues; candidates : of each match, with their probabilities."""
        found = {}
        for (a, b), match in matches.items():
            both = (catalogues[a], catalogues[b]), (records[a], records[b])
            edge = MagnitudeEdge.of(match, *both, candidates[a, b])
            if edge is not None and edge.information > LEAST_INFORMATION:
                found[a, b] = edge
        return cls(dict(sorted(found.items(), key=lambda one: (-one[1].information, one[0]))))

    def __call__(self, sets: NDArray[np.integer]) -> FloatArray:
        """(k,) log-ratios of sets (k, catalogues) of indices in the records; 0 for single ones."""
        total = np.zeros(len(sets))
        tree = np.tile(np.arange(sets.shape[1]), (len(sets), 1))  # the number of the part that each record belongs to
        for (a, b), edge in self.edges.items():
            joined = (sets[:, a] != ABSENT) & (sets[:, b] != ABSENT) & (tree[:, a] != tree[:, b])
            joined &= edge.measured(0)[sets[:, a]] & edge.measured(1)[sets[:, b]]
            k = np.flatnonzero(joined)
            if not len(k):
                continue
            total[k] += edge(sets[k, a], sets[k, b])
            tree[k] = np.where(tree[k] == tree[k, b][:, None], tree[k, a][:, None], tree[k])
        return total
