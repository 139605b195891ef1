"""Error factors: how wrong the position errors that a source states are.

Error factors (:class:`ErrorFactors`) multiply the σ that a source states or that is assumed for its kind. The positions
of two tracks that are surely one object differ by δ ~ N(0, f_a² R_a + f_b² R_b + D), with R as stated, f the factors of
their sources, and D the covariance of the motion since the reports. The posterior of all factors is

    p(f_1 … f_S) ∝ Π_a p(f_a) exp Σ_{a<b} L_ab(f_a, f_b),

L_ab the log-likelihood of all differences of the two sources. The prior p(f) is log-normal, plus a point mass at f = 1,
with a mean square of 1: the stated variance is the expected one. So is that with the root mean square of the posterior,
which is used. More than ``BLOCK`` sources are split into blocks, each in the mean field of the others. A difference
that is correlated with previous ones of its pair counts by what it adds to them (:func:`information`), and the
differences of m tracks of one object count as m − 1 (:func:`pairs_within`). A share ``FACTOR_OUTLIERS`` (1 %) of the
differences are outliers with ``FACTOR_OUTLIER`` times the errors: a wrong time stamp, an antenna far from the centre, a
false pair.

Sure pairs are selected for being near, so where pairs are sure only by chance, factors come out too small. The
residuals of single tracks from report to report, ν ~ N(0, f² (R + R′ − ρ (L L′ᵀ + L′ Lᵀ)) + κ D) as in
:mod:`sameas.picture.error_correlation`, do not depend on pairs and bound the errors from below, whatever ρ. Each source
has one unknown ρ. They measure f² (1 − ρ). With probability ``ERRORS_NEW`` ρ is 0; otherwise the prior is uniform in
ln (1 − ρ), so that residuals prefer none of the factors above the bound. A prior uniform in ρ prefers small ones, by
1 / f²: AIS whose errors persist for minutes would have factors of 0.85. The motion's share κ is unknown as well;
whether it applies to the errors of measured velocities too is a second unknown. Residuals count against small factors
and not in favour of them: with a log-normal prior alone the mean of the factors that they allow would be 1.2 to 1.4
where 1 is true, and a source more precise than others has no other evidence.

The errors of a sensor rarely grow with distance as described. One factor, mostly of near objects, would make far ones
impossible partners. So each octave of distance from the sensor (:attr:`sameas.picture.tables.Scan.range_band`) has its
own factor f_b, with prior p(f_b | f) = ½ δ(f_b − f) + ½ log-normal about f, where f has the posterior above; its
evidence are the differences and residuals of that octave alone, given the factors of the other sources' octaves.

A new estimate changes what is known of the errors, not the errors: the previous instant is then judged by it as well
(:meth:`sameas.picture.named_tracks.NamedTracks.with_present_factors`).

A source's offset, which its reports have in common, is not included; see :mod:`sameas.tracks.registration`.

Source: mean-field approximation as in Bishop, Pattern Recognition and Machine Learning, section 10.1.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import log_softmax, logsumexp

from sameas.arrays import FloatArray, IntArray, ordered_by
from sameas.gaussian import log_density
from sameas.kernels.kalman import update_in_plane
from sameas.picture.error_correlation import MIN_M2, log_residuals
from sameas.picture.tables import RANGE_BANDS, Scan
from sameas.representation import listed
from sameas.tracks.alignment import moved

ERROR_FACTORS = tuple(2.0 ** (k / 4.0) for k in range(-8, 9))  # grid of factors on stated errors, about 1
#: Prior probability that errors are as stated, and prior 1σ of ln f otherwise.
ERRORS_AS_STATED, ERROR_FACTOR_SIGMA = 0.5, 0.5
#: Prior probability that the errors of a source are new in every report; factors are then estimated from single tracks.
ERRORS_NEW = 0.1
#: Share of differences of sure pairs that are outliers, with FACTOR_OUTLIER times their errors.
FACTOR_OUTLIERS, FACTOR_OUTLIER = 0.01, 10.0


def error_update(
    mean: FloatArray, covariance: FloatArray, slope: FloatArray, noise: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The Kalman update by ν = H x + n: mean and covariance of x, ln p(ν), and χ² of ν.

    mean, covariance : (k, d), (k, d, d) of x, the errors of tracks and their constant part, before a report.
    slope, noise : (k, 2, d), (k, 2, 2) H and the covariance of n. shift : (k, 2) ν.
    """
    out = np.empty(mean.shape), np.empty(covariance.shape), np.empty(len(mean)), np.empty(len(mean))
    update_in_plane(mean, covariance, slope, noise + MIN_M2 * np.eye(2), shift, *out)
    return out


