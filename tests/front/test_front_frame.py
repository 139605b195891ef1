"""`sameas.match_frame`: a frame against any catalogue input, and the methods of its result."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table

import sameas
from sameas import InputError
from sameas.front.pointing import horizon_doubt
from sameas.io import read_provenance, read_table
from sameas.simulate.frames import Camera, GaussianProfile, Lens, frame_of_sky
from sameas.sky.frame.image import read
from sameas.sky.frame.keywords import Station
from sameas.sky.frame.pointing import Pointing
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

pytest.importorskip("photutils", reason="finding stars needs the extra sameas[frames]")

SIDE, WHERE = 256, (150.0, 20.0)


def stars_of(n):
    rng = np.random.default_rng(2)
    return Table({
        "source_id": np.arange(n) + 1000, "ra": WHERE[0] + rng.uniform(-0.1, 0.1, n) / np.cos(np.radians(20.0)),
        "dec": WHERE[1] + rng.uniform(-0.1, 0.1, n), "ra_error": np.full(n, 20.0), "dec_error": np.full(n, 20.0),
        "ref_epoch": np.full(n, 2016.0), "phot_g_mean_mag": 10 + 8 * rng.random(n) ** 0.5,
    })  # fmt: skip


def pointing():
    return Pointing(unit_vectors(*WHERE), np.diag([-2.0, 2.0]) / ARCSEC_PER_RADIAN, np.full(2, (SIDE - 1) / 2))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The path of a frame of 256 × 256 pixels of 2 arcsec without a solution, and its stars."""
    stars = stars_of(300)
    seen = frame_of_sky(
        np.random.default_rng(3), ra_deg=stars["ra"], dec_deg=stars["dec"], magnitude=stars["phot_g_mean_mag"],
        wcs=pointing().to_wcs((SIDE, SIDE)), zero_point=19.0, lens=Lens(0.3), psf=GaussianProfile(2.6),
        camera=Camera(shape=(SIDE, SIDE)),
    )  # fmt: skip
    path = tmp_path_factory.mktemp("frame") / "m.fits"
    header = fits.Header({"DATE-OBS": "2016-01-01T12:00:00", "EXPTIME": 60.0, "GAIN": 1.5, "RDNOISE": 6.0})
    fits.PrimaryHDU(seen.frame.image.astype(np.uint16), header).writeto(path)
    return path, stars


@pytest.fixture(scope="module")
def found(made):
    path, stars = made
    return sameas.match_frame(path, stars, aim=WHERE, scale=(1.9, 2.1))


@pytest.mark.slow
def test_a_frame_is_matched_with_a_table(found):
    assert len(found) > 50 and len(found.pairs) == len(found)
    assert found.pairs["id_2"].min() >= 1000 and (found.table["fate"] == "identified").sum() == len(found)
    middle = found.wcs.pixel_to_world((SIDE - 1) / 2, (SIDE - 1) / 2)
    assert middle.separation(SkyCoord(*WHERE, unit="deg")).arcsec < 1.0


def test_the_report_describes_the_interpretation_of_the_catalogue(found):
    report = found.report()
    for words in ("Frame: m.fits", "Catalogue: catalogue", "ra_error, dec_error [mas, by convention]",
                  "names of: Gaia archive", "Found in catalogue"):  # fmt: skip
        assert words in report


@pytest.mark.parametrize(
    ("turn_deg", "mirror", "shift_px", "words"),
    [(0.0, 1.0, 0.0, ""), (0.5, 1.0, 15.0, "″ at most, rotated by 0.50°"), (0.0, -1.0, 0.0, "mirrored")],
)
def test_a_wrong_solution_in_the_header_is_named(made, tmp_path, turn_deg, mirror, shift_px, words):
    path, stars = made
    turn, right = np.radians(turn_deg), pointing()
    cd = right.cd @ [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]] @ np.diag([mirror, 1.0])
    wrong = Pointing(right.centre, cd, right.origin_px + np.array([shift_px, 0.0])).to_wcs((SIDE, SIDE))
    image, header = fits.getdata(path, header=True)
    fits.writeto(tmp_path / "m.fits", image, header + wrong.to_header())
    notes = sameas.match_frame(tmp_path / "m.fits", stars).sky.notes
    of_header = [note for note in notes if note.startswith("the plate solution of the header is off by ")]
    assert len(of_header) == bool(words) and words in "".join(of_header)
    # Next to a direction that is given, the header's scale is used.
    assert abs(sameas.match_frame(tmp_path / "m.fits", stars, aim=WHERE).sky.placement.scale_arcsec - 2.0) < 0.01


def test_a_frame_that_its_header_places_elsewhere_is_found_about_the_middle_of_a_small_catalogue(made, tmp_path):
    """Right ascension and declination that were swapped, or a mount that was not synchronised, were refused."""
    path, stars = made
    image, header = fits.getdata(path, header=True)
    fits.writeto(tmp_path / "m.fits", image, header + fits.Header({"RA": WHERE[1], "DEC": 15.0, "SECPIX": 2.0}))
    notes = sameas.match_frame(tmp_path / "m.fits", stars).sky.notes
    assert "doubt: the header points elsewhere; the frame was found about the middle of the catalogue" in notes


@pytest.mark.parametrize(
    ("lon_deg", "words"),
    [
        (-130.0, ""),
        (0.0, "the frame's middle is 18° below the horizon and the Sun 32° above it of the station at this time"),
        (100.0, "the frame's middle is 17° below the horizon of the station at this time: is the time local"),
        (-60.0, "the Sun is 8° above the horizon of the station at this time: is the time local"),
    ],
)
def test_a_time_at_which_the_station_saw_no_stars_there_is_doubted(made, lon_deg, words):
    """Local time, or a longitude of the wrong sign, was believed, and reported with movers. Heights by astropy."""
    frame = read(made[0])
    frame = replace(frame, facts=replace(frame.facts, station=Station(35.0, lon_deg)))
    doubt = horizon_doubt(frame, WHERE)
    assert words in doubt and bool(doubt) == bool(words)


