"""Expectations over normals, with a stated error: adaptive cubature up to two dimensions, quasi-Monte-Carlo above.

Cubature sees jumps of a density badly, and may not see that it does: it is believed where it settles at once and
agrees with scrambled Sobol points, which take its place elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sameas.errors import InputError
from sameas.records import FloatArray

#: Takes pairs (r,) and standard normal points (n, k), gives the values (r, n) there.
Integrand = Callable[[NDArray[np.int64], FloatArray], FloatArray]

#: Adaptive cubature looks this many standard deviations around; what lies beyond is a share of 2e-17.
REACH = 8.5
SUBDIVISIONS = 40
#: Quasi-Monte-Carlo: independent scrambles, points of each at first and at most, values held at a time.
SCRAMBLES = 16
FIRST, CHECK, MOST = 2**8, 2**10, 2**13
AT_ONCE = 2**18


@dataclass(frozen=True)
class Expected:
    """(m,) ln of the expectations, and (m,) their relative standard errors; infinite where ``log_value`` is a bound."""

    log_value: FloatArray
    error: FloatArray


def expectation(integrand: Integrand, pairs: int, k: int, wanted: float, seed: int, what: str) -> Expected:
    """E f(z), z ~ N(0, 1)^k, for every pair, to a relative error of ``wanted`` where that can be had.

    Raises
    ------
    InputError : the values are negative or not finite, or zero around every pair.
    """
    _require_scipy()
    f, rows = _Checked(integrand, what), np.arange(pairs)
    if k > 2:
        value, error, bound = _scrambled(f, rows, k, wanted, seed, MOST)
    else:
        value, error, believed = _adaptive(f, pairs, k, wanted)
        bound = k * math.erfc(REACH / math.sqrt(2.0))
        seen, seen_error, unseen = _scrambled(f, rows, k, wanted, seed, CHECK)
        hit = seen > 0.0
        spread = np.multiply(seen, seen_error, out=np.zeros(pairs), where=hit)
        allowed = 5.0 * spread + error * value + 10.0 * f.largest * unseen
        rows = rows[hit & (~believed | (np.abs(value - seen) > allowed))]
        if len(rows):
            value[rows], error[rows], _ = _scrambled(f, rows, k, wanted, seed, MOST)
    nothing = value <= 0.0
    if np.any(nothing):
        if f.largest <= 0.0:
            raise InputError(f"Universal: {what} is zero around every pair; give a density that covers the records")
        # All that is known is that it is less than the largest value met, times what was not looked at.
        value, error = np.where(nothing, f.largest * bound, value), np.where(nothing, np.inf, error)
    return Expected(np.log(value), error)


@dataclass
class _Checked:
    """The integrand, refused where it gives no densities; remembers the largest value met."""

    integrand: Integrand
    what: str
    largest: float = 0.0

    def __call__(self, rows: NDArray[np.int64], points: FloatArray) -> FloatArray:
        values = np.asarray(self.integrand(rows, points), np.float64)
        if not np.all((values >= 0.0) & (values < np.inf)):
            raise InputError(f"Universal: {self.what} is negative or not finite; give densities of zero or more")
        self.largest = max(self.largest, float(values.max(initial=0.0)))
        return values


def _adaptive(f: _Checked, pairs: int, k: int, wanted: float) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """(m,) values, relative errors, and whether they settled: Gauss–Kronrod cubature pair by pair."""
    from scipy.integrate import cubature

    value, error, settled = np.zeros(pairs), np.zeros(pairs), np.zeros(pairs, np.bool_)
    for row in range(pairs):
        one = np.array([row])

        def weighted(z: FloatArray, one: NDArray[np.int64] = one) -> FloatArray:
            log_weight = -0.5 * (np.sum(z**2, axis=1) + k * math.log(2.0 * math.pi))
            return np.asarray(f(one, z)[0] * np.exp(log_weight))

        found = cubature(
            weighted, np.full(k, -REACH), np.full(k, REACH), rule="gk15", rtol=wanted, points=[np.zeros(k)],
            max_subdivisions=SUBDIVISIONS,
        )  # fmt: skip
        value[row], settled[row] = found.estimate, found.status == "converged"
        error[row] = found.error / found.estimate if found.estimate > 0.0 else 0.0
    return value, error, settled


def _scrambled(
    f: _Checked, rows: NDArray[np.int64], k: int, wanted: float, seed: int, most: int
) -> tuple[FloatArray, FloatArray, float]:
    """Values and relative errors of some pairs, and the share that no point stands for: scrambled Sobol points.

    They are doubled, up to ``most`` of each scramble, for the pairs that need it; the error is that among scrambles.
    """
    from scipy.special import ndtri
    from scipy.stats import qmc

    engines = [qmc.Sobol(k, scramble=True, rng=stream) for stream in np.random.default_rng(seed).spawn(SCRAMBLES)]
    total, drawn, error = np.zeros((SCRAMBLES, len(rows))), np.zeros(len(rows), np.int64), np.full(len(rows), np.inf)
    going, n = np.arange(len(rows)), FIRST
    while len(going) and drawn.max() < most:
        for at, engine in enumerate(engines):
            # A scramble may round to 0, which no normal has.
            points = ndtri(np.clip(engine.random(n), 1e-16, 1.0 - 1e-16))
            for begin in range(0, len(going), max(1, AT_ONCE // n)):
                some = going[begin : begin + max(1, AT_ONCE // n)]
                total[at, some] += f(rows[some], points).sum(axis=1)
        drawn[going] += n
        mean = total[:, going] / drawn[going]
        spread, middle = mean.std(axis=0, ddof=1) / math.sqrt(SCRAMBLES), mean.mean(axis=0)
        error[going] = np.divide(spread, middle, out=np.full(len(going), np.inf), where=middle > 0.0)
        going, n = going[error[going] > wanted], int(drawn.max())
    return total.mean(axis=0) / drawn, error, 1.0 / (SCRAMBLES * int(drawn.max(initial=1)))


def _require_scipy() -> None:
    import scipy.integrate

    if not hasattr(scipy.integrate, "cubature"):
        raise InputError("Universal: densities that are functions need SciPy 1.15 or later: pip install 'scipy>=1.15'")
