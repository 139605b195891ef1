"""The timed calls of `sameas`, as tasks for ``worker.py``. The only module here that calls the stages one by one."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.workload import Arrays
from sameas import CommonObjects, Field, PerPair, Plane, Radius, Records, Sphere, identify
from sameas.assignment import assign
from sameas.gate import ChiSquare
from sameas.groups import groups
from sameas.kernels import compiled
from sameas.posterior import METHODS, posterior

STAGES = ("prepare", "gate", "groups", "evidence", "assignment", "posterior", "result")

# Time the compiled path from the first call.
compiled.compile_all()


def records(arrays: Arrays) -> tuple[Records, Records]:
    """Records of both sources from plain arrays."""
    space = Sphere() if arrays.sphere else Plane()

    def source(name: str, features: np.ndarray, errors: np.ndarray) -> Records:
        if errors.ndim == 1:
            return Records.of(features, sigma=errors[:, None], space=space, source=name)
        return Records.of(features, covariance=errors, space=space, source=name)

    (features_1, features_2), (errors_1, errors_2) = arrays.features, arrays.errors
    return source("first", features_1, errors_1), source("second", features_2, errors_2)


def gate_of(sigmas: float | None) -> Radius | ChiSquare:
    """A gate of this radius in σ; the default gate for None."""
    return ChiSquare() if sigmas is None else Radius(sigmas)


def stages(folder: str, until: str = "posterior", gate_sigmas: float | None = 3.0) -> Callable[[], dict[str, Any]]:
    """From arrays to pairs as in ``identify``, up to "assignment" or "posterior"; returns the seconds of each stage."""
    arrays = Arrays.load(folder)
    rule, prior, gate = arrays.densities.rule(), PerPair(), gate_of(gate_sigmas)

    def work() -> dict[str, Any]:
        seconds: dict[str, float] = {}
        last = time.perf_counter()

        def lap(stage: str) -> None:
            nonlocal last
            now = time.perf_counter()
            seconds[stage], last = now - last, now

        first, second = records(arrays)
        lap("prepare")
        pairs = gate(first, second)
        lap("gate")
        grouped = groups(pairs)
        lap("groups")
        log_ratio = rule(pairs).log_ratio
        lap("evidence")
        best = assign(grouped, log_ratio, prior(grouped.sizes_1, grouped.sizes_2))
        lap("assignment")
        if until == "posterior":
            posterior(grouped, best)
            lap("posterior")
        at = grouped.order[best.chosen]
        rows_1, _ = pairs.i[at], pairs.j[at]
        lap("result")
        return {"stages": seconds, "pairs": len(rows_1), "candidates": len(pairs)}

    return work


def whole_call(folder: str, gate_sigmas: float | None = 3.0) -> Callable[[], int]:
    """A user's whole call: records, ``identify``, the pairs with their probabilities."""
    arrays = Arrays.load(folder)
    rule, gate = arrays.densities.rule(), gate_of(gate_sigmas)

    def work() -> int:
        answer = identify(*records(arrays), rule=rule, gate=gate)
        at = answer.groups.order[answer.best.chosen]
        return len(answer.p_pair[at])

    return work


def certificate(folder: str, gate_sigmas: float | None = 3.0) -> Callable[[], dict[str, Any]]:
    """Not timed: certificate of the assignment, size of the largest group, shares of the posterior methods."""
    arrays = Arrays.load(folder)

    def work() -> dict[str, Any]:
        answer = identify(*records(arrays), rule=arrays.densities.rule(), gate=gate_of(gate_sigmas), certify=True)
        proof = answer.best.certificate(answer.groups)
        by_method = np.bincount(answer.posterior.method, answer.groups.pair_counts, len(METHODS))
        share = by_method / max(len(answer.pairs), 1)
        return {
            "least_reduced_cost": proof.least_reduced_cost, "duality_gap": proof.duality_gap,
            "candidates": len(answer.pairs),
            "largest": answer.groups.statistics()["records in the largest"], "shares": share.tolist(),
        }  # fmt: skip

    work.warm = False  # type: ignore[attr-defined]
    return work


def full_group(n: int) -> Callable[[], int]:
    """The assignment under the exact prior on the number k of common objects, every k, in one full group of n × n."""
    _, grouped, log_ratio, prior = _full_group(n)
    return lambda: int(assign(grouped, log_ratio, prior).chosen.sum())


def linear_sum_assignment(n: int) -> Callable[[], int]:
    """SciPy's assignment on the same weights, for one k."""
    from scipy.optimize import linear_sum_assignment as solve

    pairs, _, log_ratio, _ = _full_group(n)
    cost = np.empty((n, n))
    cost[pairs.i, pairs.j] = -log_ratio
    return lambda: len(solve(cost)[0])


def _full_group(n: int) -> tuple[Any, Any, np.ndarray, Any]:
    rng = np.random.default_rng(7)
    position = rng.uniform(0.0, np.sqrt(n), (n, 2))
    measured = [position + 0.3 * rng.standard_normal((n, 2)) for _ in range(2)]
    pairs = Radius(1e6)(*(Records.of(x, sigma=0.3, source=f"source {k}") for k, x in enumerate(measured, start=1)))
    grouped = groups(pairs)
    return (pairs, grouped, Field(1.0 / n)(pairs).log_ratio, CommonObjects(0.1, 0.2)(grouped.sizes_1, grouped.sizes_2))
