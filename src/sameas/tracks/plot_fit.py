"""The biases of a radar's plots without ids near an azimuth, by EM over plots and tracks.

With the probabilities of plots to be of tracks as weights (the model is that of :mod:`sameas.tracks.plot_offsets`), a
linear least-squares problem has the biases, a constant place of the echo along and across each hull and, for a sensor
that moves, its place relative to that reported, and the drift of its azimuth: a radar on a boat measures from the bow,
and the heading is of a compass, whose error changes by degrees within minutes. The drift is an Ornstein-Uhlenbeck
process at knots of time, interpolated between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import LOG_2PI, inverse
from sameas.tracks.bias_fit import MAX_STEPS, STEP_TOLERANCE, BiasFit
from sameas.tracks.biases import AZIMUTH, RANGE, TIME, AzimuthDrift
from sameas.tracks.duplicate_ids import WAY_M_PER_S
from sameas.tracks.plot_pairs import AZIMUTH_REACH, FITTED, PLOT_RATES, PlotPairs, Plots, first_of_scans, moves

#: Bounds of the fitted factors on the errors, and weight of the trial factor, in plots.
SCALE_LIMITS, SCALE_PRIOR = (0.4, 4.0), 10.0
#: Weight of the described extents when they are estimated, in tracks; 1σ of the mean of the antennas' places along the
#: course, as a share of them (chosen).
HULL_PRIOR, HULL_ALONG = 2.0, 0.25
#: Weight of the median of PLOT_RATES, in scans; minimum number of plots of a detected track.
RATE_PRIOR, MIN_PLOTS = 10.0, 3.0
STATION_M = 5.0  # 1σ per axis of the place of a moving sensor: its antenna is not that of the positioning (chosen)
#: Time between the knots of a drift of the azimuth, and their maximum number (chosen, as the following).
COMPASS_KNOT_S, COMPASS_KNOTS = 30.0, 400
#: Its expected correlation time, the bounds of the fitted one, its expected 1σ, and the weight of both, in knots.
COMPASS_CORRELATION_S, COMPASS_LIMITS_S, COMPASS_DEG, COMPASS_PRIOR = 60.0, (15.0, 600.0), 0.3, 4.0


@dataclass(frozen=True)
class Knots:
    """The knots of a drift, at equal intervals. time_s : (k,), none for a sensor that does not drift."""

    time_s: FloatArray

    @classmethod
    def of(cls, time_s: FloatArray, sensor: FloatArray) -> Knots:
        """The knots for plots at these times (n,) from these positions of the sensor (n, 2)."""
        if not moves(sensor):
            return cls(np.empty(0))
        first, last = float(time_s.min()), float(time_s.max())
        count = int(np.clip(np.ceil((last - first) / COMPASS_KNOT_S) + 1, 2, COMPASS_KNOTS))
        return cls(np.linspace(first, last, count))

    def __len__(self) -> int:
        return len(self.time_s)

    def around(self, time_s: FloatArray) -> tuple[IntArray, FloatArray]:
        """(n, 2) the knots before and after these times, and (n, 2) their weights."""
        after = np.clip(np.searchsorted(self.time_s, time_s), 1, len(self) - 1)
        width = self.time_s[after] - self.time_s[after - 1]
        share = np.clip((time_s - self.time_s[after - 1]) / np.maximum(width, 1e-9), 0.0, 1.0)
        return np.column_stack([after - 1, after]), np.column_stack([1.0 - share, share])

    def mean_weights(self, time_s: FloatArray) -> FloatArray:
        """(k,) weights of the knots in the mean over these times."""
        if not len(self):
            return np.empty(0)
        knot, share = self.around(time_s)
        return np.bincount(knot.ravel(), share.ravel(), len(self)) / max(len(time_s), 1)

    @property
    def interval_s(self) -> float:
        """The time between knots."""
        return float(self.time_s[1] - self.time_s[0])

    def precision(self, correlation_s: float) -> FloatArray:
        """(k, k) inverse covariance at the knots of the process of variance 1 with this correlation time."""
        keep = np.exp(-np.diff(self.time_s) / correlation_s)
        step = 1.0 / np.maximum(1.0 - keep**2, 1e-9)
        out = np.eye(len(self))
        at = np.arange(len(keep))
        out[at, at] += keep**2 * step
        out[at + 1, at + 1] += keep**2 * step
        out[at, at + 1] = out[at + 1, at] = -keep * step
        return out


@dataclass(frozen=True)
class _Estimates:
    """The estimates after an EM iteration, and the probabilities and precisions that it used.

    state : of :class:`_Parts`; covariance, information, prior : of it. rate : (t,) plots of each track per scan.
    scales : factors on the errors in range and across. lasting_m2 : variances of places along and across a hull.
    drift_variance : (m,) at each pair. residual, variance, weight : (m, 2), (m, 2), (m,) of the pairs, by the estimates
    before. total : (t,) plots of each track.
    """

    state: FloatArray
    rate: FloatArray
    scales: FloatArray
    lasting_m2: FloatArray
    process: _Process
    drift_variance: FloatArray
    residual: FloatArray
    variance: FloatArray
    weight: FloatArray
    total: FloatArray
    covariance: FloatArray
    information: FloatArray
    prior: FloatArray

    @classmethod
    def initial(cls, parts: _Parts, pairs: PlotPairs, azimuth_deg: float, spread: tuple[float, float]) -> _Estimates:
        """Those at the start; the others are not known yet."""
        state, none = np.zeros(parts.size), np.empty(0)
        state[parts.azimuth] = azimuth_deg
        rate = np.full(len(pairs.scans), float(np.median(PLOT_RATES)))
        process = _Process(max(spread[1], COMPASS_DEG) ** 2, COMPASS_CORRELATION_S)
        drift_variance = np.full(len(pairs.plot), process.variance_deg2 if len(parts.knots) else 0.0)
        scales, lasting_m2 = np.full(2, spread[0]), np.full(2, pairs.lasting_m2)
        return cls(state, rate, scales, lasting_m2, process, drift_variance, *[none] * 7)

    def iterated(self, parts: _Parts, pairs: PlotPairs, n_plots: int, scale: float) -> _Estimates:
        """Those after one more iteration. scale : prior factor on the errors."""
        residual = pairs.residual - (parts.design @ self.state).reshape(-1, 2)
        variance = self.scales**2 * pairs.variance
        # Where the drift is not known yet, plots farther off are possible.
        lever = pairs.jacobian[:, 1, FITTED.index(AZIMUTH)]
        wide = variance + np.column_stack([np.zeros(len(lever)), lever**2 * self.drift_variance])
        weight = _probabilities(pairs, residual, wide, self.rate, n_plots)
        total = np.asarray(np.bincount(pairs.track, weight, len(pairs.scans)), np.float64)
        rate = (total + RATE_PRIOR) / (pairs.scans + RATE_PRIOR / np.median(PLOT_RATES))
        weighted = parts.design.multiply((weight[:, None] / variance).reshape(-1, 1)).tocsr()
        target = residual.ravel() + parts.design @ self.state
        prior = parts.prior(self.lasting_m2, self.process)
        information = (weighted.T @ parts.design).toarray() + prior
        covariance = inverse(information)
        state = covariance @ (weighted.T @ target)
        # The variances of places on the hull, of the detected tracks, and of the drift.
        detected = total > MIN_PLOTS
        square = (state**2 + np.diag(covariance))[parts.hulls].reshape(-1, 2)[detected].sum(axis=0)
        lasting_m2 = (square + HULL_PRIOR * pairs.lasting_m2) / (detected.sum() + HULL_PRIOR)
        chi_sq = np.einsum("m,ma->a", weight, residual**2 / pairs.variance)
        scales = np.sqrt((chi_sq + SCALE_PRIOR * scale**2) / (weight.sum() + SCALE_PRIOR))
        return _Estimates(
            state, rate, np.clip(scales, *SCALE_LIMITS), lasting_m2, parts.process(state, covariance),
            parts.drift_variance(covariance), residual, variance, weight, total, covariance, information, prior,
        )  # fmt: skip

    def has_converged(self, before: FloatArray, parts: _Parts) -> bool:
        """Whether the biases differ by a small part of their errors from those of the state before."""
        change = np.abs(parts.reported @ (self.state - before))
        errors = np.sqrt(np.einsum("pq,qr,pr->p", parts.reported, self.covariance, parts.reported))
        return bool(np.all(change < STEP_TOLERANCE * errors))


def refined(
    pairs: PlotPairs, widths: FloatArray, azimuth_deg: float, spread: tuple[float, float], plots: Plots
) -> BiasFit:
    """The biases near an azimuth, by EM over plots and tracks, with a constant place of the echo on each hull, and with
    a drift of the azimuth if the sensor moves.

    spread : factor on the errors of plots, and 1σ of the drift, at the start.
    """
    parts, converged = _Parts.of(pairs, widths, plots), False
    em = _Estimates.initial(parts, pairs, azimuth_deg, spread)
    for step in range(MAX_STEPS):
        before, em = em.state, em.iterated(parts, pairs, len(plots), spread[0])
        converged = step > 3 and em.has_converged(before, parts)
        if converged:
            break
    sure, detected = em.weight > 0.5, em.total > MIN_PLOTS
    error = (em.residual[:, 1] / np.sqrt(em.variance[:, 1]))[sure]
    inflation = _variance_inflation(plots.time_s[pairs.plot[sure]], pairs.track[sure], error)
    covariance = inverse((em.information - em.prior) / inflation + em.prior)
    p = len(parts.fitted)
    speed = np.hypot(*pairs.jacobian[sure, :, FITTED.index(TIME)].T)
    biases = np.array([FITTED[k] for k in parts.fitted], np.int64)
    moving = float(np.median(speed)) if sure.any() else 0.0
    common = np.diag(_common_hull(biases, float(np.sqrt(em.lasting_m2[0])), moving) ** 2)
    # The azimuth is the mean over the recording, and its standard error that of the mean without drift.
    of_mean = parts.reported @ covariance @ parts.reported.T
    missed = _missed(pairs, em.weight, plots.scan[pairs.plot])[detected if detected.any() else slice(None)]
    return BiasFit(
        biases, parts.reported @ em.state, covariance[:p, :p] + common, of_mean + common, float(em.weight.sum()),
        int(plots.scan.max()) + 1, float(np.sum(detected)), 0.0, (), converged, moving,
        parts.drift(em.state, covariance, em.process), float(np.mean(missed)),
    )  # fmt: skip


def _common_hull(biases: IntArray, hull_m: float, speed_m_per_s: float) -> FloatArray:
    """(p,) 1σ of the biases by what all hulls have in common: echoes of their near sides, antennas aft of the middle.

    hull_m : 1σ of the places of echoes along hulls.
    """
    common_m = HULL_ALONG * hull_m
    late_s = common_m / speed_m_per_s if speed_m_per_s > WAY_M_PER_S else 0.0
    return np.asarray(np.where(biases == RANGE, common_m, np.where(biases == TIME, late_s, 0.0)))


@dataclass(frozen=True)
class _Process:
    """The variance of a drift, and its correlation time."""

    variance_deg2: float
    correlation_s: float


@dataclass(frozen=True)
class _Parts:
    """The linear model of the residuals: p biases, the place of the echo along and across each of t
    hulls and, if the sensor moves, its place relative to that given (east, north), and k knots of the drift.

    fitted : (p,) which of FITTED. design : (2 m, p + 2 t + 2 + k) derivatives, sparse. pair_knots, pair_shares : (m, 2)
    knots around each pair, and their weights. reported : (p, …) from the parts to the biases, of which the azimuth is
    the mean over the scans. precision : (p,) of the prior.
    """

    fitted: list[int]
    design: Any
    knots: Knots
    pair_knots: IntArray
    pair_shares: FloatArray
    reported: FloatArray
    precision: FloatArray
    tracks: int

    @classmethod
    def of(cls, pairs: PlotPairs, widths: FloatArray, plots: Plots) -> _Parts:
        """The model of all pairs."""
        from scipy.sparse import csr_array

        fitted = [p for p, k in enumerate(FITTED) if widths[k] > 0.0]
        knots, tracks, p = Knots.of(plots.time_s, plots.sensor), len(pairs.scans), len(fitted)
        m, at = len(pairs.plot), fitted.index(FITTED.index(AZIMUTH))
        column = np.tile(np.arange(p), (m, 1))
        hull = p + 2 * pairs.track[:, None] + np.arange(2)
        columns, values = [column, hull], [pairs.jacobian[:, :, fitted], pairs.hull]
        pair_knots, pair_shares = np.empty((m, 0), np.int64), np.empty((m, 0))
        if len(knots):
            pair_knots, pair_shares = knots.around(plots.time_s[pairs.plot])
            columns += [np.tile(p + 2 * tracks + np.arange(2), (m, 1)), p + 2 * tracks + 2 + pair_knots]
            by_azimuth = pairs.jacobian[:, :, FITTED.index(AZIMUTH), None]
            values += [-pairs.frame, by_azimuth * pair_shares[:, None, :]]
        column, value = np.concatenate(columns, axis=1), np.concatenate(values, axis=2)
        size, each = p + 2 * tracks + (2 + len(knots) if len(knots) else 0), column.shape[1]
        design = csr_array(
            (value.ravel(), np.repeat(column, 2, axis=0).ravel(), np.arange(0, 2 * m * each + 1, each)), (2 * m, size)
        )
        reported = np.eye(p, size)
        reported[at, size - len(knots) :] = knots.mean_weights(plots.time_s[first_of_scans(plots)])
        precision = widths[[FITTED[k] for k in fitted]] ** -2.0
        # The azimuth's prior has the width of the search: its tails are wide.
        precision[at] = (AZIMUTH_REACH * widths[AZIMUTH]) ** -2.0
        return cls(fitted, design, knots, pair_knots, pair_shares, reported, precision, tracks)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.reported.shape[1]

    @property
    def azimuth(self) -> int:
        """The parameter of the azimuth."""
        return self.fitted.index(FITTED.index(AZIMUTH))

    @property
    def hulls(self) -> slice:
        """The parameters of hulls."""
        return slice(len(self.fitted), len(self.fitted) + 2 * self.tracks)

    @property
    def drifts(self) -> slice:
        """The parameters of knots."""
        return slice(self.size - len(self.knots), self.size)

    def prior(self, lasting_m2: FloatArray, process: _Process) -> FloatArray:
        """Prior precision, with these variances of places along and across a hull, and of the drift."""
        out = np.diag(np.full(self.size, STATION_M**-2.0))
        np.fill_diagonal(
            out[: self.hulls.stop], np.concatenate([self.precision, np.tile(1.0 / lasting_m2, self.tracks)])
        )
        if len(self.knots):
            out[self.drifts, self.drifts] = self.knots.precision(process.correlation_s) / process.variance_deg2
        return out

    def drift_variance(self, covariance: FloatArray) -> FloatArray:
        """(m,) variance of the drift at each pair."""
        if not len(self.knots):
            return np.zeros(len(self.pair_knots))
        of_knots = covariance[self.drifts, self.drifts]
        (k, n), (a, b) = self.pair_knots.T, self.pair_shares.T
        return np.asarray(a * a * of_knots[k, k] + 2.0 * a * b * of_knots[k, n] + b * b * of_knots[n, n])

    def process(self, state: FloatArray, covariance: FloatArray) -> _Process:
        """The process of the drift, by its moments at the knots and between neighbours."""
        n = len(self.knots)
        prior = _Process(COMPASS_DEG**2, COMPASS_CORRELATION_S)
        if not n:
            return prior
        moments = np.outer(state[self.drifts], state[self.drifts]) + covariance[self.drifts, self.drifts]
        expected = COMPASS_PRIOR * prior.variance_deg2
        variance = (float(np.trace(moments)) + expected) / (n + COMPASS_PRIOR)
        together = float(np.sum(np.diag(moments, 1))) * n / (n - 1)
        dt = self.knots.interval_s
        keep = (together + expected * np.exp(-dt / prior.correlation_s)) / (float(np.trace(moments)) + expected)
        low, high = np.exp(-dt / np.array(COMPASS_LIMITS_S))
        return _Process(variance, -dt / float(np.log(np.clip(keep, low, high))))

    def drift(self, state: FloatArray, covariance: FloatArray, process: _Process) -> AzimuthDrift | None:
        """The drift about the reported azimuth; None for a fixed sensor."""
        if not len(self.knots):
            return None
        whole = np.eye(self.size)[self.drifts]
        whole[:, self.azimuth] = 1.0
        # Between two knots the process is not a straight line: mean variance of a Brownian bridge.
        bridge = 2.0 * process.variance_deg2 / process.correlation_s * self.knots.interval_s / 6.0
        variance = np.einsum("kp,pq,kq->k", whole, covariance, whole) + bridge
        about_mean = whole @ state - self.reported[self.azimuth] @ state
        return AzimuthDrift(self.knots.time_s, about_mean, variance, process.variance_deg2, process.correlation_s)


def _probabilities(
    pairs: PlotPairs, residual: FloatArray, variance: FloatArray, rate: FloatArray, plots: int
) -> FloatArray:
    """(m,) probability of each pair of a plot and a track, with residuals and their variances (m, 2).

    rate : (t,) expected plots of each track per scan. plots : their number.
    """
    log_ratio = (
        np.log(rate[pairs.track]) - LOG_2PI - 0.5 * np.log(variance).sum(axis=1)
        - 0.5 * np.sum(residual**2 / variance, axis=1) - np.log(pairs.background)
    )  # fmt: skip
    ratio = np.exp(np.clip(log_ratio, -700.0, 300.0))
    return np.asarray(ratio / (1.0 + np.bincount(pairs.plot, ratio, plots)[pairs.plot]))


def _missed(pairs: PlotPairs, weight: FloatArray, scan: IntArray) -> FloatArray:
    """(t,) share of the scans of each track that have no plot of it.

    weight, scan : (m,) probability of each pair of a plot and a track, and the scan of its plot. A hull may have
    several plots in a scan.
    """
    look, at = np.unique(np.column_stack([pairs.track, scan]), axis=0, return_inverse=True)
    p_none = np.exp(np.bincount(at.ravel(), np.log1p(-np.minimum(weight, 1.0 - 1e-9)), len(look)))
    shown = np.bincount(look[:, 0], 1.0 - p_none, len(pairs.scans))
    return np.clip(1.0 - shown / np.maximum(pairs.scans, 1.0), 0.0, 1.0)


def _variance_inflation(time_s: FloatArray, track: IntArray, error: FloatArray) -> float:
    """The factor on the variance by correlated errors, at least 1, from times, tracks and errors across in σ, (m,).

    Errors of the heading are common to all tracks for some time, and those of a track's course to all of its plots, so
    that sums over blocks of 60 s scatter more than those of independent plots.
    """
    independent = float(np.sum(error**2))
    if not independent > 0.0:
        return 1.0
    block = ((time_s - time_s.min()) // 60.0).astype(np.int64)
    of_track = np.unique(np.column_stack([block, track]), axis=0, return_inverse=True)[1].ravel()
    return max(1.0, *(float(np.sum(np.bincount(each, error) ** 2)) / independent for each in (block, of_track)))
