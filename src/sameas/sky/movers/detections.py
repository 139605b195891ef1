"""Detections of several exposures, with times, errors and magnitudes; input is checked here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError, naming
from sameas.records import SetAside
from sameas.representation import counted, in_short
from sameas.sky import column_values
from sameas.sky.catalogue import Catalogue
from sameas.sky.movers.detection_times import TIMES, possible, times_of
from sameas.sky.movers.rates import EclipticAxes

#: Times within this many seconds are one exposure if no column of exposures is given (chosen).
SAME_EXPOSURE_S = 0.5


@dataclass(frozen=True)
class TrailRates:
    """Rates from the lengths of trails, (n,) detections.

    arcsec_per_min : (n, 2) east and north, of either sign; NaN without a trail. sigma : (n,) its error per axis.
    least : (n,) minimum rate with a visible trail; infinite where not known.
    """

    arcsec_per_min: FloatArray
    sigma: FloatArray
    least: FloatArray

    def some(self, rows: NDArray[Any]) -> TrailRates:
        """The rates of some detections."""
        return TrailRates(self.arcsec_per_min[rows], self.sigma[rows], self.least[rows])


@in_short
@dataclass(frozen=True)
class Detections:
    """Detections of several exposures. Make them with :meth:`Detections.of`.

    Attributes
    ----------
    ra_deg, dec_deg : (n,) ICRS. covariance : (n, 3) arcsec², east-east, east-north, north-north.
    mjd_utc : (n,) of the middle of the exposure.
    frame : (n,) number of the exposure; exposures are numbered by time.
    magnitude, magnitude_error : (n,), NaN where not measured. band : (n,) number of the band. bands : their names.
    ids : (n,) of the rows. rows : (n,) in the user's table.
    frame_names : of the exposures. set_aside : unusable rows. name : used in messages.
    trail : rates from trails.
    """

    ra_deg: FloatArray
    dec_deg: FloatArray
    covariance: FloatArray
    mjd_utc: FloatArray
    frame: IntArray
    magnitude: FloatArray
    magnitude_error: FloatArray
    band: IntArray
    bands: tuple[str, ...]
    ids: NDArray[Any]
    rows: IntArray
    frame_names: tuple[str, ...]
    set_aside: SetAside = field(default_factory=lambda: SetAside(np.empty(0, np.int64), np.empty(0, object)))
    name: str = "detections"
    trail: TrailRates | None = None

    def __len__(self) -> int:
        return len(self.ra_deg)

    @property
    def frame_mjd(self) -> FloatArray:
        """(f,) mean time of each exposure."""
        count = np.bincount(self.frame, minlength=len(self.frame_names))
        return np.asarray(np.bincount(self.frame, self.mjd_utc, len(self.frame_names)) / np.maximum(count, 1))

    @property
    def typical_sigma_arcsec(self) -> float:
        """The median position error per axis."""
        return math.sqrt(float(np.median(self.covariance[:, [0, 2]])))

    def axes(self) -> EclipticAxes:
        """The ecliptic axes at each detection."""
        return EclipticAxes.of(self.ra_deg, self.dec_deg)

    @classmethod
    def of(
        cls,
        ra_deg: ArrayLike,
        dec_deg: ArrayLike,
        mjd_utc: ArrayLike,
        *,
        sigma_arcsec: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        frame: ArrayLike | None = None,
        magnitude: ArrayLike | None = None,
        magnitude_error: ArrayLike | None = None,
        band: ArrayLike | None = None,
        ids: Sequence[Any] | NDArray[Any] | None = None,
        name: str = "detections",
    ) -> Detections:
        """Detections from columns, checked.

        ra_deg, dec_deg, mjd_utc : (n,). sigma_arcsec : one, or (n,), along both axes; or covariance : (n, 3) arcsec²
        of east-east, east-north, north-north.
        frame : (n,) labels of the exposures; None groups equal times (within half a second).
        magnitude, magnitude_error : (n,). band : (n,) labels.
        Rows without position, time or error, a few of impossible times, and duplicates within an exposure (to 1 mas)
        are set aside.

        Raises
        ------
        InputError : columns of different lengths; neither or both errors given; errors not positive; most times no MJD;
            fewer than two exposures.

        Example
        -------
        >>> seen = Detections.of([10.0, 10.01], [5.0, 5.0], [60000.0, 60000.02], sigma_arcsec=0.2)
        >>> len(seen), seen.frame_names
        (2, ('0', '1'))
        """
        ra, dec, mjd = (_numbers(x, name, what) for x, what in ((ra_deg, "ra"), (dec_deg, "dec"), (mjd_utc, "time")))
        n = len(ra)
        error = _error(sigma_arcsec, covariance, n, name)
        bright = [
            np.full(n, np.nan) if x is None else _numbers(x, name, "magnitude") for x in (magnitude, magnitude_error)
        ]
        labels = None if frame is None else np.asarray(frame)
        colours = np.zeros(n, np.int64) if band is None else np.asarray(np.ma.filled(band, "")).astype(str)
        all_ids = np.arange(n) if ids is None else np.asarray(ids)
        for values, what in ((dec, "dec"), (mjd, "time"), (labels, "frame"), (colours, "band"), (all_ids, "ids")):
            if values is not None and len(values) != n:
                raise InputError(f"{name}: {len(values)} values of {what} for {n} rows; give one per row")
        reasons = _reasons(ra, dec, mjd, error)
        in_range = possible(mjd)
        reasons[(reasons == "") & ~in_range] = "a time that is no MJD between 1890 and 2150"
        if 2 * np.count_nonzero(in_range) < np.count_nonzero(np.isfinite(mjd)):
            wrong = mjd[np.isfinite(mjd) & ~in_range][0]
            raise InputError(f"{name}: {wrong:g} is not an MJD between 1890 and 2150", naming("give {time:NAME}"))
        keep = np.flatnonzero(reasons == "")
        number, names = _frames(mjd[keep], None if labels is None else labels[keep])
        repeated = _repeated(ra[keep], dec[keep], number)
        reasons[keep[repeated]] = "the same place in the same exposure as another row"
        keep, number = keep[~repeated], number[~repeated]
        aside = np.flatnonzero(reasons != "")
        if len(np.unique(number)) < 2:
            of_one = counted(len(keep), "usable row is", "usable rows are all")
            raise InputError(
                f"{name}: {of_one} of one exposure; movers need two exposures or more",
                naming("give {time:NAME} or {frame:NAME}"),
            )
        bands, band_of = np.unique(colours, return_inverse=True)
        return cls(
            ra_deg=ra[keep], dec_deg=dec[keep], covariance=error[keep], mjd_utc=mjd[keep], frame=number,
            magnitude=bright[0][keep], magnitude_error=bright[1][keep], band=band_of[keep],
            bands=tuple(str(b) for b in bands), ids=all_ids[keep], rows=keep, frame_names=names,
            set_aside=SetAside(aside, reasons[aside]), name=name,
        )  # fmt: skip

    def some(self, rows: NDArray[Any]) -> Detections:
        """Some of the detections, with the same exposure numbers. rows : indices or a mask."""
        names = ("ra_deg", "dec_deg", "covariance", "mjd_utc", "frame", "magnitude", "magnitude_error", "band", "ids")
        trail = None if self.trail is None else self.trail.some(rows)
        return replace(self, **{k: getattr(self, k)[rows] for k in (*names, "rows")}, trail=trail)


def _numbers(values: ArrayLike, name: str, what: str) -> FloatArray:
    try:
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(np.float64), np.nan)
        out = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: {what} is not a column of numbers ({error})") from None
    if out.ndim != 1:
        raise InputError(f"{name}: {what} has shape {out.shape}; give one number per row")
    return out


def _error(sigma: ArrayLike | None, covariance: ArrayLike | None, n: int, name: str) -> FloatArray:
    if (sigma is None) == (covariance is None):
        raise InputError(f"{name}: the error of the positions is not known", naming("give {sigma:ARCSEC}"))
    if covariance is not None:
        out = np.asarray(covariance, dtype=np.float64)
        if out.shape != (n, 3):
            raise InputError(f"{name}: covariance has shape {out.shape}; give ({n}, 3): ee, en, nn in arcsec²")
    else:
        spread = np.broadcast_to(np.asarray(sigma, dtype=np.float64), (n,))
        out = np.column_stack([spread * np.abs(spread), np.zeros(n), spread * np.abs(spread)])
    with np.errstate(invalid="ignore"):
        wrong = np.flatnonzero((out[:, 0] <= 0) | (out[:, 2] <= 0) | (out[:, 1] ** 2 >= out[:, 0] * out[:, 2]))
    if len(wrong):
        raise InputError(
            f"{name}: {len(wrong)} position errors are not positive (first: row {wrong[0]})",
            naming("give positive errors, or give {sigma:ARCSEC}"),
        )
    return out


def _reasons(ra: FloatArray, dec: FloatArray, mjd: FloatArray, error: FloatArray) -> NDArray[np.object_]:
    reasons = np.full(len(ra), "", object)
    reasons[~np.isfinite(error).all(axis=1)] = "no error"
    reasons[~np.isfinite(mjd)] = "no time"
    with np.errstate(invalid="ignore"):
        reasons[~(np.isfinite(ra) & np.isfinite(dec) & (np.abs(dec) <= 90))] = "no position"
    return reasons


def _frames(mjd: FloatArray, labels: NDArray[Any] | None) -> tuple[IntArray, tuple[str, ...]]:
    """(n,) number of each row's exposure by time, and the names."""
    if labels is None:
        order = np.argsort(mjd, kind="stable")
        later = np.diff(mjd[order], prepend=mjd[order[:1]]) * 86400.0 > SAME_EXPOSURE_S
        number = np.empty(len(mjd), np.int64)
        number[order] = np.cumsum(later)
        return number, tuple(map(str, range(int(number.max(initial=-1)) + 1)))
    names, code = np.unique(labels.astype(str), return_inverse=True)
    when = np.bincount(code, mjd) / np.bincount(code)
    order = np.lexsort([names, when])
    rank = np.empty(len(names), np.int64)
    rank[order] = np.arange(len(names))
    return rank[code], tuple(str(names[k]) for k in order)


