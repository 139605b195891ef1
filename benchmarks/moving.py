"""Simulated nights with one trouble each and known movers: found, false, stated probabilities.

Usual: four exposures of half a degree, 10 to 25 minutes apart, errors of 0.2″, 300 false detections on each, ten movers
of 18 to 20.5 mag, limit 20.3 mag. The kinds say what differs. ``scripts/bench movers --hard NIGHTS``.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.tables import Table
from sameas.sky import Detections, find_movers

SIDE_ARCSEC, SIGMA_ARCSEC, LIMIT_MAG = 1800.0, 0.2, 20.3


@dataclass(frozen=True)
class Kind:
    """A kind of night.

    exposures, movers, false : numbers. error_scale : true over quoted errors. offset : σ per axis of an exposure's
    offset, arcsec. tails : share of the detections with five times the error. stars : stationary ones, on 90 % of the
    exposures. speed : range in arcsec/min, uniform, any direction; None is the main belt. crowds : number of clumps of
    25 false detections within 12″, the same on every exposure. warm : number of warm pixels under a dithered telescope.
    steady : constant dither and time between exposures.
    """

    name: str
    exposures: int = 4
    movers: int = 10
    false: int = 300
    error_scale: float = 1.0
    offset: float = 0.0
    tails: float = 0.0
    stars: int = 0
    speed: tuple[float, float] | None = None
    crowds: int = 0
    warm: int = 0
    steady: bool = False


KINDS = (
    Kind("usual"),
    Kind("three exposures", exposures=3),
    Kind("two exposures", exposures=2),
    Kind("eight exposures", exposures=8),
    Kind("1 500 false", false=1500),
    Kind("no movers", movers=0),
    Kind("errors 2.5 × quoted", error_scale=2.5),
    Kind("errors 0.4 × quoted", error_scale=0.4),
    Kind("one error in twenty 5 ×", tails=0.05),
    Kind("exposures 0.3″ off", offset=0.3),
    Kind("2 to 20″/min", speed=(2.0, 20.0)),
    Kind("0.01 to 0.06″/min, 150 stars", speed=(0.01, 0.06), stars=150),
    Kind("150 stars", stars=150),
    Kind("150 stars, two exposures", stars=150, exposures=2),
    Kind("1 500 stars", stars=1500),
    Kind("1 500 stars, errors 2.5 ×", stars=1500, error_scale=2.5),
    Kind("150 stars, exposures 0.3″ off", stars=150, offset=0.3),
    Kind("crowds of false ones", crowds=12),
    Kind("60 warm pixels, dithered", warm=60),
    Kind("60 warm pixels, steady drift", warm=60, steady=True),
)
BOUNDS = (0.5, 0.8, 0.95, 0.99, 1.01)


def night(kind: Kind, rng: np.random.Generator) -> tuple[Detections, np.ndarray]:
    """The detections of a night, and (n,) the mover of each, −1 for none."""
    between = np.full(kind.exposures - 1, 18.0) if kind.steady else rng.uniform(10.0, 25.0, kind.exposures - 1)
    minutes = np.concatenate([[0.0], np.cumsum(between)])
    n = kind.movers
    start = _random_positions(rng, n)
    if kind.speed is None:
        rate = np.column_stack([rng.normal(-0.55, 0.15, n), rng.normal(0.1, 0.15, n)])
    else:
        speed, angle = rng.uniform(*kind.speed, n), rng.uniform(0.0, 2.0 * np.pi, n)
        rate = speed[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    magnitude = rng.uniform(18.0, 20.5, n)
    stars, pixels, crowds = (_random_positions(rng, n) for n in (kind.stars, kind.warm, kind.crowds))
    star_magnitude, pixel_magnitude = rng.uniform(18.0, 21.0, kind.stars), rng.uniform(17.0, 20.0, kind.warm)
    rows: list[np.ndarray] = []
    for k, t in enumerate(minutes):
        detected = rng.random(n) < 0.97 / (1.0 + np.exp((magnitude - LIMIT_MAG) / 0.15))
        constant = rng.random(kind.stars) < 0.9
        dither = np.array([12.0, 7.0]) * k if kind.steady else rng.uniform(-20.0, 20.0, 2)
        false = _random_positions(rng, rng.poisson(kind.false))
        crowd = np.repeat(crowds, rng.poisson(25, kind.crowds), axis=0)
        crowd = crowd + 12.0 * rng.standard_normal(crowd.shape)
        position = np.concatenate([(start + t * rate)[detected], stars[constant], pixels + dither, false, crowd])
        magnitudes = [magnitude[detected], star_magnitude[constant], pixel_magnitude]
        magnitudes = [one + 0.1 * rng.standard_normal(len(one)) for one in magnitudes]
        of_false, of_crowd = 18.0 + 3.0 * rng.random(len(false)) ** 0.3, rng.uniform(18.0, 21.0, len(crowd))
        all_magnitudes = np.concatenate([*magnitudes, of_false, of_crowd])
        scale = kind.error_scale * np.where(rng.random(len(position)) < kind.tails, 5.0, 1.0)
        position = position + SIGMA_ARCSEC * scale[:, None] * rng.standard_normal(position.shape)
        position = position + kind.offset * rng.standard_normal(2)
        mover = np.concatenate([np.flatnonzero(detected), np.full(len(position) - int(detected.sum()), -1)])
        rows.append(np.column_stack([position, all_magnitudes, np.full(len(position), k), mover]))
    x, y, all_magnitudes, frame, mover = np.concatenate(rows).T
    dec = 5.0 + y / 3600.0
    detections = Detections.of(
        190.0 + x / 3600.0 / np.cos(np.radians(dec)), dec, 59300.0 + minutes[frame.astype(int)] / 1440.0,
        sigma_arcsec=SIGMA_ARCSEC, frame=frame.astype(int),
        magnitude=all_magnitudes, magnitude_error=np.full(len(x), 0.1),
    )  # fmt: skip
    return detections, mover.astype(int)[detections.rows]


def _random_positions(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.uniform(-0.5, 0.5, (n, 2)) * SIDE_ARCSEC


def tables(nights: int) -> Iterator[Table]:
    """One row per kind: found movers, false candidates, stated probabilities."""
    rows: list[tuple[Any, ...]] = []
    for number, kind in enumerate(KINDS):
        n_found = n_detectable = 0
        stated, is_real = [], []
        for seed in range(nights):
            detections, mover = night(kind, np.random.default_rng([seed, number]))
            min_detections = min(3, kind.exposures)
            movers = find_movers(detections, least=min_detections)
            mover_of_member = np.where(movers.members >= 0, mover[movers.members], -1)
            counts = [np.bincount(one[one >= 0], minlength=1) for one in mover_of_member]
            right = np.array([c.max() >= 2 for c in counts], bool)
            detectable = np.bincount(mover[mover >= 0], minlength=kind.movers) >= min_detections
            found = {int(c.argmax()) for c, ok in zip(counts, right, strict=True) if ok}
            n_detectable += int(detectable.sum())
            n_found += sum(bool(detectable[k]) for k in found)
            stated.append(movers.p_tracklet)
            is_real.append(right)
        p, right = np.concatenate(stated), np.concatenate(is_real)
        bins = []
        for low, high in itertools.pairwise(BOUNDS):
            inside = (p >= low) & (p < high)
            real_of_all = f"{int(right[inside].sum())}/{int(inside.sum())} ({p[inside].sum():.1f})"
            bins.append(real_of_all if inside.any() else "–")
        rows.append((kind.name, f"{n_found}/{n_detectable}", int((~right).sum()), f"{(1.0 - p).sum():.1f}", *bins))
    heads = [f"p {low:g}…{min(high, 1.0):g}" for low, high in itertools.pairwise(BOUNDS)]
    notes = (
        f"{nights} nights of each kind; found: of movers that at least three exposures show (two of two), with p of "
        "at least 0.5",
        "false: candidates without two detections of one mover; expected: number of false ones by the stated p",
        "by p: real / all candidates (expected real)",
    )
    yield Table("Movers of nights with one trouble each", ("night", "found", "false", "expected", *heads), rows, notes)
