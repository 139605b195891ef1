"""The fixed inputs of ``scripts/compare-outputs``: catalogues, frames and files of sensors, made without sameas.

Everything comes from fixed seeds, so that the same packages make the same bytes. :func:`make` is the only door.
"""

from __future__ import annotations

import csv
import gzip
import json
import os
import shutil
import warnings
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import MaskedColumn, Table
from astropy.wcs import WCS

DEG = 3600.0  # arcsec
#: Files of the repository, looked for by name wherever they lie now.
OF_REPOSITORY = ("new-york.csv.gz", "new-york.toml", "ais_sample.nmea", "mode_s_sample.csv", "asterix_oracle.json")
#: Files of the folder that --data names, in folders of its own.
OF_DATA = (
    "ngc188_gaia_2mass/gaia_results.fits", "ngc188_gaia_2mass/2MASS_results.ecsv", "field/HATP-32171220013343.FITS",
    "m67_poss1951/M6707HH.fits", "m67_poss1951/gaia_edr3_m67_r0.5deg.csv", "asteroid_2713/tycho2_field_r0.3deg.csv",
    "asteroid_2713/a-240.000secs.Light.Open.00000012.fit", "asteroid_2713/a-240.000secs.Dark.Open.00000036.fit",
    "asteroid_2713/a-240.000secs.Dark.Open.00000037.fit",
    *(f"field/formats/{name}" for name in ("asu.tsv", "cg18.tsv", "gal.csv", "ipac.tbl", "mrt.txt", "plain.txt",
                                           "sex.cat", "sexa.csv", "viz.tsv", "xmm.csv")),
)  # fmt: skip
#: The time of last change that all inputs get: a catalogue in a folder is known by it.
STAMP = 1_700_000_000


