"""The result of a crossmatch with everything estimated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.coverage import Coverage
from sameas.estimate.error_average import ErrorRanges
from sameas.estimate.error_model import ErrorModel, Tail, error_model, factor_on_quoted, fit_spread, tail
from sameas.estimate.error_trends import Trend
from sameas.estimate.photometry import Photometry
from sameas.estimate.quantity import Quantity, changed_without, decisive, quantities
from sameas.estimate.unresolved import BlendResolution
from sameas.evidence import Errors, Precision
from sameas.evidence.detection import DetectionCurve
from sameas.representation import in_short
from sameas.result import Identification

BRIGHTNESS_TERMS, PRECISION_TERMS = ("completeness", "brightness"), ("precision",)
COLUMN_TERMS = ("columns", "prior odds", "relations")


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
        return tail(self.answer, self.errors)

    @cached_property
    def error_model(self) -> ErrorModel | None:
        """Factors and floor of each source's errors, as far as distinguishable; None if errors were not estimated."""
        return error_model(self.answer) if self.errors_estimated else None

    @cached_property
    def spread(self) -> Errors:
        """Distribution of the residuals relative to the quoted covariances, whatever the error model."""
        if not self.errors.as_modelled:
            return self.errors
        return fit_spread(self.answer.pairs, self.answer.p_pair)

    @property
    def typical_scale(self) -> float:
        """Factor on the quoted errors for the typical pair."""
        return self.errors.typical_scale * self._model_factor

    @cached_property
    def _model_factor(self) -> float:
        """Median over the probable pairs of modelled over quoted errors, without the mixture."""
        return factor_on_quoted(self.errors, self.answer.pairs, self.answer.p_pair)
