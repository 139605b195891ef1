"""Identification of an image with a catalogue: :func:`match_frame` and its result, :class:`MatchFrame`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sameas.errors import InputError
from sameas.front.match import as_source, call_text, id_of
from sameas.front.options import COLUMN_OPTIONS, fields_of, refuse_unknown, renamed
from sameas.report.prose import Result, in_one

if TYPE_CHECKING:
    from astropy.table import Table
    from astropy.wcs import WCS
    from matplotlib.figure import Figure

    from sameas.front.framing import FrameRequest
    from sameas.result import Explanation
    from sameas.sky.catalogue import Catalogue
    from sameas.sky.frame.identified import FrameIdentification
    from sameas.sky.frame.image import Frame

#: The plots of a frame; the first is the default.
PLOTS = ("picture", "quality")


@dataclass(frozen=True, repr=False)
class MatchFrame(Result):
    """An image identified with a catalogue, returned by :func:`match_frame`. ``len()`` is the number of pairs.

    Attributes
    ----------
    sky : measurements, stars of the field, plate model, and the core's result in pixels.
    frame, catalogue : the input. request : all options. call : the call that made it.
    """

    _offers = ".table .pairs .wcs .report() .explain(star) .plot() .write(path or folder)"

    sky: FrameIdentification
    frame: Frame
    catalogue: Catalogue
    request: FrameRequest
    call: str = ""

    def __len__(self) -> int:
        return len(self.sky.result.matches)

    @property
    def doubts(self) -> tuple[str, ...]:
        """One sentence for each doubt about the catalogue or the result."""
        return (*self.catalogue.doubts, *self.sky.notes)

    @cached_property
    def table(self) -> Table:
        """One row per measurement and one per star that was not identified; see :mod:`sameas.sky.frame.outputs`."""
        from sameas.sky.frame.outputs import listing

        return listing(self.sky)

    @cached_property
    def pairs(self) -> Table:
        """The matched pairs: rows and numbers of the measurements, rows and ids of the stars, probabilities."""
        from sameas.sky.joins import pair_table

        return pair_table(self.sky.result)

    @property
    def wcs(self) -> WCS:
        """The plate solution as an astropy ``WCS``."""
        return self.sky.plate.to_wcs()

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Position, plate model, counts, scatter, brightness and assumptions, as plain numbers and text."""
        from sameas.front.framing import summary_of

        return summary_of(self.sky, self.frame, self.catalogue, partial(renamed, side=0, columns={}))

    def report(self) -> str:
        """The report that the command prints."""
        from sameas.report.frame import frame_lines

        return in_one(frame_lines(self.summary))

    def explain(
        self, id: Any = None, *, row: int | None = None, source: Literal["measurement", "star"] = "star"
    ) -> Explanation:
        """Why a star, or a measurement, was matched as it was; ``print`` the result. Distances are in pixels.

        Parameters
        ----------
        id : of the star in its catalogue, or the number of the measurement. row : among ``sky.stars`` or
            ``sky.measured``, instead. source : which of the two it is.

        Raises
        ------
        InputError : no such star or measurement; neither id nor row is given, or both.
        """
        if source not in ("measurement", "star"):
            raise InputError(f"source is {source!r}; give 'measurement' or 'star'")
        side = 1 if source == "measurement" else 2
        records = self.sky.result.first if side == 1 else self.sky.result.second
        return self.sky.result.explain(id_of(records, id, row), source=side)

    def plot(self, name: str = PLOTS[0]) -> Figure:
        """A plot of the frame with its stars, or of the ``quality`` of the plate model; notebooks show it.

        Raises
        ------
        InputError : an unknown name; matplotlib is missing.
        """
        from sameas.plots import frame

        if name not in PLOTS:
            raise InputError(f"there is no plot {name!r}; give one of {', '.join(PLOTS)}")
        if name == "quality":
            return frame.quality(self.sky)
        return frame.picture(self.sky, self.frame, brightest=self.request.brightest)

    def write(self, path: str | os.PathLike[str], *, format: str | None = None, overwrite: bool = True) -> None:
        """Writes the table with its provenance; for a path without extension, all outputs of the command.

        Parameters
        ----------
        path : a table, its format that of the extension; or a folder for table, plate solution, regions, pictures,
            page and summary. format : of the table. overwrite : False refuses a table that exists.

        Raises
        ------
        InputError : the path cannot be written, or is the frame itself.
        """
        from sameas.front.framing import provenance_of, write
        from sameas.io import write_table
        from sameas.io.atomic import refuse_inputs

        refuse_inputs(path, (self.request.path, self.request.catalogue))
        if Path(path).suffix or format is not None:
            facts = provenance_of(self.request, self.summary) | {"command": self.call}
            write_table(self.table, path, provenance=facts, format=format, overwrite=overwrite)
        else:
            digest = hashlib.sha256(self.call.encode()).hexdigest() if "in memory" in self._kinds else None
            write(replace(self.request, folder=os.fspath(path)), self.frame, self.sky, self.summary, digest=digest)

    @property
    def _kinds(self) -> tuple[str, ...]:
        """ "a file" or "in memory" for the frame, and the name of the catalogue."""
        frame = "a file" if os.path.exists(self.request.path) else "in memory"
        return frame, self.request.catalogue

    @property
    def headline(self) -> str:
        """A summary in one line."""
        from sameas.representation import count

        counts = self.summary["found"]
        stars = f"{count(counts['identified'])} of {count(counts['measurements'])} measurements identified"
        return (
            f"Match of {self.frame.name} with {self.catalogue.name}: {stars}, {count(counts['missing'])} stars missing"
        )


