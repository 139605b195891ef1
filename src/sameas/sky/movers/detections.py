"""Detections: what was measured on several exposures, with times, errors and brightness; refused here, once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError, naming
from sameas.records import SetAside
from sameas.representation import in_short
from sameas.sky.movers.rates import EclipticAxes

#: Times of this many seconds are one exposure, where no column tells which exposure a row is of (chosen).
SAME_EXPOSURE_S = 0.5
#: MJD of 1850 and 2150: times outside are of another unit.
_FIRST_MJD, _LAST_MJD = -3241.0, 106332.0


@dataclass(frozen=True)
class TrailRates:
    """What the lengths of trails say of rates, (n,) detections.

    arcsec_per_min : (n, 2) east and north, either way; NaN without a trail. sigma : (n,) its error per axis.
    least : (n,) a detection of a higher rate would show a trail; infinite where that is not known.
    """

    arcsec_per_min: FloatArray
    sigma: FloatArray
    least: FloatArray

    def some(self, rows: NDArray[Any]) -> TrailRates:
        """Those of some detections."""
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
    frame_names : of the exposures. set_aside : rows that cannot be used. name : used in messages.
    trail : what trails say of rates.
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
        """(f,) mean time of every exposure."""
        count = np.bincount(self.frame, minlength=len(self.frame_names))
        return np.asarray(np.bincount(self.frame, self.mjd_utc, len(self.frame_names)) / np.maximum(count, 1))

    def axes(self) -> EclipticAxes:
        """The ecliptic axes at every detection."""
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
        frame : (n,) which exposure each row is of, any labels; None takes equal times (within half a second) as one.
        magnitude, magnitude_error : (n,). band : (n,) labels.
        Rows without a place, time or error, and rows that repeat another of the same exposure to 1 mas, are set aside.

        Raises
        ------
        InputError : columns of different lengths; neither or both errors; errors not positive; times that are no MJD;
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
        _check_times(mjd[reasons == ""], name)
        keep = np.flatnonzero(reasons == "")
        number, names = _frames(mjd[keep], None if labels is None else labels[keep])
        repeated = _repeated(ra[keep], dec[keep], number)
        reasons[keep[repeated]] = "the same place in the same exposure as another row"
        keep, number = keep[~repeated], number[~repeated]
        aside = np.flatnonzero(reasons != "")
        if len(np.unique(number)) < 2:
            raise InputError(
                f"{name}: {len(keep)} usable rows are all of one exposure; what moves shows on two exposures or more",
                naming("say {time:NAME} or {frame:NAME}"),
            )
        bands, band_of = np.unique(colours, return_inverse=True)
        return cls(
            ra[keep], dec[keep], error[keep], mjd[keep], number, bright[0][keep], bright[1][keep], band_of[keep],
            tuple(str(b) for b in bands), all_ids[keep], keep, names, SetAside(aside, reasons[aside]), name,
        )  # fmt: skip

    def some(self, rows: NDArray[Any]) -> Detections:
        """Some of the detections, exposures numbered as before. rows : indices or a mask."""
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
        raise InputError(f"{name}: the error of the positions is not known", naming("say {sigma:ARCSEC}"))
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
            naming("give positive errors, or say {sigma:ARCSEC}"),
        )
    return out


def _reasons(ra: FloatArray, dec: FloatArray, mjd: FloatArray, error: FloatArray) -> NDArray[np.object_]:
    reasons = np.full(len(ra), "", object)
    reasons[~np.isfinite(error).all(axis=1)] = "no error"
    reasons[~np.isfinite(mjd)] = "no time"
    with np.errstate(invalid="ignore"):
        reasons[~(np.isfinite(ra) & np.isfinite(dec) & (np.abs(dec) <= 90))] = "no position"
    return reasons


def _check_times(mjd: FloatArray, name: str) -> None:
    wrong = mjd[(mjd < _FIRST_MJD) | (mjd > _LAST_MJD)]
    if len(wrong):
        raise InputError(f"{name}: {wrong[0]:g} is no MJD between 1850 and 2150", naming("say {time:NAME}"))


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
    """(n,) rows that repeat an earlier one of their exposure to 1 mas."""
    place = np.column_stack([frame, np.rint(ra * 3.6e6), np.rint(dec * 3.6e6)]).astype(np.int64)
    _, first = np.unique(place, axis=0, return_index=True)
    repeated = np.ones(len(ra), bool)
    repeated[first] = False
    return repeated
