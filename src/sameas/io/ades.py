"""Reports for the Minor Planet Center: ADES as PSV and XML (version 2022), and lines of 80 columns.

An :class:`Observer` has the observatory, people and telescope, read from a TOML file; an :class:`Observation` is one
detection. Reports are written to files, never sent.
Source: IAU ADES, github.com/IAU-ADES/ADES-Master; minorplanetcenter.net/iau/info/OpticalObs.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from sameas.arrays import IntArray
from sameas.errors import InputError, blanked
from sameas.io.atomic import replacing
from sameas.sky.frame.measurements import POGSON

if TYPE_CHECKING:
    from sameas.sky.movers.known import KnownObjects
    from sameas.sky.movers.search import Movers
    from sameas.sky.series import Series

#: Columns of a report in the order of ADES.
COLUMNS = ("permID", "provID", "trkSub", "mode", "stn", "obsTime", "ra", "dec", "rmsRA", "rmsDec", "rmsCorr", "astCat",
           "mag", "rmsMag", "band", "photCat", "logSNR", "notes", "remarks")  # fmt: skip
#: One-letter codes of catalogues in lines of 80 columns, by their names in ADES: the Minor Planet Center's, as in
#: ``iau-ades`` 0.1.3.
_CATALOGUE_CODES = {
    "USNOA1": "a", "USNOSA1": "b", "USNOA2": "c", "USNOSA2": "d", "UCAC1": "e", "Tyc1": "f", "Tyc2": "g",
    "GSC1.0": "h", "GSC1.1": "i", "GSC1.2": "j", "GSC2.2": "k", "ACT": "l", "GSCACT": "m", "SDSS8": "n", "USNOB1": "o",
    "PPM": "p", "UCAC4": "q", "UCAC2": "r", "PPMXL": "t", "UCAC3": "u", "NOMAD": "v", "CMC14": "w", "Hip2": "x",
    "Hip1": "y", "GSC": "z", "2MASS": "L", "GSC2.3": "M", "SDSS7": "N", "CMC15": "Q", "URAT1": "S", "Gaia1": "U",
    "Gaia2": "V", "Gaia3": "W", "Gaia3E": "X", "UCAC5": "Y", "ATLAS2": "Z", "PS1_DR1": "1", "PS1_DR2": "2",
}  # fmt: skip
_BASE_62 = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz"
#: Tables and keys that an observer's file must have, with examples.
_REQUIRED = {
    "observatory": {"mpcCode": "810"},
    "submitter": {"name": "J. Doe"},
    "telescope": {"design": "Schmidt-Cassegrain", "aperture": "0.36", "detector": "CCD"},
    "report": {"astCat": "Gaia3"},
}


@dataclass(frozen=True)
class Observer:
    """The header of a report: observatory, people, telescope.

    code : of the observatory. submitter : name. observers, measurers : names. telescope : design, aperture (metres),
    detector, and other keys of ADES. catalogue : of the astrometry, by its name in ADES. mode : CCD, CMO.
    band : of the magnitudes. comments : lines.
    """

    code: str
    submitter: str
    observers: tuple[str, ...]
    measurers: tuple[str, ...]
    telescope: tuple[tuple[str, str], ...]
    catalogue: str
    mode: str = "CCD"
    band: str = ""
    comments: tuple[str, ...] = field(default=())

    @classmethod
    def read(cls, path: str | Path) -> Observer:
        """From a TOML file.

        Raises InputError: not TOML, a required key is missing, or has a wrong type or form.
        """
        try:
            settings = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})", _to_write(_REQUIRED)) from None
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: is not TOML ({error})", _to_write(_REQUIRED)) from None
        tables = {name: settings.get(name, {}) for name in ("telescope", "report", "observers", "measurers", "comment")}
        for name, table in tables.items():
            if not isinstance(table, dict):
                raise InputError(f"{path}: {name} is {table!r}, not a table", f"write [{name}], and its keys below")
        _refuse_incomplete(settings, path)
        code = str(settings["observatory"]["mpcCode"])
        if not re.fullmatch(r"[0-9A-Z][0-9A-Za-z]{2,3}", code):
            raise InputError(f"{path}: mpcCode {code!r} is not a code of the Minor Planet Center, such as 810 or J95")
        telescope, report = tables["telescope"], tables["report"]
        submitter = str(settings["submitter"]["name"])
        for table, keys in _FORMS.items():
            for key, (pattern, what) in keys.items():
                value = str(tables[table].get(key, ""))
                if value and not re.fullmatch(pattern, value):
                    raise InputError(f"{path}: {table}.{key} is {value!r}, which ADES does not allow", f"give {what}")
        return cls(
            code,
            submitter,
            _names(tables["observers"].get("name", submitter)),
            _names(tables["measurers"].get("name", submitter)),
            tuple((k, str(telescope[k])) for k in ("name", "design", "aperture", "detector", "fRatio", "pixelScale")
                  if k in telescope),
            str(report["astCat"]),
            str(report.get("mode", "CCD")),
            str(report.get("band", "")),
            _names(tables["comment"].get("line", ())),
        )  # fmt: skip

    @property
    def doubts(self) -> tuple[str, ...]:
        """One sentence for each thing that the Minor Planet Center may reject, or that the report lacks."""
        unlisted = f"{self.catalogue!r} is none of the names of catalogues of the Minor Planet Center known here"
        lines = (
            "" if self.catalogue in _CATALOGUE_CODES else f"{unlisted} (Gaia3, Gaia2, UCAC4 …); it rejects others",
            "" if self.band else "the header names no band, so the report has no magnitudes",
        )
        return tuple(line for line in lines if line)


#: Forms of values by ADES 2022, and what to give.
_DECIMAL = r"\d{1,5}|\d{0,4}\.\d{1,4}", "a number, without unit, of at most six characters"
_FORMS = {
    "telescope": {"aperture": _DECIMAL, "fRatio": _DECIMAL, "pixelScale": _DECIMAL},
    "report": {
        "astCat": (r"[.A-Za-z0-9_]{1,8}", "the Minor Planet Center's name of the catalogue, such as Gaia3"),
        "band": (r"[A-Za-z0-9_]{1,3}", "the band in at most three characters, such as G"),
        "mode": (r"[A-Za-z0-9_]{1,3}", "CCD or CMO"),
    },
}
#: Least error and greatest correlation that the three decimals of a report can hold.
_LEAST_RMS, _HIGHEST_CORRELATION = 0.001, 0.999


def _refuse_incomplete(settings: Mapping[str, Any], path: str | Path) -> None:
    """Raises InputError: keys that are required are missing; it names all of them."""
    missing: dict[str, dict[str, str]] = {}
    for table, keys in _REQUIRED.items():
        given = settings.get(table)
        missing[table] = {k: v for k, v in keys.items() if not isinstance(given, dict) or k not in given}
    missing = {table: keys for table, keys in missing.items() if keys}
    if missing:
        names = ", ".join(f"{table}.{key}" for table, keys in missing.items() for key in keys)
        raise InputError(f"{path}: says no {names}", _to_write(missing))


def _to_write(missing: Mapping[str, Mapping[str, str]]) -> str:
    """What to write into an observer's file."""
    lines = {table: ", ".join(f'{key} = "{value}"' for key, value in keys.items()) for table, keys in missing.items()}
    tables = (f"below [{table}] {line}" for table, line in lines.items())
    return f"write, each key in a line: {'; '.join(tables)}"


