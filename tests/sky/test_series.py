"""A series of frames: relative alignment, removal of stationary detections, movers, names of known objects."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from astropy.table import Table

from sameas import InputError
from sameas.front.movers import MoverOptions, series_movers
from sameas.front.series import series_of
from sameas.sky.frame.measurements import Flag
from sameas.sky.motion import AU_KM
from sameas.sky.movers.orbits import Elements, de421, ephemeris, near, packed_date, states, two_body
from sameas.sky.movers.search import search
from sameas.sky.series import Exposure, tie
from sameas.space import unit_vectors

RA, DEC, SCALE = 62.5, 22.9, 1.2


def frames(seed, *, count=6, stars=150, noise=40, rates=((-0.2, 0.05),), hot=0, dither_px=4.0, drift_px=(0, 0),
           minutes=8.0):  # fmt: skip
    """Exposures of a field of uncatalogued stars, movers (px/min), noise, hot pixels on a dithered, drifting chip."""
    rng = np.random.default_rng(seed)
    star = rng.uniform(20, 1000, (stars, 2))
    bright = 10 ** rng.uniform(2.5, 5.0, stars)
    start = np.array([[500.0, 400.0 + 60 * k] for k in range(len(rates))]).reshape(-1, 2)
    fixed = rng.uniform(20, 1000, (hot, 2))
    out = []
    for k in range(count):
        wander = rng.normal(0.0, dither_px, 2) + k * np.array(drift_px)
        sky = np.concatenate([star, start + k * minutes * np.array(rates).reshape(-1, 2)]) + wander
        flux = np.concatenate([bright, np.full(len(rates), 8000.0)])
        found = rng.random(len(sky)) < np.clip(flux / 600.0, 0.0, 1.0)
        xy = np.concatenate([sky[found], fixed, rng.uniform(20, 1000, (noise, 2))])
        flux = np.concatenate([flux[found], np.full(hot, 2000.0), np.full(noise, 300.0)])
        sigma = np.clip(80.0 / flux, 0.02, 0.4)
        xy = xy + sigma[:, None] * rng.standard_normal(xy.shape)
        # The plate of each frame has an error of a shift and a small rotation.
        turn, shift = 1e-4 * rng.standard_normal(), 0.3 * rng.standard_normal(2)
        at = (xy - wander - 512.0) @ np.array([[1.0, turn], [-turn, 1.0]]) * SCALE + shift
        dec = DEC + at[:, 1] / 3600.0
        n = len(xy)
        cov = np.column_stack([sigma**2, np.zeros(n), sigma**2])
        out.append(
            Exposure(
                f"frame {k}", 58409.1 + k * minutes / 1440.0, xy[:, 0], xy[:, 1], cov,
                RA + at[:, 0] / 3600.0 / np.cos(np.radians(dec)), dec, cov * SCALE**2 + [0.01, 0.0, 0.01],
                flux, np.full(n, 60.0), flux / 60.0, np.zeros(n, np.int64), np.zeros(n), np.full(n, np.nan), SCALE,
                (1024, 1024), 120.0,
            )
        )  # fmt: skip
    return out


def test_relative_alignment_is_far_better_than_the_plates():
    series = tie(frames(1))
    assert series.ties.min() > 40
    still = series.stationary & (series.sigma_arcsec < 0.1)
    found, _ = search(series)
    assert len(found) == 1 and found.size[0] == 6 and found.p_tracklet[0] > 0.99
    # Plates are off by 0.3″.
    assert found.scatter_arcsec[0] < 0.1 and still.sum() > 300


@dataclass(frozen=True)
class Done:
    """A frame that was identified, as :func:`series_of` sees it."""

    of: Exposure
    filter: str = ""
    summary: ClassVar = {"place": {"middle_ra_deg": RA, "middle_dec_deg": DEC, "width_deg": 0.34, "height_deg": 0.34}}

    def exposure(self) -> Exposure:
        return self.of


@pytest.mark.parametrize(("share", "away_px"), [(0.2, 1.5), (0.4, 2.0), (0.5, 3.0), (0.0, 2.0), (0.3, 9.0)])
def test_a_star_without_a_measurement_of_its_own_draws_that_beside_it(share, away_px):
    """An asteroid that passed a star was reported 5.5 stated errors beside its path."""
    fwhm = 2.5
    width = fwhm / 2.3548
    x = np.linspace(-1.0, 4.0, 50_001)
    filtered = np.exp(-(x**2) / (4 * width**2)) + share * np.exp(-((x - away_px) ** 2) / (4 * width**2))
    drawn = x[np.argmax(filtered)]
    seen, star = 17.0 - 2.5 * np.log10(filtered.max()), 17.0 - 2.5 * np.log10(max(share, 1e-9))
    columns = {name: [0.01, np.nan] for name in ("cov_xx_px2", "cov_yy_px2", "cov_ee_arcsec2", "cov_nn_arcsec2")}
    zeros = {
        name: [0.0, 0.0] for name in ("y_px", "cov_xy_px2", "cov_en_arcsec2", "ra_deg", "dec_deg", "flux_err", "snr")
    }
    table = Table({
        **columns, **zeros, "x_px": [drawn, away_px], "flux": [1.0, 1.0], "flags": [0, 0], "star": ["", "s"],
        "measurement": np.ma.MaskedArray([0, 0], [False, True]), "p_match": [0.0, 0.0],
        "magnitude": np.ma.MaskedArray([seen, 0.0], [False, True]),
        "star_magnitude": np.ma.MaskedArray([0.0, star], [True, False]),
    })  # fmt: skip
    seen_there = Exposure.of_listing(table, "frame", 58409.1, SCALE, (64, 64), 60.0, fwhm)
    pulled = np.sqrt(seen_there.covariance_px[0, 0] - 0.01)
    assert pulled == pytest.approx(drawn, rel=0.3, abs=0.02)
    assert np.sqrt(seen_there.covariance[0, 2] - 0.01) == pytest.approx(pulled * SCALE, abs=1e-6)


def test_a_frame_that_is_given_twice_is_used_once():
    """The whole series was refused, with no field."""
    exposures = frames(1)
    copy = replace(exposures[2], name="copy")
    done: Any = [Done(each) for each in (*exposures, copy)]
    (one,), reasons = series_of(done)
    assert len(one.members) == len(exposures) and len(reasons) == 1
    assert reasons[0].startswith("1 frame has the time of another and cannot be used: copy; check DATE-OBS")


def test_frames_of_one_time_are_refused_for_their_time():
    """The refusal was that they show no field."""
    done: Any = [Done(replace(each, mjd_utc=58409.1)) for each in frames(1)]
    with pytest.raises(InputError, match=r"no two frames make a series: 5 frames have the time of another .* DATE-OBS"):
        series_movers(done, MoverOptions(), failed=[])


def test_uncatalogued_stars_are_no_movers():
    series = tie(frames(2, rates=()))
    found, _ = search(series)
    assert len(found) == 0


def test_hot_pixels_are_stationary_on_the_chip():
    series = tie(frames(3, hot=60, dither_px=6.0))
    found, _ = search(series)
    assert series.fixed.sum() > 0.8 * 60 * 6 and len(found) == 1


def test_warm_pixels_under_a_drifting_sky_are_no_movers():
    # Warm pixels detected intermittently: 1.1 px over the chip, 11 px over the sky.
    creeping, mover = (-2.0 / 8.0 + 0.025, -1.0 / 8.0 + 0.012), (0.2, 0.05)
    series = tie(frames(11, rates=(creeping, mover), dither_px=0.1, drift_px=(2.0, 1.0)))
    found, _ = search(series)
    assert len(found) == 1 and np.hypot(*found.rate_arcsec_per_min[0]) / SCALE == pytest.approx(
        np.hypot(*mover), rel=0.05
    )


def test_slow_and_fast_movers_are_found():
    found, _ = search(tie(frames(4, count=8, rates=((-0.06, 0.02), (3.0, -2.0), (0.3, 0.4)))))
    speeds = np.sort(np.hypot(*found.rate_arcsec_per_min.T)) / SCALE
    np.testing.assert_allclose(speeds, [np.hypot(0.06, 0.02), 0.5, np.hypot(3.0, 2.0)], rtol=0.05)


def test_a_mover_passing_a_star_loses_one_frame_only():
    made = frames(5, count=8)
    hidden = made[3]
    mover = int(np.argmin(np.abs(hidden.flux - 8000.0)))
    keep = np.arange(len(hidden)) != mover
    columns = {k: v[keep] for k, v in vars(hidden).items() if isinstance(v, np.ndarray)}
    found, _ = search(tie([*made[:3], replace(hidden, **columns), *made[4:]]))
    assert found.size.tolist() == [7]


def test_frames_of_two_fields_or_one_time_are_refused():
    made = frames(6)
    with pytest.raises(InputError, match="search the frames of each field by themselves"):
        tie([*made[:5], replace(made[5], ra_deg=made[5].ra_deg + 2.0)])
    with pytest.raises(InputError, match="check DATE-OBS"):
        tie([*made[:5], replace(made[5], mjd_utc=made[4].mjd_utc)])
    with pytest.raises(InputError, match="better three"):
        tie(made[:1])


CERES: dict[str, list[Any]] = {
    "fields": ["full_name", "H", "G", "epoch_mjd", "e", "a", "q", "i", "om", "w", "ma"],
    "data": [
        ["  1 Ceres-like", "3.3", "0.12", "59800", ".0786", "2.7666", "2.5490", "10.587", "80.27", "73.53", "334.33"]
    ],
}


@pytest.fixture
def elements(tmp_path):
    path = tmp_path / "elements.json"
    path.write_text(json.dumps(CERES))
    return Elements.read(path)


def test_elements_are_read_from_json_and_mpcorb(elements, tmp_path):
    assert elements.number == ("1",) and elements.h[0] == 3.3
    line = (
        "00001    3.34  0.15 K239D  60.07881   73.42179   80.25496   10.58688  0.0789126  0.21411523   2.7672543"
        "  0 E2023-F87  7283 122 1801-2023 0.65 M-v 30k MPCLINUX   4000      (1) Ceres              20230321"
    )
    path = tmp_path / "MPCORB.DAT"
    path.write_text(f"header\n{'-' * 60}\n{line}\n")
    read = Elements.read(path)
    assert read.name == ("(1) Ceres",) and read.number == ("1",) and read.epoch_mjd[0] == 60200.0
    assert read.perihelion_au[0] == pytest.approx(2.7672543 * (1 - 0.0789126)) and read.uncertainty[0] == 0.0


def of_jpl(covariance=None, **object_):
    """The response of JPL's small-body database for Ceres, with or without covariance."""
    row = dict(zip(CERES["fields"], CERES["data"][0], strict=True))
    tp = float(row["epoch_mjd"]) + 2400000.5 - 200.0
    value = {"e": row["e"], "q": row["q"], "tp": tp, "om": row["om"], "w": row["w"], "i": row["i"]}
    orbit: dict[str, Any] = {
        "epoch": str(float(row["epoch_mjd"]) + 2400000.5), "condition_code": "3",
        "elements": [{"name": name, "value": str(v)} for name, v in value.items()],
    }  # fmt: skip
    if covariance is not None:
        own = [{"name": {"om": "node", "w": "peri"}.get(n, n), "value": str(v)} for n, v in value.items()]
        orbit["covariance"] = {"labels": ["e", "q", "tp", "node", "peri", "i", "A2"], "epoch": orbit["epoch"],
                               "elements": own, "data": np.pad(covariance, (0, 1)).tolist()}  # fmt: skip
    return {"object": {"fullname": "1 Ceres (A801 AA)"}, "orbit": orbit, **object_}


