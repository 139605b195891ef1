"""The timed calls of other programs on the same arrays, as tasks for ``worker.py`` in the peer's own interpreter.

Only NumPy is imported before a peer is called, so that this module runs in any environment
(``scripts/bench NAME --peer-python nway=../envs/nway/bin/python``).
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import Process
from benchmarks.workload import Arrays

ARCSEC = 206264.80624709636


@dataclass(frozen=True)
class Peer:
    """name : as printed. package, distribution : of a Python package; or program : a command.

    install : the command that installs it.
    """

    name: str
    package: str = ""
    distribution: str = ""
    program: str = ""
    install: str = ""

    def version(self, python: str) -> str | None:
        """Its version in that interpreter, None if missing."""
        if self.program:
            return "installed" if shutil.which(self.program) else None
        code = f"import {self.package}, importlib.metadata as m; print(m.version('{self.distribution}'))"
        done = subprocess.run([python, "-W", "ignore", "-c", code], capture_output=True, text=True, check=False)
        return done.stdout.strip().splitlines()[-1] if done.returncode == 0 and done.stdout.strip() else None


PEERS = {
    "astropy": Peer("astropy match_coordinates_sky", "astropy", "astropy", install="pip install astropy"),
    "scipy": Peer("SciPy cKDTree nearest, 2 workers", "scipy", "scipy", install="pip install scipy"),
    "stilts": Peer("STILTS tmatch2 find=best", program="stilts", install="apt-get install stilts"),
    "nway": Peer("NWAY", "nwaylib", "nway", install='pip install nway "pandas<3"'),
    "lsdb": Peer("LSDB crossmatch", "lsdb", "lsdb", install="pip install lsdb==0.11.1"),
    "stonesoup": Peer("Stone Soup GNNWith2DAssignment", "stonesoup", "stonesoup", install="pip install stonesoup"),
}


@dataclass(frozen=True)
class Interpreters:
    """The interpreter of each peer; the running one unless given."""

    given: dict[str, str]

    @classmethod
    def of(cls, options: list[str]) -> Interpreters:
        """From options NAME=/path/to/python."""
        given = dict(option.partition("=")[::2] for option in options)
        unknown = sorted(set(given) - set(PEERS))
        if unknown or not all(given.values()):
            sys.exit(f"--peer-python {unknown}: give NAME=PYTHON, NAME one of {', '.join(PEERS)}")
        return cls(given)

    def python(self, peer: str) -> str:
        """The interpreter of a peer."""
        return self.given.get(peer, sys.executable)

    def nway(self, function: str, folder: Path, *parameters: float) -> NDArray[np.float64] | None:
        """The array that a function for NWAY (below) writes to ``nway.npy`` of a folder.

        None if NWAY is missing, or if it fails; then the last line of its stderr is printed.
        """
        python = self.python("nway")
        if PEERS["nway"].version(python) is None:
            return None
        code = f"from benchmarks import peers; peers.{function}{(str(folder), *parameters)!r}"
        command, home = [python, "-W", "ignore", "-c", code], Path(__file__).parents[1]
        done = subprocess.run(command, capture_output=True, text=True, cwd=home, check=False)
        if done.returncode:
            reason = (done.stderr.strip() or "no message").splitlines()[-1]
            print(f"NWAY failed: {reason} (it is installed by {PEERS['nway'].install})", file=sys.stderr)
            return None
        return np.asarray(np.load(folder / "nway.npy"))

    def versions(self) -> dict[str, str | None]:
        """The version of every peer, None if missing."""
        return {name: peer.version(self.python(name)) for name, peer in PEERS.items()}


# ---- nearest neighbours ----


def astropy(folder: str) -> Callable[[], int]:
    """The nearest record of the second source to every record of the first, regardless of the errors."""
    import astropy.units as u
    from astropy.coordinates import SkyCoord, match_coordinates_sky

    arrays = Arrays.load(folder)

    def work() -> int:
        first, second = (SkyCoord(*f.T, unit=u.deg) for f in arrays.features)
        index, separation, _ = match_coordinates_sky(first, second)
        return int(np.count_nonzero(separation < 1 * u.arcsec)) + 0 * len(index)

    return work


def scipy(folder: str) -> Callable[[], int]:
    """The nearest record of the second source to every record of the first, by a k-d tree and two threads."""
    from scipy.spatial import cKDTree

    arrays = Arrays.load(folder)

    def work() -> int:
        first, second = arrays.directions()
        _, index = cKDTree(second).query(first, k=1, workers=2)
        return len(index)

    return work


def lsdb(folder: str) -> Callable[[], int]:
    """Nearest neighbour within 3 times the RMS error; making the catalogues from data frames is not timed."""
    import lsdb as package
    import pandas as pd

    arrays = Arrays.load(folder)
    radius = float(3.0 * np.hypot(*(np.sqrt(np.mean(s**2)) for s in arrays.sigmas())))
    frames = [pd.DataFrame({"id": np.arange(len(f)), "ra": f[:, 0], "dec": f[:, 1]}) for f in arrays.features]
    cut = {"partition_rows": 100_000, "highest_order": 10}
    catalogues = [
        package.from_dataframe(frame, ra_column="ra", dec_column="dec", margin_threshold=5.0, **cut) for frame in frames
    ]

    def work() -> int:
        return len(catalogues[0].crossmatch(catalogues[1], radius_arcsec=radius, suffixes=("_1", "_2")).compute())

    return work


# ---- one to one, or with probabilities ----


def stilts(folder: str) -> Process:
    """STILTS, the whole process: FITS in, greedy best pairs out; candidates where separation ≤ 3σ₁ + 3σ₂."""
    tables = stilts_tables(Arrays.load(folder))
    out = Path(folder) / "stilts-out.fits"
    return Process(stilts_command(*tables, out, 3.0), str(out))


def stilts_tables(arrays: Arrays) -> tuple[Path, Path]:
    """Write both sources as FITS tables with columns row, ra, dec, err."""
    from astropy.table import Table

    paths = []
    for side, (features, sigma) in enumerate(zip(arrays.features, arrays.sigmas(), strict=True), start=1):
        path = arrays.folder / f"stilts-{side}.fits"
        columns = [np.arange(len(sigma)), *features.T, sigma]
        Table(columns, names=["row", "ra", "dec", "err"]).write(path, overwrite=True)
        paths.append(path)
    return paths[0], paths[1]


def stilts_command(first: Path, second: Path, out: Path, sigmas: float) -> list[str]:
    """The command that joins two such tables within ``sigmas`` times their errors."""
    values = f"ra dec {sigmas:g}*err"
    return [
        "stilts", "tmatch2", f"in1={first}", f"in2={second}", "matcher=skyerr", "params=1", f"values1={values}",
        f"values2={values}", "find=best", "join=1and2", f"out={out}", "ofmt=fits", "progress=none",
    ]  # fmt: skip


def stilts_pairs(arrays: Arrays, sigmas: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the pairs that STILTS finds."""
    from astropy.table import Table

    out = arrays.folder / "stilts-pairs.fits"
    Process(stilts_command(*stilts_tables(arrays), out, sigmas), str(out))()
    table = Table.read(out)
    return np.asarray(table["row_1"], np.int64), np.asarray(table["row_2"], np.int64)


