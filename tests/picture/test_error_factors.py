"""Error factors: wrongly stated errors are rescaled to the residuals of certain pairs."""

import re
from dataclasses import replace

import numpy as np
import pytest
from modelled_scenes import describe, feed, straight
from scipy.stats import multivariate_normal

from sameas.gaussian import log_density
from sameas.many.observations import records_of
from sameas.picture.error_factors import (
    BLOCK,
    ERROR_FACTORS,
    ErrorFactors,
    information,
    log_of_differences,
    log_of_residuals,
    pairs_within,
)
from sameas.picture.picture import Picture, picture_states
from sameas.picture.tables import RANGE_BANDS, Scan
from sameas.picture.track_pairs import keys
from sameas.picture.watch import Watch
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Description, Site

FACTORS = np.array(ERROR_FACTORS)


def spd(rng, n, size):
    root = size * rng.standard_normal((n, 2, 2))
    return root @ root.transpose(0, 2, 1) + 0.3 * size**2 * np.eye(2)


def test_sources_of_the_same_factor_are_one_line():
    """Eight radars whose errors are a quarter of what their kind assumes were eight lines of two."""
    factors = ErrorFactors(("ais", "west", "east"), factor=np.array([0.25, 0.25, 1.0]), sigma=np.full(3, 0.01))
    [line] = factors.lines()
    assert line == "ais and west: positions err by at most 0.25 times what is stated or assumed; counted so"


def test_the_density_of_a_difference_is_normal_with_a_few_outliers():
    rng = np.random.default_rng(1)
    one, other, motion, delta = spd(rng, 3, 5.0), spd(rng, 3, 2.0), spd(rng, 3, 1.0), 9.0 * rng.standard_normal((3, 2))
    found = log_of_differences(delta, one, other, motion) - np.log(2.0 * np.pi)
    for n, f, g in ((0, 4, 4), (1, 0, 16), (2, 9, 3)):
        total = FACTORS[f] ** 2 * one[n] + FACTORS[g] ** 2 * other[n] + motion[n]
        usual, wide = (multivariate_normal([0.0, 0.0], size * total).pdf(delta[n]) for size in (1.0, 100.0))
        # The odds of an outlier are 1 to 99.
        assert found[n, f, g] == pytest.approx(np.log(usual + wide / 99.0), abs=1e-5)


def after_pairs(rng, true, n, stated_m, weight=1.0):
    """The factors after n differences of every two sources, of errors that are ``true`` times as stated."""
    names = tuple(f"source {k}" for k in range(len(true)))
    factors = ErrorFactors().of_sources(names)
    for s in range(len(true)):
        for t in range(s + 1, len(true)):
            later, first = (np.broadcast_to(stated_m[k] ** 2 * np.eye(2), (n, 2, 2)) for k in (t, s))
            spread = np.hypot(true[s] * stated_m[s], true[t] * stated_m[t])
            # Sources in either order.
            parts = np.full(n, t * RANGE_BANDS), np.full(n, s * RANGE_BANDS)
            delta = spread * rng.standard_normal((n, 2))
            factors = factors.with_sure_pairs(parts, delta, (later, first), np.zeros((n, 2, 2)), np.full(n, weight))
    return factors


@pytest.mark.parametrize("true", [(1.0, 1.0, 1.0), (2.0, 0.5, 1.0), (0.5, 0.5, 0.5)])
def test_three_sources_determine_whose_errors_are_wrongly_stated(true):
    factors = after_pairs(np.random.default_rng(2), true, 120, (10.0, 20.0, 15.0))
    away = np.log(factors.factor / np.array(true))
    assert np.all(np.abs(away) < 4.0 * np.maximum(factors.sigma, 0.05))
    told_of = {name for line in factors.lines() for name in re.split(", | and ", line.partition(":")[0])}
    assert told_of == {f"source {k}" for k in range(3) if true[k] != 1.0}


def test_many_sources_are_estimated_in_blocks():
    true = np.array([1.0, 2.0, 0.5, 1.0, 2.0])
    assert len(true) > BLOCK
    factors = after_pairs(np.random.default_rng(3), true, 120, np.full(5, 10.0))
    assert np.all(np.abs(np.log(factors.factor / true)) < 0.35)


def test_without_certain_or_new_pairs_nothing_is_learned_of_errors():
    before = ErrorFactors().of_sources(("a", "b"))
    # Before any evidence the variance of the errors is the stated one.
    assert before.factor == pytest.approx(np.ones(2), abs=1e-6) and not before.lines()
    again = after_pairs(np.random.default_rng(4), (3.0, 3.0), 500, (10.0, 10.0), weight=0.0)
    assert again.factor == pytest.approx(before.factor) and not again.lines()


