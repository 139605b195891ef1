"""Tuning of tracks: the chosen numbers by which reports become feeds, biases are fitted and doubts are raised."""

from __future__ import annotations

from dataclasses import dataclass

from sameas.registration.tuning import DEFAULT_TUNING as REGISTRATION
from sameas.registration.tuning import Tuning as RegistrationTuning


@dataclass(frozen=True)
class Tuning:
    """The chosen numbers of tracks. Units are in the names; shares, factors and probabilities have none.

    Attributes
    ----------
    unknown_site_share : a radar without a site is taken to stand at this share of its range from its targets.
    stray_count, stray_radii, stray_m : in a source of ``stray_count`` positions or more, a position is set aside that
        lies farther from their median than ``stray_radii`` × the radius that holds nine of ten, and than ``stray_m``.
    unknown_velocity_share : a velocity is unknown when its variance is at least this share of that of all velocities.
    timeout_quantile : the track timeout is this quantile of the gaps within tracks.
    at_rest : an object moves when the χ² of its velocity against 0 exceeds the limit of this share of objects at rest.
    fastest : nothing moves faster than this factor times the usual speed of the source's objects, 1σ per axis.
    alternations : an id belongs to two objects when its reports change between their places this often; one change is
        a repeated position or a reused id.
    place_sigmas : positions may be off by this many σ.

    rotation_search : the rotation period is searched within this share of the described one, in ``rotation_plots``
        plots at most, with ``rotation_steps`` steps per resolvable frequency.
    rotation_log_odds : a period is accepted at these log-odds against chance.
    rotation_unexplained : an antenna rotates where the rotation leaves less than this share of the bearings' scatter.
    pause_quantile : the pause of an antenna is this quantile of the gaps between its plots.
    exposure_gap, exposure_length : reports of one exposure follow each other within the first share of the period, and
        all lie within the second.
    exposures_per_period, hurried_share : a period has at most this many exposures, and at most this share of them
        follow the one before in half the usual time.
    pointing_sigmas : a direction points at places within this many σ.

    measured_ratio, measured_fewest : reports are independent measurements when the median of their squared innovations
        is at least this share of that of independent errors; the second number is the fewest innovations for it.
    new_track_probability : a report starts its track anew beyond the χ² limit that this share of correct ones exceeds.

    common_instants, common_records : two sources are compared at this many instants, at fewer where these hold more
        than ``common_records`` records in all, and at ``fewest_instants`` or more.
    skipped_share : share of the common time that is skipped at its start, when not every object has reported yet.
    searched_instants, search_offsets, search_steps : instants of the bias search, offsets each, and their iterations.
    widenings, kept : factors on the errors, iteration by iteration, and candidates that remain after each.
    settled, most_steps : the bias fit ends at steps below this share of a standard error, or after this many.
    same_sigmas : two solutions are one when no record moves between them by more than this many σ.
    least_information : share of the information that is kept, however doubtful the pairs are.
    moved_sigmas : instants are independent once records have moved by this many σ.
    registration : tuning of the offset search at each instant; its ``decisive`` evidence establishes biases.

    doubt_instants, doubt_steps : instants at which sources are compared, and iterations of the common number.
    nothing, much : a source shares nothing below this share of records with a partner; a guess must reach the second.
    guess_gain : least gain of the log likelihood of an instant by a guess: some thirty guesses are made.
    near_extents, near_m : a guess of positions brings a source to another within this many of its extents, or metres.
    """

    unknown_site_share: float = 0.25
    stray_count: int = 20
    stray_radii: float = 20.0
    stray_m: float = 20e3
    unknown_velocity_share: float = 0.9
    timeout_quantile: float = 0.999
    at_rest: float = 1.0 - 1e-6
    fastest: float = 5.0
    alternations: int = 4
    place_sigmas: float = 6.0

    rotation_search: float = 0.3
    rotation_plots: int = 3000
    rotation_steps: float = 6.0
    rotation_log_odds: float = 12.0
    rotation_unexplained: float = 0.5
    pause_quantile: float = 0.99
    exposure_gap: float = 0.1
    exposure_length: float = 0.5
    exposures_per_period: float = 1.5
    hurried_share: float = 0.1
    pointing_sigmas: float = 3.0

    measured_ratio: float = 1.0 / 3.0
    measured_fewest: int = 30
    new_track_probability: float = 1e-9

    common_instants: int = 16
    common_records: int = 4000
    fewest_instants: int = 4
    skipped_share: float = 0.05
    searched_instants: int = 3
    search_offsets: int = 32
    search_steps: int = 20
    widenings: tuple[float, ...] = (2.0, 1.5, 1.2, 1.0, 1.0)
    kept: tuple[int, ...] = (12, 8, 6, 4, 3)
    settled: float = 0.01
    most_steps: int = 40
    same_sigmas: float = 0.7
    least_information: float = 0.02
    moved_sigmas: float = 3.0
    registration: RegistrationTuning = REGISTRATION

    doubt_instants: int = 5
    doubt_steps: int = 8
    nothing: float = 0.1
    much: float = 0.5
    guess_gain: float = 8.0
    near_extents: float = 3.0
    near_m: float = 50e3


DEFAULT_TUNING = Tuning()
