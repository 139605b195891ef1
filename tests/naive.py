"""Slow reference implementations of the stages, written directly from the definitions (METHOD 1 to 6).

Every function is one formula over one pair, or one enumeration of all hypotheses; none shares code with the library
(but `nested_densities`, which takes its constants). Use them on a few records to check the library's results.
All probabilities are natural logarithms unless the name begins with ``p``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.special import gammaln, log_ndtr, logsumexp, xlogy
from scipy.stats import chi2, norm

from sameas.estimate.cells import FINEST_CELLS
from sameas.estimate.coverage import COVERAGE_PSEUDO_COUNT, IN_CELL, LEFT_OUT, LOG_PRIOR_STEP
from sameas.estimate.places import PARTLY
from sameas.records import Records, unpack
from sameas.space import ARCSEC_PER_RADIAN, Sphere

Pair = tuple[int, int]
LOG_2PI = math.log(2 * math.pi)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(20)


# ---- METHOD 1: records and residuals ----


def residual(a: Records, i: int, b: Records, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Difference a − b (d,) of one pair and its covariance (d, d), in the unit of the covariances."""
    one, two = a.features[i], b.features[j]
    cov_1, cov_2 = (unpack(s.covariance[k : k + 1], s.d)[0] for s, k in ((a, i), (b, j)))
    if isinstance(a.space, Sphere):
        half = half_rotation(*one, *two)
        rotation_1, rotation_2 = rotation_matrix(-half), rotation_matrix(half)
        return sphere_difference(*one, *two), rotation_1 @ cov_1 @ rotation_1.T + rotation_2 @ cov_2 @ rotation_2.T
    delta = one - two
    for v, period in enumerate(a.space.period_list(a.d)):
        if math.isfinite(period):
            delta[v] -= period * math.ceil(delta[v] / period - 0.5)
    return delta, cov_1 + cov_2


def sphere_difference(lon_1: float, lat_1: float, lon_2: float, lat_2: float) -> np.ndarray:
    """(east, north) from 2 to 1 in arcsec, at the midpoint of the great circle; arguments in degrees (Delambre)."""
    half_lon = math.radians(math.remainder(lon_1 - lon_2, 360)) / 2
    half_lat = math.radians(lat_1 - lat_2) / 2
    middle = math.radians(lat_1 + lat_2) / 2
    east, north = math.sin(half_lon) * math.cos(middle), math.cos(half_lon) * math.sin(half_lat)
    sine = math.hypot(east, north)
    cosine = math.hypot(math.cos(half_lon) * math.cos(half_lat), math.sin(half_lon) * math.sin(middle))
    if sine == 0.0:
        return np.zeros(2)
    return np.array([east, north]) / sine * 2 * math.atan2(sine, cosine) * ARCSEC_PER_RADIAN


def half_rotation(lon_1: float, lat_1: float, lon_2: float, lat_2: float) -> float:
    """Half of θ = (position angle of the great circle at 1) − (at 2), in radians; arguments in degrees."""
    half_lon = math.radians(math.remainder(lon_1 - lon_2, 360)) / 2
    half_lat = math.radians(lat_1 - lat_2) / 2
    middle = math.radians(lat_1 + lat_2) / 2
    return math.atan2(math.sin(half_lon) * math.sin(middle), math.cos(half_lon) * math.cos(half_lat))


def rotation_matrix(angle: float) -> np.ndarray:
    """(2, 2) matrix that rotates (east, north): it adds ``angle`` (radians) to the position angle, east of north."""
    return np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])


# ---- METHOD 2: gate and groups ----


def candidates(a: Records, b: Records, *, sigmas: float | None = None, completeness: float | None = None) -> set[Pair]:
    """Pairs in the gate: |Δ_v| ≤ sigmas·σ_v in every feature, or ΔᵀΣ⁻¹Δ ≤ the χ²_d quantile."""
    if (sigmas is None) == (completeness is None):
        raise ValueError("give either sigmas or completeness")
    largest = math.inf if completeness is None else chi2.ppf(completeness, a.d)
    found = set()
    for i in range(len(a)):
        for j in range(len(b)):
            delta, cov = residual(a, i, b, j)
            if sigmas is not None:
                inside = (np.abs(delta) <= sigmas * np.sqrt(np.diag(cov))).all()
            else:
                inside = mahalanobis(delta, cov) <= largest
            if inside:
                found.add((i, j))
    return found


def mahalanobis(delta: np.ndarray, cov: np.ndarray) -> float:
    """ΔᵀΣ⁻¹Δ."""
    return float(delta @ np.linalg.solve(cov, delta))


