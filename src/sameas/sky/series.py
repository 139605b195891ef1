"""A series of frames of one field: each star once with its measurements in all frames, and the unexplained rest.

Identified frames (:class:`Exposure`) become a :class:`Series`; its stationary sources become
:class:`~sameas.sky.series_stars.SeriesStars`, with zero points and differential magnitudes. The rest is searched for
movers (:mod:`sameas.sky.movers.search`).

Stationary sources are known from the catalogue and from the series itself: repeated measurements at one position on the
sky (stars missing in the catalogue) or on the chip (hot pixels). These sources also tie the frames to each other, far
better than a catalogue of a few stars: the plate of each frame is mapped by an affine transform to the mean of all.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sameas.arrays import BoolArray, FloatArray, IntArray, robust_scale
from sameas.errors import InputError
from sameas.sky import column_values
from sameas.sky.frame.measurements import PIXEL_FLAGS, Flag
from sameas.sky.series_stars import SeriesMeasurements, SeriesStars, gather
from sameas.space import ARCSEC_PER_RADIAN, directions_deg, from_plane, to_plane, unit_vectors

if TYPE_CHECKING:
    from astropy.table import Table

#: Maximum number of sources of a frame compared with a position.
NEIGHBOURS = 3
#: Minimum of the extra scatter of a frame's bright sources, arcsec (chosen).
MIN_FLOOR_ARCSEC = 0.02
#: Flags of measurements with an unreliable position: never movers.
_SPOILT = Flag.HOT | Flag.COSMIC | Flag.POOR | Flag.EDGE
#: Flags of measurements whose flux is not that of one star: incomplete, or of a pair in one mark, which looks trailed.
_OTHER_LIGHT = PIXEL_FLAGS | Flag.EDGE | Flag.POOR | Flag.TRAILED


REACH_PX = 1.2  # maximum separation of measurements of one source in two frames, or 3σ if larger
TIE_ARCSEC = 4.0  # maximum separation of sources that tie frames, by their plates
TIE_SNR = 15.0  # minimum signal to noise
MIN_TIES = 8  # minimum number of sources to tie a frame; with fewer its own plate is used
DRIFT_SIGMAS, DRIFT_PX = 4.0, 0.6  # a source drifts if its drift over the series exceeds both
OFTEN = 0.5  # minimum share of the other frames that show a stationary source without a drift
MIN_P_STAR = 0.5  # minimum probability of a catalogue star
COMPARED = 24  # number of frames, evenly over the series, with which each measurement is compared
MIN_OVERLAP = 0.7  # maximum offset of a frame from the middle of the field, as a share of its diagonal
MOST_PULLED = 0.5  # maximum share of its distance by which a star draws a measurement
SAME_TIME_DAYS = 1.0 / 86400.0  # frames within a second of each other are one, or have a wrong time


@dataclass(frozen=True)
class Exposure:
    """The measurements of one frame with their positions on the sky; (n,) each.

    name : of the frame. mjd_utc : middle of the exposure. x_px, y_px, covariance_px (n, 3) : on the chip.
    ra_deg, dec_deg : by the frame's plate. covariance : (n, 3) arcsec² by the plate, with the plate's error.
    flux, flux_err, snr, flags : as measured. p_star : probability of a catalogue star.
    magnitude : NaN without a zero point. scale_arcsec_per_px. shape : (rows, columns). exposure_s.
    star : identifier of the catalogue star, "" for none; None if no stars are known. psf_fwhm_px : FWHM of stars.
    """

    name: str
    mjd_utc: float
    x_px: FloatArray
    y_px: FloatArray
    covariance_px: FloatArray
    ra_deg: FloatArray
    dec_deg: FloatArray
    covariance: FloatArray
    flux: FloatArray
    flux_err: FloatArray
    snr: FloatArray
    flags: IntArray
    p_star: FloatArray
    magnitude: FloatArray
    scale_arcsec_per_px: float
    shape: tuple[int, int]
    exposure_s: float = math.nan
    star: NDArray[Any] | None = None
    psf_fwhm_px: float = 3.0

    def __len__(self) -> int:
        return len(self.x_px)

    @classmethod
    def of_listing(
        cls, table: Any, name: str, mjd_utc: float, scale: float, shape: tuple[int, int], exposure_s: float,
        psf_fwhm_px: float,
    ) -> Exposure:  # fmt: skip
        """The exposure of the table of an identified frame, as made by :func:`sameas.sky.listing`."""
        rows = table[~np.ma.getmaskarray(np.ma.MaskedArray(table["measurement"]))]

        def column(key: str) -> FloatArray:
            return column_values.numbers(rows, key, name)

        def matrix(*keys: str) -> FloatArray:
            return np.column_stack([column(key) for key in keys])

        merged = _pull_px(table, name, psf_fwhm_px)[:, None] ** 2 * [1.0, 0.0, 1.0]
        covariance = matrix("cov_ee_arcsec2", "cov_en_arcsec2", "cov_nn_arcsec2")
        return cls(
            name=name, mjd_utc=mjd_utc, x_px=column("x_px"), y_px=column("y_px"),
            covariance_px=matrix("cov_xx_px2", "cov_xy_px2", "cov_yy_px2") + merged, ra_deg=column("ra_deg"),
            dec_deg=column("dec_deg"), covariance=covariance + merged * scale**2,
            flux=column("flux"), flux_err=column("flux_err"), snr=column("snr"), flags=column("flags").astype(np.int64),
            p_star=np.nan_to_num(column("p_match")), magnitude=column("magnitude"), scale_arcsec_per_px=scale,
            shape=shape, exposure_s=exposure_s, star=np.ma.filled(np.ma.MaskedArray(rows["star"]).astype(str), ""),
            psf_fwhm_px=psf_fwhm_px,
        )  # fmt: skip

    def with_row(self, ra_deg: float, dec_deg: float, magnitude: float) -> Exposure:
        """With one more row, of unit flux and the typical error, for a source that is measured otherwise."""
        new = {"ra_deg": ra_deg, "dec_deg": dec_deg, "magnitude": magnitude, "flux": 1.0, "flux_err": 0.0, "snr": 0.0,
               "flags": 0, "p_star": 0.0, "x_px": 0.0, "y_px": 0.0}  # fmt: skip
        rows: dict[str, Any] = {name: np.append(getattr(self, name), value) for name, value in new.items()}
        for name in ("covariance_px", "covariance"):
            rows[name] = np.vstack([getattr(self, name), np.median(getattr(self, name), axis=0)])
        return replace(self, star=None if self.star is None else np.append(self.star, ""), **rows)

    @property
    def names(self) -> NDArray[Any]:
        """(n,) identifiers of the stars of the catalogue, "" for none."""
        return np.full(len(self), "") if self.star is None else self.star


def _pull_px(table: Any, name: str, psf_fwhm_px: float) -> FloatArray:
    """(n,) how far a star of the catalogue without a measurement of its own draws each measurement of a listing, px.

    A star of flux f at a distance d draws the fitted place of a source of flux F by d (f/F) exp(−d²/4σ²), to first
    order in f/F, with σ of the profile; the distance is known from the drawn place only.
    """
    column = partial(column_values.numbers, table, source=name)
    unmeasured = np.ma.getmaskarray(np.ma.MaskedArray(table["measurement"]))
    px = np.column_stack([column("x_px"), column("y_px")])
    seen, known = (column(key) for key in ("magnitude", "star_magnitude"))
    sources, stars = (
        np.flatnonzero(~unmeasured),
        np.flatnonzero(unmeasured & np.isfinite(known) & np.isfinite(px).all(axis=1)),
    )
    pull = np.zeros(len(sources))
    if not len(stars) or not len(sources):
        return pull
    near = cKDTree(px[sources]).sparse_distance_matrix(cKDTree(px[stars]), 2.0 * psf_fwhm_px, output_type="ndarray")
    share = 10.0 ** (0.4 * (seen[sources[near["i"]]] - known[stars[near["j"]]]))
    share = np.nan_to_num(share) * np.exp(-((near["v"] / psf_fwhm_px) ** 2) * 2.0 * math.log(2.0))
    share = np.minimum(share, MOST_PULLED)
    np.maximum.at(pull, near["i"], near["v"] * share / (1.0 - share))
    return pull


@dataclass(frozen=True)
class Streak:
    """A trail of one frame that is in no tracklet.

    frame : number of the exposure. ends : (2, 2) arcsec east and north in the common system, the first to the west.
    snr : signal to noise ratio.
    """

    frame: int
    ends: FloatArray
    snr: float

    @classmethod
    def of(cls, frame: int, ends: FloatArray, snr: float) -> Streak:
        """Of ends in either order."""
        return cls(int(frame), ends[np.argsort(ends[:, 0], kind="stable")], float(snr))


@dataclass(frozen=True)
class Trails:
    """Trails of sources that moved during the exposure.

    arcsec : (n, 2) from one end to the other, east and north, of either sign; NaN without a trail. sigma_arcsec : (n,)
    its error per axis. min_widths : minimum length of a visible trail, in FWHM of a star. added : number of trails,
    the last rows, that are no measurements of their frames. long : too long for a mover. hidden : share of the pixels
    that are unusable or close to a known source, where no mover is measured.
    """

    arcsec: FloatArray
    sigma_arcsec: FloatArray
    min_widths: float
    added: int = 0
    long: tuple[Streak, ...] = ()
    hidden: float = math.nan


@dataclass(frozen=True)
class Series:
    """A series of frames tied together.

    exposures : in order of time. frame, row : (n,) exposure of each measurement, and its row there.
    place : (n, 2) arcsec east and north of ``middle_deg`` on the tangent plane, in the common system.
    sigma_arcsec : (n,) error of the position relative to other frames, per axis.
    star : (n,) mask of catalogue stars. stationary : (n,) stationary on the sky. fixed : (n,) stationary on the chip.
    unreliable : (n,) with an unreliable position: a hot pixel, a cosmic ray hit, cut at the edge.
    magnitude : (n,) differential, on the scale of the catalogue if any frame has it.
    floor_arcsec : (f,) extra scatter of bright sources. shift_arcsec : (f, 2) median shift of the plates.
    ties : (f,) number of sources that tie each frame. stars : with their measurements. notes : lines for the user.
    trails : if measured.
    """

    exposures: tuple[Exposure, ...]
    middle_deg: tuple[float, float]
    frame: IntArray
    row: IntArray
    place: FloatArray
    sigma_arcsec: FloatArray
    star: BoolArray
    stationary: BoolArray
    fixed: BoolArray
    unreliable: BoolArray
    magnitude: FloatArray
    floor_arcsec: FloatArray
    shift_arcsec: FloatArray
    ties: IntArray
    stars: SeriesStars
    notes: tuple[str, ...] = ()
    trails: Trails | None = None

    @property
    def scale_arcsec_per_px(self) -> float:
        """The median scale of the frames."""
        return float(np.median([e.scale_arcsec_per_px for e in self.exposures]))

    @property
    def unexplained(self) -> BoolArray:
        """(n,) mask of the measurements without another explanation: candidates for movers."""
        return ~(self.star | self.stationary | self.fixed | self.unreliable)

    def measured(self, name: str, rows: IntArray) -> NDArray[Any]:
        """(k,) a column of the exposures, such as ``"snr"``, at rows (k,) of the series."""
        start = np.cumsum([0, *(len(one) for one in self.exposures)])[:-1]
        column = np.concatenate([getattr(one, name) for one in self.exposures])
        return np.asarray(column[start[self.frame[rows]] + self.row[rows]])

    def sky(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(k,) ra_deg, dec_deg of places (k, 2) on the tangent plane."""
        return directions_deg(from_plane(place / ARCSEC_PER_RADIAN, unit_vectors(*self.middle_deg)))

    def star_table(self) -> Table:
        """A table with one row per star; values per frame are in columns of (f,) arrays."""
        from astropy.table import Table

        stars = self.stars
        ra, dec = self.sky(stars.place)
        there = stars.measurement >= 0
        number = np.where(there, self.row[np.maximum(stars.measurement, 0)], 0)
        table = Table(
            {
                "star": np.arange(len(stars)),
                "id": np.ma.MaskedArray(stars.name, stars.name == ""),
                "ra_deg": ra,
                "dec_deg": dec,
                "sigma_arcsec": stars.sigma_arcsec,
                "frames": there.sum(axis=1),
                "magnitude": np.ma.masked_invalid(stars.mean),
                "magnitude_err": np.ma.masked_invalid(stars.mean_error),
                "scatter_mag": np.ma.masked_invalid(stars.scatter_mag),
                "p_constant": np.ma.masked_invalid(stars.p_constant),
                "measurement": np.ma.MaskedArray(number, ~there),
                "frame_magnitude": np.ma.masked_invalid(stars.magnitude),
                "frame_magnitude_err": np.ma.masked_invalid(stars.error),
                "residual_east_arcsec": np.ma.masked_invalid(stars.residual_arcsec[..., 0]),
                "residual_north_arcsec": np.ma.masked_invalid(stars.residual_arcsec[..., 1]),
            }
        )
        for name in table.colnames:
            unit = next((u for key, u in _UNITS.items() if name.endswith(key)), None)
            table[name].unit = "mag" if "magnitude" in name else unit
        table.meta["frames"] = " ".join(e.name for e in self.exposures)
        table.meta["magnitudes"] = stars.scale
        return table

    def frame_table(self) -> Table:
        """A table with one row per frame: time, relative zero point, and its tie to the others."""
        from astropy.table import Table

        each, stars = self.exposures, self.stars
        table = Table(
            {
                "frame": np.array([e.name for e in each]),
                "mjd_utc": np.array([e.mjd_utc for e in each]),
                "exposure_s": np.ma.masked_invalid([e.exposure_s for e in each]),
                "measurements": np.array([len(e) for e in each]),
                "stars": (stars.measurement >= 0).sum(axis=0),
                "zero_point_mag": np.ma.masked_invalid(stars.zero_point),
                "zero_point_err_mag": np.ma.masked_invalid(stars.zero_error),
                "zero_point_stars": stars.ensemble,
                "ties": self.ties,
                "shift_east_arcsec": self.shift_arcsec[:, 0],
                "shift_north_arcsec": self.shift_arcsec[:, 1],
                "scatter_arcsec": self.floor_arcsec,
            }
        )
        for name, unit in (("mjd_utc", "d"), ("exposure_s", "s")):
            table[name].unit = unit
        for name in table.colnames:
            of_name = next((u for key, u in _UNITS.items() if name.endswith(key)), None)
            table[name].unit = of_name or table[name].unit
        table.meta["magnitudes"] = stars.scale
        return table


