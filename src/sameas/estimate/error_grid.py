"""Which errors the records allow: a grid over error scale and floor, weighed before any quoted error is believed.

The residuals of a pair have the covariance a²(Σ₁ + Σ₂) + f²·1. Whether a and f are likely is not asked of pairs that
look sure, for which the errors must be known already, but of all candidates within a wide radius: by chance they lie
evenly about a record, common objects do not. For a record of one source with candidates j, of which at most one is the
same object, and common with probability c,

    L = 1 − c + c Σ_j N(Δ_j; 0, a²Σ_j + f²·1) / ρ,

with ρ the density of the other source (METHOD 11.1; the other source's claims are left out, they count in the sum over
one-to-one hypotheses, which is made with what is left of the grid). The prior says that formal errors are usually too
small, and that a floor of the size of the quoted error is common.

With many pairs the likeliest point is where estimation begins; with few, :class:`ErrorAverage` keeps all that are not
ruled out.

Probabilities are averaged over what few pairs cannot tell of the errors (:func:`identified`). With errors θ_k that are
not ruled out, and n_k objects in common by each,

    P(pair) = Σ_k w_k P(pair | θ_k, n_k),   w_k ∝ prior(θ_k) L(θ_k, n_k),
    ln L = ln Z + n + N₁ ln(1 − n/N₁) + N₂ ln(1 − n/N₂),

where Z sums over all one-to-one hypotheses, and the rest is the probability of N₁ and N₂ records, of a Poisson field,
up to a constant. So nothing is certain that only one of the errors says.
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
from sameas.space import Sphere, ball_volume


@dataclass(frozen=True)
class GridTuning:
    """The grid of error scales and floors, and what is believed of them beforehand.

    Attributes
    ----------
    crowd : candidates of a record of the poorer source that are there by chance within the widest radius.
    reach : the widest radius, in the error of a floor that is thought of.
    enough, cell : from this number of records of both sources on, cells with so many of the poorer are drawn until they
        hold enough.
    seed : of the generator that draws them.
    log_factor : mean and standard deviation of ln a: formal errors are usually too small (chosen).
    log_floor : the same of ln of f over the typical quoted error of a pair (chosen).
    no_floor : prior probability that there is none (chosen).
    factors : least and largest a; 1 is one of the steps between. factor_step, floor_step : of ln a and ln f.
    tail : share of the pairs whose errors are so many times larger than those of the others (chosen): so an outlier is
        not taken for a floor of all.
    shares : of the poorer source in common, each as probable as the others.
    negligible : points of less weight are left out.
    points : the steps are halved, at most ``halvings`` times, until so many points are left. most_points : at most.
    many : with so many common objects or more the likeliest errors are taken, with fewer the average.
    """

    crowd: float = 3.0
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
    negligible: float = 1e-3
    points: int = 16
    halvings: int = 4
    most_points: int = 48
    many: float = 300.0


DEFAULT_GRID = GridTuning()


def _floors(errors: tuple[Errors, ...]) -> FloatArray:
    """(k, 1) or (k, d) floors; where some are one number and others one per axis, the number stands for every axis."""
    axes = max(np.size(one.floor) for one in errors)
    return np.array([np.broadcast_to(one.floor, (axes,)) for one in errors])


@dataclass(frozen=True)
class ErrorAverage:
    """Errors that few pairs leave open: (k,) of them, with ln of their prior probabilities (k,).

    limit : Δᵀ S⁻¹ Δ of a gate that holds all pairs, by any of them.
    """

    errors: tuple[Errors, ...]
    log_prior: FloatArray
    limit: float

    def candidates(self, first: Records, second: Records) -> Pairs:
        """All candidates that are so near by any of the errors, with distances by the quoted ones."""
        floors = _floors(self.errors)
        factor = max(errors.factor_1 for errors in self.errors)
        widest = Errors(factor_1=factor, factor_2=factor, floor=_floor(floors.max(axis=0)))
        pairs = Radius(math.sqrt(self.limit))(*widest.records(first, second)).of(first, second)
        near = np.zeros(len(pairs), np.bool_)
        for errors in self.errors:
            near |= errors.pairs(pairs).mahalanobis_sq <= self.limit
        return replace(
            pairs.part(near), gate=f"distance ≤ {math.sqrt(self.limit):.2f} σ by any of {len(floors)} errors"
        )

    def log_densities(self, pairs: Pairs) -> FloatArray:
        """(k, m) ln of the densities of the residuals; −∞ beyond the gate."""
        out = np.full((len(self.errors), len(pairs)), -np.inf)
        for row, errors in zip(out, self.errors, strict=True):
            modelled = errors.pairs(pairs)
            near = modelled.mahalanobis_sq <= self.limit
            row[near] = modelled.log_peak[near] + errors.log_profile(modelled.mahalanobis_sq[near], pairs.d)
        return out

    def left_open(self, weight: FloatArray) -> LeftOpen:
        """Ranges of what they are, weighted (k,)."""
        factors = np.array([errors.factor_1 for errors in self.errors])
        floors = np.array([np.max(errors.floor) for errors in self.errors])
        return LeftOpen(_range(factors, weight), _range(floors, weight))

    def typical(self, weight: FloatArray) -> Errors:
        """Errors whose variances are the mean of all, weighted (k,)."""
        factor = math.sqrt(sum(w * e.factor_1**2 for w, e in zip(weight, self.errors, strict=True)))
        floors = _floors(self.errors)
        floor = np.sqrt(weight @ floors**2)
        return replace(self.errors[0], factor_1=factor, factor_2=factor, floor=_floor(floor))


@dataclass(frozen=True)
class LeftOpen:
    """What few pairs leave open of the errors: ranges that hold 95 % of the posterior.

    factors : (least, most) factor on the quoted errors. floors : the same of the floor, in the unit of the residuals.
    """

    factors: tuple[float, float]
    floors: tuple[float, float]


def _range(values: FloatArray, weight: FloatArray) -> tuple[float, float]:
    order = np.argsort(values)
    passed = np.cumsum(weight[order])
    low, high = (values[order[min(int(np.searchsorted(passed, q)), len(order) - 1)]] for q in (0.025, 0.975))
    return float(low), float(high)


@dataclass(frozen=True)
class ErrorScan:
    """What the candidates within a wide radius say of the errors.

    pairs : these candidates, by the quoted errors. errors, log_prior : the points (k,) that are not ruled out.
    weight : (k,) their posterior weights. common : expected number of common objects.
    contrast : ln of the greatest likelihood over that of nothing in common. gain : over the greatest where errors are
    about as quoted.
    """

    pairs: Pairs
    errors: tuple[Errors, ...]
    log_prior: FloatArray
    weight: FloatArray
    common: float
    contrast: float
    gain: float

    @property
    def likeliest(self) -> Errors:
        """The point of greatest weight, without a tail."""
        return self.errors[int(np.argmax(self.weight))].with_mixture(Errors())

    def average(self, d: int) -> ErrorAverage:
        """All points."""
        # Twice the error of the tail is as improbable as the gate's own border.
        reach = max(0.5 * max(self.errors[0].scales), 1.0)
        return ErrorAverage(self.errors, self.log_prior, ChiSquare().limit(d) * reach**2)


def scan_errors(
    coverage: Coverage, density: tuple[float, float] | None = None, tuning: GridTuning = DEFAULT_GRID
) -> ErrorScan | None:
    """What candidates say of the errors; None where they can say nothing.

    That is where records stand so close that the quoted errors cannot be widened, and where no record of one source
    lies in the field of the other: densities there are those of empty sky, by which all would be candidates of all.

    Parameters
    ----------
    density : (ρ₁, ρ₂) of all records of each source, where the user gave them.
    """
    if not all(covered.any() for covered in coverage.covered):
        return None
    unit = _typical(coverage)
    part = _part(coverage, tuning)
    if part is None:
        return None
    rows_1, rows_2 = part
    first, second = coverage.first, coverage.second
    if len(rows_1) < len(first) or len(rows_2) < len(second):
        first, second = first.part(rows_1), second.part(rows_2)
    d = first.d
    richer = max(_mean_densities(coverage, density))
    # In units of the typical error, in which a floor is the same along every axis.
    widest = (tuning.crowd / (ball_volume(d) * richer * float(np.prod(unit)))) ** (1.0 / d)
    if widest < math.sqrt(ChiSquare().limit(d)):
        return None
    wide = Errors(factor_1=1e-6, factor_2=1e-6, floor=_floor(widest / tuning.reach * unit))
    pairs = Radius(tuning.reach)(*wide.records(first, second)).of(first, second)
    return _weighed(pairs, coverage, (rows_1, rows_2), unit, widest, density, tuning)


def _weighed(
    pairs: Pairs,
    coverage: Coverage,
    rows: tuple[IntArray, IntArray],
    unit: FloatArray,
    widest: float,
    density: tuple[float, float] | None,
    tuning: GridTuning,
) -> ErrorScan:
    """The grid over these candidates, of some rows of both sources."""
    # Records of the poorer source are asked, each for its candidates.
    n1, n2 = len(rows[0]), len(rows[1])
    asking, at = (0, pairs.i) if n1 <= n2 else (1, pairs.j)
    seen = coverage.covered[asking][rows[asking]]
    other = 1 - asking
    if density is None:
        richness = coverage.covered_densities[other][asking][rows[asking]]
    else:
        richness = np.full(len(rows[asking]), density[other])
    spread = _Spread.of(pairs, unit, np.log(richness)[at])
    lattice = _Lattice.over(spread, widest, tuning)
    total = float(np.count_nonzero(coverage.covered[asking]))
    gain = contrast = math.nan
    while True:
        sums = spread.sums(lattice, at, len(seen))
        log_likelihood = np.array([_log_likelihood(each[seen], tuning) for each in sums])
        if not lattice.halved:
            gain = float(log_likelihood.max() - log_likelihood[lattice.as_quoted].max())
            contrast = float(log_likelihood.max())
        log_weight = lattice.log_prior + np.logaddexp.reduce(log_likelihood, axis=1)
        weight = np.exp(log_weight - log_weight.max())
        kept = weight > tuning.negligible * weight.sum()
        kept &= weight >= np.sort(weight)[-min(tuning.most_points, len(weight))]
        share = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))[kept]
        lattice, weight = lattice.only(kept), weight[kept] / weight[kept].sum()
        common = total * float(weight @ (share @ np.array(tuning.shares) / share.sum(axis=1)))
        enough = len(weight) >= tuning.points or common > tuning.many
        if enough or lattice.halved >= tuning.halvings:
            return ErrorScan(pairs, lattice.errors(unit), lattice.log_prior, weight, common, contrast, gain)
        lattice = lattice.finer()


def _log_likelihood(sums: FloatArray, tuning: GridTuning) -> FloatArray:
    """(c,) ln of the likelihood of the records with these Σ N/ρ (n,), by share in common."""
    return np.asarray(np.log1p(np.multiply.outer(tuning.shares, sums - 1.0)).sum(axis=1))


def _typical(coverage: Coverage) -> FloatArray:
    """(d,) typical error of a pair along every axis, in the unit of the residuals; on the sphere one for both."""
    both = [np.median(records.variances, axis=0) for records in (coverage.first, coverage.second)]
    variance = np.broadcast_to(both[0] + both[1], coverage.first.d)
    if isinstance(coverage.first.space, Sphere):
        variance = np.full(2, variance.mean())
    return np.sqrt(variance)


def _floor(floor: FloatArray) -> float | tuple[float, ...]:
    """One number where that of all axes is the same."""
    return float(floor[0]) if np.all(floor == floor[0]) else tuple(floor.tolist())


def _mean_densities(coverage: Coverage, density: tuple[float, float] | None) -> tuple[float, float]:
    if density is not None:
        return density
    one, two = coverage.covered_densities
    return float(one[1].mean()), float(two[0].mean())


def _part(coverage: Coverage, tuning: GridTuning) -> tuple[IntArray, IntArray] | None:
    """Rows of both sources that are looked at: all, or those of some cells."""
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
class _Spread:
    """Candidates along the axes of their quoted covariance, in units of the typical error.

    variance, square : (d, m) of the quoted error, and of the residual. log_unit : (m,) ln of density per record of the
    other source, in that unit.
    """

    variance: FloatArray
    square: FloatArray
    log_unit: FloatArray

    @classmethod
    def of(cls, pairs: Pairs, unit: FloatArray, log_density: FloatArray) -> _Spread:
        scaled = pairs.covariance / (unit[:, None] * unit)
        variance, axes = np.linalg.eigh(scaled)
        along = np.einsum("mvw,mv->wm", axes, pairs.residual / unit)
        return cls(
            variance.T.copy(),
            along**2,
            -log_density - float(np.log(unit).sum()) - 0.5 * len(unit) * math.log(2 * math.pi),
        )

    def sums(self, lattice: _Lattice, at: IntArray | Int32Array, n: int) -> list[FloatArray]:
        """Per point of the lattice (n,) Σ N/ρ over the candidates of every record."""
        found: list[FloatArray] = []
        (share, scale), d = lattice.tuning.tail, len(self.square)
        for factor, floor in zip(lattice.factor, lattice.floor, strict=True):
            variance = factor**2 * self.variance + floor**2
            half, peak = -0.5 * (self.square / variance).sum(axis=0), self.log_unit - 0.5 * np.log(variance).sum(axis=0)
            profile = (1.0 - share) * np.exp(half) + share / scale**d * np.exp(half / scale**2)
            found.append(np.asarray(np.bincount(at, np.exp(peak) * profile, n), np.float64))
        return found


@dataclass(frozen=True)
class _Lattice:
    """Points (k,) that stand ``across`` steps of ln a above the least factor, and ``up`` steps of ln f above the least
    floor that is told from none; ``none`` where there is no floor.

    lowest, highest : least floor, and the most steps above it before any was halved. halved : how often they were.
    """

    across: IntArray
    up: IntArray
    none: BoolArray
    lowest: float
    highest: int
    halved: int
    tuning: GridTuning

    @classmethod
    def over(cls, spread: _Spread, widest: float, tuning: GridTuning) -> _Lattice:
        """All factors, and floors from a part of the least quoted errors to a part of the widest radius."""
        low, high = (math.log(value) for value in tuning.factors)
        least = 0.3 * math.sqrt(float(np.quantile(spread.variance, 0.05))) if spread.variance.size else 0.3
        most = max(int(math.log(widest / 3.0 / least) / tuning.floor_step), 1)
        grids = np.meshgrid(np.arange(int((high - low) / tuning.factor_step) + 1), np.arange(-1, most + 1))
        across, up = (np.asarray(grid.ravel(), np.int64) for grid in grids)
        return cls(across, np.maximum(up, 0), up < 0, least, most, 0, tuning)

    @property
    def factor(self) -> FloatArray:
        """(k,) a."""
        return np.asarray(self.tuning.factors[0] * np.exp(self.across * self.tuning.factor_step / 2**self.halved))

    @property
    def floor(self) -> FloatArray:
        """(k,) f, in units of the typical error."""
        return np.where(self.none, 0.0, self.lowest * np.exp(self.up * self.tuning.floor_step / 2**self.halved))

    @property
    def as_quoted(self) -> BoolArray:
        """(k,) points of about the quoted errors: the two factors next to 1, without a floor."""
        off = np.abs(np.log(self.factor))
        return self.none & (off < self.tuning.factor_step)

    def only(self, kept: BoolArray) -> _Lattice:
        """Some of the points."""
        return replace(self, across=self.across[kept], up=self.up[kept], none=self.none[kept])

    def finer(self) -> _Lattice:
        """Half the steps, about all points."""
        across = np.concatenate([2 * self.across + a for a in (-1, 0, 1) for _ in range(3)])
        up = np.concatenate([2 * self.up + f for _ in range(3) for f in (-1, 0, 1)])
        none = np.tile(self.none, 9)
        up[none] = 0
        halved = self.halved + 1
        inside = (up >= 0) & (up <= self.highest * 2**halved) & (across >= 0)
        points = np.unique(np.column_stack([none, across, up])[inside], axis=0)
        return replace(self, across=points[:, 1], up=points[:, 2], none=points[:, 0] > 0, halved=halved)

    @property
    def log_prior(self) -> FloatArray:
        """(k,) ln of the prior probability of the cell around every point, up to a constant of all."""
        tuning = self.tuning
        mean, sigma = tuning.log_factor
        of_factor = -0.5 * ((np.log(self.factor) - mean) / sigma) ** 2
        mean, sigma = tuning.log_floor
        cell = tuning.floor_step / 2**self.halved / (sigma * math.sqrt(2.0 * math.pi))
        log_floor = math.log(self.lowest) + self.up * tuning.floor_step / 2**self.halved
        density = -0.5 * ((log_floor - mean) / sigma) ** 2
        with_floor = math.log((1.0 - tuning.no_floor) * cell) + density
        return np.asarray(of_factor + np.where(self.none, math.log(tuning.no_floor), with_floor))

    def errors(self, unit: FloatArray) -> tuple[Errors, ...]:
        """The points as errors, in the unit of the residuals."""
        share, scale = self.tuning.tail
        mixture = Errors((1.0, scale), (1.0 - share, share)) if share > 0.0 else Errors()
        return tuple(
            replace(mixture, factor_1=float(a), factor_2=float(a), floor=_floor(f * unit))
            for a, f in zip(self.factor, self.floor, strict=True)
        )


#: Pairs of smaller ln of the odds, before one-to-one, are as good as impossible (chosen; less than rounding).
IMPOSSIBLE = math.log(1e-12)
#: From here on one minus a probability has lost its digits; what the odds say stands for it.
SURE = 1e-9

Solver = Callable[..., Posterior]


@dataclass(frozen=True)
class Average:
    """Errors (k,) that are left open, for one list of candidates.

    average : the errors and their prior. log_density : (k, m) ln of the density of the residuals. weight : (k,)
    posterior. numbers : (k,) expected number of common objects by each.
    """

    average: ErrorAverage
    log_density: FloatArray
    weight: FloatArray
    numbers: FloatArray

    @classmethod
    def of(cls, average: ErrorAverage, pairs: Pairs, weight: FloatArray, common: float) -> Average:
        """Before the first EM iteration, with weights (k,) from elsewhere."""
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
        seen: tuple[int, int],
        *,
        exact: bool = False,
        companion_log_odds: FloatArray | None = None,
    ) -> tuple[Average, Averaged]:
        """The weights, and the probabilities of the pairs, when all other evidence of these is ``others`` (m,).

        expected : number of common objects that ``others`` let expect. seen : N₁, N₂, records that may be common.
        exact : whether groups are summed exactly; else by messages.
        beside : (m,) ln of the odds of pairs to be companions, before one-to-one.
        """
        solver: Solver = posterior if exact else by_messages
        p_pairs, log_weight, numbers = [], [], []
        shift = _shift(expected, seen)
        for log_prior, log_density, number in zip(self.average.log_prior, self.log_density, self.numbers, strict=True):
            here = _shift(number, seen)
            solved = Solved.of(pairs, others + log_density + (here.odds - shift.odds), solver, companion_log_odds)
            p_pairs.append(solved.p_pair)
            log_weight.append(log_prior + solved.log_evidence + here.log_records)
            # A share of which nothing is known before lies between none and all.
            numbers.append((float(solved.p_pair.sum()) + 0.5) / (min(seen) + 1.0) * min(seen))
        weight = np.exp(np.array(log_weight) - max(log_weight))
        weight /= weight.sum()
        odds = others + np.array([_shift(n, seen).odds - shift.odds for n in self.numbers])[:, None]
        averaged = Averaged.of(pairs, np.array(p_pairs), odds + self.log_density, weight)
        return replace(self, weight=weight, numbers=np.array(numbers)), averaged


@dataclass(frozen=True)
class _Shift:
    """What a number of common objects adds to ln of the odds of a pair, and to ln of the probability of the records."""

    odds: float
    log_records: float


def _shift(number: float, seen: tuple[int, int]) -> _Shift:
    number = min(max(number, 1e-3), min(seen) * (1.0 - 1e-6))
    alone = [math.log1p(-number / n) for n in seen]
    records = number + sum(n * log for n, log in zip(seen, alone, strict=True))
    return _Shift(math.log(number) - sum(alone), records)


@dataclass(frozen=True)
class Solved:
    """Sums over all one-to-one hypotheses of one list of candidates.

    p_pair : (m,) probabilities of the pairs to be one object. grouped, best, p_either : the groups of the pairs that
    are not as good as impossible, their most probable hypothesis, and the probabilities by it.
    """

    p_pair: FloatArray
    grouped: Groups
    best: Hypothesis
    p_either: FloatArray

    @classmethod
    def of(
        cls,
        pairs: Pairs,
        log_same: FloatArray,
        solver: Solver,
        companion_log_odds: FloatArray | None = None,
        least: float = IMPOSSIBLE,
    ) -> Solved:
        """By ln of the odds of the pairs (m,), before one-to-one, to be one object, and ``beside``, if any, to be
        companions missed each by the other source, against having nothing to do with each other.

        No pair is more probable than these odds say: those below ``least`` are left out, and at zero.
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
        """ln of the sum over all hypotheses, against that all records are alone."""
        return float(log_evidence(self.grouped, self.best, self.p_either).sum())


