"""Simulated scenes with known truth, and their arrays in a folder that any interpreter can read.

The workload of the speed tables: σ from 0.05″ to 0.5″, log-uniform per record; 80 % of the objects in both sources,
10 % in each alone; λ = mean number of chance candidates of a record within 3σ.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SIGMA_ARCSEC = (0.05, 0.5)
#: Chance candidates of a record on average: an ordinary field, a busy one, crowded, very crowded.
LAMBDAS = (0.05, 0.5, 2.0, 8.0)


@dataclass(frozen=True)
class Densities:
    """True densities of common objects and of records in one source only, 1 / (residual unit)^d."""

    common: float
    only_1: float
    only_2: float

    def rule(self) -> Any:
        """The rule with these densities."""
        from sameas import PoissonField

        return PoissonField(self.common, self.only_1, self.only_2)


def sky_densities(scene: Any, lam: float) -> Densities:
    """The densities of a ``crowded_sky`` scene, per arcsec²."""
    from sameas.simulate.scenes import chance_area_steradians
    from sameas.space import ARCSEC_PER_RADIAN

    n1, n2, common = len(scene.first), len(scene.second), len(scene.true_pairs()[0])
    area = chance_area_steradians(n2, lam, SIGMA_ARCSEC) * ARCSEC_PER_RADIAN**2
    return Densities(common / area, (n1 - common) / area, (n2 - common) / area)


def crowded(seed: int, n: int, lam: float, elliptical: bool = False) -> tuple[Any, Densities]:
    """A scene of the workload and its true densities."""
    from sameas.simulate.scenes import crowded_sky

    scene = crowded_sky(np.random.default_rng(seed), n, lam, elliptical=elliptical)
    return scene, sky_densities(scene, lam)


def frame(seed: int, n_1: int = 2000, n_2: int = 5000, lam: float = 0.5) -> tuple[Any, Densities]:
    """One frame of n₁ detections, 90 % of them among the n₂ stars of a catalogue."""
    from sameas.simulate.scenes import Cap, chance_area_steradians, sky_field
    from sameas.space import ARCSEC_PER_RADIAN

    steradians = chance_area_steradians(n_2, lam, SIGMA_ARCSEC)
    radius_deg = math.degrees(2 * math.asin(math.sqrt(steradians / (4 * math.pi))))
    common = round(0.9 * n_1)
    scene = sky_field(
        np.random.default_rng(seed), n_common=common, n_only_1=n_1 - common, n_only_2=n_2 - common,
        sigma_arcsec=SIGMA_ARCSEC, area=Cap(150.0, 40.0, radius_deg),
    )  # fmt: skip
    area = steradians * ARCSEC_PER_RADIAN**2
    return scene, Densities(common / area, (n_1 - common) / area, (n_2 - common) / area)


def targets(seed: int, n: int, d: int, lam: float = 0.5) -> tuple[Any, Densities]:
    """Two sources of about n targets in d features, σ = 1, each missing a tenth."""
    from sameas.simulate.scenes import poisson_field

    # λ records of the other source within 3σ of the residual.
    ball = math.pi ** (d / 2) / math.gamma(d / 2 + 1) * (3.0 * math.sqrt(2.0)) ** d
    q = 0.1
    density = lam / ball / (1 - q)
    extent = (n / density / (1 - q)) ** (1 / d)
    scene = poisson_field(
        np.random.default_rng(seed), density=density, extent=(extent,) * d, q1=q, q2=q, sigma_1=1.0, sigma_2=1.0
    )
    return scene, Densities(density * (1 - q) ** 2, density * (1 - q) * q, density * q * (1 - q))


def widened(seed: int, scene: Any, share: float = 1e-3, factor: float = 40.0) -> Any:
    """The scene with errors ``factor`` times as large, quoted and real, in a ``share`` of either source's records."""
    from dataclasses import replace

    from sameas import Records
    from sameas.space import displaced

    rng = np.random.default_rng(seed)
    sources = []
    for records in (scene.first, scene.second):
        sigma = np.sqrt(records.covariance[:, 0])
        wide = rng.uniform(size=len(records)) < share
        more = np.where(wide, sigma * math.sqrt(factor**2 - 1.0), 0.0)
        moved = displaced(records.features, rng.standard_normal(records.features.shape) * more[:, None])
        features = np.where(wide[:, None], moved, records.features)
        sigma = np.where(wide, factor * sigma, sigma)
        sources.append(Records.of(features, sigma=sigma[:, None], space=records.space, source=records.source))
    return replace(scene, first=sources[0], second=sources[1])


# ---- arrays in a folder ----


@dataclass(frozen=True)
class Arrays:
    """Two sources as plain arrays: features (n, d); sigma (n,) or covariance (n, d, d); the true densities."""

    folder: Path
    features: tuple[np.ndarray, np.ndarray]
    errors: tuple[np.ndarray, np.ndarray]
    sphere: bool
    densities: Densities

    @classmethod
    def load(cls, folder: str | Path) -> Arrays:
        """The arrays that :func:`save` wrote."""
        folder = Path(folder)
        about = json.loads((folder / "about.json").read_text())
        features, errors = (
            tuple(np.load(folder / f"{kind}_{side}.npy") for side in (1, 2)) for kind in ("features", "errors")
        )
        return cls(folder, features, errors, about["sphere"], Densities(**about["densities"]))

    def sigmas(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) one σ per record: the root mean variance of its axes."""
        one, two = (e if e.ndim == 1 else np.sqrt(np.trace(e, axis1=1, axis2=2) / e.shape[-1]) for e in self.errors)
        return one, two

    def directions(self) -> list[np.ndarray]:
        """(n, 3) unit vectors of longitude and latitude, or the features themselves on a plane."""
        if not self.sphere:
            return list(self.features)
        result = []
        for features in self.features:
            lon, lat = np.radians(features).T
            result.append(np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]))
        return result


def save(folder: Path, scene: Any, densities: Densities) -> Path:
    """Write the arrays of both sources to ``folder``."""
    from sameas import Sphere

    folder.mkdir(parents=True, exist_ok=True)
    for side, records in ((1, scene.first), (2, scene.second)):
        full = records.covariance.shape[1] > 1
        errors = records.full_covariance() if full else np.sqrt(records.covariance[:, 0])
        np.save(folder / f"features_{side}.npy", records.features)
        np.save(folder / f"errors_{side}.npy", errors)
    about = {"sphere": isinstance(scene.first.space, Sphere), "densities": vars(densities)}
    (folder / "about.json").write_text(json.dumps(about))
    return folder
