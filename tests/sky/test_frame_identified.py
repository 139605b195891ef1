"""A simulated frame with known truth: identification and plate refinement."""

from __future__ import annotations

import json
import math
import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table

from sameas.errors import InputError
from sameas.report.frame import frame_lines
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.frame.detect import detect
from sameas.sky.frame.field import Cone, StarField
from sameas.sky.frame.identified import FrameIdentification, Refinement, footprint, search_cone, solve
from sameas.sky.frame.image import MasterFrames, read
from sameas.sky.frame.measurements import Flag, Measurements
from sameas.sky.frame.outputs import ERROR_TERM_NAMES, listing, summary
from sameas.sky.frame.photometry import Completeness, ZeroPoint
from sameas.sky.frame.pointing import Pointing
from sameas.sky.frame.pointing_hints import Aim, ApproximateWcs
from sameas.space import ARCSEC_PER_RADIAN, directions_deg, unit_vectors

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
SIDE = 1000
YEARS = 40.0


@dataclass(frozen=True)
class Scene:
    """A frame of 2020 and a catalogue of 1980 with proper motions; ``truth`` (n,) row of the star, −1 for none."""

    measured: Measurements
    catalogue: Catalogue
    pointing: Pointing
    truth: np.ndarray


def bent(xy: np.ndarray, by_px: float) -> np.ndarray:
    u = (xy - SIDE / 2) / (SIDE / 2)
    return xy + by_px * u * (u**2).sum(axis=1, keepdims=True)


def scene(seed: int, *, stars: int = 900, false: int = 120, limit: float = 17.0, by_px: float = 1.5) -> Scene:
    """Stars to magnitude 19, detected to ``limit``; a distorted camera; some false detections."""
    rng = np.random.default_rng(seed)
    cd = np.array([[-1.0, 0.05], [0.05, 1.0]]) / ARCSEC_PER_RADIAN
    pointing = Pointing(unit_vectors(150.0, 40.0), cd, np.array([499.5, 499.5]))
    xy = rng.uniform(-60, SIDE + 60, (stars, 2))
    ra, dec = directions_deg(pointing.to_sky(xy))
    pm = rng.normal(0, 30, (stars, 2))
    pm[:10] *= 12
    colour = rng.normal(0.9, 0.4, stars)
    magnitude = 19 + np.log10(rng.random(stars)) / 0.45
    table = Table({
        "source_id": np.arange(stars) + 10**6, "ra": ra - YEARS * pm[:, 0] / 3.6e6 / np.cos(np.radians(dec)),
        "dec": dec - YEARS * pm[:, 1] / 3.6e6, "pmra": pm[:, 0], "pmdec": pm[:, 1],
        "ra_error": np.full(stars, 20.0), "dec_error": np.full(stars, 20.0), "pmra_error": np.full(stars, 0.5),
        "pmdec_error": np.full(stars, 0.5), "ref_epoch": np.full(stars, 1980.0), "phot_g_mean_mag": magnitude,
        "bp_rp": colour,
    })  # fmt: skip
    shown = rng.random(stars) < 0.97 / (1 + np.exp((magnitude - limit) / 0.15))
    row = np.flatnonzero(shown & (bent(xy, by_px) > 0).all(axis=1) & (bent(xy, by_px) < SIDE - 1).all(axis=1))
    flux = np.concatenate([10 ** (-0.4 * (magnitude[row] - 25.0 - 0.1 * (colour[row] - 0.9)))])
    sigma = 0.02 + 0.1 * np.sqrt(10 ** (0.4 * (magnitude[row] - limit)))
    at = bent(xy[row], by_px) + rng.normal(size=(len(row), 2)) * sigma[:, None]
    at = np.concatenate([at, rng.uniform(0, SIDE, (false, 2))])
    sigma = np.concatenate([sigma, np.full(false, 0.1)])
    flux = np.concatenate(
        [flux * 10 ** (0.4 * rng.normal(0, 0.03, len(row))), 10 ** (-0.4 * rng.uniform(-9, -7, false))]
    )
    truth = np.concatenate([row, np.full(false, -1)])
    order = np.argsort(-flux)
    return Scene(measurements(at[order], sigma[order], flux[order]), Catalogue.of(table, "old"), pointing, truth[order])


