"""Fuzz targets among the files that sameas writes and reads again: tables, states, partitions."""

from __future__ import annotations

import atexit
import contextlib
import copy
import io
import pickle
import shutil
import sqlite3
import tempfile
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np


def _ran(*arguments: str) -> None:
    """A command, done here."""
    from sameas.cli.app import app

    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        app([*arguments, "--quiet"], standalone_mode=False)


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def _written(path: Path) -> bytes:
    """The content of an output, with the random name of its folder replaced, so that it is the same in every run."""
    name = path.resolve().parent.name
    return path.read_bytes().replace(name.encode(), b"x" * len(name))


def _field(folder: Path, k: int) -> Path:
    """A catalogue of twenty stars; the same ones for every k."""
    from astropy.table import Table

    from sameas.io import write_table

    truth, own = np.random.default_rng(1), np.random.default_rng(2 + k)
    ra, dec = truth.uniform(10.0, 10.02, 20), truth.uniform(-0.01, 0.01, 20)
    stars = Table({"id": [f"s{i}" for i in range(20)], "ra": ra + own.normal(0.0, 3e-5, 20), "dec": dec,
                   "sigma": np.full(20, 0.1), "mag": truth.uniform(9.0, 18.0, 20)})[:-1 - k]  # fmt: skip
    for name, unit in {"ra": "deg", "dec": "deg", "sigma": "arcsec"}.items():
        stars[name].unit = unit
    write_table(stars, folder / f"c{k}.fits", provenance={})
    return folder / f"c{k}.fits"


@cache
def tables(ending: str) -> tuple[bytes, ...]:
    """Of a match, and of many."""
    with _folder() as folder:
        a, b, c = (str(_field(folder, k)) for k in range(3))
        out = folder / f"out{ending}"
        contents = []
        for given in (("match", a, b, "--join", "1or2"), ("many", a, b, c)):
            _ran(*given, "-o", str(out))
            contents.append(_written(out))
        return tuple(contents)


@cache
def framed() -> bytes:
    """Of a frame."""
    from astropy.io import fits
    from astropy.table import Table
    from astropy.wcs import WCS

    from sameas.io import read_provenance, read_table, write_table

    rng = np.random.default_rng(4)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [150.0, 20.0], [64.0, 64.0]
    wcs.wcs.cd = np.diag([-1.0, 1.0]) / 3600.0
    x, y, flux = rng.uniform(8.0, 120.0, 25), rng.uniform(8.0, 120.0, 25), 10.0 ** rng.uniform(3.5, 4.6, 25)
    rows, columns = np.mgrid[:128, :128]
    image = rng.normal(500.0, 7.0, (128, 128))
    for x0, y0, f in zip(x, y, flux, strict=True):
        image += f / (2 * np.pi * 1.5**2) * np.exp(-((columns - x0) ** 2 + (rows - y0) ** 2) / (2 * 1.5**2))
    header = wcs.to_header()
    header["EXPTIME"], header["DATE-OBS"], header["GAIN"] = 30.0, "2016-01-01T00:00:00", 1.0
    ra, dec = wcs.all_pix2world(x, y, 0)
    stars = Table({"id": np.arange(25), "ra": ra, "dec": dec, "mag": 25.0 - 2.5 * np.log10(flux)})
    stars["ra"].unit = stars["dec"].unit = "deg"
    with _folder() as folder:
        fits.PrimaryHDU(image.astype("f4"), header).writeto(folder / "f.fits")
        write_table(stars, folder / "stars.fits", provenance={})
        _ran("frame", str(folder / "f.fits"), "--catalog", str(folder / "stars.fits"), "--sigma", "0.02",
             "--no-picture", "-o", str(folder / "out"))  # fmt: skip
        write_table(read_table(folder / "out" / "f.stars.fits"), folder / "f.ecsv",
                    provenance=read_provenance(folder / "out" / "f.stars.fits"))  # fmt: skip
        return _written(folder / "f.ecsv")