@pytest.mark.parametrize("lasting", [0.0, 0.5, 0.9, 1.0])
def test_a_constant_error_is_seen_once_however_often_it_is_compared(lasting):
    rng, n = np.random.default_rng(6), 12
    constant, new = rng.standard_normal((40_000, 1)), rng.standard_normal((40_000, n))
    squares = (np.sqrt(lasting) * constant + np.sqrt(1.0 - lasting) * new) ** 2
    rho = np.full(n, lasting)
    total = information(np.arange(n), rho, rho).cumsum()
    for count in (1, 3, n):
        # The mean of k independent squares has the variance 2 / k.
        assert total[count - 1] == pytest.approx(2.0 / squares[:, :count].mean(axis=1).var(), rel=0.05)


def test_three_tracks_of_a_ship_are_two_differences():
    rng, m = np.random.default_rng(8), 4
    place = rng.standard_normal((m, 2))
    pairs, share = pairs_within(np.array([[0, 1, 2, 3], [-1, 1, -1, 3], [-1, -1, 2, -1]]))
    assert share[:6].sum() == pytest.approx(3.0) and share[6:].tolist() == [1.0] and len(pairs) == 7
    delta = place[pairs[:6, 0]] - place[pairs[:6, 1]]
    for variance in (0.3, 1.0, 4.0):
        of_pairs = share[:6] @ log_density(delta, np.tile(2.0 * variance * np.eye(2), (6, 1, 1)))
        # m − 1 independent contrasts with the variance of one track.
        contrasts = np.linalg.svd(np.ones((1, m)))[2][1:] @ place
        exact = log_density(contrasts, np.tile(variance * np.eye(2), (m - 1, 1, 1))).sum()
        assert of_pairs - exact == pytest.approx(-3.0 * np.log(2.0))


def test_errors_that_are_forgotten_between_two_differences_count_in_full():
    weight = information(np.array([0, 1, 5]), np.array([0.6, 0.6, 0.6]), np.zeros(3))
    assert weight == pytest.approx([1.0, 0.64, 0.64])


def test_records_and_scan_have_the_same_larger_errors_and_velocities_keep_theirs():
    rng = np.random.default_rng(5)
    times = np.arange(0.0, 31.0, 10.0)
    x, v = straight([[0.0, 0.0], [900.0, 0.0]], [[4.0, 0.0], [0.0, 3.0]], times)
    scene = Scene.of([feed(rng, describe("radar", "tracks", 20.0), times, x, v, 0.0, ["1", "2"])])
    before = Scan.of(scene.at(35.0))
    after = ErrorFactors(("radar",), by_range=np.full((1, RANGE_BANDS), 2.0)).applied(before)
    assert after.reported_covariance[:, :2, :2] == pytest.approx(4.0 * before.reported_covariance[:, :2, :2])
    assert after.reported_covariance[:, 2:, 2:] == pytest.approx(before.reported_covariance[:, 2:, 2:])
    grown = after.covariance - before.covariance
    assert grown[:, :2, :2] == pytest.approx(3.0 * before.reported_covariance[:, :2, :2])
    assert records_of(after.now.sources[0]).full_covariance() == pytest.approx(after.covariance[:, :2, :2])
    assert after.error_factor.tolist() == [2.0, 2.0]


