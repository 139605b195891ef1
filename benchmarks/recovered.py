"""Estimates against the truth: mean deviation, and coverage of ±1.96 standard errors, by kind of frame."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.exposures import FrameAndCatalogue, Sky, exposure
from benchmarks.misstated import misquoted, with_outliers
from benchmarks.tables import Table
from sameas import PoissonField
from sameas.estimate.match import match
from sameas.estimate.quantity import Quantity
from sameas.estimate.result import Estimate
from sameas.evidence import Magnitudes
from sameas.space import displaced

Change = Callable[[np.random.Generator, FrameAndCatalogue], FrameAndCatalogue]
SPARSE = Sky(stars_per_deg2=5_000.0)
#: A catalogue with negligible position errors, before its stars are displaced.
EXACT = replace(SPARSE, catalogue_sigma_arcsec=(1e-3, 1e-3), gap_yr=0.0)
#: Errors that are not as quoted: of both sources; of the frame, and a floor under the catalogue's, arcsec.
BOTH, FRAME, FLOOR_ARCSEC = 1.7, 1.4, 0.1
#: One error for the whole catalogue, arcsec. Share of each source's records that are displaced by 10σ.
ALIKE_ARCSEC, DISPLACED = 0.1, 0.02
#: Share of the frame's magnitudes that are those of another star.
UNRELATED = 0.05
#: Standard errors that cover 95 %. A floor consistent with 0 is exactly at this distance from 0.
WITHIN = 1.96 + 1e-9
#: Targeted range of the share of trials within them.
LEAST, MOST = 0.90, 0.98


@dataclass(frozen=True)
class Kind:
    """Frames of one kind.

    side_deg : None for that of the options. banded : whether magnitudes are given. change : applied to
    the simulated frame. known : true values that differ from those of unchanged frames; NaN where there is none.
    """

    title: str
    sky: Sky = field(default_factory=Sky)
    side_deg: float | None = None
    banded: bool = False
    change: Change = lambda rng, simulated: simulated
    known: Mapping[str, float] = field(default_factory=dict)

    def deviations(self, seed: tuple[int, int], side_deg: float) -> Iterator[tuple[str, float]]:
        """Names and deviations, in standard errors, of all that one frame has a true value for."""
        rng = np.random.default_rng(seed)
        simulated = self.change(rng, exposure(rng, self.sky, side_deg=self.side_deg or side_deg))
        _, estimate = match(
            simulated.scene.first, simulated.scene.second, brightness=simulated.brightness if self.banded else None
        )
        truth = truths(simulated) | true_colour_terms(estimate, simulated) | dict(self.known)
        for name, quantity in quantities(estimate):
            if np.isfinite(truth.get(name, np.nan)):
                yield name, (quantity.value - truth[name]) / quantity.standard_error
        if self.banded:
            yield from curve_deviations(estimate, simulated)


def quoted_too_small(rng: np.random.Generator, simulated: FrameAndCatalogue) -> FrameAndCatalogue:
    """All errors are quoted too small."""
    return replace(simulated, scene=misquoted(simulated.scene, BOTH))


def misquoted_with_floor(rng: np.random.Generator, simulated: FrameAndCatalogue) -> FrameAndCatalogue:
    """The frame's errors quoted too small, and a floor under the catalogue's."""
    first, second = simulated.scene.first, simulated.scene.second
    moved = displaced(second.features, FLOOR_ARCSEC * rng.standard_normal((len(second), 2)))
    first, second = replace(first, covariance=first.covariance / FRAME**2), replace(second, features=moved)
    return replace(simulated, scene=replace(simulated.scene, first=first, second=second))


def uniform_errors(rng: np.random.Generator, simulated: FrameAndCatalogue) -> FrameAndCatalogue:
    """One error for all of the catalogue; the frame's errors quoted too small, and a floor under the catalogue's."""
    second = simulated.scene.second
    covariance = np.tile([ALIKE_ARCSEC**2, 0.0, ALIKE_ARCSEC**2], (len(second), 1))
    moved = displaced(second.features, ALIKE_ARCSEC * rng.standard_normal((len(second), 2)))
    second = replace(second, features=moved, covariance=covariance)
    return misquoted_with_floor(rng, replace(simulated, scene=replace(simulated.scene, second=second)))


def displaced_records(rng: np.random.Generator, simulated: FrameAndCatalogue) -> FrameAndCatalogue:
    """Some records of each source are displaced."""
    return replace(simulated, scene=with_outliers(rng, simulated.scene, DISPLACED))


def unrelated_magnitudes(rng: np.random.Generator, simulated: FrameAndCatalogue) -> FrameAndCatalogue:
    """Some of the frame's magnitudes are those of other stars of it."""
    frame, catalogue = simulated.brightness
    values = np.array(frame.values)
    at = np.flatnonzero(rng.uniform(size=len(values)) < UNRELATED)
    values[at] = values[rng.integers(0, len(values), len(at))]
    return replace(simulated, brightness=(Magnitudes(values, frame.sigma, frame.names), catalogue))


