"""Named tracks: what a source's own name of an object is worth from one look to the next.

A source that names its objects (a radar's track numbers, an MMSI, an ICAO address) says of every look which earlier
ones it goes with. Its errors at two looks go together, too: a filter smooths over a minute, an antenna stays at its
place on the hull. With e the error of a track's position, R its covariance at a report, and P that of the report moved
to the instant,

    until the next look     e′ = e + n,    n ~ N(0, P′ − P), what its own motion leaves open;
    at a new look           e′ = G e + n,  G = Cᵀ P⁻¹,  n ~ N(0, P′ − G C),  C = ρ L L′ᵀ,  ρ = exp(−Δt/τ),

L and L′ being the roots of R at the two reports, and τ the source's correlation time
(:mod:`sameas.picture.error_correlation`). Of e a look shows how far the report is from where the last one foretold it:
ν = (G − 1) e + n. What all looks of the track say of e is kept as its mean and covariance, a Kalman filter;
:func:`sameas.picture.error_correlation.error_update` is one step.

Where a look is farther from what its own track foretold than one honest look in 10⁹, the name has changed its owner, or
the object moves as nobody expects: then the track begins anew, without a past.

Source: METHOD 1; autocorrelated errors of tracks as in Bar-Shalom, Li and Kirubarajan 2001, section 8.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.gate import ChiSquare
from sameas.gaussian import inverse
from sameas.picture.error_correlation import ErrorCorrelation, error_update, growth
from sameas.picture.object_table import ColumnTable
from sameas.picture.scan import Scan
from sameas.tracks.alignment import moved, stamped_late

#: How long a name that nobody says keeps its number.
KEPT_S = 3600.0
_NEVER = (-1, -np.inf)
#: A look farther than this share of honest ones from what its own track foretold begins the track anew.
FORETOLD = ChiSquare(1.0 - 1e-9)


@dataclass(frozen=True)
class Step(ColumnTable):
    """What became of tracks that are there at the last instant and at this one, (m,) each, by ascending number.

    last : (m, 2) where a track was put at the last instant. moved : (m, 2) the same report, moved to this instant.
    here : (m, 2) where its present report puts it, with its ``covariance`` P′.
    drift : (m, 2, 2) by which P grew. turn, fresh : G and the covariance of n at this step's look.
    looked : whether the source looked at it anew; without, turn is 1 and fresh 0. source : number of its source.
    log_own : ln p of that look by the track's own looks so far, 0 without.
    mean, spread : of e after it, by the track's own looks.
    """

    number: IntArray
    source: IntArray
    last: FloatArray
    moved: FloatArray
    here: FloatArray
    covariance: FloatArray
    drift: FloatArray
    turn: FloatArray
    fresh: FloatArray
    looked: BoolArray
    log_own: FloatArray
    mean: FloatArray
    spread: FloatArray

    def find(self, number: IntArray) -> IntArray:
        """(k,) where tracks stand in the step, −1 for those that are not in it."""
        return found_in(self.number, number)


@dataclass(frozen=True)
class NamedTracks:
    """The named tracks at an instant.

    Attributes
    ----------
    instant_s : the instant. given : numbers given so far.
    by_name : number of a track, and when it was in a scan last, by source and name.
    number : (m,) ascending. place : (m,) where its record stands in the scan of the instant.
    track_of_record : (n,) number of the track of every record of that scan, −1 for records without a name.
    mean, spread : (m, 2), (m, 2, 2) of e, by the track's own looks.
    lasting : for how long the errors of all sources so far last. source : (m,) which of them each track is of.
    """

    instant_s: float = -np.inf
    given: int = 0
    by_name: Mapping[tuple[str, str], tuple[int, float]] = field(default_factory=dict, repr=False)
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    place: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    track_of_record: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    mean: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    spread: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    scan: Scan | None = None
    error_correlation: ErrorCorrelation = field(default_factory=ErrorCorrelation)
    source: IntArray = field(default_factory=lambda: np.empty(0, np.int64))

    def numbers_on(self, scan: Scan) -> IntArray:
        """(n,) the number that each record's track has so far; −1 for records without a name, and for new names."""
        sources = [description.name for description in scan.now.descriptions]
        pairs = zip(scan.source.tolist(), scan.track.tolist(), strict=True)
        return np.array([self.by_name.get((sources[s], name), _NEVER)[0] for s, name in pairs], dtype=np.int64)

    def on(self, scan: Scan) -> tuple[NamedTracks, Step]:
        """The tracks of the next instant's scan, and the step to it.

        A track that is not in a scan keeps its number for :data:`KEPT_S`, but has no past when it comes back.
        """
        correlation = self.error_correlation.of_sources(scan)
        sources = [description.name for description in scan.now.descriptions]
        track_of_record = self.numbers_on(scan)
        place = np.flatnonzero(scan.track != "")
        names = [(sources[s], name) for s, name in zip(scan.source[place].tolist(), scan.track[place], strict=True)]
        number, source = track_of_record[place], correlation.numbers(scan)[scan.source[place]]
        known = np.flatnonzero((found_in(self.number, number) >= 0) & scan.placed[place])
        step, correlation = self._step(scan, number[known], place[known], source[known], correlation)
        began = number < 0
        number[began] = self.given + np.arange(np.count_nonzero(began))
        track_of_record[place] = number
        mean, spread = np.zeros((len(number), 2)), scan.covariance[place, :2, :2]
        at = step.find(number)
        mean[at >= 0], spread[at >= 0] = step.mean[at[at >= 0]], step.spread[at[at >= 0]]
        order = np.argsort(number)
        now_s = scan.now.instant_s
        kept = {name: said for name, said in self.by_name.items() if now_s - said[1] <= KEPT_S}
        by_name = kept | {name: (k, now_s) for name, k in zip(names, number.tolist(), strict=True)}
        tracks = NamedTracks(
            now_s, self.given + int(np.count_nonzero(began)), by_name, number[order], place[order], track_of_record,
            mean[order], spread[order], scan, correlation, source[order],
        )  # fmt: skip
        return tracks, step

    def _step(
        self, scan: Scan, number: IntArray, place: IntArray, source: IntArray, correlation: ErrorCorrelation
    ) -> tuple[Step, ErrorCorrelation]:
        """The step of known tracks, without those that begin anew, and what it tells of how long errors last."""
        before = self.scan if self.scan is not None else scan
        at = found_in(self.number, number)
        was = self.place[at]
        dt = scan.now.instant_s - before.time_s[was]
        state, spread = moved(
            before.reported_state[was], before.reported_covariance[was], dt, before.walk_m2_per_s3[was]
        )
        new, elapsed = scan.covariance[place, :2, :2], scan.time_s[place] - before.time_s[was]
        # A report of an earlier time than one already heard is no new look.
        fresh_look = elapsed > 0.0
        loose = np.where(fresh_look[:, None, None], before.loose[was], scan.loose[place])
        old = (stamped_late(spread, state, before.late_s[was]) + loose)[:, :2, :2]
        shift = scan.state[place, :2] - state[:, :2]
        one, other = before.reported_covariance[was, :2, :2], scan.reported_covariance[place, :2, :2]
        alike, k = _alike(one, other), np.flatnonzero(fresh_look)
        correlation = correlation.looked(
            source[k], elapsed[k], shift[k], ((one + other)[k], alike[k]), growth(old + new - one - other)[k]
        )
        common = correlation.rho(source, elapsed)[:, None, None] * alike
        turn = common.transpose(0, 2, 1) @ inverse(old)
        fresh = new - turn @ common
        drift = growth(old - before.covariance[was, :2, :2])
        mean, open_ = self.mean[at], self.spread[at] + drift
        after, narrowed, log_own, chi_sq = error_update(mean, open_, turn, fresh, shift)
        still = ~fresh_look[:, None, None]
        step = Step(
            number, source, before.state[was, :2], state[:, :2],
            state[:, :2] + np.where(fresh_look[:, None], shift, 0.0), np.where(still, old, new), drift,
            np.where(still, np.eye(2), turn), np.where(still, 0.0, fresh), fresh_look,
            np.where(fresh_look, log_own, 0.0), np.where(fresh_look[:, None], after, mean),
            np.where(still, open_, narrowed),
        )  # fmt: skip
        honest = ~fresh_look | (chi_sq <= FORETOLD.limit(2))
        return step.take(np.flatnonzero(honest)[np.argsort(number[honest])]), correlation


def found_in(ascending: IntArray, wanted: IntArray) -> IntArray:
    """(k,) where the wanted numbers stand among ascending ones, −1 for those that are not there."""
    if not len(ascending):
        return np.full(np.shape(wanted), -1)
    at = np.minimum(np.searchsorted(ascending, wanted), len(ascending) - 1)
    return np.where(ascending[at] == wanted, at, -1)


def _alike(old: FloatArray, new: FloatArray) -> FloatArray:
    """(n, 2, 2) L L′ᵀ: covariance of the errors of two reports of one track, if they are the same."""
    return np.asarray(np.linalg.cholesky(old) @ np.linalg.cholesky(new).transpose(0, 2, 1))
