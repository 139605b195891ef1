"""Processes killed at random moments, full and read-only disks, two runs at once: is the output whole? And crowds.

Every command writes over an output of an earlier run and is then hit: by SIGKILL, SIGTERM or SIGINT at a moment drawn
over its run, every second time just after its draft has appeared. The output must be the old one or the new one, whole;
no draft may stay (after SIGKILL: none after the next run); the exit code must say what happened; nothing but one line
may be on stderr. The runs are forked from a process that has done the command once: to load modules takes longer than
the work, and is not what is to be hit. Loads that nobody foresaw are in ``loads.py``.
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.loads import tables
from benchmarks.tables import Table, report

COMMAND = [sys.executable, "-m", "sameas"]
CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: 143, signal.SIGINT: 130}
#: Seconds of the processor, and of the clock, after which a process that another has started is an orphan: a busy
#: machine does not let it end sooner.
ORPHANED_S, ORPHANED_CLOCK_S = 3.0, 60.0
ENDINGS = (".fits", ".vot", ".ecsv", ".csv", ".parquet")


@dataclass(frozen=True)
class Work:
    """One command: its name in the table, its arguments, those of the earlier run, and what it writes."""

    name: str
    arguments: tuple[str, ...]
    earlier: tuple[str, ...]
    output: Path
    #: What a stopped run may leave of both runs whatever the signal: parts, each whole, that the next run completes.
    resumes: bool = False
    #: Exit codes beside those of the signals.
    codes: tuple[int, ...] = (0,)
    #: Whether it starts processes, so that it is begun anew each time: forked, it would share those of the first.
    starts_others: bool = False

    @property
    def kind(self) -> str:
        """Its row in the table: those that differ in the format of their output share one."""
        return self.name.removesuffix(f" {self.output.suffix}")

    def command(self, earlier: bool = False) -> list[str]:
        return [*COMMAND, *(self.earlier if earlier else self.arguments), "-o", str(self.output), "--quiet"]

    def done(self, earlier: bool = False) -> dict[str, str]:
        """The files after a run that nothing disturbs."""
        done = subprocess.run(self.command(earlier), capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{self.name}: {done.stderr}")
        return self.files()

    def forked(self, server: Server | Begun, earlier: bool = False) -> tuple[int, str]:
        """Exit code and stderr of a run that nothing disturbs."""
        server.start(self.command(earlier))
        return server.ended()

    def files(self) -> dict[str, str]:
        """The files of the output by name, each as a digest."""
        folder, pattern = (self.output, "*") if self.output.is_dir() else (self.output.parent, f"{self.output.name}*")
        paths = sorted(folder.glob(pattern))
        return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in paths if not p.name.startswith(".sameas-")}

    def drafts(self) -> list[Path]:
        return list((self.output if self.output.is_dir() else self.output.parent).glob(".sameas-*"))

    def keep(self) -> dict[str, bytes]:
        """What the output holds, to be put back."""
        return {name: (_folder(self) / name).read_bytes() for name in self.files()}

    def restore(self, kept: dict[str, bytes]) -> None:
        """Put it back, and nothing else."""
        for name in set(self.files()) - set(kept):
            (_folder(self) / name).unlink()
        for name, content in kept.items():
            (_folder(self) / name).write_bytes(content)

    def fresh(self, what: str) -> Work:
        """The work into an output that may be written: this one, where an output is replaced."""
        return self

    @property
    def fills(self) -> bool:
        """Whether it writes files into a folder, not one file."""
        return not self.output.suffix

    def among_inputs(self, folder: Path) -> Work:
        """The work on copies of its inputs in a folder; it writes among them, or over the first of them."""
        every = self.inputs()
        copied = [path for path in every if Path(path).is_dir()] or every
        given = [folder / Path(path).name if Path(path).is_file() else folder for path in copied]
        folder.mkdir()
        for path in map(Path, copied):
            if path.is_dir():
                shutil.copytree(path, folder, dirs_exist_ok=True)
            else:
                shutil.copy(path, folder)
        instead = dict(zip(copied, map(str, given), strict=True))
        arguments = tuple(instead.get(argument, argument) for argument in self.arguments)
        return replace(self, arguments=arguments, output=folder if self.fills else given[0])

    def inputs(self) -> list[str]:
        """Those of its arguments that are files or folders."""
        return [argument for argument in self.arguments if os.path.isabs(argument) and os.path.exists(argument)]

    def part(self, name: str) -> str:
        """What part of the output a file belongs to, of which all files come at once."""
        return "" if not self.resumes else name.split(".")[0] if name[0] == "f" else "series"

    def verdict(self, now: dict[str, str], old: dict[str, str], new: dict[str, str], number: signal.Signals) -> str:
        """Whether the output is "old", "new", or of both runs where that may be; otherwise what is wrong with it."""
        if now in (old, new):
            return "old" if now == old else "new"
        whole = all(now.get(name) in (old.get(name), new.get(name)) for name in {*now, *old, *new})
        if whole and number == signal.SIGKILL:
            return "mixed"  # several files come one after the other
        if self.resumes and whole:
            names: dict[str, set[bool]] = {}
            for name in {*old, *new}:
                if old.get(name) != new.get(name):
                    names.setdefault(self.part(name), set()).add(now.get(name) == new.get(name))
            if all(len(which) == 1 for which in names.values()):
                return "mixed"
        return f"the output is neither: {sorted(now)}"


class Watch(Work):
    """A live picture: it is whole where its journal, its archive and its state can be read, and goes on."""

    def files(self) -> dict[str, str]:
        return {}

    def drafts(self) -> list[Path]:
        return list(self.output.rglob(".sameas-*"))

    def keep(self) -> dict[str, bytes]:
        return {}

    def restore(self, kept: dict[str, bytes]) -> None:
        """Every second run goes on where the last one was hit, the others begin anew."""
        if random.Random(len(list(self.output.rglob("*")))).random() < 0.5 and self.output.exists():
            shutil.rmtree(self.output)

    def verdict(self, now: dict[str, str], old: dict[str, str], new: dict[str, str], number: signal.Signals) -> str:
        from pyarrow import parquet

        from sameas.live.journal import load_state

        if not (self.output / "journal.sqlite").exists():
            return "old"
        try:
            with closing(sqlite3.connect(self.output / "journal.sqlite")) as base:
                if base.execute("PRAGMA integrity_check").fetchone() != ("ok",):
                    return "the journal is damaged"
                tables = {row[0] for row in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
                if tables >= {"identities", "objects"}:
                    lost = base.execute(
                        "SELECT COUNT(*) FROM identities WHERE object NOT IN (SELECT object FROM objects)"
                    )
                    if lost.fetchone() != (0,):
                        return "the journal has identities of no object"
            for path in (self.output / "archive").glob("objects-*.parquet"):
                parquet.read_table(path)
            state = load_state(self.output)
        except Exception as error:
            return f"cannot be read: {error}"
        return "old" if state is None else "new"


class Hats(Work):
    """Partitions: what is there is a part of the new output, and the next run completes it to the same bytes."""

    def files(self) -> dict[str, str]:
        paths = sorted(path for path in self.output.rglob("*") if path.is_file())
        inside = [path for path in paths if not path.relative_to(self.output).as_posix().startswith(".sameas-run")]
        return {str(p.relative_to(self.output)): hashlib.sha256(p.read_bytes()).hexdigest()
                for p in inside if not p.name.endswith(".part")}  # fmt: skip

    def drafts(self) -> list[Path]:
        """Those after a run that ended well; while a run can be resumed, the next one removes them."""
        if not (self.output / "collection.properties").exists():
            return []
        try:
            return [path for path in self.output.rglob("*") if path.suffix == ".part" or path.name == ".sameas-run"]
        except FileNotFoundError:  # a folder that is being removed
            return []

    def keep(self) -> dict[str, bytes]:
        return {}

    def restore(self, kept: dict[str, bytes]) -> None:
        shutil.rmtree(self.output, ignore_errors=True)

    def forked(self, server: Server | Begun, earlier: bool = False) -> tuple[int, str]:
        """A run that nothing disturbs, of what is there; none where it is whole, which is refused to be replaced."""
        if earlier:
            self.restore({})
        if earlier or (self.output / "collection.properties").exists():
            return 0, ""
        return super().forked(server)

    def fresh(self, what: str) -> Work:
        return replace(self, output=self.output.with_name(what.replace(" ", "-")))

    def among_inputs(self, folder: Path) -> Work:
        """It is to write into a folder that is full of something else, as its inputs are."""
        shutil.copytree(self.inputs()[0], folder)
        return replace(self, output=folder)

    def verdict(self, now: dict[str, str], old: dict[str, str], new: dict[str, str], number: signal.Signals) -> str:
        if now == new:
            return "new"
        if (self.output / "collection.properties").exists():
            return "is called whole, and is not"
        changed = [name for name, digest in now.items() if name in new and new[name] != digest]
        return f"{changed} are not those of a whole run" if changed else "mixed" if now else "old"


class Begun:
    """Runs that start others: each is begun anew in a session of its own, in which nobody may stay."""

    def __init__(self, work: Work) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.heard = tempfile.TemporaryFile()  # noqa: SIM115 (a worker that stays would hold a pipe open)

    def start(self, command: list[str]) -> int:
        """Begin a run; the number of its process."""
        self.heard.seek(0)
        self.heard.truncate()
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=self.heard, start_new_session=True,
                                        preexec_fn=_interruptible)  # fmt: skip
        return self.process.pid

    def ended(self) -> tuple[int, str]:
        """Exit code and stderr of the run, when it has ended."""
        assert self.process is not None
        code = self.process.wait()
        self.heard.seek(0)
        return code, self.heard.read().decode(errors="replace")

    def orphans(self) -> list[str]:
        """The commands of its session that are still there some seconds after it has ended; they are ended now."""
        assert self.process is not None
        latest = _seconds_of(_members(self.process.pid)) + ORPHANED_S
        _until(lambda: not 0.0 < _seconds_of(_members(self.process.pid)) < latest, ORPHANED_CLOCK_S)
        left = [(number, Path(f"/proc/{number}/cmdline").read_bytes()) for number in _members(self.process.pid)]
        for number, _ in left:
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        return [words.replace(b"\0", b" ").decode(errors="replace")[:80] for _, words in left]

    def close(self) -> None:
        self.heard.close()


class Server:
    """A process that has done a command once, and from which others of the same kind are forked."""

    def __init__(self, work: Work) -> None:
        begun = [sys.executable, "-m", "benchmarks.faults", "--serve", *work.command()[3:]]
        self.process = subprocess.Popen(begun, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
                                        preexec_fn=_interruptible)  # fmt: skip
        self._heard("ready")

    def start(self, command: list[str]) -> int:
        """Fork a run of a command; the number of its process."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command[3:]) + "\n")
        return int(self._heard("begun"))

    def ended(self) -> tuple[int, str]:
        """Exit code and stderr of the run, when it has ended."""
        code, said = json.loads(self._heard("ended"))
        return code, said

    def orphans(self) -> list[str]:
        """It starts none."""
        return []

    def close(self) -> None:
        self.process.communicate()

    def _heard(self, what: str) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line.startswith(what):
            raise RuntimeError(f"{what}: {line!r}")
        return line[len(what) :]


