"""`sameas frame`: from a file to a table, a solution, regions, pictures and a page; many frames; bad frames."""

from __future__ import annotations

import http.server
import json
import re
import threading
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import parse_qs

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table, vstack
from astropy.wcs import WCS

from browser import CHROMIUM, Browser
from sameas.errors import InputError
from sameas.io import read_provenance, read_table, write_table
from sameas.io.catalogues import COLUMNS, GaiaArchive, catalogue, rounded
from sameas.report.frame import frame_lines, frames_lines
from sameas.simulate.frames import Camera, GaussianProfile, Lens, frame_of_sky
from sameas.sky.catalogue import CatalogueOptions
from sameas.sky.frame.field import Cone
from sameas.sky.frame.pointing import Pointing
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

pytest.importorskip("photutils", reason="finding stars needs the extra sameas[frames]")
pytest.importorskip("matplotlib", reason="plots need the extra sameas[plots]")

SIDE = 320
WHERE = (150.0, 20.0)


@dataclass(frozen=True)
class Files:
    folder: Path
    frame: Path
    stars: Path
    wcs: WCS


def pointing(turn_deg: float = 30.0) -> Pointing:
    turn = np.radians(turn_deg)
    cd = np.array([[-np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]]) * 2.0 / ARCSEC_PER_RADIAN
    return Pointing(unit_vectors(*WHERE), cd, np.full(2, (SIDE - 1) / 2))


def sky(n: int = 400) -> Table:
    rng = np.random.default_rng(2)
    table = Table({
        "source_id": np.arange(n) + 10**12, "ra": WHERE[0] + rng.uniform(-0.13, 0.13, n) / np.cos(np.radians(20.0)),
        "dec": WHERE[1] + rng.uniform(-0.13, 0.13, n), "ra_error": np.full(n, 20.0), "dec_error": np.full(n, 20.0),
        "pmra": rng.normal(0, 10, n), "pmdec": rng.normal(0, 10, n), "pmra_error": np.full(n, 0.1),
        "pmdec_error": np.full(n, 0.1), "ref_epoch": np.full(n, 2016.0),
        "phot_g_mean_mag": 10 + 9 * rng.random(n) ** 0.5, "bp_rp": rng.normal(0.9, 0.3, n),
    })  # fmt: skip
    return table


def picture(path: Path, table: Table, seed: int = 3, *, solved: bool = True, **cards: object) -> Path:
    seen = frame_of_sky(
        np.random.default_rng(seed), ra_deg=table["ra"], dec_deg=table["dec"], magnitude=table["phot_g_mean_mag"],
        wcs=pointing().to_wcs((SIDE, SIDE)), zero_point=19.0, lens=Lens(0.6), psf=GaussianProfile(2.6),
        camera=Camera(shape=(SIDE, SIDE), hot_pixels=20),
    )  # fmt: skip
    header = pointing().to_wcs((SIDE, SIDE)).to_header() if solved else fits.Header()
    header.update({"DATE-OBS": "2016-01-01T12:00:00", "EXPTIME": 60.0, "GAIN": 1.5, "RDNOISE": 6.0, **cards})
    fits.PrimaryHDU(seen.frame.image.astype(np.uint16), header).writeto(path, overwrite=True)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Files:
    folder = tmp_path_factory.mktemp("frames")
    table = sky()
    write_table(table, folder / "stars.fits", provenance={})
    return Files(folder, picture(folder / "night.fits", table), folder / "stars.fits", pointing().to_wcs())


@pytest.fixture(scope="module")
def done(files, tmp_path_factory):
    """The output folder of one frame, and the printed text."""
    from typer.testing import CliRunner

    from sameas.cli.app import app

    out = tmp_path_factory.mktemp("out")
    arguments = ["frame", files.frame, "-c", files.stars, "-o", out, "--wcs-copy"]
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    return out, result.stdout


@pytest.mark.slow
def test_the_printed_text_gives_position_counts_and_assumptions(done):
    _, text = done
    for words in (
        "placed", "by                    the header's plate solution, odds 10^", "scale                 2.0",
        "measurements ", "missing stars", "expected wrong", "zero point", "half as many at magnitude",
        "assumed               times are UTC", "night.html", "night.json",
    ):  # fmt: skip
        assert " ".join(words.split()).lower() in " ".join(text.split()).lower(), words