def measurements(xy: np.ndarray, sigma: np.ndarray, flux: np.ndarray) -> Measurements:
    n, zero = len(xy), np.zeros(len(xy))
    return Measurements(
        x_px=xy[:, 0], y_px=xy[:, 1], covariance=np.column_stack([sigma**2, zero, sigma**2]), flux=flux,
        flux_err=0.03 * flux, background=zero, a_px=zero + 1.1, b_px=zero + 1.1, theta_deg=zero, fwhm_px=zero + 2.5,
        snr=zero + 20, peak=zero + 100, flags=np.zeros(n, np.uint16), shape=(SIDE, SIDE), psf_fwhm_px=2.5, name="frame",
    )  # fmt: skip


@pytest.fixture(scope="module")
def seen() -> Scene:
    return scene(1)


@pytest.fixture(scope="module")
def found(seen: Scene) -> FrameIdentification:
    return solve(seen.measured, seen.catalogue, ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE))), epoch_jyr=2020.0)


def wrong(found: FrameIdentification, truth: np.ndarray) -> int:
    i, j, _ = found.pairs
    return int(np.sum(found.stars.rows[j] != truth[i]))


@pytest.mark.slow
def test_a_wrong_time_of_the_frame_raises_a_doubt_that_names_the_right_one(seen: Scene, found: FrameIdentification):
    assert not any("proper motions" in note for note in found.notes)
    hint = ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE)))
    for stated in (1920.3, 2011.0):  # 20/04/20 in a header is read as 1920
        notes = solve(seen.measured, seen.catalogue, hint, epoch_jyr=stated).notes
        named = [re.search(r"epoch of frame were (\S+) ± (\S+), not (\S+): give epoch_jyr=YEAR", n) for n in notes]
        (year, error, printed), *others = [tuple(map(float, one.groups())) for one in named if one]
        assert not others and printed == stated and abs(year - 2020.0) < 4.0 * error < 40.0, notes
    exchanged = replace(
        seen.catalogue.astrometry,
        pm_ra_mas_per_yr=seen.catalogue.astrometry.pm_dec_mas_per_yr,
        pm_dec_mas_per_yr=seen.catalogue.astrometry.pm_ra_mas_per_yr,
    )
    notes = solve(seen.measured, replace(seen.catalogue, astrometry=exchanged), hint, epoch_jyr=2020.0).notes
    assert any("as if pmra and pmdec were exchanged: give pm='pmdec,pmra'" in note for note in notes), notes


@pytest.mark.slow
def test_nearly_all_stars_are_identified_and_false_matches_are_as_expected(
    seen: Scene, found: FrameIdentification
) -> None:
    real = int((seen.truth >= 0).sum())
    assert len(found.pairs[0]) - wrong(found, seen.truth) >= 0.98 * real
    assert wrong(found, seen.truth) <= found.result.expected_wrong + 3 * np.sqrt(found.result.expected_wrong + 1)
    assert len(np.unique(found.pairs[1])) == len(found.pairs[1])


