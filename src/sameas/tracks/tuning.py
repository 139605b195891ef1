"""Tuning of tracks: the chosen numbers by which reports become feeds, biases are fitted and doubts are raised."""

from __future__ import annotations

from dataclasses import dataclass

from sameas.registration.hough import DEFAULT_TUNING as REGISTRATION
from sameas.registration.hough import Tuning as RegistrationTuning


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

    azimuth_reach, azimuth_step_deg : bare plots' azimuth is searched within this many prior widths, in such steps.
    azimuth_peaks : peaks of the search that are told.
    gate_sigmas : plots farther than this many σ in range are of no track. path_m : a track is compared while its place
        is known this well. beside_m : nearer to the sensor than this it is taken for the sensor's own.
    gone_s, stays_s : plots in the same place between these times before and after one are background: by then what
        moves has gone. echo_m : added to the width over which they are counted. ring_share : share of the plots on
        either side in range whose density is that of the range.
    plot_rates : mean numbers of plots of a track in a scan that are averaged over. plot_scales : factors on the errors
        of plots that are tried. scale_limits, scale_prior : bounds of the factors that are fitted then, and the plots
        that the first one is worth.
    companion : probability that something else keeps its place beside a track: its vote saturates at 1/companion.
    many_tracks : where a scan may show more tracks than this, instants are compared instead.
    hull_prior : axes of tracks that the described extents are worth when they are learned.
    rate_prior : scans that the mean of plot_rates is worth. seen : a track is seen with more plots than this.

    fit_box_m, fit_box_sigmas : plots of two sources are compared where they differ by less than the first, or this many
        assumed σ. fit_scans : looks of two sources that are compared, at most.
    fit_correlation_s : looks within this time count as one: their errors last. fit_pairs : independent looks with pairs
        from which on errors are estimated.
    fit_sigmas : 1σ of the logarithms of assumed errors of ranges, of bearings, and of the wander over a hull.
    hull_sigma_m : median of the wander, that of a hull of 20 m in any direction. fit_least_m : least median of any.
    shared_hull : variance of what all sources of one place have in common, in that of the wander.
    fit_latencies : by which stamps may be late, in 1σ of their prior.
    fit_real, fit_begins : share of real pairs at first, and where EM begins, in 1σ of the prior from its medians.
    fit_steps, fit_settled : steps of EM, and the change of a logarithm that ends them.

    fault_prior, sure_fault : probability that a source has a fault of one kind, and that at which it is an alarm.
    fault_reports : fewest reports of a source that is judged. clock_jumps : jumps of a clock that are told at most.
    clock_speed_m_per_s, clock_gap_s, stamp_s : tracks as fast as this, reports at most so far apart, and the error of a
        sound stamp. clock_search_s : jumps that are looked for: from, to, step. clock_outlier, clock_vote : share of
        steps that say nothing, and the most that one can count.
    most_minutes, most_pauses, pause_prior : of a clock that is counted on from the seconds in messages: whole minutes
        that one pause may have lost, pauses that are mended, and the probability that there is one more.
    ended_s, ended_share : a source ends early by this much, and this share of the time. frozen_reports, repeats : least
        repetitions of a frozen track, and the probability that a moving one repeats a position.
    flood_s, flood_factor, flood_least : stretches that are counted, and what is more than usual.
    track_vote : the most that one track can count.

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

    azimuth_reach: float = 20.0
    azimuth_step_deg: float = 0.1
    azimuth_peaks: int = 8
    gate_sigmas: float = 3.5
    path_m: float = 100.0
    beside_m: float = 50.0
    gone_s: float = 40.0
    stays_s: float = 240.0
    echo_m: float = 15.0
    ring_share: float = 0.03
    plot_rates: tuple[float, ...] = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
    plot_scales: tuple[float, ...] = (1.0, 2.0)
    scale_limits: tuple[float, float] = (0.4, 4.0)
    scale_prior: float = 10.0
    companion: float = 3e-4
    many_tracks: float = 12.0
    hull_prior: float = 4.0
    rate_prior: float = 10.0
    seen: float = 3.0

    fit_box_m: float = 40.0
    fit_box_sigmas: float = 2.5
    fit_scans: int = 2000
    fit_correlation_s: float = 10.0
    fit_pairs: float = 5.0
    fit_sigmas: tuple[float, float, float] = (0.7, 0.35, 0.7)
    hull_sigma_m: float = 4.0
    fit_least_m: float = 1e-3
    shared_hull: float = 0.5
    fit_latencies: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
    fit_real: float = 0.3
    fit_begins: tuple[float, ...] = (0.0, -2.0)
    fit_steps: int = 200
    fit_settled: float = 1e-3

    fault_prior: float = 1e-3
    sure_fault: float = 0.95
    fault_reports: int = 20
    clock_jumps: int = 3
    clock_speed_m_per_s: float = 1.5
    clock_gap_s: float = 400.0
    stamp_s: float = 1.5
    clock_search_s: tuple[float, float, float] = (6.0, 181.0, 2.0)
    clock_outlier: float = 0.05
    clock_vote: float = 8.0
    most_minutes: int = 10
    most_pauses: int = 100
    pause_prior: float = 0.3
    ended_s: float = 60.0
    ended_share: float = 0.1
    frozen_reports: int = 3
    repeats: float = 0.02
    flood_s: float = 10.0
    flood_factor: float = 5.0
    flood_least: float = 50.0
    track_vote: float = 8.0

    doubt_instants: int = 5
    doubt_steps: int = 8
    nothing: float = 0.1
    much: float = 0.5
    guess_gain: float = 8.0
    near_extents: float = 3.0
    near_m: float = 50e3


DEFAULT_TUNING = Tuning()
