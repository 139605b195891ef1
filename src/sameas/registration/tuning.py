"""Tuning of the registration: the chosen numbers of its search, refinement and verdict, as one value."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """The chosen numbers of :func:`sameas.registration.register`; σ is the standard deviation of a residual.

    Attributes
    ----------
    beginnings, fewest_beginnings : offsets that are refined at most and at least. refined_records : records of the
        second source from which on ``beginnings`` is reduced.
    sure : an offset is established at this share of the posterior.
    small_overlap : an overlap below this share of both sources is reported.

    most_pairs : most pairs whose votes are counted one by one; above, the counts are a correlation by FFT.
    most_cells : most cells of a count.
    fine_sigmas : cells up to this many σ need no finer count. coarse_peaks : peaks of a coarse count that are refined.
    first_records, more_records : records that vote first, and the factor to the next number of them.
    decided_score, few_peaks : the votes of a part decide at this score, if no more peaks come near it.
    patch_records, patch_cell_sigmas : records of a patch where a grid is searched, and σ of its cells, which are wider
        because a node of the grid does not bring true votes exactly together.
    node_peaks : peaks that a node of the grid keeps on a patch.
    step_sigmas, reach_widths, most_steps : a step of the grid moves the edge by this many σ; the grid reaches this many
        prior widths in at most this many steps.
    peak_share, peak_cells : a fine peak has at least this share of the best score, and this distance in cells.
    vote_sample : records that locate the votes within a coarse cell.

    gate_sigmas : pairs farther than this many σ are not weighed.
    cell_sigmas, cells_per_record : size of the cells in which pairs are searched, and most cells for a record.
    sweeps, roughly, closely : most sweeps of messages, and the relative change that ends them in the search and after.
    least_common, most_common_share : bounds of the number of common objects: objects, and share of the poorer source.

    widenings : factors on the errors, iteration by iteration. kept : candidates that remain after each.
    from_patches, from_sample : first of the widenings with all records, after patches and after a sample.
    settled : the refinement ends at a step below this share of a standard error.
    same_sigmas, same_errors : two solutions are one where no record moves by more than this many σ, or where they
        differ by no more than this many standard errors.
    most_behind : solutions are dropped whose log likelihood is lower than the best by this.
    repeating : a pattern repeats where another solution explains this share of the best one's log likelihood.
    sample : records of the second source in the search; all of them are in the last refinement.
    sample_ratio : records in the search per record whose votes decided.
    patch_growth : factor by which a patch grows from one refinement to the next.
    weak : pairs of a lower weight do not count in the equations.
    many : with fewer common objects the likelihood is evaluated away from its maximum, at ``away`` standard deviations.
    """

    beginnings: int = 64
    fewest_beginnings: int = 6
    refined_records: int = 4000
    sure: float = 0.95
    small_overlap: float = 0.2

    most_pairs: int = 2_000_000
    most_cells: int = 1 << 19
    fine_sigmas: float = 2.0
    coarse_peaks: int = 8
    first_records: int = 64
    more_records: int = 8
    decided_score: float = 25.0
    few_peaks: int = 4
    patch_records: int = 40
    patch_cell_sigmas: float = 1.6
    node_peaks: int = 5
    step_sigmas: float = 3.0
    reach_widths: float = 2.5
    most_steps: int = 41
    peak_share: float = 0.3
    peak_cells: int = 2
    vote_sample: int = 20_000

    gate_sigmas: float = 5.5
    cell_sigmas: float = 6.0
    cells_per_record: float = 4.0
    sweeps: int = 100
    roughly: float = 1e-2
    closely: float = 1e-5
    least_common: float = 0.05
    most_common_share: float = 0.98

    widenings: tuple[float, ...] = (2.0, 1.5, 1.2, 1.0, 1.0)
    kept: tuple[int, ...] = (64, 64, 48, 32, 16)
    from_patches: int = 2
    from_sample: int = 3
    settled: float = 0.01
    same_sigmas: float = 0.7
    same_errors: float = 2.0
    most_behind: float = 8.0
    repeating: float = 0.4
    sample: int = 4000
    sample_ratio: int = 16
    patch_growth: int = 8
    weak: float = 1e-6
    many: float = 200.0
    away: tuple[float, ...] = (-3.0, -1.5, 1.5, 3.0)

    @property
    def decisive(self) -> float:
        """ln of the odds of ``sure``: evidence that decides."""
        return math.log(self.sure / (1.0 - self.sure))


DEFAULT_TUNING = Tuning()