@pytest.mark.slow
@pytest.mark.parametrize("sigma_arcsec", [0.05, 0.3])
def test_the_error_of_a_catalogue_without_one_is_estimated_from_the_residuals(sigma_arcsec: float) -> None:
    seen = scene(2)
    table = seen.catalogue.table["source_id", "ra", "dec", "pmra", "pmdec", "ref_epoch", "phot_g_mean_mag"].copy()
    table.rename_columns(["source_id", "phot_g_mean_mag"], ["star", "mag"])
    off = np.random.default_rng(4).normal(0, sigma_arcsec / 3600.0, (len(table), 2))
    table["ra"] += off[:, 0] / np.cos(np.radians(table["dec"]))
    table["dec"] += off[:, 1]
    bare = Catalogue.of(table, "bare")
    assert bare.error_is_unknown
    found = solve(seen.measured, bare, ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE))), epoch_jyr=2020.0)
    assert np.sqrt(found.stars.covariance_arcsec[:, 0]) == pytest.approx(sigma_arcsec, rel=0.2)
    assert "no position errors" in found.notes[-1] and found.notes[-1].endswith("give sigma=ARCSEC or sigma=COLUMN")
    real = int((seen.truth >= 0).sum())
    assert len(found.pairs[0]) - wrong(found, seen.truth) >= 0.96 * real


@pytest.mark.slow
def test_a_star_much_brighter_than_catalogued_is_reported(seen: Scene) -> None:
    kept = np.flatnonzero(seen.truth >= 0)[[40, 60]]
    flux = seen.measured.flux.copy()
    flux[kept] *= 10 ** (0.4 * np.array([2.3, -1.2]))
    measured = replace(seen.measured, flux=flux)
    found = solve(measured, seen.catalogue, ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE))), epoch_jyr=2020.0)
    rows = found.pairs[0][found.odd_brightness]
    assert set(kept) <= set(rows) and len(rows) <= len(kept) + found.result.expected_wrong + 3
    words = listing(found)["remark"]
    assert words[kept[0]] == "2.3 mag brighter than catalogued"
    assert words[kept[1]] == "1.2 mag fainter than catalogued"
    assert "mag " not in words[int(np.setdiff1d(found.pairs[0], rows)[0])]
    assert summary(found)["brightness"]["odd"]["words"].startswith(
        f"{np.sum(found.excess_mag[found.odd_brightness] < 0)} "
    )


@pytest.mark.slow
def test_the_loop_converges_and_finds_the_cubic_distortion(found: FrameIdentification) -> None:
    assert found.converged and found.plate.order == 3
    truth = found.placement.pointing.to_sky(np.array([[499.5, 499.5]]))
    x, y, _ = found.plate.predict(*directions_deg(truth))
    assert np.hypot(x[0] - 499.5, y[0] - 499.5) < 1.0
    assert np.median(np.abs(found.residual_px)) < 0.1


@pytest.mark.slow
def test_normalised_residuals_have_unit_variance(found: FrameIdentification) -> None:
    i, j, _ = found.pairs
    variance = found.measured.covariance[i][:, [0, 2]] + found.predicted_covariance[j][:, [0, 2]]
    chi = found.residual_px / np.sqrt(variance)
    # The plate is fitted to them: 2 n residuals have 2 n − 20 degrees of freedom.
    fitted = math.sqrt(1.0 - 20 / chi.size)
    assert found.plate.order == 3 and 1.4826 * np.median(np.abs(chi)) == pytest.approx(fitted, abs=0.12)


@pytest.mark.slow
@pytest.mark.long
def test_magnitudes_distinguish_neighbours_in_a_crowd() -> None:
    crowd = scene(3, stars=30_000, false=4_000)
    header = ApproximateWcs(crowd.pointing.to_wcs((SIDE, SIDE)))
    blind, seeing = (
        solve(crowd.measured, crowd.catalogue, header, epoch_jyr=2020.0, refinement=Refinement(magnitudes=how))
        for how in ("off", "auto")
    )
    assert wrong(seeing, crowd.truth) <= 0.6 * wrong(blind, crowd.truth)
    assert wrong(seeing, crowd.truth) <= seeing.result.expected_wrong + 3 * np.sqrt(seeing.result.expected_wrong + 1)