#: Correlations of two reports at which likelihoods of error factors, of which neighbouring ones differ by 2^¼, are
#: computed: 1 − ρ is 1, 2^(−½), ½ … so that f² (1 − ρ) has the same values for all f; and 0, for receivers that repeat
#: positions.
FACTOR_CORRELATIONS = np.append(1.0 - 2.0 ** (-0.5 * np.arange(16)), 1.0)
#: Sources whose joint posterior is computed exactly, and mean-field iterations over blocks of that size.
BLOCK, STEPS = 3, 5
#: At most this many pairs and reports of an instant are used, to limit the time; and at most this many reports of a
#: part of a source: more add no information.
MAX_PAIRS, MAX_REPORTS, MOST_OF_PART = 64, 32, 2000


@dataclass(frozen=True)
class ErrorFactors:
    """The estimated factors on the stated errors of sources.

    names : of the S sources; part s B + b of them is range band b of source s, B = ``RANGE_BANDS``.
    log_likely : (S B, S B, K, K) L_ab of parts a < b, by the factors of both.
    log_shifts : (S B, K, 2ρ) ln p of the residuals of their tracks, with κ on all of the motion, and with κ on all but
    the errors of measured velocities. reports : (S B,) how many reports these are from.
    factor : (S,) root mean square of each source's factor: the variance of its errors is the mean over the posterior.
    sigma : (S,) 1σ of its logarithm. by_range : (S, B) the factor of each range band.
    """

    names: tuple[str, ...] = ()
    log_likely: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0, 0)))
    log_shifts: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0)))
    reports: FloatArray = field(default_factory=lambda: np.empty(0))
    factor: FloatArray = field(default_factory=lambda: np.empty(0))
    sigma: FloatArray = field(default_factory=lambda: np.empty(0))
    by_range: FloatArray = field(default_factory=lambda: np.empty((0, RANGE_BANDS)))

    def of_sources(self, names: tuple[str, ...]) -> ErrorFactors:
        """The estimate with new sources at their prior; names : of all sources, those already known first."""
        if names == self.names:
            return self
        k, n, known = len(ERROR_FACTORS), RANGE_BANDS * len(names), len(self.reports)
        log_likely = np.zeros((n, n, k, k))
        log_likely[:known, :known] = self.log_likely.reshape(known, known, k, k)
        log_shifts, reports = np.zeros((n, k, 2 * len(FACTOR_CORRELATIONS))), np.zeros(n)
        log_shifts[:known] = self.log_shifts.reshape(known, k, 2 * len(FACTOR_CORRELATIONS))
        reports[:known] = self.reports
        extended = replace(self, names=names, log_likely=log_likely, log_shifts=log_shifts, reports=reports)
        return extended._with_posterior()

    def informative(self, part: IntArray, position: FloatArray, stated: FloatArray, motion: FloatArray) -> IntArray:
        """(k,) the new reports, of (n,), that :meth:`with_shifts` should use.

        part, position : (n,), (n, 2). stated, motion : (n, 2, 2) R + R′ as stated, and D. Where the motion is larger
        than the errors, residuals would test the motion model instead.
        """
        steady = np.trace(motion, axis1=1, axis2=2) < np.trace(stated, axis1=1, axis2=2)
        which = np.flatnonzero(steady & (self.reports[part] < MOST_OF_PART))
        return which[evenly(position[which], MAX_REPORTS)]

    def with_shifts(
        self,
        part: IntArray,
        shift: FloatArray,
        errors: tuple[FloatArray, FloatArray],
        motion: tuple[FloatArray, FloatArray],
    ) -> ErrorFactors:
        """The estimate after new reports of tracks, those chosen by :meth:`informative`.

        part, shift : (n,), (n, 2) the part of the source, and ν. errors : R + R′ and L L′ᵀ as stated. motion : D, and
        what is in it from the errors of measured velocities. (n, 2, 2) each.
        """
        n = len(part)
        if not n:
            return self
        total, common = errors[0], errors[1] + errors[1].transpose(0, 2, 1)
        log_outlier = log_density(shift, FACTOR_OUTLIER**2 * total) - np.log(1.0 / FACTOR_OUTLIERS - 1.0)
        # All factors at once, (factors times n, …).
        sq = np.array(ERROR_FACTORS) ** 2
        errors_of = [np.multiply.outer(sq, each).reshape(-1, 2, 2) for each in (total, common)]
        motion_of = [np.tile(each, (len(sq), 1, 1)) for each in motion]
        log_p = log_residuals(np.tile(shift, (len(sq), 1)), errors_of, motion_of, FACTOR_CORRELATIONS)
        both_cases = np.moveaxis(log_p.reshape(2, len(sq), n, -1), 0, 2).reshape(len(sq), n, -1)
        # Half weight: each report enters two successive residuals.
        log_likely = 0.5 * np.logaddexp(both_cases, log_outlier[:, None])
        log_shifts = self.log_shifts.copy()
        for p in np.unique(part).tolist():
            log_shifts[p] += log_likely[:, part == p].sum(axis=1)
        reports = self.reports + np.bincount(part, minlength=len(self.reports))
        return replace(self, log_shifts=log_shifts, reports=reports)

    def with_sure_pairs(
        self,
        parts: tuple[IntArray, IntArray],
        delta: FloatArray,
        stated: tuple[FloatArray, FloatArray],
        motion: FloatArray,
        weight: FloatArray,
    ) -> ErrorFactors:
        """The estimate after pairs of tracks that are surely one object, at most :data:`MAX_PAIRS` per instant.

        parts : of both sources, (n,) each. delta : (n, 2) δ. stated : R of both, (n, 2, 2) each.
        motion : (n, 2, 2) D. weight : (n,) of :func:`information`.
        """
        if not len(delta):
            return self
        swap = parts[0] > parts[1]
        first, second = np.minimum(*parts), np.maximum(*parts)
        one, other = (np.where(swap[:, None, None], *both) for both in (stated[::-1], stated))
        log_p, log_likely = log_of_differences(delta, one, other, motion), self.log_likely.copy()
        np.add.at(log_likely, (first, second), weight[:, None, None] * log_p)
        return replace(self, log_likely=log_likely)._with_posterior()

    def of_records(self, scan: Scan) -> FloatArray:
        """(n,) the factor of each record; 1 for directions and for sources that are not in ``names``."""
        if not len(scan):
            return np.empty(0)
        names = {name: k for k, name in enumerate(self.names)}
        as_stated = np.ones(RANGE_BANDS)
        factors = [self.by_range[names[d.name]] if d.name in names else as_stated for d in scan.now.descriptions]
        return np.where(scan.placed, np.array(factors)[scan.source, scan.range_band], 1.0)

    def applied(self, scan: Scan) -> Scan:
        """The scan with the position errors of its records multiplied by the factors instead of those applied before;
        errors of velocities only if these come from positions."""
        factor = self.of_records(scan)
        change = factor / scan.error_factor
        if np.all(np.abs(change - 1.0) < 1e-9):
            return scan
        scale = np.ones((len(scan), 4))
        scale[:, :2] = change[:, None]
        # Velocities from positions have correlated errors: those are wrong by the same factor.
        from_positions = np.nan_to_num(scan.reported_covariance[:, :2, 2:]).any(axis=(1, 2))
        scale[from_positions, 2:] = change[from_positions, None]
        reported = scale[:, :, None] * scan.reported_covariance * scale[:, None, :]
        added = np.nan_to_num(reported - scan.reported_covariance)
        _, extra = moved(np.zeros((len(scan), 4)), added, scan.now.instant_s - scan.time_s, np.zeros(len(scan)))
        return replace(scan.with_covariance(extra), reported_covariance=reported, error_factor=factor)

    def lines(self) -> list[str]:
        """Printable lines on the sources whose errors differ from the stated ones by 3σ and by 25 % or more."""
        names: dict[str, list[str]] = {}
        for name, factor, sigma in zip(self.names, self.factor.tolist(), self.sigma.tolist(), strict=True):
            if abs(np.log(factor)) > max(3.0 * sigma, np.log(1.25)):
                names.setdefault(_in_words(factor, sigma), []).append(name)
        return [
            f"{listed(some)}: positions err by {words} what is stated or assumed; counted so"
            for words, some in names.items()
        ]

    def _with_posterior(self) -> ErrorFactors:
        """The estimate with ``factor``, ``sigma`` and ``by_range`` updated to all evidence."""
        logs, n, k = np.log(np.array(ERROR_FACTORS)), len(self.names), len(ERROR_FACTORS)
        own = _log_prior(logs) + log_of_residuals(self.log_shifts.reshape(n, RANGE_BANDS, k, -1).sum(axis=1))
        # L symmetrised: by the factor of the first part, then of the second.
        of_parts = self.log_likely + self.log_likely.transpose(1, 0, 3, 2)
        pairwise = of_parts.reshape(n, RANGE_BANDS, n, RANGE_BANDS, k, k).sum(axis=(1, 3))
        weight = np.exp(log_softmax(own, axis=1))
        blocks = [np.arange(begin, min(begin + BLOCK, n)) for begin in range(0, n, BLOCK)]
        for _ in range(STEPS if len(blocks) > 1 else 1):
            for block in blocks:
                others = np.setdiff1d(np.arange(n), block)
                field_ = np.einsum("stfg,tg->sf", pairwise[np.ix_(block, others)], weight[others])
                weight[block] = _marginals(own[block] + field_, pairwise[np.ix_(block, block)])
        mean = weight @ logs
        sigma = np.sqrt(np.maximum(weight @ logs**2 - mean**2, 0.0))
        factor = np.sqrt(weight @ np.exp(2.0 * logs))
        return replace(self, factor=factor, sigma=sigma, by_range=self._by_range(factor, weight, of_parts, logs))

    def _by_range(self, factor: FloatArray, weight: FloatArray, pairwise: FloatArray, logs: FloatArray) -> FloatArray:
        """(S, B) the factors of the range bands: that of the source where it has evidence of one band only.

        factor, weight : (S,), (S, K) root mean square and posterior of the sources' factors. pairwise : (S B, S B, K,
        K) L of parts, symmetrised.
        """
        n, k = weight.shape
        log_pairs = np.einsum("stfg,tg->sf", pairwise, np.repeat(weight, RANGE_BANDS, axis=0))
        has_evidence = (self.reports > 0) | log_pairs.any(axis=1)
        several = has_evidence.reshape(n, RANGE_BANDS).sum(axis=1) > 1
        ratio = np.exp(-0.5 * ((logs - logs[:, None]) / ERROR_FACTOR_SIGMA) ** 2)
        change = 0.5 * np.eye(k) + 0.5 * ratio / ratio.sum(axis=1, keepdims=True)
        prior = np.repeat(np.log(weight @ change + 1e-300), RANGE_BANDS, axis=0)
        of_bands = np.exp(log_softmax(prior + log_of_residuals(self.log_shifts) + log_pairs, axis=1))
        return np.where(
            several[:, None], np.sqrt(of_bands @ np.exp(2.0 * logs)).reshape(n, RANGE_BANDS), factor[:, None]
        )


