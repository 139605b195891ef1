"""Named tracks: what a source's own name of an object is worth from one look to the next.

A source that names its objects (a radar's track numbers, an MMSI, an ICAO address) says of every look which earlier
ones it goes with. Its errors at two looks go together, too: a filter smooths over a minute, an antenna stays at its
place on the hull. With e the error of a track's position, R its covariance at a report, and P that of the report moved
to the instant,

    until the next look     e′ = e + n,    n ~ N(0, P′ − P), what its own motion leaves open;
    at a new look           e′ = G e + n,  G = Cᵀ P⁻¹,  n ~ N(0, P′ − G C),  C = ρ L L′ᵀ,  ρ = exp(−Δt/τ),

L and L′ being the roots of R at the two reports, and τ the source's correlation time (:data:`CORRELATION_S`). Of e a
look shows how far the report is from where the last one foretold it: ν = (G − 1) e + n. What all looks of the track say
of e is kept as its mean and covariance, a Kalman filter; :func:`looked` is one step of it.

Where a look is farther from what its own track foretold than one honest look in 10⁹, the name has changed its owner, or
the object moves as nobody expects: then the track begins anew, without a past.

Source: METHOD 1; autocorrelated errors of tracks as in Bar-Shalom, Li and Kirubarajan 2001, section 8.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np

from sameas.evidence import LOG_2PI
from sameas.gate import ChiSquare
from sameas.picture.roll import BoolArray, Roll
from sameas.records import FloatArray, IntArray
from sameas.tracks.alignment import moved, stamped_late

#: τ by kind of source: how long an error of position lasts, in seconds. Taken, not measured.
CORRELATION_S: Mapping[str, float] = {
    "marine radar": 60.0,  # what such a radar names it has smoothed, for a minute or so
    "air radar": 5.0,  # every turn measures anew
    "ais": 600.0,  # the antenna stays where it is on the hull, and a receiver's error drifts over minutes
    "ads-b": 600.0,  # a receiver's error drifts over minutes
    "mlat": 30.0,  # the same receivers for a while
    "lidar": 10.0,  # the same side of the hull for a while
    "camera": 10.0,  # the same side of the hull for a while
    "esm": 10.0,
    "tracks": 60.0,  # smoothed
    "other": 60.0,
}
#: How long a name that nobody says keeps its number.
KEPT_S = 3600.0
_NEVER = (-1, -np.inf)
#: Least variance of a step, m²: keeps what is certain invertible.
LEAST_M2 = 1e-6
#: A look farther than this share of honest ones from what its own track foretold begins the track anew.
FORETOLD = ChiSquare(1.0 - 1e-9)


@dataclass(frozen=True)
class Step:
    """What became of tracks that are there at the last instant and at this one, (m,) each, by ascending number.

    last : (m, 2) where a track was put at the last instant. moved : (m, 2) the same report, moved to this instant.
    here : (m, 2) where its present report puts it, with its ``covariance`` P′.
    drift : (m, 2, 2) by which P grew. turn, fresh : G and the covariance of n at this step's look.
    looked : whether the source looked at it anew; without, turn is 1 and fresh 0.
    log_own : ln p of that look by the track's own looks so far, 0 without.
    mean, spread : of e after it, by the track's own looks.
    """

    number: IntArray
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

    def take(self, which: IntArray) -> Step:
        """Some of the tracks."""
        return Step(*(getattr(self, f.name)[which] for f in fields(self)))


@dataclass(frozen=True)
class NamedTracks:
    """The named tracks at an instant.

    Attributes
    ----------
    instant_s : the instant. given : numbers given so far.
    by_name : number of a track, and when it was on a roll last, by source and name.
    number : (m,) ascending. place : (m,) where its record stands on the roll of the instant.
    on_roll : (n,) number of the track of every record of that roll, −1 for records without a name.
    mean, spread : (m, 2), (m, 2, 2) of e, by the track's own looks.
    """

    instant_s: float = -np.inf
    given: int = 0
    by_name: Mapping[tuple[str, str], tuple[int, float]] = field(default_factory=dict, repr=False)
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    place: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    on_roll: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    mean: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    spread: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    roll: Roll | None = None

    def on(self, roll: Roll, correlation_s: Mapping[str, float]) -> tuple[NamedTracks, Step]:
        """The tracks of the next instant's roll, and the step to it.

        A track that is not on a roll keeps its number for :data:`KEPT_S`, but has no past when it comes back.
        """
        sources = [description.name for description in roll.now.descriptions]
        taus = np.array([correlation_s.get(d.name, CORRELATION_S[d.kind]) for d in roll.now.descriptions])
        named = [k for k in range(len(roll)) if roll.track[k]]
        names = [(sources[roll.source[k]], roll.track[k]) for k in named]
        place = np.array(named, dtype=np.int64)
        number = np.array([self.by_name.get(name, _NEVER)[0] for name in names], dtype=np.int64)
        known = np.flatnonzero((found_in(self.number, number) >= 0) & roll.placed[place])
        step = self._step(roll, number[known], place[known], taus[roll.source[place[known]]])
        began = number < 0
        number[began] = self.given + np.arange(np.count_nonzero(began))
        on_roll = np.full(len(roll), -1)
        on_roll[place] = number
        mean, spread = np.zeros((len(number), 2)), roll.covariance[place, :2, :2]
        at = step.find(number)
        mean[at >= 0], spread[at >= 0] = step.mean[at[at >= 0]], step.spread[at[at >= 0]]
        order = np.argsort(number)
        now_s = roll.now.instant_s
        kept = {name: said for name, said in self.by_name.items() if now_s - said[1] <= KEPT_S}
        by_name = kept | {name: (k, now_s) for name, k in zip(names, number.tolist(), strict=True)}
        tracks = NamedTracks(
            now_s, self.given + int(np.count_nonzero(began)), by_name, number[order], place[order], on_roll,
            mean[order], spread[order], roll,
        )  # fmt: skip
        return tracks, step

    def _step(self, roll: Roll, number: IntArray, place: IntArray, tau_s: FloatArray) -> Step:
        """The step of known tracks, without those that begin anew."""
        before = self.roll if self.roll is not None else roll
        at = found_in(self.number, number)
        was = self.place[at]
        dt = roll.now.instant_s - before.time_s[was]
        state, spread = moved(before.said_state[was], before.said_covariance[was], dt, before.walk_m2_per_s3[was])
        old = stamped_late(spread, state, before.late_s[was])[:, :2, :2]
        new, elapsed = roll.covariance[place, :2, :2], roll.time_s[place] - before.time_s[was]
        # A report of an earlier time than one already heard is no new look.
        fresh_look = elapsed > 0.0
        common = _common(before.said_covariance[was, :2, :2], roll.said_covariance[place, :2, :2], elapsed, tau_s)
        turn = common.transpose(0, 2, 1) @ np.linalg.inv(old)
        fresh, shift = new - turn @ common, roll.state[place, :2] - state[:, :2]
        drift = growth(old - before.covariance[was, :2, :2])
        mean, open_ = self.mean[at], self.spread[at] + drift
        after, narrowed, log_own, chi_sq = looked(mean, open_, turn, fresh, shift)
        still = ~fresh_look[:, None, None]
        step = Step(
            number, before.state[was, :2], state[:, :2], state[:, :2] + np.where(fresh_look[:, None], shift, 0.0),
            np.where(still, old, new), drift, np.where(still, np.eye(2), turn), np.where(still, 0.0, fresh), fresh_look,
            np.where(fresh_look, log_own, 0.0), np.where(fresh_look[:, None], after, mean),
            np.where(still, open_, narrowed),
        )  # fmt: skip
        honest = ~fresh_look | (chi_sq <= FORETOLD.limit(2))
        return step.take(np.flatnonzero(honest)[np.argsort(number[honest])])


def looked(
    mean: FloatArray, spread: FloatArray, turn: FloatArray, fresh: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean and covariance of e′ after a look that shifted a track by ν, ln p(ν), and χ² of ν.

    mean, shift : (k, 2). spread, turn, fresh : (k, 2, 2) covariance of e before, G, and the covariance of n.
    """
    slope = turn - np.eye(2)
    total = slope @ spread @ slope.transpose(0, 2, 1) + fresh + LEAST_M2 * np.eye(2)
    cross = turn @ spread @ slope.transpose(0, 2, 1) + fresh
    gain = cross @ np.linalg.inv(total)
    surprise = shift - np.einsum("kvw,kw->kv", slope, mean)
    after = np.einsum("kvw,kw->kv", turn, mean) + np.einsum("kvw,kw->kv", gain, surprise)
    narrowed = turn @ spread @ turn.transpose(0, 2, 1) + fresh - gain @ cross.transpose(0, 2, 1)
    log_p, chi_sq = log_normal(surprise, total)
    return after, 0.5 * (narrowed + narrowed.transpose(0, 2, 1)), log_p, chi_sq


