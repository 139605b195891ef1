"""Whether outputs stay complete when commands are killed, disks are full or read-only, or two runs write at once.

Every command overwrites the output of an earlier run and gets SIGKILL, SIGTERM or SIGINT at a random moment of its run,
every second time just after its draft file has appeared. Required: the output is the complete old or the complete new
one; no draft remains (after SIGKILL: none after the next run); the exit code names the signal; stderr has at most one
line. The runs are forked from a process that has executed the command once, because loading the modules takes longer
than the work and is not what is tested. ``loads.py`` has extreme inputs. ``scripts/bench faults`` (Linux).
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
#: CPU and wall seconds after which a child of an ended process counts as an orphan; a busy machine needs that long to
#: end it.
ORPHANED_S, ORPHANED_CLOCK_S = 3.0, 60.0
ENDINGS = (".fits", ".vot", ".ecsv", ".csv", ".parquet")


@dataclass(frozen=True)
class Work:
    """One command. arguments, earlier : of the tested and of the earlier run. output : file or folder written."""

    name: str
    arguments: tuple[str, ...]
    earlier: tuple[str, ...]
    output: Path
    #: Whether a stopped run may leave files of both runs, each complete, which the next run completes.
    resumes: bool = False
    #: Allowed exit codes in addition to those of the signals.
    codes: tuple[int, ...] = (0,)
    #: Whether it starts processes. Then each run is a new process: a fork would share those of the first run.
    starts_others: bool = False

    @property
    def kind(self) -> str:
        """Its row in the table, shared by the commands that differ in the output format only."""
        return self.name.removesuffix(f" {self.output.suffix}")

    def command(self, earlier: bool = False) -> list[str]:
        return [*COMMAND, *(self.earlier if earlier else self.arguments), "-o", str(self.output), "--quiet"]

    def done(self, earlier: bool = False) -> dict[str, str]:
        """The files after an undisturbed run."""
        done = subprocess.run(self.command(earlier), capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{self.name}: {done.stderr}")
        return self.files()

    def undisturbed(self, runner: ForkServer | NewProcess, earlier: bool = False) -> tuple[int, str]:
        """Exit code and stderr of an undisturbed run."""
        runner.start(self.command(earlier))
        return runner.wait()

    def files(self) -> dict[str, str]:
        """SHA-256 of the files of the output, by name."""
        folder, pattern = (self.output, "*") if self.output.is_dir() else (self.output.parent, f"{self.output.name}*")
        paths = sorted(folder.glob(pattern))
        return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in paths if not p.name.startswith(".sameas-")}

    def drafts(self) -> list[Path]:
        return list((self.output if self.output.is_dir() else self.output.parent).glob(".sameas-*"))

    def keep(self) -> dict[str, bytes]:
        """The contents of the output, for ``restore``."""
        return {name: (_folder(self) / name).read_bytes() for name in self.files()}

    def restore(self, kept: dict[str, bytes]) -> None:
        """Restore the output, and delete all other files in it."""
        for name in set(self.files()) - set(kept):
            (_folder(self) / name).unlink()
        for name, content in kept.items():
            (_folder(self) / name).write_bytes(content)

    def to_new_output(self, name: str) -> Work:
        """The command with an output that it may write: the same one, if it replaces outputs."""
        return self

    @property
    def writes_folder(self) -> bool:
        """Whether the output is a folder, not one file."""
        return not self.output.suffix

    def among_inputs(self, folder: Path) -> Work:
        """The command on copies of its inputs in a folder, with that folder or the first input as its output."""
        inputs = self.inputs()
        copied = [path for path in inputs if Path(path).is_dir()] or inputs
        copies = [folder / Path(path).name if Path(path).is_file() else folder for path in copied]
        folder.mkdir()
        for path in map(Path, copied):
            if path.is_dir():
                shutil.copytree(path, folder, dirs_exist_ok=True)
            else:
                shutil.copy(path, folder)
        renamed = dict(zip(copied, map(str, copies), strict=True))
        arguments = tuple(renamed.get(argument, argument) for argument in self.arguments)
        return replace(self, arguments=arguments, output=folder if self.writes_folder else copies[0])

    def inputs(self) -> list[str]:
        """The arguments that are files or folders."""
        return [argument for argument in self.arguments if os.path.isabs(argument) and os.path.exists(argument)]

    def part(self, name: str) -> str:
        """The part of the output that a file belongs to; the files of a part are written together."""
        return "" if not self.resumes else name.split(".")[0] if name[0] == "f" else "series"

    def verdict(self, now: dict[str, str], old: dict[str, str], new: dict[str, str], number: signal.Signals) -> str:
        """Whether the output is "old", "new" or, where allowed, "mixed"; otherwise what is wrong with it."""
        if now in (old, new):
            return "old" if now == old else "new"
        complete = all(now.get(name) in (old.get(name), new.get(name)) for name in {*now, *old, *new})
        if complete and number == signal.SIGKILL:
            return "mixed"  # several files are replaced one after another
        if self.resumes and complete:
            parts: dict[str, set[bool]] = {}
            for name in {*old, *new}:
                if old.get(name) != new.get(name):
                    parts.setdefault(self.part(name), set()).add(now.get(name) == new.get(name))
            if all(len(is_new) == 1 for is_new in parts.values()):
                return "mixed"
        return f"the output is neither old nor new: {sorted(now)}"


class Watch(Work):
    """A live picture: complete if its journal, archive and state can be read; the next run resumes it."""

    def files(self) -> dict[str, str]:
        return {}

    def drafts(self) -> list[Path]:
        return list(self.output.rglob(".sameas-*"))

    def keep(self) -> dict[str, bytes]:
        return {}

    def restore(self, kept: dict[str, bytes]) -> None:
        """About half of the runs resume the interrupted one; the others start from an empty folder."""
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
                    dangling = base.execute(
                        "SELECT COUNT(*) FROM identities WHERE object NOT IN (SELECT object FROM objects)"
                    )
                    if dangling.fetchone() != (0,):
                        return "the journal has identities without an object"
            for path in (self.output / "archive").glob("objects-*.parquet"):
                parquet.read_table(path)
            state = load_state(self.output)
        except Exception as error:
            return f"cannot be read: {error}"
        return "old" if state is None else "new"


class Hats(Work):
    """Partitions: an interrupted output is a part of the new one, which the next run completes to the same bytes."""

    def files(self) -> dict[str, str]:
        paths = sorted(path for path in self.output.rglob("*") if path.is_file())
        written = [path for path in paths if not path.relative_to(self.output).as_posix().startswith(".sameas-run")]
        return {str(p.relative_to(self.output)): hashlib.sha256(p.read_bytes()).hexdigest()
                for p in written if not p.name.endswith(".part")}  # fmt: skip

    def drafts(self) -> list[Path]:
        """The drafts after a completed run; those of an interrupted run are removed by the next one."""
        if not (self.output / "collection.properties").exists():
            return []
        try:
            return [path for path in self.output.rglob("*") if path.suffix == ".part" or path.name == ".sameas-run"]
        except FileNotFoundError:  # the folder is being removed
            return []

    def keep(self) -> dict[str, bytes]:
        return {}

    def restore(self, kept: dict[str, bytes]) -> None:
        shutil.rmtree(self.output, ignore_errors=True)

    def undisturbed(self, runner: ForkServer | NewProcess, earlier: bool = False) -> tuple[int, str]:
        """A run that completes the output; none if it is complete, because the command refuses to replace it."""
        if earlier:
            self.restore({})
        if earlier or (self.output / "collection.properties").exists():
            return 0, ""
        return super().undisturbed(runner)

    def to_new_output(self, name: str) -> Work:
        return replace(self, output=self.output.with_name(name.replace(" ", "-")))

    def among_inputs(self, folder: Path) -> Work:
        """The command with a copy of its first input, a folder full of other files, as its output."""
        shutil.copytree(self.inputs()[0], folder)
        return replace(self, output=folder)

    def verdict(self, now: dict[str, str], old: dict[str, str], new: dict[str, str], number: signal.Signals) -> str:
        if now == new:
            return "new"
        if (self.output / "collection.properties").exists():
            return "is marked as complete, and is not"
        changed = [name for name, digest in now.items() if name in new and new[name] != digest]
        return f"{changed} differ from those of an undisturbed run" if changed else "mixed" if now else "old"


class NewProcess:
    """Starts each run as a new process in its own session; for commands that start processes themselves."""

    def __init__(self, work: Work) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.stderr = tempfile.TemporaryFile()  # noqa: SIM115 (an orphan would hold a pipe open)

    def start(self, command: list[str]) -> int:
        """Start a run; returns its process id."""
        self.stderr.seek(0)
        self.stderr.truncate()
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=self.stderr, start_new_session=True,
                                        preexec_fn=_interruptible)  # fmt: skip
        return self.process.pid

    def wait(self) -> tuple[int, str]:
        """Wait for the run to end; its exit code and stderr."""
        assert self.process is not None
        code = self.process.wait()
        self.stderr.seek(0)
        return code, self.stderr.read().decode(errors="replace")

    def orphans(self) -> list[str]:
        """Kill the processes of its session that still run after ``ORPHANED_S`` of CPU time; their command lines."""
        assert self.process is not None
        limit_s = _cpu_seconds(_members(self.process.pid)) + ORPHANED_S
        _wait_until(lambda: not 0.0 < _cpu_seconds(_members(self.process.pid)) < limit_s, ORPHANED_CLOCK_S)
        orphans = [(number, Path(f"/proc/{number}/cmdline").read_bytes()) for number in _members(self.process.pid)]
        for number, _ in orphans:
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        return [line.replace(b"\0", b" ").decode(errors="replace")[:80] for _, line in orphans]

    def close(self) -> None:
        self.stderr.close()


class ForkServer:
    """A process that has executed a command once, and from which further runs of it are forked."""

    def __init__(self, work: Work) -> None:
        command = [sys.executable, "-m", "benchmarks.faults", "--serve", *work.command()[3:]]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
                                        preexec_fn=_interruptible)  # fmt: skip
        self._answer("ready")

    def start(self, command: list[str]) -> int:
        """Fork a run of a command; returns its process id."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command[3:]) + "\n")
        return int(self._answer("begun"))

    def wait(self) -> tuple[int, str]:
        """Wait for the run to end; its exit code and stderr."""
        code, stderr = json.loads(self._answer("ended"))
        return code, stderr

    def orphans(self) -> list[str]:
        """None: its commands start no processes."""
        return []

    def close(self) -> None:
        self.process.communicate()

    def _answer(self, key: str) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line.startswith(key):
            raise RuntimeError(f"{key}: {line!r}")
        return line[len(key) :]