def _repeated(ra: FloatArray, dec: FloatArray, frame: IntArray) -> NDArray[np.bool_]:
    """(n,) mask of the rows that repeat an earlier one of their exposure, to 1 mas."""
    place = np.column_stack([frame, np.rint(ra * 3.6e6), np.rint(dec * 3.6e6)]).astype(np.int64)
    _, first = np.unique(place, axis=0, return_index=True)
    repeated = np.ones(len(ra), bool)
    repeated[first] = False
    return repeated


# Tables of detections: columns of times, exposures and bands; positions as in catalogues.

#: Recognised column names, ignoring case, in order of preference.
EXPOSURES = ("exposure", "frame", "visit", "expnum", "exposure_id", "obsid", "image")
BANDS = ("band", "filter", "fid", "filt", "fltr")


@dataclass(frozen=True)
class DetectionColumns:
    """Columns of a table of detections; None finds them by name.

    time : middle of the exposure: MJD, JD, HJD, BJD, dates, or days with a time of day in another column.
    exposure : label of the exposure; "none" groups equal times. band : of the magnitude; "none" for no band.
    """

    time: str | None = None
    exposure: str | None = None
    band: str | None = None


def detections_of(
    catalogues: Sequence[Catalogue], columns: DetectionColumns | None = None
) -> tuple[Detections, tuple[str, ...]]:
    """The detections of one or more tables, and one line per table on the chosen columns.

    catalogues : the tables. Without a column of exposures, equal times are one exposure.

    Raises InputError: no column of times, a named column that does not exist, or a column without times.

    >>> from sameas.sky import Catalogue, CatalogueOptions
    >>> table = {"ra": [10.0, 10.01], "dec": [5.0, 5.0], "mjd": [60000.0, 60000.02]}
    >>> seen, lines = detections_of([Catalogue.of(table, "night", options=CatalogueOptions(sigma=0.2))])
    >>> len(seen), lines
    (2, ('night: time mjd (MJD, UTC), exposures by equal times, no band',))
    """
    wanted = columns or DetectionColumns()
    parts, lines = [], []
    for catalogue in catalogues:
        part, line = _one(catalogue, wanted)
        parts.append(part)
        lines.append(line)
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    several = len(catalogues) > 1
    labels: NDArray[Any] | None = joined.pop("exposure")
    if labels is not None and (labels == "").all():
        labels = None
    elif several and labels is not None:
        source = np.repeat([c.name for c in catalogues], [len(c) for c in catalogues])
        labels = np.array([f"{a} {b}" for a, b in zip(source, labels, strict=True)])
    ids = np.concatenate([c.ids.astype(str) for c in catalogues]) if several else catalogues[0].ids
    name = catalogues[0].name if not several else f"{len(catalogues)} tables"
    return Detections.of(**joined, frame=labels, ids=ids, name=name), tuple(lines)


