"""Find a known asteroid on ten simulated frames of a night, name it from its orbit, and report it.

The asteroid is (2713) Luxembourg, at its positions of 18 October 2018 as seen from the Wallace observatory (station
810), at the times of ten real exposures of that night; stars, camera and noise are simulated. ``scripts/demo`` runs

    python examples/asteroid_night.py simulate demo-output/night
    sameas movers demo-output/night/frames --catalog demo-output/night/stars.fits --scale 1.0,1.4 \\
        --elements demo --report demo-output/night/observer.toml -o demo-output/night/movers
    python examples/asteroid_night.py judge demo-output/night

The frames do not mark the asteroid, and give only an approximate pointing.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time

from sameas.io import read_table, replacing, write_table
from sameas.simulate import Camera, Moffat, frame_of_sky
from sameas.sky import Pointing
from sameas.sky.movers.orbits import DEMO, Elements, ephemeris, geocentric_km
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

SEED = 2713
#: Start times of the exposures, and their length; latitude, longitude and height of the station.
NIGHT = "2018-10-18"
STARTS = ("03:01:53.784", "03:14:07.814", "03:30:43.875", "03:42:57.904", "03:51:07.264", "03:57:59.304",
          "04:06:08.663", "04:14:18.010", "04:22:27.375", "04:34:41.402")  # fmt: skip
EXPOSURE_S = 240.0
SITE = (42.61, -71.485, 100.0)
SIDE_PX, SCALE_ARCSEC, TURN_DEG, FWHM_PX = 480, 1.18, 3.0, 2.6
#: Number of stars, their faintest magnitude, magnitude of one electron per second, catalogue position error in mas.
STARS, FAINTEST, ZERO_POINT, CATALOGUE_MAS = 420, 18.5, 22.4, 5.0
OBSERVER = """[observatory]
mpcCode = "810"
[submitter]
name = "J. Doe"
[telescope]
design = "Schmidt-Cassegrain"
aperture = "0.36"
detector = "CCD"
[report]
astCat = "Gaia3"
band = "G"
"""


def where(mjd_utc: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right ascension, declination (degrees) and V of the asteroid from the station."""
    elements = Elements.read(DEMO)
    luxembourg = elements.some(np.flatnonzero(np.array(elements.number) == "2713"))
    there = ephemeris(luxembourg, mjd_utc, geocentric_km(*SITE, mjd_utc))
    return there.ra_deg[0], there.dec_deg[0], there.magnitude[0]


def simulate(folder: Path) -> None:
    """Write the frames, the catalogue of their stars, the observer's file, and the truth."""
    rng = np.random.default_rng(SEED)
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    start = Time([f"{NIGHT}T{at}" for at in STARTS], scale="utc")
    middle = start.mjd + EXPOSURE_S / 2 / 86400.0
    # A star is one point source, the asteroid the sum of five along its path during the exposure.
    steps = np.linspace(-0.4, 0.4, 5)[None] * EXPOSURE_S / 86400.0
    ra, dec, v = (part.reshape(len(middle), -1) for part in where((middle[:, None] + steps).ravel()))
    stars = _stars(rng, ra.mean(), dec.mean())
    turn = np.radians(TURN_DEG)
    cd = np.array([[-np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]]) * SCALE_ARCSEC / ARCSEC_PER_RADIAN
    aim = SkyCoord(ra.mean(), dec.mean(), unit="deg").to_string("hmsdms", sep=" ", precision=0).split(" ")
    aim = " ".join(aim[:3]), " ".join(aim[3:])
    for k, at in enumerate(STARTS):
        # The mount drifts by some pixels from frame to frame.
        origin = (SIDE_PX - 1) / 2 + rng.normal(0.0, 4.0, 2)
        seen = frame_of_sky(
            rng,
            ra_deg=np.concatenate([stars["ra"], ra[k]]), dec_deg=np.concatenate([stars["dec"], dec[k]]),
            magnitude=np.concatenate([stars["phot_g_mean_mag"], v[k] + 2.5 * np.log10(ra.shape[1])]),
            wcs=Pointing(unit_vectors(ra.mean(), dec.mean()), cd, origin).to_wcs((SIDE_PX, SIDE_PX)),
            zero_point=ZERO_POINT, psf=Moffat(FWHM_PX), exposure_s=EXPOSURE_S,
            camera=Camera(shape=(SIDE_PX, SIDE_PX), sky_e=900.0, read_noise_e=14.0, hot_pixels=60, cosmics=8),
        )  # fmt: skip
        facts = seen.frame.facts
        header = fits.Header({
            "DATE-OBS": f"{NIGHT}T{at}", "EXPTIME": EXPOSURE_S, "OBJCTRA": aim[0], "OBJCTDEC": aim[1],
            "GAIN": facts.gain_e_per_adu, "RDNOISE": facts.read_noise_e,
            "SATURATE": facts.saturation_adu, "SITELAT": SITE[0], "SITELONG": SITE[1], "FILTER": "Open",
        })  # fmt: skip
        with replacing(folder / "frames" / f"light-{k + 1:02d}.fits") as draft:
            fits.PrimaryHDU(seen.frame.image.astype(np.uint16), header).writeto(draft, overwrite=True)
    known = rng.normal(0.0, CATALOGUE_MAS / 3.6e6, (2, len(stars)))
    stars["ra"] += known[0] / np.cos(np.radians(stars["dec"]))
    stars["dec"] += known[1]
    write_table(stars, folder / "stars.fits", provenance={"seed": SEED})
    truth = Table({"mjd_utc": middle, "ra_deg": ra[:, 2], "dec_deg": dec[:, 2], "v": v[:, 2]})
    write_table(truth, folder / "truth.csv", provenance={"seed": SEED})
    (folder / "observer.toml").write_text(OBSERVER, encoding="utf-8")
    print(
        f"{len(STARTS)} frames of {SIDE_PX} × {SIDE_PX} px with {len(stars)} stars and (2713) at V {v.mean():.1f}: "
        f"{folder / 'frames'}"
    )


