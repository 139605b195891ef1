"""Ephemerides of known asteroids and comets, from their orbital elements.

Elements are converted to position and velocity at their epoch and integrated with the attraction of the Sun, the
planets, the Moon and Pluto and the Sun's relativistic term (SciPy's DOP853; planets of the ephemeris DE421). Light time
and the observer's position on the Earth are included; positions are astrometric, ICRS. Objects are integrated together.
"""

from __future__ import annotations

import atexit
import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np
from scipy.interpolate import CubicSpline

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError, optional, reading
from sameas.sky.motion import AU_KM
from sameas.sky.movers.rates import GAUSS, OBLIQUITY

#: Gauss's constant squared: GM of the Sun, au³/day².
_GM_SUN = GAUSS**2
#: Masses of Mercury, Venus, the Earth and the Moon together, Mars … Neptune, Pluto: the Sun's over theirs (DE421).
_MASS_RATIO = (6023600.0, 408523.71, 328900.56, 3098708.0, 1047.3486, 3497.898, 22902.98, 19412.24, 135200000.0)
#: Index of Pluto, (134340) in lists of asteroids: an object closer than this is Pluto itself and not attracted by it.
_PLUTO, _PLUTO_ITSELF_AU = 8, 0.03
_LIGHT_AU_PER_DAY = 173.14463267424034
#: Rotation from the ecliptic of J2000 to the axes of the ICRS equator.
_TO_EQUATOR = np.array(
    [[1.0, 0.0, 0.0], [0.0, math.cos(OBLIQUITY), -math.sin(OBLIQUITY)], [0.0, math.sin(OBLIQUITY), math.cos(OBLIQUITY)]]
)
#: Name of the elements that come with the package; ``elements.json`` gives their source.
DEMO = "demo"
#: Relative error of the integrator per step.
_TOLERANCE = 1e-10
#: Elements of covariances: names in JPL's answers and here; angles in degrees, times in days.
_COVARIANCE = {"e": "eccentricity", "q": "perihelion_au", "tp": "perihelion_mjd", "om": "node_deg",
               "w": "argument_deg", "i": "inclination_deg"}  # fmt: skip
#: Alternative names of two of them in JPL's covariances.
_LABELS = {"node": "om", "peri": "w"}
#: Step and length of the tables of planetary positions, days.
_GRID_DAYS, _BLOCK_DAYS = 2.0, 4000.0


@dataclass(frozen=True)
class Elements:
    """Orbital elements of objects, heliocentric, ecliptic and equinox of J2000; (n,) each.

    name : common name. number : permanent number, '' without one. epoch_mjd : TDB. perihelion_au, eccentricity,
    inclination_deg, node_deg, argument_deg : of the orbit. perihelion_mjd : time of perihelion, TDB. h, g : absolute
    magnitude and slope, NaN where not known. uncertainty : MPC's U of 0 … 9, NaN where not known.
    covariance : (n, 6, 6) of e, perihelion_au, perihelion_mjd, node_deg, argument_deg, inclination_deg at the epoch;
    NaN where not known. None if not known for any object.
    """

    name: tuple[str, ...]
    number: tuple[str, ...]
    epoch_mjd: FloatArray
    perihelion_au: FloatArray
    eccentricity: FloatArray
    inclination_deg: FloatArray
    node_deg: FloatArray
    argument_deg: FloatArray
    perihelion_mjd: FloatArray
    h: FloatArray
    g: FloatArray
    uncertainty: FloatArray
    covariance: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.name)

    def some(self, rows: IntArray) -> Elements:
        """Some of the objects."""
        parts: dict[str, Any] = {}
        for key, value in vars(self).items():
            if value is not None:
                parts[key] = tuple(value[k] for k in rows) if isinstance(value, tuple) else value[rows]
        return Elements(**parts)

    def displaced(self, offset: FloatArray) -> Elements:
        """The objects with (n, 6) added to their elements, in the order of ``covariance``."""
        names = _COVARIANCE.values()
        return replace(self, **{name: getattr(self, name) + offset[:, k] for k, name in enumerate(names)})

    @classmethod
    def read(cls, path: str | Path) -> Elements:
        """Elements from MPCORB.DAT, or JSON of JPL's small-body database.

        JSON may be of a query (``fields`` and ``data``), or of one object or a list of objects (``orbit``, with the
        covariance if requested by ``cov=mat``).

        path : of the file; ``"demo"`` for the five that come with the package: (1) to (4) and (2713).

        Raises InputError: neither of the two formats; no row with all elements.

        >>> Elements.read("demo").number
        ('1', '2', '3', '4', '2713')
        """
        try:
            place = files("sameas.sky.movers") / "elements.json" if str(path) == DEMO else Path(path)
            text = place.read_bytes().decode("utf-8", errors="replace")
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None
        with reading(str(path), "is neither MPCORB nor JSON of the small-body database"):
            return _of_json(text, path) if text.lstrip().startswith(("{", "[")) else _of_mpcorb(text, path)


