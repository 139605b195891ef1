"""Movers injected into the pixels of simulated and real series of frames: found, false, stated probabilities."""

from __future__ import annotations

import itertools
import json
import math
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
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
from sameas.sky.movers.below_limit import search_below_limit
from sameas.sky.movers.search import search, unexplained_detections
from sameas.sky.movers.stack import chip_map, confirmed, stack
from sameas.sky.movers.trails import with_trails
from sameas.sky.series import Exposure, Series, tie

STATED = (0.02, 0.2, 0.5, 0.8, 0.95, 0.99, 1.0001)
#: Movers of a round, and the share of them that pass a star in the middle of the series.
EACH, ON_STARS = 25, 0.1
NOTES = (
    "found / injected: movers that are on at least three frames, found with a probability of at least 0.5; columns: "
    "magnitude relative to the limit of a median frame (S/N 5 of a stationary star); rows: arcsec/min. Trails make "
    "fast movers fainter. One in ten passes a star.",
    "false: tracklets with at least 0.5 that are no injected mover, except those found in the series without movers; "
    "by their own rate and magnitude",
    "heliolinx 0.0.2, makeTracklets: the same unexplained measurements; at least three points, at most 10″/min, an arc "
    "of at least two pixels, 0.5″ from a great circle (its default); it states no probability and uses no pixels",
)
ADDED = "with --below-limit"
NOISY = "simulated detections, two in three false"
#: Program for a Python with heliolinx 0.0.2. Its arrays keep the first 16 bytes of each row (MJD and RA of a
#: detection), which identify the rows.
HELIOLINX = """
import json, sys
import numpy as np
import heliolinx.heliolinx as hl
given = json.load(sys.stdin)
n, f = len(given["mjd"]), len(given["times"])
order = np.argsort(given["mjd"], kind="stable")
seen = np.zeros(n, hl.create_hldet(1).dtype)
for key, name in (("MJD", "mjd"), ("RA", "ra"), ("Dec", "dec"), ("mag", "magnitude"), ("image", "frame")):
    seen[key] = np.array(given[name])[order]
seen["obscode"], seen["band"], seen["index"] = b"500", b"V", np.arange(n)
images = np.zeros(f, hl.create_hlimage(1).dtype)
images["MJD"], images["obscode"], images["exptime"] = given["times"], b"500", 30.0
images["RA"], images["Dec"] = given["middle"]
config = hl.MakeTrackletsConfig()
config.mintrkpts, config.maxvel, config.maxtime, config.minarc = 3, given["fastest"], given["span"], given["arc"]
config.imagerad = 0.5
paired, _, member = hl.makeTracklets(config, seen, images)
row = {(float(t), float(ra)): int(k) for t, ra, k in zip(seen["MJD"], seen["RA"], order)}
key = [row[float(t), float(ra)] for t, ra in zip(paired["MJD"], paired["RA"])]
out = {}
for tracklet, k in zip(member["i1"].tolist(), member["i2"].tolist()):
    out.setdefault(tracklet, []).append(key[k])
print(json.dumps(list(out.values())))
"""


