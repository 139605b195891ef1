"""Known objects among the tracklets: a one-to-one crossmatch with ephemerides, with probabilities.

The records of one source are tracklets, those of the other are ephemerides: mean position over the tracklet's time, and
motion over its length, with the errors of both (METHOD 1's D_τ).
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sameas._identify import identify
from sameas.arrays import ABSENT, FloatArray, IntArray
from sameas.evidence import Field
from sameas.prior import PerPair
from sameas.records import Records
from sameas.sky.motion import AU_KM
from sameas.sky.movers.orbits import Elements, ephemeris, geocentric_km, near, states
from sameas.sky.movers.search import Movers
from sameas.space import ARCSEC_PER_RADIAN, mean_direction, to_plane, unit_vectors

if TYPE_CHECKING:
    from astropy.table import Table


# Parameters of the identification of movers with known objects, all chosen.
ERROR_FACTOR = 2.0  # factor on the predicted errors, as elements are often worse than their age suggests
ODDS = 0.5  # prior odds that a known object predicted in the field is one of the tracklets
MIN_PROBABILITY = 0.5  # of an accepted match
FIELD_DEG = 4.0  # tracklets farther apart are matched field by field, in cells of this size
OLDEST_YEARS = 20.0  # maximum age of elements; older objects were lost


@dataclass(frozen=True)
class MissingObject:
    """A known object that is no tracklet: its name, predicted position (ICRS) in the middle of the night, and V."""

    name: str
    ra_deg: float
    dec_deg: float
    magnitude: float


@dataclass(frozen=True)
class KnownObjects:
    """The known objects among the tracklets.

    elements : of the objects predicted near the field. object : (k,) row of the elements of each tracklet, or ABSENT.
    p : (k,) its probability. offset_arcsec : (n, 2) observed minus computed of each detection, east and north, NaN
    without a known object. magnitude : (k,) predicted V. missing : objects predicted among the detections of a single
    field, none of which is a tracklet, the brightest first.
    """

    elements: Elements
    object: IntArray
    p: FloatArray
    offset_arcsec: FloatArray
    magnitude: FloatArray
    missing: tuple[MissingObject, ...] = ()

    def name(self, k: int) -> str:
        """The name of tracklet k, '' if it is not known."""
        return self.elements.name[self.object[k]] if self.object[k] >= 0 else ""

    def number(self, k: int) -> str:
        """The permanent number of tracklet k, '' if it has none."""
        return self.elements.number[self.object[k]] if self.object[k] >= 0 else ""

    def mean_offset(self, movers: Movers, k: int) -> FloatArray:
        """(2,) mean O−C of tracklet k, arcsec east and north."""
        rows = movers.members[k]
        return np.asarray(np.mean(self.offset_arcsec[rows[rows >= 0]], axis=0))

    def into(self, table: Table, movers: Movers) -> None:
        """Adds the object of each tracklet, its probability and mean O−C to the table of the tracklets."""
        known = self.object >= 0
        offset = np.array([self.mean_offset(movers, k) if known[k] else [np.nan] * 2 for k in range(len(movers))])
        offset = offset.reshape(-1, 2)
        table["object"] = np.ma.MaskedArray(np.array([self.name(k) for k in range(len(movers))], dtype=str), ~known)
        table["p_object"] = np.ma.MaskedArray(self.p, ~known)
        for name, values in (("o_c_east_arcsec", offset[:, 0]), ("o_c_north_arcsec", offset[:, 1])):
            table[name] = np.ma.masked_invalid(values)
            table[name].unit = "arcsec"


def name_movers(movers: Movers, elements: Elements, *, site: tuple[float, float, float] | None = None) -> KnownObjects:
    """The known objects among the tracklets.

    movers : the tracklets. elements : of known objects; those older than twenty years are ignored. site : latitude,
    longitude (degrees, east positive) and height (metres) of the observer; None for the centre of the Earth, an error
    of up to 8″ for the main belt.

    >>> named = name_movers(found, Elements.read("MPCORB.DAT"), site=(42.61, -71.485, 100.0))  # doctest: +SKIP
    """
    k, detections = len(movers), movers.detections
    owner, p = np.full(k, ABSENT), np.zeros(k)
    offset, magnitude = np.full((len(detections), 2), np.nan), np.full(k, np.nan)
    middle = float(np.median(detections.mjd_utc))
    elements = elements.some(np.flatnonzero(np.abs(elements.epoch_mjd - middle) < 365.25 * OLDEST_YEARS))
    unit = detections.axes().unit
    if not k:
        none = elements.some(np.empty(0, np.int64))
        missing = _missing(unit, elements, owner, middle, site)
        return KnownObjects(none, owner, p, offset, magnitude, missing)
    fields = _fields(unit[movers.members[:, 0]], FIELD_DEG)
    # With several fields all orbits are integrated to the night once; from there only over hours.
    state = states(elements, middle) if len(fields) > 1 else None
    is_near = np.zeros(len(elements), bool)
    for rows in fields:
        in_field = movers.only(rows)
        directions = unit[in_field.members[in_field.members >= 0]]
        match = _of_field(in_field, directions, elements, state, middle, site)
        is_near[match.near] = True
        owner[rows], p[rows], magnitude[rows] = match.owner, match.p, match.magnitude
        offset[match.rows] = match.offset
    owner = _once(owner, p)
    p = np.where(owner >= 0, p, 0.0)
    unmatched = movers.members[owner < 0]
    offset[unmatched[unmatched >= 0]] = np.nan
    magnitude[owner < 0] = np.nan
    near_all = np.flatnonzero(is_near)
    known = owner >= 0
    missing = _missing(unit, elements, owner[known], middle, site)
    owner[known] = np.searchsorted(near_all, owner[known])
    return KnownObjects(elements.some(near_all), owner, p, offset, magnitude, missing)


def _missing(
    unit: FloatArray, elements: Elements, found: IntArray, middle: float, site: tuple[float, float, float] | None
) -> tuple[MissingObject, ...]:
    """The objects predicted among the detections, whose directions (n, 3) are given, without those in the rows
    ``found``; none if the detections are far apart."""
    centre = mean_direction(unit)
    radius = float(np.degrees(np.arccos(np.clip(unit @ centre, -1, 1)).max()))
    if radius > FIELD_DEG:
        return ()
    elements = elements.some(np.setdiff1d(near(elements, middle, centre, radius), found))
    if not len(elements):
        return ()
    place = None if site is None else geocentric_km(*site, np.array([middle]))
    predicted = ephemeris(elements, np.array([middle]), place)
    ra, dec, magnitude, sigma = (
        values[:, 0] for values in (predicted.ra_deg, predicted.dec_deg, predicted.magnitude, predicted.sigma_arcsec)
    )
    seen, at = ARCSEC_PER_RADIAN * to_plane(unit, centre), _arcsec_from(centre, ra, dec)
    # An object that may as well be beside the field is not missed.
    edge = ERROR_FACTOR * sigma[:, None]
    inside = ((at > seen.min(axis=0) + edge) & (at < seen.max(axis=0) - edge)).all(axis=1)
    rows = np.flatnonzero(inside)[np.argsort(magnitude[inside], kind="stable")].tolist()
    return tuple(
        MissingObject(elements.name[row], float(ra[row]), float(dec[row]), float(magnitude[row])) for row in rows
    )


def _fields(unit: FloatArray, field_deg: float) -> list[IntArray]:
    """The tracklets of each field: all in one, or by cells of the sky if they are far apart."""
    middle = unit.mean(axis=0)
    if np.linalg.norm(middle) > math.cos(math.radians(field_deg)):
        return [np.arange(len(unit))]
    dec = np.degrees(np.arcsin(np.clip(unit[:, 2], -1, 1)))
    row = np.floor((dec + 90.0) / field_deg).astype(np.int64)
    n_columns = np.maximum(1, np.floor(360.0 * np.cos(np.radians((row + 0.5) * field_deg - 90.0)) / field_deg))
    column = np.floor(np.degrees(np.arctan2(unit[:, 1], unit[:, 0])) % 360.0 / 360.0 * n_columns).astype(np.int64)
    _, cell = np.unique(row * 1000 + column, return_inverse=True)
    order = np.argsort(cell, kind="stable")
    return [np.asarray(part) for part in np.split(order, np.flatnonzero(np.diff(cell[order])) + 1)]


def _once(owner: IntArray, p: FloatArray) -> IntArray:
    """(k,) the objects, ABSENT if another tracklet is more probably the same object."""
    out, used = np.full(len(owner), ABSENT), set[int]()
    for k in np.argsort(-p, kind="stable").tolist():
        if owner[k] >= 0 and int(owner[k]) not in used:
            out[k] = owner[k]
            used.add(int(owner[k]))
    return out


@dataclass(frozen=True)
class _FieldMatch:
    """The matches of one field: rows of the elements near it; for each tracklet the row of its object, p and magnitude;
    rows of the matched detections and their offsets."""

    near: IntArray
    owner: IntArray
    p: FloatArray
    magnitude: FloatArray
    rows: IntArray
    offset: FloatArray


def _of_field(
    movers: Movers, unit_of: FloatArray, all_elements: Elements, state: FloatArray | None, middle: float,
    site: tuple[float, float, float] | None) -> _FieldMatch:  # fmt: skip
    """The match of the tracklets of one field. unit_of : (m, 3) directions of their detections."""
    k, detections = len(movers), movers.detections
    owner, p, magnitude = np.full(k, ABSENT), np.zeros(k), np.full(k, np.nan)
    offset = np.full((len(detections), 2), np.nan)
    centre = mean_direction(unit_of)
    radius = float(np.degrees(np.arccos(np.clip(unit_of @ centre, -1, 1)).max()))
    near_rows = near(all_elements, middle, centre, radius + 0.1)
    no_rows = np.empty(0, np.int64)
    if not len(near_rows):
        return _FieldMatch(no_rows, owner, p, magnitude, no_rows, np.empty((0, 2)))
    elements = all_elements.some(near_rows)
    times = np.unique(detections.mjd_utc[movers.members[movers.members >= 0]])
    place = None if site is None else geocentric_km(*site, times)
    start = None if state is None else (middle, state[:, :, near_rows])
    predicted_sky = ephemeris(elements, times, place, start=start)
    at = _arcsec_from(centre, predicted_sky.ra_deg, predicted_sky.dec_deg)  # (objects, times, 2)
    measured, covariance = _records_of(movers, centre)
    predicted = np.empty((k, len(elements), 4))
    for row in range(k):
        rows = movers.members[row][movers.members[row] >= 0]
        time_index = np.searchsorted(times, detections.mjd_utc[rows])
        predicted[row] = _mean_and_motion(at[:, time_index], times[time_index])
    sigma = ERROR_FACTOR * np.hypot(predicted_sky.sigma_arcsec.mean(axis=1), 0.05)
    area = math.pi * (3600.0 * (radius + 0.1)) ** 2
    span = float(np.ptp(times)) * 1440.0
    density = 1.0 / (area * math.pi * max(span, 1.0) ** 2)
    residual = measured[:, None] - predicted
    first = Records.of(measured, covariance=covariance, source="tracklets")
    # The ephemeris of each object is taken at the times of the nearest tracklet.
    nearest = np.argmin((residual[..., :2] ** 2).sum(axis=-1), axis=0)
    error = np.zeros((len(elements), 4, 4))
    error[:, [0, 1], [0, 1]] = (sigma**2)[:, None]
    error[:, [2, 3], [2, 3]] = (0.05 * sigma[:, None]) ** 2 + 0.02**2
    second = Records.of(predicted[nearest, np.arange(len(elements))], covariance=error, source="ephemerides")
    answer = identify(first, second, rule=Field(density), prior=PerPair(math.log(ODDS)))
    matches = answer.matches
    for row, known, probability in zip(matches.rows_1, matches.rows_2, matches.p_match, strict=True):
        if probability < MIN_PROBABILITY:
            continue
        owner[row], p[row] = known, probability
        rows = movers.members[row][movers.members[row] >= 0]
        time_index = np.searchsorted(times, detections.mjd_utc[rows])
        observed = _arcsec_from(centre, detections.ra_deg[rows], detections.dec_deg[rows])
        offset[rows] = observed - at[known, time_index]
        magnitude[row] = float(predicted_sky.magnitude[known, time_index].mean())
    known = np.flatnonzero(np.isfinite(offset).all(axis=1))
    owner[owner >= 0] = near_rows[owner[owner >= 0]]
    return _FieldMatch(near_rows, owner, p, magnitude, known, offset[known])


def _records_of(movers: Movers, centre: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(k, 4) mean position and motion of each tracklet, arcsec from the centre, and (k, 4, 4) their covariances."""
    detections = movers.detections
    out, covariance = np.empty((len(movers), 4)), np.zeros((len(movers), 4, 4))
    for row, members in enumerate(movers.members):
        rows = members[members >= 0]
        t = detections.mjd_utc[rows]
        out[row] = _mean_and_motion(_arcsec_from(centre, detections.ra_deg[rows], detections.dec_deg[rows])[None], t)[0]
        variance = detections.covariance[rows][:, [0, 2]].mean(axis=0) + 0.05**2
        time_off = t - t.mean()
        covariance[row, [0, 1], [0, 1]] = variance / len(rows) + 0.1**2
        covariance[row, [2, 3], [2, 3]] = variance * np.ptp(t) ** 2 / np.maximum((time_off**2).sum(), 1e-12)
    return out, covariance


