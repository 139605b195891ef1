"""The pipeline of one frame, from its file to its outputs: read, calibrate, detect, place, identify, refine, write.

A :class:`FrameRequest` holds all options. It can be sent to another process; its digest is written to the summary, so
that a frame that is already done is recognised.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import sameas
from sameas.errors import Argument, InputError, Message, naming
from sameas.front.pointing import (
    PointingOptions,
    aim_of_catalogue,
    at_other_scales,
    difference_of_solutions,
    header_elsewhere,
    hints,
    horizon_doubt,
)
from sameas.front.provenance import program
from sameas.io import checksum, write_table
from sameas.io.atomic import filling
from sameas.io.catalogues import BRIGHT, GAIA, catalogue
from sameas.io.format import json_text
from sameas.io.plate import write_copy, write_regions, write_solution
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.frame.bayer import without_mosaic
from sameas.sky.frame.detect import Detection, detect
from sameas.sky.frame.field import Cone, StarField
from sameas.sky.frame.identified import FrameIdentification, Refinement, hints_by_field, search_cone, solve
from sameas.sky.frame.image import Frame, MasterFrames, read
from sameas.sky.frame.keywords import Given
from sameas.sky.frame.measurements import Measurements
from sameas.sky.frame.outputs import listing, summary
from sameas.sky.frame.place import NoSolution
from sameas.sky.frame.pointing_hints import (
    AIM_LISTS,
    BRIGHTEST_PATTERNS,
    FURTHER_PATTERNS,
    Aim,
    AimLists,
    AllSky,
    ApproximateWcs,
    Hint,
    SkyIndex,
    sky_index,
)

Progress = Callable[[str], None]
#: Outputs in addition to the table; page and pictures are optional.
ENDINGS = {"solution": ".wcs", "regions": ".reg", "picture": ".png", "quality": "-fit.png", "page": ".html"}
_TABLES = {"fits": ".stars.fits", "votable": ".stars.vot", "ecsv": ".stars.ecsv", "csv": ".stars.csv"}
_TABLES["parquet"] = ".stars.parquet"


def given_values(gain: float | None, read_noise: float | None, saturation: float | None) -> dict[str, float]:
    """The fields of ``Given`` that the user states, in electrons per unit, electrons, units."""
    values = {"gain_e_per_adu": gain, "read_noise_e": read_noise, "saturation_adu": saturation}
    return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class FrameRequest:
    """A frame and all its options. ``columns`` are fields of ``CatalogueOptions``.

    name : of the outputs in ``folder``. time : middle of the exposure, as typed. given : fields of ``Given``.
    """

    path: str
    folder: str
    name: str
    catalogue: str
    pointing: PointingOptions = field(default_factory=PointingOptions)
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
    brightest: int | None = None
    format: str = "fits"
    page: bool = True
    picture: bool = True
    copy: bool = False

    def outputs(self) -> dict[str, Path]:
        """The paths of the outputs, by kind."""
        omitted = ({"page"} if not self.page else set()) | ({"picture", "quality"} if not self.picture else set())
        endings = {"table": _TABLES[self.format], **{k: v for k, v in ENDINGS.items() if k not in omitted}}
        if self.copy:
            endings["copy"] = ".wcs" + "".join(Path(self.path).suffixes[-2:] or [".fits"])
        return {what: Path(self.folder) / (self.name + ending) for what, ending in endings.items()}

    @property
    def summary_path(self) -> Path:
        """The summary, written last."""
        return Path(self.folder) / f"{self.name}.json"

    def digest(self) -> str:
        """The SHA-256 of the frame, of all other input files, and of all options."""
        facts = {key: value for key, value in asdict(self).items() if key not in ("folder", "path")}
        files = [self.path, *self.darks, *self.flats, *self.biases, *([self.mask] if self.mask else [])]
        facts["files"] = [_checksum(path, _stamp(path)) for path in files]
        facts["catalogue"] = _catalogue_digest(self.catalogue)
        facts["version"] = sameas.__version__
        return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()

    def done(self) -> dict[str, Any] | None:
        """The summary of an earlier run with the same digest whose outputs all exist; else None."""
        try:
            outcome = json.loads(self.summary_path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return None
        same = isinstance(outcome, dict) and outcome.get("digest") == self.digest()
        return outcome if same and all(path.exists() for path in self.outputs().values()) else None


def fulfil(request: FrameRequest, progress: Progress, words: Callable[[str], str]) -> dict[str, Any]:
    """Runs the pipeline, writes the outputs, and returns the summary.

    words : formats a message that names arguments.

    Raises InputError: the frame, the catalogue or an output path cannot be used.
    """
    began = time.perf_counter()
    request.digest()  # refuses missing files before any work
    if Path(request.path).resolve() in {path.resolve() for path in request.outputs().values()}:
        raise InputError(f"{request.path}: the picture would replace this frame; give another output folder")
    frame = frame_of(request, progress)
    progress("detecting")
    measured = detect(frame, Detection(threshold_sigmas=request.threshold_sigmas))
    detected = time.perf_counter()
    match, stars = found_on(request, frame, measured, progress)
    solved = time.perf_counter()
    progress("writing")
    return write(request, frame, match, summary_of(match, frame, stars, words), [detected - began, solved - detected])


def summary_of(
    match: FrameIdentification, frame: Frame, stars: Catalogue, words: Callable[[str], str]
) -> dict[str, Any]:
    """The summary of a frame, with the interpretation of its catalogue and the doubts about it.

    words : formats a message that names arguments.
    """
    notes = [*map(words, match.notes), *(f"doubt: {words(doubt)}" for doubt in stars.doubts)]
    outcome = summary(replace(match, notes=tuple(notes)), frame)
    return outcome | {"understood": [words(line) for line in stars.interpretation]}


def write(
    request: FrameRequest,
    frame: Frame,
    match: FrameIdentification,
    facts: dict[str, Any],
    seconds: Sequence[float] = (),
    digest: str | None = None,
) -> dict[str, Any]:
    """Writes all outputs of a request, and returns the summary, which is one of them.

    facts : the summary so far. seconds : run time of the detection and of the identification. digest : of inputs that
    are not files.
    """
    began = time.perf_counter()
    outcome = {
        **program(), "digest": request.digest() if digest is None else digest,
        "file": str(Path(request.path).resolve()), **facts,
    }  # fmt: skip
    with filling(request.folder) as folder:
        drafts = replace(request, folder=str(folder))
        _write(drafts, frame, match, outcome, facts)
        if "SOURCE_DATE_EPOCH" not in os.environ:  # set for reproducible outputs
            steps = [*seconds, time.perf_counter() - began]
            named = ("to_detections", "to_identification", "to_outputs")[-len(steps) :]
            outcome["seconds"] = {name: round(step, 2) for name, step in zip(named, steps, strict=True)}
        outcome["outputs"] = {what: path.name for what, path in request.outputs().items()}
        drafts.summary_path.write_text(json_text(outcome), encoding="utf-8")
    return outcome


def frame_of(request: FrameRequest, progress: Progress) -> Frame:
    """The frame of a request, read, calibrated, and its mosaic of colours made even."""
    from sameas.sky.times import Time

    progress("reading")
    moment = None if request.time is None else _moment(request.time, Time)
    hdu = int(request.hdu) if request.hdu is not None and request.hdu.isdecimal() else request.hdu
    frame = read(request.path, hdu=hdu, mask=request.mask, given=Given(**request.given, mid_time=moment))
    if request.darks or request.flats or request.biases:
        frame = _calibration(request.biases, request.darks, request.flats)(frame)
    return without_mosaic(frame)


def _moment(text: str, kind: Any) -> Any:
    """The time of a text: a Julian year, or a date."""
    try:
        year = float(text)
    except ValueError:
        year = None
    try:
        return kind(text, scale="utc") if year is None else kind(year, format="jyear", scale="tdb")
    except ValueError:
        given = Message(Argument("time", text), ": give a date such as 2018-10-18T03:01:20, or a year such as 2018.795")
        raise InputError(given) from None


def found_on(
    request: FrameRequest, frame: Frame, measured: Measurements, progress: Progress, given: Catalogue | None = None
) -> tuple[FrameIdentification, Catalogue]:
    """The identified frame and its catalogue. given : the catalogue, if it is in memory."""
    try:
        return _found_by_hints(request, frame, measured, progress, given)
    except InputError as error:
        unusable = [line.removeprefix("doubt: ") for line in frame.facts.lines if line.endswith("not used")]
        if not unusable:
            raise
        raise InputError(Message(error.words, "; header: ", "; ".join(unusable)), source=error.source) from error


def _found_by_hints(
    request: FrameRequest, frame: Frame, measured: Measurements, progress: Progress, given: Catalogue | None
) -> tuple[FrameIdentification, Catalogue]:
    own_hints = hints(request.pointing, frame, whole_sky=request.catalogue.lower() != GAIA)
    solved = partial(_solved, request, frame, measured, progress=progress, given=given)
    of_field = partial(_aim_of_catalogue, request, own_hints, progress, given)
    if isinstance(own_hints[0], AllSky) and (aim := of_field()) is not None:
        match, stars = _solved_at_some_scale(solved, request, frame, [aim])
        match = replace(match, notes=(*match.notes, "assumed: the aim is the middle of the catalogue"))
    else:
        try:
            match, stars = _solved_at_some_scale(solved, request, frame, own_hints)
        except InputError as refusal:
            if request.pointing.aim_deg is not None or (aim := of_field()) is None:
                raise
            match, stars = _solved_elsewhere(solved, aim, refusal)
    header = next((hint.wcs for hint in own_hints if isinstance(hint, ApproximateWcs)), None)
    off = "" if header is None else difference_of_solutions(header, match.plate.to_wcs(), frame.shape)
    if off:
        match = replace(match, notes=(*match.notes, f"the plate solution of the header is {off}"))
    ra_deg, dec_deg = match.placement.wcs.wcs.crval
    doubt = horizon_doubt(frame, (float(ra_deg), float(dec_deg)))
    return replace(match, notes=(*match.notes, doubt)) if doubt else match, stars


def _aim_of_catalogue(
    request: FrameRequest, own_hints: Sequence[Hint], progress: Progress, given: Catalogue | None
) -> Aim | None:
    """The middle of a catalogue of a small field at the scales of the hints; None for other catalogues."""
    scales = next((hint.scale_arcsec for hint in own_hints if not isinstance(hint, ApproximateWcs)), None)
    if scales is None or request.catalogue.lower() in (BRIGHT, GAIA) or Path(request.catalogue).is_dir():
        return None
    return aim_of_catalogue(
        AllSky(scales), _cached_catalogue(_key(request, None), progress) if given is None else given
    )


def _solved_elsewhere(solved: _Solver, aim: Aim, refusal: InputError) -> tuple[FrameIdentification, Catalogue]:
    """The solution about the middle of the catalogue, where the header's directions have none; else that refusal."""
    try:
        match, stars = solved([aim])
    except InputError:
        raise refusal from None
    text = "doubt: the header points elsewhere; the frame was found about the middle of the catalogue"
    return replace(match, notes=(*match.notes, text)), stars