def _of_json(text: str, path: str | Path) -> Elements:
    try:
        answer = json.loads(text)
        objects = answer if isinstance(answer, list) else [answer]
        if all(isinstance(one, dict) and "orbit" in one for one in objects):
            return _of_objects(objects, path)
        fields, data = list(answer["fields"]), answer["data"]
        at = {name: fields.index(name) for name in ("full_name", "epoch_mjd", "e", "q", "i", "om", "w")}
    except (ValueError, KeyError, TypeError):
        raise InputError(
            f"{path}: no elements as JPL's small-body database gives them (full_name, epoch_mjd, e, q, i, om, w, "
            "and ma with a, or tp)"
        ) from None
    extra = {name: fields.index(name) for name in ("a", "ma", "tp", "H", "G", "condition_code") if name in fields}
    rows = [row for row in data if all(row[at[key]] not in (None, "") for key in at)]

    def column(key: str) -> FloatArray:
        where = at.get(key, extra.get(key))
        if where is None:
            return np.full(len(rows), np.nan)
        return np.array([_number(row[where]) for row in rows])

    e, q, epoch = column("e"), column("q"), column("epoch_mjd")
    with np.errstate(invalid="ignore", divide="ignore"):
        a = q / (1.0 - e)
        motion = np.degrees(math.sqrt(_GM_SUN) / np.abs(a) ** 1.5)
        passage = np.where(np.isfinite(column("tp")), column("tp") - 2400000.5, np.nan)
        passage = np.where(np.isfinite(passage), passage, epoch - column("ma") / motion)
    names = [" ".join(str(row[at["full_name"]]).split()) for row in rows]
    numbers = [name.split()[0] if name.split()[0].isdigit() else "" for name in names]
    elements = _elements(names, numbers, epoch, q, e, column("i"), column("om"), column("w"), passage, column("H"),
                   column("G"), column("condition_code"))  # fmt: skip
    return _usable(elements, path)