@pytest.mark.slow
def test_without_proper_motions_fast_stars_are_lost(seen: Scene, found: FrameIdentification) -> None:
    header = ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE)))
    still = solve(seen.measured, seen.catalogue, header, epoch_jyr=2020.0, motion=False)
    assert (still.scatter_arcsec > 1.8 * found.scatter_arcsec).all()
    right = [len(each.pairs[0]) - wrong(each, seen.truth) for each in (found, still)]
    # Slow stars are still found, because larger errors are estimated.
    assert 0.9 * right[0] < right[1] < right[0]
    fast = np.intersect1d(np.arange(10), seen.truth)
    assert np.isin(fast, found.stars.rows[found.pairs[1]]).all()
    assert not np.isin(fast, still.stars.rows[still.pairs[1]]).all()


def test_zero_point_colour_term_and_limit_are_those_of_the_camera(found: FrameIdentification) -> None:
    zero, curve = found.zero_point, found.completeness
    assert zero is not None and curve is not None
    assert zero.zero_point == pytest.approx(25.0, abs=4 * zero.sigma + 0.01) and not zero.bend
    assert zero.colour_term == pytest.approx(0.1, abs=4 * zero.colour_sigma)
    assert zero.scatter == pytest.approx(0.03, abs=0.01)
    assert curve.limit == pytest.approx(17.0, abs=0.15) and curve.top > 0.9


@pytest.mark.slow
def test_an_aim_and_a_scale_replace_a_header(seen: Scene, found: FrameIdentification) -> None:
    aim = Aim(150.05, 39.97, 0.2, (0.8, 1.25))
    other = solve(seen.measured, seen.catalogue, aim, epoch_jyr=2020.0)
    same = dict(zip(found.pairs[0], found.stars.rows[found.pairs[1]], strict=True))
    again = dict(zip(other.pairs[0], other.stars.rows[other.pairs[1]], strict=True))
    assert len(set(same.items()) ^ set(again.items())) <= 2


def test_every_measurement_and_every_lost_star_has_its_row(found: FrameIdentification) -> None:
    table = listing(found)
    fate = np.asarray(table["fate"])
    assert (fate == "identified").sum() == len(found.pairs[0])
    assert (fate == "missing").sum() == len(found.missing)
    assert np.isin(fate[: len(found.measured)], ["identified", "unidentified"]).all()
    inside = int(found.inside.sum())
    on_frame = int(found.inside[found.pairs[1]].sum())
    assert (fate == "missing").sum() + (fate == "too faint").sum() == inside - on_frame
    identified = table[fate == "identified"]
    np.testing.assert_allclose(identified["x_image"], identified["x_px"] + 1)
    off = np.asarray(identified["x_px"] - identified["star_x_px"])
    np.testing.assert_allclose(off, identified["residual_x_px"], atol=1e-9)
    assert table["p_match"].mask[fate != "identified"].all() and table["measurement"].mask[fate == "missing"].all()
    assert all(table["remark"][fate == "missing"])
    total = np.asarray(identified["p_match"] + identified["p_none"]) + np.ma.filled(identified["p_second"], 0.0)
    assert (total < 1 + 1e-9).all()


@pytest.mark.slow
def test_a_star_close_to_another_is_missing_because_of_it() -> None:
    seen = scene(2)
    bright = np.flatnonzero(seen.truth >= 0)[20]
    row = int(seen.truth[bright])
    table = seen.catalogue.table.copy()
    table.add_row(table[row])
    table["source_id"][-1], table["phot_g_mean_mag"][-1] = 7, table["phot_g_mean_mag"][row] + 1.0
    table["dec"][-1] += 1.5 / 3600
    crowd = Catalogue.of(table, "crowd")
    found = solve(seen.measured, crowd, ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE))), epoch_jyr=2020.0)
    rows = listing(found)
    companion = rows[np.ma.filled(rows["star"], 0) == 7]
    assert companion["fate"][0] == "missing"
    assert f"is {10**6 + row}; one mark for both" in companion["remark"][0]