#: True values if the errors differ from the quoted ones by more than one factor; quantities without one are NaN.
UNEVEN = {"error_scale": np.nan, "factor_1": FRAME, "floor": FLOOR_ARCSEC, "both": np.nan, "floor_instead": np.nan}
KINDS = (
    Kind("crowded, positions only"),
    Kind("sparse, positions only", SPARSE, 0.6),
    Kind("crowded, two bands", banded=True),
    Kind(
        f"crowded, two bands, {UNRELATED:.0%} of the magnitudes unrelated", banded=True, change=unrelated_magnitudes,
        known={"brightness_unrelated": UNRELATED},
    ),
    Kind(
        f"crowded, errors quoted {BOTH:g} times too small", change=quoted_too_small,
        known={"error_scale": BOTH, "factor_1": BOTH, "factor_2": BOTH, "both": BOTH, "floor_instead": np.nan},
    ),
    Kind(
        f"sparse, {DISPLACED:.0%} of either source's records displaced by 10 σ", SPARSE, 0.6, change=displaced_records,
        known={"error_scale": np.nan},
    ),
    Kind(
        f"sparse, one error of {ALIKE_ARCSEC:g}″ for all of the catalogue, the frame's quoted {FRAME:g} times too "
        f"small, a floor of {FLOOR_ARCSEC:g}″", EXACT, 0.6, change=uniform_errors, known=UNEVEN,
    ),
    Kind(
        f"sparse, the frame's errors quoted {FRAME:g} times too small, a floor of {FLOOR_ARCSEC:g}″", SPARSE, 0.6,
        change=misquoted_with_floor, known=UNEVEN,
    ),
    Kind(
        f"crowded, the frame's errors quoted {FRAME:g} times too small, a floor of {FLOOR_ARCSEC:g}″",
        change=misquoted_with_floor, known=UNEVEN,
    ),
)  # fmt: skip


def recovered(options: argparse.Namespace) -> Iterator[Table]:
    """A table for each kind of frame."""
    for kind in KINDS:
        deviations: dict[str, list[float]] = {}
        for number in range(options.trials):
            for name, deviation in kind.deviations((79, number), options.trial_side):
                deviations.setdefault(name, []).append(deviation)
        yield _table(kind, deviations, options)


def _table(kind: Kind, deviations: Mapping[str, list[float]], options: argparse.Namespace) -> Table:
    """Mean deviation, spread and coverage of every quantity."""
    lines: list[list[object]] = []
    outside = []
    for name, values in deviations.items():
        z = np.array(values)
        covered = float(np.mean(np.abs(z) <= WITHIN))
        lines.append([name, len(z), float(z.mean()), float(z.mean() * np.sqrt(len(z))), float(z.std()), covered])
        if not LEAST <= covered <= MOST:
            outside.append(f"{name} {covered:.3f}")
    columns = ("quantity", "n", "mean deviation, σ", "of its own error", "spread, σ", "within 1.96 σ")
    side = kind.side_deg or options.trial_side
    target = f"target: {LEAST:.2f} to {MOST:.2f} within 1.96 σ; outside: {', '.join(outside) or 'none'}"
    title = f"Standard errors, {options.trials} frames of {side:g}°: {kind.title}"
    notes = (f"{target}. Of {options.trials} trials, chance moves a share by ±{1.96 * _chance(options.trials):.3f}",)
    return Table(title, columns, lines, notes)


def _chance(trials: int) -> float:
    """Standard error of a share of 0.95."""
    return float(np.sqrt(0.95 * 0.05 / trials))


# ---- true values ----


