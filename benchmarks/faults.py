"""Processes killed at random moments, full and read-only disks, two runs at once: is the output whole, old or new?

Every command writes over an output of an earlier run and is then hit: by SIGKILL, SIGTERM or SIGINT at a moment drawn
over its run, every second time just after its draft has appeared. The output must be the old one or the new one, whole;
no draft may stay (after SIGKILL: none after the next run); the exit code must say what happened; nothing but one line
may be on stderr. The runs are forked from a process that has done the command once: to load modules takes longer than
the work, and is not what is to be hit.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.tables import Table, report

COMMAND = [sys.executable, "-m", "sameas"]
CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: 143, signal.SIGINT: 130}
ENDINGS = (".fits", ".vot", ".ecsv", ".csv", ".parquet")


@dataclass(frozen=True)
class Work:
    """One command: its name in the table, its arguments, those of the earlier run, and what it writes."""

    name: str
    arguments: tuple[str, ...]
    earlier: tuple[str, ...]
    output: Path

    def command(self, earlier: bool = False) -> list[str]:
        return [*COMMAND, *(self.earlier if earlier else self.arguments), "-o", str(self.output), "--quiet"]

    def done(self, earlier: bool = False) -> dict[str, str]:
        """The files after a run that nothing disturbs."""
        done = subprocess.run(self.command(earlier), capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{self.name}: {done.stderr}")
        return self.files()

    def forked(self, server: Server, earlier: bool = False) -> tuple[int, str]:
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
    faults: list[str] = field(default_factory=list)

    def row(self, name: str) -> list[object]:
        return [name, self.runs, self.old, self.new, self.mixed, len(self.faults)]


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
    seen = ("picture", *sensors(folder), "--no-image", "--every")
    made.append(Work("picture", (*seen, "20s"), (*seen, "30s"), output("picture")))
    return made


def hit(work: Work, server: Server, number: signal.Signals, moments: int, rng: random.Random) -> Count:
    """Runs of a command, each hit once."""
    found = Count()
    for earlier in (True, False):
        began = time.monotonic()
        code, said = work.forked(server, earlier)
        longest = time.monotonic() - began
        if code:
            raise RuntimeError(f"{work.name}: {said}")
        if earlier:
            old = work.files()
            kept = {name: (_folder(work) / name).read_bytes() for name in old}
    new = work.files()
    for moment in range(moments):
        for name, content in kept.items():
            (_folder(work) / name).write_bytes(content)
        process = server.start(work.command())
        if moment % 2:
            time.sleep(rng.uniform(0.0, 1.05) * longest)
        else:
            _until(partial(_ended_or_drafted, process, work))
            time.sleep(rng.choice((0.0, 1.0)) * rng.uniform(0.0, 0.1) * min(longest, 1.0))
        asked = time.monotonic()
        with suppress(ProcessLookupError):  # it has ended
            os.kill(process, number)
        code, said = server.ended()
        answer_s = time.monotonic() - asked
        now = work.files()
        found.runs += 1
        if now == old:
            found.old += 1
        elif now == new:
            found.new += 1
        elif all(now.get(name) in (old.get(name), new.get(name)) for name in {*old, *new}) and number == signal.SIGKILL:
            found.mixed += 1  # several files come one after the other
        else:
            found.faults.append(f"{work.name}, {number.name}: the output is neither: {sorted(now)}")
        # In the first moments of a process nothing has been begun, and Python's own ends are as good.
        if code not in (0, CODES[number], -number) and not (code == 99 and "KeyboardInterrupt" in said):
            found.faults.append(f"{work.name}, {number.name}: exit code {code}: {said[-200:]}")
        if "terminate called" in said or (said.count("\n") > 1 and "KeyboardInterrupt" not in said):
            found.faults.append(f"{work.name}, {number.name}: says {said[-300:]!r}")
        if answer_s > 1.5:
            found.faults.append(f"{work.name}, {number.name}: answered after {answer_s:.1f} s")
        if number != signal.SIGKILL and work.drafts():
            found.faults.append(f"{work.name}, {number.name}: a draft stayed")
            for draft in work.drafts():
                _removed(draft)
    work.forked(server)
    if work.drafts():
        found.faults.append(f"{work.name}, {number.name}: a draft stayed after the next run")
    return found


def _ended(process: int) -> bool:
    """Whether the process has ended, which another waits for."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


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
    """Disks that are full or read-only, folders that disappear, links, two runs at once: one line, nothing lost."""
    found = Count()

    def run(work: Work, what: str, expected: int, limited: bool = False) -> None:
        old = work.files()
        done = subprocess.run(work.command(), capture_output=True, text=True, preexec_fn=_small if limited else None)
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

    run(work, "files no larger than 2 kB", 1, limited=True)
    disk = work.output.with_name("disk")
    with mounted(disk) as may:
        if may:
            there = replace(work, output=disk / work.output.name)
            run(there, "a disk in memory", 0)
            with (disk / "filler").open("wb", buffering=0) as filler, suppress(OSError):
                while True:
                    filler.write(bytes(4096))
            run(there, "a full disk", 1)
            (disk / "filler").unlink()
            subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
            run(there, "a read-only disk", 1)
    if work.arguments[0] == "match":
        run(replace(work, output=Path(work.arguments[1])), "output = input", 1)
        link = work.output.with_name(f"link{work.output.suffix}")
        link.symlink_to(work.output)
        run(replace(work, output=link), "a link", 0)
        if not link.is_symlink():
            found.faults.append(f"{work.name}: a link was replaced")
    two = [subprocess.Popen(work.command(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) for _ in range(2)]
    said = b"".join(process.communicate()[1] for process in two)
    found.runs += 1
    if any(process.returncode for process in two) or said or work.drafts():
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


def _small() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))


def main() -> None:
    if sys.argv[1:2] == ["--serve"]:
        return serve(sys.argv[2:])
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--moments", type=int, default=12, help="moments for each command and signal; 12 make 540")
    parser.add_argument("--only", default="", help="commands whose name begins so")
    parser.add_argument("--signals-only", action="store_true", help="no disks, no two runs at once")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = random.Random(given.seed)
    os.environ["SOURCE_DATE_EPOCH"] = "1700000000"  # so that runs at different times write the same bytes
    rows, faults = [], []
    with tempfile.TemporaryDirectory() as folder:
        for work in (work for work in works(Path(folder)) if work.name.startswith(given.only)):
            server = Server(work)
            every = [(number.name, partial(hit, work, server, number, given.moments, rng)) for number in CODES]
            every += [] if given.signals_only else [("disks, two runs", partial(places, work))]
            for name, runs in every:
                found = runs()
                rows.append(found.row(f"{work.name}: {name}"))
                faults += found.faults
                print(*rows[-1], *found.faults, flush=True)
            server.close()
    columns = ("what", "runs", "old one", "new one", "files of both", "faults")
    report("faults", [Table("Outputs of processes that were hit", columns, rows, faults)])
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