@pytest.mark.slow
def test_estimates_are_printed_with_their_standard_errors(done):
    out, text = done
    facts, words = json.loads((out / "night.json").read_text())["estimated"], " ".join(text.split())
    assert all(error > 0.0 for _, error in facts.values())
    assert re.search(r"only in one catalogue [\d.]+ ± [\d.]+ of the frame and [\d.]+ ± [\d.]+ of the catalogue", words)
    assert re.search(r"errors (as quoted|quoted) ", words) and {"error_scale"} <= set(facts)


def test_errors_of_frame_and_catalogue_are_reported_as_for_a_match(done):
    out, text = done
    facts = json.loads((out / "night.json").read_text())
    assert "fewer than 200 pairs" in facts["error_note"] and "by source fewer than 200 pairs" in " ".join(text.split())
    alike = {"error_factor_both": [1.71, 0.04], "error_floor_instead_arcsec": [0.31, 0.02]}
    words = frame_lines(facts | {"estimated": alike, "error_note": "whose cannot be told"})
    assert (
        "by source those of both × 1.710 ± 0.040, or, with both as quoted, floor in quadrature on each axis: "
        "0.310 ± 0.020 arcsec; whose cannot be told"
    ) in " ".join(" ".join(words).split())
    apart = frame_lines(facts | {"estimated": {"error_factor_frame": [1.4, 0.1]}, "error_note": ""})
    assert "by source those of night.fits × 1.40 ± 0.10 " in " ".join(" ".join(apart).split())


def test_doubts_of_several_frames_are_listed_once():
    def summary(name, *notes):
        return {"frame": name, "catalogue": "stars", "understood": ["epoch: 2016.0"], "notes": notes,
                "exposure": {"read": ("exposure 240 s", "doubt: the gain is not known")}}  # fmt: skip

    lines = frames_lines(
        [summary("a.fits", "doubt: 0.19 arcsec was assumed"), summary("b.fits", "doubt: 0.2 arcsec was assumed")]
    )
    assert [" ".join(line.split()) for line in lines] == [
        "", "Catalogue: stars", "epoch 2016.0",
        "doubt 2 frames, the first a.fits: the gain is not known",
        "doubt 2 frames, the first a.fits: 0.19 arcsec was assumed",
    ]  # fmt: skip
    assert frames_lines([]) == []


@pytest.mark.slow
def test_doubts_about_the_catalogue_are_reported_with_the_frame(files, sameas, tmp_path):
    table = sky()
    table["pmra"], table["pmdec"] = 3.0, -2.0
    table.remove_columns([name for name in table.colnames if name in ("pmra_error", "pmdec_error")])
    write_table(table, tmp_path / "moving.fits", provenance={})
    options = "--no-page", "--no-picture", "-o", tmp_path / "out"
    text = " ".join(sameas("frame", files.frame, "-c", tmp_path / "moving.fits", *options).stdout.split())
    assert "doubt pmra has no column of errors" in text and "--pm-sigma" in text


def test_the_table_agrees_with_the_truth_and_has_its_provenance(done):
    out, _ = done
    rows, truth = read_table(out / "night.stars.fits"), sky()
    found = rows[rows["fate"] == "identified"]
    row = np.searchsorted(truth["source_id"], found["star"])
    off = np.hypot(
        (found["ra_deg"] - truth["ra"][row]) * np.cos(np.radians(20.0)), found["dec_deg"] - truth["dec"][row]
    )
    assert len(found) > 90 and np.median(off * 3600) < 0.4
    facts = read_provenance(out / "night.stars.fits")
    assert facts["frame"] == "night.fits" and json.loads(facts["summary"])["found"]["identified"] == len(found)


@pytest.mark.filterwarnings("ignore:The WCS transformation has more axes")
def test_the_solution_is_written_alone_and_into_the_copy(done, files):
    out, _ = done
    rows = read_table(out / "night.stars.fits")
    found = rows[rows["fate"] == "identified"][:50]
    for path in (out / "night.wcs", out / "night.wcs.fits"):
        x, y = WCS(fits.getheader(path)).all_world2pix(found["ra_deg"], found["dec_deg"], 0)
        np.testing.assert_allclose(x, found["x_px"], atol=0.01)
        np.testing.assert_allclose(y, found["y_px"], atol=0.01)
    np.testing.assert_array_equal(fits.getdata(out / "night.wcs.fits"), fits.getdata(files.frame))
    assert fits.getheader(out / "night.wcs.fits")["GAIN"] == 1.5