def _in_words(factor: float, sigma: float) -> str:
    """Printable: a factor with its 1σ range; at an end of the grid, what is at least or at most.

    >>> _in_words(0.5, 0.1), _in_words(0.25, 1e-6)
    ('0.5 times (0.45 to 0.55)', 'at most 0.25 times')
    """
    low, high = ERROR_FACTORS[0], ERROR_FACTORS[-1]
    if not 1.02 * low < factor < high / 1.02:
        return f"at {'most' if factor < 1.0 else 'least'} {factor:.2g} times"
    return f"{factor:.2g} times ({factor * np.exp(-sigma):.2g} to {factor * np.exp(sigma):.2g})"


def information(n_previous: IntArray, rho: FloatArray, lasting_rho: FloatArray) -> FloatArray:
    """(n,) how much a difference of a sure pair adds to the estimate of its variance, in independent differences.

    n_previous : (n,) number of the pair's previous differences. rho, lasting_rho : (n,) correlation with the last of
    them, and that with all of them by errors that last.

    The mean square of n differences with the correlation c between any two has the variance of n / (1 + (n − 1) c²)
    independent ones. So a constant error, however often it is seen, is one: all differences are worth 1 / c² at most.
    """
    first = n_previous == 0
    square = lasting_rho**2
    spread = (1.0 + n_previous * square) * (1.0 + (n_previous - 1.0) * square)
    return np.where(first, 1.0, (1.0 - rho**2) / np.where(first, 1.0, spread))


