"""Mori's formula compared with simulation: the share of objects that one-to-one assignment gives their own record.

For objects of density β that both sources always see, assignment of least Σ ΔᵀΣ⁻¹Δ gives an object its own record
with a probability of about exp(−C_m β √|S|), S the covariance of the residual, m the number of features, and
C_m = 2^(m−1) π^((m−1)/2) Γ((m+1)/2) / Γ(m/2+1): 2/√π, π and 9.45 for one, two and three features (Mori, Chang, Chong
and Dunn, "Prediction of track purity and track accuracy in dense target environments", IEEE Trans. Automatic Control
40, 953–959, 1995, equations 2 and 3). It counts exchanges of two records only, and is exact to first order in β.
"""

from __future__ import annotations

import math

import numpy as np

from benchmarks.study.scenes import EQUAL
from benchmarks.study.tally import Ratio
from benchmarks.study.trial import generator
from sameas.gate import ChiSquare
from sameas.groups import groups
from sameas.score.baselines import most_pairs
from sameas.simulate.scenes import poisson_field
from sameas.space import Plane

#: Objects of a field without edges.
OBJECTS = 400
DENSITIES = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6)


def constant(m: int) -> float:
    """C_m."""
    return 2.0 ** (m - 1) * math.pi ** ((m - 1) / 2) * math.gamma((m + 1) / 2) / math.gamma(m / 2 + 1)


def formula(density: float, m: int) -> float:
    """exp(−C_m β √|S|) for S = 1 in every feature."""
    return math.exp(-constant(m) * density)


def simulated(density: float, m: int, fields: int) -> Ratio:
    """Share of the objects that get their own record, in ``fields`` periodic fields of :data:`OBJECTS` on average."""
    rng = generator(f"mori {m} {density}", 0)
    side = (OBJECTS / density) ** (1.0 / m)
    shares = []
    for _ in range(fields):
        scene = poisson_field(rng, density=density, extent=(side,) * m, q1=0.0, q2=0.0, sigma_1=EQUAL[0],
                              sigma_2=EQUAL[1], space=Plane((side,) * m))  # fmt: skip
        pairs = ChiSquare()(scene.first, scene.second)
        chosen = most_pairs(pairs, groups(pairs))
        shares.append(np.mean(scene.truth_1[pairs.i[chosen]] == scene.truth_2[pairs.j[chosen]]))
    return Ratio(float(np.mean(shares)), float(np.std(shares, ddof=1) / math.sqrt(fields)) if fields > 1 else math.nan)