@pytest.mark.slow
def test_a_wide_field_without_time_is_found_on_the_whole_sky_with_stars_that_move(tmp_path):
    """The index of the whole sky asked for the time of the frame, after a search that needs none."""
    rng, n = np.random.default_rng(1), 20_000
    stars = Table({
        "ra": rng.uniform(0, 360, n), "dec": np.degrees(np.arcsin(rng.uniform(-1, 1, n))), "pmra": rng.normal(0, 9, n),
        "pmdec": rng.normal(0, 9, n), "ref_epoch": np.full(n, 2016.0), "phot_g_mean_mag": 9 - rng.exponential(0.9, n),
    })  # fmt: skip
    stars.write(tmp_path / "sky.fits")
    middle = Pointing(unit_vectors(*WHERE), np.diag([-240.0, 240.0]) / ARCSEC_PER_RADIAN, np.full(2, (SIDE - 1) / 2))
    near = SkyCoord(stars["ra"], stars["dec"], unit="deg").separation(SkyCoord(*WHERE, unit="deg")).deg < 15
    seen = frame_of_sky(
        rng, ra_deg=stars["ra"][near], dec_deg=stars["dec"][near], magnitude=stars["phot_g_mean_mag"][near],
        wcs=middle.to_wcs((SIDE, SIDE)), zero_point=17.0, psf=GaussianProfile(2.6), camera=Camera(shape=(SIDE, SIDE)),
    )  # fmt: skip
    fits.writeto(tmp_path / "m.fits", seen.frame.image.astype(np.uint16))
    found = sameas.match_frame(tmp_path / "m.fits", tmp_path / "sky.fits", scale=(200, 280))
    assert len(found) > 50 and any("left at epoch 2016.0" in str(note) for note in found.sky.notes)


def test_stars_and_measurements_are_explained(found):
    pair = found.pairs[3]
    star, measurement = found.explain(pair["id_2"]), found.explain(pair["id_1"], source="measurement")
    assert f"is m.fits {pair['id_1']}" in str(star) and f"is catalogue {pair['id_2']}" in str(measurement)
    assert str(found.explain(row=int(pair["row_2"]))) == str(star)
    with pytest.raises(InputError, match="source is 'x'; give 'measurement' or 'star'"):
        found.explain(1, source="x")


def test_a_wrong_aim_is_told_from_that_of_the_header(made, tmp_path):
    """A wrong --aim was answered with advice on radius, scale and catalogue only."""
    path, stars = made
    image, header = fits.getdata(path, header=True)
    header["OBJCTRA"], header["OBJCTDEC"] = "10 00 00", "+20 00 00"
    fits.PrimaryHDU(image, header).writeto(tmp_path / "aimed.fits")
    with pytest.raises(InputError, match=r"the header's aim, 150\.0\d+ \+20\.0\d+, is 1.* from the one given"):
        sameas.match_frame(tmp_path / "aimed.fits", stars, aim=(WHERE[0], WHERE[1] + 1.0), scale=(1.9, 2.1), radius=0.2)


@pytest.mark.slow
def test_without_magnitudes_the_plot_has_no_empty_panels(made, found):
    """There were two empty panels, with axes from 0 to 1."""
    pytest.importorskip("matplotlib")
    path, stars = made
    plain = stars["source_id", "ra", "dec", "ra_error", "dec_error", "ref_epoch"]
    figure = sameas.match_frame(path, plain, aim=WHERE, scale=(1.9, 2.1)).plot("quality")
    assert len(figure.axes) == 2 < len(found.plot("quality").axes)


@pytest.mark.slow
def test_a_table_or_everything_is_written(found, tmp_path):
    found.write(tmp_path / "stars.fits")
    assert len(read_table(tmp_path / "stars.fits")) == len(found.table)
    assert "sameas.match_frame(" in read_provenance(tmp_path / "stars.fits")["command"]
    pytest.importorskip("matplotlib")
    found.write(tmp_path / "all")
    names = {path.name for path in (tmp_path / "all").iterdir()}
    assert names >= {"m.stars.fits", "m.wcs", "m.reg", "m.json", "m.html", "m.png"}


def test_pictures_and_notebooks(found):
    pytest.importorskip("matplotlib")
    assert found.plot().axes and found.plot("quality").axes
    assert "data:image/png" in found._repr_html_() and len(repr(found).splitlines()) <= 10
    with pytest.raises(InputError, match="there is no plot 'x'; give one of picture, quality"):
        found.plot("x")


@pytest.mark.slow
def test_missing_values_are_named_as_python_arguments(made):
    path, stars = made
    refused: dict[str, dict[str, Any]] = {
        "no plate solution and no aim in the header; give aim=RA,DEC and scale=LO,HI": {},
        "the aim is known, but not the scale; give scale=LO,HI": {"aim": WHERE},
        "match_frame has no option 'aimm'; did you mean aim": {"aimm": WHERE},
        "scale=-1: give arcsec per pixel": {"scale": -1}, "aim='x': give": {"aim": "x"},
        "time=soon: give a date": {"time": "soon", "aim": WHERE, "scale": 2.0},
        "catalogue: no column 'x' for ra": {"ra": "x", "dec": "dec"},
    }  # fmt: skip
    for words, options in refused.items():
        with pytest.raises(InputError, match=words):
            sameas.match_frame(path, stars, **options)