def pairs_within(members: IntArray) -> tuple[IntArray, FloatArray]:
    """(k, 2) the pairs of records of each object, and (k,) what each counts, in independent differences.

    members : (n, S) records of the objects, ABSENT for none. The m (m − 1) / 2 differences of m records are sums of
    m − 1 of them: of three tracks of one ship, the third difference shows nothing new. With a weight of 2 / m each, the
    likelihood of a factor common to all is exact where their errors are equal.

    >>> pairs, share = pairs_within(np.array([[0, 3, 5], [1, 4, -1]]))
    >>> pairs.tolist(), share.round(2).tolist()
    ([[0, 3], [0, 5], [3, 5], [1, 4]], [0.67, 0.67, 0.67, 1.0])
    """
    one, two = np.triu_indices(members.shape[1], 1)
    pairs = np.stack([members[:, one], members[:, two]], axis=2).reshape(-1, 2)
    share = np.repeat(2.0 / np.maximum((members >= 0).sum(axis=1), 1), len(one))
    complete = (pairs >= 0).all(axis=1)
    return pairs[complete], share[complete]


def evenly(position: FloatArray, max_rows: int) -> IntArray:
    """(k,) rows, ascending, of at most ``max_rows`` of n positions (n, 2), spread evenly in the order of their
    coordinates, so that the choice does not depend on the order of the rows."""
    if len(position) <= max_rows:
        return np.arange(len(position))
    return np.sort(ordered_by(position.T)[np.linspace(0, len(position) - 1, max_rows).astype(np.int64)])


