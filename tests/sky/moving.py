"""Simulated nights with known movers."""

import numpy as np

from sameas.sky import Detections


def night(
    seed, *, movers=40, false=60, times_min=(0, 20, 45, 70), side_deg=1.0, sigma=0.2, p_detect=0.85, rate=None, stars=0,
    larger=1.0, apart=0.0, crowds=0,
):  # fmt: skip
    """Detections of a square field about the opposition point, and the number of the mover of each, −1 for others.

    movers : number of main-belt movers, or rates (n, 2) arcsec/min. false : false detections per exposure. stars :
    stationary, detected on nine exposures of ten. larger : true / quoted errors. apart : arcsec, 1σ per axis of the
    offset of an exposure. crowds : of 25 false detections within about 12″, at the same place on every exposure.
    """
    rng = np.random.default_rng(seed)
    mjd0, ra0, dec0 = 59300.0, 190.0, -4.0
    at = rng.uniform(-0.5, 0.5, (movers, 2)) * side_deg * 3600.0
    if rate is None:
        # Retrograde along the ecliptic, whose latitude here decreases to the east.
        rate = np.array([-0.5, 0.21]) + rng.normal(0.0, 0.08, (movers, 2))
    magnitude = rng.uniform(17.0, 20.0, movers)
    fixed = rng.uniform(-0.5, 0.5, (stars, 2)) * side_deg * 3600.0
    light = rng.uniform(17.0, 20.0, stars)
    crowd = rng.uniform(-0.5, 0.5, (crowds, 2)) * side_deg * 3600.0
    rows = []
    for frame, minutes in enumerate(times_min):
        seen = np.flatnonzero(rng.random(movers) < p_detect)
        off = apart * rng.standard_normal(2) if apart else 0.0
        place = at[seen] + minutes * rate[seen] + off + larger * sigma * rng.standard_normal((len(seen), 2))
        rows += [(frame, *xy, minutes, m, k) for xy, m, k in zip(place, magnitude[seen], seen, strict=True)]
        other = rng.uniform(-0.5, 0.5, (false, 2)) * side_deg * 3600.0
        rows += [(frame, *xy, minutes, rng.uniform(17.0, 20.0), -1) for xy in other]
        other = np.repeat(crowd, rng.poisson(25, crowds), axis=0)
        other = other + 12.0 * rng.standard_normal(other.shape)
        rows += [(frame, *xy, minutes, rng.uniform(17.0, 20.0), -1) for xy in other]
        there = np.flatnonzero(rng.random(stars) < 0.9)
        place = fixed[there] + off + larger * sigma * rng.standard_normal((len(there), 2))
        rows += [(frame, *xy, minutes, m, -1) for xy, m in zip(place, light[there], strict=True)]
    frame, x, y, minutes, bright, truth = (np.array(column) for column in zip(*rows, strict=True))
    order = rng.permutation(len(frame))
    dec = dec0 + y / 3600.0
    detections = Detections.of(
        (ra0 + x / 3600.0 / np.cos(np.radians(dec)))[order], dec[order], (mjd0 + minutes / 1440.0)[order],
        sigma_arcsec=sigma, magnitude=(bright + 0.1 * rng.standard_normal(len(bright)))[order],
        magnitude_error=np.full(len(bright), 0.1), frame=frame[order],
    )  # fmt: skip
    return detections, truth[order].astype(int)


def night_table(path):
    """The path of a new table of a night's detections."""
    from astropy.table import Table

    seen, _ = night(21)
    Table({"ra": seen.ra_deg, "dec": seen.dec_deg, "mjd": seen.mjd_utc, "mag": seen.magnitude}).write(path)
    return path
