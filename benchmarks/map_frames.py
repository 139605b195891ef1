"""Frames of the live map while it is panned: a headless Chromium's own trace, for a watch of 2 000 ships.

Ships report by AIS and to a radar every second; ``sameas watch`` replays them in a process of its own and serves the
page. The page is dragged with the mouse for some seconds, at several zooms. From the trace: frames drawn per second
(Chromium draws 60 at most), milliseconds of the page's scripts per frame, and the processor time of the page's thread:
of its longest task, and how many tasks take longer than a frame, which other programs do not change much. Chromium
draws without a graphics card here, on the cores that run the watch too; on a desk it is faster.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tests.browser import CHROMIUM, Browser

from benchmarks.tables import Table, report
from sameas.tracks.coordinates import LocalPlane

SITE, START_S = (50.55, -0.95), 1_764_201_600
SPAN_S, HALF_WIDTH_M, SIGMA_M = 300, 15_000.0, 15.0
#: What is traced, and kinds of its events: a frame that is drawn, the page's own work for one, and a task of a thread.
TRACED = ["devtools.timeline", "disabled-by-default-devtools.timeline", "disabled-by-default-devtools.timeline.frame"]
FRAME, WORK, TASK = "DrawFrame", "FireAnimationFrame", "RunTask"
#: Milliseconds between frames.
FRAME_MS = 1e3 / 60.0
#: Zooms: all of the scene in the window, and parts of it.
ZOOMS = (1.0, 4.0, 16.0)


def write_reports(folder: Path, ships: int, seed: int) -> list[Path]:
    """AIS and a radar of ships on straight courses, as CSV files."""
    rng, plane = np.random.default_rng(seed), LocalPlane(*SITE)
    place, velocity = rng.uniform(-HALF_WIDTH_M, HALF_WIDTH_M, (ships, 2)), rng.normal(0.0, 4.0, (ships, 2))
    speed_kn, course = np.hypot(*velocity.T) / 0.514444, np.degrees(np.arctan2(*velocity.T)) % 360.0
    paths = [folder / "ais.csv", folder / "radar.csv"]
    with paths[0].open("w") as ais, paths[1].open("w") as radar:
        ais.write("time,lat,lon,mmsi,name,sog,cog\n")
        radar.write("time,lat,lon,track\n")
        for t in range(SPAN_S):
            for file, name in ((ais, "ais"), (radar, "radar")):
                lat, lon = plane.to_geodetic(place + t * velocity + SIGMA_M * rng.standard_normal(place.shape))
                for k in range(ships):
                    own = f"{235_000_000 + k},SHIP {k},{speed_kn[k]:.1f},{course[k]:.1f}" if name == "ais" else str(k)
                    file.write(f"{START_S + t},{lat[k]:.6f},{lon[k]:.6f},{own}\n")
    return paths


class Traced(Browser):
    """A browser that keeps the events of its trace."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.trace: list[dict[str, Any]] = []
        self.has_ended = False
        super().__init__(*args, **options)

    def note(self, event: dict[str, Any]) -> None:
        super().note(event)
        if event["method"] == "Tracing.dataCollected":
            self.trace += event["params"]["value"]
        self.has_ended |= event["method"] == "Tracing.tracingComplete"

    def panned(self, seconds: float) -> list[dict[str, Any]]:
        """The trace of a drag there and back."""
        self.trace, self.has_ended = [], False
        self.do("Tracing.start", transferMode="ReportEvents", traceConfig={"includedCategories": TRACED})
        self.do("Input.dispatchMouseEvent", type="mousePressed", x=500, y=500, button="left", clickCount=1)
        began = time.monotonic()
        while (elapsed := time.monotonic() - began) < seconds:
            x = 500.0 + 250.0 * np.sin(2.0 * np.pi * elapsed / seconds)
            self.do("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=500, button="left", buttons=1)
            time.sleep(max(0.0, 0.008 - (time.monotonic() - began - elapsed)))
        self.do("Input.dispatchMouseEvent", type="mouseReleased", x=500, y=500, button="left", clickCount=1)
        self.do("Tracing.end")
        while not self.has_ended:
            self.note(self.chromium.message())
        return self.trace


def frames(trace: list[dict[str, Any]]) -> tuple[float, np.ndarray]:
    """Frames drawn per second, and (k,) milliseconds of the page's scripts for each."""
    drawn = np.sort([event["ts"] for event in trace if event["name"] == FRAME]) / 1e6
    scripts = np.array([event.get("dur", 0) for event in trace if event["name"] == WORK]) / 1e3
    return (len(drawn) - 1) / float(np.ptp(drawn)), scripts


def tasks(trace: list[dict[str, Any]]) -> np.ndarray:
    """(k,) milliseconds of the processor for each task of the page's thread."""
    threads = [(event["pid"], event["tid"]) for event in trace if event["name"] == WORK]
    page = max(set(threads), key=threads.count)
    return np.array([e.get("tdur", 0) for e in trace if e["name"] == TASK and (e["pid"], e["tid"]) == page]) / 1e3


def table(ships: int, seconds: float, seed: int) -> Iterator[Table]:
    """The table of all zooms."""
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [
            sys.executable,
            "-m",
            "sameas",
            "watch",
            *map(str, write_reports(folder, ships, seed)),
            "--port",
            "0",
        ]
        with (folder / "said.txt").open("w+") as said:
            watch = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT)
            try:
                with Traced(_address(watch, folder / "said.txt")) as page:
                    page.until(f"mapPage.live && mapPage.now && mapPage.now.marks.length >= {int(0.95 * ships)}", 120.0)
                    scale = page.js("mapPage.view.scale")
                    for zoom in ZOOMS:
                        page.js(f"mapPage.view.scale = {scale * zoom}; mapPage.paint()")
                        page.settle()
                        trace = page.panned(seconds)
                        (per_s, scripts), task_ms = frames(trace), tasks(trace)
                        rows.append([zoom, page.js("mapPage.now.rows.length"), per_s, float(np.median(scripts)),
                                     float(np.quantile(scripts, 0.99)), float(task_ms.max()),
                                     int((task_ms > FRAME_MS).sum())])  # fmt: skip
            finally:
                watch.terminate()
                watch.wait(20)
    yield Table(
        f"The live map of {ships} ships while it is dragged",
        ("zoom", "objects", "frames a second", "ms of scripts a frame", "p99", "longest task", "tasks > frame"), rows,
        ("of the trace of a headless Chromium without a graphics card; a picture of the ships every second",),
    )  # fmt: skip


def _address(watch: subprocess.Popen[bytes], said: Path, patience_s: float = 120.0) -> str:
    """The address that the watch prints."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end and watch.poll() is None:
        found = [word for word in said.read_text().split() if word.startswith("http://")]
        if found:
            return found[0].rstrip(".,;")
        time.sleep(0.1)
    raise RuntimeError(f"the watch has no address: {said.read_text()}")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench map_frames", description=__doc__)
    parser.add_argument("--ships", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=5.0, help="of each drag (default 5)")
    options = parser.parse_args()
    if CHROMIUM is None:
        print("Chromium is missing")
        return
    report("map_frames", table(options.ships, options.seconds, 0))


if __name__ == "__main__":
    main()
