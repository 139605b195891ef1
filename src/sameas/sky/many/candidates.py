"""Candidates: which records of every two catalogues can be one star, found two by two and through a third.

Every two catalogues are identified with each other first (:func:`sameas.sky.match.match`): that chooses how wide their
gate must be, which their residuals alone can tell. Two catalogues without motions miss each other's fast stars, whose
records lie beyond any gate; where a third catalogue knows the motion, records that both are candidates of one of its
moving records are candidates of each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.sparse import csr_array

from sameas.gate import Pairs
from sameas.records import FloatArray, IntArray, Records
from sameas.sky.many.stars import Sightings
from sameas.sky.match import SkyMatch
from sameas.space import sphere_offset

#: Candidates less probable than this, two by two, lead to no others.
PLAUSIBLE = 1e-6

Matches = Mapping[tuple[int, int], SkyMatch]


@dataclass(frozen=True)
class Candidates:
    """Candidate pairs of every two catalogues; a gate for :func:`sameas.union.union`, called by their records' names.

    records : of every catalogue. found : per two of them (a < b) the positions i (m,) and j (m,) in their records.
    """

    records: tuple[Records, ...]
    found: Mapping[tuple[int, int], tuple[IntArray, IntArray]]

    @classmethod
    def of(cls, matches: Matches, records: Sequence[Records], sightings: Sequence[Sightings]) -> Candidates:
        """Those of the ``matches`` of every two catalogues, and those that moving stars lead to."""
        links = {}
        for (a, b), match in matches.items():
            i, j, p = positions(match, records[a], records[b])
            links[a, b] = csr_array((p + 1.0, (i, j)), shape=(len(records[a]), len(records[b])))
        found = {}
        for a, b in combinations(range(len(records)), 2):
            link = links[a, b]
            for c in range(len(records)):
                if c in (a, b) or not sightings[c].moving.any():
                    continue
                to, off = _through(links, a, c), _through(links, c, b)
                link = link + (to * sightings[c].moving.astype(np.float64)) @ off
            pairs = csr_array(link).tocoo()
            found[a, b] = pairs.row.astype(np.int64), pairs.col.astype(np.int64)
        return cls(tuple(records), found)

    def __call__(self, first: Records, second: Records) -> Pairs:
        """The candidates of two of the catalogues, whatever the order of their records."""
        names = [records.source for records in self.records]
        a, b = names.index(first.source), names.index(second.source)
        i, j = self.found[min(a, b), max(a, b)]
        if a > b:
            i, j = j, i
        return measured(first, second, place(self.records[a], first)[i], place(self.records[b], second)[j])


def positions(match: SkyMatch, first: Records, second: Records) -> tuple[IntArray, IntArray, FloatArray]:
    """A match's candidates as positions in two sets of records of its catalogues, and their probabilities."""
    result = match.result
    i, known_1 = _known(first, result.rows_1)
    j, known_2 = _known(second, result.rows_2)
    known = known_1 & known_2
    return i[known], j[known], result.p_pair[known]


def measured(first: Records, second: Records, rows_1: IntArray, rows_2: IntArray) -> Pairs:
    """Pairs of records on the sphere, named by position, with residuals, squared distances and determinants."""
    i, j = rows_1.astype(np.int32), rows_2.astype(np.int32)
    offset = sphere_offset(*first.features[i].T, *second.features[j].T)
    nothing = np.zeros(len(i))
    pairs = Pairs(first, second, i, j, i, j, offset, nothing, nothing, "candidates of the catalogues two by two")
    sigma = pairs.covariance
    distance = np.einsum("kv,kvw,kw->k", offset, np.linalg.inv(sigma), offset)
    return replace(pairs, mahalanobis_sq=distance, determinant=np.linalg.det(sigma))


def place(records: Records, among: Records) -> IntArray:
    """(n,) where each of the ``records`` stands among the same records in another order."""
    order = np.argsort(among.rows)
    return order[np.searchsorted(among.rows, records.rows, sorter=order)]


def _through(links: Mapping[tuple[int, int], csr_array], a: int, b: int) -> csr_array:
    """Plausible candidates of catalogues a and b, in either order, as a matrix of ones."""
    kept = csr_array(links[a, b] if a < b else links[b, a].T)
    kept.data = np.where(kept.data > 1.0 + PLAUSIBLE, 1.0, 0.0)
    kept.eliminate_zeros()
    return kept


def _known(records: Records, rows: IntArray) -> tuple[IntArray, np.ndarray]:
    """Positions of table rows among the records, and whether they are there."""
    at = np.minimum(np.searchsorted(records.rows, rows), max(len(records) - 1, 0))
    return at, records.rows[at] == rows