class Cached:
    """A function with a cache of its latest 12 answers.

    One target reads a file several times, and one of two compared files is the same for all inputs: with each content
    read once, several times as many inputs are tested in the same time. key : what the answer depends on; None where
    that is not known. copied : makes a copy of an answer that its caller may change.
    """

    def __init__(
        self, function: Callable[..., Any], key: Callable[..., object], copied: Callable[[Any], Any] | None = None
    ) -> None:
        self.function, self.key, self.copied = function, key, copied
        self.cache = dict[object, tuple[Any, Exception | None]]()

    def __call__(self, *given: Any, **named: Any) -> Any:
        key = self.key(*given, **named)
        if key is None:
            return self.function(*given, **named)
        answer, error = self.cache.pop(key, (None, None)) if key in self.cache else self._called(*given, **named)
        while len(self.cache) >= 12:
            del self.cache[next(iter(self.cache))]
        self.cache[key] = (answer, error)  # the latest answers are kept longest
        if error is not None:
            raise error.with_traceback(None)
        return answer if self.copied is None else self.copied(answer)

    def _called(self, *given: Any, **named: Any) -> tuple[Any, Exception | None]:
        try:
            return self.function(*given, **named), None
        except Exception as error:
            return None, error


def _content(path: Any, **_: Any) -> object:
    """The name and content of a file, and the content of its provenance file."""
    provenance = Path(f"{path}.provenance.json")
    if not Path(path).is_file():
        return None
    return str(path), Path(path).read_bytes(), provenance.read_bytes() if provenance.is_file() else b""


def _pickled(*given: Any, **_: Any) -> object:
    with contextlib.suppress(Exception):
        return pickle.dumps(given)
    return None


def _header(lines: Any) -> object:
    return "\n".join(lines)


@cache
def _cached_functions() -> tuple[tuple[str, Cached], ...]:
    """The cached functions by their import paths."""
    from astropy.table import meta

    import sameas.io
    from sameas.sky import crossmatch

    return (
        ("sameas.io.read_table", Cached(sameas.io.read_table, _content)),
        ("sameas.io.read_provenance", Cached(sameas.io.read_provenance, _content, copy.deepcopy)),
        ("sameas.sky.crossmatch.match", Cached(crossmatch.match, _pickled)),
        ("astropy.table.meta.get_header_from_yaml", Cached(meta.get_header_from_yaml, _header, copy.deepcopy)),
    )


@contextlib.contextmanager
def _once() -> Iterator[None]:
    """Within it, the same content is read once, and the same catalogues are matched once."""
    with contextlib.ExitStack() as stack:
        for path, function in _cached_functions():
            stack.enter_context(mock.patch(path, function))
        yield


def _answers(questions) -> list[str]:
    """The answers in words; a question may be refused, but not all of them."""
    from sameas.errors import InputError

    answers, refused = [], None
    with _once():
        for question in questions:
            try:
                answers.append(str(question()))
            except InputError as error:
                refused = error
    if refused is not None and not answers:
        raise refused
    return answers


def explain_table(path: Path) -> object:
    """Run ``explain`` and ``compare`` on a table."""
    import sameas

    whole = path.with_name(f"whole{path.name.removeprefix('input')}")
    if not whole.exists():
        whole.write_bytes(tables(path.suffix)[0])
    questions = (
        lambda: sameas.explain(path, "s3"), lambda: sameas.compare(path, whole),
        lambda: sameas.explain(path, "s4", source=2), lambda: sameas.compare(whole, path),
        lambda: sameas.explain(path, row=1),
    )  # fmt: skip
    first = zlib.crc32(path.read_bytes()) % 4 if path.suffix != ".csv" else 0
    return _answers(questions[first : first + 2])


#: Folder of the catalogues in the provenance, replaced by the real one.
_ELSEWHERE = b"/of/the/match"