_Solver = Callable[[Sequence[Hint]], tuple[FrameIdentification, Catalogue]]


def _solved_at_some_scale(
    solved: partial[tuple[FrameIdentification, Catalogue]],
    request: FrameRequest,
    frame: Frame,
    own_hints: Sequence[Hint],
) -> tuple[FrameIdentification, Catalogue]:
    """The solution at the scale of the hints, or, if that is the header's, at one up to four times as large or small,
    with a doubt.

    All scales are searched with the patterns of the brightest stars, a second each, before the first is searched with
    the others, which takes many seconds where it is wrong.
    """
    scale, others = at_other_scales(request.pointing, own_hints)
    if not others:
        return _first_solved(solved, request, frame, own_hints)
    for aim_lists, aims in ((BRIGHTEST_PATTERNS, others), (FURTHER_PATTERNS, others[:2])):
        search = partial(solved, aim_lists=aim_lists)
        try:
            return _first_solved(search, request, frame, own_hints)
        except NoSolution as error:
            refusal = error
        for aim in aims:
            with suppress(InputError):  # also too few stars in a smaller field
                match, stars = search([aim])
                times = match.placement.scale_arcsec / scale
                text = (
                    f"doubt: the pixels are {times:.2g} times as large as the header says: does it leave out their "
                    "binning, or a lens?"
                )
                return replace(match, notes=(*match.notes, text)), stars
    scales = (
        "a quarter to 4 times this scale were tried, too, with the brightest stars, and with more near twice and half"
    )
    raise NoSolution(Message(refusal.words, f"; {scales}"), source=refusal.source)


