"""Fixed parameters of tracks: of feeds, bias and error fits, faults and doubts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.registration.hough import DEFAULT_TUNING as REGISTRATION
from sameas.registration.hough import Tuning as RegistrationTuning


@dataclass(frozen=True)
class HeightTuning:
    """Fixed parameters of heights, chosen. Units are in the names.

    sigma_m : 1σ of a height without a stated error. climb_m_per_s : 1σ of an unknown vertical speed;
    reported_climb_m_per_s : of a reported one; climb_noise_m2_per_s3 : growth of its variance with age, so that an
    aircraft that climbs at 10 m/s may be level after a minute and a half.
    pressure_m, pressure_share : 1σ of the difference between pressure height and height above the ellipsoid if it is
    not estimated: at the ground, and as a share of the height.
    offset_m : 1σ of the offset between two sources of one kind.
    min_reports, min_span_m : minimum number of reports with both heights for a line, and minimum span of their heights
    for its gain.
    instants : number of instants at which sources are compared. max_pairs : maximum number of pairs.
    min_pairs : minimum number of pairs for an offset. share : minimum share of the records that agree with it.
    near : completeness of the gate of positions. min_m : minimum 1σ of an estimate.
    """

    sigma_m: float = 60.0
    climb_m_per_s: float = 8.0
    reported_climb_m_per_s: float = 1.5
    climb_noise_m2_per_s3: float = 1.0
    pressure_m: float = 250.0
    pressure_share: float = 0.04
    offset_m: float = 300.0
    min_reports: int = 20
    min_span_m: float = 2000.0
    instants: int = 32
    min_pairs: int = 5
    share: float = 0.5
    near: float = 0.999
    max_pairs: int = 3000
    min_m: float = 5.0


@dataclass(frozen=True)
class Tuning:
    """The fixed parameters of tracks, chosen unless a source is given.

    Units are in the names; shares, factors and probabilities have none.

    Attributes
    ----------
    unknown_site_share : assumed range of the targets of a radar without a site, as a share of its maximum range.
    platform_gap_s, platform_ahead_s : longest time between two positions of a vessel that carries a sensor, on whose
        line she is, and between a position and a report before the first or after the last. platform_heading_gap_s :
        the same between two headings. platform_course_m_per_s : lowest speed at which her course may be her heading.
    stray_count, stray_radii, stray_m : in a source of at least ``stray_count`` positions, those farther from the median
        than ``stray_m`` and than ``stray_radii`` × the radius of 90 % of them are excluded.
    unknown_velocity_share : a velocity is unknown if its variance is at least this share of the prior variance of
        velocities.
    timeout_quantile : the track timeout is this quantile of the gaps within tracks.
    stamp_step_s : tolerance of the track timeout for the rounding of stamps (ASTERIX: 1/128 s).
    stationary_timeout_s : minimum track timeout of a probably stationary object: two of the intervals at which vessels
        at anchor report (3 min: ITU-R M.1371-5, table 1).
    rest_s : mean time for which a stationary object stays so. alongside : speed of a vessel alongside, in that of one
        at anchor. drift_share, drift_m_per_s, drift_s : share of the moving objects that are adrift, their velocity (1σ
        per axis), and the time in which it changes: tidal streams reach 1 to 2 m/s and turn within hours, but a vessel
        waiting under engines corrects her drift every few minutes.
    at_rest : an object moves if the χ² of its velocity against 0 exceeds this quantile for objects at rest.
    repeat_sigmas : an object has left a repeated position if it moved farther than this many σ of that position since:
        below, the position is as good as others; rounding to a step of √12 σ cannot be seen either.
    max_speed_sigmas : maximum speed, in units of the typical speed of the source's objects (1σ per axis).
    stated_speeds : an object that states a speed may move at this multiple of it, whatever the maximum speed is.
    aircraft_share : tracks of another system are of aircraft if at least this share of its reports are.
    alternations : an id belongs to two objects if its reports change between their places at least this often; a single
        change is a repeated position or a reused id.
    support_intervals : a report supports another one of a second object of its id within so many usual intervals.
    position_sigmas : tolerance of positions, σ.

    rotation_search : the rotation period is searched within this share of the described one, by at most
        ``rotation_plots`` plots, with ``rotation_steps`` steps per resolvable frequency; then within ``rotation_far``
        times it.
    rotation_log_odds : minimum log-odds of a period against chance.
    rotation_unexplained : an antenna rotates if its rotation leaves less than this share of the scatter of bearings.
    pause_quantile : the pause of an antenna is this quantile of the gaps between its plots.
    exposure_gap, exposure_length : maximum gap between successive reports of one exposure, and its maximum length, as
        shares of the period.
    exposures_per_period, hurried_share : maximum number of exposures per period, and maximum share of exposures that
        follow the previous one in less than half the usual time.
    pointing_sigmas : a direction points at places within this many σ.

    innovation_ratio, min_innovations : reports are independent measurements if the median of their squared
        innovations is at least this share of that of independent errors; minimum number of innovations.
    new_track_probability : a report beyond the χ² limit that correct reports exceed with this probability restarts its
        track.

    innovation_memory, max_innovation : weight of the previous innovations of a track, per report, and the maximum of
        one, in σ, where a lag of its filter is detected.
    manoeuvre_probability : a lag is detected beyond the χ² limit that tracks without one exceed with this probability.
    manoeuvre_noise, manoeuvre_s : factor on the motion noise in a manoeuvre, and its length: 0.13 m/s² for a minute is
        100 times the noise assumed for ships, a turn at 0.26 g for a minute that for aircraft.

    common_instants, common_records : maximum number of instants at which two sources are compared, and maximum number
        of records at all of them; more records reduce the instants, down to ``min_instants``.
    skipped_share : share of the common time skipped at its start, when some objects have not reported yet.
    searched_instants, search_offsets, search_steps : instants of the bias search, offsets per instant, and iterations.
    widenings, n_candidates : factor on the errors, and number of candidates kept, for each iteration.
    step_tolerance, max_steps : the bias fit ends at steps below this share of a standard error, or after this many.
    same_sigmas : two solutions are one if no record moves between them by more than this many σ.
    min_information : minimum eigenvalue of the observed information relative to the complete one.
    moved_sigmas : instants are independent if records have moved by at least this many σ between them.
    delay_s : prior 1σ of a delay of the time stamps that a description does not mention (chosen).
    hull_along : 1σ of the mean of the antennas' places along the course, as a share of the described extents (chosen).
    registration : of the offset search at each instant; its ``decisive`` evidence establishes biases.

    azimuth_reach, azimuth_step_deg : the azimuth of bare plots is searched within this many prior widths, in steps.
    azimuth_peaks : maximum number of peaks of the search.
    gate_sigmas : gate of plots and tracks in range, σ. max_sigma_m : maximum 1σ of the position of a compared track.
    own_platform_m : tracks nearer to the sensor than this are excluded, as the sensor's own platform.
    background_from_s, background_to_s : plots at the same place, between these times before and after a plot, are
        background: a moving object has left the place by then. echo_m : added to the width within which they are
        counted. clutter_cell_m : width of the cells in which the clutter of a picture is counted.
    ring_share : the density of plots at a range is that of this share of the plots to either side of it in range.
    plot_rates : mean numbers of plots of a track per scan, averaged over. plot_spreads : trial factors on the errors of
        plots, with 1σ of the drift of the azimuth in degrees, if the sensor moves. scale_limits, scale_prior : bounds
        of the fitted factors, and weight of the trial factor, in plots.
    companion : probability that another object accompanies a track; it limits the evidence of one track to
        −ln companion.
    max_tracks : with more tracks than this in view, and more plots per scan, instants are compared instead.
    misread : prior probability that a radar's bearings are read wrongly in one of the ways that are tried.
        reading_step_deg : of their offsets, all around. reading_window_deg : plots farther than this from an offset are
        no evidence for it. reading_near_deg : an offset as given is compared at its best place within this.
        reading_plots : about the most plots used. reading_course_s : the course of a sensor that moves is that from so
        long before to so long after. reading_same_deg : bearings from the bow that differ by less from those with an
        offset are no other reading. reading_share, reading_tracks : an offset with pairs of a larger share of the
        records, and with more tracks, is not compared.
    hull_prior : weight of the described extents when they are estimated, in tracks. way_m_per_s : speed above which a
        hull lies along the course.
    rate_prior : weight of the median of plot_rates, in scans. min_plots : minimum number of plots of a detected track.
    station_m : 1σ per axis of the place of a moving sensor: its antenna is not that of the positioning (chosen).
    compass_moved_m : a sensor that moves at least so far has a drift of its azimuth (chosen, as the following).
        compass_knot_s, compass_knots : time between its knots, and their maximum number. compass_correlation_s,
        compass_limits_s : its expected correlation time, and the bounds of the fitted one. compass_deg, compass_prior :
        1σ expected of it, and the weight of both, in knots.
        compass_noted_deg : a larger drift is reported.

    fit_box_m, fit_box_sigmas : plots of two sources are compared if they differ by less than the first, or by this many
        assumed σ. fit_scans : maximum number of compared scans of two sources.
    fit_correlation_s : scans within this time count as one, since their errors are correlated. fit_pairs : minimum
        number of independent pairs for which errors are estimated.
    fit_sigmas : 1σ of the logarithms of the assumed errors: of ranges, of bearings, of the echo's place on the hull.
    hull_sigma_m : median of the latter, that of a hull of 20 m in any direction. fit_min_m : minimum of any median.
    shared_hull : share of the variance of the echo's place that is common to all sources at one place.
    fit_latencies : trial latencies, in 1σ of their prior.
    fit_real, fit_starts : initial share of real pairs, and starting points of EM, in 1σ of the prior from its medians.
    fit_bin_scans, fit_bins : least weight of a bin of ranges for miss rates, in independent scans, and most bins.
    fit_prior_scans : weight of the described miss rate in each, in scans.
    fit_steps, fit_tolerance : maximum number of EM iterations, and the change of a logarithm at which they end.
    crossing_scans, crossing_triples : about the maximum number of instants at which directions of three places are
        compared, and of their triples at one instant; an instant with more is left out. crossing_rivals : offsets are
        not estimated where a direction is in more triples than this beyond the first, in the mean.

    fault_prior, sure_fault : prior probability of a fault of one kind, and the probability at which it is an alarm.
    fault_reports : minimum number of reports of a tested source. clock_jumps : maximum number of jumps of a clock.
    clock_speed_m_per_s, clock_gap_s, stamp_s : minimum speed of the tracks used, maximum time between their reports,
        and 1σ of a correct time stamp. clock_search_s : trial jumps: from, to, step. clock_outlier, clock_vote : share
        of outliers among the steps of tracks, and maximum evidence of one step.
    leap_gap_s : most seconds that pass in truth from one line of a file to the next where its stamps leap.
    max_minutes, max_pauses, pause_prior : of a clock counted from the seconds in messages: maximum number of whole
        minutes lost in one pause, maximum number of corrected pauses, and probability that there is another one.
    ended_s, ended_share : a source has ended if it is silent for this time and this share of the whole time.
    frozen_reports, p_repeated : minimum number of repeated positions of a frozen track, and probability that a moving
        track repeats a position. track_vote : maximum evidence of one track.
    flood_s, flood_factor, flood_min : width of the intervals in which reports are counted, and a flood's minimum
        ratio to, and excess over, the usual count.

    doubt_instants, doubt_steps : compared instants, and iterations of the number of common objects.
    unrelated_share, guess_share : a source whose share of records with a partner is not above the first has nothing in
        common with another; a guess must reach the second.
    guess_gain : minimum gain of the log likelihood per instant by a guess, among some thirty guesses.
    fix_directions, fix_instants : least number of directions that place an emitter, and most instants at which it is.
    fix_share, fix_spread : 1σ of its place by the range, and scatter of the directions by their errors, at most.
    fix_correlation_s : errors of directions nearer in time count as one.
    tiny_range : ranges of a radar's plots up to this part of its reach are hardly metres.
    apart_m : sources farther apart than this, and than either is wide, are not of one area.
    near_extents, near_m : a guess of positions must bring a source to within this many extents of another, or metres.
    """

    unknown_site_share: float = 0.25
    platform_gap_s: float = 180.0
    platform_ahead_s: float = 10.0
    platform_heading_gap_s: float = 30.0
    platform_course_m_per_s: float = 1.5
    stray_count: int = 20
    stray_radii: float = 20.0
    stray_m: float = 20e3
    unknown_velocity_share: float = 0.9
    timeout_quantile: float = 0.999
    stamp_step_s: float = 0.01
    stationary_timeout_s: float = 360.0
    rest_s: float = 3600.0
    alongside: float = 0.1
    drift_share: float = 0.1
    drift_m_per_s: float = 0.5
    drift_s: float = 600.0
    at_rest: float = 1.0 - 1e-6
    repeat_sigmas: float = 2.0
    max_speed_sigmas: float = 5.0
    stated_speeds: float = 1.5
    aircraft_share: float = 0.5
    alternations: int = 4
    support_intervals: float = 10.0
    position_sigmas: float = 6.0

    rotation_search: float = 0.3
    rotation_far: float = 3.0
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

    innovation_ratio: float = 1.0 / 3.0
    min_innovations: int = 30
    new_track_probability: float = 1e-9
    innovation_memory: float = 0.8
    max_innovation: float = 3.0
    manoeuvre_probability: float = 1e-3
    manoeuvre_noise: float = 100.0
    manoeuvre_s: float = 60.0

    common_instants: int = 16
    common_records: int = 4000
    min_instants: int = 4
    skipped_share: float = 0.05
    searched_instants: int = 3
    search_offsets: int = 32
    search_steps: int = 20
    widenings: tuple[float, ...] = (2.0, 1.5, 1.2, 1.0, 1.0)
    n_candidates: tuple[int, ...] = (12, 8, 6, 4, 3)
    step_tolerance: float = 0.01
    max_steps: int = 40
    same_sigmas: float = 0.7
    min_information: float = 0.02
    moved_sigmas: float = 3.0
    delay_s: float = 5.0
    hull_along: float = 0.25
    registration: RegistrationTuning = REGISTRATION

    azimuth_reach: float = 20.0
    azimuth_step_deg: float = 0.1
    azimuth_peaks: int = 8
    gate_sigmas: float = 3.5
    max_sigma_m: float = 100.0
    own_platform_m: float = 50.0
    background_from_s: float = 40.0
    background_to_s: float = 240.0
    echo_m: float = 15.0
    clutter_cell_m: float = 100.0
    ring_share: float = 0.03
    plot_rates: tuple[float, ...] = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
    plot_spreads: tuple[tuple[float, float], ...] = ((1.0, 0.0), (2.0, 0.0), (1.0, 1.5), (1.0, 3.0))
    scale_limits: tuple[float, float] = (0.4, 4.0)
    scale_prior: float = 10.0
    companion: float = 3e-4
    max_tracks: float = 30.0
    misread: float = 0.01
    reading_step_deg: float = 1.0
    reading_window_deg: float = 12.0
    reading_near_deg: float = 2.0
    reading_plots: int = 5000
    reading_course_s: float = 15.0
    reading_same_deg: float = 6.0
    reading_share: float = 0.5
    reading_tracks: float = 4.0
    hull_prior: float = 2.0
    way_m_per_s: float = 1.0
    rate_prior: float = 10.0
    min_plots: float = 3.0
    station_m: float = 5.0
    compass_moved_m: float = 50.0
    compass_knot_s: float = 30.0
    compass_knots: int = 400
    compass_correlation_s: float = 60.0
    compass_limits_s: tuple[float, float] = (15.0, 600.0)
    compass_deg: float = 0.3
    compass_prior: float = 4.0
    compass_noted_deg: float = 0.5

    fit_box_m: float = 40.0
    fit_box_sigmas: float = 2.5
    fit_scans: int = 2000
    fit_correlation_s: float = 10.0
    fit_pairs: float = 5.0
    fit_sigmas: tuple[float, float, float] = (0.7, 0.35, 0.7)
    hull_sigma_m: float = 4.0
    fit_min_m: float = 1e-3
    shared_hull: float = 0.5
    fit_latencies: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
    fit_real: float = 0.3
    fit_starts: tuple[float, ...] = (0.0, -2.0)
    fit_steps: int = 200
    fit_bin_scans: float = 3.0
    fit_bins: int = 5
    fit_prior_scans: float = 2.0
    fit_tolerance: float = 1e-3
    crossing_scans: int = 300
    crossing_triples: int = 1000
    crossing_rivals: float = 0.5

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
    leap_gap_s: float = 60.0
    max_minutes: int = 10
    max_pauses: int = 100
    pause_prior: float = 0.3
    ended_s: float = 60.0
    ended_share: float = 0.1
    frozen_reports: int = 3
    p_repeated: float = 0.02
    flood_s: float = 10.0
    flood_factor: float = 5.0
    flood_min: float = 50.0
    track_vote: float = 8.0

    doubt_instants: int = 5
    doubt_steps: int = 8
    unrelated_share: float = 0.1
    guess_share: float = 0.5
    guess_gain: float = 8.0
    fix_directions: int = 10
    fix_instants: int = 40
    fix_share: float = 0.1
    fix_spread: float = 2.0
    fix_correlation_s: float = 10.0
    tiny_range: float = 0.002
    apart_m: float = 900e3
    near_extents: float = 3.0
    near_m: float = 50e3

    heights: HeightTuning = HeightTuning()

    @property
    def readings_deg(self) -> FloatArray:
        """The offsets of bearings all around."""
        return np.arange(-180.0, 180.0, self.reading_step_deg)

    def azimuth_limit_deg(self, width_deg: float) -> float:
        """The largest offset of the azimuth that is searched; ``width_deg`` : its prior 1σ."""
        return min(self.azimuth_reach * width_deg, 180.0)

    def is_known(self, variance: FloatArray, speed_m_per_s: float) -> BoolArray:
        """(n,) whether velocities with these variances per axis (n,) are known, of objects with 1σ of velocity per axis
        ``speed_m_per_s``."""
        return np.asarray(variance < self.unknown_velocity_share * speed_m_per_s**2)

    @property
    def drift_walk_m2_per_s3(self) -> float:
        """Random walk of the velocity of a vessel adrift."""
        return 2.0 * self.drift_m_per_s**2 / self.drift_s


DEFAULT_TUNING = Tuning()
