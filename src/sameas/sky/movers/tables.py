"""Tables of detections: which of their columns are times, exposures, bands; positions as catalogues have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.errors import InputError, naming
from sameas.sky.catalogue import Catalogue
from sameas.sky.movers.detections import Detections

#: Names of columns that are understood, in any case, in this order.
TIMES: tuple[str, ...] = (
    "mjd_utc",
    "mjd",
    "mjd_mid",
    "mjd_obs",
    "midpointmjdtai",
    "expmidptmjd",
    "obstime",
    "obs_time",
    "date_obs",
)
TIMES += ("jd_utc_mid", "jd_utc", "jd", "time")
EXPOSURES = ("exposure", "frame", "visit", "expnum", "exposure_id", "obsid", "image")
BANDS = ("band", "filter", "fid", "filt", "fltr")
#: Numbers above this are Julian dates, not modified ones.
_JULIAN = 2_000_000.0


@dataclass(frozen=True)
class DetectionColumns:
    """Columns of a table of detections; None finds them by their names.

    time : of the middle of the exposure, UTC: MJD, JD or ISO dates. exposure : which exposure a row is of; "none" takes
    equal times as one. band : of the magnitude; "none" for no band.
    """

    time: str | None = None
    exposure: str | None = None
    band: str | None = None


def detections_of(
    catalogues: Sequence[Catalogue], columns: DetectionColumns | None = None
) -> tuple[Detections, tuple[str, ...]]:
    """The detections of one table or more, and the lines that say how their columns were understood.

    catalogues : the tables; where none has a column of exposures and each has one time, each is one exposure.

    Raises
    ------
    InputError : no column of times, or one that is not there or holds no times.

    Example
    -------
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
    if time is None:
        raise InputError(
            f"{catalogue.name}: no column of times (known names: {', '.join(TIMES[:6])}, …)",
            naming("say {time:NAME}"),
        )
    exposure = None if wanted.exposure == "none" else _chosen(catalogue, wanted.exposure, EXPOSURES, "exposure")
    band = None if wanted.band == "none" else _chosen(catalogue, wanted.band, BANDS, "band")
    mjd, how = _mjd(table[time], catalogue.name, time)
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
    return columns, f"{catalogue.name}: time {time} ({how}, UTC), {by}, {f'band {band}' if band else 'no band'}"


def _chosen(catalogue: Catalogue, option: str | None, known: Sequence[str], what: str) -> str | None:
    names = {name.lower(): name for name in reversed(catalogue.table.colnames)}
    if option is not None:
        if option in catalogue.table.colnames:
            return option
        there = ", ".join(catalogue.table.colnames[:12])
        raise InputError(f"{catalogue.name}: no column {option!r} (there are {there})", naming(f"say {{{what}:NAME}}"))
    return next((names[name] for name in known if name in names), None)


def _mjd(column: Any, name: str, label: str) -> tuple[FloatArray, str]:
    values = np.ma.MaskedArray(column)
    if values.dtype.kind in "fiu":
        days = np.asarray(np.ma.filled(values.astype(np.float64), np.nan))
        julian = bool(np.nanmedian(days) > _JULIAN) if np.isfinite(days).any() else False
        return (days - 2400000.5, "JD") if julian else (days, "MJD")
    from sameas.times import Time

    texts = np.ma.filled(values.astype(str), "")
    out = np.full(len(texts), np.nan)
    there = np.char.strip(texts) != ""
    try:
        out[there] = Time([t.strip().removesuffix("Z") for t in texts[there]], scale="utc").mjd
    except ValueError:
        raise InputError(
            f"{name}: column {label} holds neither MJD, JD nor dates such as 2018-10-18T03:01:20",
            naming("say {time:NAME}"),
        ) from None
    return out, "dates"


def _texts(column: Any) -> NDArray[Any]:
    return np.asarray(np.ma.filled(np.ma.MaskedArray(column).astype(str), ""))
