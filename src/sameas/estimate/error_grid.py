"""Which error models the records allow: their likelihood on a grid, and probabilities averaged over what is left of it.

The residuals of a pair have the covariance a²(Σ₁ + Σ₂) + f²·1. The likelihood of the error scale a and the floor f is
computed before any iteration (:func:`scan_errors`). It is not taken over pairs that look certain, because that depends
on the errors, but over all candidates within a wide radius: chance candidates are uniform around a record, common
objects are not. For a record of one source that is common with probability c and has candidates j, at most one of which
is the same object,

    L = 1 − c + c Σ_j N(Δ_j; 0, a²Σ_j + f²·1) / ρ,

with ρ the density of the other source (METHOD 6, equation 6.1a). Competition between records is ignored here; it counts
in the sum over one-to-one hypotheses for the remaining points of the grid. The prior says that formal errors are
usually too small, and that a floor of the size of the quoted error is common.

With many pairs, estimation starts from the best point. With few, :class:`ErrorAverage` keeps the points that are not
ruled out, and probabilities are averaged over them (:func:`identify_averaged`). With errors θ_k and the number of
common objects n_k by each,

    P(pair) = Σ_k w_k P(pair | θ_k, n_k),   w_k ∝ prior(θ_k) L(θ_k, n_k),
    ln L = ln Z + n + N₁ ln(1 − n/N₁) + N₂ ln(1 − n/N₂),

where Z sums over all one-to-one hypotheses, and the rest is the probability of N₁ and N₂ records of a Poisson field, up
to a constant. So a pair that is certain by only one of the errors is not certain.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.assignment import Hypothesis, assign
from sameas.estimate.cells import finest
from sameas.estimate.coverage import Coverage
from sameas.evidence import Errors, Evidence, Rule
from sameas.gate import ChiSquare, Pairs, Radius
from sameas.groups import Groups, groups, laid_out
from sameas.posterior import Posterior, by_messages, log_evidence, posterior
from sameas.prior import PerPair
from sameas.records import Records
from sameas.result import Identification
from sameas.space import ball_volume

#: Pairs of smaller ln odds, before one-to-one, are dropped (chosen; below rounding).
MIN_LOG_ODDS = math.log(1e-12)
#: Probabilities, and their complements, below this have lost their digits; odds are then used directly.
ROUNDING = 1e-9

Solver = Callable[..., Posterior]


# The grid.


@dataclass(frozen=True)
class GridTuning:
    """The grid of error scales and floors, and their prior.

    Attributes
    ----------
    chance_candidates : of a record of the poorer source, within the widest radius.
    reach : the widest radius, in standard deviations of the largest floor.
    enough, cell : with more records than this in both sources, cells with this many records of the poorer source are
        sampled until they hold enough.
    seed : of the generator that draws them.
    log_factor : mean and standard deviation of ln a: formal errors are usually too small (chosen).
    log_floor : the same of ln f, with f relative to the typical quoted error of a pair (chosen).
    no_floor : prior probability of no floor (chosen).
    factors : least and greatest a; 1 is one of the steps between. factor_step, floor_step : of ln a and ln f.
    tail : share of pairs with errors larger than the others by this factor (chosen), so that an outlier does not imply
        a floor of all.
    shares : of the poorer source in common, equally probable.
    min_weight : points of a smaller weight are dropped.
    min_points : the steps are halved, at most ``halvings`` times, until this many points are left. max_points : kept.
    max_averaged : number of common objects from which the best errors are used instead of the average.
    """

    chance_candidates: float = 3.0
    reach: float = 5.0
    enough: int = 600
    cell: int = 150
    seed: int = 20_041
    log_factor: tuple[float, float] = (math.log(1.2), 0.6)
    log_floor: tuple[float, float] = (0.0, 1.5)
    no_floor: float = 0.3
    factors: tuple[float, float] = (math.exp(-5 * 0.36), 32.0)
    factor_step: float = 0.36
    floor_step: float = 0.5
    tail: tuple[float, float] = (0.03, 4.0)
    shares: tuple[float, ...] = (0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97)
    min_weight: float = 1e-3
    min_points: int = 16
    halvings: int = 4
    max_points: int = 48
    max_averaged: float = 300.0


DEFAULT_GRID = GridTuning()


@dataclass(frozen=True)
class ErrorScan:
    """Posterior of the errors from the candidates within a wide radius.

    pairs : these candidates, by the quoted errors. errors, log_prior : the k points that are not ruled out.
    weight : (k,) their posterior weights. common : expected number of common objects.
    contrast : gain in ln likelihood over no common objects. gain : over errors about as quoted.
    """

    pairs: Pairs
    errors: tuple[Errors, ...]
    log_prior: FloatArray
    weight: FloatArray
    common: float
    contrast: float
    gain: float

    @property
    def best(self) -> Errors:
        """The point of largest weight, without a tail."""
        return self.errors[int(np.argmax(self.weight))].with_mixture(Errors())

    def average(self, d: int) -> ErrorAverage:
        """All points, with a gate for their tails."""
        # Half the usual gate in units of the tail's error: few pairs of the small tail lie beyond.
        reach = max(0.5 * max(self.errors[0].scales), 1.0)
        return ErrorAverage(self.errors, self.log_prior, ChiSquare().limit(d) * reach**2)


def scan_errors(
    coverage: Coverage, density: tuple[float, float] | None = None, tuning: GridTuning = DEFAULT_GRID
) -> ErrorScan | None:
    """The posterior of the errors; None where candidates cannot determine them.

    That is where records lie so close that quoted errors cannot be enlarged, and where no record of one source lies in
    the field of the other: with densities of an empty sky, all records would be candidates of all.

    Parameters
    ----------
    density : (ρ₁, ρ₂) of all records of each source, if given by the user.
    """
    if not all(covered.any() for covered in coverage.covered):
        return None
    unit = coverage.typical_error
    rows = _sampled_rows(coverage, tuning)
    if rows is None:
        return None
    rows_1, rows_2 = rows
    first, second = coverage.first, coverage.second
    if len(rows_1) < len(first) or len(rows_2) < len(second):
        first, second = first.part(rows_1), second.part(rows_2)
    d = first.d
    richer = max(mean_densities(coverage, density))
    # In units of the typical error; a floor is the same along every axis.
    widest = (tuning.chance_candidates / (ball_volume(d) * richer * float(np.prod(unit)))) ** (1.0 / d)
    if widest < math.sqrt(ChiSquare().limit(d)):
        return None
    wide = Errors(factor_1=1e-6, factor_2=1e-6, floor=floor_of_axes(widest / tuning.reach * unit))
    pairs = Radius(tuning.reach)(*wide.records(first, second)).of(first, second)
    return _scan(pairs, coverage, (rows_1, rows_2), unit, widest, density, tuning)


def _scan(
    pairs: Pairs,
    coverage: Coverage,
    rows: tuple[IntArray, IntArray],
    unit: FloatArray,
    widest: float,
    density: tuple[float, float] | None,
    tuning: GridTuning,
) -> ErrorScan:
    """The grid over these candidates, which are those of some rows of both sources."""
    # One term of the likelihood for each record of the poorer source.
    n1, n2 = len(rows[0]), len(rows[1])
    poorer, at = (0, pairs.i) if n1 <= n2 else (1, pairs.j)
    covered = coverage.covered[poorer][rows[poorer]]
    other = 1 - poorer
    if density is None:
        density_there = coverage.covered_densities[other][poorer][rows[poorer]]
    else:
        density_there = np.full(len(rows[poorer]), density[other])
    residuals = _Residuals.of(pairs, unit, np.log(density_there)[at])
    lattice = _Lattice.over(residuals, widest, tuning)
    total = float(np.count_nonzero(coverage.covered[poorer]))
    gain = contrast = math.nan
    while True:
        sums = residuals.sums(lattice, at, len(covered))
        log_likelihood = np.array([_log_likelihood(each[covered], tuning) for each in sums])
        if not lattice.n_halvings:
            gain = float(log_likelihood.max() - log_likelihood[lattice.as_quoted].max())
            contrast = float(log_likelihood.max())
        log_weight = lattice.log_prior + np.logaddexp.reduce(log_likelihood, axis=1)
        weight = np.exp(log_weight - log_weight.max())
        kept = weight > tuning.min_weight * weight.sum()
        kept &= weight >= np.sort(weight)[-min(tuning.max_points, len(weight))]
        share = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))[kept]
        lattice, weight = lattice.part(kept), weight[kept] / weight[kept].sum()
        common = total * float(weight @ (share @ np.array(tuning.shares) / share.sum(axis=1)))
        enough = len(weight) >= tuning.min_points or common > tuning.max_averaged
        if enough or lattice.n_halvings >= tuning.halvings:
            return ErrorScan(pairs, lattice.errors(unit), lattice.log_prior, weight, common, contrast, gain)
        lattice = lattice.refined()


def _log_likelihood(sums: FloatArray, tuning: GridTuning) -> FloatArray:
    """(c,) ln of the likelihood of the records with these Σ N/ρ (n,), by share in common."""
    return np.asarray(np.log1p(np.multiply.outer(tuning.shares, sums - 1.0)).sum(axis=1))


def mean_densities(coverage: Coverage, density: tuple[float, float] | None) -> tuple[float, float]:
    """Mean density of each source at the records of the other, per volume of the residuals; ``density`` if given."""
    if density is not None:
        return density
    one, two = coverage.covered_densities
    return float(one[1].mean()), float(two[0].mean())


def _sampled_rows(coverage: Coverage, tuning: GridTuning) -> tuple[IntArray, IntArray] | None:
    """Rows of both sources that are used: all, or those in sampled cells."""
    n1, n2 = len(coverage.first), len(coverage.second)
    if min(n1, n2) <= 2 * tuning.enough:
        return np.arange(n1), np.arange(n2)
    poorer = 0 if n1 <= n2 else 1
    level = finest(coverage.levels, min(n1, n2) / tuning.cell)
    of = (level.of_first, level.of_second)
    count = np.bincount(of[poorer][coverage.covered[poorer]], minlength=len(level.volume))
    drawn = level.drawn((count,), tuning.enough, tuning.seed)
    rows_1, rows_2 = (np.flatnonzero(drawn[cell]) for cell in of)
    return (rows_1, rows_2) if len(rows_1) and len(rows_2) else None


@dataclass(frozen=True)
class _Residuals:
    """Candidates along the axes of their quoted covariance, in units of the typical error.

    variance, square : (d, m) of the quoted error, and squared residual. log_unit : (m,) ln density factor per record of
    the other source.
    """

    variance: FloatArray
    square: FloatArray
    log_unit: FloatArray

    @classmethod
    def of(cls, pairs: Pairs, unit: FloatArray, log_density: FloatArray) -> _Residuals:
        scaled = pairs.covariance / (unit[:, None] * unit)
        variance, axes = np.linalg.eigh(scaled)
        along = np.einsum("mvw,mv->wm", axes, pairs.residual / unit)
        return cls(
            variance.T.copy(),
            along**2,
            -log_density - float(np.log(unit).sum()) - 0.5 * len(unit) * math.log(2 * math.pi),
        )

    def sums(self, lattice: _Lattice, at: IntArray | Int32Array, n: int) -> list[FloatArray]:
        """(n,) Σ N/ρ over the candidates of every record, for each point of the lattice."""
        out: list[FloatArray] = []
        (share, scale), d = lattice.tuning.tail, len(self.square)
        for factor, floor in zip(lattice.factor, lattice.floor, strict=True):
            variance = factor**2 * self.variance + floor**2
            half, peak = -0.5 * (self.square / variance).sum(axis=0), self.log_unit - 0.5 * np.log(variance).sum(axis=0)
            profile = (1.0 - share) * np.exp(half) + share / scale**d * np.exp(half / scale**2)
            out.append(np.asarray(np.bincount(at, np.exp(peak) * profile, n), np.float64))
        return out


@dataclass(frozen=True)
class _Lattice:
    """k grid points: steps of ln a above the least factor, and of ln f above the least floor or ``no_floor``.

    min_floor : least floor. max_floor_index : greatest index of the floor before halving. n_halvings : of the steps.
    """

    factor_index: IntArray
    floor_index: IntArray
    no_floor: BoolArray
    min_floor: float
    max_floor_index: int
    n_halvings: int
    tuning: GridTuning

    @classmethod
    def over(cls, residuals: _Residuals, widest: float, tuning: GridTuning) -> _Lattice:
        """All factors, and floors from 0.3 of the smallest quoted errors to a third of the widest radius."""
        low, high = (math.log(value) for value in tuning.factors)
        min_floor = 0.3 * math.sqrt(float(np.quantile(residuals.variance, 0.05))) if residuals.variance.size else 0.3
        most = max(int(math.log(widest / 3.0 / min_floor) / tuning.floor_step), 1)
        grids = np.meshgrid(np.arange(int((high - low) / tuning.factor_step) + 1), np.arange(-1, most + 1))
        factor_index, floor_index = (np.asarray(grid.ravel(), np.int64) for grid in grids)
        return cls(factor_index, np.maximum(floor_index, 0), floor_index < 0, min_floor, most, 0, tuning)

    @property
    def factor(self) -> FloatArray:
        """(k,) a."""
        tuning, halving = self.tuning, 2**self.n_halvings
        return np.asarray(tuning.factors[0] * np.exp(self.factor_index * tuning.factor_step / halving))

    @property
    def floor(self) -> FloatArray:
        """(k,) f, in units of the typical error."""
        log_step = self.floor_index * self.tuning.floor_step / 2**self.n_halvings
        return np.where(self.no_floor, 0.0, self.min_floor * np.exp(log_step))

    @property
    def as_quoted(self) -> BoolArray:
        """(k,) points with about the quoted errors: the two factors next to 1, without a floor."""
        distance = np.abs(np.log(self.factor))
        return self.no_floor & (distance < self.tuning.factor_step)

    def part(self, kept: BoolArray) -> _Lattice:
        """The lattice with some of its points."""
        factor_index, floor_index, no_floor = self.factor_index[kept], self.floor_index[kept], self.no_floor[kept]
        return replace(self, factor_index=factor_index, floor_index=floor_index, no_floor=no_floor)

    def refined(self) -> _Lattice:
        """The lattice with half the steps, around all its points."""
        factor_index = np.concatenate([2 * self.factor_index + a for a in (-1, 0, 1) for _ in range(3)])
        floor_index = np.concatenate([2 * self.floor_index + f for _ in range(3) for f in (-1, 0, 1)])
        no_floor = np.tile(self.no_floor, 9)
        floor_index[no_floor] = 0
        n_halvings = self.n_halvings + 1
        inside = (floor_index >= 0) & (floor_index <= self.max_floor_index * 2**n_halvings) & (factor_index >= 0)
        points = np.unique(np.column_stack([no_floor, factor_index, floor_index])[inside], axis=0)
        return replace(
            self, factor_index=points[:, 1], floor_index=points[:, 2], no_floor=points[:, 0] > 0, n_halvings=n_halvings
        )

    @property
    def log_prior(self) -> FloatArray:
        """(k,) ln prior probability of the cell around every point, up to a constant."""
        tuning = self.tuning
        mean, sigma = tuning.log_factor
        of_factor = -0.5 * ((np.log(self.factor) - mean) / sigma) ** 2
        mean, sigma = tuning.log_floor
        cell = tuning.floor_step / 2**self.n_halvings / (sigma * math.sqrt(2.0 * math.pi))
        log_floor = math.log(self.min_floor) + self.floor_index * tuning.floor_step / 2**self.n_halvings
        density = -0.5 * ((log_floor - mean) / sigma) ** 2
        with_floor = math.log((1.0 - tuning.no_floor) * cell) + density
        return np.asarray(of_factor + np.where(self.no_floor, math.log(tuning.no_floor), with_floor))

    def errors(self, unit: FloatArray) -> tuple[Errors, ...]:
        """The points as errors, in the unit of the residuals."""
        share, scale = self.tuning.tail
        mixture = Errors((1.0, scale), (1.0 - share, share)) if share > 0.0 else Errors()
        return tuple(
            replace(mixture, factor_1=float(a), factor_2=float(a), floor=floor_of_axes(f * unit))
            for a, f in zip(self.factor, self.floor, strict=True)
        )


# The average over its points.


@dataclass(frozen=True)
class ErrorAverage:
    """Errors that few pairs do not rule out: k of them, with ln of their prior probabilities (k,).

    limit : of Δᵀ S⁻¹ Δ, for a gate with all pairs by any of the errors.
    """

    errors: tuple[Errors, ...]
    log_prior: FloatArray
    limit: float

    def candidates(self, first: Records, second: Records) -> Pairs:
        """All candidates within the limit by any of the errors; their distances are by the quoted errors."""
        floors = _floors(self.errors)
        factor = max(errors.factor_1 for errors in self.errors)
        widest = Errors(factor_1=factor, factor_2=factor, floor=floor_of_axes(floors.max(axis=0)))
        pairs = Radius(math.sqrt(self.limit))(*widest.records(first, second)).of(first, second)
        near = np.zeros(len(pairs), np.bool_)
        for errors in self.errors:
            near |= errors.pairs(pairs).mahalanobis_sq <= self.limit
        return replace(
            pairs.part(near), gate=f"distance ≤ {math.sqrt(self.limit):.2f} σ by any of {len(floors)} errors"
        )

    def log_densities(self, pairs: Pairs) -> FloatArray:
        """(k, m) ln densities of the residuals; −∞ beyond the gate."""
        out = np.full((len(self.errors), len(pairs)), -np.inf)
        for row, errors in zip(out, self.errors, strict=True):
            modelled = errors.pairs(pairs)
            near = modelled.mahalanobis_sq <= self.limit
            row[near] = modelled.log_peak[near] + errors.log_profile(modelled.mahalanobis_sq[near], pairs.d)
        return out

    def ranges(self, weight: FloatArray) -> ErrorRanges:
        """95 % ranges of the errors with these (k,) weights."""
        factors = np.array([errors.factor_1 for errors in self.errors])
        floors = np.array([np.max(errors.floor) for errors in self.errors])
        return ErrorRanges(_interval(factors, weight), _interval(floors, weight))

    def typical(self, weight: FloatArray) -> Errors:
        """Errors whose variances are the weighted mean of all, weights (k,)."""
        factor = math.sqrt(sum(w * e.factor_1**2 for w, e in zip(weight, self.errors, strict=True)))
        floors = _floors(self.errors)
        floor = np.sqrt(weight @ floors**2)
        return replace(self.errors[0], factor_1=factor, factor_2=factor, floor=floor_of_axes(floor))


@dataclass(frozen=True)
class ErrorRanges:
    """Ranges of the errors that hold 95 % of the posterior with few pairs.

    factors : (least, greatest) factor on the quoted errors. floors : the same of the floor, in the unit of the
    residuals.
    """

    factors: tuple[float, float]
    floors: tuple[float, float]


def _interval(values: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """The weighted 2.5 % and 97.5 % quantiles."""
    order = np.argsort(values)
    cumulated = np.cumsum(weight[order])
    low, high = (values[order[min(int(np.searchsorted(cumulated, q)), len(order) - 1)]] for q in (0.025, 0.975))
    return float(low), float(high)


def _floors(errors: tuple[Errors, ...]) -> FloatArray:
    """(k, 1) or (k, d) floors; with several axes in any of them, a single number applies to every axis."""
    axes = max(np.size(one.floor) for one in errors)
    return np.array([np.broadcast_to(one.floor, (axes,)) for one in errors])


def floor_of_axes(floor: FloatArray) -> float | tuple[float, ...]:
    """The floor as one number if it is the same along all axes."""
    return float(floor[0]) if np.all(floor == floor[0]) else tuple(floor.tolist())


@dataclass(frozen=True)
class Average:
    """Errors over which probabilities are averaged, k of them, for one list of candidates.

    average : the errors and their prior. log_density : (k, m) ln densities of the residuals. weight : (k,) posterior.
    n_common : (k,) expected number of common objects by each.
    """

    average: ErrorAverage
    log_density: FloatArray
    weight: FloatArray
    n_common: FloatArray

    @classmethod
    def of(cls, average: ErrorAverage, pairs: Pairs, weight: FloatArray, common: float) -> Average:
        """Before the first EM iteration, with given (k,) weights and number of common objects."""
        return cls(average, average.log_densities(pairs), weight, np.full(len(weight), common))

    @property
    def typical(self) -> Errors:
        """Errors of the mean variance."""
        return self.average.typical(self.weight)

    def posterior(
        self,
        pairs: Pairs,
        others: FloatArray,
        expected: float,
        n_records: tuple[int, int],
        *,
        exact: bool = False,
        companion_log_odds: FloatArray | None = None,
    ) -> tuple[Average, Averaged]:
        """The updated weights, and the averaged probabilities of the pairs; ``others`` (m,) is all other evidence.

        expected : number of common objects assumed in ``others``. n_records : N₁, N₂, records that may be common.
        exact : whether groups are summed exactly; else by message passing.
        companion_log_odds : (m,) ln of the odds, before one-to-one, that a pair is two companions.
        """
        solver: Solver = posterior if exact else by_messages
        p_pairs, log_weight, n_common = [], [], []
        assumed = _count_terms(expected, n_records)
        for log_prior, log_density, number in zip(self.average.log_prior, self.log_density, self.n_common, strict=True):
            own = _count_terms(number, n_records)
            solution = HypothesisSums.of(
                pairs, others + log_density + (own.odds - assumed.odds), solver, companion_log_odds
            )
            p_pairs.append(solution.p_pair)
            log_weight.append(log_prior + solution.log_evidence + own.log_records)
            # With a uniform prior of the share in common.
            n_common.append((float(solution.p_pair.sum()) + 0.5) / (min(n_records) + 1.0) * min(n_records))
        weight = np.exp(np.array(log_weight) - max(log_weight))
        weight /= weight.sum()
        odds = others + np.array([_count_terms(n, n_records).odds - assumed.odds for n in self.n_common])[:, None]
        averaged = Averaged.of(pairs, np.array(p_pairs), odds + self.log_density, weight)
        return replace(self, weight=weight, n_common=np.array(n_common)), averaged


@dataclass(frozen=True)
class _CountTerms:
    """What the number of common objects adds to the ln odds of a pair, and to the ln probability of the records."""

    odds: float
    log_records: float


def _count_terms(number: float, n_records: tuple[int, int]) -> _CountTerms:
    number = min(max(number, 1e-3), min(n_records) * (1.0 - 1e-6))
    alone = [math.log1p(-number / n) for n in n_records]
    records = number + sum(n * log for n, log in zip(n_records, alone, strict=True))
    return _CountTerms(math.log(number) - sum(alone), records)


@dataclass(frozen=True)
class HypothesisSums:
    """Sums over all one-to-one hypotheses of one list of candidates.

    p_pair : (m,) probabilities that pairs are one object. grouped : groups of the pairs that are not dropped; best :
    their most probable hypothesis; p_related : their probabilities to be one object or companions.
    """

    p_pair: FloatArray
    grouped: Groups
    best: Hypothesis
    p_related: FloatArray

    @classmethod
    def of(
        cls,
        pairs: Pairs,
        log_same: FloatArray,
        solver: Solver,
        companion_log_odds: FloatArray | None = None,
        least: float = MIN_LOG_ODDS,
    ) -> HypothesisSums:
        """From (m,) ln odds of the pairs, before one-to-one, to be one object and (optional) two companions, against
        unrelated objects.

        Pairs with odds below ``least`` are dropped, with probability 0: one-to-one makes no pair more probable.
        """
        log_ratio = log_same if companion_log_odds is None else np.logaddexp(log_same, companion_log_odds)
        kept = np.flatnonzero(log_ratio > least)
        places = pairs.place_1[kept], pairs.place_2[kept], pairs.i[kept], pairs.j[kept]
        grouped = laid_out(*places, len(pairs.first), len(pairs.second))
        best = assign(grouped, log_ratio[kept], PerPair()(grouped.sizes_1, grouped.sizes_2))
        p, p_pair = solver(grouped, best).p_pair, np.zeros(len(pairs))
        p_pair[kept] = p if companion_log_odds is None else p * np.exp(log_same[kept] - log_ratio[kept])
        return cls(p_pair, grouped, best, p)

    @property
    def log_evidence(self) -> float:
        """ln of the sum over all hypotheses, relative to the hypothesis without pairs."""
        return float(log_evidence(self.grouped, self.best, self.p_related).sum())


@dataclass(frozen=True)
class Averaged:
    """Averaged probabilities of the pairs.

    p_pair : (m,). log_ratio : (m,) ln odds, before one-to-one, for choosing the most probable hypothesis. In a group
    without cycles, odds p (1 − p) / (p₀ p₀') give the pairs their probabilities p, with p₀ those of no partner.
    """

    p_pair: FloatArray
    log_ratio: FloatArray

    @classmethod
    def one(cls, pairs: Pairs, p_pair: FloatArray, log_ratio: FloatArray) -> Averaged:
        """From one point, (m,) each."""
        return cls.of(pairs, p_pair[None], log_ratio[None], np.ones(1))

    @classmethod
    def of(cls, pairs: Pairs, p_pairs: FloatArray, log_ratios: FloatArray, weight: FloatArray) -> Averaged:
        """From all points: p_pairs, log_ratios (k, m), weight (k,)."""
        p = np.clip(weight @ p_pairs, 0.0, 1.0)
        alone_1, alone_2 = (
            np.maximum(1.0 - np.bincount(at, p, n), 0.0)[at]
            for at, n in ((pairs.i, len(pairs.first)), (pairs.j, len(pairs.second)))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            log_weight = np.log(weight)[:, None]
            log_ratio = np.log(p) + np.log1p(-np.minimum(p, 1.0 - 1e-16)) - np.log(alone_1) - np.log(alone_2)
        least_alone = np.minimum(alone_1, alone_2)
        arithmetic = np.logaddexp.reduce(log_weight + log_ratios, axis=0)
        # Near certainty the harmonic mean of the odds: the smallest odds have the greatest effect.
        bounded = np.maximum(log_ratios, MIN_LOG_ODDS)
        harmonic = -np.logaddexp.reduce(log_weight - bounded, axis=0)
        log_ratio = np.where(p < ROUNDING, arithmetic, np.where(least_alone < ROUNDING, harmonic, log_ratio))
        return cls(p, np.maximum(log_ratio, -1e4))


def identify_averaged(
    average: Average | None,
    pairs: Pairs,
    rule: Rule,
    expected: float,
    n_records: tuple[int, int],
    companion_log_odds: FloatArray | None = None,
) -> Identification:
    """The identification of these candidates with averaged probabilities.

    The averaged odds replace the term of the positions in the evidence of ``rule``, or that of companions if errors are
    known (``average`` None). expected, n_records, companion_log_odds : as in :meth:`Average.posterior`.
    """
    evidence = rule(pairs)
    if average is None:
        replaced, rest, log_ratio = "companions", without_term(evidence, "companions"), evidence.log_ratio
        averaged = Averaged.one(
            pairs, HypothesisSums.of(pairs, log_ratio, posterior, companion_log_odds).p_pair, log_ratio
        )
    else:
        replaced, rest = "position", without_positions(evidence)
        _, averaged = average.posterior(
            pairs, rest, expected, n_records, exact=True, companion_log_odds=companion_log_odds
        )
    terms = {**evidence.terms, replaced: averaged.log_ratio - rest}
    grouped = groups(pairs)
    best = assign(grouped, averaged.log_ratio, PerPair()(grouped.sizes_1, grouped.sizes_2))
    solution = posterior(grouped, best)
    return Identification(
        pairs, grouped, Evidence(terms, evidence.log_error), best, replace(solution, p_pair=averaged.p_pair)
    )


def without_positions(evidence: Evidence) -> FloatArray:
    """(m,) the sum of all terms except that of the positions."""
    return without_term(evidence, "position")


def without_term(evidence: Evidence, excluded: str) -> FloatArray:
    """(m,) the sum of all terms except one."""
    return np.asarray(sum(values for name, values in evidence.terms.items() if name != excluded))