def _mean_and_motion(position: FloatArray, t: FloatArray) -> FloatArray:
    """(n, 4) mean of positions (n, t, 2), and the motion of a fitted line from the first to the last time."""
    time_off = t - t.mean()
    slope = np.einsum("t,ntd->nd", time_off, position) / max(float((time_off**2).sum()), 1e-15)
    return np.concatenate([position.mean(axis=1), slope * np.ptp(t)], axis=1)


def _arcsec_from(centre: FloatArray, ra_deg: FloatArray, dec_deg: FloatArray) -> FloatArray:
    """(…, 2) arcsec east and north on the tangent plane at a unit vector."""
    return ARCSEC_PER_RADIAN * to_plane(unit_vectors(ra_deg, dec_deg), centre)


# Orbit classes of tracklets: the score of ``digest2``, of the Minor Planet Center, for a near-Earth object.
#
# digest2 (Keys et al. 2019, PASP 131, 064501; public domain) samples orbits through the ends of a tracklet, and
# compares them with a model of the Solar System. It takes a station's parallax from a list that it downloads; here each
# detection is given with the observer's position, as for a satellite, so that no list is needed.

#: A list of one station, the centre of the Earth.
_STATIONS = "Code  Long.   cos      sin    Name\n500   0.00000 0.000000 0.000000Geocentric\n"


