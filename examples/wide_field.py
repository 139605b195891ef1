"""Solve a simulated 10° frame from only a range of scales, and compare with the truth.

The frame shows the sky of 2026: real stars of Gaia and Hipparcos with their motions, lens
distortion, photon and read noise, hot pixels, particle hits. ``scripts/demo`` runs

    python examples/wide_field.py simulate demo-output
    sameas frame demo-output/wide.fits --catalog bright --scale 20,45 -o demo-output
    python examples/wide_field.py judge demo-output

The file contains no pointing. The stars come with ``pip install sameas[demo]``: Gaia's brighter
than G = 10, with motions from Hipparcos.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time

from sameas.io import read_table, replacing, write_table
from sameas.io.catalogues import bright
from sameas.simulate import Camera, GaussianProfile, Lens, SimulatedFrame, frame_of_sky
from sameas.sky import Cone, Pointing, StarField
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

SEED = 20260614
SIDE_PX, SCALE_ARCSEC = 1200, 30.0
#: Sagittarius, in the Milky Way: crowded, at an arbitrary rotation.
RA_DEG, DEC_DEG, TURN_DEG = 277.3, -17.8, 217.0
WHEN, EXPOSURE_S = "2026-06-14T23:10:00", 20.0
CORNER_PX, FWHM_PX = 4.0, 2.1


def true_pointing() -> Pointing:
    """The pointing of the camera, which is not in the file."""
    turn = np.radians(TURN_DEG)
    cd = np.array([[-np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]]) * SCALE_ARCSEC / ARCSEC_PER_RADIAN
    return Pointing(unit_vectors(RA_DEG, DEC_DEG), cd, np.full(2, (SIDE_PX - 1) / 2))


def simulated(seed: int = SEED) -> tuple[SimulatedFrame, StarField]:
    """The frame with its truth, and the stars; ``star`` of the truth is a row of the stars."""
    stars = StarField.of(bright(), Time(WHEN).jyear, near=Cone(RA_DEG, DEC_DEG, 10.0))
    # The error of each position is drawn, so that the truth differs from the catalogue as on the real sky.
    rng = np.random.default_rng(seed)
    off = rng.normal(size=(len(stars), 2)) * np.sqrt(stars.covariance_arcsec[:, [0, 2]]) / 3600
    seen = frame_of_sky(
        rng,
        ra_deg=stars.ra_deg + off[:, 0] / np.cos(np.radians(stars.dec_deg)),
        dec_deg=stars.dec_deg + off[:, 1],
        magnitude=stars.magnitude,
        wcs=true_pointing().to_wcs((SIDE_PX, SIDE_PX)),
        zero_point=17.5,
        lens=Lens(corner_px=CORNER_PX),
        camera=Camera(shape=(SIDE_PX, SIDE_PX), sky_e=400.0, read_noise_e=9.0, hot_pixels=1500, cosmics=40),
        psf=GaussianProfile(fwhm_px=FWHM_PX),
        exposure_s=EXPOSURE_S,
    )
    return seen, stars


def simulate(folder: Path) -> None:
    """Write the frame, as a camera would, and a table of the truth."""
    folder.mkdir(parents=True, exist_ok=True)
    seen, stars = simulated()
    facts, truth = seen.frame.facts, seen.truth
    header = fits.Header({
        "DATE-OBS": WHEN, "EXPTIME": EXPOSURE_S, "GAIN": facts.gain_e_per_adu, "RDNOISE": facts.read_noise_e,
        "SATURATE": facts.saturation_adu,
    })  # fmt: skip
    with replacing(folder / "wide.fits") as draft:
        fits.PrimaryHDU(seen.frame.image.astype(np.uint16), header).writeto(draft, overwrite=True)
    table = Table({
        "source_id": stars.ids[truth.star], "x_px": truth.x_px, "y_px": truth.y_px, "flux_e": truth.flux_e,
        "magnitude": stars.magnitude[truth.star],
    })  # fmt: skip
    write_table(table, folder / "wide-truth.fits", provenance={"seed": SEED})
    print(
        f"Frame of {SIDE_PX} × {SIDE_PX} px with {len(truth)} stars: {folder / 'wide.fits'}, with the truth next to it"
    )


def judge(folder: Path) -> None:
    """Compare the identifications with the truth, and print the error rates."""
    rows, truth = read_table(folder / "wide.stars.fits"), read_table(folder / "wide-truth.fits")
    summary = json.loads((folder / "wide.json").read_text(encoding="utf-8"))
    print("\n".join(comparison(rows, truth, summary)))


def comparison(rows: Table, truth: Table, summary: dict[str, Any]) -> list[str]:
    """Lines to print: pointing error, right and wrong identifications."""
    middle = true_pointing().to_sky(np.full((1, 2), (SIDE_PX - 1) / 2))[0]
    place = summary["place"]
    off = np.linalg.norm(unit_vectors(place["middle_ra_deg"], place["middle_dec_deg"]) - middle) * ARCSEC_PER_RADIAN
    right, wrong, alone = verdicts(rows, truth)
    p = np.ma.filled(rows["p_match"], np.nan)[np.asarray(rows["fate"]) == "identified"]
    bright_truth = np.asarray(truth["magnitude"]) < 9.5
    seen = np.isin(np.asarray(truth["source_id"])[bright_truth], np.asarray(rows["star"][rows["fate"] == "identified"]))
    scatter = summary["residuals"]["scatter_arcsec"]
    return [
        "The wide field compared with the truth",
        f"  pointing              {off:.1f}″ from the truth ({off / SCALE_ARCSEC:.2f} px), odds {place['odds']}",
        f"  identified            {right + wrong}, {wrong} of them wrong ({wrong / max(right + wrong, 1):.2%}); "
        f"expected wrong {np.sum(1 - p):.1f}",
        f"  stars brighter than 9.5  {bright_truth.sum()}, identified {seen.mean():.2%}",
        f"  no star, rightly      {alone[0]} measurements; wrongly {alone[1]}",
        f"  residuals             {scatter[0]:.2f}″ × {scatter[1]:.2f}″ (1σ), "
        f"{max(scatter) / SCALE_ARCSEC:.3f} px; plate of order {summary['plate']['order']}",
    ]


def verdicts(rows: Table, truth: Table, reach_px: float = 1.5) -> tuple[int, int, tuple[int, int]]:
    """Number of right and wrong identifications, and of rightly and wrongly unmatched measurements.

    The true star of a measurement is the one within ``reach_px`` with the most light there; merged stars make one
    measurement.
    """
    from scipy.spatial import cKDTree

    measured = rows[np.isin(rows["fate"], ["identified", "unidentified"])]
    # Stars just beyond the edge are detected too, but are not in the truth.
    known = np.isin(np.ma.filled(measured["star"], 0), np.append(truth["source_id"], 0))
    measured = measured[known]
    place = np.column_stack([truth["x_px"], truth["y_px"]])
    at = np.column_stack([measured["x_px"], measured["y_px"]])
    own = np.zeros(len(at), np.int64)
    for k, near in enumerate(cKDTree(place).query_ball_point(at, reach_px)):
        if near:
            off = np.sum((place[near] - at[k]) ** 2, axis=1)
            light = np.log(truth["flux_e"][near]) - 0.5 * off / (FWHM_PX / 2.355) ** 2
            own[k] = truth["source_id"][near[int(np.argmax(light))]]
    identified = np.asarray(measured["fate"]) == "identified"
    right = int(np.sum(identified & (np.ma.filled(measured["star"], 0) == own)))
    alone = int(np.sum(~identified & (own == 0))), int(np.sum(~identified & (own != 0)))
    return right, int(identified.sum()) - right, alone


if __name__ == "__main__":
    steps: Any = sys.argv[1:]
    if len(steps) != 2 or steps[0] not in ("simulate", "judge"):
        sys.exit("usage: python examples/wide_field.py simulate|judge FOLDER")
    {"simulate": simulate, "judge": judge}[steps[0]](Path(steps[1]))