def log_of_residuals(log_shifts: FloatArray) -> FloatArray:
    """(n, K) ln p of residuals for each factor, from that for each ρ and both cases of the motion (n, K, 2ρ)."""
    share = ERRORS_NEW
    prior = np.full(len(FACTOR_CORRELATIONS), (1.0 - share) / len(FACTOR_CORRELATIONS))
    prior[0] += share
    return np.asarray(logsumexp(log_shifts + np.log(np.tile(prior, 2)), axis=2))


def _log_prior(logs: FloatArray) -> FloatArray:
    """(K,) ln of the prior probability of factors with these logarithms."""
    # With this median the mean square is 1: the variance before any evidence is the stated one.
    log_normal = np.exp(-0.5 * ((logs + ERROR_FACTOR_SIGMA**2) / ERROR_FACTOR_SIGMA) ** 2)
    as_stated = np.abs(logs) == np.abs(logs).min()
    share = ERRORS_AS_STATED
    return np.asarray(np.log((1.0 - share) * log_normal / log_normal.sum() + share * as_stated / as_stated.sum()))


def _marginals(own: FloatArray, pairwise: FloatArray) -> FloatArray:
    """(m, K) marginal probabilities of the factors of m sources, from the log-potentials of each (m, K) and of each two
    (m, m, K, K)."""
    m, k = own.shape
    total = np.zeros((k,) * m)
    for s in range(m):
        total += own[s].reshape([k if axis == s else 1 for axis in range(m)])
        for t in range(s + 1, m):
            total += pairwise[s, t].reshape([k if axis in (s, t) else 1 for axis in range(m)])
    p = np.exp(total - total.max(initial=-np.inf))
    out = np.array([p.sum(axis=tuple(axis for axis in range(m) if axis != s)) for s in range(m)]).reshape(m, k)
    return np.asarray(out / out.sum(axis=1, keepdims=True))


def log_of_differences(delta: FloatArray, one: FloatArray, other: FloatArray, motion: FloatArray) -> FloatArray:
    """(n, K, K) ln p(δ), up to a constant, for each pair of factors; one, other : (n, 2, 2) R_a and R_b."""
    sq = np.array(ERROR_FACTORS) ** 2
    xx, xy, yy = (
        sq[:, None] * one[:, v, w, None, None] + sq * other[:, v, w, None, None] + motion[:, v, w, None, None]
        for v, w in ((0, 0), (0, 1), (1, 1))
    )
    xx, yy = xx + MIN_M2, yy + MIN_M2
    det = np.maximum(xx * yy - xy**2, MIN_M2**2)
    x, y = delta[:, 0, None, None], delta[:, 1, None, None]
    chi_sq = (yy * x**2 - 2.0 * xy * x * y + xx * y**2) / det
    inflated = FACTOR_OUTLIER**2
    inlier, outlier = -0.5 * chi_sq, -0.5 * chi_sq / inflated - np.log(inflated * (1.0 / FACTOR_OUTLIERS - 1.0))
    return np.asarray(np.logaddexp(inlier, outlier) - 0.5 * np.log(det))