def test_every_visible_row_has_a_region(done):
    out, _ = done
    lines = (out / "night.reg").read_text().splitlines()
    fate = np.asarray(read_table(out / "night.stars.fits")["fate"])
    assert lines[0].startswith("# Region file format: DS9") and lines[2] == "icrs"
    assert len(lines) - 3 == np.sum(fate != "too faint")
    assert sum(line.startswith("circle") for line in lines) == np.sum(fate == "identified")
    assert not any(";" in line for line in lines[2:])


@pytest.mark.slow
def test_a_second_run_does_nothing_until_something_changes(done, files, sameas):
    out, _ = done
    before = (out / "night.json").stat().st_mtime_ns
    arguments = ["frame", files.frame, "-c", files.stars, "-o", out, "--wcs-copy"]
    assert "done before" in sameas(*arguments).stdout
    assert (out / "night.json").stat().st_mtime_ns == before
    assert "done before" not in sameas(*arguments, "--brightest", 41, "--no-page", "--no-picture").stdout


@pytest.mark.slow
def test_one_failing_frame_does_not_stop_the_others(files, sameas, tmp_path):
    good = [picture(tmp_path / f"n{k}.fits", sky(), seed=k) for k in (1, 2)]
    (tmp_path / "bad.fits").write_bytes(good[0].read_bytes()[:30_000])
    out = tmp_path / "out"
    arguments = [
        "frame",
        good[0],
        tmp_path / "bad.fits",
        good[1],
        "-c",
        files.stars,
        "-o",
        out,
        "--no-page",
        "--no-picture",
    ]
    result = sameas(*arguments, "-j", 1, exit_code=1)
    assert "Frames: 3; 2 done, 1 failed" in result.stdout
    assert re.search(r"bad: bad\.fits: the file is cut short", result.stderr)
    assert {path.name for path in out.glob("*.json")} == {"n1.json", "n2.json"}
    assert "Frames: 3; 0 done, 2 done before, 1 failed" in sameas(*arguments, "-j", 1, exit_code=1).stdout


@pytest.mark.long
def test_two_processes_write_the_same_as_one(files, sameas, tmp_path):
    frames = [picture(tmp_path / f"n{k}.fits", sky(), seed=k) for k in (1, 2)]
    for processes in (1, 2):
        out = tmp_path / f"by{processes}"
        sameas("frame", *frames, "-c", files.stars, "-o", out, "--no-page", "--no-picture", "-j", processes)
    for path in (tmp_path / "by1").glob("*.reg"):
        assert path.read_text() == (tmp_path / "by2" / path.name).read_text()


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "times"), [(1.0, "2"), (8.0, "0.25"), (2.0 * 0.63, "1.6")])
@pytest.mark.long_after(1)
def test_a_scale_without_the_binning_of_the_pixels_is_found_and_doubted(files, sameas, tmp_path, scale, times):
    """Binned pixels and reducers of the focal length were refused."""
    where = {"SECPIX": scale, "RA": WHERE[0], "DEC": WHERE[1]}
    frame = picture(tmp_path / "binned.fits", read_table(files.stars), solved=False, **where)
    out = tmp_path / "out"
    shown = sameas("frame", frame, "--catalog", files.stars, "-o", out, "--no-page", "--no-picture")
    summary = json.loads((out / "binned.json").read_text())
    assert summary["place"]["scale_arcsec_per_px"] == pytest.approx(2.0, rel=0.01)
    assert f"the pixels are {times} times as large as the header says" in " ".join(shown.stdout.split())


def test_a_catalogue_of_a_small_field_is_the_aim_of_a_frame_without_one(files, sameas, tmp_path):
    """A search of the whole sky was refused for want of stars."""
    bare = picture(tmp_path / "bare.fits", sky(), solved=False)
    more = ["-c", files.stars, "-o", tmp_path / "out", "--no-page", "--no-picture"]
    text = " ".join(sameas("frame", bare, *more, "--scale", "1.6,2.4").stdout.split())
    assert "by the aim, odds 10^" in text
    assert "assumed the aim is the middle of the catalogue" in text


def test_a_picture_does_not_replace_the_photograph_it_is_of(files, refusal, tmp_path):
    pictures = pytest.importorskip("PIL.Image", reason="reading photographs needs Pillow")
    pictures.fromarray(np.zeros((40, 60), np.uint8)).save(tmp_path / "night.png")
    shown = refusal("frame", tmp_path / "night.png", "-c", files.stars, "-o", tmp_path)
    assert "night.png: the picture would replace this frame; give another output folder" in shown