@cache
def match_and_provenance() -> tuple[bytes, bytes, bytes]:
    """A match as CSV, its provenance file, and the folder of its catalogues, which is kept."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    a, b = (str(_field(folder, k)) for k in range(2))
    _ran("match", a, b, "-o", str(folder / "out.csv"))
    place, facts = str(folder.resolve()).encode(), (folder / "out.csv.provenance.json").read_bytes()
    return (folder / "out.csv").read_bytes(), facts.replace(place, _ELSEWHERE), place


def explain_with_provenance(path: Path) -> object:
    """Run ``explain`` and ``compare`` on a table with changed provenance; its catalogues are matched again."""
    whole = path.with_name("input.csv")
    if not whole.exists():
        whole.write_bytes(match_and_provenance()[0])
    facts = path.read_bytes().replace(_ELSEWHERE, match_and_provenance()[2])
    path.with_name("input.csv.provenance.json").write_bytes(facts)
    return explain_table(whole)


@cache
def picture() -> dict[str, bytes]:
    """The tables of a picture."""
    with _folder() as folder:
        paths = []
        for name, key in (("ais", "mmsi"), ("radar", "track_id")):
            lines = [f"time,lat,lon,sog,cog,sigma,{key}"]
            lines += [f"{1.7e9 + t},{50.0 + 0.01 * k + 1e-5 * t:.6f},{-1.0 - 0.01 * k:.6f},3,0,15,{235000000 + k}"
                      for t in range(0, 60, 10) for k in range(3)]  # fmt: skip
            paths.append(folder / f"{name}.csv")
            paths[-1].write_text("\n".join(lines) + "\n")
        _ran("picture", *map(str, paths), "--no-image", "--every", "30s", "--format", "csv", "-o", str(folder / "out"))
        return {path.name: path.read_bytes() for path in sorted((folder / "out").glob("*.csv"))}


def explain_picture(path: Path) -> object:
    import sameas

    content, folder = path.read_bytes(), path.with_suffix("")
    whole = folder.with_name("whole")
    for place in (folder, whole):
        place.mkdir(exist_ok=True)
        for name, own in picture().items():
            (place / name).write_bytes(own)
    name = "identities.csv" if b"p_alone" in content.partition(b"\n")[0] else "objects.csv"
    (folder / name).write_bytes(content)
    questions = (
        lambda: sameas.explain(folder, "1"), lambda: sameas.explain(folder, "235000001", source="ais"),
        lambda: sameas.compare(folder, whole),
    )  # fmt: skip
    return _answers(questions)


@cache
def kept() -> dict[str, bytes]:
    """The files of a watch."""
    from sameas.live.keeper import Keeper

    with _folder() as folder:
        keeper = Keeper(_harbour(), folder, replay=_replay())
        for t in range(0, 40, 10):
            keeper.tick(1.7e9 + t)
        keeper.close()
        base = sqlite3.connect(folder / "journal.sqlite")
        base.execute("PRAGMA journal_mode=DELETE")
        base.close()
        return {name: (folder / name).read_bytes() for name in ("state.pickle", "journal.sqlite")}


def _harbour() -> Any:
    from sameas.live.settings import LiveSource, Settings, WatchSettings
    from sameas.tracks import Description
    from sameas.tracks.source import SensorErrors

    sources = {"ais": Description("ais", "ais", errors=SensorErrors(position_m=10.0)),
               "radar": Description("radar", "tracks", errors=SensorErrors(position_m=10.0))}  # fmt: skip
    plane = {"lat_deg": 50.0, "lon_deg": -1.0}
    return Settings({name: LiveSource(one) for name, one in sources.items()}, WatchSettings(plane=plane))


def _replay() -> Any:
    from sameas.live.replay import Replay
    from sameas.tracks.reports import Reports

    place = {"time_s": [1.7e9 + t for t in range(0, 60, 10) for _ in range(3)], "lat_deg": [50.0, 50.01, 50.02] * 6,
             "lon_deg": [-1.0, -1.01, -1.02] * 6}  # fmt: skip
    keys = {"ais": "mmsi", "radar": "track_id"}
    return Replay([(name, Reports.of(name, "table", place | {key: ["235000001", "2", "3"] * 6}))
                   for name, key in keys.items()])  # fmt: skip


#: The next instant of a watch that goes on.
_NEXT_S = 1.7e9 + 40


@cache
def _next() -> Any:
    """The picture after the next tick of a watch with unchanged files."""
    from sameas.live.keeper import Keeper
    from sameas.picture.live import LivePicture

    states, advance = [], LivePicture.advance

    def noted(*given: Any) -> Any:
        states.append(advance(*given))
        return states[-1]

    with _folder() as folder:
        for name, own in kept().items():
            (folder / name).write_bytes(own)
        keeper = Keeper(_harbour(), folder, replay=_replay())
        with mock.patch.object(LivePicture, "advance", noted):
            keeper.tick(_NEXT_S)
        keeper.close()
    return states[0]


@contextlib.contextmanager
def _advanced(path: Path) -> Iterator[None]:
    """Within it, a watch with a changed journal uses the known next picture, which depends on the state only."""
    from sameas.live.reception import Reception
    from sameas.picture.live import LivePicture

    with contextlib.ExitStack() as stack:
        if path.suffix == ".sqlite":
            picture = _next()
            stack.enter_context(mock.patch.object(LivePicture, "advance", lambda *_: picture))
            stack.enter_context(mock.patch.object(Reception, "take", lambda *_: None))
        yield


def continue_watch(path: Path) -> object:
    """A watch that goes on where another was; what a tick cannot do is an alarm of it."""
    from sameas.live.keeper import Keeper

    content, folder = path.read_bytes(), path.with_suffix("")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, own in kept().items():
        (folder / name).write_bytes(own)
    (folder / ("journal.sqlite" if path.suffix == ".sqlite" else "state.pickle")).write_bytes(content)
    keeper = Keeper(_harbour(), folder, replay=_replay())
    with _advanced(path):
        try:
            frame = keeper.tick(_NEXT_S)
        finally:
            keeper.close()
    return frame


@cache
def partition_run() -> dict[str, bytes]:
    """The files of a catalogue in partitions."""
    from astropy.table import Table

    from sameas.partitions.hats import write_hats

    rng = np.random.default_rng(9)
    stars = Table({"id": np.arange(60), "ra": rng.uniform(40.0, 41.0, 60), "dec": rng.uniform(10.0, 11.0, 60)})
    with _folder() as folder:
        write_hats(stars, folder / "cat", max_rows=30)
        return {str(path.relative_to(folder / "cat")): path.read_bytes()
                for path in sorted((folder / "cat").rglob("*")) if path.is_file()}  # fmt: skip


def partition_seeds() -> list[bytes]:
    """One file of each kind."""
    each = {Path(name).suffix + Path(name).name[:4]: content for name, content in partition_run().items()}
    return list(each.values())


def finish_partitions(path: Path) -> object:
    """A catalogue of which one file is changed, or two parts are the same."""
    from sameas.partitions.hats import HatsCatalogue

    content, folder = path.read_bytes(), path.with_suffix("")
    shutil.rmtree(folder, ignore_errors=True)
    for name, own in partition_run().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(own)
    begins = {own[:12]: name for name, own in partition_run().items() if not name.startswith("_")}
    place = next((name for begin, name in begins.items() if content[:6] == begin[:6]), "hats.properties")
    (folder / place).write_bytes(content)
    catalogue = HatsCatalogue.open(folder)
    whole = np.array([[0, 12 << 58]], np.int64)
    return catalogue.partition_rows, catalogue.rows(whole), catalogue.fingerprint()


SEEDS: dict[str, Callable[[], list[bytes]]] = {
    "table": lambda: [*tables(".ecsv"), framed()],
    "fits": lambda: list(tables(".fits")),
    "provenance": lambda: [match_and_provenance()[1]],
    "picture": lambda: list(picture().values()),
    "state": lambda: [kept()["state.pickle"]],
    "journal": lambda: [kept()["journal.sqlite"]],
    "partitions": partition_seeds,
}
