"""Chosen numbers of the picture that a user may change, for :class:`sameas.picture.Watch` and trackers.

Others are constants beside their use.
"""

from __future__ import annotations

from dataclasses import dataclass

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
    """Chosen numbers of the picture; none is measured. Units are in the names; shares and probabilities have none.

    Attributes
    ----------
    correlation_s : grid of error correlation times τ in seconds; dense enough that a τ between two grid points does not
        appear as a lasting share.
    lasting_shares : grid of lasting shares of the variance of a source's errors; the prior is uniform.
    memory_every_s : the memory of tracks takes in reports at steps of at least this. Errors have a part that is new in
        every report beside one that decays, and the model has one of them: at steps of 3 s the pairs of ships stated
        with 0.8 to 0.95 are right less often by 0.075, at steps of 10 s by 0.02.
    convoy_log_odds : bound of the log-odds that two objects are in convoy, so that later reports can change them.
    id_timeout_s : a track id without reports keeps its number for this long. return_s : so does one of a source whose
        objects name themselves (MMSI, ICAO address): an object that returns within it has its number again.
        most_absent : largest number of ids without reports that are kept, those absent for longest are forgotten first.
    pair_timeout_s : two tracks are dropped as a pair when their positions have not agreed for this long.
    distant_chi_sq : two tracks are not compared while their χ² is above this.
    report_reassigned : probability ε that a report is of another object than that of its id; for a radar of 20
        rotations a minute once in eight hours.
    history_s : time constant of the shares of a track's history.
    separate_log_odds : bound of the log-odds, by scans, that two objects are separate.
    scan_every_s, scan_steps : beside named tracks, the scans of plots between two instants are taken in at steps of at
        least the first, and at most so many of them, the last ones.
    min_instants : minimum number of instants at which two tracks were one object, to find deception.
    """

    correlation_s: tuple[float, ...] = (
        0.0, 2.0, 3.0, 5.0, 8.0, 12.0, 18.0, 27.0, 40.0, 60.0, 90.0, 135.0, 200.0, 300.0, 450.0, 700.0, 1100.0
    )  # fmt: skip
    lasting_shares: tuple[float, ...] = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97)
    memory_every_s: float = 10.0
    convoy_log_odds: float = 5.0
    id_timeout_s: float = 3600.0
    return_s: float = 86_400.0
    most_absent: int = 10_000
    pair_timeout_s: float = 900.0
    distant_chi_sq: float = 60.0
    report_reassigned: float = 1e-4
    history_s: float = 300.0
    separate_log_odds: float = 5.0
    scan_every_s: float = 1.0
    scan_steps: int = 60
    min_instants: int = 5


DEFAULT_TUNING = Tuning()