@pytest.mark.slow
def test_measurements_fainter_than_the_catalogue_are_reported(seen: Scene, found: FrameIdentification) -> None:
    assert not len(found.beyond_catalogue)
    table = seen.catalogue.table
    limit = 16.0
    shallow = Catalogue.of(table[table["phot_g_mean_mag"] < limit], "shallow")
    hint = ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE)))
    few = solve(seen.measured, shallow, hint, epoch_jyr=2020.0)
    fainter = np.asarray(table["phot_g_mean_mag"])[seen.truth] > limit + 0.2
    fainter &= seen.truth >= 0
    beyond = np.isin(np.arange(len(seen.truth)), few.beyond_catalogue)
    assert beyond[fainter].mean() > 0.9 and len(few.missing) < 0.05 * len(shallow)
    unidentified = next(line for line in frame_lines(summary(few)) if "not in the catalogue" in line)
    assert f"{len(few.beyond_catalogue)} of them fainter than its limit" in unidentified


def test_stars_fainter_than_the_given_limit_are_not_used(seen: Scene) -> None:
    header = ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE)))
    few = solve(seen.measured, seen.catalogue, header, epoch_jyr=2020.0, faintest=15.0)
    assert (few.stars.magnitude <= 15.0).all() and few.converged


@pytest.mark.slow
def test_a_given_plate_order_is_kept(seen: Scene) -> None:
    header = ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE)))
    linear = solve(seen.measured, seen.catalogue, header, epoch_jyr=2020.0, refinement=Refinement(order=1))
    # The missing distortion is a floor of all residuals, and is said.
    assert linear.plate.order == 1 and linear.plate.floor_arcsec > 0.2
    assert any("whatever the quoted errors" in note for note in linear.notes)
    words = " ".join(" ".join(frame_lines(summary(linear))).split())
    assert re.search(r"errors 1\.\d\d times those quoted and a floor of 0\.\d+″", words)


def test_the_summary_is_plain_json(found: FrameIdentification) -> None:
    content = json.loads(json.dumps(summary(found), allow_nan=False))
    assert content["found"]["identified"] == len(found.pairs[0])
    assert content["place"]["scale_arcsec_per_px"] == pytest.approx(1.0, abs=0.02)
    model, scale = found.estimate.error_model, content["place"]["scale_arcsec_per_px"]
    assert model is not None and content["error_note"] == model.note
    for term, name in ERROR_TERM_NAMES.items():
        quantity, unit = model.terms.get(term), scale if "floor" in term else 1.0
        assert content["estimated"].get(name) == (
            None if quantity is None else pytest.approx([unit * quantity.value, unit * quantity.standard_error])
        )
    assert content["brightness"]["completeness"]["words"].endswith(f"{found.completeness.limit:.2f}")


def test_a_catalogue_that_does_not_cover_the_field_is_refused(seen: Scene) -> None:
    header = ApproximateWcs(
        Pointing(unit_vectors(10.0, 40.0), seen.pointing.cd, seen.pointing.origin_px).to_wcs((SIDE, SIDE))
    )
    with pytest.raises(InputError, match=r"old: 0 stars within 0\.\d+° of 10\.0000°, \+40\.0000°.*cover the field"):
        solve(seen.measured, seen.catalogue, header, epoch_jyr=2020.0)


def test_a_moving_catalogue_needs_the_time_of_the_frame(seen: Scene) -> None:
    with pytest.raises(
        InputError, match="old: its stars move, but the time of the frame is not known; give epoch_jyr=YEAR"
    ):
        solve(seen.measured, seen.catalogue, ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE))), epoch_jyr=None)


def test_a_wrong_field_is_refused_with_the_odds(seen: Scene) -> None:
    rng = np.random.default_rng(4)
    lies = measurements(rng.uniform(0, SIDE, (300, 2)), np.full(300, 0.05), 10 ** rng.uniform(2, 5, 300))
    with pytest.raises(InputError, match=r"frame: no solution: by the header's plate solution the best has odds 1:"):
        solve(lies, seen.catalogue, ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE))), epoch_jyr=2020.0)