def serve(arguments: list[str]) -> None:
    """Execute a command, then fork one run per line of stdin; prints the process id, exit code and stderr of each."""
    from sameas.cli import main as command
    from sameas.cli.app import app

    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    app(arguments, standalone_mode=False)
    answers.write("ready\n")
    with tempfile.TemporaryFile() as stderr:
        for line in sys.stdin:
            stderr.truncate(0)
            child = os.fork()
            if not child:
                os.dup2(stderr.fileno(), 2)
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
            answers.write(f"begun {child}\n")
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            stderr.seek(0)
            answers.write(f"ended {json.dumps([code, stderr.read().decode(errors='replace')])}\n")
            stderr.seek(0)


@dataclass
class Count:
    """The outcomes of the runs of one row."""

    runs: int = 0
    old: int = 0
    new: int = 0
    mixed: int = 0
    #: Longest time from a signal to the end of the process.
    slowest_s: float = 0.0
    faults: list[str] = field(default_factory=list)

    def row(self, name: str) -> list[object]:
        return [name, self.runs, self.old, self.new, self.mixed, round(self.slowest_s, 2), len(self.faults)]

    def include(self, more: Count) -> None:
        """Add the counts of other runs."""
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
    """Detections of forty movers on eight exposures, and as many false ones."""
    rng = np.random.default_rng(8)
    x, angle = rng.uniform(-0.1, 0.1, (2, 40)), rng.uniform(0.0, 6.28, 40)
    path = folder / "night.csv"
    lines = ["ra,dec,mjd,mag"]
    for k in range(8):
        day = k / 100.0
        ra, dec = 150.0 + x[0] + 0.2 * day * np.cos(angle), x[1] + 0.2 * day * np.sin(angle)
        noise = rng.normal(0.0, 0.2 / 3600.0, (2, 40))
        false = rng.uniform(-0.1, 0.1, (40, 2)) + np.array([150.0, 0.0])
        rows = [*zip(ra + noise[0], dec + noise[1], strict=True), *false]
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
            photons = np.maximum(hdus[0].data - 500.0, 0.0)
            noise = np.random.default_rng(k).normal(0.0, np.sqrt(7.0**2 + photons))
            rows, columns = np.mgrid[:256, :256]
            noise += 900.0 * np.exp(-((columns - 100.3 - 9.0 * k) ** 2 + (rows - 91.4 - 7.0 * k) ** 2) / (2 * 1.5**2))
            header = hdus[0].header.copy()
            header["DATE-OBS"] = f"2016-01-01T00:{10 * k:02d}:00"
            fits.PrimaryHDU((hdus[0].data + noise).astype("f4"), header).writeto(night_folder / f"f{k}.fits")
    return night_folder


