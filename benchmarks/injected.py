"""Movers injected into the pixels of series, real and simulated: what is found, what is false, what is stated."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import OUTPUT, Table
from sameas.front.framing import FrameRequest, frame_of
from sameas.front.series import frames_in
from sameas.simulate.frames import Camera, Moffat
from sameas.simulate.frames import frame_of as simulated
from sameas.sky.frame.detect import detect
from sameas.sky.frame.image import Frame
from sameas.sky.movers.series import search
from sameas.sky.movers.stack import stack
from sameas.sky.movers.trails import with_trails
from sameas.sky.series.tied import Exposure, tie

#: Bins: magnitudes above (−) and below (+) the limit of a single frame at which S/N is 5, and rates, arcsec/min.
MAGNITUDES = (-4.0, -2.0, -1.0, -0.5, 0.0, 0.5)
RATES = (0.05, 0.2, 0.6, 2.0, 10.0)
STATED = (0.02, 0.5, 0.9, 0.99, 1.0001)
#: Movers of a round, and the share of them that pass a star in the middle of the series.
EACH, ON_STARS = 25, 0.1
NOTES = (
    "found / injected: of movers that stay on three frames, with a probability of 0.5 and more; columns: magnitude "
    "against the limit of a median frame (S/N 5 of a star that stands still); rows: arcsec/min. Fast ones trail, which "
    "dims them. One in ten passes a star.",
    "false: tracklets of 0.5 and more that are no injected mover, those that the series shows without them left out",
)


@dataclass(frozen=True)
class Scene:
    """Frames of a series.

    minutes : (f,) middles. shifts : (f, 2) px of the field on the chip. fwhm : (f,) px. limit : flux of S/N 5.
    """

    name: str
    frames: tuple[Frame, ...]
    minutes: np.ndarray
    exposure_min: float
    scale: float
    shifts: np.ndarray
    fwhm: np.ndarray
    limit: float


def real_scene(folder: Path) -> Scene:
    """The frames of a folder, calibrated with its darks; they point within some pixels of each other."""
    darks = tuple(str(p) for p in sorted(folder.iterdir()) if "dark" in p.name.lower())
    paths = [p for p in frames_in(folder) if p not in darks]
    frames = [
        frame_of(FrameRequest(path=p, folder=".", name=Path(p).stem, catalogue="", darks=darks), lambda stage: None)
        for p in paths
    ]
    order = np.argsort([f.facts.mid_time.mjd for f in frames])
    frames = [frames[k] for k in order]
    found = [detect(f) for f in frames]
    minutes = np.array([f.facts.mid_time.mjd for f in frames]) * 1440.0
    shifts = np.array([_shift(found[0], one) for one in found])
    fwhm = np.array([one.psf_fwhm_px for one in found])
    limit = float(np.median([5.0 * np.median(one.flux_err[one.snr < 8]) for one in found]))
    scale = 1.176 if frames[0].facts.scale_arcsec_per_px != frames[0].facts.scale_arcsec_per_px else float(
        frames[0].facts.scale_arcsec_per_px)  # fmt: skip
    return Scene("real frames", tuple(frames), minutes - minutes[0], frames[0].facts.exposure_s / 60.0, scale, shifts,
                 fwhm, limit)  # fmt: skip


def _shift(first: Any, other: Any) -> np.ndarray:
    """(2,) by how many px the sources of a frame stand off those of the first: the commonest offset."""
    bright = [np.column_stack([one.x_px, one.y_px])[np.argsort(-one.flux)[:80]] for one in (first, other)]
    off = (bright[1][:, None] - bright[0][None]).reshape(-1, 2)
    off = off[np.abs(off).max(axis=1) < 60.0]
    near = np.hypot(*(off[:, None] - off[None]).transpose(2, 0, 1)) < 1.5
    best = near[int(np.argmax(near.sum(axis=1)))]
    return np.asarray(off[best].mean(axis=0))


def crowded_scene(rng: np.random.Generator, *, count: int = 8, side: int = 512, stars: int = 1200) -> Scene:
    """Simulated frames of a crowded field: a star in every 15 × 15 px, seeing and pointing that wander."""
    at, light = rng.uniform(-20, side + 20, (stars, 2)), 10 ** rng.uniform(2.6, 5.2, stars) ** 1.0
    frames, shifts, fwhm = [], rng.normal(0.0, 3.0, (count, 2)), rng.uniform(2.4, 3.4, count)
    for k in range(count):
        made = simulated(
            rng, x_px=at[:, 0] + shifts[k, 0], y_px=at[:, 1] + shifts[k, 1], flux_e=light, psf=Moffat(fwhm[k]),
            camera=Camera(shape=(side, side), sky_e=400.0, hot_pixels=40, cosmics=6), name=f"crowded {k}",
        )  # fmt: skip
        frames.append(made.frame)
    errors = [np.median(m.flux_err[m.snr < 8]) for m in (detect(frames[0]),)]
    return Scene("simulated, crowded", tuple(frames), 10.0 * np.arange(count), 0.5, 1.2, shifts, fwhm,
                 5.0 * float(errors[0]))  # fmt: skip


def injected(scene: Scene, rng: np.random.Generator) -> tuple[list[Frame], np.ndarray, np.ndarray, np.ndarray]:
    """The frames with movers, (m, f, 2) their pixels, (m,) rates in arcsec/min, (m,) magnitudes against the limit."""
    rows, columns = scene.frames[0].shape
    rate = np.exp(rng.uniform(math.log(RATES[0]), math.log(RATES[-1]), EACH))
    magnitude = rng.uniform(MAGNITUDES[0], MAGNITUDES[-1], EACH)
    angle = rng.uniform(0.0, 2 * math.pi, EACH)
    step = (rate / scene.scale)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    middle = rng.uniform([0.15 * columns, 0.15 * rows], [0.85 * columns, 0.85 * rows], (EACH, 2))
    stars = detect(scene.frames[0])
    there = np.flatnonzero(rng.random(EACH) < ON_STARS)
    pick = rng.integers(0, len(stars), len(there))
    middle[there] = np.column_stack([stars.x_px, stars.y_px])[pick] - scene.shifts[0]
    t = scene.minutes - np.median(scene.minutes)
    path = middle[:, None] + t[None, :, None] * step[:, None] + scene.shifts[None]
    flux = scene.limit * 10 ** (-0.4 * magnitude)
    out = []
    for k, frame in enumerate(scene.frames):
        image = frame.image.astype(np.float64)
        gain = frame.facts.gain_e_per_adu if frame.facts.gain_e_per_adu > 0 else 1.0
        for m in range(EACH):
            _add(image, path[m, k], step[m] * scene.exposure_min, flux[m], scene.fwhm[k], gain, rng)
        out.append(replace(frame, image=image.astype(np.float32)))
    return out, path, rate, magnitude


def _add(
    image: np.ndarray, at: np.ndarray, trail: np.ndarray, flux: float, fwhm: float, gain: float,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Adds the light of a mover, drawn along its trail, with the noise of its photons."""
    profile, reach = Moffat(fwhm), int(4 * fwhm) + 2
    steps = max(1, math.ceil(2.0 * math.hypot(*trail) / fwhm))
    rows, columns = image.shape
    for share in (np.arange(steps) + 0.5) / steps - 0.5:
        x, y = at + share * trail
        a, b = max(int(y) - reach, 0), max(int(x) - reach, 0)
        c, d = min(int(y) + reach + 1, rows), min(int(x) + reach + 1, columns)
        if a >= c or b >= d:
            continue
        v, u = np.mgrid[a:c, b:d]
        light = flux / steps * profile.density((u - x) ** 2 + (v - y) ** 2)
        image[a:c, b:d] += rng.poisson(np.maximum(light * gain, 0.0)) / gain