def components(n1: int, n2: int, pairs: Iterable[Pair]) -> list[tuple[set[int], set[int]]]:
    """Connected components of the bipartite graph as (rows of 1, rows of 2), records without candidates included."""
    links: dict[tuple[int, int], set[tuple[int, int]]] = {(0, i): set() for i in range(n1)}
    links |= {(1, j): set() for j in range(n2)}
    for i, j in pairs:
        links[0, i].add((1, j))
        links[1, j].add((0, i))
    groups, seen = [], set()
    for start in links:
        if start in seen:
            continue
        reached, front = {start}, [start]
        while front:
            new = links[front.pop()] - reached
            reached |= new
            front += new
        seen |= reached
        groups.append(({row for side, row in reached if side == 0}, {row for side, row in reached if side == 1}))
    return groups


# ---- METHOD 3: evidence, ln λ of one pair ----


def log_normal(delta: np.ndarray, cov: np.ndarray) -> float:
    """ln N(Δ; 0, Σ)  [F14, T17]."""
    return -0.5 * (len(delta) * LOG_2PI + np.linalg.slogdet(cov)[1] + mahalanobis(delta, cov))


def field(delta: np.ndarray, cov: np.ndarray, density: float) -> float:
    """METHOD 3.1: a different object lies anywhere, with constant density per unit of feature space."""
    return log_normal(delta, cov) - math.log(density)


def constant_cost(delta: np.ndarray, cov: np.ndarray, c: float) -> float:
    """METHOD 3.4: ln N − 2 ln C."""
    return log_normal(delta, cov) - 2 * math.log(c)


def calibrated(delta: np.ndarray, cov: np.ndarray, detection_probability: float, density: float) -> float:
    """METHOD 3.4, calibrated: ln of P_d N / [(1 − P_d) β]; C² = β (1 − P_d) / P_d."""
    return log_normal(delta, cov) + math.log(detection_probability / ((1 - detection_probability) * density))


def log_interval(low: np.ndarray | float, high: np.ndarray | float) -> np.ndarray:
    """ln[Φ(high) − Φ(low)], low ≤ high, without cancellation in tails and narrow intervals."""
    low, high = np.broadcast_arrays(np.asarray(low, float), np.asarray(high, float))
    low, high = np.where(low > 0, -high, low), np.where(low > 0, -low, high)
    upper, lower, half = log_ndtr(high), log_ndtr(low), (high - low) / 2
    exponent = -0.5 * ((low + high) / 2 + half * NODES.reshape(-1, *[1] * low.ndim)) ** 2
    with np.errstate(divide="ignore"):
        wide = upper + np.log1p(-np.exp(lower - upper))
        narrow = np.log(half) + logsumexp(exponent.T, b=WEIGHTS, axis=-1).T - 0.5 * LOG_2PI
    return np.where(2 * half * np.maximum(1, -low) < 1, narrow, wide)