def partitioned(folder: Path) -> tuple[str, str]:
    """Two HATS catalogues of one field."""
    from astropy.table import Table as Stars

    from sameas.partitions.hats import write_hats

    rng = np.random.default_rng(9)
    ra, dec = rng.uniform(40.0, 40.6, 3000), rng.uniform(10.0, 10.6, 3000)
    for name in ("one", "two"):
        moved = dec + rng.normal(0.0, 0.1 / 3600.0, 3000)
        write_hats(Stars({"id": np.arange(3000), "ra": ra, "dec": moved}), folder / name, max_rows=400)
    return str(folder / "one"), str(folder / "two")


def works(folder: Path, endings: tuple[str, ...] = ENDINGS) -> list[Work]:
    """The commands that are tested, those that write tables with every format."""
    a, b, c = map(str, catalogues(folder))
    image, stars = map(str, frame(folder))

    def output(name: str) -> Path:
        (folder / name).mkdir()
        return folder / name / "out"

    jobs = [Work(f"match {e}", ("match", a, b), ("match", b, a), output(f"m{e[1:]}").with_suffix(e)) for e in endings]
    for e in endings:
        many = output(f"n{e[1:]}").with_suffix(e)
        jobs.append(Work(f"many {e}", ("many", a, b, c), ("many", c, b, a), many))
    arguments = ("frame", image, "--catalog", stars, "--no-picture", "--again")
    jobs.append(Work("frame", arguments, (*arguments, "--threshold", "6"), output("frame")))
    for ending in (".csv", ".fits"):
        arguments = ("movers", str(night(folder)), "--sigma", "0.2", "--least")
        jobs.append(
            Work(f"movers {ending}", (*arguments, "3"), (*arguments, "2"), output(f"v{ending[1:]}").with_suffix(ending))
        )
    many = str(nights(folder, Path(image)))
    frames, options = sorted(map(str, Path(many).iterdir())), ("--catalog", stars, "--processes")
    parts = partitioned(folder)
    for n, name in (("1", ""), ("2", ", 2 processes")):
        starts = n == "2"
        arguments = ("frame", many, *options, n, "--no-picture")
        earlier, series = (*arguments, "--threshold", "6"), output(f"series{n}")
        jobs.append(Work(f"series of frames{name}", arguments, earlier, series, True, starts_others=starts))
        earlier, arguments = ("movers", *frames[:2], *options, n), ("movers", *frames, *options, n)
        folder_of_movers = output(f"moved{n}")
        jobs.append(Work(f"movers on frames{name}", arguments, earlier, folder_of_movers, True, starts_others=starts))
        arguments = ("match", *parts, "--sigma", "0.1", "--workers", n)
        jobs.append(Hats(f"match, partitions{name}", arguments, arguments, output(f"hats{n}"), starts_others=starts))
    arguments = ("watch", *sensors(folder), "--no-map", "--pace", "60", "--every", "1s")
    jobs.append(Watch("watch", arguments, arguments, output("watch")))
    arguments = ("picture", *sensors(folder), "--no-image", "--every")
    jobs.append(Work("picture", (*arguments, "20s"), (*arguments, "30s"), output("picture")))
    return jobs