def nway(folder: str) -> Callable[[], int]:
    """NWAY's Python interface: the probability of every association within 3 times the largest errors."""
    import nwaylib
    from nwaylib.logger import NullOutputLogger

    arrays = Arrays.load(folder)
    density = arrays.densities
    area = len(arrays.features[0]) / (density.common + density.only_1) / 3600.0**2
    without_magnitudes: dict[str, list] = {"mags": [], "maghists": [], "magnames": []}
    tables = [
        {"name": f"T{k}", "ra": f[:, 0], "dec": f[:, 1], "error": s, "area": area} | without_magnitudes
        for k, (f, s) in enumerate(zip(arrays.features, arrays.sigmas(), strict=True), start=1)
    ]
    radius = 3.0 * float(np.hypot(*(s.max() for s in arrays.sigmas())))
    quiet = NullOutputLogger()

    def work() -> int:
        copies = [dict(table) for table in tables]
        return len(nwaylib.nway_match(copies, match_radius=radius, prior_completeness=8 / 9, logger=quiet))

    return work


def nway_pairs(folder: str, area_deg2: float, completeness: float) -> None:
    """Write to ``nway.npy`` the rows of NWAY's most probable associations, of sources with p_any > ½."""
    import nwaylib
    from nwaylib.logger import NullOutputLogger

    arrays = Arrays.load(folder)
    empty: dict[str, list] = {"mags": [], "maghists": [], "magnames": []}
    tables = [
        {"name": f"T{k}", "ra": f[:, 0], "dec": f[:, 1], "error": s, "area": area_deg2} | empty
        for k, (f, s) in enumerate(zip(arrays.features, arrays.sigmas(), strict=True), start=1)
    ]
    radius = 5.0 * float(np.hypot(*(np.quantile(s, 0.99) for s in arrays.sigmas())))
    quiet = NullOutputLogger()
    found = nwaylib.nway_match(tables, match_radius=radius, prior_completeness=completeness, logger=quiet)
    best = (found["match_flag"] == 1) & (found["prob_has_match"] > 0.5) & (found["T2"] >= 0)
    np.save(arrays.folder / "nway.npy", np.array([found["T1"][best], found["T2"][best]], np.int64))