def test_cones_contain_all_fields_allowed_by_the_hints(seen: Scene) -> None:
    frame = footprint(seen.pointing, (SIDE, SIDE))
    assert frame.radius_deg == pytest.approx(1.1 * np.hypot(500, 500) / 3600, rel=0.01)
    about = search_cone(
        [ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE))), Aim(150.5, 40.0, 0.2, (0.9, 1.1))], (SIDE, SIDE)
    )
    assert about is not None and about.holds(frame) and about.holds(Cone(150.5, 40.0, 0.2))
    assert not Cone(150.0, 40.0, 1.0).holds(Cone(152.0, 40.0, 1.0))


def test_stars_that_move_into_a_cone_are_in_it() -> None:
    table = {"ra": [10.0], "dec": [21.0], "pmra": [0.0], "pmdec": [-36000.0], "ref_epoch": [2000.0]}
    runner = Catalogue.of(table, "runner", options=CatalogueOptions(sigma=0.1, pm_sigma_mas_per_yr=1.0))
    assert len(StarField.of(runner, 2100.0, near=Cone(10.0, 20.0, 0.5))) == 1
    assert len(StarField.of(runner, 2010.0, near=Cone(10.0, 20.0, 0.5))) == 0


def test_a_nonlinear_response_is_found_and_a_linear_one_kept() -> None:
    rng = np.random.default_rng(5)
    seen, colour = rng.uniform(-12, -5, 300), np.full(300, np.nan)
    for curve, terms in ((0.0, 0), (0.08, 2)):
        magnitude = seen + 25 + curve * (seen + 8) ** 2 + rng.normal(0, 0.05, 300)
        magnitude[:12] += rng.normal(0, 3, 12)
        zero = ZeroPoint.of(10 ** (-0.4 * seen), magnitude, colour, np.ones(300))
        assert zero is not None and min(len(zero.bend), 2) == terms
        assert np.median(np.abs(zero(10 ** (-0.4 * seen)) - magnitude)) < 0.05
    assert ZeroPoint.of(np.ones(2), np.ones(2), colour[:2], np.ones(2)) is None


@pytest.mark.slow
def test_saturated_stars_do_not_bend_the_magnitudes_of_a_linear_detector(
    seen: Scene, found: FrameIdentification
) -> None:
    """They lost up to 1.5 mag, and a curve of third order was fitted through them."""
    flux, i = seen.measured.flux.copy(), found.pairs[0]
    bright = i[np.argsort(-flux[i])[: len(i) // 6]]
    full = flux[bright].min()
    flags = seen.measured.flags.copy()
    flux[bright], flags[bright] = full * (flux[bright] / full) ** 0.5, Flag.SATURATED
    hint = ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE)))
    lossy = solve(replace(seen.measured, flux=flux, flags=flags), seen.catalogue, hint, epoch_jyr=2020.0)
    assert found.zero_point is not None and lossy.zero_point is not None and not found.zero_point.bend
    assert not lossy.zero_point.bend
    assert abs(lossy.zero_point.zero_point - found.zero_point.zero_point) < 4 * found.zero_point.sigma


def test_completeness_drops_where_stars_are_lost() -> None:
    rng = np.random.default_rng(6)
    magnitude = rng.uniform(10, 20, 2000)
    found = (rng.random(2000) < 0.95 / (1 + np.exp((magnitude - 16.5) / 0.3))).astype(float)
    curve = Completeness.of(magnitude, found)
    assert curve is not None
    assert curve.limit == pytest.approx(16.5, abs=0.1) and curve.top == pytest.approx(0.95, abs=0.02)
    assert curve.faintest(0.01) == pytest.approx(16.5 + 0.3 * np.log(94), abs=0.5)
    share = curve.identified / np.maximum(curve.stars, 1)
    middle = 0.5 * (curve.edges[1:] + curve.edges[:-1])
    assert np.abs(share - curve(middle))[curve.stars > 30].max() < 0.15
    assert Completeness.of(np.full(3, np.nan), np.ones(3)) is None


