"""Errors of centroids on simulated frames by `sameas`, sep and photutils, and a test of the stated errors.

Single stars, so that only the centroid is tested. The table has the robust scatter per axis in pixels for faint,
medium and bright stars, the time from pixels, and the scatter of (centroid − truth) over the stated error, 1 if the
stated errors are right. sep states errors for its barycentres only.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable

import numpy as np

from benchmarks.tables import Table, report
from sameas.simulate.frames import Camera, GaussianProfile, Moffat, Profile, SimulatedFrame, Trail, frame_of
from sameas.sky.frame.detect import Detection, detect

#: Positions (n, 2) in pixels, and their errors (n, 2) if stated.
Centroids = tuple[np.ndarray, np.ndarray | None]
BINS = ((5, 15), (15, 100), (100, 1e6))
COLUMNS = ("frame", "by", "found %", "S/N 5–15, px", "15–100, px", "above 100, px", "scatter / stated error", "time, s")


def frames(size: int) -> list[tuple[str, SimulatedFrame]]:
    """Frames of stars on a loose grid, at random places within their pixels."""
    cases: list[tuple[str, Profile, Trail]] = [
        ("Gaussian 3 px", GaussianProfile(3.0), Trail()),
        ("Moffat 3 px", Moffat(3.0), Trail()),
        ("Moffat 5 px", Moffat(5.0), Trail()),
        ("Moffat 1.5 px", Moffat(1.5), Trail()),
        ("Moffat 3 px, trailed 12 px", Moffat(3.0), Trail(12.0, 30.0)),
    ]
    rng = np.random.default_rng(11)
    simulated = []
    for name, psf, trail in cases:
        x, y = (axis.ravel() for axis in np.meshgrid(np.arange(24, size - 24, 48.0), np.arange(24, size - 24, 48.0)))
        x, y = x + rng.uniform(-3, 3, x.size), y + rng.uniform(-3, 3, x.size)
        flux = 10 ** rng.uniform(2.6, 5.2, x.size)
        camera = Camera(shape=(size, size), saturation_e=1e9)
        simulated.append((name, frame_of(rng, x_px=x, y_px=y, flux_e=flux, camera=camera, psf=psf, trail=trail)))
    return simulated


def sameas_windowed(simulated: SimulatedFrame) -> Centroids:
    """sameas: windowed centroids with their errors."""
    measured = detect(simulated.frame, Detection(defects=False))
    return np.column_stack([measured.x_px, measured.y_px]), measured.sigma_px()


def sep_windowed(simulated: SimulatedFrame) -> Centroids:
    """sep: extraction, then winpos with the window of each object's half-light radius, as SExtractor does."""
    import sep

    sky = sep.Background(simulated.frame.image)
    light = simulated.frame.image - sky.back()
    rows = sep.extract(light, 1.5, err=sky.globalrms)
    radius, _ = sep.flux_radius(light, rows["x"], rows["y"], 6.0 * rows["a"], 0.5, subpix=5)
    x, y, _ = sep.winpos(light, rows["x"], rows["y"], 2.0 / 2.35 * radius)
    return np.column_stack([x, y]), None


def sep_barycentre(simulated: SimulatedFrame) -> Centroids:
    """sep: the barycentre of the pixels above the threshold, with the errors it states."""
    import sep

    sky = sep.Background(simulated.frame.image)
    gain = simulated.frame.facts.gain_e_per_adu
    rows = sep.extract(simulated.frame.image - sky.back(), 1.5, err=sky.globalrms, gain=gain)
    return np.column_stack([rows["x"], rows["y"]]), np.sqrt(np.column_stack([rows["errx2"], rows["erry2"]]))


def photutils_windowed(simulated: SimulatedFrame) -> Centroids:
    """photutils: segmentation of the smoothed frame and the catalogue's windowed centroids."""
    from astropy.convolution import convolve
    from photutils.background import Background2D
    from photutils.segmentation import SourceCatalog, detect_sources, make_2dgaussian_kernel

    sky = Background2D(simulated.frame.image, 64)
    light = simulated.frame.image - sky.background
    smooth = convolve(light, make_2dgaussian_kernel(3.0, size=5))
    segments = detect_sources(smooth, 1.0 * sky.background_rms, 5)
    return np.asarray(SourceCatalog(light, segments, convolved_data=smooth).centroid_win), None


def photutils_stars(simulated: SimulatedFrame) -> Centroids:
    """photutils: DAOStarFinder, given the true width."""
    from photutils.background import Background2D
    from photutils.detection import DAOStarFinder

    sky = Background2D(simulated.frame.image, 64)
    rows = DAOStarFinder(3.0 * sky.background_rms_median, 3.0)(simulated.frame.image - sky.background)
    x, y = ("x_centroid", "y_centroid") if "x_centroid" in rows.colnames else ("xcentroid", "ycentroid")
    return np.column_stack([rows[x], rows[y]]), None


METHODS: dict[str, Callable[[SimulatedFrame], Centroids]] = {
    "sameas": sameas_windowed,
    "sep winpos": sep_windowed,
    "sep barycentre": sep_barycentre,
    "photutils centroid_win": photutils_windowed,
    "photutils DAOStarFinder": photutils_stars,
}


def row(name: str, simulated: SimulatedFrame, method: str) -> list[object]:
    """One row of the table."""
    from scipy.spatial import cKDTree

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            METHODS[method](simulated)
            start = time.perf_counter()
            xy, sigma = METHODS[method](simulated)
            seconds = time.perf_counter() - start
    except ImportError as error:
        return [name, method, f"not installed: {error.name}", None, None, None, None, None]
    truth = np.column_stack([simulated.truth.x_px, simulated.truth.y_px])
    finite = np.isfinite(xy).all(axis=1)
    xy, sigma = xy[finite], None if sigma is None else sigma[finite]
    distance, nearest = cKDTree(xy).query(truth, distance_upper_bound=3.0)
    hit = np.isfinite(distance)
    error = xy[nearest[hit]] - truth[hit]
    # S/N of a matched filter, the same for all methods.
    camera_noise = np.sqrt(136.0 * 4 * np.pi * (3.0 / 2.355) ** 2)
    snr = simulated.truth.flux_e[hit] / np.sqrt(camera_noise**2 + simulated.truth.flux_e[hit])
    scatter = [_robust(error[(snr >= low) & (snr < high)]) for low, high in BINS]
    chi = None if sigma is None else _robust(error / sigma[nearest[hit]])
    return [name, method, 100 * float(hit.mean()), *scatter, chi, seconds]


def _robust(values: np.ndarray) -> float | None:
    return 1.4826 * float(np.median(np.abs(values))) if len(values) > 3 else None


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=2048, help="rows and columns of the frames")
    options = parser.parse_args()
    rows = [row(name, simulated, method) for name, simulated in frames(options.size) for method in METHODS]
    report("centroids", [Table("Centroids of single stars", COLUMNS, rows)])


if __name__ == "__main__":
    main()