def log_normal(x: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(k,) ln N(x; 0, covariance) in the plane, and (k,) χ²."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = a * c - b * b
    chi_sq = (c * x[:, 0] ** 2 - 2.0 * b * x[:, 0] * x[:, 1] + a * x[:, 1] ** 2) / determinant
    return -LOG_2PI - 0.5 * np.log(determinant) - 0.5 * chi_sq, chi_sq


def found_in(ascending: IntArray, wanted: IntArray) -> IntArray:
    """(k,) where the wanted numbers stand among ascending ones, −1 for those that are not there."""
    if not len(ascending):
        return np.full(len(wanted), -1)
    at = np.minimum(np.searchsorted(ascending, wanted), len(ascending) - 1)
    return np.where(ascending[at] == wanted, at, -1)


def growth(change: FloatArray) -> FloatArray:
    """(n, 2, 2) changes of covariances without what shrank."""
    values, axes = np.linalg.eigh(change)
    return np.asarray((axes * np.maximum(values, 0.0)[:, None, :]) @ axes.transpose(0, 2, 1))


def _common(old: FloatArray, new: FloatArray, elapsed_s: FloatArray, tau_s: FloatArray) -> FloatArray:
    """(n, 2, 2) C: covariance of the errors of two reports of one track."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        rho = np.where(tau_s > 0.0, np.exp(-np.maximum(elapsed_s, 0.0) / tau_s), 0.0)
    return rho[:, None, None] * (np.linalg.cholesky(old) @ np.linalg.cholesky(new).transpose(0, 2, 1))
