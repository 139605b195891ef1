"""The result of a crossmatch with everything estimated: :class:`Estimate`, and the limits it was made with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.coverage import DEFAULT_COVERAGE, Coverage, CoverageTuning
from sameas.estimate.em import DEFAULT_EM, EMTuning
from sameas.estimate.error_average import ErrorRanges
from sameas.estimate.error_grid import DEFAULT_GRID, GridTuning
from sameas.estimate.error_model import (
    DEFAULT_ERROR_FIT,
    ErrorFitTuning,
    ErrorModel,
    Tail,
    error_model,
    factor_on_quoted,
    fit_spread,
    tail,
)
from sameas.estimate.error_trends import Trend
from sameas.estimate.photometry import Photometry
from sameas.estimate.quantity import Quantity, changed_without, decisive, quantities
from sameas.estimate.share_regression import DEFAULT_COLUMNS, ColumnsTuning
from sameas.estimate.unresolved import BlendResolution
from sameas.evidence import Errors, Precision
from sameas.evidence.detection import DetectionCurve
from sameas.representation import in_short
from sameas.result import Identification

BRIGHTNESS_TERMS, PRECISION_TERMS = ("completeness", "brightness"), ("precision",)
COLUMN_TERMS = ("columns", "prior odds", "relations")


#: The gate is widened when this share of the expected true pairs lies beyond 0.7 of its radius (4e-5 where errors are
#: as quoted), and one pair more.
MIN_OUTER_SHARE = 6e-5
#: Where a record would have fewer chance candidates, half a pair of a tail suffices: its last pairs are otherwise
#: certain to have no partner.
MAX_NEGLIGIBLE_CHANCE = 0.1
MAX_GATE_SIGMAS = 400.0  # greatest radius of the gate
#: The gate is widened when the typical errors exceed those it was made for by this factor; up to there it loses only
#: 2e-6 of the pairs.
MAX_SCALE_EXCESS = 1.25
#: The gate is not widened for a tail, or for underestimated errors, when a record would have on average more chance
#: candidates than this.
MAX_CHANCE_TAIL, MAX_CHANCE_SCALE = 0.5, 8.0
#: A tail with this gain in ln likelihood that is not yet significant is looked for in a wider gate. Then, and with a
#: significant tail, a record may have this many chance candidates.
SUSPECT_TAIL_GAIN, MAX_CHANCE_SUSPECTED = 1.0, 2.0
#: The gate is widened by this factor to test for a tail that begins at its edge: after SUSPECT_TAIL_GAIN, or where
#: SUSPECT_WIDE_SHARE of the pairs has errors above 1.4 typical ones.
GATE_STEP = 1.5
SUSPECT_WIDE_SHARE = 0.1
TAIL_SEED = (3.375, 0.1)  # scale (in typical errors) and share of the tail that this test starts from
#: Gain in ln likelihood for the test to accept the tail (fields without a tail, but with clusters, ghosts or blends: at
#: most 0.4).
MIN_TAIL_GAIN = 4.0
N_MODEL_PAIRS = 3_000  # pairs from which the error model of the evidence is fitted
#: Gain in ln likelihood for another error model, over the quoted errors, or of common objects over chance.
MIN_GAIN_OF_GATE = 8.0
MIN_SIGNIFICANCE = 4.0  # excess of close candidates over chance, in standard deviations, from which errors are fitted
MAX_TREND_FITS = 3
MIN_TREND_GAIN = 2.0
MAX_RESOLUTION_FITS = 2
#: A resolution is refused where fewer common objects than this share of those without it are left: the tails of the
#: relation of the magnitudes explain such blends better, of three and more objects in the core of a cluster.
MIN_KEPT = 0.99
#: Records plus twice the expected chance candidates above which interpreting the kernels takes longer than reading the
#: compiled ones from the cache (measured with 200 to 2 000 records).
MAX_INTERPRETED = 2_300.0


@in_short
@dataclass(frozen=True)
class MatchTuning:
    """Limits for widening the gate and for accepting estimates.

    max_iterations : EM iterations after which no further error model is tried; its iterations are at most two thirds of
        these more.
    max_sample_error : a sample is rejected when the number of common objects differs from its prediction by more than
        this share and the statistical error.
    fits_trends : whether growth of the errors is fitted, at most MAX_TREND_FITS times, while a further fit gains
        MIN_TREND_GAIN in ln likelihood.
    fits_resolution : whether the resolution of a source that blends neighbours is fitted, at most
        MAX_RESOLUTION_FITS times.
    max_unrelated : from this share of pairs with unrelated magnitudes on, a note is given.
    em : tuning of EM iterations.
    columns : of other columns.
    grid : of the scan of error models before any iteration.
    coverage : of cells, densities and holes.
    error_fit : of factors, floors and tails.
    """

    max_iterations: int = 30
    max_sample_error: float = 0.02
    fits_trends: bool = True
    fits_resolution: bool = True
    max_unrelated: float = 0.5
    em: EMTuning = DEFAULT_EM
    columns: ColumnsTuning = DEFAULT_COLUMNS
    grid: GridTuning = DEFAULT_GRID
    coverage: CoverageTuning = DEFAULT_COVERAGE
    error_fit: ErrorFitTuning = DEFAULT_ERROR_FIT


DEFAULT_MATCH = MatchTuning()


@in_short
@dataclass(frozen=True)
class Estimate:
    """The estimates of a crossmatch and the options they were made with.

    Attributes
    ----------
    common, share_1, share_2 : expected number of common objects, and their shares of the covered records.
    errors : the errors of the evidence: model S of the covariances, and distribution of the residuals relative to S.
    gate_sigmas : radius of the gate, in quoted standard deviations of the typical pair.
    coverage : where both sources observe.
    iterations, converged : number of EM iterations, and whether they converged.
    learned_from : records of each source that were used: all, or those of a sample.
    notes : remarks for the user.
    photometry : relations of the magnitudes of both sources; None if not given or not informative.
    precision : evidence of the sizes of the quoted errors; None if not used or not informative.
    columns : evidence of other columns; None if not given.
    trends : growth of the errors in addition to the quoted ones; included in ``errors``.
    resolution : of the source that blends neighbours of the other, as the evidence allows for; None without.
    tuning : as of :func:`sameas.estimate.match.match`.
    answer : the identification. errors_estimated : whether the distribution of the errors was estimated from its pairs.
    error_ranges : ranges of the errors over which probabilities are averaged with few pairs; None with many.

    The properties are computed when first used.
    """

    common: float
    share_1: float
    share_2: float
    errors: Errors
    gate_sigmas: float
    coverage: Coverage
    iterations: int
    converged: bool
    learned_from: tuple[int, int]
    notes: tuple[str, ...]
    photometry: Photometry | None
    precision: Precision | None
    answer: Identification = field(repr=False)
    errors_estimated: bool
    error_ranges: ErrorRanges | None = None
    columns: ColumnEvidence | None = None
    trends: tuple[Trend, ...] = ()
    resolution: BlendResolution | None = None
    tuning: MatchTuning = field(default=DEFAULT_MATCH, repr=False)

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """All numbers by name, with standard errors; see ``sameas.estimate.quantity.quantities``."""
        errors = self.errors if self.errors_estimated else None
        return quantities(
            self.answer, self.coverage, self.photometry, self.columns, errors=errors, learned_from=self.learned_from
        )

    @property
    def detection_1(self) -> DetectionCurve | None:
        """Share of source 1's records that source 2 shows, by magnitude; None without magnitudes."""
        return self._detection[0]

    @property
    def detection_2(self) -> DetectionCurve | None:
        """Share of source 2's records that source 1 shows, by magnitude; None without magnitudes."""
        return self._detection[1]

    @cached_property
    def _detection(self) -> tuple[DetectionCurve | None, DetectionCurve | None]:
        return (None, None) if self.photometry is None else self.photometry.detection(self.answer, self.coverage)

    @cached_property
    def decisive(self) -> Mapping[str, float]:
        """Median absolute value of each term of the evidence over the identified pairs."""
        return decisive(self.answer)

    @cached_property
    def changed_by_brightness(self) -> int:
        """Number of records of source 1 that positions alone would identify differently."""
        return changed_without(self.answer, BRIGHTNESS_TERMS)

    @cached_property
    def changed_by_precision(self) -> int:
        """Number of records of source 1 identified differently without the sizes of the quoted errors."""
        return changed_without(self.answer, PRECISION_TERMS)

    @cached_property
    def changed_by_columns(self) -> int:
        """Number of records of source 1 identified differently without the other columns."""
        return changed_without(self.answer, COLUMN_TERMS)

    @cached_property
    def tail(self) -> Tail | None:
        """Share of pairs with errors far larger than the typical ones; None without a tail."""
        return tail(self.answer, self.errors, self.tuning.error_fit)

    @cached_property
    def error_model(self) -> ErrorModel | None:
        """Factors and floor of each source's errors, as far as distinguishable; None if errors were not estimated."""
        return error_model(self.answer, self.tuning.error_fit) if self.errors_estimated else None

    @cached_property
    def spread(self) -> Errors:
        """Distribution of the residuals relative to the quoted covariances, whatever the error model."""
        if not self.errors.as_modelled:
            return self.errors
        return fit_spread(self.answer.pairs, self.answer.p_pair, self.tuning.error_fit)

    @property
    def typical_scale(self) -> float:
        """Factor on the quoted errors for the typical pair."""
        return self.errors.typical_scale * self._model_factor

    @cached_property
    def _model_factor(self) -> float:
        """Median over the probable pairs of modelled over quoted errors, without the mixture."""
        return factor_on_quoted(self.errors, self.answer.pairs, self.answer.p_pair, self.tuning.error_fit)