def _of_objects(objects: Sequence[Any], path: str | Path) -> Elements:
    """Elements from answers of JPL's small-body database about single objects.

    If there is a covariance, the elements and epoch it belongs to are used. Source: ssd-api.jpl.nasa.gov/doc/sbdb.html.
    """
    rows, names, numbers, covariance = [], [], [], np.full((len(objects), 6, 6), np.nan)
    for k, one in enumerate(objects):
        orbit, body = one["orbit"], one.get("object", {})
        given = orbit.get("covariance") or {}
        chosen = given.get("elements") or orbit["elements"]
        value = {element["name"]: _number(element["value"]) for element in chosen}
        value = {_LABELS.get(name, name): v for name, v in value.items()}
        epoch = _number(given.get("epoch") or orbit["epoch"]) - 2400000.5
        physical = {p.get("name"): _number(p.get("value")) for p in one.get("phys_par") or []}
        name = " ".join(str(body.get("fullname") or body.get("des") or f"object {k + 1}").split())
        names.append(name)
        numbers.append(name.split()[0] if name.split()[0].isdigit() else "")
        rows.append([epoch, value["q"], value["e"], value["i"], value["om"], value["w"], value["tp"] - 2400000.5,
                     physical.get("H", math.nan), physical.get("G", math.nan),
                     _number(orbit.get("condition_code"))])  # fmt: skip
        labels = [_LABELS.get(label, label) for label in given.get("labels", [])]
        if given.get("data") is not None and set(_COVARIANCE) <= set(labels):
            at = [labels.index(label) for label in _COVARIANCE]  # others are of non-gravitational forces
            covariance[k] = np.array(given["data"], dtype=np.float64)[np.ix_(at, at)]
    elements = _elements(names, numbers, *np.array(rows, dtype=np.float64).T)
    known = np.isfinite(covariance).all(axis=(1, 2))
    return _usable(replace(elements, covariance=covariance) if known.any() else elements, path)


def _elements(names: Sequence[str], numbers: Sequence[str], *columns: FloatArray) -> Elements:
    """Elements from names, numbers and columns in the order of the fields."""
    return Elements(tuple(names), tuple(numbers), *columns)


def _of_mpcorb(text: str, path: str | Path) -> Elements:
    lines = text.splitlines()
    rule = next((k for k, line in enumerate(lines) if line.startswith("-----")), -1)
    rows = [line for line in lines[rule + 1 :] if len(line) >= 103 and line[20:25].strip()]
    if not rows:
        raise InputError(f"{path}: neither lines of MPCORB.DAT nor JSON of elements")

    def column(first: int, last: int) -> FloatArray:
        return np.array([_number(line[first - 1 : last]) for line in rows])

    epoch = np.array([packed_date(line[20:25]) for line in rows])
    e, a, m = column(71, 79), column(93, 103), column(27, 35)
    motion = np.degrees(math.sqrt(_GM_SUN) / np.abs(a) ** 1.5)
    m = (m + 180.0) % 360.0 - 180.0
    names = [(line[166:194].strip() or line[:7].strip()) for line in rows]
    numbers = [_number_of(line[:7].strip()) for line in rows]
    elements = _elements(names, numbers, epoch, a * (1 - e), e, column(60, 68), column(49, 57), column(38, 46),
                   epoch - m / motion, column(9, 13), column(15, 19), column(106, 106))  # fmt: skip
    return _usable(elements, path)


def _number(value: str | SupportsFloat) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


def packed_date(text: str) -> float:
    """MJD of a packed date such as K239D (2023-09-13)."""
    from datetime import date

    digits = "0123456789ABCDEFGHIJKLMNOPQRSTUV"
    try:
        year = 100 * (digits.index(text[0])) + int(text[1:3])
        return float(date(year, digits.index(text[3]), digits.index(text[4])).toordinal() - 678576)
    except (ValueError, IndexError):
        return math.nan


def _number_of(packed: str) -> str:
    """The permanent number from MPC's packed form; '' for a provisional designation."""
    if not packed.removeprefix("~").isalnum() or not packed.isascii():
        return ""
    letters = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz"
    if len(packed) != 5:
        return ""
    if packed[0] == "~":
        value = 0
        for letter in packed[1:]:
            value = value * 62 + letters.index(letter)
        return str(620000 + value)
    return str(letters.index(packed[0]) * 10000 + int(packed[1:])) if packed[1:].isdigit() else ""


def _usable(elements: Elements, path: str | Path) -> Elements:
    columns = np.column_stack([
        elements.epoch_mjd, elements.perihelion_au, elements.eccentricity, elements.inclination_deg, elements.node_deg,
        elements.argument_deg, elements.perihelion_mjd,
    ])  # fmt: skip
    good = np.flatnonzero(np.isfinite(columns).all(axis=1) & (elements.perihelion_au > 0))
    if not len(good):
        raise InputError(f"{path}: no row has all its elements")
    return elements.some(good)