def true_rule(simulated: FrameAndCatalogue) -> PoissonField:
    """The positions' rule with the parameters that made the frame."""
    sky = simulated.sky
    magnitude = np.linspace(sky.brightest, sky.faintest, 4001)
    number = 10 ** (sky.steepness * magnitude)
    detected = float(np.average(sky.completeness(magnitude), weights=number))
    stars, catalogued = sky.stars_per_deg2 / 3600.0**2, 1.0 - sky.uncatalogued
    false = stars * detected * sky.false_share / (1.0 - sky.false_share)
    return PoissonField(
        stars * catalogued * detected,
        stars * detected * sky.uncatalogued + false,
        stars * catalogued * (1.0 - detected),
    )


def truths(simulated: FrameAndCatalogue) -> dict[str, float]:
    """The true values of the estimates if errors and magnitudes are as quoted."""
    rule, sky = true_rule(simulated), simulated.sky
    only_1, only_2, common = (float(x) for x in (rule.only_1, rule.only_2, rule.common))  # type: ignore[arg-type]
    pairs = simulated.scene.true_pairs()
    colour = np.mean(simulated.colour[simulated.scene.truth_1[pairs[0]]] - 0.8)
    return {
        "common": len(pairs[0]), "share_1": common / (common + only_1), "share_2": common / (common + only_2),
        "density_common": common, "density_only_1": only_1, "density_only_2": only_2, "error_scale": 1.0,
        "zero_point": sky.zero_point + sky.colour_term * float(colour), "scatter": sky.scatter,
        "factor_1": 1.0, "factor_2": 1.0, "both": 1.0, "floor": 0.0, "floor_instead": 0.0,
    }  # fmt: skip


def true_colour_terms(estimate: Estimate, simulated: FrameAndCatalogue) -> dict[str, float]:
    """Slopes of the frame's magnitude, free of errors and scatter, on the measured colours of the true pairs.

    Not the frame's colour term, which is the slope on true colours: see :class:`sameas.evidence.Relation`. By weighted
    least squares, with a curve in the first band at the estimated knots.
    """
    relation = None if estimate.photometry is None else estimate.photometry.first_relation
    if relation is None:
        return {}
    (i, j), sky, catalogue = simulated.scene.true_pairs(), simulated.sky, simulated.brightness[1]
    star = simulated.scene.truth_1[i]
    frame = simulated.magnitude[star] + sky.zero_point + sky.colour_term * (simulated.colour[star] - 0.8)
    measured, sigma = np.asarray(catalogue.values)[j], np.asarray(catalogue.sigma)[j]
    curve = [np.interp(measured[:, 0], relation.knots, hat) for hat in np.eye(len(relation.knots))]
    basis = np.column_stack([*curve, measured[:, 1:] - measured[:, :1]])
    # The relation is − colour_term (I − V); this is the effect of errors of V and I on the expected magnitude.
    moved = (1.0 + sky.colour_term) ** 2 * sigma[:, 0] ** 2 + sky.colour_term**2 * sigma[:, 1] ** 2
    root = 1.0 / np.sqrt(sky.scatter**2 + np.asarray(simulated.brightness[0].sigma)[i, 0] ** 2 + moved)
    slopes = np.linalg.lstsq(root[:, None] * basis, root * (frame - measured[:, 0]))[0][len(relation.knots) :]
    return {f"colour_{name}": float(slope) for name, slope in zip(catalogue.names[1:], slopes, strict=True)}


def quantities(estimate: Estimate) -> Iterator[tuple[str, Quantity]]:
    """All estimated quantities."""
    yield from estimate.quantities.items()
    model = estimate.error_model
    if model is not None:
        yield from model.terms.items()


def curve_deviations(estimate: Estimate, simulated: FrameAndCatalogue) -> Iterator[tuple[str, float]]:
    """Bins of P_d(m) of the catalogue, in standard errors, where the error of a magnitude does not matter."""
    curve, sky = estimate.detection_2, simulated.sky
    if curve is None:
        return
    measured = np.asarray(simulated.brightness[1].values)[:, 0]
    true = simulated.magnitude[simulated.scene.truth_2]
    at = np.searchsorted(curve.edges, measured, side="right") - 1
    for k in range(len(curve.number)):
        expected = float(sky.completeness(true[at == k]).mean()) if np.any(at == k) else np.nan
        if curve.number[k] >= 30 and np.isfinite(expected):
            yield "P_d(m) of the catalogue", float((curve.probability[k] - expected) / curve.standard_error[k])
