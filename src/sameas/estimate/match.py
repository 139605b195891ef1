"""Crossmatch of two sources with everything unknown estimated from the data: densities, shares in common, errors.

EM iterations alternate between identification and maximum likelihood, with every pair weighted by its posterior
probability (METHOD 6), until the expected number of common objects converges. Estimated are

- the local densities of common objects and of records that only one source shows (``coverage.py``);
- the distribution of residuals relative to the quoted errors: a mixture of normals over a ladder of error scales. Its
  likelihood in the shares has one maximum, and covers both underestimated errors and heavy tails;
- growth of errors with magnitude or with the distance from the field's centre (``error_trends.py``);
- relations between the magnitudes of both sources, and the shares in common by magnitude (``photometry.py``);
- the width of the gate: it is widened while its outer part still contains true pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sameas.errors import InputError
from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.coverage import Coverage
from sameas.estimate.em import MIN_PAIRS_TO_LEARN, EMState, EMTuning
from sameas.estimate.error_grid import ENOUGH_PAIRS, MAX_AVERAGED, ErrorScan, mean_densities, scan_errors
from sameas.estimate.error_trends import covariates, with_trends
from sameas.estimate.gate_search import (
    DEFAULT_MATCH,
    GATE_STEP,
    N_MODEL_PAIRS,
    SUSPECT_TAIL_GAIN,
    GateResult,
    GateSearch,
    MatchTuning,
    has_excess,
    to_estimate,
)
from sameas.estimate.photometry import Photometry
from sameas.estimate.result import Estimate
from sameas.estimate.sample import Sampling
from sameas.evidence import Column, Errors, Magnitudes, Related
from sameas.gate import ChiSquare, Radius
from sameas.kernels.compiled import prefer_compiled
from sameas.records import Records
from sameas.result import Identification
from sameas.space import ball_volume

#: Gain in ln likelihood for another error model, over the quoted errors, or of common objects over chance.
MIN_GAIN_OF_GATE = 8.0
MAX_TREND_FITS, MIN_TREND_GAIN = 3, 2.0  # fits of growing errors, and the gain in ln likelihood for a further one
MAX_RESOLUTION_FITS = 2
#: A resolution is refused where fewer common objects than this share of those without it are left: the tails of the
#: relation of the magnitudes explain such blends better, of three and more objects in the core of a cluster.
MIN_KEPT = 0.99
#: Records plus twice the expected chance candidates above which interpreting the kernels takes longer than reading the
#: compiled ones from the cache (measured with 200 to 2 000 records).
MAX_INTERPRETED = 2_300.0
TAIL_SEED = (3.375, 0.1)  # scale (in typical errors) and share of the tail that the test for a tail starts from
MIN_TAIL_GAIN = 4.0  # gain in ln likelihood to accept it (without a tail, clusters, ghosts and blends give at most 0.4)


def match(
    first: Records,
    second: Records,
    *,
    errors: Errors | None = None,
    gate: ChiSquare | Radius | None = None,
    density: tuple[float, float] | None = None,
    brightness: tuple[Magnitudes, Magnitudes] | None = None,
    precision: bool = True,
    evidence: Sequence[Column | Related] = (),
    sampling: Sampling = Sampling(),  # noqa: B008
    tuning: MatchTuning = DEFAULT_MATCH,
    progress: Callable[[str], None] = lambda stage: None,
) -> tuple[Identification, Estimate]:
    """The identification of two sources, with everything unknown estimated, and the estimates.

    Parameters
    ----------
    errors : distribution of the residuals; estimated if not given. ``Errors()`` assumes the quoted errors.
    gate : the gate; widened as the estimated errors need if not given.
    density : (ρ₁, ρ₂) of all records of each source per (residual unit)^d, instead of local ones from the data.
    brightness : magnitudes of every row of both tables, as evidence; None uses positions only.
    precision : whether the sizes of the quoted errors are evidence: faint objects have larger ones.
    evidence : columns used as evidence, of one source or related columns of both.
    sampling : size of the sample of large sources from which estimates are made.
    tuning : limits, such as the number of pairs below which probabilities are averaged over errors.
    progress : called with the name of each step.

    Raises
    ------
    InputError : a source has no records.
    """
    for records in (first, second):
        if not len(records):
            raise InputError(f"{records.source} has no usable records; nothing can be identified")
    progress("densities")
    photometry = _photometry(first, second, brightness)
    coverage = Coverage.of(first, second)
    columns = ColumnEvidence.of(first, second, evidence)
    if _expected_work(coverage, density) > MAX_INTERPRETED:
        prefer_compiled()
    search = GateSearch(
        coverage, photometry, precision, density, gate, sampling, progress, tuning=tuning, columns=columns
    )
    scan = scan_errors(coverage, density) if errors is None and gate is None else None
    # With few records, errors by which they have nothing in common are averaged over too.
    few = min(len(first), len(second)) <= 2 * ENOUGH_PAIRS
    if scan is not None and scan.common < MAX_AVERAGED and (few or scan.contrast > MIN_GAIN_OF_GATE):
        return search.match_averaged(scan)
    search, result, remarks = _fit(search, scan, errors)
    result = search.without_message_errors(result)
    answer, result = search.identify_all(result)
    estimate = to_estimate(answer, search.coverage, result, remarks)
    return answer, replace(estimate, trends=search.trends, resolution=search.resolution)


def _expected_work(coverage: Coverage, density: tuple[float, float] | None) -> float:
    """Records of the poorer source, and twice the expected chance candidates in the default gate by quoted errors."""
    if not all(covered.any() for covered in coverage.covered):
        return 0.0
    d = coverage.first.d
    volume = ball_volume(d) * ChiSquare().limit(d) ** (0.5 * d) * float(np.prod(coverage.typical_error))
    n = min(len(coverage.first), len(coverage.second))
    return float(n * (1.0 + 2.0 * max(mean_densities(coverage, density)) * volume))


@dataclass(frozen=True)
class Assumed:
    """What is given to a match instead of being estimated; the fields are the arguments of :func:`match`."""

    errors: Errors | None = None
    gate: ChiSquare | Radius | None = None
    density: tuple[float, float] | None = None
    precision: bool = True


@dataclass(frozen=True)
class SampleMatch:
    """Estimates from a sample of two sources, for use on all records. Made by :func:`match_sample`.

    estimate : as of :func:`match`, of the sample. estimates : after the last EM iteration. gate_errors, gate_sigmas :
    errors of the gate's distances, and its radius in these.
    """

    estimate: Estimate
    estimates: EMState = field(repr=False)
    gate_errors: Errors
    gate_sigmas: float


def match_sample(
    coverage: Coverage,
    assumed: Assumed,
    *,
    brightness: tuple[Magnitudes, Magnitudes] | None,
    columns: ColumnEvidence | None,
    progress: Callable[[str], None],
) -> SampleMatch:
    """The estimates from a sample drawn by the caller.

    coverage : of the sample, with its counted records. columns : of its records, as evidence. Other arguments as of
    :func:`match`. The errors of maximum likelihood are used, however few the pairs are.
    """
    photometry = _photometry(coverage.first, coverage.second, brightness)
    all_records, density = Sampling(enough=2**62), assumed.density
    # Trends would apply to the records of the sample only; companions need all records.
    tuning = MatchTuning(fits_trends=False, fits_resolution=False, em=EMTuning(companions=False))
    search = GateSearch(
        coverage, photometry, assumed.precision, density, assumed.gate, all_records, progress, tuning=tuning,
        columns=columns,
    )  # fmt: skip
    estimated = assumed.errors is None and assumed.gate is None
    scan = scan_errors(coverage, density) if estimated else None
    search, result, remarks = _fit(search, scan, assumed.errors)
    result = search.without_message_errors(result)
    answer, result = search.identify_all(result)
    estimate = to_estimate(answer, coverage, result, remarks)
    (one, two), common = result.estimates.setting.n_counted, result.estimates.n_common
    share_1, share_2 = (min(1.0, common / max(n, 1)) for n in (one, two))
    estimate = replace(estimate, common=common, share_1=share_1, share_2=share_2)
    return SampleMatch(estimate, result.estimates, search.gate_errors, result.gate_sigmas)


def _fit(search: GateSearch, scan: ErrorScan | None, errors: Errors | None) -> tuple[GateSearch, GateResult, list[str]]:
    """The search with the fitted error model, its result, and remarks for the user."""
    tuning = search.tuning
    if scan is not None and scan.contrast > MIN_GAIN_OF_GATE and scan.gain > MIN_GAIN_OF_GATE:
        search = replace(search, gate_errors=scan.best)
    result, remarks = search.run(errors, tuning.max_iterations), []
    while errors is None and result.iterations < tuning.max_iterations:
        model, gain = result.better_model()
        if gain < MIN_GAIN_OF_GATE:
            break
        changed = replace(search, gate_errors=model)
        again = _rerun(changed, result, None)
        if again.is_worse_than(result):
            break
        search, result = changed, again
    if errors is None:
        search, result = _fit_tail(search, result)
    if tuning.fits_trends and errors is None and result.converged:
        search, result = _fit_trends(search, result)
    if tuning.fits_resolution:
        search, result = _fit_resolution(search, result, errors)
    if result.has_learned and not has_excess(search.gate_errors.pairs(result.whole.pairs), result.gate_sigmas):
        more = search.photometry is not None or search.columns is not None
        assumed = "positions and quoted errors alone" if more else "the quoted errors"
        given = search.columns and search.columns.given_only
        search = replace(
            search, photometry=None, precision=False, columns=given, trends=(), seed_errors=None, min_sigmas=0.0,
            resolution=None,
        )  # fmt: skip
        result = _rerun(search, result, errors or Errors())
        remarks.append(f"close candidates do not exceed what chance gives; {assumed} are used")
    return search, result, remarks


def _rerun(search: GateSearch, result: GateResult, errors: Errors | None) -> GateResult:
    """The result of a changed search with the remaining iterations; all are counted.

    With each error model the gate is doubled anew; five times take 12 to 18 iterations.
    """
    again = search.run(errors, search.remaining(result))
    return replace(again, iterations=result.iterations + again.iterations)


def _fit_tail(search: GateSearch, result: GateResult) -> tuple[GateSearch, GateResult]:
    """The search and result with a gate wide enough for the tail of the errors, if there is one.

    Within a gate for quoted errors, pairs of the tail are hidden among chance candidates, and their number is missing
    from the number of common objects; farther out, only a tail gives more pairs than chance.
    """
    tuning = search.tuning
    # Accepted after the last iteration, not in each: the gain of a tail grows with the number of common objects.
    late = replace(tuning, em=replace(tuning.em, significant_tail_gain=SUSPECT_TAIL_GAIN))
    while search.gate is None and result.suspects_tail() and result.iterations < tuning.max_iterations:
        min_sigmas = GATE_STEP * result.gate_sigmas
        seed_errors = _with_tail_seed(result.estimates.errors)
        wider = replace(search, min_sigmas=min_sigmas, seed_errors=seed_errors, tuning=late)
        wider_result = _rerun(wider, result, None)
        if wider_result.estimates.tail_gain < MIN_TAIL_GAIN:
            break
        search, result = wider, wider_result
    return search, result


def _with_tail_seed(errors: Errors) -> Errors:
    """The errors with a tail added, unless they have one."""
    scale, share = TAIL_SEED
    wide = scale * errors.typical_scale
    if max(errors.scales) >= wide:
        return errors
    return replace(errors, scales=(*errors.scales, wide), shares=(*((1.0 - share) * x for x in errors.shares), share))


def _fit_trends(search: GateSearch, result: GateResult) -> tuple[GateSearch, GateResult]:
    """The search and result with errors that grow with magnitude or position, if the pairs show such growth."""
    tuning, quantities = search.tuning, covariates(search.coverage, search.photometry)
    for _ in range(MAX_TREND_FITS):
        estimates = result.estimates
        few = estimates.n_common < MIN_PAIRS_TO_LEARN
        if result.iterations >= tuning.max_iterations or not estimates.fits_errors or few:
            break
        model, trends, gain = with_trends(
            estimates.errors, estimates.setting.pairs, estimates.p_single(result.p_counted), quantities,
            N_MODEL_PAIRS, search.trends,
        )  # fmt: skip
        if gain < (MIN_TREND_GAIN if search.trends else MIN_GAIN_OF_GATE):
            break
        changed = replace(search, gate_errors=model, trends=trends)
        again = _rerun(changed, result, None)
        if again.is_worse_than(result):
            break
        search, result = changed, again
    return search, result


def _fit_resolution(search: GateSearch, result: GateResult, errors: Errors | None) -> tuple[GateSearch, GateResult]:
    """The search and result with the resolution of a source that blends neighbours of the other, if one does."""
    for _ in range(MAX_RESOLUTION_FITS):
        found = result.estimates.best_resolution(result.p_counted)
        if found is None or found.is_near(search.resolution):
            break
        changed = replace(search, resolution=found)
        again = _rerun(changed, result, errors)
        if again.is_worse_than(result) or again.estimates.n_common < MIN_KEPT * result.estimates.n_common:
            break
        search, result = changed, again
    return search, result


def _photometry(first: Records, second: Records, brightness: tuple[Magnitudes, Magnitudes] | None) -> Photometry | None:
    if brightness is None:
        return None
    one, two = brightness
    return Photometry.of((one.of(first), two.of(second)), (one.names, two.names))