def test_an_aim_and_a_scale_place_a_frame_without_a_solution(files, sameas, tmp_path):
    bare = picture(tmp_path / "bare.fits", sky(), solved=False)
    more = ["-c", files.stars, "-o", tmp_path / "out", "--no-page", "--no-picture"]
    for aim in ("150.02,20.01", "10:00:04.8,+20:00:36"):
        text = sameas("frame", bare, *more, "--aim", aim, "--scale", "1.6,2.4", "--again").stdout
        assert "by                    the aim, odds 10^" in text


BARE = {"solved": False}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cards", "options", "words"),
    [
        (BARE, (), r"bare\.fits: no plate solution and no aim in the header; give --aim RA,DEC and --scale LO,HI"),
        (BARE, ("--aim", "150,20"), r"bare\.fits: the aim is known, but not the scale; give --scale LO,HI"),
        (BARE, ("--aim", "150,20", "--scale", "3,3.3", "--radius", "0.02"), "no solution: by the aim .* odds 1:"),
        (BARE, ("--aim", "15,20", "--scale", "1.6,2.4"), r"stars: 0 stars within .* cover the field\?"),
        ({}, ("--epoch", "when"), r"no column 'when' for --epoch"),
        ({}, ("--threshold", "1e6"), r"bare\.fits: no star above 1e\+06σ"),
        ({}, ("--aim", "here"), "--aim here: give RA,DEC in degrees"),
        ({}, ("--scale", "3,2"), "--scale 3,2: give LO,HI in arcsec per pixel"),
        ({}, ("--time", "noon"), "--time noon: give a date such as"),
        ({}, ("--catalog", "nowhere.fits"), r"nowhere\.fits: no such file"),
    ],
)
def test_impossible_requests_give_one_clear_line(files, refusal, tmp_path, cards, options, words):
    frame = picture(tmp_path / "bare.fits", sky(), **cards)
    arguments = ["frame", frame, "-o", tmp_path / "out", *options]
    if "--catalog" not in options:
        arguments += ["-c", files.stars]
    assert re.search(words, refusal(*arguments))
    assert not list((tmp_path / "out").glob("*")) if (tmp_path / "out").exists() else True


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.full((64, 64), np.nan, np.float32), "no pixel is a finite number"),
        (np.full((64, 64), 65535, np.uint16), "all pixels have the value 65535"),
        (np.random.default_rng(1).normal(100, 5, (96, 96)).astype(np.float32), "A plate solution needs|no star above"),
    ],
    ids=["nan", "saturated", "no stars"],
)
def test_bad_images_give_one_clear_line(files, refusal, tmp_path, image, words):
    header = pointing().to_wcs().to_header()
    header["DATE-OBS"] = "2016-01-01T12:00:00"
    fits.PrimaryHDU(image, header).writeto(tmp_path / "bad.fits")
    message = refusal("frame", tmp_path / "bad.fits", "-c", files.stars, "-o", tmp_path / "out")
    assert "bad.fits" in message and re.search(words, message)


@pytest.mark.slow
def test_a_catalogue_without_epoch_is_used_as_given_and_doubted_if_it_has_motions(files, sameas, tmp_path):
    table = sky()["source_id", "ra", "dec", "phot_g_mean_mag", "pmra", "pmdec"]
    table["ra"].unit = table["dec"].unit = "deg"
    write_table(table, tmp_path / "moves.ecsv", provenance={})
    more = ["-o", tmp_path / "out", "--no-page", "--no-picture", "--sigma", "0.05"]
    text = sameas("frame", files.frame, "-c", tmp_path / "moves.ecsv", *more).stdout
    assert "its epoch is not stated: 2016.0 was assumed; give --epoch YEAR" in text
    text = sameas("frame", files.frame, "-c", tmp_path / "moves.ecsv", *more, "--pm", "none").stdout
    assert "identified" in text


@pytest.mark.slow
def test_missing_errors_and_times_are_estimated_or_doubted_and_never_required(sameas, tmp_path):
    table = sky()["source_id", "ra", "dec", "phot_g_mean_mag", "pmra", "pmdec", "ref_epoch"]
    table.rename_columns(["source_id", "phot_g_mean_mag"], ["star", "mag"])
    table["ra"].unit = table["dec"].unit = "deg"
    write_table(table, tmp_path / "bare.ecsv", provenance={})
    undated: dict[str, Any] = {"DATE-OBS": ""}
    frame = picture(tmp_path / "timeless.fits", sky(), **undated)
    more = ["-o", tmp_path / "out", "--no-page", "--no-picture"]
    text = re.sub(r"\s+", " ", sameas("frame", frame, "-c", tmp_path / "bare.ecsv", *more).stdout)
    assert re.search(r"no position errors; 0\.0\d+ arcsec on each axis was assumed, estimated from the residuals", text)
    assert "give --sigma ARCSEC or --sigma COLUMN" in text
    assert "left at epoch 2016.0; give --time DATE" in text