_UNITS = {"_deg": "deg", "_arcsec": "arcsec", "_mag": "mag"}


def tie(exposures: Sequence[Exposure]) -> Series:
    """A series of frames of one field, tied together, with stationary sources marked.

    Raises InputError: fewer than two frames; frames of different fields; frames of the same time.
    """
    ordered = tuple(sorted(exposures, key=lambda e: e.mjd_utc))
    middle = _checked(ordered, MIN_OVERLAP)
    frame = np.concatenate([np.full(len(e), k) for k, e in enumerate(ordered)])
    row = np.concatenate([np.arange(len(e)) for e in ordered])
    everything = {
        name: np.concatenate([getattr(e, name) for e in ordered])
        for name in ("x_px", "y_px", "covariance_px", "snr", "flags", "p_star", "magnitude", "flux", "flux_err")
    }
    scale = np.array([e.scale_arcsec_per_px for e in ordered])
    ra, dec = (np.concatenate(angles) for angles in zip(*((e.ra_deg, e.dec_deg) for e in ordered), strict=True))
    place = ARCSEC_PER_RADIAN * to_plane(unit_vectors(ra, dec), unit_vectors(*middle))
    variance = 0.5 * (everything["covariance_px"][:, 0] + everything["covariance_px"][:, 2]) * scale[frame] ** 2
    good = (everything["snr"] >= TIE_SNR) & ((everything["flags"] & ~int(Flag.BLENDED)) == 0)
    tied, ties = _tied(place, frame, variance, good, len(ordered))
    floor = _floors(tied, frame, variance, good, len(ordered))
    sigma = np.sqrt(variance + floor[frame] ** 2)
    reach = REACH_PX * float(np.median(scale))
    minutes = np.array([e.mjd_utc for e in ordered])[frame] * 1440.0
    drift = DRIFT_PX * float(np.median(scale))
    stationary = _stationary(tied, frame, minutes, sigma, reach, drift, len(ordered))
    chip = np.column_stack([everything["x_px"], everything["y_px"]])
    dithered_px = _dither_px(tied, chip, frame, stationary, len(ordered))
    fixed = np.zeros(len(frame), bool)
    if dithered_px > 2.0 * REACH_PX:
        # Only for dithered frames: otherwise chip defects are stationary on the sky too.
        fixed = _stationary(chip, frame, minutes, sigma / scale[frame], 0.5, 0.5, len(ordered))
    names = np.concatenate([e.names for e in ordered])
    names = np.where(everything["p_star"] >= MIN_P_STAR, names, "")
    measured = SeriesMeasurements(
        tied, frame, sigma, names, everything["flux"], everything["flux_err"],
        (everything["flags"] & int(_OTHER_LIGHT)) == 0, everything["magnitude"], len(ordered),
    )  # fmt: skip
    stars = gather(measured, stationary & ~fixed, 0.25 * float(np.median(scale)))
    magnitude = stars.magnitudes(everything["flux"], frame)
    each = [(tied - place)[frame == k] for k in range(len(ordered))]
    shift = np.array([np.median(off, axis=0) if len(off) else [0.0, 0.0] for off in each])
    return Series(
        exposures=ordered, middle_deg=middle, frame=frame, row=row, place=tied, sigma_arcsec=sigma,
        star=everything["p_star"] >= MIN_P_STAR, stationary=stationary, fixed=fixed & ~stationary,
        unreliable=(everything["flags"] & int(_SPOILT)) != 0, magnitude=magnitude, floor_arcsec=floor,
        shift_arcsec=shift, ties=ties, stars=stars, notes=_notes(ordered, ties, MIN_TIES),
    )  # fmt: skip


