"""Tails: the small share of the pairs that lie much farther apart than the typical one, and how sure that share is.

The spread of the errors is a mixture of normals (:class:`sameas.evidence.Errors`); its components far wider than the
typical error are the tail: outliers, binaries, blends. That the quoted errors are too small for all makes no tail.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.evidence import Errors
from sameas.quantity import Quantity
from sameas.result import Identification

#: A component is of the tail when it is so many times wider than the typical error.
FAR = 2.5
#: Pairs less probable than this do not tell of it. A smaller share than the second is none.
TELLING, LEAST_SHARE = 1e-3, 1e-4


@dataclass(frozen=True)
class Tail:
    """``share`` of the pairs in the tail, and the ``factor`` (geometric mean) of their errors over those quoted."""

    share: Quantity
    factor: float


def tail(answer: Identification, errors: Errors) -> Tail | None:
    """The tail of the errors of the pairs of an answer; None where there is none.

    The standard error is that of the share in a mixture of tail and core of known forms: its information is
    Σ p [(f_tail − f_core) / f]².

    Example
    -------
    >>> found, told = match(plate, gaia)  # doctest: +SKIP
    >>> tail(found, told.errors).share  # doctest: +SKIP
    Quantity(value=0.021, standard_error=0.0018, unit='')
    """
    scales, shares = np.asarray(errors.scales), np.asarray(errors.shares)
    far = scales > FAR * errors.typical_scale
    share = float(shares[far].sum())
    if not LEAST_SHARE < share < 1.0:
        return None
    d, weight = answer.pairs.d, answer.p_pair
    told = weight > TELLING
    # Densities but for what all components have in common.
    square = answer.pairs.mahalanobis_sq[told][:, None]
    density = shares * np.exp(-0.5 * square / scales**2) / scales**d
    outer, core = density[:, far].sum(axis=1) / share, density[:, ~far].sum(axis=1) / (1.0 - share)
    slope = (outer - core) / np.maximum(share * outer + (1.0 - share) * core, np.finfo(float).tiny)
    information = float(np.sum(weight[told] * slope**2))
    factor = math.exp(float(shares[far] @ np.log(scales[far])) / share)
    return Tail(Quantity(share, 1.0 / math.sqrt(max(information, np.finfo(float).tiny))), factor)
