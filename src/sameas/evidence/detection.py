"""Detection: the share of a source's records that the other source shows too, as a function of magnitude.

The logit of the share is that at the record's position (``coverage.py``) plus a curve of its magnitude, fitted by
penalised likelihood to the probability that each record has a partner. For source 2 of a frame and a catalogue this is
P_d(m) of METHOD 3.4, and the share of source 1 without a partner gives β(m).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.representation import in_short

# Parameters of the fitted and of the reported share by magnitude, all chosen.
SORTED_VALUES = 500  # quantiles are taken from about this many values of a longer list: sufficient for knots
PER_KNOT, MAX_KNOTS = 100.0, 24  # records per knot of the curve, and greatest number of knots
#: Prior standard deviations of the curve's logit: of its second differences between knots, and of its value.
BEND, SIGMA = 1.0, 6.0
FIRST_STEPS, STEPS = 8, 2  # number of Newton steps in the first fit, and in later ones
MAX_STEP, TOLERANCE = 2.0, 0.05  # their greatest length in logit, and the length at convergence
MIN_SHARE = 1e-6  # shares are clipped to this … 1 − this
#: Of the reported curve: least number of records in a bin, widths of bins, and greatest number of bins.
MIN_IN_BIN = 30
WIDTHS_MAG = (0.1, 0.2, 0.25, 0.5, 1.0, 2.0)
MAX_BINS = 24


# Piecewise linear curves of a magnitude: their basis, and the sums for fitting them.


def knots_of(
    x: FloatArray, weights: FloatArray, per_knot: float, most: int, sorted_values: int = SORTED_VALUES
) -> FloatArray:
    """(k,) increasing knots at quantiles of ``x``: one per about ``per_knot`` of the weight, at most ``most``.

    sorted_values : quantiles are taken from about this many values.
    """
    count = min(max(round(float(weights.sum()) / per_knot), 1), most - 1) + 1
    step = max(1, len(x) // sorted_values)
    x, weights = x[::step], weights[::step]
    order = np.argsort(x, kind="stable")
    cumulated = np.cumsum(weights[order])
    levels = cumulated[-1] * np.linspace(0.01, 0.99, count)
    knots = x[order][np.minimum(np.searchsorted(cumulated, levels), len(x) - 1)]
    min_distance = 1e-3 * max(float(knots[-1] - knots[0]), 1e-9)
    distinct = np.ones(count, np.bool_)
    np.greater(knots[1:] - knots[:-1], min_distance, out=distinct[1:])
    return np.asarray(knots[distinct])


@dataclass(frozen=True)
class LinearSpline:
    """The basis of piecewise linear curves, constant outside the knots, at n places.

    A curve with values c (k,) at the knots is (1 − part)·c[left] + part·c[left + 1].
    """

    knots: FloatArray
    left: IntArray
    part: FloatArray

    @classmethod
    def at(cls, knots: FloatArray, x: FloatArray) -> LinearSpline:
        """The basis at places ``x`` (n,)."""
        if len(knots) == 1:
            return cls(knots, np.zeros(len(x), np.int64), np.zeros(len(x)))
        left = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
        part = np.clip((x - knots[left]) / (knots[left + 1] - knots[left]), 0.0, 1.0)
        return cls(knots, left, part)

    def curve(self, values: FloatArray) -> FloatArray:
        """(n,) the curve with these values (k,) at the knots."""
        padded = np.append(values, values[-1])
        low = padded[self.left]
        return np.asarray(low + self.part * (padded[self.left + 1] - low))

    def sum(self, weights: FloatArray) -> FloatArray:
        """(k,) Σ weights · basis."""
        k = len(self.knots)
        upper = np.bincount(self.left + 1, weights * self.part, k + 1)[:k]
        return np.asarray(np.bincount(self.left, weights * (1.0 - self.part), k) + upper, np.float64)


def roughness(k: int, bend: float, weight: FloatArray | float = 1.0) -> FloatArray:
    """(k, k) penalty of curves whose second differences between knots are N(0, bend²), with weights (k − 2,)."""
    second = np.diff(np.eye(k), n=2, axis=0) / bend
    return np.asarray((second.T * weight) @ second)


@in_short
@dataclass(frozen=True)
class DetectionCurve:
    """The share of a source's covered records that the other source shows, in bins of magnitude.

    band : its name. edges : (b + 1,) mag. number : (b,) records.
    probability, standard_error : (b,) of the share; the error is that of counting and of uncertain pairs.
    density : (b,) of records without a partner, per (residual unit)^d and mag; density_error : its error.
    """

    band: str
    edges: FloatArray
    number: FloatArray
    probability: FloatArray
    standard_error: FloatArray
    density: FloatArray
    density_error: FloatArray

    @classmethod
    def of(cls, band: str, magnitude: FloatArray, p_partner: FloatArray, volume: float) -> DetectionCurve:
        """From finite magnitudes (n,) with the probabilities of a partner, in a volume of feature space."""
        edges = _edges(magnitude)
        bins = len(edges) - 1
        at = np.clip(np.searchsorted(edges, magnitude, side="right") - 1, 0, bins - 1)
        number = np.bincount(at, minlength=bins).astype(np.float64)
        matched, variance = (
            np.bincount(at, p, bins).astype(np.float64) for p in (p_partner, p_partner * (1.0 - p_partner))
        )
        share = matched / np.maximum(number, 1.0)
        error = share_error(number, matched, variance)
        unmatched, size = np.maximum(number - matched, 0.0), max(volume, 1e-300) * np.diff(edges)
        # Poisson variance of the count, and the variance from uncertain pairs.
        sigma = np.sqrt(np.maximum(unmatched, 0.5) + variance)
        return cls(band, edges, number, share, error, unmatched / size, sigma / size)

    @property
    def middle(self) -> FloatArray:
        """(b,) centres of the bins, mag."""
        return 0.5 * (self.edges[1:] + self.edges[:-1])


def share_error(number: FloatArray, matched: FloatArray, variance: FloatArray) -> FloatArray:
    """Standard error of shares matched / number, where ``matched`` has the ``variance`` Σ p(1 − p).

    Binomial, divided by the share of information present: 1 − r with r = Σ p(1 − p) / [n s (1 − s)]. An empty or full
    bin counts as half a record from the end.
    """
    share = (matched + 0.5) / (number + 1.0)
    binomial = share * (1.0 - share) / (number + 1.0)
    missing = np.clip(variance / np.maximum(number * share * (1.0 - share), 1e-300), 0.0, 0.95)
    return np.sqrt(binomial / (1.0 - missing))


def _edges(magnitude: FloatArray) -> FloatArray:
    """Edges of equal bins of a round width; sparse bins at both ends are merged."""
    low, high = float(magnitude.min()), float(magnitude.max())
    width = next((w for w in WIDTHS_MAG if (high - low) / w <= MAX_BINS), (high - low) / MAX_BINS)
    edges = width * np.arange(np.floor(low / width), np.floor(high / width) + 2)
    count = np.bincount(((magnitude - edges[0]) / width).astype(np.int64), minlength=len(edges) - 1)[: len(edges) - 1]
    below, above = np.cumsum(count), np.cumsum(count[::-1])
    begin = int(np.searchsorted(below, MIN_IN_BIN))
    end = len(count) - int(np.searchsorted(above, MIN_IN_BIN))
    return edges[[0, -1]] if end <= begin + 1 else np.concatenate([edges[:1], edges[begin + 1 : end], edges[-1:]])


@dataclass(frozen=True)
class ShareCurve:
    """The addition to the logit of a record's share by its magnitude: (k,) values at (k,) knots, mag."""

    knots: FloatArray
    values: FloatArray

    @classmethod
    def fit(
        cls, magnitude: FloatArray, share: FloatArray, p_partner: FloatArray, start: ShareCurve | None = None
    ) -> ShareCurve:
        """The curve of greatest penalised likelihood, from magnitudes (n,), shares at the records' positions, and the
        probabilities of a partner; a few steps from ``start`` if given."""
        if start is None:
            # Records with and without a partner in equal parts; with a share of one half, every record counts as one.
            mean = min(max(float(p_partner.mean()), MIN_SHARE), 1.0 - MIN_SHARE)
            weights = 2.0 * ((1.0 - mean) * p_partner + mean * (1.0 - p_partner))
            knots = knots_of(magnitude, weights, PER_KNOT, MAX_KNOTS, len(magnitude))
            start = cls(knots, np.zeros(len(knots)))
        from sameas.kernels.relation import climb

        values, k = start.values.copy(), len(start.knots)
        steps = STEPS if values.any() else FIRST_STEPS
        climb(
            magnitude, logit(share, MIN_SHARE), p_partner, start.knots,
            _penalty(k, BEND, SIGMA), values,
            steps, MAX_STEP, TOLERANCE,
        )  # fmt: skip
        return cls(start.knots, values)

    def logit(self, magnitude: FloatArray) -> FloatArray:
        """(n,) the addition to the logit at magnitudes (n,); 0 where NaN."""
        known = np.isfinite(magnitude)
        spline = LinearSpline.at(self.knots, np.where(known, magnitude, self.knots[0]))
        return np.where(known, spline.curve(self.values), 0.0)

    def terms(self, magnitude: FloatArray, share: FloatArray, rows: NDArray[np.integer] | None = None) -> FloatArray:
        """(n,) the change of a pair's log-odds when the share s of its record becomes s(m); 0 where m is unknown.

        Half of ln s, because the density of common objects comes from the records of both sources, minus ln (1 − s) of
        those that only one source shows. rows : records to compute, the others get 0; all if not given.
        """
        from sameas.kernels.relation import weigh

        terms = np.zeros(len(magnitude))
        rows = np.arange(len(magnitude)) if rows is None else rows
        weigh(magnitude, share, rows, MIN_SHARE, self.knots, self.values, terms)
        return terms


@cache
def _penalty(k: int, bend: float, sigma: float) -> FloatArray:
    """(k, k) penalty that draws a curve's values towards a straight line and towards zero."""
    return np.asarray(roughness(k, bend) + np.eye(k) / sigma**2)


def logit(share: FloatArray, min_share: float = MIN_SHARE) -> FloatArray:
    """ln s / (1 − s), for shares clipped to MIN_SHARE … 1 − MIN_SHARE."""
    share = np.clip(share, min_share, 1.0 - min_share)
    return np.log(share) - np.log1p(-share)