def _checked(exposures: tuple[Exposure, ...], overlap: float) -> tuple[float, float]:
    """The middle of the field, degrees; frames of different fields or of the same time are refused."""
    if len(exposures) < 2:
        raise InputError(f"{len(exposures)} frame could be used; movers need two frames, better three")
    for one, other in itertools.pairwise(exposures):
        if abs(one.mjd_utc - other.mjd_utc) < SAME_TIME_DAYS:
            raise InputError(f"{other.name}: its time is that of {one.name}; check DATE-OBS, or give each frame once")
    middles = np.array([unit_vectors(np.median(e.ra_deg), np.median(e.dec_deg)) for e in exposures if len(e)])
    centre = np.median(middles, axis=0)
    centre /= np.linalg.norm(centre)
    for e, unit in zip([e for e in exposures if len(e)], middles, strict=True):
        off = math.degrees(math.acos(min(1.0, float(unit @ centre))))
        diagonal = math.hypot(*e.shape) * e.scale_arcsec_per_px / 3600.0
        if off > overlap * diagonal:
            raise InputError(
                f"{e.name}: points {off:.2f}° from the middle of the other frames, which are {diagonal:.2f}° across; "
                "search the frames of each field by themselves"
            )
    ra, dec = directions_deg(centre)
    return float(ra), float(dec)


