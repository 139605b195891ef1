"""Tuning of the picture: all chosen numbers, as one value for :class:`sameas.picture.Watch` and trackers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sameas.arrays import FloatArray
from sameas.gate import ChiSquare
from sameas.gate import Tuning as GateTuning
from sameas.many.sets import ManyTuning

#: The gate of an instant: for up to some thousands of records in the plane, one sweep is faster than zones.
GATE = ChiSquare(tuning=GateTuning(brute_force_records=4096))

#: Work limits of an instant. In crowded pictures (500 objects, 0.1 others within σ) the excluded sets change
#: probabilities by at most 5e-4; a first cut of 20, with 6 for the largest groups as well, takes twice as long. A walk
#: takes a tenth of a second and more.
LIVE = ManyTuning(cuts=(10.0, 8.0, 6.0, 4.0, 2.0, 1.0), block_steps=10_000, walked_below=0.0)


@dataclass(frozen=True)
class Tuning:
    """The chosen numbers of the picture; none is measured. Units are in the names; shares and probabilities have none.

    Attributes
    ----------
    unknown_velocity_share : a velocity is unknown if its variance is at least this share of the prior variance of
        velocities. It is below 1, since correcting a range bias changes an unmeasured velocity by some percent.
    ambiguous_below : an object is ambiguous if its probability is below this.
    explained_rival : a new rival is explained only if its probability is above this.
    explained_change : a change of probability is explained only if it is larger than this.
    crossing_share : directions cross if the object's 1σ is below this share of that of the region.
        crossing_existence : a new object begins at a crossing of at least this probability, which is at least the share
        clear_crossing of that of all crossings of its directions. current_weight : of directions that will be used
        again, in the position at which it begins.

    manoeuvre_chi_sq : a report with a larger χ² from its prediction is of a manoeuvre and not used to estimate errors;
        the limit of 1 in 1000 for two degrees of freedom.
    correlation_s : grid of error correlation times τ in seconds; dense enough that a τ between two grid points does not
        appear as a lasting share.
    correlation_sigma : prior 1σ of ln(τ + 1 s) about that of the source's kind. correlation_restart : change of ln of a
        source's error factor beyond which its error correlation is estimated anew.
    lasting_shares : grid of lasting shares of the variance of a source's errors; the prior is uniform.
    memory_every_s : the memory of tracks takes in reports at steps of at least this. Errors have a part that is new in
        every report beside one that decays, and the model has one of them: at steps of 3 s the pairs of ships stated
        with 0.8 to 0.95 are right less often by 0.075, at steps of 10 s by 0.02. memory_steps : at most this many
        between two instants.
    lasting_restart : evidence on pairs that was weighed by a share lower by this than the present one is dropped.
    lasting_s : time between two comparisons of a sure pair, to estimate lasting shares. sure_pair : a pair is sure at
        or above this probability.
    min_offsets : a mean offset of two tracks is used from this many differences ``lasting_s`` apart on.
    offset_freedom : prior weight of the stated errors against the offsets of sure pairs, in degrees of freedom;
        max_offset_freedom : maximum weight of the latter, since hulls differ. offset_restart : a mean offset restarts
        if the ids were swapped or reassigned with at least this probability.
    error_factors : grid of factors on stated errors, about 1. errors_as_stated : prior probability that errors are as
        stated. error_factor_sigma : prior 1σ of ln f otherwise. errors_new : prior probability that the errors of a
        source are new in every report, where factors are estimated from single tracks. factor_outliers : share of
        differences of sure pairs that are outliers, with factor_outlier times their errors.
    convoy_log_odds : bound of the log-odds that two objects are in convoy, so that later reports can change them.
    swap_rates : grid of probabilities h, per report, that a tracker swaps two objects at one place.
    swap_ranges : grid of c, where h decreases with the distance as e^(−χ²/c); the prior is uniform.
    swap_rate, swap_sigma : prior median of h and 1σ of ln h.
    motion_shares : grid of shares of the largest motion noise; the prior is uniform.
    new_track_probability : a track restarts beyond the χ² limit that this share of correct reports exceeds.
    id_timeout_s : a track id without reports keeps its number for this long. return_s : so does one of a source whose
        objects name themselves (MMSI, ICAO address): an object that returns within it has its number again.
        most_absent : largest number of ids without reports that are kept, those absent for longest are forgotten first.
    manoeuvre_every_s : mean time between two manoeuvres of an object.
    pair_timeout_s : two tracks are dropped as a pair when their positions have not agreed for this long.
    distant_chi_sq, distant_s : two tracks are not compared while their χ² is above the first, once their positions have
        not agreed for the second; their history is kept for when they are near again.
    partner_odds : two tracks may be partners unless their positions make chance this many times more probable.

    report_reassigned : probability ε that a report is of another object than that of its id; for a radar of 20
        rotations a minute once in eight hours.
    id_reassigned : probability that a report of a track is of another object, when objects are matched over time.
    unique_id_odds : factor on the odds of a match whose tracks share a unique id.
    new_share : share of the objects of an instant that may be new.
    history_s : time constant of the shares of a track's history.
    min_share : smaller shares of a track's history are dropped.
    own_share : an object that split off another is confirmed once its tracks were its own for this share of the time.

    false_scans, false_weight : prior mean duration of false tracks in scans, and its weight in tracks.
    real_s, real_weight : prior mean duration of real tracks in seconds, and its weight in tracks.
    prior_tracks : pseudo-counts of tracks per source: real (first row) and false, present at its first scan and begun
        later. Most tracks that begin later are false.
    period_s : time between two scans of a source whose description has none.
    em_steps : EM iterations per instant; they continue from the previous instant.

    split : probability that a scan shows one object as two, if neither the description nor the kind has it.
    min_existence, min_share_of_initial : objects of plots without ids are dropped below the first probability and below
        this share of that with their first scan: among much clutter the first plot of a real object is below the first.
    likely_member : a record updates the state of an object that may not exist if, in case it does, the record is its
        with this probability.
    region_factor : factor on the region's covariance for the states of objects that are already tracked.
    min_probability : probabilities of existence are clipped to this distance from 0 and 1, so that later scans can
        change them.
    separate_log_odds : bound of the log-odds, by scans, that two objects are separate.
    merging_log_odds : two objects are merged at these log-odds.
    different_quantile : two objects are separate, whatever the scans show, beyond the χ² limit with this share of equal
        ones below it.
    same_quantile : states of two objects agree within the χ² limit that includes this share of equal ones.
    joint_scan_share : scans within this share of the shortest period are processed together.
    confirming_plots : a tracked object is confirmed only with at least this many plots.
    scan_every_s, scan_steps : beside named tracks, the scans of plots between two instants are taken in at steps of at
        least the first, and at most so many of them, the last ones.
    least_q : beside named tracks, the probability that a source of plots misses an object is within this of 0 and 1:
        misses of one object come in runs. rate_looks : weight of an assumed miss rate, in looks at objects.
    own_looks, own_looks_kept : weight of the usual misses beside an object's own, and number of its last looks that
        count.
    clutter_s, most_plots, clutter_sigmas : the clutter about a plot is counted over this time, or that of so many
        plots, within so many 1σ of its position. around_sigmas : echoes within these are beside it, as on a shore.
        dense_share : prior probability that the clutter at a place is denser than elsewhere.
    hull_m, hull_plots : plots within this of an object with a name may be of its hull; number of plots that show it.

    min_instants : minimum number of instants at which two tracks were one object, to find deception.
    min_reports : minimum number of reports of a track, to find its silence.
    jump_reports : minimum number of reports of a track before and after a jump.
    apart_sigmas, apart_instants : two tracks are apart beyond this many σ, at this many instants or more.
        tracker_lag_s : 1σ of the time by which a sensor's tracker follows the path of a ship late.
    false_position_odds, sensor_swap : prior odds that reported positions are false, against a swap of the sensor's
        track to another ship; and the probability of such a swap for each further sensor. empty_vote : maximum evidence
        of one sensor without a detection at the reported position.
    silent_s, silent_odds : minimum duration of a silence, and its prior odds. sure_deception : probability at which
        either is an alarm.

    look_s, min_looks : one look of a radar at a ship lasts this long; a ship with fewer looks is no phantom yet.
    covered_q : places at which the described probability of a miss is as high are not covered.
    under_way_m_per_s : least speed of vessels, and of aircraft, that a radar is expected to see: those at rest are
        among the returns of land.
    near_share : a radar sees a ship within this share of her range, besides the errors of both: its biases may be
        unknown. turned_deg : angles about the radar of the places that give the rate of chance.
    sight_deg, sight_between_deg, sight_height_m : a place is seen if another ship within the first angle of it is, or
        one on either side within the second, in layers of the third for aircraft.
    sight_moves_m : a radar that moves farther is on a ship.
    comparable_ships : least number of ships that a radar sees, at a range and altogether. range_bins : of its rate.
    steel_m, steel_share : shorter hulls are not expected to be seen, and longer ones are never seen this many times as
        often as those of unknown length. detectabilities : number of steps of d.
    mean_detectabilities, detectability_widths : grids of the mean and of a + b of the Beta distribution of d; the prior
        is uniform. hidden_share, invented_share : a and b of the Beta priors of h and θ.
    invented_odds : prior odds that any ship is invented.

    min_expected : the summary gives a miss rate from this many expected detections on.
    blocks : number of blocks of successive instants from whose scatter a miss rate's standard error is estimated.
    """

    unknown_velocity_share: float = 0.9
    ambiguous_below: float = 0.95
    explained_rival: float = 1e-3
    explained_change: float = 0.02
    crossing_share: float = 0.2
    crossing_existence: float = 0.3
    clear_crossing: float = 0.8
    current_weight: float = 0.01

    manoeuvre_chi_sq: float = 13.8
    correlation_s: tuple[float, ...] = (
        0.0, 2.0, 3.0, 5.0, 8.0, 12.0, 18.0, 27.0, 40.0, 60.0, 90.0, 135.0, 200.0, 300.0, 450.0, 700.0, 1100.0
    )  # fmt: skip
    correlation_sigma: float = 3.0
    correlation_restart: float = 0.2
    lasting_shares: tuple[float, ...] = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97)
    memory_every_s: float = 10.0
    memory_steps: int = 60
    lasting_restart: float = 0.25
    lasting_s: float = 60.0
    sure_pair: float = 0.999
    min_offsets: int = 3
    offset_freedom: float = 4.0
    max_offset_freedom: float = 30.0
    offset_restart: float = 0.1
    error_factors: tuple[float, ...] = tuple(2.0 ** (k / 4.0) for k in range(-8, 9))
    errors_as_stated: float = 0.5
    error_factor_sigma: float = 0.5
    errors_new: float = 0.1
    factor_outliers: float = 0.01
    factor_outlier: float = 10.0
    convoy_log_odds: float = 5.0
    swap_rates: tuple[float, ...] = (1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.3)
    swap_ranges: tuple[float, ...] = (1.5, 4.0)
    swap_rate: float = 3e-4
    swap_sigma: float = 2.0
    motion_shares: tuple[float, ...] = (1.0, 0.1, 0.01)
    new_track_probability: float = 1e-9
    id_timeout_s: float = 3600.0
    return_s: float = 86_400.0
    most_absent: int = 10_000
    manoeuvre_every_s: float = 600.0
    pair_timeout_s: float = 900.0
    distant_chi_sq: float = 60.0
    distant_s: float = 20.0
    partner_odds: float = 20.0

    report_reassigned: float = 1e-4
    id_reassigned: float = 1e-3
    unique_id_odds: float = 1e7
    new_share: float = 0.05
    history_s: float = 300.0
    min_share: float = 1e-3
    own_share: float = 0.8

    false_scans: float = 4.0
    false_weight: float = 4.0
    real_s: float = 1800.0
    real_weight: float = 1.0
    prior_tracks: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 1.0), (1.0, 3.0))
    period_s: float = 10.0
    em_steps: int = 4

    split: float = 0.02
    min_existence: float = 0.01
    min_share_of_initial: float = 0.1
    likely_member: float = 0.9
    region_factor: float = 1e4
    min_probability: float = 1e-6
    separate_log_odds: float = 5.0
    merging_log_odds: float = 3.0
    different_quantile: float = 1.0 - 1e-6
    same_quantile: float = 0.99
    joint_scan_share: float = 0.2
    confirming_plots: int = 3
    scan_every_s: float = 1.0
    scan_steps: int = 60
    least_q: float = 0.1
    rate_looks: float = 10.0
    own_looks: float = 6.0
    own_looks_kept: float = 24.0
    clutter_s: float = 300.0
    most_plots: int = 20_000
    clutter_sigmas: float = 2.0
    around_sigmas: float = 6.0
    dense_share: float = 0.1
    hull_m: float = 200.0
    hull_plots: float = 3.0

    min_instants: int = 5
    min_reports: int = 5
    jump_reports: int = 3
    apart_sigmas: float = 5.0
    apart_instants: int = 3
    tracker_lag_s: float = 5.0
    false_position_odds: float = 0.1
    sensor_swap: float = 0.01
    empty_vote: float = 6.0
    silent_s: float = 60.0
    silent_odds: float = 0.01
    sure_deception: float = 0.95

    look_s: float = 30.0
    min_looks: int = 6
    covered_q: float = 0.9
    under_way_m_per_s: tuple[float, float] = (1.5, 40.0)
    near_share: float = 0.01
    turned_deg: tuple[float, ...] = (-75.0, -45.0, -25.0, 25.0, 45.0, 75.0)
    sight_deg: float = 3.0
    sight_between_deg: float = 8.0
    sight_height_m: float = 1000.0
    sight_moves_m: float = 200.0
    comparable_ships: int = 4
    range_bins: int = 5
    steel_m: float = 20.0
    steel_share: float = 0.2
    detectabilities: int = 50
    mean_detectabilities: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98)
    detectability_widths: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
    hidden_share: tuple[float, float] = (0.5, 200.0)
    invented_share: tuple[float, float] = (1.0, 3.0)
    invented_odds: float = 0.1

    min_expected: int = 20
    blocks: int = 12

    @cached_property
    def swap_models(self) -> tuple[FloatArray, FloatArray]:
        """(r,), (r,) h and c of every model of swaps: each rate with each range."""
        rates, ranges = np.array(self.swap_rates), np.array(self.swap_ranges)
        return np.tile(rates, len(ranges)), np.repeat(ranges, len(rates))


DEFAULT_TUNING = Tuning()