def after_ways(rng, true, n, correlation=0.0, stated_m=10.0, carried_m=0.0):
    """The factor of one source after n displacements of its tracks; errors are ``true`` times the stated ones. Errors
    of the velocity displace positions by ``carried_m``; objects are stationary."""
    stated, carried = (np.broadcast_to(m**2 * np.eye(2), (n, 2, 2)) for m in (stated_m, carried_m))
    spread = np.sqrt(2.0 * (1.0 - correlation) * (true * stated_m) ** 2 + carried_m**2)
    shift, factors = spread * rng.standard_normal((n, 2)), ErrorFactors().of_sources(("ais",))
    for k in np.array_split(np.arange(n), n // 20):
        factors = factors.with_shifts(
            np.zeros(len(k), np.int64), shift[k], (2.0 * stated[k], stated[k]), (carried[k], carried[k])
        )
    return float(factors._with_posterior().factor[0])


@pytest.mark.parametrize("rho", [0.0, 0.7, 0.95, 1.0])
def test_residuals_bound_factors_from_below_and_prefer_none_above(rho):
    rng, n = np.random.default_rng(9), 400
    stated, still, part = np.tile(100.0 * np.eye(2), (n, 1, 1)), np.zeros((n, 2, 2)), np.zeros(n, np.int64)
    shift = 10.0 * np.sqrt(2.0 * (1.0 - rho)) * rng.standard_normal((n, 2))
    factors = ErrorFactors().of_sources(("receiver",))
    factors = factors.with_shifts(part, shift, (2.0 * stated, stated), (still, still))
    log_likely, relative = log_of_residuals(factors.log_shifts)[0], FACTORS - np.sqrt(1.0 - rho)
    allowed = log_likely[(relative > 0.2) & (FACTORS < 2.5)]
    assert np.ptp(allowed) < 0.05
    assert np.all(log_likely[relative < -0.2] < allowed.mean() - 10.0)


@pytest.mark.parametrize("seed", range(4))
def test_track_displacements_as_stated_leave_errors_as_stated(seed):
    # Displacements give a lower bound of the errors, not the correlated part.
    rng = np.random.default_rng(seed)
    assert after_ways(rng, 1.0, 300) == pytest.approx(1.0, rel=0.12)
    assert after_ways(rng, 1.0, 300, correlation=0.9) == pytest.approx(1.0, rel=0.12)
    assert after_ways(rng, 1.0, 600, carried_m=8.0) == pytest.approx(1.0, rel=0.18)
    assert after_ways(rng, 2.0, 300) == pytest.approx(2.2, rel=0.15)


def crowd(seed, stated):
    """Eight ships within 600 m, observed by three trackers with σ = 20 m, stated as ``stated`` times that."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 601.0, 10.0)
    x, v = straight(rng.uniform(0.0, 600.0, (8, 2)), 0.3 * rng.standard_normal((8, 2)), times)
    names = [str(k) for k in range(8)]
    sources = [
        feed(rng, describe(f"tracker {k}", "tracks", 20.0 * stated), times, x, v, 0.0, names, sigma_m=20.0)
        for k in range(3)
    ]
    return Scene.of(sources), times


@pytest.mark.slow
def test_errors_stated_half_as_large_do_not_make_a_picture_overconfident():
    expected = wrong = right = total = 0
    for seed in range(4):
        scene, times = crowd(seed, 0.5)
        for state in picture_states(scene, times[20::4], Watch()):
            names = np.append(state.scan.track, "")[state.members]
            good = (names == names[:, :1]).all(axis=1)
            sure = state.probability > 0.99
            expected, wrong = expected + float((1.0 - state.probability[sure]).sum()), wrong + int((~good & sure).sum())
            right, total = right + int(good.sum()), total + 8
    assert wrong <= 2.0 * expected + 3.0
    assert right > 0.93 * total


@pytest.mark.slow
def test_a_picture_reports_whose_errors_are_wrongly_stated():
    for stated, due in ((1.0, []), (2.0, ["tracker 0", "tracker 1", "tracker 2"])):
        scene, times = crowd(1, stated)
        errors = Picture.of(scene, times).summary.errors
        assert [name for line in errors for name in re.split(", | and ", line.partition(":")[0])] == due


def map_error(seed, ships=300, seconds=330):
    """Ships with AIS, whose positions are 0.2 % too far east or west, and a radar without velocities in their middle.

    The error persists and grows to 40 m at 20 km; both sources state much larger errors than they have otherwise.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, seconds + 1.0, 1.0)
    start, v = rng.uniform(-15e3, 15e3, (ships, 2)), rng.uniform(-6.0, 6.0, (ships, 2))
    plane = LocalPlane(50.0, -1.0)
    radar, ais = [], []
    for time_s in times:
        position = start + time_s * v
        shown = np.flatnonzero(rng.random(ships) < 0.92) if time_s % 3.0 == 0.0 else np.empty(0, np.int64)
        range_m = np.hypot(*position[shown].T) + 15.0 * rng.standard_normal(len(shown))
        bearing = np.degrees(np.arctan2(*position[shown].T)) + 0.2 * rng.standard_normal(len(shown))
        radar += zip(np.full(len(shown), time_s), range_m, bearing % 360.0, shown, strict=True)
        sent = np.flatnonzero((time_s + np.arange(ships)) % 10.0 == 0.0)
        place = position[sent] * [1.002, 1.0] + 5.0 * rng.standard_normal((len(sent), 2))
        ais += zip(np.full(len(sent), time_s), *plane.to_geodetic(place), *v[sent].T, sent, strict=True)
    time_s, range_m, bearing, number = np.array(radar).T
    names = np.array([str(int(k)) for k in number], object)
    columns = {"time_s": time_s, "range_m": range_m, "bearing_deg": bearing, "track_id": names}
    plots = Reports.of("radar", "table", columns)
    time_s, lat, lon, east, north, number = np.array(ais).T
    names = np.array([f"{235_000_000 + int(k)}" for k in number], object)
    columns = {"time_s": time_s, "lat_deg": lat, "lon_deg": lon, "speed_m_per_s": np.hypot(east, north),
               "course_deg": np.degrees(np.arctan2(east, north)) % 360.0, "mmsi": names}  # fmt: skip
    site = Description("radar", "marine radar", site=Site(50.0, -1.0))
    return Scene.of([(site, plots), (Description("ais", "ais"), Reports.of("ais", "ais", columns))], plane)