def test_the_covariance_of_elements_is_propagated_to_the_sky(tmp_path):
    rng = np.random.default_rng(6)
    scale = np.array([2e-8, 5e-8, 2e-5, 3e-6, 1e-5, 4e-6])
    root = rng.standard_normal((6, 6)) * scale[:, None]
    path = tmp_path / "ceres.json"
    path.write_text(json.dumps([of_jpl(root @ root.T), of_jpl()]))
    both = Elements.read(path)
    assert both.number == ("1", "1") and both.covariance is not None and np.isnan(both.covariance[1]).all()
    times = np.array([both.epoch_mjd[0] + 400.0])
    there = ephemeris(both, times)
    np.testing.assert_allclose(there.ra_deg[0], there.ra_deg[1], atol=1e-9)
    # Orbits drawn from the covariance scatter as stated; without covariance the scale of U is used.
    some = Elements.read(path).some(np.zeros(300, np.int64))
    moved = ephemeris(replace(some, covariance=None).displaced(rng.standard_normal((300, 6)) @ root.T), times)
    off = 3600.0 * np.column_stack([(moved.ra_deg - there.ra_deg[0]) * np.cos(np.radians(there.dec_deg[0])),
                                    moved.dec_deg - there.dec_deg[0]])  # fmt: skip
    wide = np.sqrt(np.linalg.eigvalsh(np.cov(off.T))[-1])
    assert there.sigma_arcsec[0, 0] == pytest.approx(wide, rel=0.15)
    assert there.sigma_arcsec[1, 0] == pytest.approx(0.1 * 648000.0 ** (2.5 / 9.0) * 400.0 / 365.25, rel=0.01)