def _one(catalogue: Catalogue, wanted: DetectionColumns) -> tuple[dict[str, Any], str]:
    table, n = catalogue.table, len(catalogue)
    time = _chosen(catalogue, wanted.time, TIMES, "time")
    time = time or next(iter(column_values.counted_days(table)), None)
    if time is None:
        raise InputError(
            f"{catalogue.name}: no column of times (known names: {', '.join(TIMES[:6])}, …)", naming("give {time:NAME}")
        )
    exposure = None if wanted.exposure == "none" else _chosen(catalogue, wanted.exposure, EXPOSURES, "exposure")
    band = None if wanted.band == "none" else _chosen(catalogue, wanted.band, BANDS, "band")
    mjd, how = times_of(catalogue, time)
    a = catalogue.astrometry
    spread = catalogue.records()
    covariance = np.full((n, 3), np.nan)
    full = spread.full_covariance()
    covariance[spread.rows] = np.column_stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]])
    nothing = np.full(n, np.nan)
    columns = {
        "ra_deg": a.ra_deg,
        "dec_deg": a.dec_deg,
        "mjd_utc": mjd,
        "covariance": covariance,
        "magnitude": nothing if catalogue.magnitude is None else catalogue.magnitude,
        "magnitude_error": nothing if catalogue.magnitude_error is None else catalogue.magnitude_error,
        "band": _texts(table[band]) if band else np.full(n, ""),
        "exposure": _texts(table[exposure]) if exposure else np.full(n, ""),
    }
    by = f"exposure {exposure}" if exposure else "exposures by equal times"
    return columns, f"{catalogue.name}: time {time} ({how}), {by}, {f'band {band}' if band else 'no band'}"


def _chosen(catalogue: Catalogue, option: str | None, known: Sequence[str], what: str) -> str | None:
    names = {name.lower(): name for name in reversed(catalogue.table.colnames)}
    if option is not None:
        if option in catalogue.table.colnames:
            return option
        there = ", ".join(catalogue.table.colnames[:12])
        raise InputError(f"{catalogue.name}: no column {option!r} (there are {there})", naming(f"give {{{what}:NAME}}"))
    return next((names[name] for name in known if name in names), None)


def _texts(column: Any) -> NDArray[Any]:
    return np.asarray(np.ma.filled(np.ma.MaskedArray(column).astype(str), ""))