def exposures(scene: Scene, frames: Sequence[Frame]) -> list[Exposure]:
    """The measurements of the frames, their plates off by a shift that the series must find."""
    out = []
    for k, frame in enumerate(frames):
        m = detect(frame)
        at = np.column_stack([m.x_px, m.y_px]) - scene.shifts[k]
        dec = 22.9 + (at[:, 1] - 500.0) * scene.scale / 3600.0
        ra = 62.5 + (at[:, 0] - 500.0) * scene.scale / 3600.0 / np.cos(np.radians(dec))
        sky = m.covariance * scene.scale**2
        none = np.full(len(m), np.nan)
        out.append(
            Exposure(
                f"{k:03d}", 58409.1 + scene.minutes[k] / 1440.0, m.x_px, m.y_px, m.covariance, ra, dec, sky, m.flux,
                m.flux_err, m.snr, m.flags.astype(np.int64), np.zeros(len(m)), none, scene.scale, frame.shape,
                60.0 * scene.exposure_min, None, m.psf_fwhm_px,
            )
        )  # fmt: skip
    return out


def searched(scene: Scene, frames: Sequence[Frame]) -> tuple[list[np.ndarray], np.ndarray]:
    """Of every tracklet from a probability of 0.02 on: (s, 3) frame and pixels of its detections; and (k,) p."""
    series = with_trails(tie(exposures(scene, frames)), frames)
    found, series = search(series, least_probability=0.02)
    p = stack(found, series, frames).p
    p = np.concatenate([p, found.p_tracklet[len(p) :]])
    chip = [np.column_stack([e.x_px, e.y_px]) for e in series.exposures]
    places = []
    for members in found.members:
        rows = found.detections.rows[members[members >= 0]]
        frame = series.frame[rows]
        places.append(np.column_stack([frame, [chip[k][r] for k, r in zip(frame, series.row[rows], strict=True)]]))
    return places, p