def serve(arguments: list[str]) -> None:
    """Do a command, then fork those of the lines of stdin; say of each its process, its exit code and its stderr."""
    from sameas.cli import main as command
    from sameas.cli.app import app

    told = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    app(arguments, standalone_mode=False)
    told.write("ready\n")
    with tempfile.TemporaryFile() as heard:
        for line in sys.stdin:
            heard.truncate(0)
            child = os.fork()
            if not child:
                os.dup2(heard.fileno(), 2)
                sys.argv = ["sameas", *json.loads(line)]
                try:
                    command()
                except SystemExit as error:
                    sys.stderr.flush()
                    os._exit(error.code if isinstance(error.code, int) else 0)
                except BaseException:
                    traceback.print_exc()
                    sys.stderr.flush()
                    os._exit(99)
                os._exit(0)
            told.write(f"begun {child}\n")
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            heard.seek(0)
            told.write(f"ended {json.dumps([code, heard.read().decode(errors='replace')])}\n")
            heard.seek(0)


@dataclass
class Count:
    """What became of the runs of one row."""

    runs: int = 0
    old: int = 0
    new: int = 0
    mixed: int = 0
    #: Until the process had ended that was asked to, in seconds.
    slowest_s: float = 0.0
    faults: list[str] = field(default_factory=list)

    def row(self, name: str) -> list[object]:
        return [name, self.runs, self.old, self.new, self.mixed, round(self.slowest_s, 2), len(self.faults)]

    def include(self, more: Count) -> None:
        """Add other runs."""
        self.runs, self.old, self.new = self.runs + more.runs, self.old + more.old, self.new + more.new
        self.mixed, self.slowest_s = self.mixed + more.mixed, max(self.slowest_s, more.slowest_s)
        self.faults += more.faults