def nway_counterparts(folder: str, area_deg2: float, completeness: float) -> None:
    """Write to ``nway.npy`` every source's most probable counterpart by NWAY with ``--mag OPT:MAG auto``.

    Rows of both sources, p_any and p_i. The magnitudes of the second source are read from ``magnitude.npy``.
    """
    import nwaylib
    from nwaylib.logger import NullOutputLogger

    arrays = Arrays.load(folder)
    magnitude = np.load(arrays.folder / "magnitude.npy")
    (one, two), (sigma_1, sigma_2) = arrays.features, arrays.sigmas()
    tables = [
        {"name": "X", "ra": one[:, 0], "dec": one[:, 1], "error": sigma_1, "area": area_deg2}
        | {"mags": [], "maghists": [], "magnames": []},
        {"name": "OPT", "ra": two[:, 0], "dec": two[:, 1], "error": sigma_2, "area": area_deg2}
        | {"mags": [magnitude], "maghists": [None], "magnames": ["MAG"]},
    ]
    radius = 5.0 * float(np.hypot(sigma_1.max(), sigma_2.max()))
    found = nwaylib.nway_match(
        tables, match_radius=radius, prior_completeness=completeness, store_mag_hists=False, logger=NullOutputLogger()
    )
    best = found[(found["match_flag"] == 1) & (found["OPT"] >= 0)]
    np.save(
        arrays.folder / "nway.npy",
        np.array([best["X"], best["OPT"], best["prob_has_match"], best["prob_this_match"]], np.float64),
    )


def stonesoup(folder: str) -> Callable[[], int]:
    """Stone Soup's global nearest neighbour by 2-D assignment: tracks of one source, detections of the other."""
    from datetime import datetime

    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, RandomWalk
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.updater.kalman import KalmanUpdater

    arrays = Arrays.load(folder)
    (first, second), (s1, s2) = arrays.features, arrays.sigmas()
    d, now = first.shape[1], datetime(2026, 1, 1)
    model = LinearGaussian(d, list(range(d)), np.eye(d) * s2[0] ** 2)
    stationary = CombinedLinearGaussianTransitionModel([RandomWalk(1e-9)] * d)
    hypothesiser = DistanceHypothesiser(
        KalmanPredictor(stationary), KalmanUpdater(model), Mahalanobis(), missed_distance=3.0
    )
    associator = GNNWith2DAssignment(hypothesiser)

    def work() -> int:
        tracks = {Track([GaussianState(x[:, None], np.eye(d) * s**2, now)]) for x, s in zip(first, s1, strict=True)}
        detections = {Detection(x[:, None], now, measurement_model=model) for x in second}
        return len(associator.associate(tracks, detections, now))

    return work