def _tied(
    place: FloatArray, frame: IntArray, variance: FloatArray, good: BoolArray, frames: int
) -> tuple[FloatArray, IntArray]:
    """Positions in the common system, and the number of sources that tie each frame to it."""
    tied, ties = place.copy(), np.zeros(frames, np.int64)
    reference = int(np.argmax(np.bincount(frame[good], minlength=frames)))
    known = place[good & (frame == reference)]
    for iteration in range(3):
        if len(known) < MIN_TIES:
            return place, ties
        reach = TIE_ARCSEC / (1.0 if iteration == 0 else 2.0)
        tree = cKDTree(known)
        sums, counts = np.zeros_like(known), np.zeros(len(known))
        for k in range(frames):
            rows = np.flatnonzero(good & (frame == k))
            if not len(rows):
                continue
            distance, at = tree.query(tied[rows], distance_upper_bound=reach)
            nearest_back = cKDTree(tied[rows]).query(known, distance_upper_bound=reach)[1]
            mutual = np.isfinite(distance)
            mutual[mutual] = nearest_back[at[mutual]] == np.flatnonzero(mutual)
            if mutual.sum() < MIN_TIES:
                continue
            solution, used = _affine(place[rows[mutual]], known[at[mutual]], variance[rows[mutual]])
            ties[k] = used
            of_frame = frame == k
            tied[of_frame] = np.column_stack([place[of_frame], np.ones(of_frame.sum())]) @ solution
            np.add.at(sums, at[mutual], tied[rows[mutual]])
            np.add.at(counts, at[mutual], 1.0)
        often = counts >= max(2, 0.5 * frames)
        known = (sums / np.maximum(counts, 1.0)[:, None])[often]
    return tied, ties