def _names(value: object) -> tuple[str, ...]:
    return tuple(map(str, value)) if isinstance(value, list | tuple) else (str(value),)


@dataclass(frozen=True)
class Observation:
    """One detection of a report.

    name : trkSub, at most eight letters and digits. time : ISO, UTC. rms_east, rms_north : arcsec, 1σ.
    permanent, provisional : number and designation of a known object. magnitude, magnitude_error : NaN if not
    measured. remarks : on this detection.
    """

    name: str
    time: str
    ra_deg: float
    dec_deg: float
    rms_east: float
    rms_north: float
    correlation: float
    magnitude: float = math.nan
    magnitude_error: float = math.nan
    snr: float = math.nan
    permanent: str = ""
    provisional: str = ""
    remarks: str = ""

    @classmethod
    def of(
        cls, name: str, mjd_utc: float, place_deg: tuple[float, float], covariance: Sequence[float], **measured: Any
    ) -> Observation:
        """An observation from MJD (UTC), right ascension and declination in degrees, and the covariance (3,) east-east,
        east-north, north-north in arcsec². measured : other fields, by name."""
        from sameas.sky.times import Time

        east, both, north = covariance
        return cls(
            name, str(Time(mjd_utc, format="mjd", scale="utc").isot), float(place_deg[0]), float(place_deg[1]),
            math.sqrt(east), math.sqrt(north), float(both / math.sqrt(east * north)), **measured,
        )  # fmt: skip

    def fields(self, observer: Observer) -> dict[str, str]:
        """The values by ADES column; columns without a value are omitted."""
        out = {
            "permID": self.permanent,
            "provID": self.provisional,
            "trkSub": self.name,
            "mode": observer.mode,
            "stn": observer.code,
            "obsTime": self.time.rstrip("Z") + "Z",
            "ra": f"{round(self.ra_deg, 6) % 360.0:.6f}",
            "dec": f"{self.dec_deg:+.6f}",
            "rmsRA": f"{max(self.rms_east, _LEAST_RMS):.3f}",
            "rmsDec": f"{max(self.rms_north, _LEAST_RMS):.3f}",
            "rmsCorr": f"{min(max(self.correlation, -_HIGHEST_CORRELATION), _HIGHEST_CORRELATION):.3f}",
            "astCat": observer.catalogue,
        }
        if math.isfinite(self.magnitude) and observer.band:
            out |= {"mag": f"{self.magnitude:.2f}", "band": observer.band}
            if math.isfinite(self.magnitude_error):
                out["rmsMag"] = f"{max(self.magnitude_error, _LEAST_RMS):.3f}"
            out["photCat"] = observer.catalogue
        if 0 < self.snr < math.inf:
            out["logSNR"] = f"{math.log10(self.snr):.2f}"
        out["remarks"] = self.remarks
        return {key: blanked(out[key]).replace("|", "/") for key in COLUMNS if out.get(key)}