@pytest.mark.slow
def test_objects_of_different_epochs_are_propagated_together(elements):
    """Equal to propagating each alone; also from a common epoch."""
    some = elements.some(np.zeros(4, np.int64))
    some = replace(some, epoch_mjd=some.epoch_mjd + np.array([0.0, -700.0, 900.0, -700.0]))
    times = np.array([59900.3, 59900.1])
    there = ephemeris(some, times)
    for k in range(4):
        alone = ephemeris(some.some(np.array([k])), times)
        np.testing.assert_allclose(there.ra_deg[k], alone.ra_deg[0], atol=3e-8)
        np.testing.assert_allclose(there.dec_deg[k], alone.dec_deg[0], atol=3e-8)
    again = ephemeris(some, times, start=(59890.0, states(some, 59890.0)))
    np.testing.assert_allclose(again.ra_deg, there.ra_deg, atol=3e-8)


def test_files_without_elements_are_refused(tmp_path):
    path = tmp_path / "none.txt"
    path.write_text("nothing here\n")
    with pytest.raises(InputError, match="neither lines of MPCORB"):
        Elements.read(path)
    path.write_text('{"fields": ["name"], "data": []}')
    with pytest.raises(InputError, match="no elements as JPL"):
        Elements.read(path)


def test_packed_dates_are_those_of_the_minor_planet_center():
    dates = [packed_date(text) for text in ("K239D", "J9611", "xxxxx")]
    assert dates == pytest.approx([60200.0, 50083.0, np.nan], nan_ok=True)


