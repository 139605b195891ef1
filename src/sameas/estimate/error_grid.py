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

A share of the pairs has a tail of larger errors; without it, an outlier would imply a floor of all. With many pairs,
estimation starts from the best point. With few, ``error_average.py`` averages over the points that are not ruled out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.estimate.cells import finest
from sameas.estimate.coverage import Coverage
from sameas.estimate.error_average import ErrorAverage, floor_of_axes
from sameas.evidence import Errors
from sameas.gate import ChiSquare, Pairs, Radius
from sameas.space import ball_volume

CHANCE_CANDIDATES = 3.0  # of a record of the poorer source, within the widest radius
#: The same where that radius is shorter than the gate by the quoted errors: the radius is then extended as far as this,
#: if neither source has more than twice ENOUGH_PAIRS records.
CROWDED_CANDIDATES = 40.0
REACH = 5.0  # the widest radius, in standard deviations of the largest floor
#: A gate of averaged errors has at most this many chance candidates, or this radius in standard deviations.
GATE_CANDIDATES, MIN_GATE = 20.0, 3.5
#: With more records than this in both sources, cells with this many records of the poorer source are sampled until they
#: hold enough.
ENOUGH_PAIRS, CELL = 600, 150
SEED = 20_041  # of the generator that draws them
LOG_FACTOR = (math.log(1.2), 0.6)  # mean and standard deviation of ln a: formal errors are usually too small (chosen)
LOG_FLOOR = (0.0, 1.5)  # the same of ln f, with f relative to the typical quoted error of a pair (chosen)
NO_FLOOR = 0.3  # prior probability of no floor (chosen)
FACTORS = (math.exp(-5 * 0.36), 32.0)  # least and greatest a; 1 is one of the steps between
FACTOR_STEP, FLOOR_STEP = 0.36, 0.5  # of ln a and ln f
TAIL_SCALES = (3.0, 6.0)  # errors of the pairs in a tail, relative to those of the others; equal shares of it have each
TAIL_SHARES = (0.0, 0.03, 0.1, 0.25)  # of the pairs in the tail
LOG_TAIL_PRIOR = tuple(map(math.log, (0.35, 0.25, 0.25, 0.15)))  # ln of their prior probabilities (chosen)
SHARES = (0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97)  # of the poorer source in common, equally probable
MIN_WEIGHT = 1e-3  # points of a smaller weight are dropped
MIN_POINTS, MAX_POINTS = 16, 64  # the steps are halved, at most HALVINGS times, until MIN_POINTS are left
HALVINGS = 4
MAX_AVERAGED = 300.0  # number of common objects from which the best errors are used instead of the average


@dataclass(frozen=True)
class ErrorScan:
    """Posterior of the errors from the candidates within a wide radius.

    pairs : these candidates, by the quoted errors. errors, log_prior : the k points that are not ruled out.
    weight : (k,) their posterior weights. common : expected number of common objects.
    chance : (k,) chance candidates of a record within one standard deviation by each.
    contrast : gain in ln likelihood over no common objects. gain : over errors about as quoted.
    """

    pairs: Pairs
    errors: tuple[Errors, ...]
    log_prior: FloatArray
    weight: FloatArray
    chance: FloatArray
    common: float
    contrast: float
    gain: float

    @property
    def best(self) -> Errors:
        """The factor and floor of largest weight, whatever the tail."""
        plain = [errors.with_mixture(Errors()) for errors in self.errors]
        weight: dict[tuple[float, str], float] = {}
        keys = [(errors.factor_1, str(errors.floor)) for errors in plain]
        for key, of_point in zip(keys, self.weight.tolist(), strict=True):
            weight[key] = weight.get(key, 0.0) + of_point
        return plain[keys.index(max(weight, key=lambda key: weight[key]))]

    def average(self, d: int) -> ErrorAverage:
        """All points, each with a gate for its tail as far as chance candidates allow."""
        # Half the usual gate in units of the tail's error: few pairs of the small tail lie beyond.
        reach = np.array([max(0.5 * max(errors.scales), 1.0) for errors in self.errors])
        affordable = (GATE_CANDIDATES / self.chance) ** (2.0 / d)
        usual = ChiSquare().limit(d)
        limits = np.minimum(usual * reach**2, np.maximum(affordable, min(MIN_GATE**2, usual)))
        return ErrorAverage(self.errors, self.log_prior, limits)