def match_frame(
    image: str | os.PathLike[str] | Frame,
    catalogue: Any,
    *,
    aim: Any = None,
    radius: float | None = None,
    scale: float | tuple[float, float] | None = None,
    header: bool = True,
    time: Any = None,
    dark: Sequence[str] = (),
    flat: Sequence[str] = (),
    bias: Sequence[str] = (),
    mask: str | os.PathLike[str] | None = None,
    hdu: int | str | None = None,
    threshold: float = 4.0,
    gain: float | None = None,
    read_noise: float | None = None,
    saturation: float | None = None,
    order: int | None = None,
    magnitudes: Literal["auto", "off"] = "auto",
    faintest: float | None = None,
    motion: bool = True,
    progress: Callable[[str], None] = lambda stage: None,
    **columns: Any,
) -> MatchFrame:
    """Identifies the stars on a frame with a catalogue, and determines where it points.

    Parameters
    ----------
    image : path of a FITS file, or a ``sameas.sky.Frame``.
    catalogue : a path, a folder of Parquet files, "bright" (whole sky, G < 10) or "gaia" (online), or anything that
        :func:`sameas.match` takes but ``Records``.
    aim : centre of the frame: (ra, dec) in degrees, or a ``SkyCoord``. radius : largest error of it, degrees.
    scale : arcsec per pixel, or its lower and upper limit. header : whether to use the header's plate solution.
    time : middle of the exposure: a date, a Julian year or an astropy ``Time``.
    dark, flat, bias : paths of calibration frames. mask : of an image, not 0
        at unusable pixels. hdu : of the image.
    threshold : faintest detection in σ. gain, read_noise, saturation : in electrons per unit, electrons, units.
    order : of the plate model, 1 to 5; chosen from the pairs if not given. magnitudes : "off" ignores brightness.
    faintest : magnitude limit of the stars. motion : False applies no proper motion.
    progress : called with the name of each step.
    columns : options of the catalogue's columns, as of :func:`sameas.match`, without numbers: ``sigma=0.1``.

    Raises
    ------
    InputError : no image; the approximate pointing is unknown; no reliable solution; unknown options.
    """
    from sameas.front import framing
    from sameas.front.pointing import PointingOptions
    from sameas.sky.frame.image import Frame

    own = {
        "aim": aim, "radius": radius, "scale": scale, "header": header, "time": time, "hdu": hdu, "mask": mask,
        "threshold": threshold, "gain": gain, "read_noise": read_noise, "saturation": saturation, "order": order,
        "magnitudes": magnitudes, "faintest": faintest, "motion": motion,
    }  # fmt: skip
    known = (*own, "dark", "flat", "bias", "progress", *(one.parameter for one in COLUMN_OPTIONS))
    refuse_unknown(columns, known, "match_frame")
    stated = {name: value for name, value in columns.items() if value is not None}
    image, catalogue = as_source(image), as_source(catalogue)
    in_memory = isinstance(image, Frame)
    name = image.name if isinstance(image, Frame) else Path(image).name
    stars = None if isinstance(catalogue, str) else _catalogue_in_memory(catalogue, stated)
    request = framing.FrameRequest(
        path=name if in_memory else str(image),
        folder="identified",
        name=Path(name).stem,
        catalogue=catalogue if isinstance(catalogue, str) else "in memory",
        pointing=PointingOptions(_aim(aim), radius, _scale(scale), header),
        columns=fields_of(stated, 0),
        given=framing.given_values(gain, read_noise, saturation),
        time=None if time is None else _time(time),
        hdu=None if hdu is None else str(hdu),
        mask=None if mask is None else os.fspath(mask),
        darks=tuple(map(os.fspath, dark)),
        flats=tuple(map(os.fspath, flat)),
        biases=tuple(map(os.fspath, bias)),
        threshold_sigmas=threshold,
        order=order,
        magnitudes=magnitudes,
        faintest=faintest,
        motion=motion,
    )
    frame = image if isinstance(image, Frame) else framing.frame_of(request, progress)
    match, stars = _found_on(frame, request, stars, progress)
    return MatchFrame(match, frame, stars, request, call_text(match_frame, (image, catalogue), own | stated))


