"""One frame, from its file to its outputs: read, calibrate, detect, place, identify, refine, write.

A :class:`FrameRequest` is all that is said of it; it travels to another process and back into the summary, by whose
digest a frame that is done already is known.
"""

from __future__ import annotations

import hashlib
import json
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import sameas
from sameas.cli.options import frame_option, in_options
from sameas.cli.pointing_hints import PointingOptions, hints
from sameas.errors import InputError
from sameas.io import checksum, replacing, write_table
from sameas.io.catalogues import BRIGHT, GAIA, catalogue
from sameas.io.plate import write_copy, write_solution
from sameas.io.regions import write_regions
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.frame.calibration import MasterFrames
from sameas.sky.frame.detect import Detection, detect
from sameas.sky.frame.field import Cone
from sameas.sky.frame.identified import FrameIdentification, Refinement
from sameas.sky.frame.image import Frame, read
from sameas.sky.frame.keywords import Given
from sameas.sky.frame.listing import listing
from sameas.sky.frame.pointing_hints import AllSky, SkyIndex, sky_index
from sameas.sky.frame.solve import searched, solve
from sameas.sky.frame.summary import summary

Progress = Callable[[str], None]
#: What is written beside the table; ``--no-page`` and ``--no-picture`` leave theirs out.
ENDINGS = {"solution": ".wcs", "regions": ".reg", "picture": ".png", "quality": "-fit.png", "page": ".html"}
_TABLES = {"fits": ".stars.fits", "votable": ".stars.vot", "ecsv": ".stars.ecsv", "csv": ".stars.csv"}
_TABLES["parquet"] = ".stars.parquet"