def make(folder: Path, repository: Path, data: Path | None) -> list[str]:
    """Writes all inputs into the folder; the names of those that are absent.

    repository : whose small files are copied. data : folder of larger sets, or None.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _catalogues(folder)
        _deep_catalogues(folder)
        _wrong_catalogues(folder)
        _frames(folder)
        _nights(folder)
    _coast(folder)
    _metres(folder)
    _logs(folder)
    absent = [Path(name).name for name in OF_DATA if data is None or not (data / name).exists()]
    for name in OF_DATA:
        if data is not None and (data / name).exists():
            shutil.copyfile(data / name, folder / Path(name).name)
    for name in OF_REPOSITORY:
        found = sorted(path for place in ("tests", "examples") for path in (repository / place).rglob(name))
        if found:
            shutil.copyfile(found[0], folder / name)
        else:
            absent.append(name)
    if "asterix_oracle.json" not in absent:
        records = json.loads((folder / "asterix_oracle.json").read_text())["records"]
        for number, record in enumerate(records):
            (folder / f"block{number}.ast").write_bytes(bytes.fromhex(record["block"]))
    else:
        absent += [f"block{number}.ast" for number in range(3)]
    if "new-york.csv.gz" not in absent:
        _harbour(folder)
    else:
        absent += ["harbour-ais.csv", "harbour-radar.csv", "harbour.toml"]
    for path in folder.rglob("*"):
        os.utime(path, (STAMP, STAMP))
    return absent


# ---- catalogues ----


def _field(n: int, seed: int) -> Table:
    """n of 120 stars, observed with errors of 0.1 arcsec."""
    truth, noise = np.random.default_rng(1), np.random.default_rng(seed)
    ra, dec = truth.uniform(10.0, 10.4, 120)[:n], truth.uniform(-0.2, 0.2, 120)[:n]
    magnitude = truth.uniform(10.0, 18.0, 120)[:n]
    return Table(
        {
            "name": [f"s{k}" for k in range(n)], "ra": ra + noise.normal(0, 0.1, n) / DEG,
            "dec": dec + noise.normal(0, 0.1, n) / DEG, "sigma": np.full(n, 0.1),
            "mag": np.round(magnitude + noise.normal(0, 0.05, n), 3),
        },
        units={"ra": "deg", "dec": "deg", "sigma": "arcsec", "mag": "mag"},
    )  # fmt: skip


def _save(table: Table, path: Path) -> None:
    kind = {".vot": "votable", ".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".parquet": "parquet", ".fits": "fits"}
    if path.suffix == ".parquet":
        import pyarrow
        import pyarrow.parquet

        columns = {name: np.asarray(table[name]) for name in table.colnames}
        pyarrow.parquet.write_table(pyarrow.table(columns), path)
    else:
        table.write(path, format=kind[path.suffix], overwrite=True)


def _catalogues(folder: Path) -> None:
    """The same small field in every format; a third catalogue; columns of one's own; sides of files."""
    first, second = _field(120, 2), _field(100, 3)
    for kind in ("fits", "vot", "ecsv", "csv", "parquet"):
        _save(first, folder / f"first.{kind}")
        _save(second, folder / f"second.{kind}")
    _save(_field(80, 4), folder / "third.fits")
    shutil.copyfile(folder / "first.csv", folder / "first.dat")
    with gzip.GzipFile(folder / "second.csv.gz", "wb", mtime=0) as packed:
        packed.write((folder / "second.csv").read_bytes())
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU(_field(90, 6), name="STARS"),
                  fits.BinTableHDU(_field(60, 7), name="GALAXIES")]).writeto(folder / "two.fits")  # fmt: skip
    rng, own = np.random.default_rng(8), _field(110, 9)
    own.rename_columns(["name", "ra", "dec", "sigma", "mag"], ["key", "lon", "lat", "major", "bright"])
    own["minor"], own["angle"] = 0.5 * own["major"], rng.uniform(0.0, 180.0, 110)
    own["north"], own["rho"] = 0.8 * own["major"], rng.uniform(-0.6, 0.6, 110)
    own["when"], own["mu_e"], own["mu_n"] = np.full(110, 2004.5), rng.normal(0, 8, 110), rng.normal(0, 8, 110)
    own["plx"], own["rv"] = rng.uniform(0.5, 20.0, 110), rng.normal(0, 30, 110)
    for name, unit in (("minor", "arcsec"), ("angle", "deg"), ("north", "arcsec"), ("mu_e", "mas/yr"),
                       ("mu_n", "mas/yr"), ("plx", "mas"), ("rv", "km/s")):  # fmt: skip
        own[name].unit = unit
    _save(own, folder / "own.fits")
    bare = own["key", "lon", "lat", "major", "bright"]
    _save(bare, folder / "bare.csv")
    holes = Table(_field(120, 2), masked=True)
    holes["sigma"][[0, 1, 2]], holes["ra"][3] = (0.0, -1.0, np.nan), np.nan
    holes["dec"].mask[4], holes["mag"].mask[5:9] = True, True
    _save(holes, folder / "holes.ecsv")