@dataclass(frozen=True)
class Ephemeris:
    """Predicted positions of n objects at t times; (n, t).

    ra_deg, dec_deg : astrometric, ICRS, from the observer. distance_au : from the observer.
    magnitude : predicted V, NaN where H is not known. sigma_arcsec : error by the covariance or age of the elements.
    """

    ra_deg: FloatArray
    dec_deg: FloatArray
    distance_au: FloatArray
    magnitude: FloatArray
    sigma_arcsec: FloatArray


def states(elements: Elements, mjd_utc: float) -> FloatArray:
    """(2, 3, n) heliocentric positions, au, and velocities, au/day, of the objects at a time, on ICRS axes."""
    from sameas.sky.times import Time

    planets = de421()
    planets.check(np.array([mjd_utc]))
    middle = float(Time(mjd_utc, format="mjd", scale="utc").tdb.mjd)
    state = np.empty((2, 3, len(elements)))
    days = middle - elements.epoch_mjd
    # Each object is integrated from its own epoch in fractions of its time span; similar spans are integrated together.
    log2_days = np.floor(np.log2(np.maximum(np.abs(days), 16.0)))
    for octave in np.unique(log2_days):
        rows = np.flatnonzero(log2_days == octave)
        group = elements.some(rows)
        epochs, epoch_of_object = np.unique(group.epoch_mjd, return_inverse=True)
        start = np.concatenate(
            [_state(group.some(np.flatnonzero(epoch_of_object == k)), epoch) for k, epoch in enumerate(epochs)], axis=2
        )
        order = np.argsort(epoch_of_object, kind="stable")
        state[:, :, rows[order]] = _integrated_from_epochs(start, epochs, epoch_of_object[order], middle, planets)
    return state


