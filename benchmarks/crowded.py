"""A crowded Hubble frame, the core of 47 Tucanae, matched with itself.

The frame is detected twice with different settings. The two lists are matched as they are, and with the second one
displaced by 0.3 px and thinned by 30 %. Truth: the nearest detection within half a width is the same star. Printed are
double claims and the stated probabilities against this truth.

    python benchmarks/crowded.py [j8bt06nyq_flt.fits]     # of Debian's python-drizzle-testdata (apt install it)
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sameas.estimate.match import match
from sameas.sky.frame.detect import Detection, detect
from sameas.sky.frame.image import read
from sameas.sky.frame.measurements import Measurements

FRAME = Path("/usr/share/python-drizzle/test_data/j8bt06nyq_flt.fits")
SETTINGS = Detection(threshold_sigmas=8.0), Detection(threshold_sigmas=5.0, box_px=32)
SHIFT_PX, KEPT = 0.3, 0.7


def truth(first: Measurements, second: Measurements) -> np.ndarray:
    """(n₁,) row of the same star in the second list, −1 for none: mutual nearest within half a width."""
    one, two = (np.column_stack([m.x_px, m.y_px]) for m in (first, second))
    off, near = cKDTree(two).query(one)
    back = cKDTree(one).query(two)[1]
    return np.where((off < 0.5 * first.psf_fwhm_px) & (back[near] == np.arange(len(one))), near, -1)


def compared(words: str, first: Measurements, second: Measurements, same: np.ndarray) -> list[str]:
    """Lines to print about one match; ``same`` is its truth."""
    began = time.perf_counter()
    result, estimate = match(first.records(), second.records())
    seconds = time.perf_counter() - began
    matches = result.matches
    right = same[matches.rows_1] == matches.rows_2
    twice = len(matches) - len(np.unique(matches.rows_2))
    p = result.p_pair
    true = same[result.rows_1] == result.rows_2
    bins = np.clip((p * 10).astype(int), 0, 9)
    error = sum(abs(p[bins == k].mean() - true[bins == k].mean()) * np.sum(bins == k) for k in np.unique(bins)) / len(p)
    return [
        words,
        f"  identified      {len(matches)} of {len(first)} and {len(second)}, claimed twice {twice}, {seconds:.2f} s",
        f"  wrong           {np.sum(~right)} ({np.mean(~right):.2%}), expected {result.expected_wrong:.1f}; "
        f"true pairs found {np.sum(right) / max(np.sum(same >= 0), 1):.2%}",
        f"  calibration     error of probabilities {error:.4f}, typical error {estimate.typical_scale:.2f} × quoted",
    ]


def main(path: Path) -> None:
    frame = read(path, hdu=1)
    began = time.perf_counter()
    first, second = (detect(frame, settings) for settings in SETTINGS)
    print(f"Detected {len(first)} and {len(second)} stars in {time.perf_counter() - began:.1f} s")
    print("\n".join(compared("The same frame, two settings", first, second, truth(first, second))))
    kept = np.flatnonzero(np.random.default_rng(1).random(len(second)) < KEPT)
    thin = second[kept]
    same = truth(first, thin)
    moved = replace(thin, x_px=thin.x_px + SHIFT_PX)
    print("\n".join(compared(f"Displaced by {SHIFT_PX} px, {1 - KEPT:.0%} omitted", first, moved, same)))


if __name__ == "__main__":
    given = Path(sys.argv[1]) if len(sys.argv) > 1 else FRAME
    if not given.is_file():
        sys.exit(f"{given} does not exist; apt install python-drizzle-testdata, or give the frame")
    main(given)