def scan_errors(coverage: Coverage, density: tuple[float, float] | None = None) -> ErrorScan | None:
    """The posterior of the errors; None where candidates cannot determine them.

    That is where records lie so close that quoted errors cannot be enlarged, and where no record of one source lies in
    the field of the other: with densities of an empty sky, all records would be candidates of all.

    density : (ρ₁, ρ₂) of all records of each source, if given by the user.
    """
    if not all(covered.any() for covered in coverage.covered):
        return None
    unit = coverage.typical_error
    rows = _sampled_rows(coverage)
    if rows is None:
        return None
    rows_1, rows_2 = rows
    first, second = coverage.first, coverage.second
    if len(rows_1) < len(first) or len(rows_2) < len(second):
        first, second = first.part(rows_1), second.part(rows_2)
    d = first.d
    richer = max(mean_densities(coverage, density))
    # In units of the typical error; a floor is the same along every axis.
    within_one = ball_volume(d) * richer * float(np.prod(unit))
    widest = (CHANCE_CANDIDATES / within_one) ** (1.0 / d)
    if widest < math.sqrt(ChiSquare().limit(d)):
        widest = (CROWDED_CANDIDATES / within_one) ** (1.0 / d)
        if widest < math.sqrt(ChiSquare().limit(d)) or max(len(first), len(second)) > 2 * ENOUGH_PAIRS:
            return None
    wide = Errors(factor_1=1e-6, factor_2=1e-6, floor=floor_of_axes(widest / REACH * unit))
    pairs = Radius(REACH)(*wide.records(first, second)).of(first, second)
    return _scan(pairs, coverage, (rows_1, rows_2), (unit, within_one), widest, density)


def _scan(
    pairs: Pairs, coverage: Coverage, rows: tuple[IntArray, IntArray], typical: tuple[FloatArray, float],
    widest: float, density: tuple[float, float] | None,
) -> ErrorScan:  # fmt: skip
    """The grid over these candidates, which are those of some rows of both sources.

    typical : error of a pair along the axes, and chance candidates within it.
    """
    unit, within_one = typical
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
    lattice = _Lattice.over(residuals, widest)
    total = float(np.count_nonzero(coverage.covered[poorer]))
    gain = contrast = math.nan
    while True:
        sums = residuals.sums(lattice, at, len(covered))
        # Points of the lattice, shares of the tail, shares in common.
        log_likelihood = np.array([[_log_likelihood(tail[covered]) for tail in each] for each in sums])
        if not lattice.n_halvings:
            gain = float(log_likelihood.max() - log_likelihood[lattice.as_quoted].max())
            contrast = float(log_likelihood.max())
        log_prior = lattice.log_prior[:, None] + np.array(LOG_TAIL_PRIOR)
        log_weight = log_prior + np.logaddexp.reduce(log_likelihood, axis=2)
        weight = np.exp(log_weight - log_weight.max())
        kept = weight > MIN_WEIGHT * weight.sum()
        kept &= weight >= np.sort(weight, axis=None)[-min(MAX_POINTS, weight.size)]
        points, tails = (np.asarray(each, np.int64) for each in np.nonzero(kept))
        share = np.exp(log_likelihood - log_likelihood.max(axis=2, keepdims=True))[kept]
        weight = weight[kept] / weight[kept].sum()
        common = total * float(weight @ (share @ np.array(SHARES) / share.sum(axis=1)))
        of_kept = lattice.part(np.unique(points))
        enough = len(of_kept.factor_index) >= MIN_POINTS or common > MAX_AVERAGED
        if enough or lattice.n_halvings >= HALVINGS:
            errors = lattice.part(points).errors(unit, tails)
            at_points = lattice.part(points)
            chance = within_one * (at_points.factor**2 + at_points.floor**2) ** (0.5 * len(unit))
            return ErrorScan(pairs, errors, log_prior[kept], weight, chance, common, contrast, gain)
        lattice = of_kept.refined()