def signalled(
    work: Work, runner: ForkServer | NewProcess, number: signal.Signals, moments: int, rng: random.Random
) -> Count:
    """``moments`` runs of a command, each of which gets the signal once at a random moment."""
    count = Count()
    for earlier in (True, False):
        began = time.monotonic()
        code, stderr = work.undisturbed(runner, earlier)
        run_s = time.monotonic() - began
        if code:
            raise RuntimeError(f"{work.name}: {stderr}")
        if earlier:
            old, kept = work.files(), work.keep()
    new = work.files()
    if new and old == new:
        raise RuntimeError(f"{work.name}: two runs with different options write the same files")
    for moment in range(moments):
        work.restore(kept)
        process = runner.start(work.command())
        if moment % 2:
            time.sleep(rng.uniform(0.0, 1.05) * run_s)
        else:
            _wait_until(partial(_ended_or_drafted, process, work))
            time.sleep(rng.choice((0.0, 1.0)) * rng.uniform(0.0, 0.1) * min(run_s, 1.0))
        sent = time.monotonic()
        # A terminal sends Ctrl-C to all processes; SIGTERM and SIGKILL mostly go to the first process only.
        send = os.killpg if work.starts_others and (number == signal.SIGINT) != (moment % 4 == 3) else os.kill
        with suppress(ProcessLookupError):  # it has ended
            send(process, number)
        code, stderr = runner.wait()
        answer_s = time.monotonic() - sent
        count.slowest_s = max(count.slowest_s, answer_s)
        drafts = work.drafts()
        count.faults += [f"{work.name}, {number.name}: a process still runs: {line}" for line in runner.orphans()]
        now = work.files()
        count.runs += 1
        verdict = work.verdict(now, old, new, number)
        if verdict in ("old", "new", "mixed"):
            setattr(count, verdict, getattr(count, verdict) + 1)
        else:
            count.faults.append(f"{work.name}, {number.name}: {verdict}")
        # Before the command has installed its handlers, Python's default exit is as good.
        if code not in (*work.codes, CODES[number], -number) and not (code == 99 and "KeyboardInterrupt" in stderr):
            count.faults.append(f"{work.name}, {number.name}: exit code {code}: {stderr[-200:]}")
        if "terminate called" in stderr or (stderr.count("\n") > 1 and "KeyboardInterrupt" not in stderr):
            count.faults.append(f"{work.name}, {number.name}: stderr {stderr[-300:]!r}")
        if answer_s > 1.5 and number != signal.SIGKILL:  # which no process can answer
            count.faults.append(f"{work.name}, {number.name}: answered after {answer_s:.1f} s")
        if number != signal.SIGKILL and (drafts or work.drafts()):
            count.faults.append(f"{work.name}, {number.name}: a draft remains")
            for draft in work.drafts():
                _remove(draft)
    code, stderr = work.undisturbed(runner)
    if code or (work.files() != new):
        count.faults.append(f"{work.name}, {number.name}: the next run does not complete it: {code}: {stderr[-200:]}")
    if work.drafts():
        count.faults.append(f"{work.name}, {number.name}: a draft remains after the next run")
    return count