def _first_solved(
    solved: _Solver, request: FrameRequest, frame: Frame, own_hints: Sequence[Hint]
) -> tuple[FrameIdentification, Catalogue]:
    """The solution by the first field of hints that has one; refused with the words of all."""
    refusals: list[InputError] = []
    for near in hints_by_field(own_hints, frame.shape):
        try:
            return solved(near)
        except InputError as error:
            refusals.append(error)
    elsewhere = header_elsewhere(request.pointing, own_hints, frame)
    if len(refusals) == 1 and not elsewhere:
        raise refusals[0]
    words = [part for error in refusals for part in ("; ", error.words)][1:] + (["; ", elsewhere] if elsewhere else [])
    kind = NoSolution if all(isinstance(error, NoSolution) for error in refusals) else InputError
    raise kind(Message(*words), source=refusals[0].source) from refusals[0]


def _solved(
    request: FrameRequest,
    frame: Frame,
    measured: Measurements,
    near: Sequence[Hint],
    *,
    progress: Progress,
    given: Catalogue | None,
    aim_lists: AimLists = AIM_LISTS,
) -> tuple[FrameIdentification, Catalogue]:
    """The frame identified by the hints on one field, and the catalogue of this field."""
    cone = search_cone(near, frame.shape)
    progress("reading the catalogue")
    stars = _cached_catalogue(_key(request, cone), progress) if given is None else given
    moment = frame.facts.mid_time
    moves = stars.epoch_jyr is not None and stars.has_motion
    epoch = None if moment is None else float(moment.tdb.jyear)
    all_sky = next((hint for hint in near if isinstance(hint, AllSky)), None)
    progress("identifying" if all_sky is None else "searching the whole sky")
    match = solve(
        measured,
        stars,
        near,
        epoch_jyr=epoch,
        refinement=Refinement(order=request.order, magnitudes=request.magnitudes),
        index=None if all_sky is None or given else _index(_key(request, cone), epoch, frame.shape, all_sky),
        motion=request.motion and not (moves and moment is None),
        faintest=request.faintest,
        aim_lists=aim_lists,
    )
    if moves and moment is None and request.motion:
        text = (
            "doubt: the header has no time of the exposure (DATE-OBS, MJD-OBS, JD), so the stars were left at "
            f"epoch {stars.epoch_jyr:.1f}; "
        )
        match = replace(match, notes=(*match.notes, Message(text, naming("give {time:DATE}"))))
    return match, stars