def catalogues(folder: Path, count: int = 3, n: int = 400) -> list[Path]:
    """Catalogues of one field."""
    from astropy.table import Table as Stars

    from sameas.io import write_table

    truth = np.random.default_rng(1)
    ra, dec, mag = truth.uniform(10.0, 10.4, n), truth.uniform(-0.2, 0.2, n), truth.uniform(9.0, 18.0, n)
    paths = []
    for k in range(count):
        noise = np.random.default_rng(2 + k).normal(0.0, 0.1 / 3600.0, (2, n))
        table = Stars({"name": [f"s{i}" for i in range(n)], "ra": ra + noise[0], "dec": dec + noise[1],
                       "sigma": np.full(n, 0.1), "mag": mag})  # fmt: skip
        table["ra"].unit = table["dec"].unit = "deg"
        table["sigma"].unit = "arcsec"
        paths.append(folder / f"c{k}.fits")
        write_table(table, paths[-1], provenance={})
    return paths


def frame(folder: Path) -> tuple[Path, Path]:
    """A frame of stars with a plate solution in its header, and their catalogue."""
    from astropy.io import fits
    from astropy.table import Table as Stars
    from astropy.wcs import WCS

    from sameas.io import write_table

    rng = np.random.default_rng(4)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [150.0, 20.0], [128.0, 128.0]
    wcs.wcs.cd = np.diag([-1.0, 1.0]) / 3600.0
    x, y, flux = rng.uniform(8.0, 248.0, 60), rng.uniform(8.0, 248.0, 60), 10.0 ** rng.uniform(3.2, 4.6, 60)
    rows, columns = np.mgrid[:256, :256]
    image = rng.normal(500.0, 7.0, (256, 256))
    for x0, y0, f in zip(x, y, flux, strict=True):
        image += f / (2 * np.pi * 1.5**2) * np.exp(-((columns - x0) ** 2 + (rows - y0) ** 2) / (2 * 1.5**2))
    header = wcs.to_header()
    header["EXPTIME"], header["DATE-OBS"], header["GAIN"] = 30.0, "2016-01-01T00:00:00", 1.0
    path, stars = folder / "frame.fits", folder / "stars.fits"
    fits.PrimaryHDU(image.astype("f4"), header).writeto(path, overwrite=True)
    ra, dec = wcs.all_pix2world(x, y, 0)
    table = Stars({"id": np.arange(60), "ra": ra, "dec": dec, "mag": 25.0 - 2.5 * np.log10(flux)})
    table["sigma"] = np.full(60, 0.02)
    table["ra"].unit = table["dec"].unit = "deg"
    table["sigma"].unit = "arcsec"
    write_table(table, stars, provenance={})
    return path, stars