def _ended(process: int) -> bool:
    """Whether the process, a child of another one, has ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def _members(session: int) -> list[int]:
    """The processes of a session that have not ended."""
    members = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state, _, _, number = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(number) == session and state != "Z":
                members.append(int(folder.name))
    return members


def _cpu_seconds(processes: Sequence[int]) -> float:
    """CPU seconds of the processes, more than zero for each that exists."""
    tick, total = os.sysconf("SC_CLK_TCK"), 0.0
    for number in processes:
        with suppress(OSError):
            user, system = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[11:13]
            total += 1e-9 + (int(user) + int(system)) / tick
    return total


def _folder(work: Work) -> Path:
    return work.output if work.output.is_dir() else work.output.parent


def _remove(draft: Path) -> None:
    if draft.is_dir():
        shutil.rmtree(draft)
    else:
        draft.unlink()


def _interruptible() -> None:
    """Handle Ctrl-C, which a shell makes background jobs ignore."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def mounted(folder: Path) -> Iterator[bool]:
    """Mount a memory disk of 4 MB at a folder; yields False if this user may not."""
    folder.mkdir(exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder)]
    allowed = bool(shutil.which("mount")) and subprocess.run(command, capture_output=True).returncode == 0
    try:
        yield allowed
    finally:
        if allowed:
            subprocess.run(["umount", "-l", str(folder)], check=True)