def close_objects_log_density(delta: np.ndarray, sigma: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """METHOD 3.2, ln of the braces: a nearby object lies in the box b without the box a; all (d,)."""
    inner = log_interval((-a - delta) / sigma, (a - delta) / sigma)
    outer = log_interval((-b - delta) / sigma, (b - delta) / sigma)
    above = log_interval((a - delta) / sigma, (b - delta) / sigma)
    below = log_interval((-b - delta) / sigma, (-a - delta) / sigma)
    shell = np.logaddexp(above, below)
    terms = [inner[:v].sum() + shell[v] + outer[v + 1 :].sum() for v in range(len(delta))]
    return float(logsumexp(terms)) - log_shell_volume(a, b)


def log_shell_volume(a: np.ndarray, b: np.ndarray) -> float:
    """ln(V_b − V_a), V_c = ∏ 2 c_v."""
    return len(a) * math.log(2) + math.log(sum(a[:v].prod() * (b[v] - a[v]) * b[v + 1 :].prod() for v in range(len(a))))


def close_objects(delta: np.ndarray, cov: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """METHOD 3.2 with exact ψ; N uses the full covariance, the braces only σ_v (as in the paper)."""
    return log_normal(delta, cov) - close_objects_log_density(delta, np.sqrt(np.diag(cov)), a, b)


def close_objects_limit(delta: np.ndarray, cov: np.ndarray, a: np.ndarray) -> float:
    """METHOD 3.2 in the limit b → a, b proportional to a: the nearby object lies on the surface of the box a.

    d/dε of the probability of the box (1+ε)a, divided by d/dε of its volume, d·V_a.
    """
    sigma = np.sqrt(np.diag(cov))
    inner = log_interval((-a - delta) / sigma, (a - delta) / sigma)
    density = [-0.5 * (LOG_2PI + ((side * a - delta) / sigma) ** 2) - np.log(sigma) for side in (-1, 1)]
    face = np.log(a) + np.logaddexp(*density)
    terms = [inner[:v].sum() + face[v] + inner[v + 1 :].sum() for v in range(len(delta))]
    log_volume = math.log(len(a)) + np.log(2 * a).sum()
    return log_normal(delta, cov) - float(logsumexp(terms) - log_volume)


def close_objects_correlated(delta: np.ndarray, cov: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """METHOD 3.2 in two features with the full covariance in the boxes too: b without a as four rectangles."""
    (a1, a2), (b1, b2) = a, b
    around = [((-b1, -a1), (-b2, b2)), ((a1, b1), (-b2, b2)), ((-a1, a1), (-b2, -a2)), ((-a1, a1), (a2, b2))]
    terms = [log_rectangle(delta, cov, x, y) for x, y in around]
    return log_normal(delta, cov) - float(logsumexp(terms)) + log_shell_volume(a, b)


def log_rectangle(mean: np.ndarray, cov: np.ndarray, x: tuple[float, float], y: tuple[float, float]) -> float:
    """ln P(m ∈ x × y) for m ~ N(mean, cov): the conditional interval in y, integrated over x.

    The integrand is log-concave: panels whose width doubles away from its peak resolve every scale.
    """
    if x[0] == x[1] or y[0] == y[1]:
        return -math.inf
    slope, sigma = cov[0, 1] / cov[0, 0], math.sqrt(cov[1, 1] - cov[0, 1] ** 2 / cov[0, 0])

    def log_integrand(t: np.ndarray) -> np.ndarray:
        centre = mean[1] + slope * (t - mean[0])
        along = -0.5 * (LOG_2PI + math.log(cov[0, 0]) + (t - mean[0]) ** 2 / cov[0, 0])
        return along + log_interval((y[0] - centre) / sigma, (y[1] - centre) / sigma)

    width = x[1] - x[0]
    peak = minimize_scalar(
        lambda t: -float(log_integrand(t)), bounds=x, method="bounded", options={"xatol": 1e-10 * width}
    ).x
    steps = width * 2.0 ** -np.arange(42)
    edges = np.unique(np.clip(np.concatenate([peak - steps, [peak], peak + steps]), *x))
    half = np.diff(edges)[:, None] / 2
    points = (edges[:-1] + edges[1:])[:, None] / 2 + half * NODES
    return float(logsumexp(log_integrand(points), b=half * WEIGHTS))


def generalized_gaussian(x: float, sigma: float, c: float) -> float:
    """ln of the paper's approximation of ψ(x; σ, c) [T21–T25]: same variance σ² + c²/3, same value at 0."""
    variance = sigma**2 + c**2 / 3
    at_zero = float(log_interval(-c / sigma, c / sigma)) - math.log(2 * c)

    def log_peak(log_shape: float) -> float:  # of the generalized Gaussian with this shape and variance
        s = math.exp(log_shape)
        return log_shape - math.log(2) - 1.5 * gammaln(1 / s) + 0.5 * gammaln(3 / s) - 0.5 * math.log(variance)

    ends = math.log(2), math.log(1e7)
    if log_peak(ends[0]) <= at_zero:  # c ≪ σ: the normal, to rounding
        log_shape = ends[0]
    elif log_peak(ends[1]) >= at_zero:  # σ ≪ c: the uniform
        log_shape = ends[1]
    else:
        log_shape = brentq(lambda s: log_peak(s) - at_zero, *ends, xtol=1e-14, rtol=1e-14)
    shape = math.exp(log_shape)
    scale = math.exp(0.5 * (math.log(variance) + gammaln(1 / shape) - gammaln(3 / shape)))
    with np.errstate(over="ignore"):
        return at_zero - float(np.float64(abs(x) / scale) ** shape)


def close_objects_paper(delta: np.ndarray, cov: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """METHOD 3.2 with the paper's generalized Gaussians; NaN where its braces are not positive (far tails)."""
    sigma = np.sqrt(np.diag(cov))
    boxes = [
        sum(generalized_gaussian(x, s, v) + math.log(2 * v) for x, s, v in zip(delta, sigma, c, strict=True))
        for c in (b, a)
    ]
    if boxes[0] <= boxes[1]:
        return math.nan
    return log_normal(delta, cov) - boxes[0] - math.log1p(-math.exp(boxes[1] - boxes[0])) + log_shell_volume(a, b)


def universal_1d(
    x1: float, variance_1: float, x2: float, variance_2: float, log_p: Callable, log_p_other: Callable, grid: np.ndarray
) -> float:
    """METHOD 3.3 in one feature, summed on a regular ``grid`` of positions (m,).

    log_p(M) and log_p_other(M1, M2) = ln p(M₂|M₁) take arrays; the grid must cover and resolve the integrands.
    """
    one = -0.5 * (LOG_2PI + math.log(variance_1) + (x1 - grid) ** 2 / variance_1)
    two = -0.5 * (LOG_2PI + math.log(variance_2) + (x2 - grid) ** 2 / variance_2)
    log_step = math.log(grid[1] - grid[0])
    same = logsumexp(log_p(grid) + one + two) + log_step
    other = log_p(grid)[:, None] + log_p_other(grid[:, None], grid[None, :]) + one[:, None] + two[None, :]
    return float(same - logsumexp(other) - 2 * log_step)


# ---- METHOD 4: hypotheses, priors, the most probable one ----


def hypotheses(n1: int, n2: int, allowed_pairs: Iterable[Pair]) -> Iterator[tuple[Pair, ...]]:
    """All one-to-one sets of allowed pairs, the empty set included, each once, rows of 1 ascending."""
    partners: list[list[int]] = [[] for _ in range(n1)]
    for i, j in sorted(set(allowed_pairs)):
        if not (0 <= i < n1 and 0 <= j < n2):
            raise ValueError(f"pair {i, j} lies outside the {n1} and {n2} records")
        partners[i].append(j)

    def extend(i: int, used: frozenset[int]) -> Iterator[tuple[Pair, ...]]:
        if i == n1:
            yield ()
            return
        yield from extend(i + 1, used)
        for j in partners[i]:
            if j not in used:
                yield from (((i, j), *rest) for rest in extend(i + 1, used | {j}))

    return extend(0, frozenset())


def number_of_hypotheses(n1: int, n2: int) -> int:
    """Σ_k C(N₁,k) C(N₂,k) k!  [T1]."""
    return sum(math.comb(n1, k) * math.comb(n2, k) * math.factorial(k) for k in range(min(n1, n2) + 1))


def common_objects_log_prior(k: int, n1: int, n2: int, q1: float, q2: float) -> float:
    """METHOD 4.1 [T6]: ln P of one hypothesis with k pairs, up to a constant; −∞ where it is impossible."""
    n = n1 + n2 - k
    return float(gammaln(n + 1) + xlogy(n1 - k, q2) + xlogy(n2 - k, q1) - (n + 1) * math.log1p(-q1 * q2))


def common_objects_slope(n1: int, n2: int, q1: float, q2: float) -> float:
    """a₂ of METHOD 4.2 [T28], the least-squares slope of 4.1 over k = 0 … N; 0 where N = min(N₁, N₂) = 0."""
    n = min(n1, n2)
    if n == 0:
        return 0.0
    total = sum((2 * i - n) * common_objects_log_prior(i, n1, n2, q1, q2) for i in range(n + 1))
    return 6 * total / (n**3 + 3 * n**2 + 2 * n)


def common_objects_linear(k: int, n1: int, n2: int, q1: float, q2: float) -> float:
    """The paper's linear form of 4.1, up to a constant: a₂ k."""
    return k * common_objects_slope(n1, n2, q1, q2)


def per_pair(k: int, log_odds: float) -> float:
    """Log prior with the same log odds for every pair: k · log_odds."""
    return k * log_odds


def scored_hypotheses(
    n1: int, n2: int, log_ratio: dict[Pair, float], log_prior: Callable[[int], float]
) -> list[tuple[float, tuple[Pair, ...]]]:
    """Λ(A) = ln P(k) + Σ ln λ  [T27] of every hypothesis over the pairs of ``log_ratio``."""
    return [(log_prior(len(h)) + sum(log_ratio[p] for p in h), h) for h in hypotheses(n1, n2, log_ratio)]


def best(n1: int, n2: int, log_ratio: dict[Pair, float], log_prior: Callable[[int], float]) -> tuple[float, set[Pair]]:
    """The most probable hypothesis: (score, pairs); any one of several in a tie."""
    score, pairs = max(scored_hypotheses(n1, n2, log_ratio, log_prior))
    return score, set(pairs)


def best_per_k(n1: int, n2: int, log_ratio: dict[Pair, float]) -> list[float]:
    """W_k, the largest Σ ln λ of k pairs, for k = 0 … min(N₁, N₂); −∞ where there are no k allowed pairs."""
    totals = [-math.inf] * (min(n1, n2) + 1)
    for score, pairs in scored_hypotheses(n1, n2, log_ratio, lambda k: 0.0):
        totals[len(pairs)] = max(totals[len(pairs)], score)
    return totals


# ---- METHOD 5: posterior ----


def posterior(
    n1: int, n2: int, log_ratio: dict[Pair, float], log_prior: Callable[[int], float]
) -> tuple[dict[Pair, float], np.ndarray, np.ndarray]:
    """P of every pair of ``log_ratio`` and of no partner: (pair → p, p_none_1 (n1,), p_none_2 (n2,))."""
    all_scored = scored_hypotheses(n1, n2, log_ratio, log_prior)
    log_total = logsumexp([score for score, _ in all_scored])
    p_pair = dict.fromkeys(log_ratio, 0.0)
    p_none_1, p_none_2 = np.zeros(n1), np.zeros(n2)
    for score, pairs in all_scored:
        p = math.exp(score - log_total)
        for pair in pairs:
            p_pair[pair] += p
        p_none_1[list(set(range(n1)) - {i for i, _ in pairs})] += p
        p_none_2[list(set(range(n2)) - {j for _, j in pairs})] += p
    return p_pair, p_none_1, p_none_2


# ---- METHOD 6: estimated quantities ----


def linear_basis(knots: np.ndarray, x: np.ndarray | float) -> np.ndarray:
    """(…, k) basis of curves that are linear between the knots (k,) and constant beyond them."""
    return np.stack([np.interp(x, knots, at) for at in np.eye(len(knots))], axis=-1)


def log_odds_without_positions(
    p: float, log_ratio: float, p_partner: tuple[float, float], profile: float, p_min: float, most_p: float
) -> float:
    """Log odds of a pair without its error density: from p, or up to p_min from its ratio and its records' 1 − p."""
    if p > p_min:
        p = min(p, most_p)
        return math.log(p / (1 - p)) - profile
    return log_ratio + sum(math.log(max(1 - x, 1e-30)) for x in p_partner) - profile


def cells(
    square: np.ndarray, log_odds: np.ndarray, least: float, most: float, nearest: float, reach: float, shape: Pair
) -> list[tuple[float, list[tuple[int, float]]]]:
    """Per distance bin, ascending: the mean square, and per odds bin (number of pairs, exp of the mean log odds)."""
    by_distance: dict[int, dict[int, list[int]]] = {}
    for e in np.flatnonzero(log_odds > least):
        along = (0.5 * math.log(max(square[e], nearest**2)) - math.log(nearest)) / math.log(reach / nearest)
        across = (min(log_odds[e], most) - least) / (most - least)
        row = by_distance.setdefault(int(along * (shape[0] - 1)), {})
        row.setdefault(int(across * (shape[1] - 1)), []).append(int(e))
    found = []
    for _, row in sorted(by_distance.items()):
        like = [(len(at), math.exp(np.minimum(log_odds[at], most).mean())) for _, at in sorted(row.items())]
        found.append((float(square[np.concatenate([*row.values()])].mean()), like))
    return found


def log_likelihood(
    count: np.ndarray, odds: np.ndarray, density: np.ndarray, pseudo: np.ndarray, shares: np.ndarray
) -> float:
    """Σ count ln(1 + odds · Σ_k density_k share_k) + Σ pseudo_k ln share_k; count, odds (n,), density (n, k)."""
    return float(count @ np.log1p(odds * (density @ shares)) + xlogy(pseudo, shares).sum())


def em_shares(count: np.ndarray, odds: np.ndarray, density: np.ndarray, pseudo: np.ndarray, steps: int) -> np.ndarray:
    """(k,) shares that maximise `log_likelihood`, by EM from equal shares."""
    shares = np.full(len(pseudo), 1 / len(pseudo))
    for _ in range(steps):
        expected = (count * odds / (1 + odds * (density @ shares))) @ density * shares + pseudo
        shares = expected / expected.sum()
    return shares


def log_magnitude_density(
    y: float, variance: float, others: np.ndarray, other_variance: np.ndarray, knots: np.ndarray, relation: tuple,
    background: float,
) -> float:  # fmt: skip
    """ln p of a magnitude given others (1 + c,); relation: offset, scatter, slopes, centres, scales, shares."""
    offset, scatter, slopes, centres, scales, shares = relation
    basis = linear_basis(knots, others[0])
    mean = others[0] + basis @ offset + slopes @ (others[1:] - others[0] - centres)
    gradient = np.append(1 - slopes.sum(), slopes)  # of the mean with respect to each of the others
    sigma = math.sqrt((basis @ scatter) ** 2 + variance + gradient**2 @ other_variance)
    return math.log(shares[:-1] @ norm.pdf(y, mean, scales * sigma) + shares[-1] * background)


def weighted_quantiles(part: float, values: np.ndarray, weight: np.ndarray, nearest: np.ndarray, k: int) -> list[float]:
    """Weighted quantile of the values nearest to each of k knots (NaN without any), then of all values."""
    quantiles = []
    for mask in [*(nearest == at for at in range(k)), np.full(len(values), True)]:
        order = np.argsort(values[mask], kind="stable")
        below = np.cumsum(weight[mask][order])
        quantiles.append(values[mask][order][np.argmax(below >= below[-1] * part)] if mask.any() else math.nan)
    return quantiles


def em_iteration(
    sample: np.ndarray, colours: np.ndarray, knots: np.ndarray, state: tuple, penalty: np.ndarray, priors: dict
):
    """One EM iteration: (offset, scatter, slopes, scales, shares, covariance, mean basis, scatter error).

    sample : (n, 6) difference, its two variances, density if unrelated, first other magnitude, density if the pair is
        wrong.
    colours : (n, 2c) c colours, then their variances.
    """
    offset, scatter, slopes, scales, shares = state[:5]
    difference, variance, of_first, background, x, chance = sample.T
    c, curve = len(slopes), linear_basis(knots, x)
    basis = np.hstack([curve, colours[:, :c]])
    quoted = variance + (1 - slopes.sum()) ** 2 * of_first + colours[:, c:] @ slopes**2
    total = quoted + (curve @ scatter) ** 2
    residual = difference - basis @ np.append(offset, slopes)
    parts = shares[:-1] * norm.pdf(residual[:, None], 0.0, scales * np.sqrt(total)[:, None])
    unrelated = shares[-1] * background
    each = 1.0 / (parts.sum(axis=1) + unrelated + chance)
    parts *= each[:, None]
    own, precise = parts.sum(axis=1), parts @ scales**-2.0
    precision, number, true = precise / total, own.sum(), own.sum() + unrelated @ each
    inverse = np.linalg.inv(basis.T @ (precision[:, None] * basis) + penalty)
    covariance = inverse * np.sum((precision * residual) ** 2) / precision.sum()
    solved, mean = inverse @ basis.T @ (precision * difference), basis.T @ own / number
    # Excess of the squared residuals over the quoted errors at each knot, shrunk towards that of all knots.
    larger, share = number / max(number - len(mean), 1.0), mean[: len(knots)]
    observed, expected, precision_2 = precise * residual**2 / total**2, own / total, curve.T @ (own / total**2)
    excess = curve.T @ (larger * observed - own * quoted / total**2)
    shrinkage = priors["pairs"] * precision_2 / number
    squares = (excess + shrinkage * excess.sum() / precision_2.sum()) / (precision_2 + shrinkage)
    scatter = np.sqrt(np.maximum(squares, priors["scatter"] ** 2))
    by_knot = share / (precision_2 + shrinkage)
    influence = (larger * observed - expected) * (curve @ by_knot + by_knot @ shrinkage / precision_2.sum())
    error = math.sqrt(influence @ influence) / (2 * math.sqrt(share @ scatter**2))
    counts = np.maximum(parts.sum(axis=0) - priors["allowances"] * math.sqrt(true), 1e-3)
    shares = np.append(counts, true - number + priors["unrelated"])
    offset, slopes = np.split(solved, [len(knots)])
    return offset, scatter, slopes, scales, shares / shares.sum(), covariance, mean, error


def newton_step(
    magnitude: np.ndarray, log_odds: np.ndarray, p_detected: np.ndarray, knots: np.ndarray, penalty: np.ndarray,
    values: np.ndarray, longest: float,
) -> np.ndarray:  # fmt: skip
    """(k,) values after one Newton step towards the maximum of the penalised likelihood, at most ``longest`` each."""
    basis = linear_basis(knots, magnitude)
    expected = 1 / (1 + np.exp(-(log_odds + basis @ values)))
    hessian = basis.T @ ((expected * (1 - expected))[:, None] * basis) + penalty
    step = np.linalg.solve(hessian, basis.T @ (p_detected - expected) - penalty @ values)
    return values + np.clip(step, -longest, longest)


def log_weight_change(magnitude: float, share: float, least: float, knots: np.ndarray, values: np.ndarray) -> float:
    """Change of ½ ln s − ln(1 − s) when the logit of s is shifted by the curve; 0 without a magnitude."""
    if math.isnan(magnitude):
        return 0.0
    share = min(max(share, least), 1 - least)
    before = math.log(share) - math.log(1 - share)
    after = before + linear_basis(knots, magnitude) @ values
    # ln s = −ln(1 + e^−x) and ln(1 − s) = −ln(1 + e^x) for the logit x.
    gains = [np.logaddexp(0, x) - 0.5 * np.logaddexp(0, -x) for x in (before, after)]
    return float(gains[1] - gains[0])


# ---- METHOD 6: the offset between two sources ----


def wrapped(delta: np.ndarray, periods: np.ndarray) -> np.ndarray:
    """(d,) difference, reduced to within half a period on periodic axes."""
    return np.array(
        [x - p * math.floor(x / p + 0.5) if p < math.inf else x for x, p in zip(delta, periods, strict=True)]
    )


def near_pairs(
    one: tuple[np.ndarray, np.ndarray], two: tuple[np.ndarray, np.ndarray], periods: np.ndarray, sigmas: float,
    widening: float,
) -> dict[Pair, tuple[np.ndarray, np.ndarray]]:  # fmt: skip
    """{pair: (residual, widened covariance)} of the pairs within ``sigmas``; each source: positions (n, d), errors."""
    found = {}
    for i in range(len(one[0])):
        for j in range(len(two[0])):
            delta, cov = wrapped(one[0][i] - two[0][j], periods), widening**2 * (one[1][i] + two[1][j])
            if mahalanobis(delta, cov) <= sigmas**2:
                found[i, j] = delta, cov
    return found


def overlap(
    box: np.ndarray, one: np.ndarray, two: np.ndarray, margin: float, periods: np.ndarray
) -> tuple[float, list[float], list[int]]:
    """(volume of the common field, volumes of both fields, number of records of each source in the common field)."""
    more = np.ptp(two, axis=0) / max(len(two) - 1, 1) + margin
    open_axes = np.isinf(periods)
    boxes = [box, np.array([two.min(axis=0) - more, two.max(axis=0) + more])]
    boxes = [np.where(open_axes, b, [np.zeros(len(periods)), periods]) for b in boxes]
    low, high = np.maximum(boxes[0][0], boxes[1][0]), np.minimum(boxes[0][1], boxes[1][1])
    inside = [int((((x >= low) & (x <= high)) | ~open_axes).all(axis=1).sum()) for x in (one, two)]
    return float(np.prod(np.maximum(high - low, 0.0))), [float(np.prod(b[1] - b[0])) for b in boxes], inside


def belief_propagation(weight: np.ndarray, sweeps: int) -> tuple[np.ndarray, float]:
    """(probability of each pair, ln of the sum over all hypotheses); weight (n1, n2), 0 where there is no pair."""
    to_row = np.ones_like(weight)
    for _ in range(sweeps):
        incoming = weight * to_row
        to_column = weight / (1 + incoming.sum(axis=1, keepdims=True) - incoming)
        to_row = 1 / (1 + to_column.sum(axis=0) - to_column)
    incoming = weight * to_row
    by_row, by_column = 1 + incoming.sum(axis=1), 1 + to_column.sum(axis=0)
    log_sum = np.log(by_row).sum() + np.log(by_column).sum() - np.log1p(to_column * to_row).sum()
    return incoming / by_row[:, None], float(log_sum)


def count_differences(
    one: np.ndarray, two: np.ndarray, periods: np.ndarray, low: np.ndarray, size: np.ndarray, cells: np.ndarray
):
    """(cells) number of differences in each cell; the outermost cells stay 0."""
    votes = np.zeros(cells)
    for a in one:
        for b in two:
            at = np.floor((wrapped(a - b, periods) - low) / size).astype(int)
            if (at > 0).all() and (at < cells - 1).all():
                votes[tuple(at)] += 1
    return votes


# ---- METHOD 6: holes of a source ----


def inside_empty_discs(
    points: np.ndarray, others: np.ndarray, is_centre: np.ndarray, radius: np.ndarray, inner: np.ndarray, least: float,
    periods: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """(n,) mask of points closer than ``inner`` to a centre of an empty disc.

    A disc is empty if no point of ``others`` and at least ``least`` of ``points`` are closer than ``radius``.
    """
    inside = np.zeros(len(points), bool)
    for c in np.flatnonzero(is_centre):
        to_others = np.array([np.linalg.norm(wrapped(point - points[c], periods)) for point in others])
        to_points = np.array([np.linalg.norm(wrapped(point - points[c], periods)) for point in points])
        if (to_others >= radius[c]).all() and (to_points < radius[c]).sum() >= least:
            inside |= to_points < inner[c]
    return inside


# ---- Layouts ----


def ragged_ranges(first: list[int], size: list[int]) -> list[tuple[int, int, int]]:
    """(range, number within it, value) of each whole number of several ranges, one range after the other."""
    return [(k, t, first[k] + t) for k in range(len(size)) for t in range(size[k])]


# ---- shift and stack of frames ----


def best_motion(
    signal: np.ndarray, weight: np.ndarray, down: np.ndarray, right: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) the largest Σψ/√Σφ over all rates and the number of that rate; 0 where Σφ ≤ ``least`` for every rate."""
    frames, height, width = signal.shape
    best, which = np.zeros((height, width)), np.zeros((height, width), int)
    for y in range(height):
        for x in range(width):
            for r in range(len(down)):
                pixels = [
                    (f, y + down[r, f], x + right[r, f])
                    for f in range(frames)
                    if 0 <= y + down[r, f] < height and 0 <= x + right[r, f] < width
                ]
                phi = sum(float(weight[at]) for at in pixels)
                psi = sum(float(signal[at]) for at in pixels)
                if phi > least and psi / math.sqrt(phi) > best[y, x]:
                    best[y, x], which[y, x] = psi / math.sqrt(phi), r
    return best, which


# ---- densities in nested cells ----


def nested_densities(
    cells: np.ndarray, numbers: np.ndarray, levels: tuple[int, ...], volume: float
) -> tuple[np.ndarray, np.ndarray]:
    """(u, 2) whether the other source covers each cell, and (u, 2, 2) its density there, from coarse to fine levels."""
    from sameas.estimate import coverage

    def level(steps: int, n: np.ndarray) -> list[tuple[np.ndarray, float]]:
        """For each cell: records of both sources in its parent ``steps`` levels up, and the parent's covered volume."""
        out = []
        for cell in cells:
            inside = n[cells >> 2 * steps == cell >> 2 * steps].astype(float)
            total, sharing, most = inside.sum(axis=0), (inside * (inside - 1.0)).sum(axis=0), 4.0**steps
            covered = []
            for k in range(2):
                due = total[k] ** 2 / most
                partly = sharing[k] > due + PARTLY * math.sqrt(2.0 * due) + 1.0
                covered.append(max(total[k] ** 2 / max(sharing[k], 1.0), 1.0) if partly else most)
            richer = int(total[1] > total[0])
            out.append((total, volume * (np.mean(covered) if total[0] == total[1] else covered[richer])))
        return out

    def all_of(n: np.ndarray) -> float:
        first = {cell >> 2 * levels[0]: size for cell, (_, size) in zip(cells, level(levels[0], n), strict=True)}
        return sum(first.values())

    total = numbers.sum(axis=0)
    seen = np.ones(numbers.shape, bool)
    density, highest = np.tile(total[::-1] / all_of(numbers), (len(cells), 1)), np.zeros(numbers.shape)
    for steps in levels:
        for k, (n, size) in enumerate(level(steps, numbers)):
            for s in range(2):
                expected = max(density[k, s], 0.5 * highest[k, s]) * size
                if n[1 - s] == 0 and n[s] >= IN_CELL * total[s] / total[1 - s] and expected >= coverage.HOLE:
                    seen[k, s] = False
                highest[k, s] = max(highest[k, s], density[k, s])
                drawn = COVERAGE_PSEUDO_COUNT / density[k, s]
                density[k, s] = (n[1 - s] + COVERAGE_PSEUDO_COUNT) / (size + drawn)
    numbers = numbers * seen
    total = numbers.sum(axis=0)
    at = np.repeat(((total + 0.5) / all_of(numbers))[None, :, None], len(cells), axis=0).repeat(2, axis=2)
    ended = [total[0] == 0, total[1] == 0]
    for steps in levels:
        known = level(steps, numbers)
        of_cells = {cell >> 2 * steps: n for cell, (n, _) in zip(cells, known, strict=True)}
        for s in range(2):
            finest = sum(n[s] ** 2 for n in of_cells.values()) <= FINEST_CELLS * total[s] or steps == 0
            scores = []
            for rank, smooth in enumerate(coverage.SMOOTHS):
                score = -LOG_PRIOR_STEP * rank
                for k, (n, size) in enumerate(known):
                    if numbers[k, s]:
                        due = (max(n[s] - 1.0, 0.0) + smooth) / (size + smooth / at[k, s, 0])
                        score += numbers[k, s] * math.log(due)
                scores.append(score)
            smooth = coverage.SMOOTHS[int(np.argmax(scores))]
            if not ended[s]:
                for k, (n, size) in enumerate(known):
                    left = max(n[s] - (LEFT_OUT if finest else 1.0), 0.0)
                    at[k, s, 0] = (left + smooth) / (size + smooth / at[k, s, 0])
                    at[k, s, 1] = (n[s] + smooth) / (size + smooth / at[k, s, 1])
            ended[s] = ended[s] or finest
    return seen, at


def partitions_of(rows: list[int]) -> Iterator[list[list[int]]]:
    """All partitions of some rows into objects."""
    if not rows:
        yield []
        return
    for rest in partitions_of(rows[1:]):
        for k in range(len(rest)):
            yield [*rest[:k], [rows[0], *rest[k]], *rest[k + 1 :]]
        yield [[rows[0]], *rest]


def log_object(xy: np.ndarray, variance: np.ndarray, log_density: float, log_count: np.ndarray) -> float:
    """ln w of an object with rows (k, 2) of circular errors: the density of each row given those before it."""
    total, precision, place = log_density + log_count[len(xy)], 0.0, np.zeros(2)
    for at, v in zip(xy, variance, strict=True):
        if precision:
            total += log_normal(at - place, (v + 1.0 / precision) * np.eye(2))
        place = (place * precision + at / v) / (precision + 1.0 / v)
        precision += 1.0 / v
    return total