def test_printed_errors_are_never_rounded_to_zero_and_faint_completeness_is_stated():
    zero = ZeroPoint(20.32901, 0.00034, -0.0001, 0.00002, (), 0.0, 1.0, (0.0, 1.0), 0.7, 0.02, 3456.0)
    assert zero.describe() == (
        "zero point 20.3290 ± 0.0003 mag, colour term -0.00010 ± 0.00002; scatter 0.020 mag of 3456 pairs"
    )
    assert replace(zero, sigma=0.0021).words == "20.329 ± 0.002"
    edges, none = np.array([10.0, 16.0]), np.zeros(1)
    assert Completeness(1.0, 30.0, 0.5, edges, none, none).describe() == (
        "100 % of the stars detected, to the faintest of the catalogue"
    )
    assert Completeness(1.0, 17.1, 0.5, edges, none, none).describe() == (
        "100 % of the bright stars detected, 90 % of the faintest in the catalogue (16.00)"
    )
    assert Completeness(0.98, 15.2, 0.5, edges, none, none).describe() == (
        "98 % of the bright stars detected, half as many at magnitude 15.20"
    )


@pytest.mark.skipif(not (DATA / "m67_poss1951").is_dir(), reason="the plate of M67 is not here")
@pytest.mark.slow
def test_a_plate_of_1951_is_identified_with_gaia() -> None:
    from astropy.wcs import WCS

    from sameas.io import read_table

    folder = DATA / "m67_poss1951"
    frame = read(folder / "M6707HH.fits")
    measured = detect(frame)
    options = CatalogueOptions(sigma=0.001, epoch="2016.0", pm_sigma_mas_per_yr=0.3)
    gaia = Catalogue.of(read_table(folder / "gaia_edr3_m67_r0.5deg.csv"), "Gaia", options=options)
    epoch = frame.facts.time().jyear
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hint = ApproximateWcs(WCS(frame.header))
    found = solve(measured, gaia, hint, epoch_jyr=epoch, faintest=18.5)
    still = solve(measured, gaia, hint, epoch_jyr=epoch, faintest=18.5, motion=False)
    assert len(found.pairs[0]) >= 1160
    assert (found.scatter_arcsec <= 0.18).all() and still.scatter_arcsec.max() > 0.2
    moved = np.hypot(*found.stars.moved_arcsec.T)
    fast = np.flatnonzero((moved > 1.9) & found.inside)
    lost = np.setdiff1d(fast, found.pairs[1])
    assert len(fast) == 34 and len(lost) <= 5 and int(np.argmax(np.where(found.inside, moved, 0))) in found.pairs[1]
    # The magnitude of a saturated star is inaccurate, but excludes stars a hundred times fainter.
    has_magnitude = measured.clean(Flag.BLENDED | Flag.SATURATED)[found.pairs[0]]
    assert np.nanmin(found.excess_mag[has_magnitude]) > -4.0 and len(found.odd_brightness) <= 55
    table = listing(found)
    missing = table[np.isin(np.ma.filled(table["star"], 0), found.stars.ids[lost])]
    assert len(missing) == len(lost) and all(missing["remark"])