@pytest.mark.parametrize("where", [{"RA": WHERE[0], "DEC": WHERE[1]}, {"RA": WHERE[0] / 15, "DEC": WHERE[1]}])
def test_a_solution_of_another_field_does_not_widen_the_cone_around_the_aim(sameas, tmp_path, monkeypatch, where):
    cones = []

    def near(name, cone, *_, **__):
        cones.append(cone)
        write_table(sky()[np.abs(sky()["dec"] - cone.dec_deg) < cone.radius_deg], tmp_path / "near.fits", provenance={})
        return catalogue(str(tmp_path / "near.fits"), None)

    monkeypatch.setattr("sameas.front.framing.catalogue", near)
    header = pointing().to_wcs((SIDE, SIDE)).to_header()
    header["CRVAL1"], header["CRVAL2"] = 40.0, -30.0
    frame = picture(tmp_path / "elsewhere.fits", sky(), solved=False, **header, **where)
    printed = sameas("frame", frame, "-c", "gaia", "-o", tmp_path / "out", "--no-page", "--no-picture").output
    assert max(cone.radius_deg for cone in cones) < 3.0
    assert "identified" in printed and "the plate solution of the header is off by" in " ".join(printed.split())


def test_a_refusal_names_the_aims_of_the_header_that_cannot_be(refusal, tmp_path):
    frame = picture(tmp_path / "zero.fits", sky(), solved=False, RA=0.0, DEC=0.0, PIXSCALE=2.0)
    said = refusal("frame", frame, "-c", "gaia", "-o", tmp_path / "out")
    assert "header: RA and DEC are 0, as of a mount that was not set; not used" in said


def test_only_the_cone_is_read_from_a_folder_of_parquet(tmp_path):
    folder = tmp_path / "hats"
    for k, part in enumerate(np.array_split(np.arange(400), 3)):
        path = folder / "dataset" / "Norder=1" / "Dir=0" / f"Npix={k}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_table(sky()[part], path, provenance={})
    (folder / "hats.properties").write_text("obs_collection=test\nhats_col_ra=ra\nhats_col_dec=dec\n")
    whole = catalogue(str(folder), None)
    near = catalogue(str(folder), Cone(*WHERE, 0.03))
    assert len(whole) == 400 and 0 < len(near) < 60
    assert np.abs(near.astrometry.dec_deg - WHERE[1]).max() <= 0.03
    with pytest.raises(InputError, match="no stars there; does the catalogue cover the field"):
        catalogue(str(folder), Cone(10.0, -50.0, 0.1))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="the folder has no Parquet files"):
        catalogue(str(tmp_path / "empty"), None)


class Archive(http.server.BaseHTTPRequestHandler):
    """Fake TAP service: creates, runs, reports, returns and deletes jobs."""

    asked: ClassVar[list[str]]

    def log_message(self, *_):
        pass

    def reply(self, body: bytes, code: int = 200, kind: str = "text/xml", **headers: str) -> None:
        self.send_response(code)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(body)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def do_POST(self):
        sent = parse_qs(self.rfile.read(int(self.headers["Content-Length"] or 0)).decode())
        if self.path.endswith("/async"):
            self.asked.append(sent["QUERY"][0])
        self.reply(b"", 303, Location=f"http://{self.headers['Host']}/tap/async/1")

    def do_DELETE(self):
        self.reply(b"", 303, Location=f"http://{self.headers['Host']}/tap/async")

    def do_GET(self):
        if self.path.endswith("/results/result"):
            import io

            table = sky()
            for name in COLUMNS:
                if name not in table.colnames:
                    table[name] = np.full(len(table), np.nan)
            out = io.BytesIO()
            table[list(COLUMNS)].write(out, format="votable")
            self.reply(out.getvalue(), kind="application/x-votable+xml")
            return
        base = f"http://{self.headers['Host']}/tap/async/1"
        self.reply(
            f'<?xml version="1.0"?><uws:job xmlns:uws="http://www.ivoa.net/xml/UWS/v1.0" '
            f'xmlns:xlink="http://www.w3.org/1999/xlink" version="1.1"><uws:jobId>1</uws:jobId>'
            f"<uws:phase>COMPLETED</uws:phase><uws:results>"
            f'<uws:result id="result" xlink:type="simple" xlink:href="{base}/results/result"/>'
            f"</uws:results></uws:job>".encode()
        )


