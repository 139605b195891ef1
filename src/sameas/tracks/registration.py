"""Registration: the biases of each source relative to the others, estimated and removed.

:func:`registered` registers a scene. Sources without a bias in their descriptions (AIS and ADS-B, which report
satellite positions) are the reference. If all sources may be biased, the two with most reports are registered against
each other first; their priors are the gauge.

A delay of the time stamps that a description does not mention is usually unknown, not zero. Each source is therefore
also fitted with an unknown delay (of prior width ``DELAY_S``), which is kept if the data establish it: if the odds
against no delay (:func:`delay_evidence`) are decisive. ``bias.time_s = 0`` in the description excludes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.registration import Parameter
from sameas.registration.solution import DECISIVE
from sameas.representation import in_short
from sameas.tracks.alignment import States
from sameas.tracks.bearing_readings import best_other_reading
from sameas.tracks.bias_fit import BiasFit, fit_biases
from sameas.tracks.biases import AZIMUTH, BIASES, TIME, AzimuthDrift, corrected
from sameas.tracks.crossing_offsets import crossing_fit
from sameas.tracks.feed import CORRELATED_KINDS, Feed
from sameas.tracks.placement import Directions
from sameas.tracks.plot_fit import HULL_ALONG
from sameas.tracks.plot_offsets import PlotFits
from sameas.tracks.plot_pairs import has_bearings, shows_bare_plots, shows_tracks, with_plot_statistics
from sameas.tracks.snapshot import CommonScan, ComparedSource, bias_widths, common_instants, common_scans
from sameas.tracks.source import Description

DELAY_S = 5.0  # prior 1σ of a delay of the time stamps that a description does not mention (chosen)
#: An offset of bearings with pairs of a larger share of the records, and with more tracks, is not compared with others.
READING_SHARE, READING_TRACKS = 0.5, 4.0
COMPASS_NOTED_DEG = 0.5  # a larger drift of the azimuth is reported


@dataclass(frozen=True)
class _Words:
    """A bias in print: its label, the digits after the point, what follows the number, its unit, and the largest one,
    in this unit, that an operator may set."""

    label: str
    digits: int
    end: str
    unit: str
    most: float

    def text(self, value: float, standard_error: float | None) -> str:
        """Printable: the value with its standard error; None: as an operator has set it."""
        number = f"{self.label} {value:+.{self.digits}f}"
        if standard_error is None:
            return f"{number}{self.end} set by hand"
        return f"{number} ± {standard_error:.{self.digits}f}{self.end}"


#: By bias, in the order of ``BIASES``.
_WORDS = {
    "range_m": _Words("range", 1, " m", "m", 20_000.0), "azimuth_deg": _Words("azimuth", 3, "°", "deg", 180.0),
    "range_gain": _Words("range gain", 5, "", "", 0.2), "time_s": _Words("stamps", 2, " s late", "s", 600.0),
    "east_m": _Words("east", 1, " m", "m", 20_000.0), "north_m": _Words("north", 1, " m", "m", 20_000.0),
}  # fmt: skip


@in_short
@dataclass(frozen=True)
class SourceBiases:
    """The estimated biases of one source.

    Attributes
    ----------
    source : its name. against : the sources that it was compared with; none for a reference.
    parameters : by name (``sameas.tracks.biases.BIASES``) value, standard error and unit: range too long, azimuth too
        far clockwise, stamps too late, positions too far east, north.
    pairs, tracks, instants : expected number of pairs over all instants, of how many tracks, at how many instants.
    log_evidence : log-odds of these biases against no object in common.
    established : whether these biases are decisively more probable than others and than no object in common. If not,
        the records are not corrected.
    notes : doubts, printable sentences; also a delay that the description does not mention.
    theta, covariance : (6,) and (6, 6) the biases that are subtracted, in the order of ``BIASES``, and their
        covariance; None without a correction.
    by_hand : names of the biases that an operator has set; they have no standard error.
    drift : of the azimuth about that subtracted, for a radar that moves; its size is part of ``covariance``.
    """

    source: str
    against: tuple[str, ...] = ()
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    pairs: float = 0.0
    tracks: float = 0.0
    instants: int = 0
    log_evidence: float = 0.0
    established: bool = True
    notes: tuple[str, ...] = ()
    theta: FloatArray | None = field(default=None, repr=False, compare=False)
    covariance: FloatArray | None = field(default=None, repr=False, compare=False)
    by_hand: tuple[str, ...] = ()
    drift: AzimuthDrift | None = field(default=None, repr=False, compare=False)

    def removed(self, feed: Feed) -> Feed:
        """The feed corrected for these biases, and for the drift of the azimuth at the time of each report."""
        if self.theta is None or self.covariance is None:
            return feed
        covariance = self.covariance.copy()
        if self.drift is not None:
            covariance[AZIMUTH, AZIMUTH] -= self.drift.spread_deg**2
        return unbiased(feed, self.theta, covariance, self.drift)

    def later(self, late_s: float) -> SourceBiases:
        """The biases with stamps that are later by ``late_s``, which is subtracted already."""
        if not late_s:
            return self
        late = self.parameters["time_s"]
        parameters = {**self.parameters, "time_s": replace(late, value=late.value + late_s)}
        return replace(self, parameters=parameters)

    @property
    def values(self) -> str:
        """Printable: each bias with its standard error; "" for a source that is not corrected."""
        return ", ".join(
            _WORDS[name].text(it.value, None if name in self.by_hand else it.standard_error)
            for name, it in self.parameters.items()
        )

    def with_set(self, name: str, value: float) -> SourceBiases:
        """With one bias as an operator sets it, exactly; the others that are subtracted stay.

        name : of ``BIASES``. value : in its unit: metres, degrees, seconds; a gain is a share.

        Raises
        ------
        InputError : no such bias, or a value that no sensor has.
        """
        if name not in BIASES:
            raise InputError(f"{self.source}: there is no offset {name!r}", f"give one of {', '.join(BIASES)}")
        k, most, unit = BIASES.index(name), _WORDS[name].most, _WORDS[name].unit
        if not abs(value) <= most:
            raise InputError(f"{self.source}: {name} is {value:g}", f"give −{most:g} to {most:g} {unit}".rstrip())
        theta = np.zeros(len(BIASES)) if self.theta is None else self.theta.copy()
        covariance = np.zeros((len(BIASES), len(BIASES))) if self.covariance is None else self.covariance.copy()
        theta[k], covariance[k], covariance[:, k] = value, 0.0, 0.0
        known = {} if self.theta is None else dict(self.parameters)
        known[name] = Parameter(value, 0.0, unit)
        return replace(
            self, parameters={bias: known[bias] for bias in BIASES if bias in known}, established=True,
            by_hand=tuple(bias for bias in BIASES if bias in (*self.by_hand, name)), theta=theta, covariance=covariance,
            drift=None if k == AZIMUTH else self.drift,
        )  # fmt: skip

    def __str__(self) -> str:
        if not self.parameters:
            return f"{self.source}: not corrected" + (", the reference for the others" if not self.notes else "")
        others = " and ".join(self.against)
        by = f"{self.pairs:.0f} pairs of {self.tracks:.0f} tracks at {self.instants} instants with {others}"
        verdict = "" if self.established else "NOT ESTABLISHED, "
        return f"{self.source}: {verdict}{self.values}; by {by} (log evidence {self.log_evidence:.0f})"

    def lines(self) -> tuple[str, ...]:
        """Printable: the biases, then the notes."""
        return (str(self), *self.notes)


#: A source after registration, with its biases.
RegisteredFeed = tuple[Feed, SourceBiases]


def registered(
    feeds: Sequence[Feed], references: Sequence[str] | None = None, fits: PlotFits | None = None
) -> tuple[tuple[Feed, ...], tuple[SourceBiases, ...]]:
    """The feeds corrected for their biases, and the biases of each, in their order.

    references : names of the sources with unbiased positions; if not given, all without a bias in their descriptions.
    fits : of sources of plots, where already made.

    Raises InputError: a reference that is not a source of positions.
    """
    fixed, free, directions = _parts(feeds, references)
    if len(directions) == len(feeds) and len(feeds) > 1:
        of_crossings = _by_crossings(feeds)
        return tuple(feed for feed, _ in of_crossings), tuple(biases for _, biases in of_crossings)
    fits = fits or PlotFits()
    done: dict[int, RegisteredFeed] = {}
    for k in fixed:
        done[k] = _reference(feeds[k], [done[j][0] for j in done])
    anchors = [done[k][0] for k in fixed]
    if not fixed and len(free) > 1:
        done |= dict(zip(free[:2], _mutual(feeds[free[0]], feeds[free[1]]), strict=True))
    for k in free:
        if k not in done:
            done[k] = _against(feeds[k], anchors or [feed for feed, _ in done.values()][:1], fits)
    # A source without objects in common with the references may have some with sources registered to them; likewise
    # directions.
    for k in [k for k in free if fixed and not done[k][1].established] + directions:
        partner = _best_partner(feeds[k], [source for at, source in done.items() if at != k])
        second = _against(feeds[k], partner, fits)
        if k not in done or second[1].established:
            done[k] = second
    for k in directions:
        if not done[k][1].established and feeds[k].description.kind == "esm":
            done[k] = _with_unknown_offset(*done[k])
    in_order = [done[k] for k in range(len(feeds))]
    return tuple(feed for feed, _ in in_order), tuple(biases for _, biases in in_order)


def _parts(feeds: Sequence[Feed], references: Sequence[str] | None) -> tuple[list[int], list[int], list[int]]:
    """Numbers of the references, satellite clocks first, of the other sources of positions, most reports first, and of
    directions."""
    names = [feed.description.name for feed in feeds]
    placed = [k for k, feed in enumerate(feeds) if not isinstance(feed.reports, Directions)]
    for name in references or ():
        if name not in [names[k] for k in placed]:
            known = ", ".join(names[k] for k in placed)
            raise InputError(f"registered: {name!r} is not a source of positions; give some of {known} as references")
    if references is None:
        fixed = [k for k in placed if not bias_widths(feeds[k]).any()]
    else:
        fixed = [k for k in placed if names[k] in references]
    fixed.sort(key=lambda k: (feeds[k].description.kind not in CORRELATED_KINDS, -len(feeds[k].reports)))
    free = sorted((k for k in placed if k not in fixed), key=lambda k: -len(feeds[k].reports))
    return fixed, free, [k for k in range(len(feeds)) if k not in placed]


def _with_unknown_offset(feed: Feed, biases: SourceBiases) -> RegisteredFeed:
    """A direction finder whose offset is not established: what its description allows is part of its errors."""
    width_deg = float(bias_widths(feed)[AZIMUTH])
    covariance = np.zeros((len(BIASES), len(BIASES)))
    covariance[AZIMUTH, AZIMUTH] = width_deg**2
    note = f"{biases.source}: its errors allow for an offset of ± {width_deg:g}°"
    biases = replace(biases, notes=(*biases.notes, note), theta=np.zeros(len(BIASES)), covariance=covariance)
    return biases.removed(feed), biases


def _by_crossings(feeds: Sequence[Feed]) -> list[RegisteredFeed]:
    """Sources of directions alone: corrected by where three cross; else their offsets are part of the errors."""
    fit = crossing_fit(feeds)
    names = [feed.description.name for feed in feeds]
    out: list[RegisteredFeed] = []
    for k, feed in enumerate(feeds):
        name, width_deg = names[k], float(bias_widths(feed)[AZIMUTH])
        theta, covariance = np.zeros(len(BIASES)), np.zeros((len(BIASES), len(BIASES)))
        if not width_deg:
            out.append((feed, SourceBiases(name, notes=(f"{name}: its description allows no bias to fit",))))
            continue
        if fit is not None:
            theta[AZIMUTH], covariance[AZIMUTH, AZIMUTH] = fit.theta_deg[k], fit.covariance_deg2[k, k]
            azimuth = Parameter(float(theta[AZIMUTH]), math.sqrt(fit.covariance_deg2[k, k]), "deg")
            others = tuple(other for other in names if other != name)
            biases = SourceBiases(
                name, others, {"azimuth_deg": azimuth}, pairs=fit.triples,
                tracks=fit.triples / max(fit.instants * math.comb(len(feeds), 3), 1), instants=fit.instants,
                log_evidence=fit.log_evidence, theta=theta, covariance=covariance,
            )  # fmt: skip
        else:
            covariance[AZIMUTH, AZIMUTH] = width_deg**2
            several = "of several objects without frequencies, or of equal ones, do not"
            why = "of two places alone do not" if len(feeds) == 2 else several
            note = (
                f"{name}: directions {why} show its offset: the errors of positions allow for ± {width_deg:g}°; if it "
                "has none, give bias azimuth_deg = 0"
            )
            biases = SourceBiases(name, notes=(note,), theta=theta, covariance=covariance)
        out.append((biases.removed(feed), biases))
    return out


def _best_partner(feed: Feed, done: Sequence[RegisteredFeed]) -> list[Feed]:
    """The registered source of positions with most records at common instants."""
    positions = [other for other, _ in done if not isinstance(other.reports, Directions)]
    counts = [
        sum(len(e.weighing.first) for e in common_scans(ComparedSource(other, None), ComparedSource(feed, None)))
        for other in positions
    ]
    return [positions[int(np.argmax(counts))]] if positions else []


def _reference(feed: Feed, others: Sequence[Feed]) -> RegisteredFeed:
    """A source whose positions are a reference, with the delay relative to other references, if one is established."""
    fit = _delay_fit(feed, others, PlotFits()) if others else None
    if fit is None:
        return feed, SourceBiases(feed.description.name)
    return _corrected(feed, 0, fit, tuple(other.description.name for other in others))


def _against(feed: Feed, partners: Sequence[Feed], fits: PlotFits) -> RegisteredFeed:
    """One source registered against others, which stay unchanged."""
    name = feed.description.name
    if not bias_widths(feed).any():
        return feed, SourceBiases(name, notes=(f"{name}: its description allows no bias to fit",))
    if not partners:
        return feed, SourceBiases(name, notes=(f"{name}: there is no other source of positions to compare it with",))
    fit = _delay_fit(feed, partners, fits) or _fit(feed, partners, fits)
    if fit is not None:
        return _corrected(feed, 0, fit, tuple(other.description.name for other in partners))
    if not _common_scans(feed, partners):
        return feed, SourceBiases(name, established=False, notes=(_not_compared(feed, partners),))
    return feed, SourceBiases(name, notes=(_not_observable(feed, partners),))


def _fit(feed: Feed, partners: Sequence[Feed], fits: PlotFits) -> BiasFit | None:
    """The biases of one source relative to others; None if they have no time in common or no bias is observable."""
    named = [other for other in partners if shows_tracks(other)]
    by_plots = fits(feed, named) if named and shows_bare_plots(feed) else None
    if by_plots is not None:
        return by_plots
    scans = _common_scans(feed, partners)
    if not observable(scans):
        return None
    fit = fit_biases(scans, _in_sweeps(feed, partners))
    if not fit.established or not named or not has_bearings(feed) or _is_plain(fit, scans):
        return fit
    azimuth_deg = float(fit.theta[fit.biases == AZIMUTH][0])
    return replace(fit, reading=best_other_reading(feed, named, azimuth_deg))


def _is_plain(fit: BiasFit, scans: Sequence[CommonScan]) -> bool:
    """Whether so many records are in pairs that they cannot be read in another way."""
    records = sum(scan.most_pairs for scan in scans)
    return fit.tracks > READING_TRACKS and fit.pairs > READING_SHARE * records


def _common_scans(feed: Feed, partners: Sequence[Feed]) -> list[CommonScan]:
    return [scan for other in partners for scan in common_scans(ComparedSource(other, None), ComparedSource(feed, 0))]


def _in_sweeps(feed: Feed, partners: Sequence[Feed]) -> list[CommonScan]:
    """The same with the plots of an antenna in parts of its rotation; none if no partner can be compared so."""
    one = ComparedSource(feed, 0)
    swept = [common_scans(ComparedSource(other, None), one, sweeps=True) for other in partners]
    if not any(swept):
        return []
    parts = (
        part or common_scans(ComparedSource(other, None), one) for other, part in zip(partners, swept, strict=True)
    )
    return [scan for part in parts for scan in part]


def with_delay_prior(description: Description) -> Description:
    """The description with a prior 1σ of a delay in addition to its latency, so that the delay is always estimated."""
    return replace(description, bias=replace(description.bias, time_s=DELAY_S))


def _with_unknown_delay(feed: Feed) -> Feed | None:
    """The feed with a prior for a delay of its stamps; None for directions, and if its description has one, or 0."""
    if feed.description.bias.time_s is not None or isinstance(feed.reports, Directions):
        return None
    return replace(feed, description=with_delay_prior(feed.description))


def _delay_fit(feed: Feed, partners: Sequence[Feed], fits: PlotFits) -> BiasFit | None:
    """The biases of one source with a delay that its description does not mention; None if none is established."""
    delayed = _with_unknown_delay(feed)
    fit = None if delayed is None else _fit(delayed, partners, fits)
    return fit if fit is not None and _delay_established(fit, [feed, *partners]) else None


def _delay_established(fit: BiasFit, feeds: Sequence[Feed]) -> bool:
    return fit.established and delay_evidence(fit, feeds) > DECISIVE


def delay_evidence(fit: BiasFit, feeds: Sequence[Feed]) -> float:
    """Log-odds of the fitted delay, of prior width ``DELAY_S``, against none: the Savage-Dickey density ratio.

    An antenna is rarely amidships. An offset along the course that all ships share looks like a delay at a given
    speed; it adds to the standard error here, as ``HULL_ALONG`` of the described extents.

    Source: Dickey 1971, Annals of Mathematical Statistics 42, 204.
    """
    at = np.flatnonzero(fit.biases % len(BIASES) == TIME)
    if len(at) != 1:
        return -np.inf
    delay, variance = float(fit.theta[at[0]]), float(fit.covariance[at[0], at[0]])
    if fit.speed_m_per_s > 0.0:
        extent_sq = max((feed.description.errors.extent_m or 0.0) ** 2 for feed in feeds)
        variance += extent_sq * (HULL_ALONG / fit.speed_m_per_s) ** 2
    return 0.5 * delay**2 / variance + 0.5 * float(np.log(variance)) - float(np.log(DELAY_S))


def _mutual(one: Feed, other: Feed) -> tuple[RegisteredFeed, RegisteredFeed]:
    """Two sources that may both be biased, registered against each other."""
    names = one.description.name, other.description.name
    fit = _mutual_delay_fit(one, other)
    if fit is None:
        scans = scans_of_both(one, other)
        if not observable(scans):
            note = _not_observable if scans else _not_compared
            first, second = (
                (feed, SourceBiases(feed.description.name, established=bool(scans), notes=(note(feed, [partner]),)))
                for feed, partner in ((one, other), (other, one))
            )
            return first, second
        fit = fit_biases(scans)
    gauge = (
        f"{names[0]} and {names[1]} have no reference: a bias that displaces both alike cannot be seen, and is assumed "
        "to be as small as their descriptions allow"
    )
    first, second = (_corrected(feed, 6 * k, fit, (names[1 - k],)) for k, feed in enumerate((one, other)))
    if fit.established:
        first = first[0], replace(first[1], notes=(gauge, *first[1].notes))
    return first, second


def _mutual_delay_fit(one: Feed, other: Feed) -> BiasFit | None:
    """The biases of both with an unmentioned delay of the second, or else of the first; None if not established.

    Only the difference of two delays is observable: a source whose description has a delay takes all of it.
    """
    if (one.description.bias.time_s or 0.0) > 0.0 or (other.description.bias.time_s or 0.0) > 0.0:
        return None
    late_other = _with_unknown_delay(other)
    late_one = _with_unknown_delay(one) if late_other is None else None
    if late_other is None and late_one is None:
        return None
    scans = scans_of_both(late_one or one, late_other or other)
    if not observable(scans):
        return None
    fit = fit_biases(scans)
    return fit if _delay_established(fit, [one, other]) else None


def scans_of_both(one: Feed, other: Feed) -> tuple[CommonScan, ...]:
    """Two sources at common instants, the biases of both unknown: those of the first, then those of the second."""
    return common_scans(ComparedSource(one, 0), ComparedSource(other, len(BIASES)))


def observable(scans: Sequence[CommonScan]) -> bool:
    """Whether any bias is observable in these scans."""
    return any(scan.weighing.model.names for scan in scans)


def _not_observable(feed: Feed, partners: Sequence[Feed]) -> str:
    name, others = feed.description.name, " nor ".join(other.description.name for other in partners)
    return f"{name}: only its latency may be biased, and was not fitted: neither it nor {others} has velocities"


def _not_compared(feed: Feed, partners: Sequence[Feed]) -> str:
    name, others = feed.description.name, " or ".join(other.description.name for other in partners)
    if any(len(common_instants(feed, other)) for other in partners):
        return (
            f"{name}: its errors, or those of {others}, are too large to separate objects as near as these; its biases "
            "were not fitted"
        )
    return f"{name}: has no report at the times of {others}; its biases were not fitted"


def _corrected(feed: Feed, start: int, fit: BiasFit, against: tuple[str, ...]) -> RegisteredFeed:
    """The feed, corrected if its biases are established, and its biases; start : 0 or 6, of its biases in the fit."""
    own = np.flatnonzero((fit.biases >= start) & (fit.biases < start + len(BIASES)))
    which = fit.biases[own] - start
    errors = np.sqrt(np.diag(fit.covariance))[own]
    parameters = {
        BIASES[k]: Parameter(float(value), float(error), _WORDS[BIASES[k]].unit)
        for k, value, error in zip(which, fit.theta[own], errors, strict=True)
    }
    biases = SourceBiases(
        feed.description.name, against, parameters, fit.pairs, fit.tracks, fit.instants, fit.log_evidence,
        fit.established, _notes(feed, which, own, fit, against),
    )  # fmt: skip
    if fit.missed is not None:
        feed = with_plot_statistics(feed, fit.missed)
    if not fit.established:
        return feed, biases
    theta, covariance = np.zeros(len(BIASES)), np.zeros((len(BIASES), len(BIASES)))
    theta[which], covariance[np.ix_(which, which)] = fit.theta[own], fit.relative[np.ix_(own, own)]
    if fit.drift is not None:
        # Other reports than these have another drift.
        covariance[AZIMUTH, AZIMUTH] += fit.drift.spread_deg**2
    biases = replace(biases, theta=theta, covariance=covariance, drift=fit.drift)
    return biases.removed(feed), biases


def unbiased(feed: Feed, biases: FloatArray, covariance: FloatArray, drift: AzimuthDrift | None = None) -> Feed:
    """The feed corrected for biases (6,) with covariance (6, 6), and for a drift of the azimuth about them."""

    def without(reports: States | Directions) -> States | Directions:
        if drift is None:
            return corrected(reports, feed.sensor_m, biases, covariance)
        of_each, errors = np.tile(biases, (len(reports), 1)), np.tile(covariance, (len(reports), 1, 1))
        azimuth, variance = drift.at(reports.time_s)
        of_each[:, AZIMUTH] += azimuth
        errors[:, AZIMUTH, AZIMUTH] = np.maximum(variance, covariance[AZIMUTH, AZIMUTH])
        return corrected(reports, feed.sensor_m, of_each, errors)

    measured = None if feed.measured is None else without(feed.measured)
    assert not isinstance(measured, Directions)
    return replace(
        feed, reports=without(feed.reports), measured=measured,
        scan_times_s=feed.scan_times_s - biases[TIME], scan_s=feed.scan_s - biases[TIME],
    )  # fmt: skip


def _notes(feed: Feed, which: IntArray, own: IntArray, fit: BiasFit, against: tuple[str, ...]) -> tuple[str, ...]:
    """Doubts about the biases of one source."""
    name, others = feed.description.name, " and ".join(against)
    notes = []
    if fit.log_evidence < DECISIVE:
        notes.append(
            f"{name}: may have no object in common with {others}: its biases are not significant "
            f"(log evidence {fit.log_evidence:.1f})"
        )
    if TIME in which and not bias_widths(feed)[TIME]:
        delay_s = float(fit.theta[own[which == TIME][0]])
        notes.append(
            f"{name}: its stamps are {abs(delay_s):.2g} s {'late' if delay_s > 0.0 else 'early'} against those of "
            f"{others}, which its description does not mention; if they are exact, give bias time_s = 0"
        )
    if fit.established and fit.drift is not None and fit.drift.spread_deg > COMPASS_NOTED_DEG:
        at = own[which == AZIMUTH][0]
        mean_deg = float(np.sqrt(fit.relative[at, at]))
        notes.append(
            f"{name}: its azimuth drifts by {fit.drift.spread_deg:.1f}° about this (root mean square), as with a "
            f"heading from a compass; the drift is removed, and the mean is known to {mean_deg:.2f}°"
        )
    if fit.reading is not None and fit.reading.log_odds > -DECISIVE:
        notes.append(f"{name}: its {fit.reading.suspicion} (log odds {fit.reading.log_odds:.1f} against these biases)")
    if fit.near_rivals:
        theta, evidence = fit.near_rivals[0]
        values = ", ".join(f"{BIASES[k]} {value:.4g}" for k, value in zip(which, theta[own], strict=True))
        notes.append(
            f"{name}: other biases fit its records nearly as well, with log evidence lower by "
            f"{fit.log_evidence - evidence:.1f}: {values}"
        )
    if not fit.established:
        notes.append(f"{name}: is not corrected")
    needed = len(which) / 2.0 + 2.0
    if fit.tracks < needed:
        notes.append(
            f"{name}: too few tracks: {fit.tracks:.0f} for {len(which)} biases, {needed:.0f} are needed; its biases "
            "lean on what its description says of them"
        )
    if bias_widths(feed)[TIME] > 0.0 and TIME not in which:
        notes.append(f"{name}: latency was not fitted: neither it nor {others} has velocities")
    if not fit.converged:
        notes.append(f"{name}: its biases had not converged")
    far = np.abs(fit.theta[own]) > 3.0 * np.where(bias_widths(feed) > 0.0, bias_widths(feed), np.inf)[which]
    wide = [BIASES[k] for k in which[far]]
    if wide:
        assumed = all(feed.description.is_assumed(f"bias.{one}") for one in wide)
        limit = f"is assumed for the kind {feed.description.kind}" if assumed else "its description allows"
        notes.append(f"{name}: {' and '.join(wide)} came out more than three times as large as {limit}")
    return tuple(notes)