@pytest.mark.slow
def test_errors_that_persist_and_grow_with_range_do_not_split_ships():
    *_, state = picture_states(map_error(1), np.arange(16.0, 331.0, 8.0), Watch())
    joint = state.members[(state.members >= 0).all(axis=1)]
    names = state.scan.track[joint]
    right = sum(int(mmsi) - 235_000_000 == int(track) for track, mmsi in names.tolist())
    assert right >= 290
    assert isinstance(state.watch, Watch)
    by_range = state.watch.memory.tracks.error_factors.by_range[0]
    assert by_range[1] > 1.1 * by_range[3]


def test_a_new_estimate_of_a_factor_is_no_evidence_against_pairs():
    scene = map_error(3, ships=60, seconds=80)
    *_, state = picture_states(scene, np.arange(16.0, 73.0, 8.0), Watch())
    assert isinstance(state.watch, Watch)
    memory = state.watch.memory
    halved = replace(memory.tracks.error_factors, by_range=0.5 * memory.tracks.error_factors.by_range)
    smaller = replace(state.watch, memory=replace(memory, tracks=replace(memory.tracks, error_factors=halved)))
    now = scene.at(80.0)
    log_ratio = []
    for watch in (state.watch, smaller):
        after = watch.advance(now).watch
        assert isinstance(after, Watch)
        pairs = after.memory.track_pairs
        history = pairs.log_ratio + pairs.log_reported - pairs.log_now
        near = pairs.chi_sq < 6.0
        log_ratio.append(dict(zip(keys(pairs.first, pairs.second)[near].tolist(), history[near].tolist(), strict=True)))
    lost = np.array([log_ratio[0][pair] - value for pair, value in log_ratio[1].items()])
    assert len(lost) > 40
    assert lost.mean() < 0.2


def moored(seed, drift_m_per_s=0.0):
    """Eight ships, moored or adrift, 1.5 km apart: AIS of 5 m and radar plots of 15 m, both assumed to be far worse."""
    rng, times = np.random.default_rng(seed), np.arange(0.0, 600.0, 2.0)
    start, velocity = np.column_stack([1500.0 * np.arange(8) - 5000.0, np.full(8, 3000.0)]), np.zeros((8, 2))
    velocity[:, 1] = drift_m_per_s
    x, v = straight(start, velocity, times)
    mmsi, numbers = [f"23500010{k}" for k in range(8)], [str(k) for k in range(8)]
    _, ais = feed(rng, describe("ais", "ais"), times[::5], x[:, ::5], v[:, ::5], 0.0, mmsi, sigma_m=5.0)
    _, radar = feed(rng, describe("radar", "marine radar"), times, x, v, 0.0, numbers, sigma_m=15.0)
    plots = {"time_s": radar.time_s, "x_m": radar.x_m, "y_m": radar.y_m, "track_id": radar.track_id}
    return Scene.of([
        (Description("ais", "ais"), ais),
        (Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0)), Reports.of("radar", "table", plots)),
    ])  # fmt: skip


@pytest.mark.slow
def test_errors_found_to_be_smaller_are_not_taken_for_persistent_ones():
    # While they were thought three times as large, the changes of new errors seemed small.
    alone = []
    for seed in range(5):
        for state in picture_states(moored(seed), np.arange(10.0, 600.0, 10.0)):
            alone += state.p_alone[state.scan.source == 0].tolist()
    assert np.mean(np.array(alone) > 0.5) < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("drift_m_per_s", [0.2, 0.4])
def test_ships_adrift_are_not_split_from_their_own_radar_tracks(drift_m_per_s):
    # Each report of 0.3 ± 0.3 m/s would allow a ship at rest: they were alone in 7 to 10 % of the instants.
    alone = []
    for seed in range(3):
        for state in picture_states(moored(seed, drift_m_per_s), np.arange(10.0, 600.0, 10.0)):
            alone += state.p_alone[state.scan.source == 0].tolist()
    assert np.mean(np.array(alone) > 0.5) < 0.01


def test_velocities_from_positions_have_the_factor_of_positions():
    scene = map_error(2, ships=4, seconds=30)
    before = Scan.of(scene.at(30.0))
    after = ErrorFactors(("radar",), by_range=np.full((1, RANGE_BANDS), 0.5)).applied(before)
    radar = before.source == 0
    assert after.reported_covariance[radar] == pytest.approx(0.25 * before.reported_covariance[radar])
    assert after.reported_covariance[~radar] == pytest.approx(before.reported_covariance[~radar])