def _log_likelihood(sums: FloatArray) -> FloatArray:
    """(c,) ln of the likelihood of the records with these Σ N/ρ (n,), by share in common."""
    # Logarithms of products of eight take an eighth of the time; with the limit they neither overflow nor underflow.
    padded = np.ones(-(-len(sums) // 8) * 8)
    padded[: len(sums)] = np.minimum(sums, 1e36)
    factors = 1.0 + np.multiply.outer(SHARES, padded - 1.0)
    return np.asarray(np.log(factors.reshape(len(factors), -1, 8).prod(axis=2)).sum(axis=1))


def mean_densities(coverage: Coverage, density: tuple[float, float] | None) -> tuple[float, float]:
    """Mean density of each source at the records of the other, per volume of the residuals; ``density`` if given."""
    if density is not None:
        return density
    one, two = coverage.covered_densities
    return float(one[1].mean()), float(two[0].mean())


def _sampled_rows(coverage: Coverage) -> tuple[IntArray, IntArray] | None:
    """Rows of both sources that are used: all, or those in sampled cells."""
    n1, n2 = len(coverage.first), len(coverage.second)
    if min(n1, n2) <= 2 * ENOUGH_PAIRS:
        return np.arange(n1), np.arange(n2)
    poorer = 0 if n1 <= n2 else 1
    level = finest(coverage.levels, min(n1, n2) / CELL)
    of = (level.of_first, level.of_second)
    count = np.bincount(of[poorer][coverage.covered[poorer]], minlength=len(level.volume))
    drawn = level.drawn((count,), ENOUGH_PAIRS, SEED)
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
        """(t, n) Σ N/ρ over the candidates of every record by share of the tail, for each point of the lattice."""
        out: list[FloatArray] = []
        scales, d = np.array(TAIL_SCALES), len(self.square)
        shares = np.array(TAIL_SHARES)
        for factor, floor in zip(lattice.factor, lattice.floor, strict=True):
            variance = factor**2 * self.variance + floor**2
            half, peak = -0.5 * (self.square / variance).sum(axis=0), self.log_unit - 0.5 * np.log(variance).sum(axis=0)
            core, tail = np.exp(peak + half), np.zeros(len(half))
            for scale in scales:
                tail += np.exp(peak + half / scale**2) / scale**d / len(scales)
            core, tail = (np.asarray(np.bincount(at, x, n), np.float64) for x in (core, tail))
            out.append((1.0 - shares)[:, None] * core + shares[:, None] * tail)
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

    @classmethod
    def over(cls, residuals: _Residuals, widest: float) -> _Lattice:
        """All factors, and floors from 0.3 of the smallest quoted errors to a third of the widest radius."""
        low, high = (math.log(value) for value in FACTORS)
        min_floor = 0.3 * math.sqrt(float(np.quantile(residuals.variance, 0.05))) if residuals.variance.size else 0.3
        most = max(int(math.log(widest / 3.0 / min_floor) / FLOOR_STEP), 1)
        grids = np.meshgrid(np.arange(int((high - low) / FACTOR_STEP) + 1), np.arange(-1, most + 1))
        factor_index, floor_index = (np.asarray(grid.ravel(), np.int64) for grid in grids)
        return cls(factor_index, np.maximum(floor_index, 0), floor_index < 0, min_floor, most, 0)

    @property
    def factor(self) -> FloatArray:
        """(k,) a."""
        halving = 2**self.n_halvings
        return np.asarray(FACTORS[0] * np.exp(self.factor_index * FACTOR_STEP / halving))

    @property
    def floor(self) -> FloatArray:
        """(k,) f, in units of the typical error."""
        log_step = self.floor_index * FLOOR_STEP / 2**self.n_halvings
        return np.where(self.no_floor, 0.0, self.min_floor * np.exp(log_step))

    @property
    def as_quoted(self) -> BoolArray:
        """(k,) points with about the quoted errors: the two factors next to 1, without a floor."""
        distance = np.abs(np.log(self.factor))
        return self.no_floor & (distance < FACTOR_STEP)

    def part(self, kept: IntArray) -> _Lattice:
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
        mean, sigma = LOG_FACTOR
        of_factor = -0.5 * ((np.log(self.factor) - mean) / sigma) ** 2
        mean, sigma = LOG_FLOOR
        cell = FLOOR_STEP / 2**self.n_halvings / (sigma * math.sqrt(2.0 * math.pi))
        log_floor = math.log(self.min_floor) + self.floor_index * FLOOR_STEP / 2**self.n_halvings
        density = -0.5 * ((log_floor - mean) / sigma) ** 2
        with_floor = math.log((1.0 - NO_FLOOR) * cell) + density
        return np.asarray(of_factor + np.where(self.no_floor, math.log(NO_FLOOR), with_floor))

    def errors(self, unit: FloatArray, tails: IntArray) -> tuple[Errors, ...]:
        """The points as errors, in the unit of the residuals, each with one of the tails (k,)."""
        scales, mixtures = TAIL_SCALES, []
        for share in TAIL_SHARES:
            of_each = (share / len(scales),) * len(scales)
            mixtures.append(Errors((1.0, *scales), (1.0 - share, *of_each)) if share > 0.0 else Errors())
        return tuple(
            replace(mixtures[tail], factor_1=float(a), factor_2=float(a), floor=floor_of_axes(f * unit))
            for a, f, tail in zip(self.factor, self.floor, tails, strict=True)
        )
