"""The search on a series of frames: from what the tied frames leave over to what moves there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.sky.movers.detections import Detections, TrailRates
from sameas.sky.movers.model import MotionModel, Tuning
from sameas.sky.movers.search import Movers, find_movers, learn_motion
from sameas.sky.series.tied import Series


@dataclass(frozen=True)
class SearchTuning:
    """How a series is searched.

    Attributes
    ----------
    least_move_px : what moves less between its first and last frame stands still: a faint or blended star.
    turns : the search is repeated without what it has shown to stand still, so many times at most.
    counts : what is believed of movers weighs as many links: what is left of frames is mostly noise, which teaches
        nothing of rates.
    """

    least_move_px: float = 2.0
    turns: int = 3
    counts: float = 300.0


DEFAULT_TUNING = SearchTuning()
#: Little is left of a series, and three frames have to agree: links that no main-belt object makes are tried too. With
#: −6, the bound of alerts, no injected mover faster than 2″/min was found, bright or faint; with −14 most are.
MOTION_TUNING = Tuning(least_log_ratio=-14.0)


def left_over(series: Series) -> Detections:
    """What is left to move; ``rows`` are those of the series."""
    at = np.flatnonzero(series.left)
    ra, dec = series.sky(series.place[at])
    mjd = np.array([e.mjd_utc for e in series.exposures])[series.frame[at]]
    error = np.concatenate([1.0857 * e.flux_err / np.maximum(e.flux, 1e-9) for e in series.exposures])[at]
    seen = Detections.of(
        ra, dec, mjd, sigma_arcsec=series.sigma_arcsec[at], frame=np.array([f"{k:05d}" for k in series.frame[at]]),
        magnitude=series.magnitude[at], magnitude_error=np.where(np.isfinite(series.magnitude[at]), error, np.nan),
        name="series",
    )  # fmt: skip
    names = tuple(series.exposures[int(k)].name for k in seen.frame_names)
    rows = at[seen.rows]
    return replace(seen, rows=rows, ids=rows, frame_names=names, trail=_trail_rates(series, rows))


def _trail_rates(series: Series, rows: IntArray) -> TrailRates | None:
    """What the trails of some measurements say of rates; None where none were measured."""
    if series.trails is None:
        return None
    minutes = np.array([e.exposure_s for e in series.exposures])[series.frame[rows]] / 60.0
    width = np.array([max(e.psf_fwhm_px, 1.5) * e.scale_arcsec_per_px for e in series.exposures])[series.frame[rows]]
    # A trail of twice the least length is seen as one also where it is faint.
    least = 2.0 * series.trails.least_widths * width / minutes
    return TrailRates(
        series.trails.arcsec[rows] / minutes[:, None], series.trails.sigma_arcsec[rows] / minutes,
        np.where(minutes > 0, least, np.inf),
    )  # fmt: skip


def search(
    series: Series,
    *,
    least: int = 3,
    least_probability: float = 0.5,
    tuning: SearchTuning = DEFAULT_TUNING,
    motion: Tuning = MOTION_TUNING,
) -> tuple[Movers, Series]:
    """What moves on a series of frames, and the series with what the search has shown to stand still.

    least : frames that show it. least_probability : of a tracklet.

    Tracklets that move less than two pixels in all are faint or blended stars; they are marked, and the rest is
    searched again, so that rates are not learned from them.
    """
    for _ in range(tuning.turns):
        if len(np.unique(series.frame[series.left])) < 2:
            return _nothing(series), series
        detections = left_over(series)
        model = learn_motion(detections, counts=tuning.counts)
        found = find_movers(detections, model=model, least=2, least_probability=0.0, tuning=motion)
        slow = found.only(_moved_arcsec(found) < tuning.least_move_px * series.scale_arcsec_per_px)
        rows = slow.members[slow.members >= 0]
        if not len(rows):
            break
        still = series.still.copy()
        still[detections.rows[rows]] = True
        series = replace(series, still=still)
    wanted = (found.size >= least) & (found.p_tracklet >= least_probability)
    wanted &= _moved_arcsec(found) >= tuning.least_move_px * series.scale_arcsec_per_px
    return found.only(wanted), series


def _nothing(series: Series) -> Movers:
    """No tracklets, where no two frames have anything left."""
    no, none = np.empty(0), np.empty(0, np.int64)
    names = tuple(one.name for one in series.exposures)
    seen = Detections(no, no, np.empty((0, 3)), no, none, no, no, none, ("",), none, none, names, name="series")
    wide = np.empty((0, 2))
    return Movers(
        seen, MotionModel(), wide.astype(np.int64), no, no, wide, no, no, 0.0, np.empty((0, 6))
    )  # fmt: skip


def _moved_arcsec(found: Movers) -> FloatArray:
    """(k,) how far each tracklet moves between its first and last detection."""
    last = found.members[np.arange(len(found)), found.size - 1]
    minutes = (found.detections.mjd_utc[last] - found.detections.mjd_utc[found.members[:, 0]]) * 1440.0
    return np.asarray(np.hypot(*found.rate_arcsec_per_min.T) * minutes)