@pytest.fixture
def archive(tmp_path):
    pytest.importorskip("pyvo", reason="the archive needs the extra sameas[archive]")

    class Answering(Archive):
        asked: ClassVar[list[str]] = []

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Answering)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield GaiaArchive(url=f"http://127.0.0.1:{server.server_port}/tap", folder=tmp_path / "kept"), Answering.asked
    server.shutdown()
    server.server_close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_archive_is_queried_once_for_a_field_and_its_neighbours(archive):
    ask, asked = archive
    stars = catalogue("gaia", Cone(*WHERE, 0.12), archive=ask)
    assert len(stars) == 400 and stars.epoch_jyr == 2016.0 and stars.has_motion
    assert len(asked) == 1 and "FROM gaiadr3.gaia_source" in asked[0] and "phot_g_mean_mag < 21" in asked[0]
    catalogue("gaia", Cone(WHERE[0] + 0.02, WHERE[1] - 0.02, 0.12), CatalogueOptions(), archive=ask)
    catalogue("gaia", Cone(*WHERE, 0.12), archive=ask, faintest=18.0)
    assert len(asked) == 1
    catalogue("gaia", Cone(WHERE[0] + 1.0, WHERE[1], 0.12), archive=ask)
    assert len(asked) == 2


def test_an_unreachable_archive_gives_one_line_with_the_offline_alternative(tmp_path):
    pytest.importorskip("pyvo", reason="the archive needs the extra sameas[archive]")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(InputError, match=r"127\.0\.0\.1:9/tap: the archive does not answer .*catalogue='bright'"):
            catalogue("gaia", Cone(*WHERE, 0.1), archive=GaiaArchive("http://127.0.0.1:9/tap", folder=tmp_path))
    with pytest.raises(InputError, match="queried one field at a time; give cone"):
        catalogue("gaia", None)


def test_rounded_cones_contain_the_requested_ones():
    rng = np.random.default_rng(7)
    for _ in range(200):
        cone = Cone(rng.uniform(0, 360), rng.uniform(-89.9, 89.9), rng.uniform(0.01, 3))
        assert rounded(cone).holds(cone) and rounded(cone).radius_deg < cone.radius_deg + 0.25


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to show the page in")
@pytest.mark.filterwarnings("ignore:The WCS transformation has more axes")
def test_the_page_shows_zooms_and_describes_a_star_in_a_browser(done):
    out, _ = done
    rows = read_table(out / "night.stars.fits")
    third = int(np.flatnonzero(rows["fate"] == "identified")[2])
    with Browser(out / "night.html") as browser:
        assert browser.js("document.title").startswith("night.fits")
        assert int(browser.js("document.getElementById('n-found').textContent").replace(" ", "")) == np.sum(
            rows["fate"] == "identified"
        )
        left, top = browser.js("(r => [r.left, r.top])(document.getElementById('sky').getBoundingClientRect())")
        at = f"framePage.toScreen({float(rows['x_px'][third])}, {float(rows['y_px'][third])})"
        x, y = browser.js(at)
        before = browser.js("framePage.view.scale")
        browser.wheel(left + x, top + y, -400)
        browser.until(f"framePage.view.scale > 1.5 * {before}")
        nx, ny = browser.js(at)
        assert abs(nx - x) < 1 and abs(ny - y) < 1  # the point under the cursor stays
        browser.click(left + nx, top + ny)
        record = browser.js("document.getElementById('record').innerText")
        assert str(rows["star"][third]) in record and "none of them" in record and f"Measurement {third}" in record
        missing = str(rows["star"][rows["fate"] == "missing"][0])
        browser.js(f"document.getElementById('search').value = '{missing}'")
        browser.js("document.getElementById('search').dispatchEvent(new Event('change'))")
        assert browser.js("document.getElementById('record').innerText").startswith(missing)
        browser.js("document.getElementById('whole').click()")
        assert browser.js("framePage.view.scale") == pytest.approx(before)
        assert browser.js("document.getElementById('many').value === document.getElementById('many').max")
        # The plate model in the page agrees with that of the files in both directions.
        solved = WCS(fits.getheader(out / "night.wcs"))
        for px in ([0.0, 0.0], [319.0, 12.0], [150.5, 300.25]):
            sky = solved.pixel_to_world(*px)
            own = browser.js(f"framePage.toSky({px[0]}, {px[1]})")
            assert sky.separation(SkyCoord(*own, unit="deg")).arcsec < 0.01
            assert browser.js(f"framePage.fromSky({own[0]}, {own[1]})") == pytest.approx(px, abs=1e-5)
        browser.do("Input.dispatchMouseEvent", type="mouseMoved", x=left + nx, y=top + ny)
        own = browser.js(f"framePage.toSky(...framePage.toPixel({nx}, {ny}))")
        assert f"{own[0]:.5f}°" in browser.js("document.getElementById('place').textContent")
        shade = "(c => [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data].reduce((a, b) => a + b))"
        drawn = shade + "(document.getElementById('sky'))"
        for change in (
            "e => { e.value = 120; e.dispatchEvent(new Event('input')); }, 'black'",
            "e => e.click(), 'negative'", "e => e.click(), 'show-grid'", "e => e.click(), 'theme'",
        ):  # fmt: skip
            was = browser.js(drawn)
            act, name = change.rsplit(", ", 1)
            browser.js(f"({act})(document.getElementById({name}))")
            browser.until(f"{drawn} !== {was}")
        assert not browser.errors
        assert not [url for url in browser.requests if not url.startswith(("file:", "data:", "blob:"))]


