"""Series: the frames of one field and filter in a night, with tables of their stars and exposures.

Series are made from the outputs of identified frames (:mod:`sameas.front.framing`).
"""

from __future__ import annotations

import gzip
import math
import os
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sameas.errors import InputError
from sameas.front.framing import FrameRequest, frame_of
from sameas.front.provenance import program
from sameas.io import read_table, write_table
from sameas.io.atomic import filling
from sameas.representation import counted
from sameas.sky.frame.image import Frame
from sameas.sky.series import MIN_OVERLAP, SAME_TIME_DAYS, Exposure, Series, tie

#: Extensions of frames in a folder, without that of a compression.
ENDINGS = (".fits", ".fit", ".fts")
#: Words in IMAGETYP of calibration frames.
_NO_SKY = ("dark", "flat", "bias", "zero")


def frames_in(folder: str | Path) -> list[str]:
    """The paths of the frames in a folder, sorted; without calibration frames (by IMAGETYP) and our own tables.

    Raises InputError: there is none.
    """
    found = [str(path) for path in _images_in(folder) if _shows_sky(path)]
    if not found:
        raise InputError(f"{folder}: no frames in this folder ({', '.join(ENDINGS)}, plain or packed .gz, .fz)")
    return found


def calibrations_in(folder: str | Path) -> list[str]:
    """The paths of the calibration frames in a folder (by IMAGETYP), sorted."""
    return [str(path) for path in _images_in(folder) if not _shows_sky(path)]


def _images_in(folder: str | Path) -> list[Path]:
    """The FITS files of a folder, sorted, without our own tables."""
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: no such folder")
    found = []
    for path in sorted(Path(folder).iterdir()):
        plain = path.name.lower().removesuffix(".gz").removesuffix(".fz")
        if path.is_file() and plain.endswith(ENDINGS) and not plain.endswith(".stars.fits"):
            found.append(path)
    return found


def _shows_sky(path: Path) -> bool:
    """Whether IMAGETYP in the first header is not that of a calibration frame."""
    try:
        with (gzip.open if path.name.endswith(".gz") else open)(path, "rb") as file:
            head = file.read(2880 * 4).decode("ascii", "replace")
    except (OSError, EOFError, zlib.error):
        return True  # the reader reports what is wrong
    cards = (head[k : k + 80] for k in range(0, len(head), 80))
    kind = next((card[10:].split("/")[0].strip(" '").lower() for card in cards if card.startswith("IMAGETYP")), "")
    return not any(word in kind for word in _NO_SKY)


@dataclass(frozen=True)
class IdentifiedFrame:
    """An identified frame: its request and its summary."""

    request: FrameRequest
    summary: Mapping[str, Any]

    @property
    def filter(self) -> str:
        """The filter in the header; "" where there is none."""
        return str(self.summary["exposure"].get("filter") or "")

    def frame(self) -> Frame:
        """The calibrated image."""
        return frame_of(self.request, lambda stage: None)

    def exposure(self) -> Exposure:
        """The measurements, read from the output table.

        Raises InputError: the header has no time of the exposure.
        """
        from sameas.sky.times import Time

        summary = self.summary
        if summary["exposure"]["mid_time"] is None:
            raise InputError(f"{summary['frame']}: the header has no time of the exposure; a series needs the order")
        date, scale = summary["exposure"]["mid_time"].split()
        place = summary["place"]
        return Exposure.of_listing(
            read_table(self.request.outputs()["table"]), summary["frame"],
            float(Time(date, scale=scale.lower()).utc.mjd), place["scale_arcsec_per_px"],
            (place["rows"], place["columns"]), float(summary["exposure"]["exposure_s"] or "nan"),
            float(summary.get("psf_fwhm_px") or 3.0),
        )  # fmt: skip


@dataclass(frozen=True)
class FieldSeries:
    """One series of a night. name : of its files. members : frames in time order. filter : "" for any."""

    name: str
    series: Series
    members: tuple[IdentifiedFrame, ...]
    filter: str


def series_of(done: Sequence[IdentifiedFrame], *, by_filter: bool = True) -> tuple[list[FieldSeries], list[str]]:
    """The series among identified frames, the longest first, and the reasons why other frames are in none.

    by_filter : one series per filter; False for the search of movers, which uses all frames of a field.
    """
    kept, reasons = [], []
    for one in done:
        try:
            kept.append((one, one.exposure()))
        except InputError as error:
            reasons.append(str(error))
    found = []
    for group in _fields(kept, by_filter, MIN_OVERLAP):
        if len(group) < 2:
            reasons.append(f"{group[0][1].name}: the only frame of its field and filter; no series")
            continue
        group, again = _each_time_once(sorted(group, key=lambda pair: pair[1].mjd_utc))
        reasons += again
        try:
            series = tie([exposure for _, exposure in group])
        except InputError as error:
            reasons.append(str(error))
            continue
        found.append((series, tuple(one for one, _ in group)))
    found.sort(key=lambda pair: -len(pair[1]))
    names = ["series" if k == 0 else f"series-{k + 1}" for k in range(len(found))]
    each = [FieldSeries(name, *pair, pair[1][0].filter) for name, pair in zip(names, found, strict=True)]
    return each, reasons