def observations(
    movers: Movers, known: KnownObjects | None, which: IntArray, series: Series | None = None
) -> list[Observation]:
    """The rows of a report of those tracklets, tracklet by tracklet.

    series : that the detections are of; magnitudes are then those of its frames, errors have those of their plates.
    """
    detections, out = movers.detections, []
    if series is None:
        error = np.where(detections.magnitude_error > 0, detections.magnitude_error, np.nan)
        covariance, magnitude, snr = detections.covariance, detections.magnitude, POGSON / error
    else:
        covariance, magnitude, snr = (
            series.measured(name, detections.rows) for name in ("covariance", "magnitude", "snr")
        )
    for k in which.tolist():
        for row in movers.members[k][movers.members[k] >= 0].tolist():
            out.append(
                Observation.of(
                    movers.names[k], detections.mjd_utc[row], (detections.ra_deg[row], detections.dec_deg[row]),
                    covariance[row], magnitude=float(magnitude[row]),
                    magnitude_error=float(detections.magnitude_error[row]),
                    snr=float(snr[row]), permanent="" if known is None else known.number(k),
                )
            )  # fmt: skip
    return out


def _header(observer: Observer, software: str) -> list[tuple[str, list[tuple[str, str]]]]:
    """The blocks of the header, in their order."""
    blocks = [
        ("observatory", [("mpcCode", observer.code)]),
        ("submitter", [("name", observer.submitter)]),
        ("observers", [("name", name) for name in observer.observers]),
        ("measurers", [("name", name) for name in observer.measurers]),
        ("telescope", list(observer.telescope)),
        ("software", [("astrometry", software), ("objectDetection", software)]),
        *([("comment", [("line", line) for line in observer.comments])] if observer.comments else []),
    ]
    return [(block, [(key, blanked(value)) for key, value in entries]) for block, entries in blocks]