@pytest.mark.slow
def test_a_folder_of_frames_is_one_product(files, sameas, tmp_path):
    night, out = tmp_path / "night", tmp_path / "out"
    night.mkdir()
    for k in range(3):
        cards: dict[str, Any] = {"DATE-OBS": f"2016-01-01T12:{10 * k:02d}:00", "FILTER": "V"}
        picture(night / f"n{k}.fits", sky(), seed=k, **cards)
    picture(night / "red.fits", sky(), seed=4, **(cards | {"DATE-OBS": "2016-01-01T13:00:00", "FILTER": "R"}))
    picture(night / "dark.fits", sky(), seed=5, IMAGETYP="Dark Frame")
    (night / "bad.fits").write_bytes((night / "n0.fits").read_bytes()[:30_000])
    done = sameas("frame", night, "-c", files.stars, "-o", out, "--no-picture", "-j", 1, exit_code=1)
    words = " ".join(done.stdout.split())
    assert "Frames: 5; 4 done, 1 failed" in words and "dark" not in words
    assert "Series: 3 frames in V over 20.0 minutes" in words and "on all frames" in words
    assert "red.fits: the only frame of its field and filter; no series" in words
    assert "Catalogue: stars position ra, dec" in words
    order = [line.partition(":")[0] for line in done.stdout.splitlines() if " identified, " in line]
    assert order == ["n0", "n1", "n2", "red"]
    stars, frames = read_table(out / "series.stars.fits"), read_table(out / "series.frames.fits")
    assert len(frames) == 3 and stars["frame_magnitude"].shape == (len(stars), 3) and len(stars) > 90
    named = stars[~np.ma.getmaskarray(stars["id"])]
    assert len(set(named["id"])) == len(named) > 90
    truth = sky()
    at = np.searchsorted(truth["source_id"], np.asarray(named["id"]).astype(np.int64))
    off = named["magnitude"] - truth["phot_g_mean_mag"][at]
    assert np.nanmedian(np.abs(np.ma.filled(off, np.nan))) < 0.05
    page = (out / "index.html").read_text()
    assert '"page":"n0.html"' in page and "bad" in page and "red.fits: the only frame" in page
    if CHROMIUM is not None:
        with Browser(out / "index.html") as browser:
            assert browser.js("document.querySelectorAll('#frames tr').length") == 5
            assert browser.js("document.querySelector('#star h2').textContent.length") > 3
            assert browser.errors == []


def add_bias(path: Path, bias: Path) -> Path:
    """Adds 400 ADU to every fifth column of a frame, and writes the bias that has them."""
    columns = np.where(np.arange(SIDE) % 5 == 0, 400, 0).astype(np.uint16)
    with fits.open(path) as opened:
        fits.PrimaryHDU(opened[0].data + columns, opened[0].header).writeto(path, overwrite=True)
    fits.PrimaryHDU(np.broadcast_to(columns, (SIDE, SIDE)).copy()).writeto(bias, overwrite=True)
    return bias