@dataclass(frozen=True)
class Averaged:
    """p_pair : (m,) probabilities of the pairs, averaged. log_ratio : (m,) ln of the odds, before one-to-one, by which
    the most probable hypothesis is chosen.

    Weights of pairs that give a group without cycles its probabilities p, and p₀ to be alone, are p (1 − p) / (p₀ p₀').
    """

    p_pair: FloatArray
    log_ratio: FloatArray

    @classmethod
    def one(cls, pairs: Pairs, p_pair: FloatArray, log_ratio: FloatArray) -> Averaged:
        """Of one point, (m,) each."""
        return cls.of(pairs, p_pair[None], log_ratio[None], np.ones(1))

    @classmethod
    def of(cls, pairs: Pairs, p_pairs: FloatArray, log_ratios: FloatArray, weight: FloatArray) -> Averaged:
        """p_pairs, log_ratios : (k, m) by every point. weight : (k,)."""
        p = np.clip(weight @ p_pairs, 0.0, 1.0)
        alone_1, alone_2 = (
            np.maximum(1.0 - np.bincount(at, p, n), 0.0)[at]
            for at, n in ((pairs.i, len(pairs.first)), (pairs.j, len(pairs.second)))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            log_weight = np.log(weight)[:, None]
            log_ratio = np.log(p) + np.log1p(-np.minimum(p, 1.0 - 1e-16)) - np.log(alone_1) - np.log(alone_2)
        least = np.minimum(alone_1, alone_2)
        few = np.logaddexp.reduce(log_weight + log_ratios, axis=0)
        # Of what is as good as certain the odds that any of the points gives count, the least most.
        bounded = np.maximum(log_ratios, IMPOSSIBLE)
        many = -np.logaddexp.reduce(log_weight - bounded, axis=0)
        log_ratio = np.where(p < SURE, few, np.where(least < SURE, many, log_ratio))
        return cls(p, np.maximum(log_ratio, -1e4))


def identify_averaged(
    average: Average | None,
    pairs: Pairs,
    rule: Rule,
    expected: float,
    seen: tuple[int, int],
    companion_log_odds: FloatArray | None = None,
) -> Identification:
    """The identification of these candidates, averaged; ``rule`` gives all evidence, of which the term of the positions
    is replaced, or that of companions where errors are known.

    expected, seen, beside : as in :meth:`Average.posterior`. average : None where errors are known.
    """
    evidence = rule(pairs)
    if average is None:
        changed, rest, log_ratio = "companions", but(evidence, "companions"), evidence.log_ratio
        averaged = Averaged.one(pairs, Solved.of(pairs, log_ratio, posterior, companion_log_odds).p_pair, log_ratio)
    else:
        changed, rest = "position", but_positions(evidence)
        _, averaged = average.posterior(pairs, rest, expected, seen, exact=True, companion_log_odds=companion_log_odds)
    terms = {**evidence.terms, changed: averaged.log_ratio - rest}
    grouped = groups(pairs)
    best = assign(grouped, averaged.log_ratio, PerPair()(grouped.sizes_1, grouped.sizes_2))
    sure = posterior(grouped, best)
    return Identification(
        pairs, grouped, Evidence(terms, evidence.log_error), best, replace(sure, p_pair=averaged.p_pair)
    )


def but_positions(evidence: Evidence) -> FloatArray:
    """(m,) the sum of all terms but that of the positions."""
    return but(evidence, "position")


def but(evidence: Evidence, left_out: str) -> FloatArray:
    """(m,) the sum of all terms but one."""
    return np.asarray(sum(values for name, values in evidence.terms.items() if name != left_out))