def write_psv(observations: Sequence[Observation], observer: Observer, path: str | Path, *, software: str) -> None:
    """Writes an ADES report in PSV: text with bars between the columns."""
    rows = [one.fields(observer) for one in observations]
    used = [key for key in COLUMNS if key == "permID" or any(key in row for row in rows)]
    lines = ["# version=2022"]
    for block, entries in _header(observer, software):
        lines += [f"# {block}", *(f"! {key} {value}" for key, value in entries)]
    table = [used, *([row.get(key, "") for key in used] for row in rows)]
    widths = [max(len(line[k]) for line in table) for k in range(len(used))]
    lines += ["|".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in table]
    with replacing(Path(path)) as draft:
        draft.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_xml(observations: Sequence[Observation], observer: Observer, path: str | Path, *, software: str) -> None:
    """Writes an ADES report in XML."""
    root = ElementTree.Element("ades", version="2022")
    block = ElementTree.SubElement(root, "obsBlock")
    context = ElementTree.SubElement(block, "obsContext")
    for name, entries in _header(observer, software):
        part = ElementTree.SubElement(context, name)
        for key, value in entries:
            ElementTree.SubElement(part, key).text = value
    data = ElementTree.SubElement(block, "obsData")
    for one in observations:
        optical = ElementTree.SubElement(data, "optical")
        for key, value in one.fields(observer).items():
            ElementTree.SubElement(optical, key).text = value
    ElementTree.indent(root, " ")
    with replacing(Path(path)) as draft:
        text = ElementTree.tostring(root, encoding="unicode")
        draft.write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n', encoding="utf-8")


def write_80_columns(
    observations: Sequence[Observation], observer: Observer, path: str | Path, *, software: str
) -> None:
    """Writes lines of 80 columns, the older format, which the Minor Planet Center still accepts."""
    lines = [f"COD {observer.code}", f"OBS {', '.join(observer.observers)}", f"MEA {', '.join(observer.measurers)}"]
    lines += [f"TEL {' '.join(value for _, value in observer.telescope)}", f"COM measured with {software}"]
    lines = [blanked(line) for line in (*lines, *(line_of(one, observer) for one in observations))]
    with replacing(Path(path)) as draft:
        draft.write_text("\n".join(lines) + "\n", encoding="utf-8")


#: Writers of the report formats, by file extension.
REPORTS = {"psv": write_psv, "xml": write_xml, "txt": write_80_columns}


def _packed(number: int) -> str:
    """The number of a minor planet in five characters, as the Minor Planet Center packs it.

    >>> [_packed(number) for number in (2713, 99999, 100000, 360017, 619999, 620000, 3140113)]
    ['02713', '99999', 'A0000', 'a0017', 'z9999', '~0000', '~AZaz']
    """
    if number < 620_000:
        return f"{_BASE_62[number // 10_000]}{number % 10_000:04d}"
    rest = number - 620_000
    return "~" + "".join(_BASE_62[rest // 62**k % 62] for k in (3, 2, 1, 0))


def line_of(one: Observation, observer: Observer) -> str:
    """One line of 80 columns.

    >>> who = Observer("810", "J. Doe", (), (), (), "Gaia3")
    >>> line_of(Observation("sa00001", "2018-10-18T03:03:53.784", 62.5, 22.5, 0.1, 0.1, 0.0), who)
    '     sa00001  C2018 10 18.12770604 10 00.000+22 30 00.00               W     810'
    """
    number = _packed(int(one.permanent)) if one.permanent.isdigit() else "     "
    name = "       " if number.strip() else f"{one.name[:7]:7}"
    date, clock = one.time.rstrip("Z").split("T")
    hours, minutes, seconds = clock.split(":")
    day = int(date[8:]) + (int(hours) * 3600 + int(minutes) * 60 + float(seconds)) / 86400.0
    when = f"{date[:4]} {date[5:7]} {day:09.6f}"
    mag = (
        f"{one.magnitude:5.1f}{observer.band[:1] or ' '}" if math.isfinite(one.magnitude) and observer.band else " " * 6
    )
    code = _CATALOGUE_CODES.get(observer.catalogue, " ")
    note = {"CCD": "C", "CMO": "B"}.get(observer.mode, "C")
    place = f"{_hours(one.ra_deg)}{_degrees(one.dec_deg)}"
    return f"{number}{name}  {note}{when}{place}{' ' * 9}{mag}{code}{' ' * 5}{observer.code:3}"


def _hours(ra_deg: float) -> str:
    thousandths = round(ra_deg / 15.0 * 3600_000.0) % 86_400_000
    seconds, left = divmod(thousandths, 1000)
    return f"{seconds // 3600:02d} {seconds // 60 % 60:02d} {seconds % 60:02d}.{left:03d}"


def _degrees(dec_deg: float) -> str:
    hundredths = round(abs(dec_deg) * 360_000.0)
    seconds, left = divmod(hundredths, 100)
    sign = "-" if dec_deg < 0 else "+"
    return f"{sign}{seconds // 3600:02d} {seconds // 60 % 60:02d} {seconds % 60:02d}.{left:02d}"