@pytest.mark.parametrize("e", [0.0, 0.4, 0.97, 1.0, 1.4])
def test_two_body_motion_keeps_kepler_s_laws(e):
    """The radius sweeps area at the constant rate √(GM p)/2."""
    days = np.linspace(-300.0, 300.0, 20001)
    radius, anomaly = two_body(np.full(len(days), 1.5), np.full(len(days), e), days)
    swept = 0.5 * radius[1:] ** 2 * np.diff(np.unwrap(anomaly)) / np.diff(days)
    expected = 0.5 * 0.01720209895 * np.sqrt(1.5 * (1 + e))
    np.testing.assert_allclose(swept, expected, rtol=1e-3)


def test_ephemerides_are_continuous_and_near_two_body_ones(elements):
    pytest.importorskip("jplephem", reason="places of the planets need jplephem and skyfield-data")
    pytest.importorskip("skyfield_data", reason="places of the planets need jplephem and skyfield-data")
    times = np.array([59900.0, 59900.01, 59900.02])
    there = ephemeris(elements, times)
    step = np.diff(there.ra_deg[0])
    assert step[0] == pytest.approx(step[1], rel=1e-3) and 1.5 < there.distance_au[0, 0] < 4.0
    assert 6.0 < there.magnitude[0, 0] < 10.0
    ra, dec = float(there.ra_deg[0, 0]), float(there.dec_deg[0, 0])
    assert near(elements, 59900.0, unit_vectors(ra, dec), 0.0).tolist() == [0]
    assert near(elements, 59900.0, unit_vectors(ra + 40.0, dec), 1.0).tolist() == []
    with pytest.raises(InputError, match="the planetary ephemeris covers"):
        ephemeris(elements, np.array([100000.0]))