def _each_time_once(
    group: Sequence[tuple[IdentifiedFrame, Exposure]],
) -> tuple[list[tuple[IdentifiedFrame, Exposure]], list[str]]:
    """The first frame of each time, of frames in time order, and a line on the others."""
    kept, others = list(group[:1]), list(group[:0])
    for pair in group[1:]:
        (others if abs(pair[1].mjd_utc - kept[-1][1].mjd_utc) < SAME_TIME_DAYS else kept).append(pair)
    if not others:
        return kept, []
    names = ", ".join(exposure.name for _, exposure in others[:3]) + (", …" if len(others) > 3 else "")
    words = counted(len(others), "frame has", "frames have")
    return kept, [f"{words} the time of another and cannot be used: {names}; check DATE-OBS, or give each frame once"]


def _fields(
    frames: Sequence[tuple[IdentifiedFrame, Exposure]], by_filter: bool, overlap: float
) -> list[list[tuple[IdentifiedFrame, Exposure]]]:
    """Groups of frames with nearby centres, and of one filter if ``by_filter``."""

    def together(one: IdentifiedFrame, other: IdentifiedFrame) -> bool:
        return (not by_filter or one.filter == other.filter) and _near(one, other, overlap)

    groups: list[list[tuple[IdentifiedFrame, Exposure]]] = []
    for frame in frames:
        group = next((g for g in groups if together(g[0][0], frame[0])), None)
        if group is None:
            groups.append([frame])
        else:
            group.append(frame)
    return groups


def _near(one: IdentifiedFrame, other: IdentifiedFrame, overlap: float) -> bool:
    a, b = one.summary["place"], other.summary["place"]
    north = b["middle_dec_deg"] - a["middle_dec_deg"]
    east = ((b["middle_ra_deg"] - a["middle_ra_deg"] + 180.0) % 360.0 - 180.0) * math.cos(
        math.radians(a["middle_dec_deg"])
    )
    return math.hypot(east, north) < overlap * math.hypot(a["width_deg"], a["height_deg"])


def write_series(each: Sequence[FieldSeries], folder: str | Path, facts: Mapping[str, Any]) -> list[str]:
    """Writes the star table and the frame table of every series; returns the file names."""
    written = []
    facts_of_run = {**program(), **facts}
    for one in each:
        tables = {"stars": one.series.star_table(), "frames": one.series.frame_table()}
        for what, table in tables.items():
            written.append(f"{one.name}.{what}.fits")
            write_table(table, Path(folder) / written[-1], provenance=facts_of_run, overwrite=True)
    return written


def write_folder(
    each: Sequence[FieldSeries], folder: Path, title: str, facts: Mapping[str, Any],
    failed: Sequence[tuple[str, str]], reasons: Sequence[str], movers: tuple[str, str] | None = None,
) -> list[str]:  # fmt: skip
    """Writes the tables and the index page of the series in a folder of frames; returns the file names.

    title : of the page. facts : provenance. failed : names of frames that could not be identified, and why.
    reasons : why others are in no series. movers : link to the page of movers, and its words.
    """
    from sameas.pages.frame import series_field, write_series_page

    written = write_series(each, folder, facts)
    fields = [series_field(one.name, one.series, [m.summary for m in one.members], one.filter) for one in each]
    write_series_page(folder / "index.html", title, fields, failed=failed, reasons=reasons, movers=movers)
    return [*written, "index.html"]


def folder_of_series(
    done: Sequence[IdentifiedFrame], failed: Sequence[tuple[str, str]], folder: Path, title: str,
    facts: Mapping[str, Any], *, say: Callable[[Iterable[str]], object] = lambda lines: None,
) -> list[str]:  # fmt: skip
    """Makes series of identified frames, and writes them with :func:`write_folder`; returns the file names.

    say : called with the lines of the report, section by section.
    """
    from sameas.report.frame import star_lines
    from sameas.report.prose import DOUBT

    each, reasons = series_of(done)
    for one in each:
        say(["", *star_lines(one.series, one.filter)])
    say([f"{DOUBT}{reason}" for reason in reasons])
    with filling(folder) as draft:
        return write_folder(each, draft, title, facts, failed, reasons)