def _write(
    request: FrameRequest, frame: Frame, match: FrameIdentification, outcome: dict[str, Any], facts: dict[str, Any]
) -> None:
    paths = request.outputs()
    rows = listing(match)
    if outcome["epoch_jyr"] is not None:
        rows.meta["REFEPOCH"] = outcome["epoch_jyr"]
    write_table(rows, paths["table"], provenance=_provenance(outcome))
    write_solution(match.plate, paths["solution"])
    radius = 2.0 * match.measured.psf_fwhm_px * outcome["place"]["scale_arcsec_per_px"]
    write_regions(rows, paths["regions"], radius_arcsec=radius)
    if "copy" in paths:
        write_copy(match.plate, request.path, paths["copy"])
    if "page" in paths:
        from sameas.pages.frame import write_frame_page

        write_frame_page(match, frame, paths["page"], facts, request.brightest)
    if "picture" in paths:
        from sameas.plots.frame import picture, quality
        from sameas.plots.sheet import save

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            save(picture(match, frame, brightest=request.brightest), paths["picture"])
            save(quality(match), paths["quality"])


def _provenance(outcome: Mapping[str, Any]) -> dict[str, Any]:
    """The provenance of the table, from the summary."""
    named = ("program", "version", "digest", "file", "frame", "catalogue", "epoch_jyr")
    return {**{key: outcome[key] for key in named if key in outcome}, "summary": json.dumps(outcome, ensure_ascii=True)}


