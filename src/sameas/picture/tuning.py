"""Tuning of the picture: every number in it that was chosen, as one value that :class:`Watch` and trackers take."""

from __future__ import annotations

from dataclasses import dataclass

from sameas.gate import ChiSquare
from sameas.gate import Tuning as GateTuning

#: The gate of an instant: up to some thousands of records in the plane one sweep is faster than a layout of zones.
GATE = ChiSquare(tuning=GateTuning(each_with_each=4096))


@dataclass(frozen=True)
class Tuning:
    """The chosen numbers of the picture; none is measured. Units are in the names; shares and probabilities have none.

    Attributes
    ----------
    unknown_velocity_share : a velocity is unknown where its variance is at least this share of that of any object's
        velocity. It is below 1, since taking a range bias off changes an unmeasured velocity by some percent.
    ambiguous_below : an object is ambiguous where its records are less probable than this.
    explained_rival : a rival less probable than this gives no new explanation.
    explained_change : a probability that changes by more than this does.
    crossing_share : directions cross where they leave the object less than this share of the region's width.

    manoeuvre_chi_sq : a report farther than this χ² from its prediction is of a manoeuvre and does not measure errors;
        the limit of 1 in 1000 for two degrees of freedom.
    correlation_s : error correlation times τ that are weighed, in seconds; near enough to each other that what a time
        between two of them leaves is not taken for a share that lasts.
    correlation_sigma : 1σ of ln(τ + 1 s) about that of the source's kind, before its reports say more.
    lasting_shares : shares of the variance of a source's errors that may last, each as probable before pairs show more.
    lasting_s : time between two looks at a sure pair of tracks that show what of its errors lasts. sure_pair : a pair
        is sure from this probability on.
    known_offsets : a mean offset of two tracks is known from this many differences ``lasting_s`` apart on.
    offset_freedom : degrees of freedom for which the stated errors count beside the offsets of sure pairs, and
        most_offset_freedom : for which these count at most, since hulls differ. offset_anew : a mean offset begins
        anew where the pair does with at least this probability.
    error_factors : factors of stated errors that are weighed, about 1. errors_as_stated : prior probability that errors
        are as stated. error_factor_sigma : 1σ of ln f of others before sure pairs show more. factor_outliers : share of
        differences of sure pairs that may be anything within factor_outlier times their errors.
    convoy_log_odds : bound of the log-odds that two objects are in convoy, so that later reports can change them.
    swap_rates : probabilities h that a tracker has swapped two objects at one place, per report, that are weighed.
    swap_caution : a swap counts as so many times as probable as estimated.
    swap_rate, swap_sigma : median and 1σ of ln h before reports say more. swap_chi_sq : h falls with e^(−χ²/this).
    motion_shares : shares of the largest motion noise that are weighed, each as probable.
    new_track_probability : a track begins anew beyond the χ² limit that this share of correct reports exceeds.
    id_timeout_s : a track id that is not reported keeps its number for this long.
    manoeuvre_every_s : mean time between two manoeuvres of an object.
    pair_timeout_s : two tracks are not compared any more when their positions have not agreed for this long.
    parted_chi_sq, parted_s : they are not compared while they are apart by more than this χ², once their positions have
        not agreed for so long; what was known of them then counts when they meet again.
    partner_odds : two tracks may be partners until strangers are this many times more probable by their positions.
    search_s : longest search for the best partition of one group, in seconds.

    id_reassigned : probability that a report of a track is another object's, when objects are matched over time.
    unique_id_odds : factor on the odds of a match whose tracks share an id that no other object has.
    new_share : share of the objects of an instant that may be new.
    history_s : time constant of the shares of a track's history.
    least_share : smaller shares of a track's history are dropped.
    own_share : an object that split off another is confirmed once its tracks were its own for this share of the time.

    false_scans, false_weight : mean life of false tracks in scans, before any has ended, and its weight in tracks.
    real_s, real_weight : mean life of real tracks in seconds, before any has ended, and its weight in tracks.
    prior_tracks : tracks that every source counts as seen before: real (first row) and false, there at its first
        scan and begun later. Of those that begin later most are false.
    period_s : time between two scans of a source that is not described.
    em_steps : steps of EM at an instant; they continue from the last instant.

    split : probability that a scan shows one object as two, where neither the description nor the kind has it.
    forgotten : objects of bare plots that are less probable than this are dropped.
    region_factor : factor on the region's covariance for the states of objects that are known already.
    least_probability : probabilities of existence stay this far from 0 and 1, so that later scans can change them.
    separate_log_odds : bound of the log-odds by scans that two objects are two.
    merging_log_odds : two objects are merged at these log-odds.
    different : two objects are two whatever the scans say beyond the χ² limit that this share of equal ones passes.
    same_state : states of two objects agree within the χ² limit that holds this share of equal ones.
    joint_scan_share : scans within this share of the shortest period are processed together.
    confirming_plots : an object that no scan shows now is confirmed with this many plots or more.

    known_instants : instants for which two tracks were one object before their parting means anything.
    known_reports : reports of a track before its silence does.
    apart_sigmas, apart_instants : two tracks are apart beyond this many σ, at this many instants or more.
    dragged_odds, swap : odds that the places of one that names itself are false, against a sensor's tracker that went
        over to another ship, and the probability of the latter for each further sensor. empty_vote : the most that one
        sensor counts which shows nothing where a track says it is.
    silent_s, silent_odds : a silence is at least this long, and its odds before it is seen. sure_deception :
        probability at which either is an alarm.

    fewest_due : below this many expected detections the summary gives no miss rate.
    stretches : stretches of the picture by whose differences a miss rate's standard error is estimated.
    """

    unknown_velocity_share: float = 0.9
    ambiguous_below: float = 0.95
    explained_rival: float = 1e-3
    explained_change: float = 0.02
    crossing_share: float = 0.2

    manoeuvre_chi_sq: float = 13.8
    correlation_s: tuple[float, ...] = (
        0.0, 2.0, 3.0, 5.0, 8.0, 12.0, 18.0, 27.0, 40.0, 60.0, 90.0, 135.0, 200.0, 300.0, 450.0, 700.0, 1100.0
    )  # fmt: skip
    correlation_sigma: float = 3.0
    lasting_shares: tuple[float, ...] = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97)
    lasting_s: float = 60.0
    sure_pair: float = 0.999
    known_offsets: int = 3
    offset_freedom: float = 4.0
    most_offset_freedom: float = 30.0
    offset_anew: float = 0.1
    error_factors: tuple[float, ...] = tuple(2.0 ** (k / 4.0) for k in range(-8, 9))
    errors_as_stated: float = 0.5
    error_factor_sigma: float = 0.5
    factor_outliers: float = 0.01
    factor_outlier: float = 10.0
    convoy_log_odds: float = 5.0
    swap_rates: tuple[float, ...] = (1e-5, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3)
    swap_caution: float = 3.0
    swap_rate: float = 1e-3
    swap_sigma: float = 2.0
    swap_chi_sq: float = 8.0
    motion_shares: tuple[float, ...] = (1.0, 0.1, 0.01)
    new_track_probability: float = 1e-9
    id_timeout_s: float = 3600.0
    manoeuvre_every_s: float = 600.0
    pair_timeout_s: float = 900.0
    parted_chi_sq: float = 60.0
    parted_s: float = 20.0
    partner_odds: float = 20.0
    search_s: float = 10.0

    id_reassigned: float = 1e-3
    unique_id_odds: float = 1e7
    new_share: float = 0.05
    history_s: float = 300.0
    least_share: float = 1e-3
    own_share: float = 0.8

    false_scans: float = 4.0
    false_weight: float = 4.0
    real_s: float = 1800.0
    real_weight: float = 1.0
    prior_tracks: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 1.0), (1.0, 3.0))
    period_s: float = 10.0
    em_steps: int = 4

    split: float = 0.02
    forgotten: float = 0.01
    region_factor: float = 1e4
    least_probability: float = 1e-6
    separate_log_odds: float = 5.0
    merging_log_odds: float = 3.0
    different: float = 1.0 - 1e-6
    same_state: float = 0.99
    joint_scan_share: float = 0.2
    confirming_plots: int = 3

    known_instants: int = 5
    known_reports: int = 5
    apart_sigmas: float = 5.0
    apart_instants: int = 3
    dragged_odds: float = 0.1
    swap: float = 0.01
    empty_vote: float = 6.0
    silent_s: float = 60.0
    silent_odds: float = 0.01
    sure_deception: float = 0.95

    fewest_due: int = 20
    stretches: int = 12


DEFAULT_TUNING = Tuning()