#: From JPL's small-body database: Pluto is both in lists of minor planets and among the perturbing planets.
PLUTO = ["134340 Pluto (1930 BM)", "-0.44", None, "54000", ".250248713478499", "39.4450697257358", "29.5739917738007",
         "17.089000919562", "110.3769579554089", "112.5971416774872", "25.24718971218841"]  # fmt: skip


@pytest.mark.slow
def test_pluto_does_not_perturb_itself(tmp_path):
    pytest.importorskip("jplephem", reason="places of the planets need jplephem and skyfield-data")
    pytest.importorskip("skyfield_data", reason="places of the planets need jplephem and skyfield-data")
    path = tmp_path / "elements.json"
    ceres = [None if key == "G" else value for key, value in zip(CERES["fields"], CERES["data"][0], strict=True)]
    path.write_text(json.dumps({"fields": CERES["fields"], "data": [ceres, PLUTO]}))
    both = Elements.read(path)
    together = states(both, 59300.0)
    alone = states(both.some(np.array([0])), 59300.0)
    # Its elements include its motion about the Pluto-Charon barycentre, 20 m/s.
    assert np.abs(together[0, :, 0] - alone[0, :, 0]).max() * AU_KM < 20.0
    there = de421().perturbers(np.array([59300.0]))[8, :, 0]
    assert np.abs(together[0, :, 1] - there).max() < 0.1


DATA = Path(__file__).parents[2] / ".." / "shared" / "data" / "asteroid_2713"