def _deep_catalogues(folder: Path) -> None:
    """1500 stars at 2016 with motions, 1200 of them at 1999.8 with ellipses, doubles, outliers and others; and of 2010.

    A copy of the second is shifted and turned.
    """
    rng, n = np.random.default_rng(21), 1600
    ra, dec = 83.0 + rng.uniform(-0.3, 0.3, n) / np.cos(np.radians(-30.0)), -30.0 + rng.uniform(-0.3, 0.3, n)
    ra[:60], dec[:60] = ra[60:120] + rng.normal(0, 0.8, 60) / DEG, dec[60:120] + rng.normal(0, 0.8, 60) / DEG
    pm_e, pm_n, parallax = rng.normal(3, 15, n), rng.normal(-5, 15, n), rng.exponential(1.5, n) + 0.05
    g, colour = 9.0 + 11.0 * rng.random(n) ** 0.5, rng.normal(1.4, 0.5, n)
    cos_dec = np.cos(np.radians(dec))

    def placed(rows: np.ndarray, year: float, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places in degrees at a year, with errors in arcsec."""
        e, m = pm_e[rows] * (year - 2016.0) / 1000 + east, pm_n[rows] * (year - 2016.0) / 1000 + north
        return ra[rows] + e / DEG / cos_dec[rows], dec[rows] + m / DEG

    one = np.flatnonzero(rng.random(n) < 0.94)
    error = 0.05 * 10 ** (0.2 * np.maximum(g[one] - 15.0, 0.0)) * rng.lognormal(0, 0.2, len(one))  # mas
    rho = rng.uniform(-0.4, 0.4, len(one))
    draw = rng.normal(size=(2, len(one)))
    draw[1] = rho * draw[0] + np.sqrt(1 - rho**2) * draw[1]
    lon, lat = placed(one, 2016.0, *(draw * error / 1000))
    gaia = Table(
        {
            "source_id": 10**17 + 7919 * one.astype(np.int64), "ref_epoch": np.full(len(one), 2016.0), "ra": lon,
            "ra_error": error, "dec": lat, "dec_error": error, "ra_dec_corr": rho, "parallax": parallax[one],
            "parallax_error": error, "pmra": pm_e[one] + rng.normal(0, 0.1, len(one)), "pmra_error": error + 0.1,
            "pmdec": pm_n[one] + rng.normal(0, 0.1, len(one)), "pmdec_error": error + 0.1,
            "phot_g_mean_mag": g[one], "bp_rp": colour[one],
        },
        units={"ra": "deg", "dec": "deg", "ra_error": "mas", "dec_error": "mas", "parallax": "mas", "pmra": "mas/yr",
               "parallax_error": "mas", "pmdec": "mas/yr", "pmra_error": "mas/yr", "pmdec_error": "mas/yr",
               "ref_epoch": "yr", "phot_g_mean_mag": "mag", "bp_rp": "mag"},
    )  # fmt: skip
    few = rng.random(len(one)) < 0.1
    gaia["pmra"], gaia["pmdec"] = MaskedColumn(gaia["pmra"], mask=few), MaskedColumn(gaia["pmdec"], mask=few)
    _save(gaia, folder / "deep.fits")
    _save(gaia, folder / "deep.vot")

    two = np.flatnonzero((rng.random(n) < 0.8) & (g - colour < 17.0 + rng.normal(0, 0.4, n)))
    major = 0.07 * rng.lognormal(0, 0.25, len(two)) * (1.0 + 0.1 * np.maximum(g[two] - 14.0, 0.0) ** 2)
    minor, angle = major * rng.uniform(0.6, 1.0, len(two)), rng.uniform(0.0, 180.0, len(two))
    wide = np.where(rng.random(len(two)) < 0.03, 4.0, 1.15)
    along, across = wide * major * rng.normal(size=len(two)), wide * minor * rng.normal(size=len(two))
    turn = np.radians(angle)
    east, north = np.sin(turn) * along + np.cos(turn) * across, np.cos(turn) * along - np.sin(turn) * across
    lon, lat = placed(two, 1999.8, east, north)
    m = 90
    others = 83.0 + rng.uniform(-0.3, 0.3, m) / np.cos(np.radians(-30.0)), -30.0 + rng.uniform(-0.3, 0.3, m)
    size = len(two) + m
    own = {
        "designation": [f"J{k:06d}" for k in rng.permutation(size)], "RAJ2000": np.concatenate([lon, others[0]]),
        "DEJ2000": np.concatenate([lat, others[1]]), "errMaj": np.concatenate([major, np.full(m, 0.2)]),
        "errMin": np.concatenate([minor, np.full(m, 0.15)]), "errPA": np.concatenate([angle, np.zeros(m)]),
        "Jmag": np.concatenate([g[two] - colour[two], rng.uniform(11, 17, m)]) + rng.normal(0, 0.05, size),
    }  # fmt: skip
    tmass = Table(own, units={"RAJ2000": "deg", "DEJ2000": "deg", "errMaj": "arcsec", "errMin": "arcsec",
                              "errPA": "deg", "Jmag": "mag"})[rng.permutation(size)]  # fmt: skip
    tmass["Ks"] = tmass["Jmag"] - 0.6 + rng.normal(0, 0.1, size)
    _save(tmass, folder / "infrared.vot")
    _save(tmass, folder / "infrared.parquet")
    shifted, (x, y) = tmass.copy(), (tmass["RAJ2000"] - 83.0, tmass["DEJ2000"] + 30.0)
    shifted["RAJ2000"] = 83.0 + x - 2e-4 * y + 1.7 / DEG / np.cos(np.radians(-30.0))
    shifted["DEJ2000"] = -30.0 + y + 2e-4 * x - 0.9 / DEG
    _save(shifted, folder / "shifted.ecsv")

    three = np.flatnonzero((rng.random(n) < 0.7) & (g < 18.5))
    lon, lat = placed(three, 2010.4, *(0.06 * rng.normal(size=(2, len(three)))))
    survey = Table({"objID": three + 5000, "ra": lon, "dec": lat, "err": np.full(len(three), 0.06),
                    "epochMean": np.full(len(three), 2010.4), "rmag": g[three] + 0.1},
                   units={"ra": "deg", "dec": "deg", "err": "arcsec", "rmag": "mag"})  # fmt: skip
    _save(survey, folder / "survey.fits")


def _wrong_catalogues(folder: Path) -> None:
    """What is to be refused, each for one reason."""

    def changed(name: str, change: object) -> None:
        table = _field(120, 2)
        result = change(table)  # type: ignore[operator]
        _save(table if result is None else result, folder / f"{name}.fits")

    def twice(table: Table) -> None:
        table["name"][2] = "s1"

    def two_positions(table: Table) -> None:
        table["ALPHA_J2000"], table["DELTA_J2000"] = table["ra"], table["dec"]

    def correlated(table: Table) -> None:
        table["north"], table["rho"] = table["sigma"], np.zeros(120)
        table["rho"][11] = 1.5

    def unitless(table: Table) -> None:
        table["sigma"].unit = None

    def no_errors(table: Table) -> None:
        table["sigma"] = np.nan

    def outside(table: Table) -> None:
        table["dec"][7] = 97.0

    def words(table: Table) -> None:
        table["sigma"] = ["wide"] * 120

    changed("twice", twice)
    changed("positions", two_positions)
    changed("correlated", correlated)
    changed("unitless", unitless)
    changed("hollow", no_errors)
    changed("outside", outside)
    changed("words", words)
    changed("empty", lambda table: table[:0])
    changed("nowhere-ra", lambda table: table.remove_column("ra"))
    changed("unerring", lambda table: table.remove_column("sigma"))
    (folder / "page.csv").write_text("<!DOCTYPE html><html></html>")
    (folder / "nothing.csv").write_text("")
    (folder / "cut.fits").write_bytes((folder / "first.fits").read_bytes()[:7000])
    (folder / "ragged.csv").write_text("name,ra,dec,sigma\ns1,10.1,0.1,0.1\ns2,10.2\ns3,10.3,0.1,0.1\n")
    (folder / "made.csv").write_text("name,ra,dec\ns1,10.1,0.1\n")


# ---- frames ----

SIDE, MIDDLE = 320, (150.0, 20.0)


def _plate(turn_deg: float = 30.0) -> WCS:
    turn, wcs = np.radians(turn_deg), WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], list(MIDDLE), [(SIDE + 1) / 2] * 2
    wcs.wcs.cd = np.array([[-np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]]) * 2.0 / DEG
    return wcs


def _sky(n: int = 400) -> Table:
    rng = np.random.default_rng(31)
    return Table(
        {
            "source_id": np.arange(n) + 10**12,
            "ra": MIDDLE[0] + rng.uniform(-0.13, 0.13, n) / np.cos(np.radians(MIDDLE[1])),
            "dec": MIDDLE[1] + rng.uniform(-0.13, 0.13, n), "ra_error": np.full(n, 20.0),
            "dec_error": np.full(n, 20.0), "pmra": rng.normal(0, 10, n), "pmdec": rng.normal(0, 10, n),
            "pmra_error": np.full(n, 0.1), "pmdec_error": np.full(n, 0.1), "ref_epoch": np.full(n, 2016.0),
            "phot_g_mean_mag": 10 + 9 * rng.random(n) ** 0.5, "bp_rp": rng.normal(0.9, 0.3, n),
        },
        units={"ra": "deg", "dec": "deg", "ra_error": "mas", "dec_error": "mas", "pmra": "mas/yr", "pmdec": "mas/yr",
               "pmra_error": "mas/yr", "pmdec_error": "mas/yr", "ref_epoch": "yr"},
    )  # fmt: skip


def _image(stars: Table, seed: int) -> np.ndarray:
    """A CCD frame of the stars: Gaussian images of 2.6 pixels, a lens with distortion, hot pixels, noise."""
    rng = np.random.default_rng(seed)
    x, y = _plate().all_world2pix(stars["ra"], stars["dec"], 0)
    middle, half = (SIDE - 1) / 2, SIDE / 2
    r2 = ((x - middle) ** 2 + (y - middle) ** 2) / half**2
    x, y = x + 0.6 * r2 * (x - middle) / half, y + 0.6 * r2 * (y - middle) / half
    flux, sigma = 10 ** (0.4 * (22.5 - np.asarray(stars["phot_g_mean_mag"]))), 2.6 / 2.3548
    rows, columns = np.mgrid[:SIDE, :SIDE]
    image = np.full((SIDE, SIDE), 220.0)
    for cx, cy, f in zip(x, y, flux, strict=True):
        near = np.hypot(columns - cx, rows - cy) < 14
        if near.any():
            spread = np.exp(-((columns[near] - cx) ** 2 + (rows[near] - cy) ** 2) / (2 * sigma**2))
            image[near] += f / (2 * np.pi * sigma**2) * spread
    image[rng.integers(0, SIDE, 20), rng.integers(0, SIDE, 20)] += 3000.0
    return np.clip(rng.poisson(image * 1.5) / 1.5 + rng.normal(0, 4.0, image.shape), 0, 65535).astype(np.uint16)


def _frames(folder: Path) -> None:
    stars = _sky()
    _save(stars, folder / "stars.fits")
    unmoved = stars["source_id", "ra", "dec", "phot_g_mean_mag", "pmra", "pmdec"]
    _save(unmoved, folder / "unmoved.ecsv")
    hats = folder / "hats" / "dataset" / "Norder=1" / "Dir=0"
    hats.mkdir(parents=True)
    for k, rows in enumerate(np.array_split(np.arange(len(stars)), 3)):
        _save(stars[rows], hats / f"Npix={k}.parquet")
    (folder / "hats" / "hats.properties").write_text("obs_collection=test\nhats_col_ra=ra\nhats_col_dec=dec\n")
    exposure_cards = {"DATE-OBS": "2016-01-01T12:00:00", "EXPTIME": 60.0, "GAIN": 1.5, "RDNOISE": 6.0}
    solved, image = _plate().to_header(), _image(stars, 32)

    def frame(name: str, pixels: np.ndarray, *headers: dict[str, object] | fits.Header) -> None:
        header = fits.Header()
        for cards in headers:
            header.update(cards)
        fits.PrimaryHDU(pixels, header).writeto(folder / name)

    frame("night.fits", image, solved, exposure_cards)
    frame("later.fits", _image(stars, 33), solved, exposure_cards, {"DATE-OBS": "2016-01-01T12:10:00"})
    frame("aimed.fits", image, exposure_cards, {"OBJCTRA": "10 00 04", "OBJCTDEC": "+20 00 30"})
    frame("blind.fits", image, exposure_cards)
    frame("timeless.fits", image, solved, {"EXPTIME": 60.0})
    frame("nan.fits", np.full((64, 64), np.nan, np.float32), solved, exposure_cards)
    frame("full.fits", np.full((64, 64), 65535, np.uint16), solved, exposure_cards)
    noise = np.random.default_rng(34).normal(100, 5, (96, 96)).astype(np.float32)
    frame("starless.fits", noise, solved, exposure_cards)
    rng = np.random.default_rng(35)
    frame("dark.fits", rng.normal(50, 3, image.shape).astype(np.float32), {"EXPTIME": 60.0})
    frame("flat.fits", rng.normal(20000, 90, image.shape).astype(np.float32), {"EXPTIME": 2.0})
    mask = np.zeros(image.shape, np.uint8)
    mask[100:130, 40:90] = 1
    frame("mask.fits", mask)
    (folder / "torn.fits").write_bytes((folder / "night.fits").read_bytes()[:30_000])


# ---- sensors ----

START = 1_714_605_000.0  # 2024-05-01 23:10 UTC
LAT, LON, NORTH, EAST = 50.6, -1.0, 111_229.0, 70_768.0  # metres per degree there


def _nights(folder: Path) -> None:
    """Detections of two nights of five exposures: stars, movers of the main belt, and false ones."""
    for name, seed, mjd in (("asteroids.ecsv", 61, 60000.3), ("asteroids-before.ecsv", 62, 59999.3)):
        rng = np.random.default_rng(seed)
        stars, movers = rng.uniform(-0.2, 0.2, (150, 2)), rng.uniform(-0.2, 0.2, (12, 2))
        rate = np.column_stack([rng.normal(-0.55, 0.05, 12), rng.normal(0.15, 0.05, 12)])  # arcsec per minute
        rows = []
        for exposure in range(5):
            minutes = 20.0 * exposure + 0.3 * exposure**2
            for kind, place in enumerate((stars, movers + rate * minutes / DEG, rng.uniform(-0.2, 0.2, (40, 2)))):
                shown = place[rng.random(len(place)) < (0.95, 0.9, 1.0)[kind]]
                east, north = (shown + rng.normal(0.0, 0.1 / DEG, shown.shape)).T
                ra = 156.0 + east / np.cos(np.radians(10.0 + north))
                for at in zip(ra, 10.0 + north, rng.uniform(17.0, 20.0, len(ra)), strict=True):
                    rows.append((*at[:2], mjd + minutes / 1440.0, 0.1, at[2], exposure))
        names = ("ra", "dec", "mjd", "sigma", "mag", "exposure")
        table = Table(rows=rows, names=names, units=("deg", "deg", "d", "arcsec", "mag", None))
        _save(table, folder / name)


def _write(path: Path, head: list[str], rows: list[list[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])


def _coast(folder: Path) -> None:
    """AIS and a radar that reads 60 m and 1° too much, of eight ships in two minutes; one ship has no AIS."""
    rng = np.random.default_rng(41)
    place, speed = rng.uniform(-6e3, 6e3, (8, 2)), rng.normal(0.0, 5.0, (8, 2))
    place[1], speed[1] = place[0] + [70.0, 60.0], speed[0] * 0.9
    ais: list[list[object]] = []
    radar: list[list[object]] = []
    plots: list[list[object]] = []
    for t in np.arange(0.0, 120.0, 3.0):
        east, north = (place + speed * t).T
        distance, bearing = np.hypot(east, north), np.degrees(np.arctan2(east, north))
        for k in np.flatnonzero(rng.random(8) < 0.9):
            seen = distance[k] + 60 + 15 * rng.normal(), (bearing[k] + 1.0 + 0.2 * rng.normal()) % 360
            radar.append([START + t, k + 101, f"{seen[0]:.1f}", f"{seen[1]:.2f}"])
            plots.append([START + t, f"{seen[0]:.1f}", f"{seen[1]:.2f}"])
        for _ in range(rng.poisson(0.6)):
            plots.append([START + t, f"{rng.uniform(300, 9000):.1f}", f"{rng.uniform(0, 360):.2f}"])
        for k in range(7):
            if t % 12 == 3 * (k % 4):
                knots, course = np.hypot(*speed[k]) / 0.514444, np.degrees(np.arctan2(*speed[k])) % 360
                spot = [f"{LAT + north[k] / NORTH:.6f}", f"{LON + east[k] / EAST:.6f}"]
                ais.append([START + t, 235000001 + k, *spot, f"{knots:.1f}", f"{course:.1f}", f"SHIP {k}" * (k % 2)])
    head = ["time", "mmsi", "lat", "lon", "sog_kn", "cog_deg", "name"]
    _write(folder / "ais.csv", head, ais)
    _write(folder / "radar.csv", ["time", "track_id", "range_m", "bearing_deg"], radar)
    _write(folder / "plots.csv", ["time", "range_m", "bearing_deg"], plots)
    lines = (folder / "ais.csv").read_text().splitlines()
    lines[4], lines[9] = "ink", lines[9].replace("50.", "fifty ")
    (folder / "inked.csv").write_text("\n".join(lines) + "\n")
    twice: list[list[object]] = [
        [START + t, 235000001, LAT + 0.03 * k, LON, 0.0, 0.0, "TWICE"] for t in range(0, 60, 6) for k in (0, 1)
    ]
    _write(folder / "forged.csv", head, twice)
    words = [dict(zip(head, row, strict=True)) for row in ais]
    (folder / "ais.jsonl").write_text("".join(json.dumps(row, default=float) + "\n" for row in words))
    import pyarrow
    import pyarrow.parquet

    columns = {name: [str(row[k]) if name == "name" else float(row[k]) for row in ais] for k, name in enumerate(head)}  # type: ignore[arg-type]
    pyarrow.parquet.write_table(pyarrow.table(columns), folder / "ais.parquet")
    site = f"site = {{ lat_deg = {LAT}, lon_deg = {LON}, height_m = 20 }}\n"
    errors = "errors = { range_m = 15, range_share = 0, bearing_deg = 0.2, extent_m = 0 }\n"
    radar_toml = f'[sources.radar]\nkind = "marine radar"\n{site}{errors}'
    texts = {
        "sensors": radar_toml,
        "plots": radar_toml.replace("sources.radar", "sources.plots") + "clutter = { per_km2 = 0.003 }\n",
        "files": '[sources.ships]\nfile = "ais.csv"\nkind = "ais"\n[sources.west]\nkind = "marine radar"\n'
        f'{site}{errors}bias = {{ azimuth_deg = 3 }}\nfile = {{ path = "radar.csv" }}\n',
        "opened": "[sources.radar",
        "lidar": radar_toml.replace("radar]", "lidar]"),
        "mistyped": radar_toml.replace("lon_deg", "long_deg"),
        "unit": radar_toml.replace("range_m = 15", 'range_m = "15 m"'),
        "filed": radar_toml + "file = 3\n",
        "kinds": radar_toml.replace("marine radar", "marine rader"),
        "negative": radar_toml.replace("range_m = 15", "range_m = -15"),
    }
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text)


def _metres(folder: Path) -> None:
    """A radar and a camera in metres of their own, and a table of tracks with velocities."""
    rows: list[list[object]] = [[t, 1 + k, 100.0 * k + 2.0 * t, 50.0] for t in range(0, 20, 2) for k in range(3)]
    _write(folder / "flat-radar.csv", ["t", "track_id", "x_m", "y_m"], rows)
    seen = [[row[0], float(np.degrees(np.arctan2(row[2] - 50.0, row[3] + 400.0)))] for row in rows]  # type: ignore[operator]
    _write(folder / "camera.csv", ["t", "bearing_deg"], seen)  # type: ignore[arg-type]
    (folder / "metres.toml").write_text(
        '[sources.flat-radar]\nkind = "marine radar"\nsite = { east_m = 0, north_m = 0 }\n'
        'errors = { position_m = 5 }\n[sources.camera]\nkind = "camera"\nsite = { east_m = 50, north_m = -400 }\n'
    )


def _logs(folder: Path) -> None:
    """Aircraft as two receivers tell them, and the targets of a ship's radar as NMEA."""
    rng, began = np.random.default_rng(51), 1_700_000_000.0
    snapshots, lines = [], []
    for t in range(0, 60, 2):
        seen = []
        for k in range(5):
            lat, lon = 41.3 + 0.05 * k + 0.0019 * t * (1 - 0.3 * k), 2.1 - 0.04 * k + 0.002 * t
            seen.append({
                "hex": f"3c644{k}", "type": "adsb_icao", "flight": f"DLH12{k}  ", "alt_baro": 30000 + 1000 * k,
                "gs": 420.0, "track": 45.0, "lat": round(lat, 5), "lon": round(lon, 5), "nic": 8, "rc": 186,
                "seen_pos": 0.3, "nac_p": 9, "nac_v": 1, "sil": 3,
            })  # fmt: skip
            when = datetime.fromtimestamp(began + t + 0.5, UTC).strftime("%Y/%m/%d,%H:%M:%S.%f")[:-3]
            spot = f"{lat + rng.normal(0, 2e-4):.5f},{lon + rng.normal(0, 2e-4):.5f}"
            lines.append(f"MSG,3,1,1,3C644{k},1,{when},{when},,{30000 + 1000 * k},,,{spot},,,0,0,0,0")
        snapshots.append(json.dumps({"now": began + t, "messages": t, "aircraft": seen}))
    (folder / "roof.json").write_text("\n".join(snapshots) + "\n")
    (folder / "hill.sbs").write_text("\n".join(lines) + "\n")
    arpa = []
    for t in range(0, 60, 3):
        for k in range(3):
            place = f"{2.0 + k + 0.003 * t:.3f},{40.0 + 70 * k:.1f}"
            body = f"RATTM,{k + 1:02d},{place},T,9.0,{90.0 + k:.1f},T,0.0,0.0,N,,T,,2310{t:02d}.00,A"
            check = 0
            for letter in body:
                check ^= ord(letter)
            arpa.append(f"${body}*{check:02X}")
    (folder / "arpa.nmea").write_text("\n".join(arpa) + "\n")
    (folder / "ship.toml").write_text(f"[sources.arpa]\nsite = {{ lat_deg = {LAT}, lon_deg = {LON} }}\n")
    unusable = {
        "blank": "", "headed": "time,lat,lon,mmsi\n", "timeless": "lat,lon,mmsi\n1,2,3\n",
        "kindless": "time,lat,lon\n2024-05-01T12:00:00Z,50,1\n",
        "dayless": "time,lat,lon,mmsi\n23:10:00,50,1,235000001\n",
        "hello": "hello\n", "siteless": "time,track_id,range_m,bearing_deg\n0,1,2,3\n",
    }  # fmt: skip
    for name, text in unusable.items():
        (folder / f"{name}.csv").write_text(text)


def _harbour(folder: Path) -> None:
    """Ten minutes of real AIS off Manhattan, and a radar modelled on the vessels that report often."""
    rng = np.random.default_rng(61)
    with gzip.open(folder / "new-york.csv.gz", "rt", encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["BaseDateTime"] < "2020-06-30T00:10:00"]
    head = ["time", "mmsi", "lat", "lon", "sog_kn", "cog_deg", "name"]
    names = ("BaseDateTime", "MMSI", "LAT", "LON", "SOG", "COG", "VesselName")
    _write(folder / "harbour-ais.csv", head, [[row[name] + "Z" * (name == names[0]) for name in names] for row in rows])
    lat0, lon0, began = 40.6915, -74.0170, datetime(2020, 6, 30, tzinfo=UTC).timestamp()
    radar: list[list[object]] = []
    for number, mmsi in enumerate(sorted({row["MMSI"] for row in rows}), 1):
        own = [row for row in rows if row["MMSI"] == mmsi]
        if len(own) < 6:
            continue
        t = np.array([datetime.fromisoformat(row["BaseDateTime"] + "+00:00").timestamp() for row in own])
        for moment in np.arange(began + 60.0, began + 500.0, 3.0):
            lat, lon = (np.interp(moment, t, [float(row[name]) for row in own]) for name in ("LAT", "LON"))
            east, north = (lon - lon0) * 84_520.0, (lat - lat0) * 111_050.0
            distance = np.hypot(east, north)
            if distance < 7000.0 and t[0] <= moment <= t[-1] and rng.random() < 0.9:
                bearing = (np.degrees(np.arctan2(east, north)) + 1.0 + 0.3 * rng.normal()) % 360
                radar.append([f"{moment:.1f}", number, f"{distance + 50 + 15 * rng.normal():.1f}", f"{bearing:.2f}"])
    radar.sort(key=lambda row: float(str(row[0])))
    _write(folder / "harbour-radar.csv", ["time", "track_id", "range_m", "bearing_deg"], radar)
    (folder / "harbour.toml").write_text(
        f'[sources.harbour-ais]\nkind = "ais"\n[sources.harbour-radar]\nkind = "marine radar"\n'
        f"site = {{ lat_deg = {lat0}, lon_deg = {lon0}, height_m = 25 }}\n"
        "coverage = { range_m = 7000, nearest_m = 60 }\nmisses = { q = 0.1 }\n"
        "errors = { range_m = 15, range_share = 0, bearing_deg = 0.3, extent_m = 8 }\n"
        "clutter = { per_km2 = 0.01 }\ntiming = { period_s = 3 }\n"
    )