def _affine(source: FloatArray, target: FloatArray, variance: FloatArray) -> tuple[FloatArray, int]:
    """(3, 2) affine map from ``source`` to ``target`` by robust weighted least squares, and the number of pairs."""
    design = np.column_stack([source, np.ones(len(source))])
    keep = np.ones(len(source), bool)
    for _ in range(5):
        weight = np.sqrt(1.0 / (variance[keep] + 0.05**2))[:, None]
        solution = np.linalg.lstsq(design[keep] * weight, target[keep] * weight, rcond=None)[0]
        distance = np.hypot(*(target - design @ solution).T)
        limit = max(4.0 * 1.2 * float(np.median(distance[keep])), 0.1)
        within = distance < limit
        if within.sum() < 4 or (within == keep).all():
            break
        keep = within
    return solution, int(keep.sum())


def _floors(place: FloatArray, frame: IntArray, variance: FloatArray, good: BoolArray, frames: int) -> FloatArray:
    """(f,) robust scatter of bright sources about their median positions in excess of their errors, arcsec per axis."""
    floor = np.full(frames, 0.05)
    first = np.flatnonzero(good & (frame == int(np.argmax(np.bincount(frame[good], minlength=frames)))))
    if len(first) < MIN_TIES:
        return floor
    tree = cKDTree(place[first])
    offsets, variances = [], []
    for k in range(frames):
        rows = np.flatnonzero(good & (frame == k))
        distance, at = tree.query(place[rows], distance_upper_bound=0.5 * TIE_ARCSEC)
        matched = np.isfinite(distance)
        residual = np.full((len(first), 2), np.nan)
        residual[at[matched]] = place[rows[matched]]
        var = np.full(len(first), np.nan)
        var[at[matched]] = variance[rows[matched]]
        offsets.append(residual)
        variances.append(var)
    stack = np.array(offsets)
    with warnings.catch_warnings():
        # Sources that no frame shows have no median.
        warnings.simplefilter("ignore")
        centre = np.nanmedian(stack, axis=0)
        for k in range(frames):
            residual = (stack[k] - centre).ravel()
            spread = robust_scale(residual - np.nanmedian(residual))
            if np.isfinite(spread):
                floor[k] = math.sqrt(max(spread**2 - np.nanmedian(variances[k]), MIN_FLOOR_ARCSEC**2))
    return floor