def whose(place: np.ndarray, path: np.ndarray, reach: np.ndarray) -> int:
    """The mover to which seven tenths of the detections of a tracklet belong, three at least; −1 for none."""
    frame, at = place[:, 0].astype(int), place[:, 1:]
    near = np.hypot(*(path[:, frame] - at[None]).transpose(2, 0, 1)) < reach[:, None]
    count = near.sum(axis=1)
    best = int(np.argmax(count)) if len(count) else -1
    return best if best >= 0 and count[best] >= max(3, 0.7 * len(at)) else -1


def tables(scenes: Sequence[Scene], rounds: int, rng: np.random.Generator) -> list[Table]:
    """What is found of injected movers, and how often what is stated is so; and draws it."""
    out, stated, drawn = [], [], []
    for scene in scenes:
        got = np.zeros((len(RATES) - 1, len(MAGNITUDES) - 1), int)
        put, wrong, cases = got.copy(), 0, []
        before, _ = searched(scene, scene.frames)
        for _ in range(rounds):
            frames, path, rate, magnitude = injected(scene, rng)
            places, p = searched(scene, frames)
            reach = 2.0 + 0.5 * rate / scene.scale * scene.exposure_min
            hit = set()
            for place, sure in zip(places, p, strict=True):
                owner = whose(place, path, reach)
                old = any(_common(place, one) >= 2 for one in before)
                if owner < 0 and old:
                    continue
                cases.append((float(sure), owner >= 0))
                wrong += int(sure >= 0.5 and owner < 0)
                if owner >= 0 and sure >= 0.5:
                    hit.add(owner)
            rows, columns = scene.frames[0].shape
            stays = ((path > 5) & (path < [columns - 6, rows - 6])).all(axis=2).sum(axis=1) >= 3
            a, b = np.digitize(rate, RATES) - 1, np.digitize(magnitude, MAGNITUDES) - 1
            for m in np.flatnonzero(stays):
                put[a[m], b[m]] += 1
                got[a[m], b[m]] += int(m in hit)
        heads = [f"{lo:+.1f}…{hi:+.1f}" for lo, hi in itertools.pairwise(MAGNITUDES)]
        rows_ = [
            (f"{lo:g}…{hi:g}", *(f"{got[k, j]}/{put[k, j]}" for j in range(len(heads))))
            for k, (lo, hi) in enumerate(itertools.pairwise(RATES))
        ]
        rows_.append(("all", *(f"{got[:, j].sum()}/{put[:, j].sum()}" for j in range(len(heads)))))
        note = f"{rounds} series of {len(scene.frames)} frames, {rounds * EACH} movers; false in all: {wrong}"
        out.append(Table(f"Injected movers: {scene.name}", ("rate ″/min", *heads), rows_, (note, *NOTES)))
        cases_p, real = np.array([c[0] for c in cases]), np.array([c[1] for c in cases], bool)
        for lo, hi in itertools.pairwise(STATED):
            mine = (cases_p >= lo) & (cases_p < hi)
            if mine.any():
                stated.append((scene.name, f"{lo:g}…{min(hi, 1.0):g}", int(mine.sum()), f"{cases_p[mine].mean():.3f}",
                               f"{real[mine].mean():.3f}"))  # fmt: skip
        drawn.append((scene.name, got, put))
    out.append(Table("What is stated of candidates", ("series", "stated p", "candidates", "mean p", "real"), stated))
    draw(drawn)
    return out


def _common(one: np.ndarray, other: np.ndarray) -> int:
    """Detections that two tracklets have in common, to 1.5 px."""
    same = (one[:, None, 0] == other[None, :, 0]) & (
        np.hypot(*(one[:, None, 1:] - other[None, :, 1:]).transpose(2, 0, 1)) < 1.5
    )
    return int(same.any(axis=1).sum())


def draw(drawn: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> None:
    """The picture of the efficiencies."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(drawn), figsize=(5.2 * len(drawn), 3.8), squeeze=False, layout="constrained")
    middle = 0.5 * (np.array(MAGNITUDES[1:]) + np.array(MAGNITUDES[:-1]))
    for axis, (name, got, put) in zip(axes[0], drawn, strict=True):
        for k, (lo, hi) in enumerate(itertools.pairwise(RATES)):
            share = got[k] / np.maximum(put[k], 1)
            sigma = np.sqrt(np.maximum(share * (1 - share), 0.05) / np.maximum(put[k], 1))
            there = put[k] > 0
            axis.errorbar(
                middle[there] + 0.03 * k, share[there], sigma[there], marker="o", label=f"{lo:g}…{hi:g} ″/min"
            )
        axis.set(title=name, xlabel="magnitude below the limit of a frame", ylabel="found", ylim=(-0.03, 1.08))
        axis.axvline(0.0, color="0.7", lw=1)
    axes[0][0].legend(fontsize=8)
    OUTPUT.mkdir(exist_ok=True)
    figure.savefig(OUTPUT / "movers-injected.png", dpi=110)
    plt.close(figure)
