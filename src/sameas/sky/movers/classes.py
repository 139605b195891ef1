"""Orbit classes of tracklets: the score of ``digest2``, of the Minor Planet Center, for a near-Earth object.

digest2 (Keys et al. 2019, PASP 131, 064501; public domain) draws orbits through the ends of a tracklet, and compares
them with a model of the Solar System. It takes a station's parallax from a list that it downloads; here every detection
is given with the observer's place instead, as for a satellite, so that no list is needed.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from sameas.arrays import FloatArray
from sameas.sky.movers.orbits import AU_KM, geocentric_km
from sameas.sky.movers.search import Movers

#: A list of one station, the middle of the Earth.
_STATIONS = "Code  Long.   cos      sin    Name\n500   0.00000 0.000000 0.000000Geocentric\n"


def near_earth_scores(found: Movers, site: tuple[float, float, float] | None = None) -> FloatArray | None:
    """(k,) scores from 0 to 100 that tracklets are near-Earth objects without a designation; None without ``digest2``.

    found : the tracklets. site : latitude, longitude (degrees, east positive) and height (metres) of the observer; None
    for the middle of the Earth. Scores of 65 and more go to the confirmation page of the Minor Planet Center.
    Magnitudes are taken as V.

    Example
    -------
    >>> near_earth_scores(found, site=(42.61, -71.485, 100.0))  # doctest: +SKIP
    array([ 3.2, 98.1])
    """
    try:
        from digest2 import Digest2, Observation
    except ImportError:
        return None
    seen, out = found.detections, np.full(len(found), np.nan)
    if not len(found):
        return out
    sigma = np.sqrt(seen.covariance[:, [0, 2]])
    bright = np.nan_to_num(seen.magnitude)
    with tempfile.TemporaryDirectory() as folder:
        stations = Path(folder) / "stations"
        stations.write_text(_STATIONS, encoding="ascii")
        with Digest2(obscodes_path=str(stations)) as digest:
            for k, members in enumerate(found.members):
                rows = members[members >= 0]
                observer = np.zeros((len(rows), 3))
                if site is not None:
                    observer = geocentric_km(*site, seen.mjd_utc[rows]) / AU_KM
                observations = [
                    Observation(
                        mjd=float(seen.mjd_utc[row]), ra=float(seen.ra_deg[row]), dec=float(seen.dec_deg[row]),
                        mag=float(bright[row]), rms_ra=float(sigma[row, 0]), rms_dec=float(sigma[row, 1]),
                        spacebased=True, earth_obs=place.tolist(),
                    )
                    for row, place in zip(rows.tolist(), observer, strict=True)
                ]  # fmt: skip
                out[k] = digest.classify_tracklet(observations, classes=["NEO"], is_ades=True).noid.NEO
    return out