def _ended_or_drafted(process: int, work: Work) -> bool:
    return _ended(process) or bool(work.drafts())


def _wait_until(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.002)


def unwritable(work: Work) -> Count:
    """Runs with full or read-only disks, disappearing folders, links, outputs among the inputs, two runs at once.

    Required: at most one line on stderr, and no loss of the old output or of inputs.
    """
    count = Count()

    def run(work: Work, what: str, expected: int, begin: Callable[[], None] | None = None) -> None:
        old = work.files()
        done = subprocess.run(work.command(), capture_output=True, text=True, preexec_fn=begin)
        count.runs += 1
        if done.returncode != expected or "Traceback" in done.stderr or "fault of sameas" in done.stderr:
            count.faults.append(f"{work.name}, {what}: exit code {done.returncode}: {done.stderr[-300:]}")
        elif expected and work.files() != old:
            count.faults.append(f"{work.name}, {what}: the old output changed")
        elif work.drafts():
            count.faults.append(f"{work.name}, {what}: a draft stayed")
        elif expected:
            count.old += 1
        else:
            count.new += 1

    run(work.to_new_output("small"), "files of at most 2 kB", 1, _limit_file_size)
    closed = replace(work, output=work.output.with_name("closed") / work.output.name)
    closed.output.parent.mkdir(mode=0o555)
    run(closed, "a read-only folder", 1, _without_root_access)
    disk = work.output.with_name("disk")
    with mounted(disk) as allowed:
        if allowed:
            on_disk = replace(work, output=disk / work.output.name)
            run(on_disk.to_new_output("first"), "a disk in memory", 0)
            with (disk / "filler").open("wb", buffering=0) as filler, suppress(OSError):
                while True:
                    filler.write(bytes(4096))
            run(on_disk.to_new_output("full"), "a full disk", 1)
            (disk / "filler").unlink()
            subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
            run(on_disk.to_new_output("locked"), "a read-only disk", 1)
    folder = work.output.with_name("inputs")
    copied = work.among_inputs(folder)
    before = _digests(folder)
    run(copied, "output among the inputs", 0 if work.writes_folder and not isinstance(work, Hats) else 1)
    if not before.items() <= _digests(folder).items():
        count.faults.append(f"{work.name}, output among the inputs: an input changed")
    if not isinstance(work, Hats):  # outputs in partitions are not replaced
        link = work.output.with_name(f"link{work.output.suffix}")
        link.symlink_to(work.output)
        run(replace(work, output=link), "a link", 0)
        if not link.is_symlink():
            count.faults.append(f"{work.name}: a link was replaced")
    shared = work.to_new_output("two")
    both = [subprocess.Popen(shared.command(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) for _ in range(2)]
    stderr = b"".join(process.communicate()[1] for process in both)
    count.runs += 1
    # One of them may be refused, in one line.
    refused = stderr.count(b"\n") == 1 and b"another" in stderr and sum(process.returncode for process in both) == 1
    if ((any(process.returncode for process in both) or stderr) and not refused) or work.drafts():
        count.faults.append(f"{work.name}, two runs at once: {stderr[-300:]!r}")
    else:
        count.new += 1
    removed = replace(work, output=work.output.with_name("gone") / work.output.name)
    removed.output.parent.mkdir()
    process = subprocess.Popen(removed.command(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    time.sleep(0.3)
    shutil.rmtree(removed.output.parent)
    message = process.communicate()[1]
    count.runs += 1
    if "Traceback" in message or "fault of sameas" in message or (process.returncode and message.count("\n") != 1):
        count.faults.append(f"{work.name}, a folder that disappears: exit code {process.returncode}: {message[-300:]}")
    else:
        count.old += 1
    return count


def _digests(path: Path) -> dict[str, str]:
    """SHA-256 of all files in a folder."""
    return {str(one.relative_to(path)): hashlib.sha256(one.read_bytes()).hexdigest()
            for one in sorted(path.rglob("*")) if one.is_file()}  # fmt: skip


def _limit_file_size() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))


def _without_root_access() -> None:
    """Make file permissions apply to the started program even for root: drop CAP_DAC_OVERRIDE (1)."""
    ctypes.CDLL(None).prctl(24, 1, 0, 0, 0)


def main() -> None:
    if sys.argv[1:2] == ["--serve"]:
        return serve(sys.argv[2:])
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--moments", type=int, default=12, help="moments for each command and signal; 12 make 540")
    parser.add_argument("--only", default="", help="commands whose name starts with this; loads: those of loads.py")
    parser.add_argument("--load", default="", help="loads whose name contains this")
    parser.add_argument("--signals-only", action="store_true", help="skip disks, links and two runs at once")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = random.Random(given.seed)
    os.environ["SOURCE_DATE_EPOCH"] = "1700000000"  # so that runs at different times write the same bytes
    reports = [] if given.only == "loads" else output_tables(given.only, given.moments, not given.signals_only, rng)
    reports += tables(given.load, rng) if given.only in ("", "loads") else ()
    report("faults", reports)
    sys.exit(any(table.notes for table in reports))


def output_tables(only: str, moments: int, disks: bool, rng: random.Random) -> list[Table]:
    """The tables of the commands whose names start with ``only``: signals, and outputs that cannot be written."""
    hits, refusals, suffixes = dict[str, Count](), dict[str, Count](), dict[str, list[str]]()
    with tempfile.TemporaryDirectory() as folder:
        for work in (work for work in works(Path(folder)) if work.name.startswith(only)):
            suffixes.setdefault(work.kind, []).append(work.output.suffix)
            runner = NewProcess(work) if work.starts_others else ForkServer(work)
            tests = [(number.name, hits, partial(signalled, work, runner, number, moments, rng)) for number in CODES]
            tests += [("disks, two runs", refusals, partial(unwritable, work))] if disks else []
            for name, counts, test in tests:
                result = test()
                print(*result.row(f"{work.name}: {name}"), *result.faults, sep="\n    ", flush=True)
                counts.setdefault(work.kind, Count()).include(result)
            runner.close()
    titles = {kind: kind if len(its) == 1 else f"{kind}, {len(its)} formats" for kind, its in suffixes.items()}
    reports = []
    for title, counts in (("Outputs after a signal", hits), ("Outputs that cannot be written", refusals)):
        sums = Count()
        for count in counts.values():
            sums.include(replace(count, faults=list(count.faults)))
        rows = [*(count.row(titles[kind]) for kind, count in counts.items()), sums.row("all")]
        columns = ("command", "runs", "old output", "new output", "files of both", "slowest answer, s", "faults")
        reports.append(Table(title, columns, rows, sums.faults))
    return reports if disks else reports[:1]


if __name__ == "__main__":
    main()
