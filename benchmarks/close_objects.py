"""The paper's generalized Gaussian compared with the exact close-objects rule, and the effect of a correlation on it.

``python -m benchmarks.close_objects`` prints both tables, and the time of each form.
"""

from __future__ import annotations

import time

import numpy as np

from sameas.evidence import log_neighbour_density
from sameas.evidence.close import log_correlated_density, log_generalized_density

INNER, SPACINGS, PLACES = 1.1, (1.6, 1.9, 3.0, 6.0), (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0)
CORRELATIONS = (0.0, 0.3, 0.6, 0.9, 0.99)


def approximation_error(delta: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(m,) ln λ of the paper's approximation less that of the exact rule; σ = 1, NaN where its braces are negative."""
    sigma = np.ones_like(delta)
    approximate = log_generalized_density(delta, sigma, a, b)
    difference = log_neighbour_density(delta, sigma, a, b) - approximate
    return np.where(np.isfinite(approximate), difference, np.nan)


def _row(name: str, values: np.ndarray) -> str:
    return f"| {name} | " + " | ".join("—" if np.isnan(value) else f"{value:+.3f}" for value in values) + " |"


def _heading(first: str, what: str) -> list[str]:
    return [f"| {first} | " + " | ".join(f"{what} {x:g} σ" for x in PLACES) + " |", "|---" * (len(PLACES) + 1) + "|"]


def approximation_table() -> list[str]:
    """Error of ln λ for residuals along one feature, a = 1.1 σ and b = 2 d σ; a dash where it is undefined."""
    delta = np.stack([PLACES, np.zeros(len(PLACES))], axis=1)
    lines = _heading("b", "Δ =")
    for d in SPACINGS:
        lines.append(_row(f"{2 * d:g} σ", approximation_error(delta, np.full(2, INNER), np.full(2, 2 * d))))
    return lines


def correlation_table() -> list[str]:
    """ln λ with the correlation less that without it, residuals along the diagonal, b = 2 · 1.9 σ."""
    delta = np.repeat(np.array(PLACES)[:, None], 2, axis=1)
    a, b = np.full(2, INNER), np.full(2, 3.8)
    plain = log_neighbour_density(delta, np.ones_like(delta), a, b)
    lines = _heading("ρ", "Δ₁ = Δ₂ =")
    for rho in CORRELATIONS:
        covariance = np.broadcast_to([[1.0, rho], [rho, 1.0]], (len(delta), 2, 2))
        lines.append(_row(f"{rho:g}", plain - log_correlated_density(delta, covariance, a, b)))
    return lines


def times(m: int = 100_000) -> list[str]:
    """Seconds for m pairs by each form."""
    rng = np.random.default_rng(0)
    delta, root = rng.normal(0, 1.5, (m, 2)), rng.normal(0, 0.5, (m, 2, 2))
    covariance = root @ root.transpose(0, 2, 1) + 0.05 * np.eye(2)
    sigma, a, b = np.sqrt(np.einsum("mvv->mv", covariance)), np.array([0.7, 1.3]), np.array([2.0, 1.9])
    forms = {
        "diagonal": lambda: log_neighbour_density(delta, sigma, a, b),
        "correlated": lambda: log_correlated_density(delta, covariance, a, b),
        "generalized Gaussian": lambda: log_generalized_density(delta, sigma, a, b),
    }
    lines = []
    for name, form in forms.items():
        start = time.perf_counter()
        form()
        lines.append(f"{name}: {time.perf_counter() - start:.2f} s for {m} pairs")
    return lines


def main() -> None:
    for table in (approximation_table, correlation_table, times):
        print((table.__doc__ or "").strip(), *table(), "", sep="\n")


if __name__ == "__main__":
    main()