@pytest.mark.skipif(not (DATA / "asteroid_2713").is_dir(), reason="the frames of asteroid 2713 are not here")
@pytest.mark.slow
def test_two_raw_frames_without_a_solution_agree_to_a_tenth_of_a_pixel() -> None:
    from scipy.spatial import cKDTree

    from sameas.io import read_table

    folder = DATA / "asteroid_2713"
    calibration = MasterFrames.of(darks=[read(path) for path in sorted(folder.glob("*Dark*"))])
    options = CatalogueOptions(sigma=0.1, epoch="2000.0", magnitude="VT")
    tycho = Catalogue.of(read_table(folder / "tycho2_field_r0.3deg.csv"), "Tycho-2", options=options)
    found = []
    for path in (sorted(folder.glob("*Light*"))[k] for k in (0, 9)):
        frame = calibration(read(path))
        aim = Aim(*frame.facts.aim_deg, 5 / 60, (1.176 * 0.8, 1.176 * 1.2))
        found.append(solve(detect(frame), tycho, aim, epoch_jyr=frame.facts.time().jyear))
    for each in found:
        assert len(each.pairs[0]) == 7 and (np.sqrt(np.mean(each.residual_arcsec**2, axis=0)) < 0.3).all()
    one, two = (each.measured[each.measured.snr > 20] for each in found)
    ra, dec, _ = found[0].plate.to_sky(one.x_px, one.y_px)
    at = np.column_stack(found[1].plate.predict(ra, dec)[:2])
    off, near = cKDTree(np.column_stack([two.x_px, two.y_px])).query(at)
    close = off < 2
    step = at[close] - np.column_stack([two.x_px, two.y_px])[near[close]]
    terms = np.column_stack([np.ones(close.sum()), at[close] / 500 - 1])
    left = step - terms @ np.linalg.lstsq(terms, step, rcond=None)[0]
    assert close.sum() > 80 and (1.4826 * np.median(np.abs(left), axis=0) < 0.12).all()


@pytest.mark.slow
def test_trails_of_stars_outside_the_frame_are_identified_with_them(seen: Scene, found: FrameIdentification) -> None:
    px, shape = found.predicted_px, found.measured.shape
    outside = (px[:, 0] < -3.0) & (px[:, 0] > -10.0) & (px[:, 1] > 20.0) & (px[:, 1] < shape[0] - 20.0)
    row = np.flatnonzero(outside)[np.argmin(found.stars.magnitude[outside])]
    end = px[row] + [11.0, 0.0]
    new = {"x_px": end[:1], "y_px": end[1:], "covariance": [[40.0, 0.0, 0.01]], "flags": [int(Flag.EDGE)]}
    columns = ("flux", "flux_err", "background", "a_px", "b_px", "theta_deg", "fwhm_px", "snr", "peak")
    rows: dict[str, Any] = {name: np.concatenate([getattr(seen.measured, name), value]) for name, value in new.items()}
    rows |= {name: np.append(getattr(seen.measured, name), np.median(getattr(seen.measured, name))) for name in columns}
    hint = ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE)))
    for half_length_px, expected in ((12.0, [row]), (2.0, [])):
        trails = rows | {"a_px": np.full(len(rows["flux"]), half_length_px / math.sqrt(3.0))}
        again = solve(replace(seen.measured, **trails), seen.catalogue, hint, epoch_jyr=2020.0)
        last = again.pairs[0] == len(seen.measured)
        assert again.pairs[1][last].tolist() == expected


@pytest.mark.slow
def test_masked_stars_do_not_count_as_missed(seen: Scene, found: FrameIdentification) -> None:
    measured = seen.measured
    y, x = np.mgrid[:SIDE, :SIDE]
    blind = np.hypot(x - 350, y - 600) < 250
    clear = ~blind[np.rint(measured.y_px).astype(int), np.rint(measured.x_px).astype(int)]
    masked = replace(measured[np.flatnonzero(clear)], blind=blind)
    again = solve(masked, seen.catalogue, ApproximateWcs(seen.pointing.to_wcs((SIDE, SIDE))), epoch_jyr=2020.0)
    assert again.completeness is not None and found.completeness is not None
    assert abs(again.completeness.top - found.completeness.top) < 0.08
    assert abs(again.completeness.limit - found.completeness.limit) < 0.1
    behind = blind[tuple(np.rint(again.predicted_px[again.missing]).astype(int).T[::-1])]
    assert not behind.any() and len(again.missing) <= len(found.missing)
