"""Processes killed at random moments, full and read-only disks, two runs at once: is the output whole, old or new?

Every command writes over an output of an earlier run and is then hit: by SIGKILL, SIGTERM or SIGINT at a moment drawn
over its run, every second time just after its draft has appeared. The output must be the old one or the new one, whole;
no draft may stay (after SIGKILL: none after the next run); the exit code must say what happened; nothing but one line
may be on stderr.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.tables import Table, report

COMMAND = [sys.executable, "-m", "sameas"]
CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: 143, signal.SIGINT: 130}
ENDINGS = (".fits", ".vot", ".ecsv", ".csv", ".parquet")


@dataclass(frozen=True)
class Work:
    """One command: its name in the table, its arguments with the output left out, and what it writes."""

    name: str
    arguments: tuple[str, ...]
    output: Path

    def command(self) -> list[str]:
        return [*COMMAND, *self.arguments, "-o", str(self.output), "--quiet"]

    def files(self) -> dict[str, str]:
        """The files of the output by name, each as a digest."""
        paths = (
            sorted(self.output.iterdir()) if self.output.is_dir() else self.output.parent.glob(f"{self.output.name}*")
        )
        return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in paths if not p.name.startswith(".sameas-")}

    def drafts(self) -> list[Path]:
        return list((self.output if self.output.is_dir() else self.output.parent).glob(".sameas-*"))


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


def works(folder: Path, endings: tuple[str, ...] = ENDINGS) -> list[Work]:
    """The commands, and every format of tables."""
    a, b, c = map(str, catalogues(folder))
    image, stars = map(str, frame(folder))

    def output(name: str) -> Path:
        (folder / name).mkdir()
        return folder / name / "out"

    made = [Work(f"match {e}", ("match", a, b), output(f"m{e[1:]}").with_suffix(e)) for e in endings]
    made.append(Work("many .parquet", ("many", a, b, c), output("many").with_suffix(".parquet")))
    made.append(Work("frame", ("frame", image, "--catalog", stars, "--no-picture", "--again"), output("frame")))
    made.append(Work("picture", ("picture", *sensors(folder), "--every", "20s", "--no-image"), output("picture")))
    return made


def hit(work: Work, number: signal.Signals, moments: int, rng: random.Random) -> Count:
    """Runs of a command, each hit once."""
    found = Count()
    began = time.monotonic()
    done = subprocess.run(work.command(), capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{work.name}: {done.stderr}")
    longest, old = time.monotonic() - began, work.files()
    for moment in range(moments):
        process = subprocess.Popen(work.command(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                                   preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))  # fmt: skip
        if moment % 2:
            time.sleep(rng.uniform(0.0, 1.05) * longest)
        else:
            _until(lambda process=process: process.poll() is not None or bool(work.drafts()))
            time.sleep(rng.choice((0.0, 1.0)) * rng.uniform(0.0, 0.1))
        asked = time.monotonic()
        process.send_signal(number)
        _, said = process.communicate()
        answer_s = time.monotonic() - asked
        code = process.returncode
        new = work.files()
        found.runs += 1
        judged = _judged(work, old, new)
        if judged == "mixed" and number == signal.SIGKILL and len(old) > 1:
            found.mixed += 1  # several files come one after the other
        elif judged == "broken" or judged == "mixed":
            found.faults.append(f"{work.name}, {number.name}: output {judged}")
        elif new == old:
            found.old += 1
        else:
            found.new += 1
        # In the first moments Python itself is still starting: its own ends are as good.
        if code not in (0, CODES[number], -number) and not (code == 1 and "KeyboardInterrupt" in said):
            found.faults.append(f"{work.name}, {number.name}: exit code {code}: {said[-200:]}")
        if "terminate called" in said or (said.count("\n") > 1 and "KeyboardInterrupt" not in said):
            found.faults.append(f"{work.name}, {number.name}: says {said[-300:]!r}")
        if answer_s > 1.5:
            found.faults.append(f"{work.name}, {number.name}: answered after {answer_s:.1f} s")
        if number != signal.SIGKILL and work.drafts():
            found.faults.append(f"{work.name}, {number.name}: a draft stayed")
            for draft in work.drafts():
                _removed(draft)
        old = new
    subprocess.run(work.command(), capture_output=True, check=True)
    if work.drafts():
        found.faults.append(f"{work.name}, {number.name}: a draft stayed after the next run")
    return found


def _judged(work: Work, old: dict[str, str], new: dict[str, str]) -> str:
    """Whether the files of an output are whole, and all of one run: what is new can be read."""
    if set(new) != set(old):
        return "broken"
    changed = [name for name in new if new[name] != old[name]]
    folder = work.output if work.output.is_dir() else work.output.parent
    if not all(_whole(folder / name) for name in changed):
        return "broken"
    same = [name for name in new if name not in changed]
    # Files that are the same in every run tell nothing.
    return (
        "mixed" if changed and any(name.endswith((".json", ".parquet", ".fits", ".csv")) for name in same) else "whole"
    )


def _whole(path: Path) -> bool:
    from sameas.io import read_table

    text = path.suffix in (".json", ".html", ".geojson", ".reg", ".png", ".wcs", ".txt")
    if path.suffix in (".json", ".geojson"):
        return bool(json.loads(path.read_text()))
    if text:
        return path.suffix != ".html" or path.read_text().rstrip().endswith("</html>")
    return len(read_table(path).colnames) > 1


def _removed(draft: Path) -> None:
    import shutil

    if draft.is_dir():
        shutil.rmtree(draft)
    else:
        draft.unlink()


def _until(true: Callable[[], bool], patience_s: float = 60.0) -> None:
    end = time.monotonic() + patience_s
    while not true() and time.monotonic() < end:
        time.sleep(0.002)


def places(work: Work) -> Count:
    """What no output can be written to, and what no output may replace: refused in one line, the old output stays."""
    found = Count()
    output = work.output if not work.output.is_dir() else work.output / "x"

    def run(what: str, *, expected: int, **settings: object) -> subprocess.CompletedProcess[str]:
        old = work.files()
        done = subprocess.run(work.command(), capture_output=True, text=True, **settings)  # type: ignore[call-overload]
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
        return done

    def small() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))

    def nobody() -> None:
        os.setgid(65534)
        os.setuid(65534)

    run("a full disk", expected=1, preexec_fn=small)
    if os.getuid() == 0:
        output.parent.chmod(0o755)
        run("a folder of another user", expected=1, preexec_fn=nobody, env={**os.environ, "HOME": "/nonexistent"})
    one, two = (subprocess.Popen(work.command(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) for _ in range(2))
    said = one.communicate()[1] + two.communicate()[1]
    found.runs += 1
    if one.returncode or two.returncode or said or work.drafts():
        found.faults.append(f"{work.name}, two runs at once: {one.returncode}, {two.returncode}, {said[-300:]!r}")
    else:
        found.new += 1
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--moments", type=int, default=21, help="moments for each command and signal; 21 make 504")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = random.Random(given.seed)
    rows, faults = [], []
    with tempfile.TemporaryDirectory() as folder:
        for work in works(Path(folder)):
            every = [(number.name, hit(work, number, given.moments, rng)) for number in CODES]
            every.append(("disks, two runs", places(work)))
            for name, found in every:
                rows.append(found.row(f"{work.name}: {name}"))
                faults += found.faults
                print(*rows[-1], *found.faults, flush=True)
    columns = ("what", "runs", "old one", "new one", "files of both", "faults")
    report("faults", [Table("Outputs of processes that were hit", columns, rows, faults)])
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