@dataclass(frozen=True)
class FrameRequest:
    """A frame and all that is said of it. ``columns`` are fields of ``CatalogueOptions``.

    name : of the outputs in ``folder``. time : middle of the exposure as it was typed. given : fields of ``Given``.
    """

    path: str
    folder: str
    name: str
    catalogue: str
    said: PointingOptions = field(default_factory=PointingOptions)
    columns: Mapping[str, Any] = field(default_factory=dict)
    given: Mapping[str, Any] = field(default_factory=dict)
    time: str | None = None
    hdu: str | None = None
    mask: str | None = None
    darks: tuple[str, ...] = ()
    flats: tuple[str, ...] = ()
    biases: tuple[str, ...] = ()
    threshold_sigmas: float = 4.0
    order: int | None = None
    magnitudes: Literal["auto", "off"] = "auto"
    faintest: float | None = None
    motion: bool = True
    brightest: int = 1000
    format: str = "fits"
    page: bool = True
    picture: bool = True
    copy: bool = False

    def outputs(self) -> dict[str, Path]:
        """The files that are to be written, by what they are."""
        left_out = ({"page"} if not self.page else set()) | ({"picture", "quality"} if not self.picture else set())
        endings = {"table": _TABLES[self.format], **{k: v for k, v in ENDINGS.items() if k not in left_out}}
        if self.copy:
            endings["copy"] = ".wcs" + "".join(Path(self.path).suffixes[-2:] or [".fits"])
        return {what: Path(self.folder) / (self.name + ending) for what, ending in endings.items()}

    @property
    def summary_path(self) -> Path:
        """The summary, written last."""
        return Path(self.folder) / f"{self.name}.json"

    def digest(self) -> str:
        """The SHA-256 of the frame, of all other files that it takes, and of everything that is said."""
        facts = {key: value for key, value in asdict(self).items() if key not in ("folder", "path")}
        files = [self.path, *self.darks, *self.flats, *self.biases, *([self.mask] if self.mask else [])]
        facts["files"] = [_checksum(path, _stamp(path)) for path in files]
        facts["catalogue"] = _catalogue_digest(self.catalogue)
        facts["version"] = sameas.__version__
        return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()

    def done(self) -> dict[str, Any] | None:
        """The summary of a run with the same files and words whose outputs are all there."""
        try:
            told = json.loads(self.summary_path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        same = isinstance(told, dict) and told.get("digest") == self.digest()
        return told if same and all(path.exists() for path in self.outputs().values()) else None


def fulfil(request: FrameRequest, progress: Progress = lambda stage: None) -> dict[str, Any]:
    """Does all of it, and returns the summary that it has written too.

    Raises
    ------
    InputError : anything about the frame, the catalogue or the outputs that cannot be used.
    """
    began = time.perf_counter()
    digest, frame = request.digest(), _frame(request, progress)
    progress("detecting")
    measured = detect(frame, Detection(threshold_sigmas=request.threshold_sigmas))
    detected = time.perf_counter()
    found = _found(request, frame, measured, progress)
    solved = time.perf_counter()
    progress("writing")
    told = {
        "program": "sameas", "version": sameas.__version__, "digest": digest, "file": str(Path(request.path).resolve()),
        **summary(found, frame),
    }  # fmt: skip
    _write(request, frame, found, told)
    told["seconds"] = {
        "to_detections": round(detected - began, 2),
        "to_identification": round(solved - detected, 2),
        "to_outputs": round(time.perf_counter() - solved, 2),
    }
    told["outputs"] = {what: path.name for what, path in request.outputs().items()}
    with replacing(request.summary_path) as draft:
        draft.write_text(json.dumps(told, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return told


def _frame(request: FrameRequest, progress: Progress) -> Frame:
    from astropy.time import Time

    progress("reading")
    moment = None if request.time is None else _moment(request.time, Time)
    hdu = int(request.hdu) if request.hdu is not None and request.hdu.isdigit() else request.hdu
    frame = read(request.path, hdu=hdu, mask=request.mask, given=Given(**request.given, mid_time=moment))
    if request.darks or request.flats or request.biases:
        frame = _calibration(request.biases, request.darks, request.flats)(frame)
    return frame


def _moment(said: str, kind: Any) -> Any:
    """A time as people type it: a Julian year, or a date."""
    try:
        year = float(said)
    except ValueError:
        year = None
    try:
        return kind(said, scale="utc") if year is None else kind(year, format="jyear", scale="tdb")
    except ValueError:
        raise InputError(
            f"--time {said}: give a date such as 2018-10-18T03:01:20, or a year such as 2018.795"
        ) from None


def _found(request: FrameRequest, frame: Frame, measured: Any, progress: Progress) -> FrameIdentification:
    own_hints = hints(request.said, frame, whole_sky=request.catalogue.lower() != GAIA)
    near = searched(own_hints, frame.shape)
    progress("reading the catalogue")
    stars = _catalogue(request, near, progress)
    moment = frame.facts.mid_time
    if moment is None and stars.epoch_jyr is not None:
        raise InputError(
            f"{frame.name}: the header has no time of the exposure (DATE-OBS, MJD-OBS, JD), so the stars cannot be "
            "moved to it; say --time DATE"
        )
    epoch = None if moment is None else float(moment.tdb.jyear)
    all_sky = next((hint for hint in own_hints if isinstance(hint, AllSky)), None)
    progress("identifying" if all_sky is None else "searching the whole sky")
    found = solve(
        measured,
        stars,
        own_hints,
        epoch_jyr=epoch,
        refinement=Refinement(order=request.order, magnitudes=request.magnitudes),
        index=None if all_sky is None else _index(_key(request, near), epoch, frame.shape, all_sky),
        motion=request.motion,
        faintest=request.faintest,
    )
    return replace(
        found, notes=(*found.notes, *(f"doubt: {in_options(words, frame_option)}" for words in stars.doubts))
    )


def _write(request: FrameRequest, frame: Frame, found: FrameIdentification, told: dict[str, Any]) -> None:
    folder = Path(request.folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); say -o another folder") from error
    paths = request.outputs()
    rows = listing(found)
    facts = {key: told[key] for key in ("program", "version", "digest", "file", "frame", "catalogue", "epoch_jyr")}
    write_table(rows, paths["table"], provenance={**facts, "summary": json.dumps(told, ensure_ascii=True)})
    write_solution(found.plate, paths["solution"])
    radius = 2.0 * found.measured.psf_fwhm_px * told["place"]["scale_arcsec_per_px"]
    write_regions(rows, paths["regions"], radius_arcsec=radius)
    if "copy" in paths:
        write_copy(found.plate, request.path, paths["copy"])
    if "page" in paths:
        from sameas.pages import write_frame_page

        write_frame_page(found, frame, paths["page"], brightest=request.brightest)
    if "picture" in paths:
        from sameas.plots.frame import picture, quality
        from sameas.plots.sheet import save

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            save(picture(found, frame, brightest=request.brightest), paths["picture"])
            save(quality(found), paths["quality"])


# ---- kept from frame to frame of one process ----


@lru_cache(maxsize=4)
def _calibration(biases: tuple[str, ...], darks: tuple[str, ...], flats: tuple[str, ...]) -> MasterFrames:
    return MasterFrames.of(
        biases=[read(path) for path in biases],
        darks=[read(path) for path in darks],
        flats=[read(path) for path in flats],
    )


_Key = tuple[str, str, Cone | None, float | None]


def _key(request: FrameRequest, near: Cone | None) -> _Key:
    """What a catalogue is kept under: the field matters for those that are read field by field."""
    by_field = request.catalogue.lower() == GAIA or Path(request.catalogue).is_dir()
    columns = json.dumps(dict(request.columns), sort_keys=True)
    return request.catalogue, columns, near if by_field else None, request.faintest


def _catalogue(request: FrameRequest, near: Cone | None, progress: Progress) -> Catalogue:
    return _kept_catalogue(_key(request, near), progress)


_catalogues: dict[_Key, Catalogue] = {}


def _kept_catalogue(key: _Key, progress: Progress = lambda stage: None) -> Catalogue:
    if key not in _catalogues:
        name, columns, near, faintest = key
        while len(_catalogues) >= 4:
            _catalogues.pop(next(iter(_catalogues)))
        said = CatalogueOptions(**json.loads(columns))
        _catalogues[key] = catalogue(name, near, said, faintest=faintest, progress=progress)
    return _catalogues[key]


@lru_cache(maxsize=2)
def _index(key: _Key, epoch_jyr: float | None, shape: tuple[int, int], hint: AllSky) -> SkyIndex:
    from sameas.sky.frame.field import StarField

    # Patterns do not change in a year.
    return sky_index(StarField.of(_kept_catalogue(key), epoch_jyr).stars(), shape, hint)


def _stamp(path: str) -> tuple[int, int]:
    try:
        info = Path(path).stat()
    except OSError:
        raise InputError(f"{path}: no such file") from None
    return info.st_size, info.st_mtime_ns


@lru_cache(maxsize=256)
def _checksum(path: str, stamp: tuple[int, int]) -> str:
    return checksum(path)


def _catalogue_digest(name: str) -> str:
    path = Path(name)
    if path.is_dir():
        parts = sorted((str(p.relative_to(path)), *_stamp(str(p))) for p in path.rglob("*.parquet"))
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    return name.lower() if name.lower() in (BRIGHT, GAIA) else _checksum(name, _stamp(name))