def near_earth_scores(movers: Movers, site: tuple[float, float, float] | None) -> FloatArray | None:
    """(k,) scores from 0 to 100 that tracklets are near-Earth objects without a designation; None without ``digest2``.

    movers : the tracklets. site : latitude, longitude (degrees, east positive) and height (metres) of the observer;
    None for the centre of the Earth. Scores of 65 and more go to the confirmation page of the Minor Planet Center.
    Magnitudes are assumed to be V.

    >>> near_earth_scores(found, site=(42.61, -71.485, 100.0))  # doctest: +SKIP
    array([ 3.2, 98.1])
    """
    try:
        from digest2 import Digest2, Observation
    except ImportError:
        return None
    detections, out = movers.detections, np.full(len(movers), np.nan)
    if not len(movers):
        return out
    sigma = np.sqrt(detections.covariance[:, [0, 2]])
    magnitude = np.nan_to_num(detections.magnitude)
    with tempfile.TemporaryDirectory() as folder:
        stations = Path(folder) / "stations"
        stations.write_text(_STATIONS, encoding="ascii")
        with Digest2(obscodes_path=str(stations)) as digest:
            for k, members in enumerate(movers.members):
                rows = members[members >= 0]
                observer = np.zeros((len(rows), 3))
                if site is not None:
                    observer = geocentric_km(*site, detections.mjd_utc[rows]) / AU_KM
                observations = [
                    Observation(
                        mjd=float(detections.mjd_utc[row]), ra=float(detections.ra_deg[row]),
                        dec=float(detections.dec_deg[row]),
                        mag=float(magnitude[row]), rms_ra=float(sigma[row, 0]), rms_dec=float(sigma[row, 1]),
                        spacebased=True, earth_obs=place.tolist(),
                    )
                    for row, place in zip(rows.tolist(), observer, strict=True)
                ]  # fmt: skip
                out[k] = digest.classify_tracklet(observations, classes=["NEO"], is_ades=True).noid.NEO
    return out