def provenance_of(request: FrameRequest, facts: Mapping[str, Any]) -> dict[str, Any]:
    """The provenance of a table written from Python. facts : the summary."""
    return _provenance({**program(), "file": request.path, **facts})


# ---- caches, shared by the frames of one process ----


@lru_cache(maxsize=4)
def _calibration(biases: tuple[str, ...], darks: tuple[str, ...], flats: tuple[str, ...]) -> MasterFrames:
    return MasterFrames.of(
        biases=[read(path) for path in biases],
        darks=[read(path) for path in darks],
        flats=[read(path) for path in flats],
    )


_Key = tuple[str, str, Cone | None, float | None]


def _key(request: FrameRequest, cone: Cone | None) -> _Key:
    """The cache key of a catalogue; it has the field only for catalogues that are read by field."""
    by_field = request.catalogue.lower() == GAIA or Path(request.catalogue).is_dir()
    columns = json.dumps(dict(request.columns), sort_keys=True)
    return request.catalogue, columns, cone if by_field else None, request.faintest


_catalogues: dict[_Key, Catalogue] = {}


def _cached_catalogue(key: _Key, progress: Progress = lambda stage: None) -> Catalogue:
    if key not in _catalogues:
        name, columns, cone, faintest = key
        while len(_catalogues) >= 4:
            _catalogues.pop(next(iter(_catalogues)))
        options = CatalogueOptions(**json.loads(columns))
        _catalogues[key] = catalogue(name, cone, options, faintest=faintest, progress=progress)
    return _catalogues[key]


@lru_cache(maxsize=2)
def _index(key: _Key, epoch_jyr: float | None, shape: tuple[int, int], hint: AllSky) -> SkyIndex:
    # Within a year proper motions do not change the star patterns.
    stars = StarField.of(_cached_catalogue(key), epoch_jyr, motion=epoch_jyr is not None)
    return sky_index(stars.stars(), shape, hint)


def _stamp(path: str) -> tuple[int, int]:
    try:
        info = Path(path).stat()
    except OSError:
        raise InputError(f"{path}: no such file") from None
    return info.st_size, info.st_mtime_ns


@lru_cache(maxsize=256)
def _checksum(path: str, stamp: tuple[int, int]) -> str:
    """The checksum of a file. stamp : its size and time, so that a changed file is read again."""
    return checksum(path)


def _catalogue_digest(name: str) -> str:
    path = Path(name)
    if path.is_dir():
        parts = sorted((str(p.relative_to(path)), *_stamp(str(p))) for p in path.rglob("*.parquet"))
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    return name.lower() if name.lower() in (BRIGHT, GAIA) else _checksum(name, _stamp(name))