@dataclass(frozen=True)
class Bins:
    """Bounds: magnitudes above (−) and below (+) the limit of a single frame at which S/N is 5; rates, arcsec/min."""

    magnitudes: tuple[float, ...] = (-4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0)
    rates: tuple[float, ...] = (0.05, 0.2, 0.6, 2.0, 10.0)

    @property
    def shape(self) -> tuple[int, int]:
        """Of tables: rates, magnitudes."""
        return len(self.rates) - 1, len(self.magnitudes) - 1

    def of(self, rate: float, magnitude: float) -> tuple[int, int]:
        """Row and column of a rate and a magnitude; values outside the bounds are in the nearest bin."""
        each = ((rate, self.rates), (magnitude, self.magnitudes))
        row, column = (int(np.clip(np.digitize(x, bounds) - 1, 0, len(bounds) - 2)) for x, bounds in each)
        return row, column

    def drawn(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Rates and magnitudes of the movers of a round."""
        rate = np.exp(rng.uniform(math.log(self.rates[0]), math.log(self.rates[-1]), EACH))
        return rate, rng.uniform(self.magnitudes[0], self.magnitudes[-1], EACH)

    @classmethod
    def below(cls, fastest: float) -> Bins:
        """Bins of the search below the limit."""
        return cls((-0.5, 0.0, 0.25, 0.5, 0.75, 1.0), (0.2, fastest))


BINS = Bins()


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
    bins: Bins = BINS


def real_scene(folder: Path) -> Scene:
    """The frames of a folder, calibrated with its darks; their pointings differ by some pixels."""
    darks = tuple(str(p) for p in sorted(folder.iterdir()) if "dark" in p.name.lower())
    paths = [p for p in frames_in(folder) if p not in darks]
    frames = [
        frame_of(FrameRequest(path=p, folder=".", name=Path(p).stem, catalogue="", darks=darks), lambda stage: None)
        for p in paths
    ]
    order = np.argsort([f.facts.mid_time.mjd for f in frames])
    frames = [frames[k] for k in order]
    measured = [detect(f) for f in frames]
    minutes = np.array([f.facts.mid_time.mjd for f in frames]) * 1440.0
    shifts = np.array([_shift(measured[0], one) for one in measured])
    fwhm = np.array([one.psf_fwhm_px for one in measured])
    limit = float(np.median([5.0 * np.median(one.flux_err[one.snr < 8]) for one in measured]))
    scale = 1.176 if frames[0].facts.scale_arcsec_per_px != frames[0].facts.scale_arcsec_per_px else float(
        frames[0].facts.scale_arcsec_per_px)  # fmt: skip
    return Scene("real frames", tuple(frames), minutes - minutes[0], frames[0].facts.exposure_s / 60.0, scale, shifts,
                 fwhm, limit)  # fmt: skip


def _shift(first: Any, other: Any) -> np.ndarray:
    """(2,) px, the most frequent offset of the sources of a frame from those of the first."""
    bright = [np.column_stack([one.x_px, one.y_px])[np.argsort(-one.flux)[:80]] for one in (first, other)]
    off = (bright[1][:, None] - bright[0][None]).reshape(-1, 2)
    off = off[np.abs(off).max(axis=1) < 60.0]
    near = np.hypot(*(off[:, None] - off[None]).transpose(2, 0, 1)) < 1.5
    best = near[int(np.argmax(near.sum(axis=1)))]
    return np.asarray(off[best].mean(axis=0))


def crowded_scene(rng: np.random.Generator, *, count: int = 8, side: int = 512, stars: int = 1200) -> Scene:
    """Simulated frames of a crowded field: one star per 15 × 15 px, with varying seeing and pointing."""
    at, light = rng.uniform(-20, side + 20, (stars, 2)), 10 ** rng.uniform(2.6, 5.2, stars) ** 1.0
    frames, shifts, fwhm = [], rng.normal(0.0, 3.0, (count, 2)), rng.uniform(2.4, 3.4, count)
    for k in range(count):
        exposed = simulated(
            rng, x_px=at[:, 0] + shifts[k, 0], y_px=at[:, 1] + shifts[k, 1], flux_e=light, psf=Moffat(fwhm[k]),
            camera=Camera(shape=(side, side), sky_e=400.0, hot_pixels=40, cosmics=6), name=f"crowded {k}",
        )  # fmt: skip
        frames.append(exposed.frame)
    errors = [np.median(m.flux_err[m.snr < 8]) for m in (detect(frames[0]),)]
    return Scene("simulated, crowded", tuple(frames), 10.0 * np.arange(count), 0.5, 1.2, shifts, fwhm,
                 5.0 * float(errors[0]))  # fmt: skip


def injected(scene: Scene, rng: np.random.Generator) -> tuple[list[Frame], np.ndarray, np.ndarray, np.ndarray]:
    """The frames with movers, (m, f, 2) their pixels, (m,) rates in arcsec/min, (m,) magnitudes against the limit."""
    rows, columns = scene.frames[0].shape
    rate, magnitude = scene.bins.drawn(rng)
    angle = rng.uniform(0.0, 2 * math.pi, EACH)
    step = (rate / scene.scale)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    middle = rng.uniform([0.15 * columns, 0.15 * rows], [0.85 * columns, 0.85 * rows], (EACH, 2))
    stars = detect(scene.frames[0])
    on_star = np.flatnonzero(rng.random(EACH) < ON_STARS)
    pick = rng.integers(0, len(stars), len(on_star))
    middle[on_star] = np.column_stack([stars.x_px, stars.y_px])[pick] - scene.shifts[0]
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
    """Add the light of a mover along its trail, with photon noise."""
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
    """The measurements of the frames, with plates shifted by an offset that the series must find."""
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


def places_of(series: Series, tracklets: Sequence[Any]) -> list[np.ndarray]:
    """Of every tracklet, rows of the series, (s, 3): frame and pixels of its detections."""
    chip = [np.column_stack([e.x_px, e.y_px]) for e in series.exposures]
    return [
        np.array([[k, *chip[k][r]] for k, r in zip(series.frame[rows], series.row[rows], strict=True)])
        for rows in tracklets
    ]


def _itself(frame: Frame) -> Frame:
    return frame


def searched(
    series: Series, frames: Sequence[Frame], fastest: float | None = None
) -> tuple[list[np.ndarray], np.ndarray, list[np.ndarray], np.ndarray]:
    """Tracklets with a probability of at least 0.02, confirmed in the pixels if there are any, and (k,) p; and the same
    of candidates below the limit of single frames, up to a rate, with positions on all frames."""
    found, series = search(series, min_probability=0.02)
    if frames:
        found, _ = confirmed(found, stack(found, series, frames), 0.02)
    rows = [found.detections.rows[members[members >= 0]] for members in found.members]
    places, more, p = places_of(series, rows), list[np.ndarray](), np.empty(0)
    if frames and fastest:
        # Improbable tracklets keep their light in the frames.
        sure = found.only(found.p_tracklet >= 0.5)
        below = search_below_limit(
            sure, series, [partial(_itself, frame) for frame in frames], fastest, min_probability=0.02
        )
        chip = [chip_map(series, n)(below.place[:, n]) for n in range(len(frames))]
        more = [np.array([[n, *chip[n][k]] for n in range(len(frames))]) for k in range(len(below))]
        p = below.movers.p_tracklet
    return places, found.p_tracklet, more, p


def by_heliolinx(python: Path, series: Series) -> list[np.ndarray]:
    """The tracklets of heliolinx from the unexplained detections."""
    detections = unexplained_detections(series)
    span = float(np.ptp(detections.mjd_utc))
    request = {
        "mjd": detections.frame_mjd[detections.frame].tolist(),
        "ra": detections.ra_deg.tolist(), "dec": detections.dec_deg.tolist(),
        "magnitude": np.nan_to_num(detections.magnitude, nan=20.0).tolist(), "frame": detections.frame.tolist(),
        "times": detections.frame_mjd.tolist(), "middle": list(series.middle_deg), "span": 1.01 * span + 1e-4,
        # As for sameas: at least two pixels in all, at most the fastest injected rate.
        "arc": 2.0 * series.scale_arcsec_per_px, "fastest": BINS.rates[-1] * 24.0 / 60.0,
    }  # fmt: skip
    process = subprocess.run([str(python), "-c", HELIOLINX], input=json.dumps(request), capture_output=True, text=True,
                          check=True)  # fmt: skip
    tracklets = json.loads(next(line for line in process.stdout.splitlines() if line.startswith("[")))
    return places_of(series, [detections.rows[np.array(rows)] for rows in tracklets])


def mover_of(tracklet: np.ndarray, path: np.ndarray, reach: np.ndarray) -> int:
    """The mover of at least 70 % and at least three of the detections of a tracklet; −1 for none."""
    frame, position = tracklet[:, 0].astype(int), tracklet[:, 1:]
    is_near = np.hypot(*(path[:, frame] - position[None]).transpose(2, 0, 1)) < reach[:, None]
    count = is_near.sum(axis=1)
    best = int(np.argmax(count)) if len(count) else -1
    return best if best >= 0 and count[best] >= max(3, 0.7 * len(position)) else -1


class Tally:
    """The results of one program on the rounds of one scene, by rate and magnitude."""

    def __init__(self, scene: str, by: str, bins: Bins = BINS) -> None:
        self.scene, self.by, self.bins = scene, by, bins
        self.found, self.injected, self.wrong = (np.zeros(bins.shape, int) for _ in range(3))
        self.cases: list[tuple[float, bool]] = []

    def add(
        self, case: Case, tracklets: Sequence[np.ndarray], p: np.ndarray | None, before: Sequence[np.ndarray],
        stated_from: int = 0,
    ) -> None:  # fmt: skip
        """Add the tracklets of one round. before : tracklets of the series without movers, which are not false.
        stated_from : index of the first tracklet that counts in the table of stated probabilities."""
        found_movers = set()
        for k, tracklet in enumerate(tracklets):
            owner = mover_of(tracklet, case.path, case.reach)
            if owner < 0 and any(_common(tracklet, one) >= 2 for one in before):
                continue
            if p is not None and k >= stated_from:
                self.cases.append((float(p[k]), owner >= 0))
            if p is None or p[k] >= 0.5:
                if owner >= 0:
                    found_movers.add(owner)
                else:
                    self.wrong[self.bins.of(*case.like(tracklet))] += 1
        for m in np.flatnonzero(case.stays):
            cell = self.bins.of(case.rate[m], case.magnitude[m])
            self.injected[cell] += 1
            self.found[cell] += int(m in found_movers)

    def rows(self) -> list[tuple[Any, ...]]:
        """Rows of the table: found / injected, and false ones."""
        out = []
        for k, (lo, hi) in enumerate(itertools.pairwise(self.bins.rates)):
            cells = [f"{a}/{b}" if b else "–" for a, b in zip(self.found[k], self.injected[k], strict=True)]
            out.append((self.by, f"{lo:g}…{hi:g}", *cells, int(self.wrong[k].sum())))
        totals = [f"{a}/{b}" for a, b in zip(self.found.sum(axis=0), self.injected.sum(axis=0), strict=True)]
        out.append((self.by, "all", *totals, int(self.wrong.sum())))
        out.append((self.by, "false", *map(int, self.wrong.sum(axis=0)), ""))
        return out

    def stated(self) -> list[tuple[Any, ...]]:
        """Rows of the table of stated probabilities and the share that is real."""
        p, real = np.array([c[0] for c in self.cases]), np.array([c[1] for c in self.cases], bool)
        out = []
        for lo, hi in itertools.pairwise(STATED):
            inside = (p >= lo) & (p < hi)
            if inside.any():
                out.append((self.scene, self.by, f"{lo:g}…{min(hi, 1.0):g}", int(inside.sum()),
                            f"{p[inside].mean():.3f}", f"{real[inside].mean():.3f}"))  # fmt: skip
        return out


@dataclass(frozen=True)
class Case:
    """One series with movers. path : (m, f, 2) px on the chip. reach : (m,) px within which a detection is a mover's.

    limit : flux of S/N 5. stays : (m,) whether on at least three frames.
    """

    series: Series
    frames: tuple[Frame, ...]
    path: np.ndarray
    rate: np.ndarray
    magnitude: np.ndarray
    reach: np.ndarray
    limit: float
    stays: np.ndarray

    def like(self, tracklet: np.ndarray) -> tuple[float, float]:
        """Rate and magnitude of a false tracklet: its mean rate and its median light."""
        exposures = self.series.exposures
        k = tracklet[:, 0].astype(int)
        minutes = 1440.0 * (exposures[k[-1]].mjd_utc - exposures[k[0]].mjd_utc)
        rate = np.hypot(*(tracklet[-1, 1:] - tracklet[0, 1:])) * self.series.scale_arcsec_per_px / max(minutes, 1e-9)
        flux = [exposures[f].flux[np.argmin(np.hypot(exposures[f].x_px - x, exposures[f].y_px - y))] for f, x, y in
                zip(k, *tracklet[:, 1:].T, strict=True)]  # fmt: skip
        return rate, -2.5 * math.log10(max(float(np.median(flux)), 1e-9) / self.limit)


def case_of(scene: Scene, rng: np.random.Generator) -> Case:
    """A round: movers injected into the pixels, and everything measured again."""
    frames, path, rate, magnitude = injected(scene, rng)
    series = with_trails(tie(exposures(scene, frames)), frames)
    rows, columns = scene.frames[0].shape
    stays = ((path > 5) & (path < [columns - 6, rows - 6])).all(axis=2).sum(axis=1) >= 3
    reach = 2.0 + 0.5 * rate / scene.scale * scene.exposure_min
    return Case(series, tuple(frames), path, rate, magnitude, reach, scene.limit, stays)


def noisy_case(rng: np.random.Generator, *, count: int = 5, side: int = 1024, false: int = 1000) -> Case:
    """Measurements without pixels: 500 stars, and on every frame 1000 false ones near the limit."""
    scale, every, stars, limit = 1.2, 12.0, 500, 300.0
    star_xy, star_flux = rng.uniform(5, side - 5, (stars, 2)), limit * 10 ** rng.uniform(0.0, 2.4, stars)
    rate, magnitude = BINS.drawn(rng)
    angle = rng.uniform(0.0, 2 * math.pi, EACH)
    step = (rate / scale)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    minutes = every * np.arange(count)
    middle = rng.uniform(0.15 * side, 0.85 * side, (EACH, 2))
    path = middle[:, None] + (minutes - minutes.mean())[None, :, None] * step[:, None]
    out = []
    for k in range(count):
        flux = np.concatenate([star_flux, limit * 10 ** (-0.4 * magnitude)])
        xy = np.concatenate([star_xy, path[:, k]])
        flux = flux + limit / 5.0 * rng.standard_normal(len(flux))
        detected = (flux > limit) & ((xy > 0) & (xy < side)).all(axis=1)
        flux = np.concatenate([flux[detected], limit * (1.0 - rng.random(false)) ** -0.4])
        xy = np.concatenate([xy[detected], rng.uniform(0, side, (false, 2))])
        sigma = 0.02 + 1.3 * limit / 5.0 / flux
        xy = xy + sigma[:, None] * rng.standard_normal(xy.shape)
        dec, n = 22.9 + (xy[:, 1] - side / 2) * scale / 3600.0, len(xy)
        cov = np.column_stack([sigma**2, np.zeros(n), sigma**2])
        ra = 62.5 + (xy[:, 0] - side / 2) * scale / 3600.0 / np.cos(np.radians(dec))
        out.append(
            Exposure(
                f"{k:03d}", 58409.1 + minutes[k] / 1440.0, xy[:, 0], xy[:, 1], cov, ra, dec, cov * scale**2, flux,
                np.full(n, limit / 5.0), flux * 5.0 / limit, np.zeros(n, np.int64), np.zeros(n), np.full(n, np.nan),
                scale, (side, side), 30.0,
            )
        )  # fmt: skip
    stays = ((path > 0) & (path < side)).all(axis=2).sum(axis=1) >= 3
    return Case(tie(out), (), path, rate, magnitude, np.full(EACH, 2.0), limit, stays)


def tables(
    scenes: Sequence[Scene], rounds: int, rng: np.random.Generator, peer: Path | None = None,
    fastest: float | None = None,
) -> list[Table]:  # fmt: skip
    """Injected movers found by `sameas` and by heliolinx, and stated probabilities; draws the figure too.

    fastest : highest rate of the search below the limit of single frames, arcsec/min; None for no search."""
    bins = Bins.below(fastest) if fastest else BINS
    heads = [f"{lo:+g}…{hi:+g}" for lo, hi in itertools.pairwise(bins.magnitudes)]
    out, stated, drawn = [], [], []
    # Nothing can be found below the limit without pixels.
    with_bins = [replace(scene, bins=bins) for scene in scenes]
    for scene in with_bins if fastest else (*with_bins, None):
        name = NOISY if scene is None else scene.name
        contenders = ["sameas", *([ADDED] if fastest and scene else []), *(["heliolinx"] if peer else [])]
        tallies = {by: Tally(name, by, bins) for by in contenders}
        before: dict[str, list[np.ndarray]] = {"sameas": [], "heliolinx": [], ADDED: []}
        if scene is not None:
            without_movers = with_trails(tie(exposures(scene, scene.frames)), scene.frames)
            linked, _, more, _ = searched(without_movers, scene.frames, fastest)
            before["sameas"], before[ADDED] = linked, linked + more
            if peer:
                before["heliolinx"] = by_heliolinx(peer, without_movers)
        for _ in range(rounds if scene else 4 * rounds):
            case = noisy_case(rng) if scene is None else case_of(scene, rng)
            places, p, more, p_more = searched(case.series, case.frames, fastest)
            tallies["sameas"].add(case, places, p, before["sameas"])
            if ADDED in tallies:
                both = np.concatenate([p, p_more])
                tallies[ADDED].add(case, places + more, both, before[ADDED], stated_from=len(places))
            if peer:
                tallies["heliolinx"].add(case, by_heliolinx(peer, case.series), None, before["heliolinx"])
        sameas = tallies["sameas"]
        note = f"{rounds if scene else 4 * rounds} series, {int(sameas.injected.sum())} movers on at least three frames"
        rows = [row for tally in tallies.values() for row in tally.rows()]
        out.append(Table(f"Injected movers: {name}", ("by", "rate ″/min", *heads, "false"), rows, (note, *NOTES)))
        stated += [row for tally in tallies.values() for row in tally.stated()]
        drawn += list(tallies.values())
    out.append(
        Table(
            "Stated probabilities of candidates", ("series", "by", "stated p", "candidates", "mean p", "real"), stated
        )
    )
    if not fastest:
        draw(drawn)
    return out


def _common(one: np.ndarray, other: np.ndarray) -> int:
    """Detections that two tracklets have in common, to 1.5 px."""
    same = (one[:, None, 0] == other[None, :, 0]) & (
        np.hypot(*(one[:, None, 1:] - other[None, :, 1:]).transpose(2, 0, 1)) < 1.5
    )
    return int(same.any(axis=1).sum())


def draw(drawn: Sequence[Tally]) -> None:
    """Draw the share found against magnitude by rate, one panel per scene, heliolinx dotted; false ones below."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scenes = list(dict.fromkeys(one.scene for one in drawn))
    figure, axes = plt.subplots(2, len(scenes), figsize=(4.6 * len(scenes), 5.6), squeeze=False, layout="constrained",
                                sharex=True, height_ratios=(3, 1))  # fmt: skip
    middle = 0.5 * (np.array(BINS.magnitudes[1:]) + np.array(BINS.magnitudes[:-1]))
    width = np.diff(BINS.magnitudes)
    for column, scene in enumerate(scenes):
        top, low = axes[:, column]
        for tally in (one for one in drawn if one.scene == scene):
            is_sameas = tally.by == "sameas"
            for k, (lo, hi) in enumerate(itertools.pairwise(tally.bins.rates)):
                full = tally.injected[k] > 0
                share = tally.found[k] / np.maximum(tally.injected[k], 1)
                sigma = np.sqrt(np.maximum(share * (1 - share), 0.05) / np.maximum(tally.injected[k], 1))
                x = middle[full] + 0.06 * (k - 1.5) + (0.0 if is_sameas else 0.02)
                top.errorbar(x, share[full], sigma[full] if is_sameas else None, color=f"C{k}", ms=5,
                             marker="o" if is_sameas else "x", ls="-" if is_sameas else ":",
                             lw=1.4 if is_sameas else 1.1,
                             label=f"{tally.by}, {lo:g}…{hi:g} ″/min")  # fmt: skip
            off = (-0.2 if is_sameas else 0.2) * width
            low.bar(middle + off, tally.wrong.sum(axis=0), 0.38 * width, color="C7" if is_sameas else "0.8",
                    label=tally.by)  # fmt: skip
        top.set(title=scene, ylim=(-0.03, 1.08))
        low.set(xlabel="magnitude against the limit of a frame", ylim=(0.0, max(1.0, low.get_ylim()[1])))
        for axis in (top, low):
            axis.axvline(0.0, color="0.7", lw=1, zorder=0)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0][0].set_ylabel("share found")
    axes[1][0].set_ylabel("false")
    axes[0][0].legend(fontsize=7, frameon=False)
    axes[1][0].legend(fontsize=8, frameon=False)
    OUTPUT.mkdir(exist_ok=True)
    figure.savefig(OUTPUT / "movers-injected.png", dpi=110)
    plt.close(figure)