def _stars(rng: np.random.Generator, ra_deg: float, dec_deg: float) -> Table:
    """Stars of the field; their number grows as 10^(0.3 m)."""
    half = 0.62 * SIDE_PX * SCALE_ARCSEC / 3600.0
    return Table({
        "source_id": np.arange(1, STARS + 1),
        "ra": ra_deg + rng.uniform(-half, half, STARS) / np.cos(np.radians(dec_deg)),
        "dec": dec_deg + rng.uniform(-half, half, STARS), "ra_error": np.full(STARS, CATALOGUE_MAS),
        "dec_error": np.full(STARS, CATALOGUE_MAS), "ref_epoch": np.full(STARS, 2018.8),
        "phot_g_mean_mag": FAINTEST + np.log10(rng.uniform(10 ** (0.3 * (10.0 - FAINTEST)), 1.0, STARS)) / 0.3,
    })  # fmt: skip


def judge(folder: Path) -> None:
    """Compare the result with the truth, and print it."""
    print("\n".join(comparison(folder)))


def comparison(folder: Path) -> list[str]:
    """Lines to print: the detections of the first candidate that are the asteroid's, and their position errors."""
    truth, found = read_table(folder / "truth.csv"), read_table(folder / "movers" / "movers.fits")
    tracklets = read_table(folder / "movers" / "tracklets.fits")
    first = found[np.asarray(found["tracklet"]).astype(str) == str(tracklets["tracklet"][0])]
    frame = np.argmin(np.abs(np.asarray(first["mjd_utc"])[:, None] - np.asarray(truth["mjd_utc"])), axis=1)
    north = 3600.0 * (np.asarray(first["dec_deg"]) - truth["dec_deg"][frame])
    east = 3600.0 * (np.asarray(first["ra_deg"]) - truth["ra_deg"][frame]) * np.cos(np.radians(truth["dec_deg"][frame]))
    off = np.hypot(east, north)
    report = (folder / "movers" / "report.txt").read_text(encoding="utf-8").splitlines()
    return [
        "The night compared with the truth",
        f"  candidates            {len(tracklets)}",
        f"  the first             {np.sum(off < 1.0)} of its {len(first)} detections are (2713)'s; "
        f"{len(truth)} frames show it",
        f"  off by                {np.median(off):.2f}″ (median), {np.median(off) / SCALE_ARCSEC:.2f} px",
        f"  report                {sum(line.startswith('02713') for line in report)} lines of 80 columns for it",
    ]


if __name__ == "__main__":
    steps = sys.argv[1:]
    if len(steps) != 2 or steps[0] not in ("simulate", "judge"):
        sys.exit("usage: python examples/asteroid_night.py simulate|judge FOLDER")
    {"simulate": simulate, "judge": judge}[steps[0]](Path(steps[1]))