def sensors(folder: Path) -> list[str]:
    """AIS and a radar of the same ten ships."""
    rng = np.random.default_rng(6)
    lat, lon = rng.uniform(50.0, 50.1, 10), rng.uniform(-1.1, -1.0, 10)
    paths = []
    for name in ("ais", "radar"):
        lines = ["time,lat,lon,sog,cog,sigma," + ("mmsi" if name == "ais" else "track_id")]
        for t in range(0, 60, 5):
            for k in range(10):
                where = [lat[k] + 1e-5 * t + rng.normal(0, 1e-4), lon[k] + rng.normal(0, 1e-4)]
                lines.append(f"{1.7e9 + t},{where[0]:.6f},{where[1]:.6f},3,0,15,{235000000 + k}")
        paths.append(folder / f"{name}.csv")
        paths[-1].write_text("\n".join(lines) + "\n")
    return [str(path) for path in paths]


def night(folder: Path) -> Path:
    """Detections of forty movers on eight exposures, among as many that are none."""
    rng = np.random.default_rng(8)
    x, way = rng.uniform(-0.1, 0.1, (2, 40)), rng.uniform(0.0, 6.28, 40)
    path = folder / "night.csv"
    lines = ["ra,dec,mjd,mag"]
    for k in range(8):
        day = k / 100.0
        ra, dec = 150.0 + x[0] + 0.2 * day * np.cos(way), x[1] + 0.2 * day * np.sin(way)
        noise = rng.normal(0.0, 0.2 / 3600.0, (2, 40))
        chance = rng.uniform(-0.1, 0.1, (40, 2)) + np.array([150.0, 0.0])
        rows = [*zip(ra + noise[0], dec + noise[1], strict=True), *chance]
        lines += [f"{a:.7f},{b:.7f},{60000 + day:.5f},{rng.uniform(17, 20):.2f}" for a, b in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


def nights(folder: Path, image: Path) -> Path:
    """A folder of three frames of one field."""
    from astropy.io import fits

    night_folder = folder / "frames"
    night_folder.mkdir()
    with fits.open(image) as hdus:
        for k in range(3):
            noise = np.random.default_rng(k).normal(0.0, 7.0, hdus[0].data.shape)
            rows, columns = np.mgrid[:256, :256]
            noise += 900.0 * np.exp(-((columns - 100.3 - 9.0 * k) ** 2 + (rows - 91.4 - 7.0 * k) ** 2) / (2 * 1.5**2))
            header = hdus[0].header.copy()
            header["DATE-OBS"] = f"2016-01-01T00:{10 * k:02d}:00"
            fits.PrimaryHDU((hdus[0].data + noise).astype("f4"), header).writeto(night_folder / f"f{k}.fits")
    return night_folder


def partitioned(folder: Path) -> tuple[str, str]:
    """Two HATS catalogues of one field."""
    from astropy.table import Table as Stars

    from sameas.partitions.output import write_hats

    rng = np.random.default_rng(9)
    ra, dec = rng.uniform(40.0, 40.6, 3000), rng.uniform(10.0, 10.6, 3000)
    for name in ("one", "two"):
        moved = dec + rng.normal(0.0, 0.1 / 3600.0, 3000)
        write_hats(Stars({"id": np.arange(3000), "ra": ra, "dec": moved}), folder / name, most_rows=400)
    return str(folder / "one"), str(folder / "two")


def works(folder: Path, endings: tuple[str, ...] = ENDINGS) -> list[Work]:
    """The commands, and every format of tables."""
    a, b, c = map(str, catalogues(folder))
    image, stars = map(str, frame(folder))

    def output(name: str) -> Path:
        (folder / name).mkdir()
        return folder / name / "out"

    made = [Work(f"match {e}", ("match", a, b), ("match", b, a), output(f"m{e[1:]}").with_suffix(e)) for e in endings]
    for e in endings:
        many = output(f"n{e[1:]}").with_suffix(e)
        made.append(Work(f"many {e}", ("many", a, b, c), ("many", c, b, a), many))
    shot = ("frame", image, "--catalog", stars, "--no-picture", "--again")
    made.append(Work("frame", shot, (*shot, "--threshold", "6"), output("frame")))
    for ending in (".csv", ".fits"):
        moved = ("movers", str(night(folder)), "--sigma", "0.2", "--least")
        made.append(
            Work(f"movers {ending}", (*moved, "3"), (*moved, "2"), output(f"v{ending[1:]}").with_suffix(ending))
        )
    many = str(nights(folder, Path(image)))
    frames, options = sorted(map(str, Path(many).iterdir())), ("--catalog", stars, "--processes")
    parts = partitioned(folder)
    for n, name in (("1", ""), ("2", ", 2 processes")):
        two = n == "2"
        shot = ("frame", many, *options, n, "--no-picture")
        series = output(f"series{n}")
        made.append(Work(f"series of frames{name}", shot, (*shot, "--threshold", "6"), series, True, starts_others=two))
        earlier, moved = ("movers", *frames[:2], *options, n), ("movers", *frames, *options, n)
        made.append(Work(f"movers on frames{name}", moved, earlier, output(f"moved{n}"), True, starts_others=two))
        parted = ("match", *parts, "--sigma", "0.1", "--workers", n)
        made.append(Hats(f"match, partitions{name}", parted, parted, output(f"hats{n}"), starts_others=two))
    seen = ("watch", *sensors(folder), "--no-map", "--pace", "60", "--every", "1s")
    made.append(Watch("watch", seen, seen, output("watch")))
    seen = ("picture", *sensors(folder), "--no-image", "--every")
    made.append(Work("picture", (*seen, "20s"), (*seen, "30s"), output("picture")))
    return made


def hit(work: Work, server: Server | Begun, number: signal.Signals, moments: int, rng: random.Random) -> Count:
    """Runs of a command, each hit once."""
    found = Count()
    for earlier in (True, False):
        began = time.monotonic()
        code, said = work.forked(server, earlier)
        longest = time.monotonic() - began
        if code:
            raise RuntimeError(f"{work.name}: {said}")
        if earlier:
            old, kept = work.files(), work.keep()
    new = work.files()
    if new and old == new:
        raise RuntimeError(f"{work.name}: two runs of different options write the same")
    for moment in range(moments):
        work.restore(kept)
        process = server.start(work.command())
        if moment % 2:
            time.sleep(rng.uniform(0.0, 1.05) * longest)
        else:
            _until(partial(_ended_or_drafted, process, work))
            time.sleep(rng.choice((0.0, 1.0)) * rng.uniform(0.0, 0.1) * min(longest, 1.0))
        asked = time.monotonic()
        # A terminal tells all processes of Ctrl-C; who asks one to end, or kills it, mostly tells the first only.
        tell = os.killpg if work.starts_others and (number == signal.SIGINT) != (moment % 4 == 3) else os.kill
        with suppress(ProcessLookupError):  # it has ended
            tell(process, number)
        code, said = server.ended()
        answer_s = time.monotonic() - asked
        found.slowest_s = max(found.slowest_s, answer_s)
        drafts = work.drafts()
        found.faults += [f"{work.name}, {number.name}: a process stayed: {words}" for words in server.orphans()]
        now = work.files()
        found.runs += 1
        which = work.verdict(now, old, new, number)
        if which in ("old", "new", "mixed"):
            setattr(found, which, getattr(found, which) + 1)
        else:
            found.faults.append(f"{work.name}, {number.name}: {which}")
        # In the first moments of a process nothing has been begun, and Python's own ends are as good.
        if code not in (*work.codes, CODES[number], -number) and not (code == 99 and "KeyboardInterrupt" in said):
            found.faults.append(f"{work.name}, {number.name}: exit code {code}: {said[-200:]}")
        if "terminate called" in said or (said.count("\n") > 1 and "KeyboardInterrupt" not in said):
            found.faults.append(f"{work.name}, {number.name}: says {said[-300:]!r}")
        if answer_s > 1.5:
            found.faults.append(f"{work.name}, {number.name}: answered after {answer_s:.1f} s")
        if number != signal.SIGKILL and (drafts or work.drafts()):
            found.faults.append(f"{work.name}, {number.name}: a draft stayed")
            for draft in work.drafts():
                _removed(draft)
    code, said = work.forked(server)
    if code or (work.files() != new):
        found.faults.append(f"{work.name}, {number.name}: the next run does not complete it: {code}: {said[-200:]}")
    if work.drafts():
        found.faults.append(f"{work.name}, {number.name}: a draft stayed after the next run")
    return found


def _ended(process: int) -> bool:
    """Whether the process has ended, which another waits for."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def _members(session: int) -> list[int]:
    """The processes of a session that have not ended."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state, _, _, number = (place / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(number) == session and state != "Z":
                found.append(int(place.name))
    return found


def _seconds_of(processes: Sequence[int]) -> float:
    """Seconds of the processor that processes have taken, more than none for each."""
    tick, total = os.sysconf("SC_CLK_TCK"), 0.0
    for number in processes:
        with suppress(OSError):
            user, system = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[11:13]
            total += 1e-9 + (int(user) + int(system)) / tick
    return total


def _folder(work: Work) -> Path:
    return work.output if work.output.is_dir() else work.output.parent


def _removed(draft: Path) -> None:
    if draft.is_dir():
        shutil.rmtree(draft)
    else:
        draft.unlink()


def _interruptible() -> None:
    """Undo what a shell does to jobs in the background: they ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def mounted(folder: Path) -> Iterator[bool]:
    """A disk of 4 MB in memory at a folder; False where this user may not mount one."""
    folder.mkdir(exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder)]
    may = bool(shutil.which("mount")) and subprocess.run(command, capture_output=True).returncode == 0
    try:
        yield may
    finally:
        if may:
            subprocess.run(["umount", "-l", str(folder)], check=True)


def _ended_or_drafted(process: int, work: Work) -> bool:
    return _ended(process) or bool(work.drafts())


def _until(true: Callable[[], bool], patience_s: float = 60.0) -> None:
    end = time.monotonic() + patience_s
    while not true() and time.monotonic() < end:
        time.sleep(0.002)


def places(work: Work) -> Count:
    """Disks that are full or read-only, folders that disappear, links, outputs among the inputs, two runs at once: one
    line, nothing lost."""
    found = Count()

    def run(work: Work, what: str, expected: int, begin: Callable[[], None] | None = None) -> None:
        old = work.files()
        done = subprocess.run(work.command(), capture_output=True, text=True, preexec_fn=begin)
        found.runs += 1
        if done.returncode != expected or "Traceback" in done.stderr or "fault of sameas" in done.stderr:
            found.faults.append(f"{work.name}, {what}: exit code {done.returncode}: {done.stderr[-300:]}")
        elif expected and work.files() != old:
            found.faults.append(f"{work.name}, {what}: the old output changed")
        elif work.drafts():
            found.faults.append(f"{work.name}, {what}: a draft stayed")
        elif expected:
            found.old += 1
        else:
            found.new += 1

    run(work.fresh("small"), "files no larger than 2 kB", 1, _small)
    closed = replace(work, output=work.output.with_name("closed") / work.output.name)
    closed.output.parent.mkdir(mode=0o555)
    run(closed, "a folder that is closed", 1, _without_power)
    disk = work.output.with_name("disk")
    with mounted(disk) as may:
        if may:
            there = replace(work, output=disk / work.output.name)
            run(there.fresh("first"), "a disk in memory", 0)
            with (disk / "filler").open("wb", buffering=0) as filler, suppress(OSError):
                while True:
                    filler.write(bytes(4096))
            run(there.fresh("full"), "a full disk", 1)
            (disk / "filler").unlink()
            subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
            run(there.fresh("locked"), "a read-only disk", 1)
    folder = work.output.with_name("inputs")
    copied = work.among_inputs(folder)
    before = _digests(folder)
    run(copied, "output among the inputs", 0 if work.fills and not isinstance(work, Hats) else 1)
    if not before.items() <= _digests(folder).items():
        found.faults.append(f"{work.name}, output among the inputs: an input changed")
    if not isinstance(work, Hats):  # which is not replaced
        link = work.output.with_name(f"link{work.output.suffix}")
        link.symlink_to(work.output)
        run(replace(work, output=link), "a link", 0)
        if not link.is_symlink():
            found.faults.append(f"{work.name}: a link was replaced")
    twice = work.fresh("two")
    two = [subprocess.Popen(twice.command(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) for _ in range(2)]
    said = b"".join(process.communicate()[1] for process in two)
    found.runs += 1
    # One of them may be refused, in one line.
    refused = said.count(b"\n") == 1 and b"another" in said and sum(process.returncode for process in two) == 1
    if ((any(process.returncode for process in two) or said) and not refused) or work.drafts():
        found.faults.append(f"{work.name}, two runs at once: {said[-300:]!r}")
    else:
        found.new += 1
    gone = replace(work, output=work.output.with_name("gone") / work.output.name)
    gone.output.parent.mkdir()
    process = subprocess.Popen(gone.command(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    time.sleep(0.3)
    shutil.rmtree(gone.output.parent)
    words = process.communicate()[1]
    found.runs += 1
    if "Traceback" in words or "fault of sameas" in words or (process.returncode and words.count("\n") != 1):
        found.faults.append(f"{work.name}, a folder that disappears: exit code {process.returncode}: {words[-300:]}")
    else:
        found.old += 1
    return found


def _digests(path: Path) -> dict[str, str]:
    """Of all files in a folder."""
    return {str(one.relative_to(path)): hashlib.sha256(one.read_bytes()).hexdigest()
            for one in sorted(path.rglob("*")) if one.is_file()}  # fmt: skip


def _small() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))


def _without_power() -> None:
    """What it begins has to ask before it writes, as a user does, even where it is root (CAP_DAC_OVERRIDE is 1)."""
    ctypes.CDLL(None).prctl(24, 1, 0, 0, 0)


def main() -> None:
    if sys.argv[1:2] == ["--serve"]:
        return serve(sys.argv[2:])
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--moments", type=int, default=12, help="moments for each command and signal; 12 make 540")
    parser.add_argument("--only", default="", help="commands whose name begins so; loads: crowds and millions of rows")
    parser.add_argument("--load", default="", help="loads whose name holds this")
    parser.add_argument("--signals-only", action="store_true", help="no disks, no two runs at once")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = random.Random(given.seed)
    os.environ["SOURCE_DATE_EPOCH"] = "1700000000"  # so that runs at different times write the same bytes
    made = [] if given.only == "loads" else _of_outputs(given.only, given.moments, not given.signals_only, rng)
    made += tables(given.load, rng) if given.only in ("", "loads") else ()
    report("faults", made)
    sys.exit(any(table.notes for table in made))


def _of_outputs(only: str, moments: int, disks: bool, rng: random.Random) -> list[Table]:
    """The commands whose names begin so, hit by signals, and in places where they cannot write, or only just."""
    hits, placed, names = dict[str, Count](), dict[str, Count](), dict[str, list[str]]()
    with tempfile.TemporaryDirectory() as folder:
        for work in (work for work in works(Path(folder)) if work.name.startswith(only)):
            names.setdefault(work.kind, []).append(work.output.suffix)
            server = Begun(work) if work.starts_others else Server(work)
            every = [(number.name, hits, partial(hit, work, server, number, moments, rng)) for number in CODES]
            every += [("disks, two runs", placed, partial(places, work))] if disks else []
            for name, counts, runs in every:
                found = runs()
                print(*found.row(f"{work.name}: {name}"), *found.faults, sep="\n    ", flush=True)
                counts.setdefault(work.kind, Count()).include(found)
            server.close()
    titles = {kind: kind if len(its) == 1 else f"{kind}, {len(its)} formats" for kind, its in names.items()}
    made = []
    for title, counts in (("Outputs of processes that were hit", hits), ("Outputs in places that refuse them", placed)):
        sums = Count()
        for count in counts.values():
            sums.include(replace(count, faults=list(count.faults)))
        rows = [*(count.row(titles[kind]) for kind, count in counts.items()), sums.row("together")]
        columns = ("what", "runs", "old one", "new one", "files of both", "slowest answer, s", "faults")
        made.append(Table(title, columns, rows, sums.faults))
    return made if disks else made[:1]


if __name__ == "__main__":
    main()