def _found_on(
    frame: Frame, request: FrameRequest, stars: Catalogue | None, progress: Callable[[str], None]
) -> tuple[FrameIdentification, Catalogue]:
    """The identified frame and its catalogue; refusals name the options of Python."""
    from sameas.front import framing
    from sameas.sky.frame.detect import Detection, detect

    progress("detecting")
    measured = detect(frame, Detection(threshold_sigmas=request.threshold_sigmas))
    try:
        return framing.found_on(request, frame, measured, progress, stars)
    except InputError as error:
        raise InputError(renamed(error.words, 0, {}), source=error.source) from error


def _catalogue_in_memory(source: Any, stated: dict[str, Any]) -> Catalogue:
    """The catalogue of an in-memory table, its columns interpreted."""
    from sameas.front.request import Request
    from sameas.sky.crossmatch import MatchOptions

    if not hasattr(source, "astrometry"):
        return Request((source,), MatchOptions(), stated, ("catalogue",)).catalogue(1)
    return Request((source,), MatchOptions(), {f"{name}1": value for name, value in stated.items()}).catalogue(1)


def _aim(aim: Any) -> tuple[float, float] | None:
    if aim is None:
        return None
    if hasattr(aim, "icrs"):
        return float(aim.icrs.ra.deg), float(aim.icrs.dec.deg)
    try:
        ra, dec = map(float, aim)
    except (TypeError, ValueError):
        ra, dec = float("nan"), float("nan")
    if not abs(dec) <= 90.0 or not abs(ra) < float("inf"):
        raise InputError(f"aim={aim!r}: give (ra, dec) in degrees, or a SkyCoord")
    return ra % 360.0, dec


def _scale(scale: float | tuple[float, float] | None) -> tuple[float, float] | None:
    from sameas.front.pointing import CLOSE

    if scale is None:
        return None
    try:
        low, high = map(float, scale)  # type: ignore[arg-type]
    except TypeError:
        low, high = float(scale) * (1 - CLOSE), float(scale) * (1 + CLOSE)  # type: ignore[arg-type]
    if not 0.0 < low <= high < float("inf"):
        raise InputError(f"scale={scale!r}: give arcsec per pixel, or the least and the largest, above zero")
    return low, high


def _time(time: Any) -> str:
    """A time as text: an ISO date, or a Julian year."""
    return str(time.utc.isot) if hasattr(time, "isot") else str(time)