def _stationary(
    place: FloatArray, frame: IntArray, minutes: FloatArray, sigma: FloatArray, reach: float, least_drift: float,
    frames: int,
) -> BoolArray:  # fmt: skip
    """(n,) mask of the measurements with counterparts at the same position in other frames, without a drift.

    The other frames are at most ``compared``, evenly over the series, so that the cost per frame is constant.
    """
    n = len(frame)
    others = np.unique(np.linspace(0, frames - 1, min(frames, COMPARED)).astype(np.int64))
    # Sums for a line fitted to the neighbours and the measurement itself.
    weight = 1.0 / sigma**2
    s0, s1, s2, hits = weight.copy(), np.zeros(n), np.zeros(n), np.zeros(n)
    off0, off1 = np.zeros((n, 2)), np.zeros((n, 2))
    widest = max(reach, 3.0 * math.sqrt(2.0) * float(np.percentile(sigma, 99.0)))
    for k in others:
        rows = np.flatnonzero(frame == k)
        if not len(rows):
            continue
        distance, at = cKDTree(place[rows]).query(place, NEIGHBOURS, distance_upper_bound=widest, workers=-1)
        detected = np.zeros(n, bool)
        for column in range(NEIGHBOURS):
            i = np.flatnonzero(np.isfinite(distance[:, column]) & (frame != k))
            j = rows[at[i, column]]
            near = distance[i, column] < np.maximum(reach, 3.0 * np.hypot(sigma[i], sigma[j]))
            i, j = i[near], j[near]
            w, t, offset = weight[j], minutes[j] - minutes[i], place[j] - place[i]
            s0[i] += w
            s1[i] += w * t
            s2[i] += w * t**2
            off0[i] += w[:, None] * offset
            off1[i] += (w * t)[:, None] * offset
            detected[i] = True
        hits += detected
    determinant = s0 * s2 - s1**2
    span = float(np.ptp(minutes))
    with np.errstate(all="ignore"):
        drift = (s0[:, None] * off1 - s1[:, None] * off0) / determinant[:, None]
        error = np.sqrt(s0 / determinant)
        speed = np.hypot(*drift.T)
    drifting = np.nan_to_num(speed, nan=0.0) * span > least_drift
    significant = np.nan_to_num(speed / error, nan=0.0) > DRIFT_SIGMAS
    compared = len(others) - np.isin(frame, others)
    often = hits >= np.maximum(2.0, OFTEN * compared)
    few = hits >= (2.0 if frames > 3 else 1.0)
    return (often & ~(drifting & significant)) | (few & ~significant)


def _dither_px(place: FloatArray, chip: FloatArray, frame: IntArray, stationary: BoolArray, frames: int) -> float:
    """The largest displacement of the field on the chip along an axis, px."""
    middles = []
    for k in range(frames):
        selected = stationary & (frame == k)
        if selected.sum() < 4:
            continue
        design = np.column_stack([place[selected], np.ones(selected.sum())])
        solution = np.linalg.lstsq(design, chip[selected], rcond=None)[0]
        middles.append(solution[2])
    return float(np.ptp(np.array(middles), axis=0).max()) if len(middles) > 1 else 0.0


def _notes(exposures: tuple[Exposure, ...], ties: IntArray, min_ties: int) -> tuple[str, ...]:
    loose = [e.name for e, n in zip(exposures, ties, strict=True) if n < min_ties]
    return tuple(
        f"{name}: fewer than {min_ties} sources link it to the others; its own plate solution is used" for name in loose
    )