def ephemeris(
    elements: Elements, mjd_utc: FloatArray, observer_km: FloatArray | None = None, *,
    start: tuple[float, FloatArray] | None = None,
) -> Ephemeris:  # fmt: skip
    """The predicted positions of the objects at some times.

    elements : n objects. mjd_utc : (t,) times. observer_km : (t, 3) position of the observer from the centre of the
    Earth on ICRS axes, from :func:`geocentric_km`; None for the centre of the Earth. start : a time, UTC, and the
    :func:`states` then, if known.

    The error of a position follows from the covariance of the elements if known: the elements are displaced along each
    axis of the covariance and integrated too. Else it grows from 0.1″ with the years between the elements' epoch and
    the time by MPC's U (the middle of its class of runoff in longitude, 648000″^(U − ½)/9 in ten years; 0.05″ per year
    for U = 0 and if U is not known); this sets the scale of the gate.
    """
    from sameas.sky.times import Time

    planets = de421()
    planets.check(np.asarray(mjd_utc))
    tdb = Time(np.asarray(mjd_utc), format="mjd", scale="utc").tdb.mjd
    order = np.argsort(tdb)
    earth = planets.earth(tdb)
    observer = earth + (0.0 if observer_km is None else np.asarray(observer_km).T / AU_KM)
    shape = (len(elements), len(tdb))
    middle_utc, state = start or (float(np.asarray(mjd_utc)[order[len(order) // 2]]), None)
    state = states(elements, middle_utc) if state is None else state
    middle = float(Time(middle_utc, format="mjd", scale="utc").tdb.mjd)
    state_at = np.empty((2, 3, *shape))
    later = tdb >= middle
    for side in (later, ~later):
        at = np.flatnonzero(side)
        at = at[np.argsort(np.abs(tdb[at] - middle))]
        if len(at):
            state_at[..., at] = _integrated(state, middle, tdb[at], planets)
    place, velocity = state_at[0] + planets.sun(tdb)[:, None, :], state_at[1]
    to_object = place - observer[:, None, :]
    # The motion of the Sun during the light time, 0.01 km/s, is negligible (below 1 mas).
    for _ in range(2):
        light_days = np.linalg.norm(to_object, axis=0) / _LIGHT_AU_PER_DAY
        to_object = place - velocity * light_days - observer[:, None, :]
    distance = np.linalg.norm(to_object, axis=0)
    sun_at = planets.sun(tdb)
    sun = np.linalg.norm(place - sun_at[:, None, :], axis=0)
    ra = np.degrees(np.arctan2(to_object[1], to_object[0])) % 360.0
    dec = np.degrees(np.arcsin(to_object[2] / distance))
    age = np.abs(np.asarray(mjd_utc)[None] - elements.epoch_mjd[:, None]) / 365.25
    per_year = 0.1 * 648000.0 ** ((np.nan_to_num(elements.uncertainty, nan=0.0) - 0.5) / 9.0)
    sigma = np.hypot(0.1, per_year[:, None] * age)
    sigma = _sigma_by_covariance(elements, mjd_utc, observer_km, ra, dec, sigma)
    sun_distance = np.linalg.norm(sun_at - observer, axis=0)
    return Ephemeris(ra, dec, distance, _magnitude(elements, distance, sun, sun_distance), sigma)


def _sigma_by_covariance(
    elements: Elements, mjd_utc: FloatArray, observer_km: FloatArray | None, ra_deg: FloatArray, dec_deg: FloatArray,
    sigma: FloatArray,
) -> FloatArray:  # fmt: skip
    """(n, t) errors of positions, arcsec: by the covariance of the elements (major axis) if known, else ``sigma``."""
    if elements.covariance is None:
        return sigma
    rows = np.flatnonzero(np.isfinite(elements.covariance).all(axis=(1, 2)))
    if not len(rows):
        return sigma
    # Elements differ by many powers of ten: the principal axes are those of the correlation matrix.
    scale = np.sqrt(np.maximum(np.diagonal(elements.covariance[rows], axis1=1, axis2=2), 1e-40))
    value, axis = np.linalg.eigh(elements.covariance[rows] / scale[:, :, None] / scale[:, None, :])
    step = axis * np.sqrt(np.maximum(value, 0.0))[:, None, :] * scale[:, :, None]  # (n, 6 elements, 6 axes)
    displaced_elements = replace(elements.some(np.repeat(rows, 6)), covariance=None).displaced(
        step.transpose(0, 2, 1).reshape(-1, 6)
    )
    displaced = ephemeris(displaced_elements, mjd_utc, observer_km)
    shape = (len(rows), 6, -1)
    north = 3600.0 * (displaced.dec_deg.reshape(shape) - dec_deg[rows, None])
    east = 3600.0 * ((displaced.ra_deg.reshape(shape) - ra_deg[rows, None] + 180.0) % 360.0 - 180.0)
    east = east * np.cos(np.radians(dec_deg[rows, None]))
    offset = np.stack([east, north], axis=-1)
    covariance = np.einsum("nkta,nktb->ntab", offset, offset)
    out = sigma.copy()
    out[rows] = np.sqrt(np.linalg.eigvalsh(covariance)[..., -1])
    return out


def near(elements: Elements, mjd_utc: float, direction: FloatArray, radius_deg: float) -> IntArray:
    """Rows of the objects within a radius of a direction (3,) by two-body motion, seen from the centre of the Earth.

    The radius is widened for perturbations, by 0.1° plus 0.3° per year of the elements' age, more for objects near the
    Earth.
    """
    planets = de421()
    time = np.array([mjd_utc])
    earth = planets.earth(time) - planets.sun(time)
    to_object = _state(elements, mjd_utc)[0] - earth
    distance = np.linalg.norm(to_object, axis=0)
    distance_deg = np.degrees(np.arccos(np.clip(direction @ to_object / distance, -1.0, 1.0)))
    age = np.abs(mjd_utc - elements.epoch_mjd) / 365.25
    return np.flatnonzero(distance_deg < radius_deg + (0.1 + 0.3 * age) * np.maximum(1.0, 1.7 / distance))


def _magnitude(elements: Elements, distance: FloatArray, sun: FloatArray, between: FloatArray) -> FloatArray:
    """V of the H, G system (Bowell et al. 1989)."""
    cosine = (distance**2 + sun**2 - between**2) / (2 * distance * sun)
    half = np.tan(0.5 * np.arccos(np.clip(cosine, -1, 1)))
    g = np.nan_to_num(elements.g, nan=0.15)[:, None]
    phase = (1 - g) * np.exp(-3.33 * half**0.63) + g * np.exp(-1.87 * half**1.22)
    return np.asarray(elements.h[:, None] + 5 * np.log10(distance * sun) - 2.5 * np.log10(phase))


def _state(elements: Elements, mjd: float) -> FloatArray:
    """(2, 3, n) heliocentric position, au, and velocity, au/day, of the osculating orbits at a time, on ICRS axes."""
    e, q = elements.eccentricity, elements.perihelion_au
    days = mjd - elements.perihelion_mjd
    radius, anomaly = two_body(q, e, days)
    node, argument, tilt = (np.radians(x) for x in (elements.node_deg, elements.argument_deg, elements.inclination_deg))
    along = np.array([np.cos(argument) * np.cos(node) - np.sin(argument) * np.sin(node) * np.cos(tilt),
                      np.cos(argument) * np.sin(node) + np.sin(argument) * np.cos(node) * np.cos(tilt),
                      np.sin(argument) * np.sin(tilt)])  # fmt: skip
    across = np.array([-np.sin(argument) * np.cos(node) - np.cos(argument) * np.sin(node) * np.cos(tilt),
                       -np.sin(argument) * np.sin(node) + np.cos(argument) * np.cos(node) * np.cos(tilt),
                       np.cos(argument) * np.sin(tilt)])  # fmt: skip
    speed = np.sqrt(_GM_SUN / (q * (1 + e)))
    place = radius * (np.cos(anomaly) * along + np.sin(anomaly) * across)
    velocity = speed * (-np.sin(anomaly) * along + (e + np.cos(anomaly)) * across)
    return np.stack([_TO_EQUATOR @ place, _TO_EQUATOR @ velocity])


def two_body(q: FloatArray, e: FloatArray, days: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Radius, au, and true anomaly at a time from perihelion, for any eccentricity."""
    radius, anomaly = np.empty_like(q), np.empty_like(q)
    elliptic, near_parabolic, hyperbolic = e < 0.9999, np.abs(e - 1) <= 1e-4, e > 1.0001
    if elliptic.any():
        a, ec = q[elliptic] / (1 - e[elliptic]), e[elliptic]
        mean = np.remainder(math.sqrt(_GM_SUN) / a**1.5 * days[elliptic] + np.pi, 2 * np.pi) - np.pi
        angle = mean + ec * np.sin(mean)
        for _ in range(50):
            angle = angle - (angle - ec * np.sin(angle) - mean) / (1 - ec * np.cos(angle))
        anomaly[elliptic] = 2 * np.arctan2(np.sqrt(1 + ec) * np.sin(angle / 2), np.sqrt(1 - ec) * np.cos(angle / 2))
        radius[elliptic] = a * (1 - ec * np.cos(angle))
    if hyperbolic.any():
        a, ec = q[hyperbolic] / (e[hyperbolic] - 1), e[hyperbolic]
        mean = math.sqrt(_GM_SUN) / a**1.5 * days[hyperbolic]
        angle = np.arcsinh(mean / ec)
        for _ in range(80):
            angle = angle - (ec * np.sinh(angle) - angle - mean) / (ec * np.cosh(angle) - 1)
        anomaly[hyperbolic] = 2 * np.arctan(np.sqrt((ec + 1) / (ec - 1)) * np.tanh(angle / 2))
        radius[hyperbolic] = a * (ec * np.cosh(angle) - 1)
    parabolic = ~(elliptic | hyperbolic) | (near_parabolic & ~elliptic & ~hyperbolic)
    if parabolic.any():
        w = 3.0 * math.sqrt(_GM_SUN) / np.sqrt(2.0 * q[parabolic] ** 3) * days[parabolic]
        y = np.cbrt(w / 2 + np.sqrt(w * w / 4 + 1))
        s = y - 1 / y
        anomaly[parabolic] = 2 * np.arctan(s)
        radius[parabolic] = q[parabolic] * (1 + s * s)
    return radius, anomaly


def _integrated(state: FloatArray, begin: float, times: FloatArray, planets: _Planets) -> FloatArray:
    """(2, 3, n, t) states at times all later or all earlier, nearest first, from states (2, 3, n) at ``begin``."""
    from scipy.integrate import solve_ivp

    n = state.shape[2]
    if (times == begin).all():
        return np.repeat(state[..., None], len(times), axis=-1)

    def derivative(t: float, y: FloatArray) -> FloatArray:
        r, v = y.reshape(2, 3, n)
        return np.stack([v, _acceleration(planets.perturbers(np.array([t])), r, v)]).ravel()

    steps, at = np.unique(times, return_inverse=True)
    ascending = times[-1] >= begin
    solution = solve_ivp(
        derivative, (begin, float(times[-1])), state.ravel(), method="DOP853", rtol=_TOLERANCE, atol=1e-13,
        t_eval=steps if ascending else steps[::-1],
    )  # fmt: skip
    if not solution.success:
        raise InputError(f"the orbits could not be integrated from MJD {begin:g} to {times[-1]:g} ({solution.message})")
    values = solution.y if ascending else solution.y[:, ::-1]
    return np.asarray(values[:, at].reshape(2, 3, n, len(times)))


def _integrated_from_epochs(
    state: FloatArray, epochs: FloatArray, which: IntArray, end: float, planets: _Planets
) -> FloatArray:
    """(2, 3, n) states at one time from states (2, 3, n) at ``epochs[which]``."""
    from scipy.integrate import solve_ivp

    n, days = state.shape[2], end - epochs
    if not days.any():
        return state

    def derivative(fraction: float, y: FloatArray) -> FloatArray:
        r, v = y.reshape(2, 3, n)
        bodies = planets.perturbers(epochs + fraction * days)
        return np.asarray(days[which] * np.stack([v, _acceleration(bodies[..., which], r, v)])).ravel()

    solution = solve_ivp(
        derivative, (0.0, 1.0), state.ravel(), method="DOP853", rtol=_TOLERANCE, atol=1e-13, t_eval=[1.0]
    )
    if not solution.success:
        raise InputError(f"the orbits could not be integrated to MJD {end:g} ({solution.message})")
    return np.asarray(solution.y[:, 0].reshape(2, 3, n))


def _acceleration(bodies: FloatArray, r: FloatArray, v: FloatArray) -> FloatArray:
    """(3, n) acceleration, au/day², at heliocentric positions and velocities (3, n).

    bodies : planets (9, 3, n), or (9, 3, 1) at one time.
    """
    distance = np.sqrt((r * r).sum(axis=0))
    # The Sun's field to the first order of general relativity (Schwarzschild, harmonic coordinates).
    c2 = _LIGHT_AU_PER_DAY**2
    speed_sq, radial = (v * v).sum(axis=0), (r * v).sum(axis=0)
    out = -_GM_SUN * r / distance**3
    out += _GM_SUN / (c2 * distance**3) * ((4 * _GM_SUN / distance - speed_sq) * r + 4 * radial * v)
    for body, (planet, ratio) in enumerate(zip(bodies, _MASS_RATIO, strict=True)):
        to_planet = planet - r
        gm = np.full(r.shape[1], _GM_SUN / ratio)
        if body == _PLUTO:
            gm[(to_planet * to_planet).sum(axis=0) < _PLUTO_ITSELF_AU**2] = 0.0
        out += gm * (
            to_planet / ((to_planet * to_planet).sum(axis=0)) ** 1.5 - planet / ((planet * planet).sum(axis=0)) ** 1.5
        )
    return np.asarray(out)


class _Planets:
    """Positions of the planets from a JPL ephemeris file."""

    def __init__(self, kernel: Any) -> None:
        self.kernel = kernel
        self.tables: dict[int, CubicSpline] = {}
        self.first, self.last = kernel[0, 3].start_jd - 2400000.5, kernel[0, 3].end_jd - 2400000.5

    def _of(self, body: int, mjd: Any) -> FloatArray:
        """(3, t) position, au, from the barycentre of the Solar System."""
        return np.asarray(self.kernel[0, body].compute(2400000.5, mjd)[:3]) / AU_KM

    def sun(self, mjd: FloatArray) -> FloatArray:
        """(3, t) barycentric position of the Sun, au."""
        self.check(mjd)
        return self._of(10, mjd)

    def earth(self, mjd: FloatArray) -> FloatArray:
        """(3, t) barycentric position of the centre of the Earth, au."""
        self.check(mjd)
        return self._of(3, mjd) + np.asarray(self.kernel[3, 399].compute(2400000.5, mjd)[:3]) / AU_KM

    def check(self, mjd: FloatArray) -> None:
        """Refuses times outside the file."""
        if np.min(mjd) < self.first or np.max(mjd) > self.last:
            raise InputError(
                f"the planetary ephemeris covers MJD {self.first:.0f} to {self.last:.0f} only, not at {np.max(mjd):.1f}"
            )

    def perturbers(self, mjd: FloatArray) -> FloatArray:
        """(9, 3, t) heliocentric positions of the planets, interpolated between every two days (Mercury to 100 km)."""
        block = (mjd // _BLOCK_DAYS).astype(np.int64)
        out = np.empty((9, 3, len(mjd)))
        for one in set(block.tolist()):
            here = block == one
            out[:, :, here] = self._table(one)(mjd[here]).transpose(0, 2, 1)
        return out

    def _table(self, block: int) -> CubicSpline:
        if block not in self.tables:
            first, last = block * _BLOCK_DAYS - _GRID_DAYS, (block + 1) * _BLOCK_DAYS + 2 * _GRID_DAYS
            grid = np.arange(max(first, self.first), min(last, self.last), _GRID_DAYS)
            self.check(grid if len(grid) > 3 else np.array([first, last]))
            sun = self._of(10, grid)
            self.tables[block] = CubicSpline(
                grid, np.array([(self._of(body, grid) - sun).T for body in range(1, 10)]), axis=1
            )
        return self.tables[block]


@lru_cache(maxsize=1)
def de421() -> _Planets:
    """The planets of DE421, from the package ``skyfield-data``."""
    with optional("known objects need jplephem and skyfield-data", "movers"):
        from jplephem.spk import SPK
        from skyfield_data import get_skyfield_data_path
    with warnings.catch_warnings():
        # It warns about its tables of the Earth's rotation, which are not used here.
        warnings.simplefilter("ignore")
        folder = get_skyfield_data_path()
    kernel = SPK.open(str(Path(folder) / "de421.bsp"))
    atexit.register(kernel.close)
    return _Planets(kernel)


def geocentric_km(lat_deg: float, lon_deg: float, height_m: float, mjd_utc: FloatArray) -> FloatArray:
    """(t, 3) geocentric position of a site on ICRS axes, km. Latitude and longitude in degrees, east positive."""
    from astropy import units as u
    from astropy.coordinates import EarthLocation

    from sameas.sky.times import Time, installed_rotation

    place = EarthLocation.from_geodetic(
        lon_deg * u.deg, lat_deg * u.deg, (height_m if height_m == height_m else 0) * u.m
    )
    with installed_rotation():
        there = place.get_gcrs_posvel(Time(np.asarray(mjd_utc), format="mjd", scale="utc"))[0]
    return np.asarray(there.xyz.to_value(u.km)).T