@pytest.mark.long
@pytest.mark.skipif(not DATA.is_dir(), reason="the frames of asteroid 2713 are not on this machine")
def test_the_asteroid_of_five_real_frames_comes_first(tmp_path):
    from typer.testing import CliRunner

    from sameas.cli.app import app
    from sameas.io import read_table

    lights, darks = sorted(DATA.glob("*Light*.fit"))[::2], sorted(DATA.glob("*Dark*.fit"))
    arguments = ["movers", *map(str, lights), "-c", str(DATA / "tycho2_field_r0.3deg.csv"), "--sigma", "0.1",
                 "--epoch", "2000", "-o", str(tmp_path)]  # fmt: skip
    for dark in darks:
        arguments += ["--dark", str(dark)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    tracklets = read_table(tmp_path / "tracklets.fits")
    first = tracklets[0]
    assert first["n_detections"] == 5 and first["p_tracklet"] > 0.999
    assert first["scatter_arcsec"] < 0.1 * 1.176 and abs(first["rate_arcsec_per_min"] - 0.257) < 0.003
    # Nothing else comes near its odds.
    assert (tracklets["log_odds"][1:] < first["log_odds"] - 30).all()


def test_two_frames_alone_give_few_candidates():
    found, _ = search(tie(frames(7, count=2)), least=2)
    assert len(found) <= 2


def test_wrong_times_give_few_candidates():
    made = frames(8, count=8, rates=((-0.2, 0.05), (0.4, 0.1)))
    order = np.random.default_rng(0).permutation(8)
    shuffled = [replace(one, mjd_utc=made[int(k)].mjd_utc) for one, k in zip(made, order, strict=True)]
    found, _ = search(tie(shuffled))
    assert len(found) <= 3


@pytest.mark.parametrize("dither_px", [0.1, 6.0])
def test_a_chip_full_of_hot_pixels_gives_few_candidates(dither_px):
    found, _ = search(tie(frames(9, hot=600, rates=(), dither_px=dither_px)))
    assert len(found) <= 2


def test_the_trail_of_a_satellite_on_one_frame_is_no_mover():
    made = frames(10, count=6, rates=())
    trail = made[2]
    along = np.linspace(0.0, 1.0, 60)
    more = {
        "x_px": 100 + 800 * along, "y_px": 200 + 600 * along, "covariance_px": np.tile([0.1, 0.0, 0.1], (60, 1)),
        "ra_deg": RA + (along - 0.5) * 0.25, "dec_deg": DEC + (along - 0.5) * 0.2,
        "covariance": np.tile([0.15, 0.0, 0.15], (60, 1)), "flux": np.full(60, 3000.0), "flux_err": np.full(60, 60.0),
        "snr": np.full(60, 50.0), "flags": np.zeros(60, np.int64), "p_star": np.zeros(60),
        "magnitude": np.full(60, np.nan),
    }  # fmt: skip
    made[2] = replace(trail, **{k: np.concatenate([getattr(trail, k), v]) for k, v in more.items()})
    found, _ = search(tie(made))
    assert len(found) <= 1


def with_movers(seed, rates, fluxes, *, count=8):
    """Exposures with movers of rates (n, 2) px/min, and the mover of each measurement, −1 for none."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(150.0, 870.0, (len(rates), 2))
    made, truth = [], []
    for k, one in enumerate(frames(seed + 1000, count=count, rates=(), noise=60)):
        place = start + k * 8.0 * rates
        seen = rng.random(len(rates)) < np.clip(fluxes / 600.0, 0.0, 1.0)
        seen &= ((place > 5) & (place < 1019)).all(axis=1)
        flux, n = fluxes[seen], int(seen.sum())
        sigma = np.clip(80.0 / flux, 0.02, 0.4)
        x, y = (place[seen] + sigma[:, None] * rng.standard_normal((n, 2))).T
        dec = DEC + (y - 512.0) * SCALE / 3600.0
        ra = RA + (x - 512.0) * SCALE / 3600.0 / np.cos(np.radians(dec))
        cov = np.column_stack([sigma**2, np.zeros(n), sigma**2])
        none = np.zeros(n)
        more = {
            "x_px": x, "y_px": y, "covariance_px": cov, "ra_deg": ra, "dec_deg": dec,
            "covariance": cov * SCALE**2 + [0.01, 0.0, 0.01], "flux": flux, "flux_err": none + 60.0,
            "snr": flux / 60.0, "flags": none.astype(np.int64), "p_star": none, "magnitude": none + np.nan,
        }  # fmt: skip
        made.append(replace(one, **{key: np.concatenate([getattr(one, key), v]) for key, v in more.items()}))
        truth.append(np.concatenate([np.full(len(one), -1), np.flatnonzero(seen)]))
    return made, truth


@pytest.mark.slow
@pytest.mark.long
def test_probabilities_of_injected_movers_are_calibrated():
    rng = np.random.default_rng(5)
    p, right, seen, got, n = [], [], 0, 0, 12
    for field in range(12):
        speed, angle = 10 ** rng.uniform(-1.0, 0.5, n) / SCALE, rng.uniform(0.0, 2 * np.pi, n)
        rates = np.column_stack([speed * np.cos(angle), speed * np.sin(angle)])
        exposures, truth = with_movers(100 + field, rates, 10 ** rng.uniform(2.35, 3.5, n))
        found, series = search(tie(exposures), min_probability=0.0)
        whose = np.concatenate(truth)
        known = set()
        for members, sure in zip(found.members, found.p_tracklet, strict=True):
            names = whose[found.detections.rows[members[members >= 0]]]
            values, counts = np.unique(names[names >= 0], return_counts=True)
            true = bool(len(counts)) and counts.max() >= max(3, 0.7 * len(names))
            p.append(sure)
            right.append(true)
            if true and sure > 0.5:
                known.add(int(values[np.argmax(counts)]))
        often = [k for k in range(n) if (whose == k).sum() >= 5]
        seen, got = seen + len(often), got + len(known.intersection(often))
        assert len(series.exposures) == 8
    p, right = np.array(p), np.array(right)
    assert got > 0.9 * seen and seen > 60
    # At least nine in ten candidates of p ≥ 0.9 are real, and the total is as expected.
    assert right[p >= 0.9].mean() > 0.95
    assert abs(right.sum() - p.sum()) < 4.0 * np.sqrt((p * (1 - p)).sum() + 1.0)


def test_each_star_is_listed_once_with_its_measurement_in_every_frame():
    series = tie(frames(21, rates=(), hot=20))
    stars, table = series.stars, series.star_table()
    assert 120 < len(stars) < 170
    used = stars.measurement[stars.measurement >= 0]
    assert len(np.unique(used)) == len(used)
    for k in range(6):
        here = stars.measurement[:, k]
        assert (series.frame[here[here >= 0]] == k).all()
    bright = (stars.measurement >= 0).all(axis=1)
    assert bright.sum() > 60 and np.nanstd(stars.residual_arcsec[bright]) < 0.15
    row = table[int(np.flatnonzero(bright)[0])]
    at = series.stars.measurement[int(np.flatnonzero(bright)[0])]
    assert row["measurement"].tolist() == series.row[at].tolist() and row["frames"] == 6


def test_zero_points_correct_for_clouds_and_a_variable_star_is_found():
    rng = np.random.default_rng(22)
    made, cloud = frames(22, rates=(), noise=0), np.array([0.0, 0.1, 0.4, 0.05, 0.8, 0.2])
    varying = int(np.argsort(made[0].flux)[-10])
    place = made[0].ra_deg[varying], made[0].dec_deg[varying]
    dimmed = []
    for k, one in enumerate(made):
        flux = one.flux * 10 ** (-0.4 * cloud[k]) * (1 + 0.003 * rng.standard_normal(len(one)))
        near = np.argmin(np.hypot((one.ra_deg - place[0]) * np.cos(np.radians(DEC)), one.dec_deg - place[1]))
        flux[near] *= 10 ** (-0.4 * 0.3 * (k % 2))
        dimmed.append(replace(one, flux=flux, flux_err=np.full(len(one), 3.0)))
    series = tie(dimmed)
    stars = series.stars
    np.testing.assert_allclose(stars.zero_point - stars.zero_point[0], -cloud, atol=0.004)
    assert (stars.zero_error < 0.004).all() and stars.floor_mag < 0.006
    assert "instrumental" in stars.scale
    least = int(np.nanargmin(stars.p_constant))
    ra, dec = series.sky(stars.place[least : least + 1])
    assert abs(ra[0] - place[0]) * 3600 < 1.5 and abs(dec[0] - place[1]) * 3600 < 1.5
    assert stars.scatter_mag[least] == pytest.approx(0.15 * np.sqrt(6 / 5), abs=0.02)
    others = np.arange(len(stars)) != least
    assert np.nanmean(stars.p_constant[others] < 0.01) < 0.06


def test_stars_of_the_catalogue_keep_their_name_and_its_scale():
    made = []
    for one in frames(23, rates=(), noise=0):
        bright = one.flux > 3000.0
        name = np.array([f"C{v:.0f}" for v in np.round(one.flux, -1)])
        made.append(
            replace(
                one, p_star=np.where(bright, 0.99, 0.0), star=np.where(bright, name, ""),
                magnitude=np.where(bright, 20.0 - 2.5 * np.log10(one.flux), np.nan),
            )
        )  # fmt: skip
    stars = tie(made).stars
    assert len(set(stars.name[stars.name != ""])) == (stars.name != "").sum() > 40
    assert stars.scale == "of the catalogue" and np.abs(stars.zero_point - 20.0).max() < 0.01
    assert (stars.name == "").sum() > 30


@pytest.mark.parametrize("flag", [Flag.SATURATED, Flag.EDGE, Flag.TRAILED])  # two stars in one mark look trailed
def test_measurements_of_other_light_than_the_star_s_give_no_magnitude(flag):
    made = [replace(one, flags=np.where(one.flux > 2e4, int(flag), 0)) for one in frames(24, rates=())]
    series = tie(made)
    there = series.stars.measurement
    flagged = (there >= 0) & (np.concatenate([e.flux for e in series.exposures])[there] > 2e4)
    assert flagged.sum() > 20 and np.isnan(series.stars.magnitude[flagged]).all()


def test_without_unidentified_detections_there_are_no_movers():
    found, series = search(tie(frames(25, noise=0, rates=(), stars=60)))
    assert len(found) == 0 and len(found.table()) == 0 and len(found.detection_table()) == 0
    made = [replace(one, p_star=np.ones(len(one))) for one in frames(26)]
    found, series = search(tie(made))
    assert not series.unexplained.any() and len(found.table()) == len(found.detection_table()) == 0