@pytest.mark.slow
def test_a_bias_is_subtracted(files, done, sameas, tmp_path):
    """What is measured is that of a frame without one."""
    frame = tmp_path / "night.fits"
    frame.write_bytes(files.frame.read_bytes())
    bias = add_bias(frame, tmp_path / "bias.fits")
    sameas("frame", frame, "-c", files.stars, "-o", tmp_path, "--bias", bias, "--no-page", "--no-picture")
    assert "bias subtracted" in json.loads((tmp_path / "night.json").read_text())["exposure"]["read"]
    plain, subtracted = (read_table(folder / "night.stars.fits") for folder in (done[0], tmp_path))
    assert len(plain) == len(subtracted) > 100
    for name in ("x_px", "y_px", "flux"):
        np.testing.assert_allclose(subtracted[name], plain[name], rtol=1e-5)


@pytest.mark.long
def test_movers_below_the_limit_of_frames_with_a_bias_are_found(files, sameas, tmp_path):
    """The mover is too faint for a single frame, and the stack of frames whose bias stays does not show it."""
    frames, out, east, north = [tmp_path / f"n{k}.fits" for k in range(8)], tmp_path / "out", -0.4, 0.3
    for k, path in enumerate(frames):
        minutes, mover = 8 * k, sky(1)
        mover["ra"] = WHERE[0] + minutes * east / 3600.0 / np.cos(np.radians(WHERE[1]))
        mover["dec"], mover["phot_g_mean_mag"] = WHERE[1] + 0.02 + minutes * north / 3600.0, 18.0
        cards: dict[str, Any] = {"DATE-OBS": f"2016-01-01T12:{minutes:02d}:00"}
        picture(path, vstack([sky(), mover]), seed=k, **cards)
        bias = add_bias(path, tmp_path / "bias.fits")
    options = ["-c", files.stars, "-o", out, "--bias", bias, "--below-limit", 0.6, "-j", 1, "-q"]
    sameas("movers", *frames, *options)
    assert all("bias subtracted" in json.loads((out / f"n{k}.json").read_text())["exposure"]["read"] for k in range(8))
    assert len(read_table(out / "tracklets.fits")) == 0
    found = read_table(out / "below-limit.fits")
    assert len(found) == 1 and found["p_tracklet"][0] > 0.5
    rate = [found[f"rate_{axis}_arcsec_per_min"][0] for axis in ("east", "north")]
    np.testing.assert_allclose(rate, [east, north], atol=0.06)


def test_numbers_of_a_frame_are_refused_by_their_options(files, sameas):
    """They were named as in Python: given gain_e_per_adu."""
    for option, value, least in (
        ("--gain", "-3", "above zero"),
        ("--threshold", "0", "above 0"),
        ("--read-noise", "-1", "zero or more"),
    ):
        said = sameas("frame", files.frame, "-c", files.stars, option, value, exit_code=1).stderr
        assert said.endswith(f"{option} is {value}; give a number {least}\n")


def test_a_folder_without_frames_is_refused(files, sameas, tmp_path):
    (tmp_path / "empty").mkdir()
    assert "no frames in this folder" in sameas("frame", tmp_path / "empty", "-c", files.stars, exit_code=1).stderr


@pytest.mark.slow
def test_files_of_a_frame_appear_together_and_are_reproducible(files, sameas, tmp_path, monkeypatch):
    """An interruption between two files left the table of the new run beside the page of the old one."""
    from sameas.io import plate

    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    folder = tmp_path / "out"

    def written(*options):
        sameas("frame", files.frame, "-c", files.stars, "-o", folder, "--no-picture", "--again", *options)
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    first = written()
    assert written() == first

    def interrupted(*given, **named):
        raise KeyboardInterrupt

    monkeypatch.setattr(plate, "write_regions", interrupted)
    monkeypatch.setattr("sameas.front.framing.write_regions", interrupted, raising=False)
    with pytest.raises((AssertionError, KeyboardInterrupt)):
        written("--threshold", "6")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == first


def test_calibration_frames_found_in_a_folder_are_reported(tmp_path, capsys):
    from sameas.cli.frames import expanded

    for name, kind in (("dark", "Dark Frame"), ("light", "Light Frame")):
        header = fits.Header({"IMAGETYP": kind})
        fits.PrimaryHDU(np.zeros((4, 4), np.int16), header).writeto(tmp_path / f"{name}.fit")
    light, dark = (str(tmp_path / f"{name}.fit") for name in ("light", "dark"))
    assert expanded([str(tmp_path)]) == [light]
    assert "1 calibration frame not used, the first dark.fit; --dark," in capsys.readouterr().err
    assert expanded([str(tmp_path)], [dark]) == [light] and capsys.readouterr().err == ""
